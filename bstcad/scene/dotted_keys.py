"""Dotted keys of a scene file, such as lens.back.z or target[1].text, and how to set and find their values.

A number in brackets is the index of a table in a list, from 0.  A single table counts as a list of one table.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator, Sequence
from typing import Any

from bstcad.scene.errors import SceneError

PICTURE_KEYS = ("text", "image", "sample", "uniform", "profile", "intensity")  # keys of which a target has exactly one
OUTLINES = ("source.aperture", *(f"{table}.outline" for table in ("lens", "target", "lens.front", "before", "behind")))
ONE_OF: dict[str, tuple[str, ...]] = {  # alternative keys of a table; setting one removes the others
    "target": PICTURE_KEYS,
    **dict.fromkeys(("lens", "before", "behind"), ("material", "index")),
    **dict.fromkeys(OUTLINES, ("radius", "diameter")),
}
STEP = re.compile(r"([^\[\]]+)(?:\[(\d{1,6})\])?")  # part of a key: name, and number of a table in a list

Step = tuple[str, int | None]


def override(data: dict[str, Any], key: str, value: Any, shown: str) -> None:
    """Set a dotted key of `data` (None removes it) and remove its alternatives (ONE_OF); shown: key in messages."""
    steps = []
    for part in key.split("."):
        if (match := STEP.fullmatch(part)) is None:
            raise SceneError(f"{shown}: is not a dotted key; write for example lens.back.control_points")
        steps.append((match[1], None if match[2] is None else int(match[2])))
    *tables, (name, number) = steps
    table = data
    for k in range(len(tables)):
        table = _inner(table, steps[k:], shown)
    if number is not None:
        _set_table(table, name, number, value, shown=shown)
        if tables and not table[name]:  # the last table of a list within a table
            del table[name]
    elif value is None:
        table.pop(name, None)
    else:
        alternatives = ONE_OF.get(".".join(table for table, _ in tables), ())
        for other in alternatives if name in alternatives else ():
            table.pop(other, None)
        table[name] = copy.deepcopy(value)  # a later key may change parts of the value


def tables_at(node: Any, key: str, shown: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (full key, value) of `key` in `node`, once for each table of a list; shown: full key of `node` itself."""
    name, _, rest = key.partition(".")
    if isinstance(node, list):
        for k, part in enumerate(node):
            yield from tables_at(part, key, f"{shown}[{k}]")
    elif not key:
        yield shown, node
    elif isinstance(node, dict) and name in node:
        yield from tables_at(node[name], rest, f"{shown}.{name}".lstrip("."))


def _inner(table: dict[str, Any], steps: Sequence[Step], shown: str) -> dict[str, Any]:
    """Return the table in `table` at the first of `steps`, the remaining parts of a key; an absent table is created."""
    name, number = steps[0]
    inner = table.setdefault(name, {})
    listed = isinstance(inner, list) and all(isinstance(part, dict) for part in inner)
    if number is not None:
        inner = _tables(inner, name, shown)
        if number >= len(inner):
            raise _no_such_table(inner, name, number, shown)
        inner = inner[number]
    elif listed and len(inner) > 1:
        example = ".".join([f"{name}[0]", *(_step_text(other) for other in steps[1:])])
        raise SceneError(f"{shown}: there are {len(inner)} [[{name}]] tables; write the number of one, as in {example}")
    elif listed and inner:
        inner = inner[0]
    if not isinstance(inner, dict):
        raise SceneError(f"{shown}: {name} is not a table; set the key {name} itself")
    return inner


def _set_table(table: dict[str, Any], name: str, number: int, value: Any, shown: str) -> None:
    """Replace or append the table of this number in the list `name`; value None removes the table."""
    inner = [*_tables(table.get(name, []), name, shown)]
    if number >= len(inner) + (value is not None):
        raise _no_such_table(inner, name, number, shown)
    inner[number : number + 1] = [] if value is None else [copy.deepcopy(value)]
    table[name] = inner


def _tables(found: Any, name: str, shown: str) -> list[Any]:
    """Return the value `found` of a key as a list of tables; SceneError if it is neither a table nor a list."""
    if not isinstance(found, dict | list):
        raise SceneError(f"{shown}: {name} is not a table; set the key {name} itself")
    return [found] if isinstance(found, dict) else found


def _no_such_table(tables: list[Any], name: str, number: int, shown: str) -> SceneError:
    """Return the error for a list of tables without the table of this number."""
    last = f"the last one is {name}[{len(tables) - 1}]" if tables else "the list is empty"
    return SceneError(f"{shown}: there is no {name}[{number}], as {last}; count from 0")


def _step_text(step: Step) -> str:
    name, number = step
    return name if number is None else f"{name}[{number}]"
