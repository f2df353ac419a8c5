"""The command line: options and output of the commands, whose work other modules of bstcad do.

Exit codes: 0 passed, 1 failed check or no lens, 2 wrong input or machine error, 70 bug, 130 Ctrl-C, 128 + n signal n.
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
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from bstcad.runs import signals

with signals.exit_on_signal():  # loading these libraries takes a quarter of a second
    import typer
    import typer.core
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from bstcad.cli_options import (
        EXPORT_NAMES,
        Against,
        Along,
        AsBuiltBlank,
        AsJson,
        Browser,
        Budget,
        By,
        Clouds,
        Cusp,
        Cutoff,
        Depth,
        Device,
        Distance,
        ExportFolder,
        Feed,
        Folder,
        Gain,
        Grade,
        KeyName,
        Kinds,
        Layer,
        LightOption,
        Listed,
        LitAt,
        LitByLight,
        LitPng,
        MadeGrade,
        MadePng,
        Measured,
        Name,
        Opened,
        Output,
        PathTolerance,
        Picture,
        Pitch,
        Png,
        Points,
        Port,
        Quality,
        Rapid,
        ReachPng,
        Report,
        Resume,
        SceneFile,
        Scenes,
        Scheduler,
        Seed,
        Settings,
        Size,
        Stock,
        Template,
        Tiles,
        ToolRadius,
        Topic,
        Trial,
        Units,
        Verbose,
        Version,
        Workers,
        Written,
        Yield,
        Zero,
        examples,
        user_path,
    )
    from bstcad.runs import files, processes, progress
    from bstcad.runs.files import SceneError, note, sentence_of
    from bstcad.step_text import beginning

if TYPE_CHECKING:
    from bstcad.planning.batch import BatchScene
    from bstcad.planning.net_choice import Choice
    from bstcad.report.record import Contents, Examined
    from bstcad.scene.scene import Scene

START_TIME = time.perf_counter()  # start of the times in reports, which include the loading of the large libraries
INTERRUPTED, INTERNAL_ERROR = 130, 70  # exit codes after Ctrl-C and after a fault of bstcad
NOTHING_KEPT = "there was no lens yet, and nothing is kept"  # message of generate after Ctrl-C
NOTHING_MORE = "nothing more is written"  # message of the other commands after Ctrl-C
TERMINAL_INTERVAL, FILE_INTERVAL = 1.0, 30.0  # pause (s) before a sweep repeats a text: on a terminal, in a file
COMMAND_SYNONYMS = {  # wrong word -> command to suggest
    **dict.fromkeys(("design", "make", "run", "build", "create", "optimise", "optimize"), "generate"),
    **dict.fromkeys(("check", "prove", "test", "report", "measure"), "verify"),
    **dict.fromkeys(("view", "draw", "render", "display"), "show"),
}


class Interrupted(Exception):
    """Interruption of a command by Ctrl-C; its text is printed after the word "stopped"."""


class _Commands(typer.core.TyperGroup):
    """Group of the commands, with a hint if the user types another word or only a file."""

    def invoke(self, context: Any) -> Any:
        """Run the command; raise Interrupted for Ctrl-C, for which typer would only set the exit code."""
        try:
            return super().invoke(context)
        except KeyboardInterrupt as error:
            lost = NOTHING_KEPT if context.invoked_subcommand == "generate" else NOTHING_MORE
            raise Interrupted(f"; {note(error) or lost}") from error

    def resolve_command(self, context: Any, arguments: list[str]) -> Any:
        """Return the command that the first argument names, or fail with a suggestion."""
        word = arguments[0]
        if word not in self.commands:
            kind = {".toml": "generate", ".step": "verify", ".stp": "verify"}.get(Path(word).suffix.lower())
            if kind or word in COMMAND_SYNONYMS:
                meant = f"{kind} {word}" if kind else COMMAND_SYNONYMS[word]
                context.fail(f"No such command {word!r}. Did you mean {meant!r}?")
        return super().resolve_command(context, arguments)


app = typer.Typer(
    name="bstcad",
    cls=_Commands,
    help="Design a machinable freeform lens that projects a picture, and write it as an exact B-spline STEP solid.",
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.callback(invoke_without_command=True)
def _bstcad(context: typer.Context, version: Version = False) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())


# --- input and output -------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """Load libraries in the block: signals end this process at once, and the garbage collector is off.

    The libraries create a million permanent objects.  Garbage collections during the load would take half a second,
    and later collections can skip these objects.
    """
    with signals.exit_on_signal():
        gc.disable()
        try:
            yield
        finally:
            gc.freeze()
            gc.enable()


def load_commands() -> ModuleType:
    """Import bstcad.commands, which loads all libraries."""
    with loading():
        from bstcad import commands
    return commands


def begin_commands() -> ModuleType:
    """Import bstcad.commands, and start the second process."""
    copied = processes.is_new()
    commands = load_commands()
    processes.begin(copied=copied)
    return commands


def load_scene(path: Path, settings: list[str] | None, quality: str | None = None) -> Scene:
    """Load a scene with the changes from --set and --quality."""
    from bstcad.scene.scene import load

    return load(path, overrides(settings, quality))


def overrides(settings: list[str] | None, quality: str | None) -> dict[str, Any]:
    """Return the values that --set and --quality give to a scene, by dotted key."""
    found: dict[str, Any] = {}
    for setting in settings or []:
        key, equals, value = setting.partition("=")
        if not equals:
            raise SceneError(f"--set {setting}: has no value; write --set KEY=VALUE, such as --set target.pixels=128")
        found[key.strip()] = value.strip()
    return found if quality is None else found | {"tailoring.quality": quality}


def warn(scene: Scene, where: str = "") -> None:
    """Print the warnings of a scene on stderr, each after the prefix `where`."""
    for warning in scene.warnings():
        note_on_stderr(f"warning: {where}{warning}")


def with_net(scene: Scene) -> tuple[Scene, Choice | None]:
    """Print the warnings of a scene and the line on a chosen net; return the scene with its net, and the Choice."""
    from bstcad.planning import net_choice

    warn(scene)
    return net_choice.with_net(scene, note_on_stderr)


def note_on_stderr(line: str) -> None:
    """Print a line on stderr, such as the chosen net, the size of a file, or the plan of a batch."""
    print(f"bstcad: {line}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def slow_progress() -> Iterator[progress.ProgressFunction]:
    """Show a sweep's progress: new text at once, repeated text after TERMINAL_INTERVAL or, in a file, FILE_INTERVAL."""
    terminal = Console(stderr=True)
    with progress.watch(terminal) as watched:
        yield progress.Throttled(watched, TERMINAL_INTERVAL if terminal.is_terminal else FILE_INTERVAL)


