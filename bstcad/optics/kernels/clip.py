"""Fused CPU kernels (numba) behind `tubes.collect`: triangles of light, clipped exactly at the pixel borders.

A triangle of flux F and signed area A has the density F / A.  By Green's theorem its flux in pixel (i, j) is

    I_ij = F / A ∮ clip(j + 1 - y, 0, 1) dx   over the parts of the edges in column i,

so each edge is followed from pixel border to pixel border (clip_edges.py).  A piece of it adds to the pixel it crosses
and, as one number, to all pixels below; a running sum down the columns completes the picture.  The two triangles beside
an edge traverse it in opposite senses, so it is followed once, with the difference of their densities.  Most tubes have
one density (`tubes.triangle_fluxes`): then the diagonal between their triangles is not followed.  These even tubes are
computed in vectors, and the others one by one.  Some triangles are not followed: one that lies in one pixel or is too
thin gives its flux to a pixel, and one outside the screen or with an invalid corner gives none.  Along its edges the
density of such a triangle is 0: only its neighbours count there.

With L the merit function, G = ∂L/∂I and H(x, y) = ∫_y^∞ G dy, the adjoint needs for each edge Φ = ∫ H dx (for ∂L/∂A)
and ∫ (1 - s) G ds, ∫ s G ds, s = 0 … 1 along the edge (an edge that moves by δ sweeps the area δ · n ds, n its normal).
They are computed once for the two triangles beside the edge.

All lengths but those of the corners in memory are in pixels, x across the columns, y down the rows.  Columns are the
first index of the sums, as x is that of the tubes: so the rows of tubes of one part, which one thread computes, reach
few columns.

Corners 0 and 3 of a tube lie in row k, 1 and 2 in row k + 1; the tube before shares 0 and 1.  The triangles are 012 and
023, or 013 and 123 where the diagonal runs the other way (in odd tubes).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from bstcad.optics.kernels.clip_edges import (
    BLOCK,
    COLUMN,
    EDGES_END,
    ENDS,
    LENGTH,
    LOWER,
    ON,
    OUT_OF_RANGE,
    ROW,
    STARTS,
    STATE,
    UPPER,
    Y,
    add_edges,
    copy_corners,
    corner_at,
    inlined,
    integrals_along,
    load_corners,
    put_corner,
)
from bstcad.optics.numerics import reductions
from bstcad.optics.numerics.compiling import compiled
from bstcad.optics.receivers.irradiance import Scale

FEW_PARTS, MANY_CELLS = 8, 1 << 21  # most partial sums of a picture of MANY_CELLS or more, for its memory
MAX_WIDTH = 1e6  # extent in x of the corners of one part (pixels), above which rounding may reach any column
ROWS_PER_STRIP = 16  # rows of tubes whose gradient one thread computes at a time

UNEVEN, EVEN, IN_PIXEL = 0.0, 1.0, 2.0  # kinds of tubes; even tubes lie on the screen, and the last kind in one pixel
# Offsets in `work` of the quantities of tubes: flux; kind; density of the triangle with the edge 01, of that with the
# edge 23, with the edge 12 below, and with the edge 03 above; density above the edge 03; density of edges.
FLUX, KIND, FIRST, SECOND, BELOW, ABOVE, BEFORE, WEIGHT = (EDGES_END + LENGTH * k for k in range(8))
CLIP_WORK = EDGES_END + LENGTH * 8  # length of `work` for a picture
# Offsets for the adjoint: numbers of the uneven tubes; integrals along the edges 03, 12, 01 and the diagonal
# (`integrals_along`); the gradient in x and y of the corners 0 to 3.
NUMBER, ALONG_03, ALONG_12, ALONG_01, ALONG_DIAGONAL = (CLIP_WORK + LENGTH * k for k in (0, 1, 4, 7, 10))
G_0, G_1, G_2, G_3 = (CLIP_WORK + LENGTH * k for k in (13, 15, 17, 19))
ADJOINT_WORK = CLIP_WORK + LENGTH * 21  # length of `work` for the adjoint


# --- tubes and triangles ----------------------------------------------------------------------------------------------


@inlined
def pixel_at(x, y, columns, rows):
    """Return (column, row, True if on the screen) of a point."""
    on = (0.0 <= x < columns) & (0.0 <= y < rows)
    return (int(x) if on else 0), (int(y) if on else 0), on


@inlined
def in_one_cell(triangle):
    """Return True if three corners lie in one pixel or in one cell outside the screen."""
    a, b, c = triangle
    return (a[2] == b[2]) & (a[3] == b[3]) & (a[2] == c[2]) & (a[3] == c[3])


@inlined
def misses_screen(triangle):
    """Return True if three corners lie outside the same side of the screen, or one of them is invalid."""
    a, b, c = triangle
    return (a[4] & b[4] & c[4]) | ((a[4] | b[4] | c[4]) & OUT_OF_RANGE) != 0


@inlined
def area_of(triangle):
    """Return the signed area of a triangle (pixel²)."""
    a, b, c = triangle
    return 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]))


@inlined
def outside(p, size):
    """Return the signed distance (pixels) of a coordinate p outside 0 … size; 0 inside."""
    return p - min(max(p, 0.0), size)


@inlined
def half_square_outside(tube, columns, rows):
    """Return half the sum of the corners' squared distances outside the border."""
    a, b, c, d = tube
    square = outside(a[0], columns) ** 2 + outside(b[0], columns) ** 2
    square += outside(c[0], columns) ** 2 + outside(d[0], columns) ** 2
    square += outside(a[1], rows) ** 2 + outside(b[1], rows) ** 2
    square += outside(c[1], rows) ** 2 + outside(d[1], rows) ** 2
    return 0.5 * square


