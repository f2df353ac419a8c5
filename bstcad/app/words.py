"""Conversion of the words that a person types in a field to a value of a scene, and back."""

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
    matching_records,
    new_table,
    node_at,
    records_at,
    table_at,
    without_numbers,
)
from bstcad.scene.errors import SceneError, nearest
from bstcad.scene.new_scene import without_unit
from bstcad.scene.schema import Node, records

BARE = re.compile(r"[A-Za-z0-9_-]+")  # name that TOML allows without quotes
MAX_DIGITS = 300  # largest length of a number (characters)
SPACES = re.compile(r"(?<=\d)[ \u00a0\u2009\u202f'’_](?=\d{3}(?!\d))")  # separators of thousands, before three digits
# Integers such as 1.000.000, by their separator of thousands
THOUSANDS = {mark: re.compile(rf"[+-]?\d{{1,3}}(\{mark}\d{{3}})+") for mark in ",."}
DECIMAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")  # number, with a decimal point or without
BOOLEAN_WORDS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


# ---- from words to a value -------------------------------------------------------------------------------------------


def typed(key: str, words: str, data: Mapping[str, Any]) -> Any:
    """Return the value of the words that a person typed for a key; None, which removes the key, for empty words.

    A number has a decimal point or a decimal comma: 0.5 and 0,5.  A single point or comma is decimal: 1,000 is 1.  If
    both occur, the last is decimal and the others separate thousands, as spaces do: "1.000,5", "1,000.5" and "1 000,5".
    If one is repeated, or the key takes integers, it separates thousands: 1.000 pixels are 1000.  A unit may follow;
    lengths are converted to mm: 40 cm.

    Items of a list are separated by ";", else by commas with a space, else by spaces: "1,5; 2,5" and "1.5, 2.5" and
    "1,5 2,5"; if none of these occurs, by commas: "1.5,2.5", and "1,000" is the list [1, 0] if the key takes lists of
    integers, as target.pixels.  Anything in brackets is TOML: [[486.1, 1.0], [587.6, 1.0]].

    SceneError for an unknown key, or words that are not a value of the key.
    """
    node = node_at(key, data)
    if node is None:
        parent, _, last = key.rpartition(".")
        union = matching_records(records_at(parent, data), table_at(parent, data))
        known = sorted({name for record in union for name in record["properties"]})
        raise SceneError(f"{key}: unknown key; {nearest(without_numbers(last), known, 'the keys here are')}")
    if not words.strip():
        return None
    if node.get("type") == "string" and not choices(node):
        return words
    unit = node["unit"] if node["unit"] != "none" else ""
    words = words.strip().removesuffix(unit).rstrip()
    if kinds := kinds_at(key, data):  # the table may change its kind
        node = {name: part for name, part in node.items() if name != "const"} | {"enum": kinds}
    for value in _interpretations(node, words):
        if value is False and node.get("const") is True:
            return None
        try:
            return cast(node, value)
        except ValueError:
            continue
    raise SceneError(f"{key}: {_fault(key, node, words, data)}")


def _interpretations(node: Node, words: str) -> Iterator[Any]:
    """Iterate over the possible values of some words, the likeliest first."""
    yield from _toml(words)
    lists = [_parts(words), [part for part in re.split(r"[;,\s]+", words) if part]]
    yield from ([_scalar(node, part) for part in parts] for parts in lists if len(parts) > 1)
    one = _scalar(node, words)
    yield one
    if len(words) < MAX_DIGITS and any(form.fullmatch(words) for form in THOUSANDS.values()):
        yield int(re.sub(r"[.,]", "", words))
    yield [one]


def _toml(words: str) -> Iterator[Any]:
    """Iterate over the values of a list or table in TOML; a list of lists may lack its outer brackets."""
    for text in (words, f"[{words}]") if words[:1] in ("[", "{") else ():
        try:
            yield tomllib.loads(f"value = {text}")["value"]
        except (ValueError, RecursionError):
            continue


def _parts(words: str) -> list[str]:
    """Split a list of numbers that may have decimal commas."""
    words = words.strip("[]")
    if ";" in words:
        return [part.strip() for part in words.split(";") if part.strip()]
    return re.split(r",\s+", words.strip()) if re.search(r",\s", words) else words.split()


