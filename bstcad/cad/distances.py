"""Distance of points and of a mesh's facets from the faces of a lens; lengths in mm.

A lens of heights z(x, y) is compared with facets along z, by a kernel for millions of triangles.  The distance from a
radial surface is that from the foot of a point on it (dome_distance.py).  The facets of such a lens belong to the back,
to the base plane, to the wall between them, or to the inner face (base.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from numba import njit

from bstcad.optics.kernels import dome_distance
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import is_net
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.radial import circle_radius, require_radial
from bstcad.optics.surfaces.surfaces import MIN_COS2, Surface, sampled
from bstcad.runs.kernel_cache import compiled_kernel

WALL_NORMAL_Z = 1e-6  # largest |z| component of the unit normal of a facet of the wall
MAX_FACET_SAMPLES = 100_000_000  # largest number of points at which the facets of a mesh are compared with the lens
PARTS = 16  # number of parts into which the facets of a lens of heights are divided, for threads
FACETS_AT_A_TIME = 1 << 16  # number of facets of another lens that are compared with its faces at a time
PROJECTION_STEPS = 3  # Newton steps of a projection onto the rim, from a point near it
BASE_TOLERANCE = 1e-5  # largest |z - base| (mm) of the corners of a facet on the base plane, rounded to float32


def normals_near(face: Surface, points: np.ndarray) -> np.ndarray:
    """Return the unit normals (n, 3), along +z or outward, of a face at its points nearest to points (n, 3) (mm)."""
    if not face.chart.flat:
        return _feet(face, points)[1]
    _, z_x, z_y = sampled(face, points[:, 0], points[:, 1])
    normals = np.stack([-z_x, -z_y, np.ones_like(z_x)], axis=1)
    return normals / np.linalg.norm(normals, axis=1)[:, None]


def distances_of_points(points: np.ndarray, lens: Lens) -> np.ndarray:
    """Return the distances (n,) (mm) of points (n, 3) near a lens on its base from the nearer of its two faces.

    From a face of heights it is that from the tangent plane, |Δz| / sqrt(1 + |∇z|²): a distance along z would contain
    the rounding of x and y, multiplied by |∇z|.
    """
    return np.minimum(_from_face(lens.back, points), _from_face(lens.front, points))


def _from_face(face: Surface, points: np.ndarray) -> np.ndarray:
    if not face.chart.flat:
        return np.abs(_feet(face, points)[0])
    height, p, q = sampled(face, points[:, 0], points[:, 1])
    return np.abs(height - points[:, 2]) / np.sqrt(1 + p**2 + q**2)


def _feet(face: Surface, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the heights (n,) (mm) of points (n, 3) over a radial surface, and unit normals (n, 3) at their feet."""
    return dome_distance.heights(require_radial(face), points - (0.0, 0.0, face.z))


def distances_of_facets(vertices: np.ndarray, faces: np.ndarray, lens: Lens) -> Iterator[float]:
    """Yield the largest distance (mm) of each part of a mesh from a lens on its base, at points of the facets.

    vertices: (n, 3), mm; faces: indices of the vertices of each facet, (k, 3).  Since a net may bend in each knot span,
    facets are sampled twice per span (at most MAX_FACET_SAMPLES points in all).
    """
    if not lens.back.chart.flat:
        for start in range(0, len(faces), FACETS_AT_A_TIME):
            yield _from_base_and_back(vertices[faces[start : start + FACETS_AT_A_TIME]], lens)
        return
    max_parts = max(1, int((MAX_FACET_SAMPLES / 2 / max(len(faces), 1)) ** 0.5))
    radius = float(lens.outline.radius) if isinstance(lens.outline, Circle) else 0.0
    back, front = _face_numbers(lens.back), _face_numbers(lens.front)

    def largest(part: np.ndarray) -> float:
        return _chordal_error(vertices, part, max_parts, radius, back, front)

    with ThreadPoolExecutor(torch.get_num_threads()) as threads:
        yield from threads.map(largest, np.array_split(faces, PARTS))


