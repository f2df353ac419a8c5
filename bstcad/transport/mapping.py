"""The optimal transport map as a function, source point (mm) -> target point (mm), and its inverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import prange
from numpy.typing import ArrayLike

from bstcad.runs.kernel_cache import compiled_kernel
from bstcad.transport.bfm import Listener, Transport, back_and_forth, half_square, ladder, legendre
from bstcad.transport.density import Density, gradient_at_corners
from bstcad.transport.monge_ampere import ROUGH_MASS_ERROR, MongeAmpere, corners, newton_on_grids

FLOOR = 1e-3  # smallest density of a target, relative to its mean: maps of tubes need a positive target
FALLING_FLOORS = (0.03, 0.01, 0.003)  # floors, relative to the mean, used one after another before FLOOR on rough maps
BACK_AND_FORTH_CELLS = 64  # cells per side to which the grid is halved, while even, for the back-and-forth method
STEPS_PER_GRID = 8  # largest number of Newton steps on each grid; MAX_STEPS_FACTOR times as many on a rough map
MAX_MAP_NODES = 257  # largest number of points per side of a TransportMap: 0.5 MB
INVERTED_TOGETHER = 4096  # number of points that a thread inverts at a time

Points = tuple[np.ndarray, np.ndarray]  # x and y of points, of one shape


@dataclass(frozen=True)
class Frame:
    """Position of the unit square in a plane; its sides lie along x and y."""

    centre: tuple[float, float] = (0.5, 0.5)  # centre of the square in the plane (mm)
    side: float = 1.0  # length of a side (mm)

    def to_unit(self, x: ArrayLike, y: ArrayLike) -> Points:
        """Return points (mm) in coordinates of the unit square."""
        return (np.asarray(x) - self.centre[0]) / self.side + 0.5, (np.asarray(y) - self.centre[1]) / self.side + 0.5

    def from_unit(self, x: np.ndarray, y: np.ndarray) -> Points:
        """Return points of the unit square in mm."""
        return self.centre[0] + self.side * (x - 0.5), self.centre[1] + self.side * (y - 0.5)


@dataclass(frozen=True)
class Mapping:
    """The optimal map T and its inverse S = ∇v (monge_ampere.py), stored as S at the pixel corners of the target.

    S is bilinear inside a pixel, and T(x) is the solution y of S(y) = x, to rounding (`solve_point`).  T sends the
    flux of a tube, the image of a pixel under S, exactly into this pixel.  Points outside a frame are moved to its
    border.
    """

    x: np.ndarray  # (n + 1, n + 1), x of S at pixel corners, cell units of the source frame
    y: np.ndarray  # (n + 1, n + 1), y of S at pixel corners, cell units of the source frame
    guess_x: np.ndarray  # (n + 1, n + 1), x of T at source cell corners, error about a cell, cell units of target frame
    guess_y: np.ndarray  # (n + 1, n + 1), y of T at source cell corners
    source: Density
    target: Density  # target, raised to the floor
    source_frame: Frame
    target_frame: Frame
    transport: Transport  # potentials and history of the solve

    def __call__(self, x: ArrayLike, y: ArrayLike) -> Points:
        """Return the target points (mm) of source points (mm), of any shape."""
        n = self.source.n
        at = np.clip(np.stack(self.source_frame.to_unit(*np.broadcast_arrays(x, y))) * n, 0.0, n)
        out = np.empty((2, at[0].size))
        _invert(self.transport.phi * n**2, self.x, self.y, self.guess_x, self.guess_y, at.reshape(2, -1), out)
        return self.target_frame.from_unit(*(out / n).reshape(at.shape))

    def inverse(self, x: ArrayLike, y: ArrayLike) -> Points:
        """Return the source points (mm) of target points (mm), of any shape."""
        n = self.source.n
        at = np.clip(np.stack(self.target_frame.to_unit(*np.broadcast_arrays(x, y))) * n, 0.0, n)
        out = np.empty((2, at[0].size))
        _forward(self.x, self.y, at.reshape(2, -1), out)
        return self.source_frame.from_unit(*(out / n).reshape(at.shape))


AT_FACE, AT_ENTRANCE = "back", "entrance"  # values of TransportMap.plane, as files name them


@dataclass(frozen=True)
class TransportMap:
    """Origin of the light of each point of a target: the inverse of the transport map of stage 1.

    The points are corners of the target's pixels: all, or at most MAX_MAP_NODES per side at about even spacing.  The
    light between four neighbours in `source` is the flux of the target between the same four in `target`, except for
    the floor (mapping.FLOOR) in dark parts.  Stages 2 and 3 change the lens afterwards, but not the map.
    """

    x: np.ndarray  # (c,) x on the target in its receiver's unit, ascending, float64
    y: np.ndarray  # (r,) y on the target in its receiver's unit, ascending, float64
    source: np.ndarray  # (c, r, 2) float32, x and y (mm) in the scene's frame where the light for (x, y) passes `plane`
    # AT_FACE: the last tailored face along the light, which is the front if only the front is tailored, or for a mirror
    # behind glass.  AT_ENTRANCE: the plane z = const through the vertex of the first face, where the map of Wang et al.
    # begins (tailoring.method "adam" and "integration", and strong lenses near the source)
    plane: str

    @property
    def target(self) -> np.ndarray:
        """Points (x, y) on the target, (c, r, 2), in its receiver's unit."""
        return np.stack(np.meshgrid(self.x, self.y, indexing="ij"), axis=-1)


