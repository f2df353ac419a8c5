"""Read clouds of measured points: text (point_text.py), PLY and STL (point_mesh.py), height maps (point_grid.py)."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bstcad.manufacture.measured import grid_process, point_grid
from bstcad.manufacture.measured.point_mesh import read_mesh
from bstcad.manufacture.measured.point_text import INCH, INPUT_HINT, MeasuredPoints, read_text
from bstcad.optics.surfaces.outlines import Outline
from bstcad.runs import files

MAX_CLOUD_SIZE = 1_000_000_000  # largest size of a file (bytes)
MIN_CLOUD_POINTS = 100  # minimum number of points, to which six degrees of freedom and a form are fitted
MESH_SUFFIXES = (".ply", ".stl")
UNIT_SIZES = {"inches": 1 / INCH, "metres": 1e-3, "micrometres": 1e3}  # number of units in 1 mm
PLAUSIBLE_RATIOS = (0.3, 1.7)  # limits of cloud's extent / lens's width; for mm, the upper limit is 5 times as large


@dataclass(frozen=True)
class Cloud:
    """Measured points before alignment."""

    points: np.ndarray = field(repr=False)  # positions of the points (n, 3), mm, in the frame of the instrument
    unit: str  # "mm" or "inches", whichever fits the lens, after conversion to mm if a heading states a unit
    path: Path
    sha256: str = ""  # hash of the file
    without_data: int = 0  # number of points of the file that lack a coordinate and are left out
    columns: str = ""  # names of the columns read, for a Zygo file or if other columns state x, y or z too; else ""
    duplicates: int = 0  # number of points of the file that repeat an earlier one exactly and are left out


def load(path: Path, outline: Outline) -> Cloud:
    """Read the cloud of a lens with this outline; raise ValueError, with a sentence, if the file is not usable."""
    try:
        measured, data = _read(path)
        points, unit = in_millimetres(measured.positions, outline)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    digest = hashlib.sha256(data).hexdigest()
    left_out = {"without_data": measured.without_data, "duplicates": measured.duplicates}
    return Cloud(points, unit, path, digest, columns=measured.columns, **left_out)


def _read(path: Path) -> tuple[MeasuredPoints, bytes]:
    """Return the points of a file, in mm if its heading names a unit, and the file's bytes."""
    try:
        data = files.contents(path, MAX_CLOUD_SIZE)
    except ValueError as error:
        raise ValueError(f"cannot be read ({error}); give the path of a measured cloud") from None
    if not data.strip():
        raise ValueError(f"is empty; {INPUT_HINT}")
    ending = path.suffix.lower()
    if name := point_grid.grid_format(data):
        measured = grid_process.read_limited(data, name)
    elif ending in point_grid.ENDINGS:
        known = ", ".join(dict.fromkeys(name for _, _, name in point_grid.FORMATS))
        raise ValueError(
            f"its name ends in {ending}, but it begins like none of the formats {known}; export the file again"
        )
    else:
        measured = read_mesh(data, ending) if ending in MESH_SUFFIXES else read_text(data)
    if len(measured.positions) < MIN_CLOUD_POINTS:
        counts = {"without data": measured.without_data, "duplicated": measured.duplicates}
        more = "".join(f" and {count} {where}" for where, count in counts.items() if count)
        raise ValueError(
            f"contains {len(measured.positions)} points{more}, which are too few; measure at least "
            f"{MIN_CLOUD_POINTS}, preferably 10 000"
        )
    return measured, data


def in_millimetres(points: np.ndarray, outline: Outline) -> tuple[np.ndarray, str]:
    """Return the points in mm, and the unit of the input, "mm" or "inches"; ValueError if the extent fits neither."""
    low, high = np.percentile(points, (1, 99), axis=0)  # ignores stray points
    extent, width = float((high - low).max()), 2 * max(outline.half_extent)
    smallest, largest = PLAUSIBLE_RATIOS
    if smallest <= extent / width <= 5 * largest:
        return points, "mm"
    unit = next((unit for unit, size in UNIT_SIZES.items() if smallest <= extent / width / size <= largest), None)
    if unit == "inches":
        return points * INCH, unit
    lens_width = f"and the lens is {width:.3g} mm wide"
    if unit:
        raise ValueError(f"its points seem to be in {unit}: their extent is {extent:.6g} {lens_width}; give them in mm")
    raise ValueError(f"its extent is {extent:.6g} mm {lens_width}; give a cloud of the lens's back face, in mm")
