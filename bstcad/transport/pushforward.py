"""Move a density by the gradient of a potential, cell by cell, without holes and without losing mass."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from bstcad.transport.legendre import BLOCKS


def pushforward(density: np.ndarray, u: np.ndarray) -> np.ndarray:
    """(∇u)_# density on the same n x n grid; u at cell centres in cell units.  Conserves the sum to rounding.

    The map is taken at the corners of each cell and is bilinear inside; the image of a cell is cut into pieces of at
    most half a cell each way, and each piece is laid down as a box of its own extent, by exact overlap areas.
    """
    n = density.shape[0]
    x, y = gradient_at_corners(u)
    parts = np.empty((BLOCKS, n, n))
    _splat(density, x, y, parts)
    return parts.sum(axis=0)


def gradient_at_corners(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """∇u at the (n + 1)² cell corners from u at the n² centres, cell units; linear to the rim, kept in the square."""
    n = u.shape[0]
    x, y = np.empty((n + 1, n + 1)), np.empty((n + 1, n + 1))
    _gradient(u, x, y)
    for a in (x, y):
        a[1:n, 0] = 2 * a[1:n, 1] - a[1:n, 2]
        a[1:n, n] = 2 * a[1:n, n - 1] - a[1:n, n - 2]
        a[0] = 2 * a[1] - a[2]
        a[n] = 2 * a[n - 1] - a[n - 2]
        np.clip(a, 0.0, n, out=a)
    return x, y


@njit(cache=True, nogil=True, parallel=True)
def _gradient(u, x, y):
    n = u.shape[0]
    for i in prange(n - 1):
        for j in range(n - 1):
            x[i + 1, j + 1] = 0.5 * (u[i + 1, j] - u[i, j] + u[i + 1, j + 1] - u[i, j + 1])
            y[i + 1, j + 1] = 0.5 * (u[i, j + 1] - u[i, j] + u[i + 1, j + 1] - u[i + 1, j])


@njit(cache=True, nogil=True, inline="always")
def _lay(out, n, x, y, wx, wy, m):
    """Spread m evenly over the box (x ± wx/2, y ± wy/2), wx, wy <= 1, pushed inside the square."""
    x0 = min(max(x - 0.5 * wx, 0.0), n - wx)
    y0 = min(max(y - 0.5 * wy, 0.0), n - wy)
    i, j = min(int(x0), n - 1), min(int(y0), n - 1)
    k, l = min(i + 1, n - 1), min(j + 1, n - 1)  # noqa: E741
    b = m * max(0.0, x0 + wx - (i + 1)) / wx  # the part that reaches the next column
    a = m - b
    f = max(0.0, y0 + wy - (j + 1)) / wy
    out[i, j] += a - a * f
    out[i, l] += a * f
    out[k, j] += b - b * f
    out[k, l] += b * f


@njit(cache=True, nogil=True, parallel=True)
def _splat(rho, x, y, parts):
    n = rho.shape[0]
    for block in prange(BLOCKS):
        out = parts[block]
        out[:] = 0.0
        for i in range(block * n // BLOCKS, (block + 1) * n // BLOCKS):
            for j in range(n):
                if rho[i, j] <= 0.0:
                    continue
                # sides of the image of the cell (e: along i, f: along j) and its twist (t)
                ex, ey = x[i + 1, j] - x[i, j], y[i + 1, j] - y[i, j]
                fx, fy = x[i, j + 1] - x[i, j], y[i, j + 1] - y[i, j]
                tx = x[i + 1, j + 1] - x[i, j + 1] - ex
                ty = y[i + 1, j + 1] - y[i, j + 1] - ey
                p = int(2.0 * max(max(abs(ex), abs(ex + tx)), max(abs(ey), abs(ey + ty)))) + 1
                q = int(2.0 * max(max(abs(fx), abs(fx + tx)), max(abs(fy), abs(fy + ty)))) + 1
                wx = min(1.0, max(1e-6, abs(ex + 0.5 * tx) / p + abs(fx + 0.5 * tx) / q))
                wy = min(1.0, max(1e-6, abs(ey + 0.5 * ty) / p + abs(fy + 0.5 * ty) / q))
                m = rho[i, j] / (p * q)
                for s in range(p):
                    a = (s + 0.5) / p
                    for t in range(q):
                        b = (t + 0.5) / q
                        px = x[i, j] + a * ex + b * (fx + a * tx)
                        py = y[i, j] + a * ey + b * (fy + a * ty)
                        _lay(out, n, px, py, wx, wy, m)
