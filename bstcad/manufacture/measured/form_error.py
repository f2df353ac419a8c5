"""Fit the form error of a made face as a spline, separate it from measurement noise, and state its figures.

The deviation is modelled as a polynomial plus a random field, a spline on a net over the lens.  The amplitudes c_k of
the net's cosine transform are Gaussian with a variance S that depends only on the frequency; the points have white
noise of variance σ².  S (in bands of a quarter octave) and σ are estimated from the points.  The form error is the
posterior mean, the minimum-error linear estimate of heights, slopes and curvatures.  The posterior can be sampled.

Where points are sparse, the fine relief between them is the design's at the pose of the alignment.  The uncertainty of
this pose therefore belongs to the posterior: it adds to the precision of a motion by fine relief that of the alignment.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.fft
import scipy.sparse
import torch
from scipy.linalg import hadamard
from scipy.optimize import linprog
from scipy.sparse.linalg import LinearOperator, cg
from scipy.special import eval_jacobi, log_ndtr

from bstcad.analysis.shape import least_squares
from bstcad.manufacture.measured.alignment import (
    INDEPENDENT_PATCHES,
    LOW_ORDER_FORMS,
    MIN_POINT_NOISE,
    Alignment,
    BackFace,
    Pose,
    root_mean_square,
)  # fmt: skip
from bstcad.manufacture.measured.shrinkage import orders
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import BSplineSurface, basis_matrix, interpolating_net
from bstcad.optics.surfaces.surfaces import sag, sampled

POLYNOMIAL_DEGREE = 2  # degree of the polynomial in x and y
NET_MARGIN = 0.2  # margin (at each end) of the field's net / side of the lens's net; there cosines end with zero slope
POINTS_PER_NET_CELL = 6.0  # mean number of measured points in a cell of the field's net
FIELD_NET_LIMITS = (15, 513)  # limits of the field's control points per side, before they are rounded up for the FFT
MAX_REFINEMENT = 4  # refinement per side of a lens's net to which a finer field is added: the two nets are not nested
BANDS_PER_OCTAVE = 4  # number of bands of the spectrum per octave of frequency
SPECTRUM_ROUNDS = 8  # number of alternating estimates of field and spectrum
FIRST_MOTION_ROUND = 3  # round, from 0, in which the motion is fitted; the spectrum is then good enough to weight it
MOTION_SAFETY = 2.0  # factor on the uncertainty of the motion, as its weights are estimated from the same points
MAX_FIELD_STEPS, FIELD_TOLERANCE = 30, 1e-4  # maximum steps of conjugate gradients, and their relative tolerance
DETECTION_SIGMAS = 3.0  # excess over noise, in standard deviations, at which a band of frequencies contains form
UNDETECTED_VARIANCE = 1e-4  # variance of the form / variance of the noise, in a band without detected form
MAX_RELIEF_UNCERTAINTY = 0.001  # uncertainty of a motion fitted to fine relief / BackFace.reach, above which it is zero
SMOOTH_EXPONENT = (
    3.0  # least exponent by which the variance of undetected form falls with the frequency: polished faces
)
SAMPLES = 8  # number of posterior_samples, a Hadamard matrix's order; more than the six motions
EXTRAPOLATION_BANDS = 6  # number of bands from which the spectrum is extrapolated below the noise
MIN_NOISE_RATIO = 1e-3  # lower bound of the noise relative to the RMS deviation
SAMPLING_STRIPS = 32  # number of strips in which a net is sampled, which bounds the memory


@dataclass(frozen=True)
class Displaced:
    """Changes of a form error by k independent displacements of the alignment, of one standard deviation each."""

    polynomial: np.ndarray  # changes (6, k) of the polynomial's coefficients, mm
    heights: np.ndarray  # changes (m², k) of the field's heights, mm
    motion: np.ndarray  # displacements (6, k), mm; see BackFace.columns


@dataclass(frozen=True)
class FormError:
    """Fitted form error δz(x, y) over the net of a lens: a polynomial, a random field, and a small rigid motion."""

    face: BackFace
    polynomial: np.ndarray = field(repr=False)  # coefficients (6,) of the columns of _legendre, mm
    random_field: BSplineSurface = field(repr=False)
    spread: np.ndarray = field(repr=False)  # standard deviations (m, m) of the field's cosine amplitudes, mm
    noise: float  # RMS noise of the points, mm
    motion: np.ndarray  # correction (6,) of the alignment by fine relief, mm; see BackFace.columns
    displaced: Displaced = field(repr=False)

    def at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return δz (mm) at (x, y) in mm, relative to the alignment by least squares."""
        smooth = _legendre(self.face.lens.back_net, x, y) @ self.polynomial
        z, z_x, z_y = sampled(self.face.lens.back, x, y)
        moved = self.face.columns(np.stack([x, y, z], axis=1), np.stack([-z_x, -z_y, np.ones_like(z)], axis=1))
        return smooth + sag(self.random_field, x, y) + moved @ self.motion

    def add_to(self, surface: BSplineSurface) -> BSplineSurface:
        """Return `surface` plus this form error, on the net of `surface`, which is refined if the field's is finer."""
        sides = [
            own if count <= own else max(count, min(MAX_REFINEMENT * own, FIELD_NET_LIMITS[1]))
            for count, own in zip(self.random_field.shape, surface.shape, strict=True)
        ]
        finer = surface.refined((sides[0], sides[1]))
        x, y = (np.linspace(*ends, count) for ends, count in zip((finer.x, finer.y), finer.shape, strict=True))
        strips = (np.meshgrid(part, y, indexing="ij") for part in np.array_split(x, SAMPLING_STRIPS))
        values = np.concatenate([self.at(x.ravel(), y.ravel()).reshape(x.shape) for x, y in strips])
        return replace(finer, heights=finer.heights + torch.from_numpy(interpolating_net(values)))

    def posterior_samples(self, random: np.random.Generator) -> Iterator[FormError]:
        """Yield SAMPLES samples of the posterior whose displacements have orthogonal directions.

        The mean square of a linear figure's changes is then the sum over the squares of those by each displacement.
        """
        count = self.displaced.motion.shape[1]
        yield from (self.posterior_sample(random, signs=row[1 : count + 1]) for row in hadamard(SAMPLES))

    def posterior_sample(
        self, random: np.random.Generator, sign: float = 1.0, signs: np.ndarray | None = None
    ) -> FormError:
        """Return a sample of the posterior; sign: ±1, factor of its difference from the mean.

        Each displacement has its standard deviation, so that a sample never hides one.  signs (k,): directions ±1 of
        the displacements; None: random.
        """
        field_change = scipy.fft.idctn(random.normal(size=self.spread.shape) * self.spread, norm="ortho")
        signs = random.choice((-1.0, 1.0), self.displaced.motion.shape[1]) if signs is None else signs
        change = sign * (field_change + (self.displaced.heights @ signs).reshape(field_change.shape))
        return replace(
            self,
            polynomial=self.polynomial + sign * self.displaced.polynomial @ signs,
            random_field=replace(self.random_field, heights=self.random_field.heights + torch.from_numpy(change)),
            motion=self.motion + sign * self.displaced.motion @ signs,
        )

    def band(self, low: float, high: float) -> BSplineSurface:
        """Return the part of the field between two spatial frequencies (1/mm)."""
        frequency = frequencies(self.random_field)
        amplitude = scipy.fft.dctn(self.random_field.heights.numpy(), norm="ortho")
        selected = np.where((frequency > low) & (frequency <= high), amplitude, 0.0)
        return replace(self.random_field, heights=torch.from_numpy(scipy.fft.idctn(selected, norm="ortho")))


