"""A part cut along a plane through its axis: the lens between its faces, walls with draft and bevel, flange and holes.

Polygons in mm, (z, u) with u along the cut, in the frame of the part's file.  Along the middle of a straight side and
on a circle draft leans walls within the plane of the cut, so that two dimensions are enough.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import Surface, sag
from bstcad.scene.mount import Flange, Mount

POINTS = 401  # along each face

Pair = tuple[float, float]  # z, u (mm), or a value at the lower and at the upper end of the cut


@dataclass(frozen=True, eq=False)
class Profile:
    """Cross-section of a part, mm."""

    bodies: tuple[np.ndarray, ...]  # (n, 2) each: the lens with its flange, then the pieces that holes part off
    back: Pair  # z of the back's ends
    front: Pair
    front_ends: Pair  # u where the front ends
    behind: tuple[np.ndarray, ...] = ()  # (2, 2) each: edges of the flange's planes, seen behind its holes

    @property
    def ends(self) -> tuple[Pair, Pair]:
        """(least and largest z, least and largest u) of all bodies."""
        every = np.concatenate(self.bodies)
        (low, low_u), (high, high_u) = every.min(0).tolist(), every.max(0).tolist()
        return (low, high), (low_u, high_u)


def profile(lens: Lens, mount: Mount, upright: bool, origin: float = 0.0) -> Profile:
    """Section of a lens in its mount, which have to fit; upright: along y at x = 0, else along x at y = 0.

    origin: z in the scene's frame (mm) that is 0 in the part's file.
    """

    def height(surface: Surface, u: np.ndarray) -> np.ndarray:
        return (sag(surface, 0.0 * u, u) if upright else sag(surface, u, 0.0 * u)) - origin

    half = mount.rim_of(lens.outline).outline.half_extent[upright]
    along = np.linspace(-half, half, POINTS)
    back = height(lens.back, along)
    leans_from = mount.top(lens) - origin if mount.draft or mount.flange else math.inf
    sides, pieces, behind = [], [], []
    for sense, k in ((-1, 0), (1, -1)):
        chain = [(float(back[k]), half)]
        if mount.flange is not None:
            low, high = mount.flange.z - origin, mount.flange.z + mount.flange.thickness - origin
            first, *others = _flange(mount.flange, half, sense=sense, upright=upright, low=low)
            chain += [(high, half), *first, (low, half)]
            pieces += [np.array(piece) * (1, sense) for piece in others]
            outer = (others or [first])[-1]
            behind += [np.array([(z, sense * half), (z, sense * max(u for at, u in outer if at == z))])
                       for z in (low, high)]  # fmt: skip
        chain += _wall(lambda u, s=sense: float(height(lens.front, np.float64(s * u))), chain[-1][0], half,
                       mount=mount, leans_from=leans_from)  # fmt: skip
        sides.append(np.array(chain) * (1, sense))
    left, right = sides
    ends = float(left[-1, 1]), float(right[-1, 1])
    u = np.linspace(*ends, POINTS)
    front = height(lens.front, u)
    body = [np.stack([back, along], 1), right[1:-1], np.stack([front, u], 1)[::-1], left[1:-1][::-1]]
    return Profile(
        bodies=(np.concatenate(body), *pieces), back=(float(back[0]), float(back[-1])),
        front=(float(front[0]), float(front[-1])), front_ends=ends, behind=tuple(behind),
    )  # fmt: skip


def _flange(flange: Flange, half: float, *, sense: int, upright: bool, low: float) -> list[list[Pair]]:
    """Pieces of a flange beside the rim, from the lens outwards, as chains (z, |u|) from upper to lower plane."""
    high, lean, b = low + flange.thickness, math.tan(math.radians(flange.draft)), flange.bevel
    reach = flange.outline.outline.half_extent[upright]
    foot, head = reach - lean * b, reach - lean * (flange.thickness - b)  # ends of the leaning wall
    edges = []
    for x, y, diameter in flange.all_holes():
        along, off = (sense * y, x) if upright else (sense * x, y)
        if abs(off) < diameter / 2 and along > half:
            chord = math.sqrt(diameter**2 / 4 - off**2)
            edges += [along - chord, along + chord]
    edges.sort()
    wall = [(high, head - b), (high - b, head), (low + b, foot), (low, foot - b)]
    if not edges:
        return [wall]
    webs = zip(edges[1:-1:2], edges[2:-1:2], strict=True)
    return [
        [(high, edges[0]), (low, edges[0])],
        *([(high, inner), (high, outer), (low, outer), (low, inner)] for inner, outer in webs),
        [(high, edges[-1]), *wall, (low, edges[-1])],
    ]


def _wall(
    front: Callable[[float], float], z: float, half: float, *, mount: Mount, leans_from: float
) -> list[Pair]:  # fmt: skip
    """The lens's own wall from z downwards to the front, (z, |u|): it leans from `leans_from`, and ends in a bevel."""
    if not (mount.draft or mount.bevel):
        return [(front(half), half)]
    start, lean = min(z, leans_from), math.tan(math.radians(mount.draft))
    depth = _depth(front, start, half, lean) - mount.bevel
    upper = start - depth, half - lean * depth
    if not mount.bevel:
        return [(start, half), upper]
    more = _depth(front, *upper, 1.0)
    return [(start, half), upper, (upper[0] - more, upper[1] - more)]


def _depth(front: Callable[[float], float], z: float, u: float, lean: float) -> float:
    """Depth (mm) below (z, u) at which a wall that leans inwards by `lean`, mm a mm, meets the front."""
    if not lean:
        return z - front(u)
    return brentq(lambda depth: z - depth - front(u - lean * depth), 0.0, u / lean)
