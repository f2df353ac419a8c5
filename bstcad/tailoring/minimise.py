"""Minimisers of one interface: a problem (value and gradient), a start, a method; the best state is kept.

A problem maps a list of parameter tensors to (merit, gradients, RRMSD); `BestSoFar` wraps it, so that the best state,
the count and the report stand once, whatever the method.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

Problem = Callable[[list[Tensor]], tuple[float, list[Tensor], float]]
Keep = Callable[[dict[str, Any]], None]


def forget(state: dict[str, Any]) -> None:
    """A `keep` that keeps nothing."""


class Enough(Exception):
    """Raised by a report to end a minimisation; its text says why."""


@dataclass
class BestSoFar:
    """Evaluates a problem and keeps the best parameters seen; a value that is not finite is counted, not used.

    What a minimiser needs to go on later from where it is (`state`) holds everything but the problem and the report.
    """

    problem: Problem
    report: Callable[[BestSoFar], None]  # called after each evaluation
    merit: float = math.inf
    rrmsd: float = math.nan  # of the best
    latest: float = math.nan  # RRMSD of the last evaluation
    parameters: list[Tensor] = field(default_factory=list)
    evaluations: int = 0
    skipped: int = 0

    KEPT = ("merit", "rrmsd", "latest", "parameters", "evaluations", "skipped")

    def state(self) -> dict[str, Any]:
        """What it has seen so far; not changed by what it sees later."""
        return {name: getattr(self, name) for name in self.KEPT}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from such a state."""
        for name in self.KEPT:
            setattr(self, name, state[name])

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


def adam(
    problem: BestSoFar,
    start: list[Tensor],
    rates: list[float],
    steps: int,
    keep: Keep = forget,
    found: dict[str, Any] | None = None,
) -> list[Tensor]:
    """Kingma and Ba 2014, one learning rate a parameter tensor; a step with a non-finite gradient is left out.

    The rates fall to zero as half a cosine: Adam's steps do not shrink with the gradient, and at a constant rate the
    control points go on jumping by as much as the rate.  Ends early when the problem's report has had Enough.

    `keep` is called between two steps with all that the next ones depend on; given as `found`, it goes on from there.
    Returns the last parameters: with fresh random rays in each step the best merit is only the luckiest draw.
    """
    parameters = [p.clone() for p in start]
    optimiser = torch.optim.Adam([{"params": [p], "lr": r} for p, r in zip(parameters, rates, strict=True)])
    first = 0
    if found is not None:
        first = found["step"]
        problem.restore(found["best"])
        for p, at, moments in zip(parameters, found["parameters"], found["moments"], strict=True):
            p.copy_(at)
            optimiser.state[p] |= {name: moment.to(_home(name, p), copy=True) for name, moment in moments.items()}
    for step in range(first, steps):
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = rate * (1 + math.cos(math.pi * step / steps)) / 2
        if step > first:
            keep(_adam_state(problem, step, parameters, optimiser))
        try:
            merit, gradients, _ = problem(parameters)
        except Enough:
            break
        if math.isfinite(merit):
            for p, g in zip(parameters, gradients, strict=True):
                p.grad = g
            optimiser.step()
    return parameters


def _home(name: str, p: Tensor) -> torch.device | str:
    """Adam counts its steps on the CPU and has its moments where the parameters are."""
    return "cpu" if name == "step" else p.device


def _adam_state(
    problem: BestSoFar, step: int, parameters: list[Tensor], optimiser: torch.optim.Optimizer
) -> dict[str, Any]:
    """Copies: the optimiser works in place."""
    moments = [{name: t.clone() for name, t in optimiser.state[p].items()} for p in parameters]
    return {"step": step, "best": problem.state(), "parameters": [p.clone() for p in parameters], "moments": moments}
