"""Poisson's equation on the grid: cosine series along one axis, elimination along the other.

Hockney 1965, "A fast direct solution of Poisson's equation using Fourier analysis", Journal of the ACM 12.
-Δ is the five-point Laplacian on n x n cells with zero normal derivative.  In the cosine series of the second axis it
is, for the k-th term, the tridiagonal D + s_k with D the second difference along the first axis and
s_k = 4 sin²(πk/2n).  Lines of n cells are transformed where they lie in memory, and the elimination runs along them,
so nothing is ever read across lines.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from numba import njit, prange

from bstcad.transport.threads import BLOCKS, threads_for


class Poisson:
    """(-Δ)^-1 with zero normal derivative; the constant is free, and taken such that the mean is zero."""

    def __init__(self, n: int):
        """n: cells a side."""
        self.symbol = 4.0 * np.sin(0.5 * np.pi * np.arange(n) / n) ** 2  # (n,) s_k
        self.pivots = _pivots(self.symbol)
        self.keep, self.share = np.ones(n), np.zeros(n)

    def solve(self, r: np.ndarray) -> np.ndarray:
        """g with -Δg = r - mean(r), mean(g) = 0; cell units, (n, n) both."""
        workers = threads_for(r.shape[0])
        series = scipy.fft.dct(r, axis=1, workers=workers)
        series[:, 0] -= series[:, 0].mean()
        _eliminate(series, np.empty_like(series), self.pivots, self.keep, self.share, BLOCKS)
        series[:, 0] -= series[:, 0].mean()
        return scipy.fft.idct(series, axis=1, workers=workers, overwrite_x=True)


class PoissonWithoutCheckerboard(Poisson):
    """(-Δ)^-1 (1 - D_x D_y / 16), D the second differences: the checkerboard, where both are 4, maps to zero.

    With s_y for D_y it is ((1 + s_y²/16) / (D_x + s_y)) - s_y/16: one elimination again.
    """

    def __init__(self, n: int):
        """n: cells a side."""
        super().__init__(n)
        self.keep, self.share = 1.0 + self.symbol**2 / 16.0, self.symbol / 16.0


def _pivots(s: np.ndarray) -> np.ndarray:
    """(n, n): the inverse pivots of D + s_k, row i for the i-th cell of the line, column k for the k-th term.

    A pivot is 1 + e with e_i = s + e_(i-1) / (1 + e_(i-1)), positive terms only; the last one, at the rim, is e.
    For k = 0 that is zero: the line's end is set to zero, and the mean taken out afterwards.
    """
    n = s.size
    pivots, e = np.empty((n, n)), s.copy()
    for i in range(n - 1):
        pivots[i] = 1.0 / (1.0 + e)
        e = s + e * pivots[i]
    pivots[-1] = np.where(e > 0.0, 1.0 / np.where(e > 0.0, e, 1.0), 0.0)
    return pivots


@njit(cache=True, nogil=True, parallel=True)
def _eliminate(r, g, pivots, keep, share, blocks):
    """r -> keep (D + s)^-1 r - share r in place, each column a line; g: scratch."""
    n = r.shape[0]
    for block in prange(blocks):
        lo, hi = block * n // blocks, (block + 1) * n // blocks
        for k in range(lo, hi):
            g[0, k] = r[0, k] * pivots[0, k]
        for i in range(1, n):
            for k in range(lo, hi):
                g[i, k] = (r[i, k] + g[i - 1, k]) * pivots[i, k]
        for k in range(lo, hi):
            r[n - 1, k] = keep[k] * g[n - 1, k] - share[k] * r[n - 1, k]
        for i in range(n - 2, -1, -1):
            for k in range(lo, hi):
                g[i, k] += pivots[i, k] * g[i + 1, k]
                r[i, k] = keep[k] * g[i, k] - share[k] * r[i, k]
