"""Fused CPU kernels (numba) behind `tubes.collect`: triangles of light, clipped exactly at the pixel borders.

A triangle of flux F and signed area A has the density F / A.  By Green's theorem its flux in pixel (i, j) is

    I_ij = F / A ∮ clip(j + 1 - y, 0, 1) dx   over the parts of the edges in column i,

so each edge is followed from pixel border to pixel border.  A piece of it adds to the pixel it crosses and, as one
number, to all pixels below; a running sum down the columns completes the picture.  The two triangles beside an edge
traverse it in opposite senses, so it is followed once, with the difference of their densities.  Some triangles are not
followed: one that lies in one pixel or is too thin gives its flux to a pixel, and one outside the screen or with an
invalid corner gives none.  Along its edges the density of such a triangle is 0: only its neighbours count there.

With L the merit function, G = ∂L/∂I and H(x, y) = ∫_y^∞ G dy, the adjoint needs for each edge Φ = ∫ H dx (for ∂L/∂A)
and ∫ (1 - s) G ds, ∫ s G ds, s = 0 … 1 along the edge (an edge that moves by δ sweeps the area δ · n ds, n its normal).
They are computed once for the two triangles beside the edge.

All lengths but those of the corners in memory are in pixels, x across the columns, y down the rows.  Columns are the
first index of the sums, as x is that of the tubes: so the rows of tubes of one part, which one thread computes, reach
few columns.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from bstcad.optics.numerics import reductions
from bstcad.optics.numerics.compiling import compiled
from bstcad.optics.receivers.irradiance import Scale

MAX_DISTANCE = 1e15  # largest |x| + |y| of a corner (pixels); farther away, rounding approaches a pixel
NO_BORDER = 1e300  # s of the next border of an edge that crosses no more borders along an axis
FEW_PARTS, MANY_CELLS = 8, 1 << 21  # most partial sums of a picture of MANY_CELLS or more, for its memory
MAX_WIDTH = 1e6  # extent in x of the corners of one part (pixels), above which rounding may reach any column
ROWS_PER_STRIP = 16  # rows of tubes whose gradient one thread computes at a time

ON, OUT_OF_RANGE = 0, 16  # state of a corner: on the screen; outside MAX_DISTANCE or not a number
LEFT, RIGHT, ABOVE, BELOW = 1, 2, 4, 8  # bits of the state of a corner outside one or two borders of the screen

inlined = njit(forceinline=True, error_model="numpy")


# --- corners and triangles --------------------------------------------------------------------------------------------


@inlined
def pixel_at(x, y, columns, rows):
    """Return (column, row, state) of a point; outside the screen, column is -1 or `columns`, or row is -1 or `rows`."""
    if 0.0 <= x < columns and 0.0 <= y < rows:
        return int(x), int(y), ON
    if not abs(x) + abs(y) < MAX_DISTANCE:
        return 0, 0, OUT_OF_RANGE
    i, j = int(math.floor(min(max(x, -1.0), float(columns)))), int(math.floor(min(max(y, -1.0), float(rows))))
    return i, j, LEFT * (i < 0) + RIGHT * (i >= columns) + ABOVE * (j < 0) + BELOW * (j >= rows)


@inlined
def point_at(corner, scale, k, r):
    """Return (x, y) of the corner (k, r)."""
    return (corner[0, k, r] - scale[0]) * scale[2], (corner[1, k, r] - scale[1]) * scale[3]


@inlined
def corner_at(corner, scale, k, r, columns, rows):
    """Return (x, y, column, row, state) of the corner (k, r)."""
    x, y = point_at(corner, scale, k, r)
    i, j, state = pixel_at(x, y, columns, rows)
    return x, y, i, j, state


@inlined
def same_cell(a, b):
    """Return True if two corners lie in one pixel or in one cell outside the screen."""
    return a[2] == b[2] and a[3] == b[3]


@inlined
def in_one_cell(a, b, c):
    """Return True if three corners lie in one pixel or in one cell outside the screen."""
    return same_cell(a, b) and same_cell(a, c)


@inlined
def misses_screen(a, b, c):
    """Return True if three corners lie outside the same side of the screen, or one of them is invalid."""
    return (a[4] & b[4] & c[4]) | ((a[4] | b[4] | c[4]) & OUT_OF_RANGE) != 0


@inlined
def area_of(a, b, c):
    """Return the signed area of a triangle (pixel²)."""
    return 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]))


@inlined
def outside(p, size):
    """Return the signed distance (pixels) of a coordinate p outside 0 … size; 0 inside."""
    return p - min(max(p, 0.0), size)


@inlined
def half_square_outside(a, b, c, d, columns, rows):
    """Return half the sum of the corners' squared distances outside the border."""
    square = outside(a[0], columns) ** 2 + outside(b[0], columns) ** 2
    square += outside(c[0], columns) ** 2 + outside(d[0], columns) ** 2
    square += outside(a[1], rows) ** 2 + outside(b[1], rows) ** 2
    square += outside(c[1], rows) ** 2 + outside(d[1], rows) ** 2
    return 0.5 * square


