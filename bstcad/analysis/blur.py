"""How far the size of a source blurs every picture: detail much finer than its image does not come back.

A lens may still overlay many such images, so that their sum is nearer to the target than the target blurred.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.source_images import PLACES, detail_width, extended, images

REACH = 2.5  # times the wider of lens and picture: a target so far is in reach of a plate a tenth as thick as wide
WORTH = 0.9  # times the width: a nearer target that leaves more of it is not worth a sentence


@dataclass(frozen=True)
class Blur:
    """The source's image on the target, a mean over the lens weighted by the flux through each place of it."""

    width: float  # mm; diameter of the even disc whose landing points lie as far from their centroid, in the rms
    pixels: float  # the same in pixels
    rrmsd: float  # of the target against itself, convolved with the mean image


def blur(channels: Sequence[Channel], lens: Lens, screen: Screen, target: np.ndarray, n: int = PLACES) -> Blur | None:
    """Of the source whose points the channels are, at its first line; None of a point.  target: (rows, columns)."""
    if not extended(channels):
        return None
    found = images(channels, lens, screen, n)
    width = found.width()
    return Blur(width * _pixel(screen), width, found.deviation(target))


@dataclass(frozen=True)
class FinestDetail:
    """The width of a point of the picture on the target, whatever the lens: the source's image, taken up by pixels.

    w = √(D² + 4/3 p²), where D is the diameter of the source's image and p the side of a pixel
    (optics.source_images.detail_width).  D grows in proportion to the distance L from the lens to the target,
    D = 2 L tan(δ / 2) for parallel light of divergence δ through a thin plate and D = d L / l for a source of diameter
    d at the distance l before it, so that on a target at L' it is D L' / L.  What the net of control points cannot
    shape is not in it.
    """

    width: float  # mm; w
    source_image: float  # mm; D
    pixel: float  # mm; p
    distance: float  # mm; L
    nearer_distance: float | None  # mm; an L' within reach of a lens that throws the same picture; None: there is none
    nearer_width: float | None  # mm; w there
    of: str  # which size of the source: the key of the scene, or an assumption
    assumed: bool  # is that a size which the scene does not state?


def finest_detail(source_image: float, lens: Lens, screen: Screen, of: str, assumed: bool = False) -> FinestDetail:
    """The finest detail on a target on which the image of a source of the size `of` is so wide (pixels)."""
    distance, pixel = abs(screen.z - lens.back.z), _pixel(screen)
    sizes = (*(2 * half for half in lens.outline.half_extent), *(high - low for low, high in (screen.x, screen.y)))
    nearer, image = REACH * max(sizes), source_image * pixel
    here, there = (detail_width(image * share, pixel) for share in (1.0, nearer / distance))
    if not there < WORTH * here:
        nearer, there = None, None
    return FinestDetail(here, image, pixel, distance, nearer, there, of, assumed)


def _pixel(screen: Screen) -> float:
    """The side of a pixel (mm), of a square of its area."""
    return 1 / math.sqrt(math.prod(screen.per_mm))
