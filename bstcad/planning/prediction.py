"""Predict time, RRMSD and memory of a design from a pilot: a small version of the same design, run on this machine.

The sizes of a pilot are those of the scene divided by one factor (reduction.py).  The pilot includes all
faces, goals, losses, wavelengths and bounds of the scene.  How the time of each stage scales with its sizes is known
from the method.  A pilot has no detail finer than its pixels; the error of this detail is estimated from the picture.
The constants ending in _SECONDS (s) and _GB (GB) are for the sizes UNIT_…, on two cores of pace 1 (`pace`).

tests/benchmarks/test_prediction.py compares predictions with designs of the templates and of the gallery.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from numba.core.event import RecordingListener, install_listener

from bstcad.analysis.light import blur
from bstcad.analysis.steepness import Steepness
from bstcad.designs import pipeline
from bstcad.designs.designed_lens import DesignedLens
from bstcad.optics.lens.lens import Lens
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.surfaces.sides import as_pair
from bstcad.optics.trace.measure import Effort, measure_goals
from bstcad.planning.cold_run import calibration_kernel, measure_seconds
from bstcad.planning.reduction import PILOT, Reduction, pilot_scene, with_quality
from bstcad.runs.processes import Tick
from bstcad.scene.scene import Scene
from bstcad.tailoring.driver import RRMSD_SECONDS, Hooks, Task
from bstcad.tailoring.settings import COARSEST_GRID
from bstcad.tailoring.slope_map import SUBCELLS
from bstcad.tailoring.stage2 import SINGLE_ROUND_FACTOR, round_shares, sheet_sizes, stage3_sheet_sizes

Interval = tuple[float, float, float]  # (low, likely, high); nine of ten designs lie between low and high
QUALITIES = ("draft", "standard", "fine")  # qualities with a prediction
# High / likely and likely / low of the intervals.
INTERVAL_FACTORS = {"seconds": 1.5, "rrmsd": 1.5, "rrmsd_half": 1.5, "memory_gb": 1.25}

# --- the pilot --------------------------------------------------------------------------------------------------------

# Effort of the measurement of a pilot's RRMSDs: of a source without extent, and of an extended source, whose light is
# blurred and whose rays take longer.
PILOT_RAYS = Effort(rays=1024, accuracy=0.05, witness=False, cells=2)
BLURRED_PILOT_RAYS = replace(PILOT_RAYS, rays=512)
SEARCH_STAGES = ("stage 2", "stage 3")  # stages that use the minimiser
PILOT_SHARE = 0.06  # largest share of the time of a design that the search of its pilot takes, unless it is too short


@dataclass(frozen=True)
class Seconds:
    """Seconds that the parts of a design take."""

    first: float  # stage 1
    search: float  # stage 2 or 3
    rest: float  # start, writing, verification, report; for a pilot: loading, and coarse rounds

    @property
    def total(self) -> float:
        """Time of the whole command, seconds."""
        return self.first + self.search + self.rest


@dataclass(frozen=True)
class PilotLight:
    """Light through the lens of a pilot."""

    rrmsd: float  # largest RRMSD of all goals
    half_ratio: float  # largest ratio of the RRMSD on half pixels to that on pixels


@dataclass(frozen=True)
class Pilot:
    """Result of a small design of standard quality."""

    scene: Scene  # scene of the small design
    seconds: Seconds  # duration of each part (s)
    light: PilotLight  # light at the end
    early: PilotLight | None  # light after as many evaluations as a draft makes; None: not known
    factor: float  # pixels per side of the full scene / pixels per side of the pilot
    detail: float  # relative RMS of the detail of the full picture that is finer than the pilot's pixels
    blur: float  # RRMSD by blur of the source: on pixels of the full scene, minus RRMSD on pixels of the pilot
    steep: Steepness  # steepness that the map requires of the back

    def light_in(self, quality: str) -> PilotLight:
        """Return the light through the lens of a pilot of this quality."""
        return self.early or self.light if quality == "draft" else self.light


class LensAfter:
    """Hooks of a design that keep the lenses after given numbers of steps of the search on the target's pixels."""

    def __init__(self, counts: Collection[int], tick: Tick) -> None:
        self.made: dict[int, Callable[[], Lens]] = {}  # number of steps -> function that makes the lens
        self._counts, self._steps, self._searches = counts, 0, False
        self.hooks = Hooks(progress=self._progress, on_lens=self._on_lens)
        self._tick = tick

    def _progress(self, stage: str, done: int, total: int, text: str) -> None:
        self._searches = stage in SEARCH_STAGES
        self._tick()

    def _on_lens(self, make: Callable[[], Lens]) -> None:
        self._steps += self._searches
        if self._searches and self._steps in self._counts:
            self.made.setdefault(self._steps, make)


