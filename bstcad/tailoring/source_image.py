"""The picture made by a source of finite size: the picture of its centre, blurred by a slowly varying source image.

All rays through one point of the back are refracted by the same slope.  If light from the centre of the source lands
at t through this point, light from the point s of the source lands at t + δ(t, s), and δ varies slowly over the target,
even for a rough face.  So with the picture E_0 of the centre

    E(t) = ∫ K(t', t - t') E_0(t') dt',     K(t', ·) the density of δ(t', s) over the points s of the source,

which needs one sheet of flux tubes instead of a sheet for each of many source points.  K is interpolated between nodes
t_n over the screen by hat functions a_n, K(t', ·) = Σ_n a_n(t') K_n.  Then E = B E_0 = Σ_n K_n * (a_n E_0), where
the convolution * needs a few Fourier transforms.  K_n is the image of the source through the point of the back whose
light lands nearest to t_n.  There δ and the flux are interpolated biquadratically in s from 3 x 3 points of the source
to 2 · IMAGE_PAIRS points.

The error of this model is small and varies slowly during tailoring.  It is measured with rays from points of the source
at the start of a round, smoothed, and added as a constant picture: E = B E_0 + (E_rays - B E_0)_start.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.fft
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel, SourceSampler
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.irradiance import Screen, tent
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.rays import Landed
from bstcad.optics.surfaces.sampling import point_pairs
from bstcad.optics.trace.measure import side_factor, simulated
from bstcad.optics.trace.source_images import landing_pixels

IMAGE_NODES = 5  # nodes t_n per side of the screen; the outermost lie on its edges
IMAGE_GRID = 32  # cells per side of the back through which the images of the source are traced
POINT_DISTANCE = 0.7  # spacing of the 3 x 3 points of the source along each axis, in half widths of the source
IMAGE_PAIRS = 256  # pairs of source points that represent an image
PIXEL_PARTS = 5  # parts of a pixel per axis in the images; odd
ERROR_SMOOTHING = 0.15  # standard deviation of the smoothing of the blur error / reach of the images (border - 2)
MAX_TRANSFORM_BYTES, VALUE_BYTES = 2 << 30, 8  # largest size of the transforms of all images, size of one value (bytes)
MIN_BORDER = 16  # border (pixels) that is always allowed, whatever MAX_TRANSFORM_BYTES and the size of the screen
ERROR_SEED_OFFSET = 500_009  # offset of the seed of the rays that measure the blur's error; verification has other rays


@dataclass(frozen=True)
class ErrorRays:
    """Numbers of rays in each of the two sets that measure the error of the blur."""

    rays: int = 1448  # square root of the rays per spectral line
    points: int = 256  # source points


@dataclass(frozen=True, eq=False)
class ExtendedSource:
    """Source of finite size, with the light of its centre."""

    source: Emitter  # source of finite size
    centre: tuple[Channel, ...]  # light of the centre of the source, one channel per spectral line
    sampler: SourceSampler  # function that samples points of the source


@dataclass(frozen=True, eq=False)
class BlurOperator:
    """Operator B from a picture of the source's centre, on a screen with a border, to a picture of the whole source."""

    border: int  # width of the border whose light is blurred onto the screen (pixels)
    hats: tuple[np.ndarray, np.ndarray]  # hat functions, (nodes, rows + 2 border) and (nodes, columns + 2 border)
    spectra: np.ndarray  # Fourier transforms of the images K_n, (nodes, nodes, …)
    size: tuple[int, int]  # rows and columns of the transformed arrays

    def forward(self, light: np.ndarray) -> np.ndarray:
        """Apply B to light (rows + 2 border, columns + 2 border); return a picture (rows, columns)."""
        waves = scipy.fft.rfft2(self._times_hats(light), self.size)
        wide, p = scipy.fft.irfft2((waves * self.spectra).sum((0, 1)), self.size), self.border
        return wide[p : light.shape[0] - p, p : light.shape[1] - p]

    def adjoint(self, g: np.ndarray) -> np.ndarray:
        """Apply the transpose of `forward`."""
        waves = scipy.fft.rfft2(np.pad(g, self.border), self.size)
        back = scipy.fft.irfft2(waves * self.spectra.conj(), self.size)
        rows, columns = (side + 2 * self.border for side in g.shape)
        return self._times_hats(back[..., :rows, :columns]).sum((0, 1))

    def _times_hats(self, light: np.ndarray) -> np.ndarray:
        """Return light (…, rows, columns) times the hat function of each node."""
        down, across = self.hats
        return light * down[:, None, :, None] * across[None, :, None, :]


