"""Measurement of the irradiance that a lens produces on a screen, and of its RRMSD from a target.

Verification, manufactured parts, tolerances and the sweeps of accuracy against time use it; `Effort` limits the work.

RRMSD is estimated without bias from SETS independent sets of stratified rays.  Set i gives a picture A_i = A + n_i: the
noiseless picture A of the lens plus noise n_i of mean zero.  The squared distance of A_i from the target T is too large
by the squared noise, but the product of two sets is unbiased: E <(A_i - T) (A_j - T)> = <(A - T)²>, i ≠ j (E is the
expectation, <> the sum over pixels).  The mean over all pairs is a U-statistic (Hoeffding 1948), and its standard error
follows from the scatter of the pairs (`squared_distance`).  Rays are added until this error is as small as requested.
For an extended source each set samples new source points, so that their finite number causes no bias.

The picture for display is the mean of all sets, smoothed as long as this removes more noise than detail.  Flux tubes
(tubes.py) give a second picture without noise, the witness; rays and tubes share only the trace.  Tubes interpolate
linearly between their corners: with two tubes per side of a cell of the net the error is about the RRMSD that remains
after tailoring with tubes, with four a third of this error, with eight a tenth (measured).  The tubes are therefore
halved in width until the pictures agree, or the error of the tubes cannot explain the difference.  `rrmsd_by_tubes` is
a few per cent too low for a lens tailored with tubes.  A ghost (light reflected twice in a lens) is traced only once.

An extended source forms an image of itself through each point of the lens (`ImageSamples`).  All rays through one point
of the back meet the same slope, whichever source point they come from: no lens can unite them in one point.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np
import torch
from torch import Tensor

from bstcad.optics import tubes
from bstcad.optics.channels import Channel, points_per_line, source_numbers, weighted_sum
from bstcad.optics.goal import Goal
from bstcad.optics.irradiance import Leak, Screen, efficiency, leak, rrmsd, tent
from bstcad.optics.kernels.reductions import dot, total
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import Landed
from bstcad.optics.receivers import Receiver
from bstcad.optics.sampling import point_pairs
from bstcad.optics.trace import UNDERSIDE, GhostImage, Simulation, simulate, through, whole_kernel

SETS = 8  # number of independent sets of rays: the relative uncertainty of a standard error is a quarter
PILOT_DIVISOR = 5  # maximum rays per side divided by those of the first sets, which predict the number needed
PICTURE_NOISE = 0.45  # largest noise of the mean picture / RRMSD by default: RRMSD of this picture is 10 % larger
RESOLVED = 5.0  # smallest ratio of an RRMSD to its standard error at which it counts as resolved
# Tolerances of the difference between the pictures by rays and by tubes: relative to the smaller RRMSD, and absolute.
WITNESS_RELATIVE_TOLERANCE, WITNESS_TOLERANCE = 0.5, 0.002
MAX_WITNESS_TUBES = 4200  # maximum tubes per side to which the witness is refined until the pictures agree
SMOOTHING_WIDTHS = (0.0, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)  # standard deviations of Gaussians (pixels)
# Exponent: k points of an extended source divide tubes and rays per side by k^SIDE_EXPONENT; the total is constant.
SIDE_EXPONENT = 0.5
RAYS_PER_POINT = 1 << 13  # number of rays of each set per point of an extended source
MIN_SOURCE_POINTS, MAX_SOURCE_POINTS = 8, 1024  # limits of the number of source points of each set
MIN_TUBES = 513  # minimum tubes per side (`tubes_of`): fewer do not resolve pixels
COARSE_SHEET = 64  # tubes per side of the grid from which finer ones are interpolated, with 1e-6 of the light misplaced
PASS_SEEDS = 1 << 20  # difference between the seeds of successive passes of rays from an extended source
GHOST_DIVISOR = 4  # rays per side divided by those of the ghost, which is about a thousandth of the light
MAX_IMAGE_RAYS = 1 << 17  # maximum rays of the images of a source that are traced at a time, which limits the memory
IMAGE_POINTS_PER_SIDE = 48  # number of points per side of the back face through which the source is imaged
# Largest distance of landing light from the screen's centre, divided by (longer side of the screen + median distance).
# Light farther out grazes a tilted plane and does not belong to the image.
MAX_IMAGE_DISTANCE = 16
EVEN_POINT_PAIRS = 2048  # number of pairs of points that represent a uniformly bright source


@dataclass(frozen=True)
class Effort:
    """Limits of the work of a measurement; the default is the effort of a verification."""

    rays: int = 2896  # maximum rays per side in each of SETS sets that are traced together: 67 million rays per line
    seed: int = 0  # seed of the rays
    places: int = 1025  # points per side of the lens at which a verification evaluates the thickness
    points: int = 1 << 17  # points per face at which the written file is compared with the design
    accuracy: float = 0.005  # relative standard error of the RRMSD at which tracing ends; 0: all rays are traced
    seconds: float = math.inf  # time limit (s): no sets of rays are started that would end later
    witness: bool = True  # True: flux tubes give a second picture, except in the cases of `Light.witness`


FULL = Effort()
GhostTracer = Callable[[Lens, Sequence[Channel], Screen, int, int], GhostImage]  # integers: rays per side, and seed
Draw = Callable[[int, int], Sequence[Channel]]  # integers: number of points of an extended source, and seed


@dataclass(frozen=True)
class Witness:
    """Second measurement of the light, by flux tubes."""

    rrmsd: float  # RRMSD of the tubes' picture
    difference: float  # RRMSD between the pictures by tubes and by rays, without bias
    limit: float  # largest difference allowed: tolerance and noise in quadrature, or the error of the tubes if larger
    tubes: int  # number of tubes per side


@dataclass(frozen=True, eq=False)
class Light:
    """Measured light of all channels behind a lens."""

    picture: np.ndarray = field(repr=False)  # (rows, columns), row 0 = y max, with the target's sum, for display
    rrmsd: float  # RRMSD without bias (Wang et al. 2023, Eq. 15); NaN: no light falls on the screen
    standard_error: float  # standard error of the RRMSD
    rays: int  # total number of rays
    flux: dict[str, float]  # ledger: fractions of the source's flux, by where the light goes; they sum to 1
    tent: float = math.nan  # RRMSD by linear binning
    picture_error: float = math.nan  # RRMSD between `picture` and the lens's noiseless picture
    witness: Witness | None = None  # None: an extended source, losses, no kernel for this lens, or not requested
    ghost: np.ndarray | None = field(default=None, repr=False)  # ghost's part of the picture; None: no ghost is traced
    leak: Leak | None = None  # leak of the rays' mean picture before smoothing; None: the target has no dark pixel
    rrmsd_whole: float | None = None  # RRMSD from `goal.whole`; None: the goal is not restricted

    @property
    def efficiency(self) -> float:
        """Return the flux on the target as a fraction of the flux that leaves the last surface."""
        return efficiency(self.flux)

    @property
    def used(self) -> float:
        """Return the flux on the target as a fraction of the flux that meets the lens without its underside."""
        enters = 1 - self.flux["missed the lens"] - self.flux.get(UNDERSIDE, 0.0)
        return self.flux["on target"] / enters if enters > 0 else 0.0


def measure(
    lens: Lens,
    channels: Sequence[Channel],
    screen: Screen,
    target: np.ndarray,
    effort: Effort = FULL,
    ghost: GhostTracer | None = None,
    draw: Draw | None = None,
) -> Light:
    """Measure the light that `lens` produces on `screen` against `target`.

    lens: heights in float64 on the CPU for full accuracy.  channels: weights sum to 1.  target: (rows, columns) of any
    sum, row 0 = y max.  ghost: function that traces light reflected twice inside the lens (trace.ghost_light), which is
    added to picture and ledger; None: no ghost is traced.  draw: function that samples new source points for
    each set of rays; None: all sets use the points of `channels`.
    """
    goal = Goal("target", screen, np.asarray(target, dtype=np.float64))
    return measure_goal(lens, channels, goal, effort, ghost=ghost, draw=draw)


def measure_goal(
    lens: Lens, channels: Sequence[Channel], goal: Goal, effort: Effort, ghost: GhostTracer | None, draw: Draw | None
) -> Light:
    """Measure the light on the receiver of a goal against its picture and against `goal.whole` (see `measure`)."""
    screen, target = goal.receiver, torch.from_numpy(goal.picture)
    side = effort.rays / GHOST_DIVISOR
    ghost_image = ghost(lens, channels, screen, round(side_factor(channels) * side), effort.seed) if ghost else None
    setup = _Setup(lens, draw or (lambda count, seed: channels), screen, target, ghost=ghost_image)
    rays = (_sample if draw is None else _sample_source)(setup, effort, PICTURE_NOISE * effort.accuracy / FULL.accuracy)
    if not rays.boxes:
        return Light(np.zeros(screen.shape), math.nan, math.inf, rays=rays.count, flux=rays.flux)
    (value, error), (tent, _) = _value(rays, target), squared_distance(rays.tents, target)
    smoothed, error_of_smoothed = _smoothed(rays.boxes, target)
    # two nets, windows and mirrors have no kernel for the whole path, and yet have a witness
    plain = lens.shapes("front") or bool(lens.before or lens.behind)
    lossless = draw is None and all(c.losses is None for c in channels)
    paths = ((c.source, c.through(lens), screen.plane) for c in channels)
    simple = lossless and (plain or all(whole_kernel("trace.simulate", *path) for path in paths))
    return Light(
        smoothed.numpy(), value, error, rays=rays.count, flux=rays.flux, tent=math.sqrt(max(tent, 0.0)),
        picture_error=error_of_smoothed,
        witness=_witness(setup, channels, rays) if effort.witness and simple else None,
        ghost=None if ghost_image is None else (ghost_image.picture.cpu() * (total(target) / rays.on_screen)).numpy(),
        leak=leak((sum(rays.boxes, torch.zeros_like(target)) / SETS).numpy(), goal.picture),
        rrmsd_whole=None if goal.whole is None else _value(rays, torch.from_numpy(goal.whole))[0],
    )  # fmt: skip


def rrmsd_by_rays(
    lens: Lens, channels: Sequence[Channel], goal: Goal, effort: Effort = FULL, draw: Draw | None = None
) -> float:
    """Return `Light.rrmsd` alone; NaN if no light falls on the screen."""
    target = torch.from_numpy(goal.picture)
    rays = _sample(_Setup(lens, draw or (lambda count, seed: channels), goal.receiver, target), effort)
    return _value(rays, target)[0] if rays.boxes else math.nan


def rrmsd_by_tubes(lens: Lens, channels: Sequence[Channel], goal: Goal, n: int) -> float:
    """Return the RRMSD by n x n tubes per channel, without noise but with their bias; NaN if no light lands."""
    flux = tubes_picture(lens, channels, goal.receiver, n).cpu()
    return float(rrmsd(flux, torch.from_numpy(goal.picture))) if total(flux) > 0 else math.nan


@dataclass(frozen=True, eq=False)
class _Rays:
    """Pictures and ledger of independent sets of rays."""

    boxes: tuple[Tensor, ...]  # picture of each set, (rows, columns) with the target's sum; (): no light on the screen
    tents: tuple[Tensor, ...]  # pictures by linear binning, as `boxes`
    flux: dict[str, float]  # ledger of the flux, as in `Light`
    count: int  # number of rays
    on_screen: float  # flux on the screen, as a fraction of the source's
    weight: float = 1.0  # weight of the pictures in a mean: inverse variance of their noise, on any scale

    def joined(self, other: _Rays) -> _Rays:
        """Return each set i averaged, by weight, with set i of `other`; the averaged sets stay independent."""
        weight = self.weight + other.weight
        share = other.weight / weight

        def mean(a, b):
            return a + share * (b - a)

        boxes, tents = (tuple(map(mean, *each)) for each in ((self.boxes, other.boxes), (self.tents, other.tents)))
        flux = {line: mean(part, other.flux[line]) for line, part in self.flux.items()}
        on_screen = mean(self.on_screen, other.on_screen)
        return _Rays(boxes, tents, flux, self.count + other.count, on_screen=on_screen, weight=weight)


@dataclass(frozen=True, eq=False)
class _Setup:
    """Lens, light and target of a measurement."""

    lens: Lens  # lens that is measured
    draw: Draw  # function that returns the channels of a set of rays
    screen: Screen
    target: Tensor  # (rows, columns), row 0 = y max, of any sum
    ghost: GhostImage | None = None

    def trace(self, side: int, seed: int) -> _Rays:
        """Trace SETS sets, each of about side x side rays per spectral line."""
        sets = []
        count = min(max(side**2 // RAYS_PER_POINT, MIN_SOURCE_POINTS), MAX_SOURCE_POINTS)
        for i in range(SETS):
            channels = self.draw(count, seed + i)
            n = max(1, round(side_factor(channels) * side))
            sets.append(simulated(self.lens, channels, self.screen, n, seed=seed + i))
        flux = {line: math.fsum(part.flux[line] for part in sets) / SETS for line in sets[0].flux}
        if self.ghost is not None:
            flux |= {line: flux.get(line, 0.0) + more for line, more in self.ghost.flux.items()}
        count = sum(part.rays for part in sets)
        sums = [[self.with_ghost(getattr(part, kind)) for part in sets] for kind in ("box", "tent")]
        on_screen = math.fsum(float(total(box)) for box in sums[0]) / SETS
        if not all(float(total(box)) > 0 for box in sums[0]):
            return _Rays((), (), flux, count, on_screen=0.0)
        boxes, tents = (tuple(p * (total(self.target) / total(p)) for p in pictures) for pictures in sums)
        return _Rays(boxes, tents, flux, count, on_screen=on_screen, weight=float(side) ** 3)

    def with_ghost(self, picture: Tensor) -> Tensor:
        """Return the picture on the CPU, plus that of the ghost if one is traced."""
        return picture.cpu() if self.ghost is None else picture.cpu() + self.ghost.picture.cpu()


def _value(rays: _Rays, target: Tensor) -> tuple[float, float]:
    """Return (RRMSD, its standard error); an RRMSD² below its own standard error is replaced by that."""
    squared, error = squared_distance(rays.boxes, target)
    value = math.sqrt(max(squared, error))
    return value, math.sqrt(value**2 + error) - value


def squared_distance(pictures: Sequence[Tensor], other: Tensor) -> tuple[float, float]:
    """Return (|A - other|² / |other|², its standard error), unbiased, from independent noisy pictures A_i of A.

    U = mean over i ≠ j of p_ij = d_i · d_j / |other|², d_i = A_i - other.  With M pictures and Hoeffding's terms p_ij =
    U + a_i + a_j + e_ij the variance of U is σ² = 4 σ_a² / M + 2 σ_e² / (M (M - 1)).

    The jackknife estimates σ² as 4 / M ((M - 1) / (M - 2))² times the variance over i of the mean of p_ij over j.  Its
    second term, 4 σ_e² / (M (M - 2)) (Efron and Stein 1981), is twice too large, or by chance ten times too small.
    Therefore this term is replaced, with σ_e² estimated from the M (M - 1) / 2 residuals e_ij, which have
    M (M - 3) / 2 degrees of freedom.
    """
    differences = [(picture - other).reshape(-1) for picture in pictures]
    size, m = _squared(other), len(differences)
    products = np.zeros((m, m))
    for i in range(m):
        for j in range(i):
            products[i, j] = products[j, i] = dot(differences[i], differences[j]) / size
    mean, row_means = products.sum() / (m * (m - 1)), products.sum(0) / (m - 1)
    single = (row_means - mean) * (m - 1) / (m - 2)  # a_i
    rest = (products - mean - single[:, None] - single)[~np.eye(m, dtype=bool)]  # e_ij, each of them twice
    pairs = float((rest**2).sum()) / (m * (m - 3))  # σ_e²
    jackknife = 4 / m * float((single**2).sum()) / (m - 1)
    least = 2 * pairs / (m * (m - 1))
    return float(mean), math.sqrt(max(jackknife - 4 * pairs / (m * (m - 2)) + least, least))


def _noise(pictures: Sequence[Tensor], target: Tensor) -> float:
    """Return the squared noise of the mean picture, on the scale of RRMSD²: Σ_i |A_i - mean|² / (M (M - 1) |T|²)."""
    m, mean = len(pictures), sum(pictures, torch.zeros_like(target)) / len(pictures)
    return sum(_squared(picture - mean) for picture in pictures) / (m * (m - 1) * _squared(target))


def _smoothed(pictures: Sequence[Tensor], target: Tensor) -> tuple[Tensor, float]:
    """Return (smoothed mean picture with the target's sum; RRMSD between it and the lens's noiseless picture).

    Each kernel S of SMOOTHING_WIDTHS is applied to the mean of all sets except two and compared with these two, whose
    errors are independent: E <(S A - A_i) (S A - A_j)> = |S A - A|².  The kernel with the smallest difference is used.
    """
    from scipy.ndimage import gaussian_filter  # not loaded by the import of bstcad

    size, whole = _squared(target), sum(pictures, torch.zeros_like(target))
    pairs = [(one, other, (whole - one - other) / (SETS - 2)) for one, other in zip(*[iter(pictures)] * 2, strict=True)]

    def smooth(mean: Tensor, width: float) -> Tensor:
        smoothed = torch.from_numpy(gaussian_filter(mean.numpy(), width, mode="nearest")) if width else mean
        return smoothed * (total(target) / total(smoothed))

    def difference(width: float) -> float:
        near = [(smooth(mean, width), one, other) for one, other, mean in pairs]
        return sum(dot((p - one).reshape(-1), (p - other).reshape(-1)) for p, one, other in near) / len(near) / size

    least, best = math.inf, 0.0
    for width in SMOOTHING_WIDTHS:  # a wider kernel keeps less noise and less detail: there is one minimum
        if (square := difference(width)) > least:
            break
        least, best = square, width
    return smooth(whole / SETS, best), math.sqrt(max(least, 0.0))


def _sample(setup: _Setup, effort: Effort, max_noise: float = math.inf) -> _Rays:
    """Trace passes of up to `effort.rays` rays per side until the standard error is `effort.accuracy` times the RRMSD.

    The noise of the mean picture, which falls as n^-3/2 with n rays per side, must also be below `max_noise` times
    RRMSD.  The standard error falls as n^-3 where products of noise dominate (the variance of a pixel of n² stratified
    rays falls as n^-3; measured: n^-2.9), and as n^-3/2 where products of the lens's error and noise dominate.
    """
    pilot = max(effort.rays // PILOT_DIVISOR, min(effort.rays, 32))
    began, side, rays = time.perf_counter(), pilot if effort.accuracy else effort.rays, None
    first = side
    while True:
        start = time.perf_counter()
        more = setup.trace(side, effort.seed)
        if not more.boxes:
            return more
        rays = more if rays is None else rays.joined(more)
        if side >= effort.rays:
            return rays
        squared, error = squared_distance(rays.boxes, setup.target)
        goal = 2 * effort.accuracy * squared  # σ(U) = 2 RRMSD σ(RRMSD)
        noise = _noise(rays.boxes, setup.target)
        if error <= goal and noise <= max_noise**2 * squared and side > first:  # the first errors are uncertain
            return rays
        finer = (1.5 * error / goal) ** (1 / 3) if goal > 0 else math.inf
        if squared > 0:
            finer = max(finer, (1.5 * noise / (max_noise**2 * squared)) ** (1 / 3))
        larger = min(effort.rays, side * max(finer, 2.0 if side == first else 1.2))
        now = time.perf_counter()
        if now - began + (now - start) * (larger / side) ** 2 > effort.seconds:
            return rays
        side = round(larger)


def _sample_source(setup: _Setup, effort: Effort, max_noise: float) -> _Rays:
    """Trace rays to the accuracy of `_sample`, at most `effort.rays`² per set and line, with new source points per set.

    Each pixel gets few rays from each of many points: with n rays per side its variance falls as n^-2, as for random
    rays.  The error of the RRMSD falls as n^-2, or faster where more rays come from more points (measured: n^-2.6).
    Source and picture are smooth, so `max_noise` limits the error of the smoothed picture, not the noise of pixels.
    """
    pilot = max(effort.rays // PILOT_DIVISOR, min(effort.rays, 32))
    began, side, rays = time.perf_counter(), pilot if effort.accuracy else effort.rays, None
    number = 0
    while True:
        start = time.perf_counter()
        seed = effort.seed + number * PASS_SEEDS  # passes with equal numbers of rays must not repeat them
        more = setup.trace(side, seed)
        if not more.boxes:
            return more
        more = replace(more, weight=float(side) ** 2)
        rays = more if rays is None else rays.joined(more)
        if rays.weight >= effort.rays**2:
            return rays
        squared, error = squared_distance(rays.boxes, setup.target)
        goal, max_square = 2 * effort.accuracy * squared, max_noise**2 * squared  # σ(U) = 2 RRMSD σ(RRMSD)
        # the error of the first pass alone may be small by chance
        if number and error <= goal and _smoothed(rays.boxes, setup.target)[1] ** 2 <= max_square:
            return rays
        ratio = 1.3 * error / goal if goal > 0 else math.inf
        needed = rays.weight * max(ratio if number else ratio**0.8, 4.0 if number == 0 else 1.2)
        finer = math.sqrt(min(needed, effort.rays**2) - rays.weight)
        now = time.perf_counter()
        if now - began + (now - start) * (finer / side) ** 2 > effort.seconds:
            return rays
        side, number = math.ceil(finer), number + 1


def _witness(setup: _Setup, channels: Sequence[Channel], rays: _Rays) -> Witness:
    """Compare the pictures by rays and by tubes (`_compare`), starting with `tubes_of` tubes per side."""
    lens, screen, target = setup.lens, setup.screen, setup.target

    def by_tubes(n: int) -> Tensor | None:
        flux = setup.with_ghost(tubes_picture(lens, channels, screen, n))
        return flux * (total(target) / total(flux)) if total(flux) > 0 else None

    value = math.sqrt(max(squared_distance(rays.boxes, target)[0], 0.0))
    return _compare(rays.boxes, by_tubes, target, rrmsd_by_rays=value, first=tubes_of(lens, max(screen.shape)))


def _compare(
    boxes: Sequence[Tensor], by_tubes: Callable[[int], Tensor | None], target: Tensor, rrmsd_by_rays: float, first: int
) -> Witness:
    """Compare pictures by independent sets of rays with pictures by tubes, whose number per side doubles from `first`.

    The error of n tubes per side falls about as n^-1.6, so that it is less than half the change from the picture by
    n / 2 tubes.  If the pictures by tubes and by rays differ by more than twice this change, no finer tubes will agree.
    """

    def change_from(fine: Tensor | None, coarse: Tensor | None) -> float:
        return 0.0 if fine is None or coarse is None else math.sqrt(_squared(fine - coarse) / _squared(target))

    n, flux, change = first, by_tubes(first), math.inf
    while True:
        if flux is None:
            return Witness(math.nan, math.inf, limit=0.0, tubes=n)
        squared, noise = squared_distance(boxes, flux)
        difference, value = math.sqrt(max(squared, 0.0)), float(rrmsd(flux, target))
        relative = WITNESS_RELATIVE_TOLERANCE * min(rrmsd_by_rays, value)
        limit = math.hypot(max(WITNESS_TOLERANCE, relative), math.sqrt(2 * noise))
        if difference <= limit:
            return Witness(value, difference, limit=limit, tubes=n)
        if 2 * n > MAX_WITNESS_TUBES and math.isinf(change):  # the first tubes of a fine net are also the finest
            change = change_from(flux, by_tubes(n // 2))
        if 2 * n > MAX_WITNESS_TUBES or 2 * change < difference:
            return Witness(value, difference, limit=max(limit, change), tubes=n)
        n, coarse = 2 * n, flux
        flux = by_tubes(n)
        change = change_from(flux, coarse)


def tubes_of(lens: Lens, pixels: int = 0) -> int:
    """Return the tubes per side for a lens: two per control point, at least MIN_TUBES; pixels: screen pixels per side.

    A lens with two nets gets twice as many, since light deflected by the first net varies within the cells of the
    second.  If a cell of the net lights several pixels, two tubes per pixel are used, at most four per cell.  Five more
    are added, so that lines of the net and corners of tubes do not coincide.
    """
    each = 2 * len(lens.nets)
    return max(*(each * max(net.side, min(pixels, 2 * net.side)) + 5 for net in lens.nets), MIN_TUBES)


@dataclass(frozen=True)
class RayTubes:
    """Flux tubes of channels in front of the first net, launched once for all lenses that differ little.

    A tube carries the light between four neighbouring rays; its picture is differentiable in the heights of all nets.
    """

    channels: tuple[Channel, ...]  # channels of the light
    sheets: tuple[tubes.Tubes, ...]  # tubes of each channel

    @classmethod
    def launched(cls, lens: Lens, channels: Sequence[Channel], n: int | None = None) -> RayTubes:
        """Launch n x n tubes per channel (default: `tubes_of`) that carry all light which the lens transmits."""
        n = n or tubes_of(lens)
        return cls(tuple(channels), tuple(tubes.launch_tubes(c.source, c.through(lens), n) for c in channels))

    def landings(self, lens: Lens, planes: Sequence[Receiver]) -> tuple[tuple[Landed, ...], ...]:
        """Trace the corners of each channel's tubes to each receiver; return the landing points by receiver."""
        pairs = zip(self.channels, self.sheets, strict=True)
        return tuple(zip(*(sheet.landings(c.through(lens), planes) for c, sheet in pairs), strict=True))

    def picture(self, lens: Lens, screen: Screen) -> Tensor:
        """Return the flux in each pixel (rows, columns), row 0 = y max, as a fraction of the source's flux."""
        pairs = zip(self.sheets, self.landings(lens, [screen.plane])[0], strict=True)
        return weighted_sum(self.channels, (sheet.collect(corners, screen)[0] for sheet, corners in pairs))


