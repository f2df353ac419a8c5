"""Ray data files of LightTools (.ray), binary and as text.

The binary form, little-endian with numbers of 32 bits, begins with "LTRF", version (3: polarised) and minor version,
kind of the flux (0: W, 1: lm), 1 for rays without positions, kind of colour (0: none, 1: tristimulus values, 2:
wavelengths), unit of length, origin (three numbers) and total flux; rays are position, direction cosines, power, and
the wavelength (nm) where it is stated; "LTRFEND" ends the file.

The text states the same facts in lines "lt_key: value"; the rays stand between the lines lt_startofdata and
lt_endofdata.

Powers are taken as relative: in files of LightTools their mean, not their sum, is the total flux.
"""

from __future__ import annotations

import re
import struct

import numpy as np

from bstcad.photometry.intensity import PhotometricError
from bstcad.photometry.ray_set import RaySet
from bstcad.photometry.ray_table import RayTable, Source, bytes_of, plain, rows_of, rows_of_text, stated_or_none

MAGIC, END = b"LTRF", b"LTRFEND"
HEADER = struct.Struct("<4s6I4f")
# unit of length by number and by word, mm; 0, "system": the unit of the program, which the file does not state
MILLIMETRES = {0: 1.0, 1: 1.0, 2: 10.0, 3: 1000.0, 4: 25.4, 5: 304.8, 6: 1e-3, 7: 1e-6}
UNITS_OF_LENGTH = "system", "millimeters", "centimeters", "meters", "inches", "feet", "microns", "nanometers"
NO_COLOUR, WITH_WAVELENGTHS = 0, 2  # kinds of colour
KEY = re.compile(rb"^(lt_\w+|dataname):[ \t]*(.*?)[ \t\r]*$", re.MULTILINE)
START, STOP = b"lt_startofdata", b"lt_endofdata"
TEXT_HEADER = 1 << 14  # bytes within which the list of rays begins
NO_UNIT = "The file does not state its unit of length; millimetres are assumed."
ORIGIN = "The file states an origin, which is not added to the positions of its rays."


def is_binary(head: bytes) -> bool:
    """Return True if the first bytes of a file are those of the binary form."""
    return head[:4] == MAGIC


def is_text(head: bytes) -> bool:
    """Return True if the first bytes of a file are those of a text."""
    return b"lt_rdf_version" in head


def read(source: Source) -> RaySet:
    """Return the rays of a file; PhotometricError if it cannot be used."""
    data = bytes_of(source)
    head = data[:TEXT_HEADER].tobytes()
    if not is_binary(head):
        return _of_text(source, head)
    if len(head) < HEADER.size + len(END) or data[-len(END) :].tobytes() != END:
        raise PhotometricError("does not end with LTRFEND; it is not complete")
    _, version, _, kind, is_far, colour, length, *origin, flux = HEADER.unpack_from(head)
    if is_far or version > 2 or colour not in (NO_COLOUR, WITH_WAVELENGTHS) or kind > 1:
        raise PhotometricError(UNKNOWN_FORM)
    columns = 8 if colour == WITH_WAVELENGTHS else 7
    data = data[: -len(END)]
    count = (len(data) - HEADER.size) // (4 * columns)
    return _table(
        rows_of(data, HEADER.size, count, columns), unit="lm" if kind else "W", length=length, flux=flux, origin=origin
    ).checked()


UNKNOWN_FORM = "has polarised rays, tristimulus values or no positions; export it with positions, without polarisation"


def _of_text(source: Source, head: bytes) -> RaySet:
    """Return the rays of a text; PhotometricError if it cannot be used."""
    data = bytes_of(source)
    begin = head.find(START)
    end = data[-TEXT_HEADER:].tobytes().rfind(STOP)
    if not is_text(head) or begin < 0 or end < 0:
        raise PhotometricError("has no lines lt_startofdata and lt_endofdata; it is not complete")
    keys = {key.decode(): value.decode("ascii", "replace") for key, value in KEY.findall(head[:begin])}
    kind, colour = keys.get("lt_datatype", ""), keys.get("lt_color_info", "none")
    if keys.get("lt_far_field_data", "no") != "no" or colour not in ("none", "wavelength"):
        raise PhotometricError(UNKNOWN_FORM)
    length = keys.get("lt_length_units", "system")
    try:
        origin = [float(word) for word in keys.get("lt_data_origin", "").split()]
        flux = float(keys.get("lt_radiant_flux", keys.get("lt_luminous_flux", "nan")))
    except ValueError:
        raise PhotometricError("states an origin or a flux that is no number; correct it") from None
    rows = rows_of_text(data, begin + len(START), len(data) - min(len(data), TEXT_HEADER) + end)
    if len(rows) and (rows.shape[1] == 8) != (colour == "wavelength"):
        raise PhotometricError(f"has rays of {rows.shape[1]} numbers, against its line lt_color_info; correct it")
    return _table(
        rows, unit="lm" if kind.startswith("luminous") else "W", flux=flux, origin=origin,
        length=UNITS_OF_LENGTH.index(length) if length in UNITS_OF_LENGTH else -1, name=keys.get("dataname", ""),
    ).checked()  # fmt: skip


def _table(rows: np.ndarray, unit: str, length: int, flux: float, origin: list[float], name: str = "") -> RayTable:
    """Return the rays with the facts of a header; length: number of the unit of length."""
    if length not in MILLIMETRES:
        raise PhotometricError("has a unit of length that is not known; export it in millimeters")
    return RayTable(
        rows, unit, wavelengths=7 if rows.shape[1] == 8 else None, millimetres=MILLIMETRES[length],
        totals=(stated_or_none(flux),), lumens=stated_or_none(flux) if unit == "lm" else None, is_relative=True,
        name=plain(name), remarks=(*[NO_UNIT] * (length == 0), *[ORIGIN] * any(origin)),
    )  # fmt: skip
