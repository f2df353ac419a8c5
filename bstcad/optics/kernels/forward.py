"""Fused CPU kernels (numba) behind `trace.simulate` and `trace.land`: rays from the source to pixels or receiver.

Each part (see reductions.py) traces rows of cells in blocks through the steps of the plain torch form, which is the
reference: launch, front face, back face, screen, pixel.  A block stays in the first-level cache (`work` contains BLOCK
numbers of each quantity, from the offset of its name on).  Steps that evaluate no spline are vectorised.  In the
search for the back face all rays of a block take a Newton step in turn, so that the steps of different rays overlap.
Arithmetic is float64 for every precision of the net; memory is a pair of pictures per part.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from bstcad.optics.kernels import kernel_arguments
from bstcad.optics.kernels.spline import beyond2, net_of, sag
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.numerics import reductions
from bstcad.optics.numerics.compiling import compiled
from bstcad.optics.numerics.records import NO_LOSS_TABLES
from bstcad.optics.receivers.irradiance import LEDGER, Screen
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.rays import Landed, Status

BLOCK = 256  # number of rays in a block
# Offset of each quantity in `work`; constants, so that the compiler sees that they do not overlap.
X, Y, Z, DX, DY, DZ, FLUX, FATE, S, SAG, SLOPE_X, SLOPE_Y, U, V, U_S, V_S = (BLOCK * k for k in range(16))
COS_FRONT, COS_BACK, PATH = (BLOCK * k for k in range(16, 19))  # offsets used only where there are losses
WORK = 19 * BLOCK  # length of `work`


@njit(error_model="numpy")
def cosines(offset, count, work):
    """Store in `work`, from `offset` on, the cosine of the angle of incidence for the slopes there."""
    for r in range(count):
        p, q = work[SLOPE_X + r], work[SLOPE_Y + r]
        along = work[DZ + r] - p * work[DX + r] - q * work[DY + r]
        work[offset + r] = along / math.sqrt(1.0 + p * p + q * q)


@njit(inline="always")
def cos2_behind(eta, cos2_in):
    """Return cos² θ' of Snell's law; negative beyond the critical angle."""
    return 1.0 - eta * eta * (1.0 - cos2_in)


@njit(error_model="numpy")
def refract(eta, reflected, count, work):
    """Refract rays at the slopes in `work` as `interfaces.Refract` does; reflected: status of blocked rays."""
    for r in range(count):
        p, q = work[SLOPE_X + r], work[SLOPE_Y + r]
        dx, dy, dz = work[DX + r], work[DY + r], work[DZ + r]
        norm2 = 1.0 / (1.0 + p * p + q * q)
        along = dz - p * dx - q * dy
        cos2 = cos2_behind(eta, along * along * norm2)
        through = (cos2 > 0.0) & (along > 0.0)
        shift = math.sqrt((cos2 if through else 1.0) * norm2) - eta * along * norm2
        work[DX + r] = eta * dx - shift * p
        work[DY + r] = eta * dy - shift * q
        work[DZ + r] = eta * dz + shift
        fate = work[FATE + r]
        work[FATE + r] = fate if through | (fate != 0.0) else reflected


@njit(error_model="numpy")
def reflect(turned, count, work):
    """Reflect rays at the slopes in `work` as `interfaces.Reflect` does; turned: status of blocked rays."""
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
    """Return (s, found): path s (mm) of a steep ray to its first crossing; z: height over the net's plane."""
    last_u, last_v, floor = faces.m - 1.0, faces.n - 1.0, faces.rules.min_derivative
    u, v, u_s, v_s = (x - faces.x) * faces.per_x, (y - faces.y) * faces.per_y, dx * faces.per_x, dy * faces.per_y
    rate = abs(dz) + faces.steepest_x * abs(dx) + faces.steepest_y * abs(dy)
    s = below = 0.0
    arrived = False
    for step in range(int(faces.rules.approach_steps + faces.rules.newton_steps)):
        a, b = u + s * u_s, v + s * v_s
        h, h_u, h_v = sag(net, faces.m, faces.n, min(max(a, 0.0), last_u), min(max(b, 0.0), last_v))
        residual, slope = z + s * dz - h, dz - h_u * u_s - h_v * v_s
        if arrived:
            if abs(residual) <= faces.tolerance:
                return s, abs(s - below) <= faces.near / floor
            s -= residual / (slope if abs(slope) > floor else (-floor if slope < 0.0 else floor))
            continue
        left = (a > last_u and u_s > 0.0) or (a < 0.0 and u_s < 0.0) or (z + s * dz < faces.lowest and dz <= 0.0)
        left |= (b > last_v and v_s > 0.0) or (b < 0.0 and v_s < 0.0)
        if left or step >= faces.rules.approach_steps or (step == 0 and not residual < 0.0):
            break
        arrived, below = residual >= -faces.near, s
        s -= residual / rate
    return s, False


