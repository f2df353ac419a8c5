"""Ray tracing through the interfaces of a lens to a receiver, simulation of its irradiance, and ghosts.

The trace is differentiable in all parameters.  Nets do not change the path in front of the first freeform interface:
`to_first_net` traces it once, and `from_first_net` traces the rest whenever the nets change.

A simulation traces stratified rays a strip at a time, so that memory does not grow with their number.

A ghost is light that is reflected twice inside the lens: it enters through the front, is reflected at the back and
again at the front, and leaves through the back.  With T and R the transmittance and reflectance of the front, T' and R'
those of the back, it carries the fraction T R' R T' of a ray's flux, about a thousandth for bare glass; beyond the
critical angle R = 1.  Light that is reflected more often is a few hundred times fainter and is neglected.  Light of a
ghost that misses a face stays in the ledger line of its first reflection.  Tailoring traces no ghosts.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from bstcad.optics.kernels.kernel_arguments import MAX_LIGHT_TABLES, beam
from bstcad.optics.lens.interfaces import Interface, Loss, Reflect, Refract, cross, intersect
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.losses import REFLECTED
from bstcad.optics.light.channels import Channel, source_numbers, weighted_sum
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.light.ray_bundle import RayBundle
from bstcad.optics.numerics import kernel_choice
from bstcad.optics.numerics.reductions import total
from bstcad.optics.receivers import irradiance
from bstcad.optics.receivers.irradiance import Screen, joined_cells
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.bspline import is_net
from bstcad.optics.surfaces.outlines import Outline, Rectangle
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.rays import Landed, Rays, Status
from bstcad.optics.surfaces.surfaces import Plane, Surface

UNDERSIDE = "vignetted by the underside"  # line of the ledger: light that meets a front beside its optical part
BLOCKED = "stopped beside a window or mirror"  # line of the ledger: light that misses an element behind the lens
UNDERSIDE_CELLS = 256  # cells per side of the grid on which light that meets the underside is summed
WINDOW_CELLS = 96  # cells per side of the grid that finds the light which reaches the lens through windows and mirrors
MIN_RAYS_FOR_TABLE = 256  # minimum rays per side for which a table of the source's light is worth its cost
GHOST_RAYS = 1024  # maximum rays per side for a ghost; the noise of a ghost with 1 % of the light adds 0.0003 to RRMSD
# Lines of the ledger that a ghost changes, besides losses.REFLECTED.
GHOST_ON, GHOST_OFF, TOTAL_REFLECTION = "ghost on target", "ghost off target", "total internal reflection"


def across(rays: Rays, interfaces: Sequence[Interface]) -> Rays:
    """Trace rays through a sequence of interfaces in plain torch."""
    for interface in interfaces:
        rays = cross(rays, interface).rays
    return rays


def through(rays: Rays, interfaces: Sequence[Interface], planes: Sequence[Receiver]) -> tuple[Landed, ...]:
    """Trace rays through interfaces to each receiver; nets by a fused kernel if one supports the tensors."""
    *others, last = interfaces
    for interface in others:
        rays = behind(rays, interface)
    fast = _net_kernel("trace.through", rays, last) if all(plane.has_kernel for plane in planes) else None
    landed: tuple[Landed, ...] | None = fast(rays, last, planes) if fast else None
    if landed is not None:
        return landed
    rays = cross(rays, last).rays
    return tuple(plane.land(rays) for plane in planes)


def behind(rays: Rays, interface: Interface) -> Rays:
    """Trace rays through one interface; a net by a fused kernel if one supports the tensors."""
    fast = _net_kernel("trace.behind", rays, interface)
    return fast(rays, interface) if fast else cross(rays, interface).rays


def _net_kernel(name: str, rays: Rays, interface: Interface) -> Callable[..., Any] | None:
    """Return the kernel of this name for the interface's kind of net; None: there is none, use plain torch."""
    net = interface.surface
    if not is_net(net) or (isinstance(net, RadialSurface) and rays.sense < 0):  # domes: light along +z only
        return None
    return kernel_choice.kernel(f"{name} {net.kind}", net.heights, rays.position, rays.direction)