# --- along one edge ---------------------------------------------------------------------------------------------------


@inlined
def _first_border(start, cell, d, size):
    """Return (step, s of the next border, s between borders) on an axis; edge from `start` in `cell` to start + d."""
    if d > 0.0 and cell < size:
        return 1, (cell + 1 - start) / d, 1.0 / d
    if d < 0.0 and cell >= 0:
        return -1, (cell - start) / d, -1.0 / d
    return 0, NO_BORDER, NO_BORDER


@inlined
def _next_border(cell, step, size, s, spacing):
    """Return (cell, s of the next border) behind the border at s."""
    cell += step
    return cell, NO_BORDER if (cell < 0 or cell >= size) else s + spacing


@inlined
def _one_border(a, b):
    """Return s at the border between the neighbouring pixels of a and b."""
    if a[2] != b[2]:
        return (max(a[2], b[2]) - a[0]) / (b[0] - a[0])
    return (max(a[3], b[3]) - a[1]) / (b[1] - a[1])


@inlined
def _add_piece(sums, i, j, share, middle):
    """Add a piece of an edge in pixel (i, j), with midpoint y = `middle`; share: its dx times the density."""
    below = middle - j
    sums[i, j] += share * (1.0 - below)
    sums[i, j + 1] += share * below


@inlined
def add_edge(sums, a, b, density):
    """Add an edge's density · ∫ clip(j + 1 - y, 0, 1) dx to sums (columns, rows + 1), as differences down the rows."""
    if density == 0.0:
        return
    if a[4] | b[4] == ON:
        borders = abs(a[2] - b[2]) + abs(a[3] - b[3])
        share, dy = (b[0] - a[0]) * density, b[1] - a[1]
        if borders == 0:
            _add_piece(sums, a[2], a[3], share, a[1] + 0.5 * dy)
            return
        if borders == 1:
            s = _one_border(a, b)
            _add_piece(sums, a[2], a[3], s * share, a[1] + 0.5 * s * dy)
            _add_piece(sums, b[2], b[3], (1.0 - s) * share, a[1] + 0.5 * (1.0 + s) * dy)
            return
    _add_long_edge(sums, a, b, density)


@njit(error_model="numpy")
def _add_long_edge(sums, a, b, density):
    """Do what `add_edge` does, for an edge that crosses any number of borders."""
    columns, rows = sums.shape[0], sums.shape[1] - 1
    ax, ay, i, j, _ = a
    dx, dy = b[0] - ax, b[1] - ay
    if dx == 0.0:
        return
    step_x, next_x, spacing_x = _first_border(ax, i, dx, columns)
    step_y, next_y, spacing_y = _first_border(ay, j, dy, rows)
    s = 0.0
    while True:
        end = min(next_x, next_y, 1.0)
        if 0 <= i < columns and j < rows:
            share = (end - s) * dx * density
            if j < 0:
                sums[i, 0] += share
            else:
                _add_piece(sums, i, j, share, ay + 0.5 * (s + end) * dy)
        if not end < 1.0:
            return
        s = end
        if next_x < next_y:
            i, next_x = _next_border(i, step_x, columns, next_x, spacing_x)
        else:
            j, next_y = _next_border(j, step_y, rows, next_y, spacing_y)


