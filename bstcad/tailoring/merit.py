"""Merit functions: what tailoring makes small."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bstcad.optics.channels import Channel, weighted_sum
from bstcad.optics.irradiance import Screen, collect, landed_flux
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.rays import Landed
from bstcad.optics.tubes.launching import Tubes, launch_tubes


def landing(rays: Landed, aim: Tensor) -> Tensor:
    """Mean of |P_t - P|² over the rays that land (mm²); Wang et al. 2023, Eq. 14, as a mean."""
    lit = rays.alive & (rays.flux > 0)
    miss = (rays.position[0] - aim[0]) ** 2 + (rays.position[1] - aim[1]) ** 2
    return total(torch.where(lit, miss, torch.zeros_like(miss))) / lit.sum()


@dataclass(frozen=True)
class TubeMerit:
    """RRMSD² of the light that falls into each pixel, exact for ray tubes, plus a pull on light outside the target.

    Pixels give no gradient to light that has left the target; the pull is `overshoot` (1 / pixel²) times the mean
    square of its distance from the border in pixels.  Picture, pull and loss are sums over the channels of the light.
    """

    channels: tuple[Channel, ...]
    sheets: tuple[Tubes, ...]  # one a channel
    screen: Screen
    target: Tensor  # (rows, columns), sum 1
    overshoot: float

    @classmethod
    def of(
        cls, channels: tuple[Channel, ...], lens: Lens, n: int, screen: Screen, target: Tensor, overshoot: float
    ) -> TubeMerit:
        """With sheets of n x n tubes launched for `lens`; the target may have any sum."""
        sheets = tuple(launch_tubes(channel.source, channel.through(lens), n) for channel in channels)
        return cls(channels, sheets, screen, target / total(target), overshoot)

    @property
    def tubes(self) -> int:
        """How many an evaluation traces."""
        return sum(sheet.flux.numel() for sheet in self.sheets)

    def landing(self, lens: Lens) -> tuple[Landed, ...]:
        """Where the corners of each sheet meet the screen."""
        pairs = zip(self.channels, self.sheets, strict=True)
        return tuple(sheet.landing(channel.through(lens), self.screen.plane) for channel, sheet in pairs)

    def __call__(self, landed: tuple[Landed, ...]) -> tuple[Tensor, Tensor]:
        """(merit, RRMSD of the light on the screen) of the landed corners of each sheet."""
        pairs = list(zip(self.sheets, landed, strict=True))
        flux, size = weighted_sum(self.channels, (total(sheet.flux) for sheet in self.sheets)), total(self.target**2)
        left = flux  # of it, behind all that takes some on the way: darker everywhere is no worse
        if any(sheet.dims for sheet in self.sheets):
            left = weighted_sum(self.channels, (total(sheet.left(corners)) for sheet, corners in pairs))
        images, beyond = zip(*(sheet.collect(corners, self.screen) for sheet, corners in pairs), strict=True)
        image, outside = weighted_sum(self.channels, images), weighted_sum(self.channels, beyond)
        off = total((image / left - self.target) ** 2) / size
        arrived = weighted_sum(self.channels, (total(sheet.arriving(corners)) for sheet, corners in pairs))
        lost = 1 - arrived / flux  # total reflection has no gradient, but must not be a gain
        seen = image.detach() / total(image.detach())
        return off + self.overshoot * outside / left + lost, (total((seen - self.target) ** 2) / size).sqrt()


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
    """RRMSD² of rays by tent binning (Wang et al. 2023, Eq. 15), plus the pull of `TubeMerit`; summed over channels."""

    channels: tuple[Channel, ...]
    screen: Screen
    target: Tensor  # (rows, columns) as seen by the tent, its flux summing to 1 before that
    overshoot: float

    @classmethod
    def of(cls, channels: tuple[Channel, ...], screen: Screen, target: Tensor, overshoot: float) -> TentMerit:
        """From the sharp target picture."""
        return cls(channels, screen, as_seen_by_tent(target / total(target)), overshoot)

    def __call__(self, landed: tuple[Landed, ...]) -> tuple[Tensor, Tensor]:
        """(merit, RRMSD against the target as the tent sees it) of the landed rays of each channel."""
        flux = weighted_sum(self.channels, (total(landed_flux(rays).double()) for rays in landed))
        images, beyond = zip(*(collect(rays, self.screen) for rays in landed), strict=True)
        image, outside = weighted_sum(self.channels, images), weighted_sum(self.channels, beyond)
        rrmsd2 = total((image / flux - self.target) ** 2) / total(self.target**2)
        return rrmsd2 + self.overshoot * outside / flux, rrmsd2.detach().sqrt()
