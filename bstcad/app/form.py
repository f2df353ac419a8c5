"""The form of a scene: a field for each key that its tables have or may have, as the schema describes it, and as HTML.

What a scene has not, such as a wavefront or a second target, is an addition: a button that puts the table there.
"""

from __future__ import annotations

import functools
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from bstcad.app.kinds import alternatives, choices, new_table, of_kinds, plain, records_at
from bstcad.app.words import as_words, number
from bstcad.scene.schema import TAGS, Node, records, rows, schema, tags

if TYPE_CHECKING:
    import jinja2

FIRST: tuple[Mapping[str, str], ...] = (  # what most people change: a key and its words, of several the one that is set
    {
        "target.image": "Picture", "target.text": "Letters as the picture", "target.sample": "Sample as the picture",
        "target.uniform": "Even light, no picture", "target.profile.shape": "Shape of light, no picture",
    },
    {"target.z": "Place of the wall (z)"},
    {"target.x": "Picture on the wall, its ends in x"},
    {"target.y": "Picture on the wall, its ends in y"},
    {"lens.outline.shape": "Outline of the lens"},
    {
        "lens.outline.width": "Width of the lens", "lens.outline.diameter": "Diameter of the lens",
        "lens.outline.radius": "Radius of the lens",
    },
    {"lens.outline.height": "Height of the lens"},
    {"lens.back.z": "Back of the lens (z)"},
    {"lens.material": "Material", "lens.index": "Refractive index"},
    {"source.kind": "Light"},
    {"source.wavelength": "Wavelength"},
    {"target.seen_from": "Seen from"},
    {"target.rotate": "Turned by"},
    {"target.fit": "Crop or pad"},
    {"target.gamma": "Brightness of the picture's tones (gamma)"},
    {"tailoring.quality": "Quality"},
)  # fmt: skip
LOCKS = {"x": "y", "y": "x", "width": "height", "height": "width"}  # a side, and the one that a closed lock moves
ASKED_FOR = ("mount",)  # tables that mean something by being there, even without a key
MANY = 1000  # tables of a list that has no limit
STEPS, ROUND = 100, (5, 2, 1)  # of a slider, at least; and the figures that a step may have

Control = Literal["number", "pair", "numbers", "choice", "check", "text", "lines"]
Table = Mapping[str, Any]


# ---- records ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Field:
    """A key of a scene; its texts are as a person types them (words.as_words)."""

    key: str  # dotted, a table of a list by its number
    label: str
    unit: str  # "": it has none
    least: float | None  # the range; None: it has none
    most: float | None
    meaning: str  # a sentence
    default: str  # "": it has none
    example: str
    control: Control
    choices: tuple[str, ...]  # of a choice, or of a text that lists some
    value: str  # "": it is absent
    given: bool  # it is set
    required: bool
    page: str  # of the documentation, from its first page


@dataclass(frozen=True)
class Addition:
    """A table that may come, and with which keys (scene_text.changed)."""

    key: str
    label: str
    value: Mapping[str, Any]


@dataclass(frozen=True)
class Group:
    """A table of a scene, a list of tables, or a section's keys without a table."""

    key: str  # "": name and title
    label: str
    meaning: str
    page: str
    fields: tuple[Field, ...]
    groups: tuple[Group, ...]  # tables in it
    additions: tuple[Addition, ...]
    removable: bool  # the scene does without it

    def every(self) -> Iterator[Group]:
        """It, and all groups in it."""
        yield self
        for group in self.groups:
            yield from group.every()


@dataclass(frozen=True)
class Form:
    """All fields of a scene; those of `first` are not among the sections'."""

    first: tuple[Field, ...]
    sections: tuple[Group, ...]  # in the schema's order
    additions: tuple[Addition, ...]  # of sections

    def in_rows(self) -> Iterator[tuple[Field, ...]]:
        """The first fields one by one, but two sides that a lock may join together."""
        left = [*self.first]
        while left:
            field = left.pop(0)
            place, _, name = field.key.rpartition(".")
            joined = left and name in LOCKS and left[0].key == f"{place}.{LOCKS[name]}"
            yield (field, left.pop(0)) if joined else (field,)

    def groups(self) -> Iterator[Group]:
        """All groups, those in others too."""
        for section in self.sections:
            yield from section.every()

    def fields(self) -> Iterator[Field]:
        """All fields."""
        yield from self.first
        for group in self.groups():
            yield from group.fields


# ---- from a scene's tables to a form ---------------------------------------------------------------------------------


