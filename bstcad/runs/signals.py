"""Signals: what ends a run from outside, and at which moments it counts.

While a lens is tailored Ctrl-C (SIGINT) asks for the best so far, and pressed again it ends the run at once; so it does
when all is found and only has to be written and verified.  SIGTERM and SIGHUP end it at once: a SIGKILL may follow.
What was found is kept either way (bstcad.commands).
"""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Callable, Iterator

ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))  # no SIGHUP on Windows
_heard: list[int] = []  # of ENDING, since `endings` began


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
    """What has ended this run, even if its exception was lost, as in a destructor, or gave way to another."""
    return Ended(_heard[0]) if _heard else None


@contextlib.contextmanager
def endings() -> Iterator[None]:
    """SIGTERM and SIGHUP raise Ended, once: what is kept then is not to be cut short.  One that is ignored stays so."""

    def hear(number: int, frame: object) -> None:
        _heard.append(number)
        if len(_heard) == 1:
            raise Ended(number)

    _heard.clear()
    with _heard_by(hear, *(number for number in ENDING if signal.getsignal(number) != signal.SIG_IGN)):  # nohup
        yield


@contextlib.contextmanager
def first_interrupt_is_a_wish() -> Iterator[Callable[[], bool]]:
    """Ctrl-C asks for the best so far, which the function that is handed out tells; pressed again, it stops at once."""
    pressed = []

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
def an_interrupt_ends_it() -> Iterator[None]:
    """Ctrl-C stops the block at once: there is nothing better in sight to ask for."""
    deaf = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    with _heard_by(signal.default_int_handler, *(() if deaf else (signal.SIGINT,))):
        yield


@contextlib.contextmanager
def unheard_by_children() -> Iterator[None]:
    """Processes that start in the block never hear Ctrl-C, which a terminal sends to all: it is for this one."""
    with _heard_by(signal.SIG_IGN, signal.SIGINT):
        yield


@contextlib.contextmanager
def waiting() -> Iterator[None]:
    """Signals count at the end of the block: some libraries swallow them while they load, and stay half loaded."""
    pressed: list[int] = []
    numbers = [n for n in (signal.SIGINT, *ENDING) if signal.getsignal(n) not in (signal.SIG_IGN, signal.SIG_DFL)]
    with _heard_by(lambda number, frame: pressed.append(number), *numbers):
        yield
    for number in pressed:
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        _heard.append(number)
        raise Ended(number)


@contextlib.contextmanager
def _heard_by(hear: Callable[[int, object], None] | signal.Handlers, *numbers: int) -> Iterator[None]:
    """Signals go to `hear` within the block."""
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
