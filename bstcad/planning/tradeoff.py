"""Command `bstcad tradeoff`: measure what accuracy costs in time for a scene, by runs within a budget of seconds.

A run is a design of the base scene with changed settings (its point).  One knob (setting) is varied at a time, then
pairs.  The budget limits the sum of the times of all runs by this version of bstcad in a folder, on any machine.  A
run other than the first is not started if predicted to exceed it, and stopped when it exceeds it by MAX_OVERRUN.

The folder contains the base scene (scene/), the record of each run (runs/), and the results (results.py).  A run with a
record is not repeated, so an interrupted sweep continues, and a larger budget adds runs.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import bstcad
from bstcad.designs.folder import SCENE, scene_files
from bstcad.optics.surfaces.sides import Sides, as_pair, scaled
from bstcad.optics.trace.measure import Effort
from bstcad.planning import cold_run, results
from bstcad.planning.cold_run import (
    REFERENCE_EFFORT,
    ColdRun,
    LocalPool,
    Settings,
    StoredRecord,
    Value,
    format_value,
    sorted_settings,
)
from bstcad.planning.net_choice import NET_KEY, with_net
from bstcad.planning.prediction import START_SECONDS, typical_seconds
from bstcad.planning.results import (
    Calibration,
    KnobPoint,
    Preset,
    TableKnob,
    TradeoffTable,
    halving_factor,
    pareto_front,
)
from bstcad.runs import environment, files
from bstcad.runs.cluster import Answer, Machines
from bstcad.scene.errors import SceneError
from bstcad.scene.quality import PRESETS
from bstcad.scene.scene import Scene
from bstcad.scene.target import Target
from bstcad.tailoring.driver import Progress, no_progress

# --- knobs ------------------------------------------------------------------------------------------------------------

HALF, SQRT_HALF = 0.5, 0.5**0.5  # factors on the value of a setting
POINT_LIMITS = (9, 1025)  # minimum and maximum control points per side
GRID_LIMITS = (32, 2048)  # minimum and maximum transport cells per side
PIXEL_LIMITS = (8, 4096)  # minimum and maximum pixels per side
COUNT_LIMITS = (1, 16_384)  # minimum and maximum of all other varied numbers
ROUND_COUNTS = (1, 2, 3, 5, 8)  # numbers of rounds of transport and slope fit in stage 1
ADAM_FRACTIONS = (1 / 8, 1 / 4, 1 / 2, 1.0)  # steps of Wang et al.'s procedure / steps in the preset paper

Points = Mapping[str, Settings]  # settings by label ("768"), in the order of increasing work


@dataclass(frozen=True)
class Knob:
    """Setting that trades accuracy for time."""

    key: str  # name for programs, such as "tubes"
    title: str  # name in words, such as "Flux tubes per side"
    points: Points  # values of the setting
    combines: bool = False  # True if the knob varies two other knobs together


def describe(point: Settings) -> str:
    """Describe settings in words, such as "rays = 512, rounds = 2"."""
    changes = (f"{key.removeprefix('tailoring.')} = {format_value(value)}" for key, value in point)
    return ", ".join(changes) or "the scene's own"


def knobs(scene: Scene) -> tuple[Knob, ...]:
    """Return all knobs of a scene, the most important first."""
    own = scene.lens.back.net
    resolved = scene.tailoring.resolved(own)
    is_adam = resolved.method == "adam"

    def multiples(name: str, of: Iterable[float], limits: tuple[int, int] = COUNT_LIMITS) -> Points:
        value = getattr(resolved, name)
        return _numbers(f"tailoring.{name}", value, (round(factor * value) for factor in of), limits)

    presets = PRESETS if _allows_paper(scene) else [name for name in PRESETS if name != "paper"]
    others = filter(_is_candidate, (scaled(own, factor) for factor in (1 / 4, HALF, 1, 2, 4)))
    nets: list[Sides] = sorted({own, *others}, key=as_pair)
    candidates = (
        Knob("quality", "Quality presets", _choices("tailoring.quality", scene.tailoring.quality, presets)),
        Knob("evaluations", "Evaluations of stage 2", multiples("stage2_iterations", (1 / 8, 1 / 4, HALF, 1, 2, 4))),
        Knob("tubes", "Rays per side" if is_adam else "Flux tubes per side",
             multiples("rays", (1 / 4, HALF, SQRT_HALF, 1, 1 / SQRT_HALF, 2))),
        Knob("control_points", "Control points per side", _choices(NET_KEY, own, nets)),
        Knob("adam", "Adam on control points, by rays",
             _adam_points(scene.tailoring.quality == "paper") if _allows_paper(scene) else {}),
        Knob("precision", "Precision", _choices("tailoring.precision", resolved.precision, ("float32", "float64"))),
        Knob("pixels", "Pixels of the target", _pixels(scene)),
        Knob("rounds", "Rounds of stage 1",
             {} if is_adam else _numbers("tailoring.rounds", resolved.rounds, ROUND_COUNTS)),
        Knob("transport_grid", "Transport cells per side",
             multiples("transport_grid", (1 / 4, HALF, 1, 2), GRID_LIMITS)),
        Knob("transport_iterations", "Transport iterations", multiples("transport_iterations", (1 / 8, 1 / 4, 1, 2))),
        Knob("tubes_evaluations", "Tubes and evaluations together", _joint_points(
            ("tailoring.rays", resolved.rays, (HALF, SQRT_HALF, 1, 1 / SQRT_HALF)),
            ("tailoring.stage2_iterations", resolved.stage2_iterations, (1 / 4, HALF, 1, 2))), combines=True),
        Knob("control_points_tubes", "Control points and tubes together", _joint_points(
            (NET_KEY, own, (1 / 4, HALF, 1, 2)),
            ("tailoring.rays", resolved.rays, (1 / 4, HALF, 1, 2))), combines=True),
    )  # fmt: skip
    return tuple(knob for knob in candidates if len(knob.points) > 1)


def _allows_paper(scene: Scene) -> bool:
    """Return True if the preset paper can design the scene: one picture, one tailored face, no bounds on this face."""
    return _is_allowed(scene, {"tailoring.quality": "paper"})


def _is_allowed(scene: Scene, changes: Mapping[str, Any]) -> bool:
    try:
        scene.changed(changes)
    except SceneError:
        return False
    return True


def _choices(key: str, own: Value, values: Iterable[Value]) -> Points:
    return {format_value(value): () if value == own else ((key, value),) for value in values}


def _numbers(key: str, own: int, values: Iterable[int], limits: tuple[int, int] = COUNT_LIMITS) -> Points:
    return _choices(key, own, sorted({own, *(value for value in values if limits[0] <= value <= limits[1])}))


def _is_candidate(net: Sides) -> bool:
    return POINT_LIMITS[0] <= max(as_pair(net)) <= POINT_LIMITS[1]


def _pixels(scene: Scene) -> Points:
    """Return points with coarser and finer pictures of all targets; RRMSDs are on the pixels of the base scene."""
    own, points = [target.columns_rows for target in scene.targets], {}
    for factor in (1 / 4, HALF, 1, 2):
        sizes = [(round(factor * columns), round(factor * rows)) for columns, rows in own]
        if factor == 1 or all(PIXEL_LIMITS[0] <= min(size) and max(size) <= PIXEL_LIMITS[1] for size in sizes):
            values = [columns if columns == rows else (columns, rows) for columns, rows in sizes]
            changed = {f"{key}.pixels": value for key, value in zip(scene.target_keys, values, strict=True)}
            if factor == 1 or _is_allowed(scene, changed):  # a profile may be too narrow for larger pixels
                points[" and ".join(map(format_value, values))] = () if factor == 1 else sorted_settings(changed)
    return points


def _adam_points(own: bool) -> Points:
    """Return points of the preset paper with fewer steps, then unchanged; own: True if the scene has this preset."""
    points = {}
    for factor in ADAM_FRACTIONS:
        steps = {name: round(factor * PRESETS["paper"][name]) for name in ("stage1_iterations", "stage2_iterations")}
        fewer = {f"tailoring.{name}": count for name, count in steps.items()} if factor < 1 else {}
        preset = {} if own else {"tailoring.quality": "paper"}
        points[f"{steps['stage1_iterations']} + {steps['stage2_iterations']}"] = sorted_settings(preset | fewer)
    return points


def _joint_points(*varied: tuple[str, Any, Sequence[float]]) -> Points:
    """Return points that vary keys together; varied: (key, base value, factors).  A net's factor scales its spans."""
    points = {}
    for multiples in zip(*(multiples for _, _, multiples in varied), strict=True):
        values = {
            key: own if factor == 1 else scaled(own, factor) if key == NET_KEY else max(1, round(factor * own))
            for (key, own, _), factor in zip(varied, multiples, strict=True)
        }
        if NET_KEY not in values or _is_candidate(values[NET_KEY]):
            changed = {key: values[key] for key, own, _ in varied if values[key] != own}
            points[" × ".join(map(str, values.values()))] = sorted_settings(changed)
    return points


