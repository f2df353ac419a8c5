"""The views of a part on its data sheet: two sections through the axis, and the part from the side of its back.

Within the rim the latter is a map of heights; around it stand flange and holes.

All of them to one scale of the standard series (ISO 5455), in first-angle projection (ISO 128-30): the view from the
right, along -z, stands left of the section that is seen along +x.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bstcad.analysis.used_area import Used
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import sag
from bstcad.report.drafting import CHAIN, LETTERS, OFF, THICK, Paper, fitted, width_of
from bstcad.report.drawing import BLUE, GLASS, GREY, VERMILION
from bstcad.report.part_profile import Profile, half_extent, profile
from bstcad.report.units import number
from bstcad.scene.mount import Box, Mount, Round
from bstcad.shop import part_drawings

MAP_POINTS = 241  # of the map of heights, each way
LEVELS = 18  # contour lines, about
HATCH = 3.0  # mm of paper between the lines of a hatch
NUMBERS = 1.9  # mm: the heights that stand on contour lines
CALLS = ((1, 1), (-1, -1), (1, -1))  # corners of the plan, right and up, where kinds of holes are called
SAME = 5e-4  # mm: dimensions that read alike
AXES = 7.0  # mm: length of the arrows of the frame
# Room on paper (mm): left of the plan, between it and the first section, between the sections, right of the last;
# above all views, and below them.
SIDES, HEAD, FOOT = (17.0, 26.0, 21.0, 9.0), 17.0, 22.0


@dataclass(frozen=True, eq=False)
class Views:
    """What there is to draw of a part, in the frame of its file; mm."""

    lens: Lens  # within the rim
    mount: Mount  # of a bare lens one that says nothing
    origin: float  # z in the scene's frame that is 0 in the file
    cuts: tuple[Profile, Profile]  # x = 0 and y = 0
    x: np.ndarray  # (n,) of the map (mm)
    y: np.ndarray
    heights: np.ndarray  # (n, n) z of the back, row 0 = y min; NaN outside
    used: Used | None  # of the back; None: all of it
    words: tuple[tuple[str, str], tuple[str, str]]  # of the front and of the back: in a few words, and in fewer

    @property
    def rim(self) -> Round | Box:
        """Of the lens in the part."""
        return self.mount.rim_of(self.lens.outline)

    @property
    def outermost(self) -> Round | Box:
        """What all of it lies in."""
        return self.rim if self.mount.flange is None else self.mount.flange.outline

    @property
    def half(self) -> tuple[float, float]:
        """Half of how far it reaches along x and y (mm)."""
        return half_extent(self.outermost)

    @property
    def vertices(self) -> tuple[float, float]:
        """z (mm) where front and back cross the axis."""
        return float(self.lens.front.z) - self.origin, float(sag(self.lens.back, 0.0, 0.0)) - self.origin


def views_of(
    lens: Lens, used: Used | None, words: tuple[tuple[str, str], tuple[str, str]], mount: Mount | None = None,
    origin: float = 0.0,
) -> Views:  # fmt: skip
    """The views of a lens, in its mount if it has one; origin: z in the scene's frame (mm) that is 0 in the file."""
    rim = (mount or Mount()).rim_of(lens.outline)
    x, y = (np.linspace(-end, end, MAP_POINTS) for end in half_extent(rim))
    grid_x, grid_y = np.meshgrid(x, y)
    heights = np.where(rim.outline.depth(grid_x, grid_y) >= 0, sag(lens.back, grid_x, grid_y) - origin, np.nan)
    cuts = profile(lens, mount, True, origin), profile(lens, mount, False, origin)
    return Views(lens, mount or Mount(), origin, cuts, x, y, heights, used, words)


def scale_for(views: Views, width: float, height: float) -> float:
    """The largest scale of the series 1, 2, 5, 10 … by which all fits on so much paper (mm)."""
    a, b = views.half
    wide = 2 * a + sum(_thickness(cut) for cut in views.cuts)
    tall = 2 * max(a, b)
    most = min((width - sum(SIDES)) / wide, (height - HEAD - FOOT) / tall)
    decade = 10.0 ** np.floor(np.log10(most))
    return float(max(step * decade for step in (1, 2, 5) if step * decade <= most * (1 + 1e-9)))


