"""The thread that makes previews.  Quick previews come first; slower answers follow if no page waits for a quick one.

A request of a page replaces the page's earlier request, whose work ends at the next step.  The answers come in the
order of STAGES: a quick preview, a refined preview, the picture of the part as made, the effects that are left out, and
predictions for each quality.
There is one thread, since two simultaneous previews on two cores would each take twice as long.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bstcad.planning.net_choice import with_net
from bstcad.planning.plan import PilotRun, plan
from bstcad.planning.preview import Outdated, Preview, preview
from bstcad.planning.reduction import QUICK, REFINED, Reduction
from bstcad.runs import processes
from bstcad.scene.new_scene import Plate
from bstcad.scene.scene import Scene, of_text
from bstcad.scene.scene_file import tables

STAGES = ("preview", "settled", "made", "effects", "predicted")  # names of the answers to a request, in their order
MAX_PAGES = 32  # largest number of pages with a stored request
IDLE_DELAY = 0.7  # pause (s) between the first preview of a request and its other answers, in case another change comes
JOIN_TIMEOUT = 0.5  # time (s) that `end` waits for the thread
PAGE_TIMEOUT = 60.0  # time (s) without a poll after which the thread stops its work for a page, until its next poll


@dataclass(eq=False)
class PreviewRequest:
    """Scene whose previews a page waits for."""

    page: str  # id of the page
    number: int  # number of the request; later requests of a page have larger numbers
    scene: Scene
    text: str = ""  # text of the scene file, to whose lines a plan refers
    grade: str | None = None  # grade of the picture as made; None: no such picture
    light: str | None = None  # light of the picture in another light (tolerance.lit_by); None: no such picture
    answers: list[tuple[str, Any]] = field(default_factory=list)  # (stage, answer or the Exception that prevented it)
    replaced: bool = False  # True once a later request of the page has come
    preview_time: float = math.inf  # time at which the first preview was ready (time.monotonic)
    poll_time: float = field(default_factory=time.monotonic)  # time of the page's last poll (time.monotonic)
    plan: Iterator[dict[str, Any]] | None = None  # parts of the plan that are still to be made

    @property
    def done(self) -> bool:
        """True if all answers exist or the page no longer waits for them."""
        return self.replaced or len(self.answers) == len(STAGES) or time.monotonic() > self.poll_time + PAGE_TIMEOUT


class PreviewDesk:
    """Queue of the pages' requests, answered by one thread."""

    def __init__(self, sizes: tuple[Reduction, Reduction] = (QUICK, REFINED), pilot: PilotRun | None = None) -> None:
        """sizes: of the first and of the finer preview.  pilot: of predictions, see `plan`."""
        self._sizes, self._pilot = sizes, pilot
        self._news = threading.Condition()
        self._requests: dict[str, PreviewRequest] = {}  # latest request, by page
        self._ended = False
        self._thread = threading.Thread(target=self._work, name="previews", daemon=True)
        self._thread.start()

    def ask(self, request: PreviewRequest) -> None:
        """Add a request; an older request of the page is dropped."""
        with self._news:
            before = self._requests.pop(request.page, None)
            if before is not None and before.number > request.number:  # the requests arrived in another order
                request.replaced = True
                self._requests[request.page] = before
            else:
                if before is not None:
                    before.replaced = True
                self._requests[request.page] = request
                while len(self._requests) > MAX_PAGES:
                    self._requests.pop(next(iter(self._requests))).replaced = True
            self._news.notify_all()

    def answer(self, request: PreviewRequest, stage: int, patience: float) -> tuple[str, Any] | None:
        """Return (name, answer) of a stage (index in STAGES) within `patience` seconds; None if late or replaced."""
        with self._news:
            request.poll_time = time.monotonic()
            self._news.notify_all()  # the thread serves this page again if it had stopped polling
            self._news.wait_for(lambda: len(request.answers) > stage or request.replaced or self._ended, patience)
            return request.answers[stage] if len(request.answers) > stage else None

    def last(self, page: str) -> PreviewRequest | None:
        """Return the latest request of a page; None without one."""
        with self._news:
            return self._requests.get(page)

    def drop(self, page: str) -> None:
        """Drop the request of a page, which no longer waits for answers."""
        with self._news:
            if (request := self._requests.pop(page, None)) is not None:
                request.replaced = True

    def close(self) -> None:
        """Drop all requests, so that every waiting call returns."""
        with self._news:
            self._ended = True
            for request in self._requests.values():
                request.replaced = True
            self._news.notify_all()

    def end(self) -> None:
        """Drop all requests and end the thread; if it is compiling a kernel, it ends with the process."""
        self.close()
        self._thread.join(timeout=JOIN_TIMEOUT)

    # ---- the thread ----

    def _work(self) -> None:
        with contextlib.suppress(Exception):  # load libraries and compile kernels before the first request
            preview(first_scene(), self._sizes[0], outdated=lambda: self._ended or bool(self._requests))
        while True:
            with self._news:
                while not self._ended and self._next() is None:
                    self._news.wait(IDLE_DELAY / 4 if self._unanswered() else None)
                if self._ended:
                    return
                request = self._next()
            self._serve(request)

    def _next(self) -> PreviewRequest | None:
        """Return the latest of the waiting requests with the fewest answers, so that a new one comes first, or None."""
        now = time.monotonic()
        waiting = [each for each in self._unanswered() if not each.answers or now > each.preview_time + IDLE_DELAY]
        return min(reversed(waiting), key=lambda request: len(request.answers), default=None)

    def _unanswered(self) -> list[PreviewRequest]:
        return [request for request in self._requests.values() if not request.done]

    def _serve(self, request: PreviewRequest) -> None:
        """Make the next answer of a request; an interrupted answer is made again later, if the page still waits."""
        stage = STAGES[len(request.answers)]
        try:
            found = self._make(request, stage)
        except Outdated:
            request.plan = None
            return
        except Exception as fault:  # a failing preview must not end the thread
            found = fault
        processes.return_freed(allowed=0)  # arrays change in size between previews: freed memory would fragment
        with self._news:
            failed = stage == "preview" and isinstance(found, Exception)
            request.preview_time = min(request.preview_time, time.monotonic())
            request.answers += [(each, found) for each in (STAGES if failed else (stage,))]
            self._news.notify_all()

    def _make(self, request: PreviewRequest, stage: str) -> Any:
        """Return the answer of a stage: a preview, or entries of `plan --json` (for "effects", with the chosen `net`).

        "made" gives (preview, its picture as made, its picture in another light), both None if they are not wanted.
        Outdated once the request is replaced or another one has fewer answers.
        """

        def outdated() -> bool:
            had, others = len(request.answers), list(self._requests.values())
            return request.replaced or self._ended or any(not o.done and len(o.answers) < had for o in others)

        def tick() -> None:
            if outdated():
                raise Outdated

        if stage in ("preview", "settled"):
            return preview(request.scene, self._sizes[stage == "settled"], outdated)
        if stage == "made":
            if request.grade is None and request.light is None:
                return None
            tick()
            finer = next(found for _, found in reversed(request.answers) if isinstance(found, Preview))
            made = None if request.grade is None else finer.as_made(request.grade)
            tick()
            return finer, made, None if request.light is None else finer.lit_by(request.light)
        effects = None
        if request.plan is None:
            tick()
            scene, choice = with_net(request.scene)
            tick()
            request.plan = plan(scene, request.text, tick=tick, pilot=self._pilot)
            effects = next(request.plan) | {"net": None if choice is None else choice.line}
        return effects if stage == "effects" else next(request.plan)


def first_scene() -> Scene:
    """Return a small scene (a lens for letters), whose preview loads libraries and compiles kernels."""
    text = Plate.of().text("first")
    return of_text(text, tables(text, Path("first.toml")), Path("first.toml"))
