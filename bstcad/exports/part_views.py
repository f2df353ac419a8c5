"""Drawing of a part on its data sheet, in mm of paper: a plan from the side of the back, and two sections.

All views have one scale of the standard series (ISO 5455), in first-angle projection (ISO 128-30): the plan, which is
the view along -z, lies to the left of the section that is seen along +x with z to the right.  Inside the rim the plan
is a contour map of the back; flange and holes surround it.  Lines, arrows and dimensions follow ISO 128 and ISO 129-1;
edges and dimensions are black, so that a copy of a copy is legible.  matplotlib draws them.  (The drawing add-on of
ezdxf 1.4.5 would fill the hole of "Ø" and make curves of text, so that nobody could search the page or copy from it.)
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from scipy.optimize import brentq

from bstcad.exports.exports import across, pitch_radius
from bstcad.figures.drawing import BLUE, GLASS, GREY, STYLE, VERMILION, round_up
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK
from bstcad.optics.surfaces.outlines import Circle, Outline
from bstcad.optics.surfaces.surfaces import Surface, points_and_normals, sag
from bstcad.report.units import mm, number
from bstcad.scene.mount import Flange, Mount

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TYPE_POINT = 25.4 / 72  # typographic point (mm)
THICK, THIN = 0.5, 0.18  # line widths of visible edges and of all other lines (mm)
ARROW_LENGTH, ARROW_HALF_WIDTH = 2.2, 0.36  # size of an arrow head (mm)
OVERSHOOT = 1.2  # length of an extension line past its dimension line (mm)
GAP = 0.7  # distance between a line and its text, or between the part and an extension line (mm)
TAIL = 4.5  # length of a dimension line outside the measured length (mm)
LETTERS, NOTES, NUMBERS = 2.5, 2.1, 1.9  # font sizes of dimensions, of leaders and notes, of numbers on contours (mm)
CHAIN = (0, (14, 2.5, 2, 2.5))  # dashes and gaps of a centre line, in line widths
FAMILY = STYLE["font.family"]
PRINTED = 0.96  # room that a text may fill, since programs that print it round the widths of letters
MIN_ROOM = 6.0  # least room for the name of a face (mm)
SMALLER, LINE_PITCH = 0.96, 1.3  # factor by which a text is made smaller until it fits; distance of lines / font size
UNKNOWN = "\u25a1"  # box for a character that the font lacks
CONTOUR_POINTS, SECTION_POINTS = 241, 401  # points of the map of heights per axis, and of each face of a section
MAX_CONTOURS = 18  # largest range of heights, in steps between contour lines
NOTE_CORNERS = ((1, 1), (-1, -1), (1, -1))  # corners of the plan for notes on holes (1: right or up, -1: left or down)
EQUAL_DIMENSIONS = 5e-4  # difference below which two dimensions print the same number (mm)
AXIS_LENGTH = 7.0  # length of the arrows of the coordinate frame (mm)
# Margins on paper (mm): left of the plan, between plan and first section, between the sections, right of the second;
# above and below all views.
SIDE_MARGINS, TOP_MARGIN, BOTTOM_MARGIN = (17.0, 26.0, 21.0, 9.0), 17.0, 22.0
RIGHT, UP, DOWN = np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.array([0.0, -1.0])

Point = Pair = tuple[float, float]  # x, y on paper; z, u in a section; or the lower and upper end of an interval (mm)


# --- paper ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Paper:
    """Sheet of paper; all coordinates in mm from its lower left corner."""

    axes: Axes

    @classmethod
    def of(cls, figure: Figure) -> Paper:
        """Return a sheet of the size of the figure."""
        width, height = figure.get_size_inches() * 25.4
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.set(xlim=(0, width), ylim=(0, height), autoscale_on=False)
        return cls(axes)

    def line(self, points: Sequence[Any], width: float = THIN, **style: Any) -> None:
        """Draw a line through points (x, y)."""
        given = {"color": "black", "solid_capstyle": "butt", "dash_capstyle": "butt", "solid_joinstyle": "miter"}
        self.axes.plot(*np.asarray(points, dtype=float).T, linewidth=width / TYPE_POINT, **(given | style))

    def axis(self, start: Point, end: Point) -> None:
        """Draw a centre line from `start` to `end`."""
        self.line([start, end], linestyle=CHAIN, color=GREY, zorder=1.5)

    def area(self, points: Sequence[Any], **style: Any) -> None:
        """Draw a filled polygon without an edge."""
        self.axes.fill(*np.asarray(points, dtype=float).T, **({"linewidth": 0} | style))

    def text(
        self, x: float, y: float, text: str, size: float = LETTERS, *, room: float | None = None, most: int = 1,
        **style: Any,
    ) -> None:  # fmt: skip
        """Write text with an em of `size` mm, the first of its lines at y.

        room: largest width (mm); wider text is broken into at most `most` lines, and else smaller.  It is never cut.
        """
        lines = [drawable(text)]
        if room is not None:
            lines, size = fitted(lines[0], size, PRINTED * room, bold=style.get("weight") == "bold", most=most)
        given = {"va": "baseline", "fontsize": size / TYPE_POINT, "parse_math": False} | style
        for k, line in enumerate(lines):
            self.axes.text(x, y - k * LINE_PITCH * size, line, **given)

    def arrow(self, tip: Point, towards: Point, color: str = "black", **style: Any) -> None:
        """Draw a filled arrow head at `tip` that points along `towards`, a unit vector."""
        ahead, aside = ARROW_LENGTH * np.array(towards), ARROW_HALF_WIDTH * np.array([-towards[1], towards[0]])
        self.area([tip, tip - ahead + aside, tip - ahead - aside], color=color, **style)

    def dimension(
        self, ends: tuple[float, float], level: float, feet: tuple[float, float], text: str, upright: bool = False
    ) -> None:
        """Draw a dimension between the two `ends`, x of the measured points, with its line at y = level.

        feet: y of the measured points.  upright: x and y are exchanged, and the text is read from the right.
        """

        def at(along: float, beside: float) -> Point:
            return (beside, along) if upright else (along, beside)

        low, high = ends
        for end, foot in zip(ends, feet, strict=True):
            sense = np.sign(level - foot)
            self.line([at(end, foot + sense * GAP), at(end, level + sense * OVERSHOOT)])
        wide, gap = width_of(text, LETTERS), high - low
        inwards, tail = (1, 0.0) if gap >= 2 * ARROW_LENGTH + 1 else (-1, TAIL)  # arrows from inside or from outside
        shelf, above = gap < wide + 1, level - GAP if upright else level + GAP
        self.line([at(low - tail, level), at(high + (ARROW_LENGTH + 1 + wide if shelf else tail), level)])
        self.arrow(at(low, level), at(-inwards, 0))
        self.arrow(at(high, level), at(inwards, 0))
        turned = {"rotation": 90, "rotation_mode": "anchor"} if upright else {}
        place = high + ARROW_LENGTH + 1 if shelf else (low + high) / 2
        self.text(*at(place, above), text, ha="left" if shelf else "center", **turned)

    def leader(self, tip: Point, to: Point, text: str, sense: int) -> None:
        """Draw a note with an arrow at `tip`; its shelf begins at `to` and runs right (sense 1) or left (-1)."""
        (x, y), ahead = to, np.subtract(tip, to)
        self.line([tip, to, (x + sense * (width_of(text, NOTES) + 1.0), y)])
        self.arrow(tip, tuple(ahead / max(np.hypot(*ahead), 1e-9)))
        ground = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}  # covers extension lines
        self.text(x + 0.5 * sense, y + GAP, text, NOTES, ha="left" if sense > 0 else "right", bbox=ground)

    def first_angle(self, x: float, y: float, size: float) -> None:
        """Draw the symbol of first-angle projection (ISO 5456-2), `size` mm high; (x, y): middle of its left end."""
        half, end = size / 2, x + 1.4 * size
        centre = end + 0.4 * size + half
        self.line([(x, y - half / 2), (end, y - half), (end, y + half), (x, y + half / 2), (x, y - half / 2)], 0.3)
        for radius in (half / 2, half):
            self.line(Circle(radius).around() + (centre, y), 0.3)
        self.axis((x - 1, y), (end + 1, y))
        self.axis((centre - half - 1, y), (centre + half + 1, y))
        self.axis((centre, y - half - 1), (centre, y + half + 1))


def drawable(text: str) -> str:
    """Return the text with a box for each character that the font lacks; matplotlib contains this font."""
    return "".join(c if ord(c) in _letters() else UNKNOWN for c in text)


@functools.cache
def _letters() -> frozenset[int]:
    from matplotlib.font_manager import findfont, get_font

    return frozenset(get_font(findfont(FAMILY)).get_charmap())


def width_of(text: str, size: float, bold: bool = False) -> float:
    """Return the width (mm) of a line of text whose em is `size` mm."""
    return size * _relative_width(text, bold) if text else 0.0


@functools.lru_cache(maxsize=1 << 14)
def _relative_width(text: str, bold: bool) -> float:
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    size = 10.0  # matplotlib makes a font of size 1 of each smaller one
    font = FontProperties(family=FAMILY, size=size, weight="bold" if bold else "normal")
    return text_to_path.get_text_width_height_descent(text, font, False)[0] / size


def fitted(text: str, size: float, room: float, bold: bool = False, most: int = 1) -> tuple[list[str], float]:
    """Return (lines, size): the text in at most `most` lines of width `room` (mm), of `size` or smaller."""
    while len(lines := broken(text, size, room, bold)) > most:
        size *= SMALLER
    return lines, size


def broken(text: str, size: float, room: float, bold: bool = False) -> list[str]:
    """Return the text in lines of width `room` (mm), broken between words, or within a word that is wider than that."""
    lines = [""]
    for word in drawable(text).split():
        longer = f"{lines[-1]} {word}".strip()
        if width_of(longer, size, bold) <= room * (1 + 1e-9):
            lines[-1] = longer
            continue
        parts = [""]
        for letter in word:
            if parts[-1] and width_of(parts[-1] + letter, size, bold) > room * (1 + 1e-9):
                parts.append("")
            parts[-1] += letter
        lines = [line for line in lines if line] + parts
    return lines


# --- a part cut along a plane through its axis ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CrossSection:
    """Cross-section of a part: polygons (z, u) in mm, u along the cut, in the frame of the part's file.

    The cut meets each wall at right angles, so that the section shows the draft in true size.
    """

    bodies: tuple[np.ndarray, ...]  # polygons (n, 2), with the first point again at the end
    back: Pair  # z at the ends of the back
    front: Pair  # z at the ends of the front
    front_ends: Pair  # u at the ends of the front
    behind: tuple[np.ndarray, ...]  # edges (2, 2) of the flange's planes, visible behind its holes

    @property
    def ends(self) -> tuple[Pair, Pair]:
        """Intervals of z and of u over all bodies."""
        every = np.concatenate(self.bodies)
        return tuple(zip(every.min(0).tolist(), every.max(0).tolist(), strict=True))


def profile(lens: Lens, mount: Mount, upright: bool, origin: float = 0.0) -> CrossSection:
    """Return the section of a lens in its mount; upright: cut along y at x = 0, else along x at y = 0.

    Lens and mount have to fit each other.  origin: z of the file's origin in the frame of the scene (mm).
    """

    def height(surface: Surface, u: np.ndarray) -> np.ndarray:
        return (sag(surface, 0.0 * u, u) if upright else sag(surface, u, 0.0 * u)) - origin

    along, back = lens.back.section(lens.outline, upright, SECTION_POINTS)
    back, half, rims = back - origin, float(min(-along[0], along[-1])), along[[0, -1]]
    top = mount.top(lens) - origin if mount.draft or mount.bevel else math.inf
    walls = [
        _wall(lambda u, s=sense: float(height(lens.front, np.float64(s * u))), min(z, top), sense * rim, mount)
        * (1, sense)
        for sense, z, rim in zip((-1, 1), back[[0, -1]], rims, strict=True)
    ]
    ends = float(walls[0][-1, 1]), float(walls[1][-1, 1])
    u = np.linspace(*ends, SECTION_POINTS)
    front = height(lens.front, u)
    body = [np.stack([back, along], 1), walls[1], np.stack([front, u], 1)[::-1], walls[0][::-1]]
    whole, behind = shapely.Polygon(np.concatenate(body)), []
    if mount.flange is not None:
        sides, holes, behind = _flange(mount.flange, half, upright, mount.flange.z - origin)
        whole = shapely.union_all([whole, *sides]) - holes
    return CrossSection(
        bodies=tuple(shapely.get_coordinates(part.exterior) for part in getattr(whole, "geoms", [whole])),
        back=(float(back[0]), float(back[-1])),
        front=(float(front[0]), float(front[-1])),
        front_ends=ends,
        behind=tuple(behind),
    )


def _flange(
    flange: Flange, half: float, upright: bool, low: float
) -> tuple[list[shapely.Polygon], shapely.Geometry, list[np.ndarray]]:
    """Return (flange outside the rim |u| = half, holes, edges of its upper and lower face) as (z, u); low: least z."""
    high, lean, b = low + flange.thickness, math.tan(math.radians(flange.draft)), flange.bevel
    reach = flange.outline.outline.half_extent[upright]
    foot, head = reach - lean * b, reach - lean * (flange.thickness - b)  # ends of the wall with draft
    wall = [(high, half), (high, head - b), (high - b, head), (low + b, foot), (low, foot - b), (low, half)]
    holes = []
    for x, y, diameter in flange.all_holes():
        along, off = (y, x) if upright else (x, y)
        if abs(off) < diameter / 2:
            chord = math.sqrt(diameter**2 / 4 - off**2)
            holes.append(shapely.box(low - 1, along - chord, high + 1, along + chord))
    sides = [np.array(wall) * (1, sense) for sense in (-1, 1)]
    return [*map(shapely.Polygon, sides)], shapely.union_all(holes), [s[k] for s in sides for k in ([0, 1], [4, 5])]


def _wall(front: Callable[[float], float], z: float, half: float, mount: Mount) -> np.ndarray:
    """Return points (z, |u|) of the lens's wall, with draft and bevel, from (z, half) down to the front z(|u|)."""
    lean = math.tan(math.radians(mount.draft))
    depth = _depth(front, z, half, lean) - mount.bevel
    chain = [(z, half), (z - depth, half - lean * depth)]
    if mount.bevel:
        more = _depth(front, *chain[-1], 1.0)
        chain.append(tuple(np.subtract(chain[-1], more)))
    return np.array(chain)


