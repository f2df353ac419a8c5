"""Receivers: where light is collected, each with two coordinates of its own.

A plane is a level one, z = const, or a tilted one, on which x and y are measured (mm).  A receiver of another form says
how far it is along a ray, which of its places lies there, and where its places are in space; it may measure them in
another unit, such as degrees.  The kernels know planes alone: light lands on others by the plain form.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.motion import Motion
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import GRAZING, Landed, Rays, Status, Vector, axes, clocked

Array = Any  # an array of numpy or torch, or a number


class Receiver(ABC):
    """Where light is collected; x and y are its own coordinates."""

    unit: str = "mm"  # the unit of x and y
    light: str = "irradiance"  # light of a pixel over its area; over its solid angle it is radiant intensity
    tilt: tuple[float, float] | None = None  # tilt of a plane about x, then y (degrees); None: it is level, or no plane
    names: tuple[str, str] = ("x", "y")  # the names of its axes
    axes: tuple[Vector, Vector, Vector] | None = None  # e_x, e_y and n for the kernels; None: it has no kernel
    is_level: bool = False  # a plane z = const?

    @property
    def labels(self) -> tuple[str, str]:
        """The names of its axes, with their unit."""
        return tuple(f"{name} ({self.unit})" for name in self.names)

    def where(self, origin: float = 0.0) -> str:
        """Return its place in words, for every sheet, page and sentence; z is counted from `origin` (mm)."""
        return f"z = {round(self.throw(origin), 3) + 0.0:.10g} mm"

    @property
    def frame(self) -> tuple[Vector, Vector, Vector] | None:
        """e_x, e_y and n of a plane, with a kernel or without; None: the receiver is no plane."""
        return self.axes

    @property
    def origin(self) -> tuple[float, float]:
        """Coordinates of the middle of a plane."""
        return self.middle[0], self.middle[1]

    @property
    @abstractmethod
    def middle(self) -> Vector:
        """A point in its middle, in space (mm); of a tilted plane the one that it is turned about."""

    @abstractmethod
    def path(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """(way along each ray to the receiver (mm), zero for rays that do not come to it; status)."""

    @abstractmethod
    def places(self, rays: Rays) -> Sequence[Tensor]:
        """x and y of rays that are on the receiver."""

    @abstractmethod
    def point(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """The points in space (mm) of its places."""

    @abstractmethod
    def normal(self, aim: Tensor) -> Sequence[Tensor | float]:
        """The unit normal in each of these places (2, …), which points away from where light comes from."""

    def moved(self, motion: Motion) -> Receiver:
        """The receiver after a rigid motion; its places keep their coordinates."""
        return Moved(self, motion)

    def land(self, rays: Rays) -> Landed:
        """Rays behind the last interface, on the receiver.

        Each component is followed by itself: the gradient of a part of a stacked tensor is as large as the whole.
        """
        parts = replace(rays, position=rays.position.unbind(0), direction=rays.direction.unbind(0))
        path, status = self.path(parts)
        there = (p + path * d for p, d in zip(parts.position, parts.direction, strict=True))
        at = self.places(replace(parts, position=tuple(there)))
        return Landed(torch.stack(tuple(at)), rays.flux, status, rays.taken)

    def to(self, rays: Rays) -> Rays:
        """Move rays along their direction to the receiver ahead of them; those that lead away from it are lost."""
        path, status = self.path(rays)
        return replace(rays, position=rays.position + path * rays.direction, status=status)

    def way_to(self, rays: Rays, aim: Tensor) -> Tensor:
        """(3, …) from the rays' positions to places (2, …) of the receiver (mm)."""
        x, y, z = self.point(*aim)
        return torch.stack([x - rays.position[0], y - rays.position[1], z - rays.above(0.0)])

    def clearance(self, outline: Outline, z: float) -> float:
        """Return how far (mm) along +z it passes an outline on the plane z; -inf: not all of it lies before it."""
        x, y = (torch.as_tensor(p, dtype=torch.float64) for p in outline.places())
        along = torch.stack([torch.zeros_like(x), torch.zeros_like(x), torch.ones_like(x)])
        start = torch.stack([x, y, torch.zeros_like(x)])
        rays = Rays(start, along, torch.ones_like(x), torch.zeros(x.shape, dtype=torch.uint8), z=z)
        path, status = self.path(rays)
        return float(path.min()) if bool((status == Status.ALIVE).all()) else -math.inf

    def throw(self, z: float) -> float:
        """From the plane z to its middle (mm), along the axis."""
        return self.middle[2] - z

    def per_radian(self, z: float) -> float:
        """Return how far, in its unit, light from (0, 0, z) moves in its middle as it turns by a radian."""
        return self.throw(z)

    def areas(self, x: tuple[float, float], y: tuple[float, float], shape: tuple[int, int]) -> np.ndarray | None:
        """Return the areas or solid angles of the (rows, columns) cells of x by y, of mean 1; None: they are equal."""
        return None

    def seen(self, x: Array, y: Array, eye: float) -> tuple[Array, Array]:
        """The points of the level plane through its middle at which its places are seen from (0, 0, eye), in mm."""
        p_x, p_y, p_z = self.point(x, y)
        grown = self.throw(eye) / (p_z - eye)
        return grown * p_x, grown * p_y

    def from_seen(self, q_x: Array, q_y: Array, eye: float) -> tuple[Array, Array]:
        """The places of the receiver that are `seen` there."""
        x, y = (torch.as_tensor(q, dtype=torch.float64) for q in (q_x, q_y))
        way = torch.stack([x, y, torch.full_like(x, self.throw(eye))])
        status = torch.zeros(x.shape, dtype=torch.uint8)
        sight = Rays(torch.zeros_like(way), way / torch.sqrt((way * way).sum(0)), torch.ones_like(x), status, z=eye)
        return tuple(self.land(sight).position.numpy())


