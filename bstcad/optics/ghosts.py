"""Ghosts: light that is reflected twice inside the lens, and leaves it after the rest.

A ghost is a sequence of interfaces like any other: in through the front, down again from the back, up again from the
front, out through the back.  It carries T R' R T' of a ray's flux, some part in a thousand for bare glass; beyond the
critical angle R is 1.  Light that turns more often is a few hundred times fainter again and is left out.  What meets
the outline on its way is absorbed by the sides.

Verification alone follows it, by stratified rays in plain torch; tailoring does not know of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bstcad.optics import irradiance, planes
from bstcad.optics.channels import Channel, places, weighted_sum
from bstcad.optics.interfaces import Interface, Loss, Reflect, Refract, cross
from bstcad.optics.irradiance import Screen
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.rays import Landed, Rays, Status
from bstcad.optics.simulation import launch_strips
from bstcad.optics.trace import to_plane

FINEST = 1024  # rays a side; a ghost of 1 % of the light with 3 % of noise in a pixel adds 0.0003 to an RRMSD
ON, OFF, REFLECTED, TOTAL = "ghost on target", "ghost off target", "reflected at the faces", "total internal reflection"


@dataclass(frozen=True)
class Reflection:
    """R = 1 - T of a face that light meets from inside the glass; 1 beyond the critical angle."""

    through: Loss  # T
    law: Refract  # of the light that goes through

    line, in_glass = "transmitted", False  # of no ledger: what goes through is no part of the ghost

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """R at the angle of incidence."""
        _, refracted, beyond = self.law.turned(cos_in)
        safe = torch.where(beyond, torch.ones_like(refracted), refracted)
        return torch.where(beyond, torch.ones_like(cos_in), 1 - self.through.share(cos_in, safe, path))


def ghost(lens: Lens) -> tuple[Interface, ...]:
    """What light crosses, in its order, that is reflected once from inside at the back and once at the front.

    lens: its losses say what its faces reflect.
    """
    front, back = lens.interfaces
    outwards = replace(front, law=Refract(lens.index, 1.0), status_if_missed=Status.VIGNETTED)
    _, outwards = lens.losses.on((front, outwards))  # the second is met from the glass
    return front, _from_inside(back), _from_inside(outwards), back


def _from_inside(exit: Interface) -> Interface:
    """The same face for the light that does not leave through it."""
    *glass, face = exit.losses
    return replace(exit, law=Reflect(), losses=(*glass, Reflection(face, exit.law)))


@dataclass(frozen=True, eq=False)
class Ghost:
    """What light takes that way."""

    picture: Tensor  # (rows, columns) flux that falls into each pixel, as a fraction of the source's, row 0 = y max
    flux: dict[str, float]  # what it changes in the ledger of the light that goes straight through; the lines sum to 0


def ghost_light(lens: Lens, channels: Sequence[Channel], screen: Screen, n: int, seed: int) -> Ghost:
    """The ghost of all channels on a screen, by n x n stratified rays a channel, FINEST at most."""
    n = min(n, FINEST)
    parts = [_of_channel(c, lens, screen, n, seed + place) for c, place in zip(channels, places(channels), strict=True)]
    flux = {line: weighted_sum(channels, (part.flux[line] for part in parts)) for line in parts[0].flux}
    return Ghost(weighted_sum(channels, (part.picture for part in parts)), flux)


@torch.no_grad()
def _of_channel(channel: Channel, lens: Lens, screen: Screen, n: int, seed: int) -> Ghost:
    """In the ledger this light stands under what first kept it from leaving; that line loses what the ghost's win."""
    lens = channel.through(lens)
    picture = torch.zeros(screen.shape, dtype=torch.float64, device=lens.like.device)
    launched, lines = 0.0, dict.fromkeys((ON, OFF, REFLECTED, TOTAL), 0.0)
    for rays in launch_strips(channel.source, lens, n, seed):
        out, total_at_first = follow(rays, lens)
        landed = to_plane(out, screen.plane)
        landed = Landed(planes.coordinates(landed, screen.plane), landed.flux, landed.status)
        on_screen = landed.alive & screen.contains(*landed.position)
        picture += irradiance.box(landed, screen)
        for line, where, sign in (
            (ON, on_screen, 1),
            (OFF, ~on_screen, 1),
            (REFLECTED, ~total_at_first, -1),
            (TOTAL, total_at_first, -1),
        ):
            lines[line] += sign * float(total((out.flux * (out.alive & where)).double()))
        launched += float(total(rays.flux.double()))
    whole = max(launched, 1.0)  # as simulation has it
    return Ghost(picture / whole, {line: value / whole for line, value in lines.items()})


def follow(rays: Rays, lens: Lens) -> tuple[Rays, Tensor]:
    """(the ghost of rays from the source behind the lens, which of them no angle lets through the back at first)."""
    enter, down, up, leave = ghost(lens)
    at_back = cross(cross(rays, enter).rays, down)
    out = cross(cross(at_back.rays, up).rays, leave).rays
    return out, leave.law.turned(at_back.cos_in)[2]
