"""Machinability of the back: smallest radii, steepest slope, and where, on a grid four times finer than the net.

Reports, data sheets and the checks of a scene's bounds all take these numbers.  Curvature jumps at the knots, so each
knot span is sampled by itself, up to its ends, at optics.bspline.QUARTERS inside the outline; slopes on the rim too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from bstcad.optics.bspline import QUARTERS, BSplineSurface, span_places, weights
from bstcad.optics.kernels import spline
from bstcad.optics.lens import Lens
from bstcad.optics.sampling import rim

AT = 0.97  # of a bound: a point beyond counts as at the bound (the penalty of tailoring begins at 0.99)
FLAT, FLATTEST = 1e-9, 1e9  # 1/mm: less curvature is rounding; mm: the radius reported for it
RIM = 1025  # points along a quarter of the rim
ROUNDING = 1e-9  # of the outline's size: where the net ends at the rim, its last points are on the rim


@dataclass(frozen=True)
class Met:
    """The largest value of a quantity over the back."""

    largest: float
    where: str
    at_bound: float  # share of the area that is at the bound; 0 without a bound


@dataclass(frozen=True)
class Survey:
    """The extremes of a back."""

    concave: Met  # the smallest principal radius of a valley (mm), as `largest`; FLATTEST if there is no valley
    convex: Met  # the same of a ridge
    slope: Met  # the steepest angle of the tangent plane against z = const (degrees)


def survey(lens: Lens, concave: float | None = None, convex: float | None = None, slope: float | None = None) -> Survey:
    """Survey the back of a lens.  concave, convex: bounds on radii (mm); slope: bound on the angle (degrees)."""
    lens, wide = lens.plain(), 1 + ROUNDING
    x, y, along_x, along_y = _grid(lens.back)
    limits = lens.outline.scaled(wide).limits
    near = (
        math.inf if concave is None else AT * (1 / concave),
        math.inf if convex is None else AT * (1 / convex),
        math.inf if slope is None else AT * math.tan(math.radians(slope)),
    )
    found, place, count = spline.largest_bending(
        lens.back.heights.contiguous().numpy(), (along_x, along_y), (x, y), limits, near
    )
    pitch_x, pitch_y = lens.back.pitch
    each = pitch_x * pitch_y / len(QUARTERS) ** 2 / lens.outline.area
    valley, ridge, steep = (
        Met(float(value), _at(x.flat[i], y.flat[j]), min(each * float(n), 1.0))
        for value, (i, j), n in zip(found, place, count, strict=True)
    )
    return Survey(_radius(valley), _radius(ridge), _angle(lens, steep))


def _grid(back: BSplineSurface) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(x, y) (m - 2, places) mm of QUARTERS of each span, and the weights for spline.largest_bending."""
    span, shape = torch.arange(back.m - 2), (back.m - 2, len(QUARTERS))
    x, y = (at.reshape(shape[::-1]).T.contiguous().numpy() for at in span_places(back, span, span, QUARTERS))
    by_quarter = [torch.stack([torch.stack(order) for order in weights(span, back.m, s)]) for s in QUARTERS]
    of_unit = torch.stack(by_quarter).permute(3, 0, 1, 2)  # by span, quarter, derivative, control point
    scales = (torch.tensor([1.0, 1 / pitch, 1 / pitch**2], dtype=torch.float64)[:, None] for pitch in back.pitch)
    along_x, along_y = ((of_unit * scale).reshape(*shape, 9).contiguous().numpy() for scale in scales)
    return x, y, along_x, along_y


def _radius(met: Met) -> Met:
    return replace(met, largest=1 / met.largest if met.largest > FLAT else FLATTEST)


def _angle(lens: Lens, met: Met) -> Met:
    """The angle in degrees, of the rim too: it may be steeper between the points of the grid."""
    x, y = rim(lens.outline, RIM)
    _, z_x, z_y = lens.back.sag_and_slope(x, y)
    steep = torch.hypot(z_x, z_y)
    if (most := float(steep.max())) > met.largest:
        at = int(steep.argmax())
        met = replace(met, largest=most, where=_at(float(x[at]), float(y[at])))
    return replace(met, largest=math.degrees(math.atan(met.largest)))


def _at(x: float, y: float) -> str:
    return f"at ({x:.4g}, {y:.4g}) mm"
