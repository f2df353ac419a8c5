"""Outlines: what is inside, how large it is."""

import math

import pytest
import torch

from bstcad.optics.outlines import Circle, Rectangle

OUTLINES = [Rectangle(24.0, 10.0), Circle(12.0)]


@pytest.mark.parametrize("outline", OUTLINES, ids=str)
def test_area_is_the_share_of_the_bounding_box_that_is_inside(outline):
    a, b = outline.half_extent
    n = 2000
    cells = (torch.arange(n, dtype=torch.float64) + 0.5) / n * 2 - 1
    inside = outline.contains(1.25 * a * cells[:, None], 1.25 * b * cells[None, :]).double().mean()
    assert outline.area == pytest.approx(float(inside) * 6.25 * a * b, rel=2e-3)  # rim cells, 1 of n
    assert outline.area == pytest.approx({Rectangle: 240.0, Circle: math.pi * 144}[type(outline)], rel=1e-15)


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
    across, up, r2 = outline.limits
    assert torch.equal((x.abs() <= across) & (y.abs() <= up) & (x * x + y * y <= r2), outline.contains(x, y))


def test_nan_is_outside():
    nan = torch.tensor([math.nan])
    assert not any(bool(outline.contains(nan, torch.zeros(1))) for outline in OUTLINES)
