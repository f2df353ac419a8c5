"""Stage 1: fit the last freeform face to an optimal transport map, as a smooth initial surface for stage 2.

In Wang et al. 2023 the optimal transport map φ carries points S_i of the source plane to points P_i^t = φ(S_i) of the
target, and the surface minimises Σ |P_i^t - P_i|² (Eq. 14), where rays through S_i land at P_i.  Here each round solves
the transport problem from points of the face to the slopes that send their light to the target (slope_map.py), and fits
the surface to these slopes by linear least squares (slope_fit.py).  The next round starts from the sag and the map of
this round; the last rounds use finer grids and nets.  If the result is poor, the map of the paper is tried too, in
rounds of a new map and slope fits to its target points (`follow_aims`).

Free parameters of the front (curvature, conic constant) are optimised before the first round; for each candidate the
back is fitted to the same target points.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.optimize
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.surfaces.sides import as_pair, coarser
from bstcad.optics.trace.reach import MAX_EXIT_ANGLE
from bstcad.optics.trace.trace import clear_window, trace
from bstcad.tailoring import slope_map
from bstcad.tailoring.driver import Parameters, StageStep, Steps, Task
from bstcad.tailoring.effort import FrontSearch
from bstcad.tailoring.machinability import place_back
from bstcad.tailoring.merit import mean_square_miss
from bstcad.tailoring.reachable import resample
from bstcad.tailoring.settings import CONIC_CONSTANTS, SEARCH_RANGE
from bstcad.tailoring.slope_fit import Fit, tailor_to_aim
from bstcad.tailoring.slope_map import SlopeMap
from bstcad.transport.bfm import TransportStep
from bstcad.transport.mapping import Mapping, Points, Solver

COARSE_FACE_FIT = Fit(bending=1e-2, steps=40, degree=3)  # fit of coarse rounds: stiff, extrapolates into the dark
FINE_FACE_FIT = Fit(unlit=1e-2)  # fit of fine rounds: weak fit to the previous slopes where no light falls
FINE_ROUNDS = 2  # number of fine rounds: the first has half the cells per side of the last
# RRMSD, and RMS change of the map in the last round, above which `follow_aims` is tried.  The unit of the change is
# half a side of the square around the light (`slope_map.square_grid`).  The change is at most 0.016 for lenses that
# further rounds do not improve.
RETRY_RRMSD, RETRY_CHANGE = 0.25, 0.025
SETTLED_CHANGE = 0.01  # RMS change of the map, in the unit of RETRY_CHANGE, below which coarse rounds end
MAX_RAY_CELLS = 1026  # largest number of rays per side for the slope fit; further points are interpolated between them
MIN_FLUX_RATIO = 0.9  # smallest accepted flux on the target after `follow_aims`, relative to the flux after the rounds
AIM_ROUNDS = 5  # number of rounds of `follow_aims`, each with a new map
SCALAR_EVALUATIONS = 8  # evaluations of the merit in the search for one parameter of the front
SIMPLEX_EVALUATIONS = 40  # evaluations of the merit in the search for both parameters, after that for one
MAX_RIM_SINE = 0.5  # sine of the largest slope angle of the front at the rim
MAX_ELLIPSE, MAX_HYPERBOLA = 0.8, 6.0  # largest (1 + k) c² r² and -(1 + k) c² r²: conic constant, curvature, rim radius
UNBOUNDED = (-math.inf, math.inf)

Range = tuple[float, float]  # lower and upper bound
FrontMerit = Callable[[Lens], float]  # merit of a front, after a fit of the back


@dataclass(frozen=True)
class SlopeRound:
    """State of stage 1 between two rounds."""

    round: int  # number of the next round, from 0; skipped rounds count
    lens: Parameters
    slopes: SlopeMap  # map of the last round


def steps(task: Task, lens: Lens, state: SlopeRound | None = None) -> Steps:
    """Yield the steps of stage 1 from a blank, or from a saved state.

    The rounds come first (`follow_slopes`), then `follow_aims` if their result is poor (`is_poor_result`).  The
    lens of `follow_aims` is used if its RRMSD is smaller and it keeps MIN_FLUX_RATIO of the flux on the target.
    """
    lens = task.heaviest.through(lens)
    if state is None and task.free:
        few, settings = task.effort.front_net, task.settings
        net = settings.levels[0] if few is None else coarser(lens.back_net.shape, few)
        effort = task.effort.front_search or FrontSearch(iterations=settings.transport_iterations)
        source, blank = task.heaviest.source, lens.refined(net)
        shaped = shaped_front(source, blank, task.goals[0], task.free, rim_sags=task.rim_sags, effort=effort)
        lens = lens.with_front(shaped.front)
    for last in follow_slopes(task, lens, state):
        yield last
    if not task.effort.rates_lenses:
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
    """Return True if the result of the rounds is poor: a large RRMSD, or a map that still changes.

    by_rays: RRMSD of the lens; if large, it is computed again without detail that the net cannot resolve.
    """
    goal = task.goals[0]
    few = resample(goal, pixels=max(as_pair(task.settings.levels[-1])))
    if by_rays > RETRY_RRMSD and few.screen.shape != goal.screen.shape:
        by_rays = replace(task, goals=(few,)).rrmsd(lens)
    return not by_rays <= RETRY_RRMSD or state.slopes.moved > RETRY_CHANGE  # NaN: no light on the target


def follow_slopes(task: Task, lens: Lens, state: SlopeRound | None = None) -> Steps:
    """Yield a step per round of transport map and slope fit, each from the sag and the map of the previous round.

    All rounds except the last FINE_ROUNDS use coarse grids and nets, which are fast.  Once the map has settled, the
    remaining coarse rounds are skipped.
    """
    settings, z = task.settings, lens.back.z  # z: plane of the back in the blank (mm)
    slopes, done = (None, 0) if state is None else (state.slopes, state.round)
    lens = lens if state is None else state.lens.apply_to(lens)
    number = min(done, settings.rounds - 1)
    while number < settings.rounds:
        if slopes is None or number >= done:
            lens, slopes = _round(task, lens, slopes, number)
            lens = place_back(lens, z, task.min_thickness, task.bounds)  # the next round starts from the shifted back
            task.tidy()
        number = next_round(number, settings.rounds, fine=FINE_ROUNDS, settled=slopes.moved <= SETTLED_CHANGE)
        yield round_step(task, lens, SlopeRound(number, Parameters.of(lens), slopes), slopes.face_points)


def next_round(number: int, rounds: int, fine: int, settled: bool) -> int:
    """Return the number of the next round; if the map has settled, at least `rounds` - `fine`, the first fine round."""
    return max(number + 1, rounds - fine) if settled else number + 1


def round_step(task: Task, lens: Lens, state: SlopeRound, face_points: Points) -> StageStep:
    """Return the step after a round; face_points: points (mm) of the last tailored face for the pixel corners."""
    make = partial(task.refined, lens, task.settings.levels[-1])
    progress = "stage 1", state.round, task.settings.rounds, ""
    return StageStep(make, state, mapping=state.slopes.mapping, face_points=face_points, progress=progress)


def _round(task: Task, lens: Lens, previous: SlopeMap | None, number: int) -> tuple[Lens, SlopeMap]:
    """Run the round of this number (from 0); return the lens and the map to which it is fitted."""
    settings, source, goal, left = task.settings, task.heaviest.source, task.goals[0], task.settings.rounds - number
    cells = max(task.effort.coarsest_grid, settings.transport_grid // 2 ** min(left - 1, 2))
    m = settings.levels[max(-left, -len(settings.levels))] if left <= FINE_ROUNDS else settings.levels[0]

    def progress(s: TransportStep) -> None:
        task.progress("stage 1", number, settings.rounds, f"{s.grid}² cells, mass error {s.mass_error:.4f}")

    lens = task.refined(lens, m)
    window = slope_map.lit_window(source, lens)
    grid = slope_map.square_grid(source, lens, window, cells)
    solver = Solver(settings.transport_iterations, progress=progress)
    slopes = slope_map.slope_map(lens, grid, goal, previous, solver=solver, effort=task.effort.gathering)
    sides = [min(2 * points, settings.rays) for points in as_pair(m)]
    parts = math.ceil(max(sides) / MAX_RAY_CELLS)
    grid = slope_map.face_grid(source, lens, window, (math.ceil(sides[0] / parts), math.ceil(sides[1] / parts)))
    grazing = MAX_EXIT_ANGLE if task.edge is None else task.edge.angle
    fit = FINE_FACE_FIT if left <= FINE_ROUNDS else COARSE_FACE_FIT
    return slope_map.fit_to_map(lens, slopes, grid, fit, parts=parts, grazing=grazing), slopes


def follow_aims(task: Task, lens: Lens) -> tuple[Lens, Mapping]:
    """Return the given lens fitted to maps of the paper (`slope_map.map_to_target`) in rounds, and the last map.

    The face is fitted to slopes, while the paper minimises |P_i^t - P_i|².  In a round a ray keeps its aim.  So these
    slope fits converge even if the slopes needed at fixed points of the back depend strongly on the sag: in strong
    lenses near the source, and in glass of low index.  The part of these slopes that is not a gradient is lost.
    """
    settings, goal, z = task.settings, task.goals[0], lens.back.z
    for number in range(AIM_ROUNDS):
        n, m = settings.transport_grid, settings.levels[-1]
        if number < AIM_ROUNDS - 1:
            n, m = task.effort.coarsest_grid, settings.levels[0]
        lens = task.refined(lens, m)
        points = max(as_pair(m))
        side = min(3 * points, max(2 * points, settings.rays))  # many rays may leave through the sides
        counts = {"n": n, "side": side, "iterations": settings.transport_iterations}
        rays, aims, mapping = aimed_rays(task.heaviest.source, lens, goal, **counts)
        lens = place_back(tailor_to_aim(lens, rays, aims, goal.screen.receiver), z, task.min_thickness, task.bounds)
    return lens, mapping


def aimed_rays(
    source: Emitter, lens: Lens, goal: Goal, n: int, side: int, iterations: int
) -> tuple[Rays, Tensor, Mapping]:
    """Return side x side rays in `clear_window`, their aims in the target's unit, and their map on n x n cells."""
    mapping = slope_map.map_to_target(source, lens, goal, n, solver=Solver(iterations))
    area = clear_window(source, lens)
    x, y = (t.to(lens.like) for t in sampling.grid(area, side))
    rays = source.rays_through(x, y, lens.entrance.z, area.area / side**2)
    return rays, slope_map.aim_points(mapping, lens, goal.screen, x=x, y=y), mapping


