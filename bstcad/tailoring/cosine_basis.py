"""The slope energy of a net, diagonal in the cosine transform of its heights.

Neighbouring control points a pitch p apart give ∫ |∇h|² ≈ Σ (h_i+1 - h_i)² along each axis, and with even ends that sum
is diagonal in the orthonormal cosine transform ĥ = C h C^T (type II), with 2 - 2 cos(π i / m) for index i.  In the
Sobolev variable c = ĥ · sqrt(energy) a slope fit has almost the unit matrix as its normal matrix.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
import torch
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.kernels.reductions import elementary


@dataclass(frozen=True)
class Spectrum:
    """Heights h (m, m) of a net as a function of the Sobolev variable c: h = C^T (c · scale) C; Σ c² is mean |∇h|²."""

    energy: Tensor  # (m, m) slope energy of each cosine (1/mm²), zero for the piston
    scale: Tensor  # (m, m) m / sqrt(energy), zero for the piston

    @classmethod
    def of(cls, surface: BSplineSurface) -> Spectrum:
        """For the net of a surface."""
        x, y = (laplacian(surface.m) / pitch**2 for pitch in surface.pitch)
        energy = x[:, None] + y
        scale = surface.m * torch.where(energy > 0, energy, math.inf) ** -0.5
        return cls(energy.to(surface.heights), scale.to(surface.heights))

    def heights(self, c: Tensor) -> Tensor:
        """h of c (mm)."""
        return inverse_cosine(c * self.scale)

    def adjoint(self, g: Tensor) -> Tensor:
        """The transpose of `heights`: from a gradient in the control points to one in c."""
        return cosine(g) * self.scale


def laplacian(m: int) -> Tensor:
    """(m,) 2 - 2 cos(π i / m): what the second difference along one axis makes of each cosine."""
    return 2 - 2 * elementary(torch.cos, math.pi * torch.arange(m, dtype=torch.float64) / m)


def cosine(t: Tensor) -> Tensor:
    """The orthonormal cosine transform (type II) along both axes."""
    if t.device.type == "cpu":
        return torch.from_numpy(scipy.fft.dctn(t.numpy(), norm="ortho", workers=torch.get_num_threads()))
    c = _matrix(t.shape[0]).to(t)
    return c @ t @ c.T


def inverse_cosine(t: Tensor) -> Tensor:
    """Its inverse, which is its transpose."""
    if t.device.type == "cpu":
        return torch.from_numpy(scipy.fft.idctn(t.numpy(), norm="ortho", workers=torch.get_num_threads()))
    c = _matrix(t.shape[0]).to(t)
    return c.T @ t @ c


@lru_cache(maxsize=4)
def _matrix(m: int) -> Tensor:
    return torch.from_numpy(scipy.fft.dct(np.eye(m), axis=0, norm="ortho"))