@inlined
def _piece_values(g, below_g, i, j, middle):
    """Return (G, mean H) of a piece of an edge in pixel (i, j), with its midpoint at y = `middle`."""
    value = g[i, j]
    return value, below_g[i, j + 1] + (j + 1 - middle) * value


@inlined
def along_edge(g, below_g, a, b):
    """Return (∫ H dx, ∫ (1 - s) G ds, ∫ s G ds) along an edge; below_g[i, j]: sum of g[i, j:]."""
    if a[4] | b[4] == ON:
        borders = abs(a[2] - b[2]) + abs(a[3] - b[3])
        dx, dy = b[0] - a[0], b[1] - a[1]
        if borders == 0:
            value, h = _piece_values(g, below_g, a[2], a[3], a[1] + 0.5 * dy)
            return h * dx, 0.5 * value, 0.5 * value
        if borders == 1:
            s = _one_border(a, b)
            one, phi_one = _piece_values(g, below_g, a[2], a[3], a[1] + 0.5 * s * dy)
            two, phi_two = _piece_values(g, below_g, b[2], b[3], a[1] + 0.5 * (1.0 + s) * dy)
            whole, second = s * one + (1.0 - s) * two, 0.5 * (s * s * one + (1.0 - s) * (1.0 + s) * two)
            return (s * phi_one + (1.0 - s) * phi_two) * dx, whole - second, second
    return _along_long_edge(g, below_g, a, b)


@njit(error_model="numpy")
def _along_long_edge(g, below_g, a, b):
    """Do what `along_edge` does, for an edge that crosses any number of borders."""
    columns, rows = g.shape
    ax, ay, i, j, _ = a
    dx, dy = b[0] - ax, b[1] - ay
    step_x, next_x, spacing_x = _first_border(ax, i, dx, columns)
    step_y, next_y, spacing_y = _first_border(ay, j, dy, rows)
    s = phi = whole = second = 0.0
    while True:
        end = min(next_x, next_y, 1.0)
        if 0 <= i < columns and j < rows:
            length = end - s
            if j < 0:
                phi += length * below_g[i, 0]
            else:
                middle = 0.5 * (s + end)
                value, h = _piece_values(g, below_g, i, j, ay + middle * dy)
                phi += length * h
                whole += length * value
                second += length * middle * value
        if not end < 1.0:
            return phi * dx, whole - second, second
        s = end
        if next_x < next_y:
            i, next_x = _next_border(i, step_x, columns, next_x, spacing_x)
        else:
            j, next_y = _next_border(j, step_y, rows, next_y, spacing_y)


@inlined
def _add_to_pixel(sums, i, j, flux):
    sums[i, j] += flux
    sums[i, j + 1] -= flux


@inlined
def _density(sums, thinnest, a, b, c, flux):
    """Return the flux per area of a triangle; if it is not followed, add its flux to a pixel and return 0."""
    if misses_screen(a, b, c) or flux == 0.0:
        return 0.0
    i, j, state = a[2], a[3], a[4]
    if not in_one_cell(a, b, c):
        area = area_of(a, b, c)
        if abs(area) >= thinnest:
            return flux / area
        i, j, state = pixel_at((a[0] + b[0] + c[0]) / 3.0, (a[1] + b[1] + c[1]) / 3.0, sums.shape[0], sums.shape[1] - 1)
    if state == ON:
        _add_to_pixel(sums, i, j, flux)
    return 0.0


