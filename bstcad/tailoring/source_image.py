"""Light of a source of some size: the light of its middle, blurred by an image of the source that varies slowly.

All rays through one place of the back share its slope.  Where the light of the source's middle lands at t through a
place, that of its point s lands at t + δ(t, s), and δ changes slowly from place to place, however rough the face is:

    E(t) = ∫ K(t', t - t') E_0(t') dt',     K(t', ·) the density of δ(t', s) over the points s of the source.

So one sheet of tubes is traced and cut at pixels, that of E_0, instead of one for each of many points.  Between nodes
t_n over the screen K is interpolated by hats a_n, K(t', ·) = Σ_n a_n(t') K_n, which makes E = Σ_n K_n * (a_n E_0), a
few Fourier transforms.  K_n is the image through that place of the back whose light lands nearest to t_n: δ and flux
there are biquadratic in s through 3 x 3 points of the source, and stand for as many points as a smooth image needs.

What this leaves out is small and changes slowly while a lens is tailored.  It is measured at the start of a round, by
rays from points of the source, and stays in the merit as a constant picture: E = B E_0 + (E_rays - B E_0 of the start).
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

from bstcad.optics.channels import Channel
from bstcad.optics.emitters import Emitter
from bstcad.optics.irradiance import Screen, tent
from bstcad.optics.lens import Lens
from bstcad.optics.measure import Draw, a_side, seen_through, simulated
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.rays import Landed
from bstcad.optics.sampling import in_pairs

NODES = 5  # a side, from border to border of the screen, between which images are interpolated
PLACES = 32  # a side of the back, through which they are looked for
APART = 0.7  # of the source's half width and height: distance of the 3 x 3 points whose light is traced
PAIRS = 256  # of points that make a smooth image
FINER = 5  # an odd number
SIDE = 1448  # rays a side of each of the two sets that tell what the images leave out
POINTS = 256  # of the source in each set
SMOOTH = 0.15  # of the image's reach in pixels: standard deviation by which that picture is smoothed
ROOM, BYTES = 2 << 30, 8  # bytes of the transforms of all images, and of each at a place
LEAST_BORDER = 16  # pixels
SEED = 500_009  # added to the seed: rays that no judge sees


@dataclass(frozen=True)
class Spread:
    """A source of some size about its middle."""

    source: Emitter  # of this size
    centre: tuple[Channel, ...]  # the light of its middle, one channel a line
    draw: Draw  # of its points


@dataclass(frozen=True, eq=False)
class Blur:
    """B: from the light of the source's middle on a screen with a border to that of the whole source on the screen."""

    border: int  # pixels around the screen, whose light reaches onto it
    hats: tuple[np.ndarray, np.ndarray]  # (nodes, rows + 2 border), (nodes, columns + 2 border)
    spectra: np.ndarray  # (nodes, nodes, …) Fourier transform of each K_n
    size: tuple[int, int]  # of the transforms

    def forward(self, light: np.ndarray) -> np.ndarray:
        """(rows, columns) of light (rows + 2 border, columns + 2 border)."""
        waves = scipy.fft.rfft2(self._shared(light), self.size)
        return self._inside(scipy.fft.irfft2((waves * self.spectra).sum((0, 1)), self.size))

    def adjoint(self, g: np.ndarray) -> np.ndarray:
        """The transpose of `forward`."""
        waves = scipy.fft.rfft2(np.pad(g, self.border), self.size)
        back = scipy.fft.irfft2(waves * self.spectra.conj(), self.size)
        rows, columns = (side + 2 * self.border for side in g.shape)
        return self._shared(back[..., :rows, :columns]).sum((0, 1))

    def _shared(self, light: np.ndarray) -> np.ndarray:
        """Light (…, rows, columns) times the hats of each node."""
        down, across = self.hats
        return light * down[:, None, :, None] * across[None, :, None, :]

    def _inside(self, wide: np.ndarray) -> np.ndarray:
        (_, rows), (_, columns), p = self.hats[0].shape, self.hats[1].shape, self.border
        return wide[p : rows - p, p : columns - p]