def _depth(front: Callable[[float], float], z: float, u: float, lean: float) -> float:
    """Return the depth (mm) below (z, u) at which a wall with draft `lean` (mm per mm, inwards) meets the front."""
    if not lean:
        return z - front(u)
    return brentq(lambda depth: z - depth - front(u - lean * depth), 0.0, u / lean)


# --- all views --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Views:
    """Part to draw; `cuts` and `vertices` are in the frame of its STEP file (mm)."""

    lens: Lens  # lens inside the rim, in the frame of the scene
    mount: Mount  # Mount() for a bare lens
    origin: float  # z of the file's origin in the frame of the scene (mm)
    used: Outline | None  # clear aperture of the back; None: the whole face
    names: tuple[tuple[str, str], tuple[str, str]]  # names of front and back: (long, short) each

    @cached_property
    def cuts(self) -> tuple[CrossSection, CrossSection]:
        """Sections at x = 0 and at y = 0."""
        return tuple(profile(self.lens, self.mount, upright, self.origin) for upright in (True, False))

    @property
    def rim(self) -> Outline:
        """Rim of the lens inside the part."""
        return self.mount.rim_of(self.lens.plan).outline

    @cached_property
    def edge(self) -> np.ndarray:
        """Points (n, 2) around the lens as seen along the axis (mm)."""
        return self.lens.back.silhouette(self.lens.outline)

    @property
    def outermost(self) -> Outline:
        """Outline of the whole part."""
        return self.rim if self.mount.flange is None else self.mount.flange.outline.outline

    @property
    def vertices(self) -> tuple[float, float]:
        """Positions z of front and back on the axis (mm)."""
        return self.lens.front_vertex - self.origin, float(sag(self.lens.back, 0.0, 0.0)) - self.origin