@njit(error_model="numpy")
def _add_row(sums, thinnest, corner, scale, flux, k, upper):
    """Add row k of tubes and the edges between it and the row before, whose densities `upper` (m,) contains.

    Corners 0 and 3 of a tube lie in row k, 1 and 2 in row k + 1; the tube before shares 0 and 1.  The triangles are 012
    and 023, or 013 and 123 where the diagonal runs the other way.  Returns Σ flux · (mean square of the corners'
    distance outside the border), and stores in `upper` the densities for the next row.
    """
    columns, rows = sums.shape[0], sums.shape[1] - 1
    c0, c1 = corner_at(corner, scale, k, 0, columns, rows), corner_at(corner, scale, k + 1, 0, columns, rows)
    before = far = 0.0
    for r in range(flux.shape[1]):
        c3, c2 = (
            corner_at(corner, scale, k, r + 1, columns, rows),
            corner_at(corner, scale, k + 1, r + 1, columns, rows),
        )
        half, odd = 0.5 * flux[k, r], (k + r) & 1
        state = c0[4] | c1[4] | c2[4] | c3[4]
        if state == ON and in_one_cell(c0, c1, c2) and same_cell(c0, c3):
            _add_to_pixel(sums, c0[2], c0[3], flux[k, r])
            first = second = 0.0
        elif odd:
            first, second = _density(sums, thinnest, c0, c1, c3, half), _density(sums, thinnest, c1, c2, c3, half)
            add_edge(sums, c1, c3, first - second)
        else:
            first, second = _density(sums, thinnest, c0, c1, c2, half), _density(sums, thinnest, c0, c2, c3, half)
            add_edge(sums, c2, c0, first - second)
        add_edge(sums, c0, c1, first - before)
        add_edge(sums, c0, c3, upper[r] - (first if odd else second))
        if state != ON and half != 0.0:
            far += half * half_square_outside(c0, c1, c2, c3, columns, rows)
        upper[r], before, c0, c1 = second if odd else first, second, c3, c2
    add_edge(sums, c0, c1, -before)
    return far


@njit
def _add_end(sums, corner, scale, k, upper):
    """Add the edges behind the last row of tubes."""
    columns, rows = sums.shape[0], sums.shape[1] - 1
    for r in range(upper.size):
        a, b = corner_at(corner, scale, k, r, columns, rows), corner_at(corner, scale, k, r + 1, columns, rows)
        add_edge(sums, a, b, upper[r])


@njit
def _clear_columns(own, touched, corner, scale):
    """Clear the columns of `own` that triangles between the corners can reach, with a margin for rounding."""
    low, high = math.inf, -math.inf
    for k in range(corner.shape[1]):
        for r in range(corner.shape[2]):
            x = (corner[0, k, r] - scale[0]) * scale[2]
            if x < low:
                low = x
            if x > high:
                high = x
    if high - low < MAX_WIDTH:
        low, high = max(low - 1.0, 0.0), min(high + 2.0, float(own.shape[0]))
    else:
        low, high = 0.0, float(own.shape[0])
    if low < high:
        reductions.clear(own, touched, int(low), int(high))


@compiled(threads_by="flux")
def _clip(corner, scale, flux, thinnest, sums, touched, far):
    """Add the flux of the two triangles of each tube to `sums`, (parts, columns, rows + 1), and set `far`, (parts,).

    corner (2, n + 1, m + 1): corners of the tubes.  scale (x_0, y_0, s_x, s_y): pixels are (x - x_0) s_x and
    (y - y_0) s_y.  flux (n, m): flux of the tubes.  thinnest: smallest area of a triangle that is followed (pixels²).
    touched (parts, 2): range of the columns of `sums` that are in use.
    far: Σ flux · (mean square of the distance by which the corners lie outside the border).
    """
    n, m = flux.shape
    count = sums.shape[0]
    share = (n + count - 1) // count
    for c in prange(count):
        first, last = c * share, min(n, (c + 1) * share)
        far[c] = 0.0
        if first < last:
            _clear_columns(sums[c], touched[c], corner[:, first : last + 1], scale)
            upper = np.zeros(m)
            for k in range(first, last):
                far[c] += _add_row(sums[c], thinnest, corner, scale, flux, k, upper)
            _add_end(sums[c], corner, scale, last, upper)


