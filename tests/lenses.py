"""Small lenses and rays for tests: nets by a formula, at random, flat or tilted, and a lens with one as its back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.profiles import MeasuredProfile, Profile
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Outline, Rectangle
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.surfaces.sides import Sides, as_pair
from bstcad.optics.surfaces.surfaces import Sphere, Surface

N = 1.488
SQUARE = Rectangle(20.0, 20.0)
Half = float | tuple[float, float]  # half the width (mm) of a net, or along x and along y


def net(
    sag: Callable[[Tensor, Tensor], Tensor] | Tensor | None = None,
    z: float = 20.0,
    m: Sides = 17,
    half: Half = 10.0,
    dtype: torch.dtype = torch.float64,
) -> BSplineSurface:
    """Return the net whose control points stand sag(x, y) mm above z; a tensor: these heights; None: a plane."""
    ends = half if isinstance(half, tuple) else (half, half)
    heights = sag if isinstance(sag, Tensor) else torch.zeros(as_pair(m), dtype=torch.float64)
    if callable(sag):
        x, y = (torch.linspace(-e, e, count, dtype=torch.float64) for e, count in zip(ends, as_pair(m), strict=True))
        heights = heights + sag(x[:, None], y[None, :])
    return BSplineSurface(z, heights.to(dtype), (-ends[0], ends[0]), (-ends[1], ends[1]))


def half_over(outline: Outline, m: int) -> tuple[float, float]:
    """Return half the width of a net: of a round lens it goes on two spans past the rim, of any other it ends there."""
    reach = (m - 1) / (m - 5) if outline.is_round else 1.0
    half_x, half_y = (reach * half for half in outline.half_extent)
    return half_x, half_y


def rough(size: float, seed: int = 0, z: float = 20.0, m: Sides = 17, half: Half = 10.0) -> BSplineSurface:
    """Return a net of normally distributed heights, `size` mm RMS."""
    heights = size * torch.randn(as_pair(m), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return net(heights, z, half=half)


def wavy(
    dtype: torch.dtype = torch.float64, m: int = 17, depth: float = 0.8, ripple: float = 0.05, z: float = 20.0,
    half: float = 12.0,
) -> BSplineSurface:  # fmt: skip
    """Return a bowl with ripples, no mirror image of itself; depth and ripple in mm.

    With depth=4 and half=11 some light is totally reflected at its rim.
    """
    line = torch.linspace(-1, 1, m, dtype=torch.float64)
    x, y = line[:, None], line[None, :]
    h = depth * (x**2 + 0.7 * y**2) + ripple * torch.sin(7 * x + 0.3) * torch.cos(5 * y)
    return BSplineSurface(z, h.to(dtype), (-half, half), (-half, half))


def tilted(slope: float, z: float = 20.0, half: float = 12.0, m: int = 9) -> BSplineSurface:
    """Return a plane through (0, 0, z) whose height grows by `slope` mm per mm along x."""
    return net(lambda x, y: slope * x, z, m, half)


def lens_of(
    back: BSplineSurface | None = None,
    front: Surface | None = None,
    outline: Outline = SQUARE,
    index: float = N,
    **more,
) -> Lens:
    """Return a lens: by default a ball's front before `wavy`; more: other fields of Lens."""
    return Lens.between(front or Sphere(15.0, -0.02), back or wavy(), outline, index, **more)


def bundle(position, direction, dtype: torch.dtype = torch.float64) -> Rays:
    """Rays from points (n, 3) along directions (n, 3), or one of either for all; directions are made unit vectors."""
    position, direction = (torch.as_tensor(a, dtype=torch.float64).reshape(-1, 3).T for a in (position, direction))
    n = max(position.shape[1], direction.shape[1])
    direction = direction / direction.norm(dim=0)
    position, direction = (a.expand(3, n).to(dtype).contiguous() for a in (position, direction))
    return Rays(position, direction, torch.ones(n, dtype=dtype), torch.zeros(n, dtype=torch.uint8))


def uniform(shape, seed: int = 0, low: float = 0.0, high: float = 1.0) -> Tensor:
    """Return random numbers, evenly distributed."""
    random = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(shape, generator=random, dtype=torch.float64)


def places(rays: Rays) -> Tensor:
    """Return positions (3, …) with z from the origin, in float64."""
    x, y, _ = rays.position.double()
    return torch.stack([x, y, rays.position[2].double() + rays.z])


@dataclass(frozen=True)
class Measured(MeasuredProfile):
    """A profile of any law, as if it came from a file."""

    own: Profile
    words = "measured"

    @property
    def law(self):
        return self.own
