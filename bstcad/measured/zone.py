"""The minimum zone: the motion that makes the largest distance smallest (Chebyshev), by linear programming.

min t,  |d_i + n_i · motion| <= t for all points.  Few points decide it: those with the largest distances go into the
program, those that its solution leaves outside join them, until none does.  What is found is exact to OFF.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from bstcad.measured.alignment import Alignment, Face, Pose

OFF = 1e-3  # of the zone: no point lies further out than that
POINTS = 400  # in the first program, and that join it at a time
ROUNDS = 30


@dataclass(frozen=True)
class Zone:
    """The face between two envelopes of spheres about the design (a surface profile)."""

    width: float  # mm; twice the largest distance, the smallest that a motion can make it
    pose: Pose  # what was removed


def minimum_zone(face: Face, alignment: Alignment) -> Zone:
    """The minimum zone, from the alignment by least squares, by the motions that the face determines."""
    columns = face.columns(alignment.points, alignment.normals) @ alignment.motions
    distances, motion = alignment.distances, np.zeros(alignment.motions.shape[1])
    chosen = _farthest(distances)
    for _ in range(ROUNDS):
        motion, half = _solved(columns[chosen], distances[chosen])
        left = distances + columns @ motion
        if np.abs(left).max() <= half * (1 + OFF):
            break
        chosen = np.union1d(chosen, _farthest(left))
    pose = alignment.pose.after(alignment.motions @ motion, face.reach)
    return Zone(2 * float(np.abs(distances + columns @ motion).max()), pose)


def _farthest(distances: np.ndarray) -> np.ndarray:
    """The points furthest out on either side."""
    count = min(POINTS // 2, len(distances))
    return np.union1d(np.argpartition(distances, -count)[-count:], np.argpartition(distances, count - 1)[:count])


def _solved(columns: np.ndarray, distances: np.ndarray) -> tuple[np.ndarray, float]:
    """(motion, half the zone) of these points alone; in units of their largest distance, which solvers like."""
    unit = max(float(np.abs(distances).max()), 1e-12)
    size = np.abs(columns).max(axis=0)
    one = np.ones((len(columns), 1))
    scaled = columns / size
    found = linprog(
        np.append(np.zeros(columns.shape[1]), 1.0),
        A_ub=np.vstack([np.hstack([scaled, -one]), np.hstack([-scaled, -one])]),
        b_ub=np.concatenate([-distances, distances]) / unit,
        bounds=[(None, None)] * columns.shape[1] + [(0, None)],
        method="highs",
    )
    return found.x[:-1] / size * unit, float(found.x[-1]) * unit
