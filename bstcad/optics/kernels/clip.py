"""Fused CPU kernels (numba) behind `tubes.collect`: triangles of light, clipped exactly at the pixel borders.

A triangle of flux F and signed area A has the density F / A.  By Green's theorem its flux in pixel (i, j) is

    I_ij = F / A ∮ clip(j + 1 - y, 0, 1) dx   over the parts of the edges in column i,

so each edge is followed from pixel border to pixel border (clip_edges.py).  A piece of it adds to the pixel it crosses
and, as one number, to all pixels below; a running sum down the columns completes the picture.  The two triangles beside
an edge traverse it in opposite senses, so it is followed once, with the difference of their densities (clip_tubes.py).
Most tubes have one density (`tubes.triangle_fluxes`): then the diagonal between their triangles is not followed.

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

from bstcad.optics.kernels.clip_edges import (
    BLOCK,
    COLUMN,
    ENDS,
    LENGTH,
    LOWER,
    ON,
    ROW,
    STARTS,
    UPPER,
    Y,
    add_edges,
    copy_corners,
    inlined,
    integrals_along,
    load_corners,
)
from bstcad.optics.kernels.clip_tubes import (
    ABOVE,
    BELOW,
    FIRST,
    FLUX,
    IN_PIXEL,
    KIND,
    NUMBER,
    OTHER,
    REGULAR,
    SECOND,
    SWITCH,
    TUBES_END,
    UNIT_1,
    UNIT_2,
    densities,
    half_square_outside,
    load_row,
    outside,
    pixel_of,
    put_diagonals,
    set_densities,
    set_kinds,
    triangles_of,
    tube_at,
)
from bstcad.optics.numerics import reductions
from bstcad.optics.numerics.compiling import compiled
from bstcad.optics.receivers.irradiance import Scale

FEW_PARTS, MANY_CELLS = 8, 1 << 21  # most partial sums of a picture of MANY_CELLS or more, for its memory
MAX_WIDTH = 1e6  # extent in x of the corners of one part (pixels), above which rounding may reach any column
ROWS_PER_STRIP = 16  # rows of tubes whose gradient one thread computes at a time

# Offsets in `work` of the density above the edge 03, and of the densities of edges.
BEFORE, WEIGHT = TUBES_END, TUBES_END + LENGTH
CLIP_WORK = TUBES_END + LENGTH * 2  # length of `work` for a picture
# Offsets for the adjoint: integrals along the edges 03, 12, 01 (`integrals_along`), along the diagonals that are
# followed, and of these by tube, 0 for the others; the gradient in x and y of the corners 0 to 3.
ALONG_03, ALONG_12, ALONG_01, FOLLOWED, ALONG_DIAGONAL = (CLIP_WORK + LENGTH * k for k in range(0, 15, 3))
G_0, G_1, G_2, G_3 = (CLIP_WORK + LENGTH * k for k in range(15, 23, 2))
ADJOINT_WORK = CLIP_WORK + LENGTH * 23  # length of `work` for the adjoint


# --- the picture ------------------------------------------------------------------------------------------------------


@inlined
def _add_to_pixel(sums, first_column, pixel, flux):
    i, j, on = pixel
    if on:
        sums[i - first_column, j] += flux
        sums[i - first_column, j + 1] -= flux


@njit(error_model="numpy")
def _add_others(sums, size, first_column, rules, row, count, work):
    """Set the densities of tubes that are not regular, and add what is not followed.

    Returns Σ flux · (mean square of the corners' distance outside the border).
    """
    far = 0.0
    for r in range(count):
        kind, flux = work[KIND + r], work[FLUX + r]
        if kind == REGULAR or flux == 0.0:
            continue
        if kind == IN_PIXEL:
            pixel = int(work[UPPER + COLUMN + r]), int(work[UPPER + ROW + r]), True
            _add_to_pixel(sums, first_column, pixel, flux)
            continue
        odd, tube = (row + r) & 1 != 0, tube_at(r, work)
        d_1, d_2, _ = densities(rules, tube, odd)
        for d, triangle in zip((d_1, d_2), triangles_of(tube, odd)):  # noqa: B905
            if d == 0.0:
                _add_to_pixel(sums, first_column, pixel_of(triangle, *size), 0.5 * flux)
        set_densities(r, odd, flux * d_1, flux * d_2, work)
        if tube[0][4] | tube[1][4] | tube[2][4] | tube[3][4] != ON:
            far += 0.5 * flux * half_square_outside(tube, *size)
    return far


@inlined
def _put_weighted_diagonals(row, count, work):
    """Store the diagonals between triangles of different densities as edges with WEIGHT; return their number."""
    diagonals = 0
    for r in range(count):
        work[NUMBER + diagonals] = r
        work[WEIGHT + diagonals] = work[ABOVE + r] - work[BELOW + r]
        diagonals += work[FIRST + r] != work[SECOND + r]
    put_diagonals(diagonals, row, work)
    return diagonals


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
        load_row(corner, scale, flux, k, first, count, size, work)
        set_kinds(rules, k + first, count, work)
        far += _add_others(sums, size, first_column, rules, k + first, count, work)
        diagonals = _put_weighted_diagonals(k + first, count, work)
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
def _integrals_of_triangles(r, odd, work):
    """Return Φ around the two triangles of a tube."""
    p_01, p_12, p_32, p_03 = work[ALONG_01 + r], work[ALONG_12 + r], work[ALONG_01 + r + 1], work[ALONG_03 + r]
    diagonal = work[ALONG_DIAGONAL + r]  # the triangle 012 of an even tube traverses it backwards
    return p_01 + (diagonal - p_03 if odd else p_12 - diagonal), (p_12 - diagonal if odd else diagonal - p_03) - p_32


@inlined
def _set_gradients(rules, row, count, work):
    """Set the gradient in the corners by the edges 01, 12, 23 and 03, and by areas and diagonals of regular tubes."""
    _, even, uneven = rules
    for r in range(count):
        x0, y0, x1, y1 = work[UPPER + r], work[UPPER + Y + r], work[LOWER + r], work[LOWER + Y + r]
        x3, y3, x2, y2 = work[UPPER + r + 1], work[UPPER + Y + r + 1], work[LOWER + r + 1], work[LOWER + Y + r + 1]
        odd, regular, t, flux = (row + r) & 1 != 0, work[KIND + r] == REGULAR, work[SWITCH + r], work[FLUX + r]
        both = (x2 - x0) * (y3 - y1) - (x3 - x1) * (y2 - y0)
        x, y = (x3 if odd else x2), (y3 if odd else y2)
        one = (x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)
        two = both - one
        # ∂L/∂A_k = -F (Φ_k w / (2 A_k²) + (Φ_1 + Φ_2) (1 - w) / A²) + F Σ_l Φ_l (1 / (2 A_l) - 1 / A) ∂w/∂A_k
        phi_1, phi_2 = _integrals_of_triangles(r, odd, work)
        w, switching = t * t * (3.0 - 2.0 * t), (t > 0.0) & (t < 1.0)
        by_one, by_two = 1.0 / (one if regular else 1.0), 1.0 / (two if regular else 1.0)
        whole = 2.0 / (both if regular & (t < 1.0) else 1.0)  # 1 / A
        slope = 6.0 * t * (1.0 - t) / (uneven - even) * whole * whole  # |∂w/∂A_k| / (2 A_l), l the other
        slope = slope if (one - two) * whole > 0.0 else -slope
        slope = slope * (phi_1 * (by_one - whole) + phi_2 * (by_two - whole)) if switching else 0.0
        shared = (phi_1 + phi_2) * (1.0 - w) * whole * whole if t < 1.0 else 0.0
        q_1 = flux * (slope * two - shared - 2.0 * w * phi_1 * by_one * by_one)
        q_2 = flux * (-slope * one - shared - 2.0 * w * phi_2 * by_two * by_two)
        q_1, q_2 = (0.5 * q_1 if regular else 0.0), (0.5 * q_2 if regular else 0.0)
        turn = work[FIRST + r] - work[SECOND + r]
        turn = turn if regular else 0.0
        start, end = turn * work[ALONG_DIAGONAL + LENGTH + r], turn * work[ALONG_DIAGONAL + 2 * LENGTH + r]
        dx, dy = (x3 - x1 if odd else x0 - x2), (y3 - y1 if odd else y0 - y2)
        first, second, below, above = work[FIRST + r], work[SECOND + r], work[BELOW + r], work[ABOVE + r]
        a_0, a_1 = first * work[ALONG_01 + LENGTH + r], first * work[ALONG_01 + 2 * LENGTH + r]
        b_1, b_2 = below * work[ALONG_12 + LENGTH + r], below * work[ALONG_12 + 2 * LENGTH + r]
        c_3, c_2 = second * work[ALONG_01 + LENGTH + r + 1], second * work[ALONG_01 + 2 * LENGTH + r + 1]
        d_0, d_3 = above * work[ALONG_03 + LENGTH + r], above * work[ALONG_03 + 2 * LENGTH + r]
        q, more = q_2, q_1 - q_2  # coefficients of the gradients of the whole area, and of the first triangle alone
        third_x, third_y = more * (y0 - y1) + end * dy, more * (x1 - x0) - end * dx
        start_x, start_y = start * dy, -start * dx
        work[G_0 + r] = a_0 * (y1 - y0) - d_0 * (y3 - y0) + q * (y1 - y3) + more * (y1 - y) + (0.0 if odd else start_x)
        work[G_0 + LENGTH + r] = (
            d_0 * (x3 - x0) - a_0 * (x1 - x0) + q * (x3 - x1) + more * (x - x1) + (0.0 if odd else start_y)
        )
        work[G_1 + r] = a_1 * (y1 - y0) + b_1 * (y2 - y1) + q * (y2 - y0) + more * (y - y0) + (start_x if odd else 0.0)
        work[G_1 + LENGTH + r] = (
            q * (x0 - x2) - a_1 * (x1 - x0) - b_1 * (x2 - x1) + more * (x0 - x) + (start_y if odd else 0.0)
        )
        work[G_2 + r] = b_2 * (y2 - y1) - c_2 * (y2 - y3) + q * (y3 - y1) + (0.0 if odd else third_x)
        work[G_2 + LENGTH + r] = c_2 * (x2 - x3) - b_2 * (x2 - x1) + q * (x1 - x3) + (0.0 if odd else third_y)
        work[G_3 + r] = q * (y0 - y2) - c_3 * (y2 - y3) - d_3 * (y3 - y0) + (third_x if odd else 0.0)
        work[G_3 + LENGTH + r] = c_3 * (x2 - x3) + d_3 * (x3 - x0) + q * (x2 - x0) + (third_y if odd else 0.0)


@inlined
def _set_flux_gradients(row, count, first, d_flux, work):
    """Set the gradient in the flux of regular tubes, Σ Φ_k d_k at flux 1; 0 for the others."""
    for r in range(count):
        phi_1, phi_2 = _integrals_of_triangles(r, (row + r) & 1 != 0, work)
        d_flux[first + r] = phi_1 * work[UNIT_1 + r] + phi_2 * work[UNIT_2 + r]


@njit(error_model="numpy")
def _set_other_densities(rules, row, count, in_flux, work):
    """Set the densities of tubes that are not regular; return True if there are any whose gradient is needed."""
    others = False
    for r in range(count):
        if _is_other(r, in_flux, work):
            odd = (row + r) & 1 != 0
            d_1, d_2, _ = densities(rules, tube_at(r, work), odd)
            set_densities(r, odd, work[FLUX + r] * d_1, work[FLUX + r] * d_2, work)
            others = True
    return others


@inlined
def _is_other(r, in_flux, work):
    """Return True for a tube that is not regular, and whose gradient in corners or, if `in_flux`, in flux is needed."""
    kind = work[KIND + r]
    return ((kind == OTHER) & (work[FLUX + r] != 0.0)) | ((kind != REGULAR) & in_flux)


@inlined
def _integrate_diagonals(g, row, count, in_flux, work):
    """Store the integrals along the diagonals that count, by tube; 0 for the others."""
    followed = 0
    for r in range(count):
        for k in range(3):
            work[ALONG_DIAGONAL + LENGTH * k + r] = 0.0
        work[NUMBER + followed] = r
        apart = (work[FIRST + r] != work[SECOND + r]) | (work[UNIT_1 + r] != work[UNIT_2 + r])
        followed += apart | (in_flux & (work[KIND + r] == OTHER))
    if followed > 0:
        put_diagonals(followed, row, work)
        integrals_along(g, STARTS, ENDS, followed, FOLLOWED, work)
        for n in range(followed):
            r = int(work[NUMBER + n])
            for k in range(3):
                work[ALONG_DIAGONAL + LENGTH * k + r] = work[FOLLOWED + LENGTH * k + n]


@njit(error_model="numpy")
def _add_other_gradients(g, size, rules, row, count, g_far, first, d_flux, work):
    """Add the gradient of tubes that are not regular by their areas, diagonals, pixels and light outside the border.

    d_flux (m,) or (0,): receives the gradient in the flux of the row.
    """
    for r in range(count):
        if not _is_other(r, d_flux.size > 0, work):
            continue
        odd, tube, flux = (row + r) & 1 != 0, tube_at(r, work), work[FLUX + r]
        d_1, d_2, (one_one, one_two, two_one, two_two) = densities(rules, tube, odd)
        one, two = triangles_of(tube, odd)
        (phi_1, phi_2), turn = _integrals_of_triangles(r, odd, work), flux * (d_1 - d_2)
        at_start = turn * work[ALONG_DIAGONAL + LENGTH + r]
        at_end = turn * work[ALONG_DIAGONAL + 2 * LENGTH + r]
        if odd:
            to_1, to_2, start, end = (G_0, G_1, G_3), (G_1, G_2, G_3), G_1, G_3
            dx, dy = tube[3][0] - tube[1][0], tube[3][1] - tube[1][1]
        else:
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
                    i, j, on = pixel_of(triangle, *size)
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
        load_row(corner, scale, flux, k, first, count, size, work)
        set_kinds(rules, k + first, count, work)
        integrals_along(g, UPPER, LOWER, count + 1, ALONG_01, work)
        copy_corners(LOWER + 1, ENDS, count, work)
        integrals_along(g, LOWER, ENDS, count, ALONG_12, work)
        others = _set_other_densities(rules, k + first, count, in_flux, work)
        _integrate_diagonals(g, k + first, count, in_flux, work)
        _set_gradients(rules, k + first, count, work)
        in_row = d_flux[k if in_flux else 0 : k + 1 if in_flux else 0].reshape(-1)
        if in_flux:
            _set_flux_gradients(k + first, count, first, in_row, work)
        if others:
            _add_other_gradients(g, size, rules, k + first, count, g_far, first, in_row, work)
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
