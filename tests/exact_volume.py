"""The volume of a lens without any border: from its control points, to about 1e-13 of itself."""

from __future__ import annotations

import numpy as np
import torch
from scipy.interpolate import BSpline, NdBSpline

from bstcad.optics.lens.face_integrals import gauss_rule, rim_breaks
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import DEGREE, BSplineSurface, knots, parameter
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.surfaces import Surface, sag


def exact_volume(lens: Lens) -> float:
    """V = ∫∫ (back - front) dx dy over the outline (mm³)."""
    back, front = (integral(face, lens.outline) + face.z * lens.outline.area for face in (lens.back, lens.front))
    return back - front


def integral(face: Surface, outline: Outline) -> float:
    """∫∫ (z - z0) dx dy over the outline (mm³).

    Of a surface of revolution over a disc of radius a, with the sag h at its rim, pi h (3 a² - (1 + k) h²) / 6; over a
    rectangle by 96 x 96 Gauss points, exact to rounding up to a half diagonal of 0.95 R.
    """
    if face.is_net:
        if outline.is_round:
            return _over_disc(face, outline.radius)
        axes = zip(face.shape, (face.x, face.y), outline.half_extent, strict=True)
        across, along = (_weights(m, ends, half) for m, ends, half in axes)  # Σ_i Σ_j w_i w_j h_ij
        return float((across[:, None] * face.plain().heights.numpy() * along).sum())
    face, (a, b) = face.plain().moved(0.0), outline.half_extent
    if outline.is_round:
        h = sag(face, a, 0.0)
        return float(np.pi * h * (3 * a * a - (1 + face.conic_constant) * h * h) / 6)
    point, weight = gauss_rule(96)
    h = sag(face, a * point[:, None], b * point[None, :])
    return float(a * b * (weight[:, None] * h * weight).sum())


def _weights(m: int, ends: tuple[float, float], half: float) -> np.ndarray:
    """∫ B_i dx (m,) in mm from -half to half, x(t) = Σ x_j B_j(t): cubic in each span, which two Gauss points hold."""
    position = BSpline(knots(m), np.linspace(*ends, m), DEGREE)
    places = torch.tensor([-half, half], dtype=torch.float64)
    low, high = parameter(((places - ends[0]) * (m - 1) / (ends[1] - ends[0])).clamp(0.0, m - 1.0), m).tolist()
    breaks = np.unique([low, *(k for k in range(m - 1) if low < k < high), high])
    point, weight = gauss_rule(2)
    width = np.diff(breaks)[:, None]
    t = (breaks[:-1, None] + width * (point + 1) / 2).ravel()
    dx = position(t, 1) * (width * weight / 2).ravel()
    return BSpline.design_matrix(t, knots(m), DEGREE).T @ dx


def _over_disc(surface: BSplineSurface, radius: float) -> float:
    """∫∫ h dx dy of the heights over a disc (mm³), by Green: ∮ F dy with ∂F/∂x = h, along the rim.

    F is a spline of degree 3 x 2 in the linear part of the net; between two knot lines F dy/dθ is analytic, and eight
    Gauss points an arc of less than 1.5 degrees leave nothing but rounding.
    """
    full, (dx, dy) = knots(surface.m), surface.pitch
    antiderivative = BSpline(full, surface.plain().heights.numpy(), DEGREE).antiderivative()
    spline = NdBSpline((antiderivative.t, full), antiderivative.c[: surface.m + 1], (DEGREE + 1, DEGREE))
    point, weight = gauss_rule(8)
    breaks = rim_breaks(surface, radius)
    half = np.diff(breaks) / 2
    theta = (breaks[:-1] + half)[:, None] + half[:, None] * point
    t = (radius * np.cos(theta) - surface.x[0]) / dx - 0.5  # x(t) = first + pitch (t + 1/2)
    s = (radius * np.sin(theta) - surface.y[0]) / dy - 0.5
    f = dx * spline(np.stack([t, s], axis=-1)) * radius * np.cos(theta)
    return float((half[:, None] * f * weight).sum())
