"""What an effect that is left out would change of the light on a target, from a few rays and the picture alone.

An effect that is switched on is light of other channels: from elsewhere, at another wavelength, or with less flux.  All
light that leaves one point b of the last face meets the same slope there, whatever channel it belongs to; where that of
a channel lands, and what is left of it, differs from b to b as directions and lengths do, smoothly, however finely the
face is shaped for the picture.  So few rays tell, as fields over the target, by how much the light that lands at t is
moved, δ_k(t), and which share w_k(t) of it is left; and with them the picture E, be it the one that is wanted or the
one that a finished lens throws, becomes

    E'(t + δ_k(t)) = Σ_k c_k w_k(t) E(t) |∂(t + δ_k)/∂t|⁻¹,  c_k the channels' weights.

What it changes is said in three numbers (`Change`).  The change of RRMSD is that between E' and E, both of one sum:
what RRMSD the effect alone gives a lens that is perfect without it.  Of a lens that is not, the RRMSD changes by no
more (triangle inequality), and by less as a rule, since its own error and the effect's add up as squares do.
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
from scipy.sparse import csr_array
from torch import Tensor

from bstcad.optics import planes, sampling
from bstcad.optics.channels import Channel
from bstcad.optics.ghosts import follow
from bstcad.optics.irradiance import Screen, landed_flux
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.rays import Landed
from bstcad.optics.simulation import clear_window
from bstcad.optics.trace import to_plane, trace
from bstcad.optics.tubes.finding import rays_to

PLACES = 64  # a side of the last face, from which light is followed
GHOSTS, GRAIN = 128, 0.7  # rays a side that a ghost is followed by, and cells over which its picture is smoothed
CELLS = 24  # a side of the target, in each of which what it tells is averaged
SPREAD = (0.8, 2.0, 6.0, 24.0)  # cells over which that is smoothed; the wider ones where hardly any light lands
ENOUGH = 1e-4  # of the mean flux of a cell, smoothed: less does not tell
STILL = 1e-6  # pixels; light that is moved by less stays
DARK = 0.01  # of the mean of a picture: what is darker is not lit
BLUNT = 1.3  # pixels along a side that a cell lights where edges are half as sharp; measured on the templates' designs
MOST = 1 << 19  # pixels of a picture of which all rows are looked at
MARGIN = 4  # pixels of dark around a picture, more than a spline rings far
AIRY = 0.376  # standard deviation of the Gaussian as wide at half its height as the image of a point, in λ L / D


@dataclass(frozen=True)
class Change:
    """What an effect would change."""

    flux: float  # relative change of the light on the target
    rrmsd: float  # √(Σ |E' - E|² / Σ E²), E' the picture with the effect, of the sum of E
    blur: float  # pixels; the diameter of an even disc, in whose image each point of the picture is spread as widely


@dataclass(frozen=True, eq=False)
class Reference:
    """The light of one channel on its way to the picture that is to change."""

    lens: Lens
    channel: Channel
    screen: Screen
    picture: np.ndarray  # (rows, columns) flux in each pixel, row 0 = y max, of any sum
    places: tuple[Tensor, Tensor]  # (n, n) points of the last face (mm)
    pixel: np.ndarray  # (2, n, n) (column, row) where the light from there lands
    flux: np.ndarray  # (n, n) of it; zero where none does
    through: np.ndarray  # (n, n) share of the flux that the losses of the channel itself leave
    control_points: int  # a side of the lens as it will be: how sharp the light can be

    @classmethod
    @torch.no_grad()
    def of(
        cls, lens: Lens, channel: Channel, screen: Screen, picture: np.ndarray, control_points: int | None = None
    ) -> Reference:
        """Light from PLACES x PLACES places of the part of the last face that is lit.

        control_points: of the finished lens, if this is not it.
        """
        window = Rectangle(*(2 * half for half in lens.apertures[1].half_extent))
        for few in (32, PLACES):  # to find the lit part; in it
            x, y = sampling.grid(window, few)
            landed, density = _followed(lens, channel, screen, x, y)
            lit = landed.alive & lens.apertures[1].contains(x, y) & (density > 0)
            if not bool(lit.any()):
                break
            reach = (float(p.abs()[lit].max()) + size / few for p, size in zip((x, y), _sides(window), strict=True))
            window = Rectangle(*(min(2 * r, size) for r, size in zip(reach, _sides(window), strict=True)))
        flux = torch.where(lit, density, torch.zeros_like(density)).numpy()
        pixel = screen.pixels_of(landed.position).numpy()
        points = control_points or lens.back.m
        return cls(lens, channel, screen, np.asarray(picture, float), (x, y), pixel, flux, _share(landed), points)

    @property
    def lit(self) -> bool:
        """Does any of the light reach the target?"""
        return bool(self.picture.sum() > 0 and (self.flux > 0).any() and self._landing(self.flux).any())

    def change(self, channels: Sequence[Channel]) -> Change | None:
        """What it changes if the light is that of these channels, whose weights sum to 1; None if there is none."""
        if not self.lit:
            return None
        return self._between([(channel.weight, *self._fields(channel)) for channel in channels])

    @torch.no_grad()
    def _fields(self, channel: Channel) -> tuple[np.ndarray, np.ndarray]:
        """(shift (2, …) in pixels, share (…)) of the light of a channel, in cells of the target."""
        landed, _ = _followed(self.lens, channel, self.screen, *self.places)
        arrives = landed.alive.numpy()
        share = self._over_cells(np.where(arrives, _share(landed) / self.through, 0.0), self.flux)
        by = self._pixels(landed.position) - self.pixel
        return np.stack(
            [self._over_cells(p, np.where(arrives, self.flux, 0.0)) for p in np.where(arrives, by, 0)]
        ), share

    def _pixels(self, position: Tensor) -> np.ndarray:
        """(2, …) column and row of places on the screen (mm)."""
        return self.screen.pixels_of(position).numpy()

    def _over_cells(self, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """(rows, columns) in cells of the target: what light from the places says of where it lands, by its flux."""
        sums = [self._landing(weight * v) for v in (values, 1.0)]
        field, known = np.zeros(sums[0].shape), np.zeros(sums[0].shape, bool)
        for sigma in SPREAD:
            held, light = (scipy.ndimage.gaussian_filter(s, sigma, mode="constant") for s in sums)
            new = ~known & (light > ENOUGH * sums[1].mean())
            field[new], known = held[new] / light[new], known | new
        return np.where(known, field, field[known].mean() if known.any() else values.mean())

    def _landing(self, amount: np.ndarray, pixel: np.ndarray | None = None) -> np.ndarray:
        """(rows, columns) in cells of the target: what of an amount (n, n) at the places lands in each."""
        shape, cells = self.screen.shape, _cells(self.screen)
        pixel = self.pixel if pixel is None else pixel
        row, column = (np.floor(p / side * count) for p, side, count in zip(pixel[::-1], shape, cells, strict=True))
        there = (amount != 0) & (row >= 0) & (row < cells[0]) & (column >= 0) & (column < cells[1])
        index = (row[there] * cells[1] + column[there]).astype(int)
        return np.bincount(index, amount[there], math.prod(cells)).reshape(cells)

    def _between(self, parts: list[tuple[float, np.ndarray, np.ndarray]]) -> Change:
        before, zoom = self.spline.rows(self.picture), Zoom.of(_cells(self.screen), self.screen.shape)
        changed = sum(
            weight * zoom(share)[self.spline.chosen] * self.spline.moved(shift, zoom) for weight, shift, share in parts
        )
        mean = sum(weight * shift for weight, shift, _ in parts)
        square = sum(weight * ((shift - mean) ** 2).sum(0) for weight, shift, _ in parts)
        spread = float(
            (self.picture * zoom(square)).sum() / self.picture.sum()
        )  # an even disc of diameter D has D² / 8
        return Change(float(changed.sum() / before.sum() - 1), difference(changed, before), math.sqrt(8 * spread))

    @cached_property
    def spline(self) -> Spline:
        """The picture as a function of place."""
        return Spline.through(self.picture, self._grain())

    def _grain(self) -> float:
        """Pixels, along a side, that the light of a control cell falls on: the finest that the lens can shape."""
        (left, right), (low, high) = self.lens.back.x, self.lens.back.y
        cells = (self.flux > 0).sum() * self._cell() / ((right - left) * (high - low)) * (self.control_points - 1) ** 2
        return math.sqrt((self.picture > DARK * self.picture.mean()).sum() / max(cells, 1.0))

    def _cell(self) -> float:
        """mm² of the last face that a place stands for."""
        return math.prod(float(p.max() - p.min()) / (p.shape[0] - 1) for p in self.places)

    @torch.no_grad()
    def ghost(self, channel: Channel) -> Change | None:
        """What light adds that is reflected twice inside the lens; channel: the light with what faces reflect of it."""
        if not self.lit:
            return None
        lens, source = channel.through(self.lens), channel.source
        area = clear_window(source, lens)
        rays = source.rays(*sampling.grid(area, GHOSTS), lens.entrance.z, area.area / GHOSTS**2)
        straight = float(landed_flux(trace(rays, lens, self.screen.plane)).sum())
        landed = to_plane(follow(rays, lens)[0], self.screen.plane)
        flux = torch.where(landed.alive, landed.flux, torch.zeros_like(landed.flux)).numpy() / straight
        cells = self._landing(flux, self._pixels(planes.coordinates(landed, self.screen.plane)))
        share, cells = float(cells.sum()), scipy.ndimage.gaussian_filter(cells, GRAIN, mode="nearest")
        zoom = Zoom.of(cells.shape, self.screen.shape)
        added = zoom(cells / max(cells.sum(), 1e-300)) * (share * cells.size / self.picture.size)
        before = self.picture / self.picture.sum()
        return Change(share, difference(before + added, before), 0.0)

    def diffraction(self) -> Change | None:
        """What diffraction at the aperture changes: the image of a point is λ L / D wide.

        L is the way from lens to target, D the side of a square as large as the lit part of the lens.  Light of one
        wavelength that comes from one point makes finer fringes besides, which are not estimated.
        """
        if not self.lit:
            return None
        aperture = math.sqrt((self.flux > 0).sum() * self._cell())
        per_mm = math.sqrt(math.prod(self.screen.per_mm))
        width = self.channel.source.wavelength * 1e-6 * (self.screen.z - self.lens.back.z) / aperture * per_mm
        return Change(0.0, difference(blurred(self.picture, AIRY * width), self.picture), width)


@dataclass(frozen=True)
class Zoom:
    """From cells of the target to pixels, linear between the middles of the cells."""

    along: tuple[csr_array, csr_array]  # (pixels, cells) of rows and columns
    slopes: tuple[csr_array, csr_array]  # the same for the derivatives, in cells by pixel

    @classmethod
    def of(cls, cells: tuple[int, int], shape: tuple[int, int]) -> Zoom:
        """For so many cells, and pixels, along rows and columns."""
        along, slopes = [], []
        for count, side in zip(cells, shape, strict=True):
            at = ((np.arange(side) + 0.5) / side * count - 0.5).clip(0, count - 1)
            line = np.clip(1 - np.abs(at[:, None] - np.arange(count)), 0, None)
            along.append(csr_array(line))
            slopes.append(csr_array(np.gradient(line, axis=0)))
        return cls(tuple(along), tuple(slopes))

    def __call__(self, field: np.ndarray) -> np.ndarray:
        """(rows, columns) in pixels."""
        return _spread(self.along[0], field, self.along[1])

    def divergence(self, shift: np.ndarray) -> np.ndarray:
        """(rows, columns) of a shift (2, …) in pixels along columns and rows."""
        (along_rows, along_columns), (by_row, by_column) = self.along, self.slopes
        return _spread(along_rows, shift[0], by_column) + _spread(by_row, shift[1], along_columns)


def _spread(rows: csr_array, field: np.ndarray, columns: csr_array) -> np.ndarray:
    """rows · field · columnsᵀ; columns first, so that the result lies row by row."""
    return rows @ np.ascontiguousarray((columns @ field.T).T)


@dataclass(frozen=True, eq=False)
class Spline:
    """A picture as a function of place, to be moved by parts of a pixel.

    Light that is even within each pixel, and jumps between them, changes in proportion to a small shift; light that is
    as smooth as a cubic spline, with the square of a small blur.  A lens whose control cells light less than a pixel
    each makes edges like the former, one whose cells light several makes none: `sharp` is the part of the former.
    """

    picture: np.ndarray  # (rows, columns)
    padded: np.ndarray  # it in a margin of dark
    coefficients: np.ndarray  # of the spline through that
    sharp: float  # 1 / (1 + (grain / BLUNT)⁴), grain the pixels along a side that a cell lights
    chosen: slice  # the rows that are looked at: all, or of large pictures so many as tell

    @classmethod
    def through(cls, picture: np.ndarray, grain: float) -> Spline:
        """The spline through the middles of the pixels."""
        padded = np.pad(picture, MARGIN)
        step = math.ceil(picture.size / MOST)
        coefficients = scipy.ndimage.spline_filter(padded, 3)
        return cls(picture, padded, coefficients, 1 / (1 + (grain / BLUNT) ** 4), slice(step // 2, None, step))

    def rows(self, picture: np.ndarray) -> np.ndarray:
        """Of a picture the rows that are looked at."""
        return picture[self.chosen]

    def moved(self, shift: np.ndarray, zoom: Zoom) -> np.ndarray:
        """The rows of the picture whose light is moved by `shift` (2, …) pixels along columns and rows, in cells.

        What leaves the picture is lost.
        """
        if not np.abs(shift).max() > STILL:
            return self.rows(self.picture)
        dx, dy = (zoom(p)[self.chosen] for p in shift)
        rows, columns = np.arange(len(self.picture))[self.chosen, None], np.arange(self.picture.shape[1])
        at = [rows - dy + MARGIN, columns - dx + MARGIN]
        smooth = scipy.ndimage.map_coordinates(self.coefficients, at, order=3, mode="constant", prefilter=False)
        even = scipy.ndimage.map_coordinates(self.padded, at, order=1, mode="constant")
        return (smooth + self.sharp * (even - smooth)) / (1 + zoom.divergence(shift)[self.chosen])


def blurred(picture: np.ndarray, sigma: float) -> np.ndarray:
    """The picture convolved with a Gaussian of standard deviation sigma (pixels), mirrored at its borders."""
    along = (np.exp(-0.5 * (sigma * np.pi * np.arange(side) / side) ** 2) for side in picture.shape)
    return scipy.fft.idctn(scipy.fft.dctn(picture) * np.outer(*along))


def difference(changed: np.ndarray, before: np.ndarray) -> float:
    """√(Σ |E' - E|² / Σ E²), E' scaled to the sum of E; all of it if nothing is left."""
    if not changed.sum() > 0:
        return 1.0
    scaled = changed * (before.sum() / changed.sum())
    return float(np.sqrt(((scaled - before) ** 2).sum() / (before**2).sum()))


def _followed(lens: Lens, channel: Channel, screen: Screen, x: Tensor, y: Tensor) -> tuple[Landed, Tensor]:
    """Where light of a channel that passes (x, y) of the last face lands, of flux 1 before losses; its flux density."""
    lens, source = channel.through(lens), channel.source
    p, q, _ = rays_to(source, lens, x, y)
    rays = source.rays(p, q, lens.entrance.z, 1.0)
    stretch = [torch.gradient(c) for c in (p, q)]
    density = rays.flux * (stretch[0][0] * stretch[1][1] - stretch[0][1] * stretch[1][0]).abs()
    return trace(replace(rays, flux=torch.ones_like(rays.flux)), lens, screen.plane), density


def _share(landed: Landed) -> np.ndarray:
    return np.maximum(landed.flux.numpy(), 1e-12)


def _sides(window: Rectangle) -> tuple[float, float]:
    return window.width, window.height


def _cells(screen: Screen) -> tuple[int, int]:
    """Rows and columns of cells."""
    return tuple(min(CELLS, side) for side in screen.shape)
