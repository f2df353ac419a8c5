"""Fused CPU kernel (numba) behind `simulation.simulate`: stratified rays from the source to pixels, none kept.

Each part (see reductions.py) takes rows of cells and carries them, in blocks, through the steps of the plain torch
form, which stays the reference: launch, front face, back face, screen, pixel.  A block stays in the first-level cache
(`work`: BLOCK numbers of each quantity, at the place of its name).  Steps without a table run in vector registers; in
the search for the back face all rays of a block take a Newton step in turn, so that none waits for its own last one.
Arithmetic is float64 whatever the net's precision; memory is a pair of pictures a part, however many rays there are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.irradiance import LEDGER, Screen
from bstcad.optics.kernels import kernel_arguments, reductions
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.planes import TargetPlane
from bstcad.optics.rays import Landed, Status
from bstcad.optics.sources import Collimated, Point, Source

BLOCK = 256  # rays
# Where each quantity begins in `work`; constants, so that the compiler sees that they do not overlap.
X, Y, Z, DX, DY, DZ, FLUX, FATE, S, SAG, SLOPE_X, SLOPE_Y, U, V, U_S, V_S = (BLOCK * k for k in range(16))
WORK = 16 * BLOCK
LINES = 7  # the flux by Status (alive ones: on the screen), then what lands beside the screen, then the number of rays
BESIDE, COUNT = 5, 6


@njit(error_model="numpy")
def _points(cells, i, j, count, work):
    """The points of cells (i, j), …, (i, j + count - 1): `sampling.stratified_strips`."""
    for r in range(count):
        z = cells.key + np.uint64(i * cells.n + j + r) * cells.stride
        z = (z ^ (z >> np.uint64(30))) * cells.mix_1
        z = (z ^ (z >> np.uint64(27))) * cells.mix_2
        z ^= z >> np.uint64(31)
        jitter_x = (np.int64(z >> np.uint64(32)) + 0.5) * 2.0**-32
        jitter_y = (np.int64(z & np.uint64(0xFFFFFFFF)) + 0.5) * 2.0**-32
        work[X + r] = (jitter_x + i) * cells.width - cells.half_x
        work[Y + r] = (jitter_y + (j + r)) * cells.height - cells.half_y


@njit(error_model="numpy")
def _launch(beam, count, work):
    """Flux density and direction of the rays through the points: `source.irradiance`, `source.rays`."""
    for r in range(count):
        x, y = work[X + r] - beam.x, work[Y + r] - beam.y
        r2 = x * x + y * y
        lit = (abs(x) <= beam.limit_x) & (abs(y) <= beam.limit_y) & (r2 <= beam.limit_r2)
        work[FLUX + r] = beam.peak if lit else 0.0
        work[S + r] = r2
    if beam.fall > 0.0 and (beam.tilted == 0 or beam.distance == 0.0):
        for r in range(count):
            work[FLUX + r] *= math.exp(-beam.fall * work[S + r])
    if beam.distance == 0.0:
        for r in range(count):
            work[DX + r], work[DY + r], work[DZ + r] = beam.n_x, beam.n_y, beam.n_z
        return
    for r in range(count):
        d2 = work[S + r] + beam.distance * beam.distance
        d = math.sqrt(d2)
        work[DX + r] = (work[X + r] - beam.x) / d
        work[DY + r] = (work[Y + r] - beam.y) / d
        work[DZ + r] = beam.distance / d
        work[FLUX + r] /= d2 * d2 if beam.power == 4 else (d2 * d if beam.power == 3 else 1.0)


@njit(error_model="numpy")
def _tilt(beam, count, work):
    """Flux density of the rays of a tilted point source, in place of the one for light along z."""
    for r in range(count):
        x, y = work[X + r] - beam.x, work[Y + r] - beam.y
        d2 = x * x + y * y + beam.distance * beam.distance
        d = math.sqrt(d2)
        c = beam.n_x * x + beam.n_y * y + beam.n_z * beam.distance
        e = 0.0
        if (c > 0.0) & (c >= beam.least * d):
            if beam.power == 4:
                e = c / (d2 * d2)
            elif beam.power == 3:
                e = 1.0 / (d2 * d)
            else:
                e = math.exp(-beam.fall * ((d2 - c * c) / (c * c))) / (c * c * c)
        work[FLUX + r] = beam.peak * e


@njit(error_model="numpy")
def _meet_front(faces, axial, count, work):
    """To the front face: `interfaces.intersect` with `Conic.crossing`, or with the sag for rays along the axis."""
    c, conic, equator = faces.curvature, 1.0 + faces.conic_constant, faces.rules.equator
    for r in range(count):
        x, y, dx, dy, dz = work[X + r], work[Y + r], work[DX + r], work[DY + r], work[DZ + r]
        met = True
        z = 0.0
        if not axial:
            f = c * (x * x + y * y)
            g = dz - c * (x * dx + y * dy)
            k = g * g - c * (1.0 + faces.conic_constant * dz * dz) * f
            below = g + math.sqrt(k if k > 0.0 else 1.0)
            ok = (k > 0.0) & (below > 1e-6)
            s = f / (below if ok else 1.0)
            met = ok & (conic * c * s * dz < 1.0)
            x, y, z = x + s * dx, y + s * dy, s * dz
        r2 = x * x + y * y
        k = 1.0 - conic * c * c * r2
        root = math.sqrt(max(k, equator))
        inside = (k > equator) & (abs(x) <= faces.limit_x) & (abs(y) <= faces.limit_y) & (r2 <= faces.limit_r2)
        work[X + r], work[Y + r] = x, y
        work[Z + r] = c * r2 / (1.0 + root) if axial else z
        work[SLOPE_X + r], work[SLOPE_Y + r] = c * x / root, c * y / root
        work[FATE + r] = 0.0 if met & inside else faces.fates.missed_front


@njit(error_model="numpy")
def _reflect(turned, count, work):
    """The law of reflection at the slopes held in `work`: `interfaces.Reflect`."""
    for r in range(count):
        p, q = work[SLOPE_X + r], work[SLOPE_Y + r]
        dx, dy, dz = work[DX + r], work[DY + r], work[DZ + r]
        along = dz - p * dx - q * dy
        shift = -2.0 * along / (1.0 + p * p + q * q)
        work[DX + r] = dx - shift * p
        work[DY + r] = dy - shift * q
        work[DZ + r] = dz + shift
        fate = work[FATE + r]
        work[FATE + r] = fate if (along > 0.0) | (fate != 0.0) else turned


@njit(error_model="numpy")
def _refract(eta, reflected, count, work):
    """Snell's law at the slopes held in `work`: `interfaces.Refract`."""
    for r in range(count):
        p, q = work[SLOPE_X + r], work[SLOPE_Y + r]
        dx, dy, dz = work[DX + r], work[DY + r], work[DZ + r]
        norm2 = 1.0 / (1.0 + p * p + q * q)
        along = dz - p * dx - q * dy
        cos2 = 1.0 - eta * eta * (1.0 - along * along * norm2)
        through = (cos2 > 0.0) & (along > 0.0)
        shift = math.sqrt((cos2 if through else 1.0) * norm2) - eta * along * norm2
        work[DX + r] = eta * dx - shift * p
        work[DY + r] = eta * dy - shift * q
        work[DZ + r] = eta * dz + shift
        fate = work[FATE + r]
        work[FATE + r] = fate if through | (fate != 0.0) else reflected


