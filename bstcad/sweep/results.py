"""The results of a sweep: the runs that no other beats, each knob's points, and both as tradeoff.json and tradeoff.csv.

tradeoff.csv has a line a run; its columns are COLUMNS, by the names of tradeoff.json, whose entries are those of Table.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import bstcad
from bstcad.scene.scene import Scene
from bstcad.sweep import io
from bstcad.sweep.cold_run import HERE, REFERENCE, HistoryPoint, KeptRun, Run, StoredSettings
from bstcad.sweep.io import Stored
from bstcad.sweep.knobs import Knob, Settings, seeds, with_seed, words
from bstcad.sweep.work import TUBES

NOT_RUN = "not run: budget"
SAME_ERROR = 1.02  # factor below which nobody can tell two errors apart
FEWEST = 3  # runs of a front along which halving has a price: two make a line whatever they are
COLUMNS = (
    "knobs", "settings", "status", "seconds", "cpu_seconds", "kernel_seconds", "units", "rrmsd", "rrmsd_noise",
    "rrmsd_reported", "peak_memory_gb", "on_front", "predicted_seconds", "cost_seconds", "where", "reason",
)  # fmt: skip


def front(runs: Iterable[Run]) -> list[Run]:
    """The Pareto front: the runs that no other beats in both time and error, the quickest first."""
    found: list[Run] = []
    for run in sorted(filter(comparable, runs), key=lambda run: (run.seconds, run.rrmsd)):
        if not found or run.rrmsd < found[-1].rrmsd:
            found.append(run)
    return found


def comparable(run: Run) -> bool:
    """Do its seconds compare?  Those of this machine do, where one run follows the other."""
    return run.done and run.where == HERE


def halving(front: Sequence[Run]) -> float | None:
    """k = 2^(-d ln t / d ln e) by least squares: the factor on the time t that halves the error e along a front.

    None: fewer than FEWEST runs.
    """
    if len(front) < FEWEST:
        return None
    errors, times = [math.log(run.rrmsd) for run in front], [math.log(run.seconds) for run in front]
    return 2.0 ** -statistics.linear_regression(errors, times).slope


class Place(Stored):
    """A point of a knob over all its seeds: medians, and the range of the error."""

    label: str
    settings: StoredSettings
    seconds: float | None  # None: seconds do not compare
    rrmsd: float
    lowest: float
    highest: float
    seeds: int


@dataclass(frozen=True)
class Turned:
    """A knob and those of its points that were run."""

    knob: Knob
    places: tuple[Place, ...]  # from little work to much


def turned(knob: Knob, runs: Mapping[Settings, Run], seeds: Sequence[int], timed: bool = True) -> Turned:
    """The places of a knob; seeds: beside the scene's own; timed: do seconds compare?"""
    places = []
    for point in knob.points:
        wanted = (point.settings, *(with_seed(point.settings, seed) for seed in seeds))
        if done := [runs[each] for each in wanted if each in runs and runs[each].done]:
            errors, seconds = [run.rrmsd for run in done], [run.seconds for run in done]
            places.append(
                Place(
                    label=point.label, settings=point.settings, seconds=statistics.median(seconds) if timed else None,
                    rrmsd=statistics.median(errors), lowest=min(errors), highest=max(errors), seeds=len(done),
                )
            )  # fmt: skip
    return Turned(knob, tuple(places))


class Calibration(Stored):
    """The calibration kernel over a sweep."""

    seconds: float | None  # median
    lowest: float | None
    highest: float | None
    what: str  # in words


@dataclass(frozen=True)
class Planned:
    """A run that did not fit into the budget."""

    settings: Settings
    predicted_seconds: float


