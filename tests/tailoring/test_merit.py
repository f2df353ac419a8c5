"""Merit functions: zero for the perfect lens, exact pull outside, gradients against finite differences."""

import pytest
import torch

from bstcad.optics.irradiance import Screen
from bstcad.optics.rays import Landed
from bstcad.tailoring.merit import IrradianceMerit, as_seen_by_tent, landing

SCREEN = Screen(100.0, (0.0, 8.0), (0.0, 8.0), 8)


def landed(x, y, flux=None):
    flux = torch.full_like(x, 1 / x.numel()) if flux is None else flux
    return Landed(torch.stack([x, y]), flux, torch.zeros(x.shape, dtype=torch.uint8))


@pytest.mark.parametrize("subdivision", [1, 2, 4])
def test_a_perfect_lens_has_merit_zero(subdivision):
    """Even light in each pixel, brightness from pixel to pixel at random: rays on a fine grid, flux by the pixel."""
    target = torch.rand((8, 8), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    places = (torch.arange(8 * 64, dtype=torch.float64) + 0.5) / 64
    x, y = (p.reshape(-1) for p in torch.meshgrid(places, places, indexing="ij"))
    flux = target[(8 - y).floor().long().clamp(0, 7), x.floor().long()]
    merit, rrmsd = IrradianceMerit.of(SCREEN, target, 0.03, subdivision)(landed(x, y, flux / flux.sum()))
    assert float(merit) < 1e-6 and float(rrmsd) < 1e-3  # a grid of 64 rays a pixel instead of even light


def test_the_narrower_the_tents_the_sharper_the_picture():
    spot = torch.zeros((8, 8), dtype=torch.float64)
    spot[3, 4] = 1.0
    peaks = [float(as_seen_by_tent(spot, s)[3, 4]) for s in (1, 2, 4)]
    assert peaks == pytest.approx([(6 / 8) ** 2, (14 / 16) ** 2, (30 / 32) ** 2], rel=1e-12)


@pytest.mark.parametrize("subdivision", [1, 4])
def test_light_outside_is_pulled_by_its_distance_squared(subdivision):
    target = torch.ones((8, 8), dtype=torch.float64)
    x, y = torch.tensor([4.0, 11.0], dtype=torch.float64), torch.tensor([4.0, 10.0], dtype=torch.float64)
    without, with_pull = (
        IrradianceMerit.of(SCREEN, target, weight, subdivision)(landed(x, y))[0] for weight in (0.0, 0.1)
    )
    assert float(with_pull - without) == pytest.approx(0.1 * (3**2 + 2**2) / 2, rel=1e-12)  # half of the flux, pixel²


@pytest.mark.parametrize("subdivision", [1, 3])
def test_the_gradient_is_that_of_finite_differences(subdivision):
    random = torch.Generator().manual_seed(3)
    target = torch.rand((8, 8), generator=random, dtype=torch.float64)
    position = (torch.rand((2, 40), generator=random, dtype=torch.float64) * 12 - 2).requires_grad_()
    merit = IrradianceMerit.of(SCREEN, target, 0.03, subdivision)
    flux, status = torch.full((40,), 1 / 40, dtype=torch.float64), torch.zeros(40, dtype=torch.uint8)
    assert torch.autograd.gradcheck(lambda p: merit(Landed(p, flux, status))[0], (position,), eps=1e-7, atol=1e-6)


def test_landing_is_the_mean_squared_miss_of_the_rays_that_land():
    x, y = torch.tensor([1.0, 2.0, 50.0]), torch.tensor([1.0, 2.0, 50.0])
    rays = Landed(torch.stack([x, y]), torch.ones(3), torch.tensor([0, 0, 3], dtype=torch.uint8))
    aim = torch.tensor([[1.0, 2.0, 0.0], [4.0, 2.0, 0.0]])
    assert float(landing(rays, aim)) == pytest.approx(4.5)  # (3² + 0) / 2, the lost ray left out
