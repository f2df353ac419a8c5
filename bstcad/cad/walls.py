"""Walls around a lens, between rails: closed runs of edges in which they meet the optical faces or each other.

An upright wall is a plane, a cylinder or the extrusion of a cubic; a wall with draft a plane, a cone or ruled, and so
is a bevel.  Each edge is built once, for the faces on both its sides, and has the parameter of its piece of the rim
(level lines: their length; the border of a net: its knots), in space and in the parameter planes of these faces.

Walls with draft begin on a parting line, the rim itself at one height, and lean inwards as they go down to the front.
Where the rim has shrunk evenly by o, its point p has moved to p + o m, m the inward normal; on a straight side m
changes evenly between the mitres of its two corners.  Of the front only height and slope are needed.
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
from bstcad.cad.wires import Curve, Piece
from bstcad.optics.bspline import DEGREE, BSplineSurface, knots
from bstcad.optics.surfaces import Plane, Surface, sag, sampled
from bstcad.scene.mount import MAX_DRAFT, MIN_CLOSING

TOLERANCE = 1e-7  # mm, of every face, edge and vertex
RIM = 1e-8  # mm; how far an edge may leave the exact one
SLIM = 1e-3  # mm
SMOOTH = 1e-7  # rad; pieces that turn by less from one to the next join smoothly
SHARPEST = 0.05  # 1 + cos of the turn at a corner: a mitre is at most 6.3 times as long as the offset
STEPS, EXACT = 50, 1e-13  # of Newton's method, and mm below which a step is none
SAMPLES = 129  # points of a piece at which its wall is checked

Named = tuple[TopoDS_Face, str]  # a face and its name: "back", "front", "rim", "bevel" or "hole"
Loop = list[tuple[TopoDS_Edge, bool]]  # edges and whether each is walked along its own direction


# ---- faces and solids ----------------------------------------------------------------------------------------------


def face_inside(surface: Geom_Surface, outward: bool, *loops: Loop) -> TopoDS_Face:
    """The face inside a loop that runs counterclockwise seen from outside, less holes, whose loops run clockwise."""
    builder, face = BRep_Builder(), TopoDS_Face()
    builder.MakeFace(face, surface, TOLERANCE)
    for loop in loops:
        wire = TopoDS_Wire()
        builder.MakeWire(wire)
        for edge, forward in loop:
            builder.Add(wire, edge if forward else edge.Reversed())
        wire.Closed(True)
        builder.Add(face, wire if outward else wire.Reversed())
    return face if outward else TopoDS.Face_s(face.Reversed())


def solid_of(built: Sequence[TopoDS_Face], fault: str) -> TopoDS_Solid:
    """The solid that faces bound which share their edges and look outwards; ValueError(fault) if it is not valid."""
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
    """The edge from one vertex to another, its parameter the length from the first (mm)."""
    return BRepBuilderAPI_MakeEdge(start, end).Edge()


# ---- rails ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rail:
    """A closed run of edges, one over each piece of a loop."""

    curves: tuple[Curve, ...]
    edges: tuple[TopoDS_Edge, ...]
    corners: tuple[TopoDS_Vertex, ...]  # over the starts of the pieces

    @classmethod
    def of(cls, curves: Sequence[Curve]) -> Rail:
        """Along curves that follow each other."""
        corners = tuple(BRepBuilderAPI_MakeVertex(gp_Pnt(*curve.poles[0].tolist())).Vertex() for curve in curves)
        ends = corners[1:] + corners[:1]
        edges = tuple(_edge(*each) for each in zip(curves, corners, ends, strict=True))
        return cls(tuple(curves), edges, corners)

    def along(self) -> Loop:
        """The loop in the direction of its pieces."""
        return [(edge, True) for edge in self.edges]

    def against(self) -> Loop:
        """The loop in the other direction."""
        return [(edge, False) for edge in reversed(self.edges)]


def _edge(curve: Curve, start: TopoDS_Vertex, end: TopoDS_Vertex) -> TopoDS_Edge:
    piece = curve.piece
    if curve.knots is not None:
        spline = patches.bspline_curve(curve.poles, curve.knots)
        return BRepBuilderAPI_MakeEdge(spline, start, end, 0.0, piece.end).Edge()
    if piece.straight:
        return _straight(start, end)
    (x, y, z), (x0, y0) = curve.poles[0].tolist(), piece.centre
    axes = gp_Ax2(gp_Pnt(x0, y0, z), gp_Dir(0, 0, piece.turn), gp_Dir(x - x0, y - y0, 0))
    return BRepBuilderAPI_MakeEdge(Geom_Circle(axes, math.hypot(x - x0, y - y0)), start, end, 0.0, piece.end).Edge()


def on(surface: Surface, loop: Sequence[Piece]) -> Rail:
    """Where upright walls over a loop meet a surface."""
    return Rail.of([_curve_on(surface, piece) for piece in loop])


def _curve_on(surface: Surface, piece: Piece) -> Curve:
    """A line, an arc or the border of a net, exactly; or a spline within RIM."""

    def points(t: np.ndarray) -> np.ndarray:
        x, y = piece.points(t).T
        return np.column_stack([x, y, sag(surface, x, y)])

    if _level_on(surface, piece):
        return Curve(piece, points(np.array([0.0, piece.end])))
    if surface.is_net and piece.straight and (border := _border(surface, piece)) is not None:
        return border
    smooth = not surface.is_net and (piece.straight or piece.centre is not None)
    return Curve(piece, *wires.fitted(points, wires.breaks(surface, piece), RIM, smooth))


def _border(net: BSplineSurface, piece: Piece) -> Curve | None:
    """The border of a net that a straight piece runs along from end to end, on the same knots; None: it does not."""
    poles = net.control_points()
    sides = [side[::step] for side in (poles[0], poles[-1], poles[:, 0], poles[:, -1]) for step in (1, -1)]
    ends = piece.points(np.array([0.0, piece.end]))
    side = next((side for side in sides if np.abs(side[[0, -1], :2] - ends).max() <= RIM), None)
    if side is None:
        return None
    full = knots(len(side))
    along = BSpline(full, side[:, :2], DEGREE)
    return Curve(replace(piece, points=along, end=float(full[-1])), side, full)


def _level_on(surface: Surface, piece: Piece) -> bool:
    """Is the edge over a piece on a surface a level line or arc, as on a plane, or about the axis?"""
    if piece.centre is not None and not surface.is_net and math.hypot(*piece.centre) < TOLERANCE:
        return True
    return surface.level and (piece.straight or piece.centre is not None)


# ---- the surfaces of walls -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sheet:
    """A surface on which a wall lies."""

    surface: Geom_Surface
    out: bool  # does its normal point out of the lens?
    image: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None
    # (t, z, 0 at the lower edge to 1 at the upper) -> (n, 2) in its parameter plane, all linear; None: planes need none

    def curve(self, poles: tuple[np.ndarray, np.ndarray, np.ndarray], knots: np.ndarray) -> Geom2d_BSplineCurve | None:
        """The image of a curve of these poles (t, z, share of the height)."""
        return None if self.image is None else patches.bspline_curve_2d(self.image(*poles), knots)

    def along(self, curve: Curve, up: float) -> Geom2d_BSplineCurve | None:
        """The image of a curve that is its lower edge (up 0) or its upper edge (1)."""
        end = curve.piece.end
        if curve.knots is None:
            knots, t = np.array([0.0, 0.0, end, end]), np.array([0.0, end])
        else:  # the poles of t itself are the means of as many knots as the degree
            knots = curve.knots
            t = sliding_window_view(knots[1:-1], len(knots) - len(curve.poles) - 1).mean(axis=1)
        return self.curve((t, curve.poles[:, 2], np.full(len(t), up)), knots)


def _upright(piece: Piece) -> Sheet:
    """The surface that stands on a piece along z."""
    if piece.straight or piece.centre is not None:
        return _flat_or_round(piece, (*piece.at(0.0), 0.0), 0.0)
    curve = _curve_on(Plane(0.0), piece)
    base = patches.bspline_curve(curve.poles, curve.knots)
    return Sheet(Geom_SurfaceOfLinearExtrusion(base, gp_Dir(0, 0, 1)), True, lambda t, z, _: np.stack([t, z], axis=-1))


def _flat_or_round(piece: Piece, start: Sequence[float], tangent: float) -> Sheet:
    """The plane, cylinder or cone over a line or an arc, through a point over its start, leaning inwards below."""
    x, y, z = map(float, start)
    angle, turn = math.atan(tangent), piece.turn
    if piece.straight:
        u, v = (-piece.left(np.zeros(1))[0]).tolist()
        normal = gp_Dir(u * math.cos(angle), v * math.cos(angle), -math.sin(angle))
        return Sheet(Geom_Plane(gp_Ax3(gp_Pnt(x, y, z), normal)), True, None)
    x0, y0 = piece.centre
    frame, radius = gp_Ax3(gp_Pnt(x0, y0, z), gp_Dir(0, 0, turn), gp_Dir(x - x0, y - y0, 0)), math.hypot(x - x0, y - y0)
    surface = Geom_ConicalSurface(frame, angle, radius) if tangent else Geom_CylindricalSurface(frame, radius)

    def image(t: np.ndarray, heights: np.ndarray, _: np.ndarray) -> np.ndarray:
        return np.stack([t, turn * (heights - z) / math.cos(angle)], axis=-1)

    return Sheet(surface, turn > 0, image)


def _drafted(piece: Piece, low: Curve, high: Curve, tangent: float) -> Sheet:
    """The surface of a wall below the parting line."""
    if not tangent:
        return _upright(piece)
    round_or_straight = piece.straight or piece.centre is not None
    return _flat_or_round(piece, high.poles[0], tangent) if round_or_straight else _ruled(low, high)


def _ruled(low: Curve, high: Curve) -> Sheet:
    """The surface of straight lines between two cubics of the same knots."""
    net, ends = np.stack([low.poles, high.poles], axis=1), np.array([0.0, 0.0, 1.0, 1.0])
    return Sheet(patches.bspline_surface(net, low.knots, ends), True, lambda t, _, up: np.stack([t, up], axis=-1))


def _between(sheets: Sequence[Sheet], low: Rail, high: Rail, outward: bool = True) -> list[TopoDS_Face]:
    """The walls from one rail up to another; outward: they look away from the lens."""
    builder, walls = BRep_Builder(), []
    rising = [_straight(start, end) for start, end in zip(low.corners, high.corners, strict=True)]
    for k, sheet in enumerate(sheets):
        after, curves = (k + 1) % len(sheets), (low.curves[k], high.curves[k])
        loop = [(low.edges[k], True), (rising[after], True), (high.edges[k], False), (rising[k], False)]
        if not outward:
            loop = [(edge, not forward) for edge, forward in reversed(loop)]
        wall = face_inside(sheet.surface, sheet.out == outward, loop)
        images = [(low.edges[k], sheet.along(curves[0], 0.0)), (high.edges[k], sheet.along(curves[1], 1.0))]
        for edge, end, t in ((rising[k], 0, 0.0), (rising[after], -1, curves[0].piece.end)):
            ends = np.array([curve.poles[end] for curve in curves])
            length = math.dist(*ends)
            poles = np.array([t, t]), ends[:, 2], np.array([0.0, 1.0])
            images.append((edge, sheet.curve(poles, np.array([0.0, 0.0, length, length]))))
        for edge, image in images:
            if image is not None:
                builder.UpdateEdge(edge, image, wall, TOLERANCE)
        walls.append(wall)
    return walls


def over(loop: Sequence[Piece], low: Rail, high: Rail, name: str = "rim", outward: bool = True) -> list[Named]:
    """Upright walls over a loop."""
    return [(wall, name) for wall in _between([_upright(piece) for piece in loop], low, high, outward)]


# ---- draft and bevel -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Draft:
    """How the walls of a lens stand from their parting line down to the front; both zero: along z."""

    angle: float = 0.0  # degrees, by which they lean inwards
    bevel: float = 0.0  # mm along z, taken at 45 degrees off their edge with the front

    def __post_init__(self) -> None:
        if not 0 <= self.angle <= MAX_DRAFT:
            raise ValueError(
                f"draft: {self.angle:g} degrees is not between 0 and {MAX_DRAFT:g}; choose an angle in between"
            )
        if not 0 <= self.bevel < math.inf:
            raise ValueError(f"bevel: {self.bevel:g} mm; give none, 0, or more")

    def __bool__(self) -> bool:
        return self.angle > 0 or self.bevel > 0

    @property
    def tangent(self) -> float:
        """How far the walls lean inwards, mm a mm."""
        return math.tan(math.radians(self.angle))

    @property
    def name(self) -> str:
        """The subject of a sentence about it: "draft", "bevel", or both."""
        return " and ".join(name for name, size in (("draft", self.angle), ("bevel", self.bevel)) if size)


UPRIGHT = Draft()


@dataclass(frozen=True)
class LeaningPiece:
    """A piece of the rim and the wall below it, which leans."""

    front: Surface
    piece: Piece
    mitres: tuple[np.ndarray, np.ndarray]  # (2,) at the ends of the piece
    z: float  # of the parting line (mm)
    draft: Draft

    def inwards(self, t: np.ndarray) -> np.ndarray:
        """(n, 2): by how much a point of the rim moves when the rim shrinks by 1."""
        if not self.piece.straight:
            return self.piece.left(t)
        start, end = self.mitres
        return start + (t / self.piece.end)[:, None] * (end - start)

    def ends(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) in mm: the lower edge of the wall, and that of the bevel, on the front; without a bevel the same."""
        start, m, tangent = self.piece.points(t), self.inwards(t), self.draft.tangent
        depth = self._depth(start, m, tangent, np.full(len(t), self.z)) - self.draft.bevel
        upper = np.column_stack([start + tangent * depth[:, None] * m, self.z - depth])
        if not self.draft.bevel:
            return upper, upper
        depth = self._depth(upper[:, :2], m, 1.0, upper[:, 2])
        return upper, np.column_stack([upper[:, :2] + depth[:, None] * m, upper[:, 2] - depth])

    def _depth(self, start: np.ndarray, inwards: np.ndarray, tangent: float, z: np.ndarray) -> np.ndarray:
        """How far below z (n,) (mm) lines that lean inwards by `tangent` meet the front, by Newton's method."""
        depth, least = np.zeros(len(start)), np.ones(len(start))
        for _ in range(STEPS):
            height, *slopes = sampled(self.front, *(start + tangent * depth[:, None] * inwards).T)
            closing = 1 + tangent * (np.stack(slopes, axis=1) * inwards).sum(axis=1)  # mm a mm of depth
            least = np.minimum(least, closing)
            step = (z - depth - height) / np.maximum(closing, MIN_CLOSING)
            depth = depth + step
            if np.abs(step).max() <= EXACT * (1 + np.abs(z).max()):
                break
        worst = int(least.argmin())
        if not least[worst] > MIN_CLOSING or not np.abs(step).max() <= TOLERANCE:
            name, angle = ("bevel", 45.0) if tangent == 1 else ("draft", self.draft.angle)
            raise ValueError(
                "{}: at ({:.4g}, {:.4g}) mm the front is too steep for a wall that leans by {:g} degrees to meet it; "
                "make it smaller".format(name, *start[worst], angle)
            )
        return depth

    def lower_edge(self) -> Piece:
        """The edge on the front as seen along z."""
        straight = self.piece.straight and _level_on(self.front, self.piece)
        return replace(self.piece, points=lambda t: self.ends(t)[1][:, :2], straight=straight)  # no curve needs `left`

    def curves(self) -> list[Curve]:
        """The parting line, the wall's lower edge and the bevel's: lines, arcs, or cubics of the same knots."""

        def points(t: np.ndarray) -> np.ndarray:
            return np.hstack([self.piece.points(t), np.full((len(t), 1), self.z), *self.ends(t)])

        edge, knots = self.lower_edge(), None
        if _level_on(self.front, self.piece):
            poles = points(np.array([0.0, self.piece.end]))
        else:
            sharp = replace(self, draft=Draft(self.draft.angle)).lower_edge()
            poles, knots = wires.fitted(points, wires.breaks(self.front, edge, sharp), RIM)
        return [Curve(edge, part, knots) for part in np.split(poles, 3, axis=1)]