@njit(error_model="numpy")
def start_search(net, faces, count, work):
    """Store the start of the search as path from the net's plane: 0, or near the first root of a ray with several."""
    for r in range(count):
        work[S + r] = 0.0
    for r in range(count):
        dx, dy, dz = work[DX + r], work[DY + r], work[DZ + r]
        steep = not dz > faces.steepest_x * abs(dx) + faces.steepest_y * abs(dy)
        if steep and work[FATE + r] == 0.0 and work[FLUX + r] > 0.0:
            z = work[Z + r] - faces.gap
            s, found = first_root(net, faces, work[X + r], work[Y + r], z, dx, dy, dz)
            work[S + r] = s + z / dz
            work[FATE + r] = 0.0 if found and abs(dz) > faces.rules.side_exit else faces.fates.missed_back


@njit(error_model="numpy")
def to_net(faces, count, work):
    """Move rays to the plane of the net's heights; store the path to it in Z, and u, v, ∂u/∂s and ∂v/∂s."""
    for r in range(count):
        dx, dy = work[DX + r], work[DY + r]
        start = (faces.gap - work[Z + r]) / work[DZ + r]
        x, y = work[X + r] + start * dx, work[Y + r] + start * dy
        work[X + r], work[Y + r], work[Z + r] = x, y, start
        work[U + r], work[V + r] = (x - faces.x) * faces.per_x, (y - faces.y) * faces.per_y
        work[U_S + r], work[V_S + r] = dx * faces.per_x, dy * faces.per_y


@njit(error_model="numpy")
def are_axial(count, work):
    """Return True if all rays are along the axis: x and y are constant, so that one Newton step is exact."""
    return not (work[DX : DX + count].any() or work[DY : DY + count].any())


@njit(error_model="numpy", fastmath={"contract"})
def search_along_axis(net, faces, count, work):
    """Find the path and store what `search` stores, for rays along the axis, whose u and v are those of the hit."""
    last_u, last_v = faces.m - 1.0, faces.n - 1.0
    for r in range(count):
        u, v = work[U + r], work[V + r]
        work[U + r], work[V + r] = (u if u > 0.0 else 0.0), (v if v > 0.0 else 0.0)  # 0 if it is not a number
    for r in range(count):
        u, v = min(work[U + r], last_u), min(work[V + r], last_v)
        work[SAG + r], work[SLOPE_X + r], work[SLOPE_Y + r] = sag(net, faces.m, faces.n, u, v)
    for r in range(count):
        work[S + r] = work[SAG + r] / work[DZ + r]


