"""The part of a target that a design can light, found before it.

Where a place of the face can send its light is known in closed form (optics/reach.py).  Which place sends which light
is for the transport map to say, and a map may ask more of a place than the best place for an aim would have to do.  So
three questions are asked, each dearer than the one before and only where that leaves doubts:

1. Can every lit place of the face light every lit part of the target?  Then no map asks too much.
2. Can the place do it that lies in the face as the aim lies in the target?  Maps do not cross their light, and come
   near to this one.
3. What remains when coarse maps are made, each for that part of the target which the map before could light, beginning
   with what any place can light?
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor

from bstcad.optics.emitters import Emitter
from bstcad.optics.goal import Goal
from bstcad.optics.interfaces import Law
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.reach import GRAZING, room
from bstcad.optics.receivers import Receiver
from bstcad.optics.unfolding import seen_from_last_net
from bstcad.scene.target import average
from bstcad.tailoring.slope_fit import Fit
from bstcad.tailoring.slope_map import (
    FaceGrid,
    corners_of,
    face_grid,
    lit_window,
    pixel_corners,
    rays_at,
    slope_map,
    sloped,
)

PLACES, EACH = 33, 4  # cells a side of the face whose rays are known; each such cell's light is sent to all aims
BOX = 5  # aims a side of the rectangle around all that is lit, to which all places send light first
AIMS = 64  # pixels of the longer side of the target, at most, at whose corners the reach is looked at
NET, CELLS, STEPS = 33, 64, 40  # a side of the coarse maps; iterations of each
ROUNDS = 6  # of coarse maps, at most
STEADY = 1e-3  # of the light: a round that changes less is the last
COARSE = Fit(bending=1e-2, steps=40, degree=3)


@torch.no_grad()
def reachable(source: Emitter, lens: Lens, goal: Goal, grazing: float = GRAZING) -> np.ndarray | None:
    """(rows, columns) True in the pixels that a design can light; None: all that the picture wants to be lit.

    lens: the blank, with the front that it will have.
    """
    screen, picture, shown = goal.receiver, goal.picture, coarse(goal)
    few, small = shown.receiver, shown.picture
    grid = face_grid(source, lens, lit_window(source, lens, PLACES), PLACES)
    lit = [corner[corners_of(small)] for corner in pixel_corners(few)]
    around = np.meshgrid(*(np.linspace(aims.min(), aims.max(), BOX) for aims in lit), indexing="ij")
    plane, law = seen_from_last_net(lens, screen.plane), lens.last_freeform.law
    if float(from_each(grid, around, plane, law, grazing=grazing).min()) >= 0:
        return None
    ordered, aims = rays_at(grid, in_order(grid, lit)), torch.from_numpy(np.stack(lit))
    if float(room(ordered, aims, plane, law=law, grazing=grazing).min()) >= 0:
        return None
    found = _inside(from_each(grid, pixel_corners(few), plane, law, grazing=grazing).amax(0), screen, few)
    wanted, lens = None, lens.refined(NET)
    for turn in range(ROUNDS):
        if not picture[found].sum() > 0:
            break
        window = lit_window(source, lens)
        part = coarse(goal.restricted(found)).picture
        wanted = slope_map(source, lens, window, part, screen=few, n=CELLS, previous=wanted, iterations=STEPS)
        grid = face_grid(source, lens, window, 2 * NET)
        aims, rays = torch.from_numpy(np.stack(pixel_corners(few))), rays_at(grid, wanted.places)
        before, found = found, _inside(room(rays, aims, plane, law=law, grazing=grazing), screen, few)
        if turn and picture[before ^ found].sum() <= STEADY:
            break
        lens = sloped(lens, wanted, grid, COARSE, unlit=0.0)
    return found if (picture[~found] > 0).any() else None


def coarse(goal: Goal, most: int = AIMS) -> Goal:
    """The goal with at most so many pixels along the longer side, each of the mean light of those it holds."""
    screen, picture = goal.receiver, goal.picture
    shrunk = max(1.0, max(screen.shape) / most)
    rows, columns = (max(round(n / shrunk), 1) for n in screen.shape)
    whole = (0.0, 0.0, screen.columns, screen.rows)
    small = average(lambda box: picture[box[1] : box[3], box[0] : box[2]], whole[2:], whole, (columns, rows))
    return replace(goal, receiver=replace(screen, pixels=(columns, rows)), picture=small, reachable=None, whole=None)


def from_each(grid: FaceGrid, aims: Sequence[np.ndarray], plane: Receiver, law: Law, grazing: float) -> Tensor:
    """(places, …) the room (optics.reach.room) of lit places of the face to send light to aims, x and y (…) mm."""
    t, some = torch.from_numpy(np.stack(aims)), grid.density[::EACH, ::EACH] > 0
    position, direction = (
        v[:, ::EACH, ::EACH][:, some][..., None, None].expand(-1, -1, *t.shape[1:]).double()
        for v in (grid.at_face.position, grid.at_face.direction)
    )
    rays = replace(grid.at_face, position=position, direction=direction)
    return room(rays, t[:, None].expand(-1, *position.shape[1:]), plane, law=law, grazing=grazing)


def in_order(grid: FaceGrid, aims: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Places (mm) that lie in the lit window of the face as aims, x and y (mm), lie in the rectangle around these."""
    ends = [(along.min(), along.max()) for along in aims]
    sizes = grid.window.width, grid.window.height
    return tuple(
        size * ((along - low) / (high - low) - 0.5) for along, (low, high), size in zip(aims, ends, sizes, strict=True)
    )


def _inside(corners: Tensor, screen: Screen, few: Screen) -> np.ndarray:
    """(rows, columns) the screen's pixels at all of whose corners a function of the corners of `few` is positive."""
    where = np.meshgrid(
        *(np.linspace(0, a, n + 1) for a, n in ((few.columns, screen.columns), (few.rows, screen.rows))), indexing="ij"
    )
    positive = map_coordinates(corners.numpy(), where, order=1) >= 0
    return (positive[1:, 1:] & positive[1:, :-1] & positive[:-1, 1:] & positive[:-1, :-1]).T[::-1]  # row 0 is y max
