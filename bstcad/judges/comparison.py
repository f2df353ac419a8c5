"""Pictures of a lens by programs not written here, compared with bstcad's.

A judge traces the lens of a STEP file and gives a picture in two halves; bstcad's own picture of the same light, by
many more rays, is compared with it, on pixels coarse enough for the noise of the judge's rays.

The module of a judge has three functions.  `cannot(lens, channels)`: why it cannot trace this light, in a sentence; "":
it can.  `light(lens, channels)`: the channels with the losses that it simulates.  `trace(lens, channels, screen, rays,
seed)`: the picture on a screen of square pixels by that many rays, as faces.Traced.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import math
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.measure import Effort, measure
from bstcad.scene.errors import MachineError, SceneError, nearest
from bstcad.scene.target import overlap
from bstcad.verify.verdict import Check

JUDGES = {"batoid": "bstcad.judges.batoid", "mitsuba": "bstcad.judges.mitsuba"}
RAYS = 1 << 24  # of a judge, in both halves
PIXELS = 128  # along the longer side, at most
OURS = Effort(accuracy=0.0, witness=False)  # as many rays as allowed: no noise on coarse pixels
OTHER = 500_009  # added to the seed of the judge's rays
AGREE = 1.5  # pictures differ by no more than this times their noise
EXACT = 1e-9  # of the target
FLUX = 0.005  # of the source's light; a uniform loss would not change the picture


@dataclass(frozen=True)
class Judge:
    """A judge's picture beside bstcad's, as report.json has it; differences relative to the target, like RRMSD.

    None, from `by` on: it declined.
    """

    name: str  # of the program
    version: str  # of the program
    declined: str = ""  # why it cannot trace this light
    target: str = ""  # which of several targets the figures are of: target[0], target[1], …
    by: str | None = None  # the program's variant, if it has several
    rays: int | None = None  # in both halves
    pixels: tuple[int, int] | None = None  # columns, rows
    losses: str | None = None  # of light in both pictures: "none" or "Fresnel"
    rrmsd: float | None = None  # of its picture against the target
    rrmsd_ours: float | None = None  # of bstcad's, of the same light on the same pixels
    difference: float | None = None  # of the two pictures
    noise: float | None = None  # of the difference: of both programs' rays
    over_noise: float | None = None  # the difference in units of its noise: about 1 where both are right
    limit: float | None = None  # of that
    agrees: bool | None = None  # do all of its checks pass?
    on_target: float | None = None  # share of the source's light on the target, by the judge
    on_target_ours: float | None = None  # the same by bstcad's ledger
    heights_off: float | None = None  # mm, RMS: its faces against those of the lens
    slopes_off: float | None = None  # rad, RMS
    moved_by: float | None = None  # pixels, shift of light by that
    seconds: float | None = None  # of the judge

    @property
    def figure(self) -> str:
        """The name of its pictures: judge_batoid, and judge_batoid_2 of the second target."""
        number = int(re.sub(r"\D", "", self.target) or 0) + 1
        return f"judge_{self.name}" if number == 1 else f"judge_{self.name}_{number}"


@dataclass(frozen=True, eq=False)
class Compared:
    """A judge with the checks of picture and flux, and its pictures; of a judge that declined there are none."""

    judge: Judge
    checks: tuple[Check, ...] = ()
    target: np.ndarray | None = field(default=None, repr=False)
    ours: np.ndarray | None = field(default=None, repr=False)
    theirs: np.ndarray | None = field(default=None, repr=False)  # (rows, columns), all of the target's sum


class OwnJudge(Protocol):
    """A judge that a script hands in: the functions of a judge's module, its name and its version."""

    name: str
    version: str

    def cannot(self, lens: Lens, channels: Sequence[Channel]) -> str:
        """Why it cannot trace this light, in a sentence; "": it can."""

    def light(self, lens: Lens, channels: Sequence[Channel]) -> Sequence[Channel]:
        """The channels with the losses that it simulates."""

    def trace(self, lens: Lens, channels: Sequence[Channel], screen: Screen, rays: int, seed: int) -> Any:
        """The picture on a screen of square pixels by that many rays, as faces.Traced."""


def chosen(names: Sequence[str | OwnJudge]) -> tuple[str | OwnJudge, ...]:
    """Judges by their names; SceneError for an unknown one, MachineError where its program is not installed."""
    for name in names:
        if not isinstance(name, str):
            continue
        if name not in JUDGES:
            raise SceneError(f"--against {name}: is no judge; {nearest(name, list(JUDGES), 'known are')}")
        if importlib.util.find_spec(name) is None:
            raise MachineError(f"--against {name}: {name} is not installed; pip install 'bstcad[judges]'")
    return tuple(dict.fromkeys(names))


def against(
    names: Sequence[str | OwnJudge], lens: Lens, channels: Sequence[Channel], screen: Screen, target: np.ndarray,
    seed: int, progress: Callable[[str, int, int, str], None], key: str = "",
) -> tuple[Compared, ...]:  # fmt: skip
    """Each judge's picture beside bstcad's, one after the other; key: of the target, if there are several."""
    compared = []
    for number, name in enumerate(names):
        progress("judges", number, len(names), " ".join((getattr(name, "name", name), key)).strip())
        compared.append(compare(name, lens, channels, screen, target=target, rays=RAYS, seed=seed, key=key))
    if names:
        progress("judges", len(names), len(names), "")
    return tuple(compared)


