"""Analytic surfaces z(x, y): plane and sphere.  The docstring of a surface is its equation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from bstcad.optics.outlines import STRICT


@dataclass(frozen=True)
class Plane:
    """z = z0."""

    z: float  # z0 (mm)
    kind: Literal["plane"] = "plane"

    __pydantic_config__ = STRICT


@dataclass(frozen=True)
class Sphere:
    """z = z0 + c r² / (1 + sqrt(1 - c² r²)), r² = x² + y²; c may be zero (a plane)."""

    z: float  # vertex (mm)
    curvature: float | Tensor = 0.0  # c (1/mm); positive bends towards +z
    optimise: bool = False  # may tailoring change the curvature?
    kind: Literal["sphere"] = "sphere"

    __pydantic_config__ = STRICT
