"""Views of a part on its data sheet: its plan from the side of the back, and two sections through the axis.

All of them to one scale of the standard series (ISO 5455), in first-angle projection (ISO 128-30): the plan, which is
the view from the right, along -z, stands left of the section that is seen along +x.  Within the rim it is a map of
heights; around that stand flange and holes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Outline
from bstcad.optics.surfaces import sag
from bstcad.report.drafting import LETTERS, NOTES, OFF, THICK, Paper, Point, fitted, width_of
from bstcad.report.drawing import BLUE, GLASS, GREY, VERMILION
from bstcad.report.part_profile import Profile, profile
from bstcad.report.units import number
from bstcad.scene.mount import Mount
from bstcad.shop.part_drawings import across, pitch_radius

MAP_POINTS = 241  # of the map of heights, each way
LEVELS = 18  # contour lines at most
NUMBERS = 1.9  # mm: letters of the heights on contour lines
CALLS = ((1, 1), (-1, -1), (1, -1))  # corners of the plan, right and up, for notes on kinds of holes
SAME = 5e-4  # mm: dimensions that read alike
AXES = 7.0  # mm: length of the arrows of the frame
# Room on paper (mm): left of the plan, between it and the first section, between the sections, right of the last;
# above all views, and below them.
SIDES, HEAD, FOOT = (17.0, 26.0, 21.0, 9.0), 17.0, 22.0
RIGHT, UP, DOWN = np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.array([0.0, -1.0])


@dataclass(frozen=True, eq=False)
class Views:
    """A part to be drawn, in the frame of its file; mm."""

    lens: Lens  # within the rim
    mount: Mount  # Mount() of a bare lens
    origin: float  # z in the scene's frame that is 0 in the file
    used: Outline | None  # clear aperture of the back; None: all of it
    names: tuple[tuple[str, str], tuple[str, str]]  # of the front and of the back: long, short

    @cached_property
    def cuts(self) -> tuple[Profile, Profile]:
        """Sections at x = 0 and at y = 0."""
        return tuple(profile(self.lens, self.mount, upright, self.origin) for upright in (True, False))

    @property
    def rim(self) -> Outline:
        """Rim of the lens in the part."""
        return self.mount.rim_of(self.lens.outline).outline

    @property
    def outermost(self) -> Outline:
        """Outline of the whole part."""
        return self.rim if self.mount.flange is None else self.mount.flange.outline.outline

    @property
    def vertices(self) -> tuple[float, float]:
        """z (mm) where front and back cross the axis."""
        return float(self.lens.front.z) - self.origin, float(sag(self.lens.back, 0.0, 0.0)) - self.origin


@dataclass(frozen=True)
class Placed:
    """Coordinates of a view (mm) on paper (mm)."""

    scale: float
    x: float  # of the view's origin on paper
    y: float

    def __call__(self, points: Any) -> np.ndarray:
        """Points (n, 2), or one."""
        return (self.x, self.y) + self.scale * np.asarray(points, dtype=float)


def scale_for(views: Views, width: float, height: float) -> float:
    """The largest scale of the series 1, 2, 5, 10 … at which all views fit on so much paper (mm)."""
    a, b = views.outermost.half_extent
    wide = 2 * a + sum(_thickness(cut) for cut in views.cuts)
    most = min((width - sum(SIDES)) / wide, (height - HEAD - FOOT) / (2 * max(a, b)))
    decade = 10.0 ** np.floor(np.log10(most))
    return float(max(step * decade for step in (1, 2, 5) if step * decade <= most * (1 + 1e-9)))


def _thickness(cut: Profile) -> float:
    (low, high), _ = cut.ends
    return high - low


def scale_words(scale: float) -> str:
    """5:1, 1:1, 1:20."""
    return f"{scale:.6g}:1" if scale >= 1 else f"1:{1 / scale:.6g}"


def length(value: float) -> str:
    """mm to a micrometre, below 0.1 mm to three digits."""
    text = f"{value:.3g}" if 0 < abs(value) < 0.1 else f"{value:.3f}".rstrip("0").rstrip(".")
    return text.replace("-", "\u2212")


def draw(paper: Paper, views: Views, *, left: float, low: float, right: float, high: float) -> float:
    """All views side by side in that part of the paper (mm); the scale."""
    scale = scale_for(views, right - left, high - low)
    a, b = views.outermost.half_extent
    wide, reach = 2 * scale * a, scale * max(a, b)
    thick = [scale * _thickness(cut) for cut in views.cuts]
    spare = (right - left - sum(SIDES) - wide - sum(thick)) / 6
    middle = low + FOOT + reach + max(0.0, (high - low - HEAD - FOOT - 2 * reach) / 2)
    x = left + spare + SIDES[0]
    _plan(paper, views, Placed(scale, x + wide / 2, middle))
    x += wide + SIDES[1] + 2 * spare
    note = f"origin of x, y, z: {origin(views)}"
    paper.text(x - 15.5, middle - reach - 20.5, note, NOTES, room=right - 2 - (x - 15.5), color=VERMILION)
    _section(paper, views, 0, scale, left=x, middle=middle)
    _section(paper, views, 1, scale, left=x + thick[0] + SIDES[2] + 2 * spare, middle=middle)
    return scale


def origin(views: Views) -> str:
    """Position of the point (0, 0, 0) of the file on the axis, from the nearer face."""
    front, back = views.vertices
    near, name = (front, "front") if abs(front) <= abs(back) else (back, "back")
    if views.lens.reflects:
        name = "rear" if name == "front" else "mirror face"
    if not near:
        return f"where the axis meets the {name}"
    at = f"on the axis, {length(abs(near))} mm to the {'left' if near > 0 else 'right'} of the {name}"
    return f"{at}, in the flange's lower face" if views.mount.datum == "flange" else at


# --- the plan ---------------------------------------------------------------------------------------------------------


def _plan(paper: Paper, views: Views, at: Placed) -> None:
    """The part as seen along -z, x to the right and y up, its back with contour lines."""
    outer, x, y = views.outermost, at.x, at.y
    a, b = (at.scale * half for half in outer.half_extent)
    step = _contours(paper, views, at)
    paper.line(at(closed(views.rim)), THICK, zorder=5)
    if views.used is not None:
        paper.line(at(closed(views.used)), 0.25, color=VERMILION, linestyle=(0, (6, 2, 1, 2, 1, 2)), zorder=4)
    _flange(paper, views, at)
    paper.axis((x - a - 3, y), (x + a + 3, y))
    paper.axis((x, y - b - 3), (x, y + b + 3))
    _frame(paper, (x, y), ("x", "y"), min(AXES, a, b))
    for letter, along, seen, reach in (("A", UP, RIGHT, b), ("B", RIGHT, DOWN, a)):  # planes of the sections
        for sense in (-1, 1):
            start, middle = ((x, y) + sense * (reach + off) * along for off in (3.2, 4.9))
            paper.line([start, start + 3.4 * sense * along], THICK)
            paper.line([middle, middle + 3.2 * seen])
            paper.arrow(middle + 4.2 * seen, seen)
            paper.text(*(middle - 2.2 * seen), letter, weight="bold", ha="center", va="center_baseline")
    if outer.shape == "circle":
        paper.dimension((x - a, x + a), y - b - 12, (y, y), f"\u00d8{length(2 * outer.radius)}")
    else:
        paper.dimension((x - a, x + a), y - b - 12, (y - b, y - b), length(outer.width))
        paper.dimension((y - b, y + b), x - a - 11, (x - a, x - a), length(outer.height), upright=True)
    face = "Mirror face" if views.lens.reflects else "Back"
    paper.text(x, y + b + 12, f"{face}, seen along \u2212z", ha="center", weight="bold")
    note = f"contours of z every {step}" if step else "no contours: the back is level"
    paper.text(x, y - b - 17, note, NOTES, ha="center", color=BLUE)
    if views.used is not None:
        paper.text(x, y - b - 20.5, "\u2013 \u00b7\u00b7 \u2013  clear aperture", NOTES, ha="center", color=VERMILION)


def _flange(paper: Paper, views: Views, at: Placed) -> None:
    """Flange and holes around the lens, with notes on rim, corners and holes."""
    flange, outer = views.mount.flange, views.outermost
    a, b = (at.scale * half for half in outer.half_extent)
    over, under = at.y + b + 6.2, at.y - b - 6.2  # y of notes, beside the marks of the section A
    if corner := getattr(outer, "corner_radius", 0.0):
        inset = at.scale * corner * (1 - 0.5**0.5)
        paper.leader((at.x + a - inset, at.y - b + inset), (at.x + a + 2.0, at.y - b - 3.0), f"R{length(corner)}", 1)
    if flange is None:
        return
    paper.line(at(closed(outer)), THICK, zorder=5)
    lean = math.tan(math.radians(flange.draft))
    if taken := flange.thickness * lean + flange.bevel * (1 - lean):
        paper.line(at(closed(outer.inset(taken))), 0.25, zorder=5)  # the edge of its upper face
    u, v = views.rim.half_extent
    part = 0.5**0.5 if views.rim.shape == "circle" else 0.5
    tip = at((-part * u, part * v))
    paper.leader(tip, (min(at.x - 6.5, tip[0]), over), f"lens {across(views.mount.rim_of(views.lens.outline))}", -1)
    if radius := pitch_radius(views.mount):
        paper.line(at(closed(Circle(radius))), linestyle=(0, (14, 2.5, 2, 2.5)), color=GREY, zorder=1.5)
    for x, y, diameter in flange.all_holes():
        paper.line(at(closed(Circle(diameter / 2)) + (x, y)), THICK, zorder=5)
        reach = diameter / 2 + 1.5 / at.scale
        for ahead in (reach * RIGHT, reach * UP):
            paper.line(at([(x, y) - ahead, (x, y) + ahead]), color=GREY, zorder=1.5)

    def leader(holes: list[tuple[float, float, float]], right: int, up: int) -> tuple[Point, Point]:
        """(tip, shelf) of the shortest leader from one of the holes to a corner."""
        tips = [at((x + right * d / 2 * 0.5**0.5, y + up * d / 2 * 0.5**0.5)) for x, y, d in holes]
        pairs = [(tip, (at.x + right * max(right * (tip[0] - at.x), 6.5), over if up > 0 else under)) for tip in tips]
        return min(pairs, key=lambda pair: math.dist(*pair))

    kinds = list(hole_words(views.mount))[: len(CALLS)]
    ways = [[(leader(holes, *corner), text, corner[0]) for (text, holes), corner in zip(kinds, corners, strict=True)]
            for corners in itertools.permutations(CALLS, len(kinds))]  # fmt: skip
    for ends, text, sense in min(ways, key=lambda way: sum(math.dist(*ends) for ends, *_ in way)):
        paper.leader(*ends, text, sense)


def hole_words(mount: Mount) -> Iterator[tuple[str, list[tuple[float, float, float]]]]:
    """Each kind of holes through the flange: its note, and x, y and diameter (mm) of its holes."""
    flange = mount.flange
    if flange is None:
        return
    if (screws := flange.screws) is not None:
        note = f"{screws.count} \u00d7 \u00d8{length(screws.diameter)} on \u00d8{length(screws.circle)}"
        yield note, list(screws.holes())
    for diameter in dict.fromkeys(d for _, _, d in flange.holes):
        alike = [hole for hole in flange.holes if hole[2] == diameter]
        yield f"{len(alike)} \u00d7 " * (len(alike) > 1) + f"\u00d8{length(diameter)}", alike


def _contours(paper: Paper, views: Views, at: Placed) -> str:
    """Draw the lines of equal z; their step in words, "" if there are none."""
    x, y = (np.linspace(-end, end, MAP_POINTS) for end in views.rim.half_extent)
    grid_x, grid_y = np.meshgrid(x, y)
    z = sag(views.lens.back, grid_x, grid_y) - views.origin
    z = np.where(views.rim.depth(grid_x, grid_y) >= 0, z, np.nan)
    low, high = float(np.nanmin(z)), float(np.nanmax(z))
    if not high - low > 1e-9 * max(1.0, abs(low), abs(high)):
        return ""
    decade = 10.0 ** np.floor(np.log10((high - low) / LEVELS))
    step = float(next(k * decade for k in (1, 2, 5, 10) if (high - low) / (k * decade) <= LEVELS))
    levels = step * np.arange(np.ceil(low / step), np.floor(high / step) + 1)
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    on_paper = at.x + at.scale * x, at.y + at.scale * y
    drawn = paper.axes.contour(*on_paper, z, levels, colors=BLUE, linewidths=0.55, zorder=2)
    taken: list[np.ndarray] = []
    for level, lines in zip(levels, drawn.allsegs, strict=True):
        _height(paper, f"{level:.{decimals}f}", lines, views, at=at, taken=taken)
    return f"{number(step)} mm" if step >= 1e-3 else f"{number(1e3 * step)} \u00b5m"


def _height(
    paper: Paper, text: str, lines: Sequence[np.ndarray], views: Views, *, at: Placed, taken: list[np.ndarray]
) -> None:
    """Write its height on a contour where that is clear of rim, axes, frame and all heights in `taken` (paper, mm)."""
    lines = [line for line in lines if len(line) > 4]
    if not lines:
        return
    spots = np.concatenate([line[2:-2:2] for line in lines])
    ahead = np.concatenate([line[4::2] for line in lines]) - spots
    off, room = np.abs(spots - (at.x, at.y)), width_of(text, NUMBERS)
    edges = [edge for edge in (views.rim, views.used) if edge is not None]
    clear = np.min([
        *(at.scale * np.abs(edge.depth(*off.T / at.scale)) for edge in edges), off.min(1), np.hypot(*off.T) - AXES - 3,
        *(0.5 * np.hypot(*(spots - other).T) for other in taken),
    ], axis=0)  # fmt: skip
    best = int(np.argmax(np.minimum(clear, 3 * room)))
    if clear[best] <= room / 2 + 1.0:
        return
    taken.append(spots[best])
    turn = (np.degrees(np.arctan2(*ahead[best][::-1])) + 90) % 180 - 90
    ground = {"facecolor": "white", "edgecolor": "none", "pad": 0.4}
    style = {"rotation": turn, "ha": "center", "va": "center", "color": BLUE, "bbox": ground, "zorder": 3}
    paper.text(*spots[best], text, NUMBERS, **style)


def closed(outline: Outline) -> np.ndarray:
    """Points (n, 2) (mm) around an outline, the first again at the end."""
    (a, b, r2), turn = outline.limits, np.linspace(0, 2 * np.pi, 361)
    cos, sin, r = np.cos(turn), np.sin(turn), math.sqrt(r2)
    points = np.stack([np.sign(cos) * a + r * cos, np.sign(sin + 1e-12) * b + r * sin], axis=1)
    return np.concatenate([points, points[:1]])


# --- the sections -----------------------------------------------------------------------------------------------------


def _section(paper: Paper, views: Views, which: int, scale: float, *, left: float, middle: float) -> None:
    """A section, z to the right, its lowest z at `left`; which: 0 is x = 0, with y up, 1 is y = 0, with x up."""
    cut, half = views.cuts[which], [scale * half for half in views.outermost.half_extent]
    (lowest, highest), _ = cut.ends
    at, right = Placed(scale, left - scale * lowest, middle), left + scale * (highest - lowest)
    reach = half[1 - which]
    for body in cut.bodies:  # cut material: a tone, and thin lines at 45 degrees (ISO 128-50)
        paper.area(at(body), facecolor=GLASS, hatch="//", edgecolor=GREY, zorder=0.5)
        paper.line(at(np.concatenate([body, body[:2]])), THICK, zorder=5)
    for edge in cut.behind:
        paper.line(at(edge), THICK, zorder=5)
    paper.axis((left - 3, middle), (right + 3, middle))
    title = f"{'AB'[which]}\u2013{'AB'[which]}  ({'xy'[which]} = 0)"
    paper.text((left + right) / 2, middle + max(half) + 12, title, ha="center", weight="bold")
    for (low, high), level, feet in _thicknesses(views, which, at, reach):
        ends = at.x + scale * low, at.x + scale * high
        paper.dimension(ends, level, feet, length(high - low))
    room = scale * cut.front_ends[1] - 2
    turned = {"rotation": 90, "rotation_mode": "anchor", "ha": "center"}
    for beside, names in zip((left - 1.6, right + 1.6 + 0.8 * LETTERS), views.names, strict=True):
        name = next((name for name in names if width_of(name, LETTERS) <= room), names[-1])
        paper.text(beside, middle + room / 2 + 1, *fitted(name, LETTERS, room, least=0.5), **turned)
    inside = left - 16 <= at.x <= right + 3
    _frame(paper, (at.x if inside else left - 15.5, middle), ("z", "yx"[which]), min(AXES, reach))
    if which == 0:
        _light(paper, right + 10 if views.lens.reflects else left - 15.5, middle - 9, -1 if views.lens.reflects else 1)
    else:
        _walls(paper, views, at, reach)


def _thicknesses(
    views: Views, which: int, at: Placed, reach: float
) -> Iterator[tuple[tuple[float, float], float, tuple[float, float]]]:  # fmt: skip
    """Dimensions along z, of the edge or of the flange, its position and the whole: z (mm), level and feet on paper."""
    cut, flange, (front, back) = views.cuts[which], views.mount.flange, views.vertices
    middle, top, foot = at.y, at.y + reach, at.y - reach
    if flange is None:
        for k, level, end in ((1, top + 5, top), (0, foot - 6, foot)):
            yield (cut.front[k], cut.back[k]), level, (middle + at.scale * cut.front_ends[k], end)
    else:
        low, high, (lowest, highest) = flange.z - views.origin, flange.z + flange.thickness - views.origin, cut.ends[0]
        if which == 1:
            yield ((front, low), top + 5, (middle, top)) if front < low else ((low, front), top + 5, (top, middle))
            return
        yield (low, high), top + 5, (top, top)
        if max(abs(lowest - front), abs(highest - back)) > SAME:
            yield (lowest, highest), foot - 6, (middle, middle)
    if which == 0:
        yield (front, back), foot - 13, (middle, middle)


def _walls(paper: Paper, views: Views, at: Placed, reach: float) -> None:
    """Draft and bevel of the lens's own walls, beside the lower end of the cut, and of the flange's, below it."""
    mount, cut, flange = views.mount, views.cuts[1], views.mount.flange
    if words := wall_words(mount.draft, mount.bevel):
        tip = at((cut.front[0], cut.front_ends[0]))
        paper.leader(tip, (tip[0] - 2.0, tip[1] + 3.5), words, -1)
    if flange is not None and (words := wall_words(flange.draft, flange.bevel)):
        x, _ = at((flange.z - views.origin + flange.thickness / 2, 0.0))
        paper.leader((x, at.y - reach), (x + 1.5, at.y - reach - 5.0), words, 1)


def wall_words(draft: float, bevel: float) -> str:
    """Draft and bevel as a drawing names them, "" without both."""
    return ", ".join(filter(None, (f"draft {draft:g}\u00b0" * bool(draft), f"{bevel:g} \u00d7 45\u00b0" * bool(bevel))))


def _light(paper: Paper, start: float, y: float, sense: int) -> None:
    """An arrow with the light, towards the face that it meets first."""
    end = start + sense * 8.5
    paper.line([(start, y), (end - sense, y)], 0.25, color=VERMILION)
    paper.arrow((end, y), sense * RIGHT, VERMILION)
    paper.text((start + end) / 2, y - 3, "light", NOTES, ha="center", color=VERMILION)


def _frame(paper: Paper, at: Point, names: tuple[str, str], size: float) -> None:
    """The frame of the file with its origin there: arrows to the right and up, with their names."""
    for towards, name, off in ((RIGHT, names[0], (OFF, 0.6)), (UP, names[1], (0.8, -0.6))):
        tip = at + size * towards
        paper.line([at, tip - towards], 0.35, color=VERMILION, zorder=6)
        paper.arrow(tip, towards, VERMILION, zorder=6)
        paper.text(*(tip + off), name, NOTES, color=VERMILION, style="italic", zorder=6)
