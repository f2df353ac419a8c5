"""Optical interfaces: the surfaces at which light is refracted or reflected.

An interface is a surface, the outline inside which it lies, and a law: refraction between two media, or reflection.
`cross` moves rays to an interface and through it.  The laws are implemented here once in plain torch; a lens is an
ordered sequence of interfaces (lens.py), and every trace walks that sequence.

A ray meets a spline at the root of F(s) = z(s) - sag(x(s), y(s)) (mm), s the path along the ray (mm).  The signs are
those of light along +z, which comes from below the face, where F < 0; for light along -z (`Rays.sense`) F, d_z and
all heights change their sign.  F' = d_z - ∇sag · (d_x, d_y), and no slope of the face exceeds that of the steepest leg
of its control net.  If this bound keeps F' positive, the ray crosses the face once, and Newton's method finds the
crossing.  Any other ray is *steep* to the face and may cross it several times.  Light leaves the glass at the first
crossing, so the search approaches this crossing in steps too short to pass it, before Newton's method takes over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from bstcad.optics.surfaces.bspline import BSplineSurface, is_net, require_net
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.rays import Rays, Status
from bstcad.optics.surfaces.surfaces import Surface

MIN_COS_REFRACTION = 1e-3  # lower bound of cos θ' in the gradient of Snell's law (see `Refract`)
TANGENCY_TOLERANCE = 1e-6  # largest |F'| at which a ray counts as tangent to the surface and does not meet it
NEWTON_STEPS = 20  # maximum number of Newton steps, after which a ray misses; a smooth lens needs 3 to 5
APPROACH_STEPS = 200  # maximum number of steps of the approach, after which a ray misses the face
SIDE_EXIT_COSINE = 1e-2  # largest |d_z| at which a steep ray counts as leaving through a side of the lens
MIN_NEWTON_DERIVATIVE = 1e-3  # lower bound of |F'| as the divisor of a Newton step; its sign is kept
STEPS_BEFORE_RIM_CHECK = 3  # Newton steps before rays outside the net are identified; most rays then have converged
APPROACH_DISTANCE = 1e-5  # distance below the face at which an approach ends, as a fraction of the net's half width


@dataclass(frozen=True)
class Refract:
    """Snell's law as vectors: d' = η d + (cos θ' - η cos θ) N, η = n_in / n_out, N the unit normal along the light.

    cos² θ' = 1 - η² (1 - cos² θ) <= 0 means total internal reflection; rays that meet the surface from behind
    (cos θ <= 0) also count as totally reflected.  Neither has a gradient.  The gradient of the other rays grows towards
    the critical angle as d cos θ' = (η² cos θ / cos θ') d cos θ.  It is capped there: in this derivative, and nowhere
    else, cos θ' is at least MIN_COS_REFRACTION.
    """

    n_in: float  # refractive index before the interface
    n_out: float  # refractive index behind the interface

    status_if_blocked = Status.TOTAL_REFLECTION  # status of rays that cannot go on
    reverses = False  # True if the light reverses its sense along z

    @property
    def eta(self) -> float:
        """Return η = n_in / n_out, the factor of the incident direction in the refracted direction."""
        return self.n_in / self.n_out

    def deflection(self, cos_in: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (a, cos θ', blocked): the new direction is η d + a N; blocked is True where no light goes on."""
        eta = self.eta
        cos2 = 1 - eta * eta * (1 - cos_in * cos_in)
        total = cos2 <= 0
        cos_out = _capped_root(torch.where(total, torch.ones_like(cos2), cos2))
        return cos_out - eta * cos_in, cos_out, total | (cos_in <= 0)


