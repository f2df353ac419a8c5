"""A lens cut in (u, v): the same faces, edges that lie on all they bound, and the volume that calculus finds."""

from collections import Counter
from dataclasses import replace

import cadquery as cq
import numpy as np
import pytest
import torch
from OCP.BRepAdaptor import BRepAdaptor_Curve
from OCP.BRepGProp import BRepGProp
from OCP.GProp import GProp_GProps
from OCP.TopAbs import TopAbs_EDGE, TopAbs_Orientation
from OCP.TopExp import TopExp_Explorer
from OCP.TopoDS import TopoDS
from OCP.TopTools import TopTools_IndexedMapOfShape

from bstcad.cad import step_writing
from bstcad.cad.solid import lens_solid
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere, sag
from bstcad.step_text import part21
from tests import suite
from tests.exact_volume import exact_volume
from tests.lenses import net, rough

HOLES = [(2.0, 1.5, 0.8), (-2.2, 1.0, 0.5), (0.3, -2.0, 1.1)]  # x, y, diameter (mm)


def waves(m=17, seed=3, z=4.0, half=(5.0, 4.0)):
    """A net with relief on the scale of its cells, no symmetry, and as smooth as lenses are."""
    (a, b), noise = half, rough(1e-3, seed, m=m).heights
    return net(
        lambda x, y: 0.3 * torch.sin(3 * x / a + 0.5) * torch.cos(2 * y / b) + 0.1 * x / a * y / b + noise, z, m, half
    )


FRONTS = {
    "plane": Plane(0.0),
    "convex": Sphere(0.0, -0.03),
    "concave": Sphere(-0.5, 0.04),
    "nearly flat": Sphere(0.0, 1e-5),
    "conic": Conic(0.0, 0.05, -1.3),
    "freeform": waves(13, 5, 0.0),
}


def plate(front="plane"):
    return Lens.between(FRONTS[front], waves(), Rectangle(10.0, 8.0), 1.5)


def stadium(spline=True):
    """A straight side, a side that is an arc, one that is a spline or an arc inwards, and a slanted line."""
    pen = cq.Workplane("XY").moveTo(-4, -3).lineTo(3.5, -3).threePointArc((4.4, 0), (3.4, 2.9))
    if not spline:
        return pen.threePointArc((0, 2.2), (-3.6, 3.1)).close().wires().val()
    return pen.spline([(1.5, 3.6), (-1, 2.8), (-3.6, 3.1)], includeCurrent=True).close().wires().val()


def uses(solid):
    """Return for each edge (by its number) the directions in which faces use it; a seam has both."""
    found, known = {}, TopTools_IndexedMapOfShape()
    for face in solid.Faces():
        edges = TopExp_Explorer(face.wrapped, TopAbs_EDGE)
        while edges.More():
            forward = edges.Current().Orientation() == TopAbs_Orientation.TopAbs_FORWARD
            found.setdefault(known.Add(edges.Current()), []).append(forward)
            edges.Next()
    return found


def worst_gap(solid, places=301):
    """Largest distance (mm) of an edge's curve from its image in a face's parameter plane."""
    worst = 0.0
    for face in solid.Faces():
        for edge in face.Edges():
            curve, image = BRepAdaptor_Curve(edge.wrapped), BRepAdaptor_Curve(edge.wrapped, face.wrapped)
            for t in np.linspace(curve.FirstParameter(), curve.LastParameter(), places).tolist():
                worst = max(worst, curve.Value(t).Distance(image.Value(t)))
    return worst


def volume_under(lens, x0, y0, radius):
    """∫∫ (back - front) over a disc by polar Gauss points (mm³), sharing nothing with OCC."""
    r, w = np.polynomial.legendre.leggauss(160)
    r, w = radius * (r + 1) / 2, radius * w / 2
    turn = np.arange(720) * 2 * np.pi / 720
    x, y = x0 + r[:, None] * np.cos(turn), y0 + r[:, None] * np.sin(turn)
    return float((w * r) @ (sag(lens.back, x, y) - sag(lens.front, x, y)).sum(axis=1)) * 2 * np.pi / 720


def occ_volume(solid, to=1e-6):
    """Integrate the volume by OCC (mm³), nearly as exactly as it can, or to a given relative error."""
    found = GProp_GProps()
    BRepGProp.VolumePropertiesGK_s(solid.wrapped, found, to)
    return found.Mass()


@pytest.mark.parametrize("front", suite.in_turns(FRONTS, 2))
def test_it_is_a_closed_solid_whose_edges_lie_on_all_they_bound(front, tmp_path):
    lens = plate(front)
    solid = lens_solid(lens, stadium(), [*HOLES, cq.Workplane("XY").center(-1, 0).rect(0.6, 0.9).wires().val()])
    assert solid.isValid() and Counter(map(tuple, map(sorted, uses(solid).values()))) == {
        (False, True): 3 * (4 + 3 * 2 + 4)  # front, back and rising: of the rim, of circles in halves, of the window
    }
    assert worst_gap(solid) < 1e-7
    path = tmp_path / "cut.step"
    step_writing.write(solid, path, "cut")
    text, again = part21.read(path), cq.importers.importStep(str(path)).val()
    assert again.isValid() and len(again.Faces()) == len(solid.Faces()) == 2 + 4 + 6 + 4
    assert again.Volume() == pytest.approx(solid.Volume(), rel=1e-9)
    assert text.closed and (text.solids, text.faces) == (1, 2 + 4 + 6 + 4)
    assert np.abs(text.surface.control_points - lens.back.control_points()).max() < 1e-11  # the design's own net