def tubes_picture(
    lens: Lens, channels: Sequence[Channel], screen: Screen, n: int, over_the_back: bool = False
) -> Tensor:
    """Return flux per pixel / flux of the source by n x n tubes per channel; over_the_back: as in `tubes.picture`."""
    few = COARSE_SHEET if over_the_back else tubes.SHEET_TUBES
    lights = ((c.source, c.through(lens)) for c in channels)
    pictures = (tubes.picture(*light, screen, n, few=few, over_the_back=over_the_back) for light in lights)
    return weighted_sum(channels, pictures)


@dataclass(frozen=True, eq=False)
class SpectralLine:
    """Light of one line of a spectrum."""

    wavelength: float  # vacuum wavelength (nm)
    share: float  # fraction of all light in this line; the shares of all lines sum to 1
    picture: np.ndarray = field(repr=False)  # (rows, columns), row 0 = y max, with the target's sum; zero if dark


def spectral_lines(lens: Lens, channels: Sequence[Channel], goal: Goal, n: int) -> tuple[SpectralLine, ...]:
    """Return the light of each line of a spectrum by n x n tubes per channel, sorted by wavelength; () for one line."""
    lines: dict[float, list[Channel]] = {}
    for channel in channels:
        lines.setdefault(channel.source.main_wavelength, []).append(channel)
    if len(lines) < 2:
        return ()
    parts = []
    for wavelength, members in sorted(lines.items()):
        picture = tubes_picture(lens, members, goal.receiver, n).cpu()
        if total(picture) > 0:
            picture = picture * (total(torch.from_numpy(goal.picture)) / total(picture))
        parts.append(SpectralLine(wavelength, math.fsum(channel.weight for channel in members), picture.numpy()))
    return tuple(parts)


