"""The command line.  Exit codes: 0 every check passed, 1 lens written but a check failed, 2 wrong input."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core
from rich.console import Console

from bstcad import __version__, error_sentences
from bstcad.error_sentences import InputError
from bstcad.runs import memory, signals, worker

if TYPE_CHECKING:
    from bstcad.scene.scene import Scene

STARTED = time.perf_counter()  # heavy libraries load after it: their time is the command's
DEVICES = ("auto", "cpu", "cuda")
INTERRUPTED, BROKEN = 130, 70  # exit codes: Ctrl-C; a fault of bstcad itself

MEANT = {  # by words that are no commands
    **dict.fromkeys(("design", "make", "run", "build", "create", "optimise", "optimize"), "generate"),
    **dict.fromkeys(("check", "prove", "test", "report", "measure"), "verify"),
}


class _Commands(typer.core.TyperGroup):
    """The commands, which know what somebody meant who writes another word, or a file alone."""

    def resolve_command(self, context: Any, arguments: list[str]) -> Any:
        """The command that the first argument names."""
        word = arguments[0]
        if word not in self.commands:
            kind = {".toml": "generate", ".step": "verify", ".stp": "verify"}.get(Path(word).suffix.lower())
            if kind or word in MEANT:
                meant = f"{kind} {word}" if kind else MEANT[word]
                context.fail(f"No such command {word!r}. Did you mean {meant!r}?")
        return super().resolve_command(context, arguments)


app = typer.Typer(
    name="bstcad",
    cls=_Commands,
    help="From a picture to a machinable freeform lens, as an exact B-spline STEP solid.",
    add_completion=False,
    pretty_exceptions_enable=False,
)


# Arguments and options that commands share.
SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="The scene file (TOML); see templates/.")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Replace one value of the scene: --set target.pixels=128."),
]


class Stopped(Exception):
    """Ctrl-C, where something is kept; its text goes on after "stopped"."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit code."""
    memory.keep_freed()
    code = run(arguments)
    worker.end()
    gc.freeze()  # the system takes the memory back; a last walk over millions of objects would take a second
    sys.exit(code)


def run(arguments: Sequence[str] | None = None) -> int:
    """The exit code of the command; whatever is wrong with the input is one sentence on stderr."""
    try:
        with signals.endings():
            code = app(args=arguments, prog_name="bstcad", standalone_mode=False) or 0
    except signals.Ended as ended:
        return _ended(ended)
    except Stopped as kept:
        return _say(f"stopped{kept}", INTERRUPTED)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Exception as error:
        if ended := signals.ended():  # and on the way out a terminal that is gone could not be written to
            return _ended(ended)
        sentence, note = error_sentences.sentence(error), error_sentences.note(error)
        if sentence is None:
            traceback.print_exc()
            sentence = "the fault above is bstcad's, not yours; please report it with the scene file"
        return _say(
            f"{sentence}; {note}" if note else sentence, BROKEN if error_sentences.sentence(error) is None else 2
        )
    return _say("stopped; there was no lens yet, and nothing is kept", code) if code == INTERRUPTED else code


def _ended(ended: signals.Ended) -> int:
    return _say(f"ended by {ended.name}; {error_sentences.note(ended) or 'nothing is kept'}", 128 + ended.number)


def _say(sentence: str, code: int) -> int:
    with contextlib.suppress(OSError):  # a terminal that is gone
        print(f"bstcad: {sentence}", file=sys.stderr)
    return code


def _version(wanted: bool) -> None:
    if wanted:
        print(f"bstcad {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _bstcad(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and leave.")
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())


@contextlib.contextmanager
def _loading() -> Iterator[None]:
    """Libraries load in the block: signals wait until it ends, and nothing looks for garbage.

    What is loaded is a million objects that stay.  To walk over them while they come would take half a second, and
    later it is not needed either.
    """
    with signals.waiting():
        gc.disable()
        try:
            yield
        finally:
            gc.freeze()
            gc.enable()


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
) -> int:
    """Design a lens for a scene, write it, and verify what was written."""
    scene = _path(scene)
    with _loading():
        worker.begin()  # it loads its libraries while this process loads others
        wanted = _load(scene, settings or [], quality)
    folder = _folder(output or Path("outputs") / wanted.name)
    _check_device(device)
    with _loading():
        from bstcad import commands
        from bstcad.runs import checkpoint, progress

    _warn(wanted)
    _say_what_is_there(folder, resume)
    with progress.watch(Console(stderr=True)) as watched, signals.first_interrupt_is_a_wish() as interrupted:
        try:
            report = commands.generate(
                wanted, folder, device=device, progress=watched, began=STARTED, resume=resume, interrupted=interrupted
            )
        except KeyboardInterrupt as error:  # which typer would swallow with its note
            if error_sentences.note(error):
                raise Stopped(f"; {error_sentences.note(error)}") from error
            raise
    if report.get("stopped") != "interrupt":
        return _conclude(report, folder)
    _conclude(report, commands.place_for(folder, "interrupt"))
    if not checkpoint.path_for(folder).exists():
        raise Stopped(" with the best so far; without a checkpoint there is nothing to go on from")
    raise Stopped(" with the best so far; the same command with --resume goes on from there")


