"""A shop is sent and told the same by data sheet, report.html and report.json, and by a STEP file alone."""

import hashlib
import json
import math
from dataclasses import replace

import pytest
import torch

import bstcad
from bstcad import Circle, Lens, Plane, Rectangle, Sphere
from bstcad.analysis.shape import describe
from bstcad.optics.lens.passes import MIRROR
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.report import prescription as order
from bstcad.report.record import of_json
from bstcad.report.report import first_figures, html
from bstcad.scene.scene import load
from tests import suite
from tests.exports.test_data_sheet import lens_of, scene_of, sheet
from tests.report.test_report import CONTENTS
from tests.scenes import DISK

STATED = {
    "surface_profile": 0.005, "front_profile": 0.01, "roughness": 5.0, "coating": "AR <450> nm",
    "thickness_tolerance": 0.05,
}  # fmt: skip


def sent(scene, folder, found=None):
    lens = lens_of(scene)
    (folder / "lens.step").write_bytes(b"lens")
    shape, stated = describe(lens, 65) | {"volume": 1000.0}, scene.part.of(scene.lens)
    return order.order_of(lens, shape, folder, stated=stated, mount=scene.mount, found=found)


def test_a_bare_lens_is_lens_step_with_what_the_scene_states(tmp_path):
    scene = load(DISK, {"lens.back.control_points": 33, **{f"part.{key}": value for key, value in STATED.items()}})
    said = sent(scene, tmp_path)
    rows = dict(order.order_rows(said))
    assert said.sha256 == hashlib.sha256(b"lens").hexdigest() == rows["SHA-256 of lens.step"]
    assert (said.size[:2], said.mass) == ((16.0, 16.0), pytest.approx(1.19))
    assert rows["Mass"] == "1.19 g (1.19 g/cm³)" and rows["Material"] == "PMMA"
    assert rows["Profile tolerance, back"] == "profile 0.005 mm (ISO 1101)"
    assert rows["Profile tolerance, front"] == "profile 0.01 mm (ISO 1101)"
    assert rows["Roughness of optical faces"] == "P, Ra ≤ 5 nm" and rows["Coating of optical faces"] == "AR <450> nm"
    assert rows["Tolerance of the centre thickness"] == "± 0.05 mm"
    assert f"below {said.tool_radius:.3g} mm" in rows["Radius of the tool's tip"]
    assert of_json(json.dumps(replace(CONTENTS, order=said).facts())).order == said


def test_what_is_not_stated_is_said_and_a_mirror_s_rear_is_no_optical_face(tmp_path):
    rows = dict(order.order_rows(sent(scene_of("square"), tmp_path)))
    assert list(rows.values()).count("not specified") == 5
    rows = dict(order.order_rows(sent(scene_of("a mirror"), tmp_path)))
    assert rows["Material"] == "not specified" and rows["Mass"] == "not known: density not specified"
    assert "Profile tolerance, front" not in rows


@pytest.mark.parametrize(("z", "place"), [
    (3.0, "3 mm behind the vertex of the rear"), (0.0, "at the vertex of the rear"),
    (-2.0, "2 mm before the vertex of the rear"),
    (-9.0, "4 mm before the vertex of the mirror, towards the source"),
])  # fmt: skip
def test_the_origin_of_a_mirror_is_seen_from_its_own_faces(z, place):
    mirror = replace(plate(Plane(z), z + 5.0), passes=MIRROR)
    assert order._origin(mirror, z + 5.0) == f"on the axis of the mirror (the centre of its outline), {place}"


def test_a_concave_front_bounds_the_tool_and_a_part_that_could_not_be_built_is_told(tmp_path):
    scene = scene_of("round, concave").changed({"lens.front.curvature": -0.06, "mount": {"datum": "front"}})
    said = sent(scene, tmp_path)
    assert said.tool_radius == pytest.approx(1 / 0.06)  # the back bends less
    assert said.file == "lens.step" and said.unbuilt and said.origin == 0.0
    assert ("part.step", "could not be built; the failed check states why") in order.order_rows(said)


def test_a_conic_front_is_looked_at_as_far_as_its_rim():
    """z = c r² / (1 + √(1 - (1 + k) c² r²)) bends by d²z/dr² / (1 + (dz/dr)²)^(3/2); most at the rim for k > 0."""
    lens, c, k = lens_of(scene_of("round, concave")), -0.02, 3.0
    r = lens.outline.radius
    root = math.sqrt(1 - (1 + k) * (c * r) ** 2)
    bent = abs(c) / root**3 / (1 + (c * r / root) ** 2) ** 1.5
    assert order._front_radius(lens.with_front(bstcad.Conic(-2.0, c, k))) == pytest.approx(1 / bent, rel=1e-12)
    assert order._front_radius(lens.with_front(bstcad.Conic(-2.0, c, -0.5))) == 50.0
    assert order._front_radius(lens.with_front(bstcad.Conic(-2.0, -c, k))) is None


