"""Interfaces: where light changes its way, as data.

An interface is a surface, the outline inside which it lies, and a law: refraction between two media, or reflection.
`cross` takes rays to it and behind it.  It is the only place in plain torch where the laws stand; a lens is an ordered
sequence of interfaces (lens.py), and whoever follows light walks that sequence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from bstcad.optics import intersection
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import Rays, Status
from bstcad.optics.surfaces import Surface

SKIMMING = 1e-3  # cosine of refraction below which the gradient grows no more (see `Refract.turned`)
ALONG = 1e-6  # |F'|, the cosine to the surface times its norm, at or below which a ray runs along it and meets nothing


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

    status_if_blocked = Status.TOTAL_REFLECTION  # of rays that the law does not let through
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
    """What takes a part of a ray's flux at an interface, or on the way to it (losses.py)."""

    line: str  # of the ledger, under which that part is counted
    in_glass: bool  # exp(-coefficient · path) of the way to the interface; else it follows from the angle there alone

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """The part that goes on, from the cosines of incidence and refraction and the path before the face (mm)."""


@dataclass(frozen=True)
class Interface:
    """One surface on the way of the light."""

    surface: Surface
    outline: Outline  # light that meets the surface outside is lost
    law: Law
    status_if_missed: Status  # of rays that do not meet it
    losses: tuple[Loss, ...] = ()  # what takes flux, in its order; none: the paper's lossless refraction


@dataclass(frozen=True)
class Hit:
    """Rays that have crossed an interface; what is said of them holds for those still alive."""

    rays: Rays  # on the surface, with their new directions
    slopes: tuple[Tensor, Tensor]  # ∂z/∂x and ∂z/∂y of the surface there
    cos_in: Tensor  # of the angle of incidence
    cos_out: Tensor  # of the angle of refraction or reflection


def cross(rays: Rays, interface: Interface) -> Hit:
    """Rays to an interface and behind it: those that meet its surface inside the outline, turned by its law."""
    at, z_x, z_y = intersect(interface.surface, rays, interface.outline, interface.status_if_missed)
    hit = turn(at, z_x, z_y, interface.law, level=interface.surface.level)
    if not interface.losses:
        return hit
    return replace(hit, rays=dimmed(hit.rays, hit.cos_in, hit.cos_out, _path(rays, hit.rays), interface.losses))


def dimmed(rays: Rays, cos_in: Tensor, cos_out: Tensor, path: Tensor, losses: Sequence[Loss]) -> Rays:
    """Rays behind an interface with what its losses leave of their flux; path: before it (mm).

    Only rays that go on lose flux: what the others carried is counted whole, under what has become of them.
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
    """How far rays have come from one place to another (mm); 1 for those that have got lost."""
    here = torch.stack([*behind.position[:2], behind.above(before.z)])
    way = torch.where(behind.alive, here - before.position, torch.ones_like(here))  # no root of zero: no gradient
    return torch.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])


def turn(at: Rays, z_x: Tensor, z_y: Tensor, law: Law, level: bool = False) -> Hit:
    """Rays on a surface of these slopes, behind it.  level: the surface is a plane z = const, and its slopes zero."""
    if at.axial and level:  # normal incidence
        one = torch.ones_like(z_x)
        if not law.reverses:
            return Hit(at, (z_x, z_y), one, one)
        return Hit(replace(at, direction=-at.direction, sense=-at.sense), (z_x, z_y), one, one)
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
    return Hit(replace(at, direction=direction, status=status, axial=False, sense=sense), (z_x, z_y), cos_in, cos_out)


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

    start, s, found = _plane_and_root(surface, rays)
    # double where: a ray without a root takes no step, and whatever it is, none of it reaches the others' gradients
    x, y, z = torch.where(found, start + s * rays.direction, torch.zeros_like(start))
    h, z_x, z_y = surface.relative_sag_and_slope(x, y)
    dx, dy, dz = rays.direction.detach()
    ok = found & ((dz - z_x.detach() * dx - z_y.detach() * dy).abs() > ALONG)
    rise_x, rise_y = intersection.beyond(surface, x, y, z_x, z_y) if surface.is_net else (z_x, z_y)
    slope = dz - rise_x.detach() * dx - rise_y.detach() * dy
    step = torch.where(ok, z - h, torch.zeros_like(h)) / torch.where(ok, slope, torch.ones_like(slope))
    before = torch.stack([*rays.position[:2], rays.above(surface.z)])
    position = torch.where(ok, torch.stack([x, y, z]) - step * rays.direction, before)
    x, y = (torch.where(ok, p, torch.zeros_like(p)) for p in position[:2])
    _, z_x, z_y = surface.relative_sag_and_slope(x, y)  # the slope moves with the hit
    there = ok & surface.reaches(x, y) & outline.contains(x, y)
    return replace(rays, position=position, z=surface.z, status=rays.lose(~there, missed)), z_x, z_y


def _plane_and_root(surface: Surface, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
    """(where the rays cross the base plane (3, …), path s from there to the surface, found); no gradient in s."""
    dz = rays.direction[2]
    way = -rays.above(surface.z) / torch.where(dz.abs() > 1e-12, dz, torch.full_like(dz, 1e-12))
    start = torch.stack([*(rays.position[:2] + way * rays.direction[:2]), torch.zeros_like(dz)])
    with torch.no_grad():
        if surface.is_net:
            known = intersection.bounds(surface, dz.dtype, rays.sense)
            s, found = intersection.first_root(surface, start, way, rays, known)
        else:
            s, found = surface.crossing(start[0], start[1], rays.direction, rays.sense)
            found = found & (way + s >= 0)  # only the forward root counts
    return start, s, found
