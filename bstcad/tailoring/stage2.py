"""Stage 2: the irradiance itself, by ray tubes.

Each evaluation traces the same corners of a sheet of tubes, so that the merit is smooth and without noise, and what is
gained on it is gained for the lens.  In the Sobolev variable (sobolev.py) L-BFGS needs some hundred evaluations where
Adam on raw control points needs thousands.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from bstcad.optics.lens import Lens
from bstcad.tailoring.lbfgs import Search, lbfgs
from bstcad.tailoring.merit import TubeMerit
from bstcad.tailoring.minimise import Best, Reached, minimise
from bstcad.tailoring.parameters import Parameters
from bstcad.tailoring.run import EVALUATED, Step, Task
from bstcad.tailoring.sobolev import SobolevVariable, local_weight

ROUNDS = ((2 / 3, 0.75), (1.0, 0.25))  # (tubes a side, evaluations), as shares of what the knobs say
FEW = 30  # evaluations: fewer make one round, since each has its own start to pay for


@dataclass(frozen=True)
class Place:
    """Which search of stage 2 is under way."""

    round: int  # of ROUNDS
    done: int  # evaluations before this search
    last: int  # how many there will have been at the end of this round
    goal: float  # RRMSD by its own tubes at which it asks whether the accuracy is reached
    sheet_from: Parameters  # of the lens that the tubes were launched for
    search_from: Parameters  # of the lens that this search started from


@dataclass(frozen=True)
class TubeSearch:
    """Where stage 2 stands between two steps of a search."""

    place: Place
    best: Best  # of this search
    search: Search


def steps(task: Task, lens: Lens, state: TubeSearch | None = None) -> Iterator[Step]:
    """Stage 2: a first round with fewer tubes, where it is long enough for that, then all of them.

    Ends when the evaluations are spent, on a plateau, or when the accuracy asked for is reached, as `task.rrmsd` finds
    it with other and more tubes.  Goes on from a state if there is one.
    """
    knobs = task.knobs
    target = torch.from_numpy(task.target).to(lens.back.heights.device)
    place = state.place if state else Place(0, 0, 0, knobs.accuracy or 0.0, Parameters.of(lens), Parameters.of(lens))
    rounds = ROUNDS if knobs.stage2_iterations >= FEW else ((1.0, 1.0),)
    if state is None:
        yield Step(lambda: lens)
    for number in range(place.round, len(rounds)):
        tubes, share = rounds[number]
        if state is None:
            last = place.done + round(share * knobs.stage2_iterations)
            place = replace(place, round=number, last=last, sheet_from=Parameters.of(lens))
        if place.last <= place.done:
            continue
        n = round(tubes * knobs.rays)
        part = f"stage 2, {n}² tubes"
        merit = TubeMerit.of(task.channels, place.sheet_from.applied(lens), n, task.screen, target, knobs.overshoot)
        while place.done < place.last:
            if state is None:
                place = replace(place, search_from=Parameters.of(lens))
            for reached, step in _search(task, place.search_from.applied(lens), merit, place, state):
                yield replace(step, part=part)
                if reached.reason:
                    break
            lens, state, judged = step.lens, None, None
            place, reason = replace(place, done=place.done + reached.best.evaluations), reached.reason
            if reason == "accuracy" and (judged := task.rrmsd(lens)) > knobs.accuracy:
                # the tubes flatter a little: ask more of them
                place = replace(place, goal=place.goal * knobs.accuracy / judged)
                reason = "evaluations"  # so it will have been, if none are left
            elif reason != "evaluations":
                break
        work = 0.0 if judged else task.judging
        judged = judged or task.rrmsd(lens)
        reason = reason if number == len(rounds) - 1 or reason == "accuracy" else ""
        yield Step(lambda lens=lens: lens, judged=judged, work=work, part=part, ends=True, reason=reason)
        if reason:
            return


def _search(
    task: Task, lens: Lens, merit: TubeMerit, place: Place, state: TubeSearch | None
) -> Iterator[tuple[Reached, Step]]:
    """One run of the minimiser from `lens`, or further from a state of it; it ends on reaching the goal, too."""
    total, light, evaluations = task.knobs.stage2_iterations, task.heaviest, place.last - place.done
    weight = local_weight(light.source, light.through(lens), task.target, task.screen)
    variable, work = SobolevVariable.of(lens.back, weight), 0.0  # of the first step nobody knows: it sets this up
    for reached in search(lens, Problem(lens, merit), variable, evaluations, state):
        best, reason = reached.best, reached.reason
        step = Step(partial(improved, lens, variable, best), work=work, skipped=reached.skipped)
        if not reached.skipped:
            now = min(place.done + best.evaluations, total)  # a line search may run over a little
            progress = ("stage 2", now, total, f"RRMSD {best.rrmsd:.4f}")
            step = replace(step, rrmsd=best.rrmsd, progress=progress)
            reason = "accuracy" if best.rrmsd <= place.goal else reason
        if reached.state is not None and not reason:
            step = replace(step, state=TubeSearch(place, best, reached.state))
        yield replace(reached, reason=reason), step
        work = merit.tubes / EVALUATED


@dataclass(frozen=True)
class Problem:
    """Merit and gradient of the back face for a fixed sheet of tubes a channel.

    The fused kernels keep only where each corner lands, not what led there: memory is some 100 bytes a corner and does
    not grow with control points.
    """

    lens: Lens
    merit: TubeMerit

    def __call__(self, heights: Tensor) -> tuple[float, Tensor, float]:
        """(merit, ∂merit/∂heights, RRMSD)."""
        leaf = heights.detach().requires_grad_()
        lens = replace(self.lens, back=replace(self.lens.back, heights=leaf))
        merit, rrmsd = self.merit(self.merit.landing(lens))
        (gradient,) = torch.autograd.grad(merit, leaf)
        return float(merit.detach()), gradient, float(rrmsd)


def search(
    lens: Lens, problem: Problem, variable: SobolevVariable, evaluations: int, state: TubeSearch | None = None
) -> Iterator[Reached]:
    """Makes the merit of the back face smaller, from the heights that it has, in the variable c."""
    start = lens.back.heights

    def in_c(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        merit, gradient, rrmsd = problem(start + variable.heights(parameters[0].detach()))
        return merit, [variable.adjoint(gradient)], rrmsd

    method = lbfgs([torch.zeros_like(start)], evaluations, state and state.search)
    return minimise(in_c, method, evaluations, state.best if state else Best())


def improved(lens: Lens, variable: SobolevVariable, best: Best) -> Lens:
    """The lens with the best back face that a search from it has come to; itself if not one value was finite."""
    if not best.parameters:
        return lens
    return replace(lens, back=replace(lens.back, heights=lens.back.heights + variable.heights(best.parameters[0])))
