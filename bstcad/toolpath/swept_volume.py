"""Check of a tool path against the exact face: the distance of points of the face from the volume that the tool sweeps.

The check knows the path as it is written, rounded and with straight moves, and the heights of the face; its distances
share no step with the computation of the path.  For points P of the face, the clearance is

    e = min over the path of |P - c| - r,

c the centre of the ball along its straight moves, or of the nose along Z(C) and X(C) in the plane of P and the axis.  A
negative clearance is a gouge, -e deep.  A positive one is material that stays: the highest is the cusp, except where
more than LEFT cusps of the formula stay, because the tool is too large for a valley.  Such places are not reached.

Cusps are those of one point of each cell of a grid.  Gouges are narrow: their depth is that of a local search, which
begins at the worst of these points and at the contacts of the moves that lie farthest below the tool's exact height.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from bstcad.optics.numerics.reductions import on_threads
from bstcad.runs.kernel_cache import compiled_kernel
from bstcad.toolpath.cusps import ToolPasses
from bstcad.toolpath.machined_face import MachinedFace
from bstcad.toolpath.raster import Raster
from bstcad.toolpath.spiral import Spiral, nose_height

LEFT = 2.0  # material that stays, in cusps of the formula, above which a place is not reached
SAMPLES = 40_000, 200_000  # smallest and largest number of points of the face
WORK = 4e7  # largest number of pairs of a point and a move within the radius of the tool
FARTHEST = 2.0  # distance along the plane up to which moves are looked for / radius of the tool
TURN = 40.0  # cost of a turn near a point, in moves near a point
CELLS_PER_RADIUS = 8  # cells of the grid of moves per radius of the tool; a move is divided to fit into a cell
TASKS = 16  # number of parts of the points, for the threads
DEEPEST_MOVES, PLACES_ON_MOVE = 2000, (0.25, 0.5, 0.75)  # moves, and places on each, where the search begins
SEARCH_STARTS, SEARCH_SIDE, SEARCH_ROUNDS = 200, 5, 5  # worst points, points per side of a grid about each, and rounds
SEARCH_SHRINKAGE = 0.4  # ratio of the widths of the grids of one round to those of the round before
SLOPE_STEP = 1e-5  # step of the differences that give the slope of the tool's height / radius of the tool
SEED = 1  # seed of the places of the points in their cells


Height = Callable[[np.ndarray, np.ndarray], np.ndarray]  # height of a tool's centre without gouge over its two places
Measure = Callable[[np.ndarray], np.ndarray]  # clearances (n,) of points (n, 3) of the face, mm


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
    tool, radius = path.tool, path.tool.radius
    lift = (0.0, 0.0, path.top + radius)
    begin = np.concatenate([each.points[:-1] for each in path.passes]) + lift
    end = np.concatenate([each.points[1:] for each in path.passes]) + lift
    cell = radius / CELLS_PER_RADIUS
    begin, end = _pieces(begin, end, cell)
    half = float(np.linalg.norm(end - begin, axis=1).max(initial=0.0)) / 2
    middle = (begin + end)[:, :2] / 2
    low = middle.min(0)
    columns, rows = (int(count) for count in np.floor((middle.max(0) - low) / cell) + 1)
    place = np.floor((middle - low) / cell).astype(np.int64)
    number = place[:, 0] * rows + place[:, 1]
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(columns * rows + 1))
    lowest = np.full(columns * rows, np.inf)
    np.minimum.at(lowest, number, np.minimum(begin[:, 2], end[:, 2]))
    area = (columns * cell) * (rows * cell)
    near = len(begin) * (2 * (radius + half + cell)) ** 2 / area
    scene = begin[order], end[order], starts, lowest, (low[0], low[1], cell, columns, rows), radius, half

    def contact(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        z, step = tool.ball(x, y), SLOPE_STEP * radius
        z_x, z_y = (tool.ball(x + step, y) - z) / step, (tool.ball(x, y + step) - z) / step
        reach = radius / np.sqrt(1 + z_x**2 + z_y**2)
        return x + reach * z_x, y + reach * z_y

    finish = _deepest_places(path.passes[-1].points + lift, tool.ball)
    return _swept(
        tool.face, lambda points: _measured(_to_moves, points, scene), contact(*finish), work=near, passes=path.spacing
    )


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
    tool, radius = path.tool, path.tool.radius
    scene = path.angle / 360, path.x, path.z + radius, radius

    def height(turn: np.ndarray, x: np.ndarray) -> np.ndarray:
        return nose_height(tool, turn, x)

    def contact(turn: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        step = SLOPE_STEP * radius
        z_x = (height(turn, x + step) - height(turn, x)) / step
        s, angle = x + radius * z_x / np.sqrt(1 + z_x**2), 2 * np.pi * turn
        return s * np.cos(angle), s * np.sin(angle)

    deepest = contact(*_deepest_places(np.column_stack(scene[:3]), height))
    near = TURN * 2 * radius / path.passes.pitch
    return _swept(tool.face, lambda points: _measured(_to_nose, points, scene), deepest, work=near, passes=path.passes)


def _deepest_places(path: np.ndarray, height: Height) -> tuple[np.ndarray, np.ndarray]:
    """Return the first two coordinates (k,) of places on the moves that lie farthest below the height without gouge.

    path: points (n, 3) whose last coordinate is the height of the tool's centre.  These places are where the search for
    the deepest gouge begins; the gouge itself is measured at the face.
    """
    middle = (path[:-1] + path[1:]) / 2
    ends, inner = (height(at[:, 0], at[:, 1]) - at[:, 2] for at in (path, middle))
    depth = np.maximum(inner, np.maximum(ends[:-1], ends[1:]))
    chosen = np.argpartition(depth, -min(DEEPEST_MOVES, len(depth)))[-DEEPEST_MOVES:]
    share = np.array(PLACES_ON_MOVE)[:, None, None]
    places = (path[chosen] * (1 - share) + path[chosen + 1] * share).reshape(-1, 3)
    return places[:, 0], places[:, 1]


def _swept(
    face: MachinedFace, measure: Measure, deepest: tuple[np.ndarray, np.ndarray], work: float, passes: ToolPasses
) -> Swept:
    """Return the distances at samples of the face, and the deepest gouge by a local search.

    The search begins at the samples, and at the contacts `deepest` (x, y).  work: pairs with a move per point.
    """
    points = _points(face, work)
    clearance = measure(points)
    starts = _on_face(face, *deepest)
    places, found = np.concatenate([points, starts]), np.concatenate([clearance, measure(starts)])
    width = math.sqrt(4 * math.prod(face.outline.half_extent) / max(len(points), 1)) / 2
    away = np.linspace(-1, 1, SEARCH_SIDE)
    gouge = max(-float(found.min()), 0.0)
    for _ in range(SEARCH_ROUNDS):
        worst = places[np.argsort(found)[:SEARCH_STARTS]]
        x, y = (worst[:, k, None, None] + width * part for k, part in enumerate(np.meshgrid(away, away)))
        places = _on_face(face, x.ravel(), y.ravel())
        found = measure(places)
        gouge, width = max(gouge, -float(found.min(initial=0.0))), width * SEARCH_SHRINKAGE
    reached = clearance <= LEFT * passes.cusp
    highest, left = float(clearance[reached].max(initial=0.0)), max(float(clearance.max()), 0.0)
    return Swept(gouge, highest, unreached=1 - float(reached.mean()), left=left, points=points, clearance=clearance)


def _points(face: MachinedFace, work: float) -> np.ndarray:
    """Return points (n, 3) of the face, one at random in each cell of a grid; work: pairs per point."""
    count = min(max(WORK / max(work, 1.0), SAMPLES[0]), SAMPLES[1])
    half_x, half_y = face.outline.half_extent
    columns = max(round(math.sqrt(count * half_x / half_y)), 8)
    rows = max(round(columns * half_y / half_x), 8)
    cell = np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), axis=-1).reshape(-1, 2)
    at = (cell + np.random.default_rng(SEED).random(cell.shape)) / (columns, rows)
    x, y = (2 * at - 1).T * np.array([[half_x], [half_y]])
    return _on_face(face, x, y)


def _on_face(face: MachinedFace, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the points (k, 3) of the face at the places (x, y) that lie inside the outline."""
    inside = face.outline.contains(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    x, y = x[inside], y[inside]
    return np.column_stack([x, y, face.heights(x, y)])


def _measured(kernel, points: np.ndarray, scene) -> np.ndarray:  # type: ignore[no-untyped-def]  # a compiled function
    """Return the clearances (n,) of points (n, 3) by a kernel with its arguments, on all threads."""
    clearance, ends = np.empty(len(points)), [len(points) * k // TASKS for k in range(TASKS + 1)]
    on_threads(lambda *part: kernel(points, *scene, clearance, *part), list(zip(ends, ends[1:], strict=False)))
    return clearance


@compiled_kernel(error_model="numpy")
def _to_moves(points, begin, end, starts, lowest, grid, radius, half, clearance, first, last):
    """Store the distance of each point from the nearest straight move, less the radius; moves are sorted by cells.

    The cell of the point comes first.  A cell whose moves are all farther than the nearest so far is left out: its own
    distance along the plane, less half of the longest move, and the height of its lowest move are less than theirs.
    """
    low_x, low_y, cell, columns, rows = grid
    for k in range(first, last):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        best, own_i, own_j = math.inf, int((x - low_x) // cell), int((y - low_y) // cell)
        for turn in range(2):  # its own cell, then those around it
            reach = 0.0 if turn == 0 else min(math.sqrt(best) + half, FARTHEST * radius)
            a0, a1 = max(int((x - reach - low_x) // cell), 0), min(int((x + reach - low_x) // cell), columns - 1)
            b0, b1 = max(int((y - reach - low_y) // cell), 0), min(int((y + reach - low_y) // cell), rows - 1)
            for i in range(a0, a1 + 1):
                away_x = max(low_x + i * cell - x, x - low_x - (i + 1) * cell, 0.0)
                for j in range(b0, b1 + 1):
                    if turn == 1 and i == own_i and j == own_j:
                        continue
                    away_y = max(low_y + j * cell - y, y - low_y - (j + 1) * cell, 0.0)
                    away = max(math.sqrt(away_x * away_x + away_y * away_y) - half, 0.0)
                    above = max(lowest[i * rows + j] - z, 0.0)
                    if away * away + above * above > best:
                        continue
                    for move in range(starts[i * rows + j], starts[i * rows + j + 1]):
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
