"""Lenses in a body that holds them, as one part: a flange, a plate with an array of lenses, the block of an insert.

The body is any cadquery solid.  A prism over the lens's rim is cut out of it, which is quick, since no net takes part;
then the walls of that opening give way to walls between the body's faces and the lens's, whose edges both share.  The
optical faces are those of the design, control point for control point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from OCP.BRep import BRep_Tool
from OCP.BRepCheck import BRepCheck_Analyzer
from OCP.ShapeCustom import ShapeCustom
from OCP.TopAbs import TopAbs_Orientation
from OCP.TopLoc import TopLoc_Location
from OCP.TopoDS import TopoDS, TopoDS_Edge, TopoDS_Face, TopoDS_Shape

from bstcad.cad import walls
from bstcad.cad.draft import UPRIGHT, Draft
from bstcad.cad.solid import SLIM, Loop, check_thickness, face_inside, solid_of
from bstcad.cad.trimming import cut_loops, rim_points, sides
from bstcad.cad.walls import Named
from bstcad.cad.wires import Piece, shape_in
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import sag

if TYPE_CHECKING:
    import cadquery

NEAR = 1e-6  # mm; an edge of the body that is nearer to a lens's wall lies on it
UPWARDS = 1e-12  # of a plane's normal: how far its part along z may be off 1
ALONG = (0.0, 0.31, 0.77, 1.0)  # shares of an edge's length at which its distance from a wall is measured


@dataclass(frozen=True)
class Placed:
    """A lens, its wires, and the position of its frame's origin in the body's frame."""

    lens: Lens
    trim: cadquery.Wire | None = None  # in the lens's frame; None: its own outline
    holes: Sequence = ()  # through it: wires, or (x, y, diameter) in mm
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)  # mm
    draft: Draft = UPRIGHT  # of its walls below the body


@dataclass(frozen=True)
class Mounted:
    """A solid, and the names of its faces, in its own order."""

    solid: cadquery.Solid
    faces: tuple[str, ...]  # "back", "front", "rim", "bevel", "hole" or "flange"


def mounted(body: cadquery.Shape | cadquery.Workplane, lenses: Sequence[Placed]) -> Mounted:
    """The body with each lens in an opening of the lens's own shape, all one solid.

    Around each lens the body must lie between two planes z = const that meet the lens's wall.  Each may also stand
    beyond the lens's rim, above the back or below the front, but may not cut it; a plane front may lie in the lower.
    ValueError in one sentence where that is not so.
    """
    import cadquery

    names = [f"lens {k}" if len(lenses) > 1 else "lens" for k in range(1, len(lenses) + 1)]
    openings = [_Opening.of(each, name) for each, name in zip(lenses, names, strict=True)]
    given, what = shape_in(body)
    if not isinstance(given, cadquery.Shape):
        raise ValueError(f"mount: the body is {what}; give one cadquery solid, such as Workplane().box(30, 30, 2)")
    # OCC tapers and chamfers with left-handed planes and cones; its STEP writer would turn them and lose their names.
    one = _solid(given, "the body").wrapped
    rest = cadquery.Solid(TopoDS.Solid_s(ShapeCustom.DirectFaces_s(one)))
    for opening in openings:
        rest = _solid(rest.cut(opening.prism(rest)), "the rest of the body")
    faces = rest.Faces()
    opened: set[int] = set()  # faces of the body that the lenses' own walls replace
    instead: dict[int, dict[int, list[Loop]]] = {}  # of a face, by its wire: the loops that replace it
    built: list[Named] = []
    for opening in openings:
        inner, upper, lower = _meeting(opening, faces)
        opened |= inner
        own, *around = _glued(opening, lower.z, upper.z)
        built += own
        for plane, new in zip((upper, lower), around, strict=True):
            instead.setdefault(plane.face, {})[plane.wire] = new
    for k, face in enumerate(faces):
        if k not in opened:
            built.append((_with(face, instead[k]) if k in instead else face.wrapped, "flange"))
    solid = solid_of([face for face, _ in built])
    if not BRepCheck_Analyzer(solid).IsValid():
        raise ValueError("mount: body and lens make no valid solid; move the body's edges away from the lens's rim")
    return Mounted(cadquery.Solid(solid), tuple(name for _, name in built))


def _solid(shape: cadquery.Shape, what: str) -> cadquery.Solid:
    """The one solid in a shape."""
    solids = shape.Solids()
    if len(solids) != 1:
        raise ValueError(f"mount: {what} is {len(solids)} solids; give one solid that reaches all around each lens")
    return solids[0]


@dataclass(frozen=True)
class _Opening:
    """Where a lens goes into the body."""

    lens: Lens
    name: str  # in sentences
    at: tuple[float, float, float]  # of the lens's frame in the body's (mm)
    loops: list[list[Piece]]  # the rim, then holes
    there: TopLoc_Location  # from the lens's frame to the body's: moved by one location, faces still share their edges
    outline: cadquery.Wire  # the rim in the plane z = 0, in the body's frame
    draft: Draft

    @classmethod
    def of(cls, placed: Placed, name: str) -> _Opening:
        import cadquery

        if not np.isfinite(placed.at).all():  # a prism there ends the process
            raise ValueError(f"{name}: {placed.at} is no place; give x, y and z in mm")
        lens = placed.lens.plain()
        check_thickness(lens)
        loops = cut_loops(lens, placed.trim, placed.holes)
        x, y, _ = placed.at
        there = cadquery.Location(placed.at).wrapped if any(placed.at) else TopLoc_Location()
        outline = cadquery.Wire.assembleEdges([cadquery.Edge(edge) for edge in walls.level(loops[0], 0.0).edges])
        outline = outline.translate((x, y, 0.0))
        return cls(lens, name, placed.at, loops, there=there, outline=outline, draft=placed.draft)

    def prism(self, body: cadquery.Shape) -> cadquery.Solid:
        """The prism over the rim, higher than the body."""
        import cadquery

        box = body.BoundingBox()
        low = self.outline.translate((0, 0, box.zmin - 1))
        return cadquery.Solid.extrudeLinear(low, [], cadquery.Vector(0, 0, box.zlen + 2))

    def touches(self, shape: cadquery.Shape) -> bool:
        """Do all edges of a face or a wire of the body lie on the wall over the rim?"""
        import cadquery

        points = (point for edge in shape.Edges() for point in edge.positions(ALONG))
        return all(cadquery.Vertex.makeVertex(p.x, p.y, 0).distance(self.outline) <= NEAR for p in points)


@dataclass(frozen=True)
class _Meeting:
    """A plane of the body that meets a lens's wall."""

    face: int
    wire: int  # of its wires, the one around the lens
    z: float  # mm, in the body's frame


