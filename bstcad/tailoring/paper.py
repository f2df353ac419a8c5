"""The seed's own procedure: both stages by Adam on raw control points (Wang et al. 2023, sections 2.3 and 3).

It is the baseline that the other qualities are measured against.  Where the paper gives no number the choice is
stated here: steps a level, and the learning rates of stage 2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from bstcad.optics.lens import Lens
from bstcad.optics.rays import Rays
from bstcad.optics.surfaces import Sphere
from bstcad.optics.trace import into_glass, through_back, trace
from bstcad.tailoring.merit import IrradianceMerit, landing
from bstcad.tailoring.minimise import BestSoFar, adam
from bstcad.tailoring.stage1 import refine

RATES = {33: 0.02, 129: 0.004, 513: 0.008}  # mm a step, by control points a side (section 3.2); the nearest net's counts
CURVATURE_RATE = 0.001  # 1/mm a step (section 3.2)
STAGE2_RATE = 2e-5  # mm a step; not stated in the paper


def rate(m: int) -> float:
    """The paper's learning rate (mm a step) of the nearest of its three nets."""
    return RATES[min(RATES, key=lambda net: abs(net - m))]


def tailor_to_map(
    lens: Lens, rays: Rays, aim: Tensor, z: float, levels: tuple[int, ...], steps: int,
    report: Callable[[BestSoFar, int], None],
) -> Lens:  # fmt: skip
    """Stage 1: min Σ |P_t - P|² on ever finer nets, the front's curvature together with the heights if it is free."""
    free = isinstance(lens.front, Sphere) and lens.front.optimise
    for level, m in enumerate(levels):
        lens = replace(lens, back=refine(lens.back, m))
        start, rates = [lens.back.heights], [rate(m)]
        if free:
            start.append(torch.as_tensor(lens.front.curvature, dtype=lens.back.heights.dtype).clone())
            rates.append(CURVATURE_RATE)

        def problem(parameters: list[Tensor], lens: Lens = lens) -> tuple[float, list[Tensor], float]:
            leaves = [p.detach().clone().requires_grad_() for p in parameters]
            merit = landing(trace(rays, with_parameters(lens, leaves), z), aim)
            gradients = torch.autograd.grad(merit, leaves)
            return float(merit.detach()), list(gradients), float("nan")

        best = BestSoFar(problem, lambda state, level=level: report(state, level))
        adam(best, start, rates, steps)
        lens = with_parameters(lens, best.parameters)
    return lens


def with_parameters(lens: Lens, parameters: list[Tensor]) -> Lens:
    """The lens with these heights and, if there is a second parameter, this curvature of the front."""
    lens = replace(lens, back=replace(lens.back, heights=parameters[0]))
    return replace(lens, front=replace(lens.front, curvature=parameters[1])) if len(parameters) > 1 else lens


def tailor_to_irradiance(
    lens: Lens, bundles: Iterator[Rays], merit: IrradianceMerit, steps: int, report: Callable[[BestSoFar], None]
) -> tuple[Lens, BestSoFar]:
    """Stage 2: min RRMSD by the tent, with freshly sampled random rays in each step (Eq. 14)."""

    def problem(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        leaf = parameters[0].detach().clone().requires_grad_()
        now = replace(lens, back=replace(lens.back, heights=leaf))
        square, rrmsd = merit(through_back(into_glass(next(bundles), now), now, merit.screen.z))
        (gradient,) = torch.autograd.grad(square.sqrt(), leaf)
        return float(square.detach().sqrt()), [gradient], float(rrmsd)

    best = BestSoFar(problem, report)
    adam(best, [lens.back.heights], [STAGE2_RATE], steps)
    return replace(lens, back=replace(lens.back, heights=best.parameters[0])), best
