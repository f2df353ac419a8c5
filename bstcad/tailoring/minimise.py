"""Minimisers: a method queries values of the merit, so that whoever evaluates may as well stop.

A problem maps a list of parameter tensors to (merit, gradients, a figure such as RRMSD).  A method (`adam`, `lbfgs`)
is a generator that yields a `Query` and is sent its `Evaluation`.  `minimise` brings the two together and says after
each evaluation where the minimisation stands; nothing has to be done to end it there.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from bstcad.optics.kernels.reductions import dot, total

Problem = Callable[[list[Tensor]], tuple[float, list[Tensor], float]]


@dataclass(frozen=True)
class Best:
    """The best of the evaluations so far."""

    merit: float = math.inf
    figure: float = math.nan  # of it, as the problem tells it beside the merit: RRMSD, or the worst excess
    latest: float = math.nan  # figure of the last evaluation
    parameters: tuple[Tensor, ...] = ()  # none while not one value was finite
    evaluations: int = 0
    skipped: int = 0  # of them, because merit or gradient was not finite


@dataclass(frozen=True)
class Query:
    """Where a method wants to know the merit."""

    parameters: list[Tensor]
    state: Any = None  # with which the method would ask this again, and go on as now; None: not from here


@dataclass(frozen=True)
class Evaluation:
    """The answer to a query."""

    merit: float  # infinite, and the gradients zero, if one of them was not finite
    gradients: list[Tensor]
    best: Best  # this evaluation included


Method = Generator[Query, Evaluation, str]  # returns why it has nothing more to ask


@dataclass(frozen=True)
class Reached:
    """Where a minimisation stands after an evaluation."""

    best: Best
    parameters: list[Tensor] | None  # where the method would go next
    state: Any = None  # with which, and with `best`, the method goes on from here; None: it cannot be left here
    skipped: bool = False  # was this evaluation of no use?
    reason: str = ""  # why it ends here, if it does: "evaluations", or the method's own reason


def minimise(problem: Problem, method: Method, evaluations: int, best: Best = Best()) -> Iterator[Reached]:
    """Answer the method's queries until it has none left or the evaluations are spent.

    A value that is not finite is counted, not used.  `best`: of the evaluations before the method's state.
    """
    if best.evaluations >= evaluations:
        return
    query, reason = next(method), ""
    while not reason:
        merit, gradients, figure = problem(query.parameters)
        skipped = best.skipped
        if not math.isfinite(merit) or not all(bool(torch.isfinite(g).all()) for g in gradients):
            merit, gradients, skipped = math.inf, [torch.zeros_like(p) for p in query.parameters], skipped + 1
        lowest, at, lowest_figure = best.merit, best.parameters, best.figure
        if merit < lowest:
            lowest, at, lowest_figure = merit, tuple(p.detach().clone() for p in query.parameters), figure
        useless = skipped > best.skipped
        best = Best(lowest, lowest_figure, figure, parameters=at, evaluations=best.evaluations + 1, skipped=skipped)
        try:
            query, reason = method.send(Evaluation(merit, gradients, best)), ""
        except StopIteration as end:
            yield Reached(best, None, None, skipped=useless, reason=end.value)
            return
        if best.evaluations >= evaluations:
            reason = "evaluations"
        yield Reached(best, query.parameters, None if reason else query.state, skipped=useless, reason=reason)


@dataclass(frozen=True)
class AdamState:
    """Where Adam stands between two steps."""

    step: int  # evaluations before
    taken: int  # steps, of which some may have been left out
    parameters: tuple[Tensor, ...]
    mean: tuple[Tensor, ...]  # of the gradient
    square: tuple[Tensor, ...]  # mean of its square


def adam(start: list[Tensor], rates: list[float], steps: int, state: AdamState | None = None) -> Method:
    """Kingma and Ba 2014, one learning rate a parameter tensor; a step with a non-finite gradient is left out.

    The rates fall to zero within `steps`, as half a cosine: Adam's steps do not shrink with the gradient, and at a
    constant rate the control points go on jumping by as much as the rate.  Its queries never end; the query after the
    last evaluation is the result: with fresh random rays in each step the best merit is only the luckiest draw.
    """
    parameters = [p.clone() for p in (start if state is None else state.parameters)]
    optimiser = torch.optim.Adam([{"params": [p], "lr": r} for p, r in zip(parameters, rates, strict=True)])
    if state is not None and state.taken:
        for p, mean, square in zip(parameters, state.mean, state.square, strict=True):
            taken = torch.tensor(float(state.taken))  # torch counts on the CPU
            optimiser.state[p] |= {"step": taken, "exp_avg": mean.clone(), "exp_avg_sq": square.clone()}
    for step in itertools.count(0 if state is None else state.step):
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = rate * (1 + math.cos(math.pi * step / steps)) / 2
        moments = [optimiser.state[p] for p in parameters if optimiser.state[p]]
        mean, square = (tuple(m[name].clone() for m in moments) for name in ("exp_avg", "exp_avg_sq"))
        taken = int(moments[0]["step"]) if moments else 0
        held = tuple(p.clone() for p in parameters)  # Adam works in place
        state = AdamState(step, taken, held, mean=mean, square=square)
        evaluation = yield Query(list(state.parameters), state)
        if math.isfinite(evaluation.merit):
            for p, g in zip(parameters, evaluation.gradients, strict=True):
                p.grad = g
            optimiser.step()


MEMORY = 12  # steps that L-BFGS remembers
BLOCK = 10  # of its steps, after which it is asked whether it still gains
PLATEAU = 0.005  # of the merit; less in a block is not worth its time
ARMIJO, WOLFE = 1e-4, 0.9  # c1, c2 of the strong Wolfe conditions
SEARCH = 20  # trials along a line, at most

Values = Generator[Query, Evaluation, tuple[float, Tensor]]  # the merit somewhere, and its gradient there


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
        evaluation = yield Query(parts, standing)
        best, standing = evaluation.best, None
        return evaluation.merit, torch.cat([g.reshape(-1) for g in evaluation.gradients])

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


def _step(at: Callable[[Tensor], Values], search: Search) -> Generator[Query, Evaluation, Search | None]:
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
    return Search(x + change, trial.value, trial.gradient, pairs=pairs, steps=search.steps + 1, before=search.before)


def _inverse_hessian_times(g: Tensor, pairs: Sequence[tuple[Tensor, Tensor, float]]) -> Tensor:
    """The two loops: pairs are (change of x, change of the gradient, their product), oldest first."""
    q, shares = g.clone(), []
    for change, turn, curvature in reversed(pairs):
        shares.append(dot(change, q) / curvature)
        q += -shares[-1] * turn
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


Along = Callable[[float], Generator[Query, Evaluation, Trial]]


def _along(at: Callable[[Tensor], Values], x: Tensor, way: Tensor, step: float) -> Generator[Query, Evaluation, Trial]:
    value, gradient = yield from at(x + step * way)
    return Trial(step, value, dot(gradient, way), gradient)


def _strong_wolfe(along: Along, start: Trial, step: float) -> Generator[Query, Evaluation, Trial]:
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


def _zoom(along: Along, start: Trial, low: Trial, high: Trial) -> Generator[Query, Evaluation, Trial]:
    """A place as `_strong_wolfe` looks for, between two places that enclose it; `low` is the lower."""
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
    """The step at which the cubic through values and slopes of two places is lowest (equation 3.59), or halfway."""
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