def _meeting(opening: _Opening, faces: Sequence[cadquery.Face]) -> tuple[set[int], _Meeting, _Meeting]:
    """(the faces of the body that are walls of the opening, its upper plane there, its lower one)."""
    inner: set[int] = set()
    planes: dict[bool, list[_Meeting]] = {True: [], False: []}
    for k, face in enumerate(faces):
        wires = [opening.touches(wire) for wire in face.Wires()]
        if all(wires):
            inner.add(k)
        elif any(wires):
            normal = face.normalAt().z if face.geomType() == "PLANE" else 0.0
            if abs(abs(normal) - 1) > UPWARDS:
                raise ValueError(f"{opening.name}: the body meets it in a face that is no plane z = const; make it one")
            planes[normal > 0].append(_Meeting(k, wires.index(True), face.toPln().Location().Z()))
    if [len(planes[above]) for above in (True, False)] != [1, 1]:
        raise ValueError(
            f"{opening.name}: the body has to reach all around it between two planes z = const, but "
            f"{len(planes[True])} planes from above and {len(planes[False])} from below meet it; make it a plate there"
        )
    return inner, planes[True][0], planes[False][0]


def _glued(opening: _Opening, lower: float, upper: float) -> tuple[list[Named], list[Loop], list[Loop]]:
    """(the lens's faces, the loops that bound the body's upper plane around it, and those of its lower plane).

    lower, upper: z of the planes in the body's frame (mm).
    """
    lens, (rim, *holes), dz = opening.lens, opening.loops, opening.at[2]
    over, under = fit(lens, rim, (lower - dz, upper - dz), opening.name)
    if opening.draft and under is not False:
        raise ValueError(
            f"{opening.name}: draft and bevel are of its own walls, below the flange, whose lower face, z = {lower:g} "
            "mm, leaves none; leave them out, or move it up"
        )
    back, front = sides(lens)
    tops, inner = [walls.on(lens.back, loop) for loop in opening.loops], [walls.on(lens.front, hole) for hole in holes]
    top = walls.level(rim, upper - dz)
    faces = [(back.inside(tops, along=True), "back")]
    faces += walls.over(rim, tops[0], top, outward=False) if over else walls.over(rim, top, tops[0])
    if under is None:  # the lower plane is the front's: one face
        below = [rail.against() for rail in inner]
    else:
        bottom = walls.level(rim, lower - dz)
        if under:
            low = walls.on(lens.front, rim)
            faces += walls.over(rim, bottom, low, outward=False)
        else:
            leaning, low = walls.down(
                lens.front, opening.loops, bottom, lambda places: np.full(len(places), lower - dz), opening.draft
            )
            faces += leaning
        faces.append((front.inside([low, *inner], along=False), "front"))
        below = [bottom.along()]
    for hole, low, high in zip(holes, inner, tops[1:], strict=True):
        faces += walls.over(hole, low, high, "hole")
    moved = [(TopoDS.Face_s(face.Moved(opening.there)), name) for face, name in faces]
    above, below = (
        [[(TopoDS.Edge_s(edge.Moved(opening.there)), forward) for edge, forward in loop] for loop in each]
        for each in ([top.against()], below)
    )
    return moved, above, below


