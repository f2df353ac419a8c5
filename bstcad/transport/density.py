"""Densities on the unit square, source and target of a transport, and their pushforward under a gradient map.

Loops are divided into BLOCKS and a compiled sum replaces BLAS: no result depends on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numba
import numpy as np
from numba import prange
from scipy.sparse import csr_array

from bstcad.runs.kernel_cache import compiled_kernel

BLOCKS = 8  # number of independent blocks of a loop, fixed so that no sum depends on the number of threads
MAX_SINGLE_THREAD_CELLS = 128  # largest grid, in cells per side, solved by one thread


@dataclass(frozen=True)
class Density:
    """Density rho >= 0 on [0, 1]², piecewise constant on n x n cells, of mean 1; zeros are allowed."""

    values: np.ndarray  # (n, n) float64, [ix, iy]: cell ix along x, iy along y; mean 1

    @property
    def n(self) -> int:
        """Number of cells per side."""
        return self.values.shape[0]

    @classmethod
    def from_values(cls, values: np.ndarray, *, floor: float = 0.0) -> Density:
        """Return the density with these cell averages (n, n), [ix, iy]; floor: smallest value, relative to the mean."""
        return _normalised(np.asarray(values, dtype=float), np.ones(np.shape(values)), floor, "density")

    @classmethod
    def from_function(
        cls, function: Callable[[np.ndarray, np.ndarray], np.ndarray], n: int, *, samples: int = 4, floor: float = 0.0
    ) -> Density:
        """Return the density of function(x, y) on [0, 1]², the mean of samples² points in a cell; see `from_values`."""
        q = (np.arange(n * samples) + 0.5) / (n * samples)
        fine = np.broadcast_to(function(q[:, None], q[None, :]), (q.size, q.size)).astype(float)
        return cls.from_values(fine.reshape(n, samples, n, samples).mean(axis=(1, 3)), floor=floor)

    @classmethod
    def from_picture(
        cls, picture: np.ndarray, n: int, *, width: float = 1.0, height: float = 1.0, floor: float = 0.0
    ) -> Density:
        """Resample a grey picture to n x n cells, by exact overlap areas of pixels and cells.

        picture: (rows, columns), row 0 = y max, column 0 = x min.  Its pixels span width x height (any unit), centred
        in the square of the longer side, so that x and y have equal scales; the rest of the square is zero.
        floor: smallest value inside the picture, relative to its mean, such as 1e-3; darker cells are raised to this.
        """
        grey = np.asarray(picture, dtype=float)
        if grey.ndim != 2 or grey.size == 0:
            raise ValueError(f"picture: has the shape {grey.shape}; give rows x columns of grey values")
        if not (width > 0 and height > 0):
            raise ValueError(f"picture: its rectangle is {width} x {height}; give a positive width and height")
        _check_values(grey, "picture")
        side = max(width, height)
        along_x = _overlaps(n, grey.shape[1], width / side)
        along_y = _overlaps(n, grey.shape[0], height / side)
        values = (along_y @ (along_x @ grey[::-1].T).T).T  # row 0 is y max
        return _normalised(values, np.outer(along_x.sum(axis=1), along_y.sum(axis=1)), floor, "picture")

    def halved(self) -> Density:
        """Return the density on n/2 x n/2 cells, as means of 2 x 2 cells; n must be even."""
        m = self.n // 2
        return Density(self.values.reshape(m, 2, m, 2).mean(axis=(1, 3)))

    def lifted(self, floor: float) -> Density:
        """Return the density raised to at least floor times its mean everywhere on the square."""
        if self.values.min() >= floor:
            return self
        return _normalised(self.values, np.ones(self.values.shape), floor, "density")


def _overlaps(n: int, pixels: int, extent: float) -> csr_array:
    """Return the fraction (n, pixels) of each of n cells of [0, 1] in each pixel of a centred interval `extent` long.

    The matrix is sparse, since the rounding of a product of dense matrices depends on the number of threads.
    """
    edges = (0.5 + extent * (np.arange(pixels + 1) / pixels - 0.5)) * n
    cells = np.arange(n)[:, None]
    return csr_array(np.clip(np.minimum(edges[1:], cells + 1) - np.maximum(edges[:-1], cells), 0.0, None))


def _normalised(values: np.ndarray, cover: np.ndarray, floor: float, name: str) -> Density:
    """Raise values to at least floor x (mean in the picture), then scale to mean 1; cover: fraction of a cell in it."""
    if values.ndim != 2 or values.shape[0] != values.shape[1] or values.shape[0] < 4:
        raise ValueError(f"{name}: has the shape {values.shape}; give an n x n grid with n >= 4")
    _check_values(values, name)
    scaled = values / values.max()  # avoids overflow in the sums below
    raised = np.maximum(scaled, floor * scaled.mean() / cover.mean() * cover)
    return Density(raised / raised.mean())


def _check_values(values: np.ndarray, name: str) -> None:
    """Raise ValueError unless the values are finite, not negative and not all zero."""
    if not np.isfinite(values).all() or values.min() < 0:
        raise ValueError(f"{name}: has values that are negative or not finite; give finite values of at least 0")
    if values.max() == 0:
        raise ValueError(f"{name}: is black everywhere, so no light can be sent; give it a bright part")


def pushforward(density: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the density (n, n) after the map ∇u has moved it; u: (n, n), cell units.  Its sum is conserved.

    The map is evaluated at the corners of each cell and is bilinear inside.  The image of a cell is divided into pieces
    of at most half a cell along each axis, and each piece is added as a box of its own extent, by exact overlap areas.
    """
    n = density.shape[0]
    x, y = gradient_at_corners(u)
    parts = np.empty((BLOCKS, n + 1, n + 1))  # one spare row and column; rows that receive nothing use no memory
    reach = np.empty((BLOCKS, 2), np.int64)
    _splat(density, x, y, parts, reach)
    out = np.zeros((n, n))
    for part, (lo, hi) in zip(parts, reach, strict=True):
        out[lo:hi] += part[lo : min(hi, n), :n]
    return out