def form(data: Table) -> Form:
    """The form of a scene's tables, which need not be valid."""
    whole = _group("", schema(), data, data)
    names = replace(whole, label="name and title", groups=(), additions=(), page=_page("name"))
    sections = (names, *whole.groups)
    known = {field.key: field for group in whole.every() for field in group.fields}
    several = "target[0]" in {group.key for group in whole.every()}
    first = []
    for labels in FIRST:
        found = []
        for key, label in labels.items():
            if several and key.startswith("target."):
                key, label = key.replace("target", "target[0]", 1), f"{label} ({_words('target[0]')})"
            found += [replace(known[key], label=label)] if key in known else []
        first += sorted(found, key=lambda field: not field.given)[:1]
    taken = {field.key for field in first}
    return Form(tuple(first), tuple(_less(section, taken) for section in sections), whole.additions)


def _less(group: Group, taken: set[str]) -> Group:
    """A group without some fields."""
    left = tuple(field for field in group.fields if field.key not in taken)
    return replace(group, fields=left, groups=tuple(_less(inner, taken) for inner in group.groups))


def _group(key: str, node: Node, table: Table, data: Table, removable: bool = False) -> Group:
    """The group of a table at a key; of no known kind, it has only the field that tells the kind."""
    union = records_at(key, data)
    kinds = of_kinds(union, table)
    tag, nodes = tags(union[0]), kinds[0]["properties"]
    order = sorted(nodes, key=lambda name: name not in tag) if len(kinds) == 1 else [*tag]
    required = {*kinds[0].get("required", ()), *(tag if len(union) > 1 else ())}
    fields, groups, additions = [], [], []
    for name in order:
        at, value, inner = f"{key}.{name}".lstrip("."), table.get(name), nodes[name]
        may_be = records(inner)
        if not may_be:
            options = [tags(each)[name] for each in union] if name in tag else choices(inner)
            fields.append(_field(at, inner, table, options, required=name in required))
        elif most := _most(inner):
            groups.append(_list(at, inner, value, data, most=most))
        elif isinstance(value, dict):
            groups.append(_group(at, inner, value, data, removable=name not in required))
        elif at in ASKED_FOR or len(may_be) > 1 or may_be[0].get("required"):
            additions.append(Addition(at, f"Add {_words(at)}", new_table(at, data)))
        else:  # a table that is there without being written
            groups.append(_group(at, inner, {}, data))
    parts = {"fields": tuple(fields), "groups": tuple(groups), "additions": tuple(additions)}
    return Group(key, _words(key), node.get("description", ""), _page(key), **parts, removable=removable)


def _list(key: str, node: Node, value: Any, data: Table, most: int) -> Group:
    """The group of a list of tables; of one that may stand alone, such as a target, it is the table's own."""
    given = [part if isinstance(part, dict) else {} for part in (value if isinstance(value, list) else [value])]
    given = given if value else []
    behind = f"{key}[{len(given)}]"
    label = f"Add {'another ' if given else ''}{_words(key).removesuffix('s')}"
    more = (Addition(behind, label, new_table(behind, data)),) if len(given) < most else ()
    if len(given) == 1 and node.get("type") != "array":
        alone = _group(key, node, given[0], data)
        return replace(alone, additions=(*alone.additions, *more))
    groups = tuple(_group(f"{key}[{k}]", {}, part, data, removable=True) for k, part in enumerate(given))
    return Group(
        key, _words(key), node["description"], _page(key), fields=(), groups=groups, additions=more, removable=False
    )


def _most(node: Node) -> int:
    """How many tables a list may have; 0: the node is none."""
    lists = [form for form in alternatives(node) if form.get("type") == "array" and records(form)]
    return lists[0].get("maxItems", MANY) if lists else 0


def _field(key: str, node: Node, table: Table, options: list[Any], required: bool) -> Field:
    """The field of a key of a table."""
    name = key.rpartition(".")[2]
    inner = [node, *(part for form in alternatives(node) for part in (form, *form.get("prefixItems", ())))]
    inner += [form["items"] for form in alternatives(node) if isinstance(form.get("items"), dict)]
    ends = next((part for part in inner if "minimum" in part), {})
    value, control = table.get(name), _control(node, table.get(name))
    if control == "text" and any(form.get("type") == "boolean" for form in alternatives(node)):
        options = [True, False, *options]
    return Field(
        key, label=_words(key), unit=node["unit"] if node["unit"] != "none" else "",
        least=ends.get("minimum"), most=ends.get("maximum"),
        meaning=_kinds_told().get(plain(key), node["description"]),
        default=as_words(node["default"]) if "default" in node else "",
        example=as_words(node["examples"][0]) if "examples" in node else "",
        control=control, choices=tuple(map(as_words, options)) if control != "check" else (),
        value="" if value is None else as_words(value), given=value is not None, required=required, page=_page(key),
    )  # fmt: skip


