"""Runs as they are: cold processes, their lenses judged, kills in the middle of them.  Half a minute or so."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from bstcad.optics.measure import Effort
from bstcad.prediction import calibration
from bstcad.tradeoff import command, runs
from bstcad.tradeoff.knobs import Knob, Point
from bstcad.tradeoff.runs import Order, carry_out, scene_files
from bstcad.tradeoff.sweep import Here, Shelf

ROOT = Path(__file__).parent.parent.parent
EFFORT = Effort(256)
SEED = (("tailoring.seed", 1),)
REFUSED = (("lens.back.control_points", 3),)


def few_knobs(scene):
    """The base, which will be run with another seed too, and one setting that is refused."""
    return (
        Knob("quality", "Quality presets", (Point("draft", ()),)),
        Knob("control_points", "Control points a side", (Point("3", REFUSED), Point("33", ()))),
    )


class AtOnce(Here):
    """This machine, without a run that does not count."""

    def prepare(self, scene_of, tick):
        pass


SCRIPT = """
import sys
from pathlib import Path
from bstcad.scene.scene import load
from bstcad.tradeoff import command, runs
sys.path.insert(0, sys.argv[3])
from tests.tradeoff.test_runs import EFFORT, AtOnce, few_knobs
runs.JUDGES = {"tubes": (65, 131), "rays": (128, 256)}
command.tradeoff(load(sys.argv[1]), Path(sys.argv[2]), budget=1e5, machines=AtOnce(), effort=EFFORT, turn=few_knobs)
"""


@pytest.fixture(scope="module")
def killed(tiny, tmp_path_factory):
    """(folder, records that were there, process group that went on) after a kill -9 in the middle of the second run."""
    place = tmp_path_factory.mktemp("killed")
    (place / "scene.toml").write_bytes(scene_files(tiny)["scene.toml"])
    command_line = [sys.executable, "-c", SCRIPT, str(place / "scene.toml"), str(place / "sweep"), str(ROOT)]
    child = subprocess.Popen(command_line, env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=place)
    try:
        until = time.monotonic() + 240
        while not list((place / "sweep" / "runs").glob("*.json")) and time.monotonic() < until:
            assert child.poll() is None
            time.sleep(0.05)
        while not (second := cold_runs_of(child.pid)) and time.monotonic() < until:
            time.sleep(0.05)
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    there = {path.name: path.read_bytes() for path in (place / "sweep" / "runs").glob("*.json")}
    return place / "sweep", there, second


def cold_runs_of(parent):
    """Process ids of the children of `parent` that run the command line."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            words = (path / "stat").read_text().rpartition(")")[2].split()
            if int(words[1]) == parent and b"cold_process" in (path / "cmdline").read_bytes():
                found.append(int(path.name))
        except (OSError, ValueError, IndexError):
            continue
    return found


@pytest.mark.bench  # three quarters of a minute; what an interrupted one goes on from stands in test_sweep.py
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_a_killed_sweep_leaves_no_process_and_goes_on(tiny, killed):
    folder, there, second = killed
    assert len(there) == 1 and second
    until = time.monotonic() + 20
    while any(Path(f"/proc/{pid}").exists() and alive(pid) for pid in second):
        assert time.monotonic() < until, "the run that nobody waits for goes on"
        time.sleep(0.1)
    found = command.tradeoff(tiny, folder, budget=1e5, machines=AtOnce(), effort=EFFORT, turn=few_knobs)
    kept = {path.name: path.read_bytes() for path in (folder / "runs").glob("*.json")}
    assert there.items() <= kept.items() and len(kept) == 3 and not found.sweep.not_run
    base, seed, refused = (found.sweep.records[point] for point in ((), SEED, REFUSED))
    assert 0 < base.rrmsd == seed.rrmsd < 0.2 and base.rrmsd_noise < base.rrmsd / 2
    assert base.cpu_seconds > 0 and 1 < base.seconds < base.cost_seconds and base.peak_memory_gb > 0.1
    assert base.kernel_seconds > 0 and {judge.judge for judge in base.judges} == {"tubes", "rays"}
    assert [name for name, *_ in base.stages][:2] == ["loading", "stage 1"] and len(base.history) > 3
    assert refused.status == "failed" and "3 is not between" in refused.reason
    assert found.sweep.seed_matters["least-squares"] is False  # measured: the same net to the last bit
    entries = {entry["status"] for entry in json.loads((folder / "tradeoff.json").read_text())["runs"]}
    assert entries == {"done", "failed"}
    page = (folder / "tradeoff.html").read_text()
    assert "3 is not between" in page and "The seed does not matter to L-BFGS" in page


