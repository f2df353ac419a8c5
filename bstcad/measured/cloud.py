"""Reading measured points: text of x, y, z with any usual separator, and the vertices of PLY and STL files.

A heading names these columns and their unit; other columns (numbers, normals, intensities, words) are left out.  Text
without a heading has three columns, in mm.
"""

from __future__ import annotations

import hashlib
import io
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bstcad.optics.outlines import Outline
from bstcad.runs import files

LARGEST = 1_000_000_000  # bytes
FEWEST = 100  # points, for six degrees of freedom and a form beside them
MESHES = (".ply", ".stl")
ASKED = "give x, y and z in mm, one point a line"
INCH = 25.4  # mm
# 1 mm in each unit.  The extent of a cloud may be half of the lens's, or more with its fixture.
UNITS = {"inches": 1 / INCH, "metres": 1e-3, "micrometres": 1e3}
# Units as headings write them, in mm.
WRITTEN = {
    "mm": 1.0, "millimetre": 1.0, "millimeter": 1.0, "cm": 10.0, "m": 1e3, "metre": 1e3, "meter": 1e3, "um": 1e-3,
    "\u00b5m": 1e-3, "\u03bcm": 1e-3, "micron": 1e-3, "microns": 1e-3, "nm": 1e-6, "in": INCH, "inch": INCH,
    "inches": INCH, '"': INCH,
}  # fmt: skip
# Words beside x, y or z in the heading of a coordinate; "nx", "normal x" or "x deviation" is no coordinate.
BESIDE = {"coord", "coordinate", "koordinate", "pos", "position", "point", "axis", "achse", "measured", "actual"}
HEADING = 50  # lines among which a heading is looked for
ALIKE = (0.3, 1.7)  # extents of a cloud over the lens's, in the right unit


@dataclass(frozen=True)
class Cloud:
    """Measured points before any alignment."""

    points: np.ndarray = field(repr=False)  # (n, 3) mm
    unit: str  # of the file by the extent of the points: "mm" or "inches"
    path: Path
    sha256: str = ""  # of the file


def load(path: Path, outline: Outline) -> Cloud:
    """The cloud of a lens of that outline; ValueError says in a sentence what is wrong with it."""
    try:
        points, data = _read(path)
        return Cloud(*in_millimetres(points, outline), path, hashlib.sha256(data).hexdigest())
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _read(path: Path) -> tuple[np.ndarray, bytes]:
    """(the points (n, 3) of a file, in mm if its heading names a unit; its bytes)."""
    try:
        data = files.contents(path, LARGEST)
    except ValueError as error:
        raise ValueError(f"cannot be read ({error}); give the path of a measured cloud") from None
    if not data.strip():
        raise ValueError(f"is empty; {ASKED}")
    ending = path.suffix.lower()
    points = _vertices(data, ending) if ending in MESHES else _numbers(data)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite)) + 1
        raise ValueError(f"point {row} is not three finite numbers; leave out what was not measured")
    if len(points) < FEWEST:
        raise ValueError(f"holds {len(points)} points, too few; measure {FEWEST} or more, better 10 000")
    return points, data


def in_millimetres(points: np.ndarray, outline: Outline) -> tuple[np.ndarray, str]:
    """(the points in mm, the unit they came in): "mm" or "inches".

    ValueError for a cloud whose extent fits no unit of a machine shop.
    """
    low, high = np.percentile(points, (1, 99), axis=0)  # a few stray points are no extent
    extent, width = float((high - low).max()), 2 * max(outline.half_extent)
    if ALIKE[0] <= extent / width <= 5 * ALIKE[1]:
        return points, "mm"
    unit = next((unit for unit, size in UNITS.items() if ALIKE[0] <= extent / width / size <= ALIKE[1]), None)
    if unit == "inches":
        return points * INCH, unit
    covered = f"where the lens is {width:.3g} mm wide"
    if unit:
        raise ValueError(f"its points cover {extent:.3g} {covered}, as if they were in {unit}; give them in mm")
    raise ValueError(f"its points cover {extent:.3g} mm {covered}; give a cloud of its back face, in mm")