def run_pilot(scene: Scene, tick: Tick = lambda: None, *, size: Reduction = PILOT, rays: Effort | None = None) -> Pilot:
    """Design a small version of a scene in standard quality; raise SceneError if the design is refused.

    rays: of the measurement of its RRMSDs; None: by the extent of the source.
    """
    rays = rays or (PILOT_RAYS if scene.source.extent is None else BLURRED_PILOT_RAYS)
    standard = with_quality(scene, "standard")
    small, factor = pilot_scene(standard, size)
    small = _with_fewer_evaluations(standard, small, size.evaluations)
    few = with_quality(scene, "draft").tailoring.resolved(scene.lens.back.net).stage2_iterations
    after_coarse = round(SINGLE_ROUND_FACTOR * few)  # evaluations of a draft after coarse rounds
    compilations = RecordingListener()
    options = pipeline.DesignOptions(compare_later=True, effort=size.effort)

    def make_design() -> tuple[DesignedLens, LensAfter]:
        lenses = LensAfter((few, after_coarse), tick)
        return pipeline.design(small, hooks=lenses.hooks, options=options), lenses

    with install_listener("numba:compile", compilations):
        finished, lenses = make_design()
    if compilations.buffer:  # the first design after an installation waits for the compiler; time another one
        finished, lenses = make_design()
    coarse = any(stage.is_coarse for stage in finished.course.stages)
    made = None if scene.source.extent else lenses.made.get(after_coarse if coarse else few)
    early = None if made is None else small.as_mounted(replace(made().plain(), index=small.index, losses=None))
    sides, finer = [max(goal.screen.shape) for goal in finished.goals], factor > 1
    pairs = zip(scene.single_target_scenes(), small.single_target_scenes(), strict=True)
    blurs = [blur_rrmsd(one, finished.lens) - blur_rrmsd(few, finished.lens) for one, few in pairs] if finer else [0.0]
    times = dict.fromkeys(("first", "search", "rest"), 0.0)
    for stage in finished.course.stages:
        part = "search" if stage.stage in SEARCH_STAGES else "first"
        times["rest" if stage.name == "loading" or stage.is_coarse else part] += stage.seconds
    transport: Mapping[str, Any] = finished.course.transport or {}
    steep = Steepness(transport["steep_share"], transport["steepest_deg"])
    lost = max(map(detail, (goal.picture for goal in scene.goals), sides)) if finer else 0.0
    light = partial(_light, small, finished.goals, rays)
    return Pilot(
        small, Seconds(**times), light(finished.lens), None if early is None else light(early),
        factor=factor, detail=lost, blur=max(0.0, *blurs), steep=steep,
    )  # fmt: skip


def _with_fewer_evaluations(scene: Scene, small: Scene, fewest: int) -> Scene:
    """Return `small`, a small version of `scene`, with so many evaluations that its search takes PILOT_SHARE."""
    settings = small.tailoring.resolved(small.lens.back.net)
    allowed = PILOT_SHARE * typical_seconds(scene).total / typical_seconds(small).search
    if settings.method == "adam" or not allowed < 1:
        return small
    evaluations = min(settings.stage2_iterations, max(fewest, round(allowed * settings.stage2_iterations)))
    return small.changed({"tailoring.stage2_iterations": evaluations})


