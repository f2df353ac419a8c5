"""What the stages of tailoring share: the task, and the log of how it went."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from bstcad.optics.channels import Channel, weighted_sum
from bstcad.optics.irradiance import Screen, rrmsd
from bstcad.optics.lens import Lens
from bstcad.optics.tubes.launching import picture
from bstcad.scene.quality import Tailoring
from bstcad.tailoring.minimise import Keep, forget

JUDGED, EVALUATED = 6.0e6, 4.7e6  # tubes a second of pace 1: traced for a picture; with the gradient of the merit
MEMORY = 4.0  # seconds of work after which a pace measured before is forgotten
JUDGE = 4 / 3  # tubes a side with which a lens is judged, as a share of the rays that tailor it

Progress = Callable[[str, int, int, str], None]  # stage, done, total, text


def judging(rays: int) -> float:
    """Seconds that judging a lens takes on a machine of pace 1, where so many rays a side tailor it."""
    return (JUDGE * rays) ** 2 / JUDGED


def never() -> bool:
    """No one asks tailoring to end."""
    return False


@dataclass(frozen=True)
class Stage:
    """How one stage went."""

    name: str
    seconds: float
    rrmsd: float | None  # after it


@dataclass
class Log:
    """The clock of a design: what took how long, and how the RRMSD fell."""

    progress: Progress
    began: float = field(default_factory=time.perf_counter)
    stages: list[Stage] = field(default_factory=list)
    history: list[tuple[float, float]] = field(default_factory=list)  # (seconds since the start, RRMSD)
    skipped: int = 0  # steps left out because their gradient was not finite
    limit: float = math.inf  # seconds since the start at which all shall be done, what comes after tailoring too
    reserve: float = 0.0  # seconds that what comes after takes on a machine of pace 1
    pace: float = 1.0  # how many times longer work takes here than there, by what this run has measured of late
    step: float = 0.0  # seconds that the last evaluation took; the next one will take as long
    stopped: str = ""  # what ended tailoring: "evaluations", "plateau", "accuracy", "time" or "interrupt"
    interrupted: Callable[[], bool] = never  # has the user asked for the best so far?
    earlier: float = 0.0  # seconds of the runs that this one goes on from
    judged: tuple[Lens, float] | None = None  # the last lens that was, and its RRMSD

    @property
    def seconds(self) -> float:
        """Since the start, those of earlier runs included."""
        return self.earlier + time.perf_counter() - self.began

    @property
    def hurry(self) -> str:
        """Why tailoring has to end with the best so far: "interrupt", "time" (the rest is needed afterwards) or ""."""
        late = self.seconds + self.step > self.limit - self.pace * self.reserve
        return "interrupt" if self.interrupted() else "time" if late else ""

    def traced(self, tubes: int, seconds: float, rate: float) -> None:
        """Work was done: so many ray tubes in so long, and a machine of pace 1 takes `rate` of them a second.

        A busy machine changes its pace: each piece of work counts as much as all before it that took as long.
        """
        found = seconds * rate / tubes
        share = min(1.0, seconds / MEMORY)
        self.pace += share * (found - self.pace)

    def state(self) -> dict[str, Any]:
        """What a run that goes on from here has to know; not changed by what comes later."""
        stages, history = ([list(vars(s).values()) for s in self.stages], list(self.history))
        return {"stages": stages, "history": history, "skipped": self.skipped, "seconds": self.seconds}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from such a state."""
        self.stages, self.history = [Stage(*s) for s in state["stages"]], list(state["history"])
        self.skipped, self.earlier = state["skipped"], state["seconds"]

    def note(self, value: float) -> None:
        """One point of the history."""
        self.history.append((self.seconds, value))

    def end(self, name: str, value: float | None = None) -> None:
        """A stage ends; its time runs from the end of the one before."""
        spent = sum(stage.seconds for stage in self.stages)
        self.stages.append(Stage(name, self.seconds - spent, value))
        if value is not None:
            self.note(value)


@dataclass(frozen=True)
class Task:
    """What is to be done, with what, and how much work may go into it."""

    channels: tuple[Channel, ...]  # the light
    screen: Screen
    target: np.ndarray  # (rows, columns), row 0 = y max, sum 1
    knobs: Tailoring  # every one set
    log: Log
    least: float = 0.0  # thickness of the glass everywhere (mm)
    free: tuple[str, ...] = ()  # the parameters of the front that are to be found
    rim_sags: tuple[float, float] = (-math.inf, math.inf)  # that such a front may have (mm)
    keep: Keep = forget  # called with the state of the stage wherever it could be left and gone on with

    @property
    def heaviest(self) -> Channel:
        """The channel with most of the light; stage 1 reckons with it alone."""
        return max(self.channels, key=lambda channel: channel.weight)

    def rrmsd(self, lens: Lens) -> float:
        """RRMSD by more tubes than tailoring uses, and other ones."""
        if self.log.judged is None or self.log.judged[0] is not lens:
            n, began = round(JUDGE * self.knobs.rays) + 1, time.perf_counter()
            pictures = [picture(channel.source, channel.through(lens), self.screen, n) for channel in self.channels]
            found = weighted_sum(self.channels, pictures)
            self.log.traced(len(pictures) * n * n, time.perf_counter() - began, JUDGED)
            self.log.judged = lens, float(rrmsd(found, torch.from_numpy(self.target).to(found)))
        return self.log.judged[1]
