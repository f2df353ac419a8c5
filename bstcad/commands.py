"""What the commands do: generate designs, writes and proves a lens; verify proves one again from its files."""

from __future__ import annotations

import contextlib
import itertools
import math
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import bstcad
from bstcad import files
from bstcad.contents import contents_of, with_part
from bstcad.judges import comparison
from bstcad.measured import cloud as clouds
from bstcad.measured import made_part
from bstcad.measured.cloud import Cloud
from bstcad.measured.deviation import map_files
from bstcad.measured.made_part import MadePart
from bstcad.optics.measure import FULL, Effort
from bstcad.pictures import Pictures, Unseen, drawn_or_none
from bstcad.pipeline import Saved, Tailored, design, purpose
from bstcad.report import data_sheet_page, junit, part, prescription, previous_report, report, solid_view, tolerances
from bstcad.report.data_sheet import Sheet
from bstcad.report.order import SHEET, Order, order_of
from bstcad.report.record import Contents, Examined, Judge, Making, Point, Stage, Twins
from bstcad.runs import checkpoint, lock, signals, worker
from bstcad.runs import folder as folders
from bstcad.runs.checkpoint import Keeper
from bstcad.runs.folder import Made
from bstcad.scene.errors import SceneError
from bstcad.scene.mount import as_cut
from bstcad.scene.scene import Scene
from bstcad.shop import export as shop
from bstcad.sweep.plan import left_out
from bstcad.tailoring.driver import never
from bstcad.tailoring.run import Progress, silent
from bstcad.verify import checks, text_checks
from bstcad.verify.checks import Nominal, Verification
from bstcad.verify.verdict import verdict

