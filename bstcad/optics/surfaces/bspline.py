"""B-spline surface of Wang et al. 2023: order 3, uniform clamped knots, control points uniform in x and y.

Only the heights z of the control points are free.  Because the points are uniform in x and y, x as a function of the
spline's parameter t is, in spacings of the points, t + 1/2 in the inner spans and quadratic in the two end spans.  So
t(x) has a closed form, no search for the parameter of a point is needed, and a height is the sum of nine products.
Source: Wang et al. 2023, "B-spline freeform surface tailoring for prescribed irradiance", Eqs. 2 and 6-13.

A net has m control points along x and n along y.  The basis is written in u = (m - 1) (x - x_min) / (x_max - x_min),
the distance along the net in control-point spacings, 0 <= u <= m - 1, and likewise in v along y.  In span (i, j) the
surface is one biquadratic piece of nine control points, and s in [0, 1] is the position within it.  Slopes and
curvatures follow from the exact derivatives of this piece.  Second derivatives jump at the knots, so that their bounds
are computed for each span separately.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, Self

import numpy as np
import scipy.linalg
import scipy.sparse
import torch
from torch import Tensor
from typing_extensions import TypeIs

from bstcad.optics.numerics import kernel_choice
from bstcad.optics.surfaces.motion import Motion, along_axis
from bstcad.optics.surfaces.outlines import Outline, inside
from bstcad.optics.surfaces.sides import Sides, as_pair, side
from bstcad.optics.surfaces.surfaces import Surface

DEGREE = 2  # degree of the basis functions (order 3)
SPANS_AT_A_TIME = 1 << 14  # number of spans evaluated at a time, so that their values stay in the cache
# Positions in a span, including both end knots, at which slope and curvature of a net are limited and reported.
QUARTERS = (0.0, 0.25, 0.5, 0.75, 1.0)


def knots(m: int) -> np.ndarray:
    """Return {0, 0, 0, 1, 2, …, m-3, m-2, m-2, m-2}: the full knot vector of m control points, shape (m + 3,)."""
    return np.concatenate([[0.0, 0.0], np.arange(m - 1, dtype=float), [m - 2.0, m - 2.0]])


def parameter(u: Tensor, m: int) -> Tensor:
    """Return t(u) for u in [0, m-1]; Wang et al. 2023, Eq. 13.

    t = 2 - sqrt(4 - 2u) in the first span, u - 1/2 in inner spans, and m - 4 + sqrt(4 - 2(m - 1 - u)) in the last.
    """
    k, s = span(u, m)
    return k + s


def span(u: Tensor, m: int) -> tuple[Tensor, Tensor]:
    """Return (k, s) with t(u) = k + s: number k of the span, and position s in it, more accurate than t(u) - k."""
    first, last = u < 1.5, u > m - 2.5
    end = torch.where(first, u, m - 1 - u)  # distance from the nearer end
    root = torch.sqrt(4.0 - 2.0 * torch.where(first | last, end, torch.ones_like(u)))  # guarded before the root
    inner = u - 0.5
    k = inner.detach().nan_to_num(0.0).floor().clamp(0, m - 3)  # a valid index for every u
    k = torch.where(first, 0.0, torch.where(last, m - 3.0, k)).to(u.dtype)
    return k, torch.where(first, 2.0 - root, torch.where(last, root - 1.0, inner - k))


def position(t: Tensor, m: int) -> Tensor:
    """Return u(t), inverse of `parameter`: 2t - t²/2 in the first span, mirrored in the last, and t + 1/2 between."""
    end = m - 2.0 - t
    return torch.where(t < 1, 2 * t - t * t / 2, torch.where(end < 1, m - 1 - 2 * end + end * end / 2, t + 0.5))


def basis(u: Tensor, m: int) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]:
    """Return the three non-zero basis functions at u and their derivatives in u; Wang et al. 2023, Eqs. 8-12.

    With s = t - k and q = 1 - s in span k: B_k = a q², B_{k+2} = b s², B_{k+1} = 1 - B_k - B_{k+2}, where a = 1 in
    the first span, b = 1 in the last, and otherwise a, b = 1/2 (the paper prints B_{m-1} and the first piece of
    B_{m-2} reversed; the correct form is the mirror image of B_0 and B_1).  Since the control points are uniform,
    du/dt = Σ i B'_i = 2 (a q + b s).

    Returns (k, (B_k, B_{k+1}, B_{k+2}), (dB/du …)), each shaped like u.
    """
    k, s = span(u, m)
    q = 1.0 - s
    a = torch.where(k == 0, 1.0, 0.5).to(u.dtype)
    b = torch.where(k == m - 3, 1.0, 0.5).to(u.dtype)
    w0, w2 = a * q * q, b * s * s
    dt_du = 0.5 / (a * q + b * s)
    d0, d2 = -2.0 * a * q * dt_du, 2.0 * b * s * dt_du
    return k.long(), (w0, 1.0 - w0 - w2, w2), (d0, -d0 - d2, d2)


def evaluate_plain(heights: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return (h, ∂h/∂u, ∂h/∂v), h = Σ_i Σ_j B_i(u) B_j(v) h_ij, by nine products (Wang et al. 2023, Eqs. 2 and 6)."""
    m, n = heights.shape
    ku, wu, du = basis(u, m)
    kv, wv, dv = basis(v, n)
    corner = ku * n + kv
    net = heights.reshape(-1).double()  # the adjoint sums in float64: float32 sums stop growing at 2^24 rays
    h = h_u = h_v = torch.zeros_like(u)
    for i in range(3):
        for j in range(3):
            p = net[corner + (i * n + j)].to(heights.dtype)
            h = h + wu[i] * wv[j] * p
            h_u = h_u + du[i] * wv[j] * p
            h_v = h_v + wu[i] * dv[j] * p
    return h, h_u, h_v


