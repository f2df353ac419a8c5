"""Area, volume and centroid of lenses against those known otherwise."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest
import torch

from bstcad.cad.mass_properties import by_occ, of_lens
from bstcad.cad.solid import lens_solid
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.surfaces import Conic, Plane, Sphere


def flat(outline, z=20.0):
    return BSplineSurface(z, torch.zeros(9, 9, dtype=torch.float64), (-24.0, 24.0), (-24.0, 24.0))


def flattened(found):
    return [*astuple(found)[:2], *found.centroid]


def test_a_cylinder():
    found = of_lens(Lens(Plane(8.0), flat(Circle(7.0)), Circle(7.0), 1.5))
    assert flattened(found) == pytest.approx(
        [2 * np.pi * 49 + 2 * np.pi * 7 * 12, np.pi * 49 * 12, 0, 0, 14.0], rel=1e-12, abs=1e-12
    )


def test_a_half_ball_has_its_centroid_at_three_eighths():
    """Nearly: a ball of R = 10 cut at 9.9; V and V c by the formulas of the spherical segment."""
    radius, a = 10.0, 9.9
    s = radius - np.sqrt(radius**2 - a**2)
    lens = Lens(Sphere(0.0, 1 / radius), flat(Circle(a), s + 1.0), Circle(a), 1.5)  # a bowl of glass, 1 mm of rim
    cap = np.pi * s * s * (3 * radius - s) / 3
    below = 3 * (2 * radius - s) ** 2 / (4 * (3 * radius - s))  # the cap's centroid, from the ball's centre
    disc = np.pi * a * a
    wanted = (cap * (radius - below) + disc * (s + 0.5)) / (cap + disc)
    found = of_lens(lens)
    assert found.volume == pytest.approx(cap + disc, rel=1e-12)
    assert found.centroid[2] == pytest.approx(wanted, rel=1e-10)
    assert found.area == pytest.approx(2 * np.pi * radius * s + disc + 2 * np.pi * a, rel=1e-9)


@pytest.mark.parametrize(("outline", "front"), [
    (Rectangle(24.0, 20.0), Plane(8.0)), (Rectangle(24.0, 20.0), Conic(8.0, 0.02, -1.2)),
    (Circle(12.0), Sphere(8.0, 0.03)),
], ids=["block", "conic", "round"])  # fmt: skip
def test_occ_finds_the_same(make_lens, outline, front):
    lens = make_lens(front, outline, m=7)
    assert flattened(of_lens(lens)) == pytest.approx(flattened(by_occ(lens_solid(lens))), rel=2e-7, abs=2e-7)


def test_the_place_on_the_axis_only_moves_the_centroid(make_lens):
    lens = make_lens(outline=Circle(12.0), m=9)
    far = Lens(lens.front.moved(1e4), lens.back.moved(lens.back.z - lens.front.z + 1e4), lens.outline, 1.5)
    here, there = of_lens(lens), of_lens(far)
    assert there.area == pytest.approx(here.area, rel=1e-12)
    assert there.centroid[2] - 1e4 == pytest.approx(here.centroid[2] - 8.0, abs=1e-8)
