"""What `bstcad tradeoff` does: sweep, and write what it came to."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from bstcad import files
from bstcad.scene.scene import Scene
from bstcad.tradeoff import figure, page, written
from bstcad.tradeoff.findings import Findings
from bstcad.tradeoff.sweep import Sweep, sweep

if TYPE_CHECKING:
    from rich.console import Group

STYLES = {"pass": "bold green", "remarks": "bold yellow", "fail": "bold red"}  # of the page, of the terminal


def tradeoff(scene: Scene, folder: Path, **options: Any) -> Findings:
    """Sweep a scene (sweep.sweep has the options) and write tradeoff.csv, .json, .png and .html.

    The two tables are written after each run, so that they are there however a sweep ends.
    """
    latest: list[Sweep] = []

    def keep(so_far: Sweep) -> None:
        latest[:] = [so_far]
        written.write(Findings(so_far), folder)

    try:
        found = Findings(sweep(scene, folder, keep=keep, **options))
    except BaseException as error:
        if latest:
            count = len(latest[0].records)
            kept = "1 run is" if count == 1 else f"{count} runs are"
            error.add_note(f"{kept} kept in {folder}; the same command goes on from there")
            if isinstance(error, KeyboardInterrupt):  # who presses Ctrl-C has time for a picture
                publish(Findings(latest[0]), folder)
        raise
    publish(found, folder)
    return found


def publish(found: Findings, folder: Path) -> None:
    """Write all four files."""
    written.write(found, folder)
    picture = figure.draw(found) if found.lenses else None
    if picture:
        files.put(folder / "tradeoff.png", picture)
    else:
        (folder / "tradeoff.png").unlink(missing_ok=True)
    page.write(found, folder / "tradeoff.html", picture)


def summary(found: Findings) -> Group:
    """The knobs, the presets and the verdict for the terminal."""
    from rich.console import Group
    from rich.text import Text

    style, head, said = page.verdict(found)
    lines = [_presets(found), _knobs(found), *(Text(f"Note: {note}") for note in page.notes(found))]
    lines += [Text(f"Failed: {found.labels.get(record.settings, '')}: {record.reason}") for record in found.failed]
    if found.sweep.not_run:
        count = len(found.sweep.not_run)
        lines.append(Text(f"{count} runs did not fit into the budget; a larger --budget goes on from here"))
    return Group(*lines, Text(f"{head} ", STYLES[style]).append(said, "default"))


def _presets(found: Findings) -> Any:
    from rich.table import Table

    table = Table(title=found.sweep.scene.title or found.sweep.scene.name, title_justify="left")
    table.add_column("preset")
    for heading in ("RRMSD",) if found.errors_alone else ("RRMSD", "seconds"):
        table.add_column(heading, justify="right")
    for name, record in found.presets.items():
        table.add_row(name, f"{record.rrmsd:.4f}", *([] if found.errors_alone else [f"{record.seconds:.1f}"]))
    return table


def _knobs(found: Findings) -> Any:
    from rich.table import Table

    table = Table()
    for heading in ("knob", "what it does to the error" if found.errors_alone else "where it stops paying"):
        table.add_column(heading)
    for turned in found.turned:
        if len(turned.places) > 1:
            table.add_row(turned.knob.title, turned.says)
    return table
