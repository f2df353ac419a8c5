"""Shape of a lens, in quantities that a machine shop needs; lengths in mm, angles in degrees, slope of a ripple in rad.

Radii and slopes of a face are computed on a grid four times finer than its net.  Curvature jumps at the knots, so each
knot span is sampled with its ends (optics.surfaces.bspline.QUARTERS), inside the outline.  Slopes are computed on the
rim too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.fft
import torch
from torch import Tensor

from bstcad.analysis.curvature import extremes
from bstcad.optics.kernels import spline
from bstcad.optics.lens.interfaces import intersect
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK
from bstcad.optics.surfaces.bspline import QUARTERS, BSplineSurface, require_net, span_points, weights
from bstcad.optics.surfaces.outlines import EVERYWHERE, Outline
from bstcad.optics.surfaces.radial import require_radial
from bstcad.optics.surfaces.rays import Rays, Status, dot
from bstcad.optics.surfaces.sampling import sample_rim
from bstcad.optics.surfaces.surfaces import points_on, sag

GRID_POINTS = 1025  # points per side of the grid for thickness, and along a quarter of the rim
HEIGHT_ROUNDING = 1e-13  # rounding of the heights, relative to the largest height
SMOOTH_RATIO = 2.0  # largest ratio of slope energies, highest octave / octave below it, of a net without ripple
AT_BOUND = 0.97  # fraction of a bound on curvature or slope above which a point counts as at the bound
MIN_CURVATURE, MAX_RADIUS = 1e-9, 1e9  # curvature (1/mm) below which a face is flat; its radius then (mm)
OUTLINE_ROUNDING = 1e-9  # fraction by which the outline is widened, so that points on it are inside despite rounding


def describe(lens: Lens, grid: int = GRID_POINTS) -> dict[str, float | None]:
    """Return the thickness of a lens, and sag range, slope, radii, departure from a sphere and ripple of the back.

    grid: points per side.  A radius is None if the back has no such curvature.  Keys front_… describe a tailored front,
    which is seen from outside, as the back is: valleys are concave.
    """
    x, y = _points(lens.outline, grid)
    points = points_on(lens.back, x, y)
    glass, [centre] = thickness(lens, points), thickness(lens, points_on(lens.back, [0.0], [0.0]))
    of_faces: dict[str, Any] = {}
    for face in lens.described_faces:
        figures = _face_figures(require_net(face.surface), survey(lens, face.name), points_on(face.surface, x, y))
        of_faces |= {f"{face.prefix}{key}": value for key, value in figures.items()}
    (thinnest, thickest), (edge_thinnest, edge_thickest) = _range(glass), _range(glass[: 4 * grid])
    return {
        "centre_thickness": float(centre),
        "edge_thickness_min": edge_thinnest,
        "edge_thickness_max": edge_thickest,
        "thickness_min": thinnest,
        "thickness_max": thickest,
        **of_faces,
    }


def _face_figures(net: BSplineSurface, bends: Survey, points: np.ndarray) -> dict[str, Any]:
    """Return the figures of one freeform face; bends: its extremes; points: points (n, 3) (mm) all over it."""
    concave, convex = (bend.largest if bend.largest < MAX_RADIUS else None for bend in (bends.concave, bends.convex))
    octaves, waves = slope_octaves(net), ripple(net)
    top = octaves[-1] / octaves.sum() if octaves.sum() > 0 else 0.0
    return {
        "sag_pv": float(np.ptp(points[:, 2])),
        "slope_max_deg": bends.slope.largest,
        "radius_min_concave": concave,
        "radius_min_convex": convex,
        "departure_best_sphere": departure(*points.T),
        "slope_energy_top_octave": float(top),
        "ripple_height": waves.height,
        "ripple_slope": waves.slope,
    }


def thickness(lens: Lens, points: np.ndarray) -> np.ndarray:
    """Return the thickness (mm) at points (n, 3) of the back: along z, or along lines from the centre of its chart.

    A front beside the centre, such as a plane below it, gives NaN where the line meets it behind the centre.
    """
    if lens.back.chart.flat:
        x, y, z = points.T
        return z - sag(lens.front, x, y)
    position = torch.from_numpy(np.ascontiguousarray((points - (0.0, 0.0, lens.back.z)).T))
    rho = torch.sqrt(dot(position, position))
    status = torch.zeros(rho.shape, dtype=torch.uint8)
    rays = Rays(torch.zeros_like(position), position / rho, torch.ones_like(rho), status, z=lens.back.z)
    met, _ = intersect(lens.front.optical, rays, EVERYWHERE, Status.MISSED_FRONT)
    at = torch.stack([*met.position[:2], met.above(lens.back.z)])
    return torch.where(met.alive, rho - torch.sqrt(dot(at, at)), torch.full_like(rho, math.nan)).numpy()


def _range(glass: np.ndarray) -> tuple[float, float]:
    """Return the smallest and the largest of thicknesses, without those that are NaN."""
    unknown = np.isnan(glass)
    return float(np.where(unknown, math.inf, glass).min()), float(np.where(unknown, -math.inf, glass).max())


def thickness_range(lens: Lens, edge: np.ndarray | None = None, grid: int = GRID_POINTS) -> tuple[float, float]:
    """Return the minimum and maximum `thickness` (mm); edge: as in `heights`; grid: points per side."""
    return _range(thickness(lens, points_on(lens.back, *_places(lens, edge, grid))))


def heights(lens: Lens, edge: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return z (mm) of the front and of the back at points all over the outline, including the rim.

    edge: corners (n, 2) in mm of a polygon, once around, in place of the outline, for a lens that was cut smaller.
    """
    x, y, z = points_on(lens.back, *_places(lens, edge)).T
    return sag(lens.front, x, y), z


