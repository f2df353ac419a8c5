"""The back keeps clear of the front: moved as little as that takes, and back again when it takes less."""

import pytest
import torch

from bstcad.analysis.shape import describe
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.surfaces import Plane, Sphere
from bstcad.tailoring.machinability import SPARE, moved_clear

SQUARE = Rectangle(20.0, 20.0)


def lens(front, outline=SQUARE, slope=0.3):
    line = torch.linspace(-10.0, 10.0, 17, dtype=torch.float64)
    tilted = BSplineSurface(20.0, slope * line[:, None] + 0 * line, (-10.0, 10.0), (-10.0, 10.0))
    return Lens(front, tilted, outline, 1.5)


@pytest.mark.parametrize("front", [Plane(18.0), Sphere(18.0, 0.02)], ids=("plane", "sphere"))
@pytest.mark.parametrize("outline", [SQUARE, Circle(7.0)], ids=("square", "round"))
def test_it_keeps_the_least_thickness(front, outline):
    moved = moved_clear(lens(front, outline), 20.0, 0.5)
    relief = 2 * 0.3 * outline.half_extent[0]
    spare = describe(moved)["thickness_min"] - 0.5 - SPARE * relief
    assert moved.back.z > 20.0 and abs(spare) < 2e-3  # mm; the round rim lies between the points looked at


def test_a_lens_with_room_stays_where_it_was():
    roomy = lens(Plane(10.0))
    stays = moved_clear(roomy, 20.0, 0.5)
    assert stays.back.z == 20.0 and torch.equal(stays.back.heights, roomy.back.heights)


def test_it_comes_back_when_it_needs_less():
    flat = lens(Plane(18.0), slope=0.0)
    far = Lens(flat.front, BSplineSurface(30.0, flat.back.heights, flat.back.x, flat.back.y), flat.outline, flat.index)
    assert moved_clear(far, 20.0, 0.5).back.z == 20.0
