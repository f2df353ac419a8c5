"""Messages of a refused scene: one sentence with the dotted key, the fault and a remedy."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bstcad.runs.files import MachineError as MachineError
from bstcad.runs.files import SceneError
from bstcad.scene.schema import Node, records, schema, tags, toml

if TYPE_CHECKING:
    from pydantic import ValidationError
    from pydantic_core import ErrorDetails

KEY_NAME = r"""[\w-]+|"[^"\n]*"|'[^'\n]*'"""  # pattern of a name between the dots of a TOML key
DOTTED = rf"(?:{KEY_NAME})(?:\s*\.\s*(?:{KEY_NAME}))*"
HEADER, KEY = re.compile(rf"\s*(\[\[?)\s*({DOTTED})\s*\]"), re.compile(rf"\s*({DOTTED})\s*=")

NOT_BUILT = {  # beginnings of sentences about features that bstcad does not have yet, by a word for the feature
    **dict.fromkeys(("rayfile", "ray_file", "rayset", "ray_set"), "files of measured rays are not built yet"),
    **dict.fromkeys(("diffraction", "coherent", "interference"), "wave optics is not built yet"),
    **dict.fromkeys(
        ("scatter", "scattering", "bsdf", "haze"),
        "scattering is not built as an effect of a design (bstcad plan --made GRADE predicts it for rough faces)",
    ),
}
# Patterns: key of a single target at the beginning of a sentence or inside it; key of one of several targets.
THE_TARGET, ONE_TARGET = re.compile(r"^target(?=[.:])|(?<=\s)target(?=\.[a-z])"), re.compile(r"target\[\d+\]")
SIMILARITY = 0.7  # smallest ratio of difflib at which a known word is proposed; "ies" and "pixels" have 0.67

UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")  # pydantic's errors for an unknown key
SENTENCES = {  # sentence by type of pydantic's error; {shown}: the value; {listed}, {example}: examples
    ("float_type", "float_parsing", "finite_number"): "{shown} is not a number; write one, without quotes",
    ("int_type", "int_parsing", "int_from_float", "int_parsing_size"): (
        "{shown} is not a whole number; write one, without quotes or a decimal point"
    ),
    ("string_type",): "{shown} is not text; put it in quotes",
    ("bool_type", "bool_parsing"): "{shown} is neither true nor false; write true or false, without quotes",
    ("tuple_type",): "{shown} is not a list; write it in brackets, such as {listed}",
    ("too_long",): "has {actual_length} values, and {max_length} is the maximum; remove the rest",
    ("too_short",): "has {actual_length} values, and {min_length} is the minimum; add some",
    ("dataclass_type", "model_type", "model_attributes_type", "dict_type"): (
        "{shown} is not a table; write for example {example}"
    ),
    ("missing",): "missing; add for example {example}",
}


def with_target_key(sentence: str, key: str) -> str:
    """Replace the key of a single target in a sentence, "target.z: …", by that of one of several, "target[1].z: …"."""
    return THE_TARGET.sub(key, sentence)


def nearest(word: str, known: list[str], otherwise: str) -> str:
    """Return "did you mean …?" for a misspelt word, or else all known words after the words `otherwise`.

    For a word of NOT_BUILT, its sentence precedes the list.  Words are compared by difflib's ratio: twice the
    number of letters that they share in order, divided by the number of all letters.
    """
    choices = f"{otherwise} {', '.join(known)}"
    if missing := NOT_BUILT.get(word.casefold()):
        return f"{missing}; {choices}"
    similar = difflib.get_close_matches(word.casefold(), known, n=1, cutoff=SIMILARITY)
    return f"did you mean {similar[0]!r}?" if similar else choices


def explain(error: ValidationError, data: Any) -> str:
    """Return the first fault that pydantic found in the tables `data` as a sentence; unknown keys come first."""
    problems = [problem for problem in error.errors(include_url=False) if _applies(problem["loc"], data)]
    return _sentence(min(problems, key=lambda problem: problem["type"] not in UNKNOWN_KEY))


def _applies(location: tuple[int | str, ...], data: Any) -> bool:
    """Return True unless an error at this location is about another shape of outline than `data` states."""
    for step in location:
        if step in ("Circle", "Rectangle") and isinstance(data, dict):
            return data.get("shape") == step.lower()
        if isinstance(data, dict):
            data = data.get(step, data)
        elif isinstance(data, list) and isinstance(step, int):
            data = data[step] if step < len(data) else data
    return True


