"""A lens as one valid solid: two caps on its exact faces, and walls over closed wires between them.

The wires are the lens's outline, or a closed wire inside it, and holes.  Each edge is built once and shared by the two
faces that meet in it, in space and in the (u, v) planes of these faces.  Boolean operations and sewing are not used:
they loosen the edges or refit the faces, and a boolean with a net of 513 x 513 takes half a minute.
"""

from __future__ import annotations

import cmath
import math
import numbers
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from OCP.BRep import BRep_Builder
from OCP.Geom2d import Geom2d_Circle, Geom2d_Curve
from OCP.gp import gp_Ax2d, gp_Dir2d, gp_Pnt2d
from OCP.TopoDS import TopoDS_Face, TopoDS_Solid

from bstcad.cad import patches, walls, wires
from bstcad.cad.patches import FacePatch, back_patch, front_patch, level_patch
from bstcad.cad.walls import MIN_WALL, NO_DRAFT, Draft, NamedFace, Rail, face_inside
from bstcad.cad.wires import LoopPiece, RailCurve
from bstcad.optics.lens.base import check_base, on_base
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK, FRONT
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.sides import as_pair, coarser
from bstcad.optics.surfaces.surfaces import Plane, points_on, sag
from bstcad.scene.mount import parting

if TYPE_CHECKING:
    import cadquery

EXTRA_POINTS = 4  # control points of a coarse copy beyond the rim, at each end: two for the end span, and two more
RIM_POINTS_PER_CELL = 8  # number of points on each piece of a rim per control point along the back's longer side
IMAGE_TOLERANCE = 1e-12  # largest deviation / size of an edge's image in (u, v) that is written as a line or circle
IMAGE_SAMPLES = 65  # number of points of an image that are compared with a line and a circle
INVALID_LENS = (
    "lens: front, back and walls do not bound a valid solid; check that the back lies above the front, and move wires "
    "apart or make them simpler"
)


class NamedSolid(NamedTuple):
    """A solid and the names of its faces, in the order of solid.Faces()."""

    solid: cadquery.Solid
    faces: tuple[str, ...]  # names of Lens.faces, "underside" (around the front), "rim", "bevel", "hole" or "flange"


def lens_solid(
    lens: Lens, trim: cadquery.Wire | None = None, holes: Sequence = (), draft: Draft = NO_DRAFT
) -> cadquery.Solid:
    """Return the lens inside `trim` (None: its outline) without `holes` as a cadquery solid, faces oriented outwards.

    trim: a closed plane wire, of which x and y are used; holes: such wires, or (x, y, diameter) in mm.  Walls are
    parallel to z.  With a draft angle, the outer walls lean inwards below a plane under the back's rim (mount.parting).
    Raises ValueError in one sentence if a wire is open, crosses itself or another, or leaves the lens, if walls would
    meet, or if no valid solid exists.
    """
    return named_solid(lens, trim, holes, draft).solid


def named_solid(
    lens: Lens, trim: cadquery.Wire | None = None, holes: Sequence = (), draft: Draft = NO_DRAFT
) -> NamedSolid:
    """Return the solid of `lens_solid` with the names of its faces: the back, the front, then the others."""
    import cadquery

    solid, names = lens_shape(lens, cut_loops(lens, trim, holes), draft)
    return NamedSolid(cadquery.Solid(solid), names)


def lens_shape(
    lens: Lens, loops: Sequence[list[LoopPiece]] | None = None, draft: Draft = NO_DRAFT
) -> tuple[TopoDS_Solid, tuple[str, ...]]:
    """Return the OCC solid of a lens and the names of its faces, without cadquery, whose import takes a second.

    loops: rim and holes as `cut_loops` returns them (None: the lens's outline).
    """
    lens = prepared(lens)
    loops = loops or [rim_loop(lens)]
    back, below = back_patch(lens), lens.front.around
    tops, inner = [walls.rail_on(lens.back, loop) for loop in loops], [walls.rail_on(below, loop) for loop in loops[1:]]
    named, low = _outer_walls(lens, loops, tops[0], draft)
    for each in zip(loops[1:], inner, tops[1:], strict=True):
        named += walls.upright_walls(*each, "hole")
    caps = [(cap(back, tops, along=True), BACK), *front_caps(lens, [low, *inner])]
    faces, names = zip(*caps, *named, strict=True)
    return walls.solid_of(faces, INVALID_LENS), names


