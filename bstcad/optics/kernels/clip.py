"""Fused CPU kernels (numba) behind `tubes.collect`: triangles of light, cut exactly at the pixel borders.

A triangle of flux F and signed area A has the density F / A.  What of it falls into pixel (i, j) follows from Green's
theorem as a line integral along its edges,

    I_ij = -F / A ∮ clip(i + 1 - x, 0, 1) dy   over the parts of the edges in row j,

so each edge is walked from pixel border to pixel border.  Its share goes to the pixel it crosses and, as one number,
to all pixels right of that one; a running sum along the rows ends it.  With G = ∂L/∂I and H(x, y) = ∫_x^∞ G dx the
adjoint needs along the same walk Φ = ∫ H dy (for ∂L/∂A) and ∫ (1 - s) G ds, ∫ s G ds (an edge that moves by δ across
its normal n sweeps the area δ · n ds).  All in pixels, x along columns, y down the rows.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from bstcad.optics.kernels import reductions

FARTHEST = 1e15  # pixels; what lands farther away has no digits left to be cut by
NEVER = 1e300  # the next border of a walk that crosses no more borders of a kind
TALL = 1e6  # pixels; a taller triangle may round its way into any row


def serves(corner: Tensor) -> bool:
    """Do the fused kernels take it (CPU, float64)?"""
    return corner.device.type == "cpu" and corner.dtype == torch.float64


@njit(inline="always")
def _first(start, d, size):
    """(cell, step, s of the next border, s from border to border) along one axis; beyond the screen is one cell.

    Cell -1 is everything before it and cell `size` everything behind it.
    """
    cell = int(min(max(math.floor(start), -1.0), float(size)))
    if d > 0.0 and cell < size:
        return cell, 1, (cell + 1 - start) / d, 1.0 / d
    if d < 0.0 and cell >= 0:
        return cell, -1, (cell - start) / d, -1.0 / d
    return cell, 0, NEVER, NEVER


@njit
def _add_edge(sums, ax, ay, bx, by, weight):
    """One edge's share of the image before the running sum; sums (rows, columns + 1)."""
    rows, columns = sums.shape[0], sums.shape[1] - 1
    dx, dy = bx - ax, by - ay
    if dy == 0.0:
        return
    i, step_x, next_x, over_x = _first(ax, dx, columns)
    j, step_y, next_y, over_y = _first(ay, dy, rows)
    s = 0.0
    while True:
        end = min(next_x, next_y, 1.0)
        if 0 <= j < rows and i < columns:
            share = (end - s) * dy * weight
            if i < 0:
                sums[j, 0] += share
            else:
                beyond = ax + 0.5 * (s + end) * dx - i
                sums[j, i] += share * (1.0 - beyond)
                sums[j, i + 1] += share * beyond
        if not end < 1.0:
            return
        s = end
        if next_x < next_y:
            i += step_x
            next_x = NEVER if (i < 0 or i >= columns) else next_x + over_x
        else:
            j += step_y
            next_y = NEVER if (j < 0 or j >= rows) else next_y + over_y


@njit
def _along_edge(g, beyond_g, ax, ay, bx, by):
    """(∫ H dy, ∫ (1 - s) G ds, ∫ s G ds) along one edge; beyond_g (rows, columns + 1) sums G from a column on."""
    rows, columns = g.shape
    dx, dy = bx - ax, by - ay
    i, step_x, next_x, over_x = _first(ax, dx, columns)
    j, step_y, next_y, over_y = _first(ay, dy, rows)
    s = phi = whole = second = 0.0
    while True:
        end = min(next_x, next_y, 1.0)
        if 0 <= j < rows and i < columns:
            length = end - s
            if i < 0:
                phi += length * beyond_g[j, 0]
            else:
                middle = 0.5 * (s + end)
                value = g[j, i]
                phi += length * (beyond_g[j, i + 1] + (i + 1 - ax - middle * dx) * value)
                whole += length * value
                second += length * middle * value
        if not end < 1.0:
            return phi * dy, whole - second, second
        s = end
        if next_x < next_y:
            i += step_x
            next_x = NEVER if (i < 0 or i >= columns) else next_x + over_x
        else:
            j += step_y
            next_y = NEVER if (j < 0 or j >= rows) else next_y + over_y


