"""Kernels (numba) for the height at which a round tool touches a net: a ball in space, or the nose of a lathe tool.

A ball of radius r whose centre is over (x, y) touches the face z = f(s, t) where

    z(x, y) = max over (s, t) of  f(s, t) + sqrt(r² - (s - x)² - (t - y)²),

its height without gouge.  At a contact inside the net the centre lies on the normal, and Newton's method solves

    F(s, t) = (s, t) - (x, y) - r ∇f / N = 0,   N² = 1 + |∇f|².

At a contact on the border of the net, one coordinate is fixed, and the section of the ball along the other has the
radius sqrt(r² - d²).  A nose is round in the plane of the axis and one direction only: f is a function of the distance
s along this direction, and F(s) = s - x - r f' / sqrt(1 + f'²).

If all valleys are wider than the tool, the contact is unique.  Otherwise the search looks at a lattice of places in
a window about (x, y), and starts from each place near which, by
the curvatures of face and tool, the maximum may be.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from torch import Tensor

from bstcad.optics.kernels.spline import curved, net_of, sag
from bstcad.optics.numerics import reductions
from bstcad.optics.numerics.compiling import compiled

NEWTON_STEPS = 40  # largest number of Newton steps from a start to the contact
CONTACT_TOLERANCE = 1e-12  # step at which the contact is found, relative to the radius of the tool
FOUND = 1e-8  # distance |F| from the condition of contact, relative to the radius, below which a contact is found
MAX_LATTICE = 96  # largest number of lattice places along each side of the window
SMALLEST_STEP = 1e-6  # step of the search by steps at which it ends, relative to the radius
MAX_STEPS = 400  # largest number of steps of this search
BLOCK = 512  # number of places in the smallest task of a thread


class NetFrame(NamedTuple):
    """Position of a net in x and y as numbers."""

    m: int  # number of control points along x
    n: int  # number of control points along y
    x: float  # smallest x of the net (mm)
    y: float  # smallest y of the net (mm)
    per_x: float  # control points per mm along x
    per_y: float  # control points per mm along y
    wide: float  # extent of the net along x (mm)
    high: float  # extent of the net along y (mm)


class Search(NamedTuple):
    """Radius of the tool, and the lattice from which contacts are searched for."""

    radius: float  # radius of the tool (mm)
    window: float  # half width of the window (mm); 0: Newton's method starts from the place of the tool only
    step: float  # spacing of the lattice (mm)
    slack: float  # height (mm) by which the lattice may miss the top of a maximum


def ball_heights(
    heights: Tensor, search: tuple[NetFrame, Search], x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return z (n,) of a ball's centre over (x, y) (mm), and True (n,) where a contact was found.

    z is measured from the plane of the heights (m, n) of the net.
    """
    z, found = np.empty(len(x)), np.empty(len(x), np.bool_)
    net, x, y = net_of(heights), np.ascontiguousarray(x, np.float64), np.ascontiguousarray(y, np.float64)
    scene = net, *search, x, y, z, found
    reductions.on_threads(lambda *part: _balls(*scene, *part), reductions.shares(len(x), BLOCK))
    return z, found


