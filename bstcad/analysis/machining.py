"""What a tool meets of the back, on a grid four times finer than its net: smallest radii, steepest slope, and where.

Curvature jumps at the knots, so each knot span is looked at by itself, up to its ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.curvature import SPANS, Jet, Spans, curvature_bounds, places, slope_bounds
from bstcad.optics.lens import Lens

QUARTERS = (0.0, 0.25, 0.5, 0.75, 1.0)  # of a knot span
AT = 0.97  # of a bound: what comes nearer to it is at it (the penalty of tailoring begins at 0.99)
FLATTEST = 1e9  # mm; a radius said of a face that has no smaller one


@dataclass(frozen=True)
class Met:
    """The largest of something over the back, and the part of the places that are at its bound."""

    largest: float
    where: str
    at_bound: float


def concave(lens: Lens, radius: float) -> Met:
    """The smallest radius of a valley (mm), as `largest`; `radius` is its bound."""
    return _radius(lens, 1.0, lambda jet: jet.curvatures[0], radius)


def convex(lens: Lens, radius: float) -> Met:
    """The same of a ridge."""
    return _radius(lens, -1.0, lambda jet: -jet.curvatures[1], radius)


def slope(lens: Lens, degrees: float) -> Met:
    """The steepest angle of the back's tangent plane against z = const (degrees); `degrees` is its bound."""
    found = _largest(lens, slope_bounds(lens.back), lambda jet: jet.slope, math.tan(math.radians(degrees)))
    return Met(math.degrees(math.atan(found.largest)), found.where, found.at_bound)


def _radius(lens: Lens, sign: float, curvature: Callable[[Jet], Tensor], radius: float) -> Met:
    found = _largest(lens, curvature_bounds(lens.back, sign), curvature, 1 / radius)
    return Met(1 / max(found.largest, 1 / FLATTEST), found.where, found.at_bound)


def _largest(lens: Lens, most: Tensor, found: Callable[[Jet], Tensor], bound: float) -> Met:
    """most: (m - 2, m - 2) what it does not exceed in each span, which go from the largest of that down."""
    back, largest, where, reached = lens.back, -math.inf, "", 0
    limits, order = most.reshape(-1).sort(descending=True)
    for part, limit in zip(order.split(SPANS), limits[::SPANS], strict=True):
        if limit <= min(largest, AT * bound):
            break
        i, j = part // (back.m - 2), part % (back.m - 2)
        values, x, y = _inside(back, lens, i, j, found)
        reached += int((values >= AT * bound).sum())
        if float(values.max()) > largest:
            at = int(values.argmax())
            largest, where = float(values.flatten()[at]), f"at ({float(x[at]):.4g}, {float(y[at]):.4g}) mm"
    pitch_x, pitch_y = back.pitch
    count = lens.outline.area / (pitch_x * pitch_y) * len(QUARTERS) ** 2
    return Met(largest, where, min(reached / count, 1.0))


def _inside(
    back: BSplineSurface, lens: Lens, i: Tensor, j: Tensor, found: Callable[[Jet], Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """The value at each place of spans, -inf outside the outline, and x and y there, flattened."""
    x, y = torch.broadcast_tensors(*places(back, i, j, QUARTERS))
    values = found(Spans.of(back, i, j).jet(QUARTERS))
    return torch.where(lens.outline.contains(x, y), values, -math.inf), x.flatten(), y.flatten()
