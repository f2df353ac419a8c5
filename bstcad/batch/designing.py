"""One design of a batch: `bstcad generate` in a process of its own, here or on a worker of a cluster."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from bstcad.runs import cold
from bstcad.runs.cold import Ending
from bstcad.runs.folder import SCENE

KILLED = -9  # exit code of a process that somebody, or the system for want of memory, has killed


@dataclass(frozen=True)
class Order:
    """What it takes to carry out a design."""

    scene_of: Mapping[str, bytes]  # the scene and what it names, by file name
    resume: bool = False  # with the checkpoint beside its folder
    environment: Mapping[str, str] | None = None  # variables of its process


def design(order: Order, folder: Path, tick: Callable[[], None] = lambda: None) -> Ending:
    """Design into a folder; a process that was killed is begun once more, from its checkpoint."""
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        for name, data in order.scene_of.items():
            (Path(place) / name).write_bytes(data)
        command = ["generate", str(Path(place) / SCENE), "-o", str(folder)]
        resume = ["--resume"] if order.resume else []
        first = cold.run([*command, *resume], tick=tick, environment=order.environment)
        if first.code != KILLED:
            return first
        again = cold.run([*command, "--resume"], tick=tick, environment=order.environment)
    return replace(again, seconds=first.seconds + again.seconds, cpu_seconds=first.cpu_seconds + again.cpu_seconds)


def design_elsewhere(order: Order) -> tuple[Ending, dict[str, bytes]]:
    """On a worker: how it went, and the files of the design's folder by their paths in it."""
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        folder = Path(place) / "design"
        ended = design(order, folder)
        paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        return ended, {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
