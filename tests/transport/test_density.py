"""Densities keep mass, scale and orientation; a pushforward leaves no holes; no bit depends on threads."""

import os
import subprocess
import sys

import numba
import numpy as np
import pytest

from bstcad.transport import Density
from bstcad.transport.bfm import half_square, legendre
from bstcad.transport.density import (
    MAX_SINGLE_THREAD_CELLS,
    gradient_at_corners,
    inner,
    pushforward,
    resample_flux,
    threads,
    threads_for,
)


def test_a_function_has_its_means_over_cells():
    """The midpoint rule is exact for a plane."""
    middle = (np.arange(10) + 0.5) / 10
    plane = 1.0 + middle[:, None] - 0.5 * middle[None, :]
    found = Density.from_function(lambda x, y: 1.0 + x - 0.5 * y, 10, samples=3)
    np.testing.assert_allclose(found.values, plane / plane.mean(), rtol=1e-13)


def test_picture_keeps_mass_by_area_for_sizes_that_do_not_divide():
    picture = np.random.default_rng(0).random((37, 53))
    d = Density.from_picture(picture, 20, width=1.0, height=1.0)
    areas = np.kron(picture, np.ones((20, 20))).reshape(20, 37, 20, 53).mean(axis=(1, 3))
    np.testing.assert_allclose(d.values, areas[::-1].T / picture.mean(), rtol=1e-12)
    assert d.values.mean() == pytest.approx(1.0, rel=1e-14)


def test_row_0_is_y_max_and_column_0_is_x_min():
    picture = np.zeros((8, 8))
    picture[0, 1] = 1.0
    assert np.argwhere(Density.from_picture(picture, 8).values).tolist() == [[1, 7]]


def test_a_wide_rectangle_sits_centred_with_one_scale():
    d = Density.from_picture(np.ones((10, 20)), 40, width=2.0, height=1.0, floor=1e-2)
    lit = d.values > 0
    assert lit.all(axis=0).tolist() == [10 <= j < 30 for j in range(40)]
    assert np.ptp(d.values[lit]) < 1e-13


def test_floor_lifts_only_darker_cells():
    picture = np.zeros((16, 16))
    picture[:4] = 3.0
    d = Density.from_picture(picture, 16, floor=0.01)
    assert d.values.min() / d.values.max() == pytest.approx(0.01 * 0.75 / 3.0, rel=1e-12)
    assert Density.from_picture(picture, 16).values.min() == 0.0


def test_lifting_reaches_the_floor_of_the_mean():
    values = np.zeros((8, 8))
    values[2:4, 5] = 1e300
    d = Density.from_values(values).lifted(1e-3)
    assert d.values.min() == pytest.approx(1e-3, rel=2e-3)
    assert d.values.mean() == pytest.approx(1.0, rel=1e-14)


@pytest.mark.parametrize(
    ("picture", "sentence"),
    [
        (np.zeros((8, 8)), "black everywhere"),
        (-np.ones((8, 8)), "are negative"),
        (np.full((8, 8), np.nan), "finite"),
        (np.ones((8, 8, 3)), "rows x columns"),
    ],
)
def test_a_bad_picture_is_refused_in_a_sentence(picture, sentence):
    with pytest.raises(ValueError, match=sentence):
        Density.from_picture(picture, 16)


@pytest.mark.parametrize("roughness", [0.0, 0.5, 20.0])
def test_mass_is_conserved(roughness):
    rng = np.random.default_rng(0)
    rho = rng.random((48, 48))
    u = legendre(half_square(48) - roughness * rng.normal(size=(48, 48)).cumsum(axis=1))
    moved = pushforward(rho, u)
    assert moved.sum() == pytest.approx(rho.sum(), rel=1e-12)
    assert moved.min() >= 0.0


def test_a_shift_by_whole_cells():
    rho = np.zeros((32, 32))
    rho[8:12, 10:20] = np.random.default_rng(2).random((4, 10))
    q = np.arange(32) + 0.5
    u = half_square(32) + 5.0 * q[:, None] - 3.0 * q[None, :]
    np.testing.assert_allclose(pushforward(rho, u), np.roll(rho, (5, -3), axis=(0, 1)), atol=1e-12)


def rough_map(n):
    """u whose gradient shears and stays inside the square, so that no piece is pushed back."""
    bumps = np.random.default_rng(4).normal(size=(n, n)).cumsum(axis=0).cumsum(axis=1)
    q = np.arange(n) + 0.5 - n / 2
    smooth = 0.5 * 0.8 * np.add.outer(q**2, q**2) + 0.1 * np.outer(q, q) + 0.5 * n * np.add.outer(q, q)
    return smooth + bumps / np.abs(bumps).max()


