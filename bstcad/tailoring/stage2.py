"""Stage 2: the irradiance itself, by ray tubes.

Each evaluation traces the same corners of a sheet of tubes, so that the merit is smooth and without noise, and what is
gained on it is gained for the lens.  In the Sobolev variable (sobolev.py) L-BFGS needs some hundred evaluations where
Adam on raw control points needs thousands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bstcad.optics.lens import Lens
from bstcad.optics.tubes import launch_tubes
from bstcad.tailoring.merit import TubeMerit
from bstcad.tailoring.minimise import BestSoFar, Enough, lbfgs
from bstcad.tailoring.sobolev import SobolevVariable, local_weight
from bstcad.tailoring.task import Task

ROUNDS = ((2 / 3, 0.75), (1.0, 0.25))  # (tubes a side, evaluations), as shares of what the knobs say
FEW = 30  # evaluations: fewer make one round, since each has its own start to pay for

Report = Callable[[BestSoFar], None]


def tailor(task: Task, lens: Lens) -> Lens:
    """The lens after stage 2: a first round with fewer tubes, where it is long enough for that, then all of them.

    Ends when the evaluations are spent, on a plateau, when the accuracy asked for is reached (as `task.rrmsd` finds it,
    with other and more tubes), or when time is up; task.log.stopped says which.
    """
    knobs, log = task.knobs, task.log
    target = torch.from_numpy(task.target).to(lens.back.heights.device)
    done, log.stopped = 0, "evaluations"
    goal = knobs.accuracy or 0.0
    for tubes_share, share in ROUNDS if knobs.stage2_iterations >= FEW else ((1.0, 1.0),):
        if log.time_is_up:
            log.stopped = "time"
            break
        last = done + round(share * knobs.stage2_iterations)
        if last <= done:
            continue
        sheet = launch_tubes(task.source, lens, round(tubes_share * knobs.rays))
        merit = TubeMerit(sheet, task.screen, target / target.sum(), knobs.overshoot)
        while done < last:

            def report(state: BestSoFar, before: int = done, limit: float = goal) -> None:
                now = min(before + state.evaluations, knobs.stage2_iterations)  # a line search may run over a little
                log.progress("stage 2", now, knobs.stage2_iterations, f"RRMSD {state.rrmsd:.4f}")
                log.note(state.rrmsd)
                if log.time_is_up:
                    raise Enough("time")
                if state.rrmsd <= limit:
                    raise Enough("accuracy")

            variable = SobolevVariable.of(lens.back, local_weight(task.source, lens, task.target, task.screen))
            lens, best, reason = tailor_to_irradiance(lens, Problem(lens, merit), variable, last - done, report)
            log.skipped += best.skipped
            log.stopped = reason
            done += best.evaluations
            if reason == "accuracy" and (found := task.rrmsd(lens)) > knobs.accuracy:
                goal *= knobs.accuracy / found  # the tubes flatter a little: ask more of them
                log.stopped = "evaluations"  # so it will have been, if none are left
            elif reason != "evaluations":
                break
        log.end(f"stage 2, {sheet.flux.shape[0]}² tubes", task.rrmsd(lens))
        if log.stopped in ("accuracy", "time"):
            break
    log.progress("stage 2", knobs.stage2_iterations, knobs.stage2_iterations, log.stopped)
    return lens


@dataclass(frozen=True)
class Problem:
    """Merit and gradient of the back face for a fixed sheet of tubes.

    The fused kernels keep only where each corner lands, not what led there: memory is some 100 bytes a corner and does
    not grow with control points.
    """

    lens: Lens
    merit: TubeMerit

    def __call__(self, heights: Tensor) -> tuple[float, Tensor, float]:
        """(merit, ∂merit/∂heights, RRMSD)."""
        leaf = heights.detach().requires_grad_()
        lens = replace(self.lens, back=replace(self.lens.back, heights=leaf))
        merit, rrmsd = self.merit(self.merit.tubes.landing(lens, self.merit.screen.z))
        (gradient,) = torch.autograd.grad(merit, leaf)
        return float(merit.detach()), gradient, float(rrmsd)


def tailor_to_irradiance(
    lens: Lens, problem: Problem, variable: SobolevVariable, evaluations: int, report: Report
) -> tuple[Lens, BestSoFar, str]:
    """(the lens whose back face makes the merit smallest, how it went, why it ended); never worse than `lens`."""
    start = lens.back.heights

    def in_c(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        merit, gradient, rrmsd = problem(start + variable.heights(parameters[0].detach()))
        return merit, [variable.adjoint(gradient)], rrmsd

    best = BestSoFar(in_c, report)
    reason = lbfgs(best, [torch.zeros_like(start)], evaluations)
    if not best.parameters:  # not one value was finite
        return lens, best, reason
    heights = start + variable.heights(best.parameters[0])
    return replace(lens, back=replace(lens.back, heights=heights)), best, reason
