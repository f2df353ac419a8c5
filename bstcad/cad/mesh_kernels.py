"""Loops over the triangles and corners of a mesh, compiled: a mesh has millions.

Each takes a share of the triangles, from `first` up to `last`, and lets go of the interpreter, so that threads can take
the shares.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit


class FaceNumbers(NamedTuple):
    """A face of a lens as plain numbers: z = z0 + Σ B_i(u) B_j(v) h_ij over a net, or a surface of revolution."""

    z: float  # z0 (mm)
    curvature: float  # 1/mm
    bend: float  # (1 + k) c² (1/mm²), k the conic constant
    equator: float  # surfaces.EQUATOR
    x: float  # the net's corner (mm)
    y: float
    per_x: float  # control points per mm
    per_y: float


@njit(inline="always")
def _basis(u, m):
    """Span and weights of the three control points along one axis (spline_basis.basis)."""
    if u < 1.5:
        k, s = 0, 2.0 - math.sqrt(4.0 - 2.0 * u)
    elif u > m - 2.5:
        k, s = m - 3, math.sqrt(4.0 - 2.0 * (m - 1 - u)) - 1.0
    else:
        k = min(int(u - 0.5), m - 3)
        s = u - 0.5 - k
    low = (1.0 if k == 0 else 0.5) * (1.0 - s) * (1.0 - s)
    high = (1.0 if k == m - 3 else 0.5) * s * s
    return k, low, 1.0 - low - high, high


@njit(inline="always")
def _sag(face, net, x, y):
    """z (mm) of a face; net (0, 0): it is a surface of revolution."""
    m = net.shape[0]
    if m == 0:
        r2 = x * x + y * y
        return face.z + face.curvature * r2 / (1.0 + math.sqrt(max(1.0 - face.bend * r2, face.equator)))
    i, a0, a1, a2 = _basis(min(max((x - face.x) * face.per_x, 0.0), m - 1.0), m)
    j, b0, b1, b2 = _basis(min(max((y - face.y) * face.per_y, 0.0), m - 1.0), m)
    h0 = b0 * net[i, j] + b1 * net[i, j + 1] + b2 * net[i, j + 2]
    h1 = b0 * net[i + 1, j] + b1 * net[i + 1, j + 1] + b2 * net[i + 1, j + 2]
    h2 = b0 * net[i + 2, j] + b1 * net[i + 2, j + 1] + b2 * net[i + 2, j + 2]
    return face.z + (a0 * h0 + a1 * h1 + a2 * h2)


@njit(inline="always")
def _cross(vertices, a, b, c):
    """(x, y, z) of the normal of a triangle, of twice its area's length."""
    p, q, r = (vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2])
    s, t, u = (vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2])
    return q * u - r * t, r * s - p * u, p * t - q * s


@njit(inline="always")
def _at(vertices, a, b, c, share):
    """The place with these shares of a triangle's corners."""
    p, q, r = share[0], share[1], share[2]
    x = p * vertices[a, 0] + q * vertices[b, 0] + r * vertices[c, 0]
    y = p * vertices[a, 1] + q * vertices[b, 1] + r * vertices[c, 1]
    return x, y, p * vertices[a, 2] + q * vertices[b, 2] + r * vertices[c, 2]


@njit(cache=True, nogil=True)
def reach(first, last, vertices, faces):
    """(up, down): the longest edge, along x or y (mm), of the triangles that face +z, and of those that face -z."""
    up = down = 0.0
    for k in range(first, last):
        a, b, c = faces[k]
        facing = _cross(vertices, a, b, c)[2]
        longest = 0.0
        for axis in range(2):
            p, q, r = vertices[a, axis], vertices[b, axis], vertices[c, axis]
            longest = max(longest, max(abs(p - q), max(abs(q - r), abs(r - p))))
        if facing > 0.0:
            up = max(up, longest)
        elif facing < 0.0:
            down = max(down, longest)
    return up, down


@njit(cache=True, nogil=True)
def _farthest(vertices, a, b, c, shares, face, net):
    """Largest distance along z (mm) of a face from a triangle, looked at where its corners have these shares."""
    farthest = 0.0
    for share in shares:
        x, y, z = _at(vertices, a, b, c, share)
        farthest = max(farthest, abs(_sag(face, net, x, y) - z))
    return farthest


