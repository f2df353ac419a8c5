"""The trace: rays along the interfaces of a lens to a receiver, differentiable in all parameters; sums of many rays.

The part of the way before the first freeform interface stays as it is while a lens is tailored: `to_first_net`
follows it once, and `from_first_net` the rest of it as often as the nets change.

A simulation traces stratified rays a strip at a time, so that memory does not grow with their number.

A ghost is light that is reflected twice inside the lens, and leaves it after the rest: in through the front, down again
from the back, up again from the front, out through the back.  It carries T R' R T' of a ray's flux, some part in a
thousand for bare glass; beyond the critical angle R is 1.  Light that turns more often is a few hundred times fainter
again and is left out; light that meets the outline on its way is absorbed by the sides.  Verification alone follows
ghosts, in plain torch.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from bstcad.optics import irradiance, ops, sampling
from bstcad.optics.channels import Channel, source_numbers, weighted_sum
from bstcad.optics.emitters import Emitter
from bstcad.optics.interfaces import Interface, Loss, Reflect, Refract, cross, intersect
from bstcad.optics.irradiance import Screen
from bstcad.optics.kernels.kernel_arguments import KEPT, beam
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline, Rectangle
from bstcad.optics.rays import Landed, Rays, Status
from bstcad.optics.receivers import Receiver
from bstcad.optics.surfaces import Plane, Surface

UNDERSIDE = "vignetted by the underside"  # a line of the ledger: light beside the optical part of a front
BLOCKED = "stopped beside a window or mirror"  # a line of the ledger of a lens with some behind it
CELLS = 256  # a side of the lens, by which that light is summed
WINDOW_CELLS = 96  # a side of the rectangle in which useful light is looked for, past what is before a lens
TABULATED = 256  # rays a side from which on a table of the source's light is worth its cost
GHOST_RAYS = 1024  # a side, at most; a ghost of 1 % of the light with 3 % of noise in a pixel adds 0.0003 to an RRMSD
ON, OFF, REFLECTED, TOTAL = "ghost on target", "ghost off target", "reflected at the faces", "total internal reflection"


def across(rays: Rays, interfaces: Sequence[Interface]) -> Rays:
    """Rays behind the last of these interfaces, in plain torch."""
    for interface in interfaces:
        rays = cross(rays, interface).rays
    return rays


def through(rays: Rays, interfaces: Sequence[Interface], plane: Receiver) -> Landed:
    """`across`, and on to the receiver, with each net by a fused kernel where the kernels take the tensors."""
    *others, last = interfaces
    for interface in others:
        rays = behind(rays, interface)
    if plane.axes is not None and (fast := _of_net("trace.through", rays, last)):
        return fast(rays, last, plane)
    return plane.land(cross(rays, last).rays)


def behind(rays: Rays, interface: Interface) -> Rays:
    """Rays behind an interface: across a net by a fused kernel where that takes the tensors."""
    fast = _of_net("trace.behind", rays, interface)
    return fast(rays, interface) if fast else cross(rays, interface).rays


def _of_net(name: str, rays: Rays, interface: Interface) -> Callable[..., Any] | None:
    """The kernel of this name, if the interface is a net."""
    surface = interface.surface
    return ops.kernel(name, surface.heights, rays.position, rays.direction) if surface.is_net else None


def whole_kernel(
    name: str, source: Emitter, lens: Lens, plane: Receiver, tables: bool = True
) -> Callable[..., Any] | None:
    """The kernel of this name, if it knows the whole way: this source, all interfaces of the lens and the receiver.

    tables: may it take a table of the source's light, which costs as much as some ten thousand rays?
    """
    fast = ops.whole_kernel(name, lens.interfaces) if plane.axes is not None else None
    return fast if fast and beam(source, lens, tables) is not None else None


def to_first_net(rays: Rays, lens: Lens) -> Rays:
    """Rays from the source on their way to the first freeform interface."""
    return across(rays, lens.interfaces[: lens.freeform[0]])


def from_first_net(coming: Rays, lens: Lens, plane: Receiver) -> Landed:
    """From the first freeform interface on, across all that follow, to the receiver."""
    return through(coming, lens.interfaces[lens.freeform[0] :], plane)


def trace(rays: Rays, lens: Lens, plane: Receiver) -> Landed:
    """From the source along all interfaces of the lens to the receiver."""
    return from_first_net(to_first_net(rays, lens), lens, plane)


def gets_through(rays: Rays, lens: Lens) -> Tensor:
    """True for rays from the source that meet all surfaces inside their clear apertures."""
    *others, last = lens.interfaces
    met, _, _ = intersect(last.surface, across(rays, others), last.outline, last.status_if_missed)
    return met.alive


# --- many rays from a source ------------------------------------------------------------------------------------------


def window(source: Emitter, lens: Lens) -> Rectangle:
    """The rectangle of the plane through the vertex of the first surface that all useful light crosses."""
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
    """The part of a rectangle of the first vertex's plane that holds all light which meets one of the planes behind.

    On two grids, the second with cells of the size of what is useful.
    """
    z = before[0].surface.z
    for _ in range(2):
        x, y = sampling.grid(area, n)
        coming = across(source.rays(x, y, z, 1.0), before)
        meets = torch.stack([cross(coming, face).rays.alive for face in faces]).any(0)
        area = _around(area, (x, y), n, meets & (source.irradiance(x, y, z) > 0))
    return area


def _around(area: Rectangle, places: tuple[Tensor, ...], n: int, wanted: Tensor) -> Rectangle:
    """The rectangle about the axis around the wanted ones of n x n places of another one, with two cells to spare."""
    if not bool(wanted.any()):
        return area
    sides = zip(places, (area.width, area.height), strict=True)
    half_x, half_y = (min(float(p.abs()[wanted].max()) + 2.5 * size / n, size / 2) for p, size in sides)
    return Rectangle(2 * half_x, 2 * half_y)


@torch.no_grad()
def clear_window(source: Emitter, lens: Lens, n: int = 256) -> Rectangle:
    """The rectangle of the same plane that holds all light which gets through both faces, with two cells to spare.

    Light outside it still counts as lost; it need not be traced while tailoring.
    """
    area = window(source, lens)
    x, y = (p.to(lens.like) for p in sampling.grid(area, n))
    through = gets_through(source.rays(x, y, lens.entrance.z, 1.0), lens)
    through &= source.irradiance(x, y, lens.entrance.z) > 0
    return _around(area, (x, y), n, through)


def launch_strips(source: Emitter, lens: Lens, n: int, seed: int, area: Rectangle | None = None) -> Iterator[Rays]:
    """n x n stratified rays over `area` (default: the whole window), a strip of it at a time.

    Points that carry no flux launch no ray.
    """
    area = area or window(source, lens)
    like = {"dtype": lens.like.dtype, "device": lens.like.device}
    for x, y in sampling.stratified_strips(area, n, seed):
        lit = source.irradiance(x, y, lens.entrance.z) > 0
        whole = bool(lit.all())
        x, y = (p.reshape(-1) if whole else p[lit] for p in (x, y))
        yield source.rays(x.to(**like), y.to(**like), lens.entrance.z, area.area / n**2)


@dataclass(frozen=True)
class Simulation:
    """The light of one set of rays behind a lens."""

    box: Tensor  # (rows, columns) flux that falls into each pixel, as a fraction of the source's, row 0 = y max
    tent: Tensor  # the same by linear binning
    flux: dict[str, float]  # the ledger; lines sum to 1
    rays: int  # how many rays were launched

    @property
    def efficiency(self) -> float:
        """Flux inside the target over flux that leaves the back face."""
        return irradiance.efficiency(self.flux)


Lights = Sequence[tuple[float, Emitter, Lens, int]]  # (weight, source, lens as this light meets it, seed) of each


@torch.no_grad()
def simulate(lights: Lights, screen: Screen, n: int) -> Simulation:
    """The weighted sum of lights, of n x n stratified rays each; by the fused kernel where it knows all interfaces.

    Kernel and plain form trace the same rays, and agree to rounding.
    """
    tables = n >= TABULATED and len(lights) <= KEPT
    kernels = [
        whole_kernel("trace.simulate", source, lens, screen.plane, tables=tables) for _, source, lens, _ in lights
    ]
    if fast := all(kernels) and kernels[0]:
        whole = [(*light, window(light[1], light[2])) for light in lights]
        return _of_all_light(lights, *fast(whole, screen, n))
    return simulate_plain(lights, screen, n)


@torch.no_grad()
def simulate_plain(lights: Lights, screen: Screen, n: int) -> Simulation:
    """`simulate` in plain torch, a strip of the window at a time."""
    box = torch.zeros(screen.shape, dtype=torch.float64, device=lights[0][2].like.device)
    tent, flux, count = torch.zeros_like(box), {}, 0
    for weight, source, lens, seed in lights:
        for rays in launch_strips(source, lens, n, seed):
            landed = trace(rays, lens, screen.plane)
            box += weight * irradiance.box(landed, screen)
            tent += weight * irradiance.tent(landed, screen)
            lines = irradiance.ledger(landed, screen)
            if lens.behind:
                lines[BLOCKED] = float(total(landed.flux[landed.status == int(Status.BLOCKED)].double()))
            for line, value in lines.items():
                flux[line] = flux.get(line, 0.0) + weight * value
            count += rays.flux.numel()
    return _of_all_light(lights, box, tent, flux=flux, count=count)


def _of_all_light(lights: Lights, box: Tensor, tent: Tensor, flux: dict[str, float], count: int) -> Simulation:
    """The sums as fractions of the source's light: light not launched missed the lens or met its underside."""
    launched = sum(flux.values())
    whole = max(launched, 1.0)  # cells on the rim of a beam count in or out: together a little more than the beam
    flux = {line: value / whole for line, value in flux.items()}
    flux["missed the lens"] += 1.0 - launched / whole
    first = lights[0][2]
    if first.front.outline is not None and first.passes.sense > 0 and not first.before:  # light meets the plane around
        stopped = sum(part * on_underside(source, lens.front.plain(), lens.outline) for part, source, lens, _ in lights)
        flux[UNDERSIDE] = max(min(stopped, flux["missed the lens"]), 0.0)
        flux["missed the lens"] -= flux[UNDERSIDE]
    return Simulation(box / whole, tent / whole, flux, count)


