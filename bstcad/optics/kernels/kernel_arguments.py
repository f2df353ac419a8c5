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
    return Rules(
        **floats(
            newton_steps=interfaces.NEWTON_STEPS, approach_steps=interfaces.APPROACH_STEPS,
            side_exit=interfaces.SIDE_EXIT_COSINE, min_derivative=interfaces.MIN_NEWTON_DERIVATIVE,
            tangency=interfaces.TANGENCY_TOLERANCE, min_cos=interfaces.MIN_COS_REFRACTION, min_cos2=surfaces.MIN_COS2,
            grazing=rays.MIN_AXIAL_COSINE,
        )
    )  # fmt: skip


def faces(
    interface: Interface, plane: Receiver | None, sense: int, start: float, front: Interface | None = None
) -> tuple[Faces, records.TiltedScreen | None]:
    """Return (Faces of a net, with front and screen if given; TiltedScreen, or None for a level screen or no screen).

    The kernels trace light along +z.  If light comes along -z (sense -1), all numbers describe the scene reflected by
    z -> -z; the caller reflects heights and rays (crossing.reflect_z).  start: `Rays.z`, or z of the first vertex (mm).
    """
    surface, law = interface.net, interface.law
    (front_x, front_y, front_r2), (limit_x, limit_y, limit_r2) = (
        each.outline.limits for each in (front or interface, interface)
    )
    (m, n), throw = surface.shape, 0.0 if plane is None else plane.middle[2]
    fates = floats(
        missed_front=Status.MISSED_FRONT, missed_back=interface.status_if_missed, reflected=law.status_if_blocked,
        turned=Status.TURNED_BACK,
    )  # fmt: skip
    numbers = Faces(
        reflects=int(law.reverses), m=m, n=n, rules=rules(), fates=Fates(**fates),
        **floats(
            curvature=front.surface.curvature if front else 0.0,
            conic_constant=front.surface.conic_constant if front else 0.0,
            eta=law.eta, front_eta=front.law.eta if front else 1.0,
            front_x=front_x, front_y=front_y, front_r2=front_r2,
            limit_x=limit_x, limit_y=limit_y, limit_r2=limit_r2,
            gap=sense * (surface.z - start), throw=sense * (throw - surface.z),
            x=surface.x[0], y=surface.y[0], per_x=1 / surface.pitch[0], per_y=1 / surface.pitch[1],
            **interfaces.net_bounds(surface, torch.float64, sense)._asdict(),
        ),
    )  # fmt: skip
    if plane is None or plane.is_level:
        return numbers, None
    return numbers, _tilted(plane, sense, -sense if law.reverses else sense)


def front_face(before: Sequence[Interface], sense: int) -> records.FrontFace:
    """Return the face in front of a net as numbers; before: this face, or nothing."""
    everywhere = {"front_x": math.inf, "front_y": math.inf, "front_r2": math.inf}
    numbers = floats(curvature=0.0, conic_constant=0.0, eta=1.0, **everywhere)
    missed = reflected = turned = Status.MISSED_FRONT
    for face in before:
        x, y, r2 = face.outline.limits
        numbers = floats(
            curvature=sense * face.surface.curvature, conic_constant=face.surface.conic_constant, eta=face.law.eta,
            front_x=x, front_y=y, front_r2=r2,
        )  # fmt: skip
        missed, reflected, turned = face.status_if_missed, face.law.status_if_blocked, Status.TURNED_BACK
    fates = floats(missed_front=missed, missed_back=missed, reflected=reflected, turned=turned)
    return records.FrontFace(present=len(before), rules=rules(), fates=Fates(**fates), **numbers)


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
            irradiance, slope_x, slope_y = (net.ravel() for net in nets)
            table = LightTable(
                m=side, n=side, x=-window.width / 2, y=-window.height / 2, per_x=(side - 1) / window.width,
                per_y=(side - 1) / window.height, irradiance=irradiance, slope_x=slope_x, slope_y=slope_y,
            )  # fmt: skip
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
        numbers = dict.fromkeys(records.TiltedScreen._fields[:-1], 0.0) | {"n_z": float(before)}
        return records.TiltedScreen(**numbers, goniometer=receiver.goniometer)
    assert receiver.axes is not None  # no kernel traces to other receivers
    (x_x, x_y, x_z), (y_x, y_y, y_z), normal = ((*axis[:2], before * axis[2]) for axis in receiver.axes)
    (x, y, _), (n_x, n_y, n_z) = receiver.middle, (behind * n for n in normal)
    numbers = floats(x=x, y=y, n_x=n_x, n_y=n_y, n_z=n_z, x_x=x_x, x_y=x_y, x_z=x_z, y_x=y_x, y_y=y_y, y_z=y_z)
    return records.TiltedScreen(**numbers, goniometer=0)


def cells(window: Rectangle, n: int, seed: int) -> RayCells:
    """Return n x n cells of a window centred on the axis."""
    width, height = window.width / n, window.height / n
    key, *mixing = map(
        np.uint64, (sampling.hash_seed(seed), sampling.SPLITMIX_INCREMENT, sampling.MIX_1, sampling.MIX_2)
    )
    return RayCells(n, key, width, height, window.width / 2, window.height / 2, *mixing)


def pixels(screen: Screen) -> Pixels:
    """Return the screen as numbers."""
    (left, right), (bottom, top), (per_x, per_y) = screen.x, screen.y, screen.per_unit
    return Pixels(**floats(left=left, right=right, bottom=bottom, top=top, per_x=per_x, per_y=per_y))
