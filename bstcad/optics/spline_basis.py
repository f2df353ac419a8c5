"""The B-spline basis of Wang et al. 2023: order 3, uniform clamped knots, control points uniform in x and y.

Because the control points are uniform, x(t) is the identity shifted by 1/2 inside and quadratic in the two end
spans, so t(x) has a closed form and a ray needs no search for its parameter.  Nine products a point.
Source: Wang et al. 2023, "B-spline freeform surface tailoring for prescribed irradiance", Eqs. 2 and 6-13.

Everything here is written in u = (m - 1) (x - x_min) / (x_max - x_min), the distance along the net in control-point
spacings, 0 <= u <= m - 1.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse
import torch
from torch import Tensor

from bstcad.optics.kernels import spline
from bstcad.optics.kernels.choice import fused

DEGREE = 2  # order 3
SMALLEST_NET = 5  # control points a side: two end spans and one inner span


def knots(m: int) -> np.ndarray:
    """{0, 0, 0, 1, 2, …, m-3, m-2, m-2, m-2}: the full knot vector of m control points, shape (m + 3,)."""
    return np.concatenate([[0.0, 0.0], np.arange(m - 1, dtype=float), [m - 2.0, m - 2.0]])


def parameter(u: Tensor, m: int) -> Tensor:
    """t(u) for u in [0, m-1]; Wang et al. 2023, Eq. 13.

    t = 2 - sqrt(4 - 2u), u - 1/2, m - 4 + sqrt(4 - 2(m - 1 - u)) in the first, inner and last span.
    """
    k, s = span(u, m)
    return k + s


def span(u: Tensor, m: int) -> tuple[Tensor, Tensor]:
    """(k, s), t(u) = k + s: the span, and the place in it, which has not the rounding of a t as large as m."""
    first, last = u < 1.5, u > m - 2.5
    end = torch.where(first, u, m - 1 - u)  # distance from the nearer end
    root = torch.sqrt(4.0 - 2.0 * torch.where(first | last, end, torch.ones_like(u)))  # guarded before the root
    inner = u - 0.5
    k = inner.detach().nan_to_num(0.0).floor().clamp(0, m - 3)  # an index must be in range, whatever u is
    k = torch.where(first, 0.0, torch.where(last, m - 3.0, k)).to(u.dtype)
    return k, torch.where(first, 2.0 - root, torch.where(last, root - 1.0, inner - k))


def position(t: Tensor, m: int) -> Tensor:
    """u(t) = 2t - t²/2, t + 1/2, or its mirror image in the last span: the inverse of `parameter`."""
    end = m - 2.0 - t
    return torch.where(t < 1, 2 * t - t * t / 2, torch.where(end < 1, m - 1 - 2 * end + end * end / 2, t + 0.5))


def basis(u: Tensor, m: int) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]:
    """The three non-zero basis functions at u and their derivatives in u; Wang et al. 2023, Eqs. 8-12.

    With s = t - k and q = 1 - s in span k: B_k = a q², B_{k+2} = b s², B_{k+1} = 1 - B_k - B_{k+2}, where a = 1 in
    the first span, b = 1 in the last and both are 1/2 otherwise (the four corner functions; as printed, B_{m-1} and the
    first piece of B_{m-2} run the wrong way, their true form is the mirror image of B_0 and B_1).  Since the control
    points are uniform, du/dt = Σ i B'_i = 2 (a q + b s).

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
    """(h, ∂h/∂u, ∂h/∂v) of Σ_i Σ_j B_i(u) B_j(v) h_ij: the nine non-zero products (Wang et al. 2023, Eqs. 2 and 6)."""
    m = heights.shape[0]
    ku, wu, du = basis(u, m)
    kv, wv, dv = basis(v, m)
    corner = ku * m + kv
    net = heights.reshape(-1).double()  # so that the adjoint sums in float64: float32 sums stop growing at 2^24 rays
    h = h_u = h_v = torch.zeros_like(u)
    for i in range(3):
        for j in range(3):
            p = net[corner + (i * m + j)].to(heights.dtype)
            h = h + wu[i] * wv[j] * p
            h_u = h_u + du[i] * wv[j] * p
            h_v = h_v + wu[i] * dv[j] * p
    return h, h_u, h_v


def evaluate(heights: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`evaluate_plain`, by a fused kernel where one serves these tensors (same values to rounding)."""
    if fused(heights, u, v):
        return spline.BSplineSag.apply(heights, *torch.broadcast_tensors(u, v))
    return evaluate_plain(heights, u, v)


def net_gradient(heights: Tensor, u: Tensor, v: Tensor, seeds: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """(m, m) the adjoint of `evaluate`: gradient in the heights of Σ g h + g_u ∂h/∂u + g_v ∂h/∂v, seeds (g, g_u, g_v).

    It is the same for all heights; those given say what net it is.
    """
    if fused(heights, u, v):
        return spline.net_gradient(heights, u, v, seeds)
    net = torch.zeros_like(heights, requires_grad=True)
    with torch.enable_grad():
        values = evaluate_plain(net, u, v)
    return torch.autograd.grad(values, net, seeds)[0]


def basis_matrix(u: np.ndarray, m: int, derivative: int = 0) -> scipy.sparse.csr_matrix:
    """Row r holds the basis functions (or their first derivative in u) at u[r]: banded, shape (len(u), m)."""
    points = torch.as_tensor(np.asarray(u, dtype=np.float64))
    k, *weights = basis(points, m)
    columns = (k[:, None] + torch.arange(3)).numpy()
    rows = np.arange(len(points) + 1) * 3
    values = torch.stack(weights[derivative], dim=1).numpy()
    return scipy.sparse.csr_matrix((values.ravel(), columns.ravel(), rows), shape=(len(points), m))


def prolongation(coarse: int, fine: int) -> np.ndarray:
    """The (fine, coarse) matrix that carries a net to more control points with least change of the surface.

    These knot vectors are not nested, so the finer net is the least-squares fit at eight points a span of the finer
    net; in two dimensions apply it along each axis.
    """
    u = np.linspace(0.0, 1.0, 8 * (fine - 2) + 1)
    on_fine = basis_matrix(u * (fine - 1), fine)
    on_coarse = basis_matrix(u * (coarse - 1), coarse)
    normal = on_fine.T @ on_fine  # banded; a dense solver's rounding depends on its number of threads
    bands = np.zeros((DEGREE + 1, fine))
    for k in range(DEGREE + 1):
        bands[DEGREE - k, k:] = normal.diagonal(k)
    return scipy.linalg.solveh_banded(bands, (on_fine.T @ on_coarse).toarray())
