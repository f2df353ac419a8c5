"""Tables and figures of a dome: the polar sag table, curvature over directions, and the model of a report."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.cad import distances, mesh
from bstcad.exports import exports
from bstcad.figures import figure_jobs, rendering
from bstcad.optics.lens.base import on_base
from bstcad.report import prescription
from tests.cad.test_dome import CASES, dome, offset_sphere


@pytest.fixture(scope="module")
def lens():
    made = CASES["sphere"]
    return made.with_back(replace(made.back, z=0.25))


def test_the_polar_table_holds_points_of_the_dome_and_their_normals(lens, tmp_path):
    """Distances from the centre along the stated directions; the points lie on the net, the normals are exact."""
    exports.export(lens, ["sag", "points"], tmp_path, 33)
    text = (tmp_path / "sag-polar.csv").read_text()
    assert text.startswith("angle_deg,azimuth_deg,distance_mm,x_mm,y_mm,z_mm,normal_x,normal_y,normal_z\n")
    table = np.loadtxt(text.splitlines()[1:], delimiter=",")
    theta, psi = np.radians(table[:, :2]).T
    direction = np.stack([np.sin(theta) * np.cos(psi), np.sin(theta) * np.sin(psi), np.cos(theta)], axis=1)
    points, normals = table[:, 3:6], table[:, 6:]
    np.testing.assert_allclose(table[:, 2:3] * direction + (0.0, 0.0, 0.25), points, rtol=0, atol=1e-9)
    assert table[:, 0].max() == pytest.approx(85.0) and len(table) == 1 + 16 * 66
    back = np.loadtxt(tmp_path / "points-back.csv", delimiter=",", skiprows=1)
    for place, normal in ((points, normals), (back[:, :3], back[:, 3:])):
        assert distances.distances_of_points(place, lens).max() < 1e-9
        np.testing.assert_allclose(distances.normals_near(lens.back, place), normal, rtol=0, atol=1e-9)
    front = np.loadtxt(tmp_path / "points-front.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(np.linalg.norm(front[:, :3], axis=1), 8.0, atol=1e-9)
    np.testing.assert_allclose(front[:, 3:], -front[:, :3] / 8.0, atol=1e-9)  # out of the lens, towards the lamp


@pytest.mark.parametrize("kind", ["zemax", "turning"])
def test_a_table_of_heights_is_refused_with_what_a_dome_has(kind, lens, tmp_path):
    with pytest.raises(ValueError, match=f'^"{kind}" is a table of heights .*lens.step.*"sag"'):
        exports.export(lens, [kind], tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_mean_curvature_over_directions_is_that_of_a_sphere():
    """-1/R everywhere, whatever the chart's centre."""
    back = offset_sphere(12.0, 3.0, 80.0).back
    line = np.linspace(-12.0, 12.0, 201)
    x, y = np.meshgrid(line, line)
    patch = back.at(*(torch.from_numpy(part.copy()) for part in (x, y)))
    normal = patch.normal.numpy()
    found = figure_jobs.mean_curvature(
        patch.along_x.numpy(), patch.along_y.numpy(), normal / np.sqrt((normal**2).sum(0)), (x, y)
    )
    rough = max(back.pitch) / 12.0  # the curvature of a spline of degree 2 jumps at the knots
    np.testing.assert_allclose(found[2:-2, 2:-2], -1 / 12.0, rtol=rough)


def test_coordinates_of_the_chart_become_angles():
    lens = dome()
    chart, places = lens.back.chart, np.array([[0.0, 0.0], [lens.outline.radius, 0.0], [0.0, -30.0]])
    expected = [[0.0, 0.0], [85.0, 0.0], [0.0, -math.degrees(2 * math.atan(1.0))]]
    np.testing.assert_allclose(chart.drawn(places), expected, atol=1e-9)
    np.testing.assert_allclose(chart.from_drawn(chart.drawn(places)), places, atol=1e-9)


@pytest.mark.parametrize("name", ["sphere", "plane", "below the horizon"])
def test_the_model_of_the_report_has_the_extent_of_the_solid(name):
    """Nothing lies outside the part: no plane around the dome, no part of a chart."""
    lens = CASES[name]
    model = json.loads(rendering.turnable(lens, cells=64))
    vertices = mesh.lens_mesh(on_base(lens), 64).vertices
    np.testing.assert_allclose(model["low"], vertices.min(0), atol=1e-3)
    np.testing.assert_allclose(model["size"], np.ptp(vertices, axis=0), atol=2e-3)


@pytest.mark.parametrize("name", ["oblong", "below the horizon"])
def test_the_outer_size_is_that_of_the_solid_which_may_be_oblong_and_wider_than_its_rim(name):
    oblong = dome(half=78.0)
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 25), np.linspace(-1.0, 1.0, 25), indexing="ij")
    oblong = oblong.with_back(replace(oblong.back, heights=torch.from_numpy(3.0 * x**2 - 5.0 * y**2)))
    lens = on_base({"oblong": oblong, **CASES}[name])
    vertices = mesh.lens_mesh(lens, 96).vertices
    low, high = prescription._corners(lens, None)
    np.testing.assert_allclose(low, vertices.min(0), atol=5e-3)  # mm, the chords of the mesh
    np.testing.assert_allclose(high, vertices.max(0), atol=5e-3)
    assert name != "oblong" or high[0] - low[0] > 1.3 * (high[1] - low[1])
