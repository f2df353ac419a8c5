"""Profiles: irradiances of named shapes, as for beam shaping, averaged over each pixel.

A profile is centred on its target; r is the distance from the centre (mm), E the irradiance on any scale.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Annotated, Literal, TypeAlias

import numpy as np
from pydantic import Field
from scipy.special import erf

from bstcad.optics.surfaces.key import Key
from bstcad.scene.schema import LENGTHS, Record, leaving_out

# Gauss-Legendre nodes per cell of a super-Gaussian of radius w and order n: in cells up to w / n wide; below w / (4 n).
NODES, FEWER_NODES = 8, 4
MAX_VALUES = 1 << 20  # number of values of E that are computed at a time
DARK = 1e-20  # E, as a fraction of E at the centre, below which a pixel has no light

Pixels: TypeAlias = tuple[int, int]  # (columns, rows)
Size: TypeAlias = tuple[float, float]  # (width, height), mm


class _Profile(Record):
    """A profile: its irradiance and its extent."""

    @property
    @abstractmethod
    def half_extent(self) -> tuple[float, float]:
        """Half the width and height (mm) of the stated size, which must fit in the target."""

    @abstractmethod
    def light(self, pixels: Pixels, size: Size) -> np.ndarray:
        """Return the means of E over the pixels, (rows, columns), of a target of this size (width, height)."""


class DiscProfile(_Profile):
    """A uniform disc: E = 1 for r < R, else 0."""

    shape: Annotated[Literal["disc"], Key("A uniform disc.")] = "disc"
    radius: Annotated[float, Key("Radius of the disc.", "mm", *LENGTHS, example=6.0)]

    @property
    def half_extent(self) -> tuple[float, float]:
        """(R, R): the radius of the disc (mm)."""
        return self.radius, self.radius

    def light(self, pixels: Pixels, size: Size) -> np.ndarray:
        """Return the exact fraction of each pixel inside the circle, from second differences of `corner_area`."""
        x, y = edges(pixels, size)
        within = corner_area(x[None, :], y[:, None], self.radius)
        fraction = np.abs(np.diff(np.diff(within, axis=0), axis=1)) / cell(pixels, size)
        nearest, farthest = (np.hypot(*np.meshgrid(*ends)) for ends in zip(*map(_distances, (x, y)), strict=True))
        whole = [nearest >= self.radius, farthest <= self.radius]  # exactly 0 or 1
        return np.select(whole, [0.0, 1.0], fraction)


class RectangleProfile(_Profile):
    """A uniform rectangle, whose edge may be soft: E = s(x, width) s(y, height).

    s(x, a) is 1 for |x| < (a - e) / 2, 0 for |x| > (a + e) / 2, and linear in between, with e the width of the edge.
    """

    shape: Annotated[Literal["rectangle"], Key("A uniform rectangle.")] = "rectangle"
    width: Annotated[float, Key("Width along x.", "mm", *LENGTHS, example=8.0)]
    height: Annotated[float, Key("Height along y.", "mm", *LENGTHS, example=6.0)]
    edge: Annotated[
        float, Key("Width of the edge, over which E falls to zero; half of it lies outside.", "mm", 0.0, LENGTHS[1])
    ] = 0.0

    written = leaving_out(edge=0.0)

    @property
    def half_extent(self) -> tuple[float, float]:
        """Half the width and height (mm), with the outer half of the edge."""
        return (self.width + self.edge) / 2, (self.height + self.edge) / 2

    def light(self, pixels: Pixels, size: Size) -> np.ndarray:
        """Return the exact means of E over the pixels."""
        ends = zip(edges(pixels, size), (self.width / 2, self.height / 2), strict=True)
        along_x, along_y = (np.abs(np.diff(_below(at, half, self.edge))) for at, half in ends)
        return np.outer(along_y, along_x) / cell(pixels, size)


def _below(at: np.ndarray, half: float, edge: float) -> np.ndarray:
    """Return ∫_0^x s(t, 2 half) dt (mm) for the x in `at`: the mean of clip(t, -half, half) over x ± edge / 2."""

    def primitive(t: np.ndarray) -> np.ndarray:
        within = np.clip(np.abs(t), 0.0, half)
        return within * (np.abs(t) - within / 2)

    if edge == 0.0:
        return np.clip(at, -half, half)
    return (primitive(at + edge / 2) - primitive(at - edge / 2)) / edge


class GaussianProfile(_Profile):
    """A Gaussian: E = exp(-2 (r / w)²), with w the radius at which E is 1/e² of its value at the centre."""

    shape: Annotated[Literal["gaussian"], Key("The profile of a Gaussian beam.")] = "gaussian"
    radius_1e2: Annotated[float, Key("Radius at 1/e² of the irradiance at the centre.", "mm", *LENGTHS, example=6.0)]

    @property
    def half_extent(self) -> tuple[float, float]:
        """Radius (w, w), mm, at 1/e² of the irradiance at the centre."""
        return self.radius_1e2, self.radius_1e2

    def light(self, pixels: Pixels, size: Size) -> np.ndarray:
        """Return the exact means, by ∫ exp(-2 x² / w²) dx = w sqrt(pi / 8) erf(sqrt(2) x / w) along x and along y."""
        w, scale = self.radius_1e2, self.radius_1e2 * math.sqrt(math.pi / 8)
        along_x, along_y = (scale * np.abs(np.diff(erf(math.sqrt(2) * at / w))) for at in edges(pixels, size))
        return np.outer(along_y, along_x) / cell(pixels, size)


class SuperGaussianProfile(_Profile):
    """A super-Gaussian: E = exp(-2 (r / w)^n), a Gaussian for n = 2, flatter with a steeper edge for larger n.

    The definition is that of Shealy and Hoffnagle, Appl. Opt. 45, 5118 (2006).
    """

    shape: Annotated[Literal["super_gaussian"], Key("A nearly uniform disc with a soft edge.")] = "super_gaussian"
    radius_1e2: Annotated[float, Key("Radius at 1/e² of the irradiance at the centre.", "mm", *LENGTHS, example=6.0)]
    order: Annotated[float, Key("Order: 2 is a Gaussian, 10 is nearly uniform.", "", 2.0, 100.0, example=10.0)]

    @property
    def half_extent(self) -> tuple[float, float]:
        """Radius (w, w), mm, at 1/e² of the irradiance at the centre."""
        return self.radius_1e2, self.radius_1e2

    def light(self, pixels: Pixels, size: Size) -> np.ndarray:
        """Return the means by Gauss-Legendre quadrature in cells no wider than w / n; their error is about 1e-11."""
        w, n = self.radius_1e2, self.order
        reach = w * (-math.log(DARK) / 2) ** (1 / n)
        found = np.zeros(pixels[::-1])
        (x, columns), (y, rows) = (_lit_pixels(at, reach) for at in edges(pixels, size))
        (x, of_x), (y, of_y) = _nodes(x, w / n), _nodes(y, w / n)
        high = max(MAX_VALUES // (x.size * of_y.size), 1)  # rows at a time
        for row in range(0, len(y), high):
            strip = y[row : row + high]
            r = np.hypot(x.ravel(), strip.reshape(-1, 1))
            with np.errstate(over="ignore"):  # far outside the profile, where E is 0
                light = np.exp(-2 * (r / w) ** n).reshape(*strip.shape, *x.shape)
            first = rows.start + row
            found[first : first + len(strip), columns] = np.einsum("iajb,a,b->ij", light, of_y, of_x, optimize=True)
        return found


Profile = Annotated[
    DiscProfile | RectangleProfile | GaussianProfile | SuperGaussianProfile, Field(discriminator="shape")
]


# ---- pixels ----------------------------------------------------------------------------------------------------------


def edges(pixels: Pixels, size: Size) -> tuple[np.ndarray, np.ndarray]:
    """Return x of the edges of the columns, ascending, and y of the edges of the rows, descending (mm; 0: centre)."""
    columns, rows = (np.arange(-n, n + 1, 2) / (2 * n) for n in pixels)  # symmetric to the last bit
    return columns * size[0], -rows * size[1]


def cell(pixels: Pixels, size: Size) -> float:
    """Return the area of a pixel (mm²)."""
    return size[0] * size[1] / (pixels[0] * pixels[1])


def corner_area(x: np.ndarray, y: np.ndarray, radius: float) -> np.ndarray:
    """Return the area (mm²) of the disc r < R inside the rectangle from (0, 0) to (x, y), with the sign of x y.

    For x, y >= 0 it is ∫_0^x min(y, sqrt(R² - t²)) dt: x y for x <= c = sqrt(R² - y²), and c y + G(x) - G(c) for
    x > c, with G(t) = (t sqrt(R² - t²) + R² asin(t / R)) / 2.
    """
    across, up = np.minimum(np.abs(x), radius), np.minimum(np.abs(y), radius)
    c = np.sqrt(np.maximum(radius**2 - up**2, 0.0))

    def under(t: np.ndarray) -> np.ndarray:
        height = np.sqrt(np.maximum(radius**2 - t**2, 0.0))
        return (t * height + radius**2 * np.arcsin(np.minimum(t / radius, 1.0))) / 2

    area = np.where(across <= c, across * up, c * up + under(across) - under(np.minimum(c, across)))
    return np.sign(x) * np.sign(y) * area


def _distances(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances (mm) of each pixel's nearest and farthest point from 0, along one axis with edges `at`."""
    ends = np.abs(at[1:]), np.abs(at[:-1])
    across = at[1:] * at[:-1] < 0  # True for a pixel that contains 0
    return np.where(across, 0.0, np.minimum(*ends)), np.maximum(*ends)


def _lit_pixels(at: np.ndarray, reach: float) -> tuple[np.ndarray, slice]:
    """Return the edges, among `at` (mm), of pixels within `reach` (mm) of 0, and the slice of these pixels."""
    low, high = np.minimum(at[1:], at[:-1]), np.maximum(at[1:], at[:-1])
    lit = np.flatnonzero((low < reach) & (high > -reach))
    first, last = int(lit[0]), int(lit[-1]) + 1
    return at[first : last + 1], slice(first, last)


def _nodes(at: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (pixels, n) and weights (n,) for means over pixels with edges `at`; width: of the widest cell."""
    pitch = abs(float(at[1] - at[0]))
    node, weight = np.polynomial.legendre.leggauss(FEWER_NODES if 4 * pitch < width else NODES)
    cells = max(math.ceil(pitch / width), 1)
    fraction = ((np.arange(cells)[:, None] + (node + 1) / 2) / cells).ravel()  # position in a pixel, from 0 to 1
    return at[:-1, None] + np.diff(at)[:, None] * fraction, np.tile(weight / 2 / cells, cells)
