"""Source files of Zemax OpticStudio (.dat, .sdf), binary and as text.

The binary form, little-endian with numbers of 32 bits, has a header of 208 bytes: identifier (1010, or 8675309 by
OpticStudio itself), number of rays, description (100 bytes), flux of the source, flux of this set of rays, wavelength
(µm, 0 if there are several), angular ranges, unit of length, location, rotation and scale, four unused numbers, form
of the rays (0: flux only, 2: with wavelengths), unit of the flux (0: W, 1: lm), two reserved numbers.  Rays are
position, direction cosines, flux, and the wavelength (µm) where the form is 2.

The text has the number of rays and the unit of length in its first line, then the same numbers of a ray in a line.

OpticStudio uses neither the fluxes nor location and rotation of the header.  Here the flux is the total of the header
that agrees with the sum of the rays, or else that of this set of rays.
"""

from __future__ import annotations

import struct

import numpy as np

from bstcad.photometry.intensity import Luminaire, PhotometricError
from bstcad.photometry.ray_set import RaySet, scaled
from bstcad.photometry.ray_table import RayTable, Source, bytes_of, plain, rows_of, rows_of_text, stated_or_none
from bstcad.runs.transliteration import transliterate

IDENTIFIERS = 1010, 8675309
HEADER = struct.Struct("<2I100s7fI13f4I")
MILLIMETRES = {0: 1000.0, 1: 25.4, 2: 10.0, 3: 304.8, 4: 1.0}  # units of length: m, inch, cm, foot, mm
FLUX_ONLY, SPECTRAL = 0, 2  # forms of the rays
UNITS = {0: "W", 1: "lm"}
NANOMETRES = 1000.0  # unit of wavelengths, nm
FIRST_LINE = 100  # largest length of the first line of a text


def is_binary(head: bytes) -> bool:
    """Return True if the first bytes of a file are those of the binary form."""
    return int.from_bytes(head[:4], "little") in IDENTIFIERS


def read(source: Source) -> RaySet:
    """Return the rays of a file; PhotometricError if it cannot be used."""
    data = bytes_of(source)
    if not is_binary(data[:4].tobytes()):
        return _of_text(data)
    if len(data) < HEADER.size:
        raise PhotometricError(f"ends in its header, after {len(data)} of {HEADER.size} bytes; it is not complete")
    _, count, description, *numbers = HEADER.unpack_from(data[: HEADER.size].tobytes())
    source_flux, set_flux, wavelength = numbers[:3]
    form, flux_type = numbers[-4:-2]
    if form not in (FLUX_ONLY, SPECTRAL) or flux_type not in UNITS:
        raise PhotometricError(f"has rays of the form {form} in the unit {flux_type}; 0 and 2 in 0 or 1 are known")
    is_placed = any(number != 0 for number in numbers[8:14])
    return RayTable(
        rows_of(data, HEADER.size, count, 8 if form == SPECTRAL else 7),
        UNITS[flux_type],
        wavelength=NANOMETRES * wavelength if 0 < wavelength < np.inf else None,
        wavelengths=7 if form == SPECTRAL else None,
        millimetres=_millimetres(numbers[7]),
        nanometres=NANOMETRES,
        totals=(stated_or_none(set_flux), stated_or_none(source_flux)),
        name=plain(description.split(b"\0")[0].decode("ascii", "replace")),
        remarks=(PLACED,) if is_placed else (),
    ).checked()


PLACED = "The header states a location or a rotation, which is not applied; OpticStudio does not use it either."


def _millimetres(unit: int) -> float:
    if unit not in MILLIMETRES:
        raise PhotometricError(f"has the unit of length {unit}; 0 (m), 1 (inch), 2 (cm), 3 (foot) and 4 (mm) are known")
    return MILLIMETRES[unit]


def _of_text(data: np.ndarray) -> RaySet:
    """Return the rays of a text, in W; PhotometricError if it cannot be used."""
    first, end, _ = data[:FIRST_LINE].tobytes().partition(b"\n")
    words = first.split()
    if not (end and len(words) == 2 and all(word.isdigit() and len(word) < 12 for word in words)):
        raise PhotometricError("is no ray file that is known; give a TM-25, Zemax, Speos or LightTools ray file")
    rows = rows_of_text(data, start=len(first) + 1, end=len(data))
    if len(rows) != int(words[0]):
        raise PhotometricError(f"states {int(words[0])} rays and has {len(rows)}; it is not complete")
    spectral = rows.shape[1] == 8 and bool(rows[:, 7].any())
    return RayTable(
        rows, "W", wavelengths=7 if spectral else None, millimetres=_millimetres(int(words[1])), nanometres=NANOMETRES
    ).checked()


def write(rays: RaySet, luminaire: Luminaire) -> bytes:
    """Return a binary file in mm; wavelengths of single rays are written for powers in W only, as the format has it."""
    own = rays.wavelength if isinstance(rays.wavelength, np.ndarray) and rays.unit == "W" else None
    columns = [rays.position, rays.direction, rays.power[:, None]]
    if own is not None:
        columns.append(scaled(own, 1 / NANOMETRES)[:, None])
    wavelength = rays.wavelength / NANOMETRES if isinstance(rays.wavelength, float) else 0.0
    form = FLUX_ONLY if own is None else SPECTRAL
    head = HEADER.pack(
        IDENTIFIERS[0], len(rays), transliterate(plain(luminaire.name)).encode("ascii")[:99],
        *(rays.flux, rays.flux, wavelength), *(0.0, 180.0, 0.0, 360.0), 4,
        *(0.0,) * 6, *(1.0,) * 3, *(0.0,) * 4, form, int(rays.unit == "lm"), 0, 0,
    )  # fmt: skip
    return head + np.hstack(columns).astype("<f4", copy=False).tobytes()