def nodes(pixels: int) -> np.ndarray:
    """Return the indices, from 0 to `pixels`, of the pixel corners along an axis that a TransportMap stores."""
    return np.unique(np.linspace(0, pixels, min(pixels + 1, MAX_MAP_NODES)).round().astype(int))


@dataclass(frozen=True)
class Solver:
    """Settings of `solve`."""

    iterations: int = 40  # largest number of iterations of the back-and-forth method on each grid
    tolerance: float = 2e-3  # mass error (mean |flux - target|, both of mean 1) at which the solve has converged
    floors: tuple[float, ...] = FALLING_FLOORS  # floors of the target, relative to its mean, used before FLOOR
    progress: Listener = None  # called after each iteration; None: not called


def solve(
    source: Density,
    target: Density,
    source_frame: Frame = Frame(),
    target_frame: Frame = Frame(),
    solver: Solver = Solver(),
    sharper: Sequence[Density] = (),
) -> Mapping:
    """Return the optimal map: back-and-forth on a coarse grid, then Newton's method on flux tubes up to the finest.

    If the grid does not allow the tolerance, `transport.reason` is "plateau".  `mapping.target` is the target raised to
    FLOOR times its mean.  If the mass error exceeds ROUGH_MASS_ERROR, as for a bright rim beside black, a second
    solution, kept if better, has the solver's first floor on all grids, then its others and FLOOR on the last grid.
    sharper: sources of increasing detail, with which Newton's method continues on the last grid as long as the mass
    error stays below ROUGH_MASS_ERROR; `mapping.source` is the last of them that succeeded.
    """
    first = partial(back_and_forth, iterations=solver.iterations, tolerance=solver.tolerance, progress=solver.progress)
    newton = partial(newton_on_grids, steps=STEPS_PER_GRID, tolerance=solver.tolerance, progress=solver.progress)

    def solve_on_grids(floor: float) -> tuple[np.ndarray, list[float], str]:
        grids = ladder(source, target.lifted(floor), BACK_AND_FORTH_CELLS)
        return newton(grids, first(*grids[0]).phi * grids[0][0].n ** 2)

    phi, errors, reason = solve_on_grids(FLOOR)
    if errors[-1] > ROUGH_MASS_ERROR:
        other, *_ = solve_on_grids(solver.floors[0])
        for floor in (*solver.floors[1:], FLOOR):
            other, left, why = newton([(source, target.lifted(floor))], other, blur=0.0)
        if left[-1] < errors[-1]:
            phi, errors, reason = other, left, why
    for sharp in sharper:
        other, left, why = newton([(sharp, target.lifted(FLOOR))], phi, blur=0.0)
        if left[-1] > ROUGH_MASS_ERROR:
            break
        phi, errors, reason, source = other, left, why, sharp
    target, n = target.lifted(FLOOR), source.n
    half = half_square(n)
    u = legendre(half - phi)
    dual = float(((half - u) * source.values).mean() + (phi * target.values).mean()) / n**2
    count = len(errors) - 1
    transport = Transport(phi / n**2, (half - u) / n**2, tuple(errors), (dual,), iterations=count, reason=reason)
    return Mapping(*corners(phi), *gradient_at_corners(u), source, target, source_frame, target_frame, transport)


