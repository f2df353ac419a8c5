"""The nominal design: a scene, the lens that was designed for it, and the light of a lens like it on the goals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from bstcad.analysis.far_field import FarField, grid_of
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.trace.measure import FULL, Effort, Light, measure_goals
from bstcad.scene.real_source import image_diameters, real_size
from bstcad.scene.scene import Scene
from bstcad.scene.target import AngularTarget

DEFAULT_RRMSD_LIMIT = 0.25  # limit of the RRMSD in remarks, plans and tolerance studies if accept.rrmsd is not set
DRAFT_ACCURACY = 0.01  # relative standard error of the RRMSD at which ray tracing ends, for draft quality


@dataclass(frozen=True)
class Nominal:
    """A design as its scene and its lens state it, to be compared with what was written or made."""

    scene: Scene
    lens: Lens  # designed lens, float64
    goals: tuple[Goal, ...]  # goals with the pictures of the scene
    # pictures of the goals in design.npz, (rows, columns); None: those of `goals`
    stored: tuple[np.ndarray, ...] | None = field(default=None, kw_only=True)
    # for each goal, the irradiance (rows, columns) in design.npz, None if it has none, and its error, NaN if not
    # stated; (): no design.npz was read
    lit: tuple[tuple[np.ndarray | None, float], ...] = field(default=(), kw_only=True)

    @cached_property
    def channels(self) -> tuple[Channel, ...]:
        """Channels of the scene's light; their points on an extended source are not the points used in tailoring."""
        return self.scene.verification_channels()

    @cached_property
    def far_field(self) -> FarField:
        """Light of the scene for the intensity behind the lens, on the grid of an intensity as the first target."""
        scene, target = self.scene, self.scene.target
        wanted = target.intensity if isinstance(target, AngularTarget) else None
        return FarField(
            self.channels, scene.source.luminous_flux, ghost=scene.ghost, sampler=scene.sampler,
            grid=None if wanted is None else grid_of(wanted.table),
        )  # fmt: skip

    @property
    def has_far_field(self) -> bool:
        """True for a target over directions or a known luminous flux, if no mirror turns the light back."""
        angular = any(isinstance(target, AngularTarget) for target in self.scene.targets)
        return (angular or self.scene.source.luminous_flux is not None) and not self.scene.light_path.is_folded

    @property
    def emitter(self) -> Emitter:
        """Source of the scene, for a dome by the points of a sphere about its centre."""
        return self.scene.light

    @property
    def heaviest(self) -> Channel:
        """Channel with the largest weight, whose wavelength is the unit of wavefront errors."""
        return max(self.channels, key=lambda channel: channel.weight)

    def effort(self, given: Effort | None = None) -> Effort:
        """Return the effort of measuring this design, smaller for a draft; given: upper limit (None: FULL)."""
        given, tailoring = given or FULL, self.scene.tailoring
        accuracy = DRAFT_ACCURACY if tailoring.quality == "draft" else FULL.accuracy
        return replace(given, seed=tailoring.seed, accuracy=max(given.accuracy, accuracy))

    def light(self, lens: Lens, goal: Goal, effort: Effort) -> Light:
        """Return the light of a lens on a target."""
        [light] = self.lights(lens, [goal], effort)
        return light

    def lights(self, lens: Lens, goals: Sequence[Goal], effort: Effort) -> list[Light]:
        """Return the light of a lens on each target, by the same rays."""
        images = self._source_images(lens, goals) if effort.cells > 1 else ()
        ghost, sampler = self.scene.ghost, self.scene.sampler
        return measure_goals(lens, self.channels, goals, effort, ghost=ghost, sampler=sampler, images=images)

    def _source_images(self, lens: Lens, goals: Sequence[Goal]) -> Sequence[float]:
        """Return the diameter (pixels) of the image of the real source on each target; () if its size is simulated."""
        if (size := real_size(self.scene.source)) is None:
            return ()
        centre = replace(self.heaviest, source=self.heaviest.source.central, weight=1.0)
        return image_diameters(size, centre, lens, [goal.screen for goal in goals])
