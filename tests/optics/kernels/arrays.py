"""Arrays that the kernels are fed, and how near they have to come to the plain forms."""

import pytest
import torch

DTYPES = pytest.mark.parametrize("dtype", (torch.float32, torch.float64))
LAYOUTS = {
    "one row": lambda t: t,
    "three axes": lambda t: t.view(5, 7, -1),
    "every other": lambda t: t[::2],
    "transposed": lambda t: t.view(35, -1).T,
    "one": lambda t: t[:1],
    "none": lambda t: t[:0],
}


def close(a, b, dtype, scale=1.0, roundings=50):
    torch.testing.assert_close(a.double(), b.double(), rtol=0, atol=roundings * scale * torch.finfo(dtype).eps)
