"""The images that a source of some size throws on the target, one through each place of the lens.

All rays that leave one point of the back face, whatever point of the source they come from, share its slope: no lens
can bring them together.  Where they land is an image of the source.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.channels import Channel, places
from bstcad.optics.irradiance import Screen, rrmsd, tent
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import Landed
from bstcad.optics.sampling import in_pairs
from bstcad.optics.trace import through_back
from bstcad.optics.tubes.collecting import middle
from bstcad.optics.tubes.finding import rays_to
from bstcad.optics.tubes.launching import corners

PLACES = 48  # a side of the back face, through each of which the source is seen
EVEN = 2048  # pairs of points of an evenly bright source


@dataclass(frozen=True)
class Images:
    """Through each of several places: where the light of each channel lands."""

    offset: Tensor  # (2, channels, places) from the centroid of the place's own image, in pixels: columns, rows
    flux: Tensor  # (channels, places)

    def width(self) -> float:
        """2 √2 times the rms distance from the centroid, in pixels: an even disc of diameter D has D² / 8."""
        square = torch.where(self.flux > 0, (self.offset**2).sum(0), torch.zeros_like(self.flux))
        return 2 * math.sqrt(2 * float(total(square * self.flux) / total(self.flux)))

    def mean(self) -> np.ndarray:
        """(rows, columns) the mean image, centred, sum 1; both odd."""
        reach = [math.ceil(float(p[self.flux > 0].abs().max())) + 1 for p in self.offset]
        sides = [2 * r + 1 for r in reach]
        own = Screen(0.0, (-sides[0] / 2, sides[0] / 2), (-sides[1] / 2, sides[1] / 2), tuple(sides))
        position = self.offset * torch.tensor([1.0, -1.0]).view(2, 1, 1)  # rows count downwards
        found = tent(Landed(position, self.flux, torch.zeros(self.flux.shape, dtype=torch.uint8)), own)
        return (found / found.sum()).numpy()

    def deviation(self, target: np.ndarray) -> float:
        """RRMSD of a target (rows, columns) convolved with the mean image, against the target itself."""
        from scipy.signal import fftconvolve  # half a second to load, which a point source need not pay

        blurred = fftconvolve(target, self.mean(), mode="same").clip(min=0)
        return float(rrmsd(torch.from_numpy(blurred), torch.from_numpy(np.asarray(target, dtype=np.float64))))


def even_image(extent: Outline) -> Images:
    """The image of an evenly bright disc or rectangle, so large in pixels."""
    offset = torch.tensor(in_pairs(extent, EVEN), dtype=torch.float64).T[..., None]
    return Images(offset, torch.full(offset.shape[1:], 1 / (2 * EVEN), dtype=torch.float64))


def detail_width(source_image: float, pixel: float) -> float:
    """√(D² + 4/3 p²): the diameter of the even disc of the variance of a disc of diameter D and a square of side p.

    Their variances are D² / 8 and p² / 6; all in one unit of length.
    """
    return math.sqrt(source_image**2 + 4 / 3 * pixel**2)


@torch.no_grad()
def images(channels: Sequence[Channel], lens: Lens, screen: Screen, n: int = PLACES) -> Images:
    """Of the source whose points are the channels of the first line, through n x n places of the back with light."""
    first = channels[0]
    channels = [c for c in channels if (c.source.wavelength, c.index) == (first.source.wavelength, first.index)]
    x, y = corners(lens.apertures[1], n)
    landed = [_through(channel, lens, screen, x, y) for channel in channels]
    position, flux = (torch.stack([getattr(each, name) for each in landed], dim=-2) for name in ("position", "flux"))
    lit = flux.sum(0) > 0
    flux, share = flux[:, lit], flux[:, lit] / flux[:, lit].sum(0)
    pixel = screen.pixels_of(torch.where(flux > 0, position[..., lit], torch.zeros_like(share)))
    return Images(pixel - (pixel * share).sum(1, keepdim=True), flux)


def _through(channel: Channel, lens: Lens, screen: Screen, x: Tensor, y: Tensor) -> Landed:
    """The light of one channel through the places between the points (x, y) (mm) of the back face."""
    seen = channel.through(lens)
    p, q, coming = rays_to(channel.source, seen, x, y)
    landed = through_back(coming, replace(seen.unbounded(), losses=None), screen.plane)
    alive = landed.alive
    whole = alive[1:, 1:] & alive[1:, :-1] & alive[:-1, 1:] & alive[:-1, :-1]
    area = ((p[1:, 1:] - p[:-1, :-1]) * (q[:-1, 1:] - q[1:, :-1])
            - (p[:-1, 1:] - p[1:, :-1]) * (q[1:, 1:] - q[:-1, :-1])).abs() / 2  # fmt: skip
    inside = seen.number_of_back == 0 or seen.apertures[0].contains(middle(p), middle(q))
    flux = channel.weight * channel.source.irradiance(middle(p), middle(q), seen.entrance.z) * area
    flux = torch.where(whole & inside, flux, torch.zeros_like(flux)).double()
    at = torch.stack([middle(c) for c in landed.position])
    return Landed(at.reshape(2, -1), flux.reshape(-1), landed.status[1:, 1:].reshape(-1))


def extended(channels: Sequence[Channel]) -> bool:
    """Are these points of a source of some size?"""
    return any(places(channels))