def split_names(names: str | None) -> list[str]:
    """Split names at commas."""
    return [] if names is None else [name.strip() for name in names.split(",")]


def conclude(report: Contents | Examined, path: Path, verbose: bool) -> int:
    """Print the verdict and the path of the files; return the exit code."""
    from bstcad.report.report import summary

    say(summary(report, verbose), path)
    return 0 if report.passed else 1


def say(summary: Any, where: object) -> None:
    """Print a summary and the path of the files.  Without a terminal, each paragraph is one line."""
    console = Console()
    console.print(summary, soft_wrap=not console.is_terminal)
    console.print(f"Files: {where}", markup=False, highlight=False, soft_wrap=True)


# --- designing --------------------------------------------------------------------------------------------------------


@app.command(epilog=examples("generate templates/thu.toml", "generate my-lens.toml --quality draft -o outputs/rough"))
def generate(
    scene: SceneFile, output: Output = None, settings: Settings = None, quality: Quality = None,
    device: Device = "auto", resume: Resume = False, verbose: Verbose = False,
) -> int:  # fmt: skip
    """Design a lens for a scene, write it, and verify the written files."""
    commands = begin_commands()
    with loading():
        wanted = load_scene(scene, settings, quality)
    folder = output or user_path(Path("outputs") / wanted.name)
    files.check_free(folder)
    wanted, _ = with_net(wanted)
    if commands.folders.step_size(wanted) >= commands.folders.LARGE_STEP:
        note_on_stderr(commands.folders.size_sentence(wanted))
    with progress.watch(Console(stderr=True)) as watched:
        hooks = commands.Hooks(watched)
        report = commands.generate(wanted, folder, hooks=hooks, device=device, began=START_TIME, resume=resume)
    print(*report.notes, sep="\n", end="\n" if report.notes else "")
    if report.stopped != "interrupt":
        return conclude(report.contents, folder, verbose)
    conclude(report.contents, commands.output_folder(folder, "interrupt"), verbose)
    if not files.beside(folder, "checkpoint").exists():
        raise Interrupted(" with the best lens so far; there is no checkpoint to resume from")
    raise Interrupted(" with the best lens so far; run the same command with --resume to continue")


