"""The cost and the remaining error of a finished design: what its end cost, where its error sits.

- `ending`: the end of the convergence curve, taken for a power law;
- `remaining`: the squared error by parts of the target and by octaves of its cosine transform;
- `unlit` and `lifted`: lit parts of a target that stay dark, and dark parts that are lit;
- `ControlCells`: the cells of a control net that light each pixel, and the least error that they leave.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.ndimage
from scipy.fft import dctn

from bstcad.optics.irradiance import Screen

# --- the end of the convergence curve ---------------------------------------------------------------------------------

LAST = 1.1  # times the RRMSD at the end: from there on it is "the last tenth of the error"
LATELY = 0.5  # of the time that the irradiance has been tailored for: so far back the power law is fitted
FEW = 5  # points: fewer give no power
GOOD = 0.9  # R² of a line in logarithms that is one
PAYS = 10.0  # times the time: half of the error for more than that is no offer

Curve = Sequence[tuple[float, float]]  # (seconds since the start, RRMSD)
Stages = Sequence[tuple[float, float | None]]  # one after the other: (seconds, RRMSD after it if judged)


@dataclass(frozen=True)
class Ending:
    """The end of a convergence curve; RRMSD by the rays or tubes that tailor, as each evaluation has it.

    Near its end the curve is taken for RRMSD ∝ t^-p, t the time of all evaluations: half of the error takes 2^(1/p)
    times as long in all.
    """

    rrmsd: float  # at the end
    last_tenth_seconds: float  # since it was above LAST times that for the last time
    last_tenth: float  # `last_tenth_seconds` over the time from the start to the end of the curve
    power: float | None  # p, zero if the curve does not fall; None: too few points
    fit: float | None  # R² of that line, of logarithms
    halving: float | None  # 2^(1/p); None: no line fits, or it is more than PAYS


def ending(history: Curve, stages: Stages, since: float = 0.0) -> Ending | None:
    """The end of a design's history; None if the irradiance was never tailored.

    stages: their judgements are in the history too, by other tubes than the points around them.
    since: seconds since the start at which the design took up the light that it has at the end.
    """
    ends = np.cumsum([seconds for seconds, _ in stages])
    judged = {value for _, value in stages if value is not None}
    points = np.array([point for point in history if point[1] not in judged], dtype=float).reshape(-1, 2)
    if not len(points):
        return None
    seconds, values = points.T
    last = float(np.median(values[-max(1, len(values) // 20) :]))  # where each evaluation has rays of its own, of a few
    above = np.flatnonzero(values > LAST * last)
    took = float(seconds[-1] - (seconds[above[-1]] if len(above) else 0.0))
    power, fit = _power(*_lately(seconds, values, ends, since))
    halving = None
    if power and fit is not None and fit >= GOOD and power * np.log2(PAYS) >= 1:
        halving = 2 ** (1 / power)
    return Ending(last, took, took / float(seconds[-1]), power, fit=fit, halving=halving)


def _lately(seconds: np.ndarray, values: np.ndarray, ends: np.ndarray, since: float) -> tuple[np.ndarray, np.ndarray]:
    """(time, values) of the last points, since tailoring began and within the last stage.

    Each evaluation of a stage counts as long as the median one, whatever else the machine did meanwhile.
    """
    stage = np.searchsorted(ends, seconds)
    steps = np.zeros(len(seconds))
    for each in np.unique(stage):
        there = stage == each
        own = np.diff(seconds[there])
        before = ends[each - 1] if each else 0.0
        steps[there] = np.median(own) if len(own) else seconds[there][0] - before
    time = np.cumsum(np.where(seconds > since, steps, 0.0))
    chosen = (time >= (1 - LATELY) * time[-1]) & (stage == stage[-1]) & (time > 0)
    return time[chosen], values[chosen]


def _power(time: np.ndarray, values: np.ndarray) -> tuple[float | None, float | None]:
    """(p, R²) of values ∝ time^-p by least squares of the logarithms."""
    if len(time) < FEW:
        return None, None
    x, y = np.log(time), np.log(values)
    x, y = x - x.mean(), y - y.mean()
    slope, spread = (x * y).sum() / (x * x).sum(), (y * y).sum()
    return max(0.0, float(-slope)), float(slope**2 * (x * x).sum() / spread) if spread > 0 else 0.0


# --- where the error sits ---------------------------------------------------------------------------------------------

RIM = 64  # a side of the target over the width of its rim
STEEP = 0.9  # quantile of the gradient from which on a pixel lies at an edge …
SLIGHT = 0.02  # … if the gradient exceeds this part of the brightest pixel's irradiance a pixel
TENTH = 0.1  # quantile of the irradiance up to which, and from whose counterpart on, a pixel is dark or bright


def remaining(picture: np.ndarray, target: np.ndarray, per_unit: tuple[float, float]) -> dict[str, Any]:
    """Where a picture (rows, columns) differs from a target of the same sum.

    per_unit: pixels along x and y in a unit of the receiver.

    parts: [{name: of `masks`, error: share of the squared error, pixels: share of the target's pixels}].
    octaves: as `_octaves` has them.
    """
    square = (picture - target) ** 2
    whole = float(square.sum()) or 1.0
    parts = [
        {"name": name, "error": float(square[where].sum()) / whole, "pixels": float(where.mean())}
        for name, where in masks(target).items()
    ]
    return {"parts": parts, "octaves": _octaves(picture - target, math.sqrt(math.prod(per_unit)))}


def masks(target: np.ndarray) -> dict[str, np.ndarray]:
    """The pixels (rows, columns) of each part; a pixel belongs to the first part whose condition it meets.

    rim: the outermost 1/64 of the side, one pixel at least, at all four sides.  edges: the tenth of all pixels in which
    the target changes most from pixel to pixel (central differences), if it changes by 2 % of its brightest pixel.
    darkest and brightest: the tenth of all pixels, and those as dark or as bright as the last of them.  rest.
    """
    steep = np.hypot(*np.gradient(target))
    dark, bright = np.quantile(target, (TENTH, 1 - TENTH))
    lit = target > dark  # nowhere of an even target, which has no dark and no bright pixel
    tried = {
        "rim": np.logical_or.outer(*map(_outermost, target.shape)),
        "edges": steep >= max(np.quantile(steep, STEEP), SLIGHT * target.max()),
        "darkest": ~lit & lit.any(),
        "brightest": (target >= bright) & lit,
        "rest": np.ones(target.shape, dtype=bool),
    }
    first = np.argmax(np.stack(list(tried.values())), axis=0)
    return {name: first == number for number, name in enumerate(tried)}


def _outermost(side: int) -> np.ndarray:
    """Is a pixel along a side within the width of the rim?"""
    along = np.arange(side)
    return np.minimum(along, side - 1 - along) < max(1, round(side / RIM))


def _octaves(error: np.ndarray, per_unit: float) -> list[dict[str, Any]]:
    """Energy of the cosine transform (orthonormal: Parseval) by the length of the wave vector, from coarse to fine.

    Of each octave: frequency (from, below, in cycles a pixel; the finest goes on to 0.71, along the diagonals), period
    (on the target, in its unit, the coarse end first), error (share of the squared error).  The mean is in no octave,
    as both pictures have one sum.  A cosine transform is not periodic and makes nothing of opposite sides that differ.
    """
    energy = dctn(error, norm="ortho") ** 2
    along = (np.arange(side) / (2 * side) for side in error.shape)
    frequency = np.hypot(*np.meshgrid(*along, indexing="ij"))
    energy[0, 0] = 0.0  # rounding: both have one sum
    count = math.ceil(math.log2(max(error.shape)))  # down to half a wave over the longer side
    number = np.clip(np.floor(np.log2(np.maximum(frequency, 1e-9) * 4)), 1 - count, 0).astype(int)
    whole = float(energy.sum()) or 1.0
    sums = np.bincount((number + count - 1).ravel(), energy.ravel(), count) / whole
    ends = [(0.25 * 2.0**k, 0.5 * 2.0**k) for k in range(1 - count, 1)]
    return [
        {"frequency": end, "period": tuple(1 / (cycles * per_unit) for cycles in end), "error": float(share)}
        for end, share in zip(ends, sums, strict=True)
    ]


# --- where the light misses its target --------------------------------------------------------------------------------
# A target and an irradiance of one sum, (rows, columns) with row 0 at y max.

DARK = 0.01  # share of the picture's mean below which a pixel is dark
UNLIT = 0.1  # share of the target's irradiance below which a pixel was left dark
PATCH = 5e-3  # share of the lit area left dark, below which no sentence says so


def unlit(target: np.ndarray, irradiance: np.ndarray, screen: Screen) -> dict[str, Any]:
    """The share of the lit part that gets hardly any light, and the place of its largest patch; {} for next to none.

    place: least and largest x, least and largest y, in words.
    """
    lit = target > DARK * target.mean()
    dark = lit & (irradiance < UNLIT * target)
    share = float(dark.sum() / lit.sum())
    if share < PATCH or target[dark].sum() < PATCH * target.sum():  # which a rim of pixels that are lit in part is not
        return {}
    patches, count = scipy.ndimage.label(dark, np.ones((3, 3)))
    largest = 1 + np.argmax(scipy.ndimage.sum_labels(dark, patches, range(1, count + 1)))
    rows, columns = scipy.ndimage.find_objects(patches)[largest - 1]
    x, y = (np.linspace(*ends, n + 1) for ends, n in zip((screen.x, screen.y), target.shape[::-1], strict=True))
    sides = (x[columns.start], x[columns.stop]), (y[-1 - rows.stop], y[-1 - rows.start])
    named = zip(screen.plane.names, sides, strict=True)
    place = (f"{name} = {low:.4g} to {high:.4g} {screen.plane.unit}" for name, (low, high) in named)
    return {"share": share, "place": ", ".join(place)}


def lifted(target: np.ndarray, irradiance: np.ndarray) -> dict[str, float]:
    """The light on the dark parts of the target, of all light, and its level, of the mean irradiance.

    A smooth face cannot part its light without a seam.
    """
    dark = target < DARK * target.mean()
    light = float((irradiance - target)[dark].sum() / target.sum())
    return {"light": light, "level": float(irradiance[dark].mean() / target.mean()) if dark.any() else 0.0}


# --- cells of the control net -----------------------------------------------------------------------------------------

TILE = 16  # pixels a side


@dataclass(frozen=True, eq=False)
class ControlCells:
    """The squares of the knots that light each pixel; a cell stands for one control point.

    Where the light of k cells falls on a tile of the target, the net has k numbers to shape it with: of the tile's
    cosines it can make about k, the coarsest first.  The energy of the others is the least error to be had there.
    """

    a_pixel: np.ndarray = field(repr=False)  # (rows, columns) cells that light it, row 0 = y max
    target: np.ndarray = field(repr=False)  # (rows, columns)

    def floor(self, finer: float = 1.0) -> float:
        """RRMSD that is left if each tile has as many of its lowest cosines as cells light it.

        finer: times as many control points a side.
        """
        tiles, cells = (_tiles(picture) for picture in (self.target, self.a_pixel))
        energy = dctn(tiles, axes=(1, 2), norm="ortho").reshape(len(tiles), -1)[:, COARSE_TO_FINE] ** 2
        made = np.floor(np.minimum(finer**2 * cells.sum((1, 2)), TILE**2)).astype(int)
        left = np.where(np.arange(TILE**2) >= made[:, None], energy, 0.0)
        whole = float((tiles**2).sum())
        return math.sqrt(float(left.sum()) / whole) if whole else 0.0  # a part of a picture may be dark


def _tiles(picture: np.ndarray) -> np.ndarray:
    """(number, TILE, TILE); the last row and column of tiles are filled up from the border."""
    rows, columns = (-side % TILE for side in picture.shape)
    whole = np.pad(picture, ((0, rows), (0, columns)), mode="edge")
    parts = whole.reshape(whole.shape[0] // TILE, TILE, whole.shape[1] // TILE, TILE)
    return parts.transpose(0, 2, 1, 3).reshape(-1, TILE, TILE)


# The cosines of a tile by the length of their wave vectors.
COARSE_TO_FINE = np.argsort(np.hypot(*np.indices((TILE, TILE))).ravel(), kind="stable")
