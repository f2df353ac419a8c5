"""Model of a file of rays: an even disc or rectangle of points, all of one radiant intensity.

The emitting area lies on the plane across the axis on which the rays are closest together.  Its centre and size follow
from the moments of the rays there: a disc of diameter D has variances D² / 16, a rectangle of width w has w² / 12.

The intensity I(θ, φ) is smoothed as far as this predicts rays better.  The rays are halved at random; of several means,
over circles about the axis or over squares, the one that is closest to the other half is taken (cross-validation).
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bstcad.optics.light.measured_rays import MeasuredRays, RayFacts
from bstcad.optics.light.profiles import Net, Profile
from bstcad.optics.surfaces.outlines import Circle, Outline, Rectangle
from bstcad.optics.surfaces.rays import Vector
from bstcad.optics.surfaces.sampling import hash_seed, jitter
from bstcad.photometry.ray_set import RaySet

MODEL_RAYS = 1_000_000  # largest number of rays from which a model is made
STEEP = math.cos(math.radians(60))  # cosine of the largest angle of rays that determine the emitting area
SMALLEST_SIZE = 1e-6  # size (mm) of an emitting area up to which it counts as a point
DISC_RATIO = 5 / 6  # <x² y²> / (<x²> <y²>) between that of a disc, 2/3, and that of a rectangle, 1
SIDE = 129  # control points per side of the intensity's net
RINGS = 512  # number of circles about the axis, at even steps of cos θ, for an intensity that is round
WIDTHS = (0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)  # standard deviations of means over squares, in net spacings
RING_WIDTHS = (0.7, 1.5, 3.0, 6.0, 12.0, 24.0, 48.0)  # standard deviations of means over circles, in steps of cos θ
HALF_SEED = 7  # seed of the halves of the rays
MAX_LINES = 8  # largest number of spectral lines
RAYS_PER_LINE = 1000  # smallest number of rays of a line
EDGE = 1.0 / SIDE  # margin of the half angle, in tan(θ / 2)


@dataclass(frozen=True, eq=False)
class RayModel(MeasuredRays):
    """Model of a set of rays, with the wavelengths of the rays as lines."""

    record: RayFacts

    @property
    def facts(self) -> RayFacts:
        """Facts of the model."""
        return self.record

    @property
    def words(self) -> str:
        """Size of the model in words."""
        extent = self.facts.extent
        if extent is None:
            return "a point"
        a, b = extent.half_extent
        return f"a disc of {2 * a:.4g} mm" if extent.is_round else f"a rectangle of {2 * a:.4g} × {2 * b:.4g} mm"

    def scaled(self, share: float) -> RayModel:
        """Return the model with its extent multiplied by `share`; a scaled model has one wavelength, its channel's."""
        if share not in self._scaled:  # models are compared by identity
            extent, lines = self.facts.extent, self.facts.lines
            smaller = None if extent is None or not share else extent.scaled(share), lines if share else ()
            facts = replace(self.facts, extent=smaller[0], lines=smaller[1])
            self._scaled[share] = RayModel(facts) if smaller != (extent, lines) else self
        return self._scaled[share]

    @functools.cached_property
    def _scaled(self) -> dict[float, RayModel]:
        return {}


def model_of(rays: RaySet) -> RayModel:
    """Return the model of a set of rays; ValueError if no ray leads along +z."""
    numbers = np.arange(len(rays.power))
    if len(numbers) > MODEL_RAYS:
        chance, _ = jitter(hash_seed(HALF_SEED), numbers)
        numbers = numbers[chance < MODEL_RAYS / len(numbers)]
        del chance
    power = rays.power[numbers].astype(np.float64)
    position, direction = rays.position[numbers].astype(np.float64), rays.direction[numbers].astype(np.float64)
    ahead = direction[:, 2] > 0
    if not (power[ahead] > 0).any():
        raise ValueError("has no ray along +z, the axis of a lamp; turn the rays in the program that made the file")
    area, middle = _emitting_area(position[ahead], direction[ahead], power[ahead])
    law, angle = _intensity(direction[ahead], power[ahead], float(power.sum()))
    lumens = rays.flux if rays.unit == "lm" else rays.stated_lumens
    return RayModel(RayFacts(law, area, middle, lines=lines_of(rays), lumens=lumens, half_angle=angle))


