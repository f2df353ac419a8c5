"""Sums over the grid, compiled.  numpy hands them to BLAS, whose threads spin while they wait for a busy core."""

from __future__ import annotations

import numpy as np
from numba import njit


def inner(a: np.ndarray, b: np.ndarray) -> float:
    """Sum of a b over the cells, (n, m) both."""
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
