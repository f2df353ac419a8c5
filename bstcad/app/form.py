"""The form of a scene, as records and as HTML: a field for each key that the schema allows in its tables.

For a table that the scene lacks, such as a wavefront or a second target, there is an addition: a button that adds it.
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

from bstcad.app.kinds import (
    alternatives,
    choices,
    matching_records,
    new_table,
    records_at,
    required_keys,
    value_at,
    without_numbers,
)
from bstcad.app.words import as_words, number
from bstcad.scene.schema import TAGS, Node, records, rows, schema, tags

if TYPE_CHECKING:
    import jinja2

# Labels, by key, of the main fields.  Each entry gives one field: for its key that is set, or else for its first key.
MAIN_FIELDS: tuple[Mapping[str, str], ...] = (
    {
        "target.image": "Picture: image file", "target.text": "Picture: letters", "target.sample": "Picture: sample",
        "target.uniform": "Uniform light instead of a picture", "target.profile.shape": "Shape of the light spot",
    },
    {"target.z": "Position of the wall (z)"},
    {"target.x": "Picture on the wall: horizontal range (x)"},
    {"target.y": "Picture on the wall: vertical range (y)"},
    {"lens.outline.shape": "Outline of the lens"},
    {
        "lens.outline.width": "Width of the lens", "lens.outline.diameter": "Diameter of the lens",
        "lens.outline.radius": "Radius of the lens",
    },
    {"lens.outline.height": "Height of the lens"},
    {"lens.back.z": "Position of the back face at its centre (z)", "lens.back.radius": "Radius of the dome"},
    {"lens.back.half_angle": "Half angle of the dome"},
    {"lens.material": "Material", "lens.index": "Refractive index"},
    {"source.kind": "Light source"},
    {"source.wavelength": "Wavelength"},
    {"target.seen_from": "Place of the viewer"},
    {"target.rotate": "Rotation of the picture"},
    {"target.fit": "Fit of a picture with other proportions"},
    {"target.gamma": "Gamma of the picture"},
    {"tailoring.quality": "Quality"},
)  # fmt: skip
# Labels of two keys z, which are distances if the front face or the lamp is at z = 0.
FROM_FRONT = {"lens.back.z": "Thickness at the centre", "target.z": "Distance of the wall from the front face"}
FROM_LAMP = {"lens.back.z": "Back face: position from the lamp (z)", "target.z": "Wall: position from the lamp (z)"}
HELP = {  # help of main fields, instead of the description of the key
    "target.z": "The front is the face that the light enters; the drawing shows the distance from the back.",
    "target.x": "-30, 30 is a picture 60 mm wide, centred on the axis of the lens.",
    "target.y": "-20, 20 is a picture 40 mm high, centred on the axis of the lens.",
    "lens.outline.width": "Size from left to right.",
    "lens.outline.height": "Size from bottom to top.",
    "lens.back.z": "Value before the relief is computed; the face is moved if the smallest thickness requires it.",
    "lens.material": "PMMA is acrylic, PC is polycarbonate; glasses have their catalogue names, such as N-BK7.",
    "source.kind": "collimated: parallel light, such as the sun or a laser beam. point: a lamp or an LED.",
    "source.wavelength": "Colour; for sunlight or white light, leave it unchanged. Several: [[nm, weight], …].",
    "target.seen_from": "lens: beside the lens, in front of the wall. behind: behind a translucent wall.",
    "target.fit": "crop: cut off its edges. pad: add dark borders. stretch: change its proportions.",
    "target.gamma": "Leave it empty for a photo or a drawing; 1 if the numbers of the file are irradiance.",
    "tailoring.quality": "draft is fast, fine is accurate; paper is the procedure of Wang et al. 2023.",
}
SECTIONS = {  # labels, by key, of sections whose key would be unclear as a title
    "source": "light source", "before": "optics before the lens", "behind": "optics behind the lens",
    "accept": "limits of the checks", "output": "files and their accuracy", "part": "title block of the part",
    "tailoring": "computation of the lens (for experts)",
}  # fmt: skip
ADDITIONS = {  # labels of buttons that add a table, by key
    "source.profile": "Use a measured beam (picture or table)",
    "before": "Add a window or mirror before the lens", "behind": "Add a window or mirror behind the lens",
    "wavefront": "Add a required wavefront", "mount": "Add a mount (rim, flange, holes)",
    "effects": "Add an effect (losses, ghosts)", "tolerance": "Add a tolerance",
    "accept.point": "Add a test point", "accept.cut_off": "Limit the sharpness of a cut-off",
}  # fmt: skip
LOCKED_SIDES = {"x": "y", "y": "x", "width": "height", "height": "width"}  # side: the other side, which a lock changes
OPTIONAL_TABLES = ("mount",)  # tables that a button adds, though no key in them is required; others are always shown
MAX_TABLES = 1000  # largest number of tables in a list, if the schema states no number
MIN_STEPS = 100  # smallest number of steps of a slider
STEP_DIGITS = (5, 2, 1)  # possible first digits of a slider's step; its other digits are 0

Control = Literal["number", "pair", "numbers", "choice", "check", "text", "lines"]
Table = Mapping[str, Any]


# ---- records ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Field:
    """Field of a key; values are texts as a person types them (words.as_words)."""

    key: str  # dotted key; tables of a list have numbers: target[1].z
    label: str
    unit: str  # unit of the value; "" without a unit
    minimum: float | None  # smallest value; None without a limit
    maximum: float | None  # largest value; None without a limit
    meaning: str  # meaning of the key, a sentence
    default: str  # default value; "" without a default
    example: str
    control: Control
    choices: tuple[str, ...]  # possible values of a choice, or of each item of a text
    value: str  # value in the scene; "" if the key is not set
    is_set: bool
    required: bool
    page: str  # address in the documentation, relative to its first page


@dataclass(frozen=True)
class Addition:
    """Table that a button adds: its key, the button's label, and its keys and values (for scene_text.changed)."""

    key: str
    label: str
    value: Mapping[str, Any]


