"""Arguments and options of the commands: their types, names in the help, and words."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from bstcad import __version__
from bstcad.runs import files
from bstcad.runs.files import SceneError

EXPORT_NAMES = ", ".join(files.EXPORTS)


def print_version(wanted: bool) -> None:
    """Print the version and exit, if it is wanted."""
    if wanted:
        print(f"bstcad {__version__}")
        raise typer.Exit


def user_path(path: str | Path) -> Path:
    """Return a path with ~ expanded, since the shell does not expand -o=~/x.  SceneError for a name not in UTF-8."""
    path = Path(os.path.expanduser(path))
    try:
        str(Path(os.getcwd(), path)).encode()  # libraries need a working folder even for absolute paths
    except UnicodeEncodeError:
        raise SceneError(f"{str(path)!r}: its name is not UTF-8 text; rename it") from None
    return path


def design_folder(path: str | Path) -> Path:
    """Return the path of an existing folder or file, with ~ expanded; SceneError if there is none."""
    path = user_path(path)
    if not path.exists():
        raise SceneError(f"{path}: no such folder or file; give a design's folder, such as outputs/thu")
    return path


def argument(kind: Any, metavar: str, words: str, **more: Any) -> Any:
    """Return the type of an argument of type `kind`, with the help `words`."""
    return Annotated[kind, typer.Argument(metavar=metavar, help=words, **more)]


def option(kind: Any, metavar: str | None, words: str, *names: str, **more: Any) -> Any:
    """Return the type of an option of type `kind`, with the help `words`."""
    return Annotated[kind, typer.Option(*names, metavar=metavar, help=words, **more)]


def path_option(metavar: str, words: str, *names: str) -> Any:
    """Return the type of an option that is a path, with the help `words`."""
    return option(Path | None, metavar, words, *names, parser=user_path)


Version = option(bool, None, "Print the version and exit.", "--version", callback=print_version, is_eager=True)
SceneFile = argument(Path, "SCENE", "Scene file (TOML); see templates/.", parser=user_path)
Folder = argument(Path, "DIR", "Folder of a design.", parser=design_folder)
Output = path_option("DIR", "Folder for the files (default: a folder in outputs/).", "--output", "-o")
Settings = option(list[str] | None, "KEY=VALUE", "Replace one value of the scene: --set target.pixels=128.", "--set")
Quality = option(str | None, "Q", "Effort: draft, standard or fine (fast to accurate), or paper (Wang et al. 2023).")
Verbose = option(bool, None, "List every check with its value and limit.", "--verbose")
Workers = option(int | None, "N", "Distribute the work over N processes on this machine.")
Scheduler = option(str | None, "URL", "Distribute the work over the workers of the dask scheduler at this address.")
Device = option(str, "D", "Device for the design: auto, cpu or cuda.")
Resume = option(bool, None, "Continue the stopped or killed design from the checkpoint beside DIR.", "--resume")
AsJson = option(bool, None, "Print the result as JSON, for programs.", "--json")
Name = argument(str | None, "NAME", "Name of the scene; NAME.toml is written.")
Picture = option(Path | None, "FILE", "Picture that the plate projects on a wall.")
LightOption = option(str | None, "L", "Light source of the plate: sun, laser, lamp or led (default: laser).")
Size = option(
    str | None, "MM", "Size of the plate: 80 (default), 80x60 (width x height) or 120xphoto (proportions of the photo)."
)
Distance = option(
    str | None, "MM", "Distance from plate to wall (default: 5 times the plate's longer side, for the sun 2.5 times)."
)
Template = option(str | None, "T", "Copy this template instead; see --list.")
Listed = option(bool, None, "List the templates.", "--list")
Opened = argument(Path | None, "SCENE|DIR", "Scene, design, or folder of scenes and designs.", parser=user_path)
Port = option(int, "N", "Port on this machine (0: any free port).", min=0, max=65535)
Browser = option(bool, None, "Open the page in the browser.", "--browser/--no-browser")
Written = argument(Path, "DIR|STEP", "Folder of a design, or a single STEP file.", parser=design_folder)
Measured = path_option("CLOUD", "Measured points (CSV, PLY, STL) of a made part, which is also verified.")
Clouds = option(
    list[Path], "CLOUD", "Measured points (CSV, PLY, STL) of a part that was cut last; several are averaged.",
    "--measured", parser=user_path,
)  # fmt: skip
AsBuiltBlank = option(
    list[str], "KEY=VALUE", "The blank as built: front=FILE or curvature, thickness=MM, index=N.", "--as-built",
)  # fmt: skip
Gain = option(float | None, "G", "Part of the measured deviation that is corrected (default: 1/n in round n).")
By = option(str, "form|light", "Correct the whole deviation (form), or only what changes the picture (light).")
Cutoff = option(float | None, "MM", "Cutoff of the low pass of the correction (default: the one that the light needs).")
Report = path_option("DIR", "Write the report of the made part to this folder only.", "--output", "-o")
Against = option(str | None, "NAMES", "Also trace the lens with other programs: batoid, mitsuba, or batoid,mitsuba.")
Grade = option(
    str | None,
    "G",
    "Grade of errors without a [\\[tolerance]]: moulded, diamond-turned, precise, milled-polished, milled-sanded, "
    "resin-printed or resin-printed-coated.",
)
Yield = option(float | None, "P", "Find the loosest tolerances with this yield (percentage that passes).", "--yield")
Seed = option(int, "N", "Seed of the random trials.", min=0)
Trial = option(int | None, "N", "Write only the lens of this trial, as trial-N.step.", min=0)
Kinds = option(str | None, "NAMES", f"Kinds of files, separated by commas: {EXPORT_NAMES}.", "--as")
Points = option(
    int | None, "N", "Points along the longer side (default: number of control points; zemax: through all knots)."
)
ToolRadius = option(
    float | None, "MM", "Radius of the tool of a path (default: lens.tool_radius, or spiral 0.5, raster 1.5)."
)
Cusp = option(float | None, "MM", "Height of the cusps between passes (default: spiral 0.00005, raster 0.01).")
Pitch = option(float | None, "MM", "Spacing of the passes, in place of the cusp height.")
PathTolerance = option(
    float | None, "MM", "Distance of straight moves from the exact path (default: spiral 0.000005, raster 0.0005)."
)
Stock = option(float | None, "MM", "Stock that the roughing of a raster leaves (default: 0.2; 0: no roughing).")
Depth = option(float | None, "MM", "Depth of cut of roughing (default: 1).")
Feed = option(float | None, "MM/MIN", "Feed of a raster (default: 800).")
Along = option(str | None, "AXIS", "Axis along which the lines of a raster run: x (default) or y.")
Zero = option(str | None, "SIDE", "Side of the blank on which Z of a raster is 0: top (default) or bottom.")
Units = option(str | None, "UNIT", "Unit of length of the G-code: mm (default) or inch.")
Rapid = option(
    str | None, "G0|G1", "Command of rapid moves in the G-code: G0 (default), or G1 for machines without it."
)
ExportFolder = path_option("DIR", "Folder for the files (default: that of the design).", "--output", "-o")
Tiles = option(str | None, "NxM", "Number of tiles along x and along y (default: 2x2).")
Png = path_option("FILE", "PNG file to write (default: a window is opened).", "--png", "-o")
ReachPng = path_option("FILE", "PNG of the target and of the area that light can reach (target[1]: FILE_2).", "--png")
MadeGrade = option(
    str | None, "G", "Predict the picture of the part as made: a grade of --grade of bstcad tolerance.", "--made"
)
Layer = option(float | None, "MM", "Height of the layers of a print (default: that of the grade).", min=1e-4, max=1.0)
MadePng = path_option(
    "FILE", "PNG of the target and of its light as designed and as made (target[1]: FILE_2).", "--made-png"
)
LitByLight = option(
    str | None, "LIGHT", "Predict the picture of the lens in another light: sun, lamp, led or phone.", "--lit-by"
)
LitAt = option(
    float | None, "MM", "Distance of this light from the lens (default: that of the light).", min=1e-3, max=1e9
)
LitPng = path_option("FILE", "PNG of the target and of its light as designed and in this light.", "--lit-png")
Budget = option(
    float,
    "S",
    "Seconds for all runs together, on all machines, including verification. A run that is predicted to exceed this "
    "budget is not started; a run that exceeds it by a tenth is ended. The first run is never ended.",
)
Scenes = argument(list[str], "SCENES...", "Scene files (TOML), or patterns such as 'scenes/*.toml'.")
Topic = argument(
    str | None, "TOPIC", "Page, check or remark, as reports name it, such as check-rrmsd (default: the first page)."
)
KeyName = argument(str | None, "KEY", "Key or table, such as lens.tool_radius (default: all keys).")


def examples(*lines: str) -> str:
    """Return the end of a command's help: examples to copy."""
    return "\n\n".join(("Examples:", *(f"  bstcad {line}" for line in lines)))
