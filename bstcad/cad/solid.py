"""A lens as one valid solid: two caps, which lie on its exact faces, and walls over closed wires between them.

The wires are the lens's own outline, or any other inside it, and holes.  Each edge is built once and shared by the two
faces that meet in it, in space and in the (u, v) planes of these faces.  No boolean and no sewing: both loosen the
edges or refit the faces, and a boolean with a net of 513 x 513 takes half a minute.
"""

from __future__ import annotations

import cmath
import math
import numbers
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from OCP.BRep import BRep_Builder
from OCP.Geom2d import Geom2d_Circle, Geom2d_Curve
from OCP.gp import gp_Ax2d, gp_Dir2d, gp_Pnt2d
from OCP.TopoDS import TopoDS_Face, TopoDS_Solid

from bstcad.cad import patches, walls, wires
from bstcad.cad.patches import Patch, back_patch, front_patch, level_patch
from bstcad.cad.walls import RIM, SLIM, TOLERANCE, UPRIGHT, Draft, Named, Rail, face_inside, solid_of
from bstcad.cad.wires import Curve, Piece
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.sides import as_pair, coarser
from bstcad.optics.surfaces import Plane, sag
from bstcad.scene.mount import parting

if TYPE_CHECKING:
    import cadquery

SPARE = 4  # control points a side beyond the rim: two spans, and two more until x(u) is linear
PLACES = 8  # points along a piece of the rim, a cell of the back's net
EXACT = 1e-12  # of an image's size: one that leaves a line or a circle by less is that
SAMPLES = 65  # points of an image that are compared with a line and a circle
INVALID = (
    "lens: front, back and walls bound no valid solid; check that the back lies above the front, and move wires apart "
    "or make them simpler"
)


class NamedSolid(NamedTuple):
    """A solid and the names of its faces, in its own order."""

    solid: cadquery.Solid
    faces: tuple[str, ...]  # "back", "front", "underside", "rim", "bevel", "hole" or "flange"


def lens_solid(
    lens: Lens, trim: cadquery.Wire | None = None, holes: Sequence = (), draft: Draft = UPRIGHT
) -> cadquery.Solid:
    """The lens inside `trim` (None: its own outline), less `holes`, as cadquery's solid, its faces oriented outwards.

    trim: a closed plane wire, used by its x and y; holes: such wires, or (x, y, diameter) in mm.  Walls stand along z,
    but those around the lens as `draft` says, from a plane on that lies scene.mount.LAND below the back's rim.
    ValueError in one sentence if a wire is open, crosses itself or another, or leaves the lens, or walls would meet, or
    no valid solid exists.
    """
    return named_solid(lens, trim, holes, draft).solid


def named_solid(
    lens: Lens, trim: cadquery.Wire | None = None, holes: Sequence = (), draft: Draft = UPRIGHT
) -> NamedSolid:
    """That solid, and the name of each of its faces, in their order: "back", "front", then the others."""
    import cadquery

    solid, names = lens_shape(lens, cut_loops(lens, trim, holes), draft)
    return NamedSolid(cadquery.Solid(solid), names)


def lens_shape(
    lens: Lens, loops: Sequence[list[Piece]] | None = None, draft: Draft = UPRIGHT
) -> tuple[TopoDS_Solid, tuple[str, ...]]:
    """The same without cadquery, whose import takes a second; loops: see `cut_loops` (None: the lens's own outline)."""
    lens, loops = lens.plain(), loops or [wires.of_outline(lens.outline)]
    check_thickness(lens)
    back, below = back_patch(lens), lens.front.around
    tops, inner = [walls.on(lens.back, loop) for loop in loops], [walls.on(below, loop) for loop in loops[1:]]
    named, low = _around(lens, loops, tops[0], draft)
    for each in zip(loops[1:], inner, tops[1:], strict=True):
        named += walls.over(*each, "hole")
    caps = [(cap(back, tops, along=True), "back"), *front_caps(lens, [low, *inner])]
    faces, names = zip(*caps, *named, strict=True)
    return solid_of(faces, INVALID), names


def coarse_copy(lens: Lens, m: int) -> Lens:
    """The lens with a back of m control points along its longer side, for viewers, which triangulate faces first.

    Each is as high as the back itself at its (x, y).  This follows relief wider than a few cells of the coarse net, and
    smooths the rest (de Boor 1978, Schoenberg's operator); the copy does not steer light as the lens does.
    """
    lens = lens.plain()
    if m >= max(lens.back.shape):
        return lens
    stretch = (m - 1) / (m - 1 - 2 * SPARE)
    reach = (max(-low, high) for low, high in (lens.back.x, lens.back.y))
    ends = [half if end <= half else stretch * half for half, end in zip(lens.outline.half_extent, reach, strict=True)]
    spans = zip(ends, as_pair(coarser(lens.back.shape, m)), (lens.back.x, lens.back.y), strict=True)
    x, y = np.meshgrid(*(np.clip(np.linspace(-end, end, k), *span) for end, k, span in spans), indexing="ij")
    heights = torch.from_numpy(sag(lens.back, x, y) - lens.back.z)
    return replace(lens, back=BSplineSurface(lens.back.z, heights, *((-end, end) for end in ends)))


