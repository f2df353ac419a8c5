"""A drawing of a scene from the side, with its dimensions: light, lens and wall, as the keys of its text have them.

It is drawn by what stands in the text, right or wrong, and is not to scale: lens and wall are each drawn in a size that
can be seen.  An element with data-of belongs to the keys that begin so, and lights up while one of them is changed.
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

from bstcad.app.kinds import is_mirror

WIDE, HIGH, AXIS = 640, 250, 108  # of the drawing, and where its axis is
LAMP, LENS, WALL = 60, 210, 560  # places along the axis
LENS_HALF, WALL_HALF = 58, 78  # half heights
LEAST = 34  # pixels of glass


def svg(data: Mapping[str, Any]) -> str:
    """The drawing as an SVG element; "" where the tables have no lens or no target."""
    lens, target, source = (data.get(name) for name in ("lens", "target", "source"))
    targets = target if isinstance(target, list) else [target]
    if not all(isinstance(table, Mapping) for table in (lens, source, *targets)) or not targets:
        return ""
    front, back = _number(lens, "front", "z"), _number(lens, "back", "z")
    mirror = is_mirror(data)
    parts = [*_light(source, mirror), *(_mirror() if mirror else _glass()), *_walls(targets)]
    z = _number(targets[0], "z")
    away = None if None in (z, back) else z - back
    thick = None if None in (front, back) else back - front
    parts += _dimension(LENS + (0 if mirror else LEAST), WALL, HIGH - 24, words=_mm(away), of="target.z")
    if not mirror:
        parts += _dimension(LENS, LENS + LEAST, AXIS + LENS_HALF + 14, words=_mm(thick), of="lens.back.z")
    parts += _upright(LENS - 16, LENS_HALF, _across(lens.get("outline")), "lens.outline")
    parts += _upright(WALL + 40, WALL_HALF, _range(targets[0].get("y")), "target.y")
    parts.append(_label(WALL, AXIS - WALL_HALF - 10, _range(targets[0].get("x")), "target.x"))
    words = f"Side view: the {'mirror' if mirror else 'lens'}, {_mm(away) or 'some way'} before the wall; not to scale."
    begin = f'<svg class="sketch" viewBox="0 0 {WIDE} {HIGH}" role="img" aria-label="{escape(words)}">'
    return f"{begin}{''.join(parts)}</svg>"


def _light(source: Mapping[str, Any], mirror: bool) -> list[str]:
    """Rays to the lens, from a lamp or from afar."""
    ends = [AXIS + k * LENS_HALF * 0.8 for k in (-1, -0.5, 0, 0.5, 1)]
    start = WALL if mirror else LAMP
    if source.get("kind") == "point":
        lamp = f'<circle cx="{start}" cy="{AXIS}" r="7" class="lamp" data-of="source"/>'
        return [*(_line(start, AXIS, LENS, end, "ray") for end in ends), lamp]
    first = WALL - 60 if mirror else 16
    return [_line(first, end, LENS, end, "ray", "source") for end in ends]


def _glass() -> list[str]:
    top, low, right = AXIS - LENS_HALF, AXIS + LENS_HALF, LENS + LEAST
    wave = f"C {right - 12} {AXIS + 28}, {right + 10} {AXIS + 12}, {right - 4} {AXIS}"
    shape = f"M {LENS} {top} L {LENS} {low} L {right} {low} {wave} S {right + 6} {AXIS - 34}, {right} {top} Z"
    rays = [
        _line(right, AXIS + k * LENS_HALF * 0.8, WALL, AXIS + j * WALL_HALF * 0.9, "ray")
        for k, j in ((-1, -0.6), (-0.5, -1), (0, 0.25), (0.5, 0.7), (1, 1))
    ]
    return [*rays, f'<path d="{shape}" class="glass" data-of="lens"/>']


def _mirror() -> list[str]:
    rays = [
        _line(LENS, AXIS + k * LENS_HALF * 0.8, WALL, AXIS + j * WALL_HALF * 0.9, "ray")
        for k, j in ((-1, -1), (0, 0.2), (1, 1))
    ]
    shape = f"M {LENS} {AXIS - LENS_HALF} q -14 {LENS_HALF} 0 {2 * LENS_HALF} l -12 0 l 0 {-2 * LENS_HALF} Z"
    return [*rays, f'<path d="{shape}" class="metal" data-of="lens"/>']


def _walls(targets: list[Any]) -> list[str]:
    """The wall, and others before it."""
    places = [WALL - 70 * (len(targets) - 1 - k) for k in range(len(targets))]
    return [
        _line(x, AXIS - WALL_HALF, x, AXIS + WALL_HALF, "wall", f"target[{k}]" if k else "target")
        for k, x in enumerate(places)
    ]


def _line(x: float, y: float, to_x: float, to_y: float, kind: str, of: str = "") -> str:
    belongs = f' data-of="{of}"' if of else ""
    return f'<line x1="{x:g}" y1="{y:g}" x2="{to_x:g}" y2="{to_y:g}" class="{kind}"{belongs}/>'


def _dimension(x: float, to_x: float, y: float, words: str, of: str) -> list[str]:
    """A dimension along the axis; none without a number."""
    if not words:
        return []
    ends = [_line(end, y - 5, end, y + 5, "size") for end in (x, to_x)]
    return [f'<g data-of="{of}">', _line(x, y, to_x, y, "size"), *ends, _label((x + to_x) / 2, y + 16, words), "</g>"]


def _upright(x: float, half: float, words: str, of: str) -> list[str]:
    """A dimension across the axis."""
    if not words:
        return []
    ends = [_line(x - 5, AXIS + k * half, x + 5, AXIS + k * half, "size") for k in (-1, 1)]
    label = (
        f'<text x="{x - 7:g}" y="{AXIS}" class="label" transform="rotate(-90 {x - 7:g} {AXIS})">{escape(words)}</text>'
    )
    return [f'<g data-of="{of}">', _line(x, AXIS - half, x, AXIS + half, "size"), *ends, label, "</g>"]


def _label(x: float, y: float, words: str, of: str = "") -> str:
    belongs = f' data-of="{of}"' if of else ""
    return f'<text x="{x:g}" y="{y:g}" class="label"{belongs}>{escape(words)}</text>' if words else ""


def _number(table: Any, *names: str) -> float | None:
    for name in names:
        table = table.get(name) if isinstance(table, Mapping) else None
    return float(table) if isinstance(table, int | float) and not isinstance(table, bool) else None


def _mm(value: float | None) -> str:
    return "" if value is None else f"{value:.6g} mm"


def _across(outline: Any) -> str:
    """The size of an outline in words."""
    sides = [_number(outline, name) for name in ("width", "height")]
    if None not in sides:
        return f"{sides[0]:g} × {sides[1]:g} mm"
    radius, diameter = _number(outline, "radius"), _number(outline, "diameter")
    diameter = diameter if diameter is not None else None if radius is None else 2 * radius
    return "" if diameter is None else f"ø {diameter:g} mm"


def _range(ends: Any) -> str:
    """How long a range is."""
    known = isinstance(ends, list) and len(ends) == 2 and all(isinstance(end, int | float) for end in ends)
    return f"{ends[1] - ends[0]:.6g} mm" if known else ""
