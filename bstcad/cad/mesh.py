"""Closed triangle mesh of a lens on a structured grid, measures of any closed mesh, and mesh files; lengths in mm.

Every vertex lies on the lens, and the wall joins the rim nodes of both faces, so that the mesh is closed.
The chordal error falls with the square of the node spacing; the grid is refined until the error meets the tolerance.

Files: STL, which states no unit (its user must set mm), 3MF, which states millimetres, and previews for web pages and
slicers.  CPU seconds for two million triangles, with those of this module in parentheses: trimesh writes STL in 2
(0.1), reads it in 8 (0.2) and tests in 2 (0.1) whether the mesh is closed; lib3mf writes 3MF in 2.3 (1.2).
"""

from __future__ import annotations

import io
import math
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numba import njit

from bstcad.cad.distances import WALL_NORMAL_Z, distances_of_facets, distances_of_points, normals_near
from bstcad.cad.grids import (
    cell_corners,
    inward_diagonals,
    nodes,
    on_diagonals,
    rim,
    triangles_over,
    wall_triangles,
)
from bstcad.optics.lens.base import on_base
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle, Outline
from bstcad.optics.surfaces.surfaces import Recess, Surface, points_on
from bstcad.runs import files
from bstcad.runs.kernel_cache import compiled_kernel
from bstcad.scene.scene import FLOAT32_ROUNDING

MIN_MESH_CELLS = 16  # number of grid cells per side of the first mesh that `fit_mesh` tries
DEFAULT_MAX_TRIANGLES = 2_000_000  # largest number of triangles by default: 100 MB of STL
MAX_TRIANGLES = 32_000_000  # largest number of triangles if a scene states a tolerance: 1.6 GB of STL
GOAL_FRACTION = 0.95  # largest goal of the chordal error, relative to the tolerance: float32 rounding needs a margin
STEP_MARGIN = 1.01  # ratio of tried to estimated cells per side, so that the next mesh meets the goal
CELL_MARGIN = 1.1  # ratio of estimated to allowed cells per side above which no finer mesh is tried; estimates err
FACETS_PER_BLOCK = 1 << 15  # number of facets processed at a time, so that their corners stay in the cache


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh, wound counterclockwise seen from outside."""

    vertices: np.ndarray  # positions of the vertices, (n, 3), float64, mm
    faces: np.ndarray  # indices of the vertices of each triangle, (k, 3), int32

    def facets(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield corners (n, 3, 3) and normals (n, 3; length: twice the area) of facets, FACETS_PER_BLOCK at a time."""
        for first in range(0, len(self.faces), FACETS_PER_BLOCK):
            yield _corners_and_normals(self.vertices, self.faces[first : first + FACETS_PER_BLOCK])


def lens_mesh(lens: Lens, cells: int) -> Mesh:
    """Return the lens as a closed mesh of `cells` grid cells per side, an even number, which `fit_mesh` can choose."""
    if cells < 2 or cells % 2:
        raise ValueError(f"mesh: the number of cells per side is {cells}; give an even number of at least 2")
    lens = on_base(lens)
    x, y = nodes(lens.outline, cells)
    grid = np.arange(x.size, dtype=np.int32).reshape(x.shape)
    border, points = rim(grid), points_on(lens.back, x, y)
    back = points.reshape(-1, 3)
    if isinstance(lens.front, Recess):
        front, front_rim, front_faces = _recessed_front(lens.front, back[border], grid)
    elif _has_plane_front(lens):  # one fan of triangles covers a plane
        front = np.vstack([back[border], [0.0, 0.0, 0.0]])
        front[:, 2] = lens.front.z
        front_rim = x.size + np.arange(len(border))
        centre = np.full_like(front_rim, front_rim[-1] + 1)
        front_faces = np.stack([centre, np.roll(front_rim, -1), front_rim], axis=1)
    else:
        low = points_on(lens.front, x, y)
        front, front_rim = low.reshape(-1, 3), border + x.size
        front_faces = triangles_over(grid + x.size, _diagonals(lens.outline, lens.front, (x, y), low))[:, ::-1]
    back_faces = triangles_over(grid, _diagonals(lens.outline, lens.back, (x, y), points))
    triangles = [back_faces, front_faces, wall_triangles(front_rim, border)]
    return Mesh(np.concatenate([back, front]), np.concatenate(triangles, dtype=np.int32, casting="same_kind"))


