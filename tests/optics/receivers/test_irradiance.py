"""Binning: every unit of flux is where it should be; sums and the ledger: hard cases 9 and 11."""

import numpy as np
import pytest
import torch

from bstcad.optics.receivers import irradiance
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.rays import Landed, Status

SCREEN = Screen(1000.0, (10.0, 50.0), (-20.0, 0.0), (16, 10))  # pixels of 2.5 x 2 mm


def landed(x, y, flux=None, status=None):
    x, y = (torch.as_tensor(p, dtype=torch.float64) for p in (x, y))
    flux = torch.ones_like(x) if flux is None else torch.as_tensor(flux, dtype=torch.float64)
    status = torch.zeros(x.shape, dtype=torch.uint8) if status is None else torch.as_tensor(status, dtype=torch.uint8)
    return Landed(torch.stack([x, y]), flux, status)


def tent_plain(rays, screen):
    return irradiance.collect_plain(rays.position, irradiance.landed_flux(rays), screen)[0]


TENTS = pytest.mark.parametrize("tent", [irradiance.tent, tent_plain])
BINS = pytest.mark.parametrize("binning", [irradiance.tent, tent_plain, irradiance.box])


def centre(row, column, screen=SCREEN):
    """(x, y) of a pixel's centre: row 0 = y max, column 0 = x min."""
    dx, dy = (screen.x[1] - screen.x[0]) / screen.columns, (screen.y[1] - screen.y[0]) / screen.rows
    return screen.x[0] + (column + 0.5) * dx, screen.y[1] - (row + 0.5) * dy


def cloud(n, screen=SCREEN, margin=0.0, seed=0):
    """n rays of random flux over the screen, or `margin` of its size further (negative: closer)."""
    random = torch.Generator().manual_seed(seed)
    u, v, flux = torch.rand((3, n), generator=random, dtype=torch.float64)
    spread = [(a - margin * (b - a), b + margin * (b - a)) for a, b in (screen.x, screen.y)]
    x, y = (a + p * (b - a) for p, (a, b) in zip((u, v), spread, strict=True))
    return landed(x, y, flux)


@BINS
def test_a_ray_at_a_pixel_centre_is_in_that_pixel_alone(binning):
    image = binning(landed(*([c] for c in centre(3, 11))), SCREEN)
    assert image.dtype == torch.float64 and image.shape == SCREEN.shape == (10, 16)
    expected = torch.zeros(10, 16, dtype=torch.float64)
    expected[3, 11] = 1
    torch.testing.assert_close(image, expected, rtol=0, atol=1e-14)


@TENTS
def test_tent_shares_linearly_between_the_nearest_centres(tent):
    (x0, y0), (x1, y1) = centre(3, 11), centre(4, 12)
    for s, t in ((0.5, 0.0), (0.5, 0.5), (0.25, 0.75)):
        image = tent(landed([x0 + s * (x1 - x0)], [y0 + t * (y1 - y0)], [2.0]), SCREEN)
        shares = torch.tensor([[(1 - t) * (1 - s), (1 - t) * s], [t * (1 - s), t * s]], dtype=torch.float64)
        torch.testing.assert_close(image[3:5, 11:13], 2 * shares, rtol=0, atol=1e-14)
        assert float(image.sum()) == pytest.approx(2, abs=1e-14)


@TENTS
def test_tent_conserves_flux_and_centroid_of_interior_rays(tent):
    rays = cloud(5000, margin=-0.5 / 10)
    image = tent(rays, SCREEN)
    total = float(rays.flux.sum())
    assert float(image.sum()) == pytest.approx(total, rel=1e-12)
    column, row = SCREEN.pixel(*rays.position)
    i, j = (torch.arange(n, dtype=torch.float64) + 0.5 for n in SCREEN.shape)
    assert float((image.sum(0) * j).sum()) == pytest.approx(float((rays.flux * column).sum()), rel=1e-12)
    assert float((image.sum(1) * i).sum()) == pytest.approx(float((rays.flux * row).sum()), rel=1e-12)


def collect_plain(rays, screen):
    return irradiance.collect_plain(rays.position, irradiance.landed_flux(rays), screen)


