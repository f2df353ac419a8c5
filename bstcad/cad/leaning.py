"""Walls that lean, as faces: the draft of a lens's walls, and a bevel between them and the front.

The wall on a straight side is a plane and on an arc a cone, which lean by the draft everywhere; what stands on another
curve is ruled, of the same lean.  A bevel is a plane or a cone where its edges are level, and ruled where they are not.
Each edge is built once, for the faces on both its sides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from OCP.BRep import BRep_Builder
from OCP.BRepAdaptor import BRepAdaptor_Curve
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge
from OCP.Geom import Geom_Circle, Geom_ConicalSurface, Geom_Plane, Geom_Surface
from OCP.Geom2d import Geom2d_Curve, Geom2d_Line
from OCP.gp import gp_Ax2, gp_Ax3, gp_Dir, gp_Dir2d, gp_Pnt, gp_Pnt2d
from OCP.TopoDS import TopoDS_Edge, TopoDS_Face, TopoDS_Vertex

from bstcad.cad import nurbs
from bstcad.cad.draft import Ceiling, Course, Lean, Trace, check, left, of_ring
from bstcad.cad.fitting import hermite
from bstcad.cad.loops import Piece
from bstcad.cad.solid import TOLERANCE, face_inside, straight, vertex
from bstcad.cad.walls import Rail, Ring, between
from bstcad.optics.surfaces import Surface


@dataclass(frozen=True)
class Foot:
    """The leaning walls around a lens, and the edge in which they end on its front."""

    walls: list[tuple[TopoDS_Face, str]]  # and their names, "rim" or "bevel"
    ring: Ring  # the edge as seen along z; nothing stands on it
    rail: Rail


def foot(surface: Surface, rings: Sequence[Ring], high: Rail, ceiling: Ceiling, lean: Lean) -> Foot:
    """The walls over the first ring, from a rail down to the front; the others are holes, which the front must hold.

    high: where they begin; level if they are to lean.  ceiling: below which they have to end.
    ValueError, in one sentence, where they do not come down to the front or meet before.
    """
    ring = rings[0]
    found = of_ring(ring, surface, high.heights[0], lean)
    check(found, rings[1:], ceiling)
    traces = [course.traced() for course in found]
    lower = _run(found, [trace.lower for trace in traces], traces)
    upper = _run(found, [trace.upper for trace in traces], traces) if lean.bevel else lower
    if lean.draft:
        top = _Run(tuple(map(_level_line, found, high.edges)), high.corners)
        sheets = [_drafted(*each) for each in zip(found, traces, strict=True)]
        walls = _between(sheets, upper, top)
    else:
        walls = between(ring, _standing(ring, upper), high)
    named = [(wall, "rim") for wall in walls]
    if lean.bevel:
        sheets = [_bevelled(*each) for each in zip(found, traces, strict=True)]
        named += [(wall, "bevel") for wall in _between(sheets, lower, upper)]
    edges = tuple(line.edge for line in lower.lines)
    rail = Rail(edges, lower.corners, lower.heights, (None,) * len(edges), tuple(trace.breaks for trace in traces))
    return Foot(named, Ring(tuple(course.path() for course in found), ()), rail)


@dataclass(frozen=True)
class _Line:
    """An edge along one piece, by the piece's t from `first` on."""

    edge: TopoDS_Edge
    t: np.ndarray  # (n,) of its poles; of an edge that is level, both its ends
    z: np.ndarray  # (n,) mm
    full: np.ndarray | None  # knots; None: it is level
    first: float = 0.0


@dataclass(frozen=True)
class _Run:
    """Such edges once around, from the vertices over the pieces' starts."""

    lines: tuple[_Line, ...]
    corners: tuple[TopoDS_Vertex, ...]
    heights: tuple[float, ...] = ()  # z of the corners (mm)


@dataclass(frozen=True)
class _Sheet:
    """A surface that a wall lies on."""

    surface: Geom_Surface
    out: bool  # does its normal point out of the lens?
    image: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None
    # (t, z, 0 at the lower edge to 1 at the upper) -> (n, 2) in its own plane, all linear; None: a plane needs none

    def of(self, line: _Line, up: float) -> Geom2d_Curve | None:
        """The image of its lower edge or of its upper one."""
        if self.image is None:
            return None
        poles = self.image(line.t, line.z, np.full(len(line.t), up))
        if line.full is not None:
            return nurbs.bspline_curve_2d(poles, line.full)
        along = (poles[1] - poles[0]) / (line.t[1] - line.t[0])
        return Geom2d_Line(gp_Pnt2d(*(poles[0] - line.first * along).tolist()), gp_Dir2d(*along.tolist()))

    def rising(self, t: float, low: float, high: float, length: float) -> Geom2d_Curve | None:
        """The image of the edge from below up to a corner, by its length (mm)."""
        if self.image is None:
            return None
        poles = self.image(np.full(2, t), np.array([low, high]), np.array([0.0, 1.0]))
        return nurbs.bspline_curve_2d(poles, np.array([0.0, 0.0, length, length]))


def _drafted(course: Course, trace: Trace) -> _Sheet:
    """What the wall below the parting line lies on."""
    if course.piece.straight or course.piece.centre is not None:
        return _leaning(course.piece, trace.parting[0], course.lean.tangent)
    return _ruled(trace.full, trace.upper, trace.parting)


