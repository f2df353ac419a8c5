"""Read the vertices of PLY and STL files.

The amount of data that a header declares is compared with the size of the file before memory is allocated.  If the two
differ, the error states both.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

import numpy as np

from bstcad.manufacture.measured.point_text import MeasuredPoints, make_points

EXPORT_HINT = "export the file again"
PLY_TYPES = {  # names of number types in numpy, by their names in PLY
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}  # byte order in numpy of each binary format of PLY
MAX_PLY_HEADER_SIZE = 1 << 20  # largest size of a header (bytes)
STL_HEADER_SIZE, STL_TRIANGLE_SIZE = 84, 50  # bytes: 80 of text and a count; twelve float32 and two bytes


def read_mesh(data: bytes, ending: str) -> MeasuredPoints:
    """Return the distinct vertices of a file whose name ends in ".ply" or ".stl"."""
    try:
        positions = (_ply if ending == ".ply" else _stl)(data)
    except _Damaged as error:
        raise ValueError(f"is not a readable {ending[1:].upper()} file ({error}); {EXPORT_HINT}") from None
    points = make_points(positions)
    if not len(points.positions):
        raise ValueError("contains no points; export the vertices of the measured face")
    return MeasuredPoints(points.positions, points.without_data)  # vertices of neighbouring triangles are no duplicates


class _Damaged(Exception):
    """Error of a file that does not have the format of its suffix."""


# ---- PLY -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Element:
    name: str
    count: int  # number of rows that the header declares
    properties: tuple[tuple[str, str, str], ...]  # (name, type, type of a list's length or "")

    @property
    def has_lists(self) -> bool:
        """True if a property is a list, so that rows may differ in length."""
        return any(length for _, _, length in self.properties)

    def row(self, order: str) -> np.dtype:
        """Return the numpy type of a row without lists; order: "<" or ">", the byte order."""
        return np.dtype([(name, order + kind) for name, kind, _ in self.properties])

    def shortage_error(self, follow: int) -> ValueError:
        """Return the error for a file in which only `follow` of the declared rows follow."""
        what = "points" if self.name == "vertex" else f"rows of element {self.name!r}"
        return ValueError(f"its header declares {self.count} {what}, but {follow} follow; {EXPORT_HINT}")


def _ply(data: bytes) -> np.ndarray:
    """Return the vertices (n, 3) of a PLY file."""
    form, elements, start = _header(data)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None or not {"x", "y", "z"} <= {name for name, _, length in vertex.properties if not length}:
        raise ValueError("contains no points: its header has no vertex with x, y and z; export the measured vertices")
    if vertex.has_lists:
        raise ValueError("its points have lists as properties; export x, y and z only")
    if form == "ascii":
        return _ascii_vertices(data[start:], elements)
    return _binary_vertices(data, elements, start, ORDERS[form])


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Return the format, the elements in the order of their data, and the offset of the data."""
    end = re.compile(rb"^[ \t]*end_header[ \t]*(?:\r\n|\n|\r)", re.MULTILINE).search(data[:MAX_PLY_HEADER_SIZE])
    if not data.startswith(b"ply") or end is None:
        raise _Damaged("its header does not end" if data.startswith(b"ply") else "it does not begin with ply")
    form, elements = "", []
    for line in data[: end.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", name, *_]:
                form = name
            case ["element", name, count] if re.fullmatch(r"\d{1,18}", count):
                elements.append(_Element(name, int(count), ()))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= PLY_TYPES.keys():
                elements[-1] = _add_property(elements[-1], name, PLY_TYPES[kind], PLY_TYPES[length])
            case ["property", kind, name] if elements and kind in PLY_TYPES:
                elements[-1] = _add_property(elements[-1], name, PLY_TYPES[kind], "")
            case ["ply"] | ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise _Damaged(f"its header has the unknown line {line.strip()[:40]!r}")
    if form != "ascii" and form not in ORDERS:
        raise _Damaged(f"its header has the unknown format {form[:40]!r}")
    return form, elements, end.end()


def _add_property(element: _Element, name: str, kind: str, length: str) -> _Element:
    if name in {known for known, _, _ in element.properties}:
        raise _Damaged(f"its header declares {name[:40]!r} twice")
    return _Element(element.name, element.count, (*element.properties, (name, kind, length)))


def _ascii_vertices(body: bytes, elements: list[_Element]) -> np.ndarray:
    lines = [line for line in body.decode("latin-1").splitlines() if line.strip()]
    at, vertices = 0, np.empty((0, 3))
    for element in elements:
        if element.count > len(lines) - at:
            raise element.shortage_error(len(lines) - at)
        if element.name == "vertex":
            names = [name for name, _, _ in element.properties]
            columns = [names.index(axis) for axis in "xyz"]
            vertices = _parse_rows(lines[at : at + element.count], columns)
        at += element.count
    if at < len(lines):
        raise ValueError(f"its header declares {at} lines of data, but {len(lines)} follow; {EXPORT_HINT}")
    return vertices


def _parse_rows(lines: list[str], columns: list[int]) -> np.ndarray:
    numbers = np.empty((len(lines), 3))
    for row, line in enumerate(lines):
        fields = line.split()
        try:
            numbers[row] = [float(fields[column]) for column in columns]
        except (ValueError, IndexError):
            raise ValueError(f"its point {row + 1} is not three numbers ({line[:40]!r}); {EXPORT_HINT}") from None
    return numbers


def _binary_vertices(data: bytes, elements: list[_Element], at: int, order: str) -> np.ndarray:
    vertices = np.empty((0, 3))
    for element in elements:
        if element.has_lists:
            at = _end_of_list_rows(data, element, at, order)
            continue
        row = element.row(order)
        if element.count * row.itemsize > len(data) - at:
            raise element.shortage_error((len(data) - at) // row.itemsize)
        if element.name == "vertex":
            table = np.frombuffer(data, row, element.count, at)
            vertices = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
        at += element.count * row.itemsize
    if more := len(data[at:].rstrip(b"\r\n")):
        raise ValueError(f"{more} bytes follow after the data that its header declares; {EXPORT_HINT}")
    return vertices


def _end_of_list_rows(data: bytes, element: _Element, at: int, order: str) -> int:
    """Return the offset after the rows of an element with lists; rows of unequal length are read one by one."""
    types = ((order + kind, order + length if length else None) for _, kind, length in element.properties)
    parts = [(np.dtype(kind), None if length is None else np.dtype(length)) for kind, length in types]
    uniform_end = _end_of_uniform_rows(data, parts, at, element.count)
    if uniform_end is not None:
        return uniform_end
    for row in range(element.count):
        _, end = _next_row(data, parts, at)
        if not at < end <= len(data):
            raise element.shortage_error(row)
        at = end
    return at


Parts = list[tuple[np.dtype, np.dtype | None]]  # types of each property's items, and of its length if it is a list


def _next_row(data: bytes, parts: Parts, at: int) -> tuple[list[int], int]:
    """Return the number of items of each property in the row at `at`, and the row's end, beyond the data if cut off."""
    sizes = []
    for kind, length in parts:
        size = 1
        if length is not None:
            size = max(0, int(np.frombuffer(data, length, 1, at)[0])) if at + length.itemsize <= len(data) else 0
            at += length.itemsize
        sizes.append(size)
        at += size * kind.itemsize
    return sizes, at


def _end_of_uniform_rows(data: bytes, parts: Parts, at: int, count: int) -> int | None:
    """Return the offset after the rows if all their lists are as long as in the first row (triangles); else None."""
    sizes, end = _next_row(data, parts, at)
    if count == 0 or not 0 < (end - at) * count <= len(data) - at:
        return at if count == 0 else None
    fields = []
    for k, ((kind, length), size) in enumerate(zip(parts, sizes, strict=True)):
        fields += [] if length is None else [(f"length{k}", length)]
        fields.append((f"value{k}", np.dtype((kind, (size,)))))
    row = np.dtype(fields)
    table = np.frombuffer(data, row, count, at)
    lengths = [name for name in row.names or () if name.startswith("length")]
    return at + row.itemsize * count if all((table[name] == table[name][0]).all() for name in lengths) else None


# ---- STL -------------------------------------------------------------------------------------------------------------


def _stl(data: bytes) -> np.ndarray:
    """Return the corners (3 n, 3) of the triangles of an STL file."""
    if data[:5].lower() == b"solid" and b"facet" in data[:4096].lower():
        corners = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", data, re.IGNORECASE)
        facets = len(re.findall(rb"\bfacet\s+normal", data, re.IGNORECASE))
        if len(corners) != 3 * facets:
            raise ValueError(f"it has {facets} triangles, but {len(corners)} corners; {EXPORT_HINT}")
        try:
            return np.array(corners, dtype=np.float64).reshape(-1, 3)
        except ValueError:
            raise _Damaged("a corner is not three numbers") from None
    if len(data) < STL_HEADER_SIZE:
        raise _Damaged(f"it ends after {len(data)} bytes")
    [count] = struct.unpack_from("<I", data, STL_HEADER_SIZE - 4)
    if len(data) != STL_HEADER_SIZE + STL_TRIANGLE_SIZE * count:
        follow = (len(data) - STL_HEADER_SIZE) / STL_TRIANGLE_SIZE
        raise ValueError(f"its header declares {count} triangles, but {follow:.6g} follow; {EXPORT_HINT}")
    row = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    table = np.frombuffer(data, row, count, STL_HEADER_SIZE)
    return table["corners"].reshape(-1, 3).astype(np.float64)