def down(
    front: Surface, loops: Sequence[Sequence[Piece]], high: Rail, above: Surface, draft: Draft
) -> tuple[list[Named], Rail]:
    """The walls over the rim, the first loop, from a rail down to the front, and the edge in which they end on it.

    high: where they begin, on the surface `above`, which is level if they have draft.  The other loops are holes, which
    the front has to hold.  ValueError where walls do not come down to the front, or meet before.
    """
    rim = loops[0]
    if not draft:
        low = on(front, rim)
        return over(rim, low, high), low
    pieces = _leaning(rim, front, float(high.curves[0].poles[0, 2]), draft)
    _check(pieces, loops[1:], above)
    parting, upper, lower = zip(*(each.curves() for each in pieces), strict=True)
    low = Rail.of(lower)
    edge = Rail.of(upper) if draft.bevel else low
    sheets = [_drafted(*each, tangent=draft.tangent) for each in zip(rim, upper, parting, strict=True)]
    named = [(wall, "rim") for wall in _between(sheets, edge, high)]
    if draft.bevel:
        sheets = [
            _flat_or_round(piece, start.poles[0], 1.0) if start.knots is None else _ruled(end, start)
            for piece, end, start in zip(rim, lower, upper, strict=True)
        ]
        named += [(wall, "bevel") for wall in _between(sheets, low, edge)]
    return named, low


