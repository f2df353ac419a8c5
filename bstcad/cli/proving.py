"""Commands for a finished design: verify, tolerance, export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from bstcad.cli.application import InputError, Scheduler, Verbose, Workers, app, cluster, conclude, loading, path_meant
from bstcad.runs import worker

EXPORTS = "sag, points, zemax, turning, dxf, svg, preview, datasheet"  # bstcad.report.exports.ALL, which loads torch


@app.command()
def verify(
    path: Annotated[Path, typer.Argument(metavar="DIR|STEP", help="A design's folder, or a STEP file by itself.")],
    measured: Annotated[
        Path | None,
        typer.Option(metavar="CLOUD", help="Measured points of a made part (CSV, PLY, STL; mm): judge it too."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="DIR", help="Write the made part's report there, and nothing elsewhere."
        ),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(metavar="NAMES", help="Have other programs trace it too: batoid, mitsuba, or batoid,mitsuba."),
    ] = None,
    verbose: Verbose = False,
) -> int:
    """Verify a lens from its written files."""
    path = path_meant(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; give a design's folder, such as outputs/thu")
    if output is not None and measured is None:
        raise InputError(f"-o {output}: is for the report of a made part; give its points with --measured CLOUD")

    with loading():
        worker.begin()
        from bstcad.runs import commands, progress

    with progress.watch(Console(stderr=True)) as watched:
        judges = [] if against is None else [name.strip() for name in against.split(",")]
        place = output and path_meant(output)
        report = commands.verify(
            path, against=judges, measured=measured and path_meant(measured), progress=watched, place=place
        )
    return conclude(report, place or path, verbose)


@app.command()
def tolerance(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A design's folder.")],
    grade: Annotated[
        str | None,
        typer.Option(
            metavar="G", help="moulded, diamond-turned or precise, for all that the scene states no [\\[tolerance]] of."
        ),
    ] = None,
    wanted: Annotated[
        float | None,
        typer.Option("--yield", metavar="P", help="Find the loosest tolerances that keep this yield, in percent."),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Of the trials.")] = 0,
    trial: Annotated[
        int | None, typer.Option(metavar="N", help="Write the lens of this trial as trial-N.step, and nothing else.")
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
) -> int:
    """Say how exactly a lens must be made, mounted and lit: sensitivities, trials, yield."""
    folder = path_meant(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a design's folder, such as outputs/thu")
    if wanted is not None and not 0 < wanted < 100:
        raise InputError(f"--yield {wanted:g}: give the percent of lenses that are to pass, such as 90")
    if seed < 0 or (trial is not None and trial < 0):
        raise InputError("--seed and --trial count from 0; give a number that is not negative")
    with loading():
        from bstcad.report.tolerances import summary
        from bstcad.runs import progress
        from bstcad.tolerance import tolerancing
        from bstcad.tolerance.superposition import here

    if trial is not None:
        path = folder / f"trial-{trial}.step"
        for name, amount in tolerancing.write_trial(folder, trial, path, grade=grade, seed=seed).items():
            print(f"{name:20} {amount:.6g}")
        print(f"Files: {path}")
        return 0
    with cluster(scheduler, workers) as found, progress.watch(Console(stderr=True)) as watched:
        study = tolerancing.tolerance(
            folder, grade=grade, seed=seed, wanted=None if wanted is None else wanted / 100, progress=watched,
            spread=here if found is None else found.spread,
        )  # fmt: skip
    console = Console()
    console.print(summary(study))
    console.print(f"Files: {folder / 'tolerance.json'}", markup=False, highlight=False, soft_wrap=True)
    return 0


@app.command()
def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A design's folder, where the files go too.")],
    kinds: Annotated[
        str | None,
        typer.Option(
            "--as", metavar="NAMES",
            help=f"{EXPORTS}, or several with commas between.",
        ),
    ] = None,
    points: Annotated[
        int | None,
        typer.Option(metavar="N", help="Points along the wider side of grids (default: as many as control points)."),
    ] = None,
) -> int:  # fmt: skip
    """Write a lens for the shop: tables, Zemax's grid sag, a cloud for turning, the outline, previews, the sheet."""
    folder = path_meant(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a design's folder, such as outputs/thu")
    if kinds is None:
        raise InputError(f"--as is missing; give what to write: {EXPORTS}")
    with loading():
        from bstcad.runs import commands

    written = commands.export(folder, [name.strip() for name in kinds.split(",")], points)
    print("Files: " + ", ".join(map(str, written)))
    return 0
