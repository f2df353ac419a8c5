"""Where rays are started: points in a rectangle, by grid, stratified (jittered), Sobol or at random.

Each function gives (x, y) in mm over `window` (centred on the axis); every point stands for window.area / n of it.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from bstcad.optics.outlines import Rectangle

STRIP = 1 << 18  # points a strip, about; part of what a seed means


def grid(window: Rectangle, n: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Centres of n x n equal cells, each (n, n), x along the first axis."""
    centres = (torch.arange(n, dtype=dtype) + 0.5) / n - 0.5
    x, y = torch.meshgrid(centres * window.width, centres * window.height, indexing="ij")
    return x.contiguous(), y.contiguous()


def stratified(window: Rectangle, n: int, seed: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """One random point in each of n x n equal cells, each (n, n); neighbours in memory are neighbours in the lens."""
    x, y = zip(*stratified_strips(window, n, seed, dtype), strict=True)
    return torch.cat(x), torch.cat(y)


def stratified_strips(
    window: Rectangle, n: int, seed: int, dtype: torch.dtype = torch.float64
) -> Iterator[tuple[Tensor, Tensor]]:
    """The points of `stratified`, some rows of cells at a time, so that any number of them fits in memory and cache."""
    random = torch.Generator().manual_seed(seed)
    rows = max(1, STRIP // n)
    along_y = torch.arange(n, dtype=dtype)
    for first in range(0, n, rows):
        along_x = torch.arange(first, min(first + rows, n), dtype=dtype)[:, None]
        jitter_x, jitter_y = torch.rand((2, len(along_x), n), generator=random, dtype=dtype)
        x = (jitter_x.add_(along_x)).mul_(window.width / n).sub_(window.width / 2)
        y = (jitter_y.add_(along_y)).mul_(window.height / n).sub_(window.height / 2)
        yield x, y


def sobol(window: Rectangle, count: int, seed: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """`count` points of a scrambled Sobol sequence, each (count,)."""
    points = SobolEngine(2, scramble=True, seed=seed).draw(count, dtype=dtype) - 0.5
    return points[:, 0] * window.width, points[:, 1] * window.height


def random(window: Rectangle, count: int, seed: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """`count` independent uniform points, each (count,)."""
    points = torch.rand((2, count), generator=torch.Generator().manual_seed(seed), dtype=dtype) - 0.5
    return points[0] * window.width, points[1] * window.height