def simulated(lens: Lens, channels: Sequence[Channel], screen: Screen, n: int, seed: int) -> Simulation:
    """Simulate picture and ledger by n x n stratified rays per channel, with another seed for each source point."""
    pairs = zip(channels, source_numbers(channels), strict=True)
    return simulate([(c.weight, c.source, c.through(lens), seed + SETS * k) for c, k in pairs], screen, n)


def side_factor(channels: Sequence[Channel]) -> float:
    """Return k^-1/2, the factor of tubes or rays per side for each of k source points: their total is constant."""
    k = points_per_line(channels)
    return k**-SIDE_EXPONENT if k > 1 else 1


def _squared(t: Tensor) -> float:
    return dot(t.reshape(-1), t.reshape(-1))


@dataclass(frozen=True)
class ImageSamples:
    """Images of a source through several points of the back face: landing points of the light of each channel."""

    offset: Tensor  # landing point minus centroid of the image, (2, channels, points): columns, rows (pixels)
    flux: Tensor  # flux of each channel through each point, (channels, points)

    def width(self) -> float:
        """Return 2 √2 times the RMS distance from the centroid (pixels), the diameter of a uniform disc of this RMS."""
        square = torch.where(self.flux > 0, (self.offset**2).sum(0), torch.zeros_like(self.flux))
        return 2 * math.sqrt(2 * float(total(square * self.flux) / total(self.flux)))

    def mean(self, limit: tuple[int, int]) -> np.ndarray:
        """Return the mean image (odd number of rows, odd number of columns), centred; sum: fraction of light inside.

        limit: largest distance from the centre of the image in columns and in rows; light farther out is left out.
        """
        extent = [math.ceil(float(p[self.flux > 0].abs().max())) + 1 for p in self.offset]
        columns, rows = (2 * min(reach, side) + 1 for reach, side in zip(extent, limit, strict=True))
        own = Screen(0.0, (-columns / 2, columns / 2), (-rows / 2, rows / 2), (columns, rows))
        position = self.offset * torch.tensor([1.0, -1.0]).view(2, 1, 1)  # rows count downwards
        image = tent(Landed(position, self.flux, torch.zeros(self.flux.shape, dtype=torch.uint8)), own)
        fits = all(reach <= side for reach, side in zip(extent, limit, strict=True))
        return (image / (image.sum() if fits else self.flux.sum())).numpy()

    def deviation(self, target: np.ndarray) -> float:
        """Return the RRMSD between a target (rows, columns) and the target convolved with the mean image.

        Light shifted by more than the target's width falls outside the target and needs no pixels.
        """
        from scipy.signal import fftconvolve  # half a second to load, which a point source does not need

        rows, columns = target.shape
        blurred = fftconvolve(target, self.mean((columns, rows)), mode="same").clip(min=0)
        if not blurred.any():  # the image is so much wider than the target that no sample falls on the target
            blurred = np.ones_like(target)
        return float(rrmsd(torch.from_numpy(blurred), torch.from_numpy(np.asarray(target, dtype=np.float64))))


