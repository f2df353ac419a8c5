"""Rays of a scene's light where they leave the lens, for files of rays."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel, source_numbers
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.trace.measure import SETS
from bstcad.optics.trace.trace import across, behind, launch_strips
from bstcad.photometry.ray_set import RaySet

PILOT_RAYS = 1 << 14  # number of rays, all channels together, that predict the fraction which leaves the lens
SPARE = 1.02  # rays that are expected to leave the lens / wanted rays


def rays_behind(
    lens: Lens, channels: Sequence[Channel], count: int, seed: int = 0, lumens: float | None = None
) -> RaySet:
    """Return `count` rays on the last surface that they cross, whose sums are unbiased estimates for the whole light.

    Stratified rays of all channels are traced, at least `count` of which leave the lens: N.  Every (N / count)-th of
    them is kept, from a random first one (systematic sampling), with N / count times its flux.  The light of a ghost
    is not contained.  lumens: luminous flux of the source, so that powers are in lm; None: powers in W for a source of
    1 W.  A source with given rays, a file, may have fewer.  ValueError: `count` is not above 0, or no light leaves.
    """
    if count < 1:
        raise ValueError(f"count = {count} is not possible; give a number above 0")
    side, most = max(1, round(math.sqrt(PILOT_RAYS / len(channels)))), _largest_side(channels)
    found = _traced(lens, channels, min(side, most), seed=seed)
    while len(found) < count and side < most:
        side = math.ceil(side * math.sqrt(SPARE * count / max(len(found), 1)))
        found = _traced(lens, channels, min(side, most), seed=seed)
    if not len(found):
        raise ValueError("no light leaves the lens; change the source or the lens")
    count = min(count, len(found))
    every = len(found) / count
    kept = np.floor((np.arange(count) + np.random.default_rng(seed).random()) * every).astype(np.int64)
    position, direction, power, wavelength = (part[kept] for part in found.columns)
    power = power * (every * (1.0 if lumens is None else lumens))
    lines = np.unique(wavelength)
    return RaySet(
        position.astype(np.float32), direction.astype(np.float32), power.astype(np.float32),
        "W" if lumens is None else "lm", wavelength=float(lines[0]) if len(lines) == 1 else wavelength,
    )  # fmt: skip


def _largest_side(channels: Sequence[Channel]) -> float:
    """Return the rays per side beyond which no channel has further rays."""
    given = [channel.source.largest_side + 1 for channel in channels if channel.source.is_given]
    return max(given) if len(given) == len(channels) else math.inf


@dataclass(frozen=True, eq=False)
class _Traced:
    """Rays that leave the last surface: positions (n, 3) mm, directions (n, 3), fluxes (n,), wavelengths (n,) nm."""

    columns: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]

    def __len__(self) -> int:
        return len(self.columns[2])


def _traced(lens: Lens, channels: Sequence[Channel], side: float, seed: int) -> _Traced:
    """Return all rays of side x side per channel that leave the last surface."""
    parts = []
    for channel, number in zip(channels, source_numbers(channels), strict=True):
        for rays in _strips(channel, lens, int(side), seed=seed + SETS * number):
            left = rays.alive & (rays.flux > 0)
            places = torch.stack([*rays.position[:2], rays.above(0.0)])
            values = (places, rays.direction.expand_as(places), channel.weight * rays.flux)
            position, direction, flux = (value[..., left].double().cpu().numpy() for value in values)
            wavelength = np.full(len(flux), channel.source.main_wavelength, np.float32)
            parts.append((position.T, direction.T, flux, wavelength))
    position, direction, flux, wavelength = (np.concatenate(same) for same in zip(*parts, strict=True))
    return _Traced((position, direction, flux, wavelength))


@torch.no_grad()
def _strips(channel: Channel, lens: Lens, side: int, seed: int) -> Iterator[Rays]:
    """Yield rays of one channel behind the last surface, a strip at a time."""
    seen = channel.through(lens)
    *others, last = seen.interfaces
    for rays in launch_strips(channel.source, seen, side, seed):
        yield behind(across(rays, others), last)
