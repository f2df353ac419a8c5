"""What is wrong with a scene, in one sentence: what, where (a dotted key), what to do."""

from __future__ import annotations

import difflib
import functools
import types
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin, get_type_hints

from bstcad.files import SentenceError, one_line

if TYPE_CHECKING:  # the second process, which reads no scenes, need not load it
    from pydantic import BaseModel, ValidationError
    from pydantic_core import ErrorDetails

TAGS = ("kind", "shape")  # of records in a union: the keys that tell which one it is
UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")

# What a missing key could look like; shown to the user.
EXAMPLES = {
    "name": 'name = "my-lens"',
    "source": '[source] with kind = "point" or "collimated"',
    "lens": "[lens] with material, outline, front and back",
    "target": "[target] with z, x, y, pixels and a picture",
    "kind": 'kind = "sphere"',
    "aperture": 'aperture = { shape = "circle", radius = 12.0 }',
    "outline": 'outline = { shape = "rectangle", width = 24.0, height = 24.0 }',
    "front": 'front = { kind = "plane", z = 8.0 }',
    "back": 'back = { kind = "bspline", z = 20.0, control_points = 257 }',
    **{name: f"{name} = 12.0" for name in ("width", "height", "radius")},
    "control_points": "control_points = 257",
    "thickness": "thickness = 100.0",
    "index": "index = 1.38",
    "coating": "coating = { index = 1.38, thickness = 100.0 }",
    "pixels": "pixels = 512",
    "x": "x = [-200.0, 200.0]",
    "y": "y = [-200.0, 200.0]",
    "z": "z = 20.0",
}
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
LISTS = {"export": '["zemax", "dxf"]', "holes": "[[14.0, 0.0, 3.2]]"}  # of those that are not two numbers


class SceneError(SentenceError, ValueError):
    """A scene that cannot be used; its text is one sentence with a remedy."""

    def __init__(self, sentence: object = "") -> None:
        super().__init__(one_line(sentence))


class MachineError(SentenceError, RuntimeError):
    """What this machine could not do though the scene is right; its text is one sentence with a remedy."""


def nearest(word: str, known: list[str], otherwise: str) -> str:
    """'did you mean …' for a misspelt word; else all known words, behind "… not built yet" for a word of NOT_BUILT.

    A known word is near from difflib's ratio NEAR on: twice the letters that both share in order, over all letters.
    """
    every = f"{otherwise} {', '.join(known)}"
    if missing := NOT_BUILT.get(word.casefold()):
        return f"{missing} not built yet; {every}"
    near = difflib.get_close_matches(word.casefold(), known, n=1, cutoff=NEAR)
    return f"did you mean {near[0]!r}?" if near else every


def explain(error: ValidationError, data: Any, root: type[BaseModel]) -> str:
    """The first thing wrong with `data` as a `root` record; a misspelt key comes before what it left missing."""
    located = [(problem, _Place(problem["loc"], data, root)) for problem in error.errors(include_url=False)]
    located = [(problem, place) for problem, place in located if place.applies] or located
    located.sort(key=lambda pair: pair[0]["type"] not in UNKNOWN_KEY)  # stable: the file's order otherwise
    return _sentence(*located[0])


class _Place:
    """A validation error's location, walked through the data and the records side by side.

    pydantic's location also holds the tags of unions ('source', 'collimated', 'aperture', 'Circle', 'radius'):
    they choose the record and are no part of the dotted key.
    """

    def __init__(self, location: tuple[int | str, ...], data: Any, root: type):
        self.key = ""  # dotted, as the user writes it
        self.applies = True  # False: the error of a union's other branch
        self.records: list[type] = [root]  # what may stand at the key
        self.owners: list[type] = [root]  # the records whose key it is
        for step in location:
            if isinstance(step, int):
                self.key += f"[{step}]"
                data = data[step] if isinstance(data, list) and step < len(data) else None
            elif any(step in _keys(record) for record in self.records) or (isinstance(data, dict) and step in data):
                self.key += ("." if self.key else "") + step
                data = data.get(step) if isinstance(data, dict) else None
                self.owners, self.records = self.records, [r for o in self.records for r in _records(o, step)]
            else:
                self._choose(step, data)

    def _choose(self, tag: str, data: Any) -> None:
        """Keep the record a union's tag or class name speaks of."""
        chosen = [record for record in self.records if tag in (record.__name__, *_tag(record).values())]
        self.records = chosen or self.records
        if chosen and isinstance(data, dict):
            self.applies &= all(data.get(name) == value for name, value in _tag(chosen[0]).items())


