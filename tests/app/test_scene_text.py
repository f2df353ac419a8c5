"""A text is changed as its tables are, and nothing else in it; what is typed is a value, and the other way round."""

import copy
import json
import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bstcad.app.kinds import new_table, node_at, records_at, table_at
from bstcad.app.scene_text import as_words, changed, is_same, pieces, typed
from bstcad.app.words import number
from bstcad.scene.dotted_keys import override
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import _validated
from bstcad.scene.schema import TAGS, records, rows, tags
from tests import suite

FOLDER = Path(__file__).parents[2] / "templates"
NAMES = (  # templates with tables of each kind
    "beam_shaper", "disk", "flange", "led", "mirror", "portrait", "sun_caustic", "thu", "two_pictures", "white_logo",
)  # fmt: skip
TEXTS = {name: (FOLDER / f"{name}.toml").read_text(encoding="utf-8") for name in NAMES}
UNIONS = (
    "source", "source.aperture", "lens.outline", "lens.front", "target.outline", "target.profile", "wavefront",
    "mount.rim", "mount.flange.outline", "effects[0]",
)  # fmt: skip


def keys_for(data):
    """Every key of the schema as it may be set in these tables, with its example."""
    several = isinstance(data["target"], list)
    for row in rows():
        key = row.key.replace("[]", "[0]")
        key = key.replace("target", "target[1]", 1) if several and key.startswith("target") else key
        if key.rpartition(".")[2] not in TAGS and key != "target":
            yield key, row.example


def overridden(data, key, value):
    """Return the text that `changed` has to make: `override`, but lists of tables are lists, and no list is empty."""
    wanted = copy.deepcopy(data)
    override(wanted, key, value, key)
    for name in ("before", "behind", "effects", "tolerance"):
        if isinstance(wanted.get(name), dict):
            wanted[name] = [wanted[name]]
    return {name: part for name, part in wanted.items() if part != []}


def comments(text):
    """All comments of a text: no value of these texts has a number sign."""
    return [line.partition("#")[2].strip() for line in text.splitlines() if "#" in line]


def leaves(table, prefix=""):
    """(key, value) of everything in some tables that is no table."""
    for name, value in table.items():
        key = f"{prefix}.{name}".lstrip(".")
        listed = isinstance(value, list) and value and isinstance(value[0], dict)
        if not listed and not isinstance(value, dict):
            yield key, value
        for k, part in enumerate(value if listed else [value]):
            yield from leaves(part, f"{key}[{k}]" if listed else key) if isinstance(part, dict) else ()


# ---- laws ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["beam_shaper", "flange", "led", "two_pictures"])  # with most kinds of tables
def test_a_text_is_changed_as_its_tables_are(name):
    text, count = TEXTS[name], 0
    assert "".join(piece.text for piece in pieces(text)) == text
    for key, example in keys_for(data := tomllib.loads(text)):
        for value in (example, None) if example is not None else ("word", None):
            try:
                wanted = overridden(data, key, value)
            except SceneError as error:
                with pytest.raises(SceneError, match=re.escape(str(error))):
                    changed(text, key, value)
                continue
            found = changed(text, key, value)
            assert is_same(tomllib.loads(found), wanted), (key, value)
            assert (found == text) == is_same(wanted, data), (key, value)
            kept = comments(found)
            assert value is None or key not in dict(leaves(data)) or all(each in kept for each in comments(text)), key
            count += 1
    assert count > 250


@pytest.mark.parametrize("name", suite.in_turns(TEXTS, 5))
def test_the_same_value_changes_nothing_and_another_its_line_alone(name):
    text = TEXTS[name]
    for key, value in leaves(tomllib.loads(text)):
        assert changed(text, key, value) == text
        if isinstance(value, float):
            back = changed(changed(text, key, value + 1000.5), key, value)
            assert back.replace("1e-06", "1e-6").split() == text.split()
            other = changed(text, key, value + 1.0).splitlines()
            assert sum(a != b for a, b in zip(other, text.splitlines(), strict=True)) == 1


