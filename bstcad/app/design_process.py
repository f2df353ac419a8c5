"""A job of the workbench in its own process: a design, or work on a finished design.  Closing the page does not end it.

python -m bstcad.app.design_process FOLDER DESIGN [--resume] does the job of FOLDER/job.json for the design in the
folder DESIGN.  The process writes into FOLDER what the page shows: progress, light of the best lens, and state.
SIGINT ends a design with the best lens so far; SIGTERM ends it at once with a checkpoint.  After SIGTERM or SIGKILL,
`--resume` ends with the lens of an uninterrupted design, to the last bit.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from bstcad.runs import files, processes, signals
from bstcad.runs.files import SentenceError, note

JOB, SCENE = "job.json", "scene.toml"  # input files of a run
CLOUD = "cloud"  # stem of the file with the measured points; the suffix states the format
PROGRESS, LIGHT, STATE = "progress.jsonl", "light.png", "state.json"  # output files of a run
MAX_JOB_SIZE = 1_000_000  # largest size of job.json (bytes)
MAX_PICTURE_SIDE = 512  # largest length of the longer side of the picture of the light (pixels)
TUBES_PER_SIDE = 521  # flux tubes per side for the picture of the light; fewer for an extended source
MIN_INTERVAL = 2.0  # shortest time (s) between two pictures; in a trade-off, also between equal lines of progress
MAX_TIME_FRACTION = 0.03  # largest fraction of the run's time that the pictures may take
SOURCE_POINTS = 16  # points that represent an extended source in the picture


@dataclass(frozen=True)
class State:
    """State of a run, the contents of state.json."""

    __pydantic_config__ = {"extra": "forbid", "strict": True, "allow_inf_nan": False}  # rules for reading a file

    state: str  # running | finished | stopped | refused | failed; none: there is no run
    process: int = 0  # process id while the run is running, else 0
    began: float = 0.0  # start of the run, seconds since 1970
    passed: bool | None = None  # True if all checks passed, or a trade-off has a lens; None: nothing was checked
    rrmsd: float | None = None  # RRMSD of the design, or as predicted for a made part; None: unknown
    folder: str = ""  # name of the folder with the result; "" without one
    sentence: str = ""  # reason why the run stopped, was refused or failed
    files: tuple[str, ...] = ()  # names of files that an export has written into the design's folder

    def put(self, run: Path) -> None:
        """Write the state into a run's folder."""
        files.put(run / STATE, json.dumps(asdict(self)).encode())


class ProgressFile:
    """Progress function that appends lines of JSON to a file: [seconds since 1970, stage, done, total, text]."""

    def __init__(self, path: Path) -> None:
        self._path = path
        path.touch()
        if path.stat().st_size:  # a continued run: a line without a stage marks the end of its pause
            self("", 0, 0, "continued")

    def __call__(self, stage: str, done: int, total: int, text: str) -> None:
        """Append one line, unless the disk is full: a design goes on without it."""
        with contextlib.suppress(OSError), self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([round(time.time(), 3), stage, done, total, text]) + "\n")


class LightSnapshot:
    """Callback that draws the light through the best lens so far, at intervals."""

    def __init__(self, scene: Any, path: Path) -> None:
        self._scene, self._path, self._due = scene, path, time.monotonic()

    def __call__(self, make: Callable[[], Any]) -> None:
        """Draw the light of the lens that `make` returns, if a picture is due."""
        if time.monotonic() < self._due:
            return
        began = time.monotonic()
        with contextlib.suppress(Exception):  # the design does not depend on this picture
            self._draw(make())
        ended = time.monotonic()
        self._due = ended + max(MIN_INTERVAL, (ended - began) / MAX_TIME_FRACTION)

    def _draw(self, lens: Any) -> None:
        from PIL import Image

        from bstcad.figures.light_figures import View
        from bstcad.optics.trace.measure import side_factor, tubes_picture

        scene, target = self._scene, self._scene.target
        channels = scene.channels(SOURCE_POINTS) if scene.source.extent else scene.channels()
        screen, n = target.screen, max(round(TUBES_PER_SIDE * side_factor(channels)), 64)
        light, wanted = tubes_picture(lens.plain(), channels, screen, n).numpy(), target.irradiance()
        if not light.sum() > 0:
            return
        view, scaled = View.of(scene), light * (wanted.sum() / light.sum())
        image = Image.fromarray(view.picture(view.tones(scaled, wanted)).copy())
        image.thumbnail((MAX_PICTURE_SIDE, MAX_PICTURE_SIDE))
        written = io.BytesIO()
        image.save(written, "png")
        files.put(self._path, written.getvalue())


# ---- the jobs --------------------------------------------------------------------------------------------------------


def design(job: Mapping[str, Any], run_folder: Path, output: Path, resume: bool) -> State:
    """Design the scene of the run's folder into `output`; resume: continue from the checkpoint."""
    copied = processes.is_new()
    from bstcad import commands
    from bstcad.scene.scene import load

    processes.begin(copied=copied)
    scene = load(run_folder / SCENE)
    hooks = commands.Hooks(ProgressFile(run_folder / PROGRESS), on_lens=LightSnapshot(scene, run_folder / LIGHT))
    report = commands.generate(scene, output, hooks=hooks, resume=resume, began=time.perf_counter())
    found = report.contents
    if report.stopped != "interrupt":
        return State("finished", passed=found.passed, rrmsd=found.rrmsd, folder=output.name)
    lens = commands.output_folder(output, "interrupt").name
    return State(
        "stopped", passed=found.passed, rrmsd=found.rrmsd, folder=lens, sentence="ended with the best lens so far"
    )


