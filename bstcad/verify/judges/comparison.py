"""Comparison of bstcad's picture of a lens with pictures by independent programs, called judges.

A judge traces the lens of a STEP file and returns a picture in two halves.  It is compared with bstcad's picture of the
same light, which has several times as many rays, on pixels coarse enough for the noise of the judge's rays.

The module of a judge has three functions.  `cannot(lens, channels)` returns why the judge cannot trace this light, in a
sentence, or "".  `light(lens, channels)` returns the channels with the losses that the judge simulates.  `trace(lens,
channels, screen, rays, seed)` returns the picture on a screen of nearly square pixels as faces.Traced.
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

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen, overlap
from bstcad.optics.trace.measure import Effort, measure
from bstcad.scene.errors import MachineError, SceneError, nearest
from bstcad.verify.verdict import Check

JUDGES = {"batoid": "bstcad.verify.judges.batoid", "mitsuba": "bstcad.verify.judges.mitsuba"}
MAX_COMPARED_PIXELS = 128  # largest number of pixels along the longer side of the compared pictures
OWN_SEED_OFFSET = 500_009  # difference between the seeds of bstcad's and the judge's rays
AGREEMENT_FACTOR = 1.5  # limit of the pictures' difference / its noise for many pixels; for N: 1 + 3 / sqrt(N) times it
MIN_NOISE = 1e-9  # lower bound of the noise, relative to the target's RMS
FLUX_TOLERANCE = 0.005  # largest difference of the two programs' fluxes on the target, as a fraction of the source's


@dataclass(frozen=True)
class JudgeEffort:
    """Effort of a comparison with another program."""

    rays: int = 1 << 24  # total number of rays that a judge traces for one target
    own: Effort = Effort(accuracy=0.0, witness=False, cells=1)  # bstcad's picture: all rays, none by flux tubes


@dataclass(frozen=True)
class Judge:
    """Comparison of another program, the judge, with bstcad; differences are relative to the target's RMS."""

    name: str  # name of the program
    version: str  # version of the program
    declined: str = ""  # reason why the judge cannot trace this light; "" if it can
    target: str = ""  # key of the target, if there are several: target[0], target[1], …
    by: str | None = None  # variant of the program, "" if it has only one; None here and below: the judge declined
    rays: int | None = None  # total number of rays
    pixels: tuple[int, int] | None = None  # number of columns and rows
    losses: str | None = None  # losses of light in both pictures: "none" or "Fresnel"
    rrmsd: float | None = None  # RRMSD between the judge's picture and the target
    rrmsd_ours: float | None = None  # RRMSD between bstcad's picture, with the same pixels, and the target
    difference: float | None = None  # RMS difference of the two pictures
    noise: float | None = None  # RMS noise of the difference, from the rays of both programs
    over_noise: float | None = None  # ratio of difference to noise: about 1 if both programs are right
    limit: float | None = None  # limit of over_noise
    agrees: bool | None = None  # True if all checks of the judge pass
    on_target: float | None = None  # fraction of the source's light on the target, as traced by the judge
    on_target_ours: float | None = None  # fraction of the source's light on the target, from bstcad's ledger
    heights_off: float | None = None  # RMS error of the judge's faces (mm)
    slopes_off: float | None = None  # RMS error of the slopes of the judge's faces (rad)
    moved_by: float | None = None  # shift of light due to the slope error (pixels)
    seconds: float | None = None  # time of the judge (s)

    @property
    def figure(self) -> str:
        """Name of the judge's pictures: judge_batoid, and judge_batoid_2 for the second target."""
        number = int(re.sub(r"\D", "", self.target) or 0) + 1
        return f"judge_{self.name}" if number == 1 else f"judge_{self.name}_{number}"


@dataclass(frozen=True, eq=False)
class Comparison:
    """A judge's outcome with checks and pictures (rows, columns) of equal sum, or only its reason for declining."""

    judge: Judge
    checks: tuple[Check, ...] = ()
    target: np.ndarray | None = field(default=None, repr=False)
    ours: np.ndarray | None = field(default=None, repr=False)  # picture by bstcad
    theirs: np.ndarray | None = field(default=None, repr=False)  # picture by the judge


class OwnJudge(Protocol):
    """A judge given by a script: the functions of a judge's module, a name and a version."""

    name: str
    version: str

    def cannot(self, lens: Lens, channels: Sequence[Channel]) -> str:
        """Return the reason, a sentence, why the judge cannot trace this light; "" if it can."""

    def light(self, lens: Lens, channels: Sequence[Channel]) -> Sequence[Channel]:
        """Return the channels with the losses that the judge simulates."""

    def trace(self, lens: Lens, channels: Sequence[Channel], screen: Screen, rays: int, seed: int) -> Any:
        """Trace `rays` rays and return the picture on a screen of nearly square pixels, as faces.Traced."""


def choose_judges(names: Sequence[str | OwnJudge]) -> tuple[str | OwnJudge, ...]:
    """Return the judges, each once; SceneError for an unknown name, MachineError for a program not installed."""
    for name in names:
        if not isinstance(name, str):
            continue
        if name not in JUDGES:
            choices = nearest(name, list(JUDGES), "choose one of")
            raise SceneError(f"--against: {name!r} is not a known program; {choices}")
        if importlib.util.find_spec(name) is None:
            raise MachineError(f"--against {name}: {name} is not installed; run pip install 'bstcad[judges]'")
    return tuple(dict.fromkeys(names))


