"""Minimisers (Adam, L-BFGS) as generators, which can be stopped after any evaluation and resumed between steps.

A problem maps a list of parameter tensors to (merit, gradients, a figure such as RRMSD).  A method (`adam`, `lbfgs`)
is a generator that yields a `Query` and is sent its `Evaluation`.  `minimise` runs a method on a problem and yields the
state after each evaluation; to stop, a caller ends its loop over these states.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bstcad.optics.numerics.reductions import dot, shift

Objective = Callable[[list[Tensor]], tuple[float, list[Tensor], float]]  # parameters -> (merit, gradients, figure)


@dataclass(frozen=True)
class Best:
    """Best evaluation so far, and the counts of evaluations."""

    merit: float = math.inf
    figure: float = math.nan  # figure that the problem returns beside the merit, such as RRMSD or the largest excess
    latest: float = math.nan  # figure of the last evaluation
    parameters: tuple[Tensor, ...] = ()  # parameters of the best evaluation; () if no value was finite
    evaluations: int = 0
    skipped: int = 0  # evaluations whose merit or gradient was not finite


@dataclass(frozen=True)
class Query:
    """Request of a method for merit and gradients at some parameters."""

    parameters: list[Tensor]
    state: Any = None  # state from which the method makes this request again; None: it cannot resume here


@dataclass(frozen=True)
class Evaluation:
    """Answer to a query."""

    merit: float  # merit; infinite, with zero gradients, if merit or gradient was not finite
    gradients: list[Tensor]
    best: Best  # best evaluation so far, including this one


Method = Generator[Query, Evaluation, str]  # returns the reason why it ends


@dataclass(frozen=True)
class Iterate:
    """State of a minimisation after an evaluation."""

    best: Best
    parameters: list[Tensor] | None  # parameters of the next query; None: the method has ended
    state: Any = None  # state from which, with `best`, the method can resume; None: it cannot resume here
    skipped: bool = False  # True if merit or gradient of this evaluation was not finite
    reason: str = ""  # reason to end here: "evaluations" or the reason that the method returns; "": none


def minimise(problem: Objective, method: Method, evaluations: int, best: Best = Best()) -> Iterator[Iterate]:
    """Answer the queries of a method until it ends or `evaluations` are used up; yield the state after each answer.

    An evaluation that is not finite is counted as skipped.  best: best evaluation of the run that the method resumes.
    evaluations: largest number of evaluations, including those that `best` counts.
    """
    if best.evaluations >= evaluations:
        return
    try:
        query, reason = next(method), ""
    except StopIteration as end:  # a resumed method whose state leads nowhere, such as one that is damaged
        yield Iterate(best, None, reason=end.value)
        return
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
            yield Iterate(best, None, None, skipped=useless, reason=end.value)
            return
        if best.evaluations >= evaluations:
            reason = "evaluations"
        yield Iterate(best, query.parameters, None if reason else query.state, skipped=useless, reason=reason)


@dataclass(frozen=True)
class AdamState:
    """State of Adam between two steps."""

    step: int  # number of evaluations so far
    taken: int  # number of steps taken, without those skipped for a non-finite gradient
    parameters: tuple[Tensor, ...]
    mean: tuple[Tensor, ...]  # running mean of the gradient
    square: tuple[Tensor, ...]  # running mean of the square of the gradient


def adam(start: list[Tensor], rates: list[float], steps: int, state: AdamState | None = None) -> Method:
    """Run Adam (Kingma and Ba 2014) with one learning rate per parameter tensor; skip non-finite gradients.

    The rates fall to zero within `steps` as half a cosine: Adam's steps do not shrink with the gradient, and at a
    constant rate the control points keep jumping by about this rate.  The method never ends by itself.  Its result is
    the parameters of the last query: with new random rays in each step the best merit is a matter of chance.
    """
    parameters = [p.clone() for p in (start if state is None else state.parameters)]
    optimiser = torch.optim.Adam([{"params": [p], "lr": r} for p, r in zip(parameters, rates, strict=True)])
    if state is not None and state.taken:
        for p, mean, square in zip(parameters, state.mean, state.square, strict=True):
            count = torch.tensor(float(state.taken))  # torch counts on the CPU
            optimiser.state[p] |= {"step": count, "exp_avg": mean.clone(), "exp_avg_sq": square.clone()}
    step = 0 if state is None else state.step
    while True:
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = rate * (1 + math.cos(math.pi * step / steps)) / 2
        moments = [optimiser.state[p] for p in parameters if optimiser.state[p]]
        means, squares = (tuple(m[name].clone() for m in moments) for name in ("exp_avg", "exp_avg_sq"))
        taken = int(moments[0]["step"]) if moments else 0
        copies = tuple(p.clone() for p in parameters)  # Adam works in place
        evaluation = yield Query(list(copies), AdamState(step, taken, copies, mean=means, square=squares))
        if math.isfinite(evaluation.merit):
            for p, g in zip(parameters, evaluation.gradients, strict=True):
                p.grad = g
            optimiser.step()
        step += 1


LBFGS_MEMORY = 12  # number of steps whose changes of x and gradient L-BFGS keeps
ARMIJO, WOLFE = 1e-4, 0.9  # constants c1 and c2 of the strong Wolfe conditions
MAX_LINE_TRIALS = 20  # largest number of trials along a line

Pairs = tuple[tuple[Tensor, Tensor, float], ...]  # (s, y, s · y): s change of x, y of gradient; oldest first
Values = Generator[Query, Evaluation, tuple[float, Tensor]]  # returns the merit and its gradient


class Plateau(NamedTuple):
    """Definition of a plateau: the merit has fallen by less than the fraction `gain` in `steps` steps."""

    steps: int
    gain: float


PLATEAU = Plateau(10, 0.005)


@dataclass(frozen=True)
class LbfgsState:
    """State of L-BFGS between two steps."""

    x: Tensor  # all parameters, as one vector
    value: float  # merit at x
    gradient: Tensor
    pairs: Pairs = ()
    steps: int = 0
    before: float = math.inf  # best merit at the last check for a plateau


def lbfgs(
    start: list[Tensor], evaluations: int, state: LbfgsState | None = None, pairs: Pairs = (),
    plateau: Plateau = PLATEAU,
) -> Method:  # fmt: skip
    """Run limited-memory BFGS with a strong Wolfe line search (Nocedal and Wright 2006, algorithms 7.5, 3.5, 3.6).

    pairs: `LbfgsState.pairs` of a run on a similar problem, from which the first steps take their inverse Hessian.

    Returns "plateau" if no step lowers the merit.  Also returns it on a plateau, if more than `plateau.steps` of the
    `evaluations` are left; the merit is compared every `plateau.steps` steps.  A run resumed from a state has the
    result of an uninterrupted run.  (torch.optim's L-BFGS would load a compiler for longer than a draft takes.)
    """
    sizes, best, resumable = [p.numel() for p in start], Best(), state

    def at(x: Tensor) -> Values:
        nonlocal best, resumable
        parts = [part.view(p.shape) for part, p in zip(x.split(sizes), start, strict=True)]
        evaluation = yield Query(parts, resumable)
        best, resumable = evaluation.best, None
        return evaluation.merit, torch.cat([g.reshape(-1) for g in evaluation.gradients])

    if state is None:
        x = torch.cat([p.detach().reshape(-1) for p in start])
        value, gradient = yield from at(x)
        state = LbfgsState(x, value, gradient, pairs=pairs, before=best.merit)
    search = state
    while True:
        resumable = search
        following = yield from _step(at, search)
        if following is None:
            return "plateau"
        search = following
        if search.steps % plateau.steps == 0:
            if evaluations - best.evaluations > plateau.steps and best.merit > (1 - plateau.gain) * search.before:
                return "plateau"
            search = replace(search, before=best.merit)


def _step(at: Callable[[Tensor], Values], search: LbfgsState) -> Generator[Query, Evaluation, LbfgsState | None]:
    """Return the state after one step; None if no step lowers the merit."""
    x, value, g, pairs = search.x, search.value, search.gradient, search.pairs
    direction = -_inverse_hessian_times(g, pairs)
    slope = dot(g, direction)
    if not slope < 0:
        return None
    first = 1.0 if pairs else value / dot(g, g)  # Polyak's step to a merit of 0, if the merit fell as its tangent does

    def along(step: float) -> LineSearch:
        value, gradient = yield from at(x + step * direction)
        return LinePoint(step, value, dot(gradient, direction), gradient)

    trial = yield from _strong_wolfe(along, LinePoint(0.0, value, slope, g), first)
    if not trial.value < value:
        return None
    s, y = trial.step * direction, trial.gradient - g
    if (curvature := dot(s, y)) > 1e-10 * math.sqrt(dot(s, s) * dot(y, y)):
        pairs = (*pairs, (s, y, curvature))[-LBFGS_MEMORY:]
    return LbfgsState(x + s, trial.value, trial.gradient, pairs=pairs, steps=search.steps + 1, before=search.before)


def _inverse_hessian_times(g: Tensor, pairs: Pairs) -> Tensor:
    """Return H g, H the inverse Hessian, by the two-loop recursion (algorithm 7.4).

    Each pass over the vectors also computes the product that the next pass needs, since memory limits the speed.
    """
    q, alphas = g.clone(), []
    if not pairs:
        return q
    y_last, curvature = pairs[-1][1:]
    scale, product = curvature / dot(y_last, y_last), dot(pairs[-1][0], q)
    for number in range(len(pairs) - 1, -1, -1):
        _, y, curvature = pairs[number]
        alphas.append(product / curvature)
        if number:
            product = shift(q, y, -alphas[-1], along=pairs[number - 1][0])
        else:
            product = shift(q, y, -alphas[-1] * scale, along=y, scale=scale)
    for number, (s, _, curvature) in enumerate(pairs):
        following = pairs[min(number + 1, len(pairs) - 1)][1]
        product = shift(q, s, alphas.pop() - product / curvature, along=following)
    return q


@dataclass(frozen=True)
class LinePoint:
    """Merit and gradient at a point of a line search."""

    step: float
    value: float
    slope: float  # derivative along the line
    gradient: Tensor


LineSearch = Generator[Query, Evaluation, LinePoint]  # returns the point that it accepts
Along = Callable[[float], LineSearch]  # evaluates the point at a step


def _strong_wolfe(along: Along, start: LinePoint, step: float) -> LineSearch:
    """Return a point at a step a with f <= f0 + c1 a f0' and |f'| <= c2 |f0'| (algorithm 3.5), or the last point."""
    before = start
    for _ in range(MAX_LINE_TRIALS):
        trial = yield from along(step)
        if trial.value > start.value + ARMIJO * step * start.slope or trial.value >= before.value:
            return (yield from _zoom(along, start, before, trial))
        if abs(trial.slope) <= -WOLFE * start.slope:
            return trial
        if trial.slope >= 0:
            return (yield from _zoom(along, start, trial, before))
        nearest, farthest = step + 0.01 * (step - before.step), 10.0 * step
        lowest = _cubic_minimum(before, trial)
        step = min(max(lowest, nearest), farthest) if lowest > step else farthest  # no minimum: go far
        before = trial
    return before


def _zoom(along: Along, start: LinePoint, low: LinePoint, high: LinePoint) -> LineSearch:
    """Return the point of `_strong_wolfe` that low and high bracket (algorithm 3.6); `low` has the lower merit."""
    for _ in range(MAX_LINE_TRIALS):
        margin = 0.1 * abs(high.step - low.step)  # distance to keep from the ends of the interval
        nearest, farthest = sorted((low.step, high.step))
        if not nearest < nearest + margin < farthest:  # the merit jumps: no float is left between them
            break
        step = min(max(_cubic_minimum(low, high), nearest + margin), farthest - margin)
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


def _cubic_minimum(a: LinePoint, b: LinePoint) -> float:
    """Return the minimum of the cubic through two values and slopes (Eq. 3.59 of `lbfgs`'s source), or the midpoint."""
    halfway, distance = (a.step + b.step) / 2, a.step - b.step
    if not all(map(math.isfinite, (a.value, b.value, a.slope, b.slope))):
        return halfway
    d1 = a.slope + b.slope - 3 * (a.value - b.value) / distance
    square = d1 * d1 - a.slope * b.slope
    if square < 0:
        return halfway
    d2 = math.copysign(math.sqrt(square), -distance)
    divisor = b.slope - a.slope + 2 * d2
    return b.step + distance * (b.slope + d2 - d1) / divisor if divisor else halfway
