"""Simulated irradiance of a lens: stratified rays, traced a few at a time, so that memory does not grow with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bstcad.optics import irradiance, sampling
from bstcad.optics.interfaces import intersect
from bstcad.optics.irradiance import Screen
from bstcad.optics.kernels import forward
from bstcad.optics.kernels.choice import fused_whole
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.rays import Rays
from bstcad.optics.sources import Source
from bstcad.optics.trace import towards, trace


def window(source: Source, lens: Lens) -> Rectangle:
    """The rectangle of the plane through the vertex of the first surface that all useful light crosses."""
    first = lens.entrance
    aperture = lens.entrance_aperture
    return source.window(aperture, first.z, first.sags(aperture))


@torch.no_grad()
def clear_window(source: Source, lens: Lens, n: int = 256) -> Rectangle:
    """The rectangle of the same plane that holds all light which gets through both faces, with two cells to spare.

    What lies outside still counts as lost; it need not be traced while tailoring.
    """
    area = window(source, lens)
    x, y = (p.to(lens.like) for p in sampling.grid(area, n))
    through = arrive_at_back(source.rays(x, y, lens.entrance.z, 1.0), lens)
    through &= source.irradiance(x, y, lens.entrance.z) > 0
    if not bool(through.any()):
        return area
    half_x, half_y = (
        min(float(p.abs()[through].max()) + 2.5 * size / n, size / 2) for p, size in ((x, area.width), (y, area.height))
    )
    return Rectangle(2 * half_x, 2 * half_y)


def arrive_at_back(rays: Rays, lens: Lens) -> Tensor:
    """True for rays that meet all surfaces inside their clear apertures."""
    *others, last = lens.interfaces
    met, _, _ = intersect(last.surface, towards(rays, others), last.outline, last.status_if_missed)
    return met.alive


def launch(source: Source, lens: Lens, n: int, seed: int, area: Rectangle | None = None) -> Rays:
    """n x n stratified rays over `area` (default: the whole window), (3, rays), neighbours beside each other.

    Points that carry no flux launch no ray.
    """
    strips = list(launch_strips(source, lens, n, seed, area))
    position, direction = (torch.cat([getattr(s, name) for s in strips], dim=1) for name in ("position", "direction"))
    flux, status = (torch.cat([getattr(s, name) for s in strips]) for name in ("flux", "status"))
    return replace(strips[0], position=position, direction=direction, flux=flux, status=status)


def launch_strips(source: Source, lens: Lens, n: int, seed: int, area: Rectangle | None = None) -> Iterator[Rays]:
    """The rays of `launch`, a strip of the window at a time, so that memory does not grow with their number."""
    area = area or window(source, lens)
    like = {"dtype": lens.like.dtype, "device": lens.like.device}
    for x, y in sampling.stratified_strips(area, n, seed):
        lit = source.irradiance(x, y, lens.entrance.z) > 0
        whole = bool(lit.all())
        x, y = (p.reshape(-1) if whole else p[lit] for p in (x, y))
        yield source.rays(x.to(**like), y.to(**like), lens.entrance.z, area.area / n**2)


@dataclass(frozen=True)
class Simulation:
    """What one set of rays says of a lens."""

    box: Tensor  # (rows, columns) flux that falls into each pixel, as a fraction of the source's, row 0 = y max
    tent: Tensor  # the same by linear binning
    flux: dict[str, float]  # the ledger; lines sum to 1
    rays: int  # how many rays were launched

    @property
    def efficiency(self) -> float:
        """Flux inside the target over flux that leaves the back face."""
        return irradiance.efficiency(self.flux)


def simulate(source: Source, lens: Lens, screen: Screen, n: int, seed: int) -> Simulation:
    """Trace n x n stratified rays from the source through the lens to the screen.

    By `simulate_plain`, or a fused kernel where one serves: the same rays, the same values to rounding.
    """
    return simulate_all([(1.0, source, lens, seed)], screen, n)


@torch.no_grad()
def simulate_all(lights: Sequence[tuple[float, Source, Lens, int]], screen: Screen, n: int) -> Simulation:
    """The same of a weighted sum of lights: (weight, source, lens as this light meets it, seed), n x n rays each."""
    if all(fused_whole(lens.interfaces) for _, _, lens, _ in lights):
        whole = [(*light, window(light[1], light[2])) for light in lights]
        return _of_all_light(*forward.simulate(whole, screen, n))
    return simulate_all_plain(lights, screen, n)


def simulate_plain(source: Source, lens: Lens, screen: Screen, n: int, seed: int) -> Simulation:
    """`simulate` in plain torch."""
    return simulate_all_plain([(1.0, source, lens, seed)], screen, n)


@torch.no_grad()
def simulate_all_plain(lights: Sequence[tuple[float, Source, Lens, int]], screen: Screen, n: int) -> Simulation:
    """`simulate_all` in plain torch, a strip of the window at a time."""
    box = torch.zeros(screen.shape, dtype=torch.float64, device=lights[0][2].back.heights.device)
    tent, flux, count = torch.zeros_like(box), {}, 0
    for weight, source, lens, seed in lights:
        for rays in launch_strips(source, lens, n, seed):
            landed = trace(rays, lens, screen.plane)
            box += weight * irradiance.box(landed, screen)
            tent += weight * irradiance.tent(landed, screen)
            for line, value in irradiance.ledger(landed, screen).items():
                flux[line] = flux.get(line, 0.0) + weight * value
            count += rays.flux.numel()
    return _of_all_light(box, tent, flux, count)


def _of_all_light(box: Tensor, tent: Tensor, flux: dict[str, float], count: int) -> Simulation:
    """The same as fractions of the source's light: what was not launched missed the lens."""
    launched = sum(flux.values())
    whole = max(launched, 1.0)  # cells on the rim of a beam count in or out: together a little more than the beam
    flux = {line: value / whole for line, value in flux.items()}
    flux["missed the lens"] += 1.0 - launched / whole
    return Simulation(box / whole, tent / whole, flux, count)