@pytest.mark.parametrize("name", suite.in_turns(TEXTS, 5))
def test_what_goes_takes_its_own_comments_alone(name):
    text = TEXTS[name]
    for piece in (whole := pieces(text)):
        if piece.role != "key":
            continue
        key = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in piece.path).lstrip(".")
        left, own = comments(changed(text, key, None)), comments(piece.text)
        first = whole.index(piece) + 1
        below = next((k for k in range(first, len(whole)) if whole[k].role != "comment"), len(whole))
        below = [part.text.strip("# \n") for part in whole[first:below] if part.column and part.column == piece.column]
        assert sorted(left + own + below) == sorted(comments(text)), key


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(sorted(TEXTS)), st.data())
def test_changes_one_after_another_keep_the_law(name, draw):
    text = TEXTS[name] if draw.draw(st.booleans()) else TEXTS[name].replace("\n", "\r\n").rstrip()
    for _ in range(6):
        data = tomllib.loads(text)
        options = [key for key, _ in keys_for(data)] + [
            f"{each}[{k}]" for each in ("target", "effects") for k in range(3)
        ]
        key = draw.draw(st.sampled_from(options))
        value = draw.draw(st.none() | st.floats(-1e9, 1e9) | st.text(max_size=8) | st.just({"a": 1, "b": {"c": 'é"'}}))
        try:
            wanted = overridden(data, key, value)
        except SceneError:
            continue
        if not isinstance(wanted.get("target"), dict | list):
            continue
        text = changed(text, key, value)
        assert is_same(tomllib.loads(text), wanted), key
        assert "\r\n" not in text or text.count("\r\n") == text.count("\n")


# ---- where things are put --------------------------------------------------------------------------------------------


PLACED = [
    ("disk", "lens.min_thickness", 1.0, "65 x 65 heights\nmin_thickness = 1.0\n\n[target]"),
    ("disk", "target.seen_from", "lens", 'uniform irradiance …\nseen_from = "lens"\noutline = '),
    ("disk", "target.outline.radius", 12.25, '\noutline = { shape = "circle", radius = 12.25 }  # … inside'),
    ("disk", "lens.index", 1.5, "[lens]\nindex = 1.5\noutline = "),
    ("thu", "target.image", "a.jpg", 'right for a wall\nimage = "a.jpg"\n\n[tailoring]'),
    ("thu", "output.export", ["dxf"], 'optimised surface\n\n[output]\nexport = ["dxf"]\n\n# [part]'),
    ("disk", "wavefront.kind", "plane", 'no light outside\n\n[wavefront]\nkind = "plane"\nz = 500.0\n\n[tailoring]'),
    ("flange", "mount.flange.draft", 2.0, "adds others\ndraft = 2.0                     # degrees; draft angle"),
    ("flange", "mount.flange.holes", [[1.0, 2.0, 3.0]], "adds others\nholes = [[1.0, 2.0, 3.0]]\ndraft"),
    ("led", "effects[1]", {"kind": "ghost"}, 'of incidence\n\n[[effects]]\nkind = "ghost"\n\n[accept]'),
    ("disk", "effects[0].kind", "ghost", 'smaller error\n\n[[effects]]\nkind = "ghost"\n\n[accept]'),
    ("disk", "mount.flange", {"outline": {"shape": "circle"}, "z": 1.0},
     'irradiance\n\n[mount]\n\n[mount.flange]\noutline = { shape = "circle" }\nz = 1.0\n'),
    ("mirror", "effects", [{"kind": "ghost"}, {}], 'error\n\n[[effects]]\nkind = "ghost"\n\n[[effects]]\n\n[accept]'),
]  # fmt: skip


@pytest.mark.parametrize(("name", "key", "value", "written"), PLACED)
def test_a_change_stands_where_a_person_would_put_it(name, key, value, written):
    assert written in changed(TEXTS[name], key, value)


def test_one_target_is_two_and_one_again():
    two = changed(TEXTS["disk"], "target[1]", {"z": 700.0, "text": "HI"})
    assert two.replace('\n\n[[target]]\nz = 700.0\ntext = "HI"', "").replace("[[target]]", "[target]") == TEXTS["disk"]
    assert changed(two, "target[1]", None).replace("[[", "[").replace("]]", "]") == TEXTS["disk"]
    assert tomllib.loads(changed(two, "target[0]", None))["target"] == [{"z": 700.0, "text": "HI"}]
    three = changed(two, "target[2]", {"z": 9.0})
    assert [part["z"] for part in tomllib.loads(changed(three, "target[1].z", 8.0))["target"]] == [500.0, 8.0, 9.0]
    with pytest.raises(SceneError, match=r"target.z: there are 2 \[\[target\]\] tables"):
        changed(two, "target.z", 1.0)


