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
from bstcad.optics.outlines import Rectangle
from bstcad.optics.rays import Rays
from bstcad.optics.simulation import clear_window, launch, window
from bstcad.optics.trace import into_glass, through_back
from bstcad.tailoring.merit import IrradianceMerit
from bstcad.tailoring.minimise import BestSoFar, lbfgs
from bstcad.tailoring.spectrum import Spectrum
from bstcad.tailoring.task import Task

NARROW = 4  # tents a pixel each way in the last round
FEW = 0.4  # share of the evaluations done with a quarter of the rays
SPARE = 1.02  # tailoring traces this much more than what gets through now, each way

Report = Callable[[BestSoFar], None]


def tailor(task: Task, lens: Lens) -> Lens:
    """The lens after stage 2.

    A first round with few rays and wide tents, then all rays and tents so narrow that they are nearly boxes.
    """
    knobs, log = task.knobs, task.log
    target = torch.from_numpy(task.target).to(lens.back.heights.device)
    done = 0
    for turn, (n, share, subdivision) in enumerate(((knobs.rays // 2, FEW, 1), (knobs.rays, 1 - FEW, NARROW))):
        evaluations = round(share * knobs.stage2_iterations)
        if evaluations == 0:
            continue

        def report(state: BestSoFar, before: int = done) -> None:
            now = min(before + state.evaluations, knobs.stage2_iterations)
            log.progress("stage 2", now, knobs.stage2_iterations, f"RRMSD {state.rrmsd:.4f}")
            log.note(state.rrmsd)

        merit = IrradianceMerit.of(task.screen, target, knobs.overshoot, subdivision)
        problem = Problem(lens, bundle(task, lens, n, knobs.seed + turn), merit)
        lens, best = tailor_to_irradiance(lens, problem, evaluations, report)
        log.skipped += best.skipped
        done += evaluations
        log.end(f"stage 2, {subdivision}² tents a pixel", task.rrmsd(lens))
    return lens


def bundle(task: Task, lens: Lens, n: int, seed: int) -> Rays:
    """n x n stratified rays that get (nearly) through, just behind the front face."""
    whole, clear = window(task.source, lens), clear_window(task.source, lens)
    area = Rectangle(min(SPARE * clear.width, whole.width), min(SPARE * clear.height, whole.height))
    return into_glass(launch(task.source, lens, n, seed, area), lens)


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
