"""Figures of a dome's back over directions from its centre: distance, slope and mean curvature.

A direction at the angle θ from the axis and the azimuth ψ is drawn at θ (cos ψ, sin ψ), in degrees, so that the part of
the dome that overhangs is shown too.  With the unit normal n out of the lens the mean curvature is

    H = (l G - 2 m F + k E) / (2 (E G - F²)),    l = -n_x · S_x,  2 m = -n_x · S_y - n_y · S_x,  k = -n_y · S_y,

with the first fundamental form E, F, G (do Carmo 1976, section 3.3); H > 0 in a hollow, as seen from outside.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from bstcad.analysis.shape import MAX_RADIUS, Survey
from bstcad.figures.drawing import footnote, new_figure, round_up, steps, styled
from bstcad.optics.lens import domes
from bstcad.optics.lens.lens import Lens
from bstcad.report.units import quantity

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAP_POINTS = 401  # number of samples of a map along each axis
ANGLE_LABELS = ("θ cos ψ (degrees)", "θ sin ψ (degrees)")  # names of the axes of a map over directions
ROUNDING = 1e-6  # relative variation below which a map has no contour lines


def in_angles(lens: Lens, places: np.ndarray) -> np.ndarray:
    """Return θ (cos ψ, sin ψ) (degrees), (…, 2), of coordinates (…, 2) (mm) in the chart of a dome."""
    length = np.hypot(places[..., 0], places[..., 1])[..., None]
    theta = np.degrees(2 * np.arctan(length / (2 * domes.radial_back(lens).radius)))
    return places * theta / np.where(length > 0, length, 1.0)


@styled
def dome_maps(lens: Lens, found: Survey) -> Figure:
    """Draw maps of the distance from the centre, of the slope and of the mean curvature of a dome inside its outline.

    found: extreme values of the back, which the samples of the maps may miss.
    """
    dome = domes.radial_back(lens)
    half = math.degrees(dome.chart.angle(domes.rim_radius(lens.outline), dome.radius))
    line = np.linspace(-half, half, MAP_POINTS)
    across, up = np.meshgrid(line, line)
    theta = np.hypot(across, up)
    shown = theta <= half * (1 + 1e-9)
    stretch = 2 * dome.radius * np.tan(np.radians(np.minimum(theta, half)) / 2) / np.where(theta > 0, theta, 1.0)
    x, y = (torch.from_numpy(np.ascontiguousarray(stretch * part)) for part in (across, up))
    patch = dome.at(x, y)
    position, along_x, along_y = (part.numpy() for part in patch)
    normal = patch.normal.numpy()
    normal = normal / np.sqrt((normal * normal).sum(0))
    distance = np.sqrt((position * position).sum(0))
    slope = np.degrees(np.arccos(np.clip(normal[2], -1.0, 1.0)))
    bend = mean_curvature(along_x, along_y, normal, (x.numpy(), y.numpy()))
    values = [np.where(shown, part, np.nan) for part in (distance, slope, bend)]
    edge = round_up(float(np.nanpercentile(np.abs(values[2]), 99.0)))

    figure = new_figure(11.0, 3.7, layout="compressed")
    panels = figure.subplots(1, 3, sharey=True)
    panels[0].set_ylabel(ANGLE_LABELS[1])
    pv = float(np.nanmax(values[0]) - np.nanmin(values[0]))
    maps = (
        (values[0], "mm", f"Distance from the centre: PV {pv:.3g} mm"),
        (values[1], "degrees", f"Slope: up to {found.slope.largest:.3g}°"),
        (values[2], "1/mm", "Mean curvature (+ hollow, \u2212 bulge)"),
    )
    place = {"extent": (-half, half, -half, half), "origin": "lower", "interpolation_stage": "data"}
    for axes, (part, label, title) in zip(panels, maps, strict=True):
        signed = axes is panels[2]
        shades = {"cmap": steps("PuOr", 82), "vmin": -edge, "vmax": edge} if signed else {"cmap": steps("cividis", 82)}
        image = axes.imshow(part, **place, **shades)
        axes.set(xlabel=ANGLE_LABELS[0], title=title)
        axes.spines[:].set_visible(False)
        bar = figure.colorbar(
            image, ax=axes, label=label, fraction=0.046, pad=0.03, extend="both" if signed else "neither"
        )
        if not signed and np.nanmax(part) - np.nanmin(part) > ROUNDING * (1 + np.nanmax(np.abs(part))):
            bar.add_lines(axes.contour(line, line, part, 10, colors="white", linewidths=0.35))
    if found.slope.largest > 90.0:
        panels[1].contour(line, line, values[1], [90.0], colors="#d55e00", linewidths=1.2)
    radii = (("concave", found.concave), ("convex", found.convex))
    words = (f"{n}, {quantity(r.largest, 'mm')} {r.where}" for n, r in radii if r.largest < MAX_RADIUS)
    steep = " Beyond the red line, at 90°, the dome overhangs." if found.slope.largest > 90.0 else ""
    footnote(figure, f"Smallest radii of curvature, seen from outside: {'; '.join(words) or 'none'}.{steep}")
    return figure


def mean_curvature(
    along_x: np.ndarray, along_y: np.ndarray, normal: np.ndarray, chart: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return the mean curvature (1/mm), (r, c), from tangents and unit normals (3, r, c) on a grid of a chart.

    chart: x and y (r, c) of the points in the chart (mm).  The derivatives of the normal are central differences along
    the grid, turned into those along x and y.
    """
    (x_v, x_u), (y_v, y_u) = (np.gradient(part) for part in chart)
    det = x_u * y_v - x_v * y_u
    n_v, n_u = (np.stack(part) for part in zip(*(np.gradient(part) for part in normal), strict=True))
    det = np.where(np.abs(det) > 0, det, np.inf)  # beyond the half angle the chart repeats its rim
    n_x, n_y = (n_u * y_v - n_v * y_u) / det, (n_v * x_u - n_u * x_v) / det
    e, f, g = (along_x**2).sum(0), (along_x * along_y).sum(0), (along_y**2).sum(0)
    l, k = -(n_x * along_x).sum(0), -(n_y * along_y).sum(0)  # noqa: E741 - the names of the second fundamental form
    m = -((n_x * along_y).sum(0) + (n_y * along_x).sum(0)) / 2
    return (l * g - 2 * m * f + k * e) / (2 * (e * g - f * f))
