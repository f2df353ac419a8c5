"""A part cut along a plane through its axis: the lens between its faces, walls with draft and bevel, flange and holes.

Polygons in mm, z and the place along the cut, in the frame of the part's file.  Along the middle of a straight side and
on a circle draft leans walls within the plane of the cut, so that two dimensions say all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import sag
from bstcad.scene.mount import Box, Flange, Mount, Round

POINTS = 401  # along each face
BARE = Mount()

Pair = tuple[float, float]  # z, place along the cut (mm)


@dataclass(frozen=True, eq=False)
class Profile:
    """What a cut goes through, in mm."""

    bodies: tuple[np.ndarray, ...]  # (n, 2) each: that of the lens, then what holes part off it
    back: Pair  # z of its ends, at the lower and the upper end of the cut
    front: Pair
    front_ends: Pair  # where the front ends along the cut
    behind: tuple[np.ndarray, ...] = ()  # (2, 2) each: edges of the flange's planes, seen behind its holes

    @property
    def ends(self) -> tuple[Pair, Pair]:
        """(least and largest z, least and largest place along the cut) of everything."""
        every = np.concatenate(self.bodies)
        (low, low_u), (high, high_u) = every.min(0).tolist(), every.max(0).tolist()
        return (low, high), (low_u, high_u)


def profile(lens: Lens, mount: Mount | None, upright: bool, origin: float = 0.0) -> Profile:
    """Of a lens in its mount (None: bare); upright: along y at x = 0, else along x at y = 0.

    origin: z in the scene's frame (mm) that is 0 in the part's file.  The lens and its mount have to fit.
    """
    mount = mount or BARE
    rim = mount.rim_of(lens.outline)

    def height(surface, places):
        z = sag(surface, 0.0 * places, places) if upright else sag(surface, places, 0.0 * places)
        return z - origin

    half = half_extent(rim)[upright]
    along = np.linspace(-half, half, POINTS)
    back = height(lens.back, along)
    start = mount.top(lens) - origin if mount.draft or mount.flange else math.inf
    sides = [
        _side(lambda r, s=s: float(height(lens.front, np.float64(s * r))), float(back[k]), half,
              _beside(mount.flange, half, s, upright, origin), mount, start)
        for s, k in ((-1, 0), (1, -1))
    ]  # fmt: skip
    (left, left_off), (right, right_off) = sides
    ends = -left[-1][1], right[-1][1]
    places = np.linspace(*ends, POINTS)
    front = height(lens.front, places)
    body = np.concatenate([
        np.stack([back, along], 1), np.array(right[1:-1]).reshape(-1, 2), np.stack([front, places], 1)[::-1],
        (np.array(left[1:-1]).reshape(-1, 2) * (1, -1))[::-1],
    ])  # fmt: skip
    off = [np.array(each) for each in right_off] + [np.array(each) * (1, -1) for each in left_off]
    behind = ()
    if (beside := _beside(mount.flange, half, 1, upright, origin)) is not None:
        low, high, pieces = beside
        ends_of = [(z, max(u for at, u in pieces[-1] if at == z)) for z in (low, high)]
        behind = tuple(np.array([(z, s * half), (z, s * end)]) for z, end in ends_of for s in (-1, 1))
    return Profile((body, *off), (float(back[0]), float(back[-1])), (float(front[0]), float(front[-1])), ends, behind)


def half_extent(shape: Round | Box) -> Pair:
    """Half of how far it reaches along x and along y (mm)."""
    if shape.shape == "circle":
        return shape.diameter / 2, shape.diameter / 2
    return shape.width / 2, shape.height / 2


Beside = tuple[float, float, list[list[Pair]]]  # z of the flange's planes, its pieces from the lens outwards


def _beside(flange: Flange | None, half: float, sense: int, upright: bool, origin: float) -> Beside | None:
    """What of a flange lies beside the rim, as chains (z, distance from the axis) from its upper plane to its lower."""
    if flange is None:
        return None
    low, high, lean = flange.z - origin, flange.z + flange.thickness - origin, math.tan(math.radians(flange.draft))
    reach, b = half_extent(flange.outline)[upright], flange.bevel
    foot, head = reach - lean * b, reach - lean * (flange.thickness - b)  # where the leaning wall begins and ends
    wall = [(high, head - b), (high - b, head), (low + b, foot), (low, foot - b)]
    cuts = []
    for x, y, diameter in flange.all_holes():
        along, off = (y, x) if upright else (x, y)
        if abs(off) < diameter / 2 and sense * along > half:
            chord = math.sqrt(diameter**2 / 4 - off**2)
            cuts.append((sense * along - chord, sense * along + chord))
    edges = [end for cut in sorted(cuts) for end in cut]
    pieces = [[(high, edges[0]), (low, edges[0])]] if edges else [wall]
    for inner, outer in zip(edges[1::2], edges[2::2], strict=False):
        pieces.append([(high, inner), (high, outer), (low, outer), (low, inner)])
    if edges:
        pieces.append([(high, edges[-1]), *wall, (low, edges[-1])])
    return low, high, pieces


def _side(
    front: Callable[[float], float], back: float, half: float, beside: Beside | None, mount: Mount, parting: float
) -> tuple[list[Pair], list[list[Pair]]]:
    """(the lens's edge from back to front, flange included; the pieces of the flange that holes part off)."""
    chain, off = [(back, half)], []
    if beside is not None:
        low, high, (first, *off) = beside
        chain += [(high, half), *first, (low, half)]
    start = min(chain[-1][0], parting)
    lean = math.tan(math.radians(mount.draft))
    if not (mount.draft or mount.bevel):
        return [*chain, (front(half), half)], off
    depth = _meeting(front, start, half, lean) - mount.bevel
    upper = start - depth, half - lean * depth
    chain += [(start, half), upper]
    if mount.bevel:
        more = _meeting(front, *upper, 1.0)
        chain.append((upper[0] - more, upper[1] - more))
    return chain, off


def _meeting(front: Callable[[float], float], z: float, place: float, lean: float) -> float:
    """How far below z (mm) a wall that leans inwards by so much, mm a mm, meets the front."""
    if not lean:
        return z - front(place)
    return brentq(lambda depth: z - depth - front(place - lean * depth), 0.0, place / lean)
