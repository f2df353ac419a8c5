"""Other processes: the second process, which runs OCC and draws figures, and bstcad commands as child processes.

The second process loads OCC (Open CASCADE, the CAD kernel) while the lens is still being tailored.  A damaged file that
crashes OCC does not end the user's process.  The second process starts at the first `submit`, imports nothing of the
user's script, serves all designs of a session, and ends after IDLE_TIMEOUT.  That of a command is a copy of the process
of the command (`begin`), which saves two seconds of loading; it serves until the command ends.  No process outlives its
parent.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import importlib
import math
import multiprocessing
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
from typing import Any, ParamSpec, Protocol, TypeVar

from bstcad.runs.signals import TERMINAL_SIGNALS, ignored_by_children

PARENT_INTERVAL = 0.5  # time (s) between two checks that the parent is alive


def is_alive(process: int) -> bool:
    """Return True if a process with this id exists."""
    import psutil

    try:
        return psutil.pid_exists(process)
    except OverflowError:
        return False


def command_of(process: int) -> tuple[str, ...]:
    """Return the command line of a process by its id; () if it does not exist or has ended."""
    import psutil

    try:
        found = psutil.Process(process)
        return () if found.status() == psutil.STATUS_ZOMBIE else tuple(found.cmdline())
    except (psutil.Error, ValueError, OverflowError):
        return ()


def _end_with(parent: int, end: Callable[[], Any]) -> None:
    """Call `end`, which ends this process, as soon as the process `parent` (its id) has ended."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_INTERVAL)
        end()

    threading.Thread(target=watch, daemon=True).start()


# --- the second process -----------------------------------------------------------------------------------------------

IDLE_TIMEOUT = 300.0  # time (s) without work after which the second process ends
PRELOADED = (  # modules that the second process loads at its start
    "bstcad.cad.step_writing",
    "bstcad.verify.step_checks",
    "bstcad.figures.figure_jobs",
    "matplotlib.backends.backend_agg",
    "matplotlib.backends.backend_pdf",
)
# Growth of memory (bytes) at which loky ends a process; with its default, a solid in memory would count as a leak.
MEMORY_LEAK_LIMIT = "1000000000000000"
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # numbers of two parameters of glibc's mallopt (malloc.h)
MAX_KEPT = (1 << 31) - 1  # largest total of freed memory that stays with the process (bytes)
MAX_KEPT_ARRAY = 1 << 27  # largest freed array that stays with the process (bytes)
MAX_KEPT_BETWEEN = 1 << 29  # largest total of freed memory that stays between works with arrays of other sizes (bytes)

P = ParamSpec("P")
R = TypeVar("R")
_process: Executor | None = None
_is_second = False  # True in the second process


class Submit(Protocol):
    """Function that calls another function, now or later, such as `submit` and `run_here`."""

    def __call__(self, work: Callable[P, R], *arguments: P.args, **options: P.kwargs) -> Future[R]:
        """Return the Future of work(*arguments, **options)."""
        ...


def submit(work: Callable[P, R], *arguments: P.args, **options: P.kwargs) -> Future[R]:
    """Call the function `work` in the second process; calls run one after the other.

    The arguments are pickled before `submit` returns, so the caller may change them during the call, for example by a
    cached property.  The Future raises BrokenExecutor if the process died during the call.  If the system allows no
    second process, a thread does the work.
    """
    global _process
    if _process is not None:
        try:
            return _submit_to(_process, work, *arguments, **options)
        except BrokenExecutor:  # the process died during earlier work, whose Future reports it
            end()
    _process = _start()
    with ignored_by_children():
        return _submit_to(_process, work, *arguments, **options)


def _submit_to(process: Executor, work: Callable[P, R], *arguments: P.args, **options: P.kwargs) -> Future[R]:
    """Submit a call to a thread, or to a process, for which it is pickled here: loky would do so in another thread."""
    if isinstance(process, ThreadPoolExecutor):
        return process.submit(work, *arguments, **options)
    from loky.backend import reduction

    return process.submit(_call, bytes(reduction.dumps((work, arguments, options))))


def _call(pickled: bytes) -> Any:
    """Return the result of a call that `_submit_to` pickled."""
    from loky.backend import reduction

    work, arguments, options = reduction.loads(pickled)
    return work(*arguments, **options)


class Overdue(TimeoutError):
    """Work of the second process exceeded its time limit, and the second process has been ended."""


def result(work: Future[R], limit: float) -> R:
    """Return the result of a call in the second process; after `limit` seconds end that process and raise Overdue."""
    try:
        return work.result(limit)
    except TimeoutError as error:
        if work.done():  # raised by the work itself
            raise
        end()
        raise Overdue(f"not ended after {limit:.3g} s") from error


