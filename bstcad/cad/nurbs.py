"""Arrays to OCC and back: control nets and knots become B-splines with no approximation step in between.

Every array that OCC needs (TColgp, TColStd) is built here and nowhere else, because OCC 8 moves those names.
"""

from __future__ import annotations

import numpy as np
from OCP.Geom import Geom_BSplineCurve, Geom_BSplineSurface
from OCP.Geom2d import Geom2d_BSplineCurve
from OCP.gp import gp_Pnt, gp_Pnt2d
from OCP.TColgp import TColgp_Array1OfPnt, TColgp_Array1OfPnt2d, TColgp_Array2OfPnt
from OCP.TColStd import TColStd_Array1OfInteger, TColStd_Array1OfReal, TColStd_Array2OfReal


def _reals(values: np.ndarray) -> TColStd_Array1OfReal:
    array = TColStd_Array1OfReal(1, len(values))
    for i, value in enumerate(values, start=1):
        array.SetValue(i, float(value))
    return array


def _real_table(values: np.ndarray) -> TColStd_Array2OfReal:
    m, n = values.shape
    array = TColStd_Array2OfReal(1, m, 1, n)
    for i, row in enumerate(values.tolist(), start=1):
        for j, value in enumerate(row, start=1):
            array.SetValue(i, j, value)
    return array


def _knot_arrays(full: np.ndarray) -> tuple[TColStd_Array1OfReal, TColStd_Array1OfInteger]:
    """A full knot vector as OCC wants it: distinct values and their multiplicities."""
    values, counts = np.unique(full, return_counts=True)
    multiplicities = TColStd_Array1OfInteger(1, len(counts))
    for i, count in enumerate(counts.tolist(), start=1):
        multiplicities.SetValue(i, count)
    return _reals(values), multiplicities


def bspline_surface(
    net: np.ndarray, knots_u: np.ndarray, knots_v: np.ndarray, weights: np.ndarray | None = None
) -> Geom_BSplineSurface:
    """The B-spline surface of a control net (m, n, 3) in mm and two full knot vectors; rational by weights (m, n)."""
    m, n = net.shape[:2]
    poles, pole = TColgp_Array2OfPnt(1, m, 1, n), gp_Pnt()
    place, put = pole.SetCoord, poles.SetValue
    for i, row in enumerate(net.tolist(), start=1):
        for j, (x, y, z) in enumerate(row, start=1):
            place(x, y, z)
            put(i, j, pole)  # copies it
    u, count_u = _knot_arrays(knots_u)
    v, count_v = _knot_arrays(knots_v)
    degree_u, degree_v = len(knots_u) - m - 1, len(knots_v) - n - 1
    if weights is None:
        return Geom_BSplineSurface(poles, u, v, count_u, count_v, degree_u, degree_v)
    return Geom_BSplineSurface(poles, _real_table(weights), u, v, count_u, count_v, degree_u, degree_v)


def bspline_curve(poles: np.ndarray, full_knots: np.ndarray) -> Geom_BSplineCurve:
    """The B-spline curve of control points (n, 3) in mm and a full knot vector."""
    array = TColgp_Array1OfPnt(1, len(poles))
    for i, xyz in enumerate(poles.tolist(), start=1):
        array.SetValue(i, gp_Pnt(*xyz))
    return Geom_BSplineCurve(array, *_knot_arrays(full_knots), len(full_knots) - len(poles) - 1)


def bspline_curve_2d(poles: np.ndarray, full_knots: np.ndarray) -> Geom2d_BSplineCurve:
    """The B-spline curve of control points (n, 2) in the parameter plane of a face."""
    array = TColgp_Array1OfPnt2d(1, len(poles))
    for i, uv in enumerate(poles.tolist(), start=1):
        array.SetValue(i, gp_Pnt2d(*uv))
    return Geom2d_BSplineCurve(array, *_knot_arrays(full_knots), len(full_knots) - len(poles) - 1)


def net_of(surface: Geom_BSplineSurface) -> np.ndarray:
    """Control points (m, n, 3) in mm of an OCC B-spline surface, u along the first axis."""
    pole = surface.Poles().Value
    m, n = surface.NbUPoles(), surface.NbVPoles()
    places = (pole(i, j).Coord() for i in range(1, m + 1) for j in range(1, n + 1))
    return np.fromiter(places, np.dtype((float, 3)), m * n).reshape(m, n, 3)


def weights_of(surface: Geom_BSplineSurface) -> np.ndarray:
    """The weights (m, n) of an OCC B-spline surface, all 1 if it is not rational."""
    m, n = surface.NbUPoles(), surface.NbVPoles()
    return np.array([[surface.Weight(i, j) for j in range(1, n + 1)] for i in range(1, m + 1)])


def knots_of(surface: Geom_BSplineSurface) -> tuple[np.ndarray, np.ndarray]:
    """The full knot vectors in u and in v of an OCC B-spline surface."""
    u, v = surface.UKnotSequence(), surface.VKnotSequence()
    return (
        np.array([u.Value(i) for i in range(u.Lower(), u.Upper() + 1)]),
        np.array([v.Value(i) for i in range(v.Lower(), v.Upper() + 1)]),
    )
