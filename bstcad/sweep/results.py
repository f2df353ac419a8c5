"""The results of a sweep: the Pareto front, each knob's points, and all runs, as tradeoff.json and tradeoff.csv.

tradeoff.json has the entries of Table.  tradeoff.csv has a line a run; its columns are COLUMNS, by the same names.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
FEWEST = 3  # runs of a front along which halving has a price: two make a line whatever they are
COLUMNS = (
    "knobs", "settings", "status", "seconds", "cpu_seconds", "kernel_seconds", "units", "rrmsd", "rrmsd_noise",
    "rrmsd_reported", "peak_memory_gb", "on_front", "predicted_seconds", "cost_seconds", "where", "reason",
)  # fmt: skip


class TableRun(Run):
    """A run; seconds are null where it was not run."""

    seconds: float | None
    cpu_seconds: float | None
    kernel_seconds: float | None
    cost_seconds: float | None
    label: str  # in words: "Ray tubes a side: 768"
    knobs: tuple[str, ...]  # keys of the knobs that it is a point of; "base": of all
    units: float | None  # seconds / kernel_seconds
    on_front: bool


class Place(Stored):
    """A point of a knob over all its seeds: medians, and the range of the error."""

    label: str
    settings: StoredSettings
    seconds: float | None  # None: seconds do not compare
    rrmsd: float
    lowest: float
    highest: float
    seeds: int


class TableKnob(Stored):
    """A knob and those of its points that were run."""

    key: str
    title: str
    places: tuple[Place, ...]  # from little work to much


class Base(Stored):
    """The scene as it stands."""

    quality: str
    control_points: int
    pixels: tuple[int, int]
    knobs: dict[str, Any]  # tailoring as resolved


class Reference(Stored):
    """The judge of all runs."""

    rays: tuple[int, ...]  # numbers of rays that it took, the least first
    what: str  # in words


class Calibration(Stored):
    """Seconds of the calibration kernel over the sweep."""

    seconds: float | None  # median
    lowest: float | None
    highest: float | None
    what: str  # in words


class Preset(Stored):
    """A quality preset that was run."""

    name: str
    seconds: float | None
    rrmsd: float


class Table(Stored):
    """All results of a sweep."""

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
    runs: tuple[TableRun, ...]  # the most important first
    knobs: tuple[TableKnob, ...]
    front: tuple[StoredSettings, ...]  # of the runs that no other beats, the quickest first
    front_halving: float | None  # factor on the time that halves the error along the front
    presets: tuple[Preset, ...]
    seeds: dict[str, bool | None]  # by method: did another seed give another lens?  null: not measured
    history: tuple[HistoryPoint, ...]  # of the base's run, by its own tubes

    @property
    def lenses(self) -> list[TableRun]:
        """The runs with a lens, wherever they took place."""
        return [run for run in self.runs if run.done]

    @property
    def shown(self) -> list[TableRun]:
        """The runs of the figure: those whose seconds compare, or all if none do."""
        return [run for run in self.lenses if self.errors_alone or comparable(run)]

    @property
    def best(self) -> list[TableRun]:
        """The runs of the Pareto front, the quickest first."""
        return sorted((run for run in self.runs if run.on_front), key=lambda run: run.seconds)

    @property
    def own(self) -> TableRun | None:
        """The run of the scene as it stands; None: not run, or failed."""
        return next((run for run in self.shown if not run.settings), None)

    @property
    def failed(self) -> list[TableRun]:
        """The runs without a lens."""
        return [run for run in self.runs if not run.done and run.status != NOT_RUN]

    @property
    def not_run(self) -> list[TableRun]:
        """The runs that did not fit into the budget."""
        return [run for run in self.runs if run.status == NOT_RUN]

    @property
    def elsewhere(self) -> bool:
        """Did a run take place on another machine?"""
        return any(run.where not in (HERE, "") for run in self.runs)


def comparable(run: Run) -> bool:
    """Do its seconds compare?  Those of this machine do, where one run follows the other."""
    return run.done and run.where == HERE


def front(runs: Iterable[Run]) -> list[Run]:
    """The Pareto front: the runs that no other beats in both time and error, the quickest first."""
    found: list[Run] = []
    for run in sorted(filter(comparable, runs), key=lambda run: (run.seconds, run.rrmsd)):
        if not found or run.rrmsd < found[-1].rrmsd:
            found.append(run)
    return found


def halving(front: Sequence[Run]) -> float | None:
    """k = 2^(-d ln t / d ln e) by least squares: the factor on the time t that halves the error e along a front.

    None: fewer than FEWEST runs.
    """
    if len(front) < FEWEST:
        return None
    errors, times = [math.log(run.rrmsd) for run in front], [math.log(run.seconds) for run in front]
    return 2.0 ** -statistics.linear_regression(errors, times).slope


def places(knob: Knob, runs: Mapping[Settings, Run], seeds: Sequence[int], timed: bool = True) -> tuple[Place, ...]:
    """The points of a knob that were run; seeds: beside the scene's own; timed: do seconds compare?"""
    found = []
    for point in knob.points:
        wanted = (point.settings, *(with_seed(point.settings, seed) for seed in seeds))
        if done := [runs[each] for each in wanted if each in runs and runs[each].done]:
            errors, seconds = [run.rrmsd for run in done], statistics.median(run.seconds for run in done)
            place = Place(
                label=point.label, settings=point.settings, seconds=seconds if timed else None,
                rrmsd=statistics.median(errors), lowest=min(errors), highest=max(errors), seeds=len(done),
            )  # fmt: skip
            found.append(place)
    return tuple(found)