@app.command(epilog=examples("plan templates/thu.toml", "plan my-lens.toml --made resin-printed --made-png made.png"))
def plan(
    scene: SceneFile, settings: Settings = None, as_json: AsJson = False, png: ReachPng = None, made: MadeGrade = None,
    layer: Layer = None, made_png: MadePng = None, lit_by: LitByLight = None, lit_at: LitAt = None,
    lit_png: LitPng = None,
) -> int:  # fmt: skip
    """Predict time, error and memory of a design; list neglected effects and unreachable parts of the target."""
    if made is None and (layer is not None or made_png is not None):
        raise SceneError("--layer and --made-png need --made GRADE; add it, for example --made resin-printed")
    if lit_by is None and (lit_at is not None or lit_png is not None):
        raise SceneError("--lit-at and --lit-png need --lit-by LIGHT; add it, for example --lit-by phone")
    with loading():
        wanted = load_scene(scene, settings)
        if made is not None or lit_by is not None:
            from bstcad import commands  # loads more than a plan needs
        from bstcad.designs import folder as folders
        from bstcad.planning.plan import plan as planned
        from bstcad.planning.plan import reach_drawn
        from bstcad.report import report as reports
        from bstcad.scene.quality import GRADE_NAMES
        from bstcad.scene.target import numbered

    if made is not None and made not in GRADE_NAMES:
        raise SceneError(f"--made {made}: unknown grade; give one of {', '.join(GRADE_NAMES)}")
    wanted, choice = with_net(wanted)
    given = wanted, scene.read_text(encoding="utf-8-sig"), [setting.partition("=")[0] for setting in settings or []]
    drawn = () if png is None else reach_drawn(wanted)
    parts = planned(*given)
    effects = next(parts)
    for k, picture in enumerate(drawn):
        files.put(png.with_stem(numbered(png.stem, k)), picture)
    part = None if made is None else commands.predict_as_made(wanted, made, layer, made_png)
    lit = None if lit_by is None else commands.predict_lit_by(wanted, lit_by, lit_at, lit_png)
    if as_json:
        net = {"control_points": choice.facts()} if choice else {}
        sizes = {"files": {"lens.step": round(folders.step_size(wanted))}}
        other = ({} if part is None else {"made": part.facts()}) | ({} if lit is None else {"lit": lit.facts()})
        found = {"verdict": None} | effects | next(parts) | other | net | sizes
        print(json.dumps(found, ensure_ascii=False, indent=2))
        return 0
    console = Console()
    console.print(reports.plan_effects(effects, wanted.title or wanted.name, wanted.optic))
    print("predicting time, RRMSD and memory …", file=sys.stderr, flush=True)
    console.print(reports.plan_predictions(next(parts)))
    for sentence in () if part is None else reports.made_sentences(part.facts(), wanted.optic):
        console.print(sentence, end="\n\n", markup=False, highlight=False)
    for sentence in () if lit is None else reports.lit_sentences(lit.facts(), wanted.optic):
        console.print(sentence, end="\n\n", markup=False, highlight=False)
    console.print(f"Files: {folders.size_sentence(wanted)}.")
    return 0