@compiled(threads_by="image")
def _running_sums(sums, touched, image):
    """Set image (columns, rows) to the running sums down the columns of the sum of all parts, added in their order."""
    columns, rows = image.shape
    for i in prange(columns):
        image[i, :] = 0.0
        for c in range(sums.shape[0]):
            if touched[c, 0] <= i < touched[c, 1]:
                for j in range(rows):
                    image[i, j] += sums[c, i, j]
        for j in range(1, rows):
            image[i, j] += image[i, j - 1]


@compiled(threads_by="g")
def _sums_below(g, below):
    """Set below[i, j] to the sum of g[i, j:], for j up to the number of rows."""
    columns, rows = g.shape
    for i in prange(columns):
        whole = 0.0
        below[i, rows] = whole
        for j in range(rows - 1, -1, -1):
            whole += g[i, j]
            below[i, j] = whole


# --- the adjoint ------------------------------------------------------------------------------------------------------


@inlined
def _is_followed(thinnest, a, b, c):
    return not (misses_screen(a, b, c) or in_one_cell(a, b, c)) and abs(area_of(a, b, c)) >= thinnest


@inlined
def _reversed(edge):
    """Return the integrals of `along_edge` for the edge traversed backwards."""
    return -edge[0], edge[2], edge[1]


@inlined
def _triangle_adjoint(a, b, c, ab, bc, ca, flux):
    """Return (gradients in a, b and c, gradient in the flux) of a triangle abc; ab, bc, ca: its edges' `along_edge`."""
    area = area_of(a, b, c)
    phi, w = ab[0] + bc[0] + ca[0], flux / area
    mean = phi / area
    q = -0.5 * w * mean
    ux, uy, vx, vy, wx, wy = b[0] - a[0], b[1] - a[1], c[0] - b[0], c[1] - b[1], a[0] - c[0], a[1] - c[1]
    d_a = w * (ab[1] * uy + ca[2] * wy) - q * vy, q * vx - w * (ab[1] * ux + ca[2] * wx)
    d_b = w * (ab[2] * uy + bc[1] * vy) - q * wy, q * wx - w * (ab[2] * ux + bc[1] * vx)
    d_c = w * (bc[2] * vy + ca[1] * wy) - q * uy, q * ux - w * (bc[2] * vx + ca[1] * wx)
    return d_a, d_b, d_c, mean


@inlined
def _mean(g, a, b, c):
    """Return G at the pixel that receives the flux of a triangle which is not followed."""
    columns, rows = g.shape
    if misses_screen(a, b, c):
        return 0.0
    i, j, state = a[2], a[3], a[4]
    if not in_one_cell(a, b, c):
        i, j, state = pixel_at((a[0] + b[0] + c[0]) / 3.0, (a[1] + b[1] + c[1]) / 3.0, columns, rows)
    return g[i, j] if state == ON else 0.0


