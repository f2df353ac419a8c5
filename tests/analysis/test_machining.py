"""The smallest radii and the steepest slope of a back, against scipy's B-splines in each knot span up to its ends."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from bstcad.analysis import machining, shape
from bstcad.optics.bspline import BSplineSurface, knots
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.surfaces import Plane

M, HALF = 41, 5.0
WHOLE = Rectangle(10.0, 10.0)
SIDE = 1e-12  # of a span, by which a knot is looked at from one side


def rough(outline, seed=5):
    """A back of waves as short as its net can hold: its second derivatives jump at every knot."""
    heights = torch.from_numpy(np.random.default_rng(seed).normal(0.0, 0.02, (M, M)))
    return Lens(Plane(0.0), BSplineSurface(3.0, heights, (-HALF, HALF), (-HALF, HALF)), outline, 1.5)


def spline(lens):
    """(x, y of the places (mm), slope, the two principal curvatures) with five places a span each way.

    z(t, s) and the coordinate x(t) are B-splines of the same knots; z_x = z_t / x_t, z_xx = (z_tt - z_x x_tt) / x_t².
    """
    t = np.concatenate([k + np.clip([0.0, 0.25, 0.5, 0.75, 1.0], SIDE, 1 - SIDE) for k in range(M - 2)])
    eye, line, h = np.eye(M), np.linspace(-HALF, HALF, M), lens.back.heights.numpy()
    value, first, second = (BSpline(knots(M), eye, 2)(t, order) for order in range(3))
    place, speed, bend = value @ line, first @ line, second @ line
    along = first / speed[:, None]  # d/dx of the basis
    twice = (second - along * bend[:, None]) / speed[:, None] ** 2
    p, q = along @ h @ value.T, value @ h @ along.T
    r, s, u = twice @ h @ value.T, along @ h @ along.T, value @ h @ twice.T
    metric = np.stack([1 + p * p, p * q, p * q, 1 + q * q], -1).reshape(*p.shape, 2, 2)
    second_form = np.stack([r, s, s, u], -1).reshape(*p.shape, 2, 2) / np.sqrt(1 + p * p + q * q)[..., None, None]
    both = np.sort(np.linalg.eigvals(np.linalg.solve(metric, second_form)).real, axis=-1)
    x, y = np.meshgrid(place, place, indexing="ij")
    return x, y, np.hypot(p, q), both


@pytest.mark.parametrize("outline", [WHOLE, Rectangle(7.3, 4.1), Circle(4.4)], ids=("whole", "less", "round"))
def test_on_a_grid_four_times_finer_than_the_net(outline):
    lens = rough(outline)
    x, y, slope, curved = spline(lens)
    held = outline.contains(*(torch.from_numpy(p * (1 - 1e-9)) for p in (x, y))).numpy()
    concave, convex = 1 / curved[..., 1][held].max(), -1 / curved[..., 0][held].min()
    found = machining.survey(lens)
    assert found.concave.largest == pytest.approx(concave, rel=1e-7)
    assert found.convex.largest == pytest.approx(convex, rel=1e-7)
    steepest = np.degrees(np.arctan(slope[held].max()))
    assert steepest * (1 - 1e-9) <= found.slope.largest <= steepest * 1.02  # the rim is looked at, too
    middles = curved[2::5, 2::5][held[2::5, 2::5]]
    assert 1 / middles[:, 1].max() > 1.1 * concave  # what the middles of spans alone would say


def test_every_report_says_what_the_checks_hold_a_bound_to():
    lens = rough(Circle(4.4))
    said = shape.describe(lens, 65)
    found = machining.survey(lens, 0.5, 0.5, 30.0)
    assert said["radius_min_concave"] == found.concave.largest
    assert said["radius_min_convex"] == found.convex.largest
    assert said["slope_max_deg"] == found.slope.largest


def test_what_lies_outside_the_outline_does_not_count():
    lens = rough(Circle(4.4))
    heights = lens.back.heights.clone()
    heights[:4, :4] += 3.0 * torch.rand(4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    spiked = replace(lens, back=replace(lens.back, heights=heights))
    assert machining.survey(spiked) == machining.survey(lens)
    whole, also = (vars(machining.survey(replace(each, outline=WHOLE))) for each in (lens, spiked))
    assert all(whole[kind] != also[kind] for kind in ("concave", "convex", "slope"))


def test_of_a_slope_the_rim_is_looked_at():
    """z = x² / 2 R over a round lens is steepest at two points of its rim, between the places of the grid."""
    line = torch.linspace(-HALF, HALF, M, dtype=torch.float64)
    heights = (line[:, None] ** 2 / 40.0).expand(M, M).contiguous()
    lens = Lens(Plane(0.0), BSplineSurface(3.0, heights, (-HALF, HALF), (-HALF, HALF)), Circle(4.37), 1.5)
    met = machining.survey(lens).slope
    assert met.largest == pytest.approx(math.degrees(math.atan(4.37 / 20.0)), rel=1e-9)
    assert re.match(r"at \(-?4.37, ", met.where)


def test_no_digit_depends_on_the_number_of_threads():
    lens, threads = rough(Circle(4.4)), torch.get_num_threads()
    try:
        found = []
        for count in (1, 3):
            torch.set_num_threads(count)
            found.append(machining.survey(lens, 0.1, 0.1, 20.0))
    finally:
        torch.set_num_threads(threads)
    assert found[0] == found[1]


def test_the_least_and_largest_thickness_are_those_of_the_description():
    lens = rough(Circle(4.4))
    said = shape.describe(lens)
    assert shape.thickness_range(lens) == (said["thickness_min"], said["thickness_max"])
