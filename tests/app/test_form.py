"""Every key of a scene has a field, which says what the schema says; and the form's HTML is sound."""

import contextlib
import functools
import json
import re
import subprocess
import sys
import tomllib
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from bstcad.app.form import HELP, MAIN_FIELDS, Field, SceneForm, form, html, html_id, slider
from bstcad.app.kinds import new_table, without_numbers
from bstcad.app.scene_text import changed, is_same, typed
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import _validated
from bstcad.scene.schema import rows, toml
from tests import suite

ROOT = Path(__file__).parents[2]
TEXTS = {path.stem: path.read_text(encoding="utf-8") for path in sorted((ROOT / "templates").glob("*.toml"))}
DATA = {name: tomllib.loads(text) for name, text in TEXTS.items()}
sys.path.append(str(ROOT / "docs" / "_ext"))


def steps(found: SceneForm, key: str):
    """Return the entries that a person may make in a form before a key: (key, value) for `changed`."""
    groups = [*found.additions, *(addition for group in found.groups() for addition in group.additions)]
    for addition in groups:
        if f"{key}.".startswith(f"{without_numbers(addition.key)}."):
            yield addition.key, addition.value
    for field in found.fields():
        table, _, name = field.key.rpartition(".")
        if name in ("kind", "shape") and f"{key}.".startswith(f"{without_numbers(table)}."):
            yield from ((field.key, choice) for choice in field.choices if choice != field.value)


def explains(field, row):
    """Return True if a field has the meaning of a row, or the help of a main field instead."""
    return field.meaning in (row.meaning, HELP.get(without_numbers(field.key)))


@functools.cache
def form_of(text):
    """Return the form of a text; most ways to a key begin with the same steps."""
    return form(tomllib.loads(text))


CHANGED = {}  # texts with a changed entry, by text, key and value


def with_entry(text, key, value):
    """Return the text with an entry changed."""
    if (step := (text, key, repr(value))) not in CHANGED:
        CHANGED[step] = changed(text, key, value)
    return CHANGED[step]


def ways_to(row, text, left=4):
    """Return True if some steps lead from a text to a form that has the key of a row, with its meaning."""
    found = form_of(text)
    key = row.key.replace("[]", "")
    if row.range in ("table", "tables"):
        if any(without_numbers(group.key) == key and group.meaning in (row.meaning, "") for group in found.groups()):
            return True
    elif any(without_numbers(field.key) == key and explains(field, row) for field in found.fields()):
        return True
    return left > 0 and any(ways_to(row, with_entry(text, *step), left - 1) for step in steps(found, key))


def test_every_key_can_be_reached():
    assert [row.key for row in rows() if not ways_to(row, TEXTS["disk"])] == []


@pytest.mark.parametrize("name", suite.in_turns(DATA, 5))
def test_a_field_says_what_the_schema_says_and_what_the_scene_has(name):
    told = {}
    for row in rows():
        told.setdefault(without_numbers(row.key), []).append(row)
    found = form(DATA[name])
    assert max(Counter(field.key for field in found.fields()).values()) == 1
    for field in found.fields():
        [row, *_] = [row for row in told[without_numbers(field.key)] if explains(field, row)]
        assert field.unit == row.unit.replace("none", "")
        assert field.minimum is None or row.range.startswith(f"{field.minimum:g}" if field.minimum < 1e4 else "1")
        assert field.required == (row.default == "required")
        default = "" if field.required else row.default
        assert field.default == default or toml(typed(field.key, field.default, DATA[name])) == default
        assert field.control != "choice" or " | ".join(field.choices) in row.range
        assert field.is_set == (field.value != "")
        typed_again = typed(field.key, field.value, DATA[name])
        assert field.value == "" or changed(TEXTS[name], field.key, typed_again) == TEXTS[name]


