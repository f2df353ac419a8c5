"""Newton's method on the Monge-Ampère equation of flux tubes, which removes the grid error of a coarse map.

S = ∇v = y - ∇phi, v = |y|²/2 - phi, is the map from target to source.  The flux into target pixel p is the flux that
the source sends through the tube of the pixel, F_p = ∫_{S(p)} rho, and the equation is F_p = nu_p.  S is stored at
pixel corners (mean differences of phi, zero normal derivative, so that the rim of the square maps to itself) and is
bilinear in pixels.  The linearisation

    -div(rho cof(D²v) ∇eta) = nu - F,    eta the change of phi,

is elliptic while v is convex; it is solved by conjugate gradients with the Poisson solve as preconditioner.
On the target side the equation resolves the edges of the picture exactly, and the source may be zero outside a disc;
the target must be positive.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import prange
from scipy.ndimage import gaussian_filter

from bstcad.runs.kernel_cache import compiled_kernel
from bstcad.transport.bfm import Listener, PoissonWithoutCheckerboard, TransportStep, prolong
from bstcad.transport.density import Density, inner, threads

SOFTENING = 0.2  # addition to the eigenvalues of rho cof(D²v), to limit Newton's steps in dark, nearly folded regions
BLUR = 1.0  # standard deviation (cells) of the Gaussian blur of phi that removes the noise of the coarser grid
CG_ITERATIONS, CG_TOLERANCE = 15, 0.1  # conjugate gradients: maximum number of iterations, relative tolerance
MIN_STEP = 0.05  # smallest fraction of Newton's step in the line search
MAX_ERROR_RATIO = 0.9  # ratio of mass errors, after to before a step, above which the solve stops
ROUGH_MASS_ERROR = 0.005  # mass error above which a map is rough, so that the next two constants apply
MAX_ROUGH_ERROR_RATIO = 0.98  # value of MAX_ERROR_RATIO while the map is rough
MAX_STEPS_FACTOR = 3  # factor by which the largest number of steps grows while the map is rough

Grids = Sequence[tuple[Density, Density]]  # (source, target) for each of a sequence of grids


class MongeAmpere:
    """Monge-Ampère equation on one grid of n x n target pixels, the source interpolated bilinearly; cell units."""

    def __init__(self, source: Density, target: Density):
        self.rho, self.nu = source.values, target.values
        # mean differences at corners are zero for the checkerboard, so the steps must not contain it
        self.poisson = PoissonWithoutCheckerboard(source.n)

    def flux(self, phi: np.ndarray) -> np.ndarray:
        """Return F (n, n), the source flux through the tube of each target pixel; folded tubes have negative flux."""
        x, y = corners(phi)
        out = np.empty_like(phi)
        _flux(self.rho, x, y, out)
        return out

    def newton(self, phi: np.ndarray, r: np.ndarray, smoothed: np.ndarray | None = None) -> np.ndarray:
        """Return eta with -div((rho cof(D²v) + softening) ∇eta) ≈ r; smoothed: preconditioned r; None: compute it."""
        n = phi.shape[0]
        metric, p, q = np.empty((n + 1, n + 1, 3)), np.empty((n + 1, n + 1)), np.empty((n + 1, n + 1))
        _metric(self.rho, *corners(phi), metric, SOFTENING)
        eta, image = np.zeros_like(r), np.empty_like(r)
        r = r - r.mean()
        z = self.poisson.solve(r) if smoothed is None else smoothed
        d = z.copy()
        rz = first = inner(r, z)
        for _ in range(CG_ITERATIONS):
            if rz <= CG_TOLERANCE**2 * first:
                break
            _apply(metric, d, p, q, image)
            _update(eta, r, d, image, rz / inner(d, image))
            z = self.poisson.solve(r)
            rz, last = inner(r, z), rz
            d *= rz / last
            d += z
        return eta


def corners(phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return S = y - ∇phi at the (n + 1)² pixel corners from phi (n, n), in cell units."""
    n = phi.shape[0]
    x, y = np.empty((n + 1, n + 1)), np.empty((n + 1, n + 1))
    _corners(phi, x, y)
    return x, y


