"""The command that shows a design at work: show."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated

import typer

from bstcad.cli.application import app, loading, path_meant
from bstcad.error_sentences import InputError


@app.command()
def show(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A design's folder.")],
    png: Annotated[
        Path | None, typer.Option("--png", "-o", metavar="FILE", help="Write a picture instead of opening a window.")
    ] = None,
) -> int:
    """Show a lens at work: rays coloured by their flux, and the screen with its picture."""
    folder = path_meant(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a design's folder, such as outputs/thu")
    if png is not None:
        png = path_meant(png)
        if png.suffix.lower() != ".png" or png.is_dir():
            raise InputError(f"--png {png}: is no name of a PNG; give one such as light.png")
        if not png.absolute().parent.is_dir():
            raise InputError(f"--png {png}: there is no folder {png.parent}; make it first")
    with loading():
        from bstcad import show as showing

    if png is None:
        with contextlib.suppress(KeyboardInterrupt):  # one way to close a window
            showing.show(folder, None)
        return 0
    showing.show(folder, png)
    print(f"Files: {png}")
    return 0
