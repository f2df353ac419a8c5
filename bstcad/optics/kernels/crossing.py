"""Fused CPU kernels (numba) behind `trace.through` and `trace.behind`: rays across a spline face, and the adjoint.

Rays are processed in blocks (forward.py).  The forward pass stores each ray's path to the face; the adjoint computes
hit and slopes from this path again.

With the ray x + t d, the face's slopes p and q and normal n = (-p, -q, 1), the hit X (where z = sag) changes by

    dX = dx + t dd + d dt,   dt = (δsag - n · (dx + t dd)) / (n · d),   dp = δp + S_xx dX_x + S_xy dX_y, dq likewise,

δ the change by the heights at fixed x and y, S_xx … the sag's second derivatives.  The direction behind the face is
e = η d + s n, s(p, q, n · d) by the law.  The adjoint is the transpose of this map, for the net and, if needed, x, d.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from bstcad.optics.interfaces import Interface, apply_losses, net_bounds
from bstcad.optics.kernels import forward, kernel_arguments, reductions
from bstcad.optics.kernels.compiling import compiled
from bstcad.optics.kernels.forward import BLOCK, DX, DY, DZ, FATE, FLUX, SAG, SLOPE_X, SLOPE_Y, WORK, S, U, V, X, Y, Z
from bstcad.optics.kernels.records import Faces, TiltedScreen
from bstcad.optics.kernels.spline import curved, net_of, sag, scatter
from bstcad.optics.rays import Landed, Rays, Status
from bstcad.optics.receivers import Receiver

# Further offsets in `work` for the adjoint: ∂L/∂(landing, or hit and direction), ∂L/∂(path, cosine of incidence), and
# second derivatives of the sag; L: merit.
G_X, G_Y, G_PATH, G_COSINE, H_XX, H_XY, H_YY, G_Z, G_DX, G_DY, G_DZ = (WORK + BLOCK * k for k in range(11))
ADJOINT_WORK = WORK + 11 * BLOCK  # length of `work` for the adjoint


@njit(error_model="numpy")
def _load(position, direction, status, first, count, work):
    for r in range(count):
        at = first + r
        work[X + r], work[Y + r], work[Z + r] = position[0, at], position[1, at], position[2, at]
        work[DX + r], work[DY + r], work[DZ + r] = direction[0, at], direction[1, at], direction[2, at]
        work[FATE + r], work[FLUX + r] = status[at], 1.0


@njit(error_model="numpy")
def _start_beside(width, first, begin, count, status, path, work):
    """Start the search of a ray at the path extrapolated from the same column of the two rows of rays before.

    Newton's method then needs two steps instead of four.  Rows of `width` rays begin at `first`, rays of this block at
    `begin`.  Steep rays have a start already.
    """
    for r in range(count):
        one, two = begin + r - width, begin + r - 2 * width
        if two >= first and work[S + r] == 0.0 and status[one] == 0 and status[two] == 0:
            work[S + r] = 2.0 * path[one] - path[two] - work[Z + r]


@compiled()
def _cross(net, faces, tilted, lands, width, position, direction, status, out, path, cosine, first, last):
    """Trace rays first … last - 1 to the face and refract or reflect them.

    If lands is True, out (2, n) receives the landing points (mm); if None, out (6, n) receives hit (mm) and direction
    behind the face.  path (n,) receives the path to the face (mm), status (n,) is updated, and cosine (n,) receives the
    cosine of the angle of incidence, if it is not empty.
    """
    work, active = np.empty(WORK), np.empty(BLOCK, np.uint32)
    for begin in range(first, last, BLOCK):
        count = min(BLOCK, last - begin)
        _load(position, direction, status, begin, count, work)
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
        if lands is None:
            for r in range(count):
                work[Z + r] = work[S + r] * work[DZ + r]
        if faces.reflects:
            forward.reflect(faces.fates.reflected, count, work)
        else:
            forward.refract(faces.eta, faces.fates.reflected, count, work)
        if lands is not None:
            forward.to_screen(faces, tilted, count, work)
        for r in range(count):
            fate = work[FATE + r]
            status[begin + r] = np.uint8(fate)
            out[0, begin + r] = work[X + r] if fate == 0.0 else 0.0
            out[1, begin + r] = work[Y + r] if fate == 0.0 else 0.0
            if cosine.size > 0:
                cosine[begin + r] = work[forward.COS_BACK + r] if fate == 0.0 else 1.0
        if lands is None:
            _store_directions(count, work, begin, direction, out)


@njit(error_model="numpy")
def _store_directions(count, work, first, direction, out):
    """Store the height of the hit and the direction behind the face; a lost ray keeps its direction."""
    for r in range(count):
        at, alive = first + r, work[FATE + r] == 0.0
        out[2, at] = work[Z + r] if alive else 0.0
        out[3, at] = work[DX + r] if alive else direction[0, at]
        out[4, at] = work[DY + r] if alive else direction[1, at]
        out[5, at] = work[DZ + r] if alive else direction[2, at]


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
def _at_level(faces, at, e, h, gx, gy):
    """Return the gradients of the merit in (direction behind the face, hit, path) for rays that land on a level screen.

    The slopes of the face are constant; the path moves the hit along the ray.  at: x and y of the hit (mm), a zero, and
    direction before the face; e: direction behind it; h: sag (mm); gx, gy: gradient in the landing point.
    """
    ex, ey, ez = e
    ez = min(ez, -faces.rules.grazing) if faces.reflects else max(ez, faces.rules.grazing)
    a, b, far = ex / ez, ey / ez, (faces.throw - h) / ez
    g_t = gx * (at[3] - a * at[5]) + gy * (at[4] - b * at[5])
    return (gx * far, gy * far, -(a * gx + b * gy) * far), (gx, gy, -(a * gx + b * gy)), g_t


@njit(inline="always")
def _at_tilted(faces, tilted, at, e, h, gx, gy):
    """Return the gradients of `_at_level` for a tilted screen.

    The landing moves by u · (dP - e (n · dP) / (n · e)) along each axis u of the screen, n its normal,
    dP = dX + far de (far: path to the screen).
    """
    ex, ey, ez = e
    n_x, n_y, n_z = tilted.n_x, tilted.n_y, tilted.n_z
    ahead = max(n_x * ex + n_y * ey + n_z * ez, faces.rules.grazing)
    far = -(n_x * (at[0] - tilted.x) + n_y * (at[1] - tilted.y) + n_z * (h - faces.throw)) / ahead
    g_x, g_y = gx * tilted.x_x + gy * tilted.y_x, gx * tilted.x_y + gy * tilted.y_y
    g_z = gx * tilted.x_z + gy * tilted.y_z
    slide = (g_x * ex + g_y * ey + g_z * ez) / ahead
    g_x, g_y, g_z = g_x - slide * n_x, g_y - slide * n_y, g_z - slide * n_z
    return (g_x * far, g_y * far, g_z * far), (g_x, g_y, g_z), g_x * at[3] + g_y * at[4] + g_z * at[5]


@njit(inline="always")
def _behind_face(at, work, r):
    """Return the gradients of `_at_level` for rays that do not land: `work` contains ∂L/∂hit and ∂L/∂direction."""
    g_x, g_y, g_z = work[G_X + r], work[G_Y + r], work[G_Z + r]
    g_e = (work[G_DX + r], work[G_DY + r], work[G_DZ + r])
    return g_e, (g_x, g_y, g_z), g_x * at[3] + g_y * at[4] + g_z * at[5]


@njit(error_model="numpy", fastmath={"contract"})
def _chain(faces, tilted, lands, count, work, path, d_rays, first):
    """Replace Z and slopes in `work` by ∂L/∂(sag, slopes in u, v) at the hit, by the chain rule from screen to hit.

    d_rays: None, or (6, n), which receives ∂L/∂(position, direction) of rays first … first + count - 1 before the face.
    path (n,): path to the face (mm).
    """
    eta, min_cos = faces.eta, faces.rules.min_cos
    for r in range(count):
        p, q, h = work[SLOPE_X + r], work[SLOPE_Y + r], work[SAG + r]
        dx, dy, dz = work[DX + r], work[DY + r], work[DZ + r]
        along = dz - p * dx - q * dy
        norm2 = 1.0 / (1.0 + p * p + q * q)
        norm = math.sqrt(norm2)
        cos_in = along * norm
        if faces.reflects:
            cos_out, s = cos_in, -2.0 * along * norm2
        else:
            cos_out = math.sqrt(max(1.0 - eta * eta * (1.0 - cos_in * cos_in), 0.0))  # rounding may make it negative
            s = norm * cos_out - eta * along * norm2
        at, e = (work[X + r], work[Y + r], 0.0, dx, dy, dz), (eta * dx - s * p, eta * dy - s * q, eta * dz + s)
        if lands is None:
            (g_ex, g_ey, g_ez), g_hit, g_t = _behind_face(at, work, r)
        elif tilted is None:
            (g_ex, g_ey, g_ez), g_hit, g_t = _at_level(faces, at, e, h, work[G_X + r], work[G_Y + r])
        else:
            (g_ex, g_ey, g_ez), g_hit, g_t = _at_tilted(faces, tilted, at, e, h, work[G_X + r], work[G_Y + r])
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
        g_t += work[G_PATH + r]
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
            d_x, d_y, d_z = g_hit[0] + by_x + rise_x * g_sag, g_hit[1] + by_y + rise_y * g_sag, g_hit[2] - g_sag
            # g_n: along n, from s and the cosine; g_d: along d, from the path t |d|
            g_n, g_d = g_s * (norm2 * turn - fall) + work[G_COSINE + r] * norm, t * work[G_PATH + r]
            d_rays[0, k], d_rays[1, k], d_rays[2, k] = (d_x, d_y, d_z) if alive else (0.0, 0.0, 0.0)
            d_rays[3, k] = t * d_x + eta * g_ex - g_n * p + g_d * dx if alive else 0.0
            d_rays[4, k] = t * d_y + eta * g_ey - g_n * q + g_d * dy if alive else 0.0
            d_rays[5, k] = t * d_z + eta * g_ez + g_n + g_d * dz if alive else 0.0
        work[Z + r], work[SLOPE_X + r], work[SLOPE_Y + r] = g_sag, g_p * faces.per_x, g_q * faces.per_y


@njit(error_model="numpy")
def _load_gradient(lands, g, more, first, count, work):
    for r in range(count):
        work[G_X + r], work[G_Y + r] = g[0, first + r], g[1, first + r]
    if lands is None:
        for r in range(count):
            at = first + r
            work[G_Z + r], work[G_DX + r], work[G_DY + r], work[G_DZ + r] = g[2, at], g[3, at], g[4, at], g[5, at]
    for r in range(count):
        work[G_PATH + r] = more[0, first + r] if more.shape[1] > 0 else 0.0
        work[G_COSINE + r] = more[1, first + r] if more.shape[1] > 0 else 0.0


@compiled()
def _cross_adjoint(
    net, faces, tilted, lands, position, direction, status, path, g, more, d_rays, first, last, own, touched
):
    """Add to `own` (m, n) the gradient of the merit in the net, from rays first … last - 1 (see reductions.py).

    g: gradient in `out` of `_cross`.  more: gradients in path and cosine of incidence (2, n), or (2, 0).  d_rays: None,
    or (6, n), which receives the gradient in positions and directions.
    """
    work = np.empty(ADJOINT_WORK)
    for begin in range(first, last, BLOCK):
        count = min(BLOCK, last - begin)
        _load(position, direction, status, begin, count, work)
        _load_gradient(lands, g, more, begin, count, work)
        flat = d_rays is None and forward.are_axial(count, work)  # the slopes at the hit do not change with the path
        _restore_hit(net, faces, flat, path, begin, count, work)
        _chain(faces, tilted, lands, count, work, path, d_rays, begin)
        for r in range(count):
            if work[FATE + r] != 0.0:
                work[Z + r] = work[SLOPE_X + r] = work[SLOPE_Y + r] = 0.0
        u, v, g_h = work[U : U + count], work[V : V + count], work[Z : Z + count]
        scatter(own, touched, u, v, g_h, work[SLOPE_X : SLOPE_X + count], work[SLOPE_Y : SLOPE_Y + count])


class Crossing(NamedTuple):
    """Parameters of a crossing besides the net and the rays."""

    faces: Faces  # face, and screen if rays land, as numbers; the fields of the front are unused
    tilted: TiltedScreen | None  # tilted screen; None: a level screen, or none
    lands: bool  # True if rays land on the screen, False if they go on behind the face
    lossy: bool  # True if the face has losses, which need path and angle of incidence
    width: int  # number of rays in a row of the grid of rays

    @property
    def arguments(self) -> tuple[Faces, TiltedScreen | None, bool | None]:
        """Arguments of the kernels; `lands` is True or None: for the type of None numba compiles no unused branch."""
        return self.faces, self.tilted, True if self.lands else None


class Cross(torch.autograd.Function):
    """Map (heights, position (3, n), direction (3, n), status (n,), crossing) to (out, status, path, cos θ).

    out: landing points (2, n) mm; or, if rays go on, hit (mm) and direction behind the face (6, n).  path (n,) to
    the face (mm) and cos θ (n,) of incidence have a gradient if `crossing.lossy`; otherwise cos θ is empty.  The
    gradient is taken in heights, positions and directions, where needed.
    """

    @staticmethod
    def forward(  # noqa: D102
        ctx: Any, heights: Tensor, position: Tensor, direction: Tensor, status: Tensor, crossing: Crossing
    ) -> Any:
        n = status.numel()
        out = torch.empty((2 if crossing.lands else 6, n), dtype=position.dtype)
        path, cosine = torch.empty(n, dtype=torch.float64), torch.ones(n if crossing.lossy else 0, dtype=torch.float64)
        fate = status.clone()
        inputs = [net_of(heights), *crossing.arguments, crossing.width]
        inputs += [t.detach().numpy() for t in (position, direction)]
        results = [t.numpy() for t in (fate, out, path, cosine)]
        reductions.on_threads(lambda first, last: _cross(*inputs, *results, first, last), reductions.shares(n, BLOCK))
        ctx.save_for_backward(heights, position, direction, fate, path)
        ctx.crossing = crossing
        ctx.mark_non_differentiable(fate, *(() if crossing.lossy else (path, cosine)))
        ctx.set_materialize_grads(False)
        return out, fate, path, cosine

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g: Tensor | None, _: None, g_path: Tensor | None, g_cosine: Tensor | None) -> Any:  # noqa: D102
        heights, position, direction, fate, path = ctx.saved_tensors
        n, lands = fate.numel(), ctx.crossing.lands
        g = torch.zeros((2 if lands else 6, n), dtype=position.dtype) if g is None else g.contiguous()
        more = np.empty((2, 0))
        if g_path is not None or g_cosine is not None:
            more = np.zeros((2, n))
            for row, part in zip(more, (g_path, g_cosine), strict=True):
                row[:] = 0.0 if part is None else part.numpy()
        d_rays = torch.empty((6, n), dtype=position.dtype) if any(ctx.needs_input_grad[1:3]) else None
        shares = reductions.shares(n, BLOCK)
        buffers = reductions.buffers(len(shares), *heights.shape)
        inputs = [net_of(heights), *ctx.crossing.arguments]
        inputs += [t.detach().numpy() for t in (position, direction, fate, path, g)]
        inputs += [more, None if d_rays is None else d_rays.numpy()]
        tasks = [(*share, own, rows) for share, own, rows in zip(shares, *buffers, strict=True)]
        reductions.on_threads(lambda *task: _cross_adjoint(*inputs, *task), tasks)
        d_position, d_direction = (None, None) if d_rays is None else (d_rays[:3], d_rays[3:])
        return torch.from_numpy(reductions.merged(*buffers)).to(heights.dtype), d_position, d_direction, None, None


def landed(rays: Rays, interface: Interface, plane: Receiver) -> Landed:
    """Trace rays across a net to the receiver, as `interfaces.cross` and `Receiver.land` do."""
    position, traced = _across(rays, interface, plane)
    return Landed(position, traced.flux, traced.status, traced.taken)


def behind(rays: Rays, interface: Interface) -> Rays:
    """Trace rays across a net, as `interfaces.cross` does."""
    out, traced = _across(rays, interface, None)
    position, direction = reflect_z(out, rays.sense).split(3)
    sense = -rays.sense if interface.law.reverses else rays.sense
    return replace(traced, position=position, direction=direction, z=interface.surface.z, axial=False, sense=sense)


def _across(rays: Rays, interface: Interface, plane: Receiver | None) -> tuple[Tensor, Rays]:
    """Return (`out` of `Cross`, rays with flux and status behind the face but their old position and direction)."""
    shape, heights, lossy = rays.status.shape, interface.net.heights, bool(interface.losses)
    if rays.axial and interface.status_if_missed == Status.MISSED_FRONT:
        rays = _start_below_net(rays, interface)
    vectors = (reflect_z(t, rays.sense).reshape(3, -1).contiguous() for t in (rays.position, rays.direction))
    faces, width = kernel_arguments.faces(interface, plane, rays.sense, rays.z), shape[-1]
    crossing = Crossing(*faces, plane is not None, lossy, width)
    out, status, path, cos_in = Cross.apply(
        -heights if rays.sense < 0 else heights, *vectors, rays.status.reshape(-1), crossing
    )
    traced = replace(rays, status=status.view(shape))
    if lossy:
        cos_in, path = cos_in.view(shape), path.view(shape)
        traced = apply_losses(traced, cos_in, interface.law.deflection(cos_in)[1], path=path, losses=interface.losses)
    return out.view(len(out), *shape), traced


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
    """Convert vectors (3 k, …) to the frame of the kernels, or back: reflect them by z -> -z for light along -z."""
    if sense > 0:
        return vectors
    flip = torch.tensor([1.0, 1.0, -1.0] * (len(vectors) // 3), dtype=vectors.dtype)
    return vectors * flip.view(-1, *([1] * (vectors.ndim - 1)))
