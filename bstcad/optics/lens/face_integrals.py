"""Integrals over any face inside any border, from which area, volume and centroid follow.

They use Green's theorem; their relative error is about 1e-9.  The tests compare them with exact integrals of a net.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field

import numpy as np
import torch

from bstcad.optics.lens.base import on_base
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import BSplineSurface, is_net
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.surfaces import Surface

MIN_SPANS = 128  # smallest number of parts of a chord across a whole net; the spans of a coarser net are divided
GAUSS_POINTS_PER_PART = 3  # Gauss points in each part of a chord or of a border
FINE_NET = 400  # smallest number of control points per side at which FINE_POINTS give the area to 1e-9
FINE_POINTS = 2  # Gauss points in each part of a chord or of a border on a net of at least FINE_NET points per side
CHORD_POINTS = 96  # Gauss points of a chord over a face without net; exact to rounding on a sphere to 0.95 radii
END_PARTS = 12  # minimum number of parts of an end span, where heights are not polynomial; gives volumes to 1e-12
BORDER_POINTS_PER_STRIP = 512  # number of border points evaluated at a time
MIN_RELATIVE_DX = 1e-14  # |dx| / ds up to which border points are left out, since they add nothing to ∮ … dx
EDGE_PARTS = 256  # minimum number of parts into which each curve of a border is divided

gauss_rule = functools.cache(np.polynomial.legendre.leggauss)  # Gauss points and weights on [-1, 1], by their number


@dataclass(frozen=True)
class Border:
    """Gauss points of closed curves around a face, seen along -z: outer curves counterclockwise, holes clockwise."""

    x: np.ndarray  # coordinates of the points (n,), mm
    y: np.ndarray
    dx: np.ndarray  # weights of the points in ∮ … dx (n,), mm
    dy: np.ndarray  # weights of the points in ∮ … dy (n,), mm

    @property
    def ds(self) -> np.ndarray:
        """Weights of the points in ∮ … ds (n,), mm."""
        return np.hypot(self.dx, self.dy)


@dataclass(frozen=True)
class Sums:
    """Integrals over a piece of a solid's surface with unit normal n; their sum over all pieces describes the solid."""

    area: float = 0.0  # ∫ dA (mm²)
    volume: float = 0.0  # ∫ r·n dA / 3 (mm³), volume of the cone from the origin to the piece
    moment: np.ndarray = field(default_factory=lambda: np.zeros(3))  # ∫ r (r·n) dA / 4 (mm⁴), volume times centroid

    def __add__(self, other: Sums) -> Sums:
        return Sums(self.area + other.area, self.volume + other.volume, self.moment + other.moment)


def of_face(face: Surface, border: Border, raised: float = 0.0) -> Sums:
    """Return the sums over z = h(x, y) + raised (mm) inside a border; n points up, n dA = (-h_x, -h_y, 1) dx dy.

    ∫∫ g dx dy = -∮ G dx, where G = ∫ g dy along a chord of constant x from y = 0 to the border; both are Gauss
    quadratures.  h: heights of the face, in float64.
    """
    total = Sums()
    counted = np.flatnonzero(np.abs(border.dx) > MIN_RELATIVE_DX * border.ds)
    for start in range(0, len(counted), BORDER_POINTS_PER_STRIP):
        strip = counted[start : start + BORDER_POINTS_PER_STRIP]
        total += _sums_of_points(face, raised, *_chords(face, border.x[strip], border.y[strip], border.dx[strip]))
    return Sums(abs(total.area), total.volume, total.moment)  # the area is negative for a border seen from below


def _of_revolution(face: Surface, raised: float) -> Sums:
    """Return the sums over a conic inside its outline, raised by `raised` (mm), n up, from its profile h(r).

    r = sin(s) / sqrt(K), K = (1 + k) c², in place of r: at an equator h is smooth in s, but not in r.  K <= 0: s = r.
    """
    assert face.outline is not None  # a Recess
    c, k = face.conic()
    bend, radius = (1 + k) * c * c, float(face.outline.radius)
    scale = math.sqrt(bend) if bend > 0 else 0.0
    point, weight = gauss_rule(CHORD_POINTS)
    end = math.asin(scale * radius) if scale else radius
    s, ds = end / 2 * (1 + point), end / 2 * weight
    r, dr = (np.sin(s) / scale, np.cos(s) / scale * ds) if scale else (s, ds)
    h, slope, _ = (
        p.numpy() for p in face.optical.relative_sag_and_slope(torch.from_numpy(r), torch.zeros(len(r)).double())
    )
    ring = 2 * math.pi * r * dr
    cone, h = ring * (h - r * slope + raised), h + raised
    moment = np.array([0.0, 0.0, float((cone * h).sum()) / 4])
    return Sums(float((ring * np.sqrt(1 + slope * slope)).sum()), float(cone.sum()) / 3, moment)


