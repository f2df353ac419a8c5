"""Values of the light on a receiver: means over discs, uniformity, sharpness of a cut-off, and intensities of glare.

The light is known from M independent sets of rays, each with the flux E_p in each pixel p.  The mean over a disc D is

    E(D) = Σ_p f_p E_p / Σ_p f_p A_p,  f_p the fraction of the pixel in D, A_p its area (mm²) or solid angle (sr),

which is linear in E, so that the mean over the sets is without bias, and their scatter gives its standard error.  Light
is taken as even within a pixel.  A smallest or largest value is sought with one half of the sets and measured with the
other half, both ways round: the extreme of noisy values by itself is too far out.

Sharpness of a cut-off along the line x, upwards: G = max_y [log10 E(x, y) - log10 E(x, y + step)]; UN Regulation
No. 112, annex 9, 2.2, has a step of 0.1 degrees and 0.13 <= G <= 0.40 at 2.5 degrees from the line V-V.

Glare: the largest intensities in directions at 70, 80 and 90 degrees from the axis (the downward vertical of a street
light), in cd per 1000 lm of the light behind the lens, to which classes of luminous intensity (EN 13201-2) set limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.trace.source_images import convolved
from bstcad.photometry.intensity import Intensity

MAX_STRIPS, MIN_STRIPS = 2048, 4  # strips along x: of all pixels near a disc, and of each, exact along y
LIT = 0.01  # fraction of the target's brightest pixel, per area, above which a pixel is lit
EVEN = 0.99  # fraction of the target's brightest pixel, per area, above which a pixel belongs to the even part
GLARE_ANGLES = (70.0, 80.0, 90.0)  # degrees from the axis
DARKEST = 1e-4  # smallest light, as a fraction of the line's largest, that the sharpness of a cut-off distinguishes

P = TypeVar("P")  # a place


@dataclass(frozen=True)
class Estimate:
    """A measured value."""

    value: float
    standard_error: float

    @classmethod
    def of(cls, values: Sequence[float] | np.ndarray) -> Estimate:
        """Return the mean of independent values, with its standard error."""
        values = np.asarray(values, dtype=np.float64)
        return cls(float(values.mean()), float(values.std(ddof=1) / math.sqrt(values.size)))


@dataclass(frozen=True, eq=False)
class LightSets:
    """Light on a screen by independent sets of rays."""

    screen: Screen
    flux: tuple[np.ndarray, ...]  # flux in each pixel (rows, columns) for each set, as a fraction of the source's
    lit: np.ndarray  # (rows, columns), True for the pixels that the target wants lit
    even: np.ndarray  # (rows, columns), True for the pixels that the target wants brightest, without its soft edges

    @classmethod
    def of(cls, screen: Screen, pictures: Sequence[np.ndarray], on_screen: float, target: np.ndarray) -> LightSets:
        """Return the light of pictures of any sum; on_screen: its flux / flux of the source; target: flux wanted."""
        wanted = target / screen.cell_sizes
        flux = tuple(picture * (on_screen / picture.sum()) for picture in pictures)
        return cls(screen, flux, wanted > LIT * wanted.max(), wanted > EVEN * wanted.max())

    @cached_property
    def sizes(self) -> np.ndarray:
        """Areas (mm²) or solid angles (sr) of the pixels."""
        return self.screen.cell_sizes

    @property
    def pixel(self) -> tuple[float, float]:
        """Width and height of a pixel, in the unit of the receiver."""
        per_x, per_y = self.screen.per_unit
        return 1 / per_x, 1 / per_y

    @cached_property
    def densities(self) -> tuple[np.ndarray, ...]:
        """Flux per area or solid angle in each pixel, for each set."""
        return tuple(flux / self.sizes for flux in self.flux)

    @cached_property
    def lit_means(self) -> tuple[float, ...]:
        """Mean over the lit pixels of the flux per area or solid angle, for each set."""
        return self._means(self.lit)

    def _means(self, pixels: np.ndarray) -> tuple[float, ...]:
        whole = math.fsum(self.sizes[pixels])
        return tuple(math.fsum(flux[pixels]) / whole for flux in self.flux)

    def mean(self, at: tuple[float, float], radius: float | None = None, relative: bool = False) -> Estimate | None:
        """Return the mean over a disc: a fraction of the source's flux per mm² or sr, or relative to the lit pixels.

        None: no light falls on the lit pixels, so that no relative mean exists.  at: centre of the disc, in the unit of
        the receiver; radius: one pixel if None.  The part beside the screen is left out.
        """
        part = self.part_of_disc(at, radius)
        inside = part > 0
        whole = math.fsum((part * self.sizes)[inside])
        means = [math.fsum((part * flux)[inside]) / whole for flux in self.flux]
        if relative:
            if not all(self.lit_means):
                return None
            means = [value / mean for value, mean in zip(means, self.lit_means, strict=True)]
        return Estimate.of(means)

    def part_of_disc(self, at: tuple[float, float], radius: float | None = None) -> np.ndarray:
        """Return the fraction of each pixel (rows, columns) that is in a disc (see `mean`)."""
        part, radius = np.zeros(self.screen.shape), max(self.pixel) if radius is None else radius
        width, height = self.pixel
        left, top = at[0] - self.screen.x[0], self.screen.y[1] - at[1]  # centre, from the upper left corner
        first, last = (max(math.floor((left + end) / width), 0) for end in (-radius, radius))
        upper, lower = (max(math.floor((top + end) / height), 0) for end in (-radius, radius))
        window = part[upper : lower + 1, first : last + 1]
        rows, columns = window.shape
        fine = max(MAX_STRIPS // max(columns, 1), MIN_STRIPS)
        x = (first + (np.arange(columns * fine) + 0.5) / fine) * width - left
        y = (upper + np.arange(rows)[:, None]) * height - top
        half = np.sqrt(np.clip(radius**2 - x**2, 0.0, None))
        along = np.clip(np.minimum(y + height, half) - np.maximum(y, -half), 0.0, None) / height
        window[:] = along.reshape(rows, columns, fine).mean(2)
        return part

    # ---- extremes over discs ----

    def ratios(self, radius: float | None = None) -> tuple[Estimate, Estimate] | None:
        """Return (smallest / mean, smallest / largest) mean over discs within the even part; None if no disc fits.

        The discs are centred on pixels; the mean is over the whole even part.  radius: as for `mean`.
        """
        discs = self._discs(radius)
        if discs is None:
            return None
        means = np.asarray(self._means(self.even))
        if not means.all():
            return None

        def ends(seek: list[int]) -> tuple[int, int]:
            sought = discs[seek].mean(0)
            return int(sought.argmin()), int(sought.argmax())

        def to_mean(measure: list[int], places: tuple[int, int]) -> float:
            return float(discs[measure, places[0]].mean() / means[measure].mean())

        def to_max(measure: list[int], places: tuple[int, int]) -> float:
            low, high = (float(discs[measure, place].mean()) for place in places)
            return low / high if high > 0 else 0.0

        return _of_halves(len(discs), ends, to_mean), _of_halves(len(discs), ends, to_max)

    def _discs(self, radius: float | None) -> np.ndarray | None:
        """Return the means (sets, places) over all discs within the even part; None if no disc fits."""
        from scipy.ndimage import binary_erosion  # not loaded by the import of bstcad

        (rows, columns), (width, height) = self.screen.shape, self.pixel
        radius = max(width, height) if radius is None else radius
        down, across = (math.ceil(radius / side) for side in (height, width))
        if 2 * down + 1 > rows or 2 * across + 1 > columns:
            return None
        middle = (
            self.screen.x[0] + (columns // 2 + 0.5) * width,
            self.screen.y[1] - (rows // 2 + 0.5) * height,
        )
        near = slice(rows // 2 - down, rows // 2 + down + 1), slice(columns // 2 - across, columns // 2 + across + 1)
        kernel = self.part_of_disc(middle, radius)[near]
        fits = binary_erosion(self.even, kernel > 0)
        if not fits.any():
            return None
        sums = [convolved(each, kernel)[fits] for each in (self.sizes, *self.flux)]
        return np.stack([each / sums[0] for each in sums[1:]])

    # ---- cut-off ----

    def sharpness(self, at: float, step: float) -> Estimate | None:
        """Return the sharpness G of a cut-off along the line x = at (see the module); None for a dark line.

        The line is as wide as the step, or one pixel if that is wider.  Between the centres of pixels log10 E
        is interpolated; light below DARKEST of the line's largest counts as that much.
        """
        (rows, columns), (width, height) = self.screen.shape, self.pixel
        half = max(step, width) / 2
        left = self.screen.x[0] + np.arange(columns) * width
        weight = np.clip(np.minimum(left + width, at + half) - np.maximum(left, at - half), 0.0, None)
        lines = np.stack([(each * weight).sum(1)[::-1] for each in self.densities])  # upwards
        y = self.screen.y[0] + (np.arange(rows) + 0.5) * height
        below = y[y + step <= y[-1] * (1 + 1e-12)]
        if not (lines.mean(0).max() > 0 and below.size):
            return None

        def drops(sets: list[int]) -> np.ndarray:
            line = lines[sets].mean(0)
            log = np.log10(np.maximum(line, DARKEST * line.max()))
            return np.interp(below, y, log) - np.interp(below + step, y, log)

        return _of_halves(len(lines), lambda seek: int(drops(seek).argmax()), lambda sets, k: float(drops(sets)[k]))


def _of_halves(count: int, place: Callable[[list[int]], P], value: Callable[[list[int], P], float]) -> Estimate:
    """Return a value at a place that one half of the sets finds and the other half measures, mean of both ways round.

    place(sets): the place.  value(sets, place): the value there, whose standard error is by the jackknife over sets.
    """
    found, variance = [], 0.0
    for parity in (0, 1):
        seek, measure = ([k for k in range(count) if k % 2 == each] for each in (parity, 1 - parity))
        where, m = place(seek), len(measure)
        found.append(value(measure, where))
        without = np.array([value([k for k in measure if k != out], where) for out in measure])
        variance += (m - 1) / m * float(((without - without.mean()) ** 2).sum())
    return Estimate(math.fsum(found) / 2, math.sqrt(variance) / 2)


def glare(tables: Sequence[Intensity]) -> tuple[Estimate, ...]:
    """Return the largest intensities at GLARE_ANGLES from the axis, in cd per 1000 lm, from independent tables."""
    found = []
    for angle in GLARE_ANGLES:
        rings = [each.between(each.around, np.full_like(each.around, angle)) for each in tables]
        values = np.stack([1000 * ring / max(each.lumens, 1e-300) for ring, each in zip(rings, tables, strict=True)])

        def largest(sets: list[int], values: np.ndarray = values) -> int:
            return int(values[sets].mean(0).argmax())

        def mean(sets: list[int], place: int, values: np.ndarray = values) -> float:
            return float(values[sets, place].mean())

        found.append(_of_halves(len(tables), largest, mean))
    return tuple(found)
