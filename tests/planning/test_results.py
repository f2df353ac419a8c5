"""Pareto fronts, prices of halving; the figure, the page and the summary of a sweep."""

import io
import re
from dataclasses import replace

import pytest
from PIL import Image

from bstcad.figures.drawing import png
from bstcad.planning import results
from bstcad.planning.cold_run import DONE, FAILED, ColdRun
from bstcad.planning.results import halving_factor, pareto_front
from bstcad.planning.tradeoff import tradeoff
from bstcad.report.units import number
from tests.planning.conftest import FAR, Synthetic


def run(seconds, rrmsd, settings=(), status=DONE, **more):
    return ColdRun(settings=settings, status=status, seconds=seconds, rrmsd=rrmsd, **more)


def test_nothing_beats_the_runs_of_the_front():
    runs = [run(t, e) for t, e in ((1, 0.5), (2, 0.6), (3, 0.2), (3, 0.3), (4, 0.2), (5, 0.1), (6, 0.15))]
    found = pareto_front(runs)
    assert [(r.seconds, r.rrmsd) for r in found] == [(1, 0.5), (3, 0.2), (5, 0.1)]
    assert all(any(f.seconds <= r.seconds and f.rrmsd <= r.rrmsd for f in found) for r in runs)
    others = [run(0.1, 0.1, where=FAR), run(0.1, None, status=FAILED)]  # seconds of other machines do not compare
    assert pareto_front([*runs, *others]) == found and pareto_front(others) == []


@pytest.mark.parametrize("power", (0.5, 1.0, 3.0))
def test_the_price_of_halving_is_that_of_the_power_law(power):
    """t = e^-power: half the error takes 2^power times as long; two runs are a line whatever they are."""
    runs = [run(error**-power, error) for error in (0.1, 0.05, 0.031, 0.02)]
    assert (
        halving_factor(pareto_front(runs)) == pytest.approx(2**power) and halving_factor(pareto_front(runs[:2])) is None
    )


def only(table, *runs):
    """The table of a sweep that had these runs alone."""
    return table.model_copy(update={"runs": runs, "front_halving": None})


def test_the_figure_has_a_curve_a_knob_the_front_and_the_presets(swept):
    _, found = swept
    drawn = results.tradeoff_figure(found)
    png(drawn)  # which lays it out
    [axes], unit = drawn.axes, found.calibration.seconds
    assert axes.get_xscale() == axes.get_yscale() == "log"
    named = [text.get_text() for text in axes.get_legend().get_texts()]
    for knob in found.knobs:
        if knob.key != "quality" and len(knob.places) > 1:
            assert any(name.startswith(knob.title) for name in named)
    assert {"Pareto front", "convergence of the base run", "standard error of the reference"} <= set(named)
    assert {"draft", "standard", "fine", "paper"} <= {text.get_text() for text in axes.texts}
    [above] = axes.child_axes
    assert [round(x * unit, 6) for x in above.get_xlim()] == [round(x, 6) for x in axes.get_xlim()]


def test_one_run_makes_a_figure_and_a_front_of_two_claims_no_price(tiny, swept, tmp_path):
    scene = tiny.changed({"title": "<b>mine</b>"})
    one = tradeoff(scene, tmp_path / "s", budget=0.1, machines=Synthetic(scene))
    with Image.open(io.BytesIO((tmp_path / "s" / "tradeoff.png").read_bytes())) as picture:
        assert min(picture.size) > 300
    text = (tmp_path / "s" / "tradeoff.html").read_text()
    assert "<b>mine" not in text and "&lt;b&gt;mine" in text
    two = only(swept[1], swept[1].front_runs[0], swept[1].front_runs[-1])
    for found, words in ((one, "is the only run"), (two, "too few to state")):
        _, headline, explanation = results.verdict(found)
        fastest = number(found.front_runs[0].time_and_error[1])
        assert headline.startswith(f"RRMSD {fastest} in") and words in explanation


def test_without_a_lens_there_is_a_page_that_says_why(tiny, tmp_path):
    class Failing(Synthetic):
        def next(self, tick):
            answer = super().next(tick)
            ended = {"status": "failed", "reason": "ended by SIGKILL", "rrmsd": None}
            return replace(answer, value=answer.value.model_copy(update=ended))

    found = tradeoff(tiny, tmp_path / "s", budget=0.1, machines=Failing(tiny))
    text = (tmp_path / "s" / "tradeoff.html").read_text()
    assert "NO LENS" in text and "ended by SIGKILL" in text and not (tmp_path / "s" / "tradeoff.png").exists()
    assert found.front == ()


def test_the_page_fetches_nothing_and_shows_every_run(swept):
    folder, found = swept
    text = (folder / "tradeoff.html").read_text()
    assert not re.search(r'(?:src|href)="(?!data:)', text) and "<script" not in text
    assert results.verdict(found)[1] in text and "HALVING" in text
    assert text.count('<th scope="row" class="label">') == len(found.front) + len(found.runs_with_lens) + len(
        found.failed
    )
    assert "The Pareto front" in text and found.failed[0].reason in text
    assert "Calibration kernel" in text and "200 ms" in text and "The unchanged scene" in text
