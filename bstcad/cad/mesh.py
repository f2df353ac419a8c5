"""A closed triangle mesh of a lens on our own structured grid, for STL and 3MF.

Every vertex lies on the lens; the faces share the nodes of the rim, so the mesh is closed by construction.  The grid is
as fine as the tolerance asks for, as measured: the chordal error falls with the square of the node spacing.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh

from bstcad import files
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Outline
from bstcad.optics.surfaces import sag

COARSEST = 16  # cells each way
MOST = 2_000_000  # triangles of a mesh of ours: 100 MB of STL
LARGEST = 8 * MOST  # triangles of a mesh that is read
GOAL = 0.95  # of the tolerance, which float32 shall not take a vertex over
PART = 1 << 16  # triangles worked on at a time
UPRIGHT = 1e-6  # of a normal's length; a facet whose normal has no more of it along z is one of the wall
LOOKS = 100_000_000  # places at most at which the facets of a mesh are looked at


def lens_mesh(lens: Lens, cells: int) -> trimesh.Trimesh:
    """The lens as a closed mesh, wound counterclockwise from outside; mm.

    `cells` is the number of grid cells each way (even); see `cells_for`.
    """
    if cells < 2 or cells % 2:
        raise ValueError(f"mesh: {cells} cells each way; give an even number of at least 2")
    x, y = _nodes(lens.outline, cells)
    grid = np.arange(x.size).reshape(x.shape)
    rim = _rim(grid)
    back = np.stack([x, y, sag(lens.back, x, y)], axis=-1).reshape(-1, 3)
    if _flat(lens):  # one fan of triangles covers a plane
        front = np.vstack([back[rim], [0.0, 0.0, 0.0]])
        front[:, 2] = lens.front.z
        front_rim = x.size + np.arange(len(rim))
        front_faces = _fan(front_rim, front_rim[-1] + 1)
    else:
        front = np.stack([x, y, sag(lens.front, x, y)], axis=-1).reshape(-1, 3)
        front_rim, front_faces = rim + x.size, _triangles(grid + x.size)[:, ::-1]
    triangles = np.concatenate([_triangles(grid), front_faces, _wall(front_rim, rim)])
    return trimesh.Trimesh(np.concatenate([back, front]), triangles, process=False)


def _nodes(outline: Outline, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y (mm) of a square grid of nodes, (cells + 1, cells + 1), whose rim lies on the outline.

    On a disc, squares around the centre become circles (Shirley and Chiu 1997): with |a| >= |b| the node (a, b) goes to
    the radius a and the angle pi/4 b/a, else to the radius b and the angle pi/2 - pi/4 a/b.
    """
    unit = np.linspace(-1.0, 1.0, cells + 1)
    if not isinstance(outline, Circle):
        half_x, half_y = outline.half_extent
        x, y = np.meshgrid(half_x * unit, half_y * unit, indexing="ij")
        return x, y
    a, b = np.meshgrid(unit, unit, indexing="ij")
    wide = np.abs(a) >= np.abs(b)
    major, minor = np.where(wide, a, b), np.where(wide, b, a)
    turn = np.pi / 4 * minor / np.where(major == 0, 1.0, major)
    angle = np.where(wide, turn, np.pi / 2 - turn)
    return outline.radius * major * np.cos(angle), outline.radius * major * np.sin(angle)


def _triangles(grid: np.ndarray) -> np.ndarray:
    """Two triangles a cell (2 n², 3), counterclockwise, cut along the diagonal that points to the middle of the grid.

    The other diagonal would leave flat triangles in the four corners that a disc's rim rounds off.
    """
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    low = np.arange(len(a)) < len(a) / 2
    rising = (low[:, None] == low[None, :])[..., None]
    first = np.where(rising, np.stack([a, b, c], axis=-1), np.stack([a, b, d], axis=-1))
    second = np.where(rising, np.stack([a, c, d], axis=-1), np.stack([b, c, d], axis=-1))
    return np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)])


def _rim(grid: np.ndarray) -> np.ndarray:
    """The border nodes of the grid, once around, counterclockwise from its first corner."""
    return np.concatenate([grid[:-1, 0], grid[-1, :-1], grid[:0:-1, -1], grid[0, :0:-1]])


def _fan(rim: np.ndarray, centre: int) -> np.ndarray:
    """Triangles from the rim to one node inside it, facing -z."""
    return np.stack([np.full_like(rim, centre), np.roll(rim, -1), rim], axis=1)


