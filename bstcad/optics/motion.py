"""Rigid motions of the sources and screens around a lens.

A lens is traced in its own frame.  Moving the lens by T has the same effect as moving source and screen by the inverse
of T, so a motion has to act on sources and screens only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bstcad.optics.rays import Vector


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
