"""Ray bundles, and frames of directions in space.

A bundle never shrinks: a ray that is lost keeps its place and says why in `status`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from types import MappingProxyType

import torch
from torch import Tensor

NOTHING: Mapping[str, Tensor] = MappingProxyType({})
GRAZING = 1e-9  # cosine to the axis at or below which a ray does not lead to the screen


class Status(IntEnum):
    """The state of a ray: under way, or why it was lost."""

    ALIVE = 0
    MISSED_FRONT = 1  # never met the first surface inside the outline
    VIGNETTED = 2  # left the glass through a side: met the back surface outside the outline, or not at all
    TOTAL_REFLECTION = 3  # total internal reflection at a face
    TURNED_BACK = 4  # left the last surface, but not towards the plane it should land on
    BLOCKED = 5  # met a window or a mirror behind the lens outside its outline, or not at all


ARRAYS = ("position", "direction", "flux", "status")  # tensors of a bundle


@dataclass(frozen=True)
class Rays:
    """A bundle of rays, one column a ray."""

    position: Tensor  # (3, …) mm; the third counts from the plane z
    direction: Tensor  # (3, …) unit vectors
    flux: Tensor  # (…) fraction of the source's flux; of the corner of a tube the share that is left of it
    status: Tensor  # (…) uint8, a Status
    axial: bool = False  # is every direction exactly (0, 0, sense)?  Then a hit needs no root finding
    z: float = 0.0  # mm; where the bundle is: a sag keeps its digits however far from the origin the lens stands
    sense: int = 1  # +1 or -1: the way of the light along z; single rays of it may be going the other way, and get lost
    taken: Mapping[str, Tensor] = field(default_factory=lambda: NOTHING)  # flux lost so far, by lines of the ledger

    @property
    def alive(self) -> Tensor:
        """True for rays that are still under way."""
        return self.status == Status.ALIVE

    def above(self, z: float) -> Tensor:
        """Distance along the axis from the plane z (mm): negative before it."""
        return self.position[2] + (self.z - z)

    def lose(self, where: Tensor, reason: Status) -> Tensor:
        """The status after rays at `where` are lost for `reason`; a ray keeps its first reason."""
        return torch.where(self.alive & where, torch.full_like(self.status, int(reason)), self.status)


def joined(bands: Iterable[Rays], rows: int, shared: int = 0) -> Rays:
    """The bundle (…, rows, columns) of bands of rows, each of which begins with the last `shared` rows before it.

    No more than one band is held beside the whole.
    """
    whole: dict[str, Tensor] = {}
    done = 0
    for band in bands:
        parts = {name: getattr(band, name) for name in ARRAYS} | dict(band.taken)
        for name, part in parts.items():
            if name not in whole:
                whole[name] = part.new_empty((*part.shape[:-2], rows, part.shape[-1]))
            whole[name][..., done : done + part.shape[-2], :] = part
        done += band.status.shape[-2] - shared
    return replace(band, **{name: whole.pop(name) for name in ARRAYS}, taken=whole)


@dataclass(frozen=True)
class Landed:
    """Rays where they meet a receiver."""

    position: Tensor  # (2, …) its own coordinates of the places
    flux: Tensor  # (…) fraction of the source's whole flux
    status: Tensor  # (…) uint8, a Status
    taken: Mapping[str, Tensor] = field(default_factory=lambda: NOTHING)  # flux lost on the way, by lines of the ledger

    @property
    def alive(self) -> Tensor:
        """True for rays that arrived."""
        return self.status == Status.ALIVE


Vector = tuple[float, float, float]


def axes(tilt: tuple[float, float]) -> tuple[Vector, Vector, Vector]:
    """e_x, e_y and n: the axes of space, turned first about the x axis by α, then about the y axis by β (degrees).

    e_x = (cos β, 0, -sin β), e_y = (sin α sin β, cos α, sin α cos β), n = (cos α sin β, -sin α, cos α cos β): both
    turns are right-handed, so that a positive α leans n towards -y and a positive β towards +x.
    """
    (sin_a, sin_b), (cos_a, cos_b) = ([f(math.radians(t)) for t in tilt] for f in (math.sin, math.cos))
    return (cos_b, 0.0, -sin_b), (sin_a * sin_b, cos_a, sin_a * cos_b), (cos_a * sin_b, -sin_a, cos_a * cos_b)


def clocked(frame: tuple[Vector, Vector, Vector], angle: float) -> tuple[Vector, Vector, Vector]:
    """A frame turned about its own third axis by an angle (degrees), right-handed."""
    e_x, e_y, n = frame
    sin, cos = math.sin(math.radians(angle)), math.cos(math.radians(angle))
    x, y = (tuple(p * a + q * b for a, b in zip(e_x, e_y, strict=True)) for p, q in ((cos, sin), (-sin, cos)))
    return x, y, n


def clocking_of(frame: tuple[Vector, Vector, Vector]) -> float:
    """The angle (degrees) by which `axes` of the frame's tilt have to be `clocked` to be the frame."""
    e_x, e_y, _ = axes(tilt_of(frame[2]))
    along, across = (sum(p * q for p, q in zip(frame[0], e, strict=True)) for e in (e_x, e_y))
    return math.degrees(math.atan2(across, along))


def tilt_of(n: Vector) -> tuple[float, float]:
    """(α, β) in degrees of the frame whose third axis is n, a unit vector with n_z > 0."""
    return math.degrees(math.asin(max(-1.0, min(1.0, -n[1])))), math.degrees(math.atan2(n[0], n[2]))
