"""Merit functions: what tailoring makes small."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bstcad.optics.irradiance import Screen, landed_flux, tent
from bstcad.optics.rays import Landed


def landing(rays: Landed, aim: Tensor) -> Tensor:
    """Mean of |P_t - P|² over the rays that land (mm²); Wang et al. 2023, Eq. 13, as a mean."""
    lit = rays.alive & (rays.flux > 0)
    miss = (rays.position[0] - aim[0]) ** 2 + (rays.position[1] - aim[1]) ** 2
    return torch.where(lit, miss, torch.zeros_like(miss)).sum() / lit.sum()


def as_seen_by_tent(target: Tensor) -> Tensor:
    """What tent binning makes of a picture whose light lies evenly in each pixel: [1 6 1] / 8 along both axes.

    Comparing with this instead of the sharp picture lets a perfect lens have merit zero.
    """
    kernel = torch.tensor([1.0, 6.0, 1.0], dtype=target.dtype, device=target.device) / 8
    image = torch.nn.functional.conv2d(target[None, None], (kernel[:, None] * kernel)[None, None], padding=1)
    return image[0, 0]


@dataclass(frozen=True)
class IrradianceMerit:
    """RRMSD² by tent binning, plus a quadratic pull on light outside the target.

    Binning alone gives no gradient to a ray that has left the target; the pull is `overshoot` (1 / pixel²) times the
    mean square of its distance from the border in pixels.
    """

    screen: Screen
    target: Tensor  # (pixels, pixels) as seen by the tent, its flux summing to 1 before that
    overshoot: float

    @classmethod
    def of(cls, screen: Screen, target: Tensor, overshoot: float) -> IrradianceMerit:
        """From the sharp target picture."""
        return cls(screen, as_seen_by_tent(target / target.sum()), overshoot)

    def __call__(self, rays: Landed) -> tuple[Tensor, Tensor]:
        """(merit, RRMSD by the tent) of landed rays."""
        flux = landed_flux(rays)
        total = flux.sum().double()
        rrmsd2 = ((tent(rays, self.screen) / total - self.target) ** 2).sum() / (self.target**2).sum()
        return rrmsd2 + self.overshoot * self._outside(rays, flux) / total, rrmsd2.detach().sqrt()

    def _outside(self, rays: Landed, flux: Tensor) -> Tensor:
        """Σ flux · (distance beyond the border in pixels)²."""
        column, row = self.screen.pixel(rays.position[0], rays.position[1])
        beyond_x = column - column.clamp(0, self.screen.pixels)
        beyond_y = row - row.clamp(0, self.screen.pixels)
        return (flux * (beyond_x**2 + beyond_y**2)).sum().double()