def mass_error(mapping: Mapping) -> float:
    """Return mean |F - nu| over the target's pixels; F: source flux through each pixel's tube; both have mean 1."""
    flux = MongeAmpere(mapping.source, mapping.target).flux(mapping.transport.phi * mapping.source.n**2)
    return float(np.abs(flux - mapping.target.values).mean())


@compiled_kernel()
def _bilinear(s, i, j, a, b):
    """Return s, interpolated bilinearly, at (i + a, j + b)."""
    return (1 - a) * ((1 - b) * s[i, j] + b * s[i, j + 1]) + a * ((1 - b) * s[i + 1, j] + b * s[i + 1, j + 1])


@compiled_kernel(parallel=True)
def _forward(sx, sy, points, out):
    n, px, py = sx.shape[0] - 1, points[0], points[1]
    for k in prange(px.size):
        if px[k] != px[k] or py[k] != py[k]:
            out[:, k] = np.nan
            continue
        i, j = min(int(px[k]), n - 1), min(int(py[k]), n - 1)
        a, b = px[k] - i, py[k] - j
        out[0, k] = _bilinear(sx, i, j, a, b)
        out[1, k] = _bilinear(sy, i, j, a, b)


@compiled_kernel()
def _residual(sx, sy, x, y, p, q):
    """Return (x, y) - S(p, q) and ∂S_x/∂p, ∂S_x/∂q, ∂S_y/∂p, ∂S_y/∂q; S: (sx, sy), bilinear at array indices p, q."""
    i, j = min(int(p), sx.shape[0] - 2), min(int(q), sx.shape[1] - 2)
    a, b = p - i, q - j
    ex, ey = sx[i + 1, j] - sx[i, j], sy[i + 1, j] - sy[i, j]
    fx, fy = sx[i, j + 1] - sx[i, j], sy[i, j + 1] - sy[i, j]
    tx = sx[i + 1, j + 1] - sx[i, j + 1] - ex
    ty = sy[i + 1, j + 1] - sy[i, j + 1] - ey
    rx = x - (sx[i, j] + a * ex + b * (fx + a * tx))
    ry = y - (sy[i, j] + a * ey + b * (fy + a * ty))
    return rx, ry, ex + b * tx, fx + a * tx, ey + b * ty, fy + a * ty


@compiled_kernel()
def solve_point(sx, sy, x, y, p, q):
    """Return (p, q) where S = (sx, sy) is (x, y), and True if found outside a fold; Levenberg-Marquardt from (p, q)."""
    rows, columns = sx.shape[0] - 1.0, sx.shape[1] - 1.0
    rx, ry, a, b, c, d = _residual(sx, sy, x, y, p, q)
    residual2 = rx * rx + ry * ry
    damping = 0.0
    for _ in range(60):
        if residual2 < 1e-22:
            break
        # (JᵀJ + damping) step = Jᵀ r
        g, h = a * rx + c * ry, b * rx + d * ry
        aa, ab, bb = a * a + c * c + damping, a * b + c * d, b * b + d * d + damping
        det = aa * bb - ab * ab
        if det <= 1e-300:
            damping = 1e-6 + 4.0 * damping
            continue
        dp, dq = (bb * g - ab * h) / det, (aa * h - ab * g) / det
        reach = max(abs(dp), abs(dq))
        if reach > 4.0:  # pixels; further away the linear model fails
            dp, dq = 4.0 * dp / reach, 4.0 * dq / reach
        tp, tq = min(max(p + dp, 0.0), rows), min(max(q + dq, 0.0), columns)
        tx, ty, ta, tb, tc, td = _residual(sx, sy, x, y, tp, tq)
        trial2 = tx * tx + ty * ty
        if trial2 < residual2:
            p, q, rx, ry, a, b, c, d, residual2 = tp, tq, tx, ty, ta, tb, tc, td, trial2
            damping *= 0.1
        else:
            damping = max(1e-4 * (aa + bb), 8.0 * damping)
            if damping > 1e6 * (aa + bb):
                break
    return p, q, residual2 < 1e-16 and a * d - b * c > 0.0


