"""The placement of a lens in its file: a turn and a shift, r -> R r + t.

A CAD program that moves a part either writes where it placed it, or writes moved coordinates.  The first is read from
the statements of the file (assembly.py), the second is found here from the net of the freeform face, whose control
points lie on a uniform grid over the lens's own x and y.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

ON_AXIS = 1e-9  # mm; a net that lies on its uniform grid and about the axis more closely than this is not moved
FLAT = 1e-7  # mm, RMS; a net that departs by less from a plane has the normal of that plane
PARALLEL = 1e-9  # sine of the angle between two directions that span no plane
ROUNDED = 9  # decimals of a shift in mm and of a turn in degrees that are stated: less is rounding of the coordinates


@dataclass(frozen=True, eq=False)
class Placement:
    """r -> R r + t, from the lens's own frame to the frame of the file."""

    rotation: np.ndarray  # R (3, 3), orthonormal and right-handed
    shift: np.ndarray  # t (3,) in mm

    @classmethod
    def of_axes(cls, origin: np.ndarray, axis: np.ndarray, reference: np.ndarray) -> Placement:
        """The frame at an origin with z along `axis` and x along `reference` without its part along z.

        ValueError if the two directions are parallel or none.
        """
        z = _unit(axis)
        x = _unit(reference)
        x = x - (x @ z) * z
        if not np.sqrt(x @ x) > PARALLEL:
            raise ValueError("the axis and the reference direction of a placement are parallel")
        x = _unit(x)
        return cls(np.stack([x, np.cross(z, x), z], axis=1), np.asarray(origin, dtype=np.float64))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (…, 3) in the frame of the file, by their places in the lens's own; unmoved ones to the last bit."""
        turned = points if np.array_equal(self.rotation, np.eye(3)) else points @ self.rotation.T
        return turned + self.shift

    @property
    def inverse(self) -> Placement:
        """The placement that takes this one back."""
        return Placement(self.rotation.T, -(self.rotation.T @ self.shift))

    def after(self, first: Placement) -> Placement:
        """The placement `first`, and then this one."""
        return Placement(self.rotation @ first.rotation, self(first.shift))

    @property
    def moves(self) -> bool:
        """Is it any other than that of the file itself?"""
        return bool(self.shift.any()) or not np.array_equal(self.rotation, np.eye(3))

    @property
    def turn(self) -> tuple[float, np.ndarray]:
        """(angle in degrees, 0 to 180; the unit vector (3,) about which it turns)."""
        about = Rotation.from_matrix(self.rotation).as_rotvec()
        angle = math.sqrt(about @ about)
        return math.degrees(angle), about / angle if angle > 0 else np.array([0.0, 0.0, 1.0])

    @property
    def words(self) -> str:
        """The turn in degrees and the shift in mm, such as "turned by 90° about z, then shifted by (0, 0, 5) mm"."""
        shift = np.round(self.shift, ROUNDED) + 0.0
        parts = [self.turn_words] if round(self.turn[0], ROUNDED) else []
        if shift.any() or not parts:
            parts.append("shifted by ({}) mm".format(", ".join(f"{value:.9g}" for value in shift)))
        return ", then ".join(parts)

    @property
    def turn_words(self) -> str:
        """The turn alone, such as "turned by 90° about z"."""
        angle, about = self.turn
        return f"turned by {angle:.9g}° about {_axis(about)}"

    def facts(self) -> dict[str, Any]:
        """The placement in words, its turn (degrees), the axis of that and the shift (mm), for JSON."""
        angle, about = self.turn
        shift, turn = self.shift.tolist(), round(angle, ROUNDED)
        return {"words": self.words, "turn_deg": turn, "axis": about.tolist(), "shift_mm": shift}


def unmoved() -> Placement:
    """The placement of a lens whose own frame is that of the file."""
    return Placement(np.eye(3), np.zeros(3))


def composed(placements: Sequence[Placement]) -> Placement:
    """All of these, the last one first."""
    return functools.reduce(Placement.after, placements, unmoved())


def own_frame(net: np.ndarray) -> Placement:
    """The placement of a net (m, n, 3) of control points by its own grid: x along its first axis, y along the second.

    z is the direction in which the net departs from a uniform grid in a plane.  The origin is the foot of the given one
    on the axis of the net, so that heights along the axis stay.  A net that lies about the z axis already, or whose
    points lie on no such grid, is unmoved.
    """
    if _off(net) <= ON_AXIS:
        return unmoved()
    m, n, _ = net.shape
    u, v = np.linspace(-1.0, 1.0, m), np.linspace(-1.0, 1.0, n)
    centre = net.mean(axis=(0, 1))
    along_u = (net.mean(axis=1) * u[:, None]).sum(axis=0) / (u * u).sum()  # least squares: net = centre + u A + v B + …
    along_v = (net.mean(axis=0) * v[:, None]).sum(axis=0) / (v * v).sum()
    rest = (net - centre - u[:, None, None] * along_u - v[:, None] * along_v).reshape(-1, 3)
    normal = np.cross(along_u, along_v)
    spread, directions = np.linalg.eigh(rest.T @ rest / len(rest))
    z = directions[:, -1] if spread[-1] > FLAT**2 else normal
    try:
        found = Placement.of_axes(np.zeros(3), z if z @ normal > 0 else -z, along_u)
    except ValueError:
        return unmoved()
    axis = found.rotation[:, 2]
    found = Placement(found.rotation, centre - (centre @ axis) * axis)
    return found if _off(found.inverse(net)) <= ON_AXIS else unmoved()


def _off(net: np.ndarray) -> float:
    """The largest distance (mm) in x or y of a net from the uniform grid about the z axis with its extent."""
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


def _axis(about: np.ndarray) -> str:
    """The name of an axis, or its three components."""
    k = int(np.abs(about).argmax())
    if abs(abs(about[k]) - 1) < PARALLEL:
        return ("" if about[k] > 0 else "-") + "xyz"[k]
    return "({})".format(", ".join(f"{value:.6g}" for value in np.round(about, 6) + 0.0))
