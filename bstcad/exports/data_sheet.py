"""Data sheet of a part, after ISO 10110-1 and -10: an A4 page with drawing, tables, title block and light, as PDF.

data_sheet.txt.j2 has the text of the tables.  Equal designs give equal bytes: the only date is that of the scene.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from bstcad.analysis.light import needed_apertures
from bstcad.exports import part_views
from bstcad.exports.exports import across
from bstcad.exports.part_views import (
    LINE_PITCH,
    NOTES,
    PRINTED,
    SMALLER,
    THICK,
    THIN,
    Paper,
    broken,
    fitted,
    kinds_of_holes,
    wall_words,
)
from bstcad.figures.drawing import GREY, styled
from bstcad.figures.light_figures import View, brightest, srgb_grey
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK
from bstcad.optics.surfaces.outlines import Outline
from bstcad.report.goal_figures import GoalFigures, Photometry
from bstcad.report.prescription import PART, Order, prescription
from bstcad.report.units import Rows, mm, rounded_up, tables
from bstcad.scene.mount import Mount, as_cut
from bstcad.scene.quality import settings_of
from bstcad.scene.scene import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 297.0, 210.0  # size of the page, A4 (mm)
FRAME = (20.0, 10.0, 287.0, 200.0)  # left, lower, right and upper edge of the frame (mm, ISO 5457)
TABLE_TOP, TITLE_LEFT, LIGHT_LEFT = 60.5, 205.0, 226.0  # y of the tables' top; x where title block and light begin (mm)
ROW_HEIGHT, TABLE_FONT, HEADING_FONT = 3.57, 2.3, 2.6  # height of a table row, font sizes of rows and headings (mm)
PITCH, MOST_LINES = 3.4, 6  # distance of lines beside the drawing (mm); most lines of a text of the title block
PICTURE_PIXELS = 256  # largest number of pixels along the longer side of a picture of the light
APERTURE_ROUNDING = 1e-4  # relative amount by which a printed clear aperture may be too small


@dataclass(frozen=True, eq=False, kw_only=True)
class DataSheet:
    """Content of a data sheet."""

    scene: Scene
    designed: Lens  # lens as designed, not cut to the rim of its mount
    shape: Mapping[str, float | None]  # facts of analysis.shape.describe inside the mount's rim, volume of lens.step
    order: Order  # order for the shop; order.file is the STEP file that the sheet describes
    target: np.ndarray  # picture of the first target (rows, columns), row 0 at y max, column 0 at x min
    irradiance: np.ndarray  # irradiance on the first target, in the form and with the sum of `target`
    figures: Sequence[GoalFigures]  # figures of the light on each target
    passed: bool  # True if every check passed
    version: str  # version of the program
    photometry: Sequence[Photometry] = ()  # absolute figures of each target; empty: the source's flux is not known

    @property
    def mount(self) -> Mount | None:
        """Mount of the lens in part.step; None: the sheet describes lens.step."""
        return self.scene.mount if self.order.file == PART else None

    @cached_property
    def lens(self) -> Lens:
        """Lens inside the rim of its mount."""
        return as_cut(self.designed, self.mount)

    @cached_property
    def record(self) -> dict[str, Any]:
        """Prescription of the lens inside the rim."""
        return prescription(self.scene, self.lens, self.shape)

    @cached_property
    def apertures(self) -> dict[str, Outline | None]:
        """Clear aperture (x, y) that the light needs on each face; None: the whole face, as on a face in a chart."""
        found = needed_apertures(self.scene.light, self.lens)
        return found | {face.name: None for face in self.lens.optical_faces if not face.surface.chart.flat}

    @property
    def tables(self) -> dict[str, Rows]:
        """Tables by their headings: front, body, back, source and target, and the mount of a part."""
        return tables(
            "data_sheet.txt.j2", lens=self.record, passes=self.lens.passes, order=self.order, shape=self.shape,
            mount=self.mount, light=self.scene.source, passed=self.passed, photometry=self.photometry,
            asked=self.scene.limits_light, folded=self.scene.folded,
            pairs=list(zip(self.scene.targets, self.figures, strict=True)), across=across, walls=wall_words,
            apertures={face: _aperture(patch, self.lens.plan) for face, patch in self.apertures.items()},
            kinds_of_holes=kinds_of_holes,
            limits={f.name: settings_of(self.scene.tolerance, f"{f.name}.form").get("limit") for f in self.lens.faces},
        )  # fmt: skip


def _aperture(patch: Outline | None, outline: Outline) -> str:
    """Return a clear aperture in words, rounded up to 3 digits, a rectangle within `outline`; None: the whole face."""

    def up(value: float) -> float:
        return float(rounded_up(value * (1 - APERTURE_ROUNDING)))

    if patch is None:
        return "the whole face"
    if patch.is_round:
        return f"\u00d8e {mm(up(2 * patch.radius))} mm"
    sides = zip(patch.half_extent, outline.half_extent, strict=True)
    return " \u00d7 ".join(mm(min(up(2 * side), 2 * half)) for side, half in sides) + " mm (x \u00d7 y)"


# --- the page ---------------------------------------------------------------------------------------------------------


def draw(sheet: DataSheet) -> bytes:
    """Return the sheet as PDF."""
    import matplotlib
    from matplotlib.backends.backend_pdf import FigureCanvasPdf

    data = io.BytesIO()
    with matplotlib.rc_context({"pdf.fonttype": 3, "pdf.compression": 6}):
        about = {"Title": f"Data sheet of {sheet.scene.name}", "Creator": f"bstcad {sheet.version}"}
        FigureCanvasPdf(page(sheet)).print_pdf(data, metadata=about | {"CreationDate": None})
    return data.getvalue()


@styled
def page(sheet: DataSheet) -> Figure:
    """Return the whole page as a figure."""
    from matplotlib.figure import Figure

    paper = Paper.of(figure := Figure(figsize=(WIDTH / 25.4, HEIGHT / 25.4), facecolor="white"))
    left, low, right, high = FRAME
    paper.line([(left, low), (right, low), (right, high), (left, high), (left, low), (right, low)], 0.7)
    paper.line([(left, TABLE_TOP), (right, TABLE_TOP)], THICK)
    paper.line([(TITLE_LEFT, low), (TITLE_LEFT, TABLE_TOP)], THICK)
    paper.line([(LIGHT_LEFT, TABLE_TOP), (LIGHT_LEFT, high)], THIN)
    passes, forms = sheet.lens.passes, [(face.name, _form(sheet, face.name)) for face in sheet.lens.faces]
    names = tuple((f"{passes.name(face).capitalize()}: {form}", form) for face, form in forms)
    used = sheet.apertures[BACK]
    views = part_views.Views(sheet.lens, sheet.mount or Mount(), sheet.order.origin, used=used, names=names)
    scale = part_views.draw(paper, views, left=left, low=TABLE_TOP, right=LIGHT_LEFT, high=high)
    tables = list(sheet.tables.items())
    for k, (heading, rows) in enumerate(tables[:3]):
        _column(paper, left + k * (TITLE_LEFT - left) / 3, heading, rows)
    _title_block(paper, sheet, part_views.scale_words(scale))
    paper.text(LIGHT_LEFT + 2.4, high - 5.4, tables[3][0], HEADING_FONT, weight="bold")
    _write_tables(paper, tables[3:], _light(paper, sheet, high - 9.4))
    return figure


def _form(sheet: DataSheet, name: str) -> str:
    """Return the form of a face, such as "R 50 CX"; CX (convex): centre of curvature on the +z side, else CC."""
    face = sheet.record[name]
    radii = {name.removeprefix("radius"): radius for name, radius in face.items() if name[:6] == "radius" and radius}
    words = [f"R{way} {abs(radius):.5g} {'CX' if radius > 0 else 'CC'}" for way, radius in radii.items()]
    return "freeform" if face["kind"] == "bspline" else ", ".join(words) or "plane"


def _column(paper: Paper, left: float, heading: str, rows: Rows) -> None:
    right, y = left + (TITLE_LEFT - FRAME[0]) / 3, TABLE_TOP - 4.2
    start, end = left + 1.8, right - 1.8
    if left > FRAME[0]:
        paper.line([(left, FRAME[1]), (left, TABLE_TOP)], 0.25)
    paper.text(start, y, heading, HEADING_FONT, room=end - start, weight="bold")
    paper.line([(left, y - 1.7), (right, y - 1.7)])
    rooms = 23.0, end - start - 23.6
    lines, scale = _set(rows, rooms, TABLE_FONT, (y - 1.7 - FRAME[1] - 1.0) / ROW_HEIGHT)
    level = y - 1.7
    for cells in lines:
        for text, place, colour in zip(cells, (start, start + 23.6), (GREY, "black"), strict=True):
            for k, line in enumerate(text, start=1):
                paper.text(place, level - k * ROW_HEIGHT * scale, line, TABLE_FONT * scale, color=colour)
        level -= max(map(len, cells)) * ROW_HEIGHT * scale


def _set(rows: Rows, rooms: tuple[float, float], size: float, height: float, gap: float = 0.0) -> tuple[Any, float]:
    """Return (lines of each cell of each row, scale): rows of names and values, as large as fits.

    rooms: widths (mm) of names and values.  height: room for so many lines of the full size; gap: of a row, in lines.
    """
    scale = 1.0
    while True:
        lines = [
            tuple(broken(cell, scale * size, PRINTED * room) for cell, room in zip(row, rooms, strict=True))
            for row in rows
        ]
        if scale * sum(max(map(len, cells)) + gap for cells in lines) <= height:
            return lines, scale
        scale *= SMALLER


def _title_block(paper: Paper, sheet: DataSheet, scale: str) -> None:
    """Draw name, title, author and date (ISO 7200), scale and projection, and the SHA-256 of the STEP file."""
    scene, part, order, left, right = sheet.scene, sheet.scene.part, sheet.order, TITLE_LEFT, FRAME[2]
    room = right - left - 3.6
    paper.text(left + 1.8, TABLE_TOP - 5.6, scene.name, 4.2, room=room, weight="bold")
    title = scene.title or f"freeform {scene.optic}"
    _in_box(paper, left + 1.8, TABLE_TOP - 7.6, text=title, size=TABLE_FONT, room=room, height=7.6)
    cells = (
        (("Part no.", part.number), ("Drawn by", part.author), ("Organisation", part.organisation)),
        (("Date", part.date), ("Scale", scale), ("Unit", "mm"), ("Sheet", "1/1"), ("Projection", " ")),
    )
    level, height = TABLE_TOP - 16.2, 9.0
    for row in cells:
        edges = np.linspace(left, right, len(row) + 1)
        paper.line([(left, level), (right, level)], 0.25)
        for edge in edges[1:-1]:
            paper.line([(edge, level - height), (edge, level)])
        for edge, (name, value) in zip(edges, row, strict=False):
            space = edges[1] - left - 2.4
            paper.text(edge + 1.2, level - 2.6, name, 1.8, room=space, color=GREY)
            _in_box(paper, edge + 1.2, level - 3.2, text=value or "\u2014", size=3.0, room=space, height=height - 3.8)
        level -= height
    paper.first_angle(edges[-2] + 2.6, level + height - 5.9, 3.2)
    paper.line([(left, level), (right, level)], 0.25)
    notes = (
        f"SHA-256 of {order.file}:",
        order.sha256[:32],
        order.sha256[32:],
        f"{order.file} is exact and binding; dimensions here are rounded",
        f"bstcad {sheet.version}" + "; lens.step: the lens without cut and mount" * (sheet.mount is not None),
    )
    for k, note in enumerate(notes):
        paper.text(left + 1.8, level - 3.3 - 2.95 * k, note, NOTES, room=room)


def _in_box(paper: Paper, x: float, top: float, text: str, size: float, *, room: float, height: float) -> None:
    """Write text in a box below `top`, of width `room` and this height (mm), in as many lines as make it largest."""
    settings = (
        fitted(text, min(size, height / (1 + LINE_PITCH * (most - 1))), PRINTED * room, most=most)
        for most in range(1, MOST_LINES + 1)
    )
    lines, size = max(settings, key=lambda each: each[1])
    free = height - size * (1 + LINE_PITCH * (len(lines) - 1))
    for k, line in enumerate(lines):
        paper.text(x, top - free / 2 - size * (0.85 + LINE_PITCH * k), line, size)


def _light(paper: Paper, sheet: DataSheet, y: float) -> float:
    """Draw the target and the irradiance with their upper edges at y; return y of the first row below them (mm)."""
    start, end, view = LIGHT_LEFT + 2.4, FRAME[2] - 2.4, View.of(sheet.scene)
    width = (end - start - 2.4) / 2
    height = min(width * (view.y[1] - view.y[0]) / (view.x[1] - view.x[0]), 44.0)
    target, irradiance = _reduced(sheet.target), _reduced(sheet.irradiance)
    top, y = brightest(target, irradiance), y - height
    for k, (name, values) in enumerate((("Target", target), (f"Traced through {sheet.order.file}", irradiance))):
        left = start + k * (width + 2.4)
        inset = paper.axes.figure.add_axes((left / WIDTH, y / HEIGHT, width / WIDTH, height / HEIGHT))
        tones = np.round(255 * np.clip(values / top, 0, 1)) / 255
        inset.imshow(view.picture(tones), cmap=srgb_grey(), vmin=0, vmax=1, interpolation="none", aspect="auto")
        inset.set(xticks=[], yticks=[])
        inset.spines[:].set(visible=True, color=GREY, linewidth=0.4)
        paper.text(left, y - 3.2, name, NOTES, room=width)
    return y - 9.0


def _reduced(picture: np.ndarray) -> np.ndarray:
    """Return the picture averaged over blocks of pixels, so that its longer side has at most PICTURE_PIXELS."""
    from PIL import Image

    return np.asarray(Image.fromarray(picture.astype(np.float32)).reduce(-(-max(picture.shape) // PICTURE_PIXELS)))


def _write_tables(paper: Paper, tables: Sequence[tuple[str, Rows]], y: float) -> None:
    """Write tables beside the drawing from y down, all but the first with their headings, as large as fits."""
    start, end = LIGHT_LEFT + 2.4, FRAME[2] - 2.4
    rooms, rows = (16.4, end - start - 17.0), [row for _, each in tables for row in each]
    free = y - TABLE_TOP - 1.0 - 6.4 * (len(tables) - 1)
    lines, scale = _set(rows, rooms, NOTES, free / PITCH, gap=0.15)
    done = 0
    for k, (heading, each) in enumerate(tables):
        if k:
            paper.text(start, y - 1.9, heading, HEADING_FONT, weight="bold")
            y -= 6.4
        for cells in lines[done : done + len(each)]:
            for text, place, colour in zip(cells, (start, start + 17.0), (GREY, "black"), strict=True):
                for line, content in enumerate(text):
                    paper.text(place, y - line * PITCH * scale, content, NOTES * scale, color=colour)
            y -= (max(map(len, cells)) + 0.15) * PITCH * scale
        done += len(each)
