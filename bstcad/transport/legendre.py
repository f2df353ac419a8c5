"""The c-transform for |x - y|²/2 on a grid, exact and linear in the number of cells.

phi^c(x) = min_y |x - y|²/2 - phi(y) = |x|²/2 - v*(x) with v(y) = |y|²/2 - phi(y), so a c-transform is a Legendre
transform, and that separates: v*(x1, x2) = max_y2 [x2 y2 + max_y1 (x1 y1 - v(y1, y2))].  Each line needs the lower
convex hull of its n values and one monotone walk (Lucet 1997, Numerical Algorithms 16).

Cell units throughout: cell centres at i + 1/2, i = 0 … n-1, and potentials over the square of the cell side.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

BLOCKS = 8  # independent pieces of work; fixed, so that no sum depends on the number of threads


def half_square(n: int) -> np.ndarray:
    """|x|²/2 at the cell centres, cell units, (n, n)."""
    q = 0.5 * (np.arange(n) + 0.5) ** 2
    return q[:, None] + q[None, :]


def legendre(v: np.ndarray) -> np.ndarray:
    """v*(x) = max_y x·y - v(y) over the cell centres, (n, n) -> (n, n), cell units; exact on the grid."""
    first, second = np.empty_like(v), np.empty_like(v)
    _lines(v, first)  # over y2: [y1, x2]
    _negated_transpose(first, second)
    _lines(second, first)  # over y1: [x2, x1]
    _negated_transpose(first, second)
    return np.negative(second, out=second)


def c_transform(phi: np.ndarray) -> np.ndarray:
    """phi^c(x) = min_y |x - y|²/2 - phi(y), cell units, (n, n)."""
    half = half_square(phi.shape[0])
    return half - legendre(half - phi)


@njit(cache=True, nogil=True)
def _line(v, out, hull):
    """out[i] = max_j (i + 1/2)(j + 1/2) - v[j]: lower hull of v, then a walk along it as i grows."""
    top = 0
    hull[0] = 0
    for j in range(1, v.size):
        while top > 0:
            a, b = hull[top - 1], hull[top]
            if (v[b] - v[a]) * (j - b) < (v[j] - v[b]) * (b - a):
                break  # b lies strictly below the chord from a to j
            top -= 1
        top += 1
        hull[top] = j
    k = 0
    for i in range(v.size):
        x = i + 0.5
        while k < top and x * (hull[k + 1] - hull[k]) >= v[hull[k + 1]] - v[hull[k]]:
            k += 1
        out[i] = x * (hull[k] + 0.5) - v[hull[k]]


@njit(cache=True, nogil=True, parallel=True)
def _lines(v, out):
    n = v.shape[0]
    for block in prange(BLOCKS):
        hull = np.empty(v.shape[1], np.int64)
        for r in range(block * n // BLOCKS, (block + 1) * n // BLOCKS):
            _line(v[r], out[r], hull)


@njit(cache=True, nogil=True, parallel=True)
def _negated_transpose(a, out):
    """out = -aᵀ, in tiles that stay in cache."""
    n = a.shape[0]
    tiles = (n + 31) // 32
    for bi in prange(tiles):
        for bj in range(tiles):
            for i in range(bi * 32, min(n, bi * 32 + 32)):
                for j in range(bj * 32, min(n, bj * 32 + 32)):
                    out[i, j] = -a[j, i]
