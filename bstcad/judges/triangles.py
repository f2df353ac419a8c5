"""The lens as triangles with exact normals at their corners, for a program that traces meshes.

Each face is an even grid whose lines fall on all knots, cut at the outline; normals are linear between its corners, as
those of a quadratic spline nearly are.  The wall of the lens and a plate around its front stop the light that bstcad
counts as lost: through the sides, and past the lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bstcad.judges import faces
from bstcad.judges.faces import Face, Off, Shape
from bstcad.optics.outlines import Outline

RINGS = (1.0, 1.2, 1.5, 2.0, 4.0, 10.0, 30.0, 100.0)  # of the plate, over the lens: thin triangles leak light


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with normals at their corners."""

    corners: np.ndarray  # (n, 3) mm
    normals: np.ndarray  # (n, 3) unit vectors
    triangles: np.ndarray  # (k, 3) numbers of corners, anticlockwise where the normals point at the reader
    uv: np.ndarray | None = None  # (n, 2) coordinates in a texture

    def write(self, path: Path) -> Path:
        """As a binary PLY file, in float32."""
        columns = [self.corners, self.normals, *([] if self.uv is None else [self.uv])]
        names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")[: 3 * 2 if self.uv is None else 8]
        known = np.empty(len(self.triangles), dtype=[("n", "u1"), ("corners", "<i4", 3)])
        known["n"], known["corners"] = 3, self.triangles
        head = (
            f"ply\nformat binary_little_endian 1.0\nelement vertex {len(self.corners)}\n"
            + "".join(f"property float {name}\n" for name in names)
            + f"element face {len(known)}\nproperty list uchar int vertex_indices\nend_header\n"
        )
        path.write_bytes(head.encode() + np.hstack(columns).astype("<f4").tobytes() + known.tobytes())
        return path


def of_face(face: Face, outline: Outline, parts: int, up: bool) -> tuple[Mesh, Off]:
    """A face inside the outline, with normals towards +z or -z, and its error against the exact face.

    Cells that the rim cuts have their outer corners moved onto it; cells outside are left away.
    """
    x, y = face.lines(parts)
    shape = face.on_grid(x, y)
    inside, rim_x, rim_y = faces.onto(outline, shape.x, shape.y)
    kept = inside[:-1, :-1] | inside[:-1, 1:] | inside[1:, :-1] | inside[1:, 1:]
    used = np.zeros_like(inside)
    for corner in (used[:-1, :-1], used[:-1, 1:], used[1:, :-1], used[1:, 1:]):
        corner |= kept
    corners, normals, moved = _points(shape), shape.normals, used & ~inside
    at_rim = face.at(rim_x[moved], rim_y[moved])
    corners[moved], normals[moved] = _points(at_rim), at_rim.normals
    triangles = (np.cumsum(used) - 1)[_cells(*np.nonzero(kept), len(x))]
    off = _off(face, shape, x, y, inside=inside)
    if up:
        return Mesh(corners[used], normals[used], triangles), off
    return Mesh(corners[used], -normals[used], triangles[:, ::-1]), off


def wall(front: Face, back: Face, apertures: tuple[Outline, Outline]) -> Mesh:
    """The sides of a lens, from the rim of its front's clear aperture to that of its back's."""
    below, around = map(faces.rim, apertures)
    low, high = _points(front.at(*below.T)), _points(back.at(*around.T))
    return _strips([low, high], np.c_[around / np.linalg.norm(around, axis=1, keepdims=True), np.zeros(len(around))])


def plate(front: Face, outline: Outline) -> Mesh:
    """A plate with a hole in which the front sits, level with its rim."""
    around = faces.rim(outline)
    hole = _points(front.at(*around.T))
    return _strips([hole * (ring, ring, 1.0) for ring in RINGS], np.tile([0.0, 0.0, 1.0], (len(hole), 1)))


def disc(outline: Outline, centre: tuple[float, float, float], along: tuple[float, float, float]) -> Mesh:
    """The inside of an outline on a level plane, with normals of any direction; u and v are 0 to 1 along x and y."""
    around = faces.rim(outline, 4) if outline.shape == "rectangle" else faces.rim(outline)
    points = np.concatenate([np.zeros((1, 2)), around])
    k = np.arange(len(around))
    triangles = np.stack([np.zeros_like(k), 1 + k, 1 + (k + 1) % len(k)], axis=1)
    corners = np.c_[points, np.zeros(len(points))] + centre
    uv = 0.5 + points / (2 * np.array(outline.half_extent))
    return Mesh(corners, np.tile(along, (len(points), 1)), triangles if along[2] > 0 else triangles[:, ::-1], uv)


def _strips(curves: Sequence[np.ndarray], normals: np.ndarray) -> Mesh:
    """Strips between closed curves of equal numbers of points, one after the other."""
    n = len(normals)
    k, after = np.arange(n), (np.arange(n) + 1) % n
    one = np.concatenate([np.stack([k, after, after + n], axis=1), np.stack([k, after + n, k + n], axis=1)])
    triangles = np.concatenate([one + n * strip for strip in range(len(curves) - 1)])
    return Mesh(np.concatenate(curves), np.tile(normals, (len(curves), 1)), triangles)


def _points(shape: Shape) -> np.ndarray:
    return np.stack([shape.x, shape.y, shape.z], axis=-1)


def _cells(i: np.ndarray, j: np.ndarray, columns: int) -> np.ndarray:
    """The two triangles of each cell (i, j) of a grid, both with its diagonal from the first to the third corner."""
    a, b, c, d = (r * columns + s for r, s in ((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _off(face: Face, shape: Shape, x: np.ndarray, y: np.ndarray, *, inside: np.ndarray) -> Off:
    """Error in the middles of the cells, which are those of their diagonals."""
    whole = inside[:-1, :-1] & inside[1:, 1:] & inside[:-1, 1:] & inside[1:, :-1]
    middle = face.on_grid((x[:-1] + x[1:]) / 2, (y[:-1] + y[1:]) / 2)
    normals = shape.normals
    between = normals[:-1, :-1] + normals[1:, 1:]
    between /= np.linalg.norm(between, axis=-1, keepdims=True)
    heights = (shape.z[:-1, :-1] + shape.z[1:, 1:]) / 2
    wanted = Shape(*(getattr(middle, name)[whole] for name in ("x", "y", "z", "z_x", "z_y")))
    return Off.between(heights[whole], between[whole], wanted)
