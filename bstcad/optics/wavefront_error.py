"""The wavefront behind a lens against the one that is asked for: optical path by tracing, ray by ray, in float64.

The path of a ray to the plane z of the wanted wave is S = Σ_k n_k l_k, over the stretches between the interfaces: from
the source to the first one l is the path from the point, or from a plane across parallel light.  By Malus and Dupin S
is the eikonal of the light on that plane, as W (wavefront.py) is that of the wanted wave, so that

    OPD = S - W,   ∇OPD = (d_x, d_y) - (w_x, w_y),

d and w the directions of the ray and of the wanted one at its place: a positive OPD is light that comes late.  A sphere
of reference, or a plane across the wanted direction, differs from that by the square of the angle between d and w.

Piston (a constant) is no error of a wavefront; tilt (a linear part in x and y) aims the light elsewhere, and moves the
focus of a spherical wave.  Both are fitted by least squares, each ray by its flux, and figures are given without piston
and without piston and tilt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics import sampling
from bstcad.optics.emitters import Emitter
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.motion import Motion
from bstcad.optics.rays import Rays
from bstcad.optics.receivers import LevelPlane, dot
from bstcad.optics.trace import behind, clear_window
from bstcad.optics.wavefront import NM, Wave, length

RAYS = 512  # a side of the light before the lens
CELLS = 256  # a side of the map, at most
BAND = 1 << 17  # rays traced at a time: a megabyte of each quantity
ROUNDINGS = 4  # roundings of a stretch of way: of both its ends, of its length and of the sum


@dataclass(frozen=True, eq=False)
class ExitPupil:
    """The light behind a lens on a plane z = const, ray by ray: n x n rays, even on the plane of its first vertex."""

    x: Tensor  # mm
    y: Tensor  # mm
    direction: Tensor  # (3, n, n) unit vectors
    path: Tensor  # mm, optical path to the plane, as `followed` counts it
    flux: Tensor  # fraction of the source's, what faces and glass take already off
    alive: Tensor  # bool; the others did not get here, or carry nothing: their numbers mean nothing
    rounding: float  # mm: what the sum of the path may be off by


@torch.no_grad()
def exit_pupil(source: Emitter, lens: Lens, z: float, n: int = RAYS) -> ExitPupil:
    """The light of a point or of parallel light that gets through a lens, on the plane z (mm)."""
    if source.extent is not None:
        raise ValueError("light of a source of some extent has no one wavefront; take one of its points or directions")
    lens, source = lens.plain(), source.central
    area = clear_window(source, lens)
    x, y = sampling.grid(area, n)
    rows = max(1, BAND // n)
    parts = []
    for band_x, band_y in zip(x.split(rows), y.split(rows), strict=True):
        rays, path, rounding = followed(source, lens, source.rays(band_x, band_y, lens.entrance.z, area.area / n**2), z)
        parts.append((rays.position[:2], rays.direction, path, rays.flux, rays.alive & (rays.flux > 0), rounding))
    *columns, roundings = zip(*parts, strict=True)
    (x, y), direction, path, flux, alive = (torch.cat(column, dim=-2) for column in columns)
    return ExitPupil(x, y, direction, path=path, flux=flux, alive=alive, rounding=max(roundings))


def moved_pupil(pupil: ExitPupil, motion: Motion, z: float) -> ExitPupil:
    """The light of a pupil on the plane z (mm) after a motion, on the plane of that z again.

    So the light of a lens that was moved is seen from where the wanted wave stays.
    """
    place = torch.stack([pupil.x, pupil.y, torch.full_like(pupil.x, z)])
    turns, about = motion.rotation.tolist(), motion.point((0.0, 0.0, 0.0))
    x, y, height = (dot(row, place) + shift for row, shift in zip(turns, about, strict=True))
    direction = torch.stack([dot(row, pupil.direction) for row in turns])
    way = torch.where(pupil.alive, (z - height) / direction[2], torch.zeros_like(height))
    return replace(
        pupil, x=x + way * direction[0], y=y + way * direction[1], direction=direction, path=pupil.path + way
    )


def followed(source: Emitter, lens: Lens, rays: Rays, z: float) -> tuple[Rays, Tensor, float]:
    """(rays from the source on the plane z, their optical path (mm), what that may be off by in mm).

    Let o be where the axis meets the vertex plane of the first surface.  Paths count from the plane through o across
    parallel light, or from the sphere through o about a point: sources far off cost no digits.
    """
    first = lens.interfaces[0].law
    index, path, longest, sense = 1.0 if first.reverses else first.n_in, None, 0.0, rays.sense
    for interface in lens.interfaces:
        there = behind(rays, interface)
        if path is None:
            path = index * from_reference(source, lens.entrance.z, there, sense)
        else:
            path = path + index * _between(rays, there)
            longest += index * _longest(_between(rays, there), there)
        index, rays = index if interface.law.reverses else interface.law.n_out, there
    landed = LevelPlane(z).to(rays)
    ahead = torch.sign(-rays.above(z) * rays.sense)
    last = index * _between(rays, landed)
    longest += _longest(last, landed) + _longest(path, landed)
    return landed, path + ahead * last, ROUNDINGS * torch.finfo(torch.float64).eps * longest


def from_reference(source: Emitter, z: float, rays: Rays, sense: int) -> Tensor:
    """The way (mm) of rays to the first surface from where paths count; z: of its vertex, sense: of the light there."""
    place = torch.stack([*rays.position[:2], rays.above(z)])
    return source.reference(place, z, sense)


def _between(before: Rays, there: Rays) -> Tensor:
    """The way of rays from one place to another (mm)."""
    return length(torch.stack([*there.position[:2], there.above(before.z)]) - before.position)


def _longest(way: Tensor, rays: Rays) -> float:
    return float(torch.where(rays.alive, way.abs(), torch.zeros_like(way)).max())


# --- against the wanted wave ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Figures:
    """Sizes of an OPD, in waves."""

    rms: float  # each ray by its flux
    pv: float  # greatest less least of all rays


@dataclass(frozen=True, eq=False)
class WavefrontError:
    """The wavefront behind a lens against the wanted one; waves are those of the source's main wavelength in air."""

    z: float  # mm, the plane on which the light is compared
    wavelength: float  # nm
    without_piston: Figures
    without_tilt: Figures  # without piston and tilt
    tilt: tuple[float, float]  # removed, µrad: light that leans towards +x and towards +y of the wanted light
    angle_rms: float  # µrad between rays and wanted rays, each ray by its flux; tilt included
    angle_max: float  # µrad
    floor: float  # waves that rounding may add to the RMS
    flux: float  # fraction of the source's that is measured: gets here, to places for which the wave is stated
    rays: int  # measured
    x: np.ndarray = field(repr=False)  # (k,) mm, along the columns of the map
    y: np.ndarray = field(repr=False)  # (k,) mm, along its rows
    opd: np.ndarray = field(repr=False)  # (k, k) waves, without piston and tilt; NaN where there is no light


