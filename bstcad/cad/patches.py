"""Exact OCC surfaces of the optical faces of a lens, and conversion of arrays to OCC and back.

Each face becomes an OCC surface of the same kind, without a fit: the poles and knots of the back are the control points
and knots of the design.  All OCC arrays (TColgp, TColStd) are built in this module, because OCC 8 moves their classes.

Large nets are passed to OCC and back as bytes of OCC's binary files (BinTools), exact to the last bit.  Passing
2049 x 2049 poles one by one takes 6 s, and reading them back nearly as long.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from io import BytesIO

import numpy as np
import torch
from OCP.BinTools import BinTools
from OCP.BRep import BRep_Builder, BRep_Tool
from OCP.Geom import Geom_BSplineCurve, Geom_BSplineSurface, Geom_Plane, Geom_SphericalSurface, Geom_Surface
from OCP.Geom2d import Geom2d_BSplineCurve
from OCP.gp import gp_Ax3, gp_Dir, gp_Pnt, gp_Pnt2d
from OCP.TColgp import TColgp_Array1OfPnt, TColgp_Array1OfPnt2d, TColgp_Array2OfPnt
from OCP.TColStd import TColStd_Array1OfInteger, TColStd_Array1OfReal, TColStd_Array2OfReal
from OCP.TopoDS import TopoDS, TopoDS_Face, TopoDS_Shape

from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import BSplineSurface, knots, parameter
from bstcad.optics.surfaces.outlines import Circle, Outline
from bstcad.optics.surfaces.sides import MIN_SIDE
from bstcad.optics.surfaces.surfaces import Conic, Sphere

PATCH_MARGIN = 1.02  # ratio of a conic patch's width to the rim's, so that the rim does not touch the patch's boundary
PARABOLA_TOLERANCE = 1e-10  # deviation (mm) of a sphere from a parabola, below which the parabola is written instead

ParameterMap = Callable[[np.ndarray, np.ndarray], np.ndarray]  # map from (x, y) in mm to (u, v) of a patch, (…, 2)


@dataclass(frozen=True)
class FacePatch:
    """The OCC surface of an optical face."""

    surface: Geom_Surface
    outward: bool  # True if the normal of the surface, ∂u x ∂v, points out of the lens
    uv: ParameterMap | None = None  # map to (u, v); None: a plane, on which OCC needs no curves in (u, v)


def back_patch(lens: Lens) -> FacePatch:
    """Return the back, Σ B_i(u) B_j(v) P_ij with the net P and the knots of the design; normal towards +z."""
    return _net_patch(lens.back_net.plain(), lens.outline, outward=True)


def _net_patch(face: BSplineSurface, outline: Outline, outward: bool) -> FacePatch:
    if isinstance(outline, Circle):
        _check_round(face, outline.radius)
    return FacePatch(bspline_surface(face.control_points(), *map(knots, face.shape)), outward, net_parameters(face))


def part_of_net(face: BSplineSurface, x: tuple[float, float], y: tuple[float, float], outward: bool) -> FacePatch:
    """Return the patch of the control points that act over a window (mm): there it is the net, to the last bit.

    Clamped knots change a net in its end spans only, which are 1.5 pitches wide.  So the part begins 1.5 pitches or
    more outside the window, or at the border of the net.  outward: see `FacePatch`.
    """
    rows, columns = (
        _acting(*span, first=first, pitch=pitch, count=count)
        for span, (first, _), pitch, count in zip((x, y), (face.x, face.y), face.pitch, face.shape, strict=True)
    )
    net = face.control_points()[rows, columns]
    (x_low, y_low, _), (x_high, y_high, _) = net[0, 0].tolist(), net[-1, -1].tolist()
    part = BSplineSurface(face.z, face.heights[rows, columns], (x_low, x_high), (y_low, y_high))
    return FacePatch(bspline_surface(net, *map(knots, part.shape)), outward, net_parameters(part))


def _acting(low: float, high: float, *, first: float, pitch: float, count: int) -> slice:
    """Return the control points of one side that act from low to high (mm), MIN_SIDE or more."""
    start = max(math.floor((low - first) / pitch - 1.5), 0)
    end = min(max(math.ceil((high - first) / pitch + 1.5), start + MIN_SIDE - 1), count - 1)
    return slice(max(min(start, end - MIN_SIDE + 1), 0), end + 1)


def net_parameters(face: BSplineSurface) -> ParameterMap:
    """Return the map from (x, y) in mm to the parameters (u, v) of a net."""

    def uv(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        ends = zip((x, y), (face.x, face.y), face.pitch, face.shape, strict=True)
        across = ((np.clip((p - low) / pitch, 0.0, m - 1.0), m) for p, (low, _), pitch, m in ends)
        return np.stack([parameter(torch.from_numpy(p), m).numpy() for p, m in across], axis=-1)

    return uv


def _check_round(surface: BSplineSurface, radius: float) -> None:
    """Raise ValueError unless the rim is a circle in (u, v): x(u) and y(v) must be linear there, with equal pitch."""
    (x0, x1), (y0, y1) = surface.x, surface.y
    dx, dy = surface.pitch
    if abs(dx - dy) > 1e-12 * dx:
        raise ValueError(f"lens: the net's pitch is {dx:g} mm in x, {dy:g} mm in y; give a round lens equal pitches")
    reach = min(-x0, x1, -y0, y1) - 1.5 * dx  # the end spans, where x(u) is quadratic, are 1.5 pitches wide
    if radius > reach + 1e-9 * dx:
        raise ValueError(
            f"lens: the net extends to {reach + 1.5 * dx:g} mm, less than 1.5 control-point spacings beyond the rim at "
            f"{radius:g} mm; extend it to two spacings beyond the rim"
        )


def front_patch(lens: Lens) -> FacePatch:
    """Return the front's optical part as an OCC surface of the same kind, whose normal may point into the lens."""
    front, outline = lens.front.plain().optical, lens.front.outline or lens.outline
    if front.level:
        return level_patch(front.z)
    if front.kind not in PATCHES:
        raise front.unknown
    return PATCHES[front.kind](front, outline)


