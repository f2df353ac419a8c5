"""Draft and bevel of a lens's own walls: closed solids whose walls lean as asked, and whose volume is calculus's."""

from collections import Counter
from dataclasses import replace

import cadquery as cq
import numpy as np
import pytest

from bstcad.cad import step_writing
from bstcad.cad.mounting import PlacedLens, mounted, wire
from bstcad.cad.solid import lens_solid, named_solid
from bstcad.cad.solid_properties import of_solid
from bstcad.cad.walls import Draft
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Sphere, sag
from bstcad.scene.mount import LAND, Box, CircleRim
from bstcad.step_text import part21
from tests import suite
from tests.cad.test_mounting import disc
from tests.cad.test_trimming import occ_volume, plate, stadium, uses, waves, worst_gap

LEAN = Draft(4.0, bevel=0.25)
RIMS = {
    "circle": CircleRim(shape="circle", diameter=7.0),
    "rectangle": Box(shape="rectangle", width=8.0, height=6.0),
    "rounded": Box(shape="rectangle", width=8.0, height=6.0, corner_radius=1.2),
}
CIRCLE, ROUNDED = (wire(RIMS[name]) for name in ("circle", "rounded"))


def taken(rim, lean, z):
    """Return the volume (mm³) that draft and bevel take off walls of height z above a plane front."""
    tangent = np.tan(np.radians(lean.angle))

    def area(off):
        if rim.shape == "circle":
            return np.pi * (rim.diameter / 2 - off) ** 2
        corner = rim.corner_radius and rim.corner_radius - off
        return (rim.width - 2 * off) * (rim.height - 2 * off) - (4 - np.pi) * corner**2

    def slice_at(h):
        return area(tangent * (z - np.maximum(h, lean.bevel)) + np.maximum(lean.bevel - h, 0.0))

    low, high = np.array([0.0, lean.bevel]), np.array([lean.bevel, z])
    left = (slice_at(low) + 4 * slice_at((low + high) / 2) + slice_at(high)) * (high - low) / 6
    return area(0.0) * z - left.sum()


def parting(solid):
    """z of the level edges in which upright walls and leaning ones meet."""
    [z] = {round(face.BoundingBox().zmax, 9) for face in leaning(solid)}
    return z


def leaning(solid):
    """The faces between level edges above and the front or the bevel, which stand neither upright nor flat."""
    return [face for face in solid.Faces() if face.geomType() in ("PLANE", "CONE") and 0.5 > lean_of(face)[0] > 1e-6]


def lean_of(face, places=9):
    """The least and the largest angle (rad) by which a face that looks outwards and down leans, over its own grid."""
    u0, u1, v0, v1 = face._uvBounds()
    normals = [face.normalAt(u, v)[0] for u in np.linspace(u0, u1, places) for v in np.linspace(v0, v1, places)]
    angles = [-np.arcsin(normal.z) for normal in normals]
    return min(angles), max(angles)


@pytest.mark.parametrize(
    "front, rim",
    suite.in_turns([
        ("plane", "circle"), ("plane", "rounded"), ("convex", "circle"), ("concave", "rectangle"),
        ("nearly flat", "rounded"), ("conic", "rectangle"), ("freeform", "rounded"),
    ], 2),
)  # fmt: skip
def test_it_is_a_closed_solid_whose_walls_lean_by_the_draft(front, rim, tmp_path):
    """The walls lean in space, in the faces' planes, and for another reader of the file."""
    lens, path = plate(front), tmp_path / "leaning.step"
    solid, names = named_solid(lens, wire(RIMS[rim]), [(0.5, 0.3, 1.0)], LEAN)
    sides = {"circle": 2, "rectangle": 4, "rounded": 8}[rim]
    assert Counter(names) == {"back": 1, "front": 1, "rim": 2 * sides, "bevel": sides, "hole": 2}
    assert solid.isValid() and set(map(tuple, map(sorted, uses(solid).values()))) == {(False, True)}
    assert worst_gap(solid, 33) < 1e-7
    walls, bevels = leaning(solid), [face for face, name in zip(solid.Faces(), names, strict=True) if name == "bevel"]
    assert len(walls) == sides and np.array([lean_of(wall) for wall in walls]) == pytest.approx(np.radians(4.0))
    for face in (each for each in bevels if each.geomType() == "BSPLINE"):  # ruled: at 45 degrees off its middle
        (u0, u1, low, high), surface = face._uvBounds(), face._geomAdaptor()
        upper, lower = (surface.Value((u0 + u1) / 2, v) for v in (high, low))
        assert np.hypot(upper.X() - lower.X(), upper.Y() - lower.Y()) == pytest.approx(upper.Z() - lower.Z(), rel=1e-6)
    step_writing.write(solid, path, "leaning", faces=names)
    text, again = part21.read_lens(path), cq.importers.importStep(str(path)).val()
    assert text.closed and text.faces == len(names) == len(again.Faces())
    assert np.abs(text.surface.control_points - lens.back.control_points()).max() < 1e-11
    assert again.isValid() and worst_gap(again, 33) < 1e-7


