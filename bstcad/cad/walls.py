"""Walls around a lens, between rails: closed sequences of edges along which walls meet optical faces or each other.

An upright wall is a plane, a cylinder or the extrusion of a cubic.  A wall with draft, or a bevel, is a plane, a cone
or a ruled surface.  Each edge is built once for the two faces that meet in it.  In space and in the parameter planes,
an edge has the parameter of its piece of the rim: length on a level line, angle on an arc, u or v on a net's boundary.

Walls with draft begin on a parting line, the rim at one height, and lean inwards down to the front.  If the rim shrinks
by an offset o, its point p moves to p + o m, where m is the inward normal; on a straight side m is linear between the
mitres at its two corners.  Of the front, only height and slope are needed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from OCP.BRep import BRep_Builder
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge, BRepBuilderAPI_MakeVertex
from OCP.BRepCheck import BRepCheck_Analyzer
from OCP.Geom import (
    Geom_Circle,
    Geom_ConicalSurface,
    Geom_CylindricalSurface,
    Geom_Plane,
    Geom_Surface,
    Geom_SurfaceOfLinearExtrusion,
)
from OCP.Geom2d import Geom2d_BSplineCurve
from OCP.gp import gp_Ax2, gp_Ax3, gp_Dir, gp_Pnt
from OCP.TopoDS import TopoDS, TopoDS_Edge, TopoDS_Face, TopoDS_Shell, TopoDS_Solid, TopoDS_Vertex, TopoDS_Wire
from scipy.interpolate import BSpline

from bstcad.cad import patches, wires
from bstcad.cad.wires import LoopPiece, RailCurve
from bstcad.optics.surfaces.bspline import DEGREE, BSplineSurface, is_net, knots
from bstcad.optics.surfaces.surfaces import Plane, Surface, sag, sampled
from bstcad.scene.mount import MAX_DRAFT, MIN_CLOSING

SHAPE_TOLERANCE = 1e-7  # tolerance (mm) of every face, edge and vertex
RIM_TOLERANCE = 1e-8  # largest deviation (mm) of an edge from the exact curve
MIN_WALL = 1e-3  # smallest height of a wall (mm)
SMOOTH_TURN = 1e-7  # angle (rad) between successive pieces below which they join smoothly
MIN_CORNER = 0.05  # smallest 1 + cos of the exterior angle at a corner; a mitre is then at most 6.3 times the offset
MAX_NEWTON_STEPS, NEWTON_TOLERANCE = 50, 1e-13  # largest number of steps; largest last step / (1 mm + |z|)
WALL_SAMPLES = 129  # number of points along a piece at which its wall is checked

NamedFace = tuple[TopoDS_Face, str]  # face and its name, as in solid.NamedSolid
Loop = list[tuple[TopoDS_Edge, bool]]  # edges, each with True if used forwards


# ---- faces and solids ----------------------------------------------------------------------------------------------


def face_inside(surface: Geom_Surface, outward: bool, *loops: Loop) -> TopoDS_Face:
    """Return the face inside the first loop (counterclockwise seen from outside) and outside the others (clockwise).

    outward: True if the normal of `surface`, ∂u x ∂v, points out of the solid.
    """
    builder, face = BRep_Builder(), TopoDS_Face()
    builder.MakeFace(face, surface, SHAPE_TOLERANCE)
    for loop in loops:
        wire = TopoDS_Wire()
        builder.MakeWire(wire)
        for edge, forward in loop:
            builder.Add(wire, edge if forward else edge.Reversed())
        wire.Closed(True)
        builder.Add(face, wire if outward else wire.Reversed())
    return face if outward else TopoDS.Face_s(face.Reversed())


def solid_of(built: Sequence[TopoDS_Face], fault: str) -> TopoDS_Solid:
    """Return the solid bounded by faces with shared edges and outward normals; ValueError(fault) if it is not valid."""
    builder, shell, solid = BRep_Builder(), TopoDS_Shell(), TopoDS_Solid()
    builder.MakeShell(shell)
    for face in built:
        builder.Add(shell, face)
    shell.Closed(True)
    builder.MakeSolid(solid)
    builder.Add(solid, shell)
    if not BRepCheck_Analyzer(solid).IsValid():
        raise ValueError(fault)
    return solid


def _straight(start: TopoDS_Vertex, end: TopoDS_Vertex) -> TopoDS_Edge:
    """Return the straight edge between two vertices; its parameter is the length from the first (mm)."""
    return BRepBuilderAPI_MakeEdge(start, end).Edge()


# ---- rails ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rail:
    """A closed sequence of edges, one above or below each piece of a loop."""

    curves: tuple[RailCurve, ...]
    edges: tuple[TopoDS_Edge, ...]
    corners: tuple[TopoDS_Vertex, ...]  # vertices over the starts of the pieces

    @classmethod
    def of(cls, curves: Sequence[RailCurve]) -> Rail:
        """Return the rail along successive curves."""
        corners = tuple(BRepBuilderAPI_MakeVertex(gp_Pnt(*curve.poles[0].tolist())).Vertex() for curve in curves)
        ends = corners[1:] + corners[:1]
        edges = tuple(_edge(*each) for each in zip(curves, corners, ends, strict=True))
        return cls(tuple(curves), edges, corners)

    def along(self) -> Loop:
        """Return the edges as a loop in the direction of the pieces."""
        return [(edge, True) for edge in self.edges]

    def against(self) -> Loop:
        """Return the edges as a loop against the direction of the pieces."""
        return [(edge, False) for edge in reversed(self.edges)]


def _edge(curve: RailCurve, start: TopoDS_Vertex, end: TopoDS_Vertex) -> TopoDS_Edge:
    piece = curve.piece
    if curve.knots is not None:
        spline = patches.bspline_curve(curve.poles, curve.knots)
        return BRepBuilderAPI_MakeEdge(spline, start, end, 0.0, piece.end).Edge()
    if piece.straight:
        return _straight(start, end)
    assert piece.centre is not None  # without knots it is a line or an arc
    (x, y, z), (x0, y0) = curve.poles[0].tolist(), piece.centre
    axes = gp_Ax2(gp_Pnt(x0, y0, z), gp_Dir(0, 0, piece.turn), gp_Dir(x - x0, y - y0, 0))
    return BRepBuilderAPI_MakeEdge(Geom_Circle(axes, math.hypot(x - x0, y - y0)), start, end, 0.0, piece.end).Edge()


def rail_on(surface: Surface, loop: Sequence[LoopPiece]) -> Rail:
    """Return the rail in which upright walls over a loop meet a surface."""
    return Rail.of([_curve_on(surface, piece) for piece in loop])


def _curve_on(surface: Surface, piece: LoopPiece) -> RailCurve:
    """Return the curve over a piece on a surface: exact (a line, an arc, the border of a net) or a spline."""
    if piece.rim is not None:
        return piece.rim.curve_on(piece, surface)

    def points(t: np.ndarray) -> np.ndarray:
        x, y = piece.points(t).T
        return np.column_stack([x, y, sag(surface, x, y)])

    if _is_level_on(surface, piece):
        return RailCurve(piece, points(np.array([0.0, piece.end])))
    if is_net(surface) and piece.straight and (border := _border(surface, piece)) is not None:
        return border
    smooth = not surface.is_net and piece.is_line_or_arc
    return RailCurve(piece, *wires.fit_spline(points, wires.breaks(surface, piece), RIM_TOLERANCE, smooth))


def _border(net: BSplineSurface, piece: LoopPiece) -> RailCurve | None:
    """Return the boundary of a net, with the net's knots, if it coincides with a straight piece; otherwise None."""
    poles = net.control_points()
    sides = [side[::step] for side in (poles[0], poles[-1], poles[:, 0], poles[:, -1]) for step in (1, -1)]
    ends = piece.points(np.array([0.0, piece.end]))
    side = next((side for side in sides if np.abs(side[[0, -1], :2] - ends).max() <= RIM_TOLERANCE), None)
    if side is None:
        return None
    full = knots(len(side))
    along = BSpline(full, side[:, :2], DEGREE)
    return RailCurve(replace(piece, points=along, end=float(full[-1])), side, full)


