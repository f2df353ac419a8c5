"""Sweeps: what is run in which order, within the budget, once; and the files that they leave."""

import csv
import json
import math
import re
from contextlib import suppress
from itertools import accumulate

import numpy as np
import pytest

import bstcad
from bstcad.folder import scene_files
from bstcad.runs import environment
from bstcad.scene.errors import MachineError, SceneError
from bstcad.scene.scene import load
from bstcad.sweep import cold_run, io, tradeoff
from bstcad.sweep.cold_run import DONE, HistoryPoint, KeptRun
from bstcad.sweep.forecast import fitted
from bstcad.sweep.knobs import knobs, run_order, settings, with_seed
from bstcad.sweep.results import COLUMNS, Table
from bstcad.sweep.tradeoff import LEEWAY, RunPrices, Shelf
from bstcad.sweep.work import KINDS
from tests.sweep.synthetic import REFUSED, Synthetic, record

FAR = "tcp://10.0.0.1:1"  # a worker
FILES = ("tradeoff.csv", "tradeoff.json", "tradeoff.html", "tradeoff.png")


def sweep(scene, folder, budget, machine=None):
    return tradeoff.tradeoff(scene, folder, budget=budget, machines=machine or Synthetic(scene))


def settings_of(runs):
    return {run.settings for run in runs}


def lines(folder):
    with (folder / "tradeoff.csv").open(newline="") as file:
        return list(csv.DictReader(file))


class TestKnobs:
    def test_each_knob_holds_the_base_and_goes_up(self, tiny):
        found = {knob.key: knob for knob in knobs(tiny)}
        assert {"quality", "evaluations", "tubes", "control_points", "precision", "pixels", "rounds", "transport_grid",
                "transport_iterations", "adam", "tubes_evaluations", "control_points_tubes"} == set(found)  # fmt: skip
        for key, knob in found.items():
            assert (knob.base is None) == (key == "adam")
            assert len({point.settings for point in knob.points}) == len(knob.points)
            for point in knob.points:
                tiny.changed(dict(point.settings))  # SceneError for a key or a value that is none
        assert [point.label for point in found["control_points"].points] == ["9", "17", "33", "65", "129"]
        assert dict(found["tubes"].points[0].settings) == {"tailoring.rays": 32}
        assert [point.label for point in found["control_points_tubes"].points] == [
            "9 × 32", "17 × 64", "33 × 128", "65 × 256",
        ]  # fmt: skip

    def test_full_size_nets_are_those_of_the_trade(self):
        found = {knob.key: knob for knob in knobs(load("templates/thu.toml"))}
        assert [point.label for point in found["control_points"].points] == ["129", "257", "513", "1025"]
        assert [point.label for point in found["quality"].points] == ["draft", "standard", "fine", "paper"]

    def test_presets_come_first_then_neighbours_and_the_paper_last(self, tiny):
        order = run_order(tiny, knobs(tiny), lambda point: None)
        assert order[:2] == [(), settings({"tailoring.quality": "standard"})]  # the base is the draft
        assert order[-1] == settings({"tailoring.quality": "paper"})
        near = [{"tailoring.rays": 91}, {"lens.back.control_points": 17}, {"tailoring.stage2_iterations": 4}]
        assert max(order.index(settings(each)) for each in near) < order.index(settings({"tailoring.rays": 64}))
        assert len(order) == len(set(order))

    def test_seeds_are_run_where_they_were_found_to_matter(self, swept):
        _, found = swept
        assert found.seeds == {"least-squares": False, "adam": True}
        with_seeds = [run.settings for run in found.runs if "tailoring.seed" in dict(run.settings)]
        adam = [point for point in with_seeds if dict(point).get("tailoring.quality") == "paper"]
        assert len(with_seeds) == len(adam) + 1 and len(adam) == 2 * 4  # but for the probe; two more of each of four
        [knob] = [knob for knob in found.knobs if knob.key == "adam"]
        assert {place.seeds for place in knob.places} == {3}
        assert all(place.lowest < place.rrmsd < place.highest for place in knob.places)


