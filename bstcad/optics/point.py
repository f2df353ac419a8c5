"""A point that shines, looking along the axis or tilted, and a disc or rectangle of such points; see sources.py."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import torch
from torch import Tensor

from bstcad.optics.emitter import Emitter, all_alive
from bstcad.optics.kernels.reductions import elementary
from bstcad.optics.key import Key
from bstcad.optics.outlines import STRICT, Circle, Outline, Rectangle
from bstcad.optics.rays import Rays
from bstcad.optics.spectrum import WavelengthKey
from bstcad.optics.tilt import Vector


@dataclass(frozen=True)
class Point(Emitter):
    """Rays from one point into the half space on the lens's side of it.

    gaussian: irradiance on z = const falls as exp(-2 r² / w²), w = distance · tan(half_angle_1e2);
    lambertian: radiant intensity cos(theta); uniform: constant radiant intensity up to half_angle.
    Tilted, all that is turned about the point, plane and half space included (`_tilted_irradiance`); what no longer
    goes to the lens's side misses the lens.  A disc or a rectangle lies across the axis, each point such a source.
    """

    position: Annotated[
        tuple[float, float, float], Key("Place of the point, or of a disc's middle.", "mm", -1e8, 1e8)
    ] = (0.0, 0.0, 0.0)
    wavelength: WavelengthKey = 587.6
    profile: Annotated[
        Literal["gaussian", "lambertian", "uniform"],
        Key("Radiant intensity over the angle."),
    ] = "lambertian"
    half_angle_1e2: Annotated[
        float | None,
        Key("Angle of 1/e^2 of a gaussian profile's peak.", "degrees", 1e-3, 89.0),
    ] = None
    half_angle: Annotated[float | None, Key("Angle at which a uniform profile ends.", "degrees", 1e-3, 90.0)] = None
    diameter: Annotated[float | None, Key("Diameter of a disc that shines, simulated.", "mm", 0.0, 1e6)] = None
    width: Annotated[float | None, Key("Width of a rectangle that shines, along its own x.", "mm", 0.0, 1e6)] = None
    height: Annotated[float | None, Key("Height of a rectangle that shines, along its own y.", "mm", 0.0, 1e6)] = None
    tilt: Annotated[tuple[float, float] | None, Key("Tilt about x and y.", "degrees", -180.0, 180.0)] = None
    real_diameter: Annotated[float | None, Key("Diameter of the real lamp; estimates only.", "mm", 0.0, 1e6)] = None
    kind: Annotated[Literal["point"], Key("A point, or with a size a disc or rectangle of points.")] = "point"

    __pydantic_config__ = STRICT

    @property
    def extent(self) -> Outline | None:
        """The disc or rectangle that shines (mm); None: a point."""
        if self.diameter:
            return Circle(self.diameter / 2)
        return Rectangle(self.width or 0.0, self.height or 0.0) if self.width or self.height else None

    @property
    def central(self) -> Point:
        """The point in its middle, at its main line."""
        return replace(self, wavelength=self.main_wavelength, diameter=None, width=None, height=None)

    def scaled(self, share: float) -> Point:
        """The same with so much of its diameter, width and height."""
        sizes = {name: getattr(self, name) for name in ("diameter", "width", "height")}
        return replace(self, **{name: share * size if share and size else None for name, size in sizes.items()})

    @property
    def place(self) -> Vector:
        """What tells it from the other points of an extended source: its position."""
        return self.position

    def element(self, x: float, y: float) -> Point:
        """The point at (x, y) of its extent (mm)."""
        e_x, e_y, _ = self.axes
        place = tuple(p + x * a + y * b for p, a, b in zip(self.position, e_x, e_y, strict=True))
        return replace(self, position=place, diameter=None, width=None, height=None)

    def irradiance(self, x: Tensor, y: Tensor, z: float) -> Tensor:
        """E(x, y) (1/mm²) on the plane z; all the light sent to its side is 1.

        gaussian: 2 / (π w²) exp(-2 r² / w²).  lambertian: I = cos θ / π and E = I cos θ / d², so E = D² / (π d⁴)
        with D the distance of the plane and d that of the point.  uniform: I = 1 / (2π (1 - cos θ_max)), E = I D / d³.
        """
        distance = abs(z - self.position[2])
        if self.tilted:
            return self._tilted_irradiance(x - self.position[0], y - self.position[1], distance, self.towards(z))
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

    def towards(self, z: float) -> Vector:
        """Its axis, its light's way to the plane z, in a frame in which that plane is ahead along +z."""
        n, sense = self.axes[2], 1 if self.position[2] <= z else -1
        return sense * n[0], sense * n[1], n[2]

    def _tilted_irradiance(self, x: Tensor, y: Tensor, distance: float, axis: Vector) -> Tensor:
        """E of a tilted source at (x, y) from its foot on a plane at the distance D; c = n · (x, y, D) = d cos θ.

        E = I(θ) D / d³, and nothing where c <= 0.  lambertian: I = cos θ / π, E = D c / (π d⁴).  uniform: I constant
        where cos θ >= cos θ_max.  gaussian: on its own planes E ∝ exp(-2 tan² θ / t²), t = tan(half_angle_1e2), so
        I = 2 / (π t²) exp(-2 tan² θ / t²) / cos³ θ, and E = 2 D / (π t² c³) exp(-2 (d² - c²) / (t² c²)).
        """
        d2 = x * x + y * y + distance**2
        c = axis[0] * x + axis[1] * y + axis[2] * distance
        ahead = c > 0
        c = torch.where(ahead, c, torch.ones_like(c))
        if self.profile == "gaussian":
            t2 = math.tan(math.radians(self.half_angle_1e2)) ** 2
            c2 = c * c
            e = 2 * distance / (math.pi * t2) * elementary(torch.exp, -2 / t2 * (d2 - c2) / c2) / (c2 * c)
        elif self.profile == "lambertian":
            e = distance / math.pi * c / (d2 * d2)
        else:
            cos, d = math.cos(math.radians(self.half_angle)), torch.sqrt(d2)
            ahead = ahead & (c >= cos * d)
            e = distance / (2 * math.pi * (1 - cos)) / (d2 * d)
        return torch.where(ahead, e, torch.zeros_like(e))

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
            half = [min(h, p + distance * s) for h, p, s in zip(half, offsets, self._cone_slopes(z), strict=True)]
        return Rectangle(2 * half[0], 2 * half[1])

    def _cone_slopes(self, z: float) -> tuple[float, float]:
        """The largest |dx/dz| and |dy/dz| of a uniform cone's rays to the plane z; infinite if it runs along that.

        X = dx/dz ends where the line of all Y touches the cone: (1 + X²) sin² θ_max = (n_x - n_z X)².
        """
        edge = math.radians(self.half_angle)
        if not self.tilted:
            return math.tan(edge), math.tan(edge)
        x, y, z = self.towards(z)
        if z <= math.sin(edge):
            return math.inf, math.inf
        sin2 = math.sin(edge) ** 2
        roots = (math.sqrt(sin2 * (a * a + z * z - sin2)) for a in (x, y))
        return tuple((abs(a * z) + root) / (z * z - sin2) for a, root in zip((x, y), roots, strict=True))

    def spot(self, z: float) -> tuple[Outline | None, tuple[float, float]]:
        """(outline, centre in mm) of the light on the plane z, None where it has no edge: a uniform cone's disc."""
        centre = self.position[:2]
        if self.profile != "uniform" or self.half_angle >= 89 or self.tilted:
            return None, centre
        return Circle(abs(z - self.position[2]) * math.tan(math.radians(self.half_angle))), centre

    def unbounded(self, x: Tensor, y: Tensor, z: float) -> Point:
        """A source with the same rays through the points (x, y) (mm) of the plane z, in all of which it has light."""
        return Point(self.position)

    def rays(self, x: Tensor, y: Tensor, z: float, area: float) -> Rays:
        """Rays from the point through (x, y) of the plane z."""
        start_x, start_y, start_z = self.position
        towards = torch.stack([x - start_x, y - start_y, torch.full_like(x, z - start_z)])
        direction = towards / torch.sqrt(towards[0] ** 2 + towards[1] ** 2 + towards[2] ** 2)
        start = torch.tensor((start_x, start_y, 0.0), dtype=x.dtype, device=x.device).view(3, *([1] * x.ndim))
        flux = self.irradiance(x, y, z) * area
        return Rays(
            start.expand_as(direction), direction, flux, all_alive(x), z=start_z, sense=1 if start_z <= z else -1
        )