@dataclass(frozen=True)
class PaperFrame:
    """Map from coordinates of a view (mm) to coordinates on paper (mm)."""

    scale: float
    x: float  # position of the view's origin on paper
    y: float

    def __call__(self, points: Any) -> np.ndarray:
        """Return points (n, 2), or one point, on paper."""
        return (self.x, self.y) + self.scale * np.asarray(points, dtype=float)


def scale_for(views: Views, width: float, height: float) -> float:
    """Return the largest scale of the series … 0.5, 1, 2, 5 … at which all views fit on paper of this size (mm)."""
    a, b = views.outermost.half_extent
    wide = 2 * a + sum(np.ptp(cut.ends[0]) for cut in views.cuts)
    most = min((width - sum(SIDE_MARGINS)) / wide, (height - TOP_MARGIN - BOTTOM_MARGIN) / (2 * max(a, b)))
    decade = 10.0 ** np.floor(np.log10(most))
    return float(max(step * decade for step in (1, 2, 5) if step * decade <= most * (1 + 1e-9)))


def scale_words(scale: float) -> str:
    """Return a scale in words: 5:1, 1:1, 1:20."""
    return f"{scale:.6g}:1" if scale >= 1 else f"1:{1 / scale:.6g}"


def draw(paper: Paper, views: Views, *, left: float, low: float, right: float, high: float) -> float:
    """Draw all views side by side in the rectangle left, low, right, high of the paper (mm); return the scale."""
    scale = scale_for(views, right - left, high - low)
    a, b = views.outermost.half_extent
    wide, reach = 2 * scale * a, scale * max(a, b)
    thick = [scale * np.ptp(cut.ends[0]) for cut in views.cuts]
    spare = (right - left - sum(SIDE_MARGINS) - wide - sum(thick)) / 6
    middle = low + BOTTOM_MARGIN + reach + max(0.0, (high - low - TOP_MARGIN - BOTTOM_MARGIN - 2 * reach) / 2)
    x = left + spare + SIDE_MARGINS[0]
    _plan(paper, views, PaperFrame(scale, x + wide / 2, middle))
    x += wide + SIDE_MARGINS[1] + 2 * spare
    note = f"origin of x, y, z: {origin(views)}"
    paper.text(x - 15.5, middle - reach - 20.5, note, NOTES, room=right - 2 - (x - 15.5), color=VERMILION)
    _section(paper, views, 0, scale, left=x, middle=middle)
    _section(paper, views, 1, scale, left=x + thick[0] + SIDE_MARGINS[2] + 2 * spare, middle=middle)
    return scale


