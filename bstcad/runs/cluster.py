"""Work for other processes and other machines: a scheduler of dask.distributed hands it out.

Each worker has bstcad installed, of the same version, and does one thing at a time.  A worker that is lost takes
nothing with it: the scheduler gives its work to another one.
"""

from __future__ import annotations

import contextlib
import logging
import os
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

from bstcad.runs import environment, signals
from bstcad.scene.errors import MachineError, SceneError

PATIENCE = 30.0  # seconds for the scheduler to answer, and for the first worker to come
LOOK = 0.5  # seconds between two looks whether something has ended
RETRIES = 2  # of work over which a worker raised an error; lost workers are the scheduler's own business
INSTALL = "needs dask.distributed, which is not installed; run: pip install 'bstcad[cluster]'"
FORGOTTEN = ("cancelled", "lost")  # of a future: the scheduler knows no more of it
LARGE = {"distributed.admin.large-graph-warning-threshold": "1 GB"}  # what is shared goes there once, and may be large

_one_at_a_time = threading.Lock()  # of a worker process, whatever its number of threads


@cache
def version() -> str:
    """Of the program: its number and a hash of its sources."""
    return environment.version()


@dataclass(frozen=True)
class Answer:
    """What came of a piece of work."""

    key: Any  # under which it was started
    where: str  # the address of the worker; of the scheduler, if none had an answer
    value: Any = None
    reason: str = ""  # why there is no value, in words


@dataclass(frozen=True)
class Piece:
    """A piece of work that is under way."""

    key: Any
    work: Callable[..., Any]
    arguments: tuple[Any, ...]
    shared: Any


def answered(wanted: str, work: Callable[..., Any], *arguments: Any) -> tuple[str, str, Any]:
    """On a worker: (its address, why there is no value, the value)."""
    from distributed import get_worker

    with _one_at_a_time:
        where = get_worker().address
        if version() != wanted:
            return where, f"{where} has another version of bstcad, {version()}; install {wanted} there", None
        return where, "", work(*arguments)


class Machines(Protocol):
    """Where work is done."""

    room: int  # how many pieces at a time

    def start(self, key: Any, work: Callable[..., Any], *arguments: Any) -> None:
        """Begin a piece of work."""

    def next(self, tick: Callable[[], None]) -> Answer:
        """Wait for one that has ended."""


class Cluster:
    """The workers of a scheduler at an address such as tcp://10.0.0.1:8786."""

    def __init__(self, address: str, patience: float = PATIENCE) -> None:
        self._distributed, self.address = _library("--scheduler"), address
        self._pieces: dict[Any, Piece] = {}  # by their futures
        self._held: tuple[Any, Any] = (None, None)  # what is shared, and the future of it there
        try:
            self._client = self._distributed.Client(address, timeout=patience, set_as_default=False)
        except (OSError, ValueError) as error:  # of which a timeout is one
            reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
            raise SceneError(
                f"--scheduler {address}: no scheduler answers there ({reason}); start one with dask scheduler"
            ) from None
        try:
            self._client.wait_for_workers(1, timeout=patience)
        except (OSError, self._distributed.TimeoutError):
            self._close()
            raise SceneError(
                f"--scheduler {address}: has no workers; start one on each machine with dask worker {address}"
            ) from None

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *error: object) -> None:
        self._client.cancel(list(self._pieces))
        self._close()

    def _close(self) -> None:
        """Leave the scheduler, and what runs there to itself."""
        self._client.close(timeout=LOOK)

    @property
    def room(self) -> int:
        """How many workers there are now; one at least, which may come back."""
        return max(len(self._client.scheduler_info(n_workers=-1)["workers"]), 1)  # all of them, not the first five

    def start(self, key: Any, work: Callable[..., Any], *arguments: Any, shared: Any = None) -> None:
        """Have work(*arguments) done on a worker, or work(shared, *arguments), `shared` being sent once for many."""
        self._submit(Piece(key, work, arguments, shared))

    def next(self, tick: Callable[[], None] = lambda: None) -> Answer:
        """Wait for the next answer; `tick` is called meanwhile.  MachineError if the scheduler goes away."""
        while True:
            for future in [future for future in self._pieces if future.done()]:
                piece = self._pieces.pop(future)
                if future.status in FORGOTTEN:
                    self._submit(piece)
                    continue
                return self._answer(piece, future)
            tick()
            self._check()
            self._pause()

    def spread(self, work: Callable[[Any, Any], Any], shared: Any, items: Sequence[Any]) -> Iterator[Any]:
        """work(shared, item) of each item, in their order; MachineError if one has no value."""
        for k, item in enumerate(items):
            self.start(k, work, item, shared=shared)
        found: dict[int, Any] = {}
        for k in range(len(items)):
            while k not in found:
                answer = self.next()
                if answer.reason:
                    raise MachineError(f"{self.address}: a worker could not do its part ({answer.reason})")
                found[answer.key] = answer.value
            yield found.pop(k)

    def _submit(self, piece: Piece) -> None:
        self._check()
        with _set(LARGE):
            first = () if piece.shared is None else (self._hold(piece.shared),)
            future = self._client.submit(
                answered, version(), piece.work, *first, *piece.arguments, pure=False, retries=RETRIES
            )
        self._pieces[future] = piece

    def _hold(self, shared: Any) -> Any:
        """The future of a value that workers hold.  The scheduler keeps it too, so that lost workers do not matter."""
        if self._held[0] is not shared or self._held[1].status in FORGOTTEN:
            self._held = shared, self._client.submit(_itself, shared, pure=False)
        return self._held[1]

    def _check(self) -> None:
        if self._client.status != "running":
            raise MachineError(f"--scheduler {self.address}: the scheduler is gone; start it again")

    def _pause(self) -> None:
        with contextlib.suppress(TimeoutError, self._distributed.TimeoutError), self._client.as_current():
            self._distributed.wait(list(self._pieces), timeout=LOOK, return_when="FIRST_COMPLETED")

    def _answer(self, piece: Piece, future: Any) -> Answer:
        if future.status == "error":
            error = future.exception()
            words = (str(error).splitlines() or [type(error).__name__])[0]
            return Answer(piece.key, self.address, reason=f"{type(error).__name__}: {words}")
        where, reason, value = future.result()
        return Answer(piece.key, where, value, reason)


@contextlib.contextmanager
def local(workers: int) -> Iterator[Cluster]:
    """So many workers on this machine, which share its cores and leave with the block."""
    distributed = _library("--workers")
    if workers < 1:
        raise SceneError(f"--workers {workers}: none can do no work; give 1 or more")
    threads = str(max(1, cores() // workers))
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place, contextlib.ExitStack() as stack:
        with signals.unheard_by_children():
            started = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1",
                    dashboard_address="127.0.0.1:0", memory_limit=0, local_directory=place,
                    silence_logs=logging.CRITICAL,
                    env={name: threads for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")},
                )
            )  # fmt: skip
        yield stack.enter_context(Cluster(started.scheduler_address))


def cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _itself(value: Any) -> Any:
    return value


def _set(settings: dict[str, str]) -> contextlib.AbstractContextManager:
    """Settings of dask, within a block."""
    import dask

    return dask.config.set(settings)


def _library(option: str) -> Any:
    try:
        import distributed
    except ImportError:
        raise SceneError(f"{option}: {INSTALL}") from None
    return distributed
