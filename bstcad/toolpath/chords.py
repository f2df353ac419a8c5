"""Straight moves that stay within a tolerance of an exact path, by subdivision at measured deviations.

A path is a height z(t) over a parameter t.  A move from t_k to t_(k+1) is a chord; its largest distance from a smooth
path is near its middle, and falls as the square of its length.  Chords beyond the tolerance are divided into
sqrt(deviation / tolerance) equal parts, and each part is measured again.  Points that lie on a straight line with their
neighbours are left out at the end.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numba import njit

MAX_POINTS = 20_000_000  # largest number of points of a path
MAX_ROUNDS = 12  # largest number of subdivisions, one after the other
MAX_PARTS = 64  # largest number of parts of a chord in one round
STRAIGHT = 0.1  # largest distance of a point that is left out from the straight move over it, in tolerances
# Deviation at the middle of an accepted chord, in tolerances: a kink beside it deviates by up to twice as much.
MARGIN = (1 - STRAIGHT) / 2

Height = Callable[[np.ndarray], np.ndarray]


def within_tolerance(t: np.ndarray, height: Height, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (t, z) of points between which z(t) deviates from the chords by at most `tolerance` (mm).

    t: increasing parameters from which the subdivision starts.  ValueError if the path has too many points.
    """
    refuse_many(len(t))
    z = height(t)
    begin, end = np.arange(len(t) - 1), np.arange(1, len(t))  # ends of the chords to measure, by index
    for _ in range(MAX_ROUNDS):
        middle = (t[begin] + t[end]) / 2
        off = np.abs(height(middle) - (z[begin] + z[end]) / 2) / (MARGIN * tolerance)
        parts = np.clip(np.ceil(np.sqrt(off)), 1, MAX_PARTS).astype(np.int64)
        divided = parts > 1
        if not divided.any():
            break
        begin, end, parts = begin[divided], end[divided], parts[divided]
        refuse_many(len(t) + int((parts - 1).sum()))
        which = np.repeat(np.arange(len(parts)), parts - 1)
        step = np.arange(len(which)) - np.repeat(np.cumsum(parts - 1) - (parts - 1), parts - 1) + 1
        new_t = t[begin[which]] + (t[end[which]] - t[begin[which]]) * step / parts[which]
        new = len(t) + np.arange(len(new_t))
        t, z = np.concatenate([t, new_t]), np.concatenate([z, height(new_t)])
        starts, stops = (np.empty(int(parts.sum()), np.int64) for _ in range(2))
        first = np.cumsum(parts) - parts
        inner = np.ones(len(starts), bool)
        inner[first] = False
        starts[first], starts[inner] = begin, new
        inner[first], inner[first + parts - 1] = True, False
        stops[first + parts - 1], stops[inner] = end, new
        begin, end = starts, stops
    order = np.argsort(t, kind="stable")
    return t[order], z[order]


@njit(cache=True, nogil=True, error_model="numpy")
def bends(t, z, corner, height):  # type: ignore[no-untyped-def]  # a compiled function
    """Return True for the points of a path z(t) (mm) that straight moves need to pass all others within a height (mm).

    corner: True for points that are needed in any case.  The moves from an anchor whose slopes lie in [low, high] pass
    all points since the anchor; a point outside this cone makes the point before it the next anchor.
    """
    needed = np.zeros(len(t), np.bool_)
    needed[0] = needed[-1] = True
    anchor, low, high = 0, -math.inf, math.inf
    for k in range(1, len(t)):
        slope = (z[k] - z[anchor]) / (t[k] - t[anchor])
        if not low <= slope <= high or (corner[k - 1] and k - 1 > anchor):
            anchor, low, high = k - 1, -math.inf, math.inf
            needed[anchor] = True
            slope = (z[k] - z[anchor]) / (t[k] - t[anchor])
        width = height / (t[k] - t[anchor])
        low, high = max(low, slope - width), min(high, slope + width)
    return needed


def refuse_many(count: float) -> None:
    """Raise ValueError if a path would have more than MAX_POINTS points."""
    if count > MAX_POINTS:
        many = f"the path would have more than {MAX_POINTS / 1e6:g} million points"
        raise ValueError(f"{many}; give a larger cusp, pitch or tolerance")


def along_polyline(corners: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (t, corner parameters) of a polyline (n, 2) in mm: all corners, and places at most `spacing` mm apart.

    t is the length (mm) along the polyline.
    """
    lengths = np.hypot(*np.diff(corners, axis=0).T)
    refuse_many(len(corners) + float(lengths.sum()) / spacing)
    parts = np.maximum(np.ceil(lengths / spacing), 1).astype(np.int64)
    at = np.append(0.0, np.cumsum(lengths))
    which = np.repeat(np.arange(len(parts)), parts)
    step = np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.append(at[which] + lengths[which] * step / parts[which], at[-1]), at


def digits(tolerance: float) -> int:
    """Return the number of decimals (mm) whose rounding is at most a fifth of a tolerance (mm)."""
    return max(3, math.ceil(-math.log10(2 * tolerance / 5)))
