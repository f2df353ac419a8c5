"""Edges of tubes, followed from pixel border to pixel border: many at a time, in vectors.

An edge from a to b runs through pixels, its pieces.  All edges of a row are cut at their next border at once, so that
the loops over edges have no branches; the few with many pieces are then followed one by one.  A piece adds to the sums
of a picture (`add_edges`), or to the integrals that the adjoint needs (`integrals_along`).

`work` contains LENGTH numbers of each quantity, from the offset of its name on: constants, so that the compiler sees
that they do not overlap.  Columns and rows of pixels are stored as floats.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

BLOCK = 128  # number of tubes in a block of a row
LENGTH = BLOCK + 8  # numbers of each quantity in `work`: one more than tubes, and so that no two begin on one page
MAX_DISTANCE = 1e15  # largest |x| + |y| of a corner (pixels); farther away, rounding approaches a pixel
NO_BORDER = 1e300  # s of the next border of an edge that crosses no more borders along an axis
FEW_LEFT = 4  # edges are followed one by one once less than one of so many has another piece

ON, OUT_OF_RANGE = 0, 16  # state of a corner: on the screen; outside MAX_DISTANCE or not a number
LEFT, RIGHT, ABOVE, BELOW = 1, 2, 4, 8  # bits of the state of a corner outside one or two borders of the screen

# Offsets of the corners of a row of tubes in `work`, and of the starts and ends of edges.  From each, the quantities of
# a corner follow: x, y, column, row and state.
Y, COLUMN, ROW, STATE, CORNER = (LENGTH * k for k in range(1, 6))
UPPER, LOWER, STARTS, ENDS = (CORNER * k for k in range(4))
# Offsets of what is known of an edge: the density on its left minus that on its right; at its current piece, column,
# row, start s, index of the pixel in the sums, length in s, middle in s, and distance of the middle below the top of
# the pixel; on each axis s of the next border, s between borders and step; y of the start, and the extent (dx, dy).
DENSITY, AT_COLUMN, AT_ROW, START, INDEX, PART, MIDDLE, DEPTH, NEXT_X, NEXT_Y, SPACING_X, SPACING_Y, STEP_X, STEP_Y = (
    CORNER * 4 + LENGTH * k for k in range(14)
)
FIRST_Y, DX, DY, LEFT_OVER, PHI, WHOLE, SECOND, VALUE, BENEATH = (CORNER * 4 + LENGTH * k for k in range(14, 23))
LAST_COLUMN, LAST_ROW = (
    CORNER * 4 + LENGTH * k for k in (23, 24)
)  # pixel of the end; rounding must not lead beyond it
EDGES_END = CORNER * 4 + LENGTH * 25  # end of these quantities

inlined = njit(forceinline=True, error_model="numpy", fastmath={"contract"})


# --- corners ----------------------------------------------------------------------------------------------------------


@inlined
def load_corners(corner, scale, k, first, count, columns, rows, to, work):
    """Load `count` corners of row k from `first` on; outside the screen column and row are -1, or `columns` and `rows`.

    A corner out of range counts as (0, 0).
    """
    for r in range(count):
        x, y = (corner[0, k, first + r] - scale[0]) * scale[2], (corner[1, k, first + r] - scale[1]) * scale[3]
        known = abs(x) + abs(y) < MAX_DISTANCE
        x, y = (x if known else 0.0), (y if known else 0.0)
        i, j = (x if x > -1.0 else -1.0), (y if y > -1.0 else -1.0)
        i, j = math.floor(i if i < columns else columns), math.floor(j if j < rows else rows)
        work[to + r], work[to + Y + r], work[to + COLUMN + r], work[to + ROW + r] = x, y, i, j
        state = (1.0 if i < 0.0 else 0.0) + (2.0 if i >= columns else 0.0)
        state += (4.0 if j < 0.0 else 0.0) + (8.0 if j >= rows else 0.0)
        work[to + STATE + r] = state if known else 16.0


@inlined
def copy_corners(at, to, count, work):
    """Copy `count` corners from the offset `at` to the offset `to`."""
    for r in range(count):
        work[to + r], work[to + Y + r], work[to + COLUMN + r] = work[at + r], work[at + Y + r], work[at + COLUMN + r]
        work[to + ROW + r], work[to + STATE + r] = work[at + ROW + r], work[at + STATE + r]


@inlined
def corner_at(at, r, work):
    """Return (x, y, column, row, state) of corner r of those from the offset `at` on."""
    i, j, state = int(work[at + COLUMN + r]), int(work[at + ROW + r]), int(work[at + STATE + r])
    return work[at + r], work[at + Y + r], i, j, state


@inlined
def put_corner(corner, to, r, work):
    """Store a corner (x, y, column, row, state) as corner r of those from the offset `to` on."""
    work[to + r], work[to + Y + r] = corner[0], corner[1]
    work[to + COLUMN + r], work[to + ROW + r], work[to + STATE + r] = corner[2], corner[3], corner[4]


# --- pieces -----------------------------------------------------------------------------------------------------------


@inlined
def _first_pieces(starts, ends, count, first_column, columns_apart, work):
    """Begin to follow edges and set their first pieces; return the numbers of edges that go on, and of edges not on.

    starts, ends: offsets of the corners.  first_column: column of the first sums.  columns_apart: distance of two
    columns in the sums.  Edges that are not on the screen get a piece of length 0.
    """
    going_on = beside = 0
    for r in range(count):
        x, y, i, j = work[starts + r], work[starts + Y + r], work[starts + COLUMN + r], work[starts + ROW + r]
        dx, dy = work[ends + r] - x, work[ends + Y + r] - y
        right, down = work[ends + COLUMN + r] - i, work[ends + ROW + r] - j
        on = work[starts + STATE + r] + work[ends + STATE + r] == 0.0
        spacing_x, spacing_y = 1.0 / dx, 1.0 / dy
        next_x = (i + (1.0 if right > 0.0 else 0.0) - x) * spacing_x
        next_y = (j + (1.0 if down > 0.0 else 0.0) - y) * spacing_y
        next_x, next_y = (next_x if (right != 0.0) & on else NO_BORDER), (next_y if (down != 0.0) & on else NO_BORDER)
        i, j = (i - first_column if on else 0.0), (j if on else 0.0)
        last_i, last_j = (i + right if on else 0.0), (j + down if on else 0.0)
        end = next_x if next_x < next_y else next_y
        end = end if end < 1.0 else 1.0
        end = end if end > 0.0 else 0.0
        work[INDEX + r], work[MIDDLE + r], work[DEPTH + r] = i * columns_apart + j, 0.5 * end, y + 0.5 * end * dy - j
        work[PART + r] = end if on else 0.0
        step_x, step_y = (1.0 if right > 0.0 else -1.0), (1.0 if down > 0.0 else -1.0)
        spacing_x, spacing_y = abs(spacing_x), abs(spacing_y)
        goes_on = end < 1.0
        over_x, over_y = goes_on & (next_x < next_y), goes_on & (not (next_x < next_y))
        i, j = i + (step_x if over_x else 0.0), j + (step_y if over_y else 0.0)
        next_x, next_y = next_x + (spacing_x if over_x else 0.0), next_y + (spacing_y if over_y else 0.0)
        work[AT_COLUMN + r], work[AT_ROW + r], work[LAST_COLUMN + r], work[LAST_ROW + r] = i, j, last_i, last_j
        work[NEXT_X + r], work[NEXT_Y + r] = (
            (next_x if i != last_i else NO_BORDER),
            (next_y if j != last_j else NO_BORDER),
        )
        work[SPACING_X + r], work[SPACING_Y + r] = spacing_x, spacing_y
        work[STEP_X + r], work[STEP_Y + r], work[START + r] = step_x, step_y, end
        work[FIRST_Y + r], work[DX + r], work[DY + r] = y, dx, dy
        going_on += goes_on
        beside += not on
    return going_on, beside


@inlined
def _next_pieces(count, columns_apart, work):
    """Set the next piece of each edge, of length 0 for those at their end; return the number of edges that go on."""
    going_on = 0
    for r in range(count):
        s, next_x, next_y, i, j = (
            work[START + r], work[NEXT_X + r], work[NEXT_Y + r], work[AT_COLUMN + r], work[AT_ROW + r]
        )  # fmt: skip
        end = next_x if next_x < next_y else next_y
        end = end if end < 1.0 else 1.0
        middle = 0.5 * (s + end)
        work[INDEX + r], work[PART + r], work[MIDDLE + r] = i * columns_apart + j, end - s, middle
        work[DEPTH + r] = work[FIRST_Y + r] + middle * work[DY + r] - j
        goes_on = end < 1.0
        over_x, over_y = goes_on & (next_x < next_y), goes_on & (not (next_x < next_y))
        i, j = i + (work[STEP_X + r] if over_x else 0.0), j + (work[STEP_Y + r] if over_y else 0.0)
        next_x = next_x + (work[SPACING_X + r] if over_x else 0.0)
        next_y = next_y + (work[SPACING_Y + r] if over_y else 0.0)
        work[AT_COLUMN + r], work[AT_ROW + r], work[START + r] = i, j, end
        work[NEXT_X + r] = next_x if i != work[LAST_COLUMN + r] else NO_BORDER
        work[NEXT_Y + r] = next_y if j != work[LAST_ROW + r] else NO_BORDER
        going_on += goes_on
    return going_on


@inlined
def _list_left_over(count, work):
    """List the edges that go on, without a branch; return their number."""
    left = 0
    for r in range(count):
        work[LEFT_OVER + left] = r
        left += work[START + r] < 1.0
    return left


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


# --- the sums of a picture --------------------------------------------------------------------------------------------


@inlined
def add_edges(sums, size, first_column, starts, ends, count, density, work):
    """Add D ∫ clip(j + 1 - y, 0, 1) dx along edges to sums (columns, rows + 1), as differences down the rows.

    sums: those of the columns from first_column on.  size: columns and rows of the picture.  starts, ends, density:
    offsets of the corners and of the densities D.
    """
    flat, apart = sums.reshape(-1), float(sums.shape[1])
    going_on, beside = _first_pieces(starts, ends, count, float(first_column), apart, work)
    for r in range(count):
        work[DX + r] *= work[density + r]
    _add_pieces(flat, count, work)
    while FEW_LEFT * going_on > count:
        going_on = _next_pieces(count, apart, work)
        _add_pieces(flat, count, work)
    if going_on > 0:
        _add_left_over(flat, count, apart, work)
    if beside > 0:
        for r in range(count):
            a, b = corner_at(starts, r, work), corner_at(ends, r, work)
            if a[4] | b[4] != ON and work[density + r] != 0.0:
                _add_edge_beside(sums, size, first_column, a, b, work[density + r])


@inlined
def _add_pieces(flat, count, work):
    for r in range(count):
        at, share = np.uint64(work[INDEX + r]), work[PART + r] * work[DX + r]
        low = share * work[DEPTH + r]
        flat[at] += share - low
        flat[at + np.uint64(1)] += low


@njit(error_model="numpy", fastmath={"contract"})
def _add_left_over(flat, count, columns_apart, work):
    """Follow the edges that go on to their ends."""
    for n in range(_list_left_over(count, work)):
        r = np.uint64(work[LEFT_OVER + n])
        s, next_x, next_y, i, j = (
            work[START + r], work[NEXT_X + r], work[NEXT_Y + r], work[AT_COLUMN + r], work[AT_ROW + r]
        )  # fmt: skip
        while True:
            end = min(next_x, next_y, 1.0)
            at, share = np.uint64(i * columns_apart + j), (end - s) * work[DX + r]
            low = share * (work[FIRST_Y + r] + 0.5 * (s + end) * work[DY + r] - j)
            flat[at] += share - low
            flat[at + np.uint64(1)] += low
            if not end < 1.0:
                break
            s = end
            if next_x < next_y:
                i += work[STEP_X + r]
                next_x = next_x + work[SPACING_X + r] if i != work[LAST_COLUMN + r] else NO_BORDER
            else:
                j += work[STEP_Y + r]
                next_y = next_y + work[SPACING_Y + r] if j != work[LAST_ROW + r] else NO_BORDER


@njit(error_model="numpy")
def _add_edge_beside(sums, size, first_column, a, b, density):
    """Do what `add_edges` does, for one edge that lies outside the screen, or partly."""
    columns, rows = size
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
            share, depth = (end - s) * dx * density, 0.0
            if j >= 0:
                depth = ay + 0.5 * (s + end) * dy - j
                sums[i - first_column, j + 1] += share * depth
            sums[i - first_column, max(j, 0)] += share * (1.0 - depth)
        if not end < 1.0:
            return
        s = end
        if next_x < next_y:
            i, next_x = _next_border(i, step_x, columns, next_x, spacing_x)
        else:
            j, next_y = _next_border(j, step_y, rows, next_y, spacing_y)


# --- integrals along edges --------------------------------------------------------------------------------------------


@inlined
def integrals_along(g, starts, ends, count, to, work):
    """Store (∫ H dx, ∫ (1 - s) G ds, ∫ s G ds) along edges at the offset `to` and the two that follow it.

    g (columns, rows, 2): G of each pixel, and the sum of G of the pixels below it (see clip.py).  Edges that lie
    outside the screen where no pixel is below them have integrals of 0, and so have edges with a corner out of range.
    """
    flat, apart = g.reshape(-1), float(g.shape[1])
    going_on, beside = _first_pieces(starts, ends, count, 0.0, apart, work)
    for r in range(count):
        work[PHI + r] = work[WHOLE + r] = work[SECOND + r] = 0.0
    _integrate_pieces(flat, count, work)
    while FEW_LEFT * going_on > count:
        going_on = _next_pieces(count, apart, work)
        _integrate_pieces(flat, count, work)
    if going_on > 0:
        _integrate_left_over(flat, count, apart, work)
    for r in range(count):
        second = work[SECOND + r]
        work[to + r], work[to + LENGTH + r] = work[PHI + r] * work[DX + r], work[WHOLE + r] - second
        work[to + 2 * LENGTH + r] = second
    if beside > 0:
        for r in range(count):
            a, b = corner_at(starts, r, work), corner_at(ends, r, work)
            if a[4] | b[4] != ON:
                reaches = (a[4] & b[4]) & ~ABOVE == 0 and (a[4] | b[4]) & OUT_OF_RANGE == 0
                phi, one, two = _integrate_beside(g, a, b) if reaches else (0.0, 0.0, 0.0)
                work[to + r], work[to + LENGTH + r], work[to + 2 * LENGTH + r] = phi, one, two


@inlined
def _integrate_pieces(flat, count, work):
    for r in range(count):  # a loop of its own, since loads from the picture are no vectors
        at = np.uint64(2.0 * work[INDEX + r])
        work[VALUE + r], work[BENEATH + r] = flat[at], flat[at + np.uint64(1)]
    for r in range(count):
        part, value = work[PART + r], work[VALUE + r]
        whole = part * value
        work[PHI + r] += part * work[BENEATH + r] + whole * (1.0 - work[DEPTH + r])
        work[WHOLE + r] += whole
        work[SECOND + r] += whole * work[MIDDLE + r]


@njit(error_model="numpy", fastmath={"contract"})
def _integrate_left_over(flat, count, columns_apart, work):
    """Follow the edges that go on to their ends."""
    for n in range(_list_left_over(count, work)):
        r = np.uint64(work[LEFT_OVER + n])
        s, next_x, next_y, i, j = (
            work[START + r], work[NEXT_X + r], work[NEXT_Y + r], work[AT_COLUMN + r], work[AT_ROW + r]
        )  # fmt: skip
        phi, whole, second = work[PHI + r], work[WHOLE + r], work[SECOND + r]
        while True:
            end = min(next_x, next_y, 1.0)
            middle, at = 0.5 * (s + end), np.uint64(2.0 * (i * columns_apart + j))
            value = (end - s) * flat[at]
            depth = work[FIRST_Y + r] + middle * work[DY + r] - j
            phi += (end - s) * flat[at + np.uint64(1)] + value * (1.0 - depth)
            whole += value
            second += value * middle
            if not end < 1.0:
                break
            s = end
            if next_x < next_y:
                i += work[STEP_X + r]
                next_x = next_x + work[SPACING_X + r] if i != work[LAST_COLUMN + r] else NO_BORDER
            else:
                j += work[STEP_Y + r]
                next_y = next_y + work[SPACING_Y + r] if j != work[LAST_ROW + r] else NO_BORDER
        work[PHI + r], work[WHOLE + r], work[SECOND + r] = phi, whole, second


@njit(error_model="numpy")
def _integrate_beside(g, a, b):
    """Return the integrals of `integrals_along` for one edge that lies outside the screen, or partly."""
    columns, rows = g.shape[0], g.shape[1]
    ax, ay, i, j, _ = a
    dx, dy = b[0] - ax, b[1] - ay
    step_x, next_x, spacing_x = _first_border(ax, i, dx, columns)
    step_y, next_y, spacing_y = _first_border(ay, j, dy, rows)
    s = phi = whole = second = 0.0
    while True:
        end = min(next_x, next_y, 1.0)
        if 0 <= i < columns and j < rows:
            if j < 0:
                phi += (end - s) * (g[i, 0, 0] + g[i, 0, 1])
            else:
                middle, value = 0.5 * (s + end), (end - s) * g[i, j, 0]
                phi += (end - s) * g[i, j, 1] + value * (j + 1.0 - (ay + middle * dy))
                whole += value
                second += value * middle
        if not end < 1.0:
            return phi * dx, whole - second, second
        s = end
        if next_x < next_y:
            i, next_x = _next_border(i, step_x, columns, next_x, spacing_x)
        else:
            j, next_y = _next_border(j, step_y, rows, next_y, spacing_y)