# --- order of the runs ------------------------------------------------------------------------------------------------


def run_order(knobs: Sequence[Knob]) -> list[Settings]:
    """Return all runs, the most important first, so that any budget gives the most useful runs.

    First come the preset draft, the base and the preset standard, then neighbours of the base and the preset fine, then
    further points, and last the preset paper.
    """
    presets = knobs[0].points
    single = [knob for knob in knobs[1:] if not knob.combines]
    joint = [knob for knob in knobs if knob.combines]
    paper = presets.get("paper", ())  # takes minutes

    def neighbours(varied: Iterable[Knob], *distances: int) -> list[Settings]:
        return [point for steps in distances for knob in varied for point in _neighbour(knob, steps) if point != paper]

    order = [presets.get("draft", ()), (), presets.get("standard", ()), *neighbours(single, -1)]
    order += [*neighbours(joint, -1), *neighbours(single, +1), presets.get("fine", ()), *neighbours(joint, +1)]
    order += [*neighbours(single, -2, -3, -4), *neighbours(knobs[1:], 2, -2, 3, -3, 4, -4), paper]
    return list(dict.fromkeys(order))


def _neighbour(knob: Knob, steps: int) -> list[Settings]:
    """Return [the point that is `steps` steps from the base] (negative: less work), or [] if there is none.

    If the base is not a point of the knob, the first point is the neighbour with less work, the second with more work.
    """
    points = list(knob.points.values())
    start = points.index(()) if () in points else 1 if steps == -1 else 0 if steps > 0 else -1
    return points[start + steps : start + steps + 1] if start + steps >= 0 else []


