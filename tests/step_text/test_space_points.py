"""The compiled loop takes what the pattern takes, and reads each number as Python does."""

from __future__ import annotations

import random
import re

import numpy as np
import pytest

from bstcad.step_text.space_points import take
from bstcad.step_text.syntax import NAME, REAL

POINT = re.compile(rf"(?<=;)#({NAME})=CARTESIAN_POINT\('',\(({REAL},{REAL},{REAL})\)\);")
NUMBERS = (
    "0.", "-0.0000000000000000E+00", "12.98765420664180", "-99.99999999999999", "123.45678901234567", "+1.E-5",
    "9007199254740993.", "0.1", "4.9406564584124654E-324", "1.7976931348623157E+308", "1.E+309", "3.0E22", "7.E-23",
    "0.00000000000000000000001", "100000000000000000000000.5", "5.0000000000000000000000001E-01",
)  # fmt: skip
WRONG = ("", "1", ".5", "1.0E", "1.0e5", "--1.", "1..", "1.0E+", "nan", "1.0.0", " 1.")


def pattern(text):
    """The same by the pattern."""
    parts = POINT.split(text)
    values = [[float(value) for value in body.split(",")] for body in parts[2::3]]
    return [int(name) for name in parts[1::3]], np.array(values).reshape(-1, 3), "".join(parts[::3])


def same(text):
    numbers, xyz, rest = take(text)
    wanted, values, left = pattern(text)
    assert numbers.tolist() == wanted and rest == left
    assert xyz.tobytes() == values.tobytes()  # to the last bit, and the sign of zero
    return len(wanted)


def test_each_number_is_read_as_python_reads_it():
    points = (f"#{k + 1}=CARTESIAN_POINT('',({value},-1.5,{value}));" for k, value in enumerate(NUMBERS))
    assert same(";" + "".join(points)) == len(NUMBERS)


def test_digits_by_chance():
    chance = random.Random(1)
    values = [chance.uniform(-1, 1) * 10 ** chance.uniform(-8, 8) for _ in range(3000)]
    formats = ("%.16E", "%.14f", "%.17g.", "%.3f")
    values = [re.sub(r"(e.*)?\.$", ".", chance.choice(formats) % value) for value in values]
    values = [value if re.fullmatch(REAL, value) else "0.5" for value in values]
    assert (
        same(";" + "".join(f"#{k + 1}=CARTESIAN_POINT('',({','.join(values[k : k + 3])}));" for k in range(2998)))
        > 2900
    )


@pytest.mark.parametrize("value", WRONG)
def test_what_is_no_number_makes_no_point(value):
    assert same(f";#1=CARTESIAN_POINT('',(0.,1.,{value}));#2=CARTESIAN_POINT('',(0.25,1.,2.));") == 1


def test_a_text_with_a_letter_changed_or_gone():
    chance = random.Random(2)
    whole = ";#12=CARTESIAN_POINT('',(1.5,-2.25E-3,0.));#123456789012345678=CARTESIAN_POINT('',(0.,0.,1.));#7=X(#12);"
    for _ in range(3000):
        at = chance.randrange(len(whole))
        same(whole[:at] + chance.choice(["", *";#0(),.'E-=+C²"]) + whole[at + chance.randrange(3) :])
    for end in range(len(whole)):
        same(whole[:end])
