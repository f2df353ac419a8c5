"""Fused CPU kernels (numba) behind `spline_basis.evaluate`, `trace.through_back` and `irradiance.collect`.

The plain torch forms stay the reference: these give the same values to rounding, several times faster, because each
ray's nine products stay in registers and the adjoint scatters into one net a part instead of nine index_put passes.
Where the tensors are elsewhere (CUDA) `serves` says no and the plain form is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from bstcad.optics.kernels import reductions

CHUNK = 4096  # rays a task: its coordinates and results stay in the second-level cache


def serves(*tensors: Tensor) -> bool:
    """Do the fused kernels take these tensors (CPU, one dtype, float32 or float64)?"""
    first = tensors[0]
    return all(
        t.device.type == "cpu" and t.dtype == first.dtype and t.dtype in (torch.float32, torch.float64) for t in tensors
    )


def _flat(t: Tensor) -> np.ndarray:
    return t.detach().reshape(-1).contiguous().numpy()


@njit(inline="always")
def _basis(u, m):
    """Span and the three basis functions with first and second derivatives in u (see spline_basis.basis)."""
    if u < 1.5:
        k = 0
        s = 2.0 - math.sqrt(4.0 - 2.0 * u)
    elif u > m - 2.5:
        k = m - 3
        s = math.sqrt(4.0 - 2.0 * (m - 1 - u)) - 1.0
    else:
        k = min(max(int(u - 0.5), 0), m - 3)
        s = u - 0.5 - k
    a = 1.0 if k == 0 else 0.5
    b = 1.0 if k == m - 3 else 0.5
    q = 1.0 - s
    w0 = a * q * q
    w2 = b * s * s
    r = 0.5 / (a * q + b * s)  # dt/du
    d0 = -2.0 * a * q * r
    d2 = 2.0 * b * s * r
    c = 2.0 * (b - a) * r  # (d²u/dt²) (dt/du), zero but in the end spans
    e0 = (2.0 * a * r - d0 * c) * r
    e2 = (2.0 * b * r - d2 * c) * r
    return k, w0, 1.0 - w0 - w2, w2, d0, -d0 - d2, d2, e0, -e0 - e2, e2


@njit(inline="always")
def _local(net, u, v):
    """h and its first and second derivatives at (u, v): (h, h_u, h_v, h_uu, h_uv, h_vv)."""
    m = net.shape[0]
    i, a0, a1, a2, p0, p1, p2, s0, s1, s2 = _basis(u, m)
    j, b0, b1, b2, q0, q1, q2, t0, t1, t2 = _basis(v, m)
    f0 = b0 * net[i, j] + b1 * net[i, j + 1] + b2 * net[i, j + 2]
    f1 = b0 * net[i + 1, j] + b1 * net[i + 1, j + 1] + b2 * net[i + 1, j + 2]
    f2 = b0 * net[i + 2, j] + b1 * net[i + 2, j + 1] + b2 * net[i + 2, j + 2]
    g0 = q0 * net[i, j] + q1 * net[i, j + 1] + q2 * net[i, j + 2]
    g1 = q0 * net[i + 1, j] + q1 * net[i + 1, j + 1] + q2 * net[i + 1, j + 2]
    g2 = q0 * net[i + 2, j] + q1 * net[i + 2, j + 1] + q2 * net[i + 2, j + 2]
    k0 = t0 * net[i, j] + t1 * net[i, j + 1] + t2 * net[i, j + 2]
    k1 = t0 * net[i + 1, j] + t1 * net[i + 1, j + 1] + t2 * net[i + 1, j + 2]
    k2 = t0 * net[i + 2, j] + t1 * net[i + 2, j + 1] + t2 * net[i + 2, j + 2]
    return (
        a0 * f0 + a1 * f1 + a2 * f2, p0 * f0 + p1 * f1 + p2 * f2, a0 * g0 + a1 * g1 + a2 * g2,
        s0 * f0 + s1 * f1 + s2 * f2, p0 * g0 + p1 * g1 + p2 * g2, a0 * k0 + a1 * k1 + a2 * k2,
    )  # fmt: skip


@njit(inline="always")
def _scatter(own, reach, u, v, g, g_u, g_v):
    """The transpose of `_local`'s first three values: adds a ray's gradients to its nine control points."""
    m = own.shape[0]
    i, a0, a1, a2, p0, p1, p2, _, _, _ = _basis(u, m)
    j, b0, b1, b2, q0, q1, q2, _, _, _ = _basis(v, m)
    reductions.clear(own, reach, i, i + 3)
    for row in range(3):
        w, d = (a0, p0) if row == 0 else ((a1, p1) if row == 1 else (a2, p2))
        flat = w * g + d * g_u
        tilt = w * g_v
        own[i + row, j] += flat * b0 + tilt * q0
        own[i + row, j + 1] += flat * b1 + tilt * q1
        own[i + row, j + 2] += flat * b2 + tilt * q2


@njit(parallel=True, cache=True, nogil=True)
def _evaluate(net, u, v, h, h_u, h_v):
    n = u.size
    for c in prange((n + CHUNK - 1) // CHUNK):
        for r in range(c * CHUNK, min(n, (c + 1) * CHUNK)):
            h[r], h_u[r], h_v[r], _, _, _ = _local(net, float(u[r]), float(v[r]))


@njit(parallel=True, cache=True, nogil=True)
def _adjoint_in_net(u, v, g, g_u, g_v, d_net, reach):
    """d_net (parts, m, m) in float64: each part's own sum, so no two threads write one cell (see reductions.py)."""
    n = u.size
    count = d_net.shape[0]
    share = (n + count - 1) // count
    for c in prange(count):
        own, rows = d_net[c], reach[c]
        for r in range(c * share, min(n, (c + 1) * share)):
            _scatter(own, rows, float(u[r]), float(v[r]), float(g[r]), float(g_u[r]), float(g_v[r]))


