"""Merit functions: what tailoring makes small."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bstcad.optics.irradiance import Screen, collect, landed_flux
from bstcad.optics.kernels.reductions import total
from bstcad.optics.rays import Landed
from bstcad.optics.tubes.launching import Tubes


def landing(rays: Landed, aim: Tensor) -> Tensor:
    """Mean of |P_t - P|² over the rays that land (mm²); Wang et al. 2023, Eq. 14, as a mean."""
    lit = rays.alive & (rays.flux > 0)
    miss = (rays.position[0] - aim[0]) ** 2 + (rays.position[1] - aim[1]) ** 2
    return total(torch.where(lit, miss, torch.zeros_like(miss))) / lit.sum()


@dataclass(frozen=True)
class TubeMerit:
    """RRMSD² of the light that falls into each pixel, exact for ray tubes, plus a pull on light outside the target.

    Pixels give no gradient to light that has left the target; the pull is `overshoot` (1 / pixel²) times the mean
    square of its distance from the border in pixels.
    """

    tubes: Tubes
    screen: Screen
    target: Tensor  # (rows, columns), sum 1
    overshoot: float

    def __call__(self, corners: Landed) -> tuple[Tensor, Tensor]:
        """(merit, RRMSD of the light on the screen) of the landed corners."""
        flux, size = total(self.tubes.flux), total(self.target**2)
        image, outside = self.tubes.collect(corners, self.screen)
        off = total((image / flux - self.target) ** 2) / size
        lost = 1 - total(self.tubes.whole(corners)) / flux  # to total reflection: no gradient, but no gain either
        seen = image.detach() / total(image.detach())
        return off + self.overshoot * outside / flux + lost, (total((seen - self.target) ** 2) / size).sqrt()


def as_seen_by_tent(target: Tensor) -> Tensor:
    """What tent binning makes of a picture whose light lies evenly in each pixel: [1, 6, 1] / 8 along both axes.

    Comparing with this instead of the sharp picture lets a perfect lens have merit zero.
    """
    for _ in range(2):  # each turn takes one axis and swaps the two
        target = torch.nn.functional.pad(target, (1, 1))
        target = ((target[:, :-2] + 6 * target[:, 1:-1] + target[:, 2:]) / 8).T
    return target.contiguous()


@dataclass(frozen=True)
class TentMerit:
    """The seed's: RRMSD² of rays by tent binning (Wang et al. 2023, Eq. 15), plus the pull of `TubeMerit`."""

    screen: Screen
    target: Tensor  # (rows, columns) as seen by the tent, its flux summing to 1 before that
    overshoot: float

    @classmethod
    def of(cls, screen: Screen, target: Tensor, overshoot: float) -> TentMerit:
        """From the sharp target picture."""
        return cls(screen, as_seen_by_tent(target / total(target)), overshoot)

    def __call__(self, rays: Landed) -> tuple[Tensor, Tensor]:
        """(merit, RRMSD against the target as the tent sees it) of landed rays."""
        flux = total(landed_flux(rays).double())
        image, outside = collect(rays, self.screen)
        rrmsd2 = total((image / flux - self.target) ** 2) / total(self.target**2)
        return rrmsd2 + self.overshoot * outside / flux, rrmsd2.detach().sqrt()