def _is_level_on(surface: Surface, piece: LoopPiece) -> bool:
    """True if the edge over a piece on a surface has one height: on a level plane, or on a circle about the axis."""
    if piece.centre is not None and not surface.is_net and math.hypot(*piece.centre) < SHAPE_TOLERANCE:
        return True
    return surface.level and piece.is_line_or_arc


# ---- the surfaces of walls -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WallSurface:
    """The OCC surface of a wall."""

    surface: Geom_Surface
    out: bool  # True if its normal points out of the lens
    # linear map (t, z, fraction of the height from the lower edge) -> (u, v), (n, 2); None: a plane, without (u, v)
    image: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None

    def curve(self, poles: tuple[np.ndarray, np.ndarray, np.ndarray], knots: np.ndarray) -> Geom2d_BSplineCurve | None:
        """Return the image in (u, v) of the curve with poles (t, z, fraction of the height); None on a plane."""
        return None if self.image is None else patches.bspline_curve_2d(self.image(*poles), knots)

    def along(self, curve: RailCurve, up: float) -> Geom2d_BSplineCurve | None:
        """Return the image in (u, v) of the lower edge (up 0) or the upper edge (up 1); None on a plane."""
        end = curve.piece.end
        if curve.knots is None:
            knots, t = np.array([0.0, 0.0, end, end]), np.array([0.0, end])
        else:  # Greville abscissae: means of as many knots as the degree
            knots = curve.knots
            t = sliding_window_view(knots[1:-1], len(knots) - len(curve.poles) - 1).mean(axis=1)
        return self.curve((t, curve.poles[:, 2], np.full(len(t), up)), knots)


