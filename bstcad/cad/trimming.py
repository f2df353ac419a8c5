"""A lens cut by any closed wire, and with holes, in the (u, v) plane of its exact faces: no boolean touches the net.

Walls stand on each loop; their edges with a face follow the face's own points, so that front, back and walls share
them.  A boolean with a net of 513 x 513 takes half a minute and refits the faces; this takes as long as evaluating the
cut.
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
from OCP.BRepCheck import BRepCheck_Analyzer
from OCP.Geom2d import Geom2d_BSplineCurve
from OCP.TopoDS import TopoDS_Face, TopoDS_Solid

from bstcad.cad import nurbs, patches, uv_maps, walls, wires
from bstcad.cad.draft import UPRIGHT, Draft
from bstcad.cad.solid import CAPS, SLIM, TOLERANCE, check_thickness, face_inside, solid_of
from bstcad.cad.walls import Curve, Named, Rail
from bstcad.cad.wires import Piece
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import Surface, sag
from bstcad.scene.mount import parting

if TYPE_CHECKING:
    import cadquery

PLACES = 8  # points along a piece of the rim, a cell of the back's net


def trimmed_solid(
    lens: Lens, trim: cadquery.Wire | None = None, holes: Sequence = (), draft: Draft = UPRIGHT
) -> cadquery.Solid:
    """The lens inside `trim` (None: its own outline), less `holes`, as cadquery's solid.

    trim: a closed plane wire, used by its x and y; holes: such wires, or (x, y, diameter) in mm.  Walls stand along z,
    but those around the lens as `draft` says, from a plane on that lies scene.mount.LAND below the back's rim.
    ValueError in one sentence if a wire is open, crosses itself or another, or leaves the lens, or walls would meet.
    """
    return named_solid(lens, trim, holes, draft)[0]


def named_solid(
    lens: Lens, trim: cadquery.Wire | None = None, holes: Sequence = (), draft: Draft = UPRIGHT
) -> tuple[cadquery.Solid, tuple[str, ...]]:
    """That solid, and the name of each of its faces, in their order: "back", "front", then "rim", "bevel", "hole"."""
    import cadquery

    lens = lens.plain()
    solid, names = _shape(lens, cut_loops(lens, trim, holes), draft)
    return cadquery.Solid(solid), (*CAPS, *names)


def cut_loops(lens: Lens, trim: cadquery.Wire | None, holes: Sequence) -> list[list[Piece]]:
    """The rim and the holes, each with the lens on its left: the rim counterclockwise, holes clockwise."""
    outer = wires.of_outline(lens.outline) if trim is None else _of_wire("trim", trim)
    return _checked(lens, [outer, *(_hole(f"hole {k}", hole) for k, hole in enumerate(holes, start=1))])


def _of_wire(name: str, wire: cadquery.Wire) -> list[Piece]:
    try:
        return wires.of_wire(wire)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _hole(name: str, hole: cadquery.Wire | Sequence[float]) -> list[Piece]:
    if not isinstance(hole, Sequence):
        return _of_wire(name, hole)
    if len(hole) != 3 or not all(isinstance(each, numbers.Real) and math.isfinite(each) for each in hole):
        raise ValueError(f"{name}: {hole} is not (x, y, diameter); give three numbers in mm, or a closed wire")
    x, y, diameter = map(float, hole)
    if not diameter > 0:
        raise ValueError(f"{name}: a diameter of {diameter:g} mm; give one above zero")
    return wires.circle(x, y, diameter / 2)


def _checked(lens: Lens, loops: list[list[Piece]]) -> list[list[Piece]]:
    """The loops, each turned so that the lens lies on its left; ValueError if they cut no lens out."""
    rim, *holes = polygons = [wires.polygon(loop) for loop in loops]
    corners = wires.corners(rim)
    outside = ~lens.outline.contains(*torch.from_numpy(corners.T * (1 - 1e-9))).numpy()
    if outside.any():
        x, y = corners[outside][0]
        raise ValueError(f"trim: the wire leaves the lens at ({x:.4g}, {y:.4g}) mm; draw it inside")
    for k, shape in enumerate(polygons):
        name = f"hole {k}" if k else "trim"
        if point := wires.meets_itself(shape):
            raise ValueError("{}: the wire crosses or touches itself near ({:.4g}, {:.4g}) mm; draw it simple".format(
                name, *point))  # fmt: skip
        for other in polygons[:k]:
            if point := wires.meeting(shape, other):
                raise ValueError("{}: crosses or touches another wire near ({:.4g}, {:.4g}) mm; move it".format(
                    name, *point))  # fmt: skip
        if k and not rim.contains(shape):
            x, y = wires.corners(shape)[0]
            raise ValueError(f"{name}: lies outside the rim, at ({x:.4g}, {y:.4g}) mm; move it inside")
        if k and any(shape.intersects(other) for other in holes[: k - 1]):
            raise ValueError(f"{name}: lies in another hole or around one; leave one of them out")
    return [
        list(loop) if shape.exterior.is_ccw == (k == 0) else wires.reversed_loop(loop)
        for k, (loop, shape) in enumerate(zip(loops, polygons, strict=True))
    ]


@dataclass(frozen=True)
class OpticalFace:
    """The back or the front as a surface of OCC."""

    surface: Surface
    patch: patches.Patch
    uv: uv_maps.Image | None  # None: a plane needs no images

    def inside(self, rails: Sequence[Rail], along: bool) -> TopoDS_Face:
        """The face inside the first rail and outside the others; along: seen from outside, they follow their loops."""
        loops = [rail.along() if along else rail.against() for rail in rails]
        face = face_inside(self.patch.surface, self.patch.outward, *loops)
        for rail in rails if self.uv is not None else ():
            for curve, edge in zip(rail.curves, rail.edges, strict=True):
                BRep_Builder().UpdateEdge(edge, self._image(curve), face, TOLERANCE)
        return face

    def _image(self, curve: Curve) -> Geom2d_BSplineCurve:
        """The curve in the face's parameter plane, by the same parameter."""

        def points(t: np.ndarray) -> np.ndarray:
            return self.uv(*curve.piece.points(t).T)

        t = wires.breaks(self.surface, curve.piece) if curve.knots is None else np.unique(curve.knots)
        here, there = (np.diff(each, axis=0) for each in (curve.piece.points(t), points(t)))
        scale = np.linalg.norm(there, axis=1).max() / np.linalg.norm(here, axis=1).max()
        return nurbs.bspline_curve_2d(*wires.fitted(points, t, patches.RIM * scale))