def table(
    scene: Scene, knobs: Sequence[Knob], runs: Mapping[Settings, KeptRun], *, budget: float = math.inf,
    not_run: Mapping[Settings, float] | None = None, seeds_matter: Mapping[str, bool | None] | None = None,
) -> Table:  # fmt: skip
    """The results of these runs of a scene and its knobs; not_run: predicted seconds of the others."""
    lenses = {point: run for point, run in runs.items() if run.done}
    timed = {point: run for point, run in lenses.items() if comparable(run)}
    shown, own, best = timed or lenses, scene.lens.back.control_points, front(runs.values())
    base = shown.get(())
    of_all = base or next(iter(shown.values()), None)  # whose machine stands for all
    presets = next(knob for knob in knobs if knob.key == "quality").points
    return Table(
        name=scene.name,
        title=scene.title,
        base=Base(
            quality=scene.tailoring.quality,
            control_points=own,
            pixels=scene.target.columns_rows,
            knobs=scene.tailoring.resolved(own).model_dump(exclude_none=True),
        ),
        budget_seconds=budget,
        spent_seconds=sum(run.cost_seconds for run in runs.values()),
        errors_alone=bool(lenses) and not timed,
        version=bstcad.__version__,
        sources=next((run.version for run in runs.values()), ""),
        machine=of_all.machine if of_all else {},
        versions=of_all.versions if of_all else {},
        reference=_reference(scene, runs.values()),
        calibration=_calibration(timed.values()),
        runs=tuple(_runs(scene, knobs, runs, best=best, not_run=not_run or {})),
        knobs=tuple(
            TableKnob(key=knob.key, title=knob.title, places=places(knob, shown, seeds(scene), bool(timed)))
            for knob in knobs
        ),
        front=tuple(run.settings for run in best),
        front_halving=halving(best),
        presets=tuple(
            Preset(name=point.label, seconds=shown[point.settings].seconds if timed else None,
                   rrmsd=shown[point.settings].rrmsd)
            for point in presets if point.settings in shown
        ),
        seeds=dict(seeds_matter or {}),
        history=base.history if base and timed else (),
    )  # fmt: skip


def _reference(scene: Scene, runs: Iterable[Run]) -> Reference:
    columns, rows = scene.target.columns_rows
    what = (
        f"stratified rays that tailoring never saw, in independent sets, until the standard error is below "
        f"{REFERENCE.accuracy:.2%} of the RRMSD; {columns} x {rows} pixels; the lens as read back from its folder"
    )
    return Reference(rays=tuple(sorted({run.rays for run in runs if run.rays})), what=what)


def _calibration(runs: Iterable[Run]) -> Calibration:
    seconds = [run.kernel_seconds for run in runs if run.kernel_seconds]
    return Calibration(
        seconds=statistics.median(seconds) if seconds else None,
        lowest=min(seconds, default=None),
        highest=max(seconds, default=None),
        what=f"merit and gradient of {TUBES}² ray tubes through a fixed lens of 257² control points, 512² "
        "pixels; the least of three, in the process of the sweep, before each run",
    )


def _runs(
    scene: Scene, knobs: Sequence[Knob], runs: Mapping[Settings, KeptRun], *, best: Sequence[Run],
    not_run: Mapping[Settings, float],
) -> Iterator[TableRun]:  # fmt: skip
    labels, keys = _labels(scene, knobs), {}
    for knob in knobs:
        for point in knob.points:
            keys.setdefault(point.settings, []).append(knob.key)
    unknown = dict.fromkeys(("seconds", "cpu_seconds", "kernel_seconds", "cost_seconds"))
    waiting = {
        point: {"settings": point, "status": NOT_RUN, "where": "", "predicted_seconds": seconds} | unknown
        for point, seconds in not_run.items()
    }
    ran = {point: {name: getattr(run, name) for name in Run.model_fields} for point, run in runs.items()}
    on_front = {run.settings for run in best}
    for point, entries in (ran | waiting).items():
        without = tuple(entry for entry in point if entry[0] != "tailoring.seed")
        yield TableRun(
            **entries,
            label=labels.get(point) or words(point),
            knobs=tuple(keys.get(without, ())) if without else ("base",),
            units=entries["seconds"] / entries["kernel_seconds"] if entries["kernel_seconds"] else None,
            on_front=point in on_front,
        )


def _labels(scene: Scene, knobs: Sequence[Knob]) -> dict[Settings, str]:
    labels: dict[Settings, str] = {(): f"{scene.tailoring.quality} (the scene as it stands)"}
    for knob in knobs:
        for point in knob.points:
            name = point.label if knob.key == "quality" else f"{knob.title}: {point.label}"
            labels.setdefault(point.settings, name)
            for seed in seeds(scene):
                labels.setdefault(with_seed(point.settings, seed), f"{name}, seed {seed}")
    return labels


def write(table: Table, folder: Path) -> None:
    """Write tradeoff.json and tradeoff.csv."""
    io.put_rounded(folder / "tradeoff.json", table)
    runs = io.rounded([run.model_dump(mode="json") for run in table.runs])
    changes = ("; ".join(f"{key} = {value}" for key, value in run["settings"].items()) for run in runs)
    cells = ({"knobs": "; ".join(run["knobs"]), "settings": text} for run, text in zip(runs, changes, strict=True))
    io.table(folder / "tradeoff.csv", COLUMNS, (run | cell for run, cell in zip(runs, cells, strict=True)))
