"""The back-and-forth method against maps whose answer is known."""

import numpy as np
import pytest

from bstcad.transport import Density, back_and_forth
from bstcad.transport.bfm import half_square, legendre

N = 64


def gaussian(cx, cy, sx, sy):
    return lambda x, y: np.exp(-0.5 * (((x - cx) / sx) ** 2 + ((y - cy) / sy) ** 2))


def displacement(potential):
    """-∇psi at cell centres, unit-square units."""
    return tuple(-g * potential.shape[0] for g in np.gradient(potential))


def test_translation_and_its_cost():
    """A disc moved by d with zeros around both: T = x + d on the support, W2²/2 = |d|²/2."""
    d = np.array([8, 5]) / N

    def disc(cx, cy):
        return lambda x, y: 1.0 * ((x - cx) ** 2 + (y - cy) ** 2 < 0.2**2)

    rho = Density.from_function(disc(0.40, 0.45), N)
    t = back_and_forth(rho, Density.from_function(disc(0.40 + d[0], 0.45 + d[1]), N))
    assert t.dual[-1] == pytest.approx(0.5 * d @ d, rel=0.01)
    inside = rho.values > 0.9 * rho.values.max()
    for got, want in zip(displacement(t.psi), d, strict=True):
        assert abs(got[inside] - want).mean() < 0.5 / N  # half a cell: the c-transform maps centres to centres


def test_gaussian_to_gaussian():
    """T = m2 + (s2 / s1)(x - m1) along each axis."""
    rho = Density.from_function(gaussian(0.5, 0.5, 0.07, 0.09), N)
    t = back_and_forth(rho, Density.from_function(gaussian(0.53, 0.46, 0.11, 0.07), N))
    q = (np.arange(N) + 0.5) / N
    dx, dy = displacement(t.psi)
    bright = rho.values > 0.1 * rho.values.max()
    want_x = np.broadcast_to(((0.53 + 0.11 / 0.07 * (q - 0.5)) - q)[:, None], (N, N))
    want_y = np.broadcast_to(((0.46 + 0.07 / 0.09 * (q - 0.5)) - q)[None, :], (N, N))
    assert abs(dx - want_x)[bright].mean() < 0.5 / N
    assert abs(dy - want_y)[bright].mean() < 0.5 / N
    cost = 0.5 * (0.03**2 + 0.04**2 + 0.04**2 + 0.02**2)  # Gelbrich: (m2 - m1)² + (s2 - s1)², halved
    assert t.dual[-1] == pytest.approx(cost, rel=0.03)


@pytest.fixture(scope="module")
def rough():
    picture = np.random.default_rng(5).random((8, 8)) ** 3
    source = Density.from_function(lambda x, y: 1.0 * ((x - 0.5) ** 2 + (y - 0.5) ** 2 < 0.25), N)
    return source, Density.from_picture(picture, N)


def test_dual_value_never_falls(rough):
    t = back_and_forth(*rough, tolerance=0.0)
    assert len(t.dual) > 5
    assert np.diff(t.dual).min() >= -1e-13  # rounding of a mean of values of order 1


def test_the_pair_is_conjugate_and_the_error_falls(rough):
    t = back_and_forth(*rough)
    half = half_square(N)
    np.testing.assert_allclose((half - legendre(half - t.phi * N**2)) / N**2, t.psi, atol=1e-13)
    identity = np.abs(rough[0].values - rough[1].values).mean()
    assert t.mass_error[-1] < 0.2 * identity


def test_why_it_stopped(rough):
    assert back_and_forth(*rough, tolerance=0.0, iterations=200).reason == "plateau"
    assert back_and_forth(*rough, tolerance=0.0, iterations=2).reason == "iterations"
    assert back_and_forth(rough[0], rough[0]).reason == "converged"


def test_grids_must_agree(rough):
    with pytest.raises(ValueError, match="one grid"):
        back_and_forth(rough[0], rough[1].halved())