def run_judges(
    judges: Sequence[str | OwnJudge],
    lens: Lens,
    channels: Sequence[Channel],
    goal: Goal,
    seed: int,
    progress: Callable[[str, int, int, str], None],
    effort: JudgeEffort = JudgeEffort(),
) -> tuple[Comparison, ...]:
    """Compare the picture of each judge with bstcad's, one after the other."""
    compared = []
    for number, judge in enumerate(judges):
        name = judge if isinstance(judge, str) else judge.name
        progress("judges", number, len(judges), f"{name} {goal.key}" if goal.suffix else name)
        compared.append(compare(judge, lens, channels, goal, effort=effort, seed=seed))
    if judges:
        progress("judges", len(judges), len(judges), "")
    return tuple(compared)


def compare(
    judge: str | OwnJudge, lens: Lens, channels: Sequence[Channel], goal: Goal, *,
    effort: JudgeEffort = JudgeEffort(), seed: int = 0,
) -> Comparison:  # fmt: skip
    """Compare a judge's picture of the light on a target with bstcad's."""
    began = time.perf_counter()
    (functions, name, version), key = _judge_functions(judge), goal.key if goal.suffix else ""
    declined = functions.cannot(lens, channels)
    if isinstance(judge, str) and goal.screen.receiver.frame is None:
        declined = "it collects light only on planes"
    if declined:
        return Comparison(Judge(name, version, declined, target=key))
    raster = coarse_screen(goal.screen)
    target, light = resample(goal.picture, raster.shape), functions.light(lens, channels)
    traced = functions.trace(lens, light, raster, rays=effort.rays, seed=seed)
    seconds = time.perf_counter() - began
    ours = measure(lens, light, raster, target, effort=replace(effort.own, seed=seed + OWN_SEED_OFFSET))
    total = float(target.sum())
    theirs, first, second = (_scale_to(picture, total) for picture in (traced.picture, *traced.halves))
    difference = _difference(theirs, ours.picture, target)
    noise = math.hypot(_difference(first, second, target) / 2, ours.picture_error)
    limit = AGREEMENT_FACTOR * (1 + 3 / math.sqrt(_effective_pixels(first - second)))
    over_noise = difference / max(noise, MIN_NOISE)
    on_target, on_target_ours = float(traced.picture.sum()), ours.flux.get("on target", 0.0)
    irradiance = f"irradiance by {name}: difference from bstcad's, relative to the noise{goal.suffix}"
    flux = f"light on the target by {name}: difference from bstcad's, as a fraction of the source's light{goal.suffix}"
    checks = (
        Check.at_most(irradiance, over_noise, limit, id="judge-irradiance"),
        Check.at_most(flux, abs(on_target - on_target_ours), FLUX_TOLERANCE, id="judge-flux"),
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
    return Comparison(outcome, checks, target, ours.picture, theirs=theirs)


def _judge_functions(judge: str | OwnJudge) -> tuple[Any, str, str]:
    """Return the object that has a judge's functions, the judge's name and its version."""
    if isinstance(judge, str):
        return importlib.import_module(JUDGES[judge]), judge, importlib.metadata.version(judge)
    return judge, judge.name, judge.version


def _difference(one: np.ndarray, other: np.ndarray, target: np.ndarray) -> float:
    """Return the RMS difference of two pictures, each with the sum of the target, relative to the target's RMS."""
    return float(np.linalg.norm(one - other) / np.linalg.norm(target))


def _effective_pixels(noise: np.ndarray) -> float:
    """Return the effective number of noisy pixels: all if the noise is normal and uniform, few if few have noise."""
    second, fourth = float((noise**2).sum()), float((noise**4).sum())
    return min(3 * second**2 / fourth, noise.size) if fourth > 0 else float(noise.size)


def _scale_to(picture: np.ndarray, total: float) -> np.ndarray:
    """Scale a picture to a sum; a dark picture becomes NaN, which passes no check."""
    return picture * (total / float(picture.sum())) if picture.sum() > 0 else np.full_like(picture, math.nan)


def coarse_screen(screen: Screen) -> Screen:
    """Return the screen with other, nearly square pixels.

    The longer side has at most N pixels, N = MAX_COMPARED_PIXELS or its present number if that is smaller, and more
    than N / 2.  Of these numbers the one with the most nearly square pixels is chosen; of equals, the largest.
    """
    width, height = screen.x[1] - screen.x[0], screen.y[1] - screen.y[0]
    ratio = min(width, height) / max(width, height)
    most = min(MAX_COMPARED_PIXELS, screen.columns if width >= height else screen.rows)

    def shorter(longer: int) -> int:
        return max(1, round(longer * ratio))

    longer = min(range(most, most // 2, -1), key=lambda n: round(abs(n * ratio / shorter(n) - 1), 9))
    return replace(screen, pixels=(longer, shorter(longer)) if width >= height else (shorter(longer), longer))


def resample(picture: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the flux of a picture in another number of pixels (rows, columns) of the same rectangle."""
    down, across = (overlap(n, k) * (n / k) for n, k in zip(picture.shape, shape, strict=True))
    return down @ (across @ picture.T).T
