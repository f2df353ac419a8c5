"""Area, volume and centroid of lenses and parts: closed forms, laws, the exact integral, and OCC's own."""

from __future__ import annotations

import cadquery as cq
import numpy as np
import pytest
from OCP.BRepGProp import BRepGProp
from OCP.GProp import GProp_GProps

from bstcad.cad.mounting import PlacedLens, mounted, wire
from bstcad.cad.solid import lens_solid, named_solid
from bstcad.cad.solid_properties import of_solid
from bstcad.cad.walls import Draft
from bstcad.optics.lens.face_integrals import MassProperties, of_lens
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere
from bstcad.scene.mount import Box
from tests import suite
from tests.cad.test_mounting import disc
from tests.cad.test_trimming import plate, stadium
from tests.exact_volume import exact_volume
from tests.lenses import net

ROUNDED = Box(shape="rectangle", width=8.0, height=6.0, corner_radius=1.2)


def values(found):
    return [found.area, found.volume, *found.centroid]


def by_occ(shape, precise=1e-7):
    """Integrate by OCC: for small nets, since 17 x 17 control points take seconds and 65 x 65 a minute."""
    solid, surface = GProp_GProps(), GProp_GProps()
    BRepGProp.VolumePropertiesGK_s(shape.wrapped, solid, precise, False, False, True)
    BRepGProp.SurfaceProperties_s(shape.wrapped, surface, precise)
    return MassProperties(surface.Mass(), solid.Mass(), solid.CentreOfMass().Coord())


def cut(lens, *given):
    """Return a lens cut to a wire, with holes."""
    return of_solid(named_solid(lens, *given)[0])


def disc_wire(radius, x=0.0, y=0.0):
    return cq.Workplane("XY").center(x, y).circle(radius).wires().val()


# ---- bare lenses ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("outline", [Circle(7.0), Rectangle(24.0, 24.0)], ids=lambda outline: outline.shape)
def test_a_slab(outline):
    lens = Lens.between(Plane(8.0), net(half=12.0), outline, 1.5)
    rim = 2 * np.pi * 7 if outline.shape == "circle" else 96.0
    wanted = [2 * outline.area + rim * 12, outline.area * 12, 0, 0, 14.0]
    assert values(of_lens(lens)) == pytest.approx(wanted, rel=1e-12, abs=1e-12)
    assert values(of_solid(lens_solid(lens))) == pytest.approx(wanted, rel=1e-9, abs=1e-9)
    assert exact_volume(lens) == pytest.approx(wanted[1], rel=1e-14)


def test_a_half_ball_has_its_centroid_at_three_eighths():
    """Nearly: a ball of R = 10 cut at 9.9; V and V c by the formulas of the spherical segment."""
    radius, a = 10.0, 9.9
    s = radius - np.sqrt(radius**2 - a**2)
    lens = Lens.between(
        Sphere(0.0, 1 / radius), net(z=s + 1.0, half=12.0), Circle(a), 1.5
    )  # a bowl of glass, 1 mm of rim
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


# ---- cut lenses ----------------------------------------------------------------------------------------------------


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
    """OCC integrates the body beside the lens, which has simple faces alone."""
    lens, body = plate("convex"), BODIES[kind]()
    around = by_occ(body.val().cut(cq.Workplane("XY").box(10, 8, 20).val()))
    found, own = of_solid(mounted(body, [PlacedLens(lens)]).solid), of_lens(lens)
    assert found.volume == pytest.approx(own.volume + around.volume, rel=1e-7)
    moment = own.volume * np.array(own.centroid) + around.volume * np.array(around.centroid)
    assert found.centroid == pytest.approx(moment / found.volume, abs=1e-6)


@suite.in_turn(1, 2)
def test_leaning_walls():
    """Cones, slanted planes and ruled walls."""
    solid = named_solid(plate("freeform"), wire(ROUNDED), draft=Draft(4.0, bevel=0.25)).solid
    own, occ = of_solid(solid), by_occ(solid, 1e-5)
    assert values(own)[:2] == pytest.approx(values(occ)[:2], rel=1e-6)
    assert own.centroid == pytest.approx(occ.centroid, abs=1e-3)


def test_of_a_body_with_freeform_faces_nothing_is_known():
    wavy = disc(1.0, 2.0).cut(
        cq.Workplane("XZ", origin=(0, 12, 0)).moveTo(-11, 1.8).spline([(-9, 1.7), (-8, 1.9)], includeCurrent=True)
        .lineTo(-8, 3).lineTo(-11, 3).close().twistExtrude(24, 3)
    )  # fmt: skip
    assert of_solid(mounted(wavy, [PlacedLens(plate("convex"))]).solid) is None
