"""Numbers of flat tops, against pictures whose numbers are known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import gammainc

from bstcad.analysis.top_hat import MAX_BINS, FlatTop, plateau_uniformity, top_hat

PIXELS, HALF = 600, 4.0  # number of pixels a side of a square screen, and half its width (mm)
PITCH = 2 * HALF / PIXELS
AT = (np.arange(PIXELS) + 0.5) * PITCH - HALF
R = np.hypot(AT, AT[:, None])
DISC, RADIUS = (R < 3.0).astype(float), 3.0


def numbers(picture, **more):
    return top_hat(picture, (PITCH, PITCH), **more)


def test_a_disc_is_flat_even_and_upright():
    found = numbers(7.0 * DISC)
    assert (found.maximum, found.flatness, found.uniformity, found.edge_steepness) == (7.0, 1.0, 0.0, 0.0)
    assert found.fractional_power == 1.0 and found.plateau_uniformity <= 1 / MAX_BINS
    assert found.clip_level_area == pytest.approx(math.pi * RADIUS**2, rel=1e-3)  # whole pixels
    assert found.power == found.clip_level_power == pytest.approx(7.0 * found.clip_level_area)
    assert found.average == pytest.approx(7.0) and found.efficiency is None


@pytest.mark.parametrize("eta", [0.9, 0.5])
def test_a_gaussian(eta):
    """A_η = π w² / 2 ln 1/η, f_η = 1 - η, E_η = (1 - η) / ln 1/η, U_η² = (1 + η) ln 1/η / (2 (1 - η)) - 1."""
    w, log = 1.5, math.log(1 / eta)
    found = numbers(np.exp(-2 * (R / w) ** 2), eta=eta)
    close = {"rel": 5e-3}  # whole pixels; and E_max, by the median, is too low by 4e-4, 0.4 % of ln 1 / 0.9
    assert found.maximum == pytest.approx(1 - 5 * (PITCH / w) ** 2, abs=1e-6)  # a corner of pixels
    assert found.clip_level_area == pytest.approx(math.pi * w**2 / 2 * log, **close)
    assert found.power == pytest.approx(math.pi * w**2 / 2, rel=1e-5)
    assert found.fractional_power == pytest.approx(1 - eta, **close)
    assert found.flatness == pytest.approx((1 - eta) / log, rel=5e-4)
    assert found.uniformity == pytest.approx(math.sqrt((1 + eta) * log / (2 * (1 - eta)) - 1), **close)
    assert found.edge_steepness == pytest.approx(1 - log / math.log(10), **close)
    assert found.plateau_uniformity > 0.99  # no plateau


@pytest.mark.parametrize("order", [4, 24])
def test_a_super_gaussian(order):
    """exp(-2 (r / w)^p): A_η = π w² (ln(1/η) / 2)^(2/p), f_η = P(2 / p, ln 1/η), the incomplete gamma function."""
    w, eta, epsilon = 2.0, 0.9, 0.1
    found = numbers(np.exp(-2 * (R / w) ** order), eta=eta, epsilon=epsilon)
    areas = [math.pi * w**2 * (math.log(1 / level) / 2) ** (2 / order) for level in (eta, epsilon)]
    assert found.maximum == pytest.approx(1, abs=1e-6)
    assert found.clip_level_area == pytest.approx(areas[0], rel=3e-3)
    assert found.edge_steepness == pytest.approx(1 - areas[0] / areas[1], abs=3e-3)
    assert found.fractional_power == pytest.approx(gammainc(2 / order, math.log(1 / eta)), rel=3e-3)
    whole = math.pi * w**2 * 2 / order * 2 ** (-2 / order) * math.gamma(2 / order)
    assert found.power == pytest.approx(whole, rel=1e-5)
    assert found.flatness == pytest.approx(found.fractional_power * whole / areas[0], rel=5e-3)
    assert found.plateau_uniformity < 0.06


@pytest.mark.parametrize("noise", [0.003, 0.1])
def test_noise_is_the_uniformity_and_its_full_width_the_plateau_uniformity(noise):
    """σ, and 2 sqrt(2 ln 2) σ; E_max grows by less than 2 σ, where the brightest pixel grows by 4.5."""
    normal = np.random.default_rng(0).standard_normal(R.shape)
    picture = DISC * (1 + noise * normal) + 0.01 * noise * np.roll(normal, 7)
    found = numbers(picture, eta=0.5)
    assert 0 < found.maximum - 1 < 2 * noise < (picture.max() - 1) / 2
    assert found.uniformity == pytest.approx(noise, rel=0.01)
    width = math.sqrt(8 * math.log(2)) * noise / found.maximum
    assert found.plateau_uniformity == pytest.approx(width, rel=0.05)
    assert found.edge_steepness < 1e-4 and found.fractional_power == pytest.approx(1, abs=1e-3)


def test_a_hot_pixel_is_neither_the_maximum_nor_the_plateau():
    hot = DISC.copy()
    hot[PIXELS // 2, PIXELS // 3] = 1e6
    found = numbers(hot)
    assert found.maximum == 1.0 and found.edge_steepness == 0.0 and found.plateau_uniformity <= 1 / MAX_BINS


def test_two_plateaus_have_the_width_of_the_brighter_ones_peak():
    """The plateau above half of E_max counts, however large the other one is."""
    steps = np.where(R < 1.0, 1.0, 0.3) + 0.01 * np.random.default_rng(1).standard_normal(R.shape)
    assert plateau_uniformity(steps, 1.0) == pytest.approx(math.sqrt(8 * math.log(2)) * 0.01, rel=0.1)


def test_efficiency_is_the_share_of_the_light_inside_the_outline():
    found = numbers(DISC + 0.01, wanted=DISC, on_picture=0.9)
    inside = DISC.sum()
    assert found.efficiency == pytest.approx(0.9 * 1.01 * inside / (inside + 0.01 * DISC.size), rel=1e-12)
    assert replace(found, efficiency=None) == numbers(DISC + 0.01)


@pytest.mark.parametrize(
    ("picture", "more", "sentence"),
    [
        (0 * DISC, {}, "no light"),
        (-DISC, {}, "no light"),
        (np.where(DISC, np.nan, 0.0), {}, "not finite; give 0"),
        (DISC, {"eta": 0.1, "epsilon": 0.1}, "0 < epsilon < eta < 1"),
    ],
)
def test_what_has_no_such_numbers_is_refused_in_a_sentence(picture, more, sentence):
    with pytest.raises(ValueError, match=sentence):
        numbers(picture, **more)


def test_a_report_states_an_even_disc_as_even_and_all_of_its_light_inside():
    """All but what falls beside the picture; a tenth of the light spread over all of it lies partly outside."""
    found = FlatTop.of("target", DISC, (PITCH, PITCH), DISC, on_picture=0.98)
    assert found.key == "target" and found.flatness == pytest.approx(1.0) and found.uniformity < 1e-12
    assert found.fractional_power == pytest.approx(1.0, abs=0.02) and found.efficiency == pytest.approx(0.98, abs=0.02)
    haze = DISC / DISC.sum() + 0.1 / DISC.size
    inside = float((haze * DISC).sum() / haze.sum())
    assert FlatTop.of("target", haze, (PITCH, PITCH), DISC, on_picture=1.0).efficiency == pytest.approx(inside)