def values(table, prefix=""):
    """The keys of everything in some tables that is no table."""
    for name, value in table.items():
        key = f"{prefix}.{name}".lstrip(".")
        parts = value if isinstance(value, list) and value and isinstance(value[0], dict) else [value]
        for k, part in enumerate(parts):
            of_part = values(part, f"{key}[{k}]" if part is not value else key) if isinstance(part, dict) else [key]
            yield from of_part


@pytest.mark.parametrize("name", suite.in_turns(DATA, 5))
def test_every_value_of_a_scene_is_in_its_form(name):
    assert {field.key for field in form(DATA[name]).fields() if field.is_set} == {*values(DATA[name])}


@pytest.mark.parametrize("name", suite.in_turns(DATA, 5))
def test_what_is_added_is_there_and_goes_again(name):
    found = form(DATA[name])
    for addition in [*found.additions, *(each for group in found.groups() for each in group.additions)]:
        text = changed(TEXTS[name], addition.key, addition.value)
        new = {group.key: group for group in form(tomllib.loads(text)).groups()}
        key = addition.key if addition.key in new else addition.key.replace("[0]", "")
        assert new[key].removable
        if without_numbers(addition.key) not in ("target.profile", "source.profile"):  # replaces a picture, or a name
            left = tomllib.loads(changed(text, addition.key, None))
            one = {name: part[0] if name == "target" and len(part) == 1 else part for name, part in left.items()}
            assert is_same(left, DATA[name]) or is_same(one, DATA[name])


def test_the_first_fields_are_keys_and_follow_the_kind():
    known = {without_numbers(row.key): row for row in rows()}
    assert all(key in known and label for labels in MAIN_FIELDS for key, label in labels.items())
    labels = {name: {field.label: field for field in form(data).first} for name, data in DATA.items()}
    assert {"Width of the lens", "Height of the lens", "Wall: position from the lamp (z)"} <= labels["disk"].keys()
    assert {"Position of the wall (z)", "Quality"} <= labels["thu"].keys()
    assert labels["beam_shaper"]["Diameter of the lens"].value == "15"
    assert labels["led"]["Radius of the lens"].value == "12" and "Width of the lens" not in labels["led"]
    assert labels["beam_shaper"]["Refractive index"].key == "lens.index"
    assert labels["two_pictures"]["Position of the wall (z) (target 1)"].key == "target[0].z"
    assert labels["disk"]["Uniform light instead of a picture"].control == "check"
    assert labels["white_logo"]["Wavelength"].control == "lines"
    assert all(10 <= len(first) <= len(MAIN_FIELDS) for first in labels.values())


def test_a_field_leads_to_its_section_of_the_documentation():
    from reference_pages import scene_keys

    sections = dict(re.findall(r"^\(([\w-]+)\)=\n(.*?)(?=^\(|\Z)", scene_keys(), re.S | re.M))
    for data in DATA.values():
        for field in form(data).fields():
            page, anchor = field.page.split("#")
            keys = re.findall(r"^\| `([^`]+)`", sections[anchor], re.M)
            assert page == "reference/scene-keys.html" and without_numbers(field.key) in map(without_numbers, keys)


# ---- HTML ------------------------------------------------------------------------------------------------------------


VOID = {"input", "br", "hr", "img", "meta", "link"}
ATTRIBUTES = {
    "id", "name", "class", "for", "type", "value", "checked", "selected", "inputmode", "autocomplete", "spellcheck",
    "rows", "placeholder", "min", "max", "step", "role", "href", "open", "data-key", "data-value", "data-section",
    "aria-label", "aria-pressed", "aria-hidden", "title", "data-locks", "viewbox", "d", "data-middle",
    "aria-describedby", "aria-invalid", "aria-required",
}  # fmt: skip


class Sound(HTMLParser):
    """The elements of a piece of HTML, each of which is closed where it may be."""

    def __init__(self, text):
        super().__init__()
        self.open, self.found, self.words = [], [], Counter()
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        names = [name for name, _ in attrs]
        assert len(names) == len(set(names)) and set(names) <= ATTRIBUTES, names
        assert tag not in ("script", "style")
        assert self.open[-1:] not in (["p"], ["option"], ["summary"]) or tag in ("a", "button"), (self.open, tag)
        self.found.append((tag, dict(attrs), (*self.open,)))
        self.open += [tag] * (tag not in VOID)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words[self.found[-1][1].get("id") if self.found else None] += len(data.strip())


