"""Results of a sweep: tradeoff.json and .csv, the figure, the page, and the summary for the terminal.

tradeoff.json has the entries of TradeoffTable; tradeoff.csv has one line per run, with the columns TRADEOFF_COLUMNS.
"""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bstcad.figures.drawing import BLUE, GREY, VERMILION, new_figure, png, styled
from bstcad.figures.light_figures import plain_ticks
from bstcad.planning.cold_run import (
    FAILED,
    NOT_RUN,
    THIS_MACHINE,
    ColdRun,
    HistoryPoint,
    StoredRecord,
    StoredSettings,
    round_numbers,
    write_csv,
)
from bstcad.report.report import base64_images, machine
from bstcad.report.units import about, duration, environment, number
from bstcad.runs import files
from bstcad.scene.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.console import Group

# --- the table --------------------------------------------------------------------------------------------------------

MIN_FRONT_RUNS = 3  # smallest number of runs on a Pareto front to which a power law is fitted
TRADEOFF_COLUMNS = (
    "knobs", "settings", "status", "seconds", "cpu_seconds", "kernel_seconds", "units", "rrmsd", "rrmsd_half",
    "rrmsd_noise", "rrmsd_reported", "peak_memory_gb", "on_front", "predicted_seconds", "cost_seconds", "where",
    "reason",
)  # fmt: skip
PRIVATE_FIELDS = {"allowed_seconds", "history", "machine", "versions", "version"}  # fields of ColdRun that results omit


class KnobPoint(StoredRecord):
    """Value of a knob (varied setting), with the time and the error of its run."""

    label: str  # value of the knob in words
    settings: StoredSettings  # settings of the run
    seconds: float | None  # time (s); null: times are not comparable
    rrmsd: float  # RRMSD by the reference


class TableKnob(StoredRecord):
    """Setting of a scene that was varied (knob), with its points that were run."""

    key: str  # name for programs, such as "tubes"
    title: str  # name in words
    places: tuple[KnobPoint, ...]  # points, in the order of increasing work


class Calibration(StoredRecord):
    """Time of the calibration kernel during the sweep."""

    seconds: float | None  # median (s)
    lowest: float | None  # minimum (s)
    highest: float | None  # maximum (s)
    what: str = (
        "merit and gradient of 1024² flux tubes through a fixed lens of 257² control points, 512² pixels; the fastest "
        "of three evaluations, in the process of the sweep, before each run"
    )  # description of the kernel

    @classmethod
    def of(cls, unit: Sequence[float]) -> Calibration:
        """Return the record of the kernel's times `unit` (s); without times its values are null."""
        extremes: dict[str, Any] = {"lowest": min(unit, default=None), "highest": max(unit, default=None)}
        return cls(seconds=statistics.median(unit) if unit else None, **extremes)


class Preset(StoredRecord):
    """Quality preset that was run."""

    name: str  # draft, standard, fine or paper
    seconds: float | None  # time of the run (s); null: times are not comparable
    rrmsd: float  # RRMSD by the reference


