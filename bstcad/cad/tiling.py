"""Tiling: the cells of a grid over the outline of a plate, their names and their sides, without OpenCASCADE.

The grid divides the bounding box of the outline into equal rectangles.  Columns are counted along +x and rows along +y,
each from 1: tile-1-1 is the tile at the smallest x and y.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.sides import Sides, as_pair

MAX_TILES_PER_SIDE = 20  # largest number of columns and of rows
ON_RIM = 1e-9  # distance (mm) below which a point counts as one on a line or on the rim
MIN_AREA = 0.01  # smallest area of a tile, as a fraction of a whole cell; smaller ones would break
SIDES_PATTERN = re.compile(r"(\d+)\s*[x×]\s*(\d+)")

Point = tuple[float, float]
Span = tuple[float, float]


@dataclass(frozen=True)
class Side:
    """A side of a tile from one point to the next, counterclockwise: straight, or an arc about the axis."""

    start: Point  # mm
    end: Point  # mm
    radius: float | None = None  # radius of the arc about the axis (mm); None: straight
    joint: bool = False  # True where the neighbouring tile begins, False on the rim of the plate

    @property
    def angles(self) -> tuple[float, float]:
        """Angle of the start of an arc, and the angle that the arc spans (rad)."""
        first, last = (math.atan2(y, x) for x, y in (self.start, self.end))
        return first, (last - first) % (2 * math.pi)

    @property
    def twice_area(self) -> float:
        """Twice the area (mm²) between the side and the axis: ∮ x dy - y dx along the side."""
        if self.radius is not None:
            return self.radius**2 * self.angles[1]
        (x, y), (x_end, y_end) = self.start, self.end
        return x * y_end - y * x_end


@dataclass(frozen=True)
class Cell:
    """A tile of a plate, seen from the back: x to the right, y up."""

    column: int  # number along +x, from 1
    row: int  # number along +y, from 1
    sides: tuple[Side, ...]  # counterclockwise

    @property
    def name(self) -> str:
        """Name of the tile, such as "tile-1-2": column, then row."""
        return f"tile-{self.column}-{self.row}"

    @property
    def extent(self) -> tuple[Span, Span]:
        """Smallest and largest x and y (mm)."""
        points = [side.start for side in self.sides]
        for side in self.sides:
            if side.radius is not None:
                start, span = side.angles
                turns = (k * math.pi / 2 for k in range(-2, 7))
                inner = (turn for turn in turns if start < turn < start + span)
                points += [(side.radius * math.cos(turn), side.radius * math.sin(turn)) for turn in inner]
        x, y = zip(*points, strict=True)
        return (min(x), max(x)), (min(y), max(y))

    @property
    def area(self) -> float:
        """Area of the outline of the tile, mm²."""
        return sum(side.twice_area for side in self.sides) / 2


@dataclass(frozen=True)
class Tiling:
    """Number of columns (along x) and of rows (along y) of tiles."""

    columns: int = 2
    rows: int = 2

    def __post_init__(self) -> None:
        """Raise ValueError in one sentence for a number that is not possible."""
        if not all(1 <= count <= MAX_TILES_PER_SIDE for count in (self.columns, self.rows)):
            raise ValueError(
                f"tiles = {self.words} is not possible; give 1 to {MAX_TILES_PER_SIDE} columns and rows, such as 2x3"
            )
        if self.columns * self.rows == 1:
            raise ValueError("tiles = 1x1 is the whole lens, which lens.step has; give two tiles or more, such as 2x1")

    @classmethod
    def parse(cls, given: str | Sides) -> Tiling:
        """Return the tiling of "2x3" (2 along x, 3 along y), of (2, 3), or of 2 for 2x2; ValueError for others."""
        sides: Sequence[int] = ()
        if not isinstance(given, str):
            sides = as_pair(given)
        elif found := SIDES_PATTERN.fullmatch(given.strip()):
            sides = int(found[1]), int(found[2])
        if len(sides) != 2 or not all(isinstance(count, int) and not isinstance(count, bool) for count in sides):
            raise ValueError("tiles: is not two whole numbers; give columns and rows, such as 2x3")
        return cls(*sides)

    @property
    def words(self) -> str:
        """Numbers as text, such as "2x3"."""
        return f"{self.columns}x{self.rows}"

    def cuts(self, outline: Outline) -> tuple[list[float], list[float]]:
        """Return x of the cuts between columns, and y of the cuts between rows (mm)."""
        (a, b), counts = outline.half_extent, (self.columns, self.rows)
        halves = zip((a, b), counts, strict=True)
        x, y = ([half * (2 * k / count - 1) for k in range(1, count)] for half, count in halves)
        return x, y

    def cells(self, outline: Outline) -> list[Cell]:
        """Return the tiles of an outline, row by row; ValueError if one is only a sliver.

        A cell of the grid outside a round outline has no tile.
        """
        x, y = self.cuts(outline)
        (a, b), found = outline.half_extent, []
        end_x, end_y = (math.inf, math.inf) if outline.is_round else (a, b)
        columns, rows = [-end_x, *x, end_x], [-end_y, *y, end_y]
        for row in range(self.rows):
            for column in range(self.columns):
                box = (columns[column], rows[row], columns[column + 1], rows[row + 1])
                sides = tuple(_sides_in_circle(box, a) if outline.is_round else _sides_of_box(box, (a, b)))
                if not sides:
                    continue
                cell = Cell(column + 1, row + 1, sides)
                if cell.area < MIN_AREA * 4 * a * b / (self.columns * self.rows):
                    raise ValueError(
                        f"tiles = {self.words}: tile {column + 1}-{row + 1} at the rim is a sliver of {cell.area:.3g} "
                        "mm²; give another number of tiles"
                    )
                found.append(cell)
        return found


def _sides_of_box(box: tuple[float, float, float, float], half: Point) -> Iterator[Side]:
    x0, y0, x1, y1 = box
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    inner = [y0 > -half[1], x1 < half[0], y1 < half[1], x0 > -half[0]]  # sides that are not on the rim
    for start, end, joint in zip(corners, corners[1:] + corners[:1], inner, strict=True):
        yield Side(start, end, joint=joint)


def _sides_in_circle(box: tuple[float, float, float, float], radius: float) -> Iterator[Side]:
    """Yield the sides of the part of a circle about the axis inside a box; its outermost sides are at infinity."""
    points = _corners_in_circle(box, radius)
    if not points:
        return
    x, y = (sum(p[k] for p in points) / len(points) for k in (0, 1))  # inside, as box and circle are convex
    points.sort(key=lambda p: math.atan2(p[1] - y, p[0] - x))
    for start, end in zip(points, points[1:] + points[:1], strict=True):
        if _along_box(box, start, end):
            yield Side(start, end, joint=True)
            continue
        whole = Side(start, end, radius=radius)
        first, span = whole.angles
        parts = math.ceil(span / math.pi - ON_RIM)  # no arc of more than half a circle
        turns = [first + span * k / parts for k in range(1, parts)]
        ends = [start, *((radius * math.cos(turn), radius * math.sin(turn)) for turn in turns), end]
        for each in zip(ends[:-1], ends[1:], strict=True):
            yield Side(*each, radius=radius)


def _corners_in_circle(box: tuple[float, float, float, float], radius: float) -> list[Point]:
    """Return the corners of the part of a circle inside a box, in no order, each once."""
    x0, y0, x1, y1 = box
    found = [(x, y) for x in (x0, x1) for y in (y0, y1) if math.hypot(x, y) < radius - ON_RIM]
    for x in (x0, x1):
        if abs(x) < radius:
            rise = math.sqrt(radius**2 - x * x)
            found += [(x, y) for y in (-rise, rise) if y0 - ON_RIM <= y <= y1 + ON_RIM]
    for y in (y0, y1):
        if abs(y) < radius:
            run = math.sqrt(radius**2 - y * y)
            found += [(x, y) for x in (-run, run) if x0 - ON_RIM <= x <= x1 + ON_RIM]
    kept: list[Point] = []
    for point in found:
        if all(math.dist(point, other) > 10 * ON_RIM for other in kept):
            kept.append(point)
    return kept


def _along_box(box: tuple[float, float, float, float], start: Point, end: Point) -> bool:
    """True if two points follow each other on one side of a box, counterclockwise."""
    x0, y0, x1, y1 = box
    sides = ((1, y0, 0, 1), (0, x1, 1, 1), (1, y1, 0, -1), (0, x0, 1, -1))  # fixed axis, value, other axis, direction
    return any(
        abs(start[axis] - at) <= ON_RIM and abs(end[axis] - at) <= ON_RIM and (end[other] - start[other]) * way > 0
        for axis, at, other, way in sides
    )
