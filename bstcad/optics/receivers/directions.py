"""Directions: a receiver infinitely far away, whose coordinates are two angles in degrees.

A unit vector d has the angle θ from +z, and the coordinates

- "C": x = θ d_x / r and y = θ d_y / r, r = hypot(d_x, d_y), so that a distance from the centre is an angle from the
  axis (type C photometry with γ = θ: C is the angle about the axis).  A cell has the solid angle dx dy sin θ / θ.
- "A": x = atan2(d_x, d_z) about the vertical axis, and the elevation y = asin(d_y); solid angle dx dy cos y.
- "B": x = asin(d_x), and y = atan2(d_y, d_z) about the horizontal axis; solid angle dx dy cos x.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.numerics.reductions import elementary
from bstcad.optics.receivers.receivers import Array, MovedReceiver, Receiver
from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.rays import Rays, Vector

FAR = 1e9  # distance (mm) of points that stand for directions; a lens of 100 mm is seen from there at 1e-7 rad
GONIOMETERS = {"C": 1, "A": 2, "B": 3}  # number of the system of angles for the kernels
NAMES = {
    "C": "directions by the angle from the axis", "A": "directions by horizontal angle and elevation",
    "B": "directions by vertical angle and inclination to the side",
}  # fmt: skip
TINY = 1e-30
DRAWN_WIDTHS = 3.0  # distance at which directions are drawn, in widths of the lens
MAX_VALUES = 1 << 22  # number of solid angles that are computed at a time
FINE_CELL = 1.0  # largest side (degrees) of a fine cell
FINE_NODES, NODES = 2, 4  # Gauss-Legendre nodes per side of a fine cell, to 1e-10, and of other cells

Angles = Literal["C", "A", "B"]


@dataclass(frozen=True)
class Directions(Receiver):
    """All directions, in coordinates of one kind."""

    angles: Angles = "C"
    start: float = 0.0  # z (mm) of the point from which directions are drawn
    distance: float = FAR  # distance (mm) at which directions are drawn, and from which on rays are not followed

    unit, light, photometric_unit = "degrees", "radiant intensity", "cd"

    def __post_init__(self) -> None:
        object.__setattr__(self, "goniometer", GONIOMETERS[self.angles])
        object.__setattr__(self, "names", ("x", "y") if self.angles == "C" else ("horizontal", "vertical"))

    def position_text(self, origin: float = 0.0) -> str:
        """Return the kind of the coordinates in words."""
        return NAMES[self.angles]

    @property
    def middle(self) -> Vector:
        """Point on the axis that stands for its direction (mm)."""
        return 0.0, 0.0, self.start + self.distance

    def drawn(self, lens: float, z: float) -> Receiver:
        """Return the directions at a distance at which a picture still shows the lens."""
        return replace(self, start=z, distance=DRAWN_WIDTHS * lens)

    def path(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Return (path, status): every ray has a direction; it is followed only if the directions are drawn."""
        return torch.full_like(rays.direction[0], self.distance if self.distance < FAR else 0.0), rays.status

    def coordinates(self, rays: Rays) -> Sequence[Tensor]:
        """Return x and y (degrees) of the directions of rays."""
        d_x, d_y, d_z = rays.direction
        if self.angles == "A":
            angles = elementary(torch.atan2, d_x, d_z), elementary(torch.asin, d_y.clamp(-1, 1))
        elif self.angles == "B":
            angles = elementary(torch.asin, d_x.clamp(-1, 1)), elementary(torch.atan2, d_y, d_z)
        else:
            r = torch.sqrt((d_x * d_x + d_y * d_y).clamp_min(TINY))
            scale = elementary(torch.atan2, r, d_z) / r
            angles = scale * d_x, scale * d_y
        return tuple(map(torch.rad2deg, angles))

    def direction(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the unit vectors of the coordinates (degrees)."""
        lib = torch if isinstance(x, Tensor) else np
        x, y = lib.deg2rad(x), lib.deg2rad(y)
        if self.angles == "A":
            return lib.cos(y) * lib.sin(x), lib.sin(y), lib.cos(y) * lib.cos(x)
        if self.angles == "B":
            return lib.sin(x), lib.cos(x) * lib.sin(y), lib.cos(x) * lib.cos(y)
        theta = lib.sqrt(x * x + y * y)
        part = lib.sinc(theta / math.pi)  # sin θ / θ
        return part * x, part * y, lib.cos(theta)

    def point(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the points (mm) that stand for the directions x, y (degrees)."""
        single = not isinstance(x, Tensor | np.ndarray)
        d = self.direction(*map(np.asarray, (x, y))) if single else self.direction(x, y)
        x, y, z = (self.distance * (float(p) if single else p) for p in d)
        return x, y, self.start + z

    def vector_to(self, rays: Rays, aim: Tensor) -> Tensor:
        """Return vectors (3, …) along the directions `aim` (2, …), from wherever the rays are."""
        return torch.stack([FAR * part.expand_as(rays.position[0]) for part in self.direction(*aim)])

    def normal(self, aim: Tensor) -> Sequence[Tensor]:
        """Return the unit vectors of the directions `aim` (2, …)."""
        return self.direction(*aim)

    def clearance(self, outline: Outline, z: float) -> float:
        """Return the distance (mm) of the points that stand for directions."""
        return FAR

    def throw(self, z: float) -> float:
        """Return the distance (mm) of the points that stand for directions."""
        return FAR

    def per_radian(self, z: float) -> float:
        """Return the degrees per radian of deflection."""
        return math.degrees(1.0)

    def moved(self, motion: Motion) -> Receiver:
        """Return the directions after a rotation; a shift does not change them."""
        return MovedReceiver(self, motion) if motion.rotates else self

    def areas(self, x: tuple[float, float], y: tuple[float, float], shape: tuple[int, int]) -> np.ndarray | None:
        """Return the solid angles of (rows, columns) cells of ranges x, y, divided by their mean; row 0 is y max."""
        cells = _mean_densities(self, x, y, shape=shape)
        return cells[::-1] / cells.mean()

    def cell_sizes(self, x: tuple[float, float], y: tuple[float, float], shape: tuple[int, int]) -> np.ndarray:
        """Return the solid angles (sr) of (rows, columns) cells of ranges x, y; row 0 is y max."""
        (rows, columns), width, height = shape, math.radians(x[1] - x[0]), math.radians(y[1] - y[0])
        return _mean_densities(self, x, y, shape=shape)[::-1] * (width * height / (rows * columns))

    def mean_densities(self, x: tuple[float, float], y: tuple[float, float], shape: tuple[int, int]) -> np.ndarray:
        """Return the mean solid angle per dx dy of (rows, columns) cells, a few rows at a time; row 0 is y min."""
        rows, columns = shape
        fine = max((x[1] - x[0]) / columns, (y[1] - y[0]) / rows) <= FINE_CELL
        node, weight = np.polynomial.legendre.leggauss(FINE_NODES if fine else NODES)
        at_x, at_y = (
            np.radians(low + (np.arange(n)[:, None] + (node + 1) / 2) * (high - low) / n)
            for (low, high), n in ((x, columns), (y, rows))
        )
        cells, strip = np.empty(shape), max(MAX_VALUES // (columns * len(node) ** 2), 1)
        for first in range(0, rows, strip):
            density = self._density(at_x[None, None], at_y[first : first + strip, :, None, None])
            cells[first : first + strip] = (density * (weight[:, None, None] * weight / 4)).sum((1, 3))
        return cells

    def _density(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the solid angle per dx dy at coordinates in rad."""
        x, y = np.broadcast_arrays(x, y)
        if self.angles == "A":
            return np.cos(y)
        return np.cos(x) if self.angles == "B" else np.sinc(np.hypot(x, y) / np.pi)  # sin θ / θ


@functools.lru_cache(maxsize=4)
def _mean_densities(
    receiver: Directions, x: tuple[float, float], y: tuple[float, float], shape: tuple[int, int]
) -> np.ndarray:
    return receiver.mean_densities(x, y, shape)
