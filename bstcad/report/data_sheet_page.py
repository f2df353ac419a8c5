"""Page of a data sheet, as a PDF whose lines are lines: drawing, tables, title block and light on one A4.

The same design gives the same bytes: there is no date on it but the scene's.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from bstcad.analysis.light import used
from bstcad.report import data_sheet, part_views
from bstcad.report.data_sheet import Row, Sheet
from bstcad.report.drafting import NOTES, THICK, THIN, Paper, wrapped
from bstcad.report.drawing import GREY, styled
from bstcad.report.light_figures import brightest, lit_mean, seen_grey
from bstcad.scene.mount import Mount

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 297.0, 210.0  # mm, A4
FRAME = (20.0, 10.0, 287.0, 200.0)  # left, low, right, high (ISO 5457)
TABLE, TITLE, ASIDE = 60.5, 205.0, 226.0  # upper edge of the tables, left edge of the title block and of the light
ROW, SMALL, HEADING = 3.57, 2.3, 2.6  # mm: a line of a table, its letters, and those of headings
PIXELS = 256  # of a picture of the light, along its longer side at most


def draw(sheet: Sheet) -> bytes:
    """The sheet as PDF."""
    import matplotlib
    from matplotlib.backends.backend_pdf import FigureCanvasPdf

    data = io.BytesIO()
    with matplotlib.rc_context({"pdf.fonttype": 3, "pdf.compression": 6}):
        about = {"Title": f"Data sheet of {sheet.record.name}", "Creator": f"bstcad {sheet.version}"}
        FigureCanvasPdf(page(sheet)).print_pdf(data, metadata=about | {"CreationDate": None})
    return data.getvalue()


@styled
def page(sheet: Sheet) -> Figure:
    """The whole page, A4."""
    from matplotlib.figure import Figure

    paper = Paper.of(figure := Figure(figsize=(WIDTH / 25.4, HEIGHT / 25.4), facecolor="white"))
    (left, low, right, high), lens = FRAME, sheet.lens
    paper.line([(left, low), (right, low), (right, high), (left, high), (left, low), (right, low)], 0.7)
    paper.line([(left, TABLE), (right, TABLE)], THICK)
    paper.line([(TITLE, low), (TITLE, TABLE)], THICK)
    paper.line([(ASIDE, TABLE), (ASIDE, high)], THIN)
    *fronts, back = used(sheet.scene.source, lens)
    names, light = ("Front", "Back"), ("light enters", "light leaves")
    if lens.reflects:
        names, light = ("Rear", "Mirror face"), ("dark", "light meets it")
    forms = data_sheet.in_short(sheet.record.front), "freeform"
    labels = tuple((f"{name}: {form}", form) for name, form in zip(names, forms, strict=True))
    views = part_views.Views(lens, sheet.mount or Mount(), sheet.order.origin, used=back, names=labels)
    scale = part_views.draw(paper, views, left=left, low=TABLE, right=ASIDE, high=high)
    plate = " of the plate" * lens.reflects
    columns = (
        (f"{names[0]}{plate} ({light[0]})", data_sheet.front_rows(sheet, *fronts or (None,))),
        ("Material and body", data_sheet.body_rows(sheet)),
        (f"{names[1]} ({light[1]})", data_sheet.back_rows(sheet, back)),
    )
    for k, (heading, rows) in enumerate(columns):
        _table(paper, left + k * (TITLE - left) / 3, heading, rows)
    _title_block(paper, sheet, part_views.scale_words(scale))
    _light(paper, sheet)
    return figure


def _table(paper: Paper, left: float, heading: str, rows: Iterable[Row]) -> None:
    """One column of the tables of ISO 10110."""
    right, y = left + (TITLE - FRAME[0]) / 3, TABLE - 4.2
    start, end = left + 1.8, right - 1.8
    if left > FRAME[0]:
        paper.line([(left, FRAME[1]), (left, TABLE)], 0.25)
    paper.text(start, y, heading, HEADING, room=end - start, weight="bold")
    paper.line([(left, y - 1.7), (right, y - 1.7)])
    for k, (name, value) in enumerate(rows, start=1):
        level = y - 1.7 - k * ROW
        paper.text(start, level, name, SMALL, room=23.0, color=GREY)
        paper.text(start + 23.6, level, value, SMALL, room=end - start - 23.6)


def _title_block(paper: Paper, sheet: Sheet, scale: str) -> None:
    """Name, title, author and date (ISO 7200), scale and projection, and the STEP file that the sheet belongs to."""
    record, part, order, left, right = sheet.record, sheet.scene.part, sheet.order, TITLE, FRAME[2]
    room = right - left - 3.6
    paper.text(left + 1.8, TABLE - 5.6, record.name, 4.2, room=room, weight="bold")
    kind = "freeform mirror" if record.reflects else "freeform lens"
    for k, line in enumerate(wrapped(record.title or kind, SMALL, room, 2)):
        paper.text(left + 1.8, TABLE - 10.2 - 3.3 * k, line, SMALL)
    cells = (
        (("Part no.", part.number), ("Drawn by", part.author), ("Organisation", part.organisation)),
        (("Date", part.date), ("Scale", scale), ("Unit", "mm"), ("Sheet", "1/1"), ("Projection", " ")),
    )
    level, tall = TABLE - 16.2, 9.0
    for row in cells:
        edges = np.linspace(left, right, len(row) + 1)
        paper.line([(left, level), (right, level)], 0.25)
        for edge in edges[1:-1]:
            paper.line([(edge, level - tall), (edge, level)])
        for edge, (name, value) in zip(edges, row, strict=False):
            space = edges[1] - left - 2.4
            paper.text(edge + 1.2, level - 2.6, name, 1.8, room=space, color=GREY)
            paper.text(edge + 1.2, level - 7.2, value or "\u2014", 3.0, room=space)
        level -= tall
    paper.first_angle(edges[-2] + 2.6, level + tall - 5.9, 3.2)
    paper.line([(left, level), (right, level)], 0.25)
    notes = (
        f"SHA-256 of {order.file}:", order.sha256[:32], order.sha256[32:],
        f"{order.file} is exact and holds; dimensions here are rounded",
        f"bstcad {sheet.version}" + "; lens.step: the lens before it was cut and held" * (sheet.mount is not None),
    )  # fmt: skip
    for k, note in enumerate(notes):
        paper.text(left + 1.8, level - 3.3 - 2.95 * k, note, NOTES, room=room)


def _light(paper: Paper, sheet: Sheet) -> None:
    """Target and irradiance, and the purpose of the part."""
    _, _, right, high = FRAME
    start, end, view = ASIDE + 2.4, right - 2.4, sheet.view
    paper.text(start, high - 5.4, "What it is designed for", HEADING, weight="bold")
    width = (end - start - 2.4) / 2
    tall = min(width * (view.y[1] - view.y[0]) / (view.x[1] - view.x[0]), 44.0)
    target, irradiance = _few(sheet.target), _few(sheet.irradiance)
    mean = lit_mean(target)
    top = brightest(target, irradiance) / mean
    for k, (name, values) in enumerate((("Target", target), (f"Traced through {sheet.order.file}", irradiance))):
        left, y = start + k * (width + 2.4), high - 9.4 - tall
        inset = paper.axes.figure.add_axes((left / WIDTH, y / HEIGHT, width / WIDTH, tall / HEIGHT))
        shown = np.round(255 * np.clip(values / mean / top, 0, 1)) / 255
        inset.imshow(view.picture(shown), cmap=seen_grey(), vmin=0, vmax=1, interpolation="none", aspect="auto")
        inset.set(xticks=[], yticks=[])
        inset.spines[:].set(visible=True, color=GREY, linewidth=0.4)
        paper.text(left, y - 3.2, name, NOTES, room=width)
    pitch = 3.4 if sheet.mount is None else 3.05
    y = _rows(paper, data_sheet.purpose_rows(sheet), high - 9.4 - tall - 9.0, pitch)
    if sheet.mount is not None:
        paper.text(start, y - 1.9, f"The part, as in {sheet.order.file}", HEADING, weight="bold")
        _rows(paper, data_sheet.mount_rows(sheet.mount, sheet.order.origin), y - 6.4, pitch)


def _few(picture: np.ndarray) -> np.ndarray:
    """The picture on at most PIXELS along its longer side, each the mean of whole pixels."""
    every = -(-max(picture.shape) // PIXELS)
    starts = [np.arange(0, side, every) for side in picture.shape]
    counts = np.outer(*(np.diff([*start, side]) for start, side in zip(starts, picture.shape, strict=True)))
    return np.add.reduceat(np.add.reduceat(picture, starts[0], 0), starts[1], 1) / counts


def _rows(paper: Paper, rows: Iterable[Row], y: float, pitch: float) -> float:
    """Names and values beside the drawing from y downwards, as far as there is room; y of the next row."""
    start, end = ASIDE + 2.4, FRAME[2] - 2.4
    for name, value in rows:
        lines = wrapped(value, NOTES, end - start - 17.0, 3)
        if y - pitch * len(lines) < TABLE:
            paper.text(start, y, "The rest: see the file", NOTES, color=GREY)
            break
        paper.text(start, y, name, NOTES, room=16.4, color=GREY)
        for line in lines:
            paper.text(start + 17.0, y, line, NOTES)
            y -= pitch
        y -= 0.5
    return y