@njit(error_model="numpy", fastmath={"contract"})
def search(net, faces, count, work, active):
    """Find path s from the net's plane to the back by Newton steps of all rays in turn, as `interfaces._newton` does.

    On return `work` contains s after a ray's last step, and sag and slopes (in u and v) before that step.
    """
    if are_axial(count, work):
        search_along_axis(net, faces, count, work)
        return
    last_u, last_v, floor = faces.m - 1.0, faces.n - 1.0, faces.rules.min_derivative
    searching = 0
    for r in range(count):
        active[searching] = r
        searching += (work[FATE + r] == 0.0) & (work[FLUX + r] > 0.0)
    for _ in range(int(faces.rules.newton_steps)):
        remaining = 0
        for a in range(searching):
            r = active[a]
            s, u_s, v_s, dz = work[S + r], work[U_S + r], work[V_S + r], work[DZ + r]
            u, v = work[U + r] + s * u_s, work[V + r] + s * v_s
            out_u, out_v = not 0.0 <= u <= last_u, not 0.0 <= v <= last_v
            if out_u or out_v:
                u, v = min(max(u, 0.0), last_u), min(max(v, 0.0), last_v)
            h, h_u, h_v = sag(net, faces.m, faces.n, u, v)
            residual, slope = s * dz - h, dz - h_u * u_s - h_v * v_s
            if out_u or out_v:  # outside the net the sag is constant across the rim
                slope += (h_u * u_s if out_u else 0.0) + (h_v * v_s if out_v else 0.0)
            if abs(slope) < floor:
                slope = -floor if slope < 0.0 else floor  # keeps the sign
            work[S + r] = s - residual / slope
            work[SAG + r], work[SLOPE_X + r], work[SLOPE_Y + r] = h, h_u, h_v
            active[remaining] = r
            remaining += not abs(residual) <= faces.tolerance
        searching = remaining
    for a in range(searching):
        work[FATE + active[a]] = faces.fates.missed_back


@njit(error_model="numpy")
def at_back(faces, count, work):
    """Move rays to the back face; lose rays that hit it outside its aperture, behind their start, or tangentially."""
    for r in range(count):
        s, dx, dy, dz = work[S + r], work[DX + r], work[DY + r], work[DZ + r]
        x, y = work[X + r] + s * dx, work[Y + r] + s * dy
        p, q = work[SLOPE_X + r] * faces.per_x, work[SLOPE_Y + r] * faces.per_y
        work[X + r], work[Y + r], work[SLOPE_X + r], work[SLOPE_Y + r] = x, y, p, q
        inside = beyond2(x, y, faces.limit_x, faces.limit_y) <= faces.limit_r2
        met = inside & (work[Z + r] + s >= -faces.tolerance) & (abs(dz - p * dx - q * dy) > faces.rules.tangency)
        fate = work[FATE + r]
        work[FATE + r] = fate if met | (fate != 0.0) else faces.fates.missed_back


DEGREES = 180.0 / math.pi
# Coefficients of θ / sin θ in powers of 1 - cos θ, by interpolation at Chebyshev points of [0, 1], to 6e-17.  All terms
# have one sign up to rounding of the last ones.  A loop with this polynomial is vectorised and has no division.
ANGLE_BY_SINE = (
    1.0, 0.33333333333330945, 0.13333333333682526, 0.05714285694042784, 0.025396831596651948, 0.011543895604776996,
    0.00532944828305169, 0.0024737607111697374, 0.001251083869870826, 0.00016421047913476515, 0.0017011133906985544,
    -0.003976427223224787, 0.009195329684833449, -0.01586170544127971, 0.02153400343586953, -0.022454256450108755,
    0.01773831596916336, -0.01025927464062151, 0.004114940516850556, -0.001025639660813829, 0.00012117305831116537,
)  # fmt: skip


@njit(error_model="numpy", fastmath={"contract"})
def angle_by_sine(cosine):
    """Return θ / sin θ of an angle θ from 0 to 90°; cosine: cos θ."""
    c, u = ANGLE_BY_SINE, 1.0 - cosine  # two chains of products, since no loop over them is vectorised
    w = u * u
    even, odd = (c[20] * w + c[18]) * w + c[16], (c[19] * w + c[17]) * w + c[15]
    even, odd = (even * w + c[14]) * w + c[12], (odd * w + c[13]) * w + c[11]
    even, odd = (even * w + c[10]) * w + c[8], (odd * w + c[9]) * w + c[7]
    even, odd = (even * w + c[6]) * w + c[4], (odd * w + c[5]) * w + c[3]
    even, odd = (even * w + c[2]) * w + c[0], odd * w + c[1]
    return odd * u + even