def of_wall(face: Surface, border: Border, raised: float = 0.0) -> Sums:
    """Return the sums over the wall from the plane z = 0 up to the rim of a face, raised by `raised` (mm), n outwards.

    border: border of the face in its chart.
    """
    border, h = _rim_in_space(face, border)
    h = h + raised
    cone = h * (border.x * border.dy - border.y * border.dx)  # r·n ds, times the wall's height
    return Sums(float((border.ds * h).sum()), float(cone.sum()) / 3, _moment(cone, border.x, border.y, h / 2))


def _sums_of_points(face: Surface, raised: float, x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> Sums:
    """Return the sums over points (x, y) (mm) of a face's chart, raised by `raised` (mm); weight: dx dy of each (mm²).

    n dA = ∂S/∂x × ∂S/∂y dx dy for the surface S(x, y).
    """
    vectors = face.position_and_normal(torch.from_numpy(x), torch.from_numpy(y))
    (x, y, z), (n_x, n_y, n_z) = ([part.numpy() for part in vector] for vector in vectors)
    area, z = weight * np.sqrt(n_z * n_z + n_x * n_x + n_y * n_y), z + raised
    cone = weight * (z * n_z + x * n_x + y * n_y)
    return Sums(float(area.sum()), float(cone.sum()) / 3, _moment(cone, x, y, z))


def _moment(cone: np.ndarray, *r: np.ndarray) -> np.ndarray:
    return np.array([(cone * axis).sum() for axis in r]) / 4


def rim_breaks(surface: BSplineSurface, radius: float) -> np.ndarray:
    """Return ascending angles (rad) from 0 to 2 pi between which the rim of a round lens crosses no knot line of a net.

    radius: radius of the rim (mm).  Neighbouring angles differ by at most 2 pi / 256.
    """
    angles = [np.linspace(0, 2 * np.pi, 257)]
    axes = zip((surface.x, surface.y), surface.pitch, surface.shape, (0.0, np.pi / 2), strict=True)
    for (first, _), pitch, m, quarter in axes:
        lines = first + pitch * (np.arange(1, m - 2) + 0.5)  # x(t) = first + pitch (t + 1/2) in the inner spans
        angle = np.arccos(lines[np.abs(lines) < radius] / radius)
        angles += [quarter + angle, quarter - angle]
    theta = np.sort(np.concatenate(angles) % (2 * np.pi))
    theta = theta[np.concatenate([[True], np.diff(theta) > 1e-9])]  # two crossings at one point count once (rad)
    return np.append(theta[theta < 2 * np.pi - 1e-9], 2 * np.pi)


def gauss_points(breaks: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss points and their weights, `count` points in each interval between neighbouring `breaks`."""
    point, weight = gauss_rule(count)
    half = np.diff(breaks)[:, None] / 2
    return (breaks[:-1, None] + half * (1 + point)).ravel(), (half * weight).ravel()


def divided(breaks: np.ndarray, parts: int) -> np.ndarray:
    """Return breaks that divide each interval between `breaks` into equal parts, at least `parts` in total."""
    each = math.ceil(parts / (len(breaks) - 1))
    return np.interp(np.arange((len(breaks) - 1) * each + 1) / each, np.arange(len(breaks)), breaks)


def outline_border(outline: Outline, face: Surface) -> Border:
    """Return the border of a circle or a rectangle with sharp corners, in parts that cross no knot line of a face."""
    net = face if is_net(face) else None
    count = _points(net) if net else GAUSS_POINTS_PER_PART
    if outline.is_round:
        radius, _ = outline.half_extent
        breaks = rim_breaks(net, radius) if net else np.linspace(0, 2 * np.pi, EDGE_PARTS + 1)
        theta, weight = gauss_points(breaks, count)
        x, y = radius * np.cos(theta), radius * np.sin(theta)
        return Border(x, y, -y * weight, x * weight)
    sides = []
    for axis, half in enumerate(outline.half_extent):
        breaks = _smooth_parts(net, axis, EDGE_PARTS) if net else np.linspace(-half, half, EDGE_PARTS + 1)
        sides.append(gauss_points(np.clip(breaks, -half, half), count))
    (x, dx), (y, dy), (a, b) = *sides, outline.half_extent
    no_x, no_y = np.zeros_like(x), np.zeros_like(y)
    return Border(
        np.concatenate([x, no_y + a, x, no_y - a]),
        np.concatenate([no_x - b, y, no_x + b, y]),
        np.concatenate([dx, no_y, -dx, no_y]),
        np.concatenate([no_x, dy, no_x, -dy]),
    )


def _rim_in_space(face: Surface, border: Border) -> tuple[Border, np.ndarray]:
    """Return the border in x and y of space, and heights (mm) over the plane z, of a border in a face's chart."""
    patch = face.at(torch.from_numpy(border.x), torch.from_numpy(border.y))
    (x, y, h), (x_x, y_x, _), (x_y, y_y, _) = (part.numpy() for part in patch)
    return Border(x, y, x_x * border.dx + x_y * border.dy, y_x * border.dx + y_y * border.dy), h


def _chords(face: Surface, x: np.ndarray, y: np.ndarray, dx: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (x, y, weights in mm²) of points on the chords from y = 0 to border points (x, y) of weight dx (mm)."""
    ends, count = _chord_ends(face, y)
    chord, part = np.nonzero(np.diff(ends, axis=1) > 0)
    low, high = ends[chord, part], ends[chord, part + 1]
    point, weight = gauss_rule(count)
    along = ((low + high) / 2)[:, None] + ((high - low) / 2)[:, None] * point
    total = (-dx * np.sign(y))[chord, None] * ((high - low) / 2)[:, None] * weight
    return x[chord].repeat(count), along.ravel(), total.ravel()


def _chord_ends(face: Surface, y: np.ndarray) -> tuple[np.ndarray, int]:
    """Return y (mm) of the ends of each chord's parts, (n, parts + 1), and the points per part; parts may be empty."""
    low, high = np.minimum(y, 0.0)[:, None], np.maximum(y, 0.0)[:, None]
    if not is_net(face):
        return np.hstack([low, high]), CHORD_POINTS
    return np.clip(np.union1d(_smooth_parts(face, 1, MIN_SPANS), 0.0), low, high), _points(face)


def _points(face: BSplineSurface) -> int:
    return GAUSS_POINTS_PER_PART if min(face.shape) < FINE_NET else FINE_POINTS


def _smooth_parts(face: BSplineSurface, axis: int, parts: int) -> np.ndarray:
    """Return breaks (mm) along x (axis 0) or y (1) of a net, at least `parts` parts of nearly polynomial heights."""
    (first, last), pitch = (face.x, face.y)[axis], face.pitch[axis]
    lines = np.concatenate([[first], first + pitch * (np.arange(1, face.shape[axis] - 2) + 0.5), [last]])
    ends = [np.linspace(low, high, END_PARTS + 1) for low, high in (lines[:2], lines[-2:])]
    return np.unique(np.concatenate([divided(lines, parts), *ends]))


# ---- properties of a solid -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MassProperties:
    """Properties of a solid of constant density; a STEP file states them so that its reader can check the shape.

    A = ∮ dA and, by the divergence theorem, V = ∮ r·n dA / 3 and V c = ∮ r (r·n) dA / 4.
    """

    area: float  # area of the whole surface (mm²)
    volume: float  # volume of the solid (mm³)
    centroid: tuple[float, float, float]  # position of the centroid (mm)

    @classmethod
    def of(cls, total: Sums, z: float) -> MassProperties:
        """Return the properties of a solid from the sums over its surface; z: origin of the sums on the axis (mm)."""
        c_x, c_y, c_z = (total.moment / total.volume).tolist()
        return cls(total.area, total.volume, (c_x, c_y, z + c_z))


def of_lens(lens: Lens) -> MassProperties:
    """Return the properties of a bare lens to 1e-9; for a large net OpenCASCADE takes minutes, and errs by 1e-5."""
    lens, total = on_base(lens.plain()), Sums()
    z_ref = lens.front.z  # origin of z in the sums: a near one limits rounding
    for face, sign in ((lens.back, 1), (lens.front, -1)):
        rim, raised = face.around, face.around.z - z_ref
        cap, wall = _cap_and_wall(lens, rim, raised)
        if face.outline is not None:  # the optical part replaces the plane there
            inner = outline_border(face.outline, face.optical)
            hole, raised = of_face(rim, inner, raised), face.z - z_ref
            own = _of_revolution(face, raised)
            cap += Sums(own.area - hole.area, own.volume - hole.volume, own.moment - hole.moment)
        volume, moment = sign * (cap.volume + wall.volume), sign * (cap.moment + wall.moment)
        total += Sums(cap.area + sign * wall.area, volume, moment)
    return MassProperties.of(total, z_ref)


def _cap_and_wall(lens: Lens, rim: Surface, raised: float) -> tuple[Sums, Sums]:
    """Return the sums over a face inside the lens's rim, and over the wall from the plane z = 0 up to it."""
    if rim.chart == lens.back.chart:
        border = outline_border(lens.outline, rim)
    else:  # the rim of the back, seen along the axis
        border, _ = _rim_in_space(lens.back, outline_border(lens.outline, lens.back))
    return of_face(rim, border, raised), of_wall(rim, border, raised)
