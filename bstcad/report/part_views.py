"""The views of a part on its data sheet: two sections through the axis, and the back as a map of heights.

All of them to one scale of the standard series (ISO 5455), in first-angle projection (ISO 128-30): the view from the
right, along -z, stands left of the section that is seen along +x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bstcad.analysis.used_area import Used
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Outline
from bstcad.optics.surfaces import sag
from bstcad.report.drafting import CHAIN, LETTERS, OFF, THICK, Paper, fitted, width_of
from bstcad.report.drawing import BLUE, GLASS, GREY, VERMILION
from bstcad.report.units import number

POINTS = 401  # along a cut
MAP_POINTS = 241  # of the map of heights, each way
LEVELS = 18  # contour lines, about
HATCH = 3.0  # mm of paper between the lines of a hatch
NUMBERS = 1.9  # mm: the heights that stand on contour lines
AXES = 7.0  # mm: length of the arrows of the frame
# Room on paper (mm): left of the plan, between it and the first section, between the sections, right of the last;
# above all views, and below them.
SIDES, HEAD, FOOT = (17.0, 26.0, 21.0, 9.0), 17.0, 22.0


@dataclass(frozen=True, eq=False)
class Cut:
    """The lens cut along x = 0 or y = 0; mm."""

    along: np.ndarray  # (n,) y, or x
    front: np.ndarray  # (n,) z
    back: np.ndarray


@dataclass(frozen=True, eq=False)
class Views:
    """What there is to draw of a lens."""

    lens: Lens
    cuts: tuple[Cut, Cut]  # x = 0 and y = 0
    x: np.ndarray  # (n,) of the map (mm)
    y: np.ndarray
    heights: np.ndarray  # (n, n) z of the back, row 0 = y min; NaN outside
    used: Used | None  # of the back; None: all of it
    words: tuple[tuple[str, str], tuple[str, str]]  # of the front and of the back: in a few words, and in fewer


def views_of(lens: Lens, used: Used | None, words: tuple[tuple[str, str], tuple[str, str]]) -> Views:
    """The views of a lens."""
    a, b = lens.outline.half_extent
    x, y = (np.linspace(-end, end, MAP_POINTS) for end in (a, b))
    grid_x, grid_y = np.meshgrid(x, y)
    inside = ~(np.hypot(grid_x, grid_y) > a) if isinstance(lens.outline, Circle) else np.full(grid_x.shape, True)
    heights = np.where(inside, sag(lens.back, grid_x, grid_y), np.nan)
    along_y, along_x = np.linspace(-b, b, POINTS), np.linspace(-a, a, POINTS)
    cuts = (_cut(lens, 0.0, along_y), _cut(lens, along_x, 0.0))
    return Views(lens, tuple(Cut(at, *z) for at, z in zip((along_y, along_x), cuts, strict=True)), x, y, heights, used,
                 words)  # fmt: skip


def _cut(lens: Lens, x: np.ndarray | float, y: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    return sag(lens.front, x, y), sag(lens.back, x, y)


def scale_for(views: Views, width: float, height: float) -> float:
    """The largest scale of the series 1, 2, 5, 10 … by which all fits on so much paper (mm)."""
    a, b = views.lens.outline.half_extent
    wide = 2 * a + sum(float(np.ptp([cut.front, cut.back])) for cut in views.cuts)
    tall = 2 * max(a, b)
    most = min((width - sum(SIDES)) / wide, (height - HEAD - FOOT) / tall)
    decade = 10.0 ** np.floor(np.log10(most))
    return float(max(step * decade for step in (1, 2, 5) if step * decade <= most * (1 + 1e-9)))


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
    a, b = (scale * half for half in views.lens.outline.half_extent)
    thick = [scale * float(np.ptp([cut.front, cut.back])) for cut in views.cuts]
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
    place = middle - scale * max(views.lens.outline.half_extent) - 20.5
    paper.text(start, place, f"origin of x, y, z: {origin(views.lens)}", 2.1, right - 2 - start, color=VERMILION)
    return scale


def origin(lens: Lens) -> str:
    """Where the point (0, 0, 0) of the file lies on the axis, from the face that is nearer to it."""
    front, back = float(lens.front.z), float(sag(lens.back, 0.0, 0.0))
    near, name = (front, "front") if abs(front) <= abs(back) else (back, "back")
    if lens.reflects:
        name = "rear" if name == "front" else "mirror face"
    if not near:
        return f"where the axis meets the {name}"
    return f"on the axis, {length(abs(near))} mm to the {'left' if near > 0 else 'right'} of the {name}"


# --- the plan ---------------------------------------------------------------------------------------------------------


def _plan(paper: Paper, views: Views, scale: float, x0: float, y0: float) -> None:
    """The back as seen along -z, x to the right and y up, with its contour lines; (x0, y0): where the axis stands."""
    outline = views.lens.outline
    a, b = (scale * half for half in outline.half_extent)
    step = _contours(paper, views, scale, x0, y0)
    paper.line(_rim(outline, x0, y0, scale), THICK, zorder=5)
    if views.used is not None:
        patch = _patch_rim(views.used, x0, y0, scale)
        paper.line(patch, 0.25, color=VERMILION, linestyle=(0, (6, 2, 1, 2, 1, 2)), zorder=4)
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
    if isinstance(outline, Circle):
        paper.across((x0 - a, x0 + a), y0 - b - 12, (y0, y0), f"\u00d8{length(2 * outline.radius)}")
    else:
        paper.across((x0 - a, x0 + a), y0 - b - 12, (y0 - b, y0 - b), length(outline.width))
        paper.upright((y0 - b, y0 + b), x0 - a - 11, (x0 - a, x0 - a), length(outline.height))
    face = "Mirror face" if views.lens.reflects else "Back"
    paper.text(x0, y0 + b + 12, f"{face}, seen along \u2212z", ha="center", weight="bold")
    said = f"contours of z every {step}" if step else "no contours: the back is level"
    paper.text(x0, y0 - b - 17, said, 2.1, ha="center", color=BLUE)
    if views.used is not None:
        paper.text(x0, y0 - b - 20.5, "\u2013 \u00b7\u00b7 \u2013  clear aperture", 2.1, ha="center", color=VERMILION)


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
    outline, used = views.lens.outline, views.used
    edges = [(*(scale * half for half in outline.half_extent), isinstance(outline, Circle))]
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


def _rim(outline: Outline, x0: float, y0: float, scale: float) -> np.ndarray:
    """The outline on paper, closed."""
    a, b = (scale * half for half in outline.half_extent)
    if isinstance(outline, Circle):
        turn = np.linspace(0, 2 * np.pi, 361)
        return np.stack([x0 + a * np.cos(turn), y0 + a * np.sin(turn)], axis=1)
    return np.array([(x0 - a, y0 - b), (x0 + a, y0 - b), (x0 + a, y0 + b), (x0 - a, y0 + b), (x0 - a, y0 - b)])


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
    lowest = min(cut.front.min(), cut.back.min())
    front, back = (left + scale * (z - lowest) for z in (cut.front, cut.back))
    along = middle + scale * cut.along
    top, foot, right = along[-1], along[0], max(front.max(), back.max())
    body = np.concatenate([np.stack([front, along], 1), np.stack([back, along], 1)[::-1]])
    _hatched(paper, body)
    paper.line(np.concatenate([body, body[:2]]), THICK, zorder=5)
    _axis(paper, (left - 3, middle), (right + 3, middle))
    paper.text((left + right) / 2, middle + scale * max(views.lens.outline.half_extent) + 12,
               f"{letter}\u2013{letter}  ({fixed} = 0)", ha="center", weight="bold")  # fmt: skip
    centre = len(along) // 2
    for k, level in ((-1, top + 5), (0, foot - 6)):
        paper.across((front[k], back[k]), level, (along[k], along[k]), length(cut.back[k] - cut.front[k]))
    if which == 0:
        thick = length(cut.back[centre] - cut.front[centre])
        paper.across((front[centre], back[centre]), foot - 13, (middle, middle), thick)
    room = top - middle - 2
    for beside, words in zip((left - 1.6, right + 1.6 + 0.8 * LETTERS), views.words, strict=True):
        said = next((said for said in words if width_of(said, LETTERS) <= room), words[-1])
        paper.text(
            beside,
            middle + (top - middle) / 2,
            *fitted(said, LETTERS, room, least=0.5),
            rotation=90,
            rotation_mode="anchor",
            ha="center",
        )
    origin = left + scale * (0.0 - lowest)
    inside = left - 16 <= origin <= right + 3
    _frame(paper, origin if inside else left - 15.5, middle, ("z", up), min(AXES, scale * cut.along[-1]))
    if which == 0:
        _light(paper, views.lens.reflects, left, right, middle)


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
