"""Meshes as files: STL, which states no unit, 3MF, which states millimetres, and previews for web pages and slicers.

For two million triangles trimesh takes 2 s of CPU to write STL (this file 0.3), 8 s to read it (1.5), and lib3mf 2.3 s
to write 3MF (2.5, but equal bytes each time).
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numba import njit

from bstcad.cad.mesh import ASKED, PART, UPRIGHT, Mesh, chordal_error, finest, lens_mesh, sampled
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import Surface
from bstcad.runs import files

LARGEST = ASKED  # triangles of a mesh that is read
PREVIEW = 20_000  # triangles
METRE = 1e-3  # of a mm: the unit of glTF, whose y points up
VERTEX = b'<vertex x="%.10g" y="%.10g" z="%.10g"/>\n'
TRIANGLE = b'<triangle v1="%d" v2="%d" v3="%d"/>\n'
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
STL_HEADER = b"bstcad, binary STL, lengths in mm"  # must not begin with "solid"
LINE = 90  # bytes of a line of a 3MF model at most
CLEAR, SILVER = "#A9D3EE80", "#C9CED4FF"  # red, green, blue (sRGB) and opacity: clear material, a mirror
EPOCH = (1980, 1, 1, 0, 0, 0)  # the time of files in a package, so that equal meshes give equal bytes


@dataclass(frozen=True)
class Label:
    """Name and looks of a mesh."""

    name: str = "lens"
    title: str = ""
    material: str = "glass"
    colour: str = CLEAR  # #RRGGBBAA
    remark: str = ""  # a sentence


UNNAMED = Label()


def write_stl(mesh: Mesh, path: str | Path) -> None:
    """Write the mesh as binary STL: 80 bytes of header, the count, 50 bytes a triangle in float32.

    Programs that read it have to be told that it is in mm.
    """
    with Path(path).open("wb") as file:
        file.write(STL_HEADER.ljust(80) + np.uint32(len(mesh.faces)).tobytes())
        for corners, normals in mesh.facets():
            triangles = np.zeros(len(corners), STL_TRIANGLE)
            triangles["corners"] = corners
            triangles["normal"] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
            file.write(triangles.data)


def read_stl(path: str | Path) -> Mesh:
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
    corners = np.ascontiguousarray(corners) + np.float32(0)  # -0 becomes 0
    first, same = _welded(corners.view(np.uint32))
    return Mesh(corners[first].astype(np.float64), same.reshape(-1, 3))


@njit(cache=True, nogil=True)
def _welded(bits):
    """(first corner of each group of equal ones, group of each corner) of float32 corners (n, 3) as uint32, by hash."""
    size = 1 << 16
    while size < 1.25 * len(bits):
        size *= 2
    table, first, same = np.full(size, -1, np.int32), np.empty(len(bits), np.int32), np.empty(len(bits), np.int32)
    count = 0
    for k in range(len(bits)):
        x, y, z = bits[k, 0], bits[k, 1], bits[k, 2]
        key = np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)  # odd factors of no structure
        key += np.uint64(y) * np.uint64(0xC2B2AE3D27D4EB4F) + np.uint64(z) * np.uint64(0xD6E8FEB86659FD93)
        slot = np.int64((key ^ (key >> np.uint64(32))) & np.uint64(size - 1))
        while True:
            group = table[slot]
            if group < 0:
                group = table[slot] = count
                first[count] = k
                count += 1
            other = first[group]
            if bits[other, 0] == x and bits[other, 1] == y and bits[other, 2] == z:
                break
            slot = (slot + 1) & (size - 1)
        same[k] = group
    return first[:count].copy(), same


# ---- 3MF -----------------------------------------------------------------------------------------------------------

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


def model_3mf(mesh: Mesh, label: Label = UNNAMED) -> Iterator[bytes]:
    """The 3MF core model of the mesh, in millimetres, in parts: one object of one material with its colour."""
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
    yield from _lines(VERTEX, mesh.vertices)
    yield b"</vertices><triangles>\n"
    yield from _lines(TRIANGLE, mesh.faces)
    yield b'</triangles></mesh></object></resources>\n<build><item objectid="2"/></build></model>\n'


def _lines(line: bytes, rows: np.ndarray) -> Iterator[bytes]:
    """A line for each row of numbers, PART rows at a time."""
    for first in range(0, len(rows), PART):
        part = rows[first : first + PART]
        yield (line * len(part)) % tuple(part.ravel().tolist())


def write_3mf(mesh: Mesh, path: str | Path | IO[bytes], label: Label = UNNAMED) -> None:
    """Write the mesh as 3MF, which states its unit; the same mesh gives the same bytes."""
    large = LINE * (len(mesh.vertices) + len(mesh.faces)) > zipfile.ZIP64_LIMIT
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as package:
        for name, text in (("[Content_Types].xml", CONTENT_TYPES), ("_rels/.rels", RELATIONSHIPS)):
            package.writestr(_member(name), text)
        with package.open(_member("3D/3dmodel.model"), "w", force_zip64=large) as model:
            for part in model_3mf(mesh, label):
                model.write(part)


def _member(name: str) -> zipfile.ZipInfo:
    member = zipfile.ZipInfo(name, EPOCH)
    member.compress_type, member.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
    return member


# ---- previews ------------------------------------------------------------------------------------------------------


def preview_files(lens: Lens, label: Label) -> Iterator[tuple[str, bytes]]:
    """preview.glb and preview.3mf of few triangles, both of which state their chordal error.

    Web pages (glTF) and slicers (3MF) cannot show a million triangles; the normals of the glTF are the surface's own,
    and shade it as finely as the lens.
    """
    mesh = lens_mesh(lens, finest(lens, PREVIEW))
    off = chordal_error(mesh, lens)
    label = replace(label, remark=f"A preview: its facets lie within {off:.2g} mm of the lens; lens.step is exact.")
    yield "preview.glb", _glb(mesh, lens, label, off)
    package = io.BytesIO()
    write_3mf(mesh, package, label)
    yield "preview.3mf", package.getvalue()


def _glb(mesh: Mesh, lens: Lens, label: Label, off: float) -> bytes:
    """The mesh as binary glTF, in metres, the back up; off: its chordal error (mm), which its extras state.

    At an edge of the lens each vertex stands twice, with the normals of both faces.
    """
    import trimesh  # most of a second to load
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    vertices, normals, faces, count = [], [], [], 0
    for part, directions in _smooth_parts(mesh, lens):
        used, renumbered = np.unique(part, return_inverse=True)
        vertices.append(mesh.vertices[used])
        normals.append(directions(vertices[-1]))
        faces.append(renumbered.reshape(-1, 3) + count)
        count += len(used)
    red, green, blue, opacity = (int(label.colour[k : k + 2], 16) for k in (1, 3, 5, 7))
    linear = [(part / 255) ** 2.2 for part in (red, green, blue)]
    clear = {"alphaMode": "BLEND"} if opacity < 255 else {"metallicFactor": 1.0}
    material = PBRMaterial(
        name=label.material, baseColorFactor=[*linear, opacity / 255],
        **({"metallicFactor": 0.0, "roughnessFactor": 0.1} | clear),
    )  # fmt: skip
    solid = trimesh.Trimesh(
        METRE * _y_up(np.concatenate(vertices)), np.concatenate(faces), vertex_normals=_y_up(np.concatenate(normals)),
        visual=TextureVisuals(material=material), process=False, validate=False,
        metadata={"title": label.title, "remark": label.remark, "off_mm": off},
    )  # fmt: skip
    scene = trimesh.Scene()
    scene.add_geometry(solid, geom_name=label.name, node_name=label.name)
    return scene.export(file_type="glb", include_normals=True)


def _smooth_parts(mesh: Mesh, lens: Lens) -> Iterator[tuple]:
    """The triangles of each smooth piece of the lens, and its normals, out of the lens, at points (n, 3)."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    across /= np.linalg.norm(across, axis=1)[:, None]
    up, down = across[:, 2] > UPRIGHT, across[:, 2] < -UPRIGHT
    yield mesh.faces[up], lambda points: _upwards(lens.back, points)
    yield mesh.faces[down], lambda points: -_upwards(lens.front, points)
    wall, sides = mesh.faces[~(up | down)], across[~(up | down)]
    if lens.outline.is_round:
        yield wall, lambda points: points * [1, 1, 0] / lens.outline.radius
        return
    for side in ([1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]):
        yield wall[sides @ side > 0.5], lambda points, side=side: np.tile(side, (len(points), 1))


def _upwards(surface: Surface, points: np.ndarray) -> np.ndarray:
    """Unit normals of a face towards +z."""
    _, z_x, z_y = sampled(surface, points[:, 0], points[:, 1])
    normals = np.stack([-z_x, -z_y, np.ones_like(z_x)], axis=1)
    return normals / np.linalg.norm(normals, axis=1)[:, None]


def _y_up(vectors: np.ndarray) -> np.ndarray:
    x, y, z = vectors.T
    return np.stack([x, z, -y], axis=1)
