"""G-code of a raster for controllers with three axes: absolute coordinates, G0 and G1 only, for Grbl and LinuxCNC.

Lengths are in millimetres or inches.  Rapid moves (G0, or G1 with a feed for controllers without G0) run at the safe
height only, straight up, and across.  Each pass begins with a plunge (G1) straight down at a third of the feed; moves
along the face have the full feed, also where the face falls.  A coordinate that does not change is omitted.  Comments
are in parentheses, in ASCII, with at most 70 characters a line, since Grbl reads at most 80.  They have no real-time
characters of Grbl, which act even inside a comment: ! holds the feed, ~ resumes, and ? asks for the state.  Spindle,
coolant and tool change are left to the user, since routers differ in them.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bstcad.runs.transliteration import transliterate
from bstcad.toolpath import chords
from bstcad.toolpath.cutting import Cutting
from bstcad.toolpath.raster import PLUNGE, RAPID_FEED, SAFE_HEIGHT, Raster

LINE = 66  # largest number of characters of a comment
SIGNS = str.maketrans(
    {"(": "[", ")": "]", ";": ",", "!": ".", "?": ".", "~": "-"}
)  # signs that end or act in a comment
COMMAND = re.compile(r"^(\w+),")  # word and comma that begin an active comment of LinuxCNC, such as LOGOPEN
UNITS = {"mm": ("G21", 1.0), "inch": ("G20", 1 / 25.4)}  # command of a unit of length, and its number per mm


@dataclass(frozen=True)
class Writer:
    """Writer of moves in a unit and with a number of decimals."""

    cutting: Cutting  # completed settings

    @property
    def scale(self) -> float:
        """Units per mm."""
        return UNITS[self.cutting.units][1]

    @property
    def rapid(self) -> str:
        """Command of rapid moves."""
        return "G0" if self.cutting.rapid == "G0" else f"G1 {self.feed(RAPID_FEED)}"

    @property
    def places(self) -> int:
        """Number of decimals of a coordinate."""
        return chords.digits(self.cutting.finish[1] * self.scale)

    def feed(self, speed: float) -> str:
        """Return the word of a feed (mm/min)."""
        return f"F{speed * self.scale:.5g}"

    def number(self, value: float) -> str:
        """Return a coordinate, in the unit of the file, without needless zeros."""
        text = f"{value:.{self.places}f}".rstrip("0").rstrip(".")
        return "0" if text in ("-0", "") else text

    def moves(self, points: np.ndarray, safe: str) -> Iterator[str]:
        """Yield the lines of one pass (n, 3) in mm: rapid to its start, plunge, feed to its end, rapid up."""
        points = np.round(points * self.scale, self.places)
        x, y, z = points[0]
        yield f"{self.rapid} X{self.number(x)} Y{self.number(y)}"
        yield f"G1 Z{self.number(z)} {self.feed(PLUNGE * self.cutting.speed)}"
        changed = np.diff(points, axis=0) != 0
        text = [
            [f"{axis}{self.number(value)}" for value in column]
            for axis, column in zip("XYZ", points[1:].T, strict=True)
        ]
        first = f" {self.feed(self.cutting.speed)}"
        for k in np.flatnonzero(changed.any(1)):
            yield "G1 " + " ".join(text[axis][k] for axis in range(3) if changed[k, axis]) + first
            first = ""
        yield safe


def gcode(path: Raster, heading: Sequence[str]) -> str:
    """Return the G-code of a raster; heading: sentences on tool, blank, zero point and time."""
    writer, lift = Writer(path.cutting), (0.0, 0.0, path.lift)
    safe = f"{writer.rapid} Z{writer.number((SAFE_HEIGHT + path.lift) * writer.scale)}"
    lines = [*_comments(heading), UNITS[path.cutting.units][0], "G90", "G94", "G17", safe]
    rough = None
    for each in path.passes:
        if each.rough is not rough:
            rough = each.rough
            lines += _comments(["Roughing" if rough else "Finish"])
        lines += writer.moves(each.points + lift, safe)
    lines += [safe, f"{writer.rapid} X0 Y0", "M2", ""]
    return "\n".join(lines)


def _comments(sentences: Sequence[str]) -> Iterator[str]:
    for sentence in sentences:
        parts = textwrap.wrap(transliterate(sentence).translate(SIGNS), LINE)
        yield from ("(" + COMMAND.sub(r"\1 -", part) + ")" for part in parts)
