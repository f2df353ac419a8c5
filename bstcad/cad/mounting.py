"""Lenses and a body as one part: a scene's [mount], a plate with an array of lenses, or the block of a mould insert.

The body is any cadquery solid.  First, a prism over the lens's rim is cut out, which is quick, since it has no net.
Then the walls of this opening are replaced by walls between the faces of the body and of the lens, with shared edges.
Around a dome the prism stands on a circle, and the plane faces of the body are continued to the dome's rim.
The optical faces keep the control points of the design.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from OCP.BRep import BRep_Tool
from OCP.BRepFilletAPI import BRepFilletAPI_MakeChamfer
from OCP.ShapeCustom import ShapeCustom
from OCP.Standard import Standard_Failure
from OCP.StdFail import StdFail_NotDone
from OCP.TopAbs import TopAbs_Orientation
from OCP.TopLoc import TopLoc_Location
from OCP.TopoDS import TopoDS, TopoDS_Face, TopoDS_Shape

from bstcad.cad import solid_properties, step_writing, walls, wires
from bstcad.cad.patches import back_patch
from bstcad.cad.solid import (
    NamedSolid,
    cap,
    cut_loops,
    front_caps,
    named_solid,
    optical_cap,
    prepared,
    rim_heights,
    rim_points,
)
from bstcad.cad.walls import MIN_WALL, NO_DRAFT, Draft, Loop, NamedFace, face_inside, solid_of
from bstcad.cad.wires import LoopPiece, shape_in
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK, FRONT
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.scene.mount import Box, CircleRim, Flange, Mount, Part

if TYPE_CHECKING:
    import cadquery

WALL_TOLERANCE = 1e-6  # largest distance (mm) between a lens's wall and an edge of the body that lies on it
COSINE_TOLERANCE = 1e-12  # largest deviation from 1 of |z| of the unit normal of a plane z = const
DOME_OPENING = 1.001  # ratio of the radius of the circle cut out of a body to the largest radius of a dome's rim
EDGE_FRACTIONS = (0.0, 0.31, 0.77, 1.0)  # fractions of an edge's length at which its distance from a wall is measured
INVALID_PART = "mount: body and lens do not form a valid solid; move the body's edges away from the lens's rim"


@dataclass(frozen=True)
class PlacedLens:
    """A lens, the wires that cut it, and its position in a body."""

    lens: Lens
    trim: cadquery.Wire | None = None  # rim in the lens's frame; None: the lens's outline
    holes: Sequence = ()  # holes through the lens: wires, or (x, y, diameter) in mm
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)  # origin of the lens's frame in the body's frame (mm)
    draft: Draft = NO_DRAFT  # draft of the lens's walls below the body


def mounted(body: cadquery.Shape | cadquery.Workplane, lenses: Sequence[PlacedLens]) -> NamedSolid:
    """Return one solid of the body and the lenses, each in an opening of the lens's shape.

    Around each lens, the body must lie between two planes z = const that meet the lens's wall.  A plane may also lie
    above the rim of the back or below the rim of the front, but may not cut a rim; a plane front may lie in the lower
    plane.  Raises ValueError in one sentence otherwise.
    """
    import cadquery

    names = [f"lens {k}" if len(lenses) > 1 else "lens" for k in range(1, len(lenses) + 1)]
    openings = [_Opening.of(each, name) for each, name in zip(lenses, names, strict=True)]
    given, kind = shape_in(body)
    if not isinstance(given, cadquery.Shape):
        raise ValueError(f"mount: the body is {kind}; give one cadquery solid, such as Workplane().box(30, 30, 2)")
    # tapers and chamfers by OCC have left-handed planes and cones; its STEP writer reverses these without their names
    rest = cadquery.Solid(TopoDS.Solid_s(ShapeCustom.DirectFaces_s(_solid(given, "the body").wrapped)))
    for opening in openings:
        rest = _solid(rest.cut(opening.prism(rest)), "the body without the lenses")
    faces = rest.Faces()
    removed: set[int] = set()  # indices of the body's faces that walls of lenses replace
    replacements: dict[int, dict[int, list[Loop]]] = {}  # loops that replace a wire, by the indices of face and wire
    built: list[NamedFace] = []
    for opening in openings:
        inner, *planes = opening.find_faces(faces)
        removed |= inner
        own, *loops = opening.fill(*(plane.z for plane in planes))
        built += own
        for plane, new in zip(planes, loops, strict=True):
            replacements.setdefault(plane.face, {})[plane.wire] = new
    built += [(_replace_loops(face, replacements.get(k)), "flange") for k, face in enumerate(faces) if k not in removed]
    solid = solid_of([face for face, _ in built], INVALID_PART)
    return NamedSolid(cadquery.Solid(solid), tuple(name for _, name in built))


def _solid(shape: cadquery.Shape, name: str) -> cadquery.Solid:
    """Return the only solid in a shape; ValueError if there is not exactly one."""
    solids = shape.Solids()
    if len(solids) != 1:
        raise ValueError(f"mount: {name} has {len(solids)} solids; give one solid that reaches all around each lens")
    return solids[0]


class _BodyPlane(NamedTuple):
    """A plane face of the body that meets a lens's wall."""

    face: int  # index among the faces of the body
    wire: int  # index of the face's wire around the lens
    z: float  # height in the body's frame (mm)


