"""Pareto fronts and knobs: laws on runs made by hand."""

import pytest

from bstcad.sweep.cold_run import DONE, FAILED, KeptRun
from bstcad.sweep.knobs import Knob, Point, with_seed
from bstcad.sweep.results import front, halving, places


def run(seconds, rrmsd, settings=(), status=DONE, **more):
    return KeptRun(settings=settings, status=status, seconds=seconds, rrmsd=rrmsd, **more)


def test_nothing_beats_the_runs_of_the_front():
    runs = [run(t, e) for t, e in ((1, 0.5), (2, 0.6), (3, 0.2), (3, 0.3), (4, 0.2), (5, 0.1), (6, 0.15))]
    found = front(runs)
    assert [(r.seconds, r.rrmsd) for r in found] == [(1, 0.5), (3, 0.2), (5, 0.1)]
    assert all(any(f.seconds <= r.seconds and f.rrmsd <= r.rrmsd for f in found) for r in runs)
    assert not any(f.seconds < g.seconds and f.rrmsd < g.rrmsd for f in found for g in found)


def test_failed_and_remote_runs_are_not_on_it():
    runs = [run(1, 0.5), run(0.1, 0.1, where="tcp://a"), run(0.1, None, status=FAILED)]
    assert [each.seconds for each in front(runs)] == [1]
    assert front(runs[1:]) == []  # seconds of other machines do not compare


@pytest.mark.parametrize("power", (0.5, 1.0, 2.0, 3.0))
def test_the_price_of_halving_is_that_of_the_power_law(power):
    """t = e^-power: half the error takes 2^power times as long; two runs are a line whatever they are."""
    runs = [run(error**-power, error) for error in (0.1, 0.05, 0.031, 0.02)]
    assert halving(front(runs)) == pytest.approx(2**power) and halving(front(runs[:2])) is None


def test_several_seeds_give_median_and_range():
    point = Point("a", (("tailoring.rays", 5),))
    runs = {
        with_seed(point.settings, seed) if seed else point.settings: run(10 + seed, error)
        for seed, error in enumerate((0.3, 0.1, 0.2))
    }
    knob = Knob("adam", "Adam", (Point("not run", (("tailoring.rays", 4),)), point))
    [place] = places(knob, runs, (1, 2))
    assert (place.seconds, place.rrmsd, place.lowest, place.highest, place.seeds) == (11, 0.2, 0.1, 0.3, 3)
    assert places(knob, runs, (1, 2), timed=False)[0].seconds is None
