"""Ray files of the Illuminating Engineering Society, IES TM-25-13 (.tm25ray).

Numbers are little-endian and have 32 bits; the number of rays has 64.  Byte 0: "TM25", version 2013, method of
creation (0: simulation), luminous flux (lm), radiant flux (W), number of rays, date (28 bytes, ISO 8601), start of the
rays, kind of the spectrum (0: none, 1: one wavelength, 2: one per ray, 3: one spectrum, 4: a spectrum's number per
ray), wavelength, smallest and largest wavelength (nm), numbers of spectra and of further columns, bytes of further
text.  Byte 256: eight flags, 1 for data that the rays have: position, direction, radiant flux, wavelength, luminous
flux, Stokes vector, tristimulus values, number of a spectrum.  Byte 288: nine texts of 1000 characters in UTF-32.
Byte 36288: the spectra, each a number of pairs and the pairs (wavelength, value), filled up to a multiple of 32 bytes;
names of further columns, 512 bytes each; further text.  Then the rays: position (mm), direction cosines, and the data
of the flags in this order (Stokes vector: six numbers with the axis; tristimulus values: X and Z, since Y is the
luminous flux), and the further columns.

A flux that is not known is a signalling NaN; 0 is found, too.
"""

from __future__ import annotations

import struct

import numpy as np

from bstcad.photometry.intensity import Luminaire, PhotometricError
from bstcad.photometry.ray_set import RaySet
from bstcad.photometry.ray_table import RayTable, Source, bytes_of, plain, rows_of, stated_or_none

MAGIC, VERSION = b"TM25", 2013
HEADER = struct.Struct("<4s2i2fQ28s2i3f3i168x8i")  # numbers before the texts
TEXTS, CHARACTERS = 9, 1000  # number of texts, and of characters of each
FIXED_SIZE = HEADER.size + 4 * TEXTS * CHARACTERS  # bytes before the spectra
MAX_TABLES = 1000  # largest numbers of spectra and of further columns of a file
NAME_SIZE, BLOCK_SIZE = 512, 32  # bytes of the name of a column; bytes of which the spectra have a multiple
ONE_WAVELENGTH, WAVELENGTH_PER_RAY, ONE_SPECTRUM, SPECTRUM_PER_RAY = 1, 2, 3, 4  # kinds of the spectrum
UNKNOWN_BITS = b"\x01\x00\x80\x7f"  # signalling NaN
FLUXES, WAVELENGTHS = 12, 64  # bytes at which luminous and radiant flux, and the three wavelengths, begin


def read(source: Source) -> RaySet:
    """Return the rays of a file, in lm where it has luminous flux; PhotometricError if it cannot be used.

    A spectrum is read as its mean wavelength.
    """
    data = bytes_of(source)
    head = data[:FIXED_SIZE].tobytes()
    if len(head) < FIXED_SIZE:
        raise PhotometricError(f"ends in its header, after {len(head)} of {FIXED_SIZE} bytes; it is not complete")
    magic, version, _, lumens, watts, count, _, _, kind, wavelength, _, _, *rest = HEADER.unpack_from(head)
    (spectra, further, text), flags = rest[:3], rest[3:]
    if magic != MAGIC or version != VERSION:
        raise PhotometricError("does not begin with TM25 and the version 2013; give a TM-25 ray file")
    if any(flag not in (0, 1) for flag in flags) or not (flags[0] and flags[1]):
        raise PhotometricError("states no position or no direction of its rays; write the file again")
    _, _, has_watts, has_wavelength, has_lumens, has_stokes, has_colour, has_spectrum = flags
    if not (has_watts or has_lumens):
        raise PhotometricError("states no flux of its rays; write the file with radiant or luminous flux")
    if not (0 <= spectra <= MAX_TABLES and 0 <= further <= MAX_TABLES and text >= 0):
        raise PhotometricError(f"states {spectra} spectra and {further} further columns; at most {MAX_TABLES} are read")
    means, end = _spectra(data, spectra)
    columns = 6 + has_watts + has_wavelength + has_lumens + 6 * has_stokes + 2 * has_colour + has_spectrum + further
    total_lumens, total_watts = stated_or_none(lumens), stated_or_none(watts)
    luminous = has_lumens and not (has_watts and total_lumens is None and total_watts is not None)
    of_spectrum = has_spectrum and kind == SPECTRUM_PER_RAY and len(means) > 0
    return RayTable(
        rows_of(data, end + NAME_SIZE * further + text, count, columns),
        unit="lm" if luminous else "W",
        power=6 + has_watts + has_wavelength if luminous else 6,
        wavelength=_wavelength(kind, wavelength, means),
        wavelengths=6 + has_watts if has_wavelength else columns - further - 1 if of_spectrum else None,
        spectra=means if of_spectrum and not has_wavelength else None,
        totals=(total_lumens,) if luminous else (total_watts,),
        lumens=total_lumens,
        name=plain(head[HEADER.size : HEADER.size + 4 * CHARACTERS].decode("utf-32-le", "replace").split("\0")[0]),
    ).checked()


