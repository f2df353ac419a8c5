"""The colours of light: what a camera that is balanced to the source's white sees of a picture in each line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# The 1931 standard observer as sums of Gaussians with two widths: weight, centre, width below and above it (nm).
# Wyman, Sloan and Shirley, Journal of Computer Graphics Techniques 2(2), 2013, multi-lobe fit.
LOBES = (
    ((1.056, 599.8, 37.9, 31.0), (0.362, 442.0, 16.0, 26.7), (-0.065, 501.1, 20.4, 26.2)),
    ((0.821, 568.8, 46.9, 40.5), (0.286, 530.9, 16.3, 31.1)),
    ((1.217, 437.0, 11.8, 36.0), (0.681, 459.0, 26.0, 13.8)),
)
# From XYZ to linear sRGB, IEC 61966-2-1.
TO_SRGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])


def primary(wavelength: float) -> np.ndarray:
    """Linear sRGB (3,) of one line (nm); colours that no screen shows have negative parts, which are left out."""
    xyz = [sum(_lobe(wavelength, *lobe) for lobe in lobes) for lobes in LOBES]
    return np.maximum(TO_SRGB @ np.array(xyz), 0.0)


def balanced(pictures: Sequence[np.ndarray], wavelengths: Sequence[float], shares: Sequence[float]) -> np.ndarray:
    """(rows, columns, 3): red, green and blue irradiance of light whose lines' pictures (rows, columns) have one sum.

    Each colour is divided by what it is where all lines are alike, so that light of the source's own white is grey;
    a colour that no line has takes the mean of all.
    """
    parts = np.array([share * primary(nm) for nm, share in zip(wavelengths, shares, strict=True)])  # (lines, 3)
    white = parts.sum(0)
    alone = np.asarray(shares, dtype=np.float64)[:, None]
    weights = np.where(white > 1e-6 * white.max(initial=0.0), parts / np.where(white > 0, white, 1.0), alone)
    return np.tensordot(np.array(pictures), weights, axes=(0, 0))


def _lobe(wavelength: float, weight: float, centre: float, below: float, above: float) -> float:
    width = below if wavelength < centre else above
    return weight * float(np.exp(-0.5 * ((wavelength - centre) / width) ** 2))
