"""Take a transport below the grid's own error: Newton on the Monge-Ampère equation, written for ray tubes.

With S = ∇v = y - ∇phi the map from target to source, the flux that reaches target pixel p is what the source sends
through its tube, F_p = ∫_{S(p)} rho, and it has to be nu_p.  S is kept at pixel corners (averaged differences of phi,
zero normal derivative, so the rim of the square maps to itself) and is bilinear inside.  The linearisation

    -div(rho cof(D²v) ∇eta) = nu - F

is elliptic while v is convex; it is solved by conjugate gradients with the Poisson solve as preconditioner.
Writing it on the target side resolves the edges of the picture exactly, lets the source be zero outside a disc, and
needs the target positive.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from scipy.ndimage import gaussian_filter

from bstcad.transport.bfm import Step, prolong
from bstcad.transport.density import Density
from bstcad.transport.poisson import PoissonWithoutCheckerboard
from bstcad.transport.threads import threads

SOFTENING = 0.2  # added to both eigenvalues of rho cof(D²v): Newton steps stay small in dark, nearly folded regions
SMOOTHING = 1.0  # cells: Gaussian blur of phi that takes out the grid noise of the coarser solution
GRADIENT_STEPS, GRADIENT_FALL = 15, 0.1  # conjugate gradients: at most so many, until the residual fell by so much
SHORTEST = 0.05  # shortest fraction of a Newton step that is tried
ENOUGH = 0.9  # a step that leaves more than this of the mass error is the last


class Tubes:
    """The equation on one grid: n x n target pixels, source density looked up bilinearly, cell units."""

    def __init__(self, source: Density, target: Density):
        """Both on one grid."""
        self.rho, self.nu = source.values, target.values
        # differences averaged to corners are blind to the checkerboard: keep it out of the steps
        self.poisson = PoissonWithoutCheckerboard(source.n)

    def flux(self, phi: np.ndarray) -> np.ndarray:
        """F (n, n): source flux through the tube of each target pixel; signed, so a fold counts against."""
        x, y = corners(phi)
        out = np.empty_like(phi)
        _flux(self.rho, x, y, out)
        return out

    def smooth(self, r: np.ndarray) -> np.ndarray:
        """The preconditioner: (-Δ)^-1 without the checkerboard."""
        return self.poisson.solve(r)

    def newton(self, phi: np.ndarray, r: np.ndarray) -> np.ndarray:
        """eta with -div((rho cof(D²v) + softening) ∇eta) = r, roughly."""
        n = phi.shape[0]
        metric, p, q = np.empty((n + 1, n + 1, 3)), np.empty((n + 1, n + 1)), np.empty((n + 1, n + 1))
        _metric(self.rho, *corners(phi), metric, SOFTENING)
        eta, image = np.zeros_like(r), np.empty_like(r)
        r = r - r.mean()
        z = self.smooth(r)
        d = z.copy()
        rz = first = float(np.vdot(r, z))
        for _ in range(GRADIENT_STEPS):
            if rz <= GRADIENT_FALL**2 * first:
                break
            _apply(metric, d, p, q, image)
            step = rz / float(np.vdot(d, image))
            eta += step * d
            r -= step * image
            z = self.smooth(r)
            rz, last = float(np.vdot(r, z)), rz
            d *= rz / last
            d += z
        return eta


def corners(phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """S = y - ∇phi at the (n + 1)² pixel corners, cell units, from phi (n, n) in cell units."""
    n = phi.shape[0]
    x, y = np.empty((n + 1, n + 1)), np.empty((n + 1, n + 1))
    _corners(phi, x, y)
    return x, y


def climb(ladder, phi, steps, tolerance, progress):
    """Newton on each rung of (source, target), from phi (cell units) on the first.

    Returns phi (cell units), the mass errors on the last rung and why it stopped there.
    """
    for k, (source, target) in enumerate(ladder):
        if k:
            phi = prolong(phi)
        phi = gaussian_filter(phi, SMOOTHING, mode="nearest")
        with threads(source.n):
            phi, errors, reason = _newton_steps(Tubes(source, target), phi, steps, tolerance, progress)
    return phi, errors, reason


def _newton_steps(tubes, phi, steps, tolerance, progress):
    r = tubes.nu - tubes.flux(phi)
    errors, reason = [float(np.abs(r).mean())], "iterations"
    for k in range(steps):
        if errors[-1] <= tolerance:
            break
        found = _line_search(tubes, phi, r, tubes.newton(phi, r))
        if found is None:
            reason = "plateau"
            break
        phi, r = found
        errors.append(float(np.abs(r).mean()))
        if progress is not None:
            progress(Step(phi.shape[0], k + 1, errors[-1], "tubes"))
        if errors[-1] > ENOUGH * errors[-2]:
            reason = "plateau"
            break
    return phi, errors, "converged" if errors[-1] <= tolerance else reason


def _line_search(tubes, phi, r, eta):
    """The longest of 1, 1/2, 1/4 … of the step that lowers the residual in H^-1 and does not raise it in L2."""
    norm, square = _dual_norm(tubes, r), float((r * r).mean())
    step = 1.0
    while step >= SHORTEST:
        tried = phi + step * eta
        left = tubes.nu - tubes.flux(tried)
        if float((left * left).mean()) < 1.1 * square and _dual_norm(tubes, left) < (1 - 0.02 * step) * norm:
            return tried, left
        step *= 0.5
    return None


def _dual_norm(tubes, r) -> float:
    return float(np.sqrt(max(0.0, (r * tubes.smooth(r)).mean())))


@njit(cache=True, nogil=True)
def _look(rho, x, y):
    """Bilinear between cell centres, constant beyond the outer ones; cell units."""
    n = rho.shape[0]
    x = min(max(x - 0.5, 0.0), n - 1.0)
    y = min(max(y - 0.5, 0.0), n - 1.0)
    i, j = min(int(x), n - 2), min(int(y), n - 2)
    a, b = x - i, y - j
    return (1 - a) * ((1 - b) * rho[i, j] + b * rho[i, j + 1]) + a * ((1 - b) * rho[i + 1, j] + b * rho[i + 1, j + 1])


@njit(cache=True, nogil=True, parallel=True)
def _corners(phi, x, y):
    n = phi.shape[0]
    for k in prange(n + 1):
        i = np.int64(k)
        a, b = max(i - 1, 0), min(i, n - 1)
        for j in range(n + 1):
            c, d = max(j - 1, 0), min(j, n - 1)
            x[i, j] = i - 0.5 * (phi[b, c] - phi[a, c] + phi[b, d] - phi[a, d])
            y[i, j] = j - 0.5 * (phi[a, d] - phi[a, c] + phi[b, d] - phi[b, c])


@njit(cache=True, nogil=True, parallel=True)
def _flux(rho, x, y, out):
    """∫ rho |dS| over each bilinear tube, by midpoints at most half a source cell apart (400 a side at most)."""
    n = out.shape[0]
    for i in prange(n):
        for j in range(n):
            ex, ey = x[i + 1, j] - x[i, j], y[i + 1, j] - y[i, j]
            fx, fy = x[i, j + 1] - x[i, j], y[i, j + 1] - y[i, j]
            tx = x[i + 1, j + 1] - x[i, j + 1] - ex
            ty = y[i + 1, j + 1] - y[i, j + 1] - ey
            p = int(min(399.0, 2.0 * max(max(abs(ex), abs(ex + tx)), max(abs(ey), abs(ey + ty))))) + 1
            q = int(min(399.0, 2.0 * max(max(abs(fx), abs(fx + tx)), max(abs(fy), abs(fy + ty))))) + 1
            total = 0.0
            for s in range(p):
                a = (s + 0.5) / p
                for t in range(q):
                    b = (t + 0.5) / q
                    area = (ex + b * tx) * (fy + a * ty) - (ey + b * ty) * (fx + a * tx)
                    px = x[i, j] + a * ex + b * (fx + a * tx)
                    py = y[i, j] + a * ey + b * (fy + a * ty)
                    total += _look(rho, px, py) * area
            out[i, j] = total / (p * q)


@njit(cache=True, nogil=True, parallel=True)
def _metric(rho, x, y, metric, softening):
    """rho cof(D²v) + softening at pixel corners, kept positive: (xx, xy, yy) in the last axis."""
    n = x.shape[0] - 1
    for k in prange(n + 1):
        i = np.int64(k)
        a, b = max(i - 1, 0), min(i + 1, n)
        for j in range(n + 1):
            c, d = max(j - 1, 0), min(j + 1, n)
            vxx = max((x[b, j] - x[a, j]) / (b - a), 0.0)
            vyy = max((y[i, d] - y[i, c]) / (d - c), 0.0)
            vxy = 0.5 * ((x[i, d] - x[i, c]) / (d - c) + (y[b, j] - y[a, j]) / (b - a))
            most = 0.99 * np.sqrt(vxx * vyy)
            vxy = min(max(vxy, -most), most)
            here = _look(rho, x[i, j], y[i, j])
            metric[i, j, 0] = here * vyy + softening
            metric[i, j, 1] = -here * vxy
            metric[i, j, 2] = here * vxx + softening


@njit(cache=True, nogil=True, parallel=True)
def _apply(metric, eta, p, q, out):
    """out = -div(metric ∇eta); gradients at corners, no flux through the rim; p, q: scratch."""
    n = eta.shape[0]
    for k in prange(n + 1):
        i = np.int64(k)
        a, b = max(i - 1, 0), min(i, n - 1)
        for j in range(n + 1):
            c, d = max(j - 1, 0), min(j, n - 1)
            gx = 0.5 * (eta[b, c] - eta[a, c] + eta[b, d] - eta[a, d])
            gy = 0.5 * (eta[a, d] - eta[a, c] + eta[b, d] - eta[b, c])
            p[i, j] = metric[i, j, 0] * gx + metric[i, j, 1] * gy if 0 < i < n else 0.0
            q[i, j] = metric[i, j, 1] * gx + metric[i, j, 2] * gy if 0 < j < n else 0.0
    for i in prange(n):
        for j in range(n):
            along_x = p[i + 1, j] + p[i + 1, j + 1] - p[i, j] - p[i, j + 1]
            along_y = q[i, j + 1] + q[i + 1, j + 1] - q[i, j] - q[i + 1, j]
            out[i, j] = -0.5 * (along_x + along_y)
