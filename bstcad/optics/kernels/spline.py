"""Fused CPU kernels (numba) behind `spline_basis.evaluate` and its adjoints, and the spline as other kernels take it.

The plain torch forms stay the reference: these give the same values to rounding, several times faster, because each
point's nine products stay in registers and the adjoint scatters into one net a part instead of nine index_put passes.
choice.py says which tensors they take.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from bstcad.optics.kernels import reductions
from bstcad.optics.kernels.compiling import compiled

CHUNK = 4096  # points a task: its coordinates and results stay in the second-level cache


def _flat(t: Tensor) -> np.ndarray:
    return t.detach().reshape(-1).contiguous().numpy()


def net_of(heights: Tensor) -> np.ndarray:
    """The heights as the kernels take them: flat, float64."""
    return _flat(heights.detach().double())


# --- the spline at one point ------------------------------------------------------------------------------------------


@njit(error_model="numpy", fastmath={"contract"})
def basis(u, m):
    """(k, B_k, B_{k+2}, -dB_k/du, dB_{k+2}/du) at u; the middle one is what is missing to 1 (spline_basis.basis)."""
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
    """d²B_k/du² = d²B_{k+2}/du² = a b r³ / 2 at u (see `basis`)."""
    if 1.5 <= u <= m - 2.5:
        return 1.0
    k, s = (0, 2.0 - math.sqrt(4.0 - 2.0 * u)) if u < 1.5 else (m - 3, math.sqrt(4.0 - 2.0 * (m - 1 - u)) - 1.0)
    a = 1.0 if k == 0 else 0.5
    b = 1.0 if k == m - 3 else 0.5
    r = 1.0 / (a * (1.0 - s) + b * s)
    return 0.5 * a * b * r * r * r


@njit(inline="always")
def sag(net, m, u, v):
    """(h, ∂h/∂u, ∂h/∂v) as sums over differences of neighbouring heights; net is flat (see spline_basis.evaluate)."""
    i, a0, a2, p0, p2 = basis(u, m)
    j, b0, b2, q0, q2 = basis(v, m)
    at = np.uint64(i * m + j)  # unsigned: no test for an index from the end
    middle = net[at + np.uint64(1)]
    low, high = middle - net[at], net[at + np.uint64(2)] - middle
    f0, g0 = middle - b0 * low + b2 * high, q0 * low + q2 * high
    at += np.uint64(m)
    middle = net[at + np.uint64(1)]
    low, high = middle - net[at], net[at + np.uint64(2)] - middle
    f1, g1 = middle - b0 * low + b2 * high, q0 * low + q2 * high
    at += np.uint64(m)
    middle = net[at + np.uint64(1)]
    low, high = middle - net[at], net[at + np.uint64(2)] - middle
    f2, g2 = middle - b0 * low + b2 * high, q0 * low + q2 * high
    low, high = f1 - f0, f2 - f1
    return f1 - a0 * low + a2 * high, p0 * low + p2 * high, g1 - a0 * (g1 - g0) + a2 * (g2 - g1)


@njit(inline="always")
def curved(net, m, u, v):
    """(h, ∂h/∂u, ∂h/∂v, ∂²h/∂u², ∂²h/∂u∂v, ∂²h/∂v²), as `sag`."""
    i, a0, a2, p0, p2 = basis(u, m)
    j, b0, b2, q0, q2 = basis(v, m)
    c_u, c_v = bend(u, m), bend(v, m)
    at = np.uint64(i * m + j)
    middle = net[at + np.uint64(1)]
    low, high = middle - net[at], net[at + np.uint64(2)] - middle
    f0, g0, k0 = middle - b0 * low + b2 * high, q0 * low + q2 * high, high - low
    at += np.uint64(m)
    middle = net[at + np.uint64(1)]
    low, high = middle - net[at], net[at + np.uint64(2)] - middle
    f1, g1, k1 = middle - b0 * low + b2 * high, q0 * low + q2 * high, high - low
    at += np.uint64(m)
    middle = net[at + np.uint64(1)]
    low, high = middle - net[at], net[at + np.uint64(2)] - middle
    f2, g2, k2 = middle - b0 * low + b2 * high, q0 * low + q2 * high, high - low
    low, high = f1 - f0, f2 - f1
    h, h_u, h_uu = f1 - a0 * low + a2 * high, p0 * low + p2 * high, c_u * (high - low)
    low, high = g1 - g0, g2 - g1
    h_v, h_uv = g1 - a0 * low + a2 * high, p0 * low + p2 * high
    return h, h_u, h_v, h_uu, h_uv, c_v * (k1 - a0 * (k1 - k0) + a2 * (k2 - k1))


@njit(inline="always")
def scatter(own, reach, u, v, g, g_u, g_v):
    """The transpose of `sag`: adds a point's gradients to its nine control points; own (m, m), see reductions.py."""
    m = own.shape[0]
    i, a0, a2, p0, p2 = basis(u, m)
    j, b0, b2, q0, q2 = basis(v, m)
    b1, q1 = 1.0 - b0 - b2, q0 - q2
    reductions.clear(own, reach, i, i + 3)
    flat, tilt = a0 * g - p0 * g_u, a0 * g_v
    own[i, j] += flat * b0 - tilt * q0
    own[i, j + 1] += flat * b1 + tilt * q1
    own[i, j + 2] += flat * b2 + tilt * q2
    flat, tilt = (1.0 - a0 - a2) * g + (p0 - p2) * g_u, (1.0 - a0 - a2) * g_v
    own[i + 1, j] += flat * b0 - tilt * q0
    own[i + 1, j + 1] += flat * b1 + tilt * q1
    own[i + 1, j + 2] += flat * b2 + tilt * q2
    flat, tilt = a2 * g + p2 * g_u, a2 * g_v
    own[i + 2, j] += flat * b0 - tilt * q0
    own[i + 2, j + 1] += flat * b1 + tilt * q1
    own[i + 2, j + 2] += flat * b2 + tilt * q2


