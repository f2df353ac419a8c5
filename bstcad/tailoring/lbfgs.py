"""L-BFGS: the minimiser of stage 2."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from bstcad.optics.kernels.reductions import dot, total
from bstcad.tailoring.minimise import BestSoFar, Enough, Keep, forget

MEMORY = 12  # steps that L-BFGS remembers
BLOCK = 10  # of its steps, after which it is asked whether it still gains
PLATEAU = 0.005  # of the merit; less in a block is not worth its time
ARMIJO, WOLFE = 1e-4, 0.9  # c1, c2 of the strong Wolfe conditions
SEARCH = 20  # trials along a line, at most


def lbfgs(
    problem: BestSoFar,
    start: list[Tensor],
    evaluations: int,
    keep: Keep = forget,
    found: dict[str, Any] | None = None,
) -> str:
    """Limited-memory BFGS with a strong Wolfe line search (Nocedal and Wright 2006, algorithms 7.5, 3.5 and 3.6).

    Ends after so many evaluations, or on a plateau: BLOCK steps that gained less than PLATEAU of the merit, or no way
    down at all; or when the problem's report has had Enough.  Returns why: "evaluations", "plateau", or what the report
    said.  `keep` is called between two steps with all that the next ones depend on; given as `found`, it goes on from
    there to the same end.  (torch.optim has the same method, but loads a compiler for it that takes longer than a
    draft's stage 2.)
    """

    def at(x: Tensor) -> tuple[float, Tensor]:
        if problem.evaluations >= evaluations:
            raise Enough("evaluations")
        parts = x.split([p.numel() for p in start])
        merit, gradients, _ = problem([part.view(p.shape) for part, p in zip(parts, start, strict=True)])
        return merit, torch.cat([g.reshape(-1) for g in gradients])

    try:
        if found is None:
            x = torch.cat([p.detach().reshape(-1) for p in start])
            search = Search(x, *at(x))
        else:
            problem.restore(found["best"])
            search = Search(**found["search"])
        while True:
            keep({"best": problem.state(), "search": vars(search)})
            if search.steps % BLOCK == 0:
                search = replace(search, before=problem.merit)
            ahead = _step(at, search)
            if ahead is None:
                return "plateau"
            search, left = ahead, evaluations - problem.evaluations
            if search.steps % BLOCK == 0 and left > BLOCK and problem.merit > (1 - PLATEAU) * search.before:
                return "plateau"
    except Enough as reason:
        return str(reason)


@dataclass(frozen=True)
class Search:
    """Where L-BFGS stands between two steps."""

    x: Tensor
    value: float
    gradient: Tensor
    pairs: tuple[tuple[Tensor, Tensor, float], ...] = ()  # (change of x, of the gradient, their product), oldest first
    steps: int = 0
    before: float = math.inf  # the best merit when this block of steps began


def _step(at: Callable[[Tensor], tuple[float, Tensor]], search: Search) -> Search | None:
    """One step; None if there is no way down."""
    x, value, g, pairs = search.x, search.value, search.gradient, search.pairs
    way = -_inverse_hessian_times(g, pairs)
    slope = dot(g, way)
    if not slope < 0:
        return None
    first = 1.0 if pairs else min(1.0, 1.0 / float(total(g.abs())))
    trial = _strong_wolfe(partial(_along, at, x, way), Trial(0.0, value, slope, g), first)
    if not trial.value < value:
        return None
    change, turn = trial.step * way, trial.gradient - g
    if (curvature := dot(change, turn)) > 1e-10 * math.sqrt(dot(change, change) * dot(turn, turn)):
        pairs = (*pairs, (change, turn, curvature))[-MEMORY:]
    return Search(x + change, trial.value, trial.gradient, pairs, search.steps + 1, search.before)


def _inverse_hessian_times(g: Tensor, pairs: Sequence[tuple[Tensor, Tensor, float]]) -> Tensor:
    """The two loops: pairs are (change of x, change of the gradient, their product), oldest first."""
    q, shares = g.clone(), []
    for change, turn, curvature in reversed(pairs):
        shares.append(dot(change, q) / curvature)
        q -= shares[-1] * turn
    if pairs:
        _, turn, curvature = pairs[-1]
        q *= curvature / dot(turn, turn)
    for (change, turn, curvature), share in zip(pairs, reversed(shares), strict=True):
        q += (share - dot(turn, q) / curvature) * change
    return q


@dataclass(frozen=True)
class Trial:
    """One place along a line."""

    step: float
    value: float
    slope: float  # along the line
    gradient: Tensor


def _along(at: Callable[[Tensor], tuple[float, Tensor]], x: Tensor, way: Tensor, step: float) -> Trial:
    value, gradient = at(x + step * way)
    return Trial(step, value, dot(gradient, way), gradient)


def _strong_wolfe(along: Callable[[float], Trial], start: Trial, step: float) -> Trial:
    """A place with f <= f0 + c1 a f0' and |f'| <= c2 |f0'|, or after SEARCH trials the best one."""
    before = start
    for _ in range(SEARCH):
        trial = along(step)
        if trial.value > start.value + ARMIJO * step * start.slope or trial.value >= before.value:
            return _zoom(along, start, before, trial)
        if abs(trial.slope) <= -WOLFE * start.slope:
            return trial
        if trial.slope >= 0:
            return _zoom(along, start, trial, before)
        nearest, farthest = step + 0.01 * (step - before.step), 10.0 * step
        step = min(max(_lowest_of_cubic(before, trial), nearest), farthest)
        before = trial
    return before


def _zoom(along: Callable[[float], Trial], start: Trial, low: Trial, high: Trial) -> Trial:
    """Between two places that enclose such a one; `low` is the lower."""
    for _ in range(SEARCH):
        edge = 0.1 * abs(high.step - low.step)  # stay clear of both ends
        nearest, farthest = sorted((low.step, high.step))
        if not nearest < nearest + edge < farthest:  # a merit that jumps there: no number is left between them
            break
        step = min(max(_lowest_of_cubic(low, high), nearest + edge), farthest - edge)
        trial = along(step)
        if trial.value > start.value + ARMIJO * step * start.slope or trial.value >= low.value:
            high = trial
        else:
            if abs(trial.slope) <= -WOLFE * start.slope:
                return trial
            if trial.slope * (high.step - low.step) >= 0:
                high = low
            low = trial
    return low


def _lowest_of_cubic(a: Trial, b: Trial) -> float:
    """Where the cubic through values and slopes of two places is lowest (equation 3.59); halfway if it is nowhere."""
    halfway, apart = (a.step + b.step) / 2, a.step - b.step
    if not all(map(math.isfinite, (a.value, b.value, a.slope, b.slope))):
        return halfway
    d1 = a.slope + b.slope - 3 * (a.value - b.value) / apart
    square = d1 * d1 - a.slope * b.slope
    if square < 0:
        return halfway
    d2 = math.copysign(math.sqrt(square), -apart)
    below = b.slope - a.slope + 2 * d2
    return b.step + apart * (b.slope + d2 - d1) / below if below else halfway
