"""Stage 1: fit the last freeform face to an optimal transport map, which gives stage 2 a smooth first surface.

In Wang et al. 2023 the optimal transport map φ carries points S_i of the source plane to points P_i^t = φ(S_i) of the
target, and the surface minimises Σ |P_i^t - P_i|² (Eq. 14), P_i the traced landing points of rays through S_i.  Here
each round solves the transport problem from points of the face to the slopes that send their light to the target
(slope_map.py), and fits the surface to these slopes by linear least squares (slope_fit.py).  The next round starts
from the sag and the map of this one, on finer grids and nets at the end.  If the result is poor, the map and the merit
of the paper are tried too (`follow_aims`).

Free parameters of the front (curvature, conic constant) are optimised before, each candidate with its best back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.optimize
from torch import Tensor

from bstcad.optics import sampling
from bstcad.optics.emitters import Emitter
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.rays import Rays
from bstcad.optics.reach import MAX_EXIT_ANGLE
from bstcad.optics.sides import as_pair, coarser
from bstcad.optics.trace import clear_window, trace
from bstcad.scene.blank import CONIC_CONSTANTS
from bstcad.scene.quality import COARSEST_GRID
from bstcad.scene.scene import SEARCH_RANGE
from bstcad.tailoring.machinability import place_back
from bstcad.tailoring.merit import landing
from bstcad.tailoring.reachable import resample
from bstcad.tailoring.run import Parameters, StageStep, Task
from bstcad.tailoring.slope_fit import Fit, tailor_to_aim
from bstcad.tailoring.slope_map import SlopeMap, aim_points, face_grid, fit_to_map, lit_window, map_to_target, slope_map
from bstcad.transport.bfm import TransportStep
from bstcad.transport.mapping import Mapping

COARSE_FACE_FIT = (Fit(bending=1e-2, steps=40, degree=3), 0.0)  # fit, weight of unlit points: stiff, extrapolates there
FINE_FACE_FIT = (Fit(), 1e-2)  # fit, weight of unlit points: these keep the slopes of the coarse face
FINE_ROUNDS = 2  # number of rounds at the end on half of the transport's grid and on all of it
# RRMSD, and RMS change of the map in the last round in half widths of the face, above which `follow_aims` is tried.
# The change is at most 0.016 where more rounds gain nothing.
RETRY_RRMSD, RETRY_CHANGE = 0.25, 0.025
SETTLED_CHANGE = 0.01  # RMS change of the map, in the same unit, below which the coarse rounds end
MAX_RAY_CELLS = 1026  # largest number of cells a side for which a ray is sought: cells of a finer grid share their rays
MIN_FLUX_RATIO = 0.9  # smallest flux on the target of a lens of `follow_aims` over that of the rounds
AIM_ROUNDS = 5  # rounds of `follow_aims`
SCALAR_EVALUATIONS = 8  # evaluations of the merit in the search for one parameter of the front
SIMPLEX_EVALUATIONS = 40  # evaluations of the merit in the search for curvature and conic constant together
MAX_RIM_SINE = 0.5  # sine of the largest slope angle of the front at the rim
MAX_ELLIPSE, MAX_HYPERBOLA = 0.8, 6.0  # largest (1 + k) c² r² and -(1 + k) c² r² at the rim; scenes allow a little more
UNBOUNDED = (-math.inf, math.inf)

PREVIEW_NET, PREVIEW_FRONT = 17, {"n": 32, "iterations": 40, "repeats": 1}  # `shaped_front` in a preview

Range = tuple[float, float]
FrontMerit = Callable[[Lens], float]


@dataclass(frozen=True)
class SlopeRound:
    """State of stage 1 between two rounds."""

    round: int  # number of rounds done
    lens: Parameters
    wanted: SlopeMap  # map of the last round


def steps(task: Task, lens: Lens, state: SlopeRound | None = None) -> Iterator[StageStep]:
    """Yield the steps of stage 1 for a blank, or from a saved state on.

    The rounds come first (`follow_slopes`), then `follow_aims` if their result is poor (`is_poor_result`).
    """
    lens, goal = task.heaviest.through(lens), task.goals[0]
    if state is None and task.free:
        net, settings = task.knobs.levels[0], {"iterations": task.knobs.transport_iterations}
        if task.preview:
            net, settings = coarser(lens.back_net.shape, PREVIEW_NET), PREVIEW_FRONT
        settings = settings | {"free": task.free, "rim_sags": task.rim_sags}
        shaped = shaped_front(task.heaviest.source, lens.refined(net), goal.picture, goal.receiver, **settings)
        lens = lens.with_front(shaped.front)
    for last in follow_slopes(task, lens, state):
        yield last
    if task.preview:
        return
    first, by_rays = last.lens, task.rrmsd(last.lens)
    yield replace(last, state=None, rays_rrmsd=by_rays)
    if not is_poor_result(task, first, by_rays, last.state):
        return
    other, mapping = follow_aims(task, first.with_last_net(lens.nets[-1]))
    value = task.rrmsd(other)
    better = value < np.nan_to_num(by_rays, nan=np.inf)  # NaN: no light on the target
    if better and task.flux_on_target(other) >= MIN_FLUX_RATIO * task.flux_on_target(first):
        yield StageStep(lambda: other, mapping=mapping, rays_rrmsd=value)


def is_poor_result(task: Task, lens: Lens, by_rays: float, state: SlopeRound) -> bool:
    """Return True if the result of the rounds is poor: a large RRMSD, or a map that still moves.

    The RRMSD counts at no more pixels than the net has control points: no method shows finer detail.
    """
    goal = task.goals[0]
    few = resample(goal, pixels=max(as_pair(task.knobs.levels[-1])))
    if by_rays > RETRY_RRMSD and few.receiver.shape != goal.receiver.shape:
        by_rays = replace(task, goals=(few,)).rrmsd(lens)
    return not by_rays <= RETRY_RRMSD or state.wanted.moved > RETRY_CHANGE  # NaN: no light on the target


def follow_slopes(task: Task, lens: Lens, state: SlopeRound | None = None) -> Iterator[StageStep]:
    """Yield a step per round of transport map and slope fit, each from the sag and the map of the round before.

    All rounds but the last FINE_ROUNDS use coarse grids and nets, where they are cheap; they end once the map settles.
    """
    knobs = task.knobs
    wanted, done, z = None, 0, lens.back.z  # z: plane of the back in the blank (mm)
    if state is not None:
        lens, wanted, done = state.lens.apply_to(lens), state.wanted, state.round
    turn = min(done, knobs.rounds - 1)
    while turn < knobs.rounds:
        if turn >= done:
            lens, wanted = _round(task, lens, wanted, turn)
            lens = place_back(lens, z, task.min_thickness, task.bounds)  # the next round takes the move into account
            task.tidy()
        turn = max(turn + 1, knobs.rounds - FINE_ROUNDS if wanted.moved <= SETTLED_CHANGE else 0)
        state = SlopeRound(turn, Parameters.of(lens), wanted)
        yield StageStep(
            partial(task.refined, lens, knobs.levels[-1]), state, mapping=wanted.mapping, places=wanted.places,
            progress=("stage 1", turn, knobs.rounds, ""),
        )  # fmt: skip


def _round(task: Task, lens: Lens, wanted: SlopeMap | None, turn: int) -> tuple[Lens, SlopeMap]:
    """Run one round; return the lens and the map that it follows."""
    knobs, source, goal, left = task.knobs, task.heaviest.source, task.goals[0], task.knobs.rounds - turn
    cells = max(COARSEST_GRID, knobs.transport_grid // 2 ** min(left - 1, 2))
    m = knobs.levels[max(-left, -len(knobs.levels))] if left <= FINE_ROUNDS else knobs.levels[0]

    def progress(s: TransportStep) -> None:
        task.progress("stage 1", turn, knobs.rounds, f"{s.grid}² cells, mass error {s.mass_error:.4f}")

    lens = task.refined(lens, m)
    window = lit_window(source, lens)
    settings = {"iterations": knobs.transport_iterations, "progress": progress, "preview": task.preview}
    screen = goal.receiver
    wanted = slope_map(source, lens, window, goal.picture, screen=screen, n=cells, previous=wanted, **settings)
    sides = [min(2 * points, knobs.rays) for points in as_pair(m)]
    parts = math.ceil(max(sides) / MAX_RAY_CELLS)
    grid = face_grid(source, lens, window, (math.ceil(sides[0] / parts), math.ceil(sides[1] / parts)))
    grazing = MAX_EXIT_ANGLE if task.edge is None else task.edge.angle
    fit = FINE_FACE_FIT if left <= FINE_ROUNDS else COARSE_FACE_FIT
    return fit_to_map(lens, wanted, grid, *fit, parts, grazing), wanted


def follow_aims(task: Task, lens: Lens) -> tuple[Lens, Mapping]:
    """Return the lens of the paper's method, and its map: from the front to target points, then fits of the slopes.

    A ray keeps its aim while the sag changes.  So this converges even where the slopes needed at fixed points of the
    back change much with the sag: in strong lenses near the source, and in glass of low index.  The part of the map
    that is not a gradient is lost.
    """
    knobs, goal, z = task.knobs, task.goals[0], lens.back.z
    for turn in range(AIM_ROUNDS):
        n, m = (COARSEST_GRID, knobs.levels[0]) if turn < AIM_ROUNDS - 1 else (knobs.transport_grid, knobs.levels[-1])
        lens = task.refined(lens, m)
        side = min(3 * max(as_pair(m)), max(2 * max(as_pair(m)), knobs.rays))  # many rays may leave through the sides
        counts = {"n": n, "side": side, "iterations": knobs.transport_iterations}
        rays, wanted, mapping = aimed_rays(task.heaviest.source, lens, goal.picture, goal.receiver, **counts)
        lens = place_back(tailor_to_aim(lens, rays, wanted, goal.receiver.plane), z, task.min_thickness, task.bounds)
    return lens, mapping


def aimed_rays(
    source: Emitter, lens: Lens, target: np.ndarray, screen: Screen, n: int, side: int, iterations: int
) -> tuple[Rays, Tensor, Mapping]:
    """Return side x side rays over the front, the aim of each on the target (mm), and the map on n x n cells."""
    mapping = map_to_target(source, lens, target, screen=screen, n=n, iterations=iterations, progress=lambda _: None)
    area = clear_window(source, lens)
    x, y = (t.to(lens.like) for t in sampling.grid(area, side))
    rays = source.rays(x, y, lens.entrance.z, area.area / side**2)
    return rays, aim_points(mapping, lens, screen, x=x, y=y), mapping


def shaped_front(
    source: Emitter, lens: Lens, target: np.ndarray, screen: Screen, free: tuple[str, ...],
    rim_sags: tuple[float, float], n: int = COARSEST_GRID, iterations: int = 100, repeats: int = 3,
) -> Lens:  # fmt: skip
    """Return the lens with the front that minimises the merit of stage 1 in Wang et al. 2023, Eq. 14.

    The merit, the mean of |P_i^t - P_i|², is that of the best back for each front, on the net of `lens`.
    n, iterations: cells a side and iterations of the map; repeats: fits of the slopes for each front.
    """
    side, plane = 2 * max(lens.back_net.shape), screen.plane
    rays, wanted, _ = aimed_rays(source, lens, target, screen=screen, n=n, side=side, iterations=iterations)

    def miss(tried: Lens) -> float:
        fitted = tailor_to_aim(tried, rays, wanted, plane=plane, repeats=repeats)
        return float(landing(trace(rays, fitted, plane), wanted))

    return lens.with_front(best_front(miss, lens, free, rim_sags).front)


def best_front(merit: FrontMerit, lens: Lens, free: tuple[str, ...], rim_sags: Range = UNBOUNDED) -> Lens:
    """Return the lens whose front minimises `merit` in its free parameters; the merit refits the back each time.

    Bounds: at the rim the slope of the front is at most 30°, half of the blank's thickness is left, and the sag (mm)
    is in `rim_sags`.
    """
    if "curvature" in free:
        own = float(lens.front.curvature)
        lens = _optimise_one("curvature", merit, lens, bounds=_curvatures(lens, rim_sags, own), tolerance=1e-4)
    if "conic_constant" in free and lens.front.curvature:
        if "curvature" in free:
            return _optimise_two(merit, lens, rim_sags)
        own = float(lens.front.conic_constant)
        low, high = _conic_constants(lens, rim_sags)
        low, high = min(low, own), max(high, own)
        lens = _optimise_one("conic_constant", merit, lens, bounds=(low, high), tolerance=1e-3 * (high - low))
    return lens


def _with_front(lens: Lens, **values: float) -> Lens:
    return lens.with_front(lens.front.with_parameters(**values))


def _optimise_one(name: str, merit: FrontMerit, lens: Lens, bounds: Range, tolerance: float) -> Lens:
    """Return the lens with the best value of one parameter by Brent's bounded search, or its present value."""

    def at(value: float) -> float:
        return merit(_with_front(lens, **{name: float(value)}))

    options = {"maxiter": SCALAR_EVALUATIONS, "xatol": tolerance}
    search = scipy.optimize.minimize_scalar(at, bounds=bounds, method="bounded", options=options)
    start = float(lens.front.parameters()[name])
    best = float(search.x) if search.fun < at(start) else start
    return _with_front(lens, **{name: best})


