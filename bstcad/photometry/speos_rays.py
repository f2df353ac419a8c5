"""Ray files of Ansys Speos (.ray), binary and without polarisation.

Numbers are little-endian floats of 32 bits.  The header has the radiant flux (W), five times the number 2, and the
luminous flux (lm); each ray has position (mm), direction cosines, wavelength (nm) and energy.  Energies are relative:
the power of a ray is its share of the radiant flux, Φ e / Σ e.
"""

from __future__ import annotations

import struct

from bstcad.photometry.intensity import PhotometricError
from bstcad.photometry.ray_set import RaySet
from bstcad.photometry.ray_table import RayTable, Source, bytes_of, rows_of, stated_or_none

HEADER = struct.Struct("<7f")
MARK = struct.pack("<5f", *(2.0,) * 5)  # numbers between the fluxes
COLUMNS = 8  # numbers of a ray


def is_speos(head: bytes) -> bool:
    """Return True if the first bytes of a file are those of the format."""
    return head[4 : 4 + len(MARK)] == MARK


def read(source: Source) -> RaySet:
    """Return the rays of a file, in W; PhotometricError if it cannot be used."""
    data = bytes_of(source)
    head = data[: HEADER.size].tobytes()
    if len(head) < HEADER.size or not is_speos(head):
        raise PhotometricError("has no header of a Speos ray file; give a ray file of Speos without polarisation")
    watts, *_, lumens = HEADER.unpack(head)
    count = (len(data) - HEADER.size) // (4 * COLUMNS)
    return RayTable(
        rows_of(data, HEADER.size, count, COLUMNS), "W", power=7, wavelengths=6,
        totals=(stated_or_none(watts),), lumens=stated_or_none(lumens), is_relative=True,
    ).checked()  # fmt: skip
