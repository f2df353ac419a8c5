"""Rays behind a lens carry the ledger's flux, and make the picture where they land."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bstcad.analysis.leaving_rays import rays_behind
from bstcad.optics.lens.losses import FresnelLoss, Losses
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen, leaving
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.measure import simulated
from tests.lenses import lens_of, wavy

LENS = lens_of(wavy(), Plane(12.0), Circle(9.0), 1.5)
SCREEN = Screen(200.0, (-150.0, 150.0), (-150.0, 150.0), pixels=12)
CHANNELS = (
    Channel(PointSource((0.0, 0.0, 0.0)), 1.5, 0.7),
    Channel(PointSource((1.0, -2.0, 0.0), wavelength=450.0), 1.52, 0.3),
)


@pytest.fixture(scope="module")
def light():
    [light] = simulated(LENS, CHANNELS, [SCREEN], 512, seed=5)
    return light


@pytest.mark.parametrize("count", [300, 40_000])
def test_the_flux_is_the_ledger_s_and_the_count_is_the_wanted_one(light, count):
    found = rays_behind(LENS, CHANNELS, count, seed=1, lumens=800.0)
    assert [len(part) for part in (found.position, found.direction, found.power, found.wavelength)] == [count] * 4
    assert found.unit == "lm" and found.flux == pytest.approx(800 * leaving(light.flux), rel=3 / np.sqrt(count))
    assert found.power[found.wavelength == 450.0].sum() / found.flux == pytest.approx(0.3, abs=0.03)
    assert np.abs(np.linalg.norm(found.direction, axis=1) - 1).max() < 1e-6  # float32


def test_rays_carried_on_to_the_target_make_its_picture(light):
    """The picture by 200 000 rays of the file differs from that of a simulation by their noise."""
    found = rays_behind(LENS, CHANNELS, 200_000, seed=2)
    on = found.position + found.direction * ((200.0 - found.position[:, 2]) / found.direction[:, 2])[:, None]
    edges = np.linspace(-150, 150, 13)
    picture = np.histogram2d(-on[:, 1], on[:, 0], [edges, edges], weights=found.power)[0]
    expected = light.box.numpy()
    assert np.sqrt(((picture - expected) ** 2).sum() / (expected**2).sum()) < 0.01
    assert np.sqrt(((picture[::-1] - expected) ** 2).sum() / (expected**2).sum()) > 0.05


def test_losses_at_faces_are_taken_from_the_rays():
    bare = rays_behind(LENS, CHANNELS, 20_000).flux
    lossy = tuple(replace(c, losses=Losses(FresnelLoss(c.source.main_wavelength))) for c in CHANNELS)
    [light] = simulated(LENS, lossy, [SCREEN], 256, seed=5)
    found = rays_behind(LENS, lossy, 20_000).flux
    assert found == pytest.approx(leaving(light.flux), rel=0.01)
    assert 0.85 < found / bare < 0.93
