"""Jobs for other processes and other machines, distributed by a scheduler of dask.distributed.

Each worker must have the same version of bstcad as this process, and does one job at a time.  The scheduler gives the
jobs of a lost worker to another worker.
"""

from __future__ import annotations

import contextlib
import logging
import tempfile
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from typing import Any, Protocol

from bstcad.runs import environment, signals
from bstcad.runs.files import MachineError, SceneError, first_line

CONNECTION_TIMEOUT = 30.0  # longest time (s) to wait for the scheduler's answer, and then for a first worker
JOB_INTERVAL = 0.5  # time (s) between two checks for finished jobs
RETRIES = 2  # number of times that a job which raised an error on a worker is done again
MAX_WORKERS = 1000  # largest value of --workers
THIS_MACHINE = "here"  # value of `Answer.where` for a job on this machine; otherwise the address of a worker

_one_at_a_time = threading.Lock()  # limits a worker process to one job, whatever its number of threads


@dataclass(frozen=True)
class Answer:
    """Result of a job, or the reason why it failed."""

    key: Any  # key with which the job was started
    where: str  # THIS_MACHINE, or the address of the worker (of the scheduler, if no worker answered)
    value: Any = None  # result; None if the job failed
    reason: str = ""  # reason why the job failed; "": it has a result


class Machines(Protocol):
    """Interface of processes that do jobs, such as `Cluster`."""

    @property
    def capacity(self) -> int:
        """Largest number of jobs that run at the same time."""

    def start(self, key: Any, work: Callable[..., Any], *arguments: Any) -> None:
        """Start the job work(*arguments); key: value by which its Answer is recognised."""

    def next(self, tick: Callable[[], None]) -> Answer:
        """Wait until a job ends, calling `tick` regularly, and return its answer."""


@contextlib.contextmanager
def connect(scheduler: str | None, workers: int | None = None) -> Iterator[Cluster | None]:
    """Yield a Cluster of the scheduler at this address, or of `workers` local processes; None if both are None."""
    check(scheduler, workers)
    with contextlib.ExitStack() as stack:
        address = scheduler
        if workers is not None:
            address = stack.enter_context(_local(workers))
        yield None if address is None else stack.enter_context(Cluster(address))


def check(scheduler: str | None, workers: int | None) -> None:
    """Raise SceneError for invalid values of the options --scheduler and --workers."""
    if scheduler is not None and workers is not None:
        raise SceneError("--workers and --scheduler: exclude each other; give one of the two")
    if workers is not None and not 1 <= workers <= MAX_WORKERS:
        raise SceneError(f"--workers {workers}: is not between 1 and {MAX_WORKERS}; give a number of processes")


@contextlib.contextmanager
def _local(workers: int) -> Iterator[str]:
    """Yield the address of a local scheduler with this number of worker processes, which share the cores."""
    distributed = _library("--workers")
    local = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL}
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place, contextlib.ExitStack() as stack:
        process = {"memory_limit": 0, "local_directory": place, "env": environment.threads(workers)}
        with signals.ignored_by_children():
            started = distributed.LocalCluster(n_workers=workers, threads_per_worker=1, **local, **process)
            stack.enter_context(started)
        yield started.scheduler_address


