"""The number of threads changes no result, and is put back; the compiled sum is numpy's."""

import os
import subprocess
import sys

import numba
import numpy as np
import pytest

from bstcad.transport.density import ONE_THREAD, inner, threads, threads_for


def test_small_grids_use_one_and_the_number_is_put_back():
    before = numba.get_num_threads()
    with threads(ONE_THREAD):
        assert numba.get_num_threads() == 1
    with pytest.raises(KeyError), threads(ONE_THREAD):
        raise KeyError
    assert numba.get_num_threads() == before
    assert threads_for(ONE_THREAD + 1) <= numba.config.NUMBA_NUM_THREADS


BITS = """
import numba, numpy as np
from bstcad.transport.bfm import half_square, legendre
from bstcad.transport.density import pushforward
n, rng = 100, np.random.default_rng(0)
rho, v = rng.random((n, n)), half_square(n) - 5.0 * rng.normal(size=(n, n))
found = []
for count in (1, 2):
    numba.set_num_threads(count)
    u = legendre(v)
    found.append((u, pushforward(rho, u)))
print([bool(np.array_equal(one, two)) for one, two in zip(*found)])
"""


def test_one_thread_and_two_agree_to_the_last_digit():
    """In a process that may have two threads however few cores the machine has."""
    two = os.environ | {"NUMBA_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", BITS], env=two, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[True, True]", done.stderr


@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (300, 300)])
def test_inner_product(shape):
    a, b = np.random.default_rng(0).random((2, *shape))
    assert inner(a, b) == pytest.approx((a * b).sum(), rel=1e-14)
