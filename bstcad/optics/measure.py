"""One measurement: what light a lens throws on a screen, and how near it comes to a target.

Whoever judges a lens measures it so: verification, the stages of tailoring, float32 beside float64.  How much work goes
into it is an argument.  The picture is one of ray tubes, without noise (tubes/launching.py); where rays are asked for,
stratified ones that share nothing with the tubes but the trace give the ledger, the efficiency and a second picture.

Of an extended source there are points, each with tubes and rays of its own.  Their number leaves noise, too, which is
found as that of rays is: one half against the other (channels.contrast).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from bstcad.optics.channels import Channel, contrast, places, points, weighted_sum
from bstcad.optics.irradiance import Screen, rrmsd
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.simulation import Simulation, simulate
from bstcad.optics.tubes.launching import SHEET, Coarse, picture

if TYPE_CHECKING:
    from bstcad.optics.ghosts import Ghost

RESOLVED = 5.0  # an RRMSD must be so many times its noise floor
ROUNDING = 1e-9  # of the irradiance
# Tubes and rays a side fall with the number k of points of an extended source, as k to these powers: so the rays are as
# many in all as those of one point, and the tubes grow as sqrt(k), since what they leave out does not average away.
TUBES, RAYS = 0.25, 0.5
FEW = 64  # tubes a side of a coarse sheet of many: finding that is half of the work, and 1e-6 of the light is enough
SEEDS = 2  # of the rays, each for a half
# Tubes err by ∝ n^-ORDER, n a side, and by much the same in two pictures (LIKENESS, a correlation): found on lenses for
# pictures, whose faces have detail down to the control cell, where single smooth ones have 2 and 0.
ORDER, LIKENESS = 1.75, 0.75
STEP = 1.5  # times the tubes a side, up to which that was found


@dataclass(frozen=True)
class Effort:
    """How much work a measurement may take; the default is that of a verification."""

    # Ray tubes a side: one number after the other, until the noise floor is below a fifth of the RRMSD.  These are
    # primes, so that no corner is one that tailoring used, and the last are 72 million tubes.
    tubes: tuple[int, ...] = (1031, 1549, 2063, 3079, 4099, 6151)
    rays: int = 2048  # a side of the window, for each of two halves; 0: none
    seed: int = 0  # of the rays
    places: int = 1025  # a side of the lens, where a verification looks at its thickness
    points: int = 1 << 17  # of a face, where it compares the written file with the design


FULL = Effort()
Sheets = Sequence[Coarse | None]  # of each channel
GhostLight = Callable[[Lens, Sequence[Channel], Screen, int, int], "Ghost"]  # of so many rays a side, and their seed


@dataclass(frozen=True, eq=False)
class Light:
    """What a lens makes of the light of all channels."""

    picture: np.ndarray = field(repr=False)  # (rows, columns), row 0 = y max, by tubes, with the target's sum
    rrmsd: float  # of that picture (Wang et al. 2023, Eq. 15); NaN: no light falls on the screen
    # RRMSD that the finest tubes leave, from that against those a step coarser; infinite if there was one step only.
    # Of an extended source that and `sampling` together, as the root of the sum of their squares
    noise: float
    tubes: int  # how many, per channel
    rays: Simulation | None = field(default=None, repr=False)  # of the first half; None: none were asked for
    tent: float = math.nan  # RRMSD of the rays by linear binning
    disagreement: float = math.nan  # of rays and tubes, in units of their noise
    uncertainty: float = 1.0  # 1, and more where few pixels leave that noise itself uncertain
    ghost: np.ndarray | None = field(default=None, repr=False)  # the part of the picture that is one; None: left out
    sampling: float = 0.0  # part of the noise: RRMSD that comes of the number of points of an extended source
    ray_noise: float = math.nan  # RRMSD that the rays leave, both halves together

    @property
    def flux(self) -> dict[str, float]:
        """The ledger: where the source's light goes; the lines sum to 1.  Empty if no rays were asked for."""
        return self.rays.flux if self.rays else {}

    @property
    def efficiency(self) -> float:
        """Flux inside the target over flux that leaves the last surface; NaN if no rays were asked for."""
        return self.rays.efficiency if self.rays else math.nan

    @property
    def used(self) -> float:
        """Part of the light that enters the lens which falls on the target; NaN if no rays were asked for."""
        enters = 1 - self.flux["missed the lens"] if self.rays else math.nan
        return self.flux["on target"] / enters if enters > 0 else 0.0 if self.rays else math.nan