def is_valid(text, found):
    """Assert what holds of every form's HTML; its elements."""
    valid_text = Sound(text)
    ids = Counter(attrs["id"] for _, attrs, _ in valid_text.found if "id" in attrs)
    assert max(ids.values()) == 1
    labelled = {attrs["for"] for tag, attrs, _ in valid_text.found if tag == "label"}
    controls = {}
    for tag, attrs, outside in valid_text.found:
        if tag in ("input", "select", "textarea"):
            assert attrs.get("id") in labelled or attrs["aria-label"]
            assert "name" not in attrs or attrs["name"] == attrs["data-key"]
            for other in attrs.get("aria-describedby", "").split():
                assert other in ids and (other.endswith("-error") or valid_text.words[other])
            controls[attrs["data-key"]] = attrs
        if tag == "button":
            locks = attrs.get("data-locks", "").split()
            assert attrs["type"] == "button" and (len(locks) == 2 or (attrs["data-key"] and attrs["data-value"]))
        assert tag != "legend" or outside[-1] == "fieldset"
    assert controls.keys() == {field.key for field in found.fields()}
    assert labelled == {html_id(key) for key in controls}
    return valid_text.found


@pytest.mark.parametrize("name", suite.in_turns(DATA, 5))
def test_the_html_is_sound(name):
    found = form(DATA[name])
    elements = is_valid(html(found, {}), found)
    assert not [attrs for _, attrs, _ in elements if "aria-invalid" in attrs or attrs.get("role") == "alert"]
    pressed = [attrs for tag, attrs, _ in elements if tag == "button"]
    buttons = {attrs["data-key"]: json.loads(attrs["data-value"]) for attrs in pressed if "data-key" in attrs}
    locks = {key for attrs in pressed for key in attrs.get("data-locks", "").split()}
    keys = {field.key for field in found.first}
    both = [key for key in keys if key.endswith((".x", ".y")) or {"lens.outline.width", "lens.outline.height"} <= keys]
    assert locks == {key for key in both if key.rpartition(".")[2] in ("x", "y", "width", "height")}
    assert all(value is None or isinstance(value, dict) for value in buttons.values())
    by_key = {attrs["name"]: (tag, attrs) for tag, attrs, _ in elements if "name" in attrs}
    for field in found.fields():
        tag, attrs = by_key[field.key]
        assert {"choice": "select", "lines": "textarea"}.get(field.control, "input") == tag
        assert field.control != "number" or (attrs["inputmode"], attrs["value"]) == ("decimal", field.value)
        assert field.control != "check" or ("checked" in attrs) == ((field.value or field.default) == "true")
    sliders = [attrs for _, attrs, _ in elements if attrs.get("type") == "range"]
    spans = [field.key for field in found.first if field.control in ("number", "pair")]
    assert [attrs["data-key"] for attrs in sliders] == spans and len(spans) >= 3


def test_a_sentence_stands_at_its_key_or_at_the_top():
    found = form(DATA["two_pictures"])
    errors = {
        "target[0].z": "first: <b>", "target[1].x[0]": "second", "lens.outline": "table", "lens.front.nothing": "front",
        "zzz": "unknown & new", "effects[0].kind": "list", "target": "all",
    }  # fmt: skip
    text = html(found, errors)
    elements = is_valid(text, found)
    alerts = [attrs.get("id") for _, attrs, _ in elements if attrs.get("role") == "alert"]
    assert sorted(map(str, alerts)) == sorted([
        "None", "key-target-0-z-error", "key-target-1-x-error", "key-lens-table-error",
        "key-lens-front-table-error", "key-effects-table-error", "key-target-table-error",
    ])  # fmt: skip
    assert "first: &lt;b&gt;" in text and "unknown &amp; new" in text
    invalid = {attrs["data-key"]: attrs["aria-describedby"] for _, attrs, _ in elements if "aria-invalid" in attrs}
    assert invalid == {key: f"{html_id(key)}-help {html_id(key)}-error" for key in ("target[0].z", "target[1].x")}
    opened = {attrs["data-section"] for tag, attrs, _ in elements if tag == "details" and "open" in attrs}
    assert opened == {"target", "lens", "effects"}
    is_valid(html(form(DATA["disk"]), {"target[0].z": "one"}), form(DATA["disk"]))
    assert "key-target-z-error" in html(form(DATA["disk"]), {"target[0].z": "one"})


