"""Channels: an extended source of many lines as simple ones, and what light means that is a sum of them."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bstcad.optics.light.channels import Channel, channels_of, drawn_channels, merge_wavelengths, source_numbers
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.sampling import shifted_lattice

LINES = ((486.1, 1.0), (587.6, 2.0), (656.3, 1.0))
DISC = PointSource((1.0, -2.0, 3.0), profile="uniform", half_angle=40.0, diameter=2.0)
SUN = CollimatedSource(Circle(8.0), divergence=0.53)
ANGLES = np.linspace(0, np.pi, 30)
CUTS = np.linspace(-0.98, 0.98, 99)


def index(wavelength):
    return 1.5 + 3000 / wavelength**2


def positions(channels):
    return np.array([c.source.position for c in channels])


@pytest.mark.parametrize("source", [DISC, SUN, replace(DISC, wavelength=LINES)], ids=str)
def test_weights_sum_to_one_and_channels_are_simple(source):
    channels = channels_of(source, index, 24)
    assert len(channels) == 24
    assert math.fsum(c.weight for c in channels) == pytest.approx(1, abs=1e-15)
    for channel in channels:
        assert channel.source.extent is None and channel.source == channel.source.central
        assert channel.index == index(channel.source.wavelength)


@pytest.mark.parametrize("source", [PointSource(), CollimatedSource(Circle(8.0), z=-3.0)], ids=str)
def test_a_simple_source_is_one_channel_with_itself(source):
    [channel] = channels_of(source, index, 24)
    assert channel.source is source and channel.weight == 1.0


@pytest.mark.parametrize("tilt", [None, (20.0, -35.0)], ids=str)
@pytest.mark.parametrize("count", [2, 8, 9, 32, 128])
def test_points_of_a_disc_fill_it_evenly_about_its_middle(count, tilt):
    """Mean and, from four points on, spread R²/4 along x and y to rounding; all across the axis and inside."""
    source = replace(DISC, tilt=tilt)
    found = positions(channels_of(source, index, count)) - source.position
    np.testing.assert_allclose(found.mean(0), 0, atol=1e-15)
    e_x, e_y, n = np.array(source.axes)
    np.testing.assert_allclose(found @ n, 0, atol=1e-15)
    assert (np.hypot(found @ e_x, found @ e_y) <= 1 + 1e-12).all()
    if count >= 4:
        assert [np.mean((found @ e) ** 2) for e in (e_x, e_y)] == pytest.approx([0.25, 0.25], rel=1e-12)
        assert abs(np.mean((found @ e_x) * (found @ e_y))) < 1e-15
    across = (found @ e_x)[:, None] * np.cos(ANGLES) + (found @ e_y)[:, None] * np.sin(ANGLES)
    share = (across[..., None] < CUTS).mean(0)  # of the points beyond a line across the disc
    exact = 0.5 + (CUTS * np.sqrt(1 - CUTS**2) + np.arcsin(CUTS)) / np.pi
    assert np.sqrt(np.mean((share - exact) ** 2)) < 0.38 * count**-0.8  # random points: 0.41 / sqrt(count)


def test_points_of_a_rectangle_fill_it():
    found = positions(channels_of(replace(DISC, diameter=None, width=3.0, height=1.0), index, 64)) - DISC.position
    assert (np.abs(found) <= (1.51, 0.51, 0)).all() and found.max(0)[0] > 1.3 and found.max(0)[1] > 0.43
    np.testing.assert_allclose((found**2).mean(0), (9 / 12, 1 / 12, 0), rtol=1e-12)


@pytest.mark.parametrize("tilt", [None, (10.0, 60.0)], ids=str)
def test_directions_of_a_cone_carry_the_flux_of_one_radiance(tilt):
    """Mean of d over flux, ∫ d cos dω / ∫ cos dω over the cone by quadrature, cos to the normal of the aperture."""
    source = replace(SUN, divergence=30.0, tilt=tilt)
    found = np.array([c.source.axes[2] for c in channels_of(source, index, 2048)])
    e_x, e_y, n = np.array(source.axes)
    assert (found @ n >= math.cos(math.radians(15)) - 1e-12).all()
    u, w = np.polynomial.legendre.leggauss(40)
    c = np.cos(np.radians(15))
    cos = (1 + c) / 2 + (1 - c) / 2 * u[:, None, None]
    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)[:, None]
    d = cos * n + np.sqrt(1 - cos**2) * (np.cos(turn) * e_x + np.sin(turn) * e_y)
    flux = w[:, None] * d[..., 2]
    wanted = (flux[..., None] * d).sum((0, 1)) / flux.sum()
    np.testing.assert_allclose(found.mean(0), wanted, atol=2e-4)


@pytest.mark.parametrize("turn", [None, 35.0])
def test_directions_of_two_divergences_fill_an_ellipse_evenly(turn):
    """Second moments of an even ellipse, sin² α / 4 along its axes and 0 between them; a quarter of it, a quarter."""
    source = replace(SUN, divergence=(6.0, 2.0), rotate=turn)
    wide = np.sin(np.radians([3.0, 1.0]))
    cos, sin = np.cos(np.radians(turn or 0.0)), np.sin(np.radians(turn or 0.0))
    own = np.array([[cos, sin], [-sin, cos]])  # rows: axes of the ellipse
    for channels in (channels_of(source, index, 512), drawn_channels(source, index, 512, 3)):
        found = np.array([c.source.axes[2][:2] for c in channels]) @ own.T / wide
        assert (np.hypot(*found.T) <= 1 + 1e-6).all()
        np.testing.assert_allclose(found.T @ found / len(found), np.eye(2) / 4, atol=4e-3)
        assert np.mean(np.hypot(*found.T) < 0.5) == pytest.approx(0.25, abs=0.01)
    assert source.half_angles == (3.0, 1.0) and not source.is_rotation_invariant and source.can_rotate


@pytest.mark.parametrize("tilt", [None, (10.0, 60.0)], ids=str)
def test_two_equal_divergences_are_one_to_the_last_bit(tilt):
    one = replace(SUN, divergence=3.0, tilt=tilt, profile="gaussian", radius_1e2=(4.0, 2.0), rotate=20.0)
    pair = replace(one, divergence=(3.0, 3.0))
    assert channels_of(one, index, 64) == channels_of(pair, index, 64)
    assert drawn_channels(one, index, 64, 5) == drawn_channels(pair, index, 64, 5)
    assert channels_of(one.scaled(0.4), index, 64) == channels_of(pair.scaled(0.4), index, 64)
    assert replace(one, divergence=(0.0, 0.0)).extent is None


def test_each_line_has_its_share_of_points_in_pairs():
    channels = channels_of(replace(DISC, wavelength=LINES), index, 32)
    by_line = {nm: [c for c in channels if c.source.wavelength == nm] for nm, _ in LINES}
    assert {nm: len(line) for nm, line in by_line.items()} == {486.1: 8, 587.6: 16, 656.3: 8}
    for nm, weight in LINES:
        assert math.fsum(c.weight for c in by_line[nm]) == pytest.approx(weight / 4, abs=1e-15)
        away = positions(by_line[nm]) - DISC.position
        np.testing.assert_array_almost_equal(away[::2], -away[1::2], decimal=15)
    assert len({c.source.position for c in channels}) == 32  # no point twice


def test_lines_that_nothing_tells_apart_are_one_channel():
    alike = merge_wavelengths(channels_of(PointSource(wavelength=LINES), lambda nm: 1.0, 8))
    assert len(alike) == 1 and alike[0].weight == 1.0 and alike[0].source == PointSource(wavelength=587.6)
    apart = channels_of(PointSource(wavelength=LINES), index, 8)
    assert merge_wavelengths(apart) == apart


@pytest.mark.parametrize("source", [DISC, SUN, replace(DISC, diameter=None, width=2.0, height=0.5)], ids=str)
def test_drawn_points_are_spread_evenly_from_seed_to_seed(source):
    """One point a draw: over 2000 draws its mean is the middle, its second moments those of the extent (to 4 sigma)."""
    drawn = np.array([shifted_lattice(source.extent, 1, seed)[0] for seed in range(2000)]) / source.extent.half_extent
    moment = 1 / 4 if isinstance(source.extent, Circle) else 1 / 3
    assert np.abs(drawn.mean(0)).max() < 4 * math.sqrt(moment / 2000)
    np.testing.assert_allclose((drawn[:, :, None] * drawn[:, None, :]).mean(0), moment * np.eye(2), atol=0.03)
    assert len(set(shifted_lattice(source.extent, 64, 1)) | set(shifted_lattice(source.extent, 64, 2))) == 128


def test_places_are_counted_line_by_line():
    channels = channels_of(replace(DISC, wavelength=LINES), index, 16)
    assert sorted(source_numbers(channels)) == sorted([*range(8), *range(4), *range(4)])
    assert source_numbers([Channel(PointSource(), 1.5, 0.5)] * 2) == (0, 0)
    assert source_numbers(channels_of(PointSource(wavelength=LINES), index, 8)) == (0, 0, 0)
