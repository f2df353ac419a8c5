"""Cells of the control net over pixels, of a plate that throws its net straight on the screen."""

import numpy as np
import pytest
import torch

from bstcad.analysis.control_cells import TILE, control_cells
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.sources import Collimated
from bstcad.optics.surfaces import Plane

SCREEN = Screen(100.0, (-8.0, 8.0), (-8.0, 8.0), 64)
BEAM = Channel(Collimated(Rectangle(16.0, 16.0)), 1.5)


def plate(points):
    """Between two planes: the light goes straight on.  Its net is as wide as the beam."""
    heights = torch.zeros((points, points), dtype=torch.float64)
    return Lens(Plane(5.0), BSplineSurface(9.0, heights, (-8.0, 8.0), (-8.0, 8.0)), Rectangle(16.0, 16.0), 1.5)


def cells(points, target):
    return control_cells(BEAM, plate(points), SCREEN, target)


def test_all_cells_are_counted_and_lie_evenly():
    found = cells(33, np.ones((64, 64)))
    assert found.a_pixel.sum() == pytest.approx(32**2, rel=1e-6)
    np.testing.assert_allclose(found.a_pixel, 32**2 / 64**2, rtol=1e-6)
    assert found.median == pytest.approx(found.scarce) == pytest.approx(0.25)


def test_an_even_target_needs_one_cell_a_tile():
    assert cells(5, np.ones((64, 64))).floor(1.01) == 0.0  # as many cells as tiles, to rounding


def test_enough_cells_leave_nothing():
    noise = np.random.default_rng(0).random((64, 64))
    assert cells(65, noise).floor(1.01) == 0.0
    assert cells(33, noise).floor(2.02) == 0.0


def test_a_wave_needs_the_cells_that_its_cosine_takes():
    """A quarter of the cosines, those of up to 2√(64 / π) = 9.03 half waves a tile."""
    x = (np.arange(64) + 0.5) / TILE * np.pi
    floors = [cells(33, np.tile(1 + 0.5 * np.cos(k * x), (64, 1))).floor() for k in (8, 10)]
    size = 0.5**0.5 * 0.5 / (1 + 0.125) ** 0.5
    assert floors == pytest.approx([0.0, size], abs=1e-6)


def test_more_cells_leave_less():
    noise = np.random.default_rng(0).random((50, 70))
    found = control_cells(BEAM, plate(33), Screen(100.0, (-8.0, 8.0), (-8.0, 8.0), (70, 50)), noise)
    floors = [found.floor(finer) for finer in (0.2, 0.5, 1.0, 1.5)]
    assert floors == sorted(floors, reverse=True) and 0 < floors[-1] < floors[0] < 1
