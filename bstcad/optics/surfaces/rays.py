"""Ray bundles, and frames of directions in space.

A bundle keeps its size: a lost ray keeps its place in the tensors, and `status` states the reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from bstcad.optics.surfaces.charts import HEIGHTS, Chart

NO_LOSSES: Mapping[str, Tensor] = MappingProxyType({})
MIN_AXIAL_COSINE = 1e-9  # cosine of the angle between a ray and a receiver's normal up to which the ray misses it


class Status(IntEnum):
    """State of a ray: alive, or the reason of its loss."""

    ALIVE = 0  # not lost
    MISSED_FRONT = 1  # missed the clear aperture of the first face of the solid, or an element before it
    VIGNETTED = 2  # missed a later face of the solid, or met it outside its clear aperture
    TOTAL_REFLECTION = 3  # total internal reflection at a face, or met a refracting face from behind
    TURNED_BACK = 4  # left the last surface away from the receiver, or met a mirror from its rear
    BLOCKED = 5  # missed a window or mirror behind the lens, or met it outside its outline
    STARTED_INSIDE = 6  # given ray of a file that starts inside the solid
    STARTED_BESIDE = 7  # given ray of a file that starts beside or behind the first face
    LEADS_AWAY = 8  # given ray of a file that leads away from the lens at its start


TENSORS = ("position", "direction", "flux", "status")  # names of the tensors of a bundle


@dataclass(frozen=True)
class Rays:
    """A bundle of rays, one column per ray."""

    position: Tensor  # (3, …) positions, mm; the third coordinate is relative to the plane `z`
    direction: Tensor  # (3, …) unit vectors
    flux: Tensor  # (…) fraction of the source's flux; for a corner of a flux tube the transmitted fraction
    status: Tensor  # (…) uint8, Status of each ray
    axial: bool = False  # True if every direction is (0, 0, sense), so that intersections need no iteration
    z: float = 0.0  # mm, reference plane of the positions, so that sags keep their digits far from the origin
    sense: int = 1  # +1 or -1, direction of the light along z; rays of opposite sense are lost at the next surface
    taken: Mapping[str, Tensor] = field(default_factory=lambda: NO_LOSSES)  # (…) flux lost, by ledger line
    chart: Chart = HEIGHTS  # chart of the face at which the rays are

    @property
    def places(self) -> tuple[Tensor, Tensor]:
        """Coordinates x, y (mm) of the rays in the chart of the face at which they are."""
        x, y, _ = self.chart.coordinates(self.position)
        return x, y

    @property
    def alive(self) -> Tensor:
        """True for rays that are not lost."""
        return self.status == Status.ALIVE

    def above(self, z: float) -> Tensor:
        """Return the heights of the positions above the plane z (mm), negative below it."""
        return self.position[2] + (self.z - z)

    def lose(self, where: Tensor, reason: Status) -> Tensor:
        """Return the status with the rays marked by `where` lost for `reason`; a ray keeps its first reason."""
        return torch.where(self.alive & where, torch.full_like(self.status, int(reason)), self.status)


def joined(bands: Iterable[Rays], rows: int, shared: int = 0) -> Rays:
    """Return one bundle (…, rows, columns) from bands of rows; each repeats the last `shared` rows of the band before.

    Besides the whole bundle only one band exists at a time.
    """
    whole: dict[str, Tensor] = {}
    done = 0
    for band in bands:
        parts = {name: getattr(band, name) for name in TENSORS} | dict(band.taken)
        for name, part in parts.items():
            if name not in whole:
                whole[name] = part.new_empty((*part.shape[:-2], rows, part.shape[-1]))
            whole[name][..., done : done + part.shape[-2], :] = part
        done += band.status.shape[-2] - shared
    position, direction, flux, status = map(whole.pop, TENSORS)
    return replace(band, position=position, direction=direction, flux=flux, status=status, taken=whole)


def stacked(bundles: Sequence[Rays]) -> Rays:
    """Return one bundle (…, k, rows, columns) of k bundles (…, rows, columns) of one sense, without losses."""
    first = bundles[0]
    position = torch.stack([torch.stack([*each.position[:2], each.above(first.z)]) for each in bundles], dim=1)
    direction = torch.stack([each.direction.expand_as(each.position) for each in bundles], dim=1)
    flux, status = (torch.stack(same) for same in zip(*((each.flux, each.status) for each in bundles), strict=True))
    return replace(
        first, position=position, direction=direction, flux=flux, status=status, axial=all(b.axial for b in bundles)
    )


@dataclass(frozen=True)
class Landed:
    """Rays at their intersections with a receiver."""

    position: Tensor  # (2, …) coordinates on the receiver, in its unit
    flux: Tensor  # (…) fraction of the source's flux
    status: Tensor  # (…) uint8, Status of each ray
    taken: Mapping[str, Tensor] = field(default_factory=lambda: NO_LOSSES)  # (…) flux lost, by ledger line

    @property
    def alive(self) -> Tensor:
        """True for rays that reached the receiver."""
        return self.status == Status.ALIVE


Vector = tuple[float, float, float]  # (x, y, z)
Frame = tuple[Vector, Vector, Vector]  # unit vectors (e_x, e_y, n) in space


def point_along(start: Vector, distance: float, direction: Vector) -> Vector:
    """Return start + distance · direction."""
    (x, y, z), (d_x, d_y, d_z) = start, direction
    return x + distance * d_x, y + distance * d_y, z + distance * d_z


def dot(vector: Sequence[float | Tensor] | Tensor, of: Any) -> Any:
    """Return the dot product of a vector and vectors (3, …), numbers, numpy arrays or torch tensors."""
    return vector[0] * of[0] + vector[1] * of[1] + vector[2] * of[2]


def axes(tilt: tuple[float, float]) -> Frame:
    """Return (e_x, e_y, n): the axes of space, rotated first about the x axis by α, then about y by β (degrees).

    e_x = (cos β, 0, -sin β), e_y = (sin α sin β, cos α, sin α cos β), n = (cos α sin β, -sin α, cos α cos β).  The
    rotations are right-handed: a positive α inclines n towards -y and a positive β towards +x.
    """
    (sin_a, sin_b), (cos_a, cos_b) = ([f(math.radians(t)) for t in tilt] for f in (math.sin, math.cos))
    return (cos_b, 0.0, -sin_b), (sin_a * sin_b, cos_a, sin_a * cos_b), (cos_a * sin_b, -sin_a, cos_a * cos_b)


def clocked(frame: Frame, angle: float) -> Frame:
    """Return a frame rotated about its third axis by an angle (degrees), right-handed."""
    e_x, e_y, n = frame
    sin, cos = math.sin(math.radians(angle)), math.cos(math.radians(angle))
    x_x, x_y, x_z = (cos * a + sin * b for a, b in zip(e_x, e_y, strict=True))
    y_x, y_y, y_z = (-sin * a + cos * b for a, b in zip(e_x, e_y, strict=True))
    return (x_x, x_y, x_z), (y_x, y_y, y_z), n


def clocking_of(frame: Frame) -> float:
    """Return the angle (degrees) by which `clocked` rotates the `axes` of the frame's tilt to give the frame."""
    e_x, e_y, _ = axes(tilt_of(frame[2]))
    along, across = (sum(p * q for p, q in zip(frame[0], e, strict=True)) for e in (e_x, e_y))
    return math.degrees(math.atan2(across, along))


def tilt_of(n: Vector) -> tuple[float, float]:
    """Return the tilt (α, β) in degrees whose `axes` have the unit vector n as the third axis."""
    return math.degrees(math.asin(max(-1.0, min(1.0, -n[1])))), math.degrees(math.atan2(n[0], n[2]))
