"""Fit the scale of a made part to its cloud, one for all axes or one along each: the shrinkage that a moulding had.

A part that is larger than the design by ε = (ε_x, ε_y, ε_z) about the pivot c has the distances Σ_k ε_k (q_k - c_k) n_k
from the face, q a point of the face and n its normal.  A smooth form error resembles a scale, and moves the
alignment.  Scales and motions are therefore fitted together by generalised least squares, d = B β + form error.
Polynomials of LOW_DEGREE and MIDDLE_DEGREE split distances and columns B into low orders, middle orders and fine
relief.  In each part k, the residual has the mean square v_k, and n_k independent form errors are assumed (PART_FORMS):

    Σ_k B_kᵀ B_k n_k / v_k β = Σ_k B_kᵀ d_k n_k / v_k.

v_k follows from β, so that low orders that contradict the fine relief lose their weight.  The distances are measured
again at the new pose.  A face without fine relief does not determine the scales: a bowl that is wider is also flatter,
and a form error may resemble a scale exactly.  A scale is therefore stated only if it would also be determined by low
orders of the form error as large as those of the aligned distances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bstcad.manufacture.measured.alignment import (
    INDEPENDENT_PATCHES,
    LOW_ORDER_FORMS,
    MIN_SENSITIVITY,
    Alignment,
    BackFace,
    identity_pose,
    root_mean_square,
)  # fmt: skip

LOW_DEGREE = 4  # degree of the polynomials in x and y that describe form errors of low order
MIDDLE_DEGREE = 8  # degree of the polynomials that describe form errors of middle order: few waves, as from a chuck
# Assumed numbers of independent form errors of low orders, of middle orders and of the rest.
PART_FORMS = np.array([LOW_ORDER_FORMS, LOW_ORDER_FORMS, INDEPENDENT_PATCHES])
SCALE_POINTS = 20_000  # maximum number of points to which scales are fitted
MAX_UNCERTAINTY = 3e-3  # standard uncertainty of a scale, above which the face does not determine it
MAX_MOTION = 0.05  # largest motion beside the alignment / BackFace.reach; a larger one shows that nothing is determined
MAX_ENERGY = 4.0  # largest mean square of a part of the form error, relative to that after the alignment
POSE_ROUNDS, WEIGHT_ROUNDS = 4, 30  # maximum numbers of poses, and of estimates of v_k at each pose
WEIGHT_TOLERANCE = 1e-7  # change of scales and motions (mm at the rim) that ends the rounds
MAX_HIDDEN = 4.0  # largest form error of a smooth face that motions and scale hide, relative to the RMS that they leave
MAX_EXCESS = 0.05  # largest difference of one scale from 1, and its uncertainty, that a part has; form errors exceed it
MIN_VARIANCE = 1e-18  # lower bound of v_k, mm²: rounding
STRETCH_SIGMAS = 3.0  # difference of a scale from another axis, in standard uncertainties, that shows a stretched part


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

    @property
    def stretch(self) -> str:
        """Axes along which the part is stretched or shrunk relative to the other two, in words; "" if none is."""
        s, variance = np.array(self.scales), np.array(self.uncertainties) ** 2
        apart = np.abs(s[:, None] - s) > STRETCH_SIGMAS * np.sqrt(variance[:, None] + variance)
        axes = [axis for axis, differs in zip("xyz", apart.sum(axis=1) == 2, strict=True) if differs]
        sizes = ", ".join(f"{a} {x:.5f} ± {u:.2g}" for a, x, u in zip("xyz", s, self.uncertainties, strict=True))
        return f"the size differs along {' and '.join(axes)}: {sizes}" if axes else ""


def axis_scales(face: BackFace, alignment: Alignment) -> AxisScales:
    """Return the scales of an aligned cloud along x, y and z, and their standard uncertainties."""
    (x, y, z), (u, v, w) = (part.tolist() for part in _fit(face, alignment, np.eye(3)))
    return AxisScales((x, y, z), (u, v, w))


def scale(face: BackFace, alignment: Alignment) -> tuple[float, float]:
    """Return (scale of the cloud relative to the design, its standard uncertainty), one scale for all axes.

    If fine relief does not determine the scale, it is that of ordinary least squares.  Its uncertainty then assumes
    LOW_ORDER_FORMS form errors that resemble a scale, of which motions and scale take up most (MAX_HIDDEN).  A face of
    which no part can have this scale (MAX_EXCESS) has none: (1, infinity).
    """
    (value,), (uncertainty,) = (part.tolist() for part in _fit(face, alignment, np.ones((3, 1))))
    if np.isfinite(uncertainty):
        return value, uncertainty
    growth = _growth(face, alignment.points, alignment.distances, alignment.normals).sum(axis=1)
    columns = face.columns(alignment.points, alignment.normals) @ alignment.motions
    both = np.stack([growth, alignment.distances], axis=1)
    growth, distances = (both - columns @ np.linalg.solve(columns.T @ columns, columns.T @ both)).T
    energy = growth @ growth
    if energy <= (MIN_SENSITIVITY * face.reach) ** 2 * len(growth):  # a plane has no scale
        return 1.0, np.inf
    excess = growth @ distances / energy
    residual = MAX_HIDDEN * root_mean_square(distances - excess * growth)
    uncertainty = residual / np.sqrt(energy / len(growth) * LOW_ORDER_FORMS)
    return (1 + float(excess), float(uncertainty)) if max(abs(excess), uncertainty) <= MAX_EXCESS else (1.0, np.inf)


def orders(points: np.ndarray, degree: int = LOW_DEGREE) -> np.ndarray:
    """Return the products (n, k) of Legendre polynomials up to `degree`, of x and y scaled to ±1; lower ones first."""
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    u, v = (2 * (points[:, :2] - low) / (high - low) - 1).T
    degrees = np.add(*np.indices((degree + 1, degree + 1))).ravel()
    first = np.argsort(degrees, kind="stable")[: (degrees <= degree).sum()]
    return np.polynomial.legendre.legvander2d(u, v, (degree, degree))[:, first]


def _fit(face: BackFace, alignment: Alignment, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return scales (p,) and standard uncertainties (p,) of growths along `axes` (3, p)."""
    cloud = alignment.points[np.random.default_rng(0).permutation(len(alignment.points))[:SCALE_POINTS]]
    pose, aligned = identity_pose(face), np.full(len(PART_FORMS), np.inf)
    undetermined = np.ones(axes.shape[1]), np.full(axes.shape[1], np.inf)
    for turn in range(POSE_ROUNDS):
        points = pose.to_design(cloud)
        distances, normals = face.distance(points)
        growth = _growth(face, points, distances, normals) @ axes
        motions = face.columns(points, normals) @ alignment.motions
        if turn == 0:
            free = growth - motions @ np.linalg.lstsq(motions, growth, rcond=None)[0]
            energy, directions = np.linalg.eigh(free.T @ free / len(free))
            determined = energy > (MIN_SENSITIVITY * face.reach) ** 2
        basis = directions[:, determined]
        energies = _energies(points, np.column_stack([growth @ basis, motions, distances]))
        aligned = np.minimum(aligned, energies[:, -1, -1])
        found, covariance = _weighted(energies, aligned, np.zeros(len(aligned)))
        excess, motion = np.split(found, [basis.shape[1]])
        pose = pose.compose(-alignment.motions @ motion, face.reach)
        if np.abs(motion).max(initial=0.0) > MAX_MOTION * face.reach:
            return undetermined
        if np.abs(motion).max(initial=0.0) < WEIGHT_TOLERANCE:
            break
    _, cautious = _weighted(energies, aligned, aligned * [1, 0, 0])  # low orders as large as after the alignment
    uncertainty, most = (
        np.sqrt(np.einsum("ij,jk,ik->i", basis, each[: len(excess), : len(excess)], basis))
        for each in (covariance, cautious)
    )
    unknown = (np.abs(directions[:, ~determined]) > 1e-3).any(axis=1) | (most > MAX_UNCERTAINTY)
    return 1 + basis @ excess, np.where(unknown, np.inf, uncertainty)


