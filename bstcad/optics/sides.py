"""Numbers along both sides of a rectangle: control points of a net, cells of a grid, tubes of a sheet.

One number stands for both sides; a pair is (along x, along y).
"""

from __future__ import annotations

import math

Sides = int | tuple[int, int]
FEWEST = 5  # control points along a side of a net


def both(sides: Sides) -> tuple[int, int]:
    """(along x, along y)."""
    return (sides, sides) if isinstance(sides, int) else sides


def plain(sides: Sides) -> Sides:
    """One number where both are equal, else the pair."""
    x, y = both(sides)
    return x if x == y else (x, y)


def in_words(sides: Sides) -> str:
    """257, or 512 x 128."""
    return " x ".join(map(str, both(sides))) if isinstance(sides, tuple) else str(sides)


def side(net: Sides) -> int:
    """Control points a side of the square net of as many."""
    return round(math.sqrt(math.prod(both(net))))


def scaled(net: Sides, share: float) -> Sides:
    """A net with `share` times the spans each way."""
    x, y = (max(round(share * (points - 1)) + 1, FEWEST) for points in both(net))
    return plain((x, y))


def in_proportion(net: Sides, of: Sides, to: Sides) -> Sides:
    """The net with as many spans to those of `to` as `net` has to those of `of`, each way; beside `of` it is `to`."""
    each = zip(both(net), both(of), both(to), strict=True)
    x, y = (max(round((m - 1) * (t - 1) / (o - 1)) + 1, FEWEST) for m, o, t in each)
    return plain((x, y))


def coarser(net: Sides, longer: int) -> Sides:
    """A net with so many control points along its longer side and spans of (nearly) the same shape; `net` if finer."""
    most = max(both(net))
    return net if longer >= most else scaled(net, (longer - 1) / (most - 1))


def spread(count: int, x: float, y: float) -> Sides:
    """About count² in the proportion of x to y: n_x / n_y = x / y."""
    root = math.sqrt(x / y)
    return plain((max(round(count * root), 1), max(round(count / root), 1)))
