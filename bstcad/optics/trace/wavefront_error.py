"""The wavefront error of a lens: optical path by ray tracing, in float64, minus the goal wavefront.

The optical path of a ray to the plane z of the goal wave is S = Σ_k n_k l_k, summed over the segments between the
interfaces; the first segment begins at a wavefront of the source (see `optical_path`).  By the theorem of Malus and
Dupin S is the eikonal of the light on that plane, as W (wavefront.py) is that of the goal wave, so that

    OPD = S - W,   ∇OPD = (d_x, d_y) - (w_x, w_y),

with d and w the directions of the ray and of the goal wave at its position; a positive OPD is light that arrives late.
An OPD at a reference sphere, or perpendicular to w, differs from this one to second order in the angle of d to w.

Piston (a constant) is not an error of a wavefront; tilt (a linear part in x and y) deflects the light, and moves the
focus of a spherical wave.  Piston and tilt are fitted by least squares, weighted by flux; RMS and peak to valley are
given without piston, and without piston and tilt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.lens.interfaces import Refract
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.light.wavefront import MM_PER_NM, Wave, length
from bstcad.optics.numerics.reductions import total
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.rays import Rays, dot
from bstcad.optics.trace.trace import behind, clear_window

RAYS_PER_SIDE = 512  # rays per side of the square grid that is launched
MAX_MAP_CELLS = 256  # largest number of cells per side of the map
RAYS_PER_BAND = 1 << 17  # rays traced at a time: a megabyte for each quantity
ROUNDINGS_PER_SEGMENT = 4  # number of roundings of a path segment: two ends, length and sum


@dataclass(frozen=True, eq=False)
class ExitPupil:
    """Light behind a lens on a plane z = const: n x n rays, uniformly spaced on the plane of the first vertex."""

    x: Tensor  # (n, n) x of the rays on the plane, mm
    y: Tensor  # (n, n) y of the rays on the plane, mm
    direction: Tensor  # (3, n, n) unit vectors of the rays
    path: Tensor  # (n, n) optical path to the plane, mm, from the wavefront at which `optical_path` starts
    flux: Tensor  # (n, n) fraction of the source's flux, after losses at faces and in glass
    alive: Tensor  # (n, n) bool, False for lost rays and rays without flux, whose other numbers are meaningless
    rounding: float  # bound of the rounding error of `path`, mm


@torch.no_grad()
def exit_pupil(source: Emitter, lens: Lens, z: float, n: int = RAYS_PER_SIDE) -> ExitPupil:
    """Return the light of a point or parallel source that passes the lens, on the plane z (mm), by n x n rays."""
    if source.extent is not None:
        raise ValueError("an extended source has no single wavefront; pass source.central or source.element(x, y)")
    lens, source = lens.plain(), source.central
    area = clear_window(source, lens)
    x, y = sampling.grid(area, n)
    rows = max(1, RAYS_PER_BAND // n)
    parts = []
    for band_x, band_y in zip(x.split(rows), y.split(rows), strict=True):
        rays = source.rays_through(band_x, band_y, lens.entrance.z, area.area / n**2)
        rays, path, rounding = optical_path(source, lens, rays, z)
        parts.append((rays.position[:2], rays.direction, path, rays.flux, rays.alive & (rays.flux > 0), rounding))
    *columns, roundings = zip(*parts, strict=True)
    (x, y), direction, path, flux, alive = (torch.cat(column, dim=-2) for column in columns)
    return ExitPupil(x, y, direction, path=path, flux=flux, alive=alive, rounding=max(roundings))


def move_pupil(pupil: ExitPupil, motion: Motion, z: float) -> ExitPupil:
    """Return the light of a pupil on the plane z (mm) after a motion, traced to the same plane z.

    The motion brings the light of a moved lens into the frame of the goal wave.
    """
    position = torch.stack([pupil.x, pupil.y, torch.full_like(pupil.x, z)])
    turns, about = motion.rotation.tolist(), motion.point((0.0, 0.0, 0.0))
    x, y, height = (dot(row, position) + shift for row, shift in zip(turns, about, strict=True))
    direction = torch.stack([dot(row, pupil.direction) for row in turns])
    path = torch.where(pupil.alive, (z - height) / direction[2], torch.zeros_like(height))
    return replace(
        pupil, x=x + path * direction[0], y=y + path * direction[1], direction=direction, path=pupil.path + path
    )


def optical_path(source: Emitter, lens: Lens, rays: Rays, z: float) -> tuple[Rays, Tensor, float]:
    """Return (rays from the source on the plane z, their optical path (mm), bound of its rounding error (mm)).

    Let o be the point of the axis on the vertex plane of the first surface.  Paths start at the plane through o
    perpendicular to parallel light, or at the sphere through o about a point source: distant sources cost no digits.
    """
    law, sense, longest = lens.interfaces[0].law, rays.sense, 0.0
    index = law.n_in if isinstance(law, Refract) else 1.0
    path: Tensor | None = None
    for interface in lens.interfaces:
        at_face, law = behind(rays, interface), interface.law
        if path is None:
            path = index * path_from_reference(source, lens.entrance.z, at_face, sense)
        else:
            path = path + index * _between(rays, at_face)
            longest += index * _longest(_between(rays, at_face), at_face)
        index, rays = law.n_out if isinstance(law, Refract) else index, at_face
    assert path is not None  # a lens has interfaces
    landed = LevelPlane(z).to(rays)
    ahead = torch.sign(-rays.above(z) * rays.sense)
    last = index * _between(rays, landed)
    longest += _longest(last, landed) + _longest(path, landed)
    return landed, path + ahead * last, ROUNDINGS_PER_SEGMENT * torch.finfo(torch.float64).eps * longest


def path_from_reference(source: Emitter, z: float, rays: Rays, sense: int) -> Tensor:
    """Return the length (mm) of rays from the wavefront where `optical_path` starts to the first surface.

    rays: rays on this surface; z: its vertex (mm); sense: see Rays.
    """
    position = torch.stack([*rays.position[:2], rays.above(z)])
    return source.reference(position, z, sense)


def _between(before: Rays, after: Rays) -> Tensor:
    return length(torch.stack([*after.position[:2], after.above(before.z)]) - before.position)


def _longest(paths: Tensor, rays: Rays) -> float:
    return float(torch.where(rays.alive, paths.abs(), torch.zeros_like(paths)).max())


@dataclass(frozen=True)
class OpdSize:
    """RMS and peak-to-valley of an OPD, in waves."""

    rms: float  # RMS weighted by flux, waves
    pv: float  # peak to valley over all rays, waves


@dataclass(frozen=True, eq=False)
class WavefrontError:
    """Wavefront behind a lens relative to the goal; one wave is the main wavelength that the source states."""

    z: float  # plane of the comparison, mm
    wavelength: float  # main wavelength, nm
    without_piston: OpdSize  # OPD without piston
    without_tilt: OpdSize  # OPD without piston and tilt
    tilt: tuple[float, float]  # tilt removed, µrad: inclination of the light towards +x and +y relative to the goal
    angle_rms: float  # RMS angle between rays and goal rays, weighted by flux, tilt included, µrad
    angle_max: float  # largest angle between rays and goal rays, µrad
    floor: float  # bound of the rounding error of the OPD, and so of the RMS, waves
    flux: float  # fraction of the source's flux that is compared
    rays: int  # number of rays compared
    x: np.ndarray = field(repr=False)  # (k,) x of the columns of the map, mm
    y: np.ndarray = field(repr=False)  # (k,) y of the rows of the map, mm
    opd: np.ndarray = field(repr=False)  # (k, k) OPD without piston and tilt, waves; NaN where there is no light


@torch.no_grad()
def wavefront_error(source: Emitter, lens: Lens, wave: Wave, n: int = RAYS_PER_SIDE) -> WavefrontError:
    """Return the wavefront error of a lens, computed with n x n rays of a point or parallel source.

    The lens must have the index at the main wavelength.  Raises ValueError if fewer than three rays can be compared.
    """
    pupil, nm = exit_pupil(source, lens, wave.z, n), source.main_wavelength
    compared, without_piston, fit, share = _compare(pupil, wave, nm)
    x, y = pupil.x[compared], pupil.y[compared]
    deviation = pupil.direction[:, compared] - wave.directions(x, y, nm)
    measured = float(total(pupil.flux[compared]))
    without_tilt = without_piston - fit.at(x, y)
    unit, angle = 1 / (nm * MM_PER_NM), 2e6 * torch.asin((length(deviation) / 2).clamp(max=1))
    slopes = [p - tilt for p, tilt in zip(deviation[:2], fit.slopes, strict=True)]
    along_x, along_y, opd_map = _map(x, y, without_tilt, slopes=slopes, cells=min(MAX_MAP_CELLS, n // 2))
    sizes = [OpdSize(unit * _rms(o, share), unit * float(o.max() - o.min())) for o in (without_piston, without_tilt)]
    return WavefrontError(
        wave.z, nm, sizes[0], sizes[1], tilt=(1e6 * fit.slopes[0], 1e6 * fit.slopes[1]),
        angle_rms=_rms(angle, share), angle_max=float(angle.max()), floor=unit * pupil.rounding, flux=measured,
        rays=len(x), x=along_x, y=along_y, opd=unit * opd_map,
    )  # fmt: skip


@torch.no_grad()
def residual(pupil: ExitPupil, wave: Wave, nm: float) -> Tensor:
    """Return the OPD (n, n) without piston and tilt, in waves, times sqrt(flux / total flux); 0 for rays not compared.

    nm: wavelength.  The root of the sum of squares is the RMS OPD.  Raises ValueError for fewer than 3 compared rays.
    """
    compared, without_piston, fit, share = _compare(pupil, wave, nm)
    weighted = torch.zeros_like(pupil.path)
    without_tilt = without_piston - fit.at(pupil.x[compared], pupil.y[compared])
    weighted[compared] = without_tilt * share.sqrt() / (nm * MM_PER_NM)
    return weighted


def _compare(pupil: ExitPupil, wave: Wave, nm: float) -> tuple[Tensor, Tensor, _Fit, Tensor]:
    """Return (True at compared rays (n, n), their OPD without piston (mm), plane fit of the OPD, flux / its sum)."""
    compared = pupil.alive & wave.contains(pupil.x, pupil.y)
    if int(compared.sum()) < 3:
        raise ValueError(f"too few rays reach the goal wave at z = {wave.z:g} mm; change z, or a Zernike wave's circle")
    x, y, path, flux = (part[compared] for part in (pupil.x, pupil.y, pupil.path, pupil.flux))
    opd, share = path - wave.path(x, y, nm), flux / float(total(flux))
    fit = _least_squares(x, y, opd, share=share)
    return compared, opd - fit.piston, fit, share


@dataclass(frozen=True)
class _Fit:
    """Plane fit of an OPD (mm): piston + slopes · (p - middle)."""

    piston: float  # mean OPD, weighted by flux (mm)
    slopes: tuple[float, float]  # slopes of the plane along x and y
    middle: tuple[float, float]  # mean position (x, y), weighted by flux (mm)

    def at(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the tilt part (mm) at (x, y)."""
        return self.slopes[0] * (x - self.middle[0]) + self.slopes[1] * (y - self.middle[1])


