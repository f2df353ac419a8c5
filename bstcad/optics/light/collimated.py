"""Parallel light through an aperture: one direction, or a cone of directions."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated, Literal

import torch
from torch import Tensor

from bstcad.optics.light.emitters import PROFILE_NAMES, Emitter, LumensKey, OneOrTwo, TiltKey, WavelengthKey, all_alive
from bstcad.optics.light.profiles import GAUSSIAN, MeasuredProfile, Profile, pair_of
from bstcad.optics.numerics.records import NO_PATTERN, Beam
from bstcad.optics.numerics.reductions import elementary
from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.outlines import STRICT, Circle, Outline, Rectangle
from bstcad.optics.surfaces.rays import Rays, clocked, tilt_of

WIDTHS_BEFORE_LENS = 4.0  # distance of aperture and lens for a rotated beam without z, in diagonals of the aperture
ProfileName = Literal["uniform", "gaussian", "super_gaussian", "annular"]
MAX_INCLINATION = 89.0  # limit of the angle between light and the axis of the lens, degrees


@dataclass(frozen=True)
class CollimatedSource(Emitter):
    """Parallel rays through an aperture, on whose plane z the irradiance is that of a profile.

    uniform: constant.  gaussian: ∝ exp(-2 r² / radius_1e2²), or with two radii (w_x, w_y) ∝ exp(-2 q), q = x² / w_x² +
    y² / w_y².  super_gaussian: ∝ exp(-2 q^(order / 2)).  annular: constant outside inner_radius.  `rotate` turns the
    profile and the divergence about the axis, from x towards y.  A record with a `law` (profiles.Profile) is a measured
    irradiance.

    With a tilt the rays go along n = (n_x, n_y, n_z) (rays.axes).  On another plane the light is shifted by
    (n_x, n_y) / n_z times the distance, and its irradiance on planes z = const is unchanged.  With a divergence the
    rays have all directions of a cone about the axis, at equal radiance: the flux through the plane is uniform in
    (d_x, d_y), whose range for a half angle α is an ellipse about cos α (n_x, n_y).  Two divergences are full angles of
    an elliptical cone along e_x and e_y, with sines sin α_x and sin α_y and the mean cosine (cos α_x + cos α_y) / 2.
    """

    aperture: Annotated[Outline, Key("Beam outline about source.centre.", example={"shape": "circle", "radius": 12.0})]
    wavelength: WavelengthKey = 587.6
    profile: Annotated[ProfileName | MeasuredProfile, Key("Irradiance over the aperture.")] = "uniform"
    radius_1e2: Annotated[
        OneOrTwo | None,
        Key("Radius at which the profile is 1/e² of its peak; two: along x, along y.", "mm", 1e-3, 1e6, example=8.0),
    ] = None
    # None: the plane of the lens's first vertex; rays start at z = 0, or below if the front may reach it (`start`)
    z: Annotated[float | None, Key("Plane of the aperture, where rays start.", "mm", -1e8, 1e8, example=0.0)] = None
    centre: Annotated[
        tuple[float, float] | None, Key("Centre of aperture and profile.", "mm", -1e8, 1e8, example=[2.0, 0.0])
    ] = None
    tilt: TiltKey = None
    divergence: Annotated[
        OneOrTwo | None, Key("Full angle of the cone of rays, simulated; two: along x, along y.", "degrees", 0.0, 179.0)
    ] = None
    real_divergence: Annotated[
        float | None, Key("Full divergence angle of the real lamp, for estimates only.", "degrees", 0.0, 179.0)
    ] = None
    order: Annotated[
        float | None, Key("Order of a super_gaussian: 2 is a Gaussian, 10 is nearly uniform.", "", 2.0, 100.0)
    ] = None
    inner_radius: Annotated[
        float | None, Key("Radius of the dark centre of an annular profile.", "mm", 1e-3, 1e6, example=3.0)
    ] = None
    rotate: Annotated[
        float | None, Key("Rotation of profile and divergence, from x towards y.", "degrees", -180.0, 180.0)
    ] = None
    lumens: LumensKey = None
    kind: Annotated[Literal["collimated"], Key("Parallel light.")] = "collimated"

    __pydantic_config__ = STRICT
    size_key, parallel, simple_name = "divergence", True, "parallel light of one direction"
    widths = MappingProxyType(
        {"gaussian": ("radius_1e2",), "super_gaussian": ("radius_1e2", "order"), "annular": ("inner_radius",)}
    )

    @property
    def start_plane(self) -> float | None:
        """z (mm) of the plane of the aperture; None: not stated."""
        return self.z

    def complaints(self, z: float, optic: str) -> Iterator[str]:
        """Yield a sentence if directions are inclined too far to the axis, or the profile leaves no light."""
        if self.inner_radius is not None and not self.inner_radius < min(self.aperture.half_extent):
            yield "inner_radius: the dark centre reaches the rim of source.aperture; make it smaller"
        elif self.law is not None and not self.law.flux(self.aperture) > 0:
            yield "profile: the beam has no light inside source.aperture; move it, or widen the aperture"
        lean = math.degrees(math.acos(max(-1.0, min(1.0, self.axes[2][2]))))
        if not lean + max(self.half_angles) < MAX_INCLINATION:
            key, light = ("divergence", "a part of the light") if self.extent else ("tilt", "the light")
            yield f"{key}: {light} is inclined to the axis by {MAX_INCLINATION:g} degrees or more; reduce the {key}"

    def words(self, origin: float) -> str:
        """Return profile, divergence and aperture for a data sheet."""
        angles = " × ".join(f"{2 * half:.4g}°" for half in dict.fromkeys(self.half_angles))
        spread = f"divergence {angles}, " if self.extent else ""
        return f"parallel light, {self.profile_words}, {spread}{self.aperture.words.replace(' x ', ' × ')}"

    @property
    def profile_words(self) -> str:
        """Name of the profile, with its radii where there are two."""
        if isinstance(self.profile, MeasuredProfile):
            return self.profile.words
        name = PROFILE_NAMES[self.profile]
        if isinstance(self.radius_1e2, tuple):
            name += f" {' × '.join(f'{w:.4g}' for w in self.radius_1e2)} mm"
        return name + (f", rotated by {self.rotate:.4g}°" if self.rotate else "")

    def sizes(self) -> Iterator[tuple[str, OneOrTwo, str]]:
        """Yield the divergence, if there is one."""
        if self.divergence and self.extent:
            yield "divergence", self.divergence, "degrees"

    @property
    def is_rotation_invariant(self) -> bool:
        """True if aperture, profile and cone of directions are round."""
        return self.aperture.is_round and not self.can_rotate

    def moved(self, motion: Motion, entrance: float) -> CollimatedSource:
        """Return the simple beam after a motion; entrance: z of the plane through the first vertex (mm).

        The aperture keeps its size in a plane z = const when the light is rotated, so the beam gets too narrow across
        its direction.  If light along z is rotated by θ, the factor is cos θ: at 0.1 degrees, 1.5e-6 less than 1.
        """
        if not (motion.rotates or self.tilted):  # light along z has the same irradiance on all planes
            x, y = (p + d for p, d in zip(self.centre or (0.0, 0.0), motion.shift, strict=False))
            return self if (x, y) == (0.0, 0.0) and self.centre is None else replace(self, centre=(x, y))
        width = 2 * math.hypot(*self.aperture.half_extent)
        z, plane = (entrance - WIDTHS_BEFORE_LENS * width, entrance) if self.z is None else (self.z, self.z)
        normal = motion.direction(self.axes[2])
        x, y, reached = motion.point((*self.shift(plane), plane))
        distance = z - reached
        centre = x + distance * normal[0] / normal[2], y + distance * normal[1] / normal[2]
        return replace(self, z=z, centre=centre, tilt=tilt_of(normal))

    @property
    def half_angles(self) -> tuple[float, float]:
        """Half angles (degrees) of the cone along x and y of the beam, which `rotate` turns; 0: parallel."""
        along_x, along_y = pair_of(self.divergence or 0.0)
        return along_x / 2, along_y / 2

    @property
    def extent(self) -> Circle | None:
        """Disc of the direction cosines along e_x and e_y; None: all rays are parallel.

        Its radius is the sine of the larger half angle.  `element` compresses the disc to the ellipse of two angles.
        """
        return Circle(math.sin(math.radians(max(self.half_angles)))) if any(self.half_angles) else None

    @property
    def central(self) -> CollimatedSource:
        """Beam of the mean direction, at the main wavelength."""
        return replace(self, wavelength=self.main_wavelength, divergence=None)

    def scaled(self, share: float) -> CollimatedSource:
        """Return the beam with its divergence multiplied by `share`."""
        if not (share and self.divergence):
            return replace(self, divergence=None)
        along_x, along_y = (share * angle for angle in pair_of(self.divergence))
        return replace(self, divergence=(along_x, along_y) if isinstance(self.divergence, tuple) else along_x)

    def element(self, u: float, v: float) -> CollimatedSource:
        """Return the beam at (u, v) of the extent: d_x and d_y from cos α n + u e_x + v e_y, and d_z from |d| = 1.

        For two half angles, u and v are multiplied by sin α_x and sin α_y over the larger of them, e_x and e_y are
        turned by `rotate`, and cos α is the mean of both cosines.
        """
        frame, angles = self.axes, [math.radians(half) for half in self.half_angles]
        if angles[0] != angles[1]:
            largest = math.sin(max(angles))
            u, v = (part * math.sin(angle) / largest for part, angle in zip((u, v), angles, strict=True))
            frame = clocked(frame, self.rotate or 0.0)
        e_x, e_y, n = frame
        cos = (math.cos(angles[0]) + math.cos(angles[1])) / 2
        d_x, d_y = (cos * n[i] + u * e_x[i] + v * e_y[i] for i in (0, 1))
        direction = d_x, d_y, math.sqrt(max(1 - d_x * d_x - d_y * d_y, 0.0))
        return replace(self, divergence=None, tilt=tilt_of(direction))

    @property
    def can_rotate(self) -> bool:
        """True if the profile or the cone of directions is not round."""
        is_round = self.law is None or self.law.is_round  # reads a measured profile
        return not is_round or self.half_angles[0] != self.half_angles[1]

    @property
    def law(self) -> Profile | None:
        """Irradiance over the aperture, from its centre; None: a closed form, uniform or round Gaussian."""
        pair, turn = pair_of(self.radius_1e2 or 0.0), self.rotate or 0.0
        if isinstance(self.profile, MeasuredProfile):
            return replace(self.profile.law, rotate=turn)
        if self.profile == "annular":
            return Profile(inner=self.inner_radius or 0.0)
        if self.profile == "super_gaussian":
            return Profile(pair, self.order or GAUSSIAN, rotate=turn)
        return Profile(pair, rotate=turn) if self.profile == "gaussian" and pair[0] != pair[1] else None

    def irradiance(self, x: Tensor, y: Tensor, z: float) -> Tensor:
        """Return E(x, y) (1/mm²) of the mean direction on any plane z; the flux through the aperture is 1."""
        if (shift := self.shift(z)) != (0.0, 0.0):
            x, y = x - shift[0], y - shift[1]
        inside = self.aperture.contains(x, y)
        if (law := self.law) is not None:
            return torch.where(inside, law.density(x, y) / law.flux(self.aperture), torch.zeros_like(x))
        if self.profile == "uniform":
            return torch.where(inside, torch.full_like(x, 1 / self.aperture.area), torch.zeros_like(x))
        flux, w2 = self._gaussian()
        peak = elementary(torch.exp, -2 * (x * x + y * y) / w2) / flux
        return torch.where(inside, peak, torch.zeros_like(x))

    def _gaussian(self) -> tuple[float, float]:
        """Return (∫ exp(-2 r² / w²) over the aperture, w²) of a gaussian profile, w: radius_1e2, each in mm²."""
        assert self.radius_1e2 is not None  # a gaussian profile needs it (`widths`)
        w = max(pair_of(self.radius_1e2))
        if isinstance(self.aperture, Circle):
            return math.pi * w * w / 2 * -math.expm1(-2 * (self.aperture.radius / w) ** 2), w**2
        a, b = self.aperture.half_extent
        return math.pi * w * w / 2 * math.erf(math.sqrt(2) * a / w) * math.erf(math.sqrt(2) * b / w), w**2

    def beam(self, z: float) -> Beam:
        """Return the parameters of `irradiance` on the plane z (mm) for the kernels."""
        (x, y), (a, b, r2) = map(float, self.shift(z)), map(float, self.aperture.limits)
        peak, fall, start, pattern = 1 / self.aperture.area, 0.0, abs(float(z - self.start(z))), NO_PATTERN
        if (law := self.law) is not None:
            peak, pattern = 1 / law.flux(self.aperture), law.pattern()
        elif self.profile == "gaussian":
            flux, w2 = self._gaussian()
            peak, fall = 1 / flux, 2 / w2
        light = Beam(x, y, a, b, limit_r2=r2, peak=peak, fall=fall, start=start, pattern=pattern)
        if not self.tilted:
            return light
        (n_x, n_y, n_z), sense = self.axes[2], 1 if self.start(z) <= z else -1
        return light._replace(tilted=1, n_x=sense * n_x, n_y=sense * n_y, n_z=n_z)

    @property
    def slopes(self) -> tuple[float, float]:
        """Slopes (dx/dz, dy/dz) of the rays."""
        n = self.axes[2]
        return n[0] / n[2], n[1] / n[2]

    def shift(self, z: float) -> tuple[float, float]:
        """Return the centre (mm) of the light on the plane z."""
        x, y = self.centre or (0.0, 0.0)
        if not self.tilted or self.z is None:
            return x, y
        a, b = self.slopes
        return x + (z - self.z) * a, y + (z - self.z) * b

    def window(self, outline: Outline, z: float, sags: tuple[float, ...]) -> Rectangle:
        """Return the rectangle of the plane z, centred on the axis, that contains all the light.

        For light that is tilted or off the axis the rectangle contains only the part that can meet the first surface
        inside its outline, between the sags (mm).
        """
        half = [a + abs(s) for a, s in zip(self.aperture.half_extent, self.shift(z), strict=True)]
        if self.tilted or self.centre is not None:
            depth = max(map(abs, sags))
            apparent = (h + depth * abs(s) for h, s in zip(outline.half_extent, self.slopes, strict=True))
            half = [min(h, s * (1 + 1e-9)) for h, s in zip(half, apparent, strict=True)]  # margin for rounding
        return Rectangle(2 * half[0], 2 * half[1])

    def spot(self, z: float) -> tuple[Outline | None, tuple[float, float]]:
        """Return (aperture, centre in mm) of the light on the plane z."""
        return self.aperture, self.shift(z)

    def rays_through(self, x: Tensor, y: Tensor, z: float, area: float) -> Rays:
        """Return rays through (x, y) of the plane z, which start on a plane before it (`start`)."""
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
            (a, b), distance = self.slopes, z - start
            from_x, from_y = x - distance * a, y - distance * b
        position = torch.stack([from_x, from_y, torch.zeros_like(x)])
        flux = self.irradiance(x, y, z) * area
        return Rays(position, direction, flux, all_alive(x), axial=not self.tilted, z=start, sense=sense)

    def start(self, z: float) -> float:
        """Return z (mm) of the plane from which rays start, for a front whose vertex is on the plane z.

        At a distance r from the axis a front, at most a half sphere, reaches at most r towards the rays.  Tilted rays
        may move towards the axis on the way to the plane, so they start further away.
        """
        if self.z is not None:
            return self.z
        furthest = self.aperture.radius if isinstance(self.aperture, Circle) else math.hypot(*self.aperture.half_extent)
        if self.centre is not None:
            furthest += math.hypot(*self.centre)
        if self.tilted:
            furthest *= 1 + 4 * math.hypot(*self.slopes)
        return min(0.0, z - furthest)