def _places(lens: Lens, edge: np.ndarray | None, grid: int = GRID_POINTS) -> tuple[Tensor, Tensor]:
    """Return x and y (mm), in the back's chart, of points inside the outline, or inside an edge in a flat chart."""
    return _points(lens.outline, grid) if edge is None or not lens.back.chart.flat else _points_in(edge)


def _points(outline: Outline, n: int) -> tuple[Tensor, Tensor]:
    """Return x and y (mm) of 4 n points of the rim, and of the points of an n x n grid inside the outline."""
    x, y = (torch.cat(pair) for pair in zip(sample_rim(outline, n), inside(outline, n), strict=True))
    return x, y


def _points_in(polygon: np.ndarray) -> tuple[Tensor, Tensor]:
    """Return x and y (mm) of the corners (n, 2) of a polygon, and of a grid inside it."""
    import shapely

    axes = (np.linspace(low, high, GRID_POINTS) for low, high in zip(polygon.min(0), polygon.max(0), strict=True))
    grid = [axis.ravel() for axis in np.meshgrid(*axes)]
    area = shapely.Polygon(polygon)
    shapely.prepare(area)
    within = shapely.contains_xy(area, *grid)
    x, y = (np.concatenate([corner, p[within]]) for corner, p in zip(polygon.T, grid, strict=True))
    return torch.from_numpy(x), torch.from_numpy(y)


def inside(outline: Outline, n: int) -> tuple[Tensor, Tensor]:
    """Return x and y (mm) of the points of an n x n grid over the bounding box that are inside the outline."""
    axes = (torch.linspace(-half, half, n, dtype=torch.float64) for half in outline.half_extent)
    x, y = torch.meshgrid(*axes, indexing="ij")
    within = outline.contains(x, y)
    return (x.reshape(-1), y.reshape(-1)) if bool(within.all()) else (x[within], y[within])


@dataclass(frozen=True, eq=False)
class Ripple:
    """Ripple of a face: waves from control point to control point."""

    heights: np.ndarray  # ripple of the control points (m, n), mm; fades towards the rim of the net
    height: float  # RMS height over the face, without the fading (mm)
    slope: float  # RMS slope over the face, without the fading (rad)
    fading: float  # RMS of the factor by which `heights` fade


def ripple(face: BSplineSurface) -> Ripple:
    """Return the ripple of a face: the part of its highest octave that a smooth net does not have.

    The octaves are computed from the net minus its best cubic polynomial, times a Hann window (sin² from rim to rim).
    (Without the window the kink of a smooth net along its rim may give the highest octave some hundred µrad.)  With E
    the slope energy of the highest octave, E' that of the octave below, the ripple has E - SMOOTH_RATIO E', at least 0.
    Mean squares over the face follow from overlaps of the basis functions of degree 2 and of their slopes.
    """
    fading = np.outer(*(np.sin(np.pi * (np.arange(count) + 0.5) / count) ** 2 for count in face.shape))
    rest = _without_cubic(face)
    waves = scipy.fft.dctn(rest * fading, norm="ortho")
    energy, octave = _energy(face, waves), _octave(face)
    waves[(octave != 0) | (energy == 0)] = 0.0
    top, below = energy[octave == 0].sum(), energy[octave == 1].sum()
    share = max(0.0, 1 - SMOOTH_RATIO * below / top) if top > 0 else 0.0
    turns = [np.cos(np.pi * np.arange(count) / count) for count in face.shape]
    (of_x, of_y), (along_x, along_y) = (
        [(16 + 13 * turn + turn**2) / 30 for turn in turns],
        [(2 - 2 * turn) / pitch**2 * (2 + turn) / 3 for turn, pitch in zip(turns, face.pitch, strict=True)],
    )
    squares = share * waves**2 / (fading**2).sum()
    slope = math.sqrt((squares * (np.outer(along_x, of_y) + np.outer(of_x, along_y))).sum())
    height = math.sqrt((squares * np.outer(of_x, of_y)).sum())
    heights = math.sqrt(share) * scipy.fft.idctn(waves, norm="ortho")
    return Ripple(heights, height, slope, fading=math.sqrt((fading**2).mean()))


