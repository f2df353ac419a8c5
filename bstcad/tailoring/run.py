"""The task of tailoring, the steps of its stages, and the driver that goes through them.

The stages yield steps (`Step`) and know nothing of time; the driver notes it, has states saved, reports progress, and
does not ask for the next step once there is a reason to end.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from bstcad.optics.channels import Channel
from bstcad.optics.goal import Goal
from bstcad.optics.lens import Lens
from bstcad.optics.measure import Effort, measure, rrmsd_by_rays
from bstcad.optics.sides import Sides
from bstcad.optics.unfolding import imaged
from bstcad.optics.wavefront import Wave
from bstcad.scene.blank import Bounds
from bstcad.scene.quality import Tailoring
from bstcad.tailoring.merit import Merit
from bstcad.tailoring.source_image import Spread
from bstcad.transport.mapping import Mapping


@dataclass(frozen=True)
class NetParameters:
    """The plane and the heights of one freeform interface."""

    z: float  # the plane that its heights are measured from (mm)
    heights: Tensor  # (m, n) mm


@dataclass(frozen=True)
class Parameters:
    """All that tells a lens from the blank that it was tailored from."""

    nets: tuple[NetParameters, ...]  # in the order of Lens.freeform
    front: dict[str, float | Tensor]  # by name, such as curvature (1/mm); none of a plane or of a net
    back: float  # mm, the plane of the back, which is moved though its heights may be given

    @classmethod
    def of(cls, lens: Lens) -> Parameters:
        """The parameters of a lens."""
        front = {} if lens.front.is_net else lens.front.parameters()
        return cls(tuple(NetParameters(net.z, net.heights) for net in lens.nets), front, lens.back.z)

    def applied(self, lens: Lens) -> Lens:
        """The lens with these parameters, on its own device."""
        like = lens.like
        lens = lens.with_front(lens.front.with_parameters(**self.front).to(like.dtype, like.device))
        lens = lens.with_back(lens.back.moved(self.back))
        own = zip(lens.nets, self.nets, strict=True)
        return lens.with_nets(replace(net, z=p.z, heights=p.heights.to(like.device)) for net, p in own)


@dataclass(frozen=True)
class Judged:
    """A lens and its figures by the measure of the whole design: all pixels, all goals, all of the light."""

    rrmsd: float  # RRMSD by `Task.rrmsd`
    figure: float  # root of the merit of all goals (merit.py): the RRMSD itself where no wave is asked for
    lens: Parameters

    def beats(self, other: Judged) -> bool:
        """Is this lens better than another by more than the errors of judging?"""
        return WORSE * self.figure < (math.inf if math.isnan(other.figure) else other.figure)  # NaN: no light arrives


WORSE = 1.05  # ratio of two figures that is no error of judging: BETWEEN knows an RRMSD to some 5 %
BEST = "back to the best lens before"  # the name of a part of a design
WAVE_TUBES = 256  # a side, by which the wavefront of a lens between the stages is judged
EVALUATED = 4.7e6  # tubes a second of pace 1, with the gradient of the merit
JUDGING = 0.5  # seconds that `Task.rrmsd` takes on a machine of pace 1
# Of a lens between the stages, for a target of PIXELS a side: to some 5 %.  A target of p pixels a side takes
# (p / PIXELS)^⅔ times as many rays a side: the error of the product of two pictures of n² stratified rays falls as
# (p / n)³ / p.
BETWEEN, PIXELS = Effort(rays=724, accuracy=0, witness=False), 512
ASKED = Effort(rays=2048, accuracy=0.01, witness=False)  # the same where it ends at an accuracy, or tells bounds' cost
COUNTED = Effort(rays=128, accuracy=1.0, witness=False)  # to tell how much light arrives

Progress = Callable[[str, int, int, str], None]  # stage, done, total, text
MEMORY = 4.0  # seconds of work after which a pace measured before is forgotten


def silent(stage: str, done: int, total: int, text: str) -> None:
    """A progress that says nothing."""


@dataclass(frozen=True)
class Edge:
    """The light at the edge of what can be reached, which must not be reflected."""

    light: Channel  # of the source's middle, at the line with most of the flux
    angle: float  # from the normal (rad), at which it may leave the last face at most


@dataclass(frozen=True)
class Task:
    """Light, goals and knobs of a design."""

    channels: tuple[Channel, ...]  # the light
    goals: tuple[Goal, ...]  # stage 1 of one face follows the first
    knobs: Tailoring  # with every key set
    least: float = 0.0  # thickness of the glass everywhere (mm)
    free: tuple[str, ...] = ()  # the parameters of the front that tailoring searches for
    rim_sags: tuple[float, float] = (-math.inf, math.inf)  # that such a front may have (mm)
    progress: Progress = silent  # told of the progress within a step
    tidy: Callable[[], None] = lambda: None  # called where freed memory has not the sizes that are needed next
    grown: tuple[tuple[Channel, ...], ...] = ()  # points of the source, as it grows to its size; () of a point
    bounds: Bounds | None = None  # on the tailored faces; None: they may have any shape
    spreads: tuple[Spread, ...] = ()  # the same source in each of these sizes, about its middle
    edge: Edge | None = None  # of a target that is cut to what light can reach; None: light can reach all of it
    # of a picture (rows, columns) and the target, both of sum 1 or less, what stage 2 makes least; None: RRMSD²
    merit: Callable[[Tensor, Tensor], Tensor] | None = None
    wave: Wave | None = None  # that the light behind the lens shall be; None: any
    hasty: bool = False  # for a preview: one round a stage, no lens judged, and no way tried that costs much
    solution: float | None = None  # σ of light_behind.py; None: the gentler one
    floor: float = 0.0  # of its mean, to which stage 1 of two faces lifts the furthest picture
    front_sides: Callable[[Sides], Sides | None] = lambda sides: None  # of a tailored front, by those of the back

    @property
    def heaviest(self) -> Channel:
        """The channel with most of the light; stage 1 reckons with it alone."""
        return max(self.channels, key=lambda channel: channel.weight)

    @property
    def several(self) -> bool:
        """Is there another goal than one picture?"""
        return len(self.goals) > 1 or self.wave is not None

    def sides(self, lens: Lens, sides: Sides) -> tuple[Sides, ...]:
        """Control points of each of the lens's nets where a back has so many."""
        front = self.front_sides(sides)
        return tuple(sides if k == lens.number_of("back") or front is None else front for k in lens.freeform)

    @property
    def whole(self) -> Task:
        """The same task with the light of the whole source."""
        return replace(self, channels=self.grown[-1], grown=()) if self.grown else self

    def refined(self, lens: Lens, sides: Sides) -> Lens:
        """The lens with the control points that its nets have where a back has so many."""
        pairs = zip(lens.nets, self.sides(lens, sides), strict=True)
        return lens.with_nets(net.refined(own) for net, own in pairs)

    def aimed(self, lens: Lens) -> Task:
        """The task with its receivers where the last net of a lens sees them, at which stage 1 aims."""
        return replace(self, goals=tuple(replace(goal, receiver=imaged(lens, goal.receiver)) for goal in self.goals))

    def rrmsd(self, lens: Lens, effort: Effort | None = None) -> float:
        """RRMSD by rays on the CPU, without the bias of the tubes that tailor the lens; the largest of several.

        effort: None: ASKED where the design hangs on the figure, else the few rays of BETWEEN.
        """
        if effort is None and (self.knobs.accuracy is not None or self.bounds is not None):
            effort = ASKED
        if effort is None:
            largest = max(goal.picture.size for goal in self.goals)
            effort = replace(BETWEEN, rays=round(BETWEEN.rays * (largest / PIXELS**2) ** (1 / 3)))
        draw = self.spreads[-1].draw if self.spreads and not self.grown else None  # not of its middle alone
        lens = lens.plain()
        values = [
            rrmsd_by_rays(lens, self.channels, goal.receiver, target=goal.picture, effort=effort, draw=draw)
            for goal in self.goals
        ]
        return math.nan if any(map(math.isnan, values)) else max(values)

    def judged(self, lens: Lens, rrmsd: float) -> Judged:
        """The lens, of this RRMSD by `rrmsd`, as the whole design is judged."""
        figure = rrmsd
        if self.wave is not None:
            merit = Merit.of(self.channels, lens, WAVE_TUBES, goals=(), overshoot=0.0, wave=self.wave)
            square, pictures = float(merit(merit.landing(lens))[0]), sum(goal.weight for goal in self.goals)
            figure = math.sqrt((pictures * rrmsd**2 + self.wave.weight * square) / (pictures + self.wave.weight))
        return Judged(rrmsd, figure, Parameters.of(lens))

    def better(self, latest: Lens, before: Lens) -> tuple[Lens, Judged]:
        """Return the better of two lenses, and its figures, by as many rays as tell them apart; if in doubt the latest.

        BETWEEN does not resolve an RRMSD below 0.01 or so: by it a lens of 0.0070 looked better than one of 0.0048.
        """
        now, then = (self.judged(lens, self.rrmsd(lens, ASKED)) for lens in (latest, before))
        return (before, then) if then.beats(now) else (latest, now)

    def used(self, lens: Lens) -> float:
        """Part of the light that enters the lens which falls on the first target."""
        goal = self.goals[0]
        return measure(lens.plain(), self.channels, goal.receiver, target=goal.picture, effort=COUNTED).used


