"""The commands for a lens, one function each: generate, verify, tolerance, export, show.

`generate` designs, writes and verifies a lens; `verify` verifies it again from its files.  The command line and
`Design` only call these functions.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

import bstcad
from bstcad.cad.tiling import Tiling
from bstcad.designs import folder as folders
from bstcad.designs.as_designed import scene_text
from bstcad.designs.course import StageRecord
from bstcad.designs.designed_lens import DesignedLens
from bstcad.designs.pipeline import DesignOptions, DesignState, design, purpose
from bstcad.exports import data_sheet, exports
from bstcad.exports.data_sheet import DataSheet
from bstcad.exports.exports import Exported
from bstcad.exports.grid_sag import GridLight
from bstcad.exports.toolpath_files import refuse_hopeless
from bstcad.figures import rendering
from bstcad.figures.drawing import png as rendered
from bstcad.figures.figure_jobs import NoPictures, Pictures, draw_convergence, draw_light, draw_wavefront, light_path_of
from bstcad.figures.light_figures import View, changed_picture, draw_judges, draw_part
from bstcad.figures.photometric_figures import draw_isolux
from bstcad.figures.rendering import RayPath
from bstcad.manufacture.measured import cloud as clouds
from bstcad.manufacture.measured import made_part
from bstcad.manufacture.measured.cloud import Cloud
from bstcad.manufacture.measured.compensation import USUAL
from bstcad.manufacture.measured.compensation import CompensationSettings as CompensationSettings
from bstcad.manufacture.measured.form_error import map_files
from bstcad.manufacture.shop import as_built, rounds
from bstcad.manufacture.shop.as_built import AsBuilt, Retailored
from bstcad.manufacture.shop.rounds import Compensated
from bstcad.manufacture.tolerance import tolerances
from bstcad.manufacture.tolerance.grades import making_of
from bstcad.manufacture.tolerance.tolerances import Tolerances
from bstcad.optics.lens.lens import Lens
from bstcad.optics.trace.measure import FULL, Effort, Light, SpectralLine
from bstcad.planning.effect_estimates import diagnosis, left_out, simulated
from bstcad.planning.net_choice import with_net
from bstcad.planning.reduction import REFINED, Reduction
from bstcad.report import prescription, record, report
from bstcad.report.goal_figures import GoalFigures, figures_of, photometry
from bstcad.report.prescription import SHEET, Order
from bstcad.report.record import Contents, Examined, LeftOut, Report, contents_of, with_part
from bstcad.report.units import prepare
from bstcad.runs import cluster, files, processes, signals
from bstcad.runs.checkpoint import Keeper
from bstcad.runs.environment import circumstances
from bstcad.runs.files import MachineError, SceneError
from bstcad.scene.mount import as_cut
from bstcad.scene.scene import Scene
from bstcad.scene.target import numbered
from bstcad.step_text import beginning
from bstcad.tailoring import effort as efforts
from bstcad.tailoring.driver import NO_HOOKS, Hooks, Progress, no_progress
from bstcad.toolpath.cutting import CHOICES, DEFAULTS, Cutting
from bstcad.verify import checks
from bstcad.verify.checks import Proof
from bstcad.verify.judges import comparison
from bstcad.verify.judges.comparison import Comparison, JudgeEffort
from bstcad.verify.verdict import Check, verdict

if TYPE_CHECKING:
    from bstcad.manufacture.tolerance.as_made import AsMade
    from bstcad.manufacture.tolerance.lit_by import LitBy
    from bstcad.manufacture.tolerance.study import StudySettings

# Patterns of the names of the files of tiles.
TILE_FILES = "tile-*-*.step", "toolpath-raster*tile-*-*.*", "heightmap-tile-*-*.*"
# In a run with a time limit: time reserved for the report, and smallest time for the rays of the verification (s).
REPORT_TIME, MIN_RAY_TIME = 2.0, 0.5

Drawing = Callable[..., Pictures]  # class that draws figures; called with (design, processes.submit)
# Functions of a script that add to a report: checks, from (proof, folder of the files), or a section (heading, HTML).
OwnCheck = Callable[[Proof, Path], Iterable[Check]]
OwnSection = Callable[[Contents], tuple[str, str]]


@dataclass(frozen=True)
class ProofOptions:
    """Options of a verification and of its report, and the effort of a design before it."""

    effort: Effort | None = None  # effort of the verification; None: measure.FULL
    drawing: Drawing | None = None  # class that draws the figures of the report; None: Pictures
    checks: Sequence[OwnCheck] = ()  # additional checks
    sections: Sequence[OwnSection] = ()  # additional sections of report.html
    limit: float | None = None  # largest time (s) from start of design to end of report; None: no limit, as in `verify`
    tailoring: efforts.TailoringEffort = efforts.FULL  # effort of the design, in `generate` and `retailor`
    judges: JudgeEffort = JudgeEffort()  # effort of the comparison with other programs, in `verify`


# --- generate ---------------------------------------------------------------------------------------------------------


def generate(
    scene: Scene, folder: Path, options: ProofOptions = ProofOptions(), hooks: Hooks = NO_HOOKS, *,
    device: str = "auto", resume: bool = False, began: float | None = None,
) -> Report:  # fmt: skip
    """Design a lens, write it to `folder` and verify the written files.

    hooks: functions that are called during the design; `save` and `interrupted` are replaced by this command's own.
    device: "auto", "cpu" or "cuda".  began: value of time.perf_counter() from which the times in the report and
    tailoring.max_time count (None: now).
    During the design a checkpoint is written beside `folder` at intervals; with `resume` the design continues from
    this checkpoint.  After a Ctrl-C the best lens so far is written to the folder that `output_folder` returns.
    """
    scene, _ = with_net(scene, lambda line: hooks.progress("control points", 1, 1, line))
    _refuse_exports(scene)
    path, say = files.beside(folder, "checkpoint"), lambda text: hooks.progress("checkpoint", 0, 0, text)
    keeper = Keeper(path, purpose(scene, device), say, kind=DesignState)
    processes.begin()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with files.exclusive(folder):
        folders.tidy(folder)
        state = keeper.load() if resume else None
        if resume and state is None:
            keeper.say("there is no checkpoint; the design starts from the beginning")
        if not resume and keeper.path.exists():
            keeper.say("there is a checkpoint; the design starts from the beginning, since --resume is not given")
        with _checkpoint_on_error(keeper, refused=(SceneError,)), signals.stop_on_interrupt() as wished:
            hooks = replace(hooks, save=keeper, interrupted=wished)
            with processes.kept_awake():
                own = DesignOptions(effort=options.tailoring)
                found = design(scene, device=device, hooks=hooks, options=own, began=began, start=state)
        with _checkpoint_on_error(keeper):
            options = replace(options, limit=scene.tailoring.max_time)
            report = write(found, output_folder(folder, found.course.stopped or ""), options, hooks.progress)
        if found.course.stopped == "interrupt":
            keeper.flush()
        else:
            keeper.remove()
    return report


def output_folder(folder: Path, stopped: str) -> Path:
    """Return `folder`, or FOLDER-unfinished if a design stopped by Ctrl-C would replace one that was not.

    stopped: why the design ended early ("interrupt": by Ctrl-C), or "".
    """
    if stopped != "interrupt" or not (folder / "report.json").exists():
        return folder
    if record.read_course(folder / "report.json").stopped == "interrupt":
        return folder
    folder = folder.resolve()
    return folder.with_name(f"{folder.name}-unfinished")


def write(
    made: DesignedLens, folder: Path, options: ProofOptions = ProofOptions(), progress: Progress = no_progress
) -> Report:
    """Write a design to `folder`, replacing an earlier design, and verify the written files.

    If it cannot be written or verified, a note on the error names another folder with its design.npz and scene.
    """
    processes.begin()
    with (
        folders.kept_if_unwritten(made, folder),
        folders.replacing(folder) as building,
        _second_process_ended(),
        (options.drawing or Pictures)(made, processes.submit) as drawn,
    ):
        made, proof = _write_and_prove(made, building, drawn, options, progress=progress)
        proven = time.perf_counter()
        irradiances = tuple(light.picture for light in proof.lights)
        folders.write_design(made, proof.lights, building)
        exported = _export_of_scene(made, building)
        order = _order(made, proof.shape, building)
        drawn.sheet(
            data_sheet.draw, _sheet(made, proof, figures_of(made.goals, proof.lights), irradiances[0], order=order)
        )
        progress("report", 0, 1, "")
        estimates = _left_out(made, proof)  # while the second process draws the pictures
        drawn.result()
        made = replace(made, course=made.course.with_stages(StageRecord("report", time.perf_counter() - proven)))
        contents = replace(record.with_failures(_contents(made, proof, estimates), exported.failures), order=order)
        drawn.begin(draw_convergence, contents)
        _write_report(made, proof.lens, contents, building, drawn=drawn, options=options)
        _write_sheet(drawn, building)
        progress("report", 1, 1, "")
    return Report(contents, irradiances, notes=tuple(exported.notes))


def prove(made: DesignedLens, options: ProofOptions = ProofOptions(), progress: Progress = no_progress) -> Report:
    """Write a design to a temporary folder, verify these files, and return the report."""
    processes.begin()
    with tempfile.TemporaryDirectory(prefix="bstcad-") as folder, _second_process_ended():
        drawn = NoPictures(made, processes.submit)
        made, proof = _write_and_prove(made, Path(folder), drawn, options, progress=progress)
    contents = _contents(made, proof, _left_out(made, proof))
    return Report(contents, tuple(light.picture for light in proof.lights))


def _write_and_prove(
    made: DesignedLens, folder: Path, drawn: Pictures, options: ProofOptions, progress: Progress
) -> tuple[DesignedLens, Proof]:
    """Write the geometry to `folder` and verify it; return (design with the times of both stages, its proof)."""
    made = replace(made.with_report_data(), stored=None, lit=())  # design.npz is written again
    processes.return_freed()  # the second process needs the memory for the solid
    began = time.perf_counter()
    progress("write", 0, 1, "STEP, STL, 3MF")
    drawn.solid(made.lens)  # the designed lens is drawn while OCC writes and reads the file
    with scene_errors(made.scene.name):  # raised if the tailored faces do not bound a solid
        write_3mf = folders.write_geometry(made, folder, processes.submit)
    processes.return_freed()
    with ThreadPoolExecutor(1) as beside:
        parallel = [beside.submit(work) for work in (write_3mf, prepare)]
        progress("write", 1, 1, "")
        written = time.perf_counter()
        if options.limit is not None:
            left = options.limit - REPORT_TIME - made.course.seconds_total - (written - began)
            effort = options.effort or FULL
            options = replace(options, effort=replace(effort, seconds=min(effort.seconds, max(left, MIN_RAY_TIME))))
        proof = _prove_files(made, folder, drawn, options, progress=progress)
        for work in parallel:
            work.result()
    proof = replace(proof, checks=(*proof.checks, *checks.unit_checks(folder)))
    verified = time.perf_counter()
    last = (
        StageRecord("write", written - began),
        StageRecord("verify", verified - written, max(light.rrmsd for light in proof.lights)),
    )
    return replace(made, course=made.course.with_stages(*last)), proof


def _prove_files(made: DesignedLens, folder: Path, drawn: Pictures, options: ProofOptions, progress: Progress) -> Proof:
    """Verify the files in a folder and start drawing the pictures of the light; return the proof."""
    progress("verify", 0, 1, "from the written files")

    def draw(light: Light, lines: tuple[SpectralLine, ...], number: int) -> None:
        drawn.begin(draw_light, made.goals[number].picture, light, lines, number=number)
        if (lumens := made.scene.source.luminous_flux) is not None:
            drawn.begin(draw_isolux, light, lumens, number=number)

    proof = checks.verify(folder, made, processes.submit, on_lens=drawn.lens, on_light=draw, effort=options.effort)
    if proof.wavefront is not None:
        drawn.begin(draw_wavefront, proof.wavefront)
    added = (check for of_script in options.checks for check in of_script(proof, folder))
    proof = replace(proof, checks=(*proof.checks, *added))
    progress("verify", 1, 1, "RRMSD " + ", ".join(f"{light.rrmsd:.4f}" for light in proof.lights))
    return proof


@contextlib.contextmanager
def _checkpoint_on_error(keeper: Keeper, refused: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Write a checkpoint if an error or a signal ends the block; the error's note says how to resume.

    refused: errors of an invalid scene, after which the checkpoint of this run is deleted; an earlier one stays.
    """
    try:
        yield
    except refused:
        keeper.withdraw()
        raise
    except BaseException as error:
        if note := keeper.keep_at_exit():
            error.add_note(note)
        raise


