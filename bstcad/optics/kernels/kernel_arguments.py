"""Lens, cells and screen as the plain numbers that a fused kernel takes: named tuples of one type a field.

The light of a source is a Beam (beam.py).

So are the constants of the plain form: numba's cache looks at a kernel's own file only, and what that takes from
another file would stay as it was when the kernel was compiled.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
import torch

from bstcad.optics import interfaces, rays, sampling, surfaces
from bstcad.optics.bspline import halfway, interpolated
from bstcad.optics.emitters import Emitter
from bstcad.optics.interfaces import Interface
from bstcad.optics.irradiance import Screen
from bstcad.optics.kernels.beam import Beam, Table, floats
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.rays import Status
from bstcad.optics.receivers import Receiver

NODES = 4097  # places of a table of a face's transmission
SIDES = 65, 129, 257, 513  # control points a side of a table, tried in turn
EXACT = 1e-5  # largest RMS of a table's relative error in the irradiance: far below that of any picture …
DARK = 1e-4  # … where the irradiance is above this part of the largest
STRAIGHT = 1e-8  # largest RMS of a table's error in the slopes of rays
PEAK = 100.0  # largest error over these: the outermost spans are the least exact
KEPT = 16  # tables at a time
SLOWER = 0.5  # light whose errors a table of twice the sides does not divide by 1 / SLOWER has an edge
OF_A_TABLE = 0.0, 0.0, 0.0, 0.0, math.inf, 1.0, 0.0, 0, 0.0  # first fields of the Beam of a table


class Rules(NamedTuple):
    """The constants of the plain form; all are floats, so that a parallel kernel takes them as one tuple."""

    newton_steps: float  # interfaces.NEWTON_STEPS
    approach_steps: float  # interfaces.APPROACH_STEPS
    level: float  # interfaces.LEVEL
    flattest: float  # interfaces.FLATTEST
    along: float  # interfaces.ALONG
    skimming: float  # interfaces.SKIMMING
    equator: float  # surfaces.EQUATOR
    grazing: float  # rays.GRAZING


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


def rules() -> Rules:
    """The constants of the plain form, as they are now."""
    steps = (interfaces.NEWTON_STEPS, interfaces.APPROACH_STEPS)
    least = (interfaces.LEVEL, interfaces.FLATTEST, interfaces.ALONG, interfaces.SKIMMING)
    return Rules(*floats([*steps, *least, surfaces.EQUATOR, rays.GRAZING]))


def faces(
    interface: Interface, plane: Receiver | None, sense: int, start: float, front: Interface | None = None
) -> tuple[Faces, Tilted | None]:
    """The net of an interface, the screen behind it and the front before it, if there are any, as numbers.

    The kernels know light along +z: where it comes along -z (sense -1) all numbers are those of the scene seen in the
    mirror z -> -z, and so have to be the heights and the rays (crossing.upright).  start: the plane that the
    positions of the rays count from (mm).
    """
    surface, law = interface.surface, interface.law
    bent = (front.surface.curvature, front.surface.conic_constant) if front else (0.0, 0.0)
    limits = [limit for i in (front or interface, interface) for limit in i.outline.limits]
    net = [surface.x[0], surface.y[0], *(1 / pitch for pitch in surface.pitch)]
    known, throw = interfaces.net_bounds(surface, torch.float64, sense), plane.middle[2] if plane is not None else 0.0
    face = floats([*bent, law.eta, *limits, sense * (surface.z - start)])
    net = floats([*net, *known, sense * (throw - surface.z)])
    fates = [Status.MISSED_FRONT, interface.status_if_missed, law.status_if_blocked, Status.TURNED_BACK]
    numbers = Faces(int(law.reverses), *face, *surface.shape, *net, rules(), Fates(*floats(fates)))
    return numbers, _tilted(plane, sense, -sense if law.reverses else sense)


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


def losses(lens: Lens) -> Losses:
    """The lens's losses as numbers, by the plain forms of losses.py."""
    if lens.losses is None:
        return NO_LOSSES
    *front, back = (_table(interface) for interface in lens.interfaces)
    glass = [loss.coefficient for i in lens.interfaces for loss in i.losses if loss.in_glass]
    return Losses(1, front[0] if front else back, back, float(sum(glass)))


