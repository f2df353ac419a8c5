"""The fused splat against the plain torch form: picture and gradients."""

import pytest
import torch

from bstcad.optics import irradiance
from bstcad.optics.irradiance import Screen
from bstcad.optics.rays import Landed
from tests.optics.kernels.arrays import DTYPES, LAYOUTS, close, uniform


@DTYPES
@pytest.mark.parametrize("layout", LAYOUTS)
def test_collect_and_its_gradients(layout, dtype):
    n = 5 * 7 * 300
    screen = Screen(0.0, (0.0, 16.0), (0.0, 8.0), (16, 10))  # pixels of 1 x 0.8 mm
    x, y = (LAYOUTS[layout](uniform(n, s, dtype) * 20 - 2) for s in (0, 1))
    flux = LAYOUTS[layout](uniform(n, 2, dtype))
    status = (LAYOUTS[layout](uniform(n, 3)) < 0.1).to(torch.uint8)
    weight = uniform(160, 4).view(10, 16)
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
