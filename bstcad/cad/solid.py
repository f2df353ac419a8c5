"""The lens as one valid solid: each edge is built once and shared by the two faces that meet in it.

No boolean and no sewing: both would loosen the edges, and with a large net they take minutes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from OCP.BRep import BRep_Builder
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge, BRepBuilderAPI_MakeVertex
from OCP.BRepCheck import BRepCheck_Analyzer
from OCP.Geom import Geom_CylindricalSurface, Geom_Plane, Geom_Surface
from OCP.Geom2d import Geom2d_Line
from OCP.gp import gp_Ax3, gp_Dir, gp_Dir2d, gp_Pnt, gp_Pnt2d
from OCP.TopoDS import TopoDS, TopoDS_Edge, TopoDS_Face, TopoDS_Shell, TopoDS_Solid, TopoDS_Vertex, TopoDS_Wire

from bstcad.cad.patches import SIDES, Border, Patch, back_patch, front_patch
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import sag

if TYPE_CHECKING:
    import cadquery

TOLERANCE = 1e-7  # mm, of every face, edge and vertex
SLIM = 1e-3  # mm
SPARE = 4  # control points a side beyond a round rim: two spans, and two more until x(u) is linear
CAPS = ("back", "front")  # names of the first two faces of a lens

# A loop lists its edges and whether each is walked along its own direction, counterclockwise seen from outside.
# Corners are named by the ends of x and y: "01" is (-x, +y).
TOP_LOOP = (("y0", True), ("x1", True), ("y1", False), ("x0", False))
BOTTOM_LOOP = (("x0", True), ("y1", True), ("x1", False), ("y0", False))
ENDS = {"x0": ("00", "01"), "x1": ("10", "11"), "y0": ("00", "10"), "y1": ("01", "11")}
SIDE_LOOPS = {  # (front edge forward?, rising corner, back edge forward?, falling corner)
    "y0": (True, "10", False, "00"),
    "x1": (True, "11", False, "10"),
    "y1": (False, "01", True, "11"),
    "x0": (False, "00", True, "01"),
}
NORMALS = {"x0": (-1, 0, 0), "x1": (1, 0, 0), "y0": (0, -1, 0), "y1": (0, 1, 0)}

Loop = list[tuple[TopoDS_Edge, bool]]


class NamedSolid(NamedTuple):
    """A solid and the names of its faces, in its own order."""

    solid: cadquery.Solid
    faces: tuple[str, ...]  # "back", "front", "rim", "bevel", "hole" or "flange"


def lens_solid(lens: Lens) -> cadquery.Solid:
    """The lens as cadquery's solid, its faces oriented outwards; ValueError where no valid one exists."""
    import cadquery

    return cadquery.Solid(lens_shape(lens))


def coarse_copy(lens: Lens, m: int) -> Lens:
    """The lens with a back of m x m control points, for viewers, which turn a face into triangles before they show it.

    Each is as high as the back itself at its (x, y).  This follows relief wider than a few cells of the coarse net, and
    smooths the rest (de Boor 1978, Schoenberg's operator); the copy does not steer light as the lens does.
    """
    lens = lens.plain()
    if m >= lens.back.m:
        return lens
    stretch = (m - 1) / (m - 1 - 2 * SPARE) if lens.outline.is_round else 1.0
    ends = [stretch * half for half in lens.outline.half_extent]
    spans = zip(ends, (lens.back.x, lens.back.y), strict=True)
    x, y = np.meshgrid(*(np.clip(np.linspace(-end, end, m), *span) for end, span in spans), indexing="ij")
    heights = torch.from_numpy(sag(lens.back, x, y) - lens.back.z)
    return replace(lens, back=BSplineSurface(lens.back.z, heights, *((-end, end) for end in ends)))


def face_names(lens: Lens) -> tuple[str, ...]:
    """The names of the faces of `lens_solid`, in its order."""
    return (*CAPS, *["rim"] * (1 if lens.outline.is_round else len(SIDES)))


def lens_shape(lens: Lens) -> TopoDS_Solid:
    """The same without cadquery, whose import takes a second."""
    check_thickness(lens)
    build = _round_faces if lens.outline.is_round else _rectangle_faces
    fault = "lens: front, back and outline bound no valid solid; check that the back lies above the front"
    return solid_of(build(lens, back_patch(lens), front_patch(lens)), fault)


def check_thickness(lens: Lens) -> None:
    """The back must lie above the front everywhere; OCC's own check sees no face cross another.

    Below SLIM the lens has no body left for the edges' tolerance.  A spline lies nowhere below its lowest control
    point, which settles it for most lenses; for the others, three points a knot span each way.
    """
    lowest, highest = lens.back.sags(lens.outline)[0], lens.front.sags(lens.outline)[1]
    if lens.back.z + lowest - (lens.front.z + highest) > SLIM:
        return
    a, b = lens.outline.half_extent
    n = 3 * (lens.back.m - 2) + 1
    axes = (torch.linspace(-end, end, n, dtype=torch.float64) for end in (a, b))
    x, y = torch.meshgrid(*axes, indexing="ij")
    inside = lens.outline.contains(x, y)
    x, y = x[inside].numpy(), y[inside].numpy()
    thickness = sag(lens.back, x, y) - sag(lens.front, x, y)
    i = int(thickness.argmin())
    if not thickness[i] > SLIM:
        raise ValueError(
            f"lens: the back lies {thickness[i]:g} mm above the front at ({x[i]:g}, {y[i]:g}) mm; move the front down"
        )


