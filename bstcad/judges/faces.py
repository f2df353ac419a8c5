"""Faces of a lens for programs not written here: heights and slopes at any points.

Independent of the code that bstcad traces by: scipy's splines on the control net and its knots, and the sag of a
surface of revolution in numpy.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.interpolate import BSpline, NdBSpline

from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.surfaces import Surface

NEWTON = 6  # steps for the parameter of a point; the first guess is at most half a knot off
ALONE = 512  # cells a side of the grid over a face without knots


@dataclass(frozen=True)
class Shape:
    """A face at some points: arrays of one shape."""

    x: np.ndarray  # mm
    y: np.ndarray  # mm
    z: np.ndarray  # mm
    z_x: np.ndarray  # ∂z/∂x
    z_y: np.ndarray  # ∂z/∂y
    z_xy: np.ndarray | None = None  # ∂²z/∂x∂y (1/mm); None: not computed

    @property
    def normals(self) -> np.ndarray:
        """(…, 3) unit normals towards +z."""
        normal = np.stack([-self.z_x, -self.z_y, np.ones_like(self.z)], axis=-1)
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


class Face(Protocol):
    """A face of a lens."""

    def at(self, x: np.ndarray, y: np.ndarray) -> Shape:
        """The face at points (mm); beyond its rim its tangent."""

    def on_grid(self, x: np.ndarray, y: np.ndarray) -> Shape:
        """The same where lines x and y (mm) cross, y along the first axis."""

    def lines(self, parts: int) -> tuple[np.ndarray, np.ndarray]:
        """x and y (mm) of the lines of an even grid over it, through all knots, each span in 2 `parts`."""


@dataclass(frozen=True, eq=False)
class Freeform:
    """A quadratic B-spline of a net that is even in x and in y."""

    net: np.ndarray  # (m, m, 3) mm, x along the first axis

    @cached_property
    def knots(self) -> np.ndarray:
        """{0, 0, 0, 1, 2, …, m-3, m-2, m-2, m-2}."""
        m = len(self.net)
        return np.r_[0.0, 0.0, np.arange(m - 1.0), m - 2.0, m - 2.0]

    @cached_property
    def _ends(self) -> tuple[tuple[float, float], tuple[float, float]]:
        return tuple((float(self.net[0, 0, i]), float(self.net[-1, -1, i])) for i in (0, 1))

    def lines(self, parts: int) -> tuple[np.ndarray, np.ndarray]:
        """Steps of a pitch over 2 `parts`: the knots lie at one and a half pitches from the rim, and every pitch on."""
        steps = 2 * parts * (len(self.net) - 1) + 1
        return tuple(np.linspace(*ends, steps) for ends in self._ends)

    def at(self, x: np.ndarray, y: np.ndarray) -> Shape:
        """By scipy's NdBSpline."""
        (inside_x, u, u_x), (inside_y, v, v_y) = self._parameter(x, 0), self._parameter(y, 1)
        spline = NdBSpline((self.knots, self.knots), np.ascontiguousarray(self.net[..., 2]), 2)
        z, z_u, z_v = (spline(np.stack([u, v], axis=-1), nu=nu) for nu in ((0, 0), (1, 0), (0, 1)))
        z_x, z_y = z_u * u_x, z_v * v_y
        return Shape(x, y, z + z_x * (x - inside_x) + z_y * (y - inside_y), z_x=z_x, z_y=z_y)

    def on_grid(self, x: np.ndarray, y: np.ndarray) -> Shape:
        """By scipy's BSpline along y of those along x, with the mixed derivative."""
        (inside_x, u, u_x), (inside_y, v, v_y) = self._parameter(x, 0), self._parameter(y, 1)
        along = [BSpline(self.knots, self.net[..., 2], 2)(u, nu=nu).T for nu in (0, 1)]
        z, z_u, z_v, z_uv = (BSpline(self.knots, a, 2)(v, nu=nu) for nu in (0, 1) for a in along)
        z_x, z_y, z_xy = z_u * u_x, z_v * v_y[:, None], z_uv * u_x * v_y[:, None]
        off_x, off_y = x - inside_x, (y - inside_y)[:, None]
        grid_x, grid_y = np.meshgrid(x, y)
        z = z + z_x * off_x + z_y * off_y + z_xy * off_x * off_y
        return Shape(grid_x, grid_y, z, z_x=z_x + z_xy * off_y, z_y=z_y + z_xy * off_x, z_xy=z_xy)

    def _parameter(self, x: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(x clipped to the net, t, dt/dx): x(t) = Σ B_i(t) x_i, by Newton's method."""
        ends, m = self._ends[axis], len(self.net)
        x = np.clip(x, *ends)
        along = BSpline(self.knots, np.linspace(*ends, m), 2)
        last = m - 2.0
        t = np.clip((x - ends[0]) / (ends[1] - ends[0]) * (m - 1) - 0.5, 0.0, last)
        for _ in range(NEWTON):
            t = np.clip(t - (along(t) - x) / along(t, nu=1), 0.0, last)
        return x, t, 1 / along(t, nu=1)


@dataclass(frozen=True)
class Revolved:
    """z = z0 + c r² / (1 + sqrt(1 - (1 + k) c² r²)), r² = x² + y²: plane, sphere or conic."""

    z0: float  # mm
    curvature: float  # c (1/mm)
    conic_constant: float  # k
    half: tuple[float, float]  # half its bounding box (mm)

    def lines(self, parts: int) -> tuple[np.ndarray, np.ndarray]:
        """It has no knots; `parts` does not matter to a plane."""
        cells = ALONE * parts if self.curvature else 64
        return tuple(np.linspace(-half, half, cells + 1) for half in self.half)

    def on_grid(self, x: np.ndarray, y: np.ndarray) -> Shape:
        """By its equation."""
        return self.at(*np.meshgrid(x, y))

    def at(self, x: np.ndarray, y: np.ndarray) -> Shape:
        """By its equation."""
        c, r2 = self.curvature, x**2 + y**2
        root = np.sqrt(np.maximum(1 - (1 + self.conic_constant) * c * c * r2, 1e-6))  # beyond its rim any value does
        return Shape(x, y, self.z0 + c * r2 / (1 + root), z_x=c * x / root, z_y=c * y / root)


def face(surface: Surface, outline: Outline) -> Freeform | Revolved:
    """A surface of a lens of that outline."""
    plain = surface.plain()
    if plain.curvature is None:
        return Freeform(plain.control_points())
    return Revolved(plain.z, plain.curvature, plain.conic_constant, outline.half_extent)


@dataclass(frozen=True)
class Off:
    """Error of a face as a program represents it."""

    height: float  # mm, RMS
    slope: float  # rad, RMS angle between normals

    def moves(self, lens: Lens, screen: Screen) -> float:
        """Shift of light on the screen (mm): a face turns light by |n - 1| times its angle, a mirror by twice that."""
        turns = 2.0 if lens.reflects else abs(lens.index - 1)
        return self.slope * turns * abs(screen.z - lens.back.z)

    @classmethod
    def worst(cls, of: Iterable[Off]) -> Off:
        """The largest height and the largest angle of several faces."""
        heights, slopes = zip(*((off.height, off.slope) for off in of), strict=True)
        return cls(max(heights), max(slopes))

    @classmethod
    def between(cls, heights: np.ndarray, normals: np.ndarray, wanted: Shape) -> Off:
        """Heights (mm) and unit normals (…, 3) compared with the face at the same points."""
        apart = np.linalg.norm(normals - wanted.normals, axis=-1)  # of unit vectors so near each other: the angle
        return cls(*(float(np.sqrt(np.mean(p**2))) for p in (heights - wanted.z, apart)))


def rim(outline: Outline, points: int = 512) -> np.ndarray:
    """(points, 2) of a closed curve (mm), anticlockwise: a circle as a polygon, a rectangle with all its corners."""
    if outline.shape == "circle":
        turn = np.linspace(0, 2 * np.pi, points, endpoint=False)
        return outline.radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * outline.half_extent
    along = np.arange(points // 4)[:, None] / (points // 4)
    sides = [a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    around = np.concatenate(sides)
    return np.stack(onto(outline, *around.T)[1:], axis=-1) if outline.limits[2] else around


def onto(outline: Outline, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(inside, x, y): points (mm), those outside moved to the nearest one on the rim."""
    a, b, r2 = outline.limits
    r, core_x, core_y = math.sqrt(r2), np.clip(x, -a, a), np.clip(y, -b, b)
    apart = np.hypot(x - core_x, y - core_y)
    shrink = r / np.maximum(apart, max(r, 1e-300))
    return apart <= r, core_x + shrink * (x - core_x), core_y + shrink * (y - core_y)


def scattered(outline: Outline, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random points (mm) inside an outline, at most so many."""
    a, b = outline.half_extent
    x, y = np.random.default_rng(seed).uniform([[-a], [-b]], [[a], [b]], (2, count))
    inside, _, _ = onto(outline, x, y)
    return x[inside], y[inside]
