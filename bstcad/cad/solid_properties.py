"""Area, volume and centroid of a part with lenses, from its faces and edges, with a relative error of 1e-8.

Each face is integrated along its boundary with Green's theorem: a freeform net in x and y (optics.lens.face_integrals),
which for a dome are those of its chart, any other face in its parameters u and v.  OCC's own integrals take minutes for
a large net.  They have errors of 1e-5 for a face that shares an edge with a large net, since this edge is a curve of
thousands of knots.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from OCP.Bnd import Bnd_Box
from OCP.BRep import BRep_Tool
from OCP.BRepAdaptor import BRepAdaptor_Curve, BRepAdaptor_Curve2d, BRepAdaptor_Surface
from OCP.BRepBndLib import BRepBndLib
from OCP.BRepTools import BRepTools
from OCP.GeomAbs import GeomAbs_CurveType
from OCP.GeomAbs import GeomAbs_SurfaceType as Kind
from OCP.gp import gp_Pnt, gp_Pnt2d, gp_Vec, gp_Vec2d
from OCP.Standard import Standard_Failure
from OCP.TopAbs import TopAbs_EDGE, TopAbs_FACE, TopAbs_Orientation, TopAbs_VERTEX
from OCP.TopExp import TopExp_Explorer
from OCP.TopoDS import TopoDS, TopoDS_Edge, TopoDS_Face, TopoDS_Shape

from bstcad.cad import step_reading
from bstcad.cad.step_reading import StepLens, parts_of
from bstcad.optics.lens import face_integrals
from bstcad.optics.lens.face_integrals import (
    EDGE_PARTS,
    GAUSS_POINTS_PER_PART,
    MIN_RELATIVE_DX,
    Border,
    MassProperties,
    Sums,
)
from bstcad.optics.surfaces.bspline import BSplineSurface

if TYPE_CHECKING:
    import cadquery

Coordinates = tuple[float, float, float]

STRAIGHT_POINTS = 2  # number of Gauss points along v on a face that is straight along v
STRAIGHT_KINDS = (Kind.GeomAbs_Plane, Kind.GeomAbs_Cylinder, Kind.GeomAbs_Cone, Kind.GeomAbs_SurfaceOfExtrusion)
# Number of Gauss points along v for each kind of face; only rounding errors remain.
GAUSS_POINTS_V = dict.fromkeys(STRAIGHT_KINDS, STRAIGHT_POINTS)
GAUSS_POINTS_V |= {Kind.GeomAbs_Sphere: 12, Kind.GeomAbs_Torus: 12, Kind.GeomAbs_BSplineSurface: 32}
ARC_PARTS, ARC_POINTS = 8, 12  # numbers of intervals, and of Gauss points in each, of a line or an arc


@dataclass(frozen=True)
class WholePart:
    """A part with walls other than those over the lens's outline: with a flange, draft, a bevel or a cut."""

    edge: np.ndarray  # points along the edge of the back, (n, 2), mm
    low: Coordinates  # smallest x, y and z (mm) of the part's faces except freeform ones, whose extent the lens gives
    high: Coordinates  # largest x, y and z (mm) of these faces
    properties: MassProperties | None  # None: a face is of a kind that cannot be integrated


def whole_part(reread: StepLens, properties: MassProperties | None) -> WholePart | None:
    """Return the whole part in a STEP file, which has these properties; None for a bare lens."""
    if reread.edge is None:
        return None
    box = Bnd_Box()
    for face in map(TopoDS.Face_s, parts_of(reread.shape, TopAbs_FACE)):
        if not step_reading.is_freeform(BRepAdaptor_Surface(face)):
            BRepBndLib.AddOptimal_s(face, box, False, False)  # use the shape, without its mesh and tolerance
    return WholePart(reread.edge, box.CornerMin().Coord(), box.CornerMax().Coord(), properties)


def of_solid(solid: cadquery.Shape | TopoDS_Shape) -> MassProperties | None:
    """Return area, volume and centroid of a part with lens axes along z; None: a face is damaged or of unknown kind."""
    shape: TopoDS_Shape = getattr(solid, "wrapped", solid)
    vertex = TopoDS.Vertex_s(parts_of(shape, TopAbs_VERTEX)[0])
    z_ref = BRep_Tool.Pnt_s(vertex).Z()  # origin of the sums, near the part: errors due to gaps grow with the distance
    try:
        total = sum((_of_face(TopoDS.Face_s(face), z_ref) for face in parts_of(shape, TopAbs_FACE)), Sums())
        return MassProperties.of(total, z_ref)
    except (ValueError, Standard_Failure):  # Standard_Failure: a damaged file
        return None


def _of_face(face: TopoDS_Face, z_ref: float) -> Sums:
    surface = BRepAdaptor_Surface(face)
    if step_reading.is_freeform(surface):
        net = step_reading.freeform_surface(face)
        border = Border(*_concatenate(_edge_over_net(edge, face, net) for edge in _edges(face)))
        return face_integrals.of_face(net, border, net.z - z_ref)
    if surface.GetType() not in GAUSS_POINTS_V:
        raise ValueError("a face is of an unknown kind; write the file again")
    return _in_parameters(face, surface, z_ref)


