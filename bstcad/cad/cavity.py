"""The cavity of a mould: the lens, or the part with its mount, enlarged by the shrinkage about its datum.

The image of a B-spline face under x → c + F (x - c), F = diag(f_x, f_y, f_z), is the B-spline with the knots of the
face and the scaled control points, since the basis functions add up to one (Piegl and Tiller, "The NURBS Book", 1997,
property P4.8).  With one factor every face keeps its kind: a sphere stays a sphere.  With unequal factors OCC first
writes all faces and edges as NURBS, which is exact for planes, cylinders, cones, spheres and B-splines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cadquery
from OCP.BRepBuilderAPI import BRepBuilderAPI_GTransform, BRepBuilderAPI_Transform
from OCP.gp import gp_GTrsf, gp_Mat, gp_Pnt, gp_Trsf, gp_XYZ
from OCP.TopAbs import TopAbs_SOLID
from OCP.TopExp import TopExp_Explorer
from OCP.TopoDS import TopoDS

from bstcad.cad import mounting, step_writing
from bstcad.cad.solid import NamedSolid, named_solid
from bstcad.optics.lens.lens import Lens
from bstcad.scene.moulding import Moulding
from bstcad.scene.mount import Mount, Part

INVALID = "moulding: the enlarged solid is not valid; give one shrinkage in place of three"


def cavity(lens: Lens, moulding: Moulding, mount: Mount | None = None) -> tuple[NamedSolid, float]:
    """Return the solid that fills the cavity, and z (mm) of the point of the axis about which it is enlarged.

    With a mount the solid is the part in the frame of its datum, as in part.step.  The point is the datum, or else the
    vertex of the front.  Raises ValueError if the part or the cavity is no valid solid.
    """
    if mount is None:
        part, about = named_solid(lens), lens.front_vertex
    else:
        part, about = mounting.part_of(lens, mount), 0.0
        if mount.datum == "source":
            about = lens.front_vertex
    return scaled(part, moulding.factors, about), about


def step_file(solid: NamedSolid, name: str, part: Part) -> bytes:
    """Return the STEP file of a cavity; of the data of the part it states number, author, organisation and schema."""
    keys = {key: getattr(part, key) for key in ("number", "author", "organisation", "schema")}
    return b"".join(step_writing.encode(solid.solid, name, replace(Part(), **keys), faces=solid.faces))


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
