"""The figure of a sweep: RRMSD against seconds, a curve a knob, with the Pareto front; or errors alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from bstcad.report.drawing import BLUE, GREY, VERMILION, new_figure, png, styled
from bstcad.report.units import number
from bstcad.sweep.results import Table, TableKnob

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
HISTORY, FRONT, RING, FAILED = "#b5b5b5", "#f0c80073", "#a87c00", "#b00020"


def draw(table: Table) -> bytes:
    """The figure as PNG; needs a run with a lens."""
    return png(errors(table) if table.errors_alone else tradeoff(table))


@styled
def tradeoff(table: Table) -> Figure:
    """RRMSD against seconds."""
    figure = new_figure(WIDTH, HEIGHT)
    plane(figure.subplots(), table)
    return figure


@styled
def errors(table: Table) -> Figure:
    """RRMSD of each place, a line a knob, of runs whose seconds do not compare."""
    rows = [knob for knob in table.knobs if knob.places][::-1]
    figure = new_figure(WIDTH, 1.6 + 0.42 * len(rows))
    axes = figure.subplots()
    low, high = _room([place.rrmsd for knob in rows for place in knob.places])
    axes.set(xscale="log", xlim=(low / ROOM, high * ROOM), ylim=(-0.7, len(rows) - 0.3))
    _plain(axes.xaxis, axes.get_xlim())
    axes.grid(which="major", axis="x")
    axes.set_yticks(range(len(rows)), [knob.title for knob in rows])
    axes.set_xlabel("RRMSD by the reference")
    axes.set_title(f"What each knob does to the error: {table.title or table.name}", pad=12)
    for y, knob in enumerate(rows):
        _row(axes, y, knob)
    if table.own:
        axes.axvline(table.own.rrmsd, color=GREY, lw=0.9, ls=(0, (5, 3)), zorder=1, label="the scene as it stands")
        legend(axes)
    return figure


def _row(axes: Axes, y: int, knob: TableKnob) -> None:
    """A knob's places on its line, the ends by name."""
    colour, marker, line = LOOKS.get(knob.key, ("#111111", "o", ":"))
    places = sorted(knob.places, key=lambda place: place.rrmsd)
    edge = colour if marker == "x" else "white"
    axes.plot([place.rrmsd for place in places], [y] * len(places), color=colour, marker=marker, ls=line, ms=6, lw=1.0,
              mec=edge, mew=0.8, zorder=3)  # fmt: skip
    ends = ((places[0], -7, "right"), (places[-1], 7, "left"))
    for place, away, side in ends[: len(places)]:
        _annotate(axes, place.label, (place.rrmsd, y), (away, 0), ha=side, va="center", color=colour)


def plane(axes: Axes, table: Table) -> None:
    """Time and error of all runs."""
    _axes(axes, table)
    _floor(axes, table)
    if table.history:
        points = [(point.seconds, point.rrmsd) for point in table.history]
        axes.plot(*zip(*points, strict=True), color=HISTORY, lw=0.9, zorder=1, label="along the base's run (warm)")
    for knob in table.knobs:
        if knob.key in LOOKS and len(knob.places) > (knob.key != "adam"):  # the base is a place of all others
            _curve(axes, knob)
    _front(axes, table)
    _presets(axes, table)
    _failed(axes, table)
    legend(axes)


def _axes(axes: Axes, table: Table) -> None:
    """Both logarithmic, with plain numbers; above, the time in units of the calibration kernel."""
    times = [run.seconds for run in (*table.shown, *(run for run in table.failed if run.seconds > 1))]
    axes.set(xscale="log", yscale="log", xlim=_room(times), ylim=_heights(table))
    _plain(axes.xaxis, axes.get_xlim())
    _plain(axes.yaxis, axes.get_ylim())
    axes.grid(which="major")
    axes.set_xlabel("seconds, the whole command in a cold process")
    axes.set_ylabel("RRMSD by the reference")
    axes.set_title(f"What accuracy costs in time: {table.title or table.name}", pad=12)
    if unit := table.calibration.seconds:
        above = axes.secondary_xaxis("top", functions=(lambda t: t / unit, lambda u: u * unit))
        _plain(above.xaxis, tuple(limit / unit for limit in axes.get_xlim()))
        above.set_xlabel(f"units of the calibration kernel, {1000 * unit:.0f} ms here")
        above.spines["top"].set_visible(True)


def _plain(axis, limits: tuple[float, float]) -> None:
    """Ticks in plain numbers, closer where the axis spans less than a decade."""
    from matplotlib.ticker import LogLocator, NullLocator

    digits = (1, 2, 5) if limits[1] > 8 * limits[0] else (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9)
    axis.set_major_locator(LogLocator(subs=digits))
    axis.set_major_formatter(lambda value, _: number(value))
    axis.set_minor_locator(NullLocator())