def prepared(lens: Lens) -> Lens:
    """Return the lens in float64 on its base (base.on_base), if it has one; ValueError if its faces cross."""
    lens = on_base(lens.plain())
    check_thickness(lens)
    return lens


def rim_loop(lens: Lens) -> list[LoopPiece]:
    """Return the loop of the lens's outline, on which its walls stand, counterclockwise."""
    if lens.shares_outline:
        return wires.outline_loop(lens.outline)
    return wires.loop_on(lens.back_net, lens.outline, walls.RIM_TOLERANCE)


def coarse_copy(lens: Lens, m: int) -> Lens:
    """Return the lens with m control points along the longer side of its back, for viewers, which triangulate faces.

    Each control point has the height of the back at its (x, y), which is Schoenberg's operator (de Boor 1978).  The
    copy follows relief wider than a few cells of the coarse net and smooths the rest; do not trace light through it.
    """
    lens = lens.plain()
    net = lens.back_net
    if m >= max(net.shape):
        return lens
    stretch = (m - 1) / (m - 1 - 2 * EXTRA_POINTS)
    reach = (max(-low, high) for low, high in (net.x, net.y))
    ends = [half if end <= half else stretch * half for half, end in zip(lens.outline.half_extent, reach, strict=True)]
    spans = zip(ends, as_pair(coarser(net.shape, m)), (net.x, net.y), strict=True)
    x, y = np.meshgrid(*(np.clip(np.linspace(-end, end, k), *span) for end, k, span in spans), indexing="ij")
    heights, (half_x, half_y) = torch.from_numpy(sag(net, x, y) - net.z), ends
    return lens.with_back(BSplineSurface(net.z, heights, (-half_x, half_x), (-half_y, half_y)))


def check_thickness(lens: Lens) -> None:
    """Raise ValueError unless the back lies above the front everywhere; OCC does not detect faces that cross.

    The thickness must exceed MIN_WALL because of the tolerance of edges.  Since a spline lies nowhere below its lowest
    control point, most lenses need no sampling.  Others are sampled at three points per knot span in x and in y.
    """
    check_base(lens)
    lowest, highest = lens.back.sags(lens.outline)[0], lens.front.sags(lens.plan)[1]
    if lens.back.z + lowest - (lens.front.z + highest) > MIN_WALL:
        return
    a, b = lens.outline.half_extent
    axes = (
        torch.linspace(-end, end, 3 * (count - 2) + 1, dtype=torch.float64)
        for end, count in zip((a, b), lens.back_net.shape, strict=True)
    )
    x, y = torch.meshgrid(*axes, indexing="ij")
    inside = lens.outline.contains(x, y)
    x, y, z = points_on(lens.back, x[inside].numpy(), y[inside].numpy()).T
    thickness = z - sag(lens.front, x, y)
    i = int(thickness.argmin())
    if not thickness[i] > MIN_WALL:
        at = f"({x[i]:g}, {y[i]:g}) mm"
        raise ValueError(f"lens: its thickness is {thickness[i]:g} mm at {at}; move the front down")


# ---- the wires -----------------------------------------------------------------------------------------------------


