"""The base of a scene's records, and their JSON schema for editors, messages and `bstcad keys`.

The records load torch, which takes seconds.  So their schema is made once, by `python -m bstcad.scene.scene`, and kept
in __pycache__ under the hash of the code that states it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any
from weakref import WeakValueDictionary

import pydantic
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Tag,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic.functional_serializers import PlainSerializer, model_serializer
from pydantic.json_schema import GenerateJsonSchema, WithJsonSchema

from bstcad.optics.surfaces.sides import MIN_SIDE
from bstcad.runs import files

FOLDER = Path(__file__).parent
STATED_IN = FOLDER, FOLDER.with_name("optics"), FOLDER.with_name("photometry")  # folders whose code states keys
TAGS = ("kind", "shape")  # keys whose value selects the record of a union
ESCAPES = "\0\a\b\f\n\r\t\v\x1b"  # characters that escapes in TOML or Python denote, such as \n in "C:\new.png"
LENGTHS, COORDINATES = (1e-3, 1e6), (-1e8, 1e8)  # ranges of lengths and of coordinates, mm
MAX_CONTROL_POINTS = 2049  # largest number of control points along a side of a net
NET_SIZES = (MIN_SIDE, MAX_CONTROL_POINTS)  # range of the control points per side of a net

Node = Mapping[str, Any]
# A number, or a pair of numbers along x and along y; the tags make messages refer to the form that was given.
OneOrTwo = Annotated[
    Annotated[int, Tag("number")] | Annotated[tuple[int, int], Tag("pair")],
    Discriminator(lambda given: "pair" if isinstance(given, list | tuple) else "number"),
]
OneOrTwoWidths = Annotated[
    Annotated[float, Tag("number")] | Annotated[tuple[float, float], Tag("pair")],
    Discriminator(lambda given: "pair" if isinstance(given, list | tuple) else "number"),
]
# A number, or three numbers along x, y and z.
OneOrThreeNumbers = Annotated[
    Annotated[float, Tag("number")] | Annotated[tuple[float, float, float], Tag("three")],
    Discriminator(lambda given: "three" if isinstance(given, list | tuple) else "number"),
]


class Record(BaseModel):
    """A table of a scene: frozen, without unknown keys, with finite numbers only.

    A field has a type and a `Key`, which states its range; a method `complaints` checks the rest.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class FileContent:
    """The content of a file that a scene names; the scene contains all of it, so that a design can be repeated."""

    name: str  # file name of the copy beside a design
    data: bytes  # content; a subclass that is a dataclass leaves it out of its repr

    @property
    def copy(self) -> bytes:
        """Content of the copy beside a design: `data`, unless a subclass writes another format."""
        return self.data

    @property
    def digest(self) -> str:
        """SHA-256 of `data` and the other fields, in hexadecimal digits."""
        found = hashlib.sha256(repr(self).encode())
        found.update(self.data)
        return found.hexdigest()


def contents(value: Any, key: str = "") -> Iterator[tuple[str, FileContent]]:
    """Yield (dotted key, content) of all files that the value of `key` in a scene (a record or a tuple) names."""
    if isinstance(value, FileContent):
        yield key, value
        return
    parts: dict[str, Any] = {}
    if isinstance(value, tuple):
        parts = {f"{key}[{number}]": part for number, part in enumerate(value)}
    elif isinstance(value, BaseModel):
        parts = {f"{key}.{each.alias or name}": getattr(value, name) for name, each in type(value).model_fields.items()}
    elif is_dataclass(value):
        parts = {f"{key}.{each.name}": getattr(value, each.name) for each in fields(value)}
    for name, part in parts.items():
        yield from contents(part, name.lstrip("."))


