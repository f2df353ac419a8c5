"""The search for a front: it finds the least of a merit that is known, by fronts that the blank can have."""

from __future__ import annotations

import math

import pytest
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere
from bstcad.scene.fronts import as_front
from bstcad.tailoring.stage1 import best_front
from tests.lenses import SQUARE, net

RIM = math.hypot(10.0, 10.0)


def lens_with(front):
    return Lens.between(front, net(z=25.0, m=5), SQUARE, 1.5)


def searched(front, free, merit, rim_sags=(-math.inf, math.inf)):
    """(the best front, all that were tried)."""
    tried = []

    def noted(lens):
        tried.append(lens.front)
        return merit(lens.front)

    return best_front(noted, lens_with(front), free, rim_sags).front, tried


def sag_and_slope(front):
    x = torch.tensor(10.0, dtype=torch.float64)
    h, z_x, z_y = front.relative_sag_and_slope(x, x)
    return float(h), math.degrees(math.atan(math.hypot(float(z_x), float(z_y))))


def test_what_is_not_free_stays():
    assert searched(Plane(15.0), (), lambda front: 1.0) == (Plane(15.0), [])
    found, tried = searched(Conic(15.0, 0.01, -2.0), ("curvature",), lambda front: (front.curvature + 0.01) ** 2)
    assert {front.conic_constant for front in tried} == {-2.0}
    assert found.curvature == pytest.approx(-0.01, abs=1e-4) and len(tried) <= 9


def test_the_conic_constant_alone():
    found, _ = searched(Conic(15.0, 0.02, 0.0), ("conic_constant",), lambda front: (front.conic_constant + 1.3) ** 2)
    assert found.curvature == 0.02 and found.conic_constant == pytest.approx(-1.3, abs=0.1)


def test_both_together():
    """The search starts from a plane, where the conic constant has no effect."""

    def merit(front):
        return 1e4 * (front.curvature - 0.02) ** 2 + (front.conic_constant + 1.5) ** 2 + 1.0

    found, tried = searched(Conic(15.0, 0.0, 0.0), ("curvature", "conic_constant"), merit)
    assert (found.curvature, found.conic_constant) == (pytest.approx(0.02, abs=5e-4), pytest.approx(-1.5, abs=0.05))
    assert len(tried) <= 60


STARTS = [Sphere(15.0, 0.0), Conic(15.0, 0.0, 0.0), Conic(15.0, 0.01, -3.0), Conic(15.0, 0.0, 40.0)]


@pytest.mark.parametrize("start", STARTS, ids=str)
@pytest.mark.parametrize("towards", [1, -1])
@pytest.mark.parametrize("pull", [0.0, 1e-3, -1e-3])
@pytest.mark.parametrize("rim_sags", [(-math.inf, math.inf), (-1.5, 1.2)])
def test_only_fronts_that_the_blank_can_have_are_tried(start, towards, pull, rim_sags):
    """However strongly the merit pulls: at most 30° at the rim, half the thickness left, and the sags allowed."""
    free = tuple(start.parameters())
    _, tried = searched(start, free, lambda front: -towards * front.curvature + pull * front.conic_constant, rim_sags)
    for front in tried:
        sag, slope = sag_and_slope(front)
        assert slope < 30.001 and sag < 5.0 + 1e-9
        assert rim_sags[0] - 1e-9 <= sag <= rim_sags[1] + 1e-9
        assert [*as_front(front).complaints(Rectangle(20.0, 20.0))] == []  # a scene may have it
        assert bool(front.reaches(*torch.full((2,), RIM / math.sqrt(2), dtype=torch.float64)))


def test_a_merit_that_is_best_where_it_starts_changes_nothing():
    found, _ = searched(Sphere(15.0, 0.005), ("curvature",), lambda front: float(front.curvature != 0.005))
    assert found == Sphere(15.0, 0.005)
    found, _ = searched(
        Conic(15.0, 0.005, -0.5), ("curvature", "conic_constant"),
        lambda front: float((front.curvature, front.conic_constant) != (0.005, -0.5)),
    )  # fmt: skip
    assert found == Conic(15.0, 0.005, -0.5)
