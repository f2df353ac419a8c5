"""One run of a sweep: `bstcad generate` in a cold process, its lens judged, and the record of both.

A run's seconds are those of the whole command, from its start to its end: imports, picture, tailoring, writing and
proof.  Its lens is judged by the reference of the sweep, the same for all: stratified rays on the pixels of the base.
"""

from __future__ import annotations

import hashlib
import json
import math
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch

from bstcad.optics.measure import Effort, Light, measure, simulated, tubes_picture
from bstcad.prediction import calibration
from bstcad.runs import cold, environment
from bstcad.runs import folder as folders
from bstcad.runs.folder import SCENE, scene_files
from bstcad.scene.limits import rim_sags
from bstcad.scene.scene import Scene, load
from bstcad.tailoring import stage1
from bstcad.tailoring.blank import blank
from bstcad.tailoring.merit import TubeMerit
from bstcad.tailoring.minimise import adam, minimise
from bstcad.tailoring.run import Task
from bstcad.tailoring.stage2 import Problem, search, variables_of
from bstcad.tradeoff.knobs import Settings, as_text, settings

DONE, FAILED = "done", "failed"
HERE = "here"  # where a run took place; else the address of a machine of the cluster
REFERENCE = Effort(witness=False)  # of the judge: by rays alone, which learnt nothing of any picture
JUDGES = {"tubes": (257, 515, 1031), "rays": (512, 1024, 2048)}  # a side, of those that are compared
# Of the searches that compare variables: control points a side at most, tubes a control point each way, evaluations,
# and Adam's rates (mm a step), which no rule gives: the best counts.
LARGEST_NET, TUBES, EVALUATIONS = 257, 2, 60
RATES = (2e-4, 6e-5, 2e-5)
NO_PICTURE = 1.0  # RRMSD from which a lens is as bad as darkness
SMALLEST = {  # a run whose time does not count: kernels are compiled, libraries come from the disk
    "lens.back.control_points": 33, "target.pixels": 64, "tailoring.quality": "draft", "tailoring.rays": 96,
    "tailoring.transport_grid": 64, "tailoring.levels": None,
}  # fmt: skip


@dataclass(frozen=True)
class Judged:
    """What a picture of a number of tubes or rays is off by, and what it takes: the judges are judged, too."""

    judge: str  # "tubes" or "rays"
    a_side: int
    seconds: float  # of one picture, in a warm process
    error: float  # RMS of its deviation from the reference's picture, relative to the target as RRMSD is


@dataclass(frozen=True)
class Searched:
    """A search of stage 2 in one variable or the other, from the lens of stage 1."""

    variable: str  # "Sobolev", by L-BFGS, or "control points", by Adam
    control_points: int  # a side
    tubes: int  # a side
    rate: float | None  # of Adam, mm a step
    start: float  # RRMSD of the lens of stage 1, by these tubes
    rrmsd: tuple[float, ...]  # the best so far after each evaluation


