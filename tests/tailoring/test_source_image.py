"""The light of a source's middle, blurred by its images: against rays from all its points, and against the point."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import channels_of, drawn_channels
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.numerics.reductions import total
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace.measure import RayTubes, simulated, squared_distance
from bstcad.scene.quality import Tailoring
from bstcad.tailoring.driver import Task
from bstcad.tailoring.merit import Merit
from bstcad.tailoring.source_image import ExtendedSource, LocalImages, _biquadratic, blur_error, blurs, with_border
from bstcad.tailoring.stage2 import Problem, _overshoot_weight
from tests.lenses import net

INDEX, SIZE = 1.5, 2.4
SCREEN = Screen(150.0, (-38.0, 36.0), (-36.0, 36.0), (50, 48))  # wider than the light, whose rim is sharp
CHIP = PointSource((1.0, 0.0, -40.0), profile="lambertian", width=SIZE, height=1.0)
SOURCES = {
    "disc": PointSource((1.0, 0.0, -40.0), profile="lambertian", diameter=SIZE),
    "chip": CHIP,
    "line": replace(CHIP, height=None),
    "tilted": replace(CHIP, tilt=(0.0, 8.0)),
    "sun": CollimatedSource(Circle(8.0), divergence=2.5),
    "two divergences": CollimatedSource(Circle(8.0), divergence=(2.5, 1.0), rotate=30.0),
}


def lens():
    back = net(lambda x, y: -0.003 * (x**2 + y**2) + 0.02 * torch.cos(0.4 * x) * torch.sin(0.3 * y), 6.0, 25)
    return Lens.between(Sphere(1.0, 0.005), back, Circle(9.0), INDEX)


def extended(source):
    light = channels_of(source.central, lambda nm: INDEX, 1)
    return ExtendedSource(source, light, lambda points, seed: drawn_channels(source, lambda nm: INDEX, points, seed))


GOALS = (Goal("target", SCREEN, np.random.default_rng(0).uniform(0.5, 1.5, SCREEN.shape)),)


def merit(source, n=60, goals=GOALS, overshoot=0.03, seed=None):
    light = extended(source)
    return Merit.of(light.centre, lens(), n, goals, overshoot).with_blur(light, lens(), seed)


def shown(merit):
    """The picture by the images, of each goal."""
    with torch.no_grad():
        return [merit.picture(k, landed)[0] for k, landed in enumerate(merit.landing(lens()).on_goals)]


def by_rays(source, sets=6):
    """Independent pictures of sum 1, each from other points of the source."""
    seen = extended(source)
    sets_of_rays = [simulated(lens(), seen.sampler(128, seed), [SCREEN], n=50, seed=seed) for seed in range(sets)]
    return [rays.box / total(rays.box) for [rays] in sets_of_rays]


def off(pictures, other):
    """RRMSD of a picture from that of independent ones, without their noise."""
    return math.sqrt(max(squared_distance(pictures, other / total(other))[0], 0.0))


def of_point(source):
    light = channels_of(source.central, lambda nm: INDEX, 1)
    return RayTubes.launched(lens(), light, 60).picture(lens(), SCREEN)


@pytest.mark.parametrize("name", SOURCES)
def test_the_blurred_light_is_the_sum_over_the_points(name):
    """Images alone, against rays from many points: a quarter at most of the change by the source's size."""
    source = SOURCES[name]
    rays, (found,) = by_rays(source), shown(merit(source))
    assert off(rays, found) < 0.25 * off(rays, of_point(source))


def test_a_source_of_next_to_no_size_is_a_point():
    """The merit is a point's, too, but for light outside the border, which the wider screen of the blur holds."""
    tiny = replace(SOURCES["disc"], diameter=1e-6)
    plain = Merit.of(extended(tiny).centre, lens(), 60, GOALS, 0.0)
    one, two = (each(each.landing(lens())) for each in (merit(tiny, overshoot=0.0), plain))
    for mine, other in zip(one, two, strict=True):
        assert float(mine) == pytest.approx(float(other), rel=1e-3)  # tents of a fifth of a pixel


def test_flux_is_kept():
    """A blur moves light; what leaves a screen that holds all of it is nothing."""
    wide = with_border(SCREEN, 60)
    source = extended(SOURCES["disc"])
    [blur] = blurs(source, lens(), wide)
    light = RayTubes.launched(lens(), source.centre, 60).picture(lens(), with_border(wide, blur.border)).numpy()
    share = LocalImages.of(SOURCES["disc"], source.centre[0], lens(), wide).flux
    assert blur.forward(light).sum() / light.sum() == pytest.approx(float(share.mean()), rel=0.02)


