"""Runs as they are: cold processes, here and on workers, their lenses judged, kills in the middle of them."""

import os
import signal
import threading
import time

import distributed
import pytest

from bstcad import folder as folders
from bstcad.folder import scene_files
from bstcad.optics.measure import Effort
from bstcad.runs import environment
from bstcad.runs.cluster import Cluster
from bstcad.sweep import tradeoff
from bstcad.sweep.cold_run import DONE, FAILED, LocalPool, Run, carry_out, judged, kernel
from bstcad.sweep.tradeoff import Knob

EFFORT = Effort(256)
SEED, FEW = (("tailoring.seed", 1),), (("tailoring.stage2_iterations", 2),)
REFUSED = (("lens.back.control_points", 3),)


def few_knobs(scene):
    """The base, which will be run with another seed too, and one setting that is refused."""
    return (
        Knob("quality", "Quality presets", {"draft": ()}),
        Knob("control_points", "Control points a side", {"3": REFUSED, "33": ()}),
    )


def runs_of(table):
    return {run.settings: run for run in table.runs}


def sweep(scene, folder, knobs=few_knobs, machines=None):
    """A sweep with a few knobs."""
    with pytest.MonkeyPatch.context() as patch, LocalPool(1) as pool:
        patch.setattr(tradeoff, "knobs", knobs)
        return tradeoff.tradeoff(scene, folder, budget=1e5, machines=machines or pool, effort=EFFORT)


@pytest.mark.bench  # half a minute; how an interrupted sweep goes on stands in test_tradeoff.py
def test_a_sweep_of_real_runs_has_all_their_figures(tiny, tmp_path):
    found = sweep(tiny, tmp_path / "s")
    assert len(found.runs) == 3 and not found.not_run
    base, seed, refused = (runs_of(found)[point] for point in ((), SEED, REFUSED))
    assert 0 < base.rrmsd == seed.rrmsd < 0.2 and base.rrmsd_noise < base.rrmsd / 2
    assert base.cpu_seconds > 0 and 1 < base.seconds < base.cost_seconds and base.peak_memory_gb > 0.1
    assert base.kernel_seconds > 0 and len(found.history) > 3
    assert [stage["name"] for stage in base.stages][:2] == ["loading", "stage 1"]
    assert refused.status == FAILED and "3 is not between" in refused.reason
    assert found.seeds["least-squares"] is False  # measured: the same net to the last bit
    page = (tmp_path / "s" / "tradeoff.html").read_text()
    assert "3 is not between" in page and "The seed does not matter to L-BFGS" in page


def test_a_run_without_time_is_ended_and_says_so(tiny):
    found = carry_out(scene_files(tiny), (), limit=0.3, effort=EFFORT)
    assert found.status == FAILED and "ended after" in found.reason and found.rrmsd is None


def test_a_lens_tailored_to_other_pixels_is_judged_on_those_of_the_base(small_design):
    """The judge takes the lens from the run's folder, and light and pixels from the base."""
    run, (scene, _) = Run(settings=(), status=DONE), folders.read_nominal(small_design.folder)
    full = judged(run, scene, small_design.folder, EFFORT)
    coarse = judged(run, scene.changed({"target.pixels": [32, 24]}), small_design.folder, EFFORT)
    assert abs(full.rrmsd / small_design.report["rrmsd"] - 1) < 0.1  # fewer rays than its proof
    assert coarse.rrmsd < 0.9 * full.rrmsd  # four pixels in one hide errors within
    assert full.net == coarse.net and len(full.net) == 64


def test_the_kernel_is_the_same_work_each_time():
    found = [kernel(tubes=64)() for _ in range(3)]
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


@pytest.fixture(scope="module")
def scheduler():
    """A scheduler with two workers, each a process of its own."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", host="127.0.0.1"
    ) as local:
        yield local.scheduler_address


def slowly(contents, point, limit, effort):
    """A run that takes a second and no machine."""
    time.sleep(1.0)
    status, error = FAILED if point == REFUSED else DONE, 0.1 if point == FEW else 0.05
    return Run(settings=point, status=status, rrmsd=error, seconds=1.0, cost_seconds=1.0, net="n")


class Slow(Cluster):
    """A cluster that runs `slowly` instead."""

    def start(self, key, work, *arguments):
        super().start(key, slowly, *arguments)


def lose_one(address, keep):
    """Kill the first worker process that is at work on a run, and say which."""
    with distributed.Client(address, set_as_default=False) as client:
        pids, until = client.run(os.getpid), time.monotonic() + 60
        while time.monotonic() < until:
            busy = [worker for worker, tasks in client.processing().items() if tasks]
            if busy:
                time.sleep(0.3)  # it is in the middle of its run
                os.kill(pids[busy[0]], signal.SIGKILL)
                keep.append(busy[0])
                return
            time.sleep(0.05)


@pytest.mark.bench
def test_a_lost_worker_loses_nothing(scheduler, tiny, tmp_path):
    def some_knobs(scene):
        return (*few_knobs(scene), Knob("evaluations", "Evaluations", {"2": FEW, "10": ()}))

    lost = []
    killer = threading.Thread(target=lose_one, args=(scheduler, lost))
    with Slow(scheduler) as machines:
        assert machines.room == 2
        killer.start()
        found = sweep(tiny, tmp_path / "s", some_knobs, machines)
        killer.join()
    assert lost, "no worker was killed in the middle of its run"
    runs = runs_of(found)
    assert {(), FEW, REFUSED} < set(runs) and not found.not_run
    assert runs[()].done and runs[FEW].done and not runs[REFUSED].done
    assert all(run.where.startswith("tcp://") for run in runs.values())
    assert found.errors_alone and not found.front and found.shown == found.lenses


def test_a_worker_runs_the_command_as_this_machine_does(scheduler, tiny):
    with Cluster(scheduler) as machines:
        machines.start(REFUSED, carry_out, scene_files(tiny), REFUSED, 600.0, EFFORT)
        answer = machines.next()
    assert answer.where.startswith("tcp://") and answer.value.version == environment.version()
    assert "3 is not between" in answer.value.reason and 0 < answer.value.seconds < answer.value.cost_seconds
