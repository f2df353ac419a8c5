"""Tilts: frames that are turned against that of space."""

from __future__ import annotations

import math

Vector = tuple[float, float, float]


def axes(tilt: tuple[float, float]) -> tuple[Vector, Vector, Vector]:
    """e_x, e_y and n: the axes of space, turned first about the x axis by α, then about the y axis by β (degrees).

    e_x = (cos β, 0, -sin β), e_y = (sin α sin β, cos α, sin α cos β), n = (cos α sin β, -sin α, cos α cos β): both
    turns are right-handed, so that a positive α leans n towards -y and a positive β towards +x.
    """
    (sin_a, sin_b), (cos_a, cos_b) = ([f(math.radians(t)) for t in tilt] for f in (math.sin, math.cos))
    return (cos_b, 0.0, -sin_b), (sin_a * sin_b, cos_a, sin_a * cos_b), (cos_a * sin_b, -sin_a, cos_a * cos_b)


def clocked(frame: tuple[Vector, Vector, Vector], angle: float) -> tuple[Vector, Vector, Vector]:
    """A frame turned about its own third axis by an angle (degrees), right-handed."""
    e_x, e_y, n = frame
    sin, cos = math.sin(math.radians(angle)), math.cos(math.radians(angle))
    x, y = (tuple(p * a + q * b for a, b in zip(e_x, e_y, strict=True)) for p, q in ((cos, sin), (-sin, cos)))
    return x, y, n


def clocking_of(frame: tuple[Vector, Vector, Vector]) -> float:
    """The angle (degrees) by which `axes` of the frame's tilt have to be `clocked` to be the frame."""
    e_x, e_y, _ = axes(tilt_of(frame[2]))
    along, across = (sum(p * q for p, q in zip(frame[0], e, strict=True)) for e in (e_x, e_y))
    return math.degrees(math.atan2(across, along))


def tilt_of(n: Vector) -> tuple[float, float]:
    """(α, β) in degrees of the frame whose third axis is n, a unit vector with n_z > 0."""
    return math.degrees(math.asin(max(-1.0, min(1.0, -n[1])))), math.degrees(math.atan2(n[0], n[2]))
