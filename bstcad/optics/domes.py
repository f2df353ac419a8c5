"""Domes: the base plane z = const of a lens whose back is a radial surface, and its checks.

The back ends at the circle of the lens's outline in the chart.  From this rim a wall parallel to z goes down to the
base plane.  The inner face, a sphere or conic about the source, ends where the base plane cuts it, in the circle

    r² = (2 h - (1 + k) c h²) / c,    h = z_base - z0,

with curvature c and conic constant k.  Between the two lies a ring on the base plane.  A plane front is the base plane
itself, without a ring.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from typing_extensions import TypeIs

from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Outline
from bstcad.optics.radial import RadialSurface
from bstcad.optics.surfaces import Conic, Recess, Sphere, Surface, sag

BASE_MARGIN = 0.5  # largest default distance of the base plane below both lit rims (mm)
MIN_HEIGHT_FRACTION = 2e-3  # smallest height of the base plane over the inner face's equator, relative to its radius
MIN_WALL = 1e-3  # smallest height of the wall, width of the ring and thickness along z (mm)
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