@pytest.mark.parametrize("lean", [LEAN, Draft(4.0), Draft(bevel=0.25)], ids=["both", "draft", "bevel"])
@pytest.mark.parametrize("rim", RIMS)
def test_its_volume_is_that_of_slices(rim, lean):
    lens, wired = plate("plane"), wire(RIMS[rim])
    solid = lens_solid(lens, wired, draft=lean)
    z = parting(solid) if lean.angle else 3.0
    wanted = of_solid(lens_solid(lens, wired)).volume - taken(RIMS[rim], lean, z)
    assert occ_volume(solid) == pytest.approx(wanted, rel=1e-6)
    assert of_solid(solid).volume == pytest.approx(wanted, rel=1e-7)


def test_it_leans_from_below_the_lowest_place_of_the_back_s_rim():
    lens = plate("plane")
    turn = np.linspace(0, 2 * np.pi, 100_001)
    lowest = sag(lens.back, 3.5 * np.cos(turn), 3.5 * np.sin(turn)).min()
    assert parting(lens_solid(lens, wire(RIMS["circle"]), draft=LEAN)) == pytest.approx(lowest - LAND, abs=1e-3)


def test_a_circle_with_a_turned_front_has_cones_and_circles():
    """The wall of 4 degrees, the bevel of 45: exactly, by what the file says they are."""
    lens = plate("convex")
    found = lens_solid(lens, wire(RIMS["circle"]), draft=LEAN)
    cones = [face for face in found.Faces() if face.geomType() == "CONE"]
    angles = sorted(face._geomAdaptor().Cone().SemiAngle() for face in cones)
    assert angles == pytest.approx(np.radians([4.0, 4.0, 45.0, 45.0]), abs=1e-12)
    bevels = [face for face in cones if lean_of(face)[0] > 0.5]
    assert all(edge.geomType() in ("CIRCLE", "LINE") for face in bevels for edge in face.Edges())
    circles = {(edge.radius(), edge.Center().z) for edge in bevels[0].Edges() if edge.geomType() == "CIRCLE"}
    radius, z = max(circles)
    assert sag(lens.front, radius - LEAN.bevel * np.tan(np.radians(4.0)), 0.0) == pytest.approx(z - LEAN.bevel)


SLOT = cq.Workplane("XY").slot2D(7.0, 4.0).wires().val()
BEAN = cq.Workplane("XY").spline([(3.5, 0), (2, 2.5), (-1, 1.6), (-3.4, 0.4), (-1, -2.2), (2.2, -2)], periodic=True)
KITE = cq.Wire.makePolygon([cq.Vector(*p, 0) for p in ((-4, 0), (0, -3), (3, 0), (0, 1))], close=True)
# Point at which arcs of 1.6 and of 1.5 mm touch.
WAIST = np.array([2.0, np.sqrt(3.1**2 - 2.0**2)]) / 3.1 * (3.1 - 1.6, 1.6)
PEANUT = (cq.Workplane("XY").moveTo(WAIST[0], -WAIST[1]).threePointArc((3.6, 0), tuple(WAIST))
          .threePointArc((0, np.sqrt(3.1**2 - 4) - 1.5), (-WAIST[0], WAIST[1])).threePointArc((-3.6, 0), tuple(-WAIST))
          .threePointArc((0, 1.5 - np.sqrt(3.1**2 - 4)), (WAIST[0], -WAIST[1])).close().wires().val())  # fmt: skip