def test_a_freeform_front_is_concave_where_it_is_a_ridge():
    """z = -x² / 40, whose control heights are that and a constant; seen from below the lens its radius is 20 mm."""
    lens = lens_of(scene_of("round, concave"))
    u = torch.linspace(*lens.back.x, lens.back.m, dtype=torch.float64)
    ridge = (-(u**2) / 40)[:, None].expand(lens.back.m, -1)
    for sign, radius in ((1, pytest.approx(20.0, rel=1e-3)), (-1, None)):
        front = replace(lens.back, z=-2.0, heights=(sign * ridge).repeat(1, lens.back.m))
        assert order._front_radius(lens.with_front(front)) == radius


def test_the_first_figures_have_the_size_of_what_is_sent(tmp_path):
    scene = scene_of("square").changed({"mount": {"rim": {"shape": "circle", "diameter": 15.0}}})
    (tmp_path / "part.step").write_bytes(b"part")
    said = sent(scene, tmp_path, ((-7.5, -7.5, 0.0), (7.5, 7.5, 4.25), 700.0))
    rows = {name: value for name, value, _ in first_figures(replace(CONTENTS, order=said))}
    assert said.file == "part.step" and rows["Size of the part"] == "15 × 15 × 4.25 mm"


def test_the_report_s_page_has_the_block_and_escapes_its_words():
    said = replace(sheet("a flange").order, coating="AR <450> nm")
    for known in (said, None):
        page = html(replace(CONTENTS, order=known), {}).decode()
        assert ("<h2>What to order</h2>" in page) == (known is not None)
        assert (said.sha256 in page) == ("AR &lt;450&gt; nm" in page) == (known is not None)


# --- a STEP file alone, against plates and caps whose answers are known in closed form --------------------------------

SLOPE = torch.linspace(-1, 1, 33, dtype=torch.float64)[:, None].expand(33, 33).contiguous()


def plate(front=None, back_z=20.0, outline=None, heights=0 * SLOPE):
    outline = outline or Rectangle(24.0, 16.0)
    reach = 32 / 28 if outline.is_round else 1.0  # the net of a round lens goes on past the rim
    half_x, half_y = (reach * half for half in outline.half_extent)
    back = BSplineSurface(back_z, heights, (-half_x, half_x), (-half_y, half_y))
    return Lens.between(front or Plane(15.0), back, outline, 1.5)


def conic(constant):
    return {"front": bstcad.Conic(15.0, -1 / 40.0, constant), "outline": Circle(10.0)}


CONCAVE = "{}, concave, radius 40 mm{}; its vertex is at z = 15 mm"
FACTS = [
    ({}, {
        "Overall size": "24 × 16 × 5 mm (x, y, z)", "Outline": "rectangle, 24 × 16 mm",
        "Extent": "x = ±12, y = ±8, z = 15 to 20 mm", "Front": "plane at z = 15 mm", "Centre thickness": "5 mm",
        "Edge thickness": "5 to 5 mm", "Volume": "1.92 cm³", "Mass": "1.92 g times the density in g/cm³",
        "Smallest radii of the back": "concave none, convex none",
    }),
    ({"front": Plane(10.0), "heights": 3 * SLOPE}, {  # a back that rises by a quarter
        "Overall size": "24 × 16 × 13 mm (x, y, z)", "Edge thickness": "7 to 13 mm",
        "Steepest slope of the back": f"{math.degrees(math.atan(0.25)):.0f}°",
    }),
    ({"front": Sphere(15.0, 0.02), "outline": Circle(10.0)}, {
        "Front": "sphere, convex, radius 50 mm; its vertex is at z = 15 mm", "Outline": "round, diameter 20 mm",
        "Extent": "x = ±10, y = ±10, z = 15 to 20 mm", "Edge thickness": "3.990 to 3.990 mm",  # 5 - 50 + √2400
    }),
    (conic(0.0), {"Front": CONCAVE.format("sphere", ""), "Extent": "x = ±10, y = ±10, z = 13.730 to 20 mm"}),
    (conic(2.0), {"Front": CONCAVE.format("ellipsoid", ", conic constant 2")}),
    (conic(-1.0), {"Front": CONCAVE.format("paraboloid", ", conic constant -1"), "Edge thickness": "6.25 to 6.25 mm"}),
    (conic(-2.25), {"Front": CONCAVE.format("hyperboloid", ", conic constant -2.25")}),
    ({"front": BSplineSurface(15.0, SLOPE, (-12.0, 12.0), (-8.0, 8.0))}, {
        "Front": "freeform, 33 × 33 control points; crosses the axis at z = 15 mm", "Edge thickness": "4 to 6 mm",
        "Volume": "1.92 cm³",
    }),
    *(({"front": Plane(z), "back_z": z + 5.0}, {
        "Origin of the file": f"on the axis of the lens (the centre of its outline), {place}",
    }) for z, place in (
        (3.0, "3 mm before the vertex of the front, towards the source"), (0.0, "at the vertex of the front"),
        (-2.0, "inside the lens, 2 mm behind the vertex of the front"), (-9.0, "4 mm behind the vertex of the back"),
    )),
]  # fmt: skip


@pytest.mark.parametrize(("made", "facts"), suite.in_turns(FACTS, 3))
def test_the_facts_of_a_part(made, facts):
    found = order.part(plate(**made))
    assert {name: found[name] for name in facts} == facts


def test_a_stated_density_gives_the_mass():
    assert order.part(plate(), stated=1.18)["Mass"].startswith("2.266 g, for the density of 1.18 g/cm³")
