"""bstcad tradeoff: the cost of accuracy in time for a scene, by runs of it within a budget of seconds.

A run is the base scene with some settings: one knob at a time is turned, then those that go together.  The budget is
the sum of the seconds of all runs, wherever they take place, of every sweep in a folder.  A run that is
predicted not to fit is not begun; a run that takes longer is ended OVER beyond the budget.

The folder holds the base scene (scene/), the record of each run (runs/), and the results (results.py).  A run with a
record is not run again: a sweep that was stopped goes on, a larger budget goes further.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import bstcad
from bstcad.folder import SCENE, scene_files
from bstcad.optics.sides import Sides, as_pair, scaled
from bstcad.runs import environment, files
from bstcad.runs.cluster import Answer, Machines
from bstcad.runs.progress import ProgressFunction
from bstcad.scene.errors import SceneError
from bstcad.scene.quality import PRESETS
from bstcad.scene.scene import Scene
from bstcad.sweep import cold_run, results
from bstcad.sweep.cold_run import LocalPool, Run, Settings, Stored, Value, as_text, settings
from bstcad.sweep.net_choice import with_net
from bstcad.sweep.prediction import STARTED, usual
from bstcad.sweep.results import Calibration, Place, Preset, Table, TableKnob, front, halving

# --- knobs ------------------------------------------------------------------------------------------------------------

HALF, ROOT = 0.5, 0.5**0.5
NETS = (9, 1025)  # control points a side, least and most
GRIDS = (32, 2048)  # cells a side of a transport, least and most
PIXELS = (8, 4096)  # a side, least and most
COUNTS = (1, 16_384)  # of all else, least and most
ROUNDS = (1, 2, 3, 5, 8)  # of transport and slope fit in stage 1
ADAM = (1 / 8, 1 / 4, 1 / 2, 1.0)  # steps of Wang et al.'s procedure, as shares of the preset's
NET_KEY = "lens.back.control_points"

Points = Mapping[str, Settings]  # of a knob, by label ("768"), from little work to much


@dataclass(frozen=True)
class Knob:
    """A number or a choice that trades accuracy for time."""

    key: str  # for programs: "tubes"
    title: str  # "Ray tubes a side"
    points: Points
    combines: bool = False  # turns more than one key at a time


def other_seed(scene: Scene, point: Settings) -> Settings:
    """The settings with the seed after the scene's."""
    return settings({**dict(point), "tailoring.seed": scene.tailoring.seed + 1})


def words(point: Settings) -> str:
    """Settings as on the command line."""
    changes = (f"{key.removeprefix('tailoring.')} = {as_text(value)}" for key, value in point)
    return ", ".join(changes) or "the scene's own"


def knobs(scene: Scene) -> tuple[Knob, ...]:
    """All knobs of a scene, the most important first."""
    own = scene.lens.back.net
    known = scene.tailoring.resolved(own)
    adam = known.method == "adam"

    def shares(name: str, of: Iterable[float], limits: tuple[int, int] = COUNTS) -> Points:
        value = getattr(known, name)
        return _numbers(f"tailoring.{name}", value, (round(share * value) for share in of), limits)

    presets = PRESETS if _by_paper(scene) else [name for name in PRESETS if name != "paper"]
    nets = {own, *filter(_possible, (scaled(own, share) for share in (1 / 4, HALF, 1, 2, 4)))}
    every = (
        Knob("quality", "Quality presets", _choices("tailoring.quality", scene.tailoring.quality, presets)),
        Knob("evaluations", "Evaluations of stage 2", shares("stage2_iterations", (1 / 8, 1 / 4, HALF, 1, 2, 4))),
        Knob("tubes", "Rays a side" if adam else "Ray tubes a side",
             shares("rays", (1 / 4, HALF, ROOT, 1, 1 / ROOT, 2))),
        Knob("control_points", "Control points a side", _choices(NET_KEY, own, sorted(nets, key=as_pair))),
        Knob("adam", "Adam on control points, by rays", _adam(known.quality == "paper") if _by_paper(scene) else {}),
        Knob("precision", "Precision", _choices("tailoring.precision", known.precision, ("float32", "float64"))),
        Knob("pixels", "Pixels tailored to", _pixels(scene)),
        Knob("rounds", "Rounds of stage 1", {} if adam else _numbers("tailoring.rounds", known.rounds, ROUNDS)),
        Knob("transport_grid", "Transport grid, cells a side", shares("transport_grid", (1 / 4, HALF, 1, 2), GRIDS)),
        Knob("transport_iterations", "Transport iterations", shares("transport_iterations", (1 / 8, 1 / 4, 1, 2))),
        Knob("tubes_evaluations", "Tubes and evaluations together", _together(
            ("tailoring.rays", known.rays, (HALF, ROOT, 1, 1 / ROOT)),
            ("tailoring.stage2_iterations", known.stage2_iterations, (1 / 4, HALF, 1, 2))), combines=True),
        Knob("control_points_tubes", "Control points and tubes together", _together(
            (NET_KEY, own, (1 / 4, HALF, 1, 2)), ("tailoring.rays", known.rays, (1 / 4, HALF, 1, 2))), combines=True),
    )  # fmt: skip
    return tuple(knob for knob in every if len(knob.points) > 1)


