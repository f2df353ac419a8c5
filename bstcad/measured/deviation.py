"""What a deviation comes to in figures: PV, PVr, RMS, slopes, and its share by bands of spatial frequency."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from math import factorial

import numpy as np
import torch

from bstcad.analysis.shape import least_squares
from bstcad.measured.alignment import Alignment, root_mean_square
from bstcad.measured.form_error import Form
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens

GRID = 301  # places each way at which a fitted form is looked at
ZERNIKE_ORDER = 10  # n + |m| up to this: the 36 terms of the fringe set
FITTED = 50_000  # points to which those are fitted
MAP = ("deviation.npz", "deviation.csv")  # the files of the map
FINEST = 2.0  # pitches of the form's net: the shortest period in it


@dataclass(frozen=True)
class Band:
    """What of a form error has periods of some length."""

    period: tuple[float, float] | None  # longest and shortest (mm); None: the polynomial, of which nobody says a period
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
    worst: tuple[float, float]  # x, y (mm) of the point furthest off
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
        float(np.ptp(alignment.distances)),
        robust_pv(alignment.points, alignment.distances),
        alignment.rms,
        float(np.ptp(found[inside])),
        root_mean_square(found[inside]),
        float(np.sqrt(np.mean(off_x**2 + off_y**2))),
        form.noise,
        (float(alignment.points[worst, 0]), float(alignment.points[worst, 1])),
        _bands(form, x, y, np.stack([off, off_x, off_y])),
        *axes,
        found.reshape(GRID, GRID),
    )


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
    """The random field by octaves of its period, the longest first, after what else there is of the (3, n) total."""
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
    """(3, n) heights (mm) and slopes at places."""
    return np.stack([part.numpy() for part in surface.sag_and_slope(torch.from_numpy(x), torch.from_numpy(y))])


def _size(sampled: np.ndarray) -> tuple[float, float]:
    """RMS of heights (mm) and of slopes (rad)."""
    return root_mean_square(sampled[0]), float(np.sqrt(np.mean(sampled[1] ** 2 + sampled[2] ** 2)))
