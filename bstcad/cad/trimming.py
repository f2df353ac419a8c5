"""A lens cut by any closed wire, and with holes, in the (u, v) plane of its exact faces: no boolean touches the net.

Each loop becomes one ring of walls; where a wall meets a face, the edge follows the face's own points, so that front,
back and walls share it.  A boolean with a net of 513 x 513 takes half a minute and refits what it cuts; this takes as
long as evaluating the cut.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from OCP.BRep import BRep_Builder
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge
from OCP.BRepCheck import BRepCheck_Analyzer
from OCP.Geom2d import Geom2d_BSplineCurve
from OCP.TopoDS import TopoDS_Edge, TopoDS_Face, TopoDS_Solid, TopoDS_Vertex
from scipy.interpolate import BSpline

from bstcad.cad import faces, images, loops, nurbs
from bstcad.cad.loops import Piece
from bstcad.cad.solid import CAPS, TOLERANCE, check_thickness, face_inside, solid_of, vertex
from bstcad.cad.walls import Rail, Ring, between, on_wall
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import Surface, sag

if TYPE_CHECKING:
    import cadquery

COARSEST = 64  # parts of a piece, at least
FINEST = 1 << 14
DIFFERENCE = 1e-6  # of a piece: over so much of it the slope of its image is a difference quotient
CLOSE = 1e-7  # of a piece: two breaks nearer than that are one
STEPS = 50  # of bisection to where a piece crosses a knot line


def trimmed_solid(lens: Lens, trim: cadquery.Wire | None = None, holes: Sequence = ()) -> cadquery.Solid:
    """The lens inside `trim` (None: its own outline), less `holes`, as cadquery's solid.

    trim: a closed plane wire, used by its x and y; holes: such wires, or (x, y, diameter) in mm.  Walls stand along z.
    ValueError in one sentence if a wire is open, crosses itself or another, or leaves the lens.
    """
    return named_solid(lens, trim, holes)[0]


def named_solid(
    lens: Lens, trim: cadquery.Wire | None = None, holes: Sequence = ()
) -> tuple[cadquery.Solid, tuple[str, ...]]:
    """The same, and what each of its faces is, in their order: "back", "front", then "rim" and "hole" for the walls."""
    import cadquery

    lens = lens.plain()
    rim, *others = cut_loops(lens, trim, holes)
    walls = ["rim"] * len(rim) + ["hole"] * sum(map(len, others))
    return cadquery.Solid(_shape(lens, [rim, *others])), (*CAPS, *walls)


def cut_loops(lens: Lens, trim: cadquery.Wire | None, holes: Sequence) -> list[list[Piece]]:
    """The rim and the holes, each with the lens on its left: the rim counterclockwise, holes clockwise."""
    outer = loops.of_outline(lens.outline) if trim is None else loops.of_wire(trim)
    return _checked(lens, outer, [_hole(k, hole) for k, hole in enumerate(holes, start=1)])


def _hole(k: int, hole: cadquery.Wire | tuple[float, float, float]) -> list[Piece]:
    if not isinstance(hole, tuple):
        return loops.of_wire(hole)
    x, y, diameter = hole
    if not diameter > 0:
        raise ValueError(f"hole {k}: a diameter of {diameter:g} mm; give one above zero")
    return loops.circle(x, y, diameter / 2)


def _checked(lens: Lens, outer: list[Piece], inner: list[list[Piece]]) -> list[list[Piece]]:
    rim, *around = (loops.polygon(loop) for loop in (outer, *inner))
    x, y = (torch.from_numpy(p * (1 - 1e-9)) for p in rim.T)
    outside = ~lens.outline.contains(x, y).numpy()
    if outside.any():
        raise ValueError(
            "trim: the wire leaves the lens at ({:.4g}, {:.4g}) mm; draw it inside".format(*rim[outside][0])
        )
    for k, one in enumerate((rim, *around)):
        name = f"hole {k}" if k else "trim"
        if place := loops.crossing(one, one):
            raise ValueError(
                f"{name}: the wire crosses itself near ({place[0]:.4g}, {place[1]:.4g}) mm; draw it simple"
            )
        for other in (rim, *around)[:k]:
            if place := loops.crossing(one, other):
                raise ValueError(f"{name}: crosses another wire near ({place[0]:.4g}, {place[1]:.4g}) mm; move it")
        if k and not loops.encloses(rim, one[0]):
            raise ValueError(f"{name}: lies outside the rim, at ({one[0][0]:.4g}, {one[0][1]:.4g}) mm; move it inside")
        if k and any(loops.encloses(a, b[0]) for o in around[: k - 1] for a, b in ((o, one), (one, o))):
            raise ValueError(f"{name}: lies in another hole or around one; leave one of them out")
    turns = [loops.area(polygon) > 0 for polygon in (rim, *around)]
    wanted = [True] + [False] * len(inner)
    return [
        list(loop) if turn == want else loops.reversed_loop(loop)
        for loop, turn, want in zip((outer, *inner), turns, wanted, strict=True)
    ]


@dataclass(frozen=True)
class Side:
    """One of the two optical faces, and how curves are put on it."""

    surface: Surface
    patch: faces.Patch
    uv: images.Image | None  # None: a plane needs no images

    def rail(self, ring: Ring) -> Rail:
        """Where the walls over a ring meet it."""
        places = [piece.at(0.0) for piece in ring.pieces]
        heights = tuple(float(sag(self.surface, x, y)) for x, y in places)
        corners = tuple(vertex(x, y, z) for (x, y), z in zip(places, heights, strict=True))
        around = zip(ring.pieces, corners, corners[1:] + corners[:1], strict=True)
        edges, breaks, on_walls = zip(*(self._edge(*each) for each in around), strict=True)
        return Rail(edges, corners, heights, on_walls, breaks)

    def cap(self, rings: Sequence[Ring], rails: Sequence[Rail], along: bool) -> TopoDS_Face:
        """The face inside the first rail and outside the others, which run `along` the rings seen from outside."""
        loops = [rail.along() if along else rail.against() for rail in rails]
        face = face_inside(self.patch.surface, self.patch.outward, *loops)
        if self.uv is not None:
            for ring, rail in zip(rings, rails, strict=True):
                for piece, edge, breaks in zip(ring.pieces, rail.edges, rail.breaks, strict=True):
                    BRep_Builder().UpdateEdge(edge, self._image(piece, breaks), face, TOLERANCE)
        return face

    def _edge(
        self, piece: Piece, start: TopoDS_Vertex, end: TopoDS_Vertex
    ) -> tuple[TopoDS_Edge, np.ndarray, Geom2d_BSplineCurve | None]:
        """(the edge over a piece, the breaks of its curve, its image on the wall)."""
        places = smooth_parts(self.surface, piece)
        places, poles, full = _fitted(lambda t: self._points(piece, t), places, faces.RIM)
        curve = nurbs.bspline_curve(poles, full)
        edge = BRepBuilderAPI_MakeEdge(curve, start, end, 0.0, piece.end).Edge()
        return edge, places, on_wall(piece, places, poles[:, 2])

    def _image(self, piece: Piece, places: np.ndarray) -> Geom2d_BSplineCurve:
        """The same curve in the face's own plane, by the same parameter."""

        def points(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            after, before = (np.clip(t + s * DIFFERENCE * piece.end, 0.0, piece.end) for s in (1, -1))
            at, ahead, behind = (self.uv(*piece.points(p)[0].T) for p in (t, after, before))
            return at, (ahead - behind) / (after - before)[:, None]

        there, here = (np.linalg.norm(slopes, axis=1).max() for slopes in (points(places)[1], piece.points(places)[1]))
        _, poles, full = _fitted(points, places, faces.RIM * there / here)
        return nurbs.bspline_curve_2d(poles, full)

    def _points(self, piece: Piece, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) of the face over a piece and their derivatives in t."""
        places, along = piece.points(t)
        x, y = (torch.from_numpy(np.ascontiguousarray(p)) for p in places.T)
        z, z_x, z_y = (p.numpy() for p in self.surface.sag_and_slope(x, y))
        return np.column_stack([places, z]), np.column_stack([along, z_x * along[:, 0] + z_y * along[:, 1]])


def smooth_parts(surface: Surface, piece: Piece) -> np.ndarray:
    """Parameters between which a piece is short and meets no knot line of a surface."""
    places = np.linspace(0.0, piece.end, COARSEST + 1)
    if math.isfinite(surface.detail):  # a net: smooth between its knot lines
        places = _thinned(np.union1d(places, _crossings(surface, piece, places)))
    return places


def _crossings(surface: BSplineSurface, piece: Piece, places: np.ndarray) -> np.ndarray:
    """Parameters at which a piece crosses a knot line of a net, by bisection, all at once."""
    span = max(surface.m, COARSEST) * 8
    t = np.union1d(places, np.linspace(0.0, piece.end, span + 1))
    at, found = piece.points(t)[0], []
    for axis, ((first, _), pitch) in enumerate(zip((surface.x, surface.y), surface.pitch, strict=True)):
        cell = np.floor((at[:, axis] - first) / pitch - 0.5)  # knots stand at first + pitch (k + 1/2)
        crossed = np.flatnonzero(np.diff(cell) != 0)
        line = first + pitch * (np.maximum(cell[crossed], cell[crossed + 1]) + 0.5)
        low, high = t[crossed], t[crossed + 1]
        rising = at[crossed, axis] < line
        for _ in range(STEPS):
            middle = (low + high) / 2
            before = (piece.points(middle)[0][:, axis] < line) == rising
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        found.append((low + high) / 2)
    return np.concatenate(found)


def _thinned(t: np.ndarray) -> np.ndarray:
    """Ascending parameters without those that stand too near to the one before; both ends stay."""
    inner = t[1:-1]
    inner = inner[(np.diff(t)[:-1] > CLOSE * t[-1]) & (t[-1] - inner > CLOSE * t[-1])]
    return np.concatenate([t[:1], inner, t[-1:]])


def _fitted(
    points: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], places: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(breaks, poles, full knots) of the cubic through points(t) with their derivatives, as near as the tolerance.

    It begins with the breaks `places`, and halves each part that is further off at its middle or quarters.
    """
    while True:
        poles, full = _hermite(places, *points(places))
        between = np.concatenate([places[:-1] + f * np.diff(places) for f in (0.25, 0.5, 0.75)])
        off = np.abs(BSpline(full, poles, 3)(between) - points(between)[0]).max(axis=1)
        if off.max() <= tolerance:
            return places, poles, full
        if len(places) > FINEST:
            raise ValueError(f"the cut bends too sharply for its curve ({off.max():.1e} mm off); smooth the wire")
        worst = np.unique(np.tile(np.arange(len(places) - 1), 3)[off > tolerance])
        places = np.union1d(places, (places[worst] + places[worst + 1]) / 2)


def _hermite(t: np.ndarray, point: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(poles, full knots) of the piecewise cubic with these points and derivatives at t."""
    third = np.diff(t)[:, None] / 3
    inner = np.stack([point[:-1] + third * slope[:-1], point[1:] - third * slope[1:]], axis=1)
    poles = np.concatenate([point[:1], inner.reshape(-1, point.shape[1]), point[-1:]])
    return poles, np.concatenate([t[[0, 0]], np.repeat(t, 2), t[[-1, -1]]])


def sides(lens: Lens) -> tuple[Side, Side]:
    """Back and front.  Their patches reach the lens's outline, inside which every loop lies."""
    back, front = (
        Side(face, patch, images.of_face(face, lens.outline))
        for face, patch in ((lens.back, faces.back_patch(lens)), (lens.front, faces.front_patch(lens)))
    )
    return back, front


def _shape(lens: Lens, loops_of: list[list[Piece]]) -> TopoDS_Solid:
    check_thickness(lens)
    back, front = sides(lens)
    rings = [Ring.of(loop) for loop in loops_of]
    tops, bottoms = ([side.rail(ring) for ring in rings] for side in (back, front))
    around = (between(*each) for each in zip(rings, bottoms, tops, strict=True))
    caps = [back.cap(rings, tops, along=True), front.cap(rings, bottoms, along=False)]
    solid = solid_of([*caps, *(wall for walls in around for wall in walls)])
    if not BRepCheck_Analyzer(solid).IsValid():
        raise ValueError("lens: these wires cut no valid solid out of it; move them apart or make them simpler")
    return solid