@njit(inline="always")
def _one_cell(ax, ay, bx, by, cx, cy):
    """Do the three points lie in one cell?"""
    return (
        math.floor(ax) == math.floor(bx) and math.floor(ax) == math.floor(cx)
        and math.floor(ay) == math.floor(by) and math.floor(ay) == math.floor(cy)
    )  # fmt: skip


@njit(inline="always")
def _outside(ax, ay, bx, by, cx, cy, rows, columns):
    """Do the three points lie on one side of the screen, beyond it, or is one of them nowhere (NaN, infinite)?"""
    span = abs(ax) + abs(bx) + abs(cx) + abs(ay) + abs(by) + abs(cy)
    return not (
        span < FARTHEST
        and max(ax, bx, cx) > 0.0 and min(ax, bx, cx) < columns and max(ay, by, cy) > 0.0 and min(ay, by, cy) < rows
    )  # fmt: skip


@njit
def _add_triangle(sums, thinnest, ax, ay, bx, by, cx, cy, flux):
    rows, columns = sums.shape[0], sums.shape[1] - 1
    if _outside(ax, ay, bx, by, cx, cy, rows, columns):
        return
    area = 0.5 * ((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))
    if _one_cell(ax, ay, bx, by, cx, cy) or abs(area) < thinnest:
        x, y = (ax + bx + cx) / 3.0, (ay + by + cy) / 3.0
        if 0.0 <= x < columns and 0.0 <= y < rows:
            sums[int(y), int(x)] += flux
            sums[int(y), int(x) + 1] -= flux
        return
    weight = -flux / area
    _add_edge(sums, ax, ay, bx, by, weight)
    _add_edge(sums, bx, by, cx, cy, weight)
    _add_edge(sums, cx, cy, ax, ay, weight)


@njit
def _triangle_adjoint(g, beyond_g, thinnest, ax, ay, bx, by, cx, cy, flux):
    """Gradient in the six coordinates."""
    rows, columns = g.shape
    if _outside(ax, ay, bx, by, cx, cy, rows, columns) or _one_cell(ax, ay, bx, by, cx, cy):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    area = 0.5 * ((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))
    if abs(area) < thinnest:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    p0, a0, b0 = _along_edge(g, beyond_g, ax, ay, bx, by)
    p1, b1, c1 = _along_edge(g, beyond_g, bx, by, cx, cy)
    p2, c2, a2 = _along_edge(g, beyond_g, cx, cy, ax, ay)
    w = flux / area
    q = 0.5 * flux * (p0 + p1 + p2) / (area * area)
    ux, uy, vx, vy, wx, wy = bx - ax, by - ay, cx - bx, cy - by, ax - cx, ay - cy  # the edges
    return (
        w * (a0 * uy + a2 * wy) - q * vy, q * vx - w * (a0 * ux + a2 * wx),
        w * (b0 * uy + b1 * vy) - q * wy, q * wx - w * (b0 * ux + b1 * vx),
        w * (c1 * vy + c2 * wy) - q * uy, q * ux - w * (c1 * vx + c2 * wx),
    )  # fmt: skip


@njit
def _triangle_share(g, beyond_g, thinnest, ax, ay, bx, by, cx, cy):
    """The gradient in the flux: the mean of G over the triangle, zero beyond the screen."""
    rows, columns = g.shape
    if _outside(ax, ay, bx, by, cx, cy, rows, columns):
        return 0.0
    area = 0.5 * ((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))
    if _one_cell(ax, ay, bx, by, cx, cy) or abs(area) < thinnest:
        x, y = (ax + bx + cx) / 3.0, (ay + by + cy) / 3.0
        return g[int(y), int(x)] if 0.0 <= x < columns and 0.0 <= y < rows else 0.0
    phi = _along_edge(g, beyond_g, ax, ay, bx, by)[0] + _along_edge(g, beyond_g, bx, by, cx, cy)[0]
    return -(phi + _along_edge(g, beyond_g, cx, cy, ax, ay)[0]) / area


