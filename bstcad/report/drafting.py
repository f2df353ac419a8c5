"""Technical drawing in millimetres of paper: lines, fitted text, dimensions, the symbol of the projection.

Lines, arrows and dimensions in the manner of ISO 128 and ISO 129-1, in black, so that a copy of a copy can be read.
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
THICK, THIN = 0.5, 0.18  # mm; visible edges, everything else
ARROW, SLIM = 2.2, 0.36  # mm: length of an arrow's head, and half its width
OVER = 1.2  # mm by which an extension line goes on behind its dimension line
OFF = 0.7  # mm between a line and its text, or the part and its extension line
TAIL = 4.5  # mm of a dimension line outside of what it measures
LETTERS = 2.5  # mm, of dimensions
NOTES = 2.1  # mm, of what leaders call
CHAIN = (0, (14, 2.5, 2, 2.5))  # of a centre line, in its widths
FAMILY = STYLE["font.family"]
UNKNOWN = "\u25a1"  # a box, for a letter that the font does not have


@dataclass(frozen=True, eq=False)
class Paper:
    """A sheet of paper; every coordinate in mm from its lower left corner."""

    axes: Axes

    @classmethod
    def of(cls, figure: Figure) -> Paper:
        """All of a figure."""
        width, height = (inches * 25.4 for inches in figure.get_size_inches())
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.set(xlim=(0, width), ylim=(0, height))
        axes.set_autoscale_on(False)
        return cls(axes)

    def line(self, points: Sequence[Any], width: float = THIN, **style: Any) -> None:
        """A line through points (x, y)."""
        x, y = np.asarray(points, dtype=float).T
        given = {"color": "black", "solid_capstyle": "butt", "dash_capstyle": "butt", "solid_joinstyle": "miter"}
        self.axes.plot(x, y, linewidth=width / POINT, scalex=False, scaley=False, **(given | style))

    def area(self, points: Sequence[Any], **style: Any) -> Any:
        """A filled polygon without an edge."""
        return self.axes.fill(*np.asarray(points, dtype=float).T, **({"color": "black", "linewidth": 0} | style))[0]

    def box(self, left: float, low: float, right: float, high: float, width: float = THIN) -> None:
        """The edges of a rectangle."""
        self.line([(left, low), (right, low), (right, high), (left, high), (left, low), (right, low)], width)

    def text(
        self, x: float, y: float, text: str, size: float = LETTERS, room: float | None = None, **style: Any
    ) -> None:
        """Text with an em of `size` mm; made smaller, then cut, where `room` (mm) is too narrow for it."""
        bold = style.get("weight") == "bold"
        text = drawable(text)
        if room is not None:
            text, size = fitted(text, size, room, bold)
        self.axes.text(x, y, text, fontsize=size / POINT, parse_math=False, **({"va": "baseline"} | style))

    def arrow(self, tip: tuple[float, float], towards: tuple[float, float]) -> None:
        """A slim filled head at `tip` that points along `towards`, a unit vector."""
        (x, y), (a, b) = tip, towards
        foot_x, foot_y = x - ARROW * a, y - ARROW * b
        self.area([tip, (foot_x - SLIM * b, foot_y + SLIM * a), (foot_x + SLIM * b, foot_y - SLIM * a)])

    def across(self, ends: tuple[float, float], level: float, feet: tuple[float, float], text: str) -> None:
        """A dimension along x between two ends, its line at y = level; feet: the y at which the part has these ends."""
        self._dimension(ends, level, feet, text, upright=False)

    def upright(self, ends: tuple[float, float], level: float, feet: tuple[float, float], text: str) -> None:
        """A dimension along y between two ends, its line at x = level, read from the right."""
        self._dimension(ends, level, feet, text, upright=True)

    def leader(self, tip: tuple[float, float], to: tuple[float, float], text: str, sense: int) -> None:
        """A note on a shelf that begins at `to` and runs to the right (sense 1) or left (-1), its arrow at `tip`."""
        x, y = to
        away = np.subtract(to, tip)
        self.line([tip, to])
        self.line([to, (x + sense * (width_of(text, NOTES) + 1.0), y)])
        self.arrow(tip, tuple(-away / max(float(np.hypot(*away)), 1e-9)))
        ground = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}  # extension lines give way to it
        self.text(x + 0.5 * sense, y + OFF, text, NOTES, ha="left" if sense > 0 else "right", bbox=ground)

    def _dimension(self, ends, level, feet, text, upright) -> None:
        def at(along: float, beside: float) -> tuple[float, float]:
            return (beside, along) if upright else (along, beside)

        low, high = ends
        for end, foot in zip(ends, feet, strict=True):
            sense = np.sign(level - foot)
            self.line([at(end, foot + sense * OFF), at(end, level + sense * OVER)])
        wide, gap = width_of(text, LETTERS), high - low
        inside = gap >= wide + 2 * ARROW + 1
        if inside or gap >= 2 * ARROW + 1:  # arrows within, on a line from end to end
            self.line([at(low, level), at(high, level)])
            heads = ((low, -1), (high, 1))
        else:  # from outside
            self.line([at(low - TAIL, level), at(high + TAIL, level)])
            heads = ((low, 1), (high, -1))
        for end, sense in heads:
            self.arrow(at(end, level), at(float(sense), 0.0))
        above = -OFF if upright else OFF
        turned = {"rotation": 90, "rotation_mode": "anchor"} if upright else {}
        if inside or gap >= wide + 1:
            self.text(*at((low + high) / 2, level + above), text, ha="center", **turned)
        else:  # on a shelf behind the upper end
            start = high + ARROW + 1
            self.line([at(high, level), at(start + wide, level)])
            self.text(*at(start, level + above), text, ha="left", **turned)


def drawable(text: str) -> str:
    """The text with a box for every letter that the font, which every machine has, does not know."""
    return "".join(c if ord(c) in _known() else UNKNOWN for c in text)


@functools.cache
def _known() -> frozenset[int]:
    from matplotlib.font_manager import findfont, get_font

    return frozenset(get_font(findfont(FAMILY)).get_charmap())


def width_of(text: str, size: float, bold: bool = False) -> float:
    """How wide a line of text is (mm) whose em is `size` mm."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(family=FAMILY, size=size, weight="bold" if bold else "normal")
    return text_to_path.get_text_width_height_descent(text, font, False)[0] if text else 0.0


