"""Goal wavefronts behind a lens: plane, spherical, or stated by Zernike coefficients.

A wave is stated by its eikonal W (mm) on a level plane z, up to a constant: the optical path from the source to each
point (x, y) of the plane.  Light behind the lens is in air, so that by the eikonal equation |∇W| = 1, W_x and W_y are
two of the direction cosines of the rays, and d = (W_x, W_y, sqrt(1 - W_x² - W_y²)) points along +z (Born and Wolf,
Principles of Optics, section 3.1).

Sign: where W is larger the path is longer, and the wavefront lags behind; where W is smaller it runs ahead.  Rays go
towards larger W: for a diverging wave W grows away from the axis, as Noll's Z_4 with c_4 > 0 does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from torch import Tensor

from bstcad.optics.surfaces import zernike
from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.outlines import STRICT, Circle
from bstcad.optics.surfaces.rays import Vector

MM_PER_NM = 1e-6  # millimetres per nanometre
MIN_FOCUS_DISTANCE = 1e-3  # mm, smallest distance of a focus from the plane
MAX_RAY_ANGLE = math.radians(89.0)  # rad, angle to the axis from which on a ray counts as parallel to the plane
SAMPLES_PER_SIDE = 129  # grid points per side of the square around a Zernike circle, for the largest |∇W|
Place = tuple[float, float]  # (x, y), mm

Z = Key("Plane behind the lens on which the wavefront is stated and measured.", "mm", -1e8, 1e8, example=40.0)
WEIGHT = Key("Weight of the wavefront relative to the pictures.", "", 0.0, 1e9, example=2.0)
LIGHT_DIRECTION = "Vector along the light, of any length."
FOCUS = "Centre of the sphere. Light converges to a focus behind the plane z, and diverges from one before it."
COEFFICIENTS = "Coefficients in waves (main wavelength), in Noll's order from j = 1."


class _Wave:
    """Methods that all waves share."""

    z: float

    def contains(self, x: Tensor, y: Tensor) -> Tensor:
        """Return True at points (mm) of the plane for which the wave is stated: everywhere."""
        return torch.ones_like(x, dtype=torch.bool)

    def complaints(self, back: float) -> Iterator[str]:
        """Yield reasons, as "key: sentence", why the wave does not suit a lens whose back is at z = `back` (mm)."""
        if not self.z > back:
            yield f"z: the plane at z = {self.z:g} mm is not behind the back at {back:g} mm; move it further along +z"


@dataclass(frozen=True)
class PlaneWave(_Wave):
    """Plane wave W = n_x x + n_y y, with n the unit vector of the direction: parallel light."""

    z: Annotated[float, Z]
    direction: Annotated[Vector, Key(LIGHT_DIRECTION, "", -1e6, 1e6, example=[0.0, 0.1, 1.0])] = (0.0, 0.0, 1.0)
    weight: Annotated[float, WEIGHT] = 1.0
    kind: Annotated[Literal["plane"], Key("A plane wave: parallel light.", example="plane")] = "plane"

    __pydantic_config__ = STRICT

    @property
    def normal(self) -> Vector:
        """Unit vector of the direction."""
        length = math.hypot(*self.direction)
        x, y, z = (part / length for part in self.direction)
        return x, y, z

    def path(self, x: Tensor, y: Tensor, wavelength: float) -> Tensor:
        """Return W (mm) at points (mm) of the plane, zero on the axis; independent of the wavelength (nm)."""
        n_x, n_y, _ = self.normal
        return n_x * x + n_y * y

    def directions(self, x: Tensor, y: Tensor, wavelength: float) -> Tensor:
        """Return unit vectors (3, …) of the rays at points (mm) of the plane; independent of the wavelength (nm)."""
        return torch.stack([torch.full_like(x, part) for part in self.normal])

    def complaints(self, back: float) -> Iterator[str]:
        """Yield the reasons of `_Wave`, and one if the direction does not lead away from the lens."""
        yield from super().complaints(back)
        if not self.direction[2] > math.cos(MAX_RAY_ANGLE) * math.hypot(*self.direction):
            yield f"direction: {list(self.direction)} is 89 degrees or more from +z; give one such as [0.0, 0.0, 1.0]"


@dataclass(frozen=True)
class SphericalWave(_Wave):
    """Spherical wave W = ∓ (|p - f| - |o - f|), p = (x, y, z), f the focus, o the point of the axis on the plane.

    The upper sign applies to a focus behind the plane, to which rays converge; from other foci they diverge.
    """

    focus: Annotated[Vector, Key(FOCUS, "mm", -1e8, 1e8, example=[0.0, 0.0, 200.0])]
    z: Annotated[float, Z]
    weight: Annotated[float, WEIGHT] = 1.0
    kind: Annotated[Literal["sphere"], Key("A spherical wave: light to or from a focus.")] = "sphere"

    __pydantic_config__ = STRICT

    @property
    def centre(self) -> Vector:
        """Focus relative to the point of the axis on the plane (mm)."""
        return self.focus[0], self.focus[1], self.focus[2] - self.z

    @property
    def sense(self) -> int:
        """Sense of the light: +1 from the focus, -1 towards the focus."""
        return 1 if self.centre[2] < 0 else -1

    def path(self, x: Tensor, y: Tensor, wavelength: float) -> Tensor:
        """Return W (mm) at points (mm) of the plane, zero on the axis; independent of the wavelength (nm)."""
        return self.sense * path_from_sphere(torch.stack([x, y, torch.zeros_like(x)]), self.centre)

    def directions(self, x: Tensor, y: Tensor, wavelength: float) -> Tensor:
        """Return unit vectors (3, …) of the rays at points (mm) of the plane; independent of the wavelength (nm)."""
        f_x, f_y, f_z = self.centre
        from_focus = torch.stack([x - f_x, y - f_y, torch.full_like(x, -f_z)])
        return self.sense * from_focus / length(from_focus)

    def complaints(self, back: float) -> Iterator[str]:
        """Yield the reasons of `_Wave`, and one if the focus is in the plane, where a sphere has no wavefront."""
        yield from super().complaints(back)
        if not abs(self.centre[2]) >= MIN_FOCUS_DISTANCE:
            yield f"focus: the point lies in the plane at z = {self.z:g} mm; move the point or the plane along z"


@dataclass(frozen=True)
class ZernikeWave(_Wave):
    """Wave W = λ Σ_j c_j Z_j((x - c_x) / a, (y - c_y) / a), Noll's orthonormal polynomials (zernike.py), j = 1, 2, ….

    c_j are waves RMS over the circle of radius a about (c_x, c_y).  Outside the circle the wave is not stated;
    there `path` and, where |∇W| < 1, `directions` extrapolate the polynomials.
    """

    coefficients: Annotated[tuple[float, ...], Key(COEFFICIENTS, "", -1e6, 1e6, example=[0.0, 0.0, 0.0, 1.5])]
    radius: Annotated[float, Key("Radius of the circle.", "mm", 1e-3, 1e6, example=10.0)]
    z: Annotated[float, Z]
    centre: Annotated[Place, Key("Centre of the circle.", "mm", -1e8, 1e8, example=[2.0, 0.0])] = (0.0, 0.0)
    weight: Annotated[float, WEIGHT] = 1.0
    kind: Annotated[Literal["zernike"], Key("A wave stated by Zernike coefficients over a circle.")] = "zernike"

    __pydantic_config__ = STRICT

    def contains(self, x: Tensor, y: Tensor) -> Tensor:
        """Return True at points (mm) of the plane for which the wave is stated: inside the circle."""
        return Circle(self.radius).contains(x - self.centre[0], y - self.centre[1])

    def path(self, x: Tensor, y: Tensor, wavelength: float) -> Tensor:
        """Return W (mm) at points (mm) of the plane, for a wavelength (nm)."""
        return self._eikonal(x, y, wavelength)[0]

    def directions(self, x: Tensor, y: Tensor, wavelength: float) -> Tensor:
        """Return unit vectors (3, …) of the rays at points (mm) of the plane, for a wavelength (nm)."""
        _, w_x, w_y = self._eikonal(x, y, wavelength)
        cos2 = 1 - w_x * w_x - w_y * w_y
        cos = torch.sqrt(torch.where(cos2 > 0, cos2, torch.ones_like(cos2)))  # any value where no ray exists
        return torch.stack([w_x, w_y, cos])

    def steepest(self, wavelength: float) -> float:
        """Return the largest |∇W| inside the circle, for a wavelength (nm): the sine of the largest ray angle."""
        line = torch.linspace(-self.radius, self.radius, SAMPLES_PER_SIDE, dtype=torch.float64)
        x, y = torch.meshgrid(self.centre[0] + line, self.centre[1] + line, indexing="ij")
        _, w_x, w_y = self._eikonal(x, y, wavelength)
        return float(torch.hypot(w_x, w_y)[self.contains(x, y)].max())

    def _eikonal(self, x: Tensor, y: Tensor, wavelength: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return (W in mm, ∂W/∂x, ∂W/∂y) at points (mm) of the plane."""
        x, y = (x - self.centre[0]) / self.radius, (y - self.centre[1]) / self.radius
        w, w_x, w_y = (wavelength * MM_PER_NM * part for part in zernike.series(self.coefficients, x, y))
        return w, w_x / self.radius, w_y / self.radius

    def complaints(self, back: float) -> Iterator[str]:
        """Yield the reasons of `_Wave`, and one if the list of coefficients is empty."""
        yield from super().complaints(back)
        if not self.coefficients:
            yield "coefficients: the list is empty; give one such as [0.0, 0.0, 0.0, 1.5], or choose kind = 'plane'"


Wave = PlaneWave | SphericalWave | ZernikeWave


def path_from_sphere(point: Tensor, centre: Vector) -> Tensor:
    """Return |p - c| - |c| (mm) for points p (3, …) and a centre c (mm): path from the sphere about c through 0.

    It is computed as (p² - 2 p · c) / (|p - c| + |c|), which keeps its digits for a distant centre.
    """
    x, y, z = point
    c_x, c_y, c_z = centre
    distance = length(torch.stack([x - c_x, y - c_y, z - c_z]))
    return (x * (x - 2 * c_x) + y * (y - 2 * c_y) + z * (z - 2 * c_z)) / (distance + math.hypot(*centre))


def length(vector: Tensor) -> Tensor:
    """Return |v| of vectors (3, …)."""
    return torch.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
