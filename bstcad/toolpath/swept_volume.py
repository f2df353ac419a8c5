"""Check of a tool path against the exact face: the distance of points of the face from the volume that the tool sweeps.

The check knows the path as it is written, its straight moves, and the heights of the face; it shares no step with the
computation of the path.  For points P of the face, at one place of each cell of a grid, the clearance is

    e = min over the path of |P - c| - r,

c the centre of the ball along its straight moves, or of the nose along Z(C) and X(C) in the plane of P and the axis.  A
negative clearance is a gouge, -e deep.  A positive one is material that stays: the highest is the cusp, except where
more than LEFT cusps of the formula stay, because the tool is too large for a valley.  Such places are not reached.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from bstcad.optics.kernels.reductions import on_threads
from bstcad.runs.kernel_cache import compiled_kernel
from bstcad.toolpath.machined_face import MachinedFace
from bstcad.toolpath.raster import Raster
from bstcad.toolpath.spiral import Spiral

LEFT = 2.0  # material that stays, in cusps of the formula, above which a place is not reached
SAMPLES = 40_000, 200_000  # smallest and largest number of points of the face
WORK = 1e8  # largest number of pairs of a point and a move near it
TURN = 40.0  # cost of a turn near a point, in moves near a point
CELLS_PER_RADIUS = 2  # cells of the grid of moves per radius of the tool
TASKS = 16  # number of parts of the points, for the threads
SEED = 1  # seed of the places of the points in their cells


@dataclass(frozen=True)
class Swept:
    """Distances of the swept volume of a tool from the exact face."""

    gouge: float  # deepest gouge, mm; 0: none
    cusp: float  # highest material that stays where the tool reaches the face, mm
    unreached: float  # fraction of the face that the tool does not reach
    left: float  # highest material that stays anywhere, mm
    points: np.ndarray  # x, y and z of the points that were examined (n, 3), mm
    clearance: np.ndarray  # clearance e of each of them (n,), mm


def check_raster(path: Raster) -> Swept:
    """Return the distances of all moves of a raster, roughing and plunges included, from the face."""
    radius = path.tool.radius
    lift = (0.0, 0.0, path.top + radius)
    begin = np.concatenate([each.points[:-1] for each in path.passes]) + lift
    end = np.concatenate([each.points[1:] for each in path.passes]) + lift
    begin, end = _pieces(begin, end, radius)
    half = float(np.linalg.norm(end - begin, axis=1).max(initial=0.0)) / 2
    middle, cell = (begin + end)[:, :2] / 2, radius / CELLS_PER_RADIUS
    low = middle.min(0)
    columns, rows = (int(count) for count in np.floor((middle.max(0) - low) / cell) + 1)
    place = np.floor((middle - low) / cell).astype(np.int64)
    number = place[:, 0] * rows + place[:, 1]
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(columns * rows + 1))
    area = (columns * cell) * (rows * cell)
    near = len(begin) * (2 * (radius + half + cell)) ** 2 / area
    points = _points(path.tool.face, near)
    clearance = np.empty(len(points))
    scene = points, begin[order], end[order], starts, (low[0], low[1], cell, columns, rows), radius, half, clearance
    _divided(_to_moves, scene, len(points))
    return _summary(points, clearance, path.spacing.cusp)


def _pieces(begin: np.ndarray, end: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of the moves (n, 3), divided into equal pieces of at most `longest` mm."""
    step = end - begin
    parts = np.maximum(np.ceil(np.linalg.norm(step, axis=1) / longest), 1).astype(np.int64)
    which = np.repeat(np.arange(len(parts)), parts)
    piece = np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts)
    first, last = (begin[which] + step[which] * (k / parts[which])[:, None] for k in (piece, piece + 1))
    return first, last


def check_spiral(path: Spiral) -> Swept:
    """Return the distances of a spiral from the face, in the planes of the nose; gouges across them are smaller."""
    points = _points(path.tool.face, TURN * 2 * path.tool.radius / path.passes.pitch)
    clearance = np.empty(len(points))
    table = path.angle / 360, path.x, path.z + path.tool.radius
    _divided(_to_nose, (points, *table, path.tool.radius, clearance), len(points))
    return _summary(points, clearance, path.passes.cusp)


