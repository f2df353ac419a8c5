"""Correct of a measured deviation only what changes the picture: low orders through the Jacobian of the irradiance.

Let e = Σ a_k L_k + f be the deviation of a back, L_k the products of Legendre polynomials up to the order MAX_ORDER,
and f the rest, the relief of short waves.  The irradiance follows the second derivatives of the face: f is thin and
harms the picture most, so that it is corrected as by form.  Low orders are thick and only move the light.  In their
coefficients the irradiance is linear, and the correction b of least volume is sought by

    minimise |J (a + b)|² + λ |b|²,

where |b|² is the mean square of the correction over the face, and |J (a + b)| the RRMSD between the picture of the
design and that of the corrected part.  λ is the largest for which |J (a + b)|² stays below (1 + TOLERANCE)² - 1 times
the square of the RRMSD of the design, so that the RRMSD grows by TOLERANCE at most.  What b leaves of the low orders
is the form error that may stay.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from bstcad.designs.designed_lens import DesignedLens
from bstcad.optics.surfaces.bspline import BSplineSurface, interpolating_net
from bstcad.optics.trace.measure import tubes_picture

MAX_ORDER = 6  # largest degree in x plus degree in y of the Legendre polynomials
STEP = 2e-4  # mm; amplitude of a polynomial for its column of the Jacobian
TUBES_PER_PIXEL = 1.0  # tubes per pixel along each axis for the Jacobian
MIN_TUBES = 256
TOLERANCE = 0.05  # increase of the RRMSD relative to the design's
WEIGHTS = np.logspace(-12, 2, 57)  # λ, relative to the largest eigenvalue of Jᵀ J


def polynomials(shape: tuple[int, ...]) -> np.ndarray:
    """Return the Legendre polynomials (k, m, n) over the net of orders 1 to MAX_ORDER; without the constant."""
    u, v = (np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, count), MAX_ORDER) for count in shape)
    orders = [(i, j) for i in range(MAX_ORDER + 1) for j in range(MAX_ORDER + 1 - i) if i + j > 0]
    return np.stack([np.multiply.outer(u[:, i], v[:, j]) for i, j in orders])


def jacobian(made: DesignedLens, net: BSplineSurface, columns: np.ndarray) -> np.ndarray:
    """Return J (pixels, k): changes of the pictures per mm of each of `columns` (k, m, n), relative to their targets.

    Pictures of all goals, each relative to the root of the sum of squares of its target, are joined in one vector.
    """

    def pictures(heights: np.ndarray) -> np.ndarray:
        back = replace(net, heights=net.heights + torch.from_numpy(interpolating_net(heights)))
        lens, parts = made.lens.with_back(back), []
        for goal in made.goals:
            n = max(MIN_TUBES, math.ceil(TUBES_PER_PIXEL * max(goal.screen.shape)))
            flux = tubes_picture(lens, made.channels, goal.screen, n).cpu().numpy()
            parts.append((flux / flux.sum()).ravel() / np.linalg.norm(goal.picture / goal.picture.sum()))
        return np.concatenate(parts)

    return np.stack([(pictures(STEP * each) - pictures(-STEP * each)) / (2 * STEP) for each in columns], axis=1)


def staying(made: DesignedLens, deviation: np.ndarray, inside: np.ndarray, rrmsd: float) -> np.ndarray:
    """Return the part (m, n) of a deviation (m, n) of the back, in mm, that may stay in its low orders.

    inside: True (m, n) at the points inside the outline.  rrmsd: RRMSD of the design.
    """
    net = made.lens.back_net
    columns = polynomials(net.shape)
    within = columns[:, inside].T  # (points, k)
    a = np.linalg.lstsq(within, deviation[inside] - deviation[inside].mean(), rcond=None)[0]
    j = jacobian(made, net, columns)
    root = np.linalg.cholesky(within.T @ within / len(within))  # |rootᵀ b|²: mean square of the correction
    of_light = np.linalg.solve(root, np.linalg.solve(root, j.T @ j).T)  # in coordinates whose norm is the RMS
    size, axes = np.linalg.eigh((of_light + of_light.T) / 2)
    gradient = axes.T @ np.linalg.solve(root, j.T @ (j @ a))
    allowed = math.sqrt((1 + TOLERANCE) ** 2 - 1) * rrmsd
    best = -a
    for weight in WEIGHTS * float(size[-1]):
        b = -np.linalg.solve(root.T, axes @ (gradient / (np.maximum(size, 0.0) + weight)))
        if np.linalg.norm(j @ (a + b)) > allowed:
            break
        best = b
    return np.tensordot(a + best, columns, 1)