@dataclass(frozen=True)
class Reflect:
    """Law of reflection: d' = d - 2 cos θ N, N the unit normal along the light; rays from behind are lost."""

    eta = 1.0
    status_if_blocked = Status.TURNED_BACK
    reverses = True

    def deflection(self, cos_in: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (a, cos θ', blocked): the new direction is d + a N."""
        return -2 * cos_in, cos_in, cos_in <= 0


def _capped_root(cos2: Tensor) -> Tensor:
    """Return cos = sqrt(cos²) > 0, with the derivative 1 / (2 max(cos, MIN_COS_REFRACTION))."""
    cos = torch.sqrt(cos2.detach())
    return cos + (cos2 - cos2.detach()) / (2 * cos.clamp(min=MIN_COS_REFRACTION))


Law = Refract | Reflect
Normal = tuple[Tensor, Tensor, Tensor]  # components of a normal, not of unit length


class Loss(Protocol):
    """Loss of a ray's flux at an interface, or on the path to it (losses.py)."""

    line: str  # line of the ledger under which the lost flux is counted
    in_glass: bool  # True if the loss acts on the path to the interface, False if at the interface
    fused: bool  # True if kernels apply it: exp(-coefficient · path) in glass, a function of the angle at an interface

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """Return the transmitted fraction for cosines of incidence and refraction, and a path before the face (mm)."""


@dataclass(frozen=True)
class Interface:
    """One surface on the path of the light, with its clear aperture, law and losses."""

    surface: Surface  # surface that the light meets
    outline: Outline  # clear aperture; light that meets the surface outside it is lost
    law: Law
    status_if_missed: Status  # status of rays that do not meet the surface inside the outline
    losses: tuple[Loss, ...] = ()  # losses in the order in which light meets them; (): no losses

    @property
    def net(self) -> BSplineSurface:
        """Surface of a tailored interface; TypeError if it is not a net."""
        return require_net(self.surface)


@dataclass(frozen=True)
class Hit:
    """Rays that have crossed an interface; the cosines are valid for alive rays."""

    rays: Rays  # rays on the surface, with their new directions
    cos_in: Tensor  # cosine of the angle of incidence
    cos_out: Tensor  # cosine of the angle of refraction or reflection


def cross(rays: Rays, interface: Interface) -> Hit:
    """Trace rays to an interface and through it: refract or reflect rays that meet it inside the outline."""
    at, normal = intersect(interface.surface, rays, interface.outline, interface.status_if_missed)
    return leave(rays, interface, at, normal)


def leave(rays: Rays, interface: Interface, at: Rays, normal: Normal) -> Hit:
    """Refract or reflect rays at an interface, with its losses.  at, normal: see `intersect`; rays: those before it."""
    hit = deflect(at, normal, interface.law, level=interface.surface.level)
    if not interface.losses:
        return hit
    path = _path(rays, hit.rays)
    return replace(hit, rays=apply_losses(hit.rays, hit.cos_in, hit.cos_out, path, losses=interface.losses))


def apply_losses(rays: Rays, cos_in: Tensor, cos_out: Tensor, path: Tensor, losses: Sequence[Loss]) -> Rays:
    """Return rays behind an interface after its losses; path: length of the ray in front of it (mm).

    Only rays that go on lose flux.  The flux of a lost ray is counted whole, under its status.
    """
    goes_on, flux, taken = rays.alive, rays.flux, dict(rays.taken)
    one = torch.ones_like(cos_in)
    cos_in, cos_out, path = (torch.where(goes_on, t, one) for t in (cos_in, cos_out, path))
    for loss in losses:
        left = flux * torch.where(goes_on, loss.share(cos_in, cos_out, path), one)
        taken[loss.line] = taken.get(loss.line, 0) + (flux - left)
        flux = left
    return replace(rays, flux=flux, taken=taken)


def _path(before: Rays, behind: Rays) -> Tensor:
    """Return the path length between two positions of the same rays (mm); √3 for lost rays."""
    end = torch.stack([*behind.position[:2], behind.above(before.z)])
    step = torch.where(behind.alive, end - before.position, torch.ones_like(end))  # the root of zero has no gradient
    return torch.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])


