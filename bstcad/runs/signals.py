"""Signals that end a run.

While a lens is tailored, the first Ctrl-C (SIGINT) asks for the best lens so far; any other ends the run at once, and
so do SIGTERM and SIGHUP: a SIGKILL may follow.  The design so far is kept in each case (commands.generate).
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator

ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))  # no SIGHUP on Windows
TERMINAL = (signal.SIGINT, *ENDING[1:])  # that a terminal sends to every process of its group
_heard: list[int] = []  # of ENDING, since `endings` began
_starting: list[object] = []  # one for each process that is being started
_late: list[int] = []  # signals that came meanwhile to a block of `ending_at_once`


class Ended(BaseException):
    """SIGTERM or SIGHUP."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number

    @property
    def name(self) -> str:
        """As the system calls it: SIGTERM."""
        return signal.Signals(self.number).name


def ended() -> Ended | None:
    """The signal that ended this run, even if its exception was lost in a destructor or replaced by another one."""
    return Ended(_heard[0]) if _heard else None


@contextlib.contextmanager
def endings() -> Iterator[None]:
    """SIGTERM and SIGHUP raise Ended once: a second one does not interrupt keeping.  Ignored signals stay ignored."""

    def hear(number: int, frame: object) -> None:
        _heard.append(number)
        if len(_heard) == 1:
            raise Ended(number)

    _heard.clear()
    with _heard_by(hear, *(number for number in ENDING if signal.getsignal(number) != signal.SIG_IGN)):  # nohup
        yield


@contextlib.contextmanager
def first_interrupt_is_a_wish() -> Iterator[Callable[[], bool]]:
    """Within the block the first Ctrl-C makes the yielded function true; the second raises KeyboardInterrupt."""
    pressed: list[int] = []

    def hear(number: int, frame: object) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(number)
        print("\nbstcad: stopping with the best lens so far; press Ctrl-C again to stop at once", file=sys.stderr)

    def wished() -> bool:
        if lost := ended():
            raise lost
        return bool(pressed)

    with _heard_by(hear, signal.SIGINT):
        yield wished


@contextlib.contextmanager
def unheard_by_children() -> Iterator[None]:
    """Processes started in the block ignore the signals of a terminal; this process hears them after the block.

    Meanwhile the signals are blocked, where the system can: one that came would be lost to the handler that ignores it.
    """
    masks = hasattr(signal, "pthread_sigmask")
    held = signal.pthread_sigmask(signal.SIG_BLOCK, TERMINAL) if masks else ()
    _starting.append(start := object())
    try:
        with _heard_by(signal.SIG_IGN, *TERMINAL):
            yield
    finally:
        _starting.remove(start)
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, held)
        if _late:
            _end_at_once(_late[0])


@contextlib.contextmanager
def ending_at_once() -> Iterator[None]:
    """Within the block, in which libraries load, a signal ends this process at once, with a sentence.

    Some libraries swallow the exception of a signal while they load, and stay half loaded; to wait for all of them can
    take ten seconds on a busy machine.  Nothing has been written yet.
    """
    numbers = [n for n in (signal.SIGINT, *ENDING) if signal.getsignal(n) not in (signal.SIG_IGN, signal.SIG_DFL)]
    with _heard_by(_end_at_once, *numbers):
        yield


def _end_at_once(number: int, frame: object = None) -> None:
    if _starting:  # a process that is half started would complain of it
        _late.append(number)
        return
    interrupted = number == signal.SIGINT
    how = "stopped" if interrupted else f"ended by {Ended(number).name}"
    with contextlib.suppress(OSError):  # a terminal that is gone
        os.write(2, f"bstcad: {how} at its start; nothing was written\n".encode())
    os._exit(128 + number)


@contextlib.contextmanager
def _heard_by(hear: Callable[[int, object], None] | signal.Handlers, *numbers: int) -> Iterator[None]:
    """`hear` handles these signals within the block."""
    before = {}
    try:
        for number in numbers:
            before[number] = signal.signal(number, hear)
    except ValueError:  # not the main thread, which alone hears signals
        pass
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
