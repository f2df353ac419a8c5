"""Lenses on cadquery's Workplane: `import bstcad.cad.plugin`, and it has two methods more.

Workplane.lens(design) puts a lens at each point of the stack, as `sphere` and `box` put theirs;
Workplane.mounted(design) makes the body that is being built one with a lens at each point.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cadquery

from bstcad.cad import mounting
from bstcad.cad.mounting import Placed
from bstcad.cad.solid import lens_solid


def lens(
    self: cadquery.Workplane, design: Any, trim: cadquery.Wire | None = None, holes: Sequence[Any] = ()
) -> cadquery.Workplane:
    """A lens at each point of the stack, where the origin of its scene comes to lie; a Workplane of these solids.

    design: a bstcad.Design or a bstcad.Lens; trim, holes: see Design.solid.
    """
    solid = lens_solid(getattr(design, "lens", design), trim, holes)
    return self.eachpoint(lambda place: solid.moved(place))


def mounted(
    self: cadquery.Workplane, design: Any, z: float = 0.0, trim: cadquery.Wire | None = None, holes: Sequence[Any] = ()
) -> cadquery.Workplane:
    """The solid of the chain and a lens at each point of the stack, all one solid; see bstcad.mounted.

    Of the points x and y count; the origin of the lens's scene comes to lie at the height z (mm).
    """
    places: list[cadquery.Location] = []
    self.eachpoint(lambda place: places.append(place) or cadquery.Vertex.makeVertex(0, 0, 0))
    found, points = getattr(design, "lens", design), (place.toTuple()[0] for place in places)
    placed = [Placed(found, trim, holes, (x, y, z)) for x, y, _ in points]
    return self.newObject([mounting.mounted(self.findSolid(), placed).solid])


cadquery.Workplane.lens = lens
cadquery.Workplane.mounted = mounted
