"""The independent judge of domes: its reader and B-splines beside other programs, and its pictures beside bstcad's."""

import math

import cadquery as cq
import numpy as np
import pytest
import torch
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
from OCP.Geom import Geom_BSplineSurface
from OCP.gp import gp_Pnt
from OCP.TColgp import TColgp_Array2OfPnt
from OCP.TColStd import TColStd_Array1OfInteger, TColStd_Array1OfReal
from scipy.interpolate import BSpline

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.point import PointSource
from bstcad.optics.light.sphere_light import SphereLight
from bstcad.optics.receivers.directions import Directions
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.charts import SphereChart
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace import trace
from tests.benchmarks import independent_dome, judged_dome
from tests.benchmarks.cold import generate
from tests.benchmarks.independent import Conic
from tests.benchmarks.test_independent import FLUX, SIGMAS, SMALL, judged

R, INNER, N, Z, HALF = 15.0, 8.0, 1.4936, 3.0, math.radians(80.0)
CHART = SphereChart(R)
RIM = CHART.length(HALF)
MISFIT = 0.8  # largest RMS difference in units of the noise of random rays; Sobol points have less
PIXELS, RAYS = 24, 1 << 16


def wavy_dome(m=65, height=0.12, per_mm=0.35):
    """Return a dome with waves, no mirror image of itself."""
    half = RIM * (m - 1) / (m - 5)
    line = torch.linspace(-half, half, m, dtype=torch.float64)
    x, y = line[:, None], line[None, :]
    h = height * torch.sin(per_mm * x + 0.4) * torch.cos(0.8 * per_mm * y - 0.2) - 0.05 * x
    return RadialSurface(Z, h, (-half, half), (-half, half), radius=R)


def test_the_judges_spline_is_that_of_scipy():
    random = np.random.default_rng(1)
    dome = independent_dome.dome_of(random.normal(size=(7, 9, 3)))
    u, v = random.uniform(0, 5, 50), random.uniform(0, 7, 50)
    found = independent_dome.surface(dome, u, v)
    for k, (order_u, order_v) in enumerate(((0, 0), (1, 0), (0, 1))):
        rows = BSpline(dome.knots[0], dome.poles, 2)(u, nu=order_u)
        expected = [BSpline(dome.knots[1], row, 2)(at, nu=order_v) for row, at in zip(rows, v, strict=True)]
        np.testing.assert_allclose(found[k], expected, rtol=0, atol=1e-12)


def test_a_step_file_of_occ_gives_the_net_and_its_knots_back(tmp_path):
    poles, m, n = wavy_dome(9).control_points()[:, :7], 9, 7
    points = TColgp_Array2OfPnt(1, m, 1, n)
    for i, j in np.ndindex(m, n):
        points.SetValue(i + 1, j + 1, gp_Pnt(*map(float, poles[i, j])))
    arrays = []
    for count in (m, n):
        knots, times = TColStd_Array1OfReal(1, count - 1), TColStd_Array1OfInteger(1, count - 1)
        for k in range(count - 1):
            knots.SetValue(k + 1, float(k))
            times.SetValue(k + 1, 3 if k in (0, count - 2) else 1)
        arrays.append((knots, times))
    (knots_u, times_u), (knots_v, times_v) = arrays
    face = BRepBuilderAPI_MakeFace(Geom_BSplineSurface(points, knots_u, knots_v, times_u, times_v, 2, 2), 1e-6).Face()
    cq.exporters.export(cq.Workplane(cq.Face(face)), str(tmp_path / "net.step"))
    read = independent_dome.read_dome((tmp_path / "net.step").read_text())
    np.testing.assert_allclose(read.poles, poles, rtol=0, atol=1e-11)
    for count, knots in zip((m, n), read.knots, strict=True):
        np.testing.assert_array_equal(knots, independent_dome.uniform_knots(count))