def even_image(extent: Outline) -> ImageSamples:
    """Return the image of a uniformly bright disc or rectangle; extent: outline of the image (pixels)."""
    offset = torch.tensor(point_pairs(extent, EVEN_POINT_PAIRS), dtype=torch.float64).T[..., None]
    return ImageSamples(offset, torch.full(offset.shape[1:], 1 / (2 * EVEN_POINT_PAIRS), dtype=torch.float64))


def detail_width(source_image: float, pixel: float) -> float:
    """Return √(D² + 4/3 p²): diameter of the uniform disc whose variance is the sum of those of a disc and a pixel.

    D: `source_image`, diameter of the disc, variance D² / 8.  p: `pixel`, its side, variance p² / 6.  All in one unit.
    """
    return math.sqrt(source_image**2 + 4 / 3 * pixel**2)


@torch.no_grad()
def images(channels: Sequence[Channel], lens: Lens, screen: Screen, n: int = IMAGE_POINTS_PER_SIDE) -> ImageSamples:
    """Return the source's images, in light of the first line, through the lit cells of an n x n grid on the back."""
    first = channels[0]
    channels = [c for c in channels if (c.source.wavelength, c.index) == (first.source.wavelength, first.index)]
    pixel, flux = landing_pixels(channels, lens, screen, n)
    if (flux > 0).any():
        centre = torch.tensor([screen.columns / 2, screen.rows / 2]).to(pixel).view(2, 1, 1)
        distance = (pixel - centre).abs().amax(0)
        stray = distance > MAX_IMAGE_DISTANCE * (max(screen.shape) + distance[flux > 0].median())
        flux = torch.where(stray, torch.zeros_like(flux), flux)
    lit = flux.sum(0) > 0
    flux, share = flux[:, lit], flux[:, lit] / flux[:, lit].sum(0)
    pixel = torch.where(flux > 0, pixel[..., lit], torch.zeros_like(share))
    return ImageSamples(pixel - (pixel * share).sum(1, keepdim=True), flux)


