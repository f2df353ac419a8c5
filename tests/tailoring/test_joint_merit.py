"""The joint merit of two faces: its gradients against differences, and the plain form against the fused kernels."""

from functools import partial

import pytest
import torch

from bstcad.optics.lens.losses import AbsorptionLoss, FresnelLoss, Losses
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.point import PointSource
from bstcad.optics.numerics import kernel_choice
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.tailoring.machinability import excess
from bstcad.tailoring.merit import Merit
from bstcad.tailoring.settings import Bounds
from bstcad.tailoring.stage2 import Problem
from tests import suite
from tests.tailoring.test_two_faces import BEAM, WAVES, N, bumpy, goals_of, merit_of, picture

POINT = PointSource((0.5, 0.0, -300.0), half_angle=1.2, wavelength=600.0)
OBLONG = Screen(30.0, (-9.0, 9.0), (-6.0, 6.0), (24, 16))
LEANING = Screen(60.0, (-9.0, 9.0), (-9.0, 9.0), 24, tilt=(10.0, -15.0))
# mm.  Where corners cross pixel borders the merit gets another second derivative: for single control points the
# extrapolated differences err by up to 3e-4 at steps of 1e-4, 7e-6 at 1e-5 and 2e-8 at 3e-6; and by 1e-7 at 1e-7, where
# rounding begins.
STEP = 2e-6


def two_lines(lens, source, wave=None):
    """The merit of light of two wavelengths on an oblong and a leaning target."""
    channels = Channel(source, N, 0.7), Channel(source, N + 0.02, 0.3)
    goals = [Goal("target[0]", OBLONG, picture(0)[:16], 1.0), Goal("target[1]", LEANING, picture(1), 2.0)]
    return Merit.of(channels, lens, 40, goals, 0.03, wave=wave)


def lossy(lens, source):
    """The merit of light of which faces and glass take some."""
    channel = Channel(source, N, losses=Losses(FresnelLoss(600.0), AbsorptionLoss(0.01)))
    return Merit.of((channel,), lens, 40, goals_of((1.0, 1.0)), 0.03)


def bowl():
    """The back as a bowl so steep that it reflects some of the light."""
    faces = bumpy(m=13)
    x = torch.linspace(-1, 1, faces.back.m, dtype=torch.float64)
    return faces.with_heights([faces.front.heights, faces.back.heights + 10.0 * (x[:, None] ** 2 + 0.8 * x**2)])


FACES, BOWL, TOUCHING = bumpy(m=13), bowl(), Bounds(thinnest=7.99)
CASES = {  # the lens, how its merit is made, the bounds on its faces
    "two pictures": (FACES, merit_of, None),
    "a point": (FACES, partial(merit_of, source=POINT), None),
    "two lines": (FACES, partial(two_lines, source=BEAM), None),
    "a plane wave": (FACES, partial(merit_of, wave=WAVES["plane"]), None),
    "a point and a spherical wave": (FACES, partial(merit_of, source=POINT, wave=WAVES["sphere"]), None),
    "two lines and a wave": (FACES, partial(two_lines, source=BEAM, wave=WAVES["zernike"]), None),
    "losses": (FACES, partial(lossy, source=BEAM), None),
    "lost rays": (BOWL, merit_of, None),
    "lost rays and a wave": (BOWL, partial(merit_of, wave=WAVES["zernike"]), None),
    "faces that touch": (FACES, merit_of, TOUCHING),
}


def problem_of(name):
    lens, merit, bounds = CASES[name]
    return Problem(lens, merit(lens), bounds, bound_weight=1000.0)


def ways(nets):
    """Directions in the heights of all nets: random ones, and single control points of each."""
    for seed in range(2):
        generator = torch.Generator().manual_seed(seed)
        yield [torch.randn(net.shape, dtype=torch.float64, generator=generator) for net in nets]
    for k, net in enumerate(nets):
        for off in ((0, 0), (-3, 2), (2, -1)):
            way = [torch.zeros(each.shape, dtype=torch.float64) for each in nets]
            way[k][tuple(net.m // 2 + o for o in off)] = 1.0
            yield way


@pytest.mark.parametrize("name", suite.in_turns(CASES, 2))
def test_the_gradient_is_that_of_extrapolated_differences(name):
    """Richardson: (4 D(h / 2) - D(h)) / 3 of central differences D errs as h⁴."""
    problem = problem_of(name)
    heights = [net.heights for net in problem.lens.nets]
    _, gradients, _ = problem(heights)
    largest = max(float(g.abs().max()) for g in gradients)

    def difference(way, step):
        there, back = (problem([h + s * w for h, w in zip(heights, way, strict=True)])[0] for s in (step, -step))
        return (there - back) / (2 * step)

    for way in ways(problem.lens.nets):
        known = float(sum((g * w).sum() for g, w in zip(gradients, way, strict=True)))
        found = (4 * difference(way, STEP / 2) - difference(way, STEP)) / 3
        assert found == pytest.approx(known, rel=1e-6, abs=1e-9 * largest)


@pytest.mark.parametrize("name", CASES)
def test_the_plain_form_is_the_fused_one(name, monkeypatch):
    """Tubes, merit, RRMSD and both gradients: a hit is found to 1e-13 mm by the one, and a step better by the other."""
    found = []
    for enabled in (True, False):
        monkeypatch.setattr(kernel_choice, "ENABLED", enabled)
        problem = problem_of(name)
        found.append(problem([net.heights for net in problem.lens.nets]))
    (merit, gradients, rrmsd), (plain, wanted, known) = found
    assert (merit, rrmsd) == pytest.approx((plain, known), rel=1e-10)
    for fused, own in zip(gradients, wanted, strict=True):
        assert float((fused - own).norm()) <= 1e-10 * float(own.norm())


def test_the_hard_cases_are_hard():
    """Light is lost on its path in one case; in another one the faces are nearer to each other than they may be."""
    for (landed,) in merit_of(BOWL).landing(BOWL).on_goals:
        assert 0.02 < 1 - float(landed.alive.double().mean()) < 0.5
    assert excess(FACES, TOUCHING).worst > 0
