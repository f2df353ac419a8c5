"""The cost and the remaining error of a finished design.

- `ending`: the end of the convergence curve, fitted by a power law;
- `remaining`: the squared error, divided into parts of the target and into octaves of spatial frequency;
- `unlit` and `lifted`: lit parts of a target that stay dark, and dark parts that get light;
- `ControlCells`: the cells of a control net that light each pixel, and the lower bound of the error that they allow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.ndimage
from scipy.fft import dctn

from bstcad.optics.receivers.irradiance import Screen

# --- the end of the convergence curve ---------------------------------------------------------------------------------

LAST_TENTH_RATIO = 1.1  # RRMSD / final RRMSD: a report states how long before the end the curve was last above this
FITTED_FRACTION = 0.5  # the power law is fitted to this last fraction of the time
MIN_FIT_POINTS = 5  # smallest number of points of the curve for a fit
MIN_R_SQUARED = 0.9  # smallest R² of the fit (in logarithms) at which the curve counts as a power law
LAST_EVALUATIONS = 5  # number of evaluations at the end over which a report states by how much the RRMSD fell
MAX_HALVING = 10.0  # largest reported factor by which the time grows if the error is halved

History = Sequence[tuple[float, float]]  # (seconds since the start, RRMSD)
StageResults = Sequence[tuple[float, float | None]]  # stages in order: (duration (s), RRMSD by rays at its end or None)


@dataclass(frozen=True)
class ConvergenceEnd:
    """End of a convergence curve, which is the RRMSD of the best lens so far (by flux tubes) after each evaluation.

    Near its end the curve is fitted by RRMSD ∝ t^-p, where t is the total time of the evaluations.  To halve the error,
    t must grow by the factor 2^(1/p).
    """

    rrmsd: float  # final RRMSD: median of the last twentieth of the evaluations
    last_tenth_seconds: float  # time (s) since the RRMSD was last above 1.1 times its final value
    last_tenth: float  # `last_tenth_seconds` divided by the time from the start to the end of the curve
    power: float | None  # exponent p, zero if the curve does not fall; None: too few points
    fit: float | None  # R² of the fit in logarithms; None: too few points
    halving: float | None  # factor 2^(1/p) of the time; None: no or a poor fit, or a factor above 10
    # fraction by which the RRMSD fell in the last LAST_EVALUATIONS evaluations; None: the last round has no more
    last_gain: float | None


def ending(history: History, stages: StageResults, since: float = 0.0) -> ConvergenceEnd | None:
    """Return the end of a design's convergence curve; None if no stage tailored the irradiance.

    history: points of the curve and, at the ends of the `stages`, RRMSDs by rays, which are left out.
    since: time (s) from the start at which tailoring began to use its final channels of light.
    """
    ends = np.cumsum([seconds for seconds, _ in stages])
    judged = {value for _, value in stages if value is not None}
    points = np.array([point for point in history if point[1] not in judged], dtype=float).reshape(-1, 2)
    if not len(points):
        return None
    seconds, values = points.T
    last = float(np.median(values[-max(1, len(values) // 20) :]))  # median: robust against a single value
    above = np.flatnonzero(values > LAST_TENTH_RATIO * last)
    took = float(seconds[-1] - (seconds[above[-1]] if len(above) else 0.0))
    power, fit = _fit_power(*_last_points(seconds, values, ends, since))
    in_round = values[np.searchsorted(ends, seconds) == np.searchsorted(ends, seconds[-1])]
    many = len(in_round) > LAST_EVALUATIONS
    gain = max(0.0, float(1 - in_round[-1] / in_round[-1 - LAST_EVALUATIONS])) if many else None
    halving = None
    if power and fit is not None and fit >= MIN_R_SQUARED and power * np.log2(MAX_HALVING) >= 1:
        halving = 2 ** (1 / power)
    share = took / float(seconds[-1])
    return ConvergenceEnd(last, took, share, power, fit=fit, halving=halving, last_gain=gain)


def _last_points(
    seconds: np.ndarray, values: np.ndarray, ends: np.ndarray, since: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return (time, RRMSD) of the curve in the last FITTED_FRACTION of the time after `since`, within the last stage.

    seconds, values: the curve.  ends: end of each stage (s).  The duration of each evaluation is replaced by the median
    in its stage, so that other work of the machine has no effect.
    """
    stage = np.searchsorted(ends, seconds)
    steps = np.zeros(len(seconds))
    for each in np.unique(stage):
        members = stage == each
        own = np.diff(seconds[members])
        before = ends[each - 1] if each else 0.0
        steps[members] = np.median(own) if len(own) else seconds[members][0] - before
    time = np.cumsum(np.where(seconds > since, steps, 0.0))
    chosen = (time >= (1 - FITTED_FRACTION) * time[-1]) & (stage == stage[-1]) & (time > 0)
    return time[chosen], values[chosen]


