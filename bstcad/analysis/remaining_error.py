"""Where the error of a picture sits: in its dark and bright parts, at its edges, along the rim; and how fine it is.

Every pixel belongs to one part: to the rim of the target first, else to the edges of the picture, else to its darkest
or brightest pixels, else to the rest.  How fine the error is says its cosine transform, which is no periodic one and so
makes nothing of opposite sides that differ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

RIM = 64  # one part in so many of a side of the target is its rim, at each end
STEEP = 0.9  # quantile of the gradient from which on a pixel lies at an edge …
SLIGHT = 0.02  # … if the gradient is more than this part of the brightest pixel's irradiance, by pixel
TENTH = 0.1  # quantile of the irradiance up to which, and from whose counterpart on, a pixel is dark or bright


@dataclass(frozen=True)
class Part:
    """A part of the target."""

    name: str  # "rim", "edges", "darkest", "brightest" or "rest"
    error: float  # part of the squared error, all parts together 1
    pixels: float  # part of the target's pixels


@dataclass(frozen=True)
class Octave:
    """Waves whose periods lie within a factor of two."""

    frequency: tuple[float, float]  # cycles a pixel, from and below; the finest goes on to 0.71, along the diagonals
    period: tuple[float, float]  # mm on the target, the coarse end first
    error: float  # part of the squared error, all octaves together 1


@dataclass(frozen=True)
class Remaining:
    """Where the error sits."""

    parts: tuple[Part, ...]
    octaves: tuple[Octave, ...]  # from coarse to fine; what is even all over is in none, as both pictures have one sum


def remaining(picture: np.ndarray, target: np.ndarray, per_mm: tuple[float, float]) -> Remaining:
    """Of a picture (rows, columns) held to a target of the same sum; per_mm: pixels along columns and rows."""
    square = (picture - target) ** 2
    return Remaining(_parts(square, target), _octaves(picture - target, math.sqrt(math.prod(per_mm))))


def places(target: np.ndarray) -> dict[str, np.ndarray]:
    """Which pixels (rows, columns) are of which part: each of one.

    rim: the outermost 1/64 of the side, one pixel at least, at all four sides.  edges: the tenth of all pixels in which
    the target changes most from pixel to pixel (central differences), if it changes by 2 % of its brightest pixel.
    darkest and brightest: the tenth of all pixels, and what is as dark or as bright as the last of them.
    """
    left = np.ones(target.shape, dtype=bool)
    rim, steep = ~left, np.hypot(*(_slope(target, axis) for axis in (0, 1)))
    for axis, side in enumerate(target.shape):
        along = np.arange(side)
        width = max(1, round(side / RIM))
        rim |= np.expand_dims((along < width) | (along >= side - width), 1 - axis)
    dark, bright = np.quantile(target, (TENTH, 1 - TENTH))
    lit = target > dark  # of an even target nothing is, and nothing is dark or bright
    found = {}
    for name, where in (
        ("rim", rim),
        ("edges", steep >= max(np.quantile(steep, STEEP), SLIGHT * target.max())),
        ("darkest", ~lit & lit.any()),
        ("brightest", (target >= bright) & lit),
        ("rest", left),
    ):
        found[name] = where & left
        left = left & ~where
    return found


def _slope(target: np.ndarray, axis: int) -> np.ndarray:
    """Of the target along an axis, by pixel; zero where there is one pixel only."""
    return np.gradient(target, axis=axis) if target.shape[axis] > 1 else np.zeros(target.shape)


def _parts(square: np.ndarray, target: np.ndarray) -> tuple[Part, ...]:
    whole = float(square.sum()) or 1.0
    return tuple(
        Part(name, float(square[where].sum()) / whole, float(where.mean())) for name, where in places(target).items()
    )


def _octaves(error: np.ndarray, per_mm: float) -> tuple[Octave, ...]:
    """Energy of the cosine transform (orthonormal: Parseval) by the length of the wave vector, in cycles a pixel."""
    from scipy.fft import dctn

    energy = dctn(error, norm="ortho") ** 2
    along = (np.arange(side) / (2 * side) for side in error.shape)
    frequency = np.hypot(*np.meshgrid(*along, indexing="ij"))
    energy[0, 0] = 0.0  # rounding: both have one sum
    count = max(1, math.ceil(math.log2(max(error.shape))))  # down to half a wave over the longer side
    number = np.clip(np.floor(np.log2(np.maximum(frequency, 1e-9) * 4)), 1 - count, 0).astype(int)
    whole = float(energy.sum()) or 1.0
    sums = np.bincount((number + count - 1).ravel(), energy.ravel(), count) / whole
    ends = [(0.25 * 2.0**k, 0.5 * 2.0**k) for k in range(1 - count, 1)]
    return tuple(
        Octave(end, (1 / (end[0] * per_mm), 1 / (end[1] * per_mm)), float(part))
        for end, part in zip(ends, sums, strict=True)
    )
