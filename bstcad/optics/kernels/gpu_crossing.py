"""Kernels (Warp) behind `trace.through` on a GPU: rays across a spline face to level screens, and the adjoint.

One thread computes a ray, by the equations and the names of crossing.py.  The adjoint gives each ray its derivatives in
the sag and the slopes of the face at its hit; a second kernel adds them to the nine control points around the hit.
These sums are integers of 64 bits, which no order of the threads changes, so that a GPU repeats a design to the last
bit.

A tilted screen, losses, and rays that have gradients themselves (behind another freeform face) are left to plain torch.
The source runs on a CPU, too, where tests compare it with the plain form.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from bstcad.optics.kernels import kernel_arguments
from bstcad.optics.kernels.crossing import prepare_heights, reflect_z
from bstcad.optics.kernels.warp_launch import launch
from bstcad.optics.lens.interfaces import Interface
from bstcad.optics.numerics.records import Faces
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces.rays import Landed, Rays

LARGEST = 2.0**62  # largest integer of a sum

wp.set_module_options({"enable_backward": False, "fuse_fp": False})
F = wp.float64
Basis = wp.types.vector(length=5, dtype=wp.float64)  # (B_k, B_{k+2}, -dB_k/du, dB_{k+2}/du, d²B_k/du²)
Six = wp.types.vector(length=6, dtype=wp.float64)


@wp.struct
class Face:
    """Fields of `records.Faces` of the same names, its rules, and its statuses of lost rays."""

    m: wp.int32
    n: wp.int32
    reflects: wp.int32
    newton_steps: wp.int32
    approach_steps: wp.int32
    missed: wp.int32
    blocked: wp.int32
    turned: wp.int32
    eta: wp.float64
    gap: wp.float64
    x: wp.float64
    y: wp.float64
    per_x: wp.float64
    per_y: wp.float64
    limit_x: wp.float64
    limit_y: wp.float64
    limit_r2: wp.float64
    steepest_x: wp.float64
    steepest_y: wp.float64
    lowest: wp.float64
    tolerance: wp.float64
    near: wp.float64
    side_exit: wp.float64
    min_derivative: wp.float64
    tangency: wp.float64
    min_cos: wp.float64
    grazing: wp.float64


# --- the spline at one point ------------------------------------------------------------------------------------------


@wp.func
def first_of(u: wp.float64, m: int) -> int:
    """Return the number of the first control point of the span of u, in spacings (`spline.basis`)."""
    if u < F(1.5):
        return 0
    if u <= F(m) - F(2.5):
        return int(u - F(0.5))
    return m - 3


@wp.func
def basis_at(u: wp.float64, m: int) -> Basis:
    """Return the basis at u (`spline.basis`, `spline.bend`); B_{k+1} = 1 - B_k - B_{k+2}."""
    if u >= F(1.5) and u <= F(m) - F(2.5):
        s = u - F(0.5) - F(int(u - F(0.5)))
        q = F(1.0) - s
        return Basis(F(0.5) * q * q, F(0.5) * s * s, q, s, F(1.0))
    k, s = int(0), F(2.0) - wp.sqrt(F(4.0) - F(2.0) * u)
    if u >= F(1.5):
        k = m - 3
        s = wp.sqrt(F(4.0) - F(2.0) * (F(m - 1) - u)) - F(1.0)
    q, a, b = F(1.0) - s, F(0.5), F(0.5)
    if k == 0:
        a = F(1.0)
    if k == m - 3:
        b = F(1.0)
    r = F(1.0) / (a * q + b * s)
    return Basis(a * q * q, b * s * s, a * q * r, b * s * r, F(0.5) * a * b * r * r * r)


@wp.func
def row(net: wp.array2d(dtype=wp.float64), i: int, j: int, b: Basis) -> wp.vec3d:
    """Return value, slope and second derivative along v of the control points (i, j) to (i, j + 2)."""
    low, high = net[i, j + 1] - net[i, j], net[i, j + 2] - net[i, j + 1]
    return wp.vec3d(net[i, j + 1] - b[0] * low + b[1] * high, b[2] * low + b[3] * high, b[4] * (high - low))


@wp.func
def curved(net: wp.array2d(dtype=wp.float64), face: Face, u: wp.float64, v: wp.float64) -> Six:
    """Return (h, ∂h/∂u, ∂h/∂v, ∂²h/∂u², ∂²h/∂u∂v, ∂²h/∂v²) (`spline.curved`)."""
    i, j = first_of(u, face.m), first_of(v, face.n)
    a, b = basis_at(u, face.m), basis_at(v, face.n)
    f0, f1, f2 = row(net, i, j, b), row(net, i + 1, j, b), row(net, i + 2, j, b)
    low, high = f1 - f0, f2 - f1
    at, along = f1 - a[0] * low + a[1] * high, a[2] * low + a[3] * high
    return Six(at[0], along[0], at[1], a[4] * (high[0] - low[0]), along[1], at[2])


# --- rays -------------------------------------------------------------------------------------------------------------


@wp.func
def first_root(net: wp.array2d(dtype=wp.float64), face: Face, p: wp.vec3d, d: wp.vec3d) -> wp.vec2d:
    """Return (s, 1 if found): path (mm) of a steep ray to its first crossing; p: start above the net's plane."""
    last_u, last_v, floor = F(face.m - 1), F(face.n - 1), face.min_derivative
    u, v = (p[0] - face.x) * face.per_x, (p[1] - face.y) * face.per_y
    u_s, v_s = d[0] * face.per_x, d[1] * face.per_y
    rate = wp.abs(d[2]) + face.steepest_x * wp.abs(d[0]) + face.steepest_y * wp.abs(d[1])
    s, below = F(0.0), F(0.0)
    arrived = bool(False)
    for step in range(face.approach_steps + face.newton_steps):
        a, b = u + s * u_s, v + s * v_s
        h = curved(net, face, wp.clamp(a, F(0.0), last_u), wp.clamp(b, F(0.0), last_v))
        residual, slope = p[2] + s * d[2] - h[0], d[2] - h[1] * u_s - h[2] * v_s
        if arrived:
            if wp.abs(residual) <= face.tolerance:
                if wp.abs(s - below) <= face.near / floor:
                    return wp.vec2d(s, F(1.0))
                return wp.vec2d(s, F(0.0))
            s -= residual / with_floor(slope, floor)
        else:
            left = (a > last_u and u_s > F(0.0)) or (a < F(0.0) and u_s < F(0.0))
            left = left or (b > last_v and v_s > F(0.0)) or (b < F(0.0) and v_s < F(0.0))
            left = left or (p[2] + s * d[2] < face.lowest and d[2] <= F(0.0))
            if left or step >= face.approach_steps or (step == 0 and not residual < F(0.0)):
                return wp.vec2d(s, F(0.0))
            arrived, below = residual >= -face.near, s
            s -= residual / rate
    return wp.vec2d(s, F(0.0))


