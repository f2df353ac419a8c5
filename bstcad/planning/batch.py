"""Command `bstcad batch`: design many scenes, each in its own process and folder, and continue after a failure.

A design is finished if batch.json lists it with an equal scene and this version of bstcad, and its folder still
contains the design.  A design that was interrupted on this machine continues from its checkpoint.  batch.json has the
entries of Batch; batch.csv has one line per design, with the columns BATCH_COLUMNS.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

import bstcad
from bstcad.designs import folder as folders
from bstcad.designs.pipeline import DesignState, purpose
from bstcad.planning import cold_run
from bstcad.planning.cold_run import LocalPool, SceneFiles, StoredRecord, unpack_scene
from bstcad.planning.net_choice import with_net
from bstcad.planning.prediction import INTERVAL_FACTORS, memory_gb
from bstcad.report.report import check_lines
from bstcad.runs import environment, files, processes
from bstcad.runs.checkpoint import Keeper
from bstcad.runs.cluster import Answer, Cluster, Machines
from bstcad.runs.processes import ExitStatus, Tick
from bstcad.scene.errors import MachineError, SceneError
from bstcad.scene.scene import Scene, load
from bstcad.tailoring.driver import Progress, no_progress
from bstcad.verify.verdict import NO_LIMIT, VERDICTS, Check

if TYPE_CHECKING:
    from rich.console import Group

REFUSED, BROKEN, STOPPED = "refused", "broken", "not done"  # statuses of a design without a lens
STATUS_STYLES = {"passed": "green", "passed with remarks": "yellow", NO_LIMIT: "cyan"}  # colour of a status; else red
KILLED_CODE = -9  # exit code of a process killed by a user, or by the system when memory ran out
CORES_PER_DESIGN = 2  # number of cores that one design uses


class BatchEntry(StoredRecord):
    """Result of one design."""

    scene: str  # path of the scene file, as given by the user
    name: str = ""  # name of the scene and of the design's folder
    status: str = STOPPED  # verdict of report.json, or without a lens "refused", "broken" or "not done"
    rrmsd: float | None = None  # RRMSD of the report; this and the next three: of the target with the largest RRMSD
    rrmsd_noise: float | None = None  # standard error of rrmsd
    leak: float | None = None  # fraction of the light on the target that falls where the target is dark
    light_on_target: float | None = None  # fraction of the source's light that falls on the target
    checks_failed: tuple[str, ...] = ()  # names of the failed checks
    seconds: float = 0.0  # seconds_total of the report, or time until the design ended without a lens (s)
    report: str = ""  # path of report.html, relative to the batch's folder
    where: str = ""  # "here", or the address of a worker; "": not run
    reason: str = ""  # sentence that states why there is no lens; "": there is a lens
    key: str = ""  # hash of the scene with its pictures, and version of bstcad
    design: str = ""  # SHA-256 of design.npz

    @property
    def finished(self) -> bool:
        """True if there is a lens."""
        return self.status in VERDICTS

    def changed(self, **entries: Any) -> BatchEntry:
        """Return the entry with these fields replaced."""
        return self.model_copy(update=entries)


BATCH_COLUMNS = [name for name in BatchEntry.model_fields if name not in ("key", "design")]


class Batch(StoredRecord):
    """Contents of batch.json."""

    version: str  # version of bstcad
    designs: tuple[BatchEntry, ...]  # designs of the last batch in the order of its scenes, then earlier finished ones


@dataclass(frozen=True)
class BatchScene:
    """Scene file of a batch, with its scene or the reason why it is not valid."""

    path: str  # path as given by the user
    scene: Scene | None  # None: the file is not valid
    reason: str = ""  # sentence that states why the file is not valid


# --- one design, in a process of its own ------------------------------------------------------------------------------


def design(contents: SceneFiles, folder: Path, variables: Mapping[str, str], tick: Tick = lambda: None) -> ExitStatus:
    """Design a scene into a folder, from a checkpoint of this design if there is one; return how the process ended.

    contents: the scene's files.  variables: additional environment variables.  A killed process is started again, once.
    """
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        scene = unpack_scene(contents, Path(place))
        command = ["generate", str(scene), "-o", str(folder)]
        resume = ["--resume"] if _has_checkpoint(load(scene), folder) else []
        first = processes.run([*command, *resume], tick=tick, environment=variables)
        if first.code != KILLED_CODE:
            return first
        second = processes.run([*command, "--resume"], tick=tick, environment=variables)
    return replace(second, seconds=first.seconds + second.seconds, cpu_seconds=first.cpu_seconds + second.cpu_seconds)


def _has_checkpoint(scene: Scene, folder: Path) -> bool:
    keeper = Keeper(files.beside(folder, "checkpoint"), purpose(scene, "auto"), kind=DesignState)
    try:
        return keeper.load() is not None
    except SceneError:
        return False


def design_remotely(contents: SceneFiles) -> tuple[ExitStatus, dict[str, bytes]]:
    """Design a scene on a worker; return how the process ended, and the files of the design by relative path."""
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        folder = Path(place) / "design"
        ending = design(contents, folder, {})
        paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        return ending, {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


# --- all designs ------------------------------------------------------------------------------------------------------


def batch(
    scenes: Sequence[BatchScene], folder: Path, *, workers: int | None = None, cluster: Cluster | None = None,
    progress: Progress = no_progress, say: Callable[[str], None] = lambda sentence: None,
) -> list[BatchEntry]:  # fmt: skip
    """Design each scene into folder/NAME; return an entry per scene, in the order of the scenes.

    workers: number of simultaneous designs on this machine; None: as many as its cores and memory allow.
    cluster: machines that make the designs instead.  say: called with a sentence before the work begins.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with files.exclusive(folder / "batch.json"), contextlib.ExitStack() as stack:
        earlier = read(folder)
        rows, count = list(_initial_entries(scenes, folder, earlier)), len(scenes)
        names = {row.name for row in rows if row.status != REFUSED}
        stopped = ((k, scenes[k].scene) for k, row in enumerate(rows) if row.status == STOPPED)
        remaining = {k: with_net(scene)[0] for k, scene in stopped if scene is not None}
        rows += [row for row in earlier if row.finished and row.name not in names]
        if remaining:
            memory = INTERVAL_FACTORS["memory_gb"] * max(map(memory_gb, remaining.values()))
            by_memory = int(psutil.virtual_memory().available / 1e9 / memory)
            at_a_time = min(environment.cores() // CORES_PER_DESIGN, by_memory)
            machines = cluster or stack.enter_context(LocalPool(min(workers or max(1, at_a_time), len(remaining))))
            done, place = sum(row.finished for row in rows[:count]), "the cluster" if cluster else "this machine"
            at_once, plural = min(machines.capacity, len(remaining)), "s" * (len(remaining) > 1)
            say(
                f"{len(remaining)} design{plural}, {at_once} at a time on {place}, each with up to {memory:.1f} GB of "
                f"memory{f'; {done} finished before' if done else ''}"
            )
            try:
                _design_all(rows, remaining, folder, machines, progress=progress)
            except BaseException as error:
                finished = f"{sum(row.finished for row in rows[:count])} of {count} designs are finished in {folder}"
                error.add_note(f"{finished}; the same command continues with the other designs")
                raise
        write(rows, folder)
    return rows[:count]


def _initial_entries(scenes: Sequence[BatchScene], folder: Path, earlier: Sequence[BatchEntry]) -> Iterator[BatchEntry]:
    finished = {row.key: row for row in earlier if row.finished and _hash_of_design(folder / row.name) == row.design}
    path_of: dict[str, str] = {}  # path of a scene file by the name of its scene
    for each in scenes:
        if each.scene is None:
            yield BatchEntry(scene=each.path, status=REFUSED, reason=each.reason)
            continue
        name, key = each.scene.name, f"{folders.hash_of(folders.scene_files(each.scene))} {environment.version()}"
        row, reason = BatchEntry(scene=each.path, name=name, key=key), ""
        if same := path_of.get(name):
            reason = f"name: {name!r} is also the name of {same}, whose design has the same folder; give another name"
        path_of.setdefault(name, each.path)
        try:
            files.check_free(folder / name)
        except ValueError as error:
            reason = reason or f"{error} with -o"
        if reason:
            yield row.changed(status=REFUSED, reason=reason)
        else:
            yield finished[key].changed(scene=each.path) if key in finished else row


def _design_all(
    rows: list[BatchEntry], remaining: Mapping[int, Scene], folder: Path, machines: Machines, progress: Progress
) -> None:
    """Design the remaining scenes, update their entries, and write batch.json whenever a design has ended."""
    waiting, local = list(remaining), isinstance(machines, LocalPool)
    under_way: list[int] = []  # indices of the running designs
    # The processes share the cores; environment variables that are already set are not changed.
    threads = environment.threads(machines.capacity)
    variables = {name: value for name, value in threads.items() if name not in os.environ}

    def tick() -> None:
        done = len(remaining) - len(waiting) - len(under_way)
        progress("batch", done, len(remaining), ", ".join(rows[k].name for k in under_way))

    write(rows, folder)
    while waiting or under_way:
        while waiting and len(under_way) < machines.capacity:
            under_way.append(k := waiting.pop(0))
            contents = folders.scene_files(remaining[k])
            if local:
                machines.start(k, design, contents, (folder / rows[k].name).absolute(), variables)
            else:
                machines.start(k, design_remotely, contents)
        answer = machines.next(tick)
        under_way.remove(answer.key)
        rows[answer.key] = _finished_entry(rows[answer.key], answer, folder, local)
        write(rows, folder)
    tick()


def _finished_entry(row: BatchEntry, answer: Answer, folder: Path, local: bool) -> BatchEntry:
    row = row.changed(where=answer.where)
    if answer.reason:
        return row.changed(status=BROKEN, reason=answer.reason)
    ending: ExitStatus = answer.value if local else answer.value[0]
    if ending.code not in (0, 1):
        status = REFUSED if ending.code == 2 else BROKEN
        return row.changed(status=status, reason=ending.reason, seconds=ending.seconds)
    if not local:
        try:
            _store_design(answer.value[1], folder / row.name)
        except SceneError as error:
            return row.changed(status=REFUSED, reason=str(error))
    try:
        report = cold_run.read_report(folder / row.name)
    except MachineError as error:
        return row.changed(status=BROKEN, reason=str(error))
    return row.changed(
        status=report["verdict"],
        checks_failed=tuple(check["name"] for check in report["checks"] if not check["passed"]),
        seconds=report["seconds_total"],
        report=f"{row.name}/report.html",
        design=_hash_of_design(folder / row.name),
        **{key: report[key] for key in ("rrmsd", "rrmsd_noise", "leak", "light_on_target")},
    )


def _store_design(contents: SceneFiles, folder: Path) -> None:
    """Write the files of a design from another machine into its folder, replacing an earlier design."""
    with files.exclusive(folder), folders.replacing(folder) as building:
        for name, data in contents.items():
            path = building / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)


