"""A preview of a scene: the light of its lens after about a second, from a reduced design.

The preview is a design with the effort PREVIEW of the same scene with fewer pixels, control points, flux tubes and
evaluations.  Details finer than its pixels are not shown.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from bstcad.analysis.light import Blur, blur
from bstcad.analysis.shape import describe
from bstcad.designs import pipeline
from bstcad.designs.designed_lens import DesignedLens
from bstcad.manufacture.tolerance.as_made import AsMade, as_made
from bstcad.manufacture.tolerance.lit_by import LitBy, lit_by
from bstcad.optics.lens.lens import Lens
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import rrmsd_of_pictures
from bstcad.optics.surfaces.sides import as_pair, coarser
from bstcad.optics.trace.measure import side_factor, simulated, tubes_picture
from bstcad.optics.trace.source_images import landing_pixels
from bstcad.optics.trace.tubes import corners, middle
from bstcad.scene.scene import Scene
from bstcad.tailoring.driver import Hooks, Progress
from bstcad.tailoring.effort import PREVIEW
from bstcad.tailoring.merit import Merit
from bstcad.tailoring.source_image import ExtendedSource
from bstcad.verify.nominal import Nominal

COARSE_NET = 33  # control points per side in the first rounds of stage 1
TRANSPORT_CELLS = 48  # cells per side of the transport map
GOALS_SIZE_FACTOR = 0.5  # factor on pixels, control points and tubes per side for several targets or a wavefront
GOALS_EVALUATIONS_FACTOR = 3  # factor on the evaluations for several targets or a wavefront
MIN_POINT_ROUNDS = 3  # smallest number of rounds of stage 1 for a point source
TUBES_PER_PIXEL = 2.5  # flux tubes per pixel along each axis for the picture; tailoring uses other tubes
LEDGER_RAYS = 160  # rays per side for the flux ledger; fewer for an extended source
SHAPE_POINTS = 129  # points per side of the lens for the figures of its shape
IMAGE_POINTS = 16  # points per side of the back, for the images of the source and the lit fraction
SEED = 77  # seed of the ledger's rays


@dataclass(frozen=True)
class PreviewSize:
    """Size of a preview's computation."""

    pixels: int  # pixels along the longer side of a picture
    net: int  # control points along the longer side; small prime factors make the cosine transforms fast
    tubes: int  # flux tubes per side
    rounds: int  # rounds of stage 1
    evaluations: int  # evaluations of stage 2, for a point source or parallel light
    blurred: int  # evaluations of stage 3, for an extended source; each takes twice the time


QUICK = PreviewSize(pixels=72, net=180, tubes=240, rounds=2, evaluations=12, blurred=8)  # first preview
REFINED = PreviewSize(pixels=128, net=320, tubes=384, rounds=4, evaluations=50, blurred=30)  # second, finer preview


class Outdated(Exception):
    """The preview is no longer needed, since the scene has changed."""


@dataclass(frozen=True, eq=False)
class Preview(Nominal):
    """Reduced design of a scene, its light, and their figures."""

    pictures: tuple[tuple[np.ndarray, np.ndarray], ...]  # (target, irradiance) per target, each (rows, columns)
    flux: dict[str, float]  # ledger of the light: fractions that sum to 1
    shape: dict[str, float | None]  # shape of the lens, by the keys of report.json
    source_images: tuple[Blur | None, ...]  # image of the source on each target; None: the source has no size
    lit_fraction: float  # fraction of the back's area, up to the rim, that one point of the source lights
    remarks: tuple[str, ...] = ()  # warnings of the scene, and remarks on light that cannot reach the target
    seconds: float = math.nan  # time of the preview (s)

    @property
    def rrmsds(self) -> tuple[float, ...]:
        """RRMSD on each target, on the pixels of the preview."""
        return tuple(rrmsd_of_pictures(target, picture) for target, picture in self.pictures)

    def as_made(self, grade: str | None = None, layer_height: float | None = None) -> AsMade:
        """Return the pictures of the lens as made by a grade (None: that of the scene); see tolerance.as_made."""
        return as_made(self, grade, layer_height)

    def lit_by(self, light: str, distance: float | None = None) -> LitBy:
        """Return the pictures of the lens in another light; see tolerance.lit_by."""
        return lit_by(self, light, distance)


