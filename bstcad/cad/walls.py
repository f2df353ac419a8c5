"""Walls along z: over one ring of pieces they run from rail to rail, closed curves in which other faces meet them.

Each edge is built once, for the wall and for the face that meets it there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from OCP.BRep import BRep_Builder
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge
from OCP.Geom import Geom_BSplineCurve, Geom_Circle, Geom_Curve, Geom_Surface
from OCP.Geom2d import Geom2d_BSplineCurve, Geom2d_Curve, Geom2d_Line
from OCP.gp import gp_Ax2, gp_Dir, gp_Dir2d, gp_Pnt, gp_Pnt2d, gp_Trsf, gp_Vec
from OCP.TopoDS import TopoDS_Edge, TopoDS_Face, TopoDS_Vertex

from bstcad.cad import nurbs
from bstcad.cad.loops import Piece
from bstcad.cad.solid import TOLERANCE, Loop, face_inside, straight, vertex


@dataclass(frozen=True)
class Ring:
    """A closed loop of pieces, the lens on its left, and the surface that stands on each."""

    pieces: tuple[Piece, ...]
    surfaces: tuple[tuple[Geom_Surface, bool], ...]  # and whether its normal points out of the lens

    @classmethod
    def of(cls, pieces: Sequence[Piece]) -> Ring:
        """Of a loop."""
        return cls(tuple(pieces), tuple(piece.wall() for piece in pieces))


@dataclass(frozen=True)
class Rail:
    """A closed curve over a ring: an edge over each piece, from the vertex above the piece's start."""

    edges: tuple[TopoDS_Edge, ...]
    corners: tuple[TopoDS_Vertex, ...]
    heights: tuple[float, ...]  # z of the corners (mm)
    images: tuple[Geom2d_Curve | None, ...]  # of each edge on its wall, as (the wall's parameter, z); planes need none
    breaks: tuple[np.ndarray, ...] = ()  # of each edge that is a spline, in its parameter

    def along(self) -> Loop:
        """The loop in the direction of the ring."""
        return [(edge, True) for edge in self.edges]

    def against(self) -> Loop:
        """The loop in the other direction."""
        return [(edge, False) for edge in reversed(self.edges)]


def level(ring: Ring, z: float) -> Rail:
    """The ring itself at the height z (mm), on the very curves of its pieces."""
    places = [piece.at(0.0) for piece in ring.pieces]
    corners = [vertex(x, y, z) for x, y in places]
    edges, images = [], []
    for piece, here, after in zip(ring.pieces, corners, corners[1:] + corners[:1], strict=True):
        if piece.straight:
            edge, image = straight(here, after), None
        else:
            curve, start, image = _circle(piece, z) if piece.centre is not None else _freeform(piece, z)
            edge = BRepBuilderAPI_MakeEdge(curve, here, after, start, start + piece.end).Edge()
        edges.append(edge)
        images.append(image)
    return Rail(tuple(edges), tuple(corners), (z,) * len(corners), tuple(images))


def _circle(piece: Piece, z: float) -> tuple[Geom_Curve, float, Geom2d_Curve]:
    """(the curve of an arc at a height, its parameter at the piece's start, its image on the wall)."""
    (x, y), (x0, y0) = piece.at(0.0), piece.centre
    axis = gp_Ax2(gp_Pnt(x0, y0, z), gp_Dir(0, 0, piece.turn), gp_Dir(x - x0, y - y0, 0))
    start = float(piece.along(np.zeros(1))[0])
    return Geom_Circle(axis, float(np.hypot(x - x0, y - y0))), 0.0, _across(start, z, piece.turn)


def _freeform(piece: Piece, z: float) -> tuple[Geom_Curve, float, Geom2d_Curve]:
    """The same of any other piece; its own curve is walked from `first` on, or against, from the far end."""
    up = gp_Trsf()
    up.SetTranslation(gp_Vec(0, 0, z))
    curve = piece.curve.Transformed(up)
    if isinstance(curve, Geom_BSplineCurve):  # of a closed one only this part, which then says where it begins
        curve.Segment(piece.first, piece.first + piece.end)
    if piece.turn > 0:
        return curve, piece.first, _across(0.0, z, 1)
    far = piece.first + piece.end
    start = curve.ReversedParameter(far)
    return curve.Reversed(), start, _across(far + start, z, -1)


def _across(start: float, z: float, turn: int) -> Geom2d_Line:
    return Geom2d_Line(gp_Pnt2d(start, z), gp_Dir2d(turn, 0))


def on_wall(piece: Piece, breaks: np.ndarray, heights: np.ndarray) -> Geom2d_BSplineCurve | None:
    """A cubic over a piece as (the wall's parameter, z): the poles in z are those of the curve in space."""
    if piece.straight:
        return None
    along, third = piece.along(breaks), np.diff(breaks) / 3 * (1 if piece.turn > 0 else -1)
    inner = np.stack([along[:-1] + third, along[1:] - third], axis=1).ravel()
    poles = np.column_stack([np.concatenate([along[:1], inner, along[-1:]]), heights])
    return nurbs.bspline_curve_2d(poles, np.concatenate([breaks[[0, 0]], np.repeat(breaks, 2), breaks[[-1, -1]]]))


def between(ring: Ring, low: Rail, high: Rail, outward: bool = True) -> list[TopoDS_Face]:
    """The walls from one rail up to another; outward: they look away from the lens."""
    builder, walls, count = BRep_Builder(), [], len(ring.pieces)
    rising = [straight(start, end) for start, end in zip(low.corners, high.corners, strict=True)]
    for k, (piece, (surface, normal_out)) in enumerate(zip(ring.pieces, ring.surfaces, strict=True)):
        after = (k + 1) % count
        loop = [(low.edges[k], True), (rising[after], True), (high.edges[k], False), (rising[k], False)]
        if not outward:
            loop = [(edge, not forward) for edge, forward in reversed(loop)]
        wall = face_inside(surface, normal_out == outward, loop)
        for rail in (low, high):
            if rail.images[k] is not None:
                builder.UpdateEdge(rail.edges[k], rail.images[k], wall, TOLERANCE)
        if not piece.straight:
            for edge, t, z in ((rising[k], 0.0, low.heights[k]), (rising[after], piece.end, low.heights[after])):
                line = Geom2d_Line(gp_Pnt2d(float(piece.along(np.array([t]))[0]), z), gp_Dir2d(0, 1))
                builder.UpdateEdge(edge, line, wall, TOLERANCE)
        walls.append(wall)
    return walls
