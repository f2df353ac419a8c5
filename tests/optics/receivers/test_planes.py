"""Tilted planes: their axes, where light lands on them, and that a level one is what it always was."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bstcad.optics.lens.interfaces import cross
from bstcad.optics.lens.passes import LENS, MIRROR
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import TiltedPlane
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.rays import Status, axes, tilt_of
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace.trace import to_first_net
from bstcad.optics.trace.tubes import launch_tubes, picture
from bstcad.tailoring.merit import Merit
from tests.lenses import bundle, lens_of, net

TILT = (25.0, -40.0)
SCREEN = Screen(300.0, (-40.0, 100.0), (-70.0, 60.0), (24, 20), TILT)
LIGHTS = {  # a source, and does a lens or a mirror throw its light?
    "parallel": (CollimatedSource(Circle(9.0)), False),
    "point": (PointSource((1.0, -2.0, -40.0), profile="uniform", half_angle=12.0), False),
    "mirror": (PointSource((3.0, -2.0, 90.0), profile="uniform", half_angle=5.0), True),
}
ALL = pytest.mark.parametrize("light", LIGHTS)


def optic(size, reflects):
    back = net(lambda x, y: size * torch.cos(0.3 * x + 1) * torch.sin(0.4 * y + 2), 8.0, 33)
    return lens_of(back, Plane(0.0) if reflects else Sphere(0.0, 0.01), passes=MIRROR if reflects else LENS)


def coming_through(light):
    """Rays of a light on their way to the last face of its optic, and the optic."""
    source, reflects = LIGHTS[light]
    lens = optic(0.5, reflects)
    x = torch.linspace(-11.0, 11.0, 41, dtype=torch.float64)
    return to_first_net(source.rays_through(*torch.meshgrid(x, x, indexing="ij"), lens.entrance.z, 1.0), lens), lens


@pytest.mark.parametrize("tilt", [(30.0, 0.0), (0.0, 30.0), TILT, (-80.0, 75.0)])
def test_the_axes_are_those_of_space_turned_about_x_then_about_y(tilt):
    """scipy's lower-case letters turn about fixed axes, one after the other, right-handed."""
    axes = np.array(TiltedPlane((1.0, 2.0, 3.0), tilt).axes)
    assert axes == pytest.approx(Rotation.from_euler("xy", tilt, degrees=True).as_matrix().T, abs=1e-15)
    assert np.cross(axes[0], axes[1]) == pytest.approx(axes[2], abs=1e-15)


@pytest.mark.parametrize("z", [0.0, 1e6])
@ALL
def test_rays_land_on_the_plane(light, z):
    """n · (P - C) = 0 in space, P on the ray, and x and y on the plane lead back to P; also far from the origin."""
    coming, lens = coming_through(light)
    lens = lens.with_front(lens.front.moved(z)).with_back(replace(lens.back, z=lens.back.z + z))
    plane = TiltedPlane((30.0, -5.0, 300.0 + z), TILT)
    leaving = cross(replace(coming, z=coming.z + z), lens.last_tailored).rays
    landed = plane.to(leaving)
    x, y, height = landed.position[0] - 30.0, landed.position[1] + 5.0, landed.above(300.0 + z)
    n = plane.axes[2]
    off = n[0] * x + n[1] * y + n[2] * height
    there = landed.alive
    assert int(there.sum()) > 500 and float(off[there].abs().max()) < 1e-9
    way = torch.linalg.cross(landed.position - leaving.position, leaving.direction, dim=0)
    assert float(way[:, there].abs().max()) < 1e-9
    places = torch.stack(plane.coordinates(landed))[:, there]
    wanted = torch.stack([landed.position[0], landed.position[1], landed.above(0.0)])[:, there]
    found = torch.tensor([plane.point(*place) for place in places.T.tolist()], dtype=torch.float64).T
    assert float((found - wanted).abs().max()) < (1e-9 if z == 0 else 1e-8)  # of 1e6 mm a double holds 1e-10


