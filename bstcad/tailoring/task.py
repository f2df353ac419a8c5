"""What the stages of tailoring share: the task, and the log of how it went."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from bstcad.optics.irradiance import Screen, rrmsd
from bstcad.optics.lens import Lens
from bstcad.optics.simulation import simulate
from bstcad.optics.sources import Source
from bstcad.quality import Tailoring

Progress = Callable[[str, int, int, str], None]  # stage, done, total, text


@dataclass(frozen=True)
class Stage:
    """How one stage went."""

    name: str
    seconds: float
    rrmsd: float | None  # by the tent, after it


@dataclass
class Log:
    """The clock of a design: what took how long, and how the RRMSD fell."""

    progress: Progress
    began: float = field(default_factory=time.perf_counter)
    stages: list[Stage] = field(default_factory=list)
    history: list[tuple[float, float]] = field(default_factory=list)  # (seconds since the start, RRMSD by the tent)
    skipped: int = 0  # steps left out because their gradient was not finite

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.perf_counter() - self.began

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
        """RRMSD by the tent, with as many rays as stage 2 uses, but others."""
        found = simulate(self.source, lens, self.screen, self.knobs.rays, self.knobs.seed + 1).tent
        return float(rrmsd(found, torch.from_numpy(self.target).to(found)))