@contextlib.contextmanager
def _second_process_ended() -> Iterator[None]:
    """End the second process after an error, as that process may still write to a folder that will be removed."""
    try:
        yield
    except BaseException:
        processes.end()
        raise


@contextlib.contextmanager
def scene_errors(subject: Path | str = "") -> Iterator[None]:
    """Raise a ValueError of the block as a SceneError, with `subject`, such as a file, once at the beginning."""
    try:
        yield
    except ValueError as error:
        sentence = str(error).removeprefix(f"{Path(subject).name}: ")
        raise SceneError(f"{subject}: {sentence}" if subject else sentence) from error


# --- verify -----------------------------------------------------------------------------------------------------------


def verify(
    path: Path, options: ProofOptions = ProofOptions(), *, against: Sequence[Any] = (), measured: Path | None = None,
    place: Path | None = None, progress: Progress = no_progress,
) -> Report | Examined:  # fmt: skip
    """Verify a design again from the files of its folder `path` and rewrite its report; or examine a STEP file `path`.

    against: programs that also trace the lens, by name (judges.comparison.JUDGES) or as your own judge (OwnJudge).
    measured: file of measured points of a made part; the part is then verified, too.
    place: folder for the report of the made part; the design's folder then does not change.  None: this report is
    written to the design's folder and to its subfolder measured/NAME (name of the file of points), which only a
    verification of the same points rewrites.
    """
    against = comparison.choose_judges(against)
    if path.is_file():
        if against or measured:
            raise SceneError(f"{path}: a STEP file is no design, which --against and --measured need; give its folder")
        return examine(path)
    if place is not None and measured is None:
        raise SceneError(f"{place}: -o is only for the report of a made part; give its points with --measured")
    with folders.amending(path, place) as amended:
        made = read(path)
        if against or measured:
            made.scene.lens.require_heights("--against" if against else "--measured")
        with scene_errors():  # reads the cloud first, since the next steps are slow
            cloud, part = clouds.load(measured, made.lens.apertures[1]) if measured else None, None
        with (options.drawing or Pictures)(made, processes.submit) as drawn:
            with scene_errors(path):
                proof = _prove_files(made, path, drawn, options, progress=progress)
            proof = replace(proof, checks=(*proof.checks, *checks.unit_checks(path)))
            drawn.solid(proof.lens)
            judged: list[Comparison] = []
            for number, goal in enumerate(made.goals):
                lit, seed = (proof.lens, made.channels, goal), made.scene.tailoring.seed
                by_others = comparison.run_judges(against, *lit, seed=seed, progress=progress, effort=options.judges)
                drawn.begin(draw_judges, by_others, number=number)
                judged += by_others
            proof = replace(proof, checks=(*proof.checks, *(check for each in judged for check in each.checks)))
            order = _order(made, proof.shape, path)
            contents = _contents(made, proof, _left_out(made, proof))
            contents = replace(contents, order=order, judges=tuple(each.judge for each in judged))
            contents = record.with_earlier_remarks(contents, path / "report.json")
            if place is None:
                drawn.sheet(data_sheet.draw, _sheet(made, proof, contents.goals, proof.lights[0].picture, order=order))
            drawn.begin(draw_convergence, contents)
            studied = tolerances.of_folder(path, made.scene.optic)
            write = partial(_write_report, made, proof.lens, drawn=drawn, options=options, studied=studied)
            if cloud is not None:
                progress("made part", 0, 1, "from its cloud")
                with scene_errors():
                    part = made_part.judge(cloud, proof.lens, made, options.effort)
                progress("made part", 1, 1, "")
                for number, light in enumerate(proof.lights):
                    drawn.begin(draw_part, part, light.picture, number=number)
                own = Path() if place is not None else Path("measured") / _name_of(cloud, path)
                write(with_part(contents, part), amended / own)
                for name, data in map_files(part.deviation).items():
                    files.put(amended / own / name, data)
                contents = with_part(contents, part, "" if place is not None else f"{own.as_posix()}/")
            if place is None:
                write(contents, amended)
                _write_sheet(drawn, amended)
            progress("report", 1, 1, "")
    return Report(contents, tuple(light.picture for light in proof.lights), part)


