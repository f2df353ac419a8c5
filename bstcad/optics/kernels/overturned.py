"""Fused CPU kernel (numba) behind `folds.fold_penalty`: one pass over the triangles of the tubes, with the gradient."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from bstcad.optics.numerics.compiling import compiled

ROWS_PER_STRIP = 16  # rows of tubes that one thread computes at a time

inlined = njit(forceinline=True, error_model="numpy")


@inlined
def _triangle(corner, slope, i, j, p, q, u, v, factor, flux, least, most):
    """Add the gradient of F clip(least - factor A / F, 0, most)² to `slope`, and return the value; A: signed area.

    (i, j), (p, q) and (u, v): corners of the triangle.
    """
    ax, ay, bx, by = corner[0, i, j], corner[1, i, j], corner[0, p, q], corner[1, p, q]
    cx, cy = corner[0, u, v], corner[1, u, v]
    area = 0.5 * ((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))
    lack = least - factor * area / flux
    if not (lack > 0.0 and math.isfinite(area)):
        return 0.0
    if lack < most:
        weight = -factor * lack  # 2 F lack dlack/dA dA/dx, with dA/dx half a difference of coordinates
        slope[0, i, j] += weight * (by - cy)
        slope[1, i, j] += weight * (cx - bx)
        slope[0, p, q] += weight * (cy - ay)
        slope[1, p, q] += weight * (ax - cx)
        slope[0, u, v] += weight * (ay - by)
        slope[1, u, v] += weight * (bx - ax)
    return flux * min(lack, most) ** 2


@njit(error_model="numpy")
def _strip(corner, flux, factor, least, most, slope, first, last):
    """Return the penalty of the rows of tubes first … last - 1, and add its gradient to `slope`."""
    part = 0.0
    for k in range(first, last):
        for r in range(flux.shape[1]):
            half = 0.5 * flux[k, r]
            if half == 0.0:
                continue
            if (k + r) & 1:
                part += _triangle(corner, slope, k, r, k + 1, r, k, r + 1, factor, half, least, most)
                part += _triangle(corner, slope, k + 1, r, k + 1, r + 1, k, r + 1, factor, half, least, most)
            else:
                part += _triangle(corner, slope, k, r, k + 1, r, k + 1, r + 1, factor, half, least, most)
                part += _triangle(corner, slope, k, r, k + 1, r + 1, k, r + 1, factor, half, least, most)
    return part


@compiled(threads_by="flux", error_model="numpy")
def _penalty(corner, flux, factor, least, most, slope, sums):
    """Store the penalty of each strip of rows in `sums`, and add its gradient in the corners to `slope`.

    The even strips are computed first, then the odd ones, so that no two threads write one corner.
    """
    n, strips = flux.shape[0], sums.size
    for parity in range(2):
        for half_c in prange((strips - parity + 1) // 2):
            c = 2 * half_c + parity
            last = min(n, (c + 1) * ROWS_PER_STRIP)
            sums[c] = _strip(corner, flux, factor, least, most, slope, c * ROWS_PER_STRIP, last)


class Folds(torch.autograd.Function):
    """Map (corner (2, n + 1, m + 1), flux (n, m), factor, (least, most)) to the penalty: see `folds.fold_penalty`."""

    @staticmethod
    def forward(ctx: Any, corner: Tensor, flux: Tensor, factor: float, lack: tuple[float, float]) -> Tensor:  # noqa: D102
        points, carried = (t.detach().contiguous().numpy() for t in (corner, flux))
        slope, sums = np.zeros_like(points), np.zeros(-(-flux.shape[0] // ROWS_PER_STRIP))
        _penalty(points, carried, factor, *lack, slope, sums)
        ctx.slope = torch.from_numpy(slope)
        return torch.tensor(sums.sum(), dtype=torch.float64)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g: Tensor) -> Any:  # noqa: D102
        return g * ctx.slope, None, None, None