def _thickness(cut: Profile) -> float:
    (low, high), _ = cut.ends
    return high - low


def scale_words(scale: float) -> str:
    """5:1, 1:1, 1:20."""
    return f"{scale:.6g}:1" if scale >= 1 else f"1:{1 / scale:.6g}"


def length(value: float) -> str:
    """mm to a micrometre, of what is smaller than that to three digits."""
    if 0 < abs(value) < 0.1:
        return f"{value:.3g}".replace("-", "\u2212")
    return f"{value:.3f}".rstrip("0").rstrip(".").replace("-", "\u2212")


def draw(paper: Paper, views: Views, left: float, low: float, right: float, high: float) -> float:
    """All views in that part of the paper (mm), side by side; the scale."""
    scale = scale_for(views, right - left, high - low)
    a, b = (scale * half for half in views.half)
    thick = [scale * _thickness(cut) for cut in views.cuts]
    spare = (right - left - sum(SIDES) - 2 * a - sum(thick)) / 6
    tall = 2 * max(a, b)
    middle = low + FOOT + tall / 2 + max(0.0, (high - low - HEAD - FOOT - tall) / 2)
    x = left + spare + SIDES[0]
    _plan(paper, views, scale, x + a, middle)
    x += 2 * a + SIDES[1] + 2 * spare
    start = x - 15.5
    _section(paper, views, 0, scale, x, middle)
    x += thick[0] + SIDES[2] + 2 * spare
    _section(paper, views, 1, scale, x, middle)
    place = middle - scale * max(views.half) - 20.5
    said = f"origin of x, y, z: {origin(views)}"
    paper.text(start, place, said, 2.1, right - 2 - start, color=VERMILION)
    return scale


def origin(views: Views) -> str:
    """Where the point (0, 0, 0) of the file lies on the axis, from the face that is nearer to it."""
    front, back = views.vertices
    near, name = (front, "front") if abs(front) <= abs(back) else (back, "back")
    if views.lens.reflects:
        name = "rear" if name == "front" else "mirror face"
    if not near:
        return f"where the axis meets the {name}"
    place = f"on the axis, {length(abs(near))} mm to the {'left' if near > 0 else 'right'} of the {name}"
    return f"{place}, in the flange's lower face" if views.mount.datum == "flange" else place


# --- the plan ---------------------------------------------------------------------------------------------------------


def _plan(paper: Paper, views: Views, scale: float, x0: float, y0: float) -> None:
    """The part as seen along -z, x to the right and y up, its back with contour lines; (x0, y0): the axis."""
    a, b = (scale * half for half in views.half)
    step = _contours(paper, views, scale, x0, y0)
    paper.line(path(views.rim, x0, y0, scale), THICK, zorder=5)
    if views.used is not None:
        patch = _patch_rim(views.used, x0, y0, scale)
        paper.line(patch, 0.25, color=VERMILION, linestyle=(0, (6, 2, 1, 2, 1, 2)), zorder=4)
    _around(paper, views, scale, x0, y0)
    _axis(paper, (x0 - a - 3, y0), (x0 + a + 3, y0))
    _axis(paper, (x0, y0 - b - 3), (x0, y0 + b + 3))
    _frame(paper, x0, y0, ("x", "y"), min(AXES, a, b))
    for sense in (-1, 1):  # where it is cut, and from where each cut is seen
        y, x = y0 + sense * (b + 3.2), x0 + sense * (a + 3.2)
        paper.line([(x0, y), (x0, y + 3.4 * sense)], THICK)
        paper.line([(x0, y + 1.7 * sense), (x0 + 3.2, y + 1.7 * sense)])
        paper.arrow((x0 + 4.2, y + 1.7 * sense), (1.0, 0.0))
        paper.text(x0 - 1.2, y + 1.7 * sense - 0.95, "A", weight="bold", ha="right")
        paper.line([(x, y0), (x + 3.4 * sense, y0)], THICK)
        paper.line([(x + 1.7 * sense, y0), (x + 1.7 * sense, y0 - 3.2)])
        paper.arrow((x + 1.7 * sense, y0 - 4.2), (0.0, -1.0))
        paper.text(x + 1.7 * sense, y0 + 1.0, "B", weight="bold", ha="center")
    outer = views.outermost
    if outer.shape == "circle":
        paper.across((x0 - a, x0 + a), y0 - b - 12, (y0, y0), f"\u00d8{length(outer.diameter)}")
    else:
        paper.across((x0 - a, x0 + a), y0 - b - 12, (y0 - b, y0 - b), length(outer.width))
        paper.upright((y0 - b, y0 + b), x0 - a - 11, (x0 - a, x0 - a), length(outer.height))
    face = "Mirror face" if views.lens.reflects else "Back"
    paper.text(x0, y0 + b + 12, f"{face}, seen along \u2212z", ha="center", weight="bold")
    said = f"contours of z every {step}" if step else "no contours: the back is level"
    paper.text(x0, y0 - b - 17, said, 2.1, ha="center", color=BLUE)
    if views.used is not None:
        paper.text(x0, y0 - b - 20.5, "\u2013 \u00b7\u00b7 \u2013  clear aperture", 2.1, ha="center", color=VERMILION)


