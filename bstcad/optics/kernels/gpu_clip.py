"""Kernels (Warp) behind `tubes.collect` on a GPU: triangles of light, clipped exactly at the pixel borders.

One thread computes a tube.  Its triangles and their fluxes are those of the plain form, `tubes.collect_plain`.  A piece
of an edge between two pixel borders adds to its pixel and, as one number, to all pixels on its right; a running sum
along each row completes the picture.  Pixels are summed as integers of 64 bits, which no order of the threads changes,
so that a GPU repeats a design to the last bit.

With L the merit function, G = ∂L/∂I and H the sum of G from a pixel to the right end of its row, a triangle of flux f
and area A has ∂L/∂(f / A) = Q = -Σ (s_1 - s_0) Δy (H - o G) over the pieces of its edges, s from 0 to 1 along an edge
of height Δy and o the distance of the middle of a piece from the left border of its pixel.  An edge that moves by δ
sweeps the area δ · n ds, n its normal, so its ends have the gradients f / A ∫ (1 - s) G n ds and f / A ∫ s G n ds.

The source runs on a CPU, too (`wp.launch` on tensors of the CPU), where tests compare it with the plain form.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

from bstcad.optics.kernels.warp_launch import launch
from bstcad.optics.receivers.irradiance import Scale

UNITS = 2.0**50  # integers per total flux; a single term may be 2^13 times the total flux
FARTHEST = 1e9  # distance from the picture (pixels) from which on a tube counts as invalid

wp.set_module_options({"enable_backward": False, "fuse_fp": False})
Corners = wp.types.matrix(shape=(4, 2), dtype=wp.float64)
Three = wp.types.vector(length=3, dtype=wp.int32)
F = wp.float64


@wp.struct
class Rules:
    """Size of the picture, its scale, and the limits of `tubes.triangle_fluxes`."""

    columns: wp.int32
    rows: wp.int32
    x: wp.float64
    y: wp.float64
    per_x: wp.float64
    per_y: wp.float64
    thinnest: wp.float64
    even: wp.float64
    uneven: wp.float64


@wp.func
def corners_of(corner: wp.array3d(dtype=wp.float64), k: int, r: int, rules: Rules) -> Corners:
    """Return column and row (pixels) of the corners of a tube: 0 and 3 in row k, 1 and 2 in row k + 1."""
    c = Corners()
    for n in range(4):
        i, j = k, r
        if n == 1 or n == 2:
            i = k + 1
        if n >= 2:
            j = r + 1
        c[n, 0] = (corner[0, i, j] - rules.x) * rules.per_x
        c[n, 1] = (corner[1, i, j] - rules.y) * rules.per_y
    return c


@wp.func
def is_valid(c: Corners) -> bool:
    """Return True if all corners are finite and near the picture."""
    valid = bool(True)
    for n in range(4):
        for axis in range(2):
            valid = valid and wp.abs(c[n, axis]) < F(FARTHEST)  # False for NaN
    return valid


@wp.func
def triangle(odd: bool, number: int) -> Three:
    """Return the numbers of the corners of a triangle of a tube."""
    if number == 0:
        if odd:
            return Three(0, 1, 3)
        return Three(0, 1, 2)
    if odd:
        return Three(1, 2, 3)
    return Three(0, 2, 3)


@wp.func
def area_of(c: Corners, t: Three) -> wp.float64:
    """Return the signed area (pixel²) of a triangle."""
    one = (c[t[1], 0] - c[t[0], 0]) * (c[t[2], 1] - c[t[0], 1])
    return F(0.5) * (one - (c[t[2], 0] - c[t[0], 0]) * (c[t[1], 1] - c[t[0], 1]))


@wp.func
def is_whole(c: Corners, t: Three, area: wp.float64, rules: Rules) -> bool:
    """Return True for a triangle in one pixel, or one that is too thin: it gives its flux to a pixel."""
    same = bool(True)
    for axis in range(2):
        at = wp.floor(c[t[0], axis])
        same = same and wp.floor(c[t[1], axis]) == at and wp.floor(c[t[2], axis]) == at
    return same or wp.abs(area) < rules.thinnest


@wp.func
def pixel_of(c: Corners, t: Three, rules: Rules) -> wp.vec2i:
    """Return column and row of the pixel at the centroid of a triangle; (-1, -1) beside the picture."""
    x = wp.floor((c[t[0], 0] + c[t[1], 0] + c[t[2], 0]) / F(3.0))
    y = wp.floor((c[t[0], 1] + c[t[1], 1] + c[t[2], 1]) / F(3.0))
    if x >= F(0.0) and x < F(rules.columns) and y >= F(0.0) and y < F(rules.rows):
        return wp.vec2i(int(x), int(y))
    return wp.vec2i(-1, -1)


@wp.func
def apart(one: wp.float64, two: wp.float64, rules: Rules) -> wp.vec3d:
    """Return w of `tubes.triangle_fluxes` for the areas of a tube, and its derivatives in them; (1, 0, 0): uneven."""
    whole = one + two
    clipped = wp.min(wp.abs(one), wp.abs(two)) >= rules.thinnest
    if not (clipped and wp.abs(one - two) < rules.uneven * wp.abs(whole)):
        return wp.vec3d(F(1.0), F(0.0), F(0.0))
    difference, width = (one - two) / whole, rules.uneven - rules.even
    t = wp.clamp((wp.abs(difference) - rules.even) / width, F(0.0), F(1.0))
    slope = wp.sign(difference) * F(6.0) * t * (F(1.0) - t) / width * F(2.0) / (whole * whole)
    return wp.vec3d(t * t * (F(3.0) - F(2.0) * t), slope * two, -slope * one)


@wp.func
def fraction(k: int, one: wp.float64, two: wp.float64, w: wp.float64) -> wp.float64:
    """Return the fraction of the flux of a tube that its triangle k has."""
    if w == F(1.0):
        return F(0.5)
    part = one
    if k == 1:
        part = two
    return (F(1.0) - w) * part / (one + two) + w / F(2.0)


@wp.func
def next_border(a: wp.float64, d: wp.float64, at: int, end: int) -> wp.float64:
    """Return s of the next pixel border along an edge from a to a + d, which is in cell `at`; 2: it stays there."""
    if at == end:
        return F(2.0)
    border = at
    if end > at:
        border = at + 1
    return wp.clamp((F(border) - a) / d, F(0.0), F(1.0))


@wp.func
def cell_at(p: wp.float64, size: int) -> int:
    """Return the number of the cell of a coordinate: -1 before the picture, `size` behind it."""
    return int(wp.clamp(wp.floor(p), F(-1.0), F(size)))


@wp.func
def add(sums: wp.array2d(dtype=wp.int64), row: int, column: int, value: wp.float64, units: wp.float64):
    """Add a flux to a sum."""
    wp.atomic_add(sums, row, column, wp.int64(wp.round(value * units)))


@wp.func
def add_edge(
    sums: wp.array2d(dtype=wp.int64), c: Corners, start: int, end: int, weight: wp.float64, rules: Rules,
    units: wp.float64,
):  # fmt: skip
    """Add an edge of a triangle to the sums, piece by piece; weight: minus the density of the triangle."""
    a_x, a_y = c[start, 0], c[start, 1]
    d_x, d_y = c[end, 0] - a_x, c[end, 1] - a_y
    i, j = cell_at(a_x, rules.columns), cell_at(a_y, rules.rows)
    last_i, last_j = cell_at(c[end, 0], rules.columns), cell_at(c[end, 1], rules.rows)
    s = F(0.0)
    going = bool(True)
    while going:
        s_x, s_y = next_border(a_x, d_x, i, last_i), next_border(a_y, d_y, j, last_j)
        going = wp.min(s_x, s_y) < F(2.0)
        s_end = F(1.0)
        if going:
            s_end = wp.min(s_x, s_y)
        if j >= 0 and j < rules.rows and i < rules.columns:
            share = weight * (s_end - s) * d_y
            offset = F(0.0)
            if i >= 0:
                offset = a_x + (s + s_end) / F(2.0) * d_x - F(i)
            column = wp.max(i, 0)
            add(sums, j, column, share * (F(1.0) - offset), units)
            add(sums, j, column + 1, share * offset, units)
        if going and s_x <= s_y:
            i += wp.sign(last_i - i)
        elif going:
            j += wp.sign(last_j - j)
        s = s_end


@wp.func
def along(
    g: wp.array2d(dtype=wp.float64), right: wp.array2d(dtype=wp.float64), c: Corners, start: int, end: int, rules: Rules
) -> wp.vec3d:
    """Return (Q of an edge; ∫ (1 - s) G ds, ∫ s G ds along it); right: sums H of g from each column on."""
    a_x, a_y = c[start, 0], c[start, 1]
    d_x, d_y = c[end, 0] - a_x, c[end, 1] - a_y
    i, j = cell_at(a_x, rules.columns), cell_at(a_y, rules.rows)
    last_i, last_j = cell_at(c[end, 0], rules.columns), cell_at(c[end, 1], rules.rows)
    s = F(0.0)
    found = wp.vec3d(F(0.0), F(0.0), F(0.0))
    going = bool(True)
    while going:
        s_x, s_y = next_border(a_x, d_x, i, last_i), next_border(a_y, d_y, j, last_j)
        going = wp.min(s_x, s_y) < F(2.0)
        s_end = F(1.0)
        if going:
            s_end = wp.min(s_x, s_y)
        if j >= 0 and j < rules.rows and i < rules.columns:
            length = s_end - s
            value = right[j, wp.max(i, 0)]
            if i >= 0:
                middle = (s + s_end) / F(2.0)
                value -= (a_x + middle * d_x - F(i)) * g[j, i]
                found[1] += g[j, i] * length * (F(1.0) - middle)
                found[2] += g[j, i] * length * middle
            found[0] -= length * d_y * value
        if going and s_x <= s_y:
            i += wp.sign(last_i - i)
        elif going:
            j += wp.sign(last_j - j)
        s = s_end
    return found


@wp.func
def outside(p: wp.float64, size: int) -> wp.float64:
    """Return the signed distance (pixels) of a coordinate outside 0 … size; 0 inside."""
    return p - wp.clamp(p, F(0.0), F(size))


@wp.kernel
def collect_tubes(
    corner: wp.array3d(dtype=wp.float64), flux: wp.array2d(dtype=wp.float64), rules: Rules, units: wp.float64,
    sums: wp.array2d(dtype=wp.int64), far: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Add each tube to the sums (rows, columns + 1); far: flux · (mean squared distance of the corners outside)."""
    k, r = wp.tid()
    c = corners_of(corner, k, r, rules)
    if flux[k, r] == F(0.0) or not is_valid(c):
        return
    odd = (k + r) % 2 == 1
    one, two = area_of(c, triangle(odd, 0)), area_of(c, triangle(odd, 1))
    w = apart(one, two, rules)[0]
    for number in range(2):
        t = triangle(odd, number)
        area = one
        if number == 1:
            area = two
        its_flux = flux[k, r] * fraction(number, one, two, w)
        if is_whole(c, t, area, rules):
            pixel = pixel_of(c, t, rules)
            if pixel[0] >= 0:
                add(sums, pixel[1], pixel[0], its_flux, units)
                add(sums, pixel[1], pixel[0] + 1, -its_flux, units)
        else:
            for edge in range(3):
                add_edge(sums, c, t[edge], t[(edge + 1) % 3], -its_flux / area, rules, units)
    square = F(0.0)
    for n in range(4):
        square += outside(c[n, 0], rules.columns) ** F(2.0) + outside(c[n, 1], rules.rows) ** F(2.0)
    far[k, r] = flux[k, r] * square / F(4.0)


