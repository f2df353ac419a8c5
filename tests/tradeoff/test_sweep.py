"""The order of runs, the budget, going on after an interruption: by runs that take no time."""

import contextlib
import csv
import itertools
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

import bstcad
from bstcad.prediction.forecast import fitted
from bstcad.prediction.work import KINDS
from bstcad.scene.errors import MachineError, SceneError
from bstcad.tradeoff import agenda, command, figure, prediction, runs, sweep, written
from bstcad.tradeoff.findings import Findings
from bstcad.tradeoff.knobs import knobs, settings, with_seed
from bstcad.tradeoff.prediction import Prediction
from bstcad.tradeoff.sweep import Shelf
from bstcad.tradeoff.written import COLUMNS, NOT_RUN
from tests.tradeoff.synthetic import REFUSED, Synthetic, record

FILES = ("tradeoff.csv", "tradeoff.json", "tradeoff.html", "tradeoff.png")


def test_each_knob_holds_the_base_and_goes_up(tiny):
    found = {knob.key: knob for knob in knobs(tiny)}
    assert {"quality", "evaluations", "tubes", "control_points", "precision", "pixels", "rounds", "transport_grid",
            "transport_iterations", "adam", "tubes_evaluations", "control_points_tubes"} == set(found)  # fmt: skip
    for key, knob in found.items():
        assert (knob.base is None) == (key == "adam")
        assert len({point.settings for point in knob.points}) == len(knob.points)
    assert [point.label for point in found["control_points"].points] == ["9", "17", "33", "65", "129"]
    assert dict(found["tubes"].points[0].settings) == {"tailoring.rays": 32}


def test_every_setting_is_one_of_the_scene(tiny):
    for knob in knobs(tiny):
        for point in knob.points:
            tiny.changed(dict(point.settings))  # SceneError for a key or a value that is none


def test_full_size_nets_are_those_of_the_trade():
    from bstcad.scene.scene import load

    found = {knob.key: knob for knob in knobs(load("templates/thu.toml"))}
    assert [point.label for point in found["control_points"].points] == ["129", "257", "513", "1025"]
    assert [point.label for point in found["quality"].points] == ["draft", "standard", "fine", "paper"]


def test_presets_come_first_then_neighbours_and_the_paper_last(tiny):
    order = agenda.agenda(tiny, knobs(tiny), lambda point: None)
    assert order[:2] == [(), settings([("tailoring.quality", "standard")])]  # the base is the draft
    assert order[-1] == settings([("tailoring.quality", "paper")])
    neighbours = {settings([entry]) for entry in (("tailoring.rays", 91), ("lens.back.control_points", 17),
                                                   ("tailoring.stage2_iterations", 4))}  # fmt: skip
    further = settings([("tailoring.rays", 64)])
    assert max(map(order.index, neighbours)) < order.index(further)
    assert len(order) == len(set(order))


def test_seeds_are_run_where_they_were_found_to_matter(swept):
    _, found = swept
    assert found.sweep.seed_matters == {"least-squares": False, "adam": True}
    with_seeds = [point for point in found.sweep.records if "tailoring.seed" in dict(point)]
    adam = [point for point in with_seeds if dict(point).get("tailoring.quality") == "paper"]
    assert len(with_seeds) == len(adam) + 1 and len(adam) == 2 * 4  # but for the probe; two more of each of four
    [turned] = [turned for turned in found.turned if turned.knob.key == "adam"]
    assert {place.seeds for place in turned.places} == {3}
    assert all(place.lowest < place.rrmsd < place.highest for place in turned.places)


def test_the_budget_is_kept_and_what_was_not_run_is_said(tiny, tmp_path):
    found = command.tradeoff(tiny, tmp_path / "s", budget=300.0, machines=Synthetic(tiny))
    assert 150 < found.sweep.spent <= 300 and len(found.sweep.not_run) > 3
    entries = json.loads((tmp_path / "s" / "tradeoff.json").read_text())["runs"]
    left = [entry for entry in entries if entry["status"] == NOT_RUN]
    assert len(left) == len(found.sweep.not_run)
    assert all(entry["predicted_seconds"] > 0 and entry["seconds"] is None for entry in left)


