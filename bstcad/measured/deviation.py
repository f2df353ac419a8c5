"""Figures of a deviation: PV, PVr, RMS, slopes, shares of bands of spatial frequency, and the minimum zone."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from math import factorial

import numpy as np
import torch
from scipy.optimize import linprog

from bstcad.analysis.shape import least_squares
from bstcad.measured.alignment import Alignment, Face, Pose, root_mean_square
from bstcad.measured.form_error import Form
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens

GRID = 301  # points each way at which a fitted form is sampled
ZERNIKE_ORDER = 10  # n + |m| up to this: the 36 terms of the fringe set
FITTED = 50_000  # points of the fit of these
MAP = ("deviation.npz", "deviation.csv")  # the files of the map
FINEST = 2.0  # pitches of the form's net: the shortest period in it
ZONE_OFF = 1e-3  # of the minimum zone: points lie outside by less
ZONE_POINTS = 400  # in the first linear program, and that join it at a time
ZONE_ROUNDS = 30


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


def map_files(found: Deviation) -> dict[str, bytes]:
    """The deviation map as files by name: x, y and deviation (rows y, columns x) in mm, NaN outside the outline."""
    packed, (x, y) = io.BytesIO(), (part.ravel() for part in np.meshgrid(found.x, found.y))
    np.savez_compressed(packed, x=found.x, y=found.y, deviation=found.form)
    rows = "\n".join(map("{:.6f},{:.6f},{:.9g}".format, x, y, found.form.ravel()))
    return dict(zip(MAP, (packed.getvalue(), f"x [mm],y [mm],deviation [mm]\n{rows}\n".encode()), strict=True))


def deviation(lens: Lens, alignment: Alignment, form: Form) -> Deviation:
    """The figures of a cloud on its lens."""
    axes = [np.linspace(-a, a, GRID) for a in lens.outline.half_extent]
    grid = [part.ravel() for part in np.meshgrid(*axes)]
    inside = lens.outline.contains(*map(torch.from_numpy, grid)).numpy()
    x, y = (part[inside] for part in grid)
    _, z_x, z_y = (part.numpy() for part in lens.back.sag_and_slope(torch.from_numpy(x), torch.from_numpy(y)))
    cosine = 1 / np.sqrt(1 + z_x**2 + z_y**2)  # of the normal against z
    off, half = form.at(x, y), min(form.rest.pitch) / 4
    off_x, off_y = ((form.at(x + a, y + b) - form.at(x - a, y - b)) / (2 * half) for a, b in ((half, 0.0), (0.0, half)))
    found = np.full(GRID * GRID, np.nan)
    found[inside] = cosine * off
    worst = int(np.argmax(np.abs(alignment.distances)))
    return Deviation(
        pv=float(np.ptp(alignment.distances)), pvr=robust_pv(alignment.points, alignment.distances), rms=alignment.rms,
        form_pv=float(np.ptp(found[inside])), form_rms=root_mean_square(found[inside]),
        slope_rms=float(np.sqrt(np.mean(off_x**2 + off_y**2))), noise=form.noise,
        worst=(float(alignment.points[worst, 0]), float(alignment.points[worst, 1])),
        bands=_bands(form, x, y, np.stack([off, off_x, off_y])), x=axes[0], y=axes[1], form=found.reshape(GRID, GRID),
    )  # fmt: skip


def robust_pv(points: np.ndarray, distances: np.ndarray) -> float:
    """PV of a 36-term Zernike fit, and three times the RMS of the rest (Evans, Opt. Eng. 48, 043605, 2009)."""
    radius = float(np.hypot(points[:, 0], points[:, 1]).max())
    terms = zernike(points[:, 0] / radius, points[:, 1] / radius)
    some = slice(None, None, 1 + len(points) // FITTED)
    fit = terms @ least_squares(terms[some], distances[some])
    return float(np.ptp(fit)) + 3 * root_mean_square(distances - fit)


def zernike(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, 36) the fringe set on the unit circle: all terms with n + |m| <= 10."""
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    terms = []
    for n in range(ZERNIKE_ORDER + 1):
        for m in range(n % 2, min(n, ZERNIKE_ORDER - n) + 1, 2):
            radial = sum(
                (-1) ** k * factorial(n - k) * radius ** (n - 2 * k)
                / (factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k))
                for k in range((n - m) // 2 + 1)
            )  # fmt: skip
            terms += [radial * np.cos(m * angle)] + ([radial * np.sin(m * angle)] if m else [])
    return np.stack(terms, axis=1)