def vertex(x: float, y: float, z: float) -> TopoDS_Vertex:
    """At a place (mm)."""
    return BRepBuilderAPI_MakeVertex(gp_Pnt(float(x), float(y), float(z))).Vertex()


def _edge(border: Border, start: TopoDS_Vertex, end: TopoDS_Vertex) -> TopoDS_Edge:
    return BRepBuilderAPI_MakeEdge(border.curve, start, end, float(border.start), float(border.end)).Edge()


def straight(start: TopoDS_Vertex, end: TopoDS_Vertex) -> TopoDS_Edge:
    """The edge from one vertex to another, its parameter the length from the first (mm)."""
    return BRepBuilderAPI_MakeEdge(start, end).Edge()


def face_inside(surface: Geom_Surface, outward: bool, *loops: Loop) -> TopoDS_Face:
    """The face inside a loop that runs counterclockwise seen from outside, less holes, whose loops run clockwise."""
    builder, face = BRep_Builder(), TopoDS_Face()
    builder.MakeFace(face, surface, TOLERANCE)
    for loop in loops:
        wire = TopoDS_Wire()
        builder.MakeWire(wire)
        for edge, forward in loop:
            builder.Add(wire, edge if forward else edge.Reversed())
        wire.Closed(True)
        builder.Add(face, wire if outward else wire.Reversed())
    return face if outward else TopoDS.Face_s(face.Reversed())


def _patch_face(patch: Patch, edges: dict[str, TopoDS_Edge], loop: tuple[tuple[str, bool], ...]) -> TopoDS_Face:
    face = face_inside(patch.surface, patch.outward, [(edges[name], forward) for name, forward in loop])
    for name, border in patch.borders.items():
        if border.uv is not None:
            BRep_Builder().UpdateEdge(edges[name], border.uv, face, TOLERANCE)
    return face


def solid_of(built: list[TopoDS_Face], fault: str) -> TopoDS_Solid:
    """The solid that faces bound which share their edges and look outwards; ValueError(fault) if it is not valid."""
    builder, shell, solid = BRep_Builder(), TopoDS_Shell(), TopoDS_Solid()
    builder.MakeShell(shell)
    for face in built:
        builder.Add(shell, face)
    shell.Closed(True)
    builder.MakeSolid(solid)
    builder.Add(solid, shell)
    if not BRepCheck_Analyzer(solid).IsValid():
        raise ValueError(fault)
    return solid


def _rectangle_faces(lens: Lens, back: Patch, front: Patch) -> list[TopoDS_Face]:
    """Back, front and four planar sides: 6 faces, 12 edges, 8 vertices."""
    a, b = lens.outline.half_extent
    net = lens.back.control_points()
    at = {"00": (-a, -b), "01": (-a, b), "10": (a, -b), "11": (a, b)}
    corner = {"00": net[0, 0], "01": net[0, -1], "10": net[-1, 0], "11": net[-1, -1]}
    top = {name: vertex(*xyz) for name, xyz in corner.items()}
    bottom = {name: vertex(*xy, sag(lens.front, *xy)) for name, xy in at.items()}
    rising = {name: straight(bottom[name], top[name]) for name in at}
    top_edges = {s: _edge(back.borders[s], *(top[end] for end in ENDS[s])) for s in SIDES}
    bottom_edges = {s: _edge(front.borders[s], *(bottom[end] for end in ENDS[s])) for s in SIDES}

    def side(name: str) -> TopoDS_Face:
        front_forward, up, back_forward, down = SIDE_LOOPS[name]
        nx, ny, _ = NORMALS[name]
        plane = Geom_Plane(gp_Ax3(gp_Pnt(nx * a, ny * b, 0), gp_Dir(nx, ny, 0)))
        edges = (bottom_edges[name], front_forward), (rising[up], True)
        return face_inside(plane, True, [*edges, (top_edges[name], back_forward), (rising[down], False)])

    caps = [_patch_face(back, top_edges, TOP_LOOP), _patch_face(front, bottom_edges, BOTTOM_LOOP)]
    return caps + [side(name) for name in SIDES]


def _round_faces(lens: Lens, back: Patch, front: Patch) -> list[TopoDS_Face]:
    """Back, front and one cylinder with a seam at y = 0: 3 faces, 3 edges, 2 vertices."""
    radius = lens.outline.radius
    rim, rim_front = back.borders["rim"], front.borders["rim"]
    z_front, z_back = rim_front.curve.Value(0.0).Z(), rim.curve.Value(0.0).Z()
    low, high = vertex(radius, 0, z_front), vertex(radius, 0, z_back)
    top, bottom, seam = _edge(rim, high, high), _edge(rim_front, low, low), straight(low, high)

    side = Geom_CylindricalSurface(gp_Ax3(gp_Pnt(0, 0, 0), gp_Dir(0, 0, 1), gp_Dir(1, 0, 0)), radius)
    cylinder = face_inside(side, True, [(bottom, True), (seam, True), (top, False), (seam, False)])
    builder, turn = BRep_Builder(), 2 * np.pi
    builder.UpdateEdge(bottom, rim_front.around, cylinder, TOLERANCE)
    builder.UpdateEdge(top, rim.around, cylinder, TOLERANCE)
    up = gp_Dir2d(0, 1)  # the seam's own parameter runs from 0 at the front
    builder.UpdateEdge(
        seam, Geom2d_Line(gp_Pnt2d(turn, z_front), up), Geom2d_Line(gp_Pnt2d(0, z_front), up), cylinder, TOLERANCE
    )
    caps = [_patch_face(back, {"rim": top}, (("rim", True),)), _patch_face(front, {"rim": bottom}, (("rim", False),))]
    return [*caps, cylinder]
