"""Curves through exact points: cubics with the points and the derivatives of what they follow, halved until near."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.interpolate import BSpline

from bstcad.cad.loops import Piece
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.surfaces import Surface

COARSEST = 64  # parts of a piece, at least
FINEST, HALVINGS = 1 << 14, 4  # parts at most; or each of those to begin with halved so often
CLOSE = 1e-7  # of a piece: two breaks nearer than that are one
STEPS, ON = 50, 1e-13  # at most, to where a piece crosses a knot line, and mm from which on it does


def breaks(surface: Surface, *pieces: Piece) -> np.ndarray:
    """Parameters between which curves over pieces, all walked by the same one, follow one smooth part of a surface."""
    places = np.linspace(0.0, pieces[0].end, COARSEST + 1)
    if not math.isfinite(surface.detail):
        return places
    for piece in pieces:  # a net: smooth between its knot lines
        places = np.union1d(places, crossings(surface, piece, places))
    return thinned(places)


def crossings(surface: BSplineSurface, piece: Piece, places: np.ndarray) -> np.ndarray:
    """Parameters at which a piece crosses a knot line of a net, all at once: by Newton's method, else by bisection."""
    span = max(surface.m, COARSEST) * 8
    t = np.union1d(places, np.linspace(0.0, piece.end, span + 1))
    at, found = piece.points(t)[0], [np.empty(0)]
    for axis, ((first, _), pitch) in enumerate(zip((surface.x, surface.y), surface.pitch, strict=True)):
        cell = np.floor((at[:, axis] - first) / pitch - 0.5)  # knots stand at first + pitch (k + 1/2)
        crossed = np.flatnonzero(np.diff(cell) != 0)
        if not len(crossed):  # it runs along the lines
            continue
        line = first + pitch * (np.maximum(cell[crossed], cell[crossed + 1]) + 0.5)
        low, high = t[crossed], t[crossed + 1]
        rising = at[crossed, axis] < line
        middle = (low + high) / 2
        for _ in range(STEPS):
            places, along = (part[:, axis] for part in piece.points(middle))
            before = (places < line) == rising
            low, high = np.where(before, middle, low), np.where(before, high, middle)
            there = np.abs(places - line) <= ON
            if there.all():
                break
            guess = middle - (places - line) / np.where(along == 0, np.inf, along)
            inside = (guess > low) & (guess < high)
            middle = np.where(there, middle, np.where(inside, guess, (low + high) / 2))
        found.append(middle)
    return np.concatenate(found)


def thinned(t: np.ndarray) -> np.ndarray:
    """Ascending parameters without those that stand too near to the one before; both ends stay."""
    inner = t[1:-1]
    inner = inner[(np.diff(t)[:-1] > CLOSE * t[-1]) & (t[-1] - inner > CLOSE * t[-1])]
    return np.concatenate([t[:1], inner, t[-1:]])


def fitted(
    points: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], places: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(breaks, poles, full knots) of the cubic through points(t) with their derivatives, as near as the tolerance.

    It begins with the breaks `places`, and halves each part that is further off at its middle or quarters: the error
    of a smooth part falls with the fourth power of its length, down to rounding.
    """
    most, near = max(FINEST, len(places) << HALVINGS), tolerance / 2  # a part may be further off between these places
    while True:
        poles, full = hermite(places, *points(places))
        between = np.concatenate([places[:-1] + f * np.diff(places) for f in (0.25, 0.5, 0.75)])
        off = np.abs(BSpline(full, poles, 3)(between) - points(between)[0]).max(axis=1)
        if off.max() <= near:
            return places, poles, full
        if len(places) > most:
            raise ValueError(
                f"the rim bends too sharply for a curve of {len(places)} parts ({off.max():.1e} mm off); "
                "move the rim, round its corners, or give the lens fewer control points"
            )
        worst = np.unique(np.tile(np.arange(len(places) - 1), 3)[off > near])
        places = np.union1d(places, (places[worst] + places[worst + 1]) / 2)


def hermite(t: np.ndarray, point: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(poles, full knots) of the piecewise cubic with these points and derivatives at t."""
    third = np.diff(t)[:, None] / 3
    inner = np.stack([point[:-1] + third * slope[:-1], point[1:] - third * slope[1:]], axis=1)
    poles = np.concatenate([point[:1], inner.reshape(-1, point.shape[1]), point[-1:]])
    return poles, np.concatenate([t[[0, 0]], np.repeat(t, 2), t[[-1, -1]]])
