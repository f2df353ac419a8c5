"""Dotted keys in the schema and in a scene's tables; conversion of a table to another kind, and new tables."""

from __future__ import annotations

import contextlib
import copy
import re
from collections.abc import Callable, Mapping
from typing import Any

from bstcad.scene.dotted_keys import ONE_OF
from bstcad.scene.schema import Node, records, schema, tags

KEY_PART = re.compile(r"([^.\[\]]+)(?:\[(\d+)\])?")  # part of a dotted key: name, number of a table in its list
TABLE_NUMBER = re.compile(r"\[\d*\]")  # number of a table in its list, as in target[1]
SOURCE_DISTANCE = 100.0  # distance of a new source from the lens (mm)
DISTANCE_RATIO = 1.5  # distance of an added target from the back / distance of the last target from the back
SIZE_MODELS = {  # new outline: (table whose size it gets, factor on this size)
    "source.aperture": ("lens.outline", 1.0), "mount.rim": ("lens.outline", 1.0), "wavefront": ("lens.outline", 1.0),
    "mount.flange.outline": ("lens.outline", 2.0), "lens.front.outline": ("lens.outline", 0.5),
    "target.outline": ("target", 1.0), "target.profile": ("target", 1.0),
}  # fmt: skip
FIRST_OPTIONS = {  # first key, by (table, kind), of a new table that needs one of several keys
    ("target", "plane"): {"uniform": True},
    ("target", "intensity"): {"uniform": True},
    ("tolerance", ""): {"grade": "precise"},
    ("lens.front", "bspline"): {"optimise": True},
    ("accept.point", ""): {"least": 0.5},
    ("accept.cut_off", ""): {"least": 0.13},
}

# Python types of a value, by its type in the schema.
TYPES = {"number": (int, float), "integer": (int,), "boolean": (bool,), "string": (str,), "array": ()}

Table = Mapping[str, Any]


# ---- dotted keys -----------------------------------------------------------------------------------------------------


def without_numbers(key: str) -> str:
    """Return a dotted key without the numbers of tables: target[1].z becomes target.z."""
    return TABLE_NUMBER.sub("", key)


def table_at(key: str, data: Any) -> dict[str, Any]:
    """Return the table at a dotted key of a scene's tables, not a copy; an empty dict if there is none."""
    for name, number in KEY_PART.findall(key):
        data = data.get(name) if isinstance(data, dict) else None
        if isinstance(data, list):
            data = data[int(number or 0)] if int(number or 0) < len(data) else None
    return data if isinstance(data, dict) else {}


def value_at(key: str, data: Any) -> Any:
    """Return the value of a dotted key in a scene's tables; None if the key is not set."""
    parent, _, name = key.rpartition(".")
    return (table_at(parent, data) if parent else data).get(name)


def records_at(key: str, data: Table) -> list[Node]:
    """Return the schema's records (possible tables) at a dotted key; outer tables have the kinds that `data` states."""
    union, outer = [schema()], ""
    for name, number in KEY_PART.findall(key):
        known = matching_records(union, table_at(outer, data))
        union = [inner for record in known for inner in records(record["properties"].get(name, {}))]
        outer = f"{outer}.{name}".lstrip(".") + (f"[{number}]" if number else "")
    return union


def node_at(key: str, data: Table) -> Node | None:
    """Return the schema's node of a dotted key; None if the key's table does not allow the key."""
    parent, _, last = key.rpartition(".")
    union = matching_records(records_at(parent, data), table_at(parent, data))
    name = without_numbers(last)
    return next((record["properties"][name] for record in union if name in record["properties"]), None)


def kinds_at(key: str, data: Table) -> list[Any]:
    """Return all values of a key that states a kind, such as source.kind; [] for other keys."""
    parent, _, name = key.rpartition(".")
    return [tags(record)[name] for record in records_at(parent, data) if name in tags(record)]


def matching_records(union: list[Node], table: Table) -> list[Node]:
    """Return those records (possible tables) of a union that have the kind stated in `table`; all if none has it.

    A table without a kind has the kind that is the default, if one is.
    """

    def has(record: Node) -> bool:
        default = {name: record["properties"][name].get("default") for name in tags(record)}
        return bool(tags(record)) and tags(record).items() <= {**default, **_hashable(table)}.items()

    return [record for record in union if has(record)] or union


def alternatives(node: Node) -> list[Node]:
    """Return the alternative nodes of a node, or the node itself."""
    return [*node.get("anyOf", ()), *node.get("oneOf", ())] or [node]


def choices(node: Node) -> list[Any]:
    """Return the choices (enumerated values) of a node, or of its alternatives and list items."""
    found = [*node.get("enum", ()), *([node["const"]] if "const" in node else ())]
    inner = [*alternatives(node), node.get("items", {})]
    return found or [value for part in inner if part and part is not node for value in choices(part)]


