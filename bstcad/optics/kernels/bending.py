"""Fused CPU kernel behind the figures of a back (bstcad.analysis.shape): how it bends all over, in one pass.

The plain form is `bstcad.optics.curvature.Jet`; this gives the same to rounding, without keeping what it meets.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bstcad.optics.kernels.compiling import compiled
from bstcad.optics.kernels.ray_blocks import beyond2
from bstcad.optics.kernels.reductions import on_threads

KINDS = 3  # concave curvature, convex curvature, |∇z|
PARTS = 16  # shares of the rows of spans


def largest(
    net: np.ndarray, along: tuple[np.ndarray, np.ndarray], at: tuple[np.ndarray, np.ndarray],
    limits: tuple[float, float, float], bounds: tuple[float, float, float],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """(largest, its place as its index along x and along y, how many are at the bound), (3,), (3, 2), (3,), of KINDS.

    net: (m, m) heights (mm).  along: (m - 2, places, 9) weights of a span's three control points in value, first (1/mm)
    and second derivative (1/mm²), along x and along y.  at: (m - 2, places) x and y (mm).  limits: Outline.limits.
    Places outside them do not count; a curvature is below 0 where no place bends that way.
    """
    spans = len(net) - 2
    ends = [spans * part // PARTS for part in range(PARTS + 1)]
    found = np.full((PARTS, KINDS), -math.inf)
    place, count = np.zeros((PARTS, KINDS, 2), np.int64), np.zeros((PARTS, KINDS), np.int64)
    limits, bounds = np.array(limits), np.array([*bounds[:2], bounds[2] ** 2])
    on_threads(
        _largest,
        [
            (net, *along, *at, limits, bounds, first, last, found[part], place[part], count[part])
            for part, (first, last) in enumerate(zip(ends, ends[1:], strict=False))
        ],
    )
    first = found.argmax(0)  # of equals the one that is met first, whoever met it
    kinds = np.arange(KINDS)
    values = found[first, kinds]
    values[2] = math.sqrt(max(values[2], 0.0))
    return values, place[first, kinds], count.sum(0)


@njit(inline="always")
def _across(net, a, i, j):
    """Value, first and second derivative along x of the three control points of span i in column j, by weights a."""
    h0, h1, h2 = net[i, j], net[i + 1, j], net[i + 2, j]
    value, first = a[0] * h0 + a[1] * h1 + a[2] * h2, a[3] * h0 + a[4] * h1 + a[5] * h2
    return value, first, a[6] * h0 + a[7] * h1 + a[8] * h2


@compiled(error_model="numpy")
def _largest(net, along_x, along_y, x, y, limits, bounds, first, last, found, place, count):
    """Of spans first … last - 1 along x; of slopes the squares."""
    spans, places = y.shape
    reach_x, reach_y, reach2 = limits
    for i in range(first, last):
        for p in range(places):
            at_x = x[i, p]
            if not beyond2(at_x, 0.0, reach_x, reach_y) <= reach2:
                continue
            a = along_x[i, p]
            v0, d0, e0 = _across(net, a, i, 0)
            v1, d1, e1 = _across(net, a, i, 1)
            for j in range(spans):
                v2, d2, e2 = _across(net, a, i, j + 2)
                for q in range(places):
                    at_y = y[j, q]
                    if not beyond2(at_x, at_y, reach_x, reach_y) <= reach2:
                        continue
                    b = along_y[j, q]
                    z_x = b[0] * d0 + b[1] * d1 + b[2] * d2
                    z_y = b[3] * v0 + b[4] * v1 + b[5] * v2
                    z_xx = b[0] * e0 + b[1] * e1 + b[2] * e2
                    z_xy = b[3] * d0 + b[4] * d1 + b[5] * d2
                    z_yy = b[6] * v0 + b[7] * v1 + b[8] * v2
                    # optics.curvature.principal: (A ± sqrt(A² - D n²)) / n³, A = H n³, D = K n⁴
                    steep = z_x * z_x + z_y * z_y
                    n2 = 1.0 + steep
                    mean = 0.5 * ((1.0 + z_y * z_y) * z_xx + (1.0 + z_x * z_x) * z_yy) - z_x * z_y * z_xy
                    spread = math.sqrt(max(mean * mean - (z_xx * z_yy - z_xy * z_xy) * n2, 0.0))
                    scale = 1.0 / (n2 * math.sqrt(n2))
                    concave, convex = (spread + mean) * scale, (spread - mean) * scale
                    if concave > found[0]:
                        found[0], place[0, 0], place[0, 1] = concave, i * places + p, j * places + q
                    if convex > found[1]:
                        found[1], place[1, 0], place[1, 1] = convex, i * places + p, j * places + q
                    if steep > found[2]:
                        found[2], place[2, 0], place[2, 1] = steep, i * places + p, j * places + q
                    count[0] += concave >= bounds[0]
                    count[1] += convex >= bounds[1]
                    count[2] += steep >= bounds[2]
                v0, d0, e0, v1, d1, e1 = v1, d1, e1, v2, d2, e2
