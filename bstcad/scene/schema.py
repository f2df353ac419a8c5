"""The JSON schema of a scene, for editors, error sentences and `bstcad keys`.

The models are the engine's own records and load torch, which takes seconds; so the schema made of them is kept in
schema.json, and a test holds that the two agree.  `python -m bstcad.scene.schema` writes the file anew.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_name("schema.json")
TAGS = ("kind", "shape")  # keys whose value tells which record of a union a table is

Node = Mapping[str, Any]


@functools.cache
def schema() -> Node:
    """The JSON schema as it is kept."""
    return json.loads(FILE.read_text(encoding="utf-8"))


def records(node: Node) -> list[Node]:
    """The tables that may stand at a node, by themselves or in a list."""
    if "$ref" in node:
        return records(schema()["$defs"][node["$ref"].rpartition("/")[2]])
    if "properties" in node:
        return [node]
    return [record for part in _parts(node) for record in records(part)]


def tags(record: Node) -> dict[str, Any]:
    """The key and the value that tell this table from others of a union: {"kind": "plane"}."""
    keys = record["properties"]
    return {name: keys[name]["const"] for name in TAGS if "const" in keys.get(name, ())}


def _parts(node: Node) -> list[Node]:
    items = node.get("items")
    return [*node.get("anyOf", ()), *node.get("oneOf", ()), *([items] if isinstance(items, dict) else [])]


@dataclass(frozen=True)
class Row:
    """A key as `bstcad keys` prints it."""

    key: str  # dotted; of a list of tables with [] behind
    unit: str
    range: str
    default: str
    meaning: str
    kinds: tuple[str, ...] = ()  # of the table that has the key; (): of every kind


def rows(record: Node | None = None, table: str = "") -> list[Row]:
    """The keys of a table and of the tables in it, in the models' order."""
    record = schema() if record is None else record
    found: list[Row] = []
    for name, node in record["properties"].items():
        inner, key = records(node), f"{table}.{name}".lstrip(".") + ("[]" if node.get("type") == "array" else "")
        row = Row(key if inner else key.removesuffix("[]"), node["unit"], span(node), _default(record, name), "")
        found += [replace(row, meaning=node["description"]), *(_union(inner, key) if inner else ())]
    return found


def _union(union: list[Node], table: str) -> list[Row]:
    """The keys of the tables that may stand at a key, each once, and the kinds of table that have it."""
    kinds = ["".join(tags(record).values()) for record in union]
    found: dict[Row, list[str]] = {}
    if len(union) > 1:
        [name] = tags(union[0])
        meanings = (
            f"{kind}: {record['properties'][name]['description']}" for kind, record in zip(kinds, union, strict=True)
        )
        found[Row(f"{table}.{name}", "none", " | ".join(kinds), "required", " ".join(meanings))] = kinds
    for kind, record in zip(kinds, union, strict=True):
        for row in rows(record, table):
            if len(union) == 1 or row.key != f"{table}.{name}":
                found.setdefault(row, []).append(kind)
    return [row if of == kinds or row.kinds else replace(row, kinds=tuple(of)) for row, of in found.items()]


def span(node: Node) -> str:
    """The values that a key may have, in words."""
    if "const" in node or "enum" in node:
        return " | ".join(json.dumps(value).strip('"') for value in node.get("enum", [node.get("const")]))
    if records(node):
        return "table" if node.get("type") != "array" else "tables"
    if parts := [*_parts(node), *node.get("prefixItems", ())[:1]]:
        return " or ".join(dict.fromkeys(map(span, parts)))
    if "minimum" in node:
        return f"{_number(node['minimum'])} to {_number(node['maximum'])}"
    return {"boolean": "true | false", "string": "text"}.get(node.get("type", ""), "any number")


def _default(record: Node, name: str) -> str:
    if name in record.get("required", ()):
        return "required"
    default = record["properties"][name].get("default")
    return default if isinstance(default, str) else "" if default is None else toml(default)


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


def toml(value: Any) -> str:
    """A value as a scene file has it, in one line."""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {toml(part)}' for key, part in value.items())} }}"
    return f"[{', '.join(map(toml, value))}]" if isinstance(value, list) else json.dumps(value)


def of_models() -> dict[str, Any]:
    """The JSON schema that the models make."""
    from bstcad.scene.scene import Scene

    found = Scene.model_json_schema()
    _required_tags(found)
    circle = found["$defs"]["Circle"]  # of which a file may give the diameter (scene.py)
    circle["properties"]["diameter"] = circle["properties"]["radius"] | {"description": "Diameter, in place of radius."}
    circle["required"].remove("radius")
    circle["oneOf"] = [{"required": ["radius"]}, {"required": ["diameter"]}]
    for record in found["$defs"].values():
        record.pop("description", None)
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Scene of bstcad"}
    return head | _without_null({key: value for key, value in found.items() if key not in ("title", "description")})


def _required_tags(found: dict[str, Any]) -> None:
    """In a union the key that tells the record has no default."""
    for union in _nodes(found):
        if "discriminator" in union:
            name = union.pop("discriminator")["propertyName"]
            for part in union["oneOf"]:
                record = found["$defs"][part["$ref"].rpartition("/")[2]]
                record["properties"][name].pop("default", None)
                record["required"] = sorted({*record.get("required", ()), name})


def _nodes(node: Any) -> Iterator[dict[str, Any]]:
    if isinstance(node, dict):
        yield node
    for part in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        yield from _nodes(part)


def _without_null(node: Any) -> Any:
    """The same without null, which TOML does not have, without defaults of tables and without the keys' titles."""
    if isinstance(node, list):
        return [_without_null(part) for part in node]
    if not isinstance(node, dict):
        return node
    parts = [part for part in node.get("anyOf", ()) if part != {"type": "null"}]
    if len(parts) == 1:
        node = {**parts[0], **{key: value for key, value in node.items() if key != "anyOf"}}
    elif parts:
        node = node | {"anyOf": parts}
    dropped = {"title"} if "properties" not in node and isinstance(node.get("title"), str) else set()
    if isinstance(node.get("default"), dict) or ("default" in node and node["default"] in (None, [])):
        dropped.add("default")
    return {key: _without_null(value) for key, value in node.items() if key not in dropped}


if __name__ == "__main__":
    FILE.write_text(json.dumps(of_models(), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
