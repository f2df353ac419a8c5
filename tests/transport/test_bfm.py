"""The back-and-forth method against known maps, its c-transform against brute force, Poisson against series."""

import numpy as np
import pytest
import scipy.fft

from bstcad.transport import Density, back_and_forth
from bstcad.transport.bfm import Poisson, PoissonWithoutCheckerboard, half_square, legendre

N = 64


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


def minus_laplacian(g):
    """Five points, zero normal derivative."""
    p = np.pad(g, 1, mode="edge")
    return 4 * g - p[2:, 1:-1] - p[:-2, 1:-1] - p[1:-1, 2:] - p[1:-1, :-2]


def by_two_series(r, factor):
    """Each term of the cosine series times factor(s_x, s_y) / (s_x + s_y)."""
    s = 4 * np.sin(0.5 * np.pi * np.arange(r.shape[0]) / r.shape[0]) ** 2
    sx, sy = s[:, None], s[None, :]
    total = sx + sy
    total[0, 0] = np.inf
    return scipy.fft.idctn(scipy.fft.dctn(r) * factor(sx, sy) / total)


@pytest.mark.parametrize("n", [4, 33, 200])
def test_the_laplacian_of_the_solution_is_the_right_side(n):
    r = np.random.default_rng(n).normal(size=(n, n))
    g = Poisson(n).solve(r)
    np.testing.assert_allclose(minus_laplacian(g), r - r.mean(), atol=1e-11)
    assert abs(g.mean()) < 1e-12


@pytest.mark.parametrize("n", [4, 33, 200])
def test_one_series_and_an_elimination_equal_two_series(n):
    r = np.random.default_rng(n).normal(size=(n, n))
    want = by_two_series(r, lambda sx, sy: 1.0)
    np.testing.assert_allclose(Poisson(n).solve(r), want, atol=1e-11 * np.abs(want).max())
    want = by_two_series(r, lambda sx, sy: 1.0 - sx * sy / 16.0)
    np.testing.assert_allclose(PoissonWithoutCheckerboard(n).solve(r), want, atol=1e-11 * np.abs(want).max())


def c_transform(phi):
    """phi^c(x) = min_y |x - y|²/2 - phi(y), cell units."""
    half = half_square(phi.shape[0])
    return half - legendre(half - phi)


def brute_force(phi):
    q = np.arange(phi.shape[0]) + 0.5
    d = 0.5 * (q[:, None] - q[None, :]) ** 2
    cost = d[:, None, :, None] + d[None, :, None, :]  # [x1, x2, y1, y2]
    return (cost - phi).min(axis=(2, 3))


@pytest.mark.parametrize("n", [4, 9, 32])
@pytest.mark.parametrize("scale", [0.0, 1.0, 300.0, 1e5])
def test_c_transform_is_the_minimum_over_all_pairs(n, scale):
    """Every slope is steeper than the grid is wide at the largest scale, so that the rim is chosen."""
    phi = scale * np.random.default_rng(n).normal(size=(n, n))
    np.testing.assert_allclose(c_transform(phi), brute_force(phi), rtol=1e-14, atol=1e-11)  # rounding of values near n²


def test_double_transform_lies_above_and_triple_equals_single():
    phi = np.random.default_rng(3).normal(size=(40, 40)).cumsum(axis=0)
    once = c_transform(phi)
    twice = c_transform(once)
    assert (twice >= phi - 1e-11).all()
    assert (twice > phi + 0.1).any()  # a rough phi is truly lifted
    np.testing.assert_allclose(c_transform(twice), once, atol=1e-11)
