"""From landed rays to an irradiance picture and a flux ledger.

A picture is (pixels, pixels), row 0 = y max, column 0 = x min.  `tent` shares a ray among the four nearest pixel
centres (differentiable: what tailoring uses); `box` gives it to the pixel it falls into (what a detector does: what
the result is judged by).  Both sum in float64: float32 sums stop growing at 2^24 rays.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bstcad.optics import fused
from bstcad.optics.rays import Landed, Status


@dataclass(frozen=True)
class Screen:
    """A rectangle of the plane z, divided into pixels x pixels."""

    z: float  # mm
    x: tuple[float, float]  # mm
    y: tuple[float, float]  # mm
    pixels: int

    def pixel(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """(column, row) of (x, y) in mm, as real numbers: pixel i reaches from i to i + 1."""
        column = (x - self.x[0]) * (self.pixels / (self.x[1] - self.x[0]))
        row = (self.y[1] - y) * (self.pixels / (self.y[1] - self.y[0]))
        return column, row

    def contains(self, x: Tensor, y: Tensor) -> Tensor:
        """True where (x, y) in mm is on the screen."""
        return (x >= self.x[0]) & (x <= self.x[1]) & (y >= self.y[0]) & (y <= self.y[1])


def landed_flux(rays: Landed) -> Tensor:
    """The flux of each ray, zero for those that were lost on the way."""
    return torch.where(rays.alive, rays.flux, torch.zeros_like(rays.flux))


def tent(rays: Landed, screen: Screen) -> Tensor:
    """Flux a pixel by linear (tent) binning, float64: differentiable (Wang et al. 2023, section 2.3)."""
    column, row = screen.pixel(rays.position[0], rays.position[1])
    flux = landed_flux(rays)
    shape = (screen.pixels, screen.pixels)
    if fused.serves(column, row, flux):
        return fused.Splat.apply(column, row, flux, shape)
    return tent_plain(column, row, flux, shape)


def tent_plain(column: Tensor, row: Tensor, flux: Tensor, shape: tuple[int, int]) -> Tensor:
    """The tent binning in plain torch: each ray's four shares, those beyond the border dropped."""
    column, row, flux = column.reshape(-1).double() - 0.5, row.reshape(-1).double() - 0.5, flux.reshape(-1).double()
    image = torch.zeros(shape[0] * shape[1], dtype=torch.float64, device=flux.device)
    j, i = column.detach().floor(), row.detach().floor()
    for di in (0, 1):
        for dj in (0, 1):
            weight = (1 - (column - j - dj).abs()) * (1 - (row - i - di).abs()) * flux
            inside = (i + di >= 0) & (i + di < shape[0]) & (j + dj >= 0) & (j + dj < shape[1])
            index = torch.where(inside, (i + di) * shape[1] + (j + dj), torch.zeros_like(i)).long()
            image = image.index_add(0, index, torch.where(inside, weight, torch.zeros_like(weight)))
    return image.view(shape)


def box(rays: Landed, screen: Screen) -> Tensor:
    """Flux that truly falls into each pixel, float64."""
    column, row = screen.pixel(rays.position[0], rays.position[1])
    inside = rays.alive & screen.contains(rays.position[0], rays.position[1])
    last = screen.pixels - 1
    index = row.detach().floor().clamp(0, last) * screen.pixels + column.detach().floor().clamp(0, last)
    index = torch.where(inside, index, torch.zeros_like(index)).long().reshape(-1)
    weight = torch.where(inside, rays.flux, torch.zeros_like(rays.flux)).reshape(-1).double()
    image = torch.bincount(index, weights=weight.detach(), minlength=screen.pixels**2)
    return image.view(screen.pixels, screen.pixels)


def rrmsd(irradiance: Tensor, target: Tensor) -> Tensor:
    """sqrt(Σ |E_s - E|² / Σ E²), E_s scaled to the target's sum (Wang et al. 2023, Eq. 14)."""
    scaled = irradiance * (target.sum() / irradiance.sum())
    return torch.sqrt(((scaled - target) ** 2).sum() / (target**2).sum())


LEDGER = {
    "missed the lens": (Status.MISSED_FRONT,),
    "lost through the sides": (Status.VIGNETTED,),
    "total internal reflection": (Status.TOTAL_REFLECTION,),
}


def ledger(rays: Landed, screen: Screen) -> dict[str, float]:
    """Where the flux of these rays went; the lines sum to what they carry."""
    flux = rays.flux.double()
    on_screen = screen.contains(rays.position[0], rays.position[1])
    lines = {
        "on target": float(flux[rays.alive & on_screen].sum()),
        "off target": float(flux[rays.alive & ~on_screen].sum()),
    }
    for line, reasons in LEDGER.items():
        lines[line] = sum(float(flux[rays.status == int(reason)].sum()) for reason in reasons)
    return lines


def efficiency(flux: dict[str, float]) -> float:
    """Flux inside the target over flux that leaves the back face."""
    leaves = flux["on target"] + flux["off target"]
    return flux["on target"] / leaves if leaves > 0 else 0.0
