"""Draft and bevel of a lens's walls: the curves in which walls that lean end on the front.

From a parting line, the rim itself at one height, walls lean inwards as they go down to the front.  Where the rim has
shrunk evenly by o, its point p has moved to p + o m, m the inward normal; on a straight side m changes evenly between
the mitres of its two corners.  Of the front only height and slope are needed.

OCC's taper of the blank and chamfer of its edge do the same below a plane front.  Below curved fronts OCC's chamfer is
up to 0.8 degrees off 45 and leaves gaps of 1e-5 to 7e-4 mm, its taper of a spline 1e-5 mm; a file may have 5e-7 mm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from bstcad.cad import patches, wires
from bstcad.cad.solid import SLIM, TOLERANCE
from bstcad.cad.wires import Curve, Piece
from bstcad.optics.surfaces import Surface
from bstcad.scene.mount import MOST_DRAFT, STEEPEST

SMOOTH = 1e-7  # rad; pieces that turn by less from one to the next join smoothly
SHARPEST = 0.05  # 1 + cos of the turn at a corner: a mitre is at most 6.3 times as long as the offset
STEPS, EXACT = 50, 1e-13  # of Newton's method, and mm below which a step is none
SAMPLES = 129  # points of a piece in the question whether walls meet

Ceiling = Callable[[np.ndarray], np.ndarray]  # (n, 2) points in mm -> z (mm)


@dataclass(frozen=True)
class Draft:
    """How the walls of a lens stand from their parting line down to the front; both zero: along z."""

    angle: float = 0.0  # degrees, by which they lean inwards
    bevel: float = 0.0  # mm along z, taken at 45 degrees off their edge with the front

    def __post_init__(self) -> None:
        if not 0 <= self.angle <= MOST_DRAFT:
            raise ValueError(
                f"draft: {self.angle:g} degrees is not between 0 and {MOST_DRAFT:g}; choose an angle in between"
            )
        if not 0 <= self.bevel < math.inf:
            raise ValueError(f"bevel: {self.bevel:g} mm; give none, 0, or more")

    def __bool__(self) -> bool:
        return self.angle > 0 or self.bevel > 0

    @property
    def tangent(self) -> float:
        """How far the walls lean inwards, mm a mm."""
        return math.tan(math.radians(self.angle))

    @property
    def name(self) -> str:
        """The subject of a sentence about it: "draft", "bevel", or both."""
        return " and ".join(name for name, size in (("draft", self.angle), ("bevel", self.bevel)) if size)


UPRIGHT = Draft()


@dataclass(frozen=True)
class LeaningPiece:
    """A piece of the rim and how the wall below it leans."""

    surface: Surface  # the front
    piece: Piece
    mitres: tuple[np.ndarray, np.ndarray]  # (2,) at the ends of the piece
    z: float  # of the parting line (mm)
    draft: Draft

    def inwards(self, t: np.ndarray) -> np.ndarray:
        """(n, 2): by how much a point of the rim moves when the rim shrinks by 1."""
        if not self.piece.straight:
            return self.piece.left(t)
        start, end = self.mitres
        return start + (t / self.piece.end)[:, None] * (end - start)

    def ends(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) in mm: the lower edge of the wall, and that of the bevel, on the front; without a bevel the same."""
        start, m, tangent = self.piece.points(t), self.inwards(t), self.draft.tangent
        depth = self._meeting(start, m, tangent, np.full(len(t), self.z)) - self.draft.bevel
        upper = np.column_stack([start + tangent * depth[:, None] * m, self.z - depth])
        if not self.draft.bevel:
            return upper, upper
        depth = self._meeting(upper[:, :2], m, 1.0, upper[:, 2])
        return upper, np.column_stack([upper[:, :2] + depth[:, None] * m, upper[:, 2] - depth])

    def _meeting(self, start: np.ndarray, inwards: np.ndarray, tangent: float, z: np.ndarray) -> np.ndarray:
        """How far below z (n,) (mm) lines that lean inwards by `tangent` meet the front, by Newton's method."""
        depth, least = np.zeros(len(start)), np.ones(len(start))
        for _ in range(STEPS):
            x, y = (torch.from_numpy(np.ascontiguousarray(p)) for p in (start + tangent * depth[:, None] * inwards).T)
            height, *slopes = (part.numpy() for part in self.surface.sag_and_slope(x, y))
            closing = 1 + tangent * (np.stack(slopes, axis=1) * inwards).sum(axis=1)  # mm a mm of depth
            least = np.minimum(least, closing)
            step = (z - depth - height) / np.maximum(closing, STEEPEST)
            depth = depth + step
            if np.abs(step).max() <= EXACT * (1 + np.abs(z).max()):
                break
        worst = int(least.argmin())
        if not least[worst] > STEEPEST or not np.abs(step).max() <= TOLERANCE:
            name, angle = ("bevel", 45.0) if tangent == 1 else ("draft", self.draft.angle)
            raise ValueError(
                "{}: at ({:.4g}, {:.4g}) mm the front is too steep for a wall that leans by {:g} degrees to meet it; "
                "make it smaller".format(name, *start[worst], angle)
            )
        return depth

    def lower_edge(self) -> Piece:
        """The edge on the front as seen along z."""

        straight = self.piece.straight and level_on(self.surface, self.piece)
        return replace(self.piece, points=lambda t: self.ends(t)[1][:, :2], straight=straight)  # no curve needs `left`

    def traced(self) -> list[Curve]:
        """The parting line, the wall's lower edge and the bevel's: lines, arcs, or cubics of the same knots."""

        def points(t: np.ndarray) -> np.ndarray:
            return np.hstack([self.piece.points(t), np.full((len(t), 1), self.z), *self.ends(t)])

        edge, knots = self.lower_edge(), None
        if level_on(self.surface, self.piece):
            poles = points(np.array([0.0, self.piece.end]))
        else:
            sharp = replace(self, draft=Draft(self.draft.angle)).lower_edge()
            poles, knots = wires.fitted(points, wires.breaks(self.surface, edge, sharp), patches.RIM)
        return [Curve(edge, part, knots) for part in np.split(poles, 3, axis=1)]