# --- the sweep --------------------------------------------------------------------------------------------------------

SAFETY_FACTOR = 1.1  # smallest ratio of remaining to predicted time at which a run is started
MAX_OVERRUN = 0.1  # fraction of the budget by which a run may exceed it
RETRY_FACTOR = 1.5  # smallest ratio of available time to the earlier limit at which a stopped run is repeated
REFERENCE_TEXT = (
    "stratified rays that were not used in tailoring, in independent sets, until the standard error is below {:.2%} of "
    "the RRMSD; {} pixels; the lens as read back from its folder"
)
NO_TIMES = dict.fromkeys(("seconds", "cpu_seconds", "kernel_seconds", "cost_seconds"))  # null times of a run not done


class RunFile(StoredRecord):
    """Runs of a sweep by one version of bstcad."""

    runs: tuple[ColdRun, ...]


def tradeoff(
    scene: Scene,
    folder: Path,
    *,
    budget: float,
    progress: Progress = no_progress,
    machines: Machines | None = None,
    reference: Effort = REFERENCE_EFFORT,
) -> TradeoffTable:
    """Do the most important runs that the budget (s) allows, and write tradeoff.csv, .json, .png and .html.

    machines: machines of the runs; None: this machine.  reference: effort of the measurement of each lens.  The csv and
    json files are written after each run, so that they exist after an interruption.
    """
    scene = scene.changed({"tailoring.accuracy": None, "tailoring.max_time": None})  # these end a design early
    base, _ = with_net(scene)
    contents = scene_files(base)
    check_free(folder, contents)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with files.exclusive(folder):
        for place in (folder / "scene", folder / "runs"):
            place.mkdir(parents=True, exist_ok=True)
        for name, data in contents.items():
            files.put(folder / "scene" / name, data)
        sweep = _Sweep(base, budget, folder, progress, reference=reference)
        try:
            sweep.run(machines, contents)
        except BaseException as error:
            if count := len(sweep.runs):
                runs = "1 run is" if count == 1 else f"{count} runs are"
                error.add_note(f"{runs} stored in {folder}, so the work is kept; the same command continues from there")
                if isinstance(error, KeyboardInterrupt):  # after Ctrl-C there is still time to draw a figure
                    results.write_page(sweep.table(), base, folder)
            raise
        result = sweep.table()
        results.write_page(result, base, folder)
        return result