def _recessed_front(front: Recess, around: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mesh of a front and of the plane around it: vertices, indices of the plane's outer rim, triangles.

    around: vertices (k, 3) of the back's rim, below which the outer rim lies.  grid: indices of the back's nodes, which
    the new indices continue.  The grid over the front also has k rim nodes; the plane's triangles join the two rims.
    """
    cells, border, plane = len(grid) - 1, rim(grid), around.copy()
    plane[:, 2] = front.around.z
    outer, inner = 2 * grid.size + np.arange(len(border)), border + grid.size
    triangles = triangles_over(grid + grid.size, inward_diagonals(cells))[:, ::-1]
    nodes_of_both = np.vstack([_inner_nodes(front, cells), plane])
    return nodes_of_both, outer, np.concatenate([triangles, wall_triangles(inner, outer)])


def _inner_nodes(front: Recess, cells: int) -> np.ndarray:
    """Return points (n, 3) of a conic inside its outline: x = u / w, y = v / w, w = 1 + K (u² + v²) / 4.

    (u, v) is the projection from the conic's far vertex (patches.conic_net), in which a grid is even up to a steep rim.
    """
    (c, k), radius = front.conic(), float(front.outline.radius)
    bend = (1 + k) * c * c
    u, v = nodes(Circle(2 * radius / (1 + math.sqrt(1 - bend * radius * radius))), cells)
    square = u * u + v * v
    w = 1 + bend / 4 * square
    points = np.stack([u / w, v / w, front.z + c / 2 * square / w], axis=-1)
    points[[0, -1], :, 2] = points[:, [0, -1], 2] = front.around.z
    return points.reshape(-1, 3)


def _diagonals(
    outline: Outline, surface: Surface, chart: tuple[np.ndarray, np.ndarray], points: np.ndarray
) -> np.ndarray:
    """Choose the diagonal of each cell that is nearer to the face: True (n, n) for the diagonal from the first corner.

    chart: x and y of the nodes in the surface's chart; points: their positions (n + 1, n + 1, 3).  A diagonal along a
    ridge has at most half the error of a diagonal across it, so that fewer triangles suffice.  On a disc, cells on the
    grid's diagonals are divided towards the centre, because their outer corners lie on a circle and the other diagonal
    would make degenerate triangles.
    """
    cells = len(points) - 1
    inwards = inward_diagonals(cells)
    if surface.level:
        return inwards
    (a, b, c, d), (e, f, g, h), (p, q, r, s) = map(cell_corners, (*chart, points))
    along, across = (
        np.linalg.norm(points_on(surface, (x0 + x1) / 2, (y0 + y1) / 2) - (p0 + p1) / 2, axis=-1)
        for x0, x1, y0, y1, p0, p1 in ((a, c, e, g, p, r), (b, d, f, h, q, s))
    )
    if not outline.is_round:
        return along <= across
    return np.where(on_diagonals(cells), inwards, along <= across)


def _has_plane_front(lens: Lens) -> bool:
    return lens.front.sags(lens.outline) == (0.0, 0.0)


# ---- how fine a mesh has to be ---------------------------------------------------------------------------------------


def fit_mesh(lens: Lens, tolerance: float, max_triangles: int | None = None) -> tuple[int, Mesh]:
    """Return nearly the smallest number of cells per side that meets a chordal tolerance (mm), and the mesh.

    If `max_triangles` (None: DEFAULT_MAX_TRIANGLES) do not suffice, the mesh is the finest with at most that many
    triangles, or at most DEFAULT_MAX_TRIANGLES if this is fewer.
    """
    lens = on_base(lens)
    allowed = DEFAULT_MAX_TRIANGLES if max_triangles is None else max_triangles
    cells, last, goal = MIN_MESH_CELLS, max_cells(lens, allowed), chordal_error_goal(lens, tolerance)
    limit = CELL_MARGIN * last if allowed > DEFAULT_MAX_TRIANGLES else last
    while cells < last or (cells == last and allowed > DEFAULT_MAX_TRIANGLES):
        mesh = lens_mesh(lens, cells)
        at_limit = goal * (limit / (STEP_MARGIN * cells)) ** 2  # error for which `limit` cells are needed
        error = chordal_error(mesh, lens, enough=max(at_limit, math.nextafter(goal, math.inf)))
        if error <= goal:
            return cells, mesh
        # the error falls with the square of the spacing, but more slowly while cells are larger than the relief
        needed = 2 * math.ceil(STEP_MARGIN / 2 * cells * (error / goal) ** 0.5)
        if cells == last or (allowed > DEFAULT_MAX_TRIANGLES and needed >= limit):
            break
        cells = min(last, needed)
    last = max_cells(lens, min(allowed, DEFAULT_MAX_TRIANGLES))
    return last, lens_mesh(lens, last)


def chordal_error_goal(lens: Lens, tolerance: float) -> float:
    """Return the chordal error (mm), at least 0.1 tolerance, that meets it after the corners are rounded to float32."""
    rounding = 2 * FLOAT32_ROUNDING * largest_coordinate(lens)
    return max(0.1 * tolerance, min(GOAL_FRACTION * tolerance, tolerance - rounding))


def largest_coordinate(lens: Lens) -> float:
    """Return an upper bound (mm) of the absolute coordinates of the lens's points."""
    faces = ((lens.front, lens.plan), (lens.back, lens.outline))
    ends = [abs(face.z + height) for face, outline in faces for height in face.sags(outline)]
    return max(*lens.plan.half_extent, *ends)


def max_cells(lens: Lens, max_triangles: int | None = None) -> int:
    """Return the largest number of cells per side for at most `max_triangles` (None: DEFAULT_MAX_TRIANGLES)."""
    lens = on_base(lens)
    faces, total = 2 if _has_plane_front(lens) else 4, DEFAULT_MAX_TRIANGLES if max_triangles is None else max_triangles
    # triangles per cell along one side of the grid: 8 of the wall, and 4 of the fan over a plane front or 8 of the
    # plane around a front
    wall = 16 if lens.front.outline is not None else 12
    return int((math.sqrt(wall**2 + 4 * faces * total) - wall) / (2 * faces)) // 2 * 2


# ---- measures of any mesh --------------------------------------------------------------------------------------------


def is_closed(mesh: Mesh) -> bool:
    """True if each edge belongs to two triangles, once in each direction: watertight and wound consistently."""
    ends, others = mesh.faces.astype(np.int64), np.roll(mesh.faces, -1, axis=1).astype(np.int64)
    # An edge's number: even in the direction from the vertex of smaller index to the other one, and odd in the reverse.
    edges = 2 * (np.minimum(ends, others) * len(mesh.vertices) + np.maximum(ends, others)) + (ends > others)
    edges = np.sort(edges.ravel())
    smaller, larger = edges[::2], edges[1::2]
    if len(edges) == 0 or len(edges) % 2:
        return False
    return bool((smaller % 2 == 0).all() and (larger == smaller + 1).all() and (smaller[1:] > larger[:-1]).all())


def volume_and_area(mesh: Mesh) -> tuple[float, float]:
    """Return the volume (mm³; the sum of the corners' triple products / 6) and area (mm²) of a closed mesh."""
    middle = mesh.vertices.mean(0)
    parts = [
        (np.einsum("ij,ij", corners[:, 0] - middle, normals), np.linalg.norm(normals, axis=1).sum())
        for corners, normals in mesh.facets()
    ]
    volumes, areas = zip(*parts, strict=True)
    return math.fsum(volumes) / 6, math.fsum(areas) / 2


def chordal_error(mesh: Mesh, lens: Lens, enough: float = math.inf) -> float:
    """Return the largest distance (mm) between the lens and the facets, at points other than the facets' corners.

    enough: error (mm) at which the search ends; the result is then a lower bound.
    """
    error = 0.0
    for part in distances_of_facets(mesh.vertices, mesh.faces, on_base(lens)):
        error = max(error, part)
        if error >= enough:
            break
    return error


def vertex_error(mesh: Mesh, lens: Lens) -> float:
    """Return the largest distance (mm) of a vertex from the nearest face."""
    return float(distances_of_points(mesh.vertices, on_base(lens)).max())


# ---- compiled kernels, for millions of triangles ---------------------------------------------------------------------


@njit(inline="always")
def _normal(a, b, c):
    """Return (b - a) x (c - a)."""
    p, q, r, s, t, u = b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return q * u - r * t, r * s - p * u, p * t - q * s


@compiled_kernel()
def _corners_and_normals(vertices, faces):
    """Return corners (n, 3, 3) of triangles and their normals (n, 3), of twice the triangle's area."""
    corners, normals = np.empty((len(faces), 3, 3)), np.empty((len(faces), 3))
    for k in range(len(faces)):
        for i in range(3):
            for axis in range(3):
                corners[k, i, axis] = vertices[faces[k, i], axis]
        normals[k, 0], normals[k, 1], normals[k, 2] = _normal(corners[k, 0], corners[k, 1], corners[k, 2])
    return corners, normals


# ---- files -----------------------------------------------------------------------------------------------------------

PREVIEW_TRIANGLES = 20_000  # largest number of triangles of a preview
METRES_PER_MM = 1e-3  # unit conversion for glTF, which is in metres
VERTEX_XML = b'<vertex x="%.10g" y="%.10g" z="%.10g"/>\n'
TRIANGLE_XML = b'<triangle v1="%d" v2="%d" v3="%d"/>\n'
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
MAX_PROBES = 4096  # largest number of occupied slots that a corner may meet in the hash table (a fifth or more is free)
STL_HEADER = b"bstcad, binary STL, lengths in mm"  # header, which must not start with "solid"
MODEL_3MF = "3D/3dmodel.model"  # name of the model in a 3MF package
MODEL_HEAD_BYTES = 4096  # number of bytes of the model that are searched for its unit of length
MAX_LINE_BYTES = 90  # upper bound of the length of a line of a 3MF model (bytes)
CLEAR_RGBA, MIRROR_RGBA = "#A9D3EE80", "#C9CED4FF"  # sRGB and opacity of clear material and of a mirror
ARCHIVE_TIME = (1980, 1, 1, 0, 0, 0)  # time of the files in a 3MF package, so that equal meshes give equal bytes


@dataclass(frozen=True)
class Label:
    """Name and appearance of a mesh in a file."""

    name: str = "lens"
    title: str = ""  # title of a 3MF file or glTF scene; "": 3MF states the name
    material: str = "glass"
    colour: str = CLEAR_RGBA  # #RRGGBBAA
    remark: str = ""  # description, a sentence; "" for none


DEFAULT_LABEL = Label()


def write_stl(mesh: Mesh, path: str | Path) -> None:
    """Write the mesh as binary STL: a header of 80 bytes, the number of triangles, 50 bytes per triangle (float32)."""
    with Path(path).open("wb") as file:
        file.write(STL_HEADER.ljust(80) + np.uint32(len(mesh.faces)).tobytes())
        for corners, normals in mesh.facets():
            triangles = np.zeros(len(corners), STL_TRIANGLE)
            triangles["corners"] = corners
            triangles["normal"] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
            file.write(triangles.data)


def read_stl(path: str | Path) -> Mesh:
    """Read a binary STL file and merge equal corners; ValueError if the file is damaged."""
    path = Path(path)
    try:
        data = files.contents(path, 84 + MAX_TRIANGLES * STL_TRIANGLE.itemsize)
    except ValueError as error:
        raise ValueError(f"{path.name}: cannot be read ({error}); give the path of an STL file") from error
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    if len(data) != 84 + STL_TRIANGLE.itemsize * count or not count:
        raise ValueError(
            f"{path.name}: is empty or not a complete binary STL: it states {max(count, 0)} triangles and has "
            f"{len(data)} bytes; write it again"
        )
    corners = np.array(np.frombuffer(data, STL_TRIANGLE, offset=84)["corners"]).reshape(-1, 3)
    if not np.isfinite(corners).all():
        raise ValueError(f"{path.name}: a corner of a triangle is not finite; write the file again")
    corners += np.float32(0)  # -0 becomes 0
    bits = corners.view(np.uint32)
    first, same = _weld(bits)
    if not len(same):  # sort instead: 2 s for two million triangles, the hash table 0.2 s
        _, first, same = np.unique(bits, axis=0, return_index=True, return_inverse=True)
    return Mesh(corners[first].astype(np.float64), same.reshape(-1, 3))


@compiled_kernel()
def _weld(bits):
    """Group equal corners, float32 as uint32 (n, 3), by hash; return each group's first corner and each corner's group.

    The two arrays are empty if a corner meets MAX_PROBES occupied slots, which no real surface causes.
    """
    size = 1 << 16
    while 4 * size < 5 * len(bits):
        size *= 2
    table, first, same = np.full(size, -1, np.int32), np.empty(len(bits), np.int32), np.empty(len(bits), np.int32)
    count = 0
    for k in range(len(bits)):
        x, y, z = bits[k, 0], bits[k, 1], bits[k, 2]
        key = np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)  # odd factors without structure
        key += np.uint64(y) * np.uint64(0xC2B2AE3D27D4EB4F) + np.uint64(z) * np.uint64(0xD6E8FEB86659FD93)
        slot = np.int64((key ^ (key >> np.uint64(32))) & np.uint64(size - 1))
        for probe in range(MAX_PROBES + 1):
            if probe == MAX_PROBES:
                return first[:0], same[:0]
            other = table[slot]
            if other < 0:
                table[slot] = first[count] = k
                same[k] = count
                count += 1
                break
            if bits[other, 0] == x and bits[other, 1] == y and bits[other, 2] == z:
                same[k] = same[other]
                break
            slot = (slot + 1) & (size - 1)
    return first[:count].copy(), same


