"""The results of a sweep: tradeoff.json and .csv, the figure, the page, and the summary for the terminal.

tradeoff.json has the entries of Table; tradeoff.csv has a line a run, its columns are COLUMNS, by the same names.
"""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bstcad.report.drawing import BLUE, GREY, VERMILION, new_figure, png, styled
from bstcad.report.light_figures import plain_ticks
from bstcad.report.report import base64_images, machine
from bstcad.report.units import about, duration, environment, number
from bstcad.runs import files
from bstcad.scene.scene import Scene
from bstcad.sweep.cold_run import (
    FAILED,
    NOT_RUN,
    THIS_MACHINE,
    HistoryPoint,
    Run,
    Stored,
    StoredSettings,
    put_table,
    rounded,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.console import Group

# --- the table --------------------------------------------------------------------------------------------------------

FEWEST = 3  # runs of a front along which halving has a price: two make a line whatever they are
COLUMNS = (
    "knobs", "settings", "status", "seconds", "cpu_seconds", "kernel_seconds", "units", "rrmsd", "rrmsd_noise",
    "rrmsd_reported", "peak_memory_gb", "on_front", "predicted_seconds", "cost_seconds", "where", "reason",
)  # fmt: skip
KEPT = {"allowed_seconds", "history", "machine", "versions", "version"}  # of a run, in its own record alone


class Place(Stored):
    """A point of a knob over its seeds: medians, and the range of the error."""

    label: str  # in words
    settings: StoredSettings  # of the run
    seconds: float | None  # None: seconds do not compare
    rrmsd: float  # by the judge, the median over the seeds
    lowest: float  # RRMSD over the seeds
    highest: float  # RRMSD over the seeds
    seeds: int  # how many were run


class TableKnob(Stored):
    """A knob, and its points that were run."""

    key: str  # of the scene
    title: str  # in words
    places: tuple[Place, ...]  # from little work to much


class Calibration(Stored):
    """Seconds of the calibration kernel over the sweep."""

    seconds: float | None  # median
    lowest: float | None  # of its range
    highest: float | None  # of its range
    what: str = (
        "merit and gradient of 1024² ray tubes through a fixed lens of 257² control points, 512² pixels; the least of "
        "three, in the process of the sweep, before each run"
    )  # in words


class Preset(Stored):
    """A quality preset that was run."""

    name: str  # draft, standard or fine
    seconds: float | None  # of its run
    rrmsd: float  # by the judge


class Table(Stored):
    """All results of a sweep."""

    name: str  # of the scene
    title: str  # of the scene
    base: dict[str, Any]  # the scene as it stands: quality, control_points, pixels, knobs (tailoring as resolved)
    budget_seconds: float  # asked for
    spent_seconds: float  # by all runs
    errors_alone: bool  # every lens is from another machine: there are no seconds and no front
    version: str  # of bstcad
    sources: str  # version of bstcad with a hash of its sources
    machine: dict[str, Any]  # on which the seconds were measured
    versions: dict[str, str]  # of the libraries, by name
    reference: dict[str, Any]  # the judge of all runs: rays (the numbers that it took, the least first), what, in words
    calibration: Calibration  # of the machine's pace
    runs: tuple[Run, ...]  # the most important first, without the entries KEPT
    knobs: tuple[TableKnob, ...]  # that were turned
    front: tuple[StoredSettings, ...]  # of the runs that no other beats, the quickest first
    front_halving: float | None  # factor on the time that halves the error along the front
    presets: tuple[Preset, ...]  # the qualities, each as a run
    seeds: dict[str, bool | None]  # by method: did another seed give another lens?  null: not measured
    history: tuple[HistoryPoint, ...]  # of the base's run, by its own tubes

    @property
    def lenses(self) -> list[Run]:
        """The runs with a lens, wherever they took place."""
        return [run for run in self.runs if run.done]

    @property
    def shown(self) -> list[Run]:
        """The runs of the figure: all whose seconds compare; if no seconds compare, all with a lens."""
        return [run for run in self.lenses if self.errors_alone or run.comparable]

    @property
    def best(self) -> list[Run]:
        """The runs of the Pareto front, the quickest first."""
        return sorted((run for run in self.runs if run.on_front), key=lambda run: run.seconds)

    @property
    def own(self) -> Run | None:
        """The run of the scene as it stands; None: not run, or failed."""
        return next((run for run in self.shown if not run.settings), None)

    @property
    def failed(self) -> list[Run]:
        """The runs without a lens."""
        return [run for run in self.runs if run.status == FAILED]

    @property
    def not_run(self) -> list[Run]:
        """The runs that did not fit into the budget."""
        return [run for run in self.runs if run.status == NOT_RUN]

    @property
    def elsewhere(self) -> bool:
        """Did a run take place on another machine?"""
        return any(run.where not in (THIS_MACHINE, "") for run in self.runs)


def front(runs: Iterable[Run]) -> list[Run]:
    """The Pareto front: the runs that no other beats in both time and error, the quickest first."""
    found: list[Run] = []
    for run in sorted((run for run in runs if run.comparable), key=lambda run: (run.seconds, run.rrmsd)):
        if not found or run.rrmsd < found[-1].rrmsd:
            found.append(run)
    return found


def halving(front: Sequence[Run]) -> float | None:
    """k = 2^(-d ln t / d ln e) by least squares: the factor on the time t that halves the error e along a front.

    None: fewer than FEWEST runs.
    """
    if len(front) < FEWEST:
        return None
    errors, times = [math.log(run.rrmsd) for run in front], [math.log(run.seconds) for run in front]
    return 2.0 ** -statistics.linear_regression(errors, times).slope


def write(table: Table, folder: Path) -> None:
    """Write tradeoff.json and tradeoff.csv."""
    facts = rounded(table.model_dump(mode="json", exclude={"runs": {"__all__": KEPT}}))
    text = json.dumps(facts, ensure_ascii=False, indent=1)
    files.put(folder / "tradeoff.json", f"{text}\n".encode())
    for run in facts["runs"]:
        run["knobs"] = "; ".join(run["knobs"])
        run["settings"] = "; ".join(f"{key} = {value}" for key, value in run["settings"].items())
    put_table(folder / "tradeoff.csv", COLUMNS, facts["runs"])


# --- the figure -------------------------------------------------------------------------------------------------------

# Okabe and Ito's colours, each with a marker of its own, for who sees no colours.
LOOKS = {
    "evaluations": (BLUE, "o", "-"),
    "tubes": (VERMILION, "s", "-"),
    "control_points": ("#009e73", "^", "-"),
    "adam": ("#222222", "x", "--"),
    "precision": ("#cc79a7", "P", "-"),
    "pixels": ("#56b4e9", "D", "-"),
    "rounds": ("#e69f00", "v", "-"),
    "transport_grid": ("#8c6d31", "<", "-"),
    "transport_iterations": ("#7f7f7f", ">", "-"),
    "tubes_evaluations": ("#7b3fa0", "h", ":"),
    "control_points_tubes": ("#3b6e3b", "p", ":"),
}
WIDTH, HEIGHT = 10.0, 7.4  # inches
ROOM = 1.25  # factor left free beyond the outermost points
FAR = 6.0  # factor below all errors to which the standard error is looked for
NO_PICTURE = 1.0  # RRMSD from which a lens is as bad as darkness
HISTORY, FRONT, RING = "#b5b5b5", "#f0c80073", "#a87c00"


@styled
def tradeoff_figure(table: Table) -> Figure:
    """RRMSD against seconds."""
    figure = new_figure(WIDTH, HEIGHT)
    plane(figure.subplots(), table)
    return figure


def plane(axes: Axes, table: Table) -> None:
    """Time and error of all runs; above, the time in units of the calibration kernel."""
    seconds, every = [run.seconds for run in table.shown], [run.rrmsd for run in table.shown]
    bright = [rrmsd for rrmsd in every if rrmsd < NO_PICTURE] or every
    floors = [(run.seconds, run.rrmsd_noise) for run in table.best if run.rrmsd_noise]  # below them nothing can be told
    left, right = min(seconds) / ROOM, max(seconds) * ROOM
    low, high = min(bright) / ROOM, max(bright) * ROOM
    low = max(min([low, *(floor / ROOM for _, floor in floors)]), low / FAR)
    axes.set(xscale="log", yscale="log", xlim=(left, right), ylim=(low, high))
    axes.grid(which="major")
    axes.set_xlabel("seconds, the whole command in a cold process")
    axes.set_ylabel("RRMSD by the reference")
    axes.set_title(f"What accuracy costs in time: {table.title or table.name}", pad=12)
    plain_ticks(axes.xaxis, left, right)
    plain_ticks(axes.yaxis, low, high)
    if unit := table.calibration.seconds:
        above = axes.secondary_xaxis("top", functions=(lambda t: t / unit, lambda u: u * unit))
        plain_ticks(above.xaxis, left / unit, right / unit)
        above.set_xlabel(f"units of the calibration kernel, {1000 * unit:.0f} ms here")
        above.spines["top"].set_visible(True)
    if floors:
        axes.plot(*zip(*floors, strict=True), color=GREY, lw=0.9, ls=(0, (5, 3)), zorder=1,
                  label="standard error of the reference")  # fmt: skip
    if points := [(point["seconds"], point["rrmsd"]) for point in table.history if point["rrmsd"]]:
        axes.plot(*zip(*points, strict=True), color=HISTORY, lw=0.9, zorder=1, label="along the base's run (warm)")
    for knob in table.knobs:
        if knob.key in LOOKS and len(knob.places) > (knob.key != "adam"):  # the base is a place of all others
            _curve(axes, knob)
    if table.best:  # each in a ring, on the staircase above which all others lie
        axes.step(*zip(*((run.seconds, run.rrmsd) for run in table.best), strict=True), where="post", color=FRONT,
                  lw=5.5, zorder=2, label="Pareto front", marker="o", ms=18, mfc="none", mec=RING, mew=1.6,
                  solid_joinstyle="round", solid_capstyle="round")  # fmt: skip
    _presets(axes, table)
    legend(axes)


def _curve(axes: Axes, knob: TableKnob) -> None:
    """The places of a knob in their order; bars from seed to seed."""
    colour, marker, line = LOOKS[knob.key]
    ends, places = " to ".join(dict.fromkeys((knob.places[0].label, knob.places[-1].label))), knob.places
    edge, width = (colour, 1.4) if marker == "x" else ("white", 0.5)
    axes.plot([p.seconds for p in places], [p.rrmsd for p in places], color=colour, marker=marker, ls=line, mec=edge,
              mew=width, ms=5, lw=1.2, zorder=3, label=f"{knob.title}: {ends}")  # fmt: skip
    if spread := [p for p in places if p.seeds > 1]:
        bars = [[p.rrmsd - p.lowest for p in spread], [p.highest - p.rrmsd for p in spread]]
        axes.errorbar([p.seconds for p in spread], [p.rrmsd for p in spread], bars, fmt="none", ecolor=colour, lw=1.0,
                      capsize=2, zorder=3)  # fmt: skip


def _presets(axes: Axes, table: Table) -> None:
    """The presets, large and by name."""
    line = sorted((preset.seconds, preset.rrmsd) for preset in table.presets if preset.name != "paper")
    if len(line) > 1:
        axes.plot(*zip(*line, strict=True), color="#111111", lw=0.9, ls=(0, (1, 2)), zorder=4, label="bstcad's presets")
    for preset in table.presets:
        at = preset.seconds, preset.rrmsd
        axes.plot(*at, "*", ms=17, color="#ffffff", mec="#111111", mew=1.1, zorder=5)
        axes.annotate(preset.name, at, (9, 8), textcoords="offset points", weight="bold", fontsize=10, zorder=6,
                      bbox={"fc": "white", "alpha": 0.7, "lw": 0, "pad": 0.8})  # fmt: skip


def legend(axes: Axes) -> None:
    """Below the picture, in columns, of all that has a name."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=2, fontsize=8.2, handlelength=2.6,
                    columnspacing=1.6)  # fmt: skip


# --- the page and the terminal ----------------------------------------------------------------------------------------

STYLES = {"pass": "bold green", "remarks": "bold yellow", "fail": "bold red"}  # of the page, of the terminal
TEMPLATE = Path(__file__).with_name("tradeoff.html.j2")


def write_page(table: Table, scene: Scene, folder: Path) -> None:
    """Write tradeoff.html, a single file that fetches nothing, and tradeoff.png, if seconds of lenses compare."""
    picture = png(tradeoff_figure(table)) if table.best else None
    if picture:
        files.put(folder / "tradeoff.png", picture)
    else:
        (folder / "tradeoff.png").unlink(missing_ok=True)
    text = environment().from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        table=table, scene=scene.toml(), machine=machine(table.machine), verdict=verdict(table),
        picture=base64_images({"": picture}).get(""),
        runs=sorted(table.lenses, key=lambda run: run.rrmsd if table.errors_alone else run.seconds),
    )  # fmt: skip
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
    return style, f"HALVING THE ERROR COSTS ×\u00a0{about(table.front_halving)}", along


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
    lines = [Text(f"Failed: {run.label}: {run.reason}") for run in table.failed]
    if count := len(table.not_run):
        lines.append(Text(f"{count} runs did not fit into the budget; a larger --budget goes on from here"))
    return Group(rows, *lines, Text(f"{headline} ", STYLES[style]).append(explanation, "default"))
