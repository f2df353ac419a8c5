"""Errors of the form of a face, as heights of its control net: random fields, and the marks that a tool leaves.

Control points that are the values of a field are its spline but for a part (pitch / length)², so a field is only made
where it is smooth over a few control cells.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens

SMOOTH = 4.0  # control cells, at least, a correlation length or a period


def random_field(surface: BSplineSurface, correlation_length: float, seed: int, inside: np.ndarray) -> np.ndarray:
    """(m, m) a Gaussian random field of RMS 1 and mean 0 over `inside`, of covariance exp(-(r / correlation_length)²).

    correlation_length (mm); white noise drawn with the seed, smoothed by a Gaussian of half of it as standard deviation
    (the covariance of what that makes is wider by √2).  ValueError if the net is too coarse for it.
    """
    _resolved(surface, correlation_length, "a correlation length")
    cells = [correlation_length / 2 / pitch for pitch in surface.pitch]
    margin = [int(np.ceil(4 * c)) for c in cells]
    shape = [surface.m + 2 * k for k in margin]  # so that no border is felt
    noise = gaussian_filter(np.random.default_rng(seed).standard_normal(shape), cells, truncate=4.0)
    return _of_rms_one(noise[margin[0] : margin[0] + surface.m, margin[1] : margin[1] + surface.m], inside)


def ripple(surface: BSplineSurface, period: float, kind: Literal["raster", "spiral"], inside: np.ndarray) -> np.ndarray:
    """(m, m) what a tool leaves: sin(2π s / period) of RMS 1 over `inside`.

    s is x for a raster, the distance from the axis for the spiral of a diamond tool, whose turns are circles by eye.
    period (mm).  ValueError if the net is too coarse for it.
    """
    _resolved(surface, period, "a ripple's period")
    x, y = (np.linspace(*side, surface.m) for side in (surface.x, surface.y))
    s = np.broadcast_to(x[:, None], (surface.m, surface.m)) if kind == "raster" else np.hypot(x[:, None], y[None, :])
    return _of_rms_one(np.sin(2 * np.pi * s / period), inside)


def inside(lens: Lens) -> np.ndarray:
    """(m, m) which control points of the back lie inside the outline."""
    x, y = (torch.linspace(*side, lens.back.m, dtype=torch.float64) for side in (lens.back.x, lens.back.y))
    return lens.outline.contains(*torch.meshgrid(x, y, indexing="ij")).numpy()


def raised(lens: Lens, heights: np.ndarray) -> Lens:
    """The lens with its back higher by these heights (m, m) (mm)."""
    back = lens.back
    return replace(lens, back=replace(back, heights=back.heights + torch.from_numpy(heights).to(back.heights)))


def _resolved(surface: BSplineSurface, length: float, what: str) -> None:
    least = SMOOTH * max(surface.pitch)
    if length < least:
        raise ValueError(
            f"{what} of {length:g} mm is too fine for {surface.m} x {surface.m} control points, which carry "
            f"{least:.3g} mm and more; give a longer one, or a lens of more control points"
        )


def _of_rms_one(field: np.ndarray, where: np.ndarray) -> np.ndarray:
    field = field - field[where].mean()
    return field / np.sqrt(np.mean(field[where] ** 2))