def _light(scene: Scene, goals: Sequence[Goal], rays: Effort, lens: Lens) -> PilotLight:
    lights = measure_goals(lens, scene.channels(), goals, rays, ghost=None, sampler=scene.sampler)
    ratios = [each.half.rrmsd / each.rrmsd for each in lights if each.half is not None and each.rrmsd > 0]
    return PilotLight(max(each.rrmsd for each in lights), max(ratios, default=1.0))


def detail(picture: np.ndarray, pixels: int) -> float:
    """Return the RMS of a picture's cosines with more than `pixels` half waves on the longer side / RMS of all."""
    from scipy.fft import dctn

    energy = dctn(picture, norm="ortho") ** 2
    half_waves = np.hypot(*np.meshgrid(*(np.arange(n) * max(picture.shape) / n for n in picture.shape), indexing="ij"))
    return float(np.sqrt(energy[half_waves > pixels].sum() / energy.sum()))


def blur_rrmsd(scene: Scene, lens: Lens) -> float:
    """Return the RRMSD of the target convolved with the image of an extended source; 0 without extent or light."""
    image = blur(scene.channels(), lens, scene.target.screen, scene.target.irradiance())
    return 0.0 if image is None else image.rrmsd


# --- predictions ------------------------------------------------------------------------------------------------------

# Ratio of the RRMSD of the full design to that of the pilot, whose search is shorter and has fewer tubes, where the
# pilot has all pixels; exponent of Pilot.factor in this ratio.
PILOT_RATIO, PILOT_EXPONENT = 0.8, -0.4
DETAIL_FACTORS = {"draft": 0.2, "standard": 0.02, "fine": 0.02}  # RRMSD due to detail that a pilot lacks / Pilot.detail
FINE_RATIO = 0.7  # ratio of the RRMSD in fine to that in standard quality
REMAINING_BLUR = 0.5  # fraction of the blur by an extended source that remains after stage 3


def predict(scene: Scene, pilot: Pilot, gain: float = 1.0) -> dict[str, dict[str, Interval]]:
    """Return intervals of INTERVAL_FACTORS, by quality, from the pilot of a scene.

    rrmsd: on pixels.  rrmsd_half: on half pixels.  memory_gb: of two processes.  The RRMSD does not increase from a
    quality to the next better quality.  gain: RRMSD with the net of `scene`, divided by the RRMSD with the net of the
    scene of which the pilot is a small version.
    """
    best, intervals = math.inf, {}
    for quality in QUALITIES:
        whole = with_quality(scene, quality)
        best = min(best, gain * predicted_rrmsd(pilot, quality))
        errors = {"rrmsd": best, "rrmsd_half": pilot.light_in(quality).half_ratio * best}
        likely = {"seconds": predicted_seconds(whole, pilot), **errors, "memory_gb": memory_gb(whole)}
        wide = [(key, each, INTERVAL_FACTORS[key]) for key, each in likely.items()]
        intervals[quality] = {key: (each / factor, each, each * factor) for key, each, factor in wide}
    return intervals


def predicted_rrmsd(pilot: Pilot, quality: str) -> float:
    """Return the RRMSD of a full design: the scaled RRMSD of its pilot plus that of detail and blur it lacks."""
    ratio = PILOT_RATIO * pilot.factor**PILOT_EXPONENT * (FINE_RATIO if quality == "fine" else 1.0)
    return ratio * pilot.light_in(quality).rrmsd + DETAIL_FACTORS[quality] * pilot.detail + REMAINING_BLUR * pilot.blur


def predicted_seconds(scene: Scene, pilot: Pilot) -> float:
    """Return the time (s) of a design: typical times of its parts at the `pace` of the machine, or of the pilot.

    The pilot shows what slows a scene down, such as a dome.  Where it is faster than the machine's pace, it only lacks
    some of the work of a design, such as rays that rate each round.
    """
    whole, small, times = typical_seconds(scene), typical_seconds(pilot.scene), pilot.seconds
    first, search = max(pace(), times.first / small.first), max(pace(), times.search / small.search)
    return first * whole.first + search * whole.search + times.rest + pace() * whole.rest