def _by_paper(scene: Scene) -> bool:
    """Can the paper's procedure design the scene?  It knows one picture and one tailored face, and no bounds on it."""
    return _is_allowed(scene, {"tailoring.quality": "paper"})


def _is_allowed(scene: Scene, changes: Mapping[str, Any]) -> bool:
    """Does the scene allow these changes?"""
    try:
        scene.changed(changes)
    except SceneError:
        return False
    return True


def _choices(key: str, own: Value, values: Iterable[Value]) -> Points:
    return {as_text(value): () if value == own else ((key, value),) for value in values}


def _numbers(key: str, own: int, values: Iterable[int], limits: tuple[int, int] = COUNTS) -> Points:
    return _choices(key, own, sorted({own, *(value for value in values if limits[0] <= value <= limits[1])}))


def _possible(net: Sides) -> bool:
    """Is the net among those that are tried?"""
    return NETS[0] <= max(as_pair(net)) <= NETS[1]


def _pixels(scene: Scene) -> Points:
    """Coarser and finer pictures to tailor to, all targets' together; the lens is judged on the base's pixels."""
    own, points = [target.columns_rows for target in scene.targets], {}
    for share in (1 / 4, HALF, 1, 2):
        sizes = [(round(share * columns), round(share * rows)) for columns, rows in own]
        if share == 1 or all(PIXELS[0] <= min(size) and max(size) <= PIXELS[1] for size in sizes):
            values = [columns if columns == rows else (columns, rows) for columns, rows in sizes]
            changed = {f"{key}.pixels": value for key, value in zip(scene.target_keys, values, strict=True)}
            if share == 1 or _is_allowed(scene, changed):  # a profile may be too narrow for larger pixels
                points[" and ".join(map(as_text, values))] = () if share == 1 else settings(changed)
    return points


def _adam(own: bool) -> Points:
    """Wang et al.'s procedure with fewer steps; the last point is the preset."""
    points = {}
    for share in ADAM:
        steps = {name: round(share * PRESETS["paper"][name]) for name in ("stage1_iterations", "stage2_iterations")}
        fewer = {f"tailoring.{name}": count for name, count in steps.items()} if share < 1 else {}
        preset = {} if own else {"tailoring.quality": "paper"}
        points[f"{steps['stage1_iterations']} + {steps['stage2_iterations']}"] = settings(preset | fewer)
    return points


def _together(*turned: tuple[str, int, Sequence[float]]) -> Points:
    """Two keys in step: (key, the base's value, shares of that); of a net its spans are scaled."""
    points = {}
    for shares in zip(*(shares for _, _, shares in turned), strict=True):
        values = {
            key: own if share == 1 else scaled(own, share) if key == NET_KEY else max(1, round(share * own))
            for (key, own, _), share in zip(turned, shares, strict=True)
        }
        if NET_KEY not in values or _possible(values[NET_KEY]):
            changed = {key: values[key] for key, own, _ in turned if values[key] != own}
            points[" × ".join(map(str, values.values()))] = settings(changed)
    return points


# --- in which order ---------------------------------------------------------------------------------------------------


def run_order(scene: Scene, knobs: Sequence[Knob]) -> list[Settings]:
    """All runs, the most important first, so that any budget is well spent.

    Presets, neighbours of the base, other seeds, further points, the paper's procedure.
    """
    presets = knobs[0].points
    single = [knob for knob in knobs[1:] if not knob.combines]
    both = [knob for knob in knobs if knob.combines]
    paper = presets.get("paper", ())  # minutes

    def around(turned: Iterable[Knob], *steps: int) -> list[Settings]:
        return [point for away in steps for knob in turned for point in _neighbour(knob, away) if point != paper]

    order = [
        presets.get("draft", ()), (), presets.get("standard", ()), *around(single, -1),
        *(again for _, again in _probes(scene, knobs).values()), *around(both, -1), *around(single, +1),
        presets.get("fine", ()), *around(both, +1), *around(single, -2, -3, -4),
        *around(knobs[1:], 2, -2, 3, -3, 4, -4), paper,
    ]  # fmt: skip
    return list(dict.fromkeys(order))


