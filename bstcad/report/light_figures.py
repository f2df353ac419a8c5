"""Figures of the light on the target, as a person sees it who stands where the scene says.

From the lens, along +z with y up, x grows to the left.  Grey is what an eye or a camera would see (sRGB), while scales
of irradiance are linear.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bstcad.report.drawing import BLUE, GREY, VERMILION, new_figure, round_up, steps, styled
from bstcad.report.units import number
from bstcad.report.vocabulary import turned
from bstcad.scene.tones import to_srgb

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

Extent = tuple[float, float]  # (min, max) in mm

SEEN = {
    "lens": "Seen from the {optic}, looking along +z: x grows to the left",
    "behind": "Seen from behind the screen, looking towards the {optic}: x grows to the right",
}
LIT = 0.01  # a pixel is lit where the target exceeds this part of its maximum
HEADROOM = 1.06  # the scale ends above the brightest there is, so that even light is not as white as the paper
GLARING = 2.0  # of the target's maximum: up to here the scale follows a hot spot …
RARE = 99.9  # … and beyond it what is brighter than so many percent of the pixels
SPOT = 0.1  # of the largest difference: the scale reaches as far at least, or even light would look torn
TONES = 128  # the eye loses nothing, a PNG becomes a third as large
MARK = 0.045  # of a picture's side: how far the ends of a cut reach into it
CUTS = {"centre": BLUE, "brightest place": VERMILION}


@dataclass(frozen=True)
class View:
    """Where the target lies and from where it is seen."""

    x: Extent
    y: Extent
    seen_from: str  # lens | behind
    optic: str = "lens"  # or "mirror"
    tilt: tuple[float, float] | None = None  # of the target plane, about x and then about y (degrees); None: level

    @property
    def words(self) -> str:
        """From where it is seen."""
        return seen(self.seen_from, self.optic)

    @property
    def proportion(self) -> float:
        """Height over width, as far as a row of pictures should follow it."""
        return min(max((self.y[1] - self.y[0]) / (self.x[1] - self.x[0]), 0.55), 1.6)

    def picture(self, values: np.ndarray) -> np.ndarray:
        """An array in coordinates (column 0 = x min) as it is seen."""
        return values[:, ::-1] if self.seen_from == "lens" else values

    @property
    def across(self) -> Extent:
        """x at the left and at the right."""
        return self.x[::-1] if self.seen_from == "lens" else self.x


@dataclass(frozen=True)
class Cut:
    """Where the irradiance is cut: a row and a column of the picture in coordinates."""

    name: str  # of CUTS
    row: int
    column: int
    x: float  # mm, the middle of the column
    y: float  # mm, the middle of the row


def seen(seen_from: str, optic: str) -> str:
    """From where a picture is seen, in words."""
    return SEEN[seen_from].format(optic=optic)


def tilted(tilt: tuple[float, float] | None) -> str:
    """What there is to add about a tilted target plane, on a line of its own."""
    return f"\nThe target plane is tilted by {turned(tilt, number)}; x and y are measured on it." if tilt else ""


def lit_mean(target: np.ndarray) -> float:
    """Mean of the target over its lit pixels, those above 1 % of its maximum (a floor under black is not lit)."""
    return float(target[target > LIT * target.max()].mean())


def rrmsd(target: np.ndarray, irradiance: np.ndarray) -> float:
    """sqrt(Σ (E_s - E)² / Σ E²); Wang et al. 2023, the merit of stage 2."""
    return float(np.sqrt(np.sum((irradiance - target) ** 2) / np.sum(target**2)))


def brightest(target: np.ndarray, irradiance: np.ndarray) -> float:
    """Where the scale of both ends: above the brightest of either, unless that is a few pixels' glare."""
    most = float(target.max())
    glare = min(float(irradiance.max()), GLARING * most)
    return HEADROOM * max(most, glare, float(np.percentile(irradiance, RARE)))


@styled
def irradiance_triptych(target: np.ndarray, irradiance: np.ndarray, view: View) -> Figure:
    """Target, simulated and their signed difference in percent of the mean lit irradiance.

    target, irradiance: (rows, columns) in coordinates, one sum.
    """
    unit = lit_mean(target)
    error = 100.0 * (irradiance - target) / unit
    most = round_up(max(float(np.percentile(np.abs(error), 99.5)), SPOT * float(np.abs(error).max())))
    figure = new_figure(11.0, 1.3 + 2.8 * view.proportion, layout="compressed")
    panels = figure.subplots(1, 3, sharey=True)
    top = brightest(target, irradiance) / unit
    shades = {"cmap": seen_grey(), "vmin": 0.0, "vmax": top}
    draw_picture(panels[0], target / unit, view, **shades)
    shown = draw_picture(panels[1], irradiance / unit, view, **shades)
    signed = draw_picture(panels[2], error, view, cmap=steps("RdBu_r", 41), vmin=-most, vmax=most)
    panels[0].set_title("Target")
    panels[1].set_title("Simulated through the lens" if view.optic == "lens" else "Simulated by the mirror")
    panels[2].set_title("Simulated − target")
    panels[0].set_ylabel("y (mm)")
    for axes in panels[:2]:
        for cut in cuts(irradiance, view):
            _mark(axes, cut, view)
    beyond = "max" if irradiance.max() / unit > top else "neither"
    both = figure.colorbar(shown, ax=panels[:2], fraction=0.04, pad=0.015, extend=beyond)
    both.set_label("irradiance / mean lit irradiance")
    figure.colorbar(signed, ax=panels[2], label="% of mean lit irradiance", fraction=0.08, pad=0.03, extend="both")
    footnote(
        figure,
        f"{view.words}.  Grey as an eye or a camera would see it (sRGB); the scale is linear in irradiance.\n"
        "Marks at the edges: the cuts through the centre (blue) and through the brightest place (vermilion, ringed)."
        f"{tilted(view.tilt)}",
    )
    return figure


