"""Recognition of a radial net (optics.surfaces.radial) in a file, which states control points but no centre."""

from __future__ import annotations

import contextlib
import math

import numpy as np

from bstcad.optics.surfaces.radial import RadialSurface


def radial_surface(net: np.ndarray) -> RadialSurface:
    """Return the radial surface with a control net (m, n, 3) (mm) about a centre on the z axis; ValueError if none.

    The centre is the origin, or that of a sphere through the net, or else the height found by `centre_height`.
    """
    for z in (0.0, sphere_height(net)):
        with contextlib.suppress(ValueError):
            return RadialSurface.from_control_points(net, z)
    z = centre_height(net)
    if not math.isfinite(z):
        raise ValueError("the control points have no centre on the axis")
    return RadialSurface.from_control_points(net, z)


def centre_height(net: np.ndarray) -> float:
    """Return z (mm) of the centre of a radial net (m, n, 3), by linear least squares; NaN if it is not defined.

    With the half extent U of the net in u, the half extent V = r U in v, and g = sqrt(s² + r² t²) at the fractions
    s, t in [-1, 1] of the control points, P_z = z + |P_xy| (1 / (g U) - g U) / 2.  This is linear in z, 1 / U and U.
    The control points of a sphere do not define its centre, because the three columns are then dependent.
    """
    m, n, _ = net.shape
    ratio = float(net[-1, -1, 1] / net[-1, -1, 0]) if net[-1, -1, 0] else math.nan
    if not math.isfinite(ratio):
        return math.nan
    s, t = np.meshgrid(np.linspace(-1, 1, m), ratio * np.linspace(-1, 1, n), indexing="ij")
    g, across = np.hypot(s, t), np.hypot(net[..., 0], net[..., 1])
    used = g > 0
    columns = np.stack([np.ones(used.sum()), across[used] / g[used] / 2, -across[used] * g[used] / 2], axis=1)
    return float(np.linalg.lstsq(columns, net[..., 2][used], rcond=None)[0][0])


def sphere_height(net: np.ndarray) -> float:
    """Return z (mm) of the centre of the sphere about the axis that is nearest to a net: |P|² = 2 z P_z + constant."""
    points = net.reshape(-1, 3)
    columns = np.stack([2 * points[:, 2], np.ones(len(points))], axis=1)
    return float(np.linalg.lstsq(columns, (points * points).sum(axis=1), rcond=None)[0][0])