def _keys(record: type) -> list[str]:
    """The keys of a record, in the order it declares them."""
    if is_dataclass(record):
        return [field.name for field in fields(record)]
    return list(getattr(record, "model_fields", ()))


def _tag(record: type) -> dict[str, Any]:
    """The key and value that name a record in a union: {'kind': 'plane'}."""
    if is_dataclass(record):
        return {name: getattr(record, name) for name in TAGS if hasattr(record, name)}
    found = {name: field for name, field in getattr(record, "model_fields", {}).items() if name in TAGS}
    one = {name: get_args(field.annotation) for name, field in found.items() if get_origin(field.annotation) is Literal}
    return {name: values[0] for name, values in one.items() if len(values) == 1}


def _records(owner: type, key: str) -> list[type]:
    """The records that may stand at a key of `owner`, by themselves or in a list."""
    if key not in _keys(owner):
        return []
    return [leaf for leaf in _leaves(_hints(owner)[key]) if _keys(leaf)]


_hints = functools.cache(get_type_hints)  # of a record; they are compiled anew at each asking


def _leaves(annotation: Any) -> list[type]:
    """The classes of a (nested) union or tuple."""
    if get_origin(annotation) in (Union, types.UnionType, tuple):
        return [leaf for part in get_args(annotation) for leaf in _leaves(part)]
    return [annotation] if isinstance(annotation, type) else []


def _sentence(problem: ErrorDetails, place: _Place) -> str:
    key, value, context = place.key, problem["input"], problem.get("ctx", {})
    shown, last = _shown(value), key.rpartition(".")[2]
    match problem["type"]:
        case "value_error":  # one of our own validators
            text = str(context["error"])
            return text if not key or isinstance(context["error"], SceneError) else f"{key}: {text}"
        case "extra_forbidden" | "unexpected_keyword_argument":
            known = sorted({name for owner in place.owners for name in _keys(owner)})
            return f"{key}: unknown key; {nearest(last, known, 'the keys here are')}"
        case "missing" if key.endswith("]"):
            return f"{key[: key.rindex('[')]}: too few numbers; give all of them in the list"
        case "missing":
            return f"{key}: missing; add {f'for example {EXAMPLES[last]}' if last in EXAMPLES else 'it to the scene'}"
        case "union_tag_not_found":
            tags = ", ".join(repr(v) for record in place.records for v in _tag(record).values())
            return f"{key}: {context['discriminator'].strip(chr(39))} is missing; give one of {tags}"
        case "union_tag_invalid":
            known = [v for record in place.records for v in _tag(record).values()]
            name = context["discriminator"].strip("'")
            tag = str(context["tag"])
            return f"{key}.{name}: {tag!r} is not possible; {nearest(tag, known, 'choose one of')}"
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
            return f"{key}: {shown} is not a list; write it in brackets, such as {LISTS.get(last, '[0.0, 400.0]')}"
        case "too_long":
            return f"{key}: {context['actual_length']} values where {context['max_length']} belong; remove the rest"
        case "dataclass_type" | "model_type" | "model_attributes_type" | "dict_type":
            return f"{key}: {shown} is not a table; write for example {EXAMPLES.get(last, f'[{key}]')}"
    return f"{key}: {problem['msg'][:1].lower()}{problem['msg'][1:]}; change {shown}"


def _shown(value: Any) -> str:
    """A value as the file has it, cut short."""
    text = repr(value) if not isinstance(value, bool) else str(value).lower()
    return text if len(text) <= 40 else text[:39] + "…"
