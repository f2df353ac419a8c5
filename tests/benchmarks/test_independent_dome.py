"""The independent judge of domes: its B-splines beside scipy's, and its pictures beside bstcad's."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline
from scipy.stats import qmc

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
from tests.benchmarks import independent, independent_trace
from tests.benchmarks.cold import generate
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


def test_the_judges_spline_and_its_derivatives_are_those_of_scipy():
    dome, work = independent_trace.dome_of(wavy_dome(9).control_points()), np.empty((7, 3))
    for u, v in np.random.default_rng(1).uniform(0, 7, (50, 2)):
        independent_trace.point_of(dome, u, v, work)
        for k, (order_u, order_v) in enumerate(((0, 0), (1, 0), (0, 1))):
            row = BSpline(dome.knots_u, dome.poles, 2)(u, nu=order_u)
            np.testing.assert_allclose(work[4 + k], BSpline(dome.knots_v, row, 2)(v, nu=order_v), rtol=0, atol=1e-12)


def circle(radius):
    """Return the border of a circle."""
    turn = np.linspace(0, 2 * np.pi, independent.EDGE_POINTS + 1)
    return independent.border_from([radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)])


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

    judged_lens = (
        independent_trace.conic_face(independent_trace.Conic(Z + INNER, -1 / INNER, -1 / INNER), circle(INNER)),
        independent_trace.dome_face(
            independent_trace.dome_of(dome.control_points(), (0, 0, Z)), circle(math.tan(HALF / 2))
        ),
    )
    table = {"kind": "point", "profile": profile, "half_angle": 70.0, "position": place, "wavelength": 587.6}
    glass = independent.glass_of({"source": table, "lens": {"index": N, "back": {}}})
    target = independent.screen_of({"z": 200.0, "x": (-extent, extent), "y": (-extent, extent)}, (PIXELS, PIXELS))
    none, found, ledger = independent.around_of([], 1.0, [587.6]), np.zeros((PIXELS, PIXELS)), np.zeros(8)
    independent_trace.trace(
        qmc.Sobol(4, seed=0).random(RAYS), np.ones(RAYS), independent.light_of(table, 1.0, 0.0), *judged_lens, glass,
        target._replace(in_degrees=receiver is not None), none, none, found, ledger,
    )  # fmt: skip
    flux, found = dict(zip(independent.LEDGER, ledger / RAYS, strict=True)), found / RAYS
    for line in ("on target", "total internal reflection"):
        assert flux[line] == pytest.approx(made.flux[line], abs=1e-3)
    picture = made.box.numpy()
    many = picture * RAYS > 25
    misfit = (found - picture)[many] * math.sqrt(RAYS) / np.sqrt(picture[many])
    assert many.sum() > 100 and np.sqrt((misfit**2).mean()) < MISFIT
    turned = (found[:, ::-1] - picture)[many] * math.sqrt(RAYS) / np.sqrt(picture[many])
    assert np.sqrt((turned**2).mean()) > 2 * MISFIT  # the mirror image is told apart


@pytest.mark.parametrize("conic", [(8.0, -1 / 8.0, 0.0), (6.0, -0.1, -0.4), (1.0, 0.0, 0.0)])
def test_the_judge_of_folders_meets_a_front_where_its_equation_holds(conic):
    """c r² - 2 h + (1 + k) c h² = 0 ahead of the lamp; the normal is along the gradient."""
    z, c, k = conic
    front, start = independent_trace.Conic(z, c, c * (1 + k)), (0.1, -0.2, 0.05)
    table = {"kind": "point", "profile": "uniform", "half_angle": 70.0, "position": start}
    light, numbers = independent.light_of(table, 1.0, 0.0), np.random.default_rng(5)
    for a, b in numbers.random((50, 2)):
        _, d = independent_trace.sent(light, a, b, 0.0, 0.0)
        meets, s, p, n = independent_trace.on_conic(front, start, d)
        h = p[2] - z
        assert meets and abs(c * (p[0] ** 2 + p[1] ** 2) - 2 * h + front.q * h * h) < 1e-10
        along = np.array([-c * p[0], -c * p[1], 1 - front.q * h])
        np.testing.assert_allclose(n, along / np.linalg.norm(along), atol=1e-12)
        np.testing.assert_allclose(np.subtract(p, start), s * np.array(d), atol=1e-10)


@pytest.mark.bench
@pytest.mark.parametrize("changes", [(), ("source.width=0.12", "source.height=0.08", "effects=[{kind='fresnel'}]")])
def test_a_folder_of_a_dome_is_judged_independently(changes, tmp_path):
    """A small template's dome, of a point without losses and of a small chip with Fresnel's reflections."""
    done = generate("dome_letters", tmp_path / "out", *SMALL, *changes, "tailoring.quality=draft")
    assert done.code in (0, 1), done.said
    report, found = judged(tmp_path / "out", SIGMAS)
    for line in ("on target", "off target", "missed the lens"):
        assert found.flux[line] == pytest.approx(report["flux"][line], abs=FLUX)