def cut_loops(lens: Lens, trim: cadquery.Wire | None, holes: Sequence) -> list[list[LoopPiece]]:
    """Return rim (trim None: the outline), counterclockwise, and holes, clockwise; ValueError if they bound no lens."""
    if not lens.shares_outline:
        if trim is not None or len(holes):
            raise ValueError("trim or holes: a dome keeps its own rim, the circle of its outline; omit trim and holes")
        return [rim_loop(lens)]
    loops = [wires.outline_loop(lens.outline) if trim is None else _wire_loop("trim", trim)]
    loops += [_hole_loop(f"hole {k}", hole) for k, hole in enumerate(holes, start=1)]
    shape = wires.polygon(*loops)
    x, y = np.array(shape.exterior.coords).T
    outside = ~lens.outline.contains(*(torch.from_numpy(p * (1 - 1e-9)) for p in (x, y))).numpy()
    if outside.any():
        raise ValueError(
            f"trim: the wire leaves the lens at ({x[outside][0]:.4g}, {y[outside][0]:.4g}) mm; move it inside"
        )
    if fault := wires.fault(shape):
        reason, position = fault
        raise ValueError(
            f"trim or holes: {reason} near {position}; draw wires that do not cross themselves or each other, and the "
            "holes inside the rim"
        )
    if (inner := lens.front.outline) and not shape.contains(wires.polygon(wires.outline_loop(inner))):
        raise ValueError(
            f"trim or holes: a wire crosses the front, {inner.words}, or lies inside it; move the wire outside"
        )
    correct = [shape.exterior.is_ccw, *(not hole.is_ccw for hole in shape.interiors)]
    return [loop if is_left else wires.reversed_loop(loop) for loop, is_left in zip(loops, correct, strict=True)]


def _wire_loop(name: str, wire: cadquery.Wire) -> list[LoopPiece]:
    try:
        return wires.wire_loop(wire)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _hole_loop(name: str, hole: cadquery.Wire | Sequence[float]) -> list[LoopPiece]:
    if not isinstance(hole, Sequence):
        return _wire_loop(name, hole)
    if len(hole) != 3 or not all(isinstance(each, numbers.Real) and math.isfinite(each) for each in hole):
        raise ValueError(f"{name}: {hole} is not (x, y, diameter); give three numbers in mm, or a closed wire")
    x, y, diameter = map(float, hole)
    if not diameter > 0:
        raise ValueError(f"{name}: the diameter is {diameter:g} mm; give a diameter above 0")
    return wires.circle(x, y, diameter / 2)


# ---- caps and walls ------------------------------------------------------------------------------------------------


def cap(patch: FacePatch, rails: Sequence[Rail], along: bool) -> TopoDS_Face:
    """Return the face on a patch, back (along: True) or front (False), inside the first rail and outside the others."""
    loops = [rail.along() if along else rail.against() for rail in rails]
    face = face_inside(patch.surface, patch.outward, *loops)
    for rail in rails if patch.uv is not None else ():
        for curve, edge in zip(rail.curves, rail.edges, strict=True):
            BRep_Builder().UpdateEdge(edge, image(patch, curve), face, walls.SHAPE_TOLERANCE)
    return face


def front_caps(lens: Lens, rails: Sequence[Rail]) -> list[NamedFace]:
    """Return the front, and the plane around it if it has an outline, inside the first rail and outside the others."""
    if lens.front.outline is None:
        return [(cap(front_patch(lens), rails, along=False), FRONT)]
    front, rim = optical_cap(lens)
    plane = level_patch(lens.front.around.z)
    around = face_inside(plane.surface, plane.outward, *(rail.against() for rail in rails), rim.along())
    return [front, (around, "underside")]


def optical_cap(lens: Lens) -> tuple[NamedFace, Rail]:
    """Return the optical part of a front with its own outline, and its rim, counterclockwise."""
    assert lens.front.outline is not None
    rim = walls.rail_on(lens.front.optical, wires.outline_loop(lens.front.outline))
    return (cap(front_patch(lens), [rim], along=False), FRONT), rim