def _upright_surface(piece: LoopPiece) -> WallSurface:
    if piece.is_line_or_arc:
        return _plane_or_cone(piece, (*piece.at(0.0), 0.0), 0.0)
    curve = _curve_on(Plane(0.0), piece)
    assert curve.knots is not None  # a freeform piece has a spline
    base = patches.bspline_curve(curve.poles, curve.knots)
    surface = Geom_SurfaceOfLinearExtrusion(base, gp_Dir(0, 0, 1))
    return WallSurface(surface, True, lambda t, z, _: np.stack([t, z], axis=-1))


def _plane_or_cone(piece: LoopPiece, start: Sequence[float], tangent: float) -> WallSurface:
    """Return the plane, cylinder or cone over a line or arc, through a point above its start; tangent: see `Draft`."""
    x, y, z = map(float, start)
    angle, turn = math.atan(tangent), piece.turn
    if piece.straight:
        u, v = (-piece.left(np.zeros(1))[0]).tolist()
        normal = gp_Dir(u * math.cos(angle), v * math.cos(angle), -math.sin(angle))
        return WallSurface(Geom_Plane(gp_Ax3(gp_Pnt(x, y, z), normal)), True, None)
    assert piece.centre is not None  # an arc
    x0, y0 = piece.centre
    frame, radius = gp_Ax3(gp_Pnt(x0, y0, z), gp_Dir(0, 0, turn), gp_Dir(x - x0, y - y0, 0)), math.hypot(x - x0, y - y0)
    surface = Geom_ConicalSurface(frame, angle, radius) if tangent else Geom_CylindricalSurface(frame, radius)

    def image(t: np.ndarray, heights: np.ndarray, _: np.ndarray) -> np.ndarray:
        return np.stack([t, turn * (heights - z) / math.cos(angle)], axis=-1)

    return WallSurface(surface, turn > 0, image)