def test_a_page_sends_whole_numbers_for_decimal_ones():
    assert "\nz = 740.0                       # the screen" in changed(TEXTS["disk"], "target.z", 740)
    assert "\npixels = 64 " in changed(TEXTS["disk"], "target.pixels", 64)
    for key in ("target[1]", "mount.flange", "wavefront"):
        table = new_table(key, tomllib.loads(TEXTS["disk"]))
        sent = json.loads(re.sub(r"\.0\b", "", json.dumps(table)))
        assert changed(TEXTS["disk"], key, sent) == changed(TEXTS["disk"], key, table)


STRANGE = '''lens.back.z = 20.0 # dotted
lens . "back" . kind = "bspline"
source = { kind = "point", "wavelength"=[
  [486.1, 1.0], # blue
  [656.3, 1.0], # red
]} # in braces
effects = [{kind = "fresnel"}, {kind="ghost"}]
title = """
# no comment
[no header]
"""

  [ mount ] # spaced
  draft	= 1.0
[ mount.flange ]
z = 15.5
[mount.rim] # last
shape = "circle"'''


@pytest.mark.parametrize(("key", "value", "line"), [
    ("lens.back.z", 21.0, "lens.back.z = 21.0 # dotted"),
    ("lens.index", 1.5, "lens.index = 1.5"),
    ("source.wavelength", [[500.0, 1.0], [656.3, 1.0]], "  [500.0, 1.0], # blue"),
    ("effects[1].kind", "absorption", 'effects = [{kind = "fresnel"}, {kind="absorption"}]'),
    ("mount.draft", 2.0, "  draft	= 2.0"),
    ("mount.rim.diameter", 3.0, "diameter = 3.0"),
    ("mount.datum", "front", 'datum = "front"'),
    ("title", "y", 'title = "y"'),
    ("target", {"z": 5.0}, "[target]"),
    ("wave.a", 5.0, "[wave]"),
])  # fmt: skip
def test_texts_that_are_written_otherwise(key, value, line):
    wanted = overridden(tomllib.loads(STRANGE), key, value)
    for text in (STRANGE, STRANGE.replace("\n", "\r\n")):
        found = changed(text, key, value)
        assert tomllib.loads(found) == wanted and line in found.splitlines()
        assert found.count("\r\n") in (0, found.count("\n"))


def test_an_empty_text_becomes_one_and_a_broken_one_is_told():
    text = changed(changed(changed("", "target.z", 5.0), "source.kind", "point"), "name", "lens")
    assert text == 'name = "lens"\n\n[source]\nkind = "point"\n\n[target]\nz = 5.0\n'
    for wrong in ("a = = 1", "[" * 5000, "a = 1\na = 2"):
        with pytest.raises(SceneError, match="the text: not valid TOML: .*; correct that line"):
            changed(wrong, "name", "x")


# ---- kinds -----------------------------------------------------------------------------------------------------------


def in_it(place, data):
    """The place as it is called in these tables."""
    return place.replace("target", "target[0]", 1) if isinstance(data["target"], list) else place


@pytest.mark.parametrize("name", suite.in_turns(TEXTS, 5))
def test_another_kind_has_its_keys_and_those_it_needs(name):
    for place in UNIONS:
        text, data = TEXTS[name], tomllib.loads(TEXTS[name])
        place = in_it(place, data)
        if not table_at(place, data) and place not in ("source.aperture", "mount.flange.outline"):
            text = changed(text, place, new_table(place, data))
        data = tomllib.loads(text)
        old = table_at(place, data)
        for record in records_at(place, data) if old else ():
            [(tag, kind)] = tags(record).items()
            new = table_at(place, tomllib.loads(found := changed(text, f"{place}.{tag}", kind)))
            assert new[tag] == kind and new.keys() <= record["properties"].keys()
            assert {*record.get("required", ())} <= new.keys()
            assert not record.get("oneOf") or len({"radius", "diameter"} & new.keys()) == 1
            assert (found == text) == (old.get(tag) == kind)
            both = [key for key in old if key in new and key != tag]
            assert all(is_same(old[key], new[key]) for key in both)
            assert comments(found) or not comments(text)


