"""Surfaces of revolution z(r): plane, sphere, conic.  The docstring of a surface is its equation.

Every surface, the B-spline too (bspline.py), answers the same questions (`Surface`), so that nobody asks which it is:
a plane is a surface of curvature zero, a sphere a conic of conic constant zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, Self

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.outlines import STRICT, Circle, Outline

EQUATOR = 1e-6  # cos² of the slope's angle (1 - (1 + k) c² r²) from which on a surface is too steep over (x, y)


class Surface(Protocol):
    """A height z over (x, y); lengths in mm."""

    z: float  # where it crosses the axis, or for a net the plane that its heights are measured from
    kind: str
    is_net: bool  # is it a B-spline net, with `heights`?
    level: bool  # is it z = const, so that light along the axis meets it head on?
    curvature: float | Tensor | None  # at the vertex (1/mm), positive towards +z; None: it is no surface of revolution
    conic_constant: float | Tensor | None
    detail: float  # length (mm) over which it is one smooth piece; inf: all of it is

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(height over the plane z, ∂z/∂x, ∂z/∂y) at (x, y)."""

    def sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(z, ∂z/∂x, ∂z/∂y) at (x, y)."""

    def reaches(self, x: Tensor, y: Tensor) -> Tensor:
        """True where there is a point of the surface over (x, y)."""

    def sags(self, outline: Outline) -> tuple[float, float]:
        """Heights over the plane z (mm) between which, and zero, it stays inside the outline."""

    def integral(self, outline: Outline) -> float:
        """∫∫ of the height over the plane z, dx dy over the outline (mm³)."""

    def parameters(self) -> dict[str, float | Tensor]:
        """What of its shape tailoring may change, by name; its place z is none of it."""

    def with_parameters(self, **values: float | Tensor) -> Self:
        """The same surface with other values of some of its parameters."""

    def moved(self, z: float) -> Self:
        """The same surface from another plane z."""

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> Self:
        """The same surface with its tensors in another precision or on another device."""

    def plain(self) -> Self:
        """The same surface in float64 on the CPU, without gradient; single numbers are Python's."""


def sag(surface: Surface, x: Any, y: Any) -> np.ndarray:
    """z (mm) of a surface at points (mm), numpy arrays of one shape or numbers, in float64."""
    x, y = (np.require(p, float, ["C", "W"]) for p in np.broadcast_arrays(x, y))
    z, _, _ = surface.plain().sag_and_slope(*(torch.from_numpy(p.ravel()) for p in (x, y)))
    return z.numpy().reshape(x.shape)


