"""Monte Carlo study of a lens with errors: sensitivities, trials, yield, loosest tolerances, gain by adjustment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq, minimize
from scipy.stats import binomtest

from bstcad.report.tolerances import WIDEST
from bstcad.tolerance.perturbations import Perturbation, draws, trials
from bstcad.tolerance.superposition import Model, Pictures, Spread, here, model

LINEAR, FULL = 10_000, 200  # trials by the model, and of them by full traces
WORST = 5  # trials that are shown
ADJUSTED = {f"screen.{way}" for way in ("decentre_x", "decentre_y", "axial", "tilt_x", "tilt_y", "clocking")}
REACH = 8.0  # standard deviations over which the screen can be adjusted
NEARBY = 1e-4  # standard deviations: step of the difference quotients
OTHER = 7919  # added to the seed, for independent trials
Progress = Callable[[str, int, int, str], None]


@dataclass(frozen=True)
class Sensitivity:
    """Effect of one error alone."""

    perturbation: Perturbation
    rrmsd_change: float  # by one standard deviation, mean of both signs
    share: float  # of the mean square that all errors add to the picture


@dataclass(frozen=True)
class Yield:
    """Share of the trials within a limit, with the 95 % interval of Wilson."""

    low: float
    likely: float
    high: float


@dataclass(frozen=True, eq=False)
class Study:
    """Result of a Monte Carlo of a setup."""

    perturbations: tuple[Perturbation, ...]
    model: Model
    sensitivities: tuple[Sensitivity, ...]  # the worst first
    limit: float  # RRMSD
    seed: int
    rrmsd: float  # of the setup as designed
    linear: np.ndarray  # (trials,) RRMSD of all trials by the model
    full: np.ndarray  # (fewer,) RRMSD of the first trials by full traces
    adjusted: np.ndarray  # (fewer,) of the same by the model, with the screen adjusted

    @property
    def passed(self) -> Yield:
        """By the model, all trials."""
        return yield_of(self.linear, self.limit)

    @property
    def passed_full(self) -> Yield:
        """By full traces."""
        return yield_of(self.full, self.limit)

    @property
    def passed_adjusted(self) -> Yield:
        """With the screen adjusted."""
        return yield_of(self.adjusted, self.limit)

    @property
    def disagreement(self) -> np.ndarray:
        """(fewer,) relative difference of the model from the full traces."""
        return np.abs(self.linear[: len(self.full)] / self.full - 1)

    @property
    def worst(self) -> list[int]:
        """Numbers of the worst fully traced trials."""
        return np.argsort(self.full)[::-1][:WORST].tolist()


def study(
    pictures: Pictures, limit: float, seed: int, rrmsd: float, *, linear: int = LINEAR, full: int = FULL,
    progress: Progress = lambda stage, done, of, text: None, spread: Spread = here,
) -> Study:  # fmt: skip
    """Sensitivities and trials.  spread: where pictures are traced.

    rrmsd: of the design, by independent rays.  Tubes have an error, the same in every trial: its square is taken off
    each RRMSD², so that the trials compare with the design's own figure.
    """
    found = model(pictures, lambda done, of: progress("sensitivity", done, of, ""), spread)
    off = found.rrmsd**2 - rrmsd**2
    perturbations = pictures.perturbations
    amounts = trials(perturbations, seed, linear)
    by_model = _less(found.rrmsds(amounts), off)
    traced = []
    for k, rrmsd_of_it in enumerate(spread(Pictures.rrmsd, pictures, amounts[:full]), 1):
        traced.append(rrmsd_of_it)
        progress("trials", k, min(full, linear), f"RRMSD {rrmsd_of_it:.4f}")
    adjusted = [adjust(found, perturbations, amounts[k])[1] for k in range(len(traced))]
    return Study(
        perturbations, found, _sensitivities(found, perturbations, off), limit=limit, seed=seed, rrmsd=rrmsd,
        linear=by_model, full=_less(np.array(traced), off), adjusted=_less(np.array(adjusted), off),
    )  # fmt: skip


def _less(rrmsds: np.ndarray, off: float) -> np.ndarray:
    return np.sqrt(np.maximum(rrmsds**2 - off, 0.0))


def yield_of(rrmsds: np.ndarray, limit: float) -> Yield:
    """Share of the trials within the limit."""
    good = int((rrmsds <= limit).sum())
    interval = binomtest(good, len(rrmsds)).proportion_ci(method="wilson")
    return Yield(float(interval.low), good / len(rrmsds), float(interval.high))


def _sensitivities(found: Model, perturbations: Sequence[Perturbation], off: float) -> tuple[Sensitivity, ...]:
    sigmas = np.diag(found.sigmas)
    either = (_less(found.rrmsds(sigmas), off) + _less(found.rrmsds(-sigmas), off)) / 2
    added = np.sum(found.first**2, axis=1)
    nominal = float(_less(np.array([found.rrmsd]), off)[0])
    each = [
        Sensitivity(p, float(r) - nominal, float(a / added.sum()))
        for p, r, a in zip(perturbations, either, added, strict=True)
    ]
    return tuple(sorted(each, key=lambda s: s.rrmsd_change, reverse=True))


def adjust(found: Model, perturbations: Sequence[Perturbation], amounts: np.ndarray) -> tuple[np.ndarray, float]:
    """(amounts with the screen at the least RRMSD, that RRMSD), by the model: shift, focus, tilt and clocking."""
    free = [k for k, p in enumerate(perturbations) if p.kind.name in ADJUSTED]
    if not free:
        return amounts, float(found.rrmsds(amounts))

    def moved(steps: np.ndarray) -> np.ndarray:
        tried = np.broadcast_to(amounts, (*steps.shape[:-1], len(amounts))).copy()
        tried[..., free] += steps * found.sigmas[free]
        return tried

    nearby = np.concatenate([np.zeros((1, len(free))), NEARBY * np.eye(len(free)), -NEARBY * np.eye(len(free))])

    def square_and_gradient(steps: np.ndarray) -> tuple[float, np.ndarray]:
        here, up, down = np.split(found.rrmsds(moved(steps + nearby)) ** 2, [1, 1 + len(free)])
        return float(here[0]), (up - down) / (2 * NEARBY)

    best = minimize(
        square_and_gradient, np.zeros(len(free)), jac=True, bounds=[(-REACH, REACH)] * len(free), method="L-BFGS-B"
    )
    return moved(best.x), float(found.rrmsds(moved(best.x)))


def loosest(found: Study, wanted: float) -> tuple[tuple[Perturbation, ...], Yield]:
    """The loosest tolerances that keep a yield (0 … 1), and their yield by independent trials.

    Holding error i at u_i times its limit costs c_i / u_i and adds q_i u_i² to the mean square of the picture.  The
    least cost for a given sum of the latter is at u_i ∝ (c_i / q_i)^(1/3); one factor on all then brings the yield, by
    the model.
    """
    perturbations = found.perturbations
    added = np.maximum(np.sum(found.model.first**2, axis=1), 1e-30)
    costs = np.array([p.cost for p in perturbations])
    shape = np.cbrt(costs / added)
    shape /= np.exp(np.mean(np.log(shape)))
    off = found.model.rrmsd**2 - found.rrmsd**2
    even = np.random.default_rng((found.seed, OTHER)).random((LINEAR, len(perturbations)))
    unit = draws(perturbations, even)

    def share(log_factor: float) -> float:
        widths = np.minimum(np.exp(log_factor) * shape, WIDEST)
        return float(np.mean(_less(found.model.rrmsds(unit * widths), off) <= found.limit)) - wanted

    log_factor = 10.0 if share(10.0) >= 0 else brentq(share, -10.0, 10.0, xtol=1e-4)
    widths = np.minimum(np.exp(log_factor) * shape, WIDEST)
    loose = tuple(replace(p, limit=float(p.limit * w)) for p, w in zip(perturbations, widths, strict=True))
    fresh = trials(loose, found.seed + OTHER, LINEAR)
    return loose, yield_of(_less(found.model.rrmsds(fresh), off), found.limit)
