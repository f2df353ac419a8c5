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
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

import bstcad
from bstcad import files
from bstcad.pipeline import Saved, purpose
from bstcad.runs import checkpoint, child_process, environment, lock
from bstcad.runs import folder as folders
from bstcad.runs.checkpoint import CheckpointError, Keeper
from bstcad.runs.child_process import HERE, Ending
from bstcad.runs.cluster import Answer, Cluster, Machines
from bstcad.runs.progress import Report, Throttled
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.sweep import io
from bstcad.sweep.forecast import fitted
from bstcad.sweep.io import Stored
from bstcad.sweep.work import memory_gb
from bstcad.verify.verdict import VERDICTS, Check

if TYPE_CHECKING:
    from rich.console import Group

REFUSED, BROKEN, STOPPED = "refused", "broken", "not done"
COLUMNS = (
    "scene", "name", "status", "rrmsd", "rrmsd_noise", "leak", "light_on_target", "checks_failed", "seconds", "report",
    "where", "reason",
)  # fmt: skip
STYLES = {"passed": "green", "passed with remarks": "yellow"}  # of the terminal; all others are red
STAGE = "batch"
KILLED = -9  # exit code of a process that somebody, or the system for want of memory, has killed
CORES = 2  # that a design keeps busy
LOOK = 0.2  # seconds between two looks whether a design has ended


class Row(Stored):
    """How a design went."""

    scene: str  # the file, as the user named it
    name: str = ""  # of the scene and of the design's folder
    status: str = STOPPED  # its verdict (verify.verdict.VERDICTS), REFUSED, BROKEN or STOPPED
    rrmsd: float | None = None
    rrmsd_noise: float | None = None
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

    def stands(self, folder: Path) -> bool:
        """Does the batch's folder hold this very design?"""
        return self.finished and _design_in(folder / self.name) == self.design

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


@dataclass(frozen=True)
class Order:
    """All that it takes to carry out a design."""

    contents: Mapping[str, bytes]  # the scene and its pictures, by file name
    resume: bool = False  # from the checkpoint beside its folder
    environment: Mapping[str, str] | None = None  # variables of its process


# --- one design -------------------------------------------------------------------------------------------------------


def design(order: Order, folder: Path, tick: Callable[[], None] = lambda: None) -> Ending:
    """Design into a folder; a process that was killed is begun once more, from its checkpoint."""
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        for name, data in order.contents.items():
            (Path(place) / name).write_bytes(data)
        command = ["generate", str(Path(place) / folders.SCENE), "-o", str(folder)]
        resume = ["--resume"] if order.resume else []
        first = child_process.run([*command, *resume], tick=tick, environment=order.environment)
        if first.code != KILLED:
            return first
        again = child_process.run([*command, "--resume"], tick=tick, environment=order.environment)
    return replace(again, seconds=first.seconds + again.seconds, cpu_seconds=first.cpu_seconds + again.cpu_seconds)