@functools.lru_cache(maxsize=4096)  # whatever the back
def on_underside(source: Emitter, front: Surface, outline: Outline, n: int = CELLS) -> float:
    """Part of a source's light that meets the plane around the optical part of a front, inside the lens's outline."""
    plane, area = front.around, Rectangle(*(2 * half for half in outline.half_extent))
    x, y = sampling.grid(area, n)
    beside = outline.contains(x, y) & ~front.outline.contains(x, y)
    rays = source.rays(x[beside], y[beside], plane.z, area.area / n**2)
    if not rays.z < plane.z:  # a source in the dome lights no plane behind it
        return 0.0
    through, _, _ = intersect(front.optical, rays, front.outline, Status.MISSED_FRONT)
    return float(total((rays.flux * ~through.alive).double()))


# --- ghosts -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reflection:
    """R = 1 - T of a face that light meets from inside the glass; 1 beyond the critical angle."""

    through: Loss  # T
    law: Refract  # law for the light that goes through

    line, in_glass, fused = "transmitted", False, True  # in no ledger: light that goes through is no part of the ghost

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """R at the angle of incidence."""
        _, refracted, beyond = self.law.turned(cos_in)
        safe = torch.where(beyond, torch.ones_like(refracted), refracted)
        return torch.where(beyond, torch.ones_like(cos_in), 1 - self.through.share(cos_in, safe, path))