def _table(interface: Interface) -> np.ndarray:
    """The share that a face lets through, over the cosine (see `Losses`)."""
    cosine, law = torch.linspace(0, 1, NODES, dtype=torch.float64), interface.law
    cos_in = cosine if law.eta <= 1 else torch.sqrt(1 - (1 - cosine * cosine) / law.eta**2)
    cos_out = law.turned(cos_in)[1] if law.eta <= 1 else cosine
    share = torch.ones_like(cosine)
    for loss in interface.losses:
        if not loss.in_glass:
            share = share * loss.share(cos_in, cos_out, torch.zeros_like(cosine))
    return share.contiguous().numpy()


def beam(source: Emitter, lens: Lens, tables: bool = True) -> Beam | None:
    """The light of a source on the plane of the first vertex of a lens; None: the plain form traces it.

    tables: may it be a table?
    """
    first, aperture = lens.entrance, lens.interfaces[0].outline
    found = source.beam(first.z)
    if found is None and tables:
        return _tabled(source, source.window(aperture, first.z, first.sags(aperture)), first.z)
    return found


@functools.lru_cache(maxsize=KEPT)  # 6 MB each at most
@torch.no_grad()
def _tabled(source: Emitter, window: Rectangle, z: float) -> Beam | None:
    """The light by the coarsest table that is right half way between its points; None: none of SIDES is.

    It holds what the source says of its light on the plane z (mm), at the places of the control points of splines.
    """
    last = math.inf
    for side in SIDES:
        along = np.linspace(-0.5, 0.5, 2 * side - 1)
        x, y = (torch.from_numpy(p) for p in np.meshgrid(along * window.width, along * window.height, indexing="ij"))
        rays = source.rays(x, y, z, 1.0)
        ahead, starts = rays.sense * rays.direction[2], (rays.sense * -rays.above(z)).max()
        if not bool(rays.alive.all() & (ahead > 0).all()):
            return None
        values = [part.numpy() for part in (rays.flux, *(rays.direction[:2] / ahead))]
        nets = [interpolated(known[::2, ::2]) for known in values]
        scales = EXACT * (values[0] + DARK * values[0].max()), STRAIGHT, STRAIGHT
        triples = zip(nets, values, scales, strict=True)
        off = [(halfway(net) - known) / scale for net, known, scale in triples]
        error = max(max(np.sqrt(np.mean(part**2)), np.abs(part).max() / PEAK) for part in off)
        if error <= 1.0:
            size = window.width, window.height
            corner = [*(-s / 2 for s in size), *((side - 1) / s for s in size)]
            table = Table(side, side, *corner, *(net.ravel() for net in nets))
            return Beam(*OF_A_TABLE, start=float(starts), tilted=1, n_x=0.0, n_y=0.0, n_z=1.0, least=0.0, table=table)
        if not error < SLOWER * last:
            return None
        last = error
    return None


def _tilted(plane: Receiver | None, before: int, behind: int) -> Tilted | None:
    """A tilted plane as numbers, None for a level one; before, behind: the light's way along z at the last face."""
    if plane is None or plane.is_level:
        return None
    along_x, along_y, normal = ((*axis[:2], before * axis[2]) for axis in plane.axes)
    return Tilted(*floats([*plane.middle[:2], *(behind * n for n in normal), *along_x, *along_y]))


def cells(window: Rectangle, n: int, seed: int) -> Cells:
    """n x n cells of a window centred on the axis."""
    width, height = window.width / n, window.height / n
    key, *mixing = map(np.uint64, (sampling.key(seed), sampling.STRIDE, sampling.MIX_1, sampling.MIX_2))
    return Cells(n, key, width, height, window.width / 2, window.height / 2, *mixing)


def pixels(screen: Screen) -> Pixels:
    """The screen as numbers."""
    return Pixels(*floats([*screen.x, *screen.y, *screen.per_unit]))