@app.command()
def plan(
    scene: SceneFile,
    settings: Settings = None,
    as_json: Annotated[bool, typer.Option("--json", help="For programs: the same as JSON.")] = False,
) -> int:
    """Predict time, error and memory; say what is simulated, what is left out and what that changes; in seconds."""
    path = _path(scene)
    with _loading():
        wanted = _load(path, settings or [], None)
        from bstcad.plan import plan as planned

    _warn(wanted)
    keys = [setting.partition("=")[0].strip() for setting in settings or []]
    found = planned(wanted, path.read_text(encoding="utf-8-sig"), keys)
    if as_json:
        print(json.dumps(found, ensure_ascii=False, indent=2))
        return 0
    from bstcad.report.plan_table import table

    Console().print(table(found, wanted.title or wanted.name, wanted.optic))
    return 0


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
    scene = _path(scene)
    if not 0 < budget < 1e7:
        raise InputError(f"--budget {budget:g}: is not possible; give the seconds that the runs may take, such as 600")
    with _loading():
        wanted = _load(scene, settings or [], quality)
        from bstcad.runs import progress
        from bstcad.tradeoff import command

    _warn(wanted)
    folder = _path(output or Path("outputs") / f"{wanted.name}-tradeoff")
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
    with _loading():
        from bstcad.tradeoff.cluster import Cluster
    with Cluster(scheduler) as machines:
        yield machines


@app.command()
def new(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Of the scene; NAME.toml is written.")] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="What a plate in parallel light is to throw on a wall.")
    ] = None,
    size: Annotated[float | None, typer.Option(metavar="MM", help="Width and height of the plate (80).")] = None,
    distance: Annotated[float | None, typer.Option(metavar="MM", help="To the wall (5 times the size).")] = None,
    template: Annotated[str | None, typer.Option(metavar="T", help="Copy this template instead; see --list.")] = None,
    listed: Annotated[bool, typer.Option("--list", help="List the templates.")] = False,
) -> int:
    """Write a commented scene to start from."""
    _path(Path())
    with _loading():
        from bstcad.scene import new_scene

    if listed:
        known = new_scene.templates()
        print("\n".join(f"{key:{max(map(len, known))}}  {title}" for key, title in known.items()))
        return 0
    if name is None:
        raise InputError("missing argument 'NAME'; give a name for the scene, or --list")
    path = new_scene.new_scene(name, Path(), picture=picture, size=size, distance=distance, template=template)
    print(f"{path} is written; next: bstcad generate {path}")
    return 0


@app.command()
def verify(
    path: Annotated[Path, typer.Argument(metavar="DIR|STEP", help="A design's folder, or the STEP file in it.")],
) -> int:
    """Verify a lens from its written files."""
    path = _path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; give a design's folder, such as outputs/thu")

    with _loading():
        worker.begin()
        from bstcad import commands
        from bstcad.runs import progress

    with progress.watch(Console(stderr=True)) as watched:
        report = commands.verify(path, progress=watched)
    return _conclude(report, path)


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


def _load(path: Path, settings: list[str], quality: str | None) -> Scene:
    """The scene with the command line's changes."""
    from bstcad.scene.scene import load

    overrides: dict[str, Any] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals:
            raise InputError(f"--set {setting}: has no value; write --set KEY=VALUE, such as --set target.pixels=128")
        overrides[key.strip()] = value.strip()
    if quality is not None:
        overrides["tailoring.quality"] = quality
    return load(path, overrides)


def _warn(scene: Scene) -> None:
    for warning in scene.warnings():
        print(f"bstcad: warning: {warning}", file=sys.stderr)


def _folder(folder: Path) -> Path:
    """A folder the design may take: new, empty, or an earlier design's, which it replaces whole."""
    from bstcad import files

    folder = _path(folder)
    try:
        files.check_free(folder)
    except ValueError as error:
        raise InputError(f"{error} with -o") from None
    return folder


def _path(path: Path) -> Path:
    """A path as somebody meant it who wrote ~ where no shell looks, and that every library can take."""
    path = Path(os.path.expanduser(path))
    try:
        str(Path(os.getcwd(), path)).encode()  # asked for whatever the path: libraries fail without a working folder
    except UnicodeEncodeError:
        raise InputError(f"{str(path)!r}: its name is no UTF-8 text; give a path whose name is") from None
    return path


def _check_device(device: str) -> None:
    if device not in DEVICES:
        raise InputError(f"--device {device}: is not possible; give one of {', '.join(DEVICES)}")
    if device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise InputError("--device cuda: this machine has no CUDA device that torch can use; give --device cpu")


def _conclude(report: dict[str, Any], path: Path) -> int:
    """Print the verdict and where the files lie; the exit code."""
    from bstcad.report.report import summary

    console = Console()
    console.print(summary(report))
    console.print(f"Files: {path}", markup=False, highlight=False, soft_wrap=True)
    return 0 if report["passed"] else 1


if __name__ == "__main__":
    main()