def _numbers(data: bytes) -> np.ndarray:
    """(n, 3) of the columns of text that its heading names x, y and z, in mm if it states a unit; else of all three.

    Lines that begin with # are left out, unless one of them is the heading.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"is no text; {ASKED}, or a PLY or STL file under its own ending") from None
    every = [(number, line) for number, line in enumerate(map(str.strip, text.splitlines()), 1) if line]
    heading, columns, units = _heading([line for _, line in every[:HEADING]])
    lines = [(number, line) for number, line in every[heading:] if line[0] != "#"]
    if not heading and lines and _floats(lines[0][1]) is None:
        _, title = lines.pop(0)
        if lines and len(_fields(title)) == len(_fields(lines[0][1])):
            raise ValueError(f"its heading, {title[:60]!r}, names no x, y and z; name these three columns so")
    if not lines:
        raise ValueError(f"holds no points; {ASKED}")
    first, count = lines[0][0], len(_fields(lines[0][1]))
    if not heading and count > 3:
        raise ValueError(
            f"line {first} holds {count} columns, and no heading says which are x, y and z; put one above them, such "
            "as x,y,z,nx,ny,nz, or give these three alone"
        )
    if count <= max(columns):
        raise ValueError(f"line {first} holds {count} number{'s' * (count != 1)}; {ASKED}")
    separator = _separator(lines[0][1])
    body = _with_points("\n".join(line for _, line in lines), separator)
    how = {"delimiter": separator, "comments": None, "ndmin": 2, "quotechar": '"'}
    try:
        return np.loadtxt(io.StringIO(body), usecols=columns if heading else None, **how) * units
    except ValueError as error:
        wrong = next((number for number, line in lines if _floats(line, columns, exactly=not heading) is None), first)
        raise ValueError(f"line {wrong} is not three numbers; {ASKED}") from error


def _heading(lines: list[str]) -> tuple[int, tuple[int, ...], np.ndarray]:
    """(lines up to and with the heading, 0: there is none; the columns of x, y and z; the unit of each in mm)."""
    for row, line in enumerate(lines):
        if _floats(line) is not None:
            break
        plain = re.sub(r"\s+([\[(])", r"\1", line.lstrip("#%/ \t"))  # "x [mm]" is one word
        named = [(place, *found) for place, word in enumerate(_fields(plain)) if (found := _coordinate(word))]
        if {axis for _, axis, _ in named} != set("xyz"):
            continue
        if len(named) > 3:
            raise ValueError(f"its heading, {line[:60]!r}, names x, y or z twice; name three columns so")
        columns, _, units = zip(*sorted(named, key=lambda column: column[1]), strict=True)
        return row + 1, columns, np.array(units)
    return 0, (0, 1, 2), np.ones(3)


def _coordinate(word: str) -> tuple[str, float] | None:
    """("x", "y" or "z", its unit in mm) of the heading of a column such as "X [mm]"; None if it is no coordinate.

    ValueError for a unit that is none of WRITTEN.
    """
    words = re.findall(r"[a-z\u00b5\u03bc]+|\"", word.strip().strip("'\"").lower())
    axis = [part for part in words if part in ("x", "y", "z")]
    rest = [part for part in words if part not in BESIDE and part not in axis]
    if len(axis) != 1 or len(rest) > 1:
        return None
    if rest and rest[0] not in WRITTEN:
        if re.search(r"[\[(/]", word):
            raise ValueError(f"its heading, {word.strip()[:60]!r}, has a unit that is not known; give mm")
        return None
    return axis[0], WRITTEN[rest[0]] if rest else 1.0


def _separator(line: str) -> str | None:
    """Separator of the numbers of a line; None: blanks."""
    return next((mark for mark in (";", "\t", ",") if mark in line), None)


def _with_points(text: str, separator: str | None) -> str:
    """Text whose decimal commas, which stand beside semicolons and tabs only, are points."""
    return text.replace(",", ".") if separator in (";", "\t") else text


def _fields(line: str) -> list[str]:
    separator = _separator(line)
    return _with_points(line, separator).split(separator)


def _floats(line: str, columns: tuple[int, ...] = (), exactly: bool = False) -> list[float] | None:
    """The numbers of all fields of a line, or of some columns; None if there are none.  exactly: it has no others."""
    fields = _fields(line)
    if exactly and len(fields) != len(columns):
        return None
    try:
        return [float(fields[column]) for column in columns or range(len(fields))]
    except (ValueError, IndexError):
        return None


def _vertices(data: bytes, ending: str) -> np.ndarray:
    """The vertices of a PLY or STL file, each once."""
    import trimesh

    try:
        mesh = trimesh.load(io.BytesIO(data), file_type=ending[1:], process=False)
        points = np.asarray(mesh.vertices, dtype=np.float64)
    except Exception as error:  # trimesh raises whatever a damaged file leads to
        fault = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise ValueError(f"is no {ending[1:].upper()} file that can be read ({fault[:80]}); write it again") from None
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError("holds no points; export the vertices of the measured face")
    return np.unique(points, axis=0)
