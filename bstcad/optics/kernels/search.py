"""Fused CPU kernel (numba) behind `tubes.search`: rays of sources that meet given points behind a front.

Blocks of rays go through the steps of forward.py (launch, front face) and on to their heights.  Broyden's method takes
steps for all rays of a block until their largest error is below the tolerance.  The plain form does so for all rays.

Behind the front of a dome (`dome` is given) the rays are launched from a sphere about its centre.  P, Q and the points
are those of its chart, and a height is the distance from the centre.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from bstcad.optics.kernels import kernel_arguments
from bstcad.optics.kernels.dome_light import arrive_on_sphere, cross_front, front_of, launch_from_sphere
from bstcad.optics.kernels.forward import (
    BLOCK,
    DX,
    DY,
    DZ,
    FATE,
    FLUX,
    WORK,
    X,
    Y,
    Z,
    launch,
    meet_front,
    refract,
    shape,
    tilt,
)  # fmt: skip
from bstcad.optics.light.path import MAX_BROYDEN_STEPS, MIN_BROYDEN_DIVISOR, Found, Path
from bstcad.optics.numerics import reductions
from bstcad.optics.numerics.compiling import compiled
from bstcad.optics.numerics.records import DomeFront, SphereBeam
from bstcad.optics.surfaces import surfaces
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.rays import Rays

# Rows of `state`: hit, point, inverse Jacobian, last step, and distance left before it, of each ray of a block.
HIT_X, HIT_Y, P, Q, XX, XY, YX, YY, STEP_X, STEP_Y, OFF_X, OFF_Y = range(12)
ROWS = 12
NEWTON_INVERSIONS = 5  # first steps on a dome, each with difference quotients: light is bent too much for one Jacobian


class DomeStart(NamedTuple):
    """Light and front of a dome as numbers."""

    light: SphereBeam
    front: DomeFront
    radius: float  # R of the chart of the points (mm); the chart of the light may have another one


class Limits(NamedTuple):
    """Constants of the plain form."""

    step: float  # step of the difference quotients (mm)
    tolerance: float  # error (mm) at which the search ends
    steps: float  # maximum number of Broyden steps
    divisor: float  # path.MIN_BROYDEN_DIVISOR
    cosine: float  # surfaces.MIN_ARRIVAL_COSINE


@njit(error_model="numpy")
def _arrive(beam, front, dome, cosine, rise, state, shift_x, shift_y, count, work):
    """Store where the rays through the points P and Q, shifted, have risen by `rise` (mm), in HIT_X and HIT_Y."""
    for r in range(count):
        work[X + r], work[Y + r], work[Z + r], work[FATE + r] = state[P, r] + shift_x, state[Q, r] + shift_y, 0.0, 0.0
    if dome is None:
        launch(beam, count, work)
        if beam.pattern.present:
            shape(beam, count, work)
        elif beam.tilted == 1 and beam.distance > 0.0:
            tilt(beam, count, work)
        if front.present:
            meet_front(front, beam.distance == 0.0 and beam.tilted == 0, count, work)
            refract(front.eta, front.fates.reflected, count, work)
        for r in range(count):
            s = (rise[r] - work[Z + r]) / max(work[DZ + r], cosine)
            state[HIT_X, r], state[HIT_Y, r] = work[X + r] + s * work[DX + r], work[Y + r] + s * work[DY + r]
    else:
        launch_from_sphere(dome.light, count, work)
        cross_front(dome.front, count, work)
        for r in range(count):
            state[HIT_X, r], state[HIT_Y, r] = arrive_on_sphere(dome.radius, rise[r], r, work)


@njit(error_model="numpy")
def _invert(beam, front, dome, limits, rise, state, count, work):
    """Store the inverse of ∂(hit) / ∂(P, Q) by difference quotients, as `tubes._inverse_jacobian` does."""
    at_x, at_y = state[HIT_X].copy(), state[HIT_Y].copy()
    for k in range(2):
        _arrive(beam, front, dome, limits.cosine, rise, state, limits.step * (1 - k), limits.step * k, count, work)
        for r in range(count):
            state[XX + k, r] = (state[HIT_X, r] - at_x[r]) / limits.step
            state[YX + k, r] = (state[HIT_Y, r] - at_y[r]) / limits.step
    for r in range(count):
        xx, xy, yx, yy = state[XX, r], state[XY, r], state[YX, r], state[YY, r]
        det = xx * yy - xy * yx
        det = det if abs(det) > 1e-6 else 1.0
        state[XX, r], state[XY, r], state[YX, r], state[YY, r] = yy / det, -xy / det, -yx / det, xx / det


@njit(error_model="numpy")
def _update(divisor, state, off_x, off_y, r):
    """Update the inverse Jacobian of a ray as `tubes._broyden_update` does; off_x, off_y: its present distance."""
    xx, xy, yx, yy, s_x, s_y = (
        state[XX, r],
        state[XY, r],
        state[YX, r],
        state[YY, r],
        state[STEP_X, r],
        state[STEP_Y, r],
    )
    m_x, m_y = state[OFF_X, r] - off_x, state[OFF_Y, r] - off_y
    row_x, row_y = s_x * xx + s_y * yx, s_x * xy + s_y * yy
    scale = row_x * m_x + row_y * m_y
    if abs(scale) > divisor * (s_x * s_x + s_y * s_y):
        left_x, left_y = (s_x - (xx * m_x + xy * m_y)) / scale, (s_y - (yx * m_x + yy * m_y)) / scale
        state[XX, r], state[XY, r] = xx + left_x * row_x, xy + left_x * row_y
        state[YX, r], state[YY, r] = yx + left_y * row_x, yy + left_y * row_y


@njit(error_model="numpy")
def _straight(beam, dome, x, y, rise):
    """Return where the line from a point source, or along parallel light, to (x, y) at `rise` crosses the plane 0.

    On a dome the search starts at (x, y).
    """
    if dome is None:
        if beam.distance > 0.0:
            part = beam.distance / (beam.distance + rise)
            return beam.x + part * (x - beam.x), beam.y + part * (y - beam.y)
        return x - rise * beam.n_x / beam.n_z, y - rise * beam.n_y / beam.n_z
    scale = dome.light.radius / dome.radius
    return scale * x, scale * y


@compiled()
def _search(beam, front, dome, limits, x, y, rise, p, q, direction, flux, fate, error):
    """Store the points P and Q of the rays that meet (x, y) at `rise`, and these rays."""
    work, state = np.zeros(WORK), np.zeros((ROWS, BLOCK))
    inversions = 1 if dome is None else NEWTON_INVERSIONS
    for first in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - first)
        here = slice(first, first + count)
        for r in range(count):
            state[P, r], state[Q, r] = _straight(beam, dome, x[first + r], y[first + r], rise[first + r])
        for number in range(int(limits.steps)):
            _arrive(beam, front, dome, limits.cosine, rise[here], state, 0.0, 0.0, count, work)
            largest = 0.0
            for r in range(count):
                off = max(abs(x[first + r] - state[HIT_X, r]), abs(y[first + r] - state[HIT_Y, r]))
                error[first + r] = off if work[FATE + r] == 0.0 else 0.0
                largest = max(largest, error[first + r])
                direction[0, first + r], direction[1, first + r] = work[DX + r], work[DY + r]
                direction[2, first + r], flux[first + r] = work[DZ + r], work[FLUX + r]
                fate[first + r] = np.uint8(work[FATE + r])
            if largest == 0.0:
                break
            if number < inversions:
                for r in range(count):
                    state[OFF_X, r], state[OFF_Y, r] = x[first + r] - state[HIT_X, r], y[first + r] - state[HIT_Y, r]
                _invert(beam, front, dome, limits, rise[here], state, count, work)
            else:
                for r in range(count):
                    off_x, off_y = x[first + r] - state[HIT_X, r], y[first + r] - state[HIT_Y, r]
                    _update(limits.divisor, state, off_x, off_y, r)
                    state[OFF_X, r], state[OFF_Y, r] = off_x, off_y
            for r in range(count):
                off_x, off_y = state[OFF_X, r], state[OFF_Y, r]
                state[STEP_X, r] = state[XX, r] * off_x + state[XY, r] * off_y
                state[STEP_Y, r] = state[YX, r] * off_x + state[YY, r] * off_y
                state[P, r] += state[STEP_X, r]
                state[Q, r] += state[STEP_Y, r]
            if largest <= limits.tolerance:
                break
        p[here], q[here] = state[P, :count], state[Q, :count]


def search(path: Path, x: Tensor, y: Tensor, height: Tensor) -> Found:
    """Find rays as `tubes.search_plain` does; all tensors are float64."""
    shape, count = x.shape, len(path.sources)
    rays, (flux, error) = torch.empty((3, *shape), dtype=torch.float64), torch.empty((2, *shape), dtype=torch.float64)
    points, fate = torch.empty((2, *shape), dtype=torch.float64), torch.empty(shape, dtype=torch.uint8)
    face = path.face
    rise = path.sense * (height + (face.z - path.start))
    if isinstance(face, RadialSurface):
        rise = height + face.radius
    given = [x, y, rise, *points, rays, flux, fate, error]
    arrays = [t.reshape(*t.shape[: t.ndim - len(shape)], count, -1).numpy() for t in given]
    beams = [source.beam(path.start) for source in path.sources]
    domes: list[DomeStart | None] = [None] * count
    if isinstance(face, RadialSurface):
        front_face = front_of(path.before, face.z)
        domes = [DomeStart(beam, front_face, face.radius) for beam in beams if isinstance(beam, SphereBeam)]
    front = kernel_arguments.front_face(path.before, path.sense)
    numbers = path.step, path.tolerance, MAX_BROYDEN_STEPS, MIN_BROYDEN_DIVISOR, surfaces.MIN_ARRIVAL_COSINE
    limits = Limits(*map(float, numbers))

    def some(k: int, first: int, last: int) -> None:
        beam, dome = beams[k], domes[k]
        _search(dome.light.beam if dome else beam, front, dome, limits, *(a[..., k, first:last] for a in arrays))

    parts = reductions.shares(x.numel() // count, BLOCK)
    reductions.on_threads(some, [(k, *part) for k in range(count) for part in parts])
    if path.sense < 0:
        rays[2].neg_()
    axial = all(source.is_shift_invariant for source in path.sources) and all(f.surface.level for f in path.before)
    found = Rays(torch.stack([x, y, height]), rays, flux, fate, axial=axial, z=path.face.z, sense=path.sense)
    return Found(points[0], points[1], found, error)