def whole_kernel(
    name: str, source: Emitter, lens: Lens, receiver: Receiver, tables: bool = True
) -> Callable[..., Any] | None:
    """Return the kernel of this name if it can trace from the source through the lens to the receiver; None: it cannot.

    tables: allow a table of the source's light, which costs as much as some ten thousand rays.
    """
    fast = kernel_choice.whole_kernel(name, lens.interfaces) if receiver.has_kernel and not source.is_given else None
    return fast if fast and beam(source, lens, tables) is not None else None


def to_first_net(rays: Rays, lens: Lens) -> Rays:
    """Trace rays from the source through all interfaces in front of the first freeform interface."""
    return across(rays, lens.interfaces[: lens.tailored_numbers[0]])


def from_first_net(coming: Rays, lens: Lens, receiver: Receiver) -> Landed:
    """Trace rays through the first freeform interface, and all interfaces behind it, to the receiver."""
    [landed] = from_first_net_to_each(coming, lens, [receiver])
    return landed


def from_first_net_to_each(coming: Rays, lens: Lens, planes: Sequence[Receiver]) -> tuple[Landed, ...]:
    """Trace rays as `from_first_net` does, once, to each of several receivers."""
    return through(coming, lens.interfaces[lens.tailored_numbers[0] :], planes)


def trace(rays: Rays, lens: Lens, receiver: Receiver) -> Landed:
    """Trace rays from the source through all interfaces of the lens to the receiver."""
    return from_first_net(to_first_net(rays, lens), lens, receiver)


def is_transmitted(rays: Rays, lens: Lens) -> Tensor:
    """Return True for rays from the source that meet all surfaces inside their clear apertures."""
    *others, last = lens.interfaces
    coming = across(rays, others)
    return coming.alive & (behind(coming, replace(last, losses=())).status != last.status_if_missed)


# --- many rays from a source ------------------------------------------------------------------------------------------


def window(source: Emitter, lens: Lens) -> Rectangle:
    """Return the rectangle, on the plane z = const of the first vertex, crossed by all light that can meet the lens."""
    first, aperture = lens.entrance, lens.interfaces[0].outline
    area = source.window(aperture, first.z, first.sags(aperture))
    if not lens.before:
        return area
    face = lens.interfaces[len(lens.before)]
    planes = tuple(Plane(float(face.surface.z) + sag) for sag in face.surface.plain().sags(face.outline))
    return _useful(source, lens.before, tuple(replace(face, surface=p, losses=()) for p in planes), area)


@functools.lru_cache(maxsize=4096)
@torch.no_grad()
def _useful(
    source: Emitter, before: tuple[Interface, ...], faces: tuple[Interface, ...], area: Rectangle, n: int = WINDOW_CELLS
) -> Rectangle:
    """Return the rectangle in `area`, on the plane of the first vertex, with all light that meets a plane of `faces`.

    Two n x n grids of rays are traced; the second covers only the rectangle found with the first.
    """
    z = before[0].surface.z
    for _ in range(2):
        x, y = sampling.grid(area, n)
        rays = across(source.rays_through(x, y, z, 1.0), before)
        meets = torch.stack([cross(rays, face).rays.alive for face in faces]).any(0)
        area = _around(area, (x, y), n, meets & (source.irradiance(x, y, z) > 0))
    return area


def _around(area: Rectangle, points: tuple[Tensor, ...], n: int, useful: Tensor) -> Rectangle:
    """Return the rectangle about the axis with all useful points of an n x n grid, and a margin of two cells."""
    if not bool(useful.any()):
        return area
    sides = zip(points, (area.width, area.height), strict=True)
    half_x, half_y = (min(float(p.abs()[useful].max()) + 2.5 * size / n, size / 2) for p, size in sides)
    return Rectangle(2 * half_x, 2 * half_y)