class TradeoffTable(StoredRecord):
    """All results of a sweep."""

    name: str  # name of the scene
    title: str  # title of the scene
    base: dict[str, Any]  # base scene: quality, control_points, pixels, knobs (tailoring settings with their defaults)
    budget_seconds: float  # budget (s)
    spent_seconds: float  # time spent by all runs (s)
    errors_alone: bool  # true if all lenses are from other machines, so that there are no times and no front
    version: str  # version of bstcad
    sources: str  # version of bstcad with a hash of its sources
    machine: dict[str, Any]  # machine on which the times were measured
    versions: dict[str, str]  # versions of the libraries, by name
    reference: dict[str, Any]  # reference for the RRMSD: rays (numbers of rays, ascending), what (in words)
    calibration: Calibration  # time of the calibration kernel
    runs: tuple[ColdRun, ...]  # ended runs, then the others, both in order of importance
    knobs: tuple[TableKnob, ...]  # settings that were varied
    front: tuple[StoredSettings, ...]  # settings of the runs on the Pareto front, the fastest first
    front_halving: float | None  # factor of the time that halves the error along the front
    presets: tuple[Preset, ...]  # quality presets that were run
    history: tuple[HistoryPoint, ...]  # convergence of the run of the base scene

    @property
    def runs_with_lens(self) -> list[ColdRun]:
        """Runs with a lens, on any machine."""
        return [run for run in self.runs if run.done]

    @property
    def plotted(self) -> list[ColdRun]:
        """Runs in the figure: those with comparable times, or all runs with a lens if no times are comparable."""
        return [run for run in self.runs_with_lens if self.errors_alone or run.comparable]

    @property
    def front_runs(self) -> list[ColdRun]:
        """Runs of the Pareto front, the fastest first."""
        return sorted((run for run in self.runs if run.on_front), key=lambda run: run.time_and_error)

    @property
    def base_run(self) -> ColdRun | None:
        """Run of the base scene; None: not run, failed, or its time is not comparable but those of other runs are."""
        return next((run for run in self.plotted if not run.settings), None)

    @property
    def failed(self) -> list[ColdRun]:
        """Runs that gave no lens, or one that leaves a target dark."""
        return [run for run in self.runs if run.status == FAILED]

    @property
    def not_run(self) -> list[ColdRun]:
        """Runs that did not fit into the budget."""
        return [run for run in self.runs if run.status == NOT_RUN]

    @property
    def has_remote_runs(self) -> bool:
        """True if a run was done on another machine."""
        return any(run.where not in (THIS_MACHINE, "") for run in self.runs)


def pareto_front(runs: Iterable[ColdRun]) -> list[ColdRun]:
    """Return the Pareto front: comparable runs that none of them dominates in time and error, the fastest first."""
    front: list[ColdRun] = []
    for run in sorted((run for run in runs if run.comparable), key=lambda run: run.time_and_error):
        if not front or run.time_and_error[1] < front[-1].time_and_error[1]:
            front.append(run)
    return front


def halving_factor(front: Sequence[ColdRun]) -> float | None:
    """Return 2^(-d ln t / d ln e) by least squares, the factor of the time t that halves the error e along a front.

    None if the front has fewer than MIN_FRONT_RUNS runs.
    """
    if len(front) < MIN_FRONT_RUNS:
        return None
    times, errors = zip(*(map(math.log, run.time_and_error) for run in front), strict=True)
    return 2.0 ** -statistics.linear_regression(errors, times).slope


def write(table: TradeoffTable, folder: Path) -> None:
    """Write tradeoff.json and tradeoff.csv."""
    facts = round_numbers(table.model_dump(mode="json", exclude={"runs": {"__all__": PRIVATE_FIELDS}}))
    text = json.dumps(facts, ensure_ascii=False, indent=1)
    files.put(folder / "tradeoff.json", f"{text}\n".encode())
    for run in facts["runs"]:
        run["knobs"] = "; ".join(run["knobs"])
        run["settings"] = "; ".join(f"{key} = {value}" for key, value in run["settings"].items())
    write_csv(folder / "tradeoff.csv", TRADEOFF_COLUMNS, facts["runs"])


# --- the figure -------------------------------------------------------------------------------------------------------

