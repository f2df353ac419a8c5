"""Closed plane curves that cut a lens: read from cadquery's wires, in pieces that a wall can stand on."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from OCP.BRepAdaptor import BRepAdaptor_CompCurve, BRepAdaptor_Curve
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeWire
from OCP.BRepTools import BRepTools_WireExplorer
from OCP.Geom import Geom_CylindricalSurface, Geom_Plane, Geom_Surface, Geom_SurfaceOfLinearExtrusion
from OCP.GeomAbs import GeomAbs_CurveType as Kind
from OCP.gp import gp_Ax3, gp_Dir, gp_Pnt, gp_Trsf, gp_Vec
from OCP.TopAbs import TopAbs_Orientation
from OCP.TopoDS import TopoDS, TopoDS_Edge, TopoDS_Wire

from bstcad.optics.outlines import Circle, Outline

if TYPE_CHECKING:
    import cadquery

FLAT = 1e-7  # mm; a wire that leaves its plane z = const by more is not plane, one whose ends lie further apart is open
NEAR = 1e-6  # mm; what is nearer touches
SIDES = 400  # of the polygon that stands for a loop where it is asked whether two cross
UPWARDS = gp_Dir(0, 0, 1)

Points = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # t -> ((n, 2) places in mm, (n, 2) their derivatives)


@dataclass(frozen=True)
class Piece:
    """A smooth part of a loop: places (x, y) for t from 0 to `end`, the lens on its left.

    On a circle t is the angle walked (rad); turn: +1 counterclockwise about `centre`, -1 clockwise.
    """

    points: Points
    end: float
    centre: tuple[float, float] | None = None  # mm; None: no circle
    turn: int = 0
    straight: bool = False
    curve: Any = None  # OCC's, in the plane z = 0, of what is neither a line nor a circle; turn -1: walked against it
    first: float = 0.0  # parameter of that curve where the piece has its one end

    def at(self, t: float) -> tuple[float, float]:
        """The place at t (mm)."""
        x, y = self.points(np.array([t]))[0][0]
        return float(x), float(y)

    def wall(self) -> tuple[Geom_Surface, bool]:
        """The surface that stands on it along z, and whether its normal points out of the lens."""
        (x, y), direction = self.at(0.0), self.points(np.array([0.0]))[1][0]
        if self.straight:
            outwards = gp_Dir(float(direction[1]), float(-direction[0]), 0)
            return Geom_Plane(gp_Ax3(gp_Pnt(x, y, 0), outwards)), True
        if self.centre is not None:
            first = self.at(0.0 if self.turn > 0 else self.end)  # where its angle on the cylinder is 0
            towards = gp_Dir(first[0] - self.centre[0], first[1] - self.centre[1], 0)
            radius = math.hypot(x - self.centre[0], y - self.centre[1])
            return Geom_CylindricalSurface(gp_Ax3(gp_Pnt(*self.centre, 0), UPWARDS, towards), radius), self.turn > 0
        return Geom_SurfaceOfLinearExtrusion(self.curve, UPWARDS), self.turn > 0

    def along(self, t: np.ndarray) -> np.ndarray:
        """The wall's first parameter at t; its second is z.  Planes need none."""
        return self.first + (t if self.turn > 0 else self.end - t)


def of_outline(outline: Outline) -> list[Piece]:
    """The outline itself, counterclockwise."""
    if isinstance(outline, Circle):
        return circle(0.0, 0.0, outline.radius)
    a, b = outline.half_extent
    corners = [(-a, -b), (a, -b), (a, b), (-a, b)]
    return [_line(p, q) for p, q in zip(corners, corners[1:] + corners[:1], strict=True)]


def circle(x: float, y: float, radius: float) -> list[Piece]:
    """Two halves of a circle, counterclockwise: no wall meets itself in a seam."""
    return [_arc((x, y), radius, start, math.pi, 1) for start in (0.0, math.pi)]


def of_wire(wire: cadquery.Wire | cadquery.Edge | cadquery.Workplane) -> list[Piece]:
    """A closed plane wire as it runs; ValueError if it is none, is open or not parallel to the plane z = 0."""
    found = _wire_in(wire)
    explorer, pieces = BRepTools_WireExplorer(found), []
    while explorer.More():
        edge = TopoDS.Edge_s(explorer.Current())
        pieces.extend(_pieces(BRepAdaptor_Curve(edge), edge.Orientation() == TopAbs_Orientation.TopAbs_REVERSED))
        explorer.Next()
    if not pieces or not BRepAdaptor_CompCurve(found).IsClosed():
        raise ValueError("a wire is open; close it")
    ends = zip(pieces, pieces[1:] + pieces[:1], strict=True)
    if any(math.dist(before.at(before.end), after.at(0.0)) > 10 * FLAT for before, after in ends):
        raise ValueError("a wire is open; close it")
    return pieces


def _wire_in(given: Any) -> TopoDS_Wire:
    """OCC's wire in cadquery's, in a closed edge such as a circle, or in a Workplane that ends in one of them."""
    shape, what = shape_in(given)
    if isinstance(shape, TopoDS_Edge):
        return BRepBuilderAPI_MakeWire(shape).Wire()
    if not isinstance(shape, TopoDS_Wire):
        raise ValueError(f"{what} where one closed wire is needed; give one, such as cadquery.Workplane().circle(5)")
    return shape


def shape_in(given: Any) -> tuple[Any, str]:
    """(OCC's shape in cadquery's, or in a Workplane that ends in one; None where there is none, what was given)."""
    values = given.vals() if hasattr(given, "vals") else [given]
    if len(values) != 1:
        return None, f"a Workplane of {len(values)} objects"
    return getattr(values[0], "wrapped", None), type(values[0]).__name__


