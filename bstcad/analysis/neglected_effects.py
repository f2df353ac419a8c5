"""Effects that a scene neglects: an estimate of the change of the light on the target, from few rays and the picture.

An effect adds channels of light: from another point, at another wavelength, or with less flux.  At a point b of the
last face the light of all channels meets the same slope.  So a channel's shift of the landing point and its
transmission vary with b as smoothly as directions and lengths do, however fine the structure of the face.  Few rays
therefore suffice for two fields over the target, of the light that lands at t without the effect: its shift δ_k(t) and
its relative transmission w_k(t) in channel k.  The picture E, of the target or of a finished lens, becomes

    E'(t') = Σ_k c_k w_k(t) E(t) |∂t'/∂t|⁻¹,  t' = t + δ_k(t),  c_k the weights of the channels.

`Change` is the result.  Its RRMSD is between E' and E, normalised to the same sum: the RRMSD of a lens that is perfect
without the effect.  The RRMSD of a real lens changes by no more (triangle inequality), and usually by less, since its
own error and that of the effect add up as squares.
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

from bstcad.analysis.cost import DARK_LEVEL
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.receivers.irradiance import Screen, landed_flux
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.rays import Landed
from bstcad.optics.trace.trace import clear_window, trace, trace_ghost
from bstcad.optics.trace.tubes import rays_to
from bstcad.optics.trace.unfolding import per_radian

FACE_POINTS = 64  # points per side of the last face from which light is traced
GHOST_RAYS_PER_SIDE, GHOST_SMOOTHING = 128, 0.7  # rays per side for a ghost; standard deviation of its blur (cells)
FIELD_CELLS = 24  # largest number of cells per side of the target, in which the fields are averaged
FIELD_SMOOTHING = (0.8, 2.0, 6.0, 24.0)  # standard deviations of the smoothing (cells), wider where light is scarce
MIN_CELL_FLUX = 1e-4  # smoothed flux of a cell / mean, below which a field needs wider smoothing
MIN_LIGHT_SHIFT = 1e-6  # largest shift that counts as zero (pixels)
HALF_SHARP_WIDTH = 1.3  # width of a control cell's light (pixels) at which edges are half as sharp as at best, measured
MAX_SHARPNESS = 0.75  # fraction of the jump at an edge that the finest cells reproduce, measured
MAX_SAMPLED_PIXELS = 1 << 19  # largest number of sampled pixels: of a larger picture only some rows are used
PADDING = 4  # dark pixels around a picture, within which the ringing of its spline ends
AIRY_SIGMA = 0.376  # standard deviation of the Gaussian with the FWHM of a point's image, in units of λ L / D


@dataclass(frozen=True)
class Change:
    """Change of the light on the target by an effect."""

    flux: float  # relative change of the light on the target
    rrmsd: float  # √(Σ |E' - E|² / Σ E²), E' the picture with the effect, scaled to the sum of E
    blur: float  # diameter of a uniform disc with the variance of the point images (pixels); diffraction: λ L / D


@dataclass(frozen=True, eq=False)
class Reference:
    """Light of one channel through a lens, and the picture on the target, without the effect."""

    lens: Lens  # lens that the light passes
    channel: Channel  # light without the effect
    screen: Screen  # target
    picture: np.ndarray  # flux in each pixel (rows, columns), row 0 = y max, of any sum
    points: tuple[Tensor, Tensor]  # x and y of points of the last face (mm), (n, n) each
    pixel: np.ndarray  # landing points (column, row) of the light from these points, (2, n, n)
    flux: np.ndarray  # flux of this light, (n, n); zero where none lands
    through: np.ndarray  # transmission of the channel, (n, n)
    control_points: int  # number of control points of the finished lens, which limits the sharpness of the light

    @classmethod
    @torch.no_grad()
    def of(
        cls, lens: Lens, channel: Channel, screen: Screen, picture: np.ndarray, control_points: int | None = None
    ) -> Reference:
        """Trace light from FACE_POINTS x FACE_POINTS points of the lit part of the last face.

        picture: flux per pixel.  control_points: number of control points of the finished lens; None: that of `lens`.
        """
        half_x, half_y = lens.apertures[1].half_extent
        for few in (32, FACE_POINTS):  # the first grid finds the lit part
            window = Rectangle(2 * half_x, 2 * half_y)
            x, y = sampling.grid(window, few)
            landed, density = _trace_through(lens, channel, screen, (x, y))
            lit = landed.alive & lens.apertures[1].contains(x, y) & (density > 0)
            if not bool(lit.any()):
                break
            sides = zip((x, y), (window.width, window.height), strict=True)
            half_x, half_y = (min(float(p.abs()[lit].max()) + side / few, side / 2) for p, side in sides)
        pixel, through = screen.pixels_of(landed.position).numpy(), _transmission(landed)
        flux = torch.where(lit, density, torch.zeros_like(density)).numpy()
        picture, count = np.asarray(picture, float), control_points or lens.back_net.heights.numel()
        return cls(
            lens, channel, screen, picture, points=(x, y), pixel=pixel, flux=flux, through=through, control_points=count
        )

    @cached_property
    def lit(self) -> bool:
        """True if any light reaches the target."""
        return bool(self.picture.sum() > 0 and self._landing(self.flux).any())

    @cached_property
    def spline(self) -> Spline:
        """Picture as a spline, for shifts by fractions of a pixel."""
        return Spline.through(self.picture, self._cell_width())

    @torch.no_grad()
    def change(self, channels: Sequence[Channel]) -> Change | None:
        """Return the change if the light consists of these channels, whose weights sum to 1; None without light."""
        if not self.lit:
            return None
        parts = [(channel.weight, *self._fields(channel)) for channel in channels]  # (c, δ, w)
        before, shape = self.spline.rows(self.picture), self.screen.shape
        rows = self.spline.rows
        changed = sum(c * rows(to_pixels(share, shape)) * self.spline.moved(shift) for c, shift, share in parts)
        mean = sum(weight * shift for weight, shift, _ in parts)
        square = sum(weight * ((shift - mean) ** 2).sum(0) for weight, shift, _ in parts)
        # variance of a uniform disc of diameter D: D² / 8
        variance = float((self.picture * to_pixels(square, shape)).sum() / self.picture.sum())
        return Change(float(changed.sum() / before.sum() - 1), difference(changed, before), math.sqrt(8 * variance))

    def _fields(self, channel: Channel) -> tuple[np.ndarray, np.ndarray]:
        """Return shift δ (2, …) in pixels and relative transmission w (…) of a channel, for each cell of the target."""
        landed, _ = _trace_through(self.lens, channel, self.screen, self.points)
        arrives = landed.alive.numpy()
        share = self._over_cells(np.where(arrives, _transmission(landed) / self.through, 0.0), self.flux)
        shift = np.where(arrives, self.screen.pixels_of(landed.position).numpy() - self.pixel, 0)
        return np.stack([self._over_cells(p, np.where(arrives, self.flux, 0.0)) for p in shift]), share

    def _over_cells(self, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return the smoothed mean, with `weight`, of values (n, n) of the light in each cell of the target."""
        sums = [self._landing(weight * v) for v in (values, 1.0)]
        field, known = np.zeros(sums[0].shape), np.zeros(sums[0].shape, bool)
        for sigma in FIELD_SMOOTHING:
            total, light = (scipy.ndimage.gaussian_filter(s, sigma, mode="constant") for s in sums)
            new = ~known & (light > MIN_CELL_FLUX * sums[1].mean())
            field[new], known = total[new] / light[new], known | new
        return np.where(known, field, field[known].mean() if known.any() else values.mean())

    def _landing(self, amount: np.ndarray, pixel: np.ndarray | None = None) -> np.ndarray:
        """Sum `amount` (n, n) of the light that lands at `pixel` (None: `self.pixel`), by cells of the target."""
        shape, cells = self.screen.shape, tuple(min(FIELD_CELLS, side) for side in self.screen.shape)
        pixel = self.pixel if pixel is None else pixel
        row, column = (np.floor(p / side * count) for p, side, count in zip(pixel[::-1], shape, cells, strict=True))
        there = (amount != 0) & (row >= 0) & (row < cells[0]) & (column >= 0) & (column < cells[1])
        index = (row[there] * cells[1] + column[there]).astype(int)
        return np.bincount(index, amount[there], math.prod(cells)).reshape(cells)

    def _cell_width(self) -> float:
        """Return the width of the light of a control cell (pixels), the finest detail that the lens can shape."""
        (left, right), (low, high) = self.lens.back_net.x, self.lens.back_net.y
        cells = self._lit_area() / ((right - left) * (high - low)) * (math.sqrt(self.control_points) - 1) ** 2
        return math.sqrt((self.picture > DARK_LEVEL * self.picture.mean()).sum() / max(cells, 1.0))

    def _lit_area(self) -> float:
        """Return the area of the last face that is lit (mm²)."""
        cell = math.prod(float(p.max() - p.min()) / (p.shape[0] - 1) for p in self.points)
        return (self.flux > 0).sum() * cell

    @torch.no_grad()
    def ghost(self, channel: Channel) -> Change | None:
        """Return the change by light reflected twice inside the lens; channel: light with losses at the faces."""
        if not self.lit:
            return None
        lens, source = channel.through(self.lens), channel.source
        area, n = clear_window(source, lens), GHOST_RAYS_PER_SIDE
        rays = source.rays_through(*sampling.grid(area, n), lens.entrance.z, area.area / n**2)
        straight = float(landed_flux(trace(rays, lens, self.screen.receiver)).sum())
        landed = self.screen.receiver.land(trace_ghost(rays, lens)[0])
        flux = torch.where(landed.alive, landed.flux, torch.zeros_like(landed.flux)).numpy() / straight
        cells = self._landing(flux, self.screen.pixels_of(landed.position).numpy())
        share, cells = float(cells.sum()), scipy.ndimage.gaussian_filter(cells, GHOST_SMOOTHING, mode="nearest")
        scale = share * cells.size / self.picture.size
        added = to_pixels(cells / max(cells.sum(), 1e-300), self.screen.shape) * scale
        before = self.picture / self.picture.sum()
        return Change(share, difference(before + added, before), 0.0)

    def diffraction(self) -> Change | None:
        """Return the change by diffraction at the aperture, where the image of a point has the width λ L / D.

        L is the distance from lens to target, D the side of a square with the area of the lit part of the lens.
        Interference fringes of monochromatic light from a point source, which are finer, are not estimated.
        """
        if not self.lit:
            return None
        per_unit = math.sqrt(math.prod(self.screen.per_unit))
        wavelength: float = self.channel.source.wavelength  # type: ignore[assignment]  # a channel has one line
        width = wavelength * 1e-6 * per_radian(self.lens, self.screen) / math.sqrt(self._lit_area()) * per_unit
        return Change(0.0, difference(blur_by_gaussian(self.picture, AIRY_SIGMA * width), self.picture), width)