def measure(
    lens: Lens, channels: Sequence[Channel], screen: Screen, target: np.ndarray, effort: Effort = FULL,
    ghost: GhostLight | None = None,
) -> Light:  # fmt: skip
    """The light that `lens` throws on `screen`, held to `target`.

    lens: its heights in float64 on the CPU for the full accuracy.  channels: weights sum to 1.  target: (rows, columns)
    of any sum, row 0 = y max.  Takes as many tubes as bring the noise floor below a fifth of the RRMSD, at most the
    last of effort.tubes; fewer where the floor falls so slowly that the last could not resolve it.
    ghost: how light is followed that is reflected twice inside the lens (ghosts.ghost_light), to be a part of the
    picture and of the ledger; None: it is left out.
    """
    wanted = torch.from_numpy(np.asarray(target, dtype=np.float64))
    size = _norm(wanted)
    finest, floors, share = None, [], a_side(channels)
    sheets: Sheets = [{} for _ in channels]
    stray = ghost and ghost(lens, channels, screen, _rays_a_side(channels, effort), effort.seed)
    for n in effort.tubes:
        n = round(share * n)
        coarser, (whole, apart) = finest, _by_points(lens, channels, screen, n, sheets)
        whole = _joined(whole, stray)
        finest = _scaled(whole, wanted)
        if finest is None:
            return Light(np.zeros(screen.shape), math.nan, math.inf, n * n)
        found = float(rrmsd(finest, wanted))
        noise = math.inf if coarser is None else _norm(finest - coarser) / size / gap(n / floors[-1][0])
        sampling = 0.0 if apart is None else _norm(apart) * float(total(wanted) / total(whole)) / size
        floors.append((n, noise))
        if RESOLVED * noise <= found or _in_vain(found, floors, share * effort.tubes[-1]) or 2 * noise <= sampling:
            break
    faint = None if stray is None else (stray.picture.cpu() * (total(wanted) / total(whole))).numpy()
    light = Light(finest.numpy(), found, math.hypot(noise, sampling), n * n, ghost=faint, sampling=sampling)
    return _with_rays(light, noise, lens, channels, screen, wanted, effort, stray) if effort.rays else light


def gap(finer: float) -> float:
    """How far apart two pictures are by tubes, in units of what the finer one errs, which has so many times the tubes
    a side."""
    more = min(finer, STEP) ** ORDER
    return math.sqrt(1 + more**2 - 2 * LIKENESS * more)


def tubes_picture(
    lens: Lens, channels: Sequence[Channel], screen: Screen, n: int, sheets: Sheets | None = None,
    over_the_back: bool = False,
) -> torch.Tensor:  # fmt: skip
    """(rows, columns) flux that falls into each pixel, by n x n tubes a channel; all light is 1.

    sheets: of each channel what `picture` keeps; over_the_back: see there.
    """
    sheets, few = sheets or [None] * len(channels), FEW if over_the_back else SHEET
    return weighted_sum(
        channels,
        (
            picture(c.source, c.through(lens), screen, n, few, known, over_the_back)
            for c, known in zip(channels, sheets, strict=True)
        ),
    )


@dataclass(frozen=True, eq=False)
class Line:
    """The light of one line of a spectrum by itself."""

    wavelength: float  # nm
    share: float  # of all light; the shares of all lines sum to 1
    picture: np.ndarray = field(repr=False)  # (rows, columns), row 0 = y max, with the target's sum; dark: zero


def lines_apart(
    lens: Lens, channels: Sequence[Channel], screen: Screen, target: np.ndarray, n: int
) -> tuple[Line, ...]:
    """What each line of a spectrum makes by itself, by n x n tubes a channel, the shortest first; () for one line."""
    lines: dict[float, list[Channel]] = {}
    for channel in channels:
        lines.setdefault(channel.source.wavelength, []).append(channel)
    if len(lines) < 2:
        return ()
    wanted, found = torch.from_numpy(np.asarray(target, dtype=np.float64)), []
    for wavelength, members in sorted(lines.items()):
        share = math.fsum(channel.weight for channel in members)
        picture = _scaled(tubes_picture(lens, members, screen, n).cpu(), wanted)
        found.append(Line(wavelength, share, np.zeros(screen.shape) if picture is None else picture.numpy()))
    return tuple(found)


