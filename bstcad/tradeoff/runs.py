"""One run of a sweep: `bstcad generate` in a cold process, its lens judged, and the record of both.

A run's seconds are those of the whole command, from its start to its end: imports, picture, tailoring, writing and
proof.  Its lens is judged by the reference of the sweep, the same for all: ray tubes on the pixels of the base.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import bstcad
from bstcad import files
from bstcad.optics.measure import Effort, measure, simulated, tubes_picture
from bstcad.prediction import calibration
from bstcad.runs import folder as folders
from bstcad.scene.errors import MachineError
from bstcad.scene.given_net import NAME as FRONT
from bstcad.scene.scene import Scene, load
from bstcad.tradeoff.knobs import Settings, as_text, settings

DONE, FAILED = "done", "failed"
HERE = "here"  # where a run took place; else the address of a machine of the cluster
SCENE = "scene.toml"
REFERENCE = Effort(tubes=(1549, 2063, 3079, 4099, 6151), rays=0)  # of the judge; without rays, which have noise
JUDGES = {"tubes": (257, 515, 1031), "rays": (512, 1024, 2048)}  # a side, of those that are compared
LOOK = 0.02  # seconds between two looks whether a process has ended
GRACE = 5.0  # seconds it has to end when asked to
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
    rrmsd_noise: float | None = None  # noise floor of that
    tubes: int | None = None  # of the reference
    rrmsd_reported: float | None = None  # by its own proof, on its own pixels
    rrmsd_noise_reported: float | None = None
    passed: bool | None = None  # every check of the proof
    net: str = ""  # SHA-256 of the control net: equal nets are equal lenses to the last bit
    stages: tuple[tuple[str, float, float | None], ...] = ()  # (name, seconds, RRMSD after it)
    history: tuple[tuple[float, float], ...] = ()  # (seconds since its start, RRMSD by its own tubes): warm
    judges: tuple[Judged, ...] = ()  # of the base's lens only
    kernel_seconds: float = 0.0  # of the calibration kernel, before this run
    cost_seconds: float = 0.0  # what the run took of the budget: with judging and calibration
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
        return cls(**known)


@dataclass(frozen=True)
class Order:
    """What a machine needs to carry out a run."""

    files: Mapping[str, bytes]  # the base scene and what it names, by name
    settings: Settings
    limit: float = float("inf")  # seconds after which it is ended
    judges: bool = False  # whether the judges are compared on its lens
    effort: Effort = REFERENCE
    where: str = HERE


def scene_files(scene: Scene) -> dict[str, bytes]:
    """The scene as a folder that loads to it again, by file name."""
    found = {SCENE: scene.toml().encode()}
    if scene.target.image is not None:
        found[scene.target.image.name] = scene.target.image.data
    if scene.lens.front.given is not None:
        found[FRONT] = scene.lens.front.given.archive()
    return found


def base_of(scene: Scene) -> Scene:
    """The scene without what ends a design early."""
    return scene.changed({"tailoring.accuracy": None, "tailoring.max_time": None})


@cache
def version() -> str:
    """Of the program: its number and a hash of all sources that a run depends on."""
    package, digest = Path(bstcad.__file__).parent, hashlib.sha256()
    ours = {Path(__file__), Path(calibration.__file__)}
    for path in sorted(package.rglob("*.py")):
        if path.parent.name != Path(__file__).parent.name or path in ours:
            digest.update(str(path.relative_to(package)).encode() + path.read_bytes())
    return f"{bstcad.__version__}+{digest.hexdigest()[:12]}"


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
    command = [sys.executable, "-m", "bstcad.tradeoff.cold_process", "generate", str(scene), "-o", str(folder)]
    command += [word for key, value in point for word in ("--set", f"{key}={as_text(value)}")]
    source = str(Path(bstcad.__file__).parent.parent)  # the child is to be of these sources, wherever it is started
    paths = os.pathsep.join(filter(None, (source, os.environ.get("PYTHONPATH"))))
    with (scene.parent / "said").open("w+b") as said:
        began = time.perf_counter()
        child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=said, start_new_session=True,
            env={**os.environ, "PYTHONPATH": paths},
        )  # fmt: skip
        with _ended_with_us(child):
            spent = _waited(child, began + limit, tick)
        seconds = time.perf_counter() - began
        said.seek(0)
        words = said.read().decode(errors="replace")
    found = Record(point, DONE, seconds=seconds, cpu_seconds=spent.ru_utime + spent.ru_stime)
    if seconds >= limit and child.returncode < 0:
        reason = f"ended after {seconds:.0f} s, which was all that was left for it"
        return replace(found, status=FAILED, reason=reason, allowed_seconds=limit)
    if child.returncode not in (0, 1) or not (folder / "report.json").is_file():
        return replace(found, status=FAILED, reason=_reason(child.returncode, words))
    return _reported(found, json.loads((folder / "report.json").read_text(encoding="utf-8")))


@contextlib.contextmanager
def _ended_with_us(child: subprocess.Popen) -> Iterator[None]:
    """Whatever ends the block, the child does not outlive it."""
    try:
        yield
    finally:
        if child.returncode is None:
            _end(child)


def _end(child: subprocess.Popen) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(child.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(GRACE)
            return


def _waited(child: subprocess.Popen, until: float, tick: Callable[[], None]) -> Any:
    """What the child and its own children used (resource.struct_rusage), once it has ended or its time is up."""
    while True:
        pid, status, spent = os.wait4(child.pid, os.WNOHANG)
        if pid:
            child.returncode = os.waitstatus_to_exitcode(status)
            return spent
        if time.perf_counter() > until:
            os.killpg(child.pid, signal.SIGKILL)
            until = float("inf")
        tick()
        time.sleep(LOOK)


def _reason(code: int, words: str) -> str:
    """Why a run has no lens, in a sentence."""
    if code < 0:
        name = signal.Signals(-code).name
        return f"ended by {name}" + ("; the memory of this machine may be too little for it" if code == -9 else "")
    lines = [line for line in words.splitlines() if line.startswith("bstcad: ") and "warning: " not in line]
    return lines[-1].removeprefix("bstcad: ") if lines else f"exit code {code}"


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
    light = measure(lens, channels, screen, target, order.effort, base.ghost)
    if not light.rrmsd >= 0:
        return replace(record, status=FAILED, reason="none of its light falls on the target")
    net = hashlib.sha256(lens.back.control_points().tobytes()).hexdigest()
    found = replace(record, rrmsd=light.rrmsd, rrmsd_noise=light.noise, tubes=light.tubes, net=net)
    return replace(found, judges=_judges(lens, channels, screen, light.picture)) if order.judges else found


def _judges(lens, channels, screen, picture) -> tuple[Judged, ...]:
    """Ray tubes and rays as judges of one lens, against the picture of the reference."""
    makes = {
        "tubes": lambda n: tubes_picture(lens, channels, screen, n),
        "rays": lambda n: simulated(lens, channels, screen, n, 0).box,
    }
    found = []
    for judge, numbers in JUDGES.items():
        for n in numbers:
            began = time.perf_counter()
            seen = makes[judge](n).cpu().numpy()
            seconds = time.perf_counter() - began
            off = seen * (picture.sum() / seen.sum()) - picture
            found.append(Judged(judge, n, seconds, float(np.sqrt((off**2).sum() / (picture**2).sum()))))
    return tuple(found)


class Shelf:
    """The records of a sweep, a file each, in the order in which they came."""

    def __init__(self, folder: Path, scene_of: Mapping[str, bytes]) -> None:
        self._folder = folder
        digest = hashlib.sha256()
        for name, data in sorted(scene_of.items()):
            digest.update(name.encode() + data)
        self._key = f"{digest.hexdigest()} {version()}"

    def path(self, point: Settings) -> Path:
        """The file of a run: its name is a hash of scene, settings and version of the program."""
        text = json.dumps([self._key, point])
        return self._folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"

    def put(self, record: Record) -> None:
        """Keep a record, whole or not at all."""
        self._folder.mkdir(parents=True, exist_ok=True)
        files.put(self.path(record.settings), json.dumps(asdict(record), ensure_ascii=False, indent=1).encode())

    def find(self, point: Settings) -> Record | None:
        """The record of a run; None: there is none of this scene and this version."""
        path = self.path(point)
        if not path.is_file():
            return None
        try:
            return Record.of(json.loads(files.contents(path, 10_000_000)))
        except (ValueError, KeyError, TypeError):
            raise MachineError(f"{path}: is damaged; remove it, and the run is done again") from None

    def count(self) -> int:
        """How many records there are, of other versions too."""
        return len(list(self._folder.glob("*.json"))) if self._folder.is_dir() else 0


def _value(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
