"""Domes: the base plane z = const of a lens whose back is a radial surface, and its checks.

The back ends at the circle of the lens's outline in the chart.  From this rim a wall parallel to z goes down to the
base plane.  The inner face, a sphere or conic about the source, ends where the base plane cuts it, in the circle

    r² = (2 h - (1 + k) c h²) / c,    h = z_base - z0,

with curvature c and conic constant k.  Between the two lies a ring on the base plane.  A plane front is the base plane
itself, without a ring.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from typing_extensions import TypeIs

from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle, Outline
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.surfaces.surfaces import Conic, Recess, Sphere, Surface, sag

BASE_MARGIN = 0.5  # largest default distance of the base plane below both lit rims (mm)
MIN_HEIGHT_FRACTION = 2e-3  # smallest height of the base plane over the inner face's equator, relative to its radius
MIN_WALL = 1e-3  # smallest height of the wall, width of the ring and thickness along z (mm)
SILHOUETTE_RINGS = 181  # number of angles from the axis among which the edge of a dome is searched
RIM_SAMPLES = 1440  # number of points of the rim at which its height is examined
SAMPLES_PER_SPAN = 2  # number of points per knot span, along each axis, at which the thickness is examined


def is_radial(surface: Surface) -> TypeIs[RadialSurface]:
    """Return True for a radial surface, whose coordinates are those of a sphere's chart."""
    return isinstance(surface, RadialSurface)


def is_dome(lens: Lens) -> bool:
    """Return True if the back of a lens is a radial surface."""
    return is_radial(lens.back)


def radial_back(lens: Lens) -> RadialSurface:
    """Return the back of a dome; TypeError for another lens."""
    back = lens.back.plain()
    if not is_radial(back):
        raise TypeError(f"the back is a {back.kind}, not a radial surface; use the functions for heights")
    return back


