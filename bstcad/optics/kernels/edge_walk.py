"""The walk along one edge of a triangle of light, from pixel border to pixel border, for the fused CPU kernels (numba).

What it adds to the picture and what its adjoint needs of an edge stands in clip.py.
"""

from __future__ import annotations

import math

from numba import njit

FARTHEST = 1e15  # pixels; what lands farther away has no digits left to be cut by
NEVER = 1e300  # the next border of a walk that crosses no more borders of a kind

ON, NOWHERE = 0, 16  # of a corner: on the screen; farther than FARTHEST, or not a number
LEFT, RIGHT, ABOVE, BELOW = 1, 2, 4, 8  # or beyond one or two of its borders

inlined = njit(forceinline=True, error_model="numpy")


# --- corners and triangles --------------------------------------------------------------------------------------------


@inlined
def place_of(x, y, columns, rows):
    """(column, row, where) of a point; -1 is all before the screen, `columns` and `rows` are all behind it."""
    if 0.0 <= x < columns and 0.0 <= y < rows:
        return int(x), int(y), ON
    if not abs(x) + abs(y) < FARTHEST:
        return 0, 0, NOWHERE
    i, j = int(math.floor(min(max(x, -1.0), float(columns)))), int(math.floor(min(max(y, -1.0), float(rows))))
    return i, j, LEFT * (i < 0) + RIGHT * (i >= columns) + ABOVE * (j < 0) + BELOW * (j >= rows)


@inlined
def corner_at(corner, k, r, columns, rows):
    """(x, y, column, row, where) of one corner."""
    x, y = corner[0, k, r], corner[1, k, r]
    i, j, where = place_of(x, y, columns, rows)
    return x, y, i, j, where


@inlined
def same_cell(a, b):
    """Do two corners lie in one pixel, or in one of the cells beyond the screen?"""
    return a[2] == b[2] and a[3] == b[3]


@inlined
def in_one_cell(a, b, c):
    """Do the three corners lie in one pixel, or in one of the cells beyond the screen?"""
    return same_cell(a, b) and same_cell(a, c)


@inlined
def all_beside(a, b, c):
    """Do the three corners lie on one side of the screen, beyond it, or is one of them nowhere?"""
    return (a[4] & b[4] & c[4]) | ((a[4] | b[4] | c[4]) & NOWHERE) != 0


@inlined
def area_of(a, b, c):
    """Signed (pixel²)."""
    return 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]))


@inlined
def beyond(p, size):
    """Signed distance beyond the border."""
    return p - min(max(p, 0.0), size)


@inlined
def half_square_off(a, b, c, d, columns, rows):
    """Half the sum of the corners' squared distances beyond the border."""
    off = beyond(a[0], columns) ** 2 + beyond(b[0], columns) ** 2
    off += beyond(c[0], columns) ** 2 + beyond(d[0], columns) ** 2
    off += beyond(a[1], rows) ** 2 + beyond(b[1], rows) ** 2
    off += beyond(c[1], rows) ** 2 + beyond(d[1], rows) ** 2
    return 0.5 * off


# --- the walk along one edge ------------------------------------------------------------------------------------------


@inlined
def _first(start, cell, d, size):
    """(step, s of the next border, s from border to border) along one axis; beyond the screen is one cell."""
    if d > 0.0 and cell < size:
        return 1, (cell + 1 - start) / d, 1.0 / d
    if d < 0.0 and cell >= 0:
        return -1, (cell - start) / d, -1.0 / d
    return 0, NEVER, NEVER


@inlined
def _crossed(cell, step, size, reached, over):
    """(cell, s of the next border) behind the border at s = `reached`."""
    cell += step
    return cell, NEVER if (cell < 0 or cell >= size) else reached + over


@inlined
def _one_border(a, b):
    """s at the border between the neighbouring pixels of a and b."""
    if a[2] != b[2]:
        return (max(a[2], b[2]) - a[0]) / (b[0] - a[0])
    return (max(a[3], b[3]) - a[1]) / (b[1] - a[1])


@inlined
def _add_piece(sums, i, j, share, middle):
    """A piece of an edge in pixel (i, j), with its middle at y = `middle`."""
    below = middle - j
    sums[i, j] += share * (1.0 - below)
    sums[i, j + 1] += share * below


@inlined
def add_edge(sums, a, b, density):
    """Adds ∫ clip(j + 1 - y, 0, 1) dx of an edge, times a density; sums (columns, rows + 1), before the running sum."""
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
    _add_walk(sums, a, b, density)


@njit(error_model="numpy")
def _add_walk(sums, a, b, density):
    """`add_edge` across any number of borders."""
    columns, rows = sums.shape[0], sums.shape[1] - 1
    ax, ay, i, j, _ = a
    dx, dy = b[0] - ax, b[1] - ay
    if dx == 0.0:
        return
    step_x, next_x, over_x = _first(ax, i, dx, columns)
    step_y, next_y, over_y = _first(ay, j, dy, rows)
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
            i, next_x = _crossed(i, step_x, columns, next_x, over_x)
        else:
            j, next_y = _crossed(j, step_y, rows, next_y, over_y)


@inlined
def _of_piece(g, below_g, i, j, middle):
    """(G, mean H) of a piece of an edge in pixel (i, j), with its middle at y = `middle`."""
    value = g[i, j]
    return value, below_g[i, j + 1] + (j + 1 - middle) * value


@inlined
def along_edge(g, below_g, a, b):
    """(∫ H dx, ∫ (1 - s) G ds, ∫ s G ds) along an edge; g (columns, rows), below_g sums it from a row on."""
    if a[4] | b[4] == ON:
        borders = abs(a[2] - b[2]) + abs(a[3] - b[3])
        dx, dy = b[0] - a[0], b[1] - a[1]
        if borders == 0:
            value, h = _of_piece(g, below_g, a[2], a[3], a[1] + 0.5 * dy)
            return h * dx, 0.5 * value, 0.5 * value
        if borders == 1:
            s = _one_border(a, b)
            one, phi_one = _of_piece(g, below_g, a[2], a[3], a[1] + 0.5 * s * dy)
            two, phi_two = _of_piece(g, below_g, b[2], b[3], a[1] + 0.5 * (1.0 + s) * dy)
            whole, second = s * one + (1.0 - s) * two, 0.5 * (s * s * one + (1.0 - s) * (1.0 + s) * two)
            return (s * phi_one + (1.0 - s) * phi_two) * dx, whole - second, second
    return _along_walk(g, below_g, a, b)


@njit(error_model="numpy")
def _along_walk(g, below_g, a, b):
    """`along_edge` across any number of borders."""
    columns, rows = g.shape
    ax, ay, i, j, _ = a
    dx, dy = b[0] - ax, b[1] - ay
    step_x, next_x, over_x = _first(ax, i, dx, columns)
    step_y, next_y, over_y = _first(ay, j, dy, rows)
    s = phi = whole = second = 0.0
    while True:
        end = min(next_x, next_y, 1.0)
        if 0 <= i < columns and j < rows:
            length = end - s
            if j < 0:
                phi += length * below_g[i, 0]
            else:
                middle = 0.5 * (s + end)
                value, h = _of_piece(g, below_g, i, j, ay + middle * dy)
                phi += length * h
                whole += length * value
                second += length * middle * value
        if not end < 1.0:
            return phi * dx, whole - second, second
        s = end
        if next_x < next_y:
            i, next_x = _crossed(i, step_x, columns, next_x, over_x)
        else:
            j, next_y = _crossed(j, step_y, rows, next_y, over_y)
