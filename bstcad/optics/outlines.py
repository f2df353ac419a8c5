"""Outlines: the closed curves in the x-y plane that bound a lens, a beam or a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

# Read by the scene: an unknown key in a file is an error, and a tensor may stand where a number is tailored.
STRICT = {"extra": "forbid", "arbitrary_types_allowed": True}


@dataclass(frozen=True)
class Rectangle:
    """|x| <= width / 2 and |y| <= height / 2, centred on the axis."""

    width: float  # extent in x (mm)
    height: float  # extent in y (mm)
    shape: Literal["rectangle"] = "rectangle"

    __pydantic_config__ = STRICT

    @property
    def half_extent(self) -> tuple[float, float]:
        """Half the bounding box in x and in y (mm)."""
        return self.width / 2, self.height / 2

    @property
    def farthest(self) -> tuple[float, float]:
        """A point (x, y) of the rim that is farthest from the axis (mm): a corner."""
        return self.half_extent

    @property
    def limits(self) -> tuple[float, float, float]:
        """The largest |x|, |y| (mm) and x² + y² (mm²) inside."""
        return self.width / 2, self.height / 2, float("inf")

    @property
    def area(self) -> float:
        """Area (mm²)."""
        return self.width * self.height

    def contains(self, x: Tensor, y: Tensor) -> Tensor:
        """True where (x, y) (mm) lies inside or on the rim."""
        return (x.abs() <= self.width / 2) & (y.abs() <= self.height / 2)


@dataclass(frozen=True)
class Circle:
    """x² + y² <= radius², centred on the axis."""

    radius: float  # mm
    shape: Literal["circle"] = "circle"

    __pydantic_config__ = STRICT

    @property
    def half_extent(self) -> tuple[float, float]:
        """Half the bounding box in x and in y (mm)."""
        return self.radius, self.radius

    @property
    def farthest(self) -> tuple[float, float]:
        """A point (x, y) of the rim that is farthest from the axis (mm)."""
        return self.radius, 0.0

    @property
    def limits(self) -> tuple[float, float, float]:
        """The largest |x|, |y| (mm) and x² + y² (mm²) inside."""
        return self.radius, self.radius, self.radius**2

    @property
    def area(self) -> float:
        """Area (mm²)."""
        return torch.pi * self.radius**2

    def contains(self, x: Tensor, y: Tensor) -> Tensor:
        """True where (x, y) (mm) lies inside or on the rim."""
        return x * x + y * y <= self.radius**2


Outline = Rectangle | Circle
EVERYWHERE = Rectangle(math.inf, math.inf)  # an outline that loses no ray
