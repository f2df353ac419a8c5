"""How many cells of the control net light each pixel, and what of a picture is finer than they can make.

A cell is one square of the knots, and stands for one control point.  Where the light of k cells falls on a tile of the
target, the net has k numbers to shape it with; of the tile's cosines it can make about k, the coarsest first.  What the
others hold of the target is the least error to be had there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch

from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.trace import at_back
from bstcad.optics.tubes.collecting import collect
from bstcad.optics.tubes.launching import area_of, launch_tubes

TUBES = 256  # a side: cells are counted over tiles, not pixels
TILE = 16  # pixels a side
LIT = 0.01  # of the mean of a picture: what is darker is not lit


@dataclass(frozen=True, eq=False)
class ControlCells:
    """Of one lens and target."""

    a_pixel: np.ndarray = field(repr=False)  # (rows, columns) cells that light it, row 0 = y max
    target: np.ndarray = field(repr=False)  # (rows, columns)

    @property
    def median(self) -> float:
        """Cells a pixel, where the target is lit."""
        return float(np.median(self.a_pixel[self._lit]))

    @property
    def scarce(self) -> float:
        """The same that only a tenth of the lit pixels have less of."""
        return float(np.quantile(self.a_pixel[self._lit], 0.1))

    @property
    def _lit(self) -> np.ndarray:
        return self.target > LIT * self.target.mean()

    def floor(self, finer: float = 1.0) -> float:
        """RRMSD that is left if each tile has as many of its lowest cosines as cells light it.

        finer: times as many control points a side.
        """
        from scipy.fft import dctn

        tiles, cells = (_tiles(picture) for picture in (self.target, self.a_pixel))
        energy = dctn(tiles, axes=(1, 2), norm="ortho").reshape(len(tiles), -1)[:, COARSE_TO_FINE] ** 2
        made = np.floor(np.minimum(finer**2 * cells.sum((1, 2)), TILE**2)).astype(int)
        left = np.where(np.arange(TILE**2) >= made[:, None], energy, 0.0)
        return math.sqrt(float(left.sum()) / float((tiles**2).sum()))


@torch.no_grad()
def control_cells(channel: Channel, lens: Lens, screen: Screen, target: np.ndarray) -> ControlCells:
    """By ray tubes, each of which carries the part of the net that it crosses; channel: of a point, or parallel."""
    lens = channel.through(lens)
    tubes = launch_tubes(channel.source, lens, TUBES)
    x, y = at_back(tubes.coming, lens).rays.position[:2]
    pitch_x, pitch_y = lens.back.pitch
    cells = area_of(x, y).double() / (pitch_x * pitch_y)
    landed = tubes.landing(lens, screen.plane)
    corners = screen.pixels_of(landed.position.double())
    carried = torch.where(tubes.whole(landed) > 0, cells, torch.zeros_like(cells))
    return ControlCells(collect(corners, carried, screen.shape)[0].cpu().numpy(), np.asarray(target, dtype=float))


def _tiles(picture: np.ndarray) -> np.ndarray:
    """(number, TILE, TILE); what the last row and column of tiles lack is as at the border."""
    rows, columns = (-side % TILE for side in picture.shape)
    whole = np.pad(picture, ((0, rows), (0, columns)), mode="edge")
    parts = whole.reshape(whole.shape[0] // TILE, TILE, whole.shape[1] // TILE, TILE)
    return parts.transpose(0, 2, 1, 3).reshape(-1, TILE, TILE)


# The cosines of a tile by the length of their wave vectors.
COARSE_TO_FINE = np.argsort(np.hypot(*np.indices((TILE, TILE))).ravel(), kind="stable")
