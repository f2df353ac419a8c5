"""The procedure of the paper: both stages by Adam on raw control points (Wang et al. 2023, sections 2.3 and 3).

It is the baseline that the other qualities are measured against.  Where the paper gives no number the choice is
stated here or in quality.py: steps a level, a rate that falls to zero in each, and the learning rate of stage 2.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from bstcad.optics import sampling
from bstcad.optics.channels import Channel
from bstcad.optics.lens import Lens
from bstcad.optics.rays import Landed, Rays
from bstcad.optics.simulation import clear_window
from bstcad.optics.trace import through_back, towards_back, trace
from bstcad.runs.checkpoint import as_record, as_state
from bstcad.tailoring import ray_mapping
from bstcad.tailoring.merit import TentMerit, landing
from bstcad.tailoring.minimise import BestSoFar, Enough, Keep, adam, forget
from bstcad.tailoring.parameters import Parameters
from bstcad.tailoring.run import Task
from bstcad.tailoring.slope_fit import refine
from bstcad.transport.mapping import Mapping

RATES = {33: 0.02, 129: 0.004, 513: 0.008}  # mm a step, by control points a side (section 3.2)
FRONT_RATES = {  # a step, of what may be free of the front
    "curvature": 0.001,  # 1/mm (section 3.2)
    "conic_constant": 0.02,  # not in the paper, whose fronts are spheres
}
STAGE2_RATE = 2e-4  # mm a step; not stated in the paper
RAYS_PER_CONTROL_POINT = 8  # each way, at most: the coarsest net needs no million rays


def stage1(task: Task, lens: Lens, found: dict[str, Any] | None = None) -> tuple[Lens, Mapping]:
    """The lens after stage 1 and the map (front's vertex plane to target) that it follows.

    Goes on from a state of `task.keep` if one is found.  An interrupt ends it with what it has.
    """
    knobs, log, lens = task.knobs, task.log, task.heaviest.through(lens)
    mapping, begin = (as_record(Mapping, found["mapping"]), found["level"]) if found else (_transport(task, lens), 0)
    total = knobs.stage1_iterations * len(knobs.levels)
    area, search = clear_window(task.heaviest.source, lens), None  # of the blank
    if found:
        lens, search = as_record(Parameters, found["lens"]).applied(lens), found["search"]
    for level in range(begin, len(knobs.levels)):

        def report(state: BestSoFar, before: int = level * knobs.stage1_iterations) -> None:
            error = f"landing error {state.merit**0.5:.3f} mm RMS"
            log.progress("stage 1", before + state.evaluations, total, error)
            if log.interrupted():
                raise Enough("interrupt")

        lens = replace(lens, back=refine(lens.back, knobs.levels[level]))
        begun = {"mapping": as_state(mapping), "level": level, "lens": as_state(Parameters.of(lens))}

        def keep(state: dict[str, Any], begun: dict[str, Any] = begun) -> None:
            task.keep(begun | {"search": state})

        n = min(knobs.rays, RAYS_PER_CONTROL_POINT * lens.back.m)
        x, y = (t.to(lens.back.heights) for t in sampling.grid(area, n))
        rays = task.heaviest.source.rays(x, y, lens.entrance.z, area.area / n**2)
        wanted = ray_mapping.aim_points(mapping, x, y)
        lens = tailor_to_map(
            lens, rays, wanted, task.screen.z, knobs.stage1_iterations, report, keep, search, task.free
        )
        search = None
        if log.interrupted():
            break
    return replace(lens, back=refine(lens.back, knobs.levels[-1])), mapping


def _transport(task: Task, lens: Lens) -> Mapping:
    knobs, log = task.knobs, task.log

    def step(s) -> None:
        log.progress("transport", s.iteration, knobs.transport_iterations, f"mass error {s.mass_error:.4f}")

    mapping = ray_mapping.map_to_target(
        task.heaviest.source, lens, task.target, task.screen, knobs.transport_grid, knobs.transport_iterations, step
    )
    log.end("transport")
    return mapping


def stage2(task: Task, lens: Lens, found: dict[str, Any] | None = None) -> Lens:
    """The lens after stage 2: freshly sampled random rays in each step; further from a state if one is found."""
    knobs, log = task.knobs, task.log
    start, search = (as_record(Parameters, found["lens"]).applied(lens), found["search"]) if found else (lens, None)
    target = torch.from_numpy(task.target).to(lens.back.heights.device)
    merit = TentMerit.of(task.channels, task.screen, target, knobs.overshoot)

    def stage2_report(state: BestSoFar) -> None:
        log.progress("stage 2", state.evaluations, knobs.stage2_iterations, f"RRMSD {state.latest:.4f}")
        log.note(state.latest)
        if log.interrupted():
            raise Enough("interrupt")

    def keep(state: dict[str, Any]) -> None:
        task.keep({"lens": as_state(Parameters.of(start)), "search": state})

    seeds = itertools.count(knobs.seed + 2 + (search["step"] if search else 0))
    bundles = (random_bundles(task.channels, start, knobs.rays**2, seed) for seed in seeds)
    lens, best = tailor_to_irradiance(start, bundles, merit, knobs.stage2_iterations, stage2_report, keep, search)
    log.skipped += best.skipped
    log.stopped = "interrupt" if log.interrupted() else "evaluations"
    log.end("stage 2", task.rrmsd(lens))
    return lens


def random_bundles(channels: tuple[Channel, ...], lens: Lens, count: int, seed: int) -> tuple[Rays, ...]:
    """`count` independent random rays of each channel through the clear part of the vertex plane."""
    like = {"dtype": lens.back.heights.dtype, "device": lens.back.heights.device}

    def bundle(channel: Channel) -> Rays:
        area = clear_window(channel.source, channel.through(lens))
        x, y = (t.to(**like) for t in sampling.random(area, count, seed))
        return channel.source.rays(x, y, lens.entrance.z, area.area / count)

    return tuple(map(bundle, channels))


def landing_of(merit: TentMerit, bundles: tuple[Rays, ...], lens: Lens) -> tuple[Landed, ...]:
    """Where the rays of each channel meet the screen."""
    lenses = (channel.through(lens) for channel in merit.channels)
    return tuple(
        through_back(towards_back(rays, seen), seen, merit.screen.z) for rays, seen in zip(bundles, lenses, strict=True)
    )


def rate(m: int) -> float:
    """The paper's learning rate (mm a step) of the nearest of its three nets."""
    return RATES[min(RATES, key=lambda net: abs(net - m))]


def tailor_to_map(
    lens: Lens,
    rays: Rays,
    aim: Tensor,
    z: float,
    steps: int,
    report: Callable[[BestSoFar], None],
    keep: Keep = forget,
    found: dict[str, Any] | None = None,
    free: tuple[str, ...] = (),
) -> Lens:
    """Stage 1 on one net: min Σ |P_t - P|² by the heights, together with what is free of the front."""
    shape = lens.front.parameters()
    start = [lens.back.heights, *(torch.as_tensor(shape[name]).to(lens.back.heights) for name in free)]
    rates = [rate(lens.back.m), *(FRONT_RATES[name] for name in free)]

    def problem(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        leaves = [p.detach().clone().requires_grad_() for p in parameters]
        merit = landing(trace(rays, with_parameters(lens, leaves, free), z), aim)
        gradients = torch.autograd.grad(merit, leaves)
        return float(merit.detach()), list(gradients), float("nan")

    best = BestSoFar(problem, report)
    adam(best, start, rates, steps, keep, found)
    heights, *shape = best.parameters or start  # or: not one value was finite
    return with_parameters(lens, [heights, *map(float, shape)], free)


def with_parameters(lens: Lens, parameters: list[Any], free: tuple[str, ...] = ()) -> Lens:
    """The lens with these heights and behind them what is free of the front, in this order."""
    heights, *shape = parameters
    front = lens.front.with_parameters(**dict(zip(free, shape, strict=True)))
    return replace(lens, front=front, back=replace(lens.back, heights=heights))


def tailor_to_irradiance(
    lens: Lens,
    bundles: Iterator[tuple[Rays, ...]],
    merit: TentMerit,
    steps: int,
    report: Callable[[BestSoFar], None],
    keep: Keep = forget,
    found: dict[str, Any] | None = None,
) -> tuple[Lens, BestSoFar]:
    """Stage 2: min RRMSD by the tent, with freshly sampled random rays in each step (Eq. 15)."""

    def problem(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        leaf = parameters[0].detach().clone().requires_grad_()
        now = replace(lens, back=replace(lens.back, heights=leaf))
        square, rrmsd = merit(landing_of(merit, next(bundles), now))
        (gradient,) = torch.autograd.grad(square.sqrt(), leaf)
        return float(square.detach().sqrt()), [gradient], float(rrmsd)

    best = BestSoFar(problem, report)
    [heights] = adam(best, [lens.back.heights], [STAGE2_RATE], steps, keep, found)
    return replace(lens, back=replace(lens.back, heights=heights)), best
