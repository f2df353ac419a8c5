"""The lens: two surfaces, an outline and a medium."""

from __future__ import annotations

from dataclasses import dataclass

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.outlines import Outline
from bstcad.optics.surfaces import Plane, Sphere


@dataclass(frozen=True)
class Lens:
    """A solid of one index in air: light enters through `front` and leaves through `back` (towards +z)."""

    front: Plane | Sphere
    back: BSplineSurface
    outline: Outline  # both faces end on it; the sides are parallel to the axis
    index: float  # refractive index at the design wavelength