def _neighbour(knob: Knob, away: int) -> list[Settings]:
    """The point so far from the base, if there is one.

    Of a knob without the base the first point stands for the neighbour with less work, the second for more.
    """
    points = list(knob.points.values())
    start = points.index(()) if () in points else 1 if away == -1 else 0 if away > 0 else -1
    return points[start + away : start + away + 1] if start + away >= 0 else []


def _probes(scene: Scene, knobs: Sequence[Knob]) -> dict[str, tuple[Settings, Settings]]:
    """By method a cheap run, and the same run with another seed."""
    by_key = {knob.key: knob.points for knob in knobs}
    quick = {"least-squares": by_key["quality"].get("draft"), "adam": next(iter(by_key.get("adam", {}).values()), None)}
    return {method: (point, other_seed(scene, point)) for method, point in quick.items() if point is not None}


def seed_matters(scene: Scene, knobs: Sequence[Knob], runs: Mapping[Settings, Run]) -> dict[str, bool | None]:
    """By method: does another seed give another lens?  None: not measured."""
    nets = {
        method: [runs[point].net for point in pair if point in runs and runs[point].done]
        for method, pair in _probes(scene, knobs).items()
    }
    return {method: found[0] != found[1] if len(found) == 2 else None for method, found in nets.items()}


# --- the sweep --------------------------------------------------------------------------------------------------------

LEEWAY = 1.1  # a run starts if so many times its predicted seconds are left
OVER = 0.1  # of the budget, by which a run may go beyond it that takes longer than predicted
MORE = 1.5  # times as long a run may take that was ended before and is begun again
JUDGE = (
    "stratified rays that tailoring never saw, in independent sets, until the standard error is below {:.2%} of the "
    "RRMSD; {} pixels; the lens as read back from its folder"
)
UNKNOWN = dict.fromkeys(("seconds", "cpu_seconds", "kernel_seconds", "cost_seconds"))  # of a run that was not run


class RunFile(Stored):
    """The runs of a sweep by one version of bstcad."""

    runs: tuple[Run, ...]


def tradeoff(
    scene: Scene, folder: Path, *, budget: float, progress: ProgressFunction = lambda *told: None,
    machines: Machines | None = None, effort: cold_run.Effort = cold_run.REFERENCE,
) -> Table:  # fmt: skip
    """Run the most important runs that the budget allows, and write tradeoff.csv, .json, .png and .html.

    machines: where the runs take place; None: here.  effort: of the reference that judges.  The two tables are written
    after each run, so that they are there however a sweep ends.
    """
    scene = scene.changed({"tailoring.accuracy": None, "tailoring.max_time": None})  # which end a design early
    base, _ = with_net(scene)
    contents = scene_files(base)
    check_free(folder, contents)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with files.exclusive(folder):
        for place in (folder / "scene", folder / "runs"):
            place.mkdir(parents=True, exist_ok=True)
        for name, data in contents.items():
            files.put(folder / "scene" / name, data)
        search = _Search(base, budget, folder, progress)
        try:
            search.run(machines, contents, effort)
        except BaseException as error:
            if count := len(search.runs):
                kept = "1 run is" if count == 1 else f"{count} runs are"
                error.add_note(f"{kept} kept in {folder}; the same command goes on from there")
                if isinstance(error, KeyboardInterrupt):  # there is time for a figure
                    results.write_page(search.table(), base, folder)
            raise
        found = search.table()
        results.write_page(found, base, folder)
        return found


def check_free(folder: Path, contents: Mapping[str, bytes]) -> None:
    """SceneError unless the sweep of this scene may take the folder: new, empty, or begun by this sweep."""
    try:
        files.check_free(folder, [f"scene/{SCENE}"], "a sweep's")
    except ValueError as error:
        raise SceneError(f"{error} with -o") from None
    paths = {folder / "scene" / name: data for name, data in contents.items()}
    there = folder / "scene" / SCENE
    if there.is_file() and any(not path.is_file() or path.read_bytes() != data for path, data in paths.items()):
        raise SceneError(
            f"{folder}: holds the sweep of another scene, which stands in {there}; give another folder with -o, or "
            "remove that one"
        )