def _growth(face: BackFace, points: np.ndarray, distances: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return changes (n, 3) of the distances per growth along x, y and z.

    They are those at the nearest points of the face: at the points themselves, noise and form error would count as
    growth, and all of them on a nearly flat face.
    """
    return (points - distances[:, None] * normals - face.pivot) * normals


def _energies(points: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the mean products (3, k, k) of the columns' low orders, of their middle orders and of the rest."""
    basis, _ = np.linalg.qr(orders(points, MIDDLE_DEGREE))
    inside = basis.T @ columns
    low, middle = np.split(inside, [(LOW_DEGREE + 1) * (LOW_DEGREE + 2) // 2])
    parts = (low, middle, columns - basis @ inside)
    return np.stack([part.T @ part for part in parts]) / len(points)


def _weighted(energies: np.ndarray, aligned: np.ndarray, least: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return β (k,) and its covariance (k, k).

    energies: mean products of columns B and d.  aligned: v_k of the aligned distances.  least: lower bounds of v_k.
    """
    count = energies.shape[1] - 1
    found, least = np.zeros(count), np.maximum(least, MIN_VARIANCE)
    for _ in range(WEIGHT_ROUNDS):
        left = np.append(-found, 1.0)
        weights = PART_FORMS / np.clip(left @ energies @ left, least, np.maximum(MAX_ENERGY * aligned, least))
        normal = np.tensordot(weights, energies, axes=1)
        before, covariance = found, np.linalg.pinv(normal[:count, :count], hermitian=True)
        found = covariance @ normal[:count, count]
        if np.abs(found - before).max(initial=0.0) < WEIGHT_TOLERANCE:
            break
    return found, covariance
