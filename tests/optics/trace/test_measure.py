"""One measurement: a weighted sum over channels, as fine as it needs to be, and honest where there is no light."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace import measure as measuring
from bstcad.optics.trace.measure import Effort, measure, spectral_lines, squared_distance, tubes_picture
from tests.lenses import lens_of, net

SCREEN = Screen(120.0, (-14.0, 12.0), (-12.0, 12.0), (13, 12))
EFFORT = Effort(128, accuracy=0.0)
LENS = lens_of(
    net(lambda x, y: -0.004 * (x**2 + y**2) + 0.05 * torch.cos(0.4 * x) * torch.sin(0.3 * y), z=6.0, m=25),
    Sphere(1.0, 0.005),
)


def target():
    return np.random.default_rng(0).uniform(0.5, 1.5, SCREEN.shape)


BEAM, LAMP = CollimatedSource(Circle(8.0)), PointSource((2.0, 0.0, -60.0), profile="uniform", half_angle=7.0)


def test_light_is_the_weighted_sum_of_its_channels():
    """Pictures of all light (each scaled by what falls on the screen) and ledgers add up by weight."""
    channels = (Channel(BEAM, 1.48, 0.3), Channel(LAMP, 1.52, 0.7))
    parts = [measure(LENS, (replace(c, weight=1.0),), SCREEN, target(), EFFORT) for c in channels]
    both = measure(LENS, channels, SCREEN, target(), EFFORT)
    for line in both.flux:
        wanted = sum(c.weight * part.flux[line] for c, part in zip(channels, parts, strict=True))
        assert both.flux[line] == pytest.approx(wanted, abs=1e-4)  # cells on a beam's rim count in or out
    assert sum(both.flux.values()) == pytest.approx(1, abs=1e-12)
    on = [c.weight * part.flux["on target"] for c, part in zip(channels, parts, strict=True)]
    mixed = sum(w * part.picture for w, part in zip(on, parts, strict=True)) / sum(on)
    assert np.abs(mixed - both.picture).max() < 0.02 * both.picture.max()  # rays weigh here, tubes there


@pytest.mark.parametrize("noise", [0.02, 2.0])  # of a pixel: the lens's own error of 0.1 rules, or the noise
def test_the_standard_error_is_the_scatter(noise):
    """500 measurements of 8 pictures: the scatter is known to 3 %.  The jackknife is 1.5 times too large at 2.0."""
    random, pattern = np.random.default_rng(3), 0.1 * (-1.0) ** np.arange(400)
    drawn = torch.from_numpy(1 + pattern + noise * random.standard_normal((500, 8, 400)))
    flat = torch.ones(400, dtype=torch.float64)
    found, stated = np.array([squared_distance(tuple(pictures), flat) for pictures in drawn]).T
    assert found.mean() == pytest.approx(0.01, abs=4 * found.std() / math.sqrt(500))
    assert 0.9 < math.sqrt((stated**2).mean()) / found.std() < 1.3


def test_no_more_rays_than_the_accuracy_asks_for():
    loose, asked, tight = (
        measure(LENS, (Channel(BEAM, 1.5),), SCREEN, target(), Effort(rays=1024, accuracy=accuracy))
        for accuracy in (1.0, 0.02, 0.0)
    )
    assert loose.rays < tight.rays / 5 and tight.standard_error < loose.standard_error
    assert 0 < asked.standard_error < 0.02 * asked.rrmsd


def board(amplitude, shape=SCREEN.shape):
    return 1 + amplitude * (-1.0) ** np.add.outer(*map(np.arange, shape))


def test_a_witness_fails_a_trace_that_is_truly_off(monkeypatch):
    """An RRMSD of 0.005: an index off by 0.004 in one of both traces changes the picture by 5 parts in a thousand."""
    channels = (Channel(LAMP, 1.5),)
    wanted = tubes_picture(LENS, channels, SCREEN, 1026).numpy() * board(0.005)
    right = measure(LENS, channels, SCREEN, wanted, Effort(rays=512))
    assert right.rrmsd == pytest.approx(0.005, rel=0.1) and right.witness.difference < right.witness.limit < 0.003
    off = (Channel(LAMP, 1.504),)
    monkeypatch.setattr(measuring, "tubes_picture", lambda lens, _, *rest: tubes_picture(lens, off, *rest))
    wrong = measure(LENS, channels, SCREEN, wanted, Effort(rays=512)).witness
    assert wrong.limit < wrong.difference < 0.008


@pytest.mark.parametrize("error", [0.005, 0.01, 0.02])  # RRMSD of the lens
@pytest.mark.parametrize("difference", [0.0, 0.6])  # of the RRMSD: by which rays and tubes truly differ
def test_a_witness_is_right_in_both_directions(error, difference):
    """Tubes whose own error is the RRMSD at first and falls as n^-1.6; patterns without noise that do not overlap."""
    flat, random = np.ones((64, 64)), np.random.default_rng(1)
    of_lens, of_tubes, of_fault = (error * (p - p.mean()) / p.std() for p in random.standard_normal((3, 64, 64)))
    boxes = [torch.from_numpy(flat + of_lens + difference * of_fault)] * 8

    def by_tubes(n):
        return torch.from_numpy(flat + of_lens + (1031 / n) ** 1.6 * of_tubes)

    witness = measuring._compare(boxes, by_tubes, torch.from_numpy(flat), rrmsd_by_rays=error, first=1031)
    assert (witness.difference <= witness.limit) == (difference == 0)
    assert 2000 < witness.tubes < 4200 and witness.limit == pytest.approx(error / 2, rel=0.1)


def test_the_picture_is_as_near_to_the_lens_s_own_as_it_says():
    """A smooth picture by few rays: smoothing takes more noise from it than detail."""
    screen = replace(SCREEN, pixels=(64, 64))
    flat = np.ones(screen.shape)
    few, many = (
        measure(LENS, (Channel(LAMP, 1.5),), screen, flat, Effort(rays, accuracy=0.0, witness=False))
        for rays in (128, 1024)
    )
    off = np.linalg.norm(few.picture - many.picture) / np.linalg.norm(flat)
    assert off == pytest.approx(few.picture_error, rel=0.5)


def test_where_no_light_falls_there_is_no_figure():
    away = replace(SCREEN, x=(1000.0, 1010.0))
    light = measure(LENS, (Channel(BEAM, 1.5),), away, target(), EFFORT)
    assert math.isnan(light.rrmsd) and not light.picture.any()


def test_the_lines_of_a_spectrum_apart_sum_to_the_light_of_all():
    """Each by itself with its share; of one line alone there is nothing to take apart."""
    channels = (
        Channel(replace(BEAM, wavelength=656.3), 1.488, 0.75),
        Channel(replace(BEAM, wavelength=486.1), 1.5, 0.25),
    )
    lines = spectral_lines(LENS, channels, Goal("target", SCREEN, target()), 64)
    assert [line.wavelength for line in lines] == [486.1, 656.3]
    assert [line.share for line in lines] == [0.25, 0.75]
    for line, channel in zip(lines, reversed(channels), strict=True):
        alone = tubes_picture(LENS, (channel,), SCREEN, 64).numpy()
        np.testing.assert_allclose(line.picture, alone * (target().sum() / alone.sum()), rtol=0, atol=1e-12)
    assert np.abs(lines[0].picture - lines[1].picture).max() > 1e-3 * target().max()  # dispersion
    assert spectral_lines(LENS, channels[:1], Goal("target", SCREEN, target()), 64) == ()


class TestRealSource:
    """The light blurred by the image of a source that the rays do not have."""

    def test_a_blur_has_the_second_moment_of_the_source_and_keeps_the_light(self):
        point = torch.zeros(65, 65, dtype=torch.float64)
        point[32, 32] = 1.0
        for diameter in (3.0, 12.0):
            found = measuring._blurred(point, point, diameter).numpy()
            across = np.arange(65) - 32.0
            assert found.sum() == pytest.approx(1.0)
            assert [found.sum(k) @ across**2 for k in (0, 1)] == pytest.approx([diameter**2 / 16] * 2, rel=0.01)

    def test_light_beyond_the_edges_is_lost(self):
        """Even light: the corners keep a quarter, and the middle keeps all, before it is scaled to the target's sum."""
        even = torch.ones(64, 64)
        found = measuring._blurred(even, even, 8.0)
        assert float(found[0, 0] / found[32, 32]) == pytest.approx(0.25 * (1 + 0.5 / (2.0 * 1.2533)) ** 2, rel=0.02)

    def test_noise_does_not_bias_the_error_of_the_blurred_light(self):
        """Stripes of 20 % and a noise of 50 %: without noise the blurred light has the same RRMSD."""
        random, stripes = np.random.default_rng(5), 1 + 0.2 * (-1.0) ** np.arange(96) * np.ones((96, 1))
        noisy = [torch.from_numpy(stripes + 0.5 * random.standard_normal((96, 96))) for _ in range(measuring.SETS)]
        target = torch.full((96, 96), float(stripes.mean()), dtype=torch.float64)
        noiseless = measuring._blurred(torch.from_numpy(stripes), target, 2.0)
        wanted = float(((noiseless - target) ** 2).sum() / (target**2).sum()) ** 0.5
        found = measuring._cell_error(0.5, noisy, target, image=1.0)
        assert found.rrmsd == pytest.approx(0.2, rel=0.02) and found.blurred == pytest.approx(wanted, rel=0.1)
        assert found.counted == found.blurred < 0.2

    def test_only_cells_narrower_than_the_image_are_blurred(self):
        goal, channels = Goal("target", SCREEN, target()), (Channel(BEAM, 1.5),)
        sharp, wide = (
            measuring.measure_goals(LENS, channels, [goal], EFFORT, ghost=None, sampler=None, images=images)[0]
            for images in ((), (0.8,))
        )
        assert [each.blurred for each in sharp.by_cell] == [None] * 5
        assert [each.cell for each in wide.by_cell if each.blurred is not None] == [0.5, 0.25]
        assert [each.rrmsd for each in wide.by_cell] == [each.rrmsd for each in sharp.by_cell]
        assert all(each.blurred < each.rrmsd for each in wide.by_cell[3:])  # a random target, far from the light
