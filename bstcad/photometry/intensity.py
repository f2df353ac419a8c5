"""Tables of luminous intensity over directions, as photometric files state them.

A direction is a unit vector (x, y, z) in a right-handed frame whose z axis is the axis of the light.  The coordinates:

- C: angle γ from the axis and angle C about it, from x counterclockwise for an observer behind the lamp who looks along
  the light, that is from x towards -y: x = sin γ cos C, y = -sin γ sin C, z = cos γ (CIE 121, IES LM-75 type C).
- B: horizontal angle H and vertical angle V with a horizontal polar axis: -x = sin H, y = cos H sin V, z = cos H cos V.
- A: H about the vertical axis and elevation V: -x = cos V sin H, y = sin V, z = cos V cos H.

H is positive to the right for the same observer, with y upwards.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

MAX_ANGLES = 100_000  # largest number of angles along each coordinate of a file
MAX_INTENSITIES = 4_000_000  # largest number of intensities of a file
MAX_NUMBERS = MAX_INTENSITIES + 2 * MAX_ANGLES  # largest number of angles and intensities that are read from a file
MAX_CANDELA = 1e15  # largest intensity (cd), far above lamps; sums of intensities and of their squares are finite
SYMMETRIC = 1e-3  # largest difference of intensities of a symmetric table, as a fraction of the largest intensity
MAX_GAP = 1.5  # largest gap between the last plane and the first / largest step of the planes
TURN, SAME_ANGLE = 360.0, 1e-6  # degrees: full turn; difference of angles that are equal


class PhotometricError(ValueError):
    """A photometric file that cannot be used; the message is a clause on the file, with a remedy."""


@dataclass(frozen=True, eq=False)
class Intensity:
    """Luminous intensity (cd) at pairs of angles, in between bilinear; zero outside the angles of the file."""

    kind: str  # coordinates: "C", "B" or "A"
    around: np.ndarray  # (k,) C, ascending over the full turn, or the single 0 of a table that C does not change; or H
    along: np.ndarray  # (n,) γ, ascending from 0 to at most 180, or V, degrees
    candela: np.ndarray  # (k, n) intensities, cd
    rated_lumens: float | None = None  # luminous flux of the lamps by the file, lm; None: absolute photometry
    remarks: tuple[str, ...] = ()  # sentences on readings that the file does not state plainly

    def at(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the intensities (cd) in the directions of unit vectors (x, y, z)."""
        if self.kind == "C":
            around = np.degrees(np.arctan2(-y, x)) % TURN
            along = np.degrees(np.arctan2(np.hypot(x, y), z))
        elif self.kind == "B":
            around, along = np.degrees(np.arcsin(np.clip(-x, -1, 1))), np.degrees(np.arctan2(y, z))
        else:
            around, along = np.degrees(np.arctan2(-x, z)), np.degrees(np.arcsin(np.clip(y, -1, 1)))
        return self.between(around, along)

    def between(self, around: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Return the intensities (cd) at angles (degrees) by bilinear interpolation; C is periodic."""
        planes, table = self.around, self.candela
        if self.kind == "C":
            planes, table = np.append(planes, planes[0] + TURN), np.vstack([table, table[:1]])
            around = planes[0] + (around - planes[0]) % TURN
        inside = (along >= self.along[0] - SAME_ANGLE) & (along <= self.along[-1] + SAME_ANGLE)
        inside = inside & (around >= planes[0] - SAME_ANGLE) & (around <= planes[-1] + SAME_ANGLE)
        (i, a), (j, b) = cell_of(planes, around), cell_of(self.along, along)
        low = (1 - b) * table[i, j] + b * table[i, j + 1]
        high = (1 - b) * table[i + 1, j] + b * table[i + 1, j + 1]
        return np.where(inside, (1 - a) * low + a * high, 0.0)

    @property
    def lumens(self) -> float:
        """Luminous flux (lm): the integral of the intensity over all solid angles, exact for the interpolation in C, γ.

        C: ∫∫ I sin γ dγ dC; B: ∫∫ I cos H dH dV; A: ∫∫ I cos V dH dV.
        """
        if self.kind == "B":
            return float(_over_line(self.along) @ (_over_cosine(self.around) @ self.candela))
        if self.kind == "A":
            return float(_over_line(self.around) @ self.candela @ _over_cosine(self.along))
        planes = np.append(self.around, self.around[0] + TURN)
        of_plane = _over_line(planes)
        of_plane[0] += of_plane[-1]
        return float(of_plane[:-1] @ self.candela @ _over_cosine(self.along - 90.0))

    @property
    def half_angle(self) -> float:
        """Largest angle from the axis (degrees) with light."""
        if self.kind == "C":
            lit = np.flatnonzero(self.candela.max(0) > 0)
            return float(self.along[min(lit[-1] + 1, len(self.along) - 1)])
        return 90.0

    @property
    def spacing(self) -> float:
        """Smallest spacing (degrees) of the angles along γ or V."""
        return float(np.diff(self.along).min())


@dataclass(frozen=True)
class Luminaire:
    """Facts that a photometric file states besides intensities."""

    name: str = "lens"
    maker: str = "not stated"
    laboratory: str = "bstcad, by simulation"
    date: str = ""  # ISO 8601
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)  # luminous opening along C0, along C90, and its height, mm
    is_round: bool = False  # True for a round opening, whose diameter is size[0]
    lamp: str = "LED"
    watts: float = 0.0  # 0: not known


SYMMETRIES = (
    "rotational",
    "quadrant",
    "C0-C180",
    "C90-C270",
    "none",
)  # symmetries of a table over C, most symmetric first


def symmetry(table: Intensity, tolerance: float = SYMMETRIC) -> str:
    """Return the symmetry of a table over C: differences are at most the tolerance times its largest intensity."""
    planes, most = table.around, tolerance * table.candela.max()
    if len(planes) == 1 or np.ptp(table.candela, axis=0).max() <= most:
        return "rotational"

    def mirrors(about: float) -> bool:
        other = table.between((2 * about - planes)[:, None] % TURN, table.along[None])
        return bool(np.abs(other - table.candela).max() <= most)

    across, along = mirrors(0.0), mirrors(90.0)
    return "quadrant" if across and along else "C0-C180" if across else "C90-C270" if along else "none"


def checked(
    kind: str, around: np.ndarray, along: np.ndarray, candela: np.ndarray, rated: float | None = None
) -> Intensity:
    """Return a table after checks that apply to every format; PhotometricError: a clause on the fault."""
    if kind == "C" and len(around) > 1 and around[-1] - around[0] > TURN - SAME_ANGLE:
        around, candela = around[:-1], candela[:-1]  # the last plane repeats the first
    for fault in _faults(kind, around, along, candela):
        raise PhotometricError(fault)
    if rated is not None and not math.isfinite(rated):
        raise PhotometricError("has a flux of the lamps that is not finite; correct it")
    table = Intensity(kind, around, along, candela, rated_lumens=rated)
    if not table.lumens > 0:
        raise PhotometricError("has no light; give a file with intensities above 0")
    return table


def _faults(kind: str, around: np.ndarray, along: np.ndarray, candela: np.ndarray) -> Iterator[str]:
    if not (np.isfinite(around).all() and np.isfinite(along).all() and np.isfinite(candela).all()):
        yield "has a number that is not finite; correct it"
    if len(along) < 2 or (kind != "C" and len(around) < 2):
        yield "has fewer than two angles; give a table over angles"
    if (np.diff(along) <= 0).any() or (np.diff(around) <= 0).any():
        yield "has angles that do not ascend; sort them"
    low, high = (0.0, 180.0) if kind == "C" else (-90.0, 90.0)
    if along[0] < low - SAME_ANGLE or along[-1] > high + SAME_ANGLE:
        yield f"has vertical angles beyond {low:g} to {high:g} degrees; correct them"
    if around[-1] - around[0] > (TURN if kind == "C" else 2 * TURN / 4) + SAME_ANGLE:
        yield "has horizontal angles over more than a turn; correct them"
    steps = np.diff(around)
    if kind == "C" and len(around) > 1 and TURN - (around[-1] - around[0]) > MAX_GAP * steps.max():
        yield f"has horizontal angles from {around[0]:g} to {around[-1]:g}, which neither close nor span a symmetry"
    if (candela < 0).any():
        yield "has a negative intensity; correct it"
    if candela.max() > MAX_CANDELA:
        yield f"has an intensity of {candela.max():.3g} cd, and {MAX_CANDELA:g} cd is the maximum; correct its factors"


def mirrored(planes: np.ndarray, table: np.ndarray, about: float) -> tuple[np.ndarray, np.ndarray]:
    """Return planes and intensities with those mirrored about a plane (degrees), ascending, each plane once."""
    angles = np.concatenate([planes, 2 * about - planes]) % TURN
    whole = np.vstack([table, table])
    order = np.argsort(angles, kind="stable")
    angles, whole = angles[order], whole[order]
    new = np.append(True, np.diff(angles) > SAME_ANGLE)
    new[-1] &= len(angles) < 2 or angles[-1] < TURN - SAME_ANGLE
    return angles[new], whole[new]


def cell_of(angles: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of the interval of each angle, and the place in it from 0 to 1."""
    k = np.clip(np.searchsorted(angles, at, side="right") - 1, 0, len(angles) - 2)
    return k, np.clip((at - angles[k]) / (angles[k + 1] - angles[k]), 0.0, 1.0)


def _over_line(angles: np.ndarray) -> np.ndarray:
    """Return weights w with Σ w f = ∫ f dt of a piecewise linear f; angles in degrees, integral in radians."""
    half = np.radians(np.diff(angles)) / 2
    return np.append(half, 0.0) + np.append(0.0, half)


def _over_cosine(angles: np.ndarray) -> np.ndarray:
    """Return weights w with Σ w f = ∫ f cos t dt of a piecewise linear f, for angles t in degrees.

    In an interval ∫ cos t (t_1 - t) / h dt = (cos t_0 - cos t_1) / h - sin t_0, and its mirror image for the other end.
    """
    t = np.radians(angles)
    h, fall = np.diff(t), -np.diff(np.cos(t))
    first, last = fall / h - np.sin(t[:-1]), np.sin(t[1:]) - fall / h
    return np.append(first, 0.0) + np.append(0.0, last)


def is_same(angles: np.ndarray, *ends: float) -> bool:
    """Return True if the first and the last of the angles are these (degrees)."""
    return all(math.isclose(a, b, abs_tol=1e-3) for a, b in zip((angles[0], angles[-1]), ends, strict=True))
