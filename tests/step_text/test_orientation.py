"""Every sense flag of a written lens is right, and each one turned is named."""

from __future__ import annotations

import math
import re

import cadquery as cq
import pytest

from bstcad.cad import step_writing
from bstcad.cad.draft import Draft
from bstcad.cad.solid import lens_solid
from bstcad.cad.trimming import trimmed_solid
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


def face_turned(text, face):
    flip = re.compile(rf"(#{face} = ADVANCED_FACE\([^;]*)\.([TF])\.\);")
    return flip.sub(lambda hit: f"{hit[1]}.{'FT'[hit[2] == 'F']}.);", text)


def test_a_written_lens_has_none_turned(text):
    assert turned(text) == ()


def test_each_face_turned_is_named(text):
    faces = re.findall(r"#(\d+) = ADVANCED_FACE\(", text)
    for face in faces:
        assert turned(face_turned(text, face)) == (f"face #{face}",)


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


CUT_FRONTS = [Plane(8.0), Sphere(8.0, 0.02), Sphere(8.0, -0.03)]


def halves(x, y, a, b):
    """An ellipse as a wire of two arcs, begun off its axes."""
    ends = ((20, 200), (200, 380))
    return cq.Wire.assembleEdges([cq.Edge.makeEllipse(a, b, cq.Vector(x, y, 0), angle1=p, angle2=q) for p, q in ends])


def a_bean():
    """Straight sides, an arc inwards, and a spline."""
    pen = cq.Workplane("XY").moveTo(-8, -6).lineTo(7, -6).threePointArc((5, 0), (7, 6))
    return pen.spline([(3, 7.5), (-2, 5), (-8, 6)], includeCurrent=True).close().wires().val()


@pytest.fixture(params=CUT_FRONTS, ids=str)
def cut(request, make_lens):
    """Lenses with walls of every kind, around the lens and around holes."""
    lens = make_lens(request.param, Rectangle(24.0, 20.0), m=9)
    holes = [(2.0, 1.5, 2.0), halves(-4, 1, 1.5, 0.8), cq.Workplane("XY").center(-1, -3).rect(1.6, 0.9).wires().val()]
    wanted = (a_bean(), holes), (halves(0, 0, 9, 7), []), (None, holes)
    return [step_writing.encode(trimmed_solid(lens, trim, of), "lens").decode() for trim, of in wanted]


def test_a_cut_lens_is_judged_like_a_whole_one(cut):
    """Walls of holes look inwards; a wall may stand on either side of the axis."""
    for text in cut:
        found = part21.parse(text)
        assert found.turned == () and found.closed
    assert "SURFACE_OF_LINEAR_EXTRUSION" in cut[0] and "SURFACE_OF_LINEAR_EXTRUSION" in cut[1]
    assert "CYLINDRICAL_SURFACE" in cut[0]


def test_each_face_of_a_cut_lens_turned_is_named(cut):
    for face in re.findall(r"#(\d+) = ADVANCED_FACE\(", cut[0]):
        assert turned(face_turned(cut[0], face)) == (f"face #{face}",)


def test_each_leaning_wall_turned_is_named(make_lens):
    """Planes, cones around and inwards, and ruled bevels."""
    r = math.sqrt(2)
    pen = cq.Workplane("XY").moveTo(-8, -6).lineTo(8, -6).lineTo(8, 4).threePointArc((6 + r, 4 + r), (6, 6))
    arcs = pen.lineTo(2, 6).threePointArc((2 - r, 4 + r), (0, 4)).threePointArc((-2, 2), (-4, 4))
    arcs = arcs.threePointArc((-6, 6), (-8, 4))
    lens = make_lens(Sphere(8.0, 0.02), Rectangle(24.0, 20.0), m=9)
    solid = trimmed_solid(lens, arcs.close().wires().val(), draft=Draft(3.0, 0.2))
    text = step_writing.encode(solid, "lens").decode()
    assert turned(text) == () and text.count("CONICAL_SURFACE(") == 4
    faces = re.findall(r"#(\d+) = ADVANCED_FACE\(", text)
    for face in faces:  # all of them, in one
        text = face_turned(text, face)
    assert set(turned(text)) == {f"face #{face}" for face in faces}


def test_a_shell_inside_out_is_seen_at_the_back(make_lens):
    """All faces, and with them all loops, turned: each face agrees with its neighbours and with its loop."""
    text = step_writing.encode(lens_solid(make_lens(m=9)), "lens").decode()
    faces = re.findall(r"#(\d+) = ADVANCED_FACE\(", text)
    for face in faces:
        text = face_turned(text, face)
    text = re.sub(r"(FACE_BOUND\('',#\d+,)\.T\.\)", r"\1.F.)", text)
    assert part21.parse(text).closed and turned(text) == (f"face #{faces[0]}",)
