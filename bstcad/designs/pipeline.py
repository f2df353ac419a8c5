"""The stages of a design in order, from the blank of a scene to the tailored lens.

Stage 1 comes first, then stage 2.  For a source of finite size stage 3 replaces stage 2 (`second_stage`).  Only the
paper's procedure, whose stage 2 treats each source as a point, runs stage 2 before stage 3.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np
import torch

import bstcad
from bstcad.analysis.shape import thickness_range
from bstcad.analysis.steepness import Steepness, needed_steepness
from bstcad.designs.course import CurvePoint, DesignCourse, PrecisionTest, StageRecord
from bstcad.designs.designed_lens import DesignedLens
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import FRONT
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.surfaces.sides import as_pair
from bstcad.optics.trace.reach import MAX_EXIT_ANGLE, grazing_of, spread_at, unreached
from bstcad.runs import processes
from bstcad.scene.blank import LensBlank
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.tailoring import slope_map, stage1, stage2, two_faces
from bstcad.tailoring.baselines import integration, paper
from bstcad.tailoring.driver import (
    BEST_LENS_STAGE,
    NO_HOOKS,
    RRMSD_SECONDS,
    DesignRecord,
    Driver,
    Edge,
    Hooks,
    Parameters,
    Progress,
    RatedLens,
    Stage,
    StageStep,
    Steps,
    Task,
)
from bstcad.tailoring.effort import FULL, FrontSearch, TailoringEffort
from bstcad.tailoring.feasibility import find_demand, is_infeasible
from bstcad.tailoring.grazing import without_reflection
from bstcad.tailoring.machinability import BOUNDS_STAGE, active_bounds, enforce_bounds, place_back
from bstcad.tailoring.merit import PictureError
from bstcad.tailoring.reachable import Reach, reach_of
from bstcad.tailoring.settings import Settings
from bstcad.tailoring.source_image import ExtendedSource
from bstcad.tailoring.stage2 import PrecisionComparison, compare_precisions
from bstcad.transport.mapping import AT_FACE, Mapping, TransportMap

PROCEDURES: dict[str, tuple[str, Stage, Stage]] = {  # tailoring.method -> (name of stage 1, stage 1, stage 2)
    "least-squares": ("stage 1", stage1.steps, stage2.steps),
    "adam": ("stage 1", paper.stage1, paper.stage2),
    "integration": ("integration", integration.steps, stage2.steps),  # stage 2 makes no evaluation
}
Stage1State = stage1.SlopeRound | paper.Level | two_faces.FrontRound
Stage2State = stage2.TubeSearch | paper.RaySearch | stage2.Stage3State
SOLUTION_SIGNS = {"convex": 1.0, "concave": -1.0}  # sign σ (tailoring/light_behind.py) for each tailoring.solution
DEVICES = ("auto", "cpu", "cuda")
COMPARISON_STAGE = "float32 beside float64"  # name of the stage that compares precisions
EARLIER_STAGE = "earlier lens"  # name of the stage that rates an earlier lens, in the place of stage 1
# Seconds for writing, verification and report on two cores: constant part, per net of 513 x 513 control points, per
# picture of 512 x 512 pixels, and per target for the finer flux tubes that two nets need.
BASE_SECONDS, SECONDS_PER_NET, SECONDS_PER_PICTURE, SECONDS_PER_WITNESS = 4.0, 5.0, 3.0, 15.0
REACH_NET = 33  # control points per side of the flat back with which the reach of light is computed
MAX_ASTRAY = 0.05  # largest fraction of a dome's light that may reach no lit part of the target
MIN_REACHABLE = 1e-3  # reachable fraction of a target's light up to which a scene is refused
REACH_REMEDIES = {  # advice for a target that light cannot reach completely, for each optic
    "lens": "move the target nearer to the axis or further away, raise lens.index, or use a mirror",
    "mirror": "move the target nearer to where a flat mirror would send the light, or further away",
}


@dataclass(frozen=True)
class Stage1Result:
    """The result of stage 1."""

    lens: Parameters  # parameters of the lens after stage 1
    mapping: Mapping | None  # transport map of stage 1; None: an earlier lens in its place
    transport: TransportMap | None  # inverse map, from corners of the target's pixels to the lens; None: not known
    precision: PrecisionComparison | None  # comparison of float32 with float64; None: not made
    rrmsd: float  # RRMSD of the lens for the centre of the source, without a mount


@dataclass(frozen=True)
class DesignState:
    """State from which a design can be continued; a checkpoint stores it under the names of its fields."""

    record: DesignRecord  # stage times and history so far
    first: Stage1State | None = None  # state of stage 1; None: it has not begun, or it has ended
    followed: Stage1Result | None = None  # result of stage 1; None: it has not ended
    second: Stage2State | None = None  # state of stage 2 or 3; None: it has not begun, or it has ended
    best: RatedLens | None = None  # best lens before or during stage 2 or 3; None: not running, or no lens is rated
    lens: Parameters | None = None  # lens after stage 2 or 3; None: tailoring has not ended
    stopped: str = ""  # reason why tailoring ended; "": it has not ended


@dataclass(frozen=True)
class DesignOptions:
    """Options of a design that its scene does not state."""

    merit: PictureError | None = None  # function of a picture and the target that stages 2 and 3 minimise; None: RRMSD²
    compare_later: bool = False  # compare float32 with float64 only when a report needs it (`with_report_data`)
    effort: TailoringEffort = FULL  # effort beside the scene's settings
    earlier: Earlier | None = None  # earlier lens that stage 2 or 3 refines; None: stage 1 makes a lens


@dataclass(frozen=True)
class Earlier:
    """Lens of an earlier design of nearly the same scene."""

    lens: Lens  # index: that for the channel of the largest weight
    parameters: Parameters  # parameters for the blank of the new scene
    transport: TransportMap | None = None  # transport map of the earlier design, for the report; None: not known


def design(
    scene: Scene,
    *,
    device: str = "auto",
    hooks: Hooks = NO_HOOKS,
    options: DesignOptions = DesignOptions(),
    began: float | None = None,
    start: DesignState | None = None,
) -> DesignedLens:
    """Design the lens of a scene: transport map, stage 1, and stage 2, or stage 3 for an extended source.

    device: see `device_for`.  hooks: functions that are called during the design.  Once `hooks.interrupted` returns
    True, tailoring ends with the best lens so far, or with KeyboardInterrupt if there is no lens yet.
    began: time.perf_counter() when tailoring.max_time began (None: now); this time includes writing and verification.
    start: state that `hooks.save` received; the design continues from this state and has the same result.
    """
    began, merit = time.perf_counter() if began is None else began, options.merit
    if merit is not None and (len(scene.targets) > 1 or scene.wavefront is not None):
        raise SceneError("merit: a merit function needs one target and no wavefront; omit it, or the other goals")
    torch.manual_seed(scene.tailoring.seed)
    device = device_for(device)
    goals, edge = within_reach(scene, hooks.progress)
    settings = scene.tailoring.resolved(scene.lens.back.net)
    later = options.compare_later and settings.max_time is None
    task = task_of(scene, goals, settings, edge)
    task = replace(task, progress=hooks.progress, merit=merit, effort=options.effort)
    if options.earlier is not None:
        if PROCEDURES[settings.method][2] is not stage2.steps:
            raise SceneError(f"tailoring.method: {settings.method!r} refines no earlier lens; remove this key")
        task = replace(task, refines=True)
    if task.effort.rates_lenses:  # a preview is so small that the return of its memory takes longer than it helps
        task = replace(task, tidy=processes.return_freed)
    task = with_solution(scene, task)
    fresh, start = start is None, start or DesignState(DesignRecord())
    limit, reserved = math.inf if settings.max_time is None else settings.max_time, reserve(scene) + RRMSD_SECONDS
    driver = Driver(hooks, began, limit=limit, reserve=reserved, record=start.record)
    precision = getattr(torch, settings.precision)
    lens = scene.flat_lens(settings.levels[0], as_wide_as=settings.levels[-1]).to(precision, device)
    if not scene.lens.back.optimise:  # no stage refines a back that stays flat
        lens = lens.with_back(lens.back_net.refined(scene.lens.back.net))
    if fresh:
        driver.end("loading")  # loading of the libraries, the scene and its files
    followed = start.followed
    if followed is None and options.earlier is not None:
        followed = _earlier_lens(task, driver, lens, options.earlier)
    followed = followed or _stage1(scene, task, driver, lens, state=start.first, compare=not later)
    after_stage1, stages = followed.lens.apply_to(lens), len(driver.record.stages)
    lens = scene.as_mounted(after_stage1)  # the clear apertures now follow the tailored back
    if start.lens:
        lens, stopped = start.lens.apply_to(lens), start.stopped
    else:
        lens, stopped = _stage2(task, driver, lens, followed, state=start.second, best=start.best)
    lens = replace(lens.plain(), index=scene.index, losses=None)
    if scene.lens.front.fixed:  # tailoring may have converted the front to float32
        lens = lens.with_front(scene.lens.front_surface)
    sent, source = followed.transport, task.heaviest.source
    steep = None
    if sent is not None:
        at_back = sent.plane == AT_FACE
        steep = needed_steepness(source, lens, goals[0], x=sent.x, y=sent.y, origins=sent.source, at_back=at_back)
    course = _design_course(followed, driver.record, stopped, steep)
    designed = resolved(scene, lens), scene.as_mounted(lens), goals
    made = DesignedLens(*designed, course=course, device=device, transport=followed.transport)
    compare = partial(_with_comparison, course, task, after_stage1, stages)
    return replace(made, precision_comparison=compare) if later else made


def within_reach(scene: Scene, progress: Progress) -> tuple[tuple[Goal, ...], Edge | None]:
    """Return (goals, edge): goals of a scene restricted to their reachable parts, and the first `Edge` of these parts.

    `progress` reports each target that light cannot reach completely.  SceneError as in `reachable_part`.
    """
    goals: list[Goal] = []
    edge = None
    for alone, goal in zip(scene.single_target_scenes(), scene.goals, strict=True):
        part, its_edge = reachable_part(alone, goal)
        if part is not None:
            key = f"{goal.key}: " if len(scene.targets) > 1 else ""
            progress("reach", 0, 0, f"{key}{unreachable(alone, part, goal.picture)}; the design omits this part")
        goals, edge = [*goals, goal.restricted(part)], edge or its_edge
    return tuple(goals), edge


def task_of(scene: Scene, goals: Sequence[Goal], settings: Settings, edge: Edge | None) -> Task:
    """Return the task of a scene; goals, edge: results of `within_reach`; settings: [tailoring] with all defaults."""
    light = scene.with_source_scaled(0.0).channels()
    sizes = stage2.SOURCE_SIZES if scene.source.extent and settings.method != "integration" else ()
    scaled = [scene.with_source_scaled(share) for share, _ in sizes]
    sources = tuple(ExtendedSource(each.light, light, each.sampler) for each in scaled if each.sampler)
    return Task(
        light, tuple(goals), settings, min_thickness=scene.lens.min_thickness, bounds=scene.lens.bounds,
        free=scene.lens.front.free, rim_sags=scene.rim_sags, front_sides=scene.lens.front_net,
        sampled_sources=tuple(each.channels() for each in scaled), extended_sources=sources,
        edge=edge, wave=scene.wavefront,
        solution=None if settings.solution is None else SOLUTION_SIGNS[settings.solution],
    )  # fmt: skip


def with_solution(scene: Scene, task: Task) -> Task:
    """Return the task with the solution (convex or concave) of the scene, or else the better one, by `find_demand`.

    There is a choice only for two freeform faces and several goals; other tasks are returned unchanged.
    `task.progress` reports the angles and limits of the faces.  SceneError if the faces cannot make the pictures.
    """
    lens = scene.flat_lens(REACH_NET)
    if not lens.has_two_tailored_faces or not task.several:
        return task
    demand = find_demand(task, task.heaviest.through(lens))
    sentences = tuple(demand.sentences(scene.lens.back.z - scene.lens.front.z))
    if is_infeasible(demand):
        raise SceneError(f"target: no lens makes these pictures: {'; '.join(sentences[1:])}")
    for sentence in sentences:
        task.progress("reach", 0, 0, sentence)
    return replace(task, solution=demand.solution, floor=demand.floor)


def second_stage(task: Task, lens: Lens, state: Stage2State | None = None) -> tuple[str, Steps]:
    """Return (name, steps) of the stage after stage 1, from `state` on: stage 2, or 3 for a source of finite size."""
    *_, stage = PROCEDURES[task.settings.method]
    if not task.sampled_sources:
        return "stage 2", stage(task, lens, state)
    before = stage if task.settings.method == "adam" else None  # the paper's procedure is for point sources
    return "stage 3", stage2.with_stage3(before, task, lens, state)


def reachable_part(scene: Scene, goal: Goal) -> tuple[np.ndarray | None, Edge | None]:
    """Return (part, edge) of a goal: part (rows, columns) is True in the pixels that light can reach.

    scene: has no other goal.  edge: see `Edge`; None for a mirror.  (None, None): light can reach the whole picture, or
    the front is tailored.  SceneError if the part has at most MIN_REACHABLE of the light, or, with unreachable =
    "refuse", is not the whole target.
    """
    if scene.lens.front.is_tailored:  # with two tailored faces `with_solution` finds the limits
        return None, None
    channels = scene.with_source_scaled(0.0).channels()
    light = max(channels, key=lambda channel: channel.weight)  # channel of stage 1
    lens, grazing = light.through(scene.flat_lens(REACH_NET)), MAX_EXIT_ANGLE
    if refracts := lens.passes.largest_deflection(light.index) is not None:
        grazing = grazing_of(light.index, [each.index for each in channels], spread_at(scene.light, lens))
    found = reach_of(light.source, lens, goal, grazing=grazing)
    if not lens.back.chart.flat:
        if found.astray > MAX_ASTRAY:
            raise SceneError(light_astray(scene, found))
        return found.part, None  # no part of the light is held from total internal reflection yet
    part = found.part
    if part is not None and scene.lens.front.free:  # another front may send light further
        free, effort = scene.lens.front.free, FrontSearch(repeats=1)
        shaped = stage1.shaped_front(light.source, lens, goal, free, rim_sags=scene.rim_sags, effort=effort)
        part = reach_of(light.source, lens.with_front(shaped.front), goal, grazing=grazing).part
    if part is None:
        return None, None
    if not goal.picture[part].sum() > MIN_REACHABLE:
        require_light(lens, math.nan)
    if scene.target.unreachable == "refuse":
        raise SceneError(f"{goal.key}: {unreachable(scene, part, goal.picture)}; {REACH_REMEDIES[scene.optic]}")
    return part, Edge(light, grazing) if refracts else None


def light_astray(scene: Scene, found: Reach) -> str:
    """Return a sentence on light that a dome cannot send to the target."""
    deflection, angle = scene.lens.passes.largest_deflection(scene.index), math.degrees(found.beyond)
    limit = "" if deflection is None else f", which bends light by up to {deflection:.3g} degrees"
    return (
        f"lens.back.half_angle: {100 * found.astray:.2g} % of the light, {angle:.3g} degrees and more from the axis, "
        f"cannot reach a lit part of the target through the dome{limit}; give a smaller half_angle, a wider target, "
        "or a front that bends light to the axis, such as a plane"
    )


def unreachable(scene: Scene, part: np.ndarray, picture: np.ndarray) -> str:
    """Return a sentence, without full stop, on the pixels of a target outside its reachable `part`, and the reason."""
    found = unreached(picture, part, scene.lens.passes.largest_deflection(scene.index))
    area, light = (f"{100 * (found[key] or 0.0):.2g} %" for key in ("area", "light"))
    why = "no slope up to 70 degrees sends light there"
    if found["angle"] is not None:
        why = f"a face of index {scene.index:.4g} deflects light by less than {found['angle']:.3g} degrees"
    return f"{area} of the target, with {light} of its light, cannot be lit: {why}"


def resolved(scene: Scene, lens: Lens) -> Scene:
    """Return the scene with the designed front as a fixed front, so that a new design gives the same lens.

    A scene with the paper's procedure, or without free parameters of the front, is returned unchanged.
    """
    if scene.tailoring.resolved(lens.back_net.shape).method == "adam":
        return scene
    blank = scene.lens.model_copy(update={"front": scene.lens.front.with_parameters(lens.front)})
    return scene.model_copy(update={"lens": blank})


def check_front(lens: Lens, scene: Scene) -> None:
    """Raise SceneError if the scene does not allow the designed front, since no command could read such a design."""
    if not scene.lens.front.free:
        return
    try:
        resolved(scene, lens).changed({})
    except SceneError as error:
        raise SceneError(f"lens.front.optimise: with the front that the target needs, {error}") from None


def _with_comparison(course: DesignCourse, task: Task, lens: Lens, before: int) -> DesignCourse:
    """Return `course` with the comparison of precisions for the lens of stage 1, after the first `before` stages."""
    began, cpu = time.perf_counter(), time.process_time()
    comparison = cast(PrecisionTest, asdict(compare_precisions(task, lens)))
    stage = StageRecord(COMPARISON_STAGE, time.perf_counter() - began, cpu_seconds=time.process_time() - cpu)
    stages = (*course.stages[:before], stage, *course.stages[before:])
    return replace(course, twins=comparison, stages=stages, seconds_total=course.seconds_total + stage.seconds)


def _design_course(result: Stage1Result, record: DesignRecord, stopped: str, steep: Steepness | None) -> DesignCourse:
    """Return the course of a design for the report; stopped: reason why tailoring ended; steep: needed slope."""
    sent: dict[str, Any] = {}
    if result.mapping is not None:
        solved = result.mapping.transport
        sent = {
            "grid": result.mapping.source.n,
            "iterations": solved.iterations,
            "mass_error": solved.mass_error[-1],
            "stopped": solved.reason,
        }
    if steep is not None:
        sent |= {"steep_share": steep.share, "steepest_deg": steep.steepest}
    return DesignCourse(
        seconds_total=record.seconds,
        stages=tuple(StageRecord(**asdict(stage)) for stage in record.stages),
        history=tuple(CurvePoint(*entry) for entry in record.history),
        transport=sent or None,
        skipped_steps=record.skipped,
        stopped=stopped,
        twins=None if result.precision is None else cast(PrecisionTest, asdict(result.precision)),
    )


def _earlier_lens(task: Task, driver: Driver, lens: Lens, earlier: Earlier) -> Stage1Result:
    """Return an earlier lens in the place of the result of stage 1."""
    if driver.reason_to_interrupt:
        raise KeyboardInterrupt
    found, light = earlier.parameters.apply_to(lens), task.heaviest
    before = earlier.lens.to(found.like.dtype, found.like.device)
    slopes = slope_map.carry_light(light.source, before, light.through(found), task.goals[0])
    each = found, found.with_last_net(slopes.nets[-1])
    found, rrmsd = min(((lens, task.rrmsd(lens)) for lens in each), key=lambda rated: _or_infinite(rated[1]))
    require_light(found, rrmsd)
    driver.end(EARLIER_STAGE, rrmsd)
    return Stage1Result(Parameters.of(found), None, earlier.transport, precision=None, rrmsd=rrmsd)


def _or_infinite(rrmsd: float) -> float:
    return math.inf if math.isnan(rrmsd) else rrmsd


def _stage1(
    scene: Scene, task: Task, driver: Driver, lens: Lens, *, state: Stage1State | None, compare: bool
) -> Stage1Result:
    """Run stage 1 from the blank or from a state; if `compare`, then compare the precisions."""
    if driver.reason_to_interrupt and state is None:
        raise KeyboardInterrupt  # there is no lens yet
    name, stage, _ = PROCEDURES[task.settings.method]
    like = lens.like
    if scene.lens.front.is_tailored:  # stage 1 of two faces runs in numpy, on the CPU
        stage, lens = two_faces.steps, lens.to(like.dtype, "cpu")
    steps = stage(task, lens, state)
    last = driver.run(steps, task, lambda state: DesignState(driver.record, state), lambda: driver.reason_to_interrupt)
    lens = replace(last.lens, behind=lens.behind, tailored=lens.tailored).to(like.dtype, like.device)
    check_front(lens, scene)
    bounds = active_bounds(lens, task.bounds, task.min_thickness)
    if bounds is None:
        check_thickness(lens, scene, task.effort.thickness_points)
    rrmsd = require_light(lens, task.rrmsd(lens) if last.rays_rrmsd is None else last.rays_rrmsd)
    driver.end(name, rrmsd)
    if bounds is not None:
        driver.hooks.progress(BOUNDS_STAGE, 0, 1, "")
        if lens.is_tailored(FRONT):  # shifted before stage 2, which corrects the light but does not shift the back
            lens = place_back(lens, lens.back.z, task.min_thickness, bounds)
        lens = enforce_bounds(lens, bounds)
        check_thickness(lens, scene, task.effort.thickness_points)
        rrmsd = require_bounded_light(scene.lens, task.rrmsd(lens))
        driver.end(f"{BOUNDS_STAGE}, after stage 1", rrmsd)
    precision = None
    if compare and not driver.reason_to_end:
        precision = compare_precisions(task, lens)
        driver.end(COMPARISON_STAGE)
    screen, mapping = task.goals[0].screen, last.mapping
    assert mapping is not None, "each step of stage 1 has its map"
    if last.face_points is None:
        sent = slope_map.map_from_entrance(mapping, lens, screen)
    else:
        sent = slope_map.map_from_face(last.face_points, screen)
    return Stage1Result(Parameters.of(lens), mapping, sent, precision, rrmsd=rrmsd)


def _stage2(
    task: Task, driver: Driver, lens: Lens, followed: Stage1Result, *, state: Stage2State | None, best: RatedLens | None
) -> tuple[Lens, str]:
    """Run stage 2, or stage 3 for an extended source, from the result of stage 1, or from a state and the best lens.

    Return (lens, stopped): the last lens of the stage, or a better earlier one, and the reason why the stage ended.
    """
    if state is None and not driver.reason_to_interrupt:  # an interrupt leaves stage 1 incomplete: do not save it
        driver.hooks.save(DesignState(driver.record, followed=followed))
    name, steps = second_stage(task, lens, state)
    full = task.at_full_size
    known = not task.sampled_sources and lens.clear is None
    rates = task.effort.rates_lenses
    first = full.rated(lens, followed.rrmsd if known else full.rrmsd(lens)) if rates else None

    def design_state(state: Stage2State) -> DesignState:
        return DesignState(driver.record, None, followed, state, best=driver.best)

    last = driver.run(steps, full, design_state, lambda: driver.reason_to_end, best=best or first)
    lens = _final_lens(full, driver, last, [each for each in (driver.best, first) if each is not None])
    total = task.settings.stage2_iterations
    driver.hooks.progress(name, total, total, driver.stopped)
    if driver.stopped != "interrupt":
        final = Parameters.of(lens)
        driver.hooks.save(DesignState(driver.record, followed=followed, lens=final, stopped=driver.stopped))
    return lens, driver.stopped


def _final_lens(task: Task, driver: Driver, last: StageStep, before: Sequence[RatedLens]) -> Lens:
    """Return the corrected lens of the last step of a stage, or a corrected earlier lens if it is better.

    before: earlier lenses, the best first.  The paper's procedure always returns its last lens.
    """
    lens = last.lens
    corrected, value = _corrected(task, lens), last.rays_rrmsd
    if not task.effort.rates_lenses:
        return corrected
    if active_bounds(lens, task.bounds, task.min_thickness) is not None:
        driver.end(BOUNDS_STAGE, value := task.rrmsd(corrected))
    elif value is not None and (_is_changed(lens, corrected) or not last.at_full_size):
        value = task.rrmsd(corrected)
    if value is None or task.settings.method == "adam":
        return corrected
    latest = task.rated(corrected, value)
    for known in before:
        if known.beats(latest):
            lens = known.lens.apply_to(lens)
            other = _corrected(task, lens)
            best, judged = task.better(corrected, other)
            if best is other:
                driver.end(BEST_LENS_STAGE, judged.rrmsd)
                return other
    return corrected


def _corrected(task: Task, lens: Lens) -> Lens:
    """Return the lens corrected for total reflection at the edge of the reach, crossing faces, and violated bounds."""
    if task.edge is not None:
        lens = without_reflection(lens, task.edge)
    bounds = active_bounds(lens, task.bounds, task.min_thickness)
    if not lens.is_tailored(FRONT):  # stage 2 may bend the back freely where no light falls
        lens = place_back(lens, lens.back.z, task.min_thickness, bounds)
    return lens if bounds is None else enforce_bounds(lens, bounds)


def _is_changed(lens: Lens, other: Lens) -> bool:
    """Return True if two lenses differ in heights or in the z of the back."""
    nets = zip(lens.nets, other.nets, strict=True)
    return lens.back.z != other.back.z or any(a.heights is not b.heights for a, b in nets)


def device_for(asked: str) -> str:
    """Return the device of tailoring, "cpu" or "cuda"; SceneError for an unknown or missing device.

    "auto" is the CPU, for which the kernels are compiled.  A GPU runs the same functions in torch, with equal accuracy,
    most of them in less time (docs/explanation/decisions/no-gpu-by-default.md).
    """
    if asked not in DEVICES:
        raise SceneError(f"device: {asked!r} is not possible; give one of {', '.join(DEVICES)}")
    if asked == "cuda" and not torch.cuda.is_available():
        raise SceneError("device: torch finds no CUDA device on this machine; give cpu")
    return "cuda" if asked == "cuda" else "cpu"


def reserve(scene: Scene) -> float:
    """Return the estimated seconds for writing, verification and report on two cores."""
    pixels = sum(math.prod(target.columns_rows) for target in scene.targets) / 512**2
    nets = scene.lens.nets()
    points = sum(math.prod(as_pair(net)) for net in nets) / 513**2
    witnesses = len(scene.targets) * (len(nets) - 1)
    return BASE_SECONDS + SECONDS_PER_NET * points + SECONDS_PER_PICTURE * pixels + SECONDS_PER_WITNESS * witnesses


def purpose(scene: Scene, device: str) -> dict[str, Any]:
    """Return the data, except DesignOptions, that determine a design; a checkpoint with equal data can be resumed."""
    keys = scene.model_dump(mode="json", exclude={"name", "title", "output", "accept"})
    return {
        "version": bstcad.__version__,
        "device": device_for(device),
        "files": {name: content.digest for name, content in sorted(scene.files.items())},
        **keys,
    }


def require_light(lens: Lens, rrmsd: float) -> float:
    """Return the RRMSD after stage 1; SceneError if no light reaches the target, as no later stage can correct this."""
    angle = lens.passes.largest_deflection(lens.index)
    if not math.isfinite(rrmsd) and angle is None:
        raise SceneError(
            "target: no light from the mirror reaches the target; move the target nearer to where a flat mirror would "
            "send the light, or further from the mirror along +z"
        )
    if not math.isfinite(rrmsd):
        raise SceneError(
            f"target: no light reaches the target, as a face of index {lens.index:.4g} deflects light by at most "
            f"{angle:.3g} degrees; move the target nearer to where the light falls without the lens"
        )
    return rrmsd


def require_bounded_light(blank: LensBlank, rrmsd: float) -> float:
    """Return the RRMSD of the first lens within its bounds; SceneError if it sends no light to the target."""
    if math.isfinite(rrmsd):
        return rrmsd
    keys = blank.bounded_by or ("min_thickness",)
    bounds = " and ".join(f"lens.{key} = {getattr(blank, key):g}" for key in keys)
    raise SceneError(f"{bounds}: no lens within these bounds sends light to the target; relax a bound")


def check_thickness(lens: Lens, scene: Scene, points: int) -> None:
    """Raise SceneError, before stage 2, if the back crosses the front or reaches the next element or target.

    points: per side of the grid on which the thickness is measured.
    """
    thinnest, thickest = thickness_range(lens.plain(), grid=points)
    if not thinnest > 0 and not lens.back.chart.flat:
        raise SceneError(
            f"lens.back.radius: the dome that the target needs would cross the front by {-thinnest:.3g} mm; "
            "increase the radius, or move the target to where the light falls without the lens"
        )
    if not thinnest > 0:
        raise SceneError(
            f"lens.front.z: the back that the target needs would cross the front by {-thinnest:.3g} mm; "
            f"lower lens.front.z by more than this, widen the target, or make the lens smaller"
        )
    reach = lens.front.z + thickest
    if not lens.back.chart.flat:
        reach = lens.back.z + lens.back.sags(lens.outline)[1]
    room, key = scene.clearance(reach)
    if not room > 0:
        raise SceneError(
            f"{key}: the back that the target needs would reach this position, as it extends to z = {reach:.4g} mm; "
            f"increase {key}, or lower lens.front.z and lens.back.z"
        )
