"""The faces of a lens as OCC patches: a surface, its borders in space, and the same borders in its (u, v) plane.

The back's poles are the design's control points and its knots the design's knots; nothing is refitted.  The one curve
that no B-spline of low degree can be exactly is the rim of a round lens, in space: its image in (u, v) is an exact
circle, and the space curve follows it to within `RIM`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from OCP.Geom import (
    Geom_Circle,
    Geom_Curve,
    Geom_Line,
    Geom_Plane,
    Geom_SphericalSurface,
    Geom_Surface,
)
from OCP.Geom2d import Geom2d_Circle, Geom2d_Curve, Geom2d_Line
from OCP.gp import gp_Ax2, gp_Ax2d, gp_Ax3, gp_Dir, gp_Dir2d, gp_Pnt, gp_Pnt2d
from scipy.interpolate import make_interp_spline

from bstcad.cad import nurbs, uv_maps, wires
from bstcad.optics.bspline import BSplineSurface, knots
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Outline, Rectangle
from bstcad.optics.quadrature import rim_breaks
from bstcad.optics.surfaces import Conic, Plane, Sphere, Surface, sag

WIDER = 1.02  # times as wide as the outline needs: the rim touches no border of the patch
RIM = 1e-8  # mm; how far the space curve of a round rim may leave the exact rim
SIDES = ("x0", "x1", "y0", "y1")  # borders of a rectangle, named by the coordinate that is constant and its end


@dataclass(frozen=True)
class Border:
    """One border of a patch: towards +y (x0, x1), towards +x (y0, y1), or once around from +x by way of +y (rim)."""

    curve: Geom_Curve
    start: float  # parameter at the first point
    end: float
    uv: Geom2d_Curve | None  # the same points, same parameter, in the patch's plane; planes need none
    around: Geom2d_Curve | None = None  # a rim's image (angle, z) on the cylinder of a round lens's side


@dataclass(frozen=True)
class Patch:
    """A surface and the borders that cut a face out of it."""

    surface: Geom_Surface
    outward: bool  # does the surface's own normal, ∂u x ∂v, point out of the lens?
    borders: dict[str, Border]  # SIDES, or "rim"


def _line_2d(u: float, v: float, direction: tuple[float, float]) -> Geom2d_Line:
    return Geom2d_Line(gp_Pnt2d(u, v), gp_Dir2d(*direction))


def _circle(z: float, radius: float) -> Geom_Circle:
    return Geom_Circle(gp_Ax2(gp_Pnt(0, 0, z), gp_Dir(0, 0, 1), gp_Dir(1, 0, 0)), radius)


def _front_rim(z: float, radius: float, uv: Geom2d_Curve | None) -> Border:
    """A circle around the axis, which the cylinder of the side sees as the line z."""
    return Border(_circle(z, radius), 0.0, 2 * np.pi, uv, _line_2d(0, z, (1, 0)))


def _circle_2d(u: float, v: float, radius: float) -> Geom2d_Circle:
    return Geom2d_Circle(gp_Ax2d(gp_Pnt2d(u, v), gp_Dir2d(1, 0)), radius)


def _quintic(points: Callable[[np.ndarray], np.ndarray], start: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """(poles, full knots) of the quintic through 257 points of an analytic arc; a whole turn of it is good to 1e-12."""
    t = np.linspace(start, end, 257)
    spline = make_interp_spline(t, points(t), k=5)
    return spline.c, spline.t


# ---- B-spline patches --------------------------------------------------------------------------------------------


def _net_patch(net: np.ndarray, u: np.ndarray, v: np.ndarray, outward: bool) -> Patch:
    """The whole of a B-spline surface: its borders are its own boundary curves, on the same knots."""
    u0, u1, v0, v1 = u[0], u[-1], v[0], v[-1]
    borders = {
        "x0": Border(nurbs.bspline_curve(net[0], v), v0, v1, _line_2d(u0, 0, (0, 1))),
        "x1": Border(nurbs.bspline_curve(net[-1], v), v0, v1, _line_2d(u1, 0, (0, 1))),
        "y0": Border(nurbs.bspline_curve(net[:, 0], u), u0, u1, _line_2d(0, v0, (1, 0))),
        "y1": Border(nurbs.bspline_curve(net[:, -1], u), u0, u1, _line_2d(0, v1, (1, 0))),
    }
    return Patch(nurbs.bspline_surface(net, u, v), outward, borders)


def _check_round(surface: BSplineSurface, radius: float) -> None:
    """A circle in the plane is a circle in (u, v) only where x(u) and y(v) are linear, with one common pitch."""
    (x0, x1), (y0, y1) = surface.x, surface.y
    dx, dy = surface.pitch
    if abs(dx - dy) > 1e-12 * dx:
        raise ValueError(f"lens: control points {dx:g} mm apart in x, {dy:g} in y; give a round lens a square net")
    reach = min(-x0, x1, -y0, y1) - 1.5 * dx  # the end spans, where x(u) is quadratic, are 1.5 control points wide
    if radius > reach + 1e-9 * dx:
        raise ValueError(
            f"lens: the net's linear part ends at {reach:g} mm, inside the rim at {radius:g} mm; "
            "let the net reach two spans past the rim"
        )


def _rim_curve(surface: BSplineSurface, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(poles (n, 3) in mm, poles of the angle itself (n,), full knots) of the rim as a piecewise cubic within RIM.

    It has the rim's own points and tangents at its breaks: those at the knot lines of the back, and more between two of
    them as RIM requires.
    """

    def points(theta: np.ndarray) -> np.ndarray:
        x, y = radius * np.cos(theta), radius * np.sin(theta)
        return np.column_stack([x, y, sag(surface, x, y), theta])

    poles, full = wires.fitted(points, rim_breaks(surface, radius), RIM)
    return poles[:, :3], poles[:, 3], full