def test_a_run_may_go_beyond_the_budget_by_a_tenth_of_it_and_no_further(tiny, tmp_path):
    """But for the first one, without which there is nothing."""
    machine = Limited(tiny)
    command.tradeoff(tiny, tmp_path / "s", budget=300.0, machines=machine)
    assert machine.limits[0] == math.inf and len(machine.limits) > 5
    spent = itertools.accumulate(record(tiny, point).cost_seconds for point in machine.ran)
    for before, limit in zip(spent, machine.limits[1:], strict=False):
        assert before + limit == pytest.approx(1.1 * 300.0)


class Limited(Synthetic):
    """Keeps how long runs may take."""

    def __init__(self, base):
        super().__init__(base)
        self.limits = []

    def start(self, order):
        self.limits.append(order.limit)
        super().start(order)


class Several(Synthetic):
    """Three runs at a time, on other machines."""

    room = 3

    def __init__(self, base, most=math.inf):
        super().__init__(base, most, "tcp://10.0.0.1:1")
        self.orders = []

    def start(self, order):
        self.orders.append(order)

    def next(self, tick):
        self.order = self.orders.pop(0)
        return super().next(tick)


def test_a_sweep_on_a_cluster_that_goes_on_keeps_to_what_is_left(tiny, tmp_path):
    for most in (4, math.inf, math.inf):
        with contextlib.suppress(KeyboardInterrupt):
            found = command.tradeoff(tiny, tmp_path / "s", budget=300.0, machines=Several(tiny, most))
    assert 150 < found.sweep.spent <= 300 and found.sweep.not_run


def test_the_first_run_takes_place_however_small_the_budget(tiny, tmp_path):
    machine = Synthetic(tiny)
    command.tradeoff(tiny, tmp_path / "s", budget=0.1, machines=machine)
    assert machine.ran == [()]


@pytest.mark.parametrize("most", (1, 4, 11))
def test_an_interrupted_sweep_goes_on_and_ends_with_the_same_table(tiny, tmp_path, most):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    command.tradeoff(tiny, whole, budget=400.0, machines=Synthetic(tiny))
    with pytest.raises(KeyboardInterrupt) as stopped:
        command.tradeoff(tiny, parts, budget=400.0, machines=Synthetic(tiny, most))
    assert re.match(f"{most} (run is|runs are) kept in ", stopped.value.__notes__[0])
    assert all((parts / name).is_file() for name in FILES)  # what there is so far
    with pytest.raises(KeyboardInterrupt) as stopped:  # before another run has ended
        command.tradeoff(tiny, parts, budget=400.0, machines=Synthetic(tiny, 0))
    assert stopped.value.__notes__[0].startswith(f"{most} ")
    rest = Synthetic(tiny)
    command.tradeoff(tiny, parts, budget=400.0, machines=rest)
    for name in ("tradeoff.csv", "tradeoff.json"):
        assert (parts / name).read_text() == (whole / name).read_text()
    assert len(rest.ran) == len(list((parts / "runs").iterdir())) - most


def test_a_finished_sweep_runs_nothing_and_a_larger_budget_goes_further(tiny, tmp_path):
    folder = tmp_path / "s"
    first = command.tradeoff(tiny, folder, budget=200.0, machines=Synthetic(tiny))
    again = Synthetic(tiny)
    command.tradeoff(tiny, folder, budget=200.0, machines=again)
    assert again.ran == [] and again.prepared == 0
    more = command.tradeoff(tiny, folder, budget=500.0, machines=again)
    assert again.ran and set(first.sweep.records) < set(more.sweep.records)


def test_another_version_of_the_program_runs_anew(tiny, tmp_path, monkeypatch):
    folder = tmp_path / "s"
    command.tradeoff(tiny, folder, budget=100.0, machines=Synthetic(tiny))
    monkeypatch.setattr(runs, "version", lambda: "another")
    again = Synthetic(tiny)
    command.tradeoff(tiny, folder, budget=100.0, machines=again)
    assert () in again.ran