@torch.no_grad()
def clear_window(source: Emitter, lens: Lens, n: int = 256) -> Rectangle:
    """Return the part of `window` whose light passes all faces, with a margin of two cells of an n x n grid.

    Light outside this part counts as lost, and need not be traced during tailoring.
    """
    area = window(source, lens)
    x, y = (p.to(lens.like) for p in sampling.grid(area, n))
    through = is_transmitted(source.rays_through(x, y, lens.entrance.z, 1.0), lens)
    through &= source.irradiance(x, y, lens.entrance.z) > 0
    return _around(area, (x, y), n, through)


def launch_strips(source: Emitter, lens: Lens, n: int, seed: int, area: Rectangle | None = None) -> Iterator[Rays]:
    """Yield those of n x n stratified rays over `area` (default: `window`) that carry flux, a strip at a time.

    The rays of a file are drawn from the file.
    """
    if isinstance(source, RayBundle):
        yield from source.launched(lens, n, seed)
        return
    area, like = area or window(source, lens), lens.like
    for x, y in sampling.stratified_strips(area, n, seed):
        lit = source.irradiance(x, y, lens.entrance.z) > 0
        whole = bool(lit.all())
        x, y = (p.reshape(-1) if whole else p[lit] for p in (x, y))
        yield source.rays_through(x.to(like), y.to(like), lens.entrance.z, area.area / n**2)


@dataclass(frozen=True)
class Simulation:
    """Simulated light of one set of rays behind a lens."""

    box: Tensor  # flux in each pixel (rows, columns), as a fraction of the source's, row 0 = y max
    tent: Tensor  # flux in each pixel by linear (tent) binning; shape and unit as for `box`
    flux: dict[str, float]  # ledger of the flux by fate, as fractions of the source's; the lines sum to 1
    rays: int  # number of rays launched
    cells: Tensor | None = None  # flux in each cell (k rows, k columns), float32 for the memory; None: k = 1


Lights = Sequence[tuple[float, Emitter, Lens, int]]  # (weight, source, lens at this wavelength, seed) per light


@torch.no_grad()
def simulate(
    lights: Lights, screens: Sequence[Screen], n: int, *, splits_missed: bool = True, cells: int = 1
) -> tuple[Simulation, ...]:
    """Simulate the weighted sum of lights on each screen by n x n stratified rays each, the same rays for all screens.

    cells: number k of cells along each side of a pixel in which the light is counted.
    splits_missed: True: light on the underside has a line of its own; False: it stays in the line "missed the lens",
    which saves a search per source point.

    The fused kernel is used if it supports all lights; it and the plain form trace the same rays and agree to rounding.
    """
    tables = n >= MIN_RAYS_FOR_TABLE and len(lights) <= MAX_LIGHT_TABLES
    kernels = [
        whole_kernel("trace.simulate", source, lens, screen.receiver, tables=tables)
        for _, source, lens, _ in lights
        for screen in screens
    ]
    if all(kernels) and (fast := kernels[0]):
        whole = [(*light, window(light[1], light[2])) for light in lights]
        given = (fast(whole, screen, n, cells=cells) for screen in screens)
        return tuple(_as_fractions(lights, *sums, splits_missed=splits_missed) for sums in given)
    return simulate_plain(lights, screens, n, splits_missed=splits_missed, cells=cells)


