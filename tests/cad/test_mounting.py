"""Lenses in bodies: one closed solid whose volume is the body's and the lens's, whatever the body is around them."""

import re
from collections import Counter

import cadquery as cq
import numpy as np
import pytest

from bstcad.cad import patches, step_writing
from bstcad.cad.mounting import PlacedLens, body, mounted
from bstcad.scene.mount import Box, CircleRim, Flange
from bstcad.step_text import part21
from tests import suite
from tests.cad.test_trimming import FRONTS, occ_volume, plate, stadium, uses, worst_gap
from tests.exact_volume import exact_volume

RADIUS = 10.0  # mm, of the plates around the lens, which is 10 x 8 mm
AT = (1.0, -2.0, 0.5)  # mm


def disc(low, high, radius=RADIUS):
    return cq.Workplane("XY", origin=(0, 0, low)).circle(radius).extrude(high - low)


def ring(low, high):
    """Return the volume of a disc around the lens, without the lens (mm³)."""
    return (np.pi * RADIUS**2 - 80.0) * (high - low)


def check(part):
    assert part.solid.isValid() and len(part.faces) == len(part.solid.Faces())
    assert set(map(tuple, map(sorted, uses(part.solid).values()))) == {(False, True)}
    assert worst_gap(part.solid, 41) < 1e-7


@pytest.mark.parametrize(
    "front, low, high",
    suite.in_turns(
        [*((front, 1.2, 2.5) for front in FRONTS), ("convex", -1.5, 2.5), ("freeform", 1.2, 6.0), ("conic", -1.0, 6.0)],
        2,
    ),
)
def test_it_is_one_closed_solid_of_the_volume_of_both(front, low, high):
    """Beside the lens, hanging below its front, standing above its back, and both."""
    lens = plate(front)
    part = mounted(disc(low, high), [PlacedLens(lens)])
    check(part)
    assert occ_volume(part.solid) == pytest.approx(exact_volume(lens) + ring(low, high), rel=2e-6)
    assert Counter(part.faces) == {"back": 1, "front": 1, "rim": 8, "flange": 3}
    net = patches.net_of(part.solid.Faces()[part.faces.index("back")]._geomAdaptor())
    assert (net == lens.back.control_points()).all()  # the design's own


def test_a_plane_front_and_the_plate_s_lower_face_are_one_face():
    lens = plate("plane")
    part = mounted(disc(0.0, 1.5), [PlacedLens(lens, holes=[(1.0, 1.0, 0.8)])])
    check(part)
    assert Counter(part.faces) == {"back": 1, "rim": 4, "hole": 2, "flange": 3}
    lower = min(part.solid.Faces(), key=lambda face: face.Center().z)
    assert lower.Area() == pytest.approx(np.pi * (RADIUS**2 - 0.4**2), rel=1e-9)


@suite.in_turn(1, 2)
@pytest.mark.parametrize("spline", [True, False])
def test_the_lens_may_be_cut_to_any_wire(spline, tmp_path):
    lens, wire = plate("concave"), stadium(spline)
    placed = PlacedLens(lens, trim=wire, holes=[(0.5, 0.2, 1.0)], at=AT)
    part = mounted(disc(1.5, 2.5), [placed])
    check(part)
    bare = occ_volume(mounted(disc(1.5, 2.0), [placed]).solid)
    area = cq.Face.makeFromWires(wire).Area()
    assert occ_volume(part.solid) - bare == pytest.approx((np.pi * RADIUS**2 - area) * 0.5, rel=1e-6)
    path = tmp_path / "part.step"
    step_writing.write(part.solid, path, "part")
    text, again = part21.read_lens(path), cq.importers.importStep(str(path)).val()
    assert text.closed and np.abs(text.surface.control_points - lens.back.control_points() - AT).max() < 1e-11
    assert again.isValid() and occ_volume(again) == pytest.approx(occ_volume(part.solid), rel=1e-9)


@suite.in_turn(0, 2)
def test_an_array_is_one_part():
    lens = plate("convex")
    base = cq.Workplane("XY", origin=(0, 0, 0.5)).rect(40, 34).extrude(1.5)
    places = [(12.0 * i, 10.0 * j) for i in (-1, 0) for j in (0, 1)]
    part = mounted(base, [PlacedLens(lens, at=(*at, 0.0)) for at in places])
    check(part)
    assert Counter(part.faces) == {"back": 4, "front": 4, "rim": 32, "flange": 6}
    wanted = 4 * exact_volume(lens) + (40 * 34 - 4 * 80) * 1.5
    assert occ_volume(part.solid, 1e-5) == pytest.approx(wanted, rel=1e-5)


