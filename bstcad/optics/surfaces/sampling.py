"""Sample points of rays and sources: grids, stratified (jittered) points and random points of a rectangle.

Functions of a rectangle `window`, centred on the axis, return (x, y) in mm; every point represents the same area.
`point_pairs` and `shifted_lattice` return points of equal weight over the outline of an extended source, and
`sample_rim` points along an outline.

The jitter of a cell is a hash of its number, SplitMix64 (Steele, Lea and Flood 2014), instead of the next number of a
sequence, so that every thread obtains the same points.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.numerics.reductions import elementary
from bstcad.optics.surfaces.outlines import Outline, Rectangle
from bstcad.optics.surfaces.sides import Sides, as_pair

POINTS_PER_STRIP = 1 << 18  # approximate number of points in a strip of rows
SPLITMIX_INCREMENT = 0x9E3779B97F4A7C15  # increment of SplitMix64: 2^64 divided by the golden ratio
MIX_1, MIX_2 = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB  # multipliers of the finaliser of SplitMix64
# Step φ of a golden lattice, 1/g with g² = g + 1; shift from one lattice (`number`) to the next, 1/g with g³ = g + 1.
GOLDEN_RATIO, LATTICE_SHIFT = 0.6180339887498949, 0.7548776662466927


def grid(window: Rectangle, sides: Sides, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Return x and y (mm), each (n_x, n_y), of the centres of equal cells; sides: (n_x, n_y) or one number for both."""
    along_x, along_y = ((torch.arange(n, dtype=dtype) + 0.5) / n - 0.5 for n in as_pair(sides))
    x, y = torch.meshgrid(along_x * window.width, along_y * window.height, indexing="ij")
    return x.contiguous(), y.contiguous()


