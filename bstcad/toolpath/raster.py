"""Raster for a router with three axes: roughing in steps down, then a finish in lines to and fro, with a ball.

The height of the ball without gouge decides all: finishing follows it, roughing follows that of a ball that is larger
by the stock left on the face, and cuts at most one depth at a time from the blank, which is flat.  The points of the
passes have Z = 0 at the top of the blank; the highest point of the part lies below it by the stock.  X and Y are those
of the face.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from bstcad.toolpath import chords, cusps
from bstcad.toolpath.cusps import ToolPasses
from bstcad.toolpath.cutting import ROUTER, Cutting
from bstcad.toolpath.machined_face import MachinedFace, RoundTool

MAX_BALL_SLOPE = 85.0  # steepest face (degrees) that a ball reaches without its shank
ROUGH_PITCH = 0.5  # pitch of roughing, as a fraction of the radius of the ball
ROUGH_TOLERANCE = 0.1  # tolerance of roughing, as a fraction of the stock
SAFE_HEIGHT = 5.0  # Z of rapid moves, above the top of the blank (mm)
RAPID_FEED = 3000.0  # feed that the estimate of the time assumes for rapid moves (mm/min)
STRAIGHT_PLAN = 1e-9  # difference from 1 of the cosine between two moves that are one line in the plan
MAX_OVERRUN = 0.98  # largest distance of a line from the face / radius of the ball, which touches nothing beyond
PLUNGE = 1 / 3  # feed of moves straight down, as a fraction of the feed


@dataclass(frozen=True)
class ToolPass:
    """Moves in contact with the part: the tool comes down over the first point, and goes up after the last one."""

    points: np.ndarray  # x, y and z of the lowest point of the ball (n, 3), mm
    rough: bool  # True for roughing


@dataclass(frozen=True)
class Raster:
    """Passes of a raster, in the order of the cut, with points rounded as they are written."""

    passes: tuple[ToolPass, ...]
    tool: RoundTool
    cutting: Cutting  # completed settings
    spacing: ToolPasses  # spacing of the finishing lines, and their cusp
    top: float  # z of the face's frame at Z = 0 of the passes, the top of the blank (mm)
    bottom: float  # z of the face's frame at the bottom of the blank, the outermost point of the other face (mm)

    @property
    def thickness(self) -> float:
        """Thickness of the blank (mm)."""
        return self.top - self.bottom

    @property
    def lift(self) -> float:
        """Z of the top of the blank in the written files (mm)."""
        return self.thickness if self.cutting.zero == "bottom" else 0.0

    @property
    def deepest(self) -> float:
        """Lowest Z of the path in the written files (mm)."""
        return self.lift + min(float(each.points[:, 2].min()) for each in self.passes)

    @property
    def length(self) -> float:
        """Length of the moves in contact (mm)."""
        return sum(float(np.linalg.norm(np.diff(each.points, axis=0), axis=1).sum()) for each in self.passes)

    @property
    def minutes(self) -> float:
        """Time of the path (minutes) by its lengths and feeds, without acceleration; rapid moves have RAPID_FEED."""
        rapid = plunge = 0.0
        x, y = 0.0, 0.0
        for each in self.passes:
            (x1, y1, z1), (x2, y2, z2) = each.points[0], each.points[-1]
            rapid += math.hypot(x1 - x, y1 - y) + SAFE_HEIGHT - z2
            plunge, (x, y) = plunge + SAFE_HEIGHT - z1, (x2, y2)
        speed = self.cutting.speed
        return self.length / speed + plunge / (PLUNGE * speed) + rapid / RAPID_FEED


def raster(face: MachinedFace, levels: tuple[float, float], wanted: Cutting) -> Raster:
    """Return the raster that cuts a face; ValueError if the face is too steep for a ball or the path too long.

    levels: z of the lowest and of the highest point of the finished part in the frame of the face (mm).
    """
    cutting = wanted.completed(ROUTER)
    tool, (cusp, tolerance), stock = RoundTool(face, cutting.radius), cutting.finish, cutting.roughing[0]
    face.refuse_steep(MAX_BALL_SLOPE, "ball")
    spacing = cusps.raster_passes(tool, cusps.for_passes(cusp, tolerance), pitch=cutting.pitch, along=cutting.along)
    bottom, top = levels[0], levels[1] + stock

    def tip(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return tool.ball(x, y) - tool.radius - top

    passes: list[ToolPass] = list(_roughing(face, cutting, top)) if stock else []
    chords.refuse_many(_places(face, spacing.pitch, tool.spacing(tolerance)))
    zigzag = np.concatenate(list(_lines(tool, spacing.pitch, cutting.along)))
    passes.append(
        ToolPass(_straightened(_followed(zigzag, tip, tool.spacing(tolerance), tolerance), tolerance), rough=False)
    )
    places = chords.digits(tolerance)
    written = tuple(replace(each, points=np.round(each.points, places)) for each in passes)
    return Raster(written, tool, cutting, spacing=spacing, top=top, bottom=bottom)


def flat_places(face: MachinedFace, wanted: Cutting) -> float:
    """Return the number of places at which the raster of a plane with the outline and net of a face begins."""
    cutting = wanted.completed(ROUTER)
    cusp = cusps.for_passes(*cutting.finish)
    return _places(
        face, cusps.flat_pitch(cutting.radius, cusp, cutting.pitch, cusps.RASTER_PITCHES), face.net.detail / 2
    )


def _places(face: MachinedFace, pitch: float, spacing: float) -> float:
    a, b = face.outline.half_extent
    return (2 * a / pitch) * (2 * b / spacing)


def _lines(tool: RoundTool, pitch: float, along: str) -> Iterator[np.ndarray]:
    """Yield the ends (2, 2) of lines over the places within the tool's reach of the face, in turn in both directions.

    The lines go on by a pitch (mm), so that none is missing, as long as a tool there still meets the face.
    """
    a, b, r2 = tool.face.outline.limits
    a, b = (a, b) if along == "x" else (b, a)
    r = math.sqrt(r2) + min(tool.reach + pitch, MAX_OVERRUN * tool.radius)
    reach = b + r
    count = math.ceil(2 * reach / pitch) + 1
    for k, level in enumerate(np.linspace(-reach, reach, count)):
        beyond = max(abs(level) - b, 0.0)
        half = a + math.sqrt(max(r * r - beyond * beyond, 0.0))
        ends = np.array([[-half, level], [half, level]])[:: -1 if k % 2 else 1]
        yield ends if along == "x" else ends[:, ::-1]


def _followed(
    corners: np.ndarray, tip: Callable[[np.ndarray, np.ndarray], np.ndarray], spacing: float, tolerance: float
) -> np.ndarray:
    """Return points (n, 3) of a path over a polyline (mm) whose straight moves keep the tolerance (mm)."""
    start, at = chords.along_polyline(corners, spacing)

    def place(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y = (np.interp(t, at, corner) for corner in corners.T)
        return x, y

    t, z = chords.within_tolerance(start, lambda t: tip(*place(t)), tolerance)
    return np.column_stack([*place(t), z])


def _straightened(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the points (n, 3) of a path without those on straight moves; the corners of its plan are kept."""
    step = np.diff(points[:, :2], axis=0)
    length = np.hypot(*step.T)
    along = (step[1:] * step[:-1]).sum(1) > (1 - STRAIGHT_PLAN) * length[1:] * length[:-1]
    corner = np.concatenate([[True], ~along, [True]])
    at = np.append(0.0, np.cumsum(length))
    return points[chords.bends(at, points[:, 2], corner, chords.STRAIGHT * tolerance)]


