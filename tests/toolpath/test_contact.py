"""Laws of a round tool on a face: it touches along the normal, it never cuts, and its cusps follow from curvatures."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.optics.surfaces.bspline import BSplineSurface, interpolating_net
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.toolpath import chords, cusps
from bstcad.toolpath.cutting import Cutting
from bstcad.toolpath.machined_face import MachinedFace, RoundTool
from bstcad.toolpath.raster import ToolPass, raster
from bstcad.toolpath.spiral import spiral
from bstcad.toolpath.swept_volume import check_raster

PLATE = Rectangle(8.0, 6.0)


def face_of(relief, outline=PLATE, m=65, half=5.0):
    """The back whose net goes through a relief z(x, y)."""
    x, y = np.meshgrid(np.linspace(-half, half, m), np.linspace(-half, half, m), indexing="ij")
    net = BSplineSurface(2.0, torch.from_numpy(interpolating_net(relief(x, y))), (-half, half), (-half, half))
    return MachinedFace.back(net, outline)


def rough_face():
    """A face with valleys of 0.55 mm radius, which a ball of 1.5 mm bridges."""
    heights = torch.from_numpy(np.random.default_rng(7).normal(0.0, 0.02, (21, 21)))
    return MachinedFace.back(BSplineSurface(4.0, heights, (-4.0, 4.0), (-3.0, 3.0)), Rectangle(6.0, 4.0))


def milled(face, **settings):
    """The raster over a face on a part that reaches down to z = 0."""
    return raster(face, (0.0, face.highest), Cutting(**settings))


def smooth(x, y):
    return 0.4 * np.sin(x / 2.0) * np.cos(y / 2.5 + 0.3) + 0.05 * x


@pytest.mark.parametrize("radius", [0.3, 1.5])
def test_the_centre_of_a_ball_lies_on_the_normal_of_its_contact(radius):
    face, (x, y) = face_of(smooth), np.random.default_rng(0).uniform(-2.9, 2.9, (2, 2000))
    z, z_x, z_y = (each.numpy() for each in face.net.sag_and_slope(torch.from_numpy(x), torch.from_numpy(y)))
    normal = np.stack([-z_x, -z_y, np.ones_like(z)]) / np.sqrt(1 + z_x**2 + z_y**2)
    centre = np.stack([x, y, z]) + radius * normal
    tool = RoundTool(face, radius)
    assert tool.reaches_all
    assert np.abs(tool.ball(*centre[:2]) - centre[2]).max() < 1e-11
    distance = np.hypot(x, y)  # the section in the plane of the axis, whose normal is another one
    slope = (z_x * x + z_y * y) / distance
    at, over = distance - radius * slope / np.hypot(1, slope), z + radius / np.hypot(1, slope)
    ahead = at > 0
    assert np.abs(tool.nose(at[ahead], np.arctan2(y, x)[ahead]) - over[ahead]).max() < 1e-11


@pytest.mark.parametrize("make", [rough_face, lambda: face_of(smooth)], ids=["bridged", "rolled"])
def test_a_ball_touches_and_never_cuts_the_face(make):
    """Against the brute maximum over a fine grid, from which the envelope differs by the grid's step alone."""
    face, radius = make(), 1.5
    x, y = np.random.default_rng(1).uniform(-2.4, 2.4, (2, 60))
    z, step = RoundTool(face, radius).ball(x, y), 0.004
    away = np.arange(-0.6, 0.6, step)
    s, t = (at.ravel() for at in np.meshgrid(away, away, indexing="ij"))
    for k in range(len(x)):
        brute = (face.heights(x[k] + s, y[k] + t) + np.sqrt(radius**2 - s * s - t * t)).max()
        assert -1e-10 < z[k] - brute < 4 * step**2 / radius


