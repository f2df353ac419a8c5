"""Intensity files of the Illuminating Engineering Society, LM-63-1986 to LM-63-2019 (.ies).

After keywords and a line TILT=, the file has numbers: lamps, lumens per lamp (-1: absolute photometry), multiplier,
counts of vertical and horizontal angles, photometric type (1: C, 2: B, 3: A), units, width, length, height, ballast
factor, ballast-lamp factor, watts; the vertical and the horizontal angles; and the intensities, one horizontal angle
after the other.  Intensities are multiplied by the multiplier and both factors.
"""

from __future__ import annotations

import re

import numpy as np

from bstcad.photometry.intensity import (
    MAX_ANGLES,
    MAX_INTENSITIES,
    MAX_NUMBERS,
    SAME_ANGLE,
    Intensity,
    Luminaire,
    PhotometricError,
    checked,
    is_same,
    mirrored,
    symmetry,
)
from bstcad.runs.transliteration import transliterate

Table = tuple[np.ndarray, np.ndarray, np.ndarray]  # horizontal angles, vertical angles, intensities
TYPES = {1: "C", 2: "B", 3: "A"}
HEADER = 13  # numbers before the angles
ABSOLUTE = -1.0  # lumens per lamp of absolute photometry
TILT = re.compile(r"^[ \t]*TILT[ \t]*=[ \t]*(\S+)[ \t]*$", re.MULTILINE | re.IGNORECASE)


def read(data: bytes) -> Intensity:
    """Return the intensities of a file; PhotometricError if it cannot be used."""
    text = data.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\r", "\n")
    tilt = TILT.search(text)
    if tilt is None:
        raise PhotometricError("has no line TILT=; give an IES file (LM-63)")
    numbers = _numbers(text[tilt.end() :])
    if tilt[1].upper() == "INCLUDE":
        pairs = int(_take(numbers, 2)[1])
        numbers = numbers[2 + 2 * pairs :] if 0 <= pairs <= MAX_ANGLES else numbers[:0]
    header = _take(numbers, HEADER)
    lamps, lumens, multiplier = header[:3]
    vertical, horizontal, kind = (_count(value) for value in header[3:6])
    if kind not in TYPES:
        raise PhotometricError(f"has the photometric type {kind}; 1 (C), 2 (B) and 3 (A) are known")
    if not (2 <= vertical <= MAX_ANGLES and 1 <= horizontal <= MAX_ANGLES and vertical * horizontal <= MAX_INTENSITIES):
        raise PhotometricError(f"states {vertical} x {horizontal} angles; give 2 to {MAX_ANGLES} of each")
    # ballast-lamp factor of 1986 and 1991; since then the number is 1, and since 2019 it tells how the file was made
    of_the_lamp = 1.0 if text.lstrip().upper().startswith(LATER) else header[11]
    with np.errstate(over="ignore"):  # infinite products are refused
        factor = multiplier * header[10] * of_the_lamp
        rated = None if lumens == ABSOLUTE else lamps * lumens * header[10]
    if not 0 < factor < np.inf:
        raise PhotometricError("has a multiplier or ballast factor that is not above 0, or is not finite; correct it")
    body = _take(numbers[HEADER:], vertical + horizontal + vertical * horizontal)
    along, around = body[:vertical], body[vertical : vertical + horizontal]
    with np.errstate(over="ignore"):
        candela = factor * body[vertical + horizontal :].reshape(horizontal, vertical)
    return checked(TYPES[kind], *_whole(TYPES[kind], around, along, candela), rated=rated)


LATER = "IESNA:LM-63-1995", "IESNA:LM-63-2002", "IES:LM-63"  # first lines of files since 1995
SPANS = {"rotational": 0.0, "quadrant": 90.0, "C0-C180": 180.0, "C90-C270": 360.0, "none": 360.0}  # last C stated
LINE = 130  # largest length of a line of numbers
VERSIONS = {"2002": "IESNA:LM-63-2002", "2019": "IES:LM-63-2019"}


