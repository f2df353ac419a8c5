"""Rays for figures: a fan in the section y = 0, a bundle, and the ray mapping from the source to the target."""

from __future__ import annotations

import numpy as np
import torch

from bstcad.optics import sampling
from bstcad.optics.interfaces import cross
from bstcad.optics.lens import Lens
from bstcad.optics.rays import Rays, TargetPlane
from bstcad.optics.sources import Source
from bstcad.optics.trace import clear_window, to_plane, trace

RAYS = 15
LINES = 33  # of the ray mapping, each way


def fan(source: Source, lens: Lens, plane: TargetPlane) -> np.ndarray:
    """Polylines (rays, k, 3) in mm: source, each surface on the way, the plane; only rays that arrive."""
    half = clear_window(source, lens).width / 2
    x = torch.linspace(-0.98 * half, 0.98 * half, RAYS, dtype=torch.float64)
    return _ways(source.rays(x, torch.zeros_like(x), lens.entrance.z, 1.0), lens, plane)[0]


def bundle(source: Source, lens: Lens, plane: TargetPlane, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Polylines of rays through n x n cells of the light, and the flux (rays,) with which each arrives.

    Each ray carries the flux of its cell; the source's whole flux is 1.
    """
    area = clear_window(source, lens)
    x, y = (p.reshape(-1).to(torch.float64) for p in sampling.grid(area, n))
    return _ways(source.rays(x, y, lens.entrance.z, area.area / n**2), lens, plane)


def _ways(started: Rays, lens: Lens, plane: TargetPlane) -> tuple[np.ndarray, np.ndarray]:
    """Polylines (rays, k, 3) in mm of the rays that arrive, and their flux there."""
    stops = [started]
    for interface in lens.interfaces:
        stops.append(cross(stops[-1], interface).rays)
    landed = to_plane(stops[-1], plane)
    stops.append(landed)
    points = torch.stack([torch.stack([*rays.position[:2], rays.above(0.0)]) for rays in stops])
    arrive = landed.alive & (landed.flux > 0)
    return points[:, :, arrive].permute(2, 0, 1).numpy(), landed.flux[arrive].numpy()


def ray_map(source: Source, lens: Lens, plane: TargetPlane) -> tuple[np.ndarray, np.ndarray]:
    """A regular grid on the front's vertex plane, and its landing points on the plane: each (k, k, 2) in mm.

    NaN where there is no light or the ray is lost.
    """
    area = clear_window(source, lens)
    line = torch.linspace(-0.499, 0.499, LINES, dtype=torch.float64)
    x, y = torch.meshgrid(line * area.width, line * area.height, indexing="ij")
    landed = trace(source.rays(x, y, lens.entrance.z, 1.0), lens, plane)
    start = torch.stack([x, y], dim=-1)
    lost = ~(landed.alive & (landed.flux > 0))
    ends = landed.position.permute(1, 2, 0).clone()
    start[lost] = ends[lost] = torch.nan
    return start.numpy(), ends.numpy()
