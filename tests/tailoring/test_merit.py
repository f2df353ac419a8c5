"""Merits: zero for the perfect lens, exact pull outside, right gradients; the variable of stage 2."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.rays import Landed
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.measure import RayTubes
from bstcad.optics.trace.tubes import Tubes
from bstcad.tailoring import merit
from bstcad.tailoring.baselines.paper import TentMerit
from bstcad.tailoring.merit import Landings, Merit, SobolevVariable, local_weight
from tests.lenses import net

SCREEN = Screen(100.0, (0.0, 8.0), (0.0, 8.0), 8)
ONE = (Channel(None, 1.5),)


def landed(x, y, flux=None):
    flux = torch.full_like(x, 1 / x.numel()) if flux is None else flux
    return Landed(torch.stack([x, y]), flux, torch.zeros(x.shape, dtype=torch.uint8))


def sheet(n, seed=0, spread=0.0):
    """n x n tubes over the screen, their corners thrown about by `spread`."""
    random = torch.Generator().manual_seed(seed)
    edge = torch.linspace(0, 8, n + 1, dtype=torch.float64)
    x, y = torch.meshgrid(edge, edge, indexing="ij")
    position = torch.stack([x, y]) + spread * torch.randn((2, n + 1, n + 1), generator=random, dtype=torch.float64)
    status = torch.zeros((n + 1, n + 1), dtype=torch.uint8)
    return Landed(position, torch.ones((n + 1, n + 1)), status)


def of_tubes(flux, target, corners):
    """(merit, RRMSD) of one sheet of tubes whose corners have landed."""
    goals = (Goal("target", SCREEN, target.numpy()),)
    return Merit(RayTubes(ONE, (Tubes(None, flux),)), goals, 0.03)(Landings(((corners,),)))


def test_tubes_that_fill_the_pixels_have_merit_zero():
    """Each pixel's light in 3 x 3 tubes of its own; and the RRMSD of a lens that is 10 % off in every second pixel."""
    target = torch.rand((8, 8), generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 0.1
    target /= target.sum()
    flux = target.flip(0).T.repeat_interleave(3, 0).repeat_interleave(3, 1) / 9  # x first, y upwards
    merit, rrmsd = of_tubes(flux, target, sheet(24))
    assert float(merit) < 1e-24 and float(rrmsd) < 1e-12
    chequered = 1 + 0.1 * (-1.0) ** torch.stack(torch.meshgrid(torch.arange(8), torch.arange(8), indexing="ij")).sum(0)
    other = target * chequered / (target * chequered).sum()
    _, rrmsd = of_tubes(flux, other, sheet(24))
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
    leaf = corners.position.clone().requires_grad_()

    def merit(position):
        return of_tubes(flux, target, replace(corners, position=position))[0]

    assert torch.autograd.gradcheck(merit, (leaf,), eps=1e-7, atol=1e-5)


# --- the variable of stage 2 ------------------------------------------------------------------------------------------


M = 33
FLAT = net(m=M, half=8.0)


def noise(seed, m=M):
    return torch.randn((m, m), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def variable(seed=0):
    return SobolevVariable.of(FLAT, noise(seed).exp())


def test_the_piston_stays():
    """Light does not feel it."""
    assert abs(float(variable().heights(noise(3)).mean())) < 1e-14


@pytest.mark.parametrize(("i", "j"), [(1, 0), (3, 5), (32, 32)])
def test_a_mode_is_scaled_by_its_laplacian(i, j):
    u = math.pi * (torch.arange(M, dtype=torch.float64) + 0.5) / M
    mode = torch.cos(i * u)[:, None] * torch.cos(j * u)
    even = SobolevVariable.of(FLAT, torch.ones((M, M), dtype=torch.float64))
    energy = 4 - 2 * math.cos(math.pi * i / M) - 2 * math.cos(math.pi * j / M)
    torch.testing.assert_close(even.heights(mode), 0.5 * energy**-merit.LAPLACIAN_POWER * mode, rtol=0, atol=1e-12)


def test_waves_of_four_control_points_and_shorter_have_nearly_one_scale():
    """Long waves keep the power of the Laplacian; the scale of the shortest ones is at most 2^-1/4 times λ_0^-q."""
    of_waves, level = (
        SobolevVariable.of(FLAT, torch.ones((M, M)), level=merit.FOUR_POINTS).scale / 0.5,
        merit.FOUR_POINTS,
    )
    energy = merit.laplacian(M)
    torch.testing.assert_close(of_waves[1:4, 0], energy[1:4] ** -merit.LAPLACIAN_POWER, rtol=1e-3, atol=0)
    shortest = of_waves[(energy[:, None] + energy) > level]
    assert 1.0 <= float(shortest.max() / level**-merit.LAPLACIAN_POWER) <= 2**0.25
    assert float(shortest.min() / level**-merit.LAPLACIAN_POWER) > 1.0
    assert of_waves[0, 0] == 0.0


def test_steps_are_longer_where_the_picture_is_dark():
    """A flat lens and a beam on axis: control points lie over their own part of the picture; the ninth part of the
    irradiance makes steps three times as long."""
    lens = Lens.between(Plane(10.0), FLAT, Rectangle(16.0, 16.0), 1.5)
    picture = np.where(np.arange(64) < 32, 0.2, 1.8) * np.ones((48, 1))
    screen = Screen(100.0, (-8.0, 8.0), (-8.0, 8.0), (64, 48))
    weight = local_weight(CollimatedSource(Rectangle(16.0, 16.0)), lens, [Goal("target", screen, picture)])
    dark, bright = weight[4:12, 4:-4], weight[-12:-4, 4:-4]  # x along the first axis
    assert float(bright.mean()) == pytest.approx(1.8**-0.5, rel=5e-3)
    assert float(dark.mean()) == pytest.approx(0.2**-0.5, rel=5e-3)


def test_black_and_unlit_parts_have_a_bounded_weight():
    lens = Lens.between(Plane(10.0), FLAT, Rectangle(16.0, 16.0), 1.5)
    picture = np.zeros((64, 64))
    picture[10, 10] = 1.0
    goal = Goal("target", Screen(100.0, (-8.0, 0.0), (-8.0, 8.0), 64), picture)
    weight = local_weight(CollimatedSource(Rectangle(16.0, 16.0)), lens, [goal])
    assert float(weight.max()) == merit.MAX_LOCAL_WEIGHT and float(weight.min()) >= 1 / merit.MAX_LOCAL_WEIGHT
    assert float(weight[-8:].mean()) == pytest.approx(1.0, abs=1e-6)  # what lands beside the screen


def test_the_cosine_transform_by_products_is_that_by_scipy():
    """The form that other devices take."""
    c, t = merit._matrix(33), noise(4)
    torch.testing.assert_close(c @ t @ c.T, merit.cosine(t), rtol=0, atol=1e-13)
    torch.testing.assert_close(c.T @ t @ c, merit.inverse_cosine(t), rtol=0, atol=1e-13)
