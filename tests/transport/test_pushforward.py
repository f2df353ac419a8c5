"""A pushforward neither loses mass nor leaves holes."""

import numpy as np
import pytest

from bstcad.transport.legendre import half_square, legendre
from bstcad.transport.pushforward import pushforward


@pytest.mark.parametrize("roughness", [0.0, 0.5, 20.0])
def test_mass_is_conserved(roughness):
    rng = np.random.default_rng(0)
    rho = rng.random((48, 48))
    u = legendre(half_square(48) - roughness * rng.normal(size=(48, 48)).cumsum(axis=1))
    moved = pushforward(rho, u)
    assert moved.sum() == pytest.approx(rho.sum(), rel=1e-12)
    assert moved.min() >= 0.0


def test_the_identity_moves_nothing():
    rho = np.random.default_rng(1).random((32, 32))
    np.testing.assert_allclose(pushforward(rho, half_square(32)), rho, atol=1e-12)


def test_a_shift_by_whole_cells():
    rho = np.zeros((32, 32))
    rho[8:12, 10:20] = np.random.default_rng(2).random((4, 10))
    q = np.arange(32) + 0.5
    u = half_square(32) + 5.0 * q[:, None] - 3.0 * q[None, :]
    np.testing.assert_allclose(pushforward(rho, u), np.roll(rho, (5, -3), axis=(0, 1)), atol=1e-12)


def test_stretched_cells_leave_no_holes():
    """A patch of 4 x 4 cells blown up eight times each way is even on 32 x 32."""
    rho = np.zeros((64, 64))
    rho[30:34, 30:34] = 1.0
    q = 8.0 * 0.5 * (np.arange(64) + 0.5 - 32) ** 2 + 32.0 * (np.arange(64) + 0.5)
    moved = pushforward(rho, q[:, None] + q[None, :])
    np.testing.assert_allclose(moved[16:48, 16:48], 1.0 / 64, rtol=1e-9)
    assert moved.sum() == pytest.approx(16.0, rel=1e-12)
