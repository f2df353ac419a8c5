"""Figures for the shop: a round of compensation, and the material that a tool leaves where it does not reach a face."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bstcad.figures.drawing import footnote, new_figure, png, round_up, steps, styled
from bstcad.figures.light_figures import FORM_UNITS
from bstcad.report.units import quantity

TITLES = "Measured − designed", "Correction", "Expected to remain"
BINS = 160  # largest number of cells along the longer side of a map of points, each with its largest value
POINTS_PER_BIN = 5.0  # mean number of points in a cell; with one at random in each of a fine grid's cells none is empty


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


@styled
def left_figure(points: np.ndarray, clearance: np.ndarray, cusp: float) -> bytes:
    """Return a map of the material that a tool leaves as PNG, with a line around the places that it does not reach.

    points: places (n, 3) in mm; clearance: material (n,) left there, mm; cusp: highest material (mm) where it reaches.
    """
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    side = float(np.prod(high - low) / len(points) * POINTS_PER_BIN) ** 0.5  # mm
    side = max(side, float((high - low).max()) / BINS)
    counts = np.maximum(np.round((high - low) / side), 1).astype(int)
    place = np.minimum(((points[:, :2] - low) / (high - low) * counts).astype(int), counts - 1)
    largest = np.full(counts[::-1], np.nan)
    np.fmax.at(largest, (place[:, 1], place[:, 0]), clearance)
    figure = new_figure(6.4, 1.2 + 5.0 * (high[1] - low[1]) / (high[0] - low[0]), layout="compressed")
    axes = figure.subplots()
    extent = {"extent": (low[0], high[0], low[1], high[1]), "origin": "lower"}
    image = axes.imshow(1e3 * largest, cmap=steps("viridis", 41), vmin=0.0, interpolation_stage="data", **extent)
    beyond = np.nan_to_num(largest) > cusp
    if beyond.any() and not beyond.all():
        axes.contour(beyond, levels=[0.5], colors="#d55e00", linewidths=1.0, **extent)
    axes.set(title="Material left by the tool", xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
    axes.spines[:].set_visible(False)
    figure.colorbar(image, ax=axes, label="µm", fraction=0.046, pad=0.03)
    footnote(figure, "The line surrounds the places that the tool does not reach.")
    return png(figure)
