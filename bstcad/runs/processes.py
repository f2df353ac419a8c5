"""Processes beside this one: the second process, for OCC and for drawing, and bstcad commands as child processes.

While the lens is still being tailored, the second process loads OCC; a damaged file that makes OCC end its process does
not end the user's.  It starts at the first `submit`, imports nothing of the user's script, serves all designs of a
session, and ends after a long idle time.  No process outlives its parent.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import importlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bstcad.runs.signals import TERMINAL, unheard_by_children

LOOK = 0.5  # seconds between two looks for the parent


def runs(process: int) -> bool:
    """Is there a process of this number?"""
    import psutil

    try:
        return psutil.pid_exists(process)
    except OverflowError:
        return False


def command_of(process: int) -> tuple[str, ...]:
    """The words of the command line of a process; () if there is none of that number, or it has ended already."""
    import psutil

    try:
        found = psutil.Process(process)
        return () if found.status() == psutil.STATUS_ZOMBIE else tuple(found.cmdline())
    except (psutil.Error, ValueError, OverflowError):
        return ()


def _end_with(parent: int, end: Callable[[], Any]) -> None:
    """Call `end`, which ends this process, as soon as the process that started this one is gone."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(LOOK)
        end()

    threading.Thread(target=watch, daemon=True).start()


# --- the second process -----------------------------------------------------------------------------------------------

IDLE = 300.0  # seconds without work after which it ends
NEEDED = (
    "bstcad.cad.step_writing",
    "bstcad.verify.step_checks",
    "bstcad.report.figure_jobs",
    "matplotlib.backends.backend_agg",
    "matplotlib.backends.backend_pdf",
)
NO_LEAK = "1000000000000000"  # bytes; loky would take a solid in memory for a leak and end the process
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # glibc's names for mallopt (malloc.h)
KEPT, LARGE = (1 << 31) - 1, 1 << 27  # bytes: of all that is kept, and of an array that is not

# A function, or its name "module.function" where to import it would load OCC into this process.
Work = str | Callable[..., Any]
Submit = Callable[..., Future]  # submit(work, *arguments) -> the Future of work(*arguments)
_process: Executor | None = None
_second = False  # is this the second process?


def submit(work: Work, *arguments: Any) -> Future:
    """Have the function `work` called by the second process.

    Calls are done one after the other.  A result raises BrokenExecutor if the process died over it.  Where the system
    allows no second process, a thread of this one does the work.
    """
    global _process
    if _process is not None:
        try:
            return _process.submit(_call, work, *arguments)
        except BrokenExecutor:  # it died over earlier work, whose result tells so
            end()
    _process = _start()
    with unheard_by_children():
        return _process.submit(_call, work, *arguments)


class Overdue(TimeoutError):
    """A work of the second process that took too long; the process has been ended."""


def result(work: Future, limit: float) -> Any:
    """The result of a work of the second process; Overdue if it is not there after `limit` seconds."""
    try:
        return work.result(limit)
    except TimeoutError as error:
        if work.done():  # the work itself raised it
            raise
        end()
        raise Overdue(f"not ended after {limit:.3g} s") from error


def here(work: Work, *arguments: Any) -> Future:
    """Call a function in this process: a finished Future."""
    done: Future = Future()
    done.set_result(_call(work, *arguments))
    return done


def begin() -> None:
    """Start the second process, if it does not run yet, and have it load its libraries; a second or two of its own."""
    if _process is None:
        submit(load, *NEEDED)


def load(*modules: str) -> None:
    """Load modules; an error comes again at the first use of its module."""
    gc.disable()
    for module in modules:
        with contextlib.suppress(Exception):
            importlib.import_module(module)
    gc.freeze()  # a million objects that stay: no collection walks over them
    gc.enable()


def is_second() -> bool:
    """Is this the second process?  It may end without ending the user's."""
    return _second


def end() -> None:
    """End the second process at once, also while it works."""
    global _process
    ended, _process = _process, None
    if ended is not None:
        thread = isinstance(ended, ThreadPoolExecutor)
        ended.shutdown(wait=not thread, **{"cancel_futures" if thread else "kill_workers": True})


