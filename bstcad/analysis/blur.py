"""The blur by an extended source: no lens shows detail much finer than the source's image on the target.

A lens may still overlay many such images, so that their sum is nearer to the target than the blurred target is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.measure import IMAGE_PLACES, detail_width, extended, images

REACH = 2.5  # times the wider of lens and picture: the nearest target for a plate a tenth as thick as wide
WORTH = 0.9  # of the width: a nearer target has to bring less, or the report does not name it


@dataclass(frozen=True)
class Blur:
    """The source's image on the target, a mean over the lens, weighted by flux."""

    width: float  # mm; diameter of the even disc with the same rms distance from the centroid
    pixels: float  # the width in pixels
    rrmsd: float  # between the target and the target convolved with the mean image


def blur(
    channels: Sequence[Channel], lens: Lens, screen: Screen, target: np.ndarray, n: int = IMAGE_PLACES
) -> Blur | None:
    """The blur by a source whose points are the channels, at its first line; None for a point source."""
    if not extended(channels):
        return None
    found = images(channels, lens, screen, n)
    width = found.width()
    return Blur(width * _pixel(screen), width, found.deviation(target))


@dataclass(frozen=True)
class FinestDetail:
    """The least width of a point of the picture, whatever the lens: the source's image, sampled by pixels.

    w = √(D² + 4/3 p²), where D is the diameter of the source's image and p the side of a pixel
    (optics.measure.detail_width).  D is proportional to the distance L from the lens to the target: D = 2 L
    tan(δ / 2) for parallel light of divergence δ through a thin plate, D = d L / l for a source of diameter d at the
    distance l before it.  On a target at L' it is D L' / L.  The limit by the net of control points is not included.
    """

    width: float  # mm; w
    source_image: float  # mm; D
    pixel: float  # mm; p
    distance: float  # mm; L
    nearer_distance: float | None  # mm; L' of a nearer target that a lens can light with the same picture; None: no L'
    nearer_width: float | None  # mm; w on that target
    of: str  # the size of the source: its key in the scene, or an assumption
    assumed: bool  # the scene does not state the size


def finest_detail(source_image: float, lens: Lens, screen: Screen, of: str, assumed: bool = False) -> FinestDetail:
    """The finest detail on a target where the image of a source of the size `of` is `source_image` pixels wide."""
    distance, pixel = abs(screen.z - lens.back.z), _pixel(screen)
    sizes = (*(2 * half for half in lens.outline.half_extent), *(high - low for low, high in (screen.x, screen.y)))
    nearer, image = REACH * max(sizes), source_image * pixel
    here, there = (detail_width(image * share, pixel) for share in (1.0, nearer / distance))
    worth = there < WORTH * here
    return FinestDetail(
        width=here,
        source_image=image,
        pixel=pixel,
        distance=distance,
        nearer_distance=nearer if worth else None,
        nearer_width=there if worth else None,
        of=of,
        assumed=assumed,
    )


def _pixel(screen: Screen) -> float:
    """The side of a pixel (mm), of a square of its area."""
    return 1 / math.sqrt(math.prod(screen.per_mm))
