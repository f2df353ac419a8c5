"""Technical drawing in millimetres of paper: lines, fitted text, dimensions, the symbol of the projection.

Lines, arrows and dimensions after ISO 128 and ISO 129-1, in black, so that a copy of a copy can be read.  Drawn by
matplotlib: the drawing add-on of ezdxf 1.4.5, which renders DIMENSION entities on such a page, fills the hole of "Ø"
and turns letters into curves, so that nobody can search the page or copy the SHA-256 from it.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bstcad.report.drawing import GREY, STYLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

POINT = 25.4 / 72  # mm
THICK, THIN = 0.5, 0.18  # mm; visible edges, all other lines
ARROW, SLIM = 2.2, 0.36  # mm: length of an arrow's head, and half its width
OVER = 1.2  # mm by which an extension line exceeds its dimension line
OFF = 0.7  # mm between a line and its text, or the part and its extension line
TAIL = 4.5  # mm of a dimension line beyond the measured length
LETTERS = 2.5  # mm, of dimensions
NOTES = 2.1  # mm, of leaders and notes
CHAIN = (0, (14, 2.5, 2, 2.5))  # of a centre line, in its widths
FAMILY = STYLE["font.family"]
UNKNOWN = "\u25a1"  # a box, for a letter that the font lacks

Point = tuple[float, float]  # x, y (mm)


@dataclass(frozen=True, eq=False)
class Paper:
    """A sheet of paper; every coordinate in mm from its lower left corner."""

    axes: Axes

    @classmethod
    def of(cls, figure: Figure) -> Paper:
        """The whole figure as paper."""
        width, height = (inches * 25.4 for inches in figure.get_size_inches())
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.set(xlim=(0, width), ylim=(0, height), autoscale_on=False)
        return cls(axes)

    def line(self, points: Sequence[Any], width: float = THIN, **style: Any) -> None:
        """A line through points (x, y)."""
        given = {"color": "black", "solid_capstyle": "butt", "dash_capstyle": "butt", "solid_joinstyle": "miter"}
        self.axes.plot(*np.asarray(points, dtype=float).T, linewidth=width / POINT, **(given | style))

    def axis(self, start: Point, end: Point) -> None:
        """A centre line."""
        self.line([start, end], linestyle=CHAIN, color=GREY, zorder=1.5)

    def area(self, points: Sequence[Any], **style: Any) -> None:
        """A filled polygon without an edge."""
        self.axes.fill(*np.asarray(points, dtype=float).T, **({"linewidth": 0} | style))

    def text(
        self, x: float, y: float, text: str, size: float = LETTERS, *, room: float | None = None, **style: Any
    ) -> None:
        """Text with an em of `size` mm; made smaller, then cut, where `room` (mm) is too narrow for it."""
        text = drawable(text)
        if room is not None:
            text, size = fitted(text, size, room, style.get("weight") == "bold")
        self.axes.text(x, y, text, fontsize=size / POINT, parse_math=False, **({"va": "baseline"} | style))

    def arrow(self, tip: Point, towards: Point, color: str = "black", **style: Any) -> None:
        """A slim filled head at `tip` that points along `towards`, a unit vector."""
        ahead, aside = ARROW * np.array(towards), SLIM * np.array([-towards[1], towards[0]])
        self.area([tip, tip - ahead + aside, tip - ahead - aside], color=color, **style)

    def dimension(
        self, ends: tuple[float, float], level: float, feet: tuple[float, float], text: str, upright: bool = False
    ) -> None:
        """A dimension along x between two ends, its line at y = level; upright: along y at x = level, read from right.

        feet: y (upright: x) of the part at these ends.
        """

        def at(along: float, beside: float) -> Point:
            return (beside, along) if upright else (along, beside)

        low, high = ends
        for end, foot in zip(ends, feet, strict=True):
            sense = np.sign(level - foot)
            self.line([at(end, foot + sense * OFF), at(end, level + sense * OVER)])
        wide, gap = width_of(text, LETTERS), high - low
        within, tail = (1, 0.0) if gap >= 2 * ARROW + 1 else (-1, TAIL)  # arrows from inside or from outside
        self.line([at(low - tail, level), at(high + tail, level)])
        self.arrow(at(low, level), at(-within, 0))
        self.arrow(at(high, level), at(within, 0))
        turned = {"rotation": 90, "rotation_mode": "anchor"} if upright else {}
        above = level - OFF if upright else level + OFF
        if gap >= wide + 1:
            self.text(*at((low + high) / 2, above), text, ha="center", **turned)
        else:  # on a shelf behind the upper end
            self.line([at(high, level), at(high + ARROW + 1 + wide, level)])
            self.text(*at(high + ARROW + 1, above), text, ha="left", **turned)

    def leader(self, tip: Point, to: Point, text: str, sense: int) -> None:
        """A note on a shelf that begins at `to` and runs to the right (sense 1) or left (-1), its arrow at `tip`."""
        (x, y), ahead = to, np.subtract(tip, to)
        self.line([tip, to, (x + sense * (width_of(text, NOTES) + 1.0), y)])
        self.arrow(tip, tuple(ahead / max(np.hypot(*ahead), 1e-9)))
        ground = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}  # covers extension lines
        self.text(x + 0.5 * sense, y + OFF, text, NOTES, ha="left" if sense > 0 else "right", bbox=ground)

    def first_angle(self, x: float, y: float, size: float) -> None:
        """The symbol of first-angle projection (ISO 5456-2): a cone's frustum, and the view from its left beside it."""
        half, end = size / 2, x + 1.4 * size
        centre = end + 0.4 * size + half
        self.line([(x, y - half / 2), (end, y - half), (end, y + half), (x, y + half / 2), (x, y - half / 2)], 0.3)
        turn = np.linspace(0, 2 * np.pi, 73)
        for radius in (half / 2, half):
            self.line(np.stack([centre + radius * np.cos(turn), y + radius * np.sin(turn)], axis=1), 0.3)
        self.axis((x - 1, y), (end + 1, y))
        self.axis((centre - half - 1, y), (centre + half + 1, y))
        self.axis((centre, y - half - 1), (centre, y + half + 1))


