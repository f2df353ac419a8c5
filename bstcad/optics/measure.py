"""One measurement: the light that a lens throws on a screen, and how near it comes to a target.

Verification, made parts, tolerances and the sweeps of accuracy over time all measure so.  How much work goes into it is
an argument.

RRMSD is measured without bias, from SETS independent sets of stratified rays.  Each gives a picture A_i = A + n_i, the
lens's own picture A and noise of mean zero, so that the square of its distance from the target T is too large by that
of the noise.  The product of two of them is not: E <(A_i - T) (A_j - T)> = <(A - T)²>, i ≠ j.  The mean over all pairs
is a U-statistic (Hoeffding 1948), and its standard error follows from the scatter of the pairs (`apart`).  Rays are
added until that error is as small as asked for.  Of an extended source each set has points of its own, so that their
number leaves no bias either.

The picture for people is the mean of all sets, smoothed as far as that takes more noise from it than detail.  Ray tubes
(tubes.py), in whose picture there is no noise, share nothing with the rays but the trace: they are the witness.  They
interpolate linearly between their corners, which leaves out how light changes within a cell of the net: two tubes a
cell are off by about the RRMSD that tailoring by tubes leaves, four by a third of it, eight by a tenth (measured).
Tubes are therefore made half as wide until both pictures agree, or until the tubes' own error cannot be why they do
not.  Their RRMSD (`rrmsd_by_tubes`) compares twins of float32 and float64; it is a few per cent too low where tailoring
has learnt its tubes.  A ghost is traced once, and its noise stands in all sets alike.

A source of some size throws an image of itself through each place of the lens (`Images`).  All rays that leave one
point of the back face share its slope, whatever point of the source they come from: no lens can bring them together.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.channels import Channel, points_per_line, source_numbers, weighted_sum
from bstcad.optics.irradiance import Leak, Screen, efficiency, leak, rrmsd, tent
from bstcad.optics.kernels.reductions import dot, total
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import Landed
from bstcad.optics.sampling import point_pairs
from bstcad.optics.trace import UNDERSIDE, Ghost, Simulation, simulate, through, whole_kernel
from bstcad.optics.tubes import SHEET, Tubes, area_of, arriving, corners, launch_tubes, middle, picture, rays_to

SETS = 8  # independent sets of rays: a standard error is then known to a quarter of it
FEWEST = 5  # times fewer rays a side in the first sets, which tell how many are needed
SEEN = 0.45  # noise of the mean picture over the RRMSD, at the default accuracy: RRMSD is then a tenth too large
RESOLVED = 5.0  # times its standard error an RRMSD must be at least
# Differences that pictures by rays and by tubes may have: a part of the smaller RRMSD, and always a part of the target.
AGREED, FAINT = 0.5, 0.002
FINEST = 4200  # tubes a side at most, to which the witness goes where the pictures differ by more
SMOOTHED = (0.0, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)  # pixels, standard deviation of a normal kernel
# Tubes and rays a side fall with the number k of points of an extended source, as k to this power: there are as many in
# all as of one point.
RAYS = 0.5
A_POINT = 1 << 13  # rays of each set a point of an extended source
FEW_POINTS, MANY_POINTS = 8, 1024  # points of an extended source in each set
LEAST = 513  # tubes a side of the witness: a few serve no pixels
FEW = 64  # tubes a side of a coarse sheet of many: finding that is half of the work, and 1e-6 of the light is enough
PASS = 1 << 20  # between the seeds of passes by rays from an extended source
GHOSTS = 4  # times fewer rays a side for the light reflected twice, which is a hundredth of all
IMAGE_PLACES = 48  # a side of the back face, through each of which the source is seen
# Light that grazes a tilted plane lands anywhere, and is no image: more than so many times as far from the screen's
# middle as the screen is wide and half of the light is far.
ASTRAY = 16
EVEN = 2048  # pairs of points of an evenly bright source


@dataclass(frozen=True)
class Effort:
    """How much work a measurement may take; the default is that of a verification."""

    rays: int = 2896  # a side of the window at most, of each of SETS sets: 67 million in all
    seed: int = 0  # seed of the rays
    places: int = 1025  # a side of the lens, where a verification looks at its thickness
    points: int = 1 << 17  # points of a face at which the written file is compared with the design
    accuracy: float = 0.005  # standard error of the RRMSD over the RRMSD at which no more rays are traced; 0: all are
    seconds: float = math.inf  # no further sets of rays are begun that would end later
    witness: bool = True  # do ray tubes trace a source without size, too?


FULL = Effort()
GhostLight = Callable[[Lens, Sequence[Channel], Screen, int, int], Ghost]  # the numbers: rays a side, seed
Draw = Callable[[int, int], Sequence[Channel]]  # channels at this number of points of an extended source, by a seed


@dataclass(frozen=True)
class Witness:
    """The same light by ray tubes."""

    rrmsd: float  # RRMSD of their picture
    off: float  # their picture against the rays', without bias, as RRMSD has it
    limit: float  # largest `off` that passes, by the RRMSD, or by the tubes' own error and the noise of the rays
    tubes: int  # a side


@dataclass(frozen=True, eq=False)
class Light:
    """The light of all channels behind a lens."""

    picture: np.ndarray = field(repr=False)  # (rows, columns), row 0 = y max, with the target's sum: for people
    rrmsd: float  # without bias (Wang et al. 2023, Eq. 15); NaN: no light falls on the screen
    standard_error: float  # standard error of the RRMSD
    rays: int  # in all
    flux: dict[str, float]  # the ledger: where the source's light goes; the lines sum to 1
    tent: float = math.nan  # RRMSD by linear binning
    picture_off: float = math.nan  # `picture` against the lens's own, as RRMSD has it
    witness: Witness | None = None  # None: of a source of some size, with losses, without a kernel, or unasked
    ghost: np.ndarray | None = field(default=None, repr=False)  # the part of the picture by a ghost; None: left out
    leak: Leak | None = None  # leak of the rays' mean picture, not smoothed; None: the target is dark nowhere
    rrmsd_whole: float | None = None  # against a picture of which the target is a part; None: there is none

    @property
    def efficiency(self) -> float:
        """Flux inside the target over flux that leaves the last surface."""
        return efficiency(self.flux)

    @property
    def used(self) -> float:
        """Part of the light that enters the lens which falls on the target."""
        enters = 1 - self.flux["missed the lens"] - self.flux.get(UNDERSIDE, 0.0)
        return self.flux["on target"] / enters if enters > 0 else 0.0


def measure(
    lens: Lens, channels: Sequence[Channel], screen: Screen, target: np.ndarray, effort: Effort = FULL,
    ghost: GhostLight | None = None, draw: Draw | None = None, whole: np.ndarray | None = None,
) -> Light:  # fmt: skip
    """The light that `lens` throws on `screen`, held to `target`.

    lens: its heights in float64 on the CPU for the full accuracy.  channels: weights sum to 1.  target: (rows, columns)
    of any sum, row 0 = y max.  ghost: how light is followed that is reflected twice inside the lens
    (trace.ghost_light), to be a part of the picture and of the ledger; None: it is left out.
    draw: other points of an extended source for each set of rays; None: all sets begin at those of `channels`.
    whole: a picture of the target's sum to which the light is held, too.
    """
    wanted = torch.from_numpy(np.asarray(target, dtype=np.float64))
    stray = ghost and ghost(lens, channels, screen, round(a_side(channels) * effort.rays / GHOSTS), effort.seed)
    seen = SEEN * effort.accuracy / FULL.accuracy
    if draw is not None:
        rays = _enough_of_source(lens, draw, screen, wanted=wanted, effort=effort, ghost=stray, seen=seen)
    else:
        rays = _enough(lens, lambda count, seed: channels, screen, wanted=wanted, effort=effort, ghost=stray, seen=seen)
    if not rays.boxes:
        return Light(np.zeros(screen.shape), math.nan, math.inf, rays=rays.count, flux=rays.flux)
    (value, error), (tent, _) = _value(rays, wanted), apart(rays.tents, wanted)
    shown, off = _shown(rays.boxes, wanted)
    # no kernel traces two nets as a whole, or what is around a lens, and all are to have a witness
    plain = lens.shapes("front") or bool(lens.before or lens.behind)
    lenses = [(c.source, c.through(lens)) for c in channels]
    simple = draw is None and all(
        seen.losses is None and (plain or whole_kernel("trace.simulate", source, seen, screen.plane))
        for source, seen in lenses
    )
    witnessed = effort.witness and simple
    return Light(
        shown.numpy(), value, error, rays=rays.count, flux=rays.flux, tent=math.sqrt(max(tent, 0.0)), picture_off=off,
        witness=_witness(lens, channels, screen, wanted=wanted, rays=rays, ghost=stray) if witnessed else None,
        ghost=stray and (stray.picture.cpu() * (total(wanted) / rays.on_screen)).numpy(),
        leak=leak((sum(rays.boxes) / SETS).numpy(), wanted.numpy()),
        rrmsd_whole=None if whole is None else _value(rays, torch.from_numpy(whole))[0],
    )  # fmt: skip


def rrmsd_by_rays(
    lens: Lens, channels: Sequence[Channel], screen: Screen, target: np.ndarray, effort: Effort = FULL,
    draw: Draw | None = None,
) -> float:  # fmt: skip
    """`Light.rrmsd` alone; NaN where no light falls."""
    wanted = torch.from_numpy(np.asarray(target, dtype=np.float64))
    rays = _enough(lens, draw or (lambda count, seed: channels), screen, wanted=wanted, effort=effort, ghost=None)
    return _value(rays, wanted)[0] if rays.boxes else math.nan


def rrmsd_by_tubes(lens: Lens, channels: Sequence[Channel], screen: Screen, target: np.ndarray, n: int) -> float:
    """RRMSD of the picture by n x n tubes a channel: no noise, but the bias of tubes; NaN where no light falls."""
    wanted = torch.from_numpy(np.asarray(target, dtype=np.float64))
    flux = tubes_picture(lens, channels, screen, n).cpu()
    return float(rrmsd(flux, wanted)) if total(flux) > 0 else math.nan


@dataclass(frozen=True, eq=False)
class _Rays:
    """Pictures and ledger of independent sets of rays."""

    boxes: tuple[Tensor, ...]  # picture by each set, (rows, columns) with the target's sum; (): no light falls on it
    tents: tuple[Tensor, ...]  # the same by linear binning
    flux: dict[str, float]  # the ledger
    count: int  # number of rays
    on_screen: float  # flux on the screen, as a fraction of the source's
    weight: float = 1.0  # weight of its pictures among those of others: 1 / the variance of their noise, on any scale

    def joined(self, other: _Rays) -> _Rays:
        """Each set with that of `other`: sets stay independent of each other."""
        weight = self.weight + other.weight
        share = other.weight / weight

        def mean(a, b):
            return a + share * (b - a)

        return _Rays(
            tuple(map(mean, self.boxes, other.boxes)), tuple(map(mean, self.tents, other.tents)),
            {line: mean(part, other.flux[line]) for line, part in self.flux.items()}, count=self.count + other.count,
            on_screen=mean(self.on_screen, other.on_screen), weight=weight,
        )  # fmt: skip


def _value(rays: _Rays, wanted: Tensor) -> tuple[float, float]:
    """(RRMSD, its standard error); of an RRMSD² below its error, which is not resolved, that error stands for it."""
    squared, error = apart(rays.boxes, wanted)
    value = math.sqrt(max(squared, error))
    return value, math.sqrt(value**2 + error) - value


def apart(pictures: Sequence[Tensor], other: Tensor) -> tuple[float, float]:
    """(|A - other|² / |other|² without the noise of independent pictures A_i of A, its standard error).

    U = mean over i ≠ j of p_ij = d_i · d_j, d_i = A_i - other.  With M sets and Hoeffding's p_ij = U + a_i + a_j + e_ij

        σ² = 4 σ_a² / M + 2 σ_e² / (M (M - 1)).

    The jackknife, 4 / M times the variance of the means of p_ij over j times ((M - 1) / (M - 2))², has 4 σ_e² / (M (M -
    2)) as its second term (Efron and Stein 1981): twice too much where noise times noise rules, or by luck a tenth of
    it.  σ_e² follows from what a_i and a_j leave of the M (M - 1) / 2 products, with M (M - 3) / 2 degrees of freedom.
    """
    off = [(picture - other).reshape(-1) for picture in pictures]
    size, m = _squared(other), len(off)
    products = np.zeros((m, m))
    for i in range(m):
        for j in range(i):
            products[i, j] = products[j, i] = dot(off[i], off[j]) / size
    mean, of_each = products.sum() / (m * (m - 1)), products.sum(0) / (m - 1)
    single = (of_each - mean) * (m - 1) / (m - 2)  # a_i
    rest = (products - mean - single[:, None] - single)[~np.eye(m, dtype=bool)]  # e_ij, each of them twice
    pairs = float((rest**2).sum()) / (m * (m - 3))  # σ_e²
    jackknife = 4 / m * float((single**2).sum()) / (m - 1)
    least = 2 * pairs / (m * (m - 1))
    return float(mean), math.sqrt(max(jackknife - 4 * pairs / (m * (m - 2)) + least, least))


def _noise(pictures: Sequence[Tensor], wanted: Tensor) -> float:
    """Square of the noise of the mean picture, as RRMSD has it: Σ_i |A_i - mean|² / (M (M - 1) |T|²)."""
    m, mean = len(pictures), sum(pictures) / len(pictures)
    return sum(_squared(picture - mean) for picture in pictures) / (m * (m - 1) * _squared(wanted))


def _shown(pictures: Sequence[Tensor], wanted: Tensor) -> tuple[Tensor, float]:
    """(smoothed picture for people, with the target's sum; its RRMSD from the lens's noiseless picture).

    Of the kernels that SMOOTHED names the one by which means of all sets but two come nearest to these two, whose
    errors are independent: E <(S A - A_i) (S A - A_j)> = |S A - A|².
    """
    from scipy.ndimage import gaussian_filter  # which a mere import of bstcad need not load

    size, whole = _squared(wanted), sum(pictures)
    pairs = [(one, other, (whole - one - other) / (SETS - 2)) for one, other in zip(*[iter(pictures)] * 2, strict=True)]

    def smooth(mean: Tensor, width: float) -> Tensor:
        smoothed = torch.from_numpy(gaussian_filter(mean.numpy(), width, mode="nearest")) if width else mean
        return smoothed * (total(wanted) / total(smoothed))

    def off(width: float) -> float:
        near = [(smooth(mean, width), one, other) for one, other, mean in pairs]
        return sum(dot((p - one).reshape(-1), (p - other).reshape(-1)) for p, one, other in near) / len(near) / size

    least, best = math.inf, 0.0
    for width in SMOOTHED:  # wider kernels take less noise and more detail: there is one minimum
        if (square := off(width)) > least:
            break
        least, best = square, width
    return smooth(whole / SETS, best), math.sqrt(max(least, 0.0))


def _enough(
    lens, draw: Draw, screen: Screen, wanted: Tensor, effort: Effort, ghost: Ghost | None, seen: float = math.inf
) -> _Rays:
    """More rays, at most `effort.rays` a side, until the standard error is `effort.accuracy` of the RRMSD.

    The noise of the mean picture, which falls as n^-3/2, has to come down to `seen` times the RRMSD, too.
    The error falls as n^-3 with n rays a side where noise times noise rules (the variance of a pixel of n² stratified
    rays falls as n^-3; measured: n^-2.9), and as n^-3/2 where the lens's own error times noise does.
    """
    few = max(effort.rays // FEWEST, min(effort.rays, 32))
    began, side, rays = time.perf_counter(), few if effort.accuracy else effort.rays, None
    first = side
    while True:
        start = time.perf_counter()
        more = _traced(lens, draw, screen, wanted=wanted, side=side, seed=effort.seed, ghost=ghost)
        if not more.boxes:
            return more
        rays = more if rays is None else rays.joined(more)
        if side >= effort.rays:
            return rays
        squared, error = apart(rays.boxes, wanted)
        wish = 2 * effort.accuracy * squared  # σ(U) = 2 RRMSD σ(RRMSD)
        noise = _noise(rays.boxes, wanted)
        if error <= wish and noise <= seen**2 * squared and side > first:  # the first by itself could be small by luck
            return rays
        finer = (1.5 * error / wish) ** (1 / 3) if wish > 0 else math.inf
        if squared > 0:
            finer = max(finer, (1.5 * noise / (seen**2 * squared)) ** (1 / 3))
        larger = min(effort.rays, side * max(finer, 2.0 if side == first else 1.2))
        now = time.perf_counter()
        if now - began + (now - start) * (larger / side) ** 2 > effort.seconds:
            return rays
        side = round(larger)


def _enough_of_source(
    lens, draw: Draw, screen: Screen, wanted: Tensor, effort: Effort, ghost: Ghost | None, seen: float
) -> _Rays:
    """`_enough` for a source of some size, by other points of it in each set.

    A pixel sees many points by a few rays each, so that the variance of a pixel falls as that of random rays, n^-2;
    the error of the RRMSD falls as n^-2 or, where there are more points with more rays, faster (measured: n^-2.6).
    Source and picture are smooth: that of the smoothed picture is held to `seen`, not the noise of single pixels.
    """
    few = max(effort.rays // FEWEST, min(effort.rays, 32))
    began, side, rays = time.perf_counter(), few if effort.accuracy else effort.rays, None
    number = 0
    while True:
        start = time.perf_counter()
        seed = effort.seed + number * PASS  # so that a pass of as many rays as the one before has others
        more = _traced(lens, draw, screen, wanted=wanted, side=side, seed=seed, ghost=ghost)
        if not more.boxes:
            return more
        more = replace(more, weight=float(side) ** 2)
        rays = more if rays is None else rays.joined(more)
        if rays.weight >= effort.rays**2:
            return rays
        squared, error = apart(rays.boxes, wanted)
        wish, clear = 2 * effort.accuracy * squared, seen**2 * squared  # σ(U) = 2 RRMSD σ(RRMSD)
        # the first by itself could be small by luck
        if number and error <= wish and _shown(rays.boxes, wanted)[1] ** 2 <= clear:
            return rays
        more_rays = 1.3 * error / wish if wish > 0 else math.inf
        wanted_rays = rays.weight * max(more_rays if number else more_rays**0.8, 4.0 if number == 0 else 1.2)
        finer = math.sqrt(min(wanted_rays, effort.rays**2) - rays.weight)
        now = time.perf_counter()
        if now - began + (now - start) * (finer / side) ** 2 > effort.seconds:
            return rays
        side, number = math.ceil(finer), number + 1


def _traced(lens, draw: Draw, screen: Screen, wanted: Tensor, side: int, seed: int, ghost) -> _Rays:
    """SETS sets of rays, of about side x side each."""
    sets = []
    count = min(max(side**2 // A_POINT, FEW_POINTS), MANY_POINTS)
    for i in range(SETS):
        channels = draw(count, seed + i)
        n = max(1, round(a_side(channels) * side))
        sets.append(simulated(lens, channels, screen, n=n, seed=seed + i))
    flux = {line: math.fsum(part.flux[line] for part in sets) / SETS for line in sets[0].flux}
    if ghost is not None:
        flux |= {line: flux.get(line, 0.0) + more for line, more in ghost.flux.items()}
    count = sum(part.rays for part in sets)
    boxes, tents = ([_joined(getattr(part, kind), ghost) for part in sets] for kind in ("box", "tent"))
    on_screen = math.fsum(float(total(box)) for box in boxes) / SETS
    if not all(float(total(box)) > 0 for box in boxes):
        return _Rays((), (), flux, count=count, on_screen=0.0)
    whole = total(wanted)
    boxes, tents = (tuple(p * (whole / total(p)) for p in pictures) for pictures in (boxes, tents))
    return _Rays(boxes, tents, flux, count=count, on_screen=on_screen, weight=float(side) ** 3)


def _witness(lens, channels, screen: Screen, wanted: Tensor, rays: _Rays, ghost: Ghost | None) -> Witness:
    """The witness by `tubes_of` the lens, on these pixels, or by tubes of half the width and so on (`_compared`)."""

    def by_tubes(n: int) -> Tensor | None:
        seen = _joined(tubes_picture(lens, channels, screen, n), ghost)
        return seen * (total(wanted) / total(seen)) if total(seen) > 0 else None

    value = math.sqrt(max(apart(rays.boxes, wanted)[0], 0.0))
    return _compared(rays.boxes, by_tubes, wanted, rrmsd_by_rays=value, first=tubes_of(lens, max(screen.shape)))


def _compared(
    boxes: Sequence[Tensor], by_tubes: Callable[[int], Tensor | None], wanted: Tensor, rrmsd_by_rays: float, first: int
) -> Witness:
    """Pictures of independent sets of rays beside that `by_tubes` of a number a side, `first` or more.

    The error of n tubes a side falls as n^-1.6 or so, so that it is less than half of the distance from the picture by
    n / 2.  Where n tubes differ from the rays by over twice that distance, no finer ones will agree.
    """

    def change_from(seen: Tensor | None, coarse: Tensor | None) -> float:
        return 0.0 if seen is None or coarse is None else math.sqrt(_squared(seen - coarse) / _squared(wanted))

    n, seen, change = first, by_tubes(first), math.inf
    while True:
        if seen is None:
            return Witness(math.nan, math.inf, limit=0.0, tubes=n)
        squared, noise = apart(boxes, seen)
        off, value = math.sqrt(max(squared, 0.0)), float(rrmsd(seen, wanted))
        allowed = math.hypot(max(FAINT, AGREED * min(rrmsd_by_rays, value)), math.sqrt(2 * noise))
        if off <= allowed:
            return Witness(value, off, limit=allowed, tubes=n)
        if 2 * n > FINEST and math.isinf(change):  # a fine net, whose first tubes are the finest, too
            change = change_from(seen, by_tubes(n // 2))
        if 2 * n > FINEST or 2 * change < off:
            return Witness(value, off, limit=max(allowed, change), tubes=n)
        n, coarse = 2 * n, seen
        seen = by_tubes(n)
        change = change_from(seen, coarse)


def tubes_of(lens: Lens, pixels: int = 0) -> int:
    """Tubes a side that follow the nets: two a control point and net, or more where they have few.

    Light that a first net has bent changes within the cells of the next one: two nets take twice as many.

    Where a cell of the net lights more than a pixel, its light changes from pixel to pixel: two tubes a pixel, four a
    cell at most.  A little more than two: lines of the net and corners of tubes do not coincide.
    """
    each = 2 * len(lens.nets)
    return max(*(each * max(net.side, min(pixels, 2 * net.side)) + 5 for net in lens.nets), LEAST)


@dataclass(frozen=True)
class RayTubes:
    """The light of some channels as ray tubes on their way to the first net, launched once for lenses that are alike.

    A tube carries the light between four neighbouring rays; its picture is differentiable in the heights of all nets.
    """

    channels: tuple[Channel, ...]
    sheets: tuple[Tubes, ...]  # one a channel

    @classmethod
    def launched(cls, lens: Lens, channels: Sequence[Channel], n: int | None = None) -> RayTubes:
        """n x n tubes a channel (default: two a control point) that hold all light which gets through a lens."""
        n = n or tubes_of(lens)
        return cls(tuple(channels), tuple(launch_tubes(c.source, c.through(lens), n) for c in channels))

    def landing(self, lens: Lens, screen: Screen) -> tuple[Landed, ...]:
        """Where the corners of each sheet meet the screen."""
        pairs = zip(self.channels, self.sheets, strict=True)
        return tuple(sheet.landing(channel.through(lens), screen.plane) for channel, sheet in pairs)

    def picture(self, lens: Lens, screen: Screen) -> Tensor:
        """(rows, columns) flux that falls into each pixel, row 0 = y max; all light is 1."""
        pairs = zip(self.sheets, self.landing(lens, screen), strict=True)
        return weighted_sum(self.channels, (sheet.collect(corners, screen)[0] for sheet, corners in pairs))


def tubes_picture(
    lens: Lens, channels: Sequence[Channel], screen: Screen, n: int, over_the_back: bool = False
) -> Tensor:
    """(rows, columns) flux that falls into each pixel, by n x n tubes a channel (`tubes.picture`); all light is 1."""
    few = FEW if over_the_back else SHEET
    pictures = (picture(c.source, c.through(lens), screen, n, few=few, over_the_back=over_the_back) for c in channels)
    return weighted_sum(channels, pictures)


@dataclass(frozen=True, eq=False)
class Line:
    """The light of one line of a spectrum by itself."""

    wavelength: float  # nm
    share: float  # part of all light; the shares of all lines sum to 1
    picture: np.ndarray = field(repr=False)  # (rows, columns), row 0 = y max, with the target's sum; dark: zero


def lines_apart(
    lens: Lens, channels: Sequence[Channel], screen: Screen, target: np.ndarray, n: int
) -> tuple[Line, ...]:
    """The light of each line of a spectrum, by n x n tubes a channel, the shortest first; () for one line."""
    lines: dict[float, list[Channel]] = {}
    for channel in channels:
        lines.setdefault(channel.source.wavelength, []).append(channel)
    if len(lines) < 2:
        return ()
    wanted, parts = torch.from_numpy(np.asarray(target, dtype=np.float64)), []
    for wavelength, members in sorted(lines.items()):
        picture = tubes_picture(lens, members, screen, n).cpu()
        if total(picture) > 0:
            picture = picture * (total(wanted) / total(picture))
        parts.append(Line(wavelength, math.fsum(channel.weight for channel in members), picture.numpy()))
    return tuple(parts)


def simulated(lens: Lens, channels: Sequence[Channel], screen: Screen, n: int, seed: int) -> Simulation:
    """The picture and the ledger by n x n stratified rays a channel; other ones at each point of an extended source."""
    pairs = zip(channels, source_numbers(channels), strict=True)
    return simulate([(c.weight, c.source, c.through(lens), seed + SETS * k) for c, k in pairs], screen, n)


def _joined(picture: Tensor, ghost: Ghost | None) -> Tensor:
    """The picture with the ghost's light."""
    return picture.cpu() if ghost is None else picture.cpu() + ghost.picture.cpu()


