"""Figures of the light on the target, as seen from the side that the scene states.

Seen from the lens, along +z with y up, x increases to the left.  Grey tones are those of an eye or a camera (sRGB), and
the scales of irradiance are linear.  Pictures have the shape (rows, columns) and the sum of the target.  A picture "in
coordinates" has row 0 at y max and column 0 at x min.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from bstcad.analysis.cell_errors import MAX_GROWTH, SMALL_RRMSD
from bstcad.figures.drawing import (
    BLUE,
    DARK_GROUND,
    GREEN,
    GREY,
    VERMILION,
    darken,
    footnote,
    new_figure,
    png,
    round_up,
    steps,
    styled,
)
from bstcad.optics.receivers.irradiance import Screen, rrmsd_of_pictures
from bstcad.optics.receivers.receivers import LevelPlane, Receiver
from bstcad.optics.trace.measure import CellError, SpectralLine
from bstcad.report.units import number, quantity, tilt_words
from bstcad.scene.picture import to_srgb
from bstcad.scene.target import numbered
from bstcad.verify.light_limits import PER_LX

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    from bstcad.manufacture.measured.made_part import MadePart
    from bstcad.scene.scene import Scene
    from bstcad.verify.judges.comparison import Comparison

Extent = tuple[float, float]  # (min, max) in the receiver's unit

SEEN = {  # (target.seen_from, True if the light travels along -z after an odd number of fold mirrors): sentence
    ("lens", False): "Seen from the {optic}, looking along +z: x grows to the left",
    ("behind", False): "Seen from behind the screen, looking towards the {optic}: x grows to the right",
    ("lens", True): "Seen from the {optic} in the fold mirror, looking along +z: x grows to the left",
    ("behind", True): "Seen from the fold mirror, looking along -z: x grows to the right",
}
LIT = 0.01  # fraction of the target's maximum above which a pixel is lit
HEADROOM = 1.06  # end of the grey scale relative to the brightest value, so that uniform light differs from white paper
MAX_GLARE = 2.0  # multiple of the target's maximum up to which the scale includes the brightest pixel
GLARE_PERCENTILE = 99.9  # percentile of the irradiance that the scale always includes
MIN_SCALE = 0.1  # smallest end of a scale of differences, as a fraction of the largest difference
TONES = 128  # number of grey tones: without visible loss, the PNG files are a third as large as with more tones
MARK_LENGTH = 0.045  # length of the marks of a cut, as a fraction of the picture's side
CUTS = {"centre": BLUE, "brightest point": VERMILION}  # position of a cut: colour
PERCENT_LIT = "% of mean of lit pixels"  # label of a scale of differences
COLUMNS = 4  # pictures of spectral lines per row
PANEL_WIDTH, MAX_PANEL_HEIGHT = 2.4, 4.8  # width and largest height of a spectral line's picture (inches)
MANY_OUTLIERS = 300  # number of outliers from which on their dots are small
FORM_UNITS = ((1e-3, 1e3, "µm"), (0.0, 1e6, "nm"))  # (smallest size in mm, factor from mm, unit as written)
BINS = 60  # number of bins of the histogram of trials
MAX_WORST_TRIALS = 3  # number of the worst trials that are drawn
# CIE 1931 standard observer, sums of Gaussians with two widths: weight, centre, width below and above the centre (nm).
# Wyman, Sloan and Shirley, Journal of Computer Graphics Techniques 2(2), 2013, multi-lobe fit.
LOBES = (
    ((1.056, 599.8, 37.9, 31.0), (0.362, 442.0, 16.0, 26.7), (-0.065, 501.1, 20.4, 26.2)),
    ((0.821, 568.8, 46.9, 40.5), (0.286, 530.9, 16.3, 31.1)),
    ((1.217, 437.0, 11.8, 36.0), (0.681, 459.0, 26.0, 13.8)),
)
# From XYZ to linear sRGB, IEC 61966-2-1.
TO_SRGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])


@dataclass(frozen=True)
class View:
    """Position of a target, and the side from which it is seen."""

    x: Extent  # extent of the target along x
    y: Extent  # extent of the target along y
    seen_from: str  # lens | behind
    optic: str = "lens"  # lens | mirror
    folded: bool = False  # True if the light reaches the target along -z
    receiver: Receiver = LevelPlane(0.0)  # receiver on which x and y are measured
    number: int = 0  # index of the target, used in the names of its figures
    lumens: float | None = None  # luminous flux of the source (lm); None: not known
    absolute_mean: str = ""  # mean of the lit pixels with its unit, lx or cd; empty: not known

    @classmethod
    def of(cls, scene: Scene, number: int = 0) -> View:
        """Return the view of the target `number` of the scene."""
        target = scene.targets[number]
        side: dict[str, Any] = {"optic": scene.optic, "folded": scene.folded}
        side["lumens"] = scene.source.luminous_flux
        return cls(target.x, target.y, target.seen_from, receiver=target.screen.receiver, number=number, **side)

    def with_flux(self, target: np.ndarray, on_target: float) -> View:
        """Return the view with the mean light of the lit pixels; on_target: flux there / flux of the source."""
        unit = self.receiver.photometric_unit
        if self.lumens is None or unit is None:
            return self
        sizes = self.receiver.cell_sizes(self.x, self.y, target.shape)
        mean = lit_mean(self.irradiance(target)) / target.sum() * self.lumens * on_target / sizes.mean()
        return replace(self, absolute_mean=f"{number(mean * (PER_LX if unit == 'lx' else 1.0))} {unit}")

    @property
    def labels(self) -> tuple[str, str]:
        """Labels of the receiver's axes, with their unit."""
        return self.receiver.labels

    @property
    def mean_lit(self) -> str:
        """Label of a scale relative to the mean of the lit pixels."""
        absolute = f"\n({self.absolute_mean})" if self.absolute_mean else ""
        return f"{self.receiver.light} / mean of lit pixels{absolute}"

    @property
    def words(self) -> str:
        """Sentence on the side from which the target is seen, without a full stop."""
        return SEEN[self.seen_from, self.folded].format(optic=self.optic)

    def note(self, figure: Figure, more: str = "", first: str = "") -> None:
        """Write a footnote: `first`, the side from which the target is seen, `more`, and the tilt of its plane."""
        tilt = self.receiver.tilt
        plane = f"\nThe target plane is tilted by {tilt_words(tilt)}; x and y are measured on it." if tilt else ""
        footnote(figure, f"{first}{self.words}.{more}{plane}")

    @property
    def proportion(self) -> float:
        """Height of the target divided by its width, limited to 0.55 to 1.6 for a row of pictures."""
        return min(max((self.y[1] - self.y[0]) / (self.x[1] - self.x[0]), 0.55), 1.6)

    def picture(self, values: np.ndarray) -> np.ndarray:
        """Return an array in coordinates (column 0 = x min), mirrored if the target is seen from the lens."""
        return values[:, ::-1] if self.seen_from == "lens" else values

    def tones(self, light: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Return grey tones (uint8) of `light`, the flux in each pixel; the scale also suits the target `wanted`."""
        return tones(self.irradiance(light), self.irradiance(wanted))

    def irradiance(self, flux: np.ndarray) -> np.ndarray:
        """Return the flux in each pixel, divided by the ratio of the pixel's area to the mean area."""
        areas = self.receiver.areas(self.x, self.y, flux.shape)
        return flux if areas is None else flux / areas

    @property
    def across(self) -> Extent:
        """Values of x at the left and at the right edge."""
        return self.x[::-1] if self.seen_from == "lens" else self.x


def lit_mean(target: np.ndarray) -> float:
    """Return the mean of the target over its lit pixels, those above LIT times its maximum."""
    return float(target[target > LIT * target.max()].mean())


def brightest(target: np.ndarray, irradiance: np.ndarray) -> float:
    """Return the end of a scale for both pictures: above their brightest pixel, but hot spots may exceed it."""
    peak = float(target.max())
    glare = min(float(irradiance.max()), MAX_GLARE * peak)
    return HEADROOM * max(peak, glare, float(np.percentile(irradiance, GLARE_PERCENTILE)))


def tones(irradiance: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return irradiance as grey levels in sRGB (rows, columns), uint8; white is `brightest` of both arguments."""
    light = to_srgb(np.clip(irradiance / brightest(target, irradiance), 0.0, 1.0))
    return np.rint(255 * np.clip(light, 0.0, 1.0)).astype(np.uint8)


# --- parts of every figure --------------------------------------------------------------------------------------------


@cache
def srgb_grey() -> ListedColormap:
    """Return a colour map from irradiance, 0 to 1, to grey in sRGB."""
    from matplotlib.colors import ListedColormap

    tones = np.round(to_srgb(np.linspace(0.0, 1.0, 16 * TONES)) * (TONES - 1)) / (TONES - 1)
    return ListedColormap(np.repeat(np.clip(tones, 0.0, 1.0)[:, None], 3, axis=1), name="seen grey")


def draw_picture(axes: Axes, values: np.ndarray, view: View, **shades: Any) -> Any:
    """Draw `values`, which are in coordinates, as seen from the side of the view, in a frame; return the image."""
    axes.set_xlabel(view.labels[0])
    axes.spines[:].set(visible=True, color=GREY, linewidth=0.6)
    place = {"extent": (*view.across, *view.y), "origin": "upper", "interpolation_stage": "data"}
    return axes.imshow(view.picture(values), **place, **shades)


def _grey(axes: Axes, values: np.ndarray, view: View, *, top: float, title: str) -> Any:
    axes.set_title(title)
    return draw_picture(axes, values, view, cmap=srgb_grey(), vmin=0.0, vmax=top)


def _signed(axes: Axes, values: np.ndarray, view: View, *, most: float, title: str) -> Any:
    axes.set_title(title)
    return draw_picture(axes, values, view, cmap=steps("RdBu_r", 41), vmin=-most, vmax=most)


def _side_by_side(
    pictures: Mapping[str, np.ndarray], difference: str, view: View, *, height: float, spot: float = MIN_SCALE
) -> tuple[Figure, np.ndarray]:
    """Return a figure and its axes: `pictures`, by title, on one grey scale, and the difference of the last two.

    The first picture is the target.  difference: title.  height: height of the figure (inches).  spot: see `_largest`.
    """
    target, before, last = (list(pictures.values())[k] for k in (0, -2, -1))
    unit, top = lit_mean(target), max(brightest(target, picture) for picture in pictures.values())
    figure = new_figure(11.0, height, layout="compressed")
    panels, error = figure.subplots(1, len(pictures) + 1, sharey=True), 100.0 * (last - before) / unit
    for axes, (title, picture) in zip(panels, pictures.items(), strict=False):
        image = _grey(axes, picture / unit, view, top=top / unit, title=title)
    signed = _signed(panels[-1], error, view, most=_largest(error, spot), title=difference)
    panels[0].set_ylabel(view.labels[1])
    extend = "max" if last.max() > top else "neither"
    figure.colorbar(image, ax=panels[:-1], label=view.mean_lit, fraction=0.04, pad=0.015, extend=extend)
    figure.colorbar(signed, ax=panels[-1], label=PERCENT_LIT, fraction=0.08, pad=0.03, extend="both")
    return figure, panels


def _largest(values: np.ndarray, spot: float = MIN_SCALE) -> float:
    """Return the rounded end of a scale: 99.5th percentile of |values|, at least `spot` times their maximum."""
    size = np.abs(values)
    return round_up(max(float(np.percentile(size, 99.5)), spot * float(size.max())))


def plain_ticks(axis: Any, low: float, high: float) -> None:
    """Set ticks of a logarithmic axis from low to high as plain numbers: 1, 2, 5 per decade; more if high ≤ 8 low."""
    from matplotlib.ticker import LogLocator, NullLocator

    close = (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9)
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high > 8 * low else close))
    axis.set_major_formatter(lambda value, _: number(value))
    axis.set_minor_locator(NullLocator())


def _pixel_centres(extent: Extent, pixels: int) -> np.ndarray:
    return extent[0] + (np.arange(pixels) + 0.5) * (extent[1] - extent[0]) / pixels


# --- the irradiance ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cut:
    """Cut through the irradiance along a row and a column of the picture in coordinates."""

    name: str  # key of CUTS
    row: int
    column: int
    x: float  # centre of the column, in the receiver's unit
    y: float  # centre of the row, in the receiver's unit


def cuts(irradiance: np.ndarray, view: View) -> list[Cut]:
    """Return cuts through the centre of the target and through the brightest pixel of its irradiance."""
    rows, columns = irradiance.shape
    along_x, along_y = _pixel_centres(view.x, columns), _pixel_centres(view.y, rows)[::-1]
    places = ((rows // 2, columns // 2), divmod(int(irradiance.argmax()), columns))
    return [
        Cut(name, row, column, x=float(along_x[column]), y=float(along_y[row]))
        for name, (row, column) in zip(CUTS, places, strict=True)
    ]


def _mark(axes: Axes, cut: Cut, view: View) -> None:
    """Mark the ends of a cut at the edges of a picture, and the brightest point by a ring."""
    style = {"color": CUTS[cut.name], "linewidth": 1.6, "solid_capstyle": "butt", "gid": cut.name}
    for (low, high), along_x in ((view.x, True), (view.y, False)):
        reach = MARK_LENGTH * (high - low)
        for ends in ((low, low + reach), (high - reach, high)):
            axes.plot(*((ends, (cut.y, cut.y)) if along_x else ((cut.x, cut.x), ends)), **style)
    if cut.name == "brightest point":
        axes.plot(cut.x, cut.y, "o", markersize=7, markerfacecolor="none", markeredgecolor=CUTS[cut.name], gid="ring")
    axes.set(xlim=view.across, ylim=view.y)


def dark_triptych(target: np.ndarray, irradiance: np.ndarray, view: View) -> bytes:
    """Return the figure of the irradiance as a PNG for a page in dark mode."""
    return png(darken(irradiance_triptych(target, irradiance, view)), ground=DARK_GROUND)


@styled
def irradiance_triptych(target: np.ndarray, irradiance: np.ndarray, view: View) -> Figure:
    """Draw target, simulated irradiance and their difference in percent of the mean of the lit pixels.

    target, irradiance: (rows, columns) in coordinates, with equal sums.
    """
    target, irradiance = view.irradiance(target), view.irradiance(irradiance)
    simulated = "Simulated through the lens" if view.optic == "lens" else "Simulated by the mirror"
    pictures, height = {"Target": target, simulated: irradiance}, 1.3 + 2.8 * view.proportion
    figure, panels = _side_by_side(pictures, "Simulated − target", view, height=height)
    for axes in panels[:2]:
        for cut in cuts(irradiance, view):
            _mark(axes, cut, view)
    view.note(
        figure,
        f"  The grey tones look as the light looks to an eye (sRGB); the scale states the {view.receiver.light}.\n"
        "Marks at the edges: positions of the cuts in another figure, through the centre (blue) and through the "
        "brightest point (vermilion, ring).",
    )
    return figure


@styled
def changed_picture(
    target: np.ndarray, designed: np.ndarray, other: np.ndarray, view: View, changed: str = "As made"
) -> Figure:
    """Draw target, light as designed and as changed, and the difference of the last two in percent of the lit pixels.

    target, designed, other: (rows, columns) in coordinates, with equal sums.  changed: title of the changed picture.
    """
    pictures = {"Target": target, "As designed": designed, changed: other}
    shown = {title: view.irradiance(picture) for title, picture in pictures.items()}
    figure, _ = _side_by_side(shown, f"{changed} − as designed", view, height=1.3 + 2.2 * view.proportion)
    view.note(
        figure,
        f"  The grey tones look as the light looks to an eye (sRGB); the scale states the {view.receiver.light}.",
    )
    return figure


@styled
def reach_picture(target: np.ndarray, reachable: np.ndarray, view: View) -> Figure:
    """Draw the target, and beside it the target again, in vermilion where no light can reach it.

    target, reachable: (rows, columns) in coordinates; reachable is True where light can reach the target.
    """
    from matplotlib.colors import ListedColormap

    figure = new_figure(9.0, 1.3 + 3.6 * view.proportion)
    panels = figure.subplots(1, 2, sharey=True)
    top, part = HEADROOM * float(target.max()), np.where(reachable, target, 0.0)
    titles = "Target", f"Within reach: {100 * part.sum() / target.sum():.3g} % of its light"
    for axes, title in zip(panels, titles, strict=True):
        _grey(axes, target, view, top=top, title=title)
    draw_picture(panels[1], np.where(reachable, np.nan, 1.0), view, cmap=ListedColormap([VERMILION]), alpha=0.6)
    panels[0].set_ylabel(view.labels[1])
    view.note(figure, "  Vermilion: no face of this index and of slopes up to 70 degrees sends light there.")
    return figure


@styled
def ghost_picture(target: np.ndarray, ghost: np.ndarray, view: View) -> Figure:
    """Draw the light that is reflected twice inside the lens, in percent of the mean of the lit pixels.

    ghost: (rows, columns) in coordinates, multiplied by the same factor as the irradiance, which has the target's sum.
    """
    share = 100.0 * view.irradiance(ghost) / lit_mean(view.irradiance(target))
    figure = new_figure(5.6, 4.6, layout="compressed")
    axes = figure.subplots()
    top = HEADROOM * float(np.percentile(share, GLARE_PERCENTILE)) or 1.0
    image = _grey(axes, share, view, top=top, title=f"The ghost alone: up to {number(float(share.max()))} %")
    axes.set_ylabel(view.labels[1])
    figure.colorbar(image, ax=axes, label=PERCENT_LIT, extend="max" if share.max() > top else "neither")
    view.note(figure)
    return figure


@styled
def cross_section(target: np.ndarray, irradiance: np.ndarray, view: View) -> Figure:
    """Draw target and simulated irradiance along cuts through the centre and through the brightest point."""
    target, irradiance = view.irradiance(target), view.irradiance(irradiance)
    unit = lit_mean(target)
    along_x, along_y = _pixel_centres(view.x, target.shape[1]), _pixel_centres(view.y, target.shape[0])[::-1]
    figure = new_figure(11.0, 4.9)
    panels = figure.subplots(2, 2, sharey=True)
    (x, y), of = view.receiver.names, view.receiver.unit
    for pair, cut in zip(panels, cuts(irradiance, view), strict=True):
        for axes, axis, place, line, ends, where in (
            (pair[0], x, along_x, np.s_[cut.row, :], view.across, f"{y} = {number(cut.y)} {of}"),
            (pair[1], y, along_y, np.s_[:, cut.column], view.y, f"{x} = {number(cut.x)} {of}"),
        ):
            axes.fill_between(place, target[line] / unit, step="mid", color="#c9c9c9", linewidth=0, label="target")
            axes.plot(place, irradiance[line] / unit, color=CUTS[cut.name], linewidth=1.0, label="simulated")
            axes.set_title(f"Through the {cut.name}, along {axis} ({where})", color=CUTS[cut.name])
            axes.set(xlabel=f"{axis} ({of})", xlim=ends)
        pair[0].set_ylabel(view.mean_lit)
    panels[0][0].set_ylim(bottom=0.0)
    figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    view.note(figure)
    return figure


@styled
def cell_error(errors: Sequence[CellError], shape: tuple[int, int], view: View) -> Figure:
    """Draw the RRMSD against the size of the cells, both logarithmic, with a ring at the pixel.

    shape: rows and columns of the target.  A dotted line is the largest RRMSD at which the light counts as right.
    """
    from matplotlib.ticker import NullLocator

    side = Screen(0.0, view.x, view.y, shape[::-1]).pixel_side
    of_pixel = next(each.rrmsd for each in errors if each.cell == 1)
    limit = max(MAX_GROWTH * of_pixel, SMALL_RRMSD)
    figure = new_figure(4.6, 3.0)
    axes = figure.subplots()
    sizes = np.array([side * each.cell for each in errors])
    values, bars = np.array([(each.rrmsd, each.standard_error) for each in errors]).T
    low = np.minimum(bars, 0.9 * values)
    axes.errorbar(sizes, values, [low, bars], color=BLUE, marker="o", markersize=3.5, label="as simulated")
    if real := [(side * each.cell, each.blurred) for each in errors if each.blurred is not None]:
        style = {"color": VERMILION, "marker": "s", "markersize": 3.5, "linestyle": "--"}
        axes.plot(*zip(*real, strict=True), **style, label="with the size of the real source")
    ring = {"marker": "o", "markersize": 10, "markerfacecolor": "none", "markeredgecolor": GREY, "linestyle": ""}
    axes.plot(side, of_pixel, **ring, label=f"1 pixel, {quantity(side, view.receiver.unit)}", gid="pixel")
    axes.axhline(limit, color=GREY, linestyle=":", linewidth=0.9, label="largest that counts as right")
    drawn = [*values, limit, *(value for _, value in real)]
    ends = (0.8 * min(drawn), 1.25 * max(drawn))
    axes.set(xscale="log", yscale="log", xlabel=f"size of the cell ({view.receiver.unit})", ylabel="RRMSD", ylim=ends)
    plain_ticks(axes.yaxis, *ends)
    axes.xaxis.set_ticks(sizes, [number(size) for size in sizes])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(axis="y")
    figure.legend(loc="outside lower center", ncols=2, fontsize=7.5)
    return figure


# --- lines of a spectrum ----------------------------------------------------------------------------------------------


@styled
def spectral_lines(target: np.ndarray, irradiance: np.ndarray, lines: Sequence[SpectralLine], view: View) -> Figure:
    """Draw the picture of all spectral lines in colour, then the picture of each line alone.

    target, irradiance (of all lines), line.picture: (rows, columns) in coordinates, with equal sums.
    """
    even = view.irradiance(target)
    unit = lit_mean(even)
    top = brightest(even, view.irradiance(irradiance)) / unit
    rows = -(-(1 + len(lines)) // COLUMNS)
    height = PANEL_WIDTH * (view.y[1] - view.y[0]) / (view.x[1] - view.x[0])
    figure = new_figure(11.0, 0.6 + rows * (0.6 + min(height, MAX_PANEL_HEIGHT)), layout="compressed")
    panels = figure.subplots(rows, COLUMNS, sharey=True, sharex=True, squeeze=False).ravel()
    alone = [view.irradiance(line.picture) for line in lines]
    colours = balanced(alone, *([getattr(line, name) for line in lines] for name in ("wavelength", "share")))
    draw_picture(panels[0], to_srgb(np.clip(colours / unit / top, 0.0, 1.0)), view)
    panels[0].set_title("All lines")
    for axes, line, picture in zip(panels[1:], lines, alone, strict=False):
        title = f"{line.wavelength:g} nm (RRMSD {rrmsd_of_pictures(target, line.picture):.3g})"
        _grey(axes, picture / unit, view, top=top, title=title)
    for axes in panels[1 + len(lines) :]:
        axes.set_visible(False)
    for axes in panels[::COLUMNS]:
        axes.set_ylabel(view.labels[1])
    view.note(
        figure,
        "  Colour: as by a camera with white balance for the source; the lines differ where the picture is not grey.\n"
        "Grey: the light of one line alone, on the same scale.",
    )
    return figure


def primary(wavelength: float) -> np.ndarray:
    """Return linear sRGB (3,) of light of one wavelength (nm), with negative components set to zero."""
    xyz = [
        sum(
            weight * np.exp(-0.5 * ((wavelength - centre) / (below if wavelength < centre else above)) ** 2)
            for weight, centre, below, above in lobes
        )
        for lobes in LOBES
    ]
    return np.maximum(TO_SRGB @ np.array(xyz), 0.0)


def balanced(pictures: Sequence[np.ndarray], wavelengths: Sequence[float], shares: Sequence[float]) -> np.ndarray:
    """Return linear red, green and blue (rows, columns, 3) of lines whose pictures (rows, columns) have equal sums.

    Each component is divided by its value for the source's spectrum, so that light of this spectrum is grey.  If no
    line has a component, it is the mean of the pictures, weighted by the shares of the lines.
    """
    parts = np.array([share * primary(nm) for nm, share in zip(wavelengths, shares, strict=True)])  # (lines, 3)
    white = parts.sum(0)
    alone = np.asarray(shares, dtype=np.float64)[:, None]
    weights = np.where(white > 1e-6 * white.max(initial=0.0), parts / np.where(white > 0, white, 1.0), alone)
    return np.tensordot(np.array(pictures), weights, axes=(0, 0))


# --- other programs, made parts ---------------------------------------------------------------------------------------


def draw_judges(judges: Sequence[Comparison], view: View) -> dict[str, bytes]:
    """Return a figure for each other program that can trace the light, as PNG bytes by name."""
    return {each.judge.figure: png(judged_picture(each, view)) for each in judges if not each.judge.declined}


@styled
def judged_picture(compared: Comparison, view: View) -> Figure:
    """Draw the target, bstcad's picture, the other program's picture, and the difference of the two pictures."""
    name = compared.judge.name
    pictures = {"Target": compared.target} | {
        f"By {by} (RRMSD {rrmsd_of_pictures(compared.target, picture):.3g})": picture
        for by, picture in (("bstcad", compared.ours), (name, compared.theirs))
    }
    height = 0.7 + 2.2 * view.proportion
    figure, _ = _side_by_side(pictures, f"{name} − bstcad", view, height=height, spot=0.0)
    view.note(figure)
    return figure


def draw_part(made: MadePart, designed: np.ndarray, view: View) -> dict[str, bytes]:
    """Return the figure of a made part as PNG bytes by name.  designed: irradiance of the design."""
    return {numbered("made_part", view.number): png(made_part(made, designed, view))}


@styled
def made_part(made: MadePart, designed: np.ndarray, view: View) -> Figure:
    """Draw the fitted form error, the light of the made part, and its difference from the designed light."""
    x, y, form = made.deviation.x, made.deviation.y, made.deviation.form
    designed, predicted = view.irradiance(designed), view.irradiance(made.irradiances[view.number])
    outliers, unit = made.outliers[:, :2], lit_mean(designed)
    largest, pv = float(np.nanmax(np.abs(form))), float(np.nanmax(form) - np.nanmin(form))
    _, factor, unit_name = next(rung for rung in FORM_UNITS if largest >= rung[0])
    figure = new_figure(11.0, 1.3 + 2.8 * view.proportion, layout="compressed")
    face, light, changed = figure.subplots(1, 3)
    place = {"extent": (x[0], x[-1], y[0], y[-1]), "origin": "lower", "interpolation_stage": "data"}
    edge = round_up(factor * largest)
    image = face.imshow(factor * form, cmap=steps("RdBu_r", 41), vmin=-edge, vmax=edge, **place)
    face.set(title=f"Made − designed, PV {quantity(pv, 'mm')}", xlabel="x (mm)", ylabel="y (mm)")
    face.spines[:].set_visible(False)
    dots = ""
    if len(outliers):
        size = 3.0 if len(outliers) < MANY_OUTLIERS else 1.0
        face.plot(*outliers.T, ".", color="black", markersize=size, markeredgewidth=0)
        many = f"s: {len(outliers)} outliers, which are" if len(outliers) > 1 else ": an outlier, which is"
        dots = f"  Black dot{many} omitted."
    change, top = 100.0 * (predicted - designed) / unit, brightest(designed, predicted) / unit
    light_image = _grey(light, predicted / unit, view, top=top, title="Light of the made part, predicted")
    signed = _signed(changed, change, view, most=_largest(change), title="Made − designed light")
    slim = {"fraction": 0.046, "pad": 0.03}
    figure.colorbar(image, ax=face, label=f"{unit_name} along the normal", **slim)
    figure.colorbar(light_image, ax=light, label=view.mean_lit, **slim)
    figure.colorbar(signed, ax=changed, label=PERCENT_LIT, extend="both", **slim)
    left = "Left: form error of the back face after alignment, + out of the glass, seen from outside, x to the right."
    view.note(figure, first=f"{left}{dots}\n")
    return figure


# --- tolerances -------------------------------------------------------------------------------------------------------


@styled
def histogram(design: float, limit: float, linear: np.ndarray, full: np.ndarray, adjusted: np.ndarray) -> Figure:
    """Draw histograms of the RRMSD of trials, in percent of the trials of each kind.

    design, limit: RRMSD as designed, and its limit; linear: trials by superposed pictures; full: by full traces;
    adjusted: by superposed pictures, with the screen adjusted.
    """
    figure = new_figure(7.6, 3.1)
    axes = figure.subplots()
    every = np.concatenate([linear, full, adjusted, [design]])
    low, high = float(every.min()), float(np.percentile(every, 99.8))
    low, high = min(low, limit), max(high, limit) if limit < 2 * high else high
    room = 0.03 * (high - low)
    bins = np.linspace(low - room, high + room, BINS + 1)
    wide_bins = bins[:: BINS // 20]  # for the kinds with fewer trials
    for values, edges, style in (
        (linear, bins, {"fill": True, "color": BLUE, "alpha": 0.55, "label": f"{len(linear)} trials"}),
        (full, wide_bins, {"color": VERMILION, "linewidth": 2.6, "label": f"{len(full)} by full traces"}),
        (adjusted, wide_bins, {"color": GREEN, "linewidth": 1.1, "label": f"{len(adjusted)} with the screen adjusted"}),
    ):
        counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
        axes.stairs(100.0 * counts / len(values) * (len(edges) - 1) / BINS, edges, **style)
    for place, name, line in ((design, "as designed", ":"), (limit, "limit", "--")):
        axes.axvline(place, color=GREY, linestyle=line, linewidth=1.0, label=f"{name} {place:.3g}")
    axes.set(xlabel="RRMSD", ylabel="% of the trials per bin", xlim=(bins[0], bins[-1]))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


@styled
def worst_trials(
    design: float, nominal: np.ndarray, worst: Sequence[tuple[int, float, np.ndarray]], view: View, of: str = ""
) -> Figure:
    """Draw the light as designed, the light of the worst trials, and below each trial its difference from the design.

    nominal: picture of the design; worst: (number, RRMSD, picture) of each trial; pictures as in irradiance_triptych.
    of: suffix such as ", target[0]" if there are several targets.
    """
    nominal = view.irradiance(nominal)
    worst = [(number, value, view.irradiance(picture)) for number, value, picture in worst[:MAX_WORST_TRIALS]]
    unit = lit_mean(nominal)
    figure = new_figure(11.0, 1.0 + 4.6 * view.proportion, layout="compressed")
    panels = figure.subplots(2, 1 + MAX_WORST_TRIALS, sharex=True, sharey=True, squeeze=False)
    top = max(brightest(nominal, picture) for _, _, picture in worst) / unit
    differences = [100.0 * (picture - nominal) / unit for _, _, picture in worst]
    most = _largest(np.array(differences), 0.0)
    lit = _grey(panels[0, 0], nominal / unit, view, top=top, title=f"As designed{of} (RRMSD {design:.3g})")
    for (above, below), (trial, value, picture), difference in zip(panels[:, 1:].T, worst, differences, strict=False):
        _grey(above, picture / unit, view, top=top, title=f"Trial {trial} (RRMSD {value:.3g})").axes.set_xlabel("")
        changed = _signed(below, difference, view, most=most, title=f"Trial {trial} − as designed")
    for axes in (panels[1, 0], *panels[:, 1 + len(worst) :].ravel()):
        axes.set_visible(False)
    panels[0, 0].tick_params(labelbottom=True)
    panels[1, 1].tick_params(labelleft=True)
    for axes in (panels[0, 0], panels[1, 1]):
        axes.set_ylabel(view.labels[1])
    slim = {"fraction": 0.03, "pad": 0.015}
    figure.colorbar(lit, ax=panels[0], label=view.mean_lit, **slim)
    figure.colorbar(changed, ax=panels[1], label=PERCENT_LIT, extend="both", **slim)
    view.note(figure)
    return figure