def _net_rim(surface: BSplineSurface, radius: float) -> Border:
    """The rim of a round net: an exact circle in (u, v), a cubic in space and on the cylinder."""
    _check_round(surface, radius)
    poles, angle, full = _rim_curve(surface, radius)
    dx = surface.pitch[0]
    u, v = -surface.x[0] / dx - 0.5, -surface.y[0] / dx - 0.5  # the axis, from x(t) = x0 + dx (t + 1/2)
    around = nurbs.bspline_curve_2d(np.column_stack([angle, poles[:, 2]]), full)
    return Border(nurbs.bspline_curve(poles, full), 0.0, 2 * np.pi, _circle_2d(u, v, radius / dx), around)


def back_patch(lens: Lens) -> Patch:
    """z = Σ B_i(u) B_j(v) P_ij on the design's own net and knots (3, 1, …, 1, 3), normal towards +z."""
    back, full = lens.back, knots(lens.back.m)
    whole = _net_patch(back.plain().control_points(), full, full, outward=True)
    if isinstance(lens.outline, Rectangle):
        return whole
    return Patch(whole.surface, True, {"rim": _net_rim(back.plain(), lens.outline.radius)})


# ---- the front -----------------------------------------------------------------------------------------------------


def front_patch(lens: Lens) -> Patch:
    """The front cut by the outline, on the one kind of OCC surface that is exactly that."""
    return _patch(lens.front.plain(), lens.outline)


@functools.singledispatch
def _patch(front: Surface, outline: Outline) -> Patch:
    raise TypeError(f"no OCC surface is exactly a {type(front).__name__}")


@_patch.register
def _(front: Plane, outline: Outline) -> Patch:
    return _plane_patch(front.z, outline)


@_patch.register
def _(front: Sphere, outline: Outline) -> Patch:
    """A plane, a sphere, or the parabola that a very flat sphere is.

    A centre 10⁵ mm away would cost a sphere its digits; there z0 + c r²/2 departs from it by c³ r⁴/8 < PARABOLA.
    """
    c, r2 = front.curvature, uv_maps.reach2(outline)
    if c == 0:
        return _plane_patch(front.z, outline)
    if c * c * r2 >= 1:
        raise ValueError(
            f"lens.front: a sphere of radius {1 / abs(c):g} mm ends inside the lens's rim at {r2**0.5:g} mm; flatten it"
        )
    if uv_maps.nearly_flat(c, outline):
        return _conic_patch(Conic(front.z, c, -1.0), outline)
    return _sphere_patch(front.z, c, outline)


@_patch.register
def _(front: Conic, outline: Outline) -> Patch:
    """A plane or a rational patch."""
    return _conic_patch(front, outline) if front.curvature else _plane_patch(front.z, outline)


@_patch.register
def _(front: BSplineSurface, outline: Outline) -> Patch:
    """The given net, as the back's; its normal points into the lens."""
    full = knots(front.m)
    whole = _net_patch(front.control_points(), full, full, outward=False)
    return whole if isinstance(outline, Rectangle) else replace(whole, borders={"rim": _net_rim(front, outline.radius)})


def _plane_patch(z: float, outline: Outline) -> Patch:
    """z = z0, its normal towards -z."""
    plane = Geom_Plane(gp_Ax3(gp_Pnt(0, 0, z), gp_Dir(0, 0, -1), gp_Dir(1, 0, 0)))
    if isinstance(outline, Circle):
        return Patch(plane, True, {"rim": _front_rim(z, outline.radius, None)})
    a, b = outline.half_extent
    borders = {}
    for k, sense in enumerate((-1, 1)):
        borders[f"x{k}"] = Border(Geom_Line(gp_Pnt(sense * a, 0, z), gp_Dir(0, 1, 0)), -b, b, None)
        borders[f"y{k}"] = Border(Geom_Line(gp_Pnt(0, sense * b, z), gp_Dir(1, 0, 0)), -a, a, None)
    return Patch(plane, True, borders)