# --- at many points ---------------------------------------------------------------------------------------------------


@compiled(parallel=True)
def _evaluate(net, m, u, v, h, h_u, h_v):
    n = u.size
    for c in prange((n + CHUNK - 1) // CHUNK):
        for r in range(c * CHUNK, min(n, (c + 1) * CHUNK)):
            h[r], h_u[r], h_v[r] = sag(net, m, float(u[r]), float(v[r]))


@compiled(parallel=True)
def _adjoint_in_net(u, v, g, g_u, g_v, d_net, reach):
    """d_net (parts, m, m) in float64: each part's own sum, so no two threads write one cell (see reductions.py)."""
    n = u.size
    count = d_net.shape[0]
    share = (n + count - 1) // count
    for c in prange(count):
        own, rows = d_net[c], reach[c]
        for r in range(c * share, min(n, (c + 1) * share)):
            scatter(own, rows, float(u[r]), float(v[r]), float(g[r]), float(g_u[r]), float(g_v[r]))


@compiled(parallel=True)
def _adjoint_in_places(net, m, u, v, g, g_u, g_v, d_u, d_v):
    n = u.size
    for c in prange((n + CHUNK - 1) // CHUNK):
        for r in range(c * CHUNK, min(n, (c + 1) * CHUNK)):
            _, zu, zv, zuu, zuv, zvv = curved(net, m, float(u[r]), float(v[r]))
            d_u[r] = float(g[r]) * zu + float(g_u[r]) * zuu + float(g_v[r]) * zuv
            d_v[r] = float(g[r]) * zv + float(g_u[r]) * zuv + float(g_v[r]) * zvv


def net_gradient(heights: Tensor, u: Tensor, v: Tensor, seeds: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """(m, m) the gradient in the heights of Σ g h + g_u ∂h/∂u + g_v ∂h/∂v at (u, v), the seeds (g, g_u, g_v) held."""
    d_net, reach = reductions.buffers(reductions.parts(u.numel()), *heights.shape)
    _adjoint_in_net(_flat(u), _flat(v), *map(_flat, seeds), d_net, reach)
    return torch.from_numpy(reductions.merged(d_net, reach)).to(heights.dtype)


class BSplineSag(torch.autograd.Function):
    """(heights, u, v) -> (h, ∂h/∂u, ∂h/∂v); gradients in all three inputs, once differentiable."""

    @staticmethod
    def forward(ctx, heights: Tensor, u: Tensor, v: Tensor):  # noqa: D102
        ctx.save_for_backward(heights, u, v)
        out = [torch.empty(u.shape, dtype=u.dtype) for _ in range(3)]
        _evaluate(net_of(heights), heights.shape[0], _flat(u), _flat(v), *(o.view(-1).numpy() for o in out))
        return tuple(out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g: Tensor, g_u: Tensor, g_v: Tensor):  # noqa: D102
        heights, u, v = ctx.saved_tensors
        along = (_flat(u), _flat(v), _flat(g), _flat(g_u), _flat(g_v))
        d_heights = d_u = d_v = None
        if ctx.needs_input_grad[0]:
            d_heights = net_gradient(heights, u, v, (g, g_u, g_v))
        if any(ctx.needs_input_grad[1:]):
            d_u, d_v = (torch.empty(u.shape, dtype=u.dtype) for _ in range(2))
            _adjoint_in_places(net_of(heights), heights.shape[0], *along, *(d.view(-1).numpy() for d in (d_u, d_v)))
        return d_heights, d_u, d_v
