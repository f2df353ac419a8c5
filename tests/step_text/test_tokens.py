"""Texts that no STEP file may hold are refused in one sentence with the statement; all that Part 21 permits is read."""

from __future__ import annotations

import gzip
import subprocess
import sys

import numpy as np
import pytest

from bstcad.runs.files import SceneError
from bstcad.step_text import beginning, part21
from tests.step_text.test_part21 import NET, SIMPLE, text

AXIS = "#70 = AXIS2_PLACEMENT_3D('',#71,$,$); #71 = CARTESIAN_POINT('',({},0.,0.));\n"
WRONG = (
    "NAN", "nan", "INF", "-INF", "1.#QNAN", "1.5.2", "1.E", "0x1.", "1.E+", "--1.", "1,5E", "1.E400", "1." + "0" * 80,
)  # fmt: skip
MALFORMED = r"statement #71 = CARTESIAN_POINT is malformed|a CARTESIAN_POINT is not finite"
PERMITTED = "#70 = VECTOR('NAN; 1.5.2',#1,{}); #71 = COLOUR(.NAN.,*,$,(),\"0F\",W(2));\n"


@pytest.mark.parametrize("value", WRONG)
def test_a_number_that_step_does_not_know_is_refused_with_its_statement(value):
    with pytest.raises(ValueError, match=MALFORMED):
        part21.parse(text(SIMPLE + AXIS.format(value)))
    with pytest.raises(ValueError, match="malformed|not finite") as caught:
        part21.parse(text(SIMPLE + f"#70 = VECTOR('',#1,{value});\n"))
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("value", ["0.", "-1.5E-07", "+3.", "1.e-7", "12.000000000000000000"])
def test_numbers_of_step_are_none_of_these(value):
    found = part21.parse(text(SIMPLE + PERMITTED.format(value)))
    assert np.array_equal(found.surface.control_points, NET)


def test_comments_and_a_byte_order_mark_are_passed_over():
    whole = text().replace("HEADER;", "HEADER; /* it's; DATA */").replace("#7 =", "/* NAN */ #7 /**/ = /***/")
    found = part21.parse(b"\xef\xbb\xbf\n /* a; ' */ " + whole.encode())
    assert np.array_equal(found.surface.control_points, NET)


BEGINNINGS = {
    "empty": (b"", "it is empty"), "blank": (b" \n", "it is empty"), "a mesh": (b"solid x\n", "does not begin with"),
    "packed": (gzip.compress(b"ISO-10303-21;"), "compressed with gzip"), "zip": (b"PK\x03\x04..", "zip archive"),
    "UTF-16": ("ISO-10303-21;".encode("utf-16"), "UTF-16"), "comment": (b"/*" * 30_000, "does not begin"),
}  # fmt: skip


@pytest.mark.parametrize("name", BEGINNINGS)
def test_a_file_that_does_not_begin_as_step_is_refused(tmp_path, name):
    data, sentence = BEGINNINGS[name]
    (tmp_path / "x.step").write_bytes(data)
    with pytest.raises(SceneError, match=f"x.step: not a STEP file .*{sentence}"):
        beginning.check(tmp_path / "x.step")
    with pytest.raises(ValueError, match=sentence):
        part21.read(tmp_path / "x.step")


LOADED = "print(code, [m for m in ('torch', 'numpy', 'OCP', 'loky') if m in sys.modules])"


def test_verify_refuses_such_a_file_before_libraries_load(tmp_path):
    (tmp_path / "x.step").write_bytes(b"solid x\n")
    code = f"import sys\nfrom bstcad import cli\ncode = cli.run(['verify', sys.argv[1]])\n{LOADED}"
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "x.step")], capture_output=True, text=True)
    assert done.stdout == "2 []\n" and done.stderr.count("\n") == 1
