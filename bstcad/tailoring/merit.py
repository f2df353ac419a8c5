"""Merit functions: what tailoring makes small."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bstcad.optics.irradiance import Screen, collect, landed_flux
from bstcad.optics.rays import Landed


def landing(rays: Landed, aim: Tensor) -> Tensor:
    """Mean of |P_t - P|² over the rays that land (mm²); Wang et al. 2023, Eq. 14, as a mean."""
    lit = rays.alive & (rays.flux > 0)
    miss = (rays.position[0] - aim[0]) ** 2 + (rays.position[1] - aim[1]) ** 2
    return torch.where(lit, miss, torch.zeros_like(miss)).sum() / lit.sum()


def as_seen_by_tent(target: Tensor, subdivision: int = 1) -> Tensor:
    """What tent binning makes of a picture whose light lies evenly in each pixel: [1, 8s - 2, 1] / 8s along both axes.

    s is the number of tents a pixel each way, summed afterwards.  Comparing with this instead of the sharp picture
    lets a perfect lens have merit zero.
    """
    kernel = torch.tensor([1.0, 8.0 * subdivision - 2.0, 1.0], dtype=target.dtype, device=target.device)
    kernel = kernel / (8.0 * subdivision)
    image = torch.nn.functional.conv2d(target[None, None], (kernel[:, None] * kernel)[None, None], padding=1)
    return image[0, 0]


@dataclass(frozen=True)
class IrradianceMerit:
    """RRMSD² by tent binning, plus a quadratic pull on light outside the target.

    A tent as wide as a pixel hides errors from pixel to pixel (it halves them along each axis); `subdivision` narrower
    tents a pixel come closer to what falls into it.  Binning alone gives no gradient to a ray that has left the target;
    the pull is `overshoot` (1 / pixel²) times the mean square of its distance from the border in pixels.
    """

    screen: Screen  # with the finer pixels of the tents
    target: Tensor  # (pixels, pixels) as seen by the tent, its flux summing to 1 before that
    overshoot: float
    subdivision: int

    @classmethod
    def of(cls, screen: Screen, target: Tensor, overshoot: float, subdivision: int = 1) -> IrradianceMerit:
        """From the sharp target picture."""
        fine = replace(screen, pixels=screen.pixels * subdivision)
        return cls(fine, as_seen_by_tent(target / target.sum(), subdivision), overshoot, subdivision)

    def __call__(self, rays: Landed) -> tuple[Tensor, Tensor]:
        """(merit, RRMSD against the target as the tent sees it) of landed rays."""
        total = landed_flux(rays).sum().double()
        image, outside = collect(rays, self.screen)
        if self.subdivision > 1:
            outside = outside / self.subdivision**2
            image = torch.nn.functional.avg_pool2d(image[None], self.subdivision, divisor_override=1)[0]
        rrmsd2 = ((image / total - self.target) ** 2).sum() / (self.target**2).sum()
        return rrmsd2 + self.overshoot * outside / total, rrmsd2.detach().sqrt()
