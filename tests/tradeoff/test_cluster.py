"""Runs that spread over workers of dask.distributed, one of which is lost on the way."""

import os
import signal
import threading
import time
from types import SimpleNamespace

import distributed
import pytest

from bstcad.runs.cluster import Answer, Cluster
from bstcad.tradeoff import command, runs
from bstcad.tradeoff.cluster import Workers
from bstcad.tradeoff.knobs import Knob, Point
from tests.tradeoff.test_runs import EFFORT, REFUSED, few_knobs

FEW = (("tailoring.stage2_iterations", 2),)


def some_knobs(scene):
    """Four runs."""
    return (*few_knobs(scene), Knob("evaluations", "Evaluations", (Point("2", FEW), Point("10", ()))))


@pytest.fixture(scope="module")
def scheduler():
    """The address of a scheduler with two workers, each a process of its own."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", host="127.0.0.1"
    ) as local:
        yield local


def slowly(order):
    """A run that takes a second and no machine."""
    time.sleep(1.0)
    status = runs.FAILED if order.settings == REFUSED else runs.DONE
    error = 0.1 if order.settings == FEW else 0.05
    return runs.Record(
        order.settings, status, rrmsd=error, rrmsd_noise=0.001, rays=10**6, seconds=1.0, cost_seconds=1.0, net="n",
        kernel_seconds=0.1, version=runs.version(),
    )  # fmt: skip


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
    lost = []
    killer = threading.Thread(target=lose_one, args=(scheduler.scheduler_address, lost))
    with Cluster(scheduler.scheduler_address) as cluster:
        machines = Workers(cluster, slowly)
        assert machines.room == 2
        killer.start()
        found = command.tradeoff(tiny, tmp_path / "s", budget=600.0, machines=machines, turn=some_knobs)
        killer.join()
    assert lost, "no worker was killed in the middle of its run"
    records = found.sweep.records
    assert {(), FEW, REFUSED} < set(records) and not found.sweep.not_run
    assert records[()].done and records[FEW].done and not records[REFUSED].done
    assert all(r.where.startswith("tcp://") for r in records.values())
    assert records[()].rrmsd < records[FEW].rrmsd
    assert found.errors_alone and not found.compared and not found.front  # seconds of other machines do not compare
    assert set(found.shown) == {point for point, r in records.items() if r.done}


def test_a_worker_runs_the_command_as_this_machine_does(scheduler, tiny):
    with Cluster(scheduler.scheduler_address) as cluster:
        machines = Workers(cluster)
        machines.start(runs.Order(runs.scene_files(tiny), REFUSED, effort=EFFORT))
        found = machines.next(lambda: None)
    assert "3 is not between" in found.reason and found.where.startswith("tcp://")
    assert found.version == runs.version() and 0 < found.seconds < found.cost_seconds


def test_work_that_a_worker_could_not_do_is_a_failed_run():
    workers = Workers(SimpleNamespace(next=lambda tick: Answer(runs.Order({}, FEW), "tcp://there", reason="no disk")))
    found = workers.next(lambda: None)
    assert (found.settings, found.status, found.reason, found.where) == (FEW, "failed", "no disk", "tcp://there")