def a_side(channels: Sequence[Channel]) -> float:
    """k^-1/2, by which the tubes or rays a side are fewer at each of k points of a source: as many in all."""
    k = points_per_line(channels)
    return k**-RAYS if k > 1 else 1


def _squared(t: Tensor) -> float:
    """Σ t²."""
    return dot(t.reshape(-1), t.reshape(-1))


@dataclass(frozen=True)
class Images:
    """Through each of several places: where the light of each channel lands."""

    offset: Tensor  # (2, channels, places) from the centroid of the place's own image, in pixels: columns, rows
    flux: Tensor  # (channels, places)

    def width(self) -> float:
        """2 √2 times the rms distance from the centroid, in pixels: an even disc of diameter D has D² / 8."""
        square = torch.where(self.flux > 0, (self.offset**2).sum(0), torch.zeros_like(self.flux))
        return 2 * math.sqrt(2 * float(total(square * self.flux) / total(self.flux)))

    def mean(self, most: tuple[int, int]) -> np.ndarray:
        """(rows, columns) the mean image, centred, of sum 1; both odd.

        most: columns and rows as far as which it is wanted; light that is farther away counts in the sum alone.
        """
        far = [math.ceil(float(p[self.flux > 0].abs().max())) + 1 for p in self.offset]
        sides = [2 * min(reach, side) + 1 for reach, side in zip(far, most, strict=True)]
        own = Screen(0.0, (-sides[0] / 2, sides[0] / 2), (-sides[1] / 2, sides[1] / 2), tuple(sides))
        position = self.offset * torch.tensor([1.0, -1.0]).view(2, 1, 1)  # rows count downwards
        image = tent(Landed(position, self.flux, torch.zeros(self.flux.shape, dtype=torch.uint8)), own)
        whole = image.sum() if all(reach <= side for reach, side in zip(far, most, strict=True)) else self.flux.sum()
        return (image / whole).numpy()

    def deviation(self, target: np.ndarray) -> float:
        """RRMSD of a target (rows, columns) convolved with the mean image, against the target itself.

        Light that is shifted by more than the target's width falls on none of it, and takes no room.
        """
        from scipy.signal import fftconvolve  # half a second to load, which a point source need not pay

        rows, columns = target.shape
        blurred = fftconvolve(target, self.mean((columns, rows)), mode="same").clip(min=0)
        if not blurred.any():  # the image is so much wider than the target that no sample of it falls there
            blurred = np.ones_like(target)
        return float(rrmsd(torch.from_numpy(blurred), torch.from_numpy(np.asarray(target, dtype=np.float64))))