def compensate(
    path: Path, measured: Sequence[Path], settings: CompensationSettings = USUAL, *,
    progress: Progress = no_progress, effort: Effort = FULL,
) -> Compensated:  # fmt: skip
    """Write what to cut next to the folder `path` of a design, from measured points of the parts that were cut last."""
    made = read(path)
    made.scene.lens.require_heights("compensate")
    with scene_errors():
        return rounds.compensate(made, path, measured, settings, progress=progress, effort=effort)


def retailor(
    path: Path, built: AsBuilt, folder: Path | None = None, options: ProofOptions = ProofOptions(),
    hooks: Hooks = NO_HOOKS,
) -> tuple[Path, Report, Retailored]:  # fmt: skip
    """Tailor the back of the design in the folder `path` anew to its blank as built; write and verify the new design.

    Return (folder of the new design, its report, the RRMSDs before).  folder: of the new design; None: `path` with
    "-as-built" behind its name.  After a Ctrl-C the best lens so far is written.
    """
    folder = folder or path.resolve().with_name(f"{path.resolve().name}-as-built")
    if folder.resolve() == path.resolve():
        raise SceneError(f"{folder}: is the folder of the earlier design; give another folder")
    made = read(path)
    processes.begin()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with files.exclusive(folder), scene_errors():
        with signals.stop_on_interrupt() as wished:
            found = as_built.retailor(made, built, replace(hooks, interrupted=wished), options.tailoring)
        report = write(found.made, folder, options, hooks.progress)
    return folder, report, found


