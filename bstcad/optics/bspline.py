"""The seed's B-spline surface: order 3, uniform clamped knots, control points uniform in x and y, only z free.

Because the control points are uniform, x(t) is the identity shifted by 1/2 inside and quadratic in the two end
spans, so t(x) has a closed form and a ray needs no search for its parameter.  Nine products a point.
Source: Wang et al. 2023, "B-spline freeform surface tailoring for prescribed irradiance", Eqs. 2 and 7-13.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

DEGREE = 2  # order 3


def knots(m: int) -> np.ndarray:
    """{0, 0, 0, 1, 2, …, m-3, m-2, m-2, m-2}: the full knot vector of m control points, shape (m + 3,)."""
    return np.concatenate([[0.0, 0.0], np.arange(m - 1, dtype=float), [m - 2.0, m - 2.0]])


def parameter(x: Tensor, m: int) -> Tensor:
    """t(x) for x in [0, m-1] (units of the control-point spacing); Wang et al. 2023, Eq. 13.

    t = 2 - sqrt(4 - 2x), x - 1/2, m - 4 + sqrt(4 - 2(m - 1 - x)) in the first, inner and last span.
    """
    first, last = x < 1.5, x > m - 2.5
    end = torch.where(first, x, m - 1 - x)  # distance from the nearer end
    root = torch.sqrt(4.0 - 2.0 * torch.where(first | last, end, torch.ones_like(x)))  # guarded before the root
    return torch.where(first, 2.0 - root, torch.where(last, m - 4.0 + root, x - 0.5))


def position(t: Tensor, m: int) -> Tensor:
    """x(t) = 2t - t²/2, t + 1/2, or its mirror image in the last span: the inverse of `parameter`."""
    end = m - 2.0 - t
    return torch.where(t < 1, 2 * t - t * t / 2, torch.where(end < 1, m - 1 - 2 * end + end * end / 2, t + 0.5))


@dataclass(frozen=True)
class BSplineSurface:
    """z = z0 + Σ_i Σ_j B_i(t_x(x)) B_j(t_y(y)) h_ij.

    Heights are kept relative to the plane z0 so that float32 resolves nanometres.
    """

    z: float  # z0, the plane the heights are measured from (mm)
    heights: Tensor  # (m, m) mm, x along the first axis
    x: tuple[float, float]  # extent of the net in x: first and last control point (mm)
    y: tuple[float, float]  # extent of the net in y (mm)

    @property
    def m(self) -> int:
        """Number of control points along each axis."""
        return self.heights.shape[0]

    def control_points(self) -> np.ndarray:
        """The control net (m, m, 3) in mm, float64, x along the first axis."""
        net = np.empty((self.m, self.m, 3))
        net[..., 0] = np.linspace(*self.x, self.m)[:, None]
        net[..., 1] = np.linspace(*self.y, self.m)[None, :]
        net[..., 2] = self.z + self.heights.detach().cpu().numpy().astype(np.float64)
        return net
