"""Statements of a STEP file: each one that is wrong fails a check, and each one that is missing is reported."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from bstcad.cad import step_writing
from bstcad.cad.solid import lens_solid
from bstcad.optics.lens.face_integrals import of_lens
from bstcad.scene.mount import Part
from bstcad.step_text import part21
from bstcad.verify.text_checks import measure_checks, part_checks
from tests.cad.conftest import encode, make_lens

__all__ = ["make_lens"]
PART = Part(author="Änne O'Hara", material="PMMA", density=1.19, surface_profile=0.005)
SAID = "STEP text: "


@pytest.fixture
def lens(make_lens):
    return make_lens(m=9)


@pytest.fixture
def text(lens):
    return encode(lens, PART).decode()


def checked(text, lens, part=PART):
    found = part21.parse(text)
    return [*measure_checks(found.properties, of_lens(lens), lens.outline), *part_checks(found, part)]


def test_what_is_written_is_read_and_holds(lens, text):
    wanted, stated = of_lens(lens), part21.parse(text).properties
    assert stated.areas == pytest.approx((wanted.area,), rel=1e-14)
    assert stated.volumes == pytest.approx((wanted.volume,), rel=1e-14)
    assert stated.centroids == (pytest.approx(wanted.centroid, abs=1e-14),)
    assert (stated.materials, stated.densities) == (("PMMA",), pytest.approx((1.19,), rel=1e-14))
    [profile] = stated.profiles
    assert profile.width == 0.005 and profile.surface == part21.parse(text).surface.entity
    checks = checked(text, lens)
    assert len(checks) == 7 and all(check.passed and check.limit is not None for check in checks)


def of(quantity, unit):
    """The unit of a measure, changed: it stands behind it."""

    def change(text):
        at = text.index(f"{quantity}_MEASURE(")
        return text[:at] + text[at:].replace("SI_UNIT(.MILLI.,.METRE.)", unit, 1)

    return change


WRONG = {  # faults by name: (how the file is changed, the check that sees it, its words)
    "area": (lambda t: re.sub(r"(?<=AREA_MEASURE\()\s*[-+.E\d]+", "1800.0", t), "stated area",
             r"the file states 1800 mm², but its faces give \d{4}\.\d+ mm²"),
    "volume in other digits": (lambda t: re.sub(r"(?<=VOLUME_MEASURE\()\s*\d", "9", t), "stated volume", "9"),
    "volume in cubic metres": (of("VOLUME", "SI_UNIT($,.METRE.)"), "stated volume", r"e\+12 mm³"),
    "centroid": (lambda t: re.sub(r"(CARTESIAN_POINT\('centre point',\()[^,]*", r"\g<1>1.5", t), "stated centroid",
                 r"the file states \(1\.5, .*\) mm, but its faces give \(.*\) mm"),
    "tolerance in metres": (lambda t: t[: (at := t.index("LENGTH_MEASURE(5.0"))] + t[at:].replace(
        ".MILLI.", "$", 1), "profile tolerance, difference", "the file states 5 mm, but the scene states 0.005 mm"),
    "density": (lambda t: re.sub(r"(?<=RATIO_MEASURE\()1\.19", "1.2", t), "density", "1.2 g/cm³, .* 1.19 g/cm³"),
    "material": (lambda t: t.replace("('PMMA','PMMA')", "('PMMA','PC')"), "material", "'PC', .* 'PMMA'"),
}  # fmt: skip


@pytest.mark.parametrize("change", WRONG)
def test_a_wrong_statement_fails_by_name(lens, text, change):
    alter, name, words = WRONG[change]
    assert alter(text) != text
    [failed] = [check for check in checked(alter(text), lens) if not check.passed]
    assert failed.name.startswith(SAID + name) and re.search(words, failed.where)


def test_a_tolerance_of_another_face_is_none_of_the_back(lens, text):
    faces = dict(re.findall(r"#(\d+) = ADVANCED_FACE\('(\w+)'", text))
    back, front = (next(number for number, name in faces.items() if name == wanted) for wanted in ("back", "front"))
    turned = re.sub(rf"(GEOMETRIC_ITEM_SPECIFIC_USAGE\([^)]*)#{back}\)", rf"\g<1>#{front})", text)
    assert turned != text
    [failed] = [check for check in checked(turned, lens) if not check.passed]
    assert failed.name == SAID + "profile tolerance refers to the back"


def test_what_nobody_asked_for_is_not_the_scene_s(lens, text):
    failed = [check for check in checked(text, lens, Part()) if not check.passed]
    assert [check.name for check in failed] == [
        SAID + f"{what} is the scene's" for what in ("profile tolerance", "density", "material")
    ]
    assert "the file states 0.005 mm, but the scene states none" in failed[0].where


def test_what_is_not_stated_is_told_and_not_failed(lens):
    bare = b"".join(step_writing.encode(lens_solid(lens), "lens")).decode()
    checks = checked(bare, lens)
    assert [check.name for check in checks] == [
        SAID + "states area, volume, centroid", SAID + "states profile tolerance, density, material"
    ]  # fmt: skip
    assert all(check.passed and check.value is False and check.limit is None for check in checks)
    assert len(checked(bare, lens, Part())) == 1  # and what nobody asked for is not missed
    older = encode(lens, replace(PART, surface_profile=None, schema="AP214")).decode()
    assert [check.name for check in checked(older, lens) if check.limit is None] == [SAID + "states profile tolerance"]


def test_other_programs_write_it_in_other_forms(lens, text):
    """A measure as a complex entity, cm² as the unit of an area, a volume of one face, names without their second."""
    area = of_lens(lens).area
    text = re.sub(
        r"MEASURE_REPRESENTATION_ITEM\('surface area measure',AREA_MEASURE\(\s*[-+.E\d]+\),(#\d+)\)",
        rf"(MEASURE_REPRESENTATION_ITEM() MEASURE_WITH_UNIT(AREA_MEASURE({area / 100:.12f}),\1)\n"
        r"  REPRESENTATION_ITEM('surface area measure'))", text,
    )  # fmt: skip
    text = of("AREA", "SI_UNIT(.CENTI.,.METRE.)")(text).replace("'geometric validation property',\n  'surface area'",
                                                                   "'geometric validation property' , $")  # fmt: skip
    [of_face] = re.findall(r"GEOMETRIC_ITEM_SPECIFIC_USAGE\('','',#(\d+)", text)
    stated = re.search(r"#(\d+) = REPRESENTATION\('volume'", text)[1]
    more = f"""#999998=PROPERTY_DEFINITION('geometric validation property','',#{of_face});
#999999=PROPERTY_DEFINITION_REPRESENTATION(#999998,#{stated});
ENDSEC;
END-ISO"""
    text = text.replace("ENDSEC;\nEND-ISO", more)
    found = part21.parse(text).properties
    assert found.areas == pytest.approx((area,), rel=1e-12) and len(found.volumes) == 1
    assert all(check.passed for check in checked(text, lens))


def test_a_name_that_looks_like_a_statement_is_none(lens):
    sly = "a'; #1 = PROPERTY_DEFINITION('geometric validation property','volume',#4); lens"
    text = encode(lens, PART, sly).decode()
    assert len(part21.parse(text).properties.volumes) == 1 and all(check.passed for check in checked(text, lens))
