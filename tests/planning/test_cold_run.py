"""Runs as they are: cold processes, here and on workers, their lenses judged, and a kill in the middle of them."""

import threading
from pathlib import Path

import distributed
import pytest

from bstcad.designs import folder as folders
from bstcad.designs.folder import scene_files
from bstcad.optics.trace.measure import Effort
from bstcad.planning import cold_run, tradeoff
from bstcad.planning.cold_run import DONE, FAILED, ColdRun, LocalPool, calibration_kernel, judge_run, run_and_judge
from bstcad.planning.tradeoff import Knob
from bstcad.runs import environment
from bstcad.runs.cluster import Cluster
from bstcad.runs.processes import ExitStatus
from tests import suite

ROOT = Path(__file__).parent.parent.parent
EFFORT = Effort(256)
REFUSED = (("lens.back.control_points", 3),)


@suite.in_turn(0, 2)
@pytest.mark.bench  # half a minute
def test_a_sweep_of_cold_runs_measures_each_and_tells_why_one_failed(tiny, tmp_path, monkeypatch):
    """The base, and a setting that is refused."""
    few = (
        Knob("quality", "Quality presets", {"draft": ()}),
        Knob("control_points", "Control points per side", {"3": REFUSED, "33": ()}),
    )
    monkeypatch.setattr(tradeoff, "knobs", lambda scene: few)
    found = tradeoff.tradeoff(tiny, tmp_path / "sweep", budget=1e5, reference=EFFORT)
    runs = {run.settings: run for run in found.runs}
    assert len(runs) == 2 and not found.not_run
    base, refused = (runs[point] for point in ((), REFUSED))
    assert 0 < base.rrmsd < 0.2 and base.rrmsd_noise < base.rrmsd / 2
    assert base.cpu_seconds > 0 and 1 < base.seconds < base.cost_seconds and base.peak_memory_gb > 0.1
    assert base.kernel_seconds > 0 and len(found.history) > 3
    assert [stage["name"] for stage in base.stages][:2] == ["loading", "stage 1"]
    assert refused.status == FAILED and "3 is not between" in refused.reason


def test_a_run_without_time_is_ended_and_says_so(tiny):
    found = run_and_judge(scene_files(tiny), (), limit=0.3, effort=EFFORT)
    assert found.status == FAILED and "ended after" in found.reason and found.rrmsd is None


def test_a_run_with_a_damaged_report_fails_and_says_so(tiny, monkeypatch):
    def cut_off(arguments, *_):
        folder = Path(arguments[arguments.index("-o") + 1])
        folder.mkdir(parents=True)
        (folder / "report.json").write_text('{"passed": tr')
        return ExitStatus(0, 1.0, 1.0, "")

    monkeypatch.setattr(cold_run.processes, "run", cut_off)
    found = run_and_judge(scene_files(tiny), (), limit=10.0, effort=EFFORT)
    assert found.status == FAILED and "report.json: cannot be read" in found.reason


def test_a_lens_tailored_to_other_pixels_is_judged_on_those_of_the_base(small_design):
    """The judge takes the lens from the run's folder, and light and pixels from the base."""
    run, scene = ColdRun(settings=(), status=DONE), folders.read_nominal(small_design.folder).scene
    effort = Effort(512, witness=False)  # of its proof: the noise of half as many rays a side is a third of its RRMSD
    full = judge_run(run, scene, small_design.folder, effort)
    coarse = judge_run(run, scene.changed({"target.pixels": [32, 24]}), small_design.folder, effort)
    assert abs(full.rrmsd / small_design.report["rrmsd"] - 1) < 0.1  # other rays than its proof's
    assert coarse.rrmsd < 0.9 * full.rrmsd  # four pixels in one hide errors within
    assert full.net == coarse.net and len(full.net) == 64


def test_of_several_targets_the_worst_counts(small_design):
    run, scene = ColdRun(settings=(), status=DONE), folders.read_nominal(small_design.folder).scene
    own = scene.target.model_dump(mode="json", exclude_none=True)
    both = [own, own | {"z": scene.target.z + 40.0}]  # for the second of which nobody designed the lens
    alone, second, worst = (
        judge_run(run, scene.changed({"target": targets}), small_design.folder, Effort(256, accuracy=0, witness=False))
        for targets in (own, both[1], both)
    )
    assert alone.rrmsd < 0.9 * second.rrmsd and worst.rrmsd == second.rrmsd


def test_the_kernel_is_the_same_work_each_time():
    found = [calibration_kernel(tubes=64)() for _ in range(3)]
    assert len({value for value, *_ in found}) == 1 and 0 < found[0][0] < 1
    assert float(found[0][1][0].abs().max()) > 0  # no perfect lens


def test_the_version_changes_with_the_sources(monkeypatch, tmp_path):
    import bstcad

    package = tmp_path / "bstcad"
    (package / "optics").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    monkeypatch.setattr(bstcad, "__file__", str(package / "__init__.py"))
    versions = []
    for text in ("a = 1", "a = 2"):
        (package / "optics" / "lens.py").write_text(text)
        versions.append(environment.version.__wrapped__())
    assert versions[0] != versions[1]


def test_processes_that_work_when_a_pool_ends_are_ended():
    begun = threading.Event()

    def works(tick):
        begun.set()
        while True:
            tick()

    with LocalPool(1) as machines:
        machines.start("a", works)
        assert begun.wait(10)


def test_a_fault_of_a_thread_is_told():
    with LocalPool(1) as machines:
        machines.start("a", lambda tick: 1 / 0)
        assert machines.next(lambda: None).reason == "ZeroDivisionError: division by zero"


# --- on workers -------------------------------------------------------------------------------------------------------


@suite.in_turn(1, 2)
def test_a_worker_runs_the_command_as_this_machine_does(tiny):
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=True, dashboard_address=":0", host="127.0.0.1"
        ) as local,
        Cluster(local.scheduler_address) as machines,
    ):
        machines.start(REFUSED, run_and_judge, scene_files(tiny), REFUSED, 600.0, EFFORT)
        answer = machines.next()
    assert answer.where.startswith("tcp://") and answer.value.version == environment.version()
    assert "3 is not between" in answer.value.reason and 0 < answer.value.seconds < answer.value.cost_seconds
