"""The judge of tests/benchmarks/independent.py, which shares no code with bstcad, on a small design."""

import math

import numpy as np
import pytest

from tests.benchmarks.independent import faces, judge, net_of, paired

SIGMAS = 3


@pytest.fixture(scope="module")
def judged(small_design):
    """The judge's figures of the small design: two million rays."""
    return judge(small_design.folder, points=1 << 18)


def test_a_design_states_the_rrmsd_of_an_independent_monte_carlo(small_design, judged):
    stated = small_design.report
    error = math.hypot(stated["rrmsd_noise"], judged.error)
    assert error < 3e-4  # RRMSD; a seventeenth of what the design ends at
    assert abs(stated["rrmsd"] - judged.rrmsd) < SIGMAS * error


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