@dataclass(frozen=True, eq=False)
class Spline:
    """Picture as a function of x and y, for shifts by fractions of a pixel.

    A small blur changes a picture that jumps from pixel to pixel in proportion to the width of the blur, and a picture
    as smooth as a cubic spline in proportion to the square of this width.  If a control cell of a lens lights less than
    a pixel, the lens reproduces most of a jump; if it lights several pixels, none.  `sharp` is the weight of the jumps.
    """

    padded: np.ndarray  # picture with a dark margin, (rows, columns)
    coefficients: np.ndarray  # coefficients of the spline through the padded picture
    sharp: float  # weight of the jumps, see `through`
    chosen: slice  # sampled rows: all, or every k-th of a large picture

    @classmethod
    def through(cls, picture: np.ndarray, grain: float) -> Spline:
        """Make the spline through the centres of the pixels; grain: width of the light of a control cell (pixels)."""
        padded, step = np.pad(picture, PADDING), math.ceil(picture.size / MAX_SAMPLED_PIXELS)
        coefficients = scipy.ndimage.spline_filter(padded, 3)
        sharp = MAX_SHARPNESS / (1 + (grain / HALF_SHARP_WIDTH) ** 4)
        return cls(padded, coefficients, sharp, slice(step // 2, None, step))

    def rows(self, picture: np.ndarray) -> np.ndarray:
        """Return the sampled rows of a picture."""
        return picture[self.chosen]

    def moved(self, shift: np.ndarray) -> np.ndarray:
        """Return the sampled rows of the picture after its light is moved.  Light that leaves the picture is lost.

        shift: (2, rows, columns), pixels to the right and downwards, for each cell of the target.
        """
        picture = self.padded[PADDING:-PADDING, PADDING:-PADDING]
        if not np.abs(shift).max() > MIN_LIGHT_SHIFT:
            return self.rows(picture)
        across, down = (to_pixels(p, picture.shape) for p in shift)
        rows, columns = np.ogrid[: picture.shape[0], : picture.shape[1]]
        at = [self.rows(p) + PADDING for p in (rows - down, columns - across)]
        smooth = scipy.ndimage.map_coordinates(self.coefficients, at, order=3, mode="constant", prefilter=False)
        stepped = scipy.ndimage.map_coordinates(self.padded, at, order=1, mode="constant")
        divergence = np.gradient(across, axis=1) + np.gradient(down, axis=0)
        return (smooth + self.sharp * (stepped - smooth)) / (1 + self.rows(divergence))


def to_pixels(field: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Interpolate a field, given for each cell of the target, linearly to its pixels; shape: (rows, columns)."""
    for axis, pixels in enumerate(shape):
        cells = field.shape[axis]
        at = ((np.arange(pixels) + 0.5) / pixels * cells - 0.5).clip(0, cells - 1)
        low = at.astype(int)
        share = (at - low).reshape((-1, 1) if axis == 0 else (1, -1))
        below, above = (field.take(cell, axis) for cell in (low, (low + 1).clip(max=cells - 1)))
        field = below + share * (above - below)
    return field


def blur_by_gaussian(picture: np.ndarray, sigma: float) -> np.ndarray:
    """Convolve a picture with a Gaussian of standard deviation sigma (pixels), mirrored at the borders."""
    along = (np.exp(-0.5 * (sigma * np.pi * np.arange(side) / side) ** 2) for side in picture.shape)
    return scipy.fft.idctn(scipy.fft.dctn(picture) * np.outer(*along))


def difference(changed: np.ndarray, before: np.ndarray) -> float:
    """Return √(Σ |E' - E|² / Σ E²), E being `before` and E' `changed`, scaled to the sum of E; 1 if E' is dark."""
    if not changed.sum() > 0:
        return 1.0
    scaled = changed * (before.sum() / changed.sum())
    return float(np.sqrt(((scaled - before) ** 2).sum() / (before**2).sum()))


def _trace_through(
    lens: Lens, channel: Channel, screen: Screen, points: tuple[Tensor, Tensor]
) -> tuple[Landed, Tensor]:
    """Trace light through points of the last face; return (landed rays, of flux 1 before losses; flux per cell)."""
    lens, source = channel.through(lens), channel.source
    p, q, _ = rays_to(source, lens, *points)
    rays = source.rays_through(p, q, lens.entrance.z, 1.0)
    (p_x, p_y), (q_x, q_y) = (torch.gradient(c) for c in (p, q))
    density = rays.flux * (p_x * q_y - p_y * q_x).abs()
    return trace(replace(rays, flux=torch.ones_like(rays.flux)), lens, screen.receiver), density


def _transmission(landed: Landed) -> np.ndarray:
    return np.maximum(landed.flux.numpy(), 1e-12)
