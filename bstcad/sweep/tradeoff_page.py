"""tradeoff.html and tradeoff.png, and the summary for the terminal."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from bstcad.report import report
from bstcad.report.units import duration, number
from bstcad.runs import files
from bstcad.scene.scene import Scene
from bstcad.sweep import tradeoff_figure
from bstcad.sweep.results import Table

if TYPE_CHECKING:
    from rich.console import Group

STYLES = {"pass": "bold green", "remarks": "bold yellow", "fail": "bold red"}  # of the page, of the terminal
METHODS = {"least-squares": "L-BFGS by ray tubes", "adam": "Adam by random rays"}
HEADINGS = {True: "What each knob does to the error", False: "What accuracy costs in time"}  # with errors alone, or not
ALT = {
    True: "RRMSD of each point of each knob, logarithmic, a line a knob; that of the scene as it stands is marked.",
    False: "RRMSD against seconds, both logarithmic: a curve for each knob, the Pareto front, the presets.",
}


def write(table: Table, scene: Scene, folder: Path) -> None:
    """Write tradeoff.html, one file that fetches nothing, and tradeoff.png, if a run came to a lens."""
    import jinja2

    picture = tradeoff_figure.draw(table) if table.lenses else None
    if picture:
        files.put(folder / "tradeoff.png", picture)
    else:
        (folder / "tradeoff.png").unlink(missing_ok=True)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([Path(__file__).parent, Path(report.__file__).parent]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"number": number, "duration": duration}
    text = environment.get_template("tradeoff.html.j2").render(
        table=table,
        scene=scene.toml(),
        heading=HEADINGS[table.errors_alone],
        verdict=verdict(table),
        tiles=list(tiles(table)),
        notes=list(notes(table)),
        picture=picture and base64.b64encode(picture).decode(),
        alt=ALT[table.errors_alone],
        runs=sorted(table.lenses, key=lambda run: run.rrmsd if table.errors_alone else run.seconds),
        machine=report.machine(table.machine),
    )
    files.put(folder / "tradeoff.html", text.encode())


def verdict(table: Table) -> tuple[str, str, str]:
    """(style, headline, explanation)."""
    if not table.lenses:
        return "fail", "NO LENS", "No run came to a lens; why stands below."
    count, failed, style = len(table.shown), len(table.failed), "remarks" if table.failed else "pass"
    together = ", all machines together" if table.elsewhere else ""
    spent = f"{duration(table.spent_seconds)} of a budget of {duration(table.budget_seconds)}{together}."
    ran = f"{count} run{'s' * (count != 1)}{f', {failed} more without a lens' if failed else ''}; {spent}"
    if table.errors_alone:
        best = min(table.shown, key=lambda run: run.rrmsd)
        least = f"is the least, by {best.label}; errors alone were found, no times. {ran}"
        return style, f"RRMSD {number(best.rrmsd)}", least
    ends = [f"{number(run.rrmsd)} in {duration(run.seconds)}" for run in (table.best[0], table.best[-1])]
    if len(table.best) == 1:
        return style, f"RRMSD {ends[0]}", f"is the one run that none beats. {ran}"
    if table.front_halving is None:
        few = f"{len(table.best)} runs that none beats are too few for a price of halving the error; a larger budget"
        return style, f"RRMSD {ends[0]}, {ends[1]}", f"{few} has more of them. {ran}"
    along = f"in time, along the Pareto front from {ends[0]} to {ends[1]}. {ran}"
    return style, f"HALVING THE ERROR COSTS {times(table.front_halving)}", along


def times(k: float) -> str:
    """A factor on the time, without a line break in it: × 2.3, × 38, over × 1000."""
    size = "1000" if k > 1000 else f"{k:.0f}" if k >= 10 else f"{k:.2g}" if k >= 1.05 else "1"
    return f"{'over ' if k > 1000 else ''}×\u00a0{size}"


def tiles(table: Table) -> Iterator[tuple[str, str, str]]:
    """The first figures: (name, value, remark)."""
    if table.best:
        quick, best = table.best[0], table.best[-1]
        yield "Best RRMSD", number(best.rrmsd), f"in {duration(best.seconds)}: {best.label}"
        yield "Quickest", duration(quick.seconds), f"RRMSD {number(quick.rrmsd)}: {quick.label}"
    if base := table.own:
        on_front = "; on the Pareto front" if base.on_front else ""
        took = "" if table.errors_alone else f"in {duration(base.seconds)}{on_front}"
        yield "The scene as it stands", number(base.rrmsd), took
        if base.rrmsd_noise and math.isfinite(base.rrmsd_noise):
            rays = f"of the reference, by {base.rays / 1e6:.0f} million rays"
            yield "Standard error there", number(base.rrmsd_noise), rays
    if unit := table.calibration.seconds:
        low, high = (1000 * value for value in (table.calibration.lowest, table.calibration.highest))
        yield "Calibration kernel", f"{1000 * unit:.0f} ms", f"{low:.0f} to {high:.0f} ms over the sweep"


def notes(table: Table) -> Iterator[str]:
    """Sentences on seeds, on missing points and on other machines."""
    for method, matters in table.seeds.items():
        name = METHODS[method]
        if matters is None:
            yield f"Whether the seed matters to {name} was not measured: there was no time for a second seed."
        elif matters:
            bars = "" if table.errors_alone else "bars show the range, "
            yield f"The seed matters to {name}: another gives another lens; {bars}points the median."
        else:
            yield f"The seed does not matter to {name}: another seed gave the same lens to the last bit, so one is run."
    missing = [knob.title for knob in table.knobs if len(knob.places) < 2]
    if missing:
        yield f"Of these too few points fitted into the budget: {', '.join(missing)}."
    if table.errors_alone:
        yield (
            "All runs took place on other machines, beside one another, so that their seconds do not compare: there is "
            "no axis of time and no Pareto front. Without --scheduler, into another folder, a sweep finds these."
        )
    elif table.elsewhere:
        yield (
            "Some runs took place on other machines: their seconds do not compare, so that they stand among all runs "
            "alone, with their errors."
        )


def summary(table: Table) -> Group:
    """The presets, the Pareto front and the verdict for the terminal."""
    import rich.table
    from rich.console import Group
    from rich.text import Text

    style, headline, explanation = verdict(table)
    rows = rich.table.Table(title=table.title or table.name, title_justify="left")
    rows.add_column("run")
    for heading in ("RRMSD",) if table.errors_alone else ("RRMSD", "seconds"):
        rows.add_column(heading, justify="right")
    for run in sorted(table.shown, key=lambda run: -run.rrmsd):
        if run.on_front or "quality" in run.knobs or not run.settings:
            seconds = () if table.errors_alone else (f"{run.seconds:.1f}",)
            rows.add_row(Text(f"{run.label}{' (Pareto front)' * run.on_front}"), f"{run.rrmsd:.4f}", *seconds)
    lines = [Text(f"Note: {note}") for note in notes(table)]
    lines += [Text(f"Failed: {run.label}: {run.reason}") for run in table.failed]
    if count := len(table.not_run):
        lines.append(Text(f"{count} runs did not fit into the budget; a larger --budget goes on from here"))
    return Group(rows, *lines, Text(f"{headline} ", STYLES[style]).append(explanation, "default"))
