"""The command for what has been made: verify."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from bstcad.cli.application import app, conclude, loading, path_meant
from bstcad.error_sentences import InputError
from bstcad.runs import worker


@app.command()
def verify(
    path: Annotated[Path, typer.Argument(metavar="DIR|STEP", help="A design's folder, or the STEP file in it.")],
) -> int:
    """Verify a lens from its written files."""
    path = path_meant(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; give a design's folder, such as outputs/thu")

    with loading():
        worker.begin()
        from bstcad import commands
        from bstcad.runs import progress

    with progress.watch(Console(stderr=True)) as watched:
        report = commands.verify(path, progress=watched)
    return conclude(report, path)