def deflect(at: Rays, normal: Normal, law: Law, level: bool = False) -> Hit:
    """Refract or reflect rays at a surface with this normal (see `intersect`).  level: it is a plane z = const."""
    n_x, n_y, n_z = normal
    if at.axial and level:  # normal incidence
        one = torch.ones_like(n_x)
        return Hit(replace(at, direction=-at.direction, sense=-at.sense) if law.reverses else at, one, one)
    norm = torch.rsqrt(n_z * n_z + n_x * n_x + n_y * n_y)
    dx, dy, dz = torch.where(at.alive, at.direction, torch.ones_like(at.direction))
    along = n_z * dz + n_x * dx + n_y * dy
    cos_in = (along if at.sense > 0 else -along) * norm
    eta, (bend, cos_out, stopped) = law.eta, law.deflection(cos_in)
    shift = bend * norm if at.sense > 0 else -bend * norm
    direction = torch.stack([eta * dx + shift * n_x, eta * dy + shift * n_y, eta * dz + shift * n_z])
    status = at.lose(stopped, law.status_if_blocked)
    direction = torch.where(status == Status.ALIVE, direction, at.direction.detach())
    sense = -at.sense if law.reverses else at.sense
    return Hit(replace(at, direction=direction, status=status, axial=False, sense=sense), cos_in, cos_out)


def intersect(surface: Surface, rays: Rays, outline: Outline, missed: Status) -> tuple[Rays, Normal]:
    """Move the rays to the surface; those that do not meet it inside the outline are lost with the status `missed`.

    F(s) = z(s) - sag(x(s), y(s)) = 0.  The root is found without gradient; then one differentiable Newton step,
    s = s* - F(s*) / F'(s*) with constant F', adds the implicit gradient ds = -dF / F' (Wang, C. 2022 after Griewank).
    The path s is measured from the base plane z = surface.z.  It is then as short as the sag, so that neither a distant
    source nor a scene far from its origin loses digits.

    Returns rays at the surface and its normal there, along +z or outward, not of unit length: (-∂z/∂x, -∂z/∂y, 1) of a
    height field.
    """
    if isinstance(surface, RadialSurface):
        met = surface.meet(rays)
        before = torch.stack([*rays.position[:2], rays.above(surface.z)])
        ok = met.found & outline.contains(met.x, met.y)
        at = replace(rays, position=torch.where(ok, met.position, before), z=surface.z, status=rays.lose(~ok, missed))
        n_x, n_y, n_z = met.normal
        return replace(at, axial=False, chart=surface.chart), (n_x, n_y, n_z)
    if rays.axial:  # closed form: the hit is (x, y, sag)
        x, y, _ = rays.position
        h, z_x, z_y = surface.relative_sag_and_slope(x, y)
        status = rays.lose(~(surface.reaches(x, y) & outline.contains(x, y)), missed)
        return replace(rays, position=torch.stack([x, y, h]), z=surface.z, status=status), normal_of(z_x, z_y)

    start, s, meets = _plane_and_root(surface, rays)
    before = torch.stack([*rays.position[:2], rays.above(surface.z)])
    if surface.level:  # the root lies on the base plane
        ok = meets & (rays.direction[2].abs() > TANGENCY_TOLERANCE)
        status = rays.lose(~(ok & outline.contains(start[0], start[1])), missed)
        at = replace(rays, position=torch.where(ok, start, before), z=surface.z, status=status)
        return at, normal_of(torch.zeros_like(s), torch.zeros_like(s))
    # double where: a ray without a root takes no step, and its values reach no gradient of other rays
    x, y, z = torch.where(meets, start + s * rays.direction, torch.zeros_like(start))
    h, z_x, z_y = surface.relative_sag_and_slope(x, y)
    dx, dy, dz = rays.direction.detach()
    net = surface if is_net(surface) else None
    ok = meets & ((dz - z_x.detach() * dx - z_y.detach() * dy).abs() > TANGENCY_TOLERANCE)
    rise_x, rise_y = slopes_beyond(net, x, y, z_x=z_x, z_y=z_y) if net else (z_x, z_y)
    slope = dz - rise_x.detach() * dx - rise_y.detach() * dy
    step = torch.where(ok, z - h, torch.zeros_like(h)) / torch.where(ok, slope, torch.ones_like(slope))
    position = torch.where(ok, torch.stack([x, y, z]) - step * rays.direction, before)
    x, y = (torch.where(ok, p, torch.zeros_like(p)) for p in position[:2])
    _, z_x, z_y = surface.relative_sag_and_slope(x, y)  # slopes as differentiable functions of the hit
    met = ok & surface.reaches(x, y) & outline.contains(x, y)
    return replace(rays, position=position, z=surface.z, status=rays.lose(~met, missed)), normal_of(z_x, z_y)


