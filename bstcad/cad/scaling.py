"""Scale a solid about a point of the axis, by one factor or by one along each of x, y and z.

The image of a B-spline face under x → c + F (x - c), F = diag(f_x, f_y, f_z), is the B-spline with the knots of the
face and the scaled control points, since the basis functions add up to one (Piegl and Tiller, "The NURBS Book", 1997,
property P4.8).  With one factor every face keeps its kind: a sphere stays a sphere.  With unequal factors OCC first
writes all faces and edges as NURBS, which is exact for planes, cylinders, cones, spheres and B-splines.
"""

from __future__ import annotations

from collections.abc import Sequence

import cadquery
from OCP.BRepBuilderAPI import BRepBuilderAPI_GTransform, BRepBuilderAPI_Transform
from OCP.gp import gp_GTrsf, gp_Mat, gp_Pnt, gp_Trsf, gp_XYZ
from OCP.TopAbs import TopAbs_SOLID
from OCP.TopExp import TopExp_Explorer
from OCP.TopoDS import TopoDS

from bstcad.cad.solid import NamedSolid

INVALID = "moulding: the enlarged solid is not valid; give one shrinkage in place of three"


def scaled(part: NamedSolid, factors: Sequence[float], about: float) -> NamedSolid:
    """Return a solid scaled by factors (f_x, f_y, f_z) about the point of the axis at z = `about` (mm).

    The faces keep their order and their names.  Raises ValueError if OCC returns no valid solid.
    """
    f_x, f_y, f_z = factors
    if f_x == f_y == f_z:
        similarity = gp_Trsf()
        similarity.SetScale(gp_Pnt(0.0, 0.0, about), f_x)
        shape = BRepBuilderAPI_Transform(part.solid.wrapped, similarity, True).Shape()
    else:
        matrix = gp_Mat()
        matrix.SetDiagonal(f_x, f_y, f_z)
        affine = gp_GTrsf(matrix, gp_XYZ(0.0, 0.0, (1 - f_z) * about))
        shape = BRepBuilderAPI_GTransform(part.solid.wrapped, affine, True).Shape()
    found = TopExp_Explorer(shape, TopAbs_SOLID)
    solid = cadquery.Solid(TopoDS.Solid_s(found.Current())) if found.More() else None
    if solid is None or not solid.isValid() or len(solid.Faces()) != len(part.faces):
        raise ValueError(INVALID)
    return NamedSolid(solid, part.faces)
