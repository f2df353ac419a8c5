"""The edges of a re-read solid: do they lie on the faces they bound, and on the rim of the lens?

OCC's own checks look at the ends of an edge and at a few points between, and call a solid valid whose rim runs the long
way around its circle.
"""

from __future__ import annotations

import math

import numpy as np
from OCP.BRepAdaptor import BRepAdaptor_Curve
from OCP.TopAbs import TopAbs_EDGE, TopAbs_FACE
from OCP.TopExp import TopExp_Explorer
from OCP.TopoDS import TopoDS, TopoDS_Solid

from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Outline
from bstcad.optics.surfaces import sag

A_SPAN = 4  # points a knot span: one pole of a curve moves three spans


def off(shape: TopoDS_Solid, lens: Lens) -> tuple[tuple[float, str], tuple[float, str]]:
    """Largest distance (mm) of an edge from a face it bounds, and from the wall of the lens, with places."""
    spans = max(lens.back.m - 2, math.ceil(2 * max(lens.outline.half_extent) / lens.front.detail))
    share = np.linspace(0.0, 1.0, A_SPAN * spans + 1)
    from_faces, on_rim = [], []
    faces = TopExp_Explorer(shape, TopAbs_FACE)
    while faces.More():
        face = TopoDS.Face_s(faces.Current())
        edges = TopExp_Explorer(face, TopAbs_EDGE)
        while edges.More():
            edge = TopoDS.Edge_s(edges.Current())
            points = _points(BRepAdaptor_Curve(edge), share)
            apart = np.linalg.norm(points - _points(BRepAdaptor_Curve(edge, face), share), axis=1)
            from_faces.append(_worst(apart, points))
            on_rim.append(_worst(_off_rim(points, lens), points))
            edges.Next()
        faces.Next()
    nothing = (float("inf"), "no edge")
    return max(from_faces, default=nothing), max(on_rim, default=nothing)


def _points(curve: BRepAdaptor_Curve, share: np.ndarray) -> np.ndarray:
    """Points (n, 3) of a curve, in space or by way of a face, at parts of its parameter."""
    first, last = curve.FirstParameter(), curve.LastParameter()
    places = (curve.Value(t).Coord() for t in (first + share * (last - first)).tolist())
    return np.fromiter(places, np.dtype((float, 3)), len(share))


def _worst(apart: np.ndarray, points: np.ndarray) -> tuple[float, str]:
    k = int(np.where(np.isfinite(apart), apart, np.inf).argmax())
    distance = float(apart[k]) if np.isfinite(apart[k]) else float("inf")
    return distance, "at ({:.4g}, {:.4g}, {:.4g}) mm".format(*points[k])


def _off_rim(points: np.ndarray, lens: Lens) -> np.ndarray:
    """How far each point lies from the wall of the lens between its faces."""
    x, y, z = points.T
    beyond = np.maximum(z - sag(lens.back, x, y), sag(lens.front, x, y) - z)
    return np.maximum(np.abs(_outside(lens.outline, points)), beyond)


def _outside(outline: Outline, points: np.ndarray) -> np.ndarray:
    """Distance of each point from the outline, negative inside, along the nearer axis beyond a corner."""
    x, y, _ = points.T
    if isinstance(outline, Circle):
        return np.hypot(x, y) - outline.radius
    a, b = outline.half_extent
    return np.maximum(np.abs(x) - a, np.abs(y) - b)