def _by_points(
    lens: Lens, channels: Sequence[Channel], screen: Screen, n: int, sheets: Sheets
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """(that picture, by how much halves of the source's points disagree on it); None: there are no points."""
    signs = contrast(channels)
    if not signs:
        return tubes_picture(lens, channels, screen, n, sheets).cpu(), None
    whole = apart = 0
    for channel, sign, known in zip(channels, signs, sheets, strict=True):
        part = channel.weight * picture(channel.source, channel.through(lens), screen, n, FEW, known).cpu()
        whole, apart = whole + part, apart + sign * part
    return whole, apart


def simulated(lens: Lens, channels: Sequence[Channel], screen: Screen, n: int, seed: int) -> Simulation:
    """The same by n x n stratified rays a channel, with the ledger; other ones at each point of an extended source."""
    parts = [
        simulate(c.source, c.through(lens), screen, n, seed + SEEDS * place)
        for c, place in zip(channels, places(channels), strict=True)
    ]
    box, tent = (weighted_sum(channels, (getattr(part, kind) for part in parts)) for kind in ("box", "tent"))
    flux = {line: weighted_sum(channels, (part.flux[line] for part in parts)) for line in parts[0].flux}
    return Simulation(box, tent, flux, sum(part.rays for part in parts))


def _rays_a_side(channels: Sequence[Channel], effort: Effort) -> int:
    """How many rays each way there are of each channel."""
    return round(a_side(channels, RAYS) * effort.rays)


def _joined(picture: torch.Tensor, ghost: Ghost | None) -> torch.Tensor:
    """The picture with the ghost's light."""
    return picture if ghost is None else picture + ghost.picture.cpu()


def a_side(channels: Sequence[Channel], power: float = TUBES) -> float:
    """By how much fewer tubes or rays a side there are at each of k points of a source: k^-power."""
    k = points(channels)
    return k**-power if k > 1 else 1


def _with_rays(light, noise, lens, channels, screen, wanted, effort, ghost) -> Light:
    """The same light with what two halves of the rays say of it; noise: of its tubes."""
    size, n = _norm(wanted), _rays_a_side(channels, effort)
    halves = [simulated(lens, channels, screen, n, effort.seed + i) for i in (0, 1)]
    first = halves[0] if ghost is None else replace(halves[0], flux=_moved(halves[0].flux, ghost.flux))
    box, tent = (_joined(sum(getattr(half, kind).cpu() for half in halves) / 2, ghost) for kind in ("box", "tent"))
    boxes = [_scaled(picture, wanted) for picture in (*(_joined(half.box.cpu(), ghost) for half in halves), box)]
    if any(picture is None for picture in boxes):
        return replace(light, rays=first, disagreement=math.inf)
    between = boxes[0] - boxes[1]  # the difference of two halves has twice the deviation of their mean
    ray_noise = _norm(between) / size / 2
    apart = _norm(boxes[2] - torch.from_numpy(light.picture)) / size
    return replace(
        light,
        rays=first,
        tent=float(rrmsd(tent, wanted)),
        disagreement=apart / max(math.hypot(ray_noise, noise), ROUNDING),
        ray_noise=ray_noise,
        uncertainty=1 + 3 / math.sqrt(effective_pixels(between)),
    )


def _moved(flux: dict[str, float], change: dict[str, float]) -> dict[str, float]:
    """A ledger with some of its flux moved from line to line."""
    return flux | {line: flux.get(line, 0.0) + more for line, more in change.items()}


def _in_vain(found: float, floors: list[tuple[int, float]], last: int) -> bool:
    """Would the last tubes, too, leave a noise floor twice too high, were it to fall on as it has (tubes, floor)?"""
    if len(floors) < 3:  # the first has none before it
        return False
    (coarser, before), (finer, now) = floors[-2:]
    power = max(math.log(before / now) / math.log(finer / coarser), 0.0)
    return RESOLVED * now * (finer / last) ** power > 2 * found


def effective_pixels(noise: torch.Tensor) -> float:
    """How many pixels carry the noise: all of them if it is normal and everywhere alike, few if a few are lit."""
    second, fourth = float((noise**2).sum()), float((noise**4).sum())
    return min(3 * second**2 / fourth, noise.numel()) if fourth > 0 else float(noise.numel())


def _norm(t: torch.Tensor) -> float:
    """sqrt(Σ t²)."""
    return math.sqrt(float(total(t * t)))


def _scaled(picture: torch.Tensor, target: torch.Tensor) -> torch.Tensor | None:
    """The picture with the target's sum; None if it is dark."""
    return picture * (total(target) / total(picture)) if total(picture) > 0 else None