def slope_octaves(face: BSplineSurface) -> np.ndarray:
    """Return the slope energy of the control net by octaves of frequency, coarse to fine (mm², squared differences).

    It is Σ λ |ĥ|² over the cosine transform ĥ of the net minus its best cubic polynomial (the even continuation of a
    tilt has kinks), λ the eigenvalue of the negative Laplacian.  Octave k, 0 the finest, has the frequencies whose
    larger index is in (m / 2^(k+1), m / 2^k], for m points on the longer side; the other's indices are scaled to m.
    """
    energy, octave = _energy(face, scipy.fft.dctn(_without_cubic(face), norm="ortho")), _octave(face)
    return np.array([energy[octave == k].sum() for k in reversed(range(int(np.log2(max(face.shape)))))])


@lru_cache(maxsize=2)  # a verification needs it three times for each of up to two faces
def _without_cubic(face: BSplineSurface) -> np.ndarray:
    """Return the heights (m, n) of the control points minus their best cubic polynomial (mm)."""
    u, v = (np.linspace(-1, 1, count) for count in face.shape)
    columns = np.stack([np.outer(u**i, v**j).ravel() for i in range(4) for j in range(4 - i)], axis=1)
    h = face.heights.detach().cpu().double().numpy().ravel()
    return (h - columns @ least_squares(columns, h)).reshape(face.shape)


def _energy(face: BSplineSurface, waves: np.ndarray) -> np.ndarray:
    """Return the slope energy (m, n), mm², of cosines of a net with amplitudes `waves` (mm); 0 where it is rounding."""
    along_x, along_y = (2 - 2 * np.cos(np.pi * np.arange(count) / count) for count in face.shape)
    energy = (along_x[:, None] + along_y) * waves**2
    rounding = HEIGHT_ROUNDING * (abs(face.z) + float(face.heights.abs().max()))
    return np.where(energy < rounding**2, 0.0, energy)


def _octave(face: BSplineSurface) -> np.ndarray:
    """Return the number of the octave of each cosine of a net, (m, n); 0 is the highest octave."""
    m = max(face.shape)
    larger = np.maximum(*(index * (m / count) for index, count in zip(np.indices(face.shape), face.shape, strict=True)))
    return np.floor(np.log2(m / np.maximum(larger, 0.5))).astype(int)


