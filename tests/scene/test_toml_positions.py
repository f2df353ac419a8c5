"""Lines of a scene file: where a key stands, as tomllib reads the file."""

import tomllib
from pathlib import Path

import pytest

from bstcad.scene.errors import SceneError, line_of, toml_positions
from bstcad.scene.scene import load

TEMPLATES = sorted((Path(__file__).parent.parent.parent / "templates").glob("*.toml"))
TEXT = """# a comment = 1
name = "x"  # another = 2
[source]
kind = "point"
 'wavelength' = 650.0
lens.front = { kind = "plane", z = 8.0 }

[[effects]]
kind = "fresnel"
[[ "effects" ]]
kind = "absorption"
coefficient = 0.1
"""


def test_keys_and_tables_have_their_lines():
    found = toml_positions(TEXT)
    assert found["name"] == 2 and found["source"] == 3 and found["source.wavelength"] == 5
    assert found["source.lens.front"] == 6
    assert (found["effects[0]"], found["effects[0].kind"]) == (8, 9)
    assert (found["effects[1]"], found["effects[1].coefficient"]) == (10, 12)


@pytest.mark.parametrize(
    ("key", "line"),
    [
        ("source.lens.front.kind", 6), ("source.diameter", 3), ("effects[1].coating.index", 10),
        ("effects[2].kind", None), ("target.tilt", None),
    ],
)  # fmt: skip
def test_a_key_that_is_not_there_is_on_the_line_of_what_holds_it(key, line):
    assert line_of(key, toml_positions(TEXT)) == line


def leaves(tree, key=""):
    for name, value in tree.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):  # [[tables]]
            for k, table in enumerate(value):
                yield from leaves(table, f"{key}{name}[{k}].")
        else:
            yield from leaves(value, f"{key}{name}.") if isinstance(value, dict) else [f"{key}{name}"]


@pytest.mark.parametrize(
    ("overrides", "notes"),
    [({}, 1), ({"source.aperture.radius": "-2"}, 0), ({"source.aperture": '{ shape = "circle", radius = -2 }'}, 0)],
)
def test_a_wrong_value_is_told_its_line_unless_it_comes_from_elsewhere(overrides, notes, tmp_path):
    path = tmp_path / "scene.toml"
    text = next(path for path in TEMPLATES if path.stem == "thu").read_text(encoding="utf-8")
    path.write_text(text.replace("radius = 12.0 }", "radius = -1 }"), encoding="utf-8")
    with pytest.raises(SceneError) as caught:
        load(path, overrides)
    assert getattr(caught.value, "__notes__", []) == [f"line 15 of {path}"][:notes]


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.stem)
def test_every_key_of_a_template_is_on_its_line(path):
    text = path.read_text(encoding="utf-8")
    for key in leaves(tomllib.loads(text)):
        line = text.splitlines()[line_of(key, toml_positions(text)) - 1]
        assert key.rpartition(".")[2] in line.partition("#")[0]