@njit(inline="always")
def _corners(corner, k, r):
    """The four corners of tube (k, r), one after the other around it."""
    return (
        corner[0, k, r], corner[1, k, r], corner[0, k + 1, r], corner[1, k + 1, r],
        corner[0, k + 1, r + 1], corner[1, k + 1, r + 1], corner[0, k, r + 1], corner[1, k, r + 1],
    )  # fmt: skip


@njit(inline="always")
def _beyond(p, size):
    """Signed distance beyond the border."""
    return p - min(max(p, 0.0), size)


@njit(inline="always")
def _far(x0, y0, x1, y1, x2, y2, x3, y3, rows, columns):
    """Half the sum of the corners' squared distances beyond the border."""
    off = _beyond(x0, columns) ** 2 + _beyond(x1, columns) ** 2
    off += _beyond(x2, columns) ** 2 + _beyond(x3, columns) ** 2
    off += _beyond(y0, rows) ** 2 + _beyond(y1, rows) ** 2
    off += _beyond(y2, rows) ** 2 + _beyond(y3, rows) ** 2
    return 0.5 * off


@njit
def _clear_rows(own, reach, y):
    """Clear the rows that triangles between corners at y can reach; a walk's last step may be rounded beyond."""
    low, high = math.inf, -math.inf
    for k in range(y.shape[0]):
        for r in range(y.shape[1]):
            low, high = min(low, y[k, r]), max(high, y[k, r])
    if high - low < TALL:
        low, high = max(low - 1.0, 0.0), min(high + 2.0, float(own.shape[0]))
    else:  # also for NaN
        low, high = 0.0, float(own.shape[0])
    if low < high:
        reductions.clear(own, reach, int(low), int(high))


@njit(parallel=True, cache=True, nogil=True)
def _clip(corner, flux, thinnest, sums, reach, outside):
    """Both triangles of each tube; corner (2, n + 1, m + 1), flux (n, m), sums (parts, rows, columns + 1).

    outside (parts,): Σ flux · (mean square of the corners' distance beyond the border).
    """
    n, m = flux.shape
    count = sums.shape[0]
    rows, columns = float(sums.shape[1]), float(sums.shape[2] - 1)
    share = (n + count - 1) // count
    for c in prange(count):
        own = sums[c]
        _clear_rows(own, reach[c], corner[1, c * share : min(n, (c + 1) * share) + 1])
        far = 0.0
        for k in range(c * share, min(n, (c + 1) * share)):
            for r in range(m):
                half = 0.5 * flux[k, r]
                if half == 0.0:
                    continue
                x0, y0, x1, y1, x2, y2, x3, y3 = _corners(corner, k, r)
                if (k + r) % 2 == 0:
                    _add_triangle(own, thinnest, x0, y0, x1, y1, x2, y2, half)
                    _add_triangle(own, thinnest, x0, y0, x2, y2, x3, y3, half)
                else:
                    _add_triangle(own, thinnest, x0, y0, x1, y1, x3, y3, half)
                    _add_triangle(own, thinnest, x1, y1, x2, y2, x3, y3, half)
                far += half * _far(x0, y0, x1, y1, x2, y2, x3, y3, rows, columns)
        outside[c] = far


