"""The reachable part of a target, which a design can light, computed before the design.

Each point of the face reaches a part of the target that is known in closed form (optics/reach.py).  But the transport
map decides which point of the face lights which point of the target (aim), and some points cannot reach their aim.  So
there are three checks, each more expensive and only made if the previous check is inconclusive:

1. Every lit point of the face reaches all of the lit target: then any map is feasible.
2. Each aim is reached from the point of the face with the same relative position in the lit window as the aim has in
   the lit target: rays of transport maps do not cross, so that these maps nearly preserve relative positions.
3. Coarse maps are computed, each for the part of the target that the previous map could light.  The first map is for
   the part that at least one point of the face reaches.
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

from bstcad.optics.emitters import Emitter
from bstcad.optics.goal import Goal
from bstcad.optics.interfaces import Law
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.reach import MAX_EXIT_ANGLE, reach_margin
from bstcad.optics.receivers import Receiver
from bstcad.optics.unfolding import image_from_last_net
from bstcad.scene.target import average
from bstcad.tailoring import slope_map
from bstcad.tailoring.slope_fit import Fit
from bstcad.tailoring.slope_map import FaceGrid
from bstcad.transport.mapping import Points, Solver

FACE_CELLS, FACE_STRIDE = 33, 4  # cells per side of the face; every 4th cell per axis is tried for all aims
BOX_AIMS = 5  # aims per side of the first check, in the rectangle around the lit target
MAX_AIMS = 64  # largest number of pixels along the longer side of the picture for which the reach is computed
MAP_NET, MAP_CELLS, MAP_ITERATIONS = 33, 64, 40  # control points and cells per side, and iterations, of the coarse maps
MAX_ROUNDS = 6  # largest number of coarse maps
SETTLED_FRACTION = 1e-3  # change of the reachable light at which the rounds end, as a fraction of all light
COARSE_FIT = Fit(bending=1e-2, steps=40, degree=3)  # fit of the face to a coarse map


@torch.no_grad()
def reachable(source: Emitter, lens: Lens, goal: Goal, grazing: float = MAX_EXIT_ANGLE) -> np.ndarray | None:
    """Return True for each pixel that a design can light, (rows, columns); None if it can light all of the picture.

    lens: the blank, with its final front.  grazing: largest angle to the normal at which light may leave (rad).
    """
    screen, picture, small = goal.receiver, goal.picture, resample(goal)
    few, corners, solver = small.receiver, slope_map.pixel_corners(small.receiver), Solver(MAP_ITERATIONS)
    grid = slope_map.face_grid(source, lens, slope_map.lit_window(source, lens, FACE_CELLS), FACE_CELLS)
    lit_x, lit_y = (corner[slope_map.lit_corners(small.picture)] for corner in corners)
    lit = lit_x, lit_y
    around = np.meshgrid(*(np.linspace(aims.min(), aims.max(), BOX_AIMS) for aims in lit), indexing="ij")
    plane, law = image_from_last_net(lens, screen.plane), lens.last_freeform.law
    if float(reach_from_each(grid, around, plane, law, grazing=grazing).min()) >= 0:
        return None
    ordered, aims = slope_map.rays_at(grid, same_order(grid, lit)), torch.from_numpy(np.stack(lit))
    if float(reach_margin(ordered, aims, plane, law=law, grazing=grazing).min()) >= 0:
        return None
    found = _inside(reach_from_each(grid, corners, plane, law, grazing=grazing).amax(0), screen, few)
    slopes, lens = None, lens.refined(MAP_NET)
    for number in range(MAX_ROUNDS):
        if not picture[found].sum() > 0:
            break
        window, part = slope_map.lit_window(source, lens), resample(goal.restricted(found))
        grid = slope_map.square_grid(source, lens, window, MAP_CELLS)
        slopes = slope_map.slope_map(lens, grid, part, slopes, solver=solver)
        grid = slope_map.face_grid(source, lens, window, 2 * MAP_NET)
        aims, rays = torch.from_numpy(np.stack(corners)), slope_map.rays_at(grid, slopes.face_points)
        before, found = found, _inside(reach_margin(rays, aims, plane, law=law, grazing=grazing), screen, few)
        if number and picture[before ^ found].sum() <= SETTLED_FRACTION:
            break
        lens = slope_map.fit_to_map(lens, slopes, grid, COARSE_FIT)
    return found if (picture[~found] > 0).any() else None


class DomeReach(NamedTuple):
    """Reach of the light of a dome."""

    part: (
        np.ndarray | None
    )  # True for each pixel that some light reaches, (rows, columns); None: all of the lit picture
    astray: float  # fraction of the light on the face that reaches no lit point of the picture
    beyond: float  # smallest angle (rad) from the axis, seen from the centre, of such light; π / 2: there is none


@torch.no_grad()
def reachable_by_dome(source: Emitter, lens: Lens, goal: Goal, grazing: float = MAX_EXIT_ANGLE) -> DomeReach:
    """Return what each point of a dome can reach; `lens` and `grazing`: as for `reachable`.

    Light far from the axis cannot return to it, so that some light may reach no lit point at all.  No map is computed:
    the part is that of the first of its rounds.
    """
    screen, small = goal.receiver, resample(goal)
    corners = slope_map.pixel_corners(small.receiver)
    grid = slope_map.face_grid(source, lens, slope_map.lit_window(source, lens, FACE_CELLS), FACE_CELLS)
    plane, law = image_from_last_net(lens, screen.plane), lens.last_freeform.law
    margin = reach_from_each(grid, corners, plane, law, grazing=grazing)
    found = _inside(margin.amax(0), screen, small.receiver)
    lit = torch.from_numpy(slope_map.lit_corners(small.picture))
    lost = margin[:, lit].amax(1) < 0
    some = grid.density[::FACE_STRIDE, ::FACE_STRIDE].cpu()
    position = grid.at_face.position[:, ::FACE_STRIDE, ::FACE_STRIDE][:, some > 0].cpu().double()
    cosines = position[2] / torch.sqrt((position * position).sum(0))
    astray = float(some[some > 0][lost].sum() / some.sum())
    beyond = math.acos(float(cosines[lost].max())) if bool(lost.any()) else math.pi / 2
    return DomeReach(found if (goal.picture[~found] > 0).any() else None, astray, beyond)


def resample(goal: Goal, pixels: int = MAX_AIMS) -> Goal:
    """Return the goal with at most `pixels` pixels on its longer side, each the mean of old ones; the sum decreases."""
    screen, picture = goal.receiver, goal.picture
    shrunk = max(1.0, max(screen.shape) / pixels)
    rows, columns = (max(round(n / shrunk), 1) for n in screen.shape)
    size = screen.columns, screen.rows
    small = average(lambda b: picture[b[1] : b[3], b[0] : b[2]], size, (0.0, 0.0, *size), (columns, rows))
    return replace(
        goal, receiver=replace(screen, pixels=(columns, rows)), picture=small, reachable=None, whole=None, draw=None
    )


def reach_from_each(grid: FaceGrid, aims: Sequence[np.ndarray], plane: Receiver, law: Law, grazing: float) -> Tensor:
    """Return `optics.reach.reach_margin` from every FACE_STRIDE-th lit point of the face to each aim, (points, …).

    aims: x and y of the aims, in the receiver's unit, of one shape (…).  grazing: see `reachable`.
    """
    t, some = torch.from_numpy(np.stack(aims)), grid.density[::FACE_STRIDE, ::FACE_STRIDE] > 0
    position, direction = (
        v[:, ::FACE_STRIDE, ::FACE_STRIDE][:, some][..., None, None].expand(-1, -1, *t.shape[1:]).double()
        for v in (grid.at_face.position, grid.at_face.direction)
    )
    rays = replace(grid.at_face, position=position, direction=direction)
    return reach_margin(rays, t[:, None].expand(-1, *position.shape[1:]), plane, law=law, grazing=grazing)


def same_order(grid: FaceGrid, aims: Points) -> Points:
    """Return the points (mm) of the lit window at the relative positions of the aims (x, y) in their rectangle."""
    x, y = ((along - along.min()) / (along.max() - along.min()) - 0.5 for along in aims)
    return grid.window.width * x, grid.window.height * y


def _inside(corners: Tensor, screen: Screen, few: Screen) -> np.ndarray:
    """Return True (rows, columns) for pixels of `screen` with values >= 0 at all corners; corners: those of `few`."""
    where = np.meshgrid(
        *(np.linspace(0, a, n + 1) for a, n in ((few.columns, screen.columns), (few.rows, screen.rows))), indexing="ij"
    )
    positive = map_coordinates(corners.numpy(), where, order=1) >= 0
    return (positive[1:, 1:] & positive[1:, :-1] & positive[:-1, 1:] & positive[:-1, :-1]).T[::-1]  # row 0 is y max