@wp.func
def with_floor(slope: wp.float64, floor: wp.float64) -> wp.float64:
    """Return a derivative of at least `floor`, whose sign is kept."""
    if wp.abs(slope) >= floor:
        return slope
    if slope < F(0.0):
        return -floor
    return floor


@wp.func
def is_out(u: wp.float64, last: wp.float64) -> bool:
    """Return True if u is no number from 0 to `last`."""
    return not (u >= F(0.0) and u <= last)


@wp.func
def beyond2(face: Face, x: wp.float64, y: wp.float64) -> wp.float64:
    """Return what `spline.beyond2` does, for the face's clear aperture."""
    p, q = wp.max(wp.abs(x) - face.limit_x, F(0.0)), wp.max(wp.abs(y) - face.limit_y, F(0.0))
    return p * p + q * q


@wp.func
def behind(face: Face, d: wp.vec3d, p: wp.float64, q: wp.float64) -> wp.vec4d:
    """Return the direction e behind the face for its slopes, and s with e = η d + s n; e = 0 if no light goes on."""
    norm2 = F(1.0) / (F(1.0) + p * p + q * q)
    along = d[2] - p * d[0] - q * d[1]
    cos2 = F(1.0) - face.eta * face.eta * (F(1.0) - along * along * norm2)
    if face.reflects == 1:
        cos2 = F(1.0)
    if not (cos2 > F(0.0) and along > F(0.0)):
        return wp.vec4d(F(0.0), F(0.0), F(0.0), F(0.0))
    eta, s = F(face.eta), wp.sqrt(cos2 * norm2) - face.eta * along * norm2
    if face.reflects == 1:
        eta, s = F(1.0), F(-2.0) * along * norm2
    return wp.vec4d(eta * d[0] - s * p, eta * d[1] - s * q, eta * d[2] + s, s)


