"""Receivers: the planes or other surfaces that collect the light, each with its own two coordinates.

A plane is level, z = const, or tilted, with x and y measured on it (mm).  A receiver of another form defines the path
of a ray to it, the coordinates of a point on it, and the point of given coordinates; its coordinates may have another
unit, such as degrees.  The kernels trace rays to planes only; the torch code traces rays to other receivers.
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

from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.rays import MIN_AXIAL_COSINE, Frame, Landed, Rays, Status, Vector, axes, clocked, dot

# attributes and methods that a moved receiver has in common with the receiver at rest
COPIED = ("unit", "light", "photometric_unit", "names", "position_text", "per_radian", "areas", "cell_sizes")

Array = Any  # numpy array, torch tensor or number


class Receiver(ABC):
    """A surface that collects light, with its own coordinates x and y."""

    unit: str = "mm"  # unit of x and y
    light: str = "irradiance"  # quantity of a pixel: irradiance (per area) or radiant intensity (per solid angle)
    photometric_unit: str | None = None  # lx on planes, cd over directions; None: absolute values are not defined
    tilt: tuple[float, float] | None = None  # tilt of a plane about x, then y, degrees; None: not a tilted plane
    names: tuple[str, str] = ("x", "y")  # names of the coordinates
    is_level: bool = False  # True for a plane z = const
    goniometer: int = 0  # number of the system of angles (directions.GONIOMETERS); 0: not a receiver of directions

    @property
    def has_kernel(self) -> bool:
        """True if the kernels trace rays to the receiver."""
        return self.axes is not None or self.goniometer > 0

    @property
    def axes(self) -> Frame | None:
        """Axes (e_x, e_y, n) for the kernels; None: no kernel supports the receiver."""
        return None

    @property
    def labels(self) -> tuple[str, str]:
        """Names of the coordinates, with their unit."""
        x, y = self.names
        return f"{x} ({self.unit})", f"{y} ({self.unit})"

    def position_text(self, origin: float = 0.0) -> str:
        """Return the position in words for reports and messages; z is relative to `origin` (mm)."""
        return f"z = {round(self.throw(origin), 3) + 0.0:.10g} mm"

    @property
    def frame(self) -> Frame | None:
        """Axes (e_x, e_y, n) of a plane, with or without a kernel; None: the receiver is not a plane."""
        return self.axes

    @property
    def origin(self) -> tuple[float, float]:
        """Coordinates of the centre of a plane."""
        return self.middle[0], self.middle[1]

    @property
    @abstractmethod
    def middle(self) -> Vector:
        """Point at the centre, in space (mm); for a tilted plane the point about which it is tilted."""

    @abstractmethod
    def path(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Return (path along each ray to the receiver (mm), zero for rays that miss it; status)."""

    @abstractmethod
    def coordinates(self, rays: Rays) -> Sequence[Tensor]:
        """Return x and y of rays that are on the receiver."""

    @abstractmethod
    def point(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the points in space (mm) at the coordinates x, y of the receiver."""

    @abstractmethod
    def normal(self, aim: Tensor) -> Sequence[Tensor | float]:
        """Return the unit normals at the coordinates `aim` (2, …), directed away from the incident light."""

    def moved(self, motion: Motion) -> Receiver:
        """Return the receiver after a rigid motion; its coordinates move with it."""
        return MovedReceiver(self, motion)

    def land(self, rays: Rays) -> Landed:
        """Trace rays from the last interface to the receiver.

        Each component is a tensor of its own: the gradient of a part of a stacked tensor takes the memory of the whole.
        """
        parts = _by_component(rays, rays.position.unbind(0), rays.direction.unbind(0))
        path, status = self.path(parts)
        position = tuple(p + path * d for p, d in zip(parts.position, parts.direction, strict=True))
        found = self.coordinates(_by_component(parts, position, parts.direction))
        return Landed(torch.stack(tuple(found)), rays.flux, status, rays.taken)

    def to(self, rays: Rays) -> Rays:
        """Move rays along their lines, forwards or backwards, to the receiver; rays that miss it stay and are lost."""
        path, status = self.path(rays)
        return replace(rays, position=rays.position + path * rays.direction, status=status)

    def vector_to(self, rays: Rays, aim: Tensor) -> Tensor:
        """Return the vectors (3, …) (mm) from the rays' positions to the coordinates `aim` (2, …) of the receiver."""
        x, y, z = self.point(*aim)
        return torch.stack([x - rays.position[0], y - rays.position[1], z - rays.above(0.0)])

    def clearance(self, outline: Outline, z: float) -> float:
        """Return the least path (mm) along +z from the rim at z to the receiver; -inf: a rim point has no such path."""
        x, y = (torch.as_tensor(p, dtype=torch.float64) for p in outline.rim_points())
        along = torch.stack([torch.zeros_like(x), torch.zeros_like(x), torch.ones_like(x)])
        start = torch.stack([x, y, torch.zeros_like(x)])
        rays = Rays(start, along, torch.ones_like(x), torch.zeros(x.shape, dtype=torch.uint8), z=z)
        path, status = self.path(rays)
        return float(path.min()) if bool((status == Status.ALIVE).all()) else -math.inf

    def drawn(self, lens: float, z: float) -> Receiver:
        """Return the receiver as pictures show it, behind a lens of width `lens` (mm) whose back is at z (mm)."""
        return self

    def throw(self, z: float) -> float:
        """Return the height (mm) of the centre above the plane z (mm), negative below it."""
        return self.middle[2] - z

    def per_radian(self, z: float) -> float:
        """Return the shift of light at the centre, in the receiver's unit, per radian of deflection at (0, 0, z)."""
        return self.throw(z)

    def areas(self, x: tuple[float, float], y: tuple[float, float], shape: tuple[int, int]) -> np.ndarray | None:
        """Return areas or solid angles of (rows, columns) cells of ranges x, y, divided by their mean; None: equal."""
        return None

    def cell_sizes(self, x: tuple[float, float], y: tuple[float, float], shape: tuple[int, int]) -> np.ndarray:
        """Return the areas (mm²), or over directions the solid angles (sr), of (rows, columns) cells of ranges x, y."""
        mean = (x[1] - x[0]) * (y[1] - y[0]) / (shape[0] * shape[1])
        areas = self.areas(x, y, shape)
        return np.full(shape, mean) if areas is None else mean * areas

    def to_level_plane(self, x: Array, y: Array, eye: float) -> tuple[Array, Array]:
        """Return (x, y) (mm) of the receiver's points projected from (0, 0, eye) onto the level plane of its centre."""
        p_x, p_y, p_z = self.point(x, y)
        scale = self.throw(eye) / (p_z - eye)
        return scale * p_x, scale * p_y

    def from_level_plane(self, q_x: Array, q_y: Array, eye: float) -> tuple[Array, Array]:
        """Return the coordinates that `to_level_plane` projects from (0, 0, eye) onto (q_x, q_y) (mm)."""
        x, y = (torch.as_tensor(q, dtype=torch.float64) for q in (q_x, q_y))
        direction = torch.stack([x, y, torch.full_like(x, self.throw(eye))])
        direction = direction / torch.sqrt((direction * direction).sum(0))
        status = torch.zeros(x.shape, dtype=torch.uint8)
        sight = Rays(torch.zeros_like(direction), direction, torch.ones_like(x), status, z=eye)
        return tuple(self.land(sight).position.numpy())


def _by_component(rays: Rays, position: Any, direction: Any) -> Rays:
    """Return rays with position and direction as tuples of three components, which receivers index like tensors."""
    return replace(rays, position=position, direction=direction)


@dataclass(frozen=True)
class MovedReceiver(Receiver):
    """A receiver after a rigid motion: rays are moved back and traced to the receiver at rest."""

    rest: Receiver  # receiver before the motion
    motion: Motion  # rigid motion

    def __post_init__(self) -> None:
        for name in COPIED:
            object.__setattr__(self, name, getattr(self.rest, name))

    @property
    def middle(self) -> Vector:
        """Point at the centre, in space (mm)."""
        return self.motion.point(self.rest.middle)

    def path(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Return (path along each ray to the receiver (mm), zero for rays that miss it; status)."""
        return self.rest.path(self._back(rays))

    def coordinates(self, rays: Rays) -> Sequence[Tensor]:
        """Return x and y of rays that are on the receiver."""
        return self.rest.coordinates(self._back(rays))

    def point(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the points in space (mm) at the coordinates x, y of the receiver."""
        shift = self.motion.point((0.0, 0.0, 0.0))
        return tuple(t + p for t, p in zip(shift, _rotate(self.motion, self.rest.point(x, y)), strict=True))

    def normal(self, aim: Tensor) -> Sequence[Tensor | float]:
        """Return the unit normals at the coordinates `aim` (2, …), directed away from the incident light."""
        return _rotate(self.motion, self.rest.normal(aim))

    def moved(self, motion: Motion) -> Receiver:
        """Return the receiver after one more motion."""
        return replace(self, motion=motion.after(self.motion))

    def _back(self, rays: Rays) -> Rays:
        """Return the rays in the frame of the receiver at rest, with z relative to the plane z = 0."""
        inverse = self.motion.inverse
        shift, point = inverse.point((0.0, 0.0, 0.0)), (*rays.position[:2], rays.above(0.0))
        position = tuple(t + p for t, p in zip(shift, _rotate(inverse, point), strict=True))
        return _by_component(replace(rays, z=0.0), position, _rotate(inverse, rays.direction))


def _rotate(motion: Motion, vector: Array | Sequence[Array]) -> tuple[Array, Array, Array]:
    """Return components of vectors after the rotation of a motion."""
    return tuple(dot(row, vector) for row in motion.rotation.tolist())


class PlaneReceiver(Receiver):
    """Plane n · (p - C) = 0 of points p = C + (x - o_x) e_x + (y - o_y) e_y; its centre C has the coordinates o."""

    photometric_unit = "lx"

    @property
    def frame(self) -> Frame:
        """Axes (e_x, e_y, n)."""
        assert self.axes is not None  # a plane without a kernel overrides `frame`
        return self.axes

    def height(self, point: Vector) -> float:
        """Return the height n · (p - C) (mm) of a point above the plane, negative on the side of the incident light."""
        return math.fsum(n * (p - c) for n, p, c in zip(self.frame[2], point, self.middle, strict=True))

    def clearance(self, outline: Outline, z: float) -> float:
        """Return the least distance (mm) from an outline on the plane z to this plane; negative: part is behind it."""
        return -self.height((0.0, 0.0, z)) - outline.reach(*self.frame[2][:2])

    def point(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the points in space (mm) at the coordinates x, y of the plane."""
        (e_x, e_y, _), (o_x, o_y) = self.frame, self.origin
        return tuple(c + (x - o_x) * a + (y - o_y) * b for c, a, b in zip(self.middle, e_x, e_y, strict=True))

    def coordinates(self, rays: Rays) -> Sequence[Tensor]:
        """Return x and y (mm) of rays that are on the plane."""
        offset, (e_x, e_y, _), (o_x, o_y) = self._from_centre(rays), self.frame, self.origin
        return o_x + dot(e_x, offset), o_y + dot(e_y, offset)

    def _from_centre(self, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
        """Return p - C (mm) of the rays' positions p."""
        x, y, z = self.middle
        return rays.position[0] - x, rays.position[1] - y, rays.above(z)

    def _advance(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Return (n · d, n · (p - C)): the rise of rays per length of path, and their height above the plane (mm)."""
        normal = self.frame[2]
        return dot(normal, rays.direction), dot(normal, self._from_centre(rays))

    def path(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Return (path along each ray to the plane (mm), zero for rays that miss it; status)."""
        rise, above = self._advance(rays)
        ahead = rise if rays.sense > 0 else -rise
        status = rays.lose(ahead <= MIN_AXIAL_COSINE, Status.TURNED_BACK)
        lands = status == Status.ALIVE
        rise = torch.where(lands, rise, torch.ones_like(rise))
        return torch.where(lands, -above / rise, torch.zeros_like(rise)), status

    def normal(self, aim: Tensor) -> Vector:
        """Return the unit normal of the plane, the same for every aim."""
        return self.frame[2]


@dataclass(frozen=True)
class LevelPlane(PlaneReceiver):
    """Plane z = const, with the x and y of space."""

    z: float  # z of the plane, mm

    axes = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    is_level = True

    @property
    def middle(self) -> Vector:
        """Point of the plane on the axis (mm)."""
        return 0.0, 0.0, self.z

    def _advance(self, rays: Rays) -> tuple[Tensor, Tensor]:
        return rays.direction[2], rays.above(self.z)

    def coordinates(self, rays: Rays) -> Sequence[Tensor]:
        """Return x and y (mm) of rays that are on the plane."""
        return rays.position[0], rays.position[1]

    def point(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the points in space (mm) at the coordinates x, y of the plane."""
        return x, y, 0.0 * x + self.z

    def vector_to(self, rays: Rays, aim: Tensor) -> Tensor:
        """Return the vectors (3, …) (mm) from the rays' positions to the coordinates `aim` (2, …) of the plane."""
        return torch.stack([aim[0] - rays.position[0], aim[1] - rays.position[1], -rays.above(self.z)])


@dataclass(frozen=True)
class TiltedPlane(PlaneReceiver):
    """A tilted plane through C, with x and y measured on it (mm); C has the coordinates (c_x, c_y).

    The axes are those of space, rotated first about the x axis by α and then about the y axis by β, right-handed:
    e_x = (cos β, 0, -sin β), e_y = (sin α sin β, cos α, sin α cos β), and the normal, e_x × e_y,
    n = (cos α sin β, -sin α, cos α cos β).  Clocking by γ then rotates e_x and e_y about n.
    """

    centre: Vector  # centre C, mm
    tilt: tuple[float, float] = (0.0, 0.0)  # angles α, β, degrees
    clocking: float = 0.0  # angle γ, degrees

    @cached_property
    def axes(self) -> Frame:
        """Axes (e_x, e_y, n), unit vectors in space."""
        return clocked(axes(self.tilt), self.clocking) if self.clocking else axes(self.tilt)

    @property
    def middle(self) -> Vector:
        """Centre C (mm)."""
        return self.centre

    def from_level_plane(self, q_x: Array, q_y: Array, eye: float) -> tuple[Array, Array]:
        """Return the coordinates that `to_level_plane` projects from (0, 0, eye) onto (q_x, q_y) (mm)."""
        (e_x, e_y, n), (c_x, c_y, c_z) = self.axes, self.centre
        throw = c_z - eye
        path = -self.height((0.0, 0.0, eye)) / (n[0] * q_x + n[1] * q_y + n[2] * throw)
        offset = path * q_x - c_x, path * q_y - c_y, (path - 1) * throw
        return c_x + dot(e_x, offset), c_y + dot(e_y, offset)

    def vector_to(self, rays: Rays, aim: Tensor) -> Tensor:
        """Return the vectors (3, …) (mm) from the rays' positions to the coordinates `aim` (2, …) of the plane."""
        (e_x, e_y, _), offset = self.axes, self._from_centre(rays)
        x, y = aim[0] - self.centre[0], aim[1] - self.centre[1]
        return torch.stack([x * a + y * b - o for a, b, o in zip(e_x, e_y, offset, strict=True)])