def from_file(kind: type[FileContent], read: Callable[[Path], FileContent], example: str) -> tuple[Any, ...]:
    """Return the annotations of a field of type `kind` that is written as a path and contains the content of the file.

    read: reads the file at a path.  example: the key with a path, for messages.  A path is relative to the scene file,
    or to the user's home with ~.  `bounds` in the context of a validation are folders: a path into one of them must not
    lead out of them by symbolic links.
    """

    def content(given: Any, checked: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
        found = found_in(given, info)
        return shared(found) if isinstance(found, kind) else checked(found)  # a copy would compute cached values again

    def found_in(given: Any, info: ValidationInfo) -> Any:
        if isinstance(given, kind):
            return given
        if not isinstance(given, str | Path):
            raise ValueError(f"{given!r} is not a file name; write for example {example}")
        context = info.context or {}
        if given in (known := context.get("contents", {})):
            return known[given]
        folder = Path(context.get("folder", "."))
        _check_links(folder / given, context.get("bounds", ()))
        if os.path.lexists(folder / given):
            return read(folder / given)
        if any(c in ESCAPES for c in str(given)):
            raise ValueError(f"{given!r} has an escape such as \\n; write paths with / or in single quotes")
        return read(folder / os.path.expanduser(given))

    written = PlainSerializer(lambda found: found.name, return_type=str)
    return WrapValidator(content), written, WithJsonSchema({"type": "string"})


_SHARED: WeakValueDictionary[int, FileContent] = WeakValueDictionary()  # contents in use, by their hash


def shared(content: FileContent) -> FileContent:
    """Return the equal content that is in use, else `content`, so that the caches of many scenes keep a file once."""
    known = _SHARED.setdefault(hash(content), content)
    return known if known == content else content


def _check_links(path: Path, bounds: Sequence[Path]) -> None:
    """Raise ValueError if symbolic links lead `path`, or design.npz in the folder `path`, out of `bounds` (folders)."""
    for each in (path, path / "design.npz") if bounds else ():
        plain = Path(os.path.abspath(each))
        if any(plain.is_relative_to(folder) for folder in bounds) or each.resolve() != plain.resolve():
            try:
                files.within(each, *bounds)
            except ValueError as error:
                raise ValueError(f"{str(path)!r} {error}; put a copy of the file there instead") from None


def leaving_out(**defaults: Any) -> Any:
    """Return a serializer that omits keys with the values `defaults`, so that older scenes are written unchanged."""

    def written(self: Any, handler: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        found = handler(self)
        return {name: value for name, value in found.items() if name not in defaults or value != defaults[name]}

    return model_serializer(mode="wrap")(written)


# ---- the schema of the records ---------------------------------------------------------------------------------------


class _Tables(GenerateJsonSchema):
    """Generator of the JSON schema of TOML tables: without null, and without defaults that are None or []."""

    def nullable_schema(self, schema: Any) -> dict[str, Any]:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: Any) -> dict[str, Any]:
        made = super().default_schema(schema)
        return {key: value for key, value in made.items() if key != "default" or value not in (None, [])}

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def of_model(model: type[BaseModel]) -> dict[str, Any]:
    """Return the JSON schema of the record of a scene, in which the tag of a table in a union is required."""
    made = model.model_json_schema(schema_generator=_Tables)
    tables = made["$defs"]
    for union in _nodes(made):
        if "discriminator" in union:
            name = union.pop("discriminator")["propertyName"]
            for part in union["oneOf"]:
                table = tables[part["$ref"].rpartition("/")[2]]
                table["properties"][name].pop("default", None)
                table["required"] = sorted({*table.get("required", ()), name})
        if isinstance(union.get("default"), dict):
            del union["default"]
    circle = tables["Circle"]  # a file may give its diameter, which scene.py converts
    keys = circle["properties"]
    keys["diameter"] = keys["radius"] | {"description": "Diameter, in place of radius.", "examples": [24.0]}
    circle["required"].remove("radius")
    circle["oneOf"] = [{"required": ["radius"]}, {"required": ["diameter"]}]
    for table in (made, *tables.values()):
        table.pop("description", None)
    return made | {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Scene of bstcad"}


def _nodes(node: Any) -> list[dict[str, Any]]:
    """Return all objects in a JSON value, the value itself included."""
    parts = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    return [node] * isinstance(node, dict) + [inner for part in parts for inner in _nodes(part)]


# ---- the stored schema -----------------------------------------------------------------------------------------------


@functools.cache
def schema() -> Node:
    """Return the JSON schema of a scene."""
    return json.loads(schema_text())


def schema_text() -> str:
    """Return the JSON schema of a scene as text, from its file or, once per version of the code, from the records."""
    code = b"".join(path.read_bytes() for folder in STATED_IN for path in sorted(folder.rglob("*.py")))
    digest = hashlib.sha256(pydantic.VERSION.encode() + code).hexdigest()
    path = FOLDER / "__pycache__" / f"schema-{digest[:16]}.json"
    with contextlib.suppress(OSError, ValueError):
        text = path.read_text(encoding="utf-8")
        json.loads(text)
        return text
    paths = os.pathsep.join(map(str, [FOLDER.parents[1], *sys.path]))
    command, known = [sys.executable, "-m", "bstcad.scene.scene"], {**os.environ, "PYTHONPATH": paths}
    text = subprocess.run(command, env=known, stdout=subprocess.PIPE, encoding="utf-8", check=True).stdout
    with contextlib.suppress(OSError):  # a folder that cannot be written: it is made again by the next process
        for old in path.parent.glob("schema-*.json"):
            old.unlink(missing_ok=True)
        path.parent.mkdir(exist_ok=True)
        with files.atomic_file(path) as file:
            file.write(text.encode())
    return text


def records(node: Node) -> list[Node]:
    """Return the schemas of the tables that are possible at a node of the schema, alone or in a list; each once."""
    if "$ref" in node:
        return records(schema()["$defs"][node["$ref"].rpartition("/")[2]])
    if "properties" in node:
        return [node]
    found: list[Node] = []
    for record in (record for part in _parts(node) for record in records(part)):
        found += [] if record in found else [record]
    return found


def tags(record: Node) -> dict[str, Any]:
    """Return the tag by which a union recognises this table, such as {"kind": "plane"}, or {} if it has none."""
    keys = record["properties"]
    return {name: keys[name]["const"] for name in TAGS if "const" in keys.get(name, ())}


def _parts(node: Node) -> list[Node]:
    items = node.get("items")
    return [*node.get("anyOf", ()), *node.get("oneOf", ()), *([items] if isinstance(items, dict) else [])]


@dataclass(frozen=True)
class Row:
    """A key as `bstcad keys` prints it."""

    key: str  # dotted key, with [] after the name of a list of tables
    unit: str
    range: str
    default: str
    meaning: str
    kinds: tuple[str, ...] = ()  # kinds of table that have the key; (): all
    example: Any = field(default=None, compare=False)  # None: no example


def rows(record: Node | None = None, table: str = "") -> list[Row]:
    """Return the keys of a table and of the tables in it.  record: its schema (None: the scene's); table: its key."""
    record, found = record or schema(), []
    for name, node in record["properties"].items():
        inner, key = records(node), f"{table}.{name}".lstrip(".")
        if inner and node.get("type") == "array":
            key += "[]"
        default, meaning, [example, *_] = _default(record, name), node["description"], node.get("examples", [None])
        found.append(Row(key, node["unit"], span(node), default, meaning=meaning, example=example))
        found += _union(inner, key)
    return found


def _union(union: list[Node], table: str) -> list[Row]:
    """Return the keys of the tables that are possible at a key, each key once, with the kinds of table that have it."""
    if len(union) < 2:
        return [row for record in union for row in rows(record, table)]
    [name] = tags(union[0])
    pairs = [("".join(tags(record).values()), record) for record in union]
    kinds = [kind for kind, _ in pairs]
    found: dict[Row, list[str]] = {}
    for kind, record in pairs:
        for row in rows(record, table):
            found.setdefault(row, []).append(kind)
    meaning = " ".join(f"{kind}: {record['properties'][name]['description']}" for kind, record in pairs)
    default = next((each for _, record in pairs if (each := record["properties"][name].get("default"))), "required")
    tag = Row(f"{table}.{name}", "none", " | ".join(kinds), default, meaning=meaning, example=kinds[0])
    others = (row if of == kinds or row.kinds else replace(row, kinds=tuple(of)) for row, of in found.items())
    return [tag, *(row for row in others if row.key != tag.key)]


def span(node: Node) -> str:
    """Return the range or the choices of the key with this schema, in words."""
    if "const" in node or "enum" in node:
        return " | ".join(json.dumps(value).strip('"') for value in node.get("enum", [node.get("const")]))
    if records(node):
        names = [span(part) for part in _parts(node) if "enum" in part or "const" in part]  # names in place of a table
        return " or ".join([*names, "table"]) if node.get("type") != "array" else "tables"
    if parts := [*_parts(node), *node.get("prefixItems", ())[:1]]:
        return " or ".join(dict.fromkeys(map(span, parts)))
    if "minimum" in node:
        ends = node["minimum"], node["maximum"]
        return " to ".join(str(end) if isinstance(end, int) else f"{end:g}" for end in ends)
    return {"boolean": "true | false", "string": "text"}.get(node.get("type", ""), "any number")


def _default(record: Node, name: str) -> str:
    if name in record.get("required", ()):
        return "required"
    default = record["properties"][name].get("default")
    return default if isinstance(default, str) else "" if default is None else toml(default)


def toml(value: Any) -> str:
    """Return a value as it is written in a scene file, in one line."""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {toml(part)}' for key, part in value.items())} }}"
    return f"[{', '.join(map(toml, value))}]" if isinstance(value, list | tuple) else json.dumps(value)
