"""Rigid motions of the sources and screens around a lens.

A lens is traced in its own frame.  Moving the lens by T has the same effect as moving source and screen by the inverse
of T, so a motion has to act on sources and screens only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from bstcad.optics.rays import Vector, tilt_of
from bstcad.optics.sources import Collimated, Point, Source

FAR = 4.0  # widths of its aperture by which a beam without a plane z of its own gets that plane before the lens


@dataclass(frozen=True, eq=False)
class Motion:
    """x -> p + R (x - p) + t."""

    rotation: np.ndarray  # R (3, 3)
    about: Vector = (0.0, 0.0, 0.0)  # p (mm)
    shift: Vector = (0.0, 0.0, 0.0)  # t (mm)

    @classmethod
    def of(
        cls, shift: Vector = (0.0, 0.0, 0.0), turn: Vector = (0.0, 0.0, 0.0), about: Vector = (0.0, 0.0, 0.0)
    ) -> Motion:
        """A shift (mm) and turns (degrees, right-handed) about the axes of space: x, then y, then z."""
        return cls(Rotation.from_euler("xyz", turn, degrees=True).as_matrix(), about, shift)

    @property
    def inverse(self) -> Motion:
        """The motion that takes it back."""
        back = self.rotation.T
        return Motion(back, self.about, tuple((-back @ np.array(self.shift)).tolist()))

    def after(self, first: Motion | None) -> Motion:
        """The motion `first`, None for none, and then this one."""
        if first is None:
            return self
        return Motion(self.rotation @ first.rotation, shift=self.point(first.point((0.0, 0.0, 0.0))))

    @property
    def turns(self) -> bool:
        """Is it more than a shift?"""
        return not np.array_equal(self.rotation, np.eye(3))

    def point(self, place: Vector) -> Vector:
        """A point (mm) after the motion."""
        about = np.array(self.about)
        return tuple((about + self.rotation @ (np.array(place) - about) + np.array(self.shift)).tolist())

    def frame(self, vectors: tuple[Vector, ...]) -> tuple[Vector, ...]:
        """Vectors after the motion."""
        return tuple(tuple((self.rotation @ np.array(v)).tolist()) for v in vectors)


def turns_alike(source: Source) -> bool:
    """Does its light stay the same when it is turned about its axis?  Else `moved_source` cannot turn it so."""
    if isinstance(source, Collimated):
        return source.aperture.is_round and (source.extent is None or source.extent.is_round)
    return source.extent is None or source.extent.is_round


def moved_source(source: Source, motion: Motion, entrance: float) -> Source:
    """A simple source (`element`) after a motion; entrance: z of the plane through the first vertex (mm).

    The aperture of parallel light is one of a plane z = const, and stays in one when the light is turned: it is wider
    by 1 / cos than it should be, 1.5e-6 of its size at 0.1 degrees.
    """
    if isinstance(source, Point):
        tilt = source.tilt if not motion.turns else tilt_of(motion.frame((source.axes[2],))[0])
        return replace(source, position=motion.point(source.position), tilt=tilt)
    if not (motion.turns or source.tilted):  # the same on all planes
        x, y = (p + d for p, d in zip(source.centre or (0.0, 0.0), motion.shift, strict=False))
        return source if (x, y) == (0.0, 0.0) and source.centre is None else replace(source, centre=(x, y))
    wide = 2 * math.hypot(*source.aperture.half_extent)
    z, known = (entrance - FAR * wide, entrance) if source.z is None else (source.z, source.z)
    (normal,) = motion.frame((source.axes[2],))
    x, y, reached = motion.point((*source.shift(known), known))
    way = z - reached
    centre = x + way * normal[0] / normal[2], y + way * normal[1] / normal[2]
    return replace(source, z=z, centre=centre, tilt=tilt_of(normal))
