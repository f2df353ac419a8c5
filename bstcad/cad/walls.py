"""Walls around a lens, between rails: closed runs of edges in which they meet the optical faces or each other.

An upright wall is a plane, a cylinder or the extrusion of a cubic; a wall with draft a plane, a cone or ruled, and so
is a bevel.  Each edge is built once, for the faces on both its sides, and has the parameter of its piece of the rim
(level lines: their length), in space and in the parameter planes of these faces.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from OCP.BRep import BRep_Builder
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge
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
from OCP.TopoDS import TopoDS_Edge, TopoDS_Face, TopoDS_Vertex

from bstcad.cad import draft, nurbs, patches, wires
from bstcad.cad.draft import Ceiling, Draft
from bstcad.cad.solid import TOLERANCE, Loop, face_inside, straight, vertex
from bstcad.cad.wires import Curve, Piece
from bstcad.optics.surfaces import Plane, Surface, sag

Named = tuple[TopoDS_Face, str]  # a face and its name: "back", "front", "rim", "bevel" or "hole"


@dataclass(frozen=True)
class Sheet:
    """A surface on which a wall lies."""

    surface: Geom_Surface
    out: bool  # does its normal point out of the lens?
    image: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None
    # (t, z, 0 at the lower edge to 1 at the upper) -> (n, 2) in its parameter plane, all linear; None: planes need none

    def curve(self, poles: tuple[np.ndarray, np.ndarray, np.ndarray], knots: np.ndarray) -> Geom2d_BSplineCurve | None:
        """The image of a curve of these poles (t, z, share of the height)."""
        return None if self.image is None else nurbs.bspline_curve_2d(self.image(*poles), knots)

    def along(self, curve: Curve, up: float) -> Geom2d_BSplineCurve | None:
        """The image of a curve that is its lower edge (up 0) or its upper edge (1)."""
        end = curve.piece.end
        if curve.knots is None:
            knots, t = np.array([0.0, 0.0, end, end]), np.array([0.0, end])
        else:  # the poles of t itself are the means of three knots
            knots, t = curve.knots, (curve.knots[1:-3] + curve.knots[2:-2] + curve.knots[3:-1]) / 3
        return self.curve((t, curve.poles[:, 2], np.full(len(t), up)), knots)


@dataclass(frozen=True)
class Rail:
    """A closed run of edges, one over each piece of a loop."""

    curves: tuple[Curve, ...]
    edges: tuple[TopoDS_Edge, ...]
    corners: tuple[TopoDS_Vertex, ...]  # over the starts of the pieces

    @classmethod
    def of(cls, curves: Sequence[Curve]) -> Rail:
        """Along curves that follow each other."""
        corners = tuple(vertex(*curve.poles[0]) for curve in curves)
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
        spline = nurbs.bspline_curve(curve.poles, curve.knots)
        return BRepBuilderAPI_MakeEdge(spline, start, end, 0.0, piece.end).Edge()
    if piece.straight:
        return straight(start, end)
    (x, y, z), (x0, y0) = curve.poles[0].tolist(), piece.centre
    axes = gp_Ax2(gp_Pnt(x0, y0, z), gp_Dir(0, 0, piece.turn), gp_Dir(x - x0, y - y0, 0))
    return BRepBuilderAPI_MakeEdge(Geom_Circle(axes, math.hypot(x - x0, y - y0)), start, end, 0.0, piece.end).Edge()


def curve_on(surface: Surface, piece: Piece) -> Curve:
    """Where an upright wall over a piece meets a surface: a line, an arc, or a cubic within faces.RIM."""

    def points(t: np.ndarray) -> np.ndarray:
        places = piece.points(t)
        return np.column_stack([places, sag(surface, *places.T)])

    if draft.level_on(surface, piece):
        return Curve(piece, points(np.array([0.0, piece.end])))
    return Curve(piece, *wires.fitted(points, wires.breaks(surface, piece), patches.RIM))


def on(surface: Surface, loop: Sequence[Piece]) -> Rail:
    """Where upright walls over a loop meet a surface."""
    return Rail.of([curve_on(surface, piece) for piece in loop])


def level(loop: Sequence[Piece], z: float) -> Rail:
    """The loop itself at the height z (mm)."""
    return on(Plane(z), loop)


def upright(piece: Piece) -> Sheet:
    """The surface that stands on a piece along z."""
    if piece.straight or piece.centre is not None:
        return _flat_or_round(piece, (*piece.at(0.0), 0.0), 0.0)
    curve = curve_on(Plane(0.0), piece)
    base = nurbs.bspline_curve(curve.poles, curve.knots)
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


def _ruled(low: Curve, high: Curve) -> Sheet:
    """The surface of straight lines between two cubics of the same knots."""
    net, ends = np.stack([low.poles, high.poles], axis=1), np.array([0.0, 0.0, 1.0, 1.0])
    return Sheet(nurbs.bspline_surface(net, low.knots, ends), True, lambda t, _, up: np.stack([t, up], axis=-1))


def between(sheets: Sequence[Sheet], low: Rail, high: Rail, outward: bool = True) -> list[TopoDS_Face]:
    """The walls from one rail up to another; outward: they look away from the lens."""
    builder, walls = BRep_Builder(), []
    rising = [straight(start, end) for start, end in zip(low.corners, high.corners, strict=True)]
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
    return [(wall, name) for wall in between([upright(piece) for piece in loop], low, high, outward)]


def down(
    surface: Surface, loops: Sequence[Sequence[Piece]], high: Rail, ceiling: Ceiling, lean: Draft
) -> tuple[list[Named], Rail]:
    """The walls over the rim, the first loop, from a rail down to the front, and the edge in which they end on it.

    high: where they begin; level if they have draft.  ceiling: below which they have to end.  The other loops are
    holes, which the front has to hold.  ValueError where walls do not come down to the front, or meet before.
    """
    rim = loops[0]
    if not lean:
        low = on(surface, rim)
        return over(rim, low, high), low
    pieces = draft.leaning(rim, surface, float(high.curves[0].poles[0, 2]), lean)
    draft.check(pieces, loops[1:], ceiling)
    parting, upper, lower = zip(*(each.traced() for each in pieces), strict=True)
    low = Rail.of(lower)
    edge = Rail.of(upper) if lean.bevel else low
    sheets = [_drafted(*each, lean.tangent) for each in zip(rim, upper, parting, strict=True)]
    named = [(wall, "rim") for wall in between(sheets, edge, high)]
    if lean.bevel:
        sheets = [
            _flat_or_round(rim[k], above.poles[0], 1.0) if above.knots is None else _ruled(below, above)
            for k, (below, above) in enumerate(zip(lower, upper, strict=True))
        ]
        named += [(wall, "bevel") for wall in between(sheets, low, edge)]
    return named, low


def _drafted(piece: Piece, low: Curve, high: Curve, tangent: float) -> Sheet:
    """The surface of a wall below the parting line."""
    if not tangent:
        return upright(piece)
    if piece.straight or piece.centre is not None:
        return _flat_or_round(piece, high.poles[0], tangent)
    return _ruled(low, high)