@given(st.floats(1e-3, 1e6) | st.floats(-1e6, -1e-3), st.floats(-1e8, 0.0), st.floats(0.0, 1e8))
def test_a_slider_goes_from_half_to_double_within_the_range(value, minimum, maximum):
    field = Field(
        "target.z", "z", unit="mm", minimum=minimum, maximum=maximum, meaning="", default="", example="",
        control="number", choices=(), value=repr(value), is_set=True, required=True, page="",
    )  # fmt: skip
    if (found := slider(field)) is None:
        assert not minimum < value < maximum or maximum < value / 2 or abs(value) * 1e-9 > maximum - minimum
        return
    low, high, step = (float(each) for each in (found.minimum, found.maximum, found.step))
    near = 1e-9 * abs(value)
    assert min(value / 2, 2 * value) - near <= low < high <= max(value / 2, 2 * value) + near
    assert minimum - near <= low and high <= maximum + near
    assert 50 <= (high - low) / step <= 260 and float(found.value) == pytest.approx(value, rel=1e-9)


ODD = st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats() | st.text(max_size=5) | st.dates()
ODD = ODD | st.lists(ODD, max_size=3) | st.dictionaries(st.sampled_from(["kind", "shape", "z", "x"]), ODD, max_size=3)
ODD = ODD | st.lists(st.dictionaries(st.sampled_from(["kind", "z", "profile"]), ODD, max_size=2), max_size=3)


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_a_wrong_scene_has_a_form_too(draw):
    """Anything may stand anywhere: a person is in the middle of typing."""
    data = tomllib.loads(TEXTS[draw.draw(st.sampled_from(sorted(TEXTS)))])
    for _ in range(draw.draw(st.integers(1, 4))):
        table = data
        for _ in range(draw.draw(st.integers(0, 2))):
            inner = [part for part in table.values() if isinstance(part, dict)]
            table = draw.draw(st.sampled_from(inner)) if inner else table
        name = draw.draw(st.sampled_from([*table, "kind", "profile", "target", "effects", "new"]))
        table[name] = draw.draw(ODD)
    found, text = form(data), tomli_w.dumps(data)
    is_valid(html(found, {"lens": "wrong"}), found)
    field = draw.draw(st.sampled_from([*found.fields()]))
    additions = [*found.additions, *(addition for group in found.groups() for addition in group.additions)]
    done = [(each.key, each.value) for each in additions] + [(field.key, choice) for choice in field.choices]
    for key, value in [*done, (field.key, None), *((group.key, None) for group in found.groups() if group.removable)]:
        with contextlib.suppress(SceneError):
            assert tomllib.loads(changed(text, key, value))


def test_no_scene_at_all_can_be_begun():
    assert [field.label for field in form({}).first] == ["Quality"]
    text = ""
    while additions := [each for each in form(tomllib.loads(text)).additions if each.key in ("source", "lens")]:
        text = changed(text, additions[0].key, additions[0].value)
    text = changed(changed(text, "target", new_table("target", {})), "lens.material", "PMMA")
    _validated(tomllib.loads(changed(text, "name", "new")), ROOT)


def test_a_form_loads_no_torch():
    code = "import sys, bstcad.app.scene_text\nfrom bstcad.app.form import form, html\nhtml(form({}), {})\n"
    code += "print([m for m in ('torch', 'numpy', 'scipy') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
