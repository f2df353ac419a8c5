"""Integrals over a face of a lens and along its rim: what area, volume and centroid of the lens are made of.

Over a net Gauss points stand between its knot lines, where a spline is a polynomial: sums of h up to h² are exact to
rounding.  The root in the area is no polynomial, but slopes differ little within a span: where by about 0.03, it is
good to 1e-8 of itself.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numba import njit
from torch import Tensor

from bstcad.optics.outlines import Circle, Outline
from bstcad.optics.quadrature import rim_breaks
from bstcad.optics.spline_basis import basis_matrix, position

POINTS = 3  # a span and axis: h² dx is there of degree 5 at most
SPANS = 64  # a coarser net's spans are divided into so many along an axis at least
SMOOTH = 96  # Gauss points across a smooth face; up to a half diagonal of 0.95 R they leave nothing but rounding
TURN = 16  # places around a smooth face; what is asked of it has no higher waves than two around the axis


class Face(Protocol):
    """What is asked of a surface; one of finite `detail` is a net, with m, pitch, x, y and heights (BSplineSurface)."""

    detail: float

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(height over its plane, ∂z/∂x, ∂z/∂y) at (x, y)."""


@dataclass(frozen=True)
class FaceSums:
    """Over a face within an outline; h: its height over a plane of its own choice."""

    area: float  # ∫∫ sqrt(1 + |∇h|²) (mm²)
    first: float  # ∫∫ h (mm³)
    in_x: float  # ∫∫ x h (mm⁴)
    in_y: float
    second: float  # ∫∫ h² (mm⁴)
    along_rim: float  # ∮ h ds (mm²)


def face_sums(face: Face, outline: Outline, raised: float = 0.0) -> FaceSums:
    """The sums of a face in float64 on the CPU, its heights `raised` by so much."""
    round_, net = isinstance(outline, Circle), math.isfinite(face.detail)
    if not net:
        found = sums_at(face, raised, *(_polar(outline.radius) if round_ else _smooth_rectangle(*outline.half_extent)))
    elif round_:
        whole = _inside(face, outline.radius)
        found = _over_spans(face, raised, whole) + sums_at(face, raised, *_beside_the_rim(face, outline.radius, whole))
    else:
        found = _over_spans(face, raised, np.ones((face.m - 2, face.m - 2), dtype=bool))
    x, y, weight = _rim(face, outline)
    h, _, _ = face.relative_sag_and_slope(torch.from_numpy(x), torch.from_numpy(y))
    return FaceSums(*found.tolist(), float((weight * (h.numpy() + raised)).sum()))