@dataclass(frozen=True)
class Group:
    """Fields of a table or of a list of tables; or the fields of a scene that are not in a table."""

    key: str  # dotted key of the table; "" for name and title
    label: str
    meaning: str
    page: str
    fields: tuple[Field, ...]
    groups: tuple[Group, ...]  # inner tables
    additions: tuple[Addition, ...]
    removable: bool  # True if a button may remove the table

    def walk(self) -> Iterator[Group]:
        """Iterate over this group and all inner groups."""
        yield self
        for group in self.groups:
            yield from group.walk()


@dataclass(frozen=True)
class SceneForm:
    """All fields of a scene."""

    first: tuple[Field, ...]  # the main fields, which the sections do not repeat
    sections: tuple[Group, ...]  # all other fields, in the order of the schema
    additions: tuple[Addition, ...]  # sections that may be added

    def in_rows(self) -> Iterator[tuple[Field, ...]]:
        """Iterate over the rows of the main fields: single fields, or two sides that a lock can join."""
        left = [*self.first]
        while left:
            field = left.pop(0)
            table, _, name = field.key.rpartition(".")
            joined = left and name in LOCKED_SIDES and left[0].key == f"{table}.{LOCKED_SIDES[name]}"
            yield (field, left.pop(0)) if joined else (field,)

    def groups(self) -> Iterator[Group]:
        """Iterate over all groups, inner ones included."""
        for section in self.sections:
            yield from section.walk()

    def fields(self) -> Iterator[Field]:
        """Iterate over all fields."""
        yield from self.first
        for group in self.groups():
            yield from group.fields


# ---- from a scene's tables to a form ---------------------------------------------------------------------------------


def form(data: Table) -> SceneForm:
    """Return the form of a scene's tables, which need not be valid."""
    whole = _group("", schema(), data, data)
    names = replace(whole, label="name and title", groups=(), additions=(), page=_docs_page("name"))
    sections = (names, *(replace(group, label=SECTIONS.get(group.key, group.label)) for group in whole.groups))
    known = {field.key: field for group in whole.walk() for field in group.fields}
    several = "target[0]" in {group.key for group in whole.walk()}
    lamp = value_at("source.position", data) if value_at("source.kind", data) == "point" else []
    is_lamp_at_zero = lamp is None or (isinstance(lamp, list) and lamp[2:] == [0])
    distances = FROM_FRONT if value_at("lens.front.z", data) == 0 else FROM_LAMP if is_lamp_at_zero else {}
    first = []
    for labels in MAIN_FIELDS:
        found = []
        for key, label in labels.items():
            if several and key.startswith("target."):
                key, label = key.replace("target", "target[0]", 1), f"{label} ({_label('target[0]')})"
            else:
                label = distances.get(key, label)
            if key in known:
                meaning = HELP.get(without_numbers(key), known[key].meaning)
                found.append(replace(known[key], label=label, meaning=meaning))
        first += sorted(found, key=lambda field: not field.is_set)[:1]
    taken = {field.key for field in first}
    return SceneForm(tuple(first), tuple(_without(section, taken) for section in sections), whole.additions)