@wp.kernel
def cross(
    net: wp.array2d(dtype=wp.float64), face: Face, throws: wp.array(dtype=wp.float64),
    position: wp.array2d(dtype=wp.float64), direction: wp.array2d(dtype=wp.float64),
    status: wp.array2d(dtype=wp.uint8), path: wp.array(dtype=wp.float64), landed: wp.array3d(dtype=wp.float64),
):  # fmt: skip
    """Trace rays to the face, refract or reflect them, and let them land; landed: (screens, 2, n), 0 for lost rays.

    status (screens, n) is updated; path (n,) receives the path to the face (mm).
    """
    r = wp.tid()
    fate = int(status[0, r])
    d = wp.vec3d(direction[0, r], direction[1, r], direction[2, r])
    start = (face.gap - position[2, r]) / d[2]
    s = F(0.0)
    steep = not (d[2] > face.steepest_x * wp.abs(d[0]) + face.steepest_y * wp.abs(d[1]))
    if steep and fate == 0:
        above = wp.vec3d(position[0, r], position[1, r], position[2, r] - face.gap)
        root = first_root(net, face, above, d)
        s = root[0] + above[2] / d[2]
        if not (root[1] > F(0.0) and wp.abs(d[2]) > face.side_exit):
            fate = face.missed
    x, y = position[0, r] + start * d[0], position[1, r] + start * d[1]
    u, v = (x - face.x) * face.per_x, (y - face.y) * face.per_y
    u_s, v_s = d[0] * face.per_x, d[1] * face.per_y
    last_u, last_v = F(face.m - 1), F(face.n - 1)
    h = Six()
    searching = fate == 0
    steps = int(0)
    while searching:
        a, b = u + s * u_s, v + s * v_s
        h = curved(net, face, wp.clamp(a, F(0.0), last_u), wp.clamp(b, F(0.0), last_v))
        residual, slope = s * d[2] - h[0], d[2] - h[1] * u_s - h[2] * v_s
        if is_out(a, last_u):  # outside the net the sag is constant across the rim
            slope += h[1] * u_s
        if is_out(b, last_v):
            slope += h[2] * v_s
        s -= residual / with_floor(slope, face.min_derivative)
        steps += 1
        searching = not wp.abs(residual) <= face.tolerance
        if searching and steps == face.newton_steps and not (d[0] == F(0.0) and d[1] == F(0.0)):
            fate = face.missed
        searching = searching and steps < face.newton_steps
    x, y = x + s * d[0], y + s * d[1]
    p, q = h[1] * face.per_x, h[2] * face.per_y
    met = beyond2(face, x, y) <= face.limit_r2 and start + s >= -face.tolerance
    met = met and wp.abs(d[2] - p * d[0] - q * d[1]) > face.tangency
    if fate == 0 and not met:
        fate = face.missed
    path[r] = start + s
    out = behind(face, d, p, q)
    if fate == 0 and out[0] == F(0.0) and out[1] == F(0.0) and out[2] == F(0.0):
        fate = face.blocked
    sense = F(1.0)
    if face.reflects == 1:
        sense = F(-1.0)
    for k in range(throws.shape[0]):
        ends = fate
        if fate == 0 and not sense * out[2] > face.grazing:
            ends = face.turned
        status[k, r] = wp.uint8(ends)
        if ends == 0:
            far = (throws[k] - h[0]) / out[2]
            landed[k, 0, r] = x + far * out[0]
            landed[k, 1, r] = y + far * out[1]


# --- the adjoint ------------------------------------------------------------------------------------------------------


