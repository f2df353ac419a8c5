"""How the compiled loops over a grid share their work, and the sum that stands in for BLAS."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numba
import numpy as np
from numba import njit

BLOCKS = 8  # independent blocks of a loop; fixed, so that no sum depends on the number of threads
ONE_THREAD = 128  # cells a side


def threads_for(n: int) -> int:
    """Threads that pay on n x n cells: small grids finish before a second thread has woken up on a busy machine."""
    return 1 if n <= ONE_THREAD else min(2, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


@contextmanager
def threads(n: int) -> Iterator[None]:
    """Run the compiled kernels on `threads_for(n)` threads."""
    before = numba.get_num_threads()
    numba.set_num_threads(threads_for(n))
    try:
        yield
    finally:
        numba.set_num_threads(before)


def inner(a: np.ndarray, b: np.ndarray) -> float:
    """Σ a b over the cells, (n, m) both.  Compiled: the threads of BLAS spin while they wait for a busy core."""
    return float(_inner(a, b))


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _inner(a, b):
    total = 0.0
    for i in range(a.shape[0]):  # a sum for each row first: fewer digits are lost
        row = 0.0
        for j in range(a.shape[1]):
            row += a[i, j] * b[i, j]
        total += row
    return total
