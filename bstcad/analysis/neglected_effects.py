"""Effects that a scene neglects: how each would change the light on the target, from few rays and the picture.

An effect adds channels of light: from another point, at another wavelength, or with less flux.  Light of every channel
that leaves one point b of the last face meets the same slope there.  The landing point and the transmitted share of a
channel vary with b as smoothly as directions and lengths do, however fine the face is.  So few rays suffice for two
fields over the target: δ_k(t), the shift of the light of channel k that lands at t, and w_k(t), its transmitted share.
The picture E, of the target or of a finished lens, becomes

    E'(t + δ_k(t)) = Σ_k c_k w_k(t) E(t) |∂(t + δ_k)/∂t|⁻¹,  c_k the channels' weights.

`Change` holds three numbers.  Its RRMSD is that between E' and E, both scaled to one sum: the RRMSD that the effect
alone gives a lens which is perfect without it.  The RRMSD of a real lens changes by no more (triangle inequality), and
usually by less, since the lens's own error and the effect's add up as squares.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.fft
import scipy.ndimage
import torch
from torch import Tensor

from bstcad.optics import sampling
from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen, landed_flux
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.rays import Landed
from bstcad.optics.trace import clear_window, follow_ghost, trace
from bstcad.optics.tubes import rays_to
from bstcad.optics.unfolding import per_radian

PLACES = 64  # points a side of the last face, from which light is traced
GHOSTS, GRAIN = 128, 0.7  # rays a side of a ghost; cells over which the ghost's picture is smoothed
CELLS = 24  # a side of the target; fields are averaged in each
SPREAD = (0.8, 2.0, 6.0, 24.0)  # cells over which fields are smoothed; the wider ones where hardly any light lands
ENOUGH = 1e-4  # of the mean flux of a cell, smoothed: a field is unknown where there is less
STILL = 1e-6  # pixels; smaller shifts count as none
DARK = 0.01  # of the mean of a picture: darker pixels are not lit
BLUNT = 1.3  # pixels along a side that a cell lights where edges are half as sharp; measured on the templates' designs
SHARPEST = 0.75  # of a jump between pixels, at an edge that cells much smaller than a pixel make; measured there, too
MOST = 1 << 19  # pixels; of larger pictures some rows are sampled
MARGIN = 4  # dark pixels around a picture; the ringing of a spline ends within them
AIRY = 0.376  # standard deviation of the Gaussian as wide at half its height as the image of a point, in λ L / D


@dataclass(frozen=True)
class Change:
    """The changes that an effect would bring."""

    flux: float  # relative change of the light on the target
    rrmsd: float  # √(Σ |E' - E|² / Σ E²), E' the picture with the effect, scaled to the sum of E
    blur: float  # pixels; diameter of an even disc with the variance of the point images


@dataclass(frozen=True, eq=False)
class Reference:
    """The light of one channel on its way to the picture, without the effect."""

    lens: Lens
    channel: Channel
    screen: Screen
    picture: np.ndarray  # (rows, columns) flux in each pixel, row 0 = y max, of any sum
    places: tuple[Tensor, Tensor]  # (n, n) points of the last face (mm)
    pixel: np.ndarray  # (2, n, n) (column, row) where the light from these points lands
    flux: np.ndarray  # (n, n) its flux; zero where no light lands
    through: np.ndarray  # (n, n) share of the flux that the channel's own losses leave
    control_points: int  # of the finished lens, in all; they bound the sharpness of the light

    @classmethod
    @torch.no_grad()
    def of(
        cls, lens: Lens, channel: Channel, screen: Screen, picture: np.ndarray, control_points: int | None = None
    ) -> Reference:
        """Light from PLACES x PLACES points of the lit part of the last face.

        control_points: of the finished lens, in all, if `lens` is a coarser one.
        """
        window = Rectangle(*(2 * half for half in lens.apertures[1].half_extent))
        for few in (32, PLACES):  # the first grid finds the lit part
            x, y = sampling.grid(window, few)
            landed, density = _followed(lens, channel, screen, (x, y))
            lit = landed.alive & lens.apertures[1].contains(x, y) & (density > 0)
            if not bool(lit.any()):
                break
            sides = zip((x, y), (window.width, window.height), strict=True)
            window = Rectangle(*(min(2 * (float(p.abs()[lit].max()) + side / few), side) for p, side in sides))
        return cls(
            lens, channel, screen, np.asarray(picture, float), places=(x, y),
            pixel=screen.pixels_of(landed.position).numpy(),
            flux=torch.where(lit, density, torch.zeros_like(density)).numpy(),
            through=_share(landed), control_points=control_points or lens.back.heights.numel(),
        )  # fmt: skip

    @cached_property
    def lit(self) -> bool:
        """Does any of the light reach the target?"""
        return bool(self.picture.sum() > 0 and self._landing(self.flux).any())

    @cached_property
    def spline(self) -> Spline:
        """The picture as a spline."""
        return Spline.through(self.picture, self._grain())

    @torch.no_grad()
    def change(self, channels: Sequence[Channel]) -> Change | None:
        """The change if the light is that of these channels, whose weights sum to 1; None if none is lit."""
        if not self.lit:
            return None
        parts = [(channel.weight, *self._fields(channel)) for channel in channels]
        before, shape = self.spline.rows(self.picture), self.screen.shape
        changed = sum(
            weight * self.spline.rows(zoomed(share, shape)) * self.spline.moved(shift) for weight, shift, share in parts
        )
        mean = sum(weight * shift for weight, shift, _ in parts)
        square = sum(weight * ((shift - mean) ** 2).sum(0) for weight, shift, _ in parts)
        variance = float((self.picture * zoomed(square, shape)).sum() / self.picture.sum())  # D² / 8 of an even disc
        return Change(float(changed.sum() / before.sum() - 1), difference(changed, before), math.sqrt(8 * variance))

    def _fields(self, channel: Channel) -> tuple[np.ndarray, np.ndarray]:
        """(shift (2, …) in pixels, share (…)) of the light of a channel, in cells of the target."""
        landed, _ = _followed(self.lens, channel, self.screen, self.places)
        arrives = landed.alive.numpy()
        share = self._over_cells(np.where(arrives, _share(landed) / self.through, 0.0), self.flux)
        shift = np.where(arrives, self.screen.pixels_of(landed.position).numpy() - self.pixel, 0)
        return np.stack([self._over_cells(p, np.where(arrives, self.flux, 0.0)) for p in shift]), share

    def _over_cells(self, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """(rows, columns) in cells of the target: the mean of values (n, n) of the light that lands there, by flux."""
        sums = [self._landing(weight * v) for v in (values, 1.0)]
        field, known = np.zeros(sums[0].shape), np.zeros(sums[0].shape, bool)
        for sigma in SPREAD:
            total, light = (scipy.ndimage.gaussian_filter(s, sigma, mode="constant") for s in sums)
            new = ~known & (light > ENOUGH * sums[1].mean())
            field[new], known = total[new] / light[new], known | new
        return np.where(known, field, field[known].mean() if known.any() else values.mean())

    def _landing(self, amount: np.ndarray, pixel: np.ndarray | None = None) -> np.ndarray:
        """(rows, columns) in cells of the target: the sum of an amount (n, n) over the light that lands in each."""
        shape, cells = self.screen.shape, tuple(min(CELLS, side) for side in self.screen.shape)
        pixel = self.pixel if pixel is None else pixel
        row, column = (np.floor(p / side * count) for p, side, count in zip(pixel[::-1], shape, cells, strict=True))
        there = (amount != 0) & (row >= 0) & (row < cells[0]) & (column >= 0) & (column < cells[1])
        index = (row[there] * cells[1] + column[there]).astype(int)
        return np.bincount(index, amount[there], math.prod(cells)).reshape(cells)

    def _grain(self) -> float:
        """Pixels, along a side, that the light of a control cell falls on: the finest that the lens can shape."""
        (left, right), (low, high) = self.lens.back.x, self.lens.back.y
        cells = self._lit_area() / ((right - left) * (high - low)) * (math.sqrt(self.control_points) - 1) ** 2
        return math.sqrt((self.picture > DARK * self.picture.mean()).sum() / max(cells, 1.0))

    def _lit_area(self) -> float:
        """mm² of the last face."""
        cell = math.prod(float(p.max() - p.min()) / (p.shape[0] - 1) for p in self.places)
        return (self.flux > 0).sum() * cell

    @torch.no_grad()
    def ghost(self, channel: Channel) -> Change | None:
        """The change by light that is reflected twice inside the lens.  channel: with the reflection at the faces."""
        if not self.lit:
            return None
        lens, source = channel.through(self.lens), channel.source
        area = clear_window(source, lens)
        rays = source.rays(*sampling.grid(area, GHOSTS), lens.entrance.z, area.area / GHOSTS**2)
        straight = float(landed_flux(trace(rays, lens, self.screen.plane)).sum())
        landed = self.screen.plane.land(follow_ghost(rays, lens)[0])
        flux = torch.where(landed.alive, landed.flux, torch.zeros_like(landed.flux)).numpy() / straight
        cells = self._landing(flux, self.screen.pixels_of(landed.position).numpy())
        share, cells = float(cells.sum()), scipy.ndimage.gaussian_filter(cells, GRAIN, mode="nearest")
        added = zoomed(cells / max(cells.sum(), 1e-300), self.screen.shape) * (share * cells.size / self.picture.size)
        before = self.picture / self.picture.sum()
        return Change(share, difference(before + added, before), 0.0)

    def diffraction(self) -> Change | None:
        """The change by diffraction at the aperture: the image of a point is λ L / D wide.

        L is the distance from lens to target, D the side of a square of the area of the lit part of the lens.
        Monochromatic light of a point makes finer fringes besides; they are not estimated.
        """
        if not self.lit:
            return None
        per_unit = math.sqrt(math.prod(self.screen.per_unit))
        wavelength: float = self.channel.source.wavelength  # type: ignore[assignment]  # a channel has one line
        width = wavelength * 1e-6 * per_radian(self.lens, self.screen) / math.sqrt(self._lit_area()) * per_unit
        return Change(0.0, difference(blurred(self.picture, AIRY * width), self.picture), width)


@dataclass(frozen=True, eq=False)
class Spline:
    """A picture as a function of x and y, to be moved by parts of a pixel.

    Light that is even within each pixel, and jumps between pixels, changes in proportion to a small shift; light as
    smooth as a cubic spline changes with the square of a small blur.  A lens whose control cells light less than a
    pixel each makes most of such a jump; a lens whose cells light several makes none: `sharp` is the jumps' weight.
    """

    padded: np.ndarray  # (rows, columns) the picture in a dark margin
    coefficients: np.ndarray  # of the spline through the padded picture
    sharp: float  # SHARPEST / (1 + (grain / BLUNT)⁴), grain the pixels along a side that a cell lights
    chosen: slice  # the sampled rows: all rows, or of large pictures every k-th

    @classmethod
    def through(cls, picture: np.ndarray, grain: float) -> Spline:
        """The spline through the middles of the pixels."""
        padded, step = np.pad(picture, MARGIN), math.ceil(picture.size / MOST)
        coefficients = scipy.ndimage.spline_filter(padded, 3)
        return cls(padded, coefficients, SHARPEST / (1 + (grain / BLUNT) ** 4), slice(step // 2, None, step))

    def rows(self, picture: np.ndarray) -> np.ndarray:
        """The sampled rows of a picture."""
        return picture[self.chosen]

    def moved(self, shift: np.ndarray) -> np.ndarray:
        """The rows of the picture whose light is moved by `shift` (2, …) pixels along columns and rows, in cells.

        Light that leaves the picture is lost.
        """
        picture = self.padded[MARGIN:-MARGIN, MARGIN:-MARGIN]
        if not np.abs(shift).max() > STILL:
            return self.rows(picture)
        across, down = (zoomed(p, picture.shape) for p in shift)
        rows, columns = np.indices(picture.shape, sparse=True)
        at = [self.rows(p) + MARGIN for p in (rows - down, columns - across)]
        smooth = scipy.ndimage.map_coordinates(self.coefficients, at, order=3, mode="constant", prefilter=False)
        even = scipy.ndimage.map_coordinates(self.padded, at, order=1, mode="constant")
        divergence = np.gradient(across, axis=1) + np.gradient(down, axis=0)
        return (smooth + self.sharp * (even - smooth)) / (1 + self.rows(divergence))


def zoomed(field: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(rows, columns) in pixels of a field in cells of the target, linear between the middles of the cells."""
    for axis, pixels in enumerate(shape):
        cells = field.shape[axis]
        at = ((np.arange(pixels) + 0.5) / pixels * cells - 0.5).clip(0, cells - 1)
        low = at.astype(int)
        share = (at - low).reshape((-1, 1) if axis == 0 else (1, -1))
        below, above = (field.take(cell, axis) for cell in (low, (low + 1).clip(max=cells - 1)))
        field = below + share * (above - below)
    return field