class _Blurred(torch.autograd.Function):
    """B of a picture, differentiable in it."""

    @staticmethod
    def forward(ctx: Any, light: Tensor, blur: Blur) -> Tensor:
        ctx.blur = blur
        return torch.from_numpy(blur.forward(light.detach().cpu().numpy()).copy()).to(light.device)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g: Tensor):
        return torch.from_numpy(ctx.blur.adjoint(g.cpu().numpy())).to(g.device), None


def blurred(light: Tensor, blur: Blur) -> Tensor:
    """B of the light (rows + 2 border, columns + 2 border) of a source's middle, differentiable in it."""
    return _Blurred.apply(light, blur)


def bordered(screen: Screen, border: int) -> Screen:
    """The screen with so many pixels more on each side."""
    per_x, per_y = screen.per_unit
    x, y = screen.x, screen.y
    return replace(
        screen, x=(x[0] - border / per_x, x[1] + border / per_x), y=(y[0] - border / per_y, y[1] + border / per_y),
        pixels=(screen.columns + 2 * border, screen.rows + 2 * border),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Images:
    """Images of a source through places of the back, about where the light of its middle lands."""

    at: Tensor  # (2, places) where that is, in pixels: columns, rows
    offset: Tensor  # (2, 9, places) δ of 3 x 3 points of the source, in pixels
    share: Tensor  # (9, places) flux of each over that of the middle

    @classmethod
    def of(cls, source: Emitter, channel: Channel, lens: Lens, screen: Screen) -> Images:
        """Through the places that light of the middle and of all nine points gets through."""
        a, b = source.extent.half_extent
        points = [(i * APART, j * APART) for j in (-1, 0, 1) for i in (-1, 0, 1)]
        nine = (replace(source.element(a * u, b * v), wavelength=channel.source.wavelength) for u, v in points)
        pixel, flux = seen_through([channel, *(replace(channel, source=one) for one in nine)], lens, screen, n=PLACES)
        seen = (flux > 0).all(0)
        pixel, flux = pixel[..., seen].cpu(), flux[:, seen].cpu()
        return cls(pixel[:, 0], pixel[:, 1:] - pixel[:, :1], flux[1:] / flux[0])

    def nearest(self, column: float, row: float) -> tuple[Tensor, Tensor]:
        """(offset (2, 9), share (9,)) of the image that lies nearest; of a point if none is seen."""
        if not self.at.shape[1]:
            return torch.zeros(2, 9, dtype=torch.float64), torch.ones(9, dtype=torch.float64)
        place = int(torch.argmin((self.at[0] - column) ** 2 + (self.at[1] - row) ** 2))
        return self.offset[..., place], self.share[:, place]


def _biquadratic(points: Sequence[tuple[float, float]]) -> Tensor:
    """(9, points) weights of the values at the 3 x 3 points: Lagrange's polynomials in both coordinates."""
    axes = [
        (u * (u - APART) / (2 * APART**2), 1 - (u / APART) ** 2, u * (u + APART) / (2 * APART**2))
        for u in torch.tensor(points, dtype=torch.float64).T
    ]
    return torch.stack([along * across for across in axes[1] for along in axes[0]])


def blurs(spread: Spread, lens: Lens, screen: Screen) -> tuple[Blur, ...]:
    """B of each channel of the spread, for a lens; all of one border."""
    unit = Circle(1.0) if spread.source.extent.is_round else Rectangle(2.0, 2.0)
    dots = _biquadratic(in_pairs(unit, PAIRS))
    nodes = [[k / (NODES - 1) * side for k in range(NODES)] for side in screen.shape]
    kernels = []
    for channel in spread.centre:
        seen = Images.of(spread.source, channel, lens, screen)
        near = [seen.nearest(column, row) for row in nodes[0] for column in nodes[1]]
        kernels.append([tuple((part[..., None] * dots).sum(-2) for part in image) for image in near])
    reach = max(float(offset.abs().max()) for images in kernels for offset, _ in images)
    border = min(math.ceil(reach) + 2, widest(screen, len(kernels)))
    return tuple(_blur(images, screen, border) for images in kernels)


def widest(screen: Screen, lines: int) -> int:
    """The widest border (pixels) of the transforms: no wider than the screen, and of ROOM bytes for all lines.

    Light that is shifted by more than the screen's width comes from beside it.  Near a tilted plane that some light
    grazes, images would have no end.
    """
    side = math.sqrt(ROOM / (lines * NODES**2 * BYTES))
    return max(min(max(screen.shape), int((side - max(screen.shape)) / 4)), LEAST_BORDER)


def _blur(images: Sequence[tuple[Tensor, Tensor]], screen: Screen, border: int) -> Blur:
    """From the dots of each node: offset (2, dots) in pixels, share (dots,) of the middle's flux density.

    Each dot is shared by a tent among parts of a pixel, FINER a side, whose own blur does not count.
    """
    hats = tuple(_hats(side, border) for side in screen.shape)
    side = 2 * border + 1
    size = tuple(scipy.fft.next_fast_len(hat.shape[1] + side, real=True) for hat in hats)
    own = Screen(0.0, (-side / 2, side / 2), (-side / 2, side / 2), FINER * side)
    spectra = np.zeros((len(images), size[0], size[1] // 2 + 1), dtype=complex)
    for spectrum, (offset, share) in zip(spectra, images, strict=True):
        down = offset * torch.tensor([[1.0], [-1.0]])  # rows count downwards
        dots = Landed(down.contiguous(), share / share.numel(), torch.zeros(share.shape, dtype=torch.uint8))
        waves = scipy.fft.rfft(_about_zero(tent(dots, own).numpy(), FINER * size[1], axis=1))
        waves = scipy.fft.fft(_about_zero(waves[:, : spectrum.shape[1]], FINER * size[0], axis=0), axis=0)
        spectrum[:] = waves[np.arange(size[0]) - size[0] * (np.arange(size[0]) >= (size[0] + 1) // 2)]
    return Blur(border, hats, spectra.reshape(NODES, NODES, *spectra.shape[1:]), size)


def _about_zero(values: np.ndarray, n: int, axis: int) -> np.ndarray:
    """An odd number of values along an axis, with zeros to n behind them, turned so that the middle one is first."""
    odd = values.shape[axis]
    return np.roll(np.pad(values, [(0, n - odd if k == axis else 0) for k in (0, 1)]), -(odd // 2), axis)


def _hats(side: int, border: int) -> np.ndarray:
    """(NODES, side + 2 border) hats about NODES places from border to border, constant beyond the outer ones."""
    place = np.clip((np.arange(-border, side + border) + 0.5) / side, 0, 1) * (NODES - 1)
    return np.maximum(0, 1 - np.abs(place - np.arange(NODES)[:, None]))


@torch.no_grad()
def unseen(by_images: Tensor, draw: Draw, lens: Lens, screen: Screen, *, border: int, seed: int) -> Tensor:
    """(rows, columns) of the picture, what the images leave out, by two sets of rays; nothing where noise hides it.

    by_images: the picture by them, over the light that faces and glass leave; border: theirs.

    d_i = E_i - B E_0 of two sets share what is left out, and no noise: of their mean, smoothed, the share
    d_1 · d_2 / |(d_1 + d_2) / 2|² is taken.
    """
    here, off = by_images.cpu(), []
    for k in range(2):
        points = draw(POINTS, seed + SEED + k)
        n = max(1, round(a_side(points) * SIDE))
        rays = simulated(lens, points, screen, n=n, seed=seed + SEED + k)
        left = sum(rays.flux[line] for line in ("on target", "off target", "total internal reflection"))
        missed = (rays.box / left - here).numpy() if left > 0 else np.zeros(here.shape)
        off.append(gaussian_filter(missed, SMOOTH * (border - 2)))
    mean = (off[0] + off[1]) / 2
    noisy = float((mean**2).sum())
    share = max(float((off[0] * off[1]).sum()), 0.0) / noisy if noisy > 0 else 0.0
    return (torch.from_numpy(mean) * share).to(by_images.device)
