"""Where rays meet the spline: the root of F(s) = z(s) - sag(x(s), y(s)) (mm), s the path along the ray (mm).

Written for light along +z, which comes from below the face, where F < 0; for light along -z (`Rays.sense`) F, d_z and
all heights change their sign.  F' = d_z - ∇sag · (d_x, d_y), and no slope of the face is steeper than its control
legs.  Where that keeps F' positive the ray crosses the face once, and Newton's method finds where.  A ray that is
*steep* to the face may cross it several times: light leaves the glass at the first crossing, so it is led there from
below, by steps too short to pass it, before Newton's method takes over.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.rays import Rays

NEWTON_STEPS = 20  # a smooth lens needs 3 to 5; what has not converged by then is a miss
APPROACH_STEPS = 200  # what has not come near the face by then runs along it, and is a miss
LEVEL = 1e-2  # |d_z| of a steep ray at or below which it leaves through a side
FLATTEST = 1e-3  # |F'| below which a Newton step is that of 1e-3, with its sign
QUICK = 3  # Newton steps after which rays outside the net are checked for; most have arrived by then
NEAR = 1e-5  # of the net's half width: an approach ends so little below the face


class Bounds(NamedTuple):
    """What is known of a net as a whole."""

    steepest_x: float  # no |∂z/∂x| of the surface is larger
    steepest_y: float
    lowest: float  # no height is lower along the light (mm, from the surface's plane)
    tolerance: float  # |F| at which a root is found (mm)
    near: float  # -F at which an approach ends (mm)


def bounds(surface: BSplineSurface, dtype: torch.dtype, sense: int = 1) -> Bounds:
    """Each slope is a mean of those of the control legs; sags and positions are of the order of the half width."""
    h, (pitch_x, pitch_y) = surface.heights.detach(), surface.pitch
    half = max(abs(end) for end in (*surface.x, *surface.y))
    lowest = float(h.min()) if sense > 0 else -float(h.max())
    return Bounds(
        float(h.diff(dim=0).abs().max()) / pitch_x, float(h.diff(dim=1).abs().max()) / pitch_y, lowest,
        64 * half * torch.finfo(dtype).eps, NEAR * half,
    )  # fmt: skip


def first_root(surface: BSplineSurface, start: Tensor, way: Tensor, rays: Rays, known: Bounds) -> tuple[Tensor, Tensor]:
    """(s, found): path of live rays to the surface from where they cross its plane, `start` (3, …) mm; forward only.

    They come to it by `way` mm of path.  Those that are steep to the surface must begin in the glass.
    """
    dx, dy, dz = rays.direction
    steep = rays.alive & ~((dz if rays.sense > 0 else -dz) > known.steepest_x * dx.abs() + known.steepest_y * dy.abs())
    s, found = _newton(surface, start, rays.direction, torch.zeros_like(dz), rays.alive & ~steep, known.tolerance)
    if bool(steep.any()):
        few = steep.nonzero(as_tuple=True)
        before, direction = _only(rays.position, few), _only(rays.direction, few)
        before[2] += rays.z - surface.z
        below, arrived = _approach(surface, before, direction, known, rays.sense)
        below, arrived = below - way[few], arrived & (direction[2].abs() > LEVEL)
        if bool(arrived.any()):
            root, met = _newton(surface, _only(start, few), direction, below, arrived, known.tolerance)
            s[few] = root
            found[few] = met & ((root - below).abs() <= known.near / FLATTEST)  # else it runs along the face
    return s, found & (way + s >= -known.tolerance)  # a ray may begin on the face, as near as rounding allows


def _only(vectors: Tensor, few: tuple[Tensor, ...]) -> Tensor:
    """(3, k): those of (3, …) at the places `few`."""
    return vectors[(slice(None), *few)]


def _newton(
    surface: BSplineSurface, start: Tensor, direction: Tensor, s: Tensor, wanted: Tensor, tolerance: float,
    steps: int = NEWTON_STEPS,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """(s*, found) for the rays `wanted`, from the paths s beyond the plane; the stop is |F| in mm, per ray."""
    dx, dy, dz = direction
    found = torch.zeros_like(wanted)
    for step in range(steps):
        x, y = start[0] + s * dx, start[1] + s * dy
        h, z_x, z_y = surface.relative_sag_and_slope(x, y)
        residual = s * dz - h
        found = wanted & (residual.abs() <= tolerance)
        searching = wanted & ~found
        left = int(searching.sum())
        if left == 0:
            break
        if 2 * left < s.numel():  # few go on: alone, so that one ray without a root does not hold up all others
            few = searching.nonzero(as_tuple=True)
            at = (_only(start, few), _only(direction, few), s[few], wanted[few])
            s[few], found[few] = _newton(surface, *at, tolerance, steps - step)
            break
        if step + NEWTON_STEPS - steps >= QUICK:
            z_x, z_y = beyond(surface, x, y, z_x, z_y)
        slope = dz - z_x * dx - z_y * dy
        floor = torch.where(slope < 0, -FLATTEST, FLATTEST).to(slope.dtype)  # keeps the sign
        slope = torch.where(slope.abs() > FLATTEST, slope, floor)
        s = s - torch.where(searching, residual, torch.zeros_like(s)) / slope
    return s, found


def beyond(surface: BSplineSurface, x: Tensor, y: Tensor, z_x: Tensor, z_y: Tensor) -> tuple[Tensor, Tensor]:
    """The slopes with which the sag goes on beyond the net: none across the rim."""
    in_x, in_y = ((p >= ends[0]) & (p <= ends[1]) for p, ends in ((x, surface.x), (y, surface.y)))
    return torch.where(in_x, z_x, torch.zeros_like(z_x)), torch.where(in_y, z_y, torch.zeros_like(z_y))


def _approach(
    surface: BSplineSurface, begin: Tensor, direction: Tensor, known: Bounds, sense: int
) -> tuple[Tensor, Tensor]:
    """(s, arrived): path from `begin` to just below the first crossing ahead.

    F changes by at most |d_z| + |∇sag · (d_x, d_y)| per mm of path: a step of -F over the bound of that passes no root.
    """
    dx, dy, dz = direction
    rate = dz.abs() + known.steepest_x * dx.abs() + known.steepest_y * dy.abs()
    s = torch.zeros_like(dz)
    under_way, arrived = torch.ones_like(s, dtype=torch.bool), torch.zeros_like(s, dtype=torch.bool)
    for step in range(APPROACH_STEPS):
        x, y, z = begin[0] + s * dx, begin[1] + s * dy, begin[2] + s * dz
        residual = sense * (z - surface.relative_sag_and_slope(x, y)[0])
        if step == 0:
            under_way = residual < 0  # what starts behind the face has left the glass: no crossing ahead is its exit
        arrived |= under_way & (residual >= -known.near)
        gone = ((x > surface.x[1]) & (dx > 0)) | ((x < surface.x[0]) & (dx < 0))
        gone |= (sense * z < known.lowest) & (sense * dz <= 0)
        gone |= ((y > surface.y[1]) & (dy > 0)) | ((y < surface.y[0]) & (dy < 0))
        under_way = under_way & ~arrived & ~gone
        if not bool(under_way.any()):
            break
        s = torch.where(under_way, s - residual / rate, s)
    return s, arrived