@app.command(epilog=examples("new my-lens --picture photo.jpg --size 80 --distance 400", "new lamp --template led"))
def new(
    name: Name = None, picture: Picture = None, light: LightOption = None, size: Size = None, distance: Distance = None,
    template: Template = None, listed: Listed = False,
) -> int:  # fmt: skip
    """Write a new scene file with comments: a plate that projects a picture on a wall, or a copy of a template."""
    user_path(Path())
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
    """Open the workbench: a page on this machine that shows the picture on the wall after each change of a scene."""
    try:
        with loading():
            from bstcad.app import server
    except ImportError as error:
        raise SceneError(f"{error.name} is not installed; run: pip install 'bstcad[app]'") from None
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
    path: Written, measured: Measured = None, output: Report = None, against: Against = None, verbose: Verbose = False
) -> int:
    """Verify a lens from its written files, and write its report again."""
    beginning.check(path)
    commands = begin_commands()
    with progress.watch(Console(stderr=True)) as watched:
        found = commands.verify(path, against=split_names(against), measured=measured, progress=watched, place=output)
    return conclude(getattr(found, "contents", found), output or path, verbose)


@app.command(
    epilog=examples("compensate outputs/thu --measured cloud.csv", "compensate outputs/thu --measured a.csv --gain 0.8")
)
def compensate(
    folder: Folder, measured: Clouds, gain: Gain = None, cutoff: Cutoff = None, by: By = "form"
) -> int:  # fmt: skip
    """Write the back to cut next, from measured points of the parts that were cut last."""
    commands = begin_commands()
    from bstcad.manufacture.measured.compensation import CompensationSettings as CompensationSettings

    with progress.watch(Console(stderr=True)) as watched:
        found = commands.compensate(folder, measured, CompensationSettings(gain, cutoff, by), progress=watched)
    print(found.sentences, f"Files: {found.folder}", sep="\n")
    return 0


@app.command(
    epilog=examples(
        "retailor outputs/thu --as-built thickness=12.05,index=1.4912",
        "retailor outputs/thu --as-built front=front.csv -o outputs/serial-17",
    )
)
def retailor(folder: Folder, blank: AsBuiltBlank, output: Output = None, verbose: Verbose = False) -> int:
    """Tailor the back anew to a blank as it was built."""
    from bstcad.manufacture.shop.as_built import AsBuilt

    built = AsBuilt.parse(",".join(blank))
    commands = begin_commands()
    with progress.watch(Console(stderr=True)) as watched:
        place, report, found = commands.retailor(folder, built, output, hooks=commands.Hooks(watched))
    print(found.sentence(report.contents.rrmsd))
    return conclude(report.contents, place, verbose)


@app.command(epilog=examples("tolerance outputs/thu --yield 90", "tolerance outputs/thu --grade precise --trial 17"))
def tolerance(
    folder: Folder, grade: Grade = None, wanted: Yield = None, seed: Seed = 0, trial: Trial = None,
    workers: Workers = None, scheduler: Scheduler = None,
) -> int:  # fmt: skip
    """Study how accurately a lens must be made, mounted and lit: sensitivities, random trials, yield."""
    if wanted is not None and not 0 < wanted < 100:
        raise SceneError(f"--yield {wanted:g}: is not between 0 and 100; give the percentage of lenses that must pass")
    commands = load_commands()
    from bstcad.manufacture.tolerance import tolerancing
    from bstcad.manufacture.tolerance.study import StudySettings
    from bstcad.manufacture.tolerance.tolerances import summary

    settings = StudySettings(grade, None if wanted is None else wanted / 100, seed)
    if trial is not None:
        path = folder / f"trial-{trial}.step"
        for kind, amount in tolerancing.write_trial(folder, trial, path, settings):
            print(f"{kind.name:20} {amount:.6g} {kind.unit}".rstrip())
        print(f"Files: {path}")
        return 0
    with progress.watch(Console(stderr=True)) as watched:
        study = commands.tolerance(folder, replace(settings, progress=watched), workers, scheduler)
    say(summary(study), folder / "tolerance.json")
    return 0