@wp.kernel
def cross_adjoint(
    net: wp.array2d(dtype=wp.float64), face: Face, throws: wp.array(dtype=wp.float64),
    position: wp.array2d(dtype=wp.float64), direction: wp.array2d(dtype=wp.float64),
    status: wp.array2d(dtype=wp.uint8), path: wp.array(dtype=wp.float64), g: wp.array3d(dtype=wp.float64),
    place: wp.array2d(dtype=wp.float64), own: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Set place (2, n), u and v of each hit, and own (3, n), ∂L/∂(sag, slope in u, slope in v) there (`_chain`).

    g (screens, 2, n): ∂L/∂landing.
    """
    r = wp.tid()
    alive = bool(False)
    for k in range(throws.shape[0]):
        alive = alive or int(status[k, r]) == 0
    if not alive:
        return
    d = wp.vec3d(direction[0, r], direction[1, r], direction[2, r])
    x, y = position[0, r] + path[r] * d[0], position[1, r] + path[r] * d[1]
    u = wp.clamp((x - face.x) * face.per_x, F(0.0), F(face.m - 1))
    v = wp.clamp((y - face.y) * face.per_y, F(0.0), F(face.n - 1))
    h = curved(net, face, u, v)
    p, q = h[1] * face.per_x, h[2] * face.per_y
    h_xx, h_xy = h[3] * face.per_x * face.per_x, h[4] * face.per_x * face.per_y
    h_yy = h[5] * face.per_y * face.per_y
    e = behind(face, d, p, q)
    g_hit, g_out = wp.vec3d(), wp.vec3d()
    for k in range(throws.shape[0]):
        if int(status[k, r]) == 0:
            e_z = wp.max(e[2], face.grazing)
            if face.reflects == 1:
                e_z = wp.min(e[2], -face.grazing)
            far = (throws[k] - h[0]) / e_z
            by_place = wp.vec3d(g[k, 0, r], g[k, 1, r], -(e[0] * g[k, 0, r] + e[1] * g[k, 1, r]) / e_z)
            g_hit += by_place
            g_out += far * by_place
    norm2 = F(1.0) / (F(1.0) + p * p + q * q)
    norm = wp.sqrt(norm2)
    along = d[2] - p * d[0] - q * d[1]
    cos_in, s = along * norm, e[3]
    g_s = g_out[2] - p * g_out[0] - q * g_out[1]
    s_p, s_q, fall = F(0.0), F(0.0), F(2.0) * norm2
    if face.reflects == 0:
        cos_out = wp.sqrt(wp.max(F(1.0) - face.eta * face.eta * (F(1.0) - cos_in * cos_in), F(0.0)))
        turn = face.eta * face.eta * cos_in / wp.max(cos_out, face.min_cos)
        in_p, in_q = norm * d[0] + p * norm2 * cos_in, norm * d[1] + q * norm2 * cos_in
        s_p, s_q = -norm * (p * norm2 * cos_out + turn * in_p), -norm * (q * norm2 * cos_out + turn * in_q)
        fall = face.eta * norm2
    g_p = g_s * (s_p + fall * (F(2.0) * p * norm2 * along + d[0])) - s * g_out[0]
    g_q = g_s * (s_q + fall * (F(2.0) * q * norm2 * along + d[1])) - s * g_out[1]
    g_t = wp.dot(g_hit, d) + g_p * (h_xx * d[0] + h_xy * d[1]) + g_q * (h_xy * d[0] + h_yy * d[1])
    place[0, r] = u
    place[1, r] = v
    own[0, r] = g_t / along
    own[1, r] = g_p * face.per_x
    own[2, r] = g_q * face.per_y


@wp.kernel
def scatter(
    face: Face, place: wp.array2d(dtype=wp.float64), own: wp.array2d(dtype=wp.float64), units: wp.float64,
    sums: wp.array2d(dtype=wp.int64),
):  # fmt: skip
    """Add `own` of each hit to the nine control points around it, the transpose of `curved`."""
    r = wp.tid()
    if own[0, r] == F(0.0) and own[1, r] == F(0.0) and own[2, r] == F(0.0):
        return
    i, j = first_of(place[0, r], face.m), first_of(place[1, r], face.n)
    a, b = basis_at(place[0, r], face.m), basis_at(place[1, r], face.n)
    at_u, by_u = wp.vec3d(a[0], F(1.0) - a[0] - a[1], a[1]), wp.vec3d(-a[2], a[2] - a[3], a[3])
    at_v, by_v = wp.vec3d(b[0], F(1.0) - b[0] - b[1], b[1]), wp.vec3d(-b[2], b[2] - b[3], b[3])
    for k in range(3):
        flat, tilted = at_u[k] * own[0, r] + by_u[k] * own[1, r], at_u[k] * own[2, r]
        for n in range(3):
            term = at_v[n] * flat + by_v[n] * tilted
            wp.atomic_add(sums, i + k, j + n, wp.int64(wp.round(term * units)))


class CrossAndLand(torch.autograd.Function):
    """Map (heights (m, n), rays, face, throws) to (status (screens, k), landed (screens, 2, k)).

    rays: position (3, k), direction (3, k) and status (1, k).  throws: distances from the net's plane to the level
    screens (mm).  The gradient is taken in the heights.
    """

    @staticmethod
    def forward(  # noqa: D102
        ctx: Any, heights: Tensor, rays: tuple[Tensor, Tensor, Tensor], face: Any, throws: Tensor
    ) -> Any:
        (position, direction, status), screens = rays, len(throws)
        count = status.numel()
        fate = status.expand(screens, count).contiguous()
        path = torch.zeros(count, dtype=torch.float64, device=heights.device)
        landed = torch.zeros((screens, 2, count), dtype=torch.float64, device=heights.device)
        launch(cross, [count], heights.detach(), face, throws, position, direction, fate, path, landed)
        ctx.save_for_backward(heights, position, direction, fate, path, throws)
        ctx.face = face
        ctx.mark_non_differentiable(fate)
        return fate, landed

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, _: None, g: Tensor) -> Any:  # noqa: D102
        heights, position, direction, fate, path, throws = ctx.saved_tensors
        count, face = path.numel(), ctx.face
        place, own = (torch.zeros((k, count), dtype=torch.float64, device=heights.device) for k in (2, 3))
        rays = throws, position, direction, fate, path
        launch(cross_adjoint, [count], heights.detach(), face, *rays, g.contiguous(), place, own)
        largest = 4.0 * max(float(own.abs().max()), 1e-300)  # of a term, whose three parts have weights of at most 1
        units = LARGEST / (count * largest)
        sums = torch.zeros(heights.shape, dtype=torch.int64, device=heights.device)
        launch(scatter, [count], face, place, own, units, sums)
        return sums.double() / units, None, None, None


def landed(rays: Rays, interface: Interface, planes: Sequence[Receiver]) -> tuple[Landed, ...] | None:
    """Trace rays across a net to each receiver, as `interfaces.cross` and `Receiver.land` do; None: not supported."""
    if interface.losses or any(t.requires_grad for t in (rays.position, rays.direction)):
        return None
    screens = kernel_arguments.screens(interface, planes, rays.sense)
    if screens.tilted is not None:
        return None
    rays, net, faces = prepare_heights(rays, interface)
    position, direction = (
        reflect_z(t.double(), rays.sense).reshape(3, -1).contiguous() for t in (rays.position, rays.direction)
    )
    throws = torch.from_numpy(screens.throws).to(net.device)
    heights, status = net.double().contiguous(), rays.status.reshape(1, -1)
    fate, places = CrossAndLand.apply(heights, (position, direction, status), _face(faces), throws)
    shape = rays.status.shape
    return tuple(
        Landed(place.view(2, *shape).to(rays.position.dtype), rays.flux, each.view(shape), rays.taken)
        for place, each in zip(places, fate, strict=True)
    )


def _face(faces: Faces) -> Any:
    """Return a face for the kernels."""
    face = Face()
    rules, fates = faces.rules, faces.fates
    for name in Face.vars:
        record = next((each for each in (faces, rules) if name in each._fields), None)
        if record is not None:
            value = getattr(record, name)
            setattr(face, name, int(value) if name.endswith("_steps") else value)
    face.missed, face.blocked, face.turned = int(fates.missed_back), int(fates.reflected), int(fates.turned)
    return face