def level_on(surface: Surface, piece: Piece) -> bool:
    """Is the edge over a piece on a surface a level line or arc, as on a plane, or about the axis?"""
    about_axis = piece.centre is not None and math.hypot(*piece.centre) < TOLERANCE
    if surface.curvature is not None and about_axis:
        return True
    return surface.level and (piece.straight or piece.centre is not None)


def leaning(rim: Sequence[Piece], surface: Surface, z: float, draft: Draft) -> list[LeaningPiece]:
    """The rim's pieces with their mitres, from z on (mm); ValueError where a corner has none."""
    starts = [piece.left(np.zeros(1))[0] for piece in rim]
    ends = [piece.left(np.array([piece.end]))[0] for piece in rim]
    for k, (piece, before, after) in enumerate(zip(rim, ends[-1:] + ends[:-1], tuple(starts), strict=True)):
        if math.dist(before, after) <= SMOOTH:
            continue
        if not (rim[k - 1].straight and piece.straight and 1 + before @ after > SHARPEST):
            raise ValueError(
                "{}: at ({:.4g}, {:.4g}) mm the rim has a corner that is too sharp, or not between straight sides, and "
                "walls cannot lean there; round it".format(draft.name, *piece.at(0.0))
            )
        starts[k] = ends[k - 1] = (before + after) / (1 + before @ after)
    mitres = zip(starts, ends, strict=True)
    return [LeaningPiece(surface, *each, z=z, draft=draft) for each in zip(rim, mitres, strict=True)]


def check(pieces: Sequence[LeaningPiece], holes: Sequence[Sequence[Piece]], ceiling: Ceiling) -> None:
    """ValueError unless walls end below the ceiling, and leave room for each other and for the holes."""
    name = pieces[0].draft.name
    for each in pieces:
        t = np.linspace(0.0, each.piece.end, SAMPLES)
        rim = each.piece.points(t)
        upper, lower = each.ends(t)
        room = ceiling(rim) - upper[:, 2]
        worst = int(room.argmin())
        if not room[worst] > SLIM:
            raise ValueError(
                "{}: below ({:.4g}, {:.4g}) mm no wall is left between z = {:.4g} mm, where it begins, and the front's "
                "edge at {:.4g} mm; make it smaller, or the lens thicker at its edge".format(
                    name, *rim[worst], ceiling(rim)[worst], lower[worst, 2]
                )
            )
        along, on_front = np.diff(rim, axis=0), np.diff(lower[:, :2], axis=0)
        onwards = (on_front * along).sum(axis=1) / (along * along).sum(axis=1)
        if not onwards.min() > SMOOTH:
            raise ValueError(_too_close(name, rim[onwards.argmin()]))
    edge = wires.polygon([each.lower_edge() for each in pieces])
    if place := wires.meets_itself(edge):
        raise ValueError(_too_close(name, place))
    for k, hole in enumerate(map(wires.polygon, holes), start=1):
        if wires.meeting(hole, edge) or not edge.contains(hole):
            raise ValueError(
                "hole {}: near ({:.4g}, {:.4g}) mm it crosses the walls, which draft and bevel move inwards; move it, "
                "too".format(k, *wires.corners(hole)[0])
            )


def _too_close(name: str, place: Sequence[float]) -> str:
    x, y = place
    return f"{name}: below ({x:.4g}, {y:.4g}) mm the walls meet before they reach the front; make it smaller"
