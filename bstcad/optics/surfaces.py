"""Analytic surfaces z(x, y): plane and sphere.  The docstring of a surface is its equation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from bstcad.optics.outlines import STRICT, Outline

EQUATOR = 1e-6  # cos² of the slope's angle from which on a sphere is too steep to be a height over (x, y)


@dataclass(frozen=True)
class Plane:
    """z = z0."""

    z: float  # z0 (mm)
    kind: Literal["plane"] = "plane"

    __pydantic_config__ = STRICT
    curvature, conic_constant = 0.0, 0.0

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(z - z0 in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm: all zero."""
        zero = torch.zeros_like(x)
        return zero, zero, zero

    def reaches(self, x: Tensor, y: Tensor) -> Tensor:
        """True where there is a point of the surface over (x, y): everywhere."""
        return torch.ones_like(x, dtype=torch.bool)

    @property
    def level(self) -> bool:
        """Is it z = const, so that light along the axis meets it head on?"""
        return True

    def sags(self, outline: Outline) -> tuple[float, ...]:
        """Heights over the plane z0 (mm), the largest and least inside an outline among them: 0."""
        return (0.0,)

    def crossing(self, x: Tensor, y: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """(s in mm, met): where rays through (x, y) of the plane z0 meet the surface, as path from there: at once."""
        return torch.zeros_like(x), torch.ones_like(x, dtype=torch.bool)

    def sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(z in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm."""
        h, z_x, z_y = self.relative_sag_and_slope(x, y)
        return self.z + h, z_x, z_y


@dataclass(frozen=True)
class Sphere:
    """z = z0 + c r² / (1 + sqrt(1 - c² r²)), r² = x² + y²; c may be zero (a plane).

    This form (Wang et al. 2023, Eq. 16) keeps its digits where R - sqrt(R² - r²) loses all of them.
    """

    z: float  # vertex (mm)
    curvature: float | Tensor = 0.0  # c (1/mm); positive bends towards +z
    optimise: bool = False  # may tailoring change the curvature?
    kind: Literal["sphere"] = "sphere"

    __pydantic_config__ = STRICT
    conic_constant = 0.0

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(z - z0 in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm; beyond the equator finite numbers without meaning."""
        c = self.curvature
        r2 = x * x + y * y
        k = 1 - c * c * r2
        root = torch.sqrt(torch.where(k > EQUATOR, k, torch.full_like(k, EQUATOR)))  # guarded before the root
        return c * r2 / (1 + root), c * x / root, c * y / root

    @property
    def level(self) -> bool:
        """Is it z = const, so that light along the axis meets it head on?"""
        return not isinstance(self.curvature, Tensor) and self.curvature == 0

    def sags(self, outline: Outline) -> tuple[float, ...]:
        """Heights over the plane z0 (mm), the largest and least inside an outline, but for 0, among them: the rim's."""
        x, y = (torch.tensor(p, dtype=torch.float64) for p in outline.farthest)
        return (float(self.relative_sag_and_slope(x, y)[0].detach()),)

    def reaches(self, x: Tensor, y: Tensor) -> Tensor:
        """True where there is a point of the sphere over (x, y); its rim, where it stands upright, does not count."""
        return 1 - self.curvature * self.curvature * (x * x + y * y) > EQUATOR

    def crossing(self, x: Tensor, y: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """(s in mm, met): path along rays from (x, y) of the plane z0 to the near cap of the sphere.

        c s² - 2 g s + c r² = 0, g = d_z - c (x d_x + y d_y), solved as s = c r² / (g + sqrt(g² - c² r²)).
        """
        c, (dx, dy, dz) = self.curvature, direction
        f = c * (x * x + y * y)
        g = dz - c * (x * dx + y * dy)
        k = g * g - c * f
        below = g + torch.sqrt(torch.where(k > 0, k, torch.ones_like(k)))
        ok = (k > 0) & (below > 1e-6)
        s = f / torch.where(ok, below, torch.ones_like(below))
        return s, ok & (c * s * dz < 1)

    def sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(z in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm."""
        h, z_x, z_y = self.relative_sag_and_slope(x, y)
        return self.z + h, z_x, z_y
