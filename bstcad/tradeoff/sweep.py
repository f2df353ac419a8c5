"""bstcad tradeoff: what accuracy costs in time for a scene, found by runs of it within a budget of seconds.

    found = sweep(scene, folder, budget=600.0)

The budget is of the seconds that all runs take, one added to the other wherever they take place, and of every sweep in
a folder.  A run that is predicted not to fit is not begun; one that takes longer than predicted is ended OVER beyond
the budget.

The folder holds the base scene (scene/), a record of each run (runs/), and what they come to: tradeoff.csv, .json, .png
and .html.  What was run once is not run again: a sweep that was stopped goes on, one with a larger budget goes further.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Protocol

from bstcad import files
from bstcad.runs import lock
from bstcad.runs.folder import hash_of
from bstcad.runs.progress import Told
from bstcad.scene.errors import MachineError, SceneError
from bstcad.scene.scene import Scene
from bstcad.tradeoff import agenda as agendas
from bstcad.tradeoff import runs
from bstcad.tradeoff.knobs import Knob, Settings, knobs, words
from bstcad.tradeoff.prediction import Prediction
from bstcad.tradeoff.runs import Order, Record

Progress = Callable[[str, int, int, str], None]
STAGE = "tradeoff"
LEEWAY = 1.1  # a run starts if so many times its predicted seconds are left
OVER = 0.1  # of the budget, by which a run may go beyond it that takes longer than predicted
MORE = 1.5  # times as long it may take if one that was ended is begun again


@dataclass(frozen=True)
class Planned:
    """A run that did not take place."""

    settings: Settings
    predicted_seconds: float


@dataclass(frozen=True)
class Sweep:
    """All that was found."""

    scene: Scene  # the base
    knobs: tuple[Knob, ...]
    budget: float  # seconds, of the runs of all machines together
    records: Mapping[Settings, Record]  # in the order of their importance
    not_run: tuple[Planned, ...] = ()  # for want of budget
    seed_matters: Mapping[str, bool | None] = field(default_factory=dict)  # by method; None: not measured

    @property
    def spent(self) -> float:
        """Seconds of the budget that are used up."""
        return sum(record.cost_seconds for record in self.records.values())


class Machines(Protocol):
    """Where runs take place."""

    room: int  # how many at a time

    def start(self, order: Order) -> None:
        """Begin a run."""

    def next(self, tick: Callable[[], None]) -> Record:
        """Wait for one that has ended."""

    def prepare(self, scene_of: Mapping[str, bytes], tick: Callable[[], None]) -> None:
        """Whatever is to be done before the first one."""


class Here:
    """This machine: one run at a time, so that none disturbs another."""

    room = 1

    def __init__(self) -> None:
        self._order: Order | None = None

    def prepare(self, scene_of: Mapping[str, bytes], tick: Callable[[], None]) -> None:
        """Compile kernels and bring libraries from the disk."""
        runs.warm_up(scene_of, tick)

    def start(self, order: Order) -> None:
        """Keep it for `next`."""
        self._order = order

    def next(self, tick: Callable[[], None]) -> Record:
        """Carry it out."""
        return runs.carry_out(self._order, tick)


def sweep(
    scene: Scene,
    folder: Path,
    *,
    budget: float,
    progress: Progress = lambda stage, done, total, text: None,
    machines: Machines | None = None,
    effort: runs.Effort = runs.REFERENCE,
    turn: Callable[[Scene], tuple[Knob, ...]] = knobs,
    keep: Callable[[Sweep], None] = lambda so_far: None,
    pause: float = 1.0,
) -> Sweep:
    """Run what the budget allows, the most important first; every record is kept in the folder as it comes.

    effort: of the reference that judges; turn: the knobs of a scene; keep: called with what there is, after each run
    and, of runs that were there before, at the start; pause:
    seconds between two calls of progress while nothing new is to be told.
    """
    base = runs.base_of(scene)
    scene_of = runs.scene_files(base)
    check_free(folder, scene_of)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with lock.held(folder):
        _keep_scene(folder, scene_of)
        shelf = Shelf(folder / "runs", scene_of)
        found = _Search(base, turn(base), budget, shelf, Told(progress, pause), keep)
        found.run(machines or Here(), scene_of, effort)
        return found.result()


def check_free(folder: Path, scene_of: Mapping[str, bytes]) -> None:
    """SceneError unless the sweep of this scene may take the folder: a new one, empty, or one that it began in."""
    if folder.exists() and not folder.is_dir():
        raise SceneError(f"{folder}: is a file; give another folder with -o")
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    there = folder / "scene" / runs.SCENE
    if not there.is_file():
        raise SceneError(f"{folder}: holds files that are not a sweep's; give a new folder with -o")
    if any(_differs(folder / "scene" / name, data) for name, data in scene_of.items()):
        raise SceneError(
            f"{folder}: holds the sweep of another scene, which stands in {there}; give another folder with -o, or "
            "remove that one"
        )


def _differs(path: Path, data: bytes) -> bool:
    return not path.is_file() or path.stat().st_size != len(data) or path.read_bytes() != data


def _keep_scene(folder: Path, scene_of: Mapping[str, bytes]) -> None:
    (folder / "scene").mkdir(parents=True, exist_ok=True)
    for name, data in scene_of.items():
        if _differs(folder / "scene" / name, data):
            files.put(folder / "scene" / name, data)


@dataclass(frozen=True)
class UnderWay:
    """A run that has not ended."""

    began: float
    predicted_seconds: float


class Shelf:
    """The records of a sweep, a file each, in the order in which they came."""

    def __init__(self, folder: Path, scene_of: Mapping[str, bytes]) -> None:
        self._folder = folder
        self._key = f"{hash_of(scene_of)} {runs.version()}"

    def path(self, point: Settings) -> Path:
        """The file of a run: its name is a hash of scene, settings and version of the program."""
        text = json.dumps([self._key, point])
        return self._folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"

    def put(self, record: Record) -> None:
        """Keep a record, whole or not at all."""
        self._folder.mkdir(parents=True, exist_ok=True)
        files.put(self.path(record.settings), json.dumps(asdict(record), ensure_ascii=False, indent=1).encode())

    def find(self, point: Settings) -> Record | None:
        """The record of a run; None: there is none of this scene and this version."""
        path = self.path(point)
        if not path.is_file():
            return None
        try:
            return Record.of(json.loads(files.contents(path, 10_000_000)))
        except (ValueError, KeyError, TypeError):
            raise MachineError(f"{path}: is damaged; remove it, and the run is done again") from None

    def count(self) -> int:
        """How many records there are, of other versions too."""
        return len(list(self._folder.glob("*.json"))) if self._folder.is_dir() else 0


class _Search:
    """A sweep under way."""

    def __init__(
        self, base: Scene, knobs: Sequence[Knob], budget: float, shelf: Shelf, tell: Told, keep: Callable[[Sweep], None]
    ) -> None:
        self._base, self._knobs, self._budget, self._shelf = base, tuple(knobs), budget, shelf
        self._told, self._keep = tell, keep
        self._records: dict[Settings, Record] = {}
        for point in self._agenda():
            if record := shelf.find(point):
                self._records[point] = record
        for record in [record for record in self._records.values() if record.allowed_seconds is not None]:
            left = budget - self._spent() + record.cost_seconds
            if left + OVER * budget >= MORE * record.allowed_seconds:
                del self._records[record.settings]
        self._prediction = Prediction(base)
        self._prediction.learn(list(self._records.values()))
        self._earlier = self._spent()  # by the sweeps that this one goes on from
        self._under_way: dict[Settings, UnderWay] = {}

    def run(self, machines: Machines, scene_of: Mapping[str, bytes], effort: runs.Effort) -> None:
        """Until nothing is left that fits."""
        if self._choice() is None:
            return
        if self._records:
            self._keep(self.result())
        machines.prepare(scene_of, lambda: self._told("warm-up", 0, 0, "kernels are compiled, files read"))
        while True:
            while len(self._under_way) < machines.room and (point := self._choice()) is not None:
                compares, limit = point == (), self._limit()
                self._under_way[point] = UnderWay(time.perf_counter(), self._prediction.seconds(point))
                machines.start(Order(scene_of, point, limit, compares, effort))
            if not self._under_way:
                return
            record = machines.next(self._tick)
            began = self._under_way.pop(record.settings)
            record = replace(record, predicted_seconds=began.predicted_seconds)
            self._records[record.settings] = record
            self._prediction.learn(list(self._records.values()))
            self._shelf.put(record)
            self._keep(self.result())

    def result(self) -> Sweep:
        """What there is so far."""
        order = self._agenda()
        left = [point for point in order if point not in self._records]
        not_run = tuple(Planned(point, self._prediction.seconds(point)) for point in left)
        matters = agendas.touched(self._base, self._knobs, self._records.get)
        records = {point: self._records[point] for point in order if point in self._records}
        return Sweep(self._base, self._knobs, self._budget, records, not_run, matters)

    def _agenda(self) -> list[Settings]:
        return agendas.agenda(
            self._base, self._knobs, lambda point: self._records.get(point) or self._shelf.find(point)
        )

    def _choice(self) -> Settings | None:
        """The most important run that fits into what is left; the very first one always does."""
        free = (p for p in self._agenda() if p not in self._records and p not in self._under_way)
        first, left = self._nothing_yet(), self._left()
        return next((p for p in free if first or LEEWAY * self._prediction.seconds(p) <= left), None)

    def _nothing_yet(self) -> bool:
        return not self._records and not self._under_way

    def _left(self) -> float:
        """Seconds of the budget, less those that the runs under way are predicted to take."""
        return self._budget - self._spent() - LEEWAY * sum(each.predicted_seconds for each in self._under_way.values())

    def _limit(self) -> float:
        """Seconds after which a run is ended that begins now; the first one never is: without it there is nothing."""
        return math.inf if self._nothing_yet() else self._left() + OVER * self._budget

    def _spent(self) -> float:
        return sum(record.cost_seconds for record in self._records.values())

    def _tick(self) -> None:
        point = next(iter(self._under_way), None)
        if point is not None:
            many = f" and {len(self._under_way) - 1} more" if len(self._under_way) > 1 else ""
            self._tell(f"run {len(self._records) + 1}: {words(point)}{many}")

    def _tell(self, text: str) -> None:
        """The bar: of the budget that was left when this sweep began."""
        total, now = max(self._budget - self._earlier, 1.0), time.perf_counter()
        used = self._spent() - self._earlier + sum(now - each.began for each in self._under_way.values())
        self._told(STAGE, round(min(used, 0.999 * total)), max(round(total), 1), text)
