"""Light sources: each says what flux crosses a plane z = const, and sends the rays that carry it.

`irradiance(x, y, z)` is the flux density (1/mm², of a source whose whole flux is 1) on the plane z before the lens, and
`rays(x, y, z, area)` are the rays through points of that plane, each with the flux of its share `area` of the plane.
Light travels from the source towards that plane: along +z to a plane above it, along -z to one below (mirrors).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from bstcad.optics.kernels.reductions import elementary
from bstcad.optics.outlines import STRICT, Circle, Outline, Rectangle
from bstcad.optics.rays import Rays


@dataclass(frozen=True)
class Collimated:
    """Rays parallel to the axis through an aperture; E = const, or exp(-2 r² / w²) with w = radius_1e2."""

    aperture: Outline
    wavelength: float = 587.6  # nm
    profile: Literal["uniform", "gaussian"] = "uniform"
    radius_1e2: float | None = None  # 1/e² radius of the Gaussian profile (mm)
    z: float | None = None  # plane the rays start from (mm); None: 0, or in front of any lens that reaches there
    kind: Literal["collimated"] = "collimated"

    __pydantic_config__ = STRICT

    def irradiance(self, x: Tensor, y: Tensor, z: float) -> Tensor:
        """E(x, y) (1/mm²) on any plane z; the flux through the aperture is 1."""
        inside = self.aperture.contains(x, y)
        if self.profile == "uniform":
            return torch.where(inside, torch.full_like(x, 1 / self.aperture.area), torch.zeros_like(x))
        w2 = self.radius_1e2**2
        peak = elementary(torch.exp, -2 * (x * x + y * y) / w2) / self._gaussian_flux()
        return torch.where(inside, peak, torch.zeros_like(x))

    def _gaussian_flux(self) -> float:
        """∫ exp(-2 r² / w²) over the aperture (mm²)."""
        w = self.radius_1e2
        if isinstance(self.aperture, Circle):
            return math.pi * w * w / 2 * -math.expm1(-2 * (self.aperture.radius / w) ** 2)
        a, b = self.aperture.half_extent
        return math.pi * w * w / 2 * math.erf(math.sqrt(2) * a / w) * math.erf(math.sqrt(2) * b / w)

    def window(self, outline: Outline, z: float, sags: tuple[float, ...]) -> Rectangle:
        """The rectangle of the plane z that holds all the light: the aperture's bounding box."""
        a, b = self.aperture.half_extent
        return Rectangle(2 * a, 2 * b)

    def spot(self, z: float) -> tuple[Outline | None, tuple[float, float]]:
        """(outline, centre in mm) of the light on the plane z, None where it has no edge: the aperture."""
        return self.aperture, (0.0, 0.0)

    def unbounded(self, x: Tensor, y: Tensor) -> Collimated:
        """A source with the same rays through the points (x, y) (mm), in all of which it has light."""
        return Collimated(Rectangle(*(4 * float(p.abs().max()) for p in (x, y))), z=self.z)

    def rays(self, x: Tensor, y: Tensor, z: float, area: float) -> Rays:
        """Rays through (x, y) of the plane z, starting on the source's own plane."""
        start = self.start(z)
        sense = 1 if start <= z else -1
        direction = torch.zeros((3, 1), dtype=x.dtype, device=x.device)
        direction[2] = sense
        direction = direction.view(3, *([1] * x.ndim)).expand(3, *x.shape)
        position = torch.stack([x, y, torch.zeros_like(x)])
        flux = self.irradiance(x, y, z) * area
        return Rays(position, direction, flux, _all_alive(x), axial=True, z=start, sense=sense)

    def start(self, z: float) -> float:
        """The plane the rays start from (mm) for a front whose vertex is on the plane z.

        A front that they can meet r from the axis reaches at most r towards them: it is no more than a half sphere.
        """
        furthest = self.aperture.radius if isinstance(self.aperture, Circle) else math.hypot(*self.aperture.half_extent)
        return min(0.0, z - furthest) if self.z is None else self.z


