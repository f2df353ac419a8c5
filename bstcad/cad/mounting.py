"""Lenses in a body that holds them, as one part: a flange, a plate with an array of lenses, the block of an insert.

The body is any cadquery solid.  A prism over the lens's rim is cut out of it, which is quick, since no net takes part;
then the walls of that opening give way to walls between the body's faces and the lens's, whose edges both share.  The
optical faces are those of the design, control point for control point.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from OCP.BRep import BRep_Builder, BRep_Tool
from OCP.BRepAdaptor import BRepAdaptor_Curve, BRepAdaptor_Surface
from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace, BRepBuilderAPI_MakeVertex
from OCP.BRepCheck import BRepCheck_Analyzer
from OCP.BRepExtrema import BRepExtrema_DistShapeShape
from OCP.BRepPrimAPI import BRepPrimAPI_MakePrism
from OCP.GeomAbs import GeomAbs_SurfaceType
from OCP.gp import gp_Pnt, gp_Trsf, gp_Vec
from OCP.ShapeCustom import ShapeCustom
from OCP.TopAbs import TopAbs_EDGE, TopAbs_FACE, TopAbs_Orientation, TopAbs_ShapeEnum, TopAbs_WIRE
from OCP.TopExp import TopExp_Explorer
from OCP.TopLoc import TopLoc_Location
from OCP.TopoDS import TopoDS, TopoDS_Edge, TopoDS_Face, TopoDS_Shape, TopoDS_Solid, TopoDS_Wire

from bstcad.cad.draft import Lean
from bstcad.cad.leaning import Foot
from bstcad.cad.loops import Piece, shape_in
from bstcad.cad.solid import SLIM, Loop, check_thickness, face_inside, solid_of
from bstcad.cad.trimming import UPRIGHT, cut_loops, down, sides
from bstcad.cad.walls import Ring, between, level
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import sag

if TYPE_CHECKING:
    import cadquery

NEAR = 1e-6  # mm; an edge of the body that is nearer to a lens's wall lies on it
PLANE = GeomAbs_SurfaceType.GeomAbs_Plane
ALONG = (0.0, 0.31, 0.77, 1.0)  # of an edge: where it is looked at


@dataclass(frozen=True)
class Placed:
    """A lens, what it is cut to, and where its frame's origin stands in the body's."""

    lens: Lens
    trim: cadquery.Wire | None = None  # in the lens's frame; None: its own outline
    holes: Sequence = ()  # through it: wires, or (x, y, diameter) in mm
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)  # mm
    lean: Lean = UPRIGHT  # of its walls below the body


@dataclass(frozen=True)
class Mounted:
    """A solid, and what each of its faces is, in the order in which it has them."""

    solid: cadquery.Solid
    faces: tuple[str, ...]  # "back", "front", "rim", "bevel", "hole" or "flange"
    body: TopoDS_Solid | None = None  # what is left of the body beside the lenses; None: there was none
    contact: float = 0.0  # of the lenses' walls, what touches the body (mm²)


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
    if not isinstance(given, TopoDS_Shape):
        raise ValueError(f"mount: the body is {what}; give one cadquery solid, such as Workplane().box(30, 30, 2)")
    # OCC tapers and chamfers with left-handed planes and cones; its STEP writer would turn them and lose their names.
    shape = ShapeCustom.DirectFaces_s(_solid(given, "the body"))
    for opening in openings:
        shape = _solid(BRepAlgoAPI_Cut(shape, opening.prism(shape)).Shape(), "what is left of the body")
    faces = [TopoDS.Face_s(face) for face in _inside(shape, TopAbs_FACE)]
    walls: set[int] = set()  # of openings; the lenses' own walls take their place
    instead: dict[int, dict[int, list[Loop]]] = {}  # of a face, by its wire: the loops that take its place
    built: list[tuple[TopoDS_Face, str]] = []
    touching = 0.0
    for opening in openings:
        inner, upper, lower = _met(opening, faces)
        walls |= inner
        own, *around = _glued(opening, lower.z, upper.z)
        built += own
        touching += contact(opening.lens, opening.rings[0].pieces, lower.z - opening.z, upper.z - opening.z)
        for plane, new in zip((upper, lower), around, strict=True):
            instead.setdefault(plane.face, {})[plane.wire] = new
    for k, face in enumerate(faces):
        if k not in walls:
            built.append((_with(face, instead[k]) if k in instead else face, "flange"))
    solid = solid_of([face for face, _ in built])
    if not BRepCheck_Analyzer(solid).IsValid():
        raise ValueError("mount: body and lens make no valid solid; move the body's edges away from the lens's rim")
    return Mounted(cadquery.Solid(solid), tuple(name for _, name in built), shape, touching)


def _solid(shape: TopoDS_Shape, what: str) -> TopoDS_Solid:
    """The one solid in a shape."""
    found = list(_inside(shape, TopAbs_ShapeEnum.TopAbs_SOLID))
    if len(found) != 1:
        raise ValueError(f"mount: {what} is {len(found)} solids; give one solid that reaches all around each lens")
    return TopoDS.Solid_s(found[0])


def _inside(shape: TopoDS_Shape, kind: TopAbs_ShapeEnum) -> Iterator[TopoDS_Shape]:
    explorer = TopExp_Explorer(shape, kind)
    while explorer.More():
        yield explorer.Current()
        explorer.Next()


def _by(x: float, y: float, z: float) -> TopLoc_Location:
    """A move (mm).  Shapes that share an edge still do if one and the same move moves them."""
    if x == y == z == 0:
        return TopLoc_Location()
    there = gp_Trsf()
    there.SetTranslation(gp_Vec(x, y, z))
    return TopLoc_Location(there)


@dataclass(frozen=True)
class _Opening:
    """Where a lens goes into the body."""

    lens: Lens
    name: str  # in sentences
    z: float  # of its frame in the body's (mm)
    there: TopLoc_Location  # from its frame to the body's
    rings: tuple[Ring, ...]  # the rim, then holes
    outline: TopoDS_Wire  # the rim in the plane z = 0, in the body's frame
    lean: Lean

    @classmethod
    def of(cls, placed: Placed, name: str) -> _Opening:
        if not np.isfinite(placed.at).all():  # a prism there ends the process
            raise ValueError(f"{name}: {placed.at} is no place; give x, y and z in mm")
        lens = placed.lens.plain()
        check_thickness(lens)
        rings = tuple(Ring.of(loop) for loop in cut_loops(lens, placed.trim, placed.holes))
        builder, outline = BRep_Builder(), TopoDS_Wire()
        builder.MakeWire(outline)
        for edge in level(rings[0], 0.0).edges:
            builder.Add(outline, edge)
        x, y, z = placed.at
        return cls(lens, name, z, _by(x, y, z), rings, TopoDS.Wire_s(outline.Moved(_by(x, y, 0.0))), placed.lean)

    def prism(self, body: TopoDS_Shape) -> TopoDS_Shape:
        """All that stands over the rim, as high as the body."""
        import cadquery

        box = cadquery.Shape(body).BoundingBox()
        low = TopoDS.Wire_s(self.outline.Moved(_by(0.0, 0.0, box.zmin - 1)))
        return BRepPrimAPI_MakePrism(BRepBuilderAPI_MakeFace(low, True).Face(), gp_Vec(0, 0, box.zlen + 2)).Shape()

    def touches(self, shape: TopoDS_Shape) -> bool:
        """Do all edges of a face or a wire of the body lie on the wall over the rim?"""
        return all(self._touches(TopoDS.Edge_s(edge)) for edge in _inside(shape, TopAbs_EDGE))

    def _touches(self, edge: TopoDS_Edge) -> bool:
        curve = BRepAdaptor_Curve(edge)
        first, last = curve.FirstParameter(), curve.LastParameter()
        for share in ALONG:
            place = curve.Value(first + share * (last - first))
            flat = BRepBuilderAPI_MakeVertex(gp_Pnt(place.X(), place.Y(), 0.0)).Vertex()
            if BRepExtrema_DistShapeShape(flat, self.outline).Value() > NEAR:
                return False
        return True


@dataclass(frozen=True)
class _Met:
    """A plane of the body that meets a lens's wall."""

    face: int
    wire: int  # of its wires, the one around the lens
    z: float  # mm, in the body's frame


