"""The noise floor that a measurement states, against the truth: many more tubes, many more rays.

Small designs of three templates; everything is printed.  The floor decides how many tubes a verification takes: a
quarter too high costs a step more of them, too low and a figure is called resolved that is not.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from bstcad import pipeline
from bstcad.optics.measure import Effort, measure, simulated, tubes_picture
from bstcad.scene.scene import load

pytestmark = pytest.mark.bench
TEMPLATES = Path(__file__).parent.parent.parent / "templates"
SMALL = {
    "lens.back.control_points": 129, "target.pixels": 256, "tailoring.rays": 512, "tailoring.stage2_iterations": 60,
}  # fmt: skip
STEPS = ((1031, 1549), (1549, 2063), (2063, 3079))  # tubes a side: those of a verification, one after the other
MORE_TUBES, MORE_RAYS = 10, 100  # times as many
RAYS = 384  # a side, of each half
WITHIN = 1.5


@dataclass(frozen=True)
class Scaled:
    """Pictures of one sum, held against each other by the size of the target."""

    target: np.ndarray

    def apart(self, one, other):
        one, other = (p * (self.target.sum() / p.sum()) for p in (one, other))
        return float(np.linalg.norm(one - other) / np.linalg.norm(self.target))


@pytest.fixture(scope="module", params=["thu", "portrait", "caustic_letters"])
def made(request):
    """(name, lens, channels, screen, target)"""
    found = pipeline.design(load(TEMPLATES / f"{request.param}.toml", SMALL))
    return request.param, found.lens, found.scene.channels(), found.scene.target.screen, found.target


def said(what, estimate, truth):
    print(f"{what}: noise floor {estimate:.5f}, true {truth:.5f}, ratio {estimate / truth:.2f}")
    return estimate / truth


def test_the_floor_of_tubes_is_that_against_ten_times_as_many(made):
    name, *light, target = made
    print()
    finest = tubes_picture(*light, round(STEPS[-1][1] * MORE_TUBES**0.5)).numpy()
    for tubes in STEPS:
        finer = finest if tubes == STEPS[-1] else tubes_picture(*light, round(tubes[1] * MORE_TUBES**0.5)).numpy()
        found = measure(*light, target, Effort(tubes, rays=0))
        ratio = said(
            f"{name}, {tubes[0]}² and {tubes[1]}² tubes", found.noise, Scaled(target).apart(found.picture, finer)
        )
        assert 1 / WITHIN < ratio < WITHIN


def test_the_floor_of_rays_is_that_against_a_hundred_times_as_many(made):
    name, *light, target = made
    found = measure(*light, target, Effort((256,), rays=RAYS))
    halves = sum(simulated(*light, RAYS, seed).box.numpy() for seed in (0, 1))
    many = simulated(*light, round(RAYS * (2 * MORE_RAYS) ** 0.5), 2).box.numpy()
    ratio = said(f"\n{name}, 2 x {RAYS}² rays", found.ray_noise, Scaled(target).apart(halves, many))
    assert 1 / WITHIN < ratio < WITHIN