@pytest.mark.parametrize(("name", "key", "kind", "table"), [
    ("disk", "target.outline.shape", "rectangle", {"shape": "rectangle", "width": 360.0, "height": 360.0}),
    ("white_logo", "lens.outline.shape", "circle", {"shape": "circle", "diameter": 40.0}),
    ("beam_shaper", "target[1].profile.shape", "rectangle", {"shape": "rectangle", "width": 12.0, "height": 12.0}),
    ("beam_shaper", "target[1].profile.shape", "gaussian", {"shape": "gaussian", "radius_1e2": 6.0}),
    ("portrait", "lens.front.kind", "conic", {"kind": "conic", "z": 15.0, "curvature": 0.0, "optimise": True}),
    ("disk", "lens.front.kind", "bspline", {"kind": "bspline", "z": 15.0, "optimise": True}),
    ("sun_caustic", "source.kind", "point", {"kind": "point", "position": [0.0, 0.0, -100.0], "wavelength": 587.6}),
    ("disk", "source.kind", "collimated",
     {"kind": "collimated", "wavelength": 587.6, "aperture": {"shape": "rectangle", "width": 16.0, "height": 16.0}}),
    ("beam_shaper", "wavefront.kind", "sphere", {"kind": "sphere", "z": 120.0, "focus": [0.0, 0.0, 240.0]}),
    ("disk", "wavefront.kind", "zernike",
     {"kind": "zernike", "z": 500.0, "radius": 8.0, "coefficients": [0.0, 0.0, 0.0, 1.5]}),
    ("disk", "effects[0].kind", "own", {"kind": "own", "name": "dust"}),
])  # fmt: skip
def test_a_kind_is_made_of_what_was_there(name, key, kind, table):
    data = tomllib.loads(changed(TEXTS[name], key, kind))
    assert table_at(key.rpartition(".")[0], data) == table


@pytest.mark.parametrize("name", ["disk", "thu", "mirror"])
def test_light_of_another_kind_and_new_tables_are_scenes(name):
    text, data = TEXTS[name], tomllib.loads(TEXTS[name])
    other = {"point": "collimated", "collimated": "point"}[data["source"]["kind"]]
    made = [changed(text, "source.kind", other)]
    for key in ("wavefront", "mount", "mount.rim", "target[1]", "target.profile", "effects[0]", "tolerance[0]"):
        made.append(changed(text, key, new_table(key, data)))
    made.append(changed(text, "mount.flange", new_table("mount.flange", data)))
    made += [changed(made[-1], "mount.flange.screws", new_table("mount.flange.screws", tomllib.loads(made[-1])))]
    made += [changed(text, "lens.outline.shape", kind) for kind in ("circle", "rectangle")]
    for each in made:
        _validated(tomllib.loads(each), FOLDER)


# ---- words -----------------------------------------------------------------------------------------------------------


DISK = tomllib.loads(TEXTS["disk"])
WHITE = tomllib.loads(TEXTS["white_logo"])
TYPED = {
    "target.z": {
        "0,5": 0.5, ",5": 0.5, "+3": 3.0, "−2,5e-3": -0.0025, "500 mm": 500.0, "40 cm": 400.0,
        "0,5 m": 500.0, "2 in": 50.8, " ": None, "1.000,5": 1000.5,
        "1,000.5": 1000.5, "1'000.5": 1000.5, "1_000": 1000.0, "1.000.000": 1e6, "1,000": 1.0, "1.000": 1.0,
    },
    "target.x": {
        "1,5; 2,5": [1.5, 2.5], "1.5, 2.5": [1.5, 2.5], "1,5 2,5": [1.5, 2.5], "1,5, 2,5": [1.5, 2.5],
        "1.5,2.5": [1.5, 2.5], "-200,200": [-200.0, 200.0], "-200, 200 mm": [-200.0, 200.0],
        "-20 cm; 20 cm": [-200.0, 200.0],
        "-1 000; 1 000": [-1000.0, 1000.0], "[0,5; 1,5]": [0.5, 1.5],
    },
    "source.position": {"0 0 1,5": [0.0, 0.0, 1.5]},
    "target.pixels": {"512": 512, "2.048": 2048, "512 205": [512, 205], "512,205": [512, 205], "[9, 20]": [9, 20]},
    "tailoring.rays": {"1 024": 1024, "1,024": 1024},
    "tailoring.seed": {"9223372036854775807": 9223372036854775807},
    "tailoring.levels": {"129 257": [129, 257], "257": [257], "[[129, 65], 257]": [[129, 65], 257]},
    "source.wavelength": {
        "587,6": 587.6, "1 064": 1064.0, "[[486.1, 1], [587.6, 1.0]]": [[486.1, 1.0], [587.6, 1.0]],
        "[486.1, 1], [587.6, 1.0]": [[486.1, 1.0], [587.6, 1.0]],
    },
    "mount.flange.holes": {"[14, 0, 3.2]": [[14.0, 0.0, 3.2]], "[[14, 0, 3.2]]": [[14.0, 0.0, 3.2]]},
    "lens.back.reflect": {"true": True, "No": False},
    "target.uniform": {"on": True, "false": None},
    "target.rotate": {"90": 90},
    "target.seen_from": {"Behind": "behind", '"lens"': "lens"},
    "tolerance[0].name": {"lens.tilt": "lens.tilt"},
    "lens.material": {"N-BK7": "N-BK7"},
    "target.text": {" HI ": " HI ", "0,5": "0,5", "[1]": "[1]"},
    "output.export": {"zemax, DXF": ["zemax", "dxf"], "sag": ["sag"], "sag;dxf svg": ["sag", "dxf", "svg"], "[]": []},
    "lens.outline": {'{ shape = "circle", diameter = 3 }': {"shape": "circle", "diameter": 3.0}},
}  # fmt: skip


