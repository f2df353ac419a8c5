"""Area, volume and centroid of cut and mounted lenses: closed forms, laws, and a second way over the solid's faces."""

from __future__ import annotations

from dataclasses import astuple, replace

import cadquery as cq
import numpy as np
import pytest
import torch

from bstcad.cad.draft import Draft
from bstcad.cad.mounting import Placed, mounted
from bstcad.cad.part_properties import of_mounted, of_placed
from bstcad.cad.solid_properties import of_solid
from bstcad.cad.trimming import named_solid
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.surfaces import Plane, Sphere
from tests.cad.test_mounting import disc
from tests.cad.test_trimming import FRONTS, HOLES, occ_volume, plate, stadium

R, EDGE = 30.0, 2.0  # mm


def values(found):
    return [*astuple(found)[:2], *found.centroid]


def disc_wire(radius, x=0.0, y=0.0):
    return cq.Workplane("XY").center(x, y).circle(radius).wires().val()


def flat_back(z, size=24.0):
    return BSplineSurface(z, torch.zeros(9, 9, dtype=torch.float64), (-size / 2, size / 2), (-size / 2, size / 2))


def plano_convex(a):
    """A square lens whose front is a ball of the radius R; its flat back stands EDGE behind the rim of a disc of a."""
    sag = R - np.sqrt(R * R - a * a)
    return Lens(Sphere(3.0, 1 / R), flat_back(3.0 + sag + EDGE), Rectangle(24.0, 24.0), 1.5), sag


def test_a_plano_convex_lens_cut_round():
    """Cap and cylinder: V = π s (3 a² + s²) / 6 + π a² e, A = 2 π R s + π a² + 2 π a e."""
    a = 9.0
    lens, s = plano_convex(a)
    found = of_placed(Placed(lens, disc_wire(a)))
    cap, plate_ = np.pi * s * (3 * a * a + s * s) / 6, np.pi * a * a * EDGE
    in_cap = R - 3 * (2 * R - s) ** 2 / (4 * (3 * R - s))  # of its centroid from the vertex
    assert found.area == pytest.approx(2 * np.pi * R * s + np.pi * a * a + 2 * np.pi * a * EDGE, rel=1e-12)
    assert found.volume == pytest.approx(cap + plate_, rel=1e-12)
    z = 3.0 + (cap * in_cap + plate_ * (s + EDGE / 2)) / (cap + plate_)
    assert found.centroid == pytest.approx((0.0, 0.0, z), abs=1e-11)


def test_a_hole_through_its_middle_is_napkin_ring_s():
    """Of a hole of radius b the ball's part is 2 π (R³ - (R² - b²)^1.5) / 3 less the cylinder below its rim."""
    lens, s = plano_convex(9.0)
    b = 2.0
    whole, drilled = (of_placed(Placed(lens, disc_wire(9.0), holes)) for holes in ((), [(0.0, 0.0, 2 * b)]))
    over_rim = 2 * np.pi / 3 * (R**3 - (R * R - b * b) ** 1.5) - np.pi * b * b * (R - s)
    assert whole.volume - drilled.volume == pytest.approx(over_rim + np.pi * b * b * EDGE, rel=1e-10)
    small = R - np.sqrt(R * R - b * b)
    gone = 2 * np.pi * R * small + np.pi * b * b  # of front and back; the hole's wall comes instead
    assert whole.area - drilled.area == pytest.approx(gone - 2 * np.pi * b * (s - small + EDGE), rel=1e-10)


def test_a_slanted_plate_out_of_the_middle():
    """Between z = 0 and z = 4 + x/4 over an ellipse: V = π a b h, x of the centroid a² / (16 h), A of two ellipses."""
    x = torch.linspace(-12, 12, 9, dtype=torch.float64)
    back = replace(flat_back(4.0), heights=(x[:, None] / 4).expand(9, 9).contiguous())
    a, b, p, q = 3.0, 2.0, 1.0, -2.0
    wire = cq.Workplane("XY").center(p, q).ellipse(a, b).wires().val()
    found = of_placed(Placed(Lens(Plane(0.0), back, Rectangle(24.0, 24.0), 1.5), wire))
    h, slab = 4 + p / 4, np.pi * a * b
    assert found.volume == pytest.approx(slab * h, rel=1e-9)
    assert found.centroid[:2] == pytest.approx((p + a * a / 16 / h, q), abs=1e-8)
    t = np.linspace(0, 2 * np.pi, 513)[:-1]
    wall = (h + a * np.cos(t) / 4) * np.hypot(a * np.sin(t), b * np.cos(t))
    assert found.area == pytest.approx(slab * (1 + np.sqrt(17) / 4) + wall.mean() * 2 * np.pi, rel=1e-9)


