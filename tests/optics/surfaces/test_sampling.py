"""Starts of rays: each cell has its point, each seed its own points."""

import numpy as np
import pytest
import torch

from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Rectangle
from tests.tracing import stratified

WINDOW = Rectangle(24.0, 10.0)


def cell(x, y, nx, ny):
    """(column, row) counts of points in nx x ny equal cells of the window."""
    i = ((x / WINDOW.width + 0.5) * nx).floor().long().reshape(-1)
    j = ((y / WINDOW.height + 0.5) * ny).floor().long().reshape(-1)
    assert int(i.min()) >= 0 and int(i.max()) < nx and int(j.min()) >= 0 and int(j.max()) < ny
    return torch.bincount(i * ny + j, minlength=nx * ny)


@pytest.mark.parametrize("dtype", (torch.float32, torch.float64))
def test_grid_has_the_centres_x_along_the_first_axis(dtype):
    x, y = sampling.grid(WINDOW, 4, dtype)
    assert x.dtype == y.dtype == dtype and x.shape == (4, 4)
    assert x[:, 0].tolist() == [-9.0, -3.0, 3.0, 9.0] and y[0].tolist() == [-3.75, -1.25, 1.25, 3.75]


def test_stratified_has_exactly_one_point_a_cell_in_its_place():
    n = 50
    x, y = stratified(WINDOW, n, 3)
    assert (cell(x, y, n, n) == 1).all()
    gx, gy = sampling.grid(WINDOW, n)
    # point (i, j) lies in cell (i, j): neighbours in memory are neighbours in the lens
    assert float((x - gx).abs().max()) <= WINDOW.width / n / 2 and float((y - gy).abs().max()) <= WINDOW.height / n / 2
    # and it is spread over its cell evenly: mean and variance of a uniform law, 2500 points
    for offset in ((x - gx) / (WINDOW.width / n), (y - gy) / (WINDOW.height / n)):
        assert abs(float(offset.mean())) < 5 * (1 / 12 / n**2) ** 0.5
        assert float(offset.var()) == pytest.approx(1 / 12, rel=0.1)


def test_the_jitter_is_splitmix64():
    """The first numbers of the published generator from the state 1234567, which steps by STRIDE before each."""
    state = 1234567 + sampling.SPLITMIX_INCREMENT * np.arange(1, 6, dtype=object)
    numbers = sampling._mix(np.array([s % (1 << 64) for s in state], dtype=np.uint64))
    assert numbers.tolist() == [
        6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821,
    ]  # fmt: skip


def test_the_jitter_is_uniform_and_independent():
    """Along the row, across rows, between x and y, and between seeds that differ by one: all of 16 x 16 alike."""
    n = 400
    cell = np.arange(n * n).reshape(n, n)
    (x, y), (other, _) = sampling.jitter(sampling.hash_seed(0), cell), sampling.jitter(sampling.hash_seed(1), cell)
    assert min(x.min(), y.min()) > 0 and max(x.max(), y.max()) < 1
    pairs = {"x, y": (x, y), "row": (x[:, 1:], x[:, :-1]), "column": (y[1:], y[:-1]), "seed": (x, other)}
    for name, (a, b) in pairs.items():
        counts = np.bincount(((a * 16).astype(int) * 16 + (b * 16).astype(int)).reshape(-1), minlength=256)
        chi2 = float(((counts - counts.mean()) ** 2 / counts.mean()).sum())
        assert 140 < chi2 < 390, name  # 255 degrees of freedom: mean 255, standard deviation 23
        assert abs(np.corrcoef(a.reshape(-1), b.reshape(-1))[0, 1]) < 5 / n, name


DRAWS = {"stratified": (stratified, 16), "random": (sampling.random, 256)}


@pytest.mark.parametrize("name", DRAWS)
def test_a_seed_means_its_points(name):
    draw, n = DRAWS[name]
    before = torch.get_rng_state()
    first, again, other = draw(WINDOW, n, 1), draw(WINDOW, n, 1), draw(WINDOW, n, 2)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(first, other, strict=True))
    assert torch.equal(torch.get_rng_state(), before)  # the caller's random numbers are left alone