def check_thickness(lens: Lens) -> None:
    """The back must lie above the front everywhere; OCC's own check sees no face cross another.

    Below SLIM the lens has no body left for the edges' tolerance.  A spline lies nowhere below its lowest control
    point, which settles it for most lenses; for the others, three points a knot span each way.
    """
    lowest, highest = lens.back.sags(lens.outline)[0], lens.front.sags(lens.outline)[1]
    if lens.back.z + lowest - (lens.front.z + highest) > SLIM:
        return
    a, b = lens.outline.half_extent
    axes = (
        torch.linspace(-end, end, 3 * (count - 2) + 1, dtype=torch.float64)
        for end, count in zip((a, b), lens.back.shape, strict=True)
    )
    x, y = torch.meshgrid(*axes, indexing="ij")
    inside = lens.outline.contains(x, y)
    x, y = x[inside].numpy(), y[inside].numpy()
    thickness = sag(lens.back, x, y) - sag(lens.front, x, y)
    i = int(thickness.argmin())
    if not thickness[i] > SLIM:
        raise ValueError(
            f"lens: the back lies {thickness[i]:g} mm above the front at ({x[i]:g}, {y[i]:g}) mm; move the front down"
        )


# ---- the wires -----------------------------------------------------------------------------------------------------


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
    if (dome := lens.front.outline) and not shape.contains(wires.polygon(wires.of_outline(dome))):
        raise ValueError(
            f"trim or holes: a wire crosses the front, {dome.words}, or lies inside it; draw it in the plane around it"
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


# ---- caps and walls ------------------------------------------------------------------------------------------------


def cap(patch: Patch, rails: Sequence[Rail], along: bool) -> TopoDS_Face:
    """The back or the front inside the first rail and outside the others; along: seen from outside they follow it."""
    loops = [rail.along() if along else rail.against() for rail in rails]
    face = face_inside(patch.surface, patch.outward, *loops)
    for rail in rails if patch.uv is not None else ():
        for curve, edge in zip(rail.curves, rail.edges, strict=True):
            BRep_Builder().UpdateEdge(edge, image(patch, curve), face, TOLERANCE)
    return face


def front_caps(lens: Lens, rails: Sequence[Rail]) -> list[Named]:
    """The faces of the front inside the first rail and outside the others: itself, or with it the plane around it."""
    if lens.front.outline is None:
        return [(cap(front_patch(lens), rails, along=False), "front")]
    dome, rim = dome_cap(lens)
    plane = level_patch(lens.front.around.z)
    around = face_inside(plane.surface, plane.outward, *(rail.against() for rail in rails), rim.along())
    return [dome, (around, "underside")]


def dome_cap(lens: Lens) -> tuple[Named, Rail]:
    """The optical part of a front with an outline of its own, and its rim, counterclockwise."""
    rim = walls.on(lens.front.optical, wires.of_outline(lens.front.outline))
    return (cap(front_patch(lens), [rim], along=False), "front"), rim


def image(patch: Patch, curve: Curve) -> Geom2d_Curve:
    """The curve in the patch's parameter plane, by the same parameter: a line or a circle where it is one."""
    piece, cubic = curve.piece, curve.knots is not None and len(curve.knots) == len(curve.poles) + 4
    t = np.unique(curve.knots) if cubic else np.linspace(0.0, piece.end, SAMPLES)

    def points(t: np.ndarray) -> np.ndarray:
        return patch.uv(*piece.points(t).T)

    found = points(t)
    near = EXACT * np.ptp(found, axis=0).max()
    ends, share = found[[0, -1]], t[:, None] / piece.end
    if np.abs(ends[0] + share * (ends[1] - ends[0]) - found).max() <= near:
        return patches.bspline_curve_2d(ends, np.array([0.0, 0.0, piece.end, piece.end]))
    if piece.turn > 0:  # u + iv = centre + arm exp(it)?
        start, end = ends @ (1, 1j)
        arm = (end - start) / (cmath.exp(1j * piece.end) - 1)
        centre = start - arm
        if np.abs(centre + arm * np.exp(1j * t) - found @ (1, 1j)).max() <= near:
            axis = gp_Ax2d(gp_Pnt2d(centre.real, centre.imag), gp_Dir2d(arm.real, arm.imag))
            return Geom2d_Circle(axis, abs(arm))
    here, there = (np.diff(each, axis=0) for each in (piece.points(t), found))
    scale = np.linalg.norm(there, axis=1).max() / np.linalg.norm(here, axis=1).max()
    return patches.bspline_curve_2d(*wires.fitted(points, t, RIM * scale, smooth=not cubic))


def _around(lens: Lens, loops: list[list[Piece]], top: Rail, draft: Draft) -> tuple[list[Named], Rail]:
    """The walls over the rim, the first loop, from the back's edge down to the front, and their edge there."""
    if not draft.angle:
        return walls.down(lens.front.around, loops, top, above=lens.back, draft=draft)
    plane = Plane(_parting(lens, loops[0]))
    line = walls.on(plane, loops[0])
    leaning, low = walls.down(lens.front.around, loops, line, above=plane, draft=draft)
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
    return np.concatenate([piece.points(np.linspace(0.0, piece.end, PLACES * max(lens.back.shape))) for piece in rim]).T
