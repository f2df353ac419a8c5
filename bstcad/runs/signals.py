"""Signals that end a run.

While a lens is tailored, the first Ctrl-C (SIGINT) requests the best lens so far.  A second Ctrl-C, a SIGTERM or a
SIGHUP ends the run at once; SIGKILL may follow SIGTERM.  In each case a checkpoint is kept (commands.generate).
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator

# Signals that terminate a run; Windows has no SIGHUP.
TERMINATION_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
TERMINAL_SIGNALS = (signal.SIGINT, *TERMINATION_SIGNALS[1:])  # signals that a terminal sends to its whole process group
_received: list[int] = []  # numbers of the termination signals since `raise_terminated` began
_starting: list[object] = []  # one item for each process that is being started
_delayed: list[int] = []  # numbers of signals that `_exit` handles once the processes have been started


class Terminated(BaseException):
    """The run is ended by SIGTERM or SIGHUP."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number

    @property
    def name(self) -> str:
        """Name of the signal, such as SIGTERM."""
        return signal.Signals(self.number).name


def termination() -> Terminated | None:
    """Return the Terminated of this run, even if its exception was lost or replaced; None without such a signal."""
    return Terminated(_received[0]) if _received else None


@contextlib.contextmanager
def raise_terminated() -> Iterator[None]:
    """Raise Terminated on the first SIGTERM or SIGHUP in the block, unless ignored; later ones have no effect."""

    def handle(number: int, frame: object) -> None:
        _received.append(number)
        if len(_received) == 1:
            raise Terminated(number)

    _received.clear()
    numbers = [n for n in TERMINATION_SIGNALS if signal.getsignal(n) != signal.SIG_IGN]  # nohup ignores SIGHUP
    with _handled_by(handle, *numbers):
        yield


@contextlib.contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns True after one Ctrl-C in the block; a second Ctrl-C raises KeyboardInterrupt."""
    pressed: list[int] = []

    def handle(number: int, frame: object) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(number)
        print("\nbstcad: stopping with the best lens so far; press Ctrl-C again to stop at once", file=sys.stderr)

    def stop_requested() -> bool:
        if lost := termination():
            raise lost
        return bool(pressed)

    with _handled_by(handle, signal.SIGINT):
        yield stop_requested


@contextlib.contextmanager
def ignored_by_children() -> Iterator[None]:
    """Make processes that start in the block ignore a terminal's signals; this process receives them after the block.

    Until the end of the block the signals are masked, and so kept; a system that cannot mask signals loses them.
    """
    masks = hasattr(signal, "pthread_sigmask")
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, TERMINAL_SIGNALS) if masks else ()
    _starting.append(start := object())
    try:
        with _handled_by(signal.SIG_IGN, *TERMINAL_SIGNALS):
            yield
    finally:
        _starting.remove(start)
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if _delayed:
            _exit(_delayed[0])


@contextlib.contextmanager
def exit_on_signal() -> Iterator[None]:
    """End this process at once, with a sentence, on a signal in the block, which loads libraries.

    Some libraries swallow the exception of a signal while they load and stay half loaded.  Loading all of them can take
    ten seconds on a busy machine.  Nothing has been written yet.
    """
    default = (signal.SIG_IGN, signal.SIG_DFL)
    numbers = [n for n in (signal.SIGINT, *TERMINATION_SIGNALS) if signal.getsignal(n) not in default]
    with _handled_by(_exit, *numbers):
        yield


def _exit(number: int, frame: object = None) -> None:
    if _starting:  # a half-started process would print an error
        _delayed.append(number)
        return
    interrupted = number == signal.SIGINT
    how = "stopped" if interrupted else f"ended by {Terminated(number).name}"
    with contextlib.suppress(OSError):  # the terminal may be gone
        os.write(2, f"bstcad: {how} at its start; nothing was written\n".encode())
    os._exit(128 + number)


@contextlib.contextmanager
def _handled_by(handle: Callable[[int, object], None] | signal.Handlers, *numbers: int) -> Iterator[None]:
    before = {}
    try:
        for number in numbers:
            before[number] = signal.signal(number, handle)
    except ValueError:  # only the main thread can handle signals
        pass
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
