"""Outliers: isolated points by dust, glints and slips of an instrument, as against form errors, which cover an area.

A point is compared with the plane through its nearest neighbours.  It is an outlier if it lies farther from that plane
than noise and form error explain, and too few neighbours lie beside it: pits, bumps and edges of more points are form.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

NEIGHBOURS = 24  # of each point
TOGETHER = 8  # neighbours at the same distance, to half of it, that make an area
FAR = 6.0  # standard deviations, by the median of the absolute deviations (MAD), over the face or nearby
MAD = 1.4826  # from the MAD of normal numbers to their standard deviation
CAUCHY = 2.0  # standard deviations at which a neighbour's weight is halved
ROUNDS = 3  # of weighing the neighbours anew
AT_A_TIME = 20_000  # points
FINEST = 1e-6  # mm: below any measurement, above rounding


def alone(
    points: np.ndarray, distances: np.ndarray, asked: np.ndarray, noise: float | None = None
) -> tuple[np.ndarray, float]:
    """(True for outliers (n,) among points (n, 3) in mm at distances (n,) from the face, the noise in mm).

    asked: (n,) points to be judged; the others are neighbours only.  noise: over the face, if it is known.
    """
    found = np.zeros(len(points), dtype=bool)
    which = np.flatnonzero(asked)
    if len(points) <= NEIGHBOURS or not len(which):
        return found, noise or 0.0
    tree = cKDTree(points[:, :2])
    parts = (_part(tree, distances, which[k : k + AT_A_TIME]) for k in range(0, len(which), AT_A_TIME))
    off, spread, together = map(np.concatenate, zip(*parts, strict=True))
    if noise is None:
        noise = MAD * float(np.median(np.abs(off)))
    found[which] = (np.abs(off) > FAR * np.maximum(spread, noise) + FINEST) & (together < TOGETHER)
    return found, noise


def _part(tree: cKDTree, distances: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of some points: distance from the plane of the neighbours, spread of these (mm), number of them beside the point.

    The plane is that of least squares by Cauchy's weights, which begin with the neighbours' median.
    """
    places = tree.data[part]
    _, near = tree.query(places, NEIGHBOURS + 1)
    near = near[:, 1:]  # without the point itself
    found = distances[near]
    across = tree.data[near] - places[:, None]
    size = np.abs(across).max(axis=(1, 2))[:, None, None] + FINEST
    columns = np.concatenate([np.ones_like(found)[..., None], across / size], axis=2)
    left = found - np.median(found, axis=1)[:, None]
    for _ in range(ROUNDS):
        spread = MAD * np.median(np.abs(left), axis=1)[:, None] + FINEST
        weighted = columns / (1 + (left / (CAUCHY * spread)) ** 2)[..., None]
        normal = np.einsum("nki,nkj->nij", weighted, columns) + 1e-6 * np.eye(3)  # neighbours may lie on a line
        plane = np.linalg.solve(normal, np.einsum("nki,nk->ni", weighted, found)[..., None])
        left = found - (columns @ plane)[..., 0]
    off = distances[part] - plane[:, 0, 0]  # the plane where the point stands
    with_it = np.abs(left - off[:, None]) < np.abs(off)[:, None] / 2
    return off, MAD * np.median(np.abs(left), axis=1), with_it.sum(axis=1)
