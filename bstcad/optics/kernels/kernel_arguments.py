"""Conversion of lens, light, cells and screen to the arguments of a fused kernel (records.py).

The constants of the plain torch form are passed as numbers, too: a cached kernel would not notice that a constant
imported from a file outside this folder has changed.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
import torch

from bstcad.optics.lens import interfaces
from bstcad.optics.lens.interfaces import Interface
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.numerics import records
from bstcad.optics.numerics.records import (
    Beam,
    Faces,
    Fates,
    LightTable,
    LossTables,
    Pixels,
    RayCells,
    Rules,
    Screens,
    floats,
)
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces import rays, sampling, surfaces
from bstcad.optics.surfaces.bspline import interpolating_net, midpoint_values
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.rays import Status

TRANSMISSION_NODES = 4097  # number of nodes of a table of a face's transmission
TABLE_SIDES = 65, 129, 257, 513  # control points per side of a table of light, tried in this order
IRRADIANCE_TOLERANCE = 1e-5  # largest RMS of a table's relative error in the irradiance, far below errors of pictures
MIN_IRRADIANCE = 1e-4  # fraction of the maximum irradiance that is added to the divisor of the relative error
SLOPE_TOLERANCE = 1e-8  # largest RMS of a table's error in the slopes of rays
PEAK_TO_RMS = 100.0  # largest allowed error of a table at a point / RMS tolerance; end spans have the largest errors
MAX_LIGHT_TABLES = 16  # maximum number of tables of light in the cache
MAX_TABLE_ERROR_RATIO = 0.5  # largest ratio of a table's error to the coarser table's; larger: the light has an edge


def rules() -> Rules:
    """Return the current constants of the plain torch form."""
    steps = (interfaces.NEWTON_STEPS, interfaces.APPROACH_STEPS)
    search = (interfaces.SIDE_EXIT_COSINE, interfaces.MIN_NEWTON_DERIVATIVE, interfaces.TANGENCY_TOLERANCE)
    return Rules(*floats([*steps, *search, interfaces.MIN_COS_REFRACTION, surfaces.MIN_COS2, rays.MIN_AXIAL_COSINE]))


def faces(
    interface: Interface, plane: Receiver | None, sense: int, start: float, front: Interface | None = None
) -> tuple[Faces, records.TiltedScreen | None]:
    """Return (Faces of a net, with front and screen if given; TiltedScreen, or None for a level screen or no screen).

    The kernels trace light along +z.  If light comes along -z (sense -1), all numbers describe the scene reflected by
    z -> -z; the caller reflects heights and rays (crossing.reflect_z).  start: `Rays.z`, or z of the first vertex (mm).
    """
    surface, law = interface.net, interface.law
    conic = (front.surface.curvature, front.surface.conic_constant) if front else (0.0, 0.0)
    limits = [limit for i in (front or interface, interface) for limit in i.outline.limits]
    corner, per_mm = (surface.x[0], surface.y[0]), (1 / pitch for pitch in surface.pitch)
    bounds, throw = interfaces.net_bounds(surface, torch.float64, sense), plane.middle[2] if plane is not None else 0.0
    face = floats([*conic, law.eta, front.law.eta if front else 1.0, *limits, sense * (surface.z - start)])
    net = floats([*corner, *per_mm, *bounds, sense * (throw - surface.z)])
    fates = [Status.MISSED_FRONT, interface.status_if_missed, law.status_if_blocked, Status.TURNED_BACK]
    numbers = Faces._make([int(law.reverses), *face, *surface.shape, *net, rules(), Fates(*floats(fates))])
    if plane is None or plane.is_level:
        return numbers, None
    return numbers, _tilted(plane, sense, -sense if law.reverses else sense)


def front_face(before: Sequence[Interface], sense: int) -> records.FrontFace:
    """Return the face in front of a net as numbers; before: this face, or nothing."""
    numbers, fates = [0.0, 0.0, *3 * [math.inf], 1.0], [Status.MISSED_FRONT] * 4
    for face in before:
        form = floats([sense * face.surface.curvature, face.surface.conic_constant])
        numbers = [*form, *face.outline.limits, face.law.eta]
        fates = [*2 * [face.status_if_missed], face.law.status_if_blocked, Status.TURNED_BACK]
    return records.FrontFace._make([len(before), *floats(numbers), rules(), Fates(*floats(fates))])


def screens(interface: Interface, planes: Sequence[Receiver], sense: int) -> Screens:
    """Return the planes behind a net as numbers; sense: of the light before the net."""
    behind, z = -sense if interface.law.reverses else sense, interface.net.z
    throws = np.array([sense * (plane.middle[2] - z) for plane in planes])
    if all(plane.is_level for plane in planes):
        return Screens(throws, None)
    return Screens(throws, tuple(_tilted(plane, sense, behind) for plane in planes))


def losses(lens: Lens) -> LossTables:
    """Return the losses of a lens as numbers, from the plain forms of losses.py."""
    if lens.losses is None:
        return records.NO_LOSS_TABLES
    from bstcad.optics.lens.losses import AbsorptionLoss  # loaded already, since the lens has losses

    *front, back = (_table(interface) for interface in lens.interfaces)
    glass = [loss.coefficient for i in lens.interfaces for loss in i.losses if isinstance(loss, AbsorptionLoss)]
    return LossTables(1, front[0] if front else back, back, float(sum(glass)))


def _table(interface: Interface) -> np.ndarray:
    """Return the transmission of a face at equal steps of the cosine (see `LossTables`)."""
    cosine, law = torch.linspace(0, 1, TRANSMISSION_NODES, dtype=torch.float64), interface.law
    cos_in = cosine if law.eta <= 1 else torch.sqrt(1 - (1 - cosine * cosine) / law.eta**2)
    cos_out = law.deflection(cos_in)[1] if law.eta <= 1 else cosine
    share = torch.ones_like(cosine)
    for loss in interface.losses:
        if not loss.in_glass:
            share = share * loss.share(cos_in, cos_out, torch.zeros_like(cosine))
    return share.contiguous().numpy()


def beam(source: Emitter, lens: Lens, tables: bool = True) -> Beam | records.SphereBeam | None:
    """Return the light of a source on the plane of the first vertex of a lens; None: plain torch traces it.

    tables: allow a table of the light if no formula is known; there is none by the points of a sphere.
    """
    first, aperture = lens.entrance, lens.interfaces[0].outline
    formula = source.beam(first.z)
    if formula is None and tables and source.kind != "sphere":
        return _table_of_light(source, source.window(aperture, first.z, first.sags(aperture)), first.z)
    return formula


@functools.lru_cache(maxsize=MAX_LIGHT_TABLES)  # at most 6 MB each
@torch.no_grad()
def _table_of_light(source: Emitter, window: Rectangle, z: float) -> Beam | None:
    """Return the coarsest table of the light that is accurate midway between its points; None: no table is accurate.

    The table contains splines through the source's irradiance and ray slopes at points of the plane z (mm).
    """
    last = math.inf
    for side in TABLE_SIDES:
        along = np.linspace(-0.5, 0.5, 2 * side - 1)
        x, y = (torch.from_numpy(p) for p in np.meshgrid(along * window.width, along * window.height, indexing="ij"))
        rays = source.rays_through(x, y, z, 1.0)
        ahead, starts = rays.sense * rays.direction[2], (rays.sense * -rays.above(z)).max()
        if not bool(rays.alive.all() & (ahead > 0).all()):
            return None
        values = [part.numpy() for part in (rays.flux, *(rays.direction[:2] / ahead))]
        nets = [interpolating_net(known[::2, ::2]) for known in values]
        irradiance_scale = IRRADIANCE_TOLERANCE * (values[0] + MIN_IRRADIANCE * values[0].max())
        triples = zip(nets, values, (irradiance_scale, SLOPE_TOLERANCE, SLOPE_TOLERANCE), strict=True)
        errors = [(midpoint_values(net) - known) / scale for net, known, scale in triples]
        error = max(max(np.sqrt(np.mean(part**2)), np.abs(part).max() / PEAK_TO_RMS) for part in errors)
        if error <= 1.0:
            size = window.width, window.height
            corner = [*(-s / 2 for s in size), *((side - 1) / s for s in size)]
            table = LightTable._make([side, side, *corner, *(net.ravel() for net in nets)])
            return Beam(start=float(starts), tilted=1, table=table)
        if not error < MAX_TABLE_ERROR_RATIO * last:
            return None
        last = error
    return None


def _tilted(receiver: Receiver, before: int, behind: int) -> records.TiltedScreen:
    """Return a receiver as numbers; before, behind: sense of light on the net's two sides."""
    if (
        receiver.goniometer
    ):  # the coordinates of the direction, whose z component is `before` times that in the kernels' frame
        return records.TiltedScreen._make([*floats([0.0, 0.0, 0.0, 0.0, before, *6 * [0.0]]), receiver.goniometer])
    assert receiver.axes is not None  # no kernel traces to other receivers
    along_x, along_y, normal = ((*axis[:2], before * axis[2]) for axis in receiver.axes)
    numbers = floats([*receiver.middle[:2], *(behind * n for n in normal), *along_x, *along_y])
    return records.TiltedScreen._make([*numbers, 0])


def cells(window: Rectangle, n: int, seed: int) -> RayCells:
    """Return n x n cells of a window centred on the axis."""
    width, height = window.width / n, window.height / n
    key, *mixing = map(
        np.uint64, (sampling.hash_seed(seed), sampling.SPLITMIX_INCREMENT, sampling.MIX_1, sampling.MIX_2)
    )
    return RayCells(n, key, width, height, window.width / 2, window.height / 2, *mixing)


def pixels(screen: Screen) -> Pixels:
    """Return the screen as numbers."""
    return Pixels(*floats([*screen.x, *screen.y, *screen.per_unit]))