def _drafted_surface(piece: LoopPiece, low: RailCurve, high: RailCurve, tangent: float) -> WallSurface:
    if not tangent:
        return _upright_surface(piece)
    return _plane_or_cone(piece, high.poles[0], tangent) if piece.is_line_or_arc else _ruled_surface(low, high)


def _ruled_surface(low: RailCurve, high: RailCurve) -> WallSurface:
    """Return the ruled surface between two cubics with equal knots."""
    assert low.knots is not None
    net, ends = np.stack([low.poles, high.poles], axis=1), np.array([0.0, 0.0, 1.0, 1.0])
    return WallSurface(patches.bspline_surface(net, low.knots, ends), True, lambda t, _, up: np.stack([t, up], axis=-1))


def _faces_between(surfaces: Sequence[WallSurface], low: Rail, high: Rail, outward: bool = True) -> list[TopoDS_Face]:
    """Return the walls with these surfaces from one rail up to another; outward: normals point away from the lens."""
    builder, walls = BRep_Builder(), []
    rising = [_straight(start, end) for start, end in zip(low.corners, high.corners, strict=True)]
    for k, own in enumerate(surfaces):
        after, curves = (k + 1) % len(surfaces), (low.curves[k], high.curves[k])
        loop = [(low.edges[k], True), (rising[after], True), (high.edges[k], False), (rising[k], False)]
        if not outward:
            loop = [(edge, not forward) for edge, forward in reversed(loop)]
        wall = face_inside(own.surface, own.out == outward, loop)
        images = [(low.edges[k], own.along(curves[0], 0.0)), (high.edges[k], own.along(curves[1], 1.0))]
        for edge, end, t in ((rising[k], 0, 0.0), (rising[after], -1, curves[0].piece.end)):
            ends = np.array([curve.poles[end] for curve in curves])
            length = math.dist(*ends)
            poles = np.array([t, t]), ends[:, 2], np.array([0.0, 1.0])
            images.append((edge, own.curve(poles, np.array([0.0, 0.0, length, length]))))
        for edge, image in images:
            if image is not None:
                builder.UpdateEdge(edge, image, wall, SHAPE_TOLERANCE)
        walls.append(wall)
    return walls


def upright_walls(
    loop: Sequence[LoopPiece], low: Rail, high: Rail, name: str = "rim", outward: bool = True
) -> list[NamedFace]:
    """Return the upright walls over a loop between two rails, each called `name`; outward: see `_faces_between`."""
    return [(wall, name) for wall in _faces_between([_upright_surface(piece) for piece in loop], low, high, outward)]


# ---- draft and bevel -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Draft:
    """Draft and bevel of the walls of a lens between parting line and front; if both are 0, walls are parallel to z."""

    angle: float = 0.0  # inward angle of the walls (degrees)
    bevel: float = 0.0  # height along z (mm) of a bevel of 45 degrees between walls and front

    def __post_init__(self) -> None:
        if not 0 <= self.angle <= MAX_DRAFT:
            raise ValueError(
                f"draft: {self.angle:g} degrees is not between 0 and {MAX_DRAFT:g}; choose an angle in this range"
            )
        if not 0 <= self.bevel < math.inf:
            raise ValueError(f"bevel: {self.bevel:g} mm is negative or not finite; give 0 or more")

    def __bool__(self) -> bool:
        return self.angle > 0 or self.bevel > 0

    @property
    def tangent(self) -> float:
        """Tangent of the angle: inward slope of the walls, mm per mm."""
        return math.tan(math.radians(self.angle))

    @property
    def name(self) -> str:
        """Subject of a message: "draft", "bevel" or "draft and bevel"."""
        return " and ".join(name for name, size in (("draft", self.angle), ("bevel", self.bevel)) if size)


NO_DRAFT = Draft()


