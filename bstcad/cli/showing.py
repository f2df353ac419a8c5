"""Commands that show: a design at work (show), and the keys of a scene (keys, schema)."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bstcad.cli.application import InputError, app, loading, path_meant


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
        from bstcad.runs import commands

    if png is None:
        with contextlib.suppress(KeyboardInterrupt):  # one way to close a window
            commands.show(folder, None)
        return 0
    commands.show(folder, png)
    print(f"Files: {png}")
    return 0


@app.command()
def keys(
    key: Annotated[
        str | None, typer.Argument(metavar="KEY", help="A key or a table, such as lens.tool_radius (default: all).")
    ] = None,
) -> int:
    """Print keys of a scene with unit, range, default and meaning."""
    from bstcad.scene.errors import nearest
    from bstcad.scene.schema import rows

    found = {row: re.sub(r"\[\]", "", row.key) for row in rows()}
    asked = re.sub(r"\[\d*\]", "", key or "")
    shown = [row for row, name in found.items() if f"{name}.".startswith(f"{asked}.") or not asked]
    if not shown:
        table = asked
        while table and table not in found.values():
            table = table.rpartition(".")[0]
        known = sorted({name for name in found.values() if name.rpartition(".")[0] == table})
        raise InputError(f"{key}: unknown key; {nearest(asked, known, 'the keys here are')}")
    cells = [
        (row.key, row.unit, row.range, row.default, f"{', '.join(row.kinds)}: {row.meaning}".removeprefix(": "))
        for row in shown
    ]
    console = Console()
    if not console.is_terminal:
        print("\n".join("\t".join(row) for row in cells))
        return 0
    table = Table("key", "unit", "range", "default", "meaning", box=None, pad_edge=False)
    for row in cells:
        table.add_row(*map(Text, row))
    console.print(table)
    return 0


@app.command()
def schema() -> int:
    """Print the JSON schema of a scene, by which editors complete and check its keys.

    Save it beside a scene and let that begin with the line: #:schema scene.schema.json
    """
    from bstcad.scene.schema import FILE

    print(FILE.read_text(encoding="utf-8"), end="")
    return 0
