"""Points are taken out of a file's bytes exactly where the expressions for statements would find them."""

import numpy as np
import pytest

from bstcad.step_text import part21, points

HEAD = b"ISO-10303-21;\nHEADER;\n#1=CARTESIAN_POINT('',(1.,2.,3.));\nENDSEC;\nDATA;\n"
TAIL = b"ENDSEC;\nEND-ISO-10303-21;\n"


def of(statement: bytes) -> list[tuple]:
    """The points taken out of a file with this statement; the rest holds all other statements."""
    rest, numbers, xyz = points.taken_out(HEAD + statement + TAIL)
    assert HEAD.rstrip() in rest.replace(b"\n\n", b"\n") and rest.endswith(TAIL)
    assert (statement.strip() in rest) == (len(numbers) == 0)
    return list(zip(numbers.tolist(), map(tuple, xyz.tolist()), strict=True))


@pytest.mark.parametrize(
    "statement",
    [
        b"#7=CARTESIAN_POINT('',(1.5,-2.E-1,+3.25E+02));",
        b"#7 = CARTESIAN_POINT('',(1.5,-0.2,\n    325.0));\n",
        b" # 7 =\tCARTESIAN_ POINT( '' , ( 1. 5,-2.E-\n1,3.25E2 ) ) ;",
    ],
)
def test_a_point_is_found_however_it_is_spaced(statement):
    assert of(statement) == [(7, (1.5, -0.2, 325.0))]


@pytest.mark.parametrize(
    "statement",
    [
        b"#7=CARTESIAN_POINT('',(1.5,2.));",  # in a plane
        b"#7=CARTESIAN_POINT('',(1.5,2.,3.,4.));",
        b"#7=CARTESIAN_POINT('middle',(1.5,2.,3.));",
        b"#7=CARTESIAN_POINT(' ',(1.5,2.,3.));",
        b"#7=CARTESIAN_POINT('''',(1.5,2.,3.));",
        b"#7=CARTESIAN_POINT('',(1,2.,3.));",
        b"#7=CARTESIAN_POINT('',(1.E,2.,3.));",
        b"#7=CARTESIAN_POINT('',(1..5,2.,3.));",
        b"#7=CARTESIAN_POINT('',(-.5,2.,3.));",
        b"#7=CARTESIAN_POINT('',(NAN,2.,3.));",
        b"#07=CARTESIAN_POINT('',(1.,2.,3.));",
        b"#1234567890123456789=CARTESIAN_POINT('',(1.,2.,3.));",
        b"#7=PRODUCT('a;#8=CARTESIAN_POINT('''',(1.,2.,3.));','',$);",
        b"#7=CARTESIAN_POINT('',(1.,2.,3.))",
        b"x#7=CARTESIAN_POINT('',(1.,2.,3.));",
    ],
)
def test_other_statements_stay_where_they_are(statement):
    assert of(statement) == []


def test_random_points_are_read_to_the_last_bit():
    rng = np.random.default_rng(3)
    xyz = rng.normal(size=(1000, 3)) * 10.0 ** rng.integers(-12, 9, (1000, 3))
    lines = (b"#%d=CARTESIAN_POINT('',(%.16E,%.16E,%.16E));\n" % (2 * k + 1, *row) for k, row in enumerate(xyz))
    _, numbers, found = points.taken_out(HEAD + b"".join(lines) + TAIL)
    assert np.array_equal(numbers, 2 * np.arange(1000) + 1) and np.array_equal(found, xyz)


def test_references_are_counted_as_they_stand():
    assert points.references(b"(#1,#20,(#3,#1),#,#12345678901234567890)").tolist() == [1, 20, 3, 1, -1]


@pytest.mark.parametrize("cut", [b"DATA;", b"ENDSEC;"])
def test_a_file_without_a_section_keeps_its_points(cut):
    data = (HEAD + b"#7=CARTESIAN_POINT('',(1.,2.,3.));" + TAIL).replace(cut, b"")
    rest, numbers, _ = points.taken_out(data)
    assert rest == data and not len(numbers)


def test_a_point_that_is_there_twice_is_damage():
    with pytest.raises(ValueError, match="share a number"):
        part21.parse(HEAD.replace(b"#1=", b"") + 2 * b"#7=CARTESIAN_POINT('',(1.,2.,3.));" + b"#8=A();" + TAIL)
