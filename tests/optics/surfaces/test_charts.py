"""Answers of every surface through its chart: tangents, rim, section, silhouette, plan, other charts of its kind."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.charts import HEIGHTS, SphereChart
from bstcad.optics.surfaces.motion import Motion, along_axis
from bstcad.optics.surfaces.outlines import Circle, Rectangle, Rounded
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.surfaces import Conic, Plane, Recess, Sphere, Toroid, points_and_normals, points_on, sag

WAVES = torch.linspace(-1.0, 1.0, 33, dtype=torch.float64)
HILLS = torch.sin(4 * WAVES)[:, None] + 0.5 * torch.cos(3 * WAVES + 1)
EDGE = SphereChart(15.0).length(math.radians(100.0))  # radius of a dome that ends below its centre, in its chart
NET = BSplineSurface(3.0, 0.4 * HILLS, (-14.0, 14.0), (-12.0, 12.0))
DOME = replace(
    RadialSurface.sphere(0.25, 15.0, (1.15 * EDGE, 1.15 * EDGE), (33, 33)), heights=1.5 * HILLS - 2.0 * WAVES[:, None]
)
FACES = {
    "plane": (Plane(2.0), Rectangle(16.0, 10.0)),
    "sphere": (Sphere(2.0, -0.05), Circle(9.0)),
    "conic": (Conic(2.0, 0.04, -1.5), Rounded(18.0, 12.0, corner_radius=2.0)),
    "toroid": (Toroid(2.0, 0.03, -0.02), Rectangle(16.0, 10.0)),
    "recess": (Recess(Sphere(8.0, -0.1), Circle(6.0)), Circle(9.0)),
    "net": (NET, Rectangle(20.0, 18.0)),
    "dome": (DOME, Circle(EDGE)),
}


def inside(outline, n=200):
    """Points (2, n) spread over an outline."""
    turn, share = np.arange(n) * 2.399963, np.sqrt((np.arange(n) + 0.5) / n)
    a, b = outline.half_extent
    x, y = a * share * np.cos(turn), b * share * np.sin(turn)
    return np.stack([x, y])[:, outline.depth(x, y) > 1e-3]


@pytest.mark.parametrize("name", FACES)
def test_normals_stand_on_the_differences_of_points(name):
    """Central differences over 1e-5 mm of the chart; a spline's second derivatives jump, so to 1e-5."""
    face, outline = FACES[name]
    x, y = inside(outline)
    kept = np.abs(np.hypot(x, y) - 6.0) > 0.1  # the edge in which a recess ends
    x, y = x[kept], y[kept]
    points, normals = points_and_normals(face, x, y)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-14)
    assert np.array_equal(points, points_on(face, x, y))
    for d_x, d_y in ((1e-5, 0.0), (0.0, 1e-5)):
        step = points_on(face, x + d_x, y + d_y) - points_on(face, x - d_x, y - d_y)
        assert np.abs((step * normals).sum(1)).max() < 1e-5 * np.linalg.norm(step, axis=1).max()
    vectors = face.position_and_normal(torch.from_numpy(x), torch.from_numpy(y))
    position, normal = (torch.stack(vector).numpy().T for vector in vectors)
    assert np.allclose(position + (0.0, 0.0, face.z), points, atol=1e-13)
    assert np.allclose(normal / np.linalg.norm(normal, axis=1)[:, None], normals, atol=1e-13)


@pytest.mark.parametrize("name", FACES)
def test_the_normals_of_heights_point_up_and_those_of_a_dome_out(name):
    face, outline = FACES[name]
    points, normals = points_and_normals(face, *inside(outline))
    along = normals[:, 2] if face.chart.flat else (normals * (points - (0.0, 0.0, face.z))).sum(1)
    assert along.min() > 0


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("name", FACES)
def test_a_section_runs_from_rim_to_rim_in_a_plane_through_the_axis(name, upright):
    face, outline = FACES[name]
    u, z = face.section(outline, upright, 801)
    rim = face.rim(outline)[:, [int(upright), 2]]
    for end in ((u[0], z[0]), (u[-1], z[-1])):
        assert np.linalg.norm(rim - end, axis=1).min() < 0.1  # mm, the spacing of the rim's points
    if face.chart.flat:
        assert np.array_equal(z, sag(face, 0.0 * u, u) if upright else sag(face, u, 0.0 * u))
    else:
        points = np.stack([0 * u, u, z - face.z] if upright else [u, 0 * u, z - face.z])
        x, y, h = face.chart.coordinates(torch.from_numpy(points))
        _, _, rho = face._below(torch.from_numpy(points))
        assert float((rho - face.radius - h).abs().max()) < 1e-6  # mm


