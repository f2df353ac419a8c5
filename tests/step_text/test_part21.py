"""The Part-21 reader on text written by hand: it must find what stands there, and refuse what does not."""

from __future__ import annotations

import re

import numpy as np
import pytest

from bstcad.step_text import part21
from bstcad.step_text.entities import read_entities

HEAD = "ISO-10303-21;\nHEADER;\nFILE_SCHEMA(('AP242_X'));\nENDSEC;\nDATA;\n"
TAIL = "ENDSEC;\nEND-ISO-10303-21;\n"
UNITS = """#900 = ( GEOMETRIC_REPRESENTATION_CONTEXT(3) GLOBAL_UNIT_ASSIGNED_CONTEXT((#901))
 REPRESENTATION_CONTEXT('','') );
#901 = ( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.) );
"""
NET = np.stack([*np.meshgrid([0.0, 1.0, 2.0, 3.0], [0.0, 1.5, 3.0, 4.5], indexing="ij"), np.zeros((4, 4))], axis=-1)
NET[..., 2] = np.arange(16).reshape(4, 4) / 7
POINTS = "".join(
    f"#{i} = CARTESIAN_POINT('',({x:.17E},{y:.17E},\n  {z:.17E}));\n"
    for i, (x, y, z) in enumerate(NET.reshape(-1, 3), start=1)
)
GRID = "(" + ",".join("(" + ",".join(f"#{4 * i + j + 1}" for j in range(4)) + ")" for i in range(4)) + ")"
KNOTS = "(3,1,3),(3,\n1,3),(0.,1.,2.),(0.,1.,2.)"
SIMPLE = f"#50 = B_SPLINE_SURFACE_WITH_KNOTS('',2,2,{GRID},.UNSPECIFIED.,.F.,.F.,.U.,{KNOTS},.UNSPECIFIED.);\n"
PRODUCT = "#60 = PRODUCT('it''s #1; (a \\X2\\93E1\\X0\\) lens','','',());\n"


def text(surface: str = SIMPLE, product: str = PRODUCT, units: str = UNITS, points: str = POINTS) -> str:
    return HEAD + points + surface + product + units + TAIL


def test_the_surface_is_read_as_it_stands():
    found = part21.parse(text())
    assert np.array_equal(found.surface.control_points, NET)
    assert found.surface.degrees == (2, 2)
    assert found.surface.closed == (False, False) and found.surface.self_intersecting is None
    for knots, counts, full in zip(
        found.surface.knots, found.surface.multiplicities, found.surface.full_knots, strict=True
    ):
        assert knots.tolist() == [0, 1, 2] and counts.tolist() == [3, 1, 3]
        assert full.tolist() == [0, 0, 0, 1, 2, 2, 2]


@pytest.mark.parametrize(("begin", "end"), [("/*;\n", "*/"), ("#70 = TEXT(';\n", "');\n")])
def test_points_within_a_comment_or_a_string_are_no_points(begin, end):
    found = part21.parse(text(product=PRODUCT + begin + POINTS + end))  # else two entities would share a number
    assert np.array_equal(found.surface.control_points, NET)


@pytest.mark.parametrize("step", [1, -1], ids=["ascending", "descending"])
def test_points_are_read_in_blocks(step):
    """40,000 points, which no entity names, are more than two blocks."""
    numbers = np.arange(1_000, 41_000)
    rows = "".join(f"#{n} = CARTESIAN_POINT('',({n}.,-{n}.5,1.E-03));\n" for n in numbers[::step])
    _, found = read_entities(text(points=POINTS + rows).encode())
    assert np.array_equal(found.points(numbers), np.stack([numbers, -numbers - 0.5, np.full(40_000, 1e-3)], axis=-1))
    assert np.array_equal(found.points(np.arange(1, 17)), NET.reshape(-1, 3))


def test_names_units_and_schema():
    found = part21.parse(text())
    assert found.product == "it's #1; (a 鏡) lens"
    assert (found.unit, found.schema, found.solids) == ("millimetre", "AP242_X", 0)


TITLE = "Größe 3 – étui"
STRINGS = {  # strings of a file and their text, in the forms that programs write
    "UTF-8": (TITLE.encode(), TITLE),
    "Windows-1252": (TITLE.encode("cp1252"), TITLE),
    "GB18030": ("自由曲面透镜 3号".encode("gb18030"), "自由曲面透镜 3号"),
    "GB18030 with a quote": ("透镜''𠀀".encode("gb18030"), "透镜'𠀀"),
    "X2": (b"Gr\\X2\\00F600DF\\X0\\e 3 \\X2\\2013\\X0\\ \\X2\\00E9\\X0\\tui", TITLE),
    "X4": (b"\\X4\\0001D11E00000041\\X0\\", "𝄞A"),
    "X": (b"Gr\\X\\F6\\X\\DFe, \\X\\E9tui", "Größe, étui"),
    "S": (b"Gr\\S\\v\\S\\_e, \\S\\itui \\PE\\\\S\\0", "Größe, étui А"),  # page E: ISO 8859-5, Cyrillic
    "backslash": (b"a\\\\X2\\\\b", r"a\X2\b"),
}