@torch.no_grad()
def simulate_plain(
    lights: Lights, screens: Sequence[Screen], n: int, *, splits_missed: bool = True, cells: int = 1
) -> tuple[Simulation, ...]:
    """Simulate as `simulate` does, but in plain torch, with one strip of rays (`launch_strips`) at a time."""
    like, count = lights[0][2].like, 0
    pictures = [
        tuple(
            torch.zeros(each.shape, dtype=torch.float64, device=like.device) for each in (screen.divided(cells), screen)
        )
        for screen in screens
    ]
    ledgers: list[dict[str, float]] = [{} for _ in screens]
    for weight, source, lens, seed in lights:
        for rays in launch_strips(source, lens, n, seed):
            landings = from_first_net_to_each(to_first_net(rays, lens), lens, [screen.receiver for screen in screens])
            for screen, landed, (box, tent), flux in zip(screens, landings, pictures, ledgers, strict=True):
                box += weight * irradiance.box(landed, screen.divided(cells))
                tent += weight * irradiance.tent(landed, screen)
                lines = irradiance.ledger(landed, screen, given=source.is_given)
                if lens.behind:
                    lines[BLOCKED] = float(total(landed.flux[landed.status == int(Status.BLOCKED)].double()))
                for line, value in lines.items():
                    flux[line] = flux.get(line, 0.0) + weight * value
            count += rays.flux.numel()
    return tuple(
        _as_fractions(lights, box, tent, flux=flux, count=count, splits_missed=splits_missed)
        for (box, tent), flux in zip(pictures, ledgers, strict=True)
    )