def fit(lens: Lens, rim: Sequence[Piece], planes: tuple[float, float], name: str) -> tuple[bool, bool | None]:
    """(is the body's upper plane above the back's rim?, its lower plane below the front's?).

    The latter None: it is the plane of the front.  planes: z of the lower and the upper (mm), in the lens's frame.
    ValueError if a plane cuts a rim, or the body misses the wall.
    """
    lower, upper = planes
    high, low = (sag(face, *rim_points(lens, rim)) for face in (lens.back, lens.front))
    over, under = upper > high.max(), lower < low.min()
    flat = lens.front.sags(lens.outline) == (0.0, 0.0) and abs(lower - lens.front.z) < NEAR
    if np.abs(upper - high).min() < SLIM or not (over or upper < high.min()):
        raise ValueError(
            f"{name}: the flange's upper face, z = {upper:g} mm, cuts the rim of the back, which runs from z = "
            f"{high.min():.4g} to {high.max():.4g} mm; put it below or above that"
        )
    if not flat and (np.abs(lower - low).min() < SLIM or not (under or lower > low.max())):
        raise ValueError(
            f"{name}: the flange's lower face, z = {lower:g} mm, cuts the rim of the front, which runs from z = "
            f"{low.min():.4g} to {low.max():.4g} mm; put it below or above that, or into the plane of a plane front"
        )
    if (np.minimum(upper, high) - np.maximum(lower, low)).min() < SLIM:
        raise ValueError(
            f"{name}: the flange, from z = {lower:g} to {upper:g} mm, misses the lens's wall, from z = {low.max():.4g} "
            f"to {high.min():.4g} mm; move it there"
        )
    return bool(over), None if flat else bool(under)


def _with(face: cadquery.Face, instead: dict[int, list[Loop]]) -> TopoDS_Face:
    """A plane face of the body with other loops for some of its wires."""
    loops: list[Loop] = []
    for k, wire in enumerate(face.Wires()):
        loops += instead.get(k, [[(_forward(edge.wrapped), _is_forward(edge.wrapped)) for edge in wire.Edges()]])
    return face_inside(BRep_Tool.Surface_s(face.wrapped), _is_forward(face.wrapped), *loops)


def _forward(edge: TopoDS_Edge) -> TopoDS_Edge:
    return TopoDS.Edge_s(edge.Oriented(TopAbs_Orientation.TopAbs_FORWARD))


def _is_forward(shape: TopoDS_Shape) -> bool:
    return shape.Orientation() == TopAbs_Orientation.TopAbs_FORWARD
