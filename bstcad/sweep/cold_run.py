"""A run of a sweep: `bstcad generate` in a cold process, its lens judged, and the record of both.

A run takes the seconds of the whole command: imports, picture, tailoring, writing and proof.  One reference judges the
lenses of all runs: stratified rays on the pixels of the base.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainSerializer

from bstcad.folder import SCENE, read_nominal, scene_files
from bstcad.optics.measure import Effort, measure
from bstcad.runs import environment, processes
from bstcad.runs.cluster import HERE
from bstcad.scene.scene import Scene, load
from bstcad.sweep import work
from bstcad.sweep.io import Stored
from bstcad.sweep.knobs import Settings, as_text, settings

DONE, FAILED = "done", "failed"
REFERENCE = Effort(witness=False)  # of the judge: by rays alone, which no lens was tailored by
SMALLEST = {  # a run whose time does not count: kernels are compiled, libraries come from the disk
    "lens.back.control_points": 33, "target.pixels": 64, "tailoring.quality": "draft", "tailoring.rays": 96,
    "tailoring.transport_grid": 64, "tailoring.levels": None,
}  # fmt: skip


def _read(entries: Any) -> Any:
    """Settings from the object that JSON has for them."""
    if not isinstance(entries, Mapping):
        return entries
    return settings({key: tuple(value) if isinstance(value, list) else value for key, value in entries.items()})


StoredSettings = Annotated[Settings, BeforeValidator(_read), PlainSerializer(dict)]  # an object of JSON


class StageTime(Stored):
    """A stage of a design."""

    name: str
    seconds: float
    rrmsd: float | None  # after it; None: not judged


class HistoryPoint(Stored):
    """RRMSD of a design by its own tubes."""

    seconds: float  # since its start
    rrmsd: float | None  # None: not finite


class Run(Stored):
    """How a run went.  Seconds are of the machine that it ran on."""

    settings: StoredSettings  # the changes of the base
    status: str  # DONE or FAILED
    reason: str = ""  # why it failed
    where: str = HERE  # or the address of a worker
    seconds: float = 0.0  # of the whole command
    cpu_seconds: float = 0.0  # of the command and of all processes that it started
    kernel_seconds: float = 0.0  # of the calibration kernel, before this run
    cost_seconds: float = 0.0  # of the budget: with judging and calibration
    predicted_seconds: float | None = None  # of the budget, before the run began
    peak_memory_gb: float | None = None  # of both its processes, as a sum
    rrmsd: float | None = None  # by the reference
    rrmsd_noise: float | None = None  # standard error of that
    rays: int | None = None  # of the reference
    rrmsd_reported: float | None = None  # by its own proof, on its own pixels
    rrmsd_noise_reported: float | None = None
    passed: bool | None = None  # every check of the proof
    net: str = ""  # SHA-256 of the control net: equal nets are equal lenses to the last bit
    stages: tuple[StageTime, ...] = ()

    @property
    def done(self) -> bool:
        """Is there a lens?"""
        return self.status == DONE


class KeptRun(Run):
    """A run as its file keeps it."""

    allowed_seconds: float | None = None  # after which it was ended; None: it ended by itself
    history: tuple[HistoryPoint, ...] = ()
    machine: dict[str, Any] = {}
    versions: dict[str, str] = {}
    version: str = ""  # of bstcad, with a hash of its sources


@dataclass(frozen=True)
class Order:
    """All that a machine needs to carry out a run."""

    files: Mapping[str, bytes]  # the base scene and its pictures, by name
    settings: Settings
    limit: float = float("inf")  # seconds after which the command is ended
    effort: Effort = REFERENCE


def base_of(scene: Scene) -> Scene:
    """The scene without limits that end a design early."""
    return scene.changed({"tailoring.accuracy": None, "tailoring.max_time": None})


@cache
def kernel() -> work.Kernel:
    """The calibration kernel of this process."""
    return work.Kernel()


def carry_out(order: Order, tick: Callable[[], None] = lambda: None) -> KeptRun:
    """Run the command and judge its lens; `tick` is called while the command runs."""
    began = time.perf_counter()
    unit = kernel().seconds()
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        scene, folder = _unpacked(order.files, Path(place)), Path(place) / "design"
        run = _generate(scene, folder, order, tick)
        if run.done:
            run = judged(run, load(scene), folder, order.effort)
    cost = time.perf_counter() - began
    return run.model_copy(update={"kernel_seconds": unit, "cost_seconds": cost, "version": environment.version()})


def warm_up(contents: Mapping[str, bytes], tick: Callable[[], None] = lambda: None) -> None:
    """A small run that does not count, so that the first run that counts is no colder than the others."""
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        small = load(_unpacked(contents, Path(place))).changed(SMALLEST)
        _generate(_unpacked(scene_files(small), Path(place)), Path(place) / "design", Order({}, ()), tick)
    kernel()


def _unpacked(contents: Mapping[str, bytes], place: Path) -> Path:
    for name, data in contents.items():
        (place / name).write_bytes(data)
    return place / SCENE


def _generate(scene: Path, folder: Path, order: Order, tick: Callable[[], None]) -> KeptRun:
    """`bstcad generate` in a process of its own, and the figures of its report."""
    changes = [word for key, value in order.settings for word in ("--set", f"{key}={as_text(value)}")]
    ended = processes.run(["generate", str(scene), "-o", str(folder), *changes], order.limit, tick)
    took = {"settings": order.settings, "seconds": ended.seconds, "cpu_seconds": ended.cpu_seconds}
    if ended.seconds >= order.limit and ended.code < 0:
        reason = f"ended after {ended.seconds:.0f} s, which was all that was left for it"
        return KeptRun(status=FAILED, reason=reason, allowed_seconds=order.limit, **took)
    if ended.code not in (0, 1) or not (folder / "report.json").is_file():
        return KeptRun(status=FAILED, reason=ended.reason, **took)
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    return KeptRun(
        status=DONE,
        peak_memory_gb=report["machine"].get("peak_memory_gb"),
        rrmsd_reported=report["rrmsd"],
        rrmsd_noise_reported=report["rrmsd_noise"],
        passed=report["passed"],
        machine={key: value for key, value in report["machine"].items() if key != "peak_memory_gb"},
        versions=report["versions"],
        stages=tuple(StageTime(**{key: stage[key] for key in StageTime.model_fields}) for stage in report["stages"]),
        history=tuple(HistoryPoint(**point) for point in report["history"]),
        **took,
    )


def judged(run: KeptRun, base: Scene, folder: Path, effort: Effort) -> KeptRun:
    """The run with the RRMSD that the reference finds of the lens in `folder`, by light and pixels of the base."""
    lens, target = read_nominal(folder)[1].lens, base.target.irradiance()
    light = measure(
        lens, base.judging_channels(), base.target.screen, target, effort=effort, ghost=base.ghost, draw=base.draw
    )
    if not light.rrmsd >= 0:
        return run.model_copy(update={"status": FAILED, "reason": "none of its light falls on the target"})
    net = hashlib.sha256(lens.back.control_points().tobytes()).hexdigest()
    found = {"rrmsd": light.rrmsd, "rrmsd_noise": light.standard_error, "rays": light.rays, "net": net}
    return run.model_copy(update=found)