def test_the_adjoint_is_the_transpose():
    [blur] = blurs(extended(SOURCES["chip"]), lens(), SCREEN)
    generator = np.random.default_rng(1)
    light = generator.normal(size=tuple(side + 2 * blur.border for side in SCREEN.shape))
    g = generator.normal(size=SCREEN.shape)
    assert (blur.forward(light) * g).sum() == pytest.approx((light * blur.adjoint(g)).sum(), rel=1e-12)


FURTHER = replace(SCREEN, z=250.0, tilt=(20.0, 0.0))
TWO = (*GOALS, Goal("target[1]", FURTHER, np.full(FURTHER.shape, 1 / 2400), weight=2.0))


def test_each_of_several_goals_is_blurred_by_images_of_its_own():
    """The picture of each goal is the picture of that goal alone, and not that of a point."""
    source = SOURCES["disc"]
    for goal, found in zip(TWO, shown(merit(source, goals=TWO)), strict=True):
        [alone] = shown(merit(source, goals=(goal,)))
        torch.testing.assert_close(found, alone, rtol=1e-9, atol=1e-12)
        by_point = RayTubes.launched(lens(), extended(source).centre, 60).picture(lens(), goal.screen)
        assert float((found / total(found) - by_point / total(by_point)).norm()) > 0.1 * float(found.norm())


@pytest.mark.parametrize("goals", [GOALS, TWO], ids=["one goal", "two"])
def test_the_gradient_is_that_of_differences(goals):
    problem, heights = Problem(lens(), merit(SOURCES["disc"], n=50, goals=goals, seed=1)), lens().back.heights
    _, [gradient], _ = problem([heights])
    way = 1e-6 * torch.from_numpy(np.random.default_rng(2).normal(size=heights.shape))
    ahead, behind = (problem([heights + sign * way])[0] for sign in (1, -1))
    assert (ahead - behind) / 2 == pytest.approx(float(total(gradient * way)), rel=1e-3)


def test_what_the_images_leave_out_is_measured_by_rays():
    """Images of half the size leave out more; with what rays measured the picture is that of all points again."""
    source = SOURCES["disc"]
    rays, half = by_rays(source), merit(replace(source, diameter=SIZE / 2))
    [found] = shown(half)
    mended = found + blur_error(found, extended(source).sampler, lens(), SCREEN, border=half.blurs[0][0].border, seed=3)
    assert off(rays, mended) < 0.5 * off(rays, found)


def test_nine_points_make_every_biquadratic():
    points = [(0.3, -0.9), (-0.5, 0.1), (0.0, 1.0)]

    def form(u, v):
        return 1 + 2 * u - v + 0.5 * u * v + 3 * u * u * v - u * u * v * v

    nine = torch.tensor([form(i * 0.7, j * 0.7) for j in (-1, 0, 1) for i in (-1, 0, 1)], dtype=torch.float64)
    found = (nine[:, None] * _biquadratic(points)).sum(0)
    assert found.tolist() == pytest.approx([form(*p) for p in points])


def test_light_that_no_place_shows_is_not_blurred():
    """Nothing gets through: the images are those of a point."""
    nowhere = replace(SOURCES["disc"], position=(500.0, 0.0, 5.9))
    offset, share = LocalImages.of(nowhere, extended(nowhere).centre[0], lens(), SCREEN).nearest(0.0, 0.0)
    assert not offset.any() and bool((share == 1).all())


def test_a_rectangle_of_light_casts_a_rectangle():
    """Free space would be a pinhole: the images of the chip's corners stand apart as its sides do."""
    seen = LocalImages.of(CHIP, extended(CHIP).centre[0], lens(), SCREEN)
    nine = seen.offset.mean(-1)
    wide, high = float((nine[0, 5] - nine[0, 3]).abs()), float((nine[1, 7] - nine[1, 1]).abs())
    assert wide / high == pytest.approx(SIZE, rel=0.1) and Rectangle(SIZE, 1.0) == CHIP.extent


@pytest.mark.parametrize("name", SOURCES)
def test_a_few_points_tell_how_wide_the_image_is(name):
    """The pull on light beyond the border falls with the width of the image, by all 64 points or by a few."""
    source = SOURCES[name]
    light, settings = channels_of(source, lambda nm: INDEX, 64), Tailoring(overshoot=0.03).resolved(65)
    task = Task(light, GOALS, settings, extended_sources=(extended(source),))
    by_all = _overshoot_weight(replace(task, extended_sources=()), lens())
    assert _overshoot_weight(task, lens()) == pytest.approx(by_all, rel=0.02) and by_all < 0.02