@njit(inline="always")
def angles_by_radius(x, y, z, n_z, count, work):
    """Store θ / r in S, θ = atan2(n_z z, r), r = hypot(x, y), of unit vectors whose components begin at x, y and z."""
    backwards = 0
    for r in range(count):
        along = n_z * work[z + r]
        work[S + r] = angle_by_sine(abs(along))
        backwards += along < 0.0
    if backwards > 0:
        for r in range(count):
            if n_z * work[z + r] < 0.0:
                r2 = max(work[x + r] * work[x + r] + work[y + r] * work[y + r], 1e-30)
                work[S + r] = math.pi / math.sqrt(r2) - work[S + r]


@njit(inline="always")
def _about_axis(one, other, at_one, at_other, n_z, count, work):
    """Store the angles (degrees) of directions about an axis and from its normal plane, atan2(one, z) and asin(other).

    With n = hypot(one, z), the cosine of the second angle, one / n and z / n are sine and cosine of the first.
    """
    for r in range(count):
        p, q, z = work[one + r], work[other + r], n_z * work[DZ + r]
        n = math.sqrt(max(p * p + z * z, 1e-30))
        angle = p / n * angle_by_sine(abs(z) / n)
        beyond = (math.pi if p >= 0.0 else -math.pi) - angle
        work[at_one + r] = DEGREES * (angle if z >= 0.0 else beyond)
        work[at_other + r] = DEGREES * (q * angle_by_sine(n))


@njit(error_model="numpy")
def to_directions(tilted, count, work):
    """Replace the places of rays by the coordinates (degrees) of their directions (`Directions.coordinates`)."""
    if tilted.goniometer == 1:
        angles_by_radius(DX, DY, DZ, tilted.n_z, count, work)
        for r in range(count):
            scale = DEGREES * work[S + r]
            work[X + r], work[Y + r] = scale * work[DX + r], scale * work[DY + r]
    elif tilted.goniometer == 2:
        _about_axis(DX, DY, X, Y, tilted.n_z, count, work)
    else:
        _about_axis(DY, DX, Y, X, tilted.n_z, count, work)


@njit(error_model="numpy")
def to_tilted(faces, throw, tilted, count, work):
    """Move rays from the back face to a tilted screen, as `TiltedPlane.land` does."""
    grazing, turned = faces.rules.grazing, faces.fates.turned
    for r in range(count):
        dx, dy, dz = work[DX + r], work[DY + r], work[DZ + r]
        x, y, z = work[X + r] - tilted.x, work[Y + r] - tilted.y, work[SAG + r] - throw
        rise = tilted.n_x * dx + tilted.n_y * dy + tilted.n_z * dz
        ahead = rise > grazing
        far = -(tilted.n_x * x + tilted.n_y * y + tilted.n_z * z) / (rise if ahead else 1.0)
        x, y, z = x + far * dx, y + far * dy, z + far * dz
        work[X + r] = tilted.x + (tilted.x_x * x + tilted.x_y * y + tilted.x_z * z)
        work[Y + r] = tilted.y + (tilted.y_x * x + tilted.y_y * y + tilted.y_z * z)
        fate = work[FATE + r]
        work[FATE + r] = fate if ahead | (fate != 0.0) else turned


@njit(error_model="numpy")
def to_screen(faces, throw, tilted, count, work):
    """Move rays from the back face to the screen; store x and y on it.  throw: as `Faces.throw`."""
    if tilted is not None:
        if tilted.goniometer > 0:
            to_directions(tilted, count, work)
        else:
            to_tilted(faces, throw, tilted, count, work)
        return
    sense, grazing, turned = -1.0 if faces.reflects else 1.0, faces.rules.grazing, faces.fates.turned
    for r in range(count):
        dz = work[DZ + r]
        ahead = sense * dz > grazing
        far = (throw - work[SAG + r]) / (dz if ahead else 1.0)
        work[X + r] += far * work[DX + r]
        work[Y + r] += far * work[DY + r]
        fate = work[FATE + r]
        work[FATE + r] = fate if ahead | (fate != 0.0) else turned


