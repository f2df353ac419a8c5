"""Numbers along the two sides of a rectangle: control points of a net, cells of a grid, flux tubes of a sheet.

A single number applies to both sides; a pair is (along x, along y).
"""

from __future__ import annotations

import math

Sides = int | tuple[int, int]  # number for the two sides, or (along x, along y)
MIN_SIDE = 5  # minimum control points per side of a net: two end spans and one inner span


def as_pair(sides: Sides) -> tuple[int, int]:
    """Return the pair (along x, along y)."""
    return (sides, sides) if isinstance(sides, int) else sides


def simplified(sides: Sides) -> Sides:
    """Return one number if the numbers are equal, else the pair."""
    x, y = as_pair(sides)
    return x if x == y else (x, y)


def size_text(sides: Sides) -> str:
    """Return the numbers as text: "257" or "512 x 128"."""
    return " x ".join(map(str, as_pair(sides))) if isinstance(sides, tuple) else str(sides)


def side(net: Sides) -> int:
    """Return the number of control points per side of a square net with about as many points in total as `net`."""
    return round(math.sqrt(math.prod(as_pair(net))))


def scaled(net: Sides, share: float) -> Sides:
    """Return a net with `share` times as many point spacings per side as `net`, at least MIN_SIDE control points."""
    x, y = (max(round(share * (points - 1)) + 1, MIN_SIDE) for points in as_pair(net))
    return simplified((x, y))


def in_proportion(net: Sides, of: Sides, to: Sides) -> Sides:
    """Return a net with m t / o point spacings on each side, where `net` has m, `to` has t and `of` has o."""
    each = zip(as_pair(net), as_pair(of), as_pair(to), strict=True)
    x, y = (max(round((m - 1) * (t - 1) / (o - 1)) + 1, MIN_SIDE) for m, o, t in each)
    return simplified((x, y))


def coarser(net: Sides, longer: int) -> Sides:
    """Return `net` coarsened, both sides in proportion, to `longer` points on its longer side if it has more there."""
    longest = max(as_pair(net))
    return net if longer >= longest else scaled(net, (longer - 1) / (longest - 1))


def spread(count: int, x: float, y: float) -> Sides:
    """Return the numbers n_x and n_y of cells with about n_x n_y = count² and n_x / n_y = x / y."""
    root = math.sqrt(x / y)
    return simplified((max(round(count * root), 1), max(round(count / root), 1)))