def _wavelength(kind: int, stated: float, means: np.ndarray) -> float | None:
    """Return the wavelength of all rays, nm; None: not stated."""
    if kind == ONE_SPECTRUM and len(means):
        return float(means[0])
    if kind == ONE_WAVELENGTH and 0 < stated < np.inf:
        return float(stated)
    return None


def _spectra(data: np.ndarray, number: int) -> tuple[np.ndarray, int]:
    """Return the mean wavelengths of the spectra, nm, and the byte at which the spectra end."""
    at, means = FIXED_SIZE, np.empty(number, np.float32)
    for k in range(number):
        pairs = int.from_bytes(data[at : at + 4].tobytes(), "little", signed=True)
        at += 4
        if not 1 <= pairs <= (len(data) - at) // 8:
            raise PhotometricError(f"states a spectrum of {pairs} wavelengths; it is not complete")
        table = data[at : at + 8 * pairs].view("<f4").reshape(pairs, 2).astype(np.float64)
        at += 8 * pairs
        wavelength, value = table.T
        if not (
            np.isfinite(table).all() and wavelength[0] > 0 and (np.diff(wavelength) > 0).all() and (value >= 0).all()
        ):
            raise PhotometricError(
                "has a spectrum with wavelengths that do not ascend, or a negative value; correct it"
            )
        light = np.trapezoid(value, wavelength)
        means[k] = np.trapezoid(value * wavelength, wavelength) / light if light > 0 else wavelength.mean()
    return means, at + -(at - FIXED_SIZE) % BLOCK_SIZE


def write(rays: RaySet, luminaire: Luminaire, details: str = "none") -> bytes:
    """Return a file with the rays of a simulation; details: further information for a reader, of one line.

    Wavelengths of single rays are written for powers in W only; the format has none besides luminous flux.
    """
    is_luminous = rays.unit == "lm"
    own = isinstance(rays.wavelength, np.ndarray) and not is_luminous
    kind = WAVELENGTH_PER_RAY if own else ONE_WAVELENGTH if isinstance(rays.wavelength, float) else 0
    flags = 1, 1, int(not is_luminous), int(own), int(is_luminous), 0, 0, 0
    date = luminaire.date.encode("ascii", "replace")[:28]
    head = bytearray(HEADER.pack(MAGIC, VERSION, 0, 0, 0, len(rays), date, 0, kind, 0, 0, 0, 0, 0, 0, *flags))
    flux = struct.pack("<f", rays.flux)
    head[FLUXES : FLUXES + 8] = flux + UNKNOWN_BITS if is_luminous else UNKNOWN_BITS + flux
    wavelengths = [UNKNOWN_BITS] * 3
    columns = [rays.position, rays.direction, rays.power[:, None]]
    if kind == ONE_WAVELENGTH:
        wavelengths[0] = struct.pack("<f", rays.wavelength)
    elif isinstance(rays.wavelength, np.ndarray) and own:
        wavelengths[1:] = struct.pack("<f", rays.wavelength.min()), struct.pack("<f", rays.wavelength.max())
        columns.append(rays.wavelength[:, None])
    head[WAVELENGTHS : WAVELENGTHS + 12] = b"".join(wavelengths)
    texts = (
        luminaire.name, luminaire.maker, luminaire.laboratory, luminaire.laboratory, "bstcad", "none", luminaire.lamp,
        details, "none",
    )  # fmt: skip
    written = b"".join(_padded(text) for text in texts)
    return bytes(head) + written + np.hstack(columns).astype("<f4", copy=False).tobytes()


def _padded(text: str) -> bytes:
    """Return a text in UTF-32, filled up with zeros."""
    return plain(text)[: CHARACTERS - 1].encode("utf-32-le").ljust(4 * CHARACTERS, b"\0")
