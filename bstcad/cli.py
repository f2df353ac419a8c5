"""The command line: each command is a function of bstcad.commands, bstcad.sweep or bstcad.scene.

Exit codes: 0 every check passed, 1 lens written but a check failed, 2 wrong input.
"""

from __future__ import annotations

import contextlib
import gc
import glob
import json
import os
import re
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

from bstcad import __version__
from bstcad.runs import signals

with signals.ending_at_once():  # from the first libraries on, a quarter of a second
    import typer
    import typer.core
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from bstcad.runs import files, processes, progress
    from bstcad.runs.files import SceneError, note, sentence_of
    from bstcad.step_text import beginning

if TYPE_CHECKING:
    from bstcad.report.record import Contents, Examined
    from bstcad.scene.scene import Scene
    from bstcad.sweep.batch import Wanted

STARTED = time.perf_counter()  # heavy libraries load after it: their time is the command's
INTERRUPTED, BROKEN = 130, 70  # exit codes: Ctrl-C; a fault of bstcad itself
NOTHING_KEPT = "there was no lens yet, and nothing is kept"
NOTHING_MORE = "nothing more is written"  # said by commands other than generate
OFTEN, SELDOM = 1.0, 30.0  # seconds between two lines of progress of a sweep: on a terminal, in a file
EXPORTS = ", ".join(files.EXPORTS)
MEANT = {  # by words that are no commands
    **dict.fromkeys(("design", "make", "run", "build", "create", "optimise", "optimize"), "generate"),
    **dict.fromkeys(("check", "prove", "test", "report", "measure"), "verify"),
    **dict.fromkeys(("view", "draw", "render", "display"), "show"),
}


class Stopped(Exception):
    """Ctrl-C; its text goes on after "stopped"."""


class _Commands(typer.core.TyperGroup):
    """The commands, with a hint for a user who writes another word, or a file alone."""

    def invoke(self, context: Any) -> Any:
        """Run the command; of Ctrl-C typer would keep the exit code alone."""
        try:
            return super().invoke(context)
        except KeyboardInterrupt as error:
            lost = NOTHING_KEPT if context.invoked_subcommand == "generate" else NOTHING_MORE
            raise Stopped(f"; {note(error) or lost}") from error

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


