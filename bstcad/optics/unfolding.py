"""Receivers where a lens sees them: past the windows and in the flat mirrors behind it.

Stage 1 aims from the last tailored face straight at the receiver.  Behind flat mirrors it aims at the receiver's mirror
image, which is exact.  A plate of thickness t and index n brings the image nearer by t (1 - 1 / n), to first order in
the angle; stage 2, which traces all interfaces, does the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from bstcad.optics.interfaces import Interface
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.rays import Vector
from bstcad.optics.receivers import LevelPlane, Plane, Receiver, dot
from bstcad.optics.tilted import Tilted

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


def image(behind: Sequence[Interface], plane: Receiver) -> Receiver:
    """Return where a lens sees a plane by way of these interfaces, whose surfaces are flat; the plane itself: of none.

    Light leaves the lens along +z.
    """
    if not behind:
        return plane
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


def imaged(behind: Sequence[Interface], screen: Screen) -> Screen:
    """Return a screen on the image of its plane; the screen itself where nothing is behind the lens."""
    return replace(screen, surface=image(behind, screen.plane)) if behind else screen


def seen_by(lens: Lens, screen: Screen) -> Receiver:
    """Return the receiver of a screen where a lens sees it."""
    return image(lens.behind, screen.plane)


def per_radian(lens: Lens, screen: Screen) -> float:
    """Return how far, in a screen's unit, light moves on it as it leaves the back of a lens turned by a radian."""
    return seen_by(lens, screen).per_radian(lens.back.z)


def _reflected(v: Vector, n: Vector) -> Vector:
    along = 2 * dot(v, n)
    return tuple(part - along * unit for part, unit in zip(v, n, strict=True))