@dataclass(frozen=True)
class Sweep:
    """All runs of a sweep."""

    scene: Scene  # the base
    knobs: tuple[Knob, ...]
    budget: float  # seconds, of all runs together
    runs: Mapping[Settings, KeptRun]  # in the order of their importance
    not_run: tuple[Planned, ...] = ()
    seed_matters: Mapping[str, bool | None] = field(default_factory=dict)  # by method; None: not measured

    @property
    def spent(self) -> float:
        """Seconds of the budget that are used up."""
        return sum(run.cost_seconds for run in self.runs.values())

    @cached_property
    def lenses(self) -> dict[Settings, KeptRun]:
        """The runs with a lens, wherever they took place: their errors compare."""
        return {point: run for point, run in self.runs.items() if run.done}

    @cached_property
    def errors_alone(self) -> bool:
        """Is every lens from another machine, so that no seconds compare?"""
        return bool(self.lenses) and not any(map(comparable, self.lenses.values()))

    @cached_property
    def shown(self) -> dict[Settings, KeptRun]:
        """The runs of the figure."""
        return {point: run for point, run in self.lenses.items() if self.errors_alone or comparable(run)}

    @property
    def failed(self) -> list[KeptRun]:
        """The runs without a lens."""
        return [run for run in self.runs.values() if not run.done]

    @property
    def elsewhere(self) -> bool:
        """Did a run take place on another machine?"""
        return any(run.where != HERE for run in self.runs.values())

    @property
    def base(self) -> KeptRun | None:
        """The run of the scene as it stands; None: not run, or failed."""
        return self.shown.get(())

    @cached_property
    def front(self) -> list[KeptRun]:
        """The runs that no other beats."""
        return front(self.runs.values())

    @cached_property
    def turned(self) -> list[Turned]:
        """Each knob."""
        timed = not self.errors_alone
        return [turned(knob, self.shown, seeds(self.scene), timed) for knob in self.knobs]

    @cached_property
    def presets(self) -> dict[str, KeptRun]:
        """The presets that were run, by name."""
        quality = next(knob for knob in self.knobs if knob.key == "quality")
        return {point.label: self.shown[point.settings] for point in quality.points if point.settings in self.shown}

    @cached_property
    def _labels(self) -> dict[Settings, str]:
        labels: dict[Settings, str] = {(): f"{self.scene.tailoring.quality} (the scene as it stands)"}
        for knob in self.knobs:
            for point in knob.points:
                name = point.label if knob.key == "quality" else f"{knob.title}: {point.label}"
                labels.setdefault(point.settings, name)
                for seed in seeds(self.scene):
                    labels.setdefault(with_seed(point.settings, seed), f"{name}, seed {seed}")
        return labels

    def label(self, point: Settings) -> str:
        """A run in words: "Ray tubes a side: 768"."""
        return self._labels.get(point) or words(point)

    @property
    def history(self) -> tuple[HistoryPoint, ...]:
        """Convergence of the base's run."""
        return self.base.history if self.base and not self.errors_alone else ()

    @property
    def reference(self) -> str:
        """The judge, in words."""
        columns, rows = self.scene.target.columns_rows
        return (
            f"stratified rays that tailoring never saw, in independent sets, until the standard error is below "
            f"{REFERENCE.accuracy:.2%} of the RRMSD; {columns} x {rows} pixels; the lens as read back from its folder"
        )

    @cached_property
    def calibration(self) -> Calibration:
        """The calibration kernel during the sweep."""
        seconds = [run.kernel_seconds for run in self.lenses.values() if comparable(run) and run.kernel_seconds]
        return Calibration(
            seconds=statistics.median(seconds) if seconds else None,
            lowest=min(seconds, default=None),
            highest=max(seconds, default=None),
            what=f"merit and gradient of {TUBES}² ray tubes through a fixed lens of 257² control points, 512² "
            "pixels; the least of three, in the process of the sweep, before each run",
        )

    @cached_property
    def machine(self) -> KeptRun | None:
        """A run whose machine and versions stand for all: the base's, if it was run."""
        return self.base or next(iter(self.shown.values()), None)


# --- tradeoff.json and tradeoff.csv ---------------------------------------------------------------------------------


class TableRun(Run):
    """A run in tradeoff.json; figures are null where it was not run."""

    seconds: float | None
    cpu_seconds: float | None
    kernel_seconds: float | None
    cost_seconds: float | None
    knobs: tuple[str, ...]  # keys of the knobs that it is a point of; "base": of all
    units: float | None  # seconds / kernel_seconds
    on_front: bool


class TableKnob(Stored):
    """A knob."""

    key: str
    title: str
    places: tuple[Place, ...]


class Base(Stored):
    """The base of a sweep."""

    quality: str
    control_points: int
    pixels: tuple[int, int]
    knobs: dict[str, Any]  # tailoring as resolved


class Reference(Stored):
    """The judge of all runs."""

    rays: tuple[int, ...]  # numbers of rays that it took, the least first
    what: str  # in words


