"""The c-transform for |x - y|²/2 on a grid, exact and linear in the number of cells.

phi^c(x) = min_y |x - y|²/2 - phi(y) = |x|²/2 - v*(x) with v(y) = |y|²/2 - phi(y), so a c-transform is a Legendre
transform, and that separates: v*(x1, x2) = max_y2 [x2 y2 + max_y1 (x1 y1 - v(y1, y2))].  Each line needs the lower
convex hull of its n values and one monotone walk (Lucet 1997, Numerical Algorithms 16).  Which corner of the hull is
best from which x on follows from the slope of the side before it, so the walk has no condition to guess wrong.

Cell units throughout: cell centres at i + 1/2, i = 0 … n-1, and potentials over the square of the cell side.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from bstcad.transport.threads import BLOCKS

LINES = 8  # transformed together: eight doubles fill the cache line that their transpose is written to


def half_square(n: int) -> np.ndarray:
    """|x|²/2 at the cell centres, cell units, (n, n)."""
    q = 0.5 * (np.arange(n) + 0.5) ** 2
    return q[:, None] + q[None, :]


def legendre(v: np.ndarray) -> np.ndarray:
    """v*(x) = max_y x·y - v(y) over the cell centres, (n, n) -> (n, n), cell units; exact on the grid."""
    partial, whole = np.empty_like(v), np.empty_like(v)
    _transform_lines(v, partial, -1.0, BLOCKS)  # over y2: [x2, y1]
    _transform_lines(partial, whole, 1.0, BLOCKS)  # over y1: [x1, x2]
    return whole


@njit(cache=True, nogil=True, error_model="numpy")
def _line(v, out, hull, slope, first):
    """out[i] = max_j (i + 1/2)(j + 1/2) - v[j]; hull, slope (n) and first (n + 1): scratch.

    hull: corners of the lower hull; slope: of the side before each; first[i]: the last corner to be best from i on.
    """
    n = v.size
    top = 0
    hull[0] = 0
    for j in range(1, n):
        rise = (v[j] - v[hull[top]]) / (j - hull[top])
        while top > 0 and rise <= slope[top]:
            top -= 1
            rise = (v[j] - v[hull[top]]) / (j - hull[top])
        top += 1
        hull[top], slope[top] = j, rise
    first[:] = 0
    for k in range(1, top + 1):  # i + 1/2 >= slope
        first[np.int64(min(max(np.ceil(slope[k] - 0.5), 0.0), float(n)))] = k
    k = 0
    for i in range(n):
        k = max(k, first[i])
        out[i] = (i + 0.5) * (hull[k] + 0.5) - v[hull[k]]


@njit(cache=True, nogil=True, parallel=True)
def _transform_lines(v, out, sign, blocks):
    """out = sign x (transform of each row of v), transposed."""
    n = v.shape[0]
    for block in prange(blocks):
        hull, slope, first = np.empty(n, np.int64), np.empty(n), np.empty(n + 1, np.int64)
        done = np.empty((LINES, n))
        end = (block + 1) * n // blocks
        for r in range(block * n // blocks, end, LINES):
            lines = min(LINES, end - r)
            for k in range(lines):
                _line(v[r + k], done[k], hull, slope, first)
            for i in range(n):
                for k in range(lines):
                    out[i, r + k] = sign * done[k, i]