class _Location:
    """Location of a validation error in the JSON schema.

    pydantic's location also contains the tags of unions ('source', 'collimated', 'aperture', 'Circle', 'radius').  They
    select the record and are not part of the dotted key.
    """

    def __init__(self, problem: ErrorDetails):
        self.key = ""  # dotted key, as the user writes it
        self.records: list[Node] = [schema()]  # tables that are possible at the key
        self.owners = self.records  # tables that have the key
        unknown = problem["loc"][-1:] if problem["type"] in UNKNOWN_KEY else ()
        for step in problem["loc"]:
            if isinstance(step, int):
                self.key += f"[{step}]"
            elif step in unknown or any(step in record["properties"] for record in self.records):
                self.key = f"{self.key}.{step}".lstrip(".")
                self.owners = self.records
                self.records = [r for o in self.owners for r in records(o["properties"].get(step, {}))]
            else:  # tag, or class of a record
                chosen = [record for record in self.records if step in (record.get("title"), *tags(record).values())]
                self.records = chosen or self.records

    @property
    def choices(self) -> list[str]:
        """Tags of the tables that are possible at the key."""
        return [value for record in self.records for value in tags(record).values()]

    @property
    def example(self) -> str:
        """Example of the key with a value, or as a table with its required keys."""
        name = self.key.rpartition(".")[2]
        node: Node = next((o["properties"][name] for o in self.owners if name in o["properties"]), {})
        if "examples" in node:
            return f"{name} = {toml(node['examples'][0])}"
        required = ", ".join(self.records[0].get("required", ())) if self.records else ""
        return f"[{self.key}] with {required}" if required else f"[{self.key}]"

    @property
    def listed(self) -> str:
        """Example of a list at the key."""
        return f"[[{self.key}]]" if self.records else self.example.partition(" = ")[2] or "[0.0, 400.0]"


def _sentence(problem: ErrorDetails) -> str:
    location, value, context = _Location(problem), problem["input"], problem.get("ctx", {})
    key, fault = location.key, context.get("error")
    if isinstance(fault, SceneError) or (fault and not key):  # raised by a validator of bstcad
        return with_target_key(str(fault), target[0]) if (target := ONE_TARGET.match(key)) else str(fault)
    return f"{key}: {fault}" if fault else _type_sentence(problem["type"], location, value, context)


def _type_sentence(kind: str, location: _Location, value: Any, context: Mapping[str, Any]) -> str:
    """Return the sentence on an error of type `kind` by pydantic; value: refused value; context: `ctx` of the error."""
    key, last = location.key, location.key.rpartition(".")[2]
    shown = _value_text(value)
    tag, name = str(context.get("tag")), context.get("discriminator", "").strip("'").removesuffix("()")
    if kind in UNKNOWN_KEY:
        known = sorted({name for owner in location.owners for name in owner["properties"]})
        return f"{key}: unknown key; {nearest(last, known, 'the keys here are')}"
    if kind == "union_tag_not_found":
        return f"{key}: {name} is missing; give one of {', '.join(map(repr, location.choices))}"
    if kind == "union_tag_invalid":
        return f"{key}.{name}: {tag!r} is not possible; {nearest(tag, location.choices, 'choose one of')}"
    if kind == "literal_error" and isinstance(value, bool):
        return f"{key}: {shown} is not possible; write {last} = true or remove the line"
    if kind == "literal_error":
        known = [word.strip("' ") for word in context["expected"].replace(" or ", ", ").split(",")]
        return f"{key}: {shown} is not possible; {nearest(str(value), known, 'choose one of')}"
    if kind == "missing" and key.endswith("]"):
        return f"{key[: key.rindex('[')]}: the list has too few numbers; add the others"
    if kind == "float_type" and isinstance(value, list) and last == "wavelength":
        spectrum = "a spectrum is a list of lines, each with a wavelength in nm and a weight"
        return f"{key}: {spectrum}; write for example [[486.1, 1.0], [587.6, 1.0]]"
    sentence = next((text for kinds, text in SENTENCES.items() if kind in kinds), "{shown} is not possible; change it")
    return f"{key}: " + sentence.format(shown=shown, example=location.example, listed=location.listed, **context)


def _value_text(value: Any) -> str:
    """Return a value nearly as it is written in a file, shortened to 40 characters."""
    text = repr(value) if not isinstance(value, bool) else str(value).lower()
    return text if len(text) <= 40 else text[:39] + "…"


def toml_positions(text: str) -> dict[str, int]:
    """Return the line number, from 1, of each table and key of a TOML text: "source", "source.kind", "effects[0].kind".

    Keys of an inline table, front = { kind = "plane" }, are omitted; `line_of` returns the line of the table.
    """
    lines: dict[str, int] = {}
    counts: dict[str, int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if header := HEADER.match(line):
            table = _plain(header[2])
            if header[1] == "[[":
                counts[table] = counts.get(table, -1) + 1
                table = f"{table}[{counts[table]}]"
            lines.setdefault(table, number)
        elif key := KEY.match(line):
            lines.setdefault(f"{table}.{_plain(key[1])}".lstrip("."), number)
    for table in (table for table, last in counts.items() if last == 0):  # the only table of a list has no number
        single = f"{table}[0]"
        lines |= {table + key.removeprefix(single): line for key, line in lines.items() if key.startswith(single)}
    return lines


def line_of(key: str, lines: Mapping[str, int]) -> int | None:
    """Return the line of a key, or of the innermost table or value around it, or None; lines: from toml_positions."""
    while key and key not in lines:
        key = key.rpartition("[" if key.endswith("]") else ".")[0]
    return lines.get(key)


def _plain(dotted: str) -> str:
    """Return a dotted key without quotes and spaces."""
    return ".".join(name.strip("\"'") for name in re.findall(KEY_NAME, dotted))