def _emitting_area(position: np.ndarray, direction: np.ndarray, power: np.ndarray) -> tuple[Outline | None, Vector]:
    """Return (outline or None, centre) of the area on the plane across the axis where the rays are closest together.

    Rays p + t m, m = (d_x, d_y) / d_z: Σ φ |p + t m - mean|² is least at t = -cov(p, m) / var(m).
    """
    some = direction[:, 2] > STEEP
    if not (power[some] > 0).any():
        some = np.ones_like(some)
    weight = power[some] / power[some].sum()
    slope = direction[some, :2] / direction[some, 2:]
    start = position[some, :2] - position[some, 2:] * slope  # at z = 0

    def mean(values: np.ndarray) -> np.ndarray:
        return weight @ values

    p, m = start - mean(start), slope - mean(slope)
    spread = float(mean((m * m).sum(1)))
    z = -float(mean((p * m).sum(1))) / spread if spread > 0 else 0.0
    at = start + z * slope
    centre = mean(at)
    x, y = (at - centre).T
    xx, yy = float(mean(x * x)), float(mean(y * y))
    middle = float(centre[0]), float(centre[1]), z
    if 4 * math.sqrt(max(xx, yy)) < SMALLEST_SIZE:
        return None, middle
    if xx > 0 and yy > 0 and mean(x * x * y * y) < DISC_RATIO * xx * yy and abs(math.log(xx / yy)) < 0.2:
        return Circle(2 * math.sqrt((xx + yy) / 2)), middle
    return Rectangle(math.sqrt(12 * xx), math.sqrt(12 * yy)), middle


