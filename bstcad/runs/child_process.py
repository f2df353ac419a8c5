"""A bstcad command in a child process: how it ended and what it used.  The child does not outlive its parent."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

LOOK = 0.02  # seconds between two looks whether the child has ended
LOOK_UP = 0.5  # seconds between two looks of the child whether its parent is there
GRACE = 5.0  # seconds that a child has to end after SIGTERM
PARENT = "BSTCAD_PARENT"  # environment variable of a child: the number of the process that started it
HERE = "here"  # where work is done on this machine; elsewhere the address of a cluster's worker


@dataclass(frozen=True)
class Ending:
    """How a child ended."""

    code: int  # exit code; -n: signal n ended it
    seconds: float
    cpu_seconds: float  # of the child and of all processes that it started
    stderr: str

    @property
    def reason(self) -> str:
        """Why there is no result, in a sentence."""
        if self.code < 0:
            memory = "; the memory of this machine may be too little for it" if self.code == -signal.SIGKILL else ""
            return f"ended by {signal.Signals(-self.code).name}{memory}"
        lines = [line for line in self.stderr.splitlines() if line.startswith("bstcad: ") and "warning: " not in line]
        return lines[-1].removeprefix("bstcad: ") if lines else f"exit code {self.code}"


def run(
    arguments: Sequence[str],
    limit: float = float("inf"),
    tick: Callable[[], None] = lambda: None,
    environment: Mapping[str, str] | None = None,
) -> Ending:
    """`bstcad` with these arguments, killed after `limit` seconds.

    tick: called while the child works; an exception from it ends the child.  environment: variables besides ours.
    """
    source = str(Path(__file__).parents[2])  # the child runs these sources, wherever it starts
    paths = os.pathsep.join(filter(None, (source, os.environ.get("PYTHONPATH"))))
    with tempfile.TemporaryFile() as stderr:
        began = time.perf_counter()
        child = subprocess.Popen(
            [sys.executable, "-m", "bstcad.cli", *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stderr, start_new_session=True,
            env={**os.environ, **(environment or {}), "PYTHONPATH": paths, PARENT: str(os.getpid())},
        )  # fmt: skip
        try:
            used = _wait(child, began + limit, tick)
        finally:
            if child.returncode is None:
                _end(child)
        seconds = time.perf_counter() - began
        stderr.seek(0)
        return Ending(child.returncode, seconds, used.ru_utime + used.ru_stime, stderr.read().decode(errors="replace"))


def _wait(child: subprocess.Popen, until: float, tick: Callable[[], None]) -> Any:
    """resource.struct_rusage of the child and its own children, after it has ended or was killed at `until`."""
    while True:
        pid, status, used = os.wait4(child.pid, os.WNOHANG)
        if pid:
            child.returncode = os.waitstatus_to_exitcode(status)
            return used
        if time.perf_counter() > until:
            os.killpg(child.pid, signal.SIGKILL)
            until = float("inf")
        tick()
        time.sleep(LOOK)


def _end(child: subprocess.Popen) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(child.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(GRACE)
            return


def end_with_parent() -> None:
    """In a child of `run`: have its process group end when its parent is gone.  Elsewhere nothing."""
    parent = os.environ.pop(PARENT, None)
    if parent is not None and os.getpgrp() == os.getpid():
        threading.Thread(target=_end_with, args=(int(parent),), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_UP)
    os.killpg(0, signal.SIGKILL)