# Colour, marker and line of each knob; the markers are for readers who cannot distinguish colours.
KNOB_STYLES = {
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
FIGURE_WIDTH, FIGURE_HEIGHT = 10.0, 7.4  # inches
AXIS_MARGIN = 1.25  # factor between the outermost points and the ends of the axes
MAX_FLOOR_DISTANCE = 6.0  # largest factor by which standard errors extend the RRMSD axis downwards
DARK_RRMSD = 1.0  # RRMSD of a dark picture; only runs below it extend the RRMSD axis, unless there are none
THIN_LINE: dict[str, Any] = {"lw": 0.9, "zorder": 1}  # style of the lines of the convergence and the standard error
FRONT_STYLE: dict[str, Any] = {"color": "#f0c80073", "lw": 5.5, "solid_joinstyle": "round", "solid_capstyle": "round"}
RING_STYLE: dict[str, Any] = {"marker": "o", "ms": 18, "mfc": "none", "mec": "#a87c00", "mew": 1.6}  # runs of the front


@styled
def tradeoff_figure(table: TradeoffTable) -> Figure:
    """Draw RRMSD against time."""
    figure = new_figure(FIGURE_WIDTH, FIGURE_HEIGHT)
    draw_runs(figure.subplots(), table)
    return figure


def draw_runs(axes: Axes, table: TradeoffTable) -> None:
    """Draw time and error of all runs; the upper axis is the time in units of the calibration kernel."""
    seconds, errors = zip(*(run.time_and_error for run in table.plotted), strict=True)
    bright = [rrmsd for rrmsd in errors if rrmsd < DARK_RRMSD] or errors
    floors = [(run.time_and_error[0], run.rrmsd_noise) for run in table.front_runs if run.rrmsd_noise]
    left, right = min(seconds) / AXIS_MARGIN, max(seconds) * AXIS_MARGIN
    low, high = min(bright) / AXIS_MARGIN, max(bright) * AXIS_MARGIN
    low = max(min([low, *(floor / AXIS_MARGIN for _, floor in floors)]), low / MAX_FLOOR_DISTANCE)
    axes.set(xscale="log", yscale="log", xlim=(left, right), ylim=(low, high))
    axes.grid(which="major")
    axes.set_xlabel("seconds, the whole command in a cold process")
    axes.set_ylabel("RRMSD on pixels, by the reference")
    axes.set_title(f"What accuracy costs in time: {table.title or table.name}", pad=12)
    plain_ticks(axes.xaxis, left, right)
    plain_ticks(axes.yaxis, low, high)
    if unit := table.calibration.seconds:
        upper = axes.secondary_xaxis("top", functions=(lambda t: np.divide(t, unit), lambda u: np.multiply(u, unit)))
        plain_ticks(upper.xaxis, left / unit, right / unit)
        upper.set_xlabel(f"units of the calibration kernel, {1000 * unit:.0f} ms here")
        upper.spines["top"].set_visible(True)
    if floors:
        label = "standard error of the reference"
        axes.plot(*zip(*floors, strict=True), color=GREY, ls=(0, (5, 3)), label=label, **THIN_LINE)
    if points := [(point["seconds"], point["rrmsd"]) for point in table.history if point["rrmsd"]]:
        label = "convergence of the base run"
        axes.plot(*zip(*points, strict=True), color="#b5b5b5", label=label, **THIN_LINE)
    for knob in table.knobs:
        if knob.key in KNOB_STYLES and len(knob.places) > (knob.key != "adam"):  # other knobs include the base
            _draw_knob(axes, knob)
    if table.front_runs:
        times, errors = zip(*(run.time_and_error for run in table.front_runs), strict=True)
        axes.step(times, errors, where="post", zorder=2, label="Pareto front", **FRONT_STYLE, **RING_STYLE)
    _draw_presets(axes, table)
    draw_legend(axes)


def _draw_knob(axes: Axes, knob: TableKnob) -> None:
    """Draw the points of a knob in their order."""
    colour, marker, line = KNOB_STYLES[knob.key]
    ends, places = " to ".join(dict.fromkeys((knob.places[0].label, knob.places[-1].label))), knob.places
    style: dict[str, Any] = {"color": colour, "marker": marker, "ls": line, "ms": 5, "lw": 1.2, "zorder": 3}
    style |= {"mec": colour, "mew": 1.4} if marker == "x" else {"mec": "white", "mew": 0.5}
    points = [(p.seconds, p.rrmsd) for p in places if p.seconds is not None]
    axes.plot(*zip(*points, strict=True), label=f"{knob.title}: {ends}", **style)


def _draw_presets(axes: Axes, table: TradeoffTable) -> None:
    points = [(preset.name, (preset.seconds, preset.rrmsd)) for preset in table.presets if preset.seconds is not None]
    line = sorted(position for name, position in points if name != "paper")
    if len(line) > 1:
        axes.plot(*zip(*line, strict=True), color="#111111", lw=0.9, ls=(0, (1, 2)), zorder=4, label="bstcad's presets")
    for name, position in points:
        axes.plot(*position, "*", ms=17, color="#ffffff", mec="#111111", mew=1.1, zorder=5)
        box = {"fc": "white", "alpha": 0.7, "lw": 0, "pad": 0.8}
        style: dict[str, Any] = {"weight": "bold", "fontsize": 10, "zorder": 6}
        axes.annotate(name, position, (9, 8), textcoords="offset points", bbox=box, **style)


def draw_legend(axes: Axes) -> None:
    """Draw the legend below the axes, in columns."""
    if axes.get_legend_handles_labels()[0]:
        place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.11)}
        axes.legend(ncols=2, fontsize=8.2, handlelength=2.6, columnspacing=1.6, **place)


