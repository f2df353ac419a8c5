"""Slope and curvature of a B-spline net, exact in each knot span, up to the knots on either side of it.

In span (i, j) the surface is one biquadratic piece of nine control points.  Second derivatives jump at the knots, so
that what bounds them has to look at each span by itself; s in [0, 1] is the place within it (spline_basis.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.outlines import Outline
from bstcad.optics.outlines import inside as within
from bstcad.optics.spline_basis import position

SPANS = 1 << 14  # looked at together: what they take stays in the cache
QUARTERS = (0.0, 0.25, 0.5, 0.75, 1.0)  # of a span, along x and along y, where bounds on the back are held to it and
# where figures of it are taken: a grid four times finer than the net, with both sides of each knot


@dataclass(frozen=True)
class Jet:
    """Derivatives of z(x, y) at places of knot spans, each (k, k, spans): by the place in x, that in y, the span."""

    z_x: Tensor
    z_y: Tensor
    z_xx: Tensor  # 1/mm
    z_xy: Tensor
    z_yy: Tensor

    @property
    def slope(self) -> Tensor:
        """|∇z|, the tangent of the angle against z = const."""
        square = self.z_x * self.z_x + self.z_y * self.z_y
        return torch.sqrt(square.clamp_min(torch.finfo(square.dtype).tiny))  # guarded before the root

    @property
    def curvatures(self) -> tuple[Tensor, Tensor]:
        """(most concave, least concave) principal curvature (1/mm)."""
        return principal(self.z_x, self.z_y, self.z_xx, self.z_xy, self.z_yy)


def principal(z_x: Tensor, z_y: Tensor, z_xx: Tensor, z_xy: Tensor, z_yy: Tensor) -> tuple[Tensor, Tensor]:
    """The two principal curvatures of z(x, y), H ± sqrt(H² - K), positive where it is a valley towards +z (1/mm).

    H = ((1 + z_y²) z_xx - 2 z_x z_y z_xy + (1 + z_x²) z_yy) / (2 n³), K = (z_xx z_yy - z_xy²) / n⁴, n² = 1 + |∇z|².
    """
    norm2 = 1 + z_x * z_x + z_y * z_y
    mean = ((1 + z_y * z_y) * z_xx - 2 * z_x * z_y * z_xy + (1 + z_x * z_x) * z_yy) / (2 * norm2 * norm2.sqrt())
    gauss = (z_xx * z_yy - z_xy * z_xy) / (norm2 * norm2)
    spread = (mean * mean - gauss).clamp_min(torch.finfo(mean.dtype).tiny).sqrt()
    return mean + spread, mean - spread


def weights(span: Tensor, m: int, s: float) -> tuple[tuple[Tensor, Tensor, Tensor], ...]:
    """The three non-zero basis functions, and their first and second derivatives in u, at s of each span (int64).

    As `spline_basis.basis` has them; du/dt = 2 (a q + b s), d²u/dt² = 2 (b - a).
    """
    a = torch.where(span == 0, 1.0, 0.5).double()
    b = torch.where(span == m - 3, 1.0, 0.5).double()
    q, du, ddu = 1.0 - s, 2 * (a * (1.0 - s) + b * s), 2 * (b - a)
    w0, w2 = a * q * q, b * s * s
    d0, d2 = -2 * a * q / du, 2 * b * s / du
    dd0, dd2 = (2 * a - d0 * ddu) / du**2, (2 * b - d2 * ddu) / du**2
    return (w0, 1.0 - w0 - w2, w2), (d0, -d0 - d2, d2), (dd0, -dd0 - dd2, dd2)


@dataclass(frozen=True)
class Spans:
    """Some knot spans of a net."""

    m: int  # control points a side of the net
    pitch: tuple[float, float]  # mm
    i: Tensor  # (n,) int64, along x
    j: Tensor  # along y
    heights: Tensor  # (9, n) of the control points of each (mm), x first

    @classmethod
    def of(cls, surface: BSplineSurface, i: Tensor, j: Tensor) -> Spans:
        """These spans of a surface."""
        corner, net = i * surface.m + j, surface.heights.reshape(-1)
        heights = torch.stack([net[corner + (a * surface.m + b)] for a in range(3) for b in range(3)])
        return cls(surface.m, surface.pitch, i, j, heights)

    def jet(self, s: Sequence[float]) -> Jet:
        """At the places s x s of each; differentiable in the heights."""
        pitch_x, pitch_y = self.pitch
        along_x, along_y = (self._weights(index, s) for index in (self.i, self.j))
        value, first, second = ([_mean(w, self.heights[b::3]) for b in range(3)] for w in along_x)
        value, first, second = ([row[:, None] for row in rows] for rows in (value, first, second))
        return Jet(
            _mean(along_y[0], first) / pitch_x,
            _mean(along_y[1], value) / pitch_y,
            _mean(along_y[0], second) / pitch_x**2,
            _mean(along_y[1], first) / (pitch_x * pitch_y),
            _mean(along_y[2], value) / pitch_y**2,
        )

    def _weights(self, index: Tensor, s: Sequence[float]) -> list[list[Tensor]]:
        """[derivative][basis function]: (places, n)."""
        found = [weights(index, self.m, place) for place in s]
        return [[torch.stack([w[order][k] for w in found]).to(self.heights) for k in range(3)] for order in range(3)]

    def scattered(self, gradient: Tensor) -> Tensor:
        """(m, m) the transpose of taking `heights`: no control point is added to twice at a time, in any order."""
        net, corner = torch.zeros(self.m * self.m).to(gradient), self.i * self.m + self.j
        for k, part in enumerate(gradient):
            at = corner + (k // 3 * self.m + k % 3)
            net[at] += part
        return net.view(self.m, self.m)


def _mean(w: Sequence[Tensor], values: Sequence[Tensor]) -> Tensor:
    return w[0] * values[0] + w[1] * values[1] + w[2] * values[2]


def places(surface: BSplineSurface, i: Tensor, j: Tensor, s: Sequence[float]) -> tuple[Tensor, Tensor]:
    """x and y (mm) of the same places, (k, 1, spans) and (1, k, spans)."""
    at = torch.tensor(list(s), dtype=torch.float64, device=i.device)[:, None]
    u, v = (position(index + at, surface.m) for index in (i, j))
    pitch_x, pitch_y = surface.pitch
    return (surface.x[0] + pitch_x * u)[:, None], (surface.y[0] + pitch_y * v)[None]


def inside(surface: BSplineSurface, outline: Outline, i: Tensor, j: Tensor, s: Sequence[float]) -> Tensor:
    """(k, k, spans): does the outline hold the place, or does its rim pass within half a span's diagonal of it?"""
    x, y = places(surface, i, j, s)
    return within(outline.limits, x, y, math.hypot(*surface.pitch) / 2)


