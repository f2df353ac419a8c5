"""A face on a regular grid, with exact first and mixed second derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.outlines import Outline
from bstcad.optics.spline_basis import basis_matrix


@dataclass(frozen=True, eq=False)
class Grid:
    """z(x, y) of a face at each pair of x and y, arrays (len(x), len(y)); mm."""

    x: np.ndarray  # ascending
    y: np.ndarray
    z: np.ndarray
    z_x: np.ndarray  # ∂z/∂x
    z_y: np.ndarray
    z_xy: np.ndarray  # ∂²z/∂x∂y (1/mm)


def axes(outline: Outline, points: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y (mm) of a grid over the outline's bounding box, the same spacing or nearly in both, centred on the axis.

    points: along the wider side, both ends included.
    """
    a, b = outline.half_extent
    spacing = 2 * max(a, b) / (points - 1)
    x, y = (np.linspace(-end, end, max(2, round(2 * end / spacing) + 1)) for end in (a, b))
    return x, y


def on_grid(face: BSplineSurface, x: np.ndarray, y: np.ndarray) -> Grid:
    """The face at each pair of x and y (mm), which the net must reach.

    z = Σ_i Σ_j B_i(u(x)) B_j(v(y)) h_ij (Wang et al. 2023, Eq. 2) is a product of three matrices on a grid, and each
    derivative is the same product with derivatives of one or both bases: nothing here is a difference quotient.
    """
    heights = face.plain().heights.numpy()
    bases = []
    for places, (low, _), pitch in zip((x, y), (face.x, face.y), face.pitch, strict=True):
        u = np.clip((places - low) / pitch, 0.0, face.m - 1.0)
        bases.append((basis_matrix(u, face.m), basis_matrix(u, face.m, derivative=1) / pitch))
    (b_x, d_x), (b_y, d_y) = bases
    along, across = (b_x @ heights, d_x @ heights)  # (len(x), m)
    return Grid(x, y, face.z + (b_y @ along.T).T, (b_y @ across.T).T, (d_y @ along.T).T, (d_y @ across.T).T)