def level_patch(z: float) -> FacePatch:
    """Return the plane at z (mm), its normal towards -z."""
    return FacePatch(Geom_Plane(gp_Ax3(gp_Pnt(0, 0, z), gp_Dir(0, 0, -1), gp_Dir(1, 0, 0))), True)


def _sphere_patch(front: Sphere, outline: Outline) -> FacePatch:
    """Return a sphere with polar axis ±x and u = π at the vertex, so that no pole (x = ±R) or seam is on the patch.

    With s = sign(c) and R = 1/|c| for curvature c, x = s R sin v, y = -R cos v sin u, z - z_centre = s R cos v cos u.
    The normal points away from the centre.  With a centre 10⁵ mm away, digits would be lost.  Such a sphere is
    written as the parabola z0 + c r²/2 if it deviates from the parabola, at the rim r, by c³ r⁴/8 < PARABOLA_TOLERANCE.
    """
    (c, _), r = front.conic(), float(np.hypot(*outline.farthest))
    if abs(c) * r >= 1:
        raise ValueError(
            f"lens.front: a sphere of radius {1 / abs(c):g} mm ends inside the rim at {r:g} mm; increase the radius"
        )
    if abs(c) ** 3 * r**4 / 8 < PARABOLA_TOLERANCE:
        return _conic_patch(Conic(front.z, c, -1.0), outline)
    s, R = np.sign(c), 1 / abs(c)

    def uv(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        v = np.arcsin(s * x / R)
        return np.stack([np.pi + np.arcsin(y / (R * np.cos(v))), v], axis=-1)

    axes = gp_Ax3(gp_Pnt(0, 0, front.z + 1 / c), gp_Dir(s, 0, 0), gp_Dir(0, 0, s))
    return FacePatch(Geom_SphericalSurface(axes, R), bool(c > 0), uv)


def conic_net(front: Conic, a: float, b: float) -> tuple[np.ndarray, np.ndarray]:
    """Return poles (3, 3, 3) in mm and weights (3, 3) of a conic for |u| <= a, |v| <= b (mm).

    With curvature c, conic constant k, K = (1 + k) c² and w = 1 + K (u² + v²) / 4, the conic has x = u / w, y = v / w,
    z = z0 + c/2 (u² + v²) / w.  Since w x, w y, w z and w are quadratic in u and v, a rational patch of degree 2 x 2 is
    exactly the conic; (u, v) is the projection of (x, y, z) from the conic's far vertex onto the plane z = z0.  The
    blossom of u² on [-a, a] is a² (1, -1, 1).
    """
    ends, blossom = np.array([-1.0, 0.0, 1.0]), np.array([1.0, -1.0, 1.0])
    square = a * a * blossom[:, None] + b * b * blossom[None, :]
    weights = 1 + (1 + front.conic_constant) * front.curvature**2 / 4 * square
    net = np.empty((3, 3, 3))
    net[..., 0] = a * ends[:, None] / weights
    net[..., 1] = b * ends[None, :] / weights
    net[..., 2] = front.z + front.curvature / 2 * square / weights
    return net, weights


def _conic_patch(front: Conic, outline: Outline) -> FacePatch:
    """Return the patch of `conic_net`.  In (u, v), circles about the axis are circles and straight sides are arcs."""
    (c, k), (a, b) = front.conic(), outline.half_extent
    bend = (1 + k) * c**2  # K

    def uv(x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
        scale = 2 / (1 + np.sqrt(1 - bend * (x * x + y * y)))
        return np.stack([x * scale, y * scale], axis=-1)

    # largest u and v on the outline: at its corners or on the axes
    ends = np.maximum(uv(a, 0.0) + uv(0.0, b), 0.0 if outline.is_round else uv(a, b))
    if not np.isfinite(ends).all() or not (abs(bend) / 4 * (PATCH_MARGIN * ends) ** 2).sum() < 1:
        raise ValueError(
            f"lens.front: a conic of constant {k:g} and radius {1 / abs(c):g} mm is too steep inside the rim, "
            f"{np.hypot(*outline.farthest):g} mm from the axis; increase the radius"
        )
    half_u, half_v = PATCH_MARGIN * ends
    net, weights = conic_net(front, half_u, half_v)
    surface = bspline_surface(net, np.repeat([-half_u, half_u], 3), np.repeat([-half_v, half_v], 3), weights)
    return FacePatch(surface, False, uv)


PATCHES: dict[str, Callable[..., FacePatch]] = {  # function that returns the patch of each kind of front except planes
    "bspline": partial(_net_patch, outward=False),
    "sphere": _sphere_patch,
    "conic": _conic_patch,
}


# ---- arrays ----------------------------------------------------------------------------------------------------------


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
    values, counts = np.unique(full, return_counts=True)
    multiplicities = TColStd_Array1OfInteger(1, len(counts))
    for i, count in enumerate(counts.tolist(), start=1):
        multiplicities.SetValue(i, count)
    return _reals(values), multiplicities


def bspline_surface(
    net: np.ndarray, knots_u: np.ndarray, knots_v: np.ndarray, weights: np.ndarray | None = None
) -> Geom_BSplineSurface:
    """Return the B-spline surface of a net (m, n, 3) in mm and full knot vectors; weights (m, n) make it rational."""
    m, n = net.shape[:2]
    if weights is None and m * n > SMALL_NET:
        return _surface_of(surface_bytes(net, knots_u, knots_v))
    poles = TColgp_Array2OfPnt(1, m, 1, n)
    for i, row in enumerate(net.tolist(), start=1):
        for j, xyz in enumerate(row, start=1):
            poles.SetValue(i, j, gp_Pnt(*xyz))
    u, count_u = _knot_arrays(knots_u)
    v, count_v = _knot_arrays(knots_v)
    degree_u, degree_v = len(knots_u) - m - 1, len(knots_v) - n - 1
    if weights is None:
        return Geom_BSplineSurface(poles, u, v, count_u, count_v, degree_u, degree_v)
    return Geom_BSplineSurface(poles, _real_table(weights), u, v, count_u, count_v, degree_u, degree_v)


def bspline_curve(poles: np.ndarray, full_knots: np.ndarray) -> Geom_BSplineCurve:
    """Return the B-spline curve of control points (n, 3) in mm and a full knot vector."""
    array = TColgp_Array1OfPnt(1, len(poles))
    for i, xyz in enumerate(poles.tolist(), start=1):
        array.SetValue(i, gp_Pnt(*xyz))
    return Geom_BSplineCurve(array, *_knot_arrays(full_knots), len(full_knots) - len(poles) - 1)


def bspline_curve_2d(poles: np.ndarray, full_knots: np.ndarray) -> Geom2d_BSplineCurve:
    """Return the B-spline curve of control points (n, 2) in the parameter plane of a face."""
    array = TColgp_Array1OfPnt2d(1, len(poles))
    for i, uv in enumerate(poles.tolist(), start=1):
        array.SetValue(i, gp_Pnt2d(*uv))
    return Geom2d_BSplineCurve(array, *_knot_arrays(full_knots), len(full_knots) - len(poles) - 1)


def net_of(surface: Geom_BSplineSurface) -> np.ndarray:
    """Return the control points (m, n, 3) in mm of an OCC B-spline surface, u along the first axis."""
    m, n = surface.NbUPoles(), surface.NbVPoles()
    if m * n > SMALL_NET and not (surface.IsURational() or surface.IsVRational()):
        offset = SURFACE_OFFSET + SURFACE_HEADER.size
        return np.frombuffer(to_bytes(_face_on(surface)), "<f8", m * n * 3, offset).reshape(m, n, 3).copy()
    pole = surface.Poles().Value
    points = (pole(i, j).Coord() for i in range(1, m + 1) for j in range(1, n + 1))
    return np.fromiter(points, np.dtype((float, 3)), m * n).reshape(m, n, 3)


def weights_of(surface: Geom_BSplineSurface) -> np.ndarray:
    """Return the weights (m, n) of an OCC B-spline surface, all 1 if it is not rational."""
    m, n = surface.NbUPoles(), surface.NbVPoles()
    return np.array([[surface.Weight(i, j) for j in range(1, n + 1)] for i in range(1, m + 1)])


def knots_of(surface: Geom_BSplineSurface) -> tuple[np.ndarray, np.ndarray]:
    """Return the full knot vectors in u and v of an OCC B-spline surface."""
    both = surface.UKnotSequence(), surface.VKnotSequence()
    u, v = (np.array([full.Value(i) for i in range(full.Lower(), full.Upper() + 1)]) for full in both)
    return u, v


# ---- nets as bytes of OCC's binary files -----------------------------------------------------------------------------

SMALL_NET = 4096  # largest number of control points that are passed to OCC one by one
# Layout of a surface's header: number of its kind, flags (rational in u, in v, periodic in u, in v), degrees (u, v),
# numbers of poles, numbers of distinct knots.  Then follow the poles, v changing fastest, and the knots (KNOT_RECORD).
SURFACE_HEADER = struct.Struct("<B4B2H4i")
BSPLINE_KIND = 9  # number of the kind of B-spline surfaces in OCC's binary files
KNOT_RECORD = np.dtype([("value", "<f8"), ("count", "<i4")])  # a knot and its multiplicity


def to_bytes(shape: TopoDS_Shape) -> bytes:
    """Encode a shape as a binary file of OCC."""
    stream = BytesIO()
    BinTools.Write_s(shape, stream)
    return stream.getvalue()


def from_bytes(data: bytes) -> TopoDS_Shape:
    """Decode a shape from a binary file of OCC."""
    shape = TopoDS_Shape()
    BinTools.Read_s(shape, BytesIO(data))
    return shape


def surface_bytes(net: np.ndarray, *full_knots: np.ndarray) -> bytes:
    """Encode the B-spline surface of a net (m, n, 3) in mm and full knot vectors as in a binary file of OCC."""
    distinct = [np.unique(knots, return_counts=True) for knots in full_knots]
    degrees = (len(knots) - m - 1 for knots, m in zip(full_knots, net.shape, strict=False))
    sizes = *net.shape[:2], *(len(values) for values, _ in distinct)
    head = SURFACE_HEADER.pack(BSPLINE_KIND, 0, 0, 0, 0, *degrees, *sizes)
    ends = [np.rec.fromarrays(each, KNOT_RECORD).tobytes() for each in distinct]
    return b"".join([head, np.ascontiguousarray(net, "<f8").tobytes(), *ends])


def _face_on(surface: Geom_Surface) -> TopoDS_Face:
    face = TopoDS_Face()
    BRep_Builder().MakeFace(face, surface, 1e-7)
    return face


def _surface_of(own: bytes) -> Geom_BSplineSurface:
    """Decode a surface from its bytes, `own`, which replace those of a placeholder surface in the file of a face."""
    data = _PLACEHOLDER_FILE.replace(surface_bytes(*_PLACEHOLDER_NET), own, 1)
    return BRep_Tool.Surface_s(TopoDS.Face_s(from_bytes(data)))


_PLACEHOLDER_NET = (np.zeros((2, 2, 3)), *[np.array([0.0, 0.0, 1.0, 1.0])] * 2)  # control net and knot vectors
_PLACEHOLDER_FILE = to_bytes(_face_on(bspline_surface(*_PLACEHOLDER_NET)))
SURFACE_OFFSET = _PLACEHOLDER_FILE.index(surface_bytes(*_PLACEHOLDER_NET))  # bytes before the surface in a face's file