def shaped_front(
    source: Emitter, lens: Lens, goal: Goal, free: tuple[str, ...], rim_sags: Range, effort: FrontSearch
) -> Lens:
    """Return the lens with the front whose best back has the smallest mean |P_i^t - P_i|² (Wang et al. 2023, Eq. 14).

    free, rim_sags: parameters of the front and range of its sag, see `best_front`.  The back has the net of `lens`, and
    is fitted to each front: rays keep the aims P_i^t that they have with the front of `lens`.
    """
    side, receiver = 2 * max(lens.back_net.shape), goal.screen.receiver
    rays, aims, _ = aimed_rays(source, lens, goal, n=effort.cells, side=side, iterations=effort.iterations)

    def miss(front: Lens) -> float:
        fitted = tailor_to_aim(front, rays, aims, receiver=receiver, repeats=effort.repeats)
        return float(mean_square_miss(trace(rays, fitted, receiver), aims))

    return lens.with_front(best_front(miss, lens, free, rim_sags).front)


def best_front(merit: FrontMerit, lens: Lens, free: tuple[str, ...], rim_sags: Range = UNBOUNDED) -> Lens:
    """Return the lens whose front minimises `merit`: in the curvature, then with the conic constant if it is free.

    Bounds: at the rim the slope angle of the front is at most 30°, the sag is at most half of the blank's thickness,
    and the sag (mm) lies in `rim_sags`, (low, high).
    """
    if "curvature" in free:
        bounds = _curvatures(lens, rim_sags, float(lens.front.curvature))
        lens = _optimise_one("curvature", merit, lens, bounds=bounds, tolerance=1e-4)
    if "conic_constant" in free and lens.front.curvature:
        if "curvature" in free:
            return _optimise_two(merit, lens, rim_sags)
        present, (low, high) = float(lens.front.conic_constant), _conic_constants(lens, rim_sags)
        low, high = min(low, present), max(high, present)
        lens = _optimise_one("conic_constant", merit, lens, bounds=(low, high), tolerance=1e-3 * (high - low))
    return lens


