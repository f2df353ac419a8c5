"""A density on the unit square: source and target of a transport."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array


@dataclass(frozen=True)
class Density:
    """rho >= 0 on [0, 1]², piecewise constant on n x n cells, mean 1.  Zero is allowed (outside a disc, say)."""

    values: np.ndarray  # (n, n) float64, [ix, iy]: cell ix along x, iy along y; mean 1

    @property
    def n(self) -> int:
        """Cells a side."""
        return self.values.shape[0]

    @property
    def mass_error(self) -> float:
        """|mean - 1|: the rounding error of the normalisation."""
        return abs(float(self.values.mean()) - 1.0)

    @classmethod
    def from_values(cls, values: np.ndarray, *, floor: float = 0.0) -> Density:
        """Cell averages (n, n), [ix, iy]; `floor` as in `from_picture`, over the whole square."""
        return _normalised(np.asarray(values, dtype=float), np.ones(np.shape(values)), floor, "density")

    @classmethod
    def from_function(
        cls, function: Callable[[np.ndarray, np.ndarray], np.ndarray], n: int, *, samples: int = 4, floor: float = 0.0
    ) -> Density:
        """Cell averages of function(x, y) on [0, 1]² from samples x samples midpoints a cell."""
        q = (np.arange(n * samples) + 0.5) / (n * samples)
        fine = np.broadcast_to(function(q[:, None], q[None, :]), (q.size, q.size)).astype(float)
        return cls.from_values(fine.reshape(n, samples, n, samples).mean(axis=(1, 3)), floor=floor)

    @classmethod
    def from_picture(
        cls, picture: np.ndarray, n: int, *, width: float = 1.0, height: float = 1.0, floor: float = 0.0
    ) -> Density:
        """Resample a grey picture by exact pixel-cell overlap areas.

        picture: (rows, columns), row 0 = y max, column 0 = x min; its pixels span width x height (any unit), which
        sits centred in the square of its longer side, so both axes keep one scale and the rest of the square is zero.
        floor: where the picture is darker than floor x its mean it is lifted to that (1e-3 … 1e-2 is usual);
        brighter regions stay as they are.
        """
        grey = np.asarray(picture, dtype=float)
        if grey.ndim != 2 or grey.size == 0:
            raise ValueError(f"picture: expected rows x columns of grey values, got shape {grey.shape}")
        if not (width > 0 and height > 0):
            raise ValueError(f"picture: its rectangle must have a positive width and height, got {width} x {height}")
        _refuse(grey, "picture")
        side = max(width, height)
        along_x = _overlaps(n, grey.shape[1], width / side)
        along_y = _overlaps(n, grey.shape[0], height / side)
        values = (along_y @ (along_x @ grey[::-1].T).T).T  # row 0 is y max
        return _normalised(values, np.outer(along_x.sum(axis=1), along_y.sum(axis=1)), floor, "picture")

    def halved(self) -> Density:
        """The same density on n/2 x n/2 cells (means of 2 x 2; n even)."""
        m = self.n // 2
        return Density(self.values.reshape(m, 2, m, 2).mean(axis=(1, 3)))

    def lifted(self, floor: float) -> Density:
        """At least floor x mean everywhere on the square."""
        if self.values.min() >= floor:
            return self
        return _normalised(self.values, np.ones(self.values.shape), floor, "density")


def _overlaps(n: int, pixels: int, extent: float) -> csr_array:
    """(n, pixels): the fraction of each of n cells of [0, 1] covered by each pixel of the centred interval `extent`.

    Sparse: the rounding of a product of full matrices depends on the number of threads.
    """
    edges = (0.5 + extent * (np.arange(pixels + 1) / pixels - 0.5)) * n
    cells = np.arange(n)[:, None]
    return csr_array(np.clip(np.minimum(edges[1:], cells + 1) - np.maximum(edges[:-1], cells), 0.0, None))


def _normalised(values: np.ndarray, cover: np.ndarray, floor: float, name: str) -> Density:
    """Lift to floor x (mean over the support), scale to mean 1.  cover: fraction of each cell inside the support."""
    if values.ndim != 2 or values.shape[0] != values.shape[1] or values.shape[0] < 4:
        raise ValueError(f"{name}: expected an n x n grid with n >= 4, got shape {values.shape}")
    _refuse(values, name)
    scaled = values / values.max()  # no overflow in the sums below
    raised = np.maximum(scaled, floor * scaled.mean() / cover.mean() * cover)
    return Density(raised / raised.mean())


def _refuse(values: np.ndarray, name: str) -> None:
    """ValueError unless the values are finite, not negative and not all zero."""
    if not np.isfinite(values).all() or values.min() < 0:
        raise ValueError(f"{name}: every value must be finite and not negative")
    if values.max() == 0:
        raise ValueError(f"{name}: it is black everywhere, so no light can be sent; give it a bright part")
