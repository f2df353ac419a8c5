"""A preview of a scene: the light that its lens will throw, in about a second, by the steps of a design made small.

The preview is a hasty design (`Task.hasty`) of the same scene with fewer pixels, control points, ray tubes and
evaluations, so that a pixel has as many control cells and tubes as it has in a draft.  It shows no detail that is finer
than its pixels.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from bstcad import pipeline
from bstcad.analysis.light import Blur, blur
from bstcad.analysis.shape import describe
from bstcad.folder import Made
from bstcad.optics.goal import Goal
from bstcad.optics.lens import Lens
from bstcad.optics.measure import landing_pixels, side_factor, simulated, tubes_picture
from bstcad.optics.sides import as_pair, coarser
from bstcad.optics.tubes import corners, middle
from bstcad.report.light_figures import rrmsd
from bstcad.scene.scene import Scene
from bstcad.tailoring.merit import Merit
from bstcad.tailoring.run import Progress
from bstcad.tailoring.source_image import Spread

COARSE_NET = 33  # of the first rounds of stage 1
CELLS = 48  # of the transport, a side
SEVERAL, TIMES = 0.5, 3  # of several goals: each of these times this, and times the evaluations
OF_A_POINT = 3  # rounds of stage 1, at least, for the light of a point
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
    source_images: tuple[Blur | None, ...]  # the source's image on each target; None of a point
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
    made = pipeline.design(small, progress=_listening(outdated, remarks), later=True, hasty=True)
    return replace(_lit(small, made), remarks=tuple(remarks), seconds=time.perf_counter() - began)


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
    if max(as_pair(net)) > most:
        net = coarser(net, most)
    evaluations = times * (pains.evaluations if scene.source.extent is None else pains.blurred)
    changes: dict[str, Any] = dict.fromkeys(f"tailoring.{key}" for key in ("method", "accuracy", "max_time"))
    changes |= {
        "lens.back.control_points": net,
        "tailoring.quality": "draft",
        "tailoring.levels": [coarser(net, COARSE_NET), net] if max(as_pair(net)) > 1.5 * COARSE_NET else None,
        "tailoring.rays": round(share * pains.tubes),
        "tailoring.transport_grid": CELLS,
        "tailoring.stage2_iterations": evaluations,
        "tailoring.rounds": max(pains.rounds, 0 if scene.source.parallel else OF_A_POINT),
    }
    for key, target in zip(scene.target_keys, scene.targets, strict=True):
        factor = max(max(target.columns_rows) / (share * pains.pixels), 1.0)
        changes[f"{key}.pixels"] = target.fewer_pixels(factor)
    return scene.changed(changes)


def _lit(scene: Scene, made: Made) -> Preview:
    """The preview of a lens: its light by fresh tubes, of a source of some size by its images, and its figures."""
    pictures, channels, lens = [], scene.channels(), made.lens
    for goal in made.goals:
        light = _picture(scene, lens, goal)
        pictures.append((goal.picture, light * (goal.picture.sum() / max(light.sum(), 1e-300))))
    rays = max(round(side_factor(channels) * RAYS), 8)
    ledger = simulated(lens, channels, scene.target.screen, n=rays, seed=SEED).flux
    images = [blur(channels, lens, target.screen, target.irradiance(), n=IMAGE_PLACES) for target in scene.targets]
    return Preview(
        scene, lens, tuple(pictures), flux=ledger, shape=describe(lens, SHAPE),
        source_images=tuple(images), lit=_lit_share(scene, lens), remarks=(),
    )  # fmt: skip


def _lit_share(scene: Scene, lens: Lens) -> float:
    """The share of the back, up to its rim, through which light of one point of the source passes."""
    x, y = (middle(ends).reshape(-1) for ends in corners(lens.apertures[1], IMAGE_PLACES))
    _, flux = landing_pixels(scene.channels()[:1], lens, scene.target.screen, IMAGE_PLACES)
    inside = lens.apertures[1].contains(x, y)
    clear = lens.apertures[1].area / lens.outline.area  # of a mount, less than all
    return clear * float((flux[0] > 0)[inside].double().mean())


@torch.no_grad()
def _picture(scene: Scene, lens: Lens, goal: Goal) -> np.ndarray:
    """(rows, columns) of the light on the receiver of a goal."""
    n = round(SEEN * max(goal.receiver.shape))
    if not scene.source.extent:
        return tubes_picture(lens, scene.channels(), goal.receiver, n).numpy()
    spread = Spread(scene.source, scene.with_source_scaled(0.0).channels(), scene.draw)
    merit = Merit.of(spread.centre, lens, n, [goal], overshoot=0.0, spread=spread)
    return merit.picture(0, *merit.landing(lens).on_goals)[0].cpu().numpy().clip(min=0.0)