# Length of the ledger: flux by Status (alive: on the screen), flux outside the screen, number of rays, and flux lost at
# faces and in glass.
LINES = 9
BESIDE, COUNT, BY_FACES, BY_GLASS = 5, 6, 7, 8  # indices in the ledger; 5 is free, since no ray is BLOCKED
RAY_PARTS = 8  # number of partial sums of the rays; each has its own pictures, which take time to clear and to add
FEW_RAY_PARTS, MANY_PIXELS = 4, 1 << 21  # partial sums for pictures of more than MANY_PIXELS cells, for their memory


@njit(error_model="numpy")
def points(cells, i, j, count, work):
    """Store the points of cells (i, j), …, (i, j + count - 1), as `sampling.stratified_strips` does."""
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
def launch(beam, count, work):
    """Store flux density and direction of rays through the points, as `irradiance` and `rays_through` give them."""
    for r in range(count):
        x, y = work[X + r] - beam.x, work[Y + r] - beam.y
        r2 = x * x + y * y
        lit = beyond2(x, y, beam.limit_x, beam.limit_y) <= beam.limit_r2
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
def tilt(beam, count, work):
    """Replace the flux density for light along z by that of a tilted point source."""
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
def shape(beam, count, work):
    """Multiply the flux density, 1 where there is light, by the irradiance of a profile, as `Profile.density` does.

    The irradiance of a point source on a plane at the distance D is E D / c³, c = n · p, or E D / |p|³ for an
    intensity.
    """
    pattern, net = beam.pattern, beam.pattern.net
    for r in range(count):
        if not work[FLUX + r] > 0.0:
            continue
        x, y, factor = work[X + r] - beam.x, work[Y + r] - beam.y, 1.0
        u, v = x * pattern.x.x + y * pattern.x.y, x * pattern.y.x + y * pattern.y.y
        if beam.distance > 0.0:
            c = x * pattern.axis.x + y * pattern.axis.y + beam.distance * pattern.axis.z
            u, v = u + beam.distance * pattern.x.z, v + beam.distance * pattern.y.z
            if pattern.stereographic:
                d2 = x * x + y * y + beam.distance * beam.distance
                d = math.sqrt(d2)
                factor, c = beam.distance / (d2 * d), c + d
            elif c > 0.0:
                factor = beam.distance / (c * c * c)
            else:
                work[FLUX + r] = 0.0
                continue
            u, v = u / c, v / c
        if u * u + v * v < pattern.inner2:
            factor = 0.0
        if pattern.fall_u > 0.0:
            a, b = u * pattern.fall_u, v * pattern.fall_v
            factor *= math.exp(-2.0 * (a * a + b * b) ** pattern.power)
        if net.m > 0:
            e = 0.0
            if (u >= net.u_min) & (u <= net.u_max) & (v >= net.v_min) & (v <= net.v_max):
                e, _, _ = sag(net.values, net.m, net.n, (u - net.u_min) * net.per_u, (v - net.v_min) * net.per_v)
            factor *= max(e, 0.0)
        work[FLUX + r] *= factor


@njit(error_model="numpy")
def _look_up(peak, table, count, work):
    """Store flux density and direction of the rays through the points from the splines of a table."""
    last_u, last_v = table.m - 1.0, table.n - 1.0
    for r in range(count):
        u = min(max((work[X + r] - table.x) * table.per_x, 0.0), last_u)
        v = min(max((work[Y + r] - table.y) * table.per_y, 0.0), last_v)
        e, _, _ = sag(table.irradiance, table.m, table.n, u, v)
        p, _, _ = sag(table.slope_x, table.m, table.n, u, v)
        q, _, _ = sag(table.slope_y, table.m, table.n, u, v)
        dz = 1.0 / math.sqrt(1.0 + p * p + q * q)
        work[FLUX + r] = peak * max(e, 0.0)
        work[DX + r], work[DY + r], work[DZ + r] = p * dz, q * dz, dz