def _leaning(rim: Sequence[Piece], front: Surface, z: float, draft: Draft) -> list[LeaningPiece]:
    """The rim's pieces with their mitres, from z on (mm); ValueError where a corner has none."""
    starts = [piece.left(np.zeros(1))[0] for piece in rim]
    ends = [piece.left(np.array([piece.end]))[0] for piece in rim]
    for k, (piece, before, after) in enumerate(zip(rim, ends[-1:] + ends[:-1], tuple(starts), strict=True)):
        if math.dist(before, after) <= SMOOTH:
            continue
        if not (rim[k - 1].straight and piece.straight and 1 + before @ after > SHARPEST):
            raise ValueError(
                "{}: at ({:.4g}, {:.4g}) mm the rim has a corner that is too sharp, or not between straight sides, and "
                "walls cannot lean there; round it".format(draft.name, *piece.at(0.0))
            )
        starts[k] = ends[k - 1] = (before + after) / (1 + before @ after)
    mitres = zip(starts, ends, strict=True)
    return [LeaningPiece(front, *each, z=z, draft=draft) for each in zip(rim, mitres, strict=True)]


def _check(pieces: Sequence[LeaningPiece], holes: Sequence[Sequence[Piece]], above: Surface) -> None:
    """ValueError unless walls end below the surface above, and leave room for each other and for the holes."""
    name = pieces[0].draft.name
    for each in pieces:
        t = np.linspace(0.0, each.piece.end, SAMPLES)
        rim = each.piece.points(t)
        upper, lower = each.ends(t)
        top = sag(above, *rim.T)
        worst = int((top - upper[:, 2]).argmin())
        if not top[worst] - upper[worst, 2] > SLIM:
            raise ValueError(
                "{}: below ({:.4g}, {:.4g}) mm no wall is left between z = {:.4g} mm, where it begins, and the front's "
                "edge at {:.4g} mm; make it smaller, or the lens thicker at its edge".format(
                    name, *rim[worst], top[worst], lower[worst, 2]
                )
            )
        along, on_front = np.diff(rim, axis=0), np.diff(lower[:, :2], axis=0)
        onwards = (on_front * along).sum(axis=1) / (along * along).sum(axis=1)
        if not onwards.min() > SMOOTH:
            place = "({:.4g}, {:.4g}) mm".format(*rim[onwards.argmin()])
            raise ValueError(f"{name}: below {place} the walls meet before they reach the front; make it smaller")
    edge = [each.lower_edge() for each in pieces]
    if fault := wires.fault(wires.polygon(edge)):
        raise ValueError(f"{name}: below {fault[1]} the walls meet before they reach the front; make it smaller")
    if fault := wires.fault(wires.polygon(edge, *holes)):
        raise ValueError(f"{name}: near {fault[1]} a hole crosses the walls where they lean inwards; move the hole")
