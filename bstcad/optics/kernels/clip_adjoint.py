"""The adjoint of clip.py, which says what it needs of an edge; fused CPU kernels (numba)."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from bstcad.optics.kernels.compiling import compiled
from bstcad.optics.kernels.edge_walk import (
    ON,
    all_beside,
    along_edge,
    area_of,
    beyond,
    corner_at,
    half_square_off,
    in_one_cell,
    inlined,
    place_of,
    same_cell,
)

STRIP = 16  # rows of tubes whose gradient one thread takes at a time


@inlined
def _is_walked(thinnest, a, b, c):
    return not (all_beside(a, b, c) or in_one_cell(a, b, c)) and abs(area_of(a, b, c)) >= thinnest


@inlined
def _reversed(edge):
    """What `along_edge` says from b to a."""
    return -edge[0], edge[2], edge[1]


@inlined
def _triangle_adjoint(a, b, c, ab, bc, ca, flux):
    """(gradient in the six coordinates, gradient in the flux) of a triangle that is walked around, by its edges."""
    area = area_of(a, b, c)
    phi, w = ab[0] + bc[0] + ca[0], flux / area
    mean = phi / area
    q = -0.5 * w * mean
    ux, uy, vx, vy, wx, wy = b[0] - a[0], b[1] - a[1], c[0] - b[0], c[1] - b[1], a[0] - c[0], a[1] - c[1]
    return (
        w * (ab[1] * uy + ca[2] * wy) - q * vy, q * vx - w * (ab[1] * ux + ca[2] * wx),
        w * (ab[2] * uy + bc[1] * vy) - q * wy, q * wx - w * (ab[2] * ux + bc[1] * vx),
        w * (bc[2] * vy + ca[1] * wy) - q * uy, q * ux - w * (bc[2] * vx + ca[1] * wx),
        mean,
    )  # fmt: skip


@inlined
def _mean(g, a, b, c):
    """G where a triangle that is not walked around gives its flux to."""
    columns, rows = g.shape
    if all_beside(a, b, c):
        return 0.0
    i, j, where = a[2], a[3], a[4]
    if not in_one_cell(a, b, c):
        i, j, where = place_of((a[0] + b[0] + c[0]) / 3.0, (a[1] + b[1] + c[1]) / 3.0, columns, rows)
    return g[i, j] if where == ON else 0.0


@njit(error_model="numpy")
def _integrate_row(g, below_g, thinnest, corner, flux, k, in_flux, walked, known, edges):
    """Puts `along_edge` of the edges of the triangles of row k that are walked around into `edges`.

    walked (m, 3): which of a tube's triangles are, and whether it reaches beyond the screen.  edges: upper, lower,
    across (m, 3) and side (m + 1, 3) with the edges 03, 12, the diagonals, and 01.  Those of `upper` that are known
    (m,) from the row before stay as they are; afterwards `known` says which of `lower` are.
    """
    columns, rows = g.shape
    upper, lower, across, side = edges
    c0, c1 = corner_at(corner, k, 0, columns, rows), corner_at(corner, k + 1, 0, columns, rows)
    known_01 = False
    for r in range(flux.shape[1]):
        c3, c2 = corner_at(corner, k, r + 1, columns, rows), corner_at(corner, k + 1, r + 1, columns, rows)
        odd, first, second = (k + r) & 1, False, False
        where = c0[4] | c1[4] | c2[4] | c3[4]
        in_one = where == ON and in_one_cell(c0, c1, c2) and same_cell(c0, c3)
        if not in_one and (flux[k, r] != 0.0 or in_flux):
            first = _is_walked(thinnest, c0, c1, c3 if odd else c2)
            second = _is_walked(thinnest, c1 if odd else c0, c2, c3)
        walked[r, 0], walked[r, 1], walked[r, 2] = first, second, where != ON
        if first and not known_01:
            side[r, 0], side[r, 1], side[r, 2] = along_edge(g, below_g, c0, c1)
        if (first if odd else second) and not known[r]:
            upper[r, 0], upper[r, 1], upper[r, 2] = along_edge(g, below_g, c0, c3)
        known[r], known_01 = second if odd else first, second
        if second:
            side[r + 1, 0], side[r + 1, 1], side[r + 1, 2] = along_edge(g, below_g, c3, c2)
        if known[r]:
            lower[r, 0], lower[r, 1], lower[r, 2] = along_edge(g, below_g, c1, c2)
        if first or second:
            edge = along_edge(g, below_g, c1, c3) if odd else along_edge(g, below_g, c0, c2)
            across[r, 0], across[r, 1], across[r, 2] = edge
        c0, c1 = c3, c2


@njit(error_model="numpy")
def _add_row_adjoint(corner, flux, k, walked, edges, d_corner, d_flux):
    """Adds the gradient of the triangles of row k that are walked around, from the integrals along their edges."""
    upper, lower, across, side = edges
    ax, ay, bx, by = corner[0, k], corner[1, k], corner[0, k + 1], corner[1, k + 1]
    x0 = y0 = x1 = y1 = 0.0  # the gradient in corners 0 and 1, so far
    m = flux.shape[1]
    for r in range(m):
        x2 = y2 = x3 = y3 = mean = 0.0
        first, second = walked[r, 0], walked[r, 1]
        if first or second:
            half, odd = 0.5 * flux[k, r], (k + r) & 1
            c0, c1, c2, c3 = (ax[r], ay[r]), (bx[r], by[r]), (bx[r + 1], by[r + 1]), (ax[r + 1], ay[r + 1])
            e03, e12 = (upper[r, 0], upper[r, 1], upper[r, 2]), (lower[r, 0], lower[r, 1], lower[r, 2])
            edge = (across[r, 0], across[r, 1], across[r, 2])
            if first:
                e01 = (side[r, 0], side[r, 1], side[r, 2])
                if odd:
                    u, v, p, q, s, t, mean = _triangle_adjoint(c0, c1, c3, e01, edge, _reversed(e03), half)
                    x3, y3 = s, t
                else:
                    u, v, p, q, s, t, mean = _triangle_adjoint(c0, c1, c2, e01, e12, _reversed(edge), half)
                    x2, y2 = s, t
                x0, y0, x1, y1 = x0 + u, y0 + v, x1 + p, y1 + q
            if second:
                e23 = (-side[r + 1, 0], side[r + 1, 2], side[r + 1, 1])
                if odd:
                    u, v, p, q, s, t, more = _triangle_adjoint(c1, c2, c3, e12, e23, _reversed(edge), half)
                    x1, y1 = x1 + u, y1 + v
                else:
                    u, v, p, q, s, t, more = _triangle_adjoint(c0, c2, c3, edge, e23, _reversed(e03), half)
                    x0, y0 = x0 + u, y0 + v
                x2, y2, x3, y3, mean = x2 + p, y2 + q, x3 + s, y3 + t, mean + more
        if d_flux.size > 0:
            d_flux[k, r] = 0.5 * mean
        d_corner[0, k, r] += x0
        d_corner[1, k, r] += y0
        d_corner[0, k + 1, r] += x1
        d_corner[1, k + 1, r] += y1
        x0, y0, x1, y1 = x3, y3, x2, y2
    d_corner[0, k, m] += x0
    d_corner[1, k, m] += y0
    d_corner[0, k + 1, m] += x1
    d_corner[1, k + 1, m] += y1


@njit
def _add_rest_of_row(g, corner, flux, k, walked, g_outside, d_corner, d_flux):
    """Adds the gradient of the triangles that are not walked around, and of the light beyond the border."""
    columns, rows = g.shape
    for r in range(flux.shape[1]):
        if walked[r, 2] and flux[k, r] != 0.0:
            by = g_outside * 0.5 * flux[k, r]
            for i in range(k, k + 2):
                for j in range(r, r + 2):
                    d_corner[0, i, j] += by * beyond(corner[0, i, j], columns)
                    d_corner[1, i, j] += by * beyond(corner[1, i, j], rows)
        if d_flux.size > 0:
            c0, c1 = corner_at(corner, k, r, columns, rows), corner_at(corner, k + 1, r, columns, rows)
            c3, c2 = corner_at(corner, k, r + 1, columns, rows), corner_at(corner, k + 1, r + 1, columns, rows)
            odd, mean = (k + r) & 1, 0.0
            if not walked[r, 0]:
                mean += _mean(g, c0, c1, c3 if odd else c2)
            if not walked[r, 1]:
                mean += _mean(g, c1 if odd else c0, c2, c3)
            if walked[r, 2]:
                mean += g_outside * half_square_off(c0, c1, c2, c3, columns, rows)
            d_flux[k, r] += 0.5 * mean


@compiled(parallel=True)
def clip_adjoint(corner, flux, thinnest, g, below_g, g_outside, d_corner, d_flux):
    """Adds to d_corner; first the even strips of rows of tubes, then the odd ones: no two threads write one corner.

    d_flux (n, m) takes the gradient in the flux, if this is not empty; g (columns, rows), below_g (columns, rows + 1).
    """
    n, m = flux.shape
    strips = (n + STRIP - 1) // STRIP
    for parity in range(2):
        for half_c in prange((strips - parity + 1) // 2):
            first = (2 * half_c + parity) * STRIP
            upper, lower, across, side = np.empty((m, 3)), np.empty((m, 3)), np.empty((m, 3)), np.empty((m + 1, 3))
            walked, known, in_flux = np.empty((m, 3), np.bool_), np.zeros(m, np.bool_), d_flux.size > 0
            for k in range(first, min(n, first + STRIP)):
                edges = upper, lower, across, side
                _integrate_row(g, below_g, thinnest, corner, flux, k, in_flux, walked, known, edges)
                _add_row_adjoint(corner, flux, k, walked, edges, d_corner, d_flux)
                _add_rest_of_row(g, corner, flux, k, walked, g_outside, d_corner, d_flux)
                upper, lower = lower, upper
