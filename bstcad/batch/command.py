"""What `bstcad batch` does: designs many scenes, each into its own folder, whatever becomes of the others.

A design counts as done if batch.json tells of it, of the same scene and the same version of bstcad, and its folder
still holds it.  One that was under way when its batch was stopped goes on from its checkpoint, where it was made on
this machine.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from bstcad import files
from bstcad.batch import beside, designing, written
from bstcad.batch.designing import Order
from bstcad.batch.written import BROKEN, REFUSED, Row
from bstcad.pipeline import Saved, purpose
from bstcad.prediction.forecast import fitted
from bstcad.prediction.work import memory_gb
from bstcad.runs import checkpoint, environment, lock
from bstcad.runs import folder as folders
from bstcad.runs.checkpoint import CheckpointError, Keeper
from bstcad.runs.cluster import Answer, Cluster, Machines
from bstcad.runs.cold import Ending
from bstcad.runs.progress import Report, Told
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.verify.verdict import VERDICTS

if TYPE_CHECKING:
    from rich.console import Group

STYLES = {"passed": "green", "passed with remarks": "yellow"}  # of the terminal; all else is red
STAGE = "batch"


@dataclass(frozen=True)
class Wanted:
    """A scene file, and the scene that it holds, or why it holds none."""

    path: str
    scene: Scene | None
    reason: str = ""


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
        found = _Batch(wanted, folder, Told(progress, pause))
        if found.left:
            room = workers or beside.sensible(len(found.left), found.memory_gb)
            machines = cluster or stack.enter_context(beside.Beside(min(room, len(found.left))))
            say(found.outset(machines.room, cluster is None))
            try:
                found.run(machines, None if cluster else beside.environment(machines.room))
            except BaseException as error:
                error.add_note(found.kept())
                raise
        found.write()
    return list(found.rows)


class _Batch:
    """A batch under way."""

    def __init__(self, wanted: Sequence[Wanted], folder: Path, told: Told) -> None:
        self._wanted, self._folder, self._told = wanted, folder, told
        self._files = [None if one.scene is None else folders.scene_files(one.scene) for one in wanted]
        earlier = written.read(folder)
        by_key = {row.key: row for row in earlier if row.stands(folder)}
        self.rows = [self._row(k, by_key) for k in range(len(wanted))]
        names = {row.name for row in self.rows if row.status != REFUSED}
        self._others = [row for row in earlier if row.finished and row.name not in names]
        self.left = [k for k, row in enumerate(self.rows) if row.status == written.STOPPED]
        self._total, self._under_way = len(self.left), list[int]()

    def _row(self, k: int, by_key: Mapping[str, Row]) -> Row:
        """What is known of a design before the work."""
        one, contents = self._wanted[k], self._files[k]
        if one.scene is None:
            return Row(one.path, status=REFUSED, reason=one.reason)
        row = Row(one.path, one.scene.name, key=f"{folders.hash_of(contents)} {environment.version()}")
        same = next((p.path for p in self._wanted[:k] if p.scene is not None and p.scene.name == row.name), None)
        if same is not None:
            reason = f"name: {row.name!r} is the name of {same} too, and a folder holds one design; give another"
            return replace(row, status=REFUSED, reason=reason)
        try:
            files.check_free(self._folder / row.name)
        except ValueError as error:
            return replace(row, status=REFUSED, reason=f"{error} with -o")
        return replace(by_key[row.key], scene=one.path) if row.key in by_key else row

    @property
    def memory_gb(self) -> float:
        """The most that a design which is left may hold, by what whole designs took."""
        known = fitted()
        most = max(memory_gb(self._wanted[k].scene, known["memory"]) for k in self.left)
        return most * known["within"]["memory_gb"]

    def outset(self, room: int, here: bool) -> str:
        """What is about to begin, in words."""
        before = sum(row.finished for row in self.rows)
        many = "1 design" if len(self.left) == 1 else f"{len(self.left)} designs"
        where = "on this machine" if here else "on the cluster"
        done = f"; {before} finished before" if before else ""
        at_a_time = min(room, len(self.left))
        return f"{many}, {at_a_time} at a time {where}, each with up to {self.memory_gb:.1f} GB of memory{done}"

    def run(self, machines: Machines, variables: Mapping[str, str] | None) -> None:
        """Until nothing is left.  variables: of the processes here; None: they are elsewhere."""
        waiting = list(self.left)
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
            machines.start(k, designing.design_elsewhere, Order(self._files[k]))
            return
        place = self._folder / self.rows[k].name
        order = Order(self._files[k], _goes_on(self._wanted[k].scene, place), variables)
        machines.start(k, designing.design, order, place.absolute())

    def _ended(self, answer: Answer, here: bool) -> Row:
        """The row of a design that has ended."""
        row = replace(self.rows[answer.key], where=answer.where)
        if answer.reason:
            return replace(row, status=BROKEN, reason=answer.reason)
        ending: Ending = answer.value if here else answer.value[0]
        if ending.code not in (0, 1):
            status = REFUSED if ending.code == 2 else BROKEN
            return replace(row, status=status, reason=ending.reason, seconds=ending.seconds)
        if not here:
            try:
                _put(answer.value[1], self._folder / row.name)
            except SceneError as error:
                return replace(row, status=REFUSED, reason=str(error))
        return written.row_of(row, self._folder)

    def write(self) -> None:
        """batch.json and batch.csv."""
        written.write([*self.rows, *self._others], self._folder)

    def kept(self) -> str:
        """What there is to say when the batch is stopped."""
        done = sum(row.finished for row in self.rows)
        return f"{done} of {len(self.rows)} designs are finished in {self._folder}; the same command goes on from there"

    def _tick(self) -> None:
        done = self._total - sum(self.rows[k].status == written.STOPPED for k in self.left)
        self._told(STAGE, done, self._total, ", ".join(self.rows[k].name for k in self._under_way))


def _goes_on(scene: Scene, folder: Path) -> bool:
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
    """2 if a scene was refused, 1 if a lens is not as it should be or did not come about, else 0."""
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
