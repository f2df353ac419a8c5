"""Rigid motions of the sources and screens around a lens.

A lens is traced in its own frame.  A motion T of the lens has the same effect as the inverse of T on source and screen.
Therefore motions are applied to sources and screens only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bstcad.optics.surfaces.rays import Vector

ORIGIN: Vector = (0.0, 0.0, 0.0)  # origin, mm


def along_axis(axis: int, amount: float) -> Vector:
    """Return the vector with the component `amount` along an axis (0 to 2), else zeros."""
    return (amount, 0.0, 0.0) if axis == 0 else (0.0, amount, 0.0) if axis == 1 else (0.0, 0.0, amount)


@dataclass(frozen=True, eq=False)
class Motion:
    """Rigid motion of points x -> p + R (x - p) + t: a rotation R about p, then a shift t."""

    rotation: np.ndarray  # rotation matrix R, (3, 3)
    about: Vector = ORIGIN  # fixed point p of the rotation, mm
    shift: Vector = ORIGIN  # translation t, mm

    @classmethod
    def of(cls, shift: Vector = ORIGIN, turn: Vector = ORIGIN, about: Vector = ORIGIN) -> Motion:
        """Return a rotation by `turn` (degrees) about x, then y, then z through `about` (mm), then a shift (mm)."""
        return cls(Rotation.from_euler("xyz", turn, degrees=True).as_matrix(), about, shift)

    @property
    def inverse(self) -> Motion:
        """Inverse motion."""
        back = self.rotation.T
        return Motion(back, self.about, tuple((-back @ np.array(self.shift)).tolist()))

    def after(self, first: Motion | None) -> Motion:
        """Return the motion that applies `first` and then this motion; this motion alone if `first` is None."""
        if first is None:
            return self
        return Motion(self.rotation @ first.rotation, shift=self.point(first.point(ORIGIN)))

    @property
    def rotates(self) -> bool:
        """True if the motion contains a rotation."""
        return not np.array_equal(self.rotation, np.eye(3))

    def point(self, place: Vector) -> Vector:
        """Return a point (mm) after the motion."""
        about = np.array(self.about)
        return tuple((about + self.rotation @ (np.array(place) - about) + np.array(self.shift)).tolist())

    def direction(self, vector: Vector) -> Vector:
        """Return a direction vector after the motion, which only rotates it."""
        return tuple((self.rotation @ np.array(vector)).tolist())