def _version(wanted: bool) -> None:
    if wanted:
        print(f"bstcad {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _bstcad(context: typer.Context, version: Version = False) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())


# --- input and output -------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """Libraries load in the block: signals end this process at once, and nothing looks for garbage.

    What is loaded is a million objects that stay.  To walk over them while they come would take half a second, and
    later it is not needed either.
    """
    with signals.ending_at_once():
        gc.disable()
        try:
            yield
        finally:
            gc.freeze()
            gc.enable()


def engine() -> ModuleType:
    """bstcad.commands, which loads all libraries."""
    with loading():
        from bstcad import commands
    return commands


def path_meant(path: str | Path) -> Path:
    """The path with ~ replaced, which no shell saw in -o=~/x; SceneError for a name that libraries cannot take."""
    path = Path(os.path.expanduser(path))
    try:
        str(Path(os.getcwd(), path)).encode()  # also of an absolute path: libraries fail without a working folder
    except UnicodeEncodeError:
        raise SceneError(f"{str(path)!r}: its name is no UTF-8 text; give a path whose name is") from None
    return path


def design_folder(path: str | Path) -> Path:
    """The folder of a design, or a file."""
    path = path_meant(path)
    if not path.exists():
        raise SceneError(f"{path}: no such folder; give a design's folder, such as outputs/thu")
    return path


def load_scene(path: Path, settings: list[str] | None, quality: str | None = None) -> Scene:
    """The scene with the command line's changes."""
    from bstcad.scene.scene import load

    return load(path, overrides(settings, quality))


def overrides(settings: list[str] | None, quality: str | None) -> dict[str, Any]:
    """The command line's changes of a scene, by key."""
    found: dict[str, Any] = {}
    for setting in settings or []:
        key, equals, value = setting.partition("=")
        if not equals:
            raise SceneError(f"--set {setting}: has no value; write --set KEY=VALUE, such as --set target.pixels=128")
        found[key.strip()] = value.strip()
    return found if quality is None else found | {"tailoring.quality": quality}


def warn(scene: Scene, where: str = "") -> None:
    """Print the warnings of a scene on stderr; where: before each, where there are several scenes."""
    for warning in scene.warnings():
        note_on_stderr(f"warning: {where}{warning}")


def note_on_stderr(line: str) -> None:
    """Print a line on stderr: which net is chosen, how large a file will be, what a batch will do."""
    print(f"bstcad: {line}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def slow_progress() -> Iterator[progress.Report]:
    """The progress of a sweep: a text that stays comes again after OFTEN seconds, or SELDOM into a file."""
    terminal = Console(stderr=True)
    with progress.watch(terminal) as watched:
        yield progress.Throttled(watched, OFTEN if terminal.is_terminal else SELDOM)


def words(names: str | None) -> list[str]:
    """Names with commas between."""
    return [] if names is None else [name.strip() for name in names.split(",")]


def conclude(report: Contents | Examined, path: Path, verbose: bool) -> int:
    """Print the verdict and the path of the files; the exit code."""
    from bstcad.report.report import summary

    say(summary(report, verbose), path)
    return 0 if report.passed else 1


def say(summary: Any, where: object) -> None:
    """Print a summary and where the files are.  Without a terminal, each paragraph is one line."""
    console = Console()
    console.print(summary, soft_wrap=not console.is_terminal)
    console.print(f"Files: {where}", markup=False, highlight=False, soft_wrap=True)


# --- arguments and options --------------------------------------------------------------------------------------------


def argument(kind: Any, metavar: str, words: str, **more: Any) -> Any:
    """The type of an argument, with its help."""
    return Annotated[kind, typer.Argument(metavar=metavar, help=words, **more)]


def option(kind: Any, metavar: str | None, words: str, *names: str, **more: Any) -> Any:
    """The type of an option, with its help."""
    return Annotated[kind, typer.Option(*names, metavar=metavar, help=words, **more)]


def place(metavar: str, words: str, *names: str) -> Any:
    """The type of an option that is a path."""
    return option(Path | None, metavar, words, *names, parser=path_meant)


Version = option(bool, None, "Print the version and leave.", "--version", callback=_version, is_eager=True)
SceneFile = argument(Path, "SCENE", "The scene file (TOML); see templates/.", parser=path_meant)
Folder = argument(Path, "DIR", "A design's folder.", parser=design_folder)
Output = place("DIR", "Of the files (default: one in outputs/).", "--output", "-o")
Settings = option(list[str] | None, "KEY=VALUE", "Replace one value of the scene: --set target.pixels=128.", "--set")
Quality = option(str | None, "Q", "draft, standard, fine or paper: more time, less error.")
Verbose = option(bool, None, "List every check with its value and limit.", "--verbose")
Workers = option(int | None, "N", "Spread the work over so many processes here.")
Scheduler = option(str | None, "URL", "Spread the work over the workers of this dask scheduler.")
Device = option(str, "D", "auto, cpu, or cuda.")
Resume = option(bool, None, "Go on with the design that was stopped or killed in this folder.", "--resume")
AsJson = option(bool, None, "For programs: the same as JSON.", "--json")
Name = argument(str | None, "NAME", "Of the scene; NAME.toml is written.")
Picture = option(Path | None, "FILE", "The picture that a plate is to throw on a wall.")
Light = option(str | None, "L", "That the plate is for: sun, laser, lamp or led (laser).")
Size = option(str | None, "MM", "Of the plate: 80, width x height, 80x60, or photo, 120xphoto: as the photo is.")
Distance = option(str | None, "MM", "To the wall (5 times the size; in the sun 2.5 times).")
Template = option(str | None, "T", "Copy this template instead; see --list.")
Listed = option(bool, None, "List the templates.", "--list")
Opened = argument(Path | None, "SCENE|DIR", "A scene file, a design's folder, or a folder of both.", parser=path_meant)
Port = option(int, "N", "On loopback (0: a free one).", min=0, max=65535)
Browser = option(bool, None, "Open the page in the browser.", "--browser/--no-browser")
Written = argument(Path, "DIR|STEP", "A design's folder, or a STEP file by itself.", parser=design_folder)
Measured = place("CLOUD", "Measured points of a made part, to judge it too.")
PartReport = place("DIR", "Write that part's report there alone.", "--output", "-o")
Against = option(str | None, "NAMES", "Have other programs trace it too: batoid, mitsuba, or batoid,mitsuba.")
Grade = option(
    str | None, "G", "moulded, diamond-turned or precise, for all that the scene states no [\\[tolerance]] of."
)
Yield = option(float | None, "P", "Find the loosest tolerances that keep this yield, in percent.", "--yield")
Seed = option(int, "N", "Of the trials.", min=0)
Trial = option(int | None, "N", "Write the lens of this trial as trial-N.step, and nothing else.", min=0)
Kinds = option(str | None, "NAMES", f"{EXPORTS}, or several with commas between.", "--as")
Points = option(int | None, "N", "Points along the wider side of grids (default: control points; of zemax its knots).")
Png = place("FILE", "A picture to write.", "--png", "-o")
ReachPng = place("FILE", "Draw the target, and the part of it that light can reach; a second one into FILE_2.", "--png")
Budget = option(
    float, "S",
    "Seconds that all runs together may take, judging included, on however many machines: a run predicted not to fit "
    "is not begun, one that takes longer is ended a tenth beyond; the first one is run to its end.",
)  # fmt: skip
Scenes = argument(list[str], "SCENES...", "Scene files (TOML), or patterns such as 'scenes/*.toml'.")
Topic = argument(
    str | None, "TOPIC", "A page, or a check or a remark as reports name them: check-rrmsd (default: the first page)."
)
KeyName = argument(str | None, "KEY", "A key or a table, such as lens.tool_radius (default: all).")


def examples(*lines: str) -> str:
    """The end of a command's help: command lines to copy."""
    return "\n\n".join(("Examples:", *(f"  bstcad {line}" for line in lines)))


# --- designing --------------------------------------------------------------------------------------------------------


@app.command(epilog=examples("generate templates/thu.toml", "generate my-lens.toml --quality draft -o outputs/rough"))
def generate(
    scene: SceneFile, output: Output = None, settings: Settings = None, quality: Quality = None,
    device: Device = "auto", resume: Resume = False, verbose: Verbose = False,
) -> int:  # fmt: skip
    """Design a lens for a scene, write it, and verify the written files."""
    with loading():
        processes.begin()  # it loads its libraries while this process loads others
        wanted = load_scene(scene, settings, quality)
    folder = output or path_meant(Path("outputs") / wanted.name)
    files.check_free(folder)
    commands = engine()
    warn(wanted)
    wanted = commands.settled(wanted, note_on_stderr)
    if commands.folders.step_size(wanted) >= commands.folders.LARGE:
        note_on_stderr(commands.folders.said_of_sizes(wanted))
    with progress.watch(Console(stderr=True)) as watched:
        report = commands.generate(wanted, folder, device=device, progress=watched, began=STARTED, resume=resume)
    print(*report.notes, sep="\n", end="\n" if report.notes else "")
    if report.stopped != "interrupt":
        return conclude(report.contents, folder, verbose)
    conclude(report.contents, commands.place_for(folder, "interrupt"), verbose)
    if not files.beside(folder, "checkpoint").exists():
        raise Stopped(" with the best so far; without a checkpoint there is nothing to go on from")
    raise Stopped(" with the best so far; the same command with --resume goes on from there")


@app.command(epilog=examples("plan templates/thu.toml", "plan my-lens.toml --png reach.png"))
def plan(scene: SceneFile, settings: Settings = None, as_json: AsJson = False, png: ReachPng = None) -> int:
    """Say what light cannot reach, and which effects are left out; then predict time, error and memory."""
    with loading():
        wanted = load_scene(scene, settings)
        from bstcad import folder as folders
        from bstcad.report import report as reports
        from bstcad.scene.target import numbered
        from bstcad.sweep.net_choice import with_net
        from bstcad.sweep.plan import plan as planned
        from bstcad.sweep.plan import reach_drawn

    warn(wanted)
    wanted, choice = with_net(wanted)
    if choice is not None:
        note_on_stderr(choice.line)
    given = wanted, scene.read_text(encoding="utf-8-sig"), [setting.partition("=")[0] for setting in settings or []]
    drawn = () if png is None else reach_drawn(wanted)
    parts = planned(*given)
    effects = next(parts)
    for k, picture in enumerate(drawn):
        files.put(png.with_stem(numbered(png.stem, k)), picture)
    if as_json:
        net = {"control_points": choice.facts()} if choice else {}
        sizes = {"files": {"lens.step": round(folders.step_size(wanted))}}
        likely = next(parts)
        print(json.dumps({"verdict": None} | effects | likely | net | sizes, ensure_ascii=False, indent=2))
        return 0
    console = Console()
    console.print(reports.plan_effects(effects, wanted.title or wanted.name, wanted.optic))
    print("predicting seconds, RRMSD and memory …", file=sys.stderr, flush=True)
    console.print(reports.plan_predictions(next(parts)))
    console.print(f"Files: {folders.said_of_sizes(wanted)}.")
    return 0


@app.command(epilog=examples("new my-lens --picture photo.jpg --size 80 --distance 400", "new lamp --template led"))
def new(
    name: Name = None, picture: Picture = None, light: Light = None, size: Size = None, distance: Distance = None,
    template: Template = None, listed: Listed = False,
) -> int:  # fmt: skip
    """Write a commented scene to start from."""
    path_meant(Path())
    with loading():
        from bstcad.scene import new_scene

    if listed:
        known = new_scene.templates()
        print("\n".join(f"{key:{max(map(len, known))}}  {title}" for key, title in known.items()))
        return 0
    if name is None:
        raise SceneError("missing argument 'NAME'; give a name for the scene, or --list")
    written = new_scene.new_scene(
        name, Path(), picture=picture, light=light, size=size, distance=distance, template=template
    )
    if written.sentences:
        print(written.sentences)
    print(f"{written.path} is written; next: bstcad generate {written.path}")
    return 0


@app.command(name="app", epilog=examples("app", "app my-lens.toml", "app outputs/thu --no-browser"))
def workbench(given: Opened = None, port: Port = 0, browser: Browser = True) -> int:
    """Open the workbench: a page on this machine where the picture on the wall follows each change of a scene."""
    try:
        with loading():
            from bstcad.app import server
    except ImportError as error:
        raise SceneError(f"{error.name} is not installed; pip install 'bstcad[app]' brings it") from None
    import webbrowser

    seen = sys.stdout.isatty() and browser
    server.serve(given, port, say=lambda sentence: print(sentence, flush=True), show=webbrowser.open if seen else len)
    return 0


# --- a finished design ------------------------------------------------------------------------------------------------


@app.command(
    epilog=examples(
        "verify outputs/thu --against batoid,mitsuba", "verify outputs/thu --measured cloud.csv -o serial-17"
    )
)
def verify(
    path: Written, measured: Measured = None, output: PartReport = None, against: Against = None,
    verbose: Verbose = False,
) -> int:  # fmt: skip
    """Verify a lens from its written files."""
    beginning.check(path)
    processes.begin()
    commands = engine()
    with progress.watch(Console(stderr=True)) as watched:
        found = commands.verify(path, against=words(against), measured=measured, progress=watched, place=output)
    return conclude(getattr(found, "contents", found), output or path, verbose)


@app.command(epilog=examples("tolerance outputs/thu --yield 90", "tolerance outputs/thu --grade precise --trial 17"))
def tolerance(
    folder: Folder, grade: Grade = None, wanted: Yield = None, seed: Seed = 0, trial: Trial = None,
    workers: Workers = None, scheduler: Scheduler = None,
) -> int:  # fmt: skip
    """Say how exactly a lens must be made, mounted and lit: sensitivities, trials, yield."""
    if wanted is not None and not 0 < wanted < 100:
        raise SceneError(f"--yield {wanted:g}: give the percent of lenses that are to pass, such as 90")
    commands = engine()
    from bstcad.report.tolerances import summary
    from bstcad.tolerance import tolerancing

    if trial is not None:
        path = folder / f"trial-{trial}.step"
        for kind, amount in tolerancing.write_trial(folder, trial, path, grade=grade, seed=seed):
            print(f"{kind.name:20} {amount:.6g} {kind.unit}".rstrip())
        print(f"Files: {path}")
        return 0
    with progress.watch(Console(stderr=True)) as watched:
        study = commands.tolerance(
            folder, grade=grade, wanted=None if wanted is None else wanted / 100, seed=seed, workers=workers,
            scheduler=scheduler, progress=watched,
        )  # fmt: skip
    say(summary(study), folder / "tolerance.json")
    return 0


@app.command(epilog=examples("export outputs/thu --as zemax,dxf", "export outputs/thu --as points --points 1001"))
def export(folder: Folder, kinds: Kinds = None, points: Points = None) -> int:
    """Write a lens for the shop: tables, Zemax's grid sag, a cloud for turning, the outline, previews, the sheet."""
    if kinds is None:
        raise SceneError(f"--as is missing; give what to write: {EXPORTS}")
    written = engine().export(folder, words(kinds), points)
    print(*written.notes, "Files: " + ", ".join(map(str, written.paths)), sep="\n")
    return 0


@app.command(epilog=examples("show outputs/thu", "show outputs/thu --png light.png"))
def show(folder: Folder, png: Png = None) -> int:
    """Show a lens at work: rays coloured by their flux, and the screen with its picture."""
    if png is not None and (png.suffix.lower() != ".png" or png.is_dir()):
        raise SceneError(f"--png {png}: is no name of a PNG; give one such as light.png")
    if png is not None and not png.absolute().parent.is_dir():
        raise SceneError(f"--png {png}: there is no folder {png.parent}; make it first")
    commands = engine()
    with contextlib.suppress(*([KeyboardInterrupt] if png is None else [])):  # one way to close a window
        commands.show(folder, png)
    if png is not None:
        print(f"Files: {png}")
    return 0


# --- many designs -----------------------------------------------------------------------------------------------------


@app.command(
    epilog=examples(
        "tradeoff templates/thu.toml --budget 600", "tradeoff templates/thu.toml --quality draft --budget 120"
    )
)
def tradeoff(
    scene: SceneFile, budget: Budget = 600.0, output: Output = None, settings: Settings = None, quality: Quality = None,
    scheduler: Scheduler = None,
) -> int:  # fmt: skip
    """Show the price of accuracy in time: run a scene with one knob turned at a time; goes on where it was stopped."""
    if not 0 < budget < 1e7:
        raise SceneError(f"--budget {budget:g}: is not possible; give the seconds that the runs may take, such as 600")
    with loading():
        wanted = load_scene(scene, settings, quality)
        from bstcad.runs import cluster
        from bstcad.sweep import results
        from bstcad.sweep import tradeoff as sweeping

    warn(wanted)
    folder = output or path_meant(Path("outputs") / f"{wanted.name}-tradeoff")
    with cluster.asked_for(scheduler) as machines, slow_progress() as watched:
        table = sweeping.tradeoff(wanted, folder, budget=budget, progress=watched, machines=machines)
    say(results.summary(table), folder)
    return 0 if table.lenses else 1


@app.command(epilog=examples("batch 'scenes/*.toml' -o many", "batch a.toml b.toml --quality draft --workers 2"))
def batch(
    scenes: Scenes, output: Output = None, settings: Settings = None, quality: Quality = None, workers: Workers = None,
    scheduler: Scheduler = None, verbose: Verbose = False,
) -> int:  # fmt: skip
    """Design many lenses, each into its own folder; those that are finished already are left as they are."""
    paths, folder = scene_paths(scenes), output or path_meant(Path("outputs"))
    if folder.exists() and not folder.is_dir():
        raise SceneError(f"{folder}: is a file; give another folder with -o")
    with loading():
        from bstcad.runs import cluster
        from bstcad.sweep import batch as batches

        cluster.check(scheduler, workers)
        changes = overrides(settings, quality)
        wanted = [_wanted(path, changes) for path in paths]
    with cluster.asked_for(scheduler) as found, slow_progress() as watched:
        rows = batches.batch(wanted, folder, workers=workers, cluster=found, progress=watched, say=note_on_stderr)
    reports = f"the report of each design: {folder}/NAME/report.html"
    say(batches.summary(rows, folder, verbose), f"{folder / 'batch.csv'}, batch.json; {reports}")
    return batches.exit_code(rows)


def scene_paths(patterns: list[str]) -> list[Path]:
    """The scene files that are meant, each once."""
    found: dict[Path, Path] = {}
    for pattern in patterns:
        path = path_meant(Path(pattern))
        paths = [path] if path.exists() else [Path(name) for name in sorted(glob.glob(str(path), recursive=True))]
        if not paths and glob.has_magic(pattern):
            raise SceneError(f"{pattern}: no file is named so; give scene files, such as templates/*.toml")
        for each in paths or [path]:
            found.setdefault(each.resolve(), each)
    return list(found.values())


def _wanted(path: Path, changes: dict[str, Any]) -> Wanted:
    """The scene of a file, or the sentence on its fault."""
    from bstcad.scene.scene import load
    from bstcad.sweep.batch import Wanted

    try:
        scene = load(path, changes)
    except (SceneError, OSError) as error:
        return Wanted(str(path), None, sentence_of(error))
    warn(scene, f"{path}: ")
    return Wanted(str(path), scene)


# --- keys of a scene --------------------------------------------------------------------------------------------------


@app.command(epilog=examples("keys lens.tool_radius", "keys source"))
def keys(key: KeyName = None) -> int:
    """Print keys of a scene with unit, range, default and meaning."""
    from bstcad.scene.errors import nearest
    from bstcad.scene.schema import rows

    asked = re.sub(r"\[\d*\]", "", key or "")
    known = [(row.key.replace("[]", ""), row) for row in rows()]
    chosen = [row for name, row in known if not asked or f"{name}.".startswith(f"{asked}.")]
    if not chosen:
        names, parent = {name for name, _ in known}, asked
        while parent and parent not in names:
            parent = parent.rpartition(".")[0]
        beside = sorted(name for name in names if name.rpartition(".")[0] == parent)
        raise SceneError(f"{key}: unknown key; {nearest(asked, beside, 'the keys here are')}")
    console, table = Console(), Table(*("key", "unit", "range", "default", "meaning"), box=None, pad_edge=False)
    for row in chosen:
        meaning = f"{', '.join(row.kinds)}: {row.meaning}".removeprefix(": ")
        cells = row.key, row.unit, row.range, row.default, meaning
        table.add_row(*map(Text, cells))
        if not console.is_terminal:
            print("\t".join(cells))
    if console.is_terminal:
        console.print(table)
    return 0


@app.command(epilog=examples("schema > scene.schema.json", "schema | less"))
def schema() -> int:
    """Print the JSON schema of a scene, by which editors complete and check its keys.

    Save it beside a scene and let that begin with the line: #:schema scene.schema.json
    """
    from bstcad.scene.schema import FILE

    print(FILE.read_text(encoding="utf-8"), end="")
    return 0


# --- documentation ----------------------------------------------------------------------------------------------------


@app.command(epilog=examples("docs tutorials/first-lens", "docs check-rrmsd"))
def docs(topic: Topic = None) -> int:
    """Open the documentation, complete without a network; of a check or a remark print its section."""
    from bstcad.report import manual

    topics = {name.partition("#")[2]: name for name in manual.sections()}
    page = topics.get(topic) or (manual.FIRST if topic is None else manual.name_of(topic))
    if page is None:
        from bstcad.scene.errors import nearest

        known = nearest(topic, [*topics, *manual.pages()], "known are")
        raise SceneError(f"{topic}: no page, check or remark is named so; {known}")
    site = manual.site()
    if topic in topics:
        print(manual.section(page))
        page = f"reference/{page}"
    elif site is None:
        print("bstcad: the pages are not built here (make docs builds them); this is their text", file=sys.stderr)
        manual.show(manual.first() if topic is None else manual.page(page))
    if site is not None:
        name, mark, label = page.partition("#")
        print(f"Documentation: {site / name}.html{mark}{label}")
        if sys.stdout.isatty() and not label:
            import webbrowser

            webbrowser.open((site / f"{name}.html").as_uri())
    return 0


# --- the program ------------------------------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit code."""
    processes.keep_freed()
    code = run(arguments)
    processes.end()
    gc.freeze()  # the system takes the memory back; a last walk over millions of objects would take a second
    if code < 128:
        sys.exit(code)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # a terminal that is gone
            stream.flush()
    os._exit(code)  # a signal: threads may still compute, for which Python would wait


def run(arguments: Sequence[str] | None = None) -> int:
    """The exit code of the command; a fault of the input is one sentence on stderr."""
    try:
        with signals.endings():
            code = app(args=arguments, prog_name="bstcad", standalone_mode=False) or 0
    except Stopped as stopped:
        return _say(f"stopped{stopped}", INTERRUPTED)
    except KeyboardInterrupt:
        code = INTERRUPTED
    except (signals.Ended, Exception) as error:
        if ended := signals.ended():  # whatever it became on the way out; a terminal that is gone has no traceback
            return _say(f"ended by {ended.name}; {note(error) or 'nothing is kept'}", 128 + ended.number)
        sentence, code = sentence_of(error), 2
        if sentence is None:
            traceback.print_exc()
            sentence, code = "the fault above is bstcad's, not yours; please report it with the scene file", BROKEN
        return _say("; ".join(filter(None, (sentence, note(error)))), code)
    return _say(f"stopped; {NOTHING_MORE}", code) if code == INTERRUPTED else code


def _say(sentence: str, code: int) -> int:
    with contextlib.suppress(OSError):  # a terminal that is gone
        print(f"bstcad: {sentence}", file=sys.stderr)
    return code


if __name__ == "__main__":
    processes.end_with_parent()
    main()
