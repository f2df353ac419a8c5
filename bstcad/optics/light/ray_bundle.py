"""Emitter whose rays are those of a file, by which a lens is judged.

Its rays are given, so that it has no irradiance on a plane in closed form.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.light.measured_rays import PARTS, RayOrder
from bstcad.optics.surfaces.outlines import Outline, Rectangle
from bstcad.optics.surfaces.rays import Frame, Rays, Status, Vector
from bstcad.optics.surfaces.sampling import POINTS_PER_STRIP
from bstcad.optics.surfaces.surfaces import Surface


@dataclass(frozen=True, eq=False)
class RayBundle(Emitter):
    """The rays of a file at one wavelength, placed in space; their sum has the flux 1."""

    order: RayOrder
    position: Vector  # origin of the file's coordinates in space, mm
    frames: tuple[Frame, Frame]  # axes of the file's coordinates in space, for light along +z and along -z
    wavelength: float
    part: int = 0  # number of the part from which rays are drawn

    kind = "rays"
    is_given = True

    def irradiance(self, x: Tensor, y: Tensor, z: float) -> Tensor:
        """Raise NotImplementedError: rays are given, not an irradiance."""
        raise self._missing_method("an irradiance", "irradiance(x, y, z)")

    def rays_through(self, x: Tensor, y: Tensor, z: float, area: float) -> Rays:
        """Raise NotImplementedError: rays through chosen points are not known."""
        raise self._missing_method("rays through given points", "rays_through(x, y, z, area)")

    def window(self, outline: Outline, z: float, sags: tuple[float, ...]) -> Rectangle:
        """Raise NotImplementedError: all rays are traced, wherever they go."""
        raise self._missing_method("a window", "window(outline, z, sags)")

    @property
    def largest_side(self) -> int:
        """Number n for which n x n is about the number of rays in a part."""
        return max(1, math.isqrt(len(self.order.order) // PARTS))

    def launched(self, lens: Lens, n: int, seed: int) -> Iterator[Rays]:
        """Yield n x n random rays of the part, or all of its rays if they are fewer, a strip at a time.

        Rays that start beside or inside the lens, or that lead away from it, have a Status that says so.
        """
        given, like = self.order.rays, lens.like
        chosen = self.order.sample(self.part, n * n, seed)
        whole = math.fsum(given.power[chosen].astype(np.float64))
        for first in range(0, len(chosen), POINTS_PER_STRIP):
            some = chosen[first : first + POINTS_PER_STRIP]
            numbers = (part[some].T.astype(np.float64) for part in (given.position, given.direction))
            position, direction = (torch.from_numpy(part).to(like) for part in numbers)
            flux = torch.from_numpy(given.power[some].astype(np.float64) / whole).to(like)
            rays = self._oriented(position, direction, flux, lens)
            yield replace(rays, status=fates(rays, lens))

    def _oriented(self, position: Tensor, direction: Tensor, flux: Tensor, lens: Lens) -> Rays:
        """Return rays (3, n) of the file in space, on the side of the lens from which its light comes."""
        sense, z = lens.passes.sense, float(lens.entrance.z)
        frame = self.frames[0 if sense > 0 else 1]

        def turned(part: Tensor) -> Tensor:
            return torch.stack([sum(axis[k] * p for axis, p in zip(frame, part, strict=True)) for k in range(3)])

        origin = position.new_tensor([*self.position[:2], self.position[2] - z])[:, None]
        along = turned(direction)
        along = along / torch.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
        status = torch.zeros(flux.shape, dtype=torch.uint8, device=flux.device)
        return Rays(origin + turned(position), along, flux, status, z=z, sense=sense)


def fates(rays: Rays, lens: Lens) -> Tensor:
    """Return the status of rays at their start: alive, or inside, beside or behind the solid, or leading away from it.

    A ray that starts behind the first window before the lens misses it, and counts as beside the lens.
    """
    first, last = (lens.front, lens.back) if rays.sense > 0 else (lens.back, lens.front)
    x, y = rays.position[0], rays.position[1]
    within = lens.plan.contains(x, y)
    entered, left = _past(first, rays, within) >= 0, _past(last, rays, within) >= 0
    beside = ~within & (_past(lens.entrance, rays, torch.zeros_like(within)) >= 0)
    if lens.before:
        beside = beside | (_past(lens.entrance, rays, lens.interfaces[0].outline.contains(x, y)) >= 0)
    status = torch.zeros_like(rays.status)
    for where, reason in (
        (rays.sense * rays.direction[2] <= 0, Status.LEADS_AWAY),
        ((within & left) | beside, Status.STARTED_BESIDE),
        (within & entered & ~left, Status.STARTED_INSIDE),  # the last reason counts
    ):
        status = torch.where(where, torch.full_like(status, int(reason)), status)
    return status


def _past(face: Surface, rays: Rays, over: Tensor) -> Tensor:
    """Return how far (mm) along the light each ray starts behind a face; over: False where its plane is compared."""
    face = face.plain()
    own = over if face.outline is None else over & face.outline.contains(rays.position[0], rays.position[1])
    x, y = (torch.where(own, p, torch.zeros_like(p)).double() for p in rays.position[:2])
    level = torch.where(own, face.optical.sag_and_slope(x, y)[0], float(face.around.z))
    return rays.sense * (rays.position[2].double() + rays.z - level)