def _hash_of_design(folder: Path) -> str:
    """Return the SHA-256 of design.npz in a folder; "" if the folder contains no design."""
    try:
        data = files.contents(folder / "design.npz", files.MAX_ARCHIVE_SIZE)
    except ValueError:
        return ""
    return hashlib.sha256(data).hexdigest() if (folder / "report.json").is_file() else ""


# --- batch.json, batch.csv and the terminal ---------------------------------------------------------------------------


def read(folder: Path) -> tuple[BatchEntry, ...]:
    """Read the designs of earlier batches from batch.json in a folder; raise MachineError if it is damaged."""
    path = folder / "batch.json"
    return cold_run.read_record(Batch, path, "remove it, and all designs are repeated").designs if path.exists() else ()


def write(rows: Sequence[BatchEntry], folder: Path) -> None:
    """Write batch.json and batch.csv."""
    cold_run.write_record(folder / "batch.json", Batch(version=bstcad.__version__, designs=tuple(rows)))
    texts = ({"checks_failed": "; ".join(row.checks_failed), "seconds": f"{row.seconds:.1f}"} for row in rows)
    lines = (dict(row) | text for row, text in zip(rows, texts, strict=True))
    cold_run.write_csv(folder / "batch.csv", BATCH_COLUMNS, lines)


def exit_code(rows: Sequence[BatchEntry]) -> int:
    """Return 2 if a scene was refused, 1 if a check failed or an error ended a design, else 0."""
    if any(row.status == REFUSED for row in rows):
        return 2
    return int(any(row.status == BROKEN or row.checks_failed for row in rows))


def summary(rows: Sequence[BatchEntry], folder: Path, verbose: bool = False) -> Group:
    """Return a line per design, with RRMSD and time or the reason of a failure, then failed checks (verbose: all)."""
    from rich.console import Group
    from rich.text import Text

    wide, lines = max(map(len, VERDICTS)), []
    checked: list[Text] = []
    for row in rows:
        figures = f"RRMSD {row.rrmsd:.4f}  {row.seconds:5.0f} s  " if row.finished else ""
        reason = f": {row.reason}" if row.reason else ""
        status = f"{row.status.upper():{wide}}", STATUS_STYLES.get(row.status, "bold red")
        lines.append(Text.assemble(status, f"  {figures}{row.scene}{reason}"))
        if row.checks_failed or (verbose and row.finished):
            checks = [Check(**check) for check in cold_run.read_report(folder / row.name)["checks"]]
            checked += check_lines(checks, verbose, f"{row.scene}: ")
    return Group(*lines, *checked)