class Preset(Stored):
    """A quality preset."""

    name: str
    seconds: float | None
    rrmsd: float


class Table(Stored):
    """tradeoff.json."""

    name: str
    title: str
    base: Base
    budget_seconds: float
    spent_seconds: float
    errors_alone: bool  # every lens is from another machine: there are no seconds and no front
    version: str  # of bstcad
    sources: str  # the same with a hash of its sources
    machine: dict[str, Any]
    versions: dict[str, str]
    reference: Reference
    calibration: Calibration
    runs: tuple[TableRun, ...]
    knobs: tuple[TableKnob, ...]
    front: tuple[StoredSettings, ...]  # the quickest first
    front_halving: float | None  # factor on the time that halves the error along the front
    presets: tuple[Preset, ...]
    seeds: dict[str, bool | None]  # by method: did another seed give another lens?  null: not measured
    history: tuple[HistoryPoint, ...]  # of the base's run, by its own tubes


def write(sweep: Sweep, folder: Path) -> None:
    """Write tradeoff.json and tradeoff.csv."""
    table = table_of(sweep)
    io.put_rounded(folder / "tradeoff.json", table)
    lines = (run | _cells(run) for run in io.rounded([run.model_dump(mode="json") for run in table.runs]))
    io.table(folder / "tradeoff.csv", COLUMNS, lines)


def _cells(run: Mapping[str, Any]) -> dict[str, str]:
    changes = (f"{key} = {value}" for key, value in run["settings"].items())
    return {"knobs": "; ".join(run["knobs"]), "settings": "; ".join(changes)}


def table_of(sweep: Sweep) -> Table:
    """The entries of tradeoff.json."""
    scene, own, machine = sweep.scene, sweep.scene.lens.back.control_points, sweep.machine
    return Table(
        name=scene.name,
        title=scene.title,
        base=Base(
            quality=scene.tailoring.quality,
            control_points=own,
            pixels=scene.target.columns_rows,
            knobs=scene.tailoring.resolved(own).model_dump(exclude_none=True),
        ),
        budget_seconds=sweep.budget,
        spent_seconds=sweep.spent,
        errors_alone=sweep.errors_alone,
        version=bstcad.__version__,
        sources=next((run.version for run in sweep.runs.values()), ""),
        machine=machine.machine if machine else {},
        versions=machine.versions if machine else {},
        reference=Reference(
            rays=tuple(sorted({run.rays for run in sweep.runs.values() if run.rays})), what=sweep.reference
        ),
        calibration=sweep.calibration,
        runs=tuple(_table_runs(sweep)),
        knobs=tuple(TableKnob(key=t.knob.key, title=t.knob.title, places=t.places) for t in sweep.turned),
        front=tuple(run.settings for run in sweep.front),
        front_halving=halving(sweep.front),
        presets=tuple(
            Preset(name=name, seconds=None if sweep.errors_alone else run.seconds, rrmsd=run.rrmsd)
            for name, run in sweep.presets.items()
        ),
        seeds=dict(sweep.seed_matters),
        history=sweep.history,
    )


def _table_runs(sweep: Sweep) -> Iterator[TableRun]:
    on_front = {run.settings for run in sweep.front}
    for point, run in sweep.runs.items():
        yield TableRun(
            **{name: getattr(run, name) for name in Run.model_fields},
            knobs=_knobs_of(sweep, point),
            units=run.seconds / run.kernel_seconds if run.kernel_seconds else None,
            on_front=point in on_front,
        )
    unknown = dict.fromkeys(("seconds", "cpu_seconds", "kernel_seconds", "cost_seconds", "units"))
    for planned in sweep.not_run:
        yield TableRun(
            settings=planned.settings, status=NOT_RUN, where="", predicted_seconds=planned.predicted_seconds,
            knobs=_knobs_of(sweep, planned.settings), on_front=False, **unknown,
        )  # fmt: skip


def _knobs_of(sweep: Sweep, point: Settings) -> tuple[str, ...]:
    """Keys of the knobs that a run is a point of, with whatever seed."""
    without = tuple(entry for entry in point if entry[0] != "tailoring.seed")
    if not without:
        return ("base",)
    return tuple(knob.key for knob in sweep.knobs if any(p.settings == without for p in knob.points))
