"""How the walls of a lens lean, by draft and bevel, and the curves in which they end.

From a parting line, the rim itself at one height, walls lean inwards as they go down to the front.  Where the rim has
shrunk evenly by o, a place p of it has moved to p + o m, m the inward normal; on a straight side m changes evenly
between the mitres of its two corners.  Of the front nothing is asked but height and slope.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from bstcad.cad import faces, loops
from bstcad.cad.fitting import breaks, fitted
from bstcad.cad.loops import Piece
from bstcad.cad.solid import SLIM, TOLERANCE
from bstcad.optics.surfaces import Surface
from bstcad.scene.mount import MOST_DRAFT, STEEPEST

if TYPE_CHECKING:
    from bstcad.cad.walls import Ring

SMOOTH = 1e-7  # rad; pieces that turn by less from one to the next join smoothly
SHARPEST = 0.05  # 1 + cos of the turn at a corner: a mitre is at most 6.3 times as long as the offset
STEPS, EXACT = 50, 1e-13  # of Newton's method, and mm below which a step is none
SAMPLES = 129  # of a piece, where it is asked whether walls meet
DIFFERENCE = 1e-6  # of a piece: over so much of it the turn of a spline's normal is a difference quotient

Ceiling = Callable[[np.ndarray], np.ndarray]  # (n, 2) places in mm -> z (mm)


@dataclass(frozen=True)
class Lean:
    """What the walls of a lens are from its parting line down to its front; both zero: nothing but walls along z."""

    draft: float = 0.0  # degrees, by which they lean inwards
    bevel: float = 0.0  # mm along z, taken at 45 degrees off their edge with the front

    def __post_init__(self) -> None:
        if not 0 <= self.draft <= MOST_DRAFT:
            raise ValueError(
                f"draft: {self.draft:g} degrees is not between 0 and {MOST_DRAFT:g}; choose one in between"
            )
        if not 0 <= self.bevel < math.inf:
            raise ValueError(f"bevel: {self.bevel:g} mm; give none, 0, or more")

    def __bool__(self) -> bool:
        return self.draft > 0 or self.bevel > 0

    @property
    def tangent(self) -> float:
        """How far the walls lean inwards, mm a mm."""
        return math.tan(math.radians(self.draft))

    @property
    def named(self) -> str:
        """What of both there is, as a sentence about it begins."""
        return " and ".join(name for name in ("draft", "bevel") if getattr(self, name))


@dataclass(frozen=True)
class Trace:
    """The curves of one piece as cubics of one parameter: poles (n, 3) in mm."""

    breaks: np.ndarray
    full: np.ndarray  # knots
    parting: np.ndarray  # where the wall begins to lean
    upper: np.ndarray  # where it ends
    lower: np.ndarray  # where the bevel ends, on the front; without one, `upper`


@dataclass(frozen=True)
class Course:
    """One piece of the rim and the wall below it."""

    surface: Surface  # the front
    piece: Piece
    mitres: tuple[np.ndarray, np.ndarray]  # (2,) at its ends
    z: float  # of the parting line (mm)
    lean: Lean

    @property
    def level(self) -> bool:
        """Are its edges level, and lines or arcs?  So below a plane front, and about the axis of a turned one."""
        centre = self.piece.centre
        turned = self.surface.curvature is not None and centre is not None and math.hypot(*centre) < TOLERANCE
        return turned or (self.surface.level and (self.piece.straight or centre is not None))

    def inwards(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, 2): where a place of the rim moves when that shrinks by 1, and the derivatives in t."""
        piece = self.piece
        if piece.straight:
            (start, end), share = self.mitres, (t / piece.end)[:, None]
            return start + share * (end - start), np.broadcast_to((end - start) / piece.end, (len(t), 2))
        places, along = piece.points(t)
        if piece.centre is not None:
            radius = piece.turn * math.dist(piece.at(0.0), piece.centre)
            return (np.array(piece.centre) - places) / radius, -along / radius
        before, after = (np.clip(t + s * DIFFERENCE * piece.end, 0.0, piece.end) for s in (-1, 1))
        behind, ahead = (left(piece.points(p)[1]) for p in (before, after))
        return left(along), (ahead - behind) / (after - before)[:, None]

    def ends(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(n, 3) in mm and their derivatives in t: of the wall's lower edge, then of the bevel's, on the front."""
        (place, along), (m, turn), tangent = self.piece.points(t), self.inwards(t), self.lean.tangent
        depth, slope, closing = self._meeting(place, m, tangent, np.full(len(t), self.z))
        deeper = -(slope * (along + tangent * depth[:, None] * turn)).sum(axis=1) / closing
        depth = depth - self.lean.bevel
        place = place + tangent * depth[:, None] * m
        along = along + tangent * (deeper[:, None] * m + depth[:, None] * turn)
        upper, upper_along = np.column_stack([place, self.z - depth]), np.column_stack([along, -deeper])
        if not self.lean.bevel:
            return upper, upper_along, upper, upper_along
        more, slope, closing = self._meeting(place, m, 1.0, upper[:, 2])
        along = along + more[:, None] * turn
        growing = -((slope * along).sum(axis=1) + deeper) / closing
        lower = np.column_stack([place + more[:, None] * m, upper[:, 2] - more])
        return upper, upper_along, lower, np.column_stack([along + growing[:, None] * m, -deeper - growing])

    def _meeting(
        self, start: np.ndarray, inwards: np.ndarray, tangent: float, z: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where lines that lean inwards by `tangent` meet the front, by Newton's method.

        Returns (how far below z (n,) in mm, slope of the front there (n, 2), how fast both close (n,), mm a mm).
        """
        depth, least = np.zeros(len(start)), np.ones(len(start))
        for _ in range(STEPS):
            x, y = (torch.from_numpy(np.ascontiguousarray(p)) for p in (start + tangent * depth[:, None] * inwards).T)
            height, *slopes = (part.numpy() for part in self.surface.sag_and_slope(x, y))
            slope = np.stack(slopes, axis=1)
            closing = 1 + tangent * (slope * inwards).sum(axis=1)
            least = np.minimum(least, closing)
            step = (z - depth - height) / np.maximum(closing, STEEPEST)
            depth = depth + step
            if np.abs(step).max() <= EXACT * (1 + np.abs(z).max()):
                break
        worst = int(least.argmin())
        if not least[worst] > STEEPEST or not np.abs(step).max() <= TOLERANCE:
            what, angle = ("bevel", 45.0) if tangent == 1 else ("draft", self.lean.draft)
            raise ValueError(
                "{}: at ({:.4g}, {:.4g}) mm the front is too steep for a wall that leans by {:g} degrees to meet it; "
                "make it smaller".format(what, *start[worst], angle)
            )
        return depth, slope, closing

    def without_bevel(self) -> Course:
        """The same with a sharp edge."""
        return replace(self, lean=Lean(self.lean.draft))

    def path(self) -> Piece:
        """The edge at the front as seen along z."""

        def points(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            _, _, place, along = self.ends(t)
            return place[:, :2], along[:, :2]

        return Piece(points, self.piece.end, turn=1, straight=self.level and self.piece.straight)

    def traced(self) -> Trace:
        """Its curves, within faces.RIM of the exact ones."""

        def points(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            (place, along), (upper, upper_along, lower, lower_along) = self.piece.points(t), self.ends(t)
            high, level = np.full((len(t), 1), self.z), np.zeros((len(t), 1))
            return np.hstack([place, high, upper, lower]), np.hstack([along, level, upper_along, lower_along])

        places = breaks(self.surface, self.path(), *([self.without_bevel().path()] if self.lean.bevel else []))
        at, poles, full = fitted(points, places, faces.RIM)
        return Trace(at, full, poles[:, :3], poles[:, 3:6], poles[:, 6:])


def left(along: np.ndarray) -> np.ndarray:
    """Unit normals (n, 2) on the left of a direction."""
    x, y = along.T / np.hypot(*along.T)
    return np.stack([-y, x], axis=1)


def of_ring(ring: Ring, surface: Surface, z: float, lean: Lean) -> list[Course]:
    """Its pieces with their mitres, leaning from z on (mm); ValueError where a corner has none."""
    starts = [left(piece.points(np.zeros(1))[1])[0] for piece in ring.pieces]
    ends = [left(piece.points(np.array([piece.end]))[1])[0] for piece in ring.pieces]
    for k, (piece, before, after) in enumerate(zip(ring.pieces, ends[-1:] + ends[:-1], tuple(starts), strict=True)):
        if math.dist(before, after) <= SMOOTH:
            continue
        if not (ring.pieces[k - 1].straight and piece.straight and 1 + before @ after > SHARPEST):
            raise ValueError(
                "{}: at ({:.4g}, {:.4g}) mm the rim has a corner that is too sharp, or not between straight sides, and "
                "walls cannot lean there; round it".format(lean.named, *piece.at(0.0))
            )
        starts[k] = ends[k - 1] = (before + after) / (1 + before @ after)
    return [Course(surface, *each, z, lean) for each in zip(ring.pieces, zip(starts, ends, strict=True), strict=True)]


def check(courses: Sequence[Course], holes: Sequence[Ring], ceiling: Ceiling) -> None:
    """ValueError unless walls end below the ceiling, and leave room for each other and for the holes."""
    named = courses[0].lean.named
    for course in courses:
        t = np.linspace(0.0, course.piece.end, SAMPLES)
        place, along = course.piece.points(t)
        upper, _, lower, lower_along = course.ends(t)
        room = ceiling(place) - upper[:, 2]
        worst = int(room.argmin())
        if not room[worst] > SLIM:
            raise ValueError(
                "{}: below ({:.4g}, {:.4g}) mm no wall is left between z = {:.4g} mm, where it begins, and the front's "
                "edge at {:.4g} mm; make it smaller, or the lens thicker at its edge".format(
                    named, *place[worst], ceiling(place)[worst], lower[worst, 2]
                )
            )
        onwards = (lower_along[:, :2] * along).sum(axis=1) / (along * along).sum(axis=1)
        if not onwards.min() > SMOOTH:
            raise ValueError(_met(named, place[onwards.argmin()]))
    rim = loops.polygon([course.path() for course in courses])
    if place := loops.crossing(rim, rim):
        raise ValueError(_met(named, place))
    for k, hole in enumerate(holes, start=1):
        around = loops.polygon(hole.pieces)
        if loops.crossing(around, rim) or not loops.encloses(rim, around[0]):
            raise ValueError(
                "hole {}: near ({:.4g}, {:.4g}) mm it crosses the walls, which draft and bevel move inwards; move it, "
                "too".format(k, *around[0])
            )


def _met(named: str, place: Sequence[float]) -> str:
    x, y = place
    return f"{named}: below ({x:.4g}, {y:.4g}) mm the walls meet before they reach the front; make it smaller"