# --- the page and the terminal ----------------------------------------------------------------------------------------

VERDICT_STYLES = {"pass": "bold green", "remarks": "bold yellow", "fail": "bold red"}  # terminal styles, by CSS class
PAGE_TEMPLATE = Path(__file__).with_name("tradeoff.html.j2")


def write_page(table: TradeoffTable, scene: Scene, folder: Path) -> None:
    """Write tradeoff.html, a self-contained file, and tradeoff.png if times are comparable."""
    picture = png(tradeoff_figure(table)) if table.front_runs else None
    if picture:
        files.put(folder / "tradeoff.png", picture)
    else:
        (folder / "tradeoff.png").unlink(missing_ok=True)
    template = environment().from_string(PAGE_TEMPLATE.read_text(encoding="utf-8"))
    runs = sorted(table.runs_with_lens, key=lambda run: run.time_and_error[1 if table.errors_alone else 0])
    data = {"table": table, "runs": runs, "verdict": verdict(table), "picture": base64_images({"": picture}).get("")}
    page = template.render(data, scene=scene.toml(), machine=machine(table.machine))
    files.put(folder / "tradeoff.html", page.encode())


def verdict(table: TradeoffTable) -> tuple[str, str, str]:
    """Return the key of VERDICT_STYLES, the headline and the explanation of the result."""
    if not table.runs_with_lens:
        return "fail", "NO LENS", "No run gave a lens; the reasons are listed below."
    count, failed, style = len(table.plotted), len(table.failed), "remarks" if table.failed else "pass"
    together = ", summed over all machines" if table.has_remote_runs else ""
    spent = f"{duration(table.spent_seconds)} of a budget of {duration(table.budget_seconds)}{together}."
    run_count = f"{count} run{'s' * (count != 1)}{f', {failed} more without a lens' if failed else ''}; {spent}"
    if table.errors_alone:
        best = min(table.plotted, key=lambda run: run.time_and_error[1])
        lowest = f"is the lowest, with {best.label}; only errors were measured, no times. {run_count}"
        return style, f"RRMSD {number(best.rrmsd)}", lowest
    points = (run.time_and_error for run in (table.front_runs[0], table.front_runs[-1]))
    ends = [f"{number(rrmsd)} in {duration(seconds)}" for seconds, rrmsd in points]
    if len(table.front_runs) == 1:
        return style, f"RRMSD {ends[0]}", f"is the only run on the Pareto front. {run_count}"
    if table.front_halving is None:
        few = f"The Pareto front has {len(table.front_runs)} runs, too few to state what halving the error costs"
        return style, f"RRMSD {ends[0]}, {ends[1]}", f"{few}; give a larger budget. {run_count}"
    along = f"in time, along the Pareto front from {ends[0]} to {ends[1]}. {run_count}"
    return style, f"HALVING THE ERROR COSTS ×\u00a0{about(table.front_halving)}", along


def summary(table: TradeoffTable) -> Group:
    """Return the presets, the Pareto front and the verdict for the terminal."""
    import rich.table
    from rich.console import Group
    from rich.text import Text

    style, headline, explanation = verdict(table)
    rows = rich.table.Table(title=table.title or table.name, title_justify="left")
    rows.add_column("run")
    for heading in ("RRMSD on pixels", "on half pixels", *(() if table.errors_alone else ("seconds",))):
        rows.add_column(heading, justify="right")
    for run in sorted(table.plotted, key=lambda run: -run.time_and_error[1]):
        if run.on_front or "quality" in run.knobs or not run.settings:
            seconds = () if table.errors_alone else (f"{run.seconds:.1f}",)
            errors = ("–" if each is None else f"{each:.4f}" for each in (run.rrmsd, run.rrmsd_half))
            rows.add_row(Text(f"{run.label}{' (Pareto front)' * run.on_front}"), *errors, *seconds)
    lines = [Text(f"Failed: {run.label}: {run.reason}") for run in table.failed]
    if count := len(table.not_run):
        lines.append(Text(f"Runs beyond the budget: {count}; a larger --budget continues from here"))
    return Group(rows, *lines, Text(f"{headline} ", VERDICT_STYLES[style]).append(explanation, "default"))
