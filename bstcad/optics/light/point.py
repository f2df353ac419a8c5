"""Light of a point source, or of a disc or a rectangle of point sources."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated, Literal

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.light.emitters import PROFILE_NAMES, Emitter, LumensKey, OneOrTwo, TiltKey, WavelengthKey, all_alive
from bstcad.optics.light.measured_rays import MeasuredRays
from bstcad.optics.light.profiles import MeasuredProfile, Profile, pair_of
from bstcad.optics.light.ray_bundle import RayBundle
from bstcad.optics.light.wavefront import path_from_sphere
from bstcad.optics.numerics.records import Beam
from bstcad.optics.numerics.reductions import elementary
from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.outlines import EVERYWHERE, STRICT, Circle, Outline, Rectangle
from bstcad.optics.surfaces.rays import Frame, Rays, Vector, clocked, point_along, tilt_of

SIZE_KEYS = "diameter", "width", "height"  # scene keys of the size of an emitting disc or rectangle
HALF_SPACE = math.pi / 2  # rad, half angle of light that fills the half space on the side of the lens
MAX_CONE_HALF_ANGLE = math.radians(89.0)  # rad, half angle below which light has an edge on planes (`is_cone`)


@dataclass(frozen=True)
class PointSource(Emitter):
    """Rays from one point into the half space on the side of the lens.

    gaussian: irradiance on z = const ∝ exp(-2 r² / w²), r from the axis, w = distance · tan(half_angle_1e2); with two
    angles ∝ exp(-2 (x² / w_x² + y² / w_y²)), turned about the axis by `rotate`, from x towards y.
    lambertian: radiant intensity ∝ cos θ, up to half_angle if stated.  uniform: constant intensity up to half_angle.
    A tilt rotates the whole distribution, with its half space, about the point (`_tilted_irradiance`); light that then
    leads away from the lens misses it.  A disc or rectangle of points is perpendicular to the axis of the source.
    """

    position: Annotated[
        tuple[float, float, float], Key("Position of the point, or centre of the disc or rectangle.", "mm", -1e8, 1e8)
    ] = (0.0, 0.0, 0.0)
    wavelength: WavelengthKey = 587.6
    profile: Annotated[Literal["gaussian", "lambertian", "uniform"], Key("Radiant intensity by angle.")] = "lambertian"
    half_angle_1e2: Annotated[
        OneOrTwo | None,
        Key(
            "Angle at which a gaussian profile's irradiance on a plane is 1/e² of its peak; two: towards x, towards y.",
            "degrees",
            1e-3,
            89.0,
        ),
    ] = None
    half_angle: Annotated[
        float | None, Key("Angle from the axis at which a uniform or lambertian profile ends.", "degrees", 1e-3, 90.0)
    ] = None
    diameter: Annotated[float | None, Key("Diameter of an emitting disc, simulated.", "mm", 0.0, 1e6)] = None
    width: Annotated[
        float | None, Key("Width of an emitting rectangle along its x axis, simulated.", "mm", 0.0, 1e6, example=1.0)
    ] = None
    height: Annotated[
        float | None, Key("Height of an emitting rectangle along its y axis, simulated.", "mm", 0.0, 1e6, example=1.0)
    ] = None
    tilt: TiltKey = None
    real_diameter: Annotated[float | None, Key("Diameter of the real lamp, for estimates only.", "mm", 0.0, 1e6)] = None
    intensity: Annotated[MeasuredProfile | None, Key("Radiant intensity over directions, in place of a profile.")] = (
        None
    )
    rays: Annotated[MeasuredRays | None, Key("Rays of a lamp, in place of a profile and a size.")] = None
    rotate: Annotated[
        float | None, Key("Rotation of the profile about its axis, from x towards y.", "degrees", -180.0, 180.0)
    ] = None
    lumens: LumensKey = None
    kind: Annotated[Literal["point"], Key("A point, or with a size a disc or rectangle of points.")] = "point"

    __pydantic_config__ = STRICT
    size_key, simple_name, start_key = "diameter", "a point", "position"
    widths = MappingProxyType(
        {"gaussian": ("half_angle_1e2",), "uniform": ("half_angle",), "lambertian": ("half_angle",)}
    )
    unbounded = "lambertian"  # without half_angle a lambertian fills the half space

    @property
    def measured(self) -> MeasuredProfile | None:
        """Light of a file; None: a profile with a formula."""
        return self.rays if self.intensity is None else self.intensity

    @property
    def remarks(self) -> Iterator[str]:
        """Sentences, each with its key, on readings that a file of the source does not state plainly."""
        key = "intensity" if self.rays is None else "rays"
        yield from (f"source.{key}: {remark}" for remark in (() if self.measured is None else self.measured.remarks))

    def emission_centre(self, sense: int = 1) -> Vector:
        """Return the position of the point, or of the centre of the disc or rectangle (mm); sense: of the light.

        With rays, `position` is that of the origin of their file's coordinates.
        """
        if self.rays is None:
            return self.position
        place = self.position
        for part, axis in zip(self.rays.facts.origin, self.file_axes(sense), strict=True):
            place = point_along(place, part, axis)
        return place

    def _seen_from(self, z: float) -> tuple[Vector, int]:
        """Return the centre (mm) for light to the plane z, and the sense of this light."""
        sense = 1 if self.position[2] <= z else -1
        return self.emission_centre(sense), sense

    def file_axes(self, sense: int) -> Frame:
        """Return the axes in space of the coordinates of a file; sense: of the light (see Rays).

        A file describes a real lamp, which is rotated about e_x, not mirrored, to light a plane below it.
        """
        e_x, (y_x, y_y, y_z), (n_x, n_y, n_z) = self.axes
        if sense > 0:
            return clocked(self.axes, self.rotate or 0.0)
        return clocked((e_x, (-y_x, -y_y, -y_z), (-n_x, -n_y, -n_z)), -(self.rotate or 0.0))

    @property
    def start_plane(self) -> float:
        """z (mm) of the point, or of the centre of the disc or rectangle."""
        return self.emission_centre()[2]

    def nearest_z(self, upwards: bool) -> float:
        """Return z (mm) of the point of the source that is nearest to a lens above it (upwards) or below it."""
        reach = 0.0 if self.extent is None else self.extent.reach(*(axis[2] for axis in self.axes[:2]))
        return self.emission_centre(1 if upwards else -1)[2] + (reach if upwards else -reach)

    @property
    def luminous_flux(self) -> float | None:
        """Luminous flux as stated, or by the file of the intensity (lm); None: not stated."""
        return self.lumens or (None if self.measured is None else self.measured.lumens)

    def complaints(self, z: float, optic: str) -> Iterator[str]:
        """Yield faults of the sizes as "key: sentence"; z: plane of the first face (mm), optic: "lens" or "mirror"."""
        if self.measured is not None:
            kind = "an intensity" if self.rays is None else "rays"
            others = {"profile": self.profile != "lambertian", "half_angle": self.half_angle is not None}
            if self.rays is not None:
                others |= {key: getattr(self, key) is not None for key in ("intensity", *SIZE_KEYS, "real_diameter")}
                if self.rays.facts.lines and self.wavelength != PointSource.wavelength:
                    yield "wavelength: the file of the rays states wavelengths of its own; remove this key"
            yield from (f"{key}: the source also has {kind}; remove one of them" for key in others if others[key])
        given = [name for name in ("width", "height") if getattr(self, name) is not None]
        if given and self.diameter is not None:
            yield f"diameter: the source also has a {given[0]}; give a diameter, or width and height"
        for other in {"width", "height"} - set(given) if given else ():
            yield f"{other}: the key is missing; add it in mm, since the source has a {given[0]}"
        sizes = {name: getattr(self, name) or 0.0 for name in SIZE_KEYS}
        name, distance = max(sizes, key=lambda key: sizes[key]), abs(z - self.position[2])
        if self.extent is not None and not sizes[name] <= distance:
            far = f"the {distance:g} mm from the source to the {optic}"
            yield f"{name}: {sizes[name]:g} mm is more than {far}; make the source smaller or move it away"

    def reference(self, place: Tensor, z: float, sense: int) -> Tensor:
        """Return the path (mm) from a sphere about the source, with o = (0, 0, z) on it, to points o + place (3, …)."""
        x, y, start = self.emission_centre(sense)
        return path_from_sphere(place, (x, y, start - z))

    def words(self, origin: float) -> str:
        """Return position, profile, cone and sizes for a data sheet; origin: z (mm) from which the sheet measures."""
        x, y, z = self.position
        position = ", ".join(f"{round(p, 3) + 0.0:.9g}" for p in (x, y, z - origin)).replace("-", "−")
        angle = self.half_angle or self.half_angle_1e2
        sizes = [f"half angle {' × '.join(f'{a:.4g}°' for a in dict.fromkeys(pair_of(angle)))}"] if angle else []
        sizes += [f"rotated by {self.rotate:.4g}°"] if self.rotate else []
        sizes += (f"{key} {size:.4g} {unit}" for key, size, unit in self.sizes())
        kind = "point" if self.extent is None else "disc" if self.extent.is_round else "rectangle"
        name = PROFILE_NAMES[self.profile] if self.measured is None else self.measured.words
        return ", ".join([f"{kind} at ({position}) mm", name, *sizes])

    def sizes(self) -> Iterator[tuple[str, float, str]]:
        """Yield (key, value, unit) of diameter, width and height, if stated; of rays, the larger size of the model."""
        yield from ((key, size, "mm") for key in SIZE_KEYS if (size := getattr(self, key)))
        if self.rays is not None and self.extent is not None:
            yield "rays", float(f"{2 * max(self.extent.half_extent):.3g}"), "mm wide"

    @property
    def is_rotation_invariant(self) -> bool:
        """True for a point or a disc with a round profile."""
        return (self.extent is None or self.extent.is_round) and (self.law is None or self.law.is_round)

    def moved(self, motion: Motion, entrance: float) -> PointSource:
        """Return the point source after a motion; entrance: not used."""
        tilt = self.tilt if not motion.rotates else tilt_of(motion.direction(self.axes[2]))
        return replace(self, position=motion.point(self.position), tilt=tilt)

    def with_wider_cone(self, by: float) -> PointSource | None:
        """Return the source with the tangent of its half angle larger by the fraction `by`; None: no half angle."""

        def wider(angle: float) -> float:
            return math.degrees(math.atan((1 + by) * math.tan(math.radians(angle))))

        if self.measured is not None:
            return None
        if isinstance(self.half_angle_1e2, tuple):
            across, up = map(wider, self.half_angle_1e2)
            return replace(self, half_angle_1e2=(across, up))
        if self.half_angle_1e2:
            return replace(self, half_angle_1e2=wider(self.half_angle_1e2))
        return replace(self, half_angle=wider(self.half_angle)) if self.half_angle else None

    def moved_away(self, by: float, about: Vector) -> PointSource:
        """Return the source with its distance from the point `about` (mm) larger by the fraction `by`."""
        middle = np.array(about)
        return replace(self, position=tuple((middle + (1 + by) * (np.array(self.position) - middle)).tolist()))

    @property
    def extent(self) -> Outline | None:
        """Emitting disc or rectangle (mm); None: a point."""
        if self.rays is not None and self.rays.facts.extent is not None:
            return self.rays.facts.extent
        if self.diameter:
            return Circle(self.diameter / 2)
        return Rectangle(self.width or 0.0, self.height or 0.0) if self.width or self.height else None

    @property
    def central(self) -> PointSource:
        """Point source at the centre, at the main wavelength."""
        return replace(self.scaled(0.0), wavelength=self.main_wavelength)

    def scaled(self, share: float) -> PointSource:
        """Return the source with diameter, width and height multiplied by `share`."""
        sizes = self.diameter, self.width, self.height
        diameter, width, height = (share * size if share and size else None for size in sizes)
        rays = None if self.rays is None else self.rays.scaled(share)
        return replace(self, diameter=diameter, width=width, height=height, rays=rays)

    def element(self, x: float, y: float) -> PointSource:
        """Return the point source at (x, y) (mm) of the extent."""
        e_x, e_y, _ = self.axes if self.rays is None else self.file_axes(1)
        position = point_along(point_along(self.position, x, e_x), y, e_y)
        return replace(self.scaled(0.0), position=position)

    @property
    def lines(self) -> tuple[tuple[float, float], ...]:
        """(nm, fraction of the flux) of each spectral line; those of a file of rays, if it states wavelengths."""
        return self.rays.facts.lines if self.rays is not None and self.rays.facts.lines else super().lines

    @property
    def main_wavelength(self) -> float:
        """Wavelength (nm) of the line with the largest weight."""
        return self.lines[0][0] if self.rays is not None and self.rays.facts.lines else super().main_wavelength

    def bundle(self, line: int, part: int = 0) -> RayBundle | None:
        """Return the rays of a spectral line, from one of the parts of the file; None: there is only a model."""
        order = None if self.rays is None else self.rays.rays_of(line)
        if order is None or self.rays is None:
            return None
        frames = self.file_axes(1), self.file_axes(-1)
        return RayBundle(order, self.position, frames, wavelength=self.lines[line][0], part=part)

    def irradiance(self, x: Tensor, y: Tensor, z: float) -> Tensor:
        """Return E(x, y) (1/mm²) on the plane z (mm); the flux into the half space is 1.

        gaussian: 2 / (π w²) exp(-2 r² / w²), r and w as in `PointSource`.  lambertian: I = cos θ / (π sin² θ_max) and
        E = I cos θ / d², so E = D² / (π sin² θ_max d⁴), D and d the distances of plane and (x, y, z) from the source.
        uniform: I = 1 / (2π (1 - cos θ_max)), E = I D / d³.  The last two are zero beyond θ_max, the half angle `edge`.
        """
        (start_x, start_y, start_z), _ = self._seen_from(z)
        distance = abs(z - start_z)
        if self.law is not None:
            return self._irradiance_of(self.law, x - start_x, y - start_y, z)
        if self.tilted:
            return self._tilted_irradiance(x - start_x, y - start_y, distance, self.towards(z))
        r2 = (x - start_x) ** 2 + (y - start_y) ** 2
        d2 = r2 + distance**2
        if self.profile == "gaussian":
            w2 = (distance * self._spread) ** 2
            return 2 / (math.pi * w2) * elementary(torch.exp, -2 * r2 / w2)
        edge = self.edge
        if self.profile == "lambertian":
            e = distance**2 / (math.pi * math.sin(edge) ** 2 * d2 * d2)
        else:
            intensity = 1 / (2 * math.pi * (1 - math.cos(edge)))
            e = intensity * distance / (d2 * torch.sqrt(d2))
        return e if edge == HALF_SPACE else torch.where(r2 <= (distance * math.tan(edge)) ** 2, e, torch.zeros_like(e))

    @property
    def can_rotate(self) -> bool:
        """True if the profile is not round."""
        return self.law is not None and not self.law.is_round

    @property
    def law(self) -> Profile | None:
        """Irradiance on a plane at distance 1 across the axis; None: a closed form of its own."""
        if self.measured is not None:
            return replace(self.measured.law, rotate=self.rotate or 0.0)
        if self.profile != "gaussian" or not isinstance(self.half_angle_1e2, tuple):
            return None
        across, up = (math.tan(math.radians(angle)) for angle in self.half_angle_1e2)
        return Profile((across, up), rotate=self.rotate or 0.0)

    def _placed(self, law: Profile, sense: int) -> tuple[Profile, Frame]:
        """Return a profile and its axes; sense: of the light.

        An intensity is that of a real lamp, which is rotated about e_x to light a plane below it, not mirrored.
        """
        e_x, e_y, n = self.axes
        if not law.stereographic or sense > 0:
            return law, (e_x, e_y, n)
        return replace(law, rotate=-law.rotate), (e_x, (-e_y[0], -e_y[1], -e_y[2]), n)

    def _irradiance_of(self, law: Profile, x: Tensor, y: Tensor, z: float) -> Tensor:
        """Return the irradiance on the plane z at distance D, at p = (x, y, D) from the source.

        It is E(u, v) D / c³, c = n · p, or E(u, v) D / |p|³ if E is an intensity over stereographic coordinates.
        """
        centre, sense = self._seen_from(z)
        distance = abs(z - centre[2])
        law, (e_x, e_y, _) = self._placed(law, sense)
        n = self.towards(z)
        c = n[0] * x + n[1] * y + n[2] * distance
        along = torch.sqrt(x * x + y * y + distance**2)
        ahead = torch.ones_like(c, dtype=torch.bool) if law.stereographic else c > 0
        c = c + along if law.stereographic else torch.where(ahead, c, torch.ones_like(c))
        u, v = ((e[0] * x + e[1] * y + sense * e[2] * distance) / c for e in (e_x, e_y))
        cube = along**3 if law.stereographic else c * c * c
        e = law.density(u, v) / law.flux(EVERYWHERE) * distance / cube
        return torch.where(ahead, e, torch.zeros_like(e))

    @property
    def _spread(self) -> float:
        """1/e² radius of a gaussian profile divided by the distance: tan(half_angle_1e2)."""
        assert self.half_angle_1e2 is not None  # a gaussian profile needs it (`widths`)
        return math.tan(math.radians(pair_of(self.half_angle_1e2)[0]))

    @property
    def edge(self) -> float:
        """Half angle (rad) at which a uniform or lambertian profile ends; π / 2: the half space."""
        limit = self.half_angle if self.measured is None else self.measured.half_angle
        return HALF_SPACE if limit is None or self.profile == "gaussian" else math.radians(min(limit, 90.0))

    @property
    def is_cone(self) -> bool:
        """True if the light is a cone with an edge on planes before the lens."""
        return self.edge < MAX_CONE_HALF_ANGLE

    def towards(self, z: float) -> Vector:
        """Return the unit vector of the light's axis towards the plane z, in a frame whose +z points to that plane."""
        n, sense = self.axes[2], 1 if self.position[2] <= z else -1
        return sense * n[0], sense * n[1], n[2]

    def _tilted_irradiance(self, x: Tensor, y: Tensor, distance: float, axis: Vector) -> Tensor:
        """Return E of a tilted source with axis n on a plane at distance D, at (x, y) (mm) relative to the source.

        E = I(θ) D / d³, and zero where c = n · (x, y, D) = d cos θ <= 0.  lambertian: I = cos θ / (π sin² θ_max),
        E = D c / (π sin² θ_max d⁴); uniform: I is constant; both are zero where cos θ < cos θ_max.  gaussian: on planes
        perpendicular to n E ∝ exp(-2 tan² θ / t²), t = tan(half_angle_1e2), so I = 2 / (π t²) exp(-2 tan² θ / t²) /
        cos³ θ, and E = 2 D / (π t² c³) exp(-2 (d² - c²) / (t² c²)).
        """
        d2 = x * x + y * y + distance**2
        c = axis[0] * x + axis[1] * y + axis[2] * distance
        ahead = c > 0
        c = torch.where(ahead, c, torch.ones_like(c))
        peak, fall, _, min_cosine = self._tilted_law(distance)
        if self.profile == "gaussian":
            c2 = c * c
            e = peak * elementary(torch.exp, -fall * (d2 - c2) / c2) / (c2 * c)
        else:
            d = torch.sqrt(d2)
            if min_cosine:
                ahead = ahead & (c >= min_cosine * d)
            e = peak * c / (d2 * d2) if self.profile == "lambertian" else peak / (d2 * d)
        return torch.where(ahead, e, torch.zeros_like(e))

    def beam(self, z: float) -> Beam:
        """Return the parameters of `irradiance` on the plane z (mm) for the kernels."""
        x, y, from_z = map(float, self._seen_from(z)[0])
        distance, edge = abs(z - from_z), self.edge
        if (law := self.law) is not None:
            sense = 1 if from_z <= z else -1
            placed, frame = self._placed(law, sense)
            pattern, peak = placed.pattern(frame, sense), 1 / law.flux(EVERYWHERE)
            return Beam(x, y, peak=peak, distance=distance, start=distance, tilted=int(self.tilted), pattern=pattern)
        if self.tilted:
            peak, fall, power, least = self._tilted_law(distance)
            n_x, n_y, n_z = map(float, self.towards(z))
            light = Beam(x, y, peak=peak, fall=fall, power=power, distance=distance, start=distance)
            return light._replace(tilted=1, n_x=n_x, n_y=n_y, n_z=n_z, least=least)
        if self.profile == "gaussian":
            w2 = (distance * self._spread) ** 2
            peak, fall, power = 2 / (math.pi * w2), 2 / w2, 0
        elif self.profile == "lambertian":
            peak, fall, power = distance**2 / (math.pi * math.sin(edge) ** 2), 0.0, 4
        else:
            peak, fall, power = distance / (2 * math.pi * (1 - math.cos(edge))), 0.0, 3
        reach2 = (distance * math.tan(edge)) ** 2 if edge < HALF_SPACE else math.inf
        return Beam(x, y, limit_r2=reach2, peak=peak, fall=fall, power=power, distance=distance, start=distance)

    def _tilted_law(self, distance: float) -> tuple[float, float, int, float]:
        """Return (peak, fall, power, smallest cosine) of `_tilted_irradiance`, as in `Beam`."""
        if self.profile == "gaussian":
            t2 = self._spread**2
            return 2 * distance / (math.pi * t2), 2 / t2, 0, 0.0
        min_cosine = math.cos(self.edge) if self.edge < HALF_SPACE else 0.0
        if self.profile == "lambertian":
            return distance / (math.pi * math.sin(self.edge) ** 2), 0.0, 4, min_cosine
        return distance / (2 * math.pi * (1 - math.cos(self.edge))), 0.0, 3, min_cosine

    def window(self, outline: Outline, z: float, sags: tuple[float, ...]) -> Rectangle:
        """Return the rectangle about the axis on plane z (mm) crossed by all rays to the first surface in `outline`.

        The surface lies between the planes at `sags` (mm) above the plane z.  Seen from the source, a surface appears
        larger if it bends towards the source, and may appear shifted if it bends away and the source is off the axis.
        """
        centre, sense = self._seen_from(z)
        distance = abs(z - centre[2])
        offsets = [abs(p) for p in centre[:2]]
        half = list(outline.half_extent)
        for sag in sags:
            away = sag if sense > 0 else -sag
            w = distance / max(distance + away, 1e-3 * distance)  # from p, a point at h is seen at p + w (h - p)
            apparent = (w * h + abs(1 - w) * p for h, p in zip(outline.half_extent, offsets, strict=True))
            half = [max(h, s) for h, s in zip(half, apparent, strict=True)]
        if self.is_cone:
            half = [min(h, p + distance * s) for h, p, s in zip(half, offsets, self._cone_slopes(z), strict=True)]
        return Rectangle(2 * half[0], 2 * half[1])

    def _cone_slopes(self, z: float) -> tuple[float, float]:
        """Return the largest |dx/dz| and |dy/dz| of the cone's rays to the plane z; inf if a ray is parallel to it.

        At limits X of dx/dz the plane dx/dz = X touches the cone about n: (1 + X²) sin² θ_max = (n_x - n_z X)².
        """
        edge = self.edge
        if not self.tilted:
            return math.tan(edge), math.tan(edge)
        x, y, z = self.towards(z)
        if z <= math.sin(edge):
            return math.inf, math.inf
        sin2 = math.sin(edge) ** 2
        slope_x, slope_y = ((abs(a * z) + math.sqrt(sin2 * (a * a + z * z - sin2))) / (z * z - sin2) for a in (x, y))
        return slope_x, slope_y

    def spot(self, z: float) -> tuple[Outline | None, tuple[float, float]]:
        """Return (disc of the cone, centre in mm) on the plane z; disc None: the light has no edge, or is tilted."""
        (x, y, start_z), _ = self._seen_from(z)
        centre = x, y
        if not self.is_cone or self.tilted:
            return None, centre
        return Circle(abs(z - start_z) * math.tan(self.edge)), centre

    def rays_through(self, x: Tensor, y: Tensor, z: float, area: float) -> Rays:
        """Return rays from the point through (x, y) of the plane z (mm), each with the flux of a cell of `area` mm²."""
        (start_x, start_y, start_z), sense = self._seen_from(z)
        towards = torch.stack([x - start_x, y - start_y, torch.full_like(x, z - start_z)])
        direction = towards / torch.sqrt(towards[0] ** 2 + towards[1] ** 2 + towards[2] ** 2)
        start = torch.tensor((start_x, start_y, 0.0), dtype=x.dtype, device=x.device).view(3, *([1] * x.ndim))
        flux = self.irradiance(x, y, z) * area
        return Rays(start.expand_as(direction), direction, flux, all_alive(x), z=start_z, sense=sense)
