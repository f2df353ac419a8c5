"""The light of a spectrum, line by line: dispersion sends each line of it to a slightly different place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from bstcad.optics.measure import Line
from bstcad.report.colours import balanced
from bstcad.report.drawing import new_figure, styled
from bstcad.report.light_figures import View, brightest, draw_picture, footnote, lit_mean, rrmsd, seen_grey
from bstcad.scene.tones import to_srgb

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ACROSS = 4  # pictures in a row
PANEL, TALLEST = 2.4, 4.8  # inches: width of a picture, and at most its height


@styled
def lines_apart(target: np.ndarray, irradiance: np.ndarray, lines: Sequence[Line], view: View) -> Figure:
    """All lines together in colour, then the picture that each of them makes by itself.

    target, irradiance by all lines, and pictures: (rows, columns) in coordinates, one sum.
    """
    unit = lit_mean(target)
    top = brightest(target, irradiance) / unit
    rows = -(-(1 + len(lines)) // ACROSS)
    tall = PANEL * (view.y[1] - view.y[0]) / (view.x[1] - view.x[0])
    figure = new_figure(11.0, 0.6 + rows * (0.6 + min(tall, TALLEST)), layout="compressed")
    panels = figure.subplots(rows, ACROSS, sharey=True, sharex=True, squeeze=False).ravel()
    colours = balanced(
        [line.picture for line in lines], [line.wavelength for line in lines], [line.share for line in lines]
    )
    draw_picture(panels[0], to_srgb(np.clip(colours / unit / top, 0.0, 1.0)), view)
    panels[0].set_title("All lines")
    for axes, line in zip(panels[1:], lines, strict=False):
        draw_picture(axes, line.picture / unit, view, cmap=seen_grey(), vmin=0.0, vmax=top)
        axes.set_title(f"{line.wavelength:g} nm (RRMSD {rrmsd(target, line.picture):.3g})")
    for axes in panels[1 + len(lines) :]:
        axes.set_visible(False)
    for axes in panels[::ACROSS]:
        axes.set_ylabel("y (mm)")
    footnote(
        figure,
        f"{view.words}.  In colour as a camera balanced to the source's white sees it: where it is not grey, the lines "
        "part.\nIn grey: the light of one line alone, on the same scale.",
    )
    return figure
