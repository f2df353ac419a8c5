"""Where a dotted key stands in the schema, and the tables of each kind: another kind of one, and one where none was."""

from __future__ import annotations

import contextlib
import copy
import re
from collections.abc import Callable, Mapping
from typing import Any

from bstcad.scene.schema import Node, records, schema, tags

STEP = re.compile(r"([^.\[\]]+)(?:\[(\d+)\])?")  # of a dotted key: a name, and the number of a table in its list
NUMBER = re.compile(r"\[\d*\]")
FAR = 100.0  # mm from the lens to a source
FURTHER = 1.5  # times as far from the back: a second target behind the last
LIKE = {  # outlines, and the tables whose size they take by so many times
    "source.aperture": ("lens.outline", 1.0), "mount.rim": ("lens.outline", 1.0), "wavefront": ("lens.outline", 1.0),
    "mount.flange.outline": ("lens.outline", 2.0), "lens.front.outline": ("lens.outline", 0.5),
    "target.outline": ("target", 1.0), "target.profile": ("target", 1.0),
}  # fmt: skip
BESIDES = {  # where one of several keys is needed, by the table and its kind: the one to begin with
    ("target", ""): {"uniform": True},
    ("tolerance", ""): {"grade": "precise"},
    ("lens.front", "bspline"): {"optimise": True},
}

TYPES = {"number": (int, float), "integer": (int,), "boolean": (bool,), "string": (str,), "array": ()}

Table = Mapping[str, Any]


# ---- places ----------------------------------------------------------------------------------------------------------


def plain(key: str) -> str:
    """A dotted key without the numbers of tables."""
    return NUMBER.sub("", key)


def table_at(place: str, data: Any) -> dict[str, Any]:
    """The table at a dotted key of a scene's tables, itself and not a copy; an empty one if none is there."""
    for name, number in STEP.findall(place):
        data = data.get(name) if isinstance(data, dict) else None
        if isinstance(data, list):
            data = data[int(number or 0)] if int(number or 0) < len(data) else None
    return data if isinstance(data, dict) else {}


def value_at(key: str, data: Any) -> Any:
    """The value of a dotted key of a scene's tables; None if it is not there."""
    place, _, name = key.rpartition(".")
    return (table_at(place, data) if place else data).get(name)


def records_at(place: str, data: Table) -> list[Node]:
    """The records that the table at a dotted key may be; the kinds of the tables that hold it are as in `data`."""
    union, outer = [schema()], ""
    for name, number in STEP.findall(place):
        known = of_kinds(union, table_at(outer, data))
        union = [inner for record in known for inner in records(record["properties"].get(name, {}))]
        outer = f"{outer}.{name}".lstrip(".") + (f"[{number}]" if number else "")
    return union


def node_at(key: str, data: Table) -> Node | None:
    """The schema's node of a dotted key; None: the tables that hold it have no such key."""
    place, _, last = key.rpartition(".")
    union = of_kinds(records_at(place, data), table_at(place, data))
    name = plain(last)
    return next((record["properties"][name] for record in union if name in record["properties"]), None)


def kinds_at(key: str, data: Table) -> list[Any]:
    """Return all kinds that the table of a key such as source.kind may be; [] for a key that tells no kind."""
    place, _, name = key.rpartition(".")
    return [tags(record)[name] for record in records_at(place, data) if name in tags(record)]


def of_kinds(union: list[Node], table: Table) -> list[Node]:
    """The record of a union that a table is by its tag; all of them if it is none."""
    chosen = [record for record in union if tags(record) and tags(record).items() <= _hashable(table).items()]
    return chosen or union


def alternatives(node: Node) -> list[Node]:
    """The forms that a value of a node may have."""
    return [*node.get("anyOf", ()), *node.get("oneOf", ())] or [node]


def choices(node: Node) -> list[Any]:
    """The values that a node names, by itself or in its lists."""
    found = [*node.get("enum", ()), *([node["const"]] if "const" in node else ())]
    inner = [*alternatives(node), node.get("items", {})]
    return found or [value for part in inner if part and part is not node for value in choices(part)]


