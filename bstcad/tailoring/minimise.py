"""Minimisers of one interface: a problem (value and gradient), a start, a method; the best state is kept.

A problem maps a list of parameter tensors to (merit, gradients, RRMSD); `BestSoFar` wraps it, so that the best state,
the count and the report stand once, whatever the method.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

MEMORY = 12  # steps that L-BFGS remembers
BLOCK = 10  # of its steps, after which it is asked whether it still gains
PLATEAU = 0.005  # of the merit; less in a block is not worth its time
ARMIJO, WOLFE = 1e-4, 0.9  # c1, c2 of the strong Wolfe conditions
SEARCH = 20  # trials along a line, at most

Problem = Callable[[list[Tensor]], tuple[float, list[Tensor], float]]


class Enough(Exception):
    """Raised by a report to end a minimisation; its text says why."""


@dataclass
class BestSoFar:
    """Evaluates a problem and keeps the best parameters seen; a value that is not finite is counted, not used."""

    problem: Problem
    report: Callable[[BestSoFar], None]  # called after each evaluation
    merit: float = math.inf
    rrmsd: float = math.nan  # of the best
    latest: float = math.nan  # RRMSD of the last evaluation
    parameters: list[Tensor] = field(default_factory=list)
    evaluations: int = 0
    skipped: int = 0

    def __call__(self, parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        """(merit, gradients, RRMSD) at `parameters`."""
        merit, gradients, rrmsd = self.problem(parameters)
        self.evaluations += 1
        self.latest = rrmsd
        if not math.isfinite(merit) or not all(bool(torch.isfinite(g).all()) for g in gradients):
            self.skipped += 1
            return math.inf, [torch.zeros_like(p) for p in parameters], rrmsd
        if merit < self.merit:
            self.merit, self.rrmsd = merit, rrmsd
            self.parameters = [p.detach().clone() for p in parameters]
        self.report(self)
        return merit, gradients, rrmsd


def adam(problem: BestSoFar, start: list[Tensor], rates: list[float], steps: int) -> list[Tensor]:
    """Kingma and Ba 2014, one learning rate a parameter tensor; a step with a non-finite gradient is left out.

    The rates fall to zero as half a cosine: Adam's steps do not shrink with the gradient, and at a constant rate the
    control points go on jumping by as much as the rate.

    Returns the last parameters: with fresh random rays in each step the best merit is only the luckiest draw.
    """
    parameters = [p.clone() for p in start]
    optimiser = torch.optim.Adam([{"params": [p], "lr": r} for p, r in zip(parameters, rates, strict=True)])
    for step in range(steps):
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = rate * (1 + math.cos(math.pi * step / steps)) / 2
        merit, gradients, _ = problem(parameters)
        if math.isfinite(merit):
            for p, g in zip(parameters, gradients, strict=True):
                p.grad = g
            optimiser.step()
    return parameters


def lbfgs(problem: BestSoFar, start: list[Tensor], evaluations: int) -> str:
    """Limited-memory BFGS with a strong Wolfe line search (Nocedal and Wright 2006, algorithms 7.5, 3.5 and 3.6).

    Ends after so many evaluations, or on a plateau: BLOCK steps that gained less than PLATEAU of the merit, or no way
    down at all; or when the problem's report has had Enough.  Returns why: "evaluations", "plateau", or what the report
    said.  (torch.optim has the same method, but loads a compiler for it that takes longer than a draft's stage 2.)
    """

    def at(x: Tensor) -> tuple[float, Tensor]:
        if problem.evaluations >= evaluations:
            raise Enough("evaluations")
        parts = x.split([p.numel() for p in start])
        merit, gradients, _ = problem([part.view(p.shape) for part, p in zip(parts, start, strict=True)])
        return merit, torch.cat([g.reshape(-1) for g in gradients])

    x = torch.cat([p.detach().reshape(-1) for p in start])
    pairs: deque[tuple[Tensor, Tensor, float]] = deque(maxlen=MEMORY)
    try:
        value, g = at(x)
        for steps in itertools.count(1):
            if (steps - 1) % BLOCK == 0:
                before = problem.merit
            way = -_inverse_hessian_times(g, pairs)
            slope = float(g @ way)
            if not slope < 0:
                return "plateau"
            first = 1.0 if pairs else min(1.0, 1.0 / float(g.abs().sum()))
            trial = _strong_wolfe(partial(_along, at, x, way), Trial(0.0, value, slope, g), first)
            if not trial.value < value:
                return "plateau"
            change, turn = trial.step * way, trial.gradient - g
            x, value, g = x + change, trial.value, trial.gradient
            if (curvature := float(change @ turn)) > 1e-10 * float(change.norm() * turn.norm()):
                pairs.append((change, turn, curvature))
            left = evaluations - problem.evaluations
            if steps % BLOCK == 0 and left > BLOCK and problem.merit > (1 - PLATEAU) * before:
                return "plateau"
    except Enough as reason:
        return str(reason)
    raise AssertionError("unreachable")


def _inverse_hessian_times(g: Tensor, pairs: Sequence[tuple[Tensor, Tensor, float]]) -> Tensor:
    """The two loops: pairs are (change of x, change of the gradient, their product), oldest first."""
    q, shares = g.clone(), []
    for change, turn, curvature in reversed(pairs):
        shares.append(float(change @ q) / curvature)
        q -= shares[-1] * turn
    if pairs:
        _, turn, curvature = pairs[-1]
        q *= curvature / float(turn @ turn)
    for (change, turn, curvature), share in zip(pairs, reversed(shares), strict=True):
        q += (share - float(turn @ q) / curvature) * change
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
    return Trial(step, value, float(gradient @ way), gradient)


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
