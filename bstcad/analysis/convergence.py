"""What the end of a convergence curve cost: the time that the last of the error took, and what half of it would take.

Near its end a curve is taken for a power law, RRMSD ∝ t^-p, t the time of all evaluations: so half of the error takes
2^(1/p) times as long in all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

LAST = 1.1  # times the RRMSD at the end: from there on it is "the last tenth of the error"
LATELY = 0.5  # of the time that the irradiance has been tailored for: so far back the power law is fitted
FEW = 5  # points: of fewer nothing is said of a power
GOOD = 0.9  # R² of a line in logarithms that is one
PAYS = 10.0  # times the time: half of the error for more than that is no offer

Curve = Sequence[tuple[float, float]]  # (seconds since the start, RRMSD)
Parts = Sequence[tuple[float, float | None]]  # of the work, one after the other: (seconds, RRMSD after it if judged)


@dataclass(frozen=True)
class Ending:
    """The end of a convergence curve; RRMSD by the rays or tubes that tailor, as it is known at each evaluation."""

    rrmsd: float  # at the end
    last_tenth_seconds: float  # since it was above 1.1 times that for the last time
    last_tenth: float  # the same as a part of the time from the start to the end of the curve
    power: float | None  # p of RRMSD ∝ t^-p at the end, zero if it does not fall; None: too few points to say
    fit: float | None  # R² of that line, of logarithms
    halving: float | None  # 2^(1/p), how many times the time; None: no line fits, or it is more than PAYS times

    @property
    def doubled(self) -> float:
        """RRMSD after twice the time over what it is, by the power law; 1 if there is none."""
        return 2 ** -(self.power or 0.0)


def ending(history: Curve, parts: Parts, since: float = 0.0) -> Ending | None:
    """Of a design's history; None if the irradiance was never tailored.

    parts: the stages, whose judgements are in the history too, by other tubes than those of the points around them.
    since: seconds since the start from which on the light was what it is at the end, if that was another before.
    """
    ends = np.cumsum([seconds for seconds, _ in parts])
    judged = {value for _, value in parts if value is not None}
    points = np.array([point for point in history if point[1] not in judged], dtype=float).reshape(-1, 2)
    if not len(points):
        return None
    seconds, values = points.T
    last = float(np.median(values[-max(1, len(values) // 20) :]))  # where each evaluation has rays of its own, of a few
    above = np.flatnonzero(values > LAST * last)
    took = float(seconds[-1] - (seconds[above[-1]] if len(above) else 0.0))
    power, fit = _power(*_lately(seconds, values, ends, since))
    halving = None
    if power and fit is not None and fit >= GOOD and power * np.log2(PAYS) >= 1:
        halving = 2 ** (1 / power)
    return Ending(last, took, took / float(seconds[-1]), power, fit, halving)


def _lately(seconds: np.ndarray, values: np.ndarray, ends: np.ndarray, since: float) -> tuple[np.ndarray, np.ndarray]:
    """(time, values) of the last points, since tailoring began and within the part that the last of them is in.

    Each evaluation of a part counts as long as the median one, whatever else the machine did meanwhile.
    """
    part = np.searchsorted(ends, seconds)
    steps = np.zeros(len(seconds))
    for each in np.unique(part):
        there = part == each
        own = np.diff(seconds[there])
        before = ends[each - 1] if each else 0.0
        steps[there] = np.median(own) if len(own) else seconds[there][0] - before
    time = np.cumsum(np.where(seconds > since, steps, 0.0))
    chosen = (time >= (1 - LATELY) * time[-1]) & (part == part[-1]) & (time > 0)
    return time[chosen], values[chosen]


def _power(time: np.ndarray, values: np.ndarray) -> tuple[float | None, float | None]:
    """(p, R²) of values ∝ time^-p by least squares of the logarithms."""
    if len(time) < FEW:
        return None, None
    x, y = np.log(time), np.log(values)
    x, y = x - x.mean(), y - y.mean()
    slope, spread = (x * y).sum() / (x * x).sum(), (y * y).sum()
    return max(0.0, float(-slope)), float(slope**2 * (x * x).sum() / spread) if spread > 0 else 0.0
