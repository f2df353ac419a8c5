"""Minimisers of one interface: a problem (value and gradient), a start, a method; the best state is kept.

A problem maps a list of parameter tensors to (merit, gradients, RRMSD); `BestSoFar` wraps it, so that the best state,
the count and the report stand once, whatever the method.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

MEMORY = 12  # steps that L-BFGS remembers
BLOCK = 10  # of its steps, after which it is asked whether it still gains
PLATEAU = 0.005  # of the merit; less in a block is not worth its time

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
    """Limited-memory BFGS with a strong Wolfe line search (Nocedal and Wright, algorithms 7.5 and 3.5).

    Ends after so many evaluations, or on a plateau: BLOCK steps that gained less than PLATEAU of the merit; or when the
    problem's report has had Enough.  Returns why: "evaluations", "plateau", or what the report said.
    """
    parameters = [p.clone() for p in start]
    optimiser = torch.optim.LBFGS(
        parameters, history_size=MEMORY, line_search_fn="strong_wolfe", tolerance_grad=0.0, tolerance_change=0.0
    )

    def closure() -> Tensor:
        merit, gradients, _ = problem(parameters)
        for p, g in zip(parameters, gradients, strict=True):
            p.grad = g
        return torch.tensor(merit, dtype=torch.float64)

    while (left := evaluations - problem.evaluations) > 0:
        before = problem.merit
        optimiser.param_groups[0].update(max_iter=BLOCK, max_eval=left)
        try:
            optimiser.step(closure)
        except Enough as reason:
            return str(reason)
        if left > BLOCK and problem.merit > (1 - PLATEAU) * before:
            return "plateau"
    return "evaluations"