def test_a_ball_rolls_over_the_border_of_the_net():
    face, radius = face_of(lambda x, y: 0.1 * x), 1.0
    beyond = np.linspace(0.0, 0.3, 7)
    z = RoundTool(face, radius).ball(5.0 + beyond, np.zeros(7))  # the tool touches at 5 + d - r sin θ
    slant = math.atan(0.1)
    rolled = np.maximum(beyond - radius * math.sin(-slant), 0.0)
    assert (rolled > 0).all()
    assert np.abs(z - (2.0 + 0.5 + np.sqrt(radius**2 - beyond**2))).max() < 1e-11


@pytest.mark.parametrize("curvature", [-0.1, 0.0, 0.1, 0.3])
def test_cusps_of_a_cylinder_follow_from_its_radius(curvature):
    """Cusps across a cylinder along x: two circles about centres at R -+ r, which meet above the face."""
    r, p = 1.0, 0.1
    face = face_of(lambda x, y: curvature * y * y / 2 + 0 * x, Rectangle(2.0, 0.1), half=1.2)
    found = cusps.raster_passes(RoundTool(face, r), 0.0, pitch=p, along="x").cusp
    if curvature == 0:
        exact = r - math.sqrt(r * r - p * p / 4)
    else:
        big = 1 / curvature  # radius of a valley; negative: a ridge
        centre = abs(big - r)
        half = math.asin(p / 2 / centre)
        along = centre * math.cos(half)
        rest = math.sqrt(r * r - p * p / 4)
        exact = abs(big) - (along + rest) if curvature > 0 else (along - rest) - abs(big)
    assert found == pytest.approx(exact, rel=0.02)


def test_chords_keep_their_tolerance_everywhere():
    t, z = chords.within_tolerance(np.linspace(0, 10, 12), lambda t: np.sin(3 * t) * np.exp(-t / 5), 1e-4)
    fine = np.linspace(0, 10, 200_001)
    off = np.abs(np.interp(fine, t, z) - np.sin(3 * fine) * np.exp(-fine / 5))
    assert off.max() < 1e-4 and (np.diff(t) > 0).all() and len(t) < 1200


@pytest.mark.parametrize("along", ["x", "y"])
def test_a_steep_plate_is_milled_to_its_corners(along):
    """Lines that go on by a pitch beyond a square corner are farther from the face than the ball is wide."""
    face = face_of(lambda x, y: 0.12 * (x**2 + y**2), m=129, half=4.1)
    path = milled(face, along=along)
    found = check_raster(path)
    assert face.shape.slope > 0.8 and found.gouge < 5e-4 and found.unreached == 0.0


def test_the_check_finds_a_path_that_cuts_into_the_face():
    path = milled(face_of(smooth), stock=0.0)
    assert check_raster(path).gouge < 5e-4
    [finish] = path.passes
    low = ToolPass(finish.points - (0.0, 0.0, 0.003), rough=False)
    assert check_raster(replace(path, passes=(low,))).gouge > 0.0025


def test_a_front_is_turned_over_about_the_y_axis():
    face = face_of(smooth)
    front = MachinedFace.front(face.net, face.outline)
    x, y = np.random.default_rng(2).uniform(-2.9, 2.9, (2, 100))
    assert np.abs(front.heights(-x, y) + face.heights(x, y)).max() < 1e-12


@pytest.mark.parametrize(
    ("cut", "words"),
    [
        (lambda: Cutting(tool_radius=-1.0), "tool_radius = -1 mm is not possible; give a value from 0.001 to 1000"),
        (lambda: Cutting(cusp=math.nan), "cusp = nan mm is not possible"),
        (lambda: Cutting(along="z"), "along = 'z' is not possible; give x or y"),
        (lambda: spiral(face_of(lambda x, y: 2.0 * x), Cutting()), "is 63.4 degrees steep, and a nose reaches 60"),
        (lambda: spiral(face_of(smooth, Circle(3.0)), Cutting(pitch=1e-5)), "give a larger cusp"),
        (lambda: milled(face_of(smooth), pitch=1e-5, stock=0.0), "give a larger cusp"),
    ],
)  # fmt: skip
def test_an_impossible_path_is_one_sentence(cut, words):
    with pytest.raises(ValueError, match=words):
        cut()