def _optimise_two(merit: FrontMerit, lens: Lens, rim_sags: Range) -> Lens:
    """Return the lens with the best curvature and conic constant by Nelder and Mead's simplex from the present ones."""
    c, k = (float(value) for value in (lens.front.curvature, lens.front.conic_constant))

    def at(tried: np.ndarray) -> float:
        trial = _with_front(lens, curvature=float(tried[0]), conic_constant=float(tried[1]))
        if not tried[0]:
            return math.inf
        (low, high), (k_min, k_max) = _curvatures(trial, rim_sags), _conic_constants(trial, rim_sags)
        possible = low <= tried[0] <= high and k_min <= tried[1] <= k_max
        return merit(trial) if possible or tuple(tried) == (c, k) else math.inf

    low, high = _curvatures(lens, rim_sags)
    step = (high - low) / 16 * (1 if c + (high - low) / 16 <= high else -1)
    simplex = np.array([[c, k], [c + step, k], [c, k - 1.0]])
    options = {"initial_simplex": simplex, "maxfev": SIMPLEX_EVALUATIONS, "xatol": 1e-5}
    search = scipy.optimize.minimize(at, simplex[0], method="Nelder-Mead", options=options)
    best = search.x if search.fun < math.inf else simplex[0]
    return _with_front(lens, curvature=float(best[0]), conic_constant=float(best[1]))


