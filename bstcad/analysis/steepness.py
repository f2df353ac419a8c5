"""Slope that a tailored face needs for the light of a target; it may exceed the slope of any surface z(x, y).

To refract a ray from direction d to d', a face of relative index η = n / n' needs a normal along η d - d'.  A face z(x,
y) is less steep than 90 degrees, and tailoring makes it no steeper than MAX_SLOPE_DEG; light that needs a steeper face
misses its aim.  This concerns wide beams: light at 60 degrees to the axis in PMMA that shall leave at 40 degrees or
less needs an overhanging face.  Light that no slope deflects far enough is not counted here (see
optics/trace/reach.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from bstcad.optics.lens.interfaces import intersect
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.trace.reach import normal_towards
from bstcad.optics.trace.trace import across
from bstcad.optics.trace.tubes import rays_to
from bstcad.optics.trace.unfolding import image_screen

MAX_SLOPE_DEG = 70.0  # largest slope angle that tailoring makes (degrees); its tangent is optics.trace.reach.MAX_SLOPE
MAX_POINTS_PER_SIDE = 65  # largest number of points of the target, per side, for which the slope is computed


@dataclass(frozen=True)
class Steepness:
    """Slope that the last tailored face needs for the light of a target."""

    share: float  # fraction of the target's light that needs more than MAX_SLOPE_DEG
    steepest: float  # largest slope angle needed (degrees); above 90 the face would overhang


@torch.no_grad()
def needed_steepness(
    source: Emitter, lens: Lens, goal: Goal, x: np.ndarray, y: np.ndarray, origins: np.ndarray, at_back: bool = True
) -> Steepness:
    """Return the steepness for light through the points `origins` to the points x, y of the goal.

    x (c,), y (r,): coordinates on the receiver, in its unit.  origins: (c, r, 2), x and y (mm) of points of the last
    tailored face or, if not at_back, of the plane through the first vertex.
    """
    screen, number, lens = image_screen(lens, goal.screen), lens.tailored_numbers[-1], lens.plain()
    i, j = (np.unique(np.linspace(0, n - 1, min(n, MAX_POINTS_PER_SIDE)).round().astype(int)) for n in (len(x), len(y)))
    x, y, origins = x[i], y[j], origins[np.ix_(i, j)]
    p, q = (torch.from_numpy(np.ascontiguousarray(origins[..., k], dtype=float)) for k in (0, 1))
    face = lens.interfaces[number]
    if at_back:
        _, _, at = rays_to(source, lens, p, q, number=number)
    else:
        before = lens.unbounded().interfaces[:number]
        coming = across(source.rays_through(p, q, lens.entrance.z, 1.0), before)
        at, _ = intersect(face.surface, coming, face.outline, face.status_if_missed)
    aim = torch.stack(torch.meshgrid(torch.from_numpy(x), torch.from_numpy(y), indexing="ij"))
    out, eta = screen.receiver.vector_to(at, aim), face.law.eta
    out = out / torch.sqrt((out * out).sum(0))
    normal = at.chart.local(at.position, normal_towards(at, out, face.law))
    angle = torch.rad2deg(torch.atan2(torch.hypot(normal[0], normal[1]), normal[2]))
    limit = -1.0 if face.law.reverses else min(eta, 1 / eta)  # cosine of the largest deflection
    possible = (at.direction * out).sum(0) > limit
    wanted = torch.from_numpy(_at_corners(goal.picture, screen, x, y))
    flux = torch.where(at.alive & possible, wanted, torch.zeros_like(angle))
    if not float(flux.sum()) > 0:
        return Steepness(0.0, 0.0)
    steep = flux * (angle > MAX_SLOPE_DEG)
    return Steepness(float(steep.sum() / flux.sum()), float(angle[flux > 0].max()))


def _at_corners(picture: np.ndarray, screen: Screen, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return, as (c, r), the least of the four pixels of a picture around each corner x, y: zero on the light's rim."""
    around = np.pad(picture[::-1].T, 1)  # x first, y upwards
    least = np.minimum.reduce([around[1:, 1:], around[1:, :-1], around[:-1, 1:], around[:-1, :-1]])
    per_x, per_y = screen.per_unit
    i, j = np.rint((x - screen.x[0]) * per_x).astype(int), np.rint((y - screen.y[0]) * per_y).astype(int)
    return least[np.ix_(i, j)]
