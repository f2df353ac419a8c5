"""Fronts, prices of halving and where a knob stops paying: laws on records made by hand."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from bstcad.tradeoff import page, pareto
from bstcad.tradeoff.knobs import Knob, Point, with_seed
from bstcad.tradeoff.runs import DONE, FAILED, Record


def run(seconds, rrmsd, settings=(), **more):
    return Record(settings, DONE, seconds=seconds, rrmsd=rrmsd, **more)


def knob_of(*places, look=pareto.turned, title="Tubes"):
    """A knob and its records, from (seconds, error) in the order of work; the second one is the base."""
    points = tuple(Point(f"{i}", () if i == 1 else (("tailoring.rays", 100 + i),)) for i in range(len(places)))
    records = {p.settings: run(t, e, p.settings) for p, (t, e) in zip(points, places, strict=True)}
    return look(Knob("tubes", title, points), records, (1, 2))


@pytest.mark.parametrize("power", (0.5, 1.0, 2.0, 3.0))
def test_the_price_of_halving_is_that_of_the_power_law(power):
    """t = e^-power: half the error takes 2^power times as long."""
    t1, t2 = 0.1**-power, 0.03**-power
    assert pareto.halving(t1, 0.1, t2, 0.03) == pytest.approx(2**power)
    runs = [run(error**-power, error) for error in (0.1, 0.05, 0.031, 0.02)]
    assert pareto.along(pareto.front(runs)) == pytest.approx(2**power)


def test_an_error_that_does_not_fall_has_no_price():
    assert pareto.halving(1.0, 0.1, 2.0, 0.1) is None
    assert pareto.halving(1.0, 0.1, 2.0, 0.2) is None
    assert pareto.halving(1.0, 0.1, 0.5, 0.05) == 1.0  # quicker and better: it costs nothing


def test_nothing_beats_what_is_on_the_front():
    runs = [run(t, e) for t, e in ((1, 0.5), (2, 0.6), (3, 0.2), (3, 0.3), (4, 0.2), (5, 0.1), (6, 0.15))]
    front = pareto.front(runs)
    assert [(r.seconds, r.rrmsd) for r in front] == [(1, 0.5), (3, 0.2), (5, 0.1)]
    for record in runs:
        beaten = any(f.seconds <= record.seconds and f.rrmsd <= record.rrmsd for f in front)
        assert beaten
    assert not any(f.seconds < g.seconds and f.rrmsd < g.rrmsd for f in front for g in front)


def test_failed_and_remote_runs_are_not_on_it():
    runs = [run(1, 0.5), run(0.1, 0.1, where="tcp://a"), Record((), FAILED, "x", seconds=0.1)]
    assert [record.seconds for record in pareto.front(runs)] == [1]
    assert pareto.front(runs[1:]) == []  # seconds of other machines do not compare


def test_the_front_is_followed_between_its_points():
    front = pareto.front([run(1, 0.4), run(4, 0.1)])
    assert pareto.time_for(front, 0.2) == pytest.approx(2.0)
    assert pareto.time_for(front, 0.05) is None and pareto.time_for(front, 0.9) == 1


def test_a_knob_stops_where_a_step_is_dearer_than_random_rays():
    turned = knob_of((1, 0.8), (2, 0.4), (4, 0.2), (40, 0.18))
    assert turned.stops_after == "2" and "pays up to 2; on to 3 halving costs over ×\u00a01000" in turned.says
    assert turned.to_base.halving == pytest.approx(2.0) and turned.from_base.halving == pytest.approx(2.0)


def test_a_knob_that_pays_to_the_end_says_so():
    assert "pays up to 2, the most that was tried" in knob_of((1, 0.8), (2, 0.4), (4, 0.2)).says


def test_two_runs_give_no_price_of_halving():
    """Whatever they are, there is a line through two points."""
    runs = [run(1, 0.4), run(2, 0.2), run(4, 0.1)]
    assert pareto.along(runs) == pytest.approx(2.0) and pareto.along(runs[:2]) is None
    turned = knob_of((1, 0.8), (40, 0.6))
    assert turned.says == "1 has × 0.75 of the error of 0 in × 40 of its time; two places give no price of halving"
    row = page.knob(turned)
    assert row["to"] is row["on"] is None and row["whole"] == "—"
    three = knob_of((1, 0.9), (2, 0.8), (4, 0.1))
    two = replace(three, places=three.places[1:])
    assert page.halving_at(SimpleNamespace(turned=[three]))[0].startswith("×")
    assert page.halving_at(SimpleNamespace(turned=[two]))[0] == "not measured"


def test_a_knob_that_changes_nothing_will_do_at_its_least():
    turned = knob_of((10, 0.100), (10.1, 0.1001), (10.2, 0.0999))
    assert turned.stops_after == "0" and turned.says == "0, the least tried, will do; on to 1 changes nothing"
    assert all(step.halving is None for step in turned.steps)


def test_a_place_without_gain_is_passed_where_a_later_one_pays():
    assert knob_of((10, 0.1), (10.1, 0.1), (15, 0.05)).stops_after == "2"


def test_a_place_where_the_error_rises_is_passed_where_a_later_one_pays():
    assert knob_of((10, 0.1), (11, 0.104), (15, 0.05)).stops_after == "2"


def test_less_error_for_no_time_is_free():
    [step] = knob_of((10, 0.1), (10.2, 0.05)).steps
    assert step.free and step.pays


def test_a_step_that_makes_it_worse_is_said_to():
    assert "the error rises" in knob_of((1, 0.4), (2, 0.5)).says


def test_several_seeds_give_median_and_range():
    point = Point("a", (("tailoring.rays", 5),))
    records = {
        with_seed(point.settings, seed) if seed else point.settings: run(10 + seed, error)
        for seed, error in enumerate((0.3, 0.1, 0.2))
    }
    [place] = pareto.turned(Knob("adam", "Adam", (point,)), records, (1, 2)).places
    assert (place.seconds, place.rrmsd, place.lowest, place.highest, place.seeds) == (11, 0.2, 0.1, 0.3, 3)


def test_what_is_told_by_errors_alone_has_no_times_and_no_prices():
    turned = knob_of((1, 0.4), (2, 0.1), (3, 0.2), look=pareto.by_error)
    assert [place.rrmsd for place in turned.places] == [0.4, 0.1, 0.2] and not turned.steps
    assert {place.seconds for place in turned.places} == {None}
    assert turned.stops_after is None and turned.says == "least error at 1: × 0.25 of that at 0"
    assert knob_of((1, 0.1), (9, 0.101), look=pareto.by_error).says == "changes nothing"


def test_the_ways_on_from_the_base_go_to_every_later_place():
    steps = pareto.onward(knob_of((1, 0.8), (2, 0.4), (3, 0.3), (8, 0.1)))
    assert [(step.before.label, step.after.label) for step in steps] == [("1", "2"), ("1", "3")]
    assert steps[1].halving == pytest.approx(2.0) and steps[1].gain == pytest.approx(4.0)


def test_one_place_says_nothing():
    turned = knob_of((1, 0.5))
    assert turned.stops_after is None and "fewer than two" in turned.says


@pytest.mark.parametrize(("k", "said"), [(1.0, "× 1"), (2.34, "× 2.3"), (38.2, "× 38"), (1e9, "over × 1000")])
def test_prices_for_people(k, said):
    assert pareto.times(k) == said.replace("× ", "×\u00a0")
