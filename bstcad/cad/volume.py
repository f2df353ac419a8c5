"""The volume of a lens to rounding; no OCC, whose own volume properties are approximate."""

from __future__ import annotations

from bstcad.optics.lens import Lens


def exact_volume(lens: Lens) -> float:
    """V = ∫∫ (back - front) dx dy over the outline (mm³), to about 1e-13 of itself."""
    back, front = ((face.integral(lens.outline), face.z * lens.outline.area) for face in (lens.back, lens.front))
    return back[0] + back[1] - (front[0] + front[1])
