"""Where light goes through the faces, on lenses where geometry says it."""

import math

import pytest
import torch

from bstcad.analysis.used_area import used
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.sources import Collimated, Point
from bstcad.optics.surfaces import Plane

GRID = 0.01  # of the light's width: its rays lie on a grid


def plate(outline, reflects=False):
    back = BSplineSurface(20.0, torch.zeros(9, 9, dtype=torch.float64), (-12.0, 12.0), (-12.0, 12.0))
    return Lens(Plane(10.0), back, outline, 1.5, reflects)


def test_a_beam_meets_both_faces_of_a_plate_as_it_is():
    for aperture, shape, width, height in (
        (Circle(5.0), "circle", 10.0, 10.0),
        (Rectangle(8.0, 4.0), "rectangle", 8.0, 4.0),
    ):
        for patch in used(Collimated(aperture), plate(Rectangle(24.0, 24.0))):
            assert patch.shape == shape
            assert patch.half_extent == (pytest.approx(width / 2, rel=GRID), pytest.approx(height / 2, rel=GRID))
    assert set(used(Collimated(Rectangle(24.0, 24.0)), plate(Rectangle(24.0, 24.0)))) == {None}
    assert {patch.shape for patch in used(Collimated(Circle(12.0)), plate(Rectangle(24.0, 24.0)))} == {"circle"}
    assert set(used(Collimated(Circle(12.0)), plate(Circle(12.0)))) == {None}


def test_a_cone_widens_through_a_plate_as_snell_says():
    angle = math.radians(20.0)
    front, back = used(Point(profile="uniform", half_angle=20.0), plate(Rectangle(24.0, 24.0)))
    radius = 10.0 * math.tan(angle)
    assert front.shape == back.shape == "circle"
    assert front.radius == pytest.approx(radius, rel=GRID)
    inside = 10.0 * math.tan(math.asin(math.sin(angle) / 1.5))
    assert back.radius == pytest.approx(radius + inside, rel=GRID)


def test_a_lamp_of_some_size_needs_more_and_a_strip_of_light_is_not_round():
    lamp = Point(profile="uniform", half_angle=20.0, diameter=2.0)
    front = used(lamp, plate(Rectangle(24.0, 24.0)))[0]
    wanted = 10.0 * math.tan(math.radians(20.0)) + 1
    assert front.shape == "circle" and front.radius == pytest.approx(wanted, rel=GRID)
    strip = used(Collimated(Rectangle(12.0, 1.0)), plate(Rectangle(24.0, 1.0)))[0]
    assert strip.shape == "rectangle" and strip.width == pytest.approx(12.0, rel=GRID)


def test_a_mirror_has_one_face_that_light_meets():
    [face] = used(
        Point(position=(0.0, 0.0, 50.0), profile="uniform", half_angle=10.0), plate(Rectangle(24.0, 24.0), True)
    )
    assert face.shape == "circle" and face.radius == pytest.approx(30.0 * math.tan(math.radians(10.0)), rel=GRID)
