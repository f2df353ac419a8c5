"""Designs on this machine, some at a time: each a process of its own, which a thread of this one waits for."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

from bstcad.runs.cluster import Answer, cores

HERE = "here"  # where a design came about; else the address of a worker
LOOK = 0.2  # seconds between two looks whether one has ended
CORES = 2  # that a design keeps busy


class Beside:
    """So many processes; those that still work when the block ends are ended, and keep what they have found."""

    def __init__(self, room: int) -> None:
        self.room = room
        self._threads, self._ends = ThreadPoolExecutor(room), threading.Event()
        self._keys: dict[Future, Any] = {}

    def __enter__(self) -> Beside:
        return self

    def __exit__(self, *error: object) -> None:
        self._ends.set()
        self._threads.shutdown(cancel_futures=True)

    def start(self, key: Any, work: Callable[..., Any], *arguments: Any) -> None:
        """Have work(*arguments, tick) done, which is to call `tick` all the while."""
        self._keys[self._threads.submit(work, *arguments, self._tick)] = key

    def next(self, tick: Callable[[], None]) -> Answer:
        """Wait for one that has ended."""
        while True:
            ended = wait(self._keys, timeout=LOOK, return_when=FIRST_COMPLETED).done
            for future in ended:
                key, error = self._keys.pop(future), future.exception()
                if error is not None:
                    return Answer(key, HERE, reason=f"{type(error).__name__}: {error}")
                return Answer(key, HERE, future.result())
            tick()

    def _tick(self) -> None:
        if self._ends.is_set():
            raise InterruptedError("the batch has ended")


def environment(room: int) -> dict[str, str]:
    """Variables of each of so many processes, by which they share the cores; those that are set stay as they are."""
    threads = str(max(1, cores() // room))
    return {name: threads for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS") if name not in os.environ}


def sensible(count: int, memory_gb: float) -> int:
    """How many of `count` designs at a time, each of which may hold so much memory."""
    free = free_memory()
    return max(1, min(count, cores() // CORES, count if free is None else int(free / memory_gb)))


def free_memory() -> float | None:
    """What this machine could give now (GB); None where the system does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return next(int(line.split()[1]) * 1024 / 1e9 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError):
        pages = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else None
        return pages / 1e9 if pages else None