def _wall(front: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Two triangles between each pair of neighbours on the front's and the back's rim, facing outwards."""
    front_next, back_next = np.roll(front, -1), np.roll(back, -1)
    return np.concatenate(
        [np.stack([front, front_next, back_next], axis=1), np.stack([front, back_next, back], axis=1)]
    )


def cells_for(lens: Lens, tolerance: float) -> int:
    """The fewest cells each way, or nearly, whose facets lie within `tolerance` (mm) of the lens; at most `finest`."""
    cells, most = COARSEST, finest(lens)
    while cells < most:
        error = chordal_error(lens_mesh(lens, cells), lens)
        if error <= GOAL * tolerance:
            return cells
        # it falls with the square of the spacing, and more slowly while a cell is larger than what it has to follow
        cells = min(most, 2 * math.ceil(0.505 * cells * (error / (GOAL * tolerance)) ** 0.5))
    return most


def finest(lens: Lens) -> int:
    """Cells each way of the finest grid of no more than MOST triangles, two a cell on a face that is not plane."""
    faces = 2 if _flat(lens) else 4
    wall = 12  # triangles a cell of the grid's side: four rows of two along the wall, four of a fan over a plane front
    return int((math.sqrt(wall**2 + 4 * faces * MOST) - wall) / (2 * faces)) // 2 * 2


def mesh_volume(lens: Lens, cells: int) -> float:
    """Volume (mm³) of the mesh of so many cells each way, without building it: prisms under each triangle."""
    x, y = _nodes(lens.outline, cells)
    height = sag(lens.back, x, y) - sag(lens.front, x, y)
    a, b, c = _triangles(np.arange(x.size).reshape(x.shape)).T
    x, y, height = x.ravel(), y.ravel(), height.ravel()
    area = (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])
    return float(area @ (height[a] + height[b] + height[c])) / 6


def is_closed(mesh: trimesh.Trimesh) -> bool:
    """Watertight and wound consistently: each edge is walked by two triangles, once in each direction."""
    faces, n = np.asarray(mesh.faces, np.int64), len(mesh.vertices)
    there = np.sort((faces * n + np.roll(faces, -1, axis=1)).ravel())
    back = np.sort((np.roll(faces, -1, axis=1) * n + faces).ravel())
    return len(there) > 0 and bool(np.array_equal(there, back) and (np.diff(there) > 0).all())


def volume(mesh: trimesh.Trimesh) -> float:
    """Volume (mm³) inside a closed mesh: a sixth of the sum of the triple products of its triangles' corners."""
    middle = mesh.vertices.mean(0)
    parts = (np.moveaxis(corners - middle, 1, 0) for corners, _ in _by_parts(mesh))
    return sum(float(np.einsum("ij,ij->", a, np.cross(b, c))) for a, b, c in parts) / 6


def chordal_error(mesh: trimesh.Trimesh, lens: Lens) -> float:
    """Largest distance (mm) between the lens and the facets, at their centres and at places between their corners.

    On a net two a knot span or more (of at most LOOKS in all): it may bend in each.
    """
    worst, back, front = 0.0, lens.back, lens.front
    within = {sense: _within(_spans(mesh, face.detail, sense)) for sense, face in ((1, back), (-1, front))}
    for corner, cross in _by_parts(mesh):
        normal_z = cross[:, 2] / np.maximum(np.linalg.norm(cross, axis=1), np.finfo(float).tiny)
        for sense, surface in ((1, back), (-1, front)):
            facing = sense * normal_z > UPRIGHT
            for share in within[sense]:
                x, y, z = _at(corner[facing], share)
                off = np.abs(sag(surface, x, y) - z) * np.abs(normal_z[facing])  # along the facet's normal
                worst = max(worst, off.max(initial=0.0))
        if isinstance(lens.outline, Circle):
            wall = corner[np.abs(normal_z) <= UPRIGHT]
            for share in _within(1):
                x, y, _ = _at(wall, share)
                worst = max(worst, np.abs(lens.outline.radius - np.hypot(x, y)).max(initial=0.0))
    return float(worst)


def _within(parts: int) -> np.ndarray:
    """(n, 3) shares of the corners in a triangle's centre and in all that divides its edges into 2 x parts."""
    count = 2 * parts
    i, j = (p.ravel() for p in np.mgrid[: count + 1, : count + 1])
    shares = np.stack([i, j, count - i - j], axis=1)
    inside = (shares >= 0).all(1) & (shares < count).all(1)
    return np.vstack([np.full(3, 1 / 3), shares[inside] / count])


def _at(corner: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(3, n): the place with these shares of the corners (n, 3, 3) of each triangle."""
    return (share[0] * corner[:, 0] + share[1] * corner[:, 1] + share[2] * corner[:, 2]).T


def _spans(mesh: trimesh.Trimesh, detail: float, sense: int) -> int:
    """How many pieces of `detail` (mm) the longest facet of a face, that of +z or -z, reaches over.

    Fewer for so many facets that LOOKS are spent.
    """
    longest = 1.0
    for corner, cross in _by_parts(mesh):
        edges = np.abs(corner[:, :, :2] - np.roll(corner[:, :, :2], 1, axis=1))[sense * cross[:, 2] > 0]
        longest = max(longest, edges.max(initial=0.0) / detail)
    return max(1, min(math.ceil(longest), int((LOOKS / 2 / max(len(mesh.faces), 1)) ** 0.5)))


def _by_parts(mesh: trimesh.Trimesh) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(corners (n, 3, 3), normals of twice the area's length (n, 3)) of a cache's worth of triangles at a time."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    for first in range(0, len(faces), PART):
        corners = vertices[faces[first : first + PART]]
        yield corners, np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def vertex_error(mesh: trimesh.Trimesh, lens: Lens) -> float:
    """Largest distance along z (mm) of a vertex from the nearer face of the lens."""
    x, y, z = np.asarray(mesh.vertices).T
    off = [np.abs(sag(surface, x, y) - z) for surface in (lens.back, lens.front)]
    return float(np.minimum(*off).max(initial=0.0))


def _flat(lens: Lens) -> bool:
    """Is the front plane inside the outline?"""
    return lens.front.sags(lens.outline) == (0.0, 0.0)


# ---- files ---------------------------------------------------------------------------------------------------------

STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
STL_HEADER = b"bstcad, binary STL, lengths in mm"  # must not begin with "solid"


def write_stl(mesh: trimesh.Trimesh, path: str | Path) -> None:
    """Write the mesh as binary STL: 80 bytes of header, the count, 50 bytes a triangle in float32.

    A reader has to be told that it is in mm.
    """
    triangles = np.zeros(len(mesh.faces), STL_TRIANGLE)
    first = 0
    for corners, cross in _by_parts(mesh):
        part = triangles[first : first + len(corners)]
        part["corners"] = corners
        part["normal"] = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), np.finfo(float).tiny)
        first += len(corners)
    with Path(path).open("wb") as file:
        file.write(STL_HEADER.ljust(80) + np.uint32(len(triangles)).tobytes())
        file.write(triangles.data)


def read_stl(path: str | Path) -> trimesh.Trimesh:
    """The mesh of a binary STL file, equal corners merged; ValueError if the file is damaged."""
    path = Path(path)
    try:
        data = files.contents(path, 84 + LARGEST * STL_TRIANGLE.itemsize)
    except ValueError as error:
        raise ValueError(f"{path.name}: cannot be read ({error}); give the path of an STL file") from error
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    if len(data) != 84 + STL_TRIANGLE.itemsize * count or not count:
        raise ValueError(f"{path.name}: {len(data)} bytes, no binary STL of {max(count, 0)} triangles; write it again")
    corners = np.frombuffer(data, STL_TRIANGLE, offset=84)["corners"].reshape(-1, 3)
    if not np.isfinite(corners).all():
        raise ValueError(f"{path.name}: a corner is not finite; write it again")
    first, same = _equal_rows(corners)
    return trimesh.Trimesh(corners[first].astype(np.float64), same.reshape(-1, 3), process=False)


def _equal_rows(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(first row of each group of equal float32 points, group of each row).

    By hash, several times as fast as by sorting rows; by rows if two points ever share a hash.
    """
    factors = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0xD6E8FEB86659FD93], np.uint64)  # odd, of no structure
    keys = np.empty(len(corners), np.uint64)
    for k in range(0, len(corners), PART):
        bits = (corners[k : k + PART] + np.float32(0)).view(np.uint32)  # -0 becomes 0
        keys[k : k + PART] = (bits * factors).sum(1)
    order = np.argsort(keys)
    new = np.diff(keys[order], prepend=~keys[order[:1]]) != 0
    first, same = order[new], np.empty(len(keys), np.int64)
    same[order] = np.cumsum(new) - 1
    if not np.array_equal(corners[first][same], corners):
        _, first, same = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    return first, same