@app.command(
    epilog=examples(
        "export outputs/thu --as zemax,dxf",
        "export outputs/thu --as points --points 1001",
        "export outputs/thu --as raster --cusp 0.01 --zero bottom -o shop",
        "export outputs/sun_caustic --as raster,tiles --tiles 2x3",
    )
)
def export(
    folder: Folder, kinds: Kinds = None, points: Points = None, tool_radius: ToolRadius = None, cusp: Cusp = None,
    pitch: Pitch = None, tolerance: PathTolerance = None, stock: Stock = None, depth: Depth = None, feed: Feed = None,
    along: Along = None, zero: Zero = None, units: Units = None, rapid: Rapid = None, tiles: Tiles = None,
    output: ExportFolder = None,
) -> int:  # fmt: skip
    """Write files for a workshop: tables, Zemax grid sag, tool paths, tiles, outlines, previews, data sheet."""
    if kinds is None:
        raise SceneError(f"--as: is missing; give one or more kinds of files: {EXPORT_NAMES}")
    settings = {
        "tool_radius": tool_radius, "cusp": cusp, "pitch": pitch, "tolerance": tolerance, "stock": stock,
        "depth": depth, "feed": feed, "along": along, "zero": zero, "units": units, "rapid": rapid,
    }  # fmt: skip
    given = {name: value for name, value in settings.items() if value is not None}
    written = load_commands().export(folder, split_names(kinds), points, given, tiles=tiles, place=output)
    print(*written.notes, "Files: " + ", ".join(map(str, written.paths)), sep="\n")
    return 0


@app.command(epilog=examples("show outputs/thu", "show outputs/thu --png light.png"))
def show(folder: Folder, png: Png = None) -> int:
    """Show a lens with its rays, coloured by their flux, and the target with its picture."""
    if png is not None and (png.suffix.lower() != ".png" or png.is_dir()):
        raise SceneError(f"--png {png}: is not the name of a PNG file; give a name such as light.png")
    if png is not None and not png.absolute().parent.is_dir():
        raise SceneError(f"--png {png}: the folder {png.parent} does not exist; create it first")
    commands = load_commands()
    with contextlib.suppress(*([KeyboardInterrupt] if png is None else [])):  # Ctrl-C may close the window
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
    """Measure accuracy against time by designs of a scene with changed settings; a stopped sweep is continued."""
    if not 0 < budget < 1e7:
        raise SceneError(f"--budget {budget:g}: is not between 0 and 1e7; give the seconds for all runs, such as 600")
    with loading():
        wanted = load_scene(scene, settings, quality)
        from bstcad.planning import results
        from bstcad.planning import tradeoff as sweeping
        from bstcad.runs import cluster

    warn(wanted)
    folder = output or user_path(Path("outputs") / f"{wanted.name}-tradeoff")
    with cluster.connect(scheduler) as machines, slow_progress() as watched:
        table = sweeping.tradeoff(wanted, folder, budget=budget, progress=watched, machines=machines)
    say(results.summary(table), folder)
    return 0 if table.runs_with_lens else 1


@app.command(epilog=examples("batch 'scenes/*.toml' -o many", "batch a.toml b.toml --quality draft --workers 2"))
def batch(
    scenes: Scenes, output: Output = None, settings: Settings = None, quality: Quality = None, workers: Workers = None,
    scheduler: Scheduler = None, verbose: Verbose = False,
) -> int:  # fmt: skip
    """Design many lenses, each in its own folder; finished designs are skipped."""
    paths, folder = scene_paths(scenes), output or user_path(Path("outputs"))
    if folder.exists() and not folder.is_dir():
        raise SceneError(f"{folder}: is a file; give another folder with -o")
    with loading():
        from bstcad.planning import batch as batches
        from bstcad.runs import cluster

        cluster.check(scheduler, workers)
        changes = overrides(settings, quality)
        wanted = [_load_or_refuse(path, changes) for path in paths]
    with cluster.connect(scheduler) as found, slow_progress() as watched:
        rows = batches.batch(wanted, folder, workers=workers, cluster=found, progress=watched, say=note_on_stderr)
    reports = f"the report of each design: {folder}/NAME/report.html"
    say(batches.summary(rows, folder, verbose), f"{folder / 'batch.csv'}, batch.json; {reports}")
    return batches.exit_code(rows)


def scene_paths(patterns: list[str]) -> list[Path]:
    """Return the scene files that the patterns match, without repetitions."""
    found: dict[Path, Path] = {}
    for pattern in patterns:
        path = user_path(Path(pattern))
        paths = [path] if path.exists() else [Path(name) for name in sorted(glob.glob(str(path), recursive=True))]
        if not paths and glob.has_magic(pattern):
            raise SceneError(f"{pattern}: matches no file; give scene files, such as 'templates/*.toml'")
        for each in paths or [path]:
            found.setdefault(each.resolve(), each)
    return list(found.values())