@pytest.mark.parametrize(
    "rim", suite.in_turns([SLOT, BEAN.close().wires().val(), KITE, PEANUT], 2), ids=["slot", "bean", "kite", "peanut"]
)
def test_the_rim_may_be_any_smooth_wire_and_any_polygon(rim, tmp_path):
    """Walls on a spline are ruled; they, too, lean by the draft, below a straight corner's mitre as beside it."""
    solid, names = named_solid(plate("concave"), rim, draft=LEAN)
    assert solid.isValid() and worst_gap(solid, 33) < 1e-7
    step_writing.write(solid, tmp_path / "lean.step", "lean", faces=names)
    text = part21.read_lens(tmp_path / "lean.step")
    assert text.closed
    angles = [lean_of(face) for face, name in zip(solid.Faces(), names, strict=True) if name == "rim"]
    leaning = [both for both in angles if both[1] > 1e-3]
    assert len(leaning) == len(angles) / 2 and np.array(leaning) == pytest.approx(np.radians(4.0), abs=1e-5)


@pytest.mark.parametrize("lean", [LEAN, Draft(bevel=0.2)], ids=["both", "bevel"])
def test_below_a_flange_it_leans_from_the_flange_on(lean):
    lens, body = plate("plane"), disc(2.0, 3.0)
    part = mounted(body, [PlacedLens(lens, wire(RIMS["rounded"]), draft=lean)])
    assert part.solid.isValid() and worst_gap(part.solid, 41) < 1e-7 and Counter(part.faces)["bevel"] == 8
    opening = cq.Face.makeFromWires(ROUNDED).Area() * 1.0  # mm thick
    whole = of_solid(lens_solid(lens, ROUNDED)).volume + body.val().Volume() - opening
    assert occ_volume(part.solid) == pytest.approx(whole - taken(RIMS["rounded"], lean, 2.0), rel=1e-6)
    with pytest.raises(ValueError, match="lens: draft and bevel need a wall of the lens below the flange"):
        mounted(disc(-1.0, 3.0), [PlacedLens(lens, draft=Draft(1.0))])


STEEP = replace(plate(), outline=Circle(3.0)).with_front(Sphere(-4.0, 0.24)).with_back(waves(half=(4.0, 4.0)))


@pytest.mark.parametrize(
    "lens, rim, holes, lean, words",
    [
        (plate(), CIRCLE, [], Draft(bevel=3.9), "bevel: at .* mm no wall is left between z = 3"),
        (plate(), CIRCLE, [], Draft(1.0, 3.6), "draft and bevel: at .* mm the walls meet before"),
        (plate(), CircleRim(shape="circle", diameter=7.9), [], Draft(1.0, 3.8), "draft and bevel: at .* no wall is"),
        (plate(), CircleRim(shape="circle", diameter=3.0), [], Draft(25.0), "draft: at .* mm the walls meet before"),
        (plate(), Box(shape="rectangle", width=8, height=2), [], Draft(20.0), "draft: at .* the walls meet"),
        (plate(), ROUNDED, [], Draft(25.0), "draft: at .* mm the walls meet before"),
        (plate(), stadium(), [], LEAN, "draft and bevel: at .* the rim has a corner that is too sharp, or not between"),
        (plate(), CIRCLE, [(3.0, 0.0, 0.8)], Draft(4.0), "draft: near .* a hole crosses the walls where they lean"),
        (STEEP, None, [], Draft(bevel=0.1), "bevel: at .* mm the front is too steep for a wall that leans by 45"),
    ],
)  # fmt: skip
def test_walls_that_cannot_lean_are_refused_in_one_sentence(lens, rim, holes, lean, words):
    rim = wire(rim) if isinstance(rim, CircleRim | Box) else rim
    with pytest.raises(ValueError, match=words) as refused:
        lens_solid(lens, rim, holes, lean)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("asked, words", [((31.0, 0.0), "draft: 31 degrees is not"), ((0.0, -0.1), "bevel: -0.1 mm")])
def test_an_impossible_draft_or_bevel_is_refused(asked, words):
    with pytest.raises(ValueError, match=words):
        Draft(*asked)