def _without(group: Group, taken: set[str]) -> Group:
    """Return a group without the fields with the keys `taken`, and without inner groups that are then empty."""
    left = tuple(field for field in group.fields if field.key not in taken)
    inner = (_without(each, taken) for each in group.groups)
    groups = tuple(each for each in inner if each.fields or each.groups or each.additions or each.removable)
    return replace(group, fields=left, groups=groups)


def _group(key: str, node: Node, table: Table, data: Table, removable: bool = False) -> Group:
    """Return the group of `table`, at `key` in `data`; a table without a known kind has only the field of the kind."""
    union = records_at(key, data)
    kinds = matching_records(union, table)
    tag, nodes = tags(union[0]), kinds[0]["properties"]
    order = sorted(nodes, key=lambda name: name not in tag) if len(kinds) == 1 else [*tag]
    has_default = any("default" in record["properties"][name] for record in union for name in tag)
    required = {*required_keys(kinds[0], table), *(tag if len(union) > 1 and not has_default else ())}
    fields, groups, additions = [], [], []
    for name in order:
        at, value, inner = f"{key}.{name}".lstrip("."), table.get(name), nodes[name]
        may_be = records(inner)
        named = choices(inner) if may_be and not isinstance(value, dict) else ()  # names in place of a table
        if not may_be or named:
            options = [tags(each)[name] for each in union] if name in tag else choices(inner)
            fields.append(_field(at, inner, table, options, required=name in required))
            additions += [Addition(at, ADDITIONS[at], new_table(at, data))] if named and at in ADDITIONS else []
        elif maximum := _max_tables(inner):
            groups.append(_list(at, inner, value, data, maximum=maximum))
        elif isinstance(value, dict):
            groups.append(_group(at, inner, value, data, removable=name not in required))
        elif at == "lens.outline" and value_at("lens.back.kind", data) == "radial":
            continue  # a dome ends at its half angle
        elif at in OPTIONAL_TABLES or len(may_be) > 1 or may_be[0].get("required"):
            additions.append(Addition(at, ADDITIONS.get(at, f"Add {_label(at)}"), new_table(at, data)))
        else:  # a table that exists by default
            groups.append(_group(at, inner, {}, data))
    parts = {"fields": tuple(fields), "groups": tuple(groups), "additions": tuple(additions)}
    return Group(key, _label(key), node.get("description", ""), _docs_page(key), **parts, removable=removable)


def _list(key: str, node: Node, value: Any, data: Table, maximum: int) -> Group:
    """Return the group of a list of tables, `value`, or of a single table that need not be in a list, as a target."""
    tables = [part if isinstance(part, dict) else {} for part in (value if isinstance(value, list) else [value])]
    tables = tables if value else []
    behind = f"{key}[{len(tables)}]"
    label = f"Add {'another ' if tables else ''}{_label(key).removesuffix('s')}"
    label = label if tables else ADDITIONS.get(key, label)
    more = (Addition(behind, label, new_table(behind, data)),) if len(tables) < maximum else ()
    if len(tables) == 1 and node.get("type") != "array":
        alone = _group(key, node, tables[0], data)
        return replace(alone, additions=(*alone.additions, *more))
    groups = tuple(_group(f"{key}[{k}]", {}, part, data, removable=True) for k, part in enumerate(tables))
    page, meaning = _docs_page(key), node["description"]
    return Group(key, _label(key), meaning, page, fields=(), groups=groups, additions=more, removable=False)


def _max_tables(node: Node) -> int:
    """Return the largest number of tables that a list may have; 0 if the node is not a list of tables."""
    lists = [form for form in alternatives(node) if form.get("type") == "array" and records(form)]
    return lists[0].get("maxItems", MAX_TABLES) if lists else 0


def _field(key: str, node: Node, table: Table, options: list[Any], required: bool) -> Field:
    name = key.rpartition(".")[2]
    inner = [node, *(part for form in alternatives(node) for part in (form, *form.get("prefixItems", ())))]
    inner += [form["items"] for form in alternatives(node) if isinstance(form.get("items"), dict)]
    ends = next((part for part in inner if "minimum" in part), {})
    value, control = table.get(name), _control(node, table.get(name))
    if control == "text" and any(form.get("type") == "boolean" for form in alternatives(node)):
        options = [True, False, *options]
    return Field(
        key, label=_label(key), unit=node["unit"] if node["unit"] != "none" else "",
        minimum=ends.get("minimum"), maximum=ends.get("maximum"),
        meaning=_kind_meanings().get(without_numbers(key), node["description"]),
        default=as_words(node["default"]) if "default" in node else "",
        example=as_words(node["examples"][0]) if "examples" in node else "",
        control=control, choices=tuple(map(as_words, options)) if control != "check" else (),
        value="" if value is None else as_words(value), is_set=value is not None, required=required,
        page=_docs_page(key),
    )  # fmt: skip


