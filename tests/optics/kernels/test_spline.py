"""The fused kernels of the spline and of the splat against the plain torch forms: values and gradients."""

import math

import numpy as np
import pytest
import torch

from bstcad.analysis import shape
from bstcad.optics.kernels import spline
from bstcad.optics.numerics import kernel_choice
from bstcad.optics.receivers import irradiance
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces import bspline
from bstcad.optics.surfaces.bspline import QUARTERS, Spans, span_points
from bstcad.optics.surfaces.outlines import Circle, Rectangle, Rounded
from bstcad.optics.surfaces.rays import Landed
from tests.lenses import rough, uniform
from tests.optics.kernels.arrays import DTYPES, LAYOUTS, close


@DTYPES
def test_kernels_serve_matching_cpu_tensors_only(dtype):
    a = torch.zeros(3, dtype=dtype)
    other = torch.zeros(3, dtype=torch.float64 if dtype == torch.float32 else torch.float32)
    for name, by_device in kernel_choice.KERNELS.items():
        assert by_device.keys() <= {"cpu", "cuda"} and callable(kernel_choice.kernel(name, a, a))
        for wrong in ((a, a.to(torch.float16)), (a, other), (a.to("meta"), a.to("meta"))):
            assert kernel_choice.kernel(name, *wrong) is None


@DTYPES
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("m", (5, 33))
def test_evaluate_and_its_gradients(m, layout, dtype):
    """Also with a net that is not contiguous, and where autograd hands over expanded gradients."""
    n = 5 * 7 * 300  # several chunks
    u, v = (LAYOUTS[layout](uniform(n, s).to(dtype) * (m - 1)) for s in (0, 1))
    heights = (uniform((m, m), 2) - 0.5).to(dtype).T
    weights = [LAYOUTS[layout](uniform(n, s).to(dtype)) for s in (3, 4, 5)]
    results = []
    for evaluate, kind in ((bspline.evaluate, dtype), (bspline.evaluate_plain, torch.float64)):
        inputs = [t.detach().to(kind).requires_grad_() for t in (heights, u, v)]
        out = evaluate(*inputs)
        merit = sum((o * w.to(kind)).sum() for o, w in zip(out, weights, strict=True)) + out[0].sum()
        results.append((out, torch.autograd.grad(merit, inputs)))
    (out, grads), (plain, plain_grads) = results
    for a, b in zip(out, plain, strict=True):
        assert a.dtype == dtype and a.shape == u.shape
        close(a.detach(), b.detach(), dtype)
    for a, b, like in zip(grads, plain_grads, (heights, u, v), strict=True):
        assert a.dtype == dtype and a.shape == like.shape
        close(a, b, dtype, max(1.0, float(b.abs().max()) if b.numel() else 1.0))


@DTYPES
@pytest.mark.parametrize("layout", LAYOUTS)
def test_collect_and_its_gradients(layout, dtype):
    n = 5 * 7 * 300
    screen = Screen(0.0, (0.0, 16.0), (0.0, 8.0), (16, 10))  # pixels of 1 x 0.8 mm
    x, y = (LAYOUTS[layout](uniform(n, s).to(dtype) * 20 - 2) for s in (0, 1))
    flux = LAYOUTS[layout](uniform(n, 2).to(dtype))
    status = (LAYOUTS[layout](uniform(n, 3)) < 0.1).to(torch.uint8)
    weight = uniform((10, 16), 4)
    results = []
    for kind in (dtype, torch.float64):  # the kernel, and the plain form in double
        position = torch.stack([x, y]).to(kind).requires_grad_()
        rays = Landed(position, flux.to(kind), status)
        plain = (position, irradiance.landed_flux(rays), screen)
        image, outside = irradiance.collect(rays, screen) if not results else irradiance.collect_plain(*plain)
        merit = (image * weight).sum() + 0.3 * outside
        results.append((image.detach(), outside.detach(), torch.autograd.grad(merit, position)[0]))
    (image, outside, g), (expected, outside_plain, g_plain) = results
    assert image.dtype == outside.dtype == torch.float64 and g.dtype == dtype
    close(image, expected, torch.float64, 100)  # double arithmetic in both, whatever the landing's precision
    torch.testing.assert_close(outside, outside_plain, rtol=1e-12, atol=0)
    close(g, g_plain, dtype, 10)
    assert not g[:, status != 0].any()


@pytest.mark.parametrize(
    "outline",
    [Rectangle(6.0, 4.0), Rectangle(3.1, 3.9), Circle(1.7), Rounded(5.0, 3.5, corner_radius=1.2)],
    ids=("whole", "less", "round", "round corners"),
)
@pytest.mark.parametrize("m", (5, 18, 33))
def test_largest_and_where_and_how_many(m, outline):
    surface = rough(0.3, m, 1.0, m, (3.0, 2.0))
    i, j = (index.flatten() for index in torch.meshgrid(torch.arange(m - 2), torch.arange(m - 2), indexing="ij"))
    jet, (x, y) = Spans.of(surface, i, j).jet(QUARTERS), span_points(surface, i, j, QUARTERS)
    held = outline.contains(x, y).broadcast_to(jet.slope.shape)
    most, least = jet.curvatures
    grid = shape._grid(surface)
    limits, bounds = tuple(outline.limits), (1.0, 2.0, 0.5)
    values, place, count = spline.largest_bending(surface.heights.numpy(), grid[2:], grid[:2], limits, bounds)
    for k, wanted in enumerate((most, -least, jet.slope)):
        wanted = torch.where(held, wanted, -math.inf)
        assert values[k] == pytest.approx(float(wanted.max()), rel=1e-11)
        assert count[k] == int((wanted >= bounds[k]).sum())
        p, q, n = np.unravel_index(int(wanted.argmax()), wanted.shape)
        found = grid[0].flat[place[k, 0]], grid[1].flat[place[k, 1]]
        assert found == pytest.approx((float(x[p, 0, n]), float(y[0, q, n])), abs=1e-9)
