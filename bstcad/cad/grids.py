"""Structured grids of mesh nodes: a square of cells whose border lies on an outline, and triangles over it."""

from __future__ import annotations

import numpy as np

from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.trace import tubes


def nodes(outline: Outline, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y (mm) of a square grid of nodes, each (cells + 1, cells + 1), whose border lies on the outline."""
    x, y = tubes.corners(outline, cells)
    return x.numpy(), y.numpy()


def triangles_over(grid: np.ndarray, rising: np.ndarray) -> np.ndarray:
    """Return the nodes of two triangles per cell of `grid`, (2 n², 3), counterclockwise.

    grid: indices of the nodes; rising: True (n, n) for cells divided by the diagonal from their first corner.
    """
    a, b, c, d = cell_corners(grid)
    first, second = triangles = np.empty((2, *a.shape, 3), grid.dtype)
    first[..., 0], first[..., 1], first[..., 2] = a, b, np.where(rising, c, d)
    second[..., 0], second[..., 1], second[..., 2] = np.where(rising, a, b), c, d
    return triangles.reshape(-1, 3)


def cell_corners(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return four arrays: the values at the four corners of each cell, counterclockwise."""
    return values[:-1, :-1], values[1:, :-1], values[1:, 1:], values[:-1, 1:]


def inward_diagonals(cells: int) -> np.ndarray:
    """Return True (cells, cells) for cells whose diagonal towards the centre is that from the first corner."""
    inner = np.arange(cells) < cells / 2
    return inner[:, None] == inner


def on_diagonals(cells: int) -> np.ndarray:
    """Return True (cells, cells) for cells on the two diagonals of the grid."""
    k = np.arange(cells)
    return (k[:, None] == k) | (k[:, None] == k[::-1])


def rim(grid: np.ndarray) -> np.ndarray:
    """Return the border nodes of the grid, once around, counterclockwise from its first corner."""
    return np.concatenate([grid[:-1, 0], grid[-1, :-1], grid[:0:-1, -1], grid[0, :0:-1]])


def wall_triangles(front: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Return two triangles between each pair of neighbours on the rims of front and back, facing outwards."""
    after_front, after_back = np.roll(front, -1), np.roll(back, -1)
    pairs = [front, after_front, after_back], [front, after_back, back]
    return np.concatenate([np.stack(pair, axis=1) for pair in pairs])