def examine(path: Path) -> Examined:
    """Examine a single STEP file: checks and dimensions of the solid, without a design."""
    beginning.check(path)
    with scene_errors(path):
        found = checks.examine(path, processes.submit)
    passed = all(check.passed for check in found.checks)
    stated = [check.value for check in found.checks if check.id == "stated-density"]
    density = stated[0] if len(stated) == 1 else None
    placement = found.placement.facts() if found.placement.moves else None
    rows = prescription.part(found.lens, found.whole, density, placement=placement)
    words = verdict(passed, ())
    return Examined(path.stem, str(path), words, passed, checks=found.checks, part=rows, placement=placement)


def read(folder: Path) -> DesignedLens:
    """Read the design in a folder, with the stages and history of its making from report.json."""
    found = folders.read_nominal(folder)
    course, sent = record.read_course(folder / "report.json"), folders.read_transport(folder, found.scene)
    return DesignedLens(**vars(found), course=course, transport=sent)


def _name_of(cloud: Cloud, folder: Path) -> str:
    """Return the name of a cloud's subfolder of measured/: its file's name, numbered if another cloud has the name."""
    stem = re.sub(r"[^\w.-]", "_", cloud.path.stem).strip(".") or "cloud"
    for k in itertools.count(1):
        name = stem if k == 1 else f"{stem}-{k}"
        if not (path := folder / "measured" / name).exists():
            return name
        with contextlib.suppress(ValueError):  # raised if report.json is missing or damaged
            if (record.read(path / "report.json").measured or {}).get("sha256") == cloud.sha256:
                return name
    raise AssertionError("itertools.count ended")


