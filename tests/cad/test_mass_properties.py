"""Area, volume and centroid of lenses and parts: closed forms, laws, the exact integral, and OCC's own."""

from __future__ import annotations

from dataclasses import replace

import cadquery as cq
import numpy as np
import pytest
import torch
from OCP.BRepGProp import BRepGProp
from OCP.GProp import GProp_GProps

from bstcad.cad.draft import Draft
from bstcad.cad.mass_properties import MassProperties, exact_volume, of_lens
from bstcad.cad.mounting import Placed, mounted
from bstcad.cad.solid import lens_solid
from bstcad.cad.solid_properties import of_solid
from bstcad.cad.trimming import named_solid
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.surfaces import Conic, Plane, Sphere
from tests.cad.test_mounting import disc
from tests.cad.test_trimming import plate, stadium

R, EDGE = 30.0, 4.0  # mm


def values(found):
    return [found.area, found.volume, *found.centroid]


def by_occ(shape, precise=1e-7):
    """As OCC integrates: for small nets, since 17 x 17 control points take seconds and 65 x 65 a minute."""
    solid, surface = GProp_GProps(), GProp_GProps()
    BRepGProp.VolumePropertiesGK_s(shape.wrapped, solid, precise, False, False, True)
    BRepGProp.SurfaceProperties_s(shape.wrapped, surface, precise)
    return MassProperties(surface.Mass(), solid.Mass(), solid.CentreOfMass().Coord())


def flat(outline, z=20.0, half=12.0):
    heights = torch.zeros(9, 9, dtype=torch.float64)
    return BSplineSurface(z, heights, *((-half, half),) * 2)


def cut(lens, *given):
    """Of a lens cut to a wire, with holes."""
    return of_solid(named_solid(lens, *given)[0])


def disc_wire(radius, x=0.0, y=0.0):
    return cq.Workplane("XY").center(x, y).circle(radius).wires().val()


# ---- bare lenses ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("outline", [Circle(7.0), Rectangle(24.0, 24.0)], ids=lambda outline: outline.shape)
def test_a_slab(outline):
    lens = Lens(Plane(8.0), flat(outline), outline, 1.5)
    rim = 2 * np.pi * 7 if outline.shape == "circle" else 96.0
    wanted = [2 * outline.area + rim * 12, outline.area * 12, 0, 0, 14.0]
    assert values(of_lens(lens)) == pytest.approx(wanted, rel=1e-12, abs=1e-12)
    assert values(of_solid(lens_solid(lens))) == pytest.approx(wanted, rel=1e-9, abs=1e-9)
    assert exact_volume(lens) == pytest.approx(wanted[1], rel=1e-14)


@pytest.mark.parametrize("curvature", [0.1, -0.1, 0.01])
def test_a_spherical_front_takes_away_a_cap(curvature):
    """A cap of height s on a sphere of radius R holds pi s² (3R - s) / 3."""
    radius, a = 1 / abs(curvature), 7.0
    s = radius - np.sqrt(radius**2 - a**2)
    removed = np.pi * a * a * s - np.pi * s * s * (3 * radius - s) / 3  # between the vertex plane and the sphere
    lens = Lens(Sphere(8.0, curvature), flat(Circle(a)), Circle(a), 1.5)
    assert exact_volume(lens) == pytest.approx(np.pi * a * a * 12 - np.sign(curvature) * removed, rel=1e-13)


def test_a_weak_sphere_over_a_rectangle_is_its_parabola():
    """∫∫ c r²/2 = c/2 · w h (w² + h²) / 12; the next term, c³ r⁴/8, is 1e-10 of that."""
    c, w, h = 1e-7, 24.0, 24.0
    taken = 8 * w * h - exact_volume(Lens(Sphere(0.0, c), flat(None, 8.0), Rectangle(w, h), 1.5))
    assert taken == pytest.approx(c / 2 * w * h * (w * w + h * h) / 12, rel=1e-7)  # the digits that are left


def test_a_half_ball_has_its_centroid_at_three_eighths():
    """Nearly: a ball of R = 10 cut at 9.9; V and V c by the formulas of the spherical segment."""
    radius, a = 10.0, 9.9
    s = radius - np.sqrt(radius**2 - a**2)
    lens = Lens(Sphere(0.0, 1 / radius), flat(Circle(a), s + 1.0), Circle(a), 1.5)  # a bowl of glass, 1 mm of rim
    cap, disc_ = np.pi * s * s * (3 * radius - s) / 3, np.pi * a * a
    below = 3 * (2 * radius - s) ** 2 / (4 * (3 * radius - s))  # the cap's centroid, from the ball's centre
    found = of_lens(lens)
    assert found.volume == pytest.approx(cap + disc_, rel=1e-12)
    assert found.centroid[2] == pytest.approx((cap * (radius - below) + disc_ * (s + 0.5)) / (cap + disc_), rel=1e-10)
    assert found.area == pytest.approx(2 * np.pi * radius * s + disc_ + 2 * np.pi * a, rel=1e-9)


