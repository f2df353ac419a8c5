"""The thickness of the glass between two nets, and its excess over bounds, everywhere inside the outline.

Where the front is tailored, no move of the back along z makes up for a lens that is too thin: both faces make the
picture, and the light on its way from one to the other has changed by the time it gets there.  So the faces make way
for each other, by a penalty in the heights of both.

In a cell of a grid no coarser than either net, each face depends on four by four control points at most and lies
between the lowest and the highest of them.  Tiles of many cells are ruled out by these in one pass over the nets, and
where that does not do for all, single cells; in the others the thickness is looked at by the faces themselves, at
places a quarter of a cell apart.  (By numpy, in one thread: that is less work than to wake another.)
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.bspline import QUARTERS, SPANS, BSplineSurface, evaluate, net_gradient, span
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import inside
from bstcad.optics.sampling import rim
from bstcad.scene.blank import Bounds

MARGIN = 0.01  # of a bound, by which the penalty begins before it
RIM = 1025  # times four: points along the rim
WINDOW = 4  # control points along each axis that a cell may depend on: those of two spans
TILE = 16  # cells along each axis that are looked at together
ROUNDING = 1e-9  # of a cell: nets that are as fine as the cells shall not make them finer


def unit(lens: Lens, bounds: Bounds) -> float:
    """max(thinnest, MARGIN |z_back - z_front|), the length (mm) that excess of thickness is relative to.

    It stays as it is while the heights of the faces change, so that the penalty has the gradient that it says.
    """
    return max(bounds.thinnest, MARGIN * abs(lens.back.z - lens.front.z)) or 1.0


def clearance(lens: Lens, bounds: Bounds) -> tuple[float, dict[int, Tensor], float]:
    """(mean square, gradients (1/mm), worst) of the thickness t beyond its bounds.

    The gradients are in the heights of front and back, by the number of the face; none where no place is near.

    e = max(thinnest - t, t - thickest) / unit everywhere, and e = (edge - t) / unit along the rim.  The mean is over
    all places of the grid of max(e + MARGIN, 0)², the worst the largest e; -MARGIN if no place is nearer to a bound.
    The lens is of two nets in one precision; sums go in fixed parts, so no bit depends on the number of threads.
    """
    length, square, worst = unit(lens, bounds), 0.0, -MARGIN
    faces = {lens.number_of("front"): (lens.front, -1.0), lens.number_of("back"): (lens.back, 1.0)}  # and their ∂t / ∂z
    gradients: dict[int, Tensor] = {}
    for x, y, share, least in _places(lens, bounds, MARGIN * length):
        relative, thicker = _beyond(lens, x, y, replace(bounds, thinnest=least))
        relative, worst = relative / length, max(worst, float(relative.max()) / length)
        near = relative > -MARGIN
        if not near.any():
            continue
        x, y, over = x[near], y[near], relative[near] + MARGIN
        square += share * float(total(over * over))
        seed, none = 2 * share / length * thicker[near] * over, torch.zeros_like(x)
        for k, (net, sign) in faces.items():
            gradient = net_gradient(net.heights, *net.along_net(x, y), (sign * seed, none, none))
            gradients[k] = gradients[k] + gradient if k in gradients else gradient
    return square, gradients, worst


def _places(lens: Lens, bounds: Bounds, margin: float) -> Iterator[tuple[Tensor, Tensor, float, float]]:
    """x and y (mm) of places that may come within `margin` mm of a bound, their share in the mean, the least thickness.

    The share is that of one place; those of the rim have a mean of their own.
    """
    grid = Cells.over(lens)
    for x, y in grid.near(lens, bounds, margin):
        yield x, y, 1 / grid.places, bounds.thinnest
    if bounds.edge is not None:
        x, y = (p.to(lens.like) for p in rim(lens.outline, RIM))
        yield x, y, 1 / len(x), max(bounds.thinnest, bounds.edge)


def _beyond(lens: Lens, x: Tensor, y: Tensor, bounds: Bounds) -> tuple[Tensor, Tensor]:
    """How far (mm) the thickness is beyond the nearer of its bounds, and 1 where that is the greatest one, else -1."""
    front, back = (evaluate(net.heights, *net.along_net(x, y))[0] for net in (lens.front, lens.back))
    glass = (lens.back.z - lens.front.z) + back - front
    thin = bounds.thinnest - glass
    thick = torch.full_like(thin, -math.inf) if bounds.thickest is None else glass - bounds.thickest
    return torch.maximum(thin, thick), torch.where(thick > thin, 1.0, -1.0).to(thin)


@dataclass(frozen=True)
class Cells:
    """A grid over the bounding box of an outline, whose cells are no wider than a span of either net."""

    count: tuple[int, int]  # along x and along y
    half: tuple[float, float]  # of the box (mm)

    @classmethod
    def over(cls, lens: Lens) -> Cells:
        """For both nets of a lens."""
        half, pitches = lens.outline.half_extent, zip(lens.front.pitch, lens.back.pitch, strict=True)
        pairs = zip(half, pitches, strict=True)
        x, y = (max(1, math.ceil(2 * side / min(pitch) - ROUNDING)) for side, pitch in pairs)
        return cls((x, y), half)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of a cell (mm)."""
        (x, y), (half_x, half_y) = self.count, self.half
        return 2 * half_x / x, 2 * half_y / y

    @property
    def places(self) -> int:
        """Number of places at which the thickness counts, if it is near a bound there."""
        return math.prod(self.count) * len(QUARTERS) ** 2

    def near(self, lens: Lens, bounds: Bounds, margin: float) -> Iterator[tuple[Tensor, Tensor]]:
        """x and y (mm) of the places inside the outline whose cell may come within `margin` mm of a bound, in parts.

        The rim is inside: a cell that it crosses counts as far as half a cell's diagonal beyond it.
        """
        reach = math.hypot(*self.size) / 2
        for cells in torch.from_numpy(self._near(lens, bounds, margin)).split(SPANS):
            i, j = cells[inside(lens.outline.limits, *self._at(cells.T, 0.5), 2 * reach)].T
            s = torch.tensor(QUARTERS, dtype=torch.float64)
            x, y = self._at((i + s[:, None, None], j + s[:, None]), 0.0)
            x, y = (p.reshape(-1) for p in torch.broadcast_tensors(x, y))
            held = inside(lens.outline.limits, x, y, reach)
            if held.any():
                yield x[held].to(lens.like), y[held].to(lens.like)

    def _near(self, lens: Lens, bounds: Bounds, margin: float) -> np.ndarray:
        """(n, 2) numbers along x and along y of the cells that are near by the control points they depend on."""
        front, back = ((net.heights.detach().cpu().numpy(), self._begins(net)) for net in (lens.front, lens.back))
        apart = lens.back.z - lens.front.z
        for extremes in (_of_tiles, _of_cells):
            near = apart + extremes(*back, np.minimum) - extremes(*front, np.maximum) < bounds.thinnest + margin
            if bounds.thickest is not None:
                near |= apart + extremes(*back, np.maximum) - extremes(*front, np.minimum) > bounds.thickest - margin
            if not near.any():
                break
        return np.argwhere(near)

    def _at(self, cells: Sequence[Tensor], s: float) -> tuple[Tensor, Tensor]:
        """x and y (mm) of the same place in some cells."""
        x, y = ((k + s) * size - half for k, size, half in zip(cells, self.size, self.half, strict=True))
        return x, y

    def _begins(self, net: BSplineSurface) -> list[np.ndarray]:
        """The first of the WINDOW control points that each cell depends on, along x and along y."""
        left = [torch.arange(k, dtype=torch.float64) for k in self.count]
        along = zip(net.along_net(*self._at(left, 0.0)), net.shape, strict=True)
        return [span(u, m)[0].long().clamp(max=m - WINDOW).numpy() for u, m in along]


def _of_tiles(heights: np.ndarray, begins: Sequence[np.ndarray], extreme: np.ufunc) -> np.ndarray:
    """The lowest (np.minimum) or highest (np.maximum) of the heights that each tile of cells depends on (mm)."""
    for axis, begin in enumerate(begins):
        windows = [slice(part[0], part[-1] + WINDOW) for part in np.split(begin, range(TILE, len(begin), TILE))]
        parts = (heights[window] if axis == 0 else heights[:, window] for window in windows)
        heights = np.stack([extreme.reduce(part, axis) for part in parts], axis)
    return heights


def _of_cells(heights: np.ndarray, begins: Sequence[np.ndarray], extreme: np.ufunc) -> np.ndarray:
    """The same of each cell."""
    for axis, begin in enumerate(begins):
        heights = np.moveaxis(heights, axis, 0)
        for step in (1, 2):  # of two neighbours, then of four
            heights = extreme(heights[:-step], heights[step:])
        heights = np.moveaxis(heights[begin], 0, axis)
    return heights