def evaluate(heights: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the values of `evaluate_plain`, from the fused kernel if it supports these tensors (equal to rounding)."""
    if fast := kernel_choice.kernel("bspline.evaluate", heights, u, v):
        return fast(heights, *torch.broadcast_tensors(u, v))
    return evaluate_plain(heights, u, v)


def net_gradient(heights: Tensor, u: Tensor, v: Tensor, seeds: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Return the gradient (m, n) of Σ (g h + g_u ∂h/∂u + g_v ∂h/∂v) in the heights; seeds: (g, g_u, g_v).

    This adjoint of `evaluate` does not depend on the heights; `heights` gives the net's size, type and device.
    """
    if fast := kernel_choice.kernel("bspline.net_gradient", heights, u, v):
        return fast(heights, u, v, seeds)
    net = torch.zeros_like(heights, requires_grad=True)
    with torch.enable_grad():
        values = evaluate_plain(net, u, v)
    return torch.autograd.grad(values, net, seeds)[0]


def basis_matrix(u: np.ndarray, m: int, derivative: int = 0) -> scipy.sparse.csr_matrix:
    """Return the banded matrix (len(u), m): row r has the basis functions at u[r]; derivative 1: their derivatives."""
    points = torch.as_tensor(np.asarray(u, dtype=np.float64))
    k, *weights = basis(points, m)
    columns = (k[:, None] + torch.arange(3)).numpy()
    rows = np.arange(len(points) + 1) * 3
    values = torch.stack(weights[derivative], dim=1).numpy()
    return scipy.sparse.csr_matrix((values.ravel(), columns.ravel(), rows), shape=(len(points), m))


def resample(values: np.ndarray, fine: int) -> np.ndarray:
    """Resample the coefficients (m, …) of a spline to `fine` control points, (fine, …), by least squares.

    The knot vectors are not nested, so the spline is fitted at eight points per span of the new net; in two dimensions
    apply the function along each axis.  The matrices are banded: the work grows in proportion to the net.
    """
    coarse, u = len(values), np.linspace(0.0, 1.0, 8 * (fine - 2) + 1)
    on_fine, on_coarse = basis_matrix(u * (fine - 1), fine), basis_matrix(u * (coarse - 1), coarse)
    return _least_squares(on_fine, (on_fine.T @ on_coarse) @ values)


def interpolating_net(values: np.ndarray) -> np.ndarray:
    """Return the control points (m, n) of the spline that interpolates values (m, n) at its control points."""
    for m in values.shape:
        basis, bands = basis_matrix(np.arange(m), m), np.zeros((3, m))
        for k in (1, 0, -1):
            bands[1 - k, max(k, 0) : m + min(k, 0)] = basis.diagonal(k)
        values = scipy.linalg.solve_banded((1, 1), bands, values).T
    return np.ascontiguousarray(values)


def midpoint_values(net: np.ndarray) -> np.ndarray:
    """Return the values (2 m - 1, 2 n - 1) of a spline at its control points and at the midpoints between them."""
    for m in net.shape:
        net = (basis_matrix(np.arange(2 * m - 1) / 2, m) @ net).T
    return net


@lru_cache(maxsize=16)
def resampling_matrix(coarse: int, fine: int) -> scipy.sparse.csr_array:
    """Return the matrix (fine, coarse) of `resample`, without entries below rounding: a band around the diagonal."""
    whole = resample(np.eye(coarse), fine)
    return scipy.sparse.csr_array(np.where(np.abs(whole) > np.finfo(whole.dtype).eps, whole, 0.0))


def _least_squares(basis: scipy.sparse.csr_matrix, projected: np.ndarray) -> np.ndarray:
    """Solve B^T B c = projected for c, B (points, m) the basis functions at some points."""
    normal, m = basis.T @ basis, basis.shape[1]  # banded: rounding of a dense solver depends on the number of threads
    bands = np.zeros((DEGREE + 1, m))
    for k in range(DEGREE + 1):
        bands[DEGREE - k, k:] = normal.diagonal(k)
    return scipy.linalg.solveh_banded(bands, projected)


@dataclass(frozen=True)
class BSplineSurface(Surface):
    """z = z0 + Σ_i Σ_j B_i(u(x)) B_j(v(y)) h_ij.

    Heights are stored relative to the plane z0 so that float32 resolves nanometres.
    """

    z: float  # z0, the plane from which the heights are measured (mm)
    heights: Tensor  # heights of the control points (m, n), mm, x along the first axis
    x: tuple[float, float]  # extent of the net in x: first and last control point (mm)
    y: tuple[float, float]  # extent of the net in y (mm)
    kind: Literal["bspline"] = "bspline"

    is_net = True

    @classmethod
    def from_control_points(cls, net: np.ndarray, z: float | None = None) -> BSplineSurface:
        """Return the surface of a control net (m, n, 3) in mm; heights are measured from z (default: mean z)."""
        z = float(net[..., 2].mean()) if z is None else z
        x, y = ((float(net[0, 0, i]), float(net[-1, -1, i])) for i in (0, 1))
        return cls(z, torch.from_numpy(net[..., 2] - z), x, y)

    @classmethod
    def fitted(cls, surface: Surface, x: tuple[float, float], y: tuple[float, float], m: int) -> BSplineSurface:
        """Fit a net of m x m control points over x and y (mm) to a surface by least squares along each axis.

        B^T B H C^T C = B^T Z C: H are the heights of the control points, Z those of the surface at four points per span
        along each axis, B and C the basis along x and y.  The first and the last span, where x(t) is quadratic, would
        reduce the order of the error from 3 to 2; they are left out, and the outermost control points extrapolated.
        """
        u = np.linspace(1.5, m - 2.5, 4 * (m - 4) + 1)
        basis = basis_matrix(u, m)[:, 1:-1]  # the first and the last control point act on the end spans only
        along = (torch.from_numpy(low + (high - low) * u / (m - 1)) for low, high in (x, y))
        heights = surface.plain().relative_sag_and_slope(*torch.meshgrid(*along, indexing="ij"))[0].numpy()
        for _ in range(2):  # along x, then along y
            inner = _least_squares(basis, basis.T @ heights)
            first, last = (3 * end[0] - 3 * end[1] + end[2] for end in (inner, inner[::-1]))
            heights = np.concatenate([first[None], inner, last[None]]).T
        return cls(surface.z, torch.from_numpy(heights.copy()), x, y)

    @property
    def detail(self) -> float:
        """Width of the smooth pieces of the surface (mm): the smaller pitch, which is the width of a knot span."""
        return min(self.pitch)

    def from_vertex(self) -> BSplineSurface:
        """Return the surface with heights measured from its vertex, the point on the axis."""
        axis = torch.zeros(1, dtype=self.heights.dtype, device=self.heights.device)
        vertex = float(self.relative_sag_and_slope(axis, axis)[0])
        return replace(self, z=self.z + vertex, heights=self.heights - vertex)

    @property
    def vertex_z(self) -> float:
        """Position (mm) of the vertex on the axis."""
        return float(self.from_vertex().z)

    @property
    def potential(self) -> Tensor:
        """Heights (m, n) of the net whose slopes are those of the surface in its chart (charts.py): its own heights."""
        return self.heights

    def with_potential(self, heights: Tensor) -> BSplineSurface:
        """Return the surface with another potential."""
        return replace(self, heights=heights)

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers (m, n) of control points along x and along y."""
        m, n = self.heights.shape
        return m, n

    @property
    def m(self) -> int:
        """Number of control points along x; for a square net, also along y."""
        return self.shape[0]

    @property
    def side(self) -> int:
        """Control points per side of a square net with about as many points as this net."""
        return side(self.shape)

    @property
    def pitch(self) -> tuple[float, float]:
        """Spacing of the control points in x and in y (mm)."""
        m, n = self.shape
        return (self.x[1] - self.x[0]) / (m - 1), (self.y[1] - self.y[0]) / (n - 1)

    @property
    def places(self) -> tuple[Tensor, Tensor]:
        """Coordinates x and y (m, n) (mm) of the control points in the chart."""
        ends = zip((self.x, self.y), self.shape, strict=True)
        x, y = torch.meshgrid(*(torch.linspace(*side, m, dtype=torch.float64) for side, m in ends), indexing="ij")
        return x, y

    def along_net(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return (u, v) of points (mm) in control-point spacings; a point outside the net is moved to its rim."""
        (m, n), (pitch_x, pitch_y) = self.shape, self.pitch
        return ((x - self.x[0]) / pitch_x).clamp(0, m - 1), ((y - self.y[0]) / pitch_y).clamp(0, n - 1)

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (z - z0 in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm; a point outside the net is moved to its rim."""
        h, h_u, h_v = evaluate(self.heights, *self.along_net(x, y))
        return h, h_u / self.pitch[0], h_v / self.pitch[1]

    def control_points(self) -> np.ndarray:
        """Return the control net (m, n, 3) in mm, float64, x along the first axis."""
        m, n = self.shape
        net = np.empty((m, n, 3))
        net[..., 0] = np.linspace(*self.x, m)[:, None]
        net[..., 1] = np.linspace(*self.y, n)[None, :]
        net[..., 2] = self.z + self.heights.detach().cpu().numpy().astype(np.float64)
        return net

    def refined(self, sides: Sides) -> BSplineSurface:
        """Resample the surface to `sides` control points per side, or (along x, along y), by `resample`."""
        if as_pair(sides) == self.shape:
            return self
        in_x, in_y = as_pair(sides)
        heights = resample(self.heights.detach().cpu().double().numpy(), in_x)
        heights = np.ascontiguousarray(resample(np.ascontiguousarray(heights.T), in_y).T)
        return replace(self, heights=torch.from_numpy(heights).to(self.heights))

    def sags(self, outline: Outline) -> tuple[float, float]:
        """Return (min, max) over 0 and the heights (mm above z0) of all control points that act inside the outline."""
        (pitch_x, pitch_y), net = self.pitch, self.control_points()
        x, y = (np.maximum(np.abs(net[..., i]) - 2 * pitch, 0.0) for i, pitch in enumerate((pitch_x, pitch_y)))
        heights = self.heights.detach().cpu()[outline.contains(torch.from_numpy(x), torch.from_numpy(y))]
        return min(float(heights.min()), 0.0), max(float(heights.max()), 0.0)

    def scaled(self, factor: float, about: float) -> BSplineSurface:
        """Return the surface scaled by a factor about the point of the axis at z = `about` (mm)."""
        (x0, x1), (y0, y1), z = self.x, self.y, about + factor * (self.z - about)
        x, y = (factor * x0, factor * x1), (factor * y0, factor * y1)
        return replace(self, z=z, heights=factor * self.heights, x=x, y=y)

    def shifted(self, axis: int, by: float, half: float) -> Self:
        """Return the surface shifted by `by` (mm) along x (axis 0) or y (1).

        The net is extended linearly to reach ±half (mm) still; inside, the face does not change.
        """
        (low, high), pitch = (self.x, self.y)[axis], self.pitch[axis]
        more = max(0, math.ceil((half + abs(by) - min(-low, high)) / pitch))
        heights = np.pad(self.heights, [(more * (k == axis),) * 2 for k in (0, 1)], "reflect", reflect_type="odd")
        ends = low - more * pitch + by, high + more * pitch + by
        x, y = (self.x, ends) if axis else (ends, self.y)
        return replace(self, heights=torch.from_numpy(heights), x=x, y=y)

    def tilted(self, axis: int, angle: float) -> Self:
        """Return the surface rotated by a small angle (degrees) about x (axis 0) or y (1) through its vertex v.

        A point p = v + (x, y, ζ) of the rotated face was at v + q before the rotation R, with q = Rᵀ (p - v).  In place
        of the face of height h, its tangent plane at (x, y) is used: q_z = h - h(v) + ∇h · ((q_x, q_y) - (x, y)),
        linear in ζ.  The error of this is curvature · (angle · sag)², 1 nm at a tenth of a degree.
        """
        turn = Motion.of(turn=along_axis(axis, angle)).inverse.rotation.tolist()
        x, y = self.places
        h, h_x, h_y = self.relative_sag_and_slope(x, y)
        vertex = float(self.from_vertex().z) - self.z
        level = [row[0] * x + row[1] * y for row in turn]  # q for ζ = 0
        rise = h - vertex + h_x * (level[0] - x) + h_y * (level[1] - y) - level[2]
        along = turn[2][2] - h_x * turn[0][2] - h_y * turn[1][2]
        return replace(self, heights=self.heights + (vertex + rise / along - h).to(self.heights))

    def bent(self, curvature: float) -> BSplineSurface:
        """Return the surface plus curvature r² / 2 (mm), which adds `curvature` (1/mm) at its vertex."""
        x, y = (torch.linspace(*ends, m).to(self.heights) for ends, m in zip((self.x, self.y), self.shape, strict=True))
        return replace(self, heights=self.heights + curvature / 2 * (x[:, None] ** 2 + y[None, :] ** 2))

    def parameters(self) -> dict[str, float | Tensor]:
        """Return the heights of the control points (mm), by the name "heights"."""
        return {"heights": self.heights}

    def plain(self) -> Self:
        """Return the surface with heights in float64 on the CPU, without gradient."""
        return replace(self, heights=self.heights.detach().to("cpu", torch.float64))


def is_net(surface: Surface) -> TypeIs[BSplineSurface]:
    """Return True for a B-spline net, which has `heights`."""
    return isinstance(surface, BSplineSurface)


def require_net(surface: Surface) -> BSplineSurface:
    """Return a surface that is a B-spline net; TypeError for another one."""
    if not is_net(surface):
        raise TypeError(f"the {surface.kind} has no control points; fit a net to it with BSplineSurface.fitted")
    return surface


@dataclass(frozen=True)
class Jet:
    """Derivatives of z(x, y) at k x k positions of each knot span, each (k, k, spans): position in x, in y, span."""

    z_x: Tensor  # ∂z/∂x
    z_y: Tensor  # ∂z/∂y
    z_xx: Tensor  # ∂²z/∂x² (1/mm)
    z_xy: Tensor  # ∂²z/∂x∂y (1/mm)
    z_yy: Tensor  # ∂²z/∂y² (1/mm)

    @property
    def slope(self) -> Tensor:
        """Slope |∇z|, the tangent of the angle to z = const."""
        square = self.z_x * self.z_x + self.z_y * self.z_y
        return torch.sqrt(square.clamp_min(torch.finfo(square.dtype).tiny))  # guarded before the root

    @property
    def curvatures(self) -> tuple[Tensor, Tensor]:
        """Principal curvatures (1/mm), the larger (more concave) one first."""
        return principal(self.z_x, self.z_y, z_xx=self.z_xx, z_xy=self.z_xy, z_yy=self.z_yy)


def principal(z_x: Tensor, z_y: Tensor, z_xx: Tensor, z_xy: Tensor, z_yy: Tensor) -> tuple[Tensor, Tensor]:
    """Return the principal curvatures of z(x, y), H ± sqrt(H² - K) (1/mm), positive if concave towards +z.

    H = ((1 + z_y²) z_xx - 2 z_x z_y z_xy + (1 + z_x²) z_yy) / (2 n³), K = (z_xx z_yy - z_xy²) / n⁴, n² = 1 + |∇z|².
    """
    norm2 = 1 + z_x * z_x + z_y * z_y
    mean = ((1 + z_y * z_y) * z_xx - 2 * z_x * z_y * z_xy + (1 + z_x * z_x) * z_yy) / (2 * norm2 * norm2.sqrt())
    gauss = (z_xx * z_yy - z_xy * z_xy) / (norm2 * norm2)
    spread = (mean * mean - gauss).clamp_min(torch.finfo(mean.dtype).tiny).sqrt()
    return mean + spread, mean - spread


def weights(span: Tensor, m: int, s: float) -> tuple[tuple[Tensor, Tensor, Tensor], ...]:
    """Return the three non-zero basis functions and their first two derivatives in u, at position s in each `span`.

    The functions are those of `basis`; du/dt = 2 (a q + b s), d²u/dt² = 2 (b - a).
    """
    a = torch.where(span == 0, 1.0, 0.5).double()
    b = torch.where(span == m - 3, 1.0, 0.5).double()
    q, du, ddu = 1.0 - s, 2 * (a * (1.0 - s) + b * s), 2 * (b - a)
    w0, w2 = a * q * q, b * s * s
    d0, d2 = -2 * a * q / du, 2 * b * s / du
    dd0, dd2 = (2 * a - d0 * ddu) / du**2, (2 * b - d2 * ddu) / du**2
    return (w0, 1.0 - w0 - w2, w2), (d0, -d0 - d2, d2), (dd0, -dd0 - dd2, dd2)


@dataclass(frozen=True)
class Spans:
    """Selected knot spans of a net, with their control points."""

    shape: tuple[int, int]  # control points of the net along x and along y
    pitch: tuple[float, float]  # spacing of the control points along x and along y (mm)
    i: Tensor  # numbers of the spans along x, (spans,) int64
    j: Tensor  # numbers of the spans along y, (spans,) int64
    heights: Tensor  # heights of the nine control points of each span, (9, spans) mm, x along the slower index

    @classmethod
    def of(cls, surface: BSplineSurface, i: Tensor, j: Tensor) -> Spans:
        """Select the spans (i, j) of a surface."""
        (_, n), net = surface.shape, surface.heights.reshape(-1)
        corner = i * n + j
        heights = torch.stack([net[corner + (a * n + b)] for a in range(3) for b in range(3)])
        return cls(surface.shape, surface.pitch, i=i, j=j, heights=heights)

    def jet(self, s: Sequence[float]) -> Jet:
        """Return the derivatives at positions s x s (0 to 1) of each span, differentiable in the heights."""
        pitch_x, pitch_y = self.pitch
        along_x, along_y = (
            self._weights(index, count, s) for index, count in zip((self.i, self.j), self.shape, strict=True)
        )
        value, first, second = ([_mean(w, self.heights[b::3]) for b in range(3)] for w in along_x)
        value, first, second = ([row[:, None] for row in rows] for rows in (value, first, second))
        return Jet(
            _mean(along_y[0], first) / pitch_x,
            _mean(along_y[1], value) / pitch_y,
            z_xx=_mean(along_y[0], second) / pitch_x**2,
            z_xy=_mean(along_y[1], first) / (pitch_x * pitch_y),
            z_yy=_mean(along_y[2], value) / pitch_y**2,
        )

    def _weights(self, index: Tensor, count: int, s: Sequence[float]) -> list[list[Tensor]]:
        """Return `weights` by [derivative][basis function], each (len(s), spans); index: of spans; count: m or n."""
        each = [weights(index, count, at) for at in s]
        return [[torch.stack([w[order][k] for w in each]).to(self.heights) for k in range(3)] for order in range(3)]

    def scattered(self, gradient: Tensor) -> Tensor:
        """Return a gradient in `heights` (9, spans) as a gradient in the net (m, n), added up in a fixed order."""
        m, n = self.shape
        net, corner = torch.zeros(m * n).to(gradient), self.i * n + self.j
        for k, part in enumerate(gradient):
            at = corner + (k // 3 * n + k % 3)
            net[at] += part
        return net.view(m, n)


def _mean(w: Sequence[Tensor], values: Sequence[Tensor] | Tensor) -> Tensor:
    return w[0] * values[0] + w[1] * values[1] + w[2] * values[2]


def span_points(surface: BSplineSurface, i: Tensor, j: Tensor, s: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Return x (k, 1, spans) and y (1, k, spans) (mm) of the k x k positions s x s in each span (i, j)."""
    at = torch.tensor(list(s), dtype=torch.float64, device=i.device)[:, None]
    u, v = (position(index + at, count) for index, count in zip((i, j), surface.shape, strict=True))
    pitch_x, pitch_y = surface.pitch
    return (surface.x[0] + pitch_x * u)[:, None], (surface.y[0] + pitch_y * v)[None]


def near_outline(surface: BSplineSurface, outline: Outline, i: Tensor, j: Tensor, s: Sequence[float]) -> Tensor:
    """Return True (k, k, spans) for positions inside the outline or within half a span's diagonal of its rim."""
    x, y = span_points(surface, i, j, s)
    return inside(outline.limits, x, y, math.hypot(*surface.pitch) / 2)


def curvature_bounds(surface: BSplineSurface, sign: float) -> Tensor:
    """Return an upper bound (m - 2, n - 2) of the positive principal curvatures of sign · z in each span (1/mm).

    Second derivatives are weighted means of second differences of the control points; in an end span, of 1/4 to 2 times
    these differences.  A positive principal curvature is at most the larger eigenvalue of the Hessian, which grows with
    the two diagonal entries and with the magnitude of the mixed entry.
    """
    d_x, d_y = _differences(surface)
    pitch_x, pitch_y = surface.pitch
    xx, yy = sign * (d_x[1:] - d_x[:-1]) / pitch_x, sign * (d_y[:, 1:] - d_y[:, :-1]) / pitch_y
    for end in (xx[0], xx[-1], yy[:, 0], yy[:, -1]):
        end.copy_(torch.maximum(2 * end, end / 4))
    xx, yy = _window_max(xx, 1, 3), _window_max(yy, 0, 3)
    xy = _window_max(_window_max(((d_x[:, 1:] - d_x[:, :-1]) / pitch_y).abs(), 0, 2), 1, 2)
    return (xx + yy) / 2 + torch.sqrt(((xx - yy) / 2) ** 2 + xy**2)


def slope_bounds(surface: BSplineSurface) -> Tensor:
    """Return an upper bound (m - 2, n - 2) of |∇z| in each span: slopes are means of slopes of the control net."""
    d_x, d_y = (d.abs() for d in _differences(surface))
    return torch.sqrt(_window_max(_window_max(d_x, 0, 2), 1, 3) ** 2 + _window_max(_window_max(d_y, 0, 3), 1, 2) ** 2)


def _differences(surface: BSplineSurface) -> tuple[Tensor, Tensor]:
    """Return the slopes of the legs of the control net along x, (m - 1, n), and along y, (m, n - 1)."""
    h, (pitch_x, pitch_y) = surface.heights.detach(), surface.pitch
    return (h[1:] - h[:-1]) / pitch_x, (h[:, 1:] - h[:, :-1]) / pitch_y


def _window_max(t: Tensor, axis: int, count: int) -> Tensor:
    """Return the maximum of each `count` neighbours along an axis."""
    length = t.shape[axis] - count + 1
    largest = t.narrow(axis, 0, length)
    for k in range(1, count):
        largest = torch.maximum(largest, t.narrow(axis, k, length))
    return largest