def blurred(picture: np.ndarray, sigma: float) -> np.ndarray:
    """The picture convolved with a Gaussian of standard deviation sigma (pixels), mirrored at its borders."""
    along = (np.exp(-0.5 * (sigma * np.pi * np.arange(side) / side) ** 2) for side in picture.shape)
    return scipy.fft.idctn(scipy.fft.dctn(picture) * np.outer(*along))


def difference(changed: np.ndarray, before: np.ndarray) -> float:
    """√(Σ |E' - E|² / Σ E²), E' scaled to the sum of E; 1 if E' is dark."""
    if not changed.sum() > 0:
        return 1.0
    scaled = changed * (before.sum() / changed.sum())
    return float(np.sqrt(((scaled - before) ** 2).sum() / (before**2).sum()))


def _followed(lens: Lens, channel: Channel, screen: Screen, places: tuple[Tensor, Tensor]) -> tuple[Landed, Tensor]:
    """The landing of a channel's light through places of the last face, of flux 1 before losses; its flux density."""
    lens, source = channel.through(lens), channel.source
    p, q, _ = rays_to(source, lens, *places)
    rays = source.rays(p, q, lens.entrance.z, 1.0)
    (p_x, p_y), (q_x, q_y) = (torch.gradient(c) for c in (p, q))
    density = rays.flux * (p_x * q_y - p_y * q_x).abs()
    return trace(replace(rays, flux=torch.ones_like(rays.flux)), lens, screen.plane), density


def _share(landed: Landed) -> np.ndarray:
    return np.maximum(landed.flux.numpy(), 1e-12)
