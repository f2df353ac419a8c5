"""Tubes of light as two triangles each: which of them are followed, and their densities.

Corners 0 and 3 of a tube lie in row k, 1 and 2 in row k + 1; the tube before shares 0 and 1.  The triangles are 012 and
023, or 013 and 123 where the diagonal runs the other way (in odd tubes).  Most tubes lie on the screen, in more than
one pixel, and no triangle of theirs is thin.  These regular tubes are computed in vectors, and the others one by one.
Of those, some triangles are not followed: one that lies in one pixel or is too thin gives its flux to a pixel, and one
outside the screen or with an invalid corner gives none.  Along its edges the density of such a triangle is 0.
"""

from __future__ import annotations

from numba import njit

from bstcad.optics.kernels.clip_edges import (
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
    corner_at,
    inlined,
    load_corners,
    put_corner,
)

OTHER, REGULAR, IN_PIXEL = 0.0, 1.0, 2.0  # kinds of tubes; the last lie in one pixel of the screen
# Offsets in `work` of the quantities of tubes: flux; kind; density of the triangle with the edge 01, of that with the
# edge 23, with the edge 12 below, and with the edge 03 above; densities of the first two at flux 1, and t of
# `tubes.triangle_fluxes`, of regular tubes; numbers of the tubes whose diagonal is followed.
FLUX, KIND, FIRST, SECOND, BELOW, ABOVE, UNIT_1, UNIT_2, SWITCH, NUMBER = (EDGES_END + LENGTH * k for k in range(10))
TUBES_END = EDGES_END + LENGTH * 10  # end of these quantities


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
def tube_at(r, work):
    """Return the corners of a tube."""
    c0, c3 = corner_at(UPPER, r, work), corner_at(UPPER, r + 1, work)
    return c0, corner_at(LOWER, r, work), corner_at(LOWER, r + 1, work), c3


@inlined
def triangles_of(tube, odd):
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
def densities(rules, tube, odd):
    """Return the densities of the two triangles of a tube of flux 1, and their derivatives (4) in the two areas.

    Density d_1 in the areas A_1 and A_2, then d_2.  A triangle that is not followed has the density 0.
    """
    first, second = triangles_of(tube, odd)
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
def pixel_of(triangle, columns, rows):
    """Return (column, row, True if there is one) of the pixel of the flux of a triangle that is not followed."""
    a, b, c = triangle
    i, j, on = a[2], a[3], a[4] == ON
    if not in_one_cell(triangle):
        i, j, on = pixel_at((a[0] + b[0] + c[0]) / 3.0, (a[1] + b[1] + c[1]) / 3.0, columns, rows)
    return i, j, on and not misses_screen(triangle)


@inlined
def load_row(corner, scale, flux, k, first, count, size, work):
    """Load a row of tubes, whose upper corners are known; size: columns and rows of the picture."""
    load_corners(corner, scale, k + 1, first, count + 1, size[0], size[1], LOWER, work)
    for r in range(count):
        work[FLUX + r] = flux[k, first + r]


@inlined
def set_kinds(rules, row, count, work):
    """Set the kinds of the tubes of a row, and the densities of regular tubes; 0 for the others.

    row: number of the row of tubes, plus that of the first tube; the diagonals alternate with it.
    """
    thinnest, even, uneven = rules
    for r in range(count):
        x0, y0, x1, y1 = work[UPPER + r], work[UPPER + Y + r], work[LOWER + r], work[LOWER + Y + r]
        x3, y3, x2, y2 = work[UPPER + r + 1], work[UPPER + Y + r + 1], work[LOWER + r + 1], work[LOWER + Y + r + 1]
        odd = (row + r) & 1 != 0
        both = (x2 - x0) * (y3 - y1) - (x3 - x1) * (y2 - y0)  # twice the area of the tube
        x, y = (x3 if odd else x2), (y3 if odd else y2)
        one = (x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)
        two = both - one
        state = work[UPPER + STATE + r] + work[UPPER + STATE + r + 1]
        on = state + work[LOWER + STATE + r] + work[LOWER + STATE + r + 1] == 0.0
        i, j = work[UPPER + COLUMN + r], work[UPPER + ROW + r]
        in_pixel = on & (i == work[LOWER + COLUMN + r]) & (j == work[LOWER + ROW + r])
        in_pixel &= (i == work[UPPER + COLUMN + r + 1]) & (j == work[UPPER + ROW + r + 1])
        in_pixel &= (i == work[LOWER + COLUMN + r + 1]) & (j == work[LOWER + ROW + r + 1])
        regular = on & (not in_pixel) & (abs(one) >= 4.0 * thinnest) & (abs(two) >= 4.0 * thinnest)
        t = (abs(one - two) - even * abs(both)) / ((uneven - even) * abs(both))
        t = t if t < 1.0 else 1.0
        t = t if (t > 0.0) & regular else 0.0
        w = t * t * (3.0 - 2.0 * t)
        shared = 2.0 * (1.0 - w) / (both if regular & (t < 1.0) else 1.0)
        shared = shared if t < 1.0 else 0.0
        d_1, d_2 = shared + w / (one if regular else 1.0), shared + w / (two if regular else 1.0)
        d_1, d_2, flux = (d_1 if regular else 0.0), (d_2 if regular else 0.0), work[FLUX + r]
        work[UNIT_1 + r], work[UNIT_2 + r], work[SWITCH + r] = d_1, d_2, t
        d_1, d_2 = d_1 * flux, d_2 * flux
        work[FIRST + r], work[SECOND + r] = d_1, d_2
        work[BELOW + r], work[ABOVE + r] = (d_2 if odd else d_1), (d_1 if odd else d_2)
        work[KIND + r] = IN_PIXEL if in_pixel else (REGULAR if regular else OTHER)


@inlined
def set_densities(r, odd, d_1, d_2, work):
    """Set the densities of a tube that is computed by itself."""
    work[FIRST + r], work[SECOND + r] = d_1, d_2
    work[BELOW + r], work[ABOVE + r] = (d_2, d_1) if odd else (d_1, d_2)


@njit(error_model="numpy")
def put_diagonals(diagonals, row, work):
    """Store the diagonals of the tubes in NUMBER, from corner 0 or 1 of each, as edges."""
    for n in range(diagonals):
        r = int(work[NUMBER + n])
        odd = (row + r) & 1 != 0
        put_corner(corner_at(LOWER if odd else UPPER, r, work), STARTS, n, work)
        put_corner(corner_at(UPPER if odd else LOWER, r + 1, work), ENDS, n, work)
