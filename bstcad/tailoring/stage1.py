"""Stage 1: a surface that follows the transport map, by rounds of transport in slope coordinates and least squares."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from torch import Tensor

from bstcad.optics import sampling
from bstcad.optics.lens import Lens
from bstcad.optics.rays import Rays
from bstcad.optics.simulation import clear_window
from bstcad.optics.trace import trace
from bstcad.runs.checkpoint import as_record, as_state
from bstcad.tailoring import ray_mapping
from bstcad.tailoring.clearance import moved_clear
from bstcad.tailoring.front_shape import best_front
from bstcad.tailoring.merit import landing
from bstcad.tailoring.parameters import Parameters
from bstcad.tailoring.run import Task
from bstcad.tailoring.slope_fit import Fit, refine, tailor_to_aim
from bstcad.tailoring.slope_map import SlopeMap, back_grid, follow, lit_window, slope_map
from bstcad.transport.mapping import Mapping

COARSE = (Fit(bending=1e-2, steps=40, degree=3), 0.0)  # stiff: it also says how the face goes on where no light falls
FINE = (Fit(), 1e-2)  # there it holds on to the coarse face
POOR = 0.5  # RRMSD from which on the other way is tried
AIMS = 5  # rounds of it
COARSEST = 64  # cells a side of the first round's transport


def tailor(task: Task, lens: Lens, found: dict[str, Any] | None = None) -> tuple[Lens, Mapping]:
    """The lens after stage 1, and the map (back face to slopes) that it follows; going on from a state if one is found.

    An interrupt ends it after a round; before the first there is nothing to keep.
    """
    lens = task.heaviest.through(lens)
    if found is None and task.free:
        lens = shaped_front(task, lens)
    ways = [follow_slopes(task, lens, found)]
    if task.log.interrupted() or task.rrmsd(ways[0][0]) <= POOR:
        return ways[0]
    ways.append(follow_aims(task, replace(lens, front=ways[0][0].front)))
    return min(ways, key=lambda way: np.nan_to_num(task.rrmsd(way[0]), nan=np.inf))  # NaN: no light on the target


def follow_slopes(task: Task, lens: Lens, found: dict[str, Any] | None = None) -> tuple[Lens, Mapping]:
    """Rounds of transport map and slope fit: each starts from the sag and the map of the one before.

    All but the last two work on coarse grids and nets, where they cost next to nothing.
    """
    knobs, log = task.knobs, task.log
    wanted, begin, z = None, 0, lens.back.z
    if found is not None:
        lens, begin = as_record(Parameters, found["lens"]).applied(lens), found["round"]
        wanted = as_record(SlopeMap, found["wanted"])
    for turn in range(begin, knobs.rounds):
        if log.interrupted():
            if wanted is None:
                raise KeyboardInterrupt
            break
        left = knobs.rounds - turn
        coarse = max(COARSEST, knobs.transport_grid // 2 ** min(left - 1, 2))
        m = knobs.levels[max(-left, -len(knobs.levels))] if left <= 2 else knobs.levels[0]

        def step(s, turn: int = turn) -> None:
            log.progress("stage 1", turn, knobs.rounds, f"{s.grid}² cells, mass error {s.mass_error:.4f}")

        lens = replace(lens, back=refine(lens.back, m))
        wanted = slope_map(
            task.heaviest.source, lens, task.target, task.screen, coarse, wanted,
            iterations=knobs.transport_iterations, progress=step,
        )  # fmt: skip
        grid = back_grid(task.heaviest.source, lens, lit_window(task.heaviest.source, lens), min(2 * m, knobs.rays))
        lens = follow(lens, wanted, grid, *(FINE if left <= 2 else COARSE))
        lens = moved_clear(lens, z, task.least)  # the next round reckons with where the back is now
        task.keep({"round": turn + 1, "lens": as_state(Parameters.of(lens)), "wanted": as_state(wanted)})
    log.progress("stage 1", knobs.rounds, knobs.rounds, "")
    return replace(lens, back=refine(lens.back, knobs.levels[-1])), wanted.mapping


def follow_aims(task: Task, lens: Lens) -> tuple[Lens, Mapping]:
    """Wang et al.'s map, from the front to places on the target, by fits of slopes to its aims.

    A ray keeps its aim while the sag moves, so that this settles where the slopes that points of the back need change
    much with the sag: at strong lenses near the source, in glass that hardly bends light.  What of the map no surface
    can follow is lost.
    """
    knobs, z = task.knobs, lens.back.z
    for turn in range(AIMS):
        n, m = (COARSEST, knobs.levels[0]) if turn < AIMS - 1 else (knobs.transport_grid, knobs.levels[-1])
        lens = replace(lens, back=refine(lens.back, m))
        rays, wanted, mapping = aimed_rays(task, lens, n, 3 * m)  # of which many may leave through the sides
        lens = moved_clear(tailor_to_aim(lens, rays, wanted, task.screen.z), z, task.least)
    return lens, mapping


def aimed_rays(task: Task, lens: Lens, n: int, side: int) -> tuple[Rays, Tensor, Mapping]:
    """Rays that cover the front, `side` each way, and the aim of each (mm) by a map on n x n cells."""
    mapping = ray_mapping.map_to_target(
        task.heaviest.source, lens, task.target, task.screen, n, task.knobs.transport_iterations, lambda _: None
    )
    area = clear_window(task.heaviest.source, lens)
    x, y = (t.to(lens.back.heights) for t in sampling.grid(area, side))
    rays = task.heaviest.source.rays(x, y, lens.entrance.z, area.area / side**2)
    return rays, ray_mapping.aim_points(mapping, x, y), mapping


def shaped_front(task: Task, lens: Lens) -> Lens:
    """The front with which Wang et al.'s own map comes nearest to what a surface can do, on the coarsest net.

    Its merit is theirs for stage 1, the mean squared miss of the aim points, with the best back for each front.
    """
    coarse = replace(lens, back=refine(lens.back, task.knobs.levels[0]))
    rays, wanted, _ = aimed_rays(task, coarse, COARSEST, 2 * coarse.back.m)

    def miss(tried: Lens) -> float:
        return float(landing(trace(rays, tailor_to_aim(tried, rays, wanted, task.screen.z), task.screen.z), wanted))

    return replace(lens, front=best_front(miss, coarse, task.free, task.rim_sags).front)
