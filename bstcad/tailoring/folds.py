"""Penalty on folded light: flux tubes that land overturned, or far too dense.

Where a tube lands overturned, three sheets of light overlap, with bright and dark lines beside each other that are
finer than a pixel.  A merit of squared errors has local minima there.  If the lit part of a target is convex and its
light has no fine detail, the optimal map is smooth (Caffarelli 1992) and folds no light, so that folds can be
penalised.
Letters and photographs need tubes that fold for a while: with the penalty, letters had an RRMSD of 0.047 instead of
0.026, and a portrait of 0.047 instead of 0.045.  Light at a sharp border folds back over it with the best lens, so that
only tubes are penalised that landed inside the border when they were launched.  (An even square through a dome: RRMSD
0.0109 with a penalty on all tubes, 0.0081 without.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, minimum_filter
from torch import Tensor

from bstcad.optics.light.channels import Channel, weighted_sum
from bstcad.optics.numerics import kernel_choice
from bstcad.optics.numerics.reductions import total
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Scale, scaled
from bstcad.optics.surfaces.rays import Landed
from bstcad.optics.trace.tubes import Tubes, triangles

FOLD_WEIGHT = 0.05  # weight of the penalty in the merit
LEAST_AREA, MOST_LACK = 0.1, 5.0  # smallest relative area without penalty; largest lack of area that has a gradient
MIN_FILLED = 0.9  # least fraction of the convex hull of the lit pixels that is lit, for a target without folds
MAX_DETAIL = 0.02  # largest RRMSD between such a target and the target blurred by DETAIL_BLUR, inside its border
DETAIL_BLUR, DETAIL_MARGIN = 1.0, 2  # standard deviation of the blur, and least distance from the border (pixels)
# Width of the border in which light may fold: cells of the net, if the light of each is spread evenly; most pixels.
BORDER_CELLS, MAX_BORDER = 1.8, 2
PEAK_QUANTILE = 0.98  # quantile of the lit pixels that counts as the peak of a target
DARK = 1e-6  # largest value of a dark pixel, as a fraction of the mean


@dataclass(frozen=True, eq=False)
class Folds:
    """Penalty on folds of the light on one target."""

    peak: float  # peak of the target, as a fraction of its light per pixel
    scale: Scale  # places and sizes of the target's pixels
    fluxes: tuple[Tensor, ...]  # flux (n, m) of each sheet's tubes that landed inside the border; 0: of other tubes
    wholes: tuple[float, ...]  # flux of all tubes of each sheet

    @classmethod
    def of(cls, goal: Goal, sheets: Sequence[Tubes], landed: Sequence[Landed], cell: float) -> Folds | None:
        """Return the penalty for sheets of tubes whose corners landed there; None: the light may fold.

        cell: side (pixels) of the light of a cell of the net, if it were even.
        """
        if not needs_no_folds(goal):
            return None
        picture, device = goal.picture, sheets[0].flux.device
        peak = float(np.quantile(picture[_lit(goal)], PEAK_QUANTILE) / picture.sum())
        inner = _inside(_lit(goal), min(max(round(BORDER_CELLS * cell), 1), MAX_BORDER))
        padded = torch.from_numpy(np.pad(inner, 1)).to(device)  # dark beside the picture
        most = torch.tensor(padded.shape, device=device).flip(0)[:, None, None] - 1
        fluxes = []
        for sheet, corners in zip(sheets, landed, strict=True):
            x = scaled(corners.position.detach().double(), goal.screen.scale)
            centre = (x[:, 1:, 1:] + x[:, :-1, 1:] + x[:, 1:, :-1] + x[:, :-1, :-1]) / 4
            pixel = torch.where(centre.isfinite(), centre, torch.full_like(centre, -1.0)).floor().add(1)
            column, row = torch.minimum(pixel.clamp(min=0), most).long()
            fluxes.append(torch.where(padded[row, column], sheet.flux, torch.zeros_like(sheet.flux)))
        return cls(peak, goal.screen.scale, tuple(fluxes), tuple(float(total(sheet.flux)) for sheet in sheets))

    def __call__(self, channels: Sequence[Channel], landed: Sequence[Landed]) -> Tensor:
        """Return the weighted penalty of all channels (0-d), differentiable in the landing points."""
        given = zip(landed, self.fluxes, self.wholes, strict=True)
        parts = (
            fold_penalty(each.position.double(), flux, whole, self.scale, peak=self.peak) for each, flux, whole in given
        )
        return FOLD_WEIGHT * weighted_sum(channels, parts)


def needs_no_folds(goal: Goal) -> bool:
    """Return True if the lit part of a target is convex, and its light is a shape or has no fine detail."""
    picture, lit = goal.picture, _lit(goal)
    if lit.sum() < 3 or lit.sum() < MIN_FILLED * _hull_pixels(lit):
        return False
    detail = (picture - gaussian_filter(picture, DETAIL_BLUR, mode="nearest"))[_inside(lit, DETAIL_MARGIN)]
    return goal.is_shape or bool((detail**2).sum() <= MAX_DETAIL**2 * (picture**2).sum())


def _lit(goal: Goal) -> np.ndarray:
    return goal.picture > DARK * goal.picture.mean()


def _inside(lit: np.ndarray, border: int) -> np.ndarray:
    """Return the lit pixels that are further than `border` pixels from dark ones, and from the edge of the picture."""
    return minimum_filter(lit, 2 * border + 1, mode="constant")


def _hull_pixels(lit: np.ndarray) -> float:
    """Return the area (pixels) of the convex hull of the lit pixels."""
    from scipy.spatial import ConvexHull  # loads much, and is needed once per design

    row, column = np.nonzero(lit & ~(np.pad(lit, ((0, 0), (1, 1)))[:, :-2] & np.pad(lit, ((0, 0), (1, 1)))[:, 2:]))
    ends = np.concatenate([np.stack([row + i, column + j], axis=1) for i in (0, 1) for j in (0, 1)])
    return float(ConvexHull(ends).volume)


def fold_penalty(corner: Tensor, flux: Tensor, whole: float, scale: Scale, peak: float) -> Tensor:
    """Return Σ F clip(LEAST_AREA - s A p W / F, 0, MOST_LACK)² / W over the two triangles of each tube.

    corner: landing points (2, n + 1, m + 1), pixels by `scale`.  F: half the flux (n, m) of a tube, 0 if it may fold;
    W: flux of all tubes, `whole`; A: signed area of its triangle (pixel²); s: sense ±1 of most of the light; p: peak of
    the target (1 / pixel²).  A p W / F is the ratio of the peak to the density of the light in the triangle, negative
    where the triangle is overturned.
    """
    factor = peak * whole * _sense(corner, scale) * abs(scale[2] * scale[3])  # areas are in the receiver's unit
    fast = kernel_choice.kernel("folds.penalty", corner)
    if fast is not None and corner.dtype == flux.dtype == torch.float64:
        return fast(corner, flux, factor, (LEAST_AREA, MOST_LACK)) / whole
    first, second, third = triangles(corner)
    area = ((second - first)[0] * (third - first)[1] - (third - first)[0] * (second - first)[1]) / 2
    half = torch.cat([flux.reshape(-1) / 2] * 2)
    counted = (half > 0) & area.isfinite()
    safe = torch.where(counted, area, torch.zeros_like(area)) / torch.where(counted, half, torch.ones_like(half))
    lack = LEAST_AREA - factor * safe
    return total(torch.where(counted, half * lack.clamp(0, MOST_LACK) ** 2, torch.zeros_like(half))) / whole


def _sense(corner: Tensor, scale: Scale) -> float:
    """Return the sign of the area that the border of the sheet encloses, times that of the pixels' axes."""
    x, y = (corner.detach()[axis] for axis in (0, 1))
    return 1.0 if _enclosed(x, y) >= 0 else -1.0


def _enclosed(x: Tensor, y: Tensor) -> float:
    """Return the signed area inside the polygon along the border of a grid of corners."""
    u, v = (torch.cat([p[:, 0], p[-1], p[:, -1].flip(0), p[0].flip(0)]) for p in (x, y))
    return float(total(u * v.roll(-1) - u.roll(-1) * v) / 2)
