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
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import FRONT
from bstcad.optics.light.channels import Channel, SourceSampler, points_per_line, source_numbers, weighted_sum
from bstcad.optics.numerics.reductions import dot, total
from bstcad.optics.receivers.goal import Goal, interpolated
from bstcad.optics.receivers.irradiance import (
    LEDGER_OF_GIVEN_RAYS,
    Leak,
    Screen,
    efficiency,
    joined_cells,
    leak,
    leaving,
    rrmsd,
)
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces.rays import Landed
from bstcad.optics.trace import tubes
from bstcad.optics.trace.trace import UNDERSIDE, GhostImage, Simulation, simulate, whole_kernel

SETS = 8  # number of independent sets of rays: the relative uncertainty of a standard error is a quarter
MIN_PICTURES = 4  # fewest independent pictures from which `squared_distance` estimates its standard error
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
# Sizes of the cells, in pixels, on which a verification measures the RRMSD; the smallest is 1 / FINEST_CELLS.
COARSER_CELLS, FINEST_CELLS = (4, 2), 4
MAX_CELLS = 1 << 22  # largest number of cells of a picture, for the memory: 34 MB for each of SETS pictures and of sums
BLUR_MARGIN = 4.0  # dark margin around a picture that is blurred, in standard deviations of the blur
MIN_TUBES = 513  # minimum tubes per side (`tubes_of`): fewer do not resolve pixels
COARSE_SHEET = 64  # tubes per side of the grid from which finer ones are interpolated, with 1e-6 of the light misplaced
PASS_SEEDS = 1 << 20  # difference between the seeds of successive passes of rays from an extended source
GHOST_DIVISOR = 4  # rays per side divided by those of the ghost, which is about a thousandth of the light


@dataclass(frozen=True)
class Effort:
    """Limits of the work of a measurement; the default is the effort of a verification."""

    rays: int = 2896  # maximum rays per side in each of SETS sets that are traced together: 67 million rays per line
    seed: int = 0  # seed of the rays
    places: int = 1025  # points per side of the lens for its thickness in a verification; half as many rays for margins
    points: int = 1 << 17  # points per face at which the written file is compared with the design
    accuracy: float = 0.005  # relative standard error of the RRMSD at which tracing ends; 0: all rays are traced
    seconds: float = math.inf  # time limit (s): no sets of rays are started that would end later
    witness: bool = True  # True: flux tubes give a second picture, except in the cases of `Light.witness`
    cells: int = FINEST_CELLS  # cells along each side of a pixel to which the RRMSD is measured; 1: pixels alone


FULL = Effort()

GhostTracer = Callable[[Lens, Sequence[Channel], Screen, int, int], GhostImage]  # integers: rays per side, and seed


@dataclass(frozen=True)
class Witness:
    """Second measurement of the light, by flux tubes."""

    rrmsd: float  # RRMSD of the tubes' picture
    difference: float  # RRMSD between the pictures by tubes and by rays, without bias
    limit: float  # largest difference allowed: tolerance and noise in quadrature, or the error of the tubes if larger
    tubes: int  # number of tubes per side


@dataclass(frozen=True)
class CellError:
    """RRMSD of a picture on cells of another size than its pixels."""

    cell: float  # side of a cell (pixels): a power of two
    rrmsd: float  # RRMSD from the target drawn on these cells, without bias
    standard_error: float  # standard error of the RRMSD
    # RRMSD of the light blurred by the image of the real source, without bias; None: narrower than a cell, or simulated
    blurred: float | None = None

    @property
    def counted(self) -> float:
        """RRMSD that counts on these cells: with the size of the real source, if its image is wider than a cell."""
        return self.rrmsd if self.blurred is None else self.blurred


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
    # pictures of the independent sets, each (rows, columns) with the target's sum; (): no light, or no longer needed
    sets: tuple[Tensor, ...] = field(default=(), repr=False)
    on_screen: float = 0.0  # flux on the screen, ghosts included, as a fraction of the source's
    peak: float = 0.0  # flux per mm² or sr in the brightest cell of half a pixel / flux on the screen, without bias
    peak_error: float = 0.0  # standard error of `peak`
    peak_cell: float = 1.0  # side of the cell of `peak` (pixels); 1: the cells were not measured
    by_cell: tuple[CellError, ...] = ()  # RRMSDs by size of the cells, the largest first; (): not measured

    @property
    def half(self) -> CellError | None:
        """RRMSD on cells half as wide as a pixel; None: not measured."""
        return next((each for each in self.by_cell if each.cell == 0.5), None)

    @property
    def leaving(self) -> float:
        """Return the flux that leaves the last surface, ghosts included, as a fraction of the source's."""
        return leaving(self.flux)

    @property
    def efficiency(self) -> float:
        """Return the flux on the target as a fraction of the flux that leaves the last surface."""
        return efficiency(self.flux)

    @property
    def used(self) -> float:
        """Return the flux on the target as a fraction of the flux that meets the lens without its underside."""
        beside = (UNDERSIDE, *LEDGER_OF_GIVEN_RAYS)
        enters = 1 - self.flux["missed the lens"] - math.fsum(self.flux.get(line, 0.0) for line in beside)
        return self.flux["on target"] / enters if enters > 0 else 0.0