FIXED, PER_NET, PER_PICTURE = 4.0, 5.0, 3.0  # seconds; for 513 x 513 control points, for 512 x 512 pixels
BEHIND, LEAST = 2.0, 0.5  # seconds of a run with a time limit: what follows the last rays; the least that rays get


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
) -> dict[str, Any]:
    """Design a lens, write it to `folder` and prove it from the written files; the contents of report.json.

    began (time.perf_counter(), default now) is when the time of the report and of tailoring.max_time starts.
    While it designs it leaves a checkpoint beside the folder now and then, and goes on from there if asked to `resume`.
    Once `interrupted` says so, the best lens so far is written, never over an earlier design: see `place_for`.
    effort: of the proof; None: all that it may need.
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
        wished = found.stopped == "interrupt"  # then this is what was asked for
        place = place_for(folder, found.stopped)
        with _nothing_lost(keeper), contextlib.nullcontext() if wished else signals.an_interrupt_ends_it():
            contents, _ = write(
                made(found, began), place, progress=progress, effort=effort, limit=scene.tailoring.max_time
            )
        if wished:
            keeper.flush()
        else:
            keeper.remove()
    return contents.facts()


def place_for(folder: Path, stopped: str) -> Path:
    """Where a design goes: an unfinished one does not take the place of a finished one, but lies beside it."""
    if stopped != "interrupt" or not (folder / "report.json").exists():
        return folder
    if previous_report.making(folder / "report.json").stopped == "interrupt":
        return folder
    folder = folder.resolve()
    return folder.with_name(f"{folder.name}-unfinished")


def made(found: Tailored, began: float) -> Made:
    """A tailored lens with what its report tells of how it was found since `began`."""
    making = Making(
        seconds_total=found.earlier + time.perf_counter() - began,
        stages=tuple(Stage(**asdict(stage)) for stage in found.stages),
        history=tuple(Point(seconds, value) for seconds, value in found.history),
        transport=_transport(found),
        skipped_steps=found.skipped_steps,
        stopped=found.stopped,
        twins=None if found.precision is None else Twins(**asdict(found.precision)),
    )
    return Made(found.resolved, found.lens, found.target, making, found.device, found.transport)


def write(
    made: Made, folder: Path, *, progress: Progress = silent, effort: Effort | None = None, limit: float | None = None
) -> tuple[Contents, Verification]:
    """Write a design to `folder`, in the place of an earlier one, and prove it from the written files.

    limit: seconds that design and proof may take together; None: the proof takes its time.
    Returns the contents of report.json, and the proof.  Of a design that cannot be written or proved, whatever the
    reason, design.npz and the scene are kept in a folder beside, which the error's note names.
    """
    worker.begin()
    with (
        _kept(made, folder),
        _nothing_left_running(),
        Pictures(made.scene) as drawn,
        folders.replacing(folder) as building,
    ):
        with _beside() as beside:
            made, proof, order = _proved(made, building, drawn, progress, effort, beside, limit)
        proven = time.perf_counter()
        folders.write_design(made, proof.irradiance, building)
        shop.export(
            made.lens, made.scene.output.export, building, label=folders.label(made.scene), mount=made.scene.mount
        )
        progress("report", 0, 1, "")
        estimates = left_out(made.scene, proof.lens, proof.irradiance)  # while the pictures are drawn
        pictures = drawn.result()
        made = replace(made, making=made.making.followed_by(Stage("report", time.perf_counter() - proven)))
        contents = replace(contents_of(made, proof, estimates), order=order.facts())
        _write_report(contents, made, proof.lens, pictures, drawn.data_sheet(), building, progress)
    return contents, proof


@contextlib.contextmanager
def _kept(made: Made, folder: Path) -> Iterator[None]:
    """A design that cannot be written to `folder` is kept beside it; once it is written, what was kept of it goes."""
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
    """The same for a design that nobody keeps the files of: what report.json would hold, and the proof."""
    worker.begin()
    with _nothing_left_running(), tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        made, proof, _ = _proved(made, Path(place), Unseen(made.scene), progress, effort, folders.now)
    return contents_of(made, proof, left_out(made.scene, proof.lens, proof.irradiance)), proof


@contextlib.contextmanager
def _beside() -> Iterator[Callable[..., None]]:
    """Calls functions in a thread, and waits for them in the end; what one of them raised is raised there."""
    begun: list[Future] = []
    with ThreadPoolExecutor(1) as thread:

        def beside(work: Callable[..., Any], *arguments: Any) -> None:
            begun.append(thread.submit(work, *arguments))

        yield beside
        for future in begun:
            future.result()


def _proved(
    made: Made, place: Path, drawn: Pictures, progress: Progress, effort: Effort | None, beside: Callable[..., Any],
    limit: float | None = None,
) -> tuple[Made, Verification, Order]:  # fmt: skip
    """Write the geometry and verify it; the design with these two stages told, the proof, and what a shop is sent.

    beside: see folder.write_geometry.  limit: see `write`.
    """
    ends = [("design", time.perf_counter())]
    progress("write", 0, 1, "STEP, STL, 3MF")
    drawn.solid(made.lens)  # as designed, so that it can be drawn while OCC writes and reads the file
    try:
        folders.write_geometry(made, place, worker.submit, beside)
    except ValueError as error:  # the tailored faces bound no solid: nothing that a shop could open
        raise SceneError(f"{made.scene.name}: {error}") from error
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
    drawn.sheet(_sheet(made, proof, order))
    progress("verify", 1, 1, f"RRMSD {proof.rrmsd:.4f}")
    ends.append(("verify", time.perf_counter()))
    written, verified = (end - before for (_, before), (_, end) in zip(ends, ends[1:], strict=False))
    last = (Stage("write", written), Stage("verify", verified, proof.rrmsd))
    return replace(made, making=made.making.followed_by(*last)), proof, order


@contextlib.contextmanager
def _nothing_lost(keeper: Keeper, refused: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Whatever ends a design but its refusal, what it has found is on disk, and the error's note says how to go on."""
    try:
        yield
    except refused:
        keeper.withdraw()
        raise
    except BaseException as error:
        if said := keeper.kept():
            error.add_note(said)
        raise


def verify(
    path: Path, *, against: Sequence[str] = (), measured: Path | None = None, progress: Progress = silent,
    effort: Effort | None = None, place: Path | None = None,
) -> dict[str, Any]:  # fmt: skip
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
        return _verify_file(path)
    found = verify_folder(path, against=against, measured=measured, progress=progress, effort=effort, place=place)
    return found[0].facts()


def verify_folder(
    path: Path, *, against: Sequence[str] = (), measured: Path | None = None, progress: Progress = silent,
    effort: Effort | None = None, place: Path | None = None,
) -> tuple[Contents, Verification, MadePart | None]:  # fmt: skip
    """Prove the design of a folder again, and write its report anew; the contents of report.json, and the proof.

    The report of a made part that was measured goes to `place`, and the design's folder stays as it is; or into that
    folder, and also to its measured/CLOUD, which no later verification touches but one of the same cloud.
    """
    if place is not None and measured is None:
        raise SceneError(f"{place}: is for the report of a made part; give its measured points, too")
    with folders.amending(path) if place is None else folders.apart(path, place) as amended:
        return _verified(path, amended, against, measured, progress, effort, place is not None)