def check_free(folder: Path, contents: cold_run.SceneFiles) -> None:
    """Raise SceneError unless the folder is new, empty, or belongs to a sweep of this scene."""
    try:
        files.check_free(folder, [f"scene/{SCENE}"], "a sweep's")
    except ValueError as error:
        raise SceneError(f"{error} with -o") from None
    paths = {folder / "scene" / name: data for name, data in contents.items()}
    stored_scene = folder / "scene" / SCENE
    if stored_scene.is_file() and any(not path.is_file() or path.read_bytes() != data for path, data in paths.items()):
        raise SceneError(
            f"{folder}: contains the sweep of another scene, {stored_scene}; give another folder with -o, or remove "
            "this folder"
        )


class _Sweep:
    def __init__(
        self, base: Scene, budget: float, folder: Path, progress: Progress, reference: Effort = REFERENCE_EFFORT
    ) -> None:
        self._base, self._budget, self._folder, self._progress = base, budget, folder, progress
        self._reference = reference
        self._knobs = knobs(base)
        self._order, self._work = run_order(self._knobs), cache(partial(predicted_work, base))
        self._under_way: dict[Settings, tuple[float, float]] = {}  # (start time, predicted seconds) of current runs
        self._file = folder / "runs" / f"{environment.version()}.json"
        self.runs: dict[Settings, ColdRun] = {}  # runs that have ended
        if self._file.is_file():
            stored = cold_run.read_record(RunFile, self._file, "remove it, and its runs are repeated")
            self.runs = {run.settings: run for run in stored.runs}
        for point, run in list(self.runs.items()):
            if run.allowed_seconds is not None:  # the run was stopped at a limit; repeat it if there is more time now
                left = budget - self._spent() + (run.cost_seconds or 0.0)
                if left + MAX_OVERRUN * budget >= RETRY_FACTOR * run.allowed_seconds:
                    del self.runs[point]
        self._earlier = self._spent()  # seconds spent by earlier sweeps in the folder

    def run(self, machines: Machines | None, contents: cold_run.SceneFiles) -> None:
        """Do runs until no remaining one fits into the budget."""
        if self._choice() is None:
            return
        with ExitStack() as stack:
            if machines is None:  # one run at a time, so that runs do not slow each other down
                cold_run.warm_up(contents, lambda: self._progress("warm-up", 0, 0, "compiling kernels, reading files"))
                machines = stack.enter_context(LocalPool(1))
            while True:
                while len(self._under_way) < machines.capacity and (point := self._choice()) is not None:
                    # The first run has no time limit, since a sweep needs at least one.
                    limit = self._left() + MAX_OVERRUN * self._budget if self.runs or self._under_way else math.inf
                    self._under_way[point] = time.perf_counter(), self._predicted(point)
                    machines.start(point, cold_run.run_and_judge, contents, point, limit, self._reference)
                if not self._under_way:
                    return
                self._record_answer(machines.next(self._tick))

    def _record_answer(self, answer: Answer) -> None:
        _, predicted = self._under_way.pop(answer.key)
        failed: dict[str, Any] = {"status": cold_run.FAILED, "reason": answer.reason, "version": environment.version()}
        run = answer.value or ColdRun(settings=answer.key, **failed)
        self.runs[answer.key] = run.model_copy(update={"predicted_seconds": predicted, "where": answer.where})
        real = (run for run in self.runs.values() if run.cost_seconds)  # a run that a worker did not do is not stored
        cold_run.write_record(self._file, RunFile(runs=tuple(real)))
        self.table()

    def table(self) -> TradeoffTable:
        """Write and return the table of the runs so far, and of the remaining ones."""
        unset: dict[str, Any] = NO_TIMES | {"status": cold_run.NOT_RUN, "where": ""}
        points = (point for point in self._order if point not in self.runs)
        waiting = [ColdRun(settings=point, predicted_seconds=self._predicted(point), **unset) for point in points]
        runs = [self.runs[point] for point in self._order if point in self.runs]
        result = table(self._base, self._knobs, [*runs, *waiting], self._budget, reference=self._reference)
        results.write(result, self._folder)
        return result

    def _choice(self) -> Settings | None:
        """Return the most important run that fits into the remaining budget; the first run always fits."""
        free = (point for point in self._order if point not in self.runs and point not in self._under_way)
        left = self._left() if self.runs or self._under_way else math.inf
        return next((point for point in free if SAFETY_FACTOR * self._predicted(point) <= left), None)

    def _predicted(self, point: Settings) -> float:
        """Predict the seconds that a run takes of the budget: the estimate times the measured pace of its method."""
        is_adam, seconds = self._work(point)
        paces: dict[bool, list[float]] = {True: [], False: []}
        for run in filter(lambda run: run.done, self.runs.values()):
            by_adam, expected = self._work(run.settings)
            paces[by_adam].append((run.cost_seconds or 0.0) / expected)
        return seconds * statistics.median(paces[is_adam] or paces[not is_adam] or [1.0])

    def _left(self) -> float:
        """Return the seconds of the budget that remain after the predicted end of the current runs."""
        running = sum(predicted for _, predicted in self._under_way.values())
        return self._budget - self._spent() - SAFETY_FACTOR * running

    def _spent(self) -> float:
        return sum(run.cost_seconds or 0.0 for run in self.runs.values())

    def _tick(self) -> None:
        """Report progress as a fraction of the budget that was available when this sweep began."""
        point, more = next(iter(self._under_way)), len(self._under_way) - 1
        text = f"run {len(self.runs) + 1}: {describe(point)}{f' and {more} more' if more else ''}"
        total, now = max(self._budget - self._earlier, 1.0), time.perf_counter()
        used = self._spent() - self._earlier + sum(now - began for began, _ in self._under_way.values())
        self._progress("tradeoff", round(min(used, 0.999 * total)), max(round(total), 1), text)


