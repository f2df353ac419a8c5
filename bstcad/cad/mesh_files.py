"""Meshes as files: STL, which states no unit, and 3MF, which states millimetres.

For two million triangles trimesh takes 2 s of CPU to write STL (this file 0.3), 8 s to read it (1.5), and lib3mf 2.3 s
to write 3MF (2.5, but the same bytes each time).
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from bstcad.cad import mesh_kernels
from bstcad.cad.mesh import ASKED, PART, Mesh
from bstcad.runs import files

LARGEST = ASKED  # triangles of a mesh that is read
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
    first, same = _equal_rows(corners)
    return Mesh(corners[first].astype(np.float64), same.reshape(-1, 3))


def _equal_rows(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(first row of each group of equal float32 points, group of each row)."""
    corners = np.ascontiguousarray(corners) + np.float32(0)  # -0 becomes 0
    first, same = mesh_kernels.welded(corners.view(np.uint32))
    if len(same) < len(corners):
        _, first, same = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    return first, same.astype(np.int32, copy=False)


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