def measure(
    lens: Lens,
    channels: Sequence[Channel],
    screen: Screen,
    target: np.ndarray,
    effort: Effort = FULL,
    ghost: GhostTracer | None = None,
    sampler: SourceSampler | None = None,
) -> Light:
    """Measure the light that `lens` produces on `screen` against `target`.

    lens: heights in float64 on the CPU for full accuracy.  channels: weights sum to 1.  target: (rows, columns) of any
    sum, row 0 = y max.  ghost: function that traces light reflected twice inside the lens (trace.ghost_light), which is
    added to picture and ledger; None: no ghost is traced.  sampler: function that samples new source points for
    each set of rays; None: all sets use the points of `channels`.
    """
    goal = Goal("target", screen, np.asarray(target, dtype=np.float64))
    return measure_goal(lens, channels, goal, effort, ghost=ghost, sampler=sampler)


def measure_goal(
    lens: Lens,
    channels: Sequence[Channel],
    goal: Goal,
    effort: Effort,
    ghost: GhostTracer | None,
    sampler: SourceSampler | None,
) -> Light:
    """Measure the light on the receiver of a goal against its picture and against `goal.whole` (see `measure`)."""
    [light] = measure_goals(lens, channels, [goal], effort, ghost=ghost, sampler=sampler)
    return light


def measure_goals(
    lens: Lens, channels: Sequence[Channel], goals: Sequence[Goal], effort: Effort, *, ghost: GhostTracer | None,
    sampler: SourceSampler | None, images: Sequence[float] = (),
) -> list[Light]:  # fmt: skip
    """Measure the light on the receivers of several goals, with the same rays for all (see `measure_goal`).

    images: diameter (pixels) of the image of the real source on each receiver, if the channels have no size.
    """
    setups = _setups(lens, channels, goals, sampler, cells=effort.cells)
    if images:
        setups = [replace(setup, image=image) for setup, image in zip(setups, images, strict=True)]
    if ghost:
        n = round(side_factor(channels) * effort.rays / GHOST_DIVISOR)
        ghosts = [ghost(lens, channels, setup.screen, n, effort.seed) for setup in setups]
        setups = [replace(setup, ghost=image) for setup, image in zip(setups, ghosts, strict=True)]
    sample = _sample if sampler is None else _sample_source
    rays = sample(setups, effort, PICTURE_NOISE * effort.accuracy / FULL.accuracy)
    given = zip(setups, goals, rays, strict=True)
    witness = effort.witness and sampler is None
    return [_light(setup, goal, channels, found, witness=witness) for setup, goal, found in given]


def _light(setup: _Setup, goal: Goal, channels: Sequence[Channel], rays: _Rays, *, witness: bool) -> Light:
    """Return the light on one receiver; witness: if possible, compare it with a picture by tubes."""
    lens, screen, target, ghost_image = setup.lens, setup.screen, setup.target, setup.ghost
    if not rays.boxes:
        return Light(np.zeros(screen.shape), math.nan, math.inf, rays=rays.count, flux=rays.flux)
    (value, error), (tent, _) = _value(rays.boxes, target), _value(rays.tents, target)
    smoothed, error_of_smoothed = _smoothed(rays.boxes, target)
    # two nets, windows and mirrors have no kernel for the whole path, and yet have a witness
    plain = lens.is_tailored(FRONT) or bool(lens.before or lens.behind)
    lossless = all(c.losses is None for c in channels)
    paths = ((c.source, c.through(lens), screen.receiver) for c in channels)
    simple = lossless and (plain or all(whole_kernel("trace.simulate", *path) for path in paths))
    return Light(
        smoothed.numpy(), value, error, rays=rays.count, flux=rays.flux, tent=tent,
        picture_error=error_of_smoothed,
        witness=_witness(setup, channels, rays) if witness and simple else None,
        ghost=None if ghost_image is None else (ghost_image.picture.cpu() * (total(target) / rays.on_screen)).numpy(),
        leak=leak((sum(rays.boxes, torch.zeros_like(target)) / SETS).numpy(), goal.picture),
        rrmsd_whole=None if goal.whole is None else _value(rays.boxes, torch.from_numpy(goal.whole))[0],
        sets=rays.boxes, on_screen=rays.on_screen, by_cell=tuple(_by_cell(rays, goal, setup.image)),
        **_peak_figures(rays, screen),
    )  # fmt: skip


