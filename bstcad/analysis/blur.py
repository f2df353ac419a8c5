"""How far the size of a source blurs every picture: detail much finer than its image does not come back.

A lens may still overlay many such images, so that their sum is nearer to the target than the target blurred.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen, rrmsd
from bstcad.optics.lens import Lens
from bstcad.optics.source_images import PLACES, extended, images


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
    from scipy.signal import fftconvolve  # half a second to load, which a point source need not pay

    found = images(channels, lens, screen, n)
    per_mm = math.sqrt(math.prod(screen.per_mm))
    blurred = fftconvolve(target, found.mean(), mode="same").clip(min=0)
    error = float(rrmsd(torch.from_numpy(blurred), torch.from_numpy(np.asarray(target, dtype=np.float64))))
    width = found.width()
    return Blur(width / per_mm, width, error)