# ---- 3MF -----------------------------------------------------------------------------------------------------------

PACKAGE_CONTENT_TYPES = """<?xml version="1.0" encoding="UTF-8"?>
<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">\
<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>\
<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>
"""
RELATIONSHIPS = """<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">\
<Relationship Target="/3D/3dmodel.model" Id="model" \
Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>
"""


def model_3mf(mesh: Mesh, label: Label = DEFAULT_LABEL) -> Iterator[bytes]:
    """Yield parts of the 3MF core model of the mesh, in millimetres: one object of one material and colour."""
    about = {"Title": label.title or label.name, "Description": label.remark, "Application": "bstcad"}
    metadata = "".join(f'<metadata name="{key}">{escape(text)}</metadata>\n' for key, text in about.items() if text)
    yield (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<model unit="millimeter" xml:lang="en-US" '
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">\n'
        f"{metadata}<resources>"
        f'<basematerials id="1"><base name={quoteattr(label.material)} displaycolor="{label.colour}"/>'
        "</basematerials>\n"
        f'<object id="2" type="model" name={quoteattr(label.name)} pid="1" pindex="0"><mesh><vertices>\n'
    ).encode()
    yield from _format_rows(VERTEX_XML, mesh.vertices)
    yield b"</vertices><triangles>\n"
    yield from _format_rows(TRIANGLE_XML, mesh.faces)
    yield b'</triangles></mesh></object></resources>\n<build><item objectid="2"/></build></model>\n'


