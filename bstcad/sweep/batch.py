"""bstcad batch: designs many scenes, each in a process of its own into its own folder, and goes on when one fails.

A design counts as finished if batch.json has it, of the same scene and the same version of bstcad, and its folder still
holds it.  A design that was under way when its batch was stopped goes on from its checkpoint, if it was made on this
machine.  batch.json has the entries of Batch; batch.csv has a line a design, its columns are COLUMNS.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

import bstcad
from bstcad import folder as folders
from bstcad.pipeline import DesignState, purpose
from bstcad.report.report import check_lines
from bstcad.runs import environment, files, processes
from bstcad.runs.checkpoint import Keeper
from bstcad.runs.cluster import Answer, Cluster, Machines
from bstcad.runs.processes import ExitStatus
from bstcad.runs.progress import ProgressFunction
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene, load
from bstcad.sweep import cold_run
from bstcad.sweep.cold_run import LocalPool, Stored, unpacked
from bstcad.sweep.net_choice import with_net
from bstcad.sweep.prediction import WITHIN, memory_gb
from bstcad.verify.verdict import NO_LIMIT, VERDICTS, Check

if TYPE_CHECKING:
    from rich.console import Group

REFUSED, BROKEN, STOPPED = "refused", "broken", "not done"
COLUMNS = (
    "scene", "name", "status", "rrmsd", "rrmsd_noise", "leak", "light_on_target", "checks_failed", "seconds", "report",
    "where", "reason",
)  # fmt: skip
STYLES = {"passed": "green", "passed with remarks": "yellow", NO_LIMIT: "cyan"}  # terminal colours; others are red
KILLED = -9  # exit code of a process that somebody, or the system for want of memory, has killed
CORES = 2  # that a design keeps busy


class Row(Stored):
    """How a design went."""

    scene: str  # the file, as the user named it
    name: str = ""  # of the scene and of the design's folder
    status: str = STOPPED  # its verdict (verify.verdict.VERDICTS), REFUSED, BROKEN or STOPPED
    rrmsd: float | None = None  # of the report; this and the next three: of several targets on the worst
    rrmsd_noise: float | None = None  # its standard error
    leak: float | None = None  # share of the light on the target that falls where the target is dark
    light_on_target: float | None = None  # share of the light of the source
    checks_failed: tuple[str, ...] = ()  # by name
    seconds: float = 0.0  # to the verified lens
    report: str = ""  # report.html, from the batch's folder
    where: str = ""  # "here", or the address of a worker
    reason: str = ""  # why there is no lens, in a sentence
    key: str = ""  # hash of the scene with its pictures, and version of bstcad
    design: str = ""  # SHA-256 of design.npz

    @property
    def finished(self) -> bool:
        """Is there a lens?"""
        return self.status in VERDICTS

    def changed(self, **entries: Any) -> Row:
        """The row with other entries."""
        return self.model_copy(update=entries)


class Batch(Stored):
    """batch.json."""

    version: str  # of bstcad
    designs: tuple[Row, ...]  # of the last batch, in the order of its scenes, then finished ones of earlier batches


@dataclass(frozen=True)
class Wanted:
    """A scene file, and its scene, or why it holds none."""

    path: str
    scene: Scene | None
    reason: str = ""


# --- one design, in a process of its own ------------------------------------------------------------------------------


def design(
    contents: Mapping[str, bytes], folder: Path, variables: Mapping[str, str], tick: Callable[[], None] = lambda: None
) -> ExitStatus:
    """Design a scene into a folder, from the checkpoint of this very design beside it, if there is any.

    contents: the scene and its pictures, by file name.  variables: of the environment.  A process that was killed is
    begun once more.
    """
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        scene = unpacked(contents, Path(place))
        command = ["generate", str(scene), "-o", str(folder)]
        resume = ["--resume"] if _has_checkpoint(load(scene), folder) else []
        first = processes.run([*command, *resume], tick=tick, environment=variables)
        if first.code != KILLED:
            return first
        again = processes.run([*command, "--resume"], tick=tick, environment=variables)
    return replace(again, seconds=first.seconds + again.seconds, cpu_seconds=first.cpu_seconds + again.cpu_seconds)


def _has_checkpoint(scene: Scene, folder: Path) -> bool:
    keeper = Keeper(files.beside(folder, "checkpoint"), purpose(scene, "auto"), kind=DesignState)
    try:
        return keeper.load() is not None
    except SceneError:
        return False


def design_elsewhere(contents: Mapping[str, bytes]) -> tuple[ExitStatus, dict[str, bytes]]:
    """On a worker: how the design went, and the files of its folder by their paths in it."""
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        folder = Path(place) / "design"
        ended = design(contents, folder, {})
        paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        return ended, {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


# --- all designs ------------------------------------------------------------------------------------------------------


def batch(
    wanted: Sequence[Wanted], folder: Path, *, workers: int | None = None, cluster: Cluster | None = None,
    progress: ProgressFunction = lambda *told: None, say: Callable[[str], None] = lambda sentence: None,
) -> list[Row]:  # fmt: skip
    """Design each scene into folder/NAME; a row for each, in their order.

    workers: designs at a time on this machine; None: as many as its cores and its memory serve.  cluster: where they
    are designed instead.  say: is told a sentence before the work.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with files.exclusive(folder / "batch.json"), contextlib.ExitStack() as stack:
        earlier = read(folder)
        rows = list(_outset(wanted, folder, earlier))
        names = {row.name for row in rows if row.status != REFUSED}
        others = [row for row in earlier if row.finished and row.name not in names]
        left = {k: with_net(wanted[k].scene)[0] for k, row in enumerate(rows) if row.status == STOPPED}
        if left:
            most = WITHIN["memory_gb"] * max(map(memory_gb, left.values()))
            at_a_time = min(environment.cores() // CORES, int(psutil.virtual_memory().available / 1e9 / most))
            machines = cluster or stack.enter_context(LocalPool(min(workers or max(1, at_a_time), len(left))))
            done, place = sum(row.finished for row in rows), "the cluster" if cluster else "this machine"
            say(
                f"{len(left)} design{'s' * (len(left) > 1)}, {min(machines.capacity, len(left))} at a time on {place}, "
                f"each with up to {most:.1f} GB of memory"
                f"{f'; {done} finished before' if done else ''}"
            )
            try:
                _design_all(rows, left, folder, machines, told=progress, others=others)
            except BaseException as error:
                many = f"{sum(row.finished for row in rows)} of {len(rows)} designs are finished in {folder}"
                error.add_note(f"{many}; the same command goes on from there")
                raise
        write([*rows, *others], folder)
    return rows


def _outset(wanted: Sequence[Wanted], folder: Path, earlier: Sequence[Row]) -> Iterator[Row]:
    """The row of each design before the work."""
    finished = {row.key: row for row in earlier if row.finished and _design_in(folder / row.name) == row.design}
    path_of: dict[str, str] = {}  # by the scene's name
    for given in wanted:
        if given.scene is None:
            yield Row(scene=given.path, status=REFUSED, reason=given.reason)
            continue
        name, key = given.scene.name, f"{folders.hash_of(folders.scene_files(given.scene))} {environment.version()}"
        row, reason = Row(scene=given.path, name=name, key=key), ""
        if same := path_of.get(name):
            reason = f"name: {name!r} is the name of {same} too, and a folder holds one design; give another"
        path_of.setdefault(name, given.path)
        try:
            files.check_free(folder / name)
        except ValueError as error:
            reason = reason or f"{error} with -o"
        if reason:
            yield row.changed(status=REFUSED, reason=reason)
        else:
            yield finished[key].changed(scene=given.path) if key in finished else row


def _design_all(
    rows: list[Row], left: Mapping[int, Scene], folder: Path, machines: Machines, *,
    told: ProgressFunction, others: Sequence[Row],
) -> None:  # fmt: skip
    """Design the scenes that are left, put their rows in place, and write batch.json whenever a design has ended."""
    waiting, under_way, here = list(left), [], isinstance(machines, LocalPool)
    # So many processes share the cores; variables that are set stay as they are.
    share = {name: value for name, value in environment.threads(machines.capacity).items() if name not in os.environ}

    def tick() -> None:
        done = len(left) - len(waiting) - len(under_way)
        told("batch", done, len(left), ", ".join(rows[k].name for k in under_way))

    while waiting or under_way:
        while waiting and len(under_way) < machines.capacity:
            under_way.append(k := waiting.pop(0))
            contents = folders.scene_files(left[k])
            if here:
                machines.start(k, design, contents, (folder / rows[k].name).absolute(), share)
            else:
                machines.start(k, design_elsewhere, contents)
        write([*rows, *others], folder)
        answer = machines.next(tick)
        under_way.remove(answer.key)
        rows[answer.key] = _ended(rows[answer.key], answer, folder, here)
    tick()


def _ended(row: Row, answer: Answer, folder: Path, here: bool) -> Row:
    """The row of a design that has ended."""
    row = row.changed(where=answer.where)
    if answer.reason:
        return row.changed(status=BROKEN, reason=answer.reason)
    ending: ExitStatus = answer.value if here else answer.value[0]
    if ending.code not in (0, 1):
        status = REFUSED if ending.code == 2 else BROKEN
        return row.changed(status=status, reason=ending.reason, seconds=ending.seconds)
    if not here:
        try:
            _put(answer.value[1], folder / row.name)
        except SceneError as error:
            return row.changed(status=REFUSED, reason=str(error))
    report = _report(row, folder)
    return row.changed(
        status=report["verdict"],
        checks_failed=tuple(check["name"] for check in report["checks"] if not check["passed"]),
        seconds=report["seconds_total"],
        report=f"{row.name}/report.html",
        design=_design_in(folder / row.name),
        **{key: report[key] for key in ("rrmsd", "rrmsd_noise", "leak", "light_on_target")},
    )


def _put(contents: Mapping[str, bytes], folder: Path) -> None:
    """A design that was made elsewhere, in the place of an earlier one."""
    with files.exclusive(folder), folders.replacing(folder) as building:
        for name, data in contents.items():
            path = building / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)


