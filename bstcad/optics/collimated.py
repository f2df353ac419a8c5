"""Parallel light through an aperture, of one direction or of a cone of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated, Literal

import torch
from torch import Tensor

from bstcad.optics.emitters import LAWS, Emitter, WavelengthKey, all_alive
from bstcad.optics.kernels.records import ALONG_Z, Beam, floats
from bstcad.optics.kernels.reductions import elementary
from bstcad.optics.key import Key
from bstcad.optics.motion import Motion
from bstcad.optics.outlines import STRICT, Circle, Outline, Rectangle
from bstcad.optics.rays import Rays, tilt_of

FAR = 4.0  # widths of its aperture by which a beam without a plane z of its own gets that plane before the lens
MAX_LEAN = 89.0  # degrees from the lens's axis, of parallel light


@dataclass(frozen=True)
class Collimated(Emitter):
    """Parallel rays through an aperture of a plane z; on it E = const, or exp(-2 r² / w²) with w = radius_1e2.

    With the axis tilted the rays go along n = (n_x, n_y, n_z) (rays.axes), and on another plane the light is shifted by
    (n_x, n_y) / n_z times the distance; its irradiance on planes z = const is the same, since their area is that of the
    aperture.  With a divergence the rays are those of all directions in a cone about the axis, of one radiance each:
    the flux through the plane is even in (d_x, d_y), whose part in the cone of half angle α is an ellipse about
    cos α (n_x, n_y).
    """

    aperture: Annotated[Outline, Key("Outline of the beam.", example={"shape": "circle", "radius": 12.0})]
    wavelength: WavelengthKey = 587.6
    profile: Annotated[Literal["uniform", "gaussian"], Key("Irradiance over the aperture.")] = "uniform"
    radius_1e2: Annotated[
        float | None, Key("Radius of 1/e^2 of a gaussian profile's peak.", "mm", 1e-3, 1e6, example=8.0)
    ] = None
    # None: the plane of the lens's first vertex; rays start before it, at 0 or in front of a lens that reaches there
    z: Annotated[float | None, Key("Plane of the aperture, where rays start.", "mm", -1e8, 1e8, example=0.0)] = None
    centre: Annotated[
        tuple[float, float] | None, Key("Middle of aperture and profile.", "mm", -1e8, 1e8, example=[2.0, 0.0])
    ] = None
    tilt: Annotated[
        tuple[float, float] | None, Key("Tilt about x and y.", "degrees", -180.0, 180.0, example=[0.0, 10.0])
    ] = None
    divergence: Annotated[float | None, Key("Full angle of the cone of directions.", "degrees", 0.0, 179.0)] = None
    real_divergence: Annotated[
        float | None, Key("Full angle of the real lamp; estimates only.", "degrees", 0.0, 179.0)
    ] = None
    kind: Annotated[Literal["collimated"], Key("Parallel light.")] = "collimated"

    __pydantic_config__ = STRICT
    size_key, parallel, simple = "divergence", True, "parallel light of one direction"
    widths = MappingProxyType({"gaussian": "radius_1e2"})

    @property
    def begins(self) -> float | None:
        """Its plane."""
        return self.z

    def complaints(self, z: float, optic: str) -> Iterator[str]:
        """Directions that lean too far from the axis."""
        lean = math.degrees(math.acos(max(-1.0, min(1.0, self.axes[2][2]))))
        if not lean + (self.divergence or 0.0) / 2 < MAX_LEAN:
            key, light = ("divergence", "some of the light runs") if self.divergence else ("tilt", "the light runs")
            yield f"{key}: {light} {MAX_LEAN:g} degrees off the lens's axis or more; make it smaller"

    def words(self, origin: float) -> str:
        """Return profile, divergence and aperture for a data sheet."""
        spread = f"divergence {self.divergence:.4g}°, " if self.divergence else ""
        return f"parallel light, {LAWS[self.profile]}, {spread}{self.aperture.words.replace(' x ', ' × ')}"

    def sizes(self) -> Iterator[tuple[str, float, str]]:
        """Its divergence, if it has one."""
        if self.divergence:
            yield "divergence", self.divergence, "degrees"

    @property
    def turns_alike(self) -> bool:
        """Is the aperture round, as the cone is?"""
        return self.aperture.is_round

    def moved(self, motion: Motion, entrance: float) -> Collimated:
        """The simple beam after a motion; entrance: z of the plane through the first vertex (mm).

        The aperture is one of a plane z = const, and stays in one when the light is turned: it is wider by 1 / cos than
        it should be, 1.5e-6 of its size at 0.1 degrees.
        """
        if not (motion.turns or self.tilted):  # light along z has one flux density on all planes
            x, y = (p + d for p, d in zip(self.centre or (0.0, 0.0), motion.shift, strict=False))
            return self if (x, y) == (0.0, 0.0) and self.centre is None else replace(self, centre=(x, y))
        wide = 2 * math.hypot(*self.aperture.half_extent)
        z, known = (entrance - FAR * wide, entrance) if self.z is None else (self.z, self.z)
        (normal,) = motion.frame((self.axes[2],))
        x, y, reached = motion.point((*self.shift(known), known))
        way = z - reached
        centre = x + way * normal[0] / normal[2], y + way * normal[1] / normal[2]
        return replace(self, z=z, centre=centre, tilt=tilt_of(normal))

    @property
    def extent(self) -> Circle | None:
        """The cone's disc of direction cosines across the axis; None: all rays are parallel."""
        return Circle(math.sin(math.radians(self.divergence / 2))) if self.divergence else None

    @property
    def central(self) -> Collimated:
        """The beam of its mean direction, at its main line."""
        return replace(self, wavelength=self.main_wavelength, divergence=None)

    def scaled(self, share: float) -> Collimated:
        """The same beam with a share of its divergence."""
        return replace(self, divergence=share * self.divergence if share else None)

    def element(self, u: float, v: float) -> Collimated:
        """The beam at (u, v) of its extent: d = cos α n + u e_x + v e_y in x and y, and d_z from the length 1."""
        e_x, e_y, n = self.axes
        cos = math.cos(math.radians(self.divergence / 2))
        d_x, d_y = (cos * n[i] + u * e_x[i] + v * e_y[i] for i in (0, 1))
        direction = d_x, d_y, math.sqrt(max(1 - d_x * d_x - d_y * d_y, 0.0))
        return replace(self, divergence=None, tilt=tilt_of(direction))

    def irradiance(self, x: Tensor, y: Tensor, z: float) -> Tensor:
        """E(x, y) (1/mm²) on any plane z; the flux through the aperture is 1."""
        if (shift := self.shift(z)) != (0.0, 0.0):
            x, y = x - shift[0], y - shift[1]
        inside = self.aperture.contains(x, y)
        if self.profile == "uniform":
            return torch.where(inside, torch.full_like(x, 1 / self.aperture.area), torch.zeros_like(x))
        w2 = self.radius_1e2**2
        peak = elementary(torch.exp, -2 * (x * x + y * y) / w2) / self._gaussian_flux()
        return torch.where(inside, peak, torch.zeros_like(x))

    def _gaussian_flux(self) -> float:
        """∫ exp(-2 r² / w²) over the aperture (mm²)."""
        w = self.radius_1e2
        if self.aperture.is_round:
            return math.pi * w * w / 2 * -math.expm1(-2 * (self.aperture.radius / w) ** 2)
        a, b = self.aperture.half_extent
        return math.pi * w * w / 2 * math.erf(math.sqrt(2) * a / w) * math.erf(math.sqrt(2) * b / w)

    def beam(self, z: float) -> Beam:
        """`irradiance` on the plane z (mm) as numbers."""
        (x, y), limits = floats(self.shift(z)), floats(self.aperture.limits)
        peak, fall, start = 1 / self.aperture.area, 0.0, abs(float(z - self.start(z)))
        if self.profile == "gaussian":
            peak, fall = 1 / self._gaussian_flux(), 2 / self.radius_1e2**2
        axis = ALONG_Z
        if self.tilted:
            n, sense = self.axes[2], 1 if self.start(z) <= z else -1
            axis = (1, *floats((sense * n[0], sense * n[1], n[2])), 0.0)
        return Beam(x, y, *limits, peak, fall, 0, 0.0, start, *axis)

    @property
    def slopes(self) -> tuple[float, float]:
        """(dx/dz, dy/dz) of its rays."""
        n = self.axes[2]
        return n[0] / n[2], n[1] / n[2]

    def shift(self, z: float) -> tuple[float, float]:
        """Where the middle of the light is on the plane z (mm)."""
        x, y = self.centre or (0.0, 0.0)
        if not self.tilted or self.z is None:
            return x, y
        a, b = self.slopes
        return x + (z - self.z) * a, y + (z - self.z) * b

    def window(self, outline: Outline, z: float, sags: tuple[float, ...]) -> Rectangle:
        """The rectangle of the plane z that holds all the light: the aperture's bounding box.

        Of light that is tilted or beside the axis it need hold only the part that can meet the first surface inside its
        outline, between the sags (mm).
        """
        half = [a + abs(s) for a, s in zip(self.aperture.half_extent, self.shift(z), strict=True)]
        if self.tilted or self.centre is not None:
            deep = max(map(abs, sags))
            seen = (h + deep * abs(s) for h, s in zip(outline.half_extent, self.slopes, strict=True))
            half = [min(h, s * (1 + 1e-9)) for h, s in zip(half, seen, strict=True)]  # room for rounding
        return Rectangle(2 * half[0], 2 * half[1])

    def spot(self, z: float) -> tuple[Outline | None, tuple[float, float]]:
        """(outline, centre in mm) of the light on the plane z, None where it has no edge: the aperture."""
        return self.aperture, self.shift(z)

    def rays(self, x: Tensor, y: Tensor, z: float, area: float) -> Rays:
        """Rays through (x, y) of the plane z, starting on a plane before it (`start`)."""
        start = self.start(z)
        sense = 1 if start <= z else -1
        n = self.axes[2] if self.tilted else (0.0, 0.0, 1.0)
        direction = torch.zeros((3, 1), dtype=x.dtype, device=x.device)
        for row, along in enumerate(n):
            if along:
                direction[row] = sense * along
        direction = direction.view(3, *([1] * x.ndim)).expand(3, *x.shape)
        from_x, from_y = x, y
        if self.tilted:
            (a, b), way = self.slopes, z - start
            from_x, from_y = x - way * a, y - way * b
        position = torch.stack([from_x, from_y, torch.zeros_like(x)])
        flux = self.irradiance(x, y, z) * area
        return Rays(position, direction, flux, all_alive(x), axial=not self.tilted, z=start, sense=sense)

    def start(self, z: float) -> float:
        """The plane the rays start from (mm) for a front whose vertex is on the plane z.

        A front that they can meet r from the axis, no more than a half sphere, reaches at most r towards them.
        Tilted rays come nearer to the axis on the way to the plane, and start further off.
        """
        if self.z is not None:
            return self.z
        furthest = self.aperture.radius if self.aperture.is_round else math.hypot(*self.aperture.half_extent)
        if self.centre is not None:
            furthest += math.hypot(*self.centre)
        if self.tilted:
            furthest *= 1 + 4 * math.hypot(*self.slopes)
        return min(0.0, z - furthest)
