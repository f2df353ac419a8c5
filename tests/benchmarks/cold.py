"""`bstcad generate` of a scene in a cold process, and what the whole command took."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bstcad.runs import processes

ROOT = Path(__file__).parent.parent.parent
TEMPLATES = ROOT / "templates"
LIMIT = 3600.0  # seconds, after which a command is ended


@dataclass(frozen=True)
class Run:
    """A command that has ended."""

    folder: Path
    code: int
    said: str  # text of the command on stderr
    seconds: float
    cpu_seconds: float  # CPU seconds of all processes and threads

    def report(self) -> dict[str, Any]:
        """Return report.json; raise an error with the last lines of the command where there is none."""
        path = self.folder / "report.json"
        if not path.is_file():
            raise SystemExit(f"{self.folder.name}: exit {self.code}\n{self.said[-2000:]}")
        return json.loads(path.read_text(encoding="utf-8"))


def generate(scene: str | Path, folder: Path, *settings: str) -> Run:
    """`bstcad generate` of a template or of a scene file's whole path, with settings as `--set` takes them."""
    path = (TEMPLATES / scene).with_suffix(".toml")
    changes = [word for setting in settings for word in ("--set", setting)]
    ended = processes.run(["generate", str(path), "-o", str(folder), *changes], LIMIT)
    return Run(folder, ended.code, ended.stderr, ended.seconds, ended.cpu_seconds)