@njit(error_model="numpy", fastmath={"contract"})
def _basis(u, m):
    """(k, B_k, B_{k+2}, -dB_k/du, dB_{k+2}/du) at u; the middle one is what is missing to 1 (spline_basis.basis)."""
    if 1.5 <= u <= m - 2.5:
        k = int(u - 0.5)
        s = u - 0.5 - k
        q = 1.0 - s
        return k, 0.5 * q * q, 0.5 * s * s, q, s
    if u < 1.5:
        k, s = 0, 2.0 - math.sqrt(4.0 - 2.0 * u)
    else:
        k, s = m - 3, math.sqrt(4.0 - 2.0 * (m - 1 - u)) - 1.0
    q = 1.0 - s
    a = 1.0 if k == 0 else 0.5
    b = 1.0 if k == m - 3 else 0.5
    r = 1.0 / (a * q + b * s)
    return k, a * q * q, b * s * s, a * q * r, b * s * r


@njit(inline="always")
def _sag(net, m, u, v):
    """(h, ∂h/∂u, ∂h/∂v) as sums over differences of neighbouring heights; net is flat (see spline_basis.evaluate)."""
    i, a0, a2, p0, p2 = _basis(u, m)
    j, b0, b2, q0, q2 = _basis(v, m)
    at = np.uint64(i * m + j)  # unsigned: no test for an index from the end
    middle = net[at + np.uint64(1)]
    low, high = middle - net[at], net[at + np.uint64(2)] - middle
    f0, g0 = middle - b0 * low + b2 * high, q0 * low + q2 * high
    at += np.uint64(m)
    middle = net[at + np.uint64(1)]
    low, high = middle - net[at], net[at + np.uint64(2)] - middle
    f1, g1 = middle - b0 * low + b2 * high, q0 * low + q2 * high
    at += np.uint64(m)
    middle = net[at + np.uint64(1)]
    low, high = middle - net[at], net[at + np.uint64(2)] - middle
    f2, g2 = middle - b0 * low + b2 * high, q0 * low + q2 * high
    low, high = f1 - f0, f2 - f1
    return f1 - a0 * low + a2 * high, p0 * low + p2 * high, g1 - a0 * (g1 - g0) + a2 * (g2 - g1)


