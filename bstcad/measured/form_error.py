"""The form error as a spline, separated from the noise of the measurement, and its figures.

The deviation is a polynomial and a random field, a spline on a net of the lens's extent whose cosine amplitudes c_k are
Gaussian with a variance S that depends on the frequency alone; the points add white noise σ².  S (by quarter octaves)
and σ are estimated from the points themselves, and the form is the posterior mean: of all linear estimates of heights,
slopes and curvatures the one with the least error.  The posterior can be sampled.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.fft
import scipy.sparse
import torch
from scipy.optimize import linprog
from scipy.sparse.linalg import LinearOperator, cg
from scipy.special import eval_jacobi

from bstcad.analysis.shape import least_squares
from bstcad.measured.alignment import Alignment, Face, Pose, root_mean_square, sampled
from bstcad.optics.bspline import BSplineSurface, basis_matrix, interpolated
from bstcad.optics.lens import Lens

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
STRIPS = 32  # of a net's points, sampled one after the other, so that memory holds them


@dataclass(frozen=True)
class Form:
    """A fitted form error, δz(x, y) over the net of a lens: a polynomial, a random field, and a small motion."""

    face: Face
    polynomial: np.ndarray = field(repr=False)  # (6,) coefficients of the columns of _legendre
    rest: BSplineSurface = field(repr=False)  # the random field
    spread: np.ndarray = field(repr=False)  # (m, m) standard deviation of each cosine amplitude of its net, mm
    noise: float  # of the points, RMS (mm)
    motion: np.ndarray  # (6,) in Face.columns' units, of the fine relief against the alignment, which form errors bias

    def at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """δz (mm) at (x, y) in mm, as aligned by least squares."""
        smooth = _legendre(self.face.lens.back, x, y) @ self.polynomial
        z, z_x, z_y = sampled(self.face.lens.back, x, y)
        moved = self.face.columns(np.stack([x, y, z], axis=1), np.stack([-z_x, -z_y, np.ones_like(z)], axis=1))
        return smooth + sampled(self.rest, x, y)[0] + moved @ self.motion

    def on(self, surface: BSplineSurface) -> BSplineSurface:
        """`surface` with this form error, which the finer of both nets has at the places of its control points."""
        sides = [
            own if rest <= own else max(rest, min(REFINED * own, NETS[1]))
            for rest, own in zip(self.rest.shape, surface.shape, strict=True)
        ]
        finer = surface.refined((sides[0], sides[1]))
        x, y = (np.linspace(*ends, count) for ends, count in zip((finer.x, finer.y), finer.shape, strict=True))
        strips = (np.meshgrid(part, y, indexing="ij") for part in np.array_split(x, STRIPS))
        values = np.concatenate([self.at(x.ravel(), y.ravel()).reshape(x.shape) for x, y in strips])
        return replace(finer, heights=finer.heights + torch.from_numpy(interpolated(values)))

    def drawn(self, draw: np.ndarray, sign: float = 1.0) -> Form:
        """A sample of the posterior by (m, m) normal numbers; sign: 1 or -1, of the difference from the mean."""
        change = torch.from_numpy(scipy.fft.idctn(draw * self.spread, norm="ortho"))
        return replace(self, rest=replace(self.rest, heights=self.rest.heights + sign * change))

    def band(self, low: float, high: float) -> BSplineSurface:
        """The part of the field between two spatial frequencies (1/mm)."""
        frequency = frequencies(self.rest)
        amplitude = scipy.fft.dctn(self.rest.heights.numpy(), norm="ortho")
        kept = np.where((frequency > low) & (frequency <= high), amplitude, 0.0)
        return replace(self.rest, heights=torch.from_numpy(scipy.fft.idctn(kept, norm="ortho")))


def fitted(face: Face, alignment: Alignment) -> Form:
    """The form error of a cloud on its face."""
    back, points, n = face.lens.back, alignment.points, len(alignment.points)
    x, y = np.ascontiguousarray(points[:, :2].T)
    smooth = _legendre(back, x, y)
    motions = face.columns(points, alignment.normals / alignment.normals[:, 2:]) @ alignment.motions
    both = np.column_stack([face.height(points), motions])
    coefficients = np.linalg.solve(smooth.T @ smooth, smooth.T @ both)
    both -= smooth @ coefficients
    sides = [(low - MARGIN * (high - low), high + MARGIN * (high - low)) for low, high in (back.x, back.y)]
    covered = face.lens.outline.area / np.prod([high - low for low, high in sides])
    m = scipy.fft.next_fast_len(int(np.clip(np.sqrt(n / PER_CELL / covered), *NETS)), real=True)
    net = BSplineSurface(0.0, torch.zeros(m, m, dtype=torch.float64), *sides)
    u, v = ((t - low) / (high - low) * (m - 1) for t, (low, high) in zip((x, y), sides, strict=True))
    heights, spread, noise, motion = _field(net, _rows(u, v, m), both[:, 0], both[:, 1:], reach=face.reach)
    polynomial = coefficients[:, 0] - coefficients[:, 1:] @ motion
    rest = replace(net, heights=torch.from_numpy(heights))
    return Form(face, polynomial, rest, spread, noise=noise, motion=alignment.motions @ motion)


def frequencies(net: BSplineSurface) -> np.ndarray:
    """(m, m) spatial frequency (1/mm) of each cosine of a net."""
    half = [np.arange(count) / (2 * count * pitch) for count, pitch in zip(net.shape, net.pitch, strict=True)]
    return np.hypot(half[0][:, None], half[1][None, :])


def _legendre(back: BSplineSurface, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, 6) products of Legendre polynomials of x and of y (mm) up to DEGREE, which run from -1 to 1 over the net."""
    across = (2 * (t - low) / (high - low) - 1 for t, (low, high) in zip((x, y), (back.x, back.y), strict=True))
    i, j = np.indices((DEGREE + 1, DEGREE + 1))
    return np.polynomial.legendre.legvander2d(*across, (DEGREE, DEGREE))[:, (i + j <= DEGREE).ravel()]