@dataclass(frozen=True)
class _Opening:
    lens: Lens
    name: str  # name of the lens in messages
    z: float  # height of the lens's frame in the body's frame (mm)
    loops: list[list[LoopPiece]]  # rim and holes
    location: TopLoc_Location  # placement of the lens in the body; one object, so that moved faces share their edges
    outline: cadquery.Wire  # edge of the prism in the plane z = 0 of the body's frame: the rim; for a dome a circle
    draft: Draft  # draft of the lens's walls below the body

    @classmethod
    def of(cls, placed: PlacedLens, name: str) -> _Opening:
        import cadquery

        if not np.isfinite(placed.at).all():  # a prism there would crash the process
            raise ValueError(f"{name}: {placed.at} is not a position; give x, y and z in mm")
        lens = prepared(placed.lens)
        loops = cut_loops(lens, placed.trim, placed.holes)
        x, y, z = placed.at
        location = cadquery.Location(placed.at).wrapped if any(placed.at) else TopLoc_Location()
        around = loops[0] if loops[0][0].rim is None else _circle_around(lens, loops[0])
        rim = cadquery.Wire.assembleEdges([cadquery.Edge(edge) for edge in walls.rail_on(Plane(0.0), around).edges])
        return cls(lens, name, z, loops, location=location, outline=rim.translate((x, y, 0.0)), draft=placed.draft)

    def prism(self, body: cadquery.Shape) -> cadquery.Solid:
        """Return the prism over its edge, from 1 mm below the body to 1 mm above it."""
        import cadquery

        box = body.BoundingBox()
        low = self.outline.translate((0, 0, box.zmin - 1))
        return cadquery.Solid.extrudeLinear(low, [], cadquery.Vector(0, 0, box.zlen + 2))

    def find_faces(self, faces: Sequence[cadquery.Face]) -> tuple[set[int], _BodyPlane, _BodyPlane]:
        """Return the indices of the opening's walls among the body's faces, and the body's upper and lower plane."""
        inner: set[int] = set()
        planes: dict[bool, list[_BodyPlane]] = {True: [], False: []}
        for k, face in enumerate(faces):
            around = [self._touches(wire) for wire in face.Wires()]
            if all(around):
                inner.add(k)
            elif any(around):
                normal = face.normalAt().z if face.geomType() == "PLANE" else 0.0
                if abs(abs(normal) - 1) > COSINE_TOLERANCE:
                    raise ValueError(
                        f"{self.name}: the body meets the lens in a face other than a plane z = const; make it a plane"
                    )
                planes[normal > 0].append(_BodyPlane(k, around.index(True), face.toPln().Location().Z()))
        if [len(planes[above]) for above in (True, False)] != [1, 1]:
            raise ValueError(
                f"{self.name}: the body must surround the lens between two planes z = const, but {len(planes[True])} "
                f"upper and {len(planes[False])} lower planes meet it; give the body the shape of a plate there"
            )
        return inner, planes[True][0], planes[False][0]

    def _touches(self, wire: cadquery.Wire) -> bool:
        """True if all edges of a wire of the body lie on the wall over the prism's edge."""
        import cadquery

        points = (point for edge in wire.Edges() for point in edge.positions(EDGE_FRACTIONS))
        return all(cadquery.Vertex.makeVertex(p.x, p.y, 0).distance(self.outline) <= WALL_TOLERANCE for p in points)

    def fill(self, upper: float, lower: float) -> tuple[list[NamedFace], list[Loop], list[Loop]]:
        """Return the faces of the lens, and the loops around it in the body's planes z = upper and z = lower (mm)."""
        lens, (rim, *holes) = self.lens, self.loops
        above_back, below_front = check_fit(lens, rim, (lower - self.z, upper - self.z), self.name)
        if self.draft and below_front is not False:
            raise ValueError(
                f"{self.name}: draft and bevel need a wall of the lens below the flange, but the flange's lower face, "
                f"z = {lower:g} mm, leaves none; omit draft and bevel, or move the flange up"
            )
        tops = [walls.rail_on(lens.back, loop) for loop in self.loops]
        inner = [walls.rail_on(lens.front.around, hole) for hole in holes]
        top, plane = walls.rail_on(Plane(upper - self.z), rim), Plane(lower - self.z)
        faces = [(cap(back_patch(lens), tops, along=True), BACK)]
        low, high = (tops[0], top) if above_back else (top, tops[0])
        faces += walls.upright_walls(rim, low, high, outward=not above_back)
        if below_front is None:  # the front lies in the lower plane: one face
            below = [rail.against() for rail in inner]
            if lens.front.outline is not None:
                front, edge = optical_cap(lens)
                faces.append(front)
                below.append(edge.along())
        else:
            bottom = walls.rail_on(plane, rim)
            if below_front:
                low = walls.rail_on(lens.front.around, rim)
                faces += walls.upright_walls(rim, bottom, low, outward=False)
            else:
                leaning, low = walls.leaning_walls(lens.front.around, self.loops, bottom, above=plane, draft=self.draft)
                faces += leaning
            faces += front_caps(lens, [low, *inner])
            below = [bottom.along()]
        for hole, low, high in zip(holes, inner, tops[1:], strict=True):
            faces += walls.upright_walls(hole, low, high, "hole")
        moved = [(TopoDS.Face_s(face.Moved(self.location)), name) for face, name in faces]
        return moved, self._moved([top.against()]), self._moved(below)

    def _moved(self, loops: list[Loop]) -> list[Loop]:
        return [[(TopoDS.Edge_s(edge.Moved(self.location)), forward) for edge, forward in loop] for loop in loops]


