"""The blocks of the pages that run: ```sh (a command a line), ```python (a script) and ```toml (keys of a scene)."""

from __future__ import annotations

import hashlib
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
FENCE = re.compile(r"^(?:<!-- onto: (?P<onto>\S+) -->\n)?```(?P<kind>sh|python|toml)\n(?P<text>.*?)^```$", re.S | re.M)


@dataclass(frozen=True)
class Block:
    """A block of a page."""

    page: Path
    kind: str  # sh, python or toml
    text: str
    line: int  # of its fence, from 1
    onto: str = "disk.toml"  # of toml: the template that its keys go into

    @property
    def commands(self) -> list[list[str]]:
        """The commands of a block of kind sh as lists of words."""
        return [shlex.split(line) for line in self.text.replace("\\\n", " ").splitlines() if line.strip()]


def blocks(page: Path) -> list[Block]:
    """The blocks of a page that run, in order."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(page, found["kind"], found["text"], text.count("\n", 0, found.start()) + 1, found["onto"] or "disk.toml")
        for found in FENCE.finditer(text)
    ]


def run(page: Path, folder: Path) -> None:
    """Run the sh and python blocks of a page in a folder; their output goes into 1.txt, 2.txt … there.

    A folder whose stamp agrees with the page and the package is left as it is.
    """
    parts = [block for block in blocks(page) if block.kind != "toml"]
    stamp, of_run = folder / "stamp.txt", _stamp(parts)
    if stamp.exists() and stamp.read_text() == of_run:
        return
    stamp.unlink(missing_ok=True)
    scripts = Path(sys.executable).parent
    environment = os.environ | {
        "PATH": f"{scripts}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "COLUMNS": "110",
    }
    for number, block in enumerate(parts, start=1):
        commands = block.commands if block.kind == "sh" else [["python", "-"]]
        output = ""
        for command in commands:
            given = block.text if block.kind == "python" else None
            done = subprocess.run(
                command, cwd=folder, env=environment, input=given, text=True, stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT, check=False,
            )  # fmt: skip
            if done.returncode:
                raise RuntimeError(
                    f"{page}:{block.line}: {shlex.join(command)} ended with {done.returncode}:\n{done.stdout}"
                )
            output += done.stdout
        (folder / f"{number}.txt").write_text(output, encoding="utf-8")
    stamp.write_text(of_run)


def _stamp(parts: list[Block]) -> str:
    """A digest of the blocks and of the package."""
    digest = hashlib.sha256(repr([(block.kind, block.text) for block in parts]).encode())
    for path in sorted((ROOT / "bstcad").rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()
