"""Loops, the closed plane wires that cut a lens, in smooth pieces with one wall each, and splines over the pieces."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.lib.stride_tricks import sliding_window_view
from OCP.BRepAdaptor import BRepAdaptor_Curve
from OCP.GeomAbs import GeomAbs_CurveType as Kind
from OCP.TopAbs import TopAbs_Orientation
from scipy.interpolate import BSpline, make_interp_spline

from bstcad.optics.surfaces.bspline import BSplineSurface, is_net
from bstcad.optics.surfaces.outlines import Circle, Outline
from bstcad.optics.surfaces.radial import circle_radius
from bstcad.optics.surfaces.surfaces import Surface, points_on

if TYPE_CHECKING:
    import cadquery

WIRE_TOLERANCE = 1e-7  # largest deviation (mm) of a wire from its plane z = const
MIN_CLEARANCE = 1e-6  # distance (mm) below which wires are said to touch
POLYGON_SIDES = 400  # number of sides of the polygon that represents a loop in checks
MIN_INTERVALS = 64  # smallest number of intervals of a spline over a piece
MAX_INTERVALS, MAX_HALVINGS = 1 << 14, 4  # largest number of intervals: 1 << 14 or, if more, 2^4 times the first number
QUINTIC_INTERVALS = 256  # intervals of a quintic; along half a circle on a sphere or conic its error is 1e-12 mm
MIN_BREAK_DISTANCE = 1e-7  # smallest distance of two breaks, relative to the length of the piece
ONE_SIDED_SLOPE = np.array([-25, 48, -36, 16, -3]) / 12  # weights of 5 values (spacing 1) for the slope at the first
CROSSING_BISECTIONS = 50  # number of bisections, which leave only rounding errors

RIM_DEGREE = 3  # degree of the spline along the rim of a face in a chart

Locus = Callable[[np.ndarray], np.ndarray]  # function of t (n,) that returns points (n, k)


@dataclass(frozen=True)
class LoopPiece:
    """A smooth part of a loop: points (x, y) for 0 <= t <= `end`, with the lens on the left.

    On a line t is the length (mm), on a circle the angle (rad), on another curve its parameter, each from the start.
    """

    points: Locus  # points at t (n,), (n, 2), mm
    left: Locus  # unit normals at t (n,) into the lens, (n, 2)
    end: float  # largest t
    centre: tuple[float, float] | None = None  # centre of a circle (mm); None: not a circle
    turn: int = 0  # direction on a circle: +1 counterclockwise, -1 clockwise; 0: not a circle
    straight: bool = False  # True for a line
    rim: FaceRim | None = None  # curve in space over an outline in a chart; None: the curve follows from (x, y)

    @property
    def is_line_or_arc(self) -> bool:
        """True for a line or an arc, False for a freeform curve."""
        return self.straight or self.centre is not None

    def at(self, t: float) -> tuple[float, float]:
        """Return (x, y), in mm, of the point at t."""
        x, y = self.points(np.array([t]))[0]
        return float(x), float(y)


@dataclass(frozen=True)
class FaceRim:
    """A piece of the rim of a face in space, a spline with the parameter t of the piece."""

    arc: LoopPiece  # piece of the circle in the face's chart over which the rim lies, with the same t
    poles: np.ndarray  # control points, (n, 3), mm
    knots: np.ndarray  # full knot vector

    def heights(self, t: np.ndarray) -> np.ndarray:
        """Return z (mm) of the rim at t (n,)."""
        return BSpline(self.knots, self.poles[:, 2], RIM_DEGREE)(t)

    def curve_on(self, piece: LoopPiece, surface: Surface) -> RailCurve:
        """Return the rim itself on its face, or its projection along z onto a plane z = const."""
        poles = self.poles.copy()
        if surface.level:
            poles[:, 2] = surface.z
        return RailCurve(piece, poles, self.knots)


def loop_on(face: BSplineSurface, outline: Outline, tolerance: float) -> list[LoopPiece]:
    """Return the rim of a face over a circle in its chart, counterclockwise, in two halves.

    The rim is a piecewise cubic within a tolerance (mm) of the exact curve; the wall below it and its lower edge share
    its poles and knots.
    """

    def piece(arc: LoopPiece) -> LoopPiece:
        poles, knots = fit_spline(lambda t: points_on(face, *arc.points(t).T), breaks(face, arc), tolerance)
        curve = BSpline(knots, poles[:, :2], RIM_DEGREE)
        slope = curve.derivative()

        def left(t: np.ndarray) -> np.ndarray:
            along = slope(t)
            return along[:, ::-1] * (-1, 1) / np.linalg.norm(along, axis=1)[:, None]

        return LoopPiece(curve, left, arc.end, rim=FaceRim(arc, poles, knots))

    return [piece(arc) for arc in circle(0.0, 0.0, circle_radius(outline))]


def outline_loop(outline: Outline) -> list[LoopPiece]:
    """Return the loop of a circle or of a rectangle with sharp corners, counterclockwise."""
    if isinstance(outline, Circle):
        return circle(0.0, 0.0, outline.radius)
    a, b = outline.half_extent
    corners = [(-a, -b), (a, -b), (a, b), (-a, b)]
    return [line(p, q) for p, q in zip(corners, corners[1:] + corners[:1], strict=True)]


def circle(x: float, y: float, radius: float) -> list[LoopPiece]:
    """Return a circle as two halves, counterclockwise, so that no wall meets itself in a seam."""
    return [arc((x, y), radius, start, span=math.pi) for start in (0.0, math.pi)]


def wire_loop(given: cadquery.Wire | cadquery.Edge | cadquery.Workplane) -> list[LoopPiece]:
    """Return the loop of a closed plane wire in its direction; ValueError if it is open or not in a plane z = const."""
    import cadquery

    shape, kind = shape_in(given)
    wire = cadquery.Wire.assembleEdges([shape]) if isinstance(shape, cadquery.Edge) else shape
    if not isinstance(wire, cadquery.Wire):
        raise ValueError(f"{kind} is not one closed wire; give a wire, such as cadquery.Workplane().circle(5)")
    pieces = [piece for edge in wire for piece in _pieces(edge)]
    ends = zip(pieces, pieces[1:] + pieces[:1], strict=True)
    gaps = [math.dist(before.at(before.end), after.at(0.0)) for before, after in ends]
    if not pieces or not wire.IsClosed() or max(gaps) > 10 * WIRE_TOLERANCE:
        raise ValueError("a wire is open; close the wire")
    return pieces


def shape_in(given: Any) -> tuple[Any, str]:
    """Return (shape, name of its type); for a Workplane, its only object or else (None, number of objects as text)."""
    values = given.vals() if hasattr(given, "vals") else [given]
    if len(values) != 1:
        return None, f"a Workplane of {len(values)} objects"
    return values[0], type(values[0]).__name__


def line(start: Sequence[float], end: Sequence[float]) -> LoopPiece:
    """Return the straight piece between two points (x, y) (mm)."""
    p, length = np.array(start, float), math.dist(start, end)
    x, y = (np.array(end, float) - p) / length
    points, left = (lambda t: p + t[:, None] * np.array([x, y])), (lambda t: np.tile([-y, x], (len(t), 1)))
    return LoopPiece(points, left, length, straight=True)


def arc(centre: tuple[float, float], radius: float, start: float, *, span: float, turn: int = 1) -> LoopPiece:
    """Return the arc about a centre (mm) from an angle `start` over `span` (rad); turn: 1 counterclockwise, -1 not."""

    def outwards(t: np.ndarray) -> np.ndarray:
        angle = start + turn * t
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)

    points, left = (lambda t: centre + radius * outwards(t)), (lambda t: -turn * outwards(t))
    return LoopPiece(points, left, span, centre=centre, turn=turn)


def _pieces(edge: cadquery.Edge) -> list[LoopPiece]:
    curve = BRepAdaptor_Curve(edge.wrapped)
    first, last = curve.FirstParameter(), curve.LastParameter()
    heights = [curve.Value(t).Z() for t in np.linspace(first, last, 17).tolist()]
    if max(heights) - min(heights) > WIRE_TOLERANCE:
        raise ValueError("a wire is not parallel to the plane z = 0; draw it on a Workplane('XY')")
    start, end = (curve.Value(t).Coord()[:2] for t in (first, last))
    if curve.GetType() == Kind.GeomAbs_Line:
        pieces = [line(start, end)]
    elif curve.GetType() == Kind.GeomAbs_Circle:
        x, y, _ = curve.Circle().Location().Coord()
        turn = 1 if curve.Circle().Axis().Direction().Z() > 0 else -1
        angle, halves = math.atan2(start[1] - y, start[0] - x), math.ceil((last - first) / math.pi - 1e-9)
        span = (last - first) / halves
        starts = (angle + turn * k * span for k in range(halves))
        pieces = [arc((x, y), curve.Circle().Radius(), each, span=span, turn=turn) for each in starts]
    else:
        parts = 1 if math.dist(start, end) > WIRE_TOLERANCE else 2  # two for a closed edge: no wall has a seam
        ends = np.linspace(first, last, parts + 1).tolist()
        pieces = [_freeform(curve, *span) for span in zip(ends[:-1], ends[1:], strict=True)]
    return reversed_loop(pieces) if edge.wrapped.Orientation() == TopAbs_Orientation.TopAbs_REVERSED else pieces


def _freeform(curve: BRepAdaptor_Curve, first: float, last: float) -> LoopPiece:
    def points(t: np.ndarray) -> np.ndarray:
        return np.array([curve.Value(each).Coord()[:2] for each in (first + t).tolist()])

    def left(t: np.ndarray) -> np.ndarray:
        slopes = np.array([curve.DN(each, 1).Coord()[:2] for each in (first + t).tolist()])
        return slopes[:, ::-1] * (-1, 1) / np.linalg.norm(slopes, axis=1)[:, None]

    return LoopPiece(points, left, last - first)


def reversed_loop(loop: Sequence[LoopPiece]) -> list[LoopPiece]:
    """Return a loop in the opposite direction."""

    def turned(piece: LoopPiece) -> LoopPiece:
        points, left = (lambda t: piece.points(piece.end - t)), (lambda t: -piece.left(piece.end - t))
        return replace(piece, points=points, left=left, turn=-piece.turn)

    return [turned(piece) for piece in reversed(loop)]


# ---- loops as polygons -----------------------------------------------------------------------------------------------


def polygon(rim: Sequence[LoopPiece], *holes: Sequence[LoopPiece]) -> shapely.Polygon:
    """Return the polygon inside a rim and outside holes, with its corners on the curves."""
    return shapely.Polygon(_corners(rim), [_corners(hole) for hole in holes])


def _corners(loop: Sequence[LoopPiece]) -> np.ndarray:
    sides = ((piece, 1 if piece.straight else max(8, POLYGON_SIDES // len(loop))) for piece in loop)
    return np.concatenate([piece.points(np.linspace(0, piece.end, n, endpoint=False)) for piece, n in sides])


def fault(shape: shapely.Polygon) -> tuple[str, str] | None:
    """Return (reason why a polygon does not bound a lens, position), both as text; None if it does.

    Wires must neither cross nor touch themselves or each other.  Holes must lie inside the rim and outside each other.
    """
    if not shape.is_valid:
        reason, _, position = shapely.is_valid_reason(shape).lower().partition("[")
        x, y = map(float, position.rstrip("]").split())
        return reason.replace("shell", "the rim"), f"({x:.4g}, {y:.4g}) mm"
    if shapely.minimum_clearance(shape) > MIN_CLEARANCE:
        return None
    x, y = shapely.minimum_clearance_line(shape).coords[0]
    return "wires touch", f"({x:.4g}, {y:.4g}) mm"


# ---- curves over pieces ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RailCurve:
    """A curve in space over a piece, with the piece's parameter t: a spline, or a level line or arc."""

    piece: LoopPiece
    poles: np.ndarray  # control points, (n, 3), mm; for a line or an arc, its two ends
    knots: np.ndarray | None = None  # full knot vector; None: a line or an arc