def _circle_around(lens: Lens, rim: Sequence[LoopPiece]) -> list[LoopPiece]:
    """Return a circle around the rim of a dome, along which a boolean is exact; along the rim it errs by 1e-6 mm."""
    return wires.circle(0.0, 0.0, DOME_OPENING * float(np.hypot(*rim_points(lens, rim)).max()))


def check_fit(lens: Lens, rim: Sequence[LoopPiece], planes: tuple[float, float], name: str) -> tuple[bool, bool | None]:
    """Return (True if the upper plane is above the back's rim, True if the lower plane is below the front's rim).

    The second is None if the front lies in the lower plane.  planes: z of the body's lower and upper plane in the
    lens's frame (mm).  Raises ValueError if a plane cuts a rim, or the body misses the wall.
    """
    lower, upper = planes
    high, low = rim_heights(lens, rim)
    below = lens.front.around
    flat = below.sags(lens.outline) == (0.0, 0.0) and abs(lower - below.z) < WALL_TOLERANCE
    for side, z, face, heights in (("upper", upper, BACK, high), ("lower", lower, FRONT, low)):
        cuts = np.abs(z - heights).min() < MIN_WALL or heights.min() <= z <= heights.max()
        if cuts and not (flat and face == FRONT):
            raise ValueError(
                f"{name}: the flange's {side} face, z = {z:g} mm, cuts the rim of the {face}, which runs from z = "
                f"{heights.min():.4g} to {heights.max():.4g} mm in the lens's frame; move it below or above this range"
                + (", or into the plane of a plane front" if face == FRONT else "")
            )
    if (np.minimum(upper, high) - np.maximum(lower, low)).min() < MIN_WALL:
        raise ValueError(
            f"{name}: the flange, from z = {lower:g} to {upper:g} mm, misses the lens's wall, from z = {low.max():.4g} "
            f"to {high.min():.4g} mm in the lens's frame; move the flange to this height"
        )
    return bool(upper > high.max()), None if flat else bool(lower < low.min())


