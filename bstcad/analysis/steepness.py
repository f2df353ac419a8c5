"""How steep a tailored face has to be for the light of a target: more than a height over a plane carries, perhaps.

A ray that goes along d (index there over that behind the face η) and shall go on along d' needs the normal η d - d'.  A
face z(x, y) stands at less than 90 degrees, and tailoring makes it no steeper than LIMIT: light that needs more is sent
elsewhere.  Wide light is what needs it: 60 degrees in PMMA, sent straight on, would need a face that overhangs.  Light
that no face turns so far, whatever its slope, is another matter and left out here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from bstcad.optics.emitters import Emitter
from bstcad.optics.interfaces import intersect
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.reach import normal_towards
from bstcad.optics.trace import across
from bstcad.optics.tubes import rays_to

LIMIT = 70.0  # degrees; slope_fit.STEEPEST
MOST = 65  # points a side that are looked at


@dataclass(frozen=True)
class Steepness:
    """The slope that the light of a target needs of the last of the tailored faces."""

    share: float  # of the target's light needs more than LIMIT
    steepest: float  # degrees; above 90 the face would overhang


@torch.no_grad()
def needed(
    source: Emitter, lens: Lens, screen: Screen, picture: np.ndarray, *, x: np.ndarray, y: np.ndarray,
    places: np.ndarray, at_back: bool = True,
) -> Steepness:  # fmt: skip
    """Return the steepness by the places (c, r, 2) (mm) on the face through which light goes to points of the screen.

    x (c,), y (r,): these points (mm).  screen: where light behind the face sees it (unfolding.imaged).
    picture: (rows, columns) the irradiance that is wanted there, row 0 = y max.  at_back False: the places lie on the
    plane of the first vertex.
    """
    i, j = (np.unique(np.linspace(0, n - 1, min(n, MOST)).round().astype(int)) for n in (len(x), len(y)))
    x, y, places = x[i], y[j], places[np.ix_(i, j)]
    number, lens = lens.freeform[-1], lens.plain()
    p, q = (torch.from_numpy(np.ascontiguousarray(places[..., k], dtype=float)) for k in (0, 1))
    face = lens.interfaces[number]
    if at_back:
        _, _, at = rays_to(source, lens, p, q, number=number)
    else:
        before = lens.unbounded().interfaces[:number]
        coming = across(source.rays(p, q, lens.entrance.z, 1.0), before)
        at, _, _ = intersect(face.surface, coming, face.outline, face.status_if_missed)
    aim = torch.stack(torch.meshgrid(torch.from_numpy(x), torch.from_numpy(y), indexing="ij"))
    out, eta = screen.plane.way_to(at, aim), face.law.eta
    out = out / torch.sqrt((out * out).sum(0))
    normal = normal_towards(at, out, face.law)
    angle = torch.rad2deg(torch.atan2(torch.hypot(normal[0], normal[1]), normal[2]))
    most = -1.0 if face.law.reverses else min(eta, 1 / eta)  # the cosine; no face turns it further
    turned = (at.direction * out).sum(0) > most
    flux = torch.where(at.alive & turned, torch.from_numpy(_at_corners(picture, screen, x, y)), torch.zeros_like(angle))
    if not float(flux.sum()) > 0:
        return Steepness(0.0, 0.0)
    steep = flux * (angle > LIMIT)
    return Steepness(float(steep.sum() / flux.sum()), float(angle[flux > 0].max()))


def _at_corners(picture: np.ndarray, screen: Screen, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(c, r): the least of the pixels around each of these pixel corners: zero on the rim of the light."""
    around = np.pad(picture[::-1].T, 1)  # x first, y upwards
    least = np.minimum.reduce([around[1:, 1:], around[1:, :-1], around[:-1, 1:], around[:-1, :-1]])
    per_x, per_y = screen.per_unit
    i, j = np.rint((x - screen.x[0]) * per_x).astype(int), np.rint((y - screen.y[0]) * per_y).astype(int)
    return least[np.ix_(i, j)]
