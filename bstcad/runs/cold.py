"""A bstcad command in a process of its own: how it went and what it used; it does not outlive who wanted it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bstcad

LOOK = 0.02  # seconds between two looks whether it has ended
GRACE = 5.0  # seconds it has to end when asked to


@dataclass(frozen=True)
class Ending:
    """How a process ended."""

    code: int  # its exit code; negative: minus the number of the signal that ended it
    seconds: float
    cpu_seconds: float  # of it and of all processes that it started
    words: str  # what it said on stderr

    @property
    def reason(self) -> str:
        """Why it came to nothing, in a sentence."""
        if self.code < 0:
            name = signal.Signals(-self.code).name
            return f"ended by {name}" + (
                "; the memory of this machine may be too little for it" if self.code == -9 else ""
            )
        lines = [line for line in self.words.splitlines() if line.startswith("bstcad: ") and "warning: " not in line]
        return lines[-1].removeprefix("bstcad: ") if lines else f"exit code {self.code}"


def run(
    arguments: Sequence[str], limit: float = float("inf"), tick: Callable[[], None] = lambda: None,
    environment: Mapping[str, str] | None = None,
) -> Ending:  # fmt: skip
    """`bstcad` with these arguments; killed after `limit` seconds.  What `tick` raises, which is called all the while,
    ends it too.  environment: variables that it has besides those of this process.
    """
    source = str(Path(bstcad.__file__).parent.parent)  # it is to be of these sources, wherever it is started
    paths = os.pathsep.join(filter(None, (source, os.environ.get("PYTHONPATH"))))
    with tempfile.TemporaryFile() as said:
        began = time.perf_counter()
        child = subprocess.Popen(
            [sys.executable, "-m", "bstcad.runs.cold_process", *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=said, start_new_session=True,
            env={**os.environ, **(environment or {}), "PYTHONPATH": paths},
        )  # fmt: skip
        with _ended_with_us(child):
            spent = _waited(child, began + limit, tick)
        seconds = time.perf_counter() - began
        said.seek(0)
        words = said.read().decode(errors="replace")
    return Ending(child.returncode, seconds, spent.ru_utime + spent.ru_stime, words)


@contextlib.contextmanager
def _ended_with_us(child: subprocess.Popen) -> Iterator[None]:
    """Whatever ends the block, the child does not outlive it."""
    try:
        yield
    finally:
        if child.returncode is None:
            _end(child)


def _end(child: subprocess.Popen) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(child.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(GRACE)
            return


def _waited(child: subprocess.Popen, until: float, tick: Callable[[], None]) -> Any:
    """What the child and its own children used (resource.struct_rusage), once it has ended or its time is up."""
    while True:
        pid, status, spent = os.wait4(child.pid, os.WNOHANG)
        if pid:
            child.returncode = os.waitstatus_to_exitcode(status)
            return spent
        if time.perf_counter() > until:
            os.killpg(child.pid, signal.SIGKILL)
            until = float("inf")
        tick()
        time.sleep(LOOK)