def test_the_folder_of_another_scene_is_left_alone(tiny, tmp_path):
    folder = tmp_path / "s"
    command.tradeoff(tiny, folder, budget=1.0, machines=Synthetic(tiny))
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    other = tiny.changed({"target.z": 501.0})
    with pytest.raises(SceneError, match="holds the sweep of another scene"):
        sweep.sweep(other, folder, budget=1.0, machines=Synthetic(other))
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_folder_of_other_things_is_left_alone(tiny, tmp_path):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(SceneError, match="holds files that are not a sweep's"):
        sweep.sweep(tiny, tmp_path, budget=1.0, machines=Synthetic(tiny))


def test_what_ends_a_design_early_is_taken_out_of_the_base(tiny):
    hurried = tiny.changed({"tailoring.accuracy": 0.1, "tailoring.max_time": 9.0})
    assert runs.base_of(hurried) == runs.base_of(tiny)


def test_a_failed_run_is_kept_with_its_reason_and_not_done_again(swept, tiny):
    folder, found = swept
    [failed] = found.failed
    assert REFUSED in failed.settings
    again = Synthetic(tiny)
    once_more = command.tradeoff(tiny, folder, budget=1e6, machines=again)
    assert again.ran == [] and once_more.failed == [failed]
    with (folder / "tradeoff.csv").open(newline="") as file:
        rows = {row["settings"]: row for row in csv.DictReader(file)}
    row = rows["target.pixels = 96"]
    assert (row["status"], row["reason"], row["rrmsd"]) == ("failed", "ended by SIGKILL", "")


def test_a_run_that_was_ended_for_time_is_begun_again_when_there_is_more(tiny, tmp_path):
    folder, shelf = tmp_path / "s", Shelf(tmp_path / "s" / "runs", runs.scene_files(runs.base_of(tiny)))
    command.tradeoff(tiny, folder, budget=100.0, machines=Synthetic(tiny))
    shelf.put(replace(record(tiny, ()), status="failed", reason="ended", allowed_seconds=190.0, cost_seconds=90.0))
    for budget, again in ((100.0, False), (400.0, True)):
        machine = Synthetic(tiny)
        found = command.tradeoff(tiny, folder, budget=budget, machines=machine)
        assert (() in machine.ran) == again == found.sweep.records[()].done