# --- predicted seconds of runs ----------------------------------------------------------------------------------------

JUDGING_SECONDS = 2.0  # time to measure a lens's RRMSD with the reference (s)


def predicted_work(scene: Scene, point: Settings) -> tuple[bool, float]:
    """Return (True for Wang et al.'s procedure, seconds at pace 1); for a refused run, the time to start and judge."""
    try:
        changed = scene.changed(dict(point))
    except SceneError:
        return False, START_SECONDS + JUDGING_SECONDS
    seconds = typical_seconds(changed).total + JUDGING_SECONDS
    return changed.tailoring.resolved(changed.lens.back.net).method == "adam", seconds


# --- the table --------------------------------------------------------------------------------------------------------


def table(
    scene: Scene, knobs: Sequence[Knob], runs: Sequence[ColdRun], budget: float = math.inf,
    reference: Effort = REFERENCE_EFFORT,
) -> TradeoffTable:  # fmt: skip
    """Return the table of a sweep.  runs: ended runs, then runs not done, both in order of importance; budget in s.

    reference: effort of the measurement of each lens.
    """
    own, best = scene.lens.back.net, pareto_front(runs)
    comparable = {run.settings: run for run in runs if run.comparable}
    selected = comparable or {run.settings: run for run in runs if run.done}
    sample = selected.get(()) or next(iter(selected.values()), None)  # states the machine of all runs
    unit = [run.kernel_seconds for run in comparable.values() if run.kernel_seconds]
    on_front, labels = tuple(run.settings for run in best), _labels(scene, knobs)
    presets = {name: selected[point].time_and_error for name, point in knobs[0].points.items() if point in selected}
    settings = {key: value for key, value in asdict(scene.tailoring.resolved(own)).items() if value is not None}
    base = {"quality": scene.tailoring.quality, "control_points": own, "pixels": scene.target.columns_rows}

    def described(run: ColdRun) -> ColdRun:
        label = labels.get(run.settings) or describe(run.settings)
        keys = {"knobs": _knob_keys(knobs, run.settings), "on_front": run.settings in on_front}
        return run.model_copy(update={"label": label, **keys})

    return TradeoffTable(
        name=scene.name,
        title=scene.title,
        base=base | {"knobs": {"quality": scene.tailoring.quality, **settings}},
        budget_seconds=budget,
        spent_seconds=sum(run.cost_seconds or 0.0 for run in runs),
        errors_alone=bool(selected) and not comparable,
        version=bstcad.__version__,
        sources=next((run.version for run in runs if run.version), ""),
        machine=sample.machine if sample else {},
        versions=sample.versions if sample else {},
        reference={
            "rays": sorted({run.rays for run in runs if run.rays}),
            "what": REFERENCE_TEXT.format(reference.accuracy, _judged_on(scene.targets)),
        },
        calibration=Calibration.of(unit),
        runs=tuple(map(described, runs)),
        knobs=tuple(
            TableKnob(key=knob.key, title=knob.title, places=knob_points(knob, selected, timed=bool(comparable)))
            for knob in knobs
        ),
        front=on_front,
        front_halving=halving_factor(best),
        presets=tuple(
            Preset(name=name, seconds=t if comparable else None, rrmsd=e) for name, (t, e) in presets.items()
        ),
        history=comparable[()].history if () in comparable else (),
    )


