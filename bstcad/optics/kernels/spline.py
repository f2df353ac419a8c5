"""Fused CPU kernels (numba) behind `bspline.evaluate` and its adjoints, and the spline functions of other kernels.

They are several times faster than the plain forms, because each point's nine products stay in registers and the adjoint
adds to one net per part instead of nine index_put passes.
`largest_bending` gives the largest slope and curvatures of a net (analysis/shape.py); its plain form is `bspline.Jet`.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from bstcad.optics.kernels.wide import add_to_span
from bstcad.optics.numerics import reductions
from bstcad.optics.numerics.compiling import compiled
from bstcad.optics.numerics.reductions import on_threads

POINTS_PER_TASK = 4096  # number of points per task, whose coordinates and results stay in the second-level cache


def _flat(t: Tensor) -> np.ndarray:
    return t.detach().reshape(-1).contiguous().numpy()


def net_of(heights: Tensor) -> np.ndarray:
    """Return the heights for the kernels: flattened, in float64."""
    return _flat(heights.detach().double())


# --- the spline at one point ------------------------------------------------------------------------------------------


@njit(error_model="numpy", fastmath={"contract"})
def basis(u, m):
    """Return (k, B_k, B_{k+2}, -dB_k/du, dB_{k+2}/du) at u; B_{k+1} = 1 - B_k - B_{k+2} (bspline.basis)."""
    if 1.5 <= u <= m - 2.5:
        k = int(u - 0.5)
        s = u - 0.5 - k
        q = 1.0 - s
        return k, 0.5 * q * q, 0.5 * s * s, q, s
    if u < 1.5:
        k, s = 0, 2.0 - math.sqrt(4.0 - 2.0 * u)
    else:
        k, s = m - 3, math.sqrt(4.0 - 2.0 * (m - 1 - u)) - 1.0
    q = 1.0 - s
    a = 1.0 if k == 0 else 0.5
    b = 1.0 if k == m - 3 else 0.5
    r = 1.0 / (a * q + b * s)
    return k, a * q * q, b * s * s, a * q * r, b * s * r


@njit(error_model="numpy", fastmath={"contract"})
def bend(u, m):
    """Return d²B_k/du² = d²B_{k+2}/du² = a b r³ / 2 at u, r = 1 / (a q + b s) (see bspline.basis)."""
    if 1.5 <= u <= m - 2.5:
        return 1.0
    k, s = (0, 2.0 - math.sqrt(4.0 - 2.0 * u)) if u < 1.5 else (m - 3, math.sqrt(4.0 - 2.0 * (m - 1 - u)) - 1.0)
    a = 1.0 if k == 0 else 0.5
    b = 1.0 if k == m - 3 else 0.5
    r = 1.0 / (a * (1.0 - s) + b * s)
    return 0.5 * a * b * r * r * r


@njit(inline="always")
def _row(net, at, b0, b2, q0, q2):
    """Return value, slope and second difference along v of the three control points from index `at` on."""
    middle = net[at + np.uint64(1)]
    low, high = middle - net[at], net[at + np.uint64(2)] - middle
    return middle - b0 * low + b2 * high, q0 * low + q2 * high, high - low


@njit(inline="always")
def piece(net, n, at, along_u, along_v):
    """Return (h, ∂h/∂u, ∂h/∂v) of the span whose first control point has the index `at`; the others: from `basis`."""
    (a0, a2, p0, p2), (b0, b2, q0, q2) = along_u, along_v
    f0, g0, _ = _row(net, at, b0, b2, q0, q2)
    f1, g1, _ = _row(net, at + np.uint64(n), b0, b2, q0, q2)
    f2, g2, _ = _row(net, at + np.uint64(2 * n), b0, b2, q0, q2)
    low, high = f1 - f0, f2 - f1
    return f1 - a0 * low + a2 * high, p0 * low + p2 * high, g1 - a0 * (g1 - g0) + a2 * (g2 - g1)


@njit(inline="always")
def curved_piece(net, n, at, along_u, along_v, bends):
    """Return (h, ∂h/∂u, ∂h/∂v, ∂²h/∂u², ∂²h/∂u∂v, ∂²h/∂v²), as `piece` does; bends: `bend` along u and v."""
    (a0, a2, p0, p2), (b0, b2, q0, q2), (c_u, c_v) = along_u, along_v, bends
    f0, g0, k0 = _row(net, at, b0, b2, q0, q2)
    f1, g1, k1 = _row(net, at + np.uint64(n), b0, b2, q0, q2)
    f2, g2, k2 = _row(net, at + np.uint64(2 * n), b0, b2, q0, q2)
    low, high = f1 - f0, f2 - f1
    h, h_u, h_uu = f1 - a0 * low + a2 * high, p0 * low + p2 * high, c_u * (high - low)
    low, high = g1 - g0, g2 - g1
    h_v, h_uv = g1 - a0 * low + a2 * high, p0 * low + p2 * high
    return h, h_u, h_v, h_uu, h_uv, c_v * (k1 - a0 * (k1 - k0) + a2 * (k2 - k1))


@njit(inline="always")
def sag(net, m, n, u, v):
    """Return (h, ∂h/∂u, ∂h/∂v) from differences of heights; net: flattened (m, n); u, v in spacings (bspline.py)."""
    i, a0, a2, p0, p2 = basis(u, m)
    j, b0, b2, q0, q2 = basis(v, n)
    # the index is unsigned, so that no negative index is tested for
    return piece(net, n, np.uint64(i * n + j), (a0, a2, p0, p2), (b0, b2, q0, q2))


@njit(inline="always")
def curved(net, m, n, u, v):
    """Return (h, ∂h/∂u, ∂h/∂v, ∂²h/∂u², ∂²h/∂u∂v, ∂²h/∂v²), as `sag` does."""
    i, a0, a2, p0, p2 = basis(u, m)
    j, b0, b2, q0, q2 = basis(v, n)
    at, bends = np.uint64(i * n + j), (bend(u, m), bend(v, n))
    return curved_piece(net, n, at, (a0, a2, p0, p2), (b0, b2, q0, q2), bends)


@njit(inline="always")
def _add_nine(own, i, j, along_u, along_v, g, g_u, g_v):
    """Add g, g_u and g_v of a point to the nine control points from (i, j) on; the others: from `basis`."""
    (a0, a2, p0, p2), (b0, b2, q0, q2) = along_u, along_v
    for k, (a, p) in enumerate(((a0, -p0), (1.0 - a0 - a2, p0 - p2), (a2, p2))):
        flat, tilted = a * g + p * g_u, a * g_v
        own[i + k, j] += b0 * flat - q0 * tilted
        own[i + k, j + 1] += (1.0 - b0 - b2) * flat + (q0 - q2) * tilted
        own[i + k, j + 2] += b2 * flat + q2 * tilted


@njit(error_model="numpy", fastmath={"contract"})
def scatter(own, touched, u, v, g, g_u, g_v):
    """Add g, g_u, g_v of points (n,) to their nine control points, the transpose of `sag`; own: see reductions.py."""
    (m, n), row = own.shape, -1
    for r in range(u.size):
        h, h_u, h_v = float(g[r]), float(g_u[r]), float(g_v[r])
        if h == 0.0 and h_u == 0.0 and h_v == 0.0:
            continue
        a, b = float(u[r]) - 0.5, float(v[r]) - 0.5
        i, j = int(a), int(b)
        if 1.0 <= a <= m - 3.0 and 1.0 <= b < n - 4.0:  # the fourth number lies in the same row
            if i != row:
                reductions.clear(own, touched, i, i + 3)
                row = i
            add_to_span(own, np.uint64(i * n + j), np.uint64(n), a - i, b - j, h, h_u, h_v)
        else:
            i, a0, a2, p0, p2 = basis(float(u[r]), m)
            j, b0, b2, q0, q2 = basis(float(v[r]), n)
            reductions.clear(own, touched, i, i + 3)
            _add_nine(own, i, j, (a0, a2, p0, p2), (b0, b2, q0, q2), h, h_u, h_v)


@njit(error_model="numpy", inline="always")
def beyond2(x, y, limit_x, limit_y):
    """Return max(|x| - a, 0)² + max(|y| - b, 0)² (mm²), at most r² inside `outlines.Limits` (a, b, r²); NaN for NaN."""
    p, q = abs(x) - limit_x, abs(y) - limit_y
    p, q = 0.0 if p < 0.0 else p, 0.0 if q < 0.0 else q
    return p * p + q * q


# --- at many points ---------------------------------------------------------------------------------------------------


@compiled(threads_by="u")
def _evaluate(net, m, n, u, v, h, h_u, h_v):
    count = u.size
    for c in prange((count + POINTS_PER_TASK - 1) // POINTS_PER_TASK):
        for r in range(c * POINTS_PER_TASK, min(count, (c + 1) * POINTS_PER_TASK)):
            h[r], h_u[r], h_v[r] = sag(net, m, n, float(u[r]), float(v[r]))


@compiled(threads_by="u")
def _adjoint_in_net(u, v, g, g_u, g_v, d_net, touched):
    """Add the gradient in the net to d_net (parts, m, n), float64, a separate sum for each part (see reductions.py)."""
    n = u.size
    count = d_net.shape[0]
    share = (n + count - 1) // count
    for c in prange(count):
        part = slice(c * share, min(n, (c + 1) * share))
        scatter(d_net[c], touched[c], u[part], v[part], g[part], g_u[part], g_v[part])


@compiled(threads_by="u")
def _adjoint_in_places(net, m, n, u, v, g, g_u, g_v, d_u, d_v):
    count = u.size
    for c in prange((count + POINTS_PER_TASK - 1) // POINTS_PER_TASK):
        for r in range(c * POINTS_PER_TASK, min(count, (c + 1) * POINTS_PER_TASK)):
            _, zu, zv, zuu, zuv, zvv = curved(net, m, n, float(u[r]), float(v[r]))
            d_u[r] = float(g[r]) * zu + float(g_u[r]) * zuu + float(g_v[r]) * zuv
            d_v[r] = float(g[r]) * zv + float(g_u[r]) * zuv + float(g_v[r]) * zvv


def net_gradient(heights: Tensor, u: Tensor, v: Tensor, seeds: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Return the gradient (m, n) of Σ (g h + g_u ∂h/∂u + g_v ∂h/∂v) at (u, v) in the heights; seeds: (g, g_u, g_v)."""
    d_net, touched = reductions.buffers(reductions.parts(u.numel()), *heights.shape)
    _adjoint_in_net(_flat(u), _flat(v), *map(_flat, seeds), d_net, touched)
    return torch.from_numpy(reductions.merged(d_net, touched)).to(heights.dtype)