@inlined
def _tube_at(r, work):
    """Return the corners of a tube."""
    c0, c3 = corner_at(UPPER, r, work), corner_at(UPPER, r + 1, work)
    return c0, corner_at(LOWER, r, work), corner_at(LOWER, r + 1, work), c3


@inlined
def _triangles_of(tube, odd):
    """Return the triangle of a tube with the edge 01, and that with the edge 23."""
    c0, c1, c2, c3 = tube
    return (c0, c1, c3 if odd else c2), (c1 if odd else c0, c2, c3)


@inlined
def _is_followed(thinnest, triangle):
    return not (misses_screen(triangle) or in_one_cell(triangle)) and abs(area_of(triangle)) >= thinnest


@inlined
def _switch(rules, difference):
    """Return (w, dw/d(difference)) of `tubes.triangle_fluxes`, between the limits of `rules`."""
    _, even, uneven = rules
    t = min(max((difference - even) / (uneven - even), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t), 6.0 * t * (1.0 - t) / (uneven - even)


@inlined
def _densities(rules, tube, odd):
    """Return the densities of the two triangles of a tube of flux 1, and their derivatives (4) in the two areas.

    Density d_1 in the areas A_1 and A_2, then d_2.  A triangle that is not followed has the density 0.
    """
    first, second = _triangles_of(tube, odd)
    one, two = area_of(first), area_of(second)
    known = (tube[0][4] | tube[1][4] | tube[2][4] | tube[3][4]) & OUT_OF_RANGE == 0
    beside = tube[0][4] & tube[1][4] & tube[2][4] & tube[3][4] != 0  # all corners, outside one side of the screen
    if known and (beside or (in_one_cell(first) and in_one_cell(second))):
        return 0.0, 0.0, (0.0, 0.0, 0.0, 0.0)
    if known and min(abs(one), abs(two)) >= rules[0] and abs(one - two) < rules[2] * abs(one + two):
        area, difference = one + two, (one - two) / (one + two)
        w, slope = _switch(rules, abs(difference))
        slope = slope if difference > 0.0 else -slope
        by_one, by_two = 2.0 * two / (area * area) * slope, -2.0 * one / (area * area) * slope  # ∂w/∂A
        shared, half_one, half_two = (1.0 - w) / area, 0.5 / one, 0.5 / two
        in_one, in_two = half_one - 1.0 / area, half_two - 1.0 / area
        return shared + w * half_one, shared + w * half_two, (
            -shared / area - w * half_one / one + in_one * by_one, -shared / area + in_one * by_two,
            -shared / area + in_two * by_one, -shared / area - w * half_two / two + in_two * by_two,
        )  # fmt: skip
    d_1 = 0.5 / one if _is_followed(rules[0], first) else 0.0
    d_2 = 0.5 / two if _is_followed(rules[0], second) else 0.0
    return d_1, d_2, (-2.0 * d_1 * d_1, 0.0, 0.0, -2.0 * d_2 * d_2)


@inlined
def _pixel_of(triangle, columns, rows):
    """Return (column, row, True if there is one) of the pixel of the flux of a triangle that is not followed."""
    a, b, c = triangle
    i, j, on = a[2], a[3], a[4] == ON
    if not in_one_cell(triangle):
        i, j, on = pixel_at((a[0] + b[0] + c[0]) / 3.0, (a[1] + b[1] + c[1]) / 3.0, columns, rows)
    return i, j, on and not misses_screen(triangle)


@inlined
def _load_row(corner, scale, flux, k, first, count, size, work):
    """Load a row of tubes, whose upper corners are known; size: columns and rows of the picture."""
    load_corners(corner, scale, k + 1, first, count + 1, size[0], size[1], LOWER, work)
    for r in range(count):
        work[FLUX + r] = flux[k, first + r]


@inlined
def _set_kinds(rules, row, count, work):
    """Set the kinds of the tubes of a row, and the densities of even tubes; 0 for the others.

    row: number of the row of tubes, plus that of the first tube; the diagonals alternate with it.
    """
    thinnest, most, _ = rules
    for r in range(count):
        x0, y0, x1, y1 = work[UPPER + r], work[UPPER + Y + r], work[LOWER + r], work[LOWER + Y + r]
        x3, y3, x2, y2 = work[UPPER + r + 1], work[UPPER + Y + r + 1], work[LOWER + r + 1], work[LOWER + Y + r + 1]
        both = (x2 - x0) * (y3 - y1) - (x3 - x1) * (y2 - y0)  # twice the area of the tube
        x, y = (x3, y3) if (row + r) & 1 != 0 else (x2, y2)
        one = (x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)
        state = work[UPPER + STATE + r] + work[UPPER + STATE + r + 1]
        on = state + work[LOWER + STATE + r] + work[LOWER + STATE + r + 1] == 0.0
        i, j = work[UPPER + COLUMN + r], work[UPPER + ROW + r]
        in_pixel = on & (i == work[LOWER + COLUMN + r]) & (j == work[LOWER + ROW + r])
        in_pixel &= (i == work[UPPER + COLUMN + r + 1]) & (j == work[UPPER + ROW + r + 1])
        in_pixel &= (i == work[LOWER + COLUMN + r + 1]) & (j == work[LOWER + ROW + r + 1])
        even = on & (not in_pixel) & (abs(2.0 * one - both) <= most * abs(both)) & (abs(both) >= 8.0 * thinnest)
        density = 2.0 * work[FLUX + r] / (both if even else 1.0)
        density = density if even else 0.0
        work[FIRST + r] = work[SECOND + r] = work[BELOW + r] = work[ABOVE + r] = density
        work[KIND + r] = IN_PIXEL if in_pixel else (EVEN if even else UNEVEN)


@inlined
def _set_densities(r, odd, d_1, d_2, work):
    work[FIRST + r], work[SECOND + r] = d_1, d_2
    work[BELOW + r], work[ABOVE + r] = (d_2, d_1) if odd else (d_1, d_2)


@inlined
def _put_diagonal(n, tube, odd, work):
    """Store the diagonal of an uneven tube, from corner 0 or 1, as edge n."""
    put_corner(tube[1] if odd else tube[0], STARTS, n, work)
    put_corner(tube[3] if odd else tube[2], ENDS, n, work)


# --- the picture ------------------------------------------------------------------------------------------------------


@inlined
def _add_to_pixel(sums, first_column, pixel, flux):
    i, j, on = pixel
    if on:
        sums[i - first_column, j] += flux
        sums[i - first_column, j + 1] -= flux


@njit(error_model="numpy")
def _add_uneven(sums, size, first_column, rules, row, count, work):
    """Set the densities of uneven tubes, and add what is not followed.

    Returns the number of diagonals to be followed, stored as edges with their densities in WEIGHT, and Σ flux · (mean
    square of the corners' distance outside the border).
    """
    diagonals, far = 0, 0.0
    for r in range(count):
        kind, flux = work[KIND + r], work[FLUX + r]
        if kind == EVEN or flux == 0.0:
            continue
        if kind == IN_PIXEL:
            pixel = int(work[UPPER + COLUMN + r]), int(work[UPPER + ROW + r]), True
            _add_to_pixel(sums, first_column, pixel, flux)
            continue
        odd, tube = (row + r) & 1 != 0, _tube_at(r, work)
        d_1, d_2, _ = _densities(rules, tube, odd)
        for d, triangle in zip((d_1, d_2), _triangles_of(tube, odd)):  # noqa: B905
            if d == 0.0:
                _add_to_pixel(sums, first_column, _pixel_of(triangle, *size), 0.5 * flux)
        _set_densities(r, odd, flux * d_1, flux * d_2, work)
        if d_1 != d_2:
            _put_diagonal(diagonals, tube, odd, work)
            work[WEIGHT + diagonals] = flux * (d_1 - d_2) if odd else flux * (d_2 - d_1)
            diagonals += 1
        if tube[0][4] | tube[1][4] | tube[2][4] | tube[3][4] != ON:
            far += 0.5 * flux * half_square_outside(tube, *size)
    return diagonals, far


@njit(error_model="numpy", fastmath={"contract"})
def _add_block(sums, size, first_column, rules, tubes, seam, work):
    """Add a block of tubes to sums, and return `far`.

    tubes: (corners, scale, flux, range of rows, first, count): `count` tubes from `first` on in each of the rows.
    sums: those of the columns from first_column on.  seam: for each row, density on the right of the block before; on
    return, that on the right of this block.
    """
    corner, scale, flux, rows, first, count = tubes
    far, is_last = 0.0, first + count == flux.shape[1]
    load_corners(corner, scale, rows[0], first, count + 1, size[0], size[1], UPPER, work)
    work[BEFORE : BEFORE + count] = 0.0
    for k in range(rows[0], rows[1]):
        _load_row(corner, scale, flux, k, first, count, size, work)
        _set_kinds(rules, k + first, count, work)
        diagonals, beyond = _add_uneven(sums, size, first_column, rules, k + first, count, work)
        far += beyond
        if diagonals > 0:
            add_edges(sums, size, first_column, STARTS, ENDS, diagonals, WEIGHT, work)
        work[WEIGHT] = work[FIRST] - seam[k - rows[0]]
        for r in range(1, count):
            work[WEIGHT + r] = work[FIRST + r] - work[SECOND + r - 1]
        seam[k - rows[0]] = work[SECOND + count - 1]
        work[WEIGHT + count] = -seam[k - rows[0]]
        add_edges(sums, size, first_column, UPPER, LOWER, count + 1 if is_last else count, WEIGHT, work)
        for r in range(count):
            work[WEIGHT + r] = work[BEFORE + r] - work[ABOVE + r]
            work[BEFORE + r] = work[BELOW + r]
        copy_corners(UPPER + 1, ENDS, count, work)
        add_edges(sums, size, first_column, UPPER, ENDS, count, WEIGHT, work)
        copy_corners(LOWER, UPPER, count + 1, work)
    copy_corners(UPPER + 1, ENDS, count, work)
    add_edges(sums, size, first_column, UPPER, ENDS, count, BEFORE, work)
    return far


@inlined
def _rows_of(part, parts, n):
    """Return the first row of tubes of a part, and the one after its last."""
    share = (n + parts - 1) // parts
    return min(n, part * share), min(n, (part + 1) * share)


@compiled(threads_by="corner")
def _column_ranges(corner, scale, columns, ranges):
    """Set ranges (parts, 2) to the columns that the triangles of each part can reach, with a margin for rounding."""
    parts, n, m = ranges.shape[0], corner.shape[1] - 1, corner.shape[2]
    for c in prange(parts):
        first, last = _rows_of(c, parts, n)
        least, most = np.full(m, math.inf), np.full(m, -math.inf)
        for k in range(first, last + 1 if first < last else first):
            for r in range(m):
                x = (corner[0, k, r] - scale[0]) * scale[2]
                least[r], most[r] = (x if x < least[r] else least[r]), (x if x > most[r] else most[r])
        low, high = least.min(), most.max()
        if high - low < MAX_WIDTH:
            low, high = max(low - 1.0, 0.0), min(high + 2.0, float(columns))
        else:
            low, high = 0.0, float(columns) if first < last else 0.0
        ranges[c, 0], ranges[c, 1] = (int(low), int(high)) if low < high else (0, 0)


@compiled(threads_by="flux")
def _clip(corner, scale, flux, rules, size, ranges, begins, sums, far):
    """Set `sums` to the flux of the two triangles of each tube, by parts, and `far`, (parts,).

    corner (2, n + 1, m + 1): corners of the tubes.  scale (x_0, y_0, s_x, s_y): pixels are (x - x_0) s_x and
    (y - y_0) s_y.  flux (n, m): flux of the tubes.  rules: see `Clip`.  size: columns and rows of the picture.
    sums: for each part, those of its columns `ranges` (parts, 2), (columns, rows + 1), from begins[part] on.
    far: Σ flux · (mean square of the distance by which the corners lie outside the border).
    """
    n, m = flux.shape
    parts, limits = ranges.shape[0], (float(size[0]), float(size[1]))
    for c in prange(parts):
        rows, low, high = _rows_of(c, parts, n), ranges[c, 0], ranges[c, 1]
        far[c] = 0.0
        if rows[0] < rows[1]:
            part = sums[begins[c] : begins[c + 1]]
            part[:] = 0.0
            own = part.reshape(max(high - low, 1), size[1] + 1)
            seam, work = np.zeros(rows[1] - rows[0]), np.zeros(CLIP_WORK)
            for first in range(0, m, BLOCK):
                tubes = corner, scale, flux, rows, first, min(BLOCK, m - first)
                far[c] += _add_block(own, limits, low, rules, tubes, seam, work)


@compiled(threads_by="image")
def _running_sums(ranges, begins, sums, image):
    """Set image (columns, rows) to the running sums down the columns of the sum of all parts, added in their order."""
    columns, rows = image.shape
    for i in prange(columns):
        image[i, :] = 0.0
        for c in range(ranges.shape[0]):
            if ranges[c, 0] <= i < ranges[c, 1]:
                at = begins[c] + (i - ranges[c, 0]) * (rows + 1)
                for j in range(rows):
                    image[i, j] += sums[at + j]
        for j in range(1, rows):
            image[i, j] += image[i, j - 1]


# --- the adjoint ------------------------------------------------------------------------------------------------------


@compiled(threads_by="g")
def _with_sums_below(g, both):
    """Set both[i, j] (2,) to g[i, j] and the sum of g[i, j + 1:]; g (rows, columns)."""
    rows, columns = g.shape
    for i in prange(columns):
        whole = 0.0
        for j in range(rows - 1, -1, -1):
            both[i, j, 0], both[i, j, 1] = g[j, i], whole
            whole += g[j, i]


@inlined
def _add_area_gradient(q, triangle, to, r, work):
    """Add q ∂A/∂corner of a triangle of area A to the gradients at the offsets `to`."""
    a, b, c = triangle
    half = 0.5 * q
    work[to[0] + r] += half * (b[1] - c[1])
    work[to[0] + LENGTH + r] += half * (c[0] - b[0])
    work[to[1] + r] += half * (c[1] - a[1])
    work[to[1] + LENGTH + r] += half * (a[0] - c[0])
    work[to[2] + r] += half * (a[1] - b[1])
    work[to[2] + LENGTH + r] += half * (b[0] - a[0])


@inlined
def _set_gradients(count, work):
    """Set the gradient in the corners by the edges 01, 12, 23 and 03, and by the areas of even tubes."""
    for r in range(count):
        x0, y0, x1, y1 = work[UPPER + r], work[UPPER + Y + r], work[LOWER + r], work[LOWER + Y + r]
        x3, y3, x2, y2 = work[UPPER + r + 1], work[UPPER + Y + r + 1], work[LOWER + r + 1], work[LOWER + Y + r + 1]
        first, second, below, above = work[FIRST + r], work[SECOND + r], work[BELOW + r], work[ABOVE + r]
        phi = work[ALONG_01 + r] + work[ALONG_12 + r] - work[ALONG_01 + r + 1] - work[ALONG_03 + r]
        both = (x2 - x0) * (y3 - y1) - (x3 - x1) * (y2 - y0)
        q = -first * phi / (both if work[KIND + r] == EVEN else 1.0)  # half of ∂L/∂A
        q = q if work[KIND + r] == EVEN else 0.0
        a_0, a_1 = first * work[ALONG_01 + LENGTH + r], first * work[ALONG_01 + 2 * LENGTH + r]
        b_1, b_2 = below * work[ALONG_12 + LENGTH + r], below * work[ALONG_12 + 2 * LENGTH + r]
        c_3, c_2 = second * work[ALONG_01 + LENGTH + r + 1], second * work[ALONG_01 + 2 * LENGTH + r + 1]
        d_0, d_3 = above * work[ALONG_03 + LENGTH + r], above * work[ALONG_03 + 2 * LENGTH + r]
        work[G_0 + r] = a_0 * (y1 - y0) - d_0 * (y3 - y0) + q * (y1 - y3)
        work[G_0 + LENGTH + r] = d_0 * (x3 - x0) - a_0 * (x1 - x0) + q * (x3 - x1)
        work[G_1 + r] = a_1 * (y1 - y0) + b_1 * (y2 - y1) + q * (y2 - y0)
        work[G_1 + LENGTH + r] = q * (x0 - x2) - a_1 * (x1 - x0) - b_1 * (x2 - x1)
        work[G_2 + r] = b_2 * (y2 - y1) - c_2 * (y2 - y3) + q * (y3 - y1)
        work[G_2 + LENGTH + r] = c_2 * (x2 - x3) - b_2 * (x2 - x1) + q * (x1 - x3)
        work[G_3 + r] = q * (y0 - y2) - c_3 * (y2 - y3) - d_3 * (y3 - y0)
        work[G_3 + LENGTH + r] = c_3 * (x2 - x3) + d_3 * (x3 - x0) + q * (x2 - x0)


@inlined
def _set_flux_gradients(count, first, d_flux, work):
    """Set the gradient in the flux of even tubes, Φ / A; 0 for the others."""
    for r in range(count):
        both = (work[LOWER + r + 1] - work[UPPER + r]) * (work[UPPER + Y + r + 1] - work[LOWER + Y + r])
        both -= (work[UPPER + r + 1] - work[LOWER + r]) * (work[LOWER + Y + r + 1] - work[UPPER + Y + r])
        phi = work[ALONG_01 + r] + work[ALONG_12 + r] - work[ALONG_01 + r + 1] - work[ALONG_03 + r]
        d_flux[first + r] = 2.0 * phi / both if work[KIND + r] == EVEN else 0.0


@njit(error_model="numpy")
def _list_uneven(rules, row, count, in_flux, work):
    """Set the densities of uneven tubes and store their diagonals as edges; list them and return their number."""
    uneven = 0
    for r in range(count):
        flux = work[FLUX + r]
        if work[KIND + r] == UNEVEN and flux != 0.0 or work[KIND + r] != EVEN and in_flux:
            odd, tube = (row + r) & 1 != 0, _tube_at(r, work)
            d_1, d_2, _ = _densities(rules, tube, odd)
            _set_densities(r, odd, flux * d_1, flux * d_2, work)
            _put_diagonal(uneven, tube, odd, work)
            work[NUMBER + uneven] = r
            uneven += 1
    return uneven


@njit(error_model="numpy")
def _add_uneven_gradients(g, size, rules, row, uneven, g_far, first, d_flux, work):
    """Add the gradient of uneven tubes by their areas, diagonals, pixels and light outside the border.

    d_flux (m,) or (0,): receives the gradient in the flux of the row.
    """
    for n in range(uneven):
        r = int(work[NUMBER + n])
        odd, tube, flux = (row + r) & 1 != 0, _tube_at(r, work), work[FLUX + r]
        d_1, d_2, (one_one, one_two, two_one, two_two) = _densities(rules, tube, odd)
        one, two = _triangles_of(tube, odd)
        p_01, p_12, p_32, p_03 = work[ALONG_01 + r], work[ALONG_12 + r], work[ALONG_01 + r + 1], work[ALONG_03 + r]
        diagonal, turn = work[ALONG_DIAGONAL + n], flux * (d_1 - d_2)
        at_start, at_end = turn * work[ALONG_DIAGONAL + LENGTH + n], turn * work[ALONG_DIAGONAL + 2 * LENGTH + n]
        if odd:
            phi_1, phi_2 = p_01 + diagonal - p_03, p_12 - p_32 - diagonal
            to_1, to_2, start, end = (G_0, G_1, G_3), (G_1, G_2, G_3), G_1, G_3
            dx, dy = tube[3][0] - tube[1][0], tube[3][1] - tube[1][1]
        else:  # the triangle 012 traverses the diagonal backwards
            phi_1, phi_2 = p_01 + p_12 - diagonal, diagonal - p_32 - p_03
            to_1, to_2, start, end = (G_0, G_1, G_2), (G_0, G_2, G_3), G_0, G_2
            dx, dy = tube[0][0] - tube[2][0], tube[0][1] - tube[2][1]
        _add_area_gradient(flux * (phi_1 * one_one + phi_2 * two_one), one, to_1, r, work)
        _add_area_gradient(flux * (phi_1 * one_two + phi_2 * two_two), two, to_2, r, work)
        work[start + r] += at_start * dy
        work[start + LENGTH + r] -= at_start * dx
        work[end + r] += at_end * dy
        work[end + LENGTH + r] -= at_end * dx
        beside = tube[0][4] | tube[1][4] | tube[2][4] | tube[3][4] != ON
        if beside and flux != 0.0:
            weight = 0.5 * g_far * flux
            for corner, to in zip(tube, (G_0, G_1, G_2, G_3)):  # noqa: B905
                work[to + r] += weight * outside(corner[0], size[0])
                work[to + LENGTH + r] += weight * outside(corner[1], size[1])
        if d_flux.size > 0:
            mean = phi_1 * d_1 + phi_2 * d_2
            for d, triangle in zip((d_1, d_2), (one, two)):  # noqa: B905
                if d == 0.0:
                    i, j, on = _pixel_of(triangle, *size)
                    mean += 0.5 * g[i, j, 0] if on else 0.0
            d_flux[first + r] = mean + (0.5 * g_far * half_square_outside(tube, *size) if beside else 0.0)


@njit(error_model="numpy", fastmath={"contract"})
def _add_block_adjoint(g, size, rules, tubes, g_far, d_corner, d_flux, work):
    """Add the gradient of a block of tubes in their corners, and set that in their flux; tubes: as in `_add_block`."""
    corner, scale, flux, rows, first, count = tubes
    in_flux, (_, _, per_x, per_y) = d_flux.size > 0, scale
    load_corners(corner, scale, rows[0], first, count + 1, size[0], size[1], UPPER, work)
    copy_corners(UPPER + 1, ENDS, count, work)
    integrals_along(g, UPPER, ENDS, count, ALONG_03, work)
    for k in range(rows[0], rows[1]):
        _load_row(corner, scale, flux, k, first, count, size, work)
        _set_kinds(rules, k + first, count, work)
        integrals_along(g, UPPER, LOWER, count + 1, ALONG_01, work)
        copy_corners(LOWER + 1, ENDS, count, work)
        integrals_along(g, LOWER, ENDS, count, ALONG_12, work)
        uneven = _list_uneven(rules, k + first, count, in_flux, work)
        _set_gradients(count, work)
        in_row = d_flux[k if in_flux else 0 : k + 1 if in_flux else 0].reshape(-1)
        if in_flux:
            _set_flux_gradients(count, first, in_row, work)
        if uneven > 0:
            integrals_along(g, STARTS, ENDS, uneven, ALONG_DIAGONAL, work)
            _add_uneven_gradients(g, size, rules, k + first, uneven, g_far, first, in_row, work)
        for r in range(count):
            d_corner[0, k, first + r] += per_x * work[G_0 + r]
            d_corner[1, k, first + r] += per_y * work[G_0 + LENGTH + r]
            d_corner[0, k + 1, first + r] += per_x * work[G_1 + r]
            d_corner[1, k + 1, first + r] += per_y * work[G_1 + LENGTH + r]
        for r in range(count):
            d_corner[0, k + 1, first + r + 1] += per_x * work[G_2 + r]
            d_corner[1, k + 1, first + r + 1] += per_y * work[G_2 + LENGTH + r]
            d_corner[0, k, first + r + 1] += per_x * work[G_3 + r]
            d_corner[1, k, first + r + 1] += per_y * work[G_3 + LENGTH + r]
        copy_corners(LOWER, UPPER, count + 1, work)
        for r in range(3 * LENGTH):
            work[ALONG_03 + r] = work[ALONG_12 + r]


@compiled(threads_by="flux")
def clip_adjoint(corner, scale, flux, rules, g, g_far, d_corner, d_flux):
    """Add the gradient in the corners to d_corner; store the gradient in the flux in d_flux, (n, m) or empty.

    g (columns, rows, 2): see `_with_sums_below`.  g_far: gradient in `far` of `_clip`.  The even strips of rows of
    tubes are computed first, then the odd ones, so that no two threads write one corner.
    """
    n, m = flux.shape
    strips, size = (n + ROWS_PER_STRIP - 1) // ROWS_PER_STRIP, (float(g.shape[0]), float(g.shape[1]))
    for parity in range(2):
        for half_c in prange((strips - parity + 1) // 2):
            first_row = (2 * half_c + parity) * ROWS_PER_STRIP
            rows, work = (first_row, min(n, first_row + ROWS_PER_STRIP)), np.zeros(ADJOINT_WORK)
            for first in range(0, m, BLOCK):
                tubes = corner, scale, flux, rows, first, min(BLOCK, m - first)
                _add_block_adjoint(g, size, rules, tubes, g_far, d_corner, d_flux, work)


class Clip(torch.autograd.Function):
    """Map (corner (2, n + 1, m + 1), flux (n, m), picture, rules) to (picture, Σ far): see `_clip`.

    picture: its (rows, columns) and its scale.  rules: smallest area of a triangle that is followed (pixel²), and the
    limits of `tubes.triangle_fluxes`.  The gradient is taken in the corners and in the flux.
    """

    @staticmethod
    def forward(  # noqa: D102
        ctx: Any, corner: Tensor, flux: Tensor, picture: tuple[tuple[int, int], Scale], rules: tuple[float, ...]
    ) -> Any:
        ctx.save_for_backward(corner, flux)
        ((rows, columns), scale), count = picture, reductions.parts(flux.numel())
        if rows * columns >= MANY_CELLS:
            count = min(count, FEW_PARTS)
        ctx.size, ctx.scale, ctx.rules = (columns, rows), scale, rules
        tubes = _array(corner), scale
        ranges, begins, far = np.empty((count, 2), np.int64), np.zeros(count + 1, np.int64), np.zeros(count)
        _column_ranges(*tubes, columns, ranges)
        np.cumsum(np.maximum(ranges[:, 1] - ranges[:, 0], 1) * (rows + 1), out=begins[1:])
        # torch, since numpy would use huge pages, which the system clears
        sums = torch.empty(int(begins[-1]), dtype=torch.float64).numpy()
        _clip(*tubes, _array(flux), rules, ctx.size, ranges, begins, sums, far)
        image = np.empty((columns, rows))
        _running_sums(ranges, begins, sums, image)
        return torch.from_numpy(image).T, torch.tensor(far.sum())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g: Tensor, g_far: Tensor) -> Any:  # noqa: D102
        corner, flux = ctx.saved_tensors
        both = torch.empty((*ctx.size, 2), dtype=torch.float64)
        _with_sums_below(np.ascontiguousarray(g.numpy().T).T, both.numpy())
        d_corner = torch.zeros(corner.shape, dtype=torch.float64)
        d_flux = torch.empty(flux.shape if ctx.needs_input_grad[1] else (0, 0), dtype=torch.float64)
        adjoints = float(g_far), d_corner.numpy(), d_flux.numpy()
        clip_adjoint(_array(corner), ctx.scale, _array(flux), ctx.rules, both.numpy(), *adjoints)
        return d_corner, d_flux if ctx.needs_input_grad[1] else None, None, None


def _array(t: Tensor) -> np.ndarray:
    return t.detach().contiguous().numpy()
