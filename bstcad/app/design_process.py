"""A run of the workbench in a process of its own, which outlives page and server: a design, or work on a finished one.

python -m bstcad.app.design_process FOLDER DESIGN [--resume] does the job of FOLDER/job.json.  Everything that the page
shows lies in that folder too: a line for each word of progress, a picture of the light through the best lens so far,
and how the run stands.  SIGINT ends a design with the best lens so far, SIGTERM at once with a checkpoint; then, and
after a SIGKILL, `--resume` ends in the same lens, to the last bit.
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

JOB, SCENE, CLOUD = "job.json", "scene.toml", "cloud"  # a measured part's points, with the ending of their kind
WORDS, LIGHT, STATE = "progress.jsonl", "light.png", "state.json"
LARGEST = 1_000_000  # bytes of a job
SIZE = 512  # pixels of the picture of the light, at most
TUBES = 521  # ray tubes a side, by which it is taken
EACH, SHARE = 2.0, 0.03  # seconds between two pictures, at least; the most of the time that they may take
SPREAD_POINTS = 16  # of a source of some size, that the picture is taken by


@dataclass(frozen=True)
class State:
    """How a run stands."""

    __pydantic_config__ = {"extra": "forbid", "strict": True, "allow_inf_nan": False}  # rules for reading a file

    state: str  # running | finished | stopped | refused | failed
    process: int = 0  # its number, while it runs
    began: float = 0.0  # seconds since 1970
    passed: bool | None = None
    rrmsd: float | None = None
    folder: str = ""  # the name of the folder that holds the lens, if there is one
    sentence: str = ""  # why it stopped, was refused or failed

    def put(self, run: Path) -> None:
        """Write it into a run's folder."""
        files.put(run / STATE, json.dumps(asdict(self)).encode())


class Words:
    """The progress of a run, a line of JSON each: seconds since 1970, stage, done, total and text."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", encoding="utf-8")

    def __call__(self, stage: str, done: int, total: int, text: str) -> None:
        """As runs.progress.Report."""
        with contextlib.suppress(OSError):  # a full disk does not end a design
            self._file.write(json.dumps([round(time.time(), 3), stage, done, total, text]) + "\n")
            self._file.flush()


class Glance:
    """Draws the light through the best lens so far, now and then."""

    def __init__(self, scene: Any, path: Path) -> None:
        self._scene, self._path, self._due = scene, path, time.monotonic()

    def __call__(self, make: Callable[[], Any]) -> None:
        """Called with the function that makes the lens."""
        if time.monotonic() < self._due:
            return
        began = time.monotonic()
        with contextlib.suppress(Exception):  # a picture to look at, which the design does not need
            self._draw(make())
        ended = time.monotonic()
        self._due = ended + max(EACH, (ended - began) / SHARE)

    def _draw(self, lens: Any) -> None:
        from PIL import Image

        from bstcad.optics.measure import side_factor, tubes_picture
        from bstcad.report.light_figures import View

        scene, target = self._scene, self._scene.target
        channels = scene.channels(SPREAD_POINTS) if scene.source.extent else scene.channels()
        screen, n = target.screen, max(round(TUBES * side_factor(channels)), 64)
        light, wanted = tubes_picture(lens.plain(), channels, screen, n).numpy(), target.irradiance()
        if not light.sum() > 0:
            return
        view, scaled = View.of(scene), light * (wanted.sum() / light.sum())
        image = Image.fromarray(view.picture(view.tones(scaled, wanted)).copy())
        image.thumbnail((SIZE, SIZE))
        written = io.BytesIO()
        image.save(written, "png")
        files.put(self._path, written.getvalue())


# ---- the jobs --------------------------------------------------------------------------------------------------------


def design(job: Mapping[str, Any], place: Path, output: Path, resume: bool) -> State:
    """Design the scene of the run's folder into `output`."""
    from bstcad import commands
    from bstcad.scene.scene import load

    scene = load(place / SCENE)
    report = commands.generate(
        scene, output, progress=Words(place / WORDS), began=time.perf_counter(), resume=resume,
        look=Glance(scene, place / LIGHT),
    )  # fmt: skip
    found = report.contents
    if report.stopped != "interrupt":
        return State("finished", passed=found.passed, rrmsd=found.rrmsd, folder=output.name)
    lens = commands.place_for(output, "interrupt").name
    return State(
        "stopped", passed=found.passed, rrmsd=found.rrmsd, folder=lens, sentence="ended with the best lens so far"
    )


def tolerance(job: Mapping[str, Any], place: Path, output: Path, resume: bool) -> State:
    """How exactly the lens must be made, mounted and lit; job: grade, and yield (0 to 1), each perhaps None."""
    from bstcad import commands

    commands.tolerance(output, grade=job.get("grade"), wanted=job.get("yield"), progress=Words(place / WORDS))
    return State("finished", folder=output.name)


def tradeoff(job: Mapping[str, Any], place: Path, output: Path, resume: bool) -> State:
    """The price of accuracy in time, into the folder NAME-tradeoff beside the design; job: budget (s)."""
    from bstcad.runs.progress import Throttled
    from bstcad.scene.scene import load
    from bstcad.sweep import tradeoff as sweeping

    folder = output.with_name(f"{output.name}-tradeoff")
    told = Throttled(Words(place / WORDS), EACH)
    found = sweeping.tradeoff(load(output / SCENE), folder, budget=job["budget"], progress=told)
    return State("finished", passed=bool(found.lenses), folder=folder.name)


def measured(job: Mapping[str, Any], place: Path, output: Path, resume: bool) -> State:
    """Judge a made part by its measured points, whose file lies in the run's folder."""
    from bstcad import commands

    [cloud] = place.glob(f"{CLOUD}.*")
    found = commands.verify(output, measured=cloud, progress=Words(place / WORDS)).contents
    part = found.measured or {}
    return State("finished", passed=part.get("passed"), rrmsd=part.get("rrmsd_predicted"), folder=output.name)


JOBS = {work.__name__: work for work in (design, tolerance, tradeoff, measured)}


# ---- the process -----------------------------------------------------------------------------------------------------


def main(folder: str, output: str, *options: str) -> int:
    """Do the job of a run's folder, and keep there how it ended; the exit code."""
    place, began = Path(folder), time.time()
    State("running", os.getpid(), began).put(place)
    try:
        with signals.endings():
            job = json.loads(files.contents(place / JOB, LARGEST))
            ended = JOBS[job["kind"]](job, place, Path(output), "--resume" in options)
    except BaseException as error:
        ended = _ended(error)
        if ended.state == "failed":
            traceback.print_exc()
    replace(ended, began=began).put(place)
    processes.end()
    return 0 if ended.state == "finished" else 1


def _ended(error: BaseException) -> State:
    """How a run ended that wrote no lens."""
    said = note(error)
    if signals.ended() or isinstance(error, KeyboardInterrupt):
        kept = "the design so far is kept" if "is kept" in said else "nothing is kept"
        return State("stopped", sentence=kept)
    if isinstance(error, SentenceError):
        return State("refused", sentence="; ".join(filter(None, (str(error), said))))
    words = f"{type(error).__name__}: {files.first_line(error)}"
    return State("failed", sentence="; ".join(filter(None, (files.one_line(words), said))))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
