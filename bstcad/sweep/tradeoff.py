"""bstcad tradeoff: what accuracy costs in time for a scene, by runs of it within a budget of seconds.

The budget is of the seconds of all runs, one added to the other wherever they take place, and of every sweep in a
folder.  A run that is predicted not to fit is not begun; a run that takes longer is ended OVER beyond the budget.

The folder holds the base scene (scene/), the record of each run (runs/), and the results: tradeoff.csv, .json, .png and
.html.  A run with a record is not run again: a sweep that was stopped goes on, a larger budget goes further.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from bstcad.folder import SCENE, hash_of, scene_files
from bstcad.runs import environment, files
from bstcad.runs.cluster import HERE, Answer, Machines
from bstcad.runs.progress import Report, Throttled
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.sweep import cold_run, io, results, tradeoff_page
from bstcad.sweep.cold_run import FAILED, REFERENCE, KeptRun, Order
from bstcad.sweep.forecast import fitted
from bstcad.sweep.knobs import Knob, Settings, knobs, run_order, seed_matters, words
from bstcad.sweep.results import Table
from bstcad.sweep.work import KINDS, amounts

STAGE = "tradeoff"
LEEWAY = 1.1  # a run starts if so many times its predicted seconds are left
OVER = 0.1  # of the budget, by which a run may go beyond it that takes longer than predicted
MORE = 1.5  # times as long a run may take that was ended before and is begun again
# Of predictions, in units of the calibration kernel.
UNIT = 0.1  # seconds of it before it was measured, on two cores
SERIAL = 0.1  # the unit of work of one processor, which a sweep does not measure
JUDGING = 20.0  # judging a lens
ADAM = 1.0  # a step of the paper's procedure, by 1024² rays
TRUST = 0.05  # weight of the prices as they start, beside that of a run that is done


def tradeoff(
    scene: Scene,
    folder: Path,
    *,
    budget: float,
    progress: Report = lambda stage, done, total, text: None,
    machines: Machines | None = None,
    effort: cold_run.Effort = REFERENCE,
    turn: Callable[[Scene], tuple[Knob, ...]] = knobs,
    pause: float = 1.0,
) -> Table:
    """Run the most important runs that the budget allows, and write tradeoff.csv, .json, .png and .html.

    machines: where the runs take place; None: here.  effort: of the reference that judges.  turn: the knobs of a scene.
    pause: seconds between two calls of progress while nothing new is to be told.
    The two tables are written after each run, so that they are there however a sweep ends.
    """
    base = cold_run.base_of(scene)
    contents = scene_files(base)
    check_free(folder, contents)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with files.held(folder):
        (folder / "scene").mkdir(parents=True, exist_ok=True)
        for name, data in contents.items():
            files.put(folder / "scene" / name, data)
        search = _Search(base, turn(base), budget, folder, Throttled(progress, pause))
        try:
            search.run(machines, Order(contents, (), effort=effort))
        except BaseException as error:
            if count := len(search.runs):
                kept = "1 run is" if count == 1 else f"{count} runs are"
                error.add_note(f"{kept} kept in {folder}; the same command goes on from there")
                if isinstance(error, KeyboardInterrupt):  # there is time for a figure
                    search.publish()
            raise
        return search.publish()


def check_free(folder: Path, contents: Mapping[str, bytes]) -> None:
    """SceneError unless the sweep of this scene may take the folder: new, empty, or begun by this sweep."""
    there = folder / "scene" / SCENE
    try:
        files.check_free(folder, [f"scene/{SCENE}"], "a sweep's")
    except ValueError as error:
        raise SceneError(f"{error} with -o") from None
    if there.is_file() and any(_differs(folder / "scene" / name, data) for name, data in contents.items()):
        raise SceneError(
            f"{folder}: holds the sweep of another scene, which stands in {there}; give another folder with -o, or "
            "remove that one"
        )


def _differs(path: Path, data: bytes) -> bool:
    return not path.is_file() or path.read_bytes() != data


class Shelf:
    """The records of the runs of one scene and one version of bstcad, a file each."""

    def __init__(self, folder: Path, contents: Mapping[str, bytes]) -> None:
        self._folder = folder
        self._key = f"{hash_of(contents)} {environment.version()}"

    def path(self, point: Settings) -> Path:
        """The file of a run, named by a hash of scene, version and settings."""
        text = json.dumps([self._key, point])
        return self._folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"

    def put(self, run: KeptRun) -> None:
        """Keep a record, whole or not at all."""
        self._folder.mkdir(parents=True, exist_ok=True)
        io.put(self.path(run.settings), run)

    def find(self, point: Settings) -> KeptRun | None:
        """The record of a run; None: there is none."""
        path = self.path(point)
        return io.read(KeptRun, path, "remove it, and the run is done again") if path.is_file() else None


class InTurn:
    """This machine: one piece of work at a time, so that no run disturbs another."""

    room = 1

    def start(self, key: Any, work: Callable[..., Any], *arguments: Any) -> None:
        """Keep the work for `next`."""
        self._key, self._work = key, partial(work, *arguments)

    def next(self, tick: Callable[[], None]) -> Answer:
        """Do it."""
        return Answer(self._key, HERE, self._work(tick))


class _Search:
    """A sweep under way."""

    def __init__(self, base: Scene, knobs: Sequence[Knob], budget: float, folder: Path, told: Throttled) -> None:
        self._base, self._knobs, self._budget, self._folder, self._told = base, tuple(knobs), budget, folder, told
        self._shelf, self._prices = Shelf(folder / "runs", scene_files(base)), RunPrices(base)
        self._runs: dict[Settings, KeptRun] = {}
        self._runs = {point: run for point in self._order() if (run := self._shelf.find(point))}
        for point, run in list(self._runs.items()):
            if run.allowed_seconds is not None:  # it was ended; is there more time for it now?
                left = budget - self._spent() + run.cost_seconds
                if left + OVER * budget >= MORE * run.allowed_seconds:
                    del self._runs[point]
        self._prices.learn(self._runs.values())
        self._earlier = self._spent()  # by the sweeps that this one goes on from
        self._under_way: dict[Settings, tuple[float, float]] = {}  # when it began, seconds predicted

    @property
    def runs(self) -> Mapping[Settings, KeptRun]:
        """The runs that have ended."""
        return self._runs

    def run(self, machines: Machines | None, order: Order) -> None:
        """Until no run is left that fits."""
        if self._choice() is None:
            return
        if machines is None:
            cold_run.warm_up(order.files, lambda: self._told("warm-up", 0, 0, "kernels are compiled, files read"))
            machines = InTurn()
        while True:
            while len(self._under_way) < machines.room and (point := self._choice()) is not None:
                limit, seconds = self._limit(), self._prices.seconds(point)
                self._under_way[point] = time.perf_counter(), seconds
                machines.start(point, cold_run.carry_out, Order(order.files, point, limit, order.effort))
            if not self._under_way:
                return
            self._ended(machines.next(self._tick))

    def _ended(self, answer: Answer) -> None:
        _, predicted = self._under_way.pop(answer.key)
        run = answer.value or KeptRun(
            settings=answer.key, status=FAILED, reason=answer.reason, version=environment.version()
        )
        self._runs[run.settings] = run.model_copy(update={"predicted_seconds": predicted, "where": answer.where})
        self._shelf.put(self._runs[run.settings])
        self._prices.learn(self._runs.values())
        self._tabulate()

    def publish(self) -> Table:
        """Write all four files."""
        table = self._tabulate()
        tradeoff_page.write(table, self._base, self._folder)
        return table

    def _tabulate(self) -> Table:
        """Write the table of the runs so far, and of those that are left."""
        order = self._order()
        table = results.table(
            self._base,
            self._knobs,
            {point: self._runs[point] for point in order if point in self._runs},
            budget=self._budget,
            not_run={point: self._prices.seconds(point) for point in order if point not in self._runs},
            seeds_matter=seed_matters(self._base, self._knobs, self._runs.get),
        )
        results.write(table, self._folder)
        return table

    def _order(self) -> list[Settings]:
        return run_order(self._base, self._knobs, lambda point: self._runs.get(point) or self._shelf.find(point))

    def _choice(self) -> Settings | None:
        """The most important run that fits into what is left; the first run always does."""
        free = (p for p in self._order() if p not in self._runs and p not in self._under_way)
        left = math.inf if self._nothing_yet() else self._left()
        return next((p for p in free if LEEWAY * self._prices.seconds(p) <= left), None)

    def _nothing_yet(self) -> bool:
        return not self._runs and not self._under_way

    def _left(self) -> float:
        """Seconds of the budget, less those that the runs under way are predicted to take."""
        return self._budget - self._spent() - LEEWAY * sum(predicted for _, predicted in self._under_way.values())

    def _limit(self) -> float:
        """Seconds after which a run is ended that begins now; the first run never is: without it there is nothing."""
        return math.inf if self._nothing_yet() else self._left() + OVER * self._budget

    def _spent(self) -> float:
        return sum(run.cost_seconds for run in self._runs.values())

    def _tick(self) -> None:
        """The bar: of the budget that was left when this sweep began."""
        point, more = next(iter(self._under_way)), len(self._under_way) - 1
        text = f"run {len(self._runs) + 1}: {words(point)}{f' and {more} more' if more else ''}"
        total, now = max(self._budget - self._earlier, 1.0), time.perf_counter()
        used = self._spent() - self._earlier + sum(now - began for began, _ in self._under_way.values())
        self._told(STAGE, round(min(used, 0.999 * total)), max(round(total), 1), text)


class RunPrices:
    """Prices of the kinds of work in seconds: those that `plan` predicts with, moved to the seconds of the runs."""

    def __init__(self, base: Scene) -> None:
        self._work = cache(partial(work_of, base))
        self._prices = UNIT * _starting_prices()

    def learn(self, runs: Iterable[KeptRun]) -> None:
        """Non-negative least squares of (work @ prices) / took = 1, with TRUST in the prices as they start."""
        done, start = [run for run in runs if run.done], _starting_prices()
        if not done:
            return
        unit = float(np.median([run.kernel_seconds or UNIT for run in done]))
        work = np.array([self._work(run.settings) / run.cost_seconds for run in done]) * unit
        pace = float(np.median(1 / (work @ start)))  # of this machine, or of a quicker program
        steps = np.where(start > 0, start, np.median(start[start > 0]))  # by which each price may easily move
        held = np.sqrt(TRUST) * np.eye(len(start))
        wanted = np.concatenate([np.ones(len(done)), held @ (start / steps)])
        found, _ = nnls(np.vstack([work * pace * steps, held]), wanted)
        self._prices = unit * pace * steps * found

    def seconds(self, point: Settings) -> float:
        """Seconds of the budget that a run will take."""
        return float(self._work(point) @ self._prices)


def _starting_prices() -> np.ndarray:
    known = fitted()["prices"]
    prices = {name: known[name] * (1.0 if kind.unit == "tubes" else SERIAL) for name, kind in KINDS.items()}
    prices |= {"start": prices["start"] + JUDGING, "steps of Adam": ADAM}
    return np.array(list(prices.values()))


def work_of(scene: Scene, point: Settings) -> np.ndarray:
    """Amounts of each of KINDS that a run has; only the start of a run that is refused."""
    try:
        found = amounts(scene.changed(dict(point)))
    except SceneError:
        found = {"start": 1.0}
    return np.array([found.get(name, 0.0) for name in KINDS])
