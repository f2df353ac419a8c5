"""Ray bundles, and the planes that they land on.

A bundle never shrinks: a ray that is lost keeps its place and says why in `status`.  A plane is a level one z = const,
told by its z (mm) alone, or a tilted one; a place on it has two coordinates x and y (mm), measured on the plane itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from types import MappingProxyType
from typing import Any

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


ARRAYS = ("position", "direction", "flux", "status")  # of a bundle


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
    """Rays where they meet a plane."""

    position: Tensor  # (2, …) mm, on the plane
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


Array = Any  # of numpy or torch, or a number


@dataclass(frozen=True)
class TiltedPlane:
    """P = C + (x - c_x) e_x + (y - c_y) e_y: a plane through C, turned about it, and x and y measured on it (mm).

    The axes are those of space, turned first about the x axis by α and then about the y axis by β, right-handed:
    e_x = (cos β, 0, -sin β), e_y = (sin α sin β, cos α, sin α cos β), and the normal, e_x × e_y,
    n = (cos α sin β, -sin α, cos α cos β).  Clocked by γ, e_x and e_y are then turned about n.
    """

    centre: Vector  # C (mm)
    tilt: tuple[float, float]  # α, β (degrees)
    clocking: float = 0.0  # γ (degrees)

    @cached_property
    def axes(self) -> tuple[Vector, Vector, Vector]:
        """e_x, e_y and n, unit vectors in space."""
        return clocked(axes(self.tilt), self.clocking) if self.clocking else axes(self.tilt)

    def height(self, point: Vector) -> float:
        """n · (p - C): how far (mm) a point stands off the plane, negative on the side that light comes from."""
        return math.fsum(n * (p - c) for n, p, c in zip(self.axes[2], point, self.centre, strict=True))

    def point(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """The points in space (mm) of places on the plane."""
        (e_x, e_y, _), (c_x, c_y, _) = self.axes, self.centre
        return tuple(c + (x - c_x) * a + (y - c_y) * b for c, a, b in zip(self.centre, e_x, e_y, strict=True))

    def seen(self, x: Array, y: Array, eye: float) -> tuple[Array, Array]:
        """The points of the level plane through C at which its places are seen from (0, 0, eye), all in mm."""
        p_x, p_y, p_z = self.point(x, y)
        grown = (self.centre[2] - eye) / (p_z - eye)
        return grown * p_x, grown * p_y

    def from_seen(self, q_x: Array, q_y: Array, eye: float) -> tuple[Array, Array]:
        """The places of the plane that are `seen` there."""
        (e_x, e_y, n), (c_x, c_y, c_z) = self.axes, self.centre
        throw = c_z - eye
        path = -self.height((0.0, 0.0, eye)) / (n[0] * q_x + n[1] * q_y + n[2] * throw)
        off = path * q_x - c_x, path * q_y - c_y, (path - 1) * throw
        return c_x + _dot(e_x, off), c_y + _dot(e_y, off)


TargetPlane = float | TiltedPlane  # a level plane is its z (mm)


def middle(plane: TargetPlane) -> float:
    """z (mm) of a level plane, or of the point C of a tilted plane."""
    return plane.centre[2] if isinstance(plane, TiltedPlane) else plane


def normal_of(plane: TargetPlane) -> Vector:
    """The unit normal of a plane, which points away from where light comes from."""
    return plane.axes[2] if isinstance(plane, TiltedPlane) else (0.0, 0.0, 1.0)


def advance(rays: Rays, plane: TargetPlane) -> tuple[Tensor, Tensor]:
    """(n · d, n · (p - C)): how fast rays rise from the plane along their way, and how far above it they are (mm)."""
    if not isinstance(plane, TiltedPlane):
        return rays.direction[2], rays.above(plane)
    normal = plane.axes[2]
    return _dot(normal, rays.direction), _dot(normal, _from_centre(rays, plane))


def coordinates(rays: Rays, plane: TargetPlane) -> Tensor:
    """(2, …) x and y of rays on the plane (mm)."""
    if not isinstance(plane, TiltedPlane):
        return rays.position[:2]
    offset, (e_x, e_y, _) = _from_centre(rays, plane), plane.axes
    return torch.stack([plane.centre[0] + _dot(e_x, offset), plane.centre[1] + _dot(e_y, offset)])


def way_to(rays: Rays, aim: Tensor, plane: TargetPlane) -> Tensor:
    """(3, …) from the rays' positions to places (2, …) of the plane (mm)."""
    if not isinstance(plane, TiltedPlane):
        return torch.stack([aim[0] - rays.position[0], aim[1] - rays.position[1], -rays.above(plane)])
    (e_x, e_y, _), offset = plane.axes, _from_centre(rays, plane)
    x, y = aim[0] - plane.centre[0], aim[1] - plane.centre[1]
    return torch.stack([x * a + y * b - o for a, b, o in zip(e_x, e_y, offset, strict=True)])


def _from_centre(rays: Rays, plane: TiltedPlane) -> tuple[Tensor, Tensor, Tensor]:
    """p - C (mm)."""
    x, y, z = plane.centre
    return rays.position[0] - x, rays.position[1] - y, rays.above(z)


def _dot(vector: Vector, of: Array | tuple[Array, ...]) -> Array:
    return vector[0] * of[0] + vector[1] * of[1] + vector[2] * of[2]