def _judged_on(targets: Sequence[Target]) -> str:
    """Return, in words, the target pixels on which RRMSDs are measured, such as "64 x 48"."""
    sizes = " and ".join("{} x {}".format(*target.columns_rows) for target in targets)
    return f"the target with the largest RRMSD, of {sizes}" if len(targets) > 1 else sizes


def knob_points(knob: Knob, runs: Mapping[Settings, ColdRun], timed: bool = True) -> tuple[KnobPoint, ...]:
    """Return the points of a knob that were run; timed: True if times are comparable."""
    found = ((label, runs[point]) for label, point in knob.points.items() if point in runs and runs[point].done)
    times = ((label, run, run.time_and_error) for label, run in found)
    return tuple(
        KnobPoint(label=label, settings=run.settings, seconds=seconds if timed else None, rrmsd=rrmsd)
        for label, run, (seconds, rrmsd) in times
    )


def _knob_keys(knobs: Sequence[Knob], point: Settings) -> tuple[str, ...]:
    """Return the keys of the knobs with a point at these settings; ("base",) for the base scene."""
    return tuple(knob.key for knob in knobs if point in knob.points.values()) if point else ("base",)


def _labels(scene: Scene, knobs: Sequence[Knob]) -> dict[Settings, str]:
    labels: dict[Settings, str] = {(): f"{scene.tailoring.quality} (the unchanged scene)"}
    for knob in knobs:
        for label, point in knob.points.items():
            labels.setdefault(point, label if knob.key == "quality" else f"{knob.title}: {label}")
    return labels
