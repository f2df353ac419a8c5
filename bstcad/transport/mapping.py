"""The optimal map as a record to call: source point (mm) -> target point (mm), and its inverse."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike

from bstcad.transport.bfm import Step, Transport, back_and_forth, half_square, ladder, legendre
from bstcad.transport.density import Density, gradient_at_corners
from bstcad.transport.monge_ampere import ROUGH, MongeAmpere, climb, corners

FLOOR = 1e-3  # of the mean: a darker target is lifted to this, since no gradient of a convex function can avoid a hole
FALLING = (0.03, 0.01, 0.003)  # of the mean: floors of that solve, before FLOOR
COARSE = 64  # cells a side up to which the back-and-forth method runs; Newton takes over from there
NEWTON_STEPS = 8  # the most on each grid
NODES = 257  # the most points a side of a TransportMap: 0.5 MB
CHUNK = 4096  # points a thread takes at a time


@dataclass(frozen=True)
class Frame:
    """Where the unit square lies: centre and side, mm; axes along x and y."""

    centre: tuple[float, float] = (0.5, 0.5)  # mm
    side: float = 1.0  # mm

    def to_unit(self, x: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """mm -> unit square."""
        return (np.asarray(x) - self.centre[0]) / self.side + 0.5, (np.asarray(y) - self.centre[1]) / self.side + 0.5

    def from_unit(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit square -> mm."""
        return self.centre[0] + self.side * (x - 0.5), self.centre[1] + self.side * (y - 0.5)