class Cluster:
    """Workers of a scheduler at an address such as tcp://10.0.0.1:8786; patience (s): see CONNECTION_TIMEOUT."""

    def __init__(self, address: str, patience: float = CONNECTION_TIMEOUT) -> None:
        self._distributed, self.address = _library("--scheduler"), address
        self._keys: dict[Any, Any] = {}  # key of a job by its future
        try:
            self._client = self._distributed.Client(address, timeout=patience, set_as_default=False)
        except (OSError, ValueError) as error:  # a timeout is an OSError
            raise SceneError(
                f"--scheduler {address}: no scheduler answers ({first_line(error)}); start one with: dask scheduler"
            ) from None
        try:
            self._client.wait_for_workers(1, timeout=patience)
        except (OSError, self._distributed.TimeoutError):
            self._client.close(timeout=JOB_INTERVAL)
            raise SceneError(
                f"--scheduler {address}: has no workers; start one on each machine with dask worker {address}"
            ) from None

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(*self._lost):
            if self._client.status == "running":  # else no scheduler has jobs, and an answer would be awaited for long
                self._client.cancel(list(self._keys))
        with contextlib.suppress(*self._lost):
            self._client.close(timeout=JOB_INTERVAL)

    @property
    def _lost(self) -> tuple[type[BaseException], ...]:
        """Errors of a connection whose scheduler has ended; CommClosedError of distributed is an OSError."""
        return OSError, CancelledError, self._distributed.TimeoutError, self._distributed.client.ClosedClientError

    @contextlib.contextmanager
    def _connection(self) -> Iterator[None]:
        """Raise MachineError if the scheduler has ended, or ends within the block."""
        ended = f"--scheduler {self.address}: the scheduler has ended; start it again"
        if self._client.status != "running":
            raise MachineError(ended)
        try:
            yield
        except self._lost as error:
            raise MachineError(ended) from error

    @property
    def capacity(self) -> int:
        """Current number of workers; 1 if all are lost, since one may come back."""
        with self._connection():
            workers = self._client.scheduler_info(n_workers=-1)["workers"]  # all of them, not the first five
        return max(len(workers), 1)

    def start(self, key: Any, work: Callable[..., Any], *arguments: Any) -> None:
        """Start the job work(*arguments) on a worker; key: as in Machines."""
        version = environment.version()
        with self._connection():
            future = self._client.submit(answer, version, key, work, *arguments, pure=False, retries=RETRIES)
        self._keys[future] = key

    def next(self, tick: Callable[[], None] = lambda: None) -> Answer:
        """Wait until a job ends, calling `tick` regularly; return its answer.  MachineError if the scheduler ends."""
        return self._ended(self._keys, tick)

    def _ended(self, futures: Collection[Any], tick: Callable[[], None] = lambda: None) -> Answer:
        """Wait until one of these futures of jobs is done, calling `tick` regularly, and return its answer."""
        while True:
            for future in [future for future in futures if future.done()]:
                return self._answer(self._keys.pop(future), future)
            tick()
            timeout = contextlib.suppress(TimeoutError, self._distributed.TimeoutError)
            with self._connection(), timeout, self._client.as_current():
                self._distributed.wait(list(futures), timeout=JOB_INTERVAL, return_when="FIRST_COMPLETED")

    def spread(self, work: Callable[[Any, Any], Any], shared: Any, items: Sequence[Any]) -> Iterator[Any]:
        """Yield work(shared, item) for each item, in order.  MachineError if a worker fails.

        `shared` is sent once, as the result of a job, which the scheduler repeats if the worker with it is lost.
        """
        import dask

        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GB"}), self._connection():
            stored = self._client.submit(lambda value: value, shared, pure=False)
        for item in items:
            self.start(None, work, stored, item)
        for future in list(self._keys):
            answered = self._ended([future])
            if answered.reason:
                raise MachineError(f"{self.address}: a worker failed ({answered.reason}); run the command again")
            yield answered.value

    def _answer(self, key: Any, future: Any) -> Answer:
        if future.status == "cancelled":  # the client cancels every job when it loses its scheduler
            with self._connection():
                lost = f"--scheduler {self.address}: the scheduler has lost its jobs; run the command again"
                raise MachineError(lost)
        if future.status == "error":
            error = future.exception()
            return Answer(key, self.address, reason=f"{type(error).__name__}: {first_line(error)}")
        with self._connection():
            return future.result()


def answer(wanted: str, key: Any, work: Callable[..., Any], *arguments: Any) -> Answer:
    """Return the Answer of work(*arguments) on this worker; a failure if its version of bstcad is not `wanted`."""
    from distributed import get_worker

    with _one_at_a_time:
        where, version = get_worker().address, environment.version()
        if version != wanted:
            reason = f"{where} has version {version} of bstcad; install {wanted} there"
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
