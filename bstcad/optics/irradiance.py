"""From landed rays to an irradiance picture and a flux ledger.

A picture is (rows, columns), row 0 = y max, column 0 = x min.  `tent` shares a ray among the four nearest pixel
centres (differentiable, for tailoring); `box` gives it to the pixel it falls into (as a detector does, for judging the
result).  Both sum in float64: float32 sums stop growing at 2^24 rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics import ops
from bstcad.optics.kernels.reductions import total
from bstcad.optics.motion import Motion
from bstcad.optics.rays import Landed, Status, axes, clocked, clocking_of, tilt_of
from bstcad.optics.receivers import LevelPlane, Receiver, TiltedPlane

ROUNDING = 1e-12  # rounding, as a part of the light on a target
DARK = 1e-6  # part of a target's brightest pixel; a pixel that wants no more wants no light


@dataclass(frozen=True)
class Screen:
    """A rectangle of a level or tilted plane, or of another receiver, divided into columns x rows of pixels."""

    z: float  # mm; of a tilted screen at its middle
    x: tuple[float, float]  # in the unit of the receiver, of planes mm
    y: tuple[float, float]  # the same
    pixels: int | tuple[int, int]  # along both sides, or (columns, rows)
    tilt: tuple[float, float] | None = None  # about x, then about y (degrees; receivers.TiltedPlane); None: level
    clocking: float = 0.0  # then about its own normal (degrees)
    surface: Receiver | None = None  # which it is a part of; None: the plane of z, tilt and clocking

    @property
    def middle(self) -> tuple[float, float, float]:
        """Its middle in space (mm)."""
        if self.surface is not None:
            return self.surface.middle
        return sum(self.x) / 2, sum(self.y) / 2, self.z

    @property
    def plane(self) -> Receiver:
        """The plane, or the receiver of another form, on which light lands."""
        if self.surface is not None:
            return self.surface
        if self.tilt is None and self.clocking == 0:
            return LevelPlane(self.z)
        return TiltedPlane(self.middle, self.tilt or (0.0, 0.0), self.clocking)

    def moved(self, motion: Motion) -> Screen:
        """The screen after a motion; its pixels stay those that they are."""
        if self.surface is not None:
            return replace(self, surface=self.surface.moved(motion))
        middle = motion.point(self.middle)
        (x, y), (c_x, c_y, z) = (self.x, self.y), middle
        old_x, old_y, _ = self.middle
        x, y = (tuple(end - old + new for end in side) for side, old, new in ((x, old_x, c_x), (y, old_y, c_y)))
        if not motion.turns:
            return replace(self, x=x, y=y, z=z)
        frame = motion.frame(clocked(axes(self.tilt or (0.0, 0.0)), self.clocking))
        return replace(self, x=x, y=y, z=z, tilt=tilt_of(frame[2]), clocking=clocking_of(frame))

    @property
    def columns(self) -> int:
        """Pixels along x."""
        return self.pixels if isinstance(self.pixels, int) else self.pixels[0]

    @property
    def rows(self) -> int:
        """Pixels along y."""
        return self.pixels if isinstance(self.pixels, int) else self.pixels[1]

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns), as a picture on it has."""
        return self.rows, self.columns

    @property
    def per_unit(self) -> tuple[float, float]:
        """Columns along x and rows along y in a unit of the receiver."""
        return self.columns / (self.x[1] - self.x[0]), self.rows / (self.y[1] - self.y[0])

    @property
    def areas(self) -> np.ndarray | None:
        """Areas or solid angles of the pixels (rows, columns), of mean 1; None: they are equal."""
        return self.plane.areas(self.x, self.y, self.shape)

    def pixel(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """(column, row) of (x, y), as real numbers: pixel i reaches from i to i + 1."""
        per_x, per_y = self.per_unit
        return (x - self.x[0]) * per_x, (self.y[1] - y) * per_y

    def pixels_of(self, position: Tensor) -> Tensor:
        """(2, …) the same of positions (2, …), in two passes over them."""
        aside = (2, *[1] * (position.ndim - 1))
        per_x, per_y = self.per_unit
        corner = torch.tensor((self.x[0], self.y[1]), dtype=position.dtype, device=position.device).view(aside)
        per_unit = torch.tensor((per_x, -per_y), dtype=position.dtype, device=position.device).view(aside)
        return (position - corner).mul_(per_unit)

    def contains(self, x: Tensor, y: Tensor) -> Tensor:
        """True where (x, y) is on the screen."""
        return (x >= self.x[0]) & (x <= self.x[1]) & (y >= self.y[0]) & (y <= self.y[1])


def landed_flux(rays: Landed) -> Tensor:
    """The flux of each ray, zero for those that were lost on the way."""
    return torch.where(rays.alive, rays.flux, torch.zeros_like(rays.flux))


def tent(rays: Landed, screen: Screen) -> Tensor:
    """Flux a pixel by linear (tent) binning, float64: differentiable (Wang et al. 2023, section 2.3)."""
    return collect(rays, screen)[0]


def collect(rays: Landed, screen: Screen) -> tuple[Tensor, Tensor]:
    """(tent picture, Σ flux · (distance beyond the border in pixels)²), both float64 and differentiable in the landing.

    Binning gives no gradient to a ray that has left the screen; the second sum does.
    """
    flux = landed_flux(rays)
    if (fast := ops.kernel("irradiance.collect", rays.position, flux)) and not flux.requires_grad:
        (left, _), (_, top), (per_x, per_y) = screen.x, screen.y, screen.per_unit
        position = rays.position.reshape(2, -1).contiguous()
        return fast(position, flux.reshape(-1).contiguous(), (left, per_x, top, per_y), screen.shape)
    return collect_plain(rays.position, flux, screen)


def collect_plain(position: Tensor, flux: Tensor, screen: Screen) -> tuple[Tensor, Tensor]:
    """`collect` in plain torch: each ray's four shares, those beyond the border dropped."""
    column, row = (p.reshape(-1) for p in screen.pixel(position[0].double(), position[1].double()))
    flux, (rows, columns) = flux.reshape(-1).double(), screen.shape
    beyond = (column - column.clamp(0, columns)) ** 2 + (row - row.clamp(0, rows)) ** 2
    column, row = column - 0.5, row - 0.5
    image = torch.zeros(rows * columns, dtype=torch.float64, device=flux.device)
    j, i = column.detach().floor(), row.detach().floor()
    for di in (0, 1):
        for dj in (0, 1):
            weight = (1 - (column - j - dj).abs()) * (1 - (row - i - di).abs()) * flux
            inside = (i + di >= 0) & (i + di < rows) & (j + dj >= 0) & (j + dj < columns)
            index = torch.where(inside, (i + di) * columns + (j + dj), torch.zeros_like(i)).long()
            image = image.index_add(0, index, torch.where(inside, weight, torch.zeros_like(weight)))
    return image.view(screen.shape), total(flux * beyond)


def box(rays: Landed, screen: Screen) -> Tensor:
    """Flux that truly falls into each pixel, float64."""
    column, row = screen.pixel(rays.position[0], rays.position[1])
    inside = rays.alive & screen.contains(rays.position[0], rays.position[1])
    rows, columns = screen.shape
    index = row.detach().floor().clamp(0, rows - 1) * columns + column.detach().floor().clamp(0, columns - 1)
    index = torch.where(inside, index, torch.zeros_like(index)).long().reshape(-1)
    weight = torch.where(inside, rays.flux, torch.zeros_like(rays.flux)).reshape(-1).double()
    image = torch.bincount(index, weights=weight.detach(), minlength=rows * columns)
    return image.view(screen.shape)


def rrmsd(irradiance: Tensor, target: Tensor) -> Tensor:
    """sqrt(Σ |E_s - E|² / Σ E²), E_s scaled to the target's sum (Wang et al. 2023, Eq. 15)."""
    scaled = irradiance * (total(target) / total(irradiance))
    return torch.sqrt(total((scaled - target) ** 2) / total(target**2))


@dataclass(frozen=True)
class Leak:
    """The light on the dark pixels D of a target, those in which it wants no more than DARK times its brightest."""

    share: float  # Σ_D E / Σ E: of the light that falls on the target
    # mean of E over the other pixels, divided by mean of E over D; None: no light falls on D but for rounding
    contrast: float | None


def leak(irradiance: np.ndarray, target: np.ndarray) -> Leak | None:
    """The leak of a picture E (rows, columns), on any scale, against a target; None if no pixel of that is dark.

    The share is linear in E: noise of zero mean in E leaves its expectation as it is.
    """
    dark = target <= DARK * target.max()
    if not dark.any():
        return None
    share = math.fsum(irradiance[dark]) / math.fsum(irradiance.ravel())
    lit = (1 - share) / (~dark).sum()
    return Leak(share, float(lit * dark.sum() / share) if share > ROUNDING else None)


LEDGER = {
    "missed the lens": (Status.MISSED_FRONT,),
    "lost through the sides": (Status.VIGNETTED,),
    "total internal reflection": (Status.TOTAL_REFLECTION,),
}


def ledger(rays: Landed, screen: Screen) -> dict[str, float]:
    """The flux of these rays by fate; the lines sum to all that they carry."""
    flux = rays.flux.double()
    on_screen = screen.contains(rays.position[0], rays.position[1])
    lines = {
        "on target": float(total(flux[rays.alive & on_screen])),
        "off target": float(total(flux[(rays.alive & ~on_screen) | (rays.status == int(Status.TURNED_BACK))])),
    }
    for line, reasons in LEDGER.items():
        lines[line] = sum(float(total(flux[rays.status == int(reason)])) for reason in reasons)
    return lines | {line: float(total(part.double())) for line, part in rays.taken.items()}


def efficiency(flux: dict[str, float]) -> float:
    """Flux inside the target over flux that leaves the back face."""
    inside, outside = (flux[f"{side} target"] + flux.get(f"ghost {side} target", 0.0) for side in ("on", "off"))
    leaves = inside + outside
    return inside / leaves if leaves > 0 else 0.0
