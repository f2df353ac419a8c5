"""The solid: closed, valid, oriented, tight, and of the right volume."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from OCP.BRepGProp import BRepGProp
from OCP.GProp import GProp_GProps
from OCP.ShapeAnalysis import ShapeAnalysis_ShapeTolerance

from bstcad.cad import faces, nurbs
from bstcad.cad.mass_properties import exact_volume
from bstcad.cad.solid import lens_solid
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.spline_basis import knots
from bstcad.optics.surfaces import Plane, Sphere

CURVATURES = [0.0, 1e-9, -1e-9, 1e-6, 3e-5, -5e-5, 0.02, -0.03, 0.055]  # parabola below about 4e-5, sphere above
FRONTS = [Plane(8.0), *(Sphere(8.0, c) for c in CURVATURES)]
OUTLINES = [Rectangle(24.0, 20.0), Circle(12.0)]


def occ_volume(solid, accuracy=1e-7):
    """OCC's adaptive volume; the default one is off by 1e-4."""
    properties = GProp_GProps()
    BRepGProp.VolumeProperties_s(solid.wrapped, properties, accuracy)
    return properties.Mass()


@pytest.mark.parametrize("outline", OUTLINES, ids=lambda o: o.shape)
@pytest.mark.parametrize("front", FRONTS, ids=lambda f: f"{f.kind}{getattr(f, 'curvature', '')}")
def test_a_lens_is_one_valid_tight_solid(make_lens, front, outline):
    solid = lens_solid(make_lens(front, outline))
    expected = (6, 12, 8) if isinstance(outline, Rectangle) else (3, 3, 2)
    assert solid.isValid() and solid.ShapeType() == "Solid"
    assert (len(solid.Faces()), len(solid.Edges()), len(solid.Vertices())) == expected
    assert ShapeAnalysis_ShapeTolerance().Tolerance(solid.wrapped, 1) <= 1e-7  # mm, the loosest of all


@pytest.mark.parametrize("outline", OUTLINES, ids=lambda o: o.shape)
@pytest.mark.parametrize("curvature", [0.0, 1e-6, 0.02, -0.03])
def test_volume_is_positive_and_exact(outline, curvature, make_lens):
    lens = make_lens(Sphere(8.0, curvature), outline, m=7)
    assert occ_volume(lens_solid(lens)) == pytest.approx(exact_volume(lens), rel=2e-6)  # OCC's own accuracy


def test_every_face_looks_outwards(make_lens):
    for outline in OUTLINES:
        for front in (Plane(8.0), Sphere(8.0, 1e-6), Sphere(8.0, 0.02), Sphere(8.0, -0.03)):
            solid = lens_solid(make_lens(front, outline))
            for face in solid.Faces():
                u0, u1, v0, v1 = face._uvBounds()
                normal, point = face.normalAt((u0 + u1) / 2, (v0 + v1) / 2)
                outside, inside = (point + normal * step for step in (0.05, -0.05))  # mm
                assert solid.isInside(inside) and not solid.isInside(outside)


def test_poles_and_knots_are_the_design(make_lens):
    lens = make_lens(m=33)
    surface = faces.back_patch(lens).surface
    assert np.array_equal(nurbs.net_of(surface), lens.back.control_points())
    for full in nurbs.knots_of(surface):
        assert np.array_equal(full, knots(33))
    assert (surface.UDegree(), surface.VDegree()) == (2, 2)


@pytest.mark.parametrize("curvature", [1e-9, -2e-5, 5e-5, -0.03, 0.055])
def test_the_front_is_the_sphere_of_the_scene(make_lens, curvature):
    """Every point of the OCC surface obeys z = z0 + c r² / (1 + sqrt(1 - c² r²))."""
    lens = make_lens(Sphere(8.0, curvature))
    patch = faces.front_patch(lens)
    for border in patch.borders.values():
        for t in np.linspace(border.start, border.end, 9):
            p, uv = border.curve.Value(t), border.uv.Value(t)
            q = patch.surface.Value(uv.X(), uv.Y())
            assert p.Distance(q) < 1e-9  # mm
            r2 = torch.tensor(q.X() ** 2 + q.Y() ** 2, dtype=torch.float64)
            z = lens.front.sag_and_slope(r2.sqrt(), torch.zeros_like(r2))[0]
            assert q.Z() == pytest.approx(float(z), abs=3e-10)  # mm; PARABOLA and the digits of a far centre


def test_a_round_rim_is_exact_in_the_face_and_tight_in_space(make_lens):
    lens = make_lens(outline=Circle(12.0), m=33)
    patch = faces.back_patch(lens)
    rim = patch.borders["rim"]
    for t in np.linspace(0.0, 2 * np.pi, 997):
        uv, on_cylinder, p = rim.uv.Value(t), rim.around.Value(t), rim.curve.Value(t)
        q = patch.surface.Value(uv.X(), uv.Y())
        assert np.hypot(q.X(), q.Y()) == pytest.approx(12.0, abs=1e-12)
        assert p.Distance(q) < 2 * faces.RIM
        assert on_cylinder.X() == pytest.approx(t, abs=1e-12)
        assert on_cylinder.Y() == pytest.approx(p.Z(), abs=1e-12)


def test_float32_heights_make_the_same_solid_as_their_float64_values(make_lens):
    lens = make_lens(m=9)
    single = Lens(lens.front, lens.back.to(torch.float32), lens.outline, lens.index)
    same = Lens(lens.front, single.back.to(torch.float64), lens.outline, lens.index)
    assert exact_volume(single) == exact_volume(same)
    assert lens_solid(single).isValid()


def test_a_lens_that_cannot_be_is_refused_in_one_sentence(make_lens):
    with pytest.raises(ValueError, match="move the front down"):
        lens_solid(make_lens(Plane(19.0)))
    with pytest.raises(ValueError, match="ends inside the lens's rim"):
        lens_solid(make_lens(Sphere(0.0, -0.08)))
    narrow = BSplineSurface(20.0, torch.zeros(17, 17), (-12.0, 12.0), (-12.0, 12.0))
    with pytest.raises(ValueError, match="two spans past the rim"):
        lens_solid(Lens(Plane(8.0), narrow, Circle(12.0), 1.5))
    oblong = BSplineSurface(20.0, torch.zeros(17, 17), (-20.0, 20.0), (-24.0, 24.0))
    with pytest.raises(ValueError, match="square net"):
        lens_solid(Lens(Plane(8.0), oblong, Circle(12.0), 1.5))