def test_pieces_are_laid_down_by_their_overlap_with_each_pixel():
    """The rule of the docstring, written plainly: every piece a box, every pixel its share of the area."""
    n = 24
    rho, u = np.random.default_rng(6).random((n, n)), rough_map(n)
    corners = np.stack(gradient_at_corners(u), axis=-1)
    want, edges = np.zeros((n, n)), np.arange(n + 1)
    for i, j in np.ndindex(n, n):
        a, b, c, d = corners[i : i + 2, j : j + 2].reshape(4, 2)  # (0, 0), (0, 1), (1, 0), (1, 1)
        p = int(2 * max(abs(c - a).max(), abs(d - b).max())) + 1
        q = int(2 * max(abs(b - a).max(), abs(d - c).max())) + 1
        size = np.minimum(1.0, abs(c - a + d - b) / (2 * p) + abs(b - a + d - c) / (2 * q))
        for e, f in np.ndindex(p, q):
            e, f = (e + 0.5) / p, (f + 0.5) / q
            middle = (1 - e) * ((1 - f) * a + f * b) + e * ((1 - f) * c + f * d)
            low, high = middle - size / 2, middle + size / 2
            over = [np.clip(np.minimum(edges[1:], high[k]) - np.maximum(edges[:-1], low[k]), 0, 1) for k in (0, 1)]
            want += rho[i, j] / (p * q) * np.outer(*over) / size.prod()
    np.testing.assert_allclose(pushforward(rho, u), want, atol=1e-12)


@pytest.mark.parametrize("slope", [-1.0, 0.37, 1.0])
def test_a_map_to_one_point_puts_all_mass_there(slope):
    """Boxes without extent, at the rim too: 1.0 sends everything to the far corner of the square."""
    n = 48
    rho, q = np.random.default_rng(7).random((n, n)), np.arange(n) + 0.5
    moved = pushforward(rho, slope * n * np.add.outer(q, q))
    assert moved.sum() == pytest.approx(rho.sum(), rel=1e-12)
    i = min(max(int(slope * n), 0), n - 1)
    assert moved[i, i] == pytest.approx(rho.sum(), rel=1e-12)


@pytest.mark.parametrize("pixels", [(6, 4), (5, 40), (64, 48)])
def test_pixels_are_spread_part_by_part(pixels):
    """The rule of the docstring, written plainly, on corners some of which lie beyond the rim."""
    rng, n, parts = np.random.default_rng(8), 16, (3, 2)
    sides = (np.linspace(-1.0, n + 0.5, count + 1) for count in pixels)
    x, y = (c + rng.normal(scale=0.2, size=c.shape) for c in np.meshgrid(*sides, indexing="ij"))
    flux = rng.random(pixels)
    flux[rng.random(pixels) < 0.3] = 0.0
    want = np.zeros((n, n))
    for a, b in np.ndindex(parts):
        a, b = (a + 0.5) / parts[0], (b + 0.5) / parts[1]
        px, py = (
            (1 - a) * ((1 - b) * c[:-1, :-1] + b * c[:-1, 1:]) + a * ((1 - b) * c[1:, :-1] + b * c[1:, 1:]) - 0.5
            for c in (x, y)
        )
        for i, j in np.ndindex(n, n):  # tents around the cells' centres, the outer ones level beyond the rim
            shares = (np.maximum(0, 1 - np.abs(np.clip(p, 0, n - 1) - k)) for p, k in ((px, i), (py, j)))
            want[i, j] += (flux / 6 * np.multiply(*shares)).sum()
    found = resample_flux(flux, x, y, n, parts)
    np.testing.assert_allclose(found, want, atol=1e-12)
    assert found.sum() == pytest.approx(flux.sum(), rel=1e-12)


def test_black_pixels_may_lie_nowhere():
    x, y = np.meshgrid(np.linspace(0, 8, 5), np.linspace(0, 8, 5), indexing="ij")
    x[:2], y[:2] = np.nan, np.inf
    flux = np.ones((4, 4))
    flux[:2] = 0.0
    found = resample_flux(flux, x, y, 8, (4, 4))
    assert found.sum() == pytest.approx(8.0) and np.isfinite(found).all()
    flux[0, 0] = 1.0
    assert np.isnan(resample_flux(flux, x, y, 8, (4, 4))).any()  # and not somewhere by chance


def test_small_grids_use_one_and_the_number_is_put_back():
    before = numba.get_num_threads()
    with threads(MAX_SINGLE_THREAD_CELLS):
        assert numba.get_num_threads() == 1
    with pytest.raises(KeyError), threads(MAX_SINGLE_THREAD_CELLS):
        raise KeyError
    assert numba.get_num_threads() == before
    assert threads_for(MAX_SINGLE_THREAD_CELLS + 1) <= numba.config.NUMBA_NUM_THREADS


BITS = """
import numba, numpy as np
from bstcad.transport.bfm import half_square, legendre
from bstcad.transport.density import pushforward
n, rng = 100, np.random.default_rng(0)
rho, v = rng.random((n, n)), half_square(n) - 5.0 * rng.normal(size=(n, n))
found = []
for count in (1, 2):
    numba.set_num_threads(count)
    u = legendre(v)
    found.append((u, pushforward(rho, u)))
print([bool(np.array_equal(one, two)) for one, two in zip(*found)])
"""


def test_one_thread_and_two_agree_to_the_last_digit():
    """A second process may have two threads however few cores the machine has."""
    two = os.environ | {"NUMBA_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", BITS], env=two, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[True, True]", done.stderr


@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (300, 300)])
def test_inner_product(shape):
    a, b = np.random.default_rng(0).random((2, *shape))
    assert inner(a, b) == pytest.approx((a * b).sum(), rel=1e-14)