def normal_of(z_x: Tensor, z_y: Tensor) -> Normal:
    """Return the normal (-∂z/∂x, -∂z/∂y, 1) of a height field."""
    return -z_x, -z_y, torch.ones_like(z_x)


def _plane_and_root(surface: Surface, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
    """Return (points on z = surface.z (3, …), path s (mm) from there to the surface, mask of rays that meet it)."""
    dz = rays.direction[2]
    path = -rays.above(surface.z) / torch.where(dz.abs() > 1e-12, dz, torch.full_like(dz, 1e-12))
    start = torch.stack([*(rays.position[:2] + path * rays.direction[:2]), torch.zeros_like(dz)])
    with torch.no_grad():
        if is_net(surface):
            bounds = net_bounds(surface, dz.dtype, rays.sense)
            s, meets = first_root(surface, start, path, rays=rays, bounds=bounds)
        else:
            s, meets = surface.crossing(start[0], start[1], rays.direction, rays.sense)
            meets = meets & (path + s >= 0)  # only the forward root counts
    return start, s, meets


class NetBounds(NamedTuple):
    """Bounds of a net's slopes and heights, and tolerances of the search for its crossing by rays."""

    steepest_x: float  # upper bound of |∂z/∂x| on the surface
    steepest_y: float  # upper bound of |∂z/∂y| on the surface
    lowest: float  # lower bound of the heights, measured along the light (mm, from the surface's plane)
    tolerance: float  # |F| at or below which the root search stops (mm)
    near: float  # -F at or below which an approach ends (mm)


def net_bounds(surface: BSplineSurface, dtype: torch.dtype, sense: int = 1) -> NetBounds:
    """Return the bounds of a net: each slope is a weighted mean of the slopes of the legs of its control net."""
    h, half = surface.heights.detach(), max(abs(end) for end in (*surface.x, *surface.y))
    x, y = (float(h.diff(dim=axis).abs().max()) / pitch for axis, pitch in enumerate(surface.pitch))
    lowest = float(h.min()) if sense > 0 else -float(h.max())
    return NetBounds(x, y, lowest, 64 * half * torch.finfo(dtype).eps, near=APPROACH_DISTANCE * half)


def first_root(
    net: BSplineSurface, start: Tensor, path: Tensor, rays: Rays, bounds: NetBounds
) -> tuple[Tensor, Tensor]:
    """Return (s, meets): length (mm) along each ray from `start` (3, …) on z = net.z to the net, and mask of hits.

    path: signed length (mm) from the position of each ray to `start`; roots behind the position do not count.  Rays
    that are steep to the surface must begin in the glass.
    """
    dx, dy, dz = rays.direction
    steep = rays.alive & ~(rays.sense * dz > bounds.steepest_x * dx.abs() + bounds.steepest_y * dy.abs())
    tolerance, searched = bounds.tolerance, rays.alive & ~steep
    s, meets = _newton(net, start, rays.direction, torch.zeros_like(dz), searched=searched, tolerance=tolerance)
    if bool(steep.any()):
        index = steep.nonzero(as_tuple=True)
        before, direction = _select(rays.position, index), _select(rays.direction, index)
        before[2] += rays.z - net.z
        below, arrived = _approach(net, before, direction, bounds=bounds, sense=rays.sense)
        below, arrived = below - path[index], arrived & (direction[2].abs() > SIDE_EXIT_COSINE)
        if bool(arrived.any()):
            root, met = _newton(net, _select(start, index), direction, below, searched=arrived, tolerance=tolerance)
            s[index] = root
            meets[index] = met & ((root - below).abs() <= bounds.near / MIN_NEWTON_DERIVATIVE)  # otherwise tangent
    return s, meets & (path + s >= -tolerance)  # a ray may begin on the face, to rounding


def _select(vectors: Tensor, index: tuple[Tensor, ...]) -> Tensor:
    at: tuple[slice | Tensor, ...] = (slice(None), *index)
    return vectors[at]


def _newton(
    net: BSplineSurface, start: Tensor, direction: Tensor, s: Tensor, searched: Tensor, tolerance: float, first: int = 0
) -> tuple[Tensor, Tensor]:
    """Return (s* with |F| <= tolerance (mm), mask of success) by Newton steps from s; first: steps made before."""
    dx, dy, dz = direction
    meets = torch.zeros_like(searched)
    for step in range(first, NEWTON_STEPS):
        x, y = start[0] + s * dx, start[1] + s * dy
        h, z_x, z_y = net.relative_sag_and_slope(x, y)
        residual = s * dz - h
        meets = searched & (residual.abs() <= tolerance)
        searching = searched & ~meets
        remaining = int(searching.sum())
        if remaining == 0:
            break
        if 2 * remaining < s.numel():  # continue with these alone: one ray without a root must not delay all others
            index = searching.nonzero(as_tuple=True)
            rest = (_select(start, index), _select(direction, index), s[index], searched[index])
            s[index], meets[index] = _newton(net, *rest, tolerance, step)
            break
        if step >= STEPS_BEFORE_RIM_CHECK:
            z_x, z_y = slopes_beyond(net, x, y, z_x=z_x, z_y=z_y)
        slope = dz - z_x * dx - z_y * dy
        floor = torch.where(slope < 0, -MIN_NEWTON_DERIVATIVE, MIN_NEWTON_DERIVATIVE).to(slope.dtype)  # keeps the sign
        slope = torch.where(slope.abs() > MIN_NEWTON_DERIVATIVE, slope, floor)
        s = s - torch.where(searching, residual, torch.zeros_like(s)) / slope
    return s, meets


def slopes_beyond(surface: BSplineSurface, x: Tensor, y: Tensor, z_x: Tensor, z_y: Tensor) -> tuple[Tensor, Tensor]:
    """Return slopes (z_x, z_y), zero across the rim for points outside the net, where the sag continues constant."""
    in_x, in_y = ((p >= ends[0]) & (p <= ends[1]) for p, ends in ((x, surface.x), (y, surface.y)))
    return torch.where(in_x, z_x, torch.zeros_like(z_x)), torch.where(in_y, z_y, torch.zeros_like(z_y))


def _approach(
    surface: BSplineSurface, begin: Tensor, direction: Tensor, bounds: NetBounds, sense: int
) -> tuple[Tensor, Tensor]:
    """Return (s, arrived): path (mm) from `begin` to just below the first crossing ahead, True if there is one.

    F changes by at most |d_z| + |∇sag · (d_x, d_y)| per mm of path: a step of -F divided by this bound passes no root.
    """
    dx, dy, dz = direction
    rate = dz.abs() + bounds.steepest_x * dx.abs() + bounds.steepest_y * dy.abs()
    s = torch.zeros_like(dz)
    under_way, arrived = torch.ones_like(s, dtype=torch.bool), torch.zeros_like(s, dtype=torch.bool)
    for step in range(APPROACH_STEPS):
        x, y, z = begin[0] + s * dx, begin[1] + s * dy, begin[2] + s * dz
        residual = sense * (z - surface.relative_sag_and_slope(x, y)[0])
        if step == 0:
            under_way = residual < 0  # a ray that starts behind the face has left the glass already
        arrived |= under_way & (residual >= -bounds.near)
        left = ((x > surface.x[1]) & (dx > 0)) | ((x < surface.x[0]) & (dx < 0))
        left |= (sense * z < bounds.lowest) & (sense * dz <= 0)
        left |= ((y > surface.y[1]) & (dy > 0)) | ((y < surface.y[0]) & (dy < 0))
        under_way = under_way & ~arrived & ~left
        if not bool(under_way.any()):
            break
        s = torch.where(under_way, s - residual / rate, s)
    return s, arrived
