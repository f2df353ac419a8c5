"""What other programs make of a lens, beside what bstcad makes of it: pictures, and the words under them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from bstcad.report.drawing import new_figure, png, round_up, steps, styled
from bstcad.report.light_figures import View, brightest, draw_picture, footnote, lit_mean, rrmsd, seen_grey, tilted
from bstcad.report.record import Judge
from bstcad.report.units import duration, number, percent, quantity

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LIGHT = {
    "none": "without losses at the faces",
    "Fresnel": "with what bare faces reflect taken off (Fresnel), whatever the scene asks for",
}


@dataclass(frozen=True, eq=False)
class Pictures:
    """Of one judge, (rows, columns) in coordinates, of one sum."""

    name: str
    target: np.ndarray = field(repr=False)
    ours: np.ndarray = field(repr=False)
    theirs: np.ndarray = field(repr=False)


def key(name: str) -> str:
    """Of a judge's picture in a report."""
    return f"judge_{name}"


def draw_judges(judges: Sequence[Pictures], view: View) -> dict[str, bytes]:
    """The pictures of all judges as PNG bytes by name."""
    return {key(judge.name): png(side_by_side(judge, view)) for judge in judges}


@styled
def side_by_side(judge: Pictures, view: View) -> Figure:
    """Target, bstcad's picture, the judge's and the signed difference of these two, in % of the mean lit irradiance."""
    unit = lit_mean(judge.target)
    error = 100.0 * (judge.theirs - judge.ours) / unit
    most = round_up(float(np.percentile(np.abs(error), 99.5)))
    figure = new_figure(11.0, 0.7 + 2.2 * view.proportion, layout="compressed")
    panels = figure.subplots(1, 4, sharey=True)
    top = max(brightest(judge.target, picture) for picture in (judge.ours, judge.theirs)) / unit
    shades = {"cmap": seen_grey(), "vmin": 0.0, "vmax": top}
    for axes, picture in zip(panels, (judge.target, judge.ours, judge.theirs), strict=False):
        shown = draw_picture(axes, picture / unit, view, **shades)
    signed = draw_picture(panels[3], error, view, cmap=steps("RdBu_r", 41), vmin=-most, vmax=most)
    panels[0].set_title("Target")
    panels[1].set_title(f"By bstcad (RRMSD {rrmsd(judge.target, judge.ours):.3g})")
    panels[2].set_title(f"By {judge.name} (RRMSD {rrmsd(judge.target, judge.theirs):.3g})")
    panels[3].set_title(f"{judge.name} − bstcad")
    panels[0].set_ylabel("y (mm)")
    figure.colorbar(shown, ax=panels[:3], label="irradiance / mean lit", fraction=0.04, pad=0.015)
    figure.colorbar(signed, ax=panels[3], label="% of mean lit irradiance", fraction=0.08, pad=0.03, extend="both")
    footnote(figure, f"{view.words}.{tilted(view.tilt)}")
    return figure


def words(judge: Judge) -> str:
    """How a judge's picture came about, and what its own geometry is off by."""
    columns, rows = judge.pixels
    return (
        f"{judge.rays:,} rays".replace(",", "\u202f")
        + f" in {duration(judge.seconds)} on {columns} × {rows} pixels, {LIGHT[judge.losses]}. "
        f"Its faces are off those of the file by {quantity(judge.heights_off, 'mm')} and "
        f"{quantity(1e6 * judge.slopes_off, 'µrad')} (RMS), which moves light by {number(judge.moved_by)} pixels. "
        f"Of the source's light {percent(judge.on_target)} falls on the target by {judge.name}, "
        f"{percent(judge.on_target_ours)} by bstcad."
    )