def _control(node: Node, value: Any) -> Control:
    """With what a value is entered; it depends on the value where a number or a list may stand."""
    if "enum" in node or "const" in node:
        return "check" if node.get("const") is True else "choice"
    forms = {form.get("type"): form for form in alternatives(node)}
    if [*forms] in (["boolean"], ["string"]):
        return "check" if "boolean" in forms else "text"
    if "array" not in forms or ("number" in forms and not isinstance(value, list)):
        return "number"
    inner = forms["array"].get("items", {})
    if any(form.get("type") == "string" for form in alternatives(inner)):
        return "text"
    listed = any(isinstance(part, list) for part in value) if isinstance(value, list) else inner.get("type") == "array"
    if listed:
        return "lines"
    return "pair" if len(forms) == 1 and len(forms["array"].get("prefixItems", ())) == 2 else "numbers"


@functools.cache
def _kinds_told() -> Mapping[str, str]:
    """The sentences of the keys that tell a kind, with those of all kinds."""
    return {plain(row.key): row.meaning for row in rows() if row.key.rpartition(".")[2] in TAGS}


def _words(key: str) -> str:
    """The last part of a key in plain words: control points, target 2."""
    name, _, number = key.rpartition(".")[2].rstrip("]").partition("[")
    return f"{name.replace('1e2', '1/e²').replace('_', ' ')} {int(number) + 1 if number else ''}".rstrip()


def _page(key: str) -> str:
    """The place of a key in the documentation, from its first page: a table, or the keys that are in none."""
    alone = [name for name, node in schema()["properties"].items() if not records(node)]
    table = plain(key).partition(".")[0]
    return f"reference/scene-keys.html#keys-{alone[0] if table in alone else table}"


# ---- from a form to HTML ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Slider:
    """The ends and the step of a slider, as HTML has numbers."""

    least: str
    most: str
    step: str
    value: str
    middle: str = ""  # of a pair, whose width the slider has: both ends move about it


def slider(field: Field) -> Slider | None:
    """A slider from half to double the number of a field, or the width of its pair; None: it has no such number."""
    words, middle = field.value or field.default or field.example, ""
    value = number(words) if field.control == "number" else None
    if field.control == "pair":
        ends = [number(part) for part in words.replace(";", ",").split(",")]
        if len(ends) == 2 and None not in ends:
            value, middle = ends[1] - ends[0], f"{(ends[0] + ends[1]) / 2:.12g}"
    if not value or field.least is None or field.most is None:
        return None
    low, high = sorted((value / 2, 2 * value))
    low, high = max(low, field.least), min(high, field.most)
    if not low < high:
        return None
    ten = 10.0 ** math.floor(math.log10((high - low) / STEPS))
    step = next(figure * ten for figure in ROUND if figure * ten * STEPS <= high - low)
    ends = math.ceil(low / step) * step, math.floor(high / step) * step
    return Slider(*(f"{each:.12g}" for each in (*ends, step, value)), middle)


def html(form: Form, errors: Mapping[str, str], has_docs: bool = False) -> str:
    """The form as HTML, to be put into a page: no script, no style, and a sentence of `errors` beside its key.

    A control has its key as data-key and name, a slider data-key alone.  A button has data-key, and as data-value the
    JSON of what `scene_text.changed` sets there; null takes it out.  A sentence on no key of the form is at the top.
    has_docs: is the documentation there, to which sections lead?
    """
    known = [*(field.key for field in form.first), *(key for section in form.sections for key in _keys(section))]
    placed: dict[str, list[str]] = {}
    for key, sentence in errors.items():
        placed.setdefault(_nearest(key, known), []).append(sentence)
    wrong = [section for section in form.sections if _keys(section) & {*placed}]  # they are open
    template = environment().get_template("form.html.j2")
    return template.render(form=form, placed=placed, wrong=wrong, slider=slider, has_docs=has_docs)


@functools.cache
def environment() -> jinja2.Environment:
    """The templates of this folder; all text is escaped, since names and scenes are a user's."""
    import jinja2

    found = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    found.filters |= {"id": html_id, "json": functools.partial(json.dumps, default=str)}
    return found


def _keys(group: Group) -> set[str]:
    """The keys of a group's tables and fields."""
    return {key for each in group.every() for key in (each.key, *(field.key for field in each.fields)) if key}


def html_id(key: str) -> str:
    """The id of a key's control; those of what belongs to it go on behind."""
    return "key-" + re.sub(r"[^a-z0-9_]+", "-", key.lower()).strip("-")


def _nearest(key: str, known: Iterable[str]) -> str:
    """The field or the group that a sentence on a key belongs to: its own, or one that holds it; "": none."""
    alike = {other.replace("[0]", ""): other for other in known} | {other: other for other in known}
    while key:
        if found := alike.get(key) or alike.get(key.replace("[0]", "")):
            return found
        key = key.rpartition("[" if key.endswith("]") else ".")[0]
    return ""