# --- the report -------------------------------------------------------------------------------------------------------


def _contents(made: DesignedLens, proof: Proof, estimates: tuple[LeftOut, ...]) -> Contents:
    """Return the contents of report.json.  estimates: estimates of the neglected effects."""
    scene = made.scene
    alone, goal = scene.single_target_scenes()[proof.worst], made.goals[proof.worst]
    diagnosed, facts = diagnosis(alone, made.course, proof, goal.picture), circumstances(made.device)
    return contents_of(
        made, proof, course=made.course, circumstances=facts, simulated=[name for name, _ in simulated(scene)],
        estimates=estimates, diagnosis=diagnosed, making=making_of(scene.tolerance, proof.lens),
    )  # fmt: skip


def _left_out(made: DesignedLens, proof: Proof) -> tuple[LeftOut, ...]:
    return left_out(made.scene.single_target_scenes()[proof.worst], proof.lens, proof.light.picture)


def _order(made: DesignedLens, shape: Mapping[str, Any], folder: Path) -> Order:
    """Return the data for ordering the lens of a design in a folder.  shape: shape of the lens as in report.json."""
    scene, mount, path = made.scene, made.scene.mount, (folder / folders.PART).absolute()
    try:
        job = mount and path.is_file() and processes.submit(prescription.measured, path)
        found = processes.result(job, checks.time_limit(path)) if job else None
    except (BrokenExecutor, ValueError, processes.Overdue):  # the part is damaged, as its check states
        found = None
    stated = scene.part.of(scene.lens)
    return prescription.order_of(made.lens, shape, folder, stated=stated, mount=mount, found=found)


