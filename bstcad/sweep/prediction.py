"""Predict seconds, RRMSD and memory of a design by a pilot: the same design made small, and timed.

Net, pixels, ray tubes and cells of the transport of a pilot are those of the scene over one factor, so that a pixel has
the control cells and the tubes that it has in the scene, and the search makes as many evaluations.  The pilot runs all
that the scene asks for (faces, goals, losses, wavelengths, bounds) on this machine; how each stage grows with its sizes
is known from the method.  A pilot sees no detail that is finer than its pixels; this is measured on the picture.

tests/benchmarks/test_prediction.py compares predictions with designs of the templates and of the gallery.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numba.core.event import RecordingListener, install_listener

from bstcad import pipeline
from bstcad.analysis.light import blur
from bstcad.analysis.steepness import Steepness
from bstcad.optics.lens import Lens
from bstcad.optics.measure import Effort, rrmsd_by_rays
from bstcad.optics.sides import Sides, as_pair, coarser
from bstcad.scene.quality import COARSEST_GRID
from bstcad.scene.scene import Scene
from bstcad.sweep.cold_run import REPEATS, kernel, timed
from bstcad.tailoring.run import JUDGING, Task
from bstcad.tailoring.slope_map import SUBCELLS
from bstcad.tailoring.stage2 import round_shares, sheet_sizes, stage3_sheet_sizes

Interval = tuple[float, float, float]  # low, likely, high
QUALITIES = ("draft", "standard", "fine")
FLOWN = ("draft", "standard")  # qualities that have a pilot; that of `fine` is the one of standard quality
WITHIN = {"seconds": 1.5, "rrmsd": 1.5, "memory_gb": 1.25}  # factors that nine of ten designs keep to

# --- the pilot --------------------------------------------------------------------------------------------------------

LARGEST = 128, 193, 512  # pixels, control points and tubes a side of a pilot, at most
FEWEST_POINTS = 65  # control points a side of a pilot, unless its scene has fewer
FEWEST_TUBES = 16  # a side
CELLS = (16, 256)  # cells a side of the transport of a pilot, at least and at most
JUDGED = Effort(rays=2048, accuracy=0.02, witness=False)  # few rays are noisier than smooth light is wrong
SEARCHES = ("stage 2", "stage 3")  # how the names of these stages begin
ON_FEW = " pixels, "  # in the names of rounds of the search that see few pixels, always as few


@dataclass(frozen=True)
class Seconds:
    """Seconds of the parts of a design."""

    first: float  # stage 1
    search: float  # stage 2 or 3
    rest: float  # start, writing, proof and report; of a pilot what does not grow with its sizes

    @property
    def total(self) -> float:
        """Seconds of the whole command."""
        return self.first + self.search + self.rest


@dataclass(frozen=True)
class Pilot:
    """The result of a small design."""

    scene: Scene  # the scene of the small design
    seconds: Seconds
    rrmsd: float  # the largest RRMSD of all goals
    factor: float  # pixels a side of the whole scene over those of the pilot
    detail: float  # relative RMS of what is finer in the whole scene's picture than the pixels of the pilot
    blurred: float  # RRMSD that the source's size blurs in the pixels of the whole scene, beyond that in the pilot's
    steep: Steepness  # slope that the light needs of the back


def fly(scene: Scene, quality: str, tick: Callable[[], None] = lambda: None) -> Pilot:
    """Design a scene of some quality made small.  SceneError where its design would be refused."""
    small, factor = made_small(of_quality(scene, quality))
    compiled, design = RecordingListener(), partial(pipeline.design, small, progress=lambda *told: tick(), later=True)
    with install_listener("numba:compile", compiled):
        made = design()
    if compiled.buffer:  # the first design after an installation: its stages waited for the compiler
        made = design()
    light, finer = small.channels(), factor > 1
    rrmsd = max(
        rrmsd_by_rays(made.lens, light, goal.receiver, target=goal.picture, effort=JUDGED, draw=small.draw)
        for goal in made.goals
    )
    sides = [max(goal.receiver.shape) for goal in made.goals]
    alone = zip(scene.single_target_scenes(), small.single_target_scenes(), strict=True)
    lost = [blurred(one, made.lens) - blurred(few, made.lens) for one, few in alone] if finer else [0.0]
    took = dict.fromkeys(("first", "search", "rest"), 0.0)
    for stage in made.making.stages:
        part = "search" if stage.name.startswith(SEARCHES) else "first"
        took["rest" if stage.name == "loading" or ON_FEW in stage.name else part] += stage.seconds
    sent = made.making.transport
    return Pilot(
        small, Seconds(**took), rrmsd, factor,
        detail=max(map(detail, (goal.picture for goal in scene.goals), sides)) if finer else 0.0,
        blurred=max(0.0, *lost), steep=Steepness(sent["steep_share"], sent["steepest_deg"]),
    )  # fmt: skip


def of_quality(scene: Scene, quality: str) -> Scene:
    """The scene in a quality, with the knobs that it states, and without an early end of its design."""
    return scene.changed({"tailoring.quality": quality, "tailoring.accuracy": None, "tailoring.max_time": None})


def made_small(scene: Scene) -> tuple[Scene, float]:
    """The scene of a pilot, and the pixels a side of the scene over those of the pilot."""
    net, (pixels, points, tubes) = scene.lens.back.net, LARGEST
    knobs, spans = scene.tailoring.resolved(net), max(as_pair(net)) - 1
    widest = max(max(target.columns_rows) for target in scene.targets)
    factor = max(min(max(widest / pixels, spans / (points - 1)), spans / (FEWEST_POINTS - 1)), 1.0)
    changes = {
        "tailoring.rays": max(min(round(knobs.rays / factor), tubes), FEWEST_TUBES),
        "tailoring.transport_grid": int(np.clip(round(knobs.transport_grid / factor), *CELLS)),
    }
    for key, target in zip(scene.target_keys, scene.targets, strict=True):
        changes[f"{key}.pixels"] = target.fewer_pixels(factor)
    return of_net(scene, coarser(net, round(spans / factor) + 1), changes), factor


def of_net(scene: Scene, net: Sides, changes: Mapping[str, object] = {}) -> Scene:
    """The scene with another net of the back, and of a freeform front in proportion; and with other changes."""
    nets = {"lens.back.control_points": net, "tailoring.levels": None}
    if scene.lens.front.is_tailored and scene.lens.front.control_points is not None:
        nets["lens.front.control_points"] = scene.lens.front_net(net)
    return scene.changed({**nets, **changes})


def detail(picture: np.ndarray, pixels: int) -> float:
    """RMS of the waves of a picture with more half waves over its longer side than so many pixels, over its RMS."""
    from scipy.fft import dctn

    energy = dctn(picture, norm="ortho") ** 2
    half_waves = np.hypot(*np.meshgrid(*(np.arange(n) * max(picture.shape) / n for n in picture.shape), indexing="ij"))
    return float(np.sqrt(energy[half_waves > pixels].sum() / energy.sum()))


def blurred(scene: Scene, lens: Lens) -> float:
    """RRMSD of the target convolved with the image that a source of some size throws; 0 for a point."""
    image = blur(scene.channels(), lens, scene.target.screen, scene.target.irradiance())
    return 0.0 if image is None else image.rrmsd


# --- predictions ------------------------------------------------------------------------------------------------------

POWER = -0.6  # of the factor: the error that a larger design leaves
DETAIL = {"draft": 0.2, "standard": 0.02, "fine": 0.02}  # RRMSD by detail that the pilot does not see, over that detail
FINE = 0.7  # RRMSD in fine over that in standard quality
UNDONE = 0.5  # of the blur by a source of some size, that stage 3 leaves


def predictions(scene: Scene, pilots: Mapping[str, Pilot], gain: float = 1.0) -> dict[str, dict[str, Interval]]:
    """Seconds of the command, RRMSD, and GB of both processes as a sum, for each quality, by pilots of FLOWN.

    No quality has a larger RRMSD than the one below it, which does less.  gain: times the RRMSD by the pilots, for a
    scene with another net than theirs.
    """
    least, found = math.inf, {}
    for quality in QUALITIES:
        pilot, wanted = pilots[quality if quality in FLOWN else FLOWN[-1]], of_quality(scene, quality)
        least = min(least, gain * rrmsd(pilot, quality))
        likely = {"seconds": seconds(wanted, pilot), "rrmsd": least, "memory_gb": memory_gb(wanted)}
        found[quality] = {key: (each / WITHIN[key], each, each * WITHIN[key]) for key, each in likely.items()}
    return found


def rrmsd(pilot: Pilot, quality: str) -> float:
    """RRMSD of a whole design by that of its pilot, and by the detail and the blur that the pilot does not see."""
    seen = (FINE if quality == "fine" else 1.0) * pilot.factor**POWER * pilot.rrmsd
    return seen + DETAIL[quality] * pilot.detail + UNDONE * pilot.blurred


def seconds(scene: Scene, pilot: Pilot) -> float:
    """Seconds of a design: those of the stages of the pilot, as they grow with sizes, and the rest by the pace."""
    whole, small, took = usual(scene), usual(pilot.scene), pilot.seconds
    tailored = took.first * whole.first / small.first + took.search * whole.search / small.search
    return tailored + took.rest + pace() * whole.rest


# --- sizes ------------------------------------------------------------------------------------------------------------

TUBES, POINTS, PIXELS, GRID, ITERATIONS = 1024, 513, 512, 256, 40  # a side, or in all, of which the following is stated
KERNEL = 0.115  # seconds of cold_run.kernel on two cores of pace 1, on which the following is stated too
ROUND, TRANSPORT, FIT = 0.06, 0.2, 0.6  # seconds of stage 1: a round, the transport of GRID², a fit of POINTS²
TWO_FACES = 2.4  # seconds of the transport of GRID² behind two freeform faces, where the light between them is followed
BETWEEN = 3.0  # seconds of stage 1 of two freeform faces that do not grow with its sizes
FOUND = 1.0  # seconds in which the rays of a point through TUBES² given places are found
FRONT = 1.7  # seconds of the search for a curved front
EVALUATION, VARIABLE, BLUR = 0.11, 0.046, 0.30  # seconds of an evaluation: TUBES², POINTS², PIXELS² blurred by images
CALLED = 0.01  # seconds of an evaluation that do not grow with its sizes
IMAGES = 0.7  # seconds in which the images of a source of some size are found, in each round
ADAM = 0.1  # seconds of a step of the paper's procedure by TUBES² rays
STARTED = 2.8  # seconds of imports, and of the end of the process
WRITTEN, A_NET, A_PICTURE = 1.5, 2.4, 1.1  # seconds of writing, proof and report: in all, for POINTS², for PIXELS²
A_MOUNT = 2.5  # seconds of cutting and proving the mounted part
RAYS, RAYS_OF_A_DRAFT = 1.6, 1.0  # seconds of the rays of a proof, for a target and a wavelength; of a lamp twice that
WITNESS, WITNESS_OF_A_DRAFT = 6.0, 2.5  # seconds of the finer ray tubes that a second net needs, for a target
LIBRARIES = 1.5  # GB in both processes
CORNERS, NET_GB, PIXELS_GB = 0.12, 0.27, 0.02  # GB of TUBES² tubes, POINTS² control points, PIXELS² pixels
A_GOAL = 3.0  # memory for each of several goals over that of the tubes for one target


@cache
def pace() -> float:
    """Seconds that an evaluation takes on this machine over those on two cores of pace 1."""
    return min(timed(kernel()) for _ in range(REPEATS)) / KERNEL


def usual(scene: Scene) -> Seconds:
    """Seconds of a design on two cores of pace 1 by its sizes alone, where nothing in it is out of the ordinary."""
    knobs, point = scene.tailoring.resolved(scene.lens.back.net), not scene.source.parallel
    rest = STARTED + proved(scene)
    sheets, net, pixels = rounds(scene), (knobs.side / POINTS) ** 2, _pixels(scene)
    if knobs.method == "adam":
        counts = knobs.stage1_iterations * len(knobs.levels), knobs.stage2_iterations
        return Seconds(*(ADAM * (knobs.rays / TUBES) ** 2 * count for count in counts), rest)
    halvings, transport = (1, TWO_FACES) if scene.lens.front.is_tailored else (2, TRANSPORT)
    grids = [max(COARSEST_GRID, knobs.transport_grid // 2 ** min(left, halvings)) for left in range(knobs.rounds)]
    first = ROUND * knobs.rounds + (FRONT if scene.lens.front.free else 0.0)
    first += BETWEEN if scene.lens.front.is_tailored else 0.0
    first += transport * sum((grid / GRID) ** 2 for grid in grids) * knobs.transport_iterations / ITERATIONS
    fits = [fitted for level in knobs.levels[-2:] for fitted in scene.lens.nets(level)]
    first += FIT * sum(math.prod(as_pair(fitted)) for fitted in fits) / POINTS**2
    each, begun = CALLED + VARIABLE * net, JUDGING * pixels ** (2 / 3)  # seconds of an evaluation and a round
    if scene.source.extent is not None:
        each, begun = each + BLUR * pixels, begun + IMAGES
    launched = sum((tubes / TUBES) ** 2 for tubes, _ in sheets)
    search = sum(count * (EVALUATION * (tubes / TUBES) ** 2 + each) + begun for tubes, count in sheets)
    if point:
        sides = [*(SUBCELLS * grid for grid in grids), min(2 * knobs.side, knobs.rays)]
        first += FOUND * sum((side / TUBES) ** 2 for side in sides)
        search += FOUND * launched
    return Seconds(first, search + JUDGING * pixels ** (2 / 3), rest)


def rounds(scene: Scene) -> tuple[tuple[int, int], ...]:
    """(tubes a side, evaluations) of each round of stage 2 or 3."""
    knobs = scene.tailoring.resolved(scene.lens.back.net)
    if scene.source.extent is not None:
        columns, rows = zip(*(target.columns_rows for target in scene.targets), strict=True)
        return tuple(stage3_sheet_sizes(knobs, (max(columns), max(rows))))
    return tuple(sheet_sizes(knobs, round_shares(Task((), scene.goals, knobs, wave=scene.wavefront))))


def memory_gb(scene: Scene) -> float:
    """The most that both processes of a design hold, as a sum."""
    goals = len(scene.targets) + (scene.wavefront is not None)
    corners = max(tubes for tubes, _ in rounds(scene)) ** 2 / TUBES**2 * (A_GOAL * goals if goals > 1 else 1.0)
    return LIBRARIES + CORNERS * corners + NET_GB * _points(scene) + PIXELS_GB * _pixels(scene)


def proved(scene: Scene) -> float:
    """Seconds of writing, proof and report on two cores of pace 1; pipeline.reserve is a bound above it."""
    wide = not scene.source.parallel or scene.source.extent is not None
    draft = scene.tailoring.quality == "draft"
    rays, witness = (RAYS_OF_A_DRAFT, WITNESS_OF_A_DRAFT) if draft else (RAYS, WITNESS)
    a_target = rays * (2 if wide else 1) * len(scene.source.lines) + witness * (len(scene.lens.nets()) - 1)
    mounted = A_MOUNT if scene.mount is not None else 0.0
    return WRITTEN + A_NET * _points(scene) + A_PICTURE * _pixels(scene) + a_target * len(scene.targets) + mounted


def _points(scene: Scene) -> float:
    return sum(math.prod(as_pair(net)) for net in scene.lens.nets()) / POINTS**2


def _pixels(scene: Scene) -> float:
    return sum(math.prod(target.columns_rows) for target in scene.targets) / PIXELS**2
