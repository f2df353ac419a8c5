"""Light that a mount blocks: at the edges of the clear apertures, and at the walls of a flange's opening."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bstcad.optics import sampling
from bstcad.optics.channels import Channel
from bstcad.optics.interfaces import cross
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import Rays
from bstcad.optics.trace import window

RAYS = 512  # a side of the grid of rays, shared by all channels
FEWEST = 48  # a side, of one channel


@dataclass(frozen=True)
class Losses:
    """Shares of light that a mount blocks."""

    cut: float  # of the light that gets through both faces of the uncut lens, the share that misses the clear apertures
    on_flange: float  # of the light through the clear apertures, the share that meets a wall of the flange's opening


@torch.no_grad()
def losses(lens: Lens, channels: Sequence[Channel], flange: tuple[float, float] | None = None) -> Losses:
    """Losses of a lens with clear apertures.  flange: z (mm) of both ends of its opening; None without a flange."""
    whole = passing = met = 0.0
    n = max(FEWEST, math.ceil(RAYS / math.sqrt(len(channels))))
    for channel in channels:
        own = replace(channel.through(lens), losses=None)
        bare, source, rim = replace(own, clear=None), channel.source, own.apertures[1]
        area = window(source, bare)
        x, y = sampling.grid(area, n)
        rays = source.rays(x, y, own.entrance.z, channel.weight * area.area / n**2)
        uncut, through = _through(rays, bare)[-1], _through(rays, own)
        out = through[-1]
        whole += float(uncut.flux[uncut.alive].sum())
        passing += float(out.flux[out.alive].sum())
        if flange is not None:
            met += float(out.flux[out.alive & _meets(through, rim, flange)].sum())
    return Losses(1 - passing / whole if whole else 0.0, met / passing if passing else 0.0)


def _through(rays: Rays, lens: Lens) -> list[Rays]:
    """The rays from the source, and behind each interface of the lens."""
    found = [rays]
    for interface in lens.interfaces:
        found.append(cross(found[-1], interface).rays)
    return found


def _meets(rays: Sequence[Rays], rim: Outline, planes: Iterable[float]) -> Tensor:
    """Is a ray outside the rim on one of the planes, before the first face or behind the last?"""
    first, (coming, *_, leaving) = rays[1], rays
    beyond = torch.zeros_like(leaving.alive)
    for z in planes:
        for at, ends in ((coming, first), (leaving, None)):
            way = -at.above(z) / torch.where(at.direction[2] == 0, torch.full_like(at.flux, 1e-300), at.direction[2])
            x, y, _ = at.position + way * at.direction
            between = (way > 0) if ends is None else (way > 0) & (at.sense * ends.above(z) > 0)
            beyond |= between & ~rim.contains(x, y)
    return beyond