def _with_front(lens: Lens, **values: float) -> Lens:
    return lens.with_front(lens.front.with_parameters(**values))


def _optimise_one(name: str, merit: FrontMerit, lens: Lens, bounds: Range, tolerance: float) -> Lens:
    """Return the lens with the best value of one parameter by Brent's bounded search, or the present value."""

    def at(value: float) -> float:
        return merit(_with_front(lens, **{name: float(value)}))

    options = {"maxiter": SCALAR_EVALUATIONS, "xatol": tolerance}
    search = scipy.optimize.minimize_scalar(at, bounds=bounds, method="bounded", options=options)
    start = float(lens.front.parameters()[name])
    best = float(search.x) if search.fun < at(start) else start
    return _with_front(lens, **{name: best})


def _optimise_two(merit: FrontMerit, lens: Lens, rim_sags: Range) -> Lens:
    """Return the lens with the best curvature and conic constant, by a Nelder-Mead simplex from the present values."""
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
    """Return the distance (mm) of the corners of the outline's bounding box from the axis."""
    return sum(half**2 for half in lens.outline.half_extent) ** 0.5


def _curvatures(lens: Lens, rim_sags: Range, *included: float) -> Range:
    """Return the range of curvatures c (1/mm) that `best_front` allows with the front's conic constant k.

    A slope angle at r with the sine S needs c = S / (r sqrt(1 + k S²)).  included: values to include where possible.
    """
    rim, k = _rim_radius(lens), float(lens.front.conic_constant)
    room = (lens.back.z - lens.front.z) / 2
    bent = 1 + k * MAX_RIM_SINE**2
    limit = MAX_RIM_SINE / rim / math.sqrt(bent) if bent > 0 else math.inf
    if k != -1:
        limit = min(limit, math.sqrt((MAX_ELLIPSE if k > -1 else MAX_HYPERBOLA) / abs(1 + k)) / rim)
    low, high = (_curvature_of_sag(sag, math.hypot(*lens.outline.farthest), k) for sag in rim_sags)
    return max(-limit, min((low, *included))), min(limit, _curvature_of_sag(room, rim, k), max((high, *included)))