def _call(work: Work, *arguments: Any) -> Any:
    if callable(work):
        return work(*arguments)
    module, function = work.rsplit(".", 1)
    return getattr(importlib.import_module(module), function)(*arguments)


def _start() -> Executor:
    from loky import ProcessPoolExecutor

    atexit.register(end)
    # loky begins with its resource tracker, whose warnings of semaphores that a killed run left would follow our words
    quiet = ",".join(filter(None, (os.environ.get("PYTHONWARNINGS"), "ignore:resource_tracker:UserWarning")))
    environment = {"LOKY_MAX_MEMORY_LEAK_SIZE": NO_LEAK}
    try:
        with unheard_by_children(), _variable("PYTHONWARNINGS", quiet):
            return ProcessPoolExecutor(1, timeout=IDLE, initializer=_serve, initargs=(os.getpid(),), env=environment)
    except OSError:  # no shared memory for its queues
        return ThreadPoolExecutor(1)


@contextlib.contextmanager
def _variable(name: str, value: str) -> Iterator[None]:
    """Set an environment variable within the block."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        os.environ.pop(name)
        os.environ.update({} if before is None else {name: before})


def _serve(parent: int) -> None:
    """Ignore the signals of the parent, and end with it: a killed parent shuts nothing down."""
    global _second
    _second = True
    for number in (*TERMINAL, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    _end_with(parent, lambda: os._exit(1))


# --- memory -----------------------------------------------------------------------------------------------------------


def peak_memory() -> float | None:
    """Peak memory of this process (GB); None where the system does not tell.  psutil has no peak on Linux."""
    with contextlib.suppress(OSError, StopIteration):  # on Linux getrusage counts the process that started this one
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM:")).split()[1]) * 1024 / 1e9
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def keep_freed() -> None:
    """Let up to 2 GB of freed memory stay with this process, in arrays of up to 128 MiB; without glibc nothing
    changes.

    glibc returns every freed array of more than 32 MiB to the system, which hands the next one out page by page,
    cleared: an eighth of the time of an evaluation of a few million tubes.  Arrays of more than 128 MiB, as many more
    tubes have, would leave holes that no other one fits in, of a third of all memory.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(TRIM_THRESHOLD, KEPT)
        mallopt(MMAP_THRESHOLD, LARGE)


def return_freed() -> None:
    """Give freed memory back to the system, before work that needs other sizes of it; without glibc nothing happens."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


# --- commands in child processes --------------------------------------------------------------------------------------

TICK = 0.02  # seconds between two looks whether the child has ended
GRACE = 5.0  # seconds that a child has to end after SIGTERM
PARENT = "BSTCAD_PARENT"  # environment variable of a child: the number of the process that started it


@dataclass(frozen=True)
class Ending:
    """How a child ended."""

    code: int  # exit code; -n: signal n ended it
    seconds: float
    cpu_seconds: float  # of the child, of all processes that it started, and of others that ended meanwhile
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
        began, others = time.perf_counter(), _cpu_seconds_of_children()
        child = subprocess.Popen(
            [sys.executable, "-m", "bstcad.cli", *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stderr, start_new_session=True,
            env={**os.environ, **(environment or {}), "PYTHONPATH": paths, PARENT: str(os.getpid())},
        )  # fmt: skip
        try:
            while child.poll() is None:
                if time.perf_counter() > began + limit:
                    os.killpg(child.pid, signal.SIGKILL)
                tick()
                time.sleep(TICK)
        finally:
            if child.returncode is None:
                _end(child)
        seconds = time.perf_counter() - began
        stderr.seek(0)
        spent = _cpu_seconds_of_children() - others
        return Ending(child.returncode, seconds, spent, stderr.read().decode(errors="replace"))


def _cpu_seconds_of_children() -> float:
    """Of those that have ended, and of all processes that they started."""
    times = os.times()
    return times.children_user + times.children_system


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
        _end_with(int(parent), lambda: os.killpg(0, signal.SIGKILL))
