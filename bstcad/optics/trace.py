"""The trace: rays along the interfaces of a lens to a plane; free functions, differentiable in every parameter."""

from __future__ import annotations

from dataclasses import replace

import torch

from bstcad.optics import planes
from bstcad.optics.interfaces import Hit, cross, dimmed
from bstcad.optics.kernels import crossing, kernel_arguments, spline
from bstcad.optics.lens import Lens
from bstcad.optics.planes import TargetPlane
from bstcad.optics.rays import GRAZING, Landed, Rays, Status


def towards_back(rays: Rays, lens: Lens) -> Rays:
    """The rays from the source on their way to the back face: behind all interfaces but the last."""
    for interface in lens.interfaces[:-1]:
        rays = cross(rays, interface).rays
    return rays


def at_back(coming: Rays, lens: Lens) -> Hit:
    """The crossing of the back face by rays on their way to it (`towards_back`)."""
    return cross(coming, lens.interfaces[-1])


def to_plane(rays: Rays, plane: TargetPlane) -> Rays:
    """Move the rays along their direction to the plane ahead of them; those that lead away from it are lost."""
    rise, above = planes.advance(rays, plane)
    ahead = rise if rays.sense > 0 else -rise
    status = rays.lose(ahead <= GRAZING, Status.TURNED_BACK)
    lands = status == Status.ALIVE
    rise = torch.where(lands, rise, torch.ones_like(rise))
    path = torch.where(lands, -above / rise, torch.zeros_like(rise))
    return replace(rays, position=rays.position + path * rays.direction, status=status)


def through_back_plain(coming: Rays, lens: Lens, plane: TargetPlane) -> Landed:
    """Across the back face to the plane."""
    landed = to_plane(at_back(coming, lens).rays, plane)
    return Landed(planes.coordinates(landed, plane), landed.flux, landed.status, landed.taken)


def through_back(coming: Rays, lens: Lens, plane: TargetPlane) -> Landed:
    """`through_back_plain`, by a fused kernel where one serves: rays on the CPU that need no gradient themselves."""
    if not spline.serves(lens.back.heights, coming.position, coming.direction):
        return through_back_plain(coming, lens, plane)
    shape, last = coming.status.shape, lens.interfaces[-1]
    heights, position, direction = lens.back.heights, coming.position, coming.direction
    if coming.sense < 0:  # the kernel knows light along +z: seen in a mirror, this is such light
        flip = torch.tensor([1.0, 1.0, -1.0], dtype=position.dtype).view(3, *([1] * (position.ndim - 1)))
        heights, position, direction = -heights, position * flip, direction * flip
    face = crossing.Crossing(*kernel_arguments.back_face(lens, plane, coming), True, bool(last.losses))
    position, direction = (t.reshape(3, -1).contiguous() for t in (position, direction))
    landing, status, path, cos_in = crossing.Cross.apply(
        heights, position, direction, coming.status.reshape(-1), face
    )
    left = replace(coming, status=status.view(shape))
    if last.losses:
        cos_in, path = cos_in.view(shape), path.view(shape)
        left = dimmed(left, cos_in, last.law.turned(cos_in)[1], path, last.losses)
    return Landed(landing.view(2, *shape), left.flux, left.status, left.taken)


def trace(rays: Rays, lens: Lens, plane: TargetPlane) -> Landed:
    """From the source along all interfaces of the lens to the plane."""
    return through_back(towards_back(rays, lens), lens, plane)
