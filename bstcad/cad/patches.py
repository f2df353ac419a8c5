"""The faces of a lens as OCC patches: a surface, its borders in space, and the same borders in its (u, v) plane.

The back's poles are the design's control points and its knots the design's knots; nothing is refitted.  The one curve
that no B-spline of low degree can be exactly is the rim of a round lens, in space: its image in (u, v) is an exact
circle, and the space curve follows it to within `RIM`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from OCP.Geom import Geom_Circle, Geom_Curve, Geom_Line, Geom_Plane, Geom_SphericalSurface, Geom_Surface
from OCP.Geom2d import Geom2d_Circle, Geom2d_Curve, Geom2d_Line
from OCP.gp import gp_Ax2, gp_Ax2d, gp_Ax3, gp_Dir, gp_Dir2d, gp_Pnt, gp_Pnt2d
from scipy.interpolate import make_interp_spline

from bstcad.cad import nurbs, wires
from bstcad.optics.bspline import BSplineSurface, knots, parameter
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.quadrature import rim_breaks
from bstcad.optics.surfaces import Conic, Sphere, sag

WIDER = 1.02  # times as wide as the outline needs: the rim touches no border of the patch
RIM = 1e-8  # mm; how far the space curve of a round rim may leave the exact rim
PARABOLA = 1e-10  # mm; a sphere that departs from its parabola by less is written as that parabola
SIDES = ("x0", "x1", "y0", "y1")  # borders of a rectangle, named by the coordinate that is constant and its end

Image = Callable[[np.ndarray, np.ndarray], np.ndarray]  # (x, y) in mm -> (…, 2) in the parameter plane of a patch


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
    uv: Image | None = None  # None: the surface is a plane, on which OCC needs no images


def _line_2d(u: float, v: float, direction: tuple[float, float]) -> Geom2d_Line:
    return Geom2d_Line(gp_Pnt2d(u, v), gp_Dir2d(*direction))


def _front_rim(z: float, radius: float, uv: Geom2d_Curve | None) -> Border:
    """A circle around the axis, which the cylinder of the side sees as the line z."""
    circle = Geom_Circle(gp_Ax2(gp_Pnt(0, 0, z), gp_Dir(0, 0, 1), gp_Dir(1, 0, 0)), radius)
    return Border(circle, 0.0, 2 * np.pi, uv, _line_2d(0, z, (1, 0)))


def _circle_2d(u: float, v: float, radius: float) -> Geom2d_Circle:
    return Geom2d_Circle(gp_Ax2d(gp_Pnt2d(u, v), gp_Dir2d(1, 0)), radius)


def _quintic(points: Callable[[np.ndarray], np.ndarray], start: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """(poles, full knots) of the quintic through 257 points of an analytic arc; a whole turn of it is good to 1e-12."""
    t = np.linspace(start, end, 257)
    spline = make_interp_spline(t, points(t), k=5)
    return spline.c, spline.t


# ---- B-spline patches ------------------------------------------------------------------------------------------------


def back_patch(lens: Lens) -> Patch:
    """z = Σ B_i(u) B_j(v) P_ij on the design's own net and knots (3, 1, …, 1, 3), normal towards +z."""
    return _net_patch(lens.back.plain(), lens.outline, outward=True)


def _net_patch(face: BSplineSurface, outline: Outline, outward: bool) -> Patch:
    """Inside a rectangle the whole net, whose borders are its own boundary curves on the same knots."""
    net, full = face.control_points(), knots(face.m)
    end = full[-1]
    surface = nurbs.bspline_surface(net, full, full)
    if outline.is_round:
        return Patch(surface, outward, {"rim": _net_rim(face, outline.radius)}, of_net(face))
    borders = {
        "x0": Border(nurbs.bspline_curve(net[0], full), 0.0, end, _line_2d(0, 0, (0, 1))),
        "x1": Border(nurbs.bspline_curve(net[-1], full), 0.0, end, _line_2d(end, 0, (0, 1))),
        "y0": Border(nurbs.bspline_curve(net[:, 0], full), 0.0, end, _line_2d(0, 0, (1, 0))),
        "y1": Border(nurbs.bspline_curve(net[:, -1], full), 0.0, end, _line_2d(0, end, (1, 0))),
    }
    return Patch(surface, outward, borders, of_net(face))


