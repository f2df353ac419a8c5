"""Statements of lens.step besides the shape: re-read by OCC, and from the text where OCC is known to err."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from bstcad.cad import step_reading, step_writing
from bstcad.cad.solid import lens_solid
from bstcad.optics.lens.face_integrals import of_lens
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.scene.mount import LENS_COLOUR, Part
from bstcad.step_text import part21
from bstcad.verify.text_checks import part_checks
from tests.cad.conftest import encode
from tests.cad.said_in_step import read

PART = Part(
    number="LE-017", author="Änne O'Hara", organisation="A \\ B", material="PMMA", density=1.19, colour="#10a0ff40",
    surface_profile=0.005,
)  # fmt: skip


@pytest.fixture(params=[Rectangle(24.0, 20.0), Circle(12.0)], ids=lambda outline: outline.shape)
def lens(request, make_lens):
    return make_lens(outline=request.param, m=9)


def walls_of(lens):
    return ["rim"] * (2 if isinstance(lens.outline, Circle) else 4)


def test_all_that_is_said_comes_back(lens, tmp_path):
    step_writing.write_lens(lens, tmp_path / "lens.step", "lens", PART)
    said, wanted = read(tmp_path / "lens.step"), of_lens(lens)
    assert (said.name, said.faces) == ("lens", ["back", "front", *walls_of(lens)])
    assert (said.colour, said.material, said.density) == ("#10a0ff40", "PMMA", pytest.approx(1.19, rel=1e-12))
    assert (said.area, said.volume) == pytest.approx((wanted.area, wanted.volume), rel=1e-13)
    assert said.centroid == pytest.approx(wanted.centroid, abs=1e-13)
    assert said.tolerances == [("ProfileOfSurface", pytest.approx(0.005, rel=1e-12), ["back"])]  # mm
    again = step_reading.read(tmp_path / "lens.step")  # and it is the lens that it was
    assert again.control_points == pytest.approx(lens.back.control_points(), abs=1e-11)


def entity(text, number):
    return re.sub(r"\s", "", re.search(rf"#{number} = ([^;]*);", text)[1])


def test_the_text_has_each_measure_in_its_unit(lens):
    """OCC's own text has 0.005 of a metre here, and g³ cm²; its reader may undo what its writer does."""
    text = encode(lens, PART).decode()
    [(measure, aspect)] = re.findall(r"SURFACE_PROFILE_TOLERANCE\('','',#(\d+),#(\d+)\)", text)
    stated = r"LENGTH_MEASURE_WITH_UNIT\(LENGTH_MEASURE\((.*)\),#(\d+)\)"
    value, unit = re.fullmatch(stated, entity(text, measure)).groups()
    assert float(value) == 0.005
    assert entity(text, unit) == "(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))"
    [face] = re.findall(rf"GEOMETRIC_ITEM_SPECIFIC_USAGE\('','',#{aspect},#\d+,#(\d+)\)", text)
    assert entity(text, face).startswith("ADVANCED_FACE('back',")
    [(value, unit)] = re.findall(r"POSITIVE_RATIO_MEASURE\(\s*([\d.]+)\s*\),#(\d+)", text)
    powers = [entity(text, number) for number in re.findall(r"#(\d+)", entity(text, unit))]
    found = {entity(text, re.search(r"#(\d+)", power)[1]): float(power.split(",")[1].strip(")")) for power in powers}
    assert float(value) == 1.19 and found == {
        "(MASS_UNIT()NAMED_UNIT(*)SI_UNIT($,.GRAM.))": 1.0,
        "(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.CENTI.,.METRE.))": -3.0,
    }
    of_part = re.findall(r"PROPERTY_DEFINITION\('geometric validation property',\s*'[\w ]+',\s*#(\d+)\s*\)", text)
    assert len(of_part) == 3 and {entity(text, number)[:24] for number in of_part} == {"PRODUCT_DEFINITION_SHAPE"}
    assert text.count("SHAPE_REPRESENTATION('") == 1  # of the solid: there is no second one


