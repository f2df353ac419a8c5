"""Designs in cold processes: their seconds and their error, the calibration of this machine, and records on disk.

A run takes the seconds of the whole command: imports, picture, tailoring, writing and proof.  One reference judges the
lenses of all runs: stratified rays on the pixels of the base scene.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import torch
from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer
from typing_extensions import TypedDict

from bstcad.folder import SCENE, read_nominal, scene_files
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.channels import Channel
from bstcad.optics.collimated import Collimated
from bstcad.optics.goal import Goal
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.measure import Effort, measure
from bstcad.optics.outlines import Rectangle
from bstcad.optics.surfaces import Plane
from bstcad.runs import environment, files, processes
from bstcad.runs.cluster import THIS_MACHINE, Answer
from bstcad.scene.errors import MachineError, SceneError
from bstcad.scene.scene import Scene, load
from bstcad.tailoring.merit import Merit
from bstcad.tailoring.stage2 import Problem

# --- records ----------------------------------------------------------------------------------------------------------

LARGEST = 100_000_000  # bytes of a file
DIGITS = 6


class Stored(BaseModel):
    """A frozen record that a file holds."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


Record = TypeVar("Record", bound=Stored)


def read(kind: type[Record], path: Path, remedy: str) -> Record:
    """The record that a file holds; MachineError if the file is damaged or foreign."""
    try:
        return kind.model_validate_json(files.contents(path, LARGEST))
    except ValueError:  # pydantic's errors are ValueErrors
        raise MachineError(f"{path}: is damaged, or another program's; {remedy}") from None


def put(path: Path, record: Stored) -> None:
    """Write a record whole, every digit of it."""
    files.put(path, f"{record.model_dump_json(indent=1)}\n".encode())


def rounded(value: Any, digits: int = DIGITS) -> Any:
    """A JSON value with numbers of so many digits; null for a number that is not finite."""
    if isinstance(value, Mapping):
        return {key: rounded(part, digits) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(part, digits) for part in value]
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    return value


def put_table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write these columns of all rows as CSV."""
    text = io.StringIO()
    lines = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    lines.writeheader()
    lines.writerows(rows)
    files.put(path, text.getvalue().encode())


def unpacked(contents: Mapping[str, bytes], folder: Path) -> Path:
    """The scene file, written into a folder beside its pictures; contents: by file name."""
    for name, data in contents.items():
        (folder / name).write_bytes(data)
    return folder / SCENE


LOOK = 0.2  # seconds between two looks whether a process has ended


class LocalPool:
    """Some child processes at a time, each with a thread that waits for it.

    Processes that still work when the block ends are ended, and keep their checkpoints.
    """

    def __init__(self, room: int) -> None:
        self.capacity = room
        self._threads, self._ends = ThreadPoolExecutor(room), threading.Event()
        self._keys: dict[Future, Any] = {}

    def __enter__(self) -> LocalPool:
        return self

    def __exit__(self, *error: object) -> None:
        self._ends.set()
        self._threads.shutdown(cancel_futures=True)

    def start(self, key: Any, work: Callable[..., Any], *arguments: Any) -> None:
        """Have work(*arguments, tick) done, which calls `tick` all the while."""
        self._keys[self._threads.submit(work, *arguments, self._tick)] = key

    def next(self, tick: Callable[[], None]) -> Answer:
        """Wait for a process that has ended."""
        while True:
            for future in wait(self._keys, timeout=LOOK, return_when=FIRST_COMPLETED).done:
                key, error = self._keys.pop(future), future.exception()
                if error is not None:
                    return Answer(key, THIS_MACHINE, reason=f"{type(error).__name__}: {error}")
                return Answer(key, THIS_MACHINE, future.result())
            tick()

    def _tick(self) -> None:
        if self._ends.is_set():
            raise InterruptedError("nobody waits for it any more")


# --- calibration ------------------------------------------------------------------------------------------------------

TUBES, PIXELS = 1024, 512  # a side
NET, WIDTH, THICKNESS, INDEX = 257, 20.0, 5.0, 1.49  # control points a side; mm
SCREEN = 200.0  # mm from the front
WAVE, PERIODS = 0.003, 3  # mm; over the width
REPEATS = 3  # of an evaluation, at least


def timed(work: Callable[[], object]) -> float:
    """Seconds that some work takes."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


