"""The form error as a spline, separated from the noise of the measurement.

The deviation is a polynomial and a random field, a spline on a net of the lens's extent whose cosine amplitudes c_k are
Gaussian with a variance S that depends on the frequency alone; the points add white noise σ².  S (by quarter octaves)
and σ are estimated from the points themselves, and the form is the posterior mean: of all linear estimates of heights,
slopes and curvatures the one with the least error.  The posterior can be sampled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.fft
import scipy.sparse
import scipy.sparse.linalg
import torch

from bstcad.measured.alignment import Alignment, Face
from bstcad.optics.bspline import BSplineSurface, basis_matrix, prolongation

DEGREE = 2  # of the polynomial
MARGIN = 0.2  # of the side, of the field's net beyond the face, since cosines have zero slope at its ends
PER_CELL = 6.0  # points in a cell of the net, in the mean
NETS = (9, 513)  # control points a side, fewest and most
REFINED = 4  # times the control points a side of the lens's net, at most: nets of this kind are not nested
QUARTER = 4  # bands an octave
ROUNDS = 8  # between field and spectrum
SETTLED = 3  # rounds before the spectrum weighs the motions
STEPS, ENOUGH = 30, 1e-4  # of conjugate gradients; of the residual
SURE = 3.0  # standard deviations above noise, for a band of frequencies to hold form
SILENT = 1e-4  # of the noise: variance of a band below SURE
LOOSE = 0.001  # of the half width: a motion of that uncertainty by the relief stays zero
FOLLOWED = 6  # bands whose slope is extrapolated into the noise
QUIET = 1e-3  # of the deviation: least noise


@dataclass(frozen=True)
class Form:
    """A fitted form error, δz(x, y) over the net of a lens: a polynomial, a random field, and a small motion."""

    face: Face
    polynomial: np.ndarray = field(repr=False)  # (3, 3) coefficients of Legendre products, x along the first axis
    rest: BSplineSurface = field(repr=False)  # the random field
    spread: np.ndarray = field(repr=False)  # (m, m) standard deviation of each cosine amplitude of its net, mm
    noise: float  # of the points, RMS (mm)
    motion: np.ndarray  # (6,) in Face.columns' units, of the fine relief against the alignment, which form errors bias

    def on(self, surface: BSplineSurface, draw: np.ndarray | None = None, sign: float = 1.0) -> BSplineSurface:
        """`surface` with this form error, on the finer of both nets.

        draw: (m, m) normal numbers, for a sample of the posterior; None: the mean.
        """
        enough = self.rest.m <= surface.m
        finer = surface if enough else _refined(surface, max(self.rest.m, min(REFINED * surface.m, NETS[1])))
        rest = self.rest
        if draw is not None:
            drawn = torch.from_numpy(scipy.fft.idctn(draw * self.spread, norm="ortho"))
            rest = replace(rest, heights=rest.heights + sign * drawn)
        own = _on(finer, rest) + self._polynomial_heights(finer.m) + self._moved_heights(finer)
        return replace(finer, heights=finer.heights + torch.from_numpy(own))

    def at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """δz (mm) at (x, y) in mm, as aligned by least squares."""
        back, there = self.face.lens.back, (torch.from_numpy(x), torch.from_numpy(y))
        in_x, in_y = (np.polynomial.legendre.legvander(t, DEGREE) for t in _across(back, x, y))
        smooth = np.einsum("ni,ij,nj->n", in_x, self.polynomial, in_y, optimize=True)
        return smooth + self.rest.sag_and_slope(*there)[0].numpy() + self._moved(x, y)

    def _moved(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Change of z (mm) by the motion at (x, y) in mm."""
        there = torch.from_numpy(x), torch.from_numpy(y)
        z, z_x, z_y = (part.numpy() for part in self.face.lens.back.sag_and_slope(*there))
        normals = np.stack([-z_x, -z_y, np.ones_like(z)], axis=1)
        return self.face.columns(np.stack([x, y, z], axis=1), normals) @ self.motion

    def _moved_heights(self, finer: BSplineSurface) -> np.ndarray:
        """The same as heights of a net, by least squares."""
        (u, fit), (low_x, high_x), (low_y, high_y) = _line(finer.m), finer.x, finer.y
        t = u / (finer.m - 1)
        x, y = np.meshgrid(low_x + t * (high_x - low_x), low_y + t * (high_y - low_y), indexing="ij")
        return fit(fit(self._moved(x.ravel(), y.ravel()).reshape(x.shape)).T).T

    def band(self, low: float, high: float) -> BSplineSurface:
        """The part of the field between two spatial frequencies (1/mm)."""
        frequency = frequencies(self.rest)
        amplitude = scipy.fft.dctn(self.rest.heights.numpy(), norm="ortho")
        kept = np.where((frequency > low) & (frequency <= high), amplitude, 0.0)
        return replace(self.rest, heights=torch.from_numpy(scipy.fft.idctn(kept, norm="ortho")))

    def _polynomial_heights(self, m: int) -> np.ndarray:
        lines = _legendre_heights(m)
        return lines @ self.polynomial @ lines.T