@dataclass(frozen=True)
class _Means:
    """Mean intensities of rays over squares of the stereographic plane, and over circles about the axis."""

    half: float  # largest tan(θ / 2) with light

    @property
    def step(self) -> float:
        """Spacing of the nodes of the net."""
        return 2 * self.half / (SIDE - 1)

    @functools.cached_property
    def cosine(self) -> np.ndarray:
        """Cosine of the angle from the axis at each node, (SIDE, SIDE); NaN outside the circle of light."""
        t = np.linspace(-self.half, self.half, SIDE)
        r2 = t[:, None] ** 2 + t**2
        return np.where(r2 <= self.half**2, (1 - r2) / (1 + r2), np.nan)

    @property
    def height(self) -> float:
        """1 - cos θ of the circle of light, its solid angle divided by 2 π."""
        return 2 * self.half**2 / (1 + self.half**2)

    @functools.cached_property
    def solid_angle(self) -> np.ndarray:
        """Solid angle (sr) of each node's share of the circle of light, summed over fine parts of it."""
        fine = 4 * SIDE
        at = ((np.arange(fine) + 0.5) / fine * 2 - 1) * self.half
        r2 = at[:, None] ** 2 + at**2
        part = np.where(r2 <= self.half**2, 4 * (2 * self.half / fine) ** 2 / (1 + r2) ** 2, 0.0)
        return self.squares(np.stack(np.meshgrid(at, at, indexing="ij"), -1).reshape(-1, 2), part.ravel())

    def squares(self, flat: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return the sums (SIDE, SIDE) of weights at places (n, 2), each shared linearly among the nearest nodes."""
        place = np.clip((flat + self.half) / self.step, 0, SIDE - 1 - 1e-9)
        first = place.astype(int)
        part, total = place - first, np.zeros(SIDE * SIDE)
        for i, j in itertools.product((0, 1), repeat=2):
            share = np.abs(1 - i - part[:, 0]) * np.abs(1 - j - part[:, 1])
            total += np.bincount((first[:, 0] + i) * SIDE + first[:, 1] + j, weight * share, SIDE * SIDE)
        return total.reshape(SIDE, SIDE)

    def circles(self, flat: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return the sums (RINGS,) of weights at places (n, 2) between circles of even steps of cos θ."""
        r2 = (flat * flat).sum(1)
        number = np.clip(2 * r2 / (1 + r2) / self.height * RINGS, 0, RINGS - 1e-9).astype(int)
        return np.bincount(number, weight, RINGS)

    def over_squares(self, sums: np.ndarray, width: float) -> np.ndarray:
        """Return the intensity at each node as a mean with a Gaussian weight of `width` spacings."""
        from scipy.ndimage import gaussian_filter  # not loaded by the import of bstcad

        light, area = (gaussian_filter(part, width, mode="constant") for part in (sums, self.solid_angle))
        return np.where(np.isnan(self.cosine), 0.0, light / np.maximum(area, 1e-300))

    def over_circles(self, sums: np.ndarray, width: float) -> np.ndarray:
        """Return the intensity at each node as a mean over circles, with a Gaussian weight of `width` steps."""
        from scipy.ndimage import gaussian_filter1d  # not loaded by the import of bstcad

        mean = gaussian_filter1d(sums, width, mode="nearest") / (2 * math.pi * self.height / RINGS)
        at = (1 - self.cosine) / self.height * RINGS - 0.5
        return np.nan_to_num(np.interp(at, np.arange(RINGS), mean))


def _intensity(direction: np.ndarray, power: np.ndarray, whole: float) -> tuple[Profile, float]:
    """Return (radiant intensity, largest angle with light in degrees) of rays along +z; whole: flux of all rays."""
    flat = direction[:, :2] / (1 + direction[:, 2:])  # tan(θ / 2) (cos φ, sin φ)
    means = _Means(min(float(np.sqrt((flat * flat).sum(1).max())) + EDGE, 1.0))
    chance, _ = jitter(hash_seed(HALF_SEED + 1), np.arange(len(power)))
    halves = chance < 0.5, chance >= 0.5
    squares, circles = ([of(flat[some], power[some]) for some in halves] for of in (means.squares, means.circles))
    tries = [(partial(means.over_squares, width=width), squares) for width in WIDTHS]
    tries += [(partial(means.over_circles, width=width), circles) for width in RING_WIDTHS]

    def error(mean: Callable[[np.ndarray], np.ndarray], sums: Sequence[np.ndarray]) -> float:
        """Return the squared distance between the flux by one half of the rays and that of the other half."""
        pairs = zip(sums, reversed(squares), strict=True)
        return sum(float(((mean(own) * means.solid_angle - other) ** 2).sum()) for own, other in pairs)

    best, sums = min(tries, key=lambda each: error(*each))
    net = Net(best(sums[0] + sums[1]), *2 * ((-means.half, means.half),))
    angle = min(math.degrees(2 * math.atan(means.half)), 90.0)
    return Profile(net=net, stereographic=True, whole=whole), angle


def line_numbers(rays: RaySet) -> tuple[tuple[float, ...], np.ndarray]:
    """Return (wavelength of each spectral line in nm, number of the line of each ray), the line with most flux first.

    Many wavelengths, or some with few rays, are divided into at most MAX_LINES intervals of similar numbers of rays.
    """
    count = len(rays.power)
    if rays.wavelength is None or np.ndim(rays.wavelength) == 0:
        return () if rays.wavelength is None else (float(rays.wavelength),), np.zeros(count, dtype=np.int64)
    known = np.asarray(rays.wavelength)
    _, number = np.unique(known, return_inverse=True)
    counts = np.bincount(number)
    if len(counts) > MAX_LINES or counts.min() < RAYS_PER_LINE:
        least = max(RAYS_PER_LINE, math.ceil(count / MAX_LINES))
        shorter = np.cumsum(counts) - counts  # number of rays of shorter wavelengths
        number = (shorter // least)[number]
        counts = np.bincount(number)
        kept = [int(line) for line in np.flatnonzero(counts >= RAYS_PER_LINE)] or [0]
        nearest = np.array([min((abs(one - line), one) for one in kept)[1] for line in range(len(counts))])
        number = nearest[number]  # a line of few rays joins the nearest one
        _, number = np.unique(number, return_inverse=True)
    flux = np.bincount(number, rays.power)
    middle = np.bincount(number, rays.power * known.astype(np.float64)) / flux
    order = np.argsort(-flux, kind="stable")
    return tuple(round(float(nm), 3) for nm in middle[order]), np.argsort(order)[number]


def lines_of(rays: RaySet) -> tuple[tuple[float, float], ...]:
    """Return (nm, fraction of the flux) of each spectral line, the one with most flux first; (): not stated."""
    middle, number = line_numbers(rays)
    flux = np.bincount(number, rays.power)
    return tuple((nm, float(part / flux.sum())) for nm, part in zip(middle, flux, strict=False))


def rays_of_lines(rays: RaySet) -> tuple[np.ndarray | None, ...]:
    """Return the numbers of the rays of each spectral line, in the order of `lines_of`; None: all rays."""
    middle, number = line_numbers(rays)
    return tuple(np.flatnonzero(number == line) for line in range(len(middle))) if len(middle) > 1 else (None,)
