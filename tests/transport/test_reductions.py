"""The compiled sum against numpy's."""

import numpy as np
import pytest

from bstcad.transport.reductions import inner


@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (300, 300)])
def test_inner_product(shape):
    a, b = np.random.default_rng(0).random((2, *shape))
    assert inner(a, b) == pytest.approx((a * b).sum(), rel=1e-14)
