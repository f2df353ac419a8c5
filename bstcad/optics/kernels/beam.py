"""The light of a source as the kernels take it: a closed form as numbers, or a table of splines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from torch import Tensor

ALONG_Z = (0, 0.0, 0.0, 1.0, 0.0)  # the last fields of a Beam that is not tilted


def floats(values: Sequence[float | Tensor]) -> tuple[float, ...]:
    """A kernel is compiled anew for every combination of types: a radius of 12 must not be another than one of 12.0."""
    return tuple(float(v) for v in values)


class Table(NamedTuple):
    """Irradiance and slopes of rays on a plane: splines, flat nets of m x n heights."""

    m: int  # control points along x; 0: there is no table
    n: int  # and along y
    x: float  # corner of the nets (mm)
    y: float
    per_x: float  # control points per mm
    per_y: float
    irradiance: np.ndarray  # 1/mm²
    slope_x: np.ndarray  # |dx/dz|, with its sign along the light
    slope_y: np.ndarray


NO_TABLE = Table(0, 0, 0.0, 0.0, 0.0, 0.0, *3 * (np.zeros(0),))


class Beam(NamedTuple):
    """E = peak exp(-fall r²) / d^power on the plane of the front's vertex, r from (x, y), where inside the limits.

    Irradiance of a tilted point source is `Point._tilted_irradiance`: c / d^4, 1 / d³ or exp(-fall (d² - c²) / c²) / c³
    for the powers 4, 3 and 0, times the peak.  With a table E is peak times the table's.
    """

    x: float  # the source, or the middle of the beam (mm)
    y: float
    limit_x: float  # outlines.Limits of the light (mm, mm, mm²)
    limit_y: float
    limit_r2: float
    peak: float
    fall: float  # 1/mm²; of a tilted source a number
    power: int  # 0, 3 or 4, of the distance d of a point source
    distance: float  # distance of a point source from the plane (mm); 0: collimated, or a table
    start: float  # how far from the plane rays start (mm)
    tilted: int  # 1: light is not along (0, 0, 1), but along n, or as a table says
    n_x: float  # the source's axis, in the frame in which light begins along +z
    n_y: float
    n_z: float
    least: float  # cosine to the axis from which on there is light
    table: Table = NO_TABLE