def run_here(work: Callable[P, R], *arguments: P.args, **options: P.kwargs) -> Future[R]:
    """Call a function in this process and return a finished Future; a substitute for `submit`."""
    done: Future[R] = Future()
    done.set_result(work(*arguments, **options))
    return done


def begin(*, copied: bool = False) -> None:
    """Start the second process, unless it runs, and let it load its libraries; return without waiting for it.

    copied: start it as a copy of this process, which then need not load again what this process has loaded.  Only for a
    program that has run nothing in threads yet (`is_new`): threads of OpenMP end in a copy, and its sums are wrong.
    """
    global _process
    if _process is None:
        if copied and _can_be_copied():
            _process = _start("fork")
        submit(load, *PRELOADED)


def is_new() -> bool:
    """Return True if this process has not loaded torch yet, so that nothing can have run in its threads."""
    return "torch" not in sys.modules


def _can_be_copied() -> bool:
    """Return True on Linux if Python has no other thread, whose locks the copy would keep."""
    return sys.platform == "linux" and threading.active_count() == 1


@contextlib.contextmanager
def kept_awake() -> Iterator[None]:
    """Keep the second process, if it runs, from ending for lack of work during a block of long work of this one."""
    ended = threading.Event()

    def keep() -> None:
        while not ended.wait(IDLE_TIMEOUT / 3):
            process = _process
            if process is not None:
                with contextlib.suppress(BrokenExecutor, RuntimeError):  # it has just ended
                    process.submit(os.getpid)

    thread = threading.Thread(target=keep, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def load(*modules: str) -> None:
    """Import modules and ignore all errors; an import error is raised again at the first use of the module."""
    gc.disable()
    for module in modules:
        with contextlib.suppress(Exception):
            importlib.import_module(module)
    gc.freeze()  # a million permanent objects, which the garbage collector can skip
    gc.enable()


def is_second() -> bool:
    """Return True in the second process, which may end without ending the user's process."""
    return _is_second


def end() -> None:
    """End the second process at once, even while it works."""
    global _process
    ended, _process = _process, None
    if ended is not None:
        thread = isinstance(ended, ThreadPoolExecutor)
        ended.shutdown(wait=not thread, **{"cancel_futures" if thread else "kill_workers": True})


def _start(method: str = "loky") -> Executor:
    """Start the second process; method: how loky starts it, "fork" as a copy of this process."""
    with _environment_variable("LOKY_MAX_MEMORY_LEAK_SIZE", MEMORY_LEAK_LIMIT):  # loky reads it when it is imported
        from loky import ProcessPoolExecutor

    atexit.register(end)
    # loky's resource tracker would print warnings about the semaphores of killed runs after our own output
    quiet = ",".join(filter(None, (os.environ.get("PYTHONWARNINGS"), "ignore:resource_tracker:UserWarning")))
    environment = {"LOKY_MAX_MEMORY_LEAK_SIZE": MEMORY_LEAK_LIMIT}
    try:
        with ignored_by_children(), _environment_variable("PYTHONWARNINGS", quiet):
            return ProcessPoolExecutor(
                1, timeout=None if method == "fork" else IDLE_TIMEOUT,  # this process may no longer be copied later
                initializer=_serve, initargs=(os.getpid(),), env=environment,
                context=multiprocessing.get_context(method),
            )  # fmt: skip
    except OSError:  # no shared memory for its queues
        return ThreadPoolExecutor(1)


@contextlib.contextmanager
def _environment_variable(name: str, value: str) -> Iterator[None]:
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        os.environ.pop(name)
        os.environ.update({} if before is None else {name: before})


def _serve(parent: int) -> None:
    """Ignore the signals that the parent handles, and end once it has ended: a killed parent cannot end a child."""
    global _is_second, _process
    _is_second, _process = True, None  # a copy of the parent has its executor
    for number in (*TERMINAL_SIGNALS, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    _end_with(parent, lambda: os._exit(1))


# --- memory -----------------------------------------------------------------------------------------------------------


def peak_memory() -> float | None:
    """Return the peak memory of this process (GB); None if unknown.  psutil does not state it on Linux."""
    with contextlib.suppress(OSError, StopIteration):  # on Linux getrusage includes the parent process
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM:")).split()[1]) * 1024 / 1e9
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def keep_freed() -> None:
    """Let up to 2 GiB of freed memory stay with this process, in arrays of up to 128 MiB; needs glibc.

    By default, glibc returns freed arrays of more than 32 MiB to the system, which clears each new array page by page.
    Clearing takes an eighth of the time of an evaluation of a few million tubes.  Keeping freed arrays of more than
    128 MiB would fragment a third of all memory.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(TRIM_THRESHOLD, MAX_KEPT)
        mallopt(MMAP_THRESHOLD, MAX_KEPT_ARRAY)


class _MallocInfo(ctypes.Structure):
    """Struct mallinfo2 of glibc (malloc.h)."""

    _fields_ = [("others", 8 * ctypes.c_size_t), ("fordblks", ctypes.c_size_t), ("keepcost", ctypes.c_size_t)]


def return_freed(allowed: int = MAX_KEPT_BETWEEN) -> None:
    """Return freed memory to the system if it exceeds `allowed` bytes, before work with arrays of other sizes.

    The system clears returned memory before its next use, which takes a tenth of the time of writing and proof.
    This function needs glibc, and `allowed` glibc 2.33.
    """
    library = ctypes.CDLL(None)
    trim, mallinfo2 = getattr(library, "malloc_trim", None), getattr(library, "mallinfo2", None)
    if mallinfo2 is not None:
        mallinfo2.restype = _MallocInfo
        if mallinfo2().fordblks <= allowed:  # total size of freed blocks (bytes)
            return
    if trim is not None:
        trim(0)


# --- commands in child processes --------------------------------------------------------------------------------------

CHILD_INTERVAL = 0.02  # time (s) between two checks for the end of a child
TERMINATION_TIMEOUT = 5.0  # time (s) in which a child has to end after SIGTERM
PARENT = "BSTCAD_PARENT"  # environment variable of a child: process id of its parent
Tick = Callable[[], None]  # function called regularly while a child works


@dataclass(frozen=True)
class ExitStatus:
    """End of a child process: its exit code, times, and text on stderr."""

    code: int  # exit code; -n if signal n ended the child
    seconds: float  # wall time
    cpu_seconds: float  # CPU time of the child and its own children, and of other children that ended meanwhile
    stderr: str  # text that the child wrote to stderr

    @property
    def reason(self) -> str:
        """Reason why the child gave no result, to be quoted within a sentence."""
        if self.code < 0:
            memory = "; this machine may have too little memory for it" if self.code == -signal.SIGKILL else ""
            return f"ended by {signal.Signals(-self.code).name}{memory}"
        lines = [line for line in self.stderr.splitlines() if line.startswith("bstcad: ") and "warning: " not in line]
        return lines[-1].removeprefix("bstcad: ") if lines else f"exit code {self.code}"


def run(
    arguments: Sequence[str], limit: float = math.inf, tick: Tick = lambda: None, environment: Mapping[str, str] = {},
    module: str = "bstcad.cli",
) -> ExitStatus:  # fmt: skip
    """Run a module, by default `bstcad`, with these arguments in a child process; kill it after `limit` seconds.

    tick: called regularly; an exception of tick ends the child.  environment: additional environment variables.
    """
    source = str(Path(__file__).parents[2])  # the child runs these sources
    paths = os.pathsep.join(filter(None, (source, os.environ.get("PYTHONPATH"))))
    variables = {**os.environ, **environment, "PYTHONPATH": paths, PARENT: str(os.getpid())}
    command, null = [sys.executable, "-m", module, *arguments], subprocess.DEVNULL
    with tempfile.TemporaryFile() as stderr:
        began, others = time.perf_counter(), _cpu_seconds_of_children()
        child = subprocess.Popen(command, stdin=null, stdout=null, stderr=stderr, start_new_session=True, env=variables)
        try:
            while child.poll() is None:
                if time.perf_counter() > began + limit:
                    os.killpg(child.pid, signal.SIGKILL)
                tick()
                time.sleep(CHILD_INTERVAL)
        finally:
            if child.returncode is None:
                _end(child)
        seconds = time.perf_counter() - began
        stderr.seek(0)
        spent = _cpu_seconds_of_children() - others
        return ExitStatus(child.returncode, seconds, spent, stderr.read().decode(errors="replace"))


def _cpu_seconds_of_children() -> float:
    times = os.times()
    return times.children_user + times.children_system


def _end(child: subprocess.Popen) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(child.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(TERMINATION_TIMEOUT)
            return


def limit_memory(largest: int) -> None:
    """Limit the address space of this process to `largest` bytes, where the system can do so."""
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        given = [limit for limit in (soft, hard) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min(largest, *given) if given else largest, hard))


def end_with_parent() -> None:
    """If `run` started this process, end its process group once the parent has ended; else do nothing."""
    parent = os.environ.pop(PARENT, None)
    if parent is not None and os.getpgrp() == os.getpid():
        _end_with(int(parent), lambda: os.killpg(0, signal.SIGKILL))