@njit(parallel=True, cache=True, nogil=True)
def _adjoint_in_places(net, u, v, g, g_u, g_v, d_u, d_v):
    n = u.size
    for c in prange((n + CHUNK - 1) // CHUNK):
        for r in range(c * CHUNK, min(n, (c + 1) * CHUNK)):
            _, zu, zv, zuu, zuv, zvv = _local(net, float(u[r]), float(v[r]))
            d_u[r] = float(g[r]) * zu + float(g_u[r]) * zuu + float(g_v[r]) * zuv
            d_v[r] = float(g[r]) * zv + float(g_u[r]) * zuv + float(g_v[r]) * zvv


@njit
def _approach(net, frame, known, rules, px, py, pz, dx, dy, dz):
    """(s, arrived): intersection._approach for one ray."""
    last = net.shape[0] - 1.0
    rate = abs(dz) + known[0] * abs(dx) + known[1] * abs(dy)
    s = 0.0
    for step in range(int(rules.approach_steps)):
        u, v, z = (px + s * dx - frame[0]) * frame[2], (py + s * dy - frame[1]) * frame[3], pz + s * dz
        residual = z - _local(net, min(max(u, 0.0), last), min(max(v, 0.0), last))[0]
        gone = (u > last and dx > 0.0) or (u < 0.0 and dx < 0.0) or (z < known[2] and dz <= 0.0)
        if gone or (v > last and dy > 0.0) or (v < 0.0 and dy < 0.0) or (step == 0 and not residual < 0.0):
            break
        if residual >= -known[4]:
            return s, True
        s -= residual / rate
    return s, False


@njit(inline="always")
def _hit(net, frame, known, rules, px, py, pz, dx, dy, dz):
    """(found, t, sag and slopes there): intersection.first_root for one ray, pz relative to the base plane."""
    x0, y0, cx, cy = frame[0], frame[1], frame[2], frame[3]
    last = net.shape[0] - 1.0
    found, farthest = True, math.inf
    s = h = p = q = 0.0
    steep = not dz > known[0] * abs(dx) + known[1] * abs(dy)
    if steep:
        found, farthest = False, known[4] / rules.flattest
        if abs(dz) > rules.level:
            s, found = _approach(net, frame, known, rules, px, py, pz, dx, dy, dz)
        if not found:
            return False, s, h, p, q
    start = -pz / dz  # to the base plane; from there s, as short as the sag
    px += start * dx
    py += start * dy
    if steep:
        s -= start
    below = s
    for _ in range(int(rules.newton_steps)):
        u, v = (px + s * dx - x0) * cx, (py + s * dy - y0) * cy
        h, p, q, _, _, _ = _local(net, min(max(u, 0.0), last), min(max(v, 0.0), last))
        p *= cx
        q *= cy
        residual = s * dz - h
        if abs(residual) <= known[3]:
            return start + s >= 0.0 and abs(s - below) <= farthest, start + s, h, p, q
        slope = dz  # beyond the net the sag goes on level across the rim
        if 0.0 <= u <= last:
            slope -= p * dx
        if 0.0 <= v <= last:
            slope -= q * dy
        if abs(slope) < rules.flattest:
            slope = -rules.flattest if slope < 0 else rules.flattest
        s -= residual / slope
    return False, start + s, h, p, q


@njit(inline="always")
def _refracted(eta, cos2):
    """cos² of the angle of refraction from that of incidence, by Snell's law (interfaces.Refract); <= 0: none."""
    return 1.0 - eta * eta * (1.0 - cos2)


@njit(parallel=True, cache=True, nogil=True)
def _through_back(net, frame, limits, known, rules, law, throw, tilted, position, direction, status, out, path, cosine):
    """Intersect the back face, refract or reflect, land: out (2, n) mm, path (n,) mm to the face, status the fate.

    cosine (n,), of the angle of incidence, or empty where nobody asks for it.
    """
    eta, reflects, missed, lost, behind = law
    n = status.size
    for c in prange((n + CHUNK - 1) // CHUNK):
        for r in range(c * CHUNK, min(n, (c + 1) * CHUNK)):
            out[0, r] = out[1, r] = path[r] = 0.0
            if status[r] != 0:
                continue
            px, py, pz = float(position[0, r]), float(position[1, r]), float(position[2, r]) - frame[4]
            dx, dy, dz = float(direction[0, r]), float(direction[1, r]), float(direction[2, r])
            found, t, h, p, q = _hit(net, frame, known, rules, px, py, pz, dx, dy, dz)
            path[r] = t
            x, y = px + t * dx, py + t * dy
            inside = abs(x) <= limits[0] and abs(y) <= limits[1] and x * x + y * y <= limits[2]
            along = dz - p * dx - q * dy
            if not (found and inside and abs(along) > rules.along):
                status[r] = missed
                continue
            norm2 = 1.0 / (1.0 + p * p + q * q)
            cos2 = 1.0 if reflects else _refracted(eta, along * along * norm2)
            if cos2 <= 0.0 or along <= 0.0:
                status[r] = lost
                continue
            s = -2.0 * along * norm2 if reflects else math.sqrt(cos2 * norm2) - eta * along * norm2
            ez = eta * dz + s
            if tilted is None:
                if (-ez if reflects else ez) <= rules.grazing:
                    status[r] = behind
                    continue
                out[0, r] = x + (throw - h) * (eta * dx - s * p) / ez
                out[1, r] = y + (throw - h) * (eta * dy - s * q) / ez
            else:
                ex, ey = eta * dx - s * p, eta * dy - s * q
                ahead = tilted.n_x * ex + tilted.n_y * ey + tilted.n_z * ez
                if ahead <= rules.grazing:
                    status[r] = behind
                    continue
                x, y, z = x - tilted.x, y - tilted.y, h - throw
                far = -(tilted.n_x * x + tilted.n_y * y + tilted.n_z * z) / ahead
                x, y, z = x + far * ex, y + far * ey, z + far * ez
                out[0, r] = tilted.x + (tilted.x_x * x + tilted.x_y * y + tilted.x_z * z)
                out[1, r] = tilted.y + (tilted.y_x * x + tilted.y_y * y + tilted.y_z * z)
            if cosine.size > 0:
                cosine[r] = along * math.sqrt(norm2)


@njit(parallel=True, cache=True, nogil=True)
def _through_back_adjoint(
    net, frame, rules, law, throw, tilted, position, direction, status, path, g, more, d_net, reach
):
    """Gradient in the net of Σ g · landing: the chain rule through law and implicit hit (interfaces.intersect).

    more (2, n): the gradients in path and cosine of incidence, or (2, 0) if there are none.
    """
    eta, reflects, _, _, _ = law
    n = status.size
    last = net.shape[0] - 1.0
    count = d_net.shape[0]
    share = (n + count - 1) // count
    for c in prange(count):
        own, rows = d_net[c], reach[c]
        for r in range(c * share, min(n, (c + 1) * share)):
            if status[r] != 0:
                continue
            gx, gy = float(g[0, r]), float(g[1, r])
            if gx == 0.0 and gy == 0.0 and more.shape[1] == 0:
                continue
            dx, dy, dz = float(direction[0, r]), float(direction[1, r]), float(direction[2, r])
            u = min(max((float(position[0, r]) + path[r] * dx - frame[0]) * frame[2], 0.0), last)
            v = min(max((float(position[1, r]) + path[r] * dy - frame[1]) * frame[3], 0.0), last)
            h, p, q, hxx, hxy, hyy = _local(net, u, v)
            p, q = p * frame[2], q * frame[3]
            hxx, hxy, hyy = hxx * frame[2] * frame[2], hxy * frame[2] * frame[3], hyy * frame[3] * frame[3]
            along = dz - p * dx - q * dy
            norm2 = 1.0 / (1.0 + p * p + q * q)
            norm = math.sqrt(norm2)
            cos_in = along * norm
            cos_out = math.sqrt(max(_refracted(eta, cos_in * cos_in), 0.0))  # rounds anew
            s = -2.0 * along * norm2 if reflects else norm * cos_out - eta * along * norm2
            ez = eta * dz + s
            if tilted is None:
                ez = min(ez, -rules.grazing) if reflects else max(ez, rules.grazing)
                a, b = (eta * dx - s * p) / ez, (eta * dy - s * q) / ez
                far = (throw - h) / ez
                g_ex, g_ey, g_ez = gx * far, gy * far, -(a * gx + b * gy) * far
                g_t = gx * (dx - a * dz) + gy * (dy - b * dz)
            else:
                # the landing moves by u · (dP - n (e · dP) / (n · e)) for each axis u, dP = dp + far de
                ex, ey = eta * dx - s * p, eta * dy - s * q
                n_x, n_y, n_z = tilted.n_x, tilted.n_y, tilted.n_z
                ahead = max(n_x * ex + n_y * ey + n_z * ez, rules.grazing)
                x = float(position[0, r]) + path[r] * dx - tilted.x
                y = float(position[1, r]) + path[r] * dy - tilted.y
                far = -(n_x * x + n_y * y + n_z * (h - throw)) / ahead
                g_x = gx * tilted.x_x + gy * tilted.y_x
                g_y = gx * tilted.x_y + gy * tilted.y_y
                g_z = gx * tilted.x_z + gy * tilted.y_z
                slide = (g_x * ex + g_y * ey + g_z * ez) / ahead
                g_x, g_y, g_z = g_x - slide * n_x, g_y - slide * n_y, g_z - slide * n_z
                g_ex, g_ey, g_ez = g_x * far, g_y * far, g_z * far
                g_t = g_x * dx + g_y * dy + g_z * dz
            g_s = g_ez - p * g_ex - q * g_ey
            # ds/dp with N = norm: d cos_in = -N dx - p N² cos_in, d cos_out = η² cos_in / cos_out · d cos_in
            s_p = s_q = 0.0  # reflected light: s = -2 (d · N) N_z, with no such term
            if not reflects:
                turn = eta * eta * cos_in / max(cos_out, rules.skimming)
                s_p = -p * norm * norm2 * cos_out - norm * turn * (norm * dx + p * norm2 * cos_in)
                s_q = -q * norm * norm2 * cos_out - norm * turn * (norm * dy + q * norm2 * cos_in)
            fall = (2.0 if reflects else eta) * norm2
            s_p += fall * (2.0 * p * norm2 * along + dx)
            s_q += fall * (2.0 * q * norm2 * along + dy)
            g_p = g_s * s_p - s * g_ex
            g_q = g_s * s_q - s * g_ey
            # the hit slides along the ray by dt = dh / F', F' = along; with it x, y, z and the slopes
            if more.shape[1] > 0:
                g_t += more[0, r]
                g_p -= more[1, r] * norm * (dx + p * norm * cos_in)
                g_q -= more[1, r] * norm * (dy + q * norm * cos_in)
            g_t += g_p * (hxx * dx + hxy * dy) + g_q * (hxy * dx + hyy * dy)
            g_h = g_t / along
            _scatter(own, rows, u, v, g_h, g_p * frame[2], g_q * frame[3])


@njit(parallel=True, cache=True, nogil=True)
def _splat(position, flux, frame, image, reach, outside):
    """Bilinear splat onto pixel centres, image (parts, rows, columns), and outside (parts,)."""
    n = flux.size
    count, rows, columns = image.shape
    share = (n + count - 1) // count
    for c in prange(count):
        own = image[c]
        beyond = 0.0
        for r in range(c * share, min(n, (c + 1) * share)):
            f = float(flux[r])
            if f == 0.0:
                continue
            x = (float(position[0, r]) - frame[0]) * frame[1]
            y = (frame[2] - float(position[1, r])) * frame[3]
            off_x, off_y = x - min(max(x, 0.0), columns), y - min(max(y, 0.0), rows)
            beyond += f * (off_x * off_x + off_y * off_y)
            x -= 0.5
            y -= 0.5
            if not (-1.0 < x < columns and -1.0 < y < rows):  # also refuses NaN
                continue
            i, j = int(math.floor(y)), int(math.floor(x))
            wy, wx = y - i, x - j
            reductions.clear(own, reach[c], max(i, 0), min(i + 2, rows))
            if i >= 0:
                if j >= 0:
                    own[i, j] += f * (1 - wy) * (1 - wx)
                if j + 1 < columns:
                    own[i, j + 1] += f * (1 - wy) * wx
            if i + 1 < rows:
                if j >= 0:
                    own[i + 1, j] += f * wy * (1 - wx)
                if j + 1 < columns:
                    own[i + 1, j + 1] += f * wy * wx
        outside[c] = beyond


@njit(parallel=True, cache=True, nogil=True)
def _splat_adjoint(position, flux, frame, g, g_outside, d_position):
    """Gradient in the positions; g (rows, columns) is the gradient in each pixel, g_outside that in the pull."""
    rows, columns = g.shape
    n = flux.size
    for c in prange((n + CHUNK - 1) // CHUNK):
        for r in range(c * CHUNK, min(n, (c + 1) * CHUNK)):
            d_position[0, r] = d_position[1, r] = 0.0
            f = float(flux[r])
            if f == 0.0:
                continue
            x = (float(position[0, r]) - frame[0]) * frame[1]
            y = (frame[2] - float(position[1, r])) * frame[3]
            d_x = 2.0 * g_outside * (x - min(max(x, 0.0), columns))
            d_y = 2.0 * g_outside * (y - min(max(y, 0.0), rows))
            x -= 0.5
            y -= 0.5
            if -1.0 < x < columns and -1.0 < y < rows:
                i, j = int(math.floor(y)), int(math.floor(x))
                wy, wx = y - i, x - j
                g00 = g[i, j] if i >= 0 and j >= 0 else 0.0
                g01 = g[i, j + 1] if i >= 0 and j + 1 < columns else 0.0
                g10 = g[i + 1, j] if i + 1 < rows and j >= 0 else 0.0
                g11 = g[i + 1, j + 1] if i + 1 < rows and j + 1 < columns else 0.0
                d_x += (1 - wy) * (g01 - g00) + wy * (g11 - g10)
                d_y += (1 - wx) * (g10 - g00) + wx * (g11 - g01)
            d_position[0, r] = f * d_x * frame[1]
            d_position[1, r] = -f * d_y * frame[3]


def net_gradient(heights: Tensor, u: Tensor, v: Tensor, seeds: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """(m, m) the gradient in the heights of Σ g h + g_u ∂h/∂u + g_v ∂h/∂v at (u, v), the seeds (g, g_u, g_v) held."""
    d_net, reach = reductions.rooms(reductions.parts(u.numel()), *heights.shape)
    _adjoint_in_net(_flat(u), _flat(v), *map(_flat, seeds), d_net, reach)
    return torch.from_numpy(reductions.merged(d_net, reach)).to(heights.dtype)


class BSplineSag(torch.autograd.Function):
    """(heights, u, v) -> (h, ∂h/∂u, ∂h/∂v); gradients in all three inputs, once differentiable."""

    @staticmethod
    def forward(ctx, heights: Tensor, u: Tensor, v: Tensor):  # noqa: D102
        ctx.save_for_backward(heights, u, v)
        out = [torch.empty(u.shape, dtype=u.dtype) for _ in range(3)]
        _evaluate(heights.detach().contiguous().numpy(), _flat(u), _flat(v), *(o.view(-1).numpy() for o in out))
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
            _adjoint_in_places(heights.detach().contiguous().numpy(), *along, *(d.view(-1).numpy() for d in (d_u, d_v)))
        return d_heights, d_u, d_v


class Splat(torch.autograd.Function):
    """(position (2, n) mm, flux (n,), frame, shape) -> (image (rows, columns), outside); gradient in the position.

    frame: x_min (mm), columns per mm, y_max (mm), rows per mm.
    """

    @staticmethod
    def forward(ctx, position: Tensor, flux: Tensor, frame: tuple[float, ...], shape: tuple[int, int]):  # noqa: D102
        ctx.save_for_backward(position, flux)
        ctx.frame = np.array(frame)
        count = reductions.parts(flux.numel())
        (image, reach), outside = reductions.rooms(count, *shape), np.zeros(count)
        _splat(position.detach().numpy(), flux.numpy(), ctx.frame, image, reach, outside)
        return torch.from_numpy(reductions.merged(image, reach)), torch.tensor(outside.sum())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g: Tensor, g_outside: Tensor):  # noqa: D102
        position, flux = ctx.saved_tensors
        d_position = torch.empty_like(position)
        _splat_adjoint(
            position.detach().numpy(),
            flux.numpy(),
            ctx.frame,
            g.contiguous().numpy(),
            float(g_outside),
            d_position.numpy(),
        )
        return d_position, None, None, None


@dataclass(frozen=True)
class BackFace:
    """What the back-face kernels need beside net and rays."""

    frame: tuple[float, float, float, float, float]  # x_min, y_min (mm), 1/pitch in x and y (1/mm), base plane above
    # the plane that the rays' positions count from (mm)
    limits: tuple[float, float, float]  # |x|, |y| (mm) and x² + y² (mm²) inside the outline
    known: tuple[float, float, float, float, float]  # intersection.Bounds
    rules: NamedTuple  # kernel_arguments.Rules
    eta: float  # of the law of refraction; 1: reflection
    reflects: bool
    missed: int  # rays.Status of rays that do not meet the face inside the outline
    lost: int  # and of those that its law does not let through
    behind: int  # and of those that do not lead to the screen
    throw: float  # from the base plane to the screen, of a tilted one to its middle (mm)
    tilted: NamedTuple | None = None  # kernel_arguments.Tilted; None: the screen is level
    tells: bool = False  # are path and angle of incidence asked for?

    @property
    def law(self) -> tuple[float, bool, int, int, int]:
        """What the kernels are told of the interface."""
        return float(self.eta), self.reflects, self.missed, self.lost, self.behind


class ThroughBack(torch.autograd.Function):
    """(heights, position (3, n), direction (3, n), status (n,), face) -> (landing (2, n) mm, status, path, cos θ).

    path (n,) mm to the face and cos θ (n,) of incidence there have a gradient, and cos θ values, if `face.tells`.
    Gradient in the heights.
    """

    @staticmethod
    def forward(ctx, heights: Tensor, position: Tensor, direction: Tensor, status: Tensor, face: BackFace):  # noqa: D102
        landing = torch.empty((2, status.numel()), dtype=position.dtype)
        path = torch.empty(status.numel(), dtype=torch.float64)
        cosine = torch.ones(status.numel() if face.tells else 0, dtype=torch.float64)
        fate = status.clone()
        _through_back(
            heights.detach().contiguous().numpy(), *map(np.array, (face.frame, face.limits, face.known)),
            face.rules, face.law, face.throw, face.tilted, position.numpy(), direction.numpy(), fate.numpy(),
            landing.numpy(), path.numpy(), cosine.numpy(),
        )  # fmt: skip
        ctx.save_for_backward(heights, position, direction, fate, path)
        ctx.face = face
        ctx.mark_non_differentiable(fate, *(() if face.tells else (path, cosine)))
        ctx.set_materialize_grads(False)
        return landing, fate, path, cosine

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g: Tensor | None, _, g_path: Tensor | None, g_cosine: Tensor | None):  # noqa: D102
        heights, position, direction, fate, path = ctx.saved_tensors
        g = torch.zeros((2, fate.numel()), dtype=position.dtype) if g is None else g
        more = np.empty((2, 0))
        if g_path is not None or g_cosine is not None:
            more = np.zeros((2, fate.numel()))
            for row, part in zip(more, (g_path, g_cosine), strict=True):
                row[:] = 0.0 if part is None else part.numpy()
        d_net, reach = reductions.rooms(reductions.parts(fate.numel()), *heights.shape)
        _through_back_adjoint(
            heights.detach().contiguous().numpy(), np.array(ctx.face.frame), ctx.face.rules, ctx.face.law,
            ctx.face.throw, ctx.face.tilted, position.numpy(), direction.numpy(), fate.numpy(), path.numpy(),
            g.contiguous().numpy(), more, d_net, reach,
        )  # fmt: skip
        return torch.from_numpy(reductions.merged(d_net, reach)).to(heights.dtype), None, None, None, None