def _annotate(axes: Axes, text: str, at: tuple[float, float], away: tuple[float, float], **look) -> None:
    """Text so many points away from a place."""
    axes.annotate(text, at, away, textcoords="offset points", **{"fontsize": 8} | look)


def _room(values: Sequence[float]) -> tuple[float, float]:
    return min(values) / ROOM, max(values) * ROOM


def _heights(table: Table) -> tuple[float, float]:
    """Of the error axis: lenses that are better than no picture, and the standard error where it is near."""
    errors = [run.rrmsd for run in table.shown]
    low, high = _room([error for error in errors if error < NO_PICTURE] or errors)
    return max(min([low, *(floor / ROOM for _, floor in _floors(table))]), low / FAR), high


def _floors(table: Table) -> list[tuple[float, float]]:
    """(seconds, standard error) of the runs of the front."""
    return [(run.seconds, run.rrmsd_noise) for run in table.best if run.rrmsd_noise]


def _floor(axes: Axes, table: Table) -> None:
    """The standard error of the reference along the front; below it nothing can be told."""
    if points := _floors(table):
        times, floors = zip(*points, strict=True)
        axes.fill_between(times, floors, axes.get_ylim()[0], color="#ececec", lw=0, zorder=0)
        axes.plot(times, floors, color=GREY, lw=0.9, ls=(0, (5, 3)), zorder=1, label="standard error of the reference")


def _curve(axes: Axes, knob: TableKnob) -> None:
    """The places of a knob in their order; bars from seed to seed."""
    colour, marker, line = LOOKS[knob.key]
    places = knob.places
    ends = f"{places[0].label} to {places[-1].label}" if len(places) > 1 else places[0].label
    edge, width = (colour, 1.4) if marker == "x" else ("white", 0.5)
    axes.plot([p.seconds for p in places], [p.rrmsd for p in places], color=colour, marker=marker, ls=line, ms=5,
              lw=1.2, mec=edge, mew=width, label=f"{knob.title}: {ends}", zorder=3)  # fmt: skip
    if spread := [p for p in places if p.seeds > 1]:
        bars = [[p.rrmsd - p.lowest for p in spread], [p.highest - p.rrmsd for p in spread]]
        axes.errorbar([p.seconds for p in spread], [p.rrmsd for p in spread], bars, fmt="none", ecolor=colour, lw=1.0,
                      capsize=2, zorder=3)  # fmt: skip


def _front(axes: Axes, table: Table) -> None:
    """The runs that no other beats, each in a ring, on the staircase above which all others lie."""
    if not table.best:
        return
    times, errors = zip(*((run.seconds, run.rrmsd) for run in table.best), strict=True)
    axes.step(times, errors, where="post", color=FRONT, lw=5.5, zorder=2, label="Pareto front",
              marker="o", ms=18, mfc="none", mec=RING, mew=1.6, solid_joinstyle="round",
              solid_capstyle="round")  # fmt: skip


def _presets(axes: Axes, table: Table) -> None:
    """The presets, large and by name."""
    line = sorted((preset.seconds, preset.rrmsd) for preset in table.presets if preset.name != "paper")
    if len(line) > 1:
        axes.plot(*zip(*line, strict=True), color="#111111", lw=0.9, ls=(0, (1, 2)), zorder=4, label="bstcad's presets")
    for preset in table.presets:
        at = preset.seconds, preset.rrmsd
        axes.plot(*at, "*", ms=17, color="#ffffff", mec="#111111", mew=1.1, zorder=5)
        _annotate(axes, preset.name, at, (9, 8), weight="bold", fontsize=10, zorder=6,
                  bbox={"fc": "white", "alpha": 0.7, "lw": 0, "pad": 0.8})  # fmt: skip


def _failed(axes: Axes, table: Table) -> None:
    """Runs without a lens: crosses along the top, where they ended."""
    low, _ = axes.get_xlim()
    for index, run in enumerate(table.failed):
        seconds = max(run.seconds, low * 1.05)
        axes.plot(seconds, 0.975, "X", transform=axes.get_xaxis_transform(), color=FAILED, ms=8, mec="white",
                  mew=0.6, clip_on=False, zorder=6, label="failed" if index == 0 else None)  # fmt: skip
        _annotate(axes, run.label, (seconds, 0.975), (6, 0), xycoords=axes.get_xaxis_transform(),
                  fontsize=7.5, color=FAILED, va="center")  # fmt: skip


def legend(axes: Axes) -> None:
    """Below the picture, in columns, of all that has a name."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=2, fontsize=8.2, handlelength=2.6,
                    columnspacing=1.6)  # fmt: skip
