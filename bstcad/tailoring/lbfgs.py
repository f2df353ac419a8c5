"""L-BFGS: the minimiser of stage 2."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from bstcad.optics.kernels.reductions import dot, total
from bstcad.tailoring.minimise import Ask, Method, Told

MEMORY = 12  # steps that L-BFGS remembers
BLOCK = 10  # of its steps, after which it is asked whether it still gains
PLATEAU = 0.005  # of the merit; less in a block is not worth its time
ARMIJO, WOLFE = 1e-4, 0.9  # c1, c2 of the strong Wolfe conditions
SEARCH = 20  # trials along a line, at most

Values = Generator[Ask, Told, tuple[float, Tensor]]  # the merit somewhere, and its gradient there


@dataclass(frozen=True)
class Search:
    """Where L-BFGS stands between two steps."""

    x: Tensor
    value: float
    gradient: Tensor
    pairs: tuple[tuple[Tensor, Tensor, float], ...] = ()  # (change of x, of the gradient, their product), oldest first
    steps: int = 0
    before: float = math.inf  # the best merit when this block of steps began


def lbfgs(start: list[Tensor], evaluations: int, state: Search | None = None) -> Method:
    """Limited-memory BFGS with a strong Wolfe line search (Nocedal and Wright 2006, algorithms 7.5, 3.5 and 3.6).

    Ends on a "plateau": BLOCK steps that gained less than PLATEAU of the merit, though more than that could still be
    taken within so many evaluations, or no way down at all.  It can be left between two steps, and goes on from a
    state to the same end.  (torch.optim has the same method, but loads a compiler for it that takes longer than a
    draft's stage 2.)
    """
    sizes, best, standing = [p.numel() for p in start], None, None

    def at(x: Tensor) -> Values:
        nonlocal best, standing
        parts = [part.view(p.shape) for part, p in zip(x.split(sizes), start, strict=True)]
        told = yield Ask(parts, standing)
        best, standing = told.best, None
        return told.merit, torch.cat([g.reshape(-1) for g in told.gradients])

    search = state
    if search is None:
        x = torch.cat([p.detach().reshape(-1) for p in start])
        search = Search(x, *(yield from at(x)))
        search = replace(search, before=best.merit)
    while True:
        standing = search
        ahead = yield from _step(at, search)
        if ahead is None:
            return "plateau"
        search = ahead
        if search.steps % BLOCK == 0:
            if evaluations - best.evaluations > BLOCK and best.merit > (1 - PLATEAU) * search.before:
                return "plateau"
            search = replace(search, before=best.merit)


def _step(at: Callable[[Tensor], Values], search: Search) -> Generator[Ask, Told, Search | None]:
    """One step; None if there is no way down."""
    x, value, g, pairs = search.x, search.value, search.gradient, search.pairs
    way = -_inverse_hessian_times(g, pairs)
    slope = dot(g, way)
    if not slope < 0:
        return None
    first = 1.0 if pairs else min(1.0, 1.0 / float(total(g.abs())))
    trial = yield from _strong_wolfe(partial(_along, at, x, way), Trial(0.0, value, slope, g), first)
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


Along = Callable[[float], Generator[Ask, Told, Trial]]


def _along(at: Callable[[Tensor], Values], x: Tensor, way: Tensor, step: float) -> Generator[Ask, Told, Trial]:
    value, gradient = yield from at(x + step * way)
    return Trial(step, value, dot(gradient, way), gradient)


def _strong_wolfe(along: Along, start: Trial, step: float) -> Generator[Ask, Told, Trial]:
    """A place with f <= f0 + c1 a f0' and |f'| <= c2 |f0'|, or after SEARCH trials the best one."""
    before = start
    for _ in range(SEARCH):
        trial = yield from along(step)
        if trial.value > start.value + ARMIJO * step * start.slope or trial.value >= before.value:
            return (yield from _zoom(along, start, before, trial))
        if abs(trial.slope) <= -WOLFE * start.slope:
            return trial
        if trial.slope >= 0:
            return (yield from _zoom(along, start, trial, before))
        nearest, farthest = step + 0.01 * (step - before.step), 10.0 * step
        lowest = _lowest_of_cubic(before, trial)
        step = min(max(lowest, nearest), farthest) if lowest > step else farthest  # none ahead: it goes on falling
        before = trial
    return before


def _zoom(along: Along, start: Trial, low: Trial, high: Trial) -> Generator[Ask, Told, Trial]:
    """Between two places that enclose such a one; `low` is the lower."""
    for _ in range(SEARCH):
        edge = 0.1 * abs(high.step - low.step)  # stay clear of both ends
        nearest, farthest = sorted((low.step, high.step))
        if not nearest < nearest + edge < farthest:  # a merit that jumps there: no number is left between them
            break
        step = min(max(_lowest_of_cubic(low, high), nearest + edge), farthest - edge)
        trial = yield from along(step)
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