CONTENT_TYPES = """<?xml version="1.0" encoding="UTF-8"?>
<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">\
<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>\
<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>
"""
RELATIONSHIPS = """<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">\
<Relationship Target="/3D/3dmodel.model" Id="model" \
Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>
"""


def model_3mf(mesh: trimesh.Trimesh) -> str:
    """The 3MF core model of the mesh, in millimetres to 1e-9 mm or so."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    vertex_lines = '<vertex x="%.10g" y="%.10g" z="%.10g"/>\n' * len(vertices) % tuple(vertices.ravel().tolist())
    face_lines = '<triangle v1="%d" v2="%d" v3="%d"/>\n' * len(faces) % tuple(faces.ravel().tolist())
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<model unit="millimeter" xml:lang="en-US" '
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">\n'
        '<resources><object id="1" type="model"><mesh><vertices>\n'
        f"{vertex_lines}</vertices><triangles>\n{face_lines}</triangles></mesh></object></resources>\n"
        '<build><item objectid="1"/></build></model>\n'
    )


def write_3mf(mesh: trimesh.Trimesh, path: str | Path) -> None:
    """Write the mesh as 3MF, which states its unit."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as package:
        package.writestr("[Content_Types].xml", CONTENT_TYPES)
        package.writestr("_rels/.rels", RELATIONSHIPS)
        package.writestr("3D/3dmodel.model", model_3mf(mesh))