def _bands(form: Form, x: np.ndarray, y: np.ndarray, total: np.ndarray) -> tuple[Band, ...]:
    """The rest of the (3, n) total, then the random field by octaves of its period, the longest first."""
    net = form.rest
    period = 2 * max(net.x[1] - net.x[0], net.y[1] - net.y[0])  # of the slowest cosine
    bands = [Band(None, *_size(total - _sampled(net, x, y)))]
    while period > FINEST * max(net.pitch):
        shorter = period / 2
        last = shorter <= FINEST * max(net.pitch)
        bands.append(
            Band((period, shorter), *_size(_sampled(form.band(1 / period, np.inf if last else 1 / shorter), x, y)))
        )
        period = shorter
    return tuple(bands)


def _sampled(surface: BSplineSurface, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(3, n) heights (mm) and slopes at points."""
    return np.stack([part.numpy() for part in surface.sag_and_slope(torch.from_numpy(x), torch.from_numpy(y))])


def _size(sampled: np.ndarray) -> tuple[float, float]:
    """RMS of heights (mm) and of slopes (rad)."""
    return root_mean_square(sampled[0]), float(np.sqrt(np.mean(sampled[1] ** 2 + sampled[2] ** 2)))


@dataclass(frozen=True)
class Zone:
    """The face between two envelopes of spheres about the design (a surface profile)."""

    width: float  # mm; twice the largest distance, the smallest that a motion can make it
    pose: Pose  # removed from the cloud


def minimum_zone(face: Face, alignment: Alignment) -> Zone:
    """The zone of the motion with the least largest distance (Chebyshev), by linear programming, exact to ZONE_OFF.

    min t,  |d_i + n_i · motion| <= t for all points, from the alignment by least squares, over the motions that the
    face determines.  Few points decide it: the program begins with those of the largest distances, and takes in those
    that its solution leaves outside, until none is.
    """
    columns = face.columns(alignment.points, alignment.normals) @ alignment.motions
    distances, motion = alignment.distances, np.zeros(alignment.motions.shape[1])
    chosen = _farthest(distances)
    for _ in range(ZONE_ROUNDS):
        motion, half = _solved(columns[chosen], distances[chosen])
        left = distances + columns @ motion
        if np.abs(left).max() <= half * (1 + ZONE_OFF):
            break
        chosen = np.union1d(chosen, _farthest(left))
    pose = alignment.pose.after(alignment.motions @ motion, face.reach)
    return Zone(2 * float(np.abs(distances + columns @ motion).max()), pose)


def _farthest(distances: np.ndarray) -> np.ndarray:
    """Indices of the farthest points on either side."""
    count = min(ZONE_POINTS // 2, len(distances))
    return np.union1d(np.argpartition(distances, -count)[-count:], np.argpartition(distances, count - 1)[:count])


def _solved(columns: np.ndarray, distances: np.ndarray) -> tuple[np.ndarray, float]:
    """(motion, half the zone) of these points alone, solved in units of their largest distance."""
    unit = max(float(np.abs(distances).max()), 1e-12)
    size = np.abs(columns).max(axis=0)
    one = np.ones((len(columns), 1))
    scaled = columns / size
    found = linprog(
        np.append(np.zeros(columns.shape[1]), 1.0),
        A_ub=np.vstack([np.hstack([scaled, -one]), np.hstack([-scaled, -one])]),
        b_ub=np.concatenate([-distances, distances]) / unit,
        bounds=[(None, None)] * columns.shape[1] + [(0, None)],
        method="highs",
    )
    return found.x[:-1] / size * unit, float(found.x[-1]) * unit
