"""The figure, the page and the summary: what is drawn, what is said, and that nothing is fetched."""

import io
import re
from dataclasses import replace

import pytest
from PIL import Image
from rich.console import Console

from bstcad.report.drawing import png
from bstcad.sweep import tradeoff_figure, tradeoff_page
from bstcad.sweep.tradeoff import tradeoff
from tests.sweep.synthetic import Synthetic


def words_of(axes):
    return [text.get_text() for text in axes.texts]


def only(table, *runs):
    """The table of a sweep that had these runs alone."""
    return table.model_copy(update={"runs": runs, "front_halving": None})


def test_the_figure_has_a_curve_a_knob_the_front_the_presets_and_what_failed(swept):
    _, found = swept
    [axes] = tradeoff_figure.tradeoff(found).axes
    assert axes.get_xscale() == axes.get_yscale() == "log"
    named = [text.get_text() for text in axes.get_legend().get_texts()]
    for knob in found.knobs:
        if knob.key != "quality" and len(knob.places) > 1:
            assert any(name.startswith(knob.title) for name in named)
    assert {"Pareto front", "failed", "along the base's run (warm)", "standard error of the reference"} <= set(named)
    assert {"draft", "standard", "fine", "paper"} <= set(words_of(axes))
    assert "Pixels tailored to: 96" in words_of(axes)  # the one that failed


def test_the_second_axis_is_the_first_in_units_of_the_kernel(swept):
    _, found = swept
    drawn = tradeoff_figure.tradeoff(found)
    png(drawn)  # which lays it out
    [axes], unit = drawn.axes, found.calibration.seconds
    [above] = axes.child_axes
    assert "calibration kernel" in above.get_xlabel()
    assert [round(x * unit, 6) for x in above.get_xlim()] == [round(x, 6) for x in axes.get_xlim()]


def test_the_runs_of_the_front_are_marked_in_the_figure(swept):
    for found in (swept[1], only(swept[1], swept[1].best[0])):
        axes = tradeoff_figure.tradeoff(found).axes[0]
        [line] = [line for line in axes.lines if line.get_label() == "Pareto front"]
        assert [*zip(*line.get_data(), strict=True)] == [(r.seconds, r.rrmsd) for r in found.best]
        assert line.get_marker() == "o" and line.get_markersize() > 12


def test_errors_alone_have_a_line_a_knob(swept):
    found = swept[1].model_copy(update={"errors_alone": True})
    [axes] = tradeoff_figure.errors(found).axes
    assert axes.get_xlabel() == "RRMSD by the reference"
    assert [text.get_text() for text in axes.get_yticklabels()][::-1] == [knob.title for knob in found.knobs]


def test_one_run_makes_a_figure_too(tiny, tmp_path):
    found = tradeoff(tiny, tmp_path / "s", budget=0.1, machines=Synthetic(tiny))
    with Image.open(io.BytesIO((tmp_path / "s" / "tradeoff.png").read_bytes())) as picture:
        assert min(picture.size) > 300
    assert tradeoff_page.verdict(found)[1].startswith("RRMSD 0.06")


def test_a_front_of_two_runs_claims_no_price(swept):
    found = swept[1]
    two = only(found, found.best[0], found.best[-1])
    _, headline, explanation = tradeoff_page.verdict(two)
    assert headline.startswith("RRMSD 0.06") and "too few for a price of halving" in explanation
    assert "HALVING" in tradeoff_page.verdict(found)[1]


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
    assert tradeoff_page.verdict(found)[1] in text
    assert "The seed does not matter to L-BFGS by ray tubes" in text
    assert "The seed matters to Adam by random rays" in text
    assert text.count('<th scope="row" class="label">') == len(found.front) + len(found.lenses) + len(found.failed)
    assert "The Pareto front" in text and found.failed[0].reason in text


def test_the_terminal_has_the_presets_the_front_and_the_verdict(swept):
    _, found = swept
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(tradeoff_page.summary(found))
    text = console.export_text()
    assert text.count("(Pareto front)") == len(found.front) and all(preset.name in text for preset in found.presets)
    assert "Failed: Pixels tailored to: 96: ended by SIGKILL" in text and "HALVING THE ERROR COSTS" in text


def test_a_title_is_no_markup(tiny, tmp_path):
    scene = tiny.changed({"title": "<b>mine</b>"})
    tradeoff(scene, tmp_path / "s", budget=0.1, machines=Synthetic(scene))
    text = (tmp_path / "s" / "tradeoff.html").read_text()
    assert "<b>mine" not in text and "&lt;b&gt;mine" in text


@pytest.mark.parametrize(("k", "text"), [(1.0, "× 1"), (2.34, "× 2.3"), (38.2, "× 38"), (1e9, "over × 1000")])
def test_factors_for_people(k, text):
    assert tradeoff_page.times(k) == text.replace("× ", "×\u00a0")
