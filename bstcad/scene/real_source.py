"""Real size of a source that a scene simulates as a point or as parallel light: stated in the scene, or assumed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.trace.source_images import images

DEFAULT_DIAMETER = 0.1  # assumed diameter of a point source, mm
DEFAULT_DIVERGENCE = 0.1  # assumed divergence of parallel light, degrees
# Assumed sizes for each Emitter.size_key: (size, shape, unit).
DEFAULT_SIZES = {"diameter": (DEFAULT_DIAMETER, "disc", "mm"), "divergence": (DEFAULT_DIVERGENCE, "cone", "degrees")}
DISC_POINTS = tuple((x, y, 1 / 4) for x in (-0.5, 0.5) for y in (-0.5, 0.5))  # points (x, y, weight) in the unit disc


@dataclass(frozen=True)
class RealSize:
    """Size of a real source, which no ray has."""

    key: str  # key of the scene that would simulate the size, without "source.": diameter or divergence
    size: float  # diameter (mm) or full angle (degrees)
    words: str  # size in a sentence
    assumed: bool  # True if the scene does not state the size

    def channels(self, channel: Channel) -> list[Channel]:
        """Return the light of a channel from a few points of the real source; their weights sum to 1."""
        extent = channel.source.resized(self.key, self.size).extent
        assert isinstance(extent, Circle)  # the size is a diameter or an angle
        wide = channel.source.resized(self.key, self.size)
        points = ((wide.element(extent.radius * u, extent.radius * v), weight) for u, v, weight in DISC_POINTS)
        return [replace(channel, source=source, weight=weight) for source, weight in points]


def real_size(source: Emitter) -> RealSize | None:
    """Return the real size of a source; None: its size is simulated, or a source of this kind has none."""
    if source.extent is not None or (key := source.size_key) is None:
        return None
    stated, (default, shape, unit) = getattr(source, f"real_{key}"), DEFAULT_SIZES[key]
    words = f"source.real_{key} = {stated:g} {unit}" if stated else f"a {shape} of {default:g} {unit}"
    return RealSize(key, stated or default, words, assumed=not stated)


def image_diameters(size: RealSize, channel: Channel, lens: Lens, screens: Sequence[Screen]) -> list[float]:
    """Return the mean diameter (pixels) of the image of a real source on each screen; 0 if no light passes.

    channel: light of the centre of the source.
    """
    found = [images(size.channels(channel), lens, screen) for screen in screens]
    return [image.width() if image.flux.any() else 0.0 for image in found]