class TestBudget:
    def test_it_is_kept_and_the_runs_that_did_not_fit_are_told(self, tiny, tmp_path):
        found = sweep(tiny, tmp_path / "s", 300.0)
        assert 150 < found.spent_seconds <= 300 and len(found.not_run) > 3
        assert all(run.predicted_seconds > 0 and run.seconds is None for run in found.not_run)
        first, *others = found.lenses
        assert all(each.predicted_seconds * LEEWAY <= 300.0 - first.cost_seconds for each in others)

    def test_a_run_may_go_beyond_it_by_a_tenth_and_no_further(self, tiny, tmp_path):
        """But for the first one, without which there is nothing."""
        machine = Synthetic(tiny)
        sweep(tiny, tmp_path / "s", 300.0, machine)
        assert machine.limits[0] == math.inf and len(machine.limits) > 5
        spent = accumulate(record(tiny, point).cost_seconds for point in machine.ran)
        for before, limit in zip(spent, machine.limits[1:], strict=False):
            assert before + limit == pytest.approx(1.1 * 300.0)

    def test_a_sweep_on_a_cluster_that_goes_on_keeps_to_what_is_left(self, tiny, tmp_path):
        for most in (4, math.inf, math.inf):
            with suppress(KeyboardInterrupt):
                found = sweep(tiny, tmp_path / "s", 300.0, Synthetic(tiny, most, FAR, room=3))
        assert 150 < found.spent_seconds <= 300 and found.not_run

    def test_the_first_run_takes_place_however_small_it_is(self, tiny, tmp_path):
        machine = Synthetic(tiny)
        sweep(tiny, tmp_path / "s", 0.1, machine)
        assert machine.ran == [()]

    def test_a_run_that_was_ended_for_time_is_begun_again_when_there_is_more(self, tiny, tmp_path):
        folder, shelf = tmp_path / "s", Shelf(tmp_path / "s" / "runs", scene_files(cold_run.base_of(tiny)))
        sweep(tiny, folder, 100.0)
        ended = {"status": "failed", "reason": "ended", "allowed_seconds": 190.0, "cost_seconds": 90.0}
        shelf.put(record(tiny, ()).model_copy(update=ended))
        for budget, again in ((100.0, False), (400.0, True)):
            machine = Synthetic(tiny)
            found = sweep(tiny, folder, budget, machine)
            assert (() in machine.ran) == again == (found.own is not None)

    def test_predictions_learn_from_the_runs(self, tiny):
        """Where runs go by the formula of the synthetic machine, the seconds of others are known to a quarter."""
        points = [point.settings for knob in knobs(tiny) for point in knob.points if knob.key not in ("adam", "pixels")]
        found = RunPrices(tiny)
        found.learn([record(tiny, point) for point in points[::2]])
        for point in points[1::2]:
            if dict(point).get("tailoring.quality") != "paper":
                assert found.seconds(point) == pytest.approx(record(tiny, point).cost_seconds, rel=0.25)

    def test_a_price_that_starts_at_nothing_is_learned(self, tiny, monkeypatch):
        """As a fit of other designs may leave it: here runs take 5 s, and half a second an evaluation."""
        known = fitted()
        monkeypatch.setattr(tradeoff, "fitted", lambda: known | {"prices": known["prices"] | {"evaluations": 0.0}})
        counts = {settings({"tailoring.stage2_iterations": n}): n for n in (2, 10, 50, 200)}
        work = {point: {"start": 1.0, "evaluations": float(n)} for point, n in counts.items()}
        monkeypatch.setattr(
            tradeoff, "work_of", lambda scene, point: np.array([work[point].get(k, 0.0) for k in KINDS])
        )
        found = RunPrices(tiny)
        found.learn([KeptRun(settings=point, status=DONE, cost_seconds=5 + n / 2) for point, n in counts.items()])
        for point, n in counts.items():
            assert found.seconds(point) == pytest.approx(5 + n / 2, rel=0.2)


class TestResume:
    @pytest.mark.parametrize("most", (1, 4, 11))
    def test_an_interrupted_sweep_goes_on_and_ends_with_the_same_table(self, tiny, tmp_path, most):
        whole, parts = tmp_path / "whole", tmp_path / "parts"
        sweep(tiny, whole, 400.0)
        for more in (most, 0):  # the second time before another run has ended
            with pytest.raises(KeyboardInterrupt) as stopped:
                sweep(tiny, parts, 400.0, Synthetic(tiny, more))
            assert re.match(f"{most} (run is|runs are) kept in ", stopped.value.__notes__[0])
            assert all((parts / name).is_file() for name in FILES)  # of the runs so far
        rest = Synthetic(tiny)
        sweep(tiny, parts, 400.0, rest)
        for name in ("tradeoff.csv", "tradeoff.json"):
            assert (parts / name).read_text() == (whole / name).read_text()
        assert len(rest.ran) == len(list((parts / "runs").iterdir())) - most

    def test_a_finished_sweep_runs_nothing_and_a_larger_budget_goes_further(self, tiny, tmp_path, monkeypatch):
        folder = tmp_path / "s"
        first = sweep(tiny, folder, 200.0)
        monkeypatch.setattr(cold_run, "warm_up", lambda *given: pytest.fail("warms up in vain"))
        tradeoff.tradeoff(tiny, folder, budget=200.0)  # on this machine
        again = Synthetic(tiny)
        more = sweep(tiny, folder, 500.0, again)
        assert again.ran and settings_of(first.lenses) < settings_of(more.lenses)

    def test_another_version_of_the_program_runs_anew(self, tiny, tmp_path, monkeypatch):
        sweep(tiny, tmp_path / "s", 100.0)
        monkeypatch.setattr(environment, "version", lambda: "another")
        again = Synthetic(tiny)
        sweep(tiny, tmp_path / "s", 100.0, again)
        assert () in again.ran

    def test_a_failed_run_is_kept_with_its_reason_and_not_done_again(self, swept, tiny):
        folder, found = swept
        [failed] = found.failed
        assert REFUSED in failed.settings
        again = Synthetic(tiny)
        assert sweep(tiny, folder, 1e6, again) == found and again.ran == []
        [row] = [row for row in lines(folder) if row["settings"] == "target.pixels = 96"]
        assert (row["status"], row["reason"], row["rrmsd"]) == ("failed", "ended by SIGKILL", "")

    def test_the_folder_of_another_scene_or_of_other_things_is_left_alone(self, tiny, tmp_path):
        folder = tmp_path / "s"
        sweep(tiny, folder, 1.0)
        before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        with pytest.raises(SceneError, match="holds the sweep of another scene"):
            sweep(tiny.changed({"target.z": 501.0}), folder, 1.0)
        assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        with pytest.raises(SceneError, match="holds files that are not a sweep's"):
            sweep(tiny, tmp_path, 1.0)

    def test_limits_that_end_a_design_early_are_taken_out_of_the_base(self, tiny):
        hurried = tiny.changed({"tailoring.accuracy": 0.1, "tailoring.max_time": 9.0})
        assert cold_run.base_of(hurried) == cold_run.base_of(tiny)