@wp.kernel
def collect_adjoint(
    corner: wp.array3d(dtype=wp.float64), flux: wp.array2d(dtype=wp.float64), rules: Rules,
    g: wp.array2d(dtype=wp.float64), right: wp.array2d(dtype=wp.float64), g_far: wp.array(dtype=wp.float64),
    d_corner: wp.array4d(dtype=wp.float64), d_flux: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Set the gradients of each tube in its corners, d_corner (4, 2, n, m), and in its flux, d_flux (n, m)."""
    k, r = wp.tid()
    c = corners_of(corner, k, r, rules)
    if not is_valid(c):
        return
    whole_flux, odd = flux[k, r], (k + r) % 2 == 1
    one, two = area_of(c, triangle(odd, 0)), area_of(c, triangle(odd, 1))
    w = apart(one, two, rules)
    both = one + two
    d = Corners()
    by_one, by_two, by_flux = F(0.0), F(0.0), F(0.0)  # ∂L/∂A_1, ∂L/∂A_2, ∂L/∂F
    for number in range(2):
        t = triangle(odd, number)
        area = one
        if number == 1:
            area = two
        part = fraction(number, one, two, w[0])
        mean = F(0.0)  # ∂L/∂(flux of the triangle)
        if is_whole(c, t, area, rules):
            pixel = pixel_of(c, t, rules)
            if pixel[0] >= 0:
                mean = g[pixel[1], pixel[0]]
        else:
            density = whole_flux * part / area
            q = F(0.0)
            for edge in range(3):
                start, end = t[edge], t[(edge + 1) % 3]
                found = along(g, right, c, start, end, rules)
                d_x, d_y = c[end, 0] - c[start, 0], c[end, 1] - c[start, 1]
                q += found[0]
                d[start, 0] += density * found[1] * d_y
                d[start, 1] -= density * found[1] * d_x
                d[end, 0] += density * found[2] * d_y
                d[end, 1] -= density * found[2] * d_x
            mean = q / area
            if number == 0:
                by_one -= density * mean
            else:
                by_two -= density * mean
        by_flux += part * mean
        if w[0] < F(1.0):
            by_w = mean * whole_flux * (F(0.5) - area / both)
            shared = mean * whole_flux * (F(1.0) - w[0]) / (both * both)
            by_one += by_w * w[1]
            by_two += by_w * w[2]
            if number == 0:
                by_one += shared * two
                by_two -= shared * one
            else:
                by_one -= shared * two
                by_two += shared * one
    for number in range(2):
        t = triangle(odd, number)
        half = F(0.5) * by_one
        if number == 1:
            half = F(0.5) * by_two
        for n in range(3):
            after, before = t[(n + 1) % 3], t[(n + 2) % 3]
            d[t[n], 0] += half * (c[after, 1] - c[before, 1])
            d[t[n], 1] += half * (c[before, 0] - c[after, 0])
    square = F(0.0)
    for n in range(4):
        off_x, off_y = outside(c[n, 0], rules.columns), outside(c[n, 1], rules.rows)
        square += off_x * off_x + off_y * off_y
        d_corner[n, 0, k, r] = rules.per_x * (d[n, 0] + F(0.5) * g_far[0] * whole_flux * off_x)
        d_corner[n, 1, k, r] = rules.per_y * (d[n, 1] + F(0.5) * g_far[0] * whole_flux * off_y)
    d_flux[k, r] = by_flux + g_far[0] * square / F(4.0)


class Clip(torch.autograd.Function):
    """Map (corner (2, n + 1, m + 1), flux (n, m), picture, rules) to (picture, outside): see `tubes.collect`.

    picture: its (rows, columns) and its scale.  rules: smallest area of a triangle that is followed (pixel²), and the
    limits of `tubes.triangle_fluxes`.  The gradient is taken in the corners and in the flux.
    """

    @staticmethod
    def forward(  # noqa: D102
        ctx: Any, corner: Tensor, flux: Tensor, picture: tuple[tuple[int, int], Scale], rules: tuple[float, ...]
    ) -> Any:
        (rows, columns), scale = picture
        corner, flux = corner.detach().contiguous(), flux.detach().contiguous()
        ctx.save_for_backward(corner, flux)
        ctx.rules = _rules(columns, rows, scale, rules)
        units = UNITS / max(float(flux.abs().sum()), 1e-300)
        sums = torch.zeros((rows, columns + 1), dtype=torch.int64, device=flux.device)
        far = torch.zeros_like(flux)
        launch(collect_tubes, flux.shape, corner, flux, ctx.rules, units, sums, far)
        return sums.cumsum(1)[:, :columns].double() / units, far.sum()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g: Tensor, g_far: Tensor) -> Any:  # noqa: D102
        corner, flux = ctx.saved_tensors
        g = g.contiguous()
        right = torch.nn.functional.pad(g.flip(1).cumsum(1).flip(1), (0, 1)).contiguous()
        by_tube = torch.zeros((4, 2, *flux.shape), dtype=torch.float64, device=flux.device)
        d_flux = torch.zeros_like(flux)
        launch(collect_adjoint, flux.shape, corner, flux, ctx.rules, g, right, g_far.reshape(1), by_tube, d_flux)
        d_corner = torch.zeros_like(corner)
        for n, (rows, columns) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
            d_corner[:, rows : rows + flux.shape[0], columns : columns + flux.shape[1]] += by_tube[n]
        return d_corner, d_flux if ctx.needs_input_grad[1] else None, None, None


def _rules(columns: int, rows: int, scale: Scale, limits: tuple[float, ...]) -> Any:
    rules = Rules()
    rules.columns, rules.rows = columns, rows
    rules.x, rules.y, rules.per_x, rules.per_y = scale
    rules.thinnest, rules.even, rules.uneven = limits
    return rules