class _Search:
    """A sweep under way."""

    def __init__(self, base: Scene, budget: float, folder: Path, progress: ProgressFunction) -> None:
        self._base, self._budget, self._folder, self._progress = base, budget, folder, progress
        self._knobs = knobs(base)
        self._order, self._work = run_order(base, self._knobs), cache(partial(work_of, base))
        self._under_way: dict[Settings, tuple[float, float]] = {}  # when it began, seconds predicted
        self._file = folder / "runs" / f"{environment.version()}.json"
        kept = (
            cold_run.read(RunFile, self._file, "remove it, and its runs are done again")
            if self._file.is_file()
            else None
        )
        self.runs = {run.settings: run for run in kept.runs} if kept else {}  # that have ended
        for point, run in list(self.runs.items()):
            if run.allowed_seconds is not None:  # it was ended; is there more time for it now?
                left = budget - self._spent() + run.cost_seconds
                if left + OVER * budget >= MORE * run.allowed_seconds:
                    del self.runs[point]
        self._earlier = self._spent()  # by the earlier sweeps in the folder

    def run(self, machines: Machines | None, contents: Mapping[str, bytes], effort: cold_run.Effort) -> None:
        """Until no run is left that fits."""
        if self._choice() is None:
            return
        with ExitStack() as stack:
            if machines is None:  # one run at a time, so that none disturbs another
                cold_run.warm_up(contents, lambda: self._progress("warm-up", 0, 0, "kernels are compiled, files read"))
                machines = stack.enter_context(LocalPool(1))
            while True:
                while len(self._under_way) < machines.capacity and (point := self._choice()) is not None:
                    # The first run is never ended for time: without it there is nothing.
                    limit = self._left() + OVER * self._budget if self.runs or self._under_way else math.inf
                    self._under_way[point] = time.perf_counter(), self._predicted(point)
                    machines.start(point, cold_run.carry_out, contents, point, limit, effort)
                if not self._under_way:
                    return
                self._ended(machines.next(self._tick))

    def _ended(self, answer: Answer) -> None:
        _, predicted = self._under_way.pop(answer.key)
        failed = {"status": cold_run.FAILED, "reason": answer.reason, "version": environment.version()}
        run = answer.value or Run(settings=answer.key, **failed)
        self.runs[answer.key] = run.model_copy(update={"predicted_seconds": predicted, "where": answer.where})
        kept = (run for run in self.runs.values() if run.cost_seconds)  # others did not take place, and are tried again
        cold_run.put(self._file, RunFile(runs=tuple(kept)))
        self.table()

    def table(self) -> Table:
        """The table of the runs so far, and of those that are left; it is written, too."""
        waiting = [
            Run(settings=point, status=cold_run.NOT_RUN, where="", predicted_seconds=self._predicted(point), **UNKNOWN)
            for point in self._order
            if point not in self.runs
        ]
        runs = [self.runs[point] for point in self._order if point in self.runs]
        found = table(self._base, self._knobs, runs, waiting, budget=self._budget)
        results.write(found, self._folder)
        return found

    def _choice(self) -> Settings | None:
        """The most important run that fits into what is left; the first run always does."""
        free = (point for point in self._order if point not in self.runs and point not in self._under_way)
        left = self._left() if self.runs or self._under_way else math.inf
        return next((point for point in free if LEEWAY * self._predicted(point) <= left), None)

    def _predicted(self, point: Settings) -> float:
        """Seconds of the budget that a run will take: those by `plan` times the pace of the runs of its method."""
        adam, seconds = self._work(point)
        paces: dict[bool, list[float]] = {True: [], False: []}
        for run in filter(lambda run: run.done, self.runs.values()):
            by_adam, expected = self._work(run.settings)
            paces[by_adam].append(run.cost_seconds / expected)
        return seconds * statistics.median(paces[adam] or paces[not adam] or [1.0])

    def _left(self) -> float:
        """Seconds left of the budget when the runs under way have taken their predicted seconds."""
        return self._budget - self._spent() - LEEWAY * sum(predicted for _, predicted in self._under_way.values())

    def _spent(self) -> float:
        return sum(run.cost_seconds for run in self.runs.values())

    def _tick(self) -> None:
        """The bar: of the budget that was left when this sweep began."""
        point, more = next(iter(self._under_way)), len(self._under_way) - 1
        text = f"run {len(self.runs) + 1}: {words(point)}{f' and {more} more' if more else ''}"
        total, now = max(self._budget - self._earlier, 1.0), time.perf_counter()
        used = self._spent() - self._earlier + sum(now - began for began, _ in self._under_way.values())
        self._progress("tradeoff", round(min(used, 0.999 * total)), max(round(total), 1), text)


# --- predicted seconds of runs ----------------------------------------------------------------------------------------

JUDGING = 2.0  # seconds of judging a lens