def test_the_table_has_a_line_a_run_under_the_names_of_the_json(swept):
    folder, found = swept
    facts = json.loads((folder / "tradeoff.json").read_text())
    assert facts["version"] == bstcad.__version__ and facts["sources"] == found.version
    with (folder / "tradeoff.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS and len(rows) == len(found.sweep.records)
    for row, run in zip(rows, facts["runs"], strict=True):
        for name in set(COLUMNS) - {"knobs", "settings"}:
            assert row[name] == ("" if run[name] is None else str(run[name]))
    base = next(row for row in rows if row["knobs"] == "base")
    in_kernels = float(base["seconds"]) / float(base["kernel_seconds"])
    assert in_kernels == pytest.approx(float(base["units"]), rel=1e-5)  # to the digits of the table
    told, of_runs = (set(re.findall(r"[a-z_]+", text)) for text in (written.__doc__, written.__doc__.split("\n- ")[6]))
    assert facts.keys() | facts["knobs"][0].keys() | facts["base"].keys() <= told
    assert facts["runs"][0].keys() <= of_runs


def test_what_was_predicted_of_a_run_stands_beside_what_it_took(tiny, tmp_path):
    found = command.tradeoff(tiny, tmp_path / "s", budget=200.0, machines=Synthetic(tiny))
    assert all(record.predicted_seconds > 0 for record in found.sweep.records.values())
    first, *others = found.sweep.records.values()
    assert all(each.predicted_seconds * sweep.LEEWAY <= 200.0 - first.cost_seconds for each in others)


def test_a_record_comes_back_as_it_was(tiny, tmp_path):
    shelf = Shelf(tmp_path, {"scene.toml": b"x"})
    kept = record(tiny, with_seed((("target.pixels", (48, 32)),), 3))
    shelf.put(kept)
    assert shelf.find(kept.settings) == kept and shelf.find(()) is None
    shelf.path(kept.settings).write_text("{")
    with pytest.raises(MachineError, match="is damaged; remove it"):
        shelf.find(kept.settings)


def test_predictions_learn_from_the_runs(tiny):
    """Where runs go by the formula of the synthetic machine, what others take is known to a fifth."""
    points = [point.settings for knob in knobs(tiny) for point in knob.points if knob.key not in ("adam", "pixels")]
    done = [record(tiny, point) for point in points[::2]]
    found = Prediction(tiny)
    found.learn(done)
    for point in points[1::2]:
        if dict(point).get("tailoring.quality") != "paper":
            truth = record(tiny, point).cost_seconds
            assert found.seconds(point) == pytest.approx(truth, rel=0.25)


def test_a_price_that_starts_at_nothing_is_learned(tiny, monkeypatch):
    """As a fit of other designs may leave it: here runs take 5 s, and half a second an evaluation."""
    known = fitted()
    monkeypatch.setattr(prediction, "fitted", lambda: known | {"prices": known["prices"] | {"evaluations": 0.0}})
    counts = {settings([("tailoring.stage2_iterations", n)]): n for n in (2, 10, 50, 200)}
    of_run = {point: {"start": 1.0, "evaluations": float(n)} for point, n in counts.items()}
    monkeypatch.setattr(
        prediction, "work_of", lambda scene, point: np.array([of_run[point].get(k, 0.0) for k in KINDS])
    )
    found = Prediction(tiny)
    found.learn([runs.Record(point, runs.DONE, cost_seconds=5 + n / 2) for point, n in counts.items()])
    for point, n in counts.items():
        assert found.seconds(point) == pytest.approx(5 + n / 2, rel=0.2)


def test_remote_runs_count_by_their_error_alone(tiny, tmp_path):
    """Runs of other machines stay out of the front while there are runs of this one."""
    found = command.tradeoff(tiny, tmp_path / "s", budget=150.0, machines=Synthetic(tiny))
    point = next(iter(found.sweep.not_run)).settings
    records = {**found.sweep.records, point: record(tiny, point, "tcp://10.0.0.1:1")}
    mixed = Findings(replace(found.sweep, records=records))
    assert point not in mixed.compared and point not in {r.settings for r in mixed.front}


def test_a_sweep_that_is_all_remote_reports_errors_and_no_times(tiny, tmp_path):
    found = command.tradeoff(tiny, tmp_path / "s", budget=1e6, machines=Several(tiny))
    assert found.errors_alone and found.front == [] and found.front_halving is None
    assert [entry["name"] for entry in found.comparisons] == ["Adam on control points against the Sobolev variable"]
    facts = json.loads((tmp_path / "s" / "tradeoff.json").read_text())
    places = [place for knob in facts["knobs"] for place in knob["places"]]
    assert places and {place["seconds"] for place in places} == {None} and all(place["rrmsd"] > 0 for place in places)
    assert not any(knob["steps"] or knob["stops_after"] for knob in facts["knobs"])
    assert {preset["seconds"] for preset in facts["presets"]} == {None}
    assert not any(run["on_front"] for run in facts["runs"])
    page = (tmp_path / "s" / "tradeoff.html").read_text()
    assert "their seconds do not compare" in page and "all machines together" in page
    for words in ("one after the other", "alving the error", "alving its error", "HALVING", "stops paying", ">The Par"):
        assert words not in page
    [axes] = figure.errors(found).axes
    assert axes.get_xlabel() == "RRMSD by the reference"
    assert [text.get_text() for text in axes.get_yticklabels()][::-1] == [t.knob.title for t in found.turned]
