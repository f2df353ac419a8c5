"""Fused CPU kernels (numba) for radial surfaces: behind `trace.through` and `trace.behind`, and the whole path.

The whole path leads from a lamp through the front (dome_light.py) and the dome to the receiver, as in forward.py.

Rays are processed in blocks as in crossing.py, whose steps behind the face serve here too.  With the ray o + t i, the
point S(x, y) of the surface, f = S - o and the normal n = S_x × S_y, one step of Newton's method is

    δx = S_y · c / (n · i),   δy = -S_x · c / (n · i),   c = f × i,

|c| the distance of S from the ray.  The forward pass stores x and y of each hit (in spacings of the control points).
A hit X = S changes by

    dX = do + t di + i dt,   J (dx, dy, dt) = do + t di - δS,   J = (S_x, S_y, -i),

δ the change by the control points at fixed x and y, and the slopes by dS_x = δS_x + S_xx dx + S_xy dy, dS_y likewise.
The direction behind the face is e = η i + b N, N = n / |n|, b(N · i) by the law.  The adjoint is the transpose of this
map: the gradients α, β and γ in S, S_x and S_y of each ray, which are added to the nine control points of its span, and
the gradients in o and i.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from bstcad.optics.kernels import crossing, dome_light, forward, kernel_arguments
from bstcad.optics.kernels.crossing import (
    ADJOINT_WORK,
    COS_OUT,
    E_X,
    E_Y,
    E_Z,
    G_COSINE,
    G_DX,
    G_DY,
    G_DZ,
    G_PATH,
    G_X,
    G_Y,
    G_Z,
    NORM,
    SHIFT,
)  # fmt: skip
from bstcad.optics.kernels.dome_light import cross_front, launch_from_sphere
from bstcad.optics.kernels.forward import (
    BLOCK,
    COS_BACK,
    DX,
    DY,
    DZ,
    FATE,
    FLUX,
    PATH,
    SAG,
    U,
    V,
    X,
    Y,
    Z,
    to_screen,
)  # fmt: skip
from bstcad.optics.kernels.spline import basis, bend, beyond2, net_of
from bstcad.optics.kernels.wide import add_to_space_span, curved_space_piece, space_piece
from bstcad.optics.lens.interfaces import Interface
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.numerics import reductions
from bstcad.optics.numerics.compiling import compiled
from bstcad.optics.numerics.records import DomeFront, Faces, floats
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces import radial
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.rays import Rays

# Further offsets in `work`: unit normal N; for the adjoint ∂S/∂x, ∂S/∂y and the second derivatives, three components
# each, and ∂L/∂(S, ∂S/∂u, ∂S/∂v), L the merit.
N_X, N_Y, N_Z = (ADJOINT_WORK + BLOCK * k for k in range(3))
S_X, S_Y, S_XX, S_XY, S_YY, ALPHA, BETA, GAMMA = (ADJOINT_WORK + BLOCK * k for k in range(3, 27, 3))
CROSSING_WORK, DOME_WORK = ADJOINT_WORK + 3 * BLOCK, ADJOINT_WORK + 27 * BLOCK  # lengths of `work`


class RadialFace(NamedTuple):
    """Radial surface as numbers, in the frame in which light starts along +z."""

    faces: Faces
    radius: float  # R (mm)
    tolerance: float  # distance from the ray at which the search ends (mm)
    max_step: float  # largest Newton step (mm)
    min_cosine: float  # radial.MIN_COSINE
    newton_steps: float  # radial.NEWTON_STEPS


@njit(inline="always")
def times(p, q):
    """Return the cross product of two vectors."""
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


@njit(inline="always")
def dot(p, q):
    """Return the dot product of two vectors."""
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@njit(inline="always")
def _get(work, offset, r):
    """Return the vector of a ray whose components are stored from `offset` on."""
    return work[offset + r], work[offset + BLOCK + r], work[offset + 2 * BLOCK + r]


@njit(inline="always")
def _set(work, offset, r, vector):
    """Store a vector of a ray."""
    work[offset + r], work[offset + BLOCK + r], work[offset + 2 * BLOCK + r] = vector


@njit(inline="always")
def patch(net, faces, u, v):
    """Return S, ∂S/∂x and ∂S/∂y (mm), relative to the centre, at (u, v); net: `packed`, flattened."""
    i, a0, a2, p0, p2 = basis(u, faces.m)
    j, b0, b2, q0, q2 = basis(v, faces.n)
    per_x, per_y, at, row = faces.per_x, faces.per_y, np.uint64(4 * (i * faces.n + j)), np.uint64(4 * faces.n)
    return space_piece(net, at, row, a0, a2, p0 * per_x, p2 * per_x, b0, b2, q0 * per_y, q2 * per_y)


@njit(error_model="numpy", fastmath={"contract"})
def _start_on_sphere(face, r, work):
    """Start the search of ray r where it leaves the sphere of radius R."""
    faces = face.faces
    o, d = (work[X + r], work[Y + r], work[Z + r]), (work[DX + r], work[DY + r], work[DZ + r])
    middle = dot(o, d)
    path = math.sqrt(max(middle * middle - dot(o, o) + face.radius * face.radius, 0.0)) - middle
    x, y, z = o[0] + path * d[0], o[1] + path * d[1], o[2] + path * d[2]
    scale = 2.0 * face.radius / max(math.sqrt(x * x + y * y + z * z) + z, 1e-300)
    u, v = (scale * x - faces.x) * faces.per_x, (scale * y - faces.y) * faces.per_y
    work[U + r], work[V + r] = clamped(u, faces.m - 1.0), clamped(v, faces.n - 1.0)


@njit(inline="always")
def clamped(u, last):
    """Return u in [0, last]; 0 for a u that is not a number."""
    return min(u if u > 0.0 else 0.0, last)


@njit(error_model="numpy")
def _start(face, width, first, begin, count, status, hits, work, active):
    """Start the search of rays, and return the number of those that search; `active` receives them.

    A ray starts at the hits extrapolated from the same column of the two rows of rays before, if there are such hits:
    Newton's method then evaluates the surface three times instead of five.  PATH receives 1 for these rays.
    """
    faces, (_, u, v) = face.faces, hits
    searching = 0
    for r in range(count):
        work[Z + r] -= faces.gap
        one, two = begin + r - width, begin + r - 2 * width
        work[U + r] = work[V + r] = work[PATH + r] = 0.0
        if work[FATE + r] != 0.0:
            continue
        if width >= BLOCK and two >= first and status[0, one] == 0 and status[0, two] == 0:
            work[U + r] = clamped(2.0 * u[one] - u[two], faces.m - 1.0)
            work[V + r] = clamped(2.0 * v[one] - v[two], faces.n - 1.0)
            work[PATH + r] = 1.0
        else:
            _start_on_sphere(face, r, work)
        active[searching] = r
        searching += 1
    return searching


@njit(error_model="numpy", fastmath={"contract"})
def _search(net, face, searching, work, active):
    """Find the hits by Newton steps of all rays in turn, as `RadialSurface.meet` does; return the number not found.

    `work` receives u, v, normal and cosine of incidence of each hit, and the hit itself instead of the ray's start,
    with Z its height over the centre, too, and the path to it in PATH.  `active` receives the rays that are not found.
    """
    faces = face.faces
    last_u, last_v = faces.m - 1.0, faces.n - 1.0
    tolerance2, floor = face.tolerance * face.tolerance, 1e-12
    for _ in range(int(face.newton_steps)):
        remaining = 0
        for a in range(searching):
            r = active[a]
            o, d = (work[X + r], work[Y + r], work[Z + r]), (work[DX + r], work[DY + r], work[DZ + r])
            s, s_x, s_y = patch(net, faces, work[U + r], work[V + r])
            f = (s[0] - o[0], s[1] - o[1], s[2] - o[2])
            c, n, ahead = times(f, d), times(s_x, s_y), dot(f, d)
            outward, norm2 = dot(n, d), dot(n, n)
            steep = outward > face.min_cosine * math.sqrt(norm2)
            by = 1.0 / (outward if abs(outward) > floor else floor)
            x, y = dot(s_y, c) * by, -dot(s_x, c) * by
            u, v = work[U + r] + x * faces.per_x, work[V + r] + y * faces.per_y
            if (dot(c, c) <= tolerance2) & (ahead >= -face.tolerance) & steep:
                norm = 1.0 / math.sqrt(norm2)
                work[U + r], work[V + r] = clamped(u, last_u), clamped(v, last_v)
                _set(work, N_X, r, (n[0] * norm, n[1] * norm, n[2] * norm))
                work[COS_BACK + r], work[PATH + r] = outward * norm, ahead
                work[X + r] = s[0] + x * s_x[0] + y * s_y[0]
                work[Y + r] = s[1] + x * s_x[1] + y * s_y[1]
                work[Z + r] = work[SAG + r] = s[2] + x * s_x[2] + y * s_y[2]
                continue
            length = math.sqrt(x * x + y * y)
            if length > face.max_step:
                x, y = x * (face.max_step / length), y * (face.max_step / length)
                u, v = work[U + r] + x * faces.per_x, work[V + r] + y * faces.per_y
            work[U + r], work[V + r] = clamped(u, last_u), clamped(v, last_v)
            active[remaining] = r
            remaining += 1
        searching = remaining
    return searching


@njit(error_model="numpy")
def _at_dome(net, face, searching, count, work, active):
    """Move rays to the surface; lose those that do not meet it, or meet it outside its aperture."""
    faces = face.faces
    lost = _search(net, face, searching, work, active)
    again = 0
    for a in range(lost):
        r = active[a]
        if work[PATH + r] == 1.0:  # the extrapolated start may have misled the search
            _start_on_sphere(face, r, work)
            active[again] = r
            again += 1
        else:
            work[FATE + r] = faces.fates.missed_back
    lost = _search(net, face, again, work, active)
    for a in range(lost):
        work[FATE + active[a]] = faces.fates.missed_back
    for r in range(count):
        x, y = faces.x + work[U + r] / faces.per_x, faces.y + work[V + r] / faces.per_y
        inside = beyond2(x, y, faces.limit_x, faces.limit_y) <= faces.limit_r2
        fate = work[FATE + r]
        work[FATE + r] = fate if inside | (fate != 0.0) else faces.fates.missed_back


@njit(error_model="numpy", fastmath={"contract"})
def _deflect(faces, count, work):
    """Refract or reflect rays at the normals in `work`, as `interfaces.deflect` does."""
    eta = faces.eta
    for r in range(count):
        cos_in = work[COS_BACK + r]
        cos_out = crossing.cosine_behind(eta, cos_in)
        b = -2.0 * cos_in if faces.reflects else cos_out - eta * cos_in
        work[DX + r] = eta * work[DX + r] + b * work[N_X + r]
        work[DY + r] = eta * work[DY + r] + b * work[N_Y + r]
        work[DZ + r] = eta * work[DZ + r] + b * work[N_Z + r]
        fate = work[FATE + r]
        work[FATE + r] = fate if (cos_out > 0.0) | (fate != 0.0) else faces.fates.reflected


@compiled()
def _cross(net, face, screens, width, position, direction, status, outs, hits, cosine, first, last):
    """Trace rays as `crossing._cross` does; net: `packed`, flattened; hits: path (mm), and u and v of each hit."""
    work, active, faces = np.zeros(CROSSING_WORK), np.empty(BLOCK, np.uint32), face.faces
    path, hit_u, hit_v = hits
    for begin in range(first, last, BLOCK):
        count = min(BLOCK, last - begin)
        crossing.load(position, direction, status, begin, count, work)
        searching = _start(face, width, first, begin, count, status, hits, work, active)
        _at_dome(net, face, searching, count, work, active)
        for r in range(count):
            path[begin + r], hit_u[begin + r], hit_v[begin + r] = work[PATH + r], work[U + r], work[V + r]
        _deflect(faces, count, work)
        if cosine.size > 0:
            for r in range(count):
                cosine[begin + r] = work[COS_BACK + r] if work[FATE + r] == 0.0 else 1.0
        if screens is None:
            crossing.store(0, count, work, begin, status, outs[0])
            crossing.store_directions(count, work, begin, direction, outs)
        else:
            crossing.land_on_each(faces, screens, count, work, begin, status, outs)


# --- the adjoint ------------------------------------------------------------------------------------------------------


@njit(error_model="numpy", fastmath={"contract"})
def _restore_hit(net, faces, hits, first, count, work):
    """Compute hit, normal and derivatives of the surface from u and v."""
    m, n, per_x, per_y = faces.m, faces.n, faces.per_x, faces.per_y
    row = np.uint64(4 * n)
    for r in range(count):
        u, v = hits[1][first + r], hits[2][first + r]
        if work[FATE + r] != 0.0:
            u = v = 0.0
        work[U + r], work[V + r] = u, v
        i, a0, a2, p0, p2 = basis(u, m)
        j, b0, b2, q0, q2 = basis(v, n)
        s, s_x, s_y, s_xx, s_xy, s_yy = curved_space_piece(
            net, np.uint64(4 * (i * n + j)), row, a0, a2, p0 * per_x, p2 * per_x, b0, b2, q0 * per_y, q2 * per_y,
            bend(u, m) * per_x * per_x, bend(v, n) * per_y * per_y,
        )  # fmt: skip
        work[X + r], work[Y + r], work[SAG + r] = s
        _set(work, S_X, r, s_x)
        _set(work, S_Y, r, s_y)
        _set(work, S_XX, r, s_xx)
        _set(work, S_XY, r, s_xy)
        _set(work, S_YY, r, s_yy)


@njit(error_model="numpy", fastmath={"contract"})
def _leave(faces, count, work):
    """Compute the direction behind the face and what the chain rule needs for it."""
    eta = faces.eta
    for r in range(count):
        d = (work[DX + r], work[DY + r], work[DZ + r])
        n = times(_get(work, S_X, r), _get(work, S_Y, r))
        norm = 1.0 / math.sqrt(dot(n, n))
        n = (n[0] * norm, n[1] * norm, n[2] * norm)
        cos_in = dot(n, d)
        cos_out = crossing.cosine_behind(eta, cos_in)
        b = -2.0 * cos_in if faces.reflects else cos_out - eta * cos_in
        _set(work, N_X, r, n)
        work[NORM + r], work[COS_BACK + r], work[COS_OUT + r], work[SHIFT + r] = norm, cos_in, cos_out, b
        work[E_X + r], work[E_Y + r], work[E_Z + r] = (
            eta * d[0] + b * n[0],
            eta * d[1] + b * n[1],
            eta * d[2] + b * n[2],
        )


@njit(error_model="numpy", fastmath={"contract"})
def _chain(faces, count, work, path, d_rays, first):
    """Store ∂L/∂(S, ∂S/∂u, ∂S/∂v) by the chain rule through the face; d_rays and path: as in crossing.py."""
    eta, min_cos = faces.eta, faces.rules.min_cos
    for r in range(count):
        alive = work[FATE + r] == 0.0
        d, n = (work[DX + r], work[DY + r], work[DZ + r]), _get(work, N_X, r)
        s_x, s_y = _get(work, S_X, r), _get(work, S_Y, r)
        s_xx, s_xy, s_yy = _get(work, S_XX, r), _get(work, S_XY, r), _get(work, S_YY, r)
        g_s = (work[G_X + r], work[G_Y + r], work[G_Z + r])
        g_e = (work[G_DX + r], work[G_DY + r], work[G_DZ + r])
        norm, cos_in, b = work[NORM + r], work[COS_BACK + r], work[SHIFT + r]
        by_cosine = -2.0 if faces.reflects else eta * eta * cos_in / max(work[COS_OUT + r], min_cos) - eta  # db/dcos θ
        g_cos = dot(g_e, n) * by_cosine + work[G_COSINE + r]
        # ∂L/∂(S_x × S_y) from g = ∂L/∂N, which counts across N only
        g = (b * g_e[0] + g_cos * d[0], b * g_e[1] + g_cos * d[1], b * g_e[2] + g_cos * d[2])
        along = dot(g, n)
        g = ((g[0] - along * n[0]) * norm, (g[1] - along * n[1]) * norm, (g[2] - along * n[2]) * norm)
        beta, gamma = times(s_y, g), times(g, s_x)
        g_x = dot(beta, s_xx) + dot(gamma, s_xy)
        g_y = dot(beta, s_xy) + dot(gamma, s_yy)
        g_t = dot(g_s, d) + work[G_PATH + r]
        # α = -J^-T (g_x, g_y, g_t), the columns of J^-T: S_y × i, i × S_x and -n, divided by n · i
        by, out = norm / cos_in, 1.0 / cos_in
        p, q = times(d, s_y), times(s_x, d)
        alpha = (
            (g_x * p[0] + g_y * q[0]) * by + g_t * n[0] * out,
            (g_x * p[1] + g_y * q[1]) * by + g_t * n[1] * out,
            (g_x * p[2] + g_y * q[2]) * by + g_t * n[2] * out,
        )
        if d_rays is not None:
            k, t = first + r, path[first + r]
            far = t * work[G_PATH + r]
            for c in range(3):
                g_o = g_s[c] - alpha[c]
                d_rays[c, k] = g_o if alive else 0.0
                d_rays[3 + c, k] = t * g_o + eta * g_e[c] + g_cos * n[c] + far * d[c] if alive else 0.0
        per_x, per_y = (faces.per_x, faces.per_y) if alive else (0.0, 0.0)
        _set(work, ALPHA, r, alpha if alive else (0.0, 0.0, 0.0))
        _set(work, BETA, r, (beta[0] * per_x, beta[1] * per_x, beta[2] * per_x) if alive else (0.0, 0.0, 0.0))
        _set(work, GAMMA, r, (gamma[0] * per_y, gamma[1] * per_y, gamma[2] * per_y) if alive else (0.0, 0.0, 0.0))


@njit(error_model="numpy", fastmath={"contract"})
def _scatter(faces, count, work, own, touched):
    """Add ∂L/∂(S, ∂S/∂u, ∂S/∂v) of rays to the nine control points of their spans; own (m, 4 n): see reductions.py."""
    m, n = faces.m, faces.n
    for r in range(count):
        if work[FATE + r] != 0.0:
            continue
        i, a0, a2, p0, p2 = basis(work[U + r], m)
        j, b0, b2, q0, q2 = basis(work[V + r], n)
        reductions.clear(own, touched, i, i + 3)
        add_to_space_span(
            own, np.uint64(4 * (i * n + j)), np.uint64(4 * n), a0, a2, p0, p2, b0, b2, q0, q2,
            _get(work, ALPHA, r), _get(work, BETA, r), _get(work, GAMMA, r),
        )  # fmt: skip


@compiled()
def _cross_adjoint(net, face, screens, position, direction, status, hits, g, more, d_rays, first, last, own, touched):
    """Add to own (m, 4 n) the gradient in the control points (see crossing.py)."""
    work, faces = np.empty(DOME_WORK), face.faces
    for begin in range(first, last, BLOCK):
        count = min(BLOCK, last - begin)
        crossing.load(position, direction, status, begin, count, work)
        _restore_hit(net, faces, hits, begin, count, work)
        _leave(faces, count, work)
        crossing.load_gradient(faces, screens, g, more, status, begin, count, work)
        _chain(faces, count, work, hits[0], d_rays, begin)
        _scatter(faces, count, work, own, touched)


def prepare(rays: Rays, interface: Interface) -> tuple[Rays, Tensor, RadialFace]:
    """Return (the rays, `packed` control points, face as numbers)."""
    points, face = _as_numbers(interface)
    faces, _ = kernel_arguments.faces(interface, None, rays.sense, rays.z)
    return rays, points, face._replace(faces=faces)


def _as_numbers(interface: Interface) -> tuple[Tensor, RadialFace]:
    """Return the `packed` control points, and the face as numbers."""
    surface = interface.surface
    assert isinstance(surface, RadialSurface)
    faces, _ = kernel_arguments.faces(interface, None, 1, surface.z)
    tolerance = radial.ROOT_TOLERANCE * torch.finfo(torch.float64).eps * surface.radius
    search = floats(
        radius=surface.radius, tolerance=tolerance, max_step=radial.MAX_STEP * surface.radius,
        min_cosine=radial.MIN_COSINE, newton_steps=radial.NEWTON_STEPS,
    )  # fmt: skip
    return packed(surface), RadialFace(faces=faces, **search)


def packed(surface: RadialSurface) -> Tensor:
    """Return the control points (mm) relative to the centre, differentiable: (m, 4 n), (x, y, z, 0) of each."""
    directions = torch.nn.functional.pad(surface.directions.movedim(0, -1), (0, 1))
    return ((surface.radius + surface.heights.double())[..., None] * directions).flatten(1)


# --- the whole path ---------------------------------------------------------------------------------------------------


class DomeFaces(NamedTuple):
    """Front and dome as numbers."""

    dome: RadialFace
    front: DomeFront


@njit
def _trace(net, light, both, tilted, losses, count, work, active, rows):
    """Trace rays through points of the chart to the screen as `forward._trace` does.

    rows: (2, 3, count) u, v and 1 (0: no hit) of the same columns in the last row but one and in the last row of rays,
    from which a hit is extrapolated; it receives the last row and this one.  None: there are no such rows.
    """
    face = both.dome
    launch_from_sphere(light, count, work)
    cross_front(both.front, count, work)
    searching = 0
    for r in range(count):
        work[U + r] = work[V + r] = work[PATH + r] = 0.0
        if (work[FATE + r] == 0.0) & (work[FLUX + r] > 0.0):
            known = False
            if rows is not None:
                known = rows[0, 2, r] * rows[1, 2, r] == 1.0
                if known:
                    work[U + r] = clamped(2.0 * rows[1, 0, r] - rows[0, 0, r], face.faces.m - 1.0)
                    work[V + r] = clamped(2.0 * rows[1, 1, r] - rows[0, 1, r], face.faces.n - 1.0)
                    work[PATH + r] = 1.0
            if not known:
                _start_on_sphere(face, r, work)
            active[searching] = r
            searching += 1
    _at_dome(net, face, searching, count, work, active)
    if rows is not None:
        for r in range(count):
            met = (work[FATE + r] == 0.0) & (work[FLUX + r] > 0.0)
            for k in range(3):
                rows[0, k, r] = rows[1, k, r]
            rows[1, 0, r], rows[1, 1, r], rows[1, 2, r] = work[U + r], work[V + r], 1.0 if met else 0.0
    _deflect(face.faces, count, work)
    to_screen(face.faces, face.faces.throw, tilted, count, work)


@compiled()
def _rows(net, light, both, tilted, losses, cells, pixels, first, step, box, tent, lines):
    """Simulate a part of the light as `forward._rows` does."""
    work, active, part = np.zeros(CROSSING_WORK), np.empty(BLOCK, np.uint32), np.empty(forward.LINES)
    rows = np.zeros((2, 3, cells.n))
    for i in range(first, cells.n, step):
        for j in range(0, cells.n, BLOCK):
            count = min(BLOCK, cells.n - j)
            forward.points(cells, i, j, count, work)
            _trace(net, light, both, tilted, losses, count, work, active, rows[:, :, j : j + count])
            part[:] = 0.0
            if losses.present:
                forward.dim(both.dome.faces, losses, count, work, part)
            forward.count_rays(pixels, count, work, box, tent, part)
            for k in range(forward.LINES):
                lines[k] += part[k]


@compiled()
def _rays(net, light, both, tilted, losses, x, y, landing, flux, fate):
    """Store landing (2, n), flux and fate of the rays through given points (n,) of the chart."""
    work, active = np.zeros(CROSSING_WORK), np.empty(BLOCK, np.uint32)
    for first in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - first)
        for r in range(count):
            work[X + r], work[Y + r] = x[first + r], y[first + r]
        _trace(net, light, both, tilted, losses, count, work, active, None)
        for r in range(count):
            landing[0, first + r], landing[1, first + r] = work[X + r], work[Y + r]
            flux[first + r], fate[first + r] = work[FLUX + r], np.uint8(work[FATE + r])


def _scene(source: Emitter, lens: Lens, receiver: Receiver) -> forward.Scene:
    """Return net, light, faces and tilted screen for the kernels."""
    *front, last = lens.interfaces
    net, face = _as_numbers(last)
    faces, tilted = kernel_arguments.faces(last, receiver, 1, last.surface.z)
    first = dome_light.front_of(front, last.surface.z)
    both = DomeFaces(face._replace(faces=faces._replace(front_eta=first.face.eta)), first)
    return net_of(net), kernel_arguments.beam(source, lens), both, tilted


PATHS = forward.Form(_rows, _rays, _scene)
simulate, land = partial(forward.simulate, form=PATHS), partial(forward.land, form=PATHS)
RADIAL = crossing.Form(_cross, _cross_adjoint, 3, prepare)
landed, behind = partial(crossing.landed, form=RADIAL), partial(crossing.behind, form=RADIAL)
