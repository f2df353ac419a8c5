"""Figures of lighting engineers: polar and isocandela diagrams, the cone diagram of a lamp, and the isolux picture.

Intensities are in cd, or in cd/klm (cd for 1000 lm of the source) if the flux of the source is not known.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from bstcad.analysis.far_field import RAYS, FarField
from bstcad.figures.drawing import BLUE, GREEN, GREY, VERMILION, footnote, new_figure, png, steps, styled
from bstcad.figures.light_figures import View, draw_picture
from bstcad.optics.lens.lens import Lens
from bstcad.optics.receivers.directions import Directions
from bstcad.optics.trace.measure import Light
from bstcad.photometry.intensity import Intensity
from bstcad.report.units import number, quantity
from bstcad.scene.target import numbered

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVELS = 0.05, 0.1, 0.2, 0.4, 0.6, 0.8  # levels of contour lines, as fractions of the largest value
LINES = f"Lines: {', '.join(f'{100 * level:g}' for level in LEVELS)} % of the largest value."
DARK = 0.01  # fraction of the largest intensity below which a direction is not drawn
SECTORS = 15.0, 30.0, 60.0, 90.0  # half angles of a polar diagram (degrees); the smallest with all light is drawn
# Rays per side for the diagrams of a point source: the noise is about a thousandth of the largest intensity.
POINT_SOURCE_RAYS = 1024
POLAR_POINTS, MAP_POINTS = 721, 301  # samples of a curve over γ, and of an isocandela diagram along each axis
MAP_SIDE, MAP_LEFT, MAP_BOTTOM = 4.2, 0.95, 0.8  # side of an isocandela diagram, and its position in the figure, inches
SCALE_GAP, SCALE_WIDTH = 0.2, 0.21  # distance of its colour scale, and width of the scale, inches
HEIGHTS = 1.0, 2.0, 3.0, 4.0, 5.0  # distances from the lens in a cone diagram, m
PARTS_OF_PEAK = (("half", 0.5, BLUE), ("tenth", 0.1, GREEN))  # beam edges: name, fraction of the peak, colour
LAMP_LIKE = 0.5  # smallest intensity on the axis of a lamp with a beam about it, as a fraction of the largest
MAX_EDGE = 80.0  # largest angle of a beam edge that a cone diagram shows, degrees
MM2_PER_M2 = 1e6
MAX_ISOLUX_PIXELS = 160  # number of pixels per side above which an isolux picture is averaged over blocks
PLANES = (("C0-C180", 0.0, BLUE, "-"), ("C90-C270", 90.0, VERMILION, "--"))  # planes: name, C, colour, line


def draw_far_field(far: FarField, lens: Lens, view: View) -> dict[str, bytes]:
    """Return the polar and the isocandela diagram and, for a lamp of known flux, the cone diagram; none without light.

    view: its coordinates are those of the isocandela diagram if it is over directions.
    """
    table = far.table(lens, rays=POINT_SOURCE_RAYS if far.sampler is None else RAYS)
    if not table.candela.any():
        return {}
    known = far.lumens is not None
    figures = {"polar": polar_diagram(table, known), "isocandela": isocandela_diagram(table, view, known=known)}
    if known and table.candela[:, 0].max() >= LAMP_LIKE * table.candela.max():
        figures["cone"] = cone_diagram(table)
    return {name: png(figure) for name, figure in figures.items()}


def draw_isolux(light: Light, lumens: float, view: View) -> dict[str, bytes]:
    """Return the isolux picture of the light on a plane, from a source of known flux (lm); none over directions."""
    if view.receiver.photometric_unit != "lx" or not light.picture.any():
        return {}
    peak = light.peak * light.on_screen * lumens * MM2_PER_M2
    return {numbered("isolux", view.number): png(isolux_picture(illuminance(light, lumens, view), view, peak))}


def illuminance(light: Light, lumens: float, view: View) -> np.ndarray:
    """Return the illuminance (lx) of each pixel (rows, columns) of a plane; row 0 is y max, column 0 is x min."""
    rows, columns = light.picture.shape
    area = (view.x[1] - view.x[0]) * (view.y[1] - view.y[0]) / (rows * columns) / MM2_PER_M2
    return light.picture * (light.on_screen * lumens / light.picture.sum() / area)


def unit_of(known: bool) -> str:
    """Return the unit of intensities; known: True if the flux of the source is known."""
    return "cd" if known else "cd/klm"


# --- intensities ------------------------------------------------------------------------------------------------------


def in_plane(table: Intensity, c: float, gamma: np.ndarray) -> np.ndarray:
    """Return the intensities in the half planes C (γ >= 0) and C + 180° (γ < 0), degrees."""
    return table.between(np.where(gamma >= 0, c, c + 180.0) % 360.0, np.abs(gamma))


def reach_of(table: Intensity) -> float:
    """Return the largest angle γ (degrees) with more than DARK times the largest intensity."""
    return float(table.along[np.flatnonzero(table.candela.max(0) > DARK * table.candela.max())[-1]])


def brightest_direction(table: Intensity) -> tuple[float, float]:
    """Return C and γ (degrees) of the largest intensity."""
    k, j = np.unravel_index(table.candela.argmax(), table.candela.shape)
    return float(table.around[k]), float(table.along[j])


@styled
def polar_diagram(table: Intensity, known: bool) -> Figure:
    """Draw the intensities in the planes C0-C180 and C90-C270 and in that of the maximum; γ = 0 points downwards.

    known: True if the flux of the source is known, so that the unit is cd.
    """
    from matplotlib.ticker import MaxNLocator

    c, at = brightest_direction(table)
    peak, reach = float(table.candela.max()), reach_of(table)
    half = next((angle for angle in SECTORS if angle >= reach), SECTORS[-1])
    gamma = np.linspace(-half, half, POLAR_POINTS)
    figure = new_figure(7.2, 4.2 if half > 30.0 else 5.4)
    axes: Any = figure.add_subplot(projection="polar")
    lines = list(PLANES)
    if at > 0 and c % 90.0:
        low = c % 180.0
        lines.append((f"C{number(low)}-C{number(low + 180.0)}, of the maximum", low, GREEN, ":"))
    for name, plane, colour, style in lines:
        axes.plot(np.radians(gamma), in_plane(table, plane, gamma), color=colour, linestyle=style, label=name)
    axes.set(theta_zero_location="S", thetamin=-half, thetamax=half, rlim=(0.0, 1.05 * peak))
    ticks = np.arange(-half, half + 1.0, half / 3 if half > 15.0 else 5.0)
    axes.set_xticks(np.radians(ticks), [f"{abs(tick):g}°" for tick in ticks])
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_formatter(lambda value, _: number(value))
    axes.spines[:].set(visible=True, color=GREY)
    axes.grid(True)
    figure.suptitle(f"Luminous intensity ({unit_of(known)}): {number(peak)} at C = {number(c)}°, γ = {number(at)}°",
                    x=0.02, ha="left", fontsize=9.5)  # fmt: skip
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper")
    footnote(figure, f"γ is the angle from +z.  On the right: C = 0°, 90°{' …' if len(lines) > 2 else ''}; "
                     "on the left: 180° more.")  # fmt: skip
    return figure


@styled
def isocandela_diagram(table: Intensity, view: View, *, known: bool) -> Figure:
    """Draw lines of equal intensity over two angles, in the coordinates of the view if it is over directions."""
    receiver = view.receiver if isinstance(view.receiver, Directions) else Directions("C")
    reach = min(1.15 * reach_of(table) + float(np.diff(table.along)[0]), 90.0)
    angle = np.linspace(-reach, reach, MAP_POINTS)
    x, y = np.meshgrid(angle, angle[::-1])
    values, peak = table.at(*receiver.direction(x, y)), float(table.candela.max())
    ends = (-reach, reach)
    seen = View(ends, ends, view.seen_from, view.optic, folded=view.folded, receiver=receiver)
    figure = new_figure(6.8, 5.4, layout="none")
    width, height = figure.get_size_inches()
    axes, scale = (
        figure.add_axes((left / width, MAP_BOTTOM / height, across / width, MAP_SIDE / height))
        for left, across in ((MAP_LEFT, MAP_SIDE), (MAP_LEFT + MAP_SIDE + SCALE_GAP, SCALE_WIDTH))
    )
    _contours(figure, axes, values, seen, label=f"luminous intensity ({unit_of(known)})", largest=peak, scale=scale)
    axes.set_title(f"Lines of equal luminous intensity, {unit_of(known)}")
    seen.note(figure, f"\n{LINES}")
    return figure


def _contours(
    figure: Figure, axes: Any, values: np.ndarray, view: View, *, label: str, largest: float, scale: Any = None
) -> None:
    """Draw values (rows, columns; row 0 is y max) in colours, with labelled lines at LEVELS times the largest value.

    scale: axes of the colour scale; None: they are placed beside the picture.
    """
    image = draw_picture(axes, values, view, cmap=steps("cividis", 82), vmin=0.0, vmax=largest)
    rows, columns = values.shape
    (left, right), (low, high) = view.x, view.y
    x = left + (np.arange(columns) + 0.5) * (right - left) / columns
    y = high - (np.arange(rows) + 0.5) * (high - low) / rows
    levels = [level * largest for level in LEVELS if values.min() < level * largest < values.max()]
    if levels:
        shades = ["white" if level < 0.5 * largest else "black" for level in levels]
        lines = axes.contour(x, y, values, levels, colors=shades, linewidths=0.8)
        axes.clabel(lines, fmt=number, fontsize=7)
    axes.set(xlim=view.across, ylim=view.y, ylabel=view.labels[1], aspect="equal")
    figure.colorbar(image, ax=axes, cax=scale, label=label)


@styled
def isolux_picture(lux: np.ndarray, view: View, peak: float) -> Figure:
    """Draw lines of equal illuminance on a plane; lux: (rows, columns) in lx, row 0 at y max; peak: the largest, lx."""
    block = max(1, math.ceil(max(lux.shape) / MAX_ISOLUX_PIXELS))
    rows, columns = (side // block for side in lux.shape)
    cut = lux[: rows * block, : columns * block].reshape(rows, block, columns, block).mean((1, 3))
    kept = [side * block / whole for side, whole in zip((rows, columns), lux.shape, strict=True)]
    x = (view.x[0], view.x[0] + kept[1] * (view.x[1] - view.x[0]))
    y = (view.y[1] - kept[0] * (view.y[1] - view.y[0]), view.y[1])
    seen = View(x, y, view.seen_from, view.optic, folded=view.folded, receiver=view.receiver)
    figure = new_figure(6.4, 1.4 + 4.4 * min(view.proportion, 1.1), layout="compressed")
    axes = figure.subplots()
    _contours(figure, axes, cut, seen, label="illuminance (lx)", largest=float(cut.max()))
    axes.set_title(f"Illuminance: {quantity(float(lux.mean()), 'lx')} on average, up to "
                   f"{quantity(peak, 'lx')}")  # fmt: skip
    averaged = f"  Averages of {block} x {block} pixels." if block > 1 else ""
    seen.note(figure, f"\n{LINES}{averaged}")
    return figure


# --- the beam of a lamp -----------------------------------------------------------------------------------------------


def beam_edges(table: Intensity, c: float, part: float) -> tuple[float, float]:
    """Return the angles (degrees) in the half planes C and C + 180° at which I falls below `part` of the maximum.

    The angle is the first one from the axis, by linear interpolation; the last angle of the table if there is none.
    """
    limit, gamma = part * float(table.candela.max()), table.along
    edges = []
    for plane in (c, c + 180.0):
        values = in_plane(table, plane % 360.0, gamma)
        below = np.flatnonzero(values < limit)
        j = int(below[0]) if len(below) else len(gamma) - 1
        if j == 0 or not len(below):
            edges.append(float(gamma[j]))
            continue
        fall = (values[j - 1] - limit) / (values[j - 1] - values[j])
        edges.append(float(gamma[j - 1] + fall * (gamma[j] - gamma[j - 1])))
    return edges[0], edges[1]


@styled
def cone_diagram(table: Intensity) -> Figure:
    """Draw the edges of the beam at half and at a tenth of the peak over the distance, with the illuminance (lx) there.

    table: intensities in cd.  On the axis E = I / h² at the distance h; the width is h (tan γ_1 + tan γ_2).
    """
    on_axis = float(table.candela[:, 0].mean())
    figure = new_figure(8.2, 4.6)
    panels = figure.subplots(1, 2, sharey=True)
    far = HEIGHTS[-1]
    for axes, (name, plane, _, _) in zip(panels, PLANES, strict=True):
        for words, part, colour in PARTS_OF_PEAK:
            right, left = (math.tan(math.radians(min(e, MAX_EDGE))) for e in beam_edges(table, plane, part))
            axes.fill([0.0, right * far, -left * far], [0.0, far, far], color=colour, alpha=0.18, linewidth=0)
            axes.plot([-left * far, 0.0, right * far], [far, 0.0, far], color=colour, label=f"{words} of the peak")
        inner, outer = (
            sum(math.tan(math.radians(min(e, MAX_EDGE))) for e in beam_edges(table, plane, part))
            for _, part, _ in PARTS_OF_PEAK
        )
        for height in HEIGHTS:
            axes.axhline(height, color=GREY, linewidth=0.5)
            widths = f"Ø {number(inner * height)} / {number(outer * height)} m"
            axes.annotate(widths, (1.0, height), xycoords=("axes fraction", "data"), xytext=(-2, 2),
                          textcoords="offset points", ha="right", fontsize=7.5)  # fmt: skip
        axes.set(xlabel=f"{name}, C = {plane:g}° on the right (m)", ylim=(1.06 * far, 0.0), title=f"Plane {name}")
        low, high = axes.get_xlim()
        axes.set_xlim(low, high + 0.45 * (high - low))  # room for the widths
        axes.set_yticks(HEIGHTS, [f"{h:g} m: {number(on_axis / h**2)} lx" for h in HEIGHTS])
    panels[0].set_ylabel("distance, and illuminance on the axis")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    footnote(figure, f"{number(on_axis)} cd on the axis, {number(float(table.candela.max()))} cd at most.  "
                     "Ø: width of the beam at half and at a tenth of the largest intensity.")  # fmt: skip
    return figure