def sums_at(face: Face, raised: float, x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(area, ∫∫ h, ∫∫ x h, ∫∫ y h, ∫∫ h²) by points of these weights (mm²)."""
    h, h_x, h_y = (part.numpy() for part in face.relative_sag_and_slope(torch.from_numpy(x), torch.from_numpy(y)))
    area, h = weight * np.sqrt(1 + h_x * h_x + h_y * h_y), h + raised
    weighed = weight * h
    return np.array([part.sum() for part in (area, weighed, weighed * x, weighed * y, weighed * h)])


gauss_rule = functools.cache(np.polynomial.legendre.leggauss)  # points and weights from -1 to 1, by their number


def gauss_points(breaks: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points and weights, `count` between every two breaks."""
    point, weight = gauss_rule(count)
    half = np.diff(breaks)[:, None] / 2
    return (breaks[:-1, None] + half * (1 + point)).ravel(), (half * weight).ravel()


def _smooth_rectangle(a: float, b: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    (x, along), (y, across) = (gauss_points(np.array([-half, half]), SMOOTH) for half in (a, b))
    return np.repeat(x, SMOOTH), np.tile(y, SMOOTH), (along[:, None] * across).ravel()


def _polar(radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    r, weight = gauss_points(np.array([0.0, radius]), SMOOTH)
    theta = (np.arange(TURN) + 0.5) * 2 * np.pi / TURN
    x, y = r[:, None] * np.cos(theta), r[:, None] * np.sin(theta)
    return x.ravel(), y.ravel(), np.repeat(r * weight * 2 * np.pi / TURN, TURN)


# ---- nets ----------------------------------------------------------------------------------------------------------


def _axis(face: Face, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gauss points along one axis: (u in control points from the first, place in mm, weight in mm), so many a span.

    By the net's own parameter t, so that spans are polynomial to their ends: dx = x'(t) dt.
    """
    m, end, pitch = face.m, face.m - 2.0, face.pitch[axis]
    t, weight = gauss_points(np.linspace(0.0, end, (m - 2) * parts_of_a_span(face) + 1), POINTS)
    slope = 1 + np.maximum(1 - t, 0.0) + np.maximum(t - (end - 1), 0.0)  # x'(t) in pitches: 1 but in the end spans
    u = position(torch.from_numpy(t), m).numpy()
    return u, (face.x, face.y)[axis][0] + pitch * u, pitch * slope * weight


def parts_of_a_span(face: Face) -> int:
    """Into how many each span is divided."""
    return math.ceil(SPANS / (face.m - 2))


def _over_spans(face: Face, raised: float, inside: np.ndarray) -> np.ndarray:
    """The sums (as of `sums_at`) over those spans (x, y) of a net that are inside."""
    (u, x, weight), (v, y, across) = _axis(face, 0), _axis(face, 1)
    heights, (pitch_x, pitch_y) = face.plain().heights.numpy() + raised, face.pitch  # the basis sums to 1
    of_x, slope_of_x = (np.ascontiguousarray((basis_matrix(u, face.m, k) @ heights).T) for k in (0, 1))
    of_y, slope_of_y = (basis_matrix(v, face.m, k).data.reshape(-1, 3) for k in (0, 1))
    first = basis_matrix(v, face.m).indices[::3].astype(np.int64)
    each = POINTS * parts_of_a_span(face)
    slope_of_x /= pitch_x
    return _sum(of_x, slope_of_x, first, of_y, slope_of_y / pitch_y, x, weight, y, across, inside, each)


@njit(cache=True, nogil=True)
def _sum(of_x, slope_of_x, first, of_y, slope_of_y, x, weight, y, across, inside, each):
    """Row by row: along y three of the rows `of_x` (m, n) and `slope_of_x` are weighed at a time."""
    found = np.zeros(5)
    for j in range(len(y)):
        k, (a, b, c), (p, q, r) = first[j], of_y[j], slope_of_y[j]
        area = flat = in_x = second = 0.0
        for span in range(len(x) // each):
            if not inside[span, j // each]:
                continue
            for i in range(span * each, (span + 1) * each):
                h = a * of_x[k, i] + b * of_x[k + 1, i] + c * of_x[k + 2, i]
                h_x = a * slope_of_x[k, i] + b * slope_of_x[k + 1, i] + c * slope_of_x[k + 2, i]
                h_y = p * of_x[k, i] + q * of_x[k + 1, i] + r * of_x[k + 2, i]
                area += weight[i] * math.sqrt(1 + h_x * h_x + h_y * h_y)
                weighed = weight[i] * h
                flat += weighed
                in_x += weighed * x[i]
                second += weighed * h
        found += across[j] * np.array([area, flat, in_x, y[j] * flat, second])
    return found


def _lines(face: Face, axis: int) -> np.ndarray:
    """Where the knot lines of a net are (mm); those of its ends, which a round outline does not reach, as if inside."""
    return (face.x, face.y)[axis][0] + face.pitch[axis] * (np.arange(face.m - 1) + 0.5)


def _inside(face: Face, radius: float) -> np.ndarray:
    """Which spans (x, y) of a net lie inside a disc whole."""
    x, y = (np.maximum(np.abs(line[1:]), np.abs(line[:-1])) for line in (_lines(face, axis) for axis in (0, 1)))
    return np.hypot(x[:, None], y) < radius


def _beside_the_rim(face: Face, radius: float, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(x, y, weights) of what the spans inside leave of a disc, by chords along y at x = R cos θ.

    Between the angles at which the rim crosses knot lines the integral along a chord is smooth in θ.
    """
    breaks = rim_breaks(face, radius)
    breaks = np.append(breaks[breaks < np.pi], np.pi)
    theta, weight = gauss_points(breaks, 3)
    x, half = radius * np.cos(theta), radius * np.sin(theta)
    lines, columns = _lines(face, 1), _lines(face, 0)
    column = np.searchsorted(columns, radius * np.cos((breaks[:-1] + breaks[1:]) / 2)).repeat(3) - 1
    whole = inside[column]
    middle = np.abs(lines).argmin()
    first = np.where(whole.any(axis=1), whole.argmax(axis=1), middle)  # the whole spans of a column are neighbours
    last = first + whole.sum(axis=1)
    parts = parts_of_a_span(face)
    fine = np.interp(np.arange((len(lines) - 1) * parts + 1) / parts, np.arange(len(lines)), lines)
    half_ = half[:, None]
    below, above = np.minimum(fine, lines[first, None]), np.maximum(fine, lines[last, None])
    ends = np.clip(np.stack([below, above]), -half_, half_)
    side, row, part = np.nonzero(np.diff(ends, axis=2) > 0)
    low, high = ends[side, row, part], ends[side, row, part + 1]
    point, of_point = gauss_rule(3)
    y = ((low + high) / 2)[:, None] + ((high - low) / 2)[:, None] * point
    total = (weight * half)[row, None] * ((high - low) / 2)[:, None] * of_point
    return x[row].repeat(3), y.ravel(), total.ravel()


# ---- rims ----------------------------------------------------------------------------------------------------------


def _rim(face: Face, outline: Outline) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(x, y, weights (mm)) along the outline."""
    net = math.isfinite(face.detail)
    if isinstance(outline, Circle):
        breaks = rim_breaks(face, outline.radius) if net else np.linspace(0, 2 * np.pi, TURN + 1)
        theta, weight = gauss_points(breaks, 8)
        return outline.radius * np.cos(theta), outline.radius * np.sin(theta), outline.radius * weight
    a, b = outline.half_extent
    if net:
        (_, x, along), (_, y, across) = _axis(face, 0), _axis(face, 1)
    else:
        (x, along), (y, across) = (gauss_points(np.array([-half, half]), SMOOTH) for half in (a, b))
    sides = [(x, np.full_like(x, end), along) for end in (-b, b)]
    sides += [(np.full_like(y, end), y, across) for end in (-a, a)]
    x, y, weight = (np.concatenate(parts) for parts in zip(*sides, strict=True))
    return x, y, weight