@njit(error_model="numpy")
def meet_front(faces, axial, count, work):
    """Move rays to the front as `interfaces.intersect` does: by `Conic.crossing`, or along the axis by the sag."""
    c, conic, min_cos2 = faces.curvature, 1.0 + faces.conic_constant, faces.rules.min_cos2
    for r in range(count):
        x, y, dx, dy, dz = work[X + r], work[Y + r], work[DX + r], work[DY + r], work[DZ + r]
        met = True
        z = 0.0
        if not axial:
            f = c * (x * x + y * y)
            g = dz - c * (x * dx + y * dy)
            k = g * g - c * (1.0 + faces.conic_constant * dz * dz) * f
            divisor = g + math.sqrt(k if k > 0.0 else 1.0)
            ok = (k > 0.0) & (divisor > 1e-6)
            s = f / (divisor if ok else 1.0)
            met = ok & (conic * c * s * dz < 1.0)
            x, y, z = x + s * dx, y + s * dy, s * dz
        r2 = x * x + y * y
        k = 1.0 - conic * c * c * r2
        root = math.sqrt(max(k, min_cos2))
        inside = (k > min_cos2) & (beyond2(x, y, faces.front_x, faces.front_y) <= faces.front_r2)
        work[X + r], work[Y + r] = x, y
        work[Z + r] = c * r2 / (1.0 + root) if axial else z
        work[SLOPE_X + r], work[SLOPE_Y + r] = c * x / root, c * y / root
        work[FATE + r] = 0.0 if met & inside else faces.fates.missed_front


@njit
def _trace(net, beam, faces, tilted, losses, count, work, active):
    """Trace rays through points on the plane of the first vertex to the screen; store landing, flux density and fate.

    losses: if there are any, the cosines of incidence and the path in the glass are stored for `dim`.
    """
    if beam.table.m > 0:
        _look_up(beam.peak, beam.table, count, work)
    else:
        launch(beam, count, work)
    if beam.pattern.present:
        shape(beam, count, work)
    elif beam.tilted == 1 and beam.distance > 0.0:
        tilt(beam, count, work)
    if faces.reflects:  # there is no front: rays start at the source
        for r in range(count):
            work[FATE + r] = 0.0
            work[Z + r] = -beam.start
            if beam.distance > 0.0:
                work[X + r], work[Y + r] = beam.x, beam.y
            elif beam.tilted == 1:
                work[X + r] -= beam.start * (work[DX + r] / work[DZ + r])
                work[Y + r] -= beam.start * (work[DY + r] / work[DZ + r])
    else:
        meet_front(faces, beam.distance == 0.0 and beam.tilted == 0, count, work)
        if losses.present:
            cosines(COS_FRONT, count, work)
        refract(faces.front_eta, faces.fates.reflected, count, work)
    start_search(net, faces, count, work)
    if losses.present:
        for r in range(count):
            work[PATH + r] = work[Z + r]
    to_net(faces, count, work)
    search(net, faces, count, work, active)
    at_back(faces, count, work)
    if losses.present:  # the direction in the glass is a unit vector: the path is the rise divided by d_z
        for r in range(count):
            rise = faces.gap + work[S + r] * work[DZ + r] - work[PATH + r]
            work[PATH + r] = rise / work[DZ + r]
        cosines(COS_BACK, count, work)
    if faces.reflects:
        reflect(faces.fates.reflected, count, work)
    else:
        refract(faces.eta, faces.fates.reflected, count, work)
    to_screen(faces, faces.throw, tilted, count, work)


@njit(error_model="numpy")
def count_rays(pixels, count, work, box, tent, lines):
    """Add rays to box picture, tent picture and ledger, as `irradiance.box`, `tent` and `ledger` do.

    box may have several cells along each side of a pixel of `tent`.
    """
    (rows, columns), (fine_rows, fine_columns) = tent.shape, box.shape
    cells = fine_rows // rows
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
            box[min(int(cells * y), fine_rows - 1), min(int(cells * x), fine_columns - 1)] += f
        else:
            lines[BESIDE] += f
        x -= 0.5
        y -= 0.5
        if not (-1.0 < x < columns and -1.0 < y < rows):  # also excludes NaN
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


@njit(error_model="numpy")
def _share(table, cosine):
    """Interpolate the transmission of a face linearly in the cosine; table: at equal steps from 0 to 1."""
    at = min(max(cosine, 0.0), 1.0) * (table.size - 1)
    k = min(int(at), table.size - 2)
    return table[k] + (at - k) * (table[k + 1] - table[k])