def newton_on_grids(
    grids: Grids, phi: np.ndarray, *, steps: int, tolerance: float, progress: Listener = None, blur: float = BLUR
) -> tuple[np.ndarray, list[float], str]:
    """Apply up to `steps` Newton steps (on a rough map MAX_STEPS_FACTOR times as many) on each grid.

    phi: start on the first grid (cell units).  tolerance: mass error at which the steps end.  blur: standard deviation
    (cells) of the blur of phi before each grid.  Returns phi (cell units), the mass errors on the last grid, and the
    reason why the solve stopped there.
    """
    for k, (source, target) in enumerate(grids):
        if k:
            phi = prolong(phi)
        phi = gaussian_filter(phi, blur, mode="nearest") if blur else phi
        with threads(source.n):
            tubes = MongeAmpere(source, target)
            phi, errors, reason = _newton_steps(tubes, phi, steps=steps, tolerance=tolerance, progress=progress)
    return phi, errors, reason


def _newton_steps(tubes, phi, *, steps, tolerance, progress):
    r = tubes.nu - tubes.flux(phi)
    smoothed = tubes.poisson.solve(r)
    errors, reason = [float(np.abs(r).mean())], "iterations"
    for k in range(MAX_STEPS_FACTOR * steps):
        if errors[-1] <= tolerance or (k >= steps and errors[-1] <= ROUGH_MASS_ERROR):
            break
        found = _line_search(tubes, phi, r, smoothed=smoothed, eta=tubes.newton(phi, r, smoothed))
        error = np.inf if found is None else float(np.abs(found[1]).mean())
        if error > errors[-1]:  # the mass error may rise although the residual falls in H^-1 and L2
            reason = "plateau"
            break
        phi, r, smoothed = found
        errors.append(error)
        if progress is not None:
            progress(TransportStep(phi.shape[0], k + 1, errors[-1], "tubes"))
        if errors[-1] > (MAX_ROUGH_ERROR_RATIO if errors[-1] > ROUGH_MASS_ERROR else MAX_ERROR_RATIO) * errors[-2]:
            reason = "plateau"
            break
    return phi, errors, "converged" if errors[-1] <= tolerance else reason


def _line_search(tubes, phi, r, *, smoothed, eta):
    """Return (phi, its residual, preconditioned residual) after the first accepted of the steps 1, 1/2, 1/4 … of eta.

    A step is accepted if it lowers the residual in H^-1 and raises its square in L2 by less than 10 %.  None: no step.
    """
    norm, square = _dual_norm(r, smoothed), inner(r, r)
    step = 1.0
    while step >= MIN_STEP:
        trial = phi + step * eta
        left = tubes.nu - tubes.flux(trial)
        if inner(left, left) < 1.1 * square:
            smoothed = tubes.poisson.solve(left)
            if _dual_norm(left, smoothed) < (1 - 0.02 * step) * norm:
                return trial, left, smoothed
        step *= 0.5
    return None


def _dual_norm(r: np.ndarray, smoothed: np.ndarray) -> float:
    return float(np.sqrt(max(0.0, inner(r, smoothed))))


@compiled_kernel(inline="always")
def _interpolate(rho, x, y, last):
    """Interpolate rho bilinearly between cell centres, constant outside, in cell units; last: the float below n - 1."""
    x = min(max(x - 0.5, 0.0), last)
    y = min(max(y - 0.5, 0.0), last)
    row, column = np.floor(x), np.floor(y)
    a, b = x - row, y - column
    i, j, one = np.uint64(np.int64(row)), np.uint64(np.int64(column)), np.uint64(1)  # no check for negative indices
    density = rho[i, j] + b * (rho[i, j + one] - rho[i, j])
    below = rho[i + one, j] + b * (rho[i + one, j + one] - rho[i + one, j])
    return density + a * (below - density)


