"""Runs on other machines: a scheduler of dask.distributed hands them out, and their records are kept here as they come.

Each worker has bstcad installed, of the same version, and carries out one run at a time.  A worker that is lost takes
nothing with it: the scheduler gives its run to another one.  Seconds are those of the machine where a run took place,
beside whatever else ran there, so that they do not compare: errors do.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from bstcad.scene.errors import MachineError, SceneError
from bstcad.tradeoff import runs
from bstcad.tradeoff.runs import FAILED, Order, Record

PATIENCE = 30.0  # seconds for the scheduler to answer, and for the first worker to come
LOOK = 0.5  # seconds between two looks whether a run has ended
RETRIES = 2  # of a run whose worker raised an error; those of lost workers are the scheduler's own
INSTALL = "--scheduler: needs dask.distributed, which is not installed; run: pip install 'bstcad[cluster]'"

_one_at_a_time = threading.Lock()  # of a worker process, whatever its number of threads


def carried_out(order: Order) -> Record:
    """On a worker: one run, while others wait."""
    from distributed import get_worker

    with _one_at_a_time:
        return runs.carry_out(replace(order, where=get_worker().address))


class Cluster:
    """The workers of a scheduler at an address such as tcp://10.0.0.1:8786, and what they do with an order."""

    def __init__(self, address: str, patience: float = PATIENCE, work: Callable[[Order], Record] = carried_out) -> None:
        try:
            import distributed
        except ImportError:
            raise SceneError(INSTALL) from None
        self._distributed, self._address, self._work = distributed, address, work
        self._orders: dict[Any, Order] = {}  # by their futures
        try:
            self._client = distributed.Client(address, timeout=patience, set_as_default=False)
        except (OSError, ValueError) as error:  # of which a timeout is one
            reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
            raise SceneError(
                f"--scheduler {address}: no scheduler answers there ({reason}); start one with dask scheduler"
            ) from None
        try:
            self._client.wait_for_workers(1, timeout=patience)
        except (OSError, self._distributed.TimeoutError):
            self.close()
            raise SceneError(
                f"--scheduler {address}: has no workers; start one on each machine with dask worker {address}"
            ) from None

    def close(self) -> None:
        """Leave the scheduler, and what runs there to itself."""
        self._client.close(timeout=LOOK)

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *error: object) -> None:
        self._client.cancel(list(self._orders))
        self.close()

    @property
    def room(self) -> int:
        """How many workers there are now; one at least, which may come back."""
        return max(len(self._client.scheduler_info(n_workers=-1)["workers"]), 1)  # all of them, not the first five

    def prepare(self, scene_of: Mapping[str, bytes], tick: Callable[[], None]) -> None:
        """Nothing: seconds are not compared."""

    def start(self, order: Order) -> None:
        """Hand it to the scheduler."""
        self._check()
        future = self._client.submit(self._work, order, pure=False, retries=RETRIES)
        self._orders[future] = order

    def next(self, tick: Callable[[], None]) -> Record:
        """Wait until one of them has ended."""
        while True:
            for future in [future for future in self._orders if future.done()]:
                order = self._orders.pop(future)
                if future.status in ("cancelled", "lost"):  # the scheduler has forgotten it: once more
                    self.start(order)
                    continue
                return self._record(order, future)
            tick()
            self._check()
            self._pause()

    def _check(self) -> None:
        if self._client.status != "running":
            raise MachineError(f"--scheduler {self._address}: the scheduler is gone; start it again")

    def _pause(self) -> None:
        with contextlib.suppress(TimeoutError, self._distributed.TimeoutError), self._client.as_current():
            self._distributed.wait(list(self._orders), timeout=LOOK, return_when="FIRST_COMPLETED")

    def _record(self, order: Order, future: Any) -> Record:
        """What a future holds: a record, or the reason why there is none."""
        if future.status == "error":
            error = future.exception()
            words = (str(error).splitlines() or [type(error).__name__])[0]
            return Record(order.settings, FAILED, f"{type(error).__name__}: {words}", where=self._address)
        record = future.result()
        if record.version == runs.version():
            return record
        return replace(
            record, status=FAILED, rrmsd=None, version=runs.version(),
            reason=f"{record.where} has another version of bstcad, {record.version}; install {runs.version()} there",
        )  # fmt: skip
