"""The picture of a part as it is made: layers or tool marks, roughness and form error of a grade of manufacture.

The designed lens gets one random form error of the grade (grades.py).  Its faces are then smoothed, and flux tubes
trace their layers and tool marks (optics.trace.finish).  The roughness scatters the light of the picture
(analysis.scattering).
Errors of mounting and light are not included: `study` has them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from bstcad.analysis.neglected_effects import difference
from bstcad.analysis.scattering import Scatter
from bstcad.manufacture.tolerance.grades import GRADES, base_grade, finish_of, form_of, graded_table
from bstcad.manufacture.tolerance.perturbations import Setup, form_error
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel, weighted_sum
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import rrmsd_of_pictures
from bstcad.optics.trace.finish import Finish, finished_pictures
from bstcad.optics.trace.unfolding import per_radian
from bstcad.scene.quality import Tolerance
from bstcad.tailoring.source_image import BlurOperator, ExtendedSource, blurred, blurs, with_border
from bstcad.verify.nominal import Nominal

TUBES_PER_PIXEL = 2.5  # flux tubes per pixel along each axis
MAX_TUBES = 640  # largest number of tubes per side
EVEN = 1e-12  # largest variance / mean square at which a target counts as even
FORM_SEED = 0  # seed of the form error
LAYERS, MARKS, ROUGHNESS, FORM_ERROR = "layers", "tool marks", "roughness", "form"  # effects of making


@dataclass(frozen=True, eq=False)
class GoalAsMade:
    """Light on one target as designed and as made; pictures (rows, columns) with the sum of the target."""

    key: str  # key of the target
    target: np.ndarray
    designed: np.ndarray  # picture of the lens as designed
    made: np.ndarray  # picture of the part as made
    light_designed: float  # fraction of the source's light on the target, as designed
    light: float  # fraction of the source's light on the target, as made
    changes: dict[str, float]  # relative RMS change of the picture by each effect alone, the largest first
    blur: float  # RMS shift of scattered light along each axis, in the unit of the target
    unit: str  # unit of the target

    @property
    def rrmsds(self) -> tuple[float, float]:
        """RRMSD as designed and as made."""
        return rrmsd_of_pictures(self.target, self.designed), rrmsd_of_pictures(self.target, self.made)

    @property
    def contrasts(self) -> tuple[float | None, float | None]:
        """Contrast (see `contrast`) as designed and as made."""
        return contrast(self.target, self.designed), contrast(self.target, self.made)

    def facts(self) -> dict[str, Any]:
        """Return the figures without the pictures, for JSON."""
        (designed, made), (wanted, kept) = self.rrmsds, self.contrasts
        figures = {"rrmsd_designed": designed, "rrmsd": made, "contrast_designed": wanted, "contrast": kept}
        light = {"light_designed": self.light_designed, "light": self.light}
        return {"key": self.key, **figures, **light, "changes": self.changes, "blur": self.blur, "unit": self.unit}


@dataclass(frozen=True, eq=False)
class AsMade:
    """Prediction for a part of a grade."""

    grade: str  # name of the grade
    words: str  # description of the grade
    finish: Finish
    scattered: float  # fraction of the light that roughness scatters, at the main wavelength
    scatter_angle: float  # RMS angle of this light along each axis, degrees
    goals: tuple[GoalAsMade, ...]

    def facts(self) -> dict[str, Any]:
        """Return the entry `made` of `plan --json`."""
        goals = [goal.facts() for goal in self.goals]
        head = {"grade": self.grade, "words": self.words, "finish": asdict(self.finish)}
        return head | {"scattered": self.scattered, "scatter_angle": self.scatter_angle, "goals": goals}


def contrast(target: np.ndarray, picture: np.ndarray) -> float | None:
    """Return the factor c of the target's contrast in a picture E of equal sum, fitted by least squares.

    E - Ē = c (T - T̄) + rest, hence c = Σ (E - Ē)(T - T̄) / Σ (T - T̄)²: 1 for the target, 0 for even light.  None: the
    target T is even.
    """
    wanted = target - target.mean()
    size = float(np.sum(wanted * wanted))
    if size <= EVEN * float(np.sum(target * target)):
        return None
    return float(np.sum((picture - picture.mean()) * wanted)) / size


def as_made(design: Nominal, grade: str | None = None, layer_height: float | None = None) -> AsMade:
    """Predict the pictures of a design as made, with the [[tolerance]] tables of its scene.

    grade: grade that replaces that of the scene.  layer_height: height of the layers (mm) that replaces that of the
    grade.  SceneError if the grade is unknown.
    """
    table, lens, goals = graded_table(design.scene.tolerance, grade), design.lens, design.goals
    if layer_height is not None:
        table = (*table, Tolerance(layer_height=layer_height))
    name, finish = base_grade(table), finish_of(table)
    light = SceneLight.of(design)
    formed = _with_form_error(lens, light, table)
    plain = replace(finish, layer_height=None, ripple=0.0, smoothing_length=0.0, roughness=0.0)
    marks = replace(finish, roughness=0.0)
    rough = replace(plain, roughness=finish.roughness, roughness_length=finish.roughness_length)
    marked = MARKS if finish.layer_height is None else LAYERS
    designed, made = light.pictures(lens, plain), light.pictures(formed, finish)
    alone = {
        marked: light.pictures(lens, marks),
        ROUGHNESS: light.pictures(lens, rough),
        FORM_ERROR: light.pictures(formed, plain),
    }
    scatter = Scatter.of(lens, finish, design.emitter.main_wavelength)
    found = []
    for k, goal in enumerate(goals):
        before, after = designed[k], made[k]
        changes = {effect: difference(pictures[k], before) for effect, pictures in alone.items()}
        ordered = dict(sorted(changes.items(), key=lambda item: -item[1]))
        blur = scatter.angle * abs(per_radian(lens, goal.screen))
        of_target = goal.picture.sum()
        found.append(
            GoalAsMade(
                goal.key,
                goal.picture,
                scaled(before, of_target),
                scaled(after, of_target),
                light_designed=float(before.sum()),
                light=float(after.sum()),
                changes=ordered,
                blur=blur,
                unit=goal.screen.receiver.unit,
            )  # fmt: skip
        )
    words = GRADES[name].words if name in GRADES else "as stated in the scene"
    return AsMade(name, words, finish, scatter.fraction, scatter_angle=math.degrees(scatter.angle), goals=tuple(found))


@dataclass(frozen=True)
class SceneLight:
    """Light of a scene on its targets; that of an extended source is the light of its centre, blurred."""

    channels: tuple[Channel, ...]  # light of a point source or of the centre of an extended source
    goals: tuple[Goal, ...]
    blurs: tuple[tuple[BlurOperator, ...], ...]  # blurs by the extended source, by goal and channel; (): a point source

    @classmethod
    def of(cls, design: Nominal) -> SceneLight:
        """Return the light of a design's scene; images of the source by the designed lens blur the pictures."""
        scene, goals = design.scene, design.goals
        sampler = scene.sampler  # None: a point source or a parallel beam
        if scene.source.extent is None or sampler is None:
            return cls(scene.channels(), goals, ())
        source = ExtendedSource(design.emitter, scene.with_source_scaled(0.0).channels(), sampler)
        lens = design.lens.plain()
        return cls(source.centre, goals, tuple(blurs(source, lens, goal.screen) for goal in goals))

    def pictures(self, lens: Lens, finish: Finish) -> list[np.ndarray]:
        """Return flux per pixel (rows, columns) / flux of the source, on each target, for a lens with a finish."""
        screens = [goal.screen for goal in self.goals]
        pixels = max(max(screen.shape) for screen in screens)
        if self.blurs:
            screens = [with_border(screen, blur[0].border) for screen, blur in zip(screens, self.blurs, strict=True)]
        tubes = round(min(MAX_TUBES, TUBES_PER_PIXEL * pixels))
        found = finished_pictures(lens, self.channels, screens, finish, tubes=tubes)
        return [self._picture(k, [each[k] for each in found], lens, finish) for k in range(len(self.goals))]

    def _picture(self, k: int, found: Sequence[Tensor], lens: Lens, finish: Finish) -> np.ndarray:
        """Return the picture of goal k from the light of each channel, blurred by the source and by roughness."""
        receiver = self.goals[k].screen
        shift, (columns, rows) = per_radian(lens, receiver), receiver.per_unit
        parts = []
        for j, channel in enumerate(self.channels):
            picture = (blurred(found[j], self.blurs[k][j]) if self.blurs else found[j]).numpy().clip(min=0.0)
            if finish.roughness > 0:
                scatter = Scatter.of(channel.through(lens), finish, channel.source.main_wavelength)
                picture = scatter.blurred(picture, (shift * columns, shift * rows))
            parts.append(picture)
        return np.asarray(weighted_sum(self.channels, parts))


def _with_form_error(lens: Lens, light: SceneLight, table: Sequence[Tolerance]) -> Lens:
    """Return the lens with one random form error on its back, whose RMS is the limit of back.form."""
    form = form_of(table, lens)
    if form is None:
        return lens
    size, length = form
    try:
        kind = form_error(lens, length, FORM_SEED)
    except ValueError:  # the net is too coarse for the correlation length
        return lens
    return kind.apply(Setup(lens, light.channels, light.goals[0].screen), size).lens


def scaled(picture: np.ndarray, size: float) -> np.ndarray:
    """Return the picture scaled to the sum `size`; a dark picture stays dark."""
    return picture * (size / picture.sum()) if picture.sum() > 0 else picture
