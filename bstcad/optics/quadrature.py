"""Integrals of a B-spline surface over its net and over a disc, to rounding (about 1e-13 of themselves)."""

from __future__ import annotations

from typing import Protocol, Self

import numpy as np

from bstcad.optics.spline_basis import DEGREE, knots


class Net(Protocol):
    """What is asked of a surface (bspline.BSplineSurface)."""

    m: int
    pitch: tuple[float, float]
    x: tuple[float, float]
    y: tuple[float, float]

    def plain(self) -> Self:
        """In float64 on the CPU."""


def over_net(surface: Net) -> float:
    """∫∫ h dx dy of the heights over the whole net (mm³): Σ_i Σ_j w_i w_j h_ij."""
    across, along = (_weights(surface.m, pitch) for pitch in surface.pitch)
    return float((across[:, None] * _heights(surface) * along).sum())


def _heights(surface: Net) -> np.ndarray:
    return surface.plain().heights.numpy()


def _weights(m: int, pitch: float) -> np.ndarray:
    """∫ B_i dx (m,) in mm, x(t) = pitch Σ j B_j(t): a cubic in each span, so two Gauss points are exact."""
    from scipy.interpolate import BSpline

    point, weight = np.polynomial.legendre.leggauss(2)
    t = (np.arange(m - 2)[:, None] + (point + 1) / 2).ravel()
    position = BSpline(knots(m), pitch * np.arange(m), DEGREE)
    dx = position(t, 1) * np.tile(weight / 2, m - 2)
    return BSpline.design_matrix(t, knots(m), DEGREE).T @ dx


def rim_breaks(surface: Net, radius: float) -> np.ndarray:
    """Angles from 0 to 2 pi, ascending, between which the rim of a round lens crosses no knot line of the surface.

    At most 2 pi / 256 apart.
    """
    angles = [np.linspace(0, 2 * np.pi, 257)]
    for (first, _), pitch, quarter in zip((surface.x, surface.y), surface.pitch, (0.0, np.pi / 2), strict=True):
        lines = first + pitch * (np.arange(1, surface.m - 2) + 0.5)  # x(t) = first + pitch (t + 1/2) inside
        turn = np.arccos(lines[np.abs(lines) < radius] / radius)
        angles += [quarter + turn, quarter - turn]
    theta = np.sort(np.concatenate(angles) % (2 * np.pi))
    theta = theta[np.concatenate([[True], np.diff(theta) > 1e-9])]  # rad; two crossings in one point count once
    return np.append(theta[theta < 2 * np.pi - 1e-9], 2 * np.pi)


def over_disc(surface: Net, radius: float) -> float:
    """∫∫ h dx dy of the heights over a disc (mm³), by Green: ∮ F dy with ∂F/∂x = h, along the rim.

    F is a spline of degree 3 x 2 in the linear part of the net; between two knot lines F dy/dθ is analytic, and eight
    Gauss points an arc of less than 1.5 degrees leave nothing but rounding.
    """
    from scipy.interpolate import BSpline, NdBSpline

    full, (dx, dy) = knots(surface.m), surface.pitch
    antiderivative = BSpline(full, _heights(surface), DEGREE).antiderivative()
    spline = NdBSpline((antiderivative.t, full), antiderivative.c[: surface.m + 1], (DEGREE + 1, DEGREE))
    point, weight = np.polynomial.legendre.leggauss(8)
    breaks = rim_breaks(surface, radius)
    half = np.diff(breaks) / 2
    theta = (breaks[:-1] + half)[:, None] + half[:, None] * point
    t = (radius * np.cos(theta) - surface.x[0]) / dx - 0.5  # x(t) = first + pitch (t + 1/2)
    s = (radius * np.sin(theta) - surface.y[0]) / dy - 0.5
    f = dx * spline(np.stack([t, s], axis=-1)) * radius * np.cos(theta)
    return float((half[:, None] * f * weight).sum())
