"""Fused CPU kernels (numba) behind `trace.through` and `trace.behind`: rays across a spline face, and the adjoint.

Rays are processed in blocks (forward.py).  The forward pass stores each ray's path to the face; the adjoint computes
hit and slopes from this path again.

With the ray x + t d, the face's slopes p and q and normal n = (-p, -q, 1), the hit X (where z = sag) changes by

    dX = dx + t dd + d dt,   dt = (δsag - n · (dx + t dd)) / (n · d),   dp = δp + S_xx dX_x + S_xy dX_y, dq likewise,

δ the change by the heights at fixed x and y, S_xx … the sag's second derivatives.  The direction behind the face is
e = η d + s n, s(p, q, n · d) by the law.  The adjoint is the transpose of this map, for the net and, if needed, x, d.
Rays that land on several screens are traced to the face once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from bstcad.optics.kernels import forward, kernel_arguments
from bstcad.optics.kernels.forward import BLOCK, DX, DY, DZ, FATE, FLUX, SAG, SLOPE_X, SLOPE_Y, WORK, S, U, V, X, Y, Z
from bstcad.optics.kernels.spline import curved, net_of, sag, scatter
from bstcad.optics.lens.interfaces import Interface, apply_losses, net_bounds
from bstcad.optics.numerics import reductions
from bstcad.optics.numerics.compiling import compiled
from bstcad.optics.numerics.records import Faces, Screens
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces.rays import Landed, Rays, Status

# Further offsets in `work`: the hit and its status before rays land on the first of several screens.
HIT_X, HIT_Y, HIT_FATE = (WORK + BLOCK * k for k in range(3))
# Offsets for the adjoint: ∂L/∂(hit, direction behind the face, path, cosine of incidence), L the merit; second
# derivatives of the sag; the normal's length 1 / |n|, cosine behind the face, s, and direction e behind the face.
G_X, G_Y, G_Z, G_DX, G_DY, G_DZ, G_PATH, G_COSINE, H_XX, H_XY, H_YY = (WORK + BLOCK * k for k in range(3, 14))
NORM, COS_OUT, SHIFT, E_X, E_Y, E_Z = (WORK + BLOCK * k for k in range(14, 20))
CROSSING_WORK, ADJOINT_WORK = WORK + 3 * BLOCK, WORK + 20 * BLOCK  # lengths of `work`


@njit(inline="always")
def is_axial(direction):
    """Return True for light along the axis, which has no array of directions."""
    return direction.shape[1] == 0


@njit(error_model="numpy")
def load(position, direction, status, first, count, work):
    """Load rays first … first + count - 1; status (k, n): a ray is lost if its status is so for all k screens.

    direction: (3, n), or (3, 0) for light along the axis.
    """
    for r in range(count):
        at = first + r
        work[X + r], work[Y + r], work[Z + r] = position[0, at], position[1, at], position[2, at]
        work[FATE + r], work[FLUX + r] = status[0, at], 1.0
    if is_axial(direction):
        for r in range(count):
            work[DX + r], work[DY + r], work[DZ + r] = 0.0, 0.0, 1.0
    else:
        for r in range(count):
            at = first + r
            work[DX + r], work[DY + r], work[DZ + r] = direction[0, at], direction[1, at], direction[2, at]
    for k in range(1, status.shape[0]):
        for r in range(count):
            work[FATE + r] = work[FATE + r] if status[k, first + r] != 0 else 0.0


@njit(error_model="numpy")
def _start_beside(width, first, begin, count, status, path, work):
    """Start the search of a ray at the path extrapolated from the same column of the two rows of rays before.

    Newton's method then needs two steps instead of four.  Rows of `width` rays begin at `first`, rays of this block at
    `begin`.  Steep rays have a start already.
    """
    for r in range(count):
        one, two = begin + r - width, begin + r - 2 * width
        if two >= first and work[S + r] == 0.0 and status[0, one] == 0 and status[0, two] == 0:
            work[S + r] = 2.0 * path[one] - path[two] - work[Z + r]


@njit
def _tilted_screen(tilted, k):
    """Return plane k of `Screens.tilted`; None if all planes are level."""
    if tilted is None:
        return None
    return tilted[k]


@compiled()
def _cross(net, faces, screens, width, position, direction, status, outs, hits, cosine, first, last):
    """Trace rays first … last - 1 to the face and refract or reflect them.

    screens: None, or `Screens` on which rays land.  outs: (screens, 2, n), which receives the landing points; or
    (2, 3, n), which receives hit (mm) and direction behind the face.  hits: one array (n,), which receives the path to
    the face (mm).  status (screens, n) is updated, and cosine (n,) receives the cosine of the angle of
    incidence, if not empty.
    """
    work, active, path = np.empty(CROSSING_WORK), np.empty(BLOCK, np.uint32), hits[0]
    for begin in range(first, last, BLOCK):
        count = min(BLOCK, last - begin)
        load(position, direction, status, begin, count, work)
        if is_axial(direction):
            forward.to_net(faces, count, work)
            forward.search_along_axis(net, faces, count, work)
        else:
            forward.start_search(net, faces, count, work)
            forward.to_net(faces, count, work)
            if width >= BLOCK:  # the rows before are in earlier blocks
                _start_beside(width, first, begin, count, status, path, work)
            forward.search(net, faces, count, work, active)
        forward.at_back(faces, count, work)
        for r in range(count):
            path[begin + r] = work[Z + r] + work[S + r]
        if cosine.size > 0:
            forward.cosines(forward.COS_BACK, count, work)
        if screens is None:
            for r in range(count):
                work[Z + r] = work[S + r] * work[DZ + r]
        if faces.reflects:
            forward.reflect(faces.fates.reflected, count, work)
        else:
            forward.refract(faces.eta, faces.fates.reflected, count, work)
        if cosine.size > 0:
            for r in range(count):
                cosine[begin + r] = work[forward.COS_BACK + r] if work[FATE + r] == 0.0 else 1.0
        if screens is None:
            store(0, count, work, begin, status, outs[0])
            store_directions(count, work, begin, direction, outs)
        else:
            land_on_each(faces, screens, count, work, begin, status, outs)


@njit(error_model="numpy")
def land_on_each(faces, screens, count, work, first, status, outs):
    """Trace rays from the face to each screen, and store where they land."""
    for k in range(screens.throws.size):
        for r in range(count):
            if k == 0:
                work[HIT_X + r], work[HIT_Y + r], work[HIT_FATE + r] = work[X + r], work[Y + r], work[FATE + r]
            else:
                work[X + r], work[Y + r], work[FATE + r] = work[HIT_X + r], work[HIT_Y + r], work[HIT_FATE + r]
        forward.to_screen(faces, screens.throws[k], _tilted_screen(screens.tilted, k), count, work)
        store(k, count, work, first, status, outs[k])


@njit(error_model="numpy")
def store(k, count, work, first, status, out):
    """Store status k and the places of rays first … first + count - 1 in out (2, n); 0 for lost rays."""
    for r in range(count):
        fate = work[FATE + r]
        status[k, first + r] = np.uint8(fate)
        out[0, first + r] = work[X + r] if fate == 0.0 else 0.0
        out[1, first + r] = work[Y + r] if fate == 0.0 else 0.0


@njit(error_model="numpy")
def store_directions(count, work, first, direction, outs):
    """Store the height of the hit and the direction behind the face; a lost ray keeps its direction."""
    hit, behind = outs[0], outs[-1]
    for r in range(count):
        at, alive = first + r, work[FATE + r] == 0.0
        hit[2, at] = work[Z + r] if alive else 0.0
        if alive:
            behind[0, at], behind[1, at], behind[2, at] = work[DX + r], work[DY + r], work[DZ + r]
        elif is_axial(direction):
            behind[0, at], behind[1, at], behind[2, at] = 0.0, 0.0, 1.0
        else:
            behind[0, at], behind[1, at], behind[2, at] = direction[0, at], direction[1, at], direction[2, at]


# --- the adjoint ------------------------------------------------------------------------------------------------------


@njit(error_model="numpy", fastmath={"contract"})
def _restore_hit(net, faces, flat, path, first, count, work):
    """Compute the hit from the path, and there sag, slopes and second derivatives (0 if `flat`) of the face."""
    last_u, last_v = faces.m - 1.0, faces.n - 1.0
    for r in range(count):
        x, y = work[X + r] + path[first + r] * work[DX + r], work[Y + r] + path[first + r] * work[DY + r]
        work[X + r], work[Y + r] = x, y
        work[U + r] = min(max((x - faces.x) * faces.per_x, 0.0), last_u)
        work[V + r] = min(max((y - faces.y) * faces.per_y, 0.0), last_v)
    for r in range(count):
        if work[FATE + r] != 0.0:
            work[U + r] = work[V + r] = 0.0
    if flat:
        for r in range(count):
            h, p, q = sag(net, faces.m, faces.n, work[U + r], work[V + r])
            work[SAG + r], work[SLOPE_X + r], work[SLOPE_Y + r] = h, p * faces.per_x, q * faces.per_y
            work[H_XX + r] = work[H_XY + r] = work[H_YY + r] = 0.0
        return
    for r in range(count):
        h, p, q, hxx, hxy, hyy = curved(net, faces.m, faces.n, work[U + r], work[V + r])
        work[SAG + r], work[SLOPE_X + r], work[SLOPE_Y + r] = h, p * faces.per_x, q * faces.per_y
        work[H_XX + r], work[H_XY + r] = hxx * faces.per_x * faces.per_x, hxy * faces.per_x * faces.per_y
        work[H_YY + r] = hyy * faces.per_y * faces.per_y


@njit(inline="always")
def cosine_behind(eta, cos_in):
    """Return cos θ' of Snell's law; 0 beyond the critical angle, or where rounding makes its square negative."""
    return math.sqrt(max(1.0 - eta * eta * (1.0 - cos_in * cos_in), 0.0))


@njit(error_model="numpy", fastmath={"contract"})
def _leave(faces, count, work):
    """Compute, at the slopes of the hit, the direction behind the face and what the chain rule needs for it."""
    eta = faces.eta
    for r in range(count):
        p, q = work[SLOPE_X + r], work[SLOPE_Y + r]
        dx, dy, dz = work[DX + r], work[DY + r], work[DZ + r]
        along = dz - p * dx - q * dy
        norm2 = 1.0 / (1.0 + p * p + q * q)
        norm = math.sqrt(norm2)
        cos_in = along * norm
        if faces.reflects:
            cos_out, s = cos_in, -2.0 * along * norm2
        else:
            cos_out = cosine_behind(eta, cos_in)
            s = norm * cos_out - eta * along * norm2
        work[NORM + r], work[COS_OUT + r], work[SHIFT + r] = norm, cos_out, s
        work[E_X + r], work[E_Y + r], work[E_Z + r] = eta * dx - s * p, eta * dy - s * q, eta * dz + s


@njit(inline="always")
def _add_gradient(work, r, g, far):
    """Add ∂L/∂hit = g, and ∂L/∂direction = far g, of a ray that goes on by the path `far`."""
    work[G_X + r] += g[0]
    work[G_Y + r] += g[1]
    work[G_Z + r] += g[2]
    work[G_DX + r] += g[0] * far
    work[G_DY + r] += g[1] * far
    work[G_DZ + r] += g[2] * far


@njit(error_model="numpy", fastmath={"contract"})
def _add_tilted(faces, throw, tilted, g, status, first, count, work):
    """Add the gradients of `_add_landing` for a tilted screen.

    The landing moves by u · (dP - e (n · dP) / (n · e)) along each axis u of the screen, n its normal,
    dP = dX + far de (far: path to the screen).
    """
    n_x, n_y, n_z = tilted.n_x, tilted.n_y, tilted.n_z
    for r in range(count):
        at, ex, ey, ez = first + r, work[E_X + r], work[E_Y + r], work[E_Z + r]
        gx, gy = (g[0, at], g[1, at]) if status[at] == 0 else (0.0, 0.0)
        ahead = max(n_x * ex + n_y * ey + n_z * ez, faces.rules.grazing)
        above = n_x * (work[X + r] - tilted.x) + n_y * (work[Y + r] - tilted.y) + n_z * (work[SAG + r] - throw)
        far = -above / ahead
        g_x, g_y = gx * tilted.x_x + gy * tilted.y_x, gx * tilted.x_y + gy * tilted.y_y
        g_z = gx * tilted.x_z + gy * tilted.y_z
        slide = (g_x * ex + g_y * ey + g_z * ez) / ahead
        g_x, g_y, g_z = g_x - slide * n_x, g_y - slide * n_y, g_z - slide * n_z
        _add_gradient(work, r, (g_x, g_y, g_z), far)


@njit(error_model="numpy", fastmath={"contract"})
def _add_directions(tilted, g, status, first, count, work):
    """Add ∂L/∂(direction behind the face) of rays that are collected by their directions (`forward.to_directions`).

    C: with r = hypot(x, y), s = θ / r and θ = atan2(r, z), ds = (dθ - s dr) / r and dθ = z dr - r dz.
    """
    n_z = tilted.n_z
    if tilted.goniometer == 1:
        forward.angles_by_radius(E_X, E_Y, E_Z, n_z, count, work)
        for r in range(count):
            at, ex, ey, ez, s = first + r, work[E_X + r], work[E_Y + r], n_z * work[E_Z + r], work[S + r]
            alive = status[at] == 0
            gx, gy = forward.DEGREES * g[0, at] if alive else 0.0, forward.DEGREES * g[1, at] if alive else 0.0
            along = gx * ex + gy * ey
            by_radius = along * (ez - s) / max(ex * ex + ey * ey, 1e-30)  # ∂L/∂r / r beside that of x and y
            work[G_DX + r] += s * gx + by_radius * ex
            work[G_DY + r] += s * gy + by_radius * ey
            work[G_DZ + r] -= n_z * along
        return
    for r in range(count):
        at, ex, ey, ez = first + r, work[E_X + r], work[E_Y + r], n_z * work[E_Z + r]
        gx, gy = (g[0, at], g[1, at]) if status[at] == 0 else (0.0, 0.0)
        gx, gy = forward.DEGREES * gx, forward.DEGREES * gy
        one, other, g_one, g_other = (ex, ey, gx, gy) if tilted.goniometer == 2 else (ey, ex, gy, gx)
        flat = one * one + ez * ez
        by_one, by_z = g_one * ez / flat, -g_one * one / flat
        by_other = g_other / math.sqrt(max(1.0 - other * other, 1e-12))
        by_x, by_y = (by_one, by_other) if tilted.goniometer == 2 else (by_other, by_one)
        work[G_DX + r] += by_x
        work[G_DY + r] += by_y
        work[G_DZ + r] += n_z * by_z


@njit(error_model="numpy", fastmath={"contract"})
def _add_landing(faces, throw, tilted, g, status, first, count, work):
    """Add ∂L/∂(hit, direction behind the face) of rays that land on a screen; g (2, n): ∂L/∂landing."""
    if tilted is not None:
        if tilted.goniometer > 0:
            _add_directions(tilted, g, status, first, count, work)
        else:
            _add_tilted(faces, throw, tilted, g, status, first, count, work)
        return
    for r in range(count):
        at, ez = first + r, work[E_Z + r]
        gx, gy = (g[0, at], g[1, at]) if status[at] == 0 else (0.0, 0.0)
        ez = min(ez, -faces.rules.grazing) if faces.reflects else max(ez, faces.rules.grazing)
        far = (throw - work[SAG + r]) / ez
        gz = -(work[E_X + r] * gx + work[E_Y + r] * gy) / ez
        _add_gradient(work, r, (gx, gy, gz), far)


@njit(error_model="numpy", fastmath={"contract"})
def _chain(faces, count, work, path, d_rays, first):
    """Replace Z and slopes in `work` by ∂L/∂(sag, slopes in u, v) at the hit, by the chain rule through the face.

    d_rays: None, or (6, n), which receives ∂L/∂(position, direction) of rays first … first + count - 1 before the face.
    path (n,): path to the face (mm).
    """
    eta, min_cos = faces.eta, faces.rules.min_cos
    for r in range(count):
        p, q = work[SLOPE_X + r], work[SLOPE_Y + r]
        dx, dy, dz = work[DX + r], work[DY + r], work[DZ + r]
        norm, cos_out, s = work[NORM + r], work[COS_OUT + r], work[SHIFT + r]
        along, norm2 = dz - p * dx - q * dy, norm * norm
        cos_in = along * norm
        g_x, g_y, g_z = work[G_X + r], work[G_Y + r], work[G_Z + r]
        g_ex, g_ey, g_ez = work[G_DX + r], work[G_DY + r], work[G_DZ + r]
        g_t = g_x * dx + g_y * dy + g_z * dz + work[G_PATH + r]
        g_s = g_ez - p * g_ex - q * g_ey
        # ∂s/∂p with N = norm: in_p = -∂cos_in/∂p = N dx + p N² cos_in, ∂cos_out/∂p = η² cos_in / cos_out ∂cos_in/∂p
        in_p, in_q = norm * dx + p * norm2 * cos_in, norm * dy + q * norm2 * cos_in
        if faces.reflects:  # s = -2 N² along does not depend on cos_out
            turn, s_p, s_q, fall = 0.0, 0.0, 0.0, 2.0 * norm2
        else:
            turn, fall = eta * eta * cos_in / max(cos_out, min_cos), eta * norm2
            s_p, s_q = -norm * (p * norm2 * cos_out + turn * in_p), -norm * (q * norm2 * cos_out + turn * in_q)
        s_p += fall * (2.0 * p * norm2 * along + dx)
        s_q += fall * (2.0 * q * norm2 * along + dy)
        g_p = g_s * s_p - s * g_ex - work[G_COSINE + r] * in_p
        g_q = g_s * s_q - s * g_ey - work[G_COSINE + r] * in_q
        if d_rays is None:
            g_t += g_p * (work[H_XX + r] * dx + work[H_XY + r] * dy) + g_q * (work[H_XY + r] * dx + work[H_YY + r] * dy)
            g_sag = g_t / along
        else:
            t, k, alive = path[first + r], first + r, work[FATE + r] == 0.0
            # outside the net, sag and slopes are constant across its rim
            in_x, in_y = 0.0 < work[U + r] < faces.m - 1.0, 0.0 < work[V + r] < faces.n - 1.0
            by_x = work[H_XX + r] * g_p + work[H_XY + r] * g_q if in_x else 0.0
            by_y = work[H_XY + r] * g_p + work[H_YY + r] * g_q if in_y else 0.0
            rise_x, rise_y = p if in_x else 0.0, q if in_y else 0.0
            g_sag = (g_t + by_x * dx + by_y * dy) / (dz - rise_x * dx - rise_y * dy)
            d_x, d_y, d_z = g_x + by_x + rise_x * g_sag, g_y + by_y + rise_y * g_sag, g_z - g_sag
            # g_n: along n, from s and the cosine; g_d: along d, from the path t |d|
            g_n, g_d = g_s * (norm2 * turn - fall) + work[G_COSINE + r] * norm, t * work[G_PATH + r]
            d_rays[0, k], d_rays[1, k], d_rays[2, k] = (d_x, d_y, d_z) if alive else (0.0, 0.0, 0.0)
            d_rays[3, k] = t * d_x + eta * g_ex - g_n * p + g_d * dx if alive else 0.0
            d_rays[4, k] = t * d_y + eta * g_ey - g_n * q + g_d * dy if alive else 0.0
            d_rays[5, k] = t * d_z + eta * g_ez + g_n + g_d * dz if alive else 0.0
        work[Z + r], work[SLOPE_X + r], work[SLOPE_Y + r] = g_sag, g_p * faces.per_x, g_q * faces.per_y


@njit(error_model="numpy")
def load_gradient(faces, screens, g, more, status, first, count, work):
    """Load ∂L/∂(hit, direction behind the face, path, cosine of incidence); g, more: as in `_cross_adjoint`."""
    if screens is None:
        hit, direction = g[0], g[-1]
        for r in range(count):
            at = first + r
            work[G_X + r], work[G_Y + r], work[G_Z + r] = hit[0, at], hit[1, at], hit[2, at]
            work[G_DX + r], work[G_DY + r], work[G_DZ + r] = direction[0, at], direction[1, at], direction[2, at]
    else:
        work[G_X : G_DZ + BLOCK] = 0.0
        for k in range(screens.throws.size):
            tilted = _tilted_screen(screens.tilted, k)
            _add_landing(faces, screens.throws[k], tilted, g[k], status[k], first, count, work)
    for r in range(count):
        work[G_PATH + r] = more[0, first + r] if more.shape[1] > 0 else 0.0
        work[G_COSINE + r] = more[1, first + r] if more.shape[1] > 0 else 0.0


@compiled()
def _cross_adjoint(net, faces, screens, position, direction, status, hits, g, more, d_rays, first, last, own, touched):
    """Add to own (m, n) the gradient of the merit in the net, from rays first … last - 1 (see reductions.py).

    g: gradients in `outs` of `_cross`, in one array or two.  more: gradients in path and cosine of incidence (2, n), or
    (2, 0).  d_rays: None, or (6, n), which receives the gradient in positions and directions.
    """
    work, path = np.empty(ADJOINT_WORK), hits[0]
    for begin in range(first, last, BLOCK):
        count = min(BLOCK, last - begin)
        load(position, direction, status, begin, count, work)
        flat = d_rays is None and is_axial(direction)  # the slopes at the hit do not change with the path
        _restore_hit(net, faces, flat, path, begin, count, work)
        _leave(faces, count, work)
        load_gradient(faces, screens, g, more, status, begin, count, work)
        _chain(faces, count, work, path, d_rays, begin)
        for r in range(count):
            if work[FATE + r] != 0.0:
                work[Z + r] = work[SLOPE_X + r] = work[SLOPE_Y + r] = 0.0
        u, v, g_h = work[U : U + count], work[V : V + count], work[Z : Z + count]
        scatter(own, touched, u, v, g_h, work[SLOPE_X : SLOPE_X + count], work[SLOPE_Y : SLOPE_Y + count])


class Form(NamedTuple):
    """Kernels for one kind of spline surface."""

    cross: Callable[..., None]  # trace of rays across the face, as `_cross`
    adjoint: Callable[..., None]  # adjoint of `cross`, as `_cross_adjoint`
    hits: int  # number of arrays (n,) that `cross` stores for `adjoint`; the first is the path to the face (mm)
    prepare: Callable[[Rays, Interface], tuple[Rays, Tensor, Any]]  # (rays to be traced, net, face as numbers)
    knows_axis: bool = False  # True if light along the axis needs no directions: their array is (3, 0)


class Crossing(NamedTuple):
    """Parameters of a crossing besides the nets and the rays."""

    form: Form
    faces: Any  # face as numbers; the fields of the front and of a screen are unused
    screens: Screens | None  # screens on which the rays land; None: they go on behind the face
    lossy: bool  # True if the face has losses, which need path and angle of incidence
    width: int  # number of rays in a row of the grid of rays

    @property
    def shapes(self) -> tuple[int, int]:
        """Number of `outs` of `Cross`, and of the components of each."""
        return (2, 3) if self.screens is None else (len(self.screens.throws), 2)


class Cross(torch.autograd.Function):
    """Map (net, position (3, n), direction (3, n), status (n,), crossing) to (status, path, cos θ, *outs).

    net: heights (m, n), or the control points (m, 4 n) of a net in space (mm).  direction: (3, 0) along the axis.
    outs: landing points (2, n) mm for each screen; or, if rays go on, hit (mm) and direction behind the face, (3, n)
    each.  status: (screens, n), or (1, n).  path (n,) to the face (mm) and cos θ (n,) of incidence have a gradient if
    `crossing.lossy`; otherwise cos θ is empty.  The gradient is taken in heights, positions and directions, where
    needed.
    """

    @staticmethod
    def forward(  # noqa: D102
        ctx: Any, net: Tensor, position: Tensor, direction: Tensor, status: Tensor, crossing: Crossing
    ) -> Any:
        n, (count, components) = status.numel(), crossing.shapes
        outs = torch.empty((count, components, n), dtype=torch.float64)
        hits = [torch.empty(n, dtype=torch.float64) for _ in range(crossing.form.hits)]
        cosine = torch.ones(n if crossing.lossy else 0, dtype=torch.float64)
        fate = status.expand(count if crossing.screens else 1, n).clone()
        inputs = [net_of(net), *crossing[1:3], crossing.width, *_doubles([position, direction])]
        results = fate.numpy(), outs.numpy(), _arrays(hits), cosine.numpy()
        cross = crossing.form.cross
        reductions.on_threads(lambda first, last: cross(*inputs, *results, first, last), reductions.shares(n, BLOCK))
        ctx.save_for_backward(net, position, direction, fate, *hits)
        ctx.crossing = crossing
        ctx.mark_non_differentiable(fate, *(() if crossing.lossy else (hits[0], cosine)))
        ctx.set_materialize_grads(False)
        return fate, hits[0], cosine, *outs.to(position.dtype).unbind()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, _: None, g_path: Tensor | None, g_cosine: Tensor | None, *g: Tensor | None) -> Any:  # noqa: D102
        (net, position, direction, fate, *hits), crossing = ctx.saved_tensors, ctx.crossing
        n = hits[0].numel()
        more = np.empty((2, 0))
        if g_path is not None or g_cosine is not None:
            more = np.zeros((2, n))
            for row, part in zip(more, (g_path, g_cosine), strict=True):
                row[:] = 0.0 if part is None else part.numpy()
        d_rays = torch.empty((6, n), dtype=torch.float64) if any(ctx.needs_input_grad[1:3]) else None
        shares = reductions.shares(n, BLOCK)
        owns, ranges = reductions.buffers(len(shares), *net.shape)
        inputs = [net_of(net), *crossing[1:3], *_doubles([position, direction]), fate.numpy(), _arrays(hits)]
        known = _gradients(g, (crossing.shapes[1], n), as_one=crossing.screens is not None)
        inputs += [known, more, None if d_rays is None else d_rays.numpy()]
        tasks = [(*share, own, touched) for share, own, touched in zip(shares, owns, ranges, strict=True)]
        reductions.on_threads(lambda *task: crossing.form.adjoint(*inputs, *task), tasks)
        d_net = torch.from_numpy(reductions.merged(owns, ranges)).to(net.dtype)
        d_position, d_direction = (None, None) if d_rays is None else d_rays.to(position.dtype).split(3)
        return d_net, d_position, d_direction, None, None


def _gradients(g: Sequence[Tensor | None], shape: tuple[int, int], as_one: bool) -> Any:
    """Return gradients of a shape, 0 for None, as float64 arrays, copied only if needed; or as one array of them."""
    known = [torch.zeros(shape, dtype=torch.float64) if each is None else each.double().contiguous() for each in g]
    if not as_one:
        return _arrays(known)
    return (torch.stack(known) if len(known) > 1 else known[0][None]).numpy()


def _arrays(tensors: Sequence[Tensor]) -> tuple[np.ndarray, ...]:
    return tuple(t.detach().numpy() for t in tensors)


def _doubles(tensors: Sequence[Tensor]) -> tuple[np.ndarray, ...]:
    """Return the tensors as float64 arrays; the kernels are compiled for no other type of rays."""
    return _arrays([t.double() for t in tensors])


def prepare_heights(rays: Rays, interface: Interface) -> tuple[Rays, Tensor, Faces]:
    """Return (rays that start below the net, heights (m, n) in the frame of the kernels, face as numbers)."""
    if rays.axial and interface.status_if_missed == Status.MISSED_FRONT:
        rays = _start_below_net(rays, interface)
    heights, (faces, _) = interface.net.heights, kernel_arguments.faces(interface, None, rays.sense, rays.z)
    return rays, -heights if rays.sense < 0 else heights, faces


HEIGHTS = Form(_cross, _cross_adjoint, 1, prepare_heights, knows_axis=True)


def landed(rays: Rays, interface: Interface, planes: Sequence[Receiver], form: Form = HEIGHTS) -> tuple[Landed, ...]:
    """Trace rays across a net to each of the receivers, as `interfaces.cross` and `Receiver.land` do."""
    status, traced, positions = _across(rays, interface, planes, form)
    pairs = zip(positions, status, strict=True)
    return tuple(Landed(position, traced.flux, fate, traced.taken) for position, fate in pairs)


def behind(rays: Rays, interface: Interface, form: Form = HEIGHTS) -> Rays:
    """Trace rays across a net, as `interfaces.cross` does."""
    surface = interface.surface
    _, traced, outs = _across(rays, interface, (), form)
    position, direction = (reflect_z(out, rays.sense) for out in outs)
    sense = -rays.sense if interface.law.reverses else rays.sense
    traced = replace(traced, position=position, direction=direction, z=surface.z, axial=False, sense=sense)
    return replace(traced, chart=surface.chart)


def _across(
    rays: Rays, interface: Interface, planes: Sequence[Receiver], form: Form
) -> tuple[Tensor, Rays, tuple[Tensor, ...]]:
    """Return (status for each plane; rays behind the face, with old positions and directions; `outs` of `Cross`)."""
    shape, lossy = rays.status.shape, bool(interface.losses)
    rays, net, faces = form.prepare(rays, interface)
    given = rays.position, rays.direction
    if rays.axial and form.knows_axis and not any(t.requires_grad for t in given):
        given = rays.position, rays.direction[..., :0]
    vectors = (reflect_z(t, rays.sense).reshape(3, -1).contiguous() for t in given)
    screens = kernel_arguments.screens(interface, planes, rays.sense) if planes else None
    status, path, cos_in, *outs = Cross.apply(
        net, *vectors, rays.status.reshape(-1), Crossing(form, faces, screens, lossy, width=shape[-1]),
    )  # fmt: skip
    status = status.view(len(status), *shape)
    traced = replace(rays, status=status.amin(0) if len(status) > 1 else status[0])  # lost: on none of the planes
    if lossy:
        cos_in, path = cos_in.view(shape), path.view(shape)
        traced = apply_losses(traced, cos_in, interface.law.deflection(cos_in)[1], path=path, losses=interface.losses)
    return status, traced, tuple(out.view(len(out), *shape) for out in outs)


def _start_below_net(rays: Rays, interface: Interface) -> Rays:
    """Move the start of light along the axis to a plane before the whole net.

    The start of such a beam is arbitrary, and interfaces.intersect does not use it.  The kernels only find roots
    ahead of the start, and would lose light where a deep net reaches back beyond this start.
    """
    surface, sense = interface.net, rays.sense
    lowest = net_bounds(surface, torch.float64, sense).lowest
    short = float((sense * rays.above(surface.z)).detach().max()) - lowest
    if not short > 0:
        return rays
    return replace(rays, z=rays.z - sense * short)


def reflect_z(vectors: Tensor, sense: int) -> Tensor:
    """Convert vectors (3, …) to the frame of the kernels, or back: reflect them by z -> -z for light along -z."""
    if sense > 0:
        return vectors
    return vectors * torch.tensor([1.0, 1.0, -1.0], dtype=vectors.dtype).view(-1, *([1] * (vectors.ndim - 1)))