class _BlurFunction(torch.autograd.Function):
    """Operator B as a differentiable function."""

    @staticmethod
    def forward(ctx: Any, light: Tensor, blur: BlurOperator) -> Tensor:
        ctx.blur = blur
        return torch.from_numpy(blur.forward(light.detach().cpu().numpy()).copy()).to(light.device)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor, None]:
        return torch.from_numpy(ctx.blur.adjoint(g.cpu().numpy())).to(g.device), None


def blurred(light: Tensor, blur: BlurOperator) -> Tensor:
    """Blur the picture of the source's centre, (rows + 2 border, columns + 2 border); differentiable."""
    return _BlurFunction.apply(light, blur)


def with_border(screen: Screen, border: int) -> Screen:
    """Return the screen with `border` more pixels on each side."""
    sides = zip((screen.x, screen.y), screen.per_unit, strict=True)
    x, y = ((low - border / per_unit, high + border / per_unit) for (low, high), per_unit in sides)
    return replace(screen, x=x, y=y, pixels=(screen.columns + 2 * border, screen.rows + 2 * border))


@dataclass(frozen=True, eq=False)
class LocalImages:
    """Images of the source through points of the back, relative to the landing point of the centre's light."""

    at: Tensor  # (2, points) landing points of the centre's light (column, row) in pixels
    offset: Tensor  # (2, 9, points) displacement δ of the light from 3 x 3 points of the source, in pixels
    flux: Tensor  # (9, points) flux from each of the 3 x 3 points, relative to the flux from the centre

    @classmethod
    def of(cls, source: Emitter, channel: Channel, lens: Lens, screen: Screen) -> LocalImages:
        """Trace the images through the points of the back that transmit light from the centre and all 3 x 3 points."""
        assert source.extent is not None, "a point source has no image"
        a, b = source.extent.half_extent
        points = [(i * POINT_DISTANCE, j * POINT_DISTANCE) for j in (-1, 0, 1) for i in (-1, 0, 1)]
        nine = (replace(source.element(a * u, b * v), wavelength=channel.source.wavelength) for u, v in points)
        ten = [channel, *(replace(channel, source=one) for one in nine)]
        pixel, flux = landing_pixels(ten, lens, screen, n=IMAGE_GRID)
        passes = (flux > 0).all(0)
        pixel, flux = pixel[..., passes].cpu(), flux[:, passes].cpu()
        return cls(pixel[:, 0], pixel[:, 1:] - pixel[:, :1], flux[1:] / flux[0])

    def nearest(self, column: float, row: float) -> tuple[Tensor, Tensor]:
        """Return offset (2, 9) and flux (9,) of the image nearest to a position in pixels; zeros and ones if none."""
        if not self.at.shape[1]:
            return torch.zeros(2, 9, dtype=torch.float64), torch.ones(9, dtype=torch.float64)
        point = int(torch.argmin((self.at[0] - column) ** 2 + (self.at[1] - row) ** 2))
        return self.offset[..., point], self.flux[:, point]


def _biquadratic(points: Sequence[tuple[float, float]]) -> Tensor:
    """Return the weights (9, points) that interpolate 3 x 3 values to points (x, y) in half widths of the source."""
    d = POINT_DISTANCE
    axes = [
        (u * (u - d) / (2 * d**2), 1 - (u / d) ** 2, u * (u + d) / (2 * d**2))
        for u in torch.tensor(points, dtype=torch.float64).T
    ]
    return torch.stack([along * across for across in axes[1] for along in axes[0]])


def blurs(extended: ExtendedSource, lens: Lens, screen: Screen) -> tuple[BlurOperator, ...]:
    """Return the operators B for a source, a lens and a screen, one per spectral line, all with the same border."""
    extent = extended.source.extent
    unit = Circle(1.0) if extent is not None and extent.is_round else Rectangle(2.0, 2.0)
    dots = _biquadratic(point_pairs(unit, IMAGE_PAIRS))
    nodes = [[k / (IMAGE_NODES - 1) * side for k in range(IMAGE_NODES)] for side in screen.shape]
    kernels = []
    for channel in extended.centre:
        local = LocalImages.of(extended.source, channel, lens, screen)
        near = [local.nearest(column, row) for row in nodes[0] for column in nodes[1]]
        kernels.append([((p[..., None] * dots).sum(-2), (flux[..., None] * dots).sum(-2)) for p, flux in near])
    reach = max(float(offset.abs().max()) for images in kernels for offset, _ in images)
    border = min(math.ceil(reach) + 2, widest(screen, len(kernels)))
    return tuple(_operator(images, screen, border) for images in kernels)


