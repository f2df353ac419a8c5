"""What is wrong with a scene, in one sentence: what, where (a dotted key), what to do."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bstcad.runs.files import MachineError as MachineError
from bstcad.runs.files import SceneError
from bstcad.scene.schema import Node, records, schema, tags, toml

if TYPE_CHECKING:  # the second process, which reads no scenes, need not load it
    from pydantic import ValidationError
    from pydantic_core import ErrorDetails

NAME = r"""[\w-]+|"[^"\n]*"|'[^'\n]*'"""  # of a key in TOML
DOTTED = rf"(?:{NAME})(?:\s*\.\s*(?:{NAME}))*"
HEADER, KEY = re.compile(rf"\s*(\[\[?)\s*({DOTTED})\s*\]"), re.compile(rf"\s*({DOTTED})\s*=")

UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")

NOT_BUILT = {  # words that a scene may well have: the feature that each asks for, and which there is not yet
    **dict.fromkeys(("ies", "ldt", "eulumdat", "intensity"), "files of luminous intensity (IES, EULUMDAT) are"),
    **dict.fromkeys(("rayfile", "ray_file", "rayset", "ray_set"), "files of measured rays are"),
    **dict.fromkeys(("wavefront", "zernike", "phase", "aberrations"), "tailoring for a wavefront is"),
    **dict.fromkeys(("diffraction", "coherent", "interference"), "wave optics is"),
    **dict.fromkeys(("scatter", "scattering", "bsdf", "haze"), "scattering is"),
    **dict.fromkeys(("weight", "targets"), "a lens for several targets is"),
    "unreachable": "a choice of where the target may stay dark is",
}
NEAR = 0.7  # difflib's ratio from which on a known word may be the one that was meant: "ies" and "pixels" have 0.67


def nearest(word: str, known: list[str], otherwise: str) -> str:
    """'did you mean …' for a misspelt word; else all known words, behind "… not built yet" for a word of NOT_BUILT.

    A known word is near from difflib's ratio NEAR on: twice the letters that both share in order, over all letters.
    """
    every = f"{otherwise} {', '.join(known)}"
    if missing := NOT_BUILT.get(word.casefold()):
        return f"{missing} not built yet; {every}"
    near = difflib.get_close_matches(word.casefold(), known, n=1, cutoff=NEAR)
    return f"did you mean {near[0]!r}?" if near else every


def explain(error: ValidationError, data: Any) -> str:
    """The first thing wrong with `data` as a scene; a misspelt key comes before the key that it left missing."""
    located = [(problem, _Place(problem["loc"], data)) for problem in error.errors(include_url=False)]
    located = [(problem, place) for problem, place in located if place.applies] or located
    located.sort(key=lambda pair: pair[0]["type"] not in UNKNOWN_KEY)  # stable: the file's order otherwise
    return _sentence(*located[0])


class _Place:
    """A validation error's location, walked through the data and the JSON schema side by side.

    pydantic's location also holds the tags of unions ('source', 'collimated', 'aperture', 'Circle', 'radius'):
    they choose the record and are no part of the dotted key.
    """

    def __init__(self, location: tuple[int | str, ...], data: Any):
        self.key = ""  # dotted, as the user writes it
        self.applies = True  # False: the error of a union's other branch
        self.records: list[Node] = [schema()]  # the tables that may stand at the key
        self.owners = self.records  # the tables whose key it is
        for step in location:
            if isinstance(step, int):
                self.key += f"[{step}]"
                data = data[step] if isinstance(data, list) and step < len(data) else None
            elif any(step in record["properties"] for record in self.records) or (
                isinstance(data, dict) and step in data
            ):
                self.key += ("." if self.key else "") + step
                data = data.get(step) if isinstance(data, dict) else None
                self.owners = self.records
                self.records = [r for o in self.owners for r in records(o["properties"].get(step, {}))]
            else:
                self._choose(step, data)

    def _choose(self, tag: str, data: Any) -> None:
        """Keep the record that a union's tag or class name speaks of."""
        chosen = [record for record in self.records if tag in (record.get("title"), *tags(record).values())]
        self.records = chosen or self.records
        if chosen and isinstance(data, dict):
            self.applies &= all(data.get(name) == value for name, value in tags(chosen[0]).items())

    @property
    def choices(self) -> list[str]:
        """The tags of the tables that may stand at the key."""
        return [value for record in self.records for value in tags(record).values()]

    @property
    def example(self) -> str:
        """The key with a value, or as a table with its required keys; "" if the schema has no example."""
        name = self.key.rpartition(".")[2]
        node = next((o["properties"][name] for o in self.owners if name in o["properties"]), {})
        if "examples" in node:
            return f"{name} = {toml(node['examples'][0])}"
        return f"[{self.key}] with {', '.join(self.records[0].get('required', ()))}" if self.records else ""

    @property
    def listed(self) -> str:
        """A list that the key could have."""
        return f"[[{self.key}]]" if self.records else self.example.partition(" = ")[2] or "[0.0, 400.0]"


