"""Tables of a lens as text: what each file holds stands in its first line, lengths in mm."""

from __future__ import annotations

import io

import numpy as np
import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import Surface, sag
from bstcad.shop.grids import axes, on_grid

DIGITS = "%.12g"


def sag_table(lens: Lens, points: int) -> str:
    """CSV of both faces over the same places inside the outline: x, y, z of the front, z of the back."""
    x, y = _places(lens, points)
    return _csv("x_mm,y_mm,front_z_mm,back_z_mm", x, y, sag(lens.front, x, y), sag(lens.back, x, y))


def points_table(lens: Lens, face: Surface, points: int) -> str:
    """CSV of places of a face inside the outline with its unit normals, which point out of the lens."""
    x, y = _places(lens, points)
    z, z_x, z_y = (t.numpy() for t in face.plain().sag_and_slope(torch.from_numpy(x), torch.from_numpy(y)))
    outwards = 1.0 if face is lens.back else -1.0
    length = np.sqrt(1 + z_x * z_x + z_y * z_y) * outwards
    return _csv("x_mm,y_mm,z_mm,normal_x,normal_y,normal_z", x, y, z, -z_x / length, -z_y / length, 1 / length)


def turning_cloud(lens: Lens, points: int) -> str:
    """CSV for diamond turning with a slow tool: radius, angle from +x towards +y, height of the back over its vertex.

    Rings of the same spacing, `points` from the axis to the farthest point of the outline, each with as many angles as
    the outermost one needs for that spacing; places outside the outline are left out.  The tool's radius is not in it.
    """
    reach = float(np.hypot(*lens.outline.farthest))
    ring = np.linspace(0.0, reach, points)
    turn = np.arange(round(2 * np.pi * (points - 1)))
    radius, angle = (p.ravel() for p in np.meshgrid(ring, 360.0 * turn / len(turn), indexing="ij"))
    x, y = radius * np.cos(np.radians(angle)), radius * np.sin(np.radians(angle))
    inside = lens.outline.contains(*(torch.from_numpy(p * (1 - 1e-12)) for p in (x, y))).numpy()  # and on its rim
    x, y = x[inside], y[inside]
    return _csv("radius_mm,angle_deg,sag_mm", radius[inside], angle[inside], sag(lens.back, x, y) - vertex(lens.back))


def zemax_grid(lens: Lens, face: BSplineSurface, points: int) -> str:
    """Zemax OpticStudio's grid sag file (.DAT) of a face over the bounding box of the outline.

    Header: nx ny, spacings in x and y, unit (0: mm), decentre in x and y.  Then a line a point, from (-x, +y) along +x
    and downwards: sag over the vertex, ∂z/∂x, ∂z/∂y, ∂²z/∂x∂y, all exact, and 0: there is data.
    """
    x, y = axes(lens.outline, points)
    grid = on_grid(face, x, y)
    rows = (grid.z - vertex(face), grid.z_x, grid.z_y, grid.z_xy)
    columns = [np.asarray(values).T[::-1].ravel() for values in rows]
    text = io.StringIO()
    text.write(f"{len(x)} {len(y)} {x[1] - x[0]:.17g} {y[1] - y[0]:.17g} 0 0 0\n")
    np.savetxt(text, np.column_stack(columns), fmt="%.17g %.17g %.17g %.17g 0")
    return text.getvalue()


def vertex(face: Surface) -> float:
    """z where a face crosses the axis (mm)."""
    return float(sag(face, 0.0, 0.0))


def _places(lens: Lens, points: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y (mm) of the points of a grid that lie inside the outline."""
    x, y = (p.ravel() for p in np.meshgrid(*axes(lens.outline, points), indexing="ij"))
    inside = lens.outline.contains(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    return x[inside], y[inside]


def _csv(header: str, *columns: np.ndarray) -> str:
    text = io.StringIO()
    np.savetxt(text, np.column_stack(columns), fmt=DIGITS, delimiter=",", header=header, comments="")
    return text.getvalue()