def preview(scene: Scene, size: PreviewSize = QUICK, outdated: Callable[[], bool] = lambda: False) -> Preview:
    """Return the preview of a scene, which does not depend on earlier previews.

    SceneError if a design of the scene would be refused; Outdated once `outdated` returns True.
    """
    began, remarks = time.perf_counter(), list(scene.warnings())
    small = reduced_scene(scene, size)
    hooks = Hooks(progress=_progress(outdated, remarks))
    made = pipeline.design(small, hooks=hooks, options=pipeline.DesignOptions(compare_later=True, effort=PREVIEW))
    return replace(_evaluate(small, made), remarks=tuple(remarks), seconds=time.perf_counter() - began)


def _progress(outdated: Callable[[], bool], remarks: list[str]) -> Progress:
    """Return a progress function that raises Outdated and collects remarks on light that cannot reach the target."""

    def report(stage: str, done: int, total: int, text: str) -> None:
        if outdated():
            raise Outdated
        if stage == "reach":
            remarks.append(text)

    return report


def reduced_scene(scene: Scene, size: PreviewSize) -> Scene:
    """Return the scene with the pixels, control points and tailoring settings of a preview, and the default method."""
    several = len(scene.targets) > 1 or scene.wavefront is not None
    size_factor, evaluations_factor = (GOALS_SIZE_FACTOR, GOALS_EVALUATIONS_FACTOR) if several else (1.0, 1)
    max_net = max(round(size_factor * size.net), scene.lens.back.fewest_points)
    net = scene.lens.back.control_points or max_net
    if max(as_pair(net)) > max_net:
        net = coarser(net, max_net)
    evaluations = evaluations_factor * (size.evaluations if scene.source.extent is None else size.blurred)
    changes: dict[str, Any] = dict.fromkeys(f"tailoring.{key}" for key in ("method", "accuracy", "max_time"))
    changes |= {
        "lens.back.control_points": net,
        "tailoring.quality": "draft",
        "tailoring.levels": [coarser(net, COARSE_NET), net] if max(as_pair(net)) > 1.5 * COARSE_NET else None,
        "tailoring.rays": round(size_factor * size.tubes),
        "tailoring.transport_grid": TRANSPORT_CELLS,
        "tailoring.stage2_iterations": evaluations,
        "tailoring.rounds": max(size.rounds, 0 if scene.source.parallel else MIN_POINT_ROUNDS),
    }
    for key, target in zip(scene.target_keys, scene.targets, strict=True):
        factor = max(max(target.columns_rows) / (size_factor * size.pixels), 1.0)
        changes[f"{key}.pixels"] = target.fewer_pixels(factor)
    return scene.changed(changes)


def _evaluate(scene: Scene, made: DesignedLens) -> Preview:
    """Return the preview of a lens: figures, and its light by flux tubes that its design did not use."""
    pictures, channels, lens = [], scene.channels(), made.lens
    for goal in made.goals:
        found = _picture(scene, lens, goal)
        pictures.append((goal.picture, found * (goal.picture.sum() / max(found.sum(), 1e-300))))
    rays = max(round(side_factor(channels) * LEDGER_RAYS), 8)
    [light] = simulated(lens, channels, [scene.target.screen], n=rays, seed=SEED)
    images = [blur(channels, lens, target.screen, target.irradiance(), n=IMAGE_POINTS) for target in scene.targets]
    shape, lit = describe(lens, SHAPE_POINTS), _lit_fraction(scene, lens)
    return Preview(
        scene, lens, made.goals, tuple(pictures), flux=light.flux, shape=shape, source_images=tuple(images),
        lit_fraction=lit,
    )  # fmt: skip


def _lit_fraction(scene: Scene, lens: Lens) -> float:
    """Return the fraction of the back's area, up to the rim, that one point of the source lights."""
    x, y = (middle(ends).reshape(-1) for ends in corners(lens.apertures[1], IMAGE_POINTS))
    _, flux = landing_pixels(scene.channels()[:1], lens, scene.target.screen, IMAGE_POINTS)
    inside = lens.apertures[1].contains(x, y)
    clear = lens.apertures[1].area / lens.outline.area  # below 1 with a mount
    return clear * float((flux[0] > 0)[inside].double().mean())


@torch.no_grad()
def _picture(scene: Scene, lens: Lens, goal: Goal) -> np.ndarray:
    n = round(TUBES_PER_PIXEL * max(goal.screen.shape))
    if (
        scene.source.extent is None or scene.sampler is None
    ):  # a point source; otherwise the picture is blurred with images of the source
        return tubes_picture(lens, scene.channels(), goal.screen, n).numpy()
    source = ExtendedSource(scene.light, scene.with_source_scaled(0.0).channels(), scene.sampler)
    merit = Merit.of(source.centre, lens, n, [goal], overshoot=0.0).with_blur(source, lens)
    return merit.picture(0, *merit.landing(lens).on_goals)[0].cpu().numpy().clip(min=0.0)
