"""The end of a convergence curve, of curves whose end is known."""

import pytest

from bstcad.analysis.convergence import ending

PARTS = [(1.0, None), (3.0, 0.4), (100.0, 0.05)]  # picture, stage 1, stage 2


def curve(value, count=100, step=1.0):
    """Stage 1's judgement, points of stage 2 every `step` seconds, and its own judgement."""
    points = [(4.0 + k * step, value(k * step)) for k in range(1, count + 1)]
    return [(4.0, 0.4), *points, (104.0, 0.05)]


def test_a_power_law_is_found_and_says_what_half_of_the_error_costs():
    found = ending(curve(lambda t: 0.3 * t**-0.5), PARTS)
    assert found.power == pytest.approx(0.5, abs=1e-6) and found.fit == pytest.approx(1.0)
    assert found.halving == pytest.approx(4.0, rel=1e-5) and found.doubled == pytest.approx(0.5**0.5)


def test_the_last_tenth_of_a_power_law():
    """t^-1/2 is 1.1 times its end at t / 1.21, to a step; the median of the last twentieth stands for the end."""
    found = ending(curve(lambda t: 0.3 * t**-0.5), PARTS)
    assert found.last_tenth_seconds == pytest.approx(100 - 98 / 1.21, abs=1.5)
    assert found.last_tenth == pytest.approx(found.last_tenth_seconds / 104)


def test_a_curve_at_rest_has_stopped_paying():
    found = ending(curve(lambda t: 0.03 + 0.3 * 0.8**t), PARTS)
    assert found.power < 0.01 and found.halving is None and found.last_tenth > 0.7


def test_noise_is_no_power_law():
    found = ending(curve(lambda t: 0.03 * (1.3 if int(t) % 2 else 1.0)), PARTS)
    assert found.fit < 0.1 and found.halving is None


def test_a_curve_that_rises_gains_nothing():
    found = ending(curve(lambda t: 0.03 * t**0.5), PARTS)
    assert found.power == 0.0 and found.doubled == 1.0 and found.halving is None


def test_only_the_last_round_counts_for_the_power():
    """Its tubes are others, and so is the level of its curve; the time goes on."""
    parts = [(1.0, None), (3.0, 0.4), (60.0, 0.2), (40.0, 0.05)]
    found = ending(curve(lambda t: (0.3 if t <= 60 else 0.5) * t**-0.5), parts)
    assert found.power == pytest.approx(0.5, abs=1e-6)


def test_a_design_that_ended_before_the_irradiance_has_no_curve():
    assert ending([(4.0, 0.4)], PARTS[:2]) is None and ending([], []) is None


def test_of_few_points_nothing_is_said_of_a_power():
    found = ending(curve(lambda t: 0.3 * t**-0.5, count=3), PARTS)
    assert found.power is None and found.halving is None and found.doubled == 1.0


def test_where_the_light_became_another_the_time_counts_from_there():
    history = [(4.0 + t, 0.3 * (t - 60) ** -0.5) for t in range(61, 101)]
    found = ending([(30.0, 0.2), *history], [(1.0, None), (3.0, 0.4), (60.0, 0.21), (40.0, 0.05)], since=64.0)
    assert found.power == pytest.approx(0.5, abs=1e-6)