def origin(views: Views) -> str:
    """Return the position of the file's origin on the axis in words, relative to the nearer face."""
    names = [views.lens.passes.name(face.name) for face in views.lens.faces]
    near, name = min(zip(views.vertices, names, strict=True), key=lambda face: abs(face[0]))
    if not near:
        return f"at the vertex of the {name}"
    at = f"on the axis, {mm(abs(near))} mm to the {'left' if near > 0 else 'right'} of the {name}"
    return f"{at}, in the flange's lower face" if views.mount.datum == "flange" else at


# --- the plan ---------------------------------------------------------------------------------------------------------


def _plan(paper: Paper, views: Views, at: PaperFrame) -> None:
    """Draw the part as seen along -z, x to the right and y up, with contour lines of the back."""
    outer, x, y = views.outermost, at.x, at.y
    a, b = (at.scale * half for half in outer.half_extent)
    step = _contours(paper, views, at)
    paper.line(at(views.edge), THICK, zorder=5)
    if views.used is not None:
        paper.line(at(views.used.around()), 0.25, color=VERMILION, linestyle=(0, (6, 2, 1, 2, 1, 2)), zorder=4)
        paper.text(x, y - b - 20.5, "\u2013 \u00b7\u00b7 \u2013  clear aperture", NOTES, ha="center", color=VERMILION)
    if corner := getattr(outer, "corner_radius", 0.0):
        inset = at.scale * corner * (1 - 0.5**0.5)
        paper.leader((x + a - inset, y - b + inset), (x + a + 2.0, y - b - 3.0), f"R{mm(corner)}", 1)
    if views.mount.flange is not None:
        _draw_flange(paper, views, views.mount.flange, at)
    paper.axis((x - a - 3, y), (x + a + 3, y))
    paper.axis((x, y - b - 3), (x, y + b + 3))
    _frame(paper, (x, y), ("x", "y"), min(AXIS_LENGTH, a, b))
    for letter, along, seen, reach in (("A", UP, RIGHT, b), ("B", RIGHT, DOWN, a)):  # planes of the sections
        for sense in (-1, 1):
            start, middle = ((x, y) + sense * (reach + off) * along for off in (3.2, 4.9))
            paper.line([start, start + 3.4 * sense * along], THICK)
            paper.line([middle, middle + 3.2 * seen])
            paper.arrow(middle + 4.2 * seen, seen)
            paper.text(*(middle - 2.2 * seen), letter, weight="bold", ha="center", va="center_baseline")
    if outer.is_round:
        is_circle = views.mount.flange is not None or np.ptp(np.hypot(*views.edge.T)) <= EQUAL_DIMENSIONS
        within = "" if is_circle else "within "
        paper.dimension((x - a, x + a), y - b - 12, (y, y), f"{within}\u00d8{mm(2 * outer.radius)}")
    else:
        paper.dimension((x - a, x + a), y - b - 12, (y - b, y - b), mm(outer.width))
        paper.dimension((y - b, y + b), x - a - 11, (x - a, x - a), mm(outer.height), upright=True)
    face = views.lens.passes.name(BACK).capitalize()
    paper.text(x, y + b + 12, f"{face}, seen along \u2212z", ha="center", weight="bold")
    note = f"contours of z every {step}" if step else "no contours: the back is flat"
    paper.text(x, y - b - 17, note, NOTES, ha="center", color=BLUE)


