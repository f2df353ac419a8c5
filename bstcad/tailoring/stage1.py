"""Stage 1: a surface that follows the transport map, by rounds of transport in slope coordinates and least squares.

A front of which something is free is shaped first, each time with the best back for it.
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
from bstcad.optics.reach import GRAZING
from bstcad.optics.sides import both, coarser
from bstcad.optics.trace import clear_window, trace
from bstcad.scene.blank import CONIC_CONSTANTS
from bstcad.scene.quality import COARSEST_GRID
from bstcad.scene.scene import INSIDE
from bstcad.tailoring.machinability import moved_clear
from bstcad.tailoring.merit import landing
from bstcad.tailoring.reachable import coarse
from bstcad.tailoring.run import Parameters, Step, Task
from bstcad.tailoring.slope_fit import Fit, tailor_to_aim
from bstcad.tailoring.slope_map import SlopeMap, aim_points, face_grid, lit_window, map_to_target, slope_map, sloped
from bstcad.transport.bfm import Step as TransportStep
from bstcad.transport.mapping import Mapping

COARSE = (Fit(bending=1e-2, steps=40, degree=3), 0.0)  # stiff: it also extrapolates into unlit areas
FINE = (Fit(), 1e-2)  # there it holds on to the coarse face
FINE_ROUNDS = 2  # the last ones, on half of the transport's grid and on all of it
# The other way is tried from this RRMSD on, and where the map has not settled: where in the last round the places of
# the target moved by more than this share of the face.  (Found: at most 0.016 where more rounds gain nothing.)
RETRY_ABOVE, UNSETTLED = 0.25, 0.025
SETTLED = 0.01  # of the same share: the coarse rounds end where the places moved by less
LIT = 1026  # cells a side, at most, each of which is asked whether light meets it: each costs the search for a ray
KEPT_LIGHT = 0.9  # of the light on the target, which the lens fitted to aims must keep to be taken
AIMS = 5  # rounds of `follow_aims`
EVALUATIONS = 8  # of the merit, in the search for one number of a front
BOTH = 40  # evaluations for the curvature and the conic constant together
STEEPEST = 0.5  # sine of the angle of a front's slope at the rim
UPRIGHT, CONE = 0.8, 6.0  # (1 + k) c² r² at the rim, and -(1 + k) c² r²: a scene would refuse a little more
UNBOUNDED = (-math.inf, math.inf)

HASTY_NET, HASTY = 17, {"n": 32, "iterations": 40, "repeats": 1}  # by which a front is sought for a preview

Range = tuple[float, float]
Merit = Callable[[Lens], float]


@dataclass(frozen=True)
class SlopeRound:
    """Where stage 1 stands between two rounds."""

    round: int  # of those that are done
    lens: Parameters
    wanted: SlopeMap


def steps(task: Task, lens: Lens, state: SlopeRound | None = None) -> Iterator[Step]:
    """Stage 1 from a blank lens, or further from a state: its rounds, and the other way where they come to little."""
    lens, goal = task.heaviest.through(lens), task.goals[0]
    if state is None and task.free:
        net, pains = task.knobs.levels[0], {"iterations": task.knobs.transport_iterations}
        if task.hasty:
            net, pains = coarser(lens.back.shape, HASTY_NET), HASTY
        shaped = shaped_front(
            task.heaviest.source, lens.refined(net), goal.picture, screen=goal.receiver, free=task.free,
            rim_sags=task.rim_sags, **pains,
        )  # fmt: skip
        lens = lens.with_front(shaped.front)
    for last in follow_slopes(task, lens, state):
        yield last
    if task.hasty:
        return
    first, judged = last.lens, task.rrmsd(last.lens)
    yield replace(last, state=None, judged=judged)
    if not doubtful(task, first, judged, last.state):
        return
    other, mapping = follow_aims(task, first.with_last_net(lens.nets[-1]))
    value = task.rrmsd(other)
    better = value < np.nan_to_num(judged, nan=np.inf)  # NaN: no light on the target
    if better and task.used(other) >= KEPT_LIGHT * task.used(first):
        yield Step(lambda: other, mapping=mapping, judged=value)


def doubtful(task: Task, lens: Lens, judged: float, state: SlopeRound) -> bool:
    """Are the lens of the rounds, its RRMSD and their last state a reason to try the other way?

    Detail that a net of fewer points than the target has pixels cannot show is no reason: no other way would show it.
    """
    goal = task.goals[0]
    few = coarse(goal, most=max(both(task.knobs.levels[-1])))
    if judged > RETRY_ABOVE and few.receiver.shape != goal.receiver.shape:
        judged = replace(task, goals=(few,)).rrmsd(lens)
    return not judged <= RETRY_ABOVE or state.wanted.moved > UNSETTLED  # NaN: no light on the target


def follow_slopes(task: Task, lens: Lens, state: SlopeRound | None = None) -> Iterator[Step]:
    """Rounds of transport map (last net to slopes) and slope fit, each from the sag and the map of the round before.

    All but the last two work on coarse grids and nets, where they cost next to nothing; they end once they are settled.
    """
    knobs = task.knobs
    wanted, done, z = None, 0, lens.back.z  # z: where the back was to be (mm)
    if state is not None:
        lens, wanted, done = state.lens.applied(lens), state.wanted, state.round
    turn = min(done, knobs.rounds - 1)
    while turn < knobs.rounds:
        if turn >= done:
            lens, wanted = _round(task, lens, wanted, turn)
            lens = moved_clear(lens, z, task.least, task.bounds)  # the next round reckons with where the back is now
            task.tidy()
        turn = max(turn + 1, knobs.rounds - FINE_ROUNDS if wanted.moved <= SETTLED else 0)
        yield Step(
            partial(task.refined, lens, knobs.levels[-1]),
            SlopeRound(turn, Parameters.of(lens), wanted),
            mapping=wanted.mapping,
            places=wanted.places,
            progress=("stage 1", turn, knobs.rounds, ""),
        )


def _round(task: Task, lens: Lens, wanted: SlopeMap | None, turn: int) -> tuple[Lens, SlopeMap]:
    """One round: the lens, and the map that it follows."""
    knobs, source, goal, left = task.knobs, task.heaviest.source, task.goals[0], task.knobs.rounds - turn
    coarse = max(COARSEST_GRID, knobs.transport_grid // 2 ** min(left - 1, 2))
    m = knobs.levels[max(-left, -len(knobs.levels))] if left <= FINE_ROUNDS else knobs.levels[0]

    def progress(s: TransportStep) -> None:
        task.progress("stage 1", turn, knobs.rounds, f"{s.grid}² cells, mass error {s.mass_error:.4f}")

    lens = task.refined(lens, m)
    window = lit_window(source, lens)
    wanted = slope_map(
        source, lens, window, picture=goal.picture, screen=goal.receiver, n=coarse, previous=wanted,
        iterations=knobs.transport_iterations, progress=progress, hasty=task.hasty,
    )  # fmt: skip
    sides = [min(2 * points, knobs.rays) for points in both(m)]
    parts = math.ceil(max(sides) / LIT)
    grid = face_grid(source, lens, window, (math.ceil(sides[0] / parts), math.ceil(sides[1] / parts)))
    grazing = GRAZING if task.edge is None else task.edge.angle
    return sloped(lens, wanted, grid, *(FINE if left <= FINE_ROUNDS else COARSE), parts, grazing), wanted


def follow_aims(task: Task, lens: Lens) -> tuple[Lens, Mapping]:
    """Wang et al.'s map from the front to target points, followed by fits of the back's slopes to these aims.

    A ray keeps its aim while the sag moves, so this converges even where the slopes needed at points of the back change
    much with the sag: at strong lenses near the source, in glass that hardly bends light.  The part of the map that no
    surface can follow is lost.
    """
    knobs, goal, z = task.knobs, task.goals[0], lens.back.z
    for turn in range(AIMS):
        n, m = (COARSEST_GRID, knobs.levels[0]) if turn < AIMS - 1 else (knobs.transport_grid, knobs.levels[-1])
        lens = task.refined(lens, m)
        rays, wanted, mapping = aimed_rays(
            task.heaviest.source,
            lens,
            goal.picture,
            screen=goal.receiver,
            n=n,
            side=min(3 * max(both(m)), max(2 * max(both(m)), knobs.rays)),  # many may leave through the sides
            iterations=knobs.transport_iterations,
        )
        lens = moved_clear(tailor_to_aim(lens, rays, wanted, goal.receiver.plane), z, task.least, task.bounds)
    return lens, mapping


def aimed_rays(
    source: Emitter, lens: Lens, target: np.ndarray, screen: Screen, n: int, side: int, iterations: int
) -> tuple[Rays, Tensor, Mapping]:
    """Rays that cover the front, `side` each way, and the aim of each (mm) by a map on n x n cells."""
    mapping = map_to_target(source, lens, target, screen=screen, n=n, iterations=iterations, progress=lambda _: None)
    area = clear_window(source, lens)
    x, y = (t.to(lens.like) for t in sampling.grid(area, side))
    rays = source.rays(x, y, lens.entrance.z, area.area / side**2)
    return rays, aim_points(mapping, lens, screen, x=x, y=y), mapping


def shaped_front(
    source: Emitter, lens: Lens, target: np.ndarray, screen: Screen, free: tuple[str, ...],
    rim_sags: tuple[float, float], n: int = COARSEST_GRID, iterations: int = 100, repeats: int = 3,
) -> Lens:  # fmt: skip
    """The lens with the front for which a surface follows Wang et al.'s own map most closely.

    Its merit is theirs for stage 1, the mean squared miss of the aim points, with the best back for each front, on the
    net that the lens has; n, iterations: cells a side and steps of the map, repeats: fits of the slopes for each front.
    """
    side, plane = 2 * max(lens.back.shape), screen.plane
    rays, wanted, _ = aimed_rays(source, lens, target, screen=screen, n=n, side=side, iterations=iterations)

    def miss(tried: Lens) -> float:
        return float(
            landing(trace(rays, tailor_to_aim(tried, rays, wanted, plane=plane, repeats=repeats), plane), wanted)
        )

    return lens.with_front(best_front(miss, lens, free, rim_sags).front)


def best_front(merit: Merit, lens: Lens, free: tuple[str, ...], rim_sags: Range = UNBOUNDED) -> Lens:
    """The lens whose front makes `merit` smallest by the parameters that are free; the merit tailors the back anew.

    Within what the blank allows: the front reaches the rim with a slope of at most 30°, it keeps half the blank's
    thickness there, and its sag there (mm) stays in `rim_sags`.
    """
    if "curvature" in free:
        own = float(lens.front.curvature)
        lens = _along("curvature", merit, lens, bounds=_curvatures(lens, rim_sags, own), tolerance=1e-4)
    if "conic_constant" in free and lens.front.curvature:
        if "curvature" in free:
            return _together(merit, lens, rim_sags)
        own = float(lens.front.conic_constant)
        low, high = _conic_constants(lens, rim_sags)
        low, high = min(low, own), max(high, own)
        lens = _along("conic_constant", merit, lens, bounds=(low, high), tolerance=1e-3 * (high - low))
    return lens


def _with(lens: Lens, **values: float) -> Lens:
    return lens.with_front(lens.front.with_parameters(**values))


def _along(name: str, merit: Merit, lens: Lens, bounds: Range, tolerance: float) -> Lens:
    """The lens with the best value of one parameter by a bounded scalar search (Brent), its own value included."""
    search = scipy.optimize.minimize_scalar(
        lambda value: merit(_with(lens, **{name: float(value)})), bounds=bounds, method="bounded",
        options={"maxiter": EVALUATIONS, "xatol": tolerance},
    )  # fmt: skip
    start = float(lens.front.parameters()[name])
    best = float(search.x) if search.fun < merit(_with(lens, **{name: start})) else start
    return _with(lens, **{name: best})


def _together(merit: Merit, lens: Lens, rim_sags: Range) -> Lens:
    """Curvature and conic constant by a simplex (Nelder and Mead) from those that there are."""
    c, k = (float(value) for value in (lens.front.curvature, lens.front.conic_constant))

    def at(tried: np.ndarray) -> float:
        there = _with(lens, curvature=float(tried[0]), conic_constant=float(tried[1]))
        if not tried[0]:
            return math.inf
        (low, high), (least, most) = _curvatures(there, rim_sags), _conic_constants(there, rim_sags)
        possible = low <= tried[0] <= high and least <= tried[1] <= most
        return merit(there) if possible or tuple(tried) == (c, k) else math.inf

    low, high = _curvatures(lens, rim_sags)
    step = (high - low) / 16 * (1 if c + (high - low) / 16 <= high else -1)
    simplex = np.array([[c, k], [c + step, k], [c, k - 1.0]])
    search = scipy.optimize.minimize(
        at, simplex[0], method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": BOTH, "xatol": 1e-5}
    )
    best = search.x if search.fun < math.inf else simplex[0]
    return _with(lens, curvature=float(best[0]), conic_constant=float(best[1]))


def _rim(lens: Lens) -> float:
    """Distance of the bounding box's corners from the axis (mm)."""
    return sum(half**2 for half in lens.outline.half_extent) ** 0.5


