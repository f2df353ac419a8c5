"""Sweeps: what is run in which order, within the budget, once; and the files that they leave."""

import csv
import json
import math
import re
from dataclasses import replace

import pytest

import bstcad
from bstcad.optics.trace.measure import Effort
from bstcad.planning import cold_run, results, tradeoff
from bstcad.planning.cold_run import sorted_settings
from bstcad.planning.results import TRADEOFF_COLUMNS
from bstcad.planning.tradeoff import SAFETY_FACTOR, knobs, run_order
from bstcad.scene.errors import MachineError, SceneError
from bstcad.scene.scene import load
from tests import suite
from tests.planning.conftest import REFUSED, Synthetic, record

FILES = ("tradeoff.csv", "tradeoff.json", "tradeoff.html", "tradeoff.png")


@pytest.fixture(autouse=True)
def quick_figures(monkeypatch):
    """Replace the figures, which test_results.py looks at."""
    monkeypatch.setattr(results, "tradeoff_figure", lambda table: None)
    monkeypatch.setattr(results, "png", lambda figure: b"PNG")


def sweep(scene, folder, budget, machine=None):
    return tradeoff.tradeoff(scene, folder, budget=budget, machines=machine or Synthetic(scene))


def settings_of(runs):
    return {run.settings for run in runs}