def _least_squares(x: Tensor, y: Tensor, opd: Tensor, share: Tensor) -> _Fit:
    """Return the plane fit of `opd`, weighted by `share`, about the mean position, where piston and slopes decouple."""
    mean_x, mean_y = (float(total(share * p)) for p in (x, y))
    typical = float(opd[0])  # subtracted first, since paths are long and their differences short
    piston = typical + float(total(share * (opd - typical)))
    x, y, opd = x - mean_x, y - mean_y, opd - piston
    xx, xy, yy, xw, yw = (float(total(share * p * q)) for p, q in ((x, x), (x, y), (y, y), (x, opd), (y, opd)))
    det = xx * yy - xy * xy
    slopes = ((yy * xw - xy * yw) / det, (xx * yw - xy * xw) / det) if det > 0 else (0.0, 0.0)
    return _Fit(piston, slopes, (mean_x, mean_y))


def _rms(values: Tensor, share: Tensor) -> float:
    return math.sqrt(float(total(share * values * values)))


def _map(
    x: Tensor, y: Tensor, opd: Tensor, slopes: list[Tensor], cells: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (x (k,), y (k,), OPD (k, k)) of a map of k x k square cells, k = `cells`; NaN where no ray is near.

    Each ray contributes to the four cell centres around it, with bilinear weights and extrapolated by its slope (∇OPD),
    so that the error of the map is of second order in the cell size.
    """
    low_x, high_x, low_y, high_y = (float(end) for p in (x, y) for end in (p.min(), p.max()))
    pitch = max(high_x - low_x, high_y - low_y, 1e-9) / (cells - 1)
    start = [(low + high) / 2 - pitch * (cells - 1) / 2 for low, high in ((low_x, high_x), (low_y, high_y))]
    position = [((p - s) / pitch).clamp(0, cells - 1) for p, s in zip((x, y), start, strict=True)]
    cell = [p.floor().clamp(0, cells - 2) for p in position]
    sums = np.zeros((2, cells * cells))
    for right, up in ((0, 0), (1, 0), (0, 1), (1, 1)):
        offset = [c + step - p for c, step, p in zip(cell, (right, up), position, strict=True)]  # offset in cells
        weight = (1 - offset[0].abs()) * (1 - offset[1].abs())
        value = opd + pitch * (slopes[0] * offset[0] + slopes[1] * offset[1])
        index = ((cell[1] + up) * cells + cell[0] + right).long().numpy()
        for k, part in enumerate((weight, weight * value)):
            sums[k] += np.bincount(index, part.numpy(), minlength=cells * cells)
    weights, values = sums
    opd_map = np.where(weights > 0, values / np.where(weights > 0, weights, 1.0), np.nan)
    along_x, along_y = (s + pitch * np.arange(cells) for s in start)
    return along_x, along_y, opd_map.reshape(cells, cells)
