"""Figures of a made part: its form error, and the light that it will throw."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bstcad.report.drawing import new_figure, png, round_up, steps, styled
from bstcad.report.light_figures import (
    SPOT,
    View,
    brightest,
    draw_picture,
    footnote,
    lit_mean,
    seen_grey,
    tilted,
)
from bstcad.report.units import quantity

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DENSE = 300  # dots that need to be small
UNITS = ((1e-3, 1e3, "µm"), (0.0, 1e6, "nm"))  # (from this many mm on, times, written)


def draw_part(
    x: np.ndarray, y: np.ndarray, form: np.ndarray, designed: np.ndarray, predicted: np.ndarray, view: tuple[Any, ...],
    outliers: np.ndarray,
) -> dict[str, bytes]:  # fmt: skip
    """The pictures of a made part as PNG bytes by name; arguments as of `made_part`, view: of View."""
    return {"made_part": png(made_part(x, y, form, designed, predicted, View(*view), outliers))}


@styled
def made_part(
    x: np.ndarray, y: np.ndarray, form: np.ndarray, designed: np.ndarray, predicted: np.ndarray, view: View,
    outliers: np.ndarray,
) -> Figure:  # fmt: skip
    """The fitted form error (rows y, columns x, mm, NaN outside), the light of the part, and what the form changes.

    designed, predicted: (rows, columns) irradiance in coordinates, of one sum.  outliers: (n, 2) mm, drawn as dots.
    """
    most, pv = float(np.nanmax(np.abs(form))), float(np.nanmax(form) - np.nanmin(form))
    _, times, unit = next(rung for rung in UNITS if most >= rung[0])
    edge, mean = round_up(times * most), lit_mean(designed)
    change = 100.0 * (predicted - designed) / mean
    far = round_up(max(float(np.percentile(np.abs(change), 99.5)), SPOT * float(np.abs(change).max())))
    figure = new_figure(11.0, 1.3 + 2.8 * view.proportion, layout="compressed")
    face, light, changed = figure.subplots(1, 3)
    place = {"extent": (x[0], x[-1], y[0], y[-1]), "origin": "lower", "interpolation_stage": "data"}
    shown = face.imshow(times * form, cmap=steps("RdBu_r", 41), vmin=-edge, vmax=edge, **place)
    face.set(title=f"Made − designed, PV {quantity(pv, 'mm')}", xlabel="x (mm)")
    face.set_ylabel("y (mm)")
    dots = ""
    if len(outliers):
        face.plot(*outliers.T, ".", color="black", markersize=3.0 if len(outliers) < DENSE else 1.0, markeredgewidth=0)
        dots = f"  Black dots: the {len(outliers)} outliers that were left out." if len(outliers) > 1 else (
            "  Black dot: the outlier that was left out.")  # fmt: skip
    face.spines[:].set_visible(False)
    figure.colorbar(shown, ax=face, label=f"{unit} along the normal", fraction=0.046, pad=0.03)
    top = brightest(designed, predicted) / mean
    drawn = draw_picture(light, predicted / mean, view, cmap=seen_grey(), vmin=0.0, vmax=top)
    light.set_title("Light of the made part, predicted")
    figure.colorbar(drawn, ax=light, label="irradiance / mean lit", fraction=0.046, pad=0.03)
    signed = draw_picture(changed, change, view, cmap=steps("RdBu_r", 41), vmin=-far, vmax=far)
    changed.set_title("Made − designed light")
    figure.colorbar(signed, ax=changed, label="% of mean lit irradiance", fraction=0.046, pad=0.03, extend="both")
    footnote(
        figure,
        "Left: form error of the back face after alignment, + out of the glass, from outside with x to the right."
        f"{dots}\n"
        f"{view.words}.{tilted(view.tilt)}",
    )
    return figure
