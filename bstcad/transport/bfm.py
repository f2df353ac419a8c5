"""The back-and-forth method: optimal transport for the cost |x - y|²/2 between two densities on one grid.

Jacobs and Leger 2020, "A fast approach to optimal transport: the back-and-forth method", Numerische Mathematik 146.
source rho on x, target nu on y, potentials psi(x) and phi(y):

    J(phi) = ∫ phi dnu + ∫ phi^c drho,   T = id - ∇phi^c,   H1 gradient  (-Δ)^-1 (nu - T_# rho)

and likewise for psi; each is raised in turn, and c-transforms pass between them.  The grid itself limits the
accuracy: c-transforms send cell centres to cell centres, so the method comes to rest at a mass error of a few per
cent, which `tubes` then takes down.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from bstcad.transport.density import Density
from bstcad.transport.legendre import half_square, legendre
from bstcad.transport.poisson import Poisson
from bstcad.transport.pushforward import pushforward
from bstcad.transport.threads import inner, threads

COARSEST = 32  # cells a side where the ladder of grids begins
FIRST_STEP = 1.0  # sigma on the coarsest grid; 1 is Newton's step between two even densities
LEAST_STEP = 0.25  # sigma each finer grid begins with at least: the last refusals on a coarse grid were its own noise
GROW, SHRINK, HALVE = 1.25, 0.8, 0.5  # sigma after too cautious, too bold and refused steps
BOLD, CAUTIOUS = 0.25, 0.75  # Armijo-Goldstein bounds on (gain of J) / (sigma |∇J|²)
STALL = 0.005  # relative fall of the mass error over PATIENCE iterations below which it is a plateau
PATIENCE = 5
COOLINGS = 2  # step halvings before a plateau stops the iteration: the mass error settles at a height set by sigma


@dataclass(frozen=True)
class Step:
    """Where a solve stands; handed to `progress`."""

    grid: int  # cells a side
    iteration: int  # on this grid, from 1
    mass_error: float  # mean |pushforward - target|, both of mean 1
    stage: str  # "back-and-forth" | "tubes"


@dataclass(frozen=True)
class Transport:
    """A pair of potentials on the unit square, (n, n) at cell centres, and how the solve went.

    x - ∇psi(x) maps source to target, y - ∇phi(y) target to source; the solver holds phi, and psi = phi^c exactly.
    """

    phi: np.ndarray  # (n, n), on the target side
    psi: np.ndarray  # (n, n), on the source side, phi^c
    mass_error: tuple[float, ...]  # mean |pushforward - target| before each iteration and at the end, finest grid
    dual: tuple[float, ...]  # Kantorovich value after each iteration on the finest grid; rises to W2²/2
    iterations: int  # on the finest grid
    reason: str  # why the solve stopped: "converged" | "plateau" | "iterations"


def back_and_forth(
    source: Density,
    target: Density,
    *,
    iterations: int = 40,
    tolerance: float = 1e-3,
    progress: Callable[[Step], None] | None = None,
) -> Transport:
    """Potentials between two densities on one grid; neither needs to be positive.  Coarser grids are solved first.

    iterations: the limit on each grid.  tolerance: mass error at which the solve has converged.
    """
    if source.n != target.n:
        raise ValueError(f"source and target must lie on one grid, got {source.n} and {target.n} cells a side")
    sigma = FIRST_STEP
    grids = ladder(source, target, COARSEST)
    phi = np.zeros((grids[0][0].n, grids[0][0].n))
    for rho, nu in grids:
        phi = phi if phi.shape[0] == rho.n else prolong(phi)
        sigma = max(sigma, LEAST_STEP)
        with threads(rho.n):
            phi, psi, sigma, errors, duals, reason = _ascend(
                rho, nu, phi, sigma, iterations=iterations, tolerance=tolerance, progress=progress
            )
    n = source.n
    return Transport(
        phi=phi / n**2,
        psi=psi / n**2,
        mass_error=tuple(errors),
        dual=tuple(duals),
        iterations=len(duals),
        reason=reason,
    )


def prolong(phi: np.ndarray) -> np.ndarray:
    """Cell units, (m, m) -> (2m, 2m): bilinear between cell centres, zero normal derivative at the rim."""
    for axis in (0, 1):
        p = np.moveaxis(phi, axis, 0)
        before, after = np.concatenate([p[:1], p[:-1]]), np.concatenate([p[1:], p[-1:]])
        fine = np.stack([0.75 * p + 0.25 * before, 0.75 * p + 0.25 * after], axis=1)
        phi = np.moveaxis(fine.reshape(2 * p.shape[0], p.shape[1]), 0, axis)
    return np.ascontiguousarray(4.0 * phi)  # over the square of a cell side half as long


def ladder(source: Density, target: Density, coarsest: int) -> list[tuple[Density, Density]]:
    """The pair on ever finer grids, coarsest first, by halving as long as n is even and above `coarsest`."""
    rungs = [(source, target)]
    while rungs[0][0].n % 2 == 0 and rungs[0][0].n > coarsest:
        rungs.insert(0, (rungs[0][0].halved(), rungs[0][1].halved()))
    return rungs


def _ascend(source, target, phi, sigma, *, iterations, tolerance, progress):
    """Solve on one grid.  In v = |y|²/2 - phi and u = |x|²/2 - psi a c-transform is `legendre` and T = ∇u, S = ∇v."""
    n, rho, nu = source.n, source.values, target.values
    half, poisson = half_square(n), Poisson(n)
    u = legendre(half - phi)
    v = legendre(u)
    dual = _dual(u, v, rho, nu)
    errors, duals, reason = [], [], "iterations"
    forth = back = sigma  # a step size for each side: the sharper density bears only the smaller
    ceiling, since, coolings = np.inf, 0, 0
    for iteration in range(1, iterations + 1):
        v, u, forth, dual, error = _half_step(v, u, rho, nu, poisson=poisson, sigma=min(forth, ceiling), dual=dual)
        errors.append(error)
        if error <= tolerance:
            reason = "converged"
            break
        u, v, back, dual, _ = _half_step(u, v, nu, rho, poisson=poisson, sigma=min(back, ceiling), dual=dual)
        duals.append(dual / n**2)
        if progress is not None:
            progress(Step(n, iteration, error, "back-and-forth"))
        if iteration - since > PATIENCE and min(errors[-PATIENCE:]) > (1 - STALL) * min(errors[since:-PATIENCE]):
            if coolings == COOLINGS:
                reason = "plateau"
                break
            ceiling, since, coolings = 0.5 * min(forth, back), iteration, coolings + 1
    u = legendre(v)
    errors.append(float(np.abs(pushforward(rho, u) - nu).mean()))
    return half - v, half - u, min(forth, back), errors, duals, reason


def _half_step(a, b, rho, nu, *, poisson, sigma, dual):
    """Raise the potential of `a` (with b = a*, whose gradient carries rho towards nu); refuse a step that lowers J."""
    r = nu - pushforward(rho, b)
    error = float(np.abs(r).mean())
    g = poisson.solve(r)
    tried = legendre(a - sigma * g)
    kept = legendre(tried)  # the double transform: never lowers J
    gain = _dual(tried, kept, rho, nu) - dual
    share = gain / (sigma * inner(g, r) / r.size + 1e-300)
    if gain < 0.0:
        return a, b, sigma * HALVE, dual, error
    if share > CAUTIOUS:
        sigma *= GROW
    elif share < BOLD:
        sigma *= SHRINK
    return kept, tried, sigma, dual + gain, error


@njit(cache=True, nogil=True, fastmath={"reassoc"})
def _dual(u, v, rho, nu):
    """∫ psi drho + ∫ phi dnu, cell units."""
    n = u.shape[0]
    total = 0.0
    for i in range(n):  # a sum for each row first: fewer digits are lost
        row = 0.0
        for j in range(n):
            half = 0.5 * ((i + 0.5) ** 2 + (j + 0.5) ** 2)
            row += (half - u[i, j]) * rho[i, j] + (half - v[i, j]) * nu[i, j]
        total += row
    return total / n**2