class TestFiles:
    @pytest.mark.parametrize("damage", ["{", '{"settings": {}}', '{"settings": 3, "status": "done"}', ""])
    def test_a_record_comes_back_as_it_was_and_a_damaged_one_is_a_sentence(self, tiny, tmp_path, damage):
        shelf = Shelf(tmp_path, {"scene.toml": b"x"})
        kept = record(tiny, with_seed((("target.pixels", (48, 32)),), 3))
        shelf.put(kept)
        assert shelf.find(kept.settings) == kept and shelf.find(()) is None
        shelf.put(kept.model_copy(update={"history": (HistoryPoint(seconds=1.0, rrmsd=math.nan),)}))
        assert shelf.find(kept.settings).history[0].rrmsd is None  # JSON has no such number
        shelf.path(kept.settings).write_text(damage)
        with pytest.raises(MachineError, match="is damaged, or another program's; remove it"):
            shelf.find(kept.settings)

    def test_the_table_has_a_line_a_run_under_the_names_of_the_json(self, swept):
        folder, found = swept
        facts = json.loads((folder / "tradeoff.json").read_text())
        table = io.read(Table, folder / "tradeoff.json", "")
        assert table.version == bstcad.__version__ and table.sources == "1"
        rows = lines(folder)
        assert tuple(rows[0]) == COLUMNS and len(rows) == len(table.runs)
        for row, run in zip(rows, facts["runs"], strict=True):
            for name in set(COLUMNS) - {"knobs", "settings"}:
                assert row[name] == ("" if run[name] is None else str(run[name]))
        base = next(row for row in rows if row["knobs"] == "base")
        in_kernels = float(base["seconds"]) / float(base["kernel_seconds"])
        assert in_kernels == pytest.approx(float(base["units"]), rel=1e-5)  # to the digits of the table
        assert table.front == found.front == tuple(run.settings for run in table.best)

    def test_runs_of_other_machines_stay_out_of_the_front(self, tiny, tmp_path):
        found = sweep(tiny, tmp_path / "s", 150.0)
        far = Synthetic(tiny, where=FAR)
        mixed = sweep(tiny, tmp_path / "s", 200.0, far)
        assert far.ran and settings_of(mixed.lenses) == settings_of(mixed.shown) | set(far.ran)
        assert settings_of(mixed.shown) == settings_of(found.shown) and mixed.front == found.front

    def test_a_sweep_that_is_all_remote_reports_errors_and_no_times(self, tiny, tmp_path):
        found = sweep(tiny, tmp_path / "s", 1e6, Synthetic(tiny, where=FAR, room=3))
        table = io.read(Table, tmp_path / "s" / "tradeoff.json", "")
        assert found.errors_alone and table.errors_alone and table.front == ()
        places = [place for knob in table.knobs for place in knob.places]
        assert places and {place.seconds for place in places} == {None} and table.front_halving is None
        assert {preset.seconds for preset in table.presets} == {None} and not any(run.on_front for run in table.runs)
        page = (tmp_path / "s" / "tradeoff.html").read_text()
        assert "their seconds do not compare" in page and "all machines together" in page
        for words in ("one after the other", "HALVING", ">The Pareto"):
            assert words not in page
