"""What the stages of tailoring share: the task, and the log of how it went."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from bstcad.optics.irradiance import Screen, rrmsd
from bstcad.optics.lens import Lens
from bstcad.optics.sources import Source
from bstcad.optics.tubes import picture
from bstcad.quality import Tailoring

JUDGE = 4 / 3  # tubes a side with which a lens is judged, as a share of the rays that tailor it

Progress = Callable[[str, int, int, str], None]  # stage, done, total, text


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
    deadline: float = math.inf  # seconds since the start at which tailoring ends with the best so far
    stopped: str = ""  # what ended tailoring: "evaluations", "plateau", "accuracy" or "time"

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.perf_counter() - self.began

    @property
    def time_is_up(self) -> bool:
        """Is the deadline past?"""
        return self.seconds > self.deadline

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

    source: Source
    screen: Screen
    target: np.ndarray  # (pixels, pixels), row 0 = y max, sum 1
    knobs: Tailoring  # every one set
    log: Log

    def rrmsd(self, lens: Lens) -> float:
        """RRMSD by more tubes than tailoring uses, and other ones."""
        found = picture(self.source, lens, self.screen, round(JUDGE * self.knobs.rays) + 1)
        return float(rrmsd(found, torch.from_numpy(self.target).to(found)))
