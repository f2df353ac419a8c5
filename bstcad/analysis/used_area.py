"""Clear aperture that the light needs of each face."""

from __future__ import annotations

import torch

from bstcad.optics.interfaces import cross
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Outline, Rectangle
from bstcad.optics.sources import Source
from bstcad.optics.trace import clear_window

RAYS = 513  # a side of the grid of rays
ROUND = 1.01  # light is round if it reaches no farther than this times its half width, and its half height
CORNERS = tuple((u, v) for u in (-1, 0, 1) for v in (-1, 0, 1))  # of an extended source, in halves of its extent
WHOLE = 0.99  # of the clear aperture: light that reaches so far fills the face


def used(source: Source, lens: Lens) -> tuple[Outline | None, ...]:
    """Smallest circle or rectangle about the axis (mm) that holds all light on each face, in the order of the light.

    None: the light fills the face's clear aperture.  Only light that gets through all faces counts; of an extended
    source the light of its middle and of the ends of its extent.
    """
    hits = [_through(part.central, lens) for part in _elements(source)]
    return tuple(
        _patch(torch.cat(of_face, dim=1), interface.outline)
        for of_face, interface in zip(zip(*hits, strict=True), lens.interfaces, strict=True)
    )


def _elements(source: Source) -> list[Source]:
    """Point-like sources at the middle and at the ends of the extent."""
    if source.extent is None:
        return [source]
    a, b = source.extent.half_extent
    disc = source.extent.shape == "circle"
    return [source.element(a * u, b * v) for u, v in CORNERS if not (disc and u and v)]


def _through(source: Source, lens: Lens) -> list[torch.Tensor]:
    """x and y (2, n) (mm) on each face of the rays that get through all faces."""
    area = clear_window(source, lens)
    line = torch.linspace(-0.5, 0.5, RAYS, dtype=torch.float64) * (1 - 1e-9)
    x, y = (p.reshape(-1) for p in torch.meshgrid(line * area.width, line * area.height, indexing="ij"))
    rays, hits = source.rays(x, y, lens.entrance.z, 1.0), []
    for interface in lens.interfaces:
        rays = cross(rays, interface).rays
        hits.append(rays.position[:2])
    through = rays.alive & (rays.flux > 0)
    return [hit[:, through] for hit in hits]


def _patch(hits: torch.Tensor, aperture: Outline) -> Outline | None:
    """Shape that holds the hits (2, n) on a face of that clear aperture."""
    if not hits.numel():
        return Circle(0.0)
    half_x, half_y = (float(part.abs().max()) for part in hits)
    radius = float(torch.hypot(*hits).max())
    patch = Circle(radius) if radius <= ROUND * min(half_x, half_y) else Rectangle(2 * half_x, 2 * half_y)
    a, b = aperture.half_extent
    alike = aperture.shape == "circle" or patch.shape == "rectangle"
    return None if alike and half_x >= WHOLE * a and half_y >= WHOLE * b else patch
