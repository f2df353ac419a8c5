"""The figure and the page: what is drawn, what is said, and that nothing is fetched."""

import io
import re
from dataclasses import replace
from types import SimpleNamespace

from PIL import Image

from bstcad.report.drawing import png
from bstcad.tradeoff import command, figure, page
from bstcad.tradeoff.findings import Findings
from tests.tradeoff.synthetic import Synthetic
from tests.tradeoff.test_pareto import knob_of


def words_of(axes):
    return [text.get_text() for text in axes.texts]


def test_the_figure_has_a_curve_a_knob_the_front_the_presets_and_what_failed(swept):
    _, found = swept
    drawn = figure.tradeoff(found)
    axes, judges = drawn.axes
    assert axes.get_xscale() == axes.get_yscale() == "log"
    named = [text.get_text() for text in axes.get_legend().get_texts()]
    for turned in found.turned:
        if turned.knob.key != "quality" and len(turned.places) > 1:
            assert any(name.startswith(turned.knob.title) for name in named)
    assert {"Pareto front", "failed", "along the base's run (warm)"} <= set(named)
    assert {"draft", "standard", "fine", "paper"} <= set(words_of(axes))
    assert any(words.startswith("standard error of the reference") for words in words_of(axes))
    assert "Pixels tailored to: 96" in words_of(axes)  # the one that failed
    [above] = axes.child_axes
    assert "calibration kernel" in above.get_xlabel()
    assert {"512²", "515²"} < set(words_of(judges))
    [factors] = [words for words in words_of(judges) if "float32" in words]
    for name in (
        "float64 for float32", "Adam on control points for the Sobolev variable", "Adam by rays for L-BFGS by tubes",
        "rays for tubes as judges",
    ):  # fmt: skip
        assert re.search(rf"{name}:\s+(at least )?(time|error) × [\d.]+", factors)


def test_the_second_axis_is_the_first_in_units_of_the_kernel(swept):
    _, found = swept
    drawn = figure.tradeoff(found)
    png(drawn)  # which lays it out
    axes = drawn.axes[0]
    unit = found.calibration["seconds"]
    assert [round(x * unit, 6) for x in axes.child_axes[0].get_xlim()] == [round(x, 6) for x in axes.get_xlim()]


def test_one_run_makes_a_figure_too(tiny, tmp_path):
    found = command.tradeoff(tiny, tmp_path / "s", budget=0.1, machines=Synthetic(tiny))
    with Image.open(io.BytesIO((tmp_path / "s" / "tradeoff.png").read_bytes())) as picture:
        assert min(picture.size) > 300
    assert page.verdict(found)[1].startswith("RRMSD 0.06")


def test_a_front_of_two_runs_claims_no_price(swept):
    found = swept[1]
    two = {record.settings: record for record in (found.front[0], found.front[-1])}
    few = Findings(replace(found.sweep, records=two))
    _, headline, said = page.verdict(few)
    assert len(few.front) == 2 and few.front_halving is None
    assert headline.startswith("RRMSD 0.06") and "too few for a price of halving" in said
    assert [price for *_, price in page.front(few)] == ["", ""] and "HALVING" in page.verdict(found)[1]


def test_the_runs_of_the_front_are_marked_in_the_figure(swept):
    for found in (swept[1], Findings(replace(swept[1].sweep, records={(): swept[1].sweep.records[()]}))):
        axes = figure.tradeoff(found).axes[0]
        [line] = [line for line in axes.lines if line.get_label() == "Pareto front"]
        assert [*zip(*line.get_data(), strict=True)] == [(r.seconds, r.rrmsd) for r in found.front]
        assert line.get_marker() == "o" and line.get_markersize() > 12


def test_without_a_lens_there_is_a_page_that_says_why(tiny, tmp_path):
    base = tiny.changed({"target.pixels": 48})
    found = command.tradeoff(base, tmp_path / "s", budget=0.1, machines=_Failing(base))
    text = (tmp_path / "s" / "tradeoff.html").read_text()
    assert "NO LENS" in text and "ended by SIGKILL" in text and not (tmp_path / "s" / "tradeoff.png").exists()
    assert found.front == []


class _Failing(Synthetic):
    def next(self, tick):
        return replace(super().next(tick), status="failed", reason="ended by SIGKILL", rrmsd=None)


def test_the_page_fetches_nothing_and_shows_what_was_found(swept):
    folder, found = swept
    text = (folder / "tradeoff.html").read_text()
    assert not re.search(r'(?:src|href)="(?!data:)', text) and "<script" not in text
    assert f"HALVING THE ERROR COSTS {page.times(found.front_halving)}" in text
    for turned in found.turned:
        if len(turned.places) > 1:
            assert turned.says in text.replace("&#39;", "'")
    assert "The seed does not matter to L-BFGS by ray tubes" in text
    assert "The seed matters to Adam by random rays" in text
    assert found.failed[0].reason in text


def test_a_title_is_no_markup(tiny, tmp_path):
    scene = tiny.changed({"title": "<b>mine</b>"})
    command.tradeoff(scene, tmp_path / "s", budget=0.1, machines=Synthetic(scene))
    text = (tmp_path / "s" / "tradeoff.html").read_text()
    assert "<b>mine" not in text and "&lt;b&gt;mine" in text


def test_halving_is_priced_by_a_step_that_goes_a_good_part_of_the_way():
    """The last place of a knob that gains a tenth for nothing has no halving to sell."""
    grid = knob_of((23.1, 0.0240), (23.8, 0.0242), (24.6, 0.0220), title="Transport grid")
    net = knob_of((21.6, 0.0463), (23.8, 0.0242), (50.3, 0.0147), title="Control points")
    value, remark = page.halving_at(SimpleNamespace(turned=[grid, net]))
    assert value == page.times(net.from_base.halving) == "×\u00a02.8"
    assert remark == "the cheapest way tried: Control points to 2, which divides the error by 1.6"
    value, remark = page.halving_at(SimpleNamespace(turned=[grid]))
    assert value == "no way found" and "divides the error by is 1.1: Transport grid to 2" in remark


def test_nothing_is_compared_with_a_run_that_is_no_better_than_no_picture(swept):
    _, found = swept
    records = {
        point: replace(record, rrmsd=1.0 + record.rrmsd) if dict(point).get("tailoring.quality") == "paper" else record
        for point, record in found.sweep.records.items()
    }
    [adam] = [c for c in Findings(replace(found.sweep, records=records)).comparisons if "and rays" in c["name"]]
    assert not {"time_factor", "rrmsd_factor"} & adam.keys() and "no better than no picture" in adam["what"]
    assert not re.search(r"times|×", adam["what"] + adam["short"])


def test_the_variable_is_told_apart_by_evaluations_from_the_best_rate(swept):
    [entry] = [entry for entry in swept[1].comparisons if entry["name"].startswith("Adam on control points against")]
    assert (entry["rrmsd_factor"], entry["evaluations_factor"]) == (0.2 / 0.05, 4 / 2)


def test_a_busy_machine_is_told(swept):
    _, found = swept
    records = dict(found.sweep.records)
    records[()] = replace(records[()], kernel_seconds=0.5)
    busy = Findings(replace(found.sweep, records=records))
    assert page.unsteady(busy) and not page.unsteady(found)
    assert any("had other work" in note for note in page.notes(busy))
