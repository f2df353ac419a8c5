"""A pilot: the design of a scene as small as makes sense, by the same steps, to see its RRMSD.

Net, pixels, tubes and cells of the transport are those of the scene over one factor, so that a pixel has the control
cells and the tubes that it has in the scene, light is as scarce where it is, and the search makes as many evaluations.
The pilot does not see detail that is finer than its pixels, which is measured on the picture.  The pilot of a draft,
which is quickly made, is larger: the error after a few evaluations depends on the size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bstcad.analysis.cost import ControlCells, control_cells
from bstcad.optics.lens import Lens
from bstcad.pipeline import check_thickness, reached
from bstcad.scene.quality import Tailoring
from bstcad.scene.scene import Scene
from bstcad.scene.target import FEWEST
from bstcad.tailoring import stage1, stage2
from bstcad.tailoring.run import Task

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
class Flight:
    """The result of a pilot."""

    rrmsd: float
    factor: float  # pixels a side of the scene over those of the pilot
    detail: float  # of the scene's picture, finer than the pilot's pixels
    doubtful: bool  # did stage 1 try the other way as well?


@dataclass(frozen=True)
class Pilot:
    """The pilots of a scene."""

    flights: dict[str, Flight]  # by quality
    cells: ControlCells  # of the scene


def pilot(scene: Scene, lens: Lens) -> Pilot:
    """Of each quality.  lens: a coarse one for the scene, whose front the pilots have.

    SceneError where a design would be refused: no light reaches the target, or the lens would be too thick or too thin.
    """
    flown = {quality: _fly(scene, lens, quality) for quality in SIZES}
    _, finest = flown["standard"]
    return Pilot({quality: flown[by][0] for quality, by in FLOWN.items()}, _cells(scene, finest))


def _fly(scene: Scene, lens: Lens, quality: str) -> tuple[Flight, Lens]:
    """The pilot of a quality, and its lens."""
    small, factor = _small(scene, SIZES[quality])
    target, knobs = small.target, _knobs(scene, small, quality, factor)
    task = Task(
        small.channels(), target.screen, target.irradiance(), knobs, least=small.lens.min_thickness,
        rim_sags=small.rim_sags,
    )  # fmt: skip
    first = list(stage1.steps(task, replace(small.flat_lens(knobs.levels[0]), front=lens.front)))
    *_, state = (step.state for step in first if step.state is not None)
    judged = [step.judged for step in first if step.judged is not None]
    reached(first[-1].lens, judged[-1])
    check_thickness(first[-1].lens, scene)
    *_, last = (step for step in stage2.steps(task, first[-1].lens) if step.judged is not None)
    unseen = detail(scene.target.irradiance(), max(target.columns_rows))
    return Flight(last.judged, factor, unseen, stage1.doubtful(judged[0], state)), last.lens


def detail(picture: np.ndarray, pixels: int) -> float:
    """RMS of the waves of a picture with more half waves over its longer side than so many pixels, over its RMS."""
    from scipy.fft import dctn

    energy = dctn(picture, norm="ortho") ** 2
    half_waves = np.hypot(*np.meshgrid(*(np.arange(n) * max(picture.shape) / n for n in picture.shape), indexing="ij"))
    return float(np.sqrt(energy[half_waves > pixels].sum() / energy.sum()))


def _small(scene: Scene, size: Size) -> tuple[Scene, float]:
    """The scene of a pilot, and the pixels a side of the scene over those of the pilot."""
    m, (columns, rows) = scene.lens.back.control_points, scene.target.columns_rows
    fewest, most = ((m - 1) / (net - 1) for net in (FEWEST_POINTS, size.control_points))
    factor = max(min(max(max(columns, rows) / size.pixels, most), fewest), 1.0)
    less = {"lens.back.control_points": round((m - 1) / factor) + 1, "tailoring.levels": None}
    return scene.changed(less | {"target.pixels": [max(round(n / factor), FEWEST) for n in (columns, rows)]}), factor


def _knobs(scene: Scene, small: Scene, quality: str, factor: float) -> Tailoring:
    of_scene, knobs = (Tailoring(quality=quality).resolved(each.lens.back.control_points) for each in (scene, small))
    cells, tubes = int(np.clip(round(of_scene.transport_grid / factor), *CELLS)), SIZES[quality].tubes
    return knobs.model_copy(update={"rays": min(round(of_scene.rays / factor), tubes), "transport_grid": cells})


def _cells(scene: Scene, lens: Lens) -> ControlCells:
    """Of a net of as many control points as the scene has, by the way that light takes through a pilot's lens."""
    light = max(scene.channels(), key=lambda channel: channel.weight)
    few = control_cells(light, lens.plain(), scene.target.screen, scene.target.irradiance())
    finer = (scene.lens.back.control_points - 2) / (lens.back.m - 2)
    return replace(few, a_pixel=finer**2 * few.a_pixel)
