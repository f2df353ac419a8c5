"""Merit functions: zero for the perfect lens, exact pull outside, gradients against finite differences."""

from dataclasses import replace

import pytest
import torch

from bstcad.baselines.paper import TentMerit
from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen
from bstcad.optics.rays import Landed
from bstcad.optics.tubes import Tubes
from bstcad.tailoring.merit import TubeMerit

SCREEN = Screen(100.0, (0.0, 8.0), (0.0, 8.0), 8)
ONE = (Channel(None, 1.5),)


def landed(x, y, flux=None):
    flux = torch.full_like(x, 1 / x.numel()) if flux is None else flux
    return Landed(torch.stack([x, y]), flux, torch.zeros(x.shape, dtype=torch.uint8))


def test_a_perfect_lens_has_merit_zero_by_the_tent():
    """Even light in each pixel, brightness from pixel to pixel at random: rays on a fine grid, flux by the pixel."""
    target = torch.rand((8, 8), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    places = (torch.arange(8 * 64, dtype=torch.float64) + 0.5) / 64
    x, y = (p.reshape(-1) for p in torch.meshgrid(places, places, indexing="ij"))
    flux = target[(8 - y).floor().long().clamp(0, 7), x.floor().long()]
    merit, rrmsd = TentMerit.of(ONE, SCREEN, target, 0.03)((landed(x, y, flux / flux.sum()),))
    assert float(merit) < 1e-6 and float(rrmsd) < 1e-3  # a grid of 64 rays a pixel instead of even light


def sheet(n, seed=0, spread=0.0):
    """n x n tubes over the screen, their corners thrown about by `spread`."""
    random = torch.Generator().manual_seed(seed)
    edge = torch.linspace(0, 8, n + 1, dtype=torch.float64)
    x, y = torch.meshgrid(edge, edge, indexing="ij")
    position = torch.stack([x, y]) + spread * torch.randn((2, n + 1, n + 1), generator=random, dtype=torch.float64)
    status = torch.zeros((n + 1, n + 1), dtype=torch.uint8)
    return Landed(position, torch.ones((n + 1, n + 1)), status)


def test_tubes_that_fill_the_pixels_have_merit_zero():
    """Each pixel's light in 3 x 3 tubes of its own; and the RRMSD of a lens that is 10 % off in every second pixel."""
    target = torch.rand((8, 8), generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 0.1
    target /= target.sum()
    flux = target.flip(0).T.repeat_interleave(3, 0).repeat_interleave(3, 1) / 9  # x first, y upwards
    merit, rrmsd = TubeMerit(ONE, (Tubes(None, flux),), SCREEN, target, 0.03)((sheet(24),))
    assert float(merit) < 1e-24 and float(rrmsd) < 1e-12
    chequered = 1 + 0.1 * (-1.0) ** torch.stack(torch.meshgrid(torch.arange(8), torch.arange(8), indexing="ij")).sum(0)
    other = target * chequered / (target * chequered).sum()
    _, rrmsd = TubeMerit(ONE, (Tubes(None, flux),), SCREEN, other, 0.03)((sheet(24),))
    assert float(rrmsd) == pytest.approx(float((target - other).norm() / other.norm()), rel=1e-9)


def test_light_outside_is_pulled_by_its_distance_squared():
    target = torch.ones((8, 8), dtype=torch.float64)
    x, y = torch.tensor([4.0, 11.0], dtype=torch.float64), torch.tensor([4.0, 10.0], dtype=torch.float64)
    without, with_pull = (TentMerit.of(ONE, SCREEN, target, weight)((landed(x, y),))[0] for weight in (0.0, 0.1))
    assert float(with_pull - without) == pytest.approx(0.1 * (3**2 + 2**2) / 2, rel=1e-12)  # half of the flux, pixel²


def test_the_gradient_of_the_tents_is_that_of_finite_differences():
    random = torch.Generator().manual_seed(3)
    target = torch.rand((8, 8), generator=random, dtype=torch.float64)
    position = (torch.rand((2, 40), generator=random, dtype=torch.float64) * 12 - 2).requires_grad_()
    merit = TentMerit.of(ONE, SCREEN, target, 0.03)
    flux, status = torch.full((40,), 1 / 40, dtype=torch.float64), torch.zeros(40, dtype=torch.uint8)
    assert torch.autograd.gradcheck(lambda p: merit((Landed(p, flux, status),))[0], (position,), eps=1e-7, atol=1e-6)


def test_the_gradient_of_the_tubes_is_that_of_finite_differences():
    """Some of them folded, some beyond the border."""
    target = torch.rand((8, 8), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    corners = sheet(9, 1, 0.6)
    flux = torch.rand((9, 9), generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    merit = TubeMerit(ONE, (Tubes(None, flux),), SCREEN, target / target.sum(), 0.03)
    leaf = corners.position.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: merit((replace(corners, position=p),))[0], (leaf,), eps=1e-7, atol=1e-5)
