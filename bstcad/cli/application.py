"""The command line as such: its name, the options that commands share, words that are no commands, and errors."""

from __future__ import annotations

import contextlib
import errno
import gc
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core
from rich.console import Console

from bstcad import __version__
from bstcad.files import SentenceError
from bstcad.runs import signals

if TYPE_CHECKING:
    from bstcad.report.record import Contents, Examined
    from bstcad.runs.cluster import Cluster
    from bstcad.scene.scene import Scene

STARTED = time.perf_counter()  # heavy libraries load after it: their time is the command's

MOST_WORKERS = 1000
NO_MEMORY = (
    "not enough memory", "out of memory", "bad_alloc", "cannot allocate memory", "can't allocate memory",
    "failed to map segment", "can't start new thread",
)  # fmt: skip

MEANT = {  # by words that are no commands
    **dict.fromkeys(("design", "make", "run", "build", "create", "optimise", "optimize"), "generate"),
    **dict.fromkeys(("check", "prove", "test", "report", "measure"), "verify"),
    **dict.fromkeys(("view", "draw", "render", "display"), "show"),
}


class _Commands(typer.core.TyperGroup):
    """The commands, with a hint for a user who writes another word, or a file alone."""

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


Verbose = Annotated[bool, typer.Option("--verbose", help="List every check with its value and limit.")]


Scheduler = Annotated[
    str | None,
    typer.Option("--scheduler", metavar="URL", help="Spread the work over the workers of this dask scheduler."),
]
Workers = Annotated[
    int | None,
    typer.Option("--workers", metavar="N", help="Spread the work over so many processes on this machine."),
]


class InputError(SentenceError, ValueError):
    """Wrong arguments of a command."""


class Stopped(Exception):
    """Ctrl-C, where something is kept; its text goes on after "stopped"."""


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
def loading() -> Iterator[None]:
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


def load_scene(path: Path, settings: list[str], quality: str | None) -> Scene:
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


def warn(scene: Scene, name: str = "") -> None:
    """Print the warnings of a scene on stderr; name: before each, where there are several scenes."""
    for warning in scene.warnings():
        print(f"bstcad: warning: {name and f'{name}: '}{warning}", file=sys.stderr)


def check_workers(scheduler: str | None, workers: int | None) -> None:
    """InputError for wrong values of these options."""
    if scheduler is not None and workers is not None:
        raise InputError("--workers: are started on this machine, and --scheduler has its own; give one of the two")
    if workers is not None and not 1 <= workers <= MOST_WORKERS:
        raise InputError(f"--workers {workers}: is not between 1 and {MOST_WORKERS}; give a number of processes")


@contextlib.contextmanager
def cluster(scheduler: str | None, workers: int | None = None) -> Iterator[Cluster | None]:
    """The workers that the work is to be spread over; None: nobody asked for any."""
    check_workers(scheduler, workers)
    if scheduler is None and workers is None:
        yield None
        return
    with loading():
        from bstcad.runs import cluster as clusters
    with clusters.local(workers) if scheduler is None else clusters.Cluster(scheduler) as found:
        yield found


def path_meant(path: Path) -> Path:
    """A path as somebody meant it who wrote ~ where no shell looks, and that every library can take."""
    path = Path(os.path.expanduser(path))
    try:
        str(Path(os.getcwd(), path)).encode()  # asked for whatever the path: libraries fail without a working folder
    except UnicodeEncodeError:
        raise InputError(f"{str(path)!r}: its name is no UTF-8 text; give a path whose name is") from None
    return path


def conclude(report: Contents | Examined, path: Path, verbose: bool) -> int:
    """Print the verdict and the path of the files; the exit code.  Without a terminal, each paragraph is one line."""
    from bstcad.report.report import summary

    console = Console()
    console.print(summary(report, verbose), soft_wrap=not console.is_terminal)
    console.print(f"Files: {path}", markup=False, highlight=False, soft_wrap=True)
    return 0 if report.passed else 1


# --- errors in one sentence -------------------------------------------------------------------------------------------


def note(error: BaseException) -> str:
    """The notes of an error, such as how to go on."""
    return "; ".join(getattr(error, "__notes__", ()))


def sentence_of(error: Exception) -> str | None:
    """The sentence for a user whose input is wrong; None if the error is not about the input."""
    if hasattr(error, "format_message"):  # typer's own: an unknown option, a missing argument
        text = error.format_message().splitlines()[0].rstrip(".").replace(". Did", "; did")
        return text[:1].lower() + text[1:] + ("" if text.endswith("?") else "; see bstcad --help")
    if isinstance(error, SentenceError):
        return str(error)
    if _out_of_memory(error):
        return (
            "the memory of this machine is too little for that; free some, or give fewer lens.back.control_points, "
            "target.pixels or tailoring.rays"
        )
    if isinstance(error, OSError) and not error.filename and not _here():
        return "the working folder was deleted; go to another one (cd) and try again"
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}; check that the path exists, may be written and has space left"
    return None


def _out_of_memory(error: Exception) -> bool:
    """Python, torch, the system and the loader of libraries each say it in their own way."""
    if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return True
    return isinstance(error, RuntimeError | ImportError) and any(words in str(error).lower() for words in NO_MEMORY)


def _here() -> bool:
    """Is there a working folder?"""
    try:
        os.getcwd()
    except OSError:
        return False
    return True