def rrmsds_by_rays(
    lens: Lens,
    channels: Sequence[Channel],
    goals: Sequence[Goal],
    effort: Effort = FULL,
    sampler: SourceSampler | None = None,
) -> list[float]:
    """Return `Light.rrmsd` alone for each goal; NaN if no light falls on its screen."""
    setups = _setups(lens, channels, goals, sampler)
    pairs = zip(setups, _sample(setups, effort), strict=True)
    return [_value(rays.boxes, setup.target)[0] if rays.boxes else math.nan for setup, rays in pairs]


def rrmsd_by_tubes(lens: Lens, channels: Sequence[Channel], goal: Goal, n: int) -> float:
    """Return the RRMSD by n x n tubes per channel, without noise but with their bias; NaN if no light lands."""
    flux = tubes_picture(lens, channels, goal.screen, n).cpu()
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
    cells: tuple[Tensor, ...] = ()  # pictures of each set on cells (k rows, k columns), float32, as `boxes`; (): k = 1

    def joined(self, other: _Rays) -> _Rays:
        """Return each set i averaged, by weight, with set i of `other`; the averaged sets stay independent."""
        weight = self.weight + other.weight
        share = other.weight / weight

        def mean(a, b):
            return a + share * (b - a)

        boxes, tents = (tuple(map(mean, *each)) for each in ((self.boxes, other.boxes), (self.tents, other.tents)))
        flux = {line: mean(part, other.flux[line]) for line, part in self.flux.items()}
        on_screen = mean(self.on_screen, other.on_screen)
        cells = tuple(map(mean, self.cells, other.cells)) or self.cells or other.cells
        return _Rays(boxes, tents, flux, self.count + other.count, on_screen=on_screen, weight=weight, cells=cells)


@dataclass(frozen=True, eq=False)
class _Setup:
    """Lens, light and target of a measurement."""

    lens: Lens  # lens that is measured
    sampler: SourceSampler  # function that returns the channels of a set of rays
    screen: Screen
    target: Tensor  # (rows, columns), row 0 = y max, of any sum
    ghost: GhostImage | None = None
    cells: int = 1  # number k of cells along each side of a pixel in which rays are counted
    image: float = 0.0  # diameter (pixels) of the image of the real source, whose size the rays do not have; 0: none

    def rays(self, sets: Sequence[Simulation], side: int) -> _Rays:
        """Return the pictures and the ledger of SETS sets, each of about side x side rays per spectral line."""
        flux = {line: math.fsum(part.flux[line] for part in sets) / SETS for line in sets[0].flux}
        if self.ghost is not None:
            flux |= {line: flux.get(line, 0.0) + more for line, more in self.ghost.flux.items()}
        count = sum(part.rays for part in sets)
        boxes, tents = ([self.with_ghost(getattr(part, kind)) for part in sets] for kind in ("box", "tent"))
        on_screen = math.fsum(float(total(box)) for box in boxes) / SETS
        if not all(float(total(box)) > 0 for box in boxes):
            return _Rays((), (), flux, count, on_screen=0.0)
        scales = [total(self.target) / total(box) for box in boxes]
        pairs = zip(scales, sets, strict=True)
        cells = tuple(self.with_ghost(part.cells).mul_(scale) for scale, part in pairs if part.cells is not None)
        return _Rays(
            tuple(scale * box for scale, box in zip(scales, boxes, strict=True)),
            tuple(tent * (total(self.target) / total(tent)) for tent in tents),
            flux, count, on_screen=on_screen, weight=float(side) ** 3, cells=cells,
        )  # fmt: skip

    def with_ghost(self, picture: Tensor) -> Tensor:
        """Return the picture of pixels or cells on the CPU, plus that of the ghost if one is traced."""
        if self.ghost is None:
            return picture.cpu()
        ghost, cells = self.ghost.picture.cpu(), picture.shape[0] // self.screen.rows
        if cells > 1:
            ghost = torch.from_numpy(interpolated(ghost.numpy(), cells)).to(picture.dtype)
        return picture.cpu() + ghost


