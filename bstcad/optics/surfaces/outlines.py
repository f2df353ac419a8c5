"""Outlines: the closed curves in the x-y plane that bound a lens, a beam or a picture."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.numerics.reductions import elementary
from bstcad.optics.surfaces.key import Key

# Configuration of records that are read from a scene: an unknown key is an error, a tensor may replace a number that
# is tailored, and a record built in Python is validated as well.
STRICT = {"extra": "forbid", "arbitrary_types_allowed": True, "revalidate_instances": "always"}
# (a, b, r²) of an outline in mm, mm and mm²: the interior is max(|x| - a, 0)² + max(|y| - b, 0)² <= r².  All outlines
# are boxes with round corners; a circle (a = b = 0) and a rectangle (r = 0) are the limiting cases.
Limits = tuple[float, float, float]
SIZE_RANGE = (1e-3, 1e6)  # smallest and largest width, height or radius of an outline in a scene, mm
POINTS_AROUND = 361  # points once around an outline, one per degree; the last is the first
OUTLINE_POINTS = 720  # rim points on all arcs of an outline together, and about as many on all its straight sides


class _Box(ABC):
    """Base of the outlines: the methods that follow from `limits`."""

    is_round = False  # True for a circle

    @property
    @abstractmethod
    def limits(self) -> Limits:
        """Limits (a, b, r²) of the interior: max(|x| - a, 0)² + max(|y| - b, 0)² <= r² (a, b: mm; r²: mm²)."""

    @property
    def farthest(self) -> tuple[float, float]:
        """Point (x, y) (mm) of the rim, with x, y >= 0, that is farthest from the outline's centre."""
        a, b, r2 = self.limits
        r, d = math.sqrt(r2), math.hypot(a, b)
        return (a * (1 + r / d), b * (1 + r / d)) if d else (r, 0.0)

    def contains(self, x: Tensor, y: Tensor) -> Tensor:
        """Return True where (x, y) (mm) lies inside or on the rim."""
        return inside(self.limits, x, y)

    def depth(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the distance (mm) of points (x, y) (mm) from the rim, positive inside and negative outside."""
        a, b, r2 = self.limits
        x, y = np.abs(x) - a, np.abs(y) - b
        return math.sqrt(r2) - np.hypot(np.maximum(x, 0.0), np.maximum(y, 0.0)) - np.minimum(np.maximum(x, y), 0.0)

    def reach(self, n_x: float, n_y: float) -> float:
        """Return the largest n · p (mm) of all points p inside the outline, for a vector n = (n_x, n_y)."""
        a, b, r2 = self.limits
        return a * abs(n_x) + b * abs(n_y) + math.sqrt(r2) * math.hypot(n_x, n_y)

    def rim_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y (mm) of points along the rim, in no particular order."""
        a, b, r2 = self.limits
        turn, flat = np.arange(OUTLINE_POINTS) * 2 * np.pi / OUTLINE_POINTS, np.linspace(-1, 1, OUTLINE_POINTS // 4 + 1)
        r, x, y = math.sqrt(r2), np.cos(turn), np.sin(turn)
        sides = [(flat * a, 0 * flat + end * (b + r)) for end in (-1, 1) if a]
        sides += [(0 * flat + end * (a + r), flat * b) for end in (-1, 1) if b]
        sides.append((np.sign(x) * a + r * x, np.sign(y) * b + r * y))
        x, y = (np.concatenate(each) for each in zip(*sides, strict=True))
        return x, y

    def around(self, count: int = POINTS_AROUND) -> np.ndarray:
        """Return points (count, 2) (mm) around the rim from its end at +x, counterclockwise; the last is the first.

        They lie at equal angles of a circle, or of the arcs of round corners; sharp corners are points themselves.
        """
        (a, b, r2), turn = self.limits, np.linspace(0, 2 * np.pi, count)
        cos, sin, r = np.cos(turn), np.sin(turn), math.sqrt(r2)
        return np.stack([np.sign(cos) * a + r * cos, np.sign(sin + 1e-12) * b + r * sin], axis=1)

    def inset_direction(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the shift (x, y) of rim points per mm of inset: inward normal; on a rectangle 2a x 2b (-x/a, -y/b)."""
        a, b, r2 = self.limits
        if r2 == 0:
            return -x / a, -y / b
        p, q = (np.sign(at) * np.maximum(np.abs(at) - half, 0.0) for at, half in ((x, a), (y, b)))
        return -p / math.sqrt(r2), -q / math.sqrt(r2)


@dataclass(frozen=True)
class Rectangle(_Box):
    """Rectangle |x| <= width / 2 and |y| <= height / 2, with x and y from its centre."""

    width: Annotated[float, Key("Extent along x.", "mm", *SIZE_RANGE, example=12.0)]
    height: Annotated[float, Key("Extent along y.", "mm", *SIZE_RANGE, example=12.0)]
    shape: Annotated[Literal["rectangle"], Key("A rectangle with sides along x and y.")] = "rectangle"

    __pydantic_config__ = STRICT

    @property
    def half_extent(self) -> tuple[float, float]:
        """Half the width and half the height of the bounding box (mm)."""
        return self.width / 2, self.height / 2

    @property
    def limits(self) -> Limits:
        """Limits (a, b, r²), see `Limits`: half the sides (mm) and r = 0."""
        return self.width / 2, self.height / 2, 0.0

    @property
    def area(self) -> float:
        """Area, mm²."""
        return self.width * self.height

    @property
    def words(self) -> str:
        """Size in words: "24 x 10 mm"."""
        return f"{self.width:.6g} x {self.height:.6g} mm"

    def map_square(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """Map points (a, b) of the square |a|, |b| <= 1 to points (x, y) (mm) of the outline, rim to rim."""
        return a * (self.width / 2), b * (self.height / 2)

    def scaled(self, by: float) -> Rectangle:
        """Return the outline scaled by a factor."""
        return Rectangle(by * self.width, by * self.height)

    def inset(self, by: float) -> Rectangle:
        """Return the outline reduced by a margin of this width (mm)."""
        return Rectangle(self.width - 2 * by, self.height - 2 * by)


@dataclass(frozen=True)
class Rounded(Rectangle):
    """A rectangle with rounded corners, whose radius is at most half the shorter side."""

    corner_radius: float = 0.0  # radius of the corners, mm

    @property
    def limits(self) -> Limits:
        """Limits (a, b, r²), see `Limits`: half the straight sides (mm), and the square of the corner radius (mm²)."""
        r = self.corner_radius
        return self.width / 2 - r, self.height / 2 - r, r * r

    @property
    def area(self) -> float:
        """Area, mm²."""
        return self.width * self.height - (4 - math.pi) * self.corner_radius**2

    @property
    def words(self) -> str:
        """Size in words: "24 x 10 mm with corners of 3 mm"."""
        return f"{super().words} with corners of {self.corner_radius:.4g} mm"

    def map_square(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """Map points (a, b) of the square |a|, |b| <= 1 to (x, y) (mm), and smaller squares onto scaled outlines."""
        ring = torch.maximum(a.abs(), b.abs()).clamp(min=1e-300)
        x, y = a.abs() / ring * (self.width / 2), b.abs() / ring * (self.height / 2)  # on the rectangle's rim
        c, d, r2 = self.limits
        along, square = x * c + y * d, x * x + y * y
        # farther solution t (x, y) of |t (x, y) - (c, d)| = r, with (c, d) the centre of the corner's circle
        t = (along + torch.sqrt((along * along - square * (c * c + d * d - r2)).clamp(min=0))) / square
        t = torch.where((x > c) & (y > d) & (t * x > c) & (t * y > d), t, torch.ones_like(t))
        return a * (self.width / 2) * t, b * (self.height / 2) * t

    def scaled(self, by: float) -> Rounded:
        """Return the outline scaled by a factor."""
        return Rounded(by * self.width, by * self.height, corner_radius=by * self.corner_radius)

    def inset(self, by: float) -> Rounded:
        """Return the outline reduced by a margin of this width (mm)."""
        return Rounded(self.width - 2 * by, self.height - 2 * by, corner_radius=max(self.corner_radius - by, 0.0))


@dataclass(frozen=True)
class Circle(_Box):
    """Circle x² + y² <= radius², with x and y from its centre."""

    radius: Annotated[float, Key("Radius; or give the diameter.", "mm", *SIZE_RANGE, example=12.0)]
    shape: Annotated[Literal["circle"], Key("A circle.")] = "circle"

    __pydantic_config__ = STRICT

    is_round = True

    @property
    def half_extent(self) -> tuple[float, float]:
        """Half the width and half the height of the bounding box (mm)."""
        return self.radius, self.radius

    @property
    def limits(self) -> Limits:
        """Limits (a, b, r²), see `Limits`: a = b = 0, and the square of the radius (mm²)."""
        return 0.0, 0.0, self.radius**2

    @property
    def area(self) -> float:
        """Area, mm²."""
        return math.pi * self.radius**2

    @property
    def words(self) -> str:
        """Size in words: "Ø24 mm"."""
        return f"Ø{2 * self.radius:.6g} mm"

    def map_square(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """Map points (a, b) of the square |a|, |b| <= 1 to (x, y) (mm), equal-area (Shirley and Chiu 1997)."""
        steep = b.abs() > a.abs()
        long, short = torch.where(steep, b, a), torch.where(steep, a, b)
        turn = (math.pi / 4) * short / torch.where(long == 0, torch.ones_like(long), long)
        along, across = (self.radius * long * elementary(f, turn) for f in (torch.cos, torch.sin))
        return torch.where(steep, across, along), torch.where(steep, along, across)

    def scaled(self, by: float) -> Circle:
        """Return the outline scaled by a factor."""
        return Circle(by * self.radius)

    def inset(self, by: float) -> Circle:
        """Return the outline reduced by a margin of this width (mm)."""
        return Circle(self.radius - by)


Outline = Rectangle | Circle
EVERYWHERE = Circle(math.inf)  # unlimited aperture, which no ray misses


def inside(limits: Limits, x: Tensor, y: Tensor, margin: float = 0.0) -> Tensor:
    """Return True where (x, y) (mm) lies inside the outline of these limits or at most `margin` mm outside it."""
    a, b, r2 = limits
    with torch.no_grad():  # in place, since every ray is tested
        x, y = x.abs().sub_(a).clamp_(min=0), y.abs().sub_(b).clamp_(min=0)
        square = x.mul_(x) + y.mul_(y)
    return square.sqrt() <= math.sqrt(r2) + margin if margin else square <= r2
