"""Irradiance pictures and flux ledgers from the landing points of rays.

A picture is (rows, columns), row 0 = y max, column 0 = x min.  `tent` distributes a ray over the four nearest pixel
centres (differentiable, for tailoring); `box` adds it to the pixel where it lands (as a detector does, for
verification).  They sum in float64: float32 sums stop growing at 2^24 rays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from bstcad.optics.numerics import kernel_choice
from bstcad.optics.numerics.reductions import quotient, total
from bstcad.optics.receivers.receivers import LevelPlane, Receiver, TiltedPlane
from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.rays import Landed, Status, axes, clocked, clocking_of, tilt_of

LEAK_ROUNDING = 1e-12  # largest `Leak.share` that counts as rounding
MAX_DARK_VALUE = 1e-6  # largest value of a dark pixel of a target, as a fraction of its brightest pixel


Scale = tuple[float, float, float, float]  # (x_0, y_0, s_x, s_y): column and row are (x - x_0) s_x and (y - y_0) s_y


@dataclass(frozen=True)
class Screen:
    """Rectangle of a level or tilted plane, or of another receiver, divided into columns x rows of pixels."""

    z: float  # height of the plane (mm), of a tilted plane at the centre of the screen
    x: tuple[float, float]  # extent in x, in the unit of the receiver (mm on planes)
    y: tuple[float, float]  # extent in y, in the unit of the receiver
    pixels: int | tuple[int, int]  # pixels along each side, or (columns, rows)
    tilt: tuple[float, float] | None = None  # rotation about x, then about y (°; receivers.TiltedPlane); None: level
    clocking: float = 0.0  # rotation about the normal, after the tilt (°)
    surface: Receiver | None = None  # receiver that the screen is a part of; None: the plane of z, tilt and clocking

    @property
    def middle(self) -> tuple[float, float, float]:
        """Centre of the screen in space (mm)."""
        if self.surface is not None:
            return self.surface.middle
        return sum(self.x) / 2, sum(self.y) / 2, self.z

    @property
    def receiver(self) -> Receiver:
        """Receiver on which light lands: a plane, or a receiver of another form."""
        if self.surface is not None:
            return self.surface
        if self.tilt is None and self.clocking == 0:
            return LevelPlane(self.z)
        return TiltedPlane(self.middle, self.tilt or (0.0, 0.0), self.clocking)

    def moved(self, motion: Motion) -> Screen:
        """Return the screen after a motion, with the same pixels."""
        if self.surface is not None:
            return replace(self, surface=self.surface.moved(motion))
        (new_x, new_y, z), (old_x, old_y, _) = motion.point(self.middle), self.middle
        (left, right), (low, high) = self.x, self.y
        x, y = (left - old_x + new_x, right - old_x + new_x), (low - old_y + new_y, high - old_y + new_y)
        if not motion.rotates:
            return replace(self, x=x, y=y, z=z)
        e_x, e_y, n = map(motion.direction, clocked(axes(self.tilt or (0.0, 0.0)), self.clocking))
        return replace(self, x=x, y=y, z=z, tilt=tilt_of(n), clocking=clocking_of((e_x, e_y, n)))

    def divided(self, cells: int) -> Screen:
        """Return the screen with `cells` x `cells` cells in the place of each pixel."""
        return replace(self, pixels=(cells * self.columns, cells * self.rows))

    @property
    def columns(self) -> int:
        """Number of pixels along x."""
        return self.pixels if isinstance(self.pixels, int) else self.pixels[0]

    @property
    def rows(self) -> int:
        """Number of pixels along y."""
        return self.pixels if isinstance(self.pixels, int) else self.pixels[1]

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (rows, columns) of a picture on the screen."""
        return self.rows, self.columns

    @property
    def per_unit(self) -> tuple[float, float]:
        """Columns and rows per unit of the receiver's coordinates."""
        return self.columns / (self.x[1] - self.x[0]), self.rows / (self.y[1] - self.y[0])

    @property
    def pixel_side(self) -> float:
        """Side of a square with the area of a pixel, in the unit of the receiver."""
        per_x, per_y = self.per_unit
        return 1 / math.sqrt(per_x * per_y)

    @property
    def areas(self) -> np.ndarray | None:
        """Relative areas or solid angles of the pixels (rows, columns), of mean 1; None: all are equal."""
        return self.receiver.areas(self.x, self.y, self.shape)

    @property
    def cell_sizes(self) -> np.ndarray:
        """Areas (mm²) or solid angles (sr) of the pixels, (rows, columns)."""
        return self.receiver.cell_sizes(self.x, self.y, self.shape)

    def pixel(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return (column, row) of (x, y) as real numbers: pixel i extends from i to i + 1."""
        per_x, per_y = self.per_unit
        return (x - self.x[0]) * per_x, (self.y[1] - y) * per_y

    @property
    def scale(self) -> Scale:
        """Numbers (x_0, y_0, s_x, s_y): column and row of (x, y) are (x - x_0) s_x and (y - y_0) s_y."""
        per_x, per_y = self.per_unit
        return self.x[0], self.y[1], per_x, -per_y

    def pixels_of(self, position: Tensor) -> Tensor:
        """Return (column, row) (2, …) of positions (2, …), as `pixel` does."""
        return scaled(position, self.scale)

    def contains(self, x: Tensor, y: Tensor) -> Tensor:
        """Return True where (x, y) is on the screen."""
        return (x >= self.x[0]) & (x <= self.x[1]) & (y >= self.y[0]) & (y <= self.y[1])


def scaled(position: Tensor, scale: Scale) -> Tensor:
    """Return ((x - x_0) s_x, (y - y_0) s_y) (2, …) of positions (2, …)."""
    first, factor = (position.new_tensor(part).view(2, *[1] * (position.ndim - 1)) for part in (scale[:2], scale[2:]))
    return (position - first).mul_(factor)


def landed_flux(rays: Landed) -> Tensor:
    """Return the flux of each ray, zero for lost rays."""
    return torch.where(rays.alive, rays.flux, torch.zeros_like(rays.flux))


def tent(rays: Landed, screen: Screen) -> Tensor:
    """Return the flux per pixel by linear (tent) binning, float64, differentiable (Wang et al. 2023, section 2.3)."""
    return collect(rays, screen)[0]


def collect(rays: Landed, screen: Screen) -> tuple[Tensor, Tensor]:
    """Return (tent picture, Σ flux · (distance outside the border in pixels)²), float64, differentiable in position.

    Binning gives no gradient to a ray outside the screen; the second sum does.
    """
    flux = landed_flux(rays)
    if (fast := kernel_choice.kernel("irradiance.collect", rays.position, flux)) and not flux.requires_grad:
        (left, _), (_, top), (per_x, per_y) = screen.x, screen.y, screen.per_unit
        position = rays.position.reshape(2, -1).contiguous()
        return fast(position, flux.reshape(-1).contiguous(), (left, per_x, top, per_y), screen.shape)
    return collect_plain(rays.position, flux, screen)


def collect_plain(position: Tensor, flux: Tensor, screen: Screen) -> tuple[Tensor, Tensor]:
    """Compute the values of `collect` in plain torch: four pixels per ray, without pixels outside the screen."""
    column, row = (p.reshape(-1) for p in screen.pixel(position[0].double(), position[1].double()))
    flux, (rows, columns) = flux.reshape(-1).double(), screen.shape
    outside = (column - column.clamp(0, columns)) ** 2 + (row - row.clamp(0, rows)) ** 2
    column, row = column - 0.5, row - 0.5
    image = torch.zeros(rows * columns, dtype=torch.float64, device=flux.device)
    j, i = column.detach().floor(), row.detach().floor()
    for di in (0, 1):
        for dj in (0, 1):
            weight = (1 - (column - j - dj).abs()) * (1 - (row - i - di).abs()) * flux
            inside = (i + di >= 0) & (i + di < rows) & (j + dj >= 0) & (j + dj < columns)
            index = torch.where(inside, (i + di) * columns + (j + dj), torch.zeros_like(i)).long()
            image = image.index_add(0, index, torch.where(inside, weight, torch.zeros_like(weight)))
    return image.view(screen.shape), total(flux * outside)


def box(rays: Landed, screen: Screen) -> Tensor:
    """Return the flux that falls into each pixel, float64, without gradient."""
    column, row = screen.pixel(rays.position[0], rays.position[1])
    inside = rays.alive & screen.contains(rays.position[0], rays.position[1])
    rows, columns = screen.shape
    index = row.detach().floor().clamp(0, rows - 1) * columns + column.detach().floor().clamp(0, columns - 1)
    index = torch.where(inside, index, torch.zeros_like(index)).long().reshape(-1)
    weight = torch.where(inside, rays.flux, torch.zeros_like(rays.flux)).reshape(-1).double()
    image = torch.bincount(index, weights=weight.detach(), minlength=rows * columns)
    return image.view(screen.shape)


def joined_cells(picture: Tensor, count: int) -> Tensor:
    """Return the sums of count x count neighbouring cells; cells beyond the last row and column count as zero."""
    if count == 1:
        return picture
    rows, columns = (-(-side // count) for side in picture.shape)
    if (rows * count, columns * count) != tuple(picture.shape):
        whole = picture.new_zeros((rows * count, columns * count))
        whole[: picture.shape[0], : picture.shape[1]] = picture
        picture = whole
    by_row = sum(picture.view(rows, count, -1).unbind(1)[1:], picture.view(rows, count, -1)[:, 0])
    return sum(by_row.view(rows, columns, count).unbind(2)[1:], by_row.view(rows, columns, count)[..., 0])


def rrmsd(irradiance: Tensor, target: Tensor) -> Tensor:
    """Return sqrt(Σ |E_s - E|² / Σ E²), E_s: irradiance scaled to the sum of target E (Wang et al. 2023, Eq. 15)."""
    scaled = irradiance * (total(target) / total(irradiance))
    return torch.sqrt(total((scaled - target) ** 2) / total(target**2))


@dataclass(frozen=True, eq=False)
class CellTarget:
    """Target picture on cells, and the weights of the errors on pixels and on ever smaller cells in `picture_error`."""

    picture: Tensor  # target T (k rows, k columns) on the smallest cells, k = 2^(levels - 1) along each side of a pixel
    weights: tuple[float, ...]  # weights s_l / Σ T_l² of Σ D_l², for pixels (l = 0) to the smallest cells
    size: float  # Σ T_0² of the pixels

    @classmethod
    def of(cls, picture: Tensor, shares: Sequence[float] = (1.0,)) -> CellTarget:
        """Make the target of a picture on cells; shares: shares s_l of the squared errors, of the sum 1."""
        finest = 1 << (len(shares) - 1)
        sizes = [float(total(joined_cells(picture, finest >> level) ** 2)) for level in range(len(shares))]
        weights = tuple(share / size for share, size in zip(shares, sizes, strict=True))
        return cls(picture.T.contiguous().T, weights, sizes[0])  # stored by columns, as `tubes.collect` makes pictures


def picture_error(image: Tensor, flux: Tensor, target: CellTarget) -> tuple[Tensor, Tensor]:
    """Return (error of a picture on all scales, its RRMSD on pixels after scaling to the sum of the target).

    With d = image / flux - T on the smallest cells and D_l the sums of d over cells of 2^-l pixels, the error is

        Σ_l s_l Σ D_l² / Σ T_l²    (weighted squares of Wang et al. 2023, Eq. 15, on ever finer grids),

    differentiable in image (k rows, k columns) and flux (0-d), float64.  The RRMSD has no gradient.
    """
    fast = kernel_choice.kernel("irradiance.picture_error", image, target.picture)
    if fast is not None and image.dtype == torch.float64:
        return fast(image, flux, target)
    d, last = quotient(image, flux) - target.picture, len(target.weights) - 1
    error = sum(
        (weight * total(joined_cells(d, 1 << (last - level)) ** 2) for level, weight in enumerate(target.weights)),
        torch.zeros_like(flux),
    )
    off = joined_cells(image.detach() / total(image.detach()) - target.picture, 1 << last)
    return error, (total(off**2) / target.size).sqrt()


@dataclass(frozen=True)
class Leak:
    """Light on the dark pixels D of a target: pixels of at most MAX_DARK_VALUE times the brightest pixel."""

    share: float  # Σ_D E / Σ E, fraction of the light on the target that falls on D
    # Mean of E over the other pixels divided by the mean of E over D; None: the light on D is rounding.
    contrast: float | None


def leak(irradiance: np.ndarray, target: np.ndarray) -> Leak | None:
    """Return the leak of a picture E (rows, columns) of any scale; None if the target has no dark pixel.

    For a fixed sum of E the share is linear in E, so that noise of zero mean does not change its expectation.
    """
    dark = target <= MAX_DARK_VALUE * target.max()
    if not dark.any():
        return None
    share = math.fsum(irradiance[dark]) / math.fsum(irradiance.ravel())
    lit = (1 - share) / (~dark).sum()
    return Leak(share, float(lit * dark.sum() / share) if share > LEAK_ROUNDING else None)


LEDGER = {  # status of lost rays, by line of the ledger
    "missed the lens": Status.MISSED_FRONT,
    "lost through the sides": Status.VIGNETTED,
    "total internal reflection": Status.TOTAL_REFLECTION,
}
LEDGER_OF_GIVEN_RAYS = {  # further lines for the rays of a file
    "starts inside the lens": Status.STARTED_INSIDE,
    "starts beside or behind the lens": Status.STARTED_BESIDE,
    "leads away from the lens": Status.LEADS_AWAY,
}


def ledger(rays: Landed, screen: Screen, *, given: bool = False) -> dict[str, float]:
    """Return the flux on and off the target and by cause of loss; the sum is that of all rays but Status.BLOCKED.

    given: count the rays of a file by where they start as well.
    """
    flux = rays.flux.double()
    on_screen = screen.contains(rays.position[0], rays.position[1])
    lines = {
        "on target": float(total(flux[rays.alive & on_screen])),
        "off target": float(total(flux[(rays.alive & ~on_screen) | (rays.status == int(Status.TURNED_BACK))])),
    }
    causes = LEDGER | LEDGER_OF_GIVEN_RAYS if given else LEDGER
    lost = {line: float(total(flux[rays.status == int(reason)])) for line, reason in causes.items()}
    return lines | lost | {line: float(total(part.double())) for line, part in rays.taken.items()}


def leaving(flux: dict[str, float]) -> float:
    """Return the flux that leaves the last surface, that of a ghost included; flux: the ledger."""
    return math.fsum(flux.get(f"{ghost}{side} target", 0.0) for ghost in ("", "ghost ") for side in ("on", "off"))


def efficiency(flux: dict[str, float]) -> float:
    """Return the flux on the target divided by the flux that leaves the last surface; flux: the ledger."""
    whole = leaving(flux)
    return (flux["on target"] + flux.get("ghost on target", 0.0)) / whole if whole > 0 else 0.0


def rrmsd_of_pictures(target: np.ndarray, irradiance: np.ndarray) -> float:
    """Return the RRMSD of Wang et al. 2023, sqrt(Σ (E_s - E)² / Σ E²), where E_s is simulated and E the target."""
    return float(np.sqrt(np.sum((irradiance - target) ** 2) / np.sum(target**2)))


def averaged(picture: np.ndarray, columns: int, rows: int) -> np.ndarray:
    """Return the exact means (rows, columns) of a picture over fewer pixels."""
    down, across = overlap(picture.shape[0], rows), overlap(picture.shape[1], columns)
    return down @ (across @ picture.T).T


def overlap(size: int, pixels: int, start: float = 0.0, stop: float | None = None) -> csr_array:
    """Return the matrix (pixels, size) that averages `size` inputs of width 1 over equal pixels from start to stop."""
    stop = size if stop is None else stop
    edges = start + np.arange(pixels + 1) * (stop - start) / pixels
    edges[-1] = stop
    cuts = np.union1d(np.arange(size + 1), np.clip(edges, 0, size))
    cuts = cuts[(cuts >= start) & (cuts <= stop)]
    middle = (cuts[1:] + cuts[:-1]) / 2
    to = np.clip(((middle - start) * pixels / (stop - start)).astype(int), 0, pixels - 1)
    of = np.clip(middle.astype(int), 0, size - 1)
    return csr_array((np.diff(cuts) * pixels / (stop - start), (to, of)), shape=(pixels, size))
