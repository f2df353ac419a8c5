"""Work that spreads over workers of dask.distributed: answers, errors, other versions, lost workers."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import distributed
import pytest
from distributed.comm import CommClosedError

from bstcad.runs import cluster, environment
from bstcad.runs.cluster import Cluster
from bstcad.runs.files import MachineError, SceneError

ROOT = Path(__file__).parent.parent.parent


def add(shared, number):
    if number < 0:
        raise ValueError("no disk")
    return shared["more"] + number


@pytest.fixture(scope="module")
def address():
    """Return the address of a scheduler with two workers, threads of this process."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0"
    ) as local:
        yield local.scheduler_address


def test_results_come_in_the_order_of_the_items(address):
    with Cluster(address) as found:
        assert found.capacity == 2
        for more in (10, 20):  # another thing is shared after the first
            assert list(found.spread(add, {"more": more}, range(20))) == list(range(more, more + 20))


def test_an_error_on_a_worker_is_told_with_the_work_that_it_was(address):
    with Cluster(address) as found:
        found.start("a", add, {"more": 1}, -1)
        found.start("b", add, {"more": 1}, 1)
        answers = {answer.key: answer for answer in (found.next(), found.next())}
        assert answers["a"].reason == "ValueError: no disk" and answers["a"].value is None
        assert (answers["b"].reason, answers["b"].value) == ("", 2) and answers["b"].where.startswith("inproc://")
        with pytest.raises(MachineError, match=r"a worker failed \(ValueError: no disk\)"):
            list(found.spread(add, {"more": 1}, [1, -1]))


def test_a_worker_of_another_version_does_no_work(address, monkeypatch):
    versions = iter(["2", "1"])  # of this process, of the worker
    monkeypatch.setattr(environment, "version", lambda: next(versions))
    with Cluster(address) as found:
        found.start("a", add, {"more": 1}, 1)
        assert "has version 1 of bstcad; install 2 there" in found.next().reason


def test_what_cannot_be_had_is_a_sentence(monkeypatch):
    with pytest.raises(SceneError, match="--scheduler tcp://127.0.0.1:9: "):
        Cluster("tcp://127.0.0.1:9", patience=0.3)
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as empty,
        pytest.raises(SceneError, match="dask worker"),
    ):
        Cluster(empty.scheduler_address, patience=0.3)
    monkeypatch.setitem(sys.modules, "distributed", None)
    library = r"pip install 'bstcad\[cluster\]'"
    for scheduler, workers, sentence in (
        ("tcp://127.0.0.1:9", None, f"--scheduler: .* {library}"),
        (None, 2, f"--workers: .* {library}"),
        (None, 0, "--workers 0: is not between 1 and 1000"),
        ("tcp://127.0.0.1:9", 2, "give one of the two"),
    ):
        with pytest.raises(SceneError, match=sentence), cluster.connect(scheduler, workers):
            pass
    with cluster.connect(None) as found:
        assert found is None


@pytest.mark.parametrize(
    ("future", "client", "sentence"),
    [
        ("pending", "closed", "has ended"),
        ("cancelled", "connecting", "has ended"),
        ("cancelled", "running", "has lost its jobs"),
    ],
)
def test_a_scheduler_that_goes_away_is_a_sentence(future, client, sentence):
    waiting, submitted = object.__new__(Cluster), mock.Mock(status=future)
    submitted.done.return_value = future != "pending"
    waiting._keys, waiting.address, waiting._client = {submitted: "a"}, "tcp://here", mock.Mock(status=client)
    waiting._distributed = distributed
    with pytest.raises(MachineError, match=f"the scheduler {sentence}"):
        waiting.next()


@pytest.fixture
def scheduler(tmp_path):
    """Start a scheduler and a worker in processes of their own; yield address and process of the scheduler."""
    command, started = [sys.executable, "-m", "distributed.cli.dask_scheduler"], []
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(tmp_path / "at.json")]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--nthreads", "1", "--no-dashboard", "--no-nanny"]
    quiet = {"cwd": tmp_path, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    try:
        started.append(subprocess.Popen([*command, *options], **quiet))
        for _ in range(300):
            if (tmp_path / "at.json").exists() and (text := (tmp_path / "at.json").read_text()):
                break
            time.sleep(0.1)
        address = json.loads(text)["address"]
        started.append(subprocess.Popen([*worker, address], **quiet, env={**os.environ, "PYTHONPATH": str(ROOT)}))
        yield address, started[0]
    finally:
        for process in started:
            process.kill()
            process.wait()


def test_a_killed_scheduler_ends_in_a_sentence(scheduler):
    address, process = scheduler
    with pytest.raises(MachineError, match="the scheduler has ended; start it again"), Cluster(address) as found:
        found.start("a", time.sleep, 300)
        process.kill()
        process.wait()
        found.next()


@pytest.mark.parametrize("fault", [CommClosedError("closed"), ConnectionResetError(104, "reset"), OSError()])
@pytest.mark.parametrize("asked", ["submit", "scheduler_info", "wait", "cancel"])
def test_a_lost_connection_is_a_sentence_wherever_it_is_found(monkeypatch, fault, asked):
    found, pending = object.__new__(Cluster), mock.Mock(status="pending", done=lambda: False)
    client = mock.MagicMock(status="running", **({f"{asked}.side_effect": fault} if asked != "wait" else {}))
    found._keys, found.address, found._client = {pending: "a"}, "tcp://here", client
    found._distributed = mock.Mock(wraps=distributed, TimeoutError=distributed.TimeoutError, client=distributed.client)
    found._distributed.wait.side_effect = fault
    with pytest.raises(MachineError, match="the scheduler has ended"), found:
        if asked == "submit":
            found.start("a", add)
        elif asked == "scheduler_info":
            assert found.capacity
        found.next()
    assert client.close.called
