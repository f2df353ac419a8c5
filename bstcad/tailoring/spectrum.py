"""The stiffness of a tensor-product spline, diagonalised one axis at a time.

K w = λ M w with K = ∫ B' B'^T dx and M = ∫ B B^T dx for one axis gives modes W with W^T M W = 1; in two dimensions
the slope energy ∫ |∇h|² of h = W_x c W_y^T is Σ (λ_i + λ_j) c_ij².  Two small dense products change variables, and in
the Sobolev variable c · sqrt(λ_i + λ_j) a slope fit has almost the unit matrix as its normal matrix.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface, basis_matrix


@lru_cache(maxsize=8)
def axis_modes(m: int) -> tuple[np.ndarray, np.ndarray]:
    """(λ (m,), W (m, m)) of one axis in units of the control-point spacing; λ_0 = 0 is the constant."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    edges = np.concatenate([[0.0], np.arange(1, m - 2) + 0.5, [m - 1.0]])  # u at the knots
    half = np.diff(edges) / 2
    u = ((edges[:-1] + edges[1:]) / 2)[:, None] + half[:, None] * nodes
    w = (half[:, None] * weights).ravel()
    value, slope = (basis_matrix(u.ravel(), m, d).multiply(np.sqrt(w)[:, None]).tocsr() for d in (0, 1))
    energy, modes = scipy.linalg.eigh((slope.T @ slope).toarray(), (value.T @ value).toarray())
    energy[0] = 0.0
    return energy, modes


@dataclass(frozen=True)
class Spectrum:
    """Heights h (m, m) of a net as a function of the Sobolev variable c: h = W_x (c · scale) W_y^T."""

    modes: Tensor  # (m, m) W; the same for both axes
    energy: Tensor  # (m, m) λ_i / pitch_x² + λ_j / pitch_y² (1/mm²): slope energy of a unit mode
    scale: Tensor  # (m, m) energy ** -exponent, zero for the piston

    @classmethod
    def of(cls, surface: BSplineSurface, exponent: float = 0.5) -> Spectrum:
        """exponent 1/2: c measures slope (mm/mm).  1: c measures curvature (1/mm)."""
        energy, modes = axis_modes(surface.m)
        pitch_x, pitch_y = surface.pitch
        total = energy[:, None] / pitch_x**2 + energy[None, :] / pitch_y**2
        scale = np.zeros_like(total)
        scale.flat[1:] = (surface.m - 1) * total.flat[1:] ** -exponent  # m - 1: c² sums to a mean over the net
        like = {"dtype": surface.heights.dtype, "device": surface.heights.device}
        return cls(*(torch.as_tensor(a, **like) for a in (modes, total, scale)))

    def heights(self, c: Tensor) -> Tensor:
        """h = W (c · scale) W^T (mm)."""
        return self.modes @ (c * self.scale) @ self.modes.T

    def adjoint(self, g: Tensor) -> Tensor:
        """The transpose of `heights`: from a gradient in the control points to one in c."""
        return (self.modes.T @ g @ self.modes) * self.scale