def _setups(
    lens: Lens, channels: Sequence[Channel], goals: Sequence[Goal], sampler: SourceSampler | None, cells: int = 1
) -> list[_Setup]:
    """Return the measurements of one lens and light on the receivers of all goals; sampler: as in `measure`.

    cells: wanted number of cells along each side of a pixel, reduced by halves to at most MAX_CELLS per picture.
    """
    if not isinstance(sampler, SourceSampler):  # a function of a script, or none
        sampler = SourceSampler(sampler or (lambda count, seed: channels))
    while cells > 1 and max(goal.picture.size for goal in goals) * cells**2 > MAX_CELLS:
        cells //= 2
    return [_Setup(lens, sampler, goal.screen, torch.from_numpy(goal.picture), cells=cells) for goal in goals]


def _trace(setups: Sequence[_Setup], side: int, seed: int, counts_cells: bool = True) -> list[_Rays]:
    """Trace SETS sets, each of about side x side rays per spectral line, to the screens of all `setups` of one lens.

    counts_cells: False: the light is counted in pixels alone.
    """
    sets, screens, cells = [], [setup.screen for setup in setups], setups[0].cells if counts_cells else 1
    count = min(max(side**2 // RAYS_PER_POINT, MIN_SOURCE_POINTS), MAX_SOURCE_POINTS)
    for i in range(SETS):
        channels = setups[0].sampler(count, seed + i)
        n = max(1, round(side_factor(channels) * side))
        sets.append(simulated(setups[0].lens, channels, screens, n, seed=seed + i, cells=cells))
    return [setup.rays(parts, side) for setup, parts in zip(setups, zip(*sets, strict=True), strict=True)]


def _joined(rays: Sequence[_Rays] | None, more: Sequence[_Rays]) -> list[_Rays]:
    """Return the rays on each screen joined with `more` rays (`_Rays.joined`); None: no rays so far."""
    return list(more) if rays is None else [a.joined(b) for a, b in zip(rays, more, strict=True)]


def _value(pictures: Sequence[Tensor], target: Tensor) -> tuple[float, float]:
    """Return (RRMSD, its standard error); an RRMSD² below its own standard error is replaced by that."""
    squared, error = squared_distance(pictures, target)
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


def _by_cell(rays: _Rays, goal: Goal, image: float) -> Iterator[CellError]:
    """Yield the RRMSDs on cells of COARSER_CELLS pixels, on pixels, and on each finer cell that was counted.

    image: diameter (pixels) of the image of the real source.
    """
    if not rays.cells:
        return
    pixels, finest = torch.from_numpy(goal.picture), rays.cells[0].shape[0] // goal.screen.rows
    for size in COARSER_CELLS:
        pictures = [joined_cells(box, size) for box in rays.boxes]
        yield _cell_error(float(size), pictures, joined_cells(pixels, size), image)
    yield _cell_error(1.0, rays.boxes, pixels, image)
    count = 2
    while count <= finest:
        target = torch.from_numpy(goal.on_cells(count).picture).float()
        pictures = [joined_cells(cells, finest // count) for cells in rays.cells]
        yield _cell_error(1 / count, pictures, target, image)
        count *= 2


def _cell_error(cell: float, pictures: Sequence[Tensor], target: Tensor, image: float) -> CellError:
    """Return the RRMSD on cells of side `cell` (pixels); image: diameter (pixels) of the image of the real source.

    A blur G by the source is linear, so that E <(G A_i - T) (G A_j - T)> = <(G A - T)²> for means A_i of disjoint sets.
    """
    blurred = None
    if image > cell:
        means = list(pictures)
        if len(means) >= 2 * MIN_PICTURES:  # fewer convolutions
            means = [(one + other) / 2 for one, other in zip(*[iter(means)] * 2, strict=True)]
        blurred = _value([_blurred(each, target, image / cell) for each in means], target)[0]
    return CellError(cell, *_value(pictures, target), blurred)


def _blurred(picture: Tensor, target: Tensor, image: float) -> Tensor:
    """Return a picture convolved with the image of a source, with the target's sum; light beyond its edges is lost.

    image: diameter (cells) of the uniform disc with the second moment of the image, σ² = image² / 16 along each axis.
    The convolution is with the Gaussian of integers (Lindeberg 1990), which has this moment exactly and is nowhere
    negative; its spectrum is exp(-σ² (1 - cos 2πf)).  A dark margin of BLUR_MARGIN σ surrounds the picture.
    """
    import scipy.fft  # not loaded by the import of bstcad

    sigma = image / 4
    margins = (min(math.ceil(BLUR_MARGIN * sigma), side) for side in picture.shape)
    rows, columns = (scipy.fft.next_fast_len(n + more, True) for n, more in zip(picture.shape, margins, strict=True))
    down, across = np.fft.fftfreq(rows), np.fft.rfftfreq(columns)  # cycles per cell
    along = [np.exp(-(sigma**2) * (1 - np.cos(2 * np.pi * f))).astype(picture.numpy().dtype) for f in (down, across)]
    waves = scipy.fft.rfft2(picture.numpy(), (rows, columns))
    waves *= along[0][:, None]
    waves *= along[1]
    found = scipy.fft.irfft2(waves, (rows, columns))[: picture.shape[0], : picture.shape[1]]
    blurred = torch.from_numpy(np.ascontiguousarray(found))
    return blurred * (total(target) / total(blurred))


def _peak_figures(rays: _Rays, screen: Screen) -> dict[str, float]:
    """Return peak, peak_error and peak_cell of `Light`, on cells of half a pixel if they were counted."""
    if not rays.cells:
        value, error = _peak(rays.boxes, screen)
        return {"peak": value, "peak_error": error}
    finer = rays.cells[0].shape[0] // screen.rows // 2
    value, error = _peak([joined_cells(cells, finer).double() for cells in rays.cells], screen.divided(2))
    return {"peak": value, "peak_error": error, "peak_cell": 0.5}


def _peak(pictures: Sequence[Tensor], screen: Screen) -> tuple[float, float]:
    """Return (largest flux per mm² or sr of a cell, as a fraction of the flux of all cells; its standard error).

    One half of the pictures finds the cell and the other half measures it, so that noise does not make it too large.
    """
    sizes = torch.from_numpy(np.ascontiguousarray(screen.cell_sizes))
    found: list[float] = []  # density of each picture in the cell that the other half of them has found
    for one, other in ((pictures[::2], pictures[1::2]), (pictures[1::2], pictures[::2])):
        brightest = int((sum(one, torch.zeros_like(one[0])) / sizes).argmax())
        size = float(sizes.reshape(-1)[brightest])
        found += (float(part.reshape(-1)[brightest]) / size / float(total(part)) for part in other)
    return float(np.mean(found)), float(np.std(found, ddof=1)) / math.sqrt(len(found))


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


def _sample(setups: Sequence[_Setup], effort: Effort, max_noise: float = math.inf) -> list[_Rays]:
    """Trace passes of up to `effort.rays` rays per side until each standard error is `effort.accuracy` times the RRMSD.

    The noise of each mean picture, which falls as n^-3/2 with n rays per side, must also be below `max_noise` times
    RRMSD.  The standard error falls as n^-3 where products of noise dominate (the variance of a pixel of n² stratified
    rays falls as n^-3; measured: n^-2.9), and as n^-3/2 where products of the lens's error and noise dominate.
    """
    most = min(effort.rays, setups[0].sampler.largest_side or effort.rays)
    pilot = max(most // PILOT_DIVISOR, min(most, 32))
    began, side, rays = time.perf_counter(), pilot if effort.accuracy else most, None
    first = side

    def finer(rays: _Rays, target: Tensor) -> float:
        """Return the ratio by which the rays per side have to grow for one screen; 1: they suffice."""
        squared, error = squared_distance(rays.boxes, target)
        goal = 2 * effort.accuracy * squared  # σ(U) = 2 RRMSD σ(RRMSD)
        noise = _noise(rays.boxes, target)
        if error <= goal and noise <= max_noise**2 * squared and side > first:  # the first errors are uncertain
            return 1.0
        ratio = (1.5 * error / goal) ** (1 / 3) if goal > 0 else math.inf
        if squared > 0:
            ratio = max(ratio, (1.5 * noise / (max_noise**2 * squared)) ** (1 / 3))
        return max(ratio, 2.0 if side == first else 1.2)

    while True:
        start = time.perf_counter()
        more = _trace(setups, side, effort.seed, counts_cells=rays is not None or side >= most)  # not the few first
        if not all(each.boxes for each in more):
            return more
        rays = _joined(rays, more)
        if side >= most:
            return rays
        ratio = max(finer(each, setup.target) for each, setup in zip(rays, setups, strict=True))
        if ratio == 1:
            return rays
        larger = min(most, side * ratio)
        now = time.perf_counter()
        if now - began + (now - start) * (larger / side) ** 2 > effort.seconds:
            return rays
        side = round(larger)


def _sample_source(setups: Sequence[_Setup], effort: Effort, max_noise: float) -> list[_Rays]:
    """Trace rays to the accuracy of `_sample`, at most `effort.rays`² per set and line, with new source points per set.

    Each pixel gets few rays from each of many points: with n rays per side its variance falls as n^-2, as for random
    rays.  The error of the RRMSD falls as n^-2, or faster where more rays come from more points (measured: n^-2.6).
    Source and picture are smooth, so `max_noise` limits the error of the smoothed picture, not the noise of pixels.
    """
    most = min(effort.rays, setups[0].sampler.largest_side or effort.rays)
    pilot = max(most // PILOT_DIVISOR, min(most, 32))
    began, side, rays = time.perf_counter(), pilot if effort.accuracy else most, None
    number = 0

    def times_more(rays: _Rays, target: Tensor) -> float:
        """Return the ratio by which the rays have to grow for one screen; 1: they suffice."""
        squared, error = squared_distance(rays.boxes, target)
        goal, max_square = 2 * effort.accuracy * squared, max_noise**2 * squared  # σ(U) = 2 RRMSD σ(RRMSD)
        # the error of the first pass alone may be small by chance
        if number and error <= goal and _smoothed(rays.boxes, target)[1] ** 2 <= max_square:
            return 1.0
        ratio = 1.3 * error / goal if goal > 0 else math.inf
        return max(ratio if number else ratio**0.8, 4.0 if number == 0 else 1.2)

    while True:
        start = time.perf_counter()
        seed = effort.seed + number * PASS_SEEDS  # passes with equal numbers of rays must not repeat them
        more = _trace(setups, side, seed, counts_cells=rays is not None or side >= most)
        if not all(each.boxes for each in more):
            return more
        rays = _joined(rays, [replace(each, weight=float(side) ** 2) for each in more])
        weight = rays[0].weight
        if weight >= most**2:
            return rays
        ratio = max(times_more(each, setup.target) for each, setup in zip(rays, setups, strict=True))
        if ratio == 1:
            return rays
        finer = math.sqrt(min(weight * ratio, most**2) - weight)
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
        pairs = zip(self.sheets, self.landings(lens, [screen.receiver])[0], strict=True)
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
        picture = tubes_picture(lens, members, goal.screen, n).cpu()
        if total(picture) > 0:
            picture = picture * (total(torch.from_numpy(goal.picture)) / total(picture))
        parts.append(SpectralLine(wavelength, math.fsum(channel.weight for channel in members), picture.numpy()))
    return tuple(parts)


def simulated(
    lens: Lens, channels: Sequence[Channel], screens: Sequence[Screen], n: int, seed: int, splits_missed: bool = True,
    cells: int = 1,
) -> tuple[Simulation, ...]:  # fmt: skip
    """Simulate pictures and ledgers by n x n stratified rays per channel, with another seed for each source point.

    splits_missed, cells: see `simulate`.
    """
    pairs = zip(channels, source_numbers(channels), strict=True)
    lights = [(c.weight, c.source, c.through(lens), seed + SETS * k) for c, k in pairs]
    return simulate(lights, screens, n, splits_missed=splits_missed, cells=cells)


def side_factor(channels: Sequence[Channel]) -> float:
    """Return k^-1/2, the factor of tubes or rays per side for each of k source points: their total is constant."""
    k = points_per_line(channels)
    return k**-SIDE_EXPONENT if k > 1 else 1


def _squared(t: Tensor) -> float:
    return dot(t.reshape(-1), t.reshape(-1))
