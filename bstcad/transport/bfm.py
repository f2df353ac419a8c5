"""The back-and-forth method: optimal transport for the cost |x - y|²/2 between two densities on one grid.

Jacobs and Leger 2020, "A fast approach to optimal transport: the back-and-forth method", Numerische Mathematik 146.
Source rho on x, target nu on y, potentials psi(x) and phi(y):

    J(phi) = ∫ phi dnu + ∫ phi^c drho,   T = id - ∇phi^c,   H1 gradient  (-Δ)^-1 (nu - T_# rho)

and likewise for psi.  T_# rho is rho moved by T.  Gradient ascent alternates between phi and psi; the c-transform phi^c
converts one into the other.  The grid limits the accuracy: c-transforms map cell centres to cell centres, so the mass
error levels off at a few per cent, which monge_ampere.py then reduces.

The c-transform is exact, in a time linear in the number of cells.  phi^c(x) = min_y |x - y|²/2 - phi(y) is
|x|²/2 - v*(x), where v* is the Legendre transform of v(y) = |y|²/2 - phi(y).  It separates into transforms of lines:
v*(x1, x2) = max_y1 [x1 y1 + max_y2 (x2 y2 - v(y1, y2))].  Each line needs the lower convex hull of its n values and one
monotone pass over x (Lucet 1997, Numerical Algorithms 16).  The slope of the hull edge before a vertex is the first x
at which this vertex is the maximiser.  These x are stored first, so the pass has no branch that depends on the data.

Poisson's equation (Hockney 1965, "A fast direct solution of Poisson's equation using Fourier analysis", Journal of the
ACM 12): -Δ is the five-point Laplacian on n x n cells with zero normal derivative.  For the k-th term of the cosine
series along the second axis, -Δ is the tridiagonal matrix D + s_k, where D is the negative second difference along the
first axis and s_k = 4 sin²(πk/2n).  The transforms run along contiguous lines of n cells, and the elimination treats
neighbouring columns together, so that memory is never read across lines.

All quantities except `Transport` are in cell units: cell centres at i + 1/2, i = 0 … n-1, potentials in squared cells.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numba import prange

from bstcad.runs.kernel_cache import compiled_kernel
from bstcad.transport.density import BLOCKS, Density, inner, pushforward, threads, threads_for

LINES_PER_BLOCK = 8  # lines transformed together: eight doubles fill a cache line of the transposed output
MIN_CELLS = 32  # number of cells per side above which a coarser grid is solved first (`ladder`)
FIRST_STEP = 1.0  # step length sigma on the coarsest grid; for uniform densities 1 is Newton's step
MIN_FIRST_STEP = 0.25  # smallest initial sigma on a finer grid: noise lowers sigma at the end of a solve
STEP_INCREASE, STEP_DECREASE, REFUSED_STEP_FACTOR = 1.25, 0.8, 0.5  # sigma factors: step too short, too long, refused
MIN_GAIN_RATIO, MAX_GAIN_RATIO = 0.25, 0.75  # Armijo-Goldstein bounds of (gain of J) / (sigma |∇J|²)
PLATEAU_TOLERANCE = 0.005  # relative decrease of the mass error below which the solve is on a plateau
PLATEAU_ITERATIONS = 5  # number of iterations over which the decrease of the mass error is measured
STEP_HALVINGS = 1  # number of halvings of sigma before a plateau stops the solve: the final mass error depends on sigma


def half_square(n: int) -> np.ndarray:
    """Return |x|²/2 at the cell centres, (n, n), in cell units."""
    q = 0.5 * (np.arange(n) + 0.5) ** 2
    return q[:, None] + q[None, :]


def legendre(v: np.ndarray) -> np.ndarray:
    """Return v*(x) = max_y x·y - v(y) over the cell centres y, at the cell centres x; v and v*: (n, n), cell units."""
    partial, conjugate = np.empty_like(v), np.empty_like(v)
    _transform_lines(v, partial, -1.0, BLOCKS)  # maximise over y2: [x2, y1]
    _transform_lines(partial, conjugate, 1.0, BLOCKS)  # maximise over y1: [x1, x2]
    return conjugate


@compiled_kernel(error_model="numpy")
def _line(v, out, hull, slope, first):
    """Compute out[i] = max_j (i + 1/2)(j + 1/2) - v[j]; hull, slope (n) and first (n + 1) are scratch.

    hull: vertices of the lower hull; slope: slope of the edge before each vertex; first[i]: number of the last
    vertex that becomes the maximiser at i, or 0.
    """
    n = v.size
    top = 0
    hull[0] = 0
    for j in range(1, n):
        rise = (v[j] - v[hull[top]]) / (j - hull[top])
        while top > 0 and rise <= slope[top]:
            top -= 1
            rise = (v[j] - v[hull[top]]) / (j - hull[top])
        top += 1
        hull[top], slope[top] = j, rise
    first[:] = 0
    for k in range(1, top + 1):  # i + 1/2 >= slope
        first[np.int64(min(max(np.ceil(slope[k] - 0.5), 0.0), float(n)))] = k
    k = 0
    for i in range(n):
        k = max(k, first[i])
        out[i] = (i + 0.5) * (hull[k] + 0.5) - v[hull[k]]


@compiled_kernel(parallel=True)
def _transform_lines(v, out, sign, blocks):
    """Compute out = `sign` times the transposed matrix of the Legendre transforms of the rows of v."""
    n = v.shape[0]
    for block in prange(blocks):
        hull, slope, first = np.empty(n, np.int64), np.empty(n), np.empty(n + 1, np.int64)
        done = np.empty((LINES_PER_BLOCK, n))
        end = (block + 1) * n // blocks
        for r in range(block * n // blocks, end, LINES_PER_BLOCK):
            lines = min(LINES_PER_BLOCK, end - r)
            for k in range(lines):
                _line(v[r + k], done[k], hull, slope, first)
            for i in range(n):
                for k in range(lines):
                    out[i, r + k] = sign * done[k, i]


class Poisson:
    """Inverse Laplacian (-Δ)^-1 with zero normal derivative; the solution has mean zero."""

    def __init__(self, n: int):
        self.symbol = 4.0 * np.sin(0.5 * np.pi * np.arange(n) / n) ** 2  # s_k, (n,)
        self.pivots = _pivots(self.symbol)
        self.keep, self.share = np.ones(n), np.zeros(n)  # factors in `_eliminate`, (n,)

    def solve(self, r: np.ndarray) -> np.ndarray:
        """Return g with -Δg = r - mean(r), mean(g) = 0; cell units, r and g (n, n)."""
        workers = threads_for(r.shape[0])
        series = scipy.fft.dct(r, axis=1, workers=workers)
        series[:, 0] -= series[:, 0].mean()
        _eliminate(series, np.empty_like(series), self.pivots, self.keep, self.share, BLOCKS)
        series[:, 0] -= series[:, 0].mean()
        return scipy.fft.idct(series, axis=1, workers=workers, overwrite_x=True)


class PoissonWithoutCheckerboard(Poisson):
    """Operator (-Δ)^-1 (1 - D_x D_y / 16), with the negative second differences D_x and D_y along the two axes.

    It removes the checkerboard, for which D_x and D_y are nearly 4.  For a cosine along y, D_y is a number s_y, and
    the operator is (1 + s_y²/16) / (D_x + s_y) - s_y/16, again one elimination.
    """

    def __init__(self, n: int):
        super().__init__(n)
        self.keep, self.share = 1.0 + self.symbol**2 / 16.0, self.symbol / 16.0


def _pivots(s: np.ndarray) -> np.ndarray:
    """Return the inverse pivots (n, n) of D + s_k: row i for the i-th cell of the line, column k for the k-th term.

    A pivot is 1 + e with e_i = s + e_(i-1) / (1 + e_(i-1)), without cancellation; the last pivot, at the boundary, is
    e.  For k = 0 this e is 0; 0 in place of its inverse makes the solution 0 there, and its mean is subtracted later.
    """
    n = s.size
    pivots, e = np.empty((n, n)), s.copy()
    for i in range(n - 1):
        pivots[i] = 1.0 / (1.0 + e)
        e = s + e * pivots[i]
    pivots[-1] = np.where(e > 0.0, 1.0 / np.where(e > 0.0, e, 1.0), 0.0)
    return pivots


@compiled_kernel(parallel=True)
def _eliminate(r, g, pivots, keep, share, blocks):
    """Replace each column of r by keep (D + s)^-1 r - share r; g: scratch."""
    n = r.shape[0]
    for block in prange(blocks):
        lo, hi = block * n // blocks, (block + 1) * n // blocks
        for k in range(lo, hi):
            g[0, k] = r[0, k] * pivots[0, k]
        for i in range(1, n):
            for k in range(lo, hi):
                g[i, k] = (r[i, k] + g[i - 1, k]) * pivots[i, k]
        for k in range(lo, hi):
            r[n - 1, k] = keep[k] * g[n - 1, k] - share[k] * r[n - 1, k]
        for i in range(n - 2, -1, -1):
            for k in range(lo, hi):
                g[i, k] += pivots[i, k] * g[i + 1, k]
                r[i, k] = keep[k] * g[i, k] - share[k] * r[i, k]


@dataclass(frozen=True)
class TransportStep:
    """State of a solve, passed to `progress`."""

    grid: int  # cells per side of the current grid
    iteration: int  # number of the iteration on this grid, from 1
    mass_error: float  # mean |pushforward - target| of densities of mean 1
    stage: str  # method: "back-and-forth", or "tubes" for Newton's method on flux tubes


Listener = Callable[[TransportStep], None] | None  # called after each iteration of a solve


@dataclass(frozen=True)
class Transport:
    """A pair of potentials on the unit square, (n, n) at cell centres, and the history of the solve.

    x - ∇psi(x) maps source to target, y - ∇phi(y) maps target to source; psi = phi^c exactly.
    """

    phi: np.ndarray  # potential on the target side, (n, n)
    psi: np.ndarray  # potential on the source side, phi^c, (n, n)
    mass_error: tuple[float, ...]  # mean |pushforward - target| before each iteration on the finest grid and at the end
    dual: tuple[float, ...]  # dual value J after each iteration on the finest grid; from `mapping.solve`: at the end
    iterations: int  # number of iterations on the finest grid
    reason: str  # reason why the solve ended: "converged" | "plateau" | "iterations"


def back_and_forth(
    source: Density, target: Density, *, iterations: int = 40, tolerance: float = 1e-3, progress: Listener = None
) -> Transport:
    """Return the potentials between two densities on one grid, solved on coarser grids first; cells may be zero.

    iterations: largest number of iterations on each grid.  tolerance: mass error at which the solve has converged.
    """
    if source.n != target.n:
        raise ValueError(f"source, target: have {source.n} and {target.n} cells per side; give equal numbers")
    sigma = FIRST_STEP
    grids = ladder(source, target, MIN_CELLS)
    phi = np.zeros((grids[0][0].n, grids[0][0].n))
    limits = {"iterations": iterations, "tolerance": tolerance, "progress": progress}
    for rho, nu in grids:
        phi = phi if phi.shape[0] == rho.n else prolong(phi)
        sigma = max(sigma, MIN_FIRST_STEP)
        with threads(rho.n):
            phi, psi, sigma, errors, duals, reason = _ascend(rho, nu, phi, sigma, **limits)
    n = source.n
    return Transport(phi / n**2, psi / n**2, tuple(errors), tuple(duals), iterations=len(duals), reason=reason)


def prolong(phi: np.ndarray) -> np.ndarray:
    """Interpolate a potential bilinearly, (m, m) -> (2m, 2m) in cell units, with zero normal derivative at the rim."""
    for axis in (0, 1):
        p = np.moveaxis(phi, axis, 0)
        before, after = np.concatenate([p[:1], p[:-1]]), np.concatenate([p[1:], p[-1:]])
        fine = np.stack([0.75 * p + 0.25 * before, 0.75 * p + 0.25 * after], axis=1)
        phi = np.moveaxis(fine.reshape(2 * p.shape[0], p.shape[1]), 0, axis)
    return np.ascontiguousarray(4.0 * phi)  # in units of a cell side half as long


def ladder(source: Density, target: Density, coarsest: int) -> list[tuple[Density, Density]]:
    """Return both densities on grids, coarsest first; the cells per side are halved while even and above `coarsest`."""
    rungs = [(source, target)]
    while rungs[0][0].n % 2 == 0 and rungs[0][0].n > coarsest:
        rungs.insert(0, (rungs[0][0].halved(), rungs[0][1].halved()))
    return rungs


def _ascend(source, target, phi, sigma, *, iterations, tolerance, progress):
    """Return (phi, psi, sigma, mass errors, duals, reason) after the solve on one grid.

    In v = |y|²/2 - phi and u = |x|²/2 - psi the c-transform becomes `legendre`, and T = ∇u.
    """
    n, rho, nu = source.n, source.values, target.values
    half, poisson = half_square(n), Poisson(n)
    u = legendre(half - phi)
    v = legendre(u)
    dual = _dual(u, v, rho, nu)
    errors, duals, reason = [], [], "iterations"
    forth = back = sigma  # one step length per density: a sharper density allows only shorter steps
    ceiling, since, halvings = np.inf, 0, 0
    for iteration in range(1, iterations + 1):
        v, u, forth, dual, error = _half_step(v, u, rho, nu, poisson=poisson, sigma=min(forth, ceiling), dual=dual)
        errors.append(error)
        if error <= tolerance:
            reason = "converged"
            break
        u, v, back, dual, _ = _half_step(u, v, nu, rho, poisson=poisson, sigma=min(back, ceiling), dual=dual)
        duals.append(dual / n**2)
        if progress is not None:
            progress(TransportStep(n, iteration, error, "back-and-forth"))
        before, latest = errors[since:-PLATEAU_ITERATIONS], errors[-PLATEAU_ITERATIONS:]
        if iteration - since > PLATEAU_ITERATIONS and min(latest) > (1 - PLATEAU_TOLERANCE) * min(before):
            if halvings == STEP_HALVINGS:
                reason = "plateau"
                break
            ceiling, since, halvings = 0.5 * min(forth, back), iteration, halvings + 1
    u = legendre(v)
    errors.append(float(np.abs(pushforward(rho, u) - nu).mean()))
    return half - v, half - u, min(forth, back), errors, duals, reason


def _half_step(a, b, rho, nu, *, poisson, sigma, dual):
    """Return (a, b, sigma, J, mass error) after a step in the potential of `a`; b = a*, and ∇b maps rho towards nu."""
    r = nu - pushforward(rho, b)
    error = float(np.abs(r).mean())
    g = poisson.solve(r)
    trial = legendre(a - sigma * g)
    conjugate = legendre(trial)  # the double transform never lowers J
    gain = _dual(trial, conjugate, rho, nu) - dual
    share = gain / (sigma * inner(g, r) / r.size + 1e-300)
    if gain < 0.0:
        return a, b, sigma * REFUSED_STEP_FACTOR, dual, error
    if share > MAX_GAIN_RATIO:
        sigma *= STEP_INCREASE
    elif share < MIN_GAIN_RATIO:
        sigma *= STEP_DECREASE
    return conjugate, trial, sigma, dual + gain, error


@compiled_kernel(fastmath={"reassoc"})
def _dual(u, v, rho, nu):
    """Return J = ∫ psi drho + ∫ phi dnu in cell units; u, v: see `_ascend`."""
    n = u.shape[0]
    total = 0.0
    for i in range(n):  # sum each row first, for accuracy
        row = 0.0
        for j in range(n):
            half = 0.5 * ((i + 0.5) ** 2 + (j + 0.5) ** 2)
            row += (half - u[i, j]) * rho[i, j] + (half - v[i, j]) * nu[i, j]
        total += row
    return total / n**2