def nose_heights(
    heights: Tensor, search: tuple[NetFrame, Search], x: np.ndarray, angle: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return z (n,) of a nose's centre at distances x (mm) from the axis, and True (n,) where a contact was found.

    angle: direction (n,) of the plane of the nose, from +x towards +y (radians).  z: as in `ball_heights`.
    """
    z, found = np.empty(len(x)), np.empty(len(x), np.bool_)
    net, x, angle = net_of(heights), np.ascontiguousarray(x, np.float64), np.ascontiguousarray(angle, np.float64)
    scene = net, *search, x, angle, z, found
    reductions.on_threads(lambda *part: _noses(*scene, *part), reductions.shares(len(x), BLOCK))
    return z, found


# --- the face at one point --------------------------------------------------------------------------------------------


@njit(inline="always")
def _between(value, low, high):
    return min(max(value, low), high)


@njit(error_model="numpy")
def _face(net, frame, s, t):
    """Return (f, f_x, f_y, f_xx, f_xy, f_yy) at (s, t) in mm from the corner of the net."""
    h, h_u, h_v, h_uu, h_uv, h_vv = curved(net, frame.m, frame.n, s * frame.per_x, t * frame.per_y)
    a, b = frame.per_x, frame.per_y
    return h, h_u * a, h_v * b, h_uu * a * a, h_uv * a * b, h_vv * b * b


@njit(error_model="numpy")
def _height(net, frame, s, t):
    """Return f at (s, t) in mm from the corner of the net."""
    return sag(net, frame.m, frame.n, s * frame.per_x, t * frame.per_y)[0]


@njit(inline="always")
def _over(f, radius, d2):
    """Return f + sqrt(r² - d²), the height of the centre of a tool that touches a point at the distance d."""
    return f + math.sqrt(radius * radius - d2) if d2 < radius * radius else -math.inf


# --- the ball ---------------------------------------------------------------------------------------------------------


@njit(inline="always")
def _edge_step(radius, beside, along, slope, bend):
    """Return the Newton step along an edge of the net, for a ball whose centre is `beside` mm from this edge."""
    section = math.sqrt(max(radius * radius - beside * beside, 1e-12 * radius * radius))
    norm = math.sqrt(1.0 + slope * slope)
    rate = 1.0 - section * bend / (norm * norm * norm)
    return (along - section * slope / norm) / (rate if abs(rate) > 0.05 else 0.05)


@njit(error_model="numpy")
def _ball_from(net, frame, radius, place, start):
    """Return (z, |F| / r) of the contact to which Newton's method leads from `start`; both from the net's corner."""
    x, y = place
    s, t = start
    off = math.inf
    for _ in range(NEWTON_STEPS):
        _, f_x, f_y, f_xx, f_xy, f_yy = _face(net, frame, s, t)
        norm2 = 1.0 + f_x * f_x + f_y * f_y
        norm = math.sqrt(norm2)
        a, b = s - x - radius * f_x / norm, t - y - radius * f_y / norm  # F
        g_x, g_y = (f_xx * f_x + f_xy * f_y) / norm2, (f_xy * f_x + f_yy * f_y) / norm2  # ∇N / N
        xx, xy = 1.0 - radius * (f_xx - f_x * g_x) / norm, -radius * (f_xy - f_x * g_y) / norm
        yx, yy = -radius * (f_xy - f_y * g_x) / norm, 1.0 - radius * (f_yy - f_y * g_y) / norm
        det = xx * yy - xy * yx
        det = det if abs(det) > 0.05 else 0.05
        d_s, d_t = (yy * a - xy * b) / det, (xx * b - yx * a) / det
        limit = 1.0 / max(1.0, math.hypot(d_s, d_t) / radius)  # steps are at most as long as the radius
        d_s, d_t = d_s * limit, d_t * limit
        fixed_s = (s - d_s < 0.0) | (s - d_s > frame.wide)
        fixed_t = (t - d_t < 0.0) | (t - d_t > frame.high)
        new_s, new_t = _between(s - d_s, 0.0, frame.wide), _between(t - d_t, 0.0, frame.high)
        if fixed_s & (new_s == s) & (not fixed_t):
            b = _edge_step(radius, s - x, t - y, slope=f_y, bend=f_yy)
            new_t, a = _between(t - b, 0.0, frame.high), 0.0
        elif fixed_t & (new_t == t) & (not fixed_s):
            a = _edge_step(radius, t - y, s - x, slope=f_x, bend=f_xx)
            new_s, b = _between(s - a, 0.0, frame.wide), 0.0
        moved = math.hypot(new_s - s, new_t - t)
        on_edge = (fixed_s & (new_s == s)) | (fixed_t & (new_t == t))
        off = moved / radius if on_edge else math.hypot(a, b) / radius
        s, t = new_s, new_t
        if moved <= CONTACT_TOLERANCE * radius:
            break
    d2 = (s - x) * (s - x) + (t - y) * (t - y)
    return _over(_height(net, frame, s, t), radius, d2), off


@njit(error_model="numpy")
def _lattice(centre, window, step, extent):
    """Return the first place (mm) and the number of lattice places within the window and the net, and their spacing."""
    low, high = _between(centre - window, 0.0, extent), _between(centre + window, 0.0, extent)
    count = int(_between(math.ceil((high - low) / step) + 1.0, 1.0, float(MAX_LATTICE)))
    return low, count, (high - low) / (count - 1) if count > 1 else 0.0


@njit(error_model="numpy")
def _ball_by_search(net, frame, search, place, values):
    """Return (z, True if found) of the highest contact in the window; values: memory for the lattice."""
    x, y = place
    s0, columns, d_s = _lattice(x, search.window, search.step, frame.wide)
    t0, rows, d_t = _lattice(y, search.window, search.step, frame.high)
    best = -math.inf
    for i in range(columns):
        for j in range(rows):
            s, t = s0 + i * d_s, t0 + j * d_t
            values[i, j] = _over(_height(net, frame, s, t), search.radius, (s - x) ** 2 + (t - y) ** 2)
            best = max(best, values[i, j])
    found, least = best > -math.inf, best - search.slack
    for i in range(columns):
        for j in range(rows):
            here = values[i, j]
            if not here >= least:
                continue
            start = (s0 + i * d_s, t0 + j * d_t)
            z, off = _ball_from(net, frame, search.radius, place, start)
            if not (off < FOUND and z >= here):  # it went astray
                z = _ball_by_steps(net, frame, search, place, start, here)
            best = max(best, z)
    return best, found


@njit(error_model="numpy")
def _ball_by_steps(net, frame, search, place, start, z):
    """Return z of a contact near `start`, of the height z, by steps in eight directions that are halved in turn."""
    s, t = start
    step = search.step
    for _ in range(MAX_STEPS):
        if step < SMALLEST_STEP * search.radius:
            break
        better, new_s, new_t = z, s, t
        for i in range(-1, 2):
            for j in range(-1, 2):
                a, b = _between(s + i * step, 0.0, frame.wide), _between(t + j * step, 0.0, frame.high)
                there = _over(_height(net, frame, a, b), search.radius, (a - place[0]) ** 2 + (b - place[1]) ** 2)
                if there > better:
                    better, new_s, new_t = there, a, b
        if better > z:
            z, s, t = better, new_s, new_t
        else:
            step *= 0.5
    return z


@compiled(error_model="numpy")
def _balls(net, frame, search, x, y, z, found, first, last):
    values = np.empty((MAX_LATTICE, MAX_LATTICE))
    for k in range(first, last):
        place = (x[k] - frame.x, y[k] - frame.y)
        if search.window > 0.0:
            z[k], found[k] = _ball_by_search(net, frame, search, place, values)
        else:
            start = (_between(place[0], 0.0, frame.wide), _between(place[1], 0.0, frame.high))
            z[k], off = _ball_from(net, frame, search.radius, place, start)
            found[k] = (off < FOUND) & (z[k] > -math.inf)


# --- the nose ---------------------------------------------------------------------------------------------------------


@njit(error_model="numpy")
def _along(net, frame, ray, s):
    """Return (f, f', f'') at the distance s (mm) from the axis; ray: axis from the net's corner, and direction."""
    x, y, c, d = ray
    f, f_x, f_y, f_xx, f_xy, f_yy = _face(net, frame, x + s * c, y + s * d)
    return f, f_x * c + f_y * d, f_xx * c * c + 2.0 * f_xy * c * d + f_yy * d * d


@njit(inline="always")
def _reach(at, along, extent):
    """Return the distances, smallest and largest, at which a ray from `at` with the slope `along` is in 0 … extent."""
    if abs(along) < 1e-15:
        return -math.inf, math.inf
    a, b = -at / along, (extent - at) / along
    return min(a, b), max(a, b)


@njit(error_model="numpy")
def _nose_from(net, frame, radius, ray, ends, x, start):
    """Return (z, |F| / r) of the contact to which Newton's method leads from a distance `start` (mm)."""
    s, off = start, math.inf
    for _ in range(NEWTON_STEPS):
        _, slope, bend = _along(net, frame, ray, s)
        norm = math.sqrt(1.0 + slope * slope)
        gap = s - x - radius * slope / norm  # F
        rate = 1.0 - radius * bend / (norm * norm * norm)
        new = _between(s - _between(gap / (rate if abs(rate) > 0.05 else 0.05), -radius, radius), ends[0], ends[1])
        moved = abs(new - s)
        off = moved / radius if (new == ends[0]) | (new == ends[1]) else abs(gap) / radius
        s = new
        if moved <= CONTACT_TOLERANCE * radius:
            break
    return _over(_height(net, frame, ray[0] + s * ray[2], ray[1] + s * ray[3]), radius, (s - x) * (s - x)), off


@njit(error_model="numpy")
def _nose_by_search(net, frame, search, ray, ends, x, values):
    """Return (z, True if found) of the highest contact in the window; values: memory for the lattice."""
    low, high = _between(x - search.window, ends[0], ends[1]), _between(x + search.window, ends[0], ends[1])
    count = int(_between(math.ceil((high - low) / search.step) + 1.0, 1.0, float(values.size)))
    step = (high - low) / (count - 1) if count > 1 else 0.0
    best = -math.inf
    for i in range(count):
        s = low + i * step
        values[i] = _over(_height(net, frame, ray[0] + s * ray[2], ray[1] + s * ray[3]), search.radius, (s - x) ** 2)
        best = max(best, values[i])
    found, least = best > -math.inf, best - search.slack
    for i in range(count):
        if values[i] >= least:
            z, off = _nose_from(net, frame, search.radius, ray, ends, x, low + i * step)
            if not (off < FOUND and z >= values[i]):  # it went astray
                z = _nose_by_steps(net, frame, search, ray, ends, x, low + i * step)
            best = max(best, z)
    return best, found


@njit(error_model="numpy")
def _nose_by_steps(net, frame, search, ray, ends, x, s):
    """Return z of a contact near the distance s (mm), by steps to both sides that are halved in turn."""
    z = _over(_height(net, frame, ray[0] + s * ray[2], ray[1] + s * ray[3]), search.radius, (s - x) ** 2)
    step = search.step
    for _ in range(MAX_STEPS):
        if step < SMALLEST_STEP * search.radius:
            break
        better, new = z, s
        for side in range(-1, 2, 2):
            a = _between(s + side * step, ends[0], ends[1])
            there = _over(_height(net, frame, ray[0] + a * ray[2], ray[1] + a * ray[3]), search.radius, (a - x) ** 2)
            if there > better:
                better, new = there, a
        if better > z:
            z, s = better, new
        else:
            step *= 0.5
    return z


@compiled(error_model="numpy")
def _noses(net, frame, search, x, angle, z, found, first, last):
    values = np.empty(MAX_LATTICE * MAX_LATTICE)
    for k in range(first, last):
        ray = (-frame.x, -frame.y, math.cos(angle[k]), math.sin(angle[k]))
        from_x, to_x = _reach(ray[0], ray[2], frame.wide)
        from_y, to_y = _reach(ray[1], ray[3], frame.high)
        ends = (max(from_x, from_y), min(to_x, to_y))
        if search.window > 0.0:
            z[k], found[k] = _nose_by_search(net, frame, search, ray, ends, x[k], values)
        else:
            start = _between(x[k], ends[0], ends[1])
            z[k], off = _nose_from(net, frame, search.radius, ray, ends, x[k], start)
            found[k] = (off < FOUND) & (z[k] > -math.inf)
