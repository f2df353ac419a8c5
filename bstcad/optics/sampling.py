"""Where rays are started: points in a rectangle, by grid, stratified (jittered), Sobol or at random.

Each function gives (x, y) in mm over `window` (centred on the axis); every point stands for window.area / n of it.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from bstcad.optics.outlines import Rectangle


def grid(window: Rectangle, n: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Centres of n x n equal cells, each (n, n), x along the first axis."""
    centres = (torch.arange(n, dtype=dtype) + 0.5) / n - 0.5
    x, y = torch.meshgrid(centres * window.width, centres * window.height, indexing="ij")
    return x.contiguous(), y.contiguous()


def stratified(window: Rectangle, n: int, seed: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """One random point in each of n x n equal cells, each (n, n); neighbours in memory are neighbours in the lens."""
    x, y = grid(window, n, dtype)
    random = torch.Generator().manual_seed(seed)
    x += (torch.rand(x.shape, generator=random, dtype=dtype) - 0.5) * (window.width / n)
    y += (torch.rand(y.shape, generator=random, dtype=dtype) - 0.5) * (window.height / n)
    return x, y


def sobol(window: Rectangle, count: int, seed: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """`count` points of a scrambled Sobol sequence, each (count,)."""
    points = SobolEngine(2, scramble=True, seed=seed).draw(count, dtype=dtype) - 0.5
    return points[:, 0] * window.width, points[:, 1] * window.height


def random(window: Rectangle, count: int, seed: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """`count` independent uniform points, each (count,)."""
    points = torch.rand((2, count), generator=torch.Generator().manual_seed(seed), dtype=dtype) - 0.5
    return points[0] * window.width, points[1] * window.height
