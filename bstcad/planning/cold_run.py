"""Run designs in new processes (cold runs), measure their time and error, calibrate this machine, and store records.

A run designs a base scene with changed settings.  Its time is the time of the whole command: imports, picture,
tailoring, writing and verification.  The reference is a measurement of the RRMSD of every lens with stratified rays, on
the pixels of the base scene.  The calibration kernel is a fixed computation whose time shows a machine's speed.
"""

from __future__ import annotations

import csv
import hashlib
import io
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

from bstcad.designs.folder import SCENE, read_nominal, scene_files
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.measure import Effort, measure_goals
from bstcad.report.record import read as read_contents
from bstcad.runs import environment, files, processes
from bstcad.runs.cluster import THIS_MACHINE, Answer
from bstcad.runs.processes import Tick
from bstcad.scene.errors import MachineError, SceneError
from bstcad.scene.scene import Scene, load
from bstcad.tailoring.merit import Merit
from bstcad.tailoring.stage2 import Problem

# --- records ----------------------------------------------------------------------------------------------------------

MAX_RECORD_SIZE = 100_000_000  # largest size of a record's file (bytes)
SIGNIFICANT_DIGITS = 6  # default number of digits of `round_numbers`
SceneFiles = Mapping[str, bytes]  # contents of a scene file and its pictures, by file name


class StoredRecord(BaseModel):
    """Base class of immutable records that are stored in files."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


Record = TypeVar("Record", bound=StoredRecord)


def read_record(kind: type[Record], path: Path, remedy: str) -> Record:
    """Read a record of class `kind`; if the file is no such record, raise MachineError, which ends with `remedy`."""
    try:
        return kind.model_validate_json(files.contents(path, MAX_RECORD_SIZE))
    except ValueError:  # pydantic's errors are ValueErrors
        raise MachineError(f"{path}: is damaged, or was written by another program; {remedy}") from None


def read_report(folder: Path) -> dict[str, Any]:
    """Return the entries of a design's report.json; raise MachineError if the file is missing or damaged."""
    try:
        return read_contents(folder / "report.json").facts()
    except ValueError as error:
        raise MachineError(str(error)) from None


def write_record(path: Path, record: StoredRecord) -> None:
    """Write a record as JSON, with numbers at full precision."""
    files.put(path, f"{record.model_dump_json(indent=1)}\n".encode())