@dataclass(frozen=True)
class Record:
    """How a run went.  Seconds are of the machine that it ran on."""

    settings: Settings  # what it differs in from the base
    status: str  # DONE or FAILED
    reason: str = ""  # why it failed
    allowed_seconds: float | None = None  # after which it was ended; None: it ended by itself
    seconds: float = 0.0  # of the whole command
    cpu_seconds: float = 0.0  # of it and of all processes that it started
    peak_memory_gb: float | None = None  # of both its processes, as a sum
    rrmsd: float | None = None  # by the reference
    rrmsd_noise: float | None = None  # standard error of that
    rays: int | None = None  # of the reference
    rrmsd_reported: float | None = None  # by its own proof, on its own pixels
    rrmsd_noise_reported: float | None = None
    passed: bool | None = None  # every check of the proof
    net: str = ""  # SHA-256 of the control net: equal nets are equal lenses to the last bit
    stages: tuple[tuple[str, float, float | None], ...] = ()  # (name, seconds, RRMSD after it)
    history: tuple[tuple[float, float], ...] = ()  # (seconds since its start, RRMSD by its own tubes): warm
    judges: tuple[Judged, ...] = ()  # of the base's lens only
    searches: tuple[Searched, ...] = ()  # of the base only
    kernel_seconds: float = 0.0  # of the calibration kernel, before this run
    cost_seconds: float = 0.0  # what the run took of the budget: with judging and calibration
    predicted_seconds: float | None = None  # of that, when it was begun
    where: str = HERE
    machine: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    version: str = ""

    @property
    def done(self) -> bool:
        """Is there a lens?"""
        return self.status == DONE

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Record:
        """From the entries of its file."""
        known = {entry.name: facts[entry.name] for entry in fields(cls) if entry.name in facts}
        known["settings"] = settings((key, _value(value)) for key, value in facts["settings"])
        known["stages"] = tuple(map(tuple, known.get("stages", ())))
        known["history"] = tuple(map(tuple, known.get("history", ())))
        known["judges"] = tuple(Judged(**judge) for judge in known.get("judges", ()))
        found = known.get("searches", ())
        known["searches"] = tuple(Searched(**each | {"rrmsd": tuple(each["rrmsd"])}) for each in found)
        return cls(**known)


@dataclass(frozen=True)
class Order:
    """What a machine needs to carry out a run."""

    files: Mapping[str, bytes]  # the base scene and what it names, by name
    settings: Settings
    limit: float = float("inf")  # seconds after which it is ended
    compares: bool = False  # whether judges and variables are compared, too
    effort: Effort = REFERENCE
    where: str = HERE


def base_of(scene: Scene) -> Scene:
    """The scene without what ends a design early."""
    return scene.changed({"tailoring.accuracy": None, "tailoring.max_time": None})


@cache
def version() -> str:
    """Of the program: its number and a hash of all sources that a run depends on."""
    return environment.version(lambda path: path.parent.name != Path(__file__).parent.name or path == Path(__file__))


@cache
def kernel() -> calibration.Kernel:
    """The calibration kernel of this process."""
    return calibration.Kernel()


def carry_out(order: Order, tick: Callable[[], None] = lambda: None) -> Record:
    """Run, judge, and tell; `tick` is called all the while."""
    began = time.perf_counter()
    unit = kernel().seconds()
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        scene, folder = _unpacked(order.files, Path(place)), Path(place) / "design"
        found = _cold(scene, folder, order.settings, order.limit, tick)
        if found.done:
            found = _judged(found, load(scene), folder, order)
    return replace(
        found, kernel_seconds=unit, cost_seconds=time.perf_counter() - began, where=order.where, version=version()
    )


def warm_up(scene_of: Mapping[str, bytes], tick: Callable[[], None] = lambda: None) -> None:
    """A small run whose time does not count, so that the first that counts is as cold as all others, not colder."""
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        scene = _unpacked(scene_of, Path(place))
        small = load(scene).changed(SMALLEST)
        for name, data in scene_files(small).items():
            (Path(place) / name).write_bytes(data)
        _cold(scene, Path(place) / "design", (), float("inf"), tick)
    kernel()


def _unpacked(scene_of: Mapping[str, bytes], place: Path) -> Path:
    for name, data in scene_of.items():
        (place / name).write_bytes(data)
    return place / SCENE


def _cold(scene: Path, folder: Path, point: Settings, limit: float, tick: Callable[[], None]) -> Record:
    """`bstcad generate` in a process of its own, and what its report says."""
    changes = [word for key, value in point for word in ("--set", f"{key}={as_text(value)}")]
    ended = cold.run(["generate", str(scene), "-o", str(folder), *changes], limit, tick)
    found = Record(point, DONE, seconds=ended.seconds, cpu_seconds=ended.cpu_seconds)
    if ended.seconds >= limit and ended.code < 0:
        reason = f"ended after {ended.seconds:.0f} s, which was all that was left for it"
        return replace(found, status=FAILED, reason=reason, allowed_seconds=limit)
    if ended.code not in (0, 1) or not (folder / "report.json").is_file():
        return replace(found, status=FAILED, reason=ended.reason)
    return _reported(found, json.loads((folder / "report.json").read_text(encoding="utf-8")))


