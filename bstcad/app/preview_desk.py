"""The thread that makes previews: the newest scene of each page first, and what takes longer once nothing is asked.

Each request of a page replaces its request before, whose work ends at its next step.  Its answers come in the order of
STAGES: a preview at once, a settled preview, the effects that are left out, predictions of each quality.  On two cores
two previews at a time would each take twice as long: so there is one thread.
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

from bstcad.app.preview import AT_ONCE, SETTLED, Outdated, preview
from bstcad.runs import processes
from bstcad.scene.new_scene import Plate
from bstcad.scene.scene import Scene, of_text
from bstcad.scene.scene_file import tables
from bstcad.sweep.net_choice import with_net
from bstcad.sweep.plan import plan

STAGES = ("preview", "settled", "effects", "predicted")
MOST = 32  # pages whose last request is kept
IDLE = 0.7  # seconds after a preview in which another change may come; then work on later answers begins
ENDING = 0.5  # seconds that the thread has to end
LEFT = 60.0  # seconds without a word from a page, after which nobody waits for its answers


@dataclass(eq=False)
class Request:
    """A scene whose previews a page waits for."""

    page: str
    number: int  # of the page's requests
    scene: Scene
    text: str = ""  # of its file, whose lines a plan names
    answers: list[tuple[str, Any]] = field(
        default_factory=list
    )  # (stage, answer), an answer an Exception where it failed
    replaced: bool = False  # by a later request of the page
    shown: float = math.inf  # when its preview was made
    heard: float = field(default_factory=time.monotonic)  # when the page asked last
    plan: Iterator[dict[str, Any]] | None = None  # whose first part has been made

    @property
    def done(self) -> bool:
        """Are all answers there, or is nobody waiting for more?"""
        return self.replaced or len(self.answers) == len(STAGES) or time.monotonic() > self.heard + LEFT


class PreviewDesk:
    """Takes requests of pages, and makes their answers in a thread."""

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._requests: dict[str, Request] = {}  # the last one of each page
        self._ended = False
        self._thread = threading.Thread(target=self._work, name="previews", daemon=True)
        self._thread.start()

    def ask(self, request: Request) -> None:
        """Take a request; an older one of the page is dropped."""
        with self._news:
            before = self._requests.pop(request.page, None)
            if before is not None and before.number > request.number:  # they came in another order
                request.replaced = True
                self._requests[request.page] = before
            else:
                if before is not None:
                    before.replaced = True
                self._requests[request.page] = request
                while len(self._requests) > MOST:
                    self._requests.pop(next(iter(self._requests))).replaced = True
            self._news.notify_all()

    def answer(self, request: Request, stage: int, patience: float) -> tuple[str, Any] | None:
        """Wait for an answer by its number; None if it is not there in so many seconds, or nobody waits for it."""
        with self._news:
            request.heard = time.monotonic()
            self._news.notify_all()  # it may have been given up
            self._news.wait_for(lambda: len(request.answers) > stage or request.replaced or self._ended, patience)
            return request.answers[stage] if len(request.answers) > stage else None

    def last(self, page: str) -> Request | None:
        """The last request of a page."""
        with self._news:
            return self._requests.get(page)

    def forget(self, page: str) -> None:
        """Nobody waits for answers to a page any more."""
        with self._news:
            if (request := self._requests.pop(page, None)) is not None:
                request.replaced = True

    def close(self) -> None:
        """Drop all requests: nobody waits for an answer any more."""
        with self._news:
            self._ended = True
            for request in self._requests.values():
                request.replaced = True
            self._news.notify_all()

    def end(self) -> None:
        """Drop all requests, and end the thread; one that compiles a kernel ends with the process."""
        self.close()
        self._thread.join(timeout=ENDING)

    # ---- the thread ----

    def _work(self) -> None:
        with contextlib.suppress(Exception):  # libraries load, and kernels compile, before anybody waits for them
            preview(first_scene(), outdated=lambda: self._ended or bool(self._requests))
        while True:
            with self._news:
                while not self._ended and self._next() is None:
                    self._news.wait(IDLE / 4 if self._unanswered() else None)
                if self._ended:
                    return
                request = self._next()
            self._serve(request)

    def _next(self) -> Request | None:
        """The request with the fewest answers, of these the latest: a new request comes first."""
        now = time.monotonic()
        waiting = [each for each in self._unanswered() if not each.answers or now > each.shown + IDLE]
        return min(reversed(waiting), key=lambda request: len(request.answers), default=None)

    def _unanswered(self) -> list[Request]:
        return [request for request in self._requests.values() if not request.done]

    def _serve(self, request: Request) -> None:
        """Make the next answer of a request; left without, it is made again later if it is still wanted."""
        stage = STAGES[len(request.answers)]
        try:
            found = self._made(request, stage)
        except Outdated:
            request.plan = None
            return
        except Exception as fault:  # a refusal, or a fault: a preview that fails must not end the thread
            found = fault
        processes.return_freed()  # sizes change from preview to preview: holes that nothing fits in would add up
        with self._news:
            failed = stage == "preview" and isinstance(found, Exception)
            request.shown = min(request.shown, time.monotonic())
            request.answers += [(each, found) for each in (STAGES if failed else (stage,))]
            self._news.notify_all()

    def _made(self, request: Request, stage: str) -> Any:
        """The answer of a stage: a preview, or entries of `plan --json`, behind the effects the `net` that is chosen.

        Outdated once the request is replaced, or another one has fewer answers.
        """

        def outdated() -> bool:
            had, others = len(request.answers), list(self._requests.values())
            return request.replaced or self._ended or any(not o.done and len(o.answers) < had for o in others)

        def tick() -> None:
            if outdated():
                raise Outdated

        if stage in ("preview", "settled"):
            return preview(request.scene, AT_ONCE if stage == "preview" else SETTLED, outdated)
        effects = None
        if request.plan is None:  # or its work was given up
            tick()
            scene, choice = with_net(request.scene)
            tick()
            request.plan = plan(scene, request.text, tick=tick)
            effects = next(request.plan) | {"net": None if choice is None else choice.line}
        return effects if stage == "effects" else next(request.plan)


def first_scene() -> Scene:
    """A scene for which nobody has to wait: letters by a plate."""
    text = Plate.of().text("first")
    return of_text(text, tables(text, Path("first.toml")), Path("first.toml"))
