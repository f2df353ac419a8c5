"""A dome in a scene: the back as distances from a centre, and the default outlines of the lens and its front."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from bstcad.optics.light.emitters import Emitter
from bstcad.optics.light.sphere_light import SphereLight, light_angle
from bstcad.optics.surfaces.charts import SphereChart
from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.outlines import Circle, Outline
from bstcad.optics.surfaces.sides import Sides, as_pair
from bstcad.optics.surfaces.surfaces import Surface
from bstcad.scene.errors import SceneError
from bstcad.scene.schema import COORDINATES, LENGTHS, NET_SIZES, Record

if TYPE_CHECKING:
    from bstcad.optics.surfaces.bspline import BSplineSurface

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
    vertex_key: ClassVar[str] = "lens.back.radius"  # key of the position of the vertex
    extent_key: ClassVar[str] = "lens.back.half_angle"  # key of the extent of the face
    fewest_points: ClassVar[int] = MIN_DOME_POINTS  # smallest number of control points per side that bstcad chooses

    @property
    def z(self) -> float:
        """z (mm) of the vertex."""
        return self.centre[2] + self.radius

    @property
    def rim_z(self) -> float:
        """z (mm) of the rim before tailoring."""
        return self.centre[2] + self.radius * math.cos(math.radians(self.half_angle))

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

    def lit(self, outline: Outline) -> Circle:
        """Return the disc of the chart up to the half angle; outline: of the lens, which follows from it."""
        return Circle(self.chart.length(math.radians(self.half_angle)))

    def flat(self, sides: Sides, half_extent: tuple[float, float]) -> BSplineSurface:
        """Return the sphere about the centre as a net; half_extent: of the net in the chart (mm)."""
        from bstcad.optics.surfaces.radial import RadialSurface  # loads numba, which a scene alone does not need

        return RadialSurface.sphere(self.centre[2], self.radius, half_extent, as_pair(sides))

    def light(self, source: Emitter, front: Surface) -> SphereLight:
        """Return the light of a lamp behind a front by the points of the dome's sphere."""
        half_angle = light_angle(source, front, self.centre, math.radians(self.half_angle))
        return SphereLight.of(source, self.centre[2], self.chart, half_angle=half_angle)


def own_outline(back: RadialBack) -> Circle:
    """Return the outline of a lens whose back is a dome: the circle at the half angle on its sphere."""
    return Circle(_equator(back.radius, math.radians(back.half_angle)))


def forget_outlines(lens: Any, mount: Any) -> None:
    """Remove from a table [lens] the outlines that `complete` would add, so that they follow changes of the scene."""
    front = lens.get("front") if isinstance(lens, dict) else None
    if not isinstance(front, dict):
        return
    bare = {key: value for key, value in lens.items() if key != "outline"}
    bare["front"] = {key: value for key, value in front.items() if key != "outline"}
    complete(bare, mount)
    for table, default in ((lens, bare), (front, bare["front"])):
        if "outline" in default and table.get("outline") == default["outline"]:
            del table["outline"]


def _equator(radius: float, half_angle: float) -> float:
    return radius * math.sin(half_angle)


def complete(lens: Any, mount: Any = None) -> None:
    """Add to a table [lens] the kind of its back, and the outlines of a dome and its front, if these are not given.

    A curved front ends where the cone of the half angle meets it; with a [mount.flange], in the plane of the flange's
    lower face, if this plane lies between the cone and the equator of the front.
    """
    back = lens.get("back") if isinstance(lens, dict) else None
    if not isinstance(back, dict) or back.setdefault("kind", "bspline") != "radial":
        return
    centre, angle = back.get("centre", (0.0, 0.0, 0.0)), back.get("half_angle", DOME_HALF_ANGLE)
    front = lens.get("front")
    try:
        z, half = float(centre[2]), math.radians(min(angle, 90.0))
        lens.setdefault("outline", {"shape": "circle", "radius": _equator(float(back["radius"]), half)})
        if isinstance(front, dict) and front.get("kind") in ("sphere", "conic") and "outline" not in front:
            radius = _radius_at(front, z, half)
            flange = mount.get("flange") if isinstance(mount, dict) else None
            if radius is not None and isinstance(flange, dict) and "z" in flange:
                radius = max(radius, _radius_in_plane(front, float(flange["z"])))
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


def _radius_in_plane(front: dict[str, Any], z: float) -> float:
    """Return the distance from the axis (mm) at which a front crosses the plane at z; 0 if not above its equator.

    The distance r follows from c r² = 2 h - (1 + k) c h², h = z - z0; the equator has h (1 + k) c = 1.
    """
    c, k, h = float(front.get("curvature", 0.0)), float(front.get("conic_constant", 0.0)), z - float(front["z"])
    square = (2 * h - (1 + k) * c * h * h) / c if c and (1 + k) * c * h < 1 else 0.0
    return math.sqrt(max(square, 0.0))
