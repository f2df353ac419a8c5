"""Wanted wavefronts: Zernike's polynomials against Noll's table, and rays that are the gradient of the eikonal."""

import math

import numpy as np
import pytest
import torch

from bstcad.optics.light.wavefront import PlaneWave, SphericalWave, ZernikeWave, path_from_sphere
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.zernike import noll, series

NM = 632.8
COEFFICIENTS = (0.3, -2.0, 1.1, 0.7, -0.4, 0.9, 0.2, -0.8, 0.5, 0.1, -0.3, 0.6)
WAVES = [
    PlaneWave(40.0, (0.1, -0.2, 0.9)),
    SphericalWave((3.0, -1.0, 240.0), 40.0),
    SphericalWave((3.0, -1.0, -60.0), 40.0),
    ZernikeWave(COEFFICIENTS, 9.0, 40.0, centre=(0.5, -1.0)),
]
each_wave = pytest.mark.parametrize("wave", WAVES, ids=lambda wave: wave.kind)


def one(j):
    return [0.0] * (j - 1) + [1.0]


def places(n=12, side=10.0):
    return sampling.grid(Rectangle(side, side), n)


def eikonal(wave, x, y):
    return wave.path(x, y, NM)


# Zernike's polynomials


def test_nolls_order():
    """Noll 1976, Table I: n, m and whether it is a cosine (m > 0)."""
    table = [(0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1), (3, 1), (3, -3), (3, 3), (4, 0), (4, 2)]
    assert [noll(j) for j in range(1, 13)] == table
    assert len({noll(j) for j in range(1, 232)}) == 231 and noll(231)[0] == 20


def test_low_orders_in_closed_form():
    """Noll 1976, Table I."""
    x, y = places(side=1.9)
    r2, r = x * x + y * y, torch.hypot(x, y)
    turn = torch.atan2(y, x)
    for j, wanted in {
        1: torch.ones_like(x), 2: 2 * x, 3: 2 * y, 4: math.sqrt(3) * (2 * r2 - 1), 5: math.sqrt(6) * 2 * x * y,
        7: math.sqrt(8) * (3 * r2 - 2) * y, 11: math.sqrt(5) * (6 * r2**2 - 6 * r2 + 1),
        12: math.sqrt(10) * (4 * r2 - 3) * (x * x - y * y), 20: math.sqrt(12) * r**5 * torch.cos(5 * turn),
        21: math.sqrt(12) * r**5 * torch.sin(5 * turn),
    }.items():  # fmt: skip
        torch.testing.assert_close(series(one(j), x, y)[0], wanted, rtol=0, atol=1e-12)