def _format_rows(line: bytes, rows: np.ndarray) -> Iterator[bytes]:
    """Yield one line of text per row of numbers, FACETS_PER_BLOCK rows at a time."""
    for first in range(0, len(rows), FACETS_PER_BLOCK):
        part = rows[first : first + FACETS_PER_BLOCK]
        yield (line * len(part)) % tuple(part.ravel().tolist())


def write_3mf(mesh: Mesh, path: str | Path | IO[bytes], label: Label = DEFAULT_LABEL) -> None:
    """Write the mesh as 3MF in millimetres; equal meshes give equal bytes."""
    large = MAX_LINE_BYTES * (len(mesh.vertices) + len(mesh.faces)) > zipfile.ZIP64_LIMIT
    with zipfile.ZipFile(path, "w") as package:
        for name, text in (("[Content_Types].xml", PACKAGE_CONTENT_TYPES), ("_rels/.rels", RELATIONSHIPS)):
            package.writestr(_archive_member(name), text)
        with package.open(_archive_member(MODEL_3MF), "w", force_zip64=large) as model:
            for part in model_3mf(mesh, label):
                model.write(part)


def unit_of_3mf(path: Path) -> str:
    """Return the unit of length that a 3MF file states; ValueError if the file is damaged or states none."""
    try:
        if not path.is_file():
            raise ValueError("it is no regular file")
        with zipfile.ZipFile(path) as package, package.open(MODEL_3MF) as model:
            head = model.read(MODEL_HEAD_BYTES)
    except Exception as error:  # zipfile and zlib raise various errors for a damaged file
        raise ValueError(
            f"{path.name}: cannot be read ({files.first_line(error)}); generate the design again"
        ) from error
    stated = re.search(rb"<model\b[^>]*\sunit=[\"'](\w+)[\"']", head)
    if stated is None:
        raise ValueError(f"{path.name}: states no unit of length; generate the design again")
    return stated[1].decode()


