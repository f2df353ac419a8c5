"""EULUMDAT files (.ldt), as of the Lichttechnische Gesellschaft, 1990: one value a line.

Intensities are in cd per 1000 lm of the lamps.  Symmetry: 0 none, 1 rotational, 2 about C0-C180, 3 about C90-C270
(planes C270 to C90 over C0 are stated), 4 about both.  A negative number of lamps states absolute photometry.
"""

from __future__ import annotations

import numpy as np

from bstcad.photometry.intensity import (
    MAX_ANGLES,
    MAX_INTENSITIES,
    MAX_NUMBERS,
    SAME_ANGLE,
    TURN,
    Intensity,
    Luminaire,
    PhotometricError,
    checked,
    mirrored,
    symmetry,
)
from bstcad.runs.transliteration import transliterate

FIRST_SET, RATIOS = 26, 10  # line of the first set of lamps, from 0; direct ratios after the sets
LINES_PER_SET, MAX_SETS = 6, 20
KLM = 1000.0  # lm
STATED = {0: (0, 1), 1: (0, None), 2: (0, 2), 3: (3, 2), 4: (0, 4)}  # quarter of the first plane, part of the turn


def read(data: bytes) -> Intensity:
    """Return the intensities of a file; PhotometricError if it cannot be used."""
    text = data.removeprefix(b"\xef\xbb\xbf").decode("latin-1").replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n", MAX_NUMBERS)
    symmetry, planes, angles = (_whole(lines, k) for k in (2, 3, 5))
    if symmetry not in STATED:
        raise PhotometricError(f"has the symmetry {symmetry} in line 3; 0 to 4 are known")
    if not (1 <= planes <= MAX_ANGLES and 2 <= angles <= MAX_ANGLES and planes * angles <= MAX_INTENSITIES):
        raise PhotometricError(f"states {planes} planes of {angles} angles in lines 4 and 6; correct them")
    quarter, part = STATED[symmetry]
    if part and planes % (4 if symmetry >= 3 else part):
        raise PhotometricError(f"has {planes} planes in line 4, which the symmetry {symmetry} does not divide")
    sets = _whole(lines, FIRST_SET - 1)
    if not 1 <= sets <= MAX_SETS:
        raise PhotometricError(f"has {sets} sets of lamps in line {FIRST_SET}; 1 to {MAX_SETS} are possible")
    lamps, lumens = _whole(lines, FIRST_SET), _number(lines, FIRST_SET + 2)
    factor = _number(lines, 23) or 1.0
    if not (lumens > 0 and factor > 0):
        raise PhotometricError("has a flux of the lamps or a factor of the intensities that is not above 0; correct it")
    first = FIRST_SET + LINES_PER_SET * sets + RATIOS
    stated = 1 if part is None else planes if part == 1 else planes // part + 1
    values = _numbers(lines, first, planes + angles + stated * angles)
    around, along = values[:planes], values[planes : planes + angles]
    with np.errstate(over="ignore", invalid="ignore"):  # `checked` refuses infinite intensities
        candela = factor * lumens / KLM * values[planes + angles :].reshape(stated, angles)
    rated = None if lamps < 0 else lumens
    if part is None:
        return checked("C", np.zeros(1), along, candela, rated=rated)
    begin = quarter * planes // 4
    around = np.resize(around, 2 * planes)[begin : begin + stated] if part > 1 else around
    if symmetry == 4:
        around, candela = mirrored(around, candela, 90.0)
    if part > 1:
        around, candela = mirrored(around, candela, 90.0 if symmetry == 3 else 0.0)
    return checked("C", around, along, candela, rated=rated)


CODES = {"none": 0, "rotational": 1, "C0-C180": 2, "C90-C270": 3, "quadrant": 4}
MIN_STEP = 1.0  # smallest step of the planes that are written, degrees


def write(table: Intensity, luminaire: Luminaire, lamp_lumens: float | None = None) -> bytes:
    """Return a file; lamp_lumens: flux of the lamp, to which the intensities refer (None: absolute photometry).

    Planes are at equal steps over the turn, as readers expect; a table with others is interpolated.
    """
    kind, absolute = symmetry(table), lamp_lumens is None
    lumens = table.lumens if lamp_lumens is None else lamp_lumens
    planes = _even(table.around, kind)
    whole = np.arange(planes) * TURN / planes
    first, count = {0: (0, planes), 1: (0, 1), 2: (0, planes // 2 + 1), 3: (3 * planes // 4, planes // 2 + 1),
                    4: (0, planes // 4 + 1)}[CODES[kind]]  # fmt: skip
    stated = table.between((first + np.arange(count))[:, None] * TURN / planes % TURN, table.along[None])
    step = float(np.diff(table.along)[0]) if np.ptp(np.diff(table.along)) < SAME_ANGLE else 0.0
    across, along, height = luminaire.size
    below = Intensity("C", table.around, table.along, candela=np.where(table.along <= 90.0, table.candela, 0.0))
    opening = (across, 0) if luminaire.is_round else (along, across)  # length, width; of a circle: diameter, 0
    numbers = [
        luminaire.maker, 1 if kind == "rotational" else 3, CODES[kind], planes, TURN / planes, len(table.along), step,
        "simulation", luminaire.name, "", f"{luminaire.name}.ldt"[:12], f"{luminaire.date} {luminaire.laboratory}",
        *opening, height, *opening, *4 * (height,),
        100 * below.lumens / table.lumens, 100 * table.lumens / lumens, 1, 0, 1,
        -1 if absolute else 1, luminaire.lamp, lumens, "", "", luminaire.watts, *RATIOS * (0,),
    ]  # fmt: skip
    lines = [_text(value) for value in [*numbers, *whole, *table.along, *(KLM / lumens * stated).ravel()]]
    return ("\r\n".join(lines) + "\r\n").encode("latin-1")


def _even(around: np.ndarray, kind: str) -> int:
    """Return the number of planes at equal steps, a multiple of 4, that resolve the planes of a table."""
    if kind == "rotational":
        return 1
    closest = float(np.diff(np.append(around, around[0] + TURN)).min())
    return 4 * min(int(np.ceil(TURN / max(closest, MIN_STEP) / 4 - SAME_ANGLE)), 90)


def _text(value: float | str) -> str:
    return " ".join(transliterate(value, "latin-1").split())[:78] if isinstance(value, str) else f"{value:.7g}"


def _number(lines: list[str], k: int) -> float:
    """Return the number in line k, from 0; an empty line is 0."""
    text = lines[k].strip().replace(",", ".") if k < len(lines) else None
    if text is None:
        raise PhotometricError(f"ends after {len(lines)} lines; it is not complete")
    try:
        value = float(text or 0.0)
    except ValueError:
        raise PhotometricError(f"has no number in line {k + 1}; give an EULUMDAT file") from None
    if not np.isfinite(value):
        raise PhotometricError(f"has no finite number in line {k + 1}; correct it")
    return value


def _whole(lines: list[str], k: int) -> int:
    value = _number(lines, k)
    if value != int(value):
        raise PhotometricError(f"has {value:g} in line {k + 1}, which must be a whole number; correct it")
    return int(value)


def _numbers(lines: list[str], first: int, count: int) -> np.ndarray:
    """Return so many numbers from line `first` on; some programs write several in a line."""
    text = " ".join(lines[first:]).replace(",", ".").split(maxsplit=count)
    if len(text) < count:
        raise PhotometricError(f"has {len(text)} numbers of {count} angles and intensities; it is not complete")
    try:
        return np.array(text[:count], dtype=np.float64)
    except ValueError:
        raise PhotometricError(f"has something other than a number after line {first}; correct it") from None
