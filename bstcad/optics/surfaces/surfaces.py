"""Plane, sphere, conic and toroid.  The docstring of a surface is its equation.

Every surface, including the B-spline (bspline.py), implements `Surface`, so that tracing does not depend on its class.
A plane is a surface of curvature zero, and a sphere is a conic of conic constant zero.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import Field, dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.surfaces.charts import HEIGHTS, Chart
from bstcad.optics.surfaces.outlines import POINTS_AROUND, STRICT, Circle, Outline
from bstcad.optics.surfaces.rays import Rays

MIN_COS2 = 1e-6  # 1 - (1 + k) c² r² (for a sphere cos² of the slope angle) up to which a surface is too steep
MIN_ARRIVAL_COSINE = 1e-3  # smallest cosine with the axis by which a height is divided


Vectors = tuple[Tensor, Tensor, Tensor]  # components x, y and z of vectors


class Patch(NamedTuple):
    """Positions and tangents of a surface S at points (x, y) of its chart."""

    position: Tensor  # S - (0, 0, z), (3, …), mm
    along_x: Tensor  # ∂S/∂x, (3, …)
    along_y: Tensor  # ∂S/∂y, (3, …)

    @property
    def normal(self) -> Tensor:
        """∂S/∂x × ∂S/∂y, along +z or outward, not of unit length."""
        return cross(self.along_x, self.along_y)


def cross(p: Tensor, q: Tensor) -> Tensor:
    """Return the cross product of vectors (3, …)."""
    return torch.stack([p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]])


class Surface(ABC):
    """Surface given by its height z over (x, y); lengths in mm.  A subclass is a frozen dataclass.

    A surface with another `chart` is a function of the chart's coordinates, and so are the outlines of its face.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]
    z: float  # z of the vertex (mm); for a net, z of the plane from which its heights are measured
    kind: str  # kind of surface as scenes name it, such as "sphere"
    is_net = False  # True for a B-spline net, which has `heights`
    curvature: float | Tensor  # curvature at the vertex of a surface of revolution (1/mm), > 0: concave towards +z
    conic_constant: float | Tensor  # conic constant of a surface of revolution
    outline: Circle | None = None  # outline of an optical part that a plane surrounds; None: all is optical

    @property
    def level(self) -> bool:
        """True for a plane z = const, which light along the axis meets at normal incidence."""
        return False

    @property
    def detail(self) -> float:
        """Width of the smooth pieces of the surface (mm); infinite if it is smooth everywhere."""
        return math.inf

    @property
    def standoff(self) -> float:
        """Distance (mm) before the surface at which a ray to a point (x, y) of it starts: 0, for the point is exact."""
        return 0.0

    @property
    def optical(self) -> Surface:
        """Optical part of the surface."""
        return self

    @property
    def around(self) -> Surface:
        """Surface at the rim of the lens: the plane around the optical part, or the surface if all of it is optical."""
        return self

    @property
    def chart(self) -> Chart:
        """Coordinates in which the surface is a function."""
        return HEIGHTS

    @abstractmethod
    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (height over the plane z in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm."""

    def sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (z in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm."""
        h, z_x, z_y = self.relative_sag_and_slope(x, y)
        return self.z + h, z_x, z_y

    def at(self, x: Tensor, y: Tensor) -> Patch:
        """Return positions and tangents at (x, y) (mm) of the chart: (x, y, h), (1, 0, ∂z/∂x) and (0, 1, ∂z/∂y)."""
        h, z_x, z_y = self.relative_sag_and_slope(x, y)
        one, zero = torch.ones_like(h), torch.zeros_like(h)
        return Patch(torch.stack([x, y, h]), torch.stack([one, zero, z_x]), torch.stack([zero, one, z_y]))

    def position_and_normal(self, x: Tensor, y: Tensor) -> tuple[Vectors, Vectors]:
        """Return the components of S - (0, 0, z) (mm) and of ∂S/∂x × ∂S/∂y at (x, y) (mm) of the chart; see `at`."""
        h, z_x, z_y = self.relative_sag_and_slope(x, y)
        return (x, y, h), (-z_x, -z_y, torch.ones_like(h))

    def rim(self, outline: Outline) -> np.ndarray:
        """Return points (n, 3) (mm) of the surface along an outline of its chart, in no particular order."""
        return points_on(self, *outline.rim_points())

    def opening(self, outline: Outline) -> Outline:
        """Return the smallest outline, seen along the axis (mm), around the surface's rim over an outline."""
        return outline

    def plan(self, outline: Outline) -> Outline:
        """Return the smallest outline, seen along the axis (mm), around the surface inside an outline of its chart."""
        return outline

    def silhouette(self, outline: Outline, count: int = POINTS_AROUND) -> np.ndarray:
        """Return points (count, 2) (mm) around the surface inside an outline of its chart, seen along the axis.

        The last point is the first.
        """
        return outline.around(count)

    def section(self, outline: Outline, upright: bool, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return u and z (mm) of `count` points of the surface in a plane through the axis, from rim to rim.

        upright: the plane x = 0 with u = y, else the plane y = 0 with u = x.  outline: outline in the chart.
        """
        half = outline.half_extent[upright]
        u = np.linspace(-half, half, count)
        return u, sag(self, 0.0 * u, u) if upright else sag(self, u, 0.0 * u)

    def in_chart(self, chart: Chart) -> Self:
        """Return the same surface in another chart of its kind; ValueError if its chart is of another kind."""
        if type(self.chart) is not type(chart):
            raise ValueError("the back is not of the designed kind; generate the design again")
        return self

    def reaches(self, x: Tensor, y: Tensor) -> Tensor:
        """Return True where the surface has a point over (x, y)."""
        return torch.ones_like(x, dtype=torch.bool)

    def crossing(self, x: Tensor, y: Tensor, direction: Tensor, sense: int = 1) -> tuple[Tensor, Tensor]:
        """Return (path in mm along rays from (x, y) on the plane z, True if they meet the surface); sense: see Rays."""
        raise self.unknown

    def arrive(self, rays: Rays, height: Tensor) -> Rays:
        """Return rays moved along their lines to heights (mm) over the plane z."""
        s = rays.sense * (height - rays.above(self.z)) / (rays.sense * rays.direction[2]).clamp(min=MIN_ARRIVAL_COSINE)
        return replace(rays, position=rays.position + s * rays.direction)

    @abstractmethod
    def sags(self, outline: Outline) -> tuple[float, float]:
        """Return the lowest and the highest height (mm) over the plane z inside the outline, zero included."""

    def parameters(self) -> dict[str, float | Tensor]:
        """Return the shape parameters that tailoring may change, by name, without the position z."""
        return {}

    def with_parameters(self, **values: float | Tensor) -> Self:
        """Return the surface with other values of some of its parameters, or of z (mm)."""
        return replace(self, **values)

    def moved(self, z: float) -> Self:
        """Return the surface moved along the axis to a position z (mm)."""
        return self.with_parameters(z=z)

    def scaled(self, factor: float, about: float) -> Surface:
        """Return the surface scaled by a factor about the point of the axis at z = `about` (mm)."""
        raise self.unknown

    def bent(self, curvature: float) -> Surface:
        """Return the surface with `curvature` (1/mm) added at its vertex."""
        raise self.unknown

    def conic(self) -> tuple[float, float]:
        """Return curvature (1/mm) and conic constant of a surface of revolution, without gradient."""
        raise self.unknown

    @property
    def unknown(self) -> ValueError:
        """Error for a surface that is not a net, a plane, a sphere or a conic."""
        return ValueError(f"the {self.kind} is no plane, sphere or conic; pass it to scene.changed, which fits a net")

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> Self:
        """Return the surface with its tensors in another precision or on another device; numbers stay numbers."""
        moved = {n: v.to(dtype=dtype, device=device) for n, v in self.parameters().items() if isinstance(v, Tensor)}
        return self.with_parameters(**moved) if moved else self

    def plain(self) -> Self:
        """Return the surface in float64 on the CPU, without gradient; scalars become Python floats."""
        numbers = {name: float(value) for name, value in self.parameters().items()}
        return self.with_parameters(z=float(self.z), **numbers)


def sampled(surface: Surface, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return z (mm), ∂z/∂x and ∂z/∂y in float64 at points x, y (mm), which are arrays of one shape, or numbers."""
    x, y = (np.require(p, float, ["C", "W"]) for p in np.broadcast_arrays(x, y))
    values = surface.plain().sag_and_slope(*(torch.from_numpy(p.ravel()) for p in (x, y)))
    z, z_x, z_y = (value.numpy().reshape(x.shape) for value in values)
    return z, z_x, z_y


def sag(surface: Surface, x: Any, y: Any) -> np.ndarray:
    """Return z (mm) of a surface at points (mm), as `sampled` does."""
    return sampled(surface, x, y)[0]


def points_on(surface: Surface, x: Any, y: Any) -> np.ndarray:
    """Return the points (…, 3) (mm) of a surface at (x, y) (mm) of its chart, in float64."""
    position, _ = surface.plain().position_and_normal(*_tensors(x, y))
    return _in_space(surface, position)


def points_and_normals(surface: Surface, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return points (…, 3) (mm) and unit normals (…, 3), along +z or outward, at (x, y) (mm) of the chart."""
    position, (n_x, n_y, n_z) = surface.plain().position_and_normal(*_tensors(x, y))
    length = torch.sqrt(n_x * n_x + n_y * n_y + n_z * n_z)
    return _in_space(surface, position), np.stack([(n / length).numpy() for n in (n_x, n_y, n_z)], axis=-1)


def _tensors(x: Any, y: Any) -> tuple[Tensor, Tensor]:
    a, b = (torch.from_numpy(np.require(p, float, ["C", "W"])) for p in np.broadcast_arrays(x, y))
    return a, b


def _in_space(surface: Surface, position: Vectors) -> np.ndarray:
    points = np.stack([part.numpy() for part in position], axis=-1)
    points[..., 2] += float(surface.z)
    return points


class _Revolved(Surface):
    """Surface of revolution; c is its `curvature`, k its `conic_constant`, z0 its `z`."""

    @property
    def level(self) -> bool:
        """True for a plane z = const, which light along the axis meets at normal incidence."""
        return not isinstance(self.curvature, Tensor) and self.curvature == 0

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (z - z0 in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm; finite but meaningless where there is no surface.

        ∂z/∂x = c x / sqrt(1 - (1 + k) c² r²), r² = x² + y².
        """
        c = self.curvature
        r2 = x * x + y * y
        root = _root(self._cos2(r2))
        return c * r2 / (1 + root), c * x / root, c * y / root

    def reaches(self, x: Tensor, y: Tensor) -> Tensor:
        """Return True where the surface has a point over (x, y) and is not vertical."""
        return self._cos2(x * x + y * y) > MIN_COS2

    def scaled(self, factor: float, about: float) -> Self:
        """Return the surface scaled by a factor about the point of the axis at z = `about` (mm)."""
        moved = self.moved(about + factor * (self.z - about))
        return moved.with_parameters(curvature=self.curvature / factor) if self.curvature else moved

    def bent(self, curvature: float) -> Self | Sphere:
        """Return the surface with `curvature` (1/mm) added at its vertex; a plane becomes a sphere."""
        total = self.curvature + curvature
        return self.with_parameters(curvature=total) if self.curvature else Sphere(self.z, total)

    def conic(self) -> tuple[float, float]:
        """Return curvature (1/mm) and conic constant, without gradient."""
        return float(self.curvature), float(self.conic_constant)

    def _cos2(self, r2: Tensor) -> Tensor:
        return 1 - self.curvature * self.curvature * (1 + self.conic_constant) * r2

    def crossing(self, x: Tensor, y: Tensor, direction: Tensor, sense: int = 1) -> tuple[Tensor, Tensor]:
        """Return (path s in mm along rays from (x, y) on the plane z0, True where they meet the part with the vertex).

        s = c r² / (g + sqrt(g² - a c r²)) is the root of a s² - 2 g s + c r² = 0 at which a ray comes from below, d_z >
        ∇z · (d_x, d_y); d: unit direction, a = c (1 + k d_z²), g = d_z - c (x d_x + y d_y).
        sense: -1 for light along -z, which meets the surface at the other root.
        """
        c, (dx, dy, dz) = self.curvature, direction
        f = c * (x * x + y * y)
        g = dz - c * (x * dx + y * dy)
        k = g * g - c * (1 + self.conic_constant * dz * dz) * f
        divisor = g + sense * torch.sqrt(torch.where(k > 0, k, torch.ones_like(k)))
        ok = (k > 0) & (sense * divisor > 1e-6)
        s = f / torch.where(ok, divisor, torch.ones_like(divisor))
        return s, ok & ((1 + self.conic_constant) * c * s * dz < 1)  # excludes the far half and the other sheet

    def sags(self, outline: Outline) -> tuple[float, float]:
        """Return zero and the sag (mm) at the point of the outline farthest from the axis, the lower one first."""
        x, y = (torch.tensor(p, dtype=torch.float64) for p in outline.farthest)
        rim = float(self.plain().relative_sag_and_slope(x, y)[0])
        return min(rim, 0.0), max(rim, 0.0)


@dataclass(frozen=True)
class Plane(_Revolved):
    """z = z0."""

    z: float  # z0 (mm)
    kind: Literal["plane"] = "plane"

    __pydantic_config__ = STRICT

    curvature = conic_constant = 0.0

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (z - z0 in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm: all zero."""
        zero = torch.zeros_like(x)
        return zero, zero, zero

    def crossing(self, x: Tensor, y: Tensor, direction: Tensor, sense: int = 1) -> tuple[Tensor, Tensor]:
        """Return (path in mm along rays from (x, y) on the plane z0, True where they meet the plane): (0, True)."""
        return torch.zeros_like(x), torch.ones_like(x, dtype=torch.bool)


@dataclass(frozen=True)
class Sphere(_Revolved):
    """z = z0 + c r² / (1 + sqrt(1 - c² r²)), r² = x² + y²; c may be zero (a plane).

    This form (Wang et al. 2023, Eq. 16) avoids the cancellation in R - sqrt(R² - r²).
    """

    z: float  # vertex (mm)
    curvature: float | Tensor = 0.0  # c (1/mm); positive bends towards +z
    kind: Literal["sphere"] = "sphere"

    __pydantic_config__ = STRICT

    conic_constant = 0.0

    def parameters(self) -> dict[str, float | Tensor]:
        """Return the curvature (1/mm)."""
        return {"curvature": self.curvature}


@dataclass(frozen=True)
class Conic(_Revolved):
    """z = z0 + c r² / (1 + sqrt(1 - (1 + k) c² r²)), r² = x² + y²; on it c r² - 2 (z - z0) + (1 + k) c (z - z0)² = 0.

    k = 0: a sphere; -1 < k < 0: an ellipsoid with its long axis on the axis of the lens; k = -1: a paraboloid; k < -1:
    a hyperboloid; k > 0: an ellipsoid with its short axis on the axis of the lens.
    """

    z: float  # vertex (mm)
    curvature: float | Tensor = 0.0  # c at the vertex (1/mm); positive bends towards +z
    conic_constant: float | Tensor = 0.0  # k
    kind: Literal["conic"] = "conic"

    __pydantic_config__ = STRICT

    def parameters(self) -> dict[str, float | Tensor]:
        """Return the curvature (1/mm) and the conic constant."""
        return {"curvature": self.curvature, "conic_constant": self.conic_constant}


@dataclass(frozen=True)
class Toroid(Surface):
    """z = z0 + R (1 - sqrt((1 - f / R)² - y² / R²)), R = 1 / c_y, f = c_x x² / (1 + sqrt(1 - c_x² x²)).

    It is the circle of curvature c_x in the plane y = 0, rotated about the line parallel to x at z = z0 + R (a toric
    surface of ISO 10110-12).  It is a cylinder if one curvature is 0 (c_y = 0: z = z0 + f), a sphere if both are equal.
    """

    z: float  # vertex (mm)
    curvature_x: float | Tensor = 0.0  # c_x (1/mm); positive bends towards +z
    curvature_y: float | Tensor = 0.0  # c_y (1/mm)
    kind: Literal["toroid"] = "toroid"

    __pydantic_config__ = STRICT

    def _profile(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (1 - c_x² x², 1 - c_y f, (1 - c_y f)² - c_y² y²); first and last are positive on the surface."""
        c = self.curvature_x
        cos2 = 1 - c * c * x * x
        f = c * x * x / (1 + _root(cos2))
        left = 1 - self.curvature_y * f
        return cos2, left, left * left - (self.curvature_y * y) ** 2

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (z - z0 in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm; finite but meaningless where there is no surface.

        The form z - z0 = (f (2 - c_y f) + c_y y²) / (1 + sqrt((1 - c_y f)² - c_y² y²)) avoids cancellation.
        """
        cos2, left, g = self._profile(x, y)
        c_x, c_y, along, root = self.curvature_x, self.curvature_y, _root(cos2), _root(g)
        h = (c_x * x * x / (1 + along) * (1 + left) + c_y * y * y) / (1 + root)
        return h, left * c_x * x / along / root, c_y * y / root

    def reaches(self, x: Tensor, y: Tensor) -> Tensor:
        """Return True where the surface has a point over (x, y) and is not vertical."""
        cos2, left, g = self._profile(x, y)
        return (cos2 > MIN_COS2) & (g > MIN_COS2) & (left > 0)

    def sags(self, outline: Outline) -> tuple[float, float]:
        """Return the minimum and the maximum (mm) of zero and the sags at the rim of the outline."""
        h = self.plain().relative_sag_and_slope(*map(torch.from_numpy, outline.rim_points()))[0]
        return min(float(h.min()), 0.0), max(float(h.max()), 0.0)

    def parameters(self) -> dict[str, float | Tensor]:
        """Return the curvatures along x and y (1/mm)."""
        return {"curvature_x": self.curvature_x, "curvature_y": self.curvature_y}


def _root(square: Tensor) -> Tensor:
    """Return sqrt(square), at least sqrt(MIN_COS2): the square is 0 where the surface is vertical."""
    return torch.sqrt(torch.where(square > MIN_COS2, square, torch.full_like(square, MIN_COS2)))


@dataclass(frozen=True)
class Recess(Surface):
    """Surface of revolution inside a circle, continued outside by the plane z = const through its rim.

    Examples are a dome over an LED in a flat underside, or a bulge on it.  Light is traced to the optical part alone.
    """

    face: Sphere | Conic  # optical part
    outline: Circle  # outline of the optical part, about the axis

    @property
    def optical(self) -> Sphere | Conic:
        """Optical part of the surface."""
        return self.face

    def __post_init__(self) -> None:
        for name in ("z", "kind", "curvature", "conic_constant", "conic", "parameters"):  # copied from the optical part
            object.__setattr__(self, name, getattr(self.face, name))

    @property
    def around(self) -> Plane:
        """Plane through the rim of the optical part."""
        low, high = self.face.sags(self.outline)
        return Plane(float(self.z) + low + high)  # one of the two is zero

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (height over the plane z in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm."""
        inside, zero = self.outline.contains(x, y), torch.zeros_like(x)
        h, z_x, z_y = self.face.relative_sag_and_slope(x, y)
        rim = torch.full_like(h, sum(self.face.sags(self.outline)))
        return torch.where(inside, h, rim), torch.where(inside, z_x, zero), torch.where(inside, z_y, zero)

    def sags(self, outline: Outline) -> tuple[float, float]:
        """Return 0 and the sag (mm) at the rim of the optical part or of a smaller `outline`, the lower one first."""
        smaller = math.hypot(*outline.farthest) < self.outline.radius
        return self.face.sags(outline if smaller else self.outline)

    def with_parameters(self, **values: float | Tensor) -> Recess:
        """Return the surface with other parameters, or another vertex z (mm), of its optical part."""
        return replace(self, face=self.face.with_parameters(**values))

    def scaled(self, factor: float, about: float) -> Recess:
        """Return the surface and its outline scaled by a factor about the point of the axis at z = `about` (mm)."""
        return Recess(self.face.scaled(factor, about), self.outline.scaled(factor))

    def bent(self, curvature: float) -> Recess:
        """Return the surface with `curvature` (1/mm) added at its vertex."""
        return replace(self, face=self.face.bent(curvature))