def _sheet(
    made: DesignedLens, proof: Proof | Contents, figures: Sequence[GoalFigures], irradiance: np.ndarray, *, order: Order
) -> DataSheet:
    """Return the data sheet of a design from its proof or report; irradiance: light on the first target."""
    light: dict[str, Any] = {"target": made.goals[0].picture, "irradiance": irradiance, "figures": figures}
    found: dict[str, Any] = {"shape": proof.shape, "passed": proof.passed, "version": bstcad.__version__}
    lumens, reflection = made.scene.source.luminous_flux, made.scene.loses_reflections
    found["photometry"] = (
        proof.photometry
        if isinstance(proof, Contents)
        else tuple(photometry(made.goals, proof, lumens, reflection=reflection))
    )
    return DataSheet(scene=made.scene, designed=made.lens, order=order, **light, **found)


def _write_report(
    made: DesignedLens, lens: Lens, contents: Contents, folder: Path, *, drawn: Pictures, options: ProofOptions,
    studied: str = "",
) -> None:  # fmt: skip
    """Write the report as JSON, HTML and JUnit XML, with prescription.txt and figures/.

    lens: lens as read from lens.step.  studied: HTML of the report's section on tolerances.
    """
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    pictures = drawn.result()
    for name, picture in pictures.items():
        if picture is not None:
            files.put(folder / "figures" / f"{name}.png", picture)
    prescribed = prescription.prescription(made.scene, made.lens.with_clear(lens.clear), contents.shape or {})
    page = report.html(
        contents,
        pictures,
        scene=scene_text(made.scene, made.lens),
        solid=rendering.turnable(as_cut(lens, made.scene.mount)),
        tolerances=studied,
        prescription=prescription.sections(prescribed),
        sections=[of_script(contents) for of_script in options.sections],
    )
    files.put(folder / "report.html", page)
    files.put(folder / "prescription.txt", prescription.text(prescribed).encode())
    files.put(folder / "report.junit.xml", report.junit(contents))
    record.write_json(contents, folder / "report.json")


def _write_sheet(drawn: Pictures, folder: Path) -> None:
    if (sheet := drawn.data_sheet()) is not None:
        files.put(folder / SHEET, sheet)


# --- a finished design ------------------------------------------------------------------------------------------------