def _bevelled(course: Course, trace: Trace) -> _Sheet:
    """What the bevel lies on."""
    if course.level:
        return _leaning(course.piece, trace.upper[0], 1.0)
    return _ruled(trace.full, trace.lower, trace.upper)


def _leaning(piece: Piece, place: np.ndarray, tangent: float) -> _Sheet:
    """The plane or the cone through a place (3,) over the piece's start."""
    x, y, z = place.tolist()
    angle, turn = math.atan(tangent), piece.turn
    if piece.straight:
        u, v = (-left(piece.points(np.zeros(1))[1])[0]).tolist()
        normal = gp_Dir(u * math.cos(angle), v * math.cos(angle), -math.sin(angle))
        return _Sheet(Geom_Plane(gp_Ax3(gp_Pnt(x, y, z), normal)), True, None)
    x0, y0 = piece.centre
    frame = gp_Ax3(gp_Pnt(x0, y0, z), gp_Dir(0, 0, turn), gp_Dir(x - x0, y - y0, 0))
    cone = Geom_ConicalSurface(frame, angle, math.hypot(x - x0, y - y0))

    def image(t: np.ndarray, heights: np.ndarray, _: np.ndarray) -> np.ndarray:
        return np.stack([t, turn * (heights - z) / math.cos(angle)], axis=-1)

    return _Sheet(cone, turn > 0, image)


def _ruled(full: np.ndarray, low: np.ndarray, high: np.ndarray) -> _Sheet:
    """The surface of straight lines between two curves."""
    surface = nurbs.bspline_surface(np.stack([low, high], axis=1), full, np.array([0.0, 0.0, 1.0, 1.0]))
    return _Sheet(surface, True, lambda t, _, up: np.stack([t, up], axis=-1))


def _run(courses: Sequence[Course], poles: Sequence[np.ndarray], traces: Sequence[Trace]) -> _Run:
    """The edges along curves of these poles."""
    corners = tuple(vertex(*each[0]) for each in poles)
    around = zip(courses, poles, traces, corners, corners[1:] + corners[:1], strict=True)
    return _Run(tuple(_line(*each) for each in around), corners, tuple(float(each[0, 2]) for each in poles))


def _line(course: Course, poles: np.ndarray, trace: Trace, start: TopoDS_Vertex, end: TopoDS_Vertex) -> _Line:
    piece = course.piece
    if not course.level:
        edge = BRepBuilderAPI_MakeEdge(nurbs.bspline_curve(poles, trace.full), start, end, 0.0, piece.end).Edge()
        at = hermite(trace.breaks, trace.breaks[:, None], np.ones((len(trace.breaks), 1)))[0][:, 0]
        return _Line(edge, at, poles[:, 2], trace.full)
    x, y, z = poles[0].tolist()
    ends = np.array([0.0, piece.end]), np.array([z, z])
    if piece.straight:
        return _Line(straight(start, end), *ends, None)
    x0, y0 = piece.centre
    axes = gp_Ax2(gp_Pnt(x0, y0, z), gp_Dir(0, 0, piece.turn), gp_Dir(x - x0, y - y0, 0))
    circle = Geom_Circle(axes, math.hypot(x - x0, y - y0))
    return _Line(BRepBuilderAPI_MakeEdge(circle, start, end, 0.0, piece.end).Edge(), *ends, None)


def _level_line(course: Course, edge: TopoDS_Edge) -> _Line:
    """An edge of the parting line."""
    first = BRepAdaptor_Curve(edge).FirstParameter()
    return _Line(edge, np.array([0.0, course.piece.end]), np.full(2, course.z), None, first)


def _standing(ring: Ring, run: _Run) -> Rail:
    """A run as a rail of walls along z."""
    images = []
    for piece, (surface, out), line in zip(ring.pieces, ring.surfaces, run.lines, strict=True):
        sheet = _Sheet(surface, out, lambda t, z, _, piece=piece: np.stack([piece.along(t), z], axis=-1))
        images.append(None if piece.straight else sheet.of(line, 0.0))
    return Rail(tuple(line.edge for line in run.lines), run.corners, run.heights, tuple(images))


def _between(sheets: Sequence[_Sheet], low: _Run, high: _Run) -> list[TopoDS_Face]:
    """The walls from one run up to another, looking away from the lens."""
    builder, walls, count = BRep_Builder(), [], len(sheets)
    rising = [straight(start, end) for start, end in zip(low.corners, high.corners, strict=True)]
    for k, (sheet, below, above) in enumerate(zip(sheets, low.lines, high.lines, strict=True)):
        after = (k + 1) % count
        loop = [(below.edge, True), (rising[after], True), (above.edge, False), (rising[k], False)]
        wall = face_inside(sheet.surface, sheet.out, loop)
        sides = [(rising[k], 0), (rising[after], -1)]
        images = [(below.edge, sheet.of(below, 0.0)), (above.edge, sheet.of(above, 1.0))]
        for edge, end in sides:
            length = BRepAdaptor_Curve(edge).LastParameter()
            images.append((edge, sheet.rising(float(below.t[end]), float(below.z[end]), float(above.z[end]), length)))
        for edge, image in images:
            if image is not None:
                builder.UpdateEdge(edge, image, wall, TOLERANCE)
        walls.append(wall)
    return walls