def _replace_loops(face: cadquery.Face, replacements: dict[int, list[Loop]] | None) -> TopoDS_Face:
    """Return a plane face of the body with some wires replaced; replacements: loops by index of the wire, or None."""
    if replacements is None:
        return face.wrapped
    loops: list[Loop] = []
    for k, wire in enumerate(face.Wires()):
        own = [(edge.wrapped, _is_forward(edge.wrapped)) for edge in wire.Edges()]
        forward = TopAbs_Orientation.TopAbs_FORWARD
        loops += replacements.get(k, [[(TopoDS.Edge_s(edge.Oriented(forward)), along) for edge, along in own]])
    return face_inside(BRep_Tool.Surface_s(face.wrapped), _is_forward(face.wrapped), *loops)


def _is_forward(shape: TopoDS_Shape) -> bool:
    return shape.Orientation() == TopAbs_Orientation.TopAbs_FORWARD


# ---- the [mount] of a scene ----------------------------------------------------------------------------------------


def part_of(lens: Lens, mount: Mount) -> NamedSolid:
    """Return the part in the frame of the mount's datum, with names of faces; ValueError if the lens does not fit."""
    trim, draft = None if mount.rim is None else wire(mount.rim), Draft(mount.draft, mount.bevel)
    try:
        if mount.flange is None:
            found = named_solid(lens, trim, draft=draft)
        else:
            found = mounted(body(mount.flange), [PlacedLens(lens, trim, draft=draft)])
    except (Standard_Failure, StdFail_NotDone) as error:
        raise ValueError(
            f"mount: OpenCASCADE cannot build the part ({type(error).__name__}); reduce or omit bevel and draft"
        ) from error
    return found._replace(solid=found.solid.translate((0, 0, -mount.origin(lens.front_vertex))))


def wire(outline: CircleRim | Box) -> cadquery.Wire:
    """Return an outline as a wire in the plane z = 0."""
    import cadquery

    plane: Any = cadquery.Workplane("XY")  # its methods are annotated with every class that they may return
    if outline.shape == "circle":
        return plane.circle(outline.diameter / 2).wires().val()
    sharp = plane.rect(outline.width, outline.height).wires().val()
    return sharp.fillet2D(outline.corner_radius, sharp.Vertices()) if outline.corner_radius else sharp


def body(flange: Flange) -> cadquery.Workplane:
    """Return the flange without an opening for the lens, in the scene's frame."""
    import cadquery

    lean, height = math.tan(math.radians(flange.draft)), flange.thickness
    if flange.outline.shape == "circle" and lean:  # OCC cannot chamfer a circle that it has tapered
        radius, base = flange.outline.diameter / 2, cadquery.Vector(0, 0, flange.z)
        plate = cadquery.Workplane(cadquery.Solid.makeCone(radius, radius - lean * height, height, base))
    else:
        rim = cadquery.Workplane("XY").add(wire(flange.outline).translate((0, 0, flange.z)))
        plate = rim.toPending().extrude(height, taper=flange.draft or None)
    if flange.bevel:
        plate = cadquery.Workplane(_bevelled(shape_in(plate)[0], flange.bevel, lean))
    for x, y, diameter in flange.all_holes():
        base = cadquery.Vector(x, y, flange.z - 1)
        plate = plate.cut(cadquery.Solid.makeCylinder(diameter / 2, height + 2, base))
    return plate


def _bevelled(plate: cadquery.Solid, bevel: float, lean: float) -> cadquery.Solid:
    """Return a plate bevelled at 45 degrees; bevel: height along z (mm); lean: inward slope of its walls, mm per mm.

    Workplane.chamfer is not used, because it does not define which of its two lengths belongs to which face.
    """
    import cadquery

    chamfer, wall = BRepFilletAPI_MakeChamfer(plate.wrapped), bevel * math.hypot(1.0, lean)
    for side, across in (("<Z", bevel * (1 + lean)), (">Z", bevel * (1 - lean))):
        face = plate.faces(side)
        for edge in face.Edges():
            chamfer.Add(across, wall, edge.wrapped, face.wrapped)
    return cadquery.Solid(chamfer.Shape())


def write_if_it_fits(lens: Lens, mount: Mount, path: str | Path, name: str, facts: Part) -> None:
    """Write part.step with `facts`, the data of [part]; write nothing if the part cannot be built (see `part_of`)."""
    try:
        part = part_of(lens, mount)
    except ValueError:
        return
    properties = solid_properties.of_solid(part.solid)
    step_writing.write(part.solid, path, name, facts, faces=part.faces, properties=properties)
