"""What the stages of tailoring share: the task, and the steps that they go in."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bstcad.optics.channels import Channel, places
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.measure import Effort, measure, rrmsd_by_rays
from bstcad.scene.blank import Bounds
from bstcad.scene.quality import Tailoring
from bstcad.transport.mapping import Mapping

EVALUATED = 4.7e6  # tubes a second of pace 1, with the gradient of the merit
JUDGING = 0.5  # seconds that `Task.rrmsd` takes on a machine of pace 1
# Of a lens between the stages, for a target of PIXELS a side: to some 5 %.  A target of p pixels a side takes
# (p / PIXELS)^⅔ times as many rays a side: the error of the product of two pictures of n² stratified rays falls as
# (p / n)³ / p.
BETWEEN, PIXELS = Effort(rays=724, accuracy=0, witness=False), 512
ASKED = Effort(rays=2048, accuracy=0.01, witness=False)  # the same where it ends at an accuracy, or tells bounds' cost
COUNTED = Effort(rays=128, accuracy=1.0, witness=False)  # to tell how much light arrives

Progress = Callable[[str, int, int, str], None]  # stage, done, total, text


def silent(stage: str, done: int, total: int, text: str) -> None:
    """A progress that says nothing."""


@dataclass(frozen=True)
class Task:
    """What is to be done, with what, and how much work may go into it."""

    channels: tuple[Channel, ...]  # the light
    screen: Screen
    target: np.ndarray  # (rows, columns), row 0 = y max, sum 1
    knobs: Tailoring  # every one set
    least: float = 0.0  # thickness of the glass everywhere (mm)
    free: tuple[str, ...] = ()  # the parameters of the front that are to be found
    rim_sags: tuple[float, float] = (-math.inf, math.inf)  # that such a front may have (mm)
    progress: Progress = silent  # hears of what goes on within a step
    grown: tuple[tuple[Channel, ...], ...] = ()  # points of the source, as it grows to its size; () of a point
    bounds: Bounds | None = None  # on the back; None: it may have any shape

    @property
    def heaviest(self) -> Channel:
        """The channel with most of the light; stage 1 reckons with it alone."""
        return max(self.channels, key=lambda channel: channel.weight)

    @property
    def whole(self) -> Task:
        """The same with the light of the whole source."""
        return replace(self, channels=self.grown[-1], grown=()) if self.grown else self

    @property
    def tubes(self) -> int:
        """Along a side of the sheet of each channel: as many in all as for a point, but two a control cell at least.

        (In all of the cell: with many coarse sheets a lens is better than with half as many fine ones.)
        """
        points = max(places(self.channels)) + 1
        if points == 1:
            return self.knobs.rays
        return max(round(self.knobs.rays / points**0.5), math.ceil(2**0.5 * self.knobs.levels[-1]))

    def rrmsd(self, lens: Lens) -> float:
        """RRMSD by rays on the CPU, without the bias of the tubes that tailor the lens."""
        effort = ASKED
        if self.knobs.accuracy is None and self.bounds is None:
            effort = replace(BETWEEN, rays=round(BETWEEN.rays * (self.target.size / PIXELS**2) ** (1 / 3)))
        return rrmsd_by_rays(lens.plain(), self.channels, self.screen, self.target, effort)

    def used(self, lens: Lens) -> float:
        """Part of the light that enters the lens which falls on the target."""
        return measure(lens.plain(), self.channels, self.screen, self.target, COUNTED).used


@dataclass(frozen=True)
class Step:
    """What a stage has come to; the driver (driver.py) decides whether it goes on."""

    make: Callable[[], Lens] | None  # the best lens so far, in the form to go on with; None: there is none yet
    state: Any = None  # the stage goes on from here with this alone; None: it cannot be left here
    mapping: Mapping | None = None  # stage 1: the transport map that the lens follows
    # of a map from the back: the places there (mm) for each corner of the target's pixels, (columns + 1, rows + 1)
    places: tuple[np.ndarray, np.ndarray] | None = None
    progress: tuple[str, int, int, str] | None = None  # stage, done, total, text
    rrmsd: float | None = None  # of the lens, by the rays that tailor it
    judged: float | None = None  # of the lens, by `Task.rrmsd`
    work: float = 0.0  # seconds that the step takes on a machine of pace 1; 0: nobody knows
    skipped: bool = False  # was the step left out, because its gradient was not finite?
    part: str = ""  # which part of the design is under way, for the list of its times; "": none has begun
    ends: bool = False  # the part, with this step
    reason: str = ""  # why the stage ends with this step, if it does: "evaluations", "plateau" or "accuracy"

    @property
    def lens(self) -> Lens:
        """The best lens so far."""
        return self.make()
