"""The command for what accuracy costs: tradeoff."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from bstcad import error_sentences
from bstcad.cli.application import SceneFile, Settings, Stopped, app, load_scene, loading, path_meant, warn
from bstcad.error_sentences import InputError


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
        from bstcad.tradeoff import command

    warn(wanted)
    folder = path_meant(output or Path("outputs") / f"{wanted.name}-tradeoff")
    terminal = Console(stderr=True)
    pause = 1.0 if terminal.is_terminal else 30.0  # seconds
    with _machines(scheduler) as machines, progress.watch(terminal) as watched:
        try:
            found = command.tradeoff(wanted, folder, budget=budget, progress=watched, pause=pause, machines=machines)
        except KeyboardInterrupt as error:  # which typer would swallow with its note
            raise Stopped(f"; {error_sentences.note(error) or 'no run has ended yet, and nothing is kept'}") from error
    console = Console()
    console.print(command.summary(found))
    console.print(f"Files: {folder}", markup=False, highlight=False, soft_wrap=True)
    return 0 if found.lenses else 1


@contextlib.contextmanager
def _machines(scheduler: str | None) -> Iterator[Any]:
    """Where the runs of a sweep take place; None: here."""
    if scheduler is None:
        yield None
        return
    with loading():
        from bstcad.tradeoff.cluster import Cluster
    with Cluster(scheduler) as machines:
        yield machines