@njit(inline="always")
def _tabled(eta, cos_in):
    """Return the cosine by which a face's transmission is tabled (see `records.LossTables`); η = n_in / n_out."""
    return cos_in if eta <= 1.0 else math.sqrt(max(cos2_behind(eta, cos_in * cos_in), 0.0))


@njit(error_model="numpy")
def dim(faces, losses, count, work, lines):
    """Reduce the flux of each ray by its losses, and add these to the ledger, as `interfaces.apply_losses` does."""
    for r in range(count):
        flux, fate = work[FLUX + r], work[FATE + r]
        if not flux > 0.0:
            continue
        at_front = not faces.reflects and fate != faces.fates.missed_front and work[COS_FRONT + r] > 0.0
        cosine = _tabled(faces.front_eta, work[COS_FRONT + r]) if at_front else 0.0
        if cosine > 0.0:  # not totally reflected
            left = flux * _share(losses.front, cosine)
            lines[BY_FACES] += flux - left
            flux = left
        if fate == 0.0:
            left = flux * math.exp(-losses.coefficient * work[PATH + r])
            lines[BY_GLASS] += flux - left
            flux, cosine = left, work[COS_BACK + r]
            left = flux * _share(losses.back, cosine if faces.reflects else _tabled(faces.eta, cosine))
            lines[BY_FACES] += flux - left
            flux = left
        work[FLUX + r] = flux


@compiled()
def _rows(net, beam, faces, tilted, losses, cells, pixels, first, step, box, tent, lines):
    """Simulate a part of the light: every step-th row of cells from `first` on, added to the part's sums."""
    work, active, part = np.empty(WORK), np.empty(BLOCK, np.uint32), np.empty(LINES)
    for i in range(first, cells.n, step):
        for j in range(0, cells.n, BLOCK):
            count = min(BLOCK, cells.n - j)
            points(cells, i, j, count, work)
            _trace(net, beam, faces, tilted, losses, count, work, active)
            part[:] = 0.0  # partial sums by blocks: in one long sum of equal numbers rounding errors add up
            if losses.present:
                dim(faces, losses, count, work, part)
            count_rays(pixels, count, work, box, tent, part)
            for k in range(LINES):
                lines[k] += part[k]


@compiled()
def _rays(net, beam, faces, tilted, losses, x, y, landing, flux, fate):
    """Store landing (2, n), flux and fate of the rays through given points (n,)."""
    work, active = np.empty(WORK), np.empty(BLOCK, np.uint32)
    for first in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - first)
        for r in range(count):
            work[X + r], work[Y + r] = x[first + r], y[first + r]
        _trace(net, beam, faces, tilted, losses, count, work, active)
        for r in range(count):
            landing[0, first + r], landing[1, first + r] = work[X + r], work[Y + r]
            flux[first + r], fate[first + r] = work[FLUX + r], np.uint8(work[FATE + r])


Scene = tuple[Any, ...]  # net, light, faces and tilted screen (None for a level screen) as arguments of the kernels


class Form(NamedTuple):
    """Kernels of one form of the last face, and the conversion of (source, lens, receiver) to their arguments."""

    rows: Callable[..., None]
    rays: Callable[..., None]
    scene: Callable[..., Scene]


SeededLight = tuple[float, Emitter, Lens, int, Rectangle]  # weight, source, lens, seed, window (mm) at the first vertex


