"""The trace: rays along the interfaces of a lens to a plane; free functions, differentiable in every parameter.

The part of the way before the first freeform interface stays as it is while a lens is tailored: `towards_back` follows
it once, and `through_back` the rest of it as often as the nets change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from bstcad.optics import planes
from bstcad.optics.interfaces import Hit, Interface, cross
from bstcad.optics.kernels import crossing
from bstcad.optics.kernels.choice import fused
from bstcad.optics.lens import Lens
from bstcad.optics.planes import TargetPlane
from bstcad.optics.rays import GRAZING, Landed, Rays, Status


def towards(rays: Rays, interfaces: Sequence[Interface]) -> Rays:
    """Rays from the source behind the first of a lens's interfaces."""
    for interface in interfaces:
        rays = cross(rays, interface).rays
    return rays


def towards_back(rays: Rays, lens: Lens) -> Rays:
    """Rays from the source on their way to the first freeform interface; of a lens with one net that is the back."""
    return towards(rays, lens.interfaces[: lens.freeform[0]])


def at_back(coming: Rays, lens: Lens) -> Hit:
    """The crossing of the first freeform interface by rays on their way to it (`towards_back`)."""
    return cross(coming, lens.interfaces[lens.freeform[0]])


def to_plane(rays: Rays, plane: TargetPlane) -> Rays:
    """Move the rays along their direction to the plane ahead of them; those that lead away from it are lost."""
    rise, above = planes.advance(rays, plane)
    ahead = rise if rays.sense > 0 else -rise
    status = rays.lose(ahead <= GRAZING, Status.TURNED_BACK)
    lands = status == Status.ALIVE
    rise = torch.where(lands, rise, torch.ones_like(rise))
    path = torch.where(lands, -above / rise, torch.zeros_like(rise))
    return replace(rays, position=rays.position + path * rays.direction, status=status)


def land(rays: Rays, plane: TargetPlane) -> Landed:
    """Rays behind the last interface, on the plane."""
    landed = to_plane(rays, plane)
    return Landed(planes.coordinates(landed, plane), landed.flux, landed.status, landed.taken)


def through_plain(rays: Rays, interfaces: Sequence[Interface], plane: TargetPlane) -> Landed:
    """Across the last of a lens's interfaces to the plane, in plain torch."""
    return land(towards(rays, interfaces), plane)


def through(rays: Rays, interfaces: Sequence[Interface], plane: TargetPlane) -> Landed:
    """`through_plain`, with each net by a fused kernel where the kernels take the tensors."""
    *others, last = interfaces
    for interface in others:
        rays = crossing.behind(rays, interface) if _is_fused(rays, interface) else cross(rays, interface).rays
    if _is_fused(rays, last):
        return crossing.landed(rays, last, plane)
    return land(cross(rays, last).rays, plane)


def _is_fused(rays: Rays, interface: Interface) -> bool:
    surface = interface.surface
    return surface.is_net and fused(surface.heights, rays.position, rays.direction)


def through_back_plain(coming: Rays, lens: Lens, plane: TargetPlane) -> Landed:
    """`through_back` in plain torch."""
    return through_plain(coming, lens.interfaces[lens.freeform[0] :], plane)


def through_back(coming: Rays, lens: Lens, plane: TargetPlane) -> Landed:
    """From the first freeform interface on, across all that follow, to the plane."""
    return through(coming, lens.interfaces[lens.freeform[0] :], plane)


def trace(rays: Rays, lens: Lens, plane: TargetPlane) -> Landed:
    """From the source along all interfaces of the lens to the plane."""
    return through_back(towards_back(rays, lens), lens, plane)
