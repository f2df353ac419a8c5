"""The procedure of the paper: stages 1 and 2 by Adam on raw control points (Wang et al. 2023, sections 2.3 and 3).

Other lenses are compared with its lenses (`tailoring.quality` = "paper").  Choices for which the paper gives no number
are stated here or in quality.py: steps per level, learning rates that fall to zero in each level, the rate of stage 2.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel, weighted_sum
from bstcad.optics.numerics.reductions import total
from bstcad.optics.receivers.irradiance import Screen, collect, landed_flux
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.rays import Landed, Rays
from bstcad.optics.surfaces.sides import Sides
from bstcad.optics.trace.trace import clear_window, trace
from bstcad.tailoring import slope_map
from bstcad.tailoring.driver import Parameters, StageStep, Task, maker
from bstcad.tailoring.merit import mean_square_miss
from bstcad.tailoring.minimise import AdamState, Best, Iterate, adam, minimise
from bstcad.transport.bfm import TransportStep
from bstcad.transport.mapping import Mapping, Solver

STAGE1_RATES = {33: 0.02, 129: 0.004, 513: 0.008}  # learning rates (mm per step) by control points per side
FRONT_RATES = {  # learning rates of the front's parameters, per step
    "curvature": 0.001,  # 1/mm (section 3.2)
    "conic_constant": 0.02,  # chosen here, since the fronts of the paper are spheres
}
STAGE2_RATE = 2e-4  # learning rate (mm per step); chosen here, since the paper does not state it
MAX_RAYS_PER_CONTROL_POINT = 8  # largest number of rays per control point along an axis; saves rays on the coarsest net


@dataclass(frozen=True)
class Level:
    """State of stage 1 between two steps on one of its nets."""

    level: int  # number of the net, from 0
    mapping: Mapping  # map from the vertex plane of the first surface to the target
    lens: Parameters  # parameters at the start of this level
    best: Best  # best parameters so far
    search: AdamState  # state of Adam after the last step


def stage1(task: Task, lens: Lens, state: Level | None = None) -> Iterator[StageStep]:
    """Run stage 1, or resume it, on one net after another, with the same map (`transport`) for all nets."""
    settings, lens, each = task.settings, task.heaviest.through(lens), task.settings.stage1_iterations
    area = clear_window(task.heaviest.source, lens)  # window of the light that passes the blank
    if state is None:
        mapping = transport(task, lens)
        yield StageStep(None, part="transport", ends=True)
    else:
        lens, mapping = state.lens.apply_to(lens), state.mapping
    for level in range(state.level if state else 0, len(settings.levels)):
        lens = lens.refined(settings.levels[level])
        begun, best = Parameters.of(lens), Best()
        for reached in _on_level(task, lens, mapping, area=area, state=state):
            best, search = reached.best, reached.state
            resumable = None if search is None else Level(level, mapping, begun, best=best, search=search)
            finish = partial(_improved, lens, best, task.free, settings.levels[-1])
            text, count = f"landing error {best.merit**0.5:.3f} mm RMS", level * each + best.evaluations
            progress = None if reached.skipped else ("stage 1", count, each * len(settings.levels), text)
            yield StageStep(finish, resumable, mapping, progress=progress, skipped=reached.skipped)
        lens, state = _improved(lens, best, task.free, settings.levels[level]), None
    yield StageStep(partial(lens.refined, settings.levels[-1]), mapping=mapping)


def _on_level(task: Task, lens: Lens, mapping: Mapping, area: Rectangle, state: Level | None) -> Iterator[Iterate]:
    """Run or resume stage 1 on the net of `lens`: minimise the miss of rays through `area` by heights and front."""
    n = min(task.settings.rays, MAX_RAYS_PER_CONTROL_POINT * max(lens.back_net.shape))
    x, y = (t.to(lens.like) for t in sampling.grid(area, n))
    rays = task.heaviest.source.rays_through(x, y, lens.entrance.z, area.area / n**2)
    screen, shape = task.goals[0].screen, lens.front.parameters()
    aim = slope_map.aim_points(mapping, lens, screen, x=x, y=y)
    start = [lens.back_net.heights, *(torch.as_tensor(shape[name]).to(lens.like) for name in task.free)]
    nearest = min(STAGE1_RATES, key=lambda m: abs(m - max(lens.back_net.shape)))

    def problem(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        leaves = [p.detach().clone().requires_grad_() for p in parameters]
        merit = mean_square_miss(trace(rays, with_parameters(lens, leaves, task.free), screen.receiver), aim)
        return float(merit.detach()), list(torch.autograd.grad(merit, leaves)), float("nan")

    steps, rates = task.settings.stage1_iterations, [STAGE1_RATES[nearest], *(FRONT_RATES[name] for name in task.free)]
    method = adam(start, rates, steps, state.search if state else None)
    return minimise(problem, method, steps, state.best if state else Best())


def _improved(lens: Lens, best: Best, free: tuple[str, ...], net: Sides) -> Lens:
    """Return the best lens of a level that starts from `lens`, refined to `net` control points per side."""
    if best.parameters:  # empty if no value was finite
        heights, *shape = best.parameters
        lens = with_parameters(lens, [heights, *map(float, shape)], free)
    return lens.refined(net)


def transport(task: Task, lens: Lens) -> Mapping:
    """Return the map from the vertex plane of the first surface to the target, for a blank lens."""
    source, goal = task.heaviest.source, task.goals[0]
    n, count = task.settings.transport_grid, task.settings.transport_iterations

    def progress(s: TransportStep) -> None:
        task.progress("transport", s.iteration, count, f"mass error {s.mass_error:.4f}")

    return slope_map.map_to_target(source, lens, goal, n, solver=Solver(count, progress=progress))


def tent_average(target: Tensor) -> Tensor:
    """Return what tent binning makes of a picture that is constant in each pixel: filter [1, 6, 1] / 8 along each axis.

    Compared with this result, not with the sharp picture, the picture of a perfect lens has merit zero.
    """
    for _ in range(2):  # each pass filters one axis and transposes
        target = torch.nn.functional.pad(target, (1, 1))
        target = ((target[:, :-2] + 6 * target[:, 1:-1] + target[:, 2:]) / 8).T
    return target.contiguous()


@dataclass(frozen=True)
class TentMerit:
    """RRMSD² (Wang et al. 2023, Eq. 15) of all channels by tent binning, plus the overshoot term of merit.py."""

    channels: tuple[Channel, ...]  # channels of the light
    screen: Screen  # screen of the target
    target: Tensor  # (rows, columns) picture of flux 1 after tent binning
    overshoot: float  # weight of light outside the target (1 / pixel²)

    @classmethod
    def of(cls, channels: tuple[Channel, ...], screen: Screen, target: Tensor, overshoot: float) -> TentMerit:
        """Return the merit function for a sharp target picture."""
        return cls(channels, screen, tent_average(target / total(target)), overshoot)

    def __call__(self, landed: tuple[Landed, ...]) -> tuple[Tensor, Tensor]:
        """Return (merit, RRMSD against the tent-binned target); landed: rays on the target, by channel."""
        flux = weighted_sum(self.channels, (total(landed_flux(rays).double()) for rays in landed))
        images, outside_parts = zip(*(collect(rays, self.screen) for rays in landed), strict=True)
        image, outside = weighted_sum(self.channels, images), weighted_sum(self.channels, outside_parts)
        rrmsd2 = total((image / flux - self.target) ** 2) / total(self.target**2)
        return rrmsd2 + self.overshoot * outside / flux, rrmsd2.detach().sqrt()


@dataclass(frozen=True)
class RaySearch:
    """State of stage 2 between two steps."""

    lens: Parameters  # parameters at the start of stage 2
    best: Best  # best parameters so far
    search: AdamState  # state of Adam after the last step


def stage2(task: Task, lens: Lens, state: RaySearch | None = None) -> Iterator[StageStep]:
    """Run stage 2, or resume it from `state`, with new random rays in each step."""
    settings, goal, start = task.settings, task.goals[0], lens if state is None else state.lens.apply_to(lens)
    target = torch.from_numpy(goal.picture).to(lens.like.device)
    merit = TentMerit.of(task.channels, goal.screen, target, settings.overshoot)
    seeds = itertools.count(settings.seed + 2 + (state.best.evaluations if state else 0))
    bundles = (random_bundles(task.channels, start, settings.rays**2, seed) for seed in seeds)
    if state is None:
        yield StageStep(lambda: lens)
    for reached in tailor_to_irradiance(start, bundles, merit, steps=settings.stage2_iterations, state=state):
        assert reached.parameters is not None  # Adam never ends
        best, lens = reached.best, with_parameters(start, [reached.parameters[0]])
        resumable = None if reached.state is None else RaySearch(Parameters.of(start), best, reached.state)
        step = StageStep(maker(lens), resumable, skipped=reached.skipped, part="stage 2")
        if not reached.skipped:
            progress = "stage 2", best.evaluations, settings.stage2_iterations, f"RRMSD {best.latest:.4f}"
            step = replace(step, progress=progress, rrmsd=best.latest)
        yield step
    judged = task.rrmsd(lens)
    yield StageStep(lambda: lens, rays_rrmsd=judged, part="stage 2", ends=True, reason="evaluations")


def random_bundles(channels: tuple[Channel, ...], lens: Lens, count: int, seed: int) -> tuple[Rays, ...]:
    """Return `count` random rays of each channel through its `clear_window`; all channels use one seed."""

    def bundle(channel: Channel) -> Rays:
        area = clear_window(channel.source, channel.through(lens))
        x, y = (t.to(lens.like) for t in sampling.random(area, count, seed))
        return channel.source.rays_through(x, y, lens.entrance.z, area.area / count)

    return tuple(map(bundle, channels))


def with_parameters(lens: Lens, parameters: list[Any], free: tuple[str, ...] = ()) -> Lens:
    """Return the lens with new parameters: heights of the back, then parameters of the front in the order of `free`."""
    heights, *shape = parameters
    front = lens.front.with_parameters(**dict(zip(free, shape, strict=True)))
    return lens.with_front(front).with_back(lens.back.with_parameters(heights=heights))


def tailor_to_irradiance(
    lens: Lens, bundles: Iterator[tuple[Rays, ...]], merit: TentMerit, steps: int, state: RaySearch | None = None
) -> Iterator[Iterate]:
    """Minimise sqrt(`merit`), the RRMSD (Eq. 15) if overshoot is 0, with new rays of `bundles` in each step."""

    def problem(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        leaf = parameters[0].detach().clone().requires_grad_()
        trial, pairs = with_parameters(lens, [leaf]), zip(merit.channels, next(bundles), strict=True)
        square, rrmsd = merit(
            tuple(trace(rays, channel.through(trial), merit.screen.receiver) for channel, rays in pairs)
        )
        (gradient,) = torch.autograd.grad(square.sqrt(), leaf)
        return float(square.detach().sqrt()), [gradient], float(rrmsd)

    method = adam([lens.back_net.heights], [STAGE2_RATE], steps, state.search if state else None)
    return minimise(problem, method, steps, state.best if state else Best())
