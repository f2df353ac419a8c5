"""Work for other processes and other machines, handed out by a scheduler of dask.distributed.

Each worker has bstcad installed, of the same version, and does one piece of work at a time.  The scheduler gives the
work of a lost worker to another worker.
"""

from __future__ import annotations

import contextlib
import logging
import tempfile
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from bstcad.runs import environment, signals
from bstcad.runs.files import MachineError, SceneError, first_line

PATIENCE = 30.0  # seconds for the scheduler to answer, and for the first worker to come
LOOK = 0.5  # seconds between two looks whether some work has ended
RETRIES = 2  # of work over which a worker raised an error
MOST_WORKERS = 1000
HERE = "here"  # where work is done on this machine; elsewhere the address of a worker

_one_at_a_time = threading.Lock()  # of a worker process, whatever its number of threads


@dataclass(frozen=True)
class Answer:
    """The result of a piece of work."""

    key: Any  # under which the work was started
    where: str  # HERE, or the address of the worker (of the scheduler, where no worker answered)
    value: Any = None
    reason: str = ""  # why there is no value, in words


class Machines(Protocol):
    """Processes that do work."""

    @property
    def room(self) -> int:
        """Pieces of work at a time."""

    def start(self, key: Any, work: Callable[..., Any], *arguments: Any) -> None:
        """Begin a piece of work."""

    def next(self, tick: Callable[[], None]) -> Answer:
        """Wait for a piece of work that has ended."""


@contextlib.contextmanager
def asked_for(scheduler: str | None, workers: int | None = None) -> Iterator[Cluster | None]:
    """The workers of a scheduler, or `workers` processes here, which end with the block; None without either."""
    check(scheduler, workers)
    with contextlib.ExitStack() as stack:
        address = scheduler
        if workers is not None:
            address = stack.enter_context(_local(workers))
        yield None if address is None else stack.enter_context(Cluster(address))


def check(scheduler: str | None, workers: int | None) -> None:
    """SceneError for impossible values of these options."""
    if scheduler is not None and workers is not None:
        raise SceneError("--workers: are started on this machine, and --scheduler has its own; give one of the two")
    if workers is not None and not 1 <= workers <= MOST_WORKERS:
        raise SceneError(f"--workers {workers}: is not between 1 and {MOST_WORKERS}; give a number of processes")


@contextlib.contextmanager
def _local(workers: int) -> Iterator[str]:
    """The address of a scheduler with worker processes on this machine, which share its cores."""
    distributed = _library("--workers")
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place, contextlib.ExitStack() as stack:
        with signals.unheard_by_children():
            started = distributed.LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1",
                dashboard_address="127.0.0.1:0", memory_limit=0, local_directory=place,
                silence_logs=logging.CRITICAL, env=environment.threads(workers),
            )  # fmt: skip
            stack.enter_context(started)
        yield started.scheduler_address


class Cluster:
    """The workers of a scheduler at an address such as tcp://10.0.0.1:8786."""

    def __init__(self, address: str, patience: float = PATIENCE) -> None:
        self._distributed, self.address = _library("--scheduler"), address
        self._keys: dict[Any, Any] = {}  # by future
        try:
            self._client = self._distributed.Client(address, timeout=patience, set_as_default=False)
        except (OSError, ValueError) as error:  # of which a timeout is one
            raise SceneError(
                f"--scheduler {address}: no scheduler answers ({first_line(error)}); start one with dask scheduler"
            ) from None
        try:
            self._client.wait_for_workers(1, timeout=patience)
        except (OSError, self._distributed.TimeoutError):
            self._client.close(timeout=LOOK)
            raise SceneError(
                f"--scheduler {address}: has no workers; start one on each machine with dask worker {address}"
            ) from None

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *error: object) -> None:
        self._client.cancel(list(self._keys))
        self._client.close(timeout=LOOK)

    @property
    def room(self) -> int:
        """The number of workers now, or 1 where all are lost: one may come back."""
        return max(len(self._client.scheduler_info(n_workers=-1)["workers"]), 1)  # all of them, not the first five

    def start(self, key: Any, work: Callable[..., Any], *arguments: Any) -> None:
        """Have work(*arguments) done by a worker."""
        self._check()
        version = environment.version()
        future = self._client.submit(answer, version, key, work, *arguments, pure=False, retries=RETRIES)
        self._keys[future] = key

    def next(self, tick: Callable[[], None] = lambda: None) -> Answer:
        """Wait for the next answer; `tick` is called meanwhile.  MachineError if the scheduler goes away."""
        return self._ended(self._keys, tick)

    def _ended(self, futures: Collection[Any], tick: Callable[[], None] = lambda: None) -> Answer:
        """The answer of the first of these futures that is done."""
        while True:
            for future in [future for future in futures if future.done()]:
                return self._answer(self._keys.pop(future), future)
            tick()
            self._check()
            with contextlib.suppress(TimeoutError, self._distributed.TimeoutError), self._client.as_current():
                self._distributed.wait(list(futures), timeout=LOOK, return_when="FIRST_COMPLETED")

    def spread(self, work: Callable[[Any, Any], Any], shared: Any, items: Sequence[Any]) -> Iterator[Any]:
        """work(shared, item) of each item, in their order; MachineError if a worker fails.

        `shared` is sent once.  The scheduler keeps it, unlike scattered data, so that it outlives lost workers.
        """
        import dask

        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GB"}):
            held = self._client.submit(lambda value: value, shared, pure=False)
        for item in items:
            self.start(None, work, held, item)
        for future in list(self._keys):
            answered = self._ended([future])
            if answered.reason:
                raise MachineError(f"{self.address}: a worker could not do its part ({answered.reason})")
            yield answered.value

    def _check(self) -> None:
        if self._client.status != "running":
            raise MachineError(f"--scheduler {self.address}: the scheduler is gone; start it again")

    def _answer(self, key: Any, future: Any) -> Answer:
        if future.status == "cancelled":  # by a scheduler that was started again
            raise MachineError(f"--scheduler {self.address}: the scheduler has lost its work; give the command again")
        if future.status == "error":
            error = future.exception()
            return Answer(key, self.address, reason=f"{type(error).__name__}: {first_line(error)}")
        return future.result()


def answer(wanted: str, key: Any, work: Callable[..., Any], *arguments: Any) -> Answer:
    """Do the work in a worker, if its bstcad is of the version `wanted`."""
    from distributed import get_worker

    with _one_at_a_time:
        where, version = get_worker().address, environment.version()
        if version != wanted:
            reason = f"{where} has another version of bstcad, {version}; install {wanted} there"
            return Answer(key, where, reason=reason)
        return Answer(key, where, work(*arguments))


def _library(option: str) -> Any:
    try:
        import distributed
    except ImportError:
        raise SceneError(
            f"{option}: needs dask.distributed, which is not installed; run: pip install 'bstcad[cluster]'"
        ) from None
    return distributed