def _from_base_and_back(corners: np.ndarray, lens: Lens) -> float:
    """Return the largest distance (mm) of facets (n, 3, 3) from a lens on its base."""
    back, middle = require_radial(lens.back), (0.0, 0.0, lens.back.z)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    over_base = np.abs(corners[..., 2] - lens.front.around.z)
    flat = over_base.max(axis=1) <= BASE_TOLERANCE
    # a facet of the wall stands on the base; one of a steep back may be upright, too
    upright = np.abs(normals[:, 2]) <= WALL_NORMAL_Z * np.linalg.norm(normals, axis=1)
    wall = upright & (over_base.min(axis=1) <= BASE_TOLERANCE)
    outer = (normals * (corners.mean(axis=1) - middle)).sum(axis=1) > 0
    edges = (corners[wall] + np.roll(corners[wall], -1, axis=1)) / 2
    parts = [_from_wall(lens, edges.reshape(-1, 3))]
    if lens.front.outline is not None:
        parts.append(_from_conic(lens.front, _samples(corners[~outer & ~wall & ~flat])))
    on_back = dome_distance.distance_of_facets(back, corners[outer & ~wall & ~flat] - middle)
    return max(on_back, *(float(part.max(initial=0.0)) for part in parts))


def _samples(corners: np.ndarray) -> np.ndarray:
    """Return the centres of facets (n, 3, 3) and the middles of their edges, (4 n, 3)."""
    middles = (corners + np.roll(corners, -1, axis=1)) / 2
    return np.concatenate([corners.mean(axis=1), middles.reshape(-1, 3)])


def _from_conic(face: Surface, points: np.ndarray) -> np.ndarray:
    """Return |F| / |∇F| (mm), the distance of near points from F = c r² - 2 h + (1 + k) c h² = 0, h = z - z0."""
    (c, k), (x, y, z) = face.conic(), points.T
    h = z - face.z
    value = c * (x * x + y * y) - 2 * h + (1 + k) * c * h * h
    return np.abs(value) / (2 * np.sqrt((c * x) ** 2 + (c * y) ** 2 + (1 - (1 + k) * c * h) ** 2))


def _from_wall(lens: Lens, points: np.ndarray) -> np.ndarray:
    """Return the distance (mm) of points (n, 3) near the wall below the back's rim from it, across z."""
    radius = circle_radius(lens.outline)
    angle = np.arctan2(points[:, 1], points[:, 0])
    for _ in range(PROJECTION_STEPS):
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        patch = lens.back.at(torch.from_numpy(x), torch.from_numpy(y))
        place, along_x, along_y = (part[:2].numpy().T for part in patch)
        along, off = along_y * x[:, None] - along_x * y[:, None], points[:, :2] - place
        angle = angle + (off * along).sum(1) / (along * along).sum(1)
    return np.abs(off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0]) / np.linalg.norm(along, axis=1)


# ---- compiled kernels of a lens of heights ---------------------------------------------------------------------------


class FaceNumbers(NamedTuple):
    """A face as plain numbers: z = z0 + Σ B_i(u) B_j(v) h_ij over a net, or a surface of revolution."""

    z: float  # z0 (mm)
    curvature: float  # curvature c at the vertex (1/mm)
    bend: float  # (1 + k) c² (1/mm²), k the conic constant
    equator: float  # smallest 1 - (1 + k) c² r²: surfaces.MIN_COS2
    ends2: float  # r² (mm²) of Surface.outline, outside of which the face is a plane; infinite: no outline
    per_detail: float  # smooth parts per mm: 1 / Surface.detail
    net: np.ndarray  # heights h of the control points, (m, n), mm; (0, 0): a surface of revolution
    x: float  # x of the net's first corner (mm)
    y: float  # y of the net's first corner (mm)
    per_x: float  # control points per mm along x
    per_y: float  # control points per mm along y


def _face_numbers(surface: Surface) -> FaceNumbers:
    face = surface.plain()
    per_detail = 1 / float(face.detail)
    if not is_net(face):
        (c, k), no_net = face.conic(), (np.zeros((0, 0)), 0.0, 0.0, 0.0, 0.0)
        ends2 = face.outline.radius**2 if face.outline else math.inf
        return FaceNumbers(float(face.z), c, (1 + k) * c * c, MIN_COS2, ends2, per_detail, *no_net)
    net = (face.heights.contiguous().numpy(), float(face.x[0]), float(face.y[0]), 1 / face.pitch[0], 1 / face.pitch[1])
    return FaceNumbers(float(face.z), 0.0, 0.0, MIN_COS2, math.inf, per_detail, *net)


