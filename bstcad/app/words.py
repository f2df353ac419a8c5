"""What a person types in a field, as a value of a scene; and a value as a person types it."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

import tomlkit

from bstcad.app.kinds import (
    alternatives,
    cast,
    choices,
    kinds_at,
    new_table,
    node_at,
    of_kinds,
    plain,
    records_at,
    table_at,
)
from bstcad.scene.errors import SceneError, nearest
from bstcad.scene.schema import Node, records

BARE = re.compile(r"[A-Za-z0-9_-]+")  # a name that TOML takes without quotes
DIGITS = 300  # of a number, at most
SPACES = re.compile(r"(?<=\d)[ \u00a0\u2009\u202f'’_](?=\d{3}(?!\d))")  # which stand before three digits of a number
THOUSANDS = {mark: re.compile(rf"[+-]?\d{{1,3}}(\{mark}\d{{3}})+") for mark in ",."}
DECIMAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
YES_NO = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


# ---- from words to a value -------------------------------------------------------------------------------------------


def typed(key: str, words: str, data: Mapping[str, Any]) -> Any:
    """What a person typed in the field of a key, as its value; None, the key goes, for nothing.  Raises SceneError.

    A number has a decimal point or a decimal comma: 0.5 and 0,5.  A mark alone is decimal: 1,000 is 1.  Of both marks
    the last is decimal and the other parts thousands, as spaces do: 1.000,5 and 1,000.5 and 1 000,5.  A mark that comes
    twice parts thousands; in a whole number each does: 1.000 pixels are 1000.  The unit may stand behind.

    Numbers of a list are parted by ";", or else by commas with a space behind, or else by spaces: "1,5; 2,5" and
    "1.5, 2.5" and "1,5 2,5"; only if these part nothing, by commas alone: "1.5,2.5".  Texts of a list likewise.
    Anything in brackets is TOML: [[486.1, 1.0], [587.6, 1.0]].
    """
    node = node_at(key, data)
    if node is None:
        place, _, last = key.rpartition(".")
        union = of_kinds(records_at(place, data), table_at(place, data))
        known = sorted({name for record in union for name in record["properties"]})
        raise SceneError(f"{key}: unknown key; {nearest(plain(last), known, 'the keys here are')}")
    if not words.strip():
        return None
    if node.get("type") == "string" and not choices(node):
        return words
    unit = node["unit"] if node["unit"] != "none" else ""
    words = words.strip().removesuffix(unit).rstrip()
    if kinds := kinds_at(key, data):  # another kind of table is possible, too
        node = {name: part for name, part in node.items() if name != "const"} | {"enum": kinds}
    for value in _readings(node, words):
        if value is False and node.get("const") is True:
            return None
        try:
            return cast(node, value)
        except ValueError:
            continue
    raise SceneError(f"{key}: {_fault(key, node, words, data)}")


def _readings(node: Node, words: str) -> Iterator[Any]:
    """What some words may mean, the likeliest first."""
    yield from _toml(words)
    lists = [_parts(words), [part for part in re.split(r"[;,\s]+", words) if part]]
    yield from ([_one(node, part) for part in parts] for parts in lists if len(parts) > 1)
    one = _one(node, words)
    yield one
    if len(words) < DIGITS and any(form.fullmatch(words) for form in THOUSANDS.values()):
        yield int(re.sub(r"[.,]", "", words))
    yield [one]


def _toml(words: str) -> Iterator[Any]:
    """A list or a table as TOML, a list of lists also without its outer brackets."""
    for text in (words, f"[{words}]") if words[:1] in ("[", "{") else ():
        try:
            yield tomllib.loads(f"value = {text}")["value"]
        except (ValueError, RecursionError):
            continue


def _parts(words: str) -> list[str]:
    """The parts of a list of numbers that may have decimal commas."""
    words = words.strip("[]")
    if ";" in words:
        return [part.strip() for part in words.split(";") if part.strip()]
    return re.split(r",\s+", words.strip()) if re.search(r",\s", words) else words.split()


def _one(node: Node, words: str) -> Any:
    """A choice of the node, true or false, or a number; else a text."""
    words = words.strip("\"' ")
    same = next((choice for choice in choices(node) if str(choice).casefold() == words.casefold()), None)
    found = YES_NO.get(words.casefold()) if same is None else same
    found = number(words) if found is None else found
    return words if found is None else found


def number(words: str) -> int | float | None:
    """A number as a person types it (see `typed`); None: it is none that is finite."""
    text = SPACES.sub("", words.strip().replace("\u2212", "-"))
    decimal = max(".,", key=text.rfind)
    mark = "," if decimal == "." else "."
    if mark in text:
        whole, _, rest = text.partition(decimal)
        text = f"{whole.replace(mark, '')}.{rest}" if THOUSANDS[mark].fullmatch(whole) else ""
    elif text.count(decimal) > 1:
        text = text.replace(decimal, "") if THOUSANDS[decimal].fullmatch(text) else ""
    text = text.replace(",", ".")
    if not DECIMAL.fullmatch(text) or len(text) > DIGITS:
        return None
    value = float(text)
    return None if not math.isfinite(value) else int(text) if text.lstrip("+-").isdigit() else value


def _fault(key: str, node: Node, words: str, data: Mapping[str, Any]) -> str:
    """Why some words are no value of a node, and a remedy."""
    said = repr(words) if len(words) <= 40 else repr(words[:39] + "…")
    parts, kinds = alternatives(node), [part.get("type") for part in alternatives(node)]
    such = example(key, node, data)
    if records(node):
        return f"{said} is not a table; write it in braces, such as {such}"
    if words_of := [choice for choice in choices(node) if not isinstance(choice, bool)]:
        wrong = [part for part in _parts(words) if _one(node, part) not in words_of] or [words]
        wrong = wrong if "array" in kinds else [words]
        return f"{wrong[0]!r} is not possible; {nearest(wrong[0], [*map(str, words_of)], 'choose one of')}"
    if "boolean" in kinds:
        return f"{said} is neither true nor false; write one of the two"
    if kinds == ["array"] and "prefixItems" in parts[0]:
        given, wanted = _parts(words), parts[0]["minItems"]
        wrong = [part for part in given if number(part) is None]
        return (
            f"{wrong[0][:40]!r} is not a number; write {wanted} of them, such as {such}" if wrong
            else f"{len(given)} values where {wanted} belong; write them such as {such}"
        )  # fmt: skip
    if kinds == ["array"]:
        return f"{said} is not such a list; write it such as {such}"
    what, remedy = (
        ("whole number", "without a decimal point") if "integer" in kinds else ("number", "with digits alone")
    )
    return f"{said} is not a {what}; write one, {f'such as {such}' if such else remedy}"


def example(key: str, node: Node, data: Mapping[str, Any]) -> str:
    """A value of a key as a person types it: the schema's example, its default, or zeros; of a table as TOML."""
    if "examples" in node or "default" in node:
        return as_words(node["examples"][0] if "examples" in node else node["default"])
    if records(node):
        return shown(new_table(key, data))
    fixed = [part["minItems"] for part in alternatives(node) if "minItems" in part]
    return as_words([0.0] * fixed[0]) if fixed else ""


# ---- from a value to words -------------------------------------------------------------------------------------------


def as_words(value: Any) -> str:
    """A value as a person types it, and `typed` reads it: 20, "-200, 200", PMMA; lists of lists and tables as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return repr(value).removesuffix(".0")
    if isinstance(value, list | tuple) and value and not any(isinstance(part, list | tuple | dict) for part in value):
        return ", ".join(map(as_words, value))
    return shown(value) if isinstance(value, list | tuple | dict) else str(value)


def shown(value: Any) -> str:
    """A value as a scene file has it, in one line."""
    if isinstance(value, Mapping):
        return braced({name: shown(part) for name, part in value.items()})
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(shown, value))}]"
    return tomlkit.item(value).as_string()


def braced(parts: Mapping[str, str]) -> str:
    """A table in braces, of names and values as they are written."""
    return f"{{ {', '.join(f'{quoted(name)} = {part}' for name, part in parts.items())} }}" if parts else "{}"


def quoted(name: str) -> str:
    """A name as a key of TOML."""
    return name if BARE.fullmatch(name) else tomlkit.item(name).as_string()