@dataclass(frozen=True)
class LeaningPiece:
    """A piece of the rim and the leaning wall below it."""

    front: Surface  # surface on which the wall ends
    piece: LoopPiece
    mitres: tuple[np.ndarray, np.ndarray]  # mitres m at the two ends of the piece, each (2,)
    z: float  # height of the parting line (mm)
    draft: Draft

    def inwards(self, t: np.ndarray) -> np.ndarray:
        """Return the shift m (n, 2) of the rim's points at t (n,) per unit offset inwards."""
        if not self.piece.straight:
            return self.piece.left(t)
        start, end = self.mitres
        return start + (t / self.piece.end)[:, None] * (end - start)

    def ends(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points (n, 3), mm, on the lower edges of wall and bevel; without a bevel, both lie on the front."""
        start, m, tangent = self.piece.points(t), self.inwards(t), self.draft.tangent
        depth = self._depth(start, m, tangent, np.full(len(t), self.z)) - self.draft.bevel
        upper = np.column_stack([start + tangent * depth[:, None] * m, self.z - depth])
        if not self.draft.bevel:
            return upper, upper
        depth = self._depth(upper[:, :2], m, 1.0, upper[:, 2])
        return upper, np.column_stack([upper[:, :2] + depth[:, None] * m, upper[:, 2] - depth])

    def _depth(self, start: np.ndarray, inwards: np.ndarray, tangent: float, z: np.ndarray) -> np.ndarray:
        """Return depths (n,) below z (mm) where lines from `start`, `tangent` mm `inwards` per mm, meet the front."""
        depth, smallest = np.zeros(len(start)), np.ones(len(start))
        for _ in range(MAX_NEWTON_STEPS):
            height, *slopes = sampled(self.front, *(start + tangent * depth[:, None] * inwards).T)
            closing = 1 + tangent * (np.stack(slopes, axis=1) * inwards).sum(axis=1)  # -d(gap)/d(depth), mm per mm
            smallest = np.minimum(smallest, closing)
            step = (z - depth - height) / np.maximum(closing, MIN_CLOSING)
            depth = depth + step
            if np.abs(step).max() <= NEWTON_TOLERANCE * (1 + np.abs(z).max()):
                break
        worst = int(smallest.argmin())
        if not smallest[worst] > MIN_CLOSING or not np.abs(step).max() <= SHAPE_TOLERANCE:
            name, angle = ("bevel", 45.0) if tangent == 1 else ("draft", self.draft.angle)
            raise ValueError(
                "{0}: at ({1:.4g}, {2:.4g}) mm the front is too steep for a wall that leans by {3:g} degrees to meet "
                "it; reduce the {0}".format(name, *start[worst], angle)
            )
        return depth

    def lower_edge(self) -> LoopPiece:
        """Return x and y of the edge in which the wall, or its bevel if there is one, meets the front."""
        straight = self.piece.straight and _is_level_on(self.front, self.piece)
        return replace(self.piece, points=lambda t: self.ends(t)[1][:, :2], straight=straight)  # `left` is unused

    def curves(self) -> list[RailCurve]:
        """Return the parting line and the lower edges of wall and bevel: lines, arcs, or cubics with equal knots."""

        def points(t: np.ndarray) -> np.ndarray:
            return np.hstack([self.piece.points(t), np.full((len(t), 1), self.z), *self.ends(t)])

        edge, knots = self.lower_edge(), None
        if _is_level_on(self.front, self.piece):
            poles = points(np.array([0.0, self.piece.end]))
        else:
            sharp = replace(self, draft=Draft(self.draft.angle)).lower_edge()
            poles, knots = wires.fit_spline(points, wires.breaks(self.front, edge, sharp), RIM_TOLERANCE)
        return [RailCurve(edge, part, knots) for part in np.split(poles, 3, axis=1)]


def leaning_walls(
    front: Surface, loops: Sequence[Sequence[LoopPiece]], high: Rail, above: Surface, draft: Draft
) -> tuple[list[NamedFace], Rail]:
    """Return the walls over the rim, the first loop, from a rail down to the front, and their lower rail there.

    high: upper rail of the walls, on the surface `above`, which is level if the walls have draft.  The other loops are
    holes, which must lie inside the lower rail.  Raises ValueError if walls do not reach the front or meet above it.
    """
    rim = loops[0]
    if not draft:
        low = rail_on(front, rim)
        return upright_walls(rim, low, high), low
    pieces = _leaning_pieces(rim, front, float(high.curves[0].poles[0, 2]), draft)
    _check(pieces, loops[1:], above)
    parting, upper, lower = zip(*(each.curves() for each in pieces), strict=True)
    low = Rail.of(lower)
    edge = Rail.of(upper) if draft.bevel else low
    surfaces = [_drafted_surface(*each, tangent=draft.tangent) for each in zip(rim, upper, parting, strict=True)]
    named = [(wall, "rim") for wall in _faces_between(surfaces, edge, high)]
    if draft.bevel:
        surfaces = [
            _plane_or_cone(piece, start.poles[0], 1.0) if start.knots is None else _ruled_surface(end, start)
            for piece, end, start in zip(rim, lower, upper, strict=True)
        ]
        named += [(wall, "bevel") for wall in _faces_between(surfaces, low, edge)]
    return named, low


def _leaning_pieces(rim: Sequence[LoopPiece], front: Surface, z: float, draft: Draft) -> list[LeaningPiece]:
    """Return the pieces of the rim with their mitres, for walls below z (mm); ValueError if a corner has no mitre."""
    starts = [piece.left(np.zeros(1))[0] for piece in rim]
    ends = [piece.left(np.array([piece.end]))[0] for piece in rim]
    for k, (piece, before, after) in enumerate(zip(rim, ends[-1:] + ends[:-1], tuple(starts), strict=True)):
        if math.dist(before, after) <= SMOOTH_TURN:
            continue
        if not (rim[k - 1].straight and piece.straight and 1 + before @ after > MIN_CORNER):
            raise ValueError(
                "{}: at ({:.4g}, {:.4g}) mm the rim has a corner that is too sharp, or not between straight sides, so "
                "that walls cannot lean there; round the corner".format(draft.name, *piece.at(0.0))
            )
        starts[k] = ends[k - 1] = (before + after) / (1 + before @ after)
    mitres = zip(starts, ends, strict=True)
    return [LeaningPiece(front, *each, z=z, draft=draft) for each in zip(rim, mitres, strict=True)]


def _check(pieces: Sequence[LeaningPiece], holes: Sequence[Sequence[LoopPiece]], above: Surface) -> None:
    """Raise ValueError unless walls end below the surface `above`, and cross neither each other nor the holes."""
    name = pieces[0].draft.name
    for each in pieces:
        t = np.linspace(0.0, each.piece.end, WALL_SAMPLES)
        rim = each.piece.points(t)
        upper, lower = each.ends(t)
        top = sag(above, *rim.T)
        worst = int((top - upper[:, 2]).argmin())
        if not top[worst] - upper[worst, 2] > MIN_WALL:
            raise ValueError(
                "{0}: at ({1:.4g}, {2:.4g}) mm no wall is left between z = {3:.4g} mm, where it begins, and the "
                "front's edge at {4:.4g} mm; reduce the {0}, or make the lens thicker at its edge".format(
                    name, *rim[worst], top[worst], lower[worst, 2]
                )
            )
        along, on_front = np.diff(rim, axis=0), np.diff(lower[:, :2], axis=0)
        onwards = (on_front * along).sum(axis=1) / (along * along).sum(axis=1)
        if not onwards.min() > SMOOTH_TURN:
            position = "({:.4g}, {:.4g}) mm".format(*rim[onwards.argmin()])
            raise ValueError(f"{name}: at {position} the walls meet before they reach the front; reduce the {name}")
    edge = [each.lower_edge() for each in pieces]
    if fault := wires.fault(wires.polygon(edge)):
        raise ValueError(f"{name}: at {fault[1]} the walls meet before they reach the front; reduce the {name}")
    if fault := wires.fault(wires.polygon(edge, *holes)):
        raise ValueError(f"{name}: near {fault[1]} a hole crosses the walls where they lean inwards; move the hole")