@compiled_kernel()
def _best_pixel(phi, x, y, p, q):
    """Return the centre of the pixel with the largest phi(y) - |x - y|²/2, by steps of up to two pixels from (p, q)."""
    n = phi.shape[0]
    i, j = min(int(p), n - 1), min(int(q), n - 1)
    best = phi[i, j] - 0.5 * ((i + 0.5 - x) ** 2 + (j + 0.5 - y) ** 2)
    for _ in range(2 * n):
        bi, bj = i, j
        for k in range(max(i - 2, 0), min(i + 3, n)):
            for m in range(max(j - 2, 0), min(j + 3, n)):
                value = phi[k, m] - 0.5 * ((k + 0.5 - x) ** 2 + (m + 0.5 - y) ** 2)
                if value > best:
                    best, bi, bj = value, k, m
        if bi == i and bj == j:
            break
        i, j = bi, bj
    return i + 0.5, j + 0.5


@compiled_kernel(parallel=True)
def _invert(phi, sx, sy, gx, gy, points, out):
    n, px, py = sx.shape[0] - 1, points[0], points[1]
    for block in prange((px.size + INVERTED_TOGETHER - 1) // INVERTED_TOGETHER):
        for k in range(block * INVERTED_TOGETHER, min(px.size, (block + 1) * INVERTED_TOGETHER)):
            if px[k] != px[k] or py[k] != py[k]:
                out[:, k] = np.nan
                continue
            i, j = min(int(px[k]), n - 1), min(int(py[k]), n - 1)
            a, b = px[k] - i, py[k] - j
            p, q = _bilinear(gx, i, j, a, b), _bilinear(gy, i, j, a, b)
            tp, tq, regular = solve_point(sx, sy, px[k], py[k], p, q)
            if not regular:  # a fold of S: start from the best pixel of the potential, which is never in a fold
                cp, cq = _best_pixel(phi, px[k], py[k], p, q)
                tp, tq, regular = solve_point(sx, sy, px[k], py[k], cp, cq)
                if not regular:
                    tp, tq = cp, cq
            out[0, k], out[1, k] = tp, tq


def grid_coordinates(grid_x: np.ndarray, grid_y: np.ndarray, x: np.ndarray, y: np.ndarray) -> Points:
    """Return the fractional (row, column) of points x, y (m, n) in a grid of points (mm), clipped to the grid."""
    per_mm = (max(grid_x.shape) - 1) / max(np.ptp(grid_x), np.ptp(grid_y))
    out = np.empty((2, *x.shape))
    grid_x, grid_y, x, y = (np.ascontiguousarray(per_mm * p) for p in (grid_x, grid_y, x, y))
    _search(grid_x, grid_y, x, y, out)
    return out[0], out[1]


@compiled_kernel(parallel=True)
def _search(grid_x, grid_y, x, y, out):
    """Solve point by point along rows, from the neighbour's solution or the position in an evenly spaced grid."""
    rows, columns = grid_x.shape[0] - 1.0, grid_x.shape[1] - 1.0
    left, low = grid_x.min(), grid_y.min()
    wide, high = grid_x.max() - left, grid_y.max() - low
    for k in prange(x.shape[0]):
        near = False
        p, q = 0.0, 0.0
        for j in range(x.shape[1]):
            found = False
            if near:
                p, q, found = solve_point(grid_x, grid_y, x[k, j], y[k, j], p, q)
            if not found:
                p = min(max((x[k, j] - left) / wide, 0.0), 1.0) * rows
                q = min(max((y[k, j] - low) / high, 0.0), 1.0) * columns
                p, q, found = solve_point(grid_x, grid_y, x[k, j], y[k, j], p, q)
            near = found
            out[0, k, j], out[1, k, j] = p, q