@njit(error_model="numpy")
def _integrate_row(g, below_g, thinnest, corner, scale, flux, k, in_flux, flags, known, edges):
    """Store in `edges` the integrals `along_edge` of the edges of those triangles of row k that are followed.

    flags (m, 3): True for the first and the second triangle of a tube if it is followed, and for a tube that extends
    outside the screen.  edges: upper, lower, across (m, 3) and side (m + 1, 3), for the edges 03, 12, the diagonals and
    01.  known (m,): True for edges of `upper` that the row before has computed; on return, for those of `lower`.
    in_flux: True if the gradient in the flux is needed.
    """
    columns, rows = g.shape
    upper, lower, across, side = edges
    c0, c1 = corner_at(corner, scale, k, 0, columns, rows), corner_at(corner, scale, k + 1, 0, columns, rows)
    known_01 = False
    for r in range(flux.shape[1]):
        c3, c2 = (
            corner_at(corner, scale, k, r + 1, columns, rows),
            corner_at(corner, scale, k + 1, r + 1, columns, rows),
        )
        odd, first, second = (k + r) & 1, False, False
        state = c0[4] | c1[4] | c2[4] | c3[4]
        in_one = state == ON and in_one_cell(c0, c1, c2) and same_cell(c0, c3)
        if not in_one and (flux[k, r] != 0.0 or in_flux):
            first = _is_followed(thinnest, c0, c1, c3 if odd else c2)
            second = _is_followed(thinnest, c1 if odd else c0, c2, c3)
        flags[r, 0], flags[r, 1], flags[r, 2] = first, second, state != ON
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
def _add_row_adjoint(corner, scale, flux, k, flags, edges, d_corner, d_flux):
    """Add the gradient of the triangles of row k that are followed, from the integrals along their edges."""
    upper, lower, across, side = edges
    _, _, per_x, per_y = scale
    x0 = y0 = x1 = y1 = 0.0  # sums of the gradient in corners 0 and 1
    m = flux.shape[1]
    for r in range(m):
        x2 = y2 = x3 = y3 = mean = 0.0
        first, second = flags[r, 0], flags[r, 1]
        if first or second:
            half, odd = 0.5 * flux[k, r], (k + r) & 1
            c0, c1 = point_at(corner, scale, k, r), point_at(corner, scale, k + 1, r)
            c3, c2 = point_at(corner, scale, k, r + 1), point_at(corner, scale, k + 1, r + 1)
            e03, e12 = (upper[r, 0], upper[r, 1], upper[r, 2]), (lower[r, 0], lower[r, 1], lower[r, 2])
            edge = (across[r, 0], across[r, 1], across[r, 2])
            if first:
                e01 = (side[r, 0], side[r, 1], side[r, 2])
                if odd:
                    (u, v), (p, q), (x3, y3), mean = _triangle_adjoint(c0, c1, c3, e01, edge, _reversed(e03), half)
                else:
                    (u, v), (p, q), (x2, y2), mean = _triangle_adjoint(c0, c1, c2, e01, e12, _reversed(edge), half)
                x0, y0, x1, y1 = x0 + u, y0 + v, x1 + p, y1 + q
            if second:
                e23 = (-side[r + 1, 0], side[r + 1, 2], side[r + 1, 1])
                if odd:
                    (u, v), (p, q), (s, t), more = _triangle_adjoint(c1, c2, c3, e12, e23, _reversed(edge), half)
                    x1, y1 = x1 + u, y1 + v
                else:
                    (u, v), (p, q), (s, t), more = _triangle_adjoint(c0, c2, c3, edge, e23, _reversed(e03), half)
                    x0, y0 = x0 + u, y0 + v
                x2, y2, x3, y3, mean = x2 + p, y2 + q, x3 + s, y3 + t, mean + more
        if d_flux.size > 0:
            d_flux[k, r] = 0.5 * mean
        d_corner[0, k, r] += per_x * x0
        d_corner[1, k, r] += per_y * y0
        d_corner[0, k + 1, r] += per_x * x1
        d_corner[1, k + 1, r] += per_y * y1
        x0, y0, x1, y1 = x3, y3, x2, y2
    d_corner[0, k, m] += per_x * x0
    d_corner[1, k, m] += per_y * y0
    d_corner[0, k + 1, m] += per_x * x1
    d_corner[1, k + 1, m] += per_y * y1


@njit
def _add_rest_of_row(g, corner, scale, flux, k, flags, g_far, d_corner, d_flux):
    """Add the gradient of the triangles that are not followed, and of the light outside the border."""
    columns, rows = g.shape
    for r in range(flux.shape[1]):
        if flags[r, 2] and flux[k, r] != 0.0:
            weight = g_far * 0.5 * flux[k, r]
            for i in range(k, k + 2):
                for j in range(r, r + 2):
                    x, y = point_at(corner, scale, i, j)
                    d_corner[0, i, j] += weight * scale[2] * outside(x, columns)
                    d_corner[1, i, j] += weight * scale[3] * outside(y, rows)
        if d_flux.size > 0:
            c0, c1 = corner_at(corner, scale, k, r, columns, rows), corner_at(corner, scale, k + 1, r, columns, rows)
            c3, c2 = (
                corner_at(corner, scale, k, r + 1, columns, rows),
                corner_at(corner, scale, k + 1, r + 1, columns, rows),
            )
            odd, mean = (k + r) & 1, 0.0
            if not flags[r, 0]:
                mean += _mean(g, c0, c1, c3 if odd else c2)
            if not flags[r, 1]:
                mean += _mean(g, c1 if odd else c0, c2, c3)
            if flags[r, 2]:
                mean += g_far * half_square_outside(c0, c1, c2, c3, columns, rows)
            d_flux[k, r] += 0.5 * mean


