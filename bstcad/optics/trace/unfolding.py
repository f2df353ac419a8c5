"""Images of receivers as a tailored face sees them: through a flat face of the lens, windows and flat mirrors.

Stage 1 aims straight from the last tailored face to the image of the receiver.  The image in flat mirrors is exact.
A plate of thickness t and index n moves the image nearer by t (1 - 1 / n), to first order in the angle; stage 2, which
traces all interfaces, corrects the rest.  Light that is still inside the glass leaves it through a flat face, and its
direction to each point of the receiver follows from Snell's law (`BehindGlass`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bstcad.optics.lens.interfaces import Interface, Reflect
from bstcad.optics.lens.lens import Lens
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane, PlaneReceiver, Receiver
from bstcad.optics.surfaces.rays import Frame, Rays, Vector, dot, point_along
from bstcad.optics.surfaces.surfaces import sag
from bstcad.optics.surfaces.tilted import TiltedSurface

NEWTON_ITERATIONS = 8  # Newton steps for the point of a flat face through which light reaches a point of the receiver
TINY = 1e-300  # smallest divisor, so that none is zero


@dataclass(frozen=True)
class Image(PlaneReceiver):
    """Image of a plane, on which points keep their coordinates."""

    centre: Vector  # centre C of the image, mm
    at: tuple[float, float]  # coordinates o of C on the plane
    vectors: Frame  # (e_x, e_y, normal directed away from the incident light)

    @classmethod
    def of(cls, receiver: Receiver) -> Image:
        """Return a plane as the image of itself."""
        assert receiver.frame is not None  # a scene with elements behind the lens has planes only
        return cls(receiver.middle, receiver.origin, receiver.frame)

    @property
    def frame(self) -> Frame:
        """Axes (e_x, e_y, n); the kernels use `axes`, which an image lacks."""
        return self.vectors

    @property
    def origin(self) -> tuple[float, float]:
        """Coordinates o of the centre."""
        return self.at

    @property
    def middle(self) -> Vector:
        """Centre C (mm)."""
        return self.centre

    def in_mirror(self, mirror: TiltedSurface) -> Image:
        """Return the image of this image in a flat mirror."""
        n = mirror.unit_normal
        e_x, e_y, (n_x, n_y, n_z) = (point_along(v, -2 * dot(v, n), n) for v in self.frame)
        centre = point_along(self.centre, -2 * mirror.height_above(self.centre), n)
        return replace(self, centre=centre, vectors=(e_x, e_y, (-n_x, -n_y, -n_z)))

    def plain(self) -> Receiver:
        """Return a level plane with the axes of space as LevelPlane, other images unchanged."""
        (c_x, c_y, z), (o_x, o_y) = self.centre, self.origin
        return LevelPlane(z) if self.frame == LevelPlane.axes and (c_x, c_y) == (o_x, o_y) else self


@dataclass(frozen=True)
class BehindGlass(Receiver):
    """A receiver for light that is still in the glass and leaves it through a flat face, z = const."""

    rest: Receiver  # receiver behind the face
    z: float  # plane of the face, mm
    eta: float  # index of the glass relative to the index behind the face

    @property
    def middle(self) -> Vector:
        """Point at the centre of the receiver (mm)."""
        return self.rest.middle

    def path(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Return (path along each ray behind the face to the receiver (mm), zero for rays that miss it; status)."""
        return self.rest.path(rays)

    def coordinates(self, rays: Rays) -> Sequence[Tensor]:
        """Return x and y of rays that are on the receiver."""
        return self.rest.coordinates(rays)

    def point(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the points in space (mm) at the coordinates x, y of the receiver."""
        return self.rest.point(x, y)

    def normal(self, aim: Tensor) -> Sequence[Tensor | float]:
        """Return the unit normals of the receiver at the coordinates `aim` (2, …)."""
        return self.rest.normal(aim)

    def vector_to(self, rays: Rays, aim: Tensor) -> Tensor:
        """Return the unit vectors (3, …) along which rays in the glass reach the coordinates `aim` (2, …).

        From a point of the face the light goes along the unit vector s over the distance d to the receiver.  By Snell's
        law it comes along i, (i_x, i_y) = (s_x, s_y) / η, through glass of thickness t; the ray along i meets the face
        at a second point.  Newton's method makes the two points equal: as the first moves by 1, the second moves back
        by k = t / (η d i_z) perpendicular to the plane of incidence, and by k (s_z / i_z)² in it.
        """
        below, direction = rays.above(self.z), self.rest.vector_to(rays, aim)
        point = rays.position - below / direction[2] * direction
        for _ in range(NEWTON_ITERATIONS):
            behind = self.rest.vector_to(replace(rays, position=point), aim)
            length = torch.sqrt((behind * behind).sum(0))
            sines = behind[:2] / length / self.eta
            direction = torch.cat([sines, (torch.sign(behind[2]) * torch.sqrt(1 - (sines * sines).sum(0)))[None]])
            residual = rays.position - below / direction[2] * direction - point
            back, stretch = (below / (self.eta * length * direction[2])).abs(), (behind[2] / length / direction[2]) ** 2
            radial = torch.cat([sines, torch.zeros_like(sines[:1])])
            radial_part = radial * ((radial * residual).sum(0) / (radial * radial).sum(0).clamp_min(TINY))
            point = point + (residual - radial_part) / (1 + back) + radial_part / (1 + back * stretch)
        return direction


def image(behind: Sequence[Interface], receiver: Receiver) -> Receiver:
    """Return the image of a receiver by interfaces with flat surfaces; the receiver itself if there are none.

    Light leaves the lens along +z, and a receiver behind elements is a plane.
    """
    if not behind:
        return receiver
    if sum(not interface.law.reverses for interface in behind) % 2:  # the first interface is the exit from the glass
        first, *rest = behind
        return BehindGlass(image(rest, receiver), float(sag(first.surface, 0.0, 0.0)), first.law.eta)
    view = Image.of(receiver)
    leaves: TiltedSurface | None = None  # exit face of a plate, while the light is followed backwards
    for interface in reversed(behind):
        face, law = TiltedSurface.of(interface.surface), interface.law
        if isinstance(law, Reflect):
            view = view.in_mirror(face)
        elif leaves is None:
            leaves = face
        else:
            thick, n = leaves.height_above(face.vertex), law.n_out / law.n_in
            view = replace(view, centre=point_along(view.centre, thick * (1 - 1 / n), face.unit_normal))
            leaves = None
    return view.plain()


def image_from_last_net(lens: Lens, receiver: Receiver) -> Receiver:
    """Return the image of a receiver by the interfaces behind the last net; the receiver itself if there are none."""
    return image(lens.interfaces[lens.tailored_numbers[-1] + 1 :], receiver)


def image_screen(lens: Lens, screen: Screen) -> Screen:
    """Return the screen on the image of its receiver by the interfaces behind the last net of a lens."""
    receiver = screen.receiver
    view = image_from_last_net(lens, receiver)
    return screen if view is receiver else replace(screen, surface=view)


def image_from_lens(lens: Lens, screen: Screen) -> Receiver:
    """Return the image of a screen's receiver by the elements behind the lens; the receiver if there are none."""
    return image(lens.behind, screen.receiver)


def per_radian(lens: Lens, screen: Screen) -> float:
    """Return the shift of light on a screen, in the screen's unit, per radian of deflection at the back of a lens."""
    return image_from_lens(lens, screen).per_radian(lens.back.z)