def _sphere_patch(z: float, c: float, outline: Outline) -> Patch:
    """The sphere with its polar axis along ±x and u = pi at the vertex: no pole (x = ±R) and no seam on the patch.

    With s = sign(c): x = s R sin v, y = -R cos v sin u, z - z_centre = s R cos v cos u; normal away from the centre.
    """
    s, R, centre, uv = np.sign(c), 1 / abs(c), z + 1 / c, uv_maps.of_sphere(c)
    polar, to_centre = gp_Dir(s, 0, 0), gp_Dir(0, 0, s)
    surface = Geom_SphericalSurface(gp_Ax3(gp_Pnt(0, 0, centre), polar, to_centre), R)
    outward = bool(c > 0)
    if isinstance(outline, Circle):
        r = outline.radius
        image = nurbs.bspline_curve_2d(*_quintic(lambda t: uv(r * np.cos(t), r * np.sin(t)), 0.0, 2 * np.pi))
        return Patch(surface, outward, {"rim": _front_rim(float(sag(Sphere(z, c), r, 0.0)), r, image)})

    def parallel(x: float, b: float) -> Border:  # the plane x = const: v = const, and the arc's angle is u
        (start, v), (end, _) = uv(np.full(2, x), np.array([-b, b]))
        arc = Geom_Circle(gp_Ax2(gp_Pnt(x, 0, centre), polar, to_centre), R * np.cos(v))
        return Border(arc, start, end, _line_2d(0, v, (1, 0)))

    def meridian(y: float, a: float) -> Border:  # the plane y = const; the arc's angle is 0 at -x, pi/2 at the vertex
        r = np.sqrt(R * R - y * y)
        start, end = np.pi / 2 + np.arcsin(np.array([-a, a]) / r)
        arc = Geom_Circle(gp_Ax2(gp_Pnt(0, y, centre), gp_Dir(0, -s, 0), gp_Dir(-1, 0, 0)), r)
        image = _quintic(lambda t: uv(-r * np.cos(t), np.full_like(t, y)), start, end)
        return Border(arc, start, end, nurbs.bspline_curve_2d(*image))

    a, b = outline.half_extent
    borders = {"x0": parallel(-a, b), "x1": parallel(a, b), "y0": meridian(-b, a), "y1": meridian(b, a)}
    return Patch(surface, outward, borders)


def conic_net(front: Conic, a: float, b: float) -> tuple[np.ndarray, np.ndarray]:
    """(poles (3, 3, 3) in mm, weights (3, 3)) of a conic over |u| <= a, |v| <= b (mm).

    With K = (1 + k) c², w = 1 + K (u² + v²) / 4: x = u / w, y = v / w, z = z0 + c/2 (u² + v²) / w.  These are
    homogeneous quadratics, so that a rational patch of degree 2 x 2 is the conic exactly: its projection from the far
    vertex.  The blossom of u² over [-a, a] is a² (1, -1, 1).
    """
    ends, blossom = np.array([-1.0, 0.0, 1.0]), np.array([1.0, -1.0, 1.0])
    square = a * a * blossom[:, None] + b * b * blossom[None, :]
    weights = 1 + (1 + front.conic_constant) * front.curvature**2 / 4 * square
    net = np.empty((3, 3, 3))
    net[..., 0] = a * ends[:, None] / weights
    net[..., 1] = b * ends[None, :] / weights
    net[..., 2] = front.z + front.curvature / 2 * square / weights
    return net, weights


def _conic_patch(front: Conic, outline: Outline) -> Patch:
    """A rational patch; in its plane (see `conic_net`) a round rim is a circle, and a straight side an arc."""
    bend, uv = (1 + front.conic_constant) * front.curvature**2, uv_maps.of_conic(front)  # K
    a, b = outline.half_extent
    round_ = isinstance(outline, Circle)
    # the outline's extent along u and v: at its corners, on its axes
    ends = np.maximum(uv(a, 0.0) + uv(0.0, b), 0.0 if round_ else uv(a, b))
    if not np.isfinite(ends).all() or not (abs(bend) / 4 * (WIDER * ends) ** 2).sum() < 1:
        raise ValueError(
            f"lens.front: a conic of constant {front.conic_constant:g} and radius {1 / abs(front.curvature):g} mm "
            f"turns too sharply before the rim, {np.hypot(*outline.farthest):g} mm from the axis; flatten it"
        )
    half_u, half_v = WIDER * ends
    net, weights = conic_net(front, half_u, half_v)
    surface = nurbs.bspline_surface(net, np.repeat([-half_u, half_u], 3), np.repeat([-half_v, half_v], 3), weights)
    if round_:
        [radius, _] = uv(a, 0.0)
        return Patch(surface, False, {"rim": _front_rim(float(sag(front, a, 0.0)), a, _circle_2d(0, 0, radius))})

    def border(side: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], end: float) -> Border:
        space = _quintic(lambda t: np.stack([*side(t), sag(front, *side(t))], axis=-1), -end, end)
        image = _quintic(lambda t: uv(*side(t)), -end, end)
        return Border(nurbs.bspline_curve(*space), -end, end, nurbs.bspline_curve_2d(*image))

    borders = {}
    for k, sense in enumerate((-1, 1)):
        borders[f"x{k}"] = border(lambda t, x=sense * a: (np.full_like(t, x), t), b)
        borders[f"y{k}"] = border(lambda t, y=sense * b: (t, np.full_like(t, y)), a)
    return Patch(surface, False, borders)
