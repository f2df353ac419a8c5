"""Ray bundles.  A bundle never shrinks: a ray that is lost keeps its place and says why in `status`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from types import MappingProxyType

import torch
from torch import Tensor

NOTHING: Mapping[str, Tensor] = MappingProxyType({})
GRAZING = 1e-9  # cosine to the axis at or below which a ray does not lead to the screen


class Status(IntEnum):
    """What has become of a ray."""

    ALIVE = 0
    MISSED_FRONT = 1  # never met the first surface inside the outline
    VIGNETTED = 2  # left the glass through a side: met the back surface outside the outline, or not at all
    TOTAL_REFLECTION = 3  # total internal reflection at a face
    TURNED_BACK = 4  # left the last surface, but not towards the plane it should land on


@dataclass(frozen=True)
class Rays:
    """A bundle of rays, one column a ray."""

    position: Tensor  # (3, …) mm; the third counts from the plane z
    direction: Tensor  # (3, …) unit vectors
    flux: Tensor  # (…) fraction of the source's whole flux that the ray carries
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


@dataclass(frozen=True)
class Landed:
    """Rays where they meet a plane."""

    position: Tensor  # (2, …) mm, on the plane
    flux: Tensor  # (…) fraction of the source's whole flux
    status: Tensor  # (…) uint8, a Status
    taken: Mapping[str, Tensor] = field(default_factory=lambda: NOTHING)  # flux lost on the way, by lines of the ledger

    @property
    def alive(self) -> Tensor:
        """True for rays that arrived."""
        return self.status == Status.ALIVE
