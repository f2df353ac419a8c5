"""The work of the commands: `generate` designs, writes and proves a lens; `verify` proves it again from its files."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import bstcad
from bstcad import files
from bstcad.judges import comparison
from bstcad.measured import cloud as clouds
from bstcad.measured import made_part
from bstcad.measured.cloud import Cloud
from bstcad.measured.deviation import map_files
from bstcad.measured.made_part import MadePart
from bstcad.optics.lens import Lens
from bstcad.optics.measure import FULL, Effort
from bstcad.pipeline import Saved, Tailored, design, purpose
from bstcad.report import data_sheet, exports, prescription, record, rendering, report, tolerances
from bstcad.report.assemble import contents_of, with_part
from bstcad.report.data_sheet import Sheet
from bstcad.report.figure_jobs import NoPictures, Pictures, light_path_of
from bstcad.report.prescription import SHEET, Order
from bstcad.report.record import Contents, Examined, Judge, Making, Point, PrecisionTest, Stage
from bstcad.report.rendering import LightPath
from bstcad.runs import checkpoint, lock, signals, worker
from bstcad.runs import folder as folders
from bstcad.runs.checkpoint import Keeper
from bstcad.runs.environment import circumstances
from bstcad.runs.folder import Made
from bstcad.scene.errors import MachineError, SceneError
from bstcad.scene.mount import as_cut
from bstcad.scene.scene import Scene
from bstcad.sweep.diagnosis import diagnosis, of_bounds
from bstcad.sweep.plan import left_out
from bstcad.tailoring.driver import never
from bstcad.tailoring.run import Progress, silent
from bstcad.verify import checks, text_checks
from bstcad.verify.checks import Nominal, Verification
from bstcad.verify.verdict import verdict

FIXED, PER_NET, PER_PICTURE = 4.0, 5.0, 3.0  # seconds; for 513 x 513 control points, for 512 x 512 pixels
BEHIND, LEAST = 2.0, 0.5  # seconds of a run with a time limit: behind the last rays; at least for rays

Drawing = Callable[..., Pictures]  # from (scene, submit): NoPictures for a folder without figures


def generate(
    scene: Scene,
    folder: Path,
    *,
    device: str = "auto",
    progress: Progress = silent,
    began: float | None = None,
    resume: bool = False,
    interrupted: Callable[[], bool] = never,
    effort: Effort | None = None,
    drawing: Drawing | None = None,
) -> Contents:
    """Design a lens, write it to `folder` and prove it from the written files; the contents of report.json.

    began (time.perf_counter(), default now) is when the time of the report and of tailoring.max_time starts.
    While it designs it leaves a checkpoint beside the folder now and then, and goes on from there if asked to `resume`.
    Once `interrupted` says so, the best lens so far is written, never over an earlier design: see `place_for`.
    effort: of the proof; None: all that it may need.  drawing: of its figures; None: Pictures.
    """
    began = time.perf_counter() if began is None else began
    worker.begin()
    folder.parent.mkdir(parents=True, exist_ok=True)
    folders.tidy(folder)
    keeper = Keeper(
        checkpoint.path_for(folder), purpose(scene, device), lambda text: progress("checkpoint", 0, 0, text), kind=Saved
    )
    state = keeper.found() if resume else None
    with lock.held(folder):
        with _nothing_lost(keeper, refused=(SceneError,)):  # it would be refused again
            found = design(
                scene, device=device, progress=progress, began=began, reserve=reserve(scene),
                save=keeper, start=state, interrupted=interrupted,
            )  # fmt: skip
        wished = found.stopped == "interrupt"  # then the user asked for the best so far
        place = place_for(folder, found.stopped)
        with _nothing_lost(keeper), contextlib.nullcontext() if wished else signals.an_interrupt_ends_it():
            contents, _ = write(
                made(found, began), place, progress=progress, effort=effort, limit=scene.tailoring.max_time,
                drawing=drawing,
            )  # fmt: skip
        if wished:
            keeper.flush()
        else:
            keeper.remove()
    return contents


def place_for(folder: Path, stopped: str) -> Path:
    """The folder of a design: an unfinished design goes beside a finished one, never in its place."""
    if stopped != "interrupt" or not (folder / "report.json").exists():
        return folder
    if record.making(folder / "report.json").stopped == "interrupt":
        return folder
    folder = folder.resolve()
    return folder.with_name(f"{folder.name}-unfinished")


def made(found: Tailored, began: float) -> Made:
    """A tailored lens with the record of its tailoring since `began`."""
    solved = found.mapping.transport
    making = Making(
        seconds_total=found.earlier + time.perf_counter() - began,
        stages=tuple(Stage(**asdict(stage)) for stage in found.stages),
        history=tuple(Point(seconds, value) for seconds, value in found.history),
        transport={
            "grid": found.mapping.source.n,
            "iterations": solved.iterations,
            "mass_error": solved.mass_error[-1],
            "stopped": solved.reason,
        },  # fmt: skip
        skipped_steps=found.skipped_steps,
        stopped=found.stopped,
        twins=None if found.precision is None else PrecisionTest(**asdict(found.precision)),
    )
    return Made(found.resolved, found.lens, found.target, making=making, device=found.device, transport=found.transport)


def write(
    made: Made, folder: Path, *, progress: Progress = silent, effort: Effort | None = None, limit: float | None = None,
    drawing: Drawing | None = None,
) -> tuple[Contents, Verification]:  # fmt: skip
    """Write a design to `folder`, in the place of an earlier one, and prove it from the written files.

    limit: seconds that design and proof may take together; None: the proof takes its time.
    Returns the contents of report.json, and the proof.  Of a design that cannot be written or proved, whatever the
    reason, design.npz and the scene are kept in a folder beside, which the error's note names.
    """
    worker.begin()
    with (
        _kept(made, folder),
        _nothing_left_running(),
        (drawing or Pictures)(made.scene, worker.submit) as drawn,
        folders.replacing(folder) as building,
    ):
        with _beside() as beside:
            made, proof, order = _proved(
                made, building, drawn, progress=progress, effort=effort, beside=beside, limit=limit
            )
        proven = time.perf_counter()
        folders.write_design(made, proof.irradiance, building)
        exports.export(
            made.lens, made.scene.output.export, building, label=folders.label(made.scene), mount=made.scene.mount
        )
        progress("report", 0, 1, "")
        estimates = left_out(made.scene, proof.lens, proof.irradiance)  # while the pictures are drawn
        drawn.result()
        made = replace(made, making=made.making.followed_by(Stage("report", time.perf_counter() - proven)))
        contents = replace(_contents(made, proof, estimates), order=order)
        drawn.numbers(contents)
        pages = _pages(made, proof.lens, contents)
        _write_report(contents, building, pages=pages, pictures=drawn.result(), sheet=drawn.data_sheet())
        progress("report", 1, 1, "")
    return contents, proof


@contextlib.contextmanager
def _kept(made: Made, folder: Path) -> Iterator[None]:
    """A design that cannot be written to `folder` is kept beside it, until it is written."""
    try:
        yield
    except Exception as error:
        with contextlib.suppress(OSError, MemoryError):  # no room anywhere: the error itself matters more
            error.add_note(
                f"the finished design is kept in {folders.keep(made, folder)}, which bstcad.open and bstcad export read"
            )
        raise
    folders.forget_kept(made, folder)


def prove(made: Made, *, progress: Progress = silent, effort: Effort | None = None) -> tuple[Contents, Verification]:
    """Prove a design by temporary files: the contents of its report.json, and the proof."""
    worker.begin()
    with _nothing_left_running(), tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        drawn = NoPictures(made.scene, worker.submit)
        made, proof, _ = _proved(made, Path(place), drawn, progress=progress, effort=effort)
    return _contents(made, proof, left_out(made.scene, proof.lens, proof.irradiance)), proof


@contextlib.contextmanager
def _beside() -> Iterator[Callable[..., None]]:
    """A function that calls others in a thread; the block ends with all of them, and raises their errors."""
    begun: list[Future] = []
    with ThreadPoolExecutor(1) as thread:

        def beside(work: Callable[..., Any], *arguments: Any) -> None:
            begun.append(thread.submit(work, *arguments))

        yield beside
        for future in begun:
            future.result()


def _contents(made: Made, proof: Verification, estimates: tuple[record.LeftOut, ...]) -> Contents:
    """The contents of report.json; estimates: of the effects that are left out."""
    scene, blurred = made.scene, proof.blur.rrmsd if proof.blur else 0.0
    diagnosed = diagnosis(
        scene, made.making, proof.lens, picture=proof.irradiance, target=made.target, rrmsd=proof.rrmsd,
        efficiency=proof.efficiency, blurred=blurred,
    )  # fmt: skip
    return contents_of(
        scene, made.lens, made.target, proof, making=made.making, circumstances=circumstances(made.device),
        estimates=estimates, diagnosis=vars(diagnosed) | {"bounds": of_bounds(scene, made.making, proof.at_bounds)},
    )  # fmt: skip


def _proved(
    made: Made, place: Path, drawn: Pictures, *, progress: Progress, effort: Effort | None,
    beside: Callable[..., Any] = folders.now, limit: float | None = None,
) -> tuple[Made, Verification, Order]:  # fmt: skip
    """Write the geometry and verify it; the design with these two stages, its proof, and the order for a shop.

    beside: see folder.write_geometry.  limit: see `write`.
    """
    ends = [("design", time.perf_counter())]
    progress("write", 0, 1, "STEP, STL, 3MF")
    drawn.solid(made.lens)  # as designed, so that it can be drawn while OCC writes and reads the file
    with refusals(f"{made.scene.name}: "):  # the tailored faces bound no solid: nothing that a shop could open
        folders.write_geometry(made, place, worker.submit, beside)
    progress("write", 1, 1, "")
    ends.append(("write", time.perf_counter()))
    progress("verify", 0, 1, "from the written files")
    if limit is not None:
        effort, left = effort or FULL, limit - BEHIND - made.making.seconds_total - (ends[1][1] - ends[0][1])
        effort = replace(effort, seconds=min(effort.seconds, max(left, LEAST)))
    proof = checks.verify(
        place, folders.nominal(made.scene, made.lens, made.target), worker.submit, drawn.lens, effort=effort
    )
    order = _order(made, proof.shape, place)
    drawn.light(made.target, proof)
    drawn.sheet(_sheet(made, proof, proof.irradiance, order))
    progress("verify", 1, 1, f"RRMSD {proof.rrmsd:.4f}")
    ends.append(("verify", time.perf_counter()))
    written, verified = (end - before for (_, before), (_, end) in zip(ends, ends[1:], strict=False))
    last = (Stage("write", written), Stage("verify", verified, proof.rrmsd))
    return replace(made, making=made.making.followed_by(*last)), proof, order


@contextlib.contextmanager
def _nothing_lost(keeper: Keeper, refused: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Whatever ends a design but its refusal, its state is on disk, and the error's note says how to go on."""
    try:
        yield
    except refused:
        keeper.withdraw()
        raise
    except BaseException as error:
        if note := keeper.kept():
            error.add_note(note)
        raise