@pytest.mark.parametrize(("outline", "front"), [
    (Rectangle(24.0, 20.0), Plane(8.0)), (Rectangle(24.0, 20.0), Conic(8.0, 0.02, -1.2)),
    (Circle(12.0), Sphere(8.0, 0.03)),
], ids=["block", "conic", "round"])  # fmt: skip
def test_four_ways_find_the_same(make_lens, outline, front):
    """Own surfaces, the solid's faces, OCC, and the exact integral of the volume; an edge of OCC's is good to 1e-8."""
    lens = make_lens(front, outline, m=7)
    own, solid = of_lens(lens), lens_solid(lens)
    assert own.volume == pytest.approx(exact_volume(lens), rel=1e-9)
    assert values(of_solid(solid)) == pytest.approx(values(own), rel=1e-8, abs=1e-7)
    assert values(by_occ(solid)) == pytest.approx(values(own), rel=2e-7, abs=2e-7)


@pytest.mark.parametrize("outline", [Rectangle(24.0, 20.0), Circle(12.0)], ids=lambda outline: outline.shape)
def test_a_large_rough_net(make_lens, outline):
    lens = make_lens(Sphere(8.0, 0.02), outline, m=129, ripple=1e-2)
    own = of_lens(lens)
    assert own.volume == pytest.approx(exact_volume(lens), rel=1e-9)
    assert values(of_solid(lens_solid(lens))) == pytest.approx(values(own), rel=1e-8, abs=1e-7)


def test_the_place_on_the_axis_only_moves_the_centroid(make_lens):
    lens = make_lens(outline=Circle(12.0), m=9)
    far = Lens(lens.front.moved(1e4), lens.back.moved(lens.back.z - lens.front.z + 1e4), lens.outline, 1.5)
    here, there = of_lens(lens), of_lens(far)
    assert there.area == pytest.approx(here.area, rel=1e-12)
    assert there.centroid[2] - 1e4 == pytest.approx(here.centroid[2] - 8.0, abs=1e-8)


# ---- cut lenses ----------------------------------------------------------------------------------------------------


def plano_convex(a):
    """A square lens whose front is a ball of the radius R; its flat back stands EDGE behind the rim of a disc of a."""
    sag = R - np.sqrt(R * R - a * a)
    return Lens(Sphere(3.0, 1 / R), flat(None, 3.0 + sag + EDGE), Rectangle(24.0, 24.0), 1.5), sag


def test_a_plano_convex_lens_cut_round():
    """Cap and cylinder: V = π s (3 a² + s²) / 6 + π a² e, A = 2 π R s + π a² + 2 π a e."""
    a = 9.0
    lens, s = plano_convex(a)
    found = cut(lens, disc_wire(a))
    cap, plate_ = np.pi * s * (3 * a * a + s * s) / 6, np.pi * a * a * EDGE
    in_cap = R - 3 * (2 * R - s) ** 2 / (4 * (3 * R - s))  # of its centroid from the vertex
    assert found.area == pytest.approx(2 * np.pi * R * s + np.pi * a * a + 2 * np.pi * a * EDGE, rel=1e-8)
    assert found.volume == pytest.approx(cap + plate_, rel=1e-8)
    z = 3.0 + (cap * in_cap + plate_ * (s + EDGE / 2)) / (cap + plate_)
    assert found.centroid == pytest.approx((0.0, 0.0, z), abs=1e-7)


def test_a_hole_through_its_middle_is_napkin_ring_s():
    """Of a hole of radius b the ball's part is 2 π (R³ - (R² - b²)^1.5) / 3 less the cylinder below its rim."""
    lens, s = plano_convex(9.0)
    b = 2.0
    whole, drilled = (cut(lens, disc_wire(9.0), holes) for holes in ((), [(0.0, 0.0, 2 * b)]))
    over_rim = 2 * np.pi / 3 * (R**3 - (R * R - b * b) ** 1.5) - np.pi * b * b * (R - s)
    assert whole.volume - drilled.volume == pytest.approx(over_rim + np.pi * b * b * EDGE, rel=1e-8)
    small = R - np.sqrt(R * R - b * b)
    gone = 2 * np.pi * R * small + np.pi * b * b  # of front and back; the hole's wall comes instead
    assert whole.area - drilled.area == pytest.approx(gone - 2 * np.pi * b * (s - small + EDGE), rel=1e-8)


