"""Penalty on folded light: flux tubes that land overturned, or far too dense.

Where a tube lands overturned, three sheets of light overlap, with bright and dark lines beside each other that are
finer than a pixel.  A merit of squared errors has local minima there.  If the lit part of a target is convex and its
light has no fine detail, the optimal map is smooth (Caffarelli 1992) and folds no light, so that folds can be
penalised.
Letters and photographs need tubes that fold for a while: with the penalty, letters had an RRMSD of 0.047 instead of
0.026, and a portrait of 0.047 instead of 0.045.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, minimum_filter
from torch import Tensor

from bstcad.optics import ops
from bstcad.optics.goal import Goal
from bstcad.optics.irradiance import Scale
from bstcad.optics.kernels.reductions import total
from bstcad.optics.tubes import triangles

FOLD_WEIGHT = 0.05  # weight of the penalty in the merit
LEAST_AREA, MOST_LACK = 0.1, 5.0  # smallest relative area without penalty; largest lack of area that has a gradient
MIN_FILLED = 0.9  # least fraction of the convex hull of the lit pixels that is lit, for a target without folds
MAX_DETAIL = 0.02  # largest RRMSD between such a target and the target blurred by DETAIL_BLUR, inside its border
DETAIL_BLUR, DETAIL_MARGIN = 1.0, 5  # standard deviation of the blur (pixels); width of the square that must be lit
PEAK_QUANTILE = 0.98  # quantile of the lit pixels that counts as the peak of a target
DARK = 1e-6  # largest value of a dark pixel, as a fraction of the mean


def peak_without_folds(goal: Goal) -> float | None:
    """Return the peak of a target, as a fraction of its light per pixel, if its light needs no folds; else None."""
    picture = goal.picture
    lit = picture > DARK * picture.mean()
    if lit.sum() < 3 or lit.sum() < MIN_FILLED * _hull_pixels(lit):
        return None
    inner = minimum_filter(lit, DETAIL_MARGIN, mode="nearest")
    detail = (picture - gaussian_filter(picture, DETAIL_BLUR, mode="nearest"))[inner]
    if not goal.is_shape and not (detail**2).sum() <= MAX_DETAIL**2 * (picture**2).sum():
        return None
    return float(np.quantile(picture[lit], PEAK_QUANTILE) / picture.sum())


def _hull_pixels(lit: np.ndarray) -> float:
    """Return the area (pixels) of the convex hull of the lit pixels."""
    from scipy.spatial import ConvexHull  # loads much, and is needed once per design

    row, column = np.nonzero(lit & ~(np.pad(lit, ((0, 0), (1, 1)))[:, :-2] & np.pad(lit, ((0, 0), (1, 1)))[:, 2:]))
    ends = np.concatenate([np.stack([row + i, column + j], axis=1) for i in (0, 1) for j in (0, 1)])
    return float(ConvexHull(ends).volume)


def fold_penalty(corner: Tensor, flux: Tensor, scale: Scale, peak: float) -> Tensor:
    """Return Σ F clip(LEAST_AREA - s A p / F, 0, MOST_LACK)² over the two triangles of each tube, / Σ F.

    corner: landing points (2, n + 1, m + 1), pixels by `scale`.  F: half the flux (n, m) of a tube; A: signed area of
    its triangle (pixel²); s: sense ±1 of most of the light; p: peak of the target (1 / pixel²).  A p / F is the ratio
    of the peak to the density of the light in the triangle, negative where the triangle is overturned.
    """
    whole = total(flux)
    factor = peak * float(whole) * _sense(corner, scale) * abs(scale[2] * scale[3])  # areas are in the receiver's unit
    if corner.dtype == torch.float64 and flux.dtype == torch.float64 and (fast := ops.kernel("folds.penalty", corner)):
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
