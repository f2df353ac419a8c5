"""The spectrum of a net: modes, energies, and the change of variables with its transpose."""

import numpy as np
import pytest
import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.tailoring.spectrum import Spectrum, axis_modes


def flat(m):
    return BSplineSurface(20.0, torch.zeros((m, m), dtype=torch.float64), (-10.0, 10.0), (-6.0, 6.0))


@pytest.mark.parametrize("m", [5, 9, 33])
def test_the_constant_is_the_only_mode_without_energy(m):
    energy, modes = axis_modes(m)
    assert energy[0] == 0.0 and (energy[1:] > 1e-6).all()
    assert np.ptp(modes[:, 0]) < 1e-12


def test_the_sobolev_variable_measures_slope():
    """The mean of |∇h|² over the net is Σ c²: by a fine midpoint sum of the surface's own slopes."""
    m, n = 9, 400
    spectrum = Spectrum.of(flat(m))
    c = torch.randn((m, m), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    c[0, 0] = 0.0  # the piston has no slope
    surface = BSplineSurface(20.0, spectrum.heights(c), (-10.0, 10.0), (-6.0, 6.0))
    line = (torch.arange(n, dtype=torch.float64) + 0.5) / n - 0.5
    x, y = torch.meshgrid(20 * line, 12 * line, indexing="ij")
    _, z_x, z_y = surface.sag_and_slope(x, y)
    assert float((z_x**2 + z_y**2).mean()) == pytest.approx(float((c**2).sum()), rel=1e-3)  # midpoint rule


@pytest.mark.parametrize("exponent", [0.5, 1.0])
def test_adjoint_is_the_transpose(exponent):
    spectrum = Spectrum.of(flat(17), exponent)
    c, g = torch.randn((2, 17, 17), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert float((spectrum.heights(c) * g).sum()) == pytest.approx(float((c * spectrum.adjoint(g)).sum()), rel=1e-12)
