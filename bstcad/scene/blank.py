"""The lens before tailoring: outline, front, back, and the bounds on its tailored faces."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import torch
from pydantic import ConfigDict, Field

from bstcad.optics.lens.media import refractive_index
from bstcad.optics.lens.passes import LENS, MIRROR, SECOND_SURFACE, Passes
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.surfaces.charts import HEIGHTS, Chart
from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.outlines import Circle, Outline, Rectangle
from bstcad.optics.surfaces.sides import Sides, as_pair, coarser, in_proportion, simplified
from bstcad.optics.surfaces.surfaces import Surface
from bstcad.runs.files import HEIGHT_EXPORTS, PATHS, TOOL_RADII
from bstcad.scene.dome_back import RadialBack
from bstcad.scene.errors import SceneError
from bstcad.scene.fronts import (
    MAX_DOME_SLOPE,
    MAX_RECESS_SLOPE,
    MIN_ROUND_POINTS,
    FittedFront,
    Front,
    net_complaints,
    net_extent,
    net_of,
)
from bstcad.scene.schema import (
    COORDINATES,
    LENGTHS,
    MAX_CONTROL_POINTS,
    NET_SIZES,
    OneOrTwo,
    Record,
    leaving_out,
)
from bstcad.tailoring.settings import Bounds

if TYPE_CHECKING:
    from bstcad.optics.surfaces.bspline import BSplineSurface

INDICES = (1.01, 5.0)  # range of the refractive index
INDEX_OFFSETS = (-0.05, 0.05)  # range of the index of a melt minus that of its material
BOUNDS = ("tool_radius", "max_slope", "max_thickness", "edge_thickness")  # optional keys of lens that bound its faces
MAX_CELL_RATIO = 1.5  # longer / shorter side of a cell of the net, above which a warning proposes another net
Outlined = Annotated[Rectangle | Circle, Field(discriminator="shape")]


def stated_index(material: str | None, index: float | None, wavelength: float) -> float:
    """Return `index` if a table of the scene states it, else the index of its material, at a wavelength (nm)."""
    if index is not None:
        return index
    assert material is not None  # `complaints` refuse a table with neither
    return refractive_index(material, wavelength)


class Back(Record):
    """The back before tailoring: a flat B-spline net at z, which stays flat if it is not optimised."""

    kind: Annotated[Literal["bspline"], Key("The freeform face that bstcad finds.")] = "bspline"
    z: Annotated[float, Key("Position of the flat face before tailoring.", "mm", *COORDINATES, example=20.0)]
    control_points: Annotated[
        OneOrTwo | None,
        Key("Control points per side, or [along x, along y]; chosen by bstcad if absent.", "", *NET_SIZES, example=257),
    ] = None
    reflect: Annotated[bool, Key("A mirror: light comes along -z and goes back along +z.")] = False
    optimise: Annotated[bool, Key("Tailor the back; if false it stays flat.", example=False)] = True

    chart: ClassVar[Chart] = HEIGHTS  # chart of the face
    vertex_key: ClassVar[str] = "lens.back.z"  # key of the position of the vertex
    extent_key: ClassVar[str] = "lens.outline"  # key of the extent of the face
    fewest_points: ClassVar[int] = 0  # smallest number of control points per side of a net that bstcad chooses

    written = leaving_out(optimise=True)

    def lit(self, outline: Outline) -> Outline:
        """Return the outline of the face in its chart; outline: of the lens."""
        return outline

    def flat(self, sides: Sides, half_extent: tuple[float, float]) -> BSplineSurface:
        """Return the face before tailoring; half_extent: of its net in the chart (mm)."""
        from bstcad.optics.surfaces.bspline import BSplineSurface  # loads numba, which a scene alone does not need

        half_x, half_y = half_extent
        heights = torch.zeros(as_pair(sides), dtype=torch.float64)
        return BSplineSurface(self.z, heights, (-half_x, half_x), (-half_y, half_y))

    def light(self, source: Emitter, front: Surface) -> Emitter:
        """Return the light of a source as the face needs it: by the points of planes."""
        return source

    @property
    def net(self) -> Sides:
        """Control points per side, or along x and along y if these differ; SceneError if they are not given."""
        if self.control_points is None:
            raise SceneError("lens.back.control_points: missing; give a number, or use bstcad.design, which chooses it")
        return simplified(self.control_points)


def export_complaints(
    kinds: Iterable[str], dome: bool, index_before: float, front_ends: bool = False, tool_radius: float | None = None
) -> Iterator[str]:
    """Yield a sentence for each kind of export that cannot hold a lens; index_before: of the medium at its front.

    front_ends: True if the front has an outline of its own, with a plane around it.  tool_radius: radius (mm) of the
    tool that the scene states; None: no radius.
    """
    for kind in kinds:
        if dome and kind in HEIGHT_EXPORTS:
            heights = f'"{kind}" is {HEIGHT_EXPORTS[kind]} heights z(x, y), and the back of a dome is none'
            yield f'{heights}; use lens.step or lens.stl, or write "sag" (polar distances), "points" or "preview"'
        elif dome and kind == "tiles":
            yield '"tiles" cuts a back of heights z(x, y) along planes, and lens.back is a dome; use lens.step'
        elif front_ends and kind == "tiles":
            yield '"tiles" cuts whole faces, and the front ends in lens.front.outline; remove it, or use lens.step'
        elif index_before != 1 and kind == "zemax":
            yield '"zemax" starts its light in air, and lens.encapsulant is not air; use lens.step in its place'
        elif kind in PATHS and tool_radius is not None and not TOOL_RADII[0] <= tool_radius <= TOOL_RADII[1]:
            radius = (
                f"lens.tool_radius, and {tool_radius:g} mm is not between {TOOL_RADII[0]:g} and {TOOL_RADII[1]:g} mm"
            )
            yield f'"{kind}" cuts with {radius}; use bstcad export --as {kind} --tool-radius in its place'


AnyBack = Annotated[Back | RadialBack, Field(discriminator="kind")]


def _outline_unless_dome(node: dict[str, Any]) -> None:
    """Let the JSON schema of a lens require the outline only if the back is no dome, which ends at its half angle."""
    node["required"].remove("outline")
    dome = {"properties": {"kind": {"const": "radial"}}, "required": ["kind"]}
    node.update({"if": {"properties": {"back": dome}, "required": ["back"]}, "else": {"required": ["outline"]}})


class LensBlank(Record):
    """The lens before tailoring: light enters through the front and leaves through the back.

    A mirror is a plate whose back, the face with the larger z, reflects; no light meets its front.  If the front
    reflects, light crosses the back before and after the front.
    """

    model_config = ConfigDict(json_schema_extra=_outline_unless_dome)

    material: Annotated[str | None, Key("Name of the material on refractiveindex.info; or give the index.")] = None
    index: Annotated[float | None, Key("Refractive index, in place of material.", "", *INDICES, example=1.49)] = None
    index_offset: Annotated[
        float | None,
        Key("Index of the glass as melted minus the material's.", "", *INDEX_OFFSETS, example=3e-4),
    ] = None
    encapsulant: Annotated[
        float | None,
        Key("Index of the encapsulant between lamp and front, in place of air.", "", *INDICES, example=1.41),
    ] = None
    outline: Annotated[Outlined, Key("Rim of the lens.", example={"shape": "rectangle", "width": 24.0, "height": 24.0})]
    front: Annotated[Front, Key("Face at smaller z, where light enters a lens.", example={"kind": "plane", "z": 8.0})]
    back: Annotated[
        AnyBack,
        Key("Face at larger z, tailored by default.", example={"kind": "bspline", "z": 20.0, "control_points": 257}),
    ]
    tool_radius: Annotated[
        float | None, Key("Radius of the tool: minimum radius of the valleys of tailored faces.", "mm", 1e-6, 1e9)
    ] = None
    mould: Annotated[bool, Key("True: the tool cuts a mould, and tool_radius bounds the ridges.", example=True)] = False
    max_slope: Annotated[float | None, Key("Maximum slope of a tailored face.", "degrees", 1e-3, 89.0)] = None
    min_thickness: Annotated[float, Key("Minimum thickness along z; faces move to keep it.", "mm", *LENGTHS)] = 0.5
    max_thickness: Annotated[float | None, Key("Maximum thickness along z.", "mm", *LENGTHS)] = None
    edge_thickness: Annotated[float | None, Key("Minimum thickness along the rim.", "mm", *LENGTHS)] = None

    @property
    def dome(self) -> RadialBack | None:
        """The back, if it is a dome."""
        return self.back if isinstance(self.back, RadialBack) else None

    def require_heights(self, what: str) -> None:
        """Raise SceneError for a dome, with which the command or option `what` is not possible."""
        if not self.back.chart.flat:
            raise SceneError(f"{what}: is not possible for a dome yet; use lens.step, lens.stl and the report")

    @property
    def passes(self) -> Passes:
        """Sequence of the faces that light meets, and whether each refracts or reflects."""
        if self.encapsulant is not None:
            return replace(LENS, index_before=self.encapsulant)
        return MIRROR if self.back.reflect else SECOND_SURFACE if self.front.reflect else LENS

    @property
    def optic(self) -> str:
        """Kind of the optic: "lens" or "mirror"."""
        return self.passes.optic

    def index_at(self, wavelength: float) -> float:
        """Return the lens's refractive index at a wavelength (nm); 1 if light does not enter the solid."""
        if not self.passes.enters:
            return 1.0
        return stated_index(self.material, self.index, wavelength) + (self.index_offset or 0.0)

    @property
    def bounded_by(self) -> tuple[str, ...]:
        """Keys of BOUNDS that the scene states."""
        return tuple(key for key in BOUNDS if getattr(self, key) is not None)

    @property
    def bounds(self) -> Bounds | None:
        """Bounds on the tailored faces; None if the scene states no key of BOUNDS."""
        if not self.bounded_by:
            return None
        curvature = None if self.tool_radius is None else 1 / self.tool_radius
        return Bounds(
            concave=None if self.mould else curvature,
            convex=curvature if self.mould else None,
            slope=None if self.max_slope is None else math.tan(math.radians(self.max_slope)),
            thinnest=self.min_thickness,
            thickest=self.max_thickness,
            edge=self.edge_thickness,
        )

    @property
    def front_sags(self) -> tuple[float, float]:
        """Lowest and highest sag (mm) of the front inside the outline, including the vertex (0)."""
        return self.front.surface.sags(self.outline)

    @property
    def front_surface(self) -> Surface:
        """The front before tailoring, as it is traced: a fitted net in the place of a toroid."""
        return self.front.traced(self.outline)

    @property
    def tailored_faces(self) -> tuple[str, ...]:
        """Faces that tailoring shapes, in the order of the light."""
        tailored = {"front": self.front.is_tailored, "back": self.back.optimise}
        return tuple(face for face in self.passes.faces if tailored[face])

    def front_net(self, net: Sides) -> Sides | None:
        """Return the control points per side of the front's net if the back has `net`; None if the front has no net."""
        if self.front.is_tailored:
            return self._tailored_front_net(net)
        fixed = net_of(self.front.surface, self.outline) if isinstance(self.front, FittedFront) else self.front.file
        return None if fixed is None else simplified(fixed.shape)

    def _tailored_front_net(self, net: Sides) -> Sides:
        """Return a tailored front's control points per side if the back has `net`, in the scene's ratio."""
        own = self.front.file.shape if self.front.file else self.front.control_points
        if own is None:
            return net
        if self.back.control_points is None:  # the ratio is not known yet
            return coarser(simplified(own), max(as_pair(net)))
        return in_proportion(net, of=self.back.net, to=simplified(own))

    def nets(self, net: Sides | None = None) -> tuple[Sides, ...]:
        """Return the control points per side of the back (`net`, or the scene's), then of the front if it has a net."""
        back = net or self.back.net
        front = self.front_net(back)
        return (back,) if front is None else (back, front)

    def flat_front(self, net: Sides, as_wide_as: Sides | None = None) -> Surface:
        """Return the front before tailoring for a back of `net` control points; as_wide_as: see Scene.flat_lens."""
        if not self.front.is_tailored:
            return self.front_surface
        if self.front.file is not None:
            return self.front.file.surface(self.front.z).refined(self._tailored_front_net(net))
        from bstcad.optics.surfaces.bspline import BSplineSurface

        half_x, half_y = net_extent(self.outline, self._tailored_front_net(as_wide_as or net))
        heights = torch.zeros(as_pair(self._tailored_front_net(net)), dtype=torch.float64)
        return BSplineSurface(self.front.z, heights, (-half_x, half_x), (-half_y, half_y))

    @property
    def cells(self) -> tuple[float, float]:
        """Width and height (mm) of a cell of the back's net in the scene."""
        half_x, half_y = net_extent(self.outline, self.back.net)
        m, n = as_pair(self.back.net)
        return 2 * half_x / (m - 1), 2 * half_y / (n - 1)

    def doubts(self) -> Iterator[str]:
        """Yield a warning about oblong cells: square cells give finer detail with as many control points."""
        if self.back.control_points is None:
            return
        (width, height), (m, n) = self.cells, as_pair(self.back.net)
        if max(width, height) <= MAX_CELL_RATIO * min(width, height):
            return
        even = math.sqrt(width * height)
        better = [round((points - 1) * side / even) + 1 for points, side in ((m, width), (n, height))]
        if min(better) >= MIN_ROUND_POINTS and max(better) <= MAX_CONTROL_POINTS:
            yield (
                f"lens.back.control_points: the net's cells are {width:.3g} x {height:.3g} mm; {better} makes them "
                "square with as many control points"
            )

    def complaints(self) -> Iterator[str]:
        """Yield the faults of the table [lens], each as "key: sentence"."""
        given = [name for name in ("material", "index") if getattr(self, name) is not None]
        if self.front.reflect and self.back.reflect:
            yield "lens.front.reflect: no light reaches the front, as lens.back.reflect is true; remove one of them"
        if not self.passes.enters and given:
            yield f"lens.{given[0]}: light does not enter a mirror (lens.back.reflect); remove this key"
        if self.encapsulant is not None and (self.front.reflect or self.back.reflect):
            mirror = "front" if self.front.reflect else "back"
            yield f"lens.encapsulant: light goes to a mirror through air; remove this key or lens.{mirror}.reflect"
        if self.passes.enters and len(given) != 1:
            yield 'lens: needs exactly one of material and index; give for example material = "PMMA"'
        if self.index_offset is not None and self.material is None:
            yield "lens.index_offset: has no effect without lens.material; change lens.index in its place"
        of_back = net_complaints(self.outline, self.back.control_points)
        yield from (f"lens.back.control_points: {complaint}" for complaint in of_back)
        if not self.back.optimise and not self.front.is_tailored:
            tailored = f'lens.front = {{ kind = "bspline", z = {self.front.z:g}, optimise = true }}'
            yield f"lens.back.optimise: false leaves no face to tailor; write {tailored}, or remove this key"
        steepest = MAX_RECESS_SLOPE if self.back.chart.flat else MAX_DOME_SLOPE
        yield from (f"lens.front.{complaint}" for complaint in self.front.complaints(self.outline, steepest))
        (lowest, highest), thinnest, thickest = self.front_sags, self.min_thickness, self.max_thickness
        rim = "thinnest point" if self.front.surface.is_net else "rim"
        for where, front in (("centre", self.front.z), (rim, self.front.z + highest)):
            if not self.back.z - front >= thinnest:
                thick = f"{self.back.z - front:g} mm thick at its {where}, and lens.min_thickness is {thinnest:g} mm"
                remedy = f"z: the lens is {thick}; move the back to z = {front + thinnest:g} or further"
                if self.dome is not None:
                    least = front + thinnest - self.dome.centre[2]
                    remedy = f"radius: the lens is {thick}; make the dome larger, {least:g} mm or more"
                yield f"lens.back.{remedy}"
        if self.mould and self.tool_radius is None:
            yield "lens.mould: has no effect without lens.tool_radius; add that key, or remove mould"
        for key in ("min_thickness", "edge_thickness"):
            if thickest is not None and thickest < (getattr(self, key) or 0.0):
                less = f"{thickest:g} mm is less than lens.{key} = {getattr(self, key):g} mm"
                yield f"lens.max_thickness: {less}; make it larger, or lens.{key} smaller"
        if thickest is not None and thickest - thinnest < highest - lowest:
            thick = f"{thinnest:g} mm at its thinnest point and {thinnest + highest - lowest:.6g} mm at its thickest"
            why = f"{thickest:g} mm is too small, as with its curved front and a flat back the lens is {thick}"
            yield f"lens.max_thickness: {why}; make it larger"
