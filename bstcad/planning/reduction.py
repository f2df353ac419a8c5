"""Reductions of a scene: smaller designs for a preview, for a prediction, and for estimates of neglected effects.

A preview has sizes of its own, so that it takes a second whatever the scene; details finer than its pixels are not
shown.  A pilot has the pixels and the control points of the scene, per side, divided by one factor.  A coarse lens,
which has nearly the rays of the finished lens, is made by transport and slope fits alone (effect_estimates.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bstcad.optics.surfaces.sides import Sides, as_pair, coarser
from bstcad.scene.scene import Scene
from bstcad.tailoring.effort import BRIEF, PREVIEW, TailoringEffort

COARSE_NET = 33  # control points per side in the first rounds of stage 1 of a preview
GOALS_SIZE_FACTOR = 0.5  # factor on pixels, control points and tubes per side for several targets or a wavefront
GOALS_EVALUATIONS_FACTOR = 3  # factor on the evaluations for several targets or a wavefront
MIN_POINT_ROUNDS = 3  # smallest number of rounds of stage 1 for a point source
MIN_PILOT_SIDE = 16  # minimum tubes, and cells of the transport map, per side of a pilot


@dataclass(frozen=True)
class Reduction:
    """Sizes of a smaller design of a scene."""

    pixels: int  # largest number of pixels along the longer side of a picture
    net: int  # largest number of control points along the longer side of the back
    cells: int  # cells per side of the transport map; of a pilot the largest number
    tubes: int = 0  # flux tubes per side; of a pilot the largest number
    rounds: int = 0  # rounds of stage 1; of a pilot the largest number, 0: those of the scene
    evaluations: int = 0  # evaluations of stage 2, for a point source or parallel light; of a pilot the fewest
    blurred: int = 0  # evaluations of stage 3, for an extended source; each takes twice the time
    fewest_points: int = 2  # control points per side that a pilot has at least, unless its scene has fewer
    effort: TailoringEffort = PREVIEW  # effort of tailoring


# Sizes of the first preview, whose net has small prime factors, for fast cosine transforms, and of the finer preview.
QUICK = Reduction(pixels=72, net=180, tubes=240, cells=48, rounds=2, evaluations=12, blurred=8)
REFINED = Reduction(pixels=128, net=320, tubes=384, cells=48, rounds=4, evaluations=50, blurred=30)
# Sizes of a pilot, whose pixels may be more with `fewest_points`, and of a coarse lens.
PILOT = Reduction(pixels=128, net=193, cells=96, tubes=384, rounds=4, evaluations=30, fewest_points=65, effort=BRIEF)
COARSE = Reduction(pixels=64, net=33, cells=32, rounds=2)


def reduced_scene(scene: Scene, size: Reduction) -> Scene:
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
        "tailoring.transport_grid": size.cells,
        "tailoring.stage2_iterations": evaluations,
        "tailoring.rounds": max(size.rounds, 0 if scene.source.parallel else MIN_POINT_ROUNDS),
    }
    factors = [max(max(target.columns_rows) / (size_factor * size.pixels), 1.0) for target in scene.targets]
    return scene.changed(changes | _fewer_pixels(scene, factors))


def pilot_scene(scene: Scene, size: Reduction = PILOT) -> tuple[Scene, float]:
    """Return the scene of a pilot, and the ratio of the pixels per side of the full scene to those of the pilot."""
    net = scene.lens.back.net
    settings, spans = scene.tailoring.resolved(net), max(as_pair(net)) - 1
    widest = max(max(target.columns_rows) for target in scene.targets)
    least = max(widest / size.pixels, spans / (size.net - 1))
    factor = max(min(least, spans / (size.fewest_points - 1)), 1.0)
    changes: dict[str, Any] = {
        "tailoring.rays": max(min(round(settings.rays / factor), size.tubes), MIN_PILOT_SIDE),
        "tailoring.transport_grid": int(np.clip(round(settings.transport_grid / factor), MIN_PILOT_SIDE, size.cells)),
        "tailoring.rounds": min(settings.rounds, size.rounds or settings.rounds),
    }
    changes |= _fewer_pixels(scene, [factor] * len(scene.targets))
    return replace_net(scene, coarser(net, round(spans / factor) + 1), changes), factor


def _fewer_pixels(scene: Scene, factors: list[float]) -> dict[str, Any]:
    """Return the changes of a scene by which each target has fewer pixels per side, by its factor."""
    targets = zip(scene.target_keys, scene.targets, factors, strict=True)
    return {f"{key}.pixels": target.fewer_pixels(factor) for key, target, factor in targets}


def with_quality(scene: Scene, quality: str) -> Scene:
    """Return the scene in another quality, without limits that end a design early; all other settings remain."""
    return scene.changed({"tailoring.quality": quality, "tailoring.accuracy": None, "tailoring.max_time": None})


def replace_net(scene: Scene, net: Sides, changes: Mapping[str, object] = {}) -> Scene:
    """Return the scene with another net of the back, a freeform front's net in proportion, and `changes` by key."""
    nets = {"lens.back.control_points": net, "tailoring.levels": None}
    if scene.lens.front.is_tailored and scene.lens.front.control_points is not None:
        nets["lens.front.control_points"] = scene.lens.front_net(net)
    return scene.changed({**nets, **changes})