def even_image(extent: Outline) -> Images:
    """The image of an evenly bright disc or rectangle, its extent in pixels."""
    offset = torch.tensor(point_pairs(extent, EVEN), dtype=torch.float64).T[..., None]
    return Images(offset, torch.full(offset.shape[1:], 1 / (2 * EVEN), dtype=torch.float64))


def detail_width(source_image: float, pixel: float) -> float:
    """√(D² + 4/3 p²): the diameter of the even disc of the variance of a disc of diameter D and a square of side p.

    Their variances are D² / 8 and p² / 6; all in one unit of length.
    """
    return math.sqrt(source_image**2 + 4 / 3 * pixel**2)


@torch.no_grad()
def images(channels: Sequence[Channel], lens: Lens, screen: Screen, n: int = IMAGE_PLACES) -> Images:
    """Images of the source whose points are the channels of the first line, through n x n lit places of the back."""
    first = channels[0]
    channels = [c for c in channels if (c.source.wavelength, c.index) == (first.source.wavelength, first.index)]
    pixel, flux = seen_through(channels, lens, screen, n)
    if (flux > 0).any():
        middle_off = (pixel - torch.tensor([screen.columns / 2, screen.rows / 2]).to(pixel).view(2, 1, 1)).abs().amax(0)
        astray = middle_off > ASTRAY * (max(screen.shape) + middle_off[flux > 0].median())
        flux = torch.where(astray, torch.zeros_like(flux), flux)
    lit = flux.sum(0) > 0
    flux, share = flux[:, lit], flux[:, lit] / flux[:, lit].sum(0)
    pixel = torch.where(flux > 0, pixel[..., lit], torch.zeros_like(share))
    return Images(pixel - (pixel * share).sum(1, keepdim=True), flux)