@compiled_kernel(parallel=True)
def _corners(phi, x, y):
    n = phi.shape[0]
    for k in prange(n + 1):
        i = np.int64(k)
        a, b = max(i - 1, 0), min(i, n - 1)
        for j in range(n + 1):
            c, d = max(j - 1, 0), min(j, n - 1)
            x[i, j] = i - 0.5 * (phi[b, c] - phi[a, c] + phi[b, d] - phi[a, d])
            y[i, j] = j - 0.5 * (phi[a, d] - phi[a, c] + phi[b, d] - phi[b, c])


@compiled_kernel(parallel=True, error_model="numpy", fastmath={"contract"})
def _flux(rho, x, y, out):
    """Integrate rho over the signed area of each bilinear tube; midpoints half a cell apart or nearer, up to 400²."""
    n = out.shape[0]
    last = np.nextafter(n - 1.0, 0.0)
    for i in prange(n):
        for j in range(n):
            x0, y0 = x[i, j], y[i, j]
            ex, ey = x[i + 1, j] - x0, y[i + 1, j] - y0
            fx, fy = x[i, j + 1] - x0, y[i, j + 1] - y0
            tx = x[i + 1, j + 1] - x[i, j + 1] - ex
            ty = y[i + 1, j + 1] - y[i, j + 1] - ey
            p = int(min(399.0, 2.0 * max(max(abs(ex), abs(ex + tx)), max(abs(ey), abs(ey + ty))))) + 1
            q = int(min(399.0, 2.0 * max(max(abs(fx), abs(fx + tx)), max(abs(fy), abs(fy + ty))))) + 1
            da, db = 1.0 / p, 1.0 / q
            total = 0.0
            for s in range(p):
                a = (s + 0.5) * da
                left, low = x0 + a * ex, y0 + a * ey
                along_x, along_y = fx + a * tx, fy + a * ty
                b = -0.5 * db
                for _ in range(q):
                    b += db
                    area = (ex + b * tx) * along_y - (ey + b * ty) * along_x
                    total += _interpolate(rho, left + b * along_x, low + b * along_y, last) * area
            out[i, j] = total * (da * db)


@compiled_kernel(parallel=True)
def _metric(rho, x, y, metric, softening):
    """Compute rho cof(D²v) + softening, made positive, at pixel corners: (xx, xy, yy) along the last axis."""
    n = x.shape[0] - 1
    last = np.nextafter(n - 1.0, 0.0)
    for k in prange(n + 1):
        i = np.int64(k)
        a, b = max(i - 1, 0), min(i + 1, n)
        for j in range(n + 1):
            c, d = max(j - 1, 0), min(j + 1, n)
            vxx = max((x[b, j] - x[a, j]) / (b - a), 0.0)
            vyy = max((y[i, d] - y[i, c]) / (d - c), 0.0)
            vxy = 0.5 * ((x[i, d] - x[i, c]) / (d - c) + (y[b, j] - y[a, j]) / (b - a))
            limit = 0.99 * np.sqrt(vxx * vyy)
            vxy = min(max(vxy, -limit), limit)
            density = _interpolate(rho, x[i, j], y[i, j], last)
            metric[i, j, 0] = density * vyy + softening
            metric[i, j, 1] = -density * vxy
            metric[i, j, 2] = density * vxx + softening


@compiled_kernel()
def _update(eta, r, d, image, step):
    """Update the solution eta and the residual r with a step of conjugate gradients along d; image: operator at d."""
    n = eta.shape[0]
    for i in range(n):
        for j in range(n):
            eta[i, j] += step * d[i, j]
            r[i, j] -= step * image[i, j]


@compiled_kernel(parallel=True)
def _apply(metric, eta, p, q, out):
    """Compute out = -div(metric ∇eta); gradients at corners, no flux through the rim; p, q: scratch."""
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
    for row in prange(n):
        for j in range(n):
            along_x = p[row + 1, j] + p[row + 1, j + 1] - p[row, j] - p[row, j + 1]
            along_y = q[row, j + 1] + q[row + 1, j + 1] - q[row, j] - q[row + 1, j]
            out[row, j] = -0.5 * (along_x + along_y)