def _verified(
    path: Path, amended: Path, against: Sequence[str], measured: Path | None, progress: Progress,
    effort: Effort | None, apart: bool,
) -> tuple[Contents, Verification, MadePart | None]:  # fmt: skip
    """Prove the design in a folder; its new report goes to `amended`.  apart: that is the made part's alone."""
    made, nominal = _read(path)
    cloud = None if measured is None else _cloud(measured, nominal)
    progress("verify", 0, 1, "from the written files")
    with Pictures(made.scene) as drawn:
        try:
            proof = checks.verify(path, nominal, worker.submit, drawn.lens, effort=effort)
        except ValueError as error:
            raise SceneError(f"{path}: {error}") from error
        drawn.solid(proof.lens)
        drawn.light(made.target, proof)
        progress("verify", 1, 1, f"RRMSD {proof.rrmsd:.4f}")
        judged = comparison.against(
            against, proof.lens, nominal.channels, nominal.screen, nominal.target, nominal.seed, progress
        )
        drawn.judges(judged)
        proof = replace(proof, checks=(*proof.checks, *(check for one in judged for check in one.checks)))
        order = _order(made, proof.shape, path)
        if not apart:
            drawn.sheet(_sheet(made, proof, order))
        contents = contents_of(made, proof, left_out(made.scene, proof.lens, proof.irradiance))
        contents = replace(contents, order=order.facts(), judges=tuple(Judge(**one.facts) for one in judged))
        part = None if cloud is None else _judged(cloud, proof, nominal, effort, progress)
        if part is not None:
            drawn.part(part, proof)
        pictures, studied = drawn.result(), tolerances.of_folder(path, made.optic)
        if part is not None:
            own = Path() if apart else Path("measured") / _name_of(cloud, path)
            (amended / own).mkdir(parents=True, exist_ok=True)
            for name, data in map_files(part.deviation).items():
                files.put(amended / own / name, data)
            alone, contents = (
                with_part(contents, part),
                with_part(contents, part, "" if apart else f"{own.as_posix()}/"),
            )
            _write_report(alone, made, proof.lens, pictures, None, amended / own, progress, studied)
        if not apart:
            _write_report(contents, made, proof.lens, pictures, drawn.data_sheet(), amended, progress, studied)
    return contents, proof, part


def _name_of(cloud: Cloud, folder: Path) -> str:
    """The folder in measured/ of a design for a cloud: by its file's name, but never that of another cloud."""
    stem = re.sub(r"[^\w.-]", "_", cloud.path.stem).strip(".") or "cloud"
    for k in itertools.count(1):
        name = stem if k == 1 else f"{stem}-{k}"
        if not (place := folder / "measured" / name).exists():
            return name
        known = previous_report.contents(place / "report.json")
        if known is not None and known.measured and known.measured.get("sha256") == cloud.sha256:
            return name
    raise AssertionError("there is a number for every cloud")


def _cloud(measured: Path, nominal: Nominal) -> Cloud:
    """The cloud of a made part, read before anything that takes time."""
    try:
        return clouds.load(measured, nominal.lens.apertures[1])
    except ValueError as error:
        raise SceneError(error) from error


def _judged(cloud: Cloud, proof: Verification, nominal: Nominal, effort: Effort | None, progress: Progress) -> MadePart:
    """The made part that was measured as `cloud`."""
    progress("made part", 0, 1, "from its cloud")
    try:
        found = made_part.judge(cloud, proof.lens, nominal, effort)
    except ValueError as error:
        raise SceneError(error) from error
    progress("made part", 1, 1, "")
    return found


def export(folder: Path, kinds: Sequence[str], points: int | None = None) -> list[Path]:
    """Write files for the shop into a design's folder, see bstcad.shop.export; their paths."""
    with folders.amending(folder) as amended:
        made = read(folder)
        try:
            written = shop.export(made.lens, kinds, amended, points, folders.label(made.scene), made.scene.mount)
        except ValueError as error:
            raise SceneError(f"export: {error}") from error
        if shop.SHEET in kinds:
            written.append(amended / SHEET)
            files.put(written[-1], data_sheet_page.draw(_sheet_again(made, folder)))
    return [folder / path.name for path in written]


