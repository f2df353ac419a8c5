"""Where rays are started: points in a rectangle, by grid, stratified (jittered), Sobol or at random.

Each function gives (x, y) in mm over `window` (centred on the axis); every point stands for window.area / n of it.

The jitter of a cell is a number of its own, not the next of a sequence: SplitMix64 (Steele, Lea and Flood 2014) of the
cell's place, so that any thread can start anywhere and gets the same points.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from bstcad.optics.outlines import Rectangle

STRIP = 1 << 18  # points a strip, about
STRIDE = 0x9E3779B97F4A7C15  # 2^64 over the golden ratio
MIX_1, MIX_2 = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB


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
    rows = max(1, STRIP // n)
    for first in range(0, n, rows):
        i = np.arange(first, min(first + rows, n))[:, None]
        j = np.arange(n)
        jitter_x, jitter_y = jitter(key(seed), i * n + j)
        x = (jitter_x + i) * (window.width / n) - window.width / 2
        y = (jitter_y + j) * (window.height / n) - window.height / 2
        yield torch.from_numpy(x).to(dtype), torch.from_numpy(y).to(dtype)


def key(seed: int) -> int:
    """A number of 64 bits that neighbouring seeds do not share a bit pattern in."""
    return int(_mix(np.array([(seed + STRIDE) % (1 << 64)], dtype=np.uint64))[0])


def jitter(key: int, cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two numbers in (0, 1), multiples of 2^-33, for each cell: SplitMix64's 64 bits, the upper and the lower half."""
    bits = _mix(np.uint64(key) + cell.astype(np.uint64) * np.uint64(STRIDE))
    return tuple((half + 0.5) * 2.0**-32 for half in (bits >> np.uint64(32), bits & np.uint64(0xFFFFFFFF)))


def _mix(z: np.ndarray) -> np.ndarray:
    """SplitMix64's finaliser: every bit of z changes each bit of the result with probability 1/2."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(MIX_1)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(MIX_2)
    return z ^ (z >> np.uint64(31))


def sobol(window: Rectangle, count: int, seed: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """`count` points of a scrambled Sobol sequence, each (count,)."""
    points = SobolEngine(2, scramble=True, seed=seed).draw(count, dtype=dtype) - 0.5
    return points[:, 0] * window.width, points[:, 1] * window.height


def random(window: Rectangle, count: int, seed: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """`count` independent uniform points, each (count,)."""
    points = torch.rand((2, count), generator=torch.Generator().manual_seed(seed), dtype=dtype) - 0.5
    return points[0] * window.width, points[1] * window.height