@torch.no_grad()
def landing_pixels(channels: Sequence[Channel], lens: Lens, screen: Screen, n: int) -> tuple[Tensor, Tensor]:
    """Return (pixel (2, channels, points), flux (channels, points)) of the light through n x n cells of the back.

    pixel: column and row at which each channel's light lands, meaningless where the flux is zero.
    """
    x, y = tubes.corners(lens.apertures[1], n)
    lines = groupby(channels, key=lambda channel: (channel.index, channel.losses, channel.around))
    count, parts = max(1, MAX_IMAGE_RAYS // x.numel()), []
    for line in (list(members) for _, members in lines):
        parts += [_through(line[k : k + count], lens, screen, x=x, y=y) for k in range(0, len(line), count)]
    position, flux = (torch.cat(part, dim=-2) for part in zip(*parts, strict=True))
    return screen.pixels_of(position), flux


def _through(channels: Sequence[Channel], lens: Lens, screen: Screen, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Trace light of one index through the cells between the points (x, y) (mm) of the back; return (landing, flux).

    landing: points (2, channels, cells) in the receiver's unit.  flux: (channels, cells), zero for light that is lost.
    """
    lens = channels[0].through(lens)
    p, q, rays = tubes.rays_to([channel.source for channel in channels], lens, x, y)
    behind = replace(lens.unbounded(), losses=None).interfaces[lens.number_of("back") :]
    [landed] = through(rays, behind, [screen.plane])
    centre = tubes.middle(p), tubes.middle(q)
    cells = zip(channels, *centre, strict=True)
    density = [each.weight * each.source.irradiance(x, y, lens.entrance.z) for each, x, y in cells]
    flux = torch.stack(density) * tubes.area_of(p, q)
    if lens.passes.sense > 0:  # light comes to the front
        flux = torch.where(lens.apertures[0].contains(*centre), flux, torch.zeros_like(flux))
    flux = tubes.arriving_flux(flux, landed).double()
    return tubes.middle(landed.position).flatten(-2), flux.flatten(-2)