def _around(paper: Paper, views: Views, scale: float, x0: float, y0: float) -> None:
    """Flange and holes around the lens, and what rim, corners and holes measure."""
    flange, outer, rim = views.mount.flange, views.outermost, views.rim
    a, b = (scale * half for half in views.half)
    over, under = y0 + b + 6.2, y0 - b - 6.2  # of notes, beside the marks of the cut A
    if corner := getattr(outer, "corner_radius", 0.0):
        inset = scale * corner * (1 - 0.5**0.5)
        paper.leader((x0 + a - inset, y0 - b + inset), (x0 + a + 2.0, y0 - b - 3.0), f"R{length(corner)}", 1)
    if flange is None:
        return
    paper.line(path(outer, x0, y0, scale), THICK, zorder=5)
    if taken := flange.thickness * np.tan(np.radians(flange.draft)) + flange.bevel * (
        1 - np.tan(np.radians(flange.draft))
    ):
        paper.line(path(_smaller(outer, taken), x0, y0, scale), 0.25, zorder=5)  # the edge of its upper face
    tip = _tip(rim, -1, 1)
    paper.leader((x0 + scale * tip[0], y0 + scale * tip[1]), (min(x0 - 6.5, x0 + scale * tip[0]), over),
                 f"lens {part_drawings.across(rim)}", -1)  # fmt: skip
    if radius := part_drawings.pitch_radius(views.mount):
        circle = Round(shape="circle", diameter=2 * radius)
        paper.line(path(circle, x0, y0, scale), linestyle=CHAIN, color=GREY, zorder=1.5)
    for x, y, diameter in flange.all_holes():
        at_x, at_y, r = x0 + scale * x, y0 + scale * y, scale * diameter / 2
        paper.line(path(Round(shape="circle", diameter=diameter), at_x, at_y, scale), THICK, zorder=5)
        paper.line([(at_x - r - 1.5, at_y), (at_x + r + 1.5, at_y)], color=GREY, zorder=1.5)
        paper.line([(at_x, at_y - r - 1.5), (at_x, at_y + r + 1.5)], color=GREY, zorder=1.5)
    kinds = list(hole_words(views.mount))[: len(CALLS)]

    def called(holes: list[tuple[float, float, float]], right: int, up: int) -> tuple[tuple, tuple]:
        """(tip, shelf) of the shortest leader from one of them to a corner."""
        found = []
        for x, y, diameter in holes:
            edge = scale * diameter / 2 * 0.5**0.5
            tip = x0 + scale * x + right * edge, y0 + scale * y + up * edge
            shelf = x0 + right * max(right * (tip[0] - x0), 6.5), over if up > 0 else under
            found.append((tip, shelf))
        return min(found, key=lambda pair: math.dist(*pair))

    def total(corners: Sequence[tuple[int, int]]) -> float:
        return sum(math.dist(*called(holes, *at)) for (_, holes), at in zip(kinds, corners, strict=True))

    for (text, holes), at in zip(kinds, min(itertools.permutations(CALLS, len(kinds)), key=total), strict=True):
        paper.leader(*called(holes, *at), text, at[0])


