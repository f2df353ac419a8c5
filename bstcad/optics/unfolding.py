"""Receivers where a tailored face sees them: through a flat face of the lens, past windows and in flat mirrors.

Stage 1 aims from the last tailored face straight at the receiver.  Behind flat mirrors it aims at the receiver's mirror
image, which is exact.  A plate of thickness t and index n brings the image nearer by t (1 - 1 / n), to first order in
the angle; stage 2, which traces all interfaces, does the rest.  Light that is still in the glass leaves it through a
flat face: towards each place it takes the way that Snell's law has it take (`BehindGlass`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bstcad.optics.interfaces import Interface
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.rays import Rays, Vector
from bstcad.optics.receivers import LevelPlane, Plane, Receiver, dot
from bstcad.optics.surfaces import sag
from bstcad.optics.tilted import Tilted

STEPS = 8  # steps of Newton's method to the place of a flat face from which light goes to a place of a receiver
TINY = 1e-300  # instead of 0, as a divisor
STRAIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Image(Plane):
    """The image of a plane, on which its places keep their coordinates."""

    centre: Vector  # C (mm)
    at: tuple[float, float]  # o: the coordinates of C on the plane
    vectors: tuple[Vector, Vector, Vector]  # e_x, e_y and the normal, which points away from where light comes from

    @classmethod
    def of(cls, plane: Receiver) -> Image:
        """Return a plane as the image of itself."""
        if isinstance(plane, Image):
            return plane
        return cls(plane.middle, plane.origin, plane.frame)

    @property
    def frame(self) -> tuple[Vector, Vector, Vector]:
        """e_x, e_y and n; no kernel knows them, which takes planes by `axes`."""
        return self.vectors

    @property
    def origin(self) -> tuple[float, float]:
        """o."""
        return self.at

    @property
    def middle(self) -> Vector:
        """C (mm)."""
        return self.centre

    def in_mirror(self, mirror: Tilted) -> Image:
        """Return the mirror image."""
        n = mirror.unit
        e_x, e_y, across = (_reflected(v, n) for v in self.frame)
        shift = -2 * mirror.height_above(self.centre)
        centre = tuple(c + shift * part for c, part in zip(self.centre, n, strict=True))
        return replace(self, centre=centre, vectors=(e_x, e_y, tuple(-part for part in across)))

    def nearer(self, way: Vector) -> Image:
        """Return the image moved by a vector (mm)."""
        return replace(self, centre=tuple(c + w for c, w in zip(self.centre, way, strict=True)))

    def plain(self) -> Receiver:
        """Return a level plane with the axes of space as such, else itself."""
        (c_x, c_y, z), (o_x, o_y) = self.centre, self.origin
        return LevelPlane(z) if self.frame == STRAIGHT and (c_x, c_y) == (o_x, o_y) else self


@dataclass(frozen=True)
class BehindGlass(Receiver):
    """A receiver at which light aims that is still in the glass, and leaves it through a level face."""

    rest: Receiver
    z: float  # mm; of the face
    eta: float  # index of the glass over that behind it

    @property
    def middle(self) -> Vector:
        """The point in the middle of the receiver (mm)."""
        return self.rest.middle

    def path(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """(way along each ray behind the face to the receiver (mm), status)."""
        return self.rest.path(rays)

    def places(self, rays: Rays) -> Sequence[Tensor]:
        """x and y of rays that are on the receiver."""
        return self.rest.places(rays)

    def point(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The points in space (mm) of places on the receiver."""
        return self.rest.point(x, y)

    def normal(self, aim: Tensor) -> Sequence[Tensor | float]:
        """The unit normal of the receiver in each of these places (2, …)."""
        return self.rest.normal(aim)

    def way_to(self, rays: Rays, aim: Tensor) -> Tensor:
        """(3, …) the unit vectors along which rays in the glass go to places (2, …) of the receiver.

        From a place of the face the light goes on along s to the receiver, d behind it, and before the face it comes
        along i = (s_x / η, s_y / η) through t of glass from another place of the face.  Newton's method makes both one:
        as the place moves by 1, the other one moves back by k = t s_z / (η d i_z) across the plane of incidence, and
        by k (s_z / i_z)² in it.
        """
        below, way = rays.above(self.z), self.rest.way_to(rays, aim)
        at = rays.position - below / way[2] * way
        for _ in range(STEPS):
            out = self.rest.way_to(replace(rays, position=at), aim)
            length = torch.sqrt((out * out).sum(0))
            sines = out[:2] / length / self.eta
            way = torch.cat([sines, (torch.sign(out[2]) * torch.sqrt(1 - (sines * sines).sum(0)))[None]])
            apart = rays.position - below / way[2] * way - at
            back, bent = (below / (self.eta * length * way[2])).abs(), (out[2] / length / way[2]) ** 2
            radial = torch.cat([sines, torch.zeros_like(sines[:1])])
            within = radial * ((radial * apart).sum(0) / (radial * radial).sum(0).clamp_min(TINY))
            at = at + (apart - within) / (1 + back) + within / (1 + back * bent)
        return way


def image(behind: Sequence[Interface], plane: Receiver) -> Receiver:
    """Return where light before these interfaces, whose surfaces are flat, sees a receiver; itself: of none.

    Light leaves the lens along +z, and a receiver behind elements is a plane.
    """
    if not behind:
        return plane
    if sum(not interface.law.reverses for interface in behind) % 2:  # the first leads out of the glass
        face, *beyond = behind
        return BehindGlass(image(beyond, plane), float(sag(face.surface, 0.0, 0.0)), face.law.eta)
    seen = Image.of(plane)
    leaves: Tilted | None = None  # the face through which light, followed backwards, has come into a plate
    for interface in reversed(behind):
        face = Tilted.of(interface.surface)
        if interface.law.reverses:
            seen = seen.in_mirror(face)
        elif leaves is None:
            leaves = face
        else:
            thick, n = leaves.height_above(face.vertex), interface.law.n_out / interface.law.n_in
            seen = seen.nearer(tuple(thick * (1 - 1 / n) * part for part in face.unit))
            leaves = None
    return seen.plain()


def seen_from_last_net(lens: Lens, plane: Receiver) -> Receiver:
    """Return a receiver where light behind the last net of a lens sees it; itself where it meets nothing else."""
    return image(lens.interfaces[lens.freeform[-1] + 1 :], plane)


def imaged(lens: Lens, screen: Screen) -> Screen:
    """Return a screen on such a receiver."""
    plane = screen.plane
    seen = seen_from_last_net(lens, plane)
    return screen if seen is plane else replace(screen, surface=seen)


def seen_by(lens: Lens, screen: Screen) -> Receiver:
    """Return the receiver of a screen where a lens sees it."""
    return image(lens.behind, screen.plane)


def per_radian(lens: Lens, screen: Screen) -> float:
    """Return how far, in a screen's unit, light moves on it as it leaves the back of a lens turned by a radian."""
    return seen_by(lens, screen).per_radian(lens.back.z)


def _reflected(v: Vector, n: Vector) -> Vector:
    along = 2 * dot(v, n)
    return tuple(part - along * unit for part, unit in zip(v, n, strict=True))
