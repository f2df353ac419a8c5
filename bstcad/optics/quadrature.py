"""Integrals over any face inside any border, which area, volume and centroid are made of.

By Green's theorem, to some 1e-9; the tests hold them to the exact integral of a control net.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field

import numpy as np
import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.surfaces import Surface

SPANS = 128  # a coarser net's spans are divided so that an axis has as many parts at least
POINTS = 3  # Gauss points in each part of a chord or of an edge …
SMOOTH = 96  # Gauss points of a chord over a smooth face; up to a half diagonal of 0.95 R they leave only rounding
END_PARTS = 12  # at least, of a net's end spans, where x(t) is quadratic and h(x) no polynomial: volumes to 1e-12
STRIP = 512  # border points at a time
LEVEL = 1e-14  # part of a length; a border that goes no further in x adds nothing
FINE = 400  # … 2 in those of a net with as many control points a side: they hold the area of such a lens to 1e-9
EDGE_PARTS = 256  # least number of parts of an edge's curve

gauss_rule = functools.cache(np.polynomial.legendre.leggauss)  # points and weights from -1 to 1, by their number


@dataclass(frozen=True)
class Border:
    """Gauss points of closed curves that have the face on their left, seen against z: counterclockwise, holes not."""

    x: np.ndarray  # (n,) mm
    y: np.ndarray
    dx: np.ndarray  # their weights in ∮ … dx (mm)
    dy: np.ndarray

    @property
    def ds(self) -> np.ndarray:
        """Their weights in ∮ … ds (mm)."""
        return np.hypot(self.dx, self.dy)


@dataclass(frozen=True)
class Sums:
    """Sums over a piece of a solid's surface with the unit normal n; over the whole surface, those of the solid."""

    area: float = 0.0  # ∫ dA (mm²)
    volume: float = 0.0  # ∫ r·n dA / 3 (mm³): of the cone from the origin to the piece
    moment: np.ndarray = field(default_factory=lambda: np.zeros(3))  # ∫ r (r·n) dA / 4 (mm⁴): volume times centroid

    def __add__(self, other: Sums) -> Sums:
        return Sums(self.area + other.area, self.volume + other.volume, self.moment + other.moment)


def of_face(face: Surface, border: Border, raised: float = 0.0) -> Sums:
    """The sums of z = h(x, y) + raised inside a border, n towards +z: n dA = (-h_x, -h_y, 1) dx dy; float64 on the CPU.

    ∫∫ g dx dy = -∮ G dx with G = ∫ g dy along a chord of constant x from y = 0 to the border: Gauss points on both.
    """
    total = Sums()
    moves = np.flatnonzero(np.abs(border.dx) > LEVEL * border.ds)
    for start in range(0, len(moves), STRIP):
        some = moves[start : start + STRIP]
        total += _at(face, raised, *_chords(face, border.x[some], border.y[some], border.dx[some]))
    return Sums(abs(total.area), total.volume, total.moment)  # the area is negative for a border seen from below


def of_wall(face: Surface, border: Border, raised: float = 0.0) -> Sums:
    """The sums of the wall along z between the plane z = 0 and the rim of a face on a border, n away from the face."""
    h = face.relative_sag_and_slope(torch.from_numpy(border.x), torch.from_numpy(border.y))[0].numpy() + raised
    cone = h * (border.x * border.dy - border.y * border.dx)  # r·n ds, times the wall's height
    return Sums(float((border.ds * h).sum()), float(cone.sum()) / 3, _moment(cone, border.x, border.y, h / 2))