OUTLINES = [CircleRim(shape="circle", diameter=26.0), Box(shape="rectangle", width=26.0, height=22.0),
            Box(shape="rectangle", width=26.0, height=22.0, corner_radius=3.0)]  # fmt: skip


@pytest.mark.parametrize("outline", OUTLINES)
@pytest.mark.parametrize("draft", [0.0, 10.0])
def test_a_flange_s_bevels_are_at_45_degrees_whatever_its_walls_lean(outline, draft):
    """Normals of the faces, and the volume of slices that shrink with the wall and the bevels."""
    bevel, thick = 0.3, 1.5
    plate = body(Flange(outline=outline, z=16.5, thickness=thick, draft=draft, bevel=bevel)).val()
    angles = {round(float(np.degrees(np.arcsin(face.normalAt().z))), 6) + 0.0 for face in plate.Faces()}
    assert plate.isValid() and angles == {-90.0, -45.0, draft, 45.0, 90.0}
    lean = np.tan(np.radians(draft))

    def slice_at(z):
        off = lean * np.clip(z, bevel, thick - bevel) + np.maximum(bevel - z, 0) + np.maximum(z - thick + bevel, 0)
        if outline.shape == "circle":
            return np.pi * (outline.diameter / 2 - off) ** 2
        corner = outline.corner_radius and outline.corner_radius - off
        return (outline.width - 2 * off) * (outline.height - 2 * off) - (4 - np.pi) * corner**2

    ends = np.array([0.0, bevel, thick - bevel, thick])
    low, high = ends[:-1], ends[1:]
    simpson = (slice_at(low) + 4 * slice_at((low + high) / 2) + slice_at(high)) * (high - low) / 6  # exact of squares
    assert plate.Volume() == pytest.approx(simpson.sum(), rel=1e-9)


@pytest.mark.parametrize(("draft", "bevel"), [(0.0, 0.0), (1.0, 0.2)])
@pytest.mark.parametrize("outline", [CircleRim(shape="circle", diameter=20.0), *(
    Box(shape="rectangle", width=20.0, height=16.0, corner_radius=corner) for corner in (0.0, 2.0)
)])  # fmt: skip
def test_every_face_of_a_flanged_lens_has_its_name_in_step(outline, draft, bevel):
    """OCC's writer turns the left-handed walls of a taper, and had left them unnamed."""
    part = mounted(body(Flange(outline=outline, z=1.2, thickness=1.3, draft=draft, bevel=bevel, holes=((7, 4, 1),))),
                   [PlacedLens(plate("concave"))])  # fmt: skip
    text = b"".join(step_writing.encode(part.solid, "part", faces=part.faces)).decode()
    assert Counter(re.findall(r"=\s*ADVANCED_FACE\('([^']*)'", text)) == Counter(part.faces)
    check(part)


def test_a_place_that_is_none_is_refused():
    with pytest.raises(ValueError, match=r"lens: \(0.0, nan, 0.0\) is not a position; give x, y and z in mm"):
        mounted(disc(1.0, 2.0), [PlacedLens(plate("plane"), at=(0.0, float("nan"), 0.0))])


@pytest.mark.parametrize(
    "body, words",
    [
        (disc(1.0, 4.0), "lens: the flange's upper face, z = 4 mm, cuts the rim of the back"),
        (disc(0.0, 2.0), "lens: the flange's lower face, z = 0 mm, cuts the rim of the front"),
        (disc(7.0, 8.0), "lens: the flange, from z = 7 to 8 mm, misses the lens's wall"),
        (disc(1.0, 2.0, 4.5), "give one solid that reaches all around each lens"),
        (cq.Workplane("XY").sphere(9.0), "lens: the body must surround the lens between two"),
        (cq.Workplane("XY", origin=(0, 0, 1)).circle(RADIUS).workplane(offset=2).circle(7.5).loft()
         .rotate((0, 0, 0), (1, 0, 0), 5), "lens: the body meets the lens in a face other than a plane"),
        (None, "mount: the body is NoneType; give one cadquery solid"),
        (cq.Workplane("XY"), "mount: the body is a Workplane of 0 objects; give one"),
        (cq.Workplane("XY").rarray(20, 20, 2, 1).box(9, 9, 9, combine=False), "a Workplane of 2 objects; give one"),
        (cq.Assembly(), "mount: the body is Assembly; give one"),
    ],
)  # fmt: skip
def test_a_body_that_does_not_fit_is_one_sentence(body, words):
    with pytest.raises(ValueError, match=words) as found:
        mounted(body, [PlacedLens(plate("concave"))])
    assert "\n" not in str(found.value)