def _points(face: MachinedFace, work: float) -> np.ndarray:
    """Return points (n, 3) of the face, one at random in each cell of a grid; work: pairs per point."""
    count = min(max(WORK / max(work, 1.0), SAMPLES[0]), SAMPLES[1])
    half_x, half_y = face.outline.half_extent
    columns = max(round(math.sqrt(count * half_x / half_y)), 8)
    rows = max(round(columns * half_y / half_x), 8)
    cell = np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), axis=-1).reshape(-1, 2)
    at = (cell + np.random.default_rng(SEED).random(cell.shape)) / (columns, rows)
    x, y = (2 * at - 1).T * np.array([[half_x], [half_y]])
    inside = face.outline.contains(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    x, y = x[inside], y[inside]
    return np.column_stack([x, y, face.heights(x, y)])


def _summary(points: np.ndarray, clearance: np.ndarray, cusp: float) -> Swept:
    reached = clearance <= LEFT * cusp
    highest = float(clearance[reached].max(initial=0.0))
    gouge, left = max(-float(clearance.min()), 0.0), max(float(clearance.max()), 0.0)
    return Swept(gouge, highest, unreached=1 - float(reached.mean()), left=left, points=points, clearance=clearance)


def _divided(kernel, scene, count: int) -> None:  # type: ignore[no-untyped-def]  # a compiled function and its arguments
    ends = [count * k // TASKS for k in range(TASKS + 1)]
    on_threads(lambda *part: kernel(*scene, *part), list(zip(ends, ends[1:], strict=False)))


@compiled_kernel(error_model="numpy")
def _to_moves(points, begin, end, starts, grid, radius, half, clearance, first, last):
    """Store the distance of each point from the nearest straight move, less the radius; moves are sorted by cells."""
    low_x, low_y, cell, columns, rows = grid
    reach = radius + half
    for k in range(first, last):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        best = math.inf
        i0, i1 = max(int((x - reach - low_x) // cell), 0), min(int((x + reach - low_x) // cell), columns - 1)
        j0, j1 = max(int((y - reach - low_y) // cell), 0), min(int((y + reach - low_y) // cell), rows - 1)
        for i in range(i0, i1 + 1):
            for move in range(starts[i * rows + j0], starts[i * rows + j1 + 1]):
                a, b, c = begin[move, 0], begin[move, 1], begin[move, 2]
                u, v, w = end[move, 0] - a, end[move, 1] - b, end[move, 2] - c
                length2 = u * u + v * v + w * w
                share = ((x - a) * u + (y - b) * v + (z - c) * w) / length2 if length2 > 0.0 else 0.0
                share = min(max(share, 0.0), 1.0)
                a, b, c = x - a - share * u, y - b - share * v, z - c - share * w
                best = min(best, a * a + b * b + c * c)
        clearance[k] = math.sqrt(best) - radius


@compiled_kernel(error_model="numpy")
def _to_nose(points, turn, x, z, radius, clearance, first, last):
    """Store the distance of each point from the nearest centre of the nose in its plane, less the radius."""
    for k in range(first, last):
        distance = math.hypot(points[k, 0], points[k, 1])
        angle = math.atan2(points[k, 1], points[k, 0]) / (2.0 * math.pi)
        best = math.inf
        for side in range(2):
            s = distance if side == 0 else -distance  # the nose may touch the face beyond the axis
            if s + radius < 0.0:
                continue
            low, high = 0, x.size - 1  # first point at which x <= s + radius
            while low < high:
                middle = (low + high) // 2
                if x[middle] <= s + radius:
                    high = middle
                else:
                    low = middle + 1
            part = angle + 0.5 * side
            at = part + math.ceil(turn[low] - 1.0 - part)
            at = at if at >= turn[0] else at + 1.0
            while at <= turn[-1]:
                after = min(max(np.searchsorted(turn, at), 1), turn.size - 1)
                share = (at - turn[after - 1]) / (turn[after] - turn[after - 1])
                centre = x[after - 1] + share * (x[after] - x[after - 1])
                if centre < s - radius:
                    break
                over = z[after - 1] + share * (z[after] - z[after - 1])
                best = min(best, math.hypot(s - centre, points[k, 2] - over))
                at += 1.0
        clearance[k] = best - radius