@njit(error_model="numpy")
def _first_root(net, faces, x, y, z, dx, dy, dz):
    """(s, found): path of a ray steep to the net to its first crossing (see intersection.py); z from its plane."""
    last, flattest = faces.m - 1.0, faces.rules.flattest
    u, v, u_s, v_s = (x - faces.x) * faces.per_x, (y - faces.y) * faces.per_y, dx * faces.per_x, dy * faces.per_y
    rate = abs(dz) + faces.steepest_x * abs(dx) + faces.steepest_y * abs(dy)
    s = below = 0.0
    arrived = False
    for step in range(int(faces.rules.approach_steps + faces.rules.newton_steps)):
        a, b = u + s * u_s, v + s * v_s
        h, h_u, h_v = _sag(net, faces.m, min(max(a, 0.0), last), min(max(b, 0.0), last))
        residual, slope = z + s * dz - h, dz - h_u * u_s - h_v * v_s
        if arrived:
            if abs(residual) <= faces.tolerance:
                return s, abs(s - below) <= faces.near / flattest
            s -= residual / (slope if abs(slope) > flattest else (-flattest if slope < 0.0 else flattest))
            continue
        gone = (a > last and u_s > 0.0) or (a < 0.0 and u_s < 0.0) or (z + s * dz < faces.lowest and dz <= 0.0)
        gone |= (b > last and v_s > 0.0) or (b < 0.0 and v_s < 0.0)
        if gone or (step == 0 and not residual < 0.0):
            break
        arrived, below = residual >= -faces.near, s
        s -= residual / rate
    return s, False


@njit(error_model="numpy")
def _start_search(net, faces, count, work):
    """Where the search begins, as path from the net's plane: there, but for rays that are steep to the net."""
    for r in range(count):
        work[S + r] = 0.0
    for r in range(count):
        dx, dy, dz = work[DX + r], work[DY + r], work[DZ + r]
        steep = not dz > faces.steepest_x * abs(dx) + faces.steepest_y * abs(dy)
        if steep and work[FATE + r] == 0.0 and work[FLUX + r] > 0.0:
            z = work[Z + r] - faces.gap
            s, found = _first_root(net, faces, work[X + r], work[Y + r], z, dx, dy, dz)
            work[S + r] = s + z / dz
            work[FATE + r] = 0.0 if found and abs(dz) > faces.rules.level else faces.fates.missed_back


@njit(error_model="numpy")
def _to_net(faces, count, work):
    """To the plane the net's heights are measured from; u, v there and ∂u/∂s, ∂v/∂s along the ray."""
    for r in range(count):
        dx, dy = work[DX + r], work[DY + r]
        start = (faces.gap - work[Z + r]) / work[DZ + r]
        x, y = work[X + r] + start * dx, work[Y + r] + start * dy
        work[X + r], work[Y + r], work[Z + r] = x, y, start
        work[U + r], work[V + r] = (x - faces.x) * faces.per_x, (y - faces.y) * faces.per_y
        work[U_S + r], work[V_S + r] = dx * faces.per_x, dy * faces.per_y