def fitted(text: str, size: float, room: float, bold: bool = False, least: float = 0.8) -> tuple[str, float]:
    """(text, size) that fits into so much room (mm): down to a part of its size, then cut at its end."""
    size = max(least * size, min(size, size * room / max(width_of(text, size, bold), 1e-9)))
    if width_of(text, size, bold) <= room * (1 + 1e-9):
        return text, size
    while text and width_of(f"{text}\u2026", size, bold) > room:
        text = text[:-1]
    return f"{text.rstrip()}\u2026", size


def wrapped(text: str, size: float, room: float, most: int) -> list[str]:
    """The text in at most so many lines of so much room (mm), broken between words; the last one is cut."""
    lines, words = [], drawable(text).split()
    while words and len(lines) < most:
        count = 1
        while count < len(words) and width_of(" ".join(words[: count + 1]), size) <= room:
            count += 1
        if len(lines) == most - 1:
            count = len(words)
        lines.append(fitted(" ".join(words[:count]), size, room, least=1.0)[0])
        words = words[count:]
    return lines


def first_angle(paper: Paper, x: float, y: float, size: float) -> None:
    """The symbol of first-angle projection (ISO 5456-2): a cone's frustum, and beside it the view from its left."""
    half, length = size / 2, 1.4 * size
    paper.line(
        [(x, y - half / 2), (x + length, y - half), (x + length, y + half), (x, y + half / 2), (x, y - half / 2)], 0.3
    )
    turn = np.linspace(0, 2 * np.pi, 73)
    centre = x + length + 0.4 * size + half
    for radius in (half / 2, half):
        paper.line(np.stack([centre + radius * np.cos(turn), y + radius * np.sin(turn)], axis=1), 0.3)
    paper.line([(x - 1, y), (x + length + 1, y)], linestyle=CHAIN, color=GREY)
    paper.line([(centre - half - 1, y), (centre + half + 1, y)], linestyle=CHAIN, color=GREY)
    paper.line([(centre, y - half - 1), (centre, y + half + 1)], linestyle=CHAIN, color=GREY)
