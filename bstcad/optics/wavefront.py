"""Wavefronts that are asked for behind a lens: plane, spherical, or stated by Zernike coefficients.

A wave is told by its eikonal W (mm) on a level plane z, up to a constant: the optical path from the source to each
place (x, y) of it.  Light behind the lens is in air, so the eikonal equation |∇W| = 1 gives the rays: W_x and W_y are
two of the direction cosines, and d = (W_x, W_y, sqrt(1 - W_x² - W_y²)) leads along +z (Born and Wolf, Principles of
Optics, section 3.1).

Sign: where W is larger the path is longer, and the wavefront lags behind; where W is smaller it runs ahead.  So rays go
towards larger W; a diverging wave has W > 0 around its axis, like a positive Noll 4, and a converging one W < 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from torch import Tensor

from bstcad.optics import zernike
from bstcad.optics.key import Key
from bstcad.optics.outlines import STRICT, Circle
from bstcad.optics.rays import Vector

NM = 1e-6  # mm
IN_PLANE = 1e-3  # mm; a focus nearer to the plane is on it
ALONG = math.radians(89.0)  # rays that lean further from the axis run along the plane
SAMPLES = 129  # a side of a Zernike circle, at which its steepest ray is looked for
Place = tuple[float, float]

Z = Key("Plane behind the lens on which the wavefront is stated and measured.", "mm", -1e8, 1e8, example=40.0)
WEIGHT = Key("Weight of the wavefront against the pictures.", "", 0.0, 1e9, example=2.0)


class _Wave:
    """What waves have in common."""

    z: float

    def contains(self, x: Tensor, y: Tensor) -> Tensor:
        """True at places (mm) of the plane for which the wave is stated: everywhere."""
        return torch.ones_like(x, dtype=torch.bool)

    def complaints(self, back: float) -> Iterator[str]:
        """Everything that keeps the wave from a lens whose back is at that z (mm), each as "key: sentence"."""
        if not self.z > back:
            behind = f"the plane at z = {self.z:g} is not behind the back at z = {back:g}"
            yield f"z: {behind}; move it further along +z"


@dataclass(frozen=True)
class PlaneWave(_Wave):
    """W = n_x x + n_y y, n the direction as a unit vector: parallel light."""

    z: Annotated[float, Z]
    direction: Annotated[
        Vector, Key("Direction of the light, of any length.", "", -1e6, 1e6, example=[0.0, 0.1, 1.0])
    ] = (0.0, 0.0, 1.0)
    weight: Annotated[float, WEIGHT] = 1.0
    kind: Annotated[Literal["plane"], Key("A plane wave: parallel light.", example="plane")] = "plane"

    __pydantic_config__ = STRICT

    @property
    def normal(self) -> Vector:
        """The direction as a unit vector."""
        length = math.hypot(*self.direction)
        x, y, z = (part / length for part in self.direction)
        return x, y, z

    def path(self, x: Tensor, y: Tensor, wavelength: float) -> Tensor:
        """W (mm) at places (mm) of the plane, zero on the axis; the wavelength (nm) does not matter."""
        n_x, n_y, _ = self.normal
        return n_x * x + n_y * y

    def directions(self, x: Tensor, y: Tensor, wavelength: float) -> Tensor:
        """(3, …) unit vectors of the rays through places (mm) of the plane; the wavelength (nm) does not matter."""
        return torch.stack([torch.full_like(x, part) for part in self.normal])

    def complaints(self, back: float) -> Iterator[str]:
        """A direction that does not lead away from the lens."""
        yield from super().complaints(back)
        if not self.direction[2] > math.cos(ALONG) * math.hypot(*self.direction):
            yield "direction: does not lead along +z, away from the lens; give one such as [0.0, 0.0, 1.0]"


@dataclass(frozen=True)
class SphericalWave(_Wave):
    """W = ∓ (|p - f| - |o - f|), p = (x, y, z), f the focus, o where the axis meets the plane: a sphere about f.

    The upper sign, rays towards the focus, is that of a focus behind the plane; from one before it they diverge.
    """

    focus: Annotated[
        Vector, Key("Centre of the sphere: behind z light converges, before it diverges.", "mm", -1e8, 1e8,
                    example=[0.0, 0.0, 200.0])
    ]  # fmt: skip
    z: Annotated[float, Z]
    weight: Annotated[float, WEIGHT] = 1.0
    kind: Annotated[Literal["sphere"], Key("A spherical wave: light to or from a focus.")] = "sphere"

    __pydantic_config__ = STRICT

    @property
    def centre(self) -> Vector:
        """The focus from where the axis meets the plane (mm)."""
        return self.focus[0], self.focus[1], self.focus[2] - self.z

    @property
    def sense(self) -> int:
        """+1 for light that comes from the focus, -1 for light that goes there."""
        return 1 if self.centre[2] < 0 else -1

    def path(self, x: Tensor, y: Tensor, wavelength: float) -> Tensor:
        """W (mm) at places (mm) of the plane, zero on the axis; the wavelength (nm) does not matter."""
        return self.sense * beyond(torch.stack([x, y, torch.zeros_like(x)]), self.centre)

    def directions(self, x: Tensor, y: Tensor, wavelength: float) -> Tensor:
        """(3, …) unit vectors of the rays through places (mm) of the plane; the wavelength (nm) does not matter."""
        f_x, f_y, f_z = self.centre
        from_focus = torch.stack([x - f_x, y - f_y, torch.full_like(x, -f_z)])
        return self.sense * from_focus / length(from_focus)

    def complaints(self, back: float) -> Iterator[str]:
        """A focus in the plane, where a sphere has no wavefront."""
        yield from super().complaints(back)
        if not abs(self.centre[2]) >= IN_PLANE:
            yield f"focus: lies in the plane at z = {self.z:g}; move one of them along z"


@dataclass(frozen=True)
class ZernikeWave(_Wave):
    """W = λ Σ_j c_j Z_j((x - c_x) / a, (y - c_y) / a): Noll's orthonormal polynomials (zernike.py), j = 1, 2, 3, ….

    c_j are waves RMS over the circle of radius a about (c_x, c_y); outside it nothing is asked for, and `path` and
    `directions` go on with the polynomials, as far as these have rays.
    """

    coefficients: Annotated[
        tuple[float, ...], Key("Waves at the source's main wavelength, in Noll's order from j = 1.", "", -1e6, 1e6,
                               example=[0.0, 0.0, 0.0, 1.5])
    ]  # fmt: skip
    radius: Annotated[float, Key("Radius of the circle.", "mm", 1e-3, 1e6, example=10.0)]
    z: Annotated[float, Z]
    centre: Annotated[Place, Key("Middle of the circle.", "mm", -1e8, 1e8, example=[2.0, 0.0])] = (0.0, 0.0)
    weight: Annotated[float, WEIGHT] = 1.0
    kind: Annotated[Literal["zernike"], Key("A wave stated by Zernike coefficients over a circle.")] = "zernike"

    __pydantic_config__ = STRICT

    def contains(self, x: Tensor, y: Tensor) -> Tensor:
        """True at places (mm) of the plane for which the wave is stated: inside the circle."""
        return Circle(self.radius).contains(x - self.centre[0], y - self.centre[1])

    def path(self, x: Tensor, y: Tensor, wavelength: float) -> Tensor:
        """W (mm) at places (mm) of the plane, for a wavelength (nm)."""
        return self._eikonal(x, y, wavelength)[0]

    def directions(self, x: Tensor, y: Tensor, wavelength: float) -> Tensor:
        """(3, …) unit vectors of the rays through places (mm) of the plane, for a wavelength (nm)."""
        _, w_x, w_y = self._eikonal(x, y, wavelength)
        cos2 = 1 - w_x * w_x - w_y * w_y
        cos = torch.sqrt(torch.where(cos2 > 0, cos2, torch.ones_like(cos2)))  # where no ray is, any length does
        return torch.stack([w_x, w_y, cos])

    def steepest(self, wavelength: float) -> float:
        """The largest |∇W| on the circle, for a wavelength (nm): the sine of the angle of its steepest ray."""
        line = torch.linspace(-self.radius, self.radius, SAMPLES, dtype=torch.float64)
        x, y = torch.meshgrid(self.centre[0] + line, self.centre[1] + line, indexing="ij")
        _, w_x, w_y = self._eikonal(x, y, wavelength)
        return float(torch.hypot(w_x, w_y)[self.contains(x, y)].max())

    def _eikonal(self, x: Tensor, y: Tensor, wavelength: float) -> tuple[Tensor, Tensor, Tensor]:
        """(W in mm, ∂W/∂x, ∂W/∂y)."""
        x, y = (x - self.centre[0]) / self.radius, (y - self.centre[1]) / self.radius
        w, w_x, w_y = (wavelength * NM * part for part in zernike.series(self.coefficients, x, y))
        return w, w_x / self.radius, w_y / self.radius

    def complaints(self, back: float) -> Iterator[str]:
        """No coefficient at all."""
        yield from super().complaints(back)
        if not self.coefficients:
            yield "coefficients: none is in it; give some, such as [0.0, 0.0, 0.0, 1.5], or kind = 'plane'"


Wave = PlaneWave | SphericalWave | ZernikeWave


def beyond(place: Tensor, centre: Vector) -> Tensor:
    """|p - c| - |c| (mm) of places p (3, …) and a centre c (mm): by how much p is further from c than the origin is.

    As (p² - 2 p · c) / (|p - c| + |c|), which keeps its digits however far off the centre is.
    """
    x, y, z = place
    c_x, c_y, c_z = centre
    off = length(torch.stack([x - c_x, y - c_y, z - c_z]))
    return (x * (x - 2 * c_x) + y * (y - 2 * c_y) + z * (z - 2 * c_z)) / (off + math.hypot(*centre))


def length(vector: Tensor) -> Tensor:
    """|v| of (3, …)."""
    return torch.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