def _draw_flange(paper: Paper, views: Views, flange: Flange, at: PaperFrame) -> None:
    """Draw the flange and its holes around the lens, with notes on the sizes of rim and holes."""
    outer = views.outermost
    over, under = (at.y + sense * (at.scale * outer.half_extent[1] + 6.2) for sense in (1, -1))  # y of notes
    paper.line(at(outer.around()), THICK, zorder=5)
    lean = math.tan(math.radians(flange.draft))
    if inset := flange.thickness * lean + flange.bevel * (1 - lean):
        paper.line(at(outer.inset(inset).around()), 0.25, zorder=5)  # edge of the upper face
    u, v = views.rim.half_extent
    part = 0.5**0.5 if views.rim.is_round else 0.5
    tip = at((-part * u, part * v))
    paper.leader(tip, (min(at.x - 6.5, tip[0]), over), f"lens {across(views.rim)}", -1)
    if radius := pitch_radius(views.mount):
        paper.line(at(Circle(radius).around()), linestyle=CHAIN, color=GREY, zorder=1.5)
    for x, y, diameter in flange.all_holes():
        paper.line(at(Circle(diameter / 2).around() + (x, y)), THICK, zorder=5)
        for ahead in (diameter / 2 + 1.5 / at.scale) * np.stack([RIGHT, UP]):
            paper.line(at([(x, y) - ahead, (x, y) + ahead]), color=GREY, zorder=1.5)

    for (text, holes), (right, up) in zip(kinds_of_holes(views.mount), NOTE_CORNERS, strict=False):
        x, y, diameter = max(holes, key=lambda hole, corner=(right, up): np.dot(hole[:2], corner))
        tip = at((x, y) + 0.5**0.5 * diameter / 2 * np.array([right, up]))
        shelf = at.x + right * max(right * (tip[0] - at.x), 6.5), over if up > 0 else under
        paper.leader(tip, shelf, text, right)