def verify(
    path: Path, *, against: Sequence[str] = (), measured: Path | None = None, progress: Progress = silent,
    effort: Effort | None = None, place: Path | None = None, drawing: Drawing | None = None,
) -> Contents | Examined:  # fmt: skip
    """Prove a design again from the files of its folder, and write its report anew; or look at one STEP file alone.

    against: programs not written here that are to trace it too, by their names (judges.comparison.JUDGES).
    measured: a cloud of points of a made part, which is then judged too.  place: a folder for the report of that part,
    instead of the design's own.
    """
    against = comparison.chosen(against)
    if path.is_file() and against:
        raise SceneError(f"{path}: a STEP file alone says nothing of the light; give --against a design's folder")
    if path.is_file() and measured is not None:
        raise SceneError(f"{path}: a STEP file alone says no light to judge a made part by; give the design's folder")
    if path.is_file():
        return examine(path)
    return verify_folder(
        path, against=against, measured=measured, progress=progress, effort=effort, place=place, drawing=drawing
    )[0]


def verify_folder(
    path: Path, *, against: Sequence[str] = (), measured: Path | None = None, progress: Progress = silent,
    effort: Effort | None = None, place: Path | None = None, drawing: Drawing | None = None,
) -> tuple[Contents, Verification, MadePart | None]:  # fmt: skip
    """Prove the design of a folder again, and write its report anew; the contents of report.json, and the proof.

    The report of a made part that was measured goes to `place`, and the design's folder stays as it is; or into that
    folder, and also to its measured/CLOUD, which no later verification touches but one of the same cloud.
    """
    if place is not None and measured is None:
        raise SceneError(f"{place}: is for the report of a made part; give its measured points, too")
    with folders.amending(path) if place is None else folders.apart(path, place) as amended:
        made, nominal = _read(path)
        cloud = None if measured is None else _cloud(measured, nominal)
        with (drawing or Pictures)(made.scene, worker.submit) as drawn:
            proof = _proof_of(path, nominal, drawn, effort=effort, progress=progress)
            drawn.solid(proof.lens)
            drawn.light(made.target, proof)
            judged = comparison.against(
                against,
                proof.lens,
                nominal.channels,
                nominal.screen,
                target=nominal.target,
                seed=nominal.seed,
                progress=progress,
            )
            drawn.judges(judged)
            proof = replace(proof, checks=(*proof.checks, *(check for judge in judged for check in judge.checks)))
            order = _order(made, proof.shape, path)
            if place is None:
                drawn.sheet(_sheet(made, proof, proof.irradiance, order))
            contents = _contents(made, proof, left_out(made.scene, proof.lens, proof.irradiance))
            contents = replace(contents, order=order, judges=tuple(Judge(**judge.facts) for judge in judged))
            drawn.numbers(contents)
            part = None if cloud is None else _judged(cloud, proof, nominal, effort=effort, progress=progress)
            if part is not None:
                drawn.part(part, proof)
            pages = _pages(made, proof.lens, contents, studied=tolerances.of_folder(path, made.optic))
            if part is not None:
                own = Path() if place is not None else Path("measured") / _name_of(cloud, path)
                (amended / own).mkdir(parents=True, exist_ok=True)
                for name, data in map_files(part.deviation).items():
                    files.put(amended / own / name, data)
                _write_report(with_part(contents, part), amended / own, pages=pages, pictures=drawn.result())
                contents = with_part(contents, part, "" if place is not None else f"{own.as_posix()}/")
            if place is None:
                _write_report(contents, amended, pages=pages, pictures=drawn.result(), sheet=drawn.data_sheet())
            progress("report", 1, 1, "")
    return contents, proof, part


