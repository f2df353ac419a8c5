"""The lens's shape in the numbers a machine shop asks for; lengths in mm, angles in degrees."""

from __future__ import annotations

import numpy as np
import torch

from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline

PLACES = 1025  # points each way at which thickness is looked at


def describe(lens: Lens) -> dict[str, float | None]:
    """Thickness, relief, slope, radii and departure from the best sphere of the back face; mm and degrees."""
    x, y = _places(lens.outline)
    back, slope_x, slope_y = (a.numpy() for a in lens.back.sag_and_slope(x, y))
    thickness = back - lens.front.sag_and_slope(x, y)[0].numpy()
    rim = _rim(lens.outline)
    edge = lens.back.sag_and_slope(*rim)[0] - lens.front.sag_and_slope(*rim)[0]
    centre = torch.zeros(1, dtype=torch.float64)
    axial = lens.back.sag_and_slope(centre, centre)[0] - lens.front.sag_and_slope(centre, centre)[0]
    concave, convex = radii(lens)
    return {
        "centre_thickness": float(axial),
        "edge_thickness_min": float(edge.min()),
        "edge_thickness_max": float(edge.max()),
        "thickness_min": float(min(thickness.min(), edge.min())),
        "thickness_max": float(max(thickness.max(), edge.max())),
        "sag_pv": float(np.ptp(back)),
        "slope_max_deg": float(np.degrees(np.arctan(np.hypot(slope_x, slope_y).max()))),
        "radius_min_concave": concave,
        "radius_min_convex": convex,
        "departure_best_sphere": departure(x.numpy(), y.numpy(), back),
    }


def _places(outline: Outline) -> tuple[torch.Tensor, torch.Tensor]:
    """A square grid of points inside the outline, flattened (mm)."""
    a, b = outline.half_extent
    x, y = torch.meshgrid(
        torch.linspace(-a, a, PLACES, dtype=torch.float64),
        torch.linspace(-b, b, PLACES, dtype=torch.float64),
        indexing="ij",
    )
    inside = outline.contains(x, y)
    return x[inside], y[inside]


def _rim(outline: Outline) -> tuple[torch.Tensor, torch.Tensor]:
    """Points along the rim (mm)."""
    turn = torch.linspace(0, 2 * torch.pi, 4 * PLACES, dtype=torch.float64)
    c, s = torch.cos(turn), torch.sin(turn)
    a, b = outline.half_extent
    if outline.shape == "rectangle":  # the circle pushed out onto the square
        reach = torch.maximum(c.abs(), s.abs())
        c, s = c / reach, s / reach
    return a * c, b * s


def radii(lens: Lens) -> tuple[float | None, float | None]:
    """Smallest concave and convex radius of the back face (mm) at the middle of its knot spans; None: there is none.

    Principal curvatures of z(x, y); towards +z is concave (a valley, which a tool must fit into).  In the middle of an
    inner span the quadratic spline's derivatives are differences of nine control points: z_xx = Σ (1 -2 1)(1 6 1)/8.
    """
    net = lens.back.control_points()[..., 2]
    pitch_x, pitch_y = lens.back.pitch
    value, slope, bend = np.array([1, 6, 1]) / 8, np.array([-1, 0, 1]) / 2, np.array([1, -2, 1])
    z_x, z_y = _stencil(net, slope, value) / pitch_x, _stencil(net, value, slope) / pitch_y
    z_xx, z_yy = _stencil(net, bend, value) / pitch_x**2, _stencil(net, value, bend) / pitch_y**2
    z_xy = _stencil(net, slope, slope) / (pitch_x * pitch_y)
    norm2 = 1 + z_x**2 + z_y**2
    mean = ((1 + z_y**2) * z_xx - 2 * z_x * z_y * z_xy + (1 + z_x**2) * z_yy) / (2 * norm2**1.5)
    gauss = (z_xx * z_yy - z_xy**2) / norm2**2
    spread = np.sqrt(np.maximum(mean**2 - gauss, 0.0))
    centres_x = lens.back.x[0] + pitch_x * np.arange(1, lens.back.m - 1)
    centres_y = lens.back.y[0] + pitch_y * np.arange(1, lens.back.m - 1)
    x, y = np.meshgrid(centres_x, centres_y, indexing="ij")
    inside = lens.outline.contains(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    most, least = (mean + spread)[inside].max(), (mean - spread)[inside].min()
    return (1 / float(most) if most > 1e-12 else None), (-1 / float(least) if least < -1e-12 else None)


def _stencil(net: np.ndarray, along_x: np.ndarray, along_y: np.ndarray) -> np.ndarray:
    """Σ_i Σ_j a_i b_j net[k + i, l + j] for three neighbours each way: (m - 2, m - 2)."""
    rows = sum(a * net[i : len(net) - 2 + i] for i, a in enumerate(along_x))
    return sum(b * rows[:, j : rows.shape[1] - 2 + j] for j, b in enumerate(along_y))


def departure(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> float:
    """Peak to valley (mm) of the back against its best sphere: least squares of x² + y² + z² = ax + by + cz + d."""
    columns = np.stack([x, y, z - z.mean(), np.ones_like(x)], axis=1)
    right = x**2 + y**2 + (z - z.mean()) ** 2
    (a, b, c, d), *_ = np.linalg.lstsq(columns, right, rcond=None)
    centre = np.array([a, b, c]) / 2
    radius = np.sqrt(d + centre @ centre)
    off = np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - z.mean() - centre[2]) ** 2) - radius
    return float(np.ptp(off))
