"""The spectrum of a net: transforms, energies, and the change of variables with its transpose."""

import pytest
import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.tailoring import sobolev as spectra
from bstcad.tailoring.merit import Spectrum


def flat(m):
    return BSplineSurface(20.0, torch.zeros((m, m), dtype=torch.float64), (-10.0, 10.0), (-6.0, 6.0))


def noise(m, seed):
    return torch.randn((m, m), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("m", [5, 9, 33])
def test_the_constant_is_the_only_mode_without_energy(m):
    energy = Spectrum.of(flat(m)).energy
    assert float(energy[0, 0]) == 0.0 and int((energy > 1e-6).sum()) == m * m - 1


def test_the_sobolev_variable_measures_slope():
    """The mean of |∇h|² over the net is Σ c² for smooth nets: by a fine midpoint sum of the surface's own slopes."""
    m, n = 33, 400
    spectrum = Spectrum.of(flat(m))
    c = torch.zeros((m, m), dtype=torch.float64)
    c[:4, :4] = noise(4, 0)
    c[0, 0] = 0.0  # the piston has no slope
    surface = BSplineSurface(20.0, spectrum.heights(c), (-10.0, 10.0), (-6.0, 6.0))
    line = (torch.arange(n, dtype=torch.float64) + 0.5) / n - 0.5
    x, y = torch.meshgrid(20 * line, 12 * line, indexing="ij")
    _, z_x, z_y = surface.sag_and_slope(x, y)
    assert float((z_x**2 + z_y**2).mean()) == pytest.approx(float((c**2).sum()), rel=0.06)  # of order 1 / m: the ends


def test_adjoint_is_the_transpose():
    spectrum = Spectrum.of(flat(17))
    c, g = noise(17, 1), noise(17, 2)
    assert float((spectrum.heights(c) * g).sum()) == pytest.approx(float((c * spectrum.adjoint(g)).sum()), rel=1e-12)


def test_the_cosine_transform_by_products_is_that_by_scipy():
    """The form that other devices take."""
    c, t = spectra._matrix(33), noise(33, 4)
    torch.testing.assert_close(c @ t @ c.T, spectra.cosine(t), rtol=0, atol=1e-13)
    torch.testing.assert_close(c.T @ t @ c, spectra.inverse_cosine(t), rtol=0, atol=1e-13)