def tolerance(job: Mapping[str, Any], run_folder: Path, output: Path, resume: bool) -> State:
    """Study the tolerances of a finished design.  job: grade and yield (0 to 1), each of which may be None."""
    from bstcad import commands
    from bstcad.manufacture.tolerance.study import StudySettings

    progress = ProgressFile(run_folder / PROGRESS)
    commands.tolerance(output, StudySettings(job.get("grade"), job.get("yield"), progress=progress))
    return State("finished", folder=output.name)


def tradeoff(job: Mapping[str, Any], run_folder: Path, output: Path, resume: bool) -> State:
    """Study the trade-off of time against accuracy, in the folder NAME-tradeoff beside the design.  job: budget (s)."""
    from bstcad.planning import tradeoff as sweeping
    from bstcad.runs.progress import Throttled
    from bstcad.scene.scene import load

    folder = output.with_name(f"{output.name}-tradeoff")
    throttled = Throttled(ProgressFile(run_folder / PROGRESS), MIN_INTERVAL)
    found = sweeping.tradeoff(load(output / SCENE), folder, budget=job["budget"], progress=throttled)
    return State("finished", passed=bool(found.runs_with_lens), folder=folder.name)


def measured(job: Mapping[str, Any], run_folder: Path, output: Path, resume: bool) -> State:
    """Judge a made part by the file of measured points in the run's folder."""
    from bstcad import commands

    [cloud] = run_folder.glob(f"{CLOUD}.*")
    found = commands.verify(output, measured=cloud, progress=ProgressFile(run_folder / PROGRESS)).contents
    part = found.measured or {}
    return State("finished", passed=part.get("passed"), rrmsd=part.get("rrmsd_predicted"), folder=output.name)


def compensate(job: Mapping[str, Any], run_folder: Path, output: Path, resume: bool) -> State:
    """Write what to cut next, from the file of measured points in the run's folder."""
    from bstcad import commands

    [cloud] = run_folder.glob(f"{CLOUD}.*")
    found = commands.compensate(output, [cloud], progress=ProgressFile(run_folder / PROGRESS))
    return State("finished", rrmsd=found.figures["rrmsd"]["expected"], folder=found.folder.name)


def retailor(job: Mapping[str, Any], run_folder: Path, output: Path, resume: bool) -> State:
    """Tailor the back anew to a blank as built.  job: thickness (mm) and index, one of which may be None."""
    from bstcad import commands
    from bstcad.manufacture.shop.as_built import AsBuilt

    hooks = commands.Hooks(ProgressFile(run_folder / PROGRESS))
    built = AsBuilt(job.get("thickness"), job.get("index"))
    folder, report, _ = commands.retailor(output, built, hooks=hooks)
    return State("finished", passed=report.contents.passed, rrmsd=report.contents.rrmsd, folder=folder.name)


def export(job: Mapping[str, Any], run_folder: Path, output: Path, resume: bool) -> State:
    """Write files for a shop into the design's folder.  job: kind, tool_radius (mm) or None, tiles such as "2x3"."""
    from bstcad import commands

    ProgressFile(run_folder / PROGRESS)("export", 0, 1, job["kind"])
    cutting = {"tool_radius": job["tool_radius"]} if job["tool_radius"] else {}
    written = commands.export(output, [job["kind"]], cutting=cutting, tiles=job["tiles"] or None)
    return State("finished", folder=output.name, files=tuple(path.name for path in written.paths))


# functions by kind of run
JOBS = {work.__name__: work for work in (design, tolerance, tradeoff, measured, compensate, retailor, export)}
STUDIES = tuple(kind for kind in JOBS if kind != design.__name__)  # kinds of runs of a finished design


# ---- the process -----------------------------------------------------------------------------------------------------


def main(folder: str, output: str, *options: str) -> int:
    """Do the job of the run in `folder` for the design in `output`, and write the run's state; return the exit code."""
    run_folder, began = Path(folder), time.time()
    State("running", os.getpid(), began).put(run_folder)
    try:
        with signals.raise_terminated():
            job = json.loads(files.contents(run_folder / JOB, MAX_JOB_SIZE))
            ended = JOBS[job["kind"]](job, run_folder, Path(output), "--resume" in options)
    except BaseException as error:
        ended = _final_state(error)
        if ended.state == "failed":
            traceback.print_exc()
    replace(ended, began=began).put(run_folder)
    processes.end()
    return 0 if ended.state == "finished" else 1


def _final_state(error: BaseException) -> State:
    notes = note(error)
    if signals.termination() or isinstance(error, KeyboardInterrupt):
        sentence = "the work so far is kept" if "is kept" in notes else "nothing is kept"
        return State("stopped", sentence=sentence)
    if isinstance(error, SentenceError):
        return State("refused", sentence="; ".join(filter(None, (str(error), notes))))
    words = f"{type(error).__name__}: {files.first_line(error)}"
    return State("failed", sentence="; ".join(filter(None, (files.one_line(words), notes))))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