def _fit_power(time: np.ndarray, values: np.ndarray) -> tuple[float | None, float | None]:
    """Fit values ∝ time^-p by least squares of the logarithms; return (p >= 0, R²), None for too few points."""
    if len(time) < MIN_FIT_POINTS:
        return None, None
    x, y = np.log(time), np.log(values)
    x, y = x - x.mean(), y - y.mean()
    slope, spread = (x * y).sum() / (x * x).sum(), (y * y).sum()
    return max(0.0, float(-slope)), float(slope**2 * (x * x).sum() / spread) if spread > 0 else 0.0


# --- the error by parts of the target and by octaves ------------------------------------------------------------------

RIM_RATIO = 64  # side of the target divided by the width of its rim
EDGE_QUANTILE = 0.9  # quantile of the gradient above which a pixel is at an edge
MIN_EDGE_GRADIENT = 0.02  # smallest gradient at an edge, per pixel, relative to the brightest pixel
TONE_QUANTILE = 0.1  # quantile of the irradiance below which a pixel is dark; bright: above 1 - TONE_QUANTILE


def remaining(picture: np.ndarray, target: np.ndarray, per_unit: tuple[float, float]) -> dict[str, Any]:
    """Return the fractions of the squared error in "parts" of the target and in "octaves" of spatial frequency.

    picture, target: (rows, columns), of the same sum.  per_unit: pixels along x and y per unit of the receiver.
    parts: [{name: name in `masks`, error: fraction of the squared error, pixels: fraction of the target's pixels}].
    octaves: see `_octaves`.
    """
    square = (picture - target) ** 2
    whole = float(square.sum()) or 1.0
    parts = [
        {"name": name, "error": float(square[where].sum()) / whole, "pixels": float(where.mean())}
        for name, where in masks(target).items()
    ]
    return {"parts": parts, "octaves": _octaves(picture - target, math.sqrt(math.prod(per_unit)))}


def masks(target: np.ndarray) -> dict[str, np.ndarray]:
    """Return a mask (rows, columns) of each part; a pixel belongs to the first part whose condition it meets.

    rim: a strip of at least one pixel along each side, as wide as 1/64 of the target.  edges: the tenth of all pixels
    with the largest gradient (central differences), if it is at least 0.02 per pixel, relative to the brightest pixel.
    darkest, brightest: a tenth of all pixels each, more if pixels are equally bright.  rest: all others.
    """
    steep = np.hypot(*np.gradient(target))
    dark, bright = np.quantile(target, (TONE_QUANTILE, 1 - TONE_QUANTILE))
    lit = target > dark  # False throughout a uniform target, which has no dark and no bright pixel
    conditions = {
        "rim": np.logical_or.outer(*map(_in_rim, target.shape)),
        "edges": steep >= max(np.quantile(steep, EDGE_QUANTILE), MIN_EDGE_GRADIENT * target.max()),
        "darkest": ~lit & lit.any(),
        "brightest": (target >= bright) & lit,
        "rest": np.ones(target.shape, dtype=bool),
    }
    first = np.argmax(np.stack(list(conditions.values())), axis=0)
    return {name: first == number for number, name in enumerate(conditions)}


def _in_rim(side: int) -> np.ndarray:
    along = np.arange(side)
    return np.minimum(along, side - 1 - along) < max(1, round(side / RIM_RATIO))


def _octaves(error: np.ndarray, per_unit: float) -> list[dict[str, Any]]:
    """Return a record for each octave of an error picture's cosine transform (orthonormal: Parseval), coarse first.

    "frequency": lower and upper limit in cycles per pixel (the finest octave extends to 0.71, along the diagonals).
    "period": both limits as lengths on the target, the longer first, in the unit of `per_unit` (pixels per unit).
    "error": fraction of the squared error.  The mean is in no octave, as both pictures have the same sum.  The cosine
    transform is not periodic, so a difference between opposite sides adds no high frequencies.
    """
    energy = dctn(error, norm="ortho") ** 2
    along = (np.arange(side) / (2 * side) for side in error.shape)
    frequency = np.hypot(*np.meshgrid(*along, indexing="ij"))
    energy[0, 0] = 0.0  # rounding: both pictures have the same sum
    count = math.ceil(math.log2(max(error.shape)))  # octaves down to half a period over the longer side
    number = np.clip(np.floor(np.log2(np.maximum(frequency, 1e-9) * 4)), 1 - count, 0).astype(int)
    whole = float(energy.sum()) or 1.0
    sums = np.bincount((number + count - 1).ravel(), energy.ravel(), count) / whole
    ends = [(0.25 * 2.0**k, 0.5 * 2.0**k) for k in range(1 - count, 1)]
    return [
        {"frequency": end, "period": tuple(1 / (cycles * per_unit) for cycles in end), "error": float(share)}
        for end, share in zip(ends, sums, strict=True)
    ]