@pytest.mark.parametrize("front", suite.in_turns(FRONTS, 2))
def test_its_volume_is_that_of_calculus(front):
    """A wall that looked inwards would add volume instead of taking it away."""
    lens = plate(front)
    disc = cq.Workplane("XY").circle(3.5).wires().val()
    solid = lens_solid(lens, disc, HOLES)
    wanted = volume_under(lens, 0.0, 0.0, 3.5) - sum(volume_under(lens, x, y, d / 2) for x, y, d in HOLES)
    assert occ_volume(solid) == pytest.approx(wanted, rel=2e-6)


def test_without_wires_it_is_the_lens_itself():
    """Cut along its own outline, too."""
    own = {"rectangle": rectangle(10, 8), "circle": cq.Workplane("XY").circle(3.0).wires().val()}
    for lens in (plate("convex"), replace(plate("convex"), outline=Circle(3.0)).with_back(waves(half=(4.0, 4.0)))):
        for trim in (None, own[lens.outline.shape]):
            assert occ_volume(lens_solid(lens, trim)) == pytest.approx(exact_volume(lens), rel=2e-6)


def test_a_wire_of_one_closed_edge():
    """An ellipse of the half axes 3 and 2 mm, whose area says how much of a plate it cuts out."""
    flat = plate().with_back(net(z=4.0, half=(5.0, 4.0)))
    ellipse = cq.Workplane("XY").ellipse(3, 2).wires().val()
    solid = lens_solid(flat, ellipse, [cq.Workplane("XY").ellipse(0.5, 0.4).wires().val()])
    assert solid.isValid() and worst_gap(solid) < 1e-7
    assert occ_volume(solid) == pytest.approx(np.pi * (6 - 0.2) * 4.0, rel=1e-8)


def test_the_direction_of_a_wire_does_not_matter():
    lens, wire = plate(), stadium()
    back = cq.Wire(TopoDS.Wire_s(wire.wrapped.Reversed()))
    assert lens_solid(lens, back).Volume() == pytest.approx(lens_solid(lens, wire).Volume(), rel=1e-12)
    hole = cq.Wire.makeCircle(0.4, cq.Vector(1, 1, 7), cq.Vector(0, 0, -1))
    assert lens_solid(lens, wire, [hole]).Volume() == pytest.approx(
        lens_solid(lens, wire, [(1.0, 1.0, 0.8)]).Volume(), rel=1e-12
    )


def rectangle(width, height, x=0.0, y=0.0):
    return cq.Workplane("XY").center(x, y).rect(width, height).wires().val()


def polygon(*places):
    return cq.Wire.makePolygon([cq.Vector(x, y, 0) for x, y in places], close=True)


FAULT, OPEN, NO_WIRE = "trim or holes: {} near .*; draw wires", "a wire is open", "is not one closed wire"
CROSSED, TOUCHED = FAULT.format(".*self-intersection"), FAULT.format("wires touch")
PLATE = rectangle(6, 5)


@pytest.mark.parametrize(
    "trim, holes, words",
    [
        (rectangle(11, 5), [], "trim: the wire leaves the lens at"),
        (polygon((-3, -2), (3, 2), (3, -2), (-3, 2)), [], CROSSED),
        (polygon((-3, -2), (0, 0), (3, -2), (3, 2), (0, 0), (-3, 2)), [], CROSSED),
        (polygon((-3, -2), (3, -2), (3, 2), (4, 3), (3, 2), (-3, 2)), [], CROSSED),
        (polygon((-3, -2), (3, -2), (3, 2), (0, -2 + 1e-7), (-3, 2)), [], TOUCHED),
        (PLATE, [(2.9, 0.0, 1.0)], CROSSED),
        (PLATE, [rectangle(1, 1, 2.5)], CROSSED),
        (PLATE, [rectangle(1, 1, 2.5 - 1e-7)], TOUCHED),
        (PLATE, [(0.0, 0.0, 1.0), (0.0, 0.0, 1.0)], CROSSED),
        (PLATE, [(0.0, 0.0, 1.0), (4.0, 0.0, 0.5)], FAULT.format("hole lies outside the rim")),
        (PLATE, [(0.0, 0.0, 2.0), (0.1, 0.0, 0.5)], FAULT.format("holes are nested")),
        (PLATE, [(0.0, 0.0, 0.0)], "hole 1: the diameter is 0 mm"),
        (PLATE, [(0.0, 1.0)], r"hole 1: \(0.0, 1.0\) is not \(x, y, diameter\); give"),
        (PLATE, (0.0, 0.0, 1.0), f"hole 1: float {NO_WIRE}"),
        (PLATE, [(0.0, float("nan"), 1.0)], "hole 1: .* give three numbers"),
        ("a wire", [], f"trim: str {NO_WIRE}"),
        (cq.Workplane("XY").rarray(3, 3, 2, 2).circle(1), [], "trim: a Workplane of 4 objects is not one"),
        (cq.Face.makePlane(3, 3), [], f"trim: Face {NO_WIRE}"),
        (cq.Edge.makeLine(cq.Vector(0, 0, 0), cq.Vector(1, 0, 0)), [], OPEN),
        (cq.Wire.makePolygon([cq.Vector(*p) for p in ((-3, -2, 0), (3, 2, 0), (3, -2, 0))]), [], OPEN),
        (cq.Wire.makePolygon([cq.Vector(*p) for p in ((-3, -2, 0), (3, -2, 0), (0, 2, 1))], close=True), [],
         "is not parallel to the plane z = 0"),
    ],
)  # fmt: skip
def test_what_cannot_be_cut_is_one_sentence(trim, holes, words):
    with pytest.raises(ValueError, match=words) as refused:
        lens_solid(plate(), trim, holes)
    assert "\n" not in str(refused.value)