def _control(node: Node, value: Any) -> Control:
    """Return the control that edits a value; it depends on the value if the key allows a number or a list."""
    if "enum" in node or "const" in node or (records(node) and choices(node)):
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
def _kind_meanings() -> Mapping[str, str]:
    """Return the descriptions, by key, of the keys that state a kind, with the meanings of all kinds."""
    return {without_numbers(row.key): row.meaning for row in rows() if row.key.rpartition(".")[2] in TAGS}


def _label(key: str) -> str:
    """Return the last part of a key as words: control points, target 2."""
    name, _, number = key.rpartition(".")[2].rstrip("]").partition("[")
    return f"{name.replace('1e2', '1/e²').replace('_', ' ')} {int(number) + 1 if number else ''}".rstrip()


def _docs_page(key: str) -> str:
    """Return the address of the section on a key's table, relative to the first page of the documentation."""
    alone = [name for name, node in schema()["properties"].items() if not records(node)]
    table = without_numbers(key).partition(".")[0]
    return f"reference/scene-keys.html#keys-{alone[0] if table in alone else table}"


# ---- from a form to HTML ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Slider:
    """Range and step of a slider, as HTML writes numbers."""

    minimum: str
    maximum: str
    step: str
    value: str
    middle: str = ""  # centre of a pair, whose width the slider sets; "" for a number


def slider(field: Field) -> Slider | None:
    """Return a slider from half to twice a field's number or the width of its pair; None without number or limits."""
    words, middle = field.value or field.default or field.example, ""
    value = number(words) if field.control == "number" else None
    if field.control == "pair":
        ends = [number(part) for part in words.replace(";", ",").split(",")]
        if len(ends) == 2 and None not in ends:
            value, middle = ends[1] - ends[0], f"{(ends[0] + ends[1]) / 2:.12g}"
    if not value or field.minimum is None or field.maximum is None:
        return None
    low, high = sorted((value / 2, 2 * value))
    low, high = max(low, field.minimum), min(high, field.maximum)
    if not low < high:
        return None
    ten = 10.0 ** math.floor(math.log10((high - low) / MIN_STEPS))
    step = next(figure * ten for figure in STEP_DIGITS if figure * ten * MIN_STEPS <= high - low)
    ends = math.ceil(low / step) * step, math.floor(high / step) * step
    return Slider(*(f"{each:.12g}" for each in (*ends, step, value)), middle)


def html(form: SceneForm, errors: Mapping[str, str], has_docs: bool = False) -> str:
    """Return the form as HTML for a page, without script and style.

    A control has its key as data-key and name, a slider as data-key only.  A button has data-key, and in data-value the
    JSON of the value that `scene_text.changed` sets; null removes the table.
    errors: sentences by key, each shown at the key's control, or else at its table, or else at the top.
    has_docs: True if the documentation is available, to which the sections link.
    """
    known = [*(field.key for field in form.first), *(key for section in form.sections for key in _keys(section))]
    placed: dict[str, list[str]] = {}
    for key, sentence in errors.items():
        placed.setdefault(_owner(key, known), []).append(sentence)
    wrong = [section for section in form.sections if _keys(section) & {*placed}]  # shown open
    template = environment().get_template("form.html.j2")
    return template.render(form=form, placed=placed, wrong=wrong, slider=slider, has_docs=has_docs)


@functools.cache
def environment() -> jinja2.Environment:
    """Return the Jinja environment of this folder; all text is escaped, since names and scenes come from users."""
    import jinja2

    loader, undefined = jinja2.FileSystemLoader(Path(__file__).parent), jinja2.StrictUndefined
    found = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=undefined
    )
    found.filters |= {"id": html_id, "json": functools.partial(json.dumps, default=str)}
    return found


def _keys(group: Group) -> set[str]:
    return {key for each in group.walk() for key in (each.key, *(field.key for field in each.fields)) if key}


def html_id(key: str) -> str:
    """Return the id of a key's control; ids of related elements have a suffix."""
    return "key-" + re.sub(r"[^a-z0-9_]+", "-", key.lower()).strip("-")


def _owner(key: str, known: Iterable[str]) -> str:
    """Return the one of the `known` keys at whose field or group a sentence on `key` is shown; "": at the top."""
    alike = {other.replace("[0]", ""): other for other in known} | {other: other for other in known}
    while key:
        if found := alike.get(key) or alike.get(key.replace("[0]", "")):
            return found
        key = key.rpartition("[" if key.endswith("]") else ".")[0]
    return ""
