"""Closed plane wires that cut a lens, in smooth pieces that a wall can stand on, and cubics that follow them."""

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

from bstcad.optics.outlines import Outline
from bstcad.optics.surfaces import Surface

if TYPE_CHECKING:
    import cadquery

FLAT = 1e-7  # mm; a wire that leaves its plane z = const by more is not plane, and with ends further apart it is open
NEAR = 1e-6  # mm; wires nearer to each other than this touch
SIDES = 400  # of the polygon by which a loop is checked
COARSEST = 64  # parts of a piece, at least
FINEST, HALVINGS = 1 << 14, 4  # parts of a cubic at most; or each of its first parts halved so often
SMOOTH_PARTS = 256  # of a quintic, which follows half a circle on a sphere or conic to 1e-12 mm
CLOSE = 1e-7  # of a piece: two breaks nearer than that are merged
ONE_SIDED = np.array([-25, 48, -36, 16, -3]) / 12  # of five values a step apart: the slope at the first, to h⁴ f⁽⁵⁾ / 5
BISECTIONS = 50

Points = Callable[[np.ndarray], np.ndarray]  # t (n,) -> points (n, k)


@dataclass(frozen=True)
class Piece:
    """A smooth part of a loop: points (x, y) for t from 0 to `end`, the lens on the left.

    On a line t is the length, on a circle the angle walked (rad); turn: +1 counterclockwise about `centre`, -1
    clockwise.
    """

    points: Points  # t (n,) -> (n, 2) in mm
    left: Points  # t (n,) -> unit normals (n, 2), into the lens
    end: float
    centre: tuple[float, float] | None = None  # mm; None: no circle
    turn: int = 0
    straight: bool = False

    def at(self, t: float) -> tuple[float, float]:
        """The point at t (mm)."""
        x, y = self.points(np.array([t]))[0]
        return float(x), float(y)


def of_outline(outline: Outline) -> list[Piece]:
    """The outline itself, counterclockwise."""
    if outline.is_round:
        return circle(0.0, 0.0, outline.radius)
    a, b = outline.half_extent
    corners = [(-a, -b), (a, -b), (a, b), (-a, b)]
    return [_line(p, q) for p, q in zip(corners, corners[1:] + corners[:1], strict=True)]


def circle(x: float, y: float, radius: float) -> list[Piece]:
    """Two halves of a circle, counterclockwise: no wall meets itself in a seam."""
    return [_arc((x, y), radius, start, span=math.pi) for start in (0.0, math.pi)]


def of_wire(given: cadquery.Wire | cadquery.Edge | cadquery.Workplane) -> list[Piece]:
    """A closed plane wire as it runs; ValueError if it is none, is open or not parallel to the plane z = 0."""
    import cadquery

    shape, kind = shape_in(given)
    wire = cadquery.Wire.assembleEdges([shape]) if isinstance(shape, cadquery.Edge) else shape
    if not isinstance(wire, cadquery.Wire):
        raise ValueError(f"{kind} where one closed wire is needed; give one, such as cadquery.Workplane().circle(5)")
    pieces = [piece for edge in wire for piece in _pieces(edge)]
    ends = zip(pieces, pieces[1:] + pieces[:1], strict=True)
    gaps = [math.dist(before.at(before.end), after.at(0.0)) for before, after in ends]
    if not pieces or not wire.IsClosed() or max(gaps) > 10 * FLAT:
        raise ValueError("a wire is open; close it")
    return pieces


def shape_in(given: Any) -> tuple[Any, str]:
    """(the one shape given, itself or at the end of a Workplane, or None; the name of its kind)."""
    values = given.vals() if hasattr(given, "vals") else [given]
    if len(values) != 1:
        return None, f"a Workplane of {len(values)} objects"
    return values[0], type(values[0]).__name__


def _line(start: Sequence[float], end: Sequence[float]) -> Piece:
    p, length = np.array(start, float), math.dist(start, end)
    x, y = (np.array(end, float) - p) / length

    def left(t: np.ndarray) -> np.ndarray:
        return np.tile([-y, x], (len(t), 1))

    return Piece(lambda t: p + t[:, None] * np.array([x, y]), left, length, straight=True)


