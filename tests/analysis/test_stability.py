"""The margins of lenses whose margins are known by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bstcad.analysis.stability import margins
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.sources import Collimated, Point
from bstcad.optics.surfaces import Plane

INDEX = 1.5
CRITICAL = math.degrees(math.asin(1 / INDEX))
SCREEN = Screen(1000.0, (-500.0, 500.0), (-500.0, 500.0), 16)
BEAM = Collimated(Circle(4.0), z=0.0)


def light(source, lens):
    """All of it in one channel."""
    return (Channel(source, lens.index),)


def wedge(degrees: float, m: int = 9) -> Lens:
    """A plane front and a back that rises along x by an angle."""
    x = torch.linspace(-5.0, 5.0, m, dtype=torch.float64)
    heights = (x * math.tan(math.radians(degrees)))[:, None].repeat(1, m)
    back = BSplineSurface(20.0, heights, (-5.0, 5.0), (-5.0, 5.0))
    return Lens(Plane(5.0), back, Rectangle(10.0, 10.0), INDEX)


@pytest.mark.parametrize("degrees", [0.0, 10.0, 41.0, CRITICAL - 1e-3, CRITICAL + 1e-3, 45.0])
def test_the_margin_of_a_wedge_is_the_critical_angle_less_its_own(degrees):
    """A beam along the axis meets the wedge at the wedge's angle; beyond the critical one the margin is negative."""
    found = margins(light(BEAM, wedge(degrees)), wedge(degrees), SCREEN, seed=1, n=64)
    assert found.tir_margin_deg == pytest.approx(CRITICAL - degrees, abs=1e-6)  # arccos near 1 keeps 1e-8 rad
    assert found.newton_slope_min == pytest.approx(1.0)  # d = (0, 0, 1): F' = d_z
    assert found.non_finite == 0


def test_newtons_slope_behind_a_point_source():
    """F' = d_z - d_x tan α; least for the ray that leans most along the rise."""
    lens = wedge(30.0)
    found = margins(light(Point((0.0, 0.0, 0.0)), lens), lens, SCREEN, seed=1, n=256)
    in_glass = math.asin(math.sin(math.atan(5.0 / 5.0)) / INDEX)  # at most: at the front's rim
    least = math.cos(in_glass) - math.sin(in_glass) * math.tan(math.radians(30.0))
    assert least < found.newton_slope_min < 1.0
    assert found.tir_margin_deg < CRITICAL - 30.0


def test_light_that_misses_the_back_has_no_margin():
    found = margins(
        light(replace(BEAM, aperture=Circle(1e-3)), wedge(0.0)),
        replace(wedge(0.0), outline=Circle(1e-9)),
        SCREEN,
        1,
        n=8,
    )
    assert found.tir_margin_deg is None and found.newton_slope_min is None


def test_what_is_not_finite_is_counted():
    lens = wedge(5.0)
    heights = lens.back.heights.clone()
    heights[4, 4] = float("nan")
    heights[2, 7] = float("inf")
    assert (
        margins(light(BEAM, lens), replace(lens, back=replace(lens.back, heights=heights)), SCREEN, 1, n=8).non_finite
        >= 2
    )