def tolerance(
    folder: Path, settings: StudySettings, workers: int | None = None, scheduler: str | None = None
) -> Tolerances:
    """Study how accurately a lens must be made, mounted and lit; write tolerance.json and return its contents.

    workers: number of processes for the traces (None: only this one).  scheduler: address of a dask scheduler, whose
    workers trace instead.
    """
    from bstcad.manufacture.tolerance import tolerancing  # loaded late, since the other commands do not need it

    if (wanted := settings.wanted) is not None and not 0 < wanted < 1:
        raise SceneError(f"wanted: {wanted:g} is not between 0 and 1; give the fraction of lenses that must pass")
    with cluster.connect(scheduler, workers) as found:
        return tolerancing.tolerance(folder, settings if found is None else replace(settings, spread=found.spread))


def predict_as_made(
    scene: Scene, grade: str | None = None, layer_height: float | None = None, png: Path | None = None,
    size: Reduction = REFINED,
) -> AsMade:  # fmt: skip
    """Predict the pictures of a scene's lens as made by a grade of manufacture, from a reduced design.

    layer_height: height of the layers of a print (mm); None: that of the grade.  png: file of the pictures to write,
    one per target (FILE, FILE_2, …).  size: of the reduced design.
    """
    from bstcad.planning.preview import preview  # loaded late, since the other commands do not need it

    found = preview(scene, size)
    made = found.as_made(grade, layer_height)
    if png is not None:
        _draw_changed(png, found.scene, [(goal.target, goal.designed, goal.made) for goal in made.goals], "As made")
    return made


def predict_lit_by(
    scene: Scene, light: str, distance: float | None = None, png: Path | None = None, size: Reduction = REFINED
) -> LitBy:
    """Predict the pictures of a scene's lens in another light (tolerance.lit_by), from a reduced design.

    distance: from the light to the lens (mm); None: that of the light.  png, size: as for `predict_as_made`.
    """
    from bstcad.manufacture.tolerance.lit_by import scene_lit_by
    from bstcad.planning.preview import preview  # loaded late, as in predict_as_made

    scene_lit_by(scene, light, distance)  # an unknown light is refused before the preview
    found = preview(scene, size)
    lit = found.lit_by(light, distance)
    if png is not None:
        _draw_changed(png, found.scene, [(goal.target, goal.designed, goal.lit) for goal in lit.goals], "In this light")
    return lit


def _draw_changed(png: Path, scene: Scene, pictures: Iterable[tuple[Any, Any, Any]], changed: str) -> None:
    for k, (target, designed, other) in enumerate(pictures):
        figure = changed_picture(target, designed, other, view=View.of(scene, k), changed=changed)
        files.put(png.with_stem(numbered(png.stem, k)), rendered(figure))


def export(
    folder: Path, kinds: Sequence[str], points: int | None = None, cutting: Mapping[str, Any] = MappingProxyType({}),
    *, tiles: str | tuple[int, int] | None = None, place: Path | None = None,
) -> Exported:  # fmt: skip
    """Write files for a shop from the design in `folder`; kinds and points as in bstcad.exports.exports.export.

    cutting: settings of tool paths, by the names of the fields of bstcad.toolpath.cutting.Cutting.
    tiles: numbers of tiles along x and along y, such as "2x3" or (2, 3); None: 2x2.  Older tiles are removed.
    place: folder for the files, which is created if necessary; None: the design's folder.
    """
    into = folder if place is None else place
    if into.exists() and not into.is_dir():
        raise SceneError(f"export: {into} is a file; give another folder")
    with folders.amending(folder, into=into) as amended:
        made = read(folder)
        with scene_errors("export"):
            tiling = exports.DEFAULT_TILING if tiles is None else Tiling.parse(tiles)
            written = _export(made, kinds, amended, points=points, cutting=_cutting(cutting), tiling=tiling)
        if exports.SHEET in kinds:
            written.paths.append(amended / SHEET)
            files.put(written.paths[-1], data_sheet.draw(_sheet_again(made, folder)))
    if "tiles" in kinds:
        new = {path.name for path in written.paths}
        for old in (path for pattern in TILE_FILES for path in into.glob(pattern) if path.name not in new):
            old.unlink()
    return replace(written, paths=[into / path.name for path in written.paths])


