"""The reachable part of a target, which a design can light, computed before the design.

Each point of the face reaches a part of the target that is known in closed form (optics/trace/reach.py).  A pixel is
reachable if each of its corners is reached by some point of the face.  A design may not give it as much light as it
asks for, if few points reach it or if these are needed elsewhere; but what a face can light is not called dark.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor

from bstcad.optics.lens.interfaces import Law
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen, averaged
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces.charts import HEIGHTS
from bstcad.optics.trace.reach import MAX_EXIT_ANGLE, reach_margin
from bstcad.optics.trace.unfolding import image_from_last_net
from bstcad.tailoring import slope_map
from bstcad.tailoring.slope_map import FaceGrid
from bstcad.transport.mapping import Points

FACE_CELLS, FACE_STRIDE = 49, 3  # cells per side of the face; every third cell per axis is tried for all aims
FEW_POINTS, FEW_AIMS = 12, 8  # every 12th cell per axis, and every 8th lit aim, are tried first
MAX_AIMS = 64  # largest number of pixels along the longer side of the picture for which the reach is computed


class Reach(NamedTuple):
    """Reach of the light of a lens."""

    part: (
        np.ndarray | None
    )  # True for each pixel that some light reaches, (rows, columns); None: all of the lit picture
    astray: float  # fraction of the light on the face that reaches no lit point of the picture
    beyond: float  # smallest angle (rad) from the centre of a dome to such light, to the axis; π / 2: there is none


@torch.no_grad()
def reach_of(source: Emitter, lens: Lens, goal: Goal, grazing: float = MAX_EXIT_ANGLE) -> Reach:
    """Return what the light at the last freeform face can reach.

    lens: the blank, with its final front.  grazing: largest angle to the normal at which light may leave (rad).
    """
    screen, small = goal.screen, resample(goal)
    corners = slope_map.pixel_corners(small.screen)
    grid = slope_map.face_grid(source, lens, slope_map.lit_window(source, lens, FACE_CELLS), FACE_CELLS)
    receiver, law = image_from_last_net(lens, screen.receiver), lens.last_tailored.law
    lit = slope_map.lit_corners(small.picture)
    if _reaches_all(grid, corners, lit, receiver=receiver, law=law, grazing=grazing):
        return Reach(None, 0.0, math.pi / 2)
    margin = reach_from_each(grid, corners, receiver, law, grazing=grazing)
    ordered = reach_in_order(grid, corners, lit, receiver=receiver, law=law, grazing=grazing)
    found = _inside(torch.maximum(margin.amax(0), ordered), screen, small.screen)
    lost = margin[:, torch.from_numpy(lit)].amax(1) < 0
    some = grid.density[::FACE_STRIDE, ::FACE_STRIDE].cpu()
    position = grid.at_face.position[:, ::FACE_STRIDE, ::FACE_STRIDE][:, some > 0].cpu().double()
    astray = float(some[some > 0][lost].sum() / some.sum())
    beyond = math.pi / 2
    if grid.at_face.chart is not HEIGHTS and bool(lost.any()):
        cosines = position[2] / torch.sqrt((position * position).sum(0))
        beyond = math.acos(float(cosines[lost].max()))
    return Reach(found if (goal.picture[~found] > 0).any() else None, astray, beyond)


def resample(goal: Goal, pixels: int = MAX_AIMS) -> Goal:
    """Return the goal with at most `pixels` pixels on its longer side, each the mean of old ones; the sum decreases."""
    screen, picture = goal.screen, goal.picture
    shrunk = max(1.0, max(screen.shape) / pixels)
    rows, columns = (max(round(n / shrunk), 1) for n in screen.shape)
    small = averaged(picture, columns, rows)
    return replace(
        goal,
        screen=replace(screen, pixels=(columns, rows)),
        picture=small,
        reachable=None,
        whole=None,
        cell_picture=None,
    )


def _reaches_all(grid: FaceGrid, aims: Points, lit: np.ndarray, receiver: Receiver, law: Law, grazing: float) -> bool:
    """Return True if few points of the face reach all aims, and all points some of few lit aims.

    Then the whole picture is reachable and no light is astray, found from a tenth of the pairs of points and aims.
    """
    if not reach_from_each(grid, aims, receiver, law, grazing=grazing, stride=FEW_POINTS).amax(0).ge(0).all():
        return False
    few = [p[lit][None, ::FEW_AIMS] for p in aims]
    return bool(reach_from_each(grid, few, receiver, law, grazing=grazing).amax((1, 2)).ge(0).all())


def reach_from_each(
    grid: FaceGrid, aims: Sequence[np.ndarray], receiver: Receiver, law: Law, grazing: float, stride: int = FACE_STRIDE
) -> Tensor:
    """Return `trace.reach.reach_margin` from every `stride`-th lit point of the face, (points, rows, columns).

    aims: x and y of the aims, in the receiver's unit, (rows, columns) each.  grazing: see `reachable`.
    """
    t, some = torch.from_numpy(np.stack(aims)), grid.density[::stride, ::stride] > 0
    position, direction = (
        v[:, ::stride, ::stride][:, some][..., None, None].expand(-1, -1, *t.shape[1:]).double()
        for v in (grid.at_face.position, grid.at_face.direction)
    )
    rays = replace(grid.at_face, position=position, direction=direction)
    return reach_margin(rays, t[:, None].expand(-1, *position.shape[1:]), receiver, law=law, grazing=grazing)


def reach_in_order(
    grid: FaceGrid, aims: Points, lit: np.ndarray, receiver: Receiver, law: Law, grazing: float
) -> Tensor:
    """Return the margin (…) of each aim from the point of the face with the same relative position in its lit window.

    A target close to the lens is reached from the part of the face in front of it, which may lie between the points of
    `reach_from_each`.  lit: aims (…) whose rectangle corresponds to the window.  Without light there: -1.
    """
    sizes = grid.window.width, grid.window.height
    places = [
        np.clip((p - p[lit].min()) / np.ptp(p[lit]) - 0.5, -0.5, 0.5) * size
        for p, size in zip(aims, sizes, strict=True)
    ]
    b = places[0], places[1]
    margin = reach_margin(
        slope_map.rays_at(grid, b), torch.from_numpy(np.stack(aims)), receiver, law=law, grazing=grazing
    )
    [shone] = slope_map.interpolate(grid, (grid.density > 0)[None], b)
    return torch.where(shone > 0.99, margin, -torch.ones_like(margin))


def _inside(corners: Tensor, screen: Screen, few: Screen) -> np.ndarray:
    """Return True (rows, columns) for pixels of `screen` with values >= 0 at all corners; corners: those of `few`."""
    where = np.meshgrid(
        *(np.linspace(0, a, n + 1) for a, n in ((few.columns, screen.columns), (few.rows, screen.rows))), indexing="ij"
    )
    positive = map_coordinates(corners.numpy(), where, order=1) >= 0
    return (positive[1:, 1:] & positive[1:, :-1] & positive[:-1, 1:] & positive[:-1, :-1]).T[::-1]  # row 0 is y max
