"""The shape of a lens in the numbers that a machine shop asks for; lengths in mm, angles in degrees."""

from __future__ import annotations

import numpy as np
import scipy.fft
import torch

from bstcad.analysis.machining import FLATTEST, survey
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.sampling import rim

PLACES = 1025  # points each way of the grid for thickness
ROUNDING = 1e-13  # of the heights


def describe(lens: Lens, places: int = PLACES) -> dict[str, float | None]:
    """Thickness, relief, slope, radii and departure from the best sphere of the back face; mm and degrees.

    Slope and radii are those of analysis.machining, on its grid; a radius is None if the back bends that way nowhere.
    """
    (x, y), edge_places = _places(lens.outline, places), rim(lens.outline, places)
    x, y = torch.cat([edge_places[0], x]), torch.cat([edge_places[1], y])
    back = lens.back.sag_and_slope(x, y)[0].numpy()
    thickness = back - lens.front.sag_and_slope(x, y)[0].numpy()
    edge = thickness[: len(edge_places[0])]
    centre = torch.zeros(1, dtype=torch.float64)
    axial = lens.back.sag_and_slope(centre, centre)[0] - lens.front.sag_and_slope(centre, centre)[0]
    bends = survey(lens)
    concave, convex = (met.largest if met.largest < FLATTEST else None for met in (bends.concave, bends.convex))
    octaves = slope_octaves(lens.back)
    return {
        "centre_thickness": float(axial),
        "edge_thickness_min": float(edge.min()),
        "edge_thickness_max": float(edge.max()),
        "thickness_min": float(thickness.min()),
        "thickness_max": float(thickness.max()),
        "sag_pv": float(np.ptp(back)),
        "slope_max_deg": bends.slope.largest,
        "radius_min_concave": concave,
        "radius_min_convex": convex,
        "departure_best_sphere": departure(x.numpy(), y.numpy(), back),
        "slope_energy_top_octave": float(octaves[-1] / octaves.sum()) if octaves.sum() > 0 else 0.0,
        "slope_energy_octave_below": float(octaves[-2] / octaves.sum()) if octaves.sum() > 0 else 0.0,
    }


def thickness_range(lens: Lens, edge: np.ndarray | None = None) -> tuple[float, float]:
    """Least and largest thickness (mm along z).  edge: as in `heights`."""
    front, back = heights(lens, edge)
    glass = back - front
    return float(glass.min()), float(glass.max())


def heights(lens: Lens, edge: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """z (mm) of the front and of the back at points all over the outline, the rim included.

    edge: corners (n, 2) in mm of a polygon, once around, instead of the outline, for a lens that was cut from it.
    """
    if edge is None:
        places = zip(rim(lens.outline, PLACES), _places(lens.outline, PLACES), strict=True)
        x, y = (torch.cat(pair) for pair in places)
    else:
        grid_x, grid_y = (np.linspace(low, high, PLACES) for low, high in zip(edge.min(0), edge.max(0), strict=True))
        row, column = _inside(edge, grid_x, grid_y).nonzero()
        within = np.stack([grid_x[column], grid_y[row]], axis=1)
        x, y = (torch.from_numpy(each) for each in np.concatenate([edge, within]).T.copy())
    return lens.front.sag_and_slope(x, y)[0].numpy(), lens.back.sag_and_slope(x, y)[0].numpy()


def _inside(polygon: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Which points of a grid (rows y, columns x) lie in a polygon (n, 2): those behind an odd number of its sides."""
    (x0, y0), (x1, y1) = polygon.T, np.roll(polygon, -1, axis=0).T
    found = np.empty((len(y), len(x)), bool)
    for row, height in enumerate(y):
        met = (y0 <= height) != (y1 <= height)
        crossed = x0[met] + (height - y0[met]) * ((x1 - x0)[met] / (y1 - y0)[met])
        found[row] = np.searchsorted(np.sort(crossed), x) % 2
    return found


def _places(outline: Outline, n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A square grid of points inside the outline, flattened (mm)."""
    a, b = outline.half_extent
    x, y = torch.meshgrid(
        torch.linspace(-a, a, n, dtype=torch.float64),
        torch.linspace(-b, b, n, dtype=torch.float64),
        indexing="ij",
    )
    inside = outline.contains(x, y)
    return x[inside], y[inside]


def slope_octaves(back: BSplineSurface) -> np.ndarray:
    """Slope energy of the control net by octaves of frequency, coarse to fine (mm², squared steps); ripple is last.

    Σ λ |ĥ|² over the cosine transform ĥ of the net without its best cubic polynomial (a tilt has no even
    continuation), λ the Laplacian; octave k holds the frequencies whose larger index lies in (m / 2^(k+1), m / 2^k].
    """
    m = back.m
    u = np.linspace(-1, 1, m)
    columns = np.stack([np.outer(u**i, u**j).ravel() for i in range(4) for j in range(4 - i)], axis=1)
    h = back.heights.detach().cpu().double().numpy().ravel()
    h = h - columns @ least_squares(columns, h)
    axis = 2 - 2 * np.cos(np.pi * np.arange(m) / m)
    energy = (axis[:, None] + axis) * scipy.fft.dctn(h.reshape(m, m), norm="ortho") ** 2
    energy[energy < (ROUNDING * (abs(back.z) + np.abs(h).max())) ** 2] = 0.0
    larger = np.maximum(*np.indices((m, m)))
    borders = [m / 2**k for k in range(int(np.log2(m)), -1, -1)]
    return np.array([energy[(larger > a) & (larger <= b)].sum() for a, b in zip(borders, borders[1:], strict=False)])


def least_squares(columns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Coefficients (k,) of columns (n, k) by least squares for values (n,).

    By the normal equations of columns scaled to one length, and once more for the residual: as exact as by singular
    values for columns that are not nearly dependent, and several times as fast.
    """
    lengths = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    normal = columns.T @ columns / np.outer(lengths, lengths)
    found = np.zeros(len(lengths))
    for _ in range(2):
        found += np.linalg.solve(normal, columns.T @ (values - columns @ found) / lengths) / lengths
    return found


def departure(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> float:
    """Peak to valley (mm) of the back against its best sphere, which may be a plane.

    Least squares of P = h - k (x² + y² + h²) - a x - b y - d, h = z - mean: zero on a sphere of curvature 2 k / n,
    n² = 1 + a² + b² - 4 k d, from which a point is 2 P / (n + sqrt(n² - 4 k P)) away (Pratt 1987).
    """
    h = z - z.mean()
    columns = np.stack([x**2 + y**2 + h**2, x, y, np.ones_like(x)], axis=1)
    k, a, b, d = found = least_squares(columns, h)
    p = h - columns @ found
    n2 = 1 + a * a + b * b - 4 * k * d
    return float(np.ptp(2 * p / (np.sqrt(n2) + np.sqrt(np.maximum(n2 - 4 * k * p, 0.0)))))