def _rim_radius(lens: Lens) -> float:
    """Return the distance of the bounding box's corners from the axis (mm)."""
    return sum(half**2 for half in lens.outline.half_extent) ** 0.5


def _curvatures(lens: Lens, rim_sags: Range, *own: float) -> Range:
    """Return the range of curvatures c (1/mm) that `best_front` allows with the front's conic constant k.

    The slope angle at r has the sine S where c = S / (r sqrt(1 + k S²)).  own: values to include where possible.
    """
    rim, k = _rim_radius(lens), float(lens.front.conic_constant)
    room = (lens.back.z - lens.front.z) / 2
    bent = 1 + k * MAX_RIM_SINE**2
    limit = MAX_RIM_SINE / rim / math.sqrt(bent) if bent > 0 else math.inf
    if k != -1:
        limit = min(limit, math.sqrt((MAX_ELLIPSE if k > -1 else MAX_HYPERBOLA) / abs(1 + k)) / rim)
    low, high = (_curvature_of_sag(sag, math.hypot(*lens.outline.farthest), k) for sag in rim_sags)
    return max(-limit, min((low, *own))), min(limit, _curvature_of_sag(room, rim, k), max((high, *own)))


def _curvature_of_sag(h: float, r: float, k: float) -> float:
    """Return the curvature c = 2 h / (r² + (1 + k) h²) of a conic of sag h at r, short of a vertical slope there."""
    p = 1 + k
    if p == 0:
        return 2 * h / (r * r)
    limit = SEARCH_RANGE * r / math.sqrt(abs(p))
    h = max(-limit, min(h, limit))
    return 2 * h / (r * r + p * h * h)


def _conic_constants(lens: Lens, rim_sags: Range) -> Range:
    """Return the range of conic constants k that `best_front` allows with the front's curvature c.

    tan² of the slope angle at r is c² r² / (1 - (1 + k) c² r²); the sag at r is h where 1 + k = (2 h - c r²) / (c h²).
    """
    k_min, k_max = CONIC_CONSTANTS
    c, rim = float(lens.front.curvature), _rim_radius(lens)
    room = (lens.back.z - lens.front.z) / 2
    bent = (c * rim) ** 2
    sag = abs(rim_sags[0]) if c < 0 else min(rim_sags[1], room)
    steep = 1 / bent - (1 - MAX_RIM_SINE**2) / MAX_RIM_SINE**2
    deep = (2 * sag - abs(c) * rim**2) / (abs(c) * sag**2) if sag < math.inf else steep
    return max(-MAX_HYPERBOLA / bent - 1, k_min), min(steep, deep, MAX_ELLIPSE / bent, 1 + k_max) - 1
