"""Two methods of cadquery's Workplane for lenses, which `import bstcad.cad.plugin` adds.

Workplane.lens(design) puts a lens at each point of the stack, as `sphere` and `box` put their solids.
Workplane.mounted(design) joins the solid under construction with a lens at each point.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cadquery

from bstcad.cad import mounting
from bstcad.cad.mounting import PlacedLens
from bstcad.cad.solid import lens_solid


def lens(
    self: cadquery.Workplane, design: Any, trim: cadquery.Wire | None = None, holes: Sequence[Any] = ()
) -> cadquery.Workplane:
    """Return a Workplane with a lens at each point of the stack; the origin of the lens's scene lies at the point.

    design: a bstcad.Design or a bstcad.Lens; trim, holes: see Design.solid.
    """
    solid = lens_solid(getattr(design, "lens", design), trim, holes)
    return self.eachpoint(lambda location: solid.moved(location))


def mounted(
    self: cadquery.Workplane, design: Any, z: float = 0.0, trim: cadquery.Wire | None = None, holes: Sequence[Any] = ()
) -> cadquery.Workplane:
    """Return a Workplane with one solid: the chain's solid joined with a lens at each point; see bstcad.mounted.

    Only x and y of the points are used.  z: height (mm) of the origin of the lens's scene in the solid's frame.
    """
    lenses: list[PlacedLens] = []

    def place(location: cadquery.Location) -> cadquery.Vertex:  # eachpoint expects a shape
        x, y, _ = location.toTuple()[0]
        lenses.append(PlacedLens(getattr(design, "lens", design), trim, holes, (x, y, z)))
        return cadquery.Vertex.makeVertex(0, 0, 0)

    self.eachpoint(place)
    return self.newObject([mounting.mounted(self.findSolid(), lenses).solid])


for method in (lens, mounted):
    setattr(cadquery.Workplane, method.__name__, method)
