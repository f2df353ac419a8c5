"""Profiles: irradiance of a shape with a name, as those who shape beams ask for it, averaged over each pixel.

A profile is centred on the middle of its target; r is the distance from there (mm), E the irradiance on any scale.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.special import erf

from bstcad.optics.key import Key
from bstcad.scene.schema import LENGTHS, Record

# Of Gauss-Legendre along a cell of the quadrature, in which E changes by a factor of e or its 4th root at most, about.
NODES, FEWER = 8, 4
SAMPLES = 1 << 20  # of E in work at a time
DARK = 1e-20  # of E in the middle; beyond it a pixel has no light

Pixels, Size = tuple[int, int], tuple[float, float]  # (columns, rows), (width, height) in mm


class _Profile(Record):
    """A profile: its light, and how far it reaches."""

    @property
    @abstractmethod
    def half_extent(self) -> tuple[float, float]:
        """Half the width and height (mm) of its stated size, which a target has to hold."""

    @abstractmethod
    def light(self, pixels: Pixels, size: Size) -> np.ndarray:
        """(rows, columns) means of E over the pixels of a target of a size."""


class DiscProfile(_Profile):
    """E = 1 for r < R, else 0."""

    shape: Annotated[Literal["disc"], Key("An even disc.")] = "disc"
    radius: Annotated[float, Key("Radius of the disc.", "mm", *LENGTHS, example=6.0)]

    @property
    def half_extent(self) -> tuple[float, float]:
        """(R, R)."""
        return self.radius, self.radius

    def light(self, pixels: Pixels, size: Size) -> np.ndarray:
        """The share of each pixel inside the circle, exact: second differences of `corner_area`."""
        x, y = edges(pixels, size)
        within = corner_area(x[None, :], y[:, None], self.radius)
        share = np.abs(np.diff(np.diff(within, axis=0), axis=1)) / cell(pixels, size)
        nearest, farthest = (np.hypot(*np.meshgrid(*ends)) for ends in zip(*map(_distances, (x, y)), strict=True))
        whole = [nearest >= self.radius, farthest <= self.radius]  # to the last bit
        return np.select(whole, [0.0, 1.0], share)


class RectangleProfile(_Profile):
    """E = 1 for |x| < width / 2 and |y| < height / 2, else 0."""

    shape: Annotated[Literal["rectangle"], Key("An even rectangle.")] = "rectangle"
    width: Annotated[float, Key("Width along x.", "mm", *LENGTHS, example=8.0)]
    height: Annotated[float, Key("Height along y.", "mm", *LENGTHS, example=6.0)]

    @property
    def half_extent(self) -> tuple[float, float]:
        """Half of width and height."""
        return self.width / 2, self.height / 2

    def light(self, pixels: Pixels, size: Size) -> np.ndarray:
        """The share of each pixel inside the rectangle, exact."""
        ends = zip(edges(pixels, size), self.half_extent, strict=True)
        along_x, along_y = (np.abs(np.diff(np.clip(at, -half, half))) for at, half in ends)
        return np.outer(along_y, along_x) / cell(pixels, size)


class GaussianProfile(_Profile):
    """E = exp(-2 (r / w)²), w the radius at which E is 1/e² of that in the middle."""

    shape: Annotated[Literal["gaussian"], Key("A Gaussian beam's.")] = "gaussian"
    radius_1e2: Annotated[float, Key("Radius at 1/e² of the irradiance in the middle.", "mm", *LENGTHS, example=6.0)]

    @property
    def half_extent(self) -> tuple[float, float]:
        """(w, w)."""
        return self.radius_1e2, self.radius_1e2

    def light(self, pixels: Pixels, size: Size) -> np.ndarray:
        """Exact: ∫ exp(-2 x² / w²) dx = w sqrt(pi / 8) erf(sqrt(2) x / w), along x and along y."""
        w = self.radius_1e2
        along_x, along_y = (
            w * math.sqrt(math.pi / 8) * np.abs(np.diff(erf(math.sqrt(2) * at / w))) for at in edges(pixels, size)
        )
        return np.outer(along_y, along_x) / cell(pixels, size)


class SuperGaussianProfile(_Profile):
    """E = exp(-2 (r / w)^n): of order n = 2 a Gaussian, and the flatter and steeper the higher the order.

    As beam shapers state it: Shealy and Hoffnagle, Appl. Opt. 45, 5118 (2006).
    """

    shape: Annotated[Literal["super_gaussian"], Key("Even, with a soft edge.")] = "super_gaussian"
    radius_1e2: Annotated[float, Key("Radius at 1/e² of the irradiance in the middle.", "mm", *LENGTHS, example=6.0)]
    order: Annotated[float, Key("Order: 2 is a Gaussian, 10 nearly even.", "", 2.0, 100.0, example=10.0)]

    @property
    def half_extent(self) -> tuple[float, float]:
        """(w, w)."""
        return self.radius_1e2, self.radius_1e2

    def light(self, pixels: Pixels, size: Size) -> np.ndarray:
        """By Gauss-Legendre quadrature in cells no wider than w / n, to about 1e-11 of the middle's E."""
        w, n = self.radius_1e2, self.order
        reach = w * (-math.log(DARK) / 2) ** (1 / n)
        found = np.zeros(pixels[::-1])
        (x, columns), (y, rows) = (_lit(at, reach) for at in edges(pixels, size))
        (x, of_x), (y, of_y) = _nodes(x, w / n), _nodes(y, w / n)
        high = max(SAMPLES // (x.size * of_y.size), 1)  # rows at a time
        for row in range(0, len(y), high):
            strip = y[row : row + high]
            r = np.hypot(x.ravel(), strip.reshape(-1, 1))
            with np.errstate(over="ignore"):  # far outside, where E is 0
                light = np.exp(-2 * (r / w) ** n).reshape(*strip.shape, *x.shape)
            first = rows.start + row
            found[first : first + len(strip), columns] = np.einsum("iajb,a,b->ij", light, of_y, of_x, optimize=True)
        return found


Profile = Annotated[
    DiscProfile | RectangleProfile | GaussianProfile | SuperGaussianProfile, Field(discriminator="shape")
]


# ---- pixels ----------------------------------------------------------------------------------------------------------


def edges(pixels: Pixels, size: Size) -> tuple[np.ndarray, np.ndarray]:
    """x of the columns' edges, ascending, and y of the rows', descending as rows run down (mm from the middle)."""
    columns, rows = (np.arange(-n, n + 1, 2) / (2 * n) for n in pixels)  # symmetric to the last bit
    return columns * size[0], -rows * size[1]


def cell(pixels: Pixels, size: Size) -> float:
    """Area of a pixel (mm²)."""
    return size[0] * size[1] / (pixels[0] * pixels[1])


def corner_area(x: np.ndarray, y: np.ndarray, radius: float) -> np.ndarray:
    """Area (mm²) of the disc r < R between (0, 0) and (x, y), with the sign of x y.

    ∫_0^x min(y, sqrt(R² - t²)) dt for x, y >= 0: x y up to the abscissa c = sqrt(R² - y²) of the circle at that height,
    from there G(x) - G(c), G(t) = (t sqrt(R² - t²) + R² asin(t / R)) / 2.
    """
    across, up = np.minimum(np.abs(x), radius), np.minimum(np.abs(y), radius)
    c = np.sqrt(np.maximum(radius**2 - up**2, 0.0))

    def under(t: np.ndarray) -> np.ndarray:
        height = np.sqrt(np.maximum(radius**2 - t**2, 0.0))
        return (t * height + radius**2 * np.arcsin(np.minimum(t / radius, 1.0))) / 2

    area = np.where(across <= c, across * up, c * up + under(across) - under(np.minimum(c, across)))
    return np.sign(x) * np.sign(y) * area


def _distances(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (mm) of each pixel's nearest and farthest place from the middle, along one axis."""
    ends = np.abs(at[1:]), np.abs(at[:-1])
    across = at[1:] * at[:-1] < 0  # the axis runs through it
    return np.where(across, 0.0, np.minimum(*ends)), np.maximum(*ends)


def _lit(at: np.ndarray, reach: float) -> tuple[np.ndarray, slice]:
    """The edges of the pixels that a profile reaches, and which pixels these are."""
    low, high = np.minimum(at[1:], at[:-1]), np.maximum(at[1:], at[:-1])
    lit = np.flatnonzero((low < reach) & (high > -reach))
    first, last = int(lit[0]), int(lit[-1]) + 1
    return at[first : last + 1], slice(first, last)


def _nodes(at: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Places (pixels, nodes) and weights (nodes,) of a quadrature of the mean over each pixel between edges `at`."""
    pitch = abs(float(at[1] - at[0]))
    node, weight = np.polynomial.legendre.leggauss(FEWER if 4 * pitch < width else NODES)
    cells = max(math.ceil(pitch / width), 1)
    share = ((np.arange(cells)[:, None] + (node + 1) / 2) / cells).ravel()  # of a pixel
    return at[:-1, None] + np.diff(at)[:, None] * share, np.tile(weight / 2 / cells, cells)