@pytest.mark.parametrize("name", FACES)
def test_rim_and_silhouette_lie_in_the_plan_and_the_plan_is_no_wider(name):
    face, outline = FACES[name]
    plan, edge, rim = face.plan(outline), face.silhouette(outline), face.rim(outline)
    assert np.array_equal(edge[0], edge[-1]) or np.allclose(edge[0], edge[-1], atol=1e-12)
    for x, y in (edge.T, rim[:, :2].T):
        assert plan.depth(x, y).min() > -1e-3 * max(plan.half_extent)  # samples of the plan
    assert face.opening(outline).depth(*rim[:, :2].T).min() > -1e-9
    assert plan.depth(*edge.T).min() < 1e-2  # touched
    inner = points_on(face, *inside(outline))[:, :2]
    reach = np.hypot(*edge.T).max()
    assert np.hypot(*inner.T).max() < reach * (1 + 1e-3)


def test_a_dome_that_overhangs_is_wider_than_its_opening():
    """A sphere of 15 mm up to 100 degrees; a net of 33 points differs from it by a thousandth."""
    sphere = replace(DOME, heights=0.0 * DOME.heights)
    assert sphere.plan(Circle(EDGE)).radius == pytest.approx(15.0, rel=5e-3)
    assert sphere.opening(Circle(EDGE)).radius == pytest.approx(15.0 * math.sin(math.radians(100.0)), rel=5e-3)


def test_a_dome_in_the_chart_of_another_radius_is_the_same_dome_over_the_same_rim():
    chart, outline = SphereChart(13.7), Circle(EDGE)
    moved, found = DOME.in_chart(chart), DOME.chart.outline_in(chart, outline)
    assert moved.chart == chart and found.radius != outline.radius
    assert np.abs(moved.control_points() - DOME.control_points()).max() < 1e-12
    assert np.abs(moved.rim(found) - DOME.rim(outline)).max() < 1e-9
    assert NET.in_chart(HEIGHTS) is NET
    for face, other in ((NET, chart), (DOME, HEIGHTS)):
        with pytest.raises(ValueError, match="not of the designed kind"):
            face.in_chart(other)


def test_arcs_of_a_sphere_are_its_angles_times_the_radius():
    chart, angle = SphereChart(15.0), np.radians(np.array([10.0, 60.0, 100.0]))
    length = np.array([chart.length(each) for each in angle])
    along, from_axis = chart.arcs(length, 0 * length)
    assert np.allclose(along, 15.0 * angle) and np.allclose(from_axis, 15.0 * angle)
    along, from_axis = chart.arcs(0 * length, length)
    assert np.allclose(along[angle < np.pi / 2], 0.0) and np.allclose(from_axis, 15.0 * angle)


@pytest.mark.parametrize("name", ["net", "dome"])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_shifted_or_tilted_net_goes_through_the_moved_points(name, axis):
    """Points of the moved face against the face moved, near the middle: heights along the chart's h."""
    face, outline = FACES[name]
    x, y = 0.3 * inside(outline)
    points, about = points_on(face, x, y), (0.0, 0.0, face.vertex_z)
    for moved, motion in (
        (face.shifted(axis, 0.02, outline.half_extent[axis]), Motion.of(shift=along_axis(axis, 0.02))),
        (face.tilted(axis, 0.1), Motion.of(turn=along_axis(axis, 0.1), about=about)),
    ):
        places = np.array([motion.point(tuple(point)) for point in points.tolist()])
        before = off(face, places)
        assert off(moved, places) < 1e-2 * before and before > 5e-4  # mm


def off(face, points):
    """Largest distance of points from a face along h (mm)."""
    if face.chart.flat:
        return np.abs(points[:, 2] - sag(face, *points[:, :2].T)).max()
    local = torch.from_numpy((points - (0.0, 0.0, face.z)).T.copy())
    return float((face._below(local)[2] - torch.linalg.norm(local, dim=0)).abs().max())
