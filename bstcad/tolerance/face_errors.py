"""Errors of the form of a face, as heights of its control net: random fields and tool marks.

Control points with the values of a field make its spline but for (pitch / length)², so a field must be smooth over a
few control cells.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch
from scipy.linalg import solve_banded
from scipy.ndimage import gaussian_filter

from bstcad.optics.bspline import BSplineSurface, basis_matrix
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.surfaces import Surface

FACE = 513  # control points a side of the net of a plane or a conic with a form error
SPARE = 6  # of these control points on each side of a round outline, beyond the rim
BEYOND = 1.03  # of the rim's radius: such a net follows its face up to there, which is far enough not to matter inside
SMOOTH = 4.0  # control cells in a correlation length or a period, at least


def random_field(surface: BSplineSurface, correlation_length: float, seed: int, inside: np.ndarray) -> np.ndarray:
    """(m, m) a Gaussian random field of RMS 1 and mean 0 over `inside`, of covariance exp(-(r / correlation_length)²).

    White noise drawn with the seed, smoothed by a Gaussian of standard deviation correlation_length (mm) / 2; the
    covariance is wider by √2.  ValueError if the net is too coarse for it.
    """
    _resolved(surface, correlation_length, "a correlation length")
    cells = [correlation_length / 2 / pitch for pitch in surface.pitch]
    margin = [int(np.ceil(4 * c)) for c in cells]
    shape = [surface.m + 2 * k for k in margin]  # without an effect of borders
    noise = gaussian_filter(np.random.default_rng(seed).standard_normal(shape), cells, truncate=4.0)
    return _of_rms_one(noise[margin[0] : margin[0] + surface.m, margin[1] : margin[1] + surface.m], inside)


def ripple(surface: BSplineSurface, period: float, kind: Literal["raster", "spiral"], inside: np.ndarray) -> np.ndarray:
    """(m, m) tool marks sin(2π s / period) of RMS 1 over `inside`.

    s is x for a raster, the distance from the axis for the spiral of a diamond tool, whose turns are nearly circles.
    period (mm).  ValueError if the net is too coarse for it.
    """
    _resolved(surface, period, "a ripple's period")
    x, y = (np.linspace(*side, surface.m) for side in (surface.x, surface.y))
    s = np.broadcast_to(x[:, None], (surface.m, surface.m)) if kind == "raster" else np.hypot(x[:, None], y[None, :])
    return _of_rms_one(np.sin(2 * np.pi * s / period), inside)


def inside(lens: Lens, net: BSplineSurface) -> np.ndarray:
    """(m, m) True for control points of a face of the lens inside the outline."""
    return lens.outline.contains(*_points(net)).numpy()


def raised(lens: Lens, heights: np.ndarray) -> Lens:
    """The lens with its back higher by these heights (m, m) (mm)."""
    return replace(lens, back=higher(lens.back, heights))


def higher(net: BSplineSurface, heights: np.ndarray) -> BSplineSurface:
    """A face higher by these heights (m, m) (mm)."""
    return replace(net, heights=net.heights + torch.from_numpy(heights).to(net.heights))


def as_net(face: Surface, outline: Outline) -> BSplineSurface:
    """A plane, a sphere or a conic as a net of FACE control points a side; a net as it is.

    It interpolates the face over each control point.  In its end spans a spline of uniform control points follows a
    curve poorly: of a disc they lie beyond the rim, where the net becomes level; of a rectangle they lie at its sides.
    """
    if face.curvature is None:
        return face
    wide = (FACE - 1) / (FACE - 1 - 2 * SPARE) if outline.shape == "circle" else 1.0
    half_x, half_y = (half * wide for half in outline.half_extent)
    level = BSplineSurface(face.z, torch.zeros((FACE, FACE), dtype=torch.float64), (-half_x, half_x), (-half_y, half_y))
    x, y = _points(level)
    rim, r = math.hypot(*outline.farthest), torch.hypot(x, y)
    there = torch.full((1,), BEYOND * rim, dtype=torch.float64)
    rim = BEYOND * rim if bool(face.reaches(there, torch.zeros_like(there))) else rim
    inwards = (rim / r.clamp(min=rim)).clamp(max=1.0)
    sag = face.sag_and_slope(inwards * x, inwards * y)[0] - face.z
    bands = _bands(basis_matrix(np.arange(FACE, dtype=float), FACE))
    along_x = solve_banded((1, 1), bands, sag.numpy())
    return replace(level, heights=torch.from_numpy(solve_banded((1, 1), bands, along_x.T).T.copy()))


def _points(net: BSplineSurface) -> tuple[torch.Tensor, torch.Tensor]:
    """(m, m) x and y of the control points (mm)."""
    x, y = (torch.linspace(*side, net.m, dtype=torch.float64) for side in (net.x, net.y))
    return torch.meshgrid(x, y, indexing="ij")


def _bands(matrix: Any) -> np.ndarray:
    """(3, m) the diagonals of a tridiagonal matrix as LAPACK takes them."""
    m = matrix.shape[0]
    bands = np.zeros((3, m))
    for k in (-1, 0, 1):
        bands[1 - k, max(k, 0) : m + min(k, 0)] = matrix.diagonal(k)
    return bands


def _resolved(surface: BSplineSurface, length: float, what: str) -> None:
    least = SMOOTH * max(surface.pitch)
    if length < least:
        raise ValueError(
            f"{what} of {length:g} mm is too fine for {surface.m} x {surface.m} control points, which carry "
            f"{least:.3g} mm and more; give a longer one, or a lens of more control points"
        )


def _of_rms_one(field: np.ndarray, where: np.ndarray) -> np.ndarray:
    field = field - field[where].mean()
    return field / np.sqrt(np.mean(field[where] ** 2))
