"""Every sense flag of a written lens is right, and each one turned is named."""

from __future__ import annotations

import re

import pytest

from bstcad.cad import step_writing
from bstcad.cad.solid import lens_solid
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.surfaces import Plane, Sphere
from bstcad.step_text import part21

OUTLINES = [Rectangle(24.0, 20.0), Circle(12.0)]
FRONTS = [Plane(8.0), Sphere(8.0, 0.02), Sphere(8.0, -0.06), Sphere(8.0, 1e-6), Sphere(8.0, -5e-5)]  # a deep bowl too


@pytest.fixture(params=OUTLINES, ids=lambda outline: outline.shape)
def outline(request):
    return request.param


@pytest.fixture(params=FRONTS, ids=str)
def text(request, make_lens, outline):
    return step_writing.encode(lens_solid(make_lens(request.param, outline, m=9)), "lens").decode()


def turned(text):
    return part21.parse(text).turned


def test_a_written_lens_has_none_turned(text):
    assert turned(text) == ()


def test_each_face_turned_is_named(text):
    faces = re.findall(r"#(\d+) = ADVANCED_FACE\(", text)
    for face in faces:
        flip = re.compile(rf"(#{face} = ADVANCED_FACE\([^;]*)\.([TF])\.\);")
        altered = flip.sub(lambda hit: f"{hit[1]}.{'FT'[hit[2] == 'F']}.);", text)
        assert turned(altered) == (f"face #{face}",)


def test_each_edge_turned_is_named(text, outline):
    """A closed rim apart, which begins where it ends."""
    found = re.findall(r"(#(\d+) = EDGE_CURVE\('',#(\d+),#(\d+),#\d+,)\.T\.", text)
    edges = [(line, name) for line, name, first, second in found if first != second]
    assert len(edges) == (12 if isinstance(outline, Rectangle) else 1)
    for line, name in edges:
        assert turned(text.replace(f"{line}.T.", f"{line}.F.")) == (f"edge #{name}",)


def test_a_loop_out_of_order_is_named(make_lens):
    text = step_writing.encode(lens_solid(make_lens(m=9)), "lens").decode()
    loop, first, second = re.search(r"#(\d+) = EDGE_LOOP\('',\((#\d+),(#\d+),", text).groups()
    altered = text.replace(f"EDGE_LOOP('',({first},{second},", f"EDGE_LOOP('',({second},{first},", 1)
    assert turned(altered) == (f"loop #{loop}",)
