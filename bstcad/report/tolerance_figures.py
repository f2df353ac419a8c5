"""Figures of a tolerance study: how the trials came out, and the light of the worst of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from bstcad.report.drawing import BLUE, GREY, VERMILION, new_figure, png, round_up, steps, styled
from bstcad.report.light_figures import View, brightest, draw_picture, footnote, lit_mean, seen_grey, tilted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES = {  # key of a picture: what it shows, for those who cannot see it
    "tolerance_trials": "Histogram of the RRMSD of the trials, with the limit, and with the screen adjusted.",
    "tolerance_worst": "The irradiance as designed, that of the worst trials beside it, and the difference.",
}
BINS = 60
GREEN = "#009e73"  # of Okabe and Ito, too
SHOWN = 3  # of the worst trials


@dataclass(frozen=True, eq=False)
class Trials:
    """RRMSD of trials."""

    design: float
    limit: float
    linear: np.ndarray = field(repr=False)  # by superposed pictures
    full: np.ndarray = field(repr=False)  # of fewer, by full traces
    adjusted: np.ndarray = field(repr=False)  # of these, with the screen adjusted


@dataclass(frozen=True, eq=False)
class Worst:
    """The light of one trial."""

    number: int
    rrmsd: float
    picture: np.ndarray = field(repr=False)  # (rows, columns) in coordinates, with the target's sum


def draw_tolerances(trials: Trials, nominal: np.ndarray, worst: Sequence[Worst], view: View) -> dict[str, bytes]:
    """The pictures of a study as PNG bytes by name; nominal: the light as designed, with the target's sum."""
    return {
        "tolerance_trials": png(histogram(trials)),
        "tolerance_worst": png(worst_trials(trials.design, nominal, worst, view)),
    }


@styled
def histogram(trials: Trials) -> Figure:
    """How many trials come to which RRMSD, a bin, as a part of all of their kind."""
    figure = new_figure(7.6, 3.1)
    axes = figure.subplots()
    every = np.concatenate([trials.linear, trials.full, trials.adjusted, [trials.design]])
    low, high = float(every.min()), float(np.percentile(every, 99.8))
    low, high = min(low, trials.limit), max(high, trials.limit) if trials.limit < 2 * high else high
    room = 0.03 * (high - low)
    bins = np.linspace(low - room, high + room, BINS + 1)

    def parts(values: np.ndarray, among: np.ndarray) -> np.ndarray:
        return 100.0 * np.histogram(np.clip(values, among[0], among[-1]), among)[0] / len(values)

    axes.stairs(
        parts(trials.linear, bins), bins, fill=True, color=BLUE, alpha=0.55, label=f"{len(trials.linear)} trials"
    )
    few = bins[:: BINS // 20]  # fewer trials, wider bins
    kinds = ((trials.full, VERMILION, 2.6, "by full traces"), (trials.adjusted, GREEN, 1.1, "with the screen adjusted"))
    for values, colour, width, said in kinds:
        axes.stairs(parts(values, few) * 20 / BINS, few, color=colour, linewidth=width, label=f"{len(values)} {said}")
    top = axes.get_ylim()[1]
    for place, said, line in ((trials.design, "as designed", ":"), (trials.limit, "limit", "--")):
        if bins[0] <= place <= bins[-1]:
            axes.axvline(place, color=GREY, linestyle=line, linewidth=1.0)
            left = place > (bins[0] + bins[-1]) / 2
            axes.annotate(
                f"{said} {place:.3g}", (place, 1.14 * top), (-4 if left else 4, -1), textcoords="offset points",
                ha="right" if left else "left", va="top", fontsize=8, color=GREY,
            )  # fmt: skip
    axes.set(xlabel="RRMSD", ylabel="% of the trials, a bin", xlim=(bins[0], bins[-1]), ylim=(0, 1.14 * top))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


@styled
def worst_trials(design: float, nominal: np.ndarray, worst: Sequence[Worst], view: View) -> Figure:
    """The light as designed, then that of the worst trials on the same scale, and below by how much it is off that."""
    shown = worst[:SHOWN]
    unit = lit_mean(nominal)
    figure = new_figure(11.0, 1.0 + 4.6 * view.proportion, layout="compressed")
    panels = figure.subplots(2, 1 + SHOWN, sharex=True, sharey=True, squeeze=False)
    top = max(brightest(nominal, one.picture) for one in shown) / unit
    off = [100.0 * (one.picture - nominal) / unit for one in shown]
    most = round_up(float(np.percentile(np.abs(off), 99.5)))
    grey = {"cmap": seen_grey(), "vmin": 0.0, "vmax": top}
    signed = {"cmap": steps("RdBu_r", 41), "vmin": -most, "vmax": most}
    lit = draw_picture(panels[0, 0], nominal / unit, view, **grey)
    panels[0, 0].set_title(f"As designed (RRMSD {design:.3g})")
    for (above, below), one, apart in zip(panels[:, 1:].T, shown, off, strict=False):
        draw_picture(above, one.picture / unit, view, **grey)
        above.set_xlabel("")
        above.set_title(f"Trial {one.number} (RRMSD {one.rrmsd:.3g})")
        changed = draw_picture(below, apart, view, **signed)
        below.set_title(f"Trial {one.number} − as designed")
    for axes in (panels[1, 0], *panels[:, 1 + len(shown) :].ravel()):
        axes.set_visible(False)
    panels[0, 0].tick_params(labelbottom=True)
    panels[1, 1].tick_params(labelleft=True)
    for axes in (panels[0, 0], panels[1, 1]):
        axes.set_ylabel("y (mm)")
    figure.colorbar(lit, ax=panels[0], label="irradiance / mean lit", fraction=0.03, pad=0.015)
    figure.colorbar(changed, ax=panels[1], label="% of mean lit irradiance", fraction=0.03, pad=0.015, extend="both")
    footnote(figure, f"{view.words}.{tilted(view.tilt)}")
    return figure