def _design_in(folder: Path) -> str:
    """SHA-256 of the design in a folder; "" if there is none."""
    try:
        data = files.contents(folder / "design.npz", files.MAX_ARCHIVE_SIZE)
    except ValueError:
        return ""
    return hashlib.sha256(data).hexdigest() if (folder / "report.json").is_file() else ""


# --- batch.json, batch.csv and the terminal ---------------------------------------------------------------------------


def read(folder: Path) -> tuple[Row, ...]:
    """The designs of earlier batches in a folder; MachineError if batch.json is damaged."""
    path = folder / "batch.json"
    return cold_run.read(Batch, path, "remove it, and all designs are done again").designs if path.exists() else ()


def write(rows: Sequence[Row], folder: Path) -> None:
    """Write batch.json and batch.csv."""
    cold_run.put(folder / "batch.json", Batch(version=bstcad.__version__, designs=tuple(rows)))
    texts = ({"checks_failed": "; ".join(row.checks_failed), "seconds": f"{row.seconds:.1f}"} for row in rows)
    cold_run.put_table(folder / "batch.csv", COLUMNS, (dict(row) | text for row, text in zip(rows, texts, strict=True)))


def _report(row: Row, folder: Path) -> dict[str, Any]:
    return json.loads((folder / row.name / "report.json").read_text(encoding="utf-8"))


def exit_code(rows: Sequence[Row]) -> int:
    """2 if a scene was refused, 1 if a check failed or a lens did not come about, else 0."""
    if any(row.status == REFUSED for row in rows):
        return 2
    return int(any(row.status == BROKEN or row.checks_failed for row in rows))


def summary(rows: Sequence[Row], folder: Path, verbose: bool = False) -> Group:
    """A line a design: its verdict, RRMSD and seconds, or why there is no lens; then the checks that failed.

    verbose: all checks.
    """
    from rich.console import Group
    from rich.text import Text

    wide, lines, checked = max(map(len, VERDICTS)), [], []
    for row in rows:
        figures = f"RRMSD {row.rrmsd:.4f}  {row.seconds:5.0f} s  " if row.finished else ""
        reason = f": {row.reason}" if row.reason else ""
        status = f"{row.status.upper():{wide}}", STYLES.get(row.status, "bold red")
        lines.append(Text.assemble(status, f"  {figures}{row.scene}{reason}"))
        if row.checks_failed or (verbose and row.finished):
            checks = [Check(**check) for check in _report(row, folder)["checks"]]
            checked += check_lines(checks, verbose, f"{row.scene}: ")
    return Group(*lines, *checked)
