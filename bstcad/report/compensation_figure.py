"""Figure of a round of compensation: the measured deviation, its correction, and what is expected to remain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bstcad.report.drawing import footnote, new_figure, png, round_up, steps, styled
from bstcad.report.light_figures import FORM_UNITS
from bstcad.report.units import quantity

TITLES = "Measured − designed", "Correction", "Expected to remain"


@styled
def correction_figure(x: np.ndarray, y: np.ndarray, parts: Sequence[np.ndarray]) -> bytes:
    """Return the maps (rows y, columns x; mm, NaN outside the face) of deviation, correction and rest as PNG."""
    figure = new_figure(11.0, 1.0 + 3.2 * (y[-1] - y[0]) / (x[-1] - x[0]), layout="compressed")
    for axes, part, title in zip(figure.subplots(1, len(parts)), parts, TITLES, strict=True):
        largest = float(np.nanmax(np.abs(part)))
        _, factor, unit = next(rung for rung in FORM_UNITS if largest >= rung[0])
        edge = round_up(factor * largest)
        place = {"extent": (x[0], x[-1], y[0], y[-1]), "origin": "lower", "interpolation_stage": "data"}
        image = axes.imshow(factor * part, cmap=steps("RdBu_r", 41), vmin=-edge, vmax=edge, **place)
        pv = quantity(float(np.nanmax(part) - np.nanmin(part)), "mm")
        axes.set(title=f"{title}, PV {pv}", xlabel="x (mm)", ylabel="y (mm)")
        axes.spines[:].set_visible(False)
        figure.colorbar(image, ax=axes, label=f"{unit} along z", fraction=0.046, pad=0.03)
    footnote(figure, "Back face, seen from outside; + is out of the glass. Height and tilt are removed.")
    return png(figure)
