"""The solid of a bare lens with fronts of every kind: exact, tight, facing out, and the same when read back."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from OCP.BRepAdaptor import BRepAdaptor_Curve
from OCP.Geom2d import Geom2d_Circle
from OCP.ShapeAnalysis import ShapeAnalysis_ShapeTolerance

from bstcad.cad import patches, step_reading, step_writing, walls, wires
from bstcad.cad.patches import back_patch, conic_net, front_patch
from bstcad.cad.solid import image, lens_solid
from bstcad.optics.surfaces.bspline import knots
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere, sag
from bstcad.step_text import part21
from tests import suite
from tests.cad.test_trimming import occ_volume
from tests.exact_volume import exact_volume
from tests.lenses import half_over, lens_of, net

OUTLINES = {"rectangle": Rectangle(24.0, 20.0), "circle": Circle(12.0)}
CONICS = {
    "ellipsoid": Conic(8.0, 0.02, -1 / 2.25),
    "paraboloid": Conic(8.0, -0.03, -1.0),
    "hyperboloid": Conic(8.0, 0.03, -4.0),
    "oblate": Conic(8.0, -0.025, 1.5),
    "long": Conic(8.0, 0.01, -60.0),
    "flat": Conic(8.0, 1e-6, -0.5),
}

CURVATURES = (-1e-9, -5e-5, -0.03, 0.055)  # written as a parabola below about 4e-5
FRONTS = {"level": Plane(8.0), **{f"sphere {c:g}": Sphere(8.0, c) for c in CURVATURES}, **CONICS}


def given_net(outline, m=21):
    """A freeform front as an earlier design's back could be, its vertex at z = 8."""
    given = net(
        lambda x, y: 0.03 * x + 0.01 * x * y + 0.1 * torch.sin(x / 3) * torch.cos(y / 4), 8.0, m, half_over(outline, m)
    )
    return given.from_vertex().moved(8.0)


@pytest.fixture(params=OUTLINES)
def outline(request):
    return OUTLINES[request.param]


@pytest.fixture(params=suite.in_turns([*FRONTS, "net"], 2))
def front(request, outline):
    return given_net(outline) if request.param == "net" else FRONTS[request.param]


@pytest.fixture
def lens(front, outline, make_lens):
    return make_lens(front, outline, m=9)


@pytest.mark.parametrize("name", CONICS)
def test_the_patch_of_a_conic_is_the_conic(name, outline):
    """Points that OCC evaluates all over the patch fulfil c r² - 2 h + (1 + k) c h² = 0."""
    front, (a, b) = CONICS[name], (8.0, 7.0)
    poles, weights = conic_net(front, a, b)
    surface = patches.bspline_surface(poles, np.repeat([-a, a], 3), np.repeat([-b, b], 3), weights)
    points = np.array([surface.Value(u, v).Coord() for u in np.linspace(-a, a, 9) for v in np.linspace(-b, b, 9)])
    x, y, h = points[:, 0], points[:, 1], points[:, 2] - front.z
    c = front.curvature
    residual = c * (x * x + y * y) - 2 * h + (1 + front.conic_constant) * c * h * h
    assert np.abs(residual).max() < 1e-14
    assert np.abs(points[:, 2] - sag(front, x, y)).max() < 1e-13


def test_the_solid_is_valid_tight_of_the_lens_s_volume_and_faces_out(lens):
    solid = lens_solid(lens)
    assert solid.isValid() and solid.ShapeType() == "Solid"
    counts = (6, 12, 8) if isinstance(lens.outline, Rectangle) else (4, 6, 4)
    assert (len(solid.Faces()), len(solid.Edges()), len(solid.Vertices())) == counts
    assert ShapeAnalysis_ShapeTolerance().Tolerance(solid.wrapped, 1) <= 1e-7  # mm, the loosest of all
    assert occ_volume(solid, 1e-7) == pytest.approx(exact_volume(lens), rel=2e-6)  # OCC's own accuracy
    for face in solid.Faces():
        u0, u1, v0, v1 = face._uvBounds()
        normal, point = face.normalAt((u0 + u1) / 2, (v0 + v1) / 2)
        outside, inside = (point + normal * step for step in (0.05, -0.05))  # mm
        assert solid.isInside(inside) and not solid.isInside(outside)