def _cutting(settings: Mapping[str, Any]) -> Cutting:
    known = [field.name for field in fields(Cutting)]
    for name, value in settings.items():
        if name not in known:
            raise ValueError(f"'{name}' is no setting of a tool path; give {', '.join(known)}")
        if name not in CHOICES and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise ValueError(f"{name} = {value!r} is not a number; give it in mm (feed: mm/min)")
    return Cutting(**settings)


def _export_of_scene(made: DesignedLens, folder: Path) -> Exported:
    """Write the files of output.export that are possible for this lens; a remark of the report states the others."""
    return _export(made, made.scene.output.export, folder, strict=False)


def _refuse_exports(scene: Scene) -> None:
    """Raise SceneError if output.export asks for a tool path that can only fail after the design."""
    kinds, lens = scene.output.export, scene.lens
    for kind in (kind for kind in kinds if kind in files.PATHS):
        with scene_errors(f'output.export: "{kind}" is not possible'):
            flat = scene.flat_lens(lens.back.net)
            cells = exports.DEFAULT_TILING.cells(flat.plan) if "tiles" in kinds else ()
            refuse_hopeless(kind, flat, _cutting_of(scene, [kind]), lens.tailored_faces, cells=cells)


def _cutting_of(scene: Scene, kinds: Sequence[str], cutting: Cutting = DEFAULTS) -> Cutting:
    """Return the settings of tool paths, with the scene's tool and zero; ValueError if no tool has its radius."""
    if cutting.zero is None:
        cutting = replace(cutting, zero=scene.output.zero)
    if cutting.tool_radius is not None or scene.lens.mould or not set(kinds) & set(files.PATHS):
        return cutting
    return replace(cutting, tool_radius=scene.lens.tool_radius)  # the tool for which the faces were designed


def _export(
    made: DesignedLens, kinds: Sequence[str], folder: Path, *, points: int | None = None, cutting: Cutting = DEFAULTS,
    tiling: Tiling = exports.DEFAULT_TILING, strict: bool = True,
) -> Exported:  # fmt: skip
    scene, lens, cutting = made.scene, made.lens, _cutting_of(made.scene, kinds, cutting)
    light = GridLight(made.emitter.central, tuple(goal.screen for goal in made.goals))
    return exports.export(
        lens, kinds, folder, points=points, label=folders.label(scene), mount=scene.mount, light=light,
        far=made.far_field, cutting=cutting, moulding=scene.moulding, part=scene.part.of(scene.lens), tiling=tiling,
        strict=strict,
    )  # fmt: skip


def _sheet_again(made: DesignedLens, folder: Path) -> DataSheet:
    with scene_errors():
        known = record.read(folder / "report.json")
    if known.shape is None or not (folder / "lens.step").is_file():
        raise SceneError(f"{folder}: no lens.step, or no shape in report.json; run bstcad verify, or else generate")
    irradiances, order = folders.read_irradiances(folder, made.scene), _order(made, known.shape, folder)
    return _sheet(made, known, known.goals, irradiances[0], order=order)


def show(folder: Path, png: Path | None) -> None:
    """Draw a lens with rays and picture to the file `png`; None: in a window, and wait until the window is closed."""
    on_linux = sys.platform.startswith("linux")  # only on Linux the environment states whether there is a display
    if png is None and on_linux and not any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))):
        raise MachineError("this machine has no display for a window; give --png FILE to write a picture")
    path = light_path_in(folder)
    if png is None:
        if not rendering.draw(path, None):
            raise MachineError("no window could be opened; give --png FILE to write a picture")
        return
    with tempfile.TemporaryDirectory(prefix="bstcad-") as temporary:
        drawn = Path(temporary, "light.png")
        if not rendering.draw(path, drawn):
            raise MachineError("this machine cannot draw in three dimensions; it needs a display, EGL or OSMesa")
        files.put(png, drawn.read_bytes())


def light_path_in(folder: Path) -> RayPath:
    """Return the lens in a folder, rays through it, and its pictures; SceneError if no light reaches the target."""
    nominal = folders.read_nominal(folder)
    path = light_path_of(nominal, folders.read_irradiances(folder, nominal.scene))
    if path is None:
        raise SceneError(f"{folder}: no light reaches the target, so there is nothing to show; see report.html")
    return path
