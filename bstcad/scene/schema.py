"""The JSON schema of a scene, for editors, error sentences and `bstcad keys`.

The models are the engine's own records and load torch, which takes seconds; so the schema made of them
(json_schema.py) is kept in schema.json.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
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
        row = Row(
            key if inner else key.removesuffix("[]"), node["unit"], span(node), _default(record, name),
            meaning=node["description"],
        )  # fmt: skip
        found += [row, *(_union(inner, key) if inner else ())]
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
        found[Row(f"{table}.{name}", "none", " | ".join(kinds), "required", meaning=" ".join(meanings))] = kinds
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