@njit(error_model="numpy", fastmath={"contract"})
def _search(net, faces, count, work, active):
    """Path s from the net's plane to the back by Newton steps, each for all still searching: `intersection._newton`.

    `work` ends with s after a ray's last step, and with sag and slopes (in u and v) before it.
    """
    last, flattest = faces.m - 1.0, faces.rules.flattest
    searching = 0
    for r in range(count):
        active[searching] = r
        searching += (work[FATE + r] == 0.0) & (work[FLUX + r] > 0.0)
    for _ in range(int(faces.rules.newton_steps)):
        still = 0
        for a in range(searching):
            r = active[a]
            s, u_s, v_s, dz = work[S + r], work[U_S + r], work[V_S + r], work[DZ + r]
            u, v = work[U + r] + s * u_s, work[V + r] + s * v_s
            out_u, out_v = not 0.0 <= u <= last, not 0.0 <= v <= last
            if out_u or out_v:
                u, v = min(max(u, 0.0), last), min(max(v, 0.0), last)
            h, h_u, h_v = _sag(net, faces.m, u, v)
            residual, slope = s * dz - h, dz - h_u * u_s - h_v * v_s
            if out_u or out_v:  # beyond the net the sag goes on level across the rim
                slope += (h_u * u_s if out_u else 0.0) + (h_v * v_s if out_v else 0.0)
            if abs(slope) < flattest:
                slope = -flattest if slope < 0.0 else flattest  # keeps the sign
            work[S + r] = s - residual / slope
            work[SAG + r], work[SLOPE_X + r], work[SLOPE_Y + r] = h, h_u, h_v
            active[still] = r
            # along the axis one step is exact: x and y do not move
            still += not (abs(residual) <= faces.tolerance or (u_s == 0.0 and v_s == 0.0))
        searching = still
    for a in range(searching):
        work[FATE + active[a]] = faces.fates.missed_back


@njit(error_model="numpy")
def _at_back(faces, count, work):
    """Move to the back face; those that meet it outside the outline, from behind them or along it are lost."""
    for r in range(count):
        s, dx, dy, dz = work[S + r], work[DX + r], work[DY + r], work[DZ + r]
        x, y = work[X + r] + s * dx, work[Y + r] + s * dy
        p, q = work[SLOPE_X + r] * faces.per_x, work[SLOPE_Y + r] * faces.per_y
        work[X + r], work[Y + r], work[SLOPE_X + r], work[SLOPE_Y + r] = x, y, p, q
        inside = (abs(x) <= faces.limit_x) & (abs(y) <= faces.limit_y) & (x * x + y * y <= faces.limit_r2)
        there = inside & (work[Z + r] + s >= 0.0) & (abs(dz - p * dx - q * dy) > faces.rules.along)
        fate = work[FATE + r]
        work[FATE + r] = fate if there | (fate != 0.0) else faces.fates.missed_back


@njit(error_model="numpy")
def _to_tilted(faces, tilted, count, work):
    """`_to_screen` for a tilted screen."""
    grazing, turned = faces.rules.grazing, faces.fates.turned
    for r in range(count):
        dx, dy, dz = work[DX + r], work[DY + r], work[DZ + r]
        x, y, z = work[X + r] - tilted.x, work[Y + r] - tilted.y, work[SAG + r] - faces.throw
        rise = tilted.n_x * dx + tilted.n_y * dy + tilted.n_z * dz
        ahead = rise > grazing
        far = -(tilted.n_x * x + tilted.n_y * y + tilted.n_z * z) / (rise if ahead else 1.0)
        x, y, z = x + far * dx, y + far * dy, z + far * dz
        work[X + r] = tilted.x + (tilted.x_x * x + tilted.x_y * y + tilted.x_z * z)
        work[Y + r] = tilted.y + (tilted.y_x * x + tilted.y_y * y + tilted.y_z * z)
        fate = work[FATE + r]
        work[FATE + r] = fate if ahead | (fate != 0.0) else turned


