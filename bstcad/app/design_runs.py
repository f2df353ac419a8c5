"""Runs in their own processes: the server starts, stops and resumes them, and follows them through files.

A run belongs to a design: the folder .NAME.KIND-run beside the design's folder holds the job, its progress and its
state.  A new server finds the runs of an earlier one, whether they still run, have ended, or were killed.
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

from bstcad.app.design_process import JOB, JOBS, LIGHT, PROGRESS, STATE, State
from bstcad.app.workspace import NAME
from bstcad.designs import folder as folders
from bstcad.report.record import of_json
from bstcad.runs import files
from bstcad.runs.processes import command_of
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene

DESIGN = "design"  # kind of a run that designs a lens; the other kinds work on a finished design
MAX_PROGRESS_SIZE = 50_000_000  # largest size (bytes) of any file of a run that is read; the progress is the longest
SCENE_TEXT = "written.toml"  # file of a run: the text of the scene on the page, with its comments
ENDING_TIMEOUT = 1.0  # time (s) that an ending server waits for its runs; a slow run still writes its checkpoint later
START_TIMEOUT = 30.0  # time (s) in which the process of a run has to start
PROCESS_LOST = "its process was killed, or this machine had too little memory for it"
NO_RUN = State("none")  # state of a run that was never started


@dataclass(frozen=True)
class Run:
    """Run of one kind for a design; it need not have been started."""

    design: Path  # folder of the design
    kind: str = DESIGN  # key of JOBS

    @property
    def folder(self) -> Path:
        """The folder of the run."""
        return files.beside(self.design, f"{self.kind}-run")

    # ---- start and stop ----

    def begin(self, job: Mapping[str, Any] | None = None, contents: Mapping[str, bytes] | None = None) -> None:
        """Start the run in its own process, after deleting the files of an earlier start.  SceneError if it is running.

        job: entries of job.json besides the kind.  contents: other files for the run, by name.
        """
        if self.state.state == "running":
            raise SceneError(f"{self.design.name}: its {self.kind} run has not ended; wait until it ends, or stop it")
        if self.folder.is_symlink() or self.folder.is_file():  # not ours; the target of a link stays as it is
            self.folder.unlink()
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        for name, data in (contents or {}).items():
            files.put(self.folder / name, data)
        files.put(self.folder / JOB, json.dumps({"kind": self.kind, **(job or {})}).encode())
        self._start()

    def go_on(self) -> None:
        """Resume a run that was stopped or killed; a design continues from its checkpoint."""
        if not self.read(JOB):
            raise SceneError(f"{self.design.name}: there is no run to resume; start a new run")
        if self.state.state != "running":
            for path in self.folder.iterdir():
                if path.is_symlink():  # never write through a link
                    path.unlink()
            self._start("--resume")

    def _start(self, *options: str) -> None:
        """Start the process in its own session, so that a Ctrl-C in the terminal does not reach it."""
        source = str(Path(__file__).parents[2])  # the process runs these sources
        paths = os.pathsep.join(filter(None, (source, os.environ.get("PYTHONPATH"))))
        command = [sys.executable, "-m", "bstcad.app.design_process", str(self.folder), str(self.design), *options]
        environment = os.environ | {"PYTHONPATH": paths}
        with (self.folder / "process.log").open("ab") as log:
            pipes = {"stdin": subprocess.DEVNULL, "stdout": log, "stderr": log}
            process = subprocess.Popen(command, **pipes, start_new_session=True, env=environment)
        self._wait_for_start(process)

    def _wait_for_start(self, process: subprocess.Popen) -> None:
        """Wait until the process has written its state, or has ended."""
        until = time.monotonic() + START_TIMEOUT
        while self._written_state().process != process.pid and time.monotonic() < until:
            if process.poll() is not None:  # it has ended already
                if self._written_state() == NO_RUN:
                    sentence = f"its process did not start; {self.folder.name}/process.log states why"
                    State("failed", sentence=sentence).put(self.folder)
                return
            time.sleep(0.01)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the running process: SIGINT ends a design with the best lens so far, SIGTERM at once."""
        state = self.state
        if state.state == "running":
            os.kill(state.process, number)

    # ---- state and progress ----

    @property
    def state(self) -> State:
        """Current state of the run."""
        stated = self._written_state()
        if stated.state in ("stopped", "failed") and self._finished_elsewhere():
            return replace(stated, state="finished", folder=self.design.name, sentence="")
        if stated.state != "running" or self._is_own_process(stated.process):
            return stated
        again = self._written_state()  # it may have ended since the first reading
        if again.state != "running":
            return again
        return replace(again, state="stopped", process=0, sentence=PROCESS_LOST)

    @property
    def final_sentence(self) -> str:
        """Sentence for the terminal about a run that the ending server has stopped."""
        state, name = self.state, f"{self.design.name}: the {self.kind} run"
        if state.state == "running":
            return f"{name} is stopping; run bstcad app in this folder to see it and, if it is a design, to resume it"
        reason = f"{state.sentence}; " if state.sentence else ""
        return f"{name} is {state.state}; {reason}run bstcad app in this folder to see it"

    def _written_state(self) -> State:
        try:
            return of_json(self.read(STATE), State)
        except ValueError:
            return NO_RUN

    def read(self, name: str) -> bytes:
        """Return the bytes of a file of the run; b"" if it is absent, too large or a link out of the designs."""
        try:
            folder = self.folder
            return files.contents(files.within(folder / name, folder.parent), MAX_PROGRESS_SIZE)
        except ValueError:
            return b""

    def _finished_elsewhere(self) -> bool:
        """Return True if another program, such as `bstcad generate --resume`, has finished this design."""
        if self.kind != DESIGN or files.beside(self.design, "checkpoint").exists():
            return False
        try:
            return (self.design / "report.json").stat().st_mtime > (self.folder / STATE).stat().st_mtime
        except OSError:
            return False

    def _is_own_process(self, process: int) -> bool:
        """Return True if the process belongs to this run; the system reuses the ids of ended processes."""
        return str(self.folder) in command_of(process)

    def news(self, since: int) -> dict[str, Any]:
        """Return the state and "lines", the progress from line `since` on: [s since 1970, stage, done, total, text]."""
        state = self.state
        lines = self.read(PROGRESS).decode("utf-8", "replace").split("\n")[:-1]
        progress = [found for line in lines[max(since, 0) :] if (found := _read(line)) is not None]
        resumable = state.state in ("stopped", "failed") and self.kind == DESIGN
        stamp = {"light": self._modification_time(LIGHT), "next": len(lines), "now": time.time()}
        return asdict(state) | stamp | {"lines": progress, "resumable": resumable, "kind": self.kind}

    def _modification_time(self, name: str) -> str:
        try:
            return str((self.folder / name).stat().st_mtime_ns)
        except OSError:
            return ""

    @property
    def light(self) -> bytes:
        """PNG of the light through the best lens so far; b"" before the first one."""
        return self.read(LIGHT)