def curvature_bounds(surface: BSplineSurface, sign: float) -> Tensor:
    """(m - 2, m - 2) of each span: what the principal curvatures of sign · z do not exceed (1/mm), if it is positive.

    Second derivatives are means of differences of the control points, in an end span of 1/4 to 2 times those.  A
    principal curvature is at most the eigenvalue of the Hessian, where that is positive, and the eigenvalue grows with
    both diagonal entries and with the magnitude of the other.
    """
    d_x, d_y = _differences(surface)
    pitch_x, pitch_y = surface.pitch
    xx, yy = sign * (d_x[1:] - d_x[:-1]) / pitch_x, sign * (d_y[:, 1:] - d_y[:, :-1]) / pitch_y
    for end in (xx[0], xx[-1], yy[:, 0], yy[:, -1]):
        end.copy_(torch.maximum(2 * end, end / 4))
    xx, yy = _most(xx, 1, 3), _most(yy, 0, 3)
    xy = _most(_most(((d_x[:, 1:] - d_x[:, :-1]) / pitch_y).abs(), 0, 2), 1, 2)
    return (xx + yy) / 2 + torch.sqrt(((xx - yy) / 2) ** 2 + xy**2)


def slope_bounds(surface: BSplineSurface) -> Tensor:
    """(m - 2, m - 2) of each span: what |∇z| does not exceed; slopes are means of differences of the control points."""
    d_x, d_y = (d.abs() for d in _differences(surface))
    return torch.sqrt(_most(_most(d_x, 0, 2), 1, 3) ** 2 + _most(_most(d_y, 0, 3), 1, 2) ** 2)


def _differences(surface: BSplineSurface) -> tuple[Tensor, Tensor]:
    """Of neighbouring heights over their distance along x, (m - 1, m), and along y, (m, m - 1)."""
    h, (pitch_x, pitch_y) = surface.heights.detach(), surface.pitch
    return (h[1:] - h[:-1]) / pitch_x, (h[:, 1:] - h[:, :-1]) / pitch_y


def _most(t: Tensor, axis: int, count: int) -> Tensor:
    """The largest of each `count` neighbours along an axis."""
    left = t.shape[axis] - count + 1
    most = t.narrow(axis, 0, left)
    for k in range(1, count):
        most = torch.maximum(most, t.narrow(axis, k, left))
    return most
