"""Light of a lamp inside a dome, in the fused CPU kernels (numba): `SphereLight` and the front, for blocks of rays.

All positions are relative to the centre of the dome.  The steps are those of the plain torch form: a ray leads from the
lamp through the point (x, y) of the sphere of radius R (optics/light/sphere_light.py), meets the front, a surface of
revolution c r² - 2 h + (1 + k) c h² = 0 of height h over its vertex, and is refracted by the normal

    N ∥ (-c x, -c y, 1 - (1 + k) c h).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from numba import njit

from bstcad.optics.kernels import kernel_arguments
from bstcad.optics.kernels.crossing import cosine_behind
from bstcad.optics.kernels.forward import (
    COS_FRONT,
    DX,
    DY,
    DZ,
    FATE,
    FLUX,
    SAG,
    SLOPE_X,
    SLOPE_Y,
    U,
    X,
    Y,
    Z,
    launch,
    shape,
    tilt,
)  # fmt: skip
from bstcad.optics.kernels.spline import beyond2
from bstcad.optics.lens.interfaces import Interface
from bstcad.optics.numerics.records import DomeFront


def front_of(before: Sequence[Interface], centre: float) -> DomeFront:
    """Return the one interface before a dome as numbers; centre: z of the dome's centre (mm)."""
    [front] = before
    surface = front.surface
    return DomeFront(kernel_arguments.front_face(before, 1), float(surface.z) - centre, int(surface.level))


@njit(error_model="numpy")
def launch_from_sphere(light, count, work):
    """Store flux density, start and direction of the rays through the points X and Y of the chart."""
    radius, beam, lamp = light.radius, light.beam, light.lamp
    for r in range(count):
        x, y = work[X + r], work[Y + r]
        u, v = x / (2.0 * radius), y / (2.0 * radius)
        square = u * u + v * v
        d_x, d_y, d_z = 2.0 * u / (1.0 + square), 2.0 * v / (1.0 + square), (1.0 - square) / (1.0 + square)
        p_x, p_y, p_z = radius * d_x - lamp.x, radius * d_y - lamp.y, radius * d_z - lamp.z
        length = math.sqrt(p_x * p_x + p_y * p_y + p_z * p_z)
        s_x, s_y, s_z = p_x / length, p_y / length, p_z / length
        ahead = s_z > light.least
        axial = s_z if ahead else 1.0
        stretch = (1.0 + d_z) / 2.0
        lit = ahead & (x * x + y * y <= light.limit_r2)
        density = (s_x * d_x + s_y * d_y + s_z * d_z) / (length * length) * (stretch * stretch)
        work[SAG + r] = light.peak * (radius * radius / (axial * axial * axial)) * density if lit else 0.0
        work[SLOPE_X + r], work[SLOPE_Y + r], work[U + r] = s_x, s_y, s_z
        work[X + r], work[Y + r] = beam.x + s_x * (radius / axial), beam.y + s_y * (radius / axial)
    launch(beam, count, work)
    if beam.pattern.present:
        shape(beam, count, work)
    elif beam.tilted == 1 and beam.distance > 0.0:
        tilt(beam, count, work)
    for r in range(count):
        work[FLUX + r] *= work[SAG + r]
        work[X + r], work[Y + r], work[Z + r] = lamp.x, lamp.y, lamp.z
        work[DX + r], work[DY + r], work[DZ + r], work[FATE + r] = (
            work[SLOPE_X + r],
            work[SLOPE_Y + r],
            work[U + r],
            0.0,
        )


@njit(error_model="numpy")
def cross_front(front, count, work):
    """Move rays to the front, refract them there, and store the cosine of incidence in COS_FRONT."""
    face, level = front.face, front.level == 1
    c, k, eta, fates, min_cos2 = face.curvature, face.conic_constant, face.eta, face.fates, face.rules.min_cos2
    for r in range(count):
        dx, dy, dz = work[DX + r], work[DY + r], work[DZ + r]
        path = (front.z - work[Z + r]) / (dz if abs(dz) > 1e-12 else 1e-12)
        x, y, s = work[X + r] + path * dx, work[Y + r] + path * dy, 0.0
        met = abs(dz) > face.rules.tangency
        if not level:  # Conic.crossing
            f = c * (x * x + y * y)
            g = dz - c * (x * dx + y * dy)
            square = g * g - c * (1.0 + k * dz * dz) * f
            divisor = g + math.sqrt(square if square > 0.0 else 1.0)
            ok = (square > 0.0) & (divisor > 1e-6)
            s = f / (divisor if ok else 1.0)
            met = ok & ((1.0 + k) * c * s * dz < 1.0)
        x, y, z = x + s * dx, y + s * dy, s * dz
        met &= path + s >= 0.0
        n_x, n_y, n_z = -c * x, -c * y, 1.0 - (1.0 + k) * c * z
        met &= n_z * n_z > min_cos2
        met &= beyond2(x, y, face.front_x, face.front_y) <= face.front_r2
        norm = 1.0 / math.sqrt(n_x * n_x + n_y * n_y + n_z * n_z)
        cos_in = (n_x * dx + n_y * dy + n_z * dz) * norm
        cos_out = cosine_behind(eta, cos_in)
        through = (cos_out > 0.0) & (cos_in > 0.0)
        bend = (cos_out - eta * cos_in) * norm
        if met:
            work[X + r], work[Y + r], work[Z + r] = x, y, front.z + z
        if met & through:
            work[DX + r], work[DY + r], work[DZ + r] = (
                eta * dx + bend * n_x,
                eta * dy + bend * n_y,
                eta * dz + bend * n_z,
            )
        work[COS_FRONT + r] = cos_in
        work[FATE + r] = fates.missed_front if not met else (0.0 if through else fates.reflected)


@njit(error_model="numpy")
def arrive_on_sphere(radius, distance, r, work):
    """Return the place (x, y) (mm) in the chart of the sphere of `radius` at which ray r is at `distance` (mm)."""
    x, y, z, dx, dy, dz = work[X + r], work[Y + r], work[Z + r], work[DX + r], work[DY + r], work[DZ + r]
    middle = x * dx + y * dy + z * dz
    s = math.sqrt(max(middle * middle - (x * x + y * y + z * z) + distance * distance, 0.0)) - middle
    x, y, z = x + s * dx, y + s * dy, z + s * dz
    scale = 2.0 * radius / max(math.sqrt(x * x + y * y + z * z) + z, 1e-300)
    return scale * x, scale * y