def kinds_of_holes(mount: Mount) -> Iterator[tuple[str, list[tuple[float, float, float]]]]:
    """Yield for each kind of hole through the flange its note, and x, y and diameter (mm) of each hole."""
    flange = mount.flange
    if flange is not None and (screws := flange.screws) is not None:
        yield f"{screws.count} \u00d7 \u00d8{mm(screws.diameter)} on \u00d8{mm(screws.circle)}", list(screws.holes())
    holes = flange.holes if flange else ()
    for diameter in dict.fromkeys(d for _, _, d in holes):
        alike = [hole for hole in holes if hole[2] == diameter]
        yield f"{len(alike)} \u00d7 " * (len(alike) > 1) + f"\u00d8{mm(diameter)}", alike


def _contours(paper: Paper, views: Views, at: PaperFrame) -> str:
    """Draw contours of z; return the step between them in words, "" if the back is flat."""
    x, y, z = _heights(views)
    low, high = float(np.nanmin(z)), float(np.nanmax(z))
    if not high - low > 1e-9 * max(1.0, abs(low), abs(high)):
        return ""
    step = round_up((high - low) / MAX_CONTOURS)
    levels = step * np.arange(np.ceil(low / step), np.floor(high / step) + 1)
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    on_paper = np.moveaxis(at(np.stack([x, y], axis=-1)), -1, 0)
    drawn = paper.axes.contour(*on_paper, z, levels, colors=BLUE, linewidths=0.55, zorder=2)
    size, ground = NUMBERS / TYPE_POINT, {"facecolor": "white", "edgecolor": "none", "pad": 0.4}
    edges = [edge for edge in (views.rim, views.used) if edge is not None]
    for label in paper.axes.clabel(drawn, fmt=f"%.{decimals}f", fontsize=size, inline=False, zorder=3):
        off = np.abs(np.subtract(label.get_position(), (at.x, at.y)))
        clear = [*off, np.hypot(*off) - AXIS_LENGTH, *(at.scale * abs(edge.depth(*off / at.scale)) for edge in edges)]
        if min(clear) < width_of(label.get_text(), NUMBERS) / 2 + 0.5:  # it would cover an axis, the frame or an edge
            label.remove()
        label.set_bbox(ground)
    return f"{number(step)} mm" if step >= 1e-3 else f"{number(1e3 * step)} \u00b5m"