def _sheet_again(made: Made, folder: Path) -> Sheet:
    """The data sheet of a finished design, by what its report says of it."""
    known = previous_report.contents(folder / "report.json")
    if known is None or known.shape is None or not (folder / "lens.step").is_file():
        raise SceneError(f"{folder}: its report or lens.step is gone or damaged; bstcad verify, or generate, writes it")
    return Sheet(
        scene=made.scene, designed=made.lens, shape=known.shape, order=_order(made, known.shape, folder),
        target=made.target, irradiance=folders.read_irradiance(folder, made.scene), rrmsd=known.rrmsd,
        light_on_target=known.light_on_target, passed=known.passed, version=bstcad.__version__,
    )  # fmt: skip


def _sheet(made: Made, proof: Verification, order: Order) -> Sheet:
    """The data sheet of a design that was just proved."""
    return Sheet(
        scene=made.scene, designed=made.lens, shape=proof.shape, order=order, target=made.target,
        irradiance=proof.irradiance, rrmsd=proof.rrmsd, light_on_target=proof.flux["on target"], passed=proof.passed,
        version=bstcad.__version__,
    )  # fmt: skip


def _order(made: Made, shape: Mapping[str, Any], folder: Path) -> Order:
    """What a shop is sent of the design in a folder; shape: as report.json has it."""
    mount, path = made.scene.mount, (folder / folders.PART).absolute()
    try:
        found = worker.submit("bstcad.report.order.measured", path).result() if mount and path.is_file() else None
    except (BrokenExecutor, ValueError):  # a damaged part, which a check tells: the lens is sent
        found = None
    return order_of(made.scene, made.lens, shape, folder, found)


def read(folder: Path) -> Made:
    """The design in a folder, and what its report tells of how it was made."""
    return _read(folder)[0]


def _read(folder: Path) -> tuple[Made, Nominal]:
    scene, nominal = folders.read_nominal(folder)
    making, sent = previous_report.making(folder / "report.json"), folders.read_transport(folder, scene)
    return Made(scene, nominal.lens, nominal.target, making, transport=sent), nominal


def _verify_file(path: Path) -> dict[str, Any]:
    """One STEP file by itself: what it is, not what it was meant to be."""
    try:
        found, lens, whole = checks.examine(path, worker.submit)
    except ValueError as error:
        raise SceneError(f"{path}: {error}") from error
    passed, stated = all(c.passed for c in found), [c.value for c in found if c.name == text_checks.DENSITY]
    told = part.part(lens, whole, stated[0] if len(stated) == 1 else None)
    return Examined(path.stem, str(path), verdict(passed, ()), passed, tuple(found), told).facts()


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


def _transport(found: Tailored) -> dict[str, Any]:
    solved = found.mapping.transport
    return {
        "grid": found.mapping.source.n,
        "iterations": solved.iterations,
        "mass_error": solved.mass_error[-1],
        "stopped": solved.reason,
    }


def _write_report(contents, made, lens, pictures, sheet, folder, progress, studied="") -> None:
    """The report as JSON, HTML and JUnit's XML, prescription.txt, datasheet.pdf and figures/.

    lens: as it was read back; sheet: the PDF; studied: the page's section on tolerances.
    """
    pictures = drawn_or_none(worker.submit("bstcad.report.figures.draw_numbers", contents)) | pictures
    place = files.folder_in_place(folder / "figures")
    for name, picture in pictures.items():
        if picture is not None:
            files.put(place / f"{name}.png", picture)
    written = prescription.prescription(made.scene, replace(made.lens, clear=lens.clear), contents.shape)
    scene = prescription.scene_text(made.scene, made.lens)
    written_out = prescription.sections(written)
    solid = solid_view.solid(as_cut(lens, made.scene.mount))
    report.write_html(contents, pictures, folder / "report.html", scene, written_out, solid, studied)
    if sheet is not None:
        files.put(folder / SHEET, sheet)
    files.put(folder / "prescription.txt", prescription.text(written).encode())
    files.put(folder / "report.junit.xml", junit.junit(contents))
    report.write_json(contents, folder / "report.json")
    progress("report", 1, 1, "")
