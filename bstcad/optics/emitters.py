"""Emitters: each gives the flux density on a plane z = const, and the rays that carry this flux.

`irradiance(x, y, z)` is the flux density (1/mm², of a source whose whole flux is 1) on the plane z before the lens, and
`rays(x, y, z, area)` are the rays through points of that plane, each with the flux of its share `area` of the plane.
Light travels from the source towards that plane: along +z to a plane above it, along -z to one below (mirrors).

A source of some `extent`, or of several lines, is a sum of simple sources (`element`; see channels.py).  The methods
above describe simple sources; those of an extended source give the light of its middle (`central`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Annotated

import torch
from torch import Tensor

from bstcad.optics.kernels.records import Beam
from bstcad.optics.key import Key
from bstcad.optics.motion import Motion
from bstcad.optics.outlines import Outline, Rectangle
from bstcad.optics.rays import Rays, Vector, axes

Wavelength = float | tuple[tuple[float, float], ...]  # nm; or lines, each (nm, weight), weights of any sum
WavelengthKey = Annotated[  # key of every source
    Wavelength,
    Key("One wavelength, or lines [[nm, weight], ...] of a spectrum, weights of any sum.", "nm", 100.0, 20_000.0),
]
LAWS = {"gaussian": "Gaussian", "lambertian": "Lambertian", "uniform": "even"}  # profiles in words


class Emitter(ABC):
    """Where light comes from.

    A class of one's own is a frozen dataclass that says its `irradiance`, `rays` and `window`; what else is asked of it
    follows from these, or is declined in a sentence.
    """

    wavelength: Wavelength
    lumens: float | None = None  # flux (lm); None: relative
    tilt: tuple[float, float] | None = None
    extent: Outline | None = None  # outline over which simple sources are spread; None: it is one
    profile: str = "own"
    size_key: str | None = None  # key of its size; after real_ that of the real lamp's
    kind: str = "own"
    parallel: bool = False  # is the light of one point of its extent parallel?
    simple: str = "a source without size"  # name of the source without its extent
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

    def words(self, origin: float) -> str:
        """Return kind, place, profile and sizes for a data sheet; origin: z (mm) from which the sheet measures."""
        return "a source of one's own"

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