class _Revolved:
    """What plane, sphere and conic share: c = `curvature`, k = `conic_constant`."""

    is_net, detail = False, math.inf

    @property
    def level(self) -> bool:
        """Is it z = const, so that light along the axis meets it head on?"""
        return not isinstance(self.curvature, Tensor) and self.curvature == 0

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(z - z0 in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm; beyond the rim of the surface finite numbers without meaning.

        ∂z/∂x = c x / sqrt(1 - (1 + k) c² r²).
        """
        c = self.curvature
        r2 = x * x + y * y
        cos2 = self._cos2(r2)
        root = torch.sqrt(torch.where(cos2 > EQUATOR, cos2, torch.full_like(cos2, EQUATOR)))  # guarded before the root
        return c * r2 / (1 + root), c * x / root, c * y / root

    def reaches(self, x: Tensor, y: Tensor) -> Tensor:
        """True where there is a point of the surface over (x, y); a rim where it stands upright does not count."""
        return self._cos2(x * x + y * y) > EQUATOR

    def _cos2(self, r2: Tensor) -> Tensor:
        return 1 - self.curvature * self.curvature * (1 + self.conic_constant) * r2

    def crossing(self, x: Tensor, y: Tensor, direction: Tensor, sense: int = 1) -> tuple[Tensor, Tensor]:
        """(s in mm, met): path along rays from (x, y) of the plane z0 to the part of the surface around its vertex.

        a s² - 2 g s + c r² = 0, a = c (1 + k d_z²), g = d_z - c (x d_x + y d_y), solved as
        s = c r² / (g + sqrt(g² - a c r²)): of the two roots that where a ray comes from below, d_z > ∇z · (d_x, d_y).
        sense: -1 for light along -z, which comes from above; then it is the other root.
        """
        c, (dx, dy, dz) = self.curvature, direction
        f = c * (x * x + y * y)
        g = dz - c * (x * dx + y * dy)
        k = g * g - c * (1 + self.conic_constant * dz * dz) * f
        below = g + sense * torch.sqrt(torch.where(k > 0, k, torch.ones_like(k)))
        ok = (k > 0) & (sense * below > 1e-6)
        s = f / torch.where(ok, below, torch.ones_like(below))
        return s, ok & ((1 + self.conic_constant) * c * s * dz < 1)  # the other half, or the other sheet, is none of it

    def sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(z in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm."""
        h, z_x, z_y = self.relative_sag_and_slope(x, y)
        return self.z + h, z_x, z_y

    def sags(self, outline: Outline) -> tuple[float, float]:
        """Zero and the sag where the outline is farthest from the axis (mm), the lower one first."""
        x, y = (torch.tensor(p, dtype=torch.float64) for p in outline.farthest)
        rim = float(self.plain().relative_sag_and_slope(x, y)[0])
        return min(rim, 0.0), max(rim, 0.0)

    def integral(self, outline: Outline) -> float:
        """∫∫ (z - z0) dx dy over the outline (mm³).

        Over a disc of radius a, with the sag h at its rim, pi h (3 a² - (1 + k) h²) / 6; over a rectangle by 96 x 96
        Gauss points, exact to rounding up to a half diagonal of 0.95 R.
        """
        surface, (a, b) = self.plain(), outline.half_extent
        if isinstance(outline, Circle):
            h = sag(surface.moved(0.0), a, 0.0)
            return float(np.pi * h * (3 * a * a - (1 + surface.conic_constant) * h * h) / 6)
        point, weight = np.polynomial.legendre.leggauss(96)
        h = sag(surface.moved(0.0), a * point[:, None], b * point[None, :])
        return float(a * b * (weight[:, None] * h * weight).sum())

    def with_parameters(self, **values: float | Tensor) -> Self:
        """The same surface with other values of some of its parameters."""
        return replace(self, **values)

    def moved(self, z: float) -> Self:
        """The same surface with its vertex at z (mm)."""
        return replace(self, z=z)

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> Self:
        """The same surface with its tensors in another precision or on another device; numbers stay numbers."""
        there = {n: v.to(dtype=dtype, device=device) for n, v in self.parameters().items() if isinstance(v, Tensor)}
        return replace(self, **there) if there else self

    def plain(self) -> Self:
        """The same surface with Python's numbers."""
        return replace(self, z=float(self.z), **{name: float(value) for name, value in self.parameters().items()})


@dataclass(frozen=True)
class Plane(_Revolved):
    """z = z0."""

    z: float  # z0 (mm)
    kind: Literal["plane"] = "plane"

    __pydantic_config__ = STRICT

    curvature = conic_constant = 0.0

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(z - z0 in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm: all zero."""
        zero = torch.zeros_like(x)
        return zero, zero, zero

    def reaches(self, x: Tensor, y: Tensor) -> Tensor:
        """True where there is a point of the surface over (x, y): everywhere."""
        return torch.ones_like(x, dtype=torch.bool)

    def crossing(self, x: Tensor, y: Tensor, direction: Tensor, sense: int = 1) -> tuple[Tensor, Tensor]:
        """(s in mm, met): where rays through (x, y) of the plane z0 meet the surface, as path from there: at once."""
        return torch.zeros_like(x), torch.ones_like(x, dtype=torch.bool)

    def parameters(self) -> dict[str, float | Tensor]:
        """Nothing: a plane has no shape."""
        return {}


@dataclass(frozen=True)
class Sphere(_Revolved):
    """z = z0 + c r² / (1 + sqrt(1 - c² r²)), r² = x² + y²; c may be zero (a plane).

    This form (Wang et al. 2023, Eq. 16) keeps its digits where R - sqrt(R² - r²) loses all of them.
    """

    z: float  # vertex (mm)
    curvature: float | Tensor = 0.0  # c (1/mm); positive bends towards +z
    kind: Literal["sphere"] = "sphere"

    __pydantic_config__ = STRICT

    conic_constant = 0.0

    def parameters(self) -> dict[str, float | Tensor]:
        """The curvature (1/mm)."""
        return {"curvature": self.curvature}


@dataclass(frozen=True)
class Conic(_Revolved):
    """z = z0 + c r² / (1 + sqrt(1 - (1 + k) c² r²)), r² = x² + y²; on it c r² - 2 (z - z0) + (1 + k) c (z - z0)² = 0.

    k = 0: a sphere; -1 < k < 0: an ellipsoid, its long axis the lens's; k = -1: a paraboloid; k < -1: a hyperboloid;
    k > 0: an ellipsoid, its short axis the lens's.
    """

    z: float  # vertex (mm)
    curvature: float | Tensor = 0.0  # c at the vertex (1/mm); positive bends towards +z
    conic_constant: float | Tensor = 0.0  # k
    kind: Literal["conic"] = "conic"

    __pydantic_config__ = STRICT

    def parameters(self) -> dict[str, float | Tensor]:
        """The curvature (1/mm) and the conic constant."""
        return {"curvature": self.curvature, "conic_constant": self.conic_constant}