def _roughing(face: MachinedFace, cutting: Cutting, top: float) -> Iterator[ToolPass]:
    """Yield the passes that take the blank down to the stock on the face, level by level from Z = 0."""
    stock, depth = cutting.roughing
    larger = RoundTool(face, cutting.radius + stock)
    pitch, spacing = ROUGH_PITCH * cutting.radius, min(larger.spacing(ROUGH_TOLERANCE * stock), cutting.radius / 4)

    def tip(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return larger.ball(x, y) - cutting.radius - top

    lines = [_followed(ends, tip, spacing, ROUGH_TOLERANCE * stock) for ends in _lines(larger, pitch, cutting.along)]
    lowest = min(float(line[:, 2].min()) for line in lines)
    for level in range(1, math.ceil(-lowest / depth) + 1):
        above, floor = -(level - 1) * depth, -level * depth
        for line in lines:
            for run in _runs(line, above=above, floor=floor):
                yield ToolPass(_straightened(run, ROUGH_TOLERANCE * stock), rough=True)


def _runs(line: np.ndarray, above: float, floor: float) -> Iterator[np.ndarray]:
    """Yield the parts of a line of points (n, 3) that are lower than `above`, raised to `floor` (mm)."""
    low = line[:, 2] < above
    starts = np.flatnonzero(low & ~np.append(False, low[:-1]))
    ends = np.flatnonzero(low & ~np.append(low[1:], False)) + 1
    for start, end in zip(starts, ends, strict=True):
        run = line[max(start - 1, 0) : end + 1].copy()  # with the neighbours, where the blank is already cut
        run[:, 2] = np.maximum(run[:, 2], floor)
        yield run
