"""A side view of a scene with its dimensions: light, lens and wall, drawn from the keys of its text.

The text need not be valid, and the drawing is not to scale.  An element with data-of belongs to all keys that
begin with its value, and is highlighted while one of them is edited.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bstcad.app.form import environment
from bstcad.app.kinds import are_numbers, is_mirror, value_at


def svg(data: Mapping[str, Any]) -> str:
    """Return the drawing as an SVG element; "" without a lens, a source or a target."""
    lens, target, source = (data.get(name) for name in ("lens", "target", "source"))
    targets = target if isinstance(target, list) else [target]
    if not all(isinstance(table, Mapping) for table in (lens, source, *targets)) or not targets:
        return ""
    dome = value_at("back.kind", lens) == "radial"
    front, wall = _number("front.z", lens), _number("z", targets[0])
    back = _dome_z(lens) if dome else _number("back.z", lens)
    sizes = {"outline": _across(lens.get("outline")), "thickness": _between(front, back)}
    sizes |= {"width": _range(targets[0].get("x")), "height": _range(targets[0].get("y"))}
    kinds = {
        "mirror": is_mirror(data),
        "point": source.get("kind") != "collimated",
        "walls": len(targets),
        "dome": dome,
    }
    template = environment().get_template("sketch.svg.j2")
    return template.render(distance=_between(back, wall), **sizes, **kinds)


def _number(key: str, data: Any) -> float | None:
    value = value_at(key, data) if isinstance(data, Mapping) else None
    return value if are_numbers(value) else None


def _dome_z(lens: Any) -> float | None:
    """Return z (mm) of the vertex of a dome; None if a number is missing."""
    centre, radius = value_at("back.centre", lens) or [0.0], _number("back.radius", lens)
    known = isinstance(centre, list) and are_numbers(centre[-1]) and radius is not None
    return centre[-1] + radius if known else None


def _between(start: float | None, end: float | None) -> str:
    """Return a distance along z as text; "" if one of the positions is unknown."""
    return "" if start is None or end is None else f"{end - start:.6g} mm"


def _across(outline: Any) -> str:
    width, height, radius, diameter = (_number(key, outline) for key in ("width", "height", "radius", "diameter"))
    if width is not None and height is not None:
        return f"{width:g} × {height:g} mm"
    diameter = 2 * radius if diameter is None and radius is not None else diameter
    return "" if diameter is None else f"ø {diameter:g} mm"


def _range(ends: Any) -> str:
    known = isinstance(ends, list) and len(ends) == 2 and are_numbers(*ends)
    return f"{ends[1] - ends[0]:.6g} mm" if known else ""