# --- sizes ------------------------------------------------------------------------------------------------------------

# Sizes (per side, or iterations) for which the following times (s) and memory (GB) are stated, on two cores of pace 1.
UNIT_TUBES, UNIT_POINTS, UNIT_PIXELS, UNIT_GRID, UNIT_ITERATIONS = 1024, 513, 512, 256, 40
PACE_TUBES, PACE_REPEATS = 512, 5  # tubes per side, and evaluations, of cold_run.calibration_kernel for the pace
KERNEL_SECONDS = 0.0256  # time of an evaluation with PACE_TUBES; defines pace 1
ROUND_SECONDS, TRANSPORT_SECONDS, FIT_SECONDS = 0.06, 0.2, 0.6  # stage 1: rest of a round, transport, slope fit
TWO_FACE_TRANSPORT_SECONDS = 2.4  # time of a transport for two freeform faces, with the trace between them
TWO_FACE_SECONDS = 3.0  # additional time in stage 1 for two freeform faces of any size
AIMING_SECONDS = 0.15  # time to find the rays from a point source through UNIT_TUBES² points of a face
FRONT_SECONDS = 1.7  # time of the search for the free parameters of a front
EVALUATION_SECONDS, VARIABLE_SECONDS, BLUR_SECONDS = 0.075, 0.03, 0.30  # time of the tubes, net, blur in an evaluation
CALL_SECONDS = 0.01  # time in an evaluation that is independent of sizes
IMAGE_SECONDS = 0.7  # time in a round for the images of an extended source
ADAM_SECONDS = 0.1  # time of a step of Wang et al.'s procedure
START_SECONDS = 2.8  # time of the imports and of the end of the process
WRITE_SECONDS, NET_SECONDS, PICTURE_SECONDS = 1.5, 2.4, 1.1  # time to write and verify: constant part, net, pixels
MOUNT_SECONDS = 2.5  # time of cutting and verifying the mounted part
RAY_SECONDS, DRAFT_RAY_SECONDS = 1.6, 1.0  # tracing parallel light, per target and spectral line; twice for other light
WITNESS_SECONDS, DRAFT_WITNESS_SECONDS = 6.0, 2.5  # time to verify a lens of two nets with flux tubes, per target
LIBRARIES_GB = 1.5  # memory of the libraries in both processes
TUBES_GB, NET_GB, PIXELS_GB = 0.12, 0.27, 0.02  # memory of tubes, net and pixels
GOAL_MEMORY_FACTOR = 1.2  # memory of tubes per goal with several goals / memory with one target


@cache
def pace() -> float:
    """Return the time of the calibration kernel on this machine divided by KERNEL_SECONDS; 0.5: twice as fast."""
    return min(measure_seconds(calibration_kernel(PACE_TUBES)) for _ in range(PACE_REPEATS)) / KERNEL_SECONDS


