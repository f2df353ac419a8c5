"""The judge of tests/benchmarks/independent.py, which shares no code with bstcad, on a small design."""

import math

import numpy as np
import pytest
import torch

from bstcad.optics.receivers import goal
from bstcad.optics.receivers.irradiance import joined_cells
from tests import suite
from tests.benchmarks.independent import faces, interpolated, joined, judge, net_of, paired
from tests.benchmarks.judged_cells import finer_targets, stated_by_cell

SIGMAS = 3


@pytest.fixture(scope="module")
def judged(small_design):
    """The judge's figures of the small design: four million rays."""
    return judge(small_design.folder, points=1 << 19, finer_targets=finer_targets(small_design.folder)[0])


@suite.in_turn(1, 2)
def test_a_design_states_the_rrmsd_of_an_independent_monte_carlo(small_design, judged):
    stated = small_design.report
    error = math.hypot(stated["rrmsd_noise"], judged.error)
    assert error < 3e-4  # RRMSD; a seventeenth of what the design ends at
    assert abs(stated["rrmsd"] - judged.rrmsd) < SIGMAS * error


def test_a_design_states_the_rrmsd_of_an_independent_monte_carlo_on_cells_of_each_size(small_design, judged):
    stated = stated_by_cell(small_design.report)
    assert judged.by_cell[1.0] == pytest.approx((judged.rrmsd, judged.error))
    for size, (rrmsd, error) in stated.items():
        own, own_error = judged.by_cell[size]
        assert abs(rrmsd - own) < max(0.03 * own, SIGMAS * math.hypot(error, own_error)), size


def test_a_design_states_the_flux_of_an_independent_monte_carlo(small_design, judged):
    stated = small_design.report["flux"]
    assert stated["on target"] > 2e-3  # the source is small and far away
    assert judged.flux == pytest.approx({line: stated.get(line, 0.0) for line in judged.flux}, rel=1e-3, abs=2e-6)


def test_the_independent_picture_lies_where_the_stated_picture_lies(small_design, judged):
    with np.load(small_design.folder / "design.npz") as kept:
        stated = kept["irradiance"]
    for axis in (0, 1):
        place = np.arange(stated.shape[axis])
        centroids = [(p.sum(1 - axis) @ place) / p.sum() for p in (stated, judged.picture)]
        assert centroids[0] == pytest.approx(centroids[1], abs=0.02)  # pixels


def test_the_net_is_read_from_the_step_file(small_design):
    (back,) = faces(small_design.folder / "lens.step")["back"]
    with np.load(small_design.folder / "design.npz") as kept:
        assert np.abs(net_of(back).z - kept["control_points"][..., 2]).max() < 1e-9


def test_pairs_of_pictures_have_no_noise_in_their_mean():
    """RRMSD² of pictures with an error of 0.1 and independent noise of 0.3 is 0.01; a single picture's is 0.1."""
    target = np.ones(40_000)
    pattern = 0.1 * np.where(np.arange(target.size) % 2, 1, -1)
    pictures = target + pattern + 0.3 * np.random.default_rng(5).standard_normal((8, target.size))
    assert paired(pictures, target) == pytest.approx(0.1, rel=0.02)


def test_the_judge_interpolates_and_joins_cells_as_bstcad_does():
    """Two forms of the same mathematics: means over pixels are kept, and no cell is negative."""
    picture = np.random.default_rng(7).random((7, 10)) ** 4
    for count in (2, 4):
        fine = interpolated(picture, count)
        np.testing.assert_allclose(fine, goal.interpolated(picture, count), rtol=0, atol=1e-15)
        np.testing.assert_allclose(joined(fine, count), picture, rtol=0, atol=1e-15)
        assert fine.min() >= 0
    for count in (2, 4):  # the sides are not multiples of these
        np.testing.assert_allclose(joined(picture, count), joined_cells(torch.from_numpy(picture), count), atol=1e-15)
