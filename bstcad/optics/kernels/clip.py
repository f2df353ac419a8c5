"""Fused CPU kernels (numba) behind `tubes.collect`: triangles of light, cut exactly at the pixel borders.

A triangle of flux F and signed area A has the density F / A.  What of it falls into pixel (i, j) follows from Green's
theorem as a line integral along its edges,

    I_ij = F / A ∮ clip(j + 1 - y, 0, 1) dx   over the parts of the edges in column i,

so an edge is walked from pixel border to pixel border.  Its share goes to the pixel it crosses and, as one number, to
all pixels below that one; a running sum down the columns ends it.  The two triangles beside an edge run through it in
opposite senses: it is walked once, with the difference of their densities.  A triangle that lies in one pixel or has no
area gives its flux to a pixel and is not walked around, nor is one that lies beside the screen or nowhere; what is not
walked around has the density 0 for its edges, so that neither its density nor its corners reach its neighbours.

With G = ∂L/∂I and H(x, y) = ∫_y^∞ G dy the adjoint needs of each edge Φ = ∫ H dx (for ∂L/∂A) and ∫ (1 - s) G ds,
∫ s G ds (an edge that moves by δ across its normal n sweeps the area δ · n ds).  They are the same for both triangles.

All in pixels, x along columns, y down the rows.  Columns come first in the sums, as x does in a sheet of tubes: the
rows of tubes that one part takes reach few of them.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from bstcad.optics.kernels import reductions
from bstcad.optics.kernels.clip_adjoint import clip_adjoint
from bstcad.optics.kernels.compiling import compiled
from bstcad.optics.kernels.edge_walk import (
    ON,
    add_edge,
    all_beside,
    area_of,
    corner_at,
    half_square_off,
    in_one_cell,
    inlined,
    place_of,
    same_cell,
)

WIDE = 1e6  # pixels; a wider triangle may round its way into any column


@inlined
def _give(sums, i, j, flux):
    sums[i, j] += flux
    sums[i, j + 1] -= flux


@inlined
def _density(sums, thinnest, a, b, c, flux):
    """Flux per area of a triangle that is walked around; 0 of another, which gives its flux to a pixel instead."""
    if all_beside(a, b, c) or flux == 0.0:
        return 0.0
    i, j, where = a[2], a[3], a[4]
    if not in_one_cell(a, b, c):
        area = area_of(a, b, c)
        if abs(area) >= thinnest:
            return flux / area
        i, j, where = place_of((a[0] + b[0] + c[0]) / 3.0, (a[1] + b[1] + c[1]) / 3.0, sums.shape[0], sums.shape[1] - 1)
    if where == ON:
        _give(sums, i, j, flux)
    return 0.0


@njit(error_model="numpy")
def _add_row(sums, thinnest, corner, flux, k, upper):
    """Row k of tubes, and the edges between it and the row before; upper (m,): the densities on that side of them.

    Corners 0 and 3 of a tube lie in row k, 1 and 2 in row k + 1; the tube before shares 0 and 1.  Its triangles are 012
    and 023, or 013 and 123 where the diagonal runs the other way.  Returns Σ flux · (mean square of the corners'
    distance beyond the border), and leaves in `upper` the densities for the next row.
    """
    columns, rows = sums.shape[0], sums.shape[1] - 1
    c0, c1 = corner_at(corner, k, 0, columns, rows), corner_at(corner, k + 1, 0, columns, rows)
    before = far = 0.0
    for r in range(flux.shape[1]):
        c3, c2 = corner_at(corner, k, r + 1, columns, rows), corner_at(corner, k + 1, r + 1, columns, rows)
        half, odd = 0.5 * flux[k, r], (k + r) & 1
        where = c0[4] | c1[4] | c2[4] | c3[4]
        if where == ON and in_one_cell(c0, c1, c2) and same_cell(c0, c3):
            _give(sums, c0[2], c0[3], flux[k, r])
            first = second = 0.0
        elif odd:
            first, second = _density(sums, thinnest, c0, c1, c3, half), _density(sums, thinnest, c1, c2, c3, half)
            add_edge(sums, c1, c3, first - second)
        else:
            first, second = _density(sums, thinnest, c0, c1, c2, half), _density(sums, thinnest, c0, c2, c3, half)
            add_edge(sums, c2, c0, first - second)
        add_edge(sums, c0, c1, first - before)
        add_edge(sums, c0, c3, upper[r] - (first if odd else second))
        if where != ON and half != 0.0:
            far += half * half_square_off(c0, c1, c2, c3, columns, rows)
        upper[r], before, c0, c1 = second if odd else first, second, c3, c2
    add_edge(sums, c0, c1, -before)
    return far


@njit
def _add_end(sums, corner, k, upper):
    """The edges behind the last row of tubes."""
    columns, rows = sums.shape[0], sums.shape[1] - 1
    for r in range(upper.size):
        a, b = corner_at(corner, k, r, columns, rows), corner_at(corner, k, r + 1, columns, rows)
        add_edge(sums, a, b, upper[r])


@njit
def _clear_columns(own, reach, x):
    """Clear the columns that triangles between corners at x can reach; a walk's last step may be rounded beyond."""
    low, high = math.inf, -math.inf
    for k in range(x.shape[0]):
        for r in range(x.shape[1]):
            if x[k, r] < low:
                low = x[k, r]
            if x[k, r] > high:
                high = x[k, r]
    if high - low < WIDE:
        low, high = max(low - 1.0, 0.0), min(high + 2.0, float(own.shape[0]))
    else:
        low, high = 0.0, float(own.shape[0])
    if low < high:
        reductions.clear(own, reach, int(low), int(high))


