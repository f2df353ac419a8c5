"""The second process, for OCC and for drawing, beside the one that tailors.

OCC loads while the lens is still being tailored, and a damaged file that makes OCC end its process does not end the
user's.  The process starts at the first `submit`, imports nothing of the user's script, serves all designs of a
session, and ends with its parent or after a long idle time.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import importlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

IDLE = 300.0  # seconds without work after which it ends
NEEDED = (
    "bstcad.cad.step_writing",
    "bstcad.verify.step_checks",
    "bstcad.report.figure_jobs",
    "matplotlib.backends.backend_agg",
    "matplotlib.backends.backend_pdf",
)
SEMAPHORES = Path("/dev/shm")  # where Linux shows them; other systems hide them
NO_LEAK = "1000000000000000"  # bytes; loky would take a solid in memory for a leak and end the process
LOOK = 1.0  # seconds between two looks for the parent
TRIM_THRESHOLD, MMAP_THRESHOLD, KEPT = -1, -3, (1 << 31) - 1  # glibc's names for mallopt (malloc.h); bytes

Work = str | Callable[..., Any]  # a function of some module, or its name "module.function", which need not be loaded
Submit = Callable[..., Future]  # submit(work, *arguments) -> the Future of work(*arguments)
_process: Executor | None = None
_second = False  # is this the second process?


def submit(work: Work, *arguments: Any) -> Future:
    """Have the function `work` called there.

    Calls are done one after the other.  A result raises BrokenExecutor if the process died over it.  Where the system
    allows no second process, a thread of this one does the work.
    """
    global _process
    if _process is not None:
        try:
            return _process.submit(_call, work, *arguments)
        except BrokenExecutor:  # it died over something earlier; whoever waited for that knows
            end()
    _process = _start()
    with _deaf():  # what starts now inherits it
        return _process.submit(_call, work, *arguments)


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


def peak_memory() -> float | None:
    """Peak memory of this process (GB); None where the system does not tell.  psutil has no peak on Linux."""
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def keep_freed() -> None:
    """Let up to 2 GB of freed memory stay with this process; without glibc nothing changes.

    glibc returns every freed array of more than 32 MiB to the system, which hands the next one out page by page,
    cleared: an eighth of the time of an evaluation of a few million tubes.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(TRIM_THRESHOLD, KEPT)
        mallopt(MMAP_THRESHOLD, KEPT)


def end() -> None:
    """End the second process at once, also while it works."""
    global _process
    ended, _process = _process, None
    if ended is not None:
        thread = isinstance(ended, ThreadPoolExecutor)
        ended.shutdown(wait=True, **{"cancel_futures" if thread else "kill_workers": True})


def clear_semaphores() -> None:
    """Remove semaphores whose processes were killed together with loky's resource tracker.

    Only the process that made a semaphore uses its name, to start further processes.
    """
    for path in SEMAPHORES.glob("sem.loky-*"):
        process = path.name.split("-")[1]
        with contextlib.suppress(OSError, ValueError):
            if path.lstat().st_uid == os.getuid() and not runs(int(process)):
                path.unlink()


def runs(process: int) -> bool:
    """Is there a process of this number?"""
    import psutil

    try:
        return psutil.pid_exists(process)
    except OverflowError:
        return False


def _call(work: Work, *arguments: Any) -> Any:
    if callable(work):
        return work(*arguments)
    module, function = work.rsplit(".", 1)
    return getattr(importlib.import_module(module), function)(*arguments)


def _start() -> Executor:
    from loky import ProcessPoolExecutor

    atexit.register(end)
    clear_semaphores()
    try:
        with _deaf(), _quiet():  # loky begins with its resource tracker
            return ProcessPoolExecutor(1, timeout=IDLE, initializer=_serve, env={"LOKY_MAX_MEMORY_LEAK_SIZE": NO_LEAK})
    except OSError:  # no shared memory for its queues
        return ThreadPoolExecutor(1)


@contextlib.contextmanager
def _deaf() -> Iterator[None]:
    """Processes started in the block ignore Ctrl-C and the end of a terminal; this one hears them after the block."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread may set handlers
        yield
        return
    masks = hasattr(signal, "pthread_sigmask")  # a blocked signal waits, although its handler is to ignore it
    held = signal.pthread_sigmask(signal.SIG_BLOCK, _of_a_terminal()) if masks else set()
    before = {number: signal.signal(number, signal.SIG_IGN) for number in _of_a_terminal()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, held)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """loky's resource tracker, if it starts in the block, warns of no semaphore that a killed run left.

    Its warning would follow the program's last sentence.
    """
    name, before = "PYTHONWARNINGS", os.environ.get("PYTHONWARNINGS")
    os.environ[name] = ",".join(filter(None, (before, "ignore:resource_tracker:UserWarning")))
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def _of_a_terminal() -> tuple[int, ...]:
    return tuple(getattr(signal, name) for name in ("SIGINT", "SIGHUP") if hasattr(signal, name))


def _serve() -> None:
    """Ignore the signals of the parent, and end with it: a killed parent shuts nothing down."""
    global _second
    _second = True
    for number in (*_of_a_terminal(), signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_leave_with, args=(os.getppid(),), daemon=True).start()


def _leave_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK)
    os._exit(1)