def typical_seconds(scene: Scene) -> Seconds:
    """Return the times of a design on two cores of pace 1 (see `pace`), estimated from its sizes only."""
    settings, point = scene.tailoring.resolved(scene.lens.back.net), not scene.source.parallel
    rest = START_SECONDS + proof_seconds(scene)
    sheets, net, pixels = search_rounds(scene), (settings.side / UNIT_POINTS) ** 2, _pixel_ratio(scene)
    if settings.method == "adam":
        step = ADAM_SECONDS * (settings.rays / UNIT_TUBES) ** 2
        stage1 = step * (settings.stage1_iterations * len(settings.levels))
        return Seconds(stage1, step * settings.stage2_iterations, rest)
    halvings, transport = (1, TWO_FACE_TRANSPORT_SECONDS) if scene.lens.front.is_tailored else (2, TRANSPORT_SECONDS)
    grids = [max(COARSEST_GRID, settings.transport_grid // 2 ** min(left, halvings)) for left in range(settings.rounds)]
    first = ROUND_SECONDS * settings.rounds + (FRONT_SECONDS if scene.lens.front.free else 0.0)
    first += TWO_FACE_SECONDS if scene.lens.front.is_tailored else 0.0
    cells = sum((grid / UNIT_GRID) ** 2 for grid in grids)
    first += transport * cells * settings.transport_iterations / UNIT_ITERATIONS
    fits = [fitted for level in settings.levels[-2:] for fitted in scene.lens.nets(level)]
    first += FIT_SECONDS * sum(math.prod(as_pair(fitted)) for fitted in fits) / UNIT_POINTS**2
    each, begun = CALL_SECONDS + VARIABLE_SECONDS * net, RRMSD_SECONDS * pixels ** (2 / 3)  # per evaluation, round
    if scene.source.extent is not None:
        each, begun = each + BLUR_SECONDS * pixels, begun + IMAGE_SECONDS
    launched = sum((tubes / UNIT_TUBES) ** 2 for tubes, _ in sheets)
    tube = len(scene.targets) * EVALUATION_SECONDS  # upper limit: rounds for several pictures may end early
    search = sum(count * (tube * (tubes / UNIT_TUBES) ** 2 + each) + begun for tubes, count in sheets)
    if point:
        sides = [*(SUBCELLS * grid for grid in grids), min(2 * settings.side, settings.rays)]
        first += AIMING_SECONDS * sum((side / UNIT_TUBES) ** 2 for side in sides)
        search += AIMING_SECONDS * launched
    return Seconds(first, search + RRMSD_SECONDS * pixels ** (2 / 3), rest)


def search_rounds(scene: Scene) -> tuple[tuple[int, int], ...]:
    """Return (tubes per side, number of evaluations) of each round of stage 2 or 3."""
    settings = scene.tailoring.resolved(scene.lens.back.net)
    if scene.source.extent is not None:
        columns, rows = zip(*(target.columns_rows for target in scene.targets), strict=True)
        return tuple(stage3_sheet_sizes(settings, (max(columns), max(rows))))
    task = Task((), scene.goals, settings, bounds=scene.lens.bounds, wave=scene.wavefront)
    return tuple(sheet_sizes(settings, round_shares(task)))


def memory_gb(scene: Scene) -> float:
    """Return the peak memory (GB) of the two processes of a design together."""
    goals = len(scene.targets) + (scene.wavefront is not None)
    by_goals = GOAL_MEMORY_FACTOR * goals if goals > 1 else 1.0
    corners = max(tubes for tubes, _ in search_rounds(scene)) ** 2 / UNIT_TUBES**2 * by_goals
    return LIBRARIES_GB + TUBES_GB * corners + NET_GB * _point_ratio(scene) + PIXELS_GB * _pixel_ratio(scene)


def proof_seconds(scene: Scene) -> float:
    """Return the time (s) of writing, verification and report on two cores of pace 1; `pipeline.reserve` is larger."""
    wide = not scene.source.parallel or scene.source.extent is not None
    draft = scene.tailoring.quality == "draft"
    rays, witness = (DRAFT_RAY_SECONDS, DRAFT_WITNESS_SECONDS) if draft else (RAY_SECONDS, WITNESS_SECONDS)
    a_target = rays * (2 if wide else 1) * len(scene.source.lines) + witness * (len(scene.lens.nets()) - 1)
    mounted = MOUNT_SECONDS if scene.mount is not None else 0.0
    by_size = WRITE_SECONDS + NET_SECONDS * _point_ratio(scene) + PICTURE_SECONDS * _pixel_ratio(scene)
    return by_size + a_target * len(scene.targets) + mounted


def _point_ratio(scene: Scene) -> float:
    return sum(math.prod(as_pair(net)) for net in scene.lens.nets()) / UNIT_POINTS**2


def _pixel_ratio(scene: Scene) -> float:
    return sum(math.prod(target.columns_rows) for target in scene.targets) / UNIT_PIXELS**2
