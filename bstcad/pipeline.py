"""design(scene): the stages in order, from the blank to the tailored lens."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch

import bstcad
from bstcad.analysis.shape import thickness_range
from bstcad.analysis.steepness import Steepness, needed_steepness
from bstcad.baselines import integration, paper
from bstcad.folder import Made
from bstcad.optics.emitters import Emitter
from bstcad.optics.goal import Goal
from bstcad.optics.lens import Lens
from bstcad.optics.reach import MAX_EXIT_ANGLE, grazing_of, spread_at, unreached
from bstcad.optics.sides import as_pair
from bstcad.optics.unfolding import image_screen
from bstcad.report.record import CurvePoint, DesignCourse, StageRecord
from bstcad.runs import processes
from bstcad.scene.errors import SceneError
from bstcad.scene.quality import Tailoring
from bstcad.scene.scene import Scene
from bstcad.tailoring import slope_map, stage1, stage2, two_faces
from bstcad.tailoring.feasibility import find_demand, is_infeasible
from bstcad.tailoring.grazing import without_reflection
from bstcad.tailoring.machinability import BOUNDS_STAGE, active_bounds, enforce_bounds, place_back
from bstcad.tailoring.reachable import reachable
from bstcad.tailoring.run import (
    BEST,
    JUDGING,
    Driver,
    Edge,
    Judged,
    Look,
    Parameters,
    Progress,
    Record,
    Step,
    Task,
    forget,
    never,
    silent,
    unseen,
)
from bstcad.tailoring.source_image import Spread
from bstcad.tailoring.stage2 import Comparison, compare_precisions
from bstcad.transport.mapping import Mapping, TransportMap

PROCEDURES = {  # tailoring.method: (name of the first stage, the first stage, stage 2)
    "least-squares": ("stage 1", stage1.steps, stage2.steps),
    "adam": ("stage 1", paper.stage1, paper.stage2),
    "integration": ("integration", integration.steps, stage2.steps),  # of no evaluations
}
Stage1State = stage1.SlopeRound | paper.Level | two_faces.FrontRound
Stage2State = stage2.TubeSearch | paper.RaySearch | stage2.Stage3State
SIGNS = {"convex": 1.0, "concave": -1.0}  # tailoring.solution
DEVICES = ("auto", "cpu", "cuda")
COMPARED = "float32 beside float64"  # the name of that stage
# Seconds that writing, proving and reporting take on two cores; PER_NET of 513 x 513 control points, PER_PICTURE of
# 512 x 512 pixels, PER_WITNESS of a target by the finer ray tubes that two nets need.
FIXED, PER_NET, PER_PICTURE, PER_WITNESS = 4.0, 5.0, 3.0, 15.0
REACH_NET = 33  # control points a side of the flat back from which the reach of light is found
LEAST_REACHED = 1e-3  # of the light of a target that has to be within reach
FURTHER = {  # how light gets to all of a target, by the optic
    "lens": "move the target nearer to the axis or further away, take a higher lens.index, or reflect with a mirror",
    "mirror": "move the target nearer to where a flat mirror would send the light, or further away",
}


@dataclass(frozen=True)
class Followed:
    """The result of stage 1."""

    lens: Parameters
    mapping: Mapping  # the transport map that it followed
    transport: TransportMap  # the same, inverted, from the target's pixels
    precision: Comparison | None  # float32 beside float64; None if there was no time for it
    rrmsd: float  # RRMSD of the lens for the source's middle, without a mount


@dataclass(frozen=True)
class Saved:
    """A design as it can be left: everything that the way on from there depends on."""

    record: Record
    first: Stage1State | None = None  # where stage 1 stands; None: it has ended
    followed: Followed | None = None  # None: stage 1 has not ended
    second: Stage2State | None = None  # where stage 2 or 3 stands; None: it has not begun, or it has ended
    best: Judged | None = None  # the best lens at the ends of its parts so far
    lens: Parameters | None = None  # after that
    stopped: str = ""  # the reason why tailoring ended


def design(
    scene: Scene, *, device: str = "auto", progress: Progress = silent, began: float | None = None,
    save: Callable[[Saved], None] = forget, start: Saved | None = None, interrupted: Callable[[], bool] = never,
    merit: Callable[[torch.Tensor, torch.Tensor], torch.Tensor] | None = None, later: bool = False,
    look: Look = unseen, hasty: bool = False,
) -> Made:  # fmt: skip
    """From a scene to a tailored lens: transport map, stage 1, stage 2, or stage 3 for a source of some size.

    tailoring.max_time is counted from `began` (time.perf_counter(), default now) and leaves time for writing and proof.
    `save` is called now and then with a state; given as `start`, the design goes on from there and ends the same.
    Once `interrupted` says so, tailoring ends with the best so far; KeyboardInterrupt if there is no lens yet.
    merit: of a picture and the target, what stages 2 and 3 make least; None: RRMSD².
    look: called now and then with the function that makes the best lens so far.
    hasty: as a preview, see `Task.hasty`; the scene itself says how small it is.
    later: float32 is compared with float64 only when a report asks for it (`Made.with_report_data`).
    """
    began = time.perf_counter() if began is None else began
    if merit is not None and (len(scene.targets) > 1 or scene.wavefront is not None):
        raise SceneError("merit: is one of a picture, and the scene has several goals; leave it out, or ask for less")
    torch.manual_seed(scene.tailoring.seed)
    device = device_for(device)
    goals, edge = within_reach(scene, progress)
    knobs = scene.tailoring.resolved(scene.lens.back.net)
    later = later and knobs.max_time is None
    task = task_of(scene, goals, knobs, edge, progress=progress, tidy=processes.return_freed, merit=merit, hasty=hasty)
    task = posed(scene, task)
    limits = {} if knobs.max_time is None else {"limit": knobs.max_time, "reserve": reserve(scene) + JUDGING}
    record = Record() if start is None else start.record
    driver = Driver(progress, began, **limits, interrupted=interrupted, save=save, look=look, record=record)
    precision = getattr(torch, knobs.precision)
    lens = scene.flat_lens(knobs.levels[0], dtype=precision, device=device, as_wide_as=knobs.levels[-1])
    if not scene.lens.back.optimise:  # nothing refines it on the way
        lens = lens.with_back(lens.back.refined(scene.lens.back.net))
    if start is None:
        driver.end("loading")  # the libraries, the scene and the files it names
    followed = (
        start.followed
        if start and start.followed
        else _stage1(scene, task, driver, lens, state=start and start.first, compare=not later)
    )
    after_stage1, stages = followed.lens.applied(lens), len(driver.record.stages)
    lens = scene.as_mounted(after_stage1)  # the walls end elsewhere than below a flat back
    if start and start.lens:
        lens, stopped = start.lens.applied(lens), start.stopped
    else:
        lens, stopped = _stage2(task, driver, lens, followed, state=start and start.second, best=start and start.best)
    lens = replace(lens.plain(), index=scene.index, losses=None)
    if scene.lens.front.fixed:  # as it was given: tailoring may have worked with less digits of it
        lens = replace(lens, front=scene.lens.front_surface)
    steep = steepness(task.heaviest.source, lens, goals[0], sent=followed.transport)
    making = _making(followed, driver.record, stopped, steep)
    return Made(
        resolved(scene, lens), scene.as_mounted(lens), goals, making, device=device, transport=followed.transport,
        precision_comparison=partial(_compared, making, task, after_stage1, stages) if later else None,
    )  # fmt: skip


def within_reach(scene: Scene, progress: Progress) -> tuple[tuple[Goal, ...], Edge | None]:
    """(goals, edge): the goals of a scene without what light cannot reach, as `reachable_part` has both.

    Of a target that light cannot reach all of, `progress` is told.  SceneError as `reachable_part`.
    """
    goals, edge = [], None
    for alone, goal in zip(scene.each_alone(), scene.goals, strict=True):
        part, its_edge = reachable_part(alone, goal)
        if part is not None:
            of = f"{goal.key}: " if len(scene.targets) > 1 else ""
            progress("reach", 0, 0, f"{of}{unreachable(alone, part, goal.picture)}; the design is for the rest")
        goals, edge = [*goals, goal.restricted(part)], edge or its_edge
    return tuple(goals), edge


def task_of(scene: Scene, goals: Sequence[Goal], knobs: Tailoring, edge: Edge | None, **more: Any) -> Task:
    """The task of a scene; goals, edge: as `within_reach` has them.  more: fields of Task that no scene tells."""
    light = scene.with_source_scaled(0.0).channels()
    sizes = stage2.SOURCE_SIZES if scene.source.extent and knobs.method != "integration" else ()
    scaled = [scene.with_source_scaled(share) for share, _ in sizes]
    return Task(
        light, tuple(goals), knobs, least=scene.lens.min_thickness, free=scene.lens.front.free,
        rim_sags=scene.rim_sags, grown=tuple(each.channels() for each in scaled), bounds=scene.lens.bounds,
        spreads=tuple(Spread(each.source, light, each.draw) for each in scaled), edge=edge, wave=scene.wavefront,
        solution=SIGNS.get(knobs.solution), front_sides=scene.lens.front_net, **more,
    )  # fmt: skip


def posed(scene: Scene, task: Task) -> Task:
    """The task with the solution that asks less of two freeform faces; it says what they cannot do.  SceneError."""
    lens = scene.flat_lens(REACH_NET)
    if not lens.shapes_two_faces or not task.several:
        return task
    demand = find_demand(task, task.heaviest.through(lens))
    sentences = tuple(demand.sentences(scene.lens.back.z - scene.lens.front.z))
    if is_infeasible(demand):
        raise SceneError(f"target: {'; '.join(sentences[1:])}")
    for sentence in sentences:
        task.progress("reach", 0, 0, sentence)
    return replace(task, solution=demand.solution, floor=demand.floor)


def second_stage(task: Task, lens: Lens, state: Stage2State | None = None) -> tuple[str, Iterator[Step]]:
    """The name and the steps of the stage that follows stage 1: stage 2, and 3 for a source of some size."""
    *_, stage = PROCEDURES[task.knobs.method]
    if not task.grown:
        return "stage 2", stage(task, lens, state)
    before = stage if task.knobs.method == "adam" else None  # the paper's procedure knows points alone
    return "stage 3", stage2.with_stage3(before, task, lens, state)


def reachable_part(scene: Scene, goal: Goal) -> tuple[np.ndarray | None, Edge | None]:
    """(rows, columns) True in the pixels that a design for the one goal of a scene can light, and the edge's light.

    None, None: it can light all that its picture lights.  A mirror, whose slope alone binds it, has no such edge.
    SceneError where it can light none, or not all in a scene with target.unreachable = "refuse".
    """
    if scene.lens.front.shaped:  # which may send light further than any back: `posed` tells
        return None, None
    channels = scene.with_source_scaled(0.0).channels()
    light = max(channels, key=lambda channel: channel.weight)  # stage 1 reckons with it alone
    lens, grazing = light.through(scene.flat_lens(REACH_NET)), MAX_EXIT_ANGLE
    if refracts := lens.passes.largest_turn(light.index) is not None:
        grazing = grazing_of(light.index, [each.index for each in channels], spread_at(scene.source, lens))
    part = reachable(light.source, lens, goal, grazing=grazing)
    if part is not None and scene.lens.front.free:  # another front may send light further
        front = stage1.shaped_front(
            light.source, lens, goal.picture, goal.receiver, free=scene.lens.front.free, rim_sags=scene.rim_sags,
            repeats=1,
        ).front  # fmt: skip
        part = reachable(light.source, lens.with_front(front), goal, grazing=grazing)
    if part is None:
        return None, None
    if not goal.picture[part].sum() > LEAST_REACHED:
        reached(lens, math.nan)
    if scene.target.unreachable == "refuse":
        raise SceneError(f"{goal.key}: {unreachable(scene, part, goal.picture)}; {FURTHER[scene.optic]}")
    return part, Edge(light, grazing) if refracts else None


def unreachable(scene: Scene, part: np.ndarray, picture: np.ndarray) -> str:
    """How much of a target lies outside of the part that can be lit, and why, as a sentence without its end."""
    found = unreached(picture, part, scene.lens.passes.largest_turn(scene.index))
    area, light = (f"{100 * found[key]:.2g} %" for key in ("area", "light"))
    why = "no slope up to 70 degrees sends light there"
    if found["angle"] is not None:
        why = f"a face of index {scene.index:.4g} turns light by less than {found['angle']:.3g} degrees, or reflects it"
    return f"{area} of the target, with {light} of its light, cannot be lit: {why}"


def resolved(scene: Scene, lens: Lens) -> Scene:
    """The scene with the designed front, so that a design of it is this one, and has no front to search for.

    The paper's procedure finds front and back together, and so is a freeform front; such a scene stays as it is.
    """
    if scene.tailoring.resolved(lens.back.shape).method == "adam":
        return scene
    blank = scene.lens.model_copy(update={"front": scene.lens.front.designed(lens.front)})
    return scene.model_copy(update={"lens": blank})


def check_front(lens: Lens, scene: Scene) -> None:
    """A front that was found, and that does not go with the rest of the scene, is refused; SceneError says why.

    Such a design would be written to a folder that no command could read.
    """
    if not scene.lens.front.free:
        return
    try:
        resolved(scene, lens).changed({})
    except SceneError as error:
        raise SceneError(f"lens.front.optimise: with the front that the target needs, {error}") from None


def _compared(making: DesignCourse, task: Task, lens: Lens, before: int) -> DesignCourse:
    """The record with float32 beside float64, for the lens of stage 1, behind so many stages."""
    began, cpu = time.perf_counter(), time.process_time()
    twins = asdict(compare_precisions(task, lens))
    stage = StageRecord(COMPARED, time.perf_counter() - began, cpu_seconds=time.process_time() - cpu)
    stages = (*making.stages[:before], stage, *making.stages[before:])
    return replace(making, twins=twins, stages=stages, seconds_total=making.seconds_total + stage.seconds)


def steepness(source: Emitter, lens: Lens, goal: Goal, sent: TransportMap) -> Steepness:
    """The slope that the light of a goal needs of the last tailored face, by the map of stage 1."""
    at_back, screen = sent.plane == "back", image_screen(lens, goal.receiver)
    return needed_steepness(source, lens, screen, goal.picture, x=sent.x, y=sent.y, places=sent.source, at_back=at_back)


def _making(followed: Followed, went: Record, stopped: str, steep: Steepness) -> DesignCourse:
    """The record of a tailoring for the report."""
    solved = followed.mapping.transport
    return DesignCourse(
        seconds_total=went.seconds,
        stages=tuple(StageRecord(**asdict(stage)) for stage in went.stages),
        history=tuple(CurvePoint(*entry) for entry in went.history),
        transport={
            "grid": followed.mapping.source.n,
            "iterations": solved.iterations,
            "mass_error": solved.mass_error[-1],
            "stopped": solved.reason,
            "steep_share": steep.share,
            "steepest_deg": steep.steepest,
        },
        skipped_steps=went.skipped,
        stopped=stopped,
        twins=None if followed.precision is None else asdict(followed.precision),
    )


def _stage1(
    scene: Scene, task: Task, driver: Driver, lens: Lens, state: Stage1State | None, compare: bool
) -> Followed:  # fmt: skip
    """Stage 1 from the blank, or further from a state, and if asked the comparison of precisions behind it."""
    if driver.wish and state is None:
        raise KeyboardInterrupt  # there is nothing to show
    name, stage, _ = PROCEDURES[task.knobs.method]
    like = lens.like
    if scene.lens.front.shaped:  # whose light between both faces is one of numpy: a second of work on the CPU
        stage, lens = two_faces.steps, lens.to(like.dtype, "cpu")
    last = driver.run(stage(task, lens, state), task, lambda state: Saved(driver.record, state), lambda: driver.wish)
    lens = replace(last.lens, behind=lens.behind, shaped=lens.shaped).to(like.dtype, like.device)
    check_front(lens, scene)
    bounds = active_bounds(lens, task.bounds, task.least)
    if bounds is None:
        check_thickness(lens, scene)
    rrmsd = reached(lens, task.rrmsd(lens) if last.judged is None else last.judged)
    driver.end(name, rrmsd)
    if bounds is not None:
        driver.progress(BOUNDS_STAGE, 0, 1, "")
        if lens.shapes("front"):  # stage 2 takes a move into account, but makes none itself
            lens = place_back(lens, lens.back.z, task.least, bounds)
        lens = enforce_bounds(lens, bounds)
        check_thickness(lens, scene)
        rrmsd = possible(scene, task.rrmsd(lens))
        driver.end(f"{BOUNDS_STAGE}, after stage 1", rrmsd)
    precision = None
    if compare and not driver.hurry:
        precision = compare_precisions(task, lens)
        driver.end(COMPARED)
    screen = task.goals[0].receiver
    if last.places is None:
        sent = slope_map.sent_from_entrance(last.mapping, lens, screen)
    else:
        sent = slope_map.sent_from(last.places, screen)
    return Followed(Parameters.of(lens), last.mapping, sent, precision, rrmsd=rrmsd)


def _stage2(
    task: Task, driver: Driver, lens: Lens, followed: Followed, state: Stage2State | None, best: Judged | None
) -> tuple[Lens, str]:  # fmt: skip
    """Stage 2, and 3 for a source of some size, from stage 1 or further from a state: the lens, and why it ended.

    It is no worse than the lens of stage 1, nor than that of any part on the way.
    """
    if state is None and not driver.wish:  # which cuts stages short: a later run shall not
        driver.save(Saved(driver.record, followed=followed))
    name, steps = second_stage(task, lens, state)
    whole = task.whole
    known = not task.grown and lens.clear is None
    first = None if task.hasty else whole.judged(lens, followed.rrmsd if known else whole.rrmsd(lens))

    def saved(state: Stage2State) -> Saved:
        return Saved(driver.record, None, followed, state, best=driver.best)

    last = driver.run(steps, whole, saved, lambda: driver.hurry, best=best or first)
    lens = _handed_on(whole, driver, last, (driver.best, first))
    total = task.knobs.stage2_iterations
    driver.progress(name, total, total, driver.stopped)
    if driver.stopped != "interrupt":
        driver.save(Saved(driver.record, followed=followed, lens=Parameters.of(lens), stopped=driver.stopped))
    return lens, driver.stopped


def _handed_on(task: Task, driver: Driver, last: Step, before: Sequence[Judged]) -> Lens:
    """The lens after the last step of a stage, mended; or one from before, mended too, if that is better.

    before: the best first.  The paper's procedure hands on its last lens, as it does.
    """
    lens = last.lens
    mended, value = _mended(task, lens), last.judged
    if task.hasty:
        return mended
    if active_bounds(lens, task.bounds, task.least) is not None:
        driver.end(BOUNDS_STAGE, value := task.rrmsd(mended))
    elif value is not None and (_moved(lens, mended) or not last.whole):
        value = task.rrmsd(mended)
    if value is None or task.knobs.method == "adam":
        return mended
    latest = task.judged(mended, value)
    for known in before:
        if known.beats(latest):
            lens = known.lens.applied(lens)
            other = _mended(task, lens)
            best, judged = task.better(mended, other)
            if best is other:
                driver.end(BEST, judged.rrmsd)
                return other
    return mended


def _mended(task: Task, lens: Lens) -> Lens:
    """The lens with no light reflected at the edge of its reach, with its faces clear of each other, within bounds."""
    if task.edge is not None:
        lens = without_reflection(lens, task.edge)
    bounds = active_bounds(lens, task.bounds, task.least)
    if not lens.shapes("front"):  # where no light falls stage 2 is free to bend the back
        lens = place_back(lens, lens.back.z, task.least, bounds)
    return lens if bounds is None else enforce_bounds(lens, bounds)


def _moved(lens: Lens, other: Lens) -> bool:
    """Is the other lens of other heights, or with its back elsewhere?"""
    nets = zip(lens.nets, other.nets, strict=True)
    return lens.back.z != other.back.z or any(a.heights is not b.heights for a, b in nets)


def device_for(asked: str) -> str:
    """Where tailoring runs: "cpu" or "cuda"; SceneError for another device, and where there is none.

    "auto" is the CPU, which the compiled kernels serve alone.  On a GPU the plain form runs, which nobody has measured
    to be right and faster there; until somebody has, only a user who asks for it by name gets it.
    """
    if asked not in DEVICES:
        raise SceneError(f"device: {asked!r} is not possible; give one of {', '.join(DEVICES)}")
    if asked == "cuda" and not torch.cuda.is_available():
        raise SceneError("device: this machine has no CUDA device that torch can use; give cpu")
    return "cuda" if asked == "cuda" else "cpu"


def reserve(scene: Scene) -> float:
    """Seconds that writing, proving and reporting will take on two cores."""
    pixels = sum(math.prod(target.columns_rows) for target in scene.targets) / 512**2
    nets = scene.lens.nets()
    points = sum(math.prod(as_pair(net)) for net in nets) / 513**2
    witnesses = len(scene.targets) * (len(nets) - 1)
    return FIXED + PER_NET * points + PER_PICTURE * pixels + PER_WITNESS * witnesses


def purpose(scene: Scene, device: str) -> dict[str, Any]:
    """Everything that the result of `design` depends on: a state of it belongs to no other design."""
    wanted = scene.model_dump(mode="json", exclude={"name", "title", "output", "accept"})
    return {
        "version": bstcad.__version__,
        "device": device_for(device),
        "files": {name: content.digest for name, content in sorted(scene.files.items())},
        **wanted,
    }


def reached(lens: Lens, rrmsd: float) -> float:
    """RRMSD after stage 1; SceneError if no light reaches the target, which no later stage could bring there."""
    angle = lens.passes.largest_turn(lens.index)
    if not math.isfinite(rrmsd) and angle is None:
        raise SceneError(
            "target: no light that the mirror throws back reaches it; move it nearer to where a flat mirror would send "
            "the light, or further from the mirror along +z"
        )
    if not math.isfinite(rrmsd):
        raise SceneError(
            f"target: no light reaches it: a face of index {lens.index:.4g} turns light by less than "
            f"{angle:.3g} degrees before it reflects it; "
            "move the target nearer to where the light falls by itself"
        )
    return rrmsd


def possible(scene: Scene, rrmsd: float) -> float:
    """RRMSD of the first lens that keeps to the bounds on its back; SceneError if it throws no light on the target."""
    if math.isfinite(rrmsd):
        return rrmsd
    keys = scene.lens.bounded_by or ("min_thickness",)
    bounds = " and ".join(f"lens.{key} = {getattr(scene.lens, key):g}" for key in keys)
    raise SceneError(f"{bounds}: no back that keeps to it brings light onto the target; allow the back more")


def check_thickness(lens: Lens, scene: Scene) -> None:
    """A lens that the blank or the target has no room for is refused before the long stage; SceneError says why."""
    thinnest, thickest = thickness_range(lens.plain())
    if not thinnest > 0:
        raise SceneError(
            f"lens.front.z: the back that this target needs would cross the front by {-thinnest:.3g} mm; "
            f"lower the front by more than that, move the target's light apart or make the lens smaller"
        )
    room, key = scene.clearance(reach := lens.front.z + thickest)
    if not room > 0:
        raise SceneError(
            f"{key}: the back that this target needs would reach it, at z = {reach:.4g}; move it further along +z or "
            f"lower the front"
        )
