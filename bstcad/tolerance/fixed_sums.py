"""Products and main axes of small matrices, added up in one order: no bit depends on the number of threads.

BLAS and LAPACK divide such sums as they like (see optics/kernels/reductions.py).
"""

from __future__ import annotations

import numpy as np
import torch

from bstcad.optics.kernels.reductions import dot

SWEEPS = 30  # at most; Jacobi's method converges quadratically, and takes six or so
NOTHING = 1e-16  # of the largest of a matrix: smaller off its diagonal is left


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a (…, n) times b (n, m)."""
    return np.einsum("...i,ij->...j", a, b, optimize=False)


def gram(rows: np.ndarray) -> np.ndarray:
    """(n, n) the products of all pairs of rows (n, long)."""
    vectors = [torch.from_numpy(np.ascontiguousarray(row)) for row in rows]
    found = np.empty((len(vectors), len(vectors)))
    for i, a in enumerate(vectors):
        for j, b in enumerate(vectors[: i + 1]):
            found[i, j] = found[j, i] = dot(a, b)
    return found


def main_axes(symmetric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(eigenvalues (n,), the largest first; eigenvectors (n, n) as columns) of a symmetric matrix.

    By cyclic Jacobi rotations (Golub and Van Loan, Matrix Computations, 8.5).
    """
    a, v = symmetric.copy(), np.eye(len(symmetric))
    least = NOTHING * np.abs(a).max(initial=0.0)
    for _ in range(SWEEPS):
        turned = False
        for p in range(len(a) - 1):
            for q in range(p + 1, len(a)):
                if abs(a[p, q]) > least:
                    _rotate(a, v, p, q)
                    turned = True
        if not turned:
            break
    values = np.diag(a)
    order = np.argsort(-values, kind="stable")
    return values[order], v[:, order]


def _rotate(a: np.ndarray, v: np.ndarray, p: int, q: int) -> None:
    """Make a[p, q] zero by a rotation in the plane of p and q, and turn v with it."""
    tau = (a[q, q] - a[p, p]) / (2 * a[p, q])
    t = np.copysign(1.0, tau) / (abs(tau) + np.sqrt(1 + tau * tau))
    c = 1 / np.sqrt(1 + t * t)
    s = t * c
    for m in (a.T, a, v.T):  # columns, then rows; of v its columns
        m[p], m[q] = c * m[p] - s * m[q], s * m[p] + c * m[q]
    a[p, q] = a[q, p] = 0.0
