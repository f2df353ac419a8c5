"""Fused CPU kernel (numba) behind `irradiance.picture_error`: the error of a picture on pixels and on their cells.

One pass over the cells computes the error and its gradient; torch would need a dozen passes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from bstcad.optics.numerics import reductions
from bstcad.optics.numerics.compiling import compiled
from bstcad.optics.receivers.irradiance import CellTarget

SUMS = 4  # sums of each row of pixels: the error, and E^s, (E^s)² and E^s E of the pixels
ERROR, LIGHT, SQUARE, PRODUCT = range(SUMS)


@compiled(threads_by="image", error_model="numpy")
def _errors(image, target, flux, weights, gradient, sums):
    """Store the gradient of Σ_l weights[l] Σ d_l², and the sums of each row of pixels.

    image, target, gradient (k m, k n): cells; k = 2^(levels - 1), and weights (levels,).  d_l: sums of image / flux -
    target over squares of k / 2^l cells per side, pixels for l = 0 and cells for the last l.  sums (m, SUMS).
    """
    levels = weights.size
    cells, inverse = 1 << (levels - 1), 1.0 / flux
    m, n = sums.shape[0], image.shape[1] // cells
    for row in prange(m):
        part = np.zeros((levels, cells, cells))  # d_l of a pixel, in the first 2^l rows and columns
        error = light = square = product = 0.0
        first = cells * row
        for column in range(n):
            left, lit = cells * column, False
            value_of_pixel = wanted_of_pixel = 0.0
            for i in range(cells):
                for j in range(cells):
                    value, wanted = image[first + i, left + j] * inverse, target[first + i, left + j]
                    lit |= value != 0.0 or wanted != 0.0
                    value_of_pixel += value
                    wanted_of_pixel += wanted
                    part[levels - 1, i, j] = value - wanted
            if not lit:
                gradient[first : first + cells, left : left + cells] = 0.0
                continue
            light += value_of_pixel
            square += value_of_pixel * value_of_pixel
            product += value_of_pixel * wanted_of_pixel
            for level in range(levels - 2, -1, -1):
                finer = part[level + 1]
                for i in range(1 << level):
                    for j in range(1 << level):
                        p, q = 2 * i, 2 * j
                        part[level, i, j] = (finer[p, q] + finer[p, q + 1]) + (finer[p + 1, q] + finer[p + 1, q + 1])
            for level in range(levels):
                for i in range(1 << level):
                    for j in range(1 << level):
                        d = part[level, i, j]
                        part[level, i, j] = 2.0 * inverse * weights[level] * d
                        error += weights[level] * d * d
                        if level > 0:  # the gradient in the sum that contains this one
                            part[level, i, j] += part[level - 1, i >> 1, j >> 1]
            for i in range(cells):
                for j in range(cells):
                    gradient[first + i, left + j] = part[levels - 1, i, j]
        sums[row, ERROR], sums[row, LIGHT], sums[row, SQUARE], sums[row, PRODUCT] = error, light, square, product


class PictureError(torch.autograd.Function):
    """Map (image, flux, target) to (error, RRMSD on pixels): see `irradiance.picture_error`."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, flux: Tensor, target: CellTarget) -> Any:  # noqa: D102
        # transposed, as `tubes.collect` makes pictures: this copies nothing
        values, wanted = (np.ascontiguousarray(t.detach().numpy().T) for t in (image, target.picture))
        gradient, sums = np.empty_like(values), np.empty((values.shape[0] >> (len(target.weights) - 1), SUMS))
        _errors(values, wanted, float(flux), np.array(target.weights), gradient, sums)
        found = sums.sum(0)
        scaled = found[SQUARE] / found[LIGHT] ** 2 - 2 * found[PRODUCT] / found[LIGHT] + target.size
        ctx.gradient = torch.from_numpy(gradient).T
        # total in fixed parts, so that threads change no bit
        ctx.by_flux = -float(reductions.total(ctx.gradient.T * torch.from_numpy(values))) if flux.requires_grad else 0.0
        ctx.by_flux /= float(flux)
        rrmsd = torch.tensor(max(scaled, 0.0) / target.size, dtype=torch.float64).sqrt()
        ctx.mark_non_differentiable(rrmsd)
        return torch.tensor(found[ERROR], dtype=torch.float64), rrmsd

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g: Tensor, _: Tensor) -> Any:  # noqa: D102
        return ctx.gradient if float(g) == 1.0 else g * ctx.gradient, g * ctx.by_flux, None
