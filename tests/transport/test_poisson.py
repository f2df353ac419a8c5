"""Poisson's equation against its own Laplacian and against the cosine series in both axes."""

import numpy as np
import pytest
import scipy.fft

from bstcad.transport.bfm import Poisson, PoissonWithoutCheckerboard


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


def test_the_checkerboard_is_kept_out():
    """The highest term of the cosine series is a checkerboard; the plain solve gives 1/8 of it back."""
    n = 200
    line = np.cos(np.pi * (n - 1) * (np.arange(n) + 0.5) / n)
    board = np.outer(line, line)
    np.testing.assert_allclose(Poisson(n).solve(board), board / 8, atol=1e-4)  # s = 4 cos²(pi/2n)
    np.testing.assert_allclose(PoissonWithoutCheckerboard(n).solve(board), 0.0, atol=1e-4)