@pytest.mark.parametrize("collect", [irradiance.collect, collect_plain])
@pytest.mark.parametrize("tailored", ["landing", "landing and flux"])
def test_gradients_of_picture_and_overshoot_are_finite_differences(tailored, collect):
    """Some rays beside the screen, some within half a pixel of its border, some lost."""
    small = Screen(1000.0, (10.0, 50.0), (-20.0, 0.0), (4, 3))
    rays = cloud(20, small, margin=0.2)
    status = torch.zeros(20, dtype=torch.uint8)
    status[7] = int(Status.VIGNETTED)

    def collected(position, flux=rays.flux):
        return collect(Landed(position, flux, status), small)

    inputs = (rays.position, rays.flux) if tailored == "landing and flux" else (rays.position,)
    assert torch.autograd.gradcheck(collected, tuple(p.clone().requires_grad_() for p in inputs))


@pytest.mark.parametrize("collect", [irradiance.collect, collect_plain])
def test_overshoot_is_the_squared_distance_from_the_border_in_pixels(collect):
    """Pixels of 2.5 x 2 mm: 5 mm beside the right border are 2, 5 mm above the upper border are 2.5."""
    x, y = [55.0, 30.0, 55.0, 30.0, 55.0], [-10.0, 5.0, 5.0, -10.0, 5.0]
    rays = landed(x, y, [1.0, 0.5, 0.25, 1.0, 1.0], [0, 0, 0, 0, 2])
    assert float(collect(rays, SCREEN)[1]) == pytest.approx(1 * 4 + 0.5 * 6.25 + 0.25 * 10.25, rel=1e-14)


def test_box_is_numpys_histogram():
    """Asymmetric on purpose: x and y, rows and columns, up and down cannot be confused."""
    rays = cloud(20_000, margin=0.1)
    x, y = (p.numpy() for p in rays.position)
    limits = [SCREEN.y, SCREEN.x]
    counted, _, _ = np.histogram2d(y, x, bins=(10, 16), range=limits, weights=rays.flux.numpy())
    np.testing.assert_allclose(irradiance.box(rays, SCREEN).numpy(), counted[::-1], rtol=1e-12)


def test_rrmsd_is_zero_for_equals_and_free_of_scale():
    target = torch.rand((16, 16), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    other = target.flip(0)
    assert float(irradiance.rrmsd(target, target)) == 0.0
    assert float(irradiance.rrmsd(3.7e-9 * target, target)) < 1e-14
    value = float(irradiance.rrmsd(other, target))
    assert float(irradiance.rrmsd(1e5 * other, target)) == pytest.approx(value, rel=1e-12)
    assert float(irradiance.rrmsd(other, 1e-7 * target)) == pytest.approx(value, rel=1e-12)


def test_rrmsd_of_a_picture_known_by_hand():
    """All light in one of two equal pixels: differences (1, -1) on a target (1, 1)."""
    target, one_sided = torch.tensor([[1.0, 1.0]]), torch.tensor([[5.0, 0.0]])
    assert float(irradiance.rrmsd(one_sided, target)) == pytest.approx(1.0, rel=1e-6)  # float32


class TestLeak:
    """Against pictures whose light in the dark is known."""

    def test_share_and_contrast_of_a_lit_half_over_an_even_background(self):
        target = np.zeros((8, 20))
        target[:, :5] = 3.0
        picture = np.where(target > 0, 9.0, 1.0)
        found = irradiance.leak(7.0 * picture, target)  # on any scale
        assert found.share == pytest.approx(15 / (5 * 9 + 15)) and found.contrast == pytest.approx(9.0)

    def test_a_picture_as_it_was_wanted_leaks_nothing(self):
        target = np.array([[0.0, 1.0], [0.5e-6, 2e-6]])  # of the brightest: dark is what wants up to a millionth
        assert irradiance.leak(target, target).share == pytest.approx(0.5e-6, rel=1e-3)
        assert irradiance.leak(np.where(target > 1e-6, target, 0.0), target) == irradiance.Leak(0.0, None)
        assert irradiance.leak(np.ones((2, 2)), np.array([[0.1, 1.0], [2e-6, 2e-6]])) is None