@njit(parallel=True, cache=True, nogil=True)
def _clip_adjoint(corner, flux, thinnest, g, beyond_g, g_outside, d_corner):
    """Adds to d_corner; first the even rows of tubes, then the odd ones: no two threads write one corner."""
    n, m = flux.shape
    rows, columns = float(g.shape[0]), float(g.shape[1])
    for parity in range(2):
        for half_k in prange((n - parity + 1) // 2):
            k = 2 * half_k + parity
            for r in range(m):
                half = 0.5 * flux[k, r]
                if half == 0.0:
                    continue
                x0, y0, x1, y1, x2, y2, x3, y3 = _corners(corner, k, r)
                if (k + r) % 2 == 0:
                    u0, v0, u1, v1, u2, v2 = _triangle_adjoint(g, beyond_g, thinnest, x0, y0, x1, y1, x2, y2, half)
                    s0, t0, s2, t2, u3, v3 = _triangle_adjoint(g, beyond_g, thinnest, x0, y0, x2, y2, x3, y3, half)
                    u0, v0, u2, v2 = u0 + s0, v0 + t0, u2 + s2, v2 + t2
                else:
                    u0, v0, u1, v1, u3, v3 = _triangle_adjoint(g, beyond_g, thinnest, x0, y0, x1, y1, x3, y3, half)
                    s1, t1, u2, v2, s3, t3 = _triangle_adjoint(g, beyond_g, thinnest, x1, y1, x2, y2, x3, y3, half)
                    u1, v1, u3, v3 = u1 + s1, v1 + t1, u3 + s3, v3 + t3
                pull = g_outside * half
                d_corner[0, k, r] += u0 + pull * _beyond(x0, columns)
                d_corner[1, k, r] += v0 + pull * _beyond(y0, rows)
                d_corner[0, k + 1, r] += u1 + pull * _beyond(x1, columns)
                d_corner[1, k + 1, r] += v1 + pull * _beyond(y1, rows)
                d_corner[0, k + 1, r + 1] += u2 + pull * _beyond(x2, columns)
                d_corner[1, k + 1, r + 1] += v2 + pull * _beyond(y2, rows)
                d_corner[0, k, r + 1] += u3 + pull * _beyond(x3, columns)
                d_corner[1, k, r + 1] += v3 + pull * _beyond(y3, rows)


@njit(parallel=True, cache=True, nogil=True)
def _clip_adjoint_in_flux(corner, thinnest, g, beyond_g, g_outside, d_flux):
    """The gradient in the flux of each tube, d_flux (n, m)."""
    n, m = d_flux.shape
    rows, columns = float(g.shape[0]), float(g.shape[1])
    for k in prange(n):
        for r in range(m):
            x0, y0, x1, y1, x2, y2, x3, y3 = _corners(corner, k, r)
            if (k + r) % 2 == 0:
                mean = _triangle_share(g, beyond_g, thinnest, x0, y0, x1, y1, x2, y2)
                mean += _triangle_share(g, beyond_g, thinnest, x0, y0, x2, y2, x3, y3)
            else:
                mean = _triangle_share(g, beyond_g, thinnest, x0, y0, x1, y1, x3, y3)
                mean += _triangle_share(g, beyond_g, thinnest, x1, y1, x2, y2, x3, y3)
            pull = g_outside * _far(x0, y0, x1, y1, x2, y2, x3, y3, rows, columns)
            d_flux[k, r] = 0.5 * (mean + pull)


class Clip(torch.autograd.Function):
    """(corner (2, n + 1, m + 1) in pixels, flux (n, m), (rows, columns), thinnest in pixel²) -> (image, outside).

    Gradient in the corners and in the flux.
    """

    @staticmethod
    def forward(ctx, corner: Tensor, flux: Tensor, shape: tuple[int, int], thinnest: float):  # noqa: D102
        ctx.save_for_backward(corner, flux)
        ctx.thinnest = thinnest
        (rows, columns), count = shape, reductions.parts(flux.numel())
        (sums, reach), outside = reductions.rooms(count, rows, columns + 1), np.zeros(count)
        _clip(corner.detach().contiguous().numpy(), flux.detach().contiguous().numpy(), thinnest, sums, reach, outside)
        image = reductions.merged(sums, reach).cumsum(1)
        return torch.from_numpy(image[:, :columns].copy()), torch.tensor(outside.sum())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g: Tensor, g_outside: Tensor):  # noqa: D102
        corner, flux = ctx.saved_tensors
        g = g.contiguous().numpy()
        beyond = np.zeros((g.shape[0], g.shape[1] + 1))
        beyond[:, :-1] = g[:, ::-1].cumsum(1)[:, ::-1]
        at, d_corner, d_flux = corner.detach().contiguous().numpy(), np.zeros(corner.shape), None
        carried, pull = flux.detach().contiguous().numpy(), float(g_outside)
        _clip_adjoint(at, carried, ctx.thinnest, g, beyond, pull, d_corner)
        if ctx.needs_input_grad[1]:
            d_flux = torch.empty(flux.shape, dtype=torch.float64)
            _clip_adjoint_in_flux(at, ctx.thinnest, g, beyond, pull, d_flux.numpy())
        return torch.from_numpy(d_corner), d_flux, None, None
