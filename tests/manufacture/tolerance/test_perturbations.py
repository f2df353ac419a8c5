"""Errors change the light as physics says; an error that moves everything changes nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.manufacture.tolerance.perturbations import (
    Setup,
    as_net,
    form_error,
    inside_outline,
    kinds,
    random_field,
    ripple,
)
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from tests.lenses import net

TUBES = 257


def plate_of(m):
    """A plate of 24 x 24 x 12 mm."""
    return Lens.between(Plane(8.0), net(m=m, half=12.0), Rectangle(24.0, 24.0), 1.5)


@pytest.fixture(scope="module")
def picture(setup):
    return setup.picture(TUBES)


@pytest.mark.parametrize(
    "motion",
    [Motion.of(shift=(0.2, -0.1, 0.3)), Motion.of(turn=(0.5, -0.3, 7.0), about=(0.1, 0.2, 20.0))],
    ids=["shift", "turn"],
)
def test_what_moves_everything_changes_nothing(setup, picture, motion):
    moved = setup.moved("lens", motion).moved("source", motion).moved("screen", motion)
    back = setup.moved("source", motion).moved("screen", motion).moved("lens", motion)
    for each in (moved, back):
        assert np.abs(each.picture(TUBES) - picture).max() < 1e-6 * picture.max()


def test_what_scales_everything_changes_nothing(setup, picture):
    factor, (_, _, about) = 1.1, setup.pivot("lens")

    def grown(p):
        return tuple(a + factor * (q - a) for q, a in zip(p, (0.0, 0.0, about), strict=True))

    larger = setup.with_lens_scaled(factor).with_sources(lambda s: replace(s, position=grown(s.position)))
    screen = setup.screen
    sides = {side: tuple(factor * end for end in getattr(screen, side)) for side in ("x", "y")}
    larger = replace(larger, screen=replace(screen, z=grown(screen.middle)[2], **sides))
    assert np.abs(larger.picture(TUBES) - picture).max() < 1e-6 * picture.max()


def test_a_plate_that_is_tilted_shifts_a_beam_as_snell_says():
    """A plate of thickness t shifts the beam by t sin θ (1 - cos θ / (n cos θ'))."""
    plate, screen = plate_of(33), Screen(100.0, (-8.0, 8.0), (-8.0, 8.0), (64, 64))
    setup = Setup(plate, (Channel(CollimatedSource(Circle(4.0), z=0.0), plate.index),), screen)
    theta, n = np.radians(5.0), plate.index
    wanted = 12.0 * np.sin(theta) * (1 - np.cos(theta) / (n * np.sqrt(1 - (np.sin(theta) / n) ** 2)))
    tilted = kinds(setup)["lens.tilt_x"].apply(setup, 5.0).picture(TUBES)
    y = 8.0 - (np.arange(64) + 0.5) / 4
    found = float((tilted.sum(1) * y).sum() / tilted.sum())
    assert abs(found) == pytest.approx(wanted, rel=5e-3)


def test_a_random_field_is_as_rough_and_as_wide_as_it_says():
    lens = plate_of(129)
    where = inside_outline(lens.outline, lens.back)
    length = 12 * lens.back.pitch[0]
    fields = [random_field(lens.back, length, seed, where) for seed in range(12)]
    assert all(np.sqrt(np.mean(f[where] ** 2)) == pytest.approx(1.0) and abs(f[where].mean()) < 1e-12 for f in fields)
    lag = [np.mean([np.mean(f[k:] * f[: len(f) - k]) for f in fields]) for k in (0, 6, 12)]
    assert lag[1] / lag[0] == pytest.approx(np.exp(-0.25), abs=0.08)
    assert lag[2] / lag[0] == pytest.approx(np.exp(-1.0), abs=0.12)
    assert np.array_equal(fields[3], random_field(lens.back, length, 3, where))


@pytest.mark.parametrize("outline", [Circle(10.0), Rectangle(16.0, 12.0)])
def test_a_front_as_a_net_is_that_front(outline):
    front = Sphere(3.0, 0.04)
    x, y = torch.meshgrid(*[torch.linspace(-10, 10, 201, dtype=torch.float64)] * 2, indexing="ij")
    within = outline.contains(x, y)
    net = as_net(front, outline)
    (z, *slopes), (found, *found_slopes) = front.sag_and_slope(x, y), net.sag_and_slope(x, y)
    off = (found - z).abs()
    assert float(off[within].max()) < 1e-5  # mm; in the end span of a rectangle
    within &= (x.abs() < 7.9) & (y.abs() < 5.9) if isinstance(outline, Rectangle) else within
    assert float(off[within].max()) < 1e-7  # a hundredth of the least form error
    for found, wanted in zip(found_slopes, slopes, strict=True):
        assert float((found - wanted)[within].abs().max()) < 1e-5  # rad: 2 µm on a screen 200 mm away


def test_what_a_net_cannot_carry_is_refused(setup):
    with pytest.raises(ValueError, match="33 x 33 control points"):
        ripple(setup.lens, 0.1, "raster")
    with pytest.raises(ValueError, match="0.2 mm"):
        form_error(setup.lens, 0.2, 0)