def compare(
    given: str | OwnJudge, lens: Lens, channels: Sequence[Channel], screen: Screen, target: np.ndarray, *, rays: int,
    seed: int = 0, key: str = "",
) -> Compared:  # fmt: skip
    """A judge's picture of the light that `lens` throws on `screen`, beside bstcad's.

    rays: of the judge in all.  seed: of them.  target: (rows, columns) of any sum, row 0 = y max.  key: target[1], by
    which checks name it; "": it is the only one.
    """
    began = time.perf_counter()
    judge, name, version = _known(given)
    declined = judge.cannot(lens, channels)
    if isinstance(given, str) and screen.plane.frame is None:
        declined = "it collects light on planes alone"
    if declined:
        return Compared(Judge(name, version, declined, target=key))
    raster = coarse(screen)
    target, light = resampled(target, raster.shape), judge.light(lens, channels)
    traced = judge.trace(lens, light, raster, rays=rays, seed=seed)
    seconds = time.perf_counter() - began
    ours = measure(lens, light, raster, target, effort=replace(OURS, seed=seed + OTHER))
    total = float(target.sum())
    theirs, first, second = (_scaled(picture, total) for picture in (traced.picture, *traced.halves))
    difference = _difference(theirs, ours.picture, target)
    noise = math.hypot(_difference(first, second, target) / 2, ours.picture_error)
    over_noise, limit = difference / max(noise, EXACT), AGREE * (1 + 3 / math.sqrt(_effective_pixels(first - second)))
    on_target, on_target_ours = float(traced.picture.sum()), ours.flux.get("on target", 0.0)
    of = f", {key}" if key else ""
    irradiance = f"irradiance by {name} against bstcad's, over the noise{of}"
    flux = f"light on the target by {name} against the ledger's, of the source's{of}"
    checks = (
        Check.at_most(irradiance, over_noise, limit, id="judge-irradiance"),
        Check.at_most(flux, abs(on_target - on_target_ours), FLUX, id="judge-flux"),
    )
    outcome = Judge(
        name,
        version,
        target=key,
        by=traced.by,
        rays=traced.rays,
        pixels=(raster.columns, raster.rows),
        losses="Fresnel" if any(channel.losses for channel in light) else "none",
        rrmsd=_difference(theirs, target, target),
        rrmsd_ours=ours.rrmsd,
        difference=difference,
        noise=noise,
        over_noise=over_noise,
        limit=limit,
        agrees=all(check.passed for check in checks),
        on_target=on_target,
        on_target_ours=on_target_ours,
        heights_off=traced.error.height,
        slopes_off=traced.error.slope,
        moved_by=traced.error.shift(lens, raster) * max(raster.per_unit),
        seconds=seconds,
    )
    return Compared(outcome, checks, target, ours.picture, theirs=theirs)


def _known(given: str | OwnJudge) -> tuple[Any, str, str]:
    """(functions, name, version) of a judge."""
    if isinstance(given, str):
        return importlib.import_module(JUDGES[given]), given, importlib.metadata.version(given)
    return given, given.name, given.version


def _difference(one: np.ndarray, other: np.ndarray, target: np.ndarray) -> float:
    """RMS difference of two pictures of the target's sum, as a part of the target."""
    return float(np.linalg.norm(one - other) / np.linalg.norm(target))


def _effective_pixels(noise: np.ndarray) -> float:
    """Number of pixels that carry the noise: all if it is normal and uniform, few if a few are lit."""
    second, fourth = float((noise**2).sum()), float((noise**4).sum())
    return min(3 * second**2 / fourth, noise.size) if fourth > 0 else float(noise.size)


def _scaled(picture: np.ndarray, total: float) -> np.ndarray:
    """The picture with that sum; NaN, which no check passes, of a dark picture."""
    return picture * (total / float(picture.sum())) if picture.sum() > 0 else np.full_like(picture, math.nan)


def coarse(screen: Screen) -> Screen:
    """The same screen with square pixels, at most PIXELS and no more than it has along its longer side.

    Of the numbers of pixels from half of that on the one nearest to squares; of several the largest.
    """
    width, height = screen.x[1] - screen.x[0], screen.y[1] - screen.y[0]
    share = min(width, height) / max(width, height)
    most = min(PIXELS, screen.columns if width >= height else screen.rows)

    def few(many: int) -> int:
        return max(1, round(many * share))

    many = min(range(most, most // 2, -1), key=lambda many: round(abs(many * share / few(many) - 1), 9))
    return replace(screen, pixels=(many, few(many)) if width >= height else (few(many), many))


def resampled(picture: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """A picture on (rows, columns) other pixels of the same rectangle, with the flux that falls into each."""
    down, across = (overlap(n, k) * (n / k) for n, k in zip(picture.shape, shape, strict=True))
    return down @ (across @ picture.T).T