def _proof_of(
    path: Path, nominal: Nominal, drawn: Pictures, *, effort: Effort | None, progress: Progress
) -> Verification:
    """The proof of the files in a folder."""
    progress("verify", 0, 1, "from the written files")
    with refusals(f"{path}: "):
        proof = checks.verify(path, nominal, worker.submit, drawn.lens, effort=effort)
    progress("verify", 1, 1, f"RRMSD {proof.rrmsd:.4f}")
    return proof


def _name_of(cloud: Cloud, folder: Path) -> str:
    """The folder in measured/ of a design for a cloud: by its file's name, but never that of another cloud."""
    stem = re.sub(r"[^\w.-]", "_", cloud.path.stem).strip(".") or "cloud"
    for k in itertools.count(1):
        name = stem if k == 1 else f"{stem}-{k}"
        if not (place := folder / "measured" / name).exists():
            return name
        with contextlib.suppress(ValueError):  # of a report that is gone or damaged
            if (record.read(place / "report.json").measured or {}).get("sha256") == cloud.sha256:
                return name
    raise AssertionError("there is a number for every cloud")


def _cloud(measured: Path, nominal: Nominal) -> Cloud:
    """The cloud of a made part, read before anything that takes time."""
    with refusals():
        return clouds.load(measured, nominal.lens.apertures[1])