def drawable(text: str) -> str:
    """The text with a box for every letter that the font lacks, which every machine has."""
    return "".join(c if ord(c) in _letters() else UNKNOWN for c in text)


@functools.cache
def _letters() -> frozenset[int]:
    from matplotlib.font_manager import findfont, get_font

    return frozenset(get_font(findfont(FAMILY)).get_charmap())


def width_of(text: str, size: float, bold: bool = False) -> float:
    """Width (mm) of a line of text whose em is `size` mm."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(family=FAMILY, size=size, weight="bold" if bold else "normal")
    return text_to_path.get_text_width_height_descent(text, font, False)[0] if text else 0.0


def fitted(text: str, size: float, room: float, bold: bool = False, least: float = 0.8) -> tuple[str, float]:
    """(text, size) for a room of that width (mm): down to `least` of its size, then cut at its end."""
    size = max(least * size, min(size, size * room / max(width_of(text, size, bold), 1e-9)))
    if width_of(text, size, bold) <= room * (1 + 1e-9):
        return text, size
    while text and width_of(f"{text}\u2026", size, bold) > room:
        text = text[:-1]
    return f"{text.rstrip()}\u2026", size


def wrapped(text: str, size: float, room: float, most: int) -> list[str]:
    """The text in at most `most` lines of that width (mm), broken between words; the last line is cut."""
    lines = [""]
    for word in drawable(text).split():
        longer = f"{lines[-1]} {word}".strip()
        if len(lines) == most or longer == word or width_of(longer, size) <= room:
            lines[-1] = longer
        else:
            lines.append(word)
    return [fitted(line, size, room, least=1.0)[0] for line in lines]
