"""A pilot: the design of a scene as small as makes sense, by the same steps, to see what RRMSD it comes to.

Net, pixels, tubes and cells of the transport are those of the scene over one factor, so that a pixel has the control
cells and the tubes that it has in the scene, light is as scarce where it is, and the search makes as many evaluations.
What the picture has that is finer than the pilot's pixels it does not see: that is told apart (`detail`).  A draft is
quickly made, so that its pilot can be larger: what its few evaluations leave depends on the size.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch

from bstcad.analysis.control_cells import ControlCells, control_cells
from bstcad.optics.lens import Lens
from bstcad.pipeline import check_thickness, reached
from bstcad.scene.limits import rim_sags
from bstcad.scene.quality import Tailoring
from bstcad.scene.scene import Scene
from bstcad.scene.target import FEWEST
from bstcad.tailoring import stage1, stage2
from bstcad.tailoring.blank import blank
from bstcad.tailoring.run import Step, Task

QUALITIES = ("draft", "standard", "fine")
FLOWN = {"draft": "draft", "standard": "standard", "fine": "standard"}  # by which pilot each goes; a fine one is dear
FEWEST_POINTS = 65  # control points a side
CELLS = (16, 256)  # a side of its transport, at least and at most


@dataclass(frozen=True)
class Size:
    """The most that a pilot has along each side."""

    pixels: int  # or more, where the control points would be fewer than FEWEST_POINTS
    control_points: int
    tubes: int


SIZES = {"draft": Size(256, 385, 768), "standard": Size(128, 193, 512)}


@dataclass(frozen=True)
class Found:
    """What the pilot of a quality came to."""

    rrmsd: float
    factor: float  # times as many pixels and control points a side has the scene
    detail: float  # what of the scene's picture is finer than the pilot's pixels
    doubtful: bool  # did stage 1 try the other way as well?


@dataclass(frozen=True)
class Pilot:
    """What the pilots of a scene came to."""

    found: dict[str, Found]  # by quality
    cells: ControlCells  # of the scene


def pilot(scene: Scene, lens: Lens) -> Pilot:
    """Of each quality.  lens: a coarse one for the scene, with the front that they have.

    SceneError where a design would be refused: no light reaches the target, or the lens would be too thick or too thin.
    """
    flown = {quality: _flown(scene, lens, quality) for quality in SIZES}
    _, finest = flown["standard"]
    return Pilot({quality: flown[by][0] for quality, by in FLOWN.items()}, _cells(scene, finest))


def _flown(scene: Scene, lens: Lens, quality: str) -> tuple[Found, Lens]:
    """What the pilot of a quality comes to, and its lens."""
    small, factor = _small(scene, SIZES[quality])
    task = _task(small, _knobs(scene, small, quality, factor))
    begun = replace(blank(small, task.knobs.levels[0], torch.float64, "cpu"), front=lens.front)
    first = list(stage1.steps(task, begun))
    *_, state = (step.state for step in first if step.state is not None)
    judged = [step.judged for step in first if step.judged is not None]
    reached(first[-1].lens, judged[-1])
    check_thickness(first[-1].lens, scene)
    last = _last(stage2.steps(task, first[-1].lens))
    unseen = detail(scene.target.irradiance(), max(small.target.columns_rows))
    return Found(last.judged, factor, unseen, stage1.doubtful(judged[0], state)), last.lens


def detail(picture: np.ndarray, pixels: int) -> float:
    """RMS of what in a picture has more half waves over its longer side than so many pixels, relative to its RMS."""
    from scipy.fft import dctn

    energy = dctn(picture, norm="ortho") ** 2
    half_waves = np.hypot(*np.meshgrid(*(np.arange(n) * max(picture.shape) / n for n in picture.shape), indexing="ij"))
    return float(np.sqrt(energy[half_waves > pixels].sum() / energy.sum()))


def _small(scene: Scene, size: Size) -> tuple[Scene, float]:
    """The scene of a pilot, and how many times as many pixels a side it has itself."""
    m, (columns, rows) = scene.lens.back.control_points, scene.target.columns_rows
    fewest, most = ((m - 1) / (net - 1) for net in (FEWEST_POINTS, size.control_points))
    factor = max(min(max(max(columns, rows) / size.pixels, most), fewest), 1.0)
    less = {"lens.back.control_points": round((m - 1) / factor) + 1}
    less["target.pixels"] = [max(round(side / factor), FEWEST) for side in (columns, rows)]
    return scene.changed(less | {"tailoring.levels": None}), factor


def _knobs(scene: Scene, small: Scene, quality: str, factor: float) -> Tailoring:
    of_scene, knobs = (Tailoring(quality=quality).resolved(each.lens.back.control_points) for each in (scene, small))
    cells, tubes = int(np.clip(round(of_scene.transport_grid / factor), *CELLS)), SIZES[quality].tubes
    return knobs.model_copy(update={"rays": min(round(of_scene.rays / factor), tubes), "transport_grid": cells})


def _task(small: Scene, knobs: Tailoring) -> Task:
    target, least = small.target, small.lens.min_thickness
    return Task(small.channels(), target.screen, target.irradiance(), knobs, least, rim_sags=rim_sags(small))


def _cells(scene: Scene, lens: Lens) -> ControlCells:
    """Of a net of as many control points as the scene has, by the way that light takes through a pilot's lens."""
    light = max(scene.channels(), key=lambda channel: channel.weight)
    few = control_cells(light, lens.plain(), scene.target.screen, scene.target.irradiance())
    finer = (scene.lens.back.control_points - 2) / (lens.back.m - 2)
    return replace(few, a_pixel=finer**2 * few.a_pixel)


def _last(steps: Iterable[Step]) -> Step:
    """The last step that was judged."""
    return [step for step in steps if step.judged is not None][-1]
