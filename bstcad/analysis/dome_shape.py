"""Shape of a dome: its thickness from the centre, its principal radii and its steepest slope.

The curvatures follow from both fundamental forms of the surface S(x, y), n the outward unit normal:

    E = S_x · S_x, F = S_x · S_y, G = S_y · S_y;    l = S_xx · n, m = S_xy · n, k = S_yy · n,

whose principal curvatures are the roots κ of (l - κ E)(k - κ G) = (m - κ F)².  A valley, seen from outside, has κ > 0.
The slope is the angle between n and +z.  Above 90 degrees the dome overhangs: a mould of two parts cannot release it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bstcad.optics.lens.interfaces import intersect
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import QUARTERS, BSplineSurface, Spans, near_outline, span_points
from bstcad.optics.surfaces.outlines import EVERYWHERE
from bstcad.optics.surfaces.radial import RadialSurface, cross, dot
from bstcad.optics.surfaces.rays import Rays, Status
from bstcad.optics.surfaces.surfaces import Surface

SPANS_AT_A_TIME = 1 << 14  # number of spans whose curvatures are in memory together


@dataclass(frozen=True)
class DomeExtremes:
    """Largest curvature of a valley and of a ridge (1/mm) and slope (degrees) of a dome, each with its place (mm)."""

    valley: tuple[float, tuple[float, float, float]]
    ridge: tuple[float, tuple[float, float, float]]
    slope: tuple[float, tuple[float, float, float]]


def radial_thickness(front: Surface, back: RadialSurface, x: Tensor, y: Tensor) -> Tensor:
    """Return the distances (mm) between front and back at points of the back's chart, along lines from its centre.

    A front beside the centre, such as a plane below it, gives NaN where the line meets it behind the centre.
    """
    position = back.at(x, y).position
    rho = torch.sqrt(dot(position, position))
    status = torch.zeros(x.shape, dtype=torch.uint8)
    rays = Rays(torch.zeros_like(position), position / rho, torch.ones_like(x), status, z=back.z)
    met, _ = intersect(front.optical, rays, EVERYWHERE, Status.MISSED_FRONT)
    at = torch.stack([*met.position[:2], met.above(back.z)])
    return torch.where(met.alive, rho - torch.sqrt(dot(at, at)), torch.full_like(rho, math.nan))


def extremes(lens: Lens, back: RadialSurface) -> DomeExtremes:
    """Return the extremes of a dome inside its outline, at QUARTERS of each knot span."""
    i, j = (t.reshape(-1) for t in torch.meshgrid(*(torch.arange(m - 2) for m in back.shape), indexing="ij"))
    found = [(-math.inf, (0.0, 0.0, 0.0))] * 3
    for first in range(0, len(i), SPANS_AT_A_TIME):
        some = slice(first, first + SPANS_AT_A_TIME)
        inside = near_outline(back, lens.outline, i[some], j[some], s=QUARTERS)
        if not bool(inside.any()):
            continue
        x, y = (p.expand(inside.shape)[inside] for p in span_points(back, i[some], j[some], QUARTERS))
        kept = lens.outline.contains(x, y)
        values = _values(back, i[some], j[some], inside)
        for k, value in enumerate(values):
            value = torch.where(kept, value, torch.full_like(value, -math.inf))
            at = int(value.argmax())
            if float(value[at]) > found[k][0]:
                place = back.at(x[at : at + 1], y[at : at + 1]).position[:, 0]
                found[k] = float(value[at]), (float(place[0]), float(place[1]), float(place[2]) + float(back.z))
    return DomeExtremes(*found)


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