def _heights(views: Views) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y and z (mm) of the back on a grid of its chart; z is NaN outside the rim and where it overhangs."""
    outline = views.lens.outline
    chart = np.meshgrid(*(np.linspace(-end, end, CONTOUR_POINTS) for end in outline.half_extent))
    points, normals = points_and_normals(views.lens.back, *chart)
    x, y, z = np.moveaxis(points, -1, 0)
    return x, y, np.where((outline.depth(*chart) >= 0) & (normals[..., 2] > 0), z - views.origin, np.nan)


# --- the sections -----------------------------------------------------------------------------------------------------


def _section(paper: Paper, views: Views, which: int, scale: float, *, left: float, middle: float) -> None:
    """Draw section 0 (x = 0, y up) or 1 (y = 0, x up) with z to the right from `left` on, its axis at y = `middle`."""
    cut, half = views.cuts[which], [scale * half for half in views.outermost.half_extent]
    (lowest, highest), _ = cut.ends
    at, right = PaperFrame(scale, left - scale * lowest, middle), left + scale * (highest - lowest)
    reach, sense = half[1 - which], views.lens.passes.sense
    for body in cut.bodies:  # cut material: tinted, with thin lines at 45 degrees (ISO 128-50)
        paper.area(at(body), facecolor=GLASS, hatch="//", edgecolor=GREY, zorder=0.5)
        paper.line(at(np.concatenate([body, body[1:2]])), THICK, zorder=5)
    for edge in cut.behind:
        paper.line(at(edge), THICK, zorder=5)
    paper.axis((left - 3, middle), (right + 3, middle))
    title = f"{'AB'[which]}\u2013{'AB'[which]}  ({'xy'[which]} = 0)"
    paper.text((left + right) / 2, middle + max(half) + 12, title, ha="center", weight="bold")
    for (low, high), level, feet in _thicknesses(views, which, at, reach):
        paper.dimension((at.x + scale * low, at.x + scale * high), level, feet, mm(high - low))
    room = max(scale * cut.front_ends[1] - 2, MIN_ROOM)
    turned = {"rotation": 90, "rotation_mode": "anchor", "ha": "center"}
    for beside, names in zip((left - 1.6, right + 1.6 + 0.8 * LETTERS), views.names, strict=True):
        name = next((name for name in names if width_of(name, LETTERS) <= room), names[-1])
        paper.text(beside, middle + room / 2 + 1, name, room=room, **turned)
    inside = left - 16 <= at.x <= right + 3
    _frame(paper, (at.x if inside else left - 15.5, middle), ("z", "yx"[which]), min(AXIS_LENGTH, reach))
    if which == 1:
        _walls(paper, views, at, reach)
        return
    start = left - 15.5 if sense > 0 else right + 10  # arrow in the direction of the light
    end, y = start + sense * 8.5, middle - 9
    paper.line([(start, y), (end - sense, y)], 0.25, color=VERMILION)
    paper.arrow((end, y), sense * RIGHT, VERMILION)
    paper.text((start + end) / 2, y - 3, "light", NOTES, ha="center", color=VERMILION)


def _thicknesses(
    views: Views, which: int, at: PaperFrame, reach: float
) -> Iterator[tuple[tuple[float, float], float, tuple[float, float]]]:
    """Yield (ends in z, level, feet) of thicknesses, see Paper.dimension; reach: half the cut's height on paper."""
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
        if max(abs(lowest - front), abs(highest - back)) > EQUAL_DIMENSIONS:
            yield (lowest, highest), foot - 6, (middle, middle)
    if which == 0:
        yield (front, back), foot - 13, (middle, middle)


