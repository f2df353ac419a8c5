"""A point in a dome with a concentric inner sphere, to an even disc of directions: the dome by a differential equation.

The inner sphere bends no light.  The flux within the angle θ from the axis is F(θ): sin² θ / sin² Θ of a Lambertian
lamp and (1 - cos θ) / (1 - cos Θ) of an even one, Θ the half angle of its cone.  An even disc of the half angle Φ takes
the flux (1 - cos φ) / (1 - cos Φ) within φ, so that cos φ = 1 - F(θ) (1 - cos Φ).  The dome turns light by δ = φ - θ.
By Snell's law its normal is parallel to n d - d' = (n - cos δ) d - sin δ e_θ, and the normal of ρ(θ) d is parallel to
ρ d - ρ' e_θ:

    d log ρ / dθ = sin δ / (n - cos δ).
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.point import PointSource
from bstcad.optics.light.sphere_light import SphereLight
from bstcad.optics.receivers.directions import Directions
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.charts import SphereChart
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace import trace
from bstcad.tailoring import slope_map
from bstcad.tailoring.slope_map import Solver
from bstcad.tailoring.stage1 import COARSE_FACE_FIT, FINE_FACE_FIT
from tests import suite

N, R, INNER = 1.4936, 15.0, 8.0  # index, radii in mm
CONE, DISC = math.radians(80.0), math.radians(50.0)  # half angles Θ and Φ
CHART = SphereChart(R)
RIM = CHART.length(CONE)
PROFILES = "lambertian", "uniform"


def outgoing(theta, profile):
    """Return φ(θ)."""
    if profile == "lambertian":
        flux = (np.sin(theta) / math.sin(CONE)) ** 2
    else:
        flux = (np.sin(theta / 2) / math.sin(CONE / 2)) ** 2
    return 2 * np.arcsin(np.sqrt(flux) * math.sin(DISC / 2))


def distances(profile):
    """Return ρ(θ) (mm), ρ(0) = R, as a function of θ (rad) up to 110°."""

    def slope(theta, _):
        delta = outgoing(theta, profile) - theta
        return np.sin(delta) / (N - np.cos(delta))

    found = solve_ivp(slope, (0.0, math.radians(110.0)), [0.0], "DOP853", rtol=1e-12, atol=1e-13, dense_output=True)
    return lambda theta: R * np.exp(found.sol(np.ravel(theta))[0]).reshape(np.shape(theta))


def from_axis(points):
    """Return the angle (rad) of points (3, …) from the axis."""
    return np.arctan2(np.hypot(points[0], points[1]), points[2])


def flat_dome(m):
    """Return the net of a sphere that reaches two spans past the rim."""
    half = RIM * (m - 1) / (m - 5)
    return RadialSurface.sphere(0.0, R, (half, half), (m, m))


def interpolated(rho, m):
    """Return the net that has the distance rho(θ) where its m x m control points lie in the chart."""
    dome = flat_dome(m)
    x, y = torch.meshgrid(*[torch.linspace(*dome.x, m, dtype=torch.float64)] * 2, indexing="ij")
    for _ in range(50):  # values there are weighted means, with weights of at least 9/16 in the middle
        points = dome.at(x, y).position.numpy()
        off = rho(from_axis(points)) - np.linalg.norm(points, axis=0)
        dome = replace(dome, heights=dome.heights + torch.from_numpy(off))
        if np.abs(off).max() < 1e-7:
            return dome
    raise AssertionError("the net does not come to the surface")


def light(profile):
    """Return the lamp over the chart."""
    return SphereLight(PointSource((0.0, 0.0, 0.0), profile=profile, half_angle=math.degrees(CONE)), 0.0, CHART, CONE)


def lens_of(dome):
    """Return the lens of an inner sphere and a dome, both about the lamp."""
    clear = Circle(INNER * math.sin(CONE) * (1 + 1e-9)), Circle(RIM)
    return Lens.between(Sphere(INNER, -1 / INNER), dome, Circle(RIM), N, clear=clear)


def disc(pixels, parts=16):
    """Return the goal of an even disc of directions."""
    edge = math.degrees(DISC)
    screen = Screen(0.0, (-edge, edge), (-edge, edge), pixels, surface=Directions())
    line = ((np.arange(pixels * parts) + 0.5) / (pixels * parts) * 2 - 1) * edge
    inside = np.hypot(line[:, None], line) <= edge
    flux = inside.reshape(pixels, parts, pixels, parts).mean((1, 3)) * screen.cell_sizes
    return Goal("disc", screen, flux / flux.sum())


def error_of_picture(lens, profile, rays, pixels=24):
    """Return the RRMSD of the light of rays x rays rays from an even disc."""
    goal = disc(pixels)
    made, *_ = trace.simulate_plain([(1.0, light(profile), lens, 1)], [goal.screen], rays)
    off = (made.box / made.box.sum()).numpy() - goal.picture
    return math.sqrt((off**2).sum() / (goal.picture**2).sum()), made.flux


@pytest.mark.parametrize("profile", suite.in_turns(PROFILES, 2))
def test_the_dome_of_the_equation_makes_an_even_disc(profile):
    """Rays land at φ(θ): the slopes of the net are good to the second order, 0.01° at 129 control points."""
    errors, rho = [], distances(profile)
    theta, psi = (torch.from_numpy(p) for p in (np.radians(np.linspace(0.5, 79.9, 300)), np.linspace(0, 7, 300)))
    length = 2 * R * torch.tan(theta / 2)
    for m in (129, 257):
        lens = lens_of(interpolated(rho, m))
        rays = light(profile).rays_through(length * torch.cos(psi), length * torch.sin(psi), 0.0, 1.0)
        landed = trace.trace(rays, lens, Directions())
        assert landed.alive.all()
        angle = torch.hypot(*landed.position).numpy()
        errors.append(np.abs(angle - np.degrees(outgoing(theta.numpy(), profile))).max())
    assert errors[0] < 0.012 and errors[1] < errors[0] / 3.0
    rrmsd, flux = error_of_picture(lens, profile, rays=768)
    assert rrmsd < 0.01 and flux["on target"] > 0.9995  # about 0.007 of it noise


def by_rounds(profile, m, plan):
    """Return the lens after rounds of stage 1 from a sphere; plan: cells of the transport map and fit of each."""
    goal, lens, source = disc(256), lens_of(flat_dome(m)), light(profile)
    per_degree = RIM / math.degrees(DISC)
    slopes = SimpleNamespace(face_points=tuple(p * per_degree for p in slope_map.pixel_corners(goal.screen)))
    for cells, fit in plan:
        window = slope_map.lit_window(source, lens)
        grid = slope_map.square_grid(source, lens, window, cells)
        slopes = slope_map.slope_map(lens, grid, goal, slopes, solver=Solver(100))
        lens = slope_map.fit_to_map(lens, slopes, slope_map.face_grid(source, lens, window, 2 * m), fit)
    return lens


@suite.in_turn(0, 2)
@pytest.mark.parametrize(("profile", "finest", "at_rim"), [
    ("uniform", 128, 1e-4), pytest.param("lambertian", 256, 2e-4, marks=pytest.mark.bench),
])  # fmt: skip
def test_rounds_of_stage_1_find_the_dome_of_the_equation(profile, finest, at_rim):
    """The distance from the centre within 1e-4 of R up to 70°; the light's edge on cells shows in the last degrees."""
    plan = [(48, COARSE_FACE_FIT)] * 6 + [(128, FINE_FACE_FIT)] * 3 + [(finest, FINE_FACE_FIT)] * 3  # half steps
    lens, rho = by_rounds(profile, 129, plan), distances(profile)
    length, psi = np.meshgrid(np.linspace(0, RIM, 100), np.linspace(0, 2 * math.pi, 8))
    x, y = (torch.from_numpy(length * f(psi)) for f in (np.cos, np.sin))
    points = lens.back.at(x, y).position.numpy()
    off = np.abs(np.linalg.norm(points, axis=0) - rho(from_axis(points))) / R
    assert off[length < CHART.length(math.radians(70.0))].max() < 1e-4
    assert off.max() < at_rim and np.sqrt((off**2).mean()) < 6e-5
    rrmsd, flux = error_of_picture(lens, profile, rays=512)
    assert rrmsd < 0.04 and flux["on target"] > 0.997  # 0.025 without stage 2, and noise