@dataclass(frozen=True)
class Step:
    """The state of a stage; the driver decides whether it goes on."""

    make: Callable[[], Lens] | None  # the best lens so far, in the form to go on with; None: there is none yet
    state: Any = None  # the stage goes on from here with this alone; None: it cannot be left here
    mapping: Mapping | None = None  # stage 1: the transport map that the lens follows
    # places (mm) on the last tailored face for each corner of the target's pixels, x and y, (columns + 1, rows + 1);
    # None: the map of `mapping` begins elsewhere
    places: tuple[np.ndarray, np.ndarray] | None = None
    progress: tuple[str, int, int, str] | None = None  # stage, done, total, text
    rrmsd: float | None = None  # of the lens, by the rays that tailor it
    judged: float | None = None  # of the lens, by `Task.rrmsd`
    whole: bool = True  # is it judged by all of the light, and not by that of a smaller source?
    work: float = 0.0  # seconds that the step takes on a machine of pace 1; 0: nobody knows
    skipped: bool = False  # was the step left out, because its gradient was not finite?
    part: str = ""  # which part of the design is under way, for the list of its times; "": none has begun
    ends: bool = False  # the part, with this step
    reason: str = ""  # why the stage ends with this step, if it does: "evaluations", "plateau" or "accuracy"

    @property
    def lens(self) -> Lens:
        """The best lens so far."""
        return self.make()