def lines(folder):
    with (folder / "tradeoff.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def record_file(folder):
    [path] = (folder / "runs").iterdir()
    return path


class TestKnobs:
    def test_each_knob_holds_the_base_and_goes_up(self, tiny):
        points = {knob.key: knob.points for knob in knobs(tiny)}
        assert {"quality", "evaluations", "tubes", "control_points", "precision", "pixels", "rounds", "transport_grid",
                "transport_iterations", "adam", "tubes_evaluations", "control_points_tubes"} == set(points)  # fmt: skip
        for key, found in points.items():
            assert (() in found.values()) == (key != "adam") and len(set(found.values())) == len(found)
            for point in found.values():
                tiny.changed(dict(point))  # SceneError for a key or a value that is none
        assert list(points["control_points"]) == ["9", "17", "33", "65", "129"]
        assert dict(points["tubes"]["32"]) == {"tailoring.rays": 32}
        assert list(points["control_points_tubes"]) == ["9 × 32", "17 × 64", "33 × 128", "65 × 256"]
        full = {knob.key: list(knob.points) for knob in knobs(load("templates/thu.toml"))}
        assert full["control_points"] == ["129", "257", "513", "1025"]
        assert full["quality"] == ["draft", "standard", "fine", "paper"]

    def test_all_targets_are_turned_together_and_the_paper_is_left_out(self, tiny):
        target = tiny.target.model_dump(mode="json", exclude_none=True)
        two = tiny.changed({"target": [target | {"pixels": 64}, target | {"z": 900.0, "pixels": [96, 48]}]})
        points = {knob.key: knob.points for knob in knobs(two)}
        assert list(points["pixels"]) == ["16 and [24, 12]", "32 and [48, 24]", "64 and [96, 48]", "128 and [192, 96]"]
        assert dict(points["pixels"]["16 and [24, 12]"]) == {"target[0].pixels": 16, "target[1].pixels": (24, 12)}
        for found in points.values():
            for point in found.values():
                two.changed(dict(point))
        assert "paper" not in points["quality"] and "adam" not in points and "paper" in {
            name for knob in knobs(tiny) for name in knob.points
        }  # fmt: skip

    def test_presets_come_first_then_neighbours_and_the_paper_last(self, tiny):
        order = run_order(knobs(tiny))
        assert order[:2] == [(), sorted_settings({"tailoring.quality": "standard"})]  # the base is the draft
        assert order[-1] == sorted_settings({"tailoring.quality": "paper"})
        near = [{"tailoring.rays": 91}, {"lens.back.control_points": 17}, {"tailoring.stage2_iterations": 6}]
        assert max(order.index(sorted_settings(each)) for each in near) < order.index(
            sorted_settings({"tailoring.rays": 64})
        )
        assert len(order) == len(set(order))


class TestBudget:
    @suite.in_turn(0, 2)
    def test_it_is_kept_and_the_runs_that_did_not_fit_are_told(self, tiny, tmp_path):
        found = sweep(tiny, tmp_path / "s", 200.0)
        assert 150 < found.spent_seconds <= 200 and len(found.not_run) > 3
        assert all(run.predicted_seconds > 0 and run.seconds is None for run in found.not_run)
        first, *others = found.runs_with_lens
        assert all(each.predicted_seconds * SAFETY_FACTOR <= 200.0 - first.cost_seconds for each in others)

    def test_a_run_that_was_ended_for_time_is_begun_again_when_there_is_more(self, tiny, tmp_path):
        class Ended(Synthetic):
            def next(self, tick):
                answer = super().next(tick)
                ended = {"status": "failed", "reason": "ended", "allowed_seconds": 190.0, "cost_seconds": 90.0}
                return replace(answer, value=answer.value.model_copy(update=ended))

        sweep(tiny, tmp_path / "s", 1.0, Ended(tiny, 1))
        for budget, again in ((100.0, False), (400.0, True)):
            machine = Synthetic(tiny)
            found = sweep(tiny, tmp_path / "s", budget, machine)
            assert (() in machine.ran) == again == (found.base_run is not None)


class TestResume:
    @suite.in_turn(1, 2)
    def test_an_interrupted_sweep_goes_on_and_ends_with_the_same_table(self, tiny, tmp_path):
        whole, parts = tmp_path / "whole", tmp_path / "parts"
        sweep(tiny, whole, 400.0)
        for more in (11, 0):  # the second time before another run has ended
            with pytest.raises(KeyboardInterrupt) as stopped:
                sweep(tiny, parts, 400.0, Synthetic(tiny, more))
            assert re.match("11 runs are stored in ", stopped.value.__notes__[0])
            assert all((parts / name).is_file() for name in FILES)  # of the runs so far
        rest = Synthetic(tiny)
        sweep(tiny, parts, 400.0, rest)
        for name in ("tradeoff.csv", "tradeoff.json"):
            assert (parts / name).read_text() == (whole / name).read_text()
        assert len(rest.ran) == len(json.loads(record_file(parts).read_text())["runs"]) - 11

    def test_a_finished_sweep_runs_nothing_and_a_larger_budget_goes_further(self, tiny, tmp_path, monkeypatch):
        folder = tmp_path / "s"
        first = sweep(tiny, folder, 200.0)
        monkeypatch.setattr(cold_run, "warm_up", lambda *given: pytest.fail("warms up in vain"))
        tradeoff.tradeoff(tiny, folder, budget=200.0)  # on this machine
        again = Synthetic(tiny)
        more = sweep(tiny, folder, 500.0, again)
        assert again.ran and settings_of(first.runs_with_lens) < settings_of(more.runs_with_lens)

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
        with pytest.raises(SceneError, match="contains the sweep of another scene"):
            sweep(tiny.changed({"target.z": 501.0}), folder, 1.0)
        assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        with pytest.raises(SceneError, match="contains files that are not a sweep's"):
            sweep(tiny, tmp_path, 1.0)


class TestFiles:
    @pytest.mark.parametrize("damage", ["{", '{"runs": [{"settings": 3, "status": "done"}]}'])
    def test_records_come_back_as_they_were_and_damaged_ones_are_a_sentence(self, tiny, tmp_path, damage):
        point = sorted_settings({"target.pixels": (48, 32), "tailoring.seed": 3})
        bad = {"seconds": 1.0, "rrmsd": math.nan}
        kept = tradeoff.RunFile(runs=(record(tiny, point), record(tiny, ()).model_copy(update={"history": (bad,)})))
        cold_run.write_record(tmp_path / "runs.json", kept)
        read = cold_run.read_record(tradeoff.RunFile, tmp_path / "runs.json", "")
        assert read.runs[0] == kept.runs[0] and read.runs[1].history[0]["rrmsd"] is None  # JSON has no such number
        sweep(tiny, tmp_path / "s", 1.0)
        record_file(tmp_path / "s").write_text(damage)
        with pytest.raises(MachineError, match="; remove it"):
            sweep(tiny, tmp_path / "s", 1.0)

    def test_the_table_has_a_line_a_run_under_the_names_of_the_json(self, swept):
        folder, found = swept
        facts = json.loads((folder / "tradeoff.json").read_text())
        assert set(facts) == set(KEYS.split()) and set(facts["runs"][0]) == set(OF_A_RUN.split())
        assert facts["version"] == bstcad.__version__ and facts["sources"] == "1"
        rows = lines(folder)
        assert tuple(rows[0]) == TRADEOFF_COLUMNS and len(rows) == len(found.runs)
        for row, run in zip(rows, facts["runs"], strict=True):
            for name in set(TRADEOFF_COLUMNS) - {"knobs", "settings"}:
                assert row[name] == ("" if run[name] is None else str(run[name]))
        base = next(row for row in rows if row["knobs"] == "base")
        in_kernels = float(base["seconds"]) / float(base["kernel_seconds"])
        assert in_kernels == pytest.approx(float(base["units"]), rel=1e-5)  # to the digits of the table
        assert facts["front"] == [dict(run.settings) for run in found.front_runs]


KEYS = """
    name title base budget_seconds spent_seconds errors_alone version sources machine versions reference calibration
    runs knobs front front_halving presets history
"""
OF_A_RUN = """
    settings status reason where seconds cpu_seconds kernel_seconds cost_seconds predicted_seconds peak_memory_gb rrmsd
    rrmsd_half rrmsd_noise rays rrmsd_reported rrmsd_noise_reported passed net stages label knobs units on_front
"""


def test_the_table_states_the_effort_of_its_own_reference(tiny, tmp_path):
    found = tradeoff.tradeoff(
        tiny, tmp_path / "s", budget=0.1, machines=Synthetic(tiny), reference=Effort(accuracy=0.02)
    )
    assert "below 2.00% of the RRMSD" in found.reference["what"]