def write(table: Intensity, luminaire: Luminaire, version: str = "2002", lamp_lumens: float | None = None) -> bytes:
    """Return a file of type C that states the planes which the table's symmetry needs.

    lamp_lumens: flux of the lamp to which the intensities refer; None: absolute photometry, stated as -1.  In
    LM-63-2019 the number 1.00010 tells that the file comes from a simulation.
    """
    span = SPANS[symmetry(table)]
    inside = table.around[(table.around > SAME_ANGLE) & (table.around < span - SAME_ANGLE)]
    planes = np.concatenate([[0.0], inside, [span]]) if span else np.zeros(1)
    candela = table.between(planes[:, None], table.along[None])
    length, width, height = (side / 1000 for side in luminaire.size)  # C = 0 is along the length
    opening = (-width, -width, height) if luminaire.is_round else (width, length, height)  # negative: round
    keywords = {
        "TEST": "simulation", "TESTLAB": luminaire.laboratory, "ISSUEDATE": luminaire.date,
        "MANUFAC": luminaire.maker, "LUMCAT": luminaire.name, "LUMINAIRE": luminaire.name, "LAMP": luminaire.lamp,
    }  # fmt: skip
    lines = [VERSIONS[version], *(f"[{key}] {_plain(text)}" for key, text in keywords.items()), "TILT=NONE"]
    lumens = -1 if lamp_lumens is None else lamp_lumens
    lines.append(f"1 {lumens:g} 1 {len(table.along)} {len(planes)} 1 2 {' '.join(f'{side:.6g}' for side in opening)}")
    lines.append(f"1 {'1' if version == '2002' else '1.00010'} {luminaire.watts:.6g}")
    for row in (table.along, planes, *candela):
        lines += _wrapped(row)
    return ("\r\n".join(lines) + "\r\n").encode("ascii")


def _plain(text: str) -> str:
    """Return a text in ASCII, of one line."""
    return " ".join(transliterate(text).split())


def _wrapped(numbers: np.ndarray) -> list[str]:
    """Return numbers as lines of at most LINE characters."""
    lines: list[str] = []
    line = ""
    for text in (f"{number:.7g}" for number in numbers):
        if line and len(line) + 1 + len(text) > LINE:
            lines, line = [*lines, line], ""
        line = f"{line} {text}".lstrip()
    return [*lines, line]


def _whole(kind: str, around: np.ndarray, along: np.ndarray, candela: np.ndarray) -> Table:
    """Return the angles and intensities of the full turn, or of both sides, by the symmetry of the angles stated."""
    if kind != "C":
        if abs(around[0]) < SAME_ANGLE and len(around) > 1:  # one side of the vertical plane
            around, candela = np.append(-around[:0:-1], around), np.vstack([candela[:0:-1], candela])
        return around, along, candela
    if len(around) == 1:
        return np.zeros(1), along, candela
    if is_same(around, 0.0, 90.0):
        around, candela = mirrored(around, candela, 0.0)
        around, candela = mirrored(around, candela, 90.0)
    elif is_same(around, 0.0, 180.0):
        around, candela = mirrored(around, candela, 0.0)
    elif is_same(around, 90.0, 270.0):
        around, candela = mirrored(around, candela, 90.0)
    return around, along, candela


def _numbers(text: str) -> np.ndarray:
    text = text.rstrip("\x1a\0 \n")  # end of a file under DOS
    most = 2 * MAX_NUMBERS  # largest count of numbers, with those of TILT=INCLUDE
    try:
        return np.array(text.replace(",", " ").split(maxsplit=most)[:most], dtype=np.float64)
    except ValueError:
        raise PhotometricError("has something other than a number after the line TILT=; correct it") from None


def _take(numbers: np.ndarray, count: int) -> np.ndarray:
    if len(numbers) < count:
        raise PhotometricError(f"ends after {len(numbers)} numbers of {count}; it is not complete")
    if not np.isfinite(numbers[:count]).all():
        raise PhotometricError("has a number that is not finite; correct it")
    return numbers[:count]


def _count(value: float) -> int:
    if value != int(value):
        raise PhotometricError(f"has the count {value:g}, which is not a whole number; correct it")
    return int(value)
