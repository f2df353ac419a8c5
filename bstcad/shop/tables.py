"""Tables of a lens as text: the first line names the columns, lengths in mm."""

from __future__ import annotations

import io

import numpy as np
import torch

from bstcad.optics.bspline import BSplineSurface, basis_matrix
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.surfaces import Surface, sag

DIGITS = "%.12g"


def sag_table(lens: Lens, points: int) -> str:
    """CSV of both faces at the same points inside the outline: x, y, z of the front, z of the back."""
    x, y = _inside(lens, points)
    return _csv("x_mm,y_mm,front_z_mm,back_z_mm", (x, y, sag(lens.front, x, y), sag(lens.back, x, y)))


def points_table(lens: Lens, face: Surface, points: int) -> str:
    """CSV of points of a face inside the outline with its unit normals, which point out of the lens."""
    x, y = _inside(lens, points)
    z, z_x, z_y = (t.numpy() for t in face.plain().sag_and_slope(torch.from_numpy(x), torch.from_numpy(y)))
    outwards = 1.0 if face is lens.back else -1.0
    length = np.sqrt(1 + z_x * z_x + z_y * z_y) * outwards
    return _csv("x_mm,y_mm,z_mm,normal_x,normal_y,normal_z", (x, y, z, -z_x / length, -z_y / length, 1 / length))


def turning_cloud(lens: Lens, points: int) -> str:
    """CSV for diamond turning with a slow tool: radius, angle from +x towards +y, height of the back over its vertex.

    Rings of equal spacing, `points` from the axis to the farthest point of the outline, each with as many angles as
    the outermost ring needs for that spacing; points outside the outline are left out.  The tool's radius is not in it.
    """
    ring = np.linspace(0.0, float(np.hypot(*lens.outline.farthest)), points)
    count = round(2 * np.pi * (points - 1))
    radius, angle = (p.ravel() for p in np.meshgrid(ring, np.arange(count) * 360.0 / count, indexing="ij"))
    x, y = radius * np.cos(np.radians(angle)), radius * np.sin(np.radians(angle))
    inside = lens.outline.contains(*(torch.from_numpy(p * (1 - 1e-12)) for p in (x, y))).numpy()  # and on its rim
    height = sag(lens.back, x[inside], y[inside]) - vertex(lens.back)
    return _csv("radius_mm,angle_deg,sag_mm", (radius[inside], angle[inside], height))


def zemax_grid(lens: Lens, face: BSplineSurface, points: int) -> str:
    """Zemax OpticStudio's grid sag file (.DAT) of a face over the bounding box of the outline.

    Header: nx ny, spacings in x and y, unit (0: mm), decentre in x and y.  Then a line a point, from (-x, +y) along +x
    and downwards: sag over the vertex, ∂z/∂x, ∂z/∂y, ∂²z/∂x∂y, all exact, and 0: there is data.
    """
    x, y = axes(lens.outline, points)
    z, *derivatives = on_grid(face, x, y)
    columns = [values.T[::-1].ravel() for values in (z - vertex(face), *derivatives)]
    text = io.StringIO()
    text.write(f"{len(x)} {len(y)} {x[1] - x[0]:.17g} {y[1] - y[0]:.17g} 0 0 0\n")
    np.savetxt(text, np.column_stack(columns), fmt="%.17g %.17g %.17g %.17g 0")
    return text.getvalue()


def axes(outline: Outline, points: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y (mm) of a grid over the outline's bounding box, nearly square cells, centred on the axis.

    points: along the wider side, both ends included.
    """
    a, b = outline.half_extent
    spacing = 2 * max(a, b) / (points - 1)
    x, y = (np.linspace(-end, end, max(2, round(2 * end / spacing) + 1)) for end in (a, b))
    return x, y


def on_grid(face: BSplineSurface, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
    """(z, ∂z/∂x, ∂z/∂y, ∂²z/∂x∂y) (mm, 1, 1, 1/mm) of a face at each pair of x and y (mm) within its net.

    z = Σ_i Σ_j B_i(u(x)) B_j(v(y)) h_ij (Wang et al. 2023, Eq. 2) is a product of three matrices on a grid, and each
    derivative is the same product with derivatives of one or both bases.
    """
    bases = []
    for at, (low, _), pitch in zip((x, y), (face.x, face.y), face.pitch, strict=True):
        u = np.clip((at - low) / pitch, 0.0, face.m - 1.0)
        bases.append((basis_matrix(u, face.m), basis_matrix(u, face.m, derivative=1) / pitch))
    (b_x, d_x), (b_y, d_y) = bases
    heights = face.plain().heights.numpy()
    along, across = b_x @ heights, d_x @ heights  # (len(x), m)
    return face.z + (b_y @ along.T).T, (b_y @ across.T).T, (d_y @ along.T).T, (d_y @ across.T).T


def vertex(face: Surface) -> float:
    """z where a face crosses the axis (mm)."""
    return float(sag(face, 0.0, 0.0))


def _inside(lens: Lens, points: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y (mm) of the points of a grid that lie inside the outline."""
    x, y = (p.ravel() for p in np.meshgrid(*axes(lens.outline, points), indexing="ij"))
    inside = lens.outline.contains(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    return x[inside], y[inside]


def _csv(header: str, columns: tuple[np.ndarray, ...]) -> str:
    text = io.StringIO()
    np.savetxt(text, np.column_stack(columns), fmt=DIGITS, delimiter=",", header=header, comments="")
    return text.getvalue()
