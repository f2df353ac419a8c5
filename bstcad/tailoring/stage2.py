"""Stage 2: the irradiance itself, by ray tubes.

Each evaluation traces the same corners of a sheet of tubes, so that the merit is smooth and without noise, and what is
gained on it is gained for the lens.  In the Sobolev variable (sobolev.py) L-BFGS needs some hundred evaluations where
Adam on raw control points needs thousands.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from bstcad.optics.lens import Lens
from bstcad.runs.checkpoint import as_record, as_state
from bstcad.tailoring.lbfgs import lbfgs
from bstcad.tailoring.merit import TubeMerit
from bstcad.tailoring.minimise import BestSoFar, Enough, Keep, forget
from bstcad.tailoring.parameters import Parameters
from bstcad.tailoring.run import EVALUATED, Task
from bstcad.tailoring.sobolev import SobolevVariable, local_weight

ROUNDS = ((2 / 3, 0.75), (1.0, 0.25))  # (tubes a side, evaluations), as shares of what the knobs say
FEW = 30  # evaluations: fewer make one round, since each has its own start to pay for

Report = Callable[[BestSoFar], None]


def tailor(task: Task, lens: Lens, found: dict[str, Any] | None = None) -> Lens:
    """The lens after stage 2: a first round with fewer tubes, where it is long enough for that, then all of them.

    Ends when the evaluations are spent, on a plateau, when the accuracy asked for is reached (as `task.rrmsd` finds it,
    with other and more tubes), when time is up or the user has asked for the best so far; task.log.stopped says which.
    Goes on from a state of `task.keep` if one is found.
    """
    knobs, log = task.knobs, task.log
    target = torch.from_numpy(task.target).to(lens.back.heights.device)
    log.stopped = "evaluations"
    place = Place(0, 0, 0, knobs.accuracy or 0.0, Parameters.of(lens), Parameters.of(lens))
    search = None
    if found is not None:
        place, search = as_record(Place, found["place"]), found["search"]
    rounds = ROUNDS if knobs.stage2_iterations >= FEW else ((1.0, 1.0),)
    for number in range(place.round, len(rounds)):
        tubes_share, share = rounds[number]
        if search is None:
            last = place.done + round(share * knobs.stage2_iterations)
            place = replace(place, round=number, last=last, sheet_from=Parameters.of(lens))
            if reason := log.hurry:
                log.stopped = reason
                break
        if place.last <= place.done:
            continue
        n = round(tubes_share * knobs.rays)
        merit = TubeMerit.of(task.channels, place.sheet_from.applied(lens), n, task.screen, target, knobs.overshoot)
        while place.done < place.last:
            if search is None:
                place = replace(place, search_from=Parameters.of(lens))
            lens, best, reason = _search(task, place.search_from.applied(lens), merit, place, search)
            search = None
            log.skipped += best.skipped
            log.stopped = reason
            place = replace(place, done=place.done + best.evaluations)
            if reason == "accuracy" and (reached := task.rrmsd(lens)) > knobs.accuracy:
                # the tubes flatter a little: ask more of them
                place = replace(place, goal=place.goal * knobs.accuracy / reached)
                log.stopped = "evaluations"  # so it will have been, if none are left
            elif reason != "evaluations":
                break
        log.end(f"stage 2, {n}² tubes", task.rrmsd(lens))
        if log.stopped in ("accuracy", "time", "interrupt"):
            break
    log.progress("stage 2", knobs.stage2_iterations, knobs.stage2_iterations, log.stopped)
    return lens


@dataclass(frozen=True)
class Place:
    """Where stage 2 stands."""

    round: int  # of ROUNDS
    done: int  # evaluations before this search
    last: int  # how many there will have been at the end of this round
    goal: float  # RRMSD by its own tubes at which it asks whether the accuracy is reached
    sheet_from: Parameters  # of the lens that the tubes were launched for
    search_from: Parameters  # of the lens that this search started from


def _search(
    task: Task, lens: Lens, merit: TubeMerit, place: Place, found: dict[str, Any] | None
) -> tuple[Lens, BestSoFar, str]:
    """One run of the minimiser from `lens`, or further from a state of it."""
    knobs, log = task.knobs, task.log
    tubes, last = merit.tubes, time.perf_counter()

    def report(state: BestSoFar) -> None:
        nonlocal last
        log.step, last = time.perf_counter() - last, time.perf_counter()
        if state.evaluations > 1:  # before the first one the variable is set up
            log.traced(tubes, log.step, EVALUATED)
        now = min(place.done + state.evaluations, knobs.stage2_iterations)  # a line search may run over a little
        log.progress("stage 2", now, knobs.stage2_iterations, f"RRMSD {state.rrmsd:.4f}")
        log.note(state.rrmsd)
        if reason := log.hurry:
            raise Enough(reason)
        if state.rrmsd <= place.goal:
            raise Enough("accuracy")

    def keep(search: dict[str, Any]) -> None:
        task.keep({"place": as_state(place), "search": search})

    light = task.heaviest
    variable = SobolevVariable.of(lens.back, local_weight(light.source, light.through(lens), task.target, task.screen))
    return tailor_to_irradiance(lens, Problem(lens, merit), variable, place.last - place.done, report, keep, found)


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


def tailor_to_irradiance(
    lens: Lens,
    problem: Problem,
    variable: SobolevVariable,
    evaluations: int,
    report: Report,
    keep: Keep = forget,
    found: dict[str, Any] | None = None,
) -> tuple[Lens, BestSoFar, str]:
    """(the lens whose back face makes the merit smallest, how it went, why it ended); never worse than `lens`.

    keep, found: as `lbfgs` has them.
    """
    start = lens.back.heights

    def in_c(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        merit, gradient, rrmsd = problem(start + variable.heights(parameters[0].detach()))
        return merit, [variable.adjoint(gradient)], rrmsd

    best = BestSoFar(in_c, report)
    reason = lbfgs(best, [torch.zeros_like(start)], evaluations, keep, found)
    if not best.parameters:  # not one value was finite
        return lens, best, reason
    heights = start + variable.heights(best.parameters[0])
    return replace(lens, back=replace(lens.back, heights=heights)), best, reason