@cache
def kernel(tubes: int = TUBES) -> Callable[[], Any]:
    """The evaluation of merit and gradient by ray tubes through a fixed small lens; it is set up once a process."""
    u = torch.linspace(-math.pi * PERIODS, math.pi * PERIODS, NET, dtype=torch.float64)
    outline, span = Rectangle(WIDTH, WIDTH), (-WIDTH / 2, WIDTH / 2)
    back = BSplineSurface(THICKNESS, WAVE * u.cos()[:, None] * u.cos(), span, span)
    lens = Lens(Plane(0.0), back, outline, INDEX)
    target = np.full((PIXELS, PIXELS), 1.0)
    channel, screen = Channel(Collimated(outline), INDEX), Screen(SCREEN, span, span, PIXELS)
    merit = Merit.of((channel,), lens, tubes, [Goal("target", screen, target)], overshoot=0.03)
    once = partial(Problem(lens, merit), [back.heights])
    once()  # compiles and allocates
    return once


# --- runs -------------------------------------------------------------------------------------------------------------

Value = int | float | str | tuple[int, int]
Settings = tuple[tuple[str, Value], ...]  # (dotted key of the scene, value), sorted by key; () is the base

DONE, FAILED, NOT_RUN = "done", "failed", "not run: budget"
REFERENCE = Effort(witness=False)  # of the judge: by rays alone, which no lens was tailored by
SMALLEST = {  # a run whose time does not count: kernels are compiled, libraries come from the disk
    "lens.back.control_points": 33, "tailoring.quality": "draft", "tailoring.rays": 96,
    "tailoring.transport_grid": 64, "tailoring.levels": None,
}  # fmt: skip
SMALLEST_PIXELS = 64  # a side of each target in it
Tick = Callable[[], None]  # is called while a command runs


def settings(entries: Mapping[str, Value]) -> Settings:
    """Settings in their order."""
    return tuple(sorted(entries.items()))


def as_text(value: Value) -> str:
    """A value as --set takes it."""
    return f"[{value[0]}, {value[1]}]" if isinstance(value, tuple) else str(value)


def _from_json(entries: Any) -> Any:
    if not isinstance(entries, Mapping):
        return entries
    return settings({key: tuple(value) if isinstance(value, list) else value for key, value in entries.items()})


StoredSettings = Annotated[Settings, BeforeValidator(_from_json), PlainSerializer(dict)]  # an object of JSON


class HistoryPoint(TypedDict):
    """RRMSD of a design by its own tubes."""

    seconds: float  # since its start
    rrmsd: float | None  # None: not finite


class Run(Stored):
    """How a run went; seconds are of the machine that it ran on, None where it was not run."""

    settings: StoredSettings  # the changes of the base
    status: str  # DONE, FAILED or NOT_RUN
    reason: str = ""  # why it failed
    label: str = ""  # in words: "Ray tubes a side: 768"
    knobs: tuple[str, ...] = ()  # keys of the knobs that it is a point of; "base": of all
    where: str = THIS_MACHINE  # or the address of a worker; "": nowhere
    seconds: float | None = 0.0  # of the whole command
    cpu_seconds: float | None = 0.0  # of the command and of all processes that it started
    kernel_seconds: float | None = 0.0  # of the calibration kernel, before this run
    units: float | None = None  # seconds / kernel_seconds
    cost_seconds: float | None = 0.0  # of the budget: with judging and calibration
    predicted_seconds: float | None = None  # of the budget, before the run began
    peak_memory_gb: float | None = None  # of both its processes, as a sum
    rrmsd: float | None = None  # by the reference; of several targets the largest
    rrmsd_noise: float | None = None  # standard error of that
    rays: int | None = None  # of the reference
    rrmsd_reported: float | None = None  # by its own proof, on its own pixels
    rrmsd_noise_reported: float | None = None  # its standard error
    passed: bool | None = None  # every check of the proof
    net: str = ""  # SHA-256 of the control net: equal nets are equal lenses to the last bit
    stages: tuple[dict[str, Any], ...] = ()  # name, seconds, rrmsd after it; None: not judged
    on_front: bool = False  # of the sweep
    # not in tradeoff.json
    allowed_seconds: float | None = None  # after which it was ended; None: it ended by itself
    history: tuple[HistoryPoint, ...] = ()  # the convergence curve of the run
    machine: dict[str, Any] = {}  # that ran it
    versions: dict[str, str] = {}  # of the libraries, by name
    version: str = ""  # of bstcad, with a hash of its sources

    @property
    def done(self) -> bool:
        """Is there a lens?"""
        return self.status == DONE

    @property
    def comparable(self) -> bool:
        """Do its seconds compare?  Seconds of this machine do, since its runs follow each other."""
        return self.done and self.where == THIS_MACHINE


