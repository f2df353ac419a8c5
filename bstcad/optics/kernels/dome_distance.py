"""Kernels (numba) for the distance of points and facets from a radial surface; lengths in mm, from its centre.

The foot S(x, y) of a point p is found by Newton's method from the point's direction: with f = p - S and the first
fundamental form E = S_x · S_x, F = S_x · S_y, G = S_y · S_y,

    δx = (G f·S_x - F f·S_y) / (E G - F²),   δy = (E f·S_y - F f·S_x) / (E G - F²),

without the second derivatives of S, since p lies near S.  The height of p is f · n, n the outward unit normal at S.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from bstcad.optics.kernels.dome import clamped, dot, packed, patch, times
from bstcad.optics.kernels.spline import net_of
from bstcad.optics.numerics import reductions
from bstcad.optics.numerics.compiling import compiled
from bstcad.optics.surfaces.radial import RadialSurface

MAX_STEPS = 4  # largest number of Newton steps to a foot
# Step δ, in spacings of the control points, at which the search ends.  The height is then exact to κ δ² / 2, κ the
# curvature, and the normal to κ δ.
FACET_TOLERANCE, POINT_TOLERANCE = 1e-5, 1e-9
MAX_PARTS = 8  # largest number of parts of a facet's edge, which has two points per part
BLOCK = 1024  # number of facets or points in the smallest task of a thread


class Chart(NamedTuple):
    """Chart of a radial surface as numbers."""

    m: int  # number of control points along x
    n: int  # number of control points along y
    x: float  # x of the net's first corner (mm)
    y: float  # y of the net's first corner (mm)
    per_x: float  # control points per mm along x
    per_y: float  # control points per mm along y
    radius: float  # R (mm)


def heights(surface: RadialSurface, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the heights (n,) of points (n, 3) near a surface over it, and the unit normals (n, 3) at their feet."""
    above, normals = np.empty(len(points)), np.empty((len(points), 3))
    points, (net, chart) = np.ascontiguousarray(points), _as_numbers(surface)
    parts = reductions.shares(len(points), BLOCK)
    reductions.on_threads(lambda *part: _heights(net, chart, points, above, normals, *part), parts)
    return above, normals


def distance_of_facets(surface: RadialSurface, corners: np.ndarray) -> float:
    """Return the largest distance (mm) of facets (n, 3, 3) from a surface, at two points per control-point spacing."""
    corners, (net, chart) = np.ascontiguousarray(corners), _as_numbers(surface)
    parts = reductions.shares(len(corners), BLOCK)
    largest = np.zeros(len(parts))
    tasks = [(k, *part) for k, part in enumerate(parts)]
    reductions.on_threads(lambda *task: _distance_of_facets(net, chart, corners, largest, *task), tasks)
    return float(largest.max(initial=0.0))


def _as_numbers(surface: RadialSurface) -> tuple[np.ndarray, Chart]:
    (x, y), (pitch_x, pitch_y), (m, n) = (float(surface.x[0]), float(surface.y[0])), surface.pitch, surface.shape
    return net_of(packed(surface)), Chart(
        m, n, x, y, per_x=1 / float(pitch_x), per_y=1 / float(pitch_y), radius=float(surface.radius)
    )


@njit(inline="always")
def _along_net(chart, p):
    """Return (u, v) in spacings of the direction of a point, inside the net."""
    scale = 2.0 * chart.radius / max(math.sqrt(dot(p, p)) + p[2], 1e-300)
    u, v = (scale * p[0] - chart.x) * chart.per_x, (scale * p[1] - chart.y) * chart.per_y
    return clamped(u, chart.m - 1.0), clamped(v, chart.n - 1.0)


@njit(error_model="numpy", fastmath={"contract"})
def _height(net, chart, p, tolerance):
    """Return the height (mm) of a point over the surface, and the unit normal at its foot."""
    u, v = _along_net(chart, p)
    for step in range(MAX_STEPS + 1):
        s, s_x, s_y = patch(net, chart, u, v)
        f = (p[0] - s[0], p[1] - s[1], p[2] - s[2])
        e, mixed, g = dot(s_x, s_x), dot(s_x, s_y), dot(s_y, s_y)
        a, b, by = dot(f, s_x), dot(f, s_y), 1.0 / (e * g - mixed * mixed)
        du, dv = (g * a - mixed * b) * by * chart.per_x, (e * b - mixed * a) * by * chart.per_y
        if (step == MAX_STEPS) | (max(abs(du), abs(dv)) <= tolerance):
            break
        u, v = clamped(u + du, chart.m - 1.0), clamped(v + dv, chart.n - 1.0)
    n = times(s_x, s_y)
    norm = 1.0 / math.sqrt(dot(n, n))
    n = (n[0] * norm, n[1] * norm, n[2] * norm)
    return dot(f, n), n


@compiled()
def _heights(net, chart, points, above, normals, first, last):
    for k in range(first, last):
        point = (points[k, 0], points[k, 1], points[k, 2])
        above[k], (normals[k, 0], normals[k, 1], normals[k, 2]) = _height(net, chart, point, POINT_TOLERANCE)


@compiled()
def _distance_of_facets(net, chart, corners, largest, task, first, last):
    """Store the largest distance of facets `first` … `last` - 1 at their centres and at 2 `parts` steps per edge."""
    worst = 0.0
    for k in range(first, last):
        a = (corners[k, 0, 0], corners[k, 0, 1], corners[k, 0, 2])
        b = (corners[k, 1, 0], corners[k, 1, 1], corners[k, 1, 2])
        c = (corners[k, 2, 0], corners[k, 2, 1], corners[k, 2, 2])
        (u0, v0), (u1, v1), (u2, v2) = _along_net(chart, a), _along_net(chart, b), _along_net(chart, c)
        extent = max(max(u0, u1, u2) - min(u0, u1, u2), max(v0, v1, v2) - min(v0, v1, v2))
        n = 2 * min(MAX_PARTS, max(1, math.ceil(extent)))
        centre = ((a[0] + b[0] + c[0]) / 3.0, (a[1] + b[1] + c[1]) / 3.0, (a[2] + b[2] + c[2]) / 3.0)
        worst = max(worst, abs(_height(net, chart, centre, FACET_TOLERANCE)[0]))
        for i in range(n):
            for j in range(n + 1 - i):
                p, q, r = i / n, j / n, (n - i - j) / n
                if max(p, q, r) < 1.0:
                    x, y = p * a[0] + q * b[0] + r * c[0], p * a[1] + q * b[1] + r * c[1]
                    z = p * a[2] + q * b[2] + r * c[2]
                    worst = max(worst, abs(_height(net, chart, (x, y, z), FACET_TOLERANCE)[0]))
    largest[task] = worst