def cast(node: Node, value: Any) -> Any:
    """A value as a node takes it, in tables too: a whole number is a decimal one where the node has these.

    Ranges are not asked.  ValueError: the node takes nothing like it.
    """
    if union := records(node):
        return [_cast_table(union, part) for part in value] if isinstance(value, list) else _cast_table(union, value)
    if len(forms := alternatives(node)) > 1:
        for form in forms:
            with contextlib.suppress(ValueError):
                return cast(form, value)
        raise ValueError
    if "const" in node or "enum" in node:
        taken = any(value == choice and type(value) is type(choice) for choice in choices(node))
    elif node["type"] == "array" and isinstance(value, list):
        fixed = node.get("prefixItems")
        if fixed is not None and len(fixed) != len(value):
            raise ValueError
        return [cast(part, each) for part, each in zip(fixed or [node["items"]] * len(value), value, strict=True)]
    else:
        taken = type(value) in TYPES[node["type"]]
    if not taken:
        raise ValueError
    is_number = node.get("type") == "number" and abs(value) < 10**300
    return float(value) if is_number else value


def _cast_table(union: list[Node], table: Any) -> dict[str, Any]:
    """The same for a table: what its record does not take stays as it is, for the sentence that says so."""
    if not isinstance(table, dict):
        raise ValueError
    nodes, taken = of_kinds(union, table)[0]["properties"], dict(table)
    for name in nodes.keys() & table.keys():
        with contextlib.suppress(ValueError):
            taken[name] = cast(nodes[name], table[name])
    return taken


def _hashable(table: Table) -> dict[str, str]:
    return {name: value for name, value in table.items() if isinstance(value, str)}


# ---- tables ----------------------------------------------------------------------------------------------------------


def of_kind(place: str, tag: Mapping[str, str], data: Table) -> dict[str, Any]:
    """The table at a place as one of another kind: what both kinds have stays, what the new one needs is made."""
    union, old = records_at(place, data), table_at(place, data)
    chosen = next((record for record in union if tag.items() <= tags(record).items()), None)
    if chosen is None:  # no such kind
        return {**old, **tag}
    before = of_kinds(union, old)
    had = before[0]["properties"] if len(before) == 1 else chosen["properties"]
    kept = {name: value for name, value in old.items() if _stays(had.get(name), chosen["properties"].get(name), value)}
    scene = copy.deepcopy(dict(data))
    table_at(place, scene).update(tag)
    return _completed(place, chosen, kept, scene)


def _stays(before: Node | None, after: Node | None, value: Any) -> bool:
    """Does a key mean the same in two kinds of table, so that its value stays?"""
    if before is None or after is None or before["description"] != after["description"] or "const" in after:
        return False
    try:
        cast(after, value)
    except ValueError:
        return False
    return True


def new_table(key: str, data: Table) -> dict[str, Any]:
    """The table that is put where there is none: required keys, made of what the scene has, or the schema's examples.

    Of a list it is one behind the last, target[1]: a second target is the first, further away.
    """
    name, others = plain(key), data.get(plain(key))
    others = [part for part in (others if isinstance(others, list) else [others]) if isinstance(part, dict)]
    if name == "target" and others:
        z, start = others[-1].get("z"), _z(data, "lens.back")
        further = {"z": start + FURTHER * (z - start)} if are_numbers(z, start) else {}
        return {**others[-1], **further}
    union = records_at(key, data)
    node: Node = node_at(key, data) or {}
    like = table_at(LIKE.get(name, ("", 0.0))[0], data)
    shapes = [tags(record) for record in union]
    wanted = [{n: v for n, v in each.items() if n in shapes[0]} for each in (like, *node.get("examples", ()))]
    free = [kind for kind in shapes if not any(kind.items() <= _hashable(part).items() for part in others)]
    kind = next((each for each in (*wanted, *free) if each in shapes), shapes[0])
    return _completed(key, union[shapes.index(kind)], {}, data)


def _completed(place: str, record: Node, kept: Table, data: Table) -> dict[str, Any]:
    """A table of a record: its tag, then the keys that are kept and those that it needs, in the schema's order."""
    needed = {*record.get("required", ())}
    ways = [way["required"] for way in record.get("oneOf", ())]  # of a circle: radius, or diameter
    if ways and not any(name in kept for way in ways for name in way):
        needed.update(ways[-1])
    table: dict[str, Any] = dict(tags(record))
    for name, node in record["properties"].items():
        if name in kept:
            table[name] = kept[name]
        elif name in needed and name not in table:
            table[name] = _made(f"{place}.{name}", node, data)
        elif (start := STARTS.get(f"{place}.{name}")) and (made := start(data)) is not None:
            table[name] = made
    kind = "".join(tags(record).values())
    return BESIDES.get((plain(place), kind), {}) | table