def cast(node: Node, value: Any) -> Any:
    """Return a value, or a table of values, with the types of a node: integers become floats where the node has floats.

    Ranges are not checked.  ValueError if the node does not allow the value.
    """
    if union := records(node):
        if isinstance(value, str) and value in choices(node):  # a name in place of a table
            return value
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
    """Cast the values of a table as its record in `union` requires; invalid values stay, for the check of the scene."""
    if not isinstance(table, dict):
        raise ValueError
    nodes, taken = matching_records(union, table)[0]["properties"], dict(table)
    for name in nodes.keys() & table.keys():
        with contextlib.suppress(ValueError):
            taken[name] = cast(nodes[name], table[name])
    return taken


def _hashable(table: Table) -> dict[str, str]:
    return {name: value for name, value in table.items() if isinstance(value, str)}


# ---- tables ----------------------------------------------------------------------------------------------------------


def convert_table(key: str, tag: Mapping[str, str], data: Table) -> dict[str, Any]:
    """Return the table at a key with another kind, which `tag` states, such as {"kind": "point"}.

    Keys with the same meaning in both kinds stay, others are removed, and required keys are added.
    """
    union, old = records_at(key, data), table_at(key, data)
    chosen = next((record for record in union if tag.items() <= tags(record).items()), None)
    if chosen is None:  # no such kind
        return {**old, **tag}
    before = matching_records(union, old)
    had = before[0]["properties"] if len(before) == 1 else chosen["properties"]
    nodes = chosen["properties"]
    common = {name: value for name, value in old.items() if _is_common(had.get(name), nodes.get(name), value)}
    scene = copy.deepcopy(dict(data))
    table_at(key, scene).update(tag)
    return _completed(key, chosen, common, scene)


def _is_common(before: Node | None, after: Node | None, value: Any) -> bool:
    """Return True if a key means the same before and after a change of its table's kind and may keep its value."""
    if before is None or after is None or before["description"] != after["description"] or "const" in after:
        return False
    try:
        cast(after, value)
    except ValueError:
        return False
    return True


def new_table(key: str, data: Table) -> dict[str, Any]:
    """Return a new table for a key: its required keys, with values that fit the scene, or the schema's examples.

    In a list, the key names the table after the last one, such as target[1].  A further target is a copy of the last
    at DISTANCE_RATIO times its distance from the back.
    """
    name, others = without_numbers(key), data.get(without_numbers(key))
    others = [part for part in (others if isinstance(others, list) else [others]) if isinstance(part, dict)]
    if name == "target" and others:
        z, start = others[-1].get("z"), _scaled_z(data, "lens.back")
        further = {"z": start + DISTANCE_RATIO * (z - start)} if are_numbers(z, start) else {}
        return {**others[-1], **further}
    union = records_at(key, data)
    node: Node = node_at(key, data) or {}
    like = table_at(SIZE_MODELS.get(name, ("", 0.0))[0], data)
    shapes = [tags(record) for record in union]
    wanted = [{n: v for n, v in each.items() if n in shapes[0]} for each in (like, *node.get("examples", ()))]
    free = [kind for kind in shapes if not any(kind.items() <= _hashable(part).items() for part in others)]
    kind = next((each for each in (*wanted, *free) if each in shapes), shapes[0])
    return _completed(key, union[shapes.index(kind)], {}, data)


def required_keys(record: Node, table: Table) -> set[str]:
    """Return the keys that a table of a record needs; those of "else" only without the kinds that "if" states."""
    condition = record.get("if", {}).get("properties", {})
    kinds = {f"{name}.kind": node["properties"]["kind"] for name, node in condition.items()}
    is_met = all(value_at(key, table) == kind["const"] for key, kind in kinds.items())
    return {*record.get("required", ()), *(() if is_met else record["else"]["required"])}


def _completed(key: str, record: Node, common: Table, data: Table) -> dict[str, Any]:
    """Return a table of a record, in the schema's order: keys of its kind, keys in `common`, and required keys."""
    needed = required_keys(record, common)
    options = [option["required"] for option in record.get("oneOf", ())]  # for a circle: radius, or diameter
    if options and not any(name in common for option in options for name in option):
        needed.update(options[-1])
    table = {name: tag for name, tag in tags(record).items() if record["properties"][name].get("default") != tag}
    for name, node in record["properties"].items():
        if name in common:
            table[name] = common[name]
        elif name in needed and name not in table:
            table[name] = _needed_value(f"{key}.{name}", node, data)
        elif (start := SOURCE_ORIGINS.get(f"{key}.{name}")) and (made := start(data)) is not None:
            table[name] = made
    kind = "".join(tags(record).values())
    has_one = any(name in table for name in ONE_OF.get(without_numbers(key), ()))
    return table if has_one else FIRST_OPTIONS.get((without_numbers(key), kind), {}) | table