def _curvature_of_sag(h: float, r: float, k: float) -> float:
    """Return the curvature c = 2 h / (r² + (1 + k) h²) of a conic of sag h at r; h is limited near a vertical slope."""
    p = 1 + k
    if p == 0:
        return 2 * h / (r * r)
    limit = SEARCH_RANGE * r / math.sqrt(abs(p))
    h = max(-limit, min(h, limit))
    return 2 * h / (r * r + p * h * h)


def _conic_constants(lens: Lens, rim_sags: Range) -> Range:
    """Return the range of conic constants k that `best_front` allows with the front's curvature c.

    tan² of the slope angle at r is c² r² / (1 - (1 + k) c² r²); a sag h at r needs 1 + k = (2 h - c r²) / (c h²).
    """
    k_min, k_max = CONIC_CONSTANTS
    c, rim = float(lens.front.curvature), _rim_radius(lens)
    room = (lens.back.z - lens.front.z) / 2
    bent = (c * rim) ** 2
    sag = abs(rim_sags[0]) if c < 0 else min(rim_sags[1], room)
    steep = 1 / bent - (1 - MAX_RIM_SINE**2) / MAX_RIM_SINE**2
    deep = (2 * sag - abs(c) * rim**2) / (abs(c) * sag**2) if sag < math.inf else steep
    return max(-MAX_HYPERBOLA / bent - 1, k_min), min(steep, deep, MAX_ELLIPSE / bent, 1 + k_max) - 1