@pytest.mark.parametrize("key", TYPED)
def test_words_are_values(key):
    assert {words: repr(typed(key, words, DISK)) for words in TYPED[key]} == {w: repr(v) for w, v in TYPED[key].items()}


@pytest.mark.parametrize(("key", "words", "sentence"), [
    ("target.z", "far", "target.z: 'far' is not a number; write one, such as 1000"),
    ("target.z", "1.00,000.5", "target.z: '1.00,000.5' is not a number; write one, such as 1000"),
    ("target.z", "40 miles", "target.z: '40 miles' is not a number; write one, such as 1000"),
    ("target.z", "1e999", "target.z: '1e999' is not a number; write one, such as 1000"),
    ("target.x", "5", "target.x: 2 values are needed instead of 1; write 2, such as -200, 200"),
    ("target.x", "1; a", "target.x: 'a' is not a number; write 2 numbers, such as -200, 200"),
    ("target.pixels", "12.5", "target.pixels: '12.5' is not a whole number; write one, such as 512"),
    ("target.seen_from", "behnd", "target.seen_from: 'behnd' is not possible; did you mean 'behind'?"),
    ("lens.back.reflect", "maybe", "lens.back.reflect: 'maybe' is neither true nor false; write true or false"),
    ("source.wavelength", "[[486, 1], 5]", "is not a number; write one, such as 587.6"),
    ("mount.flange.holes", "14 0 3", "'14 0 3' is not a list of the right form; write a list such as [[14"),
    ("lens.outline", "round", "lens.outline: 'round' is not a table; write it in braces, such as { height = 24.0,"),
    ("lens.bak", "1", "lens.bak: unknown key; did you mean 'back'?"),
])  # fmt: skip
def test_words_that_are_no_value_are_told_so(key, words, sentence):
    with pytest.raises(SceneError) as told:
        typed(key, words, DISK)
    assert sentence in str(told.value)


@pytest.mark.parametrize("name", suite.in_turns(TEXTS, 5))
def test_a_value_is_typed_as_it_is_shown(name):
    data = tomllib.loads(TEXTS[name])
    for key, value in leaves(data):
        assert is_same(typed(key, as_words(value), data), value), key
    for row in rows():
        node = node_at(row.key.replace("[]", "[0]"), data)
        if node is not None and not records(node):
            for value in (*node.get("examples", ()), *([node["default"]] if node.get("default", "") != "" else ())):
                assert is_same(typed(row.key.replace("[]", "[0]"), as_words(value), data), value), row.key


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_number_is_read_with_point_and_comma(value):
    words = as_words(value)
    assert number(words) == value and number(words.replace(".", ",")) == value
    assert typed("target.x", f"{words}; 0", DISK) == typed("target.x", f"{words} 0", DISK) == [value, 0.0]


@given(st.integers(-(10**12), 10**12))
def test_every_whole_number_is_read_in_thousands(value):
    for space in " \u00a0'":
        assert number(f"{value:,}".replace(",", space)) == value
    assert abs(value) < 10**6 or number(f"{value:,}") == number(f"{value:,}".replace(",", ".")) == value
    assert typed("tailoring.seed", f"{value:,}", DISK) == value


@given(st.text(max_size=30), st.sampled_from([row.key.replace("[]", "[0]") for row in rows()]))
def test_any_words_are_a_value_or_a_sentence(words, key):
    try:
        value = typed(key, words, WHITE)
    except SceneError as error:
        assert str(error).startswith(key)
    else:
        json.dumps(value)
