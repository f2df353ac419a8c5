"""The B-spline surface of Wang et al. 2023: control points uniform in x and y, only the heights z free.

The basis, and why x needs no search for its parameter: spline_basis.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from bstcad.optics import quadrature
from bstcad.optics.outlines import Circle, Outline
from bstcad.optics.spline_basis import evaluate


@dataclass(frozen=True)
class BSplineSurface:
    """z = z0 + Σ_i Σ_j B_i(u(x)) B_j(v(y)) h_ij.

    Heights are kept relative to the plane z0 so that float32 resolves nanometres.
    """

    z: float  # z0, the plane the heights are measured from (mm)
    heights: Tensor  # (m, m) mm, x along the first axis
    x: tuple[float, float]  # extent of the net in x: first and last control point (mm)
    y: tuple[float, float]  # extent of the net in y (mm)
    kind: Literal["bspline"] = "bspline"

    is_net, level = True, False
    curvature = conic_constant = None  # a freeform surface has none of its own

    @classmethod
    def from_control_points(cls, net: np.ndarray, z: float | None = None) -> BSplineSurface:
        """The surface of a control net (m, m, 3) in mm, heights measured from z or else from the mean of the net."""
        z = float(net[..., 2].mean()) if z is None else z
        x, y = ((float(net[0, 0, i]), float(net[-1, -1, i])) for i in (0, 1))
        return cls(z, torch.from_numpy(net[..., 2] - z), x, y)

    @property
    def detail(self) -> float:
        """Length over which it is one smooth piece (mm): a knot span."""
        return min(self.pitch)

    def from_vertex(self) -> BSplineSurface:
        """The same surface, its heights measured from where it crosses the axis."""
        axis = torch.zeros(1, dtype=self.heights.dtype, device=self.heights.device)
        vertex = float(self.relative_sag_and_slope(axis, axis)[0])
        return replace(self, z=self.z + vertex, heights=self.heights - vertex)

    @property
    def m(self) -> int:
        """Number of control points along each axis."""
        return self.heights.shape[0]

    @property
    def pitch(self) -> tuple[float, float]:
        """Spacing of the control points in x and in y (mm)."""
        return (self.x[1] - self.x[0]) / (self.m - 1), (self.y[1] - self.y[0]) / (self.m - 1)

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(z - z0 in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm; a point beyond the net is moved to its rim."""
        pitch_x, pitch_y = self.pitch
        u = ((x - self.x[0]) / pitch_x).clamp(0, self.m - 1)
        v = ((y - self.y[0]) / pitch_y).clamp(0, self.m - 1)
        h, h_u, h_v = evaluate(self.heights, u, v)
        return h, h_u / pitch_x, h_v / pitch_y

    def reaches(self, x: Tensor, y: Tensor) -> Tensor:
        """True where there is a point of the surface over (x, y): everywhere, since its rim goes on."""
        return torch.ones_like(x, dtype=torch.bool)

    def sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(z in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm; a point beyond the net is moved to its rim."""
        h, z_x, z_y = self.relative_sag_and_slope(x, y)
        return self.z + h, z_x, z_y

    def control_points(self) -> np.ndarray:
        """The control net (m, m, 3) in mm, float64, x along the first axis."""
        net = np.empty((self.m, self.m, 3))
        net[..., 0] = np.linspace(*self.x, self.m)[:, None]
        net[..., 1] = np.linspace(*self.y, self.m)[None, :]
        net[..., 2] = self.z + self.heights.detach().cpu().numpy().astype(np.float64)
        return net

    def sags(self, outline: Outline) -> tuple[float, float]:
        """Lowest and highest of the heights that the surface inside the outline depends on (mm), and of zero."""
        (pitch_x, pitch_y), net = self.pitch, self.control_points()
        x, y = (np.maximum(np.abs(net[..., i]) - 2 * pitch, 0.0) for i, pitch in enumerate((pitch_x, pitch_y)))
        heights = self.heights.detach().cpu()[outline.contains(torch.from_numpy(x), torch.from_numpy(y))]
        return min(float(heights.min()), 0.0), max(float(heights.max()), 0.0)

    def integral(self, outline: Outline) -> float:
        """∫∫ of the heights dx dy over a disc, or over the whole net, which ends at a rectangle's sides (mm³)."""
        return quadrature.over_disc(self, outline.radius) if isinstance(outline, Circle) else quadrature.over_net(self)

    def parameters(self) -> dict[str, Tensor]:
        """The heights (mm)."""
        return {"heights": self.heights}

    def with_parameters(self, **values: Tensor) -> BSplineSurface:
        """The same net with other heights."""
        return replace(self, **values)

    def moved(self, z: float) -> BSplineSurface:
        """The same surface with its heights measured from another plane z (mm)."""
        return replace(self, z=z)

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> BSplineSurface:
        """The same surface with its heights in another precision or on another device."""
        return replace(self, heights=self.heights.to(dtype=dtype, device=device))

    def plain(self) -> BSplineSurface:
        """The same surface with its heights in float64 on the CPU, without gradient."""
        return replace(self, heights=self.heights.detach().to("cpu", torch.float64))