@njit(error_model="numpy")
def _to_screen(faces, tilted, count, work):
    """From the back face to the screen, and the place on it: `trace.to_plane`, `planes.coordinates`."""
    if tilted is not None:
        _to_tilted(faces, tilted, count, work)
        return
    sense, grazing, turned = -1.0 if faces.reflects else 1.0, faces.rules.grazing, faces.fates.turned
    for r in range(count):
        dz = work[DZ + r]
        ahead = sense * dz > grazing
        far = (faces.throw - work[SAG + r]) / (dz if ahead else 1.0)
        work[X + r] += far * work[DX + r]
        work[Y + r] += far * work[DY + r]
        fate = work[FATE + r]
        work[FATE + r] = fate if ahead | (fate != 0.0) else turned


@njit
def _fly(net, beam, faces, tilted, count, work, active):
    """From points on the plane of the first vertex to landings, flux densities and fates."""
    _launch(beam, count, work)
    if beam.tilted == 1 and beam.distance > 0.0:
        _tilt(beam, count, work)
    if faces.reflects:  # no face was met before: rays begin at the source
        for r in range(count):
            work[FATE + r] = 0.0
            work[Z + r] = -beam.start
            if beam.distance > 0.0:
                work[X + r], work[Y + r] = beam.x, beam.y
            elif beam.tilted == 1:
                work[X + r] -= beam.start * (beam.n_x / beam.n_z)
                work[Y + r] -= beam.start * (beam.n_y / beam.n_z)
    else:
        _meet_front(faces, beam.distance == 0.0 and beam.tilted == 0, count, work)
        _refract(1.0 / faces.index, faces.fates.reflected, count, work)
    _start_search(net, faces, count, work)
    _to_net(faces, count, work)
    _search(net, faces, count, work, active)
    _at_back(faces, count, work)
    if faces.reflects:
        _reflect(faces.fates.turned, count, work)
    else:
        _refract(faces.index, faces.fates.reflected, count, work)
    _to_screen(faces, tilted, count, work)


@njit(error_model="numpy")
def _count(pixels, count, work, box, tent, lines):
    """Box and tent picture and the ledger: `irradiance.box`, `tent` and `ledger`."""
    rows, columns = box.shape
    for r in range(count):
        f = work[FLUX + r]
        if not f > 0.0:
            continue
        lines[COUNT] += 1.0
        if work[FATE + r] != 0.0:
            lines[int(work[FATE + r])] += f
            continue
        x, y = work[X + r], work[Y + r]
        on_screen = pixels.left <= x <= pixels.right and pixels.bottom <= y <= pixels.top
        x, y = (x - pixels.left) * pixels.per_x, (pixels.top - y) * pixels.per_y
        if on_screen:
            lines[0] += f
            box[min(int(y), rows - 1), min(int(x), columns - 1)] += f
        else:
            lines[BESIDE] += f
        x -= 0.5
        y -= 0.5
        if not (-1.0 < x < columns and -1.0 < y < rows):  # also refuses NaN
            continue
        i, j = int(math.floor(y)), int(math.floor(x))
        right, below = f * (x - j), y - i
        left = f - right
        if i >= 0:
            if j >= 0:
                tent[i, j] += left - below * left
            if j + 1 < columns:
                tent[i, j + 1] += right - below * right
        if i + 1 < rows:
            if j >= 0:
                tent[i + 1, j] += below * left
            if j + 1 < columns:
                tent[i + 1, j + 1] += below * right


@njit(cache=True, nogil=True)
def _rows(net, beam, faces, tilted, cells, pixels, first, step, box, tent, lines):
    """A part of the simulation: each step-th row of cells from the first, added to sums of its own."""
    work, active, part = np.empty(WORK), np.empty(BLOCK, np.uint32), np.empty(LINES)
    for i in range(first, cells.n, step):
        for j in range(0, cells.n, BLOCK):
            count = min(BLOCK, cells.n - j)
            _points(cells, i, j, count, work)
            _fly(net, beam, faces, tilted, count, work, active)
            part[:] = 0.0  # by blocks: a long sum of equal numbers is rounded the same way each time
            _count(pixels, count, work, box, tent, part)
            for k in range(LINES):
                lines[k] += part[k]


