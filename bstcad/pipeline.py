"""design(scene): the stages in order and nothing else."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

import bstcad
from bstcad.analysis.shape import describe
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle
from bstcad.runs.checkpoint import as_record, as_state, on_device
from bstcad.scene.errors import SceneError
from bstcad.scene.limits import rim_sags
from bstcad.scene.scene import Scene
from bstcad.tailoring import paper, stage1, stage2
from bstcad.tailoring.clearance import moved_clear
from bstcad.tailoring.minimise import Keep, forget
from bstcad.tailoring.parameters import Parameters
from bstcad.tailoring.precision import Twin, twins
from bstcad.tailoring.run import Log, Progress, Stage, Task, judging, never
from bstcad.transport.mapping import Mapping

PROCEDURES = {  # tailoring.method: (stage 1, stage 2)
    "least-squares": (stage1.tailor, stage2.tailor),
    "adam": (paper.stage1, paper.stage2),
}


def silent(stage: str, done: int, total: int, text: str) -> None:
    """A progress that says nothing."""


@dataclass(frozen=True)
class Tailored:
    """A tailored lens and how it was found."""

    scene: Scene
    lens: Lens  # float64, on the CPU
    target: np.ndarray  # (rows, columns), row 0 = y max, sum 1
    mapping: Mapping  # the transport map that stage 1 aimed at
    stages: tuple[Stage, ...]
    history: tuple[tuple[float, float], ...]
    skipped_steps: int
    stopped: str  # what ended tailoring: "evaluations", "plateau", "accuracy", "time" or "interrupt"
    device: str
    earlier: float = 0.0  # seconds of the runs that this one went on from
    twins: Twin | None = None  # float32 beside float64; None if there was no time for it

    @property
    def resolved(self) -> Scene:
        """The scene with the front as it was found, so that a design of it is this one, and has nothing to search for.

        The paper's procedure finds front and back together; its scene stays as it is.
        """
        lens, knobs = self.scene.lens, self.scene.tailoring.resolved(self.scene.lens.back.control_points)
        if knobs.method == "adam" or not lens.front.free:
            return self.scene
        found = lens.front.found(self.lens.front)
        return self.scene.model_copy(update={"lens": lens.model_copy(update={"front": found})})


def design(
    scene: Scene,
    *,
    device: str = "auto",
    progress: Progress = silent,
    began: float | None = None,
    reserve: float = 0.0,
    keep: Keep = forget,
    found: dict[str, Any] | None = None,
    interrupted: Callable[[], bool] = never,
) -> Tailored:
    """From a scene to a tailored lens: transport map, stage 1, stage 2.

    Of tailoring.max_time, counted from `began` (time.perf_counter(), default now), so much is left over as takes
    `reserve` seconds on a machine of pace 1 (tailoring.task.Log).
    `keep` is called now and then with a state; given as `found`, the design goes on from there and ends the same.
    Once `interrupted` says so, tailoring ends with the best so far; KeyboardInterrupt if there is no lens yet.
    """
    torch.manual_seed(scene.tailoring.seed)
    device = device_for(device)
    target = scene.target
    knobs = scene.tailoring.resolved(scene.lens.back.control_points)
    screen = target.screen
    log = Log(progress, time.perf_counter() if began is None else began, interrupted=interrupted)
    if knobs.max_time is not None:
        log.limit, log.reserve = knobs.max_time, reserve + judging(knobs.rays)
    task = Task(
        scene.channels(), screen, target.irradiance(), knobs, log, scene.tolerances.min_thickness,
        scene.lens.front.free, rim_sags(scene),
    )  # fmt: skip
    lens = blank(scene, knobs.levels[0], getattr(torch, knobs.precision), device)
    if found is None:
        log.end("picture")
    else:
        found = on_device(found, device)
        log.restore(found["log"])
    lens, mapping, twin = _tailored(scene, task, lens, found, keep)
    lens = replace(lens.plain(), index=scene.index)
    return Tailored(
        scene, lens, task.target, mapping, tuple(log.stages), tuple(log.history), log.skipped, log.stopped, device,
        log.earlier, twin,
    )  # fmt: skip


def device_for(asked: str) -> str:
    """Where tailoring runs: "cpu" or "cuda".  "auto" is the CPU.

    The compiled kernels serve the CPU alone.  On a GPU the plain form runs, which nobody has measured to be right and
    faster there; until somebody has, only who asks for it by name gets it.
    """
    return "cpu" if asked == "auto" else asked


def purpose(scene: Scene, device: str) -> dict[str, Any]:
    """What a state of `design` belongs to: everything that its result depends on."""
    picture, net = scene.target.image, scene.lens.front.given
    judged = {"rrmsd", "form", "efficiency", "light_on_target"}  # when all is done
    unseen = {"name": True, "title": True, "output": True, "tolerances": judged}
    wanted = scene.model_dump(mode="json", exclude=unseen)
    return {
        "version": bstcad.__version__,
        "device": device_for(device),
        "picture": hashlib.sha256(picture.data).hexdigest() if picture else None,
        **({"front": hashlib.sha256(net.data).hexdigest()} if net else {}),
        **wanted,
    }


def _tailored(
    scene: Scene, task: Task, lens: Lens, found: dict[str, Any] | None, keep: Keep
) -> tuple[Lens, Mapping, Twin | None]:
    """Stage 1, the twins and stage 2, or what is left of them behind a state."""
    log = task.log
    first, second = PROCEDURES[task.knobs.method]
    stage, inner = (found["stage"], found["inner"]) if found else (1, None)

    def kept(stage: int, **more: Any) -> Keep:
        return lambda inner: keep({"stage": stage, "log": log.state(), "inner": inner, **more})

    if stage == 1:
        lens, mapping = first(replace(task, keep=kept(1)), lens, inner)
        check_thickness(lens, scene)
        log.end("stage 1", reached(task, lens))
        twin, inner = None, None
        if not log.hurry:
            twin = twins(task, lens)
            log.end("float32 beside float64")
    else:
        lens, mapping = as_record(Parameters, found["lens"]).applied(lens), as_record(Mapping, found["mapping"])
        twin = as_record(Twin, found["twin"]) if found["twin"] else None
    after = {"lens": as_state(Parameters.of(lens)), "mapping": as_state(mapping), "twin": as_state(twin)}
    if stage <= 2:
        if inner is None and not log.interrupted():  # which cuts stages short: a later run shall not
            kept(2, **after)(None)
        lens = second(replace(task, keep=kept(2, **after)), lens, inner)
        lens = moved_clear(lens, lens.back.z, task.least)  # where no light falls stage 2 may bend it anyhow
        if log.stopped != "interrupt":
            kept(3, **after | {"lens": as_state(Parameters.of(lens))})({"stopped": log.stopped})
    else:
        log.stopped = inner["stopped"]
    return lens, mapping, twin


def blank(scene: Scene, m: int, dtype: torch.dtype, device: str) -> Lens:
    """The lens before tailoring: a flat net of m x m control points.

    The net of a round lens reaches two spans past the rim, where x(t) is linear.
    """
    outline = scene.lens.outline
    reach = (m - 1) / (m - 5) if isinstance(outline, Circle) else 1.0
    half_x, half_y = (reach * half for half in outline.half_extent)
    heights = torch.zeros((m, m), dtype=dtype, device=device)
    back = BSplineSurface(scene.lens.back.z, heights, (-half_x, half_x), (-half_y, half_y))
    return Lens(scene.lens.front.surface.to(dtype, device), back, outline, scene.index, scene.lens.back.reflect)


def reached(task: Task, lens: Lens) -> float:
    """RRMSD after stage 1; SceneError if no light reaches the target, which no later stage could bring there."""
    found = task.rrmsd(lens)
    if not math.isfinite(found) and lens.reflects:
        raise SceneError(
            "target: no light that the mirror throws back reaches it; move it nearer to where a flat mirror would send "
            "the light, or further from the mirror along +z"
        )
    if not math.isfinite(found):
        raise SceneError(
            f"target: no light reaches it: a face of index {lens.index:.4g} turns light by less than "
            f"{math.degrees(math.acos(1 / lens.index)):.3g} degrees before it reflects it; "
            "move the target nearer to where the light falls by itself"
        )
    return found


def check_thickness(lens: Lens, scene: Scene) -> None:
    """A lens that the blank or the target has no room for is refused before the long stage; SceneError says why."""
    shape = describe(lens.plain())
    thinnest, thickest = shape["thickness_min"], shape["thickness_max"]
    most = scene.tolerances.max_thickness
    if not thinnest > 0:
        raise SceneError(
            f"lens.front.z: the back that this target needs would cross the front by {-thinnest:.3g} mm; "
            f"lower the front by more than that, move the target's light apart or make the lens smaller"
        )
    if most is not None and not thickest <= most:
        raise SceneError(
            f"tolerances.max_thickness: the back that this target needs makes the lens {thickest:.3g} mm thick, and "
            f"only {most:g} mm are allowed; allow more, move the target's light apart or make the lens smaller"
        )
    if not (reach := lens.front.z + thickest) < scene.target.z:
        raise SceneError(
            f"target.z: the back that this target needs would reach it, at z = {reach:.4g}; move the target further "
            f"along +z or lower the front"
        )