def widest(screen: Screen, lines: int) -> int:
    """Return the largest border (pixels) within MAX_TRANSFORM_BYTES for all spectral lines; at least MIN_BORDER.

    It is at most the screen's longer side.  Images on a tilted target that some light grazes may be arbitrarily large.
    """
    side = math.sqrt(MAX_TRANSFORM_BYTES / (lines * IMAGE_NODES**2 * VALUE_BYTES))
    return max(min(max(screen.shape), int((side - max(screen.shape)) / 4)), MIN_BORDER)


def _operator(images: Sequence[tuple[Tensor, Tensor]], screen: Screen, border: int) -> BlurOperator:
    """Make B from the image at each node, as points: offset (2, n) in pixels, flux (n,) relative to the centre.

    A hat function distributes each point over parts of a pixel (PIXEL_PARTS per axis), which blurs negligibly.
    """
    down, across = (_hats(side, border) for side in screen.shape)
    side = 2 * border + 1
    rows, columns = (scipy.fft.next_fast_len(hat.shape[1] + side, real=True) for hat in (down, across))
    fine = Screen(0.0, (-side / 2, side / 2), (-side / 2, side / 2), PIXEL_PARTS * side)
    spectra, k = np.zeros((len(images), rows, columns // 2 + 1), dtype=complex), np.arange(rows)
    for spectrum, (offset, flux) in zip(spectra, images, strict=True):
        position = (offset * torch.tensor([[1.0], [-1.0]])).contiguous()  # rows increase downwards, y upwards
        dots = Landed(position, flux / flux.numel(), torch.zeros(flux.shape, dtype=torch.uint8))
        waves = scipy.fft.rfft(_about_zero(tent(dots, fine).numpy(), PIXEL_PARTS * columns, axis=1))
        waves = scipy.fft.fft(_about_zero(waves[:, : spectrum.shape[1]], PIXEL_PARTS * rows, axis=0), axis=0)
        spectrum[:] = waves[k - rows * (k >= (rows + 1) // 2)]
    spectra = spectra.reshape(IMAGE_NODES, IMAGE_NODES, *spectra.shape[1:])
    return BlurOperator(border, (down, across), spectra, (rows, columns))


def _about_zero(values: np.ndarray, n: int, axis: int) -> np.ndarray:
    """Pad an odd number of values along an axis with zeros to n, and roll them so that the centre value is first."""
    odd = values.shape[axis]
    return np.roll(np.pad(values, [(0, n - odd if k == axis else 0) for k in (0, 1)]), -(odd // 2), axis)


def _hats(side: int, border: int) -> np.ndarray:
    """Return the hat functions (IMAGE_NODES, side + 2 border) along an axis, constant beyond the outer nodes."""
    position = np.clip((np.arange(-border, side + border) + 0.5) / side, 0, 1) * (IMAGE_NODES - 1)
    return np.maximum(0, 1 - np.abs(position - np.arange(IMAGE_NODES)[:, None]))


@torch.no_grad()
def blur_error(
    by_images: Tensor,
    sampler: SourceSampler,
    lens: Lens,
    screen: Screen,
    *,
    border: int,
    seed: int,
    effort: ErrorRays = ErrorRays(),
) -> Tensor:
    """Return the error E_rays - B E_0 of a picture, (rows, columns), by two sets of rays; 0 if noise hides it.

    by_images: picture B E_0, divided by the transmitted flux.  sampler: of the source.  border: of B (pixels).

    The smoothed differences d_i of E_i and B E_0 in the two sets have an equal error and independent noise.  Their mean
    is therefore scaled by d_1 · d_2 / |(d_1 + d_2) / 2|².
    """
    picture, errors = by_images.cpu(), []
    for k in range(2):
        points = sampler(effort.points, seed + ERROR_SEED_OFFSET + k)
        n = max(1, round(side_factor(points) * effort.rays))
        seed_of_set = seed + ERROR_SEED_OFFSET + k
        [rays] = simulated(lens, points, [screen], n=n, seed=seed_of_set, splits_missed=False)
        left = sum(rays.flux[line] for line in ("on target", "off target", "total internal reflection"))
        error = (rays.box / left - picture).numpy() if left > 0 else np.zeros(picture.shape)
        errors.append(gaussian_filter(error, ERROR_SMOOTHING * (border - 2)))
    mean = (errors[0] + errors[1]) / 2
    noisy = float((mean**2).sum())
    scale = max(float((errors[0] * errors[1]).sum()), 0.0) / noisy if noisy > 0 else 0.0
    return (torch.from_numpy(mean) * scale).to(by_images.device)
