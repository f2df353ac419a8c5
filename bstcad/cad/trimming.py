"""A lens cut by any closed wire, and with holes, in the (u, v) plane of its exact faces: no boolean touches the net.

Each loop becomes one ring of walls; where a wall meets a face, the edge follows the face's own points, so that front,
back and walls share it.  A boolean with a net of 513 x 513 takes half a minute and refits what it cuts; this takes as
long as evaluating the cut.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from OCP.BRep import BRep_Builder
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge
from OCP.BRepCheck import BRepCheck_Analyzer
from OCP.Geom2d import Geom2d_BSplineCurve
from OCP.TopoDS import TopoDS_Edge, TopoDS_Face, TopoDS_Solid, TopoDS_Vertex

from bstcad.cad import faces, images, loops, nurbs
from bstcad.cad.draft import Ceiling, Lean
from bstcad.cad.fitting import breaks, fitted
from bstcad.cad.leaning import Foot, foot
from bstcad.cad.loops import Piece
from bstcad.cad.solid import CAPS, SLIM, TOLERANCE, check_thickness, face_inside, solid_of, vertex
from bstcad.cad.walls import Rail, Ring, between, level, on_wall
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import Surface, sag
from bstcad.scene.mount import parting

if TYPE_CHECKING:
    import cadquery

DIFFERENCE = 1e-6  # of a piece: over so much of it the slope of its image is a difference quotient
PLACES = 8  # along an edge, a cell of the back's net
UPRIGHT = Lean()


def trimmed_solid(
    lens: Lens, trim: cadquery.Wire | None = None, holes: Sequence = (), lean: Lean = UPRIGHT
) -> cadquery.Solid:
    """The lens inside `trim` (None: its own outline), less `holes`, as cadquery's solid.

    trim: a closed plane wire, used by its x and y; holes: such wires, or (x, y, diameter) in mm.  Walls stand along z,
    but those around the lens as `lean` says, from a plane on that lies scene.mount.LAND below the back's rim.
    ValueError in one sentence if a wire is open, crosses itself or another, or leaves the lens, or walls would meet.
    """
    return named_solid(lens, trim, holes, lean)[0]


def named_solid(
    lens: Lens, trim: cadquery.Wire | None = None, holes: Sequence = (), lean: Lean = UPRIGHT
) -> tuple[cadquery.Solid, tuple[str, ...]]:
    """The same, and what each of its faces is, in their order: "back", "front", then "rim", "bevel" and "hole"."""
    import cadquery

    lens = lens.plain()
    solid, walls = _shape(lens, cut_loops(lens, trim, holes), lean)
    return cadquery.Solid(solid), (*CAPS, *walls)


def cut_loops(lens: Lens, trim: cadquery.Wire | None, holes: Sequence) -> list[list[Piece]]:
    """The rim and the holes, each with the lens on its left: the rim counterclockwise, holes clockwise."""
    outer = loops.of_outline(lens.outline) if trim is None else _trim(trim)
    return _checked(lens, outer, [_hole(k, hole) for k, hole in enumerate(holes, start=1)])


def _hole(k: int, hole: cadquery.Wire | Sequence[float]) -> list[Piece]:
    try:
        if not isinstance(hole, Sequence):
            return loops.of_wire(hole)
    except ValueError as error:
        raise ValueError(f"hole {k}: {error}") from error
    if len(hole) != 3 or not all(isinstance(each, numbers.Real) and math.isfinite(each) for each in hole):
        raise ValueError(f"hole {k}: {hole} is not (x, y, diameter); give three numbers in mm, or a closed wire")
    x, y, diameter = map(float, hole)
    if not diameter > 0:
        raise ValueError(f"hole {k}: a diameter of {diameter:g} mm; give one above zero")
    return loops.circle(x, y, diameter / 2)


def _trim(wire: cadquery.Wire) -> list[Piece]:
    try:
        return loops.of_wire(wire)
    except ValueError as error:
        raise ValueError(f"trim: {error}") from error


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
        if place := loops.touching(one, one):
            raise ValueError(f"{name}: the wire touches itself at ({place[0]:.4g}, {place[1]:.4g}) mm; draw it simple")
        for other in (rim, *around)[:k]:
            if place := loops.crossing(one, other):
                raise ValueError(f"{name}: crosses another wire near ({place[0]:.4g}, {place[1]:.4g}) mm; move it")
            if place := loops.touching(one, other) or loops.touching(other, one):
                raise ValueError(f"{name}: touches another wire at ({place[0]:.4g}, {place[1]:.4g}) mm; move it")
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
        places = breaks(self.surface, piece)
        places, poles, full = fitted(lambda t: self._points(piece, t), places, faces.RIM)
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
        _, poles, full = fitted(points, places, faces.RIM * there / here)
        return nurbs.bspline_curve_2d(poles, full)

    def _points(self, piece: Piece, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) of the face over a piece and their derivatives in t."""
        places, along = piece.points(t)
        x, y = (torch.from_numpy(np.ascontiguousarray(p)) for p in places.T)
        z, z_x, z_y = (p.numpy() for p in self.surface.sag_and_slope(x, y))
        return np.column_stack([places, z]), np.column_stack([along, z_x * along[:, 0] + z_y * along[:, 1]])


