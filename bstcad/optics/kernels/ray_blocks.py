"""Blocks of rays on their way from the front face to the screen, for the fused CPU kernels (numba).

A block stays in the first-level cache (`work`: BLOCK numbers of each quantity, at the place of its name).  Steps
without a table run in vector registers; in the search for the back face all rays of a block take a Newton step in turn,
so that none waits for its own last one.  Arithmetic is float64 whatever the net's precision.
"""

from __future__ import annotations

import math

from numba import njit

from bstcad.optics.kernels.spline import sag

BLOCK = 256  # rays
# Where each quantity begins in `work`; constants, so that the compiler sees that they do not overlap.
X, Y, Z, DX, DY, DZ, FLUX, FATE, S, SAG, SLOPE_X, SLOPE_Y, U, V, U_S, V_S = (BLOCK * k for k in range(16))
COS_FRONT, COS_BACK, PATH = (BLOCK * k for k in range(16, 19))  # told only where faces and glass take flux
WORK = 19 * BLOCK


@njit(error_model="numpy")
def cosines(place, count, work):
    """Cosine of the angle of incidence at the slopes held in `work`, to `place` in it."""
    for r in range(count):
        p, q = work[SLOPE_X + r], work[SLOPE_Y + r]
        along = work[DZ + r] - p * work[DX + r] - q * work[DY + r]
        work[place + r] = along / math.sqrt(1.0 + p * p + q * q)


@njit(error_model="numpy", inline="always")
def beyond2(x, y, limit_x, limit_y):
    """(mm²) what an outline holds up to its r²: `outlines.inside`; NaN of NaN."""
    p, q = abs(x) - limit_x, abs(y) - limit_y
    p, q = 0.0 if p < 0.0 else p, 0.0 if q < 0.0 else q
    return p * p + q * q


@njit(error_model="numpy")
def refract(eta, reflected, count, work):
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


@njit(error_model="numpy")
def reflect(turned, count, work):
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
def first_root(net, faces, x, y, z, dx, dy, dz):
    """(s, found): path of a ray steep to the net to its first crossing (see intersection.py); z from its plane."""
    last, flattest = faces.m - 1.0, faces.rules.flattest
    u, v, u_s, v_s = (x - faces.x) * faces.per_x, (y - faces.y) * faces.per_y, dx * faces.per_x, dy * faces.per_y
    rate = abs(dz) + faces.steepest_x * abs(dx) + faces.steepest_y * abs(dy)
    s = below = 0.0
    arrived = False
    for step in range(int(faces.rules.approach_steps + faces.rules.newton_steps)):
        a, b = u + s * u_s, v + s * v_s
        h, h_u, h_v = sag(net, faces.m, min(max(a, 0.0), last), min(max(b, 0.0), last))
        residual, slope = z + s * dz - h, dz - h_u * u_s - h_v * v_s
        if arrived:
            if abs(residual) <= faces.tolerance:
                return s, abs(s - below) <= faces.near / flattest
            s -= residual / (slope if abs(slope) > flattest else (-flattest if slope < 0.0 else flattest))
            continue
        gone = (a > last and u_s > 0.0) or (a < 0.0 and u_s < 0.0) or (z + s * dz < faces.lowest and dz <= 0.0)
        gone |= (b > last and v_s > 0.0) or (b < 0.0 and v_s < 0.0)
        if gone or step >= faces.rules.approach_steps or (step == 0 and not residual < 0.0):
            break
        arrived, below = residual >= -faces.near, s
        s -= residual / rate
    return s, False


@njit(error_model="numpy")
def start_search(net, faces, count, work):
    """Where the search begins, as path from the net's plane: there, but for rays that are steep to the net."""
    for r in range(count):
        work[S + r] = 0.0
    for r in range(count):
        dx, dy, dz = work[DX + r], work[DY + r], work[DZ + r]
        steep = not dz > faces.steepest_x * abs(dx) + faces.steepest_y * abs(dy)
        if steep and work[FATE + r] == 0.0 and work[FLUX + r] > 0.0:
            z = work[Z + r] - faces.gap
            s, found = first_root(net, faces, work[X + r], work[Y + r], z, dx, dy, dz)
            work[S + r] = s + z / dz
            work[FATE + r] = 0.0 if found and abs(dz) > faces.rules.level else faces.fates.missed_back


@njit(error_model="numpy")
def to_net(faces, count, work):
    """To the plane the net's heights are measured from; u, v there and ∂u/∂s, ∂v/∂s along the ray."""
    for r in range(count):
        dx, dy = work[DX + r], work[DY + r]
        start = (faces.gap - work[Z + r]) / work[DZ + r]
        x, y = work[X + r] + start * dx, work[Y + r] + start * dy
        work[X + r], work[Y + r], work[Z + r] = x, y, start
        work[U + r], work[V + r] = (x - faces.x) * faces.per_x, (y - faces.y) * faces.per_y
        work[U_S + r], work[V_S + r] = dx * faces.per_x, dy * faces.per_y


@njit(error_model="numpy", fastmath={"contract"})
def search(net, faces, count, work, active):
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
            h, h_u, h_v = sag(net, faces.m, u, v)
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
def at_back(faces, count, work):
    """Move to the back face; those that meet it outside its clear aperture, from behind them or along it are lost."""
    for r in range(count):
        s, dx, dy, dz = work[S + r], work[DX + r], work[DY + r], work[DZ + r]
        x, y = work[X + r] + s * dx, work[Y + r] + s * dy
        p, q = work[SLOPE_X + r] * faces.per_x, work[SLOPE_Y + r] * faces.per_y
        work[X + r], work[Y + r], work[SLOPE_X + r], work[SLOPE_Y + r] = x, y, p, q
        inside = beyond2(x, y, faces.limit_x, faces.limit_y) <= faces.limit_r2
        there = inside & (work[Z + r] + s >= -faces.tolerance) & (abs(dz - p * dx - q * dy) > faces.rules.along)
        fate = work[FATE + r]
        work[FATE + r] = fate if there | (fate != 0.0) else faces.fates.missed_back


@njit(error_model="numpy")
def to_tilted(faces, tilted, count, work):
    """`to_screen` for a tilted screen."""
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
def to_screen(faces, tilted, count, work):
    """From the back face to the screen, and the place on it: `trace.to_plane`, `planes.coordinates`."""
    if tilted is not None:
        to_tilted(faces, tilted, count, work)
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
