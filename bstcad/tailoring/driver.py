"""The task of a design, the steps that its stages yield, and the driver that runs the stages.

A stage is an iterator of steps, and does not read the clock.  The driver runs the steps, measures time, saves states,
reports progress, and stops when there is a reason to end.  A machine of pace 2 takes twice the time of one of pace 1.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.wavefront import Wave
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.surfaces.sides import Sides
from bstcad.optics.trace.measure import Effort, measure_goal, rrmsds_by_rays
from bstcad.optics.trace.unfolding import image_screen
from bstcad.tailoring.effort import FULL, TailoringEffort
from bstcad.tailoring.merit import Merit
from bstcad.tailoring.settings import Bounds, Settings
from bstcad.tailoring.source_image import ExtendedSource
from bstcad.transport.mapping import Mapping


@dataclass(frozen=True)
class NetParameters:
    """Reference plane and control-point heights of one freeform interface."""

    z: float  # plane from which the heights are measured (mm)
    heights: Tensor  # control points (m, n), mm above the plane


@dataclass(frozen=True)
class Parameters:
    """Parameters that tailoring changes; together with a blank they determine the lens."""

    nets: tuple[NetParameters, ...]  # freeform interfaces, in the order of Lens.tailored_numbers
    front: dict[str, float | Tensor]  # values by name, such as curvature (1/mm); empty for a plane or a net
    back: float  # z of the plane of the back (mm); tailoring moves it even if the heights are fixed

    @classmethod
    def of(cls, lens: Lens) -> Parameters:
        """Return the parameters of a lens."""
        front = {} if lens.front.is_net else lens.front.parameters()
        return cls(tuple(NetParameters(net.z, net.heights) for net in lens.nets), front, lens.back.z)

    def apply_to(self, lens: Lens) -> Lens:
        """Return `lens` with these parameters, on the device of `lens`."""
        like = lens.like
        lens = lens.with_front(lens.front.with_parameters(**self.front).to(like.dtype, like.device))
        lens = lens.with_back(lens.back.moved(self.back))
        pairs = zip(lens.nets, self.nets, strict=True)
        return lens.with_nets(replace(net, z=p.z, heights=p.heights.to(like.device)) for net, p in pairs)


@dataclass(frozen=True)
class RatedLens:
    """Lens with its figures of merit for all pixels, all goals, and the light of the whole source."""

    rrmsd: float  # RRMSD by `Task.rrmsd`
    figure: float  # square root of the merit (merit.py) with `rrmsd` for each picture; `rrmsd` if there is no wavefront
    lens: Parameters

    def beats(self, other: RatedLens) -> bool:
        """Return True if this lens is better than another by more than the error of the figures."""
        theirs = math.inf if math.isnan(other.figure) else other.figure  # NaN: no light arrives
        return SIGNIFICANT_RATIO * self.figure < theirs


SIGNIFICANT_RATIO = 1.05  # smallest ratio of two figures that is significant: `TailoringEffort.stage` has errors of 5 %
BEST_LENS_STAGE = "back to the best lens before"  # name, in the record of a design, of the return to an earlier lens
TUBES_PER_SECOND = 7e6  # tubes traced per second, with the gradient of the merit, on a machine of pace 1
RRMSD_SECONDS = 0.5  # seconds that `Task.rrmsd` takes on a machine of pace 1
ROUGH_RAYS = 0.5  # rays per side, relative to `TailoringEffort.stage`, for an RRMSD known to some 15 %

Progress = Callable[[str, int, int, str], None]  # called with stage, units done, units in total, text
LensCallback = Callable[[Callable[[], Lens]], None]  # called with a function that returns the best lens so far
PACE_MEMORY = 4.0  # seconds of work over which the pace of the machine is averaged


def no_progress(stage: str, done: int, total: int, text: str) -> None:
    """Report no progress; default of a `Progress`."""


@dataclass(frozen=True)
class Edge:
    """Light at the edge of the reachable part of a target, where it is close to total internal reflection."""

    light: Channel  # channel with the largest flux, for the centre of the source
    angle: float  # largest angle to the normal at which light may leave the last face (rad)


@dataclass(frozen=True)
class Task:
    """Data of a design that its stages use: light, goals, settings and bounds."""

    channels: tuple[Channel, ...]  # light of the source, or of the centre of a source of finite size
    goals: tuple[Goal, ...]  # targets; stage 1 with one freeform face uses only the first
    settings: Settings  # settings of the scene's [tailoring]
    min_thickness: float = 0.0  # minimum thickness of the glass everywhere (mm)
    free: tuple[str, ...] = ()  # names of the parameters of the front that stage 1 optimises
    rim_sags: tuple[float, float] = (-math.inf, math.inf)  # range of the front's sag at the rim (mm)
    progress: Progress = no_progress  # receives the progress within a step
    tidy: Callable[[], None] = lambda: None  # returns freed memory to the system between large allocations
    sampled_sources: tuple[tuple[Channel, ...], ...] = ()  # light of the source at its sizes in stage 3; (): no stage 3
    bounds: Bounds | None = None  # bounds on the shape of the tailored faces; None: no bounds
    extended_sources: tuple[ExtendedSource, ...] = ()  # source at its sizes in stage 3, to blur the picture
    edge: Edge | None = None  # light at the edge of a target cut to its reachable part; None: not cut
    # error of a picture relative to the target in the merit, both (rows, columns) and of sum <= 1; None: RRMSD²
    merit: Callable[[Tensor, Tensor], Tensor] | None = None
    wave: Wave | None = None  # required wavefront behind the lens; None: no wavefront goal
    effort: TailoringEffort = FULL  # effort beside the settings; that of a preview is smaller
    refines: bool = False  # refinement of an earlier lens: only the last round of stage 2 or 3
    solution: float | None = None  # sign σ of light_behind.py, +1 or -1; None: feasibility.py chooses
    floor: float = 0.0  # smallest irradiance, relative to the mean, of the furthest picture in stage 1 of two faces
    # control points per side of the front as a function of those of the back; None: the front is not freeform
    front_sides: Callable[[Sides], Sides | None] = lambda sides: None

    @property
    def heaviest(self) -> Channel:
        """Channel with the largest part of the light, the only one that stage 1 uses."""
        return max(self.channels, key=lambda channel: channel.weight)

    @property
    def several(self) -> bool:
        """True if there is more than one picture, or a wavefront goal."""
        return len(self.goals) > 1 or self.wave is not None

    def sides(self, lens: Lens, sides: Sides) -> tuple[Sides, ...]:
        """Return the control points per side of each net of a lens whose back has `sides`."""
        front = self.front_sides(sides)
        return tuple(sides if k == lens.number_of(BACK) or front is None else front for k in lens.tailored_numbers)

    @property
    def at_full_size(self) -> Task:
        """Task with the sampled light of the whole source instead of the light of its centre."""
        return replace(self, channels=self.sampled_sources[-1], sampled_sources=()) if self.sampled_sources else self

    def refined(self, lens: Lens, sides: Sides) -> Lens:
        """Return the lens with its nets refined: the back to `sides`, a front to `front_sides(sides)`."""
        pairs = zip(lens.nets, self.sides(lens, sides), strict=True)
        return lens.with_nets(net.refined(count) for net, count in pairs)

    def with_imaged_receivers(self, lens: Lens) -> Task:
        """Return the task with its receivers imaged through the surfaces behind the last net, for stage 1."""
        goals = (replace(goal, screen=image_screen(lens, goal.screen)) for goal in self.goals)
        return replace(self, goals=tuple(goals))

    def rrmsd(self, lens: Lens, effort: Effort | None = None) -> float:
        """Return the largest RRMSD over the goals from independent rays, on the CPU; NaN without light on a target.

        The flux tubes used for tailoring would underestimate the RRMSD.  effort: rays to use; None: `flux` of the
        task's effort if it rates no lenses, `fine` for a scene with an accuracy or bounds, else `between_stages`.
        """
        if effort is None and not self.effort.rates_lenses:  # only the light on the target counts
            effort = self.effort.flux
        if effort is None and (self.settings.accuracy is not None or self.bounds is not None):
            effort = self.effort.fine
        effort = effort or self.effort.between_stages(self.goals)
        sources = () if self.sampled_sources else self.extended_sources  # centre alone before stage 3
        sampler = sources[-1].sampler if sources else None  # samples the task's last source
        values = rrmsds_by_rays(lens.plain(), self.channels, self.goals, effort, sampler=sampler)
        return math.nan if any(map(math.isnan, values)) else max(values)

    def rated(self, lens: Lens, rrmsd: float) -> RatedLens:
        """Return the lens with its figure of merit; rrmsd: its RRMSD by `Task.rrmsd`."""
        figure = rrmsd
        if self.wave is not None:
            merit = Merit.of(self.channels, lens, self.effort.wavefront_tubes, goals=(), overshoot=0.0, wave=self.wave)
            square, pictures = float(merit(merit.landing(lens))[0]), sum(goal.weight for goal in self.goals)
            figure = math.sqrt((pictures * rrmsd**2 + self.wave.weight * square) / (pictures + self.wave.weight))
        return RatedLens(rrmsd, figure, Parameters.of(lens))

    def better(self, latest: Lens, before: Lens) -> tuple[Lens, RatedLens]:
        """Return the better of two lenses with its figures by fine rays; `latest` if the difference is insignificant.

        The rays between the stages do not resolve RRMSDs below about 0.01: with it 0.0070 seemed better than 0.0048.
        """
        now, then = (self.rated(lens, self.rrmsd(lens, self.effort.fine)) for lens in (latest, before))
        return (before, then) if then.beats(now) else (latest, now)

    def flux_on_target(self, lens: Lens) -> float:
        """Return the light on the first target as a fraction of the light that meets the lens."""
        return measure_goal(lens.plain(), self.channels, self.goals[0], self.effort.flux, ghost=None, sampler=None).used


@dataclass(frozen=True)
class StageStep:
    """State of a stage after one of its steps; the driver decides whether the stage goes on."""

    # returns the lens of this round or, in stage 2, the best lens of this search; None: no lens yet
    make: Callable[[], Lens] | None
    state: Any = None  # record from which the stage can resume here; None: it cannot
    mapping: Mapping | None = None  # transport map that the lens follows (stage 1)
    # x and y (mm), each (columns + 1, rows + 1), of the points of the last tailored face that light the corners of the
    # target's pixels; None: `mapping` begins on another surface
    face_points: tuple[np.ndarray, np.ndarray] | None = None
    progress: tuple[str, int, int, str] | None = None  # arguments of `Progress`; None: nothing to report
    rrmsd: float | None = None  # RRMSD of the lens by the flux tubes or rays used for tailoring
    rays_rrmsd: float | None = None  # RRMSD of the lens by `Task.rrmsd`
    at_full_size: bool = True  # True if `rays_rrmsd` is for the source at full size, False for a smaller source
    work: float = 0.0  # seconds that the step takes on a machine of pace 1; 0: unknown
    skipped: bool = False  # True if the step was left out because merit or gradient was not finite
    part: str = ""  # name of the current part of the design, for the list of times; "": no part has begun
    ends: bool = False  # True if the part ends with this step
    reason: str = ""  # reason to end the stage here: "evaluations", "plateau" or "accuracy"; "": none

    @property
    def lens(self) -> Lens:
        """Lens that `make` returns."""
        assert self.make is not None, "the stage has made no lens yet"
        return self.make()


Steps = Iterator[StageStep]
Stage = Callable[[Task, Lens, Any], Steps]  # called with task, lens, and a state to resume from or None


def maker(lens: Lens) -> Callable[[], Lens]:
    """Return a function without arguments that returns `lens`, for `StageStep.make`."""
    return lambda: lens


@dataclass(frozen=True)
class Hooks:
    """Functions that a design calls while it runs; by default they do nothing."""

    progress: Progress = no_progress  # reports progress
    save: Callable[[Any], None] = lambda state: None  # called with each state from which the design can resume
    interrupted: Callable[[], bool] = lambda: False  # returns True once the user wants the best lens so far
    on_lens: LensCallback = lambda make: None  # called after each step that has an RRMSD


NO_HOOKS = Hooks()


@dataclass(frozen=True)
class StageTime:
    """Time and RRMSD of one stage, or of one part of it."""

    name: str
    seconds: float  # wall-clock time (s)
    rrmsd: float | None  # RRMSD of the lens at the end of the stage; None: not measured
    cpu_seconds: float | None = None  # CPU time, summed over processors (s); None: not measured


@dataclass(frozen=True)
class DesignRecord:
    """Record of a design so far: times of its stages and convergence history."""

    stages: tuple[StageTime, ...] = ()
    history: tuple[tuple[float, float], ...] = ()  # (seconds since the start, RRMSD)
    skipped: int = 0  # number of steps left out because merit or gradient was not finite
    seconds: float = 0.0  # wall-clock time since the start, summed over all runs of a resumed design (s)
    cpu_seconds: float = 0.0  # CPU time since a driver was made, summed over processors and runs (s)


class Driver:
    """Driver of the stages of one design: keeps the time, the record and the best lens.

    limit: seconds for all runs of the design, including the work after tailoring, which takes `reserve` seconds on a
    machine of pace 1.  began: start of this run by `clock`; None: now.  record: earlier runs of a resumed design.
    """

    def __init__(
        self, hooks: Hooks = NO_HOOKS, began: float | None = None, *, limit: float = math.inf, reserve: float = 0.0,
        record: DesignRecord = DesignRecord(), clock: Callable[[], float] = time.perf_counter,
        processor: Callable[[], float] = time.process_time,
    ) -> None:  # fmt: skip
        self.hooks = hooks
        self.pace = 1.0  # recent time per work on this machine, relative to the reference machine of pace 1
        self.stopped = ""  # reason why tailoring ended: "evaluations", "plateau", "accuracy", "time" or "interrupt"
        self._limit, self._reserve, self._clock, self._before = limit, reserve, clock, record
        self._began = clock() if began is None else began
        self._step = 0.0  # seconds of the last evaluation, as an estimate for the next one
        self._last = clock()  # time at the end of the last step
        self._processor, self._spent = processor, processor()
        self.best: RatedLens | None = None  # best lens at the ends of the parts of the current stage
        self._record = record

    @property
    def record(self) -> DesignRecord:
        """Record of the stages and the history so far."""
        seconds, cpu = self._clock() - self._began, self._processor() - self._spent
        return replace(self._record, seconds=self._before.seconds + seconds, cpu_seconds=self._before.cpu_seconds + cpu)

    @property
    def reason_to_end(self) -> str:
        """Reason to end now with the best lens so far: "interrupt", "time" (only the reserve is left) or "" (none)."""
        late = self.record.seconds + self._step > self._limit - self.pace * self._reserve
        return self.reason_to_interrupt or ("time" if late else "")

    @property
    def reason_to_interrupt(self) -> str:
        """Reason to end a stage to which the time limit does not apply (stage 1): "interrupt" or "" (none)."""
        return "interrupt" if self.hooks.interrupted() else ""

    def run(
        self, stage: Steps, task: Task, pack: Callable[..., Any], why: Callable[[], str], best: RatedLens | None = None
    ) -> StageStep:
        """Run a stage until it ends or `why` returns a reason to end it; return its last step.

        pack: makes the state to save from the state of a step.  best: best lens before the stage.  Afterwards
        `self.best`, from which the caller may choose, is the best lens at the start of the stage or the end of a part:
        a part that uses fewer pixels or a smaller source may end with a worse lens.
        """
        self._last, self.best = self._clock(), best
        for step in stage:
            self.stopped = self._take(step, pack) or (step.make and why()) or ""
            if step.ends:
                self._update_best(step, task)
            if self.stopped:
                break
        if self.stopped and step.part and not step.ends:
            step = replace(step, rays_rrmsd=task.rrmsd(step.lens) if step.rays_rrmsd is None else step.rays_rrmsd)
            self.end(step.part, step.rays_rrmsd)
            self._update_best(step, task)
        self.stopped = self.stopped or "evaluations"
        return step

    def _update_best(self, step: StageStep, task: Task) -> None:
        if step.rays_rrmsd is not None and step.at_full_size:
            latest = task.rated(step.lens, step.rays_rrmsd)
            if self.best is None or math.isnan(self.best.figure) or latest.figure < self.best.figure:
                self.best = latest

    def _take(self, step: StageStep, pack: Callable[[Any], Any]) -> str:
        """Record a step; return the reason if the stage ends with this step, else ""."""
        now = self._clock()
        if step.work:
            self.measure(now - self._last, step.work)
        if step.rrmsd is not None:
            self._step = now - self._last
        self._last = now
        if step.progress:
            self.hooks.progress(*step.progress)
        self._record = replace(self._record, skipped=self._record.skipped + step.skipped)
        if step.rrmsd is not None:
            self.note(step.rrmsd)
        if step.make and (step.rrmsd is not None or step.rays_rrmsd is not None):
            self.hooks.on_lens(step.make)
        if step.ends:
            self.end(step.part, step.rays_rrmsd)
        if step.state is not None:
            self.hooks.save(pack(step.state))
        return step.reason

    def measure(self, seconds: float, expected: float) -> None:
        """Update the pace with work that took `seconds`, and would take `expected` seconds on a machine of pace 1.

        The pace of a busy machine changes, so the weight of this work is seconds / PACE_MEMORY, at most 1.
        """
        share = min(1.0, seconds / PACE_MEMORY)
        self.pace += share * (seconds / expected - self.pace)

    def note(self, value: float) -> None:
        """Append an RRMSD, with the present time, to the history."""
        record = self.record
        self._record = replace(record, history=(*record.history, (record.seconds, value)))

    def end(self, name: str, value: float | None = None) -> None:
        """Record the end of a part of the design; it began at the end of the previous part.  value: RRMSD, if known."""
        record = self.record
        spent = sum(stage.seconds for stage in record.stages)
        cpu = None  # unknown for the first part, most of which precedes this driver
        if record.stages:
            cpu = record.cpu_seconds - sum(stage.cpu_seconds or 0.0 for stage in record.stages)
        self._record = replace(record, stages=(*record.stages, StageTime(name, record.seconds - spent, value, cpu)))
        if value is not None:
            self.note(value)
