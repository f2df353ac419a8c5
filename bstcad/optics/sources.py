"""Light sources: each says what flux crosses a plane z = const, and sends the rays that carry it.

`irradiance(x, y, z)` is the flux density (1/mm², of a source whose whole flux is 1) on the plane z before the lens, and
`rays(x, y, z, area)` are the rays through points of that plane, each with the flux of its share `area` of the plane.
Light travels from the source towards that plane: along +z to a plane above it, along -z to one below (mirrors).

A source of some `extent`, or of several lines, is a sum of simple ones (`element`; see channels.py).  What is said
above holds for simple sources; an extended one gives the light of its middle (`central`).
"""

from bstcad.optics.collimated import Collimated
from bstcad.optics.point import Point

__all__ = ["Collimated", "Point", "Source"]

Source = Collimated | Point
