"""A preview of a scene: the light that its lens will throw, in about a second, by the steps of a design made small.

The preview is a design of the same scene with fewer pixels, control points, ray tubes and evaluations, so that a pixel
has as many control cells and tubes as it has in a draft.  Left out are the judging of a lens on its way, and the search
for light that has to move far.  A preview shows no detail that is finer than its pixels.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from bstcad import pipeline
from bstcad.analysis.light import blur
from bstcad.analysis.shape import describe
from bstcad.optics.channels import Channel
from bstcad.optics.goal import Goal
from bstcad.optics.lens import Lens
from bstcad.optics.measure import a_side, seen_through, simulated, tubes_picture
from bstcad.optics.sides import both, coarser
from bstcad.optics.tubes import corners, middle
from bstcad.report.light_figures import rrmsd
from bstcad.scene.scene import Scene
from bstcad.tailoring import stage1, stage2, two_faces
from bstcad.tailoring.machinability import front_shaped, held, kept, moved_clear
from bstcad.tailoring.merit import Merit
from bstcad.tailoring.run import Progress, Step, Task

COARSE_NET = 33  # of the first rounds of stage 1
CELLS = 48  # of the transport, a side
SEVERAL, TIMES = 0.5, 3  # of several goals: each of these times this, and times the evaluations
OF_A_POINT = 3  # rounds of stage 1, at least, for the light of a point
FRONT_CELLS, FRONT_NET, FRONT_STEPS = 32, 17, 40  # by which a front is sought of which something is free
SEEN = 2.5  # ray tubes a pixel and side, by which the picture is taken: others than those that tailored the lens
RAYS = 160  # a side, by which light that goes astray is counted
SHAPE = 129  # points a side, at which the thickness is looked at
IMAGE_PLACES = 16  # a side of the back, through each of which the source is seen
SEED = 77  # of those rays


@dataclass(frozen=True)
class Pains:
    """How much work goes into a preview."""

    pixels: int  # of a picture's longer side
    net: int  # control points along the longer side; of small factors, by which cosine transforms are quick
    tubes: int  # a side
    rounds: int  # of stage 1
    evaluations: int  # of stage 2
    blurred: int  # the same of a source of some size, each of which takes twice as long


AT_ONCE = Pains(pixels=72, net=180, tubes=240, rounds=2, evaluations=12, blurred=8)
SETTLED = Pains(pixels=128, net=320, tubes=384, rounds=4, evaluations=50, blurred=30)


class Outdated(Exception):
    """The scene has changed meanwhile: nobody waits for this preview any more."""


@dataclass(frozen=True, eq=False)
class Preview:
    """A lens made small, its light, and the figures of both."""

    scene: Scene  # made small
    lens: Lens
    pictures: tuple[tuple[np.ndarray, np.ndarray], ...]  # of each target (wanted, irradiance), both (rows, columns)
    flux: dict[str, float]  # the ledger of the light; its lines sum to 1
    shape: dict[str, float | None]  # of the lens, by the keys of report.json
    source_images: tuple[float | None, ...]  # mm; width of the source's image on each target; None of a point
    lit: float  # share of the back, up to its rim, through which light of one point of the source passes
    remarks: tuple[str, ...]  # on the scene, and on light that cannot get where it is wanted
    seconds: float = math.nan

    @property
    def rrmsds(self) -> tuple[float, ...]:
        """Of each target, on the pixels of the preview."""
        return tuple(rrmsd(target, picture) for target, picture in self.pictures)


def preview(scene: Scene, pains: Pains = AT_ONCE, outdated: Callable[[], bool] = lambda: False) -> Preview:
    """The preview of a scene.  SceneError where a design would be refused; Outdated once `outdated` says so.

    It depends on the scene alone.  (From the map of a preview before, stage 1 would need a round less, 0.1 s for
    collimated light; but then the picture keeps some of the scene before.)
    """
    began, remarks = time.perf_counter(), list(scene.warnings())
    small = made_small(scene, pains)
    told = _listening(outdated, remarks)
    goals, edge = pipeline.within_reach(small, told)
    knobs = small.tailoring.resolved(small.lens.back.net)
    task = pipeline.posed(small, pipeline.task_of(small, goals, knobs, edge, progress=told, hasty=True))
    lens = small.flat_lens(knobs.levels[0], as_wide_as=knobs.levels[-1])
    *_, last = (step for step in _first_stage(task, lens) if told("stage 1", 0, 0, "") is None)
    pipeline.check_front(last.lens, small)
    lens = small.as_mounted(last.lens)
    bounds = held(lens, task.bounds, task.least)
    if bounds is not None:
        lens = kept(moved_clear(lens, lens.back.z, task.least, bounds), bounds)
    *_, best = (step for step in _second_stage(task, lens) if told("stage 2", 0, 0, "") is None)
    lens = best.lens
    if not front_shaped(lens):
        lens = moved_clear(lens, lens.back.z, task.least, bounds)
    if bounds is not None:
        lens = kept(lens, bounds)
    lens = small.as_mounted(replace(lens.plain(), index=small.index, losses=None))
    found = _lit(small, task, lens)
    if not found.shape["thickness_min"] > 0 or not small.clearance(lens.front.z + found.shape["thickness_max"]) > 0:
        pipeline.check_thickness(lens, small)
    return replace(found, remarks=tuple(remarks), seconds=time.perf_counter() - began)


def _listening(outdated: Callable[[], bool], remarks: list[str]) -> Progress:
    """A progress that raises Outdated, and collects remarks on light that cannot get where it is wanted."""

    def told(stage: str, done: int, total: int, text: str) -> None:
        if outdated():
            raise Outdated
        if stage == "reach":
            remarks.append(text)

    return told


def made_small(scene: Scene, pains: Pains) -> Scene:
    """The scene with the pixels, control points and knobs of a preview; its method is that of this program."""
    several = len(scene.targets) > 1 or scene.wavefront is not None
    share, times = (SEVERAL, TIMES) if several else (1.0, 1)
    most = round(share * pains.net)
    net = scene.lens.back.control_points or most
    if max(both(net)) > most:
        net = coarser(net, most)
    evaluations = times * (pains.evaluations if scene.source.extent is None else pains.blurred)
    changes: dict[str, Any] = dict.fromkeys(f"tailoring.{key}" for key in ("method", "accuracy", "max_time"))
    changes |= {
        "lens.back.control_points": net,
        "tailoring.quality": "draft",
        "tailoring.levels": [coarser(net, COARSE_NET), net] if max(both(net)) > 1.5 * COARSE_NET else None,
        "tailoring.rays": round(share * pains.tubes),
        "tailoring.transport_grid": CELLS,
        "tailoring.stage2_iterations": evaluations,
        "tailoring.rounds": pains.rounds,
    }
    for key, target in zip(scene.target_keys, scene.targets, strict=True):
        factor = max(max(target.columns_rows) / (share * pains.pixels), 1.0)
        changes[f"{key}.pixels"] = target.fewer_pixels(factor)
    return scene.changed(changes)


def _first_stage(task: Task, lens: Lens) -> Iterator[Step]:
    """Stage 1, without the other way that a design tries where the map does not settle."""
    if lens.shaped is not None:
        yield from (step for step in two_faces.steps(task, lens) if step.state is not None)
        return
    lens = task.heaviest.through(lens)
    if task.heaviest.source.kind == "point":
        task = replace(task, knobs=task.knobs.model_copy(update={"rounds": max(OF_A_POINT, task.knobs.rounds)}))
    yield from stage1.follow_slopes(task, _with_front(task, lens) if task.free else lens)


def _with_front(task: Task, lens: Lens) -> Lens:
    """The lens with the front that suits a coarse back best."""
    coarse, goal = lens.refined(coarser(lens.back.shape, FRONT_NET)), task.goals[0]
    shaped = stage1.shaped_front(
        task.heaviest.source, coarse, goal.picture, goal.receiver, free=task.free, rim_sags=task.rim_sags,
        n=FRONT_CELLS, iterations=FRONT_STEPS, repeats=1,
    )  # fmt: skip
    return lens.with_front(shaped.front)


def _second_stage(task: Task, lens: Lens) -> Iterator[Step]:
    """One round of stage 2, or of stage 3 for all of a source of some size; left before anybody judges its lens."""
    whole = stage2.Round(task, task.knobs.rays, task.knobs.stage2_iterations)
    if task.grown:
        light = replace(task, channels=task.grown[-1], grown=(), spreads=task.spreads[-1:])
        whole = replace(whole, task=light, spread=task.spreads[-1], by_images=True)
    for step in stage2.run_rounds([whole], lens):
        if step.ends:
            return
        if step.make:
            yield step
        if step.progress and step.progress[1] >= whole.evaluations:
            return


def _lit(scene: Scene, task: Task, lens: Lens) -> Preview:
    """The preview of a lens: its light by fresh tubes, of a source of some size by its images, and its figures."""
    pictures, channels = [], scene.channels()
    for goal in task.goals:
        light = _picture(channels, task, lens, goal)
        pictures.append((goal.picture, light * (goal.picture.sum() / max(light.sum(), 1e-300))))
    rays = max(round(a_side(channels) * RAYS), 8)
    ledger = simulated(lens, channels, scene.target.screen, n=rays, seed=SEED).flux
    images = [blur(channels, lens, target.screen, target.irradiance(), n=IMAGE_PLACES) for target in scene.targets]
    return Preview(
        scene, lens, tuple(pictures), flux=ledger, shape=describe(lens, SHAPE),
        source_images=tuple(each and each.width for each in images), lit=_lit_share(scene, lens), remarks=(),
    )  # fmt: skip


def _lit_share(scene: Scene, lens: Lens) -> float:
    """The share of the back, up to its rim, through which light of one point of the source passes."""
    x, y = (middle(ends).reshape(-1) for ends in corners(lens.apertures[1], IMAGE_PLACES))
    _, flux = seen_through(scene.channels()[:1], lens, scene.target.screen, IMAGE_PLACES)
    inside = lens.apertures[1].contains(x, y)
    clear = lens.apertures[1].area / lens.outline.area  # of a mount, less than all
    return clear * float((flux[0] > 0)[inside].double().mean())


@torch.no_grad()
def _picture(channels: Sequence[Channel], task: Task, lens: Lens, goal: Goal) -> np.ndarray:
    """(rows, columns) of the light on the receiver of a goal."""
    n = round(SEEN * max(goal.receiver.shape))
    if not task.spreads:
        return tubes_picture(lens, channels, goal.receiver, n).numpy()
    spread = task.spreads[-1]
    merit = Merit.of(spread.centre, lens, n, [goal], overshoot=0.0, spread=spread)
    return merit.picture(0, *merit.landing(lens).on_goals)[0].cpu().numpy().clip(min=0.0)