def _met(opening: _Opening, faces: Sequence[TopoDS_Face]) -> tuple[set[int], _Met, _Met]:
    """(the faces of the body that are walls of the opening, its upper plane there, its lower one)."""
    walls: set[int] = set()
    planes: dict[bool, list[_Met]] = {True: [], False: []}
    for k, face in enumerate(faces):
        wires = [opening.touches(wire) for wire in _inside(face, TopAbs_WIRE)]
        if all(wires):
            walls.add(k)
        elif any(wires):
            surface = BRepAdaptor_Surface(face)
            normal = surface.Plane().Axis().Direction().Z() if surface.GetType() == PLANE else 0.0
            if abs(abs(normal) - 1) > 1e-12:
                raise ValueError(f"{opening.name}: the body meets it in a face that is no plane z = const; make it one")
            out = (1 if surface.Plane().Direct() else -1) * normal
            above = (out > 0) == (face.Orientation() == TopAbs_Orientation.TopAbs_FORWARD)
            planes[above].append(_Met(k, wires.index(True), surface.Plane().Location().Z()))
    if [len(planes[above]) for above in (True, False)] != [1, 1]:
        raise ValueError(
            f"{opening.name}: the body has to reach all around it between two planes z = const, but "
            f"{len(planes[True])} planes from above and {len(planes[False])} from below meet it; make it a plate there"
        )
    return walls, planes[True][0], planes[False][0]