def _walls(paper: Paper, views: Views, at: PaperFrame, reach: float) -> None:
    """Write draft and bevel of the lens's walls beside the cut's lower end, and of the flange's walls below the cut."""
    mount, cut, flange = views.mount, views.cuts[1], views.mount.flange
    if words := wall_words(mount):
        tip = at((cut.front[0], cut.front_ends[0]))
        paper.leader(tip, (tip[0] - 2.0, tip[1] + 3.5), words, -1)
    if flange is not None and (words := wall_words(flange)):
        x, _ = at((flange.z - views.origin + flange.thickness / 2, 0.0))
        paper.leader((x, at.y - reach), (x - 1.5, at.y - reach - 5.0), words, -1)


def wall_words(walls: Mount | Flange) -> str:
    """Return draft and bevel in the words of a drawing, "" if both are 0."""
    draft, bevel = f"draft {walls.draft:g}\u00b0", f"{walls.bevel:g} \u00d7 45\u00b0"
    return ", ".join([draft] * bool(walls.draft) + [bevel] * bool(walls.bevel))


def _frame(paper: Paper, at: Point, names: tuple[str, str], size: float) -> None:
    """Draw the coordinate frame of the file with its origin at `at`: named arrows, `size` mm long, right and up."""
    for towards, name, off in ((RIGHT, names[0], (GAP, 0.6)), (UP, names[1], (0.8, -0.6))):
        tip = at + size * towards
        paper.line([at, tip - towards], 0.35, color=VERMILION, zorder=6)
        paper.arrow(tip, towards, VERMILION, zorder=6)
        paper.text(*(tip + off), name, NOTES, color=VERMILION, style="italic", zorder=6)