def _judged(
    cloud: Cloud, proof: Verification, nominal: Nominal, *, effort: Effort | None, progress: Progress
) -> MadePart:
    """The made part that was measured as `cloud`."""
    progress("made part", 0, 1, "from its cloud")
    with refusals():
        found = made_part.judge(cloud, proof.lens, nominal, effort)
    progress("made part", 1, 1, "")
    return found


def export(folder: Path, kinds: Sequence[str], points: int | None = None) -> list[Path]:
    """Write files for the shop into a design's folder, see bstcad.report.exports; their paths."""
    with folders.amending(folder) as amended:
        made = read(folder)
        with refusals("export: "):
            written = exports.export(
                made.lens, kinds, amended, points, label=folders.label(made.scene), mount=made.scene.mount
            )
        if exports.SHEET in kinds:
            written.append(amended / SHEET)
            files.put(written[-1], data_sheet.draw(_sheet_again(made, folder)))
    return [folder / path.name for path in written]


def _sheet_again(made: Made, folder: Path) -> Sheet:
    """The data sheet of a finished design, by its report."""
    with refusals():
        known = record.read(folder / "report.json")
    if known.shape is None or not (folder / "lens.step").is_file():
        raise SceneError(f"{folder}: its report or lens.step is gone or damaged; bstcad verify, or generate, writes it")
    return _sheet(made, known, folders.read_irradiance(folder, made.scene), _order(made, known.shape, folder))


