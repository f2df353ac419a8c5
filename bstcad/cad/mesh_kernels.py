"""Loops over the triangles and corners of a mesh, compiled: a mesh has millions of them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

PROBES = 1000  # slots of a hash table at most in which the group of a corner is looked for


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
    per_detail: float  # smooth parts per mm: 1 / Surface.detail


@njit(inline="always")
def _basis(u, m):
    """Span and weights of three control points (bspline.basis; numba's cache misses changes in other files)."""
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


@njit(cache=True, nogil=True)
def _off_face(a, b, c, parts, face, net):
    """Largest distance along z (mm) of a face from the triangle a, b, c, whose edges are divided into 2 x parts.

    Compared are its centre and all points of that division but the corners.
    """
    n = 2 * parts
    worst = abs(_sag(face, net, (a[0] + b[0] + c[0]) / 3, (a[1] + b[1] + c[1]) / 3) - (a[2] + b[2] + c[2]) / 3)
    for i in range(n):
        for j in range(n + 1 - i):
            p, q, r = i / n, j / n, (n - i - j) / n
            if max(p, q, r) < 1.0:
                x, y = p * a[0] + q * b[0] + r * c[0], p * a[1] + q * b[1] + r * c[1]
                worst = max(worst, abs(_sag(face, net, x, y) - (p * a[2] + q * b[2] + r * c[2])))
    return worst


@njit(cache=True, nogil=True)
def chordal_error(vertices, faces, upright, most, radius, back, back_net, front, front_net):
    """Largest distance (mm) of the lens from triangles, along their normals.

    A triangle whose normal has no more than `upright` of its length along z belongs to the wall, a cylinder of the
    given radius, or planes (radius 0).  most: parts of a triangle's edges at most, else one for each smooth part.
    """
    worst = 0.0
    for k in range(len(faces)):
        a, b, c = vertices[faces[k, 0]], vertices[faces[k, 1]], vertices[faces[k, 2]]
        p, q, r, s, t, u = b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]
        n_z = p * t - q * s
        length = math.sqrt((q * u - r * t) ** 2 + (r * s - p * u) ** 2 + n_z * n_z)
        if abs(n_z) > upright * length:
            reach = max(abs(p), abs(q), abs(s), abs(t), abs(p - s), abs(q - t))
            face, net = (back, back_net) if n_z > 0.0 else (front, front_net)
            parts = min(most, max(1, math.ceil(reach * face.per_detail)))
            worst = max(worst, _off_face(a, b, c, parts, face, net) * abs(n_z) / length)
        elif radius > 0.0:
            for x, y in ((a[0] + b[0], a[1] + b[1]), (b[0] + c[0], b[1] + c[1]), (c[0] + a[0], c[1] + a[1])):
                worst = max(worst, abs(radius - math.hypot(x, y) / 2))
    return worst


@njit(cache=True, nogil=True)
def welded(bits):
    """(first corner of each group of equal ones, group of each corner) of float32 corners (n, 3) as uint32.

    By a hash table.  Both are empty where more than PROBES groups would share a slot of it, as in a hostile file.
    """
    size = 1 << 16
    while size < 1.25 * len(bits):
        size *= 2
    table, first, same = np.full(size, -1, np.int32), np.empty(len(bits), np.int32), np.empty(len(bits), np.int32)
    count = 0
    for k in range(len(bits)):
        x, y, z = bits[k, 0], bits[k, 1], bits[k, 2]
        key = np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)  # odd factors of no structure
        key += np.uint64(y) * np.uint64(0xC2B2AE3D27D4EB4F) + np.uint64(z) * np.uint64(0xD6E8FEB86659FD93)
        slot = np.int64((key ^ (key >> np.uint64(32))) & np.uint64(size - 1))
        for _ in range(PROBES):
            group = table[slot]
            if group < 0:
                group = table[slot] = count
                first[count] = k
                count += 1
            other = first[group]
            if bits[other, 0] == x and bits[other, 1] == y and bits[other, 2] == z:
                same[k] = group
                break
            slot = (slot + 1) & (size - 1)
        else:
            return first[:0], same[:0]
    return first[:count].copy(), same