def test_a_slanted_plate_out_of_the_middle():
    """Between z = 0 and z = 4 + x/4 over an ellipse: V = π a b h, x of the centroid a² / (16 h), A of two ellipses."""
    x = torch.linspace(-12, 12, 9, dtype=torch.float64)
    back = replace(flat(None, 4.0), heights=(x[:, None] / 4).expand(9, 9).contiguous())
    a, b, p, q = 3.0, 2.0, 1.0, -2.0
    wire = cq.Workplane("XY").center(p, q).ellipse(a, b).wires().val()
    found = cut(Lens(Plane(0.0), back, Rectangle(24.0, 24.0), 1.5), wire)
    h, slab = 4 + p / 4, np.pi * a * b
    assert found.volume == pytest.approx(slab * h, rel=1e-8)
    assert found.centroid[:2] == pytest.approx((p + a * a / 16 / h, q), abs=1e-7)
    t = np.linspace(0, 2 * np.pi, 513)[:-1]
    wall = (h + a * np.cos(t) / 4) * np.hypot(a * np.sin(t), b * np.cos(t))
    assert found.area == pytest.approx(slab * (1 + np.sqrt(17) / 4) + wall.mean() * 2 * np.pi, rel=1e-8)


def test_what_a_hole_takes_and_what_it_leaves_are_the_whole():
    lens, hole = plate("freeform"), (1.0, -0.5, 2.4)
    whole, rest, plug = cut(lens, stadium()), cut(lens, stadium(), [hole]), cut(lens, disc_wire(1.2, 1.0, -0.5))
    assert rest.volume + plug.volume == pytest.approx(whole.volume, rel=1e-8)
    moment = rest.volume * np.array(rest.centroid) + plug.volume * np.array(plug.centroid)
    assert moment == pytest.approx(whole.volume * np.array(whole.centroid), abs=1e-5)


# ---- bodies --------------------------------------------------------------------------------------------------------

BODIES = {  # walls of every kind that is known: planes, cones, tori, spheres, cylinders across, extruded splines
    "chamfered": lambda: disc(1.2, 2.5).faces(">Z").edges().chamfer(0.3),
    "rounded": lambda: disc(1.2, 2.5).edges().fillet(0.3),
    "drilled across": lambda: disc(1.0, 3.0).faces(">Z").workplane().center(8, 0).sphere(0.5, combine="cut")
    .cut(cq.Workplane("XZ").center(-8, 2).circle(0.4).extrude(20, both=True)),
    "a spline's": lambda: cq.Workplane("XY", origin=(0, 0, 1.2)).moveTo(-9, -8).lineTo(9, -8)
    .spline([(11, 0), (9, 8)], includeCurrent=True).lineTo(-9, 8).close().extrude(1.0),
}  # fmt: skip


@pytest.mark.parametrize("kind", BODIES)
def test_a_lens_in_a_body_is_both(kind):
    """What the body has beside the lens is OCC's, of simple faces alone."""
    lens, body = plate("convex"), BODIES[kind]()
    around = by_occ(body.val().cut(cq.Workplane("XY").box(10, 8, 20).val()))
    found, own = of_solid(mounted(body, [Placed(lens)]).solid), of_lens(lens)
    assert found.volume == pytest.approx(own.volume + around.volume, rel=1e-7)
    moment = own.volume * np.array(own.centroid) + around.volume * np.array(around.centroid)
    assert found.centroid == pytest.approx(moment / found.volume, abs=1e-6)


def test_a_part_elsewhere_is_the_same():
    placed = Placed(plate("freeform"), stadium(spline=False), [(0.5, 0.2, 1.0)])
    here, there = (mounted(disc(1.2, 2.5), [replace(placed, at=at)]).solid for at in ((0, 0, 0), (0.4, -0.3, 0.0)))
    assert of_solid(there).volume == pytest.approx(of_solid(here).volume, rel=1e-8)
    far = values(of_solid(there.translate(cq.Vector(0, 0, 300))))
    assert far == pytest.approx(np.add(values(of_solid(there)), [0, 0, 0, 0, 300]), rel=1e-9)


def test_leaning_walls():
    """Cones, slanted planes and ruled walls."""
    solid = mounted(disc(1.2, 2.5), [Placed(plate("convex"), draft=Draft(2.0))]).solid
    assert of_solid(solid).volume == pytest.approx(by_occ(solid, 1e-4).volume, rel=1e-5)


def test_of_a_body_with_freeform_faces_nothing_is_known():
    wavy = disc(1.0, 2.0).cut(
        cq.Workplane("XZ", origin=(0, 12, 0)).moveTo(-11, 1.8).spline([(-9, 1.7), (-8, 1.9)], includeCurrent=True)
        .lineTo(-8, 3).lineTo(-11, 3).close().twistExtrude(24, 3)
    )  # fmt: skip
    assert of_solid(mounted(wavy, [Placed(plate("convex"))]).solid) is None