def design_elsewhere(order: Order) -> tuple[Ending, dict[str, bytes]]:
    """On a worker: how the design went, and the files of its folder by their paths in it."""
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        folder = Path(place) / "design"
        ended = design(order, folder)
        paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        return ended, {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


class LocalPool:
    """Some child processes at a time, each with a thread that waits for it.

    Processes that still work when the block ends are ended, and keep their checkpoints.
    """

    def __init__(self, room: int) -> None:
        self.room = room
        self._threads, self._ends = ThreadPoolExecutor(room), threading.Event()
        self._keys: dict[Future, Any] = {}

    def __enter__(self) -> LocalPool:
        return self

    def __exit__(self, *error: object) -> None:
        self._ends.set()
        self._threads.shutdown(cancel_futures=True)

    def start(self, key: Any, work: Callable[..., Any], *arguments: Any) -> None:
        """Have work(*arguments, tick) done, which calls `tick` all the while."""
        self._keys[self._threads.submit(work, *arguments, self._tick)] = key

    def next(self, tick: Callable[[], None]) -> Answer:
        """Wait for a process that has ended."""
        while True:
            for future in wait(self._keys, timeout=LOOK, return_when=FIRST_COMPLETED).done:
                key, error = self._keys.pop(future), future.exception()
                if error is not None:
                    return Answer(key, HERE, reason=f"{type(error).__name__}: {error}")
                return Answer(key, HERE, future.result())
            tick()

    def _tick(self) -> None:
        if self._ends.is_set():
            raise InterruptedError("the batch has ended")


# --- the batch --------------------------------------------------------------------------------------------------------


def batch(
    wanted: Sequence[Wanted], folder: Path, *, workers: int | None = None, cluster: Cluster | None = None,
    progress: Report = lambda stage, done, total, text: None, pause: float = 1.0,
    say: Callable[[str], None] = lambda sentence: None,
) -> list[Row]:  # fmt: skip
    """Design each scene into folder/NAME; a row for each, in their order.

    workers: designs at a time on this machine; None: as many as its cores and its memory serve.  cluster: where they
    are designed instead.  say: is told a sentence before the work.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with lock.held(folder / "batch.json"), contextlib.ExitStack() as stack:
        found = _Batch(wanted, folder, Throttled(progress, pause))
        if found.left:
            room = workers or _sensible(len(found.left), found.memory_gb)
            machines = cluster or stack.enter_context(LocalPool(min(room, len(found.left))))
            say(found.outset(machines.room, cluster is None))
            try:
                found.run(machines, None if cluster else _variables(machines.room))
            except BaseException as error:
                done = sum(row.finished for row in found.rows)
                many = f"{done} of {len(found.rows)} designs are finished in {folder}"
                error.add_note(f"{many}; the same command goes on from there")
                raise
        found.write()
    return list(found.rows)


def _sensible(count: int, memory_gb: float) -> int:
    """How many of `count` designs at a time, each of which may hold so much memory."""
    free = psutil.virtual_memory().available / 1e9
    return max(1, min(count, environment.cores() // CORES, int(free / memory_gb)))


def _variables(room: int) -> dict[str, str]:
    """Environment variables of so many processes; those that are set stay as they are."""
    return {name: value for name, value in environment.threads(room).items() if name not in os.environ}


class _Batch:
    """A batch under way."""

    def __init__(self, wanted: Sequence[Wanted], folder: Path, told: Throttled) -> None:
        self._wanted, self._folder, self._told = wanted, folder, told
        self._contents = [None if one.scene is None else folders.scene_files(one.scene) for one in wanted]
        earlier = read(folder)
        by_key = {row.key: row for row in earlier if row.stands(folder)}
        self.rows = [self._row(k, by_key) for k in range(len(wanted))]
        names = {row.name for row in self.rows if row.status != REFUSED}
        self._others = [row for row in earlier if row.finished and row.name not in names]
        self.left = [k for k, row in enumerate(self.rows) if row.status == STOPPED]
        self._under_way: list[int] = []

    def _row(self, k: int, by_key: Mapping[str, Row]) -> Row:
        """The row of a design before the work."""
        one, contents = self._wanted[k], self._contents[k]
        if one.scene is None:
            return Row(scene=one.path, status=REFUSED, reason=one.reason)
        key = f"{folders.hash_of(contents)} {environment.version()}"
        row = Row(scene=one.path, name=one.scene.name, key=key)
        same = next((p.path for p in self._wanted[:k] if p.scene is not None and p.scene.name == row.name), None)
        if same is not None:
            reason = f"name: {row.name!r} is the name of {same} too, and a folder holds one design; give another"
            return row.changed(status=REFUSED, reason=reason)
        try:
            files.check_free(self._folder / row.name)
        except ValueError as error:
            return row.changed(status=REFUSED, reason=f"{error} with -o")
        return by_key[key].changed(scene=one.path) if key in by_key else row

    @property
    def memory_gb(self) -> float:
        """The most that a design which is left may hold, by the memory that whole designs took."""
        most = max(memory_gb(self._wanted[k].scene, fitted()["memory"]) for k in self.left)
        return most * fitted()["within"]["memory_gb"]

    def outset(self, room: int, here: bool) -> str:
        """What is about to begin, in words."""
        before = sum(row.finished for row in self.rows)
        many = f"{len(self.left)} design{'s' * (len(self.left) > 1)}, {min(room, len(self.left))} at a time"
        where = "on this machine" if here else "on the cluster"
        done = f"; {before} finished before" if before else ""
        return f"{many} {where}, each with up to {self.memory_gb:.1f} GB of memory{done}"

    def run(self, machines: Machines, variables: Mapping[str, str] | None) -> None:
        """Until no design is left.  variables: of the processes here; None: they are elsewhere."""
        waiting, self._total = list(self.left), len(self.left)
        while waiting or self._under_way:
            while waiting and len(self._under_way) < machines.room:
                self._start(machines, waiting.pop(0), variables)
            self.write()
            answer = machines.next(self._tick)
            self._under_way.remove(answer.key)
            self.rows[answer.key] = self._ended(answer, variables is not None)
        self._told(STAGE, self._total, self._total, "")

    def _start(self, machines: Machines, k: int, variables: Mapping[str, str] | None) -> None:
        self._under_way.append(k)
        if variables is None:
            machines.start(k, design_elsewhere, Order(self._contents[k]))
            return
        place = self._folder / self.rows[k].name
        order = Order(self._contents[k], _has_checkpoint(self._wanted[k].scene, place), variables)
        machines.start(k, design, order, place.absolute())

    def _ended(self, answer: Answer, here: bool) -> Row:
        """The row of a design that has ended."""
        row = self.rows[answer.key].changed(where=answer.where)
        if answer.reason:
            return row.changed(status=BROKEN, reason=answer.reason)
        ending: Ending = answer.value if here else answer.value[0]
        if ending.code not in (0, 1):
            status = REFUSED if ending.code == 2 else BROKEN
            return row.changed(status=status, reason=ending.reason, seconds=ending.seconds)
        if not here:
            try:
                _put(answer.value[1], self._folder / row.name)
            except SceneError as error:
                return row.changed(status=REFUSED, reason=str(error))
        return _reported(row, self._folder)

    def write(self) -> None:
        """Write batch.json and batch.csv."""
        told = Batch(version=bstcad.__version__, designs=(*self.rows, *self._others))
        io.put(self._folder / "batch.json", told)
        lines = (
            dict(row) | {"checks_failed": "; ".join(row.checks_failed), "seconds": f"{row.seconds:.1f}"}
            for row in told.designs
        )
        io.table(self._folder / "batch.csv", COLUMNS, lines)

    def _tick(self) -> None:
        done = self._total - sum(self.rows[k].status == STOPPED for k in self.left)
        self._told(STAGE, done, self._total, ", ".join(self.rows[k].name for k in self._under_way))


def read(folder: Path) -> tuple[Row, ...]:
    """The designs of earlier batches in a folder; MachineError if batch.json is damaged."""
    path = folder / "batch.json"
    return io.read(Batch, path, "remove it, and all designs are done again").designs if path.exists() else ()


def checks(row: Row, folder: Path) -> tuple[Check, ...]:
    """The checks of the design that the batch's folder holds."""
    return tuple(Check(**check) for check in _report(row, folder)["checks"])


def _report(row: Row, folder: Path) -> dict[str, Any]:
    return json.loads((folder / row.name / "report.json").read_text(encoding="utf-8"))


def _reported(row: Row, folder: Path) -> Row:
    """The row with the figures of the report of the design that the batch's folder now holds."""
    report = _report(row, folder)
    return row.changed(
        status=report["verdict"],
        checks_failed=tuple(check["name"] for check in report["checks"] if not check["passed"]),
        seconds=report["seconds_total"],
        report=f"{row.name}/report.html",
        design=_design_in(folder / row.name),
        **{key: report[key] for key in ("rrmsd", "rrmsd_noise", "leak", "light_on_target")},
    )


def _design_in(folder: Path) -> str:
    """SHA-256 of the design in a folder; "" if there is none."""
    try:
        data = files.contents(folder / "design.npz", files.LARGEST)
    except ValueError:
        return ""
    return hashlib.sha256(data).hexdigest() if (folder / "report.json").is_file() else ""


def _has_checkpoint(scene: Scene, folder: Path) -> bool:
    """Is there a checkpoint of this very design?"""
    keeper = Keeper(checkpoint.path_for(folder), purpose(scene, "auto"), kind=Saved)
    try:
        return keeper.found() is not None
    except CheckpointError:
        return False


def _put(contents: Mapping[str, bytes], folder: Path) -> None:
    """A design that was made elsewhere, in the place of an earlier one."""
    with lock.held(folder), folders.replacing(folder) as building:
        for name, data in contents.items():
            path = building / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)


def exit_code(rows: Sequence[Row]) -> int:
    """2 if a scene was refused, 1 if a check failed or a lens did not come about, else 0."""
    if any(row.status == REFUSED for row in rows):
        return 2
    return int(any(row.status == BROKEN or row.checks_failed for row in rows))


def summary(rows: Sequence[Row]) -> Group:
    """A line a design: its verdict, RRMSD and seconds, or why there is no lens."""
    from rich.console import Group
    from rich.text import Text

    wide, lines = max(map(len, VERDICTS)), []
    for row in rows:
        figures = f"RRMSD {row.rrmsd:.4f}  {row.seconds:5.0f} s  " if row.finished else ""
        reason = f": {row.reason}" if row.reason else ""
        status = f"{row.status.upper():{wide}}", STYLES.get(row.status, "bold red")
        lines.append(Text.assemble(status, f"  {figures}{row.scene}{reason}"))
    return Group(*lines)
