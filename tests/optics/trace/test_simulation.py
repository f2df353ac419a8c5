"""Simulation: a beam through a plate lands as the beam, with the flux of the source; the ledger: hard case 11."""

import math

import numpy as np
import pytest
import torch

from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers import irradiance
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.trace import clear_window, trace, window
from tests.lenses import lens_of, net, wavy
from tests.tracing import launch, simulated, stratified


def covered(screen, radius):
    """The area of each pixel inside x² + y² <= radius²: exact along x, on 400 lines a pixel; row 0 = y max."""
    (rows, columns), lines = screen.shape, 400
    x = np.linspace(*screen.x, columns + 1)
    height = (screen.y[1] - screen.y[0]) / rows / lines
    y = screen.y[1] - (np.arange(rows * lines) + 0.5) * height
    chord = np.sqrt(np.maximum(radius**2 - y**2, 0))
    inside = np.diff(np.clip(x, -chord[:, None], chord[:, None]), axis=1)
    return inside.reshape(rows, lines, columns).sum(1) * height


SCREEN = Screen(300.0, (-7.3, 6.1), (-6.9, 7.7), (24, 21))  # pixels in no ratio to the cells of the rays
DISC = CollimatedSource(Circle(6.5))
EXPECTED = torch.as_tensor(covered(SCREEN, 6.5) / (math.pi * 6.5**2))


def test_a_disc_beam_through_a_plate_lands_as_the_disc():
    """Pixel by pixel, in absolute flux: the beam is cut by two sides of the screen and fills whole pixels and parts."""
    result = simulated(DISC, lens_of(net(z=12.0), Plane(8.0)), SCREEN, 600, seed=0)
    assert float(EXPECTED.sum()) < 0.999  # some of it falls beside the screen
    assert float((result.box - EXPECTED).abs().max()) < 0.03 * float(EXPECTED.max())
    assert float(irradiance.rrmsd(result.box, EXPECTED)) < 8e-3
    assert result.flux["on target"] == pytest.approx(float(EXPECTED.sum()), abs=3e-4)
    assert irradiance.efficiency(result.flux) == pytest.approx(float(EXPECTED.sum()), abs=3e-4)


def test_flux_through_the_lens_is_the_sources():
    """A Lambertian point, a plane front: what crosses the square outline is the view factor of a centred square,
    (4 / π) X / sqrt(1 + X²) atan(X / sqrt(1 + X²)), X = half side over distance (each quarter a standard factor)."""
    lens = lens_of(net(z=22.0), Plane(15.0))
    result = simulated(PointSource(), lens, Screen(100.0, (-500.0, 500.0), (-500.0, 500.0), 8), 400, seed=0)
    ratio = 10.0 / 15.0
    slant = math.sqrt(1 + ratio**2)
    share = 4 / math.pi * ratio / slant * math.atan(ratio / slant)
    assert 1 - result.flux["missed the lens"] == pytest.approx(share, rel=1e-5)


@pytest.mark.parametrize("source", [PointSource(), DISC], ids=("point", "collimated"))
def test_the_clear_window_loses_no_light_that_gets_through(source):
    lens = lens_of(wavy(z=22.0, depth=3.0, half=10.0), index=1.6)
    whole, clear = window(source, lens), clear_window(source, lens)
    assert clear.width <= whole.width and clear.height <= whole.height
    all_rays = trace(launch(source, lens, 150, 0), lens, LevelPlane(100.0))
    x, y = (p.reshape(-1) for p in stratified(whole, 150, 0))
    lit = source.irradiance(x, y, 15.0) > 0
    beyond = (x[lit].abs() > clear.width / 2) | (y[lit].abs() > clear.height / 2)
    assert not (all_rays.alive & beyond).any()