def _sheet(made: Made, worth: Verification | Contents, irradiance: np.ndarray, order: Order) -> Sheet:
    """The data sheet of a design."""
    return Sheet(
        scene=made.scene, designed=made.lens, shape=worth.shape, order=order, target=made.target, irradiance=irradiance,
        rrmsd=worth.rrmsd, light_on_target=worth.flux["on target"], passed=worth.passed, version=bstcad.__version__,
    )  # fmt: skip


def _order(made: Made, shape: Mapping[str, Any], folder: Path) -> Order:
    """The order for a shop of the design in a folder; shape: as report.json has it."""
    mount, path = made.scene.mount, (folder / folders.PART).absolute()
    try:
        found = worker.submit(prescription.measured, path).result() if mount and path.is_file() else None
    except (BrokenExecutor, ValueError):  # a damaged part, which a check tells: the lens is sent
        found = None
    return prescription.order_of(made.scene, made.lens, shape, folder, found=found)


def read(folder: Path) -> Made:
    """The design in a folder, with its making from report.json."""
    return _read(folder)[0]


def _read(folder: Path) -> tuple[Made, Nominal]:
    scene, nominal = folders.read_nominal(folder)
    making, sent = record.making(folder / "report.json"), folders.read_transport(folder, scene)
    return Made(scene, nominal.lens, nominal.target, making, transport=sent), nominal


def examine(path: Path) -> Examined:
    """Look at one STEP file by itself: its checks and its part, whatever it was designed for."""
    with refusals(f"{path}: "):
        found, lens, whole = checks.examine(path, worker.submit)
    passed, stated = all(c.passed for c in found), [c.value for c in found if c.name == text_checks.DENSITY]
    rows = prescription.part(lens, whole, stated[0] if len(stated) == 1 else None)
    return Examined(
        name=path.stem, title=str(path), verdict=verdict(passed, ()), passed=passed, checks=tuple(found), part=rows
    )


