"""Do two STEP files hold the same solid?  What damage may leave of one that `verify` still passes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from OCP.BRep import BRep_Tool
from OCP.BRepAdaptor import BRepAdaptor_Curve
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeVertex
from OCP.BRepExtrema import BRepExtrema_DistShapeShape
from OCP.TopAbs import TopAbs_EDGE, TopAbs_VERTEX
from OCP.TopoDS import TopoDS, TopoDS_Edge

from bstcad.cad import step_reading
from bstcad.cad.step_reading import parts_of

FACE = 1e-11  # mm: what sixteen digits of text leave of a control point
REST = 5e-7  # mm: what the report lets edges and vertices bridge


@dataclass(frozen=True)
class Geometry:
    """What OCC reads from a STEP file, apart from side faces, which their edges tell."""

    face: np.ndarray  # control net of the freeform face
    corners: np.ndarray  # (n, 3)
    edges: list[TopoDS_Edge]


def geometry(path: Path) -> Geometry:
    """The solid of a STEP file that can be read."""
    found = step_reading.read(path)
    corners = [BRep_Tool.Pnt_s(TopoDS.Vertex_s(v)).Coord() for v in parts_of(found.shape, TopAbs_VERTEX)]
    corners.sort(key=lambda corner: np.round(corner, 3).tolist())
    edges = [TopoDS.Edge_s(e) for e in parts_of(found.shape, TopAbs_EDGE)]
    return Geometry(found.control_points, np.array(corners), edges)


def apart(edge: TopoDS_Edge, other: TopoDS_Edge) -> float:
    """Largest distance (mm) of nine points of an edge from another, wherever along it."""
    curve = BRepAdaptor_Curve(edge)
    points = (curve.Value(t) for t in np.linspace(curve.FirstParameter(), curve.LastParameter(), 9))
    vertices = (BRepBuilderAPI_MakeVertex(point).Vertex() for point in points)
    return max(BRepExtrema_DistShapeShape(vertex, other).Value() for vertex in vertices)


def immaterial(path: Path, whole: Geometry) -> bool:
    """Is the solid that OCC reads the same: its freeform face to FACE, its corners and each of its edges to REST?"""
    found = geometry(path)
    if found.face.shape != whole.face.shape or found.corners.shape != whole.corners.shape:
        return False
    nearest = [min(range(12), key=lambda k: apart(edge, whole.edges[k])) for edge in found.edges]
    return bool(
        np.abs(found.face - whole.face).max() <= FACE
        and np.abs(found.corners - whole.corners).max() <= REST
        and sorted(nearest) == list(range(12))
        and all(apart(edge, whole.edges[k]) <= REST for edge, k in zip(found.edges, nearest, strict=True))
    )