@torch.no_grad()
def wavefront_error(source: Emitter, lens: Lens, wave: Wave, n: int = RAYS) -> WavefrontError:
    """The error by n x n rays over the light of a point or of parallel light that gets through the lens.

    The lens is that of the source's main wavelength.  Raises ValueError if no ray can be compared.
    """
    pupil, nm = exit_pupil(source, lens, wave.z, n), source.main_wavelength
    seen, flat, fit, share = _against(pupil, wave, nm)
    x, y = pupil.x[seen], pupil.y[seen]
    off = pupil.direction[:, seen] - wave.directions(x, y, nm)
    measured = float(total(pupil.flux[seen]))
    level = flat - fit.at(x, y)
    unit, angle = 1 / (nm * NM), 2e6 * torch.asin((length(off) / 2).clamp(max=1))
    slopes = [p - tilt for p, tilt in zip(off[:2], fit.slopes, strict=True)]
    along_x, along_y, seen_map = _map(x, y, level, slopes=slopes, cells=min(CELLS, n // 2))
    return WavefrontError(
        wave.z, nm,
        *(Figures(unit * _rms(part, share), unit * float(part.max() - part.min())) for part in (flat, level)),
        tilt=(1e6 * fit.slopes[0], 1e6 * fit.slopes[1]), angle_rms=_rms(angle, share), angle_max=float(angle.max()),
        floor=unit * pupil.rounding, flux=measured, rays=len(x), x=along_x, y=along_y, opd=unit * seen_map,
    )  # fmt: skip


@torch.no_grad()
def residual(pupil: ExitPupil, wave: Wave, nm: float) -> Tensor:
    """(n, n) OPD without piston and tilt in waves of nm, times the root of each ray's share of the flux; 0: not seen.

    Its root of the sum of squares is the RMS.  Raises ValueError if no ray can be compared.
    """
    seen, flat, fit, share = _against(pupil, wave, nm)
    weighted = torch.zeros_like(pupil.path)
    weighted[seen] = (flat - fit.at(pupil.x[seen], pupil.y[seen])) * share.sqrt() / (nm * NM)
    return weighted


def _against(pupil: ExitPupil, wave: Wave, nm: float) -> tuple[Tensor, Tensor, _Fit, Tensor]:
    """(seen (n, n); of the rays that are: OPD without piston in mm, its least-squares plane, share of their flux)."""
    seen = pupil.alive & wave.contains(pupil.x, pupil.y)
    if int(seen.sum()) < 3:
        raise ValueError(f"no light comes to where the wavefront is stated on the plane z = {wave.z:g}")
    x, y, path, flux = (part[seen] for part in (pupil.x, pupil.y, pupil.path, pupil.flux))
    opd, share = path - wave.path(x, y, nm), flux / float(total(flux))
    fit = _least_squares(x, y, opd, share=share)
    return seen, opd - fit.piston, fit, share


@dataclass(frozen=True)
class _Fit:
    """piston + slopes · (p - middle) of an OPD (mm)."""

    piston: float
    slopes: tuple[float, float]
    middle: tuple[float, float]

    def at(self, x: Tensor, y: Tensor) -> Tensor:
        """The tilt alone."""
        return self.slopes[0] * (x - self.middle[0]) + self.slopes[1] * (y - self.middle[1])


def _least_squares(x: Tensor, y: Tensor, opd: Tensor, share: Tensor) -> _Fit:
    """The least-squares plane, each ray by its share; its normal equations part about the mean place."""
    middle = tuple(float(total(share * p)) for p in (x, y))
    typical = float(opd[0])  # a path is long, and its differences are short
    piston = typical + float(total(share * (opd - typical)))
    x, y, opd = x - middle[0], y - middle[1], opd - piston
    xx, xy, yy, xw, yw = (float(total(share * p * q)) for p, q in ((x, x), (x, y), (y, y), (x, opd), (y, opd)))
    det = xx * yy - xy * xy
    if not det > 0:
        return _Fit(piston, (0.0, 0.0), middle)
    return _Fit(piston, ((yy * xw - xy * yw) / det, (xx * yw - xy * xw) / det), middle)


def _rms(values: Tensor, share: Tensor) -> float:
    return math.sqrt(float(total(share * values * values)))


def _map(
    x: Tensor, y: Tensor, opd: Tensor, slopes: list[Tensor], cells: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(x (k,), y (k,), OPD (k, k)): scattered rays on the centres of square cells, NaN where no ray is near.

    Each ray tells the four centres around it, by linear weights and with its slope (∇OPD) for the way there, so that
    the map errs in second order of a cell.
    """
    low_x, high_x, low_y, high_y = (float(end) for p in (x, y) for end in (p.min(), p.max()))
    pitch = max(high_x - low_x, high_y - low_y, 1e-9) / (cells - 1)
    start = [(low + high) / 2 - pitch * (cells - 1) / 2 for low, high in ((low_x, high_x), (low_y, high_y))]
    at = [((p - s) / pitch).clamp(0, cells - 1) for p, s in zip((x, y), start, strict=True)]
    cell = [p.floor().clamp(0, cells - 2) for p in at]
    sums = np.zeros((2, cells * cells))
    for right, up in ((0, 0), (1, 0), (0, 1), (1, 1)):
        way = [c + step - p for c, step, p in zip(cell, (right, up), at, strict=True)]  # in cells
        weight = (1 - way[0].abs()) * (1 - way[1].abs())
        told = opd + pitch * (slopes[0] * way[0] + slopes[1] * way[1])
        index = ((cell[1] + up) * cells + cell[0] + right).long().numpy()
        for k, part in enumerate((weight, weight * told)):
            sums[k] += np.bincount(index, part.numpy(), minlength=cells * cells)
    weight, told = sums
    there = np.where(weight > 0, told / np.where(weight > 0, weight, 1.0), np.nan)
    along_x, along_y = (s + pitch * np.arange(cells) for s in start)
    return along_x, along_y, there.reshape(cells, cells)