def _needed_value(key: str, node: Node, data: Table) -> Any:
    """Return a value for a required key, from the sizes and positions in the scene, or else the schema's example."""
    parent, _, name = key.rpartition(".")
    sizes, like = extent(table_at(parent, data)), SIZE_MODELS.get(without_numbers(parent))
    if sizes is None and like is not None and (found := extent(table_at(like[0], data))):
        sizes = (like[1] * found[0], like[1] * found[1])
    if name in SIZES and sizes is not None:
        return SIZES[name](sizes)
    if records(node):
        return new_table(key, data)
    made = VALUES[without_numbers(key)](data) if without_numbers(key) in VALUES else None
    return node["examples"][0] if made is None else made


SIZES: Mapping[str, Callable[[tuple[float, float]], float]] = {  # sizes of an outline from its (x, y) extent, by key
    "width": lambda sizes: sizes[0],
    "height": lambda sizes: sizes[1],
    "diameter": min,
    "radius": lambda sizes: min(sizes) / 2,
    "radius_1e2": lambda sizes: min(sizes) / 2,
}


def extent(table: Table) -> tuple[float, float] | None:
    """Return the extent of an outline or a target along x and y (mm); None if it is not stated."""
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
    """Return True if all values are numbers (not bool) of a magnitude below 1e300."""
    return all(type(value) in (int, float) and abs(value) < 1e300 for value in values)


def _scaled_z(data: Table, key: str, times: float = 1.0, more: float = 0.0) -> float | None:
    """Return times * z + more (mm) for the key z of the table at `key`; None without z."""
    z = table_at(key, data).get("z")
    return times * z + more if are_numbers(z) else None


def _on_axis(z: float | None) -> list[float] | None:
    return None if z is None else [0.0, 0.0, z]


def _screw_circle(data: Table) -> float | None:
    """Return the diameter (mm) of a flange's circle of holes: the mean of the smaller sides of lens and flange."""
    sizes = extent(table_at("lens.outline", data)), extent(table_at("mount.flange.outline", data))
    return None if None in sizes else (min(sizes[0]) + min(sizes[1])) / 2


def _target_centre(data: Table) -> list[float] | None:
    """Return the centre [x, y] of the first target, in its unit; None if its ends are not stated."""
    ends = [table_at("target", data).get(axis) for axis in "xy"]
    if all(isinstance(pair, list) and len(pair) == 2 and are_numbers(*pair) for pair in ends):
        return [sum(pair) / 2 for pair in ends]
    return None


def _source_z(data: Table) -> float | None:
    """Return z (mm) of a new source before the lens, or on the light's side of a mirror; None: keep the default."""
    source, front, back = table_at("source", data), _scaled_z(data, "lens.front"), _scaled_z(data, "lens.back")
    if front is None or back is None:
        return None
    if not is_mirror(data):
        return None if front > 0 else front - SOURCE_DISTANCE
    before = source.get("z", source.get("position", [None])[-1:])
    before = before[0] if isinstance(before, list) and before else before
    return before if are_numbers(before) else back + SOURCE_DISTANCE


def is_mirror(data: Table) -> bool:
    """Return True if a face of the lens reflects the light."""
    return any(table_at(f"lens.{face}", data).get("reflect") is True for face in ("front", "back"))


def lamp_z(data: Table) -> float | None:
    """Return z (mm) of a lamp, a source of kind point; None for other sources, or if its position is invalid."""
    position = value_at("source.position", data)
    position = [0.0, 0.0, 0.0] if position is None else position
    is_lamp = value_at("source.kind", data) == "point" and isinstance(position, list) and len(position) == 3
    return position[2] if is_lamp and are_numbers(*position) else None


SOURCE_ORIGINS: Mapping[str, Callable[[Table], Any]] = {  # functions that return a new source's position, by key
    "source.position": lambda data: _on_axis(_source_z(data)),
    "source.z": lambda data: _source_z(data) if is_mirror(data) else None,
}
VALUES: Mapping[str, Callable[[Table], Any]] = {  # functions that return the value of a required key, by key
    "wavefront.z": lambda data: _scaled_z(data, "target"),
    "wavefront.focus": lambda data: _on_axis(_scaled_z(data, "target", times=2.0)),
    "mount.flange.z": lambda data: _scaled_z(data, "lens.front", more=0.5),
    "mount.flange.screws.circle": _screw_circle,
    "accept.point.at": _target_centre,
    "accept.cut_off.at": lambda data: (_target_centre(data) or [None])[0],
}
