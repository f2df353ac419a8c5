"""Stage 2: the irradiance itself.

The heights are P = P0 + W (c · scale) W^T (see spectrum.py); in c the merit is well scaled and a quasi-Newton method
needs tens of evaluations where Adam on raw control points needs thousands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bstcad.optics.lens import Lens
from bstcad.optics.rays import Rays
from bstcad.optics.trace import through_back
from bstcad.tailoring.merit import IrradianceMerit
from bstcad.tailoring.minimise import BestSoFar, lbfgs
from bstcad.tailoring.spectrum import Spectrum

Report = Callable[[BestSoFar], None]


@dataclass(frozen=True)
class Problem:
    """Merit and gradient of the back face for a fixed bundle of rays.

    The fused kernels keep only where each ray lands, not what led there: memory is some 70 bytes a ray and does not
    grow with control points.
    """

    lens: Lens
    in_glass: Rays  # just behind the front face
    merit: IrradianceMerit

    def __call__(self, heights: Tensor) -> tuple[float, Tensor, float]:
        """(merit, ∂merit/∂heights, RRMSD by the tent)."""
        leaf = heights.detach().requires_grad_()
        lens = replace(self.lens, back=replace(self.lens.back, heights=leaf))
        merit, rrmsd = self.merit(through_back(self.in_glass, lens, self.merit.screen.z))
        (gradient,) = torch.autograd.grad(merit, leaf)
        return float(merit.detach()), gradient, float(rrmsd)


def tailor_to_irradiance(lens: Lens, problem: Problem, evaluations: int, report: Report) -> tuple[Lens, BestSoFar]:
    """The lens whose back face makes the merit smallest, by L-BFGS in the Sobolev variable; never worse than `lens`."""
    spectrum = Spectrum.of(lens.back)
    start = lens.back.heights

    def in_c(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        merit, gradient, rrmsd = problem(start + spectrum.heights(parameters[0]))
        return merit, [spectrum.adjoint(gradient)], rrmsd

    best = BestSoFar(in_c, report)
    lbfgs(best, [torch.zeros_like(start)], evaluations)
    heights = start + spectrum.heights(best.parameters[0])
    return replace(lens, back=replace(lens.back, heights=heights)), best
