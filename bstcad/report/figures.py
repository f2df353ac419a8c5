"""The figures of a lens, of its flux and of its design's convergence, each a function from plain values to a Figure.

Maps have row 0 at y min; axes are in mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from bstcad.analysis.shape import least_squares
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.rays import TiltedPlane
from bstcad.report.drawing import BLUE, GLASS, GREY, VERMILION, new_figure, round_up, steps, styled
from bstcad.report.light_figures import View, footnote, tilted
from bstcad.report.record import Point, Stage
from bstcad.report.units import turned

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROUNDING = 1e-6  # a map that varies less than this part of its size is flat and gets no contour lines
MAP_POINTS = 401  # samples of a surface map along each axis


# --- light ------------------------------------------------------------------------------------------------------------


@styled
def flux_ledger(flux: Mapping[str, float]) -> Figure:
    """The flux ledger: a bar for each of its lines, which sum to 1."""
    names, parts = list(flux), 100.0 * np.array(list(flux.values()), dtype=float)
    figure = new_figure(5.4, 0.7 + 0.32 * len(names))
    axes = figure.subplots()
    axes.barh(names, parts, color=[BLUE if name == "on target" else VERMILION for name in names], height=0.6)
    for line, part in enumerate(parts):
        inside = part > 80.0
        side = {"ha": "right", "color": "white"} if inside else {"ha": "left", "color": "black"}
        axes.text(part - 1 if inside else part + 1, line, f"{part:.3g} %", va="center", fontsize=8.5, **side)
    axes.invert_yaxis()
    axes.set(xlim=(0, 100), xlabel="% of the source's flux", title="Where the light goes")
    axes.tick_params(axis="y", length=0)
    return figure


# --- lens -------------------------------------------------------------------------------------------------------------


@styled
def surface_maps(lens: Lens, steepest: float) -> Figure:
    """Samples of the back surface inside the outline: height, slope angle, mean curvature (optics.bspline.principal).

    steepest: slope of the back (degrees), which the samples would miss.

    The best plane is taken off the height where it hides the rest (its PV exceeds that of the remainder).
    """
    x, y, sag, slope_x, slope_y = _sample(lens)
    plane = _best_plane(x, y, sag)
    tilted = np.nanmax(plane) - np.nanmin(plane) > np.nanmax(sag - plane) - np.nanmin(sag - plane)
    height = sag - plane if tilted else sag - np.nanmean(sag)
    pv = float(np.nanmax(height) - np.nanmin(height))
    scale, unit = (1.0, "mm") if pv >= 0.5 else (1e3, "µm")
    slope = np.degrees(np.arctan(np.hypot(slope_x, slope_y)))
    (z_xy, z_xx), z_yy = np.gradient(slope_x, y, x), np.gradient(slope_y, y, axis=0)
    across = (1 + slope_y**2) * z_xx - 2 * slope_x * slope_y * z_xy + (1 + slope_x**2) * z_yy
    bend = 500.0 * across / (1 + slope_x**2 + slope_y**2) ** 1.5  # 1/m
    edge = round_up(float(np.nanpercentile(np.abs(bend), 99.0)))

    figure = new_figure(11.0, 3.7, layout="compressed")
    panels = figure.subplots(1, 3, sharey=True)
    drawn = [
        _surface(panels[0], x, y, scale * height, cmap=steps("cividis", 82)),
        _surface(panels[1], x, y, slope, cmap=steps("cividis", 82)),
        _surface(panels[2], x, y, bend, cmap=steps("PuOr", 82), vmin=-edge, vmax=edge),
    ]
    panels[0].set_title(f"Height{', best plane removed' if tilted else ''}: PV {scale * pv:.3g} {unit}")
    panels[1].set_title(f"Slope: up to {steepest:.3g}°")
    panels[2].set_title("Mean curvature, + bends towards +z")
    panels[0].set_ylabel("y (mm)")
    for axes, shown, label in zip(panels, drawn, (unit, "degrees", "1/m"), strict=True):
        extend = "both" if axes is panels[2] else "neither"
        bar = figure.colorbar(shown, ax=axes, label=label, fraction=0.046, pad=0.03, extend=extend)
        values = shown.get_array()
        if axes is not panels[2] and np.nanmax(values) - np.nanmin(values) > ROUNDING * (1 + np.nanmax(np.abs(values))):
            bar.add_lines(axes.contour(x, y, values, 10, colors="white", linewidths=0.35))
    return figure


def _surface(axes: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, **shades: Any) -> Any:
    """Draw `values` (row 0 = y min) sampled at x and y (mm)."""
    axes.set_xlabel("x (mm)")
    axes.spines[:].set_visible(False)
    place = {"extent": (x[0], x[-1], y[0], y[-1]), "origin": "lower"}
    return axes.imshow(values, interpolation_stage="data", **place, **shades)


def _sample(lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """x (n,), y (n,) and sag (mm), ∂z/∂x, ∂z/∂y (n, n) of the back surface, row 0 = y min, NaN outside the outline."""
    reach_x, reach_y = lens.outline.half_extent
    x = torch.linspace(-reach_x, reach_x, MAP_POINTS, dtype=torch.float64)
    y = torch.linspace(-reach_y, reach_y, MAP_POINTS, dtype=torch.float64)
    grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
    inside = lens.outline.contains(grid_x, grid_y)
    back = lens.back.plain()
    maps = (torch.where(inside, part, torch.nan) for part in back.sag_and_slope(grid_x, grid_y))
    return tuple(part.detach().numpy() for part in (x, y, *maps))


def _best_plane(x: np.ndarray, y: np.ndarray, sag: np.ndarray) -> np.ndarray:
    """Least-squares plane of sag (rows y, columns x) over its finite points; NaN where sag is."""
    grid_x, grid_y = np.meshgrid(x, y)
    columns = np.stack([np.ones_like(grid_x), grid_x, grid_y], axis=-1)
    known = np.isfinite(sag)
    plane = columns @ least_squares(columns[known], sag[known])
    return np.where(known, plane, np.nan)


@styled
def side_view(lens: Lens, rays: np.ndarray, screen: Screen | None = None) -> Figure:
    """The lens cut along y = 0 with rays (n_rays, n_points, 3) in mm projected on x-z: close, and the whole path.

    A tilted screen is drawn too, as its edges are seen along y.
    """
    figure = new_figure(11.0, 3.4)
    close, whole = figure.subplots(1, 2, width_ratios=(1, 1.9))
    reach = lens.outline.half_extent[0]
    x = torch.linspace(-reach, reach, MAP_POINTS, dtype=torch.float64)
    faces = (lens.front.plain(), lens.back.plain())
    front, back = (face.sag_and_slope(x, torch.zeros_like(x))[0].detach().expand_as(x) for face in faces)
    rim_z, rim_x = torch.cat([front, back.flip(0)]).numpy(), torch.cat([x, x.flip(0)]).numpy()
    for axes in (close, whole):
        axes.plot(rays[:, :, 2].T, rays[:, :, 0].T, color=VERMILION, linewidth=0.6, alpha=0.8)
        axes.fill(rim_z, rim_x, facecolor=GLASS, edgecolor=BLUE, linewidth=1.0)
        axes.set(xlabel="z (mm)", ylabel="x (mm)")
    low, high = rim_z.min(), rim_z.max()
    close.set(xlim=(low - reach * 0.5, high + reach * 0.5), ylim=(-1.25 * reach, 1.25 * reach))
    close.set(title=f"{'Mirror' if lens.reflects else 'Lens'}, cut along y = 0", aspect="equal")
    whole.set_title("Whole path, source to target (axes not to one scale)")
    if screen is not None and isinstance(plane := screen.plane, TiltedPlane):
        edges = np.array([plane.point(x, y) for x, y in product(screen.x, screen.y)])[[0, 1, 3, 2]]
        whole.fill(edges[:, 2], edges[:, 0], facecolor="none", edgecolor=GREY, linewidth=1.0, gid="screen")
        footnote(figure, f"Grey: the target, its plane tilted by {turned(screen.tilt)}.")
    return figure


@styled
def transport_map(source: np.ndarray, image: np.ndarray, view: View) -> Figure:
    """Lines of a regular grid (k, k, 2) on the source beside their images (k, k, 2) on the target, both in mm."""
    figure = new_figure(8.2, 4.1)
    titles = ("Regular grid on the source", "The same lines on the target")
    for axes, points, title in zip(figure.subplots(1, 2), (source, image), titles, strict=True):
        for lines, colour in ((points, BLUE), (points.swapaxes(0, 1), VERMILION)):
            axes.plot(lines[..., 0].T, lines[..., 1].T, color=colour, linewidth=0.6)
        axes.set(title=title, xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
        axes.xaxis.set_inverted(view.seen_from == "lens")
    footnote(figure, f"{view.words}.{tilted(view.tilt)}")
    return figure


# --- time -------------------------------------------------------------------------------------------------------------


@styled
def convergence(history: Sequence[Point], stages: Sequence[Stage], noise: float) -> Figure:
    """RRMSD against seconds since the start; each stage is a band as wide as it took, the standard error a line."""
    seconds = np.array([point.seconds for point in history], dtype=float)
    values = np.array([point.rrmsd for point in history], dtype=float)
    figure = new_figure(5.2, 3.2)
    axes = figure.subplots()
    axes.plot(seconds, values, color=BLUE, marker="." if len(values) < 100 else "", markersize=4)
    if seconds.min() > 0.0 and seconds.max() > 30.0 * seconds.min():
        axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set(xlabel="time (s)", ylabel="RRMSD")
    axes.set_title(f"RRMSD: {values[0]:.2g} at the start, {values[-1]:.2g} at the end", pad=16)
    resolved = noise > values.min() / 20  # else it is far below the curve
    axes.set_ylim(0.7 * min(values.min(), noise if resolved else np.inf), 1.2 * values.max())
    if resolved:
        axes.axhline(noise, color=GREY, linestyle="--", linewidth=0.9)
        right_end = axes.get_yaxis_transform()
        axes.text(0.99, noise * 1.05, "standard error", transform=right_end, ha="right", color=GREY, fontsize=8)
    _plain_ticks(axes)
    _mark_stages(axes, stages, seconds)
    axes.grid(axis="y", which="both")
    return figure


def _plain_ticks(axes: Axes) -> None:
    """Ticks at 1, 2, 5 times powers of ten (every digit within half a decade), written as plain decimals."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

    scaled = [axes.yaxis] + ([axes.xaxis] if axes.get_xscale() == "log" else [])
    for axis in scaled:
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high > 5.0 * low else np.arange(1.0, 10.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())
        axis.set_minor_formatter(NullFormatter())


def _mark_stages(axes: Axes, stages: Sequence[Stage], seconds: np.ndarray) -> None:
    """A thin line where each stage ends, and its name above the frame where there is room."""
    ends = np.cumsum([stage.seconds for stage in stages])
    low, high = float(min(seconds.min(), ends[0])) if len(ends) else 0.0, float(max(seconds.max(), *ends, 0.0))
    axes.set_xlim(low * (0.9 if axes.get_xscale() == "log" else 0.0), high * 1.02)
    place = axes.transData + axes.transAxes.inverted()
    start = axes.get_xlim()[0]
    for stage, end in zip(stages, ends, strict=True):
        left, right = (float(place.transform((t, axes.get_ylim()[0]))[0]) for t in (start, end))
        axes.axvline(end, color=GREY, linewidth=0.6, linestyle=":")
        if right - left > 0.0165 * len(stage.name):
            centre = (left + right) / 2
            axes.text(centre, 1.015, stage.name, transform=axes.transAxes, ha="center", color=GREY, fontsize=8)
        start = end