@contextlib.contextmanager
def refusals(where: str = "") -> Iterator[None]:
    """A ValueError in the block refuses the input: SceneError, its sentence behind `where`."""
    try:
        yield
    except ValueError as error:
        raise SceneError(f"{where}{error}") from error


@contextlib.contextmanager
def _nothing_left_running() -> Iterator[None]:
    """After an error the second process may still be writing into a folder that is about to go."""
    try:
        yield
    except BaseException:
        worker.end()
        raise


def reserve(scene: Scene) -> float:
    """Seconds that writing, proving and reporting will take, from runs on two cores."""
    pixels, net = math.prod(scene.target.columns_rows) / 512**2, (scene.lens.back.control_points / 513) ** 2
    return FIXED + PER_NET * net + PER_PICTURE * pixels


@dataclass(frozen=True)
class _Pages:
    """The parts of a report that are the same for the design and for a made part of it."""

    prescription: dict[str, Any]
    scene: str  # the resolved TOML text
    solid: str  # the lens of the 3-D view
    studied: str  # the page's section on tolerances


def _pages(made: Made, lens: Lens, contents: Contents, studied: str = "") -> _Pages:
    """lens: as it was read back."""
    return _Pages(
        prescription=prescription.prescription(made.scene, replace(made.lens, clear=lens.clear), contents.shape),
        scene=prescription.scene_text(made.scene, made.lens),
        solid=rendering.turnable(as_cut(lens, made.scene.mount)),
        studied=studied,
    )


def _write_report(
    contents: Contents, folder: Path, *, pages: _Pages, pictures: Mapping[str, bytes | None], sheet: bytes | None = None
) -> None:
    """The report as JSON, HTML and JUnit's XML, prescription.txt, datasheet.pdf and figures/; sheet: the PDF."""
    place = files.folder_in_place(folder / "figures")
    for name, picture in pictures.items():
        if picture is not None:
            files.put(place / f"{name}.png", picture)
    report.write_html(
        contents, pictures, folder / "report.html", scene=pages.scene, solid=pages.solid, tolerances=pages.studied,
        prescription=prescription.sections(pages.prescription),
    )  # fmt: skip
    if sheet is not None:
        files.put(folder / SHEET, sheet)
    files.put(folder / "prescription.txt", prescription.text(pages.prescription).encode())
    files.put(folder / "report.junit.xml", report.junit(contents))
    record.write_json(contents, folder / "report.json")


def show(folder: Path, png: Path | None) -> None:
    """Write the picture of a design at work to `png`, or open a window with it and wait until it is closed."""
    if png is None and not _has_display():
        raise MachineError("this machine has no display to open a window on; give --png FILE for a picture")
    path = light_path_in(folder)
    if png is None:
        if not rendering.draw(path, None):
            raise MachineError("no window could be opened here; give --png FILE for a picture")
        return
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        drawn = Path(place, "light.png")
        if not rendering.draw(path, drawn):
            raise MachineError("this machine cannot draw in three dimensions: it has no display, EGL or OSMesa")
        files.put(png, drawn.read_bytes())


def light_path_in(folder: Path) -> LightPath:
    """The lens of a folder, rays through it and their picture; SceneError if no light arrives."""
    scene, nominal = folders.read_nominal(folder)
    found = light_path_of(scene, nominal.lens, nominal.target, folders.read_irradiance(folder, scene))
    if found is None:
        raise SceneError(f"{folder}: no light of this design arrives at the target; there is nothing to show")
    return found


def _has_display() -> bool:
    """Linux says by its environment whether there is one; elsewhere there is."""
    return not sys.platform.startswith("linux") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