def _at(face: Surface, raised: float, x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> Sums:
    """The sums by points of these weights (mm²)."""
    h, h_x, h_y = (part.numpy() for part in face.relative_sag_and_slope(torch.from_numpy(x), torch.from_numpy(y)))
    area, h = weight * np.sqrt(1 + h_x * h_x + h_y * h_y), h + raised
    cone = weight * (h - x * h_x - y * h_y)
    return Sums(float(area.sum()), float(cone.sum()) / 3, _moment(cone, x, y, h))


def _moment(cone: np.ndarray, *r: np.ndarray) -> np.ndarray:
    return np.array([(cone * axis).sum() for axis in r]) / 4


def rim_breaks(surface: BSplineSurface, radius: float) -> np.ndarray:
    """Angles from 0 to 2 pi, ascending, between which the rim of a round lens crosses no knot line of the surface.

    At most 2 pi / 256 apart.
    """
    angles = [np.linspace(0, 2 * np.pi, 257)]
    axes = zip((surface.x, surface.y), surface.pitch, surface.shape, (0.0, np.pi / 2), strict=True)
    for (first, _), pitch, m, quarter in axes:
        lines = first + pitch * (np.arange(1, m - 2) + 0.5)  # x(t) = first + pitch (t + 1/2) inside
        turn = np.arccos(lines[np.abs(lines) < radius] / radius)
        angles += [quarter + turn, quarter - turn]
    theta = np.sort(np.concatenate(angles) % (2 * np.pi))
    theta = theta[np.concatenate([[True], np.diff(theta) > 1e-9])]  # rad; two crossings in one point count once
    return np.append(theta[theta < 2 * np.pi - 1e-9], 2 * np.pi)


def gauss_points(breaks: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points and weights, `count` between every two breaks."""
    point, weight = gauss_rule(count)
    half = np.diff(breaks)[:, None] / 2
    return (breaks[:-1, None] + half * (1 + point)).ravel(), (half * weight).ravel()


def divided(breaks: np.ndarray, parts: int) -> np.ndarray:
    """The breaks with more between them, evenly, so that there are at least this many parts."""
    each = math.ceil(parts / (len(breaks) - 1))
    return np.interp(np.arange((len(breaks) - 1) * each + 1) / each, np.arange(len(breaks)), breaks)


def outline_border(outline: Outline, face: Surface) -> Border:
    """The border of a circle or of a box (its corners sharp), in parts that meet no knot line of a face."""
    net = face.is_net
    count = _points(face) if net else POINTS
    if outline.is_round:
        breaks = rim_breaks(face, outline.radius) if net else np.linspace(0, 2 * np.pi, EDGE_PARTS + 1)
        theta, weight = gauss_points(breaks, count)
        x, y = outline.radius * np.cos(theta), outline.radius * np.sin(theta)
        return Border(x, y, -y * weight, x * weight)
    sides = []
    for axis, half in enumerate(outline.half_extent):
        breaks = _smooth_parts(face, axis, EDGE_PARTS) if net else np.linspace(-half, half, EDGE_PARTS + 1)
        sides.append(gauss_points(np.clip(breaks, -half, half), count))
    (x, dx), (y, dy), (a, b) = *sides, outline.half_extent
    no_x, no_y = np.zeros_like(x), np.zeros_like(y)
    return Border(
        np.concatenate([x, no_y + a, x, no_y - a]),
        np.concatenate([no_x - b, y, no_x + b, y]),
        np.concatenate([dx, no_y, -dx, no_y]),
        np.concatenate([no_x, dy, no_x, -dy]),
    )


def _chords(face: Surface, x: np.ndarray, y: np.ndarray, dx: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(x, y, weights) along the chords from y = 0 to points of the border."""
    ends, count = _chord_ends(face, y)
    chord, part = np.nonzero(np.diff(ends, axis=1) > 0)
    low, high = ends[chord, part], ends[chord, part + 1]
    point, weight = gauss_rule(count)
    along = ((low + high) / 2)[:, None] + ((high - low) / 2)[:, None] * point
    total = (-dx * np.sign(y))[chord, None] * ((high - low) / 2)[:, None] * weight
    return x[chord].repeat(count), along.ravel(), total.ravel()


def _chord_ends(face: Surface, y: np.ndarray) -> tuple[np.ndarray, int]:
    """((n, parts + 1) ends of the parts of each chord, some without length; Gauss points in each)."""
    low, high = np.minimum(y, 0.0)[:, None], np.maximum(y, 0.0)[:, None]
    if not face.is_net:
        return np.hstack([low, high]), SMOOTH
    return np.clip(np.union1d(_smooth_parts(face, 1, SPANS), 0.0), low, high), _points(face)


def _points(face: BSplineSurface) -> int:
    return POINTS if min(face.shape) < FINE else 2


def _smooth_parts(face: BSplineSurface, axis: int, parts: int) -> np.ndarray:
    """Breaks (mm) along an axis of a net, between which heights are nearly polynomial: knot lines and more."""
    (first, last), pitch = (face.x, face.y)[axis], face.pitch[axis]
    lines = np.concatenate([[first], first + pitch * (np.arange(1, face.shape[axis] - 2) + 0.5), [last]])
    ends = [np.linspace(*pair, END_PARTS + 1) for pair in (lines[:2], lines[-2:])]
    return np.unique(np.concatenate([divided(lines, parts), *ends]))


# ---- of a solid ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MassProperties:
    """Properties of a solid of even density; a STEP file states them, so that its reader can check the shape by them.

    By the divergence theorem, A = ∮ dA, V = ∮ r·n dA / 3 and V c = ∮ r (r·n) dA / 4.
    """

    area: float  # area of the whole surface (mm²)
    volume: float  # mm³
    centroid: tuple[float, float, float]  # mm

    @classmethod
    def of(cls, total: Sums, z: float) -> MassProperties:
        """Properties of a solid by the sums over its whole surface, whose origin is at z (mm) on the axis."""
        c_x, c_y, c_z = (total.moment / total.volume).tolist()
        return cls(total.area, total.volume, (c_x, c_y, z + c_z))


def of_lens(lens: Lens) -> MassProperties:
    """Properties of a bare lens by its own surfaces, to 1e-9; OCC takes minutes over a large net, and leaves 1e-5."""
    lens, total = lens.plain(), Sums()
    z_ref = lens.front.z  # heights are measured from there, so that digits stay
    for face, sign in ((lens.back, 1), (lens.front, -1)):
        rim, raised = face.around, face.around.z - z_ref
        border = outline_border(lens.outline, rim)
        cap, wall = of_face(rim, border, raised), of_wall(rim, border, raised)
        if face.outline is not None:  # there the plane makes way for the optical part
            inner = outline_border(face.outline, face.optical)
            hole, dome = of_face(rim, inner, raised), of_face(face.optical, inner, face.z - z_ref)
            cap += Sums(dome.area - hole.area, dome.volume - hole.volume, dome.moment - hole.moment)
        volume, moment = sign * (cap.volume + wall.volume), sign * (cap.moment + wall.moment)
        total += Sums(cap.area + sign * wall.area, volume, moment)
    return MassProperties.of(total, z_ref)