def _curvatures(lens: Lens, rim_sags: Range, *own: float) -> Range:
    """The range of curvatures (1/mm) at which the front is possible with its own conic constant k, `own` among
    them where they are possible.

    Its slope at r has the sine S where c = S / (r sqrt(1 + k S²)).
    """
    rim, k = _rim(lens), float(lens.front.conic_constant)
    room = (lens.back.z - lens.front.z) / 2
    bent = 1 + k * STEEPEST**2
    limit = STEEPEST / rim / math.sqrt(bent) if bent > 0 else math.inf
    if k != -1:
        limit = min(limit, math.sqrt((UPRIGHT if k > -1 else CONE) / abs(1 + k)) / rim)
    low, high = (_of_sag(sag, math.hypot(*lens.outline.farthest), k) for sag in rim_sags)
    return max(-limit, min((low, *own))), min(limit, _of_sag(room, rim, k), max((high, *own)))


def _of_sag(h: float, r: float, k: float) -> float:
    """The curvature of a conic with this sag at r: c = 2 h / (r² + (1 + k) h²), up to where it stands upright."""
    p = 1 + k
    if p == 0:
        return 2 * h / (r * r)
    most = INSIDE * r / math.sqrt(abs(p))
    h = max(-most, min(h, most))
    return 2 * h / (r * r + p * h * h)


def _conic_constants(lens: Lens, rim_sags: Range) -> Range:
    """The range of conic constants at which the front is possible with its own curvature c.

    tan² of the slope at r is c² r² / (1 - (1 + k) c² r²), and 1 + k = (2 h - c r²) / (c h²) where the sag is h.
    """
    least, most = CONIC_CONSTANTS
    c, rim = float(lens.front.curvature), _rim(lens)
    room = (lens.back.z - lens.front.z) / 2
    bent = (c * rim) ** 2
    sag = abs(rim_sags[0]) if c < 0 else min(rim_sags[1], room)
    steep = 1 / bent - (1 - STEEPEST**2) / STEEPEST**2
    deep = (2 * sag - abs(c) * rim**2) / (abs(c) * sag**2) if sag < math.inf else steep
    return max(-CONE / bent - 1, least), min(steep, deep, UPRIGHT / bent, 1 + most) - 1