def fitted(face: Face, alignment: Alignment) -> Form:
    """The form error of a cloud on its face."""
    back, points, n = face.lens.back, alignment.points, len(alignment.points)
    x, y = (np.ascontiguousarray(points[:, i]) for i in (0, 1))
    off = points[:, 2] - back.sag_and_slope(torch.from_numpy(x), torch.from_numpy(y))[0].numpy()
    i, j = np.array([(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]).T
    in_x, in_y = (np.polynomial.legendre.legvander(t, DEGREE) for t in _across(back, x, y))
    smooth = in_x[:, i] * in_y[:, j]
    motions = face.columns(points, alignment.normals / alignment.normals[:, 2:]) @ alignment.motions
    both = np.column_stack([off, motions])
    found = np.linalg.solve(smooth.T @ smooth, smooth.T @ both)
    both -= smooth @ found
    sides = [(low - MARGIN * (high - low), high + MARGIN * (high - low)) for low, high in (back.x, back.y)]
    covered = face.lens.outline.area / np.prod([high - low for low, high in sides])
    m = scipy.fft.next_fast_len(int(np.clip(np.sqrt(n / PER_CELL / covered), *NETS)), real=True)
    net = BSplineSurface(0.0, torch.zeros(m, m, dtype=torch.float64), *sides)
    u, v = ((t - low) / (high - low) * (m - 1) for t, (low, high) in zip((x, y), sides, strict=True))
    heights, spread, noise, motion = _field(net, _rows(u, v, m), both[:, 0], both[:, 1:], reach=face.reach)
    polynomial = np.zeros((DEGREE + 1, DEGREE + 1))
    polynomial[i, j] = found[:, 0] - found[:, 1:] @ motion
    rest = replace(net, heights=torch.from_numpy(heights))
    return Form(face, polynomial, rest, spread, noise=noise, motion=alignment.motions @ motion)


def frequencies(net: BSplineSurface) -> np.ndarray:
    """(m, m) spatial frequency (1/mm) of each cosine of a net."""
    half = [np.arange(net.m) / (2 * net.m * pitch) for pitch in net.pitch]
    return np.hypot(half[0][:, None], half[1][None, :])


def _across(back: BSplineSurface, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and y from -1 to 1 over the net."""
    return tuple(2 * (t - low) / (high - low) - 1 for t, (low, high) in zip((x, y), (back.x, back.y), strict=True))


def _field(
    net: BSplineSurface, rows: scipy.sparse.csr_array, off: np.ndarray, motions: np.ndarray, *, reach: float
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """(heights (m, m), standard deviation of each cosine amplitude, noise, motion) of the random field.

    motions: (n, k) changes by the motions of the alignment, without polynomials.  Their amounts follow by generalised
    least squares: the field leaves V⁻¹ off σ² of off, V the covariance of field and noise together.
    """
    m, n = net.m, len(off)
    gram = (rows.T @ rows).tocsr()
    band, bands = _bands(frequencies(net))
    modes = np.bincount(band.ravel(), minlength=bands)
    per_mode = n / m**2 * np.multiply.outer(_gram_symbol(m), _gram_symbol(m))
    level = np.bincount(band.ravel(), (1 / per_mode).ravel(), bands) / modes
    quiet = QUIET**2 * float(off @ off) / n + 1e-24
    noise2, variance = 0.25 * float(off @ off) / n + quiet, np.full((m, m), float(off @ off) / n)
    motion, amplitude, found = np.zeros(motions.shape[1]), np.zeros((m, m)), None

    def posterior(values: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        return _mean(gram, rows.T @ values, variance, noise2=noise2, per_mode=per_mode, start=start)

    for turn in range(ROUNDS):
        if turn == SETTLED:
            taken = [posterior(column) for column in motions.T]
            alone = motions - np.stack([rows @ _heights(part) for part in taken], axis=1)
            motion = _motion(motions, off, alone, noise2=noise2, reach=reach)
        still = off - motions @ motion
        amplitude = posterior(still, amplitude)
        left = still - rows @ _heights(amplitude)
        shrunk = 1 + noise2 / (per_mode * variance)  # true amplitude over its posterior mean
        energy = np.bincount(band.ravel(), ((shrunk * amplitude) ** 2 * per_mode / noise2).ravel(), bands) / modes
        found = energy if found is None else (found + energy) / 2
        free = max(n - float((1 / shrunk).sum()), 0.05 * n)
        noise2 = float(np.sqrt(noise2 * max(float(left @ left) / free, quiet)))
        variance = _variances(found, modes, level * noise2)[band]
    amplitude = posterior(off - motions @ motion, amplitude)
    spread = 1 / (per_mode / noise2 + 1 / variance)
    return scipy.fft.idctn(amplitude, norm="ortho"), np.sqrt(spread), float(np.sqrt(noise2)), motion


def _motion(motions: np.ndarray, off: np.ndarray, alone: np.ndarray, *, noise2: float, reach: float) -> np.ndarray:
    """The motion by generalised least squares; alone: V⁻¹ σ² times each column of motions."""
    normal = alone.T @ motions / noise2
    size, directions = np.linalg.eigh((normal + normal.T) / 2)
    sure = size > 1 / (LOOSE * reach) ** 2  # determined by fine relief
    return directions[:, sure] @ (directions[:, sure].T @ (alone.T @ off) / noise2 / size[sure])


def _variances(found: np.ndarray, modes: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Variance of the form in each band, from its energy over the noise's there.

    Bands below the noise continue the last bands above it as a power of the frequency, as polished and turned faces do,
    but not above the limit of detection.
    """
    least = SURE * np.sqrt(2 / modes)
    sure = found > 1 + least
    variance = np.where(sure, np.maximum(found - 1, 0.0), SILENT) * noise
    last = np.flatnonzero(sure)[-FOLLOWED:]
    beyond = np.arange(len(found)) > (last[-1] if len(last) else len(found))
    if len(last) == FOLLOWED and beyond.any():
        slope, height = np.polyfit(last, np.log(variance[last]), 1)
        onward = np.exp(np.minimum(slope, 0.0) * (np.flatnonzero(beyond) - last.mean()) + np.log(variance[last]).mean())
        variance[beyond] = np.clip(onward, SILENT * noise[beyond], (least * noise)[beyond])
    return variance


def _heights(amplitude: np.ndarray) -> np.ndarray:
    """(m²,) from cosine amplitudes (m, m)."""
    return scipy.fft.idctn(amplitude, norm="ortho").ravel()


def _mean(
    gram: scipy.sparse.csr_array, seen: np.ndarray, variance: np.ndarray, *, noise2: float, per_mode: np.ndarray,
    start: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Posterior mean (m, m) of the amplitudes, by conjugate gradients.

    In z = c / sqrt(S): (1 + sqrt(S) Cᵀ G C sqrt(S) / σ²) z = sqrt(S) Cᵀ b / σ², preconditioned by its diagonal
    for evenly spread points.
    """
    m, root = len(variance), np.sqrt(variance)
    even = 1 + variance * per_mode / noise2

    def product(z: np.ndarray) -> np.ndarray:
        return z + root * scipy.fft.dctn((gram @ _heights(root * z)).reshape(m, m), norm="ortho") / noise2

    wanted = root * scipy.fft.dctn(seen.reshape(m, m), norm="ortho") / noise2
    z = np.zeros_like(root) if start is None else start / root
    residual = wanted - product(z)
    p = prepared = residual / even
    rho, least = float((residual * prepared).sum()), ENOUGH**2 * float((wanted * wanted / even).sum())
    for _ in range(STEPS):
        if rho <= least:
            break
        q = product(p)
        alpha = rho / float((p * q).sum())
        z, residual = z + alpha * p, residual - alpha * q
        prepared = residual / even
        rho, before = float((residual * prepared).sum()), rho
        p = prepared + rho / before * p
    return root * z


def _rows(u: np.ndarray, v: np.ndarray, m: int) -> scipy.sparse.csr_array:
    """(n, m²) the nine products of each point."""
    in_u, in_v = basis_matrix(u, m), basis_matrix(v, m)
    n = len(u)
    columns = in_u.indices.reshape(n, 3, 1) * m + in_v.indices.reshape(n, 1, 3)
    values = in_u.data.reshape(n, 3, 1) * in_v.data.reshape(n, 1, 3)
    return scipy.sparse.csr_array((values.ravel(), columns.ravel(), np.arange(n + 1) * 9), shape=(n, m * m))


def _gram_symbol(m: int) -> np.ndarray:
    """Σ B(u)² of a cosine sampled evenly: (66 + 52 cos ω + 2 cos 2ω) / 120, quadratic splines."""
    w = np.pi * np.arange(m) / m
    return (66 + 52 * np.cos(w) + 2 * np.cos(2 * w)) / 120


def _bands(frequency: np.ndarray) -> tuple[np.ndarray, int]:
    """(band of each cosine, number of bands): quarters of octaves, without empty ones."""
    least = frequency[frequency > 0].min()
    found = np.floor(QUARTER * np.log2(np.maximum(frequency, least) / least)).astype(int)
    _, packed = np.unique(found, return_inverse=True)
    packed = packed.reshape(frequency.shape)
    return packed, int(packed.max()) + 1


def _line(m: int) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """(points along a net of m control points, function from values (points, …) to control points by least squares)."""
    u = np.linspace(0, m - 1, 4 * m)
    rows = basis_matrix(u, m)
    solve = scipy.sparse.linalg.splu((rows.T @ rows).tocsc())
    return u, lambda values: solve.solve(rows.T @ values)


def _legendre_heights(m: int) -> np.ndarray:
    """(m, 3) control points of the Legendre polynomials over a net."""
    u, fit = _line(m)
    return fit(np.polynomial.legendre.legvander(2 * u / (m - 1) - 1, DEGREE))


def _on(finer: BSplineSurface, rest: BSplineSurface) -> np.ndarray:
    """Heights on the net of `finer` of another spline that reaches beyond it, by least squares."""
    u, fit = _line(finer.m)
    lines = []
    for ends, own in ((finer.x, rest.x), (finer.y, rest.y)):
        there = (ends[0] + u / (finer.m - 1) * (ends[1] - ends[0]) - own[0]) / (own[1] - own[0]) * (rest.m - 1)
        lines.append(fit(basis_matrix(there, rest.m).toarray()))
    return lines[0] @ rest.heights.numpy() @ lines[1].T


def _refined(surface: BSplineSurface, m: int) -> BSplineSurface:
    """The same surface on m x m control points, to rounding in all but its end spans."""
    if surface.m == m:
        return surface
    carry = prolongation(surface.m, m)
    return replace(surface, heights=torch.from_numpy(carry @ surface.heights.numpy() @ carry.T))
