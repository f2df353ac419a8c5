"""Placement of a lens in its file: a rotation and a shift, r -> R r + t.

A CAD program that moves a part writes either a placement or moved coordinates.  A placement is read from the
statements of the file (assembly.py).  Moved coordinates are recognised here from the net of the freeform face, whose
control points lie on a uniform grid in x and y of the lens's own frame.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

MAX_GRID_DEVIATION = 1e-9  # largest deviation (mm) of an unmoved net from a uniform grid centred on the axis
FLAT_RMS = 1e-7  # RMS deviation (mm) from a plane, below which a net's z axis is the plane's normal
PARALLEL_SINE = 1e-9  # sine of the angle below which two directions are parallel
DECIMALS = 9  # decimals of a stated shift (mm) and rotation (degrees); further ones are rounding errors


@dataclass(frozen=True, eq=False)
class Placement:
    """Rigid motion r -> R r + t from the frame of the lens to the frame of the file."""

    rotation: np.ndarray  # R, (3, 3), orthonormal and right-handed
    shift: np.ndarray  # t, (3,), mm

    @classmethod
    def of_axes(cls, origin: np.ndarray, axis: np.ndarray, reference: np.ndarray) -> Placement:
        """Return the placement at `origin`, with z along `axis` and x along the component of `reference` normal to z.

        Raises ValueError if the two directions are parallel or zero.
        """
        z = _unit(axis)
        x = _unit(reference)
        x = x - (x @ z) * z
        if not np.sqrt(x @ x) > PARALLEL_SINE:
            raise ValueError("the axis and the reference direction of a placement are parallel")
        x = _unit(x)
        return cls(np.stack([x, np.cross(z, x), z], axis=1), np.asarray(origin, dtype=np.float64))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Transform points (…, 3) from the lens's frame to the file's; without a rotation, R r is r to the last bit."""
        turned = points if np.array_equal(self.rotation, np.eye(3)) else points @ self.rotation.T
        return turned + self.shift

    @property
    def inverse(self) -> Placement:
        """The inverse placement."""
        return Placement(self.rotation.T, -(self.rotation.T @ self.shift))

    def after(self, first: Placement) -> Placement:
        """Return the placement that applies `first`, then this placement."""
        return Placement(self.rotation @ first.rotation, self(first.shift))

    @property
    def moves(self) -> bool:
        """True if this is not the identity."""
        return bool(self.shift.any()) or not np.array_equal(self.rotation, np.eye(3))

    @property
    def turn(self) -> tuple[float, np.ndarray]:
        """Angle of rotation (degrees, 0 to 180) and unit vector (3,) of its axis."""
        about = Rotation.from_matrix(self.rotation).as_rotvec()
        angle = math.sqrt(about @ about)
        return math.degrees(angle), about / angle if angle > 0 else np.array([0.0, 0.0, 1.0])

    @property
    def words(self) -> str:
        """Rotation and shift in words, such as "rotated by 90° about z, then shifted by (0, 0, 5) mm"."""
        shift = np.round(self.shift, DECIMALS) + 0.0
        parts = [self.turn_words] if round(self.turn[0], DECIMALS) else []
        if shift.any() or not parts:
            parts.append("shifted by ({}) mm".format(", ".join(f"{value:.9g}" for value in shift)))
        return ", then ".join(parts)

    @property
    def turn_words(self) -> str:
        """Rotation in words, such as "rotated by 90° about z"."""
        angle, about = self.turn
        return f"rotated by {angle:.9g}° about {_axis_name(about)}"

    def facts(self) -> dict[str, Any]:
        """Return entries for JSON: the placement in words, angle (degrees) and axis of its rotation, and shift (mm)."""
        angle, about = self.turn
        shift, turn = self.shift.tolist(), round(angle, DECIMALS)
        return {"words": self.words, "turn_deg": turn, "axis": about.tolist(), "shift_mm": shift}


def identity() -> Placement:
    """Return the placement of a lens whose frame is the frame of the file."""
    return Placement(np.eye(3), np.zeros(3))


def compose(placements: Sequence[Placement]) -> Placement:
    """Return the placement that applies all of these, the last one first."""
    return functools.reduce(Placement.after, placements, identity())


def own_frame(net: np.ndarray) -> Placement:
    """Return the placement of the frame of a net (m, n, 3): x along its first array axis, y along its second.

    z is the direction in which the net deviates from a uniform plane grid.  The origin is the file's origin projected
    onto the axis of the net, so that heights along the axis do not change.  The identity is returned for a net that
    is already centred on the z axis, or whose points do not lie on such a grid.
    """
    if _grid_deviation(net) <= MAX_GRID_DEVIATION:
        return identity()
    m, n, _ = net.shape
    u, v = np.linspace(-1.0, 1.0, m), np.linspace(-1.0, 1.0, n)
    centre = net.mean(axis=(0, 1))
    along_u = (net.mean(axis=1) * u[:, None]).sum(axis=0) / (u * u).sum()  # least squares: net = centre + u A + v B + …
    along_v = (net.mean(axis=0) * v[:, None]).sum(axis=0) / (v * v).sum()
    rest = (net - centre - u[:, None, None] * along_u - v[:, None] * along_v).reshape(-1, 3)
    normal = np.cross(along_u, along_v)
    spread, directions = np.linalg.eigh(rest.T @ rest / len(rest))
    z = directions[:, -1] if spread[-1] > FLAT_RMS**2 else normal
    try:
        found = Placement.of_axes(np.zeros(3), z if z @ normal > 0 else -z, along_u)
    except ValueError:
        return identity()
    axis = found.rotation[:, 2]
    found = Placement(found.rotation, centre - (centre @ axis) * axis)
    return found if _grid_deviation(found.inverse(net)) <= MAX_GRID_DEVIATION else identity()


def _grid_deviation(net: np.ndarray) -> float:
    """Return the largest deviation (mm) in x or y of a net from a uniform grid of equal size, centred on the z axis."""
    m, n, _ = net.shape
    half = (net[-1, -1, :2] - net[0, 0, :2]) / 2
    if not half.min() > 0:
        return math.inf
    off_x = np.abs(net[..., 0] - half[0] * np.linspace(-1.0, 1.0, m)[:, None]).max()
    off_y = np.abs(net[..., 1] - half[1] * np.linspace(-1.0, 1.0, n)).max()
    return float(max(off_x, off_y))


def _unit(vector: np.ndarray) -> np.ndarray:
    length = math.sqrt(vector @ vector)
    if not 0 < length < math.inf:
        raise ValueError("a direction of a placement has no length")
    return vector / length


def _axis_name(about: np.ndarray) -> str:
    """Return the name of an axis (unit vector), such as z or -x, or else its three components."""
    k = int(np.abs(about).argmax())
    if abs(abs(about[k]) - 1) < PARALLEL_SINE:
        return ("" if about[k] > 0 else "-") + "xyz"[k]
    return "({})".format(", ".join(f"{value:.6g}" for value in np.round(about, 6) + 0.0))