def work_of(scene: Scene, point: Settings) -> tuple[bool, float]:
    """(by the paper's procedure?, seconds on a machine of pace 1); a run that is refused has its start alone."""
    try:
        changed = scene.changed(dict(point))
    except SceneError:
        return False, STARTED + JUDGING
    return changed.tailoring.resolved(changed.lens.back.net).method == "adam", usual(changed).total + JUDGING


# --- the table --------------------------------------------------------------------------------------------------------


def table(
    scene: Scene, knobs: Sequence[Knob], runs: Sequence[Run], waiting: Sequence[Run] = (), *, budget: float = math.inf
) -> Table:
    """The results of the runs of a scene that have ended, and of those that wait, both by their importance."""
    own, best = scene.lens.back.net, front(runs)
    timed = {run.settings: run for run in runs if run.comparable}
    shown = timed or {run.settings: run for run in runs if run.done}
    of_all = shown.get(()) or next(iter(shown.values()), None)  # whose machine stands for all
    unit = [run.kernel_seconds for run in timed.values() if run.kernel_seconds]
    on_front, labels = tuple(run.settings for run in best), _labels(scene, knobs)
    return Table(
        name=scene.name,
        title=scene.title,
        base={
            "quality": scene.tailoring.quality, "control_points": own, "pixels": scene.target.columns_rows,
            "knobs": scene.tailoring.resolved(own).model_dump(exclude_none=True),
        },
        budget_seconds=budget,
        spent_seconds=sum(run.cost_seconds for run in runs),
        errors_alone=bool(shown) and not timed,
        version=bstcad.__version__,
        sources=next((run.version for run in runs), ""),
        machine=of_all.machine if of_all else {},
        versions=of_all.versions if of_all else {},
        reference={
            "rays": sorted({run.rays for run in runs if run.rays}),
            "what": JUDGE.format(cold_run.REFERENCE.accuracy, _judged_on(scene)),
        },
        calibration=Calibration(
            seconds=statistics.median(unit) if unit else None, lowest=min(unit, default=None),
            highest=max(unit, default=None),
        ),
        runs=tuple(
            run.model_copy(update={
                "label": labels.get(run.settings) or words(run.settings),
                "knobs": _turned(knobs, run.settings), "on_front": run.settings in on_front,
            }) for run in (*runs, *waiting)
        ),
        knobs=tuple(
            TableKnob(key=knob.key, title=knob.title, places=places(scene, knob, shown, timed=bool(timed)))
            for knob in knobs
        ),
        front=on_front,
        front_halving=halving(best),
        presets=tuple(
            Preset(name=name, seconds=shown[point].seconds if timed else None, rrmsd=shown[point].rrmsd)
            for name, point in knobs[0].points.items() if point in shown
        ),
        seeds=seed_matters(scene, knobs, {run.settings: run for run in runs}),
        history=timed[()].history if () in timed else (),
    )  # fmt: skip


def _judged_on(scene: Scene) -> str:
    """The pixels of the reference; "64 x 48"."""
    sizes = " and ".join("{} x {}".format(*target.columns_rows) for target in scene.targets)
    return f"the target with the largest RRMSD, of {sizes}" if len(scene.targets) > 1 else sizes


def places(scene: Scene, knob: Knob, runs: Mapping[Settings, Run], timed: bool = True) -> tuple[Place, ...]:
    """The points of a knob that were run, by the scene's seed or the next; timed: do seconds compare?"""
    found = []
    for label, point in knob.points.items():
        if done := [runs[each] for each in (point, other_seed(scene, point)) if each in runs and runs[each].done]:
            errors, seconds = [run.rrmsd for run in done], statistics.median(run.seconds for run in done)
            place = Place(
                label=label, settings=point, seconds=seconds if timed else None, rrmsd=statistics.median(errors),
                lowest=min(errors), highest=max(errors), seeds=len(done),
            )  # fmt: skip
            found.append(place)
    return tuple(found)


def _turned(knobs: Sequence[Knob], point: Settings) -> tuple[str, ...]:
    """Keys of the knobs that settings are a point of, whatever their seed."""
    without = tuple(entry for entry in point if entry[0] != "tailoring.seed")
    return tuple(knob.key for knob in knobs if without in knob.points.values()) if without else ("base",)


def _labels(scene: Scene, knobs: Sequence[Knob]) -> dict[Settings, str]:
    labels: dict[Settings, str] = {(): f"{scene.tailoring.quality} (the scene as it stands)"}
    for knob in knobs:
        for label, point in knob.points.items():
            name = label if knob.key == "quality" else f"{knob.title}: {label}"
            labels.setdefault(point, name)
            labels.setdefault(other_seed(scene, point), f"{name}, seed {scene.tailoring.seed + 1}")
    return labels
