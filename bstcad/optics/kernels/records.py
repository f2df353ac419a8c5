"""Lens, light, cells and screen as the plain numbers that a fused kernel takes: named tuples of one type a field.

They stand in this folder, whose contents a cache of kernels goes by (compiling.py): a kernel finds a field by its
place.  An emitter makes its Beam by itself; kernel_arguments.py makes the others.
"""

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


class Rules(NamedTuple):
    """The constants of the plain form; all are floats, so that a parallel kernel takes them as one tuple."""

    newton_steps: float  # interfaces.NEWTON_STEPS
    approach_steps: float  # interfaces.APPROACH_STEPS
    level: float  # interfaces.LEVEL
    flattest: float  # interfaces.FLATTEST
    along: float  # interfaces.ALONG
    skimming: float  # interfaces.SKIMMING
    equator: float  # surfaces.EQUATOR
    grazing: float  # rays.MIN_AXIAL_COSINE


class Fates(NamedTuple):
    """The status of lost rays: rays.Status as the kernel writes it."""

    missed_front: float
    missed_back: float
    reflected: float  # rays that the law of the net does not let through
    turned: float  # away from the screen


class Tilted(NamedTuple):
    """A tilted plane as numbers, in the frame in which light begins along +z; z from the net's plane is `throw`."""

    x: float  # place of the point C that it is turned about (mm), from which x and y on the plane count
    y: float
    n_x: float  # the normal, with the light that the plane is there for
    n_y: float
    n_z: float
    x_x: float  # the axis of x
    x_y: float
    x_z: float
    y_x: float  # the axis of y
    y_y: float
    y_z: float


class Faces(NamedTuple):
    """The lens and the screen as numbers, in the frame in which light begins along +z (see `faces`)."""

    reflects: int  # 1: the net is a mirror
    curvature: float  # curvature of the front (1/mm)
    conic_constant: float  # conic constant of the front
    index: float  # before the net over that behind it, the law's η
    front_x: float  # outlines.Limits of the front's clear aperture (mm, mm, mm²)
    front_y: float
    front_r2: float
    limit_x: float  # and of the back's
    limit_y: float
    limit_r2: float
    gap: float  # from the plane where the rays begin to the plane the net's heights are measured from (mm)
    m: int  # control points along x
    n: int  # and along y
    x: float  # the net's corner (mm)
    y: float
    per_x: float  # control points per mm
    per_y: float
    steepest_x: float  # interfaces.NetBounds of the net
    steepest_y: float
    lowest: float
    tolerance: float
    near: float
    throw: float  # from the net's plane to the screen, of a tilted one to its middle (mm)
    rules: Rules
    fates: Fates


class Cells(NamedTuple):
    """n x n cells with a ray in each."""

    n: int
    key: np.uint64  # key of the jitter
    width: float  # size of a cell (mm)
    height: float
    half_x: float  # half extent of the window (mm)
    half_y: float
    stride: np.uint64  # sampling.STRIDE
    mix_1: np.uint64  # sampling.MIX_1
    mix_2: np.uint64  # sampling.MIX_2


class Pixels(NamedTuple):
    """The screen's edges (mm) and its pixels per mm."""

    left: float
    right: float
    bottom: float
    top: float
    per_x: float
    per_y: float


class Losses(NamedTuple):
    """Losses of faces and glass: the share that each face lets through at cosines k / (n - 1), k = 0 … n - 1.

    At a face into the denser medium, or at a mirror, the cosine is that of incidence, else that of refraction: in these
    the share is smooth, and linear interpolation of it right to 1e-7.
    """

    told: int  # 0: there are none
    front: np.ndarray
    back: np.ndarray
    coefficient: float  # coefficient of absorption (1/mm)


NO_LOSSES = Losses(0, np.ones(2), np.ones(2), 0.0)