def fit_form_error(face: BackFace, alignment: Alignment) -> FormError:
    """Fit the form error of a face to an aligned cloud."""
    back, points, n = face.lens.back_net, alignment.points, len(alignment.points)
    x, y = np.ascontiguousarray(points[:, :2].T)
    smooth = _legendre(back, x, y)
    motions = face.columns(points, alignment.normals / alignment.normals[:, 2:]) @ alignment.motions
    targets = np.column_stack([face.height(points), motions])
    coefficients = np.linalg.solve(smooth.T @ smooth, smooth.T @ targets)
    targets -= smooth @ coefficients
    sides = [(low - NET_MARGIN * (high - low), high + NET_MARGIN * (high - low)) for low, high in (back.x, back.y)]
    covered = face.lens.outline.area / np.prod([high - low for low, high in sides])
    m = scipy.fft.next_fast_len(int(np.clip(np.sqrt(n / POINTS_PER_NET_CELL / covered), *FIELD_NET_LIMITS)), real=True)
    net = BSplineSurface(0.0, torch.zeros(m, m, dtype=torch.float64), sides[0], sides[1])
    u, v = ((t - low) / (high - low) * (m - 1) for t, (low, high) in zip((x, y), sides, strict=True))
    heights, spread, noise, motion, (displacements, responses) = _field(
        net, _basis_rows(u, v, m), targets[:, 0], targets[:, 1:], aligned=precision(face, alignment), reach=face.reach
    )
    polynomial = coefficients[:, 0] - coefficients[:, 1:] @ motion
    random_field = replace(net, heights=torch.from_numpy(heights))
    displaced = Displaced(-coefficients[:, 1:] @ displacements, responses, alignment.motions @ displacements)
    return FormError(
        face, polynomial, random_field, spread, noise=noise, motion=alignment.motions @ motion, displaced=displaced
    )


