"""The size of a real source that no ray has: stated or assumed, and its image on a screen."""

from __future__ import annotations

import math

import pytest
import torch

from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.scene.real_source import image_diameters, real_size
from tests.lenses import lens_of, net

PLATE = lens_of(net(lambda x, y: 0.0 * x + 0.0 * y, z=6.0, m=9), Plane(0.0))
SCREENS = [Screen(z, (-20.0, 20.0), (-20.0, 20.0), 80) for z in (206.0, 406.0)]  # pixels of 0.5 mm


@pytest.mark.parametrize(("real", "degrees"), [(0.3, 0.3), (None, 0.1)])
def test_the_image_of_parallel_light_is_its_divergence_times_the_distance(real, degrees):
    source = CollimatedSource(Circle(4.0), real_divergence=real)
    size = real_size(source)
    assert size.assumed is (real is None) and size.size == degrees
    found = image_diameters(size, Channel(source, 1.5), PLATE, SCREENS)
    wanted = [2 * distance * math.tan(math.radians(degrees / 2)) / 0.5 for distance in (200, 400)]
    assert found == pytest.approx(wanted, rel=0.02)


def test_a_lamp_has_a_diameter_and_a_simulated_size_is_not_counted_twice():
    lamp = PointSource((0.0, 0.0, -100.0), profile="uniform", half_angle=4.0, real_diameter=2.0)
    size = real_size(lamp)
    [found] = image_diameters(size, Channel(lamp, 1.5), PLATE, SCREENS[:1])
    assert found == pytest.approx(2.0 * 200 / 104 / 0.5, rel=0.05)  # 6 mm of glass count as 4; a disc seen at a slant
    assert real_size(PointSource((0.0, 0.0, -100.0), profile="uniform", half_angle=4.0, diameter=1.0)) is None
    assert torch.isclose(sum(torch.tensor(c.weight) for c in size.channels(Channel(lamp, 1.5))), torch.tensor(1.0))