def breaks(surface: Surface, *pieces: LoopPiece) -> np.ndarray:
    """Return parameters t, from 0 to the end, between which each piece lies over one smooth part of a surface."""
    t = np.linspace(0.0, pieces[0].end, MIN_INTERVALS + 1)
    if pieces[0].rim is not None:  # smooth between the knots of the rim
        t = np.unique(np.concatenate([t, pieces[0].rim.knots]))
    elif is_net(surface):  # smooth between its knot lines
        t = np.unique(np.concatenate([t, *(_crossings(surface, piece) for piece in pieces)]))
    inner = t[1:-1]
    inner = inner[(np.diff(t)[:-1] > MIN_BREAK_DISTANCE * t[-1]) & (t[-1] - inner > MIN_BREAK_DISTANCE * t[-1])]
    return np.concatenate([t[:1], inner, t[-1:]])


def _crossings(surface: BSplineSurface, piece: LoopPiece) -> np.ndarray:
    """Return the parameters at which a piece crosses knot lines of a net, by bisection of all crossings at once."""
    t, crossings = np.linspace(0.0, piece.end, max(*surface.shape, MIN_INTERVALS) * 8 + 1), [np.empty(0)]
    points = piece.points(t)
    for axis, ((first, _), pitch) in enumerate(zip((surface.x, surface.y), surface.pitch, strict=True)):
        cell = np.floor((points[:, axis] - first) / pitch - 0.5)  # knots lie at first + pitch (k + 1/2)
        k = np.flatnonzero(np.diff(cell))  # empty if the piece runs along the lines
        line, low, high = first + pitch * (np.maximum(cell[k], cell[k + 1]) + 0.5), t[k], t[k + 1]
        rising = cell[k] < cell[k + 1]
        for _ in range(CROSSING_BISECTIONS if len(k) else 0):
            middle = (low + high) / 2
            before = (piece.points(middle)[:, axis] < line) == rising
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        crossings.append(high)
    return np.concatenate(crossings)