def _arc(centre: tuple[float, float], radius: float, start: float, *, span: float, turn: int = 1) -> Piece:
    def outwards(t: np.ndarray) -> np.ndarray:
        angle = start + turn * t
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)

    return Piece(lambda t: centre + radius * outwards(t), lambda t: -turn * outwards(t), span, centre=centre, turn=turn)


def _pieces(edge: cadquery.Edge) -> list[Piece]:
    """An edge in its own orientation."""
    curve = BRepAdaptor_Curve(edge.wrapped)
    first, last = curve.FirstParameter(), curve.LastParameter()
    heights = [curve.Value(t).Z() for t in np.linspace(first, last, 17).tolist()]
    if max(heights) - min(heights) > FLAT:
        raise ValueError("a wire is not parallel to the plane z = 0; draw it on a Workplane('XY')")
    start, end = (curve.Value(t).Coord()[:2] for t in (first, last))
    if curve.GetType() == Kind.GeomAbs_Line:
        pieces = [_line(start, end)]
    elif curve.GetType() == Kind.GeomAbs_Circle:
        x, y, _ = curve.Circle().Location().Coord()
        turn = 1 if curve.Circle().Axis().Direction().Z() > 0 else -1
        angle, halves = math.atan2(start[1] - y, start[0] - x), math.ceil((last - first) / math.pi - 1e-9)
        span = (last - first) / halves
        starts = (angle + turn * k * span for k in range(halves))
        pieces = [_arc((x, y), curve.Circle().Radius(), each, span=span, turn=turn) for each in starts]
    else:
        parts = 1 if math.dist(start, end) > FLAT else 2  # a wall that closes on itself would meet itself in a seam
        ends = np.linspace(first, last, parts + 1).tolist()
        pieces = [_freeform(curve, *span) for span in zip(ends[:-1], ends[1:], strict=True)]
    return reversed_loop(pieces) if edge.wrapped.Orientation() == TopAbs_Orientation.TopAbs_REVERSED else pieces


def _freeform(curve: BRepAdaptor_Curve, first: float, last: float) -> Piece:
    """Any other curve between two of OCC's own parameters."""

    def points(t: np.ndarray) -> np.ndarray:
        return np.array([curve.Value(each).Coord()[:2] for each in (first + t).tolist()])

    def left(t: np.ndarray) -> np.ndarray:
        slopes = np.array([curve.DN(each, 1).Coord()[:2] for each in (first + t).tolist()])
        return slopes[:, ::-1] * (-1, 1) / np.linalg.norm(slopes, axis=1)[:, None]

    return Piece(points, left, last - first)


def reversed_loop(loop: Sequence[Piece]) -> list[Piece]:
    """The same loop walked the other way."""

    def turned(piece: Piece) -> Piece:
        points, left = (lambda t: piece.points(piece.end - t)), (lambda t: -piece.left(piece.end - t))
        return replace(piece, points=points, left=left, turn=-piece.turn)

    return [turned(piece) for piece in reversed(loop)]


# ---- loops as polygons -----------------------------------------------------------------------------------------------


def polygon(rim: Sequence[Piece], *holes: Sequence[Piece]) -> shapely.Polygon:
    """The polygon inside a rim, less holes, by points along the curves."""
    return shapely.Polygon(_corners(rim), [_corners(hole) for hole in holes])