@pytest.mark.parametrize("form", STRINGS)
def test_names_are_read_whole_in_each_form(form):
    written, name = STRINGS[form]
    head, tail = text(product="#60 = PRODUCT('?','','',());\n").encode().split(b"?")
    assert part21.parse(head + written + tail).product == name


MILLI = "SI_UNIT(.MILLI.,.METRE.)"
INCH = UNITS.replace(MILLI, "CONVERSION_BASED_UNIT('INCH',#902)") + (
    "#902 = LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE(2.54),#903);\n"
    "#903 = ( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.CENTI.,.METRE.) );\n"
)


@pytest.mark.parametrize(
    ("units", "name", "size"),
    [
        (INCH, "inch", 25.4),
        (UNITS.replace(".MILLI.", "$"), "metre", 1e3),
        (UNITS.replace("MILLI", "CENTI"), "centimetre", 10.0),
    ],
)
def test_coordinates_in_another_unit_are_read_in_mm(units, name, size):
    found = part21.parse(text(units=units))
    assert found.unit == name
    np.testing.assert_allclose(found.surface.control_points, size * NET, rtol=1e-15)


def test_a_unit_of_no_stated_size_is_refused():
    with pytest.raises(ValueError, match="it has lengths in inch but does not state the size of this unit"):
        part21.parse(text(units=UNITS.replace(MILLI, "CONVERSION_BASED_UNIT('INCH',#901)")))


def square(loop: str = ".T.,.T.", second: str = ".F.,.T.") -> str:
    """Two faces that share one edge (#80), used by each with an edge flag and a bound flag."""
    (first_edge, first_bound), (other_edge, other_bound) = loop.split(","), second.split(",")
    return f"""#70 = VERTEX_POINT('',#1);
#71 = LINE('',#1,#72); #72 = VECTOR('',#73,1.); #73 = DIRECTION('',(1.,0.,0.));
#80 = EDGE_CURVE('',#70,#70,#71,.T.);
#81 = ORIENTED_EDGE('',*,*,#80,{first_edge}); #82 = ORIENTED_EDGE('',*,*,#80,{other_edge});
#83 = EDGE_LOOP('',(#81)); #84 = EDGE_LOOP('',(#82));
#85 = FACE_BOUND('',#83,{first_bound}); #86 = FACE_OUTER_BOUND('',#84,{other_bound});
#87 = ADVANCED_FACE('',(#85),#50,.T.); #88 = ADVANCED_FACE('',(#86),#50,.F.);
#89 = CLOSED_SHELL('',(#87,#88)); #90 = MANIFOLD_SOLID_BREP('',#89);
"""


@pytest.mark.parametrize(
    ("loop", "second", "uses"),
    [
        (".T.,.T.", ".F.,.T.", (1, 1)),
        (".T.,.T.", ".T.,.F.", (1, 1)),
        (".T.,.T.", ".T.,.T.", (2, 0)),
        (".F.,.F.", ".T.,.T.", (2, 0)),
    ],
)
def test_edge_uses_count_the_direction_of_edge_and_bound(loop, second, uses):
    found = part21.parse(text(SIMPLE + square(loop, second)))
    assert found.edge_uses == {80: uses} and found.closed is (uses == (1, 1))
    assert (found.solids, found.faces) == (1, 2)


def rational(weights) -> str:
    """The surface as an entity of several kinds, with weights (4, 4), as other programs write it."""
    rows = ",".join(
        "(" + ",".join(f"{each:.17G}." if each == 1 else f"{each:.6f}" for each in row) + ")" for row in weights
    )
    return (
        f"#50 = ( BOUNDED_SURFACE() B_SPLINE_SURFACE(2,2,{GRID},.UNSPECIFIED.,.F.,.F.,.U.)\n"
        f" B_SPLINE_SURFACE_WITH_KNOTS({KNOTS},.UNSPECIFIED.) GEOMETRIC_REPRESENTATION_ITEM()\n"
        f" RATIONAL_B_SPLINE_SURFACE(({rows})) REPRESENTATION_ITEM('') SURFACE() );\n"
    )


