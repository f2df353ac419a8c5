"""G-code of a raster for controllers with three axes: millimetres, absolute, G0 and G1 only, for Grbl and LinuxCNC.

Rapid moves (G0) run at the safe height only, straight up, and across.  Each pass begins with a plunge (G1) at a third
of the feed.  A coordinate that does not change is omitted.  Comments are in parentheses, in ASCII, with at most 70
characters a line, since Grbl reads at most 80.  Spindle, coolant and tool change are left to the user, since routers
differ in them.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence

import numpy as np

from bstcad.toolpath import chords
from bstcad.toolpath.raster import PLUNGE, SAFE_HEIGHT, Raster

LINE = 66  # largest number of characters of a comment
SIGNS = str.maketrans({"(": "[", ")": "]", "µ": "u", "°": " degrees", "×": "x", "−": "-", ";": ",", "\u202f": " "})


def gcode(path: Raster, heading: Sequence[str]) -> str:
    """Return the G-code of a raster; heading: sentences on tool, stock, zero point and time."""
    places = chords.digits(path.cutting.finish[1])
    lines = [*_comments(heading), "G21", "G90", "G94", "G17", f"G0 Z{SAFE_HEIGHT:g}"]
    rough = None
    for each in path.passes:
        if each.rough is not rough:
            rough = each.rough
            lines += _comments(["Roughing" if rough else "Finish"])
        lines += _moves(np.round(each.points, places), path.cutting.speed, places)
    lines += [f"G0 Z{SAFE_HEIGHT:g}", "G0 X0 Y0", "M2", ""]
    return "\n".join(lines)


def _comments(sentences: Sequence[str]) -> Iterator[str]:
    for sentence in sentences:
        text = sentence.translate(SIGNS).encode("ascii", "replace").decode()
        yield from (f"({part})" for part in textwrap.wrap(text, LINE))


def _moves(points: np.ndarray, feed: float, places: int) -> Iterator[str]:
    """Yield the lines of one pass: rapid to its start, plunge, feed to its end, rapid up."""
    x, y, z = points[0]
    yield f"G0 X{_number(x, places)} Y{_number(y, places)}"
    yield f"G1 Z{_number(z, places)} F{PLUNGE * feed:.5g}"
    changed = np.diff(points, axis=0) != 0
    text = [
        [f"{axis}{_number(value, places)}" for value in column]
        for axis, column in zip("XYZ", points[1:].T, strict=True)
    ]
    first = f" F{feed:.5g}"
    for k in np.flatnonzero(changed.any(1)):
        yield "G1 " + " ".join(text[axis][k] for axis in range(3) if changed[k, axis]) + first
        first = ""
    yield f"G0 Z{SAFE_HEIGHT:g}"


def _number(value: float, places: int) -> str:
    """Return a coordinate (mm) without needless zeros."""
    text = f"{value:.{places}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
