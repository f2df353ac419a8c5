"""How far each thing may be off: a kind with its limit and distribution, and trials drawn from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.stats import norm

from bstcad.tolerance.kinds import Kind
from bstcad.tolerance.setup import Setup

SIGMAS = 2.0  # a normal distribution ends at its limit, which is so many of its standard deviations before the cut


@dataclass(frozen=True)
class Perturbation:
    """One kind of error and how it is distributed about nominal."""

    kind: Kind
    limit: float  # ± (unit of the kind); of a random field the RMS that it has on average
    distribution: Literal["normal", "uniform", "field"] = "normal"
    cost: float = 1.0  # of holding it, as against the others, at the same limit

    @property
    def sigma(self) -> float:
        """Its standard deviation."""
        return self.limit * float(spread(self.distribution))

    def scaled(self, limit: float) -> Perturbation:
        """The same with another limit."""
        return replace(self, limit=limit)


def spread(distribution: str) -> float:
    """Standard deviation over limit.

    normal: cut at its limit, L = a s with a = 2: σ² = s² (1 - 2 a φ(a) / (2 Φ(a) - 1)); field: one of the modes that a
    random field is mixed of, normal and not cut.
    """
    if distribution == "uniform":
        return 1 / math.sqrt(3)
    if distribution == "field":
        return 1.0
    cut = 1 - 2 * SIGMAS * norm.pdf(SIGMAS) / (2 * norm.cdf(SIGMAS) - 1)
    return math.sqrt(cut) / SIGMAS


def trial(perturbations: Sequence[Perturbation], seed: int, number: int) -> np.ndarray:
    """The amounts (n,) of one trial, in the kinds' units; the same for the same seed and number, whatever else is."""
    return draws(perturbations, np.random.default_rng((seed, number)).random(len(perturbations)))


def trials(perturbations: Sequence[Perturbation], seed: int, count: int) -> np.ndarray:
    """The amounts (count, n) of trials 0 … count - 1."""
    even = np.stack([np.random.default_rng((seed, k)).random(len(perturbations)) for k in range(count)])
    return draws(perturbations, even)


def draws(perturbations: Sequence[Perturbation], even: np.ndarray) -> np.ndarray:
    """Amounts from numbers that are even in [0, 1), by the inverse of each distribution; (…, n) both."""
    found = np.empty_like(even)
    low = norm.cdf(-SIGMAS)
    for k, perturbation in enumerate(perturbations):
        p = even[..., k]
        if perturbation.distribution == "uniform":
            unit = 2 * p - 1
        elif perturbation.distribution == "field":
            unit = norm.ppf(np.clip(p, 1e-12, None))
        else:
            unit = norm.ppf(low + p * (1 - 2 * low)) / SIGMAS
        found[..., k] = perturbation.limit * unit
    return found


def perturbed(setup: Setup, perturbations: Sequence[Perturbation], amounts: Sequence[float]) -> Setup:
    """The setup as it comes out with these amounts, in the order of the perturbations; shapes before motions."""
    pairs = [(p.kind, float(a)) for p, a in zip(perturbations, amounts, strict=True) if a]
    for kind, amount in sorted(pairs, key=lambda pair: _moves(pair[0])):
        setup = kind.apply(setup, amount)
    return setup


def _moves(kind: Kind) -> bool:
    return kind.name.startswith(("lens.decentre", "lens.tilt", "lens.axial", "lens.clocking", "source.", "screen."))
