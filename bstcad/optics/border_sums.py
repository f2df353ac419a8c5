"""The same sums as in face_sums over the part of a face inside any closed curves, by Green's theorem.

∫∫ g dx dy = -∮ G dx with G = ∫ g dy along a chord of constant x from the axis to the border: Gauss points on both, and
none of them beyond a knot line, between which a spline is a polynomial.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from bstcad.optics.face_sums import POINTS, SMOOTH, Face, FaceSums, gauss_rule, parts_of_a_span, sums_at

STRIP = 256  # places of the border at a time
END = 4  # parts of the spans at the ends of a net, at least
LEVEL = 1e-14  # of a length: along a curve that goes no further in x there is nothing to integrate


@dataclass(frozen=True)
class Border:
    """Gauss points of closed curves that have the face on their left, seen against z: counterclockwise, holes not."""

    x: np.ndarray  # (n,) mm
    y: np.ndarray
    dx: np.ndarray  # their weights in ∮ … dx (mm)
    ds: np.ndarray  # and in ∮ … ds


def border_sums(face: Face, border: Border, raised: float = 0.0) -> FaceSums:
    """The sums of a face within a border, in float64 on the CPU, its heights `raised` by so much."""
    found = np.zeros(5)
    moves = np.flatnonzero(np.abs(border.dx) > LEVEL * border.ds)
    for start in range(0, len(moves), STRIP):
        some = moves[start : start + STRIP]
        found += sums_at(face, raised, *_chords(face, border.x[some], border.y[some], border.dx[some]))
    h, _, _ = face.relative_sag_and_slope(torch.from_numpy(border.x), torch.from_numpy(border.y))
    return FaceSums(*found.tolist(), float((border.ds * (h.numpy() + raised)).sum()))


def _chords(face: Face, x: np.ndarray, y: np.ndarray, dx: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(x, y, weights) along the chords from y = 0 to places of the border."""
    ends, count = _ends(face, y)
    place, part = np.nonzero(np.diff(ends, axis=1) > 0)
    low, high = ends[place, part], ends[place, part + 1]
    point, weight = gauss_rule(count)
    along = ((low + high) / 2)[:, None] + ((high - low) / 2)[:, None] * point
    total = (-dx * np.sign(y))[place, None] * ((high - low) / 2)[:, None] * weight
    return x[place].repeat(count), along.ravel(), total.ravel()


def _ends(face: Face, y: np.ndarray) -> tuple[np.ndarray, int]:
    """(n, parts + 1) where the parts of each chord end, some of them without length; Gauss points in each."""
    low, high = np.minimum(y, 0.0)[:, None], np.maximum(y, 0.0)[:, None]
    if not math.isfinite(face.detail):
        return np.hstack([low, high]), SMOOTH
    (first, last), pitch = face.y, face.pitch[1]
    lines = np.concatenate([[first], first + pitch * (np.arange(1, face.m - 2) + 0.5), [last]])
    end = np.linspace(0.0, 1.5 * pitch, END + 1)  # x(t) is quadratic in these two spans, and h(x) no polynomial
    parts = parts_of_a_span(face)
    fine = np.interp(np.arange((len(lines) - 1) * parts + 1) / parts, np.arange(len(lines)), lines)
    return np.clip(np.unique(np.concatenate([fine, first + end, last - end, [0.0]])), low, high), POINTS