def test_twice_the_size_is_four_times_the_area_and_eight_times_the_volume():
    lens = plate("concave")
    back, front = lens.back, lens.front
    grown = Lens(
        Sphere(2 * front.z, front.curvature / 2),
        BSplineSurface(2 * back.z, 2 * back.heights, *(tuple(2 * end for end in ends) for ends in (back.x, back.y))),
        Rectangle(20.0, 16.0), 1.5,
    )  # fmt: skip
    pen = cq.Workplane("XY").moveTo(-8, -6).lineTo(7, -6).threePointArc((8.8, 0), (6.8, 5.8))
    large = pen.threePointArc((0, 4.4), (-7.2, 6.2)).close().wires().val()
    found = of_placed(Placed(grown, large, [(4.0, 3.0, 1.6)]))
    small = of_placed(Placed(lens, stadium(spline=False), [(2.0, 1.5, 0.8)]))
    assert (found.area, found.volume) == pytest.approx((4 * small.area, 8 * small.volume), rel=1e-12)
    assert np.array(found.centroid) == pytest.approx(2 * np.array(small.centroid), rel=1e-11)


def test_what_a_hole_takes_and_what_it_leaves_are_the_whole():
    lens, hole = plate("freeform"), (1.0, -0.5, 2.4)
    whole = of_placed(Placed(lens, stadium()))
    rest, plug = of_placed(Placed(lens, stadium(), [hole])), of_placed(Placed(lens, disc_wire(1.2, 1.0, -0.5)))
    assert rest.volume + plug.volume == pytest.approx(whole.volume, rel=1e-10)
    moment = rest.volume * np.array(rest.centroid) + plug.volume * np.array(plug.centroid)
    assert moment == pytest.approx(whole.volume * np.array(whole.centroid), abs=1e-7)


@pytest.mark.parametrize("front", FRONTS)
def test_the_faces_of_the_solid_give_the_same(front):
    """By ∮ z n_z dA from the faces and edges of OCC's solid, where the other goes along the wires in a plane."""
    lens, wire = plate(front), stadium(spline=front == "plane")
    solid, _ = named_solid(lens, wire, HOLES)
    assert values(of_solid(solid.wrapped)) == pytest.approx(
        values(of_placed(Placed(lens, wire, HOLES))), rel=2e-8, abs=2e-8
    )


@pytest.mark.parametrize("front, low, high, at", [
    ("convex", 1.2, 2.5, (0.0, 0.0, -0.1)), ("freeform", -2.0, 6.0, (0.4, -0.3, 0.2)), ("plane", 0.0, 1.5, (0.4, 0, 0)),
])  # fmt: skip
def test_so_do_those_of_a_lens_in_its_body(front, low, high, at):
    """Beside the lens, below its front and above its back, and with a plane front in the body's lower face.

    OCC's curves on faces that it has turned right-handed (the chamfer's cones) lie within 1e-6 mm of the exact ones.
    """
    body = disc(low, high).faces(">Z").edges().chamfer(0.3)
    placed = Placed(plate(front), stadium(spline=False), [(0.5, 0.2, 1.0)], at)
    found = mounted(body, [placed])
    assert values(of_mounted(found, [placed])) == pytest.approx(
        values(of_solid(found.solid.wrapped)), rel=2e-8, abs=1e-6
    )


def test_of_a_body_with_freeform_faces_nothing_is_known():
    wavy = disc(1.0, 2.0).cut(
        cq.Workplane("XZ", origin=(0, 12, 0)).moveTo(-11, 1.8).spline([(-9, 1.7), (-8, 1.9)], includeCurrent=True)
        .lineTo(-8, 3).lineTo(-11, 3).close().twistExtrude(24, 3)
    )  # fmt: skip
    placed = Placed(plate("convex"))
    assert of_mounted(mounted(wavy, [placed]), [placed]) is None


def test_below_a_body_of_spheres_leaning_walls_state_nothing():
    """A sphere about the lens's axis is no height over (x, y), as which its faces would be read."""
    placed = Placed(plate("convex"), draft=Draft(1.0))
    found = mounted(disc(1.2, 2.0), [placed])
    whole = of_mounted(found, [placed])
    assert whole.volume == pytest.approx(occ_volume(found.solid), rel=1e-6)
    dome = cq.Workplane("XY").sphere(5.0).val().wrapped
    assert of_mounted(replace(found, body=dome), [placed]) is None
