"""Commands for many designs: tradeoff, batch."""

from __future__ import annotations

import glob
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from bstcad.cli.application import (
    InputError,
    SceneFile,
    Scheduler,
    Settings,
    Stopped,
    Verbose,
    app,
    check_workers,
    cluster,
    load_scene,
    loading,
    note,
    path_meant,
    sentence_of,
    warn,
)

if TYPE_CHECKING:
    from bstcad.sweep.batch import Wanted

OFTEN, SELDOM = 1.0, 30.0  # seconds between two words of progress on a terminal, in a file


@app.command()
def tradeoff(
    scene: SceneFile,
    budget: Annotated[
        float,
        typer.Option(
            metavar="S",
            help="Seconds that all runs together may take, judging included, on however many machines: a run predicted "
            "not to fit is not begun, one that takes longer is ended a tenth beyond; the first one is run to its end.",
        ),
    ] = 600.0,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Its folder (default: outputs/NAME-tradeoff).")
    ] = None,
    settings: Settings = None,
    quality: Annotated[str | None, typer.Option(metavar="Q", help="From which the knobs are turned.")] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="URL", help="Spread the runs over a dask scheduler's workers, for their errors alone."),
    ] = None,
) -> int:
    """Show what accuracy costs in time: run a scene with one knob turned at a time; goes on where it was stopped."""
    scene = path_meant(scene)
    if not 0 < budget < 1e7:
        raise InputError(f"--budget {budget:g}: is not possible; give the seconds that the runs may take, such as 600")
    with loading():
        wanted = load_scene(scene, settings or [], quality)
        from bstcad.runs import progress
        from bstcad.sweep import results
        from bstcad.sweep import tradeoff as sweeping

    warn(wanted)
    folder = path_meant(output or Path("outputs") / f"{wanted.name}-tradeoff")
    terminal = Console(stderr=True)
    pause = OFTEN if terminal.is_terminal else SELDOM
    with cluster(scheduler) as machines, progress.watch(terminal) as watched:
        try:
            table = sweeping.tradeoff(wanted, folder, budget=budget, progress=watched, pause=pause, machines=machines)
        except KeyboardInterrupt as error:  # which typer would swallow with its note
            raise Stopped(f"; {note(error) or 'no run has ended yet, and nothing is kept'}") from error
    console = Console()
    console.print(results.summary(table))
    console.print(f"Files: {folder}", markup=False, highlight=False, soft_wrap=True)
    return 0 if table.lenses else 1


@app.command()
def batch(
    scenes: Annotated[
        list[str], typer.Argument(metavar="SCENES...", help="Scene files (TOML), or patterns such as 'scenes/*.toml'.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="The folder of the designs' folders.")
    ] = Path("outputs"),
    settings: Settings = None,
    quality: Annotated[str | None, typer.Option(metavar="Q", help="Of all of them.")] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers", metavar="N", help="Designs at a time here (default: one for two cores, if memory allows)."
        ),
    ] = None,
    scheduler: Scheduler = None,
    verbose: Verbose = False,
) -> int:
    """Design many lenses, each into its own folder; those that are finished already are left as they are."""
    check_workers(scheduler, workers)
    paths, folder = _paths(scenes), path_meant(output)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; give another folder with -o")
    with loading():
        from bstcad.report.report import check_lines
        from bstcad.runs import progress
        from bstcad.sweep import batch as batches

        wanted = [_wanted(path, settings or [], quality) for path in paths]
    terminal = Console(stderr=True)
    with cluster(scheduler) as found, progress.watch(terminal) as watched:
        try:
            rows = batches.batch(
                wanted, folder, workers=workers, cluster=found, progress=watched,
                pause=OFTEN if terminal.is_terminal else SELDOM,
                say=lambda sentence: print(f"bstcad: {sentence}", file=sys.stderr),
            )  # fmt: skip
        except KeyboardInterrupt as error:  # which typer would swallow with its note
            raise Stopped(f"; {note(error)}") from error
    console = Console()
    console.print(batches.summary(rows), soft_wrap=not console.is_terminal)
    for row in rows:
        if row.checks_failed or (verbose and row.finished):
            for line in check_lines(batches.checks(row, folder), verbose, f"{row.scene}: "):
                console.print(line, soft_wrap=not console.is_terminal)
    places = f"{folder / 'batch.csv'}, batch.json; the report of each design: {folder}/NAME/report.html"
    console.print(f"Files: {places}", markup=False, highlight=False, soft_wrap=True)
    return batches.exit_code(rows)


def _paths(patterns: list[str]) -> list[Path]:
    """The scene files that are meant, each once."""
    found: dict[Path, Path] = {}
    for pattern in patterns:
        path = path_meant(Path(pattern))
        paths = [path] if path.exists() else [Path(name) for name in sorted(glob.glob(str(path), recursive=True))]
        if not paths and glob.has_magic(pattern):
            raise InputError(f"{pattern}: no file is named so; give scene files, such as templates/*.toml")
        for each in paths or [path]:
            found.setdefault(each.resolve(), each)
    return list(found.values())


def _wanted(path: Path, settings: list[str], quality: str | None) -> Wanted:
    """The scene of a file, or the sentence that says what is wrong with it."""
    from bstcad.scene.errors import SceneError
    from bstcad.sweep.batch import Wanted

    try:
        scene = load_scene(path, settings, quality)
    except (SceneError, OSError) as error:
        return Wanted(str(path), None, sentence_of(error))
    warn(scene, str(path))
    return Wanted(str(path), scene)