@pytest.mark.parametrize("eye", [0.0, -50.0])
def test_a_place_is_seen_where_the_line_to_it_meets_the_level_plane(eye):
    plane, (x, y) = TiltedPlane((30.0, -5.0, 300.0), TILT), np.random.default_rng(0).uniform(-90, 90, (2, 50))
    q_x, q_y = plane.to_level_plane(x, y, eye)
    p_x, p_y, p_z = plane.point(x, y)
    assert q_x / (300.0 - eye) == pytest.approx(p_x / (p_z - eye)) and q_y / (300.0 - eye) == pytest.approx(
        p_y / (p_z - eye)
    )
    assert np.stack(plane.from_level_plane(q_x, q_y, eye)) == pytest.approx(np.stack([x, y]), abs=1e-10)
    assert plane.to_level_plane(30.0, -5.0, eye) == pytest.approx((30.0, -5.0))  # the middle stays


def test_rays_that_lead_away_from_it_are_lost():
    """A plane steep to the axis: of two rays that lead upwards the one that does not approach it is lost."""
    rays = bundle((0.0, 0.0, 0.0), [[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]])
    landed = TiltedPlane((50.0, 0.0, 50.0), (0.0, 60.0)).to(rays)
    assert landed.status.tolist() == [Status.ALIVE, Status.TURNED_BACK]
    back = replace(rays, direction=-rays.direction, sense=-1)
    below = TiltedPlane((-50.0, 0.0, -50.0), (0.0, 60.0)).to(back)
    assert below.status.tolist() == landed.status.tolist()
    assert torch.allclose(below.position[:, 0], -landed.position[:, 0])


@ALL
def test_the_gradient_of_the_merit_is_its_derivative(light):
    """Central differences on the tilted screen agree."""
    source, reflects = LIGHTS[light]
    lens = optic(0.05, reflects)
    goal = Goal("target", SCREEN, np.ones(SCREEN.shape))
    merit = Merit.of((Channel(source, lens.index),), lens, 48, [goal], 1e-3)
    change = net(lambda x, y: torch.cos(1.1 * x + 2) * torch.sin(0.9 * y + 1), m=33).heights

    def value(heights):
        return merit(merit.landing(lens.with_back(replace(lens.back, heights=heights))))[0]

    heights, step = lens.back.heights.clone().requires_grad_(), 1e-6
    (g,) = torch.autograd.grad(value(heights), heights)
    with torch.no_grad():
        slope = (value(heights + step * change) - value(heights - step * change)) / (2 * step)
    assert float((g * change).sum()) == pytest.approx(float(slope), rel=1e-4)  # corners cross pixel borders


@pytest.mark.parametrize("tilt", [(50.0, 0.0), (0.0, -50.0), (30.0, 40.0)])
def test_irradiance_falls_as_the_cosine(tilt):
    """A collimated uniform beam of irradiance E behind a flat plate: E cos θ on the plane, θ from the axis to n."""
    plate = lens_of(net(z=5.0), Plane(0.0))
    beam, side = CollimatedSource(Rectangle(8.0, 8.0)), 16.0
    screen = Screen(200.0, (-side, side), (-side, side), 64, tilt)
    cosine = screen.receiver.axes[2][2]
    assert cosine == pytest.approx(math.prod(math.cos(math.radians(t)) for t in tilt))
    for found in (picture(beam, plate, screen, 64), launch_tubes(beam, plate, 64).picture(plate, screen)):
        irradiance = found * screen.per_unit[0] * screen.per_unit[1]
        assert float(found.sum()) == pytest.approx(1, abs=3e-9)  # the rim of the sheet is 1e-9 inside
        lit = irradiance[28:36, 28:36]
        assert torch.allclose(lit, torch.full_like(lit, cosine / 64.0), rtol=1e-9, atol=0)


TILTS = [(0.0, 0.0), (30.0, 0.0), (0.0, 30.0), (-20.0, 50.0), (70.0, -80.0)]


@pytest.mark.parametrize("tilt", TILTS, ids=str)
def test_the_tilt_of_an_axis_leads_to_it(tilt):
    assert tilt_of(axes(tilt)[2]) == pytest.approx(tilt, abs=1e-13)