@pytest.mark.parametrize("weight", [1, 0.7])
def test_a_rational_surface_with_equal_weights_is_the_same_surface(weight):
    plain, found = (part21.parse(text(each)).surface for each in (SIMPLE, rational(np.full((4, 4), weight))))
    assert np.array_equal(found.control_points, plain.control_points) and found.degrees == (2, 2)
    assert all(map(np.array_equal, found.full_knots, plain.full_knots)) and found.entity == "50"
    assert found.closed == (False, False) and found.self_intersecting is None


def test_other_weights_are_named():
    weights = np.ones((4, 4))
    weights[1, 2] = 1.01
    with pytest.raises(ValueError, match="#50 is rational with weights from 1 to 1.01, and a face"):
        part21.parse(text(rational(weights)))
    with pytest.raises(ValueError, match="the weights of the surface #50 are malformed, or not one per control point"):
        part21.parse(text(rational(np.ones((4, 3)))))


def test_a_face_outside_the_shell_uses_no_edge():
    found = part21.parse(text(SIMPLE + square().replace("(#87,#88)", "(#87)")))
    assert found.edge_uses == {80: (1, 0)} and not found.closed


DAMAGES = {
    "empty": (lambda t: "", "not a STEP file"),
    "other": (lambda t: "solid stl" + t, "not a STEP file"),
    "truncated": (lambda t: t[: len(t) // 2], "truncated"),
    "hole": (lambda t: t.replace("#7 = ", ""), "not an entity"),
    "missing": (lambda t: re.sub(r"#7 = [^;]*;\n", "", t), "#7 is missing"),
    "twice": (lambda t: t.replace("#7 = ", "#8 = "), "share a number"),
    "bracket": (lambda t: t.replace("((#1,", "(#1,"), "malformed"),
    "letter": (lambda t: t.replace("(3,1,3)", "(3,l,3)"), "malformed"),
    "infinite": (lambda t: t.replace("1.50000000000000000E+00", "1.E999", 1), "not finite"),
    "kind": (lambda t: t.replace("#3,#4)", "#3,#60)"), "#60 is missing or of another kind"),
    "knots": (lambda t: t.replace("(3,1,3)", "(2,1,3)"), "knots"),
    "no times": (lambda t: t.replace(KNOTS[:-11], "(3,0,1,3),(3,\n1,3),(0.,0.5,1.,2.)", 1), "knots"),
    "infinite knot": (
        lambda t: t.replace("(0.,1.,2.)", "(0.,1.,2.E999)", 1),
        r"#50 = B_\w+ is malformed: the number 2.E999 is not finite",
    ),
    "far": (lambda t: t.replace("1.50000000000000000E+00", "1.E20", 1), "above 1e\\+12"),
    "huge number": (lambda t: t.replace("#60 =", f"#{'9' * 20} ="), "not an entity"),
    "alias": (lambda t: t.replace("#60 =", "#07 ="), "not an entity"),
    "behind": (lambda t: t.replace("'','',());", "'','',())A;"), "not an entity"),
    "no data": (lambda t: t.replace("DATA;", "DATUM;"), "no DATA"),
    "two units": (lambda t: t.replace("SI_UNIT(.M", "SI_UNIT($,.METRE.) SI_UNIT(.M"), "not based on one"),
    "ragged": (lambda t: t.replace("#3,#4)", "#3)"), "rectangular"),
    "rational": (lambda t: t.replace("B_SPLINE_SURFACE_W", "RATIONAL_B_SPLINE_SURFACE_W"), "no B"),
    "no surface": (lambda t: t.replace(SIMPLE, ""), "no B_SPLINE_SURFACE_WITH_KNOTS"),
    "no product": (lambda t: t.replace(PRODUCT, ""), "no PRODUCT"),
    "no unit": (lambda t: t.replace(UNITS, ""), "units of length are not stated"),
    "no schema": (lambda t: t.replace("FILE_SCHEMA", "FILE"), "FILE_SCHEMA"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_refused_in_one_sentence(damage):
    change, sentence = DAMAGES[damage]
    damaged = change(text())
    assert damaged != text()
    with pytest.raises(ValueError, match=sentence) as caught:
        part21.parse(damaged)
    assert "\n" not in str(caught.value)


def test_more_freeform_faces_than_two_are_refused():
    grown = SIMPLE.replace("#50", "#51"), SIMPLE.replace("#50", "#52")
    assert part21.parse(text(SIMPLE + grown[0])).front is not None
    with pytest.raises(ValueError, match="3 freeform surfaces"):
        part21.parse(text(SIMPLE + "".join(grown)))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match="gone.step: cannot be read"):
        part21.read(tmp_path / "gone.step")
