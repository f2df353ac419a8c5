"""A lens cut by any closed wire, and with holes, in the (u, v) plane of its exact faces: no boolean touches the net.

Walls stand on each loop; their edges with a face follow the face's own points, so that front, back and walls share
them.  A boolean with a net of 513 x 513 takes half a minute and refits the faces; this takes as long as evaluating the
cut.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from OCP.BRep import BRep_Builder
from OCP.Geom2d import Geom2d_BSplineCurve
from OCP.TopoDS import TopoDS_Face

from bstcad.cad import nurbs, walls, wires
from bstcad.cad.patches import RIM, Patch, back_patch, front_patch
from bstcad.cad.solid import (
    CAPS,
    SLIM,
    TOLERANCE,
    NamedSolid,
    check_thickness,
    face_inside,
    face_names,
    lens_solid,
    solid_of,
)
from bstcad.cad.walls import UPRIGHT, Curve, Draft, Named, Rail
from bstcad.cad.wires import Piece
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import Plane, Surface, sag
from bstcad.scene.mount import parting

if TYPE_CHECKING:
    import cadquery

PLACES = 8  # points along a piece of the rim, a cell of the back's net
INVALID = "lens: these wires cut no valid solid out of it; move them apart or make them simpler"


def trimmed_solid(
    lens: Lens, trim: cadquery.Wire | None = None, holes: Sequence = (), draft: Draft = UPRIGHT
) -> cadquery.Solid:
    """The lens inside `trim` (None: its own outline), less `holes`, as cadquery's solid.

    trim: a closed plane wire, used by its x and y; holes: such wires, or (x, y, diameter) in mm.  Walls stand along z,
    but those around the lens as `draft` says, from a plane on that lies scene.mount.LAND below the back's rim.
    ValueError in one sentence if a wire is open, crosses itself or another, or leaves the lens, or walls would meet.
    """
    return named_solid(lens, trim, holes, draft).solid


def named_solid(
    lens: Lens, trim: cadquery.Wire | None = None, holes: Sequence = (), draft: Draft = UPRIGHT
) -> NamedSolid:
    """That solid, and the name of each of its faces, in their order: "back", "front", then "rim", "bevel", "hole"."""
    import cadquery

    if trim is None and not (len(holes) or draft):
        return NamedSolid(lens_solid(lens), face_names(lens))
    lens = lens.plain()
    loops = cut_loops(lens, trim, holes)
    check_thickness(lens)
    tops, inner = [walls.on(lens.back, loop) for loop in loops], [walls.on(lens.front, loop) for loop in loops[1:]]
    rim, low = _around(lens, loops, tops[0], draft)
    named = rim + [face for each in zip(loops[1:], inner, tops[1:], strict=True) for face in walls.over(*each, "hole")]
    back = cap(lens.back, back_patch(lens), tops, along=True)
    front = cap(lens.front, front_patch(lens), [low, *inner], along=False)
    solid = solid_of([back, front, *(wall for wall, _ in named)], INVALID)
    return NamedSolid(cadquery.Solid(solid), (*CAPS, *(name for _, name in named)))


def cut_loops(lens: Lens, trim: cadquery.Wire | None, holes: Sequence) -> list[list[Piece]]:
    """The rim counterclockwise, then the holes clockwise, so that the lens lies on their left.

    ValueError if they cut no lens out.
    """
    loops = [wires.of_outline(lens.outline) if trim is None else _of_wire("trim", trim)]
    loops += [_hole(f"hole {k}", hole) for k, hole in enumerate(holes, start=1)]
    shape = wires.polygon(*loops)
    x, y = np.array(shape.exterior.coords).T
    outside = ~lens.outline.contains(*(torch.from_numpy(p * (1 - 1e-9)) for p in (x, y))).numpy()
    if outside.any():
        raise ValueError(
            f"trim: the wire leaves the lens at ({x[outside][0]:.4g}, {y[outside][0]:.4g}) mm; draw it inside"
        )
    if fault := wires.fault(shape):
        reason, place = fault
        raise ValueError(
            f"trim or holes: {reason} near {place}; draw each wire simple, and the holes inside the rim and apart"
        )
    turned = [shape.exterior.is_ccw, *(not hole.is_ccw for hole in shape.interiors)]
    return [loop if right else wires.reversed_loop(loop) for loop, right in zip(loops, turned, strict=True)]


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


def cap(surface: Surface, patch: Patch, rails: Sequence[Rail], along: bool) -> TopoDS_Face:
    """The back or the front inside the first rail and outside the others; along: seen from outside they follow it."""
    loops = [rail.along() if along else rail.against() for rail in rails]
    face = face_inside(patch.surface, patch.outward, *loops)
    for rail in rails if patch.uv is not None else ():
        for curve, edge in zip(rail.curves, rail.edges, strict=True):
            BRep_Builder().UpdateEdge(edge, _image(surface, patch, curve), face, TOLERANCE)
    return face


def _image(surface: Surface, patch: Patch, curve: Curve) -> Geom2d_BSplineCurve:
    """The curve in the face's parameter plane, by the same parameter."""

    def points(t: np.ndarray) -> np.ndarray:
        return patch.uv(*curve.piece.points(t).T)

    t = wires.breaks(surface, curve.piece) if curve.knots is None else np.unique(curve.knots)
    here, there = (np.diff(each, axis=0) for each in (curve.piece.points(t), points(t)))
    scale = np.linalg.norm(there, axis=1).max() / np.linalg.norm(here, axis=1).max()
    return nurbs.bspline_curve_2d(*wires.fitted(points, t, RIM * scale))


def _around(lens: Lens, loops: list[list[Piece]], top: Rail, draft: Draft) -> tuple[list[Named], Rail]:
    """The walls over the rim, the first loop, from the back's edge down to the front, and their edge there."""
    if not draft.angle:
        return walls.down(lens.front, loops, top, above=lens.back, draft=draft)
    plane = Plane(_parting(lens, loops[0]))
    line = walls.on(plane, loops[0])
    leaning, low = walls.down(lens.front, loops, line, above=plane, draft=draft)
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