def polygon(loop: Sequence[Piece]) -> np.ndarray:
    """(n, 2) places along a loop, once around (mm)."""
    count = max(8, SIDES // len(loop))
    sides = ((piece, 1 if piece.straight else count) for piece in loop)
    return np.concatenate([piece.points(np.linspace(0, piece.end, n, endpoint=False))[0] for piece, n in sides])


def area(corners: np.ndarray) -> float:
    """Area of a polygon, positive if it runs counterclockwise (mm²)."""
    (x, y), (x1, y1) = corners.T, np.roll(corners, -1, axis=0).T
    return float((x * y1 - x1 * y).sum()) / 2


def crossing(one: np.ndarray, other: np.ndarray) -> tuple[float, float] | None:
    """A place where two polygons cross, or one (given twice) crosses itself; None: there is none."""
    a, b = one, np.roll(one, -1, axis=0)
    c, d = other, np.roll(other, -1, axis=0)

    def side(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
        return np.sign((q - p)[..., 0] * (r - p)[..., 1] - (q - p)[..., 1] * (r - p)[..., 0])

    a, b, c, d = a[:, None], b[:, None], c[None, :], d[None, :]
    crossed = (side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)
    if not crossed.any():
        return None
    x, y = one[np.argwhere(crossed)[0][0]]
    return float(x), float(y)


def touching(one: np.ndarray, other: np.ndarray) -> tuple[float, float] | None:
    """A corner of one polygon that lies on another, or on a side of its own (given twice) that it does not end."""
    start, along = other, np.roll(other, -1, axis=0) - other
    reach = one[:, None] - start[None]
    share = ((reach * along).sum(axis=2) / np.maximum((along * along).sum(axis=1), FLAT**2)).clip(0.0, 1.0)
    near = np.linalg.norm(reach - share[..., None] * along, axis=2) <= NEAR
    if one is other:
        k = np.arange(len(one))
        near[k, k] = near[k, k - 1] = False
    places = one[near.any(axis=1)]
    return (float(places[0, 0]), float(places[0, 1])) if len(places) else None


def encloses(corners: np.ndarray, place: np.ndarray) -> bool:
    """Does a polygon enclose a place?"""
    (x, y), (x1, y1) = corners.T, np.roll(corners, -1, axis=0).T
    over = (y > place[1]) != (y1 > place[1])
    at = x + (place[1] - y) / np.where(over, y1 - y, 1.0) * (x1 - x)
    return bool((over & (place[0] < at)).sum() % 2)


def reversed_loop(loop: Sequence[Piece]) -> list[Piece]:
    """The same loop walked the other way."""
    return [_reversed(piece) for piece in reversed(loop)]


def _reversed(piece: Piece) -> Piece:
    def points(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        places, along = piece.points(piece.end - t)
        return places, -along

    return replace(piece, points=points, turn=-piece.turn)


def _line(start: Sequence[float], end: Sequence[float]) -> Piece:
    p, length = np.array(start, float), math.dist(start, end)
    direction = (np.array(end, float) - p) / length

    def points(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return p + t[:, None] * direction, np.broadcast_to(direction, (len(t), 2))

    return Piece(points, length, straight=True)


def _arc(centre: tuple[float, float], radius: float, start: float, span: float, turn: int) -> Piece:
    def points(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = start + turn * t
        c, s = radius * np.cos(angle), radius * np.sin(angle)
        return np.stack([centre[0] + c, centre[1] + s], axis=1), turn * np.stack([-s, c], axis=1)

    return Piece(points, span, centre, turn)


def _pieces(curve: BRepAdaptor_Curve, against: bool) -> Iterator[Piece]:
    """An edge, walked against its own direction or along it."""
    first, last = curve.FirstParameter(), curve.LastParameter()
    heights = [curve.Value(first + share * (last - first)).Z() for share in np.linspace(0, 1, 17).tolist()]
    if max(heights) - min(heights) > FLAT:
        raise ValueError("a wire is not parallel to the plane z = 0; draw it on a Workplane('XY')")
    ends = [(p.X(), p.Y()) for p in (curve.Value(first), curve.Value(last))]
    if curve.GetType() == Kind.GeomAbs_Line:
        found = [_line(*ends)]
    elif curve.GetType() == Kind.GeomAbs_Circle:
        found = curve.Circle()
        centre, radius = (found.Location().X(), found.Location().Y()), found.Radius()
        turn = 1 if found.Axis().Direction().Z() > 0 else -1
        start = math.atan2(ends[0][1] - centre[1], ends[0][0] - centre[0])
        halves = math.ceil((last - first) / math.pi - 1e-9)
        span = (last - first) / halves
        found = [_arc(centre, radius, start + turn * k * span, span, turn) for k in range(halves)]
    else:
        parts = 1 if math.dist(*ends) > FLAT else 2  # a wall that closes on itself would meet itself in a seam
        ends = np.linspace(first, last, parts + 1).tolist()
        found = [_freeform(curve, heights[0], *span) for span in zip(ends[:-1], ends[1:], strict=True)]
    yield from reversed_loop(found) if against else found


def _freeform(curve: BRepAdaptor_Curve, z: float, first: float, last: float) -> Piece:
    """Any other curve between two of OCC's own parameters."""
    down = gp_Trsf()
    down.SetTranslation(gp_Vec(0, 0, -z))
    moved = curve.Curve().Curve().Transformed(curve.Trsf()).Transformed(down)

    def points(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        out, p, v = np.empty((len(t), 4)), gp_Pnt(), gp_Vec()
        for row, value in enumerate((first + t).tolist()):
            curve.D1(value, p, v)
            out[row] = p.X(), p.Y(), v.X(), v.Y()
        return out[:, :2], out[:, 2:]

    return Piece(points, last - first, None, 1, False, moved, first)