def _load_or_refuse(path: Path, changes: dict[str, Any]) -> BatchScene:
    from bstcad.planning.batch import BatchScene
    from bstcad.scene.scene import load

    try:
        scene = load(path, changes)
    except (SceneError, OSError) as error:
        return BatchScene(str(path), None, sentence_of(error))
    warn(scene, f"{path}: ")
    return BatchScene(str(path), scene)


# --- keys of a scene --------------------------------------------------------------------------------------------------


@app.command(epilog=examples("keys lens.tool_radius", "keys source"))
def keys(key: KeyName = None) -> int:
    """Print the keys of a scene with unit, range, default and meaning."""
    from bstcad.scene.errors import nearest
    from bstcad.scene.schema import rows

    prefix = re.sub(r"\[\d*\]", "", key or "")
    known = [(row.key.replace("[]", ""), row) for row in rows()]
    chosen = [row for name, row in known if not prefix or f"{name}.".startswith(f"{prefix}.")]
    if not chosen:
        names, parent = {name for name, _ in known}, prefix
        while parent and parent not in names:
            parent = parent.rpartition(".")[0]
        beside = sorted(name for name in names if name.rpartition(".")[0] == parent)
        raise SceneError(f"{key}: unknown key; {nearest(prefix, beside, 'the keys here are')}")
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
    """Print the JSON schema of scenes, with which editors complete and check the keys.

    Save the schema beside a scene file, whose first line is then: #:schema scene.schema.json
    """
    from bstcad.scene.schema import schema_text

    print(schema_text(), end="")
    return 0


# --- documentation ----------------------------------------------------------------------------------------------------


@app.command(epilog=examples("docs tutorials/first-lens", "docs check-rrmsd"))
def docs(topic: Topic = None) -> int:
    """Open the documentation, which needs no network; for a check or a remark, print its section."""
    from bstcad.report import manual

    topics = {name.partition("#")[2]: name for name in manual.sections()}
    page = topics.get(topic) or (manual.FIRST if topic is None else manual.name_of(topic))
    if page is None:
        from bstcad.scene.errors import nearest

        known = nearest(topic, [*topics, *sorted(manual.names())], "known are")
        raise SceneError(f"{topic}: no page, check or remark has this name; {known}")
    site = manual.site()
    if topic in topics:
        print(manual.section(page))
        page = f"reference/{page}"
    elif site is None:
        print("bstcad: the HTML pages are not built (make docs builds them); this is their text", file=sys.stderr)
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
    """Run the command line and exit with its exit code."""
    processes.keep_freed()
    code = run(arguments)
    processes.end()
    gc.freeze()  # the system frees the memory; a last collection of millions of objects would take a second
    if code < 128:
        sys.exit(code)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # the terminal may be gone
            stream.flush()
    os._exit(code)  # after a signal, Python would wait for threads that still compute


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code; an error of the input or the machine prints one sentence."""
    try:
        with signals.raise_terminated():
            code = app(args=arguments, prog_name="bstcad", standalone_mode=False) or 0
    except Interrupted as stopped:
        return _say(f"stopped{stopped}", INTERRUPTED)
    except KeyboardInterrupt:
        code = INTERRUPTED
    except (signals.Terminated, Exception) as error:
        if ended := signals.termination():  # another exception may have replaced Terminated
            return _say(f"ended by {ended.name}; {note(error) or 'nothing is kept'}", 128 + ended.number)
        sentence, code = sentence_of(error), 2
        if sentence is None:
            traceback.print_exc()
            sentence, code = "this is a fault of bstcad; please report it with the scene file", INTERNAL_ERROR
        return _say("; ".join(filter(None, (sentence, note(error)))), code)
    return _say(f"stopped; {NOTHING_MORE}", code) if code == INTERRUPTED else code


def _say(sentence: str, code: int) -> int:
    with contextlib.suppress(OSError):  # the terminal may be gone
        print(f"bstcad: {sentence}", file=sys.stderr)
    return code


if __name__ == "__main__":
    processes.end_with_parent()
    main()
