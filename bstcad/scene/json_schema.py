"""The JSON schema that the models of a scene make; `python -m bstcad.scene.json_schema` keeps it in schema.json.

A test holds that the two agree.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from bstcad.scene.scene import Scene
from bstcad.scene.schema import FILE


def of_models() -> dict[str, Any]:
    """The JSON schema that the models make."""
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
