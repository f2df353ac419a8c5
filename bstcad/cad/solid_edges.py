"""The edges of a re-read solid: the outline that they tell, and whether they lie on the faces that they bound.

OCC's own checks look at the ends of an edge and at a few points between, and call a solid valid whose rim runs the long
way around its circle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from OCP.BRep import BRep_Tool
from OCP.BRepAdaptor import BRepAdaptor_Curve, BRepAdaptor_Surface
from OCP.BRepTools import BRepTools, BRepTools_WireExplorer
from OCP.GeomAbs import GeomAbs_SurfaceType as Kind
from OCP.TopAbs import TopAbs_EDGE, TopAbs_FACE, TopAbs_Orientation, TopAbs_ShapeEnum
from OCP.TopExp import TopExp
from OCP.TopoDS import TopoDS, TopoDS_Face, TopoDS_Shape
from OCP.TopTools import TopTools_IndexedMapOfShape

from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Outline, Rectangle, Rounded
from bstcad.optics.surfaces import sag

AXIAL = 1e-9  # mm or rad; walls further off lie elsewhere
ROUND = 1e-6  # mm; the edge of a round back follows its circle more closely
DIGITS = 9  # of a clear aperture in mm: what is finer is rounding of the file's coordinates
EDGE_POINTS = 129  # on each edge of a face
SPAN_POINTS = 4  # points a knot span: one pole of a curve moves three spans


def parts_of(shape: TopoDS_Shape, kind: TopAbs_ShapeEnum) -> list[TopoDS_Shape]:
    """The solids, faces, edges or vertices of a shape, each once, as cadquery's Faces() has them.

    Without cadquery, whose import would cost a proof 1.4 s.
    """
    parts = TopTools_IndexedMapOfShape()
    TopExp.MapShapes_s(shape, kind, parts)
    return [parts(i) for i in range(1, parts.Extent() + 1)]


# ---- outlines ------------------------------------------------------------------------------------------------------


def of_walls(walls: Sequence[BRepAdaptor_Surface]) -> Outline | None:
    """The outline whose wall these faces are and no more; None of others, such as those of a flange or with draft."""
    if all(wall.GetType() == Kind.GeomAbs_Cylinder for wall in walls):
        radii = [_radius(wall) for wall in walls]
        return Circle(max(radii)) if radii and max(radii) - min(radii) <= AXIAL else None
    if len(walls) == 4 and all(wall.GetType() == Kind.GeomAbs_Plane for wall in walls):
        planes = [wall.Plane() for wall in walls]
        normals = np.abs([plane.Axis().Direction().Coord() for plane in planes])
        points = np.array([plane.Location().Coord() for plane in planes])
        along = [points[normals[:, axis] > 1 - AXIAL, axis] for axis in (0, 1)]
        if all(len(pair) == 2 and abs(pair.sum()) <= AXIAL for pair in along):
            return Rectangle(*(float(np.ptp(pair)) for pair in along))
    return None


def _radius(wall: BRepAdaptor_Surface) -> float:
    """The radius (mm) of a cylinder on the axis; infinite off it."""
    axis = wall.Cylinder().Axis()
    off = max(abs(axis.Location().X()), abs(axis.Location().Y()), 1 - abs(axis.Direction().Z()))
    return wall.Cylinder().Radius() if off <= AXIAL else math.inf


def edge(face: TopoDS_Face) -> np.ndarray:
    """Points (n, 2) in mm along the outer edge of a face, once around."""
    parts, explorer = [], BRepTools_WireExplorer(BRepTools.OuterWire_s(face), face)
    while explorer.More():
        curve = BRepAdaptor_Curve(explorer.Current())
        t = np.linspace(curve.FirstParameter(), curve.LastParameter(), EDGE_POINTS)
        if explorer.Orientation() == TopAbs_Orientation.TopAbs_REVERSED:
            t = t[::-1]
        parts += [curve.Value(each).Coord()[:2] for each in t[:-1].tolist()]
        explorer.Next()
    return np.array(parts)


def clear(front: np.ndarray, back: np.ndarray) -> tuple[Outline, Outline]:
    """The clear apertures of front and back, by points (n, 2) in mm along the edges of these faces.

    That of the back is the circle or the rectangle, its corners round or sharp, about the axis on which its edge lies.
    That of the front lies inside it by the largest inset of the front's edge.  An edge that reaches beyond the back's,
    as that of a front in one plane with a flange does, bounds no light that the lens is made for.
    ValueError if the edge of the back is of another shape.
    """
    rim = around(back)
    if isinstance(rim, Circle):
        rim = Circle(round(rim.radius, DIGITS))
    else:
        corner = float((rim.width + rim.height) / 2 - np.abs(back).sum(axis=1).max()) / (2 - math.sqrt(2))
        size = round(rim.width, DIGITS), round(rim.height, DIGITS)
        rim = Rounded(*size, corner_radius=round(corner, DIGITS)) if corner > ROUND else Rectangle(*size)
    if not (off := np.abs(rim.depth(*back.T)).max()) <= ROUND:
        raise ValueError(f"the edge of the back lies up to {off:.2g} mm off any circle or rectangle about the axis")
    inset = float(rim.depth(*front.T).max())
    return rim.inset(round(inset, DIGITS)) if inset > ROUND else rim, rim


def around(points: np.ndarray) -> Outline:
    """The circle about the axis on which all the points lie, else the rectangle about it that just holds them."""
    distance = np.hypot(*points.T)
    if np.ptp(distance) <= ROUND:
        return Circle(float(distance.max()))
    width, height = (2 * np.abs(points).max(axis=0)).tolist()
    return Rectangle(width, height)


# ---- checks --------------------------------------------------------------------------------------------------------


def along_edges(solid: TopoDS_Shape) -> np.ndarray:
    """(n, 3) ends and middles of all edges (mm), whatever their order."""
    found = []
    for each in map(TopoDS.Edge_s, parts_of(solid, TopAbs_EDGE)):
        if BRep_Tool.Degenerated_s(each):  # a point, such as a cone's apex
            continue
        curve = BRepAdaptor_Curve(each)
        found.append(_points(curve, np.array([0.0, 0.5, 1.0])))
    return np.concatenate(found)


def off(shape: TopoDS_Shape, lens: Lens) -> tuple[tuple[float, str], tuple[float, str]]:
    """Largest distance (mm) of an edge from a face it bounds, and from the wall of the lens, each with its place."""
    spans = max(lens.back.m - 2, math.ceil(2 * max(lens.outline.half_extent) / lens.front.detail))
    share = np.linspace(0.0, 1.0, SPAN_POINTS * spans + 1)
    from_faces, from_rim = [], []
    for face in map(TopoDS.Face_s, parts_of(shape, TopAbs_FACE)):
        for each in map(TopoDS.Edge_s, parts_of(face, TopAbs_EDGE)):
            points = _points(BRepAdaptor_Curve(each), share)
            distance = np.linalg.norm(points - _points(BRepAdaptor_Curve(each, face), share), axis=1)
            from_faces.append(_worst(distance, points))
            from_rim.append(_worst(_off_rim(points, lens), points))
    nothing = (float("inf"), "no edge")
    return max(from_faces, default=nothing), max(from_rim, default=nothing)


def _points(curve: BRepAdaptor_Curve, share: np.ndarray) -> np.ndarray:
    """Points (n, 3) of a curve, in space or by way of a face, at shares of its parameter."""
    first, last = curve.FirstParameter(), curve.LastParameter()
    points = (curve.Value(t).Coord() for t in (first + share * (last - first)).tolist())
    return np.fromiter(points, np.dtype((float, 3)), len(share))


def _worst(distance: np.ndarray, points: np.ndarray) -> tuple[float, str]:
    k = int(np.where(np.isfinite(distance), distance, np.inf).argmax())
    worst = float(distance[k]) if np.isfinite(distance[k]) else float("inf")
    return worst, "at ({:.4g}, {:.4g}, {:.4g}) mm".format(*points[k])


def _off_rim(points: np.ndarray, lens: Lens) -> np.ndarray:
    """Distance of each point from the wall of the lens between its faces."""
    x, y, z = points.T
    beyond = np.maximum(z - sag(lens.back, x, y), sag(lens.front, x, y) - z)
    return np.maximum(np.abs(_outside(lens.outline, x, y)), beyond)


def _outside(outline: Outline, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Distance of each point from the outline, negative inside, along the nearer axis beyond a corner."""
    if isinstance(outline, Circle):
        return np.hypot(x, y) - outline.radius
    a, b = outline.half_extent
    return np.maximum(np.abs(x) - a, np.abs(y) - b)