@dataclass(frozen=True)
class Point:
    """Rays from one point into the half space on the lens's side of it.

    gaussian: irradiance on z = const falls as exp(-2 r² / w²), w = distance · tan(half_angle_1e2);
    lambertian: radiant intensity cos(theta); uniform: constant radiant intensity up to half_angle.
    """

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)  # mm
    wavelength: float = 587.6  # nm
    profile: Literal["gaussian", "lambertian", "uniform"] = "lambertian"
    half_angle_1e2: float | None = None  # degrees, gaussian
    half_angle: float | None = None  # degrees, uniform
    diameter: float | None = None  # mm; an extended disc
    kind: Literal["point"] = "point"

    __pydantic_config__ = STRICT

    def irradiance(self, x: Tensor, y: Tensor, z: float) -> Tensor:
        """E(x, y) (1/mm²) on the plane z; all the light sent to its side is 1.

        gaussian: 2 / (π w²) exp(-2 r² / w²).  lambertian: I = cos θ / π and E = I cos θ / d², so E = D² / (π d⁴)
        with D the distance of the plane and d that of the point.  uniform: I = 1 / (2π (1 - cos θ_max)), E = I D / d³.
        """
        distance = abs(z - self.position[2])
        r2 = (x - self.position[0]) ** 2 + (y - self.position[1]) ** 2
        d2 = r2 + distance**2
        if self.profile == "gaussian":
            w2 = (distance * math.tan(math.radians(self.half_angle_1e2))) ** 2
            return 2 / (math.pi * w2) * elementary(torch.exp, -2 * r2 / w2)
        if self.profile == "lambertian":
            return distance**2 / (math.pi * d2 * d2)
        edge = math.radians(self.half_angle)
        intensity = 1 / (2 * math.pi * (1 - math.cos(edge)))
        inside = r2 <= (distance * math.tan(edge)) ** 2 if self.half_angle < 90 else torch.ones_like(r2, dtype=bool)
        return torch.where(inside, intensity * distance / (d2 * torch.sqrt(d2)), torch.zeros_like(d2))

    def window(self, outline: Outline, z: float, sags: tuple[float, ...]) -> Rectangle:
        """The rectangle of the plane z that holds every ray that can meet the first surface inside its outline.

        The surface lies between that plane and those at `sags` (mm) from it: one that bends towards the source is seen
        under a wider angle, one that bends away may be seen shifted from an offset source.
        """
        distance = abs(z - self.position[2])
        offsets = [abs(p) for p in self.position[:2]]
        half = list(outline.half_extent)
        for sag in sags:
            away = sag if z > self.position[2] else -sag
            w = distance / max(distance + away, 1e-3 * distance)  # a point at h is seen at p + w (h - p)
            seen = (w * h + abs(1 - w) * p for h, p in zip(outline.half_extent, offsets, strict=True))
            half = [max(h, s) for h, s in zip(half, seen, strict=True)]
        if self.profile == "uniform" and self.half_angle < 89:
            reach = distance * math.tan(math.radians(self.half_angle))
            half = [min(h, p + reach) for h, p in zip(half, offsets, strict=True)]
        return Rectangle(2 * half[0], 2 * half[1])

    def spot(self, z: float) -> tuple[Outline | None, tuple[float, float]]:
        """(outline, centre in mm) of the light on the plane z, None where it has no edge: a uniform cone's disc."""
        centre = self.position[:2]
        if self.profile != "uniform" or self.half_angle >= 89:
            return None, centre
        return Circle(abs(z - self.position[2]) * math.tan(math.radians(self.half_angle))), centre

    def unbounded(self, x: Tensor, y: Tensor) -> Point:
        """A source with the same rays through the points (x, y) (mm), in all of which it has light."""
        return Point(self.position)

    def rays(self, x: Tensor, y: Tensor, z: float, area: float) -> Rays:
        """Rays from the point through (x, y) of the plane z."""
        start_x, start_y, start_z = self.position
        towards = torch.stack([x - start_x, y - start_y, torch.full_like(x, z - start_z)])
        direction = towards / torch.sqrt(towards[0] ** 2 + towards[1] ** 2 + towards[2] ** 2)
        start = torch.tensor((start_x, start_y, 0.0), dtype=x.dtype, device=x.device).view(3, *([1] * x.ndim))
        flux = self.irradiance(x, y, z) * area
        return Rays(
            start.expand_as(direction), direction, flux, _all_alive(x), z=start_z, sense=1 if start_z <= z else -1
        )


def _all_alive(x: Tensor) -> Tensor:
    return torch.zeros(x.shape, dtype=torch.uint8, device=x.device)


Source = Collimated | Point
