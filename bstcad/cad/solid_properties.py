"""Area, volume and centroid of any part of lenses, from the faces and edges of its solid alone, to about 1e-8.

Each face is summed along its border by Green's theorem: a large net in (x, y) by optics.quadrature, any other face in
its own parameters (u, v).  OCC's integrals take minutes over a large net; beside one, where an edge has thousands of
knots, they are off by 1e-5.
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
from bstcad.optics import quadrature
from bstcad.optics.quadrature import EDGE_PARTS, MIN_RELATIVE_DX, POINTS, Border, MassProperties, Sums

if TYPE_CHECKING:
    import cadquery

Point = tuple[float, float, float]

STRAIGHT = 2  # Gauss points along v where r and its derivatives are linear: r (r · n) is cubic at most
ALONG_V = {  # Gauss points along v by the kind of a face, which leave only rounding: straight, up to a turn, a patch
    Kind.GeomAbs_Plane: STRAIGHT, Kind.GeomAbs_Cylinder: STRAIGHT, Kind.GeomAbs_Cone: STRAIGHT,
    Kind.GeomAbs_SurfaceOfExtrusion: STRAIGHT,
    Kind.GeomAbs_Sphere: 12, Kind.GeomAbs_Torus: 12, Kind.GeomAbs_BSplineSurface: 32,
}  # fmt: skip
ARC_PARTS, ARC_POINTS = 8, 12  # of an edge that is a line or an arc on a smooth face: they leave only rounding


@dataclass(frozen=True)
class WholePart:
    """A lens whose walls are not those of its outline: with a flange, draft or bevel, or cut to a wire."""

    edge: np.ndarray  # (n, 2) points in mm, once around the back
    low: Point  # least x, y and z (mm) of all faces but freeform ones, whose edges are others', too
    high: Point  # the largest
    properties: MassProperties | None  # None: it has faces of kinds that nothing here integrates


def whole_part(reread: StepLens, properties: MassProperties | None) -> WholePart | None:
    """The part around the lens of a STEP file; None of a bare lens."""
    if reread.edge is None:
        return None
    box = Bnd_Box()
    for face in map(TopoDS.Face_s, parts_of(reread.shape, TopAbs_FACE)):
        if not step_reading.is_freeform(BRepAdaptor_Surface(face)):
            BRepBndLib.AddOptimal_s(face, box, False, False)  # by the shape, not by its mesh and tolerance
    return WholePart(reread.edge, box.CornerMin().Coord(), box.CornerMax().Coord(), properties)


def of_solid(solid: cadquery.Shape | TopoDS_Shape) -> MassProperties | None:
    """Of a part in which the axes of lenses run along z; None if it has a face of a kind that is not known here."""
    shape: TopoDS_Shape = getattr(solid, "wrapped", solid)
    vertex = TopoDS.Vertex_s(parts_of(shape, TopAbs_VERTEX)[0])
    z_ref = BRep_Tool.Pnt_s(vertex).Z()  # of the sums' origin, near the part: gaps weigh by their distance from it
    try:
        total = sum((_of_face(TopoDS.Face_s(face), z_ref) for face in parts_of(shape, TopAbs_FACE)), Sums())
        return MassProperties.of(total, z_ref)
    except (ValueError, Standard_Failure):  # the latter of a damaged file
        return None


def _of_face(face: TopoDS_Face, z_ref: float) -> Sums:
    surface = BRepAdaptor_Surface(face)
    if step_reading.is_freeform(surface):
        net = step_reading.freeform_surface(face)
        return quadrature.of_face(net, Border(*_joined(_along(edge) for edge in _edges(face))), net.z - z_ref)
    if surface.GetType() not in ALONG_V:
        raise ValueError("a face is of a kind that is not known here; write it again")
    return _in_parameters(face, surface, z_ref)


def _in_parameters(face: TopoDS_Face, surface: BRepAdaptor_Surface, z_ref: float) -> Sums:
    """∫∫ g du dv = -∮ G du with G = ∫ g dv from a fixed v to the border; n dA = ∂r/∂u x ∂r/∂v du dv.

    A face that OCC has reversed has its border reversed, too, which turns n.
    """
    u, v, du = (each[:, None] for each in _joined(_image(edge, face) for edge in _edges(face)))
    spline = surface.GetType() == Kind.GeomAbs_BSplineSurface
    ruled = spline and surface.VDegree() == 1 and surface.NbVPoles() == 2
    point, weight = quadrature.gauss_rule(STRAIGHT if ruled else ALONG_V[surface.GetType()])
    half = (v - BRepTools.UVBounds_s(face)[2]) / 2
    u, along, weight = np.broadcast_arrays(u, v + half * (point - 1), -du * half * weight)
    found = step_reading.points_and_tangents(surface, u.ravel().tolist(), along.ravel().tolist())
    r, normal = found[:, 0] - (0.0, 0.0, z_ref), np.cross(found[:, 1], found[:, 2])
    cone = weight.ravel() * (r * normal).sum(axis=1)
    area = weight.ravel() * np.linalg.norm(normal, axis=1)
    return Sums(abs(float(area.sum())), float(cone.sum()) / 3, (cone[:, None] * r).sum(axis=0) / 4)


def _edges(face: TopoDS_Face) -> Iterator[TopoDS_Edge]:
    """The edges of a face as it walks them, a seam twice."""
    explorer = TopExp_Explorer(face, TopAbs_EDGE)
    while explorer.More():
        yield TopoDS.Edge_s(explorer.Current())
        explorer.Next()


def _joined(parts: Iterator[tuple[np.ndarray, ...]]) -> list[np.ndarray]:
    return [np.concatenate(each) for each in zip(*parts, strict=True)]


def _along(edge: TopoDS_Edge) -> tuple[np.ndarray, ...]:
    """x, y and weights of dx and dy of Gauss points along an edge in space."""
    curve = BRepAdaptor_Curve(edge)
    t, weight = _gauss_points(edge, [curve], over_net=True)
    x, y, _, dx, dy, _ = _evaluated(curve, t, gp_Pnt(), gp_Vec())
    return x, y, weight * dx, weight * dy


def _image(edge: TopoDS_Edge, face: TopoDS_Face) -> tuple[np.ndarray, ...]:
    """u, v and weights of du of Gauss points along an edge in the parameters of its face, where u changes."""
    curve = BRepAdaptor_Curve2d(edge, face)
    curves = [curve] if BRep_Tool.Degenerated_s(edge) else [curve, BRepAdaptor_Curve(edge)]
    t, weight = _gauss_points(edge, curves)
    u, v, du, dv = _evaluated(curve, t, gp_Pnt2d(), gp_Vec2d())
    moves = np.abs(du) > MIN_RELATIVE_DX * np.hypot(du, dv)
    return u[moves], v[moves], (weight * du)[moves]


def _evaluated(
    curve: BRepAdaptor_Curve | BRepAdaptor_Curve2d, t: np.ndarray, point: gp_Pnt | gp_Pnt2d, tangent: gp_Vec | gp_Vec2d
) -> np.ndarray:
    """The coordinates of a curve and then those of its derivative, each (n,); point, tangent: where OCC puts them."""
    rows = []
    for value in t.tolist():
        curve.D1(value, point, tangent)
        rows.append((*point.Coord(), *tangent.Coord()))
    return np.array(rows).T


def _gauss_points(
    edge: TopoDS_Edge, curves: Sequence[BRepAdaptor_Curve | BRepAdaptor_Curve2d], over_net: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters and weights in the sense of an edge, in parts that meet no knot of its curves."""
    first, last = curves[0].FirstParameter(), curves[0].LastParameter()
    knots = {first, last}
    for curve in curves:
        if curve.GetType() == GeomAbs_CurveType.GeomAbs_BSplineCurve:
            spline = curve.BSpline()
            knots.update(k for k in map(spline.Knot, range(1, spline.NbKnots() + 1)) if first < k < last)
    parts, points = (EDGE_PARTS, POINTS) if over_net or len(knots) > 2 else (ARC_PARTS, ARC_POINTS)
    t, weight = quadrature.gauss_points(quadrature.divided(np.array(sorted(knots)), parts), points)
    return t, -weight if edge.Orientation() == TopAbs_Orientation.TopAbs_REVERSED else weight
