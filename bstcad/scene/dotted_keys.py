"""Dotted keys, lens.back.z or target[1].text: a value of the tables of a scene file is set by one.

A number in brackets is that of a table in a list, from 0.  One table, and a list of one, are the same.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator, Sequence
from typing import Any

from bstcad.scene.errors import SceneError

PICTURES = ("text", "image", "sample", "uniform", "profile")  # a target has exactly one
OUTLINES = (
    "source.aperture", "lens.outline", "target.outline", "lens.front.outline", "before.outline", "behind.outline",
)  # fmt: skip
ONE_OF = {  # alternatives among the keys of a table: a later one replaces the others
    "target": PICTURES, **dict.fromkeys(("lens", "before", "behind"), ("material", "index")),
    **dict.fromkeys(OUTLINES, ("radius", "diameter")),
}  # fmt: skip
STEP = re.compile(r"([^\[\]]+)(?:\[(\d{1,6})\])?")  # a name, and the number of a table in its list

Step = tuple[str, int | None]


def override(data: dict[str, Any], key: str, value: Any, shown: str) -> None:
    """Set a dotted key, `shown` so in a sentence; None takes it out.  It replaces its alternatives (ONE_OF)."""
    found = [STEP.fullmatch(part) for part in key.split(".")]
    if not all(found):
        raise SceneError(f"{shown}: is no dotted key; write one such as lens.back.control_points")
    *tables, last = ((match[1], None if match[2] is None else int(match[2])) for match in found)
    table = data
    for k, step in enumerate(tables):
        table = _entered(table, step, [*tables, last][k:], shown)
    name, number = last
    if number is not None:
        _set_one(table, last, value, shown)
    elif value is None:
        table.pop(name, None)
    else:
        alternatives = ONE_OF.get(".".join(name for name, _ in tables), ())
        for other in alternatives if name in alternatives else ():
            table.pop(other, None)
        table[name] = copy.deepcopy(value)  # a later key may go into it


def tables_at(node: Any, place: str, shown: str = "") -> Iterator[tuple[str, Any]]:
    """(key, value) of a dotted key, of each table of a list by its number; none where it is not there."""
    name, _, rest = place.partition(".")
    if isinstance(node, list):
        for k, part in enumerate(node):
            yield from tables_at(part, place, f"{shown}[{k}]")
    elif not place:
        yield shown, node
    elif isinstance(node, dict) and name in node:
        yield from tables_at(node[name], rest, f"{shown}.{name}".lstrip("."))


def _entered(table: dict[str, Any], step: Step, way: Sequence[Step], shown: str) -> dict[str, Any]:
    """The table that a step leads to; way: the step and those behind it, for a sentence."""
    name, number = step
    inner = table.setdefault(name, {})
    listed = isinstance(inner, list) and all(isinstance(part, dict) for part in inner)
    if number is not None:
        inner = _tables(inner, step, shown)
        _must_be_there(inner, step, shown, len(inner))
        inner = inner[number]
    elif listed and len(inner) > 1:
        such = ".".join([f"{name}[0]", *(_written(other) for other in way[1:])])
        raise SceneError(f"{shown}: there are {len(inner)} [[{name}]] tables; say which, such as {such}")
    elif listed and inner:
        inner = inner[0]
    if not isinstance(inner, dict):
        raise SceneError(f"{shown}: {name} is not a table; set it whole instead")
    return inner


def _set_one(table: dict[str, Any], step: Step, value: Any, shown: str) -> None:
    """Replace one table of a list, put one behind the last, or take one out (None)."""
    name, number = step
    inner = [*_tables(table.get(name, []), step, shown)]
    _must_be_there(inner, step, shown, len(inner) + (value is not None))
    inner[number : number + 1] = [] if value is None else [copy.deepcopy(value)]
    table[name] = inner


def _tables(found: Any, step: Step, shown: str) -> list[Any]:
    """What stands at a key as a list of tables."""
    if not isinstance(found, dict | list):
        raise SceneError(f"{shown}: {step[0]} is not a table; set it whole instead")
    return [found] if isinstance(found, dict) else found


def _must_be_there(tables: list[Any], step: Step, shown: str, room: int) -> None:
    """SceneError for a number of a table that is not there; room: how many may be."""
    name, number = step
    if number >= room:
        last = f"the last of them is {name}[{len(tables) - 1}]" if tables else "there is none of them"
        raise SceneError(f"{shown}: there is no {name}[{number}], {last}; count from 0")


def _written(step: Step) -> str:
    """A step as it stands in a key."""
    name, number = step
    return name if number is None else f"{name}[{number}]"