def test_the_borders_lie_on_the_front(lens):
    """Points of the curves in space and in the patch agree, at the same parameter."""
    front, patch = lens.front, front_patch(lens)
    far = 3e-10 if isinstance(front, Sphere) else 0.0  # mm; PARABOLA, and the digits of a far centre
    near = walls.RIM_TOLERANCE if front.is_net and lens.outline.is_round else 1e-11  # mm
    for curve, edge in zip(*borders(front, lens.outline), strict=True):
        border, uv = BRepAdaptor_Curve(edge), image(patch, curve) if patch.uv else None
        for t in np.linspace(0.0, curve.piece.end, 101).tolist():
            point = np.array(border.Value(t).Coord())
            assert abs(point[2] - sag(front, *point[:2])) < near + far
            if uv is not None:
                through = np.array(patch.surface.Value(*uv.Value(t).Coord()).Coord())
                assert np.abs(through - point).max() < near + far


def borders(surface, outline):
    """Curves and edges in which the walls of a bare lens meet a surface."""
    rail = walls.rail_on(surface.plain(), wires.outline_loop(outline))
    return rail.curves, rail.edges


def test_the_borders_of_a_rectangle_s_back_are_the_net_s_own(make_lens):
    lens = make_lens(m=9)
    points, patch = lens.back.control_points(), back_patch(lens)
    sides = [points[:, 0], points[-1], points[::-1, -1], points[0, ::-1]]
    for curve, side in zip(borders(lens.back, lens.outline)[0], sides, strict=True):
        assert np.array_equal(curve.poles, side) and np.array_equal(curve.knots, knots(9))
        ends = image(patch, curve)
        assert (ends.Degree(), ends.NbPoles(), ends.LastParameter()) == (1, 2, 7.0)


def test_the_file_is_sound_and_the_front_is_read_back(lens, tmp_path):
    """OCC reads it, and so does the reader of the text."""
    step_writing.write_lens(lens, tmp_path / "lens.step", "lens")
    reread, text = step_reading.read(tmp_path / "lens.step"), part21.read(tmp_path / "lens.step")
    faces, edges = (6, 12) if isinstance(lens.outline, Rectangle) else (4, 6)
    assert text.closed and (text.solids, text.faces, len(text.edge_uses)) == (1, faces, edges)
    assert (text.unit, text.product) == ("millimetre", "lens") and text.schema.startswith("AP242")
    assert np.abs(reread.control_points - lens.back.control_points()).max() < 1e-11
    off_face, off_wall = step_reading.edge_deviations(reread.shape, lens)
    assert off_face[0] < 5e-8 and off_wall[0] < 5e-8  # mm
    whole = step_reading.lens(reread, lens.index)
    assert whole.outline == lens.outline and exact_volume(whole) == pytest.approx(exact_volume(lens), rel=1e-11)
    front, again = lens.front, reread.front
    assert again.z == pytest.approx(8.0, abs=1e-10 if front.kind == "sphere" else 1e-12)  # of a centre 4e4 mm away
    if front.is_net:
        assert np.abs(again.control_points() - front.control_points()).max() < 1e-11
        assert np.abs(text.front.control_points - front.control_points()).max() < 1e-11
        return
    if front.curvature == 0:
        assert again == Plane(8.0)
        return
    assert again.curvature == pytest.approx(front.curvature, rel=1e-5, abs=1e-13)
    effect = abs(front.curvature) ** 3 * 244.0**2 / 8  # mm at the rim, of a change of the conic constant by 1
    assert effect * abs(again.conic_constant - front.conic_constant) < 1e-11
    x, y = np.random.default_rng(1).uniform(-8.0, 8.0, (2, 200))
    assert np.abs(sag(again, x, y) - sag(front, x, y)).max() < (1e-9 if front.kind == "sphere" else 1e-12)


