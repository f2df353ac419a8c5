"""The scene explains itself: each field has unit, range and meaning; the schema and `bstcad keys` are made of them."""

import json
import re
import tomllib
from dataclasses import is_dataclass
from pathlib import Path
from typing import get_args, get_type_hints

import jsonschema
import pytest

from bstcad import cli
from bstcad.optics.surfaces.key import Key
from bstcad.scene import schema
from bstcad.scene.scene import OUTLINES, Scene

TEMPLATES = sorted((Path(__file__).parent.parent.parent / "templates").glob("*.toml"))
THU = Path(__file__).parent.parent.parent / "templates" / "thu.toml"


def leaves(hint):
    """Every class that a type names."""
    if inner := [leaf for part in get_args(hint) for leaf in leaves(part)]:
        return inner
    return [hint] if isinstance(hint, type) else []


def fields(record, table=""):
    """(dotted key, name, type) of every field of a record and of the records in it, from the classes alone."""
    for name, hint in get_type_hints(record, include_extras=True).items():
        if name not in (record.__dataclass_fields__ if is_dataclass(record) else record.model_fields):
            continue
        inner = [leaf for leaf in leaves(hint) if hasattr(leaf, "model_fields") or hasattr(leaf, "__pydantic_config__")]
        listed = "[]" if inner and "..." in str(hint) and "'table'" not in str(hint) else ""  # a table may stand alone
        name = (not is_dataclass(record) and record.model_fields[name].alias) or name
        yield f"{table}{name}{listed}", name, hint
        for leaf in inner:
            yield from fields(leaf, f"{table}{name}{listed}.")


FIELDS = list(fields(Scene))


def test_every_field_has_unit_range_and_a_sentence():
    for dotted, name, hint in FIELDS:
        [key] = (part for part in hint.__metadata__ if isinstance(part, Key))
        assert re.fullmatch(r"[^\n]{5,110}[.]", key.meaning), dotted
        numeric = {int, float} & set(leaves(hint))
        assert (key.minimum is not None) == bool(numeric), dotted
        assert not numeric or key.minimum < key.maximum, dotted
        assert numeric or key.unit == "" or name == "rotate", dotted
        for value in (key.minimum - max(1, abs(key.minimum)), 2 * key.maximum + 1) if numeric else ():
            for given in (value, (0.5 * (key.minimum + key.maximum), value), ((value, 1.0),)):
                with pytest.raises(ValueError, match=f"is not between .*{key.unit}; "):
                    key.in_range(given)


def test_the_keys_are_those_of_the_models(capsys):
    assert cli.run(["keys"]) == 0
    rows = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert all(len(row) == 5 and row[1] and row[2] and row[4].endswith(".") for row in rows)
    diameters = {f"{table.replace('before', 'before[]').replace('behind', 'behind[]')}.diameter" for table in OUTLINES}
    assert {row[0] for row in rows} == {dotted for dotted, *_ in FIELDS} | diameters
    assert len(FIELDS) > 150


@pytest.mark.parametrize(("asked", "first", "count"), [
    ("lens.tool_radius", "lens.tool_radius\tmm\t1e-06 to 1e+09\t\tRadius of the tool: ", 1),
    ("accept", "accept\tnone\ttable\t\tThe limits", 29),
    ("effects[0].coating", "effects[].coating\tnone\ttable\t\tfresnel: ", 3),
    ("lens.front.curvature", "lens.front.curvature\t1/mm\t-1000 to 1000\t0.0\tsphere, conic: ", 1),
])  # fmt: skip
def test_a_key_or_a_table_is_printed(asked, first, count, capsys):
    assert cli.run(["keys", asked]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(first) and len(lines) == count


def test_an_unknown_key_ends_with_2_and_the_nearest(capsys):
    for asked, words in (("lens.tool_radus", "did you mean 'lens.tool_radius'?"), ("zzz", "the keys here are accept")):
        assert cli.run(["keys", asked]) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"bstcad: {asked}: unknown key; {words}") and said.count("\n") == 1


def test_the_kept_schema_is_that_of_the_models_and_is_made_again(monkeypatch, capsys):
    """Under the hash of another version, or damaged, it is made again; it is read without its records."""
    assert schema.of_model(Scene) == schema.schema()
    [kept] = (Path(schema.__file__).parent / "__pycache__").glob("schema-*.json")
    kept.write_text("{")
    text = schema.schema_text()
    assert json.loads(text) == schema.schema() and kept.read_text() == text
    monkeypatch.setattr(schema.subprocess, "run", None)
    assert schema.schema_text() == text
    assert cli.run(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == schema.schema()


VALIDATOR = jsonschema.Draft202012Validator(schema.schema())


def test_an_editor_accepts_the_templates():
    VALIDATOR.check_schema(schema.schema())
    assert [list(VALIDATOR.iter_errors(tomllib.loads(path.read_text()))) for path in TEMPLATES] == [[]] * len(TEMPLATES)


@pytest.mark.parametrize(("table", "key", "value"), [
    ("lens", "tool_radius", -1.0), ("lens", "tool_radus", 1.0), ("lens", "material", 3), ("lens", "back", None),
    ("source", "kind", None), ("source", "wavelength", [[50.0, 1.0]]), ("source", "diameter", 1.0),
    ("target", "x", [0.0]), ("target", "pixels", 7), ("target", "rotate", 45),
    ("lens", "outline", {"shape": "oval"}),
    ("lens", "outline", {"shape": "circle", "radius": 1.0, "diameter": 2.0}),
    ("tolerances", "rrmsd", 0.1),
])  # fmt: skip
def test_an_editor_refuses_a_wrong_scene(table, key, value):
    scene = tomllib.loads(THU.read_text())
    scene.setdefault(table, {})[key] = value
    if value is None:
        del scene[table][key]
    assert list(VALIDATOR.iter_errors(scene))
