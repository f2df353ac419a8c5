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


def tilt_of(n: Vector) -> tuple[float, float]:
    """(α, β) in degrees of the frame whose third axis is n, a unit vector with n_z > 0."""
    return math.degrees(math.asin(max(-1.0, min(1.0, -n[1])))), math.degrees(math.atan2(n[0], n[2]))