class BSplineSag(torch.autograd.Function):
    """Map (heights, u, v) to (h, ∂h/∂u, ∂h/∂v); gradients in all three inputs, once differentiable."""

    @staticmethod
    def forward(ctx: Any, heights: Tensor, u: Tensor, v: Tensor) -> Any:  # noqa: D102
        ctx.save_for_backward(heights, u, v)
        out = [torch.empty(u.shape, dtype=u.dtype) for _ in range(3)]
        _evaluate(net_of(heights), *heights.shape, _flat(u), _flat(v), *(o.view(-1).numpy() for o in out))
        return tuple(out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g: Tensor, g_u: Tensor, g_v: Tensor) -> Any:  # noqa: D102
        heights, u, v = ctx.saved_tensors
        along = (_flat(u), _flat(v), _flat(g), _flat(g_u), _flat(g_v))
        d_heights = d_u = d_v = None
        if ctx.needs_input_grad[0]:
            d_heights = net_gradient(heights, u, v, (g, g_u, g_v))
        if any(ctx.needs_input_grad[1:]):
            d_u, d_v = (torch.empty(u.shape, dtype=u.dtype) for _ in range(2))
            _adjoint_in_places(net_of(heights), *heights.shape, *along, *(d.view(-1).numpy() for d in (d_u, d_v)))
        return d_heights, d_u, d_v


