"""The penalty on the thickness of the glass between two freeform faces, everywhere inside the outline.

If the front is tailored, a lens that is too thin cannot be corrected by a shift of the back along z: each face shapes
the light, and a shift changes where the light from the front meets the back.  So the penalty changes both faces.

In a cell of a grid no coarser than either net, each face depends on at most 4 x 4 control points, and lies between the
lowest and the highest of them.  These extremes often show for whole tiles of cells that the thickness is nowhere near a
bound; if not, they exclude single cells.  In the remaining cells the thickness is computed at points a quarter of a
cell apart.  (The extremes are computed by numpy in one thread: the work is too small for several threads.)
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.numerics.reductions import total
from bstcad.optics.surfaces.bspline import (
    QUARTERS,
    SPANS_AT_A_TIME,
    BSplineSurface,
    evaluate,
    net_gradient,
    require_net,
    span,
)
from bstcad.optics.surfaces.outlines import inside
from bstcad.optics.surfaces.sampling import sample_rim
from bstcad.tailoring.settings import Bounds

PENALTY_MARGIN = 0.01  # relative distance before a bound at which its penalty begins (thickness: distance / `unit`)
QUARTER_RIM_POINTS = 1025  # number of points along a quarter of the rim
CELL_POINTS = 4  # control points per axis on which a cell may depend: it lies in at most two knot spans
TILE_CELLS = 16  # number of cells per axis in a tile
CELL_ROUNDING = 1e-9  # allowance in the number of cells per axis, so that rounding adds no cell to an exact number


def unit(lens: Lens, bounds: Bounds) -> float:
    """Return max(thinnest, PENALTY_MARGIN |z_back - z_front|) (mm), unit of the excess in `clearance`; 1 instead of 0.

    The unit does not depend on the heights of the faces, and so does not contribute to the gradient.
    """
    return max(bounds.thinnest, PENALTY_MARGIN * abs(lens.back.z - lens.front.z)) or 1.0


def clearance(lens: Lens, bounds: Bounds) -> tuple[float, dict[int, Tensor], float]:
    """Return (penalty, its gradients in the heights (1/mm), largest excess) of the thickness t over its bounds.

    The excess is e = max(thinnest - t, t - thickest) / unit, along the rim with max(thinnest, edge) as thinnest.  With
    m = PENALTY_MARGIN the penalty is the mean of max(e + m, 0)² over the grid, plus the mean along the rim if `edge` is
    given.  If every e < -m, the largest excess is -m and the gradients are {}.  The keys of the gradients are the
    numbers of the faces.  Sums have fixed parts, so that no bit depends on the number of threads.
    """
    length, square, worst = unit(lens, bounds), 0.0, -PENALTY_MARGIN
    signs = zip(lens.faces, (-1.0, 1.0), strict=True)  # ∂t / ∂z
    faces = {lens.number_of(face.name): (require_net(face.surface), sign) for face, sign in signs}
    gradients: dict[int, Tensor] = {}
    for x, y, share, thinnest in _points_near_bounds(lens, bounds, PENALTY_MARGIN * length):
        relative, thicker = _excess(lens, x, y, replace(bounds, thinnest=thinnest))
        relative, worst = relative / length, max(worst, float(relative.max()) / length)
        near = relative > -PENALTY_MARGIN
        if not near.any():
            continue
        x, y, over = x[near], y[near], relative[near] + PENALTY_MARGIN
        square += share * float(total(over * over))
        seed, none = 2 * share / length * thicker[near] * over, torch.zeros_like(x)
        for k, (net, sign) in faces.items():
            gradient = net_gradient(net.heights, *net.along_net(x, y), (sign * seed, none, none))
            gradients[k] = gradients[k] + gradient if k in gradients else gradient
    return square, gradients, worst


def _points_near_bounds(lens: Lens, bounds: Bounds, margin: float) -> Iterator[tuple[Tensor, Tensor, float, float]]:
    """Yield (x, y, weight of each point, minimum thickness) of the points in cells with a thickness near a bound.

    Near: within `margin` (mm).  With `bounds.edge`, all points along the rim follow; their weights sum to 1.
    """
    grid = CellGrid.over(lens)
    for x, y in grid.near(lens, bounds, margin):
        yield x, y, 1 / grid.points, bounds.thinnest
    if bounds.edge is not None:
        x, y = (p.to(lens.like) for p in sample_rim(lens.outline, QUARTER_RIM_POINTS))
        yield x, y, 1 / len(x), max(bounds.thinnest, bounds.edge)


def _excess(lens: Lens, x: Tensor, y: Tensor, bounds: Bounds) -> tuple[Tensor, Tensor]:
    """Return the excess (mm) of the thickness over the nearer bound, and 1 if it is the maximum, -1 if the minimum."""
    front, back = (evaluate(net.heights, *net.along_net(x, y))[0] for net in (lens.front_net, lens.back_net))
    glass = (lens.back.z - lens.front.z) + back - front
    thin = bounds.thinnest - glass
    thick = torch.full_like(thin, -math.inf) if bounds.thickest is None else glass - bounds.thickest
    return torch.maximum(thin, thick), torch.where(thick > thin, 1.0, -1.0).to(thin)


@dataclass(frozen=True)
class CellGrid:
    """Grid over the bounding box of an outline, with cells no wider than a knot span of either net."""

    count: tuple[int, int]  # number of cells along x and along y
    half: tuple[float, float]  # half width and half height of the box (mm)

    @classmethod
    def over(cls, lens: Lens) -> CellGrid:
        """Make the grid for both nets of a lens."""
        half, pitches = lens.outline.half_extent, zip(lens.front_net.pitch, lens.back_net.pitch, strict=True)
        pairs = zip(half, pitches, strict=True)
        x, y = (max(1, math.ceil(2 * side / min(pitch) - CELL_ROUNDING)) for side, pitch in pairs)
        return cls((x, y), half)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of a cell (mm)."""
        (x, y), (half_x, half_y) = self.count, self.half
        return 2 * half_x / x, 2 * half_y / y

    @property
    def points(self) -> int:
        """Number of points of the grid at which the thickness is computed."""
        return math.prod(self.count) * len(QUARTERS) ** 2

    def near(self, lens: Lens, bounds: Bounds, margin: float) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield x, y (mm) of points inside the outline, in cells whose thickness may be within `margin` mm of a bound.

        Points up to half of a cell's diagonal outside the outline are included, so that the rim is covered.
        """
        reach = math.hypot(*self.size) / 2
        for cells in torch.from_numpy(self._near(lens, bounds, margin)).split(SPANS_AT_A_TIME):
            i, j = cells[inside(lens.outline.limits, *self._at(cells.T, 0.5), 2 * reach)].T
            s = torch.tensor(QUARTERS, dtype=torch.float64)
            x, y = self._at((i + s[:, None, None], j + s[:, None]), 0.0)
            x, y = (p.reshape(-1) for p in torch.broadcast_tensors(x, y))
            within = inside(lens.outline.limits, x, y, reach)
            if within.any():
                yield x[within].to(lens.like), y[within].to(lens.like)

    def _near(self, lens: Lens, bounds: Bounds, margin: float) -> np.ndarray:
        """Return the indices (n, 2) of the cells where the thickness may be within `margin` mm of a bound."""
        nets = lens.front_net, lens.back_net
        front, back = ((net.heights.detach().cpu().numpy(), self._first_points(net)) for net in nets)
        distance = lens.back.z - lens.front.z
        for extremes in (_tile_extremes, _cell_extremes):
            near = distance + extremes(*back, np.minimum) - extremes(*front, np.maximum) < bounds.thinnest + margin
            if bounds.thickest is not None:
                near |= distance + extremes(*back, np.maximum) - extremes(*front, np.minimum) > bounds.thickest - margin
            if not near.any():
                break
        return np.argwhere(near)

    def _at(self, cells: Sequence[Tensor], s: float) -> tuple[Tensor, Tensor]:
        """Return x and y (mm) at the fraction s of the width and height of each cell; cells: indices along x and y."""
        x, y = ((k + s) * size - half for k, size, half in zip(cells, self.size, self.half, strict=True))
        return x, y

    def _first_points(self, net: BSplineSurface) -> list[np.ndarray]:
        """Return the index of the first of the CELL_POINTS control points of each cell, along x and along y."""
        left = [torch.arange(k, dtype=torch.float64) for k in self.count]
        along = zip(net.along_net(*self._at(left, 0.0)), net.shape, strict=True)
        return [span(u, m)[0].long().clamp(max=m - CELL_POINTS).numpy() for u, m in along]


def _tile_extremes(heights: np.ndarray, begins: Sequence[np.ndarray], extreme: np.ufunc) -> np.ndarray:
    """Return the `extreme` (np.minimum or np.maximum) of the heights (mm) in each tile; begins: see `_first_points`."""
    for axis, begin in enumerate(begins):
        tiles = np.split(begin, range(TILE_CELLS, len(begin), TILE_CELLS))
        windows = [slice(tile[0], tile[-1] + CELL_POINTS) for tile in tiles]
        parts = (heights[window] if axis == 0 else heights[:, window] for window in windows)
        heights = np.stack([extreme.reduce(part, axis) for part in parts], axis)
    return heights


def _cell_extremes(heights: np.ndarray, begins: Sequence[np.ndarray], extreme: np.ufunc) -> np.ndarray:
    """Return the `extreme` (np.minimum or np.maximum) of the heights (mm) in each cell; begins: see `_first_points`."""
    for axis, begin in enumerate(begins):
        heights = np.moveaxis(heights, axis, 0)
        for step in (1, 2):  # extremes of two neighbouring control points, then of four
            heights = extreme(heights[:-step], heights[step:])
        heights = np.moveaxis(heights[begin], 0, axis)
    return heights