def hole_words(mount: Mount) -> Iterator[tuple[str, list[tuple[float, float, float]]]]:
    """Each kind of holes through the flange: how a drawing calls it, and x, y and diameter (mm) of them."""
    flange = mount.flange
    if flange is None:
        return
    if (screws := flange.screws) is not None:
        yield (
            f"{screws.count} \u00d7 \u00d8{length(screws.diameter)} on \u00d8{length(screws.circle)}",
            list(screws.holes()),
        )
    for diameter in dict.fromkeys(d for _, _, d in flange.holes):
        alike = [hole for hole in flange.holes if hole[2] == diameter]
        yield f"{len(alike)} \u00d7 " * (len(alike) > 1) + f"\u00d8{length(diameter)}", alike


def _tip(shape: Round | Box, right: int, up: int) -> tuple[float, float]:
    """Where a leader meets an outline in one of its quarters (mm)."""
    a, b = half_extent(shape)
    if shape.shape == "circle":
        return right * a * 0.5**0.5, up * b * 0.5**0.5
    return right * a / 2, up * b


def _smaller(shape: Round | Box, by: float) -> Round | Box:
    """An outline moved inwards (mm)."""
    if shape.shape == "circle":
        return Round(shape="circle", diameter=shape.diameter - 2 * by)
    size = {"width": shape.width - 2 * by, "height": shape.height - 2 * by}
    return Box(shape="rectangle", **size, corner_radius=max(shape.corner_radius - by, 0.0))


def _contours(paper: Paper, views: Views, scale: float, x0: float, y0: float) -> str:
    """Draw the lines of equal z; how far apart they are, in words, "" if there are none."""
    low, high = float(np.nanmin(views.heights)), float(np.nanmax(views.heights))
    if not high - low > 1e-9 * max(1.0, abs(low), abs(high)):
        return ""
    decade = 10.0 ** np.floor(np.log10((high - low) / LEVELS))
    step = float(next(k * decade for k in (1, 2, 5, 10) if (high - low) / (k * decade) <= LEVELS))
    levels = step * np.arange(np.ceil(low / step), np.floor(high / step) + 1)
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    x, y = x0 + scale * views.x, y0 + scale * views.y
    drawn = paper.axes.contour(x, y, views.heights, levels, colors=BLUE, linewidths=0.55, zorder=2)
    taken = [np.zeros((0, 2))]
    for level, lines in zip(levels, drawn.allsegs, strict=True):
        _heighted(paper, f"{level:.{decimals}f}", lines, views, (x0, y0), scale, taken)
    return f"{number(step)} mm" if step >= 1e-3 else f"{number(1e3 * step)} \u00b5m"


def _heighted(
    paper: Paper, text: str, lines: Sequence[np.ndarray], views: Views, middle: tuple[float, float], scale: float,
    taken: list[np.ndarray],
) -> None:  # fmt: skip
    """Write its height on a contour, where that is clear of the rim, the axes and all heights that stand there."""
    room = width_of(text, NUMBERS)
    used, rim = views.used, views.rim
    edges = [(*(scale * half for half in half_extent(rim)), rim.shape == "circle")]
    if used is not None:
        edges.append((scale * used.width / 2, scale * used.height / 2, used.shape == "circle"))
    best, least = None, room / 2 + 1.0
    for line in lines:
        for place, ahead in zip(line[2:-2:2], line[4::2], strict=False):
            off = np.abs(place - middle)
            rim = min(_from_edge(off, *edge) for edge in edges)
            others = np.hypot(*(np.concatenate(taken) - place).T)
            clear = min(rim, off.min(), np.hypot(*off) - AXES - 3, 0.5 * others.min(initial=1e9))
            if clear > least:
                best, least = (place, ahead - place), min(clear, 3 * room)
    if best is None:
        return
    (x, y), (u, v) = best
    taken.append(best[0][None])
    turn = (np.degrees(np.arctan2(v, u)) + 90) % 180 - 90
    ground = {"facecolor": "white", "edgecolor": "none", "pad": 0.4}
    paper.text(x, y, text, NUMBERS, rotation=turn, ha="center", va="center", color=BLUE, bbox=ground, zorder=3)


def _from_edge(off: np.ndarray, a: float, b: float, is_round: bool) -> float:
    """How far (mm of paper) a point, |x| and |y| from the axis, is from the edge of a disc or a rectangle about it."""
    inside = a - np.hypot(*off) if is_round else min(a - off[0], b - off[1])
    return abs(float(inside))


