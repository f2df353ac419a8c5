"""Records of lens, light, cells and screen as arguments of a fused kernel: named tuples of fixed types.

A compiled kernel finds a field by its index, so the records are part of this folder, on whose contents the cache of
kernels depends (compiling.py).  Emitters create their own Beam; kernel_arguments.py creates the other records.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from torch import Tensor


def floats(**values: float | Tensor) -> dict[str, float]:
    """Convert fields of a record to floats, since a kernel is compiled again for every combination of types."""
    return {name: float(value) for name, value in values.items()}


class LightTable(NamedTuple):
    """Irradiance and slopes of rays on a plane, as splines: flattened nets of m x n values."""

    m: int  # control points along x; 0: no table
    n: int  # control points along y
    x: float  # position of the corner of the nets (mm)
    y: float
    per_x: float  # control points per mm along x and y
    per_y: float
    irradiance: np.ndarray  # net of the irradiance (1/mm²)
    slope_x: np.ndarray  # nets of dx/|dz| and dy/|dz| of the rays
    slope_y: np.ndarray


NO_TABLE = LightTable(0, 0, 0.0, 0.0, 0.0, 0.0, *3 * (np.zeros(0),))


class Frame3(NamedTuple):
    """Vector in the frame in which light starts along +z."""

    x: float
    y: float
    z: float


class NetTable(NamedTuple):
    """Net of a quadratic B-spline in (u, v), as `profiles.Net`."""

    m: int  # control points along u; 0: no net
    n: int  # control points along v
    u_min: float  # range of u
    u_max: float
    v_min: float  # range of v
    v_max: float
    per_u: float  # spans per unit
    per_v: float
    values: np.ndarray  # (m n,)


NO_NET = NetTable(m=0, n=0, u_min=0.0, u_max=0.0, v_min=0.0, v_max=0.0, per_u=0.0, per_v=0.0, values=np.zeros(0))


class Pattern(NamedTuple):
    """Irradiance E(u, v) as `profiles.Profile`; u = p · x / (p · axis), v likewise, for a ray p of a point source.

    For parallel light u = p · x and v = p · y for the place p from the centre of the beam, on any plane z = const.
    """

    present: int  # 1: the irradiance is this profile; 0: the formula of `Beam`
    x: Frame3  # direction of u
    y: Frame3  # direction of v
    axis: Frame3  # axis of a point source
    fall_u: float  # 1 / w_u; 0: no fall
    fall_v: float
    power: float  # order / 2
    inner2: float  # square of the radius of the dark disc
    stereographic: int  # 1: u = p · x / (d + p · axis), and E is the intensity, so that it is E D / d³ on a plane
    net: NetTable


_UNIT = Frame3(0.0, 0.0, 1.0)
NO_PATTERN = Pattern(
    present=0, x=_UNIT, y=_UNIT, axis=_UNIT, fall_u=0.0, fall_v=0.0, power=1.0, inner2=0.0, stereographic=0, net=NO_NET
)


class Beam(NamedTuple):
    """Irradiance E = peak exp(-fall r²) / d^power on the first vertex's plane; r, d: distances from (x, y) and source.

    The irradiance of a tilted point source is `Point._tilted_irradiance`: peak times c / d^4, 1 / d³ or exp(-fall (d² -
    c²) / c²) / c³, c = d cos θ, for the powers 4, 3 and 0.  With a table E is peak times the table's irradiance.
    """

    x: float = 0.0  # position of the source, or of the beam's centre (mm)
    y: float = 0.0
    limit_x: float = 0.0  # outlines.Limits of the light (mm, mm, mm²)
    limit_y: float = 0.0
    limit_r2: float = math.inf
    peak: float = 1.0  # factor of the irradiance
    fall: float = 0.0  # coefficient of the exponent (1/mm²); without unit for a tilted point source
    power: int = 0  # power of the distance d of a point source: 0, 3 or 4
    distance: float = 0.0  # distance of a point source from the plane (mm); 0: collimated, or a table
    start: float = 0.0  # distance from this plane to the plane from which rays start (mm)
    tilted: int = 0  # 1: the axis of the light is n or given by a table; 0: (0, 0, 1)
    n_x: float = 0.0  # axis n of the source, in the frame in which light starts along +z
    n_y: float = 0.0
    n_z: float = 1.0
    least: float = 0.0  # smallest cosine of the angle to the axis at which there is light
    table: LightTable = NO_TABLE  # table of the light
    pattern: Pattern = NO_PATTERN  # irradiance by a profile of its own, inside the limits


class SphereBeam(NamedTuple):
    """Light of a lamp by the points of a sphere, as `sphere_light.SphereLight`."""

    beam: Beam  # irradiance of the lamp on the plane at the distance R from it
    radius: float  # R (mm)
    lamp: Frame3  # position of the lamp
    limit_r2: float  # square of the radius of the disc of the chart in which light is launched (mm²)
    least: float  # sphere_light.MIN_AXIAL_COSINE
    peak: float = 1.0  # factor of the flux density


class Rules(NamedTuple):
    """Constants of the plain torch form; all are floats, so that a parallel kernel accepts them as one tuple."""

    newton_steps: float  # interfaces.NEWTON_STEPS
    approach_steps: float  # interfaces.APPROACH_STEPS
    side_exit: float  # interfaces.SIDE_EXIT_COSINE
    min_derivative: float  # interfaces.MIN_NEWTON_DERIVATIVE
    tangency: float  # interfaces.TANGENCY_TOLERANCE
    min_cos: float  # interfaces.MIN_COS_REFRACTION
    min_cos2: float  # surfaces.MIN_COS2
    grazing: float  # rays.MIN_AXIAL_COSINE


class Fates(NamedTuple):
    """Status of lost rays (rays.Status), as a kernel stores it."""

    missed_front: float  # status of rays that miss the front
    missed_back: float  # status of rays that miss the net
    reflected: float  # status of rays that the law of a face blocks
    turned: float  # status of rays that lead away from the screen


class TiltedScreen(NamedTuple):
    """Tilted plane or directions, in the frame where light starts along +z; `Faces.throw`: height of C over the net."""

    x: float  # position of the centre C of the rotation (mm), also the coordinates of C on the plane
    y: float
    n_x: float  # normal, along the light that the plane receives
    n_y: float
    n_z: float
    x_x: float  # x axis of the plane
    x_y: float
    x_z: float
    y_x: float  # y axis of the plane
    y_y: float
    y_z: float
    goniometer: int = 0  # directions.GONIOMETERS, for the angles of the direction (x, y, n_z z); 0: a plane


class Screens(NamedTuple):
    """Planes on which light lands behind one net."""

    throws: np.ndarray  # (k,) `Faces.throw` of each plane (mm)
    tilted: tuple[TiltedScreen, ...] | None  # each plane; None: all are level


class Faces(NamedTuple):
    """Lens and screen as numbers, in the frame in which light starts along +z (see `kernel_arguments.faces`)."""

    reflects: int  # 1: the net is a mirror
    curvature: float  # curvature of the front (1/mm)
    conic_constant: float  # conic constant of the front
    eta: float  # relative index η = n_in / n_out at the net
    front_eta: float  # relative index at the front; without a front 1
    front_x: float  # outlines.Limits of the front's clear aperture (mm, mm, mm²)
    front_y: float
    front_r2: float
    limit_x: float  # outlines.Limits of the net's clear aperture (mm, mm, mm²)
    limit_y: float
    limit_r2: float
    gap: float  # distance from the plane of `Rays.z`, or of the first vertex, to the plane of the net's heights (mm)
    m: int  # control points along x
    n: int  # control points along y
    x: float  # position of the net's corner (mm)
    y: float
    per_x: float  # control points per mm along x and y
    per_y: float
    steepest_x: float  # interfaces.NetBounds of the net
    steepest_y: float
    lowest: float
    tolerance: float
    near: float
    throw: float  # distance from the net's plane to the screen, to its centre if it is tilted (mm)
    rules: Rules
    fates: Fates


class FrontFace(NamedTuple):
    """Face in front of a net as numbers, by the names of `Faces`, in the frame in which light starts along +z."""

    present: int  # 1: there is such a face; 0: light comes from the source to the net
    curvature: float  # curvature of the face (1/mm)
    conic_constant: float
    front_x: float  # outlines.Limits of its clear aperture (mm, mm, mm²)
    front_y: float
    front_r2: float
    eta: float  # relative index η = n_in / n_out at the face
    rules: Rules
    fates: Fates


class DomeFront(NamedTuple):
    """Front of a dome as numbers."""

    face: FrontFace
    z: float  # z of its vertex
    level: int  # 1: it is a plane


class RayCells(NamedTuple):
    """Grid of n x n cells with a ray in each."""

    n: int  # cells per side
    key: np.uint64  # key of the jitter: sampling.hash_seed of the seed
    width: float  # size of a cell (mm)
    height: float
    half_x: float  # half extent of the window (mm)
    half_y: float
    stride: np.uint64  # sampling.SPLITMIX_INCREMENT
    mix_1: np.uint64  # sampling.MIX_1
    mix_2: np.uint64  # sampling.MIX_2


class Pixels(NamedTuple):
    """Edges of the screen (mm) and pixels per mm."""

    left: float
    right: float
    bottom: float
    top: float
    per_x: float
    per_y: float


class LossTables(NamedTuple):
    """Losses of faces and glass: the transmission of each face at cosines k / (n - 1), k = 0 … n - 1.

    At a face into the denser medium, or at a mirror, the cosine is that of the angle of incidence, else of refraction.
    The transmission is smooth in this cosine: linear interpolation (uncoated, index up to 2) is accurate to 7e-7.
    """

    present: int  # 0: no losses
    front: np.ndarray  # transmission of the front; unused for a mirror
    back: np.ndarray  # transmission of the back, or reflectance of a mirror
    coefficient: float  # absorption coefficient of the glass (1/mm)


NO_LOSS_TABLES = LossTables(0, np.ones(2), np.ones(2), 0.0)