def sides(lens: Lens) -> tuple[Side, Side]:
    """Back and front.  Their patches reach the lens's outline, inside which every loop lies."""
    back, front = (
        Side(face, patch, images.of_face(face, lens.outline))
        for face, patch in ((lens.back, faces.back_patch(lens)), (lens.front, faces.front_patch(lens)))
    )
    return back, front


def _shape(lens: Lens, loops_of: list[list[Piece]], lean: Lean) -> tuple[TopoDS_Solid, list[str]]:
    """The solid, and the names of its walls."""
    check_thickness(lens)
    back, front = sides(lens)
    rings = [Ring.of(loop) for loop in loops_of]
    tops, inner = [back.rail(ring) for ring in rings], [front.rail(ring) for ring in rings[1:]]
    rim = _around(lens, front, rings, tops[0], lean)
    walls = [*rim.walls]
    for ring, low, high in zip(rings[1:], inner, tops[1:], strict=True):
        walls += [(wall, "hole") for wall in between(ring, low, high)]
    caps = [back.cap(rings, tops, along=True), front.cap([rim.ring, *rings[1:]], [rim.rail, *inner], along=False)]
    solid = solid_of([*caps, *(wall for wall, _ in walls)])
    if not BRepCheck_Analyzer(solid).IsValid():
        raise ValueError("lens: these wires cut no valid solid out of it; move them apart or make them simpler")
    return solid, [name for _, name in walls]


def _around(lens: Lens, front: Side, rings: list[Ring], top: Rail, lean: Lean) -> Foot:
    """The walls over the rim, the first ring, from the back's edge down to the front."""
    if not lean.draft:
        return down(front, rings, top, lambda places: sag(lens.back, *places.T), lean)
    rim, z = rings[0], _parting(lens, rings[0])
    line = level(rim, z)
    found = down(front, rings, line, lambda places: np.full(len(places), z), lean)
    return Foot([*((wall, "rim") for wall in between(rim, line, top)), *found.walls], found.ring, found.rail)


def down(front: Side, rings: Sequence[Ring], high: Rail, ceiling: Ceiling, lean: Lean) -> Foot:
    """The walls over the rim, the first ring, from a rail down to the front; see leaning.foot."""
    if lean:
        return foot(front.surface, rings, high, ceiling, lean)
    low = front.rail(rings[0])
    return Foot([(wall, "rim") for wall in between(rings[0], low, high)], rings[0], low)


def _parting(lens: Lens, rim: Ring) -> float:
    """z of the plane from which walls lean (mm): below the back's rim, and above the front's."""
    count = PLACES * lens.back.m  # along each piece, some in each cell of the net
    x, y = np.concatenate([piece.points(np.linspace(0.0, piece.end, count))[0] for piece in rim.pieces]).T
    low, high = sag(lens.back, x, y).min(), sag(lens.front, x, y).max()
    if not low - high > SLIM:
        raise ValueError(
            f"draft: the back's rim comes down to z = {low:.4g} mm, and the front's rises to {high:.4g} mm, so that no "
            "plane between them divides the wall; leave it out, or make the lens thicker at its edge"
        )
    return parting(lens.back, lens.front, x, y)
