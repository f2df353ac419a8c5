"""Files of tool paths: the table of a spiral, the G-code and the table of a raster, and the sentences about them.

Tables are in mm and degrees, with as many decimals as the tolerance of the path requires.  The text beside each path
states tool, zero point, pitch, and what the check of the written moves against the exact face found
(toolpath/swept_volume.py).
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from bstcad.cad.tiling import Cell, Span
from bstcad.figures.shop_figures import left_figure
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK, FRONT
from bstcad.optics.surfaces.bspline import require_net
from bstcad.report.units import quantity
from bstcad.toolpath import gcode
from bstcad.toolpath import raster as rasters
from bstcad.toolpath import spiral as spirals
from bstcad.toolpath.chords import digits, refuse_many
from bstcad.toolpath.cutting import Cutting
from bstcad.toolpath.machined_face import MachinedFace, RoundTool
from bstcad.toolpath.raster import RAPID_FEED, SAFE_HEIGHT, Raster, raster
from bstcad.toolpath.spiral import ANGLE_DIGITS, Spiral, spiral
from bstcad.toolpath.swept_volume import LEFT, Swept, check_raster, check_spiral

# Steepest face (degrees) that a tool reaches, its name, and number of places of a path over a plane, by kind of path.
PLANES = {
    "spiral": (spirals.MAX_NOSE_SLOPE, "nose", spirals.flat_places),
    "raster": (rasters.MAX_BALL_SLOPE, "ball", rasters.flat_places),
}
MIN_EXCESS = 2.0  # points of a path over a plane / most points, from which a design cannot shorten the path enough
ROWS_AT_A_TIME = 100_000  # rows of a table that are formatted at a time


def toolpath_files(
    kind: str, lens: Lens, cutting: Cutting, name: str, cells: Sequence[Cell] = ()
) -> Iterator[tuple[str, str | bytes]]:
    """Yield (name, content) of the files of a path, "spiral" or "raster", over each face of a lens that is a net.

    If the tool does not reach a part of the face, a picture shows where.
    name: of the lens, for the heading.  cells: tiles, each of which has a raster of its own; empty: the whole lens.
    ValueError if a face is too steep for the tool, or the path too long.
    """
    faces = dict(machined_faces(lens))
    for side, face in faces.items():
        file = f"toolpath-{kind}" + ("" if side == BACK else f"-{side}")
        if kind == "spiral":
            turned = spiral(face, cutting)
            found, sentences = check_spiral(turned), [*_of_part(name, side), *spiral_words(turned)]
            yield f"{file}.csv", _table("c_deg,x_mm,z_mm", _formats(turned), *_columns(turned, face))
            yield from _check_files(file, found, turned.tool, sentences, cusp=turned.passes.cusp)
            continue
        levels = -_farthest(lens, faces, side), face.highest
        for cell in cells or (None,):
            part = face if cell is None else face.part(*_extent(cell, side))
            milled = raster(part, levels, cutting)
            found, sentences = check_raster(milled), [*_of_part(name, side), *raster_words(milled, cell)]
            own = file if cell is None else f"{file}-{cell.name}"
            yield f"{own}.nc", gcode.gcode(milled, [*sentences, *_of_check(found, milled.tool)])
            yield f"{own}.csv", raster_table(milled)
            yield from _check_files(own, found, milled.tool, sentences, cusp=milled.spacing.cusp)


def refuse_hopeless(
    kind: str, lens: Lens, cutting: Cutting, tailored: Sequence[str], cells: Sequence[Cell] = ()
) -> None:
    """Raise ValueError if a path over a lens before tailoring can only fail, whatever shape the tailored faces get.

    A face that is not tailored is too steep, or a path over planes is more than MIN_EXCESS times too long.
    """
    steepest, tool, places = PLANES[kind]
    for side, face in machined_faces(lens):
        if side not in tailored:
            face.refuse_steep(steepest, tool)
        for cell in (cells if kind == "raster" else ()) or (None,):
            refuse_many(places(face if cell is None else face.part(*_extent(cell, side)), cutting) / MIN_EXCESS)


def _check_files(
    file: str, found: Swept, tool: RoundTool, sentences: Sequence[str], cusp: float
) -> Iterator[tuple[str, str | bytes]]:
    """Yield the picture of what the tool does not reach, if any, and the text with all sentences about a path."""
    if found.unreached:
        yield f"{file}-unreached.png", left_figure(found.points, found.clearance, LEFT * cusp)
    yield f"{file}.txt", " ".join([*sentences, *_of_check(found, tool)]) + "\n"


def _farthest(lens: Lens, faces: Mapping[str, MachinedFace], side: str) -> float:
    """Return how far (mm) the face opposite to a side reaches from z = 0 of the frame, away from the tool."""
    opposite = FRONT if side == BACK else BACK
    if opposite in faces:
        return faces[opposite].highest
    return -(lens.front.z + lens.front.sags(lens.plan)[0])


def _extent(cell: Cell, side: str) -> tuple[Span, Span]:
    """Return x and y (mm) of the ends of a tile in the frame of a machined face."""
    x, y = cell.extent
    return (x, y) if side == BACK else ((-x[1], -x[0]), y)


def machined_faces(lens: Lens) -> Iterator[tuple[str, MachinedFace]]:
    """Yield name and face of the back, and of the front if it is a net."""
    yield BACK, MachinedFace.back(lens.back_net, lens.plan)
    if lens.front.is_net:
        yield FRONT, MachinedFace.front(require_net(lens.front), lens.plan)


# --- tables -----------------------------------------------------------------------------------------------------------


def _columns(path: Spiral, face: MachinedFace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return C (degrees), X and Z (mm) of the nose's lowest point; Z = 0 is the vertex of the face."""
    return path.angle, path.x, path.z - face.vertex_z


