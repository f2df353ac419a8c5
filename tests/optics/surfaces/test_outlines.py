"""Outlines: what is inside, how large it is."""

import math

import numpy as np
import pytest
import torch

from bstcad.optics.surfaces.outlines import Circle, Rectangle, Rounded, inside
from bstcad.optics.surfaces.sampling import sample_rim
from bstcad.optics.trace.tubes import area_of, corners

ROUND = Rounded(24.0, 10.0, corner_radius=3.0)
OUTLINES = [Rectangle(24.0, 10.0), Circle(12.0), ROUND]
AREAS = {Rectangle: 240.0, Circle: math.pi * 144, Rounded: 18 * 10 + 2 * 3 * 4 + math.pi * 9}


@pytest.mark.parametrize("outline", OUTLINES, ids=str)
def test_the_rim_is_inside_and_one_ulp_further_is_not(outline):
    a, b = (torch.tensor([v], dtype=torch.float64) for v in outline.half_extent)
    zero, up = torch.zeros_like(a), torch.full_like(a, torch.inf)
    for x, y, x_out, y_out in ((a, zero, torch.nextafter(a, up), zero), (zero, -b, zero, -torch.nextafter(b, up))):
        assert bool(outline.contains(x, y)) and bool(outline.contains(-x, -y))
        assert not bool(outline.contains(x_out, y_out)) and not bool(outline.contains(-x_out, -y_out))


@pytest.mark.parametrize("outline", OUTLINES, ids=str)
def test_limits_say_the_same_as_contains(outline):
    x, y = (torch.rand((2, 5000), generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5) * 40
    a, b = outline.half_extent
    r = {Rectangle: 0.0, Circle: 12.0, Rounded: 3.0}[type(outline)]
    in_corner = (x.abs() > a - r) & (y.abs() > b - r)
    round_ = torch.hypot(x.abs() - (a - r), y.abs() - (b - r)) <= r
    wanted = (x.abs() <= a) & (y.abs() <= b) & (~in_corner | round_)
    assert torch.equal(inside(outline.limits, x, y), wanted) and torch.equal(outline.contains(x, y), wanted)
    assert torch.equal(torch.from_numpy(outline.depth(x.numpy(), y.numpy())) >= 0, wanted)
    assert outline.area == pytest.approx(AREAS[type(outline)], rel=1e-15)


@pytest.mark.parametrize("outline", OUTLINES, ids=str)
def test_it_reaches_as_far_as_its_rim(outline):
    x, y = outline.rim_points()
    for n_x, n_y in ((1.0, 0.0), (0.0, -2.0), (0.6, 0.8), (-3.0, 1.0)):
        assert outline.reach(n_x, n_y) == pytest.approx((n_x * x + n_y * y).max(), rel=1e-4)


@pytest.mark.parametrize("outline", OUTLINES, ids=str)
def test_an_inset_leaves_what_is_so_deep_inside(outline):
    x, y = (np.random.default_rng(0).random((2, 5000)) - 0.5) * 30
    assert np.array_equal(outline.inset(1.5).depth(x, y) >= 0, outline.depth(x, y) >= 1.5)
    p, q = outline.rim_points()
    m, n = outline.inset_direction(p, q)
    assert np.abs(outline.inset(1.5).depth(p + 1.5 * m, q + 1.5 * n)).max() < 1e-12
    assert np.abs(outline.depth(p, q)).max() < 1e-12 and np.hypot(p, q).max() == pytest.approx(
        math.hypot(*outline.farthest)
    )
    assert np.abs(outline.scaled(2.0).depth(2 * p, 2 * q)).max() < 1e-12


@pytest.mark.parametrize("outline", OUTLINES, ids=str)
def test_places_along_the_rim_in_its_order_lie_on_it(outline):
    x, y = (p.numpy() for p in sample_rim(outline, 100))
    assert np.abs(outline.depth(x, y)).max() < 1e-12 and (x[0], y[0]) == pytest.approx((x[-1], y[-1]))
    turned = np.unwrap(np.arctan2(y, x))
    assert (np.diff(turned) > 0).all() and turned[-1] - turned[0] == pytest.approx(2 * np.pi)


@pytest.mark.parametrize("outline", OUTLINES, ids=str)
def test_corners_of_tubes_cover_an_outline_to_its_rim_once(outline):
    x, y = corners(outline, 64)
    depth = outline.depth(x.numpy(), y.numpy())
    assert depth.min() > -1e-12
    assert max(np.abs(depth[end]).max() for end in (0, -1, (slice(None), 0), (slice(None), -1))) < 1e-12
    area = area_of(x, y)
    assert float(area.sum()) == pytest.approx(outline.area, rel=2e-3)  # chords of the arcs
    assert float(area.max() / area.min()) < (2.5 if isinstance(outline, Rounded) else 1.15)  # a corner moves inwards