def precision(face: BackFace, alignment: Alignment) -> np.ndarray:
    """Return the precision (k, k), 1/mm², of the alignment's motions: Bᵀ B / (n v), B: their columns.

    v = v_low / LOW_ORDER_FORMS + v_rest / INDEPENDENT_PATCHES.  v_low is the mean square (mm²) of the distances' low
    orders without noise: form errors that may resemble a motion.  v_rest is that of the rest, mostly noise.
    """
    columns, n = face.columns(alignment.points, alignment.normals) @ alignment.motions, len(alignment.points)
    basis, _ = np.linalg.qr(orders(alignment.points))
    inside = basis.T @ alignment.distances
    rest = (n * alignment.rms**2 - inside @ inside) / (n - len(inside))
    low = max(inside @ inside - len(inside) * rest, 0.0) / n
    variance = low / LOW_ORDER_FORMS + rest / min(n, INDEPENDENT_PATCHES)
    return columns.T @ columns / (n * max(variance, MIN_POINT_NOISE**2))


def frequencies(net: BSplineSurface) -> np.ndarray:
    """Return the spatial frequencies (m, m), 1/mm, of the cosines of a net."""
    half = [np.arange(count) / (2 * count * pitch) for count, pitch in zip(net.shape, net.pitch, strict=True)]
    return np.hypot(half[0][:, None], half[1][None, :])


