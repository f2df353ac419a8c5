"""Fused CPU kernels (numba) behind `irradiance.collect`: bilinear splatting of rays onto pixels, and its adjoint."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from bstcad.optics.numerics import reductions
from bstcad.optics.numerics.compiling import compiled

RAYS_PER_TASK = 4096  # number of rays per task, whose coordinates and results stay in the second-level cache


@compiled(threads_by="flux")
def _splat(position, flux, frame, image, touched, outside):
    """Splat rays bilinearly onto pixel centres; image (parts, rows, columns), outside (parts,): as in `Splat`."""
    n = flux.size
    count, rows, columns = image.shape
    share = (n + count - 1) // count
    for c in prange(count):
        own = image[c]
        far = 0.0
        for r in range(c * share, min(n, (c + 1) * share)):
            f = float(flux[r])
            if f == 0.0:
                continue
            x = (float(position[0, r]) - frame[0]) * frame[1]
            y = (frame[2] - float(position[1, r])) * frame[3]
            off_x, off_y = x - min(max(x, 0.0), columns), y - min(max(y, 0.0), rows)
            far += f * (off_x * off_x + off_y * off_y)
            x -= 0.5
            y -= 0.5
            if not (-1.0 < x < columns and -1.0 < y < rows):  # also excludes NaN
                continue
            i, j = int(math.floor(y)), int(math.floor(x))
            wy, wx = y - i, x - j
            reductions.clear(own, touched[c], max(i, 0), min(i + 2, rows))
            if i >= 0:
                if j >= 0:
                    own[i, j] += f * (1 - wy) * (1 - wx)
                if j + 1 < columns:
                    own[i, j + 1] += f * (1 - wy) * wx
            if i + 1 < rows:
                if j >= 0:
                    own[i + 1, j] += f * wy * (1 - wx)
                if j + 1 < columns:
                    own[i + 1, j + 1] += f * wy * wx
        outside[c] = far


@compiled(threads_by="flux")
def _splat_adjoint(position, flux, frame, g, g_outside, d_position):
    """Compute d_position from the gradients g (rows, columns) in the picture and g_outside in the sum of `outside`."""
    rows, columns = g.shape
    n = flux.size
    for c in prange((n + RAYS_PER_TASK - 1) // RAYS_PER_TASK):
        for r in range(c * RAYS_PER_TASK, min(n, (c + 1) * RAYS_PER_TASK)):
            d_position[0, r] = d_position[1, r] = 0.0
            f = float(flux[r])
            if f == 0.0:
                continue
            x = (float(position[0, r]) - frame[0]) * frame[1]
            y = (frame[2] - float(position[1, r])) * frame[3]
            d_x = 2.0 * g_outside * (x - min(max(x, 0.0), columns))
            d_y = 2.0 * g_outside * (y - min(max(y, 0.0), rows))
            x -= 0.5
            y -= 0.5
            if -1.0 < x < columns and -1.0 < y < rows:
                i, j = int(math.floor(y)), int(math.floor(x))
                wy, wx = y - i, x - j
                g00 = g[i, j] if i >= 0 and j >= 0 else 0.0
                g01 = g[i, j + 1] if i >= 0 and j + 1 < columns else 0.0
                g10 = g[i + 1, j] if i + 1 < rows and j >= 0 else 0.0
                g11 = g[i + 1, j + 1] if i + 1 < rows and j + 1 < columns else 0.0
                d_x += (1 - wy) * (g01 - g00) + wy * (g11 - g10)
                d_y += (1 - wx) * (g10 - g00) + wx * (g11 - g01)
            d_position[0, r] = f * d_x * frame[1]
            d_position[1, r] = -f * d_y * frame[3]


class Splat(torch.autograd.Function):
    """Map (position (2, n), flux (n,), frame, shape) to (image (rows, columns), outside), as `irradiance.collect` does.

    frame: x_min, columns per unit, y_max, rows per unit (of the receiver).  The gradient is taken in the position.
    """

    @staticmethod
    def forward(ctx: Any, position: Tensor, flux: Tensor, frame: tuple[float, ...], shape: tuple[int, int]) -> Any:  # noqa: D102
        ctx.save_for_backward(position, flux)
        ctx.frame = np.array(frame)
        count = reductions.parts(flux.numel())
        (image, touched), outside = reductions.buffers(count, *shape), np.zeros(count)
        _splat(position.detach().numpy(), flux.numpy(), ctx.frame, image, touched, outside)
        return torch.from_numpy(reductions.merged(image, touched)), torch.tensor(outside.sum())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g: Tensor, g_outside: Tensor) -> Any:  # noqa: D102
        position, flux = ctx.saved_tensors
        d_position = torch.empty_like(position)
        rays = position.detach().numpy(), flux.numpy()
        _splat_adjoint(*rays, ctx.frame, g.contiguous().numpy(), float(g_outside), d_position.numpy())
        return d_position, None, None, None
