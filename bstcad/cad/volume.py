"""The volume of a lens to rounding, and the closed forms of its faces that this takes; no OCC.

V = ∫∫ back dx dy - ∫∫ front dx dy over the outline.  OCC's own volume properties are approximate.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.interpolate import BSpline, NdBSpline

from bstcad.optics.bspline import DEGREE, BSplineSurface, knots
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.surfaces import Plane, Sphere


def curvature(front: Plane | Sphere) -> float:
    """c (1/mm), zero for a plane."""
    return 0.0 if isinstance(front, Plane) else float(front.curvature)


def sag(front: Plane | Sphere, r2: np.ndarray | float) -> np.ndarray | float:
    """z (mm) at r² = x² + y² (mm²): z0 + c r² / (1 + sqrt(1 - c² r²))."""
    c = curvature(front)
    return front.z + c * r2 / (1 + np.sqrt(1 - c * c * r2))


def double(back: BSplineSurface) -> BSplineSurface:
    """The surface in float64 on the CPU, without its gradient."""
    return BSplineSurface(back.z, back.heights.detach().to("cpu", torch.float64), back.x, back.y)


def exact_volume(lens: Lens) -> float:
    """Volume (mm³) of the lens, to about 1e-13 of itself."""
    if isinstance(lens.outline, Circle):
        return _under_round_back(lens.back, lens.outline.radius) - _under_cap(lens.front, lens.outline.radius)
    return _under_back(lens.back) - _under_rectangle(lens.front, lens.outline)


def _heights(back: BSplineSurface) -> np.ndarray:
    return back.heights.detach().cpu().numpy().astype(np.float64)


def _weights(m: int, pitch: float) -> np.ndarray:
    """∫ B_i dx (m,) in mm, x(t) = pitch Σ j B_j(t): a cubic in each span, so two Gauss points are exact."""
    point, weight = np.polynomial.legendre.leggauss(2)
    t = (np.arange(m - 2)[:, None] + (point + 1) / 2).ravel()
    position = BSpline(knots(m), pitch * np.arange(m), DEGREE)
    dx = position(t, 1) * np.tile(weight / 2, m - 2)
    return BSpline.design_matrix(t, knots(m), DEGREE).T @ dx


def _under_back(back: BSplineSurface) -> float:
    """∫∫ z dx dy over the whole net (mm³): Σ_i Σ_j w_i w_j h_ij + z0 A."""
    (x0, x1), (y0, y1) = back.x, back.y
    across, along = (_weights(back.m, pitch) for pitch in back.pitch)
    return float(across @ _heights(back) @ along) + back.z * (x1 - x0) * (y1 - y0)


def _under_rectangle(front: Plane | Sphere, outline: Rectangle) -> float:
    """∫∫ z dx dy of the front (mm³): 96 x 96 Gauss points, exact to rounding up to a half diagonal of 0.95 R."""
    a, b = outline.half_extent
    point, weight = np.polynomial.legendre.leggauss(96)
    departure = sag(front, (a * point[:, None]) ** 2 + (b * point[None, :]) ** 2) - front.z
    return float(a * b * (weight @ departure @ weight)) + front.z * outline.area


def _under_cap(front: Plane | Sphere, radius: float) -> float:
    """∫∫ z dx dy of the front over a disc (mm³): with s = sag - z0 at the rim, pi s (3 a² - s²) / 6 + z0 A."""
    s = sag(front, radius**2) - front.z
    return float(np.pi * (s * (3 * radius**2 - s * s) / 6 + front.z * radius**2))


def rim_breaks(back: BSplineSurface, radius: float) -> np.ndarray:
    """Angles from 0 to 2 pi, ascending, between which the rim of a round lens crosses no knot line of the back.

    At most 2 pi / 256 apart.
    """
    angles = [np.linspace(0, 2 * np.pi, 257)]
    for (first, _), pitch, quarter in zip((back.x, back.y), back.pitch, (0.0, np.pi / 2), strict=True):
        lines = first + pitch * (np.arange(1, back.m - 2) + 0.5)  # x(t) = first + pitch (t + 1/2) inside
        turn = np.arccos(lines[np.abs(lines) < radius] / radius)
        angles += [quarter + turn, quarter - turn]
    theta = np.sort(np.concatenate(angles) % (2 * np.pi))
    theta = theta[np.concatenate([[True], np.diff(theta) > 1e-9])]  # rad; two crossings in one point count once
    return np.append(theta[theta < 2 * np.pi - 1e-9], 2 * np.pi)


def _under_round_back(back: BSplineSurface, radius: float) -> float:
    """∫∫ z dx dy over a disc (mm³), by Green: ∮ F dy with ∂F/∂x = z, along the rim.

    F is a spline of degree 3 x 2 in the linear part of the net; between two knot lines F dy/dθ is analytic, and eight
    Gauss points an arc of less than 1.5 degrees leave nothing but rounding.
    """
    full, (dx, dy) = knots(back.m), back.pitch
    antiderivative = BSpline(full, _heights(back), DEGREE).antiderivative()
    spline = NdBSpline((antiderivative.t, full), antiderivative.c[: back.m + 1], (DEGREE + 1, DEGREE))
    point, weight = np.polynomial.legendre.leggauss(8)
    breaks = rim_breaks(back, radius)
    half = np.diff(breaks) / 2
    theta = (breaks[:-1] + half)[:, None] + half[:, None] * point
    t = (radius * np.cos(theta) - back.x[0]) / dx - 0.5  # x(t) = first + pitch (t + 1/2)
    s = (radius * np.sin(theta) - back.y[0]) / dy - 0.5
    f = dx * spline(np.stack([t, s], axis=-1)) * radius * np.cos(theta)
    return float(half @ (f @ weight)) + back.z * np.pi * radius**2