@njit(cache=True, nogil=True)
def off_faces(first, last, vertices, faces, upright, on_back, back, back_net, on_front, front, front_net):
    """Largest distance (mm) of a face of the lens from a triangle, along the triangle's normal.

    on_back, on_front: (places, 3) shares of the corners at which one that faces +z, or -z, is looked at; one whose
    normal has no more than `upright` of its length along z belongs to the wall.
    """
    worst = 0.0
    for k in range(first, last):
        a, b, c = faces[k]
        n_x, n_y, n_z = _cross(vertices, a, b, c)
        length = math.sqrt(n_x * n_x + n_y * n_y + n_z * n_z)
        if n_z > upright * length:
            farthest = _farthest(vertices, a, b, c, on_back, back, back_net)
        elif -n_z > upright * length:
            farthest = _farthest(vertices, a, b, c, on_front, front, front_net)
        else:
            continue
        worst = max(worst, farthest * abs(n_z) / length)
    return worst


@njit(cache=True, nogil=True)
def off_wall(first, last, vertices, faces, upright, shares, radius):
    """Largest distance (mm) of a round wall from the triangles that stand upright."""
    worst = 0.0
    for k in range(first, last):
        a, b, c = faces[k]
        n_x, n_y, n_z = _cross(vertices, a, b, c)
        if abs(n_z) <= upright * math.sqrt(n_x * n_x + n_y * n_y + n_z * n_z):
            for share in shares:
                x, y, _ = _at(vertices, a, b, c, share)
                worst = max(worst, abs(radius - math.hypot(x, y)))
    return worst


@njit(cache=True, nogil=True)
def vertices_off(first, last, vertices, back, back_net, front, front_net):
    """Largest distance along z (mm) of a vertex from the nearer face."""
    worst = 0.0
    for k in range(first, last):
        x, y, z = vertices[k]
        off_back, off_front = abs(_sag(back, back_net, x, y) - z), abs(_sag(front, front_net, x, y) - z)
        worst = max(worst, min(off_back, off_front))
    return worst


@njit(cache=True, nogil=True)
def enclosed(first, last, vertices, faces, middle):
    """(six times the volume (mm³) between triangles and the point `middle`, twice their area (mm²))."""
    volume = area = 0.0
    for k in range(first, last):
        a, b, c = faces[k]
        n_x, n_y, n_z = _cross(vertices, a, b, c)
        area += math.sqrt(n_x * n_x + n_y * n_y + n_z * n_z)
        x, y, z = vertices[a, 0] - middle[0], vertices[a, 1] - middle[1], vertices[a, 2] - middle[2]
        volume += x * n_x + y * n_y + z * n_z
    return volume, area


@njit(cache=True, nogil=True)
def edges_in_pairs(faces, n):
    """Is each edge between two of the n vertices walked by two triangles, once in each direction?

    Edges a -> b are dealt out by b, then, in the order of b, by a, then, in the order of a, by b again: so both lists,
    of the ends that each vertex leads to and of those that lead to it, are sorted, as by a radix sort.
    """
    starts = np.zeros(n + 1, np.int64)
    for k in range(len(faces)):
        for corner in range(3):
            starts[faces[k, corner] + 1] += 1
    for k in range(n):
        starts[k + 1] += starts[k]
    fill, before = starts[:-1].copy(), np.empty(3 * len(faces), np.int32)
    for k in range(len(faces)):
        for corner in range(3):
            a, b = faces[k, corner], faces[k, (corner + 1) % 3]
            if fill[b] == starts[b + 1]:  # more edges lead there than away
                return False
            before[fill[b]] = a
            fill[b] += 1
    there = _dealt(starts, before)
    back = _dealt(starts, there)
    for k in range(n):
        for e in range(starts[k], starts[k + 1]):
            if there[e] != back[e] or (e > starts[k] and there[e] == there[e - 1]):
                return False
    return True