def _formats(path: Spiral) -> tuple[str, str, str]:
    places = digits(path.cutting.finish[1])
    return f"%.{ANGLE_DIGITS}f", f"%.{places}f", f"%.{places}f"


def raster_table(path: Raster) -> str:
    """Return a CSV table of the points of a raster: X, Y and Z of the ball's lowest point, and the kind of its pass.

    Columns: pass (number), roughing (1 or 0), x_mm, y_mm, z_mm.  Between passes the tool goes up and across.
    """
    counts = [len(each.points) for each in path.passes]
    number, rough = np.repeat(np.arange(len(counts)), counts), np.repeat([each.rough for each in path.passes], counts)
    points = np.concatenate([each.points for each in path.passes]) + (0.0, 0.0, path.lift)
    places = digits(path.cutting.finish[1])
    return _table("pass,roughing,x_mm,y_mm,z_mm", ("%d", "%d", *[f"%.{places}f"] * 3), number, rough, *points.T)


def _table(heading: str, formats: tuple[str, ...], *columns: np.ndarray) -> str:
    """Return a CSV table; formats of thousands of rows at a time are several times faster than row by row."""
    row, rows, text = ",".join(formats) + "\n", np.column_stack(columns), io.StringIO()
    text.write(heading + "\n")
    for start in range(0, len(rows), ROWS_AT_A_TIME):
        part = rows[start : start + ROWS_AT_A_TIME]
        text.write(row * len(part) % tuple(part.ravel().tolist()))
    return text.getvalue()


# --- sentences --------------------------------------------------------------------------------------------------------


def _of_part(name: str, side: str) -> Iterator[str]:
    turned = ", turned over about the y axis: X and Z are those of the lens times -1" if side != BACK else ""
    yield f"{name}, {side}{turned}."


