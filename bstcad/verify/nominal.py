"""The nominal design: a scene, the lens that was designed for it, and the light of a lens like it on the goals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.trace.measure import FULL, Effort, Light, measure_goals
from bstcad.scene.real_source import image_diameters, real_size
from bstcad.scene.scene import Scene

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