def path(shape: Round | Box, x0: float, y0: float, scale: float) -> np.ndarray:
    """An outline about (x0, y0) on paper, closed (n, 2)."""
    turn = np.linspace(0, 2 * np.pi, 361)
    cos, sin, (a, b) = np.cos(turn), np.sin(turn), half_extent(shape)
    if shape.shape == "circle":
        return np.stack([x0 + scale * a * cos, y0 + scale * b * sin], axis=1)
    r = shape.corner_radius
    x, y = np.sign(cos) * (a - r) + r * cos, np.sign(sin + 1e-12) * (b - r) + r * sin
    points = np.stack([x0 + scale * x, y0 + scale * y], axis=1)
    return np.concatenate([points, points[:1]])


def _patch_rim(used: Used, x0: float, y0: float, scale: float) -> np.ndarray:
    """The edge of the clear aperture on paper, closed."""
    a, b = scale * used.width / 2, scale * used.height / 2
    if used.shape == "circle":
        turn = np.linspace(0, 2 * np.pi, 361)
        return np.stack([x0 + a * np.cos(turn), y0 + b * np.sin(turn)], axis=1)
    return np.array([(x0 - a, y0 - b), (x0 + a, y0 - b), (x0 + a, y0 + b), (x0 - a, y0 + b), (x0 - a, y0 - b)])


# --- the sections -----------------------------------------------------------------------------------------------------


def _section(paper: Paper, views: Views, which: int, scale: float, left: float, middle: float) -> None:
    """A section, z to the right, its lowest z at `left`; which: 0 is x = 0, with y up, 1 is y = 0, with x up."""
    cut, letter, fixed, up = views.cuts[which], "AB"[which], "xy"[which], "yx"[which]
    (lowest, highest), _ = cut.ends
    half = scale * views.half[1 - which]
    top, foot, right = middle + half, middle - half, left + scale * (highest - lowest)

    def at(z: float) -> float:
        return left + scale * (z - lowest)

    for body in cut.bodies:
        points = np.stack([at(body[:, 0]), middle + scale * body[:, 1]], 1)
        _hatched(paper, points)
        paper.line(np.concatenate([points, points[:2]]), THICK, zorder=5)
    for edge in cut.behind:
        paper.line(np.stack([at(edge[:, 0]), middle + scale * edge[:, 1]], 1), THICK, zorder=5)
    _axis(paper, (left - 3, middle), (right + 3, middle))
    paper.text((left + right) / 2, middle + scale * max(views.half) + 12,
               f"{letter}\u2013{letter}  ({fixed} = 0)", ha="center", weight="bold")  # fmt: skip
    _dimensions(paper, views, which, scale, at, middle, (foot, top))
    if which == 0:
        front, back = views.vertices
        paper.across((at(front), at(back)), foot - 13, (middle, middle), length(back - front))
    room = scale * cut.front_ends[1] - 2
    for beside, words in zip((left - 1.6, right + 1.6 + 0.8 * LETTERS), views.words, strict=True):
        said = next((said for said in words if width_of(said, LETTERS) <= room), words[-1])
        paper.text(
            beside,
            middle + room / 2 + 1,
            *fitted(said, LETTERS, room, least=0.5),
            rotation=90,
            rotation_mode="anchor",
            ha="center",
        )
    inside = left - 16 <= at(0.0) <= right + 3
    _frame(paper, at(0.0) if inside else left - 15.5, middle, ("z", up), min(AXES, half))
    if which == 0:
        _light(paper, views.lens.reflects, left, right, middle)