def ghost(lens: Lens) -> tuple[Interface, ...]:
    """The faces of the solid for light, in its order, that is reflected once inside at the back and once at the front.

    The lens's losses say what its faces reflect.
    """
    number = lens.number_of("front")
    front, back = lens.interfaces[number : number + 2]
    outwards = replace(front, law=Refract(lens.index, 1.0), status_if_missed=Status.VIGNETTED)
    _, outwards = lens.losses.on((front, outwards))  # the second is met from the glass
    return front, _from_inside(back), _from_inside(outwards), back


def _from_inside(exit: Interface) -> Interface:
    """The same face for the light that does not leave through it."""
    *glass, face = exit.losses
    return replace(exit, law=Reflect(), losses=(*glass, Reflection(face, exit.law)))


@dataclass(frozen=True, eq=False)
class Ghost:
    """The light of a ghost."""

    picture: Tensor  # (rows, columns) flux that falls into each pixel, as a fraction of the source's, row 0 = y max
    flux: dict[str, float]  # changes in the ledger of the light that goes straight through; the lines sum to 0


@torch.no_grad()
def ghost_light(lens: Lens, channels: Sequence[Channel], screen: Screen, n: int, seed: int) -> Ghost:
    """The ghost of all channels on a screen, by n x n stratified rays a channel, GHOST_RAYS at most."""
    n = min(n, GHOST_RAYS)
    parts = [
        _ghost_of_channel(c, c.through(lens), screen, n=n, seed=seed + k)
        for c, k in zip(channels, source_numbers(channels), strict=True)
    ]
    flux = {line: weighted_sum(channels, (part.flux[line] for part in parts)) for line in parts[0].flux}
    return Ghost(weighted_sum(channels, (part.picture for part in parts)), flux)


def _ghost_of_channel(channel: Channel, lens: Lens, screen: Screen, n: int, seed: int) -> Ghost:
    """The ledger has this light under the first reason why it did not leave; that line loses the ghost's flux."""
    picture = torch.zeros(screen.shape, dtype=torch.float64, device=lens.like.device)
    launched, lines = 0.0, dict.fromkeys((ON, OFF, REFLECTED, TOTAL), 0.0)
    for rays in launch_strips(channel.source, lens, n, seed):
        out, total_at_first = follow_ghost(rays, lens)
        landed = screen.plane.land(out)
        on_screen = landed.alive & screen.contains(*landed.position)
        picture += irradiance.box(landed, screen)
        for line, where, sign in (
            (ON, on_screen, 1), (OFF, ~on_screen, 1), (REFLECTED, ~total_at_first, -1), (TOTAL, total_at_first, -1),
        ):  # fmt: skip
            lines[line] += sign * float(total((out.flux * (out.alive & where)).double()))
        launched += float(total(rays.flux.double()))
    whole = max(launched, 1.0)  # as `_of_all_light` has it
    return Ghost(picture / whole, {line: value / whole for line, value in lines.items()})


def follow_ghost(rays: Rays, lens: Lens) -> tuple[Rays, Tensor]:
    """(the ghost of rays from the source behind the lens, which of them no angle lets through the back at first)."""
    enter, down, up, leave = ghost(lens)
    at_back = cross(cross(across(rays, lens.before), enter).rays, down)
    out = cross(cross(at_back.rays, up).rays, leave).rays
    return across(out, lens.behind), leave.law.turned(at_back.cos_in)[2]
