"""Values of the light against an own count over other rays, and against what is known of simple light."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.analysis.light_values import LightSets, glare
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.directions import Directions
from bstcad.optics.receivers.irradiance import Screen, landed_flux
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.measure import Effort, measure
from bstcad.optics.trace.trace import trace, window
from bstcad.photometry.intensity import Intensity
from tests.lenses import lens_of, wavy

SOURCE = PointSource((0.0, 0.0, 0.0))
LENS = lens_of(wavy(z=24.0), Plane(20.0), Circle(10.0), 1.5)
SCREENS = {
    "plane": Screen(100.0, (-36.0, 24.0), (-24.0, 24.0), (60, 48)),
    "directions": Screen(0.0, (-24.0, 16.0), (-16.0, 16.0), (50, 40), surface=Directions("A")),
}
OWN_SIDE = 1400  # rays per side of the own count


@pytest.fixture(scope="module", params=SCREENS)
def lit(request):
    """(screen, values of the light, own rays): coordinates x, y of random rays of their own, and their flux."""
    return light_and_own_rays(SCREENS[request.param])


def light_and_own_rays(screen):
    channels, wanted = [Channel(SOURCE, 1.5)], screen.cell_sizes / screen.cell_sizes.sum()
    light = measure(LENS, channels, screen, wanted, Effort(512, accuracy=0.0, witness=False))
    found = LightSets.of(screen, [each.numpy() for each in light.sets], light.on_screen, target=wanted)
    area, chance = window(SOURCE, LENS), torch.Generator().manual_seed(5)
    cell = (torch.arange(OWN_SIDE, dtype=torch.float64) + 0.5) / OWN_SIDE - 0.5
    jitter = (torch.rand((2, OWN_SIDE, OWN_SIDE), generator=chance, dtype=torch.float64) - 0.5) / OWN_SIDE
    x = (area.width * (cell[:, None] + jitter[0])).reshape(-1)
    y = (area.height * (cell + jitter[1])).reshape(-1)
    landed = trace(SOURCE.rays_through(x, y, LENS.entrance.z, area.area / OWN_SIDE**2), LENS, screen.receiver)
    return screen, found, (*landed.position.numpy(), landed_flux(landed).numpy())


def size_of_disc(screen, at, radius):
    """Area or solid angle of a disc, on a fine grid."""
    fine = (np.arange(400) + 0.5) / 200 - 1
    x, y = np.meshgrid(at[0] + radius * fine, at[1] + radius * fine)
    inside = (x - at[0]) ** 2 + (y - at[1]) ** 2 < radius**2
    if screen.receiver.unit == "mm":
        return inside.sum() * (radius / 200) ** 2
    return (inside * np.cos(np.radians(y))).sum() * math.radians(radius / 200) ** 2


def own_mean(screen, rays, at, radius):
    """Mean over a disc by counting rays."""
    x, y, flux = rays
    return flux[(x - at[0]) ** 2 + (y - at[1]) ** 2 < radius**2].sum() / size_of_disc(screen, at, radius)


@pytest.mark.parametrize("at", [(0.0, 0.0), (-5.3, 4.1), (6.6, -3.2)])
@pytest.mark.parametrize(("radius", "noise"), [(1.5, 0.03), (4.0, 0.01)])
def test_a_point_is_what_own_rays_count(lit, at, radius, noise):
    """noise: about three standard deviations of the own count, and of the pixels at the edge of the disc."""
    screen, found, rays = lit
    value, own = found.mean(at, radius), own_mean(screen, rays, at, radius)
    assert value.standard_error < noise * own / 2
    assert value.value == pytest.approx(own, rel=noise)
    assert found.mean(at, radius, relative=True).value == pytest.approx(own / own_whole(screen, rays), rel=noise)


def own_whole(screen, rays):
    """Mean over the screen by counting rays."""
    x, y, flux = rays
    on = (x > screen.x[0]) & (x < screen.x[1]) & (y > screen.y[0]) & (y < screen.y[1])
    return flux[on].sum() / screen.cell_sizes.sum()


def test_uniformity_is_what_own_rays_count(lit):
    """Discs about points of a grid as fine as the pixels, from rays sorted into a fine histogram."""
    screen, found, rays = lit
    x, y, flux = rays
    fine = [np.linspace(*ends, 5 * n + 1) for ends, n in ((screen.x, screen.columns), (screen.y, screen.rows))]
    count, *_ = np.histogram2d(x, y, fine, weights=flux)
    u, v = (each[:-1] + np.diff(each) / 2 for each in fine)
    reach = 4.0 + max(found.pixel)
    own = np.array([
        count[np.hypot(u[:, None] - a, v - b) < 4.0].sum() / size_of_disc(screen, (a, b), 4.0)
        for a in np.arange(screen.x[0] + reach, screen.x[1] - reach, 2.4)
        for b in np.arange(screen.y[0] + reach, screen.y[1] - reach, 2.4)
    ])  # fmt: skip
    to_mean, to_max = found.ratios(4.0)
    assert to_mean.value == pytest.approx(own.min() / own_whole(screen, rays), rel=0.05)
    assert to_max.value == pytest.approx(own.min() / own.max(), rel=0.05)
    assert 0 < to_mean.standard_error < 0.01 and 0 < to_max.standard_error < 0.01


@pytest.mark.parametrize("kind", SCREENS)
def test_a_cut_off_is_what_own_rays_count(kind):
    """The edge of the light, on a screen that is wider than it."""
    wide = replace(SCREENS[kind], x=(-120.0, 120.0), y=(-120.0, 120.0), pixels=60)
    if kind == "directions":
        wide = replace(wide, x=(-60.0, 60.0), y=(-60.0, 60.0))
    screen, found, (x, y, flux) = light_and_own_rays(wide)
    width, height = found.pixel
    at = screen.x[0] + 30.5 * width  # the middle of a pixel
    value = found.sharpness(at, height)
    line, _ = np.histogram(
        y[np.abs(x - at) < width / 2], screen.rows, screen.y, weights=flux[np.abs(x - at) < width / 2]
    )
    line = np.maximum(line / screen.cell_sizes[::-1, 30], 1e-4 * (line / screen.cell_sizes[::-1, 30]).max())
    assert value.value == pytest.approx(np.log10(line[:-1] / line[1:]).max(), rel=0.04)
    assert value.value > 0.5 and value.standard_error < 0.05


# ---- simple light ----------------------------------------------------------------------------------------------------


def sets_of(density, screen, noise=0.0, count=8):
    """Sets of pictures of a density per area, with independent noise in each pixel."""
    chance = np.random.default_rng(3)
    flux = tuple(density * screen.cell_sizes * (1 + noise * chance.normal(size=density.shape)) for _ in range(count))
    return LightSets(screen, flux, *2 * [np.ones(density.shape, bool)])


def centres(screen):
    (left, right), (low, high), (rows, columns) = screen.x, screen.y, screen.shape
    x, y = (
        left + (np.arange(columns) + 0.5) / columns * (right - left),
        high - (np.arange(rows) + 0.5) / rows * (high - low),
    )
    return np.meshgrid(x, y)


def test_a_disc_has_its_area_and_centroid():
    screen = Screen(0.0, (-10.0, 10.0), (-6.0, 6.0), (40, 16))
    found = sets_of(np.ones(screen.shape), screen)
    x, y = centres(screen)
    for radius in (0.3, 1.0, 4.5):
        part = found.part_of_disc((1.3, -0.7), radius)
        assert (part * screen.cell_sizes).sum() == pytest.approx(math.pi * radius**2, rel=2e-3)
        assert part.max() <= 1 + 1e-12
        if radius > 1:
            assert (part * x).sum() / part.sum() == pytest.approx(1.3, abs=0.05)
    beside = found.part_of_disc((-10.0, 6.0), 2.0)
    assert (beside * screen.cell_sizes).sum() == pytest.approx(math.pi, rel=2e-3)  # a quarter


def test_solid_angles_of_cells_sum_to_that_of_the_window():
    x, y = (-40.0, 30.0), (-20.0, 50.0)
    whole = math.radians(x[1] - x[0]) * (math.sin(math.radians(y[1])) - math.sin(math.radians(y[0])))
    assert Directions("A").cell_sizes(x, y, (7, 9)).sum() == pytest.approx(whole, rel=1e-10)
    cap = Directions("C").cell_sizes((-30.0, 30.0), (-30.0, 30.0), (600, 600))
    u, v = centres(Screen(0.0, (-30.0, 30.0), (-30.0, 30.0), 600))
    inside = np.hypot(u, v) < 25.0
    assert cap[inside].sum() == pytest.approx(2 * math.pi * (1 - math.cos(math.radians(25.0))), rel=1e-3)


def test_noise_does_not_move_the_smallest_value():
    """Even light with 5 per cent of noise: the extreme of the mean picture is 5 per cent off, this is not."""
    screen = Screen(0.0, (0.0, 50.0), (0.0, 50.0), 50)
    found = sets_of(np.ones(screen.shape), screen, noise=0.05)
    naive = np.mean(found.flux, 0).min() / np.mean(found.flux)
    to_mean, to_max = found.ratios(0.55)
    assert naive < 0.95 and abs(to_mean.value - 1) < 4 * to_mean.standard_error < 0.08
    assert abs(to_max.value - 1) < 4 * to_max.standard_error < 0.12


def test_an_edge_has_the_sharpness_of_its_slope():
    """E = 10^(-s y): G = s · step, whatever the pixels; downwards there is no cut-off; dark lines have no value."""
    screen = Screen(0.0, (-1.0, 1.0), (-1.0, 1.0), 64)
    _, y = centres(screen)
    rising = sets_of(10 ** (-1.5 * y), screen).sharpness(0.2, 0.1)
    assert rising.value == pytest.approx(0.15, rel=1e-3) and rising.standard_error < 1e-12
    assert sets_of(10 ** (1.5 * y), screen).sharpness(0.2, 0.1).value == pytest.approx(-0.15, rel=1e-3)
    black = sets_of(np.where(y > 0, 0.0, 1.0), screen)
    assert black.sharpness(0.0, 0.1).value == pytest.approx(4.0)
    assert sets_of(np.zeros(screen.shape), screen).sharpness(0.0, 0.1) is None


def test_no_disc_fits_into_a_narrow_light():
    screen = Screen(0.0, (0.0, 10.0), (0.0, 10.0), 20)
    assert sets_of(np.ones(screen.shape), screen).ratios(6.0) is None


def test_without_light_on_the_lit_pixels_there_are_no_relative_values():
    """Light beside a picture, as by a poor lens and few rays, has a mean, but none relative to the lit pixels."""
    screen, light = Screen(0.0, (0.0, 10.0), (0.0, 10.0), 20), np.zeros((20, 20))
    light[0, 0] = 1.0
    found = LightSets.of(screen, [light, light], 0.5, target=np.fliplr(light))
    assert found.mean((5.0, 5.0), 1.0, relative=True) is None and found.ratios(1.0) is None
    assert found.mean((5.0, 5.0), 1.0).value == 0.0


def test_glare_of_a_lambertian_lamp():
    """I = cos γ / π of the flux."""
    gamma = np.arange(0.0, 91.0)
    table = Intensity("C", np.array([0.0, 90.0, 180.0, 270.0]), gamma, np.tile(7 * np.cos(np.radians(gamma)), (4, 1)))
    expected = [1000 / math.pi * math.cos(math.radians(angle)) for angle in (70, 80, 90)]
    found = glare(4 * [table])
    assert [each.value for each in found] == pytest.approx(expected, abs=0.05)
    assert [each.standard_error for each in found] == pytest.approx([0, 0, 0], abs=1e-9)


def test_glare_is_not_larger_by_noise():
    """Light of 100 cd everywhere with a noise of 10 cd in each cell, whose largest value would be about 109 cd."""
    chance, around, gamma = np.random.default_rng(3), np.arange(0.0, 360.0, 5.0), np.arange(0.0, 91.0)
    found = []
    for _ in range(16):
        tables = [Intensity("C", around, gamma, 100 + 10 * chance.standard_normal((72, 91))) for _ in range(8)]
        found += [(each.value * each_lumens, each.standard_error * each_lumens) for each in glare(tables)
                  for each_lumens in [tables[0].lumens / 1000]]  # fmt: skip
    value, error = np.mean(found, axis=0)
    assert value == pytest.approx(100.0, abs=2.0) and 2.0 < error < 5.0