def spiral_words(path: Spiral) -> Iterator[str]:
    """Yield sentences on the tool, the frame and the size of a spiral."""
    yield f"Nose of radius {path.tool.radius:g} mm, round in X-Z only and compensated in this plane."
    yield (
        "C is the angle of the part under the tool, from +x towards +y, X the distance of the nose from the axis, and "
        "Z the height of its lowest point above the vertex of the face."
    )
    pitch, count = quantity(path.passes.pitch, "mm"), f"{len(path.x):,}".replace(",", " ")
    yield f"{path.turns:.0f} turns of {pitch}, {count} points, straight moves within {_tolerance(path.cutting)}."
    clearance = math.degrees(math.atan(path.slope_along_cut))
    yield f"The face falls by at most {clearance:.3g} degrees along the cut: the tool needs a larger clearance angle."
    if (beyond := path.tool.radius * math.sin(math.atan(path.slope_at_axis))) > path.passes.pitch:
        yield f"The face is tilted on the axis, where the nose touches it up to {quantity(beyond, 'mm')} beyond."


def raster_words(path: Raster, cell: Cell | None = None) -> Iterator[str]:
    """Yield sentences on the tool, the blank, the zero point and the time of a raster over a lens, or over a tile."""
    stock, depth = path.cutting.roughing
    yield f"Ball end mill of radius {path.tool.radius:g} mm; Z is the lowest point of the ball."
    width, height = (2 * half for half in path.tool.face.outline.half_extent)
    part, axis = ("lens", "on the axis of the lens") if cell is None else (cell.name, _middle(cell))
    yield (
        f"Blank: flat, {path.thickness:.6g} mm thick, larger than the {part} of {width:g} mm x {height:g} mm by the "
        f"room to hold it; its top lies {stock:g} mm above the highest point of the lens, its bottom at the outermost "
        "point of the other face."
    )
    yield f"Zero point: X0 Y0 {axis}, Z0 on the {path.cutting.zero} of the blank."
    if path.cutting.units == "inch":
        yield "The moves of the G-code are in inches; this text is in millimetres."
    cut = f"Roughing in steps of {depth:g} mm leaves {stock:g} mm. " if stock else "There is no roughing. "
    lines = f"Finish in lines along {path.cutting.along} with a pitch of {quantity(path.spacing.pitch, 'mm')}"
    yield f"{cut}{lines}, straight moves within {_tolerance(path.cutting)}. The lowest Z is {path.deepest:.3f} mm."
    yield (
        f"Feed {path.cutting.speed:g} mm/min, also along falling parts of the face, and a third of it in plunges "
        f"straight down at the start of each pass; rapid moves at Z = {SAFE_HEIGHT + path.lift:.6g} mm. Time "
        f"without acceleration about {_time(path.minutes)}, with rapid moves of {RAPID_FEED:g} mm/min."
    )
    yield "Start the spindle first: the file has no commands for the spindle."


def _middle(cell: Cell) -> str:
    x, y = (round(sum(span) / 2, 9) + 0.0 for span in cell.extent)
    return f"at the middle of the tile, x = {x:g} mm, y = {y:g} mm of the lens"


def _of_check(found: Swept, tool: RoundTool) -> Iterator[str]:
    yield (
        f"Check of the moves against the exact face at {len(found.points):,} points, and by a search ".replace(",", " ")
        + "about the worst places: deepest gouge "
        + f"{quantity(found.gouge, 'mm')}, highest cusp {quantity(found.cusp, 'mm')}."
    )
    if found.unreached:
        widest = 1 / tool.face.shape.valley
        yield (
            f"The tool does not reach {100 * found.unreached:.2g} % of the face, where {quantity(found.left, 'mm')} "
            f"stays at most: the tightest valley has a radius of {widest:.3g} mm; give a smaller tool_radius, or "
            "design with lens.tool_radius."
        )


def _tolerance(cutting: Cutting) -> str:
    return quantity(cutting.finish[1], "mm")


def _time(minutes: float) -> str:
    return f"{minutes:.2g} min" if minutes < 90 else f"{minutes / 60:.2g} h"
