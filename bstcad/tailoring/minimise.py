"""Minimisers: a method asks for values and is told them, so that whoever tells may as well stop.

A problem maps a list of parameter tensors to (merit, gradients, RRMSD).  A method (`adam` here, lbfgs.py) is a
generator that yields where it wants to know the merit (`Ask`) and is sent it (`Told`).  `minimise` brings the two
together and says after each evaluation where the minimisation stands; nothing has to be done to end it there.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

Problem = Callable[[list[Tensor]], tuple[float, list[Tensor], float]]


@dataclass(frozen=True)
class Best:
    """The best of what has been evaluated."""

    merit: float = math.inf
    rrmsd: float = math.nan
    latest: float = math.nan  # RRMSD of the last evaluation
    parameters: tuple[Tensor, ...] = ()  # none while not one value was finite
    evaluations: int = 0
    skipped: int = 0  # of them, because merit or gradient was not finite


@dataclass(frozen=True)
class Ask:
    """Where a method wants to know the merit."""

    parameters: list[Tensor]
    state: Any = None  # with which the method would ask this again, and go on as now; None: not from here


@dataclass(frozen=True)
class Told:
    """What it is told of that."""

    merit: float  # infinite, and the gradients zero, if one of them was not finite
    gradients: list[Tensor]
    best: Best  # this evaluation included


Method = Generator[Ask, Told, str]  # returns why it has nothing more to ask


@dataclass(frozen=True)
class Reached:
    """Where a minimisation stands after an evaluation."""

    best: Best
    parameters: list[Tensor] | None  # where the method would go next
    state: Any = None  # with which, and with `best`, the method goes on from here; None: it cannot be left here
    skipped: bool = False  # was this evaluation of no use?
    reason: str = ""  # why it ends here, if it does: "evaluations", or what the method says


def minimise(problem: Problem, method: Method, evaluations: int, best: Best = Best()) -> Iterator[Reached]:
    """Tells the method what it asks until it has no more to ask or so many evaluations are spent.

    A value that is not finite is counted, not used.  `best`: of the evaluations before the method's state.
    """
    if best.evaluations >= evaluations:
        return
    ask, reason = next(method), ""
    while not reason:
        merit, gradients, rrmsd = problem(ask.parameters)
        skipped = best.skipped
        if not math.isfinite(merit) or not all(bool(torch.isfinite(g).all()) for g in gradients):
            merit, gradients, skipped = math.inf, [torch.zeros_like(p) for p in ask.parameters], skipped + 1
        lowest, at, seen = best.merit, best.parameters, best.rrmsd
        if merit < lowest:
            lowest, at, seen = merit, tuple(p.detach().clone() for p in ask.parameters), rrmsd
        useless, best = skipped > best.skipped, Best(lowest, seen, rrmsd, at, best.evaluations + 1, skipped)
        try:
            ask, reason = method.send(Told(merit, gradients, best)), ""
        except StopIteration as end:
            yield Reached(best, None, None, useless, end.value)
            return
        if best.evaluations >= evaluations:
            reason = "evaluations"
        yield Reached(best, ask.parameters, None if reason else ask.state, useless, reason)


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
    constant rate the control points go on jumping by as much as the rate.  Asks for ever; what it asks after the last
    evaluation is the result: with fresh random rays in each step the best merit is only the luckiest draw.
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
        state = _adam_state(step, parameters, optimiser)
        told = yield Ask(list(state.parameters), state)
        if math.isfinite(told.merit):
            for p, g in zip(parameters, told.gradients, strict=True):
                p.grad = g
            optimiser.step()


def _adam_state(step: int, parameters: list[Tensor], optimiser: torch.optim.Optimizer) -> AdamState:
    """Copies: the optimiser works in place."""
    moments = [optimiser.state[p] for p in parameters if optimiser.state[p]]
    return AdamState(
        step,
        int(moments[0]["step"]) if moments else 0,
        tuple(p.clone() for p in parameters),
        tuple(m["exp_avg"].clone() for m in moments),
        tuple(m["exp_avg_sq"].clone() for m in moments),
    )