def never() -> bool:
    """No one asks tailoring to end."""
    return False


def forget(state: Any) -> None:
    """States are not saved anywhere."""


Look = Callable[[Callable[[], Lens]], None]  # called with the function that makes the best lens so far


def unseen(make: Callable[[], Lens]) -> None:
    """Nobody looks at the lens while it is tailored."""


@dataclass(frozen=True)
class Stage:
    """Time and RRMSD of one stage."""

    name: str
    seconds: float
    rrmsd: float | None  # after it
    cpu_seconds: float | None = None  # of all processors; None: nobody counted


@dataclass(frozen=True)
class Record:
    """Stages and history of a design so far."""

    stages: tuple[Stage, ...] = ()
    history: tuple[tuple[float, float], ...] = ()  # (seconds since the start, RRMSD)
    skipped: int = 0  # steps left out because their gradient was not finite
    seconds: float = 0.0  # since the start, of all runs together
    cpu_seconds: float = 0.0  # of all processors, since a driver was made, of all runs together


class Driver:
    """The driver of one design.

    limit: seconds from the start to the end of the whole run, including the work after tailoring, which takes `reserve`
    seconds on a machine of pace 1.  interrupted: has the user asked for the best lens so far?  save: called with each
    state from which the design could resume.  look: called as soon as the lens has come to an RRMSD.  record: of the
    earlier runs that this one resumes.
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
        look: Look = unseen,
        record: Record = Record(),
        clock: Callable[[], float] = time.perf_counter,
        processor: Callable[[], float] = time.process_time,
    ) -> None:
        self.progress, self.interrupted, self.save, self.look = progress, interrupted, save, look
        self.pace = 1.0  # how many times longer work takes here than on a machine of pace 1, as measured of late
        self.stopped = ""  # what ended tailoring: "evaluations", "plateau", "accuracy", "time" or "interrupt"
        self._limit, self._reserve, self._clock, self._before = limit, reserve, clock, record
        self._began = clock() if began is None else began
        self._step = 0.0  # seconds that the last evaluation took; the next one will take as long
        self._last = clock()  # end of the last step
        self._processor, self._spent = processor, processor()
        self.best: Judged | None = None  # best lens at the ends of the parts of the stage under way
        self._record = record

    @property
    def record(self) -> Record:
        """Stages and history so far."""
        seconds, cpu = self._clock() - self._began, self._processor() - self._spent
        return replace(self._record, seconds=self._before.seconds + seconds, cpu_seconds=self._before.cpu_seconds + cpu)

    @property
    def hurry(self) -> str:
        """Why tailoring has to end with the best so far: "interrupt", "time" (the rest is needed afterwards) or ""."""
        late = self.record.seconds + self._step > self._limit - self.pace * self._reserve
        return self.wish or ("time" if late else "")

    @property
    def wish(self) -> str:
        """The same for a stage that runs whole, however long it takes: "interrupt" or ""."""
        return "interrupt" if self.interrupted() else ""

    def run(
        self, steps: Iterator[Step], task: Task, saved: Callable[[Any], Any], why: Callable[[], str],
        best: Judged | None = None,
    ) -> Step:  # fmt: skip
        """Go through a stage until it ends or `why` says why it has to; its last step.

        saved: the state to save, from that of a step.  best: the best lens before; afterwards `self.best` is the best
        at the ends of all parts.  A part sees fewer pixels or less light, and may end with a lens that is worse.
        """
        self._last, self.best = self._clock(), best
        for step in steps:
            self.stopped = self._take(step, saved) or (step.make and why()) or ""
            if step.ends:
                self._compare(step, task)
            if self.stopped:
                break
        if self.stopped and step.part and not step.ends:
            step = replace(step, judged=task.rrmsd(step.lens) if step.judged is None else step.judged)
            self.end(step.part, step.judged)
            self._compare(step, task)
        self.stopped = self.stopped or "evaluations"
        return step

    def _compare(self, step: Step, task: Task) -> None:
        """Note the lens of a step if it is the best so far."""
        if step.judged is not None and step.whole:
            latest = task.judged(step.lens, step.judged)
            if self.best is None or math.isnan(self.best.figure) or latest.figure < self.best.figure:
                self.best = latest

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
        if step.make and (step.rrmsd is not None or step.judged is not None):
            self.look(step.make)
        if step.ends:
            self.end(step.part, step.judged)
        if step.state is not None:
            self.save(saved(step.state))
        return step.reason

    def measure(self, seconds: float, expected: float) -> None:
        """Update the pace by work that took `seconds` here and would take `expected` seconds on a machine of pace 1.

        A busy machine changes its pace: a piece of work weighs seconds / MEMORY against all work before it.
        """
        share = min(1.0, seconds / MEMORY)
        self.pace += share * (seconds / expected - self.pace)

    def note(self, value: float) -> None:
        """One point of the history."""
        record = self.record
        self._record = replace(record, history=(*record.history, (record.seconds, value)))

    def end(self, name: str, value: float | None = None) -> None:
        """End a part of the design; its time runs from the end of the part before."""
        record = self.record
        spent = sum(stage.seconds for stage in record.stages)
        cpu = None  # of the first part: most of it was over when this driver was made
        if record.stages:
            cpu = record.cpu_seconds - sum(stage.cpu_seconds or 0.0 for stage in record.stages)
        self._record = replace(record, stages=(*record.stages, Stage(name, record.seconds - spent, value, cpu)))
        if value is not None:
            self.note(value)