def stratified_strips(
    window: Rectangle, n: int, seed: int, dtype: torch.dtype = torch.float64
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield x and y (mm) of a random point in each of n x n equal cells, in strips of rows that fit the cache."""
    rows = max(1, POINTS_PER_STRIP // n)
    for first in range(0, n, rows):
        i = np.arange(first, min(first + rows, n))[:, None]
        j = np.arange(n)
        jitter_x, jitter_y = jitter(hash_seed(seed), i * n + j)
        x = (jitter_x + i) * (window.width / n) - window.width / 2
        y = (jitter_y + j) * (window.height / n) - window.height / 2
        yield torch.from_numpy(x).to(dtype), torch.from_numpy(y).to(dtype)


def hash_seed(seed: int) -> int:
    """Return a 64-bit hash of the seed; hashes of neighbouring seeds are independent."""
    return int(_mix(np.array([(seed + SPLITMIX_INCREMENT) % (1 << 64)], dtype=np.uint64))[0])


def jitter(key: int, cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two numbers in (0, 1) per cell number, from the two 32-bit halves of SplitMix64; key: hashed seed."""
    bits = _mix(np.uint64(key) + cell.astype(np.uint64) * np.uint64(SPLITMIX_INCREMENT))
    upper, lower = ((half + 0.5) * 2.0**-32 for half in (bits >> np.uint64(32), bits & np.uint64(0xFFFFFFFF)))
    return upper, lower


def _mix(z: np.ndarray) -> np.ndarray:
    """Apply the finaliser of SplitMix64: every bit of z changes each bit of the result with probability 1/2."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(MIX_1)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(MIX_2)
    return z ^ (z >> np.uint64(31))


def random(window: Rectangle, count: int, seed: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Return x and y (mm), (count,) each, of `count` independent uniform points."""
    points = torch.rand((2, count), generator=torch.Generator().manual_seed(seed), dtype=dtype) - 0.5
    return points[0] * window.width, points[1] * window.height


def point_pairs(outline: Outline, pairs: int, number: int = 0) -> list[tuple[float, float]]:
    """Return points (x, y) spread over an outline, each followed by its reflection in the centre: their mean is 0.

    A golden lattice, a = (k + 1/2) / pairs and b = (k φ + shift) mod 1 for k = 0, 1, … (φ: GOLDEN_RATIO), covers one
    half: (a, 2 b - 1) of a rectangle, r² = a and ψ = π b (a sunflower spiral) of a disc, in half extents.  `number`
    determines the shift.  For two or more pairs the second moments are set to those of the outline, so that a point may
    lie outside a rectangle by hundredths of its size.  32 points of a disc have 2/3 of the noise of 128 random ones at
    a hard edge of a picture, 1/5 at a soft one.
    """
    half_x, half_y = outline.half_extent
    lattice = [((k + 0.5) / pairs, (0.5 + number * LATTICE_SHIFT + k * GOLDEN_RATIO) % 1.0) for k in range(pairs)]
    if outline.is_round:
        points = [(math.sqrt(a) * math.cos(math.pi * b), math.sqrt(a) * math.sin(math.pi * b)) for a, b in lattice]
        points = _with_second_moment(points, 1 / 4)
    else:
        points = _with_second_moment([(a, 2 * b - 1) for a, b in lattice], 1 / 3)
    return [(sign * half_x * x, sign * half_y * y) for x, y in points for sign in (1, -1)]


def shifted_lattice(outline: Outline, count: int, seed: int) -> list[tuple[float, float]]:
    """Return points (x, y) over an outline; over all seeds each is uniformly distributed, so that means are unbiased.

    A golden lattice of `count` points, a = k / count and b = k φ (φ: GOLDEN_RATIO), shifted by two random numbers
    modulo 1 (Cranley and Patterson 1976); in half extents (2 a - 1, 2 b - 1), on a disc r² = a and ψ = 2 π b.
    """
    (move_a,), (move_b,) = jitter(hash_seed(seed), np.zeros(1, np.int64))
    half_x, half_y = outline.half_extent
    lattice = [((k / count + move_a) % 1.0, (k * GOLDEN_RATIO + move_b) % 1.0) for k in range(count)]
    if outline.is_round:
        polar = ((math.sqrt(a), 2 * math.pi * b) for a, b in lattice)
        return [(half_x * r * math.cos(turn), half_y * r * math.sin(turn)) for r, turn in polar]
    return [(half_x * (2 * a - 1), half_y * (2 * b - 1)) for a, b in lattice]


def _with_second_moment(points: list[tuple[float, float]], moment: float) -> list[tuple[float, float]]:
    """Return the points sheared and scaled to mean x² = mean y² = moment and mean x y = 0."""
    n = len(points)
    if n < 2:
        return points
    xx, xy, yy = (math.fsum(p[i] * p[j] for p in points) / n for i, j in ((0, 0), (0, 1), (1, 1)))
    shear = xy / xx
    scale_x, scale_y = math.sqrt(moment / xx), math.sqrt(moment / (yy - shear * xy))
    return [(scale_x * x, scale_y * (y - shear * x)) for x, y in points]


def sample_rim(outline: Outline, n: int) -> tuple[Tensor, Tensor]:
    """Return x and y (mm) of 4 n points along the rim; the last equals the first."""
    turn = torch.linspace(0, 2 * torch.pi, 4 * n, dtype=torch.float64)
    c, s = elementary(torch.cos, turn), elementary(torch.sin, turn)
    a, b = outline.half_extent
    if not outline.is_round:  # project the circle onto the square
        reach = torch.maximum(c.abs(), s.abs())
        c, s = c / reach, s / reach
    x, y = a * c, b * s
    a, b, r2 = outline.limits
    if not outline.is_round and r2:  # project the corners onto their arcs
        p, q = (x.abs() - a).clamp(min=0), (y.abs() - b).clamp(min=0)
        d = torch.hypot(p, q)
        shift = torch.where((p > 0) & (q > 0), 1 - math.sqrt(r2) / d.clamp(min=1e-300), torch.zeros_like(d))
        x, y = x - x.sign() * p * shift, y - y.sign() * q * shift
    return x, y
