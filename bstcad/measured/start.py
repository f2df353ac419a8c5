"""Where to begin an alignment: shifts of millimetres, turns of degrees; and axes that somebody swapped.

A few thousand points, weighted so that those of sides and front do not pull, go from several starts; the best is kept,
and the cloud as it was given unless another is clearly better.  Only proper motions are tried.  That a cloud fits once
its axes are exchanged or turned over is found apart, to name the fault.
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
import torch

from bstcad.measured.alignment import Face, Pose, step, unmoved

SAMPLE = 3000  # points
STEPS, FEW_STEPS = 40, 15  # from each start; where only the axes are in question
SHARE = 0.25  # of all points that a start must bring near the face
BETTER = 0.5  # of the distance that the cloud as given comes to: a start that does as well takes its place
RING = 0.15  # of the half width: decentres that are tried where the nearest starts do not fit


def found(face: Face, cloud: np.ndarray, good: float) -> tuple[Pose, float]:
    """(the best start, distance in mm that a quarter of the points keep to); good: one that needs no further search."""
    sample = _sample(cloud)
    low, high = np.percentile(sample, (1, 99), axis=0)
    middle = (low + high)[:2] / 2
    best = _best(face, sample, [np.zeros(2), middle], STEPS)
    if best[1] <= good:
        return best
    turns = 2 * np.pi * np.arange(8) / 8
    ring = RING * face.reach * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    further = _best(face, sample, [*ring, *(middle + ring)], STEPS)
    return further if further[1] < BETTER * best[1] else best


def exchanged(face: Face, cloud: np.ndarray, kept: float) -> tuple[np.ndarray, str] | None:
    """(matrix (3, 3), what was done to the axes) by which the cloud fits far better than `kept` mm; None: by none."""
    sample, fitting = _sample(cloud)[:: SAMPLE // 1000], []
    for matrix, words in _exchanges():
        turned = sample @ matrix.T
        low, high = np.percentile(turned, (1, 99), axis=0)
        pose, found = _best(face, turned, [np.zeros(2), (low + high)[:2] / 2], FEW_STEPS)
        if found < BETTER * kept:
            fitting.append(
                (found, round(np.linalg.norm(pose.angles)), matrix, words)
            )  # whole degrees: the simplest first
    if not fitting:
        return None
    least = min(found for found, *_ in fitting) / BETTER
    # of two that fit alike that which leaves less to turn: a swap of axes is also a mirror image that is turned
    _, _, matrix, words = min((one for one in fitting if one[0] <= least), key=lambda one: one[1])
    return matrix, words


def _exchanges() -> list[tuple[np.ndarray, str]]:
    """The 47 ways of exchanging and reversing axes, those that happen most first."""
    ways = []
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        words = ", ".join(
            f"{'xyz'[k]} is {'-' if signs[k] < 0 else ''}{'xyz'[order[k]]}"
            for k in range(3)
            if order[k] != k or signs[k] < 0
        )
        if words:
            moved, reversed_axes = sum(a != k for k, a in enumerate(order)), sum(s < 0 for s in signs)
            ways.append((moved + 2 * reversed_axes, matrix, words))
    return [(matrix, words) for _, matrix, words in sorted(ways, key=lambda way: way[0])]


def _sample(cloud: np.ndarray) -> np.ndarray:
    """As many points of a cloud as a start needs, always the same ones."""
    return cloud[np.random.default_rng(0).permutation(len(cloud))[:SAMPLE]]


def _best(face: Face, sample: np.ndarray, decentres: list[np.ndarray], steps: int) -> tuple[Pose, float]:
    """The best of several starts, the first of them unless another is clearly better."""
    best: tuple[Pose, float] | None = None
    for decentre in decentres:
        for height in _heights(face, sample, decentre):
            start = Pose(np.eye(3), np.array([*decentre, height]), face.pivot)
            pose, kept = _followed(face, sample, start, steps)
            if best is None or kept < BETTER * best[1]:
                best = pose, kept
    return best or (unmoved(face), np.inf)


def _heights(face: Face, sample: np.ndarray, decentre: np.ndarray) -> list[float]:
    """Shifts along z to begin with (mm): none, and the one that the densest quarter of the points over the lens has."""
    points = sample - np.array([*decentre, 0.0])
    over = points[face.inside(points)]
    if len(over) < 8:
        return [0.0]
    x, y = (torch.from_numpy(np.ascontiguousarray(over[:, i])) for i in (0, 1))
    off = np.sort(over[:, 2] - face.lens.back.sag_and_slope(x, y)[0].numpy())
    quarter = len(off) // 4
    densest = int(np.argmin(off[quarter:] - off[:-quarter]))
    return [0.0, float(off[densest : densest + quarter].mean())]


def _followed(face: Face, sample: np.ndarray, pose: Pose, steps: int) -> tuple[Pose, float]:
    """Gauss-Newton with weights 1 / (1 + (d / s)²), s the distance that a quarter of all points keep to."""
    kept = np.inf
    for _ in range(steps):
        points = pose.undone(sample)
        points = points[face.inside(points)]
        if len(points) < max(8, SHARE * len(sample)):
            return pose, np.inf
        distances, normals = face.distance(points)
        kept = float(np.sort(np.abs(distances))[int(SHARE * len(sample)) - 1])
        weight = 1 / (1 + (distances / (2 * kept + 1e-9)) ** 2)
        motion, _ = step(face, points, distances, normals, weight)
        pose = pose.after(motion * min(1.0, face.reach / 4 / max(np.abs(motion).max(), 1e-12)), face.reach)
        if np.abs(motion).max() < 1e-6 * face.reach:
            break
    return pose, kept
