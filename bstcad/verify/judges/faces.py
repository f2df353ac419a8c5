"""Faces of a lens for judges (heights, slopes and triangles), and the record of a judge's picture.

The faces are independent of bstcad's tracing: scipy evaluates splines on the control net and its knots, and numpy the
sag of a surface of revolution.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline, NdBSpline
from trimesh import Trimesh

from bstcad.optics.lens.lens import Lens
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.bspline import is_net
from bstcad.optics.surfaces.outlines import Circle, Outline
from bstcad.optics.surfaces.surfaces import Surface
from bstcad.optics.trace.unfolding import per_radian

PARAMETER_STEPS = 6  # steps of Newton's method for t at a given x; the first guess has an error of at most half a span
GRID_CELLS = 512  # number of cells per side of the coarsest grid over a curved face without knots
PLATE_RINGS = (1.0, 1.2, 1.5, 2.0, 4.0, 10.0, 30.0, 100.0)  # radii of rings / rim radius; slim triangles leak light


@dataclass(frozen=True)
class FaceShape:
    """Heights and slopes of a face at some points, arrays of one shape."""

    x: np.ndarray  # x of the points (mm)
    y: np.ndarray  # y of the points (mm)
    z: np.ndarray  # height (mm)
    z_x: np.ndarray  # ∂z/∂x
    z_y: np.ndarray  # ∂z/∂y
    z_xy: np.ndarray | None = None  # ∂²z/∂x∂y (1/mm); None: not computed

    @property
    def points(self) -> np.ndarray:
        """Points of the face, (…, 3), mm."""
        return np.stack([self.x, self.y, self.z], axis=-1)

    @property
    def normals(self) -> np.ndarray:
        """Unit normals towards +z, (…, 3)."""
        normal = np.stack([-self.z_x, -self.z_y, np.ones_like(self.z)], axis=-1)
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


@dataclass(frozen=True, eq=False)
class Freeform:
    """A quadratic B-spline on a net that is uniform in x and in y, extrapolated linearly outside the net."""

    net: np.ndarray  # control net, (m, n, 3), mm, x along the first axis

    @cached_property
    def knots(self) -> tuple[np.ndarray, np.ndarray]:
        """Full knot vectors: {0, 0, 0, 1, 2, …, m-3, m-2, m-2, m-2} along x, with n instead of m along y."""
        m, n = (np.r_[0.0, 0.0, np.arange(m - 1.0), m - 2.0, m - 2.0] for m in self.net.shape[:2])
        return m, n

    @cached_property
    def _ends(self) -> tuple[tuple[float, float], tuple[float, float]]:
        (x0, y0), (x1, y1) = self.net[0, 0, :2].tolist(), self.net[-1, -1, :2].tolist()
        return (x0, x1), (y0, y1)

    def lines(self, parts: int) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y (mm) of grid lines, 2 * parts per pitch; each knot (at 1.5, 2.5, … pitches) has one."""
        x, y = (
            np.linspace(*ends, 2 * parts * (m - 1) + 1) for ends, m in zip(self._ends, self.net.shape, strict=False)
        )
        return x, y

    def at(self, x: np.ndarray, y: np.ndarray) -> FaceShape:
        """Evaluate the face at points (mm) by scipy's NdBSpline."""
        (inside_x, u, u_x), (inside_y, v, v_y) = self._parameter(x, 0), self._parameter(y, 1)
        spline = NdBSpline(self.knots, np.ascontiguousarray(self.net[..., 2]), 2)
        z, z_u, z_v = (spline(np.stack([u, v], axis=-1), nu=nu) for nu in ((0, 0), (1, 0), (0, 1)))
        z_x, z_y = z_u * u_x, z_v * v_y
        return FaceShape(x, y, z + z_x * (x - inside_x) + z_y * (y - inside_y), z_x=z_x, z_y=z_y)

    def on_grid(self, x: np.ndarray, y: np.ndarray) -> FaceShape:
        """Evaluate the face, with z_xy, where lines x and y (mm) cross, y along the first axis, by scipy's BSpline."""
        (inside_x, u, u_x), (inside_y, v, v_y) = self._parameter(x, 0), self._parameter(y, 1)
        along = [BSpline(self.knots[0], self.net[..., 2], 2)(u, nu=nu).T for nu in (0, 1)]
        z, z_u, z_v, z_uv = (BSpline(self.knots[1], a, 2)(v, nu=nu) for nu in (0, 1) for a in along)
        z_x, z_y, z_xy = z_u * u_x, z_v * v_y[:, None], z_uv * u_x * v_y[:, None]
        off_x, off_y = x - inside_x, (y - inside_y)[:, None]
        grid_x, grid_y = np.meshgrid(x, y)
        z = z + z_x * off_x + z_y * off_y + z_xy * off_x * off_y
        return FaceShape(grid_x, grid_y, z, z_x=z_x + z_xy * off_y, z_y=z_y + z_xy * off_x, z_xy=z_xy)

    def _parameter(self, x: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return x (axis 1: y) clipped to the net, and t and dt/dx for x(t) = Σ B_i(t) x_i, by Newton's method."""
        ends, m = self._ends[axis], self.net.shape[axis]
        x = np.clip(x, *ends)
        along = BSpline(self.knots[axis], np.linspace(*ends, m), 2)
        last = m - 2.0
        t = np.clip((x - ends[0]) / (ends[1] - ends[0]) * (m - 1) - 0.5, 0.0, last)
        for _ in range(PARAMETER_STEPS):
            t = np.clip(t - (along(t) - x) / along(t, nu=1), 0.0, last)
        return x, t, 1 / along(t, nu=1)


@dataclass(frozen=True)
class Revolved:
    """z = z0 + c r² / (1 + sqrt(1 - (1 + k) c² r²)), r² = x² + y²: plane, sphere or conic."""

    z0: float  # z of the vertex (mm)
    curvature: float  # c (1/mm)
    conic_constant: float  # k
    half: tuple[float, float]  # half extents along x and y (mm)

    def lines(self, parts: int) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y (mm) of the lines of a uniform grid over the face; parts: refinement (ignored on a plane)."""
        cells = GRID_CELLS * parts if self.curvature else 64
        x, y = (np.linspace(-half, half, cells + 1) for half in self.half)
        return x, y

    def on_grid(self, x: np.ndarray, y: np.ndarray) -> FaceShape:
        """Evaluate the face where lines x and y (mm) cross, y along the first axis."""
        return self.at(*np.meshgrid(x, y))

    def at(self, x: np.ndarray, y: np.ndarray) -> FaceShape:
        """Evaluate the face at points (mm)."""
        c, r2 = self.curvature, x**2 + y**2
        cos2 = 1 - (1 + self.conic_constant) * c * c * r2
        root = np.sqrt(np.maximum(cos2, 1e-6))  # any value is allowed outside the rim
        return FaceShape(x, y, self.z0 + c * r2 / (1 + root), z_x=c * x / root, z_y=c * y / root)


Face = Freeform | Revolved


def face(surface: Surface, outline: Outline) -> Face:
    """Return a surface of a lens as a Freeform or Revolved face; outline: bounds of a Revolved face."""
    plain = surface.plain()
    if is_net(plain):
        return Freeform(plain.control_points())
    return Revolved(plain.z, *plain.conic(), outline.half_extent)


@dataclass(frozen=True)
class FaceError:
    """Error of a face in a judge's representation."""

    height: float  # RMS error of heights (mm)
    slope: float  # RMS angle between normals (rad)

    def shift(self, lens: Lens, screen: Screen) -> float:
        """Return the RMS shift of light on the screen due to the error of the slope, in the screen's unit."""
        return self.slope * lens.deflection * abs(per_radian(lens, screen))

    @classmethod
    def worst(cls, errors: Iterable[FaceError]) -> FaceError:
        """Return the largest errors of height and slope of several faces."""
        heights, slopes = zip(*((error.height, error.slope) for error in errors), strict=True)
        return cls(max(heights), max(slopes))

    @classmethod
    def between(cls, heights: np.ndarray, normals: np.ndarray, exact: FaceShape) -> FaceError:
        """Return the error of heights (mm) and unit normals (…, 3) against the exact face at the same points."""
        angles = np.linalg.norm(normals - exact.normals, axis=-1)  # small-angle approximation
        return cls(*(float(np.sqrt(np.mean(p**2))) for p in (heights - exact.z, angles)))


@dataclass(frozen=True, eq=False)
class Traced:
    """A judge's picture of the light on a screen."""

    halves: np.ndarray = field(repr=False)  # flux per pixel, (2, rows, columns), row 0 = y max; full flux in each half
    rays: int  # total number of rays
    error: FaceError  # largest error of the judge's faces
    by: str = ""  # variant of the program; "": it has only one

    @property
    def picture(self) -> np.ndarray:
        """Mean of the two halves, (rows, columns)."""
        return self.halves.mean(axis=0)


# --- outlines ---------------------------------------------------------------------------------------------------------


def rim(outline: Outline, points: int = 512) -> np.ndarray:
    """Return points (points, 2) along an outline (mm), counterclockwise, including all corners of a rectangle."""
    if isinstance(outline, Circle):
        turn = np.linspace(0, 2 * np.pi, points, endpoint=False)
        return outline.radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * outline.half_extent
    along = np.arange(points // 4)[:, None] / (points // 4)
    around = np.concatenate([a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    return np.stack(clip_to_rim(outline, *around.T)[1:], axis=-1) if outline.limits[2] else around


def clip_to_rim(outline: Outline, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a mask of points inside an outline, and x, y (mm) with points outside moved to the nearest rim point."""
    a, b, r2 = outline.limits
    r, core_x, core_y = math.sqrt(r2), np.clip(x, -a, a), np.clip(y, -b, b)
    distance = np.hypot(x - core_x, y - core_y)
    shrink = r / np.maximum(distance, max(r, 1e-300))
    return distance <= r, core_x + shrink * (x - core_x), core_y + shrink * (y - core_y)


def random_points(outline: Outline, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at most `count` random points x, y (mm) inside an outline."""
    a, b = outline.half_extent
    x, y = np.random.default_rng(seed).uniform([[-a], [-b]], [[a], [b]], (2, count))
    inside, _, _ = clip_to_rim(outline, x, y)
    return x[inside], y[inside]


# --- triangles, for a program that traces meshes ----------------------------------------------------------------------


def _mesh(corners: np.ndarray, normals: np.ndarray, triangles: np.ndarray, uv: np.ndarray | None = None) -> Trimesh:
    """Return the mesh of corners (n, 3) in mm and triangles (k, 3), with unit normals (n, 3) and texture uv (n, 2)."""
    mesh = Trimesh(corners, triangles, vertex_normals=normals, process=False)
    if uv is not None:
        mesh.vertex_attributes |= dict(zip("uv", uv.T.astype("<f4"), strict=True))
    return mesh


def face_mesh(face: Face, outline: Outline, parts: int, up: bool) -> tuple[Trimesh, FaceError]:
    """Return a mesh of a face inside the outline, and its error; exact normals at corners, towards +z (up) or -z.

    The grid (Face.lines(parts)) has lines through all knots.  Between corners, normals are interpolated linearly,
    nearly as on a quadratic spline.  Cells without a corner inside are omitted; then corners outside move to the rim.
    """
    x, y = face.lines(parts)
    shape = face.on_grid(x, y)
    inside, rim_x, rim_y = clip_to_rim(outline, shape.x, shape.y)
    at_corners = [inside[:-1, :-1], inside[:-1, 1:], inside[1:, 1:], inside[1:, :-1]]
    cells, used = np.logical_or.reduce(at_corners), np.zeros_like(inside)
    for corner in (used[:-1, :-1], used[:-1, 1:], used[1:, 1:], used[1:, :-1]):
        corner |= cells
    corners, normals, moved = shape.points, shape.normals, used & ~inside
    at_rim = face.at(rim_x[moved], rim_y[moved])
    corners[moved], normals[moved] = at_rim.points, at_rim.normals
    numbers, (i, j) = np.cumsum(used).reshape(used.shape) - 1, np.nonzero(cells)
    a, b, c, d = numbers[i, j], numbers[i, j + 1], numbers[i + 1, j + 1], numbers[i + 1, j]
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    error = _mesh_error(face, shape, x, y, whole=np.logical_and.reduce(at_corners))
    if up:
        return _mesh(corners[used], normals[used], triangles), error
    return _mesh(corners[used], -normals[used], triangles[:, ::-1]), error


def _mesh_error(face: Face, shape: FaceShape, x: np.ndarray, y: np.ndarray, *, whole: np.ndarray) -> FaceError:
    """Return the error of the mesh at the midpoints of the cells' diagonals; whole: True for cells inside the rim."""
    middle = face.on_grid((x[:-1] + x[1:]) / 2, (y[:-1] + y[1:]) / 2)
    between = shape.normals[:-1, :-1] + shape.normals[1:, 1:]
    between /= np.linalg.norm(between, axis=-1, keepdims=True)
    heights = (shape.z[:-1, :-1] + shape.z[1:, 1:]) / 2
    exact = FaceShape(*(getattr(middle, name)[whole] for name in ("x", "y", "z", "z_x", "z_y")))
    return FaceError.between(heights[whole], between[whole], exact)


def wall(front: Face, back: Face, apertures: tuple[Outline, Outline]) -> Trimesh:
    """Return the mesh of a lens's wall between the rims of the clear apertures of front and back."""
    below, around = map(rim, apertures)
    low, high = front.at(*below.T).points, back.at(*around.T).points
    return _strips([low, high], np.c_[around / np.linalg.norm(around, axis=1, keepdims=True), np.zeros(len(around))])


def plate(front: Face, outline: Outline) -> Trimesh:
    """Return the mesh of a plate around the front: from the front's rim outwards, at the height of this rim."""
    hole = front.at(*rim(outline).T).points
    return _strips([hole * (ring, ring, 1.0) for ring in PLATE_RINGS], np.tile([0.0, 0.0, 1.0], (len(hole), 1)))


def disc(outline: Outline, centre: tuple[float, float, float], along: tuple[float, float, float]) -> Trimesh:
    """Return the mesh of the area inside an outline around `centre` (mm), normals `along`, texture u, v from 0 to 1."""
    around = rim(outline, 4) if outline.shape == "rectangle" else rim(outline)
    points = np.concatenate([np.zeros((1, 2)), around])
    k = np.arange(len(around))
    triangles = np.stack([np.zeros_like(k), 1 + k, 1 + (k + 1) % len(k)], axis=1)
    corners = np.c_[points, np.zeros(len(points))] + centre
    uv = 0.5 + points / (2 * np.array(outline.half_extent))
    return _mesh(corners, np.tile(along, (len(points), 1)), triangles if along[2] > 0 else triangles[:, ::-1], uv)


def _strips(curves: Sequence[np.ndarray], normals: np.ndarray) -> Trimesh:
    """Return strips of triangles between successive closed curves (n, 3) with equal numbers of points."""
    n = len(normals)
    k, after = np.arange(n), (np.arange(n) + 1) % n
    strip = np.concatenate([np.stack([k, after, after + n], axis=1), np.stack([k, after + n, k + n], axis=1)])
    triangles = np.concatenate([strip + n * number for number in range(len(curves) - 1)])
    return _mesh(np.concatenate(curves), np.tile(normals, (len(curves), 1)), triangles)