@njit(cache=True, nogil=True)
def _dealt(starts, others):
    """Vertex by vertex: to each of its others, this vertex."""
    fill, found = starts[:-1].copy(), np.empty_like(others)
    for k in range(len(starts) - 1):
        for e in range(starts[k], starts[k + 1]):
            other = others[e]
            found[fill[other]] = k
            fill[other] += 1
    return found


# ---- files -----------------------------------------------------------------------------------------------------------

PROBES = 1000  # places of a hash table that are looked at for one corner


@njit(cache=True, nogil=True)
def welded(bits):
    """(first corner of each group of equal ones, in order; group of each corner) of float32 corners (n, 3) as uint32.

    By a hash table that grows with the groups.  Both empty where too many corners share a place in it.
    """
    size = 1 << 16
    table = np.full(size, -1, np.int32)
    first, same, count = np.empty(len(bits), np.int32), np.empty(len(bits), np.int32), 0
    for k in range(len(bits)):
        if 2 * count > size:
            size *= 4
            table = np.full(size, -1, np.int32)
            for group in range(count):
                place = _free(bits, first, table, first[group])
                if place < 0:
                    return first[:0], same[:0]
                table[place] = group
        place = _free(bits, first, table, k)
        if place < 0:
            return first[:0], same[:0]
        if table[place] < 0:
            table[place] = count
            first[count] = k
            count += 1
        same[k] = table[place]
    return first[:count].copy(), same


@njit(inline="always")
def _free(bits, first, table, k):
    """Where the table holds the group of corner k, or is free for it; -1 if that is nowhere near."""
    x, y, z = bits[k, 0], bits[k, 1], bits[k, 2]
    key = np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)  # odd factors of no structure
    key += np.uint64(y) * np.uint64(0xC2B2AE3D27D4EB4F) + np.uint64(z) * np.uint64(0xD6E8FEB86659FD93)
    key ^= key >> np.uint64(32)
    place = np.int64(key & np.uint64(len(table) - 1))
    for _ in range(PROBES):
        group = table[place]
        if group < 0:
            return place
        other = first[group]
        if bits[other, 0] == x and bits[other, 1] == y and bits[other, 2] == z:
            return place
        place = (place + 1) & (len(table) - 1)
    return np.int64(-1)


@njit(cache=True, nogil=True)
def stl_triangles(vertices, faces, out):
    """Fill (n, 12) float32: the unit normal and the three corners of each triangle."""
    for k in range(len(faces)):
        a, b, c = faces[k]
        n_x, n_y, n_z = _cross(vertices, a, b, c)
        length = max(math.sqrt(n_x * n_x + n_y * n_y + n_z * n_z), 1e-300)
        out[k, 0], out[k, 1], out[k, 2] = n_x / length, n_y / length, n_z / length
        for axis in range(3):
            out[k, 3 + axis], out[k, 6 + axis] = vertices[a, axis], vertices[b, axis]
            out[k, 9 + axis] = vertices[c, axis]


@njit(cache=True, nogil=True)
def lines_of(words, numbers, decimals, out):
    """Write a line a row of whole `numbers` (n, 3), each between two of four `words`; the bytes written.

    words: (length, bytes ...) a row.  decimals: digits behind the point, of which no zeros at the end are written.
    """
    end = 0
    for row in numbers:
        for column in range(4):
            for letter in range(words[column, 0]):
                out[end] = words[column, 1 + letter]
                end += 1
            if column < 3:
                end = _number(row[column], decimals, out, end)
    return end


@njit(inline="always")
def _number(value, decimals, out, end):
    """Write a whole number, of which so many digits stand behind a point; where it ends."""
    if value < 0:
        out[end] = 45  # -
        end += 1
        value = -value
    while decimals > 0 and value % 10 == 0:
        value //= 10
        decimals -= 1
    digits, left = 1, value // 10
    while left > 0:
        digits += 1
        left //= 10
    digits = max(digits, decimals + 1)
    stop = end + digits + (1 if decimals > 0 else 0)
    at = stop - 1
    for k in range(digits):
        if k == decimals and k > 0:
            out[at] = 46  # .
            at -= 1
        out[at] = 48 + value % 10
        value //= 10
        at -= 1
    return stop
