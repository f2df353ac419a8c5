"""Short ways to rays that tests take and the package does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.rays import Landed, Rays
from bstcad.optics.trace.trace import Simulation, across, launch_strips, simulate, simulate_plain


def stratified(window: Rectangle, n: int, seed: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """One random point in each of n x n equal cells, each (n, n); neighbours in memory are neighbours in the lens."""
    x, y = zip(*sampling.stratified_strips(window, n, seed, dtype), strict=True)
    return torch.cat(x), torch.cat(y)


def launch(source: Emitter, lens: Lens, n: int, seed: int, area: Rectangle | None = None) -> Rays:
    """The rays of `launch_strips` in one bundle, (3, rays), neighbours beside each other."""
    strips = list(launch_strips(source, lens, n, seed, area))
    position, direction = (torch.cat([getattr(s, name) for s in strips], dim=1) for name in ("position", "direction"))
    flux, status = (torch.cat([getattr(s, name) for s in strips]) for name in ("flux", "status"))
    return replace(strips[0], position=position, direction=direction, flux=flux, status=status)


def from_first_net_plain(coming: Rays, lens: Lens, plane: Receiver) -> Landed:
    """`trace.from_first_net` in plain torch."""
    [landed] = from_first_net_to_each_plain(coming, lens, [plane])
    return landed


def from_first_net_to_each_plain(coming: Rays, lens: Lens, planes: Sequence[Receiver]) -> tuple[Landed, ...]:
    """`trace.from_first_net_to_each` in plain torch."""
    rays = across(coming, lens.interfaces[lens.tailored_numbers[0] :])
    return tuple(plane.land(rays) for plane in planes)


def simulated(source: Emitter, lens: Lens, screen: Screen, n: int, seed: int) -> Simulation:
    """The light of n x n stratified rays of one source on the screen."""
    [found] = simulate([(1.0, source, lens, seed)], [screen], n)
    return found


def simulated_plain(source: Emitter, lens: Lens, screen: Screen, n: int, seed: int) -> Simulation:
    """`simulated` in plain torch."""
    [found] = simulate_plain([(1.0, source, lens, seed)], [screen], n)
    return found