# --- unlit and lifted parts -------------------------------------------------------------------------------------------
# Target and irradiance are pictures (rows, columns) of the same sum, with row 0 at y max.

DARK_LEVEL = 0.01  # a pixel of the target is dark below this irradiance, as a fraction of the mean
UNLIT_LEVEL = 0.1  # a lit pixel counts as unlit below this fraction of its target irradiance
MIN_UNLIT_FRACTION = 5e-3  # smallest reported unlit fraction, both of the lit area and of its light


def unlit(target: np.ndarray, irradiance: np.ndarray, screen: Screen) -> dict[str, Any]:
    """Return share and place of the lit area that stays dark; {} for less than MIN_UNLIT_FRACTION of area or light.

    share: fraction of the lit area.  place: the ranges of x and y of the largest dark patch, as text.
    """
    lit = target > DARK_LEVEL * target.mean()
    dark = lit & (irradiance < UNLIT_LEVEL * target)
    share = float(dark.sum() / lit.sum())
    least = MIN_UNLIT_FRACTION
    if share < least or target[dark].sum() < least * target.sum():  # only pixels of a rim, partly lit
        return {}
    patches, count = scipy.ndimage.label(dark, np.ones((3, 3)))
    largest = 1 + np.argmax(scipy.ndimage.sum_labels(dark, patches, range(1, count + 1)))
    rows, columns = scipy.ndimage.find_objects(patches)[largest - 1]
    x, y = (np.linspace(*ends, n + 1) for ends, n in zip((screen.x, screen.y), target.shape[::-1], strict=True))
    sides = (x[columns.start], x[columns.stop]), (y[-1 - rows.stop], y[-1 - rows.start])
    named = zip(screen.receiver.names, sides, strict=True)
    place = (f"{name} = {low:.4g} to {high:.4g} {screen.receiver.unit}" for name, (low, high) in named)
    return {"share": share, "place": ", ".join(place)}


def lifted(target: np.ndarray, irradiance: np.ndarray) -> dict[str, float]:
    """Return how much light the dark parts of the target get: a smooth face cannot leave all of them dark.

    light: excess over the target, as a fraction of all light.  level: mean irradiance there / mean of the whole target.
    """
    dark = target < DARK_LEVEL * target.mean()
    light = float((irradiance - target)[dark].sum() / target.sum())
    return {"light": light, "level": float(irradiance[dark].mean() / target.mean()) if dark.any() else 0.0}


# --- cells of the control net -----------------------------------------------------------------------------------------

TILE_PIXELS = 16  # side of the tiles into which a target is cut (pixels)


@dataclass(frozen=True, eq=False)
class ControlCells:
    """Number of cells of the control net that light each pixel; there is one cell per control point.

    Where the light of k cells falls on a tile of the target, k control points shape it, and can produce about the k
    coarsest cosines of the tile.  The energy of the other cosines is a lower bound of the squared error.
    """

    cells_per_pixel: np.ndarray = field(repr=False)  # cells that light each pixel, (rows, columns), row 0 = y max
    target: np.ndarray = field(repr=False)  # target picture, (rows, columns)

    def floor(self, finer: float = 1.0) -> float:
        """Return the RRMSD if each tile shows as many of its coarsest cosines as cells light it.

        finer: factor by which the number of control points per side is multiplied.
        """
        tiles, cells = (_tiles(picture) for picture in (self.target, self.cells_per_pixel))
        energy = dctn(tiles, axes=(1, 2), norm="ortho").reshape(len(tiles), -1)[:, COARSE_TO_FINE] ** 2
        made = np.floor(np.minimum(finer**2 * cells.sum((1, 2)), TILE_PIXELS**2)).astype(int)
        left = np.where(np.arange(TILE_PIXELS**2) >= made[:, None], energy, 0.0)
        whole = float((tiles**2).sum())
        return math.sqrt(float(left.sum()) / whole) if whole else 0.0  # a part of a picture can be dark


def _tiles(picture: np.ndarray) -> np.ndarray:
    """Cut a picture into tiles (number, rows, columns); the last ones are padded with the values at the border."""
    rows, columns = (-side % TILE_PIXELS for side in picture.shape)
    whole = np.pad(picture, ((0, rows), (0, columns)), mode="edge")
    parts = whole.reshape(whole.shape[0] // TILE_PIXELS, TILE_PIXELS, whole.shape[1] // TILE_PIXELS, TILE_PIXELS)
    return parts.transpose(0, 2, 1, 3).reshape(-1, TILE_PIXELS, TILE_PIXELS)


# Order of the cosines of a tile by the length of their wave vectors
COARSE_TO_FINE = np.argsort(np.hypot(*np.indices((TILE_PIXELS, TILE_PIXELS))).ravel(), kind="stable")