def _legendre(back: BSplineSurface, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the products (n, 6) of Legendre polynomials up to POLYNOMIAL_DEGREE, of x and y scaled to ±1."""
    u, v = (2 * (t - low) / (high - low) - 1 for t, (low, high) in zip((x, y), (back.x, back.y), strict=True))
    i, j = np.indices((POLYNOMIAL_DEGREE + 1, POLYNOMIAL_DEGREE + 1))
    products = np.polynomial.legendre.legvander2d(u, v, (POLYNOMIAL_DEGREE, POLYNOMIAL_DEGREE))
    return products[:, (i + j <= POLYNOMIAL_DEGREE).ravel()]


def _field(
    net: BSplineSurface, rows: scipy.sparse.csr_array, off: np.ndarray, motions: np.ndarray, *,
    aligned: np.ndarray, reach: float,
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray, tuple[np.ndarray, np.ndarray]]:  # fmt: skip
    """Return the field's heights (m, m), standard deviations (m, m) of its amplitudes, the noise (mm) and motion (k,).

    Last are k independent displacements (k, k) of one standard deviation, mm, and the heights (m², k) that they change.
    rows: basis functions (n, m²).  off: deviations (n,), mm; motions: their changes (n, k), mm/mm; polynomials removed.
    Generalised least squares give the motion: a fit of the field has the residual σ² V⁻¹ off, V: covariance of `off`.
    aligned: precision (k, k) of the motions by the alignment, 1/mm².
    """
    (m, _), n = net.shape, len(off)  # the net is square
    gram = (rows.T @ rows).tocsr()
    band, bands = _bands(frequencies(net))
    modes = np.bincount(band.ravel(), minlength=bands)
    per_mode = n / m**2 * np.multiply.outer(_gram_symbol(m), _gram_symbol(m))
    level = np.bincount(band.ravel(), (1 / per_mode).ravel(), bands) / modes
    min_variance = MIN_NOISE_RATIO**2 * float(off @ off) / n + 1e-24
    noise2, variance = 0.25 * float(off @ off) / n + min_variance, np.full((m, m), float(off @ off) / n)
    motion, amplitude, energies = np.zeros(motions.shape[1]), np.zeros((m, m)), None

    def posterior(values: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        return _posterior_mean(gram, rows.T @ values, variance, noise2=noise2, per_mode=per_mode, start=start)

    def explained(columns: np.ndarray) -> np.ndarray:
        """Return the heights (m², k) by which the field explains changes (n, k) of the deviations."""
        return np.stack([_heights(posterior(column)) for column in columns.T], axis=1)

    def fit_motion() -> tuple[np.ndarray, np.ndarray]:
        """Return the motion (k,) by fine relief, and its precision (k, k) with that of the alignment, 1/mm²."""
        whitened = (motions - rows @ explained(motions)) / noise2
        size, directions = np.linalg.eigh((whitened.T @ motions + motions.T @ whitened) / 2)
        detected = directions[:, size > 1 / (MAX_RELIEF_UNCERTAINTY * reach) ** 2]
        information = detected.T @ (whitened.T @ motions) @ detected
        motion = detected @ np.linalg.solve(information, detected.T @ (whitened.T @ off))
        total = detected @ information @ detected.T + aligned
        return motion, (total + total.T) / 2

    for turn in range(SPECTRUM_ROUNDS):
        if turn == FIRST_MOTION_ROUND:
            motion, total = fit_motion()
        aligned_off = off - motions @ motion
        amplitude = posterior(aligned_off, amplitude)
        residual = aligned_off - rows @ _heights(amplitude)
        shrunk = 1 + noise2 / (per_mode * variance)  # ratio of the least-squares amplitude to its posterior mean
        energy = np.bincount(band.ravel(), ((shrunk * amplitude) ** 2 * per_mode / noise2).ravel(), bands) / modes
        energies = energy if energies is None else (energies + energy) / 2
        free = max(n - float((1 / shrunk).sum()), 0.05 * n)
        noise2 = float(np.sqrt(noise2 * max(float(residual @ residual) / free, min_variance)))
        variance, possible = (of(energies, modes, level * noise2)[band] for of in (_variances, _possible_variances))
    amplitude = posterior(off - motions @ motion, amplitude)
    spread = 1 / (per_mode / noise2 + 1 / possible)
    size, directions = np.linalg.eigh(total)
    displacements = MOTION_SAFETY * directions / np.sqrt(size)
    changes = displacements, -explained(motions @ displacements)
    return _heights(amplitude).reshape(m, m), np.sqrt(spread), float(np.sqrt(noise2)), motion, changes


def _variances(energy: np.ndarray, modes: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the variance (mm²) of the form in each band.

    energy: mean square of a band's amplitudes relative to `noise`, their variance due to noise (mm²); modes: number of
    amplitudes.  Beyond the last detected band, the variance is extrapolated with a power law of the frequency, which
    polished and turned faces follow, but stays below the limit of detection.
    """
    least = DETECTION_SIGMAS * np.sqrt(2 / modes)
    detected = energy > 1 + least
    variance = np.where(detected, np.maximum(energy - 1, 0.0), UNDETECTED_VARIANCE) * noise
    last = np.flatnonzero(detected)[-EXTRAPOLATION_BANDS:]
    higher = np.arange(len(energy)) > (last[-1] if len(last) else len(energy))
    if len(last) == EXTRAPOLATION_BANDS and higher.any():
        slope, _ = np.polyfit(last, np.log(variance[last]), 1)
        trend = np.exp(np.minimum(slope, 0.0) * (np.flatnonzero(higher) - last.mean()) + np.log(variance[last]).mean())
        variance[higher] = np.clip(trend, UNDETECTED_VARIANCE * noise[higher], (least * noise)[higher])
    return variance


def _possible_variances(energy: np.ndarray, modes: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the variance (mm²) that the form may have in each band, for samples; arguments as in _variances.

    Where fewer than EXTRAPOLATION_BANDS bands are detected, an undetected one may have the mean of a normal
    distribution of the excess energy, truncated at zero.  Beyond the last detected band the spectrum falls.
    """
    variance, deviation = _variances(energy, modes, noise), np.sqrt(2 / modes)
    detected = np.flatnonzero(energy > 1 + DETECTION_SIGMAS * deviation)
    if len(detected) >= EXTRAPOLATION_BANDS:
        return variance
    excess = (energy - 1) / deviation
    log_density = -(excess**2) / 2 - math.log(math.sqrt(2 * math.pi))  # logarithm of the normal density
    possible = noise * deviation * (excess + np.exp(log_density - log_ndtr(excess)))
    possible[detected] = variance[detected]
    last = detected[-1] if len(detected) else 0
    octaves = np.maximum(np.arange(len(energy)) - last, 0) / BANDS_PER_OCTAVE
    return np.maximum(np.minimum(possible, possible[last] * 2.0 ** (-SMOOTH_EXPONENT * octaves)), variance)


def _heights(amplitude: np.ndarray) -> np.ndarray:
    return scipy.fft.idctn(amplitude, norm="ortho").ravel()


def _posterior_mean(
    gram: scipy.sparse.csr_array, right_side: np.ndarray, variance: np.ndarray, *, noise2: float, per_mode: np.ndarray,
    start: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return the posterior mean (m, m) of the amplitudes c, by conjugate gradients.

    (1 + sqrt(S) Cᵀ G C sqrt(S) / σ²) c / sqrt(S) = sqrt(S) Cᵀ b / σ² is solved for c / sqrt(S), preconditioned as if
    Cᵀ G C were `per_mode`.  C: inverse cosine transform; G: `gram`; b: `right_side`; S: `variance`; σ²: `noise2`.
    """
    m, even = len(variance), 1 + variance * per_mode / noise2
    root = np.sqrt(variance / even)

    def product(scaled: np.ndarray) -> np.ndarray:
        scaled = scaled.reshape(m, m)
        relief = scipy.fft.dctn((gram @ _heights(root * scaled)).reshape(m, m), norm="ortho")
        return (scaled / even + root * relief / noise2).ravel()

    operator = LinearOperator((m * m, m * m), matvec=product, dtype=np.float64)
    right = (root * scipy.fft.dctn(right_side.reshape(m, m), norm="ortho") / noise2).ravel()
    guess = None if start is None else (start / root).ravel()
    scaled_mean, _ = cg(operator, right, guess, rtol=FIELD_TOLERANCE, maxiter=MAX_FIELD_STEPS)
    return root * scaled_mean.reshape(m, m)


def _basis_rows(u: np.ndarray, v: np.ndarray, m: int) -> scipy.sparse.csr_array:
    """Return the matrix (n, m²) of the nine nonzero products of basis functions at each point (u, v), in pitches."""
    in_u, in_v = basis_matrix(u, m), basis_matrix(v, m)
    n = len(u)
    columns = in_u.indices.reshape(n, 3, 1) * m + in_v.indices.reshape(n, 1, 3)
    values = in_u.data.reshape(n, 3, 1) * in_v.data.reshape(n, 1, 3)
    return scipy.sparse.csr_array((values.ravel(), columns.ravel(), np.arange(n + 1) * 9), shape=(n, m * m))


def _gram_symbol(m: int) -> np.ndarray:
    """Return the symbol (66 + 52 cos ω + 2 cos 2ω) / 120 of quadratic B-splines' Gram matrix, ω = π k / m, k < m."""
    w = np.pi * np.arange(m) / m
    return (66 + 52 * np.cos(w) + 2 * np.cos(2 * w)) / 120


def _bands(frequency: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the number, from 0, of each cosine's band (a quarter octave), and how many bands are not empty."""
    least = frequency[frequency > 0].min()
    quarters = np.floor(BANDS_PER_OCTAVE * np.log2(np.maximum(frequency, least) / least)).astype(int)
    _, packed = np.unique(quarters, return_inverse=True)
    return packed.reshape(frequency.shape), int(packed.max()) + 1


# --- figures of a deviation -------------------------------------------------------------------------------------------

DEVIATION_MAP_POINTS = 301  # number of points per side of the deviation map
ZERNIKE_ORDER = 10  # maximum n + |m| of the 36 terms of the fringe set
ZERNIKE_FIT_POINTS = 50_000  # maximum number of points to which Zernike terms are fitted
MAP_FILES = ("deviation.npz", "deviation.csv")  # file names of the deviation map
SHORTEST_PERIOD = 2.0  # shortest period of a form error, in pitches of the field's net


@dataclass(frozen=True)
class Band:
    """Part of a form error in a band of periods."""

    period: tuple[float, float] | None  # longest and shortest period, mm; None: polynomial and motion
    rms: float  # RMS height, mm
    slope_rms: float  # RMS slope, rad


@dataclass(frozen=True)
class Deviation:
    """Deviation of a made face from the design along the normal, positive outside the glass; lengths in mm."""

    pv: float  # peak to valley of the points
    pvr: float  # robust PV of the points: PV of 36 Zernike terms plus three times the RMS residual (Evans 2009)
    rms: float  # RMS of the points
    form_pv: float  # peak to valley of the fitted form
    form_rms: float  # RMS of the fitted form
    slope_rms: float  # RMS slope of the fitted form, rad
    noise: float  # RMS noise of the points
    worst: tuple[float, float]  # x, y of the point with the largest deviation
    bands: tuple[Band, ...]
    x: np.ndarray = field(repr=False)  # coordinates of the map's columns (DEVIATION_MAP_POINTS,)
    y: np.ndarray = field(repr=False)  # coordinates of the map's rows (DEVIATION_MAP_POINTS,)
    form: np.ndarray = field(repr=False)  # map of the fitted form (rows y, columns x), NaN outside the outline


def map_files(made: Deviation) -> dict[str, bytes]:
    """Return the deviation map as files by name: x, y, deviation (rows y, columns x) in mm, NaN outside the outline."""
    packed, (x, y) = io.BytesIO(), (part.ravel() for part in np.meshgrid(made.x, made.y))
    np.savez_compressed(packed, x=made.x, y=made.y, deviation=made.form)
    rows = "\n".join(map("{:.6f},{:.6f},{:.9g}".format, x, y, made.form.ravel()))
    return dict(zip(MAP_FILES, (packed.getvalue(), f"x [mm],y [mm],deviation [mm]\n{rows}\n".encode()), strict=True))


def deviation(lens: Lens, alignment: Alignment, form: FormError) -> Deviation:
    """Return the deviation of the back face of a made part from `lens`."""
    axes = [np.linspace(-a, a, DEVIATION_MAP_POINTS) for a in lens.outline.half_extent]
    x, y = np.meshgrid(*axes)
    inside = lens.outline.contains(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    x, y = x[inside], y[inside]
    _, z_x, z_y = sampled(lens.back, x, y)
    cosine = 1 / np.sqrt(1 + z_x**2 + z_y**2)  # cosine of the angle between normal and z
    off, half = form.at(x, y), min(form.random_field.pitch) / 4
    off_x, off_y = ((form.at(x + a, y + b) - form.at(x - a, y - b)) / (2 * half) for a, b in ((half, 0.0), (0.0, half)))
    form_map = np.full(inside.shape, np.nan)
    form_map[inside] = along_normal = cosine * off
    distances = alignment.distances
    worst_x, worst_y, _ = alignment.points[np.argmax(np.abs(distances))].tolist()
    points = {"pv": float(np.ptp(distances)), "pvr": robust_pv(alignment.points, distances), "rms": alignment.rms}
    slope = float(np.sqrt(np.mean(off_x**2 + off_y**2)))
    fitted = {"form_pv": float(np.ptp(along_normal)), "form_rms": root_mean_square(along_normal), "slope_rms": slope}
    bands, worst = _octaves(form, x, y, np.stack([off, off_x, off_y])), (worst_x, worst_y)
    return Deviation(
        **points, **fitted, noise=form.noise, worst=worst, bands=bands, x=axes[0], y=axes[1], form=form_map
    )


def _octaves(form: FormError, x: np.ndarray, y: np.ndarray, total: np.ndarray) -> tuple[Band, ...]:
    """Split the form's height and slopes, `total` (3, n), into the part without the field, and octaves of the field."""
    shortest = SHORTEST_PERIOD * max(form.random_field.pitch)
    period = 2 * max(high - low for low, high in (form.random_field.x, form.random_field.y))  # first cosine (mm)
    bands = [_band(None, total - np.stack(sampled(form.random_field, x, y)))]
    while period > shortest:
        finest = np.inf if period / 2 <= shortest else 2 / period
        bands.append(_band((period, period / 2), sampled(form.band(1 / period, finest), x, y)))
        period = period / 2
    return tuple(bands)


def _band(period: tuple[float, float] | None, part: Sequence[np.ndarray] | np.ndarray) -> Band:
    return Band(period, root_mean_square(part[0]), float(np.sqrt(np.mean(part[1] ** 2 + part[2] ** 2))))


def robust_pv(points: np.ndarray, distances: np.ndarray) -> float:
    """Return PV of a 36-term Zernike fit plus three times the RMS residual (Evans, Opt. Eng. 48, 043605, 2009)."""
    radius = float(np.hypot(points[:, 0], points[:, 1]).max())
    terms = zernike(points[:, 0] / radius, points[:, 1] / radius)
    some = slice(None, None, 1 + len(points) // ZERNIKE_FIT_POINTS)
    fit = terms @ least_squares(terms[some], distances[some])
    return float(np.ptp(fit)) + 3 * root_mean_square(distances - fit)


def zernike(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the fringe set (points, 36) on the unit circle: all Zernike terms with n + |m| <= 10.

    R(r) = (-1)^k r^m P_k^(m, 0)(1 - 2 r²), k = (n - m) / 2, with Jacobi polynomials P.
    """
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    terms = []
    for n in range(ZERNIKE_ORDER + 1):
        for m in range(n % 2, min(n, ZERNIKE_ORDER - n) + 1, 2):
            k = (n - m) // 2
            radial = (-1) ** k * radius**m * eval_jacobi(k, m, 0, 1 - 2 * radius**2)
            terms += [radial * np.cos(m * angle)] + ([radial * np.sin(m * angle)] if m else [])
    return np.stack(terms, axis=1)


# --- the minimum zone -------------------------------------------------------------------------------------------------

ZONE_TOLERANCE = 1e-3  # distance by which points may lie outside the minimum zone, relative to its half width
ZONE_CHUNK = 400  # largest number of points in the first linear program, and added in each round
MAX_ZONE_ROUNDS = 30  # maximum number of linear programs


def minimum_zone(face: BackFace, alignment: Alignment) -> tuple[float, Pose]:
    """Return width (mm) and pose of the narrowest zone between two envelopes of spheres centred on the design.

    The width is twice the largest distance, minimised over the motions that the face determines (Chebyshev): min t
    subject to |d_i + c_i · motion| <= t for all points i, with c_i as in BackFace.columns, starting from the alignment
    by least squares.  Few points are active: the linear program begins with the largest distances, and points outside
    its solution are added until none lies outside by more than ZONE_TOLERANCE.
    """
    columns = face.columns(alignment.points, alignment.normals) @ alignment.motions
    distances, motion = alignment.distances, np.zeros(alignment.motions.shape[1])
    chosen = _farthest(distances)
    for _ in range(MAX_ZONE_ROUNDS):
        motion, half = _chebyshev(columns[chosen], distances[chosen])
        residual = distances + columns @ motion
        if np.abs(residual).max() <= half * (1 + ZONE_TOLERANCE):
            break
        chosen = np.union1d(chosen, _farthest(residual))
    width = 2 * float(np.abs(distances + columns @ motion).max())
    return width, alignment.pose.compose(alignment.motions @ motion, face.reach)


def _farthest(distances: np.ndarray) -> np.ndarray:
    count = min(ZONE_CHUNK // 2, len(distances))
    return np.union1d(np.argpartition(distances, -count)[-count:], np.argpartition(distances, count - 1)[:count])


def _chebyshev(columns: np.ndarray, distances: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the motion that minimises the largest distance of these points, and that distance (mm)."""
    unit = max(float(np.abs(distances).max()), 1e-12)
    size = np.abs(columns).max(axis=0)
    scaled, ones = columns / size, np.ones((len(columns), 1))
    optimum = linprog(
        np.append(np.zeros(columns.shape[1]), 1.0),
        A_ub=np.block([[scaled, -ones], [-scaled, -ones]]),
        b_ub=np.concatenate([-distances, distances]) / unit,
        bounds=[(None, None)] * columns.shape[1] + [(0, None)],
        method="highs",
    )
    return optimum.x[:-1] / size * unit, float(optimum.x[-1]) * unit