@compiled(threads_by="flux")
def clip_adjoint(corner, scale, flux, thinnest, g, below_g, g_far, d_corner, d_flux):
    """Add the gradient in the corners to d_corner; store the gradient in the flux in d_flux, (n, m) or empty.

    g (columns, rows), g_far: gradients in the picture and in `far` of `_clip`.  below_g: see `along_edge`.  The even
    strips of rows of tubes are computed first, then the odd ones, so that no two threads write one corner.
    """
    n, m = flux.shape
    strips = (n + ROWS_PER_STRIP - 1) // ROWS_PER_STRIP
    for parity in range(2):
        for half_c in prange((strips - parity + 1) // 2):
            first = (2 * half_c + parity) * ROWS_PER_STRIP
            upper, lower, across, side = np.empty((m, 3)), np.empty((m, 3)), np.empty((m, 3)), np.empty((m + 1, 3))
            flags, known, in_flux = np.empty((m, 3), np.bool_), np.zeros(m, np.bool_), d_flux.size > 0
            for k in range(first, min(n, first + ROWS_PER_STRIP)):
                edges = upper, lower, across, side
                _integrate_row(g, below_g, thinnest, corner, scale, flux, k, in_flux, flags, known, edges)
                _add_row_adjoint(corner, scale, flux, k, flags, edges, d_corner, d_flux)
                _add_rest_of_row(g, corner, scale, flux, k, flags, g_far, d_corner, d_flux)
                upper, lower = lower, upper


class Clip(torch.autograd.Function):
    """Map (corner (2, n + 1, m + 1), flux (n, m), picture, thinnest) to (picture, Σ far): see `_clip`.

    picture: its (rows, columns) and its scale.  The gradient is taken in the corners and in the flux.
    """

    @staticmethod
    def forward(  # noqa: D102
        ctx: Any, corner: Tensor, flux: Tensor, picture: tuple[tuple[int, int], Scale], thinnest: float
    ) -> Any:
        ctx.save_for_backward(corner, flux)
        ((rows, columns), scale), count = picture, reductions.parts(flux.numel())
        if rows * columns >= MANY_CELLS:
            count = min(count, FEW_PARTS)
        ctx.scale, ctx.thinnest = scale, thinnest
        (sums, touched), far = reductions.buffers(count, columns, rows + 1), np.zeros(count)
        _clip(_array(corner), scale, _array(flux), thinnest, sums, touched, far)
        image = np.empty((columns, rows))
        _running_sums(sums, touched, image)
        return torch.from_numpy(image).T, torch.tensor(far.sum())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g: Tensor, g_far: Tensor) -> Any:  # noqa: D102
        corner, flux = ctx.saved_tensors
        by_column = np.ascontiguousarray(g.numpy().T)
        columns, rows = by_column.shape
        below = np.empty((columns, rows + 1))
        _sums_below(by_column, below)
        d_corner = torch.zeros(corner.shape, dtype=torch.float64)
        d_flux = torch.empty(flux.shape if ctx.needs_input_grad[1] else (0, 0), dtype=torch.float64)
        tubes, adjoints = (_array(corner), ctx.scale, _array(flux), ctx.thinnest), (d_corner.numpy(), d_flux.numpy())
        clip_adjoint(*tubes, by_column, below, float(g_far), *adjoints)
        return d_corner, d_flux if ctx.needs_input_grad[1] else None, None, None


def _array(t: Tensor) -> np.ndarray:
    return t.detach().contiguous().numpy()