@njit(cache=True, nogil=True)
def _rays(net, beam, faces, tilted, x, y, landing, flux, fate):
    """Where the rays through given points (n,) land (2, n), what they carry and what becomes of them."""
    work, active = np.empty(WORK), np.empty(BLOCK, np.uint32)
    for first in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - first)
        for r in range(count):
            work[X + r], work[Y + r] = x[first + r], y[first + r]
        _fly(net, beam, faces, tilted, count, work, active)
        for r in range(count):
            landing[0, first + r], landing[1, first + r] = work[X + r], work[Y + r]
            flux[first + r], fate[first + r] = work[FLUX + r], np.uint8(work[FATE + r])


def serves(source: Source, lens: Lens) -> bool:
    """Does the fused kernel take this source and lens (on the CPU, float32 or float64)?"""
    heights = lens.back.heights
    return (
        heights.device.type == "cpu"
        and heights.dtype in (torch.float32, torch.float64)
        and isinstance(source, Collimated | Point)
        and (lens.reflects or not isinstance(lens.front, BSplineSurface))
        and lens.losses is None
    )


def simulate(
    source: Source, lens: Lens, screen: Screen, n: int, seed: int, window: Rectangle
) -> tuple[Tensor, Tensor, dict[str, float], int]:
    """(box picture, tent picture, ledger, number of rays) of n x n stratified rays over `window`.

    The window lies on the plane of the first vertex; flux as a fraction of the source's.
    """
    count = reductions.PARTS
    box, tent, lines = (np.zeros((count, *shape)) for shape in (screen.shape, screen.shape, (LINES,)))
    cells, pixels = kernel_arguments.cells(window, n, seed), kernel_arguments.pixels(screen)
    scene = _scene(source, lens, screen.plane)
    _on_threads(lambda c: _rows(*scene, cells, pixels, c, count, box[c], tent[c], lines[c]), count)
    rays = int(lines[:, COUNT].sum())
    box, tent, lines = (total.sum(0) * (cells.width * cells.height) for total in (box, tent, lines))
    flux = {"on target": float(lines[0]), "off target": float(lines[BESIDE] + lines[Status.TURNED_BACK])}
    flux |= {line: float(sum(lines[reason] for reason in reasons)) for line, reasons in LEDGER.items()}
    return torch.from_numpy(box), torch.from_numpy(tent), flux, rays


def land(source: Source, lens: Lens, plane: TargetPlane, x: Tensor, y: Tensor) -> Landed:
    """Rays through (x, y) of the plane of the first vertex, each (n,) float64, on `plane`; flux in 1/mm² there.

    `trace.trace` of `source.rays(x, y, lens.entrance.z, 1.0)`, but that rays without flux may end anyhow.
    """
    scene = _scene(source, lens, plane)
    landing, flux, fate = np.empty((2, x.numel())), np.empty(x.numel()), np.empty(x.numel(), np.uint8)
    ends = np.arange(1, reductions.PARTS) * (x.numel() // (reductions.PARTS * BLOCK)) * BLOCK
    shares = [np.split(a, ends, axis=-1) for a in (x.numpy(), y.numpy(), landing, flux, fate)]
    _on_threads(lambda c: _rays(*scene, *(share[c] for share in shares)), reductions.PARTS)
    return Landed(*(torch.from_numpy(a) for a in (landing, flux, fate)))


def _on_threads(work: Callable[[int], None], count: int) -> None:
    """work(0), …, work(count - 1), as many at once as torch has threads.

    Python's threads: the kernels hold no lock, and without numba's own they compile in half the time.
    """
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(work, range(count)))


def _scene(source: Source, lens: Lens, plane: TargetPlane) -> tuple[Any, ...]:
    """Net, beam, faces and tilt of the screen, as the kernels take them."""
    beam, before = kernel_arguments.beam(source, lens.entrance.z), -1 if lens.reflects else 1
    faces, tilted = kernel_arguments.faces(lens, plane), kernel_arguments.tilted(plane, before, 1)
    return kernel_arguments.net(lens), beam, faces, tilted
