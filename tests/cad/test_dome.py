"""Domes as solids: the design's control points, a closed solid of the right volume, read back by two readers."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.analysis.shape import survey
from bstcad.cad import distances, mesh, mounting, solid, solid_properties, step_reading, step_writing
from bstcad.cad.radial_nets import radial_surface
from bstcad.cad.walls import Draft
from bstcad.optics.lens import face_integrals
from bstcad.optics.lens.base import on_base
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.charts import SphereChart
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere
from bstcad.scene.mount import CircleRim, Flange, Mount, Part
from bstcad.step_text import part21
from bstcad.verify import step_checks
from tests import suite
from tests.cad.test_trimming import uses, worst_gap

R, INNER = 15.0, 8.0  # mm
CAVITY = Sphere(INNER, -1 / INNER)  # about the origin


def dome(front=CAVITY, half=85.0, m=25, wave=0.4, z=0.0):
    """Return a dome about (0, 0, z), with a rim that is neither plane nor round unless wave is 0 (mm)."""
    chart, half = SphereChart(R), math.radians(half)
    rim = chart.length(half)
    net = RadialSurface.sphere(z, R, (1.15 * rim, 1.15 * rim), (m, m))
    s = torch.linspace(-1.0, 1.0, m, dtype=torch.float64)
    net = replace(net, heights=wave * (torch.sin(4 * s)[:, None] + 0.5 * torch.cos(5 * s + 1)))
    return Lens.between(front, net, Circle(rim), 1.49, clear=(Circle(INNER * math.sin(half)), Circle(rim)))


def cap(radius, height):
    """Return the volume of a spherical cap (mm³) of a radius at its base and a height."""
    return math.pi * height * (3 * radius**2 + height**2) / 6


CASES = {
    "sphere": dome(),
    "conic": dome(Conic(8.0, -1 / 8.0, -0.3), half=60.0),
    "plane": dome(Plane(0.3)),
    "below the horizon": dome(Plane(-4.0), half=100.0, wave=0.2),
    "off the origin": dome(z=0.25),
}


@pytest.mark.parametrize("name", suite.in_turns(CASES, 2))
def test_the_file_has_the_design_s_control_points_and_a_closed_solid(name, tmp_path):
    lens, path = CASES[name], tmp_path / "dome.step"
    step_writing.write_lens(lens, path, "dome")
    net, based = lens.back.control_points(), on_base(lens)
    text, reread = part21.read_lens(path), step_reading.read(path)
    assert np.abs(text.surface.control_points - net).max() < 1e-11
    assert np.abs(reread.control_points - net).max() < 1e-11
    assert np.abs(reread.back.control_points() - net).max() < 1e-11
    assert reread.back.kind == "radial" and reread.back.z == pytest.approx(lens.back.z, abs=1e-9)
    assert reread.edge is None  # a bare lens
    assert text.closed and text.faces == (5 if based.front.outline else 4)
    assert reread.front.conic() == pytest.approx(lens.front.conic(), abs=1e-9)
    assert [check.name for check in step_checks.check(path, based, 1e-9, 100) if not check.passed] == []
    stated, found = face_integrals.of_lens(lens), solid_properties.of_solid(reread.shape)
    assert text.properties.volumes == pytest.approx([stated.volume], rel=1e-12)
    assert found.volume == pytest.approx(stated.volume, rel=2e-9)
    assert found.area == pytest.approx(stated.area, rel=2e-9)
    assert found.centroid == pytest.approx(stated.centroid, abs=1e-7)
    # the chart of the file has another radius, but the rim is the design's
    assert np.abs(_rim(step_reading.lens(reread, 1.49)) - _rim(lens)).max() < 1e-7


def _rim(lens):
    return lens.back.rim(lens.outline)


def test_each_edge_is_shared_by_two_faces_that_meet_in_it():
    import cadquery as cq

    shape, names = solid.lens_shape(CASES["sphere"])
    found = cq.Solid(shape)
    assert Counter(names) == {"back": 1, "front": 1, "underside": 1, "rim": 2}
    assert found.isValid() and worst_gap(found, 41) < 2e-7
    assert set(map(tuple, map(sorted, uses(found).values()))) == {(False, True)}


def test_occ_s_own_volume_of_the_faces_divided_at_their_knots_is_the_solid_s():
    """OCC integrates a face as one piece, 2e-5 off for a spline of some hundred; divided, it is exact."""
    from OCP.BRepGProp import BRepGProp
    from OCP.GeomAbs import GeomAbs_C2
    from OCP.GProp import GProp_GProps
    from OCP.ShapeUpgrade import ShapeUpgrade_ShapeDivideContinuity

    divide = ShapeUpgrade_ShapeDivideContinuity(solid.lens_shape(CASES["sphere"])[0])
    for criterion in (divide.SetSurfaceCriterion, divide.SetBoundaryCriterion, divide.SetPCurveCriterion):
        criterion(GeomAbs_C2)
    assert divide.Perform()
    found = GProp_GProps()
    BRepGProp.VolumeProperties_s(divide.Result(), found)
    assert found.Mass() == pytest.approx(face_integrals.of_lens(CASES["sphere"]).volume, rel=1e-8)


def test_equal_distances_make_a_spherical_shell():
    """The volume against that of caps and a cylinder; a net differs from a sphere by its pitch squared."""
    base = on_base(dome(wave=0.0)).front
    rim, high = R * math.sin(math.radians(85)), R * math.cos(math.radians(85))
    wanted = cap(rim, R - high) + math.pi * rim**2 * (high - base.around.z)
    wanted -= cap(base.outline.radius, INNER - base.around.z)
    assert math.hypot(base.outline.radius, base.around.z) == pytest.approx(INNER, rel=1e-12)
    coarse, middle, fine = (face_integrals.of_lens(dome(wave=0.0, m=m)).volume for m in (41, 81, 161))
    first, second = (4 * middle - coarse) / 3, (4 * fine - middle) / 3
    assert fine == pytest.approx(wanted, rel=5e-4) and (16 * second - first) / 15 == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("name", suite.in_turns(["sphere", "conic", "plane", "below the horizon"], 2))
def test_the_mesh_is_closed_and_has_the_solid_s_volume(name):
    """The error of a volume falls with the square of the spacing: two meshes give the limit."""
    lens = CASES[name]
    coarse, fine = (mesh.lens_mesh(lens, cells) for cells in (48, 96))
    assert mesh.is_closed(coarse) and mesh.is_closed(fine)
    (small, _), (large, area) = map(mesh.volume_and_area, (coarse, fine))
    wanted = solid_properties.of_solid(solid.lens_shape(lens)[0])
    assert large < wanted.volume * (1 + 1e-9) and area == pytest.approx(wanted.area, rel=5e-4)
    assert (4 * large - small) / 3 == pytest.approx(wanted.volume, rel=1e-6)
    assert mesh.vertex_error(fine, lens) < 1e-12
    error = mesh.chordal_error(fine, lens)
    assert wanted.volume - large < error * wanted.area and error < 0.3 * mesh.chordal_error(coarse, lens)


@pytest.mark.bench
@pytest.mark.parametrize("name", suite.in_turns(["sphere", "conic", "plane", "below the horizon"], 2))
def test_a_fine_mesh_has_the_solid_s_volume_without_extrapolation(name):
    made = mesh.lens_mesh(CASES[name], 2304)
    assert mesh.volume_and_area(made)[0] == pytest.approx(face_integrals.of_lens(CASES[name]).volume, rel=1e-6)


def test_the_chordal_error_of_a_sphere_is_its_sagitta():
    """A vertex pulled inwards by 0.1 mm is found, whatever face it lies on."""
    lens = dome(wave=0.0, m=65)
    made = mesh.lens_mesh(lens, 64)
    longest = max(np.linalg.norm(p[:, 0] - p[:, 1], axis=1).max() for p, _ in made.facets())
    assert mesh.chordal_error(made, lens) < longest**2 / 8 / INNER
    for z in (14.9, 7.9):
        moved = made.vertices.copy()
        moved[np.argmin(np.abs(moved - (0, 0, z)).sum(axis=1)), 2] -= 0.1
        assert mesh.chordal_error(replace(made, vertices=moved), lens) > 0.02
        assert mesh.vertex_error(replace(made, vertices=moved), lens) == pytest.approx(0.1, abs=2e-3)


def test_an_upright_facet_of_a_steep_dome_is_no_wall():
    """Rounded corners may lie exactly above one another: such a facet is measured from the dome, not from its rim."""
    lens, height = dome(wave=0.0, m=65), R * math.cos(math.radians(80.0))
    r, turn = R * math.sin(math.radians(80.0)), 0.004
    vertices = np.array(
        [[r, 0.0, height - 0.05], [r * math.cos(turn), r * math.sin(turn), height], [r, 0.0, height + 0.05]]
    )
    found = mesh.Mesh(vertices, np.array([[0, 1, 2]], np.int32))
    assert mesh.chordal_error(found, lens) < 0.02


def test_a_flange_adds_its_volume_alone():
    lens, high = dome(), 0.3
    z = on_base(lens).front.around.z
    body = mounting.body(Flange(outline=CircleRim(shape="circle", diameter=36.0), z=z, thickness=high))
    part = mounting.mounted(body, [mounting.PlacedLens(lens)])
    x, y, _ = lens.back.rim(lens.outline).T  # trapezoids of a periodic curve
    inside = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2
    wanted = face_integrals.of_lens(lens).volume + (math.pi * 18.0**2 - inside) * high
    assert part.solid.isValid() and Counter(part.faces)["flange"] == 3
    assert solid_properties.of_solid(part.solid).volume == pytest.approx(wanted, rel=1e-6)


def test_walls_of_a_dome_may_lean():
    upright, leaning = (solid.lens_shape(dome(), draft=Draft(angle))[0] for angle in (0.0, 3.0))
    volumes = [solid_properties.of_solid(each).volume for each in (upright, leaning)]
    assert 0 < volumes[0] - volumes[1] < 5.0  # mm³: 0.5 mm high, 90 mm long, at most 0.03 mm deep


def test_a_centre_is_found_from_the_net():
    for wave in (0.0, 0.4):
        net = dome(wave=wave, z=-3.75).back.control_points()
        found = radial_surface(net)
        assert found.z == pytest.approx(-3.75, abs=1e-10) and np.abs(found.control_points() - net).max() < 1e-11
    net[3, 4] *= 1 + 1e-6
    with pytest.raises(ValueError, match="the control points leave the directions of a radial net"):
        RadialSurface.from_control_points(net, -3.75)


@pytest.mark.parametrize(
    "lens, words",
    [
        (dome(half=95.0), "base: a plane must lie above z = 0.016 mm, the front's equator"),
        (dome(Plane(2.0)), "the rim of the dome is -.* mm above its base plane; move the front down"),
        (dome(Sphere(14.9, -1 / 14.9)), "lens: "),
        (dome(Sphere(2.0, 0.01)), "does not open towards -z"),
        (replace(dome(), outline=Rectangle(20.0, 20.0)), "is not a circle; give a dome a circle in its chart"),
        (replace(dome(half=70.0), outline=Circle(23.5)), "less than 1.5 control-point spacings beyond the rim"),
    ],
)  # fmt: skip
def test_a_dome_that_is_none_is_one_sentence(lens, words):
    with pytest.raises(ValueError, match=words):
        solid.lens_shape(lens)


def test_a_dome_keeps_its_own_rim():
    with pytest.raises(ValueError, match="trim or holes: a dome keeps its own rim"):
        solid.lens_solid(dome(), holes=[(0.0, 0.0, 1.0)])


def test_a_part_is_read_back_in_the_chart_of_its_design(tmp_path):
    """A flange in the base plane, and one whose lower face lies below it: apertures, net and a closed solid."""
    lens = on_base(dome(half=80.0, m=25), 0.5)
    lens = lens.with_clear((lens.front.outline, lens.outline))
    for z in (0.5, -0.4):
        plate = Flange(outline=CircleRim(shape="circle", diameter=40.0), z=z, thickness=1.2 if z < 0 else 0.9)
        mount = Mount(datum="flange", flange=plate)
        mounting.write_if_it_fits(lens, mount, tmp_path / "part.step", "dome", Part())
        found = step_checks.lens_of_part(tmp_path, lens, mount)
        assert step_reading.read(tmp_path / "part.step").edge is not None  # a lens with walls of its own
        assert found.back.radius == lens.back.radius and found.apertures[0].radius == pytest.approx(
            lens.front.outline.radius, abs=1e-8
        )
        assert found.apertures[1].radius == pytest.approx(lens.outline.radius, abs=1e-8)
        assert np.abs(found.back.control_points() - lens.back.control_points()).max() < 1e-11
        assert [c.name for c in step_checks.check_part(tmp_path, lens, mount, Part()) if not c.passed] == []
        openings = (each.back.opening(each.outline).radius for each in (found, lens))
        assert next(openings) == pytest.approx(next(openings), abs=1e-9)


def offset_sphere(radius, height, half, m=97):
    """Return a dome about the origin whose back is the sphere of a radius (mm) about (0, 0, height)."""
    chart, half = SphereChart(radius), math.radians(half)
    rim = chart.length(half)
    net = RadialSurface.sphere(0.0, radius, (1.1 * rim, 1.1 * rim), (m, m))
    _, _, cos = net.directions
    rho = height * cos + torch.sqrt(radius**2 - height**2 * (1 - cos**2))
    net = replace(net, heights=rho - radius)
    return Lens.between(Plane(-2.0), net, Circle(rim), 1.49)


@pytest.mark.parametrize("height", [0.0, 3.0, -3.0])
def test_the_curvature_and_the_overhang_of_a_sphere_are_known(height):
    """A sphere of 12 mm has ridges of 12 mm and no valley; about a higher centre it overhangs at the rim."""
    lens, half = offset_sphere(12.0, height, 85.0), math.radians(85.0)
    found, pitch = survey(lens), max(lens.back.pitch)
    # the curvature of a spline of degree 2 jumps at the knots, by the pitch in units of the radius
    assert found.convex.largest == pytest.approx(12.0, rel=pitch / 12.0) and found.concave.largest > 1e6
    z = math.cos(half) * (height * math.cos(half) + math.sqrt(144.0 - (height * math.sin(half)) ** 2))
    slope = math.degrees(math.acos((z - height) / 12.0))
    assert found.slope.largest == pytest.approx(slope, abs=0.1) and (slope > 90.0) == (height > 0)


@pytest.mark.parametrize("upright", [False, True])
def test_a_section_lies_on_the_dome_and_ends_on_its_rim(upright):
    lens = CASES["below the horizon"]
    u, z = lens.back.section(lens.outline, upright, 201)
    points = np.stack([0 * u, u, z] if upright else [u, 0 * u, z], axis=1)
    assert distances.distances_of_points(points, lens).max() < 1e-10
    rim = lens.back.rim(lens.outline)
    assert max(np.linalg.norm(rim - point, axis=1).min() for point in points[[0, -1]]) < 0.1
    edge, reach = lens.back.silhouette(lens.outline), np.hypot(*mesh.lens_mesh(lens, 64).vertices[:, :2].T).max()
    assert np.hypot(*edge.T).max() == pytest.approx(reach, rel=1e-3) and (edge[0] == pytest.approx(edge[-1]))
