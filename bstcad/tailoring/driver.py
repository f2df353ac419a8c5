"""The driver of a design goes through the steps of its stages; clock, checkpoints, progress and stopping are its own.

The stages say what they have come to (`run.Step`) and know nothing of time; the driver notes it, has it saved, and
does not ask for the next step once there is a reason to end.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from bstcad.tailoring.run import Progress, Step, Task, silent

MEMORY = 4.0  # seconds of work after which a pace measured before is forgotten


def never() -> bool:
    """No one asks tailoring to end."""
    return False


def forget(state: Any) -> None:
    """States are not saved anywhere."""


@dataclass(frozen=True)
class Stage:
    """How one stage went."""

    name: str
    seconds: float
    rrmsd: float | None  # after it
    cpu_seconds: float | None = None  # of all processors; None: nobody counted


@dataclass(frozen=True)
class Record:
    """How a design has gone so far."""

    stages: tuple[Stage, ...] = ()
    history: tuple[tuple[float, float], ...] = ()  # (seconds since the start, RRMSD)
    skipped: int = 0  # steps left out because their gradient was not finite
    seconds: float = 0.0  # since the start, of all runs together
    cpu_seconds: float = 0.0  # of all processors, since a driver was made, of all runs together


class Driver:
    """Of one design.

    limit: seconds since the start at which all shall be done, what comes after tailoring too, which takes `reserve`
    seconds on a machine of pace 1.  interrupted: has the user asked for the best so far?  save: called with each
    state that the design could go on from.  record: of the runs that this one goes on from.
    """

    def __init__(
        self,
        progress: Progress = silent,
        began: float | None = None,
        *,
        limit: float = math.inf,
        reserve: float = 0.0,
        interrupted: Callable[[], bool] = never,
        save: Callable[[Any], None] = forget,
        record: Record = Record(),
        clock: Callable[[], float] = time.perf_counter,
        processor: Callable[[], float] = time.process_time,
    ) -> None:
        self.progress, self.interrupted, self.save = progress, interrupted, save
        self.pace = 1.0  # how many times longer work takes here than on a machine of pace 1, as measured of late
        self.stopped = ""  # what ended tailoring: "evaluations", "plateau", "accuracy", "time" or "interrupt"
        self._limit, self._reserve, self._clock, self._before = limit, reserve, clock, record
        self._began = clock() if began is None else began
        self._step = 0.0  # seconds that the last evaluation took; the next one will take as long
        self._last = clock()  # end of the last step
        self._processor, self._spent = processor, processor()
        self._record = record

    @property
    def record(self) -> Record:
        """How it has gone so far."""
        seconds, cpu = self._clock() - self._began, self._processor() - self._spent
        return replace(self._record, seconds=self._before.seconds + seconds, cpu_seconds=self._before.cpu_seconds + cpu)

    @property
    def hurry(self) -> str:
        """Why tailoring has to end with the best so far: "interrupt", "time" (the rest is needed afterwards) or ""."""
        late = self.record.seconds + self._step > self._limit - self.pace * self._reserve
        return self.wish or ("time" if late else "")

    @property
    def wish(self) -> str:
        """The same for what runs whole however long it takes: "interrupt" or ""."""
        return "interrupt" if self.interrupted() else ""

    def run(self, steps: Iterator[Step], task: Task, saved: Callable[[Any], Any], why: Callable[[], str]) -> Step:
        """Go through a stage until it ends or `why` says why it has to; its last step.

        saved: the state to save, from that of a step.
        """
        self._last = self._clock()
        for step in steps:
            self.stopped = self._take(step, saved) or (step.make and why()) or ""
            if self.stopped:
                break
        if self.stopped and step.part and not step.ends:
            self.end(step.part, task.rrmsd(step.lens) if step.judged is None else step.judged)
        self.stopped = self.stopped or "evaluations"
        return step

    def _take(self, step: Step, saved: Callable[[Any], Any]) -> str:
        """Note a step; why the stage ends with it, if it does."""
        now = self._clock()
        if step.work:
            self.measure(now - self._last, step.work)
        if step.rrmsd is not None:
            self._step = now - self._last
        self._last = now
        if step.progress:
            self.progress(*step.progress)
        self._record = replace(self._record, skipped=self._record.skipped + step.skipped)
        if step.rrmsd is not None:
            self.note(step.rrmsd)
        if step.ends:
            self.end(step.part, step.judged)
        if step.state is not None:
            self.save(saved(step.state))
        return step.reason

    def measure(self, seconds: float, expected: float) -> None:
        """Work was done in so many seconds that takes the expected ones on a machine of pace 1.

        A busy machine changes its pace: each piece of work counts as much as all before it that took as long.
        """
        share = min(1.0, seconds / MEMORY)
        self.pace += share * (seconds / expected - self.pace)

    def note(self, value: float) -> None:
        """One point of the history."""
        record = self.record
        self._record = replace(record, history=(*record.history, (record.seconds, value)))

    def aside(self, name: str, value: float) -> None:
        """Record a part that judged another lens: its value stays out of the history."""
        history = self._record.history
        self.end(name, value)
        self._record = replace(self._record, history=history)

    def end(self, name: str, value: float | None = None) -> None:
        """A part of the design ends; its time runs from the end of the one before."""
        record = self.record
        spent = sum(stage.seconds for stage in record.stages)
        cpu = None  # of the first part: most of it was over when this driver was made
        if record.stages:
            cpu = record.cpu_seconds - sum(stage.cpu_seconds or 0.0 for stage in record.stages)
        self._record = replace(record, stages=(*record.stages, Stage(name, record.seconds - spent, value, cpu)))
        if value is not None:
            self.note(value)
