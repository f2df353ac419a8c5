"""Work that spreads over workers of dask.distributed: answers, errors, other versions, what is lost on the way."""

import contextlib
import sys
from unittest import mock

import distributed
import pytest

from bstcad.runs import cluster
from bstcad.runs.cluster import Cluster, Piece
from bstcad.scene.errors import MachineError, SceneError


def add(shared, number):
    if number < 0:
        raise ValueError("no disk")
    return shared["more"] + number


@pytest.fixture(scope="module")
def address():
    """Of a scheduler with two workers, threads of this process."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0"
    ) as local:
        yield local.scheduler_address


def test_results_come_in_the_order_of_the_items(address):
    with Cluster(address) as found:
        assert found.room == 2
        for more in (10, 20):  # another thing is shared after the first
            assert list(found.spread(add, {"more": more}, range(20))) == list(range(more, more + 20))


def test_an_error_on_a_worker_is_told_with_the_work_that_it_was(address):
    with Cluster(address) as found:
        found.start("a", add, -1, shared={"more": 1})
        found.start("b", add, 1, shared={"more": 1})
        answers = {answer.key: answer for answer in (found.next(), found.next())}
        assert answers["a"].reason == "ValueError: no disk" and answers["a"].value is None
        assert (answers["b"].reason, answers["b"].value) == ("", 2) and answers["b"].where.startswith("inproc://")
        with pytest.raises(MachineError, match=r"a worker could not do its part \(ValueError: no disk\)"):
            list(found.spread(add, {"more": 1}, [1, -1]))


def test_a_worker_of_another_version_does_no_work(address, monkeypatch):
    versions = iter(["2", "1", "1"])  # of whoever asks; of the worker, which says it twice
    monkeypatch.setattr(cluster, "version", lambda: next(versions))
    with Cluster(address) as found:
        found.start("a", add, 1, shared={"more": 1})
        assert "has another version of bstcad, 1; install 2 there" in found.next().reason


def test_a_scheduler_that_is_not_there_is_a_sentence():
    with pytest.raises(SceneError, match=r"--scheduler tcp://127.0.0.1:9: no scheduler answers there .*; start one"):
        Cluster("tcp://127.0.0.1:9", patience=1.0)


def test_a_scheduler_without_workers_is_a_sentence():
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as empty,
        pytest.raises(SceneError, match="has no workers; start one"),
    ):
        Cluster(empty.scheduler_address, patience=1.0)


def test_without_the_library_a_sentence_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SceneError, match=r"--scheduler: .* pip install 'bstcad\[cluster\]'"):
        Cluster("tcp://127.0.0.1:9")
    with pytest.raises(SceneError, match=r"--workers: .* pip install 'bstcad\[cluster\]'"), cluster.local(2):
        pass


class Future:
    """One that has ended, or does not."""

    def __init__(self, status, result=None):
        self.status, self._result = status, result

    def done(self):
        return self.status != "pending"

    def result(self):
        return self._result


def waiting_for(*futures, status="running"):
    """A cluster that waits for the first of these futures, and whose scheduler hands out the others from then on."""
    found, (first, *others) = object.__new__(Cluster), futures
    shared = {"more": 1}
    found._pieces, found.address, found._held = {first: Piece("a", add, (1,), shared)}, "tcp://here", (None, None)
    found._client = mock.Mock(status=status, as_current=contextlib.nullcontext)
    found._client.submit.side_effect = others
    found._distributed = mock.Mock(TimeoutError=TimeoutError)
    return found


def test_what_the_scheduler_forgot_is_done_again_with_what_was_shared():
    held, again = Future("finished"), Future("finished", ("tcp://there", "", 2))
    assert waiting_for(Future("lost"), held, again).next().value == 2
    found = waiting_for(Future("lost"), held, again)
    found._held = found._pieces[next(iter(found._pieces))].shared, Future("cancelled")  # so that it is sent anew
    assert found.next().value == 2


def test_a_scheduler_that_goes_away_is_a_sentence():
    with pytest.raises(MachineError, match="the scheduler is gone"):
        waiting_for(Future("pending"), status="closed").next()
