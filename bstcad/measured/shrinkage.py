"""Fit the scale of a made part along each axis to its cloud: the shrinkage that a moulding had.

A part that is larger than the design by ε = (ε_x, ε_y, ε_z) about the pivot c has the distances Σ_k ε_k (q_k - c_k) n_k
from the face, q a point and n its normal.  The three are fitted by least squares beside the motions of the alignment.
Form errors that resemble a scale limit the accuracy, as in alignment.scale: SCALE_PATCHES independent patches of them
are assumed.  A face without fine relief does not tell the three apart: a bowl that is wider is also flatter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bstcad.measured.alignment import MIN_SENSITIVITY, SCALE_PATCHES, Alignment, BackFace, root_mean_square


@dataclass(frozen=True)
class AxisScales:
    """Scales of a part relative to the design along x, y and z."""

    scales: tuple[float, float, float]
    uncertainties: tuple[float, float, float]  # standard uncertainties; infinite if the face does not determine a scale

    def facts(self) -> dict[str, list[float | None]]:
        """Return the entries of report.json; None for a scale that the face does not determine."""
        known = [np.isfinite(u) for u in self.uncertainties]
        return {
            name: [value if ok else None for value, ok in zip(values, known, strict=True)]
            for name, values in (("scale_xyz", self.scales), ("scale_xyz_uncertainty", self.uncertainties))
        }


def axis_scales(face: BackFace, alignment: Alignment) -> AxisScales:
    """Return the scales of an aligned cloud along x, y and z, fitted beside its motions, and their uncertainties."""
    growth = (alignment.points - face.pivot) * alignment.normals
    columns = face.columns(alignment.points, alignment.normals) @ alignment.motions
    both = np.column_stack([growth, alignment.distances])
    both = both - columns @ np.linalg.solve(columns.T @ columns, columns.T @ both)
    growth, distances = both[:, :3], both[:, 3]
    energy, directions = np.linalg.eigh(growth.T @ growth / len(growth))
    determined = energy > (MIN_SENSITIVITY * face.reach) ** 2
    inverse = np.where(determined, 1 / np.where(determined, energy, 1.0), 0.0)
    excess = directions @ (inverse * (directions.T @ (growth.T @ distances / len(growth))))
    residual = root_mean_square(distances - growth @ excess)
    variance = (directions**2) @ inverse * residual**2 / SCALE_PATCHES
    variance[(np.abs(directions[:, ~determined]) > 1e-3).any(axis=1)] = np.inf
    x, y, z = (1 + excess).tolist()
    u, v, w = np.sqrt(variance).tolist()
    return AxisScales((x, y, z), (u, v, w))
