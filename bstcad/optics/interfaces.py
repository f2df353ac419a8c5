"""Interfaces: where light changes its way, as data.

An interface is a surface, the outline inside which it lies, and a law: refraction between two media, or reflection.
`cross` takes rays to it and behind it.  It is the only place in plain torch where the laws stand; a lens is an ordered
sequence of interfaces (lens.py), and whoever follows light walks that sequence.

A ray meets a spline at the root of F(s) = z(s) - sag(x(s), y(s)) (mm), s the path along the ray (mm).  `first_root` is
written for light along +z, which comes from below the face, where F < 0; for light along -z (`Rays.sense`) F, d_z and
all heights change their sign.  F' = d_z - ∇sag · (d_x, d_y), and no slope of the face is steeper than its control
legs.  Where that keeps F' positive the ray crosses the face once, and Newton's method finds where.  A ray that is
*steep* to the face may cross it several times: light leaves the glass at the first crossing, so it is led there from
below, by steps too short to pass it, before Newton's method takes over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import Rays, Status
from bstcad.optics.surfaces import Surface

SKIMMING = 1e-3  # cosine of refraction below which the gradient grows no more (see `Refract.turned`)
ALONG = 1e-6  # |F'|, the cosine to the surface times its norm, at or below which a ray runs along it and meets nothing
NEWTON_STEPS = 20  # a smooth lens needs 3 to 5; a ray that has not converged by then misses
APPROACH_STEPS = 200  # a ray that has not come near the face by then runs along it, and misses
LEVEL = 1e-2  # |d_z| of a steep ray at or below which it leaves through a side
FLATTEST = 1e-3  # |F'| below which a Newton step is that of 1e-3, with its sign
QUICK = 3  # Newton steps after which rays outside the net are checked for; most have arrived by then
NEAR = 1e-5  # part of the net's half width, so little below the face an approach ends


@dataclass(frozen=True)
class Refract:
    """Snell's law as vectors: d' = η d + (cos θ' - η cos θ) N, η = n_in / n_out, N the unit normal along the light.

    cos² θ' = 1 - η² (1 - cos² θ) <= 0 is total internal reflection; rays that meet the surface from behind
    (cos θ <= 0) also count as that.  Neither has a gradient.  That of the others grows towards the critical angle as
    d cos θ' = η² cos θ / cos θ' d cos θ, and is capped there: cos θ' counts as SKIMMING at least, in this derivative
    and nowhere else.
    """

    n_in: float  # refractive index before the interface
    n_out: float  # and behind it

    status_if_blocked = Status.TOTAL_REFLECTION  # status of rays that the law does not let through
    reverses = False  # does light turn back along z?

    @property
    def eta(self) -> float:
        """The direction's factor η."""
        return self.n_in / self.n_out

    def turned(self, cos_in: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(a, cos θ', stopped): the new direction is η d + a N; stopped: True where no light goes on."""
        eta = self.eta
        cos2 = 1 - eta * eta * (1 - cos_in * cos_in)
        total = cos2 <= 0
        cos_out = _capped_root(torch.where(total, torch.ones_like(cos2), cos2))
        return cos_out - eta * cos_in, cos_out, total | (cos_in <= 0)


@dataclass(frozen=True)
class Reflect:
    """The law of reflection: d' = d - 2 cos θ N, N the unit normal along the light; rays from behind are lost."""

    eta = 1.0
    status_if_blocked = Status.TURNED_BACK
    reverses = True

    def turned(self, cos_in: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(a, cos θ', stopped): the new direction is d + a N."""
        return -2 * cos_in, cos_in, cos_in <= 0


def _capped_root(cos2: Tensor) -> Tensor:
    """cos = sqrt(cos²) > 0 with the derivative 1 / (2 max(cos, SKIMMING)): the same sign, never more than that."""
    cos = torch.sqrt(cos2.detach())
    return cos + (cos2 - cos2.detach()) / (2 * cos.clamp(min=SKIMMING))


Law = Refract | Reflect


class Loss(Protocol):
    """A loss of a ray's flux at an interface, or on the way to it (losses.py)."""

    line: str  # line of the ledger under which that part is counted
    in_glass: bool  # it acts on the way to the interface; else at the interface
    fused: bool  # the kernels know it: exp(-coefficient · path) in the glass, at the interface the angle alone

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """The part that goes on, from the cosines of incidence and refraction and the path before the face (mm)."""


@dataclass(frozen=True)
class Interface:
    """One surface on the way of the light."""

    surface: Surface
    outline: Outline  # light that meets the surface outside is lost
    law: Law
    status_if_missed: Status  # status of rays that do not meet it
    losses: tuple[Loss, ...] = ()  # in the order of the light; none: the paper's lossless refraction


@dataclass(frozen=True)
class Hit:
    """Rays that have crossed an interface; the cosines hold for those still alive."""

    rays: Rays  # on the surface, with their new directions
    cos_in: Tensor  # cosine of the angle of incidence
    cos_out: Tensor  # cosine of the angle of refraction or reflection


def cross(rays: Rays, interface: Interface) -> Hit:
    """Rays to an interface and behind it: those that meet its surface inside the outline, turned by its law."""
    at, z_x, z_y = intersect(interface.surface, rays, interface.outline, interface.status_if_missed)
    hit = deflect(at, z_x, z_y, interface.law, level=interface.surface.level)
    if not interface.losses:
        return hit
    return replace(
        hit, rays=dimmed(hit.rays, hit.cos_in, hit.cos_out, path=_path(rays, hit.rays), losses=interface.losses)
    )


def dimmed(rays: Rays, cos_in: Tensor, cos_out: Tensor, path: Tensor, losses: Sequence[Loss]) -> Rays:
    """Rays behind an interface after its losses; path: before it (mm).

    Only rays that go on lose flux: the flux of the others is counted whole, under their status.
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
    """The path of rays from one place to another (mm); √3 for lost rays."""
    here = torch.stack([*behind.position[:2], behind.above(before.z)])
    way = torch.where(behind.alive, here - before.position, torch.ones_like(here))  # no root of zero: no gradient
    return torch.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])


def deflect(at: Rays, z_x: Tensor, z_y: Tensor, law: Law, level: bool = False) -> Hit:
    """Rays on a surface of these slopes, behind it.  level: the surface is a plane z = const, and its slopes zero."""
    if at.axial and level:  # normal incidence
        one = torch.ones_like(z_x)
        if not law.reverses:
            return Hit(at, one, one)
        return Hit(replace(at, direction=-at.direction, sense=-at.sense), one, one)
    norm = torch.rsqrt(1 + z_x * z_x + z_y * z_y)
    dx, dy, dz = torch.where(at.alive, at.direction, torch.ones_like(at.direction))
    along = dz - dx * z_x - dy * z_y
    cos_in = (along if at.sense > 0 else -along) * norm
    eta, (bend, cos_out, stopped) = law.eta, law.turned(cos_in)
    shift = bend * norm if at.sense > 0 else -bend * norm
    direction = torch.stack([eta * dx - shift * z_x, eta * dy - shift * z_y, eta * dz + shift])
    status = at.lose(stopped, law.status_if_blocked)
    direction = torch.where(status == Status.ALIVE, direction, at.direction.detach())
    sense = -at.sense if law.reverses else at.sense
    return Hit(replace(at, direction=direction, status=status, axial=False, sense=sense), cos_in, cos_out)


def intersect(surface: Surface, rays: Rays, outline: Outline, missed: Status) -> tuple[Rays, Tensor, Tensor]:
    """Move the rays to the surface; those that do not meet it inside the outline are lost as `missed`.

    F(s) = z(s) - sag(x(s), y(s)) = 0.  The root is found without gradient; then one differentiable Newton step,
    s = s* - F(s*) / F'(s*) with F' held, carries the implicit gradient ds = -dF / F' (Wang, C. 2022 after Griewank).
    The path s counts from the surface's base plane: it is as short as the sag, so that neither a source far off nor a
    scene far from its origin costs digits.

    Returns (rays at the surface, ∂z/∂x, ∂z/∂y there).
    """
    if rays.axial:  # closed form: the hit is (x, y, sag)
        x, y, _ = rays.position
        h, z_x, z_y = surface.relative_sag_and_slope(x, y)
        status = rays.lose(~(surface.reaches(x, y) & outline.contains(x, y)), missed)
        return replace(rays, position=torch.stack([x, y, h]), z=surface.z, status=status), z_x, z_y

    start, s, meets = _plane_and_root(surface, rays)
    # double where: a ray without a root takes no step, and whatever it is, none of it reaches the others' gradients
    x, y, z = torch.where(meets, start + s * rays.direction, torch.zeros_like(start))
    h, z_x, z_y = surface.relative_sag_and_slope(x, y)
    dx, dy, dz = rays.direction.detach()
    ok = meets & ((dz - z_x.detach() * dx - z_y.detach() * dy).abs() > ALONG)
    rise_x, rise_y = slopes_beyond(surface, x, y, z_x=z_x, z_y=z_y) if surface.is_net else (z_x, z_y)
    slope = dz - rise_x.detach() * dx - rise_y.detach() * dy
    step = torch.where(ok, z - h, torch.zeros_like(h)) / torch.where(ok, slope, torch.ones_like(slope))
    before = torch.stack([*rays.position[:2], rays.above(surface.z)])
    position = torch.where(ok, torch.stack([x, y, z]) - step * rays.direction, before)
    x, y = (torch.where(ok, p, torch.zeros_like(p)) for p in position[:2])
    _, z_x, z_y = surface.relative_sag_and_slope(x, y)  # the slope moves with the hit
    there = ok & surface.reaches(x, y) & outline.contains(x, y)
    return replace(rays, position=position, z=surface.z, status=rays.lose(~there, missed)), z_x, z_y


def _plane_and_root(surface: Surface, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
    """(where the rays cross the base plane (3, …), path s from there to the surface, meets); no gradient in s."""
    dz = rays.direction[2]
    way = -rays.above(surface.z) / torch.where(dz.abs() > 1e-12, dz, torch.full_like(dz, 1e-12))
    start = torch.stack([*(rays.position[:2] + way * rays.direction[:2]), torch.zeros_like(dz)])
    with torch.no_grad():
        if surface.is_net:
            known = net_bounds(surface, dz.dtype, rays.sense)
            s, meets = first_root(surface, start, way, rays=rays, known=known)
        else:
            s, meets = surface.crossing(start[0], start[1], rays.direction, rays.sense)
            meets = meets & (way + s >= 0)  # only the forward root counts
    return start, s, meets


class NetBounds(NamedTuple):
    """Bounds of a net as a whole."""

    steepest_x: float  # no |∂z/∂x| of the surface is larger
    steepest_y: float
    lowest: float  # no height is lower along the light (mm, from the surface's plane)
    tolerance: float  # |F| at which a root is found (mm)
    near: float  # -F at which an approach ends (mm)


def net_bounds(surface: BSplineSurface, dtype: torch.dtype, sense: int = 1) -> NetBounds:
    """Each slope is a mean of those of the control legs; sags and positions are of the order of the half width."""
    h, (pitch_x, pitch_y) = surface.heights.detach(), surface.pitch
    half = max(abs(end) for end in (*surface.x, *surface.y))
    lowest = float(h.min()) if sense > 0 else -float(h.max())
    return NetBounds(
        float(h.diff(dim=0).abs().max()) / pitch_x, float(h.diff(dim=1).abs().max()) / pitch_y, lowest,
        tolerance=64 * half * torch.finfo(dtype).eps, near=NEAR * half,
    )  # fmt: skip


def first_root(
    surface: BSplineSurface, start: Tensor, way: Tensor, rays: Rays, known: NetBounds
) -> tuple[Tensor, Tensor]:
    """(s, meets): path of live rays to the surface from where they cross its plane, `start` (3, …) mm; forward only.

    They come to it by `way` mm of path.  Those that are steep to the surface must begin in the glass.
    """
    dx, dy, dz = rays.direction
    steep = rays.alive & ~((dz if rays.sense > 0 else -dz) > known.steepest_x * dx.abs() + known.steepest_y * dy.abs())
    s, meets = _newton(
        surface, start, rays.direction, s=torch.zeros_like(dz), wanted=rays.alive & ~steep, tolerance=known.tolerance
    )
    if bool(steep.any()):
        few = steep.nonzero(as_tuple=True)
        before, direction = _only(rays.position, few), _only(rays.direction, few)
        before[2] += rays.z - surface.z
        below, arrived = _approach(surface, before, direction, known=known, sense=rays.sense)
        below, arrived = below - way[few], arrived & (direction[2].abs() > LEVEL)
        if bool(arrived.any()):
            root, met = _newton(
                surface, _only(start, few), direction, s=below, wanted=arrived, tolerance=known.tolerance
            )
            s[few] = root
            meets[few] = met & ((root - below).abs() <= known.near / FLATTEST)  # else it runs along the face
    return s, meets & (way + s >= -known.tolerance)  # a ray may begin on the face, as near as rounding allows


def _only(vectors: Tensor, few: tuple[Tensor, ...]) -> Tensor:
    """(3, k): those of (3, …) at the places `few`."""
    return vectors[(slice(None), *few)]


def _newton(
    surface: BSplineSurface, start: Tensor, direction: Tensor, s: Tensor, wanted: Tensor, tolerance: float,
    steps: int = NEWTON_STEPS,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """(s*, meets) for the rays `wanted`, from the paths s beyond the plane; the stop is |F| in mm, per ray."""
    dx, dy, dz = direction
    meets = torch.zeros_like(wanted)
    for step in range(steps):
        x, y = start[0] + s * dx, start[1] + s * dy
        h, z_x, z_y = surface.relative_sag_and_slope(x, y)
        residual = s * dz - h
        meets = wanted & (residual.abs() <= tolerance)
        searching = wanted & ~meets
        left = int(searching.sum())
        if left == 0:
            break
        if 2 * left < s.numel():  # few go on: alone, so that one ray without a root does not hold up all others
            few = searching.nonzero(as_tuple=True)
            at = (_only(start, few), _only(direction, few), s[few], wanted[few])
            s[few], meets[few] = _newton(surface, *at, tolerance, steps - step)
            break
        if step + NEWTON_STEPS - steps >= QUICK:
            z_x, z_y = slopes_beyond(surface, x, y, z_x=z_x, z_y=z_y)
        slope = dz - z_x * dx - z_y * dy
        floor = torch.where(slope < 0, -FLATTEST, FLATTEST).to(slope.dtype)  # keeps the sign
        slope = torch.where(slope.abs() > FLATTEST, slope, floor)
        s = s - torch.where(searching, residual, torch.zeros_like(s)) / slope
    return s, meets


def slopes_beyond(surface: BSplineSurface, x: Tensor, y: Tensor, z_x: Tensor, z_y: Tensor) -> tuple[Tensor, Tensor]:
    """The slopes with which the sag goes on beyond the net: none across the rim."""
    in_x, in_y = ((p >= ends[0]) & (p <= ends[1]) for p, ends in ((x, surface.x), (y, surface.y)))
    return torch.where(in_x, z_x, torch.zeros_like(z_x)), torch.where(in_y, z_y, torch.zeros_like(z_y))


def _approach(
    surface: BSplineSurface, begin: Tensor, direction: Tensor, known: NetBounds, sense: int
) -> tuple[Tensor, Tensor]:
    """(s, arrived): path from `begin` to just below the first crossing ahead.

    F changes by at most |d_z| + |∇sag · (d_x, d_y)| per mm of path: a step of -F over the bound of that passes no root.
    """
    dx, dy, dz = direction
    rate = dz.abs() + known.steepest_x * dx.abs() + known.steepest_y * dy.abs()
    s = torch.zeros_like(dz)
    under_way, arrived = torch.ones_like(s, dtype=torch.bool), torch.zeros_like(s, dtype=torch.bool)
    for step in range(APPROACH_STEPS):
        x, y, z = begin[0] + s * dx, begin[1] + s * dy, begin[2] + s * dz
        residual = sense * (z - surface.relative_sag_and_slope(x, y)[0])
        if step == 0:
            under_way = residual < 0  # a ray that starts behind the face has left the glass already
        arrived |= under_way & (residual >= -known.near)
        gone = ((x > surface.x[1]) & (dx > 0)) | ((x < surface.x[0]) & (dx < 0))
        gone |= (sense * z < known.lowest) & (sense * dz <= 0)
        gone |= ((y > surface.y[1]) & (dy > 0)) | ((y < surface.y[0]) & (dy < 0))
        under_way = under_way & ~arrived & ~gone
        if not bool(under_way.any()):
            break
        s = torch.where(under_way, s - residual / rate, s)
    return s, arrived
