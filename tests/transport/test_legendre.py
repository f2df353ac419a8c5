"""The c-transform against brute force, and the laws of double transforms."""

import numpy as np
import pytest

from bstcad.transport.bfm import half_square, legendre


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
@pytest.mark.parametrize("scale", [0.0, 1.0, 300.0])
def test_c_transform_is_the_minimum_over_all_pairs(n, scale):
    phi = scale * np.random.default_rng(n).normal(size=(n, n))
    np.testing.assert_allclose(c_transform(phi), brute_force(phi), atol=1e-11)  # rounding of values near n²


def test_double_transform_lies_above_and_triple_equals_single():
    phi = np.random.default_rng(3).normal(size=(40, 40)).cumsum(axis=0)
    once = c_transform(phi)
    twice = c_transform(once)
    assert (twice >= phi - 1e-11).all()
    assert (twice > phi + 0.1).any()  # a rough phi is truly lifted
    np.testing.assert_allclose(c_transform(twice), once, atol=1e-11)


def test_half_square_is_its_own_transform():
    np.testing.assert_allclose(legendre(half_square(50)), half_square(50), atol=1e-11)


def test_dilation_of_the_square():
    """v = a |y|²/2 gives v* = |x|²/(2a) where x/a is a cell centre."""
    n, a = 63, 3.0
    got = legendre(a * half_square(n))
    inside = np.arange(1, n, 3)  # (i + 1/2) / 3 = j + 1/2
    np.testing.assert_allclose(got[np.ix_(inside, inside)], (half_square(n) / a)[np.ix_(inside, inside)], atol=1e-11)


def test_a_concave_function_counts_by_the_corners_of_the_square_alone():
    n = 30
    got = legendre(-half_square(n))
    q, ends = np.arange(n) + 0.5, np.array([0.5, n - 0.5])
    best = (q[:, None] * ends + 0.5 * ends**2).max(axis=1)
    np.testing.assert_allclose(got, best[:, None] + best[None, :], atol=1e-11)


def test_steep_slopes_choose_the_rim():
    """Beyond every x of the grid, both ways: the walk starts or stays at an end of the hull."""
    q = np.arange(16) + 0.5
    v = 1e3 * q[:, None] - 1e3 * q[None, :]
    np.testing.assert_allclose(legendre(v), 0.5 * q[:, None] + 15.5 * q[None, :] + 15e3, atol=1e-11)