@dataclass(frozen=True)
class Mapping:
    """The optimal map T and its inverse S = ∇v, held as S at the target's pixel corners.

    S is bilinear inside a pixel; T(x) solves S(y) = x by Newton, so T sends exactly the flux of each tube into its
    pixel and the two are inverse to each other to rounding.  Points outside a frame are first moved to its rim.
    """

    x: np.ndarray  # (n + 1, n + 1), S at pixel corners, cell units of the source frame
    y: np.ndarray  # likewise
    guess_x: np.ndarray  # (n + 1, n + 1), T at source cell corners to about a cell, cell units of the target frame
    guess_y: np.ndarray  # likewise
    source: Density
    target: Density  # with the floor it was solved for
    source_frame: Frame
    target_frame: Frame
    transport: Transport

    def __call__(self, x: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Source point (mm, any shape) -> target point (mm, the same shape)."""
        n = self.source.n
        px, py = (np.clip(a * n, 0.0, n) for a in self.source_frame.to_unit(*np.broadcast_arrays(x, y)))
        out = np.empty((2, px.size))
        _invert(self.transport.phi * n**2, self.x, self.y, self.guess_x, self.guess_y, px.ravel(), py.ravel(), out)
        return self.target_frame.from_unit(*(out / n).reshape(2, *px.shape))

    def inverse(self, x: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Target point (mm, any shape) -> source point (mm, the same shape)."""
        n = self.source.n
        px, py = (np.clip(a * n, 0.0, n) for a in self.target_frame.to_unit(*np.broadcast_arrays(x, y)))
        out = np.empty((2, px.size))
        _forward(self.x, self.y, px.ravel(), py.ravel(), out)
        return self.source_frame.from_unit(*(out / n).reshape(2, *px.shape))


@dataclass(frozen=True)
class TransportMap:
    """The origin of the light for each point of a target: the inverse of the map that stage 1 of a design followed.

    The points are corners of the target's pixels: all of them, or NODES a side, about evenly.  The quadrilateral of
    four neighbours in `source` sends the target's flux between the same four in `target`, but for FLOOR of the mean
    in the target's dark parts.  Stages 2 and 3 change the lens afterwards; this map stays that of stage 1.
    """

    x: np.ndarray  # (c,) mm on the target plane, ascending, float64
    y: np.ndarray  # (r,) mm on the target plane, ascending, float64
    source: np.ndarray  # (c, r, 2) float32, x and y (mm) in the scene's frame where the light for (x, y) passes `plane`
    # "back": the last tailored face in the order of the light, which is the front of a lens whose front is tailored
    # alone and of a mirror behind glass.  "entrance": the plane z = const through the vertex of the face that
    # light meets first, where Wang et al.'s own map begins (tailoring.method "adam" and "integration", strong lenses
    # near the source)
    plane: str

    @property
    def target(self) -> np.ndarray:
        """(c, r, 2) x and y (mm) on the target plane."""
        return np.stack(np.meshgrid(self.x, self.y, indexing="ij"), axis=-1)


def nodes(pixels: int) -> np.ndarray:
    """Which of the corners 0, …, pixels of a row of pixels a TransportMap has."""
    return np.unique(np.linspace(0, pixels, min(pixels + 1, NODES)).round().astype(int))


def solve(
    source: Density,
    target: Density,
    source_frame: Frame = Frame(),
    target_frame: Frame = Frame(),
    *,
    iterations: int = 40,
    tolerance: float = 2e-3,
    falling: tuple[float, ...] = FALLING,
    sharper: Sequence[Density] = (),
    progress: Callable[[Step], None] | None = None,
) -> Mapping:
    """The map that carries source to target: back-and-forth on a coarse grid, then Newton on ray tubes to the finest.

    iterations: of the back-and-forth method, on each of its grids.  tolerance: mass error (mean |F - nu|, both of
    mean 1) at which the solve has converged; where the grid allows no less, `transport.reason` is "plateau".
    A target with zeros is lifted to FLOOR of its mean; `mapping.target` is the lifted one.  Where a bright rim ends in
    black, Newton's first step on a grid would fold the map: there the floor is high first, and falls on the last grid.
    falling: these floors, of the mean.
    sharper: sources of ever more detail, to which the map is carried on by Newton's method on the last grid, as long as
    its mass error stays below ROUGH; `mapping.source` is the last one of them that it reaches.
    """
    newton = partial(climb, steps=NEWTON_STEPS, tolerance=tolerance, progress=progress)

    def climbed(floor: float) -> tuple[np.ndarray, list[float], str]:
        grids = ladder(source, target.lifted(floor), COARSE)
        phi = back_and_forth(*grids[0], iterations=iterations, tolerance=tolerance, progress=progress).phi
        return newton(grids, phi * grids[0][0].n ** 2)

    phi, errors, reason = climbed(FLOOR)
    if errors[-1] > ROUGH:
        other, *_ = climbed(falling[0])
        for floor in (*falling[1:], FLOOR):
            other, left, why = newton([(source, target.lifted(floor))], other, smoothing=0.0)
        if left[-1] < errors[-1]:
            phi, errors, reason = other, left, why
    for sharp in sharper:
        other, left, why = newton([(sharp, target.lifted(FLOOR))], phi, smoothing=0.0)
        if left[-1] > ROUGH:
            break
        phi, errors, reason, source = other, left, why, sharp
    target, n = target.lifted(FLOOR), source.n
    half = half_square(n)
    u = legendre(half - phi)
    dual = float(((half - u) * source.values).mean() + (phi * target.values).mean()) / n**2
    transport = Transport(
        phi / n**2, (half - u) / n**2, mass_error=tuple(errors), dual=(dual,), iterations=len(errors) - 1, reason=reason
    )
    x, y = corners(phi)
    guess_x, guess_y = gradient_at_corners(u)
    return Mapping(
        x, y, guess_x, guess_y, source=source, target=target, source_frame=source_frame, target_frame=target_frame,
        transport=transport,
    )  # fmt: skip


def mass_error(mapping: Mapping) -> float:
    """mean |F - nu| over the target's pixels, F the source flux through each pixel's tube; both have mean 1."""
    flux = MongeAmpere(mapping.source, mapping.target).flux(mapping.transport.phi * mapping.source.n**2)
    return float(np.abs(flux - mapping.target.values).mean())


@njit(cache=True, nogil=True)
def _bilinear(s, i, j, a, b):
    """s at (i + a, j + b)."""
    return (1 - a) * ((1 - b) * s[i, j] + b * s[i, j + 1]) + a * ((1 - b) * s[i + 1, j] + b * s[i + 1, j + 1])


@njit(cache=True, nogil=True, parallel=True)
def _forward(sx, sy, px, py, out):
    n = sx.shape[0] - 1
    for k in prange(px.size):
        if px[k] != px[k] or py[k] != py[k]:
            out[:, k] = np.nan
            continue
        i, j = min(int(px[k]), n - 1), min(int(py[k]), n - 1)
        a, b = px[k] - i, py[k] - j
        out[0, k] = _bilinear(sx, i, j, a, b)
        out[1, k] = _bilinear(sy, i, j, a, b)


@njit(cache=True, nogil=True)
def _residual(sx, sy, x, y, p, q):
    """x - S(p, q) and the four derivatives of S there."""
    i, j = min(int(p), sx.shape[0] - 2), min(int(q), sx.shape[1] - 2)
    a, b = p - i, q - j
    ex, ey = sx[i + 1, j] - sx[i, j], sy[i + 1, j] - sy[i, j]
    fx, fy = sx[i, j + 1] - sx[i, j], sy[i, j + 1] - sy[i, j]
    tx = sx[i + 1, j + 1] - sx[i, j + 1] - ex
    ty = sy[i + 1, j + 1] - sy[i, j + 1] - ey
    rx = x - (sx[i, j] + a * ex + b * (fx + a * tx))
    ry = y - (sy[i, j] + a * ey + b * (fy + a * ty))
    return rx, ry, ex + b * tx, fx + a * tx, ey + b * ty, fy + a * ty


@njit(cache=True, nogil=True)
def solve_point(sx, sy, x, y, p, q):
    """(p, q) with S(p, q) = (x, y): Levenberg-Marquardt, which is ascent on the concave x·y - v(y) where S folds."""
    rows, columns = sx.shape[0] - 1.0, sx.shape[1] - 1.0
    rx, ry, a, b, c, d = _residual(sx, sy, x, y, p, q)
    here = rx * rx + ry * ry
    damping = 0.0
    for _ in range(60):
        if here < 1e-22:
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
        if reach > 4.0:  # pixels: beyond that the linear model says nothing
            dp, dq = 4.0 * dp / reach, 4.0 * dq / reach
        tp, tq = min(max(p + dp, 0.0), rows), min(max(q + dq, 0.0), columns)
        tx, ty, ta, tb, tc, td = _residual(sx, sy, x, y, tp, tq)
        there = tx * tx + ty * ty
        if there < here:
            p, q, rx, ry, a, b, c, d, here = tp, tq, tx, ty, ta, tb, tc, td, there
            damping *= 0.1
        else:
            damping = max(1e-4 * (aa + bb), 8.0 * damping)
            if damping > 1e6 * (aa + bb):
                break
    return p, q, here < 1e-16 and a * d - b * c > 0.0


@njit(cache=True, nogil=True)
def _best_pixel(phi, x, y, p, q):
    """Centre of the pixel that is best for phi(y) - |x - y|²/2, by steps of up to two pixels from (p, q)."""
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


@njit(cache=True, nogil=True, parallel=True)
def _invert(phi, sx, sy, gx, gy, px, py, out):
    n = sx.shape[0] - 1
    for block in prange((px.size + CHUNK - 1) // CHUNK):
        for k in range(block * CHUNK, min(px.size, (block + 1) * CHUNK)):
            if px[k] != px[k] or py[k] != py[k]:
                out[:, k] = np.nan
                continue
            i, j = min(int(px[k]), n - 1), min(int(py[k]), n - 1)
            a, b = px[k] - i, py[k] - j
            p, q = _bilinear(gx, i, j, a, b), _bilinear(gy, i, j, a, b)
            tp, tq, regular = solve_point(sx, sy, px[k], py[k], p, q)
            if not regular:  # a fold: ask the potential itself, whose best pixel is never inside one
                cp, cq = _best_pixel(phi, px[k], py[k], p, q)
                tp, tq, regular = solve_point(sx, sy, px[k], py[k], cp, cq)
                if not regular:
                    tp, tq = cp, cq
            out[0, k], out[1, k] = tp, tq


def places_in(grid_x: np.ndarray, grid_y: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The real row and column of a grid of places (mm) at which it has the points (x, y) (m, n); outside at its rim."""
    per_mm = (max(grid_x.shape) - 1) / max(np.ptp(grid_x), np.ptp(grid_y))
    out = np.empty((2, *x.shape))
    grid_x, grid_y, x, y = (np.ascontiguousarray(per_mm * p) for p in (grid_x, grid_y, x, y))
    _search(grid_x, grid_y, x, y, out)
    return out[0], out[1]


@njit(cache=True, nogil=True, parallel=True)
def _search(grid_x, grid_y, x, y, out):
    """From the neighbour's place, or from where an even grid has it; row by row."""
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
