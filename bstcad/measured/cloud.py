"""Reading measured points: text of x, y, z (mm) with any usual separator, and the vertices of PLY and STL files."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bstcad import files
from bstcad.optics.outlines import Outline

LARGEST = 1_000_000_000  # bytes
FEWEST = 100  # points, for six degrees of freedom and a form beside them
MESHES = (".ply", ".stl")
ASKED = "give x, y and z in mm, one point a line"
INCH = 25.4  # mm
# Units by what 1 mm is in them.  The extent of a cloud may be half of the lens's, or more if its fixture is in it.
UNITS = {"inches": 1 / INCH, "metres": 1e-3, "micrometres": 1e3}
ALIKE = (0.3, 1.7)  # extents of a cloud over the lens's, in the right unit


@dataclass(frozen=True)
class Cloud:
    """Measured points, as they are before any alignment."""

    points: np.ndarray = field(repr=False)  # (n, 3) mm
    unit: str  # that they came in: "mm" or "inches"
    path: Path


def load(path: Path, outline: Outline) -> Cloud:
    """The cloud of a lens of that outline; ValueError says in a sentence what is wrong with it."""
    points = read(path)
    try:
        return Cloud(*in_millimetres(points, outline), path)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def read(path: Path) -> np.ndarray:
    """The points (n, 3) of a file, in its unit; ValueError says in a sentence what is wrong with it."""
    try:
        data = files.contents(path, LARGEST)
    except ValueError as error:
        raise ValueError(f"{path}: cannot be read ({error}); give the path of a measured cloud") from None
    if not data.strip():
        raise ValueError(f"{path}: is empty; {ASKED}")
    try:
        points = _vertices(data, path.suffix.lower()) if path.suffix.lower() in MESHES else _numbers(data)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if not np.isfinite(points).all():
        row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0]) + 1
        raise ValueError(f"{path}: point {row} is not three finite numbers; leave out what was not measured")
    if len(points) < FEWEST:
        raise ValueError(f"{path}: holds {len(points)} points, too few; measure {FEWEST} or more, better 10 000")
    return points


def in_millimetres(points: np.ndarray, outline: Outline) -> tuple[np.ndarray, str]:
    """(the points in mm, the unit they came in): "mm" or "inches".

    ValueError for a cloud whose extent fits no unit that a machine shop measures in.
    """
    low, high = np.percentile(points, (1, 99), axis=0)  # a few stray points are no extent
    found, wanted = float((high - low).max()), 2 * max(outline.half_extent)
    ratio = found / wanted
    if ALIKE[0] <= ratio <= 5 * ALIKE[1]:
        return points, "mm"
    for unit, size in UNITS.items():
        if ALIKE[0] <= ratio / size <= ALIKE[1]:
            if unit == "inches":
                return points * INCH, unit
            raise ValueError(
                f"its points cover {found:.3g} where the lens is {wanted:.3g} mm wide, as if they were in {unit}; "
                "give them in mm"
            )
    raise ValueError(
        f"its points cover {found:.3g} mm where the lens is {wanted:.3g} mm wide; give a cloud of its back face, in mm"
    )


def _numbers(data: bytes) -> np.ndarray:
    """Columns of text; the first line may be a heading, and lines that begin with # are left out."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"is no text; {ASKED}, or a PLY or STL file under its own ending") from None
    lines = [
        (number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip() and line.strip()[0] != "#"
    ]
    if lines and not _is_row(lines[0][1]):
        del lines[0]
    if not lines:
        raise ValueError(f"holds no points; {ASKED}")
    separator = _separator(lines[0][1])
    columns = len(_fields(lines[0][1], separator))
    if columns != 3:
        raise ValueError(f"line {lines[0][0]} holds {columns} number{'s' * (columns != 1)}; {ASKED}")
    body = "\n".join(line for _, line in lines)
    if separator in (";", "\t"):
        body = body.replace(",", ".")  # a decimal comma
    try:
        return np.loadtxt(io.StringIO(body), delimiter=separator, comments=None, ndmin=2)
    except ValueError as error:
        wrong = next((number for number, line in lines if not _is_row(line, separator)), lines[0][0])
        raise ValueError(f"line {wrong} is not three numbers; {ASKED}") from error


def _separator(line: str) -> str | None:
    """What parts the numbers of a line; None: blanks."""
    return next((mark for mark in (";", "\t", ",") if mark in line.strip()), None)


def _fields(line: str, separator: str | None) -> list[str]:
    fields = line.strip().split(separator)
    return [field.replace(",", ".") for field in fields] if separator in (";", "\t") else fields


def _is_row(line: str, separator: str | None = "") -> bool:
    """Is it numbers only, and, where the separator is known, three?"""
    fields = _fields(line, _separator(line) if separator == "" else separator)
    try:
        [float(field) for field in fields]
    except ValueError:
        return False
    return separator == "" or len(fields) == 3


def _vertices(data: bytes, ending: str) -> np.ndarray:
    """The vertices of a PLY or STL file, each once."""
    import trimesh

    try:
        found = trimesh.load(io.BytesIO(data), file_type=ending[1:], process=False)
        points = np.asarray(found.vertices, dtype=np.float64)
    except Exception as error:  # trimesh raises whatever a damaged file leads to
        said = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise ValueError(f"is no {ending[1:].upper()} file that can be read ({said[:80]}); write it again") from None
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError("holds no points; export the vertices of the measured face")
    return np.unique(points, axis=0)