@dataclass(frozen=True)
class Moved(Receiver):
    """A receiver after a rigid motion: light lands on it as light that is moved back lands on the one at rest."""

    rest: Receiver
    motion: Motion

    def __post_init__(self) -> None:
        for name in ("unit", "light", "names", "where", "per_radian", "areas"):  # which no motion changes
            object.__setattr__(self, name, getattr(self.rest, name))

    @property
    def middle(self) -> Vector:
        """The point in the middle, in space (mm)."""
        return self.motion.point(self.rest.middle)

    def path(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """(way along each ray to the receiver (mm), zero for rays that do not come to it; status)."""
        return self.rest.path(self._back(rays))

    def places(self, rays: Rays) -> Sequence[Tensor]:
        """x and y of rays that are on the receiver."""
        return self.rest.places(self._back(rays))

    def point(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """The points in space (mm) of its places."""
        shift = self.motion.point((0.0, 0.0, 0.0))
        return tuple(t + p for t, p in zip(shift, _turned(self.motion, self.rest.point(x, y)), strict=True))

    def normal(self, aim: Tensor) -> Sequence[Tensor | float]:
        """The unit normal in each of these places (2, …), which points away from where light comes from."""
        return _turned(self.motion, self.rest.normal(aim))

    def moved(self, motion: Motion) -> Receiver:
        """The receiver after one more motion."""
        return replace(self, motion=motion.after(self.motion))

    def _back(self, rays: Rays) -> Rays:
        """The rays as they lie to the receiver at rest, their places counted from the plane z = 0."""
        inverse = self.motion.inverse
        shift, place = inverse.point((0.0, 0.0, 0.0)), (*rays.position[:2], rays.above(0.0))
        position = tuple(t + p for t, p in zip(shift, _turned(inverse, place), strict=True))
        return replace(rays, position=position, direction=_turned(inverse, rays.direction), z=0.0)


def _turned(motion: Motion, vector: Sequence[Array]) -> tuple[Array, Array, Array]:
    """Components of vectors after the turn of a motion."""
    return tuple(dot(row, vector) for row in motion.rotation.tolist())


class Plane(Receiver):
    """P = C + (x - o_x) e_x + (y - o_y) e_y, the plane n · (p - C) = 0; C its middle, o the coordinates of C on it."""

    def height(self, point: Vector) -> float:
        """n · (p - C): how far (mm) a point stands off the plane, negative on the side that light comes from."""
        return math.fsum(n * (p - c) for n, p, c in zip(self.frame[2], point, self.middle, strict=True))

    def clearance(self, outline: Outline, z: float) -> float:
        """Return how far (mm) it passes an outline on the plane z; negative: it cuts the outline."""
        return -self.height((0.0, 0.0, z)) - outline.reach(*self.frame[2][:2])

    def point(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """The points in space (mm) of places on the plane."""
        (e_x, e_y, _), (o_x, o_y) = self.frame, self.origin
        return tuple(c + (x - o_x) * a + (y - o_y) * b for c, a, b in zip(self.middle, e_x, e_y, strict=True))

    def places(self, rays: Rays) -> Sequence[Tensor]:
        """x and y of rays that are on the plane (mm)."""
        offset, (e_x, e_y, _), (o_x, o_y) = self._from_centre(rays), self.frame, self.origin
        return o_x + dot(e_x, offset), o_y + dot(e_y, offset)

    def _from_centre(self, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
        """p - C (mm)."""
        x, y, z = self.middle
        return rays.position[0] - x, rays.position[1] - y, rays.above(z)

    def _advance(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """(n · d, n · (p - C)): how fast rays rise from it along their way, and how far above it they are (mm)."""
        normal = self.frame[2]
        return dot(normal, rays.direction), dot(normal, self._from_centre(rays))

    def path(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """(way along each ray to the plane (mm), zero for rays that do not come to it; status)."""
        rise, above = self._advance(rays)
        ahead = rise if rays.sense > 0 else -rise
        status = rays.lose(ahead <= GRAZING, Status.TURNED_BACK)
        lands = status == Status.ALIVE
        rise = torch.where(lands, rise, torch.ones_like(rise))
        return torch.where(lands, -above / rise, torch.zeros_like(rise)), status

    def normal(self, aim: Tensor) -> Vector:
        """The unit normal, everywhere the same."""
        return self.frame[2]


@dataclass(frozen=True)
class LevelPlane(Plane):
    """The plane z = const, with the x and y of space."""

    z: float  # mm

    axes = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    is_level = True

    @property
    def middle(self) -> Vector:
        """Its point on the axis (mm)."""
        return 0.0, 0.0, self.z

    def _advance(self, rays: Rays) -> tuple[Tensor, Tensor]:
        return rays.direction[2], rays.above(self.z)

    def places(self, rays: Rays) -> Sequence[Tensor]:
        """x and y of rays that are on the plane (mm)."""
        return rays.position[:2]

    def point(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """The points in space (mm) of places on the plane."""
        return x, y, 0.0 * x + self.z

    def way_to(self, rays: Rays, aim: Tensor) -> Tensor:
        """(3, …) from the rays' positions to places (2, …) of the plane (mm)."""
        return torch.stack([aim[0] - rays.position[0], aim[1] - rays.position[1], -rays.above(self.z)])


@dataclass(frozen=True)
class TiltedPlane(Plane):
    """A plane through C, turned about it, and x and y measured on it (mm): o = (c_x, c_y).

    The axes are those of space, turned first about the x axis by α and then about the y axis by β, right-handed:
    e_x = (cos β, 0, -sin β), e_y = (sin α sin β, cos α, sin α cos β), and the normal, e_x × e_y,
    n = (cos α sin β, -sin α, cos α cos β).  Clocked by γ, e_x and e_y are then turned about n.
    """

    centre: Vector  # C (mm)
    tilt: tuple[float, float] = (0.0, 0.0)  # α, β (degrees)
    clocking: float = 0.0  # γ (degrees)

    @cached_property
    def axes(self) -> tuple[Vector, Vector, Vector]:
        """e_x, e_y and n, unit vectors in space."""
        return clocked(axes(self.tilt), self.clocking) if self.clocking else axes(self.tilt)

    @property
    def middle(self) -> Vector:
        """C (mm)."""
        return self.centre

    def from_seen(self, q_x: Array, q_y: Array, eye: float) -> tuple[Array, Array]:
        """The places of the plane that are `seen` there."""
        (e_x, e_y, n), (c_x, c_y, c_z) = self.axes, self.centre
        throw = c_z - eye
        path = -self.height((0.0, 0.0, eye)) / (n[0] * q_x + n[1] * q_y + n[2] * throw)
        off = path * q_x - c_x, path * q_y - c_y, (path - 1) * throw
        return c_x + dot(e_x, off), c_y + dot(e_y, off)

    def way_to(self, rays: Rays, aim: Tensor) -> Tensor:
        """(3, …) from the rays' positions to places (2, …) of the plane (mm)."""
        (e_x, e_y, _), offset = self.axes, self._from_centre(rays)
        x, y = aim[0] - self.centre[0], aim[1] - self.centre[1]
        return torch.stack([x * a + y * b - o for a, b, o in zip(e_x, e_y, offset, strict=True)])


def dot(vector: Sequence[float], of: Array | Sequence[Array]) -> Array:
    """The product of a vector and others (3, …)."""
    return vector[0] * of[0] + vector[1] * of[1] + vector[2] * of[2]