def _made(key: str, node: Node, data: Table) -> Any:
    """A value for a key that a table needs: by the size or the place of what is there, else the schema's example."""
    place, _, name = key.rpartition(".")
    sizes, like = extent(table_at(place, data)), LIKE.get(plain(place))
    if sizes is None and like is not None and (found := extent(table_at(like[0], data))):
        sizes = (like[1] * found[0], like[1] * found[1])
    if name in MEASURES and sizes is not None:
        return MEASURES[name](sizes)
    if records(node):
        return new_table(key, data)
    made = PLACES[plain(key)](data) if plain(key) in PLACES else None
    return node["examples"][0] if made is None else made


MEASURES: Mapping[str, Callable[[tuple[float, float]], float]] = {  # of an outline, by its extent along x and y
    "width": lambda sizes: sizes[0],
    "height": lambda sizes: sizes[1],
    "diameter": min,
    "radius": lambda sizes: min(sizes) / 2,
    "radius_1e2": lambda sizes: min(sizes) / 2,
}


def extent(table: Table) -> tuple[float, float] | None:
    """The extent of an outline, or of a target, along x and y."""
    ends = [table.get(axis) for axis in "xy"]
    if all(isinstance(pair, list) and len(pair) == 2 and are_numbers(*pair) for pair in ends):
        return ends[0][1] - ends[0][0], ends[1][1] - ends[1][0]
    if are_numbers(table.get("width"), table.get("height")):
        return table["width"], table["height"]
    for name, times in (("diameter", 1.0), ("radius", 2.0), ("radius_1e2", 2.0)):
        if are_numbers(table.get(name)):
            return times * table[name], times * table[name]
    return None


def are_numbers(*values: Any) -> bool:
    """Are they all numbers that a lens can have?"""
    return all(type(value) in (int, float) and abs(value) < 1e300 for value in values)


def _z(data: Table, place: str, times: float = 1.0, more: float = 0.0) -> float | None:
    """z of a table, so many times and so much further; None where it has none."""
    z = table_at(place, data).get("z")
    return times * z + more if are_numbers(z) else None


def _on_axis(z: float | None) -> list[float] | None:
    return None if z is None else [0.0, 0.0, z]


def _circle(data: Table) -> float | None:
    """Diameter of the circle of a flange's holes, half way between lens and rim."""
    sizes = extent(table_at("lens.outline", data)), extent(table_at("mount.flange.outline", data))
    return None if None in sizes else (min(sizes[0]) + min(sizes[1])) / 2


def _start(data: Table) -> float | None:
    """z where light has to start that does not come from z = 0, before the lens: to a mirror it comes from above."""
    source, front, back = table_at("source", data), _z(data, "lens.front"), _z(data, "lens.back")
    if front is None or back is None:
        return None
    if not is_mirror(data):
        return None if front > 0 else front - FAR
    before = source.get("z", source.get("position", [None])[-1:])
    before = before[0] if isinstance(before, list) and before else before
    return before if are_numbers(before) else back + FAR


def is_mirror(data: Table) -> bool:
    """Does a face of the lens reflect the light?"""
    return any(table_at(f"lens.{face}", data).get("reflect") is True for face in ("front", "back"))


STARTS: Mapping[str, Callable[[Table], Any]] = {  # where light starts, of sources that need it stated
    "source.position": lambda data: _on_axis(_start(data)),
    "source.z": lambda data: _start(data) if is_mirror(data) else None,
}
PLACES: Mapping[str, Callable[[Table], Any]] = {
    "wavefront.z": lambda data: _z(data, "target"),
    "wavefront.focus": lambda data: _on_axis(_z(data, "target", times=2.0)),
    "mount.flange.z": lambda data: _z(data, "lens.front", more=0.5),
    "mount.flange.screws.circle": _circle,
}
