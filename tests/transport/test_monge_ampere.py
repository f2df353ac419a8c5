"""The flux of a tube, and the linearisation Newton rests on."""

import numpy as np
import pytest

from bstcad.transport import Density
from bstcad.transport.monge_ampere import MongeAmpere, _apply, _metric, corners

N = 32


def wave(amplitude):
    """A smooth potential with zero slope at the rim, cell units."""
    c = np.cos(np.pi * (np.arange(N) + 0.5) / N)
    return amplitude * N**2 / np.pi**2 * (c[:, None] * c[None, :] + 0.3 * (2 * c[:, None] ** 2 - 1))


def test_rim_of_the_square_maps_to_itself():
    x, y = corners(wave(0.2))
    assert (x[0] == 0).all() and (x[-1] == N).all() and (y[:, 0] == 0).all() and (y[:, -1] == N).all()


def test_all_flux_of_the_source_arrives():
    source = Density.from_function(lambda x, y: np.exp(-3 * (x - 0.4) ** 2 - (y - 0.5) ** 2), N)
    assert MongeAmpere(source, source).flux(wave(0.2)).mean() == pytest.approx(1.0, abs=2e-4)  # midpoint rule


def test_flux_is_the_determinant_for_an_even_source():
    """F -> det D²v for v = |y|²/2 - phi, second order in the cell."""
    even = Density.from_values(np.ones((N, N)))
    q = np.pi * (np.arange(N) + 0.5) / N
    c, s, c2 = np.cos(q), np.sin(q), np.cos(2 * q)
    a = 0.2
    vxx = 1 + a * (c[:, None] * c[None, :] + 1.2 * c2[:, None])
    vyy = 1 + a * c[:, None] * c[None, :]
    vxy = -a * s[:, None] * s[None, :]
    np.testing.assert_allclose(MongeAmpere(even, even).flux(wave(a)), vxx * vyy - vxy**2, atol=0.01)


def test_linearisation_against_differences_of_the_flux():
    even = Density.from_values(np.ones((N, N)))
    tubes, phi = MongeAmpere(even, even), wave(0.2)
    eta = wave(1.0).T
    step = 1e-5
    want = (tubes.flux(phi + step * eta) - tubes.flux(phi - step * eta)) / (2 * step)
    metric, p, q = np.empty((N + 1, N + 1, 3)), np.empty((N + 1, N + 1)), np.empty((N + 1, N + 1))
    got = np.empty((N, N))
    _metric(even.values, *corners(phi), metric, 0.0)
    _apply(metric, eta, p, q, got)
    assert np.abs(got - want)[1:-1, 1:-1].max() < 0.02 * np.abs(want).max()  # second order in the cell


def test_one_newton_step_takes_most_of_the_residual():
    even = Density.from_values(np.ones((N, N)))
    target = Density.from_function(lambda x, y: 1 + 0.5 * np.cos(np.pi * x) * np.cos(2 * np.pi * y), N)
    tubes, phi = MongeAmpere(even, target), np.zeros((N, N))
    before = target.values - tubes.flux(phi)
    after = target.values - tubes.flux(phi + tubes.newton(phi, before))
    assert np.abs(after).mean() < 0.4 * np.abs(before).mean()  # the softening leaves part of it