def simulate(
    lights: Sequence[SeededLight], screen: Screen, n: int, form: Form | None = None, cells: int = 1
) -> tuple[Tensor, Tensor, dict[str, float], int]:
    """Return (box picture, tent picture, ledger, number of rays) from n x n stratified rays of each light.

    Flux is a fraction of the flux of all sources, whose weights sum to 1.  form: None for heights.  cells: number of
    cells of the box picture along each side of a pixel.
    """
    form = form or HEIGHTS
    fine = screen.divided(cells)
    count = RAY_PARTS if math.prod(fine.shape) <= MANY_PIXELS else FEW_RAY_PARTS
    box, tent, lines = (np.zeros((count, *shape)) for shape in (fine.shape, screen.shape, (LINES,)))
    pixels = kernel_arguments.pixels(screen)
    many = len(lights) >= count  # True: a part traces whole lights; False: some rows of each light

    def part(c: int) -> None:
        for arguments in scenes[c::count] if many else scenes:
            form.rows(*arguments, pixels, *((0, 1) if many else (c, count)), box[c], tent[c], lines[c])

    scenes = list(_scenes(lights, screen.receiver, n, form.scene))
    reductions.on_threads(part, [(c,) for c in range(count)])
    rays = int(lines[:, COUNT].sum())
    box, tent, lines = (total.sum(0) for total in (box, tent, lines))
    flux = {"on target": float(lines[0]), "off target": float(lines[BESIDE] + lines[Status.TURNED_BACK])}
    flux |= {line: float(lines[reason]) for line, reason in LEDGER.items()}
    flux |= {line: float(lines[k]) for line, k in _taken(lights[0][2]).items()}
    return torch.from_numpy(box), torch.from_numpy(tent), flux, rays


def _taken(lens: Lens) -> dict[str, int]:
    """Return the index of each line of losses in the kernel's ledger, in the order in which light meets the losses."""
    losses = (loss for interface in lens.interfaces for loss in interface.losses)
    return {loss.line: BY_GLASS if loss.in_glass else BY_FACES for loss in losses}


def _scenes(
    lights: Sequence[SeededLight], receiver: Receiver, n: int, scene: Callable[..., Scene]
) -> Iterator[tuple[Any, ...]]:
    """Yield the first six arguments of `_rows` for each light; successive equal lenses are converted once."""
    last: tuple[Lens, tuple[Any, ...]] | None = None
    for weight, source, lens, seed, window in lights:
        if last is None or not _is_same(lens, last[0]):
            last = lens, (scene(source, lens, receiver), kernel_arguments.losses(lens))
        (net, _, faces, tilted), losses = last[1]
        cells, beam = kernel_arguments.cells(window, n, seed), kernel_arguments.beam(source, lens)
        assert beam is not None  # else the plain form traces the light
        beam = beam._replace(peak=beam.peak * weight * cells.width * cells.height)  # flux of a ray, not its density
        yield net, beam, faces, tilted, losses, cells


def _is_same(one: Lens, other: Lens) -> bool:
    """Return True if two lenses have the same surfaces, outlines, laws (so the same indices) and losses."""
    return len(one.interfaces) == len(other.interfaces) and all(
        a.surface is b.surface and (a.outline, a.law, a.losses) == (b.outline, b.law, b.losses)
        for a, b in zip(one.interfaces, other.interfaces, strict=True)
    )


def land(source: Emitter, lens: Lens, receiver: Receiver, x: Tensor, y: Tensor, form: Form | None = None) -> Landed:
    """Trace rays through (x, y) of the first vertex's plane, each (n,) float64, to `receiver`; flux: density at (x, y).

    Equal to `trace.trace` of these `source.rays_through` without losses, except for the status of rays without flux.
    """
    form = form or HEIGHTS
    scene = *form.scene(source, lens, receiver), NO_LOSS_TABLES
    landing, flux, fate = np.empty((2, x.numel())), np.empty(x.numel()), np.empty(x.numel(), np.uint8)
    reductions.on_threads(
        lambda first, last: form.rays(
            *scene, *(a[..., first:last] for a in (x.numpy(), y.numpy(), landing, flux, fate))
        ),
        reductions.shares(x.numel(), BLOCK),
    )
    return Landed(torch.from_numpy(landing), torch.from_numpy(flux), torch.from_numpy(fate))


def _scene(source: Emitter, lens: Lens, receiver: Receiver) -> Scene:
    """Return net, beam, faces and tilted screen for the kernels; light along -z is reflected by z -> -z."""
    (*front, last), z = lens.interfaces, lens.entrance.z
    heights = last.net.heights
    faces = kernel_arguments.faces(last, receiver, lens.passes.sense, z, *front)
    return net_of(-heights if lens.passes.sense < 0 else heights), kernel_arguments.beam(source, lens), *faces


HEIGHTS = Form(_rows, _rays, _scene)
