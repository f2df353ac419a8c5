"""Area, volume and centroid of a part as it was read back, from its faces and edges alone.

V = ∮ z n_z dA, V c = ∮ (x z, y z, z² / 2) n_z dA.  Of a face z = h(x, y) that is ∫∫ h dx dy and so on, by quadrature
along its edges, since OCC takes minutes over a large net.  Walls along z have no part in it, and their area is ∮ z ds.
On planes and cones about z n_z is a constant, and OCC knows the rest; ruled walls are summed all over.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from OCP.BRepAdaptor import BRepAdaptor_Curve, BRepAdaptor_Curve2d, BRepAdaptor_Surface
from OCP.BRepGProp import BRepGProp
from OCP.BRepTools import BRepTools
from OCP.GeomAbs import GeomAbs_CurveType
from OCP.GeomAbs import GeomAbs_SurfaceType as Kind
from OCP.gp import gp_Pnt, gp_Pnt2d, gp_Vec, gp_Vec2d
from OCP.GProp import GProp_GProps
from OCP.TopAbs import TopAbs_EDGE, TopAbs_FACE, TopAbs_Orientation
from OCP.TopExp import TopExp_Explorer
from OCP.TopoDS import TopoDS, TopoDS_Edge, TopoDS_Face, TopoDS_Shape

from bstcad.cad import step_reading
from bstcad.cad.mass_properties import MassProperties
from bstcad.optics.border_sums import Border, border_sums
from bstcad.optics.face_sums import gauss_points

POINTS = 4  # in each part of an edge
PARTS = 64  # of an edge without knots
PRECISE = 1e-9  # of themselves, asked of OCC on planes and cones
UPRIGHT = 1e-9  # of a wall's normal or a cone's axis; further off it is neither

Sums = tuple[float, float, np.ndarray]  # area (mm²), part of the volume (mm³), part of volume times centroid (mm⁴)


def of_solid(solid: TopoDS_Shape) -> MassProperties:
    """Of a part of lenses whose axes run along z; ValueError if it has a face of a kind that is not known here."""
    area, volume, moment = 0.0, 0.0, np.zeros(3)
    for face in map(TopoDS.Face_s, _inside(solid, TopAbs_FACE)):
        own = _of_face(face)
        area, volume, moment = area + own[0], volume + own[1], moment + own[2]
    x, y, z = (moment / volume).tolist()
    return MassProperties(area, volume, (x, y, z))


def _inside(shape: TopoDS_Shape, kind: object) -> Iterator[TopoDS_Shape]:
    explorer = TopExp_Explorer(shape, kind)
    while explorer.More():
        yield explorer.Current()
        explorer.Next()


def _of_face(face: TopoDS_Face) -> Sums:
    surface = BRepAdaptor_Surface(face)
    kind = surface.GetType()
    if kind == Kind.GeomAbs_BSplineSurface and min(surface.UDegree(), surface.VDegree()) == 1:
        return _ruled(face, surface)
    if kind in (Kind.GeomAbs_BSplineSurface, Kind.GeomAbs_Sphere):
        return _height(face)
    if kind == Kind.GeomAbs_Plane:
        normal = surface.Plane().Axis().Direction()
        if abs(normal.Z()) < UPRIGHT:
            return _wall(face, lambda x, y: (normal.X(), normal.Y()))
        return _slanted(face, surface)
    if kind == Kind.GeomAbs_Cylinder and 1 - abs(surface.Cylinder().Axis().Direction().Z()) < UPRIGHT:
        centre, radius = surface.Cylinder().Location(), surface.Cylinder().Radius()
        return _wall(face, lambda x, y: ((x - centre.X()) / radius, (y - centre.Y()) / radius))
    if kind == Kind.GeomAbs_SurfaceOfExtrusion and 1 - abs(surface.Direction().Z()) < UPRIGHT:
        return _extruded(face)
    if kind == Kind.GeomAbs_Cone and 1 - abs(surface.Cone().Axis().Direction().Z()) < UPRIGHT:
        return _slanted(face, surface)
    raise ValueError(
        f"a face is of a kind ({kind.name.removeprefix('GeomAbs_')}) that is not known here; write it again"
    )


def _height(face: TopoDS_Face) -> Sums:
    """Of an optical face: seen against z its edges run clockwise if it looks down, which turns the sign of all sums."""
    surface = step_reading.height(face)
    x, y, _, dx, dy = _around(face)
    found = border_sums(surface, Border(x, y, dx, np.hypot(dx, dy)), surface.z)
    return abs(found.area), found.first, np.array([found.in_x, found.in_y, found.second / 2])


def _wall(face: TopoDS_Face, normal: Callable[[np.ndarray, np.ndarray], tuple]) -> Sums:
    """Of a wall along z; normal: its (n_x, n_y) at (x, y), inwards or outwards."""
    x, y, z, dx, dy = _around(face)
    n_x, n_y = normal(x, y)
    return abs(float((z * (n_x * dy - n_y * dx)).sum())), 0.0, np.zeros(3)


def _extruded(face: TopoDS_Face) -> Sums:
    """Of a wall along z over any curve, by whose parameter an edge runs on or back."""
    area = 0.0
    for edge in map(TopoDS.Edge_s, _inside(face, TopAbs_EDGE)):
        _, _, z, dx, dy = _along(edge)
        image, place, step = BRepAdaptor_Curve2d(edge, face), gp_Pnt2d(), gp_Vec2d()
        image.D1((image.FirstParameter() + image.LastParameter()) / 2, place, step)
        turn = -1 if edge.Orientation() == TopAbs_Orientation.TopAbs_REVERSED else 1
        area += turn * math.copysign(1.0, step.X()) * float((z * np.hypot(dx, dy)).sum())
    return abs(area), 0.0, np.zeros(3)


def _slanted(face: TopoDS_Face, surface: BRepAdaptor_Surface) -> Sums:
    """Of a plane or a cone about z: n_z ∫ z dA and so on, from the moments that OCC finds."""
    found = GProp_GProps()
    BRepGProp.SurfaceProperties_s(face, found, PRECISE)  # without it only so many points are taken
    area, (x, y, z) = found.Mass(), found.CentreOfMass().Coord()
    about = found.MatrixOfInertia()  # the centroid: on the diagonal ∫ (y² + z²) dA …, beside it -∫ x y dA …
    x_z, y_z = area * x * z - about.Value(1, 3), area * y * z - about.Value(2, 3)
    z_z = area * z * z + (about.Value(1, 1) + about.Value(2, 2) - about.Value(3, 3)) / 2
    n_z = _upwards(face, surface)
    return area, n_z * area * z, n_z * np.array([x_z, y_z, z_z / 2])


def _ruled(face: TopoDS_Face, surface: BRepAdaptor_Surface) -> Sums:
    """Of a ruled wall within its own borders, by Gauss points all over it; ValueError within others."""
    spline = surface.BSpline()
    ends = np.array([BRepTools.UVBounds_s(face), spline.Bounds()])
    if np.abs(ends[0] - ends[1]).max() > UPRIGHT or len(list(_inside(face, TopAbs_EDGE))) > 4:
        raise ValueError("a ruled face is cut by other borders than its own; write it again")
    u, weight_u = gauss_points(np.array([spline.UKnot(k) for k in range(1, spline.NbUKnots() + 1)]), POINTS)
    v, weight_v = gauss_points(np.array([spline.VKnot(k) for k in range(1, spline.NbVKnots() + 1)]), POINTS)
    rows, place, along_u, along_v = [], gp_Pnt(), gp_Vec(), gp_Vec()
    for each_u in u.tolist():
        for each_v in v.tolist():
            spline.D1(each_u, each_v, place, along_u, along_v)
            rows.append((*place.Coord(), *along_u.Crossed(along_v).Coord()))
    x, y, z, *normal = np.array(rows).T
    weight = np.outer(weight_u, weight_v).ravel()
    turn = -1 if face.Orientation() == TopAbs_Orientation.TopAbs_REVERSED else 1
    up = turn * weight * normal[2]
    area = float(weight @ np.sqrt(sum(each**2 for each in normal)))
    return area, float(up @ z), np.array([up @ (x * z), up @ (y * z), up @ (z * z) / 2])


def _upwards(face: TopoDS_Face, surface: BRepAdaptor_Surface) -> float:
    """n_z of the unit normal that looks out of the solid, in the middle of a face."""
    u = (surface.FirstUParameter() + surface.LastUParameter()) / 2
    v = (surface.FirstVParameter() + surface.LastVParameter()) / 2
    place, along_u, along_v = gp_Pnt(), gp_Vec(), gp_Vec()
    surface.D1(u, v, place, along_u, along_v)
    normal = along_u.Crossed(along_v).Normalized()
    return normal.Z() * (-1 if face.Orientation() == TopAbs_Orientation.TopAbs_REVERSED else 1)


def _around(face: TopoDS_Face) -> list[np.ndarray]:
    """x, y, z and weights of dx and dy of Gauss points along the edges, counterclockwise seen from outside."""
    along = [_along(TopoDS.Edge_s(edge)) for edge in _inside(face, TopAbs_EDGE)]
    return [np.concatenate(each) for each in zip(*along, strict=True)]


def _along(edge: TopoDS_Edge) -> tuple[np.ndarray, ...]:
    """The same of one edge, in the direction in which its face has it."""
    curve = BRepAdaptor_Curve(edge)
    t, weight = gauss_points(_breaks(curve), POINTS)
    weight = -weight if edge.Orientation() == TopAbs_Orientation.TopAbs_REVERSED else weight
    (x, y, z, dx, dy), p, v = np.empty((5, len(t))), gp_Pnt(), gp_Vec()
    for k, value in enumerate(t.tolist()):
        curve.D1(value, p, v)
        x[k], y[k], z[k], dx[k], dy[k] = p.X(), p.Y(), p.Z(), v.X(), v.Y()
    return x, y, z, weight * dx, weight * dy


def _breaks(curve: BRepAdaptor_Curve) -> np.ndarray:
    """Ascending parameters, from the edge's one end to its other, between which its curve is smooth."""
    first, last = curve.FirstParameter(), curve.LastParameter()
    if curve.GetType() != GeomAbs_CurveType.GeomAbs_BSplineCurve:
        return np.linspace(first, last, PARTS + 1)
    spline = curve.BSpline()
    inner = np.array([spline.Knot(k) for k in range(1, spline.NbKnots() + 1)])
    return np.concatenate([[first], inner[(inner > first) & (inner < last)], [last]])
