"""Move a density by the gradient of a potential, and a picture's flux with its corners: no holes, no lost mass."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from bstcad.transport.threads import BLOCKS


def pushforward(density: np.ndarray, u: np.ndarray) -> np.ndarray:
    """(∇u)_# density on the same n x n grid; u at cell centres in cell units.  Conserves the sum to rounding.

    The map is taken at the corners of each cell and is bilinear inside; the image of a cell is cut into pieces of at
    most half a cell each way, and each piece is laid down as a box of its own extent, by exact overlap areas.
    """
    n = density.shape[0]
    x, y = gradient_at_corners(u)
    parts = np.empty((BLOCKS, n + 1, n + 1))  # a row and a column to spare; pages of rows out of reach stay unused
    reach = np.empty((BLOCKS, 2), np.int64)
    _splat(density, x, y, parts, reach)
    out = np.zeros((n, n))
    for part, (lo, hi) in zip(parts, reach, strict=True):
        out[lo:hi] += part[lo : min(hi, n), :n]
    return out


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


def spread(flux: np.ndarray, x: np.ndarray, y: np.ndarray, n: int, parts: tuple[int, int]) -> np.ndarray:
    """(n, n) flux on the cells of a square when (k, l) pixels have their corners x, y (k + 1, l + 1) there, in cells.

    Each pixel's flux is cut into parts[0] x parts[1] equal parts at bilinear points; the four cells with the nearest
    centres share each part.  Flux beyond the rim counts for the cell at the rim.
    """
    out = np.zeros((n, n))
    _spread(flux, x, y, *parts, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _spread(flux, x, y, along_x, along_y, out):
    n = out.shape[0]
    for k in range(flux.shape[0]):
        for m in range(flux.shape[1]):
            part = flux[k, m] / (along_x * along_y)
            if part == 0.0:  # also where the corners of black pixels lie nowhere
                continue
            for i in range(along_x):
                a = (i + 0.5) / along_x
                x0, x1 = (1 - a) * x[k, m] + a * x[k + 1, m], (1 - a) * x[k, m + 1] + a * x[k + 1, m + 1]
                y0, y1 = (1 - a) * y[k, m] + a * y[k + 1, m], (1 - a) * y[k, m + 1] + a * y[k + 1, m + 1]
                for j in range(along_y):
                    b = (j + 0.5) / along_y
                    px, py = (1 - b) * x0 + b * x1 - 0.5, (1 - b) * y0 + b * y1 - 0.5
                    if not abs(px) + abs(py) < np.inf:  # light that lies nowhere: no density comes of it
                        out[0, 0] = np.nan
                        continue
                    px, py = min(max(px, 0.0), n - 1.0), min(max(py, 0.0), n - 1.0)
                    row, column = int(px), int(py)
                    below, right = min(row + 1, n - 1), min(column + 1, n - 1)
                    u, v = px - row, py - column
                    out[row, column] += part * (1 - u) * (1 - v)
                    out[row, right] += part * (1 - u) * v
                    out[below, column] += part * u * (1 - v)
                    out[below, right] += part * u * v


@njit(cache=True, nogil=True, parallel=True)
def _gradient(u, x, y):
    n = u.shape[0]
    for i in prange(n - 1):
        for j in range(n - 1):
            x[i + 1, j + 1] = 0.5 * (u[i + 1, j] - u[i, j] + u[i + 1, j + 1] - u[i, j + 1])
            y[i + 1, j + 1] = 0.5 * (u[i, j + 1] - u[i, j] + u[i + 1, j + 1] - u[i + 1, j])


@njit(cache=True, nogil=True)
def _rows_reached(x):
    """First and last + 1 of the rows of pixels that boxes centred between these corners can touch."""
    n = x.shape[1] - 1
    least, most = float(n), 0.0
    for i in range(x.shape[0]):
        for j in range(n + 1):
            least, most = min(least, x[i, j]), max(most, x[i, j])
    return max(int(least) - 1, 0), min(int(most) + 3, n + 1)


@njit(cache=True, nogil=True, parallel=True, error_model="numpy", fastmath={"contract"})
def _splat(rho, x, y, parts, reach):
    """parts[block]: what the cells of one block of rows send, laid down between the two rows of reach[block]."""
    n, blocks = rho.shape[0], parts.shape[0]
    for turn in prange(blocks):
        block = 2 * turn % blocks + 2 * turn // blocks  # even ones, then odd ones: a share of every region each
        begin, end = block * n // blocks, (block + 1) * n // blocks
        lo, hi = _rows_reached(x[begin : end + 1])
        reach[block, 0], reach[block, 1] = lo, hi
        out = parts[block]
        for i in range(lo, hi):
            for j in range(n + 1):
                out[i, j] = 0.0
        for i in range(begin, end):
            for j in range(n):
                if rho[i, j] > 0.0:
                    _lay_cell(out, n, rho[i, j], x, y, i, j)
        for i in range(lo, hi):  # what rounding has laid beyond the rim
            out[i, n - 1] += out[i, n]
        if hi > n:
            for j in range(n):
                out[n - 1, j] += out[n, j]


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _lay_cell(out, n, mass, x, y, i, j):
    """Add the pieces of the image of cell (i, j) to out (n + 1, n + 1)."""
    # sides of the image (e: along i, f: along j) and its twist (t)
    x0, y0 = x[i, j], y[i, j]
    ex, ey = x[i + 1, j] - x0, y[i + 1, j] - y0
    fx, fy = x[i, j + 1] - x0, y[i, j + 1] - y0
    tx = x[i + 1, j + 1] - x[i, j + 1] - ex
    ty = y[i + 1, j + 1] - y[i, j + 1] - ey
    p = int(2.0 * max(max(abs(ex), abs(ex + tx)), max(abs(ey), abs(ey + ty)))) + 1
    q = int(2.0 * max(max(abs(fx), abs(fx + tx)), max(abs(fy), abs(fy + ty)))) + 1
    da, db = 1.0 / p, 1.0 / q
    # sides of the box of a piece: at most 1, so that it falls on two pixels each way at most
    wx = min(1.0, max(1e-6, abs(ex + 0.5 * tx) * da + abs(fx + 0.5 * tx) * db))
    wy = min(1.0, max(1e-6, abs(ey + 0.5 * ty) * da + abs(fy + 0.5 * ty) * db))
    right, high = n - wx, n - wy  # where a box that begins further on is pushed back to
    per_x, per_y = 1.0 / wx, 1.0 / wy
    least_x, least_y = 1.0 - per_x, 1.0 - per_y
    m = mass * da * db
    one = np.uint64(1)
    for s in range(p):
        a = (s + 0.5) * da
        left, low = x0 + a * ex - 0.5 * wx, y0 + a * ey - 0.5 * wy
        along_x, along_y = (fx + a * tx) * db, (fy + a * ty) * db
        b = -0.5
        for _ in range(q):
            b += 1.0
            px = min(max(left + b * along_x, 0.0), right)
            py = min(max(low + b * along_y, 0.0), high)
            row, column = np.floor(px), np.floor(py)
            f = max(0.0, (px - row) * per_x + least_x)  # the part that reaches the next row
            g = max(0.0, (py - column) * per_y + least_y)
            far = m * f
            near = m - far
            r, c = np.uint64(np.int64(row)), np.uint64(np.int64(column))  # unsigned: no test for indices from the end
            out[r, c] += near - near * g
            out[r, c + one] += near * g
            out[r + one, c] += far - far * g
            out[r + one, c + one] += far * g
