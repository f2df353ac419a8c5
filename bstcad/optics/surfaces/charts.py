"""Charts: the coordinates (x, y, h) in which a tailored face is a function h(x, y).

The chart of a height field is space itself, h = z.  The chart of a radial surface is the sphere of radius R about its
centre.  There (x, y) are the stereographic coordinates of the direction d from the centre,

    d = (2 u, 2 v, 1 - u² - v²) / (1 + u² + v²),    (u, v) = (x, y) / (2 R) = tan(θ / 2) (cos ψ, sin ψ),

θ the angle from +z, and h = ρ - R with the distance ρ from the centre.  Near the axis x and y are millimetres.

The slopes in a chart are those of a potential f whose gradient Snell's law determines at each point.  In space f = z.
On the sphere f = R log(ρ / R): the normal of the surface ρ(d) d is parallel to d - ∇_s log ρ, ∇_s the gradient on the
unit sphere.  Stereographic coordinates are conformal: lengths on the unit sphere are those of (x, y) times the same
factor s / R in all directions, s = 1 / (1 + u² + v²).  With the orthonormal axes (e_x, e_y, d) of the sphere,

    ∇f = -s (n_x, n_y) / n_d,    n the normal, n_x = n · e_x, n_y = n · e_y, n_d = n · d.

In space the axes are (x, y, z) and s = 1, which gives the slopes -n_x / n_z and -n_y / n_z.
Source for the sphere: Wang, X.-J. 1996, "On the design of a reflector antenna", Inverse Problems 12, 351 (reflectors);
Gutiérrez and Huang 2009, "The refractor problem in reshaping light beams", Arch. Rational Mech. Anal. 193, 423.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.surfaces.outlines import Outline

MAX_DRAWN_ANGLE = 179.0  # largest angle from the axis (degrees) of a direction in a figure


class Chart(ABC):
    """Coordinates of points near a face; positions are relative to the face's `z` on the axis (mm)."""

    flat = False  # True if x and y are those of space, so that an outline is seen along the axis as it is
    labels: tuple[str, str]  # names of the coordinates in a figure, see `drawn`
    distance: str  # name of the distance h + offset in a figure

    @property
    def offset(self) -> float:
        """Distance (mm) of the surface h = 0."""
        return 0.0

    @abstractmethod
    def point(self, x: Tensor, y: Tensor, h: Tensor) -> Tensor:
        """Return the position (3, …) (mm) of coordinates (mm)."""

    @abstractmethod
    def coordinates(self, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the coordinates (x, y, h) (mm) of a position (3, …) (mm)."""

    @abstractmethod
    def local(self, position: Tensor, vector: Tensor) -> Tensor:
        """Return the components (3, …) of vectors along the chart's axes at a position; the third is that of h."""

    @abstractmethod
    def stretch(self, position: Tensor) -> Tensor | float:
        """Return the factor s by which the slope ∇f differs from -(n_x, n_y) / n_d."""

    @abstractmethod
    def arcs(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return lengths (mm) on the surface h = 0: along x from the plane x = 0, and from the axis."""

    @abstractmethod
    def drawn(self, places: np.ndarray) -> np.ndarray:
        """Return the coordinates (…, 2) in a figure, named `labels`, of coordinates (…, 2) (mm)."""

    @abstractmethod
    def from_drawn(self, places: np.ndarray) -> np.ndarray:
        """Return the coordinates (…, 2) (mm) of coordinates (…, 2) in a figure, the inverse of `drawn`."""

    @abstractmethod
    def outline_in(self, other: Chart, outline: Outline) -> Outline:
        """Return an outline of this chart in another chart of the same kind: the same curve on the same face."""


class HeightChart(Chart):
    """Chart of height fields: x, y and z."""

    flat = True
    labels = ("x (mm)", "y (mm)")
    distance = "Sag"

    def point(self, x: Tensor, y: Tensor, h: Tensor) -> Tensor:
        """Return (x, y, h) stacked."""
        return torch.stack([x, y, h])

    def coordinates(self, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return x, y and z of a position."""
        return position[0], position[1], position[2]

    def local(self, position: Tensor, vector: Tensor) -> Tensor:
        """Return the vectors themselves."""
        return vector

    def stretch(self, position: Tensor) -> float:
        """Return 1."""
        return 1.0

    def arcs(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return x and sqrt(x² + y²)."""
        return np.broadcast_arrays(x, y)[0], np.hypot(x, y)

    def drawn(self, places: np.ndarray) -> np.ndarray:
        """Return the coordinates themselves."""
        return places

    def from_drawn(self, places: np.ndarray) -> np.ndarray:
        """Return the coordinates themselves."""
        return places

    def outline_in(self, other: Chart, outline: Outline) -> Outline:
        """Return the outline itself."""
        return outline


HEIGHTS = HeightChart()


@dataclass(frozen=True)
class SphereChart(Chart):
    """Chart of radial surfaces: stereographic coordinates of the direction from the centre, and distance minus R."""

    radius: float  # R, mm

    labels = ("θ cos ψ (degrees)", "θ sin ψ (degrees)")
    distance = "Distance from the centre"

    @property
    def offset(self) -> float:
        """Radius R (mm)."""
        return self.radius

    @staticmethod
    def angle(length: float, radius: float) -> float:
        """Return θ (rad) at the distance `length` (mm) from the middle of the chart of a sphere."""
        return 2 * math.atan(length / (2 * radius))

    def length(self, angle: float) -> float:
        """Return 2 R tan(θ / 2) (mm), the distance from the middle of the chart to directions at θ (rad)."""
        return 2 * self.radius * math.tan(angle / 2)

    def direction(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the unit vectors d (3, …) at (x, y) (mm)."""
        u, v = x / (2 * self.radius), y / (2 * self.radius)
        square = u * u + v * v
        return torch.stack([2 * u, 2 * v, 1 - square]) / (1 + square)

    def point(self, x: Tensor, y: Tensor, h: Tensor) -> Tensor:
        """Return (R + h) d."""
        return (self.radius + h) * self.direction(x, y)

    def coordinates(self, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (x, y, ρ - R); x = 2 R p_x / (ρ + p_z), which is finite except opposite to the axis."""
        p_x, p_y, p_z = position
        rho = torch.sqrt(p_x * p_x + p_y * p_y + p_z * p_z)
        scale = 2 * self.radius / (rho + p_z).clamp(min=1e-300)
        return scale * p_x, scale * p_y, rho - self.radius

    def local(self, position: Tensor, vector: Tensor) -> Tensor:
        """Return the components along (e_x, e_y, d).

        With d = p / ρ the axes are e_x = (1 - d_x² / (1 + d_z), -d_x d_y / (1 + d_z), -d_x), and likewise e_y.
        """
        d_x, d_y, d_z = position / torch.sqrt((position * position).sum(0))
        share = (d_x * vector[0] + d_y * vector[1]) / (1 + d_z).clamp(min=1e-300) + vector[2]
        along = d_x * vector[0] + d_y * vector[1] + d_z * vector[2]
        return torch.stack([vector[0] - d_x * share, vector[1] - d_y * share, along])

    def stretch(self, position: Tensor) -> Tensor:
        """Return s = 1 / (1 + u² + v²) = (1 + d_z) / 2."""
        return (1 + position[2] / torch.sqrt((position * position).sum(0))) / 2

    def arcs(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return R times the angles of d from the plane x = 0 and from the axis."""
        d_x, d_y, d_z = self.direction(*map(torch.from_numpy, map(np.array, np.broadcast_arrays(x, y)))).numpy()
        return self.radius * np.arctan2(d_x, d_z), self.radius * np.arctan2(np.hypot(d_x, d_y), d_z)

    def drawn(self, places: np.ndarray) -> np.ndarray:
        """Return θ (cos ψ, sin ψ) (degrees), so that a part that overhangs is shown too."""
        length = np.hypot(places[..., 0], places[..., 1])[..., None]
        theta = np.degrees(2 * np.arctan(length / (2 * self.radius)))
        return places * theta / np.where(length > 0, length, 1.0)

    def from_drawn(self, places: np.ndarray) -> np.ndarray:
        """Return 2 R tan(θ / 2) (cos ψ, sin ψ), θ at most MAX_DRAWN_ANGLE."""
        theta = np.hypot(places[..., 0], places[..., 1])[..., None]
        length = 2 * self.radius * np.tan(np.radians(np.minimum(theta, MAX_DRAWN_ANGLE)) / 2)
        return length / np.where(theta > 0, theta, 1.0) * places

    def outline_in(self, other: Chart, outline: Outline) -> Outline:
        """Return the outline of the same directions: coordinates are proportional to R."""
        assert isinstance(other, SphereChart)
        return outline.scaled(other.radius / self.radius)