def of_net(face: BSplineSurface) -> Image:
    """(x, y) in mm to (u, v) of a net."""

    def uv(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        ends = zip((x, y), (face.x, face.y), face.pitch, strict=True)
        across = (np.clip((p - low) / pitch, 0.0, face.m - 1.0) for p, (low, _), pitch in ends)
        return np.stack([parameter(torch.from_numpy(p), face.m).numpy() for p in across], axis=-1)

    return uv


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


def _net_rim(surface: BSplineSurface, radius: float) -> Border:
    """The rim of a round net: an exact circle in (u, v), a piecewise cubic within RIM in space and on the cylinder.

    The cubic has the rim's own points and tangents at its breaks: those at the knot lines of the net, and more between
    two of them as RIM requires.
    """
    _check_round(surface, radius)

    def points(theta: np.ndarray) -> np.ndarray:
        x, y = radius * np.cos(theta), radius * np.sin(theta)
        return np.column_stack([x, y, sag(surface, x, y), theta])

    poles, full = wires.fitted(points, rim_breaks(surface, radius), RIM)
    dx = surface.pitch[0]
    u, v = -surface.x[0] / dx - 0.5, -surface.y[0] / dx - 0.5  # the axis, from x(t) = x0 + dx (t + 1/2)
    around = nurbs.bspline_curve_2d(poles[:, [3, 2]], full)
    return Border(nurbs.bspline_curve(poles[:, :3], full), 0.0, 2 * np.pi, _circle_2d(u, v, radius / dx), around)


# ---- the front -------------------------------------------------------------------------------------------------------


def front_patch(lens: Lens) -> Patch:
    """The front cut by the outline, on the one kind of OCC surface that is exactly that; its normal may point inwards.

    A sphere whose centre lies 10⁵ mm away would lose its digits: it is written as the parabola z0 + c r²/2, from which
    it departs by c³ r⁴/8 < PARABOLA.
    """
    front, outline = lens.front.plain(), lens.outline
    if front.is_net:
        return _net_patch(front, outline, outward=False)
    if front.level:
        return _plane_patch(front.z, outline)
    c, r = front.curvature, float(np.hypot(*outline.farthest))
    if front.kind != "sphere":
        return _conic_patch(front, outline)
    if abs(c) * r >= 1:
        raise ValueError(
            f"lens.front: a sphere of radius {1 / abs(c):g} mm ends inside the lens's rim at {r:g} mm; flatten it"
        )
    if abs(c) ** 3 * r**4 / 8 < PARABOLA:
        return _conic_patch(Conic(front.z, c, -1.0), outline)
    return _sphere_patch(front.z, c, outline)


def _plane_patch(z: float, outline: Outline) -> Patch:
    """z = z0, its normal towards -z."""
    plane = Geom_Plane(gp_Ax3(gp_Pnt(0, 0, z), gp_Dir(0, 0, -1), gp_Dir(1, 0, 0)))
    if outline.is_round:
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
    s, R, centre = np.sign(c), 1 / abs(c), z + 1 / c

    def uv(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        v = np.arcsin(s * x / R)
        return np.stack([np.pi + np.arcsin(y / (R * np.cos(v))), v], axis=-1)

    polar, to_centre = gp_Dir(s, 0, 0), gp_Dir(0, 0, s)
    surface = Geom_SphericalSurface(gp_Ax3(gp_Pnt(0, 0, centre), polar, to_centre), R)
    outward = bool(c > 0)
    if outline.is_round:
        r = outline.radius
        image = nurbs.bspline_curve_2d(*_quintic(lambda t: uv(r * np.cos(t), r * np.sin(t)), 0.0, 2 * np.pi))
        return Patch(surface, outward, {"rim": _front_rim(float(sag(Sphere(z, c), r, 0.0)), r, image)}, uv)

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
    return Patch(surface, outward, borders, uv)


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
    bend = (1 + front.conic_constant) * front.curvature**2  # K
    a, b = outline.half_extent

    def uv(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        scale = 2 / (1 + np.sqrt(1 - bend * (x * x + y * y)))
        return np.stack([x * scale, y * scale], axis=-1)

    # the outline's extent along u and v: at its corners, on its axes
    ends = np.maximum(uv(a, 0.0) + uv(0.0, b), 0.0 if outline.is_round else uv(a, b))
    if not np.isfinite(ends).all() or not (abs(bend) / 4 * (WIDER * ends) ** 2).sum() < 1:
        raise ValueError(
            f"lens.front: a conic of constant {front.conic_constant:g} and radius {1 / abs(front.curvature):g} mm "
            f"turns too sharply before the rim, {np.hypot(*outline.farthest):g} mm from the axis; flatten it"
        )
    half_u, half_v = WIDER * ends
    net, weights = conic_net(front, half_u, half_v)
    surface = nurbs.bspline_surface(net, np.repeat([-half_u, half_u], 3), np.repeat([-half_v, half_v], 3), weights)
    if outline.is_round:
        [radius, _] = uv(a, 0.0)
        return Patch(surface, False, {"rim": _front_rim(float(sag(front, a, 0.0)), a, _circle_2d(0, 0, radius))}, uv)

    def border(side: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], end: float) -> Border:
        space = _quintic(lambda t: np.stack([*side(t), sag(front, *side(t))], axis=-1), -end, end)
        image = _quintic(lambda t: uv(*side(t)), -end, end)
        return Border(nurbs.bspline_curve(*space), -end, end, nurbs.bspline_curve_2d(*image))

    borders = {}
    for k, sense in enumerate((-1, 1)):
        borders[f"x{k}"] = border(lambda t, x=sense * a: (np.full_like(t, x), t), b)
        borders[f"y{k}"] = border(lambda t, y=sense * b: (t, np.full_like(t, y)), a)
    return Patch(surface, False, borders, uv)
