"""A dome in a scene: the back as distances from a centre, and the default outlines of the lens and its front."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from bstcad.optics.charts import SphereChart
from bstcad.optics.key import Key
from bstcad.optics.outlines import Circle
from bstcad.optics.sides import Sides
from bstcad.scene.errors import SceneError
from bstcad.scene.schema import COORDINATES, LENGTHS, NET_SIZES, Record

DOME_HALF_ANGLE = 85.0  # degrees; default of lens.back.half_angle
DOME_MARGIN = 1e-6  # relative margin of the outline of a dome's front beyond the half angle
MIN_DOME_POINTS = 17  # fewest control points per side of a dome


class RadialBack(Record):
    """The back as a dome before tailoring: a sphere about a centre, whose control points keep their directions."""

    kind: Annotated[Literal["radial"], Key("A dome: a freeform face of distances from a centre.")] = "radial"
    centre: Annotated[
        tuple[float, float, float],
        Key("Centre of the distances, on the axis.", "mm", *COORDINATES, example=[0.0, 0.0, 0.0]),
    ] = (0.0, 0.0, 0.0)
    radius: Annotated[float, Key("Distance of the vertex from the centre.", "mm", *LENGTHS, example=15.0)]
    half_angle: Annotated[
        float, Key("Angle from the axis, seen from the centre, up to which the dome is tailored.", "degrees", 5.0, 89.0)
    ] = DOME_HALF_ANGLE
    control_points: Annotated[
        int | None, Key("Control points per side; chosen by bstcad if absent.", "", *NET_SIZES, example=257)
    ] = None

    reflect: ClassVar[bool] = False
    optimise: ClassVar[bool] = True

    @property
    def z(self) -> float:
        """z (mm) of the vertex."""
        return self.centre[2] + self.radius

    @property
    def net(self) -> Sides:
        """Control points per side; SceneError if they are not given."""
        if self.control_points is None:
            raise SceneError("lens.back.control_points: missing; give a number, or use bstcad.design, which chooses it")
        return self.control_points

    @property
    def chart(self) -> SphereChart:
        """Chart of the sphere through the vertex."""
        return SphereChart(self.radius)

    @property
    def lit(self) -> Circle:
        """Disc of the chart up to the half angle."""
        return Circle(self.chart.length(math.radians(self.half_angle)))


def complete(lens: Any) -> None:
    """Add to a table [lens] the kind of its back, and the outlines of a dome and its front, if these are not given."""
    back = lens.get("back") if isinstance(lens, dict) else None
    if not isinstance(back, dict) or back.setdefault("kind", "bspline") != "radial":
        return
    centre, angle = back.get("centre", (0.0, 0.0, 0.0)), back.get("half_angle", DOME_HALF_ANGLE)
    front = lens.get("front")
    try:
        z, half = float(centre[2]), math.radians(min(angle, 90.0))
        lens.setdefault("outline", {"shape": "circle", "radius": float(back["radius"]) * math.sin(half)})
        if isinstance(front, dict) and front.get("kind") in ("sphere", "conic") and "outline" not in front:
            radius = _radius_at(front, z, half)
            if radius is not None:
                front["outline"] = {"shape": "circle", "radius": radius}
    except (KeyError, TypeError, ValueError, IndexError):
        return  # refused with its key, when the tables are read


def _radius_at(front: dict[str, Any], z: float, angle: float) -> float | None:
    """Return the distance from the axis (mm) at which the cone of `angle` (rad) about (0, 0, z) meets a front.

    Points (s sin α, z + s cos α) on c r² - 2 h + (1 + k) c h² = 0, h over the vertex, solve a quadratic equation in s.
    None: the cone does not meet the front.
    """
    c, k = float(front.get("curvature", 0.0)), float(front.get("conic_constant", 0.0))
    sin, cos, below = math.sin(angle), math.cos(angle), z - float(front["z"])
    a = c * (sin * sin + (1 + k) * cos * cos)
    b = (1 + k) * c * below * cos - cos
    d = (1 + k) * c * below**2 - 2 * below
    square = b * b - a * d
    if not (square > 0 and a):
        return None
    s = max((-b - math.sqrt(square)) / a, (-b + math.sqrt(square)) / a)
    return s * sin * (1 + DOME_MARGIN) if s > 0 else None
