"""Work that spreads over workers of dask.distributed: answers, errors, other versions, lost workers."""

import sys
from unittest import mock

import distributed
import pytest

from bstcad.runs import cluster, environment
from bstcad.runs.cluster import Cluster
from bstcad.runs.files import MachineError, SceneError


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
        Cluster("tcp://127.0.0.1:9", patience=1.0)
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as empty,
        pytest.raises(SceneError, match="dask worker"),
    ):
        Cluster(empty.scheduler_address, patience=1.0)
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
    [("pending", "closed", "has ended"), ("cancelled", "running", "has lost its jobs")],
)
def test_a_scheduler_that_goes_away_is_a_sentence(future, client, sentence):
    waiting, submitted = object.__new__(Cluster), mock.Mock(status=future)
    submitted.done.return_value = future != "pending"
    waiting._keys, waiting.address, waiting._client = {submitted: "a"}, "tcp://here", mock.Mock(status=client)
    with pytest.raises(MachineError, match=f"the scheduler {sentence}"):
        waiting.next()