def _in_parameters(face: TopoDS_Face, surface: BRepAdaptor_Surface, z_ref: float) -> Sums:
    """Integrate over a face: ∫∫ g du dv = -∮ G du, where G = ∫ g dv from a fixed v to the border.

    g is computed from the position r, relative to (0, 0, z_ref), and n dA = ∂r/∂u x ∂r/∂v du dv.  A face that OCC has
    reversed has a reversed border.
    """
    u, v, du = (each[:, None] for each in _concatenate(_edge_in_parameters(edge, face) for edge in _edges(face)))
    spline = surface.GetType() == Kind.GeomAbs_BSplineSurface
    ruled = spline and surface.VDegree() == 1 and surface.NbVPoles() == 2
    point, weight = face_integrals.gauss_rule(STRAIGHT_POINTS if ruled else GAUSS_POINTS_V[surface.GetType()])
    half = (v - BRepTools.UVBounds_s(face)[2]) / 2
    u, along, weight = np.broadcast_arrays(u, v + half * (point - 1), -du * half * weight)
    found = step_reading.points_and_tangents(surface, u.ravel().tolist(), along.ravel().tolist())
    r, normal = found[:, 0] - (0.0, 0.0, z_ref), np.cross(found[:, 1], found[:, 2])
    cone = weight.ravel() * (r * normal).sum(axis=1)
    area = weight.ravel() * np.linalg.norm(normal, axis=1)
    return Sums(abs(float(area.sum())), float(cone.sum()) / 3, (cone[:, None] * r).sum(axis=0) / 4)


def _edges(face: TopoDS_Face) -> Iterator[TopoDS_Edge]:
    """Yield the edges of a face in the face's order and directions; a seam occurs twice."""
    explorer = TopExp_Explorer(face, TopAbs_EDGE)
    while explorer.More():
        yield TopoDS.Edge_s(explorer.Current())
        explorer.Next()


def _concatenate(parts: Iterator[tuple[np.ndarray, ...]]) -> list[np.ndarray]:
    return [np.concatenate(each) for each in zip(*parts, strict=True)]


def _edge_over_net(edge: TopoDS_Edge, face: TopoDS_Face, net: BSplineSurface) -> tuple[np.ndarray, ...]:
    """Return x, y, dx and dy of an edge in the net's chart; if it is not flat, they follow from the edge in (u, v)."""
    if net.chart.flat:
        return _edge_in_space(edge)
    curve = BRepAdaptor_Curve2d(edge, face)
    t, weight = _gauss_points(edge, [curve, BRepAdaptor_Curve(edge)], over_net=True)
    u, v, du, dv = _evaluate(curve, t, gp_Pnt2d(), gp_Vec2d())
    x, y = step_reading.chart_coordinates(net, np.stack([u, v], axis=1))
    pitch_x, pitch_y = net.pitch  # x(u) is linear outside the end spans, which the rim does not reach
    return x, y, pitch_x * weight * du, pitch_y * weight * dv


def _edge_in_space(edge: TopoDS_Edge) -> tuple[np.ndarray, ...]:
    """Return x and y (mm) at Gauss points along an edge in space, and dx and dy multiplied by the points' weights."""
    curve = BRepAdaptor_Curve(edge)
    t, weight = _gauss_points(edge, [curve], over_net=True)
    x, y, _, dx, dy, _ = _evaluate(curve, t, gp_Pnt(), gp_Vec())
    return x, y, weight * dx, weight * dy


def _edge_in_parameters(edge: TopoDS_Edge, face: TopoDS_Face) -> tuple[np.ndarray, ...]:
    """Return u, v and weighted du at the Gauss points of an edge of a face, except points where u does not change."""
    curve = BRepAdaptor_Curve2d(edge, face)
    curves = [curve] if BRep_Tool.Degenerated_s(edge) else [curve, BRepAdaptor_Curve(edge)]
    t, weight = _gauss_points(edge, curves)
    u, v, du, dv = _evaluate(curve, t, gp_Pnt2d(), gp_Vec2d())
    moves = np.abs(du) > MIN_RELATIVE_DX * np.hypot(du, dv)
    return u[moves], v[moves], (weight * du)[moves]


def _evaluate(
    curve: BRepAdaptor_Curve | BRepAdaptor_Curve2d, t: np.ndarray, point: gp_Pnt | gp_Pnt2d, tangent: gp_Vec | gp_Vec2d
) -> np.ndarray:
    """Return the coordinates of a curve and of its derivative at t, each (n,); point, tangent: OCC's output objects."""
    rows = []
    for value in t.tolist():
        curve.D1(value, point, tangent)
        rows.append((*point.Coord(), *tangent.Coord()))
    return np.array(rows).T


def _gauss_points(
    edge: TopoDS_Edge, curves: Sequence[BRepAdaptor_Curve | BRepAdaptor_Curve2d], over_net: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters and weights of Gauss points between knots of `curves`; over_net: True for an edge of a net."""
    first, last = curves[0].FirstParameter(), curves[0].LastParameter()
    knots = {first, last}
    for curve in curves:
        if curve.GetType() == GeomAbs_CurveType.GeomAbs_BSplineCurve:
            spline = curve.BSpline()
            knots.update(k for k in map(spline.Knot, range(1, spline.NbKnots() + 1)) if first < k < last)
    parts, points = (EDGE_PARTS, GAUSS_POINTS_PER_PART) if over_net or len(knots) > 2 else (ARC_PARTS, ARC_POINTS)
    t, weight = face_integrals.gauss_points(face_integrals.divided(np.array(sorted(knots)), parts), points)
    return t, -weight if edge.Orientation() == TopAbs_Orientation.TopAbs_REVERSED else weight