def _dimensions(paper: Paper, views: Views, which: int, scale: float, at, middle: float, edges: tuple[float, float]):
    """Thicknesses along z: of the edge, or of the flange, where it lies and all of it; then how walls lean."""
    cut, flange, (foot, top) = views.cuts[which], views.mount.flange, edges
    if flange is None:
        for k, level in ((1, top + 5), (0, foot - 6)):
            front, back = cut.front[k], cut.back[k]
            feet = middle + scale * cut.front_ends[k], top if k else foot
            paper.across((at(front), at(back)), level, feet, length(back - front))
    else:
        low, high, (lowest, highest) = flange.z - views.origin, flange.z + flange.thickness - views.origin, cut.ends[0]
        if which == 0:
            paper.across((at(low), at(high)), top + 5, (top, top), length(high - low))
            if max(abs(lowest - views.vertices[0]), abs(highest - views.vertices[1])) > SAME:
                paper.across((at(lowest), at(highest)), foot - 6, (middle, middle), length(highest - lowest))
        else:
            front = views.vertices[0]
            ends, feet = ((front, low), (middle, top)) if front < low else ((low, front), (top, middle))
            paper.across(tuple(map(at, ends)), top + 5, feet, length(abs(front - low)))
    if which == 1:
        _walls(paper, views, scale, at, middle, foot)


def _walls(paper: Paper, views: Views, scale: float, at, middle: float, foot: float) -> None:
    """Draft and bevel of the lens's own walls, beside the lower end of the cut, and of the flange's, below it."""
    mount, cut = views.mount, views.cuts[1]
    if lines := wall_words(mount.draft, mount.bevel):
        tip = at(cut.front[0]), middle + scale * cut.front_ends[0]
        paper.leader(tip, (tip[0] - 2.0, tip[1] + 3.5), lines, -1)
    flange = mount.flange
    if flange is not None and (lines := wall_words(flange.draft, flange.bevel)):
        tip = at(flange.z - views.origin + flange.thickness / 2), foot
        paper.leader(tip, (tip[0] + 1.5, foot - 5.0), lines, 1)


def wall_words(draft: float, bevel: float) -> str:
    """Of both what there is, as a drawing calls it."""
    return ", ".join(filter(None, (f"draft {draft:g}\u00b0" * bool(draft), f"{bevel:g} \u00d7 45\u00b0" * bool(bevel))))


def _light(paper: Paper, reflects: bool, left: float, right: float, middle: float) -> None:
    """An arrow with the light, before the face that it meets first."""
    y = middle - 9
    ends = (right + 10, right + 2) if reflects else (left - 15.5, left - 7)
    paper.line([(ends[0], y), (ends[1], y)], 0.25, color=VERMILION)
    paper.area([(ends[1], y), (ends[1] + np.sign(ends[0] - ends[1]) * 2, y + 0.5),
                (ends[1] + np.sign(ends[0] - ends[1]) * 2, y - 0.5)], color=VERMILION)  # fmt: skip
    paper.text(sum(ends) / 2, y - 3, "light", 2.1, ha="center", color=VERMILION)


def _hatched(paper: Paper, body: np.ndarray) -> None:
    """Cut material: a tone, and thin lines at 45 degrees (ISO 128-50)."""
    shape = paper.area(body, color=GLASS, zorder=0.5)
    low, high = body.min(axis=0), body.max(axis=0)
    tall = high[1] - low[1]
    for start in np.arange(low[0] - tall, high[0], HATCH):
        paper.line([(start, low[1]), (start + tall, high[1])], 0.09, color=GREY, clip_path=shape, zorder=0.6)


def _axis(paper: Paper, start: tuple[float, float], end: tuple[float, float]) -> None:
    paper.line([start, end], linestyle=CHAIN, color=GREY, zorder=1.5)


def _frame(paper: Paper, x: float, y: float, names: tuple[str, str], size: float) -> None:
    """The frame of the file, with its origin at (x, y): arrows to the right and up, by their names."""
    for tip, towards, name in (((x + size, y), (1.0, 0.0), names[0]), ((x, y + size), (0.0, 1.0), names[1])):
        paper.line([(x, y), tip], 0.35, color=VERMILION, zorder=6)
        head = [tip[0] - 1.8 * towards[0], tip[1] - 1.8 * towards[1]]
        paper.area([tip, (head[0] - 0.5 * towards[1], head[1] + 0.5 * towards[0]),
                    (head[0] + 0.5 * towards[1], head[1] - 0.5 * towards[0])], color=VERMILION, zorder=6)  # fmt: skip
        place = (tip[0] + OFF, y + 0.6) if towards[0] else (x + 0.8, tip[1] - 0.6)
        paper.text(*place, name, 2.1, color=VERMILION, style="italic", zorder=6)
