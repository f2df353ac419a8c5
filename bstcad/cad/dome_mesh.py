"""Nodes and chordal error of the mesh of a dome, whose faces are no functions of x and y; lengths in mm.

The nodes of the dome lie on a grid in its chart, those of its inner face on a grid in the projection (u, v) of a conic
from its far vertex (patches.conic_net), so that both are even up to the rim.  The distance of a point from the dome is
that from its foot on the dome (dome_distance.py).
"""

from __future__ import annotations

import math

import numpy as np
import torch

from bstcad.cad.grids import cell_corners, inward_diagonals, nodes, on_diagonals, rim, triangles_over, wall_triangles
from bstcad.optics.kernels import dome_distance
from bstcad.optics.lens import domes
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.surfaces import Surface

PROJECTION_STEPS = 3  # Newton steps of a projection onto the rim, from a point near it
BASE_TOLERANCE = 1e-5  # largest |z - base| (mm) of the corners of a facet on the base plane, rounded to float32
FACETS_AT_A_TIME = 1 << 16  # number of facets compared with the faces at a time

Faces = tuple[np.ndarray, np.ndarray]  # vertices (n, 3) in mm, and indices of the vertices of each triangle, (k, 3)


def dome_grid(lens: Lens, cells: int) -> Faces:
    """Return the closed mesh of a dome on its base (domes.on_base), of `cells` grid cells per side."""
    dome, outline = domes.radial_back(lens), Circle(domes.rim_radius(lens.outline))
    x, y = nodes(outline, cells)
    grid = np.arange(x.size, dtype=np.int32).reshape(x.shape)
    top, border = domes.points_on(dome, x, y), rim(grid)
    below = top.reshape(-1, 3)[border].copy()
    below[:, 2] = lens.front.around.z
    low = grid.size + np.arange(len(border), dtype=np.int32)  # lower edge of the wall
    parts = [top.reshape(-1, 3), below]
    triangles = [triangles_over(grid, _diagonals(dome, x, y, top)), wall_triangles(low, border)]
    if lens.front.outline is None:  # a fan covers a plane front
        centre = np.full_like(low, low[-1] + 1)
        parts.append(np.array([[0.0, 0.0, lens.front.z]]))
        triangles.append(np.stack([centre, np.roll(low, -1), low], axis=1))
    else:
        inner = (low[-1] + 1 + np.arange(x.size, dtype=np.int32)).reshape(x.shape)
        parts.append(_inner_nodes(lens.front, cells))
        triangles += [triangles_over(inner, inward_diagonals(cells))[:, ::-1], wall_triangles(rim(inner), low)]
    return np.concatenate(parts), np.concatenate(triangles, dtype=np.int32, casting="same_kind")


def _inner_nodes(front: Surface, cells: int) -> np.ndarray:
    """Return points (n, 3) of a conic inside its outline: x = u / w, y = v / w, w = 1 + K (u² + v²) / 4."""
    assert front.outline is not None  # a Recess
    (c, k), radius = front.conic(), float(front.outline.radius)
    bend = (1 + k) * c * c
    u, v = nodes(Circle(2 * radius / (1 + math.sqrt(1 - bend * radius * radius))), cells)
    square = u * u + v * v
    w = 1 + bend / 4 * square
    points = np.stack([u / w, v / w, front.z + c / 2 * square / w], axis=-1)
    points[[0, -1], :, 2] = points[:, [0, -1], 2] = front.around.z
    return points.reshape(-1, 3)


