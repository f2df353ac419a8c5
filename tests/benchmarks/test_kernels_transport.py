"""How transport grows with its grid: run by `make bench`.  Figures are printed; only ratios of one run are asserted."""

import statistics
import time

import numpy as np
import pytest
import scipy.fft
from skimage.data import astronaut

from bstcad.transport import Density, back_and_forth, solve
from bstcad.transport.poisson import Poisson
from bstcad.transport.threads import threads, threads_for
from tests.benchmarks.timing import median_seconds

pytestmark = pytest.mark.bench
SIZES = (256, 512, 1024)  # cells a side
SLACK = 1.6  # caches: 256² doubles are half a megabyte, 1024² are eight


def densities(n):
    """A disc to a portrait."""
    disc = Density.from_function(lambda x, y: 1.0 * ((x - 0.5) ** 2 + (y - 0.5) ** 2 < 0.25), n)
    return disc, Density.from_picture(astronaut().mean(axis=2), n, floor=1e-2)


def seconds_an_iteration(n, iterations=9):
    """Median over iterations at full size, from a start that the grids below have brought into place."""
    stamps = []

    def note(step):
        if step.grid == n:
            stamps.append(time.perf_counter())

    back_and_forth(*densities(n), iterations=iterations, tolerance=0.0, progress=note)
    return statistics.median(np.diff(stamps))


def grown(seconds, n_log_n):
    """Prints the table and its exponent; how much more the largest costs than n² (log n) allows."""
    exponent = np.polyfit(np.log(SIZES), np.log(seconds), 1)[0]
    table = ", ".join(f"{n}²: {s:.4f} s" for n, s in zip(SIZES, seconds, strict=True))
    print(f"{table}; grows as n^{exponent:.2f}")
    allowed = (SIZES[-1] / SIZES[0]) ** 2
    if n_log_n:
        allowed *= np.log(SIZES[-1]) / np.log(SIZES[0])
    return seconds[-1] / seconds[0] / allowed


def test_an_iteration_of_back_and_forth_grows_as_its_cells():
    seconds_an_iteration(SIZES[0], 2)  # compiles
    print("\nback-and-forth, an iteration: ", end="")
    assert grown([seconds_an_iteration(n) for n in SIZES], n_log_n=True) < SLACK


def test_a_map_grows_as_its_cells():
    solve(*densities(64))
    print("\nmapping.solve, all grids: ", end="")
    assert grown([median_seconds(lambda n=n: solve(*densities(n)), 3) for n in SIZES], n_log_n=True) < SLACK


def test_one_series_and_an_elimination_beat_two_series():
    n = SIZES[-1]
    r, poisson = np.random.default_rng(0).normal(size=(n, n)), Poisson(n)
    workers = threads_for(n)

    def two_series():
        return scipy.fft.idctn(scipy.fft.dctn(r, workers=workers), workers=workers, overwrite_x=True)

    with threads(n):
        ratio = median_seconds(two_series) / median_seconds(lambda: poisson.solve(r))
    print(f"\nPoisson at {n}²: two cosine series / one with elimination = {ratio:.1f}")
    assert ratio > 1.2