def carry_out(
    contents: Mapping[str, bytes], point: Settings, limit: float = math.inf, effort: Effort = REFERENCE,
    tick: Tick = lambda: None,
) -> Run:  # fmt: skip
    """Run the command for a base scene with these settings and judge its lens.

    contents: the base and its pictures, by name.  limit: seconds after which the command is ended.
    """
    began = time.perf_counter()
    unit = min(timed(kernel()) for _ in range(REPEATS))  # the least: all disturbances make it longer
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        scene, folder = unpacked(contents, Path(place)), Path(place) / "design"
        run = _generate(scene, folder, point, limit, tick=tick)
        if run.done:
            run = judged(run, load(scene), folder, effort)
    took = {"kernel_seconds": unit, "units": run.seconds / unit, "cost_seconds": time.perf_counter() - began}
    return run.model_copy(update=took | {"version": environment.version()})


def warm_up(contents: Mapping[str, bytes], tick: Tick) -> None:
    """A small run that does not count, so that the first run that counts is no colder than the others."""
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        base = load(unpacked(contents, Path(place)))
        try:
            small = base.changed(SMALLEST | {f"{key}.pixels": SMALLEST_PIXELS for key in base.target_keys})
        except SceneError:  # a profile that so few pixels cannot show
            small = base.changed(SMALLEST)
        _generate(unpacked(scene_files(small), Path(place)), Path(place) / "design", (), math.inf, tick=tick)
    kernel()


def _generate(scene: Path, folder: Path, point: Settings, limit: float, *, tick: Tick) -> Run:
    """`bstcad generate` in a process of its own, and the figures of its report."""
    changes = [word for key, value in point for word in ("--set", f"{key}={as_text(value)}")]
    ended = processes.run(["generate", str(scene), "-o", str(folder), *changes], limit, tick)
    took = {"settings": point, "seconds": ended.seconds, "cpu_seconds": ended.cpu_seconds}
    if ended.seconds >= limit and ended.code < 0:
        reason = f"ended after {ended.seconds:.0f} s, which was all that was left for it"
        return Run(status=FAILED, reason=reason, allowed_seconds=limit, **took)
    if ended.code not in (0, 1) or not (folder / "report.json").is_file():
        return Run(status=FAILED, reason=ended.reason, **took)
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    return Run(
        status=DONE,
        peak_memory_gb=report["machine"].pop("peak_memory_gb", None),
        rrmsd_reported=report["rrmsd"],
        rrmsd_noise_reported=report["rrmsd_noise"],
        passed=report["passed"],
        machine=report["machine"],
        versions=report["versions"],
        stages=tuple({key: stage[key] for key in ("name", "seconds", "rrmsd")} for stage in report["stages"]),
        history=tuple(report["history"]),
        **took,
    )


def judged(run: Run, base: Scene, folder: Path, effort: Effort) -> Run:
    """The run with the RRMSD of the lens in `folder` by the reference: by light and pixels of the base.

    Of several targets the largest RRMSD counts.
    """
    lens, channels = read_nominal(folder)[1].lens, base.verification_channels()
    how = {"effort": effort, "ghost": base.ghost, "draw": base.draw}
    lights = [measure(lens, channels, target.screen, target.irradiance(), **how) for target in base.targets]
    if not all(light.rrmsd >= 0 for light in lights):
        return run.model_copy(update={"status": FAILED, "reason": "none of its light falls on the target"})
    light = max(lights, key=lambda light: light.rrmsd)
    net = hashlib.sha256(b"".join(net.control_points().tobytes() for net in lens.nets)).hexdigest()
    found = {"rrmsd": light.rrmsd, "rrmsd_noise": light.standard_error, "rays": light.rays, "net": net}
    return run.model_copy(update=found)