def _read(line: str) -> list[Any] | None:
    """Parse a line of progress; None for a line that is incomplete after a full disk or a kill."""
    try:
        at, stage, done, total, text = json.loads(line)
    except (ValueError, TypeError, RecursionError):
        return None
    numbers = (type(value) in (int, float) and abs(value) < 1e300 for value in (at, done, total))
    return [at, stage, done, total, text] if all(numbers) and {type(stage), type(text)} == {str} else None


def begin_design(scene: Scene, design: Path, text: str = "") -> Run:
    """Start the design of a scene into a folder; text: text of the scene file, which is stored with the run.

    SceneError if the folder contains other files, or this design is already running.
    """
    files.check_free(design)
    run = Run(design)
    run.begin(contents=folders.scene_files(scene) | {SCENE_TEXT: text.encode()})
    return run


def all_runs(designs: Path) -> list[Run]:
    """Return the runs in a folder of designs, running or ended."""
    found = []
    for kind in JOBS:
        for path in sorted(designs.glob(f".*.{kind}-run")) if designs.is_dir() else ():
            run = Run(designs / path.name[1 : -len(f".{kind}-run")], kind)
            with contextlib.suppress(ValueError):  # a link that leads out of the folder
                files.within(run.design, designs)
                if NAME.fullmatch(run.design.name) and run.read(STATE):
                    found.append(run)
    return found


def end(runs: list[Run]) -> list[Run]:
    """Tell all running runs to end with a checkpoint; return these runs."""
    running = [run for run in runs if run.state.state == "running"]
    for run in running:
        run.signal(signal.SIGTERM)
    return running


def endings(running: list[Run]) -> list[str]:
    """Wait up to ENDING_TIMEOUT for runs that are stopping; return a sentence on each for the terminal."""
    until = time.monotonic() + ENDING_TIMEOUT
    while any(run.state.state == "running" for run in running) and time.monotonic() < until:
        time.sleep(0.1)
    return [run.final_sentence for run in running]
