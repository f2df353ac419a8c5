"""Runs that spread over workers of dask.distributed, one of which is lost on the way."""

import contextlib
import os
import signal
import sys
import threading
import time
from unittest import mock

import distributed
import pytest

from bstcad.scene.errors import MachineError, SceneError
from bstcad.tradeoff import cluster, command, runs
from bstcad.tradeoff.cluster import Cluster
from bstcad.tradeoff.knobs import Knob, Point
from tests.tradeoff.synthetic import record
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
    where, status = distributed.get_worker().address, runs.FAILED if order.settings == REFUSED else runs.DONE
    error = 0.1 if order.settings == FEW else 0.05
    return runs.Record(
        order.settings, status, rrmsd=error, rrmsd_noise=0.001, tubes=131**2, seconds=1.0, cost_seconds=1.0, net="n",
        kernel_seconds=0.1, where=where, version=runs.version(),
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


def test_a_lost_worker_loses_nothing(scheduler, tiny, tmp_path):
    lost = []
    killer = threading.Thread(target=lose_one, args=(scheduler.scheduler_address, lost))
    with Cluster(scheduler.scheduler_address, work=slowly) as machines:
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
    with Cluster(scheduler.scheduler_address) as machines:
        machines.start(runs.Order(runs.scene_files(tiny), REFUSED, effort=EFFORT))
        found = machines.next(lambda: None)
    assert "3 is not between" in found.reason and found.where.startswith("tcp://")
    assert found.version == runs.version() and 0 < found.seconds < found.cost_seconds


def test_a_scheduler_that_is_not_there_is_a_sentence():
    with pytest.raises(SceneError, match=r"--scheduler tcp://127.0.0.1:9: no scheduler answers there .*; start one"):
        Cluster("tcp://127.0.0.1:9", patience=1.0)


def test_a_scheduler_without_workers_is_a_sentence():
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=":0") as empty,
        pytest.raises(SceneError, match="has no workers; start one"),
    ):
        Cluster(empty.scheduler_address, patience=1.0)


def test_without_the_library_a_sentence_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SceneError, match=r"pip install 'bstcad\[cluster\]'"):
        Cluster("tcp://127.0.0.1:9")


class Ended:
    """A future that has ended."""

    def __init__(self, status, value=None):
        self.status, self.value = status, value

    def done(self):
        return True

    def exception(self):
        return self.value

    def result(self):
        return self.value


def with_future(future, status="running"):
    """A cluster that waits for one future."""
    found = object.__new__(Cluster)
    found._orders, found._address = {future: runs.Order({}, FEW)}, "tcp://here"
    found._client = mock.Mock(status=status, as_current=contextlib.nullcontext)
    found._client.submit.return_value = again
    found._distributed, found._work = mock.Mock(TimeoutError=TimeoutError), None
    return found


again = Ended("finished")


def test_an_error_on_a_worker_is_the_reason_of_a_failed_run():
    found = with_future(Ended("error", RuntimeError("no disk"))).next(lambda: None)
    assert (found.settings, found.status, found.reason) == (FEW, "failed", "RuntimeError: no disk")


def test_a_worker_of_another_version_does_not_count(tiny):
    found = with_future(Ended("finished", record(tiny, FEW, "tcp://there"))).next(lambda: None)
    assert found.status == "failed" and "tcp://there has another version of bstcad, 1;" in found.reason


def test_what_the_scheduler_forgot_is_run_again(tiny, monkeypatch):
    monkeypatch.setattr(cluster.runs, "version", lambda: "1")
    again.value = record(tiny, FEW, "tcp://there")
    assert with_future(Ended("lost")).next(lambda: None) == again.value


def test_a_scheduler_that_goes_away_is_a_sentence():
    waiting = Ended("pending")
    waiting.done = lambda: False
    with pytest.raises(MachineError, match="the scheduler is gone"):
        with_future(waiting, "closed").next(lambda: None)
