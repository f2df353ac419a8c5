"""The page of a data sheet, as a PDF whose lines are lines: drawing, tables, title block and light on one A4.

The same design gives the same bytes: there is no date on it but one that was given.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from bstcad.analysis.used_area import Used, used
from bstcad.report import data_sheet, part_views
from bstcad.report.data_sheet import Sheet
from bstcad.report.drafting import THICK, THIN, Paper, first_angle, wrapped
from bstcad.report.drawing import GREY, styled
from bstcad.report.light_figures import brightest, lit_mean, seen_grey
from bstcad.report.part_views import scale_words

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 297.0, 210.0  # mm, A4
FRAME = (20.0, 10.0, 287.0, 200.0)  # left, low, right, high (ISO 5457)
TABLE, TITLE, ASIDE = 60.5, 205.0, 226.0  # upper edge of the tables, left edge of the title block and of the light
ROW, SMALL, NOTE = 3.57, 2.3, 2.1  # mm: a line of a table, its letters, and those of notes


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

    figure = Figure(figsize=(WIDTH / 25.4, HEIGHT / 25.4), facecolor="white")
    paper = Paper.of(figure)
    left, low, right, high = FRAME
    paper.box(*FRAME, width=0.7)
    paper.line([(left, TABLE), (right, TABLE)], THICK)
    paper.line([(TITLE, low), (TITLE, TABLE)], THICK)
    paper.line([(ASIDE, TABLE), (ASIDE, high)], THIN)
    met = ("back",) if sheet.lens.reflects else ("front", "back")
    patches = dict(zip(met, used(sheet.source, sheet.lens), strict=True))
    names = ("Rear", "Mirror face") if sheet.lens.reflects else ("Front", "Back")
    words = tuple(
        (f"{name}: {said}", said)
        for name, said in zip(names, (data_sheet.in_short(sheet.record.front), "freeform"), strict=True)
    )
    patch = patches["back"]
    used_back = None if patch.shape == "whole" else patch
    views = part_views.views_of(sheet.lens, used_back, words, sheet.mount, sheet.order.origin)
    scale = part_views.draw(paper, views, left, TABLE, ASIDE, high)
    _tables(paper, sheet, patches, names)
    _title_block(paper, sheet, scale_words(scale))
    _light(paper, sheet)
    return figure


# --- the table of ISO 10110 -------------------------------------------------------------------------------------------


def _tables(paper: Paper, sheet: Sheet, patches: Mapping[str, Used], names: Sequence[str]) -> None:
    """Both surfaces, and the material between them."""
    left, low, _, _ = FRAME
    columns = np.linspace(left, TITLE, 4)
    front_says = f"{names[0]} (light enters)" if not sheet.lens.reflects else f"{names[0]} of the plate (dark)"
    back_says = f"{names[1]} (light leaves)" if not sheet.lens.reflects else f"{names[1]} (light meets it)"
    parts = (
        (front_says, data_sheet.front_rows(sheet, patches.get("front"))),
        ("Material and body", data_sheet.body_rows(sheet)),
        (back_says, data_sheet.back_rows(sheet, patches["back"])),
    )
    for k, (heading, rows) in enumerate(parts):
        start, end, y = columns[k] + 1.8, columns[k + 1] - 1.8, TABLE - 4.2
        if k:
            paper.line([(columns[k], low), (columns[k], TABLE)], 0.25)
        paper.text(start, y, heading, 2.6, end - start, weight="bold")
        paper.line([(columns[k], y - 1.7), (columns[k + 1], y - 1.7)], THIN)
        y -= 1.7
        for name, value in rows:
            y -= ROW
            paper.text(start, y, name, SMALL, 23.0, color=GREY)
            paper.text(start + 23.6, y, value, SMALL, end - start - 23.6)


# --- the title block --------------------------------------------------------------------------------------------------


def _title_block(paper: Paper, sheet: Sheet, scale: str) -> None:
    """Name, title, who and when (ISO 7200), scale and projection, and which STEP file this sheet belongs to."""
    _, low, right, _ = FRAME
    record, stated, order, left = sheet.record, sheet.stated, sheet.order, TITLE
    inner = right - left - 3.6
    paper.text(left + 1.8, TABLE - 5.6, record.name, 4.2, inner, weight="bold")
    kind = "freeform mirror" if record.reflects else "freeform lens"
    lines = wrapped(record.title or kind, SMALL, inner, 2)
    for k, line in enumerate(lines):
        paper.text(left + 1.8, TABLE - 10.2 - 3.3 * k, line, SMALL)
    cells = (
        (("Part no.", stated.part_number), ("Drawn by", stated.author), ("Organisation", stated.organisation)),
        (("Date", stated.date), ("Scale", scale), ("Unit", "mm"), ("Sheet", "1/1"), ("Projection", "")),
    )
    level, tall = TABLE - 16.2, 9.0
    for row in cells:
        edges = np.linspace(left, right, len(row) + 1)
        paper.line([(left, level), (right, level)], 0.25)
        for k, (name, value) in enumerate(row):
            if k:
                paper.line([(edges[k], level - tall), (edges[k], level)], THIN)
            room = edges[k + 1] - edges[k] - 2.4
            paper.text(edges[k] + 1.2, level - 2.6, name, 1.8, room, color=GREY)
            paper.text(edges[k] + 1.2, level - 7.2, value or ("" if name == "Projection" else "\u2014"), 3.0, room)
            if name == "Projection":
                first_angle(paper, edges[k] + 2.6, level - 5.9, 3.2)
        level -= tall
    paper.line([(left, level), (right, level)], 0.25)
    notes = (
        f"SHA-256 of {order.file}:",
        *(order.sha256[half] for half in (slice(32), slice(32, None))),
        f"{order.file} is exact and holds; dimensions here are rounded",
        f"bstcad {sheet.version}" + "; lens.step: the lens before it was cut and held" * (sheet.mount is not None),
    )
    for k, note in enumerate(notes):
        paper.text(left + 1.8, level - 3.3 - 2.95 * k, note, NOTE, inner)


# --- what it is for ---------------------------------------------------------------------------------------------------


def _light(paper: Paper, sheet: Sheet) -> None:
    """Target and irradiance, and what the part was designed for."""
    _, _, right, high = FRAME
    start, end, view = ASIDE + 2.4, right - 2.4, sheet.view
    paper.text(start, high - 5.4, "What it is designed for", 2.6, weight="bold")
    width = (end - start - 2.4) / 2
    tall = min(width * (view.y[1] - view.y[0]) / (view.x[1] - view.x[0]), 44.0)
    top = brightest(sheet.target, sheet.irradiance) / lit_mean(sheet.target)
    pictures = (("Target", sheet.target), (f"Traced through {sheet.order.file}", sheet.irradiance))
    for k, (name, values) in enumerate(pictures):
        left, y = start + k * (width + 2.4), high - 9.4 - tall
        inset = paper.axes.figure.add_axes((left / WIDTH, y / HEIGHT, width / WIDTH, tall / HEIGHT))
        shown = np.round(255 * np.clip(values / lit_mean(sheet.target) / top, 0, 1)) / 255
        inset.imshow(view.picture(shown), cmap=seen_grey(), vmin=0, vmax=1, interpolation="none", aspect="auto")
        inset.set(xticks=[], yticks=[])
        inset.spines[:].set(visible=True, color=GREY, linewidth=0.4)
        paper.text(left, y - 3.2, name, NOTE, width)
    pitch = 3.4 if sheet.mount is None else 3.05
    y = _rows(paper, data_sheet.designed_for(sheet), start, end, high - 9.4 - tall - 9.0, pitch)
    if sheet.mount is not None:
        paper.text(start, y - 1.9, f"The part, as in {sheet.order.file}", 2.6, weight="bold")
        _rows(paper, data_sheet.held_rows(sheet.mount, sheet.order.origin), start, end, y - 6.4, pitch)


def _rows(
    paper: Paper, rows: Iterable[tuple[str, str]], start: float, end: float, y: float, pitch: float
) -> float:  # fmt: skip
    """Names and values from y downwards, as far as there is room; where the next would stand."""
    for name, value in rows:
        lines = wrapped(value, NOTE, end - start - 17.0, 3)
        if y - pitch * len(lines) < TABLE:
            paper.text(start, y, "The rest: see the file", NOTE, color=GREY)
            break
        paper.text(start, y, name, NOTE, 16.4, color=GREY)
        for line in lines:
            paper.text(start + 17.0, y, line, NOTE)
            y -= pitch
        y -= 0.5
    return y