def _field(
    net: BSplineSurface, rows: scipy.sparse.csr_array, off: np.ndarray, motions: np.ndarray, *, reach: float
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """(heights (m, m), standard deviation of each cosine amplitude, noise, motion) of the random field.

    motions: (n, k) changes by the motions of the alignment, without polynomials.  Their amounts follow by generalised
    least squares: the field leaves V⁻¹ off σ² of off, V the covariance of field and noise together.
    """
    (m, _), n = net.shape, len(off)  # a square net of its own
    gram = (rows.T @ rows).tocsr()
    band, bands = _bands(frequencies(net))
    modes = np.bincount(band.ravel(), minlength=bands)
    per_mode = n / m**2 * np.multiply.outer(_gram_symbol(m), _gram_symbol(m))
    level = np.bincount(band.ravel(), (1 / per_mode).ravel(), bands) / modes
    quiet = QUIET**2 * float(off @ off) / n + 1e-24
    noise2, variance = 0.25 * float(off @ off) / n + quiet, np.full((m, m), float(off @ off) / n)
    motion, amplitude, energies = np.zeros(motions.shape[1]), np.zeros((m, m)), None

    def posterior(values: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        return _mean(gram, rows.T @ values, variance, noise2=noise2, per_mode=per_mode, start=start)

    for turn in range(ROUNDS):
        if turn == SETTLED:
            alone = motions - np.stack([rows @ _heights(posterior(column)) for column in motions.T], axis=1)
            motion = _motion(motions, off, alone, noise2=noise2, reach=reach)
        still = off - motions @ motion
        amplitude = posterior(still, amplitude)
        left = still - rows @ _heights(amplitude)
        shrunk = 1 + noise2 / (per_mode * variance)  # true amplitude over its posterior mean
        energy = np.bincount(band.ravel(), ((shrunk * amplitude) ** 2 * per_mode / noise2).ravel(), bands) / modes
        energies = energy if energies is None else (energies + energy) / 2
        free = max(n - float((1 / shrunk).sum()), 0.05 * n)
        noise2 = float(np.sqrt(noise2 * max(float(left @ left) / free, quiet)))
        variance = _variances(energies, modes, level * noise2)[band]
    amplitude = posterior(off - motions @ motion, amplitude)
    spread = 1 / (per_mode / noise2 + 1 / variance)
    return _heights(amplitude).reshape(m, m), np.sqrt(spread), float(np.sqrt(noise2)), motion


def _motion(motions: np.ndarray, off: np.ndarray, alone: np.ndarray, *, noise2: float, reach: float) -> np.ndarray:
    """The motion by generalised least squares; alone: V⁻¹ σ² times each column of motions."""
    normal = alone.T @ motions / noise2
    size, directions = np.linalg.eigh((normal + normal.T) / 2)
    sure = size > 1 / (LOOSE * reach) ** 2  # determined by fine relief
    return directions[:, sure] @ (directions[:, sure].T @ (alone.T @ off) / noise2 / size[sure])


def _variances(energy: np.ndarray, modes: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Variance of the form in each band, from its energy over the noise's there.

    Bands below the noise continue the last bands above it as a power of the frequency, as polished and turned faces do,
    but not above the limit of detection.
    """
    least = SURE * np.sqrt(2 / modes)
    sure = energy > 1 + least
    variance = np.where(sure, np.maximum(energy - 1, 0.0), SILENT) * noise
    last = np.flatnonzero(sure)[-FOLLOWED:]
    beyond = np.arange(len(energy)) > (last[-1] if len(last) else len(energy))
    if len(last) == FOLLOWED and beyond.any():
        slope, _ = np.polyfit(last, np.log(variance[last]), 1)
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
    """Posterior mean (m, m) of the amplitudes c, by conjugate gradients.

    (1 + sqrt(S) Cᵀ G C sqrt(S) / σ²) c / sqrt(S) = sqrt(S) Cᵀ b / σ², in c / root: divided on both sides by the square
    root of its diagonal for evenly spread points.
    """
    m, even = len(variance), 1 + variance * per_mode / noise2
    root = np.sqrt(variance / even)

    def product(scaled: np.ndarray) -> np.ndarray:
        scaled = scaled.reshape(m, m)
        relief = scipy.fft.dctn((gram @ _heights(root * scaled)).reshape(m, m), norm="ortho")
        return (scaled / even + root * relief / noise2).ravel()

    operator = LinearOperator((m * m, m * m), matvec=product, dtype=np.float64)
    right = (root * scipy.fft.dctn(seen.reshape(m, m), norm="ortho") / noise2).ravel()
    guess = None if start is None else (start / root).ravel()
    scaled_mean, _ = cg(operator, right, guess, rtol=ENOUGH, maxiter=STEPS)
    return root * scaled_mean.reshape(m, m)


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
    quarters = np.floor(QUARTER * np.log2(np.maximum(frequency, least) / least)).astype(int)
    _, packed = np.unique(quarters, return_inverse=True)
    return packed.reshape(frequency.shape), int(packed.max()) + 1


# --- figures of a deviation -------------------------------------------------------------------------------------------

GRID = 301  # points each way at which a fitted form is sampled
ZERNIKE_ORDER = 10  # n + |m| up to this: the 36 terms of the fringe set
FITTED = 50_000  # points of the fit of these
MAP = ("deviation.npz", "deviation.csv")  # the files of the map
FINEST = 2.0  # pitches of the form's net: the shortest period in it


@dataclass(frozen=True)
class Band:
    """The part of a form error in a band of periods."""

    period: tuple[float, float] | None  # longest and shortest (mm); None: the polynomial, which has none
    rms: float  # mm
    slope_rms: float  # rad


@dataclass(frozen=True)
class Deviation:
    """A made face against the designed one, along the normal, + out of the glass; lengths in mm."""

    pv: float  # of the points
    pvr: float  # of the points: PV of the best 36 Zernike terms, and three times the RMS of the rest (Evans 2009)
    rms: float  # of the points
    form_pv: float  # of the fitted form
    form_rms: float
    slope_rms: float  # rad; of the fitted form
    noise: float  # of the points, RMS
    worst: tuple[float, float]  # x, y (mm) of the farthest point
    bands: tuple[Band, ...]
    x: np.ndarray = field(repr=False)  # (GRID,) mm
    y: np.ndarray = field(repr=False)
    form: np.ndarray = field(repr=False)  # (rows y, columns x) of the fitted form, NaN outside the outline


def map_files(made: Deviation) -> dict[str, bytes]:
    """The deviation map as files by name: x, y and deviation (rows y, columns x) in mm, NaN outside the outline."""
    packed, (x, y) = io.BytesIO(), (part.ravel() for part in np.meshgrid(made.x, made.y))
    np.savez_compressed(packed, x=made.x, y=made.y, deviation=made.form)
    rows = "\n".join(map("{:.6f},{:.6f},{:.9g}".format, x, y, made.form.ravel()))
    return dict(zip(MAP, (packed.getvalue(), f"x [mm],y [mm],deviation [mm]\n{rows}\n".encode()), strict=True))


def deviation(lens: Lens, alignment: Alignment, form: Form) -> Deviation:
    """The figures of a cloud on its lens."""
    axes = [np.linspace(-a, a, GRID) for a in lens.outline.half_extent]
    x, y = np.meshgrid(*axes)
    inside = lens.outline.contains(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    x, y = x[inside], y[inside]
    _, z_x, z_y = sampled(lens.back, x, y)
    cosine = 1 / np.sqrt(1 + z_x**2 + z_y**2)  # of the normal against z
    off, half = form.at(x, y), min(form.rest.pitch) / 4
    off_x, off_y = ((form.at(x + a, y + b) - form.at(x - a, y - b)) / (2 * half) for a, b in ((half, 0.0), (0.0, half)))
    form_map = np.full(inside.shape, np.nan)
    form_map[inside] = along_normal = cosine * off
    worst_x, worst_y, _ = alignment.points[np.argmax(np.abs(alignment.distances))]
    return Deviation(
        pv=float(np.ptp(alignment.distances)), pvr=robust_pv(alignment.points, alignment.distances), rms=alignment.rms,
        form_pv=float(np.ptp(along_normal)), form_rms=root_mean_square(along_normal),
        slope_rms=float(np.sqrt(np.mean(off_x**2 + off_y**2))), noise=form.noise,
        worst=(float(worst_x), float(worst_y)),
        bands=_octaves(form, x, y, np.stack([off, off_x, off_y])), x=axes[0], y=axes[1], form=form_map,
    )  # fmt: skip


def _octaves(form: Form, x: np.ndarray, y: np.ndarray, total: np.ndarray) -> tuple[Band, ...]:
    """The rest of the (3, n) total, then the random field by octaves of its period, the longest first."""
    shortest = FINEST * max(form.rest.pitch)
    period = 2 * max(high - low for low, high in (form.rest.x, form.rest.y))  # of the slowest cosine
    bands = [_band(None, total - sampled(form.rest, x, y))]
    while period > shortest:
        finest = np.inf if period / 2 <= shortest else 2 / period
        bands.append(_band((period, period / 2), sampled(form.band(1 / period, finest), x, y)))
        period = period / 2
    return tuple(bands)


def _band(period: tuple[float, float] | None, part: np.ndarray) -> Band:
    """Of (3, n) heights (mm) and slopes (rad)."""
    return Band(period, root_mean_square(part[0]), float(np.sqrt(np.mean(part[1] ** 2 + part[2] ** 2))))


def robust_pv(points: np.ndarray, distances: np.ndarray) -> float:
    """PV of a 36-term Zernike fit, and three times the RMS of the rest (Evans, Opt. Eng. 48, 043605, 2009)."""
    radius = float(np.hypot(points[:, 0], points[:, 1]).max())
    terms = zernike(points[:, 0] / radius, points[:, 1] / radius)
    some = slice(None, None, 1 + len(points) // FITTED)
    fit = terms @ least_squares(terms[some], distances[some])
    return float(np.ptp(fit)) + 3 * root_mean_square(distances - fit)


def zernike(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, 36) the fringe set on the unit circle: all terms with n + |m| <= 10.

    R(r) = (-1)^k r^m P_k^(m, 0)(1 - 2 r²), k = (n - m) / 2, with Jacobi's polynomials P.
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

ZONE_OFF = 1e-3  # of the minimum zone: points lie outside by less
ZONE_POINTS = 400  # in the first linear program, and that join it at a time
ZONE_ROUNDS = 30


def minimum_zone(face: Face, alignment: Alignment) -> tuple[float, Pose]:
    """(width in mm, pose removed from the cloud) of the narrowest zone between two envelopes of spheres on the design.

    Its width is twice the largest distance, least by a motion (Chebyshev): min t, |d_i + n_i · motion| <= t for all
    points, from the alignment by least squares, over the motions that the face determines.  Few points decide it: the
    linear program begins with those of the largest distances, and takes in those that its solution leaves outside,
    until they lie outside by less than ZONE_OFF of the width.
    """
    columns = face.columns(alignment.points, alignment.normals) @ alignment.motions
    distances, motion = alignment.distances, np.zeros(alignment.motions.shape[1])
    chosen = _farthest(distances)
    for _ in range(ZONE_ROUNDS):
        motion, half = _chebyshev(columns[chosen], distances[chosen])
        left = distances + columns @ motion
        if np.abs(left).max() <= half * (1 + ZONE_OFF):
            break
        chosen = np.union1d(chosen, _farthest(left))
    width = 2 * float(np.abs(distances + columns @ motion).max())
    return width, alignment.pose.after(alignment.motions @ motion, face.reach)


def _farthest(distances: np.ndarray) -> np.ndarray:
    """Indices of the farthest points on either side."""
    count = min(ZONE_POINTS // 2, len(distances))
    return np.union1d(np.argpartition(distances, -count)[-count:], np.argpartition(distances, count - 1)[:count])


def _chebyshev(columns: np.ndarray, distances: np.ndarray) -> tuple[np.ndarray, float]:
    """(motion, largest distance) of these points alone, solved in units of their largest distance."""
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