@pytest.mark.parametrize("front", [Conic(8.0, 0.075, 0.2), Conic(8.0, -0.07, -60.0)])
def test_a_conic_that_turns_too_sharply_is_refused(make_lens, front):
    with pytest.raises(ValueError, match=r"^lens\.front: a conic of constant .*; increase the radius$"):
        front_patch(make_lens(front, OUTLINES["circle"]))


def test_a_patch_of_three_by_three_that_is_no_conic_is_refused(make_lens, tmp_path):
    lens = make_lens(CONICS["ellipsoid"], OUTLINES["rectangle"])
    step_writing.write_lens(lens, tmp_path / "lens.step", "lens")
    text = (tmp_path / "lens.step").read_text()
    weights = re.search(r"RATIONAL_B_SPLINE_SURFACE\s*\(\s*\(\s*\(\s*([\d.]+)", text).group(1)
    altered = f"{float(weights) + 1e-6:.14f}"
    (tmp_path / "lens.step").write_text(text.replace(weights, altered, 1))
    with pytest.raises(ValueError, match="not a conic"):
        step_reading.read(tmp_path / "lens.step")


# ---- edges and rim -------------------------------------------------------------------------------------------------


def written(lens, folder):
    """The shape of a lens, re-read."""
    step_writing.write_lens(lens, folder / "lens.step", "lens")
    return step_reading.read(folder / "lens.step").shape


@pytest.mark.parametrize(
    ("change", "off"),
    [
        (Rectangle(24.0 + 2e-6, 20.0), 1e-6),
        (Rectangle(24.0, 20.0 - 2e-6), 1e-6),
        (Plane(8.0 + 1e-6), 1e-6),
        (Plane(8.0 - 1e-6), 0.0),  # the rim lies between the faces: form and vertex are other checks
    ],
    ids=["wider", "narrower", "front above the rim", "front below the rim"],
)
def test_a_lens_of_another_wall_is_off_by_the_difference(make_lens, tmp_path, change, off):
    lens = make_lens()
    shape = written(lens, tmp_path)
    other = lens.with_front(change) if isinstance(change, Plane) else replace(lens, outline=change)
    (off_faces, _), (off_wall, where) = step_reading.edge_deviations(shape, other)
    assert off_wall == pytest.approx(off, abs=1e-9) and off_faces <= 1e-9 and where.startswith("at (")


def test_a_rim_as_rough_as_they_come_is_followed_as_nearly(make_lens, tmp_path):
    """Heights that jump by half a millimetre from one control point to the next: 32 parts between two knot lines
    leave 4.7e-8 mm."""
    lens = make_lens(Plane(-8.0), Circle(13.0), 129, 0.5)
    (off_faces, _), (off_wall, _) = step_reading.edge_deviations(written(lens, tmp_path), lens)
    assert off_faces <= 2 * walls.RIM_TOLERANCE and off_wall <= 2 * walls.RIM_TOLERANCE


def test_a_round_rim_is_exact_in_the_face_and_tight_in_space(make_lens):
    lens = make_lens(outline=Circle(12.0), m=33)
    patch = back_patch(lens)
    for curve, edge in zip(*borders(lens.back, lens.outline), strict=True):
        uv, rim = image(patch, curve), BRepAdaptor_Curve(edge)
        assert isinstance(uv, Geom2d_Circle)
        for t in np.linspace(0.0, np.pi, 499).tolist():
            q = patch.surface.Value(*uv.Value(t).Coord())
            assert np.hypot(q.X(), q.Y()) == pytest.approx(12.0, abs=1e-12)
            assert rim.Value(t).Distance(q) < 2 * walls.RIM_TOLERANCE


def test_a_lens_that_cannot_be_is_refused_in_one_sentence(make_lens):
    for lens, words in (
        (make_lens(Plane(19.0)), "move the front down"),
        (make_lens(Sphere(0.0, -0.08)), "ends inside the rim"),
        (lens_of(net(half=12.0), Plane(8.0), Circle(12.0)), "two spacings beyond the rim"),
        (lens_of(net(half=(20.0, 24.0)), Plane(8.0), Circle(12.0)), "equal pitches"),
    ):
        with pytest.raises(ValueError, match=words):
            lens_solid(lens)
