"""The fused kernels of the spline against the plain torch form: values and gradients."""

import pytest
import torch

from bstcad.optics import bspline
from bstcad.optics.kernels.compiling import fused
from tests.optics.kernels.arrays import DTYPES, LAYOUTS, close, uniform


@DTYPES
def test_kernels_serve_matching_cpu_tensors_only(dtype):
    a = torch.zeros(3, dtype=dtype)
    assert fused(a, a)
    assert not fused(a, a.to(torch.float16))
    assert not fused(a, torch.zeros(3, dtype=torch.float64 if dtype == torch.float32 else torch.float32))
    assert not fused(a.to("meta"), a.to("meta"))


@DTYPES
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("m", (5, 33))
def test_evaluate_and_its_gradients(m, layout, dtype):
    """Also with a net that is not contiguous, and where autograd hands over expanded gradients."""
    n = 5 * 7 * 300  # several chunks
    u, v = (LAYOUTS[layout](uniform(n, s, dtype) * (m - 1)) for s in (0, 1))
    net = (uniform(m * m, 2).view(m, m) - 0.5).to(dtype).T
    weights = [LAYOUTS[layout](uniform(n, s, dtype)) for s in (3, 4, 5)]
    results = []
    for evaluate, kind in ((bspline.evaluate, dtype), (bspline.evaluate_plain, torch.float64)):
        inputs = [t.detach().to(kind).requires_grad_() for t in (net, u, v)]
        out = evaluate(*inputs)
        merit = sum((o * w.to(kind)).sum() for o, w in zip(out, weights, strict=True)) + out[0].sum()
        results.append((out, torch.autograd.grad(merit, inputs)))
    (out, grads), (plain, plain_grads) = results
    for a, b in zip(out, plain, strict=True):
        assert a.dtype == dtype and a.shape == u.shape
        close(a.detach(), b.detach(), dtype)
    for a, b, like in zip(grads, plain_grads, (net, u, v), strict=True):
        assert a.dtype == dtype and a.shape == like.shape
        close(a, b, dtype, max(1.0, float(b.abs().max()) if b.numel() else 1.0))
