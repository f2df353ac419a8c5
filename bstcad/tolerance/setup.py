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
from bstcad.optics.rays import Vector
from bstcad.optics.sources import Source
from bstcad.optics.surfaces import Surface


@dataclass(frozen=True)
class Setup:
    """Lens, light and screen to be traced; lengths in mm."""

    lens: Lens
    channels: tuple[Channel, ...]
    screen: Screen

    def pivot(self, part: str) -> Vector:
        """Point about which a part ("lens", "source", "screen") tilts.

        Of the lens half way between its faces' vertices (of a mirror the vertex), of the source the weighted mean of
        its points or the middle of its aperture, of the screen its middle.
        """
        if part == "screen":
            return self.screen.middle
        if part == "lens":
            back = float(self.lens.back.plain().from_vertex().z)
            return 0.0, 0.0, back if self.lens.reflects else (self.lens.front.z + back) / 2
        points = [_position(channel.source, self.lens.entrance.z) for channel in self.channels]
        mean = np.average(points, axis=0, weights=[channel.weight for channel in self.channels])
        return tuple(mean.tolist())

    def picture(self, tubes: int) -> np.ndarray:
        """(rows, columns) flux in each pixel of the screen, row 0 = y max, by tubes x tubes a channel."""
        return tubes_picture(self.lens, self.channels, self.screen, tubes, over_the_back=True).cpu().numpy()

    def moved(self, part: str, motion: Motion) -> Setup:
        """With its lens, source or screen moved; seen from a moved lens, source and screen move the other way."""
        if part == "lens":
            return self.moved("source", motion.inverse).moved("screen", motion.inverse)
        if part == "screen":
            return replace(self, screen=moved_screen(self.screen, motion))
        return self.with_sources(lambda source: moved_source(source, motion, self.lens.entrance.z))

    def with_sources(self, change: Callable[[Source], Source]) -> Setup:
        """With each channel's source changed."""
        return replace(self, channels=tuple(replace(c, source=change(c.source)) for c in self.channels))

    def with_indices(self, change: Callable[[float], float]) -> Setup:
        """With each refractive index of the lens changed."""
        channels = tuple(replace(c, index=change(c.index)) for c in self.channels)
        return replace(self, lens=replace(self.lens, index=change(self.lens.index)), channels=channels)

    def with_lens_scaled(self, factor: float) -> Setup:
        """With its lens larger by a factor about its pivot."""
        return replace(self, lens=_scaled(self.lens, factor, self.pivot("lens")[2]))


def _position(source: Source, entrance: float) -> Vector:
    if source.kind == "point":
        return source.position
    z = entrance if source.z is None else source.z
    return (*source.shift(z), z)


def _scaled(lens: Lens, factor: float, about: float) -> Lens:
    """The lens larger by a factor about the point of the axis at z = `about` (mm)."""

    def grown(surface: Surface) -> Surface:
        moved = surface.moved(about + factor * (surface.z - about))
        if surface.curvature is None:
            x, y = (tuple(factor * end for end in side) for side in (surface.x, surface.y))
            return replace(moved, heights=factor * surface.heights, x=x, y=y)
        return moved.with_parameters(curvature=surface.curvature / factor) if surface.curvature else moved

    clear = lens.clear and tuple(aperture.scaled(factor) for aperture in lens.clear)
    outline = lens.outline.scaled(factor)
    return replace(lens, front=grown(lens.front), back=grown(lens.back), outline=outline, clear=clear)