def _reported(record: Record, report: Mapping[str, Any]) -> Record:
    """The record with what the run says of itself."""
    return replace(
        record,
        peak_memory_gb=report["machine"].get("peak_memory_gb"),
        rrmsd_reported=report["rrmsd"],
        rrmsd_noise_reported=report["rrmsd_noise"],
        passed=report["passed"],
        machine={key: value for key, value in report["machine"].items() if key != "peak_memory_gb"},
        versions=report["versions"],
        stages=tuple((stage["name"], stage["seconds"], stage["rrmsd"]) for stage in report["stages"]),
        history=tuple((point["seconds"], point["rrmsd"]) for point in report["history"]),
    )


def _judged(record: Record, base: Scene, folder: Path, order: Order) -> Record:
    """The record with what the reference finds of the lens that is read back from the run's folder."""
    lens = folders.read_nominal(folder)[1].lens
    channels, screen, target = base.judging_channels(), base.target.screen, base.target.irradiance()
    light = measure(lens, channels, screen, target, order.effort, base.ghost, base.draw)
    if not light.rrmsd >= 0:
        return replace(record, status=FAILED, reason="none of its light falls on the target")
    net = hashlib.sha256(lens.back.control_points().tobytes()).hexdigest()
    found = replace(record, rrmsd=light.rrmsd, rrmsd_noise=light.standard_error, rays=light.rays, net=net)
    if not order.compares:
        return found
    return replace(found, judges=_judges(lens, channels, screen, light), searches=searched(base))


def _judges(lens, channels, screen, light: Light) -> tuple[Judged, ...]:
    """Ray tubes and rays as judges of one lens, against the picture of the reference, whose own error is taken off."""
    picture = light.picture
    makes = {
        "tubes": lambda n: tubes_picture(lens, channels, screen, n),
        "rays": lambda n: simulated(lens, channels, screen, n, 0).box,
    }
    found = []
    for judge, numbers in JUDGES.items():
        makes[judge](numbers[0])  # what is compiled, or read, the first time does not count
        for n in numbers:
            began = time.perf_counter()
            seen = makes[judge](n).cpu().numpy()
            seconds = time.perf_counter() - began
            off = seen * (picture.sum() / seen.sum()) - picture
            squared = float((off**2).sum() / (picture**2).sum()) - light.picture_off**2
            found.append(Judged(judge, n, seconds, math.sqrt(max(squared, 0.0))))
    return tuple(found)


def searched(scene: Scene) -> tuple[Searched, ...]:
    """L-BFGS in the Sobolev variable and Adam on control points, from one lens, by one merit, and as often evaluated.

    What they come to differs by variable and method alone, and in no seconds.  The source is without its size.
    """
    m = min(scene.lens.back.control_points, LARGEST_NET)
    scene = scene.changed({"lens.back.control_points": m, "tailoring.levels": None}).of_size(0.0)
    task = Task(
        scene.channels(), scene.target.screen, scene.target.irradiance(), scene.tailoring.resolved(m),
        scene.tolerances.min_thickness, scene.lens.front.free, rim_sags(scene),
    )  # fmt: skip
    *_, last = stage1.steps(task, blank(scene, task.knobs.levels[0], torch.float64, "cpu"))
    lens = last.lens
    merit = TubeMerit.of(
        task.channels, lens, TUBES * m, task.screen, torch.from_numpy(task.target), task.knobs.overshoot
    )
    problem, start = Problem(lens, merit), lens.back.heights
    found = [("Sobolev", None, search(lens, problem, variables_of(task, lens), EVALUATIONS))]
    for rate in RATES:
        method = adam([start], [rate], EVALUATIONS)
        found.append(("control points", rate, minimise(problem, method, EVALUATIONS)))
    begun = problem([start])[2]
    return tuple(
        Searched(variable, m, TUBES * m, rate, begun, tuple(reached.best.rrmsd for reached in each))
        for variable, rate, each in found
    )


def _value(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
