"""9. Twenty million hits in one pixel or one control point.

A float32 sum of ones stops at 2^24 = 16 777 216, since 2^24 + 1 is no float32: torch's `index_add_` and the adjoint of
its indexing lose every hit after that, and the flux of a bright pixel or the gradient of a control point with it.  Here
what many rays add to is float64 whatever the rays are, and a hit whose flux is a short binary number is counted
exactly; other fluxes lose what float64 rounding of a long sum loses, which is stated.
"""

from __future__ import annotations

import pytest
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.numerics import kernel_choice, reductions
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces import bspline
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace import trace, tubes
from tests.tracing import simulated

HITS = 20_000_000
SINGLE = 1 << 16  # number of single rays behind one ray that carries all the others: its flux is above 2^24
SCREEN = Screen(100.0, (-50.0, 50.0), (-50.0, 50.0), 5)  # pixel (2, 2): |x|, |y| < 10
ROUND = torch.finfo(torch.float64).eps / 2

PRECISION = pytest.mark.parametrize("dtype", (torch.float32, torch.float64), ids=str)
FORMS = pytest.mark.parametrize("compiled", (True, False), ids=("compiled", "plain"))


@pytest.fixture(autouse=True)
def plain(request, monkeypatch):
    """Switch all kernels off where a test asks for the plain form."""
    if "compiled" in request.fixturenames and not request.getfixturevalue("compiled"):
        monkeypatch.setattr(kernel_choice, "ENABLED", False)


def carried(dtype, count=SINGLE) -> torch.Tensor:
    """(count + 1,) that sum to HITS: one large, then ones; a float32 sum stays at the large one."""
    flux = torch.ones(count + 1, dtype=dtype)
    flux[0] = HITS - count
    return flux


@PRECISION
def test_a_traced_pixel_counts_twenty_million_rays(holds, dtype):
    """Rays go from the source through a slab into one pixel; 1 / 20 007 729 is no short binary number.

    A sum of n equal numbers rounds each time in the same direction, by at most ROUND; a part adds n / MAX_PARTS.
    """
    heights = torch.zeros((5, 5), dtype=dtype)
    lens = Lens.between(
        Plane(5.0), BSplineSurface(8.0, heights, (-10.0, 10.0), (-10.0, 10.0)), Rectangle(20.0, 20.0), 1.5
    )
    n = 4473
    found = simulated(CollimatedSource(Rectangle(18.0, 18.0)), lens, SCREEN, n, 0)
    assert found.rays == n * n > HITS and float(found.box.sum()) == float(found.box[2, 2])
    bound = n * n / reductions.MAX_PARTS * ROUND
    holds("2e7 hits in one pixel, traced: error of the flux", abs(float(found.box[2, 2]) - 1), bound, "of it")
    # the ledger sums blocks of 256 rays first: n / (256 MAX_PARTS) sums, and 256 in each
    bound = (n * n / reductions.MAX_PARTS / 256 + 256) * ROUND
    figure = "2e7 hits, traced: error of the ledger's flux on the target"
    holds(figure, abs(found.flux["on target"] - 1), bound, "of it")


def square(n: int, low: float, high: float) -> torch.Tensor:
    """(2, n + 1, n + 1): corners of n x n tubes from low to high, in pixels."""
    line = torch.linspace(low, high, n + 1, dtype=torch.float64)
    return torch.stack(torch.meshgrid(line, line, indexing="xy"))


def test_a_pixel_counts_twenty_million_tubes(holds):
    """All in one pixel; 480 MB."""
    n = 4473
    image, outside = tubes.collect(square(n, 2.1, 2.9), torch.ones((1, 1), dtype=torch.float64).expand(n, n), (5, 5))
    assert float(outside) == 0 and float(image.abs().sum()) == float(image[2, 2])  # the others are dark to the last bit
    holds("2e7 hits in one pixel, tubes: hits not counted", abs(float(image[2, 2]) - n * n), 0.0)


@FORMS
def test_tubes_cut_by_a_border_leave_no_light_beside(holds, compiled):
    """n x n tubes over a quarter of each of four pixels.

    An edge's share is F / area · dy ~ 2 F / d for a tube of side d = width / n pixels, and what it leaves beside it is
    the rounding of that: six edges of n² tubes, in the worst case all of one sign, out of a whole of n² F.
    """
    n, width = 1447 if compiled else 101, 0.94  # borders run through the middle of tubes
    image, _ = tubes.collect(square(n, 2 - width / 2, 2 + width / 2), torch.ones((n, n), dtype=torch.float64), (5, 5))
    lit = torch.zeros((5, 5), dtype=torch.bool)
    lit[1:3, 1:3] = True
    bound = 6 * 2 * n / width * ROUND
    error, dark = float((4 * image[lit] / n**2 - 1).abs().max()), float(image[~lit].abs().max()) / n**2
    holds("tubes cut by a pixel border: relative error of the flux in their pixels", error, bound)
    holds("tubes cut by a pixel border: light in dark pixels", dark, bound, "of the light")


@FORMS
@PRECISION
def test_a_control_point_feels_every_ray(holds, dtype, compiled):
    """The adjoint of the sag, in the middle of a span: nine weights, 1/8, 3/4 and 1/8 each way, sum to 1."""
    heights = torch.zeros((9, 9), dtype=dtype, requires_grad=True)
    g = carried(dtype)
    u = torch.full((1,), 4.0, dtype=dtype).expand(g.shape)
    h, _, _ = bspline.evaluate(heights, u, u)
    (found,) = torch.autograd.grad(h, heights, g)
    weight = torch.tensor([0.125, 0.75, 0.125], dtype=torch.float64)
    expected = HITS * weight[:, None] * weight
    holds("2e7 hits in one control point: error of its gradient", _most(found[3:6, 3:6], expected), 0.0, "hits")
    assert float(found.double().sum()) == HITS


@FORMS
@PRECISION
def test_a_control_point_feels_every_ray_that_lands(holds, dtype, compiled):
    """The adjoint of refraction at a flat face: a slope p turns a ray on the axis by (n - 1) p, over a throw of 64 mm.

    With n = 3/2 and control points 1 mm apart every factor is a power of two, so that the sum is exact: 32 mm a unit of
    slope, and the slopes of the basis functions in the middle of a span are -1/2, 0 and 1/2 a mm.
    """
    g = carried(dtype)
    heights = torch.zeros((9, 9), dtype=dtype, requires_grad=True)
    lens = Lens.between(Plane(-2.0), BSplineSurface(0.0, heights, (-4.0, 4.0), (-4.0, 4.0)), Rectangle(8.0, 8.0), 1.5)
    start = torch.tensor([0.0, 0.0, -1.0], dtype=dtype)[:, None].expand(3, g.numel())
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=dtype)[:, None].expand(3, g.numel())
    rays = Rays(start, axis, torch.ones(1, dtype=dtype).expand(g.shape), torch.zeros(g.shape, dtype=torch.uint8))
    landed = trace.from_first_net(rays, lens, LevelPlane(64.0))
    (found,) = torch.autograd.grad(landed.position[0], heights, g)
    slope = torch.tensor([-0.5, 0.0, 0.5], dtype=torch.float64)
    weight = torch.tensor([0.125, 0.75, 0.125], dtype=torch.float64)
    expected = 32 * HITS * slope[:, None] * weight
    figure = "2e7 hits in one control point, refracted: error of its gradient"
    holds(figure, _most(found[3:6, 3:6], expected), 0.0, "mm / mm")


def _most(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float((found.double() - expected).abs().max())