def _as_fractions(
    lights: Lights, cells: Tensor, tent: Tensor, flux: dict[str, float], count: int, *, splits_missed: bool
) -> Simulation:
    """Return the sums as fractions of the source's light; light not launched missed the lens or met its underside."""
    launched = sum(flux.values())
    whole = max(launched, 1.0)  # the sum may exceed 1 slightly: a cell at the rim of a beam counts whole
    cells = cells.div_(whole)
    box = joined_cells(cells, cells.shape[0] // tent.shape[0])
    fine = None if box is cells else cells.float()
    flux = {line: value / whole for line, value in flux.items()}
    flux["missed the lens"] += 1.0 - launched / whole
    first = lights[0][2]
    if any(source.is_given for _, source, _, _ in lights):  # its rays are counted by where they start
        return Simulation(box, tent / whole, flux, count, cells=fine)
    underside_lit = first.front.outline is not None and first.passes.sense > 0 and not first.before
    if underside_lit and splits_missed:
        stopped = sum(
            part * on_underside(source, lens.front.plain(), lens.back.opening(lens.outline))
            for part, source, lens, _ in lights
        )
        flux[UNDERSIDE] = max(min(stopped, flux["missed the lens"]), 0.0)
        flux["missed the lens"] -= flux[UNDERSIDE]
    return Simulation(box, tent / whole, flux, count, cells=fine)


@functools.lru_cache(maxsize=4096)  # independent of the back, which changes in tailoring
def on_underside(source: Emitter, front: Surface, outline: Outline, n: int = UNDERSIDE_CELLS) -> float:
    """Return the fraction of a source's light that meets the plane around a front's optical part, inside `outline`."""
    assert front.outline is not None  # a front without outline has no plane around it
    plane, (half_x, half_y) = front.around, outline.half_extent
    area = Rectangle(2 * half_x, 2 * half_y)
    x, y = sampling.grid(area, n)
    beside = outline.contains(x, y) & ~front.outline.contains(x, y)
    rays = source.rays_through(x[beside], y[beside], plane.z, area.area / n**2)
    if not rays.z < plane.z:  # a source in the dome lights no plane behind it
        return 0.0
    met, _ = intersect(front.optical, rays, front.outline, Status.MISSED_FRONT)
    return float(total((rays.flux * ~met.alive).double()))


# --- ghosts -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reflection:
    """Reflectance R = 1 - T of a face that light meets from inside the glass; 1 beyond the critical angle."""

    through: Loss  # loss whose share is the transmittance T
    law: Refract  # law of refraction of the transmitted light

    line, in_glass, fused = "transmitted", False, True  # not a line of the ledger: this light leaves the ghost

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """Return R at the angle of incidence, whose cosine is `cos_in`; the other arguments are those of Loss."""
        _, refracted, beyond = self.law.deflection(cos_in)
        safe = torch.where(beyond, torch.ones_like(refracted), refracted)
        return torch.where(beyond, torch.ones_like(cos_in), 1 - self.through.share(cos_in, safe, path))


def ghost(lens: Lens) -> tuple[Interface, ...]:
    """Return the faces in the order of a ghost: in at the front, reflected at back and front, out at the back.

    The reflectance of the faces follows from the lens's losses.
    """
    assert lens.losses is not None  # without losses no face reflects
    front, back = lens.interfaces[lens.solid]
    outwards = replace(front, law=Refract(lens.index, lens.passes.index_before), status_if_missed=Status.VIGNETTED)
    _, outwards = lens.losses.on((front, outwards))  # losses of `outwards` for light from inside the glass
    return front, _from_inside(back), _from_inside(outwards), back


def _from_inside(exit: Interface) -> Interface:
    """Return a face as a mirror for light inside the glass."""
    assert isinstance(exit.law, Refract)
    *glass, face = exit.losses
    return replace(exit, law=Reflect(), losses=(*glass, Reflection(face, exit.law)))


@dataclass(frozen=True, eq=False)
class GhostImage:
    """Light of a ghost."""

    picture: Tensor  # flux in each pixel (rows, columns), as a fraction of the source's, row 0 = y max
    flux: dict[str, float]  # changes by the ghost to the ledger of a simulation without it; the lines sum to 0


@torch.no_grad()
def ghost_light(lens: Lens, channels: Sequence[Channel], screen: Screen, n: int, seed: int) -> GhostImage:
    """Trace the ghost of all channels to a screen by n x n stratified rays per channel, at most GHOST_RAYS per side."""
    n = min(n, GHOST_RAYS)
    parts = [
        _ghost_of_channel(c, c.through(lens), screen, n=n, seed=seed + k)
        for c, k in zip(channels, source_numbers(channels), strict=True)
    ]
    flux = {line: weighted_sum(channels, (part.flux[line] for part in parts)) for line in parts[0].flux}
    return GhostImage(weighted_sum(channels, (part.picture for part in parts)), flux)


def _ghost_of_channel(channel: Channel, lens: Lens, screen: Screen, n: int, seed: int) -> GhostImage:
    """Trace the ghost of one channel; subtract its flux from the ledger's line of its first reflection."""
    picture = torch.zeros(screen.shape, dtype=torch.float64, device=lens.like.device)
    launched, lines = 0.0, dict.fromkeys((GHOST_ON, GHOST_OFF, REFLECTED, TOTAL_REFLECTION), 0.0)
    for rays in launch_strips(channel.source, lens, n, seed):
        out, at_first = trace_ghost(rays, lens)  # at_first: True where the first reflection was total
        landed = screen.receiver.land(out)
        on_screen = landed.alive & screen.contains(*landed.position)
        picture += irradiance.box(landed, screen)
        gains, losses = {GHOST_ON: on_screen, GHOST_OFF: ~on_screen}, {REFLECTED: ~at_first, TOTAL_REFLECTION: at_first}
        for line, counted in (gains | losses).items():
            flux = float(total((out.flux * (out.alive & counted)).double()))
            lines[line] += flux if line in gains else -flux
        launched += float(total(rays.flux.double()))
    whole = max(launched, 1.0)  # the divisor of `_as_fractions`
    return GhostImage(picture / whole, {line: value / whole for line, value in lines.items()})


def trace_ghost(rays: Rays, lens: Lens) -> tuple[Rays, Tensor]:
    """Return (rays of the ghost behind the lens; True where their reflection at the back was total)."""
    entry, down, up, exit = ghost(lens)
    at_back = cross(cross(across(rays, lens.before), entry).rays, down)
    out = cross(cross(at_back.rays, up).rays, exit).rays
    return across(out, lens.behind), exit.law.deflection(at_back.cos_in)[2]
