"""Commands before and for a design: generate, plan, new."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from bstcad.cli.application import (
    STARTED,
    InputError,
    SceneFile,
    Settings,
    Stopped,
    Verbose,
    app,
    conclude,
    load_scene,
    loading,
    note,
    path_meant,
    warn,
)
from bstcad.runs import signals, worker

DEVICES = ("auto", "cpu", "cuda")


@app.command()
def generate(
    scene: SceneFile,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="The design's folder (default: outputs/NAME).")
    ] = None,
    settings: Settings = None,
    quality: Annotated[
        str | None, typer.Option(metavar="Q", help="draft, standard, fine or paper: more time, less error.")
    ] = None,
    device: Annotated[
        str,
        typer.Option(metavar="D", help="auto (the CPU), cpu, or cuda: a GPU, unmeasured yet."),
    ] = "auto",
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the design that was stopped or killed in this folder.")
    ] = False,
    verbose: Verbose = False,
) -> int:
    """Design a lens for a scene, write it, and verify what was written."""
    scene = path_meant(scene)
    with loading():
        worker.begin()  # it loads its libraries while this process loads others
        wanted = load_scene(scene, settings or [], quality)
    folder = _folder(output or Path("outputs") / wanted.name)
    _check_device(device)
    with loading():
        from bstcad.runs import checkpoint, commands, progress

    warn(wanted)
    _say_what_is_there(folder, resume)
    with progress.watch(Console(stderr=True)) as watched, signals.first_interrupt_is_a_wish() as interrupted:
        try:
            report = commands.generate(
                wanted, folder, device=device, progress=watched, began=STARTED, resume=resume, interrupted=interrupted
            )
        except KeyboardInterrupt as error:  # which typer would swallow with its note
            if note(error):
                raise Stopped(f"; {note(error)}") from error
            raise
    if report.stopped != "interrupt":
        return conclude(report, folder, verbose)
    conclude(report, commands.place_for(folder, "interrupt"), verbose)
    if not checkpoint.path_for(folder).exists():
        raise Stopped(" with the best so far; without a checkpoint there is nothing to go on from")
    raise Stopped(" with the best so far; the same command with --resume goes on from there")


@app.command()
def plan(
    scene: SceneFile,
    settings: Settings = None,
    as_json: Annotated[bool, typer.Option("--json", help="For programs: the same as JSON.")] = False,
) -> int:
    """Say what is simulated, what is left out and what that changes; then predict time, error and memory."""
    path = path_meant(scene)
    with loading():
        wanted = load_scene(path, settings or [], None)
        from bstcad.sweep.plan import plan as planned

    warn(wanted)
    keys = [setting.partition("=")[0].strip() for setting in settings or []]
    text = path.read_text(encoding="utf-8-sig")
    if as_json:
        print(json.dumps(planned(wanted, text, keys), ensure_ascii=False, indent=2))
        return 0
    from bstcad.report import report as reports

    console = Console()

    def first(effects: Mapping[str, Any]) -> None:
        console.print(reports.plan_effects(effects, wanted.title or wanted.name, wanted.optic))
        print("predicting seconds, RRMSD and memory …", file=sys.stderr, flush=True)

    console.print(reports.plan_predictions(planned(wanted, text, keys, first=first)))
    return 0


@app.command()
def new(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Of the scene; NAME.toml is written.")] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The picture that a plate is to throw on a wall.")
    ] = None,
    light: Annotated[
        str | None, typer.Option(metavar="L", help="That the plate is for: sun, laser, lamp or led (laser).")
    ] = None,
    size: Annotated[str | None, typer.Option(metavar="MM", help="Of the plate: 80, or width x height, 80x60.")] = None,
    distance: Annotated[
        str | None, typer.Option(metavar="MM", help="To the wall (5 times the size; in the sun 2.5 times).")
    ] = None,
    template: Annotated[str | None, typer.Option(metavar="T", help="Copy this template instead; see --list.")] = None,
    listed: Annotated[bool, typer.Option("--list", help="List the templates.")] = False,
) -> int:
    """Write a commented scene to start from."""
    path_meant(Path())
    with loading():
        from bstcad.scene import new_scene

    if listed:
        known = new_scene.templates()
        print("\n".join(f"{key:{max(map(len, known))}}  {title}" for key, title in known.items()))
        return 0
    if name is None:
        raise InputError("missing argument 'NAME'; give a name for the scene, or --list")
    written = new_scene.new_scene(
        name, Path(), picture=picture, light=light, size=size, distance=distance, template=template
    )
    if written.said:
        print(written.said)
    print(f"{written.path} is written; next: bstcad generate {written.path}")
    return 0


def _say_what_is_there(folder: Path, resume: bool) -> None:
    """Whether there is a design to go on with."""
    from bstcad.runs import checkpoint, lock

    if lock.busy(folder):  # by a run that works: what is there is not for this one
        return
    there = checkpoint.path_for(folder).exists()
    if resume and not there:
        print("bstcad: no checkpoint to go on from; the design begins anew", file=sys.stderr)
    if there and not resume:
        print("bstcad: the design stopped here before begins anew; --resume would go on with it", file=sys.stderr)


def _folder(folder: Path) -> Path:
    """A folder the design may take: new, empty, or an earlier design's, which it replaces whole."""
    from bstcad import files

    folder = path_meant(folder)
    try:
        files.check_free(folder)
    except ValueError as error:
        raise InputError(f"{error} with -o") from None
    return folder


def _check_device(device: str) -> None:
    if device not in DEVICES:
        raise InputError(f"--device {device}: is not possible; give one of {', '.join(DEVICES)}")
    if device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise InputError("--device cuda: this machine has no CUDA device that torch can use; give --device cpu")
