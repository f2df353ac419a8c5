"""Light sources: each gives the flux density on a plane z = const, and the rays that carry this flux.

`irradiance(x, y, z)` is the flux density (1/mm², of a source whose whole flux is 1) on the plane z before the lens, and
`rays(x, y, z, area)` are the rays through points of that plane, each with the flux of its share `area` of the plane.
Light travels from the source towards that plane: along +z to a plane above it, along -z to one below (mirrors).

A source of some `extent`, or of several lines, is a sum of simple sources (`element`; see channels.py).  The methods
above describe simple sources; those of an extended source give the light of its middle (`central`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated, Literal

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.kernels.beam import Beam
from bstcad.optics.kernels.reductions import elementary
from bstcad.optics.key import Key
from bstcad.optics.motion import Motion
from bstcad.optics.outlines import STRICT, Circle, Outline, Rectangle
from bstcad.optics.rays import Rays, Vector, axes, tilt_of
from bstcad.optics.wavefront import beyond

FAR = 4.0  # widths of its aperture by which a beam without a plane z of its own gets that plane before the lens
SIDES = "diameter", "width", "height"  # sizes of a disc or rectangle that shines
HALF_SPACE = math.pi / 2  # rad; the edge of light that fills all directions on the lens's side
MAX_LEAN = 89.0  # degrees from the lens's axis, of parallel light
WIDEST = math.radians(89.0)  # widest cone whose edge counts on planes
Wavelength = float | tuple[tuple[float, float], ...]  # nm; or lines, each (nm, weight), weights of any sum
ALONG_Z = (0, 0.0, 0.0, 1.0, 0.0)  # the last fields of a Beam that is not tilted
WavelengthKey = Annotated[  # key of every source
    Wavelength,
    Key("One wavelength, or lines [[nm, weight], ...] of a spectrum, weights of any sum.", "nm", 100.0, 20_000.0),
]


class Emitter(ABC):
    """Where light comes from.

    A class of one's own is a frozen dataclass that says its `irradiance`, `rays` and `window`; what else is asked of it
    follows from these, or is declined in a sentence.
    """

    wavelength: Wavelength
    lumens: float | None = None  # flux (lm); None: relative
    files: Mapping[str, bytes] = MappingProxyType({})  # contents of the files that it came from, by name
    tilt: tuple[float, float] | None = None
    extent: Outline | None = None  # outline over which simple sources are spread; None: it is one
    profile: str = "own"
    size_key: str | None = None  # key of its size; after real_ that of the real lamp's
    kind: str = "own"
    parallel: bool = False  # is the light of one point of its extent parallel?
    simple: str = "a source without size"  # what it is without its extent
    start_key: str = "z"  # key of the place where its light starts
    widths: Mapping[str, str] = MappingProxyType({})  # key of the width that each profile has
    unbounded: str | None = None  # profile that needs no width

    @property
    def begins(self) -> float | None:
        """The plane z (mm) from which its light starts; None: one before the lens, wherever that is."""
        return None

    def nearest(self, upwards: bool) -> float | None:
        """z (mm) of the place of its extent that is nearest to a lens above it, or below it; None as in `begins`."""
        return self.begins

    def complaints(self, z: float, optic: str) -> Iterator[str]:
        """Faults of its size, as "key: sentence"; z: of the face that its light meets first (mm); optic: of what."""
        yield from ()

    @property
    def central(self) -> Emitter:
        """The simple source in its middle, at its main line."""
        return replace(self, wavelength=self.main_wavelength)

    @abstractmethod
    def irradiance(self, x: Tensor, y: Tensor, z: float) -> Tensor:
        """E(x, y) (1/mm²) on the plane z (mm); the whole flux is 1."""

    @abstractmethod
    def rays(self, x: Tensor, y: Tensor, z: float, area: float) -> Rays:
        """Rays through (x, y) of the plane z (mm), each with the flux of its share `area` (mm²) of the plane."""

    @abstractmethod
    def window(self, outline: Outline, z: float, sags: tuple[float, ...]) -> Rectangle:
        """The rectangle of the plane z (mm) that holds every ray that can meet the first surface inside its outline.

        The surface lies between that plane and those at `sags` (mm) from it.
        """

    def spot(self, z: float) -> tuple[Outline | None, tuple[float, float]]:
        """(outline, centre in mm) of the light on the plane z, None where it has no edge."""
        return None, (0.0, 0.0)

    def starts(self, entrance: float) -> Vector:
        """The middle of its light where that starts, or on the plane `entrance` (mm) if no plane is stated."""
        z = entrance if self.begins is None else self.begins
        return (*self.spot(z)[1], z)

    @property
    def place(self) -> Vector:
        """Direction of parallel light, or position: it tells a simple source from the others of an extended one."""
        return self.axes[2] if self.parallel else self.starts(0.0)

    def element(self, x: float, y: float) -> Emitter:
        """The simple source at (x, y) of its extent."""
        raise self._silent("the simple sources that its extent consists of", "element(x, y)")

    def scaled(self, share: float) -> Emitter:
        """The same source with a share of its extent."""
        raise self._silent("a smaller extent", "scaled(share)")

    def moved(self, motion: Motion, entrance: float) -> Emitter:
        """The simple source after a motion; entrance: z of the plane through the first vertex (mm)."""
        raise self._silent("how its light moves", "moved(motion, entrance)")

    def reference(self, place: Tensor, z: float, sense: int) -> Tensor:
        """Path (mm) to places (3, …), counted from the plane z, from the wavefront through where the axis meets it."""
        if not self.parallel:
            raise self._silent("its wavefronts", "reference(place, z, sense)")
        n_x, n_y, n_z = self.axes[2]
        return sense * (n_x * place[0] + n_y * place[1] + n_z * place[2])

    def _silent(self, what: str, method: str) -> NotImplementedError:
        """The sentence by which a class declines what it does not know."""
        name = type(self).__name__
        return NotImplementedError(f"the emitter {name} does not say {what}; give it the method {method}")

    def sizes(self) -> Iterator[tuple[str, float, str]]:
        """The keys that give it an extent, each with the size and its unit."""
        yield from ()

    @property
    def turns_alike(self) -> bool:
        """Does its light stay the same when it is turned about its axis?  Else `moved` cannot turn it so."""
        return False

    @property
    def shifts_alike(self) -> bool:
        """Does its light stay the same when it is shifted along the axis of the lens?"""
        return self.parallel and not self.tilted

    def wider(self, by: float) -> Emitter | None:
        """The simple source with the tangent of its cone larger by a share; None: it has no cone."""
        return None

    def larger(self, by: float, about: Vector) -> Emitter | None:
        """The simple source further from a point by a share of its distance; None: it is in no place."""
        return None

    @property
    def lines(self) -> tuple[tuple[float, float], ...]:
        """(nm, share of the flux) of each line, the main one first and the others as listed; shares sum to 1."""
        if isinstance(self.wavelength, int | float):
            return ((self.wavelength, 1.0),)
        whole, first = math.fsum(weight for _, weight in self.wavelength), self.main_wavelength
        shares = [(nm, weight / whole) for nm, weight in self.wavelength]
        return tuple(sorted(shares, key=lambda line: line[0] != first))  # stable

    @property
    def main_wavelength(self) -> float:
        """The heaviest line (nm), or the middle of several as heavy."""
        if isinstance(self.wavelength, int | float):
            return self.wavelength
        most = max(weight for _, weight in self.wavelength)
        heaviest = sorted(nm for nm, weight in self.wavelength if weight == most)
        return heaviest[(len(heaviest) - 1) // 2]

    @property
    def tilted(self) -> bool:
        """Does its axis lean against that of the lens?"""
        return self.tilt is not None and any(self.tilt)

    @property
    def axes(self) -> tuple[Vector, Vector, Vector]:
        """Its own axes in space; its light goes along the third, or, to a lens below it, along minus the third."""
        return axes(self.tilt or (0.0, 0.0))

    def beam(self, z: float) -> Beam | None:
        """`irradiance` on the plane z (mm) as numbers; None: no kernel knows its law, and takes a table instead."""
        return None


def all_alive(x: Tensor) -> Tensor:
    """The status of rays through x: none is lost yet."""
    return torch.zeros(x.shape, dtype=torch.uint8, device=x.device)


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
        if not (motion.turns or self.tilted):  # the same on all planes
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
        (x, y), limits = _floats(self.shift(z)), _floats(self.aperture.limits)
        peak, fall, start = 1 / self.aperture.area, 0.0, abs(float(z - self.start(z)))
        if self.profile == "gaussian":
            peak, fall = 1 / self._gaussian_flux(), 2 / self.radius_1e2**2
        axis = ALONG_Z
        if self.tilted:
            n, sense = self.axes[2], 1 if self.start(z) <= z else -1
            axis = (1, *_floats((sense * n[0], sense * n[1], n[2])), 0.0)
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


@dataclass(frozen=True)
class Point(Emitter):
    """Rays from one point into the half space on the lens's side of it.

    gaussian: irradiance on z = const falls as exp(-2 r² / w²), w = distance · tan(half_angle_1e2);
    lambertian: radiant intensity cos(theta), up to half_angle if there is one; uniform: constant up to half_angle.
    Tilted, all that is turned about the point, plane and half space included (`_tilted_irradiance`); what no longer
    goes to the lens's side misses the lens.  A disc or a rectangle lies across the axis, each point such a source.
    """

    position: Annotated[
        tuple[float, float, float], Key("Place of the point, or of a disc's middle.", "mm", -1e8, 1e8)
    ] = (0.0, 0.0, 0.0)
    wavelength: WavelengthKey = 587.6
    profile: Annotated[Literal["gaussian", "lambertian", "uniform"], Key("Radiant intensity over the angle.")] = (
        "lambertian"
    )
    half_angle_1e2: Annotated[
        float | None,
        Key(
            "Angle from the axis at which a gaussian's irradiance on a plane is 1/e^2 of its peak.",
            "degrees",
            1e-3,
            89.0,
        ),
    ] = None
    half_angle: Annotated[
        float | None, Key("Angle from the axis at which a uniform or lambertian profile ends.", "degrees", 1e-3, 90.0)
    ] = None
    diameter: Annotated[float | None, Key("Diameter of a disc that shines, simulated.", "mm", 0.0, 1e6)] = None
    width: Annotated[
        float | None, Key("Width of a rectangle that shines, along its own x.", "mm", 0.0, 1e6, example=1.0)
    ] = None
    height: Annotated[
        float | None, Key("Height of a rectangle that shines, along its own y.", "mm", 0.0, 1e6, example=1.0)
    ] = None
    tilt: Annotated[
        tuple[float, float] | None, Key("Tilt about x and y.", "degrees", -180.0, 180.0, example=[0.0, 10.0])
    ] = None
    real_diameter: Annotated[float | None, Key("Diameter of the real lamp; estimates only.", "mm", 0.0, 1e6)] = None
    kind: Annotated[Literal["point"], Key("A point, or with a size a disc or rectangle of points.")] = "point"

    __pydantic_config__ = STRICT
    size_key, simple, start_key = "diameter", "a point", "position"
    widths = MappingProxyType({"gaussian": "half_angle_1e2", "uniform": "half_angle", "lambertian": "half_angle"})
    unbounded = "lambertian"  # it lights the half space

    @property
    def begins(self) -> float:
        """That of its middle."""
        return self.position[2]

    def nearest(self, upwards: bool) -> float:
        """z (mm) of the place of the point, disc or rectangle that is nearest to a lens above it, or below it."""
        reach = 0.0 if self.extent is None else self.extent.reach(*(axis[2] for axis in self.axes[:2]))
        return self.position[2] + (reach if upwards else -reach)

    def complaints(self, z: float, optic: str) -> Iterator[str]:
        """A disc or a rectangle that is not described, or that is larger than its distance from the lens."""
        given = [name for name in ("width", "height") if getattr(self, name) is not None]
        if given and self.diameter is not None:
            yield f"diameter: the source also has a {given[0]}; give a diameter, or width and height"
        for other in {"width", "height"} - set(given) if given else ():
            yield f"{other}: missing, and a source with a {given[0]} needs it; add it in mm"
        sizes = {name: getattr(self, name) or 0.0 for name in SIDES}
        name, distance = max(sizes, key=sizes.get), abs(z - self.position[2])
        if self.extent is not None and not sizes[name] <= distance:
            far = f"the {distance:g} mm from the source to the {optic}"
            yield f"{name}: {sizes[name]:g} mm is more than {far}; make the source smaller or move it away"

    def reference(self, place: Tensor, z: float, sense: int) -> Tensor:
        """Path (mm) to places (3, …), counted from the plane z, from the sphere about it through that on the axis."""
        x, y, start = self.position
        return beyond(place, (x, y, start - z))

    def sizes(self) -> Iterator[tuple[str, float, str]]:
        """Its diameter, width and height, if it has any."""
        yield from ((key, size, "mm") for key in SIDES if (size := getattr(self, key)))

    @property
    def turns_alike(self) -> bool:
        """Is it a point or a disc?"""
        return self.extent is None or self.extent.is_round

    def moved(self, motion: Motion, entrance: float) -> Point:
        """The point after a motion."""
        tilt = self.tilt if not motion.turns else tilt_of(motion.frame((self.axes[2],))[0])
        return replace(self, position=motion.point(self.position), tilt=tilt)

    def wider(self, by: float) -> Point | None:
        """The point with the tangent of its cone larger by a share; None: it has no cone."""
        name = "half_angle_1e2" if self.half_angle_1e2 else "half_angle"
        if not (angle := getattr(self, name)):
            return None
        return replace(self, **{name: math.degrees(math.atan((1 + by) * math.tan(math.radians(angle))))})

    def larger(self, by: float, about: Vector) -> Point:
        """The point further from another one by a share of its distance."""
        middle = np.array(about)
        return replace(self, position=tuple((middle + (1 + by) * (np.array(self.position) - middle)).tolist()))

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
        """The same source with a share of its diameter, width and height."""
        sizes = {name: getattr(self, name) for name in SIDES}
        return replace(self, **{name: share * size if share and size else None for name, size in sizes.items()})

    def element(self, x: float, y: float) -> Point:
        """The point at (x, y) of its extent (mm)."""
        e_x, e_y, _ = self.axes
        place = tuple(p + x * a + y * b for p, a, b in zip(self.position, e_x, e_y, strict=True))
        return replace(self, position=place, diameter=None, width=None, height=None)

    def irradiance(self, x: Tensor, y: Tensor, z: float) -> Tensor:
        """E(x, y) (1/mm²) on the plane z; all the light sent to its side is 1.

        gaussian: 2 / (π w²) exp(-2 r² / w²).  lambertian: I = cos θ / (π sin² θ_max) and E = I cos θ / d², so
        E = D² / (π sin² θ_max d⁴) with D the distance of the plane and d that of the point.  uniform:
        I = 1 / (2π (1 - cos θ_max)), E = I D / d³.  Beyond θ_max both are dark.
        """
        distance = abs(z - self.position[2])
        if self.tilted:
            return self._tilted_irradiance(x - self.position[0], y - self.position[1], distance, self.towards(z))
        r2 = (x - self.position[0]) ** 2 + (y - self.position[1]) ** 2
        d2 = r2 + distance**2
        if self.profile == "gaussian":
            w2 = (distance * math.tan(math.radians(self.half_angle_1e2))) ** 2
            return 2 / (math.pi * w2) * elementary(torch.exp, -2 * r2 / w2)
        edge = self.edge
        if self.profile == "lambertian":
            e = distance**2 / (math.pi * math.sin(edge) ** 2 * d2 * d2)
        else:
            intensity = 1 / (2 * math.pi * (1 - math.cos(edge)))
            e = intensity * distance / (d2 * torch.sqrt(d2))
        return e if edge == HALF_SPACE else torch.where(r2 <= (distance * math.tan(edge)) ** 2, e, torch.zeros_like(e))

    @property
    def edge(self) -> float:
        """The angle from the axis (rad) at which a uniform or lambertian profile ends: π / 2 lights the half space."""
        return HALF_SPACE if self.half_angle is None or self.profile == "gaussian" else math.radians(self.half_angle)

    @property
    def is_cone(self) -> bool:
        """Has its light an edge, on planes before it too?"""
        return self.edge < WIDEST

    def towards(self, z: float) -> Vector:
        """Its axis, its light's way to the plane z, in a frame in which that plane is ahead along +z."""
        n, sense = self.axes[2], 1 if self.position[2] <= z else -1
        return sense * n[0], sense * n[1], n[2]

    def _tilted_irradiance(self, x: Tensor, y: Tensor, distance: float, axis: Vector) -> Tensor:
        """E of a tilted source at (x, y) from its foot on a plane at the distance D; c = n · (x, y, D) = d cos θ.

        E = I(θ) D / d³, and nothing where c <= 0.  lambertian: I = cos θ / (π sin² θ_max), E = D c / (π sin² θ_max d⁴);
        uniform: I constant, both where cos θ >= cos θ_max.  gaussian: on its own planes E ∝ exp(-2 tan² θ / t²),
        t = tan(half_angle_1e2), so I = 2 / (π t²) exp(-2 tan² θ / t²) / cos³ θ, and
        E = 2 D / (π t² c³) exp(-2 (d² - c²) / (t² c²)).
        """
        d2 = x * x + y * y + distance**2
        c = axis[0] * x + axis[1] * y + axis[2] * distance
        ahead = c > 0
        c = torch.where(ahead, c, torch.ones_like(c))
        if self.profile == "gaussian":
            t2 = math.tan(math.radians(self.half_angle_1e2)) ** 2
            c2 = c * c
            e = 2 * distance / (math.pi * t2) * elementary(torch.exp, -2 / t2 * (d2 - c2) / c2) / (c2 * c)
        else:
            edge, d = self.edge, torch.sqrt(d2)
            if edge < HALF_SPACE:
                ahead = ahead & (c >= math.cos(edge) * d)
            if self.profile == "lambertian":
                e = distance / (math.pi * math.sin(edge) ** 2) * c / (d2 * d2)
            else:
                e = distance / (2 * math.pi * (1 - math.cos(edge))) / (d2 * d)
        return torch.where(ahead, e, torch.zeros_like(e))

    def beam(self, z: float) -> Beam:
        """`irradiance` on the plane z (mm) as numbers."""
        x, y, from_z = _floats(self.position)
        distance, round_ = abs(z - from_z), (0.0, 0.0)
        if self.tilted:
            law = self._tilted_law(distance)
            return Beam(x, y, *round_, math.inf, *law[:3], distance, distance, 1, *_floats(self.towards(z)), law[3])
        reach2, edge = math.inf, self.edge
        if self.profile == "gaussian":
            w2 = (distance * math.tan(math.radians(self.half_angle_1e2))) ** 2
            law = 2 / (math.pi * w2), 2 / w2, 0
        elif self.profile == "lambertian":
            law = distance**2 / (math.pi * math.sin(edge) ** 2), 0.0, 4
        else:
            law = distance / (2 * math.pi * (1 - math.cos(edge))), 0.0, 3
        if edge < HALF_SPACE:
            reach2 = (distance * math.tan(edge)) ** 2
        return Beam(x, y, *round_, reach2, *law, distance, distance, *ALONG_Z)

    def _tilted_law(self, distance: float) -> tuple[float, float, int, float]:
        """(peak, fall, power, least) of `_tilted_irradiance`."""
        if self.profile == "gaussian":
            t2 = math.tan(math.radians(self.half_angle_1e2)) ** 2
            return 2 * distance / (math.pi * t2), 2 / t2, 0, 0.0
        least = math.cos(self.edge) if self.edge < HALF_SPACE else 0.0
        if self.profile == "lambertian":
            return distance / (math.pi * math.sin(self.edge) ** 2), 0.0, 4, least
        return distance / (2 * math.pi * (1 - math.cos(self.edge))), 0.0, 3, least

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
        if self.is_cone:
            half = [min(h, p + distance * s) for h, p, s in zip(half, offsets, self._cone_slopes(z), strict=True)]
        return Rectangle(2 * half[0], 2 * half[1])

    def _cone_slopes(self, z: float) -> tuple[float, float]:
        """The largest |dx/dz| and |dy/dz| of a cone's rays to the plane z; infinite if it runs along that.

        X = dx/dz ends where the line of all Y touches the cone: (1 + X²) sin² θ_max = (n_x - n_z X)².
        """
        edge = self.edge
        if not self.tilted:
            return math.tan(edge), math.tan(edge)
        x, y, z = self.towards(z)
        if z <= math.sin(edge):
            return math.inf, math.inf
        sin2 = math.sin(edge) ** 2
        roots = (math.sqrt(sin2 * (a * a + z * z - sin2)) for a in (x, y))
        return tuple((abs(a * z) + root) / (z * z - sin2) for a, root in zip((x, y), roots, strict=True))

    def spot(self, z: float) -> tuple[Outline | None, tuple[float, float]]:
        """(outline, centre in mm) of the light on the plane z, None where it has no edge: a cone's disc."""
        centre = self.position[:2]
        if not self.is_cone or self.tilted:
            return None, centre
        return Circle(abs(z - self.position[2]) * math.tan(self.edge)), centre

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


def _floats(values: Sequence[float]) -> tuple[float, ...]:
    """A kernel is compiled anew for every combination of types: a radius of 12 must not be another than one of 12.0."""
    return tuple(float(v) for v in values)


Source = Collimated | Point