def sides(lens: Lens) -> tuple[OpticalFace, OpticalFace]:
    """Back and front.  Their patches reach the lens's outline, inside which every loop lies."""
    back, front = (
        OpticalFace(face, patch, uv_maps.of_face(face, lens.outline))
        for face, patch in ((lens.back, patches.back_patch(lens)), (lens.front, patches.front_patch(lens)))
    )
    return back, front


def _shape(lens: Lens, loops: list[list[Piece]], draft: Draft) -> tuple[TopoDS_Solid, list[str]]:
    """The solid, and the names of its walls."""
    check_thickness(lens)
    back, front = sides(lens)
    tops, inner = [walls.on(lens.back, loop) for loop in loops], [walls.on(lens.front, loop) for loop in loops[1:]]
    rim, low = _around(lens, loops, tops[0], draft)
    named = rim + [face for each in zip(loops[1:], inner, tops[1:], strict=True) for face in walls.over(*each, "hole")]
    caps = [back.inside(tops, along=True), front.inside([low, *inner], along=False)]
    solid = solid_of([*caps, *(wall for wall, _ in named)])
    if not BRepCheck_Analyzer(solid).IsValid():
        raise ValueError("lens: these wires cut no valid solid out of it; move them apart or make them simpler")
    return solid, [name for _, name in named]


def _around(lens: Lens, loops: list[list[Piece]], top: Rail, draft: Draft) -> tuple[list[Named], Rail]:
    """The walls over the rim, the first loop, from the back's edge down to the front, and their edge there."""
    if not draft.angle:
        return walls.down(lens.front, loops, top, lambda places: sag(lens.back, *places.T), draft)
    z = _parting(lens, loops[0])
    line = walls.level(loops[0], z)
    leaning, low = walls.down(lens.front, loops, line, lambda places: np.full(len(places), z), draft)
    return walls.over(loops[0], line, top) + leaning, low


def _parting(lens: Lens, rim: Sequence[Piece]) -> float:
    """z of the plane from which walls lean (mm): below the back's rim, and above the front's."""
    x, y = rim_points(lens, rim)
    low, high = sag(lens.back, x, y).min(), sag(lens.front, x, y).max()
    if not low - high > SLIM:
        raise ValueError(
            f"draft: the back's rim comes down to z = {low:.4g} mm, and the front's rises to {high:.4g} mm, so that no "
            "plane between them divides the wall; leave it out, or make the lens thicker at its edge"
        )
    return parting(lens.back, lens.front, x, y)


def rim_points(lens: Lens, rim: Sequence[Piece]) -> np.ndarray:
    """x and y (2, n) of points along a rim (mm), several in each cell of the back's net."""
    return np.concatenate([piece.points(np.linspace(0.0, piece.end, PLACES * lens.back.m)) for piece in rim]).T
