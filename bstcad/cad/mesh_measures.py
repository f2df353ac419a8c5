"""What a mesh is worth: is it closed, what does it enclose, how far is it from the lens?

Nothing here depends on how the mesh came about: any closed one may be asked, in mm.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from bstcad.cad import mesh_kernels
from bstcad.cad.mesh_kernels import FaceNumbers
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle
from bstcad.optics.surfaces import EQUATOR, Surface

if TYPE_CHECKING:
    from bstcad.cad.mesh import Mesh

UPRIGHT = 1e-6  # of a normal's length; a facet whose normal has no more of it along z is one of the wall
LOOKS = 100_000_000  # places at most at which the facets of a mesh are looked at
SHARES = 16  # of the triangles, in order: sums do not depend on the number of threads


def is_closed(mesh: Mesh) -> bool:
    """Watertight and wound consistently: each edge is walked by two triangles, once in each direction."""
    return len(mesh.faces) > 0 and mesh_kernels.edges_in_pairs(mesh.faces, len(mesh.vertices))


def volume_and_area(mesh: Mesh) -> tuple[float, float]:
    """Volume (mm³) inside a closed mesh, a sixth of the triple products of its triangles' corners; its area (mm²)."""
    middle = mesh.vertices.mean(0)
    parts = _shared(mesh_kernels.enclosed, len(mesh.faces), mesh.vertices, mesh.faces, middle)
    volumes, areas = zip(*parts, strict=True)
    return math.fsum(volumes) / 6, math.fsum(areas) / 2


def chordal_error(mesh: Mesh, lens: Lens) -> float:
    """Largest distance (mm) between the lens and the facets, at their centres and at places between their corners.

    On a net two a knot span or more (of at most LOOKS in all): it may bend in each.
    """
    vertices, faces = mesh.vertices, mesh.faces
    longest = np.max(_shared(mesh_kernels.reach, len(faces), vertices, faces), axis=0)
    looks = [_within(_spans(reach, face.detail, len(faces))) for reach, face in zip(longest, _faces(lens), strict=True)]
    seen = [value for look, face in zip(looks, _faces(lens), strict=True) for value in (look, *_numbers(face))]
    worst = _shared(mesh_kernels.off_faces, len(faces), vertices, faces, UPRIGHT, *seen)
    if isinstance(lens.outline, Circle):
        radius = float(lens.outline.radius)
        worst += _shared(mesh_kernels.off_wall, len(faces), vertices, faces, UPRIGHT, _within(1), radius)
    return float(max(worst))


def vertex_error(mesh: Mesh, lens: Lens) -> float:
    """Largest distance along z (mm) of a vertex from the nearer face of the lens."""
    numbers = [value for face in _faces(lens) for value in _numbers(face)]
    return float(max(_shared(mesh_kernels.vertices_off, len(mesh.vertices), mesh.vertices, *numbers)))


def _faces(lens: Lens) -> tuple[Surface, Surface]:
    return lens.back, lens.front


def _shared(kernel: Callable[..., Any], count: int, *arguments: Any) -> list[Any]:
    """What a kernel makes of each share of `count` things, which threads take in turn."""
    ends = [count * k // SHARES for k in range(SHARES + 1)]
    with ThreadPoolExecutor(torch.get_num_threads()) as threads:
        return list(threads.map(lambda first, last: kernel(first, last, *arguments), ends, ends[1:]))


def _numbers(surface: Surface) -> tuple[FaceNumbers, np.ndarray]:
    """A face as the kernels take it, and its net, (0, 0) where it has none."""
    face = surface.plain()
    if face.curvature is not None:
        c = float(face.curvature)
        bend = (1 + float(face.conic_constant)) * c * c
        return FaceNumbers(float(face.z), c, bend, EQUATOR, 0.0, 0.0, 0.0, 0.0), np.zeros((0, 0))
    corner, per_mm = (float(face.x[0]), float(face.y[0])), (1 / pitch for pitch in face.pitch)
    return FaceNumbers(float(face.z), 0.0, 0.0, EQUATOR, *corner, *per_mm), face.heights.contiguous().numpy()


def _within(parts: int) -> np.ndarray:
    """(n, 3) shares of the corners in a triangle's centre and in all that divides its edges into 2 x parts."""
    count = 2 * parts
    i, j = (p.ravel() for p in np.mgrid[: count + 1, : count + 1])
    shares = np.stack([i, j, count - i - j], axis=1)
    inside = (shares >= 0).all(1) & (shares < count).all(1)
    return np.vstack([np.full(3, 1 / 3), shares[inside] / count])


def _spans(longest: float, detail: float, count: int) -> int:
    """How many pieces of `detail` (mm) the longest facet of a face reaches over.

    Fewer for so many facets that LOOKS are spent.
    """
    return max(1, min(math.ceil(max(1.0, longest / detail)), int((LOOKS / 2 / max(count, 1)) ** 0.5)))
