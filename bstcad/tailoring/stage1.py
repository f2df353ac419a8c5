"""Stage 1: a surface that follows the transport map, by rounds of transport in slope coordinates and least squares."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from torch import Tensor

from bstcad.optics import sampling
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.rays import Rays
from bstcad.optics.simulation import clear_window
from bstcad.optics.sources import Source
from bstcad.optics.trace import trace
from bstcad.scene.quality import COARSEST_GRID
from bstcad.tailoring import ray_mapping
from bstcad.tailoring.clearance import moved_clear
from bstcad.tailoring.front_shape import best_front
from bstcad.tailoring.merit import landing
from bstcad.tailoring.parameters import Parameters
from bstcad.tailoring.run import Step, Task
from bstcad.tailoring.slope_fit import Fit, refine, tailor_to_aim
from bstcad.tailoring.slope_map import SlopeMap, back_grid, follow, lit_window, slope_map
from bstcad.transport.bfm import Step as TransportStep
from bstcad.transport.mapping import Mapping

COARSE = (Fit(bending=1e-2, steps=40, degree=3), 0.0)  # stiff: it also extrapolates into unlit areas
FINE = (Fit(), 1e-2)  # there it holds on to the coarse face
# The other way is tried from this RRMSD on, and where the map has not settled: where in the last round the places of
# the target moved by more than this share of the back face.  (Found: at most 0.016 where more rounds gain nothing.)
POOR, UNSETTLED = 0.25, 0.025
LIT = 1026  # cells a side, at most, each of which is asked whether light meets it: each costs the search for a ray
KEPT = 0.9  # of the light on the target: so much of it the other way must leave there to be taken
AIMS = 5  # rounds of it


@dataclass(frozen=True)
class SlopeRound:
    """Where stage 1 stands between two rounds."""

    round: int  # of those that are done
    lens: Parameters
    wanted: SlopeMap


def steps(task: Task, lens: Lens, state: SlopeRound | None = None) -> Iterator[Step]:
    """Stage 1 from a blank lens, or further from a state: its rounds, and the other way where they come to little."""
    lens = task.heaviest.through(lens)
    if state is None and task.free:
        coarse = _refined(lens, task.knobs.levels[0])
        found = shaped_front(
            task.heaviest.source, coarse, task.target, task.screen, task.free, task.rim_sags,
            iterations=task.knobs.transport_iterations,
        )  # fmt: skip
        lens = replace(lens, front=found.front)
    for last in follow_slopes(task, lens, state):
        yield last
    found, judged = last.lens, task.rrmsd(last.lens)
    yield replace(last, state=None, judged=judged)
    if not doubtful(judged, last.state):
        return
    other, mapping = follow_aims(task, replace(lens, front=found.front))
    value = task.rrmsd(other)
    better = value < np.nan_to_num(judged, nan=np.inf)  # NaN: no light on the target
    if better and task.used(other) >= KEPT * task.used(found):
        yield Step(lambda: other, mapping=mapping, judged=value)


def doubtful(judged: float, state: SlopeRound) -> bool:
    """Is what the rounds came to, by their RRMSD and their last state, a reason to try the other way?"""
    return not judged <= POOR or state.wanted.moved > UNSETTLED  # NaN: no light on the target


def follow_slopes(task: Task, lens: Lens, state: SlopeRound | None = None) -> Iterator[Step]:
    """Rounds of transport map (back face to slopes) and slope fit: each from the sag and the map of the one before.

    All but the last two work on coarse grids and nets, where they cost next to nothing.
    """
    knobs = task.knobs
    wanted, done, z = None, 0, lens.back.z
    if state is not None:
        lens, wanted, done = state.lens.applied(lens), state.wanted, state.round
    for turn in range(min(done, knobs.rounds - 1), knobs.rounds):
        if turn >= done:
            lens, wanted = _round(task, lens, wanted, z, turn)
        yield Step(
            partial(_refined, lens, knobs.levels[-1]),
            SlopeRound(turn + 1, Parameters.of(lens), wanted),
            wanted.mapping,
            wanted.places,
            ("stage 1", turn + 1, knobs.rounds, ""),
        )


def _round(task: Task, lens: Lens, wanted: SlopeMap | None, z: float, turn: int) -> tuple[Lens, SlopeMap]:
    """One round: the lens, and the map that it follows; z is where its back was to be (mm)."""
    knobs, source, left = task.knobs, task.heaviest.source, task.knobs.rounds - turn
    coarse = max(COARSEST_GRID, knobs.transport_grid // 2 ** min(left - 1, 2))
    m = knobs.levels[max(-left, -len(knobs.levels))] if left <= 2 else knobs.levels[0]

    def progress(s: TransportStep) -> None:
        task.progress("stage 1", turn, knobs.rounds, f"{s.grid}² cells, mass error {s.mass_error:.4f}")

    lens = _refined(lens, m)
    window = lit_window(source, lens)
    wanted = slope_map(
        source, lens, window, task.target, task.screen, coarse, wanted,
        iterations=knobs.transport_iterations, progress=progress,
    )  # fmt: skip
    side = min(2 * m, knobs.rays)
    parts = math.ceil(side / LIT)
    grid = back_grid(source, lens, window, math.ceil(side / parts))
    lens = follow(lens, wanted, grid, *(FINE if left <= 2 else COARSE), parts)
    return moved_clear(lens, z, task.least, task.bounds), wanted  # the next round reckons with where the back is now


def _refined(lens: Lens, m: int) -> Lens:
    return lens.with_nets(refine(net, m) for net in lens.nets)


def follow_aims(task: Task, lens: Lens) -> tuple[Lens, Mapping]:
    """Wang et al.'s map, from the front to places on the target, by fits of slopes to its aims.

    A ray keeps its aim while the sag moves, so that this settles where the slopes that points of the back need change
    much with the sag: at strong lenses near the source, in glass that hardly bends light.  What of the map no surface
    can follow is lost.
    """
    knobs, z = task.knobs, lens.back.z
    for turn in range(AIMS):
        n, m = (COARSEST_GRID, knobs.levels[0]) if turn < AIMS - 1 else (knobs.transport_grid, knobs.levels[-1])
        lens = _refined(lens, m)
        rays, wanted, mapping = aimed_rays(
            task.heaviest.source, lens, task.target, task.screen, n, aimed(m, knobs.rays), knobs.transport_iterations
        )
        lens = moved_clear(tailor_to_aim(lens, rays, wanted, task.screen.plane), z, task.least, task.bounds)
    return lens, mapping


def aimed(m: int, rays: int) -> int:
    """Rays a side for a net of m x m; more than two a control cell each way, since many may leave through the sides."""
    return min(3 * m, max(2 * m, rays))


def aimed_rays(
    source: Source, lens: Lens, target: np.ndarray, screen: Screen, n: int, side: int, iterations: int
) -> tuple[Rays, Tensor, Mapping]:
    """Rays that cover the front, `side` each way, and the aim of each (mm) by a map on n x n cells."""
    mapping = ray_mapping.map_to_target(source, lens, target, screen, n, iterations, lambda _: None)
    area = clear_window(source, lens)
    x, y = (t.to(lens.like) for t in sampling.grid(area, side))
    rays = source.rays(x, y, lens.entrance.z, area.area / side**2)
    return rays, ray_mapping.aim_points(mapping, lens, screen.plane, x, y), mapping


def shaped_front(
    source: Source, lens: Lens, target: np.ndarray, screen: Screen, free: tuple[str, ...],
    rim_sags: tuple[float, float], n: int = COARSEST_GRID, iterations: int = 100, repeats: int = 3,
) -> Lens:  # fmt: skip
    """The lens with the front with which Wang et al.'s own map comes nearest to what a surface can do.

    Its merit is theirs for stage 1, the mean squared miss of the aim points, with the best back for each front, on the
    net that the lens has; n, iterations: cells a side and steps of the map, repeats: fits of the slopes for each front.
    """
    rays, wanted, _ = aimed_rays(source, lens, target, screen, n, 2 * lens.back.m, iterations)
    plane = screen.plane

    def miss(tried: Lens) -> float:
        return float(landing(trace(rays, tailor_to_aim(tried, rays, wanted, plane, repeats), plane), wanted))

    return replace(lens, front=best_front(miss, lens, free, rim_sags).front)
