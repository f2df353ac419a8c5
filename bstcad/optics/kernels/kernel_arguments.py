"""How the numbers that a fused kernel takes (records.py) follow from lens, light, cells and screen.

The constants of the plain form are among them: numba's cache looks at a kernel's own file only, and what that takes
from another file would stay as it was when the kernel was compiled.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch

from bstcad.optics import interfaces, rays, sampling, surfaces
from bstcad.optics.bspline import halfway, interpolated
from bstcad.optics.emitters import Emitter
from bstcad.optics.interfaces import Interface
from bstcad.optics.irradiance import Screen
from bstcad.optics.kernels import records
from bstcad.optics.kernels.records import Beam, Cells, Faces, Fates, Losses, Pixels, Rules, Table, Tilted, floats
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


def rules() -> Rules:
    """The constants of the plain form, as they are now."""
    steps = (interfaces.NEWTON_STEPS, interfaces.APPROACH_STEPS)
    least = (interfaces.LEVEL, interfaces.FLATTEST, interfaces.ALONG, interfaces.SKIMMING)
    return Rules(*floats([*steps, *least, surfaces.EQUATOR, rays.MIN_AXIAL_COSINE]))


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


def losses(lens: Lens) -> Losses:
    """The lens's losses as numbers, by the plain forms of losses.py."""
    if lens.losses is None:
        return records.NO_LOSSES
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
    mixing = sampling.SPLITMIX_INCREMENT, sampling.MIX_1, sampling.MIX_2
    key, *mixing = map(np.uint64, (sampling.hash_seed(seed), *mixing))
    return Cells(n, key, width, height, window.width / 2, window.height / 2, *mixing)


def pixels(screen: Screen) -> Pixels:
    """The screen as numbers."""
    return Pixels(*floats([*screen.x, *screen.y, *screen.per_unit]))