Pair = tuple[np.ndarray, np.ndarray]
Triple = tuple[float, float, float]
QUANTITIES = 3  # number of quantities: concave curvature, convex curvature, |∇z|
ROW_PARTS = 16  # parts into which the rows of spans are divided, one per task


def largest_bending(
    net: np.ndarray, along: Pair, at: Pair, limits: Triple, bounds: Triple
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the maxima (3,), their indices along x and y (3, 2) and the numbers of points that reach `bounds` (3,).

    The quantities are concave and convex curvature (1/mm) and |∇z|; a curvature is negative if no point is bent that
    way.  Indices run over all points of an axis.  net: (m, n) heights (mm).  along: (m - 2, points, 9) weights of a
    span's control points in value, first (1/mm) and second derivative (1/mm²) along x, and (n - 2, points, 9) along
    y.  at: x and y of the points (mm), each (spans, points).  limits: Outline.limits; points outside do not count.
    """
    spans = len(net) - 2
    ends = [spans * part // ROW_PARTS for part in range(ROW_PARTS + 1)]
    found = np.full((ROW_PARTS, QUANTITIES), -math.inf)
    index = np.zeros((ROW_PARTS, QUANTITIES, 2), np.int64)
    count = np.zeros((ROW_PARTS, QUANTITIES), np.int64)
    scene = net, *along, *at, np.array(limits), np.array([*bounds[:2], bounds[2] ** 2])
    parts = zip(pairwise(ends), found, index, count, strict=True)
    on_threads(_largest, [(*scene, *span, *results) for span, *results in parts])
    best, kinds = found.argmax(0), np.arange(QUANTITIES)  # part with the first of equal values
    values = found[best, kinds]
    values[2] = math.sqrt(max(values[2], 0.0))
    return values, index[best, kinds], count.sum(0)


@njit(inline="always")
def _across(net, a, i, j):
    """Return value, first and second derivative along x of the control points of span i in column j, by weights a."""
    h0, h1, h2 = net[i, j], net[i + 1, j], net[i + 2, j]
    value, first = a[0] * h0 + a[1] * h1 + a[2] * h2, a[3] * h0 + a[4] * h1 + a[5] * h2
    return value, first, a[6] * h0 + a[7] * h1 + a[8] * h2


@compiled(error_model="numpy")
def _largest(net, along_x, along_y, x, y, limits, bounds, first, last, found, index, count):
    """Compute the results of `largest_bending` for spans first … last - 1 along x, with squared slopes."""
    spans, points = y.shape
    limit_x, limit_y, limit_r2 = limits
    for i in range(first, last):
        for p in range(points):
            at_x = x[i, p]
            if not beyond2(at_x, 0.0, limit_x, limit_y) <= limit_r2:
                continue
            a = along_x[i, p]
            v0, d0, e0 = _across(net, a, i, 0)
            v1, d1, e1 = _across(net, a, i, 1)
            for j in range(spans):
                v2, d2, e2 = _across(net, a, i, j + 2)
                for q in range(points):
                    at_y = y[j, q]
                    if not beyond2(at_x, at_y, limit_x, limit_y) <= limit_r2:
                        continue
                    b = along_y[j, q]
                    z_x = b[0] * d0 + b[1] * d1 + b[2] * d2
                    z_y = b[3] * v0 + b[4] * v1 + b[5] * v2
                    z_xx = b[0] * e0 + b[1] * e1 + b[2] * e2
                    z_xy = b[3] * d0 + b[4] * d1 + b[5] * d2
                    z_yy = b[6] * v0 + b[7] * v1 + b[8] * v2
                    # bspline.principal: (A ± sqrt(A² - D n²)) / n³, A = H n³, D = K n⁴
                    steep = z_x * z_x + z_y * z_y
                    n2 = 1.0 + steep
                    mean = 0.5 * ((1.0 + z_y * z_y) * z_xx + (1.0 + z_x * z_x) * z_yy) - z_x * z_y * z_xy
                    spread = math.sqrt(max(mean * mean - (z_xx * z_yy - z_xy * z_xy) * n2, 0.0))
                    scale = 1.0 / (n2 * math.sqrt(n2))
                    concave, convex = (spread + mean) * scale, (spread - mean) * scale
                    if concave > found[0]:
                        found[0], index[0, 0], index[0, 1] = concave, i * points + p, j * points + q
                    if convex > found[1]:
                        found[1], index[1, 0], index[1, 1] = convex, i * points + p, j * points + q
                    if steep > found[2]:
                        found[2], index[2, 0], index[2, 1] = steep, i * points + p, j * points + q
                    count[0] += concave >= bounds[0]
                    count[1] += convex >= bounds[1]
                    count[2] += steep >= bounds[2]
                v0, d0, e0, v1, d1, e1 = v1, d1, e1, v2, d2, e2