@njit(inline="always")
def _normal(a, b, c):
    """Return (b - a) x (c - a)."""
    p, q, r, s, t, u = b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return q * u - r * t, r * s - p * u, p * t - q * s


@njit(inline="always")
def _basis(u, m):
    """Return (k, B_k, B_{k+1}, B_{k+2}) at u (pitches), m control points: bspline.basis, copied for numba's cache."""
    if u < 1.5:
        k, s = 0, 2.0 - math.sqrt(4.0 - 2.0 * u)
    elif u > m - 2.5:
        k, s = m - 3, math.sqrt(4.0 - 2.0 * (m - 1 - u)) - 1.0
    else:
        k = min(int(u - 0.5), m - 3)
        s = u - 0.5 - k
    low = (1.0 if k == 0 else 0.5) * (1.0 - s) * (1.0 - s)
    high = (1.0 if k == m - 3 else 0.5) * s * s
    return k, low, 1.0 - low - high, high


@njit(inline="always")
def _sag(face, x, y):
    net = face.net
    m, n = net.shape
    if m == 0:
        r2 = min(x * x + y * y, face.ends2)
        return face.z + face.curvature * r2 / (1.0 + math.sqrt(max(1.0 - face.bend * r2, face.equator)))
    i, a0, a1, a2 = _basis(min(max((x - face.x) * face.per_x, 0.0), m - 1.0), m)
    j, b0, b1, b2 = _basis(min(max((y - face.y) * face.per_y, 0.0), n - 1.0), n)
    h0 = b0 * net[i, j] + b1 * net[i, j + 1] + b2 * net[i, j + 2]
    h1 = b0 * net[i + 1, j] + b1 * net[i + 1, j + 1] + b2 * net[i + 1, j + 2]
    h2 = b0 * net[i + 2, j] + b1 * net[i + 2, j + 1] + b2 * net[i + 2, j + 2]
    return face.z + (a0 * h0 + a1 * h1 + a2 * h2)


@compiled_kernel()
def _distance_from_face(a, b, c, parts, face):
    """Return the largest distance along z (mm) of a face from the triangle a b c, with 2 * parts steps per edge."""
    n = 2 * parts
    worst = abs(_sag(face, (a[0] + b[0] + c[0]) / 3, (a[1] + b[1] + c[1]) / 3) - (a[2] + b[2] + c[2]) / 3)
    for i in range(n):
        for j in range(n + 1 - i):
            p, q, r = i / n, j / n, (n - i - j) / n
            if max(p, q, r) < 1.0:
                x, y = p * a[0] + q * b[0] + r * c[0], p * a[1] + q * b[1] + r * c[1]
                worst = max(worst, abs(_sag(face, x, y) - (p * a[2] + q * b[2] + r * c[2])))
    return worst


@compiled_kernel()
def _chordal_error(vertices, faces, max_parts, radius, back, front):
    """Return the largest distance (mm) of the lens from triangles, along the triangles' normals.

    A triangle whose unit normal has |z| <= WALL_NORMAL_Z belongs to the wall: a cylinder of the given radius, or planes
    (radius 0).  Edges and interior of a triangle on a face are sampled in two steps per `Surface.detail`, with at most
    2 * max_parts steps per edge.  On a round wall only the middles of the edges are sampled.
    """
    worst = 0.0
    for k in range(len(faces)):
        a, b, c = vertices[faces[k, 0]], vertices[faces[k, 1]], vertices[faces[k, 2]]
        n_x, n_y, n_z = _normal(a, b, c)
        length = math.sqrt(n_x**2 + n_y**2 + n_z**2)
        if abs(n_z) > WALL_NORMAL_Z * length:
            p, q, s, t = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
            extent = max(abs(p), abs(q), abs(s), abs(t), abs(p - s), abs(q - t))
            face = back if n_z > 0.0 else front
            parts = min(max_parts, max(1, math.ceil(extent * face.per_detail)))
            worst = max(worst, _distance_from_face(a, b, c, parts, face) * abs(n_z) / length)
        elif radius > 0.0:
            for x, y in ((a[0] + b[0], a[1] + b[1]), (b[0] + c[0], b[1] + c[1]), (c[0] + a[0], c[1] + a[1])):
                worst = max(worst, abs(radius - math.hypot(x, y) / 2))
    return worst