def _corners(loop: Sequence[Piece]) -> np.ndarray:
    sides = ((piece, 1 if piece.straight else max(8, SIDES // len(loop))) for piece in loop)
    return np.concatenate([piece.points(np.linspace(0, piece.end, n, endpoint=False)) for piece, n in sides])


def fault(shape: shapely.Polygon) -> tuple[str, str] | None:
    """(why a polygon bounds no lens, at which place); None: it does.

    Its wires may neither cross nor touch themselves or each other, and its holes lie inside the rim, none in another.
    """
    if not shape.is_valid:
        reason, _, place = shapely.is_valid_reason(shape).lower().partition("[")
        x, y = map(float, place.rstrip("]").split())
        return reason.replace("shell", "the rim"), f"({x:.4g}, {y:.4g}) mm"
    if shapely.minimum_clearance(shape) > NEAR:
        return None
    x, y = shapely.minimum_clearance_line(shape).coords[0]
    return "wires touch", f"({x:.4g}, {y:.4g}) mm"


# ---- curves over pieces ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Curve:
    """A curve in space over a piece, by the piece's t: a spline, or a level line or arc."""

    piece: Piece
    poles: np.ndarray  # (n, 3) mm; of a line or an arc: both its ends
    knots: np.ndarray | None = None  # full; None: a line or an arc


def breaks(surface: Surface, *pieces: Piece) -> np.ndarray:
    """Parameters between which pieces, all with the same parameter, run over one smooth part of a surface."""
    t = np.linspace(0.0, pieces[0].end, COARSEST + 1)
    if math.isfinite(surface.detail):  # a net: smooth between its knot lines
        t = np.unique(np.concatenate([t, *(_crossings(surface, piece) for piece in pieces)]))
    inner = t[1:-1]
    inner = inner[(np.diff(t)[:-1] > CLOSE * t[-1]) & (t[-1] - inner > CLOSE * t[-1])]
    return np.concatenate([t[:1], inner, t[-1:]])


def _crossings(surface: Surface, piece: Piece) -> np.ndarray:
    """Parameters at which a piece crosses a knot line of a net, by bisection of all crossings at once."""
    t, crossings = np.linspace(0.0, piece.end, max(*surface.shape, COARSEST) * 8 + 1), [np.empty(0)]
    places = piece.points(t)
    for axis, ((first, _), pitch) in enumerate(zip((surface.x, surface.y), surface.pitch, strict=True)):
        cell = np.floor((places[:, axis] - first) / pitch - 0.5)  # knots stand at first + pitch (k + 1/2)
        k = np.flatnonzero(np.diff(cell))  # none if the piece runs along the lines
        line, low, high = first + pitch * (np.maximum(cell[k], cell[k + 1]) + 0.5), t[k], t[k + 1]
        rising = cell[k] < cell[k + 1]
        for _ in range(BISECTIONS if len(k) else 0):
            middle = (low + high) / 2
            before = (piece.points(middle)[:, axis] < line) == rising
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        crossings.append(high)
    return np.concatenate(crossings)


def fitted(points: Points, t: np.ndarray, tolerance: float, smooth: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """(poles (n, k), full knots) of a spline with the points (and tangents) of points(t), within the tolerance.

    smooth: of an analytic curve, by a quintic if that suffices.  Else a cubic: it begins with the breaks t and halves
    each part that is further off at its middle or quarters: the error of a smooth part falls with the fourth power of
    its length, down to rounding.
    """
    if smooth:
        even = np.linspace(t[0], t[-1], 2 * SMOOTH_PARTS + 1)
        values = points(even)
        spline = make_interp_spline(even[::2], values[::2], k=5)
        if np.abs(spline(even) - values).max() <= tolerance:
            return spline.c, spline.t
    most, near = max(FINEST, len(t) << HALVINGS), tolerance / 2  # between those three points a part may be further off
    while True:
        quarters = np.append((t[:-1, None] + np.diff(t)[:, None] * np.arange(4) / 4).ravel(), t[-1])
        values = points(quarters)
        poles, knots = _hermite(t, values)
        off = np.abs(BSpline(knots, poles, 3)(quarters) - values)[:-1].reshape(len(t) - 1, -1).max(axis=1)
        if off.max() <= near:
            return poles, knots
        if len(t) > most:
            raise ValueError(
                f"the rim bends too sharply for a curve of {len(t)} parts ({off.max():.1e} mm off); "
                "move the rim, round its corners, or give the lens fewer control points"
            )
        t = np.union1d(t, (t[:-1] + t[1:])[off > near] / 2)


def _hermite(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(poles, full knots) of the piecewise cubic with the values at t, its slopes from those at quarters."""
    parts, length = sliding_window_view(values, 5, axis=0)[::4], np.diff(t)[:, None]
    first, last = 4 * parts @ ONE_SIDED / length, -4 * parts @ ONE_SIDED[::-1] / length
    slope = np.concatenate([first[:1], (last[:-1] + first[1:]) / 2, last[-1:]])
    at = values[::4]
    inner = np.stack([at[:-1] + length / 3 * slope[:-1], at[1:] - length / 3 * slope[1:]], axis=1)
    poles = np.concatenate([at[:1], inner.reshape(-1, at.shape[1]), at[-1:]])
    return poles, np.concatenate([t[[0, 0]], np.repeat(t, 2), t[[-1, -1]]])
