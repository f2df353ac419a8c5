"""Runs in processes of their own: begun, followed, stopped and gone on with by the files of their folders.

A run belongs to the folder of its design: .NAME.KIND-run beside it holds the job, its progress and its state.  A server
that starts finds runs that an earlier server began, whether they still run, ended meanwhile, or were killed.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from bstcad import folder as folders
from bstcad.app.design_process import JOB, JOBS, LIGHT, STATE, WORDS, State
from bstcad.app.workspace import NAME
from bstcad.report.record import of_json
from bstcad.runs import files
from bstcad.runs.processes import command_of
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene

DESIGN = "design"  # the kind of a run that designs a lens; others are work on a finished design
LARGEST = 50_000_000  # bytes of progress
WRITTEN = "written.toml"  # file of a run: the scene as its page had it, comments and all
GRACE = 1.0  # seconds that the server waits for runs to keep their checkpoints when it ends; they go on with it alone
START = 30.0  # seconds that the process of a run has to start
LOST = "its process was killed, or the memory of this machine was too little for it"
NONE = State("none")


@dataclass(frozen=True)
class Run:
    """The run of a kind that belongs to a design, there or not."""

    design: Path  # its folder
    kind: str = DESIGN  # of JOBS

    @property
    def place(self) -> Path:
        """The folder of the run."""
        return files.beside(self.design, f"{self.kind}-run")

    # ---- begun and ended ----

    def begin(self, job: Mapping[str, Any] | None = None, contents: Mapping[str, bytes] | None = None) -> None:
        """Begin it anew in a process of its own; contents: files for it.  SceneError if it is under way."""
        if self.state.state == "running":
            raise SceneError(f"{self.design.name}: this is under way already; wait for its end, or stop it")
        if self.place.is_symlink() or self.place.is_file():  # somebody's; what a link leads to stays as it is
            self.place.unlink()
        shutil.rmtree(self.place, ignore_errors=True)
        self.place.mkdir(parents=True)
        for name, data in (contents or {}).items():
            files.put(self.place / name, data)
        files.put(self.place / JOB, json.dumps({"kind": self.kind, **(job or {})}).encode())
        self._start()

    def go_on(self) -> None:
        """Go on with a run that was stopped or killed, a design from its checkpoint."""
        if not self.read(JOB):
            raise SceneError(f"{self.design.name}: has no run to go on with; begin it anew")
        if self.state.state != "running":
            for path in self.place.iterdir():
                if path.is_symlink():  # nothing is written through it
                    path.unlink()
            self._start("--resume")

    def _start(self, *options: str) -> None:
        """Start the process, in a session of its own: a Ctrl-C in the terminal is not meant for it."""
        source = str(Path(__file__).parents[2])  # it runs these sources
        paths = os.pathsep.join(filter(None, (source, os.environ.get("PYTHONPATH"))))
        with (self.place / "process.log").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "bstcad.app.design_process", str(self.place), str(self.design), *options],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
                env=os.environ | {"PYTHONPATH": paths},
            )  # fmt: skip
        self._await(process)

    def _await(self, process: subprocess.Popen) -> None:
        """Wait until the process has stated that it runs; it alone writes its state."""
        until = time.monotonic() + START
        while self._stated().process != process.pid and time.monotonic() < until:
            if process.poll() is not None:  # it has ended already
                if self._stated() == NONE:
                    State("failed", sentence="its process did not start; process.log in its folder says why").put(
                        self.place
                    )
                return
            time.sleep(0.01)

    def signal(self, number: signal.Signals) -> None:
        """Send its process a signal, if it runs: SIGINT ends a design with the best lens so far, SIGTERM at once."""
        state = self.state
        if state.state == "running":
            os.kill(state.process, number)

    # ---- followed ----

    @property
    def state(self) -> State:
        """How it stands."""
        stated = self._stated()
        if stated.state in ("stopped", "failed") and self._finished_elsewhere():
            return replace(stated, state="finished", folder=self.design.name, sentence="")
        if stated.state != "running" or self._lives(stated.process):
            return stated
        again = self._stated()  # it may have ended between the two looks
        if again.state != "running":
            return again
        return replace(again, state="stopped", process=0, sentence=LOST)

    @property
    def ending(self) -> str:
        """How it ended, or is about to, after the server asked it to."""
        state, name = self.state, f"{self.design.name}: the {self.kind}"
        if state.state == "running":
            return f"{name} is being stopped, and keeps what it has; bstcad app in this folder goes on with it"
        kept = f"{state.sentence}; " if state.sentence else ""
        return f"{name} is {state.state}; {kept}bstcad app in this folder shows it"

    def _stated(self) -> State:
        try:
            return of_json(self.read(STATE), State)
        except ValueError:
            return NONE

    def read(self, name: str) -> bytes:
        """The bytes of a file of the run; b"" if there is none, or it lies outside of the folder of the designs."""
        try:
            place = self.place
            return files.contents(files.within(place / name, place.parent), LARGEST)
        except ValueError:
            return b""

    def _finished_elsewhere(self) -> bool:
        """Did another program, such as `bstcad generate --resume`, go on with this design to its end?"""
        if self.kind != DESIGN or files.beside(self.design, "checkpoint").exists():
            return False
        try:
            return (self.design / "report.json").stat().st_mtime > (self.place / STATE).stat().st_mtime
        except OSError:
            return False

    def _lives(self, process: int) -> bool:
        """Is that process the one of this run?  The system gives the numbers of ended processes to others."""
        return str(self.place) in command_of(process)

    def news(self, since: int) -> dict[str, Any]:
        """Its state, and the lines of its progress from number `since` on.

        A line is [seconds since 1970, stage, done, total, text].
        """
        state = self.state
        lines = self.read(WORDS).decode("utf-8", "replace").split("\n")[:-1]
        told = [found for line in lines[max(since, 0) :] if (found := _read(line)) is not None]
        resumable = state.state in ("stopped", "failed") and self.kind == DESIGN
        stamp = {"light": self._stamp(LIGHT), "next": len(lines), "now": time.time()}
        return asdict(state) | stamp | {"lines": told, "resumable": resumable, "kind": self.kind}

    def _stamp(self, name: str) -> str:
        try:
            return str((self.place / name).stat().st_mtime_ns)
        except OSError:
            return ""

    @property
    def light(self) -> bytes:
        """The PNG of the light through the best lens so far; b"" before there is one."""
        return self.read(LIGHT)


def _read(line: str) -> list[Any] | None:
    """A line of progress; None for one that a full disk or a kill has cut."""
    try:
        at, stage, done, total, text = json.loads(line)
    except (ValueError, TypeError, RecursionError):
        return None
    numbers = (type(value) in (int, float) and abs(value) < 1e300 for value in (at, done, total))  # for a page
    return [at, stage, done, total, text] if all(numbers) and {type(stage), type(text)} == {str} else None


def begin_design(scene: Scene, design: Path, text: str = "") -> Run:
    """Design a scene into a folder, and keep the text that it was made of.

    SceneError where that folder is another's, or a run is under way.
    """
    files.check_free(design)
    run = Run(design)
    run.begin(contents=folders.scene_files(scene) | {WRITTEN: text.encode()})
    return run


def all_runs(designs: Path) -> list[Run]:
    """The runs in a folder of designs, under way or ended."""
    found = []
    for kind in JOBS:
        for path in sorted(designs.glob(f".*.{kind}-run")) if designs.is_dir() else ():
            run = Run(designs / path.name[1 : -len(f".{kind}-run")], kind)
            with contextlib.suppress(ValueError):  # a link leads out of the folder
                files.within(run.design, designs)
                if NAME.fullmatch(run.design.name) and run.read(STATE):
                    found.append(run)
    return found


def end(runs: list[Run]) -> list[Run]:
    """Have runs end before the server ends, each with its checkpoint; those that ran."""
    running = [run for run in runs if run.state.state == "running"]
    for run in running:
        run.signal(signal.SIGTERM)
    return running


def endings(running: list[Run]) -> list[str]:
    """Wait a moment for runs that were asked to end; a sentence on each, for the terminal."""
    until = time.monotonic() + GRACE
    while any(run.state.state == "running" for run in running) and time.monotonic() < until:
        time.sleep(0.1)
    return [run.ending for run in running]