@torch.no_grad()
def seen_through(channels: Sequence[Channel], lens: Lens, screen: Screen, n: int) -> tuple[Tensor, Tensor]:
    """(pixel (2, channels, places), flux (channels, places)) of each channel's light through n x n places of the back.

    pixel: where it lands, column and row; of no meaning where no light gets through, and the flux is zero.
    """
    x, y = corners(lens.apertures[1], n)
    landed = [_through(channel, lens, screen, x=x, y=y) for channel in channels]
    position, flux = (torch.stack([getattr(each, name) for each in landed], dim=-2) for name in ("position", "flux"))
    return screen.pixels_of(position), flux


def _through(channel: Channel, lens: Lens, screen: Screen, x: Tensor, y: Tensor) -> Landed:
    """The light of one channel through the places between the points (x, y) (mm) of the back face."""
    seen = channel.through(lens)
    p, q, coming = rays_to(channel.source, seen, x, y)
    behind = replace(seen.unbounded(), losses=None).interfaces[seen.number_of("back") :]
    landed = through(coming, behind, screen.plane)
    flux = channel.weight * channel.source.irradiance(middle(p), middle(q), seen.entrance.z) * area_of(p, q)
    if seen.passes.sense > 0:  # light comes to the front
        flux = torch.where(seen.apertures[0].contains(middle(p), middle(q)), flux, torch.zeros_like(flux))
    flux = arriving(flux, landed).double()
    at = torch.stack([middle(c) for c in landed.position])
    return Landed(at.reshape(2, -1), flux.reshape(-1), landed.status[1:, 1:].reshape(-1))
