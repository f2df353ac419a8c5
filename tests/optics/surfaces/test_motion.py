"""Rigid motions of sources and screens: points stay where the motion takes them, light keeps its rays."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.outlines import Circle

MOTIONS = {
    "shift": Motion.of(shift=(0.3, -0.2, 0.5)),
    "turn": Motion.of(turn=(1.5, -2.5, 4.0), about=(1.0, 2.0, 30.0)),
    "both": Motion.of(shift=(-1.0, 2.0, 3.0), turn=(-3.0, 2.0, -10.0), about=(0.0, 0.0, 12.0)),
}
SCREENS = {
    "level": Screen(100.0, (-40.0, 60.0), (-30.0, 30.0), (50, 30)),
    "tilted": Screen(100.0, (-40.0, 60.0), (-30.0, 30.0), (50, 30), tilt=(10.0, -20.0)),
}


@pytest.fixture(params=MOTIONS)
def motion(request):
    return MOTIONS[request.param]


def place(screen, x, y):
    """A place of a screen in space."""
    return np.array(screen.receiver.point(x, y))


def test_a_motion_and_its_inverse_are_none(motion):
    p = (3.0, -4.0, 5.0)
    assert motion.inverse.point(motion.point(p)) == pytest.approx(p, abs=1e-12)
    assert np.abs(motion.rotation @ motion.rotation.T - np.eye(3)).max() < 1e-15
    assert np.linalg.det(motion.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("axis", range(3))
def test_turns_are_right_handed(axis):
    turned = Motion.of(turn=tuple(90.0 if k == axis else 0.0 for k in range(3))).rotation
    one, two = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
    assert np.abs(turned @ one - two).max() < 1e-15


@pytest.mark.parametrize("name", SCREENS)
def test_each_pixel_goes_where_the_motion_takes_it(name, motion):
    before = SCREENS[name]
    after = before.moved(motion)
    for shares in ((0.0, 0.0), (1.0, 0.0), (0.3, 0.8)):
        old, new = (
            [a + s * (b - a) for (a, b), s in zip((each.x, each.y), shares, strict=True)] for each in (before, after)
        )
        assert place(after, *new) == pytest.approx(motion.point(place(before, *old)), abs=1e-10)


@pytest.mark.parametrize(
    "source",
    [
        PointSource((1.0, -2.0, -5.0), profile="gaussian", half_angle_1e2=20.0),
        PointSource((1.0, -2.0, -5.0), profile="lambertian", tilt=(5.0, 3.0)),
        CollimatedSource(Circle(8.0), z=-20.0),
        CollimatedSource(Circle(8.0), tilt=(4.0, -2.0)),
    ],
    ids=["point", "tilted point", "beam", "tilted beam"],
)
def test_rays_of_a_moved_source_are_moved_rays(source, motion):
    """Back by the motion, each is a ray of the source: through its point, or along its beam inside its aperture."""
    z = 10.0
    after = source.moved(motion, z)
    x = torch.linspace(-3.0, 3.0, 7, dtype=torch.float64)
    x, y = torch.meshgrid(x, x, indexing="ij")
    if isinstance(source, CollimatedSource):
        shift = after.shift(z)
        x, y = x + shift[0], y + shift[1]
    rays = after.rays_through(x, y, z, 1.0)
    back = motion.inverse
    height = rays.position[2] + rays.z
    start = np.stack([p.numpy().ravel() for p in (*rays.position[:2], height)])
    places = np.array([back.point(tuple(p)) for p in start.T])
    direction = back.rotation @ rays.direction.expand(3, *x.shape).reshape(3, -1).numpy()
    if isinstance(source, PointSource):
        off = np.array(source.position) - places
        assert np.abs(np.cross(off, direction.T)).max() < 1e-9
        return
    assert np.abs(direction - np.array(source.axes[2])[:, None]).max() < 1e-12
    plane = z if source.z is None else source.z
    on = places + ((plane - places[:, 2]) / direction[2])[:, None] * direction.T
    centre = np.array(source.shift(plane))
    wide = np.hypot(*(on[:, :2] - centre).T).max()
    assert wide < 3.0 * math.sqrt(2) * 1.05  # the aperture stays in a plane z = const: wider by 1 / cos