def _archive_member(name: str) -> zipfile.ZipInfo:
    member = zipfile.ZipInfo(name, ARCHIVE_TIME)
    member.compress_type, member.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
    # level 1: a third of the time of level 6, for a file larger by a seventh; zipfile has no public name for it
    member._compresslevel = 1  # type: ignore[attr-defined]
    return member


# ---- previews ------------------------------------------------------------------------------------------------------


def preview_files(lens: Lens, label: Label) -> Iterator[tuple[str, bytes]]:
    """Yield names and bytes of preview.glb and preview.3mf, which have few triangles and state their chordal error.

    Web pages (glTF) and slicers (3MF) cannot show a million triangles.  The glTF states the normals of the exact
    surface, so that shading shows the whole relief.
    """
    mesh = lens_mesh(lens, max_cells(lens, PREVIEW_TRIANGLES))
    off = chordal_error(mesh, lens)
    label = replace(label, remark=f"A preview: its facets lie within {off:.2g} mm of the lens; lens.step is exact.")
    yield "preview.glb", _glb(mesh, lens, label, off)
    package = io.BytesIO()
    write_3mf(mesh, package, label)
    yield "preview.3mf", package.getvalue()


def _glb(mesh: Mesh, lens: Lens, label: Label, off: float) -> bytes:
    """Encode the mesh as binary glTF, in metres, y upwards; off: chordal error (mm), which the extras state.

    A vertex on an edge of the lens is repeated with the normal of each face and each facet of the wall that meet there.
    """
    lens = on_base(lens)
    import trimesh  # takes most of a second
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    across /= np.linalg.norm(across, axis=1)[:, None]
    wall = np.abs(across[:, 2]) <= WALL_NORMAL_Z
    if lens.front.outline is not None:  # the plane around the front's optical part meets that part in an edge
        wall |= across[:, 2] <= WALL_NORMAL_Z - 1
    vertices, normals = [mesh.vertices[mesh.faces[wall]].reshape(-1, 3)], [across[wall].repeat(3, axis=0)]
    faces, count = [np.arange(3 * wall.sum()).reshape(-1, 3)], 3 * wall.sum()
    for face, sense in ((lens.back, 1), (lens.front, -1)):
        used, renumbered = np.unique(mesh.faces[(sense * across[:, 2] > WALL_NORMAL_Z) & ~wall], return_inverse=True)
        vertices.append(mesh.vertices[used])
        normals.append(sense * normals_near(face.optical, vertices[-1]))
        faces.append(renumbered.reshape(-1, 3) + count)
        count += len(used)
    *colour, opacity = (int(label.colour[k : k + 2], 16) for k in (1, 3, 5, 7))  # red, green, blue
    factors = {"baseColorFactor": [*((part / 255) ** 2.2 for part in colour), opacity / 255]}  # linear
    surface = {"metallicFactor": 0.0, "alphaMode": "BLEND"} if opacity < 255 else {"metallicFactor": 1.0}
    material = PBRMaterial(name=label.material, roughnessFactor=0.1, **factors, **surface)
    solid = trimesh.Trimesh(
        METRES_PER_MM * _y_up(np.concatenate(vertices)),
        np.concatenate(faces),
        vertex_normals=_y_up(np.concatenate(normals)),
        visual=TextureVisuals(material=material),
        process=False,
        validate=False,
        metadata={"title": label.title, "remark": label.remark, "off_mm": off},
    )
    scene = trimesh.Scene()
    scene.add_geometry(solid, geom_name=label.name, node_name=label.name)
    return scene.export(file_type="glb", include_normals=True)


def _y_up(vectors: np.ndarray) -> np.ndarray:
    x, y, z = vectors.T
    return np.stack([x, z, -y], axis=1)
