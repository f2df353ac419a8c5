"""The outline of a lens as it was read back: what its walls say, or else how far the edge of its back reaches."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from OCP.BRepAdaptor import BRepAdaptor_Curve, BRepAdaptor_Surface
from OCP.BRepTools import BRepTools, BRepTools_WireExplorer
from OCP.GeomAbs import GeomAbs_SurfaceType as Kind
from OCP.TopAbs import TopAbs_Orientation
from OCP.TopoDS import TopoDS_Face

from bstcad.optics.outlines import Circle, Outline, Rectangle, Rounded

AXIAL = 1e-9  # mm or rad; walls further off lie elsewhere
ROUND = 1e-6  # mm; the edge of a round back follows its circle more closely
DIGITS = 9  # of a clear aperture in mm: what is finer is rounding of the file's coordinates
PLACES = 129  # on each part of the edge


def of_walls(walls: Sequence[BRepAdaptor_Surface]) -> Outline | None:
    """The outline whose wall these faces are and no more; None of others, such as those of a flange or with draft."""
    if all(wall.GetType() == Kind.GeomAbs_Cylinder for wall in walls):
        radii = [_radius(wall) for wall in walls]
        return Circle(max(radii)) if radii and max(radii) - min(radii) <= AXIAL else None
    if len(walls) == 4 and all(wall.GetType() == Kind.GeomAbs_Plane for wall in walls):
        planes = [wall.Plane() for wall in walls]
        normals = np.abs([plane.Axis().Direction().Coord() for plane in planes])
        places = np.array([plane.Location().Coord() for plane in planes])
        along = [places[normals[:, axis] > 1 - AXIAL, axis] for axis in (0, 1)]
        if all(len(pair) == 2 and abs(pair.sum()) <= AXIAL for pair in along):
            return Rectangle(*(float(np.ptp(pair)) for pair in along))
    return None


def _radius(wall: BRepAdaptor_Surface) -> float:
    """The radius (mm) of a cylinder on the axis; infinite off it."""
    axis = wall.Cylinder().Axis()
    off = max(abs(axis.Location().X()), abs(axis.Location().Y()), 1 - abs(axis.Direction().Z()))
    return wall.Cylinder().Radius() if off <= AXIAL else math.inf


def edge(face: TopoDS_Face) -> np.ndarray:
    """Places (n, 2) in mm along the outer edge of a face, once around."""
    parts, explorer = [], BRepTools_WireExplorer(BRepTools.OuterWire_s(face), face)
    while explorer.More():
        curve = BRepAdaptor_Curve(explorer.Current())
        t = np.linspace(curve.FirstParameter(), curve.LastParameter(), PLACES)
        if explorer.Orientation() == TopAbs_Orientation.TopAbs_REVERSED:
            t = t[::-1]
        parts += [curve.Value(each).Coord()[:2] for each in t[:-1].tolist()]
        explorer.Next()
    return np.array(parts)


def clear(front: np.ndarray, back: np.ndarray) -> tuple[Outline, Outline]:
    """The clear apertures of front and back, by places (n, 2) in mm along the edges of these faces.

    That of the back is the circle or the rectangle, its corners round or sharp, about the axis on which its edge lies.
    That of the front lies inside it by as much as the front's edge at the most.  An edge that reaches beyond the
    back's, as that of a front in one plane with a flange does, bounds no light that the lens is made for.
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
    taken = float(rim.depth(*front.T).max())
    return rim.inset(round(taken, DIGITS)) if taken > ROUND else rim, rim


def around(places: np.ndarray) -> Outline:
    """The circle about the axis on which all the places lie, else the rectangle about it that just holds them."""
    distance = np.hypot(*places.T)
    if np.ptp(distance) <= ROUND:
        return Circle(float(distance.max()))
    width, height = (2 * np.abs(places).max(axis=0)).tolist()
    return Rectangle(width, height)
