"""Progress of long work: bars on a terminal, plain lines anywhere else.

Both are context managers that hand out one function, progress(stage, done, total, text); `text` is the merit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Report = Callable[[str, int, int, str], None]
PAUSE = 3.0  # seconds between two plain lines of a stage


def watch(console: Console) -> AbstractContextManager[Report]:
    """Bars if `console` is a terminal, else lines."""
    return bars(console) if console.is_terminal else lines(console)


@contextmanager
def bars(console: Console) -> Iterator[Report]:
    """One bar a stage, with the merit and the time left; the bars of past stages stay."""
    columns = (
        TextColumn("{task.description:<12}"),
        BarColumn(bar_width=30),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[merit]}", style="cyan"),
    )
    with Progress(*columns, console=console) as progress:
        tasks = {}

        def report(stage: str, done: int, total: int, text: str) -> None:
            if stage not in tasks:
                for task in tasks.values():
                    progress.stop_task(task)
                tasks[stage] = progress.add_task(stage, total=total or None, merit=text)
            progress.update(tasks[stage], completed=done, total=total or None, merit=text)

        yield report


@contextmanager
def lines(console: Console, clock: Callable[[], float] = time.monotonic) -> Iterator[Report]:
    """A line when a stage starts, every few seconds, and when it ends."""
    started: dict[str, float] = {}
    last: dict[str, float] = {}
    ended: set[str] = set()

    def report(stage: str, done: int, total: int, text: str) -> None:
        now = clock()
        begun = started.setdefault(stage, now)
        ends = done >= total > 0
        if stage in ended or not (ends or now - last.get(stage, -PAUSE) >= PAUSE):
            return
        last[stage] = now
        if ends:
            ended.add(stage)
        left = (now - begun) * (total - done) / done if done else 0.0
        when = f"{now - begun:.1f} s" if ends else f"{left:.0f} s left" if left else ""
        parts = (f"{stage}: {done}/{total}" if total else stage, text, when)
        console.print(", ".join(part for part in parts if part), markup=False, highlight=False, soft_wrap=True)

    yield report