@compiled(parallel=True)
def _clip(corner, flux, thinnest, sums, reach, outside):
    """Both triangles of each tube; corner (2, n + 1, m + 1), flux (n, m), sums (parts, columns, rows + 1).

    outside (parts,): Σ flux · (mean square of the corners' distance beyond the border).
    """
    n, m = flux.shape
    count = sums.shape[0]
    share = (n + count - 1) // count
    for c in prange(count):
        first, last = c * share, min(n, (c + 1) * share)
        outside[c] = 0.0
        if first < last:
            _clear_columns(sums[c], reach[c], corner[0, first : last + 1])
            upper = np.zeros(m)
            for k in range(first, last):
                outside[c] += _add_row(sums[c], thinnest, corner, flux, k, upper)
            _add_end(sums[c], corner, last, upper)


class Clip(torch.autograd.Function):
    """(corner (2, n + 1, m + 1) in pixels, flux (n, m), (rows, columns), thinnest in pixel²) -> (image, outside).

    Gradient in the corners and in the flux.
    """

    @staticmethod
    def forward(ctx, corner: Tensor, flux: Tensor, shape: tuple[int, int], thinnest: float):  # noqa: D102
        ctx.save_for_backward(corner, flux)
        ctx.thinnest = thinnest
        (rows, columns), count = shape, reductions.parts(flux.numel())
        (sums, reach), outside = reductions.buffers(count, columns, rows + 1), np.zeros(count)
        _clip(corner.detach().contiguous().numpy(), flux.detach().contiguous().numpy(), thinnest, sums, reach, outside)
        image = reductions.merged(sums, reach).cumsum(1)[:, :rows]
        return torch.from_numpy(image.T.copy()), torch.tensor(outside.sum())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g: Tensor, g_outside: Tensor):  # noqa: D102
        corner, flux = ctx.saved_tensors
        g = g.numpy().T.copy()
        below = np.zeros((g.shape[0], g.shape[1] + 1))
        below[:, :-1] = g[:, ::-1].cumsum(1)[:, ::-1]
        d_corner = torch.zeros(corner.shape, dtype=torch.float64)
        d_flux = torch.empty(flux.shape if ctx.needs_input_grad[1] else (0, 0), dtype=torch.float64)
        clip_adjoint(
            corner.detach().contiguous().numpy(), flux.detach().contiguous().numpy(), ctx.thinnest, g, below,
            float(g_outside), d_corner.numpy(), d_flux.numpy(),
        )  # fmt: skip
        return d_corner, d_flux if ctx.needs_input_grad[1] else None, None, None
