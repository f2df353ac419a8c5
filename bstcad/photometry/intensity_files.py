"""Intensity files by their suffix: .ies, .ldt, and .csv, a table of intensities in cd.

The first row of a table has the angles C and its first column the angles γ (degrees); the first value of the first row
is not read.  A comma or a semicolon separates values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import PurePath

import numpy as np

from bstcad.photometry import eulumdat, ies
from bstcad.photometry.intensity import MAX_INTENSITIES, MAX_NUMBERS, Intensity, PhotometricError, checked

CORNER = "gamma\\C"  # first value of a table, above γ and before C


def of_csv(data: bytes) -> Intensity:
    """Return the intensities (cd) of a table: C angles in its first row, γ in its first column, degrees."""
    if sum(map(data.count, (b",", b";", b"\n"))) > MAX_NUMBERS:  # before memory is allocated for each number
        raise PhotometricError(f"has more than {MAX_NUMBERS} values; give a table over fewer angles")
    rows = [
        line.replace(";", ",").split(",") for line in data.decode("utf-8-sig", "replace").splitlines() if line.strip()
    ]
    if not rows or len(rows) * len(rows[0]) > MAX_INTENSITIES or any(len(row) != len(rows[0]) for row in rows):
        raise PhotometricError("is not a table with rows of as many values each; separate them by commas")
    try:
        around = np.array(rows[0][1:], dtype=np.float64)
        body = np.array(rows[1:], dtype=np.float64)
    except ValueError:
        raise PhotometricError(
            "has something other than a number; write C in the first row, γ in the first column"
        ) from None
    if body.ndim != 2 or body.shape[0] < 2 or body.shape[1] < 2:
        raise PhotometricError("has fewer than two angles; write C in the first row and γ in the first column")
    return checked("C", around, body[:, 0], body[:, 1:].T)


def csv_text(table: Intensity) -> str:
    """Return a table of intensities (cd) over C and γ (degrees), which `of_csv` reads."""
    rows = [[CORNER, *(f"{c:.10g}" for c in table.around)]]
    rows += [[f"{value:.10g}" for value in (g, *each)] for g, each in zip(table.along, table.candela.T, strict=True)]
    return "".join(",".join(row) + "\n" for row in rows)


READERS: Mapping[str, Callable[[bytes], Intensity]] = {".ies": ies.read, ".ldt": eulumdat.read, ".csv": of_csv}


def read(name: str, data: bytes) -> Intensity:
    """Return the intensities of a file by the suffix of its name; PhotometricError if it cannot be used."""
    suffix = PurePath(name).suffix.lower()
    if suffix not in READERS:
        raise PhotometricError(f"is no intensity file; give one of {', '.join(READERS)}")
    return READERS[suffix](data)
