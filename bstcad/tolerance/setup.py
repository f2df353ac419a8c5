"""A lens as it stands: its shape, the light that comes to it, and the screen, all in the lens's own frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.measure import tubes_picture
from bstcad.optics.motion import Motion, moved_screen, moved_source
from bstcad.optics.planes import Vector
from bstcad.optics.sources import Source
from bstcad.optics.surfaces import Surface


@dataclass(frozen=True)
class Setup:
    """What is traced; lengths in mm."""

    lens: Lens
    channels: tuple[Channel, ...]
    screen: Screen

    @property
    def middle(self) -> Vector:
        """The point of the lens about which it tilts: on the axis, half way between its faces' vertices."""
        back = float(self.lens.back.plain().from_vertex().z)
        return 0.0, 0.0, back if self.lens.reflects else (self.lens.front.z + back) / 2

    @property
    def foot(self) -> Vector:
        """The point of the source about which it tilts: the mean of its points, or of an aperture its middle."""
        known = [_place(channel.source, self.lens.entrance.z) for channel in self.channels]
        weights = [channel.weight for channel in self.channels]
        return tuple(float(np.average([place[k] for place in known], weights=weights)) for k in range(3))

    def picture(self, tubes: int) -> np.ndarray:
        """(rows, columns) flux in each pixel of the screen, row 0 = y max, by tubes x tubes a channel."""
        return tubes_picture(self.lens, self.channels, self.screen, tubes, over_the_back=True).cpu().numpy()

    def with_sources(self, change: Callable[[Source], Source]) -> Setup:
        """The same with each channel's source changed."""
        return replace(self, channels=tuple(replace(c, source=change(c.source)) for c in self.channels))

    def with_source_moved(self, motion: Motion) -> Setup:
        """The same with its source somewhere else."""
        entrance = self.lens.entrance.z
        return self.with_sources(lambda source: moved_source(source, motion, entrance))

    def with_screen_moved(self, motion: Motion) -> Setup:
        """The same with its screen somewhere else."""
        return replace(self, screen=moved_screen(self.screen, motion))

    def with_lens_moved(self, motion: Motion) -> Setup:
        """The same with its lens somewhere else: seen from the lens, source and screen have moved the other way."""
        back = motion.inverse
        return self.with_source_moved(back).with_screen_moved(back)

    def with_indices(self, change: Callable[[float], float]) -> Setup:
        """The same with each refractive index of the lens changed."""
        channels = tuple(replace(c, index=change(c.index)) for c in self.channels)
        return replace(self, lens=replace(self.lens, index=change(self.lens.index)), channels=channels)

    def with_lens_scaled(self, factor: float) -> Setup:
        """The same with its lens larger by a factor about its middle."""
        return replace(self, lens=scaled(self.lens, factor, self.middle[2]))


def _place(source: Source, entrance: float) -> Vector:
    if source.kind == "point":
        return source.position
    z = entrance if source.z is None else source.z
    return (*source.shift(z), z)


def scaled(lens: Lens, factor: float, about: float) -> Lens:
    """The lens larger by a factor about the point of the axis at z = `about` (mm)."""
    back = lens.back
    grown = replace(
        back,
        z=about + factor * (back.z - about),
        heights=factor * back.heights,
        x=tuple(factor * end for end in back.x),
        y=tuple(factor * end for end in back.y),
    )
    return replace(
        lens,
        front=_scaled_surface(lens.front, factor, about),
        back=grown,
        outline=lens.outline.scaled(factor),
        clear=lens.clear and tuple(aperture.scaled(factor) for aperture in lens.clear),
    )


def _scaled_surface(surface: Surface, factor: float, about: float) -> Surface:
    moved = surface.moved(about + factor * (surface.z - about))
    if surface.curvature is None:
        ends = {side: tuple(factor * end for end in getattr(surface, side)) for side in ("x", "y")}
        return replace(moved, heights=factor * surface.heights, **ends)
    return moved.with_parameters(curvature=surface.curvature / factor) if surface.curvature else moved