def test_number_and_names_stand_in_product_and_header(lens):
    text = encode(lens, PART).decode()
    assert text.isascii() and re.search(r"PRODUCT\('LE-017','lens',", text)
    header = re.sub(r"\s", "", text[: text.index("ENDSEC")])
    assert r"('\X2\00C4\X0\nneO''Hara'),('A\X2\005C\X0\B')" in header
    assert part21.parse(text).product == "lens"


def test_what_is_not_said_is_not_written(lens, tmp_path):
    step_writing.write(lens_solid(lens), tmp_path / "lens.step", "lens")
    said = read(tmp_path / "lens.step")
    assert (said.colour, said.material, said.area, said.volume, said.centroid) == (None,) * 5
    assert said.tolerances == [] and set(said.faces) <= {None, ""}
    text = (tmp_path / "lens.step").read_text()
    assert not re.search("TOLERANCE|MATERIAL|COLOUR|PROPERTY_DEFINITION", text)


def test_older_programs_get_ap214(lens, tmp_path):
    part = Part(material="PMMA", density=1.19, colour=LENS_COLOUR, schema="AP214")
    step_writing.write_lens(lens, tmp_path / "lens.step", "lens", part)
    text, said = part21.read(tmp_path / "lens.step"), read(tmp_path / "lens.step")
    assert text.schema.startswith("AUTOMOTIVE_DESIGN") and text.closed
    assert (said.faces[:2], said.colour, said.material) == (["back", "front"], LENS_COLOUR, "PMMA")
    assert said.density == pytest.approx(1.19, rel=1e-12)
    step_writing.write_lens(lens, tmp_path / "lens.step", "lens")  # nothing of it stays in the process
    assert part21.read(tmp_path / "lens.step").schema.startswith("AP242")


def test_the_front_has_a_profile_of_its_own(lens, tmp_path):
    """Two zones in mm, each of its face, by OCC's reader; the text's reader and the checks tell them apart."""
    part = replace(PART, front_profile=0.02)
    step_writing.write_lens(lens, tmp_path / "lens.step", "lens", part)
    found = dict((names[0], width) for _, width, names in read(tmp_path / "lens.step").tolerances)
    assert found == {"back": pytest.approx(0.005, rel=1e-12), "front": pytest.approx(0.02, rel=1e-12)}
    text = part21.read(tmp_path / "lens.step")
    assert {(one.face, one.width) for one in text.properties.profiles} == {("back", 0.005), ("front", 0.02)}
    assert all(check.passed and check.limit is not None for check in part_checks(text, part))
    assert [check.passed for check in part_checks(text, replace(part, front_profile=0.03))].count(False) == 1
    step_writing.write_lens(lens, tmp_path / "lens.step", "lens", PART)
    assert [check.limit for check in part_checks(part21.read(tmp_path / "lens.step"), part)].count(None) == 1
    faces = ["back", "flange", *walls_of(lens)]  # a plane front is one with a flange
    text = encode(lens, part, faces=faces).decode()
    assert text.count("SURFACE_PROFILE_TOLERANCE") == 1


def test_the_same_lens_is_the_same_file(lens, monkeypatch):
    """But for the date in its header, which SOURCE_DATE_EPOCH fixes."""
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    first, _, second = (encode(lens, part, name) for part, name in ((PART, "lens"), (Part(), "other"), (PART, "lens")))
    assert first == second and b"'1970-01-02T00:00:00'" in first
    monkeypatch.delenv("SOURCE_DATE_EPOCH")
    now = encode(lens, PART)
    assert now != first and now.partition(b"DATA;")[2] == first.partition(b"DATA;")[2]


def test_the_lens_of_a_design_says_what_its_scene_does(small_design):
    """PMMA, whose density is known."""
    said = read(small_design.folder / "lens.step")
    assert (said.material, said.density, said.colour) == ("PMMA", pytest.approx(1.19), LENS_COLOUR)
    assert said.faces == ["back", "front", *["rim"] * 4] and said.tolerances == []
    reread = step_reading.lens(step_reading.read(small_design.folder / "lens.step"), 1.5)
    assert said.volume == pytest.approx(of_lens(reread).volume, rel=1e-12)
    assert said.centroid == pytest.approx(of_lens(reread).centroid, abs=1e-9)
