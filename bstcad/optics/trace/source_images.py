"""Images of an extended source through the points of the back face, which blur the picture of a lens.

An extended source forms an image of itself through each point of the lens (`ImageSamples`).  All rays through one point
of the back meet the same slope, whichever source point they come from: no lens can unite them in one point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
import torch
from scipy.fft import irfft2, next_fast_len, rfft2
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK
from bstcad.optics.light.channels import Channel
from bstcad.optics.numerics.reductions import total
from bstcad.optics.receivers.irradiance import Screen, rrmsd, tent
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.rays import Landed
from bstcad.optics.surfaces.sampling import point_pairs
from bstcad.optics.trace import tubes
from bstcad.optics.trace.trace import behind, through

MAX_IMAGE_RAYS = 1 << 17  # maximum rays of the images of a source that are traced at a time, which limits the memory
IMAGE_POINTS_PER_SIDE = 48  # number of points per side of the back face through which the source is imaged
# Largest distance of landing light from the screen's centre, divided by (longer side of the screen + median distance).
# Light farther out grazes a tilted plane and does not belong to the image.
MAX_IMAGE_DISTANCE = 16
EVEN_POINT_PAIRS = 2048  # number of pairs of points that represent a uniformly bright source


@dataclass(frozen=True)
class ImageSamples:
    """Images of a source through several points of the back face: landing points of the light of each channel."""

    offset: Tensor  # landing point minus centroid of the image, (2, channels, points): columns, rows (pixels)
    flux: Tensor  # flux of each channel through each point, (channels, points)

    def width(self) -> float:
        """Return 2 √2 times the RMS distance from the centroid (pixels), the diameter of a uniform disc of this RMS."""
        square = torch.where(self.flux > 0, (self.offset**2).sum(0), torch.zeros_like(self.flux))
        return 2 * math.sqrt(2 * float(total(square * self.flux) / total(self.flux)))

    def mean(self, limit: tuple[int, int]) -> np.ndarray:
        """Return the mean image (odd number of rows, odd number of columns), centred; sum: fraction of light inside.

        limit: largest distance from the centre of the image in columns and in rows; light farther out is left out.
        """
        extent = [math.ceil(float(p[self.flux > 0].abs().max())) + 1 for p in self.offset]
        columns, rows = (2 * min(reach, side) + 1 for reach, side in zip(extent, limit, strict=True))
        own = Screen(0.0, (-columns / 2, columns / 2), (-rows / 2, rows / 2), (columns, rows))
        position = self.offset * torch.tensor([1.0, -1.0]).view(2, 1, 1)  # rows count downwards
        image = tent(Landed(position, self.flux, torch.zeros(self.flux.shape, dtype=torch.uint8)), own)
        fits = all(reach <= side for reach, side in zip(extent, limit, strict=True))
        return (image / (image.sum() if fits else self.flux.sum())).numpy()

    def deviation(self, target: np.ndarray) -> float:
        """Return the RRMSD between a target (rows, columns) and the target convolved with the mean image.

        Light shifted by more than the target's width falls outside the target and needs no pixels.
        """
        rows, columns = target.shape
        blurred = convolved(target, self.mean((columns, rows))).clip(min=0)
        if not blurred.any():  # the image is so much wider than the target that no sample falls on the target
            blurred = np.ones_like(target)
        return float(rrmsd(torch.from_numpy(blurred), torch.from_numpy(np.asarray(target, dtype=np.float64))))


def convolved(values: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Return the convolution of two arrays (rows, columns) by Fourier transforms, as far as `values` reaches.

    As scipy.signal.fftconvolve(values, kernel, mode="same"), without the half second that its import takes.
    """
    shape = [next_fast_len(a + b - 1, real=True) for a, b in zip(values.shape, kernel.shape, strict=True)]
    whole = irfft2(rfft2(values, shape) * rfft2(kernel, shape), shape)
    rows, columns = (slice((b - 1) // 2, (b - 1) // 2 + a) for a, b in zip(values.shape, kernel.shape, strict=True))
    return whole[rows, columns]


def even_image(extent: Outline) -> ImageSamples:
    """Return the image of a uniformly bright disc or rectangle; extent: outline of the image (pixels)."""
    offset = torch.tensor(point_pairs(extent, EVEN_POINT_PAIRS), dtype=torch.float64).T[..., None]
    return ImageSamples(offset, torch.full(offset.shape[1:], 1 / (2 * EVEN_POINT_PAIRS), dtype=torch.float64))


def detail_width(source_image: float, pixel: float) -> float:
    """Return √(D² + 4/3 p²): diameter of the uniform disc whose variance is the sum of those of a disc and a pixel.

    D: `source_image`, diameter of the disc, variance D² / 8.  p: `pixel`, its side, variance p² / 6.  All in one unit.
    """
    return math.sqrt(source_image**2 + 4 / 3 * pixel**2)


@torch.no_grad()
def images(channels: Sequence[Channel], lens: Lens, screen: Screen, n: int = IMAGE_POINTS_PER_SIDE) -> ImageSamples:
    """Return the source's images, in light of the first line, through the lit cells of an n x n grid on the back."""
    first = channels[0]
    channels = [c for c in channels if (c.source.wavelength, c.index) == (first.source.wavelength, first.index)]
    pixel, flux = landing_pixels(channels, lens, screen, n)
    if (flux > 0).any():
        centre = torch.tensor([screen.columns / 2, screen.rows / 2]).to(pixel).view(2, 1, 1)
        distance = (pixel - centre).abs().amax(0)
        stray = distance > MAX_IMAGE_DISTANCE * (max(screen.shape) + distance[flux > 0].median())
        flux = torch.where(stray, torch.zeros_like(flux), flux)
    lit = flux.sum(0) > 0
    flux, share = flux[:, lit], flux[:, lit] / flux[:, lit].sum(0)
    pixel = torch.where(flux > 0, pixel[..., lit], torch.zeros_like(share))
    return ImageSamples(pixel - (pixel * share).sum(1, keepdim=True), flux)


@torch.no_grad()
def landing_pixels(channels: Sequence[Channel], lens: Lens, screen: Screen, n: int) -> tuple[Tensor, Tensor]:
    """Return (pixel (2, channels, points), flux (channels, points)) of the light through n x n cells of the back.

    pixel: column and row at which each channel's light lands, meaningless where the flux is zero.
    """
    x, y = tubes.corners(lens.apertures[1], n)
    lines = groupby(channels, key=lambda channel: (channel.index, channel.losses, channel.around))
    count, parts = max(1, MAX_IMAGE_RAYS // x.numel()), []
    for line in (list(members) for _, members in lines):
        parts += [_through(line[k : k + count], lens, screen, x=x, y=y) for k in range(0, len(line), count)]
    position, flux = (torch.cat(part, dim=-2) for part in zip(*parts, strict=True))
    return screen.pixels_of(position), flux


def _through(channels: Sequence[Channel], lens: Lens, screen: Screen, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Trace light of one index through the cells between the points (x, y) (mm) of the back; return (landing, flux).

    landing: points (2, channels, cells) in the receiver's unit.  flux: (channels, cells), zero for light that is lost.
    """
    lens = channels[0].through(lens)
    p, q, rays = tubes.rays_to([channel.source for channel in channels], lens, x, y)
    last = replace(lens.unbounded(), losses=None).interfaces[lens.number_of(BACK) :]
    rays = replace(rays, position=rays.position - lens.back.standoff * rays.direction)
    [landed] = through(rays, last, [screen.receiver])
    centre = tubes.middle(p), tubes.middle(q)
    cells = zip(channels, *centre, strict=True)
    density = [each.weight * each.source.irradiance(x, y, lens.entrance.z) for each, x, y in cells]
    flux = torch.stack(density) * tubes.area_of(p, q)
    if lens.passes.sense > 0:  # light comes to the front
        enters = lens.apertures[0].contains(*centre)
        if not lens.back.chart.flat:  # the centres of the cells lie on the sphere from which the light is launched
            cells = zip(channels, *centre, strict=True)
            coming = [each.source.rays_through(x, y, lens.entrance.z, 1.0) for each, x, y in cells]
            enters = torch.stack([behind(rays, lens.interfaces[0]).alive for rays in coming])
        flux = torch.where(enters, flux, torch.zeros_like(flux))
    flux = tubes.arriving_flux(flux, landed).double()
    return tubes.middle(landed.position).flatten(-2), flux.flatten(-2)
