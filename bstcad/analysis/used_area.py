"""Which part of each face the light goes through: the clear aperture that a lens needs."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from bstcad.optics.interfaces import cross
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.simulation import clear_window
from bstcad.optics.sources import Source

RAYS = 513  # a side of the grid of rays
ROUND = 1.01  # a patch of light is round if it reaches no farther than this times its half width, and its half height
CORNERS = tuple((u, v) for u in (-1, 0, 1) for v in (-1, 0, 1))  # of a source of some size, in halves of it
WHOLE = 0.99  # of the clear aperture: light that reaches so far fills the face


@dataclass(frozen=True)
class Used:
    """The part of a face that light meets, as the smallest shape about the axis that holds all of it; mm."""

    width: float
    height: float
    shape: str  # "circle", "rectangle", or "whole": all of its clear aperture


def used(source: Source, lens: Lens) -> tuple[Used, ...]:
    """Of each face that light meets, in its order; the light that gets through all of them counts.

    Of a source of some size that of its middle, and of the ends of its extent.
    """
    hits = [_through(part.central, lens) for part in _parts(source)]
    return tuple(
        _patch(torch.cat(of_face, dim=1), interface.outline)
        for of_face, interface in zip(zip(*hits, strict=True), lens.interfaces, strict=True)
    )


def _parts(source: Source) -> list[Source]:
    """The simple sources whose light reaches farthest, and the one in the middle."""
    if source.extent is None:
        return [source]
    a, b = source.extent.half_extent
    disc = source.extent.shape == "circle"
    return [source.element(a * u, b * v) for u, v in CORNERS if not (disc and u and v)]


def _through(source: Source, lens: Lens) -> list[torch.Tensor]:
    """Where the light that gets through all faces meets each: (2, n), mm."""
    area = clear_window(source, lens)
    line = torch.linspace(-0.5, 0.5, RAYS, dtype=torch.float64) * (1 - 1e-9)
    x, y = (p.reshape(-1) for p in torch.meshgrid(line * area.width, line * area.height, indexing="ij"))
    rays, hits = source.rays(x, y, lens.entrance.z, 1.0), []
    for interface in lens.interfaces:
        rays = cross(rays, interface).rays
        hits.append(rays.position[:2])
    through = rays.alive & (rays.flux > 0)
    return [hit[:, through] for hit in hits]


def _patch(places: torch.Tensor, aperture: Outline) -> Used:
    """Of places (2, n) on a face of that clear aperture."""
    a, b = aperture.half_extent
    if not places.numel():
        return Used(0.0, 0.0, "circle")
    half_x, half_y = (float(part.abs().max()) for part in places)
    radius = float(torch.hypot(*places).max())
    round_ = radius <= ROUND * min(half_x, half_y)
    fills = aperture.shape == "circle" or not round_
    if fills and half_x >= WHOLE * a and half_y >= WHOLE * b:
        return Used(2 * a, 2 * b, "whole")
    if round_:
        return Used(2 * radius, 2 * radius, "circle")
    return Used(2 * half_x, 2 * half_y, "rectangle")