@styled
def ghost_picture(target: np.ndarray, ghost: np.ndarray, view: View) -> Figure:
    """What the light that was reflected twice inside the lens adds, in percent of the mean lit irradiance.

    ghost: (rows, columns) in coordinates, of the irradiance that has the target's sum.
    """
    share = 100.0 * ghost / lit_mean(target)
    figure = new_figure(5.6, 4.6, layout="compressed")
    axes = figure.subplots()
    top = HEADROOM * float(np.percentile(share, RARE)) or 1.0
    shown = draw_picture(axes, share, view, cmap=seen_grey(), vmin=0.0, vmax=top)
    axes.set_ylabel("y (mm)")
    axes.set_title(f"The ghost alone: up to {number(float(share.max()))} %")
    figure.colorbar(shown, ax=axes, label="% of mean lit irradiance", extend="max" if share.max() > top else "neither")
    footnote(figure, f"{view.words}.")
    return figure


def seen_grey() -> ListedColormap:
    """From irradiance, 0 to 1, to the grey that a screen has to be sent."""
    from matplotlib.colors import ListedColormap

    tones = np.round(to_srgb(np.linspace(0.0, 1.0, 16 * TONES)) * (TONES - 1)) / (TONES - 1)
    return ListedColormap(np.repeat(np.clip(tones, 0.0, 1.0)[:, None], 3, axis=1), name="seen grey")


def cuts(irradiance: np.ndarray, view: View) -> tuple[Cut, Cut]:
    """Through the centre of the target, and through the brightest place of its irradiance."""
    rows, columns = irradiance.shape
    along_x, along_y = _pixel_centres(view.x, columns), _pixel_centres(view.y, rows)[::-1]
    places = ((rows // 2, columns // 2), divmod(int(irradiance.argmax()), columns))
    centre, hottest = (
        Cut(name, row, column, float(along_x[column]), float(along_y[row]))
        for name, (row, column) in zip(CUTS, places, strict=True)
    )
    return centre, hottest


def draw_picture(axes: Axes, values: np.ndarray, view: View, **shades: Any) -> Any:
    """Draw `values`, in coordinates, as they are seen, in a frame."""
    axes.set_xlabel("x (mm)")
    axes.spines[:].set(visible=True, color=GREY, linewidth=0.6)
    place = {"extent": (*view.across, *view.y), "origin": "upper", "interpolation_stage": "data"}
    return axes.imshow(view.picture(values), **place, **shades)


def _mark(axes: Axes, cut: Cut, view: View) -> None:
    """The ends of a cut's row and column at the edges of a picture; a ring where it is brightest."""
    style = {"color": CUTS[cut.name], "linewidth": 1.6, "solid_capstyle": "butt", "gid": cut.name}
    for (low, high), along_x in ((view.x, True), (view.y, False)):
        reach = MARK * (high - low)
        for ends in ((low, low + reach), (high - reach, high)):
            axes.plot(*((ends, (cut.y, cut.y)) if along_x else ((cut.x, cut.x), ends)), **style)
    if cut.name == "brightest place":
        axes.plot(cut.x, cut.y, "o", markersize=7, markerfacecolor="none", markeredgecolor=CUTS[cut.name], gid="ring")
    axes.set(xlim=view.across, ylim=view.y)


@styled
def cross_section(target: np.ndarray, irradiance: np.ndarray, view: View) -> Figure:
    """Target and simulated irradiance along rows and columns: through the centre, and through the brightest place."""
    unit = lit_mean(target)
    along_x, along_y = _pixel_centres(view.x, target.shape[1]), _pixel_centres(view.y, target.shape[0])[::-1]
    figure = new_figure(11.0, 4.9)
    panels = figure.subplots(2, 2, sharey=True)
    for (left, right), cut in zip(panels, cuts(irradiance, view), strict=True):
        rows = (
            (left, along_x, target[cut.row], irradiance[cut.row], "x", view.across, f"y = {cut.y:.3g} mm"),
            (right, along_y, target[:, cut.column], irradiance[:, cut.column], "y", view.y, f"x = {cut.x:.3g} mm"),
        )
        for axes, place, wanted, found, axis, ends, where in rows:
            axes.fill_between(place, wanted / unit, step="mid", color="#c9c9c9", linewidth=0, label="target")
            axes.plot(place, found / unit, color=CUTS[cut.name], linewidth=1.0, label="simulated")
            axes.set_title(f"Through the {cut.name}, along {axis} ({where})", color=CUTS[cut.name])
            axes.set(xlabel=f"{axis} (mm)", xlim=ends)
        left.set_ylabel("irradiance / mean lit")
    panels[0][0].set_ylim(bottom=0.0)
    figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    footnote(figure, f"{view.words}.{tilted(view.tilt)}")
    return figure


def footnote(figure: Figure, text: str) -> None:
    """A line in grey under a figure."""
    figure.supxlabel(text, x=0.01, ha="left", fontsize=8, color=GREY)


def _pixel_centres(extent: Extent, pixels: int) -> np.ndarray:
    """Centres of `pixels` equal pixels over `extent`, ascending (mm)."""
    return extent[0] + (np.arange(pixels) + 0.5) * (extent[1] - extent[0]) / pixels
