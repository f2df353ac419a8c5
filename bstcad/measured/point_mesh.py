"""Points of meshes and clouds in PLY and STL files: their vertices.

A header promises how much follows.  It is held to what does follow before anything is allocated, and both numbers are
stated where they differ.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

import numpy as np

from bstcad.measured.point_text import Points, measured

AGAIN = "export it again"
TYPES = {  # PLY's number types, as numpy has them
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST_HEADER = 1 << 20  # bytes
STL_HEAD, STL_TRIANGLE = 84, 50  # bytes: 80 of words and a count; twelve float32 and two bytes


def read_mesh(data: bytes, ending: str) -> Points:
    """The vertices of a file with this ending, ".ply" or ".stl", each once."""
    try:
        places = (_ply if ending == ".ply" else _stl)(data)
    except _Damaged as error:
        raise ValueError(f"is no {ending[1:].upper()} file that can be read ({error}); write it again") from None
    found = measured(places)
    if not len(found.places):
        raise ValueError("holds no points; export the vertices of the measured face")
    return Points(np.unique(found.places, axis=0), found.without_data)


class _Damaged(Exception):
    """A file that is not what its ending says."""


# ---- PLY -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Element:
    """A table of a PLY file."""

    name: str
    count: int  # promised number of rows
    properties: tuple[tuple[str, str, str], ...]  # (name, type, type of a list's length or "")

    @property
    def lists(self) -> bool:
        """Do its rows differ in length?"""
        return any(length for _, _, length in self.properties)

    def row(self, order: str) -> np.dtype:
        """A row without lists."""
        return np.dtype([(name, order + kind) for name, kind, _ in self.properties])

    def promised(self, follow: int) -> ValueError:
        """Fewer rows follow than are promised."""
        what = "points" if self.name == "vertex" else f"rows of element {self.name!r}"
        return ValueError(f"its header promises {self.count} {what}, and {follow} follow; {AGAIN}")


def _ply(data: bytes) -> np.ndarray:
    """(n, 3) float64 of element vertex."""
    form, elements, start = _header(data)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None or not {"x", "y", "z"} <= {name for name, _, length in vertex.properties if not length}:
        raise ValueError("holds no points: its header names no vertex with x, y and z; export the measured vertices")
    if vertex.lists:
        raise ValueError("its points have lists as properties; export x, y and z alone")
    return _of_text(data[start:], elements) if form == "ascii" else _of_bytes(data, elements, start, ORDERS[form])


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """(format, elements in their order, where the data begin)."""
    end = re.compile(rb"^[ \t]*end_header[ \t]*(?:\r\n|\n|\r)", re.MULTILINE).search(data[:LONGEST_HEADER])
    if not data.startswith(b"ply") or end is None:
        raise _Damaged("its header does not end" if data.startswith(b"ply") else "it does not begin with ply")
    form, elements = "", []
    for line in data[: end.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", name, *_]:
                form = name
            case ["element", name, count] if re.fullmatch(r"\d{1,18}", count):
                elements.append(_Element(name, int(count), ()))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= TYPES.keys():
                elements[-1] = _with(elements[-1], name, TYPES[kind], TYPES[length])
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1] = _with(elements[-1], name, TYPES[kind], "")
            case ["ply"] | ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise _Damaged(f"{line.strip()[:40]!r} in its header")
    if form != "ascii" and form not in ORDERS:
        raise _Damaged(f"its format is {form[:40]!r}")
    return form, elements, end.end()


def _with(element: _Element, name: str, kind: str, length: str) -> _Element:
    """The element with one more property."""
    if name in {known for known, _, _ in element.properties}:
        raise _Damaged(f"property {name[:40]!r} twice")
    return _Element(element.name, element.count, (*element.properties, (name, kind, length)))


def _of_text(body: bytes, elements: list[_Element]) -> np.ndarray:
    """The vertices of an ASCII file: a row a line."""
    lines = [line for line in body.decode("latin-1").splitlines() if line.strip()]
    at, found = 0, np.empty((0, 3))
    for element in elements:
        if element.count > len(lines) - at:
            raise element.promised(len(lines) - at)
        if element.name == "vertex":
            names = [name for name, _, _ in element.properties]
            columns = [names.index(axis) for axis in "xyz"]
            found = _rows(lines[at : at + element.count], columns)
        at += element.count
    if at < len(lines):
        raise ValueError(f"its header promises {at} lines of data, and {len(lines)} follow; {AGAIN}")
    return found


def _rows(lines: list[str], columns: list[int]) -> np.ndarray:
    """(n, 3) of three columns of lines."""
    found = np.empty((len(lines), 3))
    for row, line in enumerate(lines):
        fields = line.split()
        try:
            found[row] = [float(fields[column]) for column in columns]
        except (ValueError, IndexError):
            raise ValueError(f"its point {row + 1} is not three numbers ({line[:40]!r}); {AGAIN}") from None
    return found


def _of_bytes(data: bytes, elements: list[_Element], at: int, order: str) -> np.ndarray:
    """The vertices of a binary file."""
    found = np.empty((0, 3))
    for element in elements:
        if element.lists:
            at = _behind_lists(data, element, at, order)
            continue
        row = element.row(order)
        if element.count * row.itemsize > len(data) - at:
            raise element.promised((len(data) - at) // row.itemsize)
        if element.name == "vertex":
            table = np.frombuffer(data, row, element.count, at)
            found = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
        at += element.count * row.itemsize
    if more := len(data[at:].rstrip(b"\r\n")):
        raise ValueError(f"{more} bytes follow behind all that its header promises; {AGAIN}")
    return found


def _behind_lists(data: bytes, element: _Element, at: int, order: str) -> int:
    """Where the rows of an element with lists end: at once if all are as long as the first, else row by row."""
    parts = [
        (np.dtype(order + kind), np.dtype(order + length) if length else None) for _, kind, length in element.properties
    ]
    if element.count > len(data) - at:  # a row has a byte at least
        raise element.promised(_rows_that_follow(data, parts, at, element.count)[0])
    alike = _as_the_first(data, parts, at, element.count)
    if alike is not None:
        return alike
    rows, end = _rows_that_follow(data, parts, at, element.count)
    if rows < element.count:
        raise element.promised(rows)
    return end


Parts = list[tuple[np.dtype, np.dtype | None]]


def _rows_that_follow(data: bytes, parts: Parts, at: int, most: int) -> tuple[int, int]:
    """(whole rows from a place on, at most so many; where they end)."""
    for row in range(most):
        end = at
        for kind, length in parts:
            count = 1
            if length is not None:
                if end + length.itemsize > len(data):
                    return row, at
                count = int(np.frombuffer(data, length, 1, end)[0])
                end += length.itemsize
            end += max(count, 0) * kind.itemsize
        if end > len(data) or end == at:
            return row, at
        at = end
    return most, at


def _as_the_first(data: bytes, parts: Parts, at: int, count: int) -> int | None:
    """Where the rows end if the lists of all are as long as those of the first, as of triangles; None: they are not."""
    fields, end = [], at
    for k, (kind, length) in enumerate(parts):
        size = 1
        if length is not None:
            if end + length.itemsize > len(data):
                return None
            size = int(np.frombuffer(data, length, 1, end)[0])
            fields.append((f"length{k}", length))
            end += length.itemsize
        if not 0 <= size * kind.itemsize <= len(data) - end:
            return None
        fields.append((f"value{k}", kind, (size,)))
        end += size * kind.itemsize
    row = np.dtype(fields)
    if count == 0 or not 0 < row.itemsize * count <= len(data) - at:
        return at if count == 0 else None
    table = np.frombuffer(data, row, count, at)
    lengths = [name for name in row.names or () if name.startswith("length")]
    return at + row.itemsize * count if all((table[name] == table[name][0]).all() for name in lengths) else None


# ---- STL -------------------------------------------------------------------------------------------------------------


def _stl(data: bytes) -> np.ndarray:
    """(3 n, 3) float64: the corners of the triangles."""
    if data[:5].lower() == b"solid" and b"facet" in data[:4096].lower():
        corners = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", data, re.IGNORECASE)
        facets = len(re.findall(rb"\bfacet\s+normal", data, re.IGNORECASE))
        if len(corners) != 3 * facets:
            raise ValueError(f"it has {facets} triangles, and {len(corners)} corners follow; {AGAIN}")
        try:
            return np.array(corners, dtype=np.float64).reshape(-1, 3)
        except ValueError:
            raise _Damaged("a corner is not three numbers") from None
    if len(data) < STL_HEAD:
        raise _Damaged(f"it ends after {len(data)} bytes")
    [count] = struct.unpack_from("<I", data, STL_HEAD - 4)
    if len(data) != STL_HEAD + STL_TRIANGLE * count:
        follow = (len(data) - STL_HEAD) / STL_TRIANGLE
        raise ValueError(f"its header promises {count} triangles, and {follow:.6g} follow; {AGAIN}")
    row = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    table = np.frombuffer(data, row, count, STL_HEAD)
    return table["corners"].reshape(-1, 3).astype(np.float64)