def _diagonals(dome: RadialSurface, x: np.ndarray, y: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Choose the diagonal of each cell that is nearer to the dome, as mesh.lens_mesh does for heights."""
    (a, b, c, d), (e, f, g, h), (p, q, r, s) = map(cell_corners, (x, y, points))
    along, across = (
        np.linalg.norm(domes.points_on(dome, (x0 + x1) / 2, (y0 + y1) / 2) - (p0 + p1) / 2, axis=-1)
        for x0, x1, y0, y1, p0, p1 in ((a, c, e, g, p, r), (b, d, f, h, q, s))
    )
    return np.where(on_diagonals(len(a)), inward_diagonals(len(a)), along <= across)


def chordal_error(vertices: np.ndarray, faces: np.ndarray, lens: Lens, enough: float) -> float:
    """Return the largest distance (mm) between a dome on its base and facets of its mesh, at points of the facets.

    enough: error (mm) at which the search ends; the result is then a lower bound.
    """
    dome, error = domes.radial_back(lens), 0.0
    for start in range(0, len(faces), FACETS_AT_A_TIME):
        corners = vertices[faces[start : start + FACETS_AT_A_TIME]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        over_base = np.abs(corners[..., 2] - lens.front.around.z)
        flat = over_base.max(axis=1) <= BASE_TOLERANCE
        # a facet of the wall stands on the base; one of a steep dome may be upright, too
        upright = np.abs(normals[:, 2]) <= 1e-6 * np.linalg.norm(normals, axis=1)
        wall = upright & (over_base.min(axis=1) <= BASE_TOLERANCE)
        outer = (normals * (corners.mean(axis=1) - (0.0, 0.0, dome.z))).sum(axis=1) > 0
        middles = (corners[wall] + np.roll(corners[wall], -1, axis=1)) / 2
        parts = [_from_rim(lens, dome, middles.reshape(-1, 3))]
        if lens.front.outline is not None:
            parts.append(distance_from_conic(lens.front, _samples(corners[~outer & ~wall & ~flat])))
        on_dome = dome_distance.distance_of_facets(dome, corners[outer & ~wall & ~flat] - (0.0, 0.0, dome.z))
        error = max(error, on_dome, *(float(part.max(initial=0.0)) for part in parts))
        if error >= enough:
            break
    return error


def vertex_error(vertices: np.ndarray, lens: Lens) -> float:
    """Return the largest distance (mm) of a vertex from the nearest of dome, inner face and base plane."""
    distance = np.minimum(
        distance_from_dome(domes.radial_back(lens), vertices), np.abs(vertices[:, 2] - lens.front.around.z)
    )
    if lens.front.outline is not None:
        distance = np.minimum(distance, distance_from_conic(lens.front, vertices))
    return float(distance.max())


def _samples(corners: np.ndarray) -> np.ndarray:
    """Return the centres of facets (n, 3, 3) and the middles of their edges, (4 n, 3)."""
    middles = (corners + np.roll(corners, -1, axis=1)) / 2
    return np.concatenate([corners.mean(axis=1), middles.reshape(-1, 3)])


def distance_from_conic(face: Surface, points: np.ndarray) -> np.ndarray:
    """Return |F| / |∇F| (mm), the distance of near points from F = c r² - 2 h + (1 + k) c h² = 0, h = z - z0."""
    (c, k), (x, y, z) = face.conic(), points.T
    h = z - face.z
    value = c * (x * x + y * y) - 2 * h + (1 + k) * c * h * h
    return np.abs(value) / (2 * np.sqrt((c * x) ** 2 + (c * y) ** 2 + (1 - (1 + k) * c * h) ** 2))


def distance_from_dome(dome: RadialSurface, points: np.ndarray) -> np.ndarray:
    """Return the distance (mm) of points (n, 3) near a dome from it."""
    return np.abs(dome_distance.heights(dome, points - (0.0, 0.0, dome.z))[0])


def normals_on(dome: RadialSurface, points: np.ndarray) -> np.ndarray:
    """Return the unit normals (n, 3), outwards, of a dome at points (n, 3) (mm) near it."""
    return dome_distance.heights(dome, points - (0.0, 0.0, dome.z))[1]


def _from_rim(lens: Lens, dome: RadialSurface, points: np.ndarray) -> np.ndarray:
    """Return the distance (mm) of points (n, 3) near the wall from it, across z."""
    radius = domes.rim_radius(lens.outline)
    angle = np.arctan2(points[:, 1], points[:, 0])
    for _ in range(PROJECTION_STEPS):
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        patch = dome.at(torch.from_numpy(x), torch.from_numpy(y))
        place, along_x, along_y = (part[:2].numpy().T for part in patch)
        along, off = along_y * x[:, None] - along_x * y[:, None], points[:, :2] - place
        angle = angle + (off * along).sum(1) / (along * along).sum(1)
    return np.abs(off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0]) / np.linalg.norm(along, axis=1)