def fit_spline(points: Locus, t: np.ndarray, tolerance: float, smooth: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Fit a spline to a curve within a tolerance and return its poles (n, k) and full knots.

    smooth: the curve is analytic, and a quintic is used if it suffices.  Otherwise, a piecewise cubic interpolates the
    points and slopes of the curve.  Its first intervals lie between the breaks t.  Each interval is halved until its
    error is small enough at its centre and quarters; the error falls with the fourth power of the interval's length.
    """
    if smooth:
        even = np.linspace(t[0], t[-1], 2 * QUINTIC_INTERVALS + 1)
        values = points(even)
        spline = make_interp_spline(even[::2], values[::2], k=5)
        if np.abs(spline(even) - values).max() <= tolerance:
            return spline.c, spline.t
    max_parts = max(MAX_INTERVALS, len(t) << MAX_HALVINGS)
    limit = tolerance / 2  # the error may be larger between the centre and the quarters
    while True:
        quarters = np.append((t[:-1, None] + np.diff(t)[:, None] * np.arange(4) / 4).ravel(), t[-1])
        values = points(quarters)
        poles, knots = _hermite(t, values)
        off = np.abs(BSpline(knots, poles, 3)(quarters) - values)[:-1].reshape(len(t) - 1, -1).max(axis=1)
        if off.max() <= limit:
            return poles, knots
        if len(t) > max_parts:
            raise ValueError(
                f"the rim bends too sharply for a curve of {len(t) - 1} parts (error {off.max():.1e} mm); "
                "move the rim, round its corners, or give the lens fewer control points"
            )
        t = np.union1d(t, (t[:-1] + t[1:])[off > limit] / 2)


def _hermite(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return poles and full knots of a piecewise cubic; values: the curve at t and at the quarters of each interval."""
    parts, length = sliding_window_view(values, 5, axis=0)[::4], np.diff(t)[:, None]
    first, last = 4 * parts @ ONE_SIDED_SLOPE / length, -4 * parts @ ONE_SIDED_SLOPE[::-1] / length
    slope = np.concatenate([first[:1], (last[:-1] + first[1:]) / 2, last[-1:]])
    at = values[::4]
    inner = np.stack([at[:-1] + length / 3 * slope[:-1], at[1:] - length / 3 * slope[1:]], axis=1)
    poles = np.concatenate([at[:1], inner.reshape(-1, at.shape[1]), at[-1:]])
    return poles, np.concatenate([t[[0, 0]], np.repeat(t, 2), t[[-1, -1]]])