def least_squares(columns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the least-squares coefficients (k,) of columns (n, k) for values (n,).

    The normal equations of columns scaled to length 1 are solved, and solved again for the residual.  For columns that
    are not nearly dependent this is as accurate as a singular value decomposition, and several times faster.
    """
    lengths = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    normal = columns.T @ columns / np.outer(lengths, lengths)
    found = np.zeros(len(lengths))
    for _ in range(2):
        found += np.linalg.solve(normal, columns.T @ (values - columns @ found) / lengths) / lengths
    return found


def departure(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> float:
    """Return the peak-to-valley departure (mm) of a face from its best sphere, which may be a plane.

    Least squares of P = h - k (x² + y² + h²) - a x - b y - d, h = z - mean.  P = 0 is a sphere of curvature 2 k / n,
    n² = 1 + a² + b² - 4 k d; its distance from a point is 2 P / (n + sqrt(n² - 4 k P)) (Pratt 1987).
    """
    h = z - z.mean()
    columns = np.stack([x**2 + y**2 + h**2, x, y, np.ones_like(x)], axis=1)
    k, a, b, d = found = least_squares(columns, h)
    p = h - columns @ found
    n2 = 1 + a * a + b * b - 4 * k * d
    return float(np.ptp(2 * p / (np.sqrt(n2) + np.sqrt(np.maximum(n2 - 4 * k * p, 0.0)))))


# --- machinability: the smallest radii and the steepest slope ---------------------------------------------------------


@dataclass(frozen=True)
class Extreme:
    """Extreme of a quantity over a face."""

    largest: float  # largest value; for a radius, the radius of the largest curvature
    where: str  # position, as text
    at_bound: float  # fraction of the area that is at the bound; 0 without a bound


@dataclass(frozen=True)
class Survey:
    """Extremes of a face, seen from outside the lens."""

    concave: Extreme  # smallest principal radius of a valley (mm), in `largest`; MAX_RADIUS if there is no valley
    convex: Extreme  # smallest principal radius of a ridge (mm), in `largest`; MAX_RADIUS if there is no ridge
    slope: Extreme  # largest angle of the tangent plane to z = const (degrees)


def survey(
    lens: Lens,
    face: str = BACK,
    *,
    concave: float | None = None,
    convex: float | None = None,
    slope: float | None = None,
) -> Survey:
    """Find the extremes of a freeform face, seen from outside: from +z the highest, from -z any other.

    concave, convex: smallest radii (mm), slope: largest angle (degrees) allowed.  From -z a ridge of z is a valley.
    """
    if face != lens.faces[-1].name:
        turned = lens.with_back(lens.face(face).surface)
        from_above = survey(turned, concave=convex, convex=concave, slope=slope)
        return replace(from_above, concave=from_above.convex, convex=from_above.concave)
    lens = lens.plain()
    back = lens.back_net
    if not back.chart.flat:
        valley, ridge, steep = (
            Extreme(value, f"at ({', '.join(f'{p:.4g}' for p in place)}) mm", 0.0)
            for value, place in extremes(require_radial(back), lens.outline)
        )
        return Survey(_radius(valley), _radius(ridge), steep)
    x, y, along_x, along_y = _grid(back)
    valleys, ridges = (math.inf if radius is None else AT_BOUND * (1 / radius) for radius in (concave, convex))
    near = (valleys, ridges, math.inf if slope is None else AT_BOUND * math.tan(math.radians(slope)))
    limits, net = lens.outline.scaled(1 + OUTLINE_ROUNDING).limits, back.heights.contiguous().numpy()
    found, place, count = spline.largest_bending(net, (along_x, along_y), (x, y), limits=limits, bounds=near)
    each = math.prod(back.pitch) / len(QUARTERS) ** 2 / lens.outline.area
    valley, ridge, steep = (
        Extreme(float(value), _position_text(x.flat[i], y.flat[j]), min(each * float(n), 1.0))
        for value, (i, j), n in zip(found, place, count, strict=True)
    )
    return Survey(_radius(valley), _radius(ridge), _angle(lens, steep))


def _grid(back: BSplineSurface) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the grid for spline.largest_bending: x and y (mm), and the weights along x and along y.

    The points lie at QUARTERS of each span; x, y: (spans, points).  weights: see spline.largest_bending.
    """
    spans = [torch.arange(count - 2) for count in back.shape]
    points = span_points(back, spans[0], spans[1], QUARTERS)
    x, y = (at.reshape(len(QUARTERS), -1).T.contiguous().numpy() for at in points)
    scaled = []
    for span, count, pitch in zip(spans, back.shape, back.pitch, strict=True):
        by_quarter = [torch.stack([torch.stack(order) for order in weights(span, count, s)]) for s in QUARTERS]
        of_unit = torch.stack(by_quarter).permute(3, 0, 1, 2)  # (span, quarter, derivative, control point)
        scale = torch.tensor([1.0, 1 / pitch, 1 / pitch**2], dtype=torch.float64)[:, None]
        scaled.append((of_unit * scale).reshape(len(span), len(QUARTERS), 9).contiguous().numpy())
    return x, y, scaled[0], scaled[1]


def _radius(bend: Extreme) -> Extreme:
    return replace(bend, largest=1 / bend.largest if bend.largest > MIN_CURVATURE else MAX_RADIUS)


def _angle(lens: Lens, slope: Extreme) -> Extreme:
    """Return the largest slope of the back, rim included, in degrees; slope: largest tangent on the grid."""
    x, y = sample_rim(lens.outline, GRID_POINTS)
    _, z_x, z_y = lens.back.sag_and_slope(x, y)
    steep = torch.hypot(z_x, z_y)
    if (largest := float(steep.max())) > slope.largest:
        at = int(steep.argmax())
        slope = replace(slope, largest=largest, where=_position_text(float(x[at]), float(y[at])))
    return replace(slope, largest=math.degrees(math.atan(slope.largest)))


def _position_text(x: float, y: float) -> str:
    return f"at ({x:.4g}, {y:.4g}) mm"
