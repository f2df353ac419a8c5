"""Margins of a trace: distance from total reflection and from grazing rays, along the lens's own light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from bstcad.optics.channels import Channel, points
from bstcad.optics.interfaces import intersect
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.trace import from_first_free, launch_strips, to_first_free

RAYS = 512  # a side of the window


@dataclass(frozen=True)
class Margins:
    """The worst of all rays that carry light to the back face."""

    tir_margin_deg: float | None  # critical angle minus angle of incidence (degrees), < 0: reflected; None: no such ray
    newton_slope_min: float | None  # |F'(t)| at the back face, the denominator of Newton's step; 1 head on, 0 grazing
    non_finite: int  # count of control points, hits and landings that are not finite


@torch.no_grad()
def margins(channels: Sequence[Channel], lens: Lens, screen: Screen, seed: int, n: int = RAYS) -> Margins:
    """Margins over n x n stratified rays a channel; the k points of an extended source share n x n rays.

    cos θ = (d_z - d_x z_x - d_y z_y) / sqrt(1 + z_x² + z_y²) at the back face, total reflection at sin θ = 1 / n;
    F(t) = z(t) - sag(x(t), y(t)), F' = d_z - d_x z_x - d_y z_y.
    """
    margin, slope, n = math.inf, math.inf, math.ceil(n / math.sqrt(points(channels)))
    wrong = int((~torch.isfinite(lens.back.heights)).sum())
    for channel in channels:
        through = channel.through(lens)
        last = through.interfaces[-1]
        critical = math.inf if last.law.reverses else math.degrees(math.asin(min(1.0 / last.law.eta, 1.0)))
        for rays in launch_strips(channel.source, through, n, seed):
            coming = to_first_free(rays, through)
            met, z_x, z_y = intersect(last.surface, coming, last.outline, last.status_if_missed)
            dx, dy, dz = met.direction
            along = met.sense * (dz - dx * z_x - dy * z_y)
            meets = met.alive & (met.flux > 0)
            wrong += int((~torch.isfinite(met.position)).any(0)[meets].sum())
            if bool(meets.any()):
                cosine = (along / torch.sqrt(1 + z_x * z_x + z_y * z_y))[meets].clamp(-1.0, 1.0)
                margin = min(margin, critical - float(torch.rad2deg(torch.arccos(cosine)).max()))
                slope = min(slope, float(along.abs()[meets].min()))
            landed = from_first_free(coming, through, screen.plane)
            wrong += int((~torch.isfinite(landed.position)).any(0)[landed.alive].sum())
    return Margins(None if math.isinf(margin) else margin, None if math.isinf(slope) else slope, wrong)