def test_orthonormal_on_the_disc():
    """∫ Z_i Z_j / π = δ_ij, by Gauss's quadrature in r² and an even one in the angle: exact to this degree."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    r, turn = torch.from_numpy(np.sqrt((nodes + 1) / 2)), torch.arange(40, dtype=torch.float64) * (2 * math.pi / 40)
    x, y = r[:, None] * torch.cos(turn), r[:, None] * torch.sin(turn)
    terms = torch.stack([series(one(j), x, y)[0] for j in range(1, 56)])
    gram = torch.einsum("iab,jab,a->ij", terms, terms, torch.from_numpy(weights / 2)) / 40
    torch.testing.assert_close(gram, torch.eye(55, dtype=torch.float64), rtol=0, atol=1e-12)


def test_high_orders_keep_their_digits():
    """Values on the rim are known: R_n^m(1) = 1, and Z_231 = sqrt(21) R_20^0 or sqrt(42) cos or sin."""
    turn = torch.tensor([0.0, 0.3, 2.0], dtype=torch.float64)
    n, m = noll(231)
    wanted = math.sqrt(2 * (n + 1)) * (torch.cos(m * turn) if m > 0 else torch.sin(-m * turn))
    torch.testing.assert_close(series(one(231), torch.cos(turn), torch.sin(turn))[0], wanted, rtol=0, atol=1e-10)


@pytest.mark.parametrize("j", [2, 4, 8, 12, 25, 60])
def test_slopes_are_those_of_differences(j):
    x, y = places(side=1.3)
    step = 1e-5
    _, z_x, z_y = series(one(j), x, y)
    by_x = (series(one(j), x + step, y)[0] - series(one(j), x - step, y)[0]) / (2 * step)
    by_y = (series(one(j), x, y + step)[0] - series(one(j), x, y - step)[0]) / (2 * step)
    torch.testing.assert_close(torch.stack([z_x, z_y]), torch.stack([by_x, by_y]), rtol=0, atol=1e-6)


# rays


@each_wave
def test_rays_are_the_gradient_of_the_eikonal(wave):
    (x, y), step = places(), 1e-4
    d_x, d_y, d_z = wave.directions(x, y, NM)
    by_x = (eikonal(wave, x + step, y) - eikonal(wave, x - step, y)) / (2 * step)
    by_y = (eikonal(wave, x, y + step) - eikonal(wave, x, y - step)) / (2 * step)
    torch.testing.assert_close(torch.stack([d_x, d_y]), torch.stack([by_x, by_y]), rtol=0, atol=1e-10)
    torch.testing.assert_close(d_x**2 + d_y**2 + d_z**2, torch.ones_like(x), rtol=0, atol=1e-14)
    assert (d_z > 0).all()


@each_wave
def test_directions_have_gradients(wave):
    x, y = (p.clone().requires_grad_() for p in places(2, 5.0))
    assert torch.autograd.gradcheck(lambda x, y: wave.directions(x, y, NM) + 0 * x, (x, y))


def test_a_diverging_wave_lags_behind_at_its_rim_and_a_converging_one_runs_ahead():
    """Positive W: a longer path.  Noll 4, 2 ρ² - 1, diverges for c > 0, as light from a point does."""
    x = torch.tensor([0.0, 5.0], dtype=torch.float64)
    for wave, outwards in (
        (SphericalWave((0.0, 0.0, -100.0), 0.0), True), (SphericalWave((0.0, 0.0, 100.0), 0.0), False),
        (ZernikeWave((0.0, 0.0, 0.0, 3.0), 10.0, 0.0), True), (ZernikeWave((0.0, 0.0, 0.0, -3.0), 10.0, 0.0), False),
    ):  # fmt: skip
        at_axis, at_rim = wave.path(x, 0 * x, NM)
        assert (at_rim > at_axis) == outwards and (wave.directions(x, 0 * x, NM)[0, 1] > 0) == outwards


def test_a_sphere_leads_through_its_focus():
    x, y = places()
    for wave in WAVES[1:3]:
        direction = wave.directions(x, y, NM)
        path = (wave.focus[2] - wave.z) / direction[2]
        torch.testing.assert_close(x + path * direction[0], torch.full_like(x, wave.focus[0]), rtol=0, atol=1e-11)
        torch.testing.assert_close(y + path * direction[1], torch.full_like(y, wave.focus[1]), rtol=0, atol=1e-11)


def test_a_path_from_far_off_keeps_its_digits():
    """A sphere of 1e8 mm is r² / 2 R deep; the next term is 1e-18 mm."""
    x, y = places()
    far = path_from_sphere(torch.stack([x, y, torch.zeros_like(x)]), (0.0, 0.0, -1e8))
    torch.testing.assert_close(far, (x * x + y * y) / 2e8, rtol=1e-13, atol=0)


def test_a_zernike_wave_is_stated_on_its_circle_and_its_waves_are_rms():
    wave = ZernikeWave((0.0, 0.0, 0.0, 0.5, 1.2), 9.0, 40.0, centre=(2.0, 0.0))
    x, y = places(400, 24.0)
    inside = wave.contains(x, y)
    assert float(inside.double().mean()) * 24.0**2 == pytest.approx(math.pi * 81, rel=1e-3)
    rms = float((wave.path(x, y, NM)[inside] / (NM * 1e-6)).square().mean().sqrt())
    assert rms == pytest.approx(1.3, rel=1e-3)  # hypot(0.5, 1.2)
    tilt = ZernikeWave((0.0, 3.0), 9.0, 40.0)
    assert tilt.steepest(NM) == pytest.approx(2 * 3.0 * NM * 1e-6 / 9.0)
    assert ZernikeWave((0.0, 0.0), 9.0, 40.0).steepest(NM) == 0.0


def test_a_wave_is_as_steep_wherever_its_circle_lies():
    middle, *others = (ZernikeWave(COEFFICIENTS, 9.0, 40.0, at).steepest(NM) for at in [(0, 0), (2.0, 0), (0, 4.0)])
    assert others == pytest.approx([middle, middle], rel=1e-12)