def round_numbers(value: Any, digits: int = SIGNIFICANT_DIGITS) -> Any:
    """Return a JSON value with its floats rounded to `digits` significant digits, or None where they are not finite."""
    if isinstance(value, Mapping):
        return {key: round_numbers(part, digits) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [round_numbers(part, digits) for part in value]
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    return value


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write the given columns of all rows as CSV."""
    text = io.StringIO()
    lines = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    lines.writeheader()
    lines.writerows(rows)
    files.put(path, text.getvalue().encode())


def unpack_scene(contents: SceneFiles, folder: Path) -> Path:
    """Write a scene and its pictures into a folder; return the path of the scene file."""
    for name, data in contents.items():
        (folder / name).write_bytes(data)
    return folder / SCENE


POOL_INTERVAL = 0.2  # interval (seconds) at which a waiting pool calls `tick`


class LocalPool:
    """Pool of at most `room` child processes, each with a thread that waits for it.

    Processes that are still running at the end of the `with` block are terminated; checkpoints in their folders remain.
    """

    def __init__(self, room: int) -> None:
        self.capacity = room
        self._threads, self._stopping = ThreadPoolExecutor(room), threading.Event()
        self._keys: dict[Future, Any] = {}

    def __enter__(self) -> LocalPool:
        return self

    def __exit__(self, *error: object) -> None:
        self._stopping.set()
        self._threads.shutdown(cancel_futures=True)

    def start(self, key: Any, work: Callable[..., Any], *arguments: Any) -> None:
        """Start work(*arguments, tick) in a thread; `work` must call `tick` regularly.  key: returned in the answer."""
        self._keys[self._threads.submit(work, *arguments, self._tick)] = key

    def next(self, tick: Tick) -> Answer:
        """Wait until one of the calls has ended, and return its answer; `tick` is called regularly and may raise."""
        while True:
            for future in wait(self._keys, timeout=POOL_INTERVAL, return_when=FIRST_COMPLETED).done:
                key, error = self._keys.pop(future), future.exception()
                if error is not None:
                    return Answer(key, THIS_MACHINE, reason=f"{type(error).__name__}: {error}")
                return Answer(key, THIS_MACHINE, future.result())
            tick()

    def _tick(self) -> None:
        if self._stopping.is_set():
            raise InterruptedError("the pool was closed")


# --- calibration ------------------------------------------------------------------------------------------------------

KERNEL_TUBES, KERNEL_PIXELS = 1024, 512  # flux tubes and target pixels per side of the calibration kernel
KERNEL_NET, KERNEL_INDEX = 257, 1.49  # control points per side, and refractive index, of the kernel's lens
KERNEL_WIDTH, KERNEL_THICKNESS = 20.0, 5.0  # width and thickness of the kernel's lens, mm
KERNEL_SCREEN_Z = 200.0  # distance of the kernel's screen from the front of its lens, mm
WAVE_HEIGHT, WAVE_PERIODS = 0.003, 3  # waves of the back of the kernel's lens: amplitude (mm), periods across the width
KERNEL_REPEATS = 3  # number of evaluations of the kernel; the time of the fastest is used


def measure_seconds(work: Callable[[], object]) -> float:
    """Call `work`, and return the time (s) that the call took."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


@cache
def calibration_kernel(tubes: int = KERNEL_TUBES) -> Callable[[], Any]:
    """Return a function that evaluates merit and gradient with flux tubes (`tubes` per side) through a fixed lens."""
    u = torch.linspace(-math.pi * WAVE_PERIODS, math.pi * WAVE_PERIODS, KERNEL_NET, dtype=torch.float64)
    outline, span = Rectangle(KERNEL_WIDTH, KERNEL_WIDTH), (-KERNEL_WIDTH / 2, KERNEL_WIDTH / 2)
    back = BSplineSurface(KERNEL_THICKNESS, WAVE_HEIGHT * u.cos()[:, None] * u.cos(), span, span)
    lens = Lens.between(Plane(0.0), back, outline, KERNEL_INDEX)
    target = np.full((KERNEL_PIXELS, KERNEL_PIXELS), 1.0)
    channel, screen = (
        Channel(CollimatedSource(outline), KERNEL_INDEX),
        Screen(KERNEL_SCREEN_Z, span, span, KERNEL_PIXELS),
    )
    merit = Merit.of((channel,), lens, tubes, [Goal("target", screen, target)], overshoot=0.03)
    evaluate = partial(Problem(lens, merit), [back.heights])
    evaluate()  # compiles the kernels and allocates memory
    return evaluate


# --- runs -------------------------------------------------------------------------------------------------------------

Value = int | float | str | tuple[int, int]
Settings = tuple[tuple[str, Value], ...]  # pairs (dotted key of a scene, value), sorted by key; (): the base scene

DONE, FAILED, NOT_RUN = "done", "failed", "not run: budget"  # statuses of a run
REFERENCE_EFFORT = Effort(witness=False)  # effort of the reference: no flux tubes, only rays that tailoring did not use
WARM_UP_CHANGES = {  # settings of the first run, which compiles kernels and loads libraries and is not timed
    "lens.back.control_points": 33, "tailoring.quality": "draft", "tailoring.rays": 96,
    "tailoring.transport_grid": 64, "tailoring.levels": None,
}  # fmt: skip
WARM_UP_PIXELS = 64  # pixels per side of each target in the warm-up run


def sorted_settings(entries: Mapping[str, Value]) -> Settings:
    """Return settings sorted by key."""
    return tuple(sorted(entries.items()))


def format_value(value: Value) -> str:
    """Return a value of a setting as text for the option --set."""
    return f"[{value[0]}, {value[1]}]" if isinstance(value, tuple) else str(value)


def _from_json(entries: Any) -> Any:
    if not isinstance(entries, Mapping):
        return entries
    return sorted_settings({key: tuple(value) if isinstance(value, list) else value for key, value in entries.items()})


StoredSettings = Annotated[Settings, BeforeValidator(_from_json), PlainSerializer(dict)]  # stored as a JSON object


class HistoryPoint(TypedDict):
    """RRMSD of a design at one time, from the flux tubes of tailoring, or at the end of a stage from new rays."""

    seconds: float  # time since the start of the command
    rrmsd: float | None  # RRMSD; null: not finite


class ColdRun(StoredRecord):
    """Result of one run; times are in seconds on the machine of the run, and null if the run was not done."""

    settings: StoredSettings  # changes relative to the base scene
    status: str  # "done", "failed" or "not run: budget"
    reason: str = ""  # reason of the failure
    label: str = ""  # description, such as "Flux tubes per side: 768"
    knobs: tuple[str, ...] = ()  # keys of the knobs (tradeoff.Knob) with these settings; "base": the base scene
    where: str = THIS_MACHINE  # "here", or the address of a worker; "": not run
    seconds: float | None = 0.0  # wall time of the whole command
    cpu_seconds: float | None = 0.0  # CPU time of the command and of all processes that it started
    kernel_seconds: float | None = 0.0  # time of the calibration kernel before this run
    units: float | None = None  # seconds / kernel_seconds
    cost_seconds: float | None = 0.0  # time charged to the budget, including the reference and the calibration
    predicted_seconds: float | None = None  # cost_seconds as predicted before the run
    peak_memory_gb: float | None = None  # peak memory of the two processes together (GB)
    rrmsd: float | None = None  # RRMSD on pixels by the reference; for several targets the largest
    rrmsd_half: float | None = None  # RRMSD on half pixels by the reference, of the same target
    rrmsd_noise: float | None = None  # standard error of rrmsd
    rays: int | None = None  # number of rays of the reference
    rrmsd_reported: float | None = None  # RRMSD by the verification of the design, on the pixels of the run
    rrmsd_noise_reported: float | None = None  # standard error of rrmsd_reported
    passed: bool | None = None  # true if every check of the verification passed
    net: str = ""  # SHA-256 of the control nets; equal nets are equal lenses to the last bit
    stages: tuple[dict[str, Any], ...] = ()  # stages: name, seconds and rrmsd at the end (null: not measured)
    on_front: bool = False  # true if the run is on the Pareto front of the sweep
    allowed_seconds: float | None = None  # only in runs/*.json: time limit that stopped the run; null: it ended itself
    history: tuple[HistoryPoint, ...] = ()  # only in runs/*.json: convergence curve of the run
    machine: dict[str, Any] = {}  # only in runs/*.json: machine of the run
    versions: dict[str, str] = {}  # only in runs/*.json: versions of the libraries, by name
    version: str = ""  # only in runs/*.json: version of bstcad, with a hash of its sources

    @property
    def done(self) -> bool:
        """True if the run gave a lens that lights every target."""
        return self.status == DONE

    @property
    def time_and_error(self) -> tuple[float, float]:
        """Time (seconds) and RRMSD of a run with a lens."""
        assert self.seconds is not None and self.rrmsd is not None, "a run with a lens has both"
        return self.seconds, self.rrmsd

    @property
    def comparable(self) -> bool:
        """True if the run gave a lens on this machine, where runs do not overlap, so that times are comparable."""
        return self.done and self.where == THIS_MACHINE


def run_and_judge(
    contents: SceneFiles, point: Settings, limit: float, effort: Effort, tick: Tick = lambda: None
) -> ColdRun:
    """Design the scene `contents` with settings `point` in at most `limit` s, and measure the RRMSD with `effort`."""
    start = time.perf_counter()
    unit = min(measure_seconds(calibration_kernel()) for _ in range(KERNEL_REPEATS))
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        scene, folder = unpack_scene(contents, Path(place)), Path(place) / "design"
        run = _generate(scene, folder, point, limit, tick=tick)
        if run.done:
            run = judge_run(run, load(scene), folder, effort)
    units = None if run.seconds is None else run.seconds / unit
    times = {"kernel_seconds": unit, "units": units, "cost_seconds": time.perf_counter() - start}
    return run.model_copy(update=times | {"version": environment.version()})


def warm_up(contents: SceneFiles, tick: Tick) -> None:
    """Do a small run that is not timed, so that the first timed run has the same conditions as later runs."""
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        base = load(unpack_scene(contents, Path(place)))
        try:
            small = base.changed(WARM_UP_CHANGES | {f"{key}.pixels": WARM_UP_PIXELS for key in base.target_keys})
        except SceneError:  # a profile too narrow for so few pixels
            small = base.changed(WARM_UP_CHANGES)
        _generate(unpack_scene(scene_files(small), Path(place)), Path(place) / "design", (), math.inf, tick=tick)
    calibration_kernel()


def _generate(scene: Path, folder: Path, point: Settings, limit: float, *, tick: Tick) -> ColdRun:
    """Run `bstcad generate` with settings `point`, for at most `limit` s, in a new process; return the run's record."""
    changes = [word for key, value in point for word in ("--set", f"{key}={format_value(value)}")]
    process = processes.run(["generate", str(scene), "-o", str(folder), *changes], limit, tick)
    times: dict[str, Any] = {"settings": point, "seconds": process.seconds, "cpu_seconds": process.cpu_seconds}
    if process.seconds >= limit and process.code < 0:
        reason = f"ended after {process.seconds:.0f} s, because its share of the budget was used up"
        return ColdRun(status=FAILED, reason=reason, allowed_seconds=limit, **times)
    if process.code not in (0, 1) or not (folder / "report.json").is_file():
        return ColdRun(status=FAILED, reason=process.reason, **times)
    try:
        report = read_report(folder)
    except MachineError as error:
        return ColdRun(status=FAILED, reason=str(error), **times)
    return ColdRun(
        status=DONE,
        peak_memory_gb=report["machine"].pop("peak_memory_gb", None),
        rrmsd_reported=report["rrmsd"],
        rrmsd_noise_reported=report["rrmsd_noise"],
        passed=report["passed"],
        machine=report["machine"],
        versions=report["versions"],
        stages=tuple({key: stage[key] for key in ("name", "seconds", "rrmsd")} for stage in report["stages"]),
        history=tuple(report["history"]),
        **times,
    )


def judge_run(run: ColdRun, base: Scene, folder: Path, effort: Effort) -> ColdRun:
    """Return `run` with the RRMSD of the lens in `folder` by `effort`: the largest on the targets of `base`."""
    lens, channels = read_nominal(folder).lens, base.verification_channels()
    lights = measure_goals(lens, channels, base.goals, effort, ghost=base.ghost, sampler=base.sampler)
    if not all(light.rrmsd >= 0 for light in lights):
        return run.model_copy(update={"status": FAILED, "reason": "none of its light falls on the target"})
    light = max(lights, key=lambda light: light.rrmsd)
    net = hashlib.sha256(b"".join(net.control_points().tobytes() for net in lens.nets)).hexdigest()
    errors = {"rrmsd": light.rrmsd, "rrmsd_half": light.half and light.half.rrmsd, "rrmsd_noise": light.standard_error}
    return run.model_copy(update=errors | {"rays": light.rays, "net": net})
