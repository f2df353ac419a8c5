"""Fresnel's losses and the ghost by a program not written here: mitsuba's particle tracer; run by `make bench`.

Whole pictures of all templates: test_judges.py.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from bstcad.judges import comparison
from bstcad.judges import mitsuba as judge
from bstcad.optics.measure import tubes_picture
from bstcad.optics.trace import ghost_light
from tests.benchmarks.written_lenses import SCENES, written

pytestmark = pytest.mark.bench

PHOTONS = 8_000_000
REPETITIONS = 8  # of the ghost, each with a share of the photons
TUBES = 1031
SIGMAS = 4


@pytest.fixture(scope="module", params=SCENES)
def lens(request, tmp_path_factory):
    return written(request.param, tmp_path_factory.mktemp("judged"))


def test_the_irradiance_with_fresnels_losses_is_mitsubas(lens):
    screen, target = lens.scene.target.screen, lens.scene.target.irradiance()
    channels = lens.scene.channels()
    found = comparison.compare("mitsuba", lens.lens, channels, screen, target, rays=PHOTONS)
    lossless = tubes_picture(lens.lens, channels, comparison.coarse(screen), TUBES).numpy()
    theirs = found.theirs / found.theirs.sum() * found.on_target
    without = np.linalg.norm(theirs - lossless) / np.linalg.norm(lossless) / found.noise
    print(
        f"\n{found.rays / 1e6:.0f} M photons, noise {found.noise:.2%} of the picture: difference over that noise "
        f"{found.over_noise:.3f}, without Fresnel {without:.2f}; flux {found.on_target:.5f} there, "
        f"{found.on_target_ours:.5f} here",
        end="",
    )
    assert found.over_noise <= 1.1  # of two thousand pixels or more: 1 within a few hundredths
    assert without > 3  # so a wrong loss is seen
    assert found.on_target == pytest.approx(found.on_target_ours, rel=1e-3)


def test_the_ghost_is_mitsubas(tmp_path):
    """Its flux over all of the target, and where it falls alone: on pixels two away from any that others light."""
    lens = written("a point, through a sphere", tmp_path)
    screen = lens.scene.target.screen
    channels = judge.light(lens.lens, lens.scene.channels())
    theirs = np.concatenate(
        [
            judge.trace(lens.lens, channels, screen, PHOTONS * 2 // REPETITIONS, seed, reflections=2).halves
            for seed in range(REPETITIONS // 2)
        ]
    )
    ghost = ghost_light(lens.lens, channels, screen, 1024, 0).picture.numpy()
    straight = tubes_picture(lens.lens, channels, screen, TUBES).numpy()
    alone = ~binary_dilation(straight > 1e-6 * straight.max(), iterations=2)
    for where, others in ((np.ones_like(alone), straight.sum()), (alone, 0.0)):
        seen = theirs[:, where].sum(axis=1)
        found, noise = float(seen.mean()), float(seen.std(ddof=1)) / math.sqrt(len(seen))
        expected = float(others + ghost[where].sum())
        print(f"\nflux {found:.6f} ± {noise:.6f} there, {expected:.6f} here, {others:.6f} without a ghost", end="")
        assert abs(found - expected) < SIGMAS * noise < found - others
