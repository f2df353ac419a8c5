"""Principal curvatures and steepest slope of a radial net, by both fundamental forms.

With n the outward unit normal of the surface S(x, y),

    E = S_x · S_x, F = S_x · S_y, G = S_y · S_y;    l = S_xx · n, m = S_xy · n, k = S_yy · n,

whose principal curvatures are the roots κ of (l - κ E)(k - κ G) = (m - κ F)².  A valley, seen from outside, has κ > 0.
The slope is the angle between n and +z.  Above 90 degrees the face overhangs: a mould of two parts cannot release it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bstcad.optics.surfaces.bspline import QUARTERS, BSplineSurface, Spans, near_outline, span_points
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.rays import dot
from bstcad.optics.surfaces.surfaces import cross, points_on

SPANS_AT_A_TIME = 1 << 14  # number of spans whose curvatures are in memory together

Largest = tuple[float, tuple[float, float, float]]  # largest value of a quantity, and its place (mm)


def extremes(back: RadialSurface, outline: Outline) -> tuple[Largest, Largest, Largest]:
    """Return the largest curvature of a valley and of a ridge (1/mm), and the largest slope (degrees), of a face.

    outline: outline of the face in the chart.  The points are those at QUARTERS of each knot span.
    """
    i, j = (t.reshape(-1) for t in torch.meshgrid(*(torch.arange(m - 2) for m in back.shape), indexing="ij"))
    found = [(-math.inf, (0.0, 0.0, 0.0))] * 3
    for first in range(0, len(i), SPANS_AT_A_TIME):
        some = slice(first, first + SPANS_AT_A_TIME)
        inside = near_outline(back, outline, i[some], j[some], s=QUARTERS)
        if not bool(inside.any()):
            continue
        x, y = (p.expand(inside.shape)[inside] for p in span_points(back, i[some], j[some], QUARTERS))
        kept = outline.contains(x, y)
        for k, value in enumerate(_values(back, i[some], j[some], inside)):
            value = torch.where(kept, value, torch.full_like(value, -math.inf))
            at = int(value.argmax())
            if float(value[at]) > found[k][0]:
                p_x, p_y, p_z = points_on(back, x[at].numpy(), y[at].numpy()).tolist()
                found[k] = float(value[at]), (p_x, p_y, p_z)
    return found[0], found[1], found[2]


def _values(back: RadialSurface, i: Tensor, j: Tensor, inside: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return (κ of valleys, -κ of ridges, slope in degrees) at the points of spans (i, j) that are inside, (n,)."""
    jets = []
    for d in back.directions:
        component = BSplineSurface(0.0, (back.radius + back.heights) * d, back.x, back.y)
        jets.append(Spans.of(component, i, j).jet(QUARTERS))
    s_x, s_y, s_xx, s_xy, s_yy = (
        torch.stack([getattr(jet, name).expand(inside.shape)[inside] for jet in jets])
        for name in ("z_x", "z_y", "z_xx", "z_xy", "z_yy")
    )
    n = cross(s_x, s_y)
    n = n / torch.sqrt(dot(n, n))
    e, f, g = dot(s_x, s_x), dot(s_x, s_y), dot(s_y, s_y)
    l, m, k = dot(s_xx, n), dot(s_xy, n), dot(s_yy, n)  # noqa: E741 - the names of the second fundamental form
    area = e * g - f * f
    mean, gauss = (l * g - 2 * m * f + k * e) / (2 * area), (l * k - m * m) / area
    root = torch.sqrt((mean * mean - gauss).clamp(min=0))
    return mean + root, -(mean - root), torch.rad2deg(torch.arccos(n[2].clamp(-1.0, 1.0)))
