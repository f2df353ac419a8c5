"""Clouds of measured points: text of x, y, z (point_text.py) and the vertices of PLY and STL files (point_mesh.py)."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bstcad.measured.point_mesh import read_mesh
from bstcad.measured.point_text import ASKED, INCH, Points, read_text
from bstcad.optics.outlines import Outline
from bstcad.runs import files

LARGEST = 1_000_000_000  # bytes
FEWEST = 100  # points, for six degrees of freedom and a form beside them
MESHES = (".ply", ".stl")
# 1 mm in each unit.  The extent of a cloud may be half of the lens's, or more with its fixture.
UNITS = {"inches": 1 / INCH, "metres": 1e-3, "micrometres": 1e3}
ALIKE = (0.3, 1.7)  # extents of a cloud over the lens's, in the right unit


@dataclass(frozen=True)
class Cloud:
    """Measured points before any alignment."""

    points: np.ndarray = field(repr=False)  # (n, 3) mm
    unit: str  # of the file by the extent of the points: "mm" or "inches"
    path: Path
    sha256: str = ""  # of the file
    without_data: int = 0  # points of the file without a height or another coordinate, which are left out
    columns: str = ""  # which columns were taken, where its heading names nominal and actual ones


def load(path: Path, outline: Outline) -> Cloud:
    """The cloud of a lens of that outline; ValueError says in a sentence what is wrong with it."""
    try:
        found, data = _read(path)
        points, unit = in_millimetres(found.places, outline)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    digest = hashlib.sha256(data).hexdigest()
    return Cloud(points, unit, path, digest, without_data=found.without_data, columns=found.columns)


def _read(path: Path) -> tuple[Points, bytes]:
    """(the points of a file, in mm if its heading names a unit; its bytes)."""
    try:
        data = files.contents(path, LARGEST)
    except ValueError as error:
        raise ValueError(f"cannot be read ({error}); give the path of a measured cloud") from None
    if not data.strip():
        raise ValueError(f"is empty; {ASKED}")
    ending = path.suffix.lower()
    found = read_mesh(data, ending) if ending in MESHES else read_text(data)
    if len(found.places) < FEWEST:
        without = f" and {found.without_data} without data" if found.without_data else ""
        raise ValueError(f"holds {len(found.places)} points{without}, too few; measure {FEWEST} or more, better 10 000")
    return found, data


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
