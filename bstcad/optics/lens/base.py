"""Base: the plane z = const on which a lens stands whose front and back are faces of different charts, such as a dome.

The back ends at the circle of the lens's outline in its chart.  From this rim a wall parallel to z goes down to the
base plane.  The inner face, a sphere or conic about the source, ends where the base plane cuts it, in the circle

    r² = (2 h - (1 + k) c h²) / c,    h = z_base - z0,

with curvature c and conic constant k.  Between the two lies a ring on the base plane.  A plane front is the base plane
itself, without a ring.
"""

from __future__ import annotations

import math

import numpy as np

from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Conic, Recess, Sphere, sag

BASE_MARGIN = 0.5  # largest default distance of the base plane below both lit rims (mm)
MIN_HEIGHT_FRACTION = 2e-3  # smallest height of the base plane over the inner face's equator, relative to its radius
MIN_WALL = 1e-3  # smallest height of the wall and width of the ring (mm)


def on_base(lens: Lens, z: float | None = None) -> Lens:
    """Return a dome whose inner face ends in its base plane, at z (mm); other lenses and finished domes unchanged.

    The front becomes a Recess, a face inside a circle and the plane around it, unless it is a plane.  By default the
    plane lies up to BASE_MARGIN below the rim of the back and the front's clear aperture.  Raises ValueError in one
    sentence if no plane lies below both and above the equator of the front, where its wall would be vertical.
    """
    if lens.shares_outline or lens.front.outline is not None:
        return lens
    front, rim = lens.front.plain(), lens.back.rim(lens.outline)
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


def check_base(lens: Lens) -> None:
    """Raise ValueError unless the wall and the ring of a lens on its base have a height and a width."""
    if lens.shares_outline:
        return
    rim, base = lens.back.plain().rim(lens.outline), lens.front.around
    low = float((rim[:, 2] - sag(base, *rim[:, :2].T)).min())
    if not low > MIN_WALL:
        raise ValueError(f"lens: the rim of the dome is {low:.4g} mm above its base plane; move the front down")
    if lens.front.outline is not None:
        ring = float(np.hypot(*rim[:, :2].T).min()) - lens.front.outline.radius
        if not ring > MIN_WALL:
            raise ValueError(f"lens: the ring around the front is {ring:.4g} mm wide; make the front smaller")