def _scalar(node: Node, words: str) -> Any:
    """Return a choice of the node, a boolean, a number, or else the text itself."""
    words = words.strip("\"' ")
    same = next((choice for choice in choices(node) if str(choice).casefold() == words.casefold()), None)
    found = BOOLEAN_WORDS.get(words.casefold()) if same is None else same
    if found is None and node.get("unit") == "mm":
        bare, unit = without_unit(words)
        length = number(bare)
        found = length if length is None or unit == 1.0 else length * unit
    found = number(words) if found is None else found
    return words if found is None else found


def number(words: str) -> int | float | None:
    """Return the number that a person typed (see `typed`); None if it is not a finite number."""
    text = SPACES.sub("", words.strip().replace("\u2212", "-"))
    decimal = max(".,", key=text.rfind)
    mark = "," if decimal == "." else "."
    if mark in text:
        whole, _, rest = text.partition(decimal)
        text = f"{whole.replace(mark, '')}.{rest}" if THOUSANDS[mark].fullmatch(whole) else ""
    elif text.count(decimal) > 1:
        text = text.replace(decimal, "") if THOUSANDS[decimal].fullmatch(text) else ""
    text = text.replace(",", ".")
    if not DECIMAL.fullmatch(text) or len(text) > MAX_DIGITS:
        return None
    value = float(text)
    return None if not math.isfinite(value) else int(text) if text.lstrip("+-").isdigit() else value


def _fault(key: str, node: Node, words: str, data: Mapping[str, Any]) -> str:
    """Return the reason why some words are not a value of a node, with a remedy."""
    quoted = repr(words) if len(words) <= 40 else repr(words[:39] + "…")
    parts, kinds = alternatives(node), [part.get("type") for part in alternatives(node)]
    sample = example(key, node, data)
    if records(node):
        return f"{quoted} is not a table; write it in braces, such as {sample}"
    if words_of := [choice for choice in choices(node) if not isinstance(choice, bool)]:
        wrong = [part for part in _parts(words) if _scalar(node, part) not in words_of] or [words]
        wrong = wrong if "array" in kinds else [words]
        return f"{wrong[0]!r} is not possible; {nearest(wrong[0], [*map(str, words_of)], 'choose one of')}"
    if "boolean" in kinds:
        return f"{quoted} is neither true nor false; write true or false"
    if kinds == ["array"] and "prefixItems" in parts[0]:
        given, wanted = _parts(words), parts[0]["minItems"]
        wrong = [part for part in given if number(part) is None]
        if wrong:
            return f"{wrong[0][:40]!r} is not a number; write {wanted} numbers, such as {sample}"
        return f"{wanted} values are needed instead of {len(given)}; write {wanted}, such as {sample}"
    if kinds == ["array"]:
        return f"{quoted} is not a list of the right form; write a list such as {sample}"
    what, remedy = ("whole number", "without a decimal point") if "integer" in kinds else ("number", "with digits")
    return f"{quoted} is not a {what}; write one, {f'such as {sample}' if sample else remedy}"


def example(key: str, node: Node, data: Mapping[str, Any]) -> str:
    """Return an example value of a key as words: the schema's example or default, a new table as TOML, or zeros."""
    if "examples" in node or "default" in node:
        return as_words(node["examples"][0] if "examples" in node else node["default"])
    if records(node):
        return as_toml(new_table(key, data))
    fixed = [part["minItems"] for part in alternatives(node) if "minItems" in part]
    return as_words([0.0] * fixed[0]) if fixed else ""


# ---- from a value to words -------------------------------------------------------------------------------------------


def as_words(value: Any) -> str:
    """Return a value in the words that `typed` reads: 20, "-200, 200", PMMA; lists of lists and tables as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return repr(value).removesuffix(".0")
    if isinstance(value, list | tuple) and value and not any(isinstance(part, list | tuple | dict) for part in value):
        return ", ".join(map(as_words, value))
    return as_toml(value) if isinstance(value, list | tuple | dict) else str(value)


def as_toml(value: Any) -> str:
    """Return a value as TOML in one line."""
    if isinstance(value, Mapping):
        return inline_table({name: as_toml(part) for name, part in value.items()})
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(as_toml, value))}]"
    return tomlkit.item(value).as_string()


def inline_table(parts: Mapping[str, str]) -> str:
    """Return an inline table of TOML from names and values in TOML."""
    return f"{{ {', '.join(f'{toml_key(name)} = {part}' for name, part in parts.items())} }}" if parts else "{}"


def toml_key(name: str) -> str:
    """Return a name as a key of TOML, quoted if necessary."""
    return name if BARE.fullmatch(name) else tomlkit.item(name).as_string()