@pytest.mark.parametrize(
    ("profile", "place", "receiver", "extent", "waves"),
    [
        ("lambertian", (0.0, 0.0, Z), None, 400.0, (0.6, 1.5)),  # so steep that some light is totally reflected
        ("uniform", (0.8, -0.5, Z + 0.3), Directions(), 70.0, (0.12, 0.35)),
    ],
)
def test_a_wavy_dome_makes_the_picture_of_the_independent_judge(profile, place, receiver, extent, waves):
    """A lamp at and beside the centre, on a plane and in directions; the difference is that of counted rays."""
    source, dome = PointSource(place, profile=profile, half_angle=70.0), wavy_dome(65, *waves)
    light = SphereLight(source, Z, CHART, HALF)
    clear = Circle(INNER), Circle(RIM)
    lens = Lens.between(Sphere(Z + INNER, -1 / INNER), dome, Circle(RIM), N, clear=clear)
    screen = Screen(200.0, (-extent, extent), (-extent, extent), PIXELS, surface=receiver)
    made, *_ = trace.simulate_plain([(1.0, light, lens, 1)], [screen], 768)

    land = independent_dome.in_directions if receiver else independent_dome.on_plane(200.0)
    net = independent_dome.dome_of(dome.control_points(), (0, 0, Z))
    found = independent_dome.judge(
        net, INNER, N, place, half_angle=math.radians(70.0), rim=HALF, lambertian=profile == "lambertian",
        land=land, extent=extent, pixels=PIXELS, rays=RAYS,
    )  # fmt: skip
    assert found.flux["on target"] == pytest.approx(made.flux["on target"], abs=1e-3)
    assert found.flux["total internal reflection"] == pytest.approx(made.flux["total internal reflection"], abs=1e-3)
    picture = made.box.numpy()
    many = picture * RAYS > 25
    misfit = (found.picture - picture)[many] * math.sqrt(RAYS) / np.sqrt(picture[many])
    assert many.sum() > 100 and np.sqrt((misfit**2).mean()) < MISFIT
    turned = (found.picture[:, ::-1] - picture)[many] * math.sqrt(RAYS) / np.sqrt(picture[many])
    assert np.sqrt((turned**2).mean()) > 2 * MISFIT  # the mirror image is told apart


def test_the_judge_of_folders_meets_the_dome_where_the_plain_judge_does():
    """Newton's method by numba from a table of starts, beside that of numpy from a tree, from a lamp off the centre."""
    dome = independent_dome.dome_of(wavy_dome(65, 0.6, 1.5).control_points(), (0, 0, Z))
    net, random = judged_dome.net_of(dome), np.random.default_rng(3)
    d = independent_dome.light(random.random((400, 2)), math.radians(75.0), True)
    p = np.array([0.5, -0.3, Z + 0.2]) + random.uniform(-0.2, 0.2, (400, 3))
    expected, work = independent_dome.meet(dome, p, d), np.empty((7, 3))
    for k in range(len(d)):
        arrives, s, place, normal = judged_dome.met(net, p[k], d[k], work)
        assert arrives == expected.found[k]
        if arrives:
            assert s == pytest.approx(expected.path[k], abs=1e-9)
            np.testing.assert_allclose(place, expected.point[k], rtol=0, atol=1e-9)
            np.testing.assert_allclose(normal, expected.normal[k], rtol=0, atol=1e-9)


@pytest.mark.parametrize("conic", [(8.0, -1 / 8.0, 0.0), (6.0, -0.1, -0.4), (1.0, 0.0, 0.0)])
def test_the_judge_of_folders_meets_a_front_where_its_equation_holds(conic):
    """c r² - 2 h + (1 + k) c h² = 0 ahead of the lamp; the normal is along the gradient."""
    z, c, k = conic
    front, random = Conic(z, c, c * (1 + k)), np.random.default_rng(5)
    for d in independent_dome.light(random.random((50, 2)), math.radians(70.0), False):
        meets, p, n = judged_dome.on_conic(front, (0.1, -0.2, 0.05), tuple(d))
        h = p[2] - z
        assert meets and abs(c * (p[0] ** 2 + p[1] ** 2) - 2 * h + front.q * h * h) < 1e-10
        along = np.array([-c * p[0], -c * p[1], 1 - front.q * h])
        np.testing.assert_allclose(n, along / np.linalg.norm(along), atol=1e-12)
        assert np.abs(np.cross(np.subtract(p, (0.1, -0.2, 0.05)), d)).max() < 1e-10


@pytest.mark.bench
@pytest.mark.parametrize("changes", [(), ("source.width=0.12", "source.height=0.08", "effects=[{kind='fresnel'}]")])
def test_a_folder_of_a_dome_is_judged_independently(changes, tmp_path):
    """A small template's dome, of a point without losses and of a small chip with Fresnel's reflections."""
    done = generate("dome_letters", tmp_path / "out", *SMALL, *changes, "tailoring.quality=draft")
    assert done.code in (0, 1), done.said
    report, found = judged(tmp_path / "out", SIGMAS)
    for line in ("on target", "off target", "missed the lens"):
        assert found.flux[line] == pytest.approx(report["flux"][line], abs=FLUX)
