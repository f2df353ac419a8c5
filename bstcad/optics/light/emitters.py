"""Emitters: sources of light, each with its irradiance on a plane z = const and the rays that carry this flux.

`irradiance(x, y, z)` is the irradiance (1/mm², for a total flux of 1) on the plane z before the lens, and
`rays_through(x, y, z, area)` are the rays through points of that plane, each with the flux of its cell of area `area`.
Light travels from the source towards that plane: along +z to a plane above it, along -z to one below (mirrors).

A source with an `extent`, or with several spectral lines, is a sum of simple sources (`element`; see channels.py).
The methods above describe simple sources; for an extended source they return the light of its centre (`central`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import Field, replace
from types import MappingProxyType
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from bstcad.optics.light.profiles import MeasuredProfile
from bstcad.optics.numerics.records import Beam, SphereBeam
from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.outlines import Outline, Rectangle
from bstcad.optics.surfaces.rays import Frame, Rays, Vector, axes

Wavelength = float | tuple[tuple[float, float], ...]  # nm; or spectral lines (nm, weight), weights of any sum
WavelengthKey = Annotated[  # key of every source
    Wavelength,
    Key("One wavelength, or lines [[nm, weight], ...] of a spectrum, weights of any sum.", "nm", 100.0, 20_000.0),
]
LumensKey = Annotated[
    float | None, Key("Luminous flux of the source; that of its file if absent.", "lm", 1e-6, 1e9, example=500.0)
]
TiltKey = Annotated[
    tuple[float, float] | None, Key("Tilt about x, then about y.", "degrees", -180.0, 180.0, example=[0.0, 10.0])
]
OneOrTwo = float | tuple[float, float]  # a number, or two along x and y
PROFILE_NAMES = {  # profile names in text
    "gaussian": "Gaussian", "super_gaussian": "super-Gaussian", "lambertian": "Lambertian", "annular": "annular",
    "uniform": "uniform",
}  # fmt: skip


class Emitter(ABC):
    """A source of light.

    A subclass is a frozen dataclass that defines `irradiance`, `rays_through` and `window`.  The other methods have
    defaults; some raise NotImplementedError, which names the method that the subclass must add.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]
    wavelength: Wavelength
    lumens: float | None = None  # stated luminous flux, lm
    tilt: tuple[float, float] | None = None  # rotation of the axis about x, then y (degrees); None: not tilted
    profile: str | MeasuredProfile = "own"  # name of the distribution of the light, or a record with its `law`
    size_key: str | None = None  # scene key of the size; the key for the real lamp has the prefix real_; None: no size
    kind: str = "own"  # name of the kind of source
    parallel: bool = False  # True if the light of each point of the extent is parallel
    simple_name: str = "a source without size"  # name of the source without its extent
    start_key: str = "z"  # scene key of the position where the light starts
    widths: Mapping[str, tuple[str, ...]] = MappingProxyType({})  # scene keys that each profile needs
    unbounded: str | None = None  # name of the profile that needs no width
    is_given: bool = False  # True: the rays are given (ray_bundle.RayBundle), without an irradiance on planes

    @property
    def luminous_flux(self) -> float | None:
        """Luminous flux, lm; None: not stated, so that fluxes are relative."""
        return self.lumens

    @property
    def remarks(self) -> Iterator[str]:
        """Sentences, each with its key, on readings that a file of the source does not state plainly."""
        yield from ()

    @property
    def extent(self) -> Outline | None:
        """Outline (mm or direction cosines) filled by simple sources; None: a simple source."""
        return None

    @property
    def start_plane(self) -> float | None:
        """z (mm) of the plane from which the light starts; None: a plane before the lens, wherever the lens is."""
        return None

    def nearest_z(self, upwards: bool) -> float | None:
        """Return z (mm) of the extent's point nearest to a lens above (upwards) or below; None as in `start_plane`."""
        return self.start_plane

    def complaints(self, z: float, optic: str) -> Iterator[str]:
        """Yield faults of the source as "key: sentence"; z: plane of the first face (mm), optic: "lens" or "mirror"."""
        yield from ()

    @property
    def central(self) -> Emitter:
        """Simple source at the centre, at the main wavelength."""
        return replace(self, wavelength=self.main_wavelength)

    @abstractmethod
    def irradiance(self, x: Tensor, y: Tensor, z: float) -> Tensor:
        """Return E(x, y) (1/mm²) on the plane z (mm); the total flux is 1."""

    @abstractmethod
    def rays_through(self, x: Tensor, y: Tensor, z: float, area: float) -> Rays:
        """Return rays through (x, y) of the plane z (mm), each with the flux of a cell of `area` (mm²)."""

    @abstractmethod
    def window(self, outline: Outline, z: float, sags: tuple[float, ...]) -> Rectangle:
        """Return the rectangle on the plane z (mm) with all rays that can meet the first surface inside its outline.

        The surface lies between the planes at `sags` (mm) above the plane z.
        """

    def spot(self, z: float) -> tuple[Outline | None, tuple[float, float]]:
        """Return (outline, centre in mm) of the light on the plane z; outline None: the light has no edge."""
        return None, (0.0, 0.0)

    def start_point(self, entrance: float) -> Vector:
        """Return the centre of the light (mm) on its start plane, or on the plane `entrance` (mm) if it has none."""
        z = entrance if self.start_plane is None else self.start_plane
        return (*self.spot(z)[1], z)

    @property
    def place(self) -> Vector:
        """Direction of parallel light, else position (mm): distinguishes the simple sources of an extended source."""
        return self.axes[2] if self.parallel else self.start_point(0.0)

    def element(self, x: float, y: float) -> Emitter:
        """Return the simple source at (x, y) of the extent."""
        raise self._missing_method("the simple sources that its extent consists of", "element(x, y)")

    def scaled(self, share: float) -> Emitter:
        """Return the source with its extent multiplied by `share`."""
        raise self._missing_method("a smaller extent", "scaled(share)")

    def resized(self, key: str, size: float) -> Emitter:
        """Return the source with another size, by the key of the size."""
        return replace(self, **{key: size})

    def moved(self, motion: Motion, entrance: float) -> Emitter:
        """Return the simple source after a motion; entrance: z of the plane through the first vertex (mm)."""
        raise self._missing_method("how its light moves", "moved(motion, entrance)")

    def reference(self, place: Tensor, z: float, sense: int) -> Tensor:
        """Return the path (mm) from the wavefront through o = (0, 0, z) to points o + place (3, …); sense: see Rays."""
        if not self.parallel:
            raise self._missing_method("its wavefronts", "reference(place, z, sense)")
        n_x, n_y, n_z = self.axes[2]
        return sense * (n_x * place[0] + n_y * place[1] + n_z * place[2])

    def _missing_method(self, what: str, method: str) -> NotImplementedError:
        name = type(self).__name__
        return NotImplementedError(f"the emitter {name} does not define {what}; add the method {method} to the class")

    def words(self, origin: float) -> str:
        """Return kind, position, profile and sizes for a data sheet; origin: z (mm) from which the sheet measures."""
        return "a custom source"

    def sizes(self) -> Iterator[tuple[str, OneOrTwo, str]]:
        """Yield (key, size, unit) for each key that defines the extent; size: a number, or two along x and y."""
        yield from ()

    @property
    def is_rotation_invariant(self) -> bool:
        """True if a rotation about the source's axis leaves the light unchanged; else `moved` neglects the rotation."""
        return False

    @property
    def can_rotate(self) -> bool:
        """True if a rotation of the profile about the axis changes the light."""
        return False

    @property
    def is_shift_invariant(self) -> bool:
        """True if a shift along the axis of the lens leaves the light unchanged."""
        return self.parallel and not self.tilted

    def bundle(self, line: int, part: int = 0) -> Emitter | None:
        """Return the rays of a file at a spectral line, from one of the file's parts; None: no file of rays."""
        return None

    @property
    def largest_side(self) -> int:
        """Number n for which n x n is about the number of given rays in a part."""
        raise self._missing_method("given rays", "largest_side")

    def with_wider_cone(self, by: float) -> Emitter | None:
        """Return the simple source with the tangent of its half angle larger by the fraction `by`; None: no cone."""
        return None

    def moved_away(self, by: float, about: Vector) -> Emitter | None:
        """Return the source with its distance from `about` (mm) larger by the fraction `by`; None: no position."""
        return None

    @property
    def lines(self) -> tuple[tuple[float, float], ...]:
        """(nm, fraction of the flux) of each spectral line, the main line first; the fractions sum to 1."""
        if isinstance(self.wavelength, int | float):
            return ((self.wavelength, 1.0),)
        total, first = math.fsum(weight for _, weight in self.wavelength), self.main_wavelength
        fractions = [(nm, weight / total) for nm, weight in self.wavelength]
        return tuple(sorted(fractions, key=lambda line: line[0] != first))  # a stable sort

    @property
    def main_wavelength(self) -> float:
        """Wavelength (nm) of the line with the largest weight; the lower median of several such lines."""
        if isinstance(self.wavelength, int | float):
            return self.wavelength
        largest = max(weight for _, weight in self.wavelength)
        heaviest = sorted(nm for nm, weight in self.wavelength if weight == largest)
        return heaviest[(len(heaviest) - 1) // 2]

    @property
    def tilted(self) -> bool:
        """True if the axis of the source is inclined to the axis of the lens."""
        return self.tilt is not None and any(self.tilt)

    @property
    def axes(self) -> Frame:
        """Axes (e_x, e_y, n) of the source in space; the light goes along n, or along -n to a lens below the source."""
        return axes(self.tilt or (0.0, 0.0))

    def beam(self, z: float) -> Beam | SphereBeam | None:
        """Return the parameters of `irradiance` on the plane z (mm) for the kernels; None: the kernels use a table."""
        return None


def all_alive(x: Tensor) -> Tensor:
    """Return the status of rays through x, none of which is lost."""
    return torch.zeros(x.shape, dtype=torch.uint8, device=x.device)