def points_on(surface: RadialSurface, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the points (…, 3) (mm) of a radial surface at (x, y) (mm) of its chart."""
    return _in_space(surface, surface.at(*_tensors(x, y)).position)


def points_and_normals(surface: RadialSurface, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (…, 3) (mm) and unit normals (…, 3), outwards, at (x, y) (mm) of the chart."""
    patch = surface.at(*_tensors(x, y))
    normal = patch.normal
    unit = normal / torch.sqrt((normal * normal).sum(0))
    return _in_space(surface, patch.position), np.moveaxis(unit.numpy(), 0, -1)


def rim_of(lens: Lens) -> np.ndarray:
    """Return points (n, 3) (mm) of the back's rim, the curve over the circle of the outline in the chart."""
    angle = np.arange(RIM_SAMPLES) * (2 * math.pi / RIM_SAMPLES)
    radius = rim_radius(lens.outline)
    return points_on(radial_back(lens), radius * np.cos(angle), radius * np.sin(angle))


def rim_radius(outline: Outline) -> float:
    """Return the radius (mm, in the chart) of a dome's outline; ValueError unless it is a circle."""
    if not isinstance(outline, Circle):
        raise ValueError(f"lens.outline: {outline.words} is not a circle; give a dome a circle in its chart")
    return float(outline.radius)


def in_chart_of(other: RadialSurface, surface: Surface, outline: Outline) -> tuple[RadialSurface, Circle]:
    """Return a radial surface and the circle of an outline in the chart of another one, of the same angles.

    The coordinates of a chart are proportional to its radius R, and the distances R + h do not depend on it.
    Raises ValueError if the surface is not radial.
    """
    if not is_radial(surface):
        raise ValueError("the back is not the radial surface of a dome; generate the design again")
    factor = other.radius / surface.radius
    (x0, x1), (y0, y1) = surface.x, surface.y
    heights = surface.heights + (surface.radius - other.radius)
    x, y = (factor * x0, factor * x1), (factor * y0, factor * y1)
    moved = replace(surface, heights=heights, x=x, y=y, radius=other.radius)
    return moved, Circle(factor * rim_radius(outline))


def opening(lens: Lens) -> Circle:
    """Return the smallest circle about the axis around the rim of a dome, seen along the axis (mm)."""
    return Circle(float(np.hypot(*rim_of(lens)[:, :2].T).max()))


def towards(surface: RadialSurface, theta: np.ndarray, psi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (…, 3) (mm) of a radial surface in directions from its centre, and its unit normals (…, 3).

    theta, psi: angle from +z, and azimuth from +x towards +y (rad).  ValueError if the surface has no point there.
    """
    theta, psi = np.broadcast_arrays(theta, psi)
    sin = np.sin(theta)
    along = torch.from_numpy(np.stack([sin * np.cos(psi), sin * np.sin(psi), np.cos(theta)]))
    flux, status = torch.ones(theta.shape, dtype=torch.float64), torch.zeros(theta.shape, dtype=torch.uint8)
    met = surface.plain().meet(Rays(torch.zeros_like(along), along, flux, status, z=surface.z))
    if not bool(met.found.all()):
        raise ValueError("lens.back: the dome has no point in some directions; reduce lens.back.half_angle")
    unit = met.normal / torch.sqrt((met.normal * met.normal).sum(0))
    return _in_space(surface, met.position), np.moveaxis(unit.numpy(), 0, -1)


def section(lens: Lens, upright: bool, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return u and z (mm) of `count` points of a dome's back in a plane through its axis, from rim to rim.

    upright: the plane x = 0 with u = y, else the plane y = 0 with u = x.
    """
    dome, radius = radial_back(lens), rim_radius(lens.outline)
    ends = np.array([-radius, radius]), np.zeros(2)
    rim = points_on(dome, *(ends[::-1] if upright else ends)) - (0.0, 0.0, dome.z)
    low, high = np.arctan2(np.hypot(rim[:, 0], rim[:, 1]), rim[:, 2])
    theta = np.linspace(-low, high, count)
    points, _ = towards(dome, np.abs(theta), np.where(theta < 0, math.pi, 0.0) + upright * math.pi / 2)
    return points[:, int(upright)], points[:, 2]


def silhouette(lens: Lens, count: int = 361) -> np.ndarray:
    """Return points (count, 2) (mm) of the edge of a dome seen along its axis, the last equal to the first."""
    dome = radial_back(lens)
    theta = np.linspace(0.0, dome.chart.angle(rim_radius(lens.outline), dome.radius), SILHOUETTE_RINGS)
    psi = np.linspace(0.0, 2 * math.pi, count)
    points, _ = towards(dome, theta[:, None], psi)
    r = np.hypot(points[..., 0], points[..., 1]).max(axis=0)
    return np.stack([r * np.cos(psi), r * np.sin(psi)], axis=1)


def on_base(lens: Lens, z: float | None = None) -> Lens:
    """Return a dome whose inner face ends in its base plane, at z (mm); other lenses and finished domes unchanged.

    The front becomes a Recess, a face inside a circle and the plane around it, unless it is a plane.  By default the
    plane lies up to BASE_MARGIN below the rim of the back and the front's clear aperture.  Raises ValueError in one
    sentence if no plane lies below both and above the equator of the front, where its wall would be vertical.
    """
    if not is_dome(lens) or lens.front.outline is not None:
        return lens
    front, rim = lens.front.plain(), rim_of(lens)
    lowest = float(rim[:, 2].min())
    if front.level:
        if z is not None and z != front.z:
            raise ValueError(f"base: z = {z:g} mm is not the plane front, z = {front.z:g} mm; omit it")
        return lens
    if not isinstance(front, (Sphere, Conic)):
        raise front.unknown
    c, k = front.conic()
    if not c < 0:
        raise ValueError(f"lens.front: a curvature of {c:g} /mm does not open towards -z; give a negative curvature")
    if lens.clear is not None:
        lowest = min(lowest, float(sag(front, *lens.clear[0].farthest)))
    floor = front.z + 1 / ((1 + k) * c) * (1 - MIN_HEIGHT_FRACTION) if 1 + k > 0 else -math.inf
    chosen = lowest - min(BASE_MARGIN, (lowest - floor) / 2) if z is None else float(z)
    if not floor < chosen < lowest:
        raise ValueError(
            f"base: a plane must lie above z = {floor:.4g} mm, the front's equator, and below z = {lowest:.4g} mm, the "
            "lowest point of the rims that light meets; reduce half_angle, or choose a plane between them"
        )
    h = chosen - front.z
    return lens.with_front(Recess(front, Circle(math.sqrt((2 * h - (1 + k) * c * h * h) / c))))


def check_dome(lens: Lens) -> None:
    """Raise ValueError unless the back of a dome lies outside its front, and its wall and its ring have a width."""
    dome, rim, base = radial_back(lens), rim_of(lens), lens.front.around
    low = float((rim[:, 2] - sag(base, *rim[:, :2].T)).min())
    if not low > MIN_WALL:
        raise ValueError(f"lens: the rim of the dome is {low:.4g} mm above its base plane; move the front down")
    if lens.front.outline is not None:
        ring = float(np.hypot(*rim[:, :2].T).min()) - lens.front.outline.radius
        if not ring > MIN_WALL:
            raise ValueError(f"lens: the ring around the front is {ring:.4g} mm wide; make the front smaller")
    radius = rim_radius(lens.outline)
    count = SAMPLES_PER_SPAN * max(dome.shape) + 1
    x, y = np.meshgrid(*[np.linspace(-radius, radius, count)] * 2, indexing="ij")
    inside = np.hypot(x, y) <= radius
    points = points_on(dome, x[inside], y[inside])
    thickness = points[:, 2] - sag(lens.front, *points[:, :2].T)
    i = int(thickness.argmin())
    if not thickness[i] > MIN_WALL:
        at = "({:.4g}, {:.4g}, {:.4g}) mm".format(*points[i])
        raise ValueError(f"lens: its thickness along z is {thickness[i]:.4g} mm at {at}; make the front smaller")


def _tensors(x: np.ndarray, y: np.ndarray) -> tuple[Tensor, Tensor]:
    a, b = (torch.from_numpy(np.require(p, float, ["C", "W"])) for p in (x, y))
    return a, b


def _in_space(surface: RadialSurface, position: Tensor) -> np.ndarray:
    points = np.moveaxis(position.numpy(), 0, -1).copy()
    points[..., 2] += surface.z
    return points
