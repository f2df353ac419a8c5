"""Progress of long work: bars on a terminal or in a notebook, plain lines elsewhere.

Each display is a context manager that yields a function progress(stage, done, total, text): name of the stage, number
of steps done, their total (0: unknown), and a text such as the RRMSD so far.
"""

from __future__ import annotations

import html
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

ProgressFunction = Callable[[str, int, int, str], None]
LINE_INTERVAL = 3.0  # shortest time (s) between two lines of a stage, if the output is not a terminal
REDRAW_INTERVAL = 0.2  # shortest time (s) between two updates of the table in a notebook, unless a stage ends


class Throttled:
    """Progress function that passes on a new text at once, and a repeated text only after `pause` (s)."""

    def __init__(self, progress: ProgressFunction, pause: float) -> None:
        self._progress, self._pause, self._last = progress, pause, ("", -math.inf)

    def __call__(self, stage: str, done: int, total: int, text: str) -> None:
        """Call the wrapped function, unless its last call, less than the pause ago, had the same text."""
        now = time.perf_counter()
        if text != self._last[0] or now - self._last[1] >= self._pause:
            self._last = text, now
            self._progress(stage, done, total, text)


def watch(console: Console) -> AbstractContextManager[ProgressFunction]:
    """Display `bars` if the console is a terminal, else `lines`."""
    return bars(console) if console.is_terminal else lines(console)


def for_script(wanted: bool = True) -> AbstractContextManager[ProgressFunction]:
    """Display bars for a script in a terminal or a notebook; nothing elsewhere, or if not `wanted`."""
    display, console = _notebook(), Console(stderr=True)
    if wanted and display is not None:
        return cells(display)
    if wanted and console.is_terminal:
        return bars(console)
    return nullcontext(lambda stage, done, total, text: None)


def _notebook() -> Callable[..., Any] | None:
    if "IPython" not in sys.modules:
        return None
    from IPython import get_ipython
    from IPython.display import display

    return display if hasattr(get_ipython(), "kernel") else None  # IPython in a terminal has no kernel


@contextmanager
def bars(console: Console) -> Iterator[ProgressFunction]:
    """Display one bar per stage, with its text and the time left; bars of past stages stay."""
    name, merit = TextColumn("{task.description:<12}"), TextColumn("{task.fields[merit]}", style="cyan")
    times = TaskProgressColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    with Progress(name, BarColumn(bar_width=30), *times, merit, console=console) as progress:
        tasks: dict[str, Any] = {}

        def report(stage: str, done: int, total: int, text: str) -> None:
            if stage not in tasks:
                for task in tasks.values():
                    progress.stop_task(task)
                tasks[stage] = progress.add_task(stage, total=total or None, merit=text)
            progress.update(tasks[stage], completed=done, total=total or None, merit=text)

        yield report


@contextmanager
def cells(display: Callable[..., Any], clock: Callable[[], float] = time.monotonic) -> Iterator[ProgressFunction]:
    """Display a table of the stages below a notebook's cell; display: function of IPython; clock: returns seconds."""
    began: dict[str, float] = {}  # start time by stage
    rows: dict[str, str] = {}
    handle = display({"text/html": "", "text/plain": ""}, raw=True, display_id=True)
    drawn = clock()

    def report(stage: str, done: int, total: int, text: str) -> None:
        nonlocal drawn
        now = clock()
        rows[stage] = (
            f'<tr><td>{html.escape(stage)}</td><td><progress max="{max(total, 1)}" value="{done}"></progress></td>'
            f"<td>{now - began.setdefault(stage, now):.1f} s</td><td>{html.escape(text)}</td></tr>"
        )
        if done >= total or now - drawn >= REDRAW_INTERVAL:
            drawn = now
            show()

    def show() -> None:
        last = next(reversed(rows), "")
        handle.update({"text/html": f"<table>{''.join(rows.values())}</table>", "text/plain": last}, raw=True)

    yield report
    show()


@contextmanager
def lines(console: Console, clock: Callable[[], float] = time.monotonic) -> Iterator[ProgressFunction]:
    """Print a line when a stage starts, every LINE_INTERVAL, and when the stage ends; clock: returns seconds."""
    began: dict[str, float] = {}  # start time by stage
    due: dict[str, float] = {}  # earliest time of a stage's next line

    def report(stage: str, done: int, total: int, text: str) -> None:
        now, ends = clock(), done >= total > 0
        begun, next_line = began.setdefault(stage, now), due.get(stage, now)
        if now < next_line and not (ends and next_line < math.inf):
            return
        due[stage] = math.inf if ends else now + LINE_INTERVAL
        left = (now - begun) * (total - done) / done if done else 0.0
        when = f"{now - begun:.1f} s" if ends else f"{left:.0f} s left" if left else ""
        parts = (f"{stage}: {done}/{total}" if total else stage, text, when)
        console.print(", ".join(part for part in parts if part), markup=False, highlight=False, soft_wrap=True)

    yield report