def _glued(
    opening: _Opening, lower: float, upper: float
) -> tuple[list[tuple[TopoDS_Face, str]], list[Loop], list[Loop]]:
    """(the lens's faces, the loops that bound the body's upper plane around it, and those of its lower plane).

    lower, upper: z of the planes in the body's frame (mm).
    """
    lens, rings, dz = opening.lens, opening.rings, opening.z
    over, under = fit(lens, rings[0].pieces, lower - dz, upper - dz, opening.name)
    if opening.lean and under is not False:
        raise ValueError(
            f"{opening.name}: draft and bevel are of its own walls, below the flange, whose lower face, z = {lower:g} "
            "mm, leaves none; leave them out, or move it up"
        )
    back, front = sides(lens)
    backs = [back.rail(ring) for ring in rings]
    inner = [front.rail(ring) for ring in rings[1:]]
    rim, top = rings[0], level(rings[0], upper - dz)
    found = [(back.cap(rings, backs, along=True), "back")]
    walls = between(rim, backs[0], top, outward=False) if over else between(rim, top, backs[0])
    if under is None:  # the lower plane is the front's: one face
        below, foot = [rail.against() for rail in inner], None
    else:
        bottom = level(rim, lower - dz)
        if under:
            low = front.rail(rim)
            foot = Foot([(wall, "rim") for wall in between(rim, bottom, low, outward=False)], rim, low)
        else:
            foot = down(front, rings, bottom, lambda places: np.full(len(places), lower - dz), opening.lean)
        found.append((front.cap([foot.ring, *rings[1:]], [foot.rail, *inner], along=False), "front"))
        below = [bottom.along()]
    found += [(wall, "rim") for wall in walls] + (foot.walls if foot else [])
    for ring, low, high in zip(rings[1:], inner, backs[1:], strict=True):
        found += [(wall, "hole") for wall in between(ring, low, high)]
    moved = [(TopoDS.Face_s(face.Moved(opening.there)), name) for face, name in found]
    above, below = (
        [[(edge.Moved(opening.there), forward) for edge, forward in loop] for loop in each]
        for each in ([top.against()], below)
    )
    return moved, above, below


def fit(lens: Lens, rim: Sequence[Piece], lower: float, upper: float, name: str = "lens") -> tuple[bool, bool | None]:
    """(is the body's upper plane above the back's rim?, its lower plane below the front's?), in the lens's frame (mm).

    The latter None: it is the plane of the front.  ValueError if a plane cuts a rim, or the body misses the wall.
    """
    _, high, low = _heights(lens, rim)
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


def contact(lens: Lens, rim: Sequence[Piece], lower: float, upper: float) -> float:
    """The area of the lens's wall over a rim that lies between two planes z = lower and upper (mm²)."""
    weights, high, low = _heights(lens, rim)
    return float(weights @ np.maximum(np.minimum(upper, high) - np.maximum(lower, low), 0.0))


def _heights(lens: Lens, rim: Sequence[Piece]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(lengths (mm) that sum to the rim's, z of the back, z of the front) at places along a rim, some in each cell."""
    count = 4 * lens.back.m  # parts of each piece
    lengths, places = [], []
    for piece in rim:
        ends = np.linspace(0.0, piece.end, count + 1)
        for t, share in zip((ends[:-1], ends[:-1] / 2 + ends[1:] / 2, ends[1:]), (1 / 6, 4 / 6, 1 / 6), strict=True):
            at, along = piece.points(t)
            places.append(at)
            lengths.append(np.hypot(*along.T) * share * piece.end / count)  # Simpson's rule
    x, y = np.concatenate(places).T
    return np.concatenate(lengths), sag(lens.back, x, y), sag(lens.front, x, y)


def _with(face: TopoDS_Face, instead: dict[int, list[Loop]]) -> TopoDS_Face:
    """A plane face of the body with other loops for some of its wires."""
    loops_of: list[Loop] = []
    for k, wire in enumerate(_inside(face, TopAbs_WIRE)):
        edges = [TopoDS.Edge_s(edge) for edge in _inside(wire, TopAbs_EDGE)]
        own = [(_forward(edge), edge.Orientation() == TopAbs_Orientation.TopAbs_FORWARD) for edge in edges]
        loops_of += instead.get(k, [own])
    return face_inside(BRep_Tool.Surface_s(face), face.Orientation() == TopAbs_Orientation.TopAbs_FORWARD, *loops_of)


def _forward(edge: TopoDS_Edge) -> TopoDS_Edge:
    return TopoDS.Edge_s(edge.Oriented(TopAbs_Orientation.TopAbs_FORWARD))