def image(patch: FacePatch, curve: RailCurve) -> Geom2d_Curve:
    """Return the image in (u, v) of a curve on a patch: a line, circle or spline with the parameter of the curve."""
    piece, uv = curve.piece, patch.uv
    located = piece if piece.rim is None else piece.rim.arc  # (u, v) follow from the chart
    assert uv is not None  # a plane needs no image
    cubic = curve.knots if curve.knots is not None and len(curve.knots) == len(curve.poles) + 4 else None
    t = np.linspace(0.0, piece.end, IMAGE_SAMPLES) if cubic is None else np.unique(cubic)

    def points(t: np.ndarray) -> np.ndarray:
        return uv(*located.points(t).T)

    found = points(t)
    tolerance = IMAGE_TOLERANCE * np.ptp(found, axis=0).max()
    ends, fraction = found[[0, -1]], t[:, None] / piece.end
    if np.abs(ends[0] + fraction * (ends[1] - ends[0]) - found).max() <= tolerance:
        return patches.bspline_curve_2d(ends, np.array([0.0, 0.0, piece.end, piece.end]))
    if located.turn > 0:  # is the image a circle, u + iv = centre + arm exp(it)?
        start, end = ends @ (1, 1j)
        arm = (end - start) / (cmath.exp(1j * piece.end) - 1)
        centre = start - arm
        if np.abs(centre + arm * np.exp(1j * t) - found @ (1, 1j)).max() <= tolerance:
            axis = gp_Ax2d(gp_Pnt2d(centre.real, centre.imag), gp_Dir2d(arm.real, arm.imag))
            return Geom2d_Circle(axis, abs(arm))
    chords, images = (np.diff(each, axis=0) for each in (piece.points(t), found))
    scale = np.linalg.norm(images, axis=1).max() / np.linalg.norm(chords, axis=1).max()
    return patches.bspline_curve_2d(*wires.fit_spline(points, t, walls.RIM_TOLERANCE * scale, smooth=cubic is None))


def _outer_walls(lens: Lens, loops: Sequence[list[LoopPiece]], top: Rail, draft: Draft) -> tuple[list[NamedFace], Rail]:
    """Return the walls over the rim (the first loop) from `top` on the back to the front, and the rail on the front."""
    if not draft.angle:
        return walls.leaning_walls(lens.front.around, loops, top, above=lens.back, draft=draft)
    plane = Plane(_parting(lens, loops[0]))
    line = walls.rail_on(plane, loops[0])
    leaning, low = walls.leaning_walls(lens.front.around, loops, line, above=plane, draft=draft)
    return walls.upright_walls(loops[0], line, top) + leaning, low


def _parting(lens: Lens, rim: Sequence[LoopPiece]) -> float:
    """Return z (mm) of the plane from which walls lean: below the back's rim and above the front's."""
    back, front = rim_heights(lens, rim)
    low, high = back.min(), front.max()
    if not low - high > MIN_WALL:
        raise ValueError(
            f"draft: the rim of the back comes down to z = {low:.4g} mm, and the rim of the front rises to {high:.4g} "
            "mm, so that no plane between them divides the wall; omit draft, or make the lens thicker at its edge"
        )
    return parting(back, front)


def rim_points(lens: Lens, rim: Sequence[LoopPiece]) -> np.ndarray:
    """Return x and y (2, n) of points along a rim (mm), several in each cell of the back's net."""
    count = RIM_POINTS_PER_CELL * max(lens.back_net.shape)
    return np.concatenate([piece.points(np.linspace(0.0, piece.end, count)) for piece in rim]).T


def rim_heights(lens: Lens, rim: Sequence[LoopPiece]) -> tuple[np.ndarray, np.ndarray]:
    """Return z (mm) of back and front at the points of `rim_points`."""
    x, y = rim_points(lens, rim)
    own = [piece.rim for piece in rim]
    t = np.linspace(0.0, rim[0].end, len(x) // len(rim))
    back = [piece.heights(t) for piece in own if piece is not None]
    return np.concatenate(back) if back else sag(lens.back, x, y), sag(lens.front, x, y)