def _sentence(problem: ErrorDetails, place: _Place) -> str:
    key, value, context = place.key, problem["input"], problem.get("ctx", {})
    shown, last = _shown(value), key.rpartition(".")[2]
    match problem["type"]:
        case "value_error":  # one of our own validators
            text = str(context["error"])
            return text if not key or isinstance(context["error"], SceneError) else f"{key}: {text}"
        case "extra_forbidden" | "unexpected_keyword_argument":
            known = sorted({name for owner in place.owners for name in owner["properties"]})
            return f"{key}: unknown key; {nearest(last, known, 'the keys here are')}"
        case "missing" if key.endswith("]"):
            return f"{key[: key.rindex('[')]}: too few numbers; give all of them in the list"
        case "missing":
            return f"{key}: missing; add {f'for example {place.example}' if place.example else 'it to the scene'}"
        case "union_tag_not_found":
            choices = ", ".join(map(repr, place.choices))
            return f"{key}: {context['discriminator'].strip(chr(39))} is missing; give one of {choices}"
        case "union_tag_invalid":
            name = context["discriminator"].strip("'")
            tag = str(context["tag"])
            return f"{key}.{name}: {tag!r} is not possible; {nearest(tag, place.choices, 'choose one of')}"
        case "literal_error" if isinstance(value, bool):
            return f"{key}: {shown} is not possible; write {last} = true or remove the line"
        case "literal_error":
            known = [word.strip("' ") for word in context["expected"].replace(" or ", ", ").split(",")]
            return f"{key}: {shown} is not possible; {nearest(str(value), known, 'choose one of')}"
        case "float_type" | "float_parsing" | "finite_number":
            return f"{key}: {shown} is not a number; write one, without quotes"
        case "int_type" | "int_parsing" | "int_from_float" | "int_parsing_size":
            return f"{key}: {shown} is not a whole number; write one, without quotes or a decimal point"
        case "string_type":
            return f"{key}: {shown} is not text; put it in quotes"
        case "bool_type" | "bool_parsing":
            return f"{key}: {shown} is neither true nor false; write one of the two, without quotes"
        case "tuple_type":
            return f"{key}: {shown} is not a list; write it in brackets, such as {place.listed}"
        case "too_long":
            return f"{key}: {context['actual_length']} values where {context['max_length']} belong; remove the rest"
        case "dataclass_type" | "model_type" | "model_attributes_type" | "dict_type":
            return f"{key}: {shown} is not a table; write for example {place.example or f'[{key}]'}"
    return f"{key}: {problem['msg'][:1].lower()}{problem['msg'][1:]}; change {shown}"


def _shown(value: Any) -> str:
    """A value as the file has it, cut short."""
    text = repr(value) if not isinstance(value, bool) else str(value).lower()
    return text if len(text) <= 40 else text[:39] + "…"


def toml_positions(text: str) -> dict[str, int]:
    """The line, from 1, of each table and key of a TOML text: "source", "source.kind", "effects[0].kind".

    What stands inside a value, such as front = { kind = "plane" }, is on the line of that value (`line_of`).
    """
    found: dict[str, int] = {}
    counts: dict[str, int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if header := HEADER.match(line):
            table = _plain(header[2])
            if header[1] == "[[":
                counts[table] = counts.get(table, -1) + 1
                table = f"{table}[{counts[table]}]"
            found.setdefault(table, number)
        elif key := KEY.match(line):
            found.setdefault(f"{table}.{_plain(key[1])}" if table else _plain(key[1]), number)
    return found


def line_of(key: str, found: Mapping[str, int]) -> int | None:
    """The line of a key, or of the innermost table or value that holds it; None if the file has none of them."""
    while key:
        if key in found:
            return found[key]
        key = key.rpartition(".")[0] if not key.endswith("]") else key.rpartition("[")[0]
    return None


def _plain(dotted: str) -> str:
    """A dotted key as it is read: without quotes and spaces."""
    return ".".join(name.strip("\"'") for name in re.findall(NAME, dotted))
