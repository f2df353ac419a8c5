"""A worker process for OCC and for drawing, so that both cores have work to do.

OCC loads while the lens is still being tailored, and a damaged file on which it ends its process does not
end the user's.  The process starts at the first `submit`, imports nothing of the user's script, serves all
designs of a session, and leaves with its parent or when it has been idle for long.
"""

from __future__ import annotations

import atexit
import contextlib
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

IDLE = 300.0  # seconds without work after which it leaves
NEEDED = (
    "bstcad.cad.step_writing",
    "bstcad.verify.step_checks",
    "bstcad.report.figure_jobs",
    "matplotlib.backends.backend_agg",
    "matplotlib.backends.backend_pdf",
)
SEMAPHORES = Path("/dev/shm")  # where Linux shows them; elsewhere they cannot be seen, nor cleared
NO_LEAK = "1000000000000000"  # bytes; loky would end a process of ours, and what it has read, for a solid in memory
LOOK = 1.0  # seconds between looks whether its parent is still there

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
    """The same, done at once in this process."""
    done: Future = Future()
    done.set_result(_call(work, *arguments))
    return done


def begin() -> None:
    """Start it, if it does not run yet, and have it load what it will need; a second or two of its own."""
    if _process is None:
        submit(load, *NEEDED)


def load(*modules: str) -> None:
    """Load modules; if one cannot be, whoever needs it will say so."""
    gc.disable()
    for module in modules:
        with contextlib.suppress(Exception):
            importlib.import_module(module)
    gc.freeze()  # a million objects that stay: no collection need walk over them, neither now nor later
    gc.enable()


def is_second() -> bool:
    """Is this the second process, so that it may end without an end of the user's?"""
    return _second


def peak_memory() -> float | None:
    """The most memory that this process has held so far (GB); None where the system does not tell."""
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def end() -> None:
    """End the second process now, whatever it is doing."""
    global _process
    ended, _process = _process, None
    if isinstance(ended, ThreadPoolExecutor):
        ended.shutdown(wait=True, cancel_futures=True)
    elif ended is not None:
        ended.shutdown(wait=True, kill_workers=True)


def clear_semaphores() -> None:
    """Remove the semaphores of processes that were killed together with what would have cleared up behind them.

    A semaphore's name serves to start further processes, which only the one that made it does: once that is dead,
    nobody needs it.
    """
    for path in SEMAPHORES.glob("sem.loky-*"):
        process = path.name.split("-")[1]
        with contextlib.suppress(OSError, ValueError):
            if path.lstat().st_uid == os.getuid() and not runs(int(process)):
                path.unlink()


def runs(process: int) -> bool:
    """Is there a process of this number?"""
    if os.name == "nt":  # where signal 0 is no question
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # it is someone else's
        return True
    return True


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
        with _deaf(), _quiet():  # it begins with a process that clears up behind it
            return ProcessPoolExecutor(1, timeout=IDLE, initializer=_serve, env={"LOKY_MAX_MEMORY_LEAK_SIZE": NO_LEAK})
    except OSError:  # no shared memory for its queues
        return ThreadPoolExecutor(1)


@contextlib.contextmanager
def _deaf() -> Iterator[None]:
    """Ctrl-C and the end of a terminal reach both processes, and only the first one is to answer, later."""
    if threading.current_thread() is not threading.main_thread():  # which alone may say what signals do
        yield
        return
    masks = hasattr(signal, "pthread_sigmask")  # a signal that is held back waits, though it would be ignored now
    held = signal.pthread_sigmask(signal.SIG_BLOCK, _of_a_terminal()) if masks else None
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
    """The process that clears up tells nobody what it found, which would stand behind our last sentence.

    A run that ends while semaphores come and go may leave one to it; so does one that is killed.
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
    """A parent that was killed cannot say goodbye; any other end is its to answer."""
    global _second
    _second = True
    for number in (*_of_a_terminal(), signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_leave_with, args=(os.getppid(),), daemon=True).start()


def _leave_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK)
    os._exit(1)
