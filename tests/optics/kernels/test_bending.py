"""The fused kernel of a back's figures against the plain jets of its spans."""

import math

import numpy as np
import pytest
import torch

from bstcad.analysis import shape
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.curvature import QUARTERS, Spans, places
from bstcad.optics.kernels import bending
from bstcad.optics.outlines import Circle, Rectangle, Rounded


@pytest.mark.parametrize(
    "outline",
    [Rectangle(6.0, 4.0), Rectangle(3.1, 3.9), Circle(1.7), Rounded(5.0, 3.5, corner_radius=1.2)],
    ids=("whole", "less", "round", "round corners"),
)
@pytest.mark.parametrize("m", (5, 18, 33))
def test_largest_and_where_and_how_many(m, outline):
    heights = torch.from_numpy(np.random.default_rng(m).normal(0.0, 0.3, (m, m)))
    surface = BSplineSurface(1.0, heights, (-3.0, 3.0), (-2.0, 2.0))
    i, j = (index.flatten() for index in torch.meshgrid(torch.arange(m - 2), torch.arange(m - 2), indexing="ij"))
    jet, (x, y) = Spans.of(surface, i, j).jet(QUARTERS), places(surface, i, j, QUARTERS)
    held = outline.contains(x, y).broadcast_to(jet.slope.shape)
    most, least = jet.curvatures
    grid = shape._grid(surface)
    limits, bounds = tuple(outline.limits), (1.0, 2.0, 0.5)
    values, place, count = bending.largest(heights.numpy(), grid[2:], grid[:2], limits, bounds)
    for k, wanted in enumerate((most, -least, jet.slope)):
        wanted = torch.where(held, wanted, -math.inf)
        assert values[k] == pytest.approx(float(wanted.max()), rel=1e-11)
        assert count[k] == int((wanted >= bounds[k]).sum())
        p, q, n = np.unravel_index(int(wanted.argmax()), wanted.shape)
        found = grid[0].flat[place[k, 0]], grid[1].flat[place[k, 1]]
        assert found == pytest.approx((float(x[p, 0, n]), float(y[0, q, n])), abs=1e-9)