def gradient_at_corners(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ∇u at the (n + 1)² cell corners from u at the n² cell centres, in cell units, clipped to the square."""
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


def resample_flux(flux: np.ndarray, x: np.ndarray, y: np.ndarray, n: int, parts: tuple[int, int]) -> np.ndarray:
    """Return the flux (n, n) in the cells of a square from pixels with corners x, y (k + 1, l + 1) in cell units.

    The flux (k, l) of each pixel is divided into parts[0] x parts[1] equal parts, evenly spaced in the pixel; each part
    is divided among the four cells with the nearest centres.  Flux outside the square is added to the cell at the rim.
    """
    out = np.zeros((n, n))
    _resample(flux, x, y, *parts, out)
    return out


@compiled_kernel(error_model="numpy")
def _resample(flux, x, y, along_x, along_y, out):
    n = out.shape[0]
    for k in range(flux.shape[0]):
        for m in range(flux.shape[1]):
            part = flux[k, m] / (along_x * along_y)
            if part == 0.0:  # black pixels may have corners that are not finite
                continue
            for i in range(along_x):
                a = (i + 0.5) / along_x
                x0, x1 = (1 - a) * x[k, m] + a * x[k + 1, m], (1 - a) * x[k, m + 1] + a * x[k + 1, m + 1]
                y0, y1 = (1 - a) * y[k, m] + a * y[k + 1, m], (1 - a) * y[k, m + 1] + a * y[k + 1, m + 1]
                for j in range(along_y):
                    b = (j + 0.5) / along_y
                    px, py = (1 - b) * x0 + b * x1 - 0.5, (1 - b) * y0 + b * y1 - 0.5
                    if not abs(px) + abs(py) < np.inf:  # flux at a position that is not finite: a NaN as result
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


@compiled_kernel(parallel=True)
def _gradient(u, x, y):
    n = u.shape[0]
    for i in prange(n - 1):
        for j in range(n - 1):
            x[i + 1, j + 1] = 0.5 * (u[i + 1, j] - u[i, j] + u[i + 1, j + 1] - u[i, j + 1])
            y[i + 1, j + 1] = 0.5 * (u[i, j + 1] - u[i, j] + u[i + 1, j + 1] - u[i + 1, j])


@compiled_kernel()
def _rows_reached(x):
    """Return the range (first, last + 1) of the rows of cells that boxes centred between the corners x can touch."""
    n = x.shape[1] - 1
    least, most = float(n), 0.0
    for i in range(x.shape[0]):
        for j in range(n + 1):
            least, most = min(least, x[i, j]), max(most, x[i, j])
    return max(int(least) - 1, 0), min(int(most) + 3, n + 1)


@compiled_kernel(parallel=True, error_model="numpy", fastmath={"contract"})
def _splat(rho, x, y, parts, reach):
    """Add the images of the cells of each block of rows to parts[block], and store the rows reached in reach[block]."""
    n, blocks = rho.shape[0], parts.shape[0]
    for turn in prange(blocks):
        block = 2 * turn % blocks + 2 * turn // blocks  # even, then odd blocks: each thread gets rows from all regions
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
        for i in range(lo, hi):  # flux placed outside the rim by rounding
            out[i, n - 1] += out[i, n]
        if hi > n:
            for j in range(n):
                out[n - 1, j] += out[n, j]


@compiled_kernel(inline="always", error_model="numpy")
def _lay_cell(out, n, mass, x, y, i, j):
    """Add the pieces of the image of cell (i, j) to out (n + 1, n + 1)."""
    # edge vectors of the image of the cell (e: along i, f: along j) and its twist (t)
    x0, y0 = x[i, j], y[i, j]
    ex, ey = x[i + 1, j] - x0, y[i + 1, j] - y0
    fx, fy = x[i, j + 1] - x0, y[i, j + 1] - y0
    tx = x[i + 1, j + 1] - x[i, j + 1] - ex
    ty = y[i + 1, j + 1] - y[i, j + 1] - ey
    p = int(2.0 * max(max(abs(ex), abs(ex + tx)), max(abs(ey), abs(ey + ty)))) + 1
    q = int(2.0 * max(max(abs(fx), abs(fx + tx)), max(abs(fy), abs(fy + ty)))) + 1
    da, db = 1.0 / p, 1.0 / q
    # sides of the box of a piece: at most 1, so that it covers at most two pixels along each axis
    wx = min(1.0, max(1e-6, abs(ex + 0.5 * tx) * da + abs(fx + 0.5 * tx) * db))
    wy = min(1.0, max(1e-6, abs(ey + 0.5 * ty) * da + abs(fy + 0.5 * ty) * db))
    right, high = n - wx, n - wy  # largest start of a box inside the grid
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
            f = max(0.0, (px - row) * per_x + least_x)  # fraction in the next row
            g = max(0.0, (py - column) * per_y + least_y)
            far = m * f
            near = m - far
            r, c = np.uint64(np.int64(row)), np.uint64(np.int64(column))  # unsigned: no check for negative indices
            out[r, c] += near - near * g
            out[r, c + one] += near * g
            out[r + one, c] += far - far * g
            out[r + one, c + one] += far * g


def threads_for(n: int) -> int:
    """Return the number of threads for n x n cells: one on a small grid, which two do not speed up, else up to two."""
    return 1 if n <= MAX_SINGLE_THREAD_CELLS else min(2, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


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
    """Return Σ a b over the cells of a and b (n, m); compiled, since waiting BLAS threads would keep a core busy."""
    return float(_inner(a, b))


@compiled_kernel(fastmath={"reassoc", "contract"})
def _inner(a, b):
    total = 0.0
    for i in range(a.shape[0]):  # sum each row first, for accuracy
        row = 0.0
        for j in range(a.shape[1]):
            row += a[i, j] * b[i, j]
        total += row
    return total