def alive(pid):
    """Does it run, and not only wait to be reaped?"""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_run_without_time_is_ended_and_says_so(tiny):
    found = carry_out(Order(scene_files(tiny), (), limit=0.3, effort=EFFORT))
    assert found.status == "failed" and "ended after" in found.reason and found.rrmsd is None


def test_a_lens_tailored_to_other_pixels_is_judged_on_those_of_the_base(tiny, small_design):
    """The judge takes the lens from the run's folder, and light and pixels from the base."""
    record = runs.Record((), runs.DONE)
    from bstcad.runs import folder as folders

    scene, _ = folders.read_nominal(small_design.folder)
    order = Order({}, (), effort=EFFORT)
    full = runs._judged(record, scene, small_design.folder, order)
    coarse = runs._judged(record, scene.changed({"target.pixels": [32, 24]}), small_design.folder, order)
    assert abs(full.rrmsd / small_design.report["rrmsd"] - 1) < 0.1  # fewer tubes than its proof
    assert coarse.rrmsd < 0.9 * full.rrmsd  # four pixels in one hide what is wrong within
    assert full.net == coarse.net and len(full.net) == 64


def test_what_the_first_picture_compiles_does_not_count(monkeypatch):
    """By a clock that the judges turn themselves: the first picture of each takes a hundred times as long."""
    picture, clock, made = torch.ones(4, 4), [0.0], []

    def make(judge):
        clock[0] += 1.0 if judge in made else 100.0
        made.append(judge)
        return picture

    monkeypatch.setattr(runs.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(runs, "tubes_picture", lambda *given: make("tubes"))
    monkeypatch.setattr(runs, "simulated", lambda *given: SimpleNamespace(box=make("rays")))
    found = runs._judges(None, None, None, SimpleNamespace(picture=picture.numpy(), picture_off=0.0))
    assert {(judge.judge, judge.seconds) for judge in found} == {("tubes", 1.0), ("rays", 1.0)}


def test_each_search_starts_at_the_same_lens_and_the_variable_makes_the_difference(tiny, monkeypatch):
    monkeypatch.setattr(runs, "EVALUATIONS", 12)
    ours, *adam = runs.searched(tiny)
    assert ours.rate is None and [each.rate for each in adam] == list(runs.RATES)
    for each in (ours, *adam):
        assert each.rrmsd[0] == ours.start and each.control_points == 33 and each.tubes == 66
        assert len(each.rrmsd) <= 12 and all(map(math.isfinite, each.rrmsd))
    assert all(len(each.rrmsd) == 12 for each in adam)
    assert ours.rrmsd[-1] < 0.8 * ours.start and ours.rrmsd[-1] < min(each.rrmsd[-1] for each in adam)


def test_the_kernel_is_the_same_work_each_time():
    kernel = calibration.Kernel(tubes=64)
    assert kernel.seconds() > 0
    problem, heights = kernel._problem, kernel._lens.back.heights
    values = {problem(heights)[0] for _ in range(3)}
    assert len(values) == 1 and 0 < values.pop() < 1  # and a gradient that is one: the lens is not perfect
    assert float(problem(heights)[1].abs().max()) > 0


def test_the_version_changes_with_the_sources(monkeypatch, tmp_path):
    import bstcad

    package = tmp_path / "bstcad"
    (package / "optics").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "optics" / "lens.py").write_text("a = 1")
    monkeypatch.setattr(bstcad, "__file__", str(package / "__init__.py"))
    one = runs.version.__wrapped__()
    (package / "optics" / "lens.py").write_text("a = 2")
    assert runs.version.__wrapped__() != one


def test_settings_that_come_back_from_a_file_are_the_same(tiny, tmp_path):
    point = (("tailoring.rays", 64), ("target.pixels", (32, 24)))
    shelf = Shelf(tmp_path, scene_files(tiny))
    shelf.put(replace(runs.Record(point, runs.FAILED, "x"), seconds=1.5))
    assert shelf.find(point).settings == point and shelf.count() == 1
